r"""Passages of systems of first order checked after the fact: x' must not jump.

The rate x' of a DAE is continuous through an isolated singular point of G B; a step that leaves on
another branch of g = 0 ends with another one.  Such a step is redone with half its length.
"""

from __future__ import annotations

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.methods.base import StepResult
from srm_mbs.stepping.guard import BranchGuard, passes
from srm_mbs.stepping.stepsize import Proposal, StepSizeControl, Verdict
from srm_mbs.stepping.turning import jumped
from srm_mbs.systems.base import System


class RateGuard(BranchGuard):
    """:class:`~srm_mbs.stepping.guard.BranchGuard` for systems of first order.

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

    def judge(self, proposal: Proposal, result: StepResult | None) -> Verdict:
        """Redo a step whose rate jumped; otherwise the inner control's verdict.

        Raises
        ------
        EvaluationError
            Where a run that ``stops`` takes another branch.
        """
        verdict = super().judge(proposal, result)
        if self._stops and verdict is Verdict.ACCEPTED:
            self._refuse()
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
