"""Radau IIA of scipy_dae on the stabilised index-2 equations, written with index 1."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

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


class ScipyDaeRadau(Peer):
    """Order 5."""

    name = "scipy_dae_radau"
    title = "scipy_dae Radau"
    modules = ("scipy_dae", "pinocchio")

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return tolerance_sweep()

    def everyday(self, problem: Problem) -> Setting:
        return Setting("rtol", 1e-8)

    def prepare(self, problem: Problem) -> Runner:
        from scipy_dae.integrate import solve_dae

        equations = Stabilised(problem)

        def at(setting: Setting) -> Run:
            def run() -> Outcome:
                budget = Budget()

                def residual(t: float, y: Array, rate: Array) -> Array:
                    budget.tick()
                    return equations.residual(t, y, rate)

                def jacobians(t: float, y: Array, rate: Array) -> tuple[Array, Array]:
                    budget.tick(equations.nq + equations.nv + 1)
                    return equations.jacobians(t, y, rate)

                try:
                    with np.errstate(all="ignore"), warnings.catch_warnings():
                        warnings.simplefilter("ignore")  # of singular matrices; it then fails
                        result = solve_dae(
                            residual,
                            (0.0, problem.t_end),
                            equations.start,
                            equations.start_rate,
                            method="Radau",
                            jac=jacobians,
                            t_eval=problem.times,
                            rtol=setting.value,
                            atol=setting.value,
                        )
                except OverBudgetError:
                    raise
                except Exception as error:  # singular matrices, states that are not finite
                    raise RunFailedError(f"{type(error).__name__}: {error}") from error
                if not result.success or result.y.shape[1] != len(problem.times):
                    raise RunFailedError(str(result.message))
                y = result.y.T
                return Outcome(budget.count, None, lambda: equations.states(y))

            return run

        return at
