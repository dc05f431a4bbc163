"""The floor: the equation reduced by hand to one degree of freedom, under SciPy's DOP853."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.work_precision.peers.base import (
    Array,
    Budget,
    NotApplicableError,
    Outcome,
    Peer,
    Run,
    Runner,
    Setting,
    tolerance_sweep,
)
from benchmarks.work_precision.peers.explicit import dop853
from benchmarks.work_precision.problems.base import Problem


class ReducedODE(Peer):
    """No simulator does this by itself: not counted among the peers in the ratios."""

    name = "reduced"
    title = "hand-reduced ODE + SciPy DOP853"
    modules = ("scipy",)

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return tolerance_sweep()

    def everyday(self, problem: Problem) -> Setting:
        return Setting("rtol", 1e-8)

    def prepare(self, problem: Problem) -> Runner:
        model = problem.reduced
        if model is None:
            raise NotApplicableError("there is no reduced model of one degree of freedom")

        def at(setting: Setting) -> Run:
            def run() -> Outcome:
                budget = Budget()

                def field(t: float, y: Array) -> Array:
                    budget.tick()
                    return model.field(t, y)

                y, steps = dop853(field, np.array(model.start), problem.times, setting.value)
                return Outcome(budget.count, steps, observed=lambda: problem.expand(y))

            return run

        return at
