r"""Passages checked after the fact: the motion must leave a singular configuration the way it came.

Velocities are continuous through a passage.  A step too long for its error estimate may end on
another branch; its velocity then differs from

    v_0 + h (a_0 + a_1) / 2

by a large part of itself, while on the same branch the difference is h^3 v''' / 12.  Such a step is
redone with half its length; what does not help in the end is kept, and reported.

Turns of the motion over several steps that could not tell the branches.

Sweeps may lie off the constraints by so much that, next to a singular configuration, they cannot
tell its branches.  They then turn in many short steps, each of which looks smooth.  The velocity
(x' of a DAE) is compared across all steps whose sweeps are off the constraints by a part of sigma.

Passages of systems of first order checked after the fact: x' must not jump.

The rate x' of a DAE is continuous through an isolated singular point of G B; a step that leaves on
another branch of g = 0 ends with another one.  Such a step is redone with half its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.control.step_size import (
    Grid,
    Proposal,
    Propose,
    StepDecision,
    StepSizeControl,
)
from srm_mbs.integration.methods.base import IntegratorState, StepResult
from srm_mbs.integration.methods.near_singular import AMBIGUOUS

TURNED = 0.3
"""Part of the velocity by which it may differ from what is expected."""
LEFT = 10.0
"""A passage is over when sigma is this many times its smallest value again."""
PASSED = 0.1
"""Smallest sigma from which nothing singular was passed: sweeps in their initial layers are off the
closures, and velocities that change afterwards have not turned."""


def jumped(system: System, before: FloatArray, after: FloatArray) -> bool:
    """Whether the velocity in the tangent rate ``after`` (n,) is another one than ``before``."""
    jump, *sizes = (system.position_norm(rate) for rate in (after - before, before, after))
    return jump > TURNED * max(sizes)


@dataclass
class _Passage:
    """Steps next to a singular configuration: time and tangent rate at the start and at the end,
    and the smallest sigma so far."""

    t: float
    rate: FloatArray
    end: float
    end_rate: FloatArray
    lowest: float


class AmbiguousPassages:
    """Follows a run step by step."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._turned: list[tuple[float, float]] = []
        self._passage: _Passage | None = None

    def watch(self, t_new: float, result: StepResult) -> None:
        """Look at an accepted step to ``t_new``."""
        passage = self._passage
        if passage is None and result.off == 0.0:
            return
        lowest = float(result.sigmas.min())
        ambiguous = result.off > AMBIGUOUS * lowest
        if passage is None:
            if ambiguous:
                rate = result.rates[0].copy()
                self._passage = _Passage(result.t, rate, t_new, result.end_rate, lowest)
            return
        passage.end, passage.end_rate = t_new, result.end_rate
        passage.lowest = min(passage.lowest, lowest)
        if not ambiguous and result.sigmas[-1] > LEFT * passage.lowest:
            self._turned = self.turned()
            self._passage = None

    @property
    def under_way(self) -> bool:
        """Whether a passage has begun and is not over."""
        return self._passage is not None

    def turned(self) -> list[tuple[float, float]]:
        """Start and end (s) of the passages over which the velocity turned, one that the run ends
        in included."""
        passage = self._passage
        if passage is None or not passage.lowest < PASSED:
            return self._turned
        if not jumped(self._system, passage.rate, passage.end_rate):
            return self._turned
        return [*self._turned, (passage.t, passage.end)]


MAX_REDONE = 8


def passes(result: StepResult) -> bool:
    """Whether sigma changes by so much over a step that it may have passed zero."""
    sigmas: list[float] = result.sigmas.tolist()
    return 2.0 * min(sigmas) < max(sigmas)


def turned(system: System, result: StepResult) -> bool:
    """Whether the velocity of a step next to a singular configuration took another direction."""
    if not passes(result):
        return False
    k = system.multiplier_part.start
    start, end = result.rates[0], result.end_rate
    halfway = 0.5 * result.h * (start[k:] + end[k:])
    still = np.zeros(k)
    jump, *sizes = (
        system.position_norm(np.concatenate([v, still]))
        for v in (end[:k] - start[:k] - halfway, start[:k], end[:k], halfway)
    )
    return jump > TURNED * max(sizes)


