"""SUNDIALS IDA (scikit-sundae) on the stabilised index-2 equations (Gear, Gupta, Leimkuhler)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout

import numpy as np

from benchmarks.work_precision.peers.base import (
    Array,
    Budget,
    Outcome,
    OverBudgetError,
    Peer,
    Run,
    RunFailedError,
    Runner,
    Setting,
    tolerance_sweep,
)
from benchmarks.work_precision.peers.gear_gupta_leimkuhler import Stabilised
from benchmarks.work_precision.problems.base import Problem

LARGEST_STEPS = 10**7


class SundialsIDA(Peer):
    """Dense linear solver."""

    name = "sundials_ida"
    title = "SUNDIALS IDA (GGL)"
    modules = ("sksundae", "pinocchio")

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return tolerance_sweep()

    def everyday(self, problem: Problem) -> Setting:
        return Setting("rtol", 1e-8)

    def prepare(self, problem: Problem) -> Runner:
        from sksundae.ida import IDA

        equations = Stabilised(problem)
        times = np.concatenate([[0.0], problem.times])

        def at(setting: Setting) -> Run:
            def run() -> Outcome:
                budget = Budget()

                def residual(t: float, y: Array, rate: Array, out: Array) -> None:
                    budget.tick()
                    out[:] = equations.residual(t, y, rate)

                def jacobian(
                    t: float, y: Array, rate: Array, res: Array, factor: float, out: Array
                ) -> None:
                    by_state, by_rate = equations.jacobians(t, y, rate)
                    budget.tick(equations.nq + equations.nv + 1)
                    out[:] = by_state + factor * by_rate

                solver = IDA(
                    residual,
                    jacfn=jacobian,
                    rtol=setting.value,
                    atol=setting.value,
                    max_num_steps=LARGEST_STEPS,
                )
                try:
                    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                        result = solver.solve(times, equations.start, equations.start_rate)
                except OverBudgetError:
                    raise
                except Exception as error:  # the wrapper raises what the solver reports
                    raise RunFailedError(f"{type(error).__name__}: {error}") from error
                if not result.success or len(result.y) != len(times):
                    raise RunFailedError(str(result.message))
                y = result.y[1:]
                return Outcome(budget.count, None, lambda: equations.states(y))

            return run

        return at
