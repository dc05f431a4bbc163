r"""Passages of systems of first order checked after the fact: x' must not jump.

The rate x' of a DAE is continuous through an isolated singular point of G B; a step that leaves on
another branch of g = 0 ends with another one.  Such a step is redone with half its length.
"""

from __future__ import annotations

from srm_mbs.arrays import FloatArray
from srm_mbs.methods.base import StepResult
from srm_mbs.stepping.guard import BranchGuard, passes
from srm_mbs.stepping.stepsize import Proposal, StepSizeControl, Verdict
from srm_mbs.stepping.turning import jumped
from srm_mbs.systems.base import System


class RateGuard(BranchGuard):
    """:class:`~srm_mbs.stepping.guard.BranchGuard` for systems of first order."""

    def __init__(self, inner: StepSizeControl, system: System) -> None:
        super().__init__(inner, system)
        self._slope: FloatArray | None = None

    def judge(self, proposal: Proposal, result: StepResult | None) -> Verdict:
        """Redo a step whose rate jumped; otherwise the inner control's verdict."""
        verdict = super().judge(proposal, result)
        if verdict is Verdict.ACCEPTED and result is not None:
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
