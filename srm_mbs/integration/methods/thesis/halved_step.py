"""The thesis' placement of steps by halving, 2.4.1 (1)."""

from __future__ import annotations

from srm_mbs.integration.control.placement import TOO_CLOSE, SlopeOfSigma, sigma_slope
from srm_mbs.integration.control.step_size import Proposal, StepDecision, StepSizeControl
from srm_mbs.integration.methods.base import IntegratorState, StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau

DEPARTING = 0.15
"""Distance of the start of a step from the zero of sigma, as a fraction of its reach, below which
the step departs from it."""


class HalvedStep(SlopeOfSigma):
    """The thesis' rule 2.4.1 (1): a step h that ends on a singular point is not taken; instead
    h/2, and then h, so that the point lies in the middle of the second step.

    For tableaus with stages inside the step, which would lie on the point in their turn, it is
    h/4, and then h.  Only the end of a step is examined, after it was tried; the zone takes care of
    a stage that falls on a singular point.

    Parameters
    ----------
    inner, scheme
        The control that is wrapped; the tableau of the run.
    t_end
        End of the run (s): it cannot be avoided, even if it is singular.

    ``replaced`` counts the steps that were halved.
    """

    def __init__(self, inner: StepSizeControl, scheme: ButcherTableau, t_end: float) -> None:
        super().__init__(inner, scheme, t_end)
        inside = (scheme.c > 0.0) & (scheme.c < 1.0)
        self._fraction = 0.25 if inside.any() else 0.5
        # The steps that the rule still prescribes: (part, whole), then (whole,).
        self._plan: tuple[float, ...] = ()

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The step that the rule prescribes, else the inner proposal."""
        proposal = super().propose(t, limit, memory)
        if not self._plan:
            return proposal
        h = min(self._plan[0], limit)
        remaining = self._t_end - t
        # Less than the whole step may be left; a sliver must not be.
        if h > remaining * (1.0 - 1e-9):
            return Proposal(remaining, self._t_end)
        return Proposal.over(t, h)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Replace a step that ends on a singular point; otherwise the inner decision."""
        free = not self._plan and proposal.t_new < self._t_end
        if free and result is not None and self._ends_on_a_singular_point(proposal.h, result):
            self._plan = (self._fraction * proposal.h, proposal.h)
            self.replaced += 1
            return StepDecision.REPLACED
        decision = super().decide(proposal, result)
        self._plan = self._plan[1:] if decision is StepDecision.ACCEPTED else ()
        return decision

    def _ends_on_a_singular_point(self, h: float, result: StepResult) -> bool:
        sigmas = result.sigmas
        reach = h * max(self._slope, sigma_slope(self._inverse, sigmas, h))
        return bool(sigmas[-1] < TOO_CLOSE * reach and sigmas[0] > DEPARTING * reach)
