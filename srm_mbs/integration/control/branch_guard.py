r"""The branch guard: a motion must leave a singular configuration on the branch it arrived on.

Velocities are continuous through a singular configuration.  A step too long for its error estimate
may end on another branch; its velocity then differs from

    v_0 + h (a_0 + a_1) / 2

by a large part of itself, while on the same branch the difference is h^3 v''' / 12.  For systems of
first order it is the rate x' of the state that must not jump; it is continuous through an isolated
singular point of G B.  Such a step is redone with half its length; a step that is still suspect
after several halvings is kept, and reported.
"""

from __future__ import annotations

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.integration.control.step_size import (
    ControlWrapper,
    Proposal,
    StepDecision,
    StepSizeControl,
)
from srm_mbs.integration.methods.base import IntegratorState, StepResult

VELOCITY_JUMP = 0.3
"""Difference from the expected velocity, over the velocity, from which it is on another branch."""
MAX_REDONE = 8
"""Halvings of one suspect step."""


def velocity_jumps(system: System, before: FloatArray, after: FloatArray) -> bool:
    """Whether the velocity jumps between the tangent rates ``before`` and ``after`` (n,)."""
    jump, *sizes = (system.position_norm(rate) for rate in (after - before, before, after))
    return jump > VELOCITY_JUMP * max(sizes)


def may_cross(result: StepResult) -> bool:
    """Whether sigma changes by so much over a step that it may have passed zero."""
    sigmas: list[float] = result.sigmas.tolist()
    return 2.0 * min(sigmas) < max(sigmas)


class BranchGuard(ControlWrapper):
    """Wraps ``inner`` step-size control: a step that changes the branch is redone.

    For second-order systems; :class:`RateBranchGuard` is for those of first order.

    ``replaced`` counts the steps that were redone.

    Attributes
    ----------
    suspects
        Times (s) of the steps that were kept although the velocity jumped.
    """

    def __init__(self, inner: StepSizeControl, system: System) -> None:
        super().__init__(inner)
        self._system = system
        self.suspects: list[float] = []
        self._limit = np.inf
        self._tries = 0

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The inner proposal, halved after a step that has to be redone."""
        return self._inner.propose(t, min(limit, self._limit), memory)

    def moved(self, t: float) -> None:
        """See :class:`~srm_mbs.integration.control.step_size.StepSizeControl`."""
        super().moved(t)
        self._limit, self._tries = np.inf, 0

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Redo a step that changes the branch; otherwise the inner decision."""
        if result is not None and result.quiet and not self._tries:
            return self._inner.decide(proposal, result)
        suspect = result is not None and not result.quiet and self.changes_branch(result)
        if suspect and self._tries < MAX_REDONE:
            self._limit = 0.5 * proposal.h
            self._tries += 1
            self.replaced += 1
            return StepDecision.REPLACED
        decision = self._inner.decide(proposal, result)
        if decision is StepDecision.ACCEPTED and result is not None:
            if suspect:
                self.suspects.append(proposal.t_new)
            self._limit = np.inf
            self._tries = 0
        return decision

    def suspect_times(self) -> list[float]:
        """Times (s) up to which the motion may have changed its branch."""
        return sorted(self.suspects)

    def changes_branch(self, result: StepResult) -> bool:
        """Whether the velocity at the end of a step next to a singular configuration is that of
        another branch."""
        if not may_cross(result):
            return False
        system = self._system
        k = system.multiplier_part.start
        start, end = result.rates[0], result.end_rate
        halfway = 0.5 * result.h * (start[k:] + end[k:])
        zero = np.zeros(k)
        jump, *sizes = (
            system.position_norm(np.concatenate([v, zero]))
            for v in (end[:k] - start[:k] - halfway, start[:k], end[:k], halfway)
        )
        return jump > VELOCITY_JUMP * max(sizes)


class RateBranchGuard(BranchGuard):
    """:class:`BranchGuard` for systems of first order."""

    def __init__(self, inner: StepSizeControl, system: System) -> None:
        super().__init__(inner, system)
        self._slope: FloatArray | None = None

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Redo a step whose rate jumps; otherwise the inner decision."""
        decision = super().decide(proposal, result)
        if decision is StepDecision.ACCEPTED and result is not None:
            self._slope = (result.end_rate - result.rates[0]) / result.h
        return decision

    def changes_branch(self, result: StepResult) -> bool:
        """Whether x' jumps over a step next to a singular point, compared with its value at the
        start and with the one extrapolated from the step before."""
        if not may_cross(result):
            return False
        before, after = result.rates[0], result.end_rate
        extrapolated = before if self._slope is None else before + result.h * self._slope
        return velocity_jumps(self._system, before, after) and velocity_jumps(
            self._system, extrapolated, after
        )
