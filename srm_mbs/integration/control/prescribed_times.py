"""Steps that avoid given times, and the choice of the placement of a run.

The user may know the times of singular configurations: :class:`AvoidTimes` keeps all stages and all
ends of steps away from them (thesis, 2.4.1 (2)).  With a fixed step it splits a step, and the run
returns to its grid.  :func:`placed` makes the step-size control of a run, for mechanisms and DAEs
alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.integration.control.placement import SingularityPlacement, SlopeOfSigma
from srm_mbs.integration.control.step_size import ControlWrapper, Proposal, StepSizeControl
from srm_mbs.integration.methods.base import IntegratorState
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.thesis.halved_step import HalvedStep

PLACEMENTS = ("automatic", "halved", "off")
"""How steps are placed around the singular configurations that sigma shows."""
STAGE_CLEARANCE = 0.05
"""Smallest distance of a stage from a given time, as a fraction of the step."""
CLEARANCE_AHEAD = 0.15
"""Smallest distance from the end of a step to a given time after it, as a fraction of the step;
the next step could pass a nearer one only by being very short."""


def _clear_places(scheme: ButcherTableau) -> tuple[FloatArray, list[float]]:
    """The abscissae of a ``scheme`` that are to be clear, and the centres of its wide gaps."""
    abscissae = np.unique(scheme.abscissae[scheme.abscissae > 0.0])
    return abscissae, [centre for centre, half in scheme.gaps if half > 1.5 * STAGE_CLEARANCE]


class AvoidTimes(ControlWrapper):
    """Wraps ``inner`` step-size control: no stage or end of a step lies on a given time.

    Where it would, the step is shortened: the given time comes to lie at the centre of a gap
    between abscissae, or so far ahead that an equal step would put it there.

    Parameters
    ----------
    inner
        The control that proposes steps and decides on them.
    scheme
        The tableau, for its abscissae.
    times : (k,) s
        Within the run.
    t_end
        End of the run (s).
    step
        The step (s) if it is fixed: a step may then reach over a grid point that is itself to be
        avoided.

    ``placed`` counts the steps that were shortened; none is redone.
    """

    def __init__(
        self,
        inner: StepSizeControl,
        scheme: ButcherTableau,
        times: FloatArray,
        t_end: float,
        step: float | None,
    ) -> None:
        super().__init__(inner, t_end)
        self._step = step
        self._times = np.sort(times)
        self._members = tuple(_clear_places(scheme.member(stiff)) for stiff in (False, True))
        self._abscissae, self._centres = self._members[False]

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The inner proposal, shortened where it would come too close to a given time."""
        self._abscissae, self._centres = self._members[memory.stiff]
        proposal = self._inner.propose(t, limit, memory)
        distances = self._times[self._times > t] - t
        if proposal.singular_arrival or not len(distances) or self._clear(proposal.h, distances):
            return proposal
        self.placed += 1
        longest = proposal.h
        if self._step is not None and self._end_blocked(longest, distances):
            longest = min(self._step, limit, self._t_end - t)
        h = self._longest_clear(longest, distances)
        return Proposal.over(t, h)

    def _clear(self, h: float, distances: FloatArray) -> bool:
        """Whether a step of length ``h`` stays clear of times at ``distances`` (s)."""
        if self._end_blocked(h, distances):
            return False
        gaps = np.abs(distances[:, None] / h - self._abscissae)
        return bool(np.all(gaps >= STAGE_CLEARANCE))

    def _end_blocked(self, h: float, distances: FloatArray) -> bool:
        theta = distances / h
        return bool(np.any((theta > 1.0 - STAGE_CLEARANCE) & (theta < 1.0 + CLEARANCE_AHEAD)))

    def _longest_clear(self, h: float, distances: FloatArray) -> float:
        """The longest clear step up to ``h`` that puts one of the times where it should be."""
        near = distances[distances < (1.0 + CLEARANCE_AHEAD) * h]
        positions = np.array([*self._centres, 1.0 + self._centres[0]])
        candidates = np.sort((near[:, None] / positions).ravel())[::-1]
        # One that stops well before the first time is always clear.
        return float(next(x for x in candidates if x <= h and self._clear(x, distances)))


def suspected(wrappers: Sequence[Any]) -> list[float]:
    """Times (s) up to which the motion may have changed its branch, by the branch guard among the
    ``wrappers``."""
    return [t for wrapper in wrappers for t in wrapper.suspect_times()]


def placed(
    control: StepSizeControl,
    scheme: ButcherTableau,
    placement: str | None,
    times: FloatArray,
    t_end: float,
    step: float | None = None,
    arrivals: bool = False,
    scatters: bool = False,
) -> tuple[StepSizeControl, tuple[ControlWrapper, ...]]:
    """``control`` with its steps placed, and the wrappers that do it.

    Parameters
    ----------
    control, scheme
        The control that is wrapped; the tableau of the run.
    placement
        One of :data:`PLACEMENTS`; None for a system without constraints, which has no sigma.
    times : (k,) s
        Times to be avoided, within the run; often none.
    t_end
        End of the run (s).
    step
        The step (s) if it is fixed.
    arrivals, scatters
        As for :class:`~srm_mbs.integration.control.placement.SingularityPlacement`.
    """
    wrappers: list[ControlWrapper] = []
    if placement == "automatic":
        wrappers.append(SingularityPlacement(control, scheme, t_end, arrivals, scatters))
    elif placement == "halved":
        wrappers.append(HalvedStep(control, scheme, t_end))
    elif placement == "off":
        wrappers.append(SlopeOfSigma(control, scheme))
    if len(times):
        # Outermost: nothing may change a step that was made to avoid these times.
        inner = wrappers[-1] if wrappers else control
        wrappers.append(AvoidTimes(inner, scheme, times, t_end, step))
    return (wrappers[-1] if wrappers else control), tuple(wrappers)
