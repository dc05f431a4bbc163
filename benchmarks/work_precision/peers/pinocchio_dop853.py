"""Pinocchio's ``constraintDynamics`` under SciPy's DOP853, with and without Baumgarte gains."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from benchmarks.work_precision.peers.base import (
    TOLERANCES,
    Budget,
    NotApplicableError,
    Outcome,
    Peer,
    Run,
    Runner,
    Setting,
    gain_variants,
    middle_gain,
    tolerance_sweep,
)
from benchmarks.work_precision.peers.explicit import dop853
from benchmarks.work_precision.peers.pinocchio_dynamics import PinocchioDynamics
from benchmarks.work_precision.problems.base import Problem


def _runner(problem: Problem) -> Runner:
    dynamics = cache(lambda gain: PinocchioDynamics(problem, gain))

    def at(setting: Setting) -> Run:
        chosen = dynamics(setting.gain)

        def run() -> Outcome:
            budget = Budget()
            y, steps = dop853(chosen.field(budget), chosen.start, problem.times, setting.value)
            nq = chosen.nq
            return Outcome(budget.count, steps, lambda: (y[:, :nq], y[:, nq:]))

        return run

    return at


class PinocchioDOP853(Peer):
    """Without stabilisation."""

    name = "pinocchio_dop853"
    title = "Pinocchio + SciPy DOP853"
    modules = ("pinocchio", "scipy")

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return tolerance_sweep()

    def everyday(self, problem: Problem) -> Setting:
        return Setting("rtol", 1e-8)

    def prepare(self, problem: Problem) -> Runner:
        return _runner(problem)


class PinocchioDOP853Baumgarte(Peer):
    """With Baumgarte gains; each rate is a variant."""

    name = "pinocchio_dop853_baumgarte"
    title = "Pinocchio + SciPy DOP853 + Baumgarte"
    modules = ("pinocchio", "scipy")

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return tolerance_sweep(TOLERANCES, gain_variants(problem))

    def everyday(self, problem: Problem) -> Setting:
        return Setting("rtol", 1e-8, *middle_gain(problem))

    def prepare(self, problem: Problem) -> Runner:
        if not problem.tree.closures:
            raise NotApplicableError("there is no closure to stabilise")
        return _runner(problem)
