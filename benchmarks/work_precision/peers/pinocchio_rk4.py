"""Pinocchio's ``constraintDynamics`` under RK4 with fixed steps and Baumgarte gains."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from benchmarks.work_precision.peers.base import (
    Budget,
    Outcome,
    Peer,
    Run,
    Runner,
    Setting,
    gain_variants,
    middle_gain,
    step_sweep,
)
from benchmarks.work_precision.peers.explicit import rk4
from benchmarks.work_precision.peers.pinocchio_dynamics import PinocchioDynamics
from benchmarks.work_precision.problems.base import SAMPLES, Problem

EVERYDAY_SUBSTEPS = 100


class PinocchioRK4Baumgarte(Peer):
    """Each Baumgarte rate is a variant; none without closures."""

    name = "pinocchio_rk4_baumgarte"
    title = "Pinocchio + RK4 + Baumgarte"
    modules = ("pinocchio",)

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return step_sweep(problem, variants=gain_variants(problem) or [("", 0.0)])

    def everyday(self, problem: Problem) -> Setting:
        step = problem.t_end / SAMPLES / EVERYDAY_SUBSTEPS
        return Setting("step", step, *middle_gain(problem), EVERYDAY_SUBSTEPS)

    def prepare(self, problem: Problem) -> Runner:
        dynamics = cache(lambda gain: PinocchioDynamics(problem, gain))

        def at(setting: Setting) -> Run:
            chosen = dynamics(setting.gain)

            def run() -> Outcome:
                budget = Budget()
                field = chosen.field(budget)
                y = rk4(field, chosen.start, problem.times, setting.substeps)
                nq = chosen.nq
                return Outcome(budget.count, budget.count // 4, lambda: (y[:, :nq], y[:, nq:]))

            return run

        return at
