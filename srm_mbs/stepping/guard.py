r"""Passages checked after the fact: the motion must leave a singular configuration the way it came.

Velocities are continuous through a passage.  A step too long for its error estimate may end on
another branch; its velocity then differs from

    v_0 + h (a_0 + a_1) / 2

by a large part of itself, while on the same branch the difference is h^3 v''' / 12.  Such a step is
redone with half its length; what does not help in the end is kept, and reported.
"""

from __future__ import annotations

import numpy as np

from srm_mbs.methods.base import Memory, StepResult
from srm_mbs.stepping.stepsize import Grid, Proposal, Propose, StepSizeControl, Verdict
from srm_mbs.stepping.turning import TURNED, AmbiguousPassages
from srm_mbs.systems.base import System

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
        system.size(np.concatenate([v, still]))
        for v in (end[:k] - start[:k] - halfway, start[:k], end[:k], halfway)
    )
    return jump > TURNED * max(sizes)


class BranchGuard:
    """Wraps ``inner`` step-size control: a passage that changes the branch is redone.

    For second-order systems; :class:`~srm_mbs.stepping.rate_guard.RateGuard` for those of first
    order.

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

    def _shorter(self, t: float, limit: float, memory: Memory) -> Proposal:
        return self._inner.propose(t, min(limit, self._limit), memory)

    def judge(self, proposal: Proposal, result: StepResult | None) -> Verdict:
        """Redo a step whose velocity turned; otherwise the inner control's verdict."""
        if result is not None and result.quiet and not self._tries:
            return self._inner.judge(proposal, result)
        suspect = result is not None and not result.quiet and self.suspect(result)
        if suspect and self._tries < MAX_REDONE:
            self._limit = 0.5 * proposal.h
            self.propose = self._shorter
            self._tries += 1
            self.replaced += 1
            return Verdict.REPLACED
        verdict = self._inner.judge(proposal, result)
        if verdict is Verdict.ACCEPTED and result is not None:
            if not result.quiet:
                self._passages.watch(proposal.t_new, result)
            if suspect:
                self.suspects.append(proposal.t_new)
            self._limit = np.inf
            self.propose = self._inner.propose
            self._tries = 0
        return verdict

    def aim(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`~srm_mbs.stepping.stepsize.StepSizeControl`."""
        self._inner.aim(end, grid)

    def told(self) -> list[float]:
        """Times (s) up to which the motion may have changed its branch: the suspects, and the ends
        of longer passages (:mod:`srm_mbs.stepping.turning`) without any."""
        longer = [
            end
            for begin, end in self._passages.turned()
            if not any(begin < t <= end for t in self.suspects)
        ]
        return sorted([*self.suspects, *longer])

    def suspect(self, result: StepResult) -> bool:
        """Whether a step may have changed the branch."""
        return turned(self._system, result)