class BranchGuard:
    """Wraps ``inner`` step-size control: a passage that changes the branch is redone.

    For second-order systems; :class:`~srm_mbs.integration.control.branch_guard.RateGuard` for those
    of first order.

    Attributes
    ----------
    placed, replaced
        0; how many steps were redone.
    suspects
        Times (s) of the steps that were kept although the velocity turned.
    propose
        The inner proposal, halved after a passage that has to be redone; almost always the inner
        control's own method, which saves a call per step.
    """

    propose: Propose

    placed = 0

    def __init__(self, inner: StepSizeControl, system: System) -> None:
        self._inner = inner
        self._system = system
        self.adaptive = inner.adaptive
        self.replaced = 0
        self.suspects: list[float] = []
        self._limit = np.inf
        self._tries = 0
        self._passages = AmbiguousPassages(system)
        self.propose = inner.propose

    def _shorter(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        return self._inner.propose(t, min(limit, self._limit), memory)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Redo a step whose velocity turned; otherwise the inner control's verdict."""
        if result is not None and result.quiet and not self._tries:
            return self._inner.decide(proposal, result)
        suspect = result is not None and not result.quiet and self.suspect(result)
        if suspect and self._tries < MAX_REDONE:
            self._limit = 0.5 * proposal.h
            self.propose = self._shorter
            self._tries += 1
            self.replaced += 1
            return StepDecision.REPLACED
        verdict = self._inner.decide(proposal, result)
        if verdict is StepDecision.ACCEPTED and result is not None:
            if not result.quiet:
                self._passages.watch(proposal.t_new, result)
            if suspect:
                self.suspects.append(proposal.t_new)
            self._limit = np.inf
            self.propose = self._inner.propose
            self._tries = 0
        return verdict

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`~srm_mbs.integration.control.step_size.StepSizeControl`."""
        self._inner.set_target_time(end, grid)

    def suspect_times(self) -> list[float]:
        """Times (s) up to which the motion may have changed its branch: the suspects, and the ends
        of longer passages (:mod:`srm_mbs.integration.control.branch_guard`) without any."""
        longer = [
            end
            for begin, end in self._passages.turned()
            if not any(begin < t <= end for t in self.suspects)
        ]
        return sorted([*self.suspects, *longer])

    def suspect(self, result: StepResult) -> bool:
        """Whether a step may have changed the branch."""
        return turned(self._system, result)


class RateGuard(BranchGuard):
    """:class:`~srm_mbs.integration.control.branch_guard.BranchGuard` for systems of first order.

    Parameters
    ----------
    inner, system
        As there.
    stops
        Whether a run ends before a step after which it is on another branch: sweeps.
    unbounded
        Whether they carry y, which is not bounded at the singular point.  No shorter step leads
        such sweeps over it: a sweep that is off the constraints by d, at a distance r, is driven
        away by B'(x) d y ~ d/r, so that d grows like a power of 1/r, while what brings it back,
        G B T/eps, vanishes.  Such a run ends as soon as x' is another one, not only when the
        passage is over.
    """

    def __init__(
        self,
        inner: StepSizeControl,
        system: System,
        stops: bool = False,
        unbounded: bool = False,
    ) -> None:
        super().__init__(inner, system)
        self._slope: FloatArray | None = None
        self._stops, self._unbounded = stops, unbounded

    def _refuse(self) -> None:
        if self._passages.under_way and not self._unbounded and not self.suspects:
            return
        if not (self.suspects or self._passages.turned()):
            return
        why = ", because they carry y, which is not bounded there" if self._unbounded else ""
        raise EvaluationError(
            "next to a singular point of G B x' turned, and no shorter step mended it: the sweeps "
            f"leave on another branch of g = 0{why}"
        )

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Redo a step whose rate jumped; otherwise the inner control's verdict.

        Raises
        ------
        EvaluationError
            Where a run that ``stops`` takes another branch.
        """
        verdict = super().decide(proposal, result)
        if self._stops and verdict is StepDecision.ACCEPTED:
            self._refuse()
        if verdict is StepDecision.ACCEPTED and result is not None:
            self._slope = (result.end_rate - result.rates[0]) / result.h
        return verdict

    def suspect(self, result: StepResult) -> bool:
        """Whether x' jumped over a step next to a singular point, seen from its start and also from
        where it was heading."""
        if not passes(result):
            return False
        before, after = result.rates[0], result.end_rate
        heading = before if self._slope is None else before + result.h * self._slope
        return jumped(self._system, before, after) and jumped(self._system, heading, after)
