"""Implicit integrators on the reduced equations of stiff problems: SciPy's Radau, SUNDIALS."""

from __future__ import annotations

import io
from abc import abstractmethod
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.work_precision.peers.base import (
    Array,
    Budget,
    NotApplicableError,
    Outcome,
    OverBudgetError,
    Peer,
    Run,
    RunFailedError,
    Runner,
    Setting,
    tolerance_sweep,
)
from benchmarks.work_precision.problems.base import Problem
from tests.support.stiff import differenced

LARGEST_STEPS = 10**7
Field = Callable[[float, Array], Array]


class ReducedImplicit(Peer):
    """Jacobians are differences."""

    implicit = True

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return tolerance_sweep()

    def everyday(self, problem: Problem) -> Setting:
        return Setting("rtol", 1e-8)

    @abstractmethod
    def solve(self, field: Field, start: Array, times: Array, tolerance: float) -> Array:
        """y (n, k) at ``times``.

        Raises
        ------
        RunFailedError
            If the integrator gives up.
        """

    def prepare(self, problem: Problem) -> Runner:
        model = problem.reduced
        if model is None:
            raise NotApplicableError("there is no reduced model")

        def at(setting: Setting) -> Run:
            def run() -> Outcome:
                budget = Budget()

                def field(t: float, y: Array) -> Array:
                    budget.tick()
                    return np.asarray(model.field(t, y))

                start = np.array(model.start)
                y = self.solve(field, start, problem.times, setting.value)
                return Outcome(budget.count, observed=lambda: problem.expand(y))

            return run

        return at


class ReducedRadau(ReducedImplicit):
    """Order 5."""

    name = "reduced_radau"
    title = "reduced ODE + SciPy Radau"
    modules = ("scipy",)

    def solve(self, field: Field, start: Array, times: Array, tolerance: float) -> Array:
        run = solve_ivp(
            field,
            (0.0, times[-1]),
            start,
            "Radau",
            times,
            rtol=tolerance,
            atol=tolerance,
            jac=differenced(field),
        )
        if not run.success:
            raise RunFailedError(run.message)
        return run.y.T


def _solved(solve: Callable[[], Any], count: int) -> Array:
    """y at the times after the first of ``count``."""
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            result = solve()
    except OverBudgetError:
        raise
    except Exception as error:  # the wrapper raises what the solver reports
        raise RunFailedError(f"{type(error).__name__}: {error}") from error
    if not result.success or len(result.y) != count:
        raise RunFailedError(str(result.message))
    return result.y[1:]


class ReducedCVODE(ReducedImplicit):
    """Backward differentiation, dense linear solver."""

    name = "reduced_cvode"
    title = "reduced ODE + SUNDIALS CVODE"
    modules = ("sksundae",)

    def solve(self, field: Field, start: Array, times: Array, tolerance: float) -> Array:
        from sksundae.cvode import CVODE

        def into(t: float, y: Array, out: Array) -> None:
            out[:] = field(t, y)

        solver = CVODE(
            into, method="BDF", rtol=tolerance, atol=tolerance, max_num_steps=LARGEST_STEPS
        )
        grid = np.concatenate([[0.0], times])
        return _solved(lambda: solver.solve(grid, start), len(grid))


class ReducedIDA(ReducedImplicit):
    """The same on y' - f = 0."""

    name = "reduced_ida"
    title = "reduced ODE + SUNDIALS IDA"
    modules = ("sksundae",)

    def solve(self, field: Field, start: Array, times: Array, tolerance: float) -> Array:
        from sksundae.ida import IDA

        def residual(t: float, y: Array, rate: Array, out: Array) -> None:
            out[:] = rate - field(t, y)

        solver = IDA(residual, rtol=tolerance, atol=tolerance, max_num_steps=LARGEST_STEPS)
        grid = np.concatenate([[0.0], times])
        return _solved(lambda: solver.solve(grid, start, field(0.0, start)), len(grid))
