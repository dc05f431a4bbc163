"""SUNDIALS IDA (scikit-sundae) on the stabilised index-2 equations (Gear, Gupta, Leimkuhler)."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

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


@contextmanager
def _silent() -> Iterator[None]:
    """Without what SUNDIALS prints on the process' standard error; its messages are raised too."""
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


class SundialsIDA(Peer):
    """Dense linear solver, IDA's own difference quotients for the Jacobian."""

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

                solver = IDA(
                    residual,
                    rtol=setting.value,
                    atol=setting.value,
                    max_num_steps=LARGEST_STEPS,
                )
                try:
                    with _silent():
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
