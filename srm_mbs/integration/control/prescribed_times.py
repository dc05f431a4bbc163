r"""Singular configurations that the user knows, and the thesis' own ways around them.

Further wrappers of step-size control, beside the automatic
:class:`~srm_mbs.integration.control.placement.SingularityPlacement`:

* :class:`AvoidTimes`: no stage and no end of a step lies on a given time (thesis, 2.4.1 (2));
* :class:`HalvedStep`: a step that would end on a singular point is replaced by a part of it and
  one whole step over the point (thesis, 2.4.1 (1));
* :class:`SlopeOfSigma`: neither, only the slope of sigma that the zone needs.

With a fixed step all of them split a step, and the run returns to its grid.  :func:`placed` puts
together what a user chose, for mechanisms and DAEs alike.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.integration.control.branch_guard import BranchGuard
from srm_mbs.integration.control.placement import (
    TOO_CLOSE,
    SingularityPlacement,
    inverse_abscissae,
    sigma_slope,
)
from srm_mbs.integration.control.step_size import Grid, Proposal, StepDecision, StepSizeControl
from srm_mbs.integration.methods.base import IntegratorState, StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau

PLACEMENTS = ("automatic", "halved", "off")
"""What is done around singular configurations that sigma shows."""
CLEARANCE = 0.05
"""Smallest distance of a stage from a given time, as a fraction of the step."""
FAR_ENOUGH = 0.15
"""A step that starts nearer to the zero than this fraction of its reach is leaving it."""
AHEAD = 0.15
"""Smallest distance from the end of a step to a given time after it, as a fraction of the step;
the next step could pass a nearer one only by being very short."""


class AvoidTimes:
    """Wraps ``inner`` step-size control: no stage or end of a step lies on a given time.

    Where it would, the step is shortened: the given time comes to lie at the centre of a gap
    between abscissae, or so far ahead that an equal step would put it there.

    Parameters
    ----------
    inner
        The control that proposes and judges the steps.
    scheme
        The tableau, for its abscissae.
    times : (k,) s
        Within the run.
    t_end
        End of the run (s).
    step
        The step (s) if it is fixed: a step may then reach over a grid point that is itself to be
        avoided.

    Attributes
    ----------
    placed, replaced
        How many steps were shortened in advance; 0, none is redone.
    """

    replaced = 0

    def __init__(
        self,
        inner: StepSizeControl,
        scheme: ButcherTableau,
        times: FloatArray,
        t_end: float,
        step: float | None = None,
    ) -> None:
        self._inner = inner
        self._t_end, self._step = t_end, step
        self._times = np.sort(times)
        self._abscissae = np.unique(np.append(scheme.c[scheme.c > 0.0], 1.0))
        self._centres = [centre for centre, half in scheme.gaps if half > 1.5 * CLEARANCE]
        self.adaptive = inner.adaptive
        self.placed = 0

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The inner proposal, shortened where it would come too close to a given time."""
        proposal = self._inner.propose(t, limit, memory)
        distances = self._times[self._times > t] - t
        if not len(distances) or self._clear(proposal.h, distances):
            return proposal
        if proposal.arriving:
            return proposal
        self.placed += 1
        longest = proposal.h
        if self._step is not None and self._end_blocked(longest, distances):
            longest = min(self._step, limit, self._t_end - t)
        h = self._longest_clear(longest, distances)
        return Proposal(h, t + h)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """The inner control's verdict."""
        return self._inner.decide(proposal, result)

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`~srm_mbs.integration.control.step_size.StepSizeControl`."""
        self._t_end = end
        self._inner.set_target_time(end, grid)

    def _clear(self, h: float, distances: FloatArray) -> bool:
        """Whether a step of length ``h`` stays clear of times at ``distances`` (s)."""
        if self._end_blocked(h, distances):
            return False
        gaps = np.abs(distances[:, None] / h - self._abscissae)
        return bool(np.all(gaps >= CLEARANCE))

    def _end_blocked(self, h: float, distances: FloatArray) -> bool:
        theta = distances / h
        return bool(np.any((theta > 1.0 - CLEARANCE) & (theta < 1.0 + AHEAD)))

    def _longest_clear(self, h: float, distances: FloatArray) -> float:
        """The longest clear step up to ``h`` that puts one of the times where it should be."""
        near = distances[distances < (1.0 + AHEAD) * h]
        positions = np.array([*self._centres, 1.0 + self._centres[0]])
        candidates = np.sort((near[:, None] / positions).ravel())[::-1]
        # One that stops well before the first time is always clear.
        return float(next(x for x in candidates if x <= h and self._clear(x, distances)))


class SlopeOfSigma:
    """Wraps ``inner`` step-size control without placing steps.

    It measures how fast sigma changes, by which the zone is widened for fast passages.

    Attributes
    ----------
    placed, replaced
        0.
    """

    def __init__(self, inner: StepSizeControl, scheme: ButcherTableau) -> None:
        self._inner = inner
        self._inverse = inverse_abscissae(scheme)
        self._slope = 0.0
        self.adaptive = inner.adaptive
        self.placed = 0
        self.replaced = 0

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The inner proposal."""
        memory.sigma_slope = self._slope
        return self._inner.propose(t, limit, memory)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """The inner control's verdict."""
        verdict = self._inner.decide(proposal, result)
        if verdict is StepDecision.ACCEPTED and result is not None:
            slope = sigma_slope(self._inverse, result.sigmas, proposal.h)
            self._slope = max(slope, 0.5 * self._slope)
        return verdict

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`~srm_mbs.integration.control.step_size.StepSizeControl`."""
        self._inner.set_target_time(end, grid)


class HalvedStep(SlopeOfSigma):
    """The thesis' rule 2.4.1 (1): a step h that ends on a singular point is not taken; instead
    h/2, and then h, so that the point lies in the middle of the second step.

    For tableaus with stages inside the step, which would lie on the point in their turn, it is
    h/4, and then h.  Only the end of a step is looked at, after it was tried; a stage that falls
    on a singular point is left to the zone.

    Parameters
    ----------
    inner, scheme
        As above.
    t_end
        End of the run (s): it cannot be avoided, even if it is singular.

    Attributes
    ----------
    placed, replaced
        0; how many steps were replaced.
    """

    def __init__(self, inner: StepSizeControl, scheme: ButcherTableau, t_end: float) -> None:
        super().__init__(inner, scheme)
        self._t_end = t_end
        inside = (scheme.c > 0.0) & (scheme.c < 1.0)
        self._fraction = 0.25 if inside.any() else 0.5
        # What is left of the rule: (part, whole), then (whole,).
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
        return Proposal(h, t + h)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Replace a step that ends on a singular point; otherwise the inner verdict."""
        free = not self._plan and proposal.t_new < self._t_end
        if free and result is not None and self._ends_on_a_singular_point(proposal.h, result):
            self._plan = (self._fraction * proposal.h, proposal.h)
            self.replaced += 1
            return StepDecision.REPLACED
        verdict = super().decide(proposal, result)
        self._plan = self._plan[1:] if verdict is StepDecision.ACCEPTED else ()
        return verdict

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`~srm_mbs.integration.control.step_size.StepSizeControl`."""
        self._t_end = end
        super().set_target_time(end, grid)

    def _ends_on_a_singular_point(self, h: float, result: StepResult) -> bool:
        sigmas = result.sigmas
        reach = h * max(self._slope, sigma_slope(self._inverse, sigmas, h))
        return bool(sigmas[-1] < TOO_CLOSE * reach and sigmas[0] > FAR_ENOUGH * reach)


Placing = SingularityPlacement | SlopeOfSigma | AvoidTimes | BranchGuard
"""A control that counts, in ``placed`` and ``replaced``, what it did."""


def suspected(wrappers: Sequence[Placing]) -> list[float]:
    """Times (s) up to which the motion may have changed its branch, by the guard among them."""
    return [
        t
        for wrapper in wrappers
        if isinstance(wrapper, BranchGuard)
        for t in wrapper.suspect_times()
    ]


def placed(
    control: StepSizeControl,
    scheme: ButcherTableau,
    placement: str | None,
    times: FloatArray,
    t_end: float,
    step: float | None = None,
    arrivals: bool = False,
) -> tuple[StepSizeControl, tuple[Placing, ...]]:
    """``control`` with its steps placed, and the wrappers that do it.

    Parameters
    ----------
    control, scheme
        What is wrapped; the tableau of the run.
    placement
        One of :data:`PLACEMENTS`; None for a system without constraints, which has no sigma.
    times : (k,) s
        Times to be avoided, within the run; often none.
    t_end
        End of the run (s).
    step
        The step (s) if it is fixed.
    arrivals
        As for :class:`~srm_mbs.integration.control.placement.SingularityPlacement`.
    """
    wrappers: list[Placing] = []
    if placement == "automatic":
        wrappers.append(SingularityPlacement(control, scheme, t_end, arrivals))
    elif placement == "halved":
        wrappers.append(HalvedStep(control, scheme, t_end))
    elif placement == "off":
        wrappers.append(SlopeOfSigma(control, scheme))
    if len(times):
        # Outermost: nothing may change a step that was made to avoid these times.
        inner = wrappers[-1] if wrappers else control
        wrappers.append(AvoidTimes(inner, scheme, times, t_end, step))
    return (wrappers[-1] if wrappers else control), tuple(wrappers)
