r"""Passages of systems of first order checked after the fact: x' must not jump.

The rate x' of a DAE is continuous through an isolated singular point of G B; a step that leaves on
another branch of g = 0 ends with another one.  Such a step is redone with half its length.

A run may also turn in many steps: its sweeps lie off the constraints by so much that, next to the
singular point, they cannot tell the branches.  x' is therefore compared as well across all steps
whose sweeps are off the constraints by a part of sigma.  What cannot be mended is kept, and
reported.
"""

from __future__ import annotations

from dataclasses import dataclass

from srm_mbs.arrays import FloatArray
from srm_mbs.methods.base import StepResult
from srm_mbs.methods.branch import AMBIGUOUS
from srm_mbs.stepping.guard import TURNED, BranchGuard, passes
from srm_mbs.stepping.stepsize import Proposal, StepSizeControl, Verdict
from srm_mbs.systems.base import System

LEFT = 10.0
"""A passage is over when sigma is this many times its smallest value again."""


@dataclass
class _Passage:
    """Steps next to a singular point: time and x' at the start, the same at the end, and the
    smallest sigma so far."""

    t: float
    rate: FloatArray
    end: float
    end_rate: FloatArray
    lowest: float


class RateGuard(BranchGuard):
    """:class:`~srm_mbs.stepping.guard.BranchGuard` for systems of first order."""

    def __init__(self, inner: StepSizeControl, system: System) -> None:
        super().__init__(inner, system)
        self._slope: FloatArray | None = None
        self._passage: _Passage | None = None

    def judge(self, proposal: Proposal, result: StepResult | None) -> Verdict:
        """Redo a step whose rate jumped; otherwise the inner control's verdict."""
        verdict = super().judge(proposal, result)
        if verdict is Verdict.ACCEPTED and result is not None:
            self._slope = (result.end_rate - result.rates[0]) / result.h
            self._watch(proposal.t_new, result)
        return verdict

    def suspect(self, result: StepResult) -> bool:
        """Whether x' jumped over a step next to a singular point, seen from its start and also from
        where it was heading."""
        if not passes(result):
            return False
        before, after = result.rates[0], result.end_rate
        heading = before if self._slope is None else before + result.h * self._slope
        return self._jumped(before, after) and self._jumped(heading, after)

    def _jumped(self, before: FloatArray, after: FloatArray) -> bool:
        jump, *sizes = (self._system.size(x) for x in (after - before, before, after))
        return jump > TURNED * max(sizes)

    def _watch(self, t_new: float, result: StepResult) -> None:
        """Follow a passage over steps that cannot tell the branches."""
        lowest = float(result.sigmas.min())
        ambiguous = result.off > AMBIGUOUS * lowest
        passage = self._passage
        if passage is None:
            if ambiguous:
                rate = result.rates[0].copy()
                self._passage = _Passage(result.t, rate, t_new, result.end_rate, lowest)
            return
        passage.end, passage.end_rate = t_new, result.end_rate
        passage.lowest = min(passage.lowest, lowest)
        if ambiguous or not result.sigmas[-1] > LEFT * passage.lowest:
            return
        self.suspects = self.told()
        self._passage = None

    def told(self) -> list[float]:
        """Times up to which the solution may have changed its branch, a passage that the run ends
        in included."""
        passage = self._passage
        if passage is None or any(passage.t < t for t in self.suspects):
            return self.suspects
        turned = self._jumped(passage.rate, passage.end_rate)
        return [*self.suspects, passage.end] if turned else self.suspects
