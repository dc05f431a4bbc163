"""Pinocchio's ``constraintDynamics`` under RK4 with a projection after every step."""

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
    RunFailedError,
    Runner,
    Setting,
    step_sweep,
)
from benchmarks.work_precision.peers.explicit import rk4
from benchmarks.work_precision.peers.pinocchio_dynamics import PinocchioDynamics
from benchmarks.work_precision.peers.pinocchio_rk4 import EVERYDAY_SUBSTEPS
from benchmarks.work_precision.problems.base import SAMPLES, Problem

CLOSED = 1e-13
"""Closure error (m) at which Newton's iteration ends."""


class PinocchioRK4Projected(Peer):
    """Positions onto the closures by Newton, velocities onto their rates, least M-norm."""

    name = "pinocchio_rk4_projected"
    title = "Pinocchio + RK4 + projection"
    modules = ("pinocchio",)

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return step_sweep(problem)

    def everyday(self, problem: Problem) -> Setting:
        step = problem.t_end / SAMPLES / EVERYDAY_SUBSTEPS
        return Setting("step", step, substeps=EVERYDAY_SUBSTEPS)

    def prepare(self, problem: Problem) -> Runner:
        if not problem.tree.closures:
            raise NotApplicableError("there is no closure to project on")
        dynamics = PinocchioDynamics(problem)
        equations, nq = dynamics.equations, dynamics.nq

        def project(y: Array) -> Array:
            q, v = equations.normalised(y[:nq]), y[nq:]
            try:
                return np.concatenate(equations.projected(q, v, enough=CLOSED))
            except np.linalg.LinAlgError as error:
                raise RunFailedError(f"the projection failed: {error}") from error

        def at(setting: Setting) -> Run:
            def run() -> Outcome:
                budget = Budget()
                field = dynamics.field(budget)
                y = rk4(field, dynamics.start, problem.times, setting.substeps, project)
                return Outcome(budget.count, budget.count // 4, lambda: (y[:, :nq], y[:, nq:]))

            return run

        return at
