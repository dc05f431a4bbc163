r"""Steps placed so that no stage lies on a singular configuration.

:class:`SingularityPlacement` wraps step-size control (docs/notation.md, "Singular configurations"):

* a priori, when sigma falls, its zero is predicted by a parabola through the stages of the last
  step, and the step is shortened so that the zero lies well inside a gap between the abscissae of
  the tableau, or well after the end;
* sigma changes by at most 0.5 per step;
* a posteriori, when a stage came too close, the zero is located from the stages of the step and
  the step is redone, at most three times;
* where the motion turns back next to a singular configuration, or is slow there, steps are not
  placed: stages may lie anywhere (:mod:`srm_mbs.integration.methods.branch_nodes`);
* where the run, or its smooth interval, ends beside a singular configuration, they are not placed
  either; where there are no nodes of the branch, the multipliers up to the end are found first
  (:mod:`srm_mbs.integration.singular_endpoints`).

sigma is the modulus of a smooth quantity: at a passage it has a kink.  With the sign changed after
its zero, the values at the stages of a step follow a polynomial of low degree, from which the zero
is found.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import IntEnum

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.integration.control.step_size import (
    ControlWrapper,
    Grid,
    Proposal,
    StepDecision,
    StepSizeControl,
)
from srm_mbs.integration.methods.base import IntegratorState, StepResult
from srm_mbs.integration.methods.branch_nodes import BRANCH_SIGMA
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.near_singular import WATCHED_SIGMA

PREDICTION_STEPS = 3.0
"""Steps within which zeros of sigma are predicted."""
EXPECTED_STEPS = 1.5
"""Steps within which a zero of sigma is examined before it is passed."""
EXPECTED_SIGMA = 0.6
"""sigma below which it is examined wherever it lies."""
SIGMA_CHANGE = 0.5
"""Largest change of sigma in one step, by the slope of the last steps."""
SCATTER_FROM = 0.25
"""Abscissa from which on changes of sigma count where its pivots follow the graph of the loops:
sigma jumps there by up to a half when other pivots are taken, and a jump is no slope that an early
stage would have found.  Of a motion through a zero the later stages still find half the slope."""
TOO_CLOSE = 0.05
"""A stage is too close if sigma < TOO_CLOSE * slope * h, and nearer to zero than the start."""
CLEARANCE = 0.6
"""Distance of the zero from the abscissae that is large enough, over half the widest gap."""
MAX_REDONE = 3
"""Times that one step is redone because a stage came too close."""
SINGULAR_END_SIGMA = 5e-3
"""A run, or its smooth interval, ends beside a singular configuration if sigma is smaller there:
rounding in direct solves at smaller sigma exceeds the tightest tolerances."""
TURNING_SIGMA = 0.02
"""Extreme value of sigma up to which a motion turns back next to a singular configuration, before
or behind it."""
TURNING_MISFIT = 0.01
"""Largest misfit of the parabola that tells so, over the change of sigma: where several loops pass
singular configurations one after the other, sigma is no parabola."""
SLOW_SIGMA_CHANGE = 5e-4
"""Change of sigma per step of a slow motion."""
ARRIVAL_SIGMA_CHANGE = 0.2
"""Change of sigma up to such an end from where it is prepared for, unless one step reaches
further."""


def real_roots(p0: float, p1: float, p2: float = 0.0) -> list[float]:
    """Real roots of p0 + p1 x + p2 x^2, ascending."""
    if p2 == 0.0:
        return [-p0 / p1] if p1 else []
    discriminant = p1 * p1 - 4.0 * p2 * p0
    if discriminant < 0.0:
        return []
    # Of the two forms of a root, the one that does not cancel.
    q = -0.5 * (p1 + math.copysign(math.sqrt(discriminant), p1))
    return sorted([q / p2, p0 / q]) if q else [0.0]


def zero_within(abscissae: FloatArray, sigmas: FloatArray) -> float | None:
    """Where in (0, 1 + a little] the step passes a zero of sigma; None if it does not.

    Parameters
    ----------
    abscissae, sigmas : (s + 1,)
        Fractions of the step, and sigma there.
    """
    order = np.argsort(abscissae, kind="stable")
    c, sigma = abscissae[order], sigmas[order]
    top = float(sigma.max())
    if not top > 0.0:
        return None
    degree = 2 if len(c) > 4 else 1
    basis = np.vander(c, degree + 1)
    # Column k has the sign of sigma changed behind the first k + 1 abscissae.
    signed = sigma[:, None] * np.where(np.tri(len(c)).T > 0.0, 1.0, -1.0)
    fits = np.linalg.lstsq(basis, signed, rcond=None)[0]
    misfits = np.linalg.norm(basis @ fits - signed, axis=0)
    ends = [*c.tolist(), 1.1]
    for k in np.argsort(misfits, kind="stable").tolist():
        before, after = ends[k], ends[k + 1]
        if after > before:
            for root in real_roots(*fits[::-1, k].tolist()):
                if before - 0.02 <= root <= after + 0.02:
                    return root
    return None


def parabola(c: float, start: float, middle: float, end: float) -> tuple[float, float]:
    """a and b of sigma = start + a x + b x^2 through (c, middle) and (1, end); of the line through
    (1, end) if c is next to an end of the step."""
    b = ((middle - start) / c - (end - start)) / (c - 1.0) if 0.1 < c < 0.9 else 0.0
    return end - start - b, b


def error_of_parabola(
    abscissae: FloatArray, middle: int, sigmas: FloatArray, ahead: float
) -> float:
    """Error of a step's :func:`parabola` at ``ahead`` steps from its start, if its largest misfit
    at the stages is that of a cubic term.

    Parameters
    ----------
    abscissae, sigmas : (s + 1,)
        Fractions of the step, and sigma there.
    """
    c, start, end = float(abscissae[middle]), float(sigmas[0]), float(sigmas[-1])
    a, b = parabola(c, start, float(sigmas[middle]), end)
    misfit = float(np.abs(start + abscissae * (a + abscissae * b) - sigmas).max())
    cubic = float(np.abs(abscissae * (abscissae - c) * (abscissae - 1.0)).max())
    return misfit * abs(ahead * (ahead - c) * (ahead - 1.0)) / cubic if cubic > 0.0 else misfit


def zero_ahead(k: int, c: float, sigmas: FloatArray) -> float | None:
    """Where sigma will vanish, in steps from the start of the last one (> 1); None if it does not
    fall, or not within ``PREDICTION_STEPS`` steps.

    A parabola through the start, the stage ``k`` with the abscissa ``c``, and the end; a line if
    that has no zero ahead.
    """
    start, end = float(sigmas[0]), float(sigmas[-1])
    if not end < start:
        return None
    line = start / (start - end)
    zero = line
    a, b = parabola(c, start, float(sigmas[k]), end)
    root = a * a - 4.0 * b * start
    if root >= 0.0 and a < 0.0:
        zero = 2.0 * start / (-a + np.sqrt(root))
    elif a + 2.0 * b >= 0.0 or root < 0.0:
        return None if line > PREDICTION_STEPS else line
    if zero <= 1.0:
        zero = line
    return float(zero) if 1.0 < zero < PREDICTION_STEPS else None


def expected_zero(sigmas: FloatArray, ahead: float | None) -> float | None:
    """Where sigma is expected to vanish, in steps from the start of the last one: at the zero
    ``ahead`` if the next step may reach it, or, where sigma is small and falls, on a line.

    Next to an avoided singular configuration steps stay a fraction of their distance to it, and no
    zero is ever within their reach.
    """
    if ahead is not None and ahead < 1.0 + EXPECTED_STEPS:
        return ahead
    start, end = float(sigmas[0]), float(sigmas[-1])
    if not (end < start and end < EXPECTED_SIGMA):
        return None
    return start / (start - end)


def extreme_sigma(abscissae: FloatArray, middle: int, sigmas: FloatArray) -> float:
    """The extreme value of the parabola through sigma at the start, the stage ``middle`` and the
    end of a step, with its sign changed where the step passes a zero; infinite without one, or if
    sigma at the other stages does not follow it.

    Parameters
    ----------
    abscissae, sigmas : (s + 1,)
        Fractions of the step, and sigma there.
    """
    c = float(abscissae[middle])
    if not 0.1 < c < 0.9:
        return np.inf
    start = float(sigmas[0])
    best, extreme = np.inf, np.inf
    for sign, last_sign in ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)):
        a, b = parabola(c, start, sign * float(sigmas[middle]), last_sign * float(sigmas[-1]))
        off = np.abs(start + abscissae * (a + abscissae * b)) - sigmas
        misfit = float(off @ off)
        if misfit < best:
            best, extreme = misfit, np.inf if b == 0.0 else start - a * a / (4.0 * b)
    change = float(sigmas.max() - sigmas.min())
    return extreme if np.sqrt(best / len(sigmas)) <= TURNING_MISFIT * change else np.inf


class Arrival(IntEnum):
    """Whether the run, or its smooth interval, ends beside a singular configuration."""

    NONE = 0
    """It does not matter, or has been prepared for."""
    WATCHED = 1
    """It may."""
    DUE = 2
    """It does: stages next to it are solved by nodes of the branch."""


def inverse_abscissae(scheme: ButcherTableau, scatters: bool = False) -> list[float]:
    """1/c of the stages and the end (s + 1,) by which sigma has a slope, for one that ``scatters``
    from :data:`SCATTER_FROM` on; 0 of the others."""
    least = SCATTER_FROM if scatters else 0.0
    return [1.0 / c if c > 0.0 and c >= least else 0.0 for c in scheme.abscissae.tolist()]


def sigma_slope(inverse: list[float], sigmas: FloatArray, h: float) -> float:
    """max_j |sigma_j - sigma_0| / (c_j h) over the stages (1/s); ``inverse`` has their 1/c_j."""
    # Lists: NumPy's overhead on a dozen numbers is several times the work, in every step.
    values: list[float] = sigmas.tolist()
    start = values[0]
    return max([abs(sigma - start) * x for sigma, x in zip(values, inverse)]) / h


class Gaps:
    """Where, as a fraction of the step, a zero of sigma does no harm."""

    def __init__(self, scheme: ButcherTableau) -> None:
        self._centre, half_width = scheme.gaps[0]
        self._clearance = CLEARANCE * half_width
        self._first = min((x for x in scheme.c.tolist() if x > 0.0), default=1.0)
        self._wide = sorted(
            (middle, middle + half - self._clearance)
            for middle, half in scheme.gaps
            if half > self._clearance
        )

    def longest_step(self, distance: float, h: float) -> float:
        """The longest step up to ``h`` (s) for a zero of sigma at ``distance`` (s) ahead.

        The zero comes to lie in a wide gap between the abscissae, or so far after the end that
        an equal step would put it there.
        """
        position = distance / h
        if position >= 1.0 + self._centre:
            return h
        if position <= 0.5 * self._first:
            return h  # the first stage is no nearer to the zero than the start
        for centre, end in self._wide:
            if position <= end:
                return distance / max(position, centre)
        return distance / (1.0 + self._centre)

    def ends_on(self, distance: float, h: float) -> bool:
        """Whether a step ``h`` ends on a zero at ``distance``."""
        return abs(distance / h - 1.0) < self._clearance

    def step_over(self, distance: float) -> float:
        """The shortest step that has a zero at ``distance`` well inside one of its gaps."""
        return distance / self._wide[-1][1]


class StagePlaces:
    """Where the stages of a ``scheme`` lie in a step."""

    def __init__(self, scheme: ButcherTableau, scatters: bool) -> None:
        self.gaps = Gaps(scheme)
        self.abscissae = scheme.abscissae
        self.inverse = inverse_abscissae(scheme, scatters)
        self.later_stages = np.flatnonzero(self.abscissae > 0.0).tolist()
        self.inner_stages = [j for j in self.later_stages if self.abscissae[j] < 1.0]
        self.middle = scheme.middle


class SingularityPlacement(ControlWrapper):
    """Wraps ``inner`` step-size control around singular configurations.

    Parameters
    ----------
    inner, scheme
        The control that is wrapped; the tableau of the run.
    t_end
        End of the run (s).
    arrivals
        Whether the driver prepares for ends beside singular configurations.
    scatters
        Whether sigma jumps with its pivots: ``sigma_scatters`` of
        :class:`~srm_mbs.dynamics.system.System`.

    ``placed`` counts the steps changed a priori, ``replaced`` those redone a posteriori.
    """

    def __init__(
        self,
        inner: StepSizeControl,
        scheme: ButcherTableau,
        t_end: float = np.inf,
        arrivals: bool = False,
        scatters: bool = False,
    ) -> None:
        super().__init__(inner, t_end)
        self._members = tuple(
            StagePlaces(scheme.member(stiff), scatters) for stiff in (False, True)
        )
        self._places = self._members[False]
        self._slope = 0.0
        self._zero: float | None = None
        self._zero_error = 0.0
        self._expected: float | None = None
        self._redo: float | None = None
        self._redone = 0
        self._watched = Arrival.WATCHED if arrivals and inner.adaptive else Arrival.NONE
        self._arrival = self._watched
        self._known = False
        self._lingering = False
        self._turning = False
        self._lost_branch = False

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The inner proposal, shortened where a stage would come too close."""
        self._places = self._members[memory.stiff]
        if self._redo is not None:
            limit = min(limit, self._redo)
        slope = memory.sigma_slope = self._slope
        if slope > 0.0 and self.adaptive:
            longest = SIGMA_CHANGE / slope
            if longest < limit:
                limit = longest
        proposal = self._inner.propose(t, limit, memory)
        if self._arrives(t, proposal):
            self._arrival = Arrival.DUE
        self._lingering = memory.lingering = self._lingers(proposal, memory)
        if self._lingering:
            return proposal
        if self._arrival is Arrival.DUE:
            self._arrival = Arrival.NONE
            return replace(proposal, singular_arrival=True)
        # Where the multipliers are known, stages may lie anywhere.
        self._known = memory.history is not None and memory.history.known_until >= self._t_end
        if self._known:
            return proposal
        if self._zero is not None and self._redo is None and self._zero > t:
            h = self._placed(self._zero - t, proposal.h, t)
            if h != proposal.h:
                self.placed += 1
                return Proposal.over(t, h, placed=True)
        return proposal

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`~srm_mbs.integration.control.step_size.StepSizeControl`."""
        super().set_target_time(end, grid)
        self._arrival = self._watched

    def moved(self, t: float) -> None:
        """See :class:`~srm_mbs.integration.control.step_size.StepSizeControl`."""
        super().moved(t)
        self._zero = self._redo = self._expected = None
        self._redone = 0

    def next_zero(self) -> float | None:
        """See :class:`~srm_mbs.integration.control.step_size.StepSizeControl`."""
        return self._expected

    def _lingers(self, proposal: Proposal, memory: IntegratorState) -> bool:
        """Whether stages next to a singular configuration are to be solved by nodes of the branch:
        the motion turns back, is slow or ends there."""
        history = memory.history
        if self._lost_branch or history is None or history.known_until >= proposal.t_new:
            return False
        if not self.adaptive:
            return history.away is not None
        if self._arrival is Arrival.DUE:
            return True
        if not memory.sigma < WATCHED_SIGMA:
            return False
        # Where nodes solved the last state, sigma at stages off the branch need not be a parabola.
        return self._turning or history.away is not None

    def _arrives(self, t: float, proposal: Proposal) -> bool:
        """Whether it is found that the run, or its interval, ends beside a singular
        configuration."""
        if self._arrival is not Arrival.WATCHED:
            return False
        if self._zero is None or not self._zero > t:
            return False
        if not abs(self._zero - self._t_end) * self._slope < SINGULAR_END_SIGMA:
            return False
        # Of many loops sigma is no parabola, and its zero not known that well: only the step to the
        # end will tell.
        if not self._zero_error < SINGULAR_END_SIGMA:
            return False
        return (
            proposal.t_new >= self._t_end or (self._t_end - t) * self._slope <= ARRIVAL_SIGMA_CHANGE
        )

    def _placed(self, distance: float, h: float, t: float) -> float:
        gaps = self._places.gaps
        if t + h >= self._t_end and gaps.ends_on(distance, h):
            return h  # the run, or its smooth interval, ends there
        if self.adaptive:
            return gaps.longest_step(distance, h)
        # A fixed step may cross its grid point where that is singular: it could only creep up.
        if not gaps.ends_on(distance, h):
            return gaps.longest_step(distance, h) if distance < h else h
        over = gaps.step_over(distance)
        return over if t + over <= self._t_end else h

    def _better_step(self, h: float, sigmas: FloatArray, slope: float, last: bool) -> float | None:
        """A better step length if a stage or the end came too close, else None.

        ``last``: the run, or its smooth interval, ends with this step, wherever that is.
        """
        values: list[float] = sigmas.tolist()
        places = self._places
        reach = TOO_CLOSE * max(self._slope, slope) * h
        if not min(values) < min(reach, 0.5 * values[0]):
            return None
        movable = places.inner_stages if last else places.later_stages
        if not min((values[i] for i in movable), default=np.inf) < min(reach, 0.5 * values[0]):
            return None
        zero = zero_within(places.abscissae, sigmas)
        if zero is None or not zero > 0.0:
            return None
        return places.gaps.longest_step(zero * h, 0.98 * h)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Redo a badly placed step; otherwise the inner decision."""
        slope, places = 0.0, self._places
        if result is None:
            pass
        elif result.quiet:  # no zero is near: only the slope is kept
            slope = result.slope
        else:
            h = proposal.h
            slope = sigma_slope(self._places.inverse, result.sigmas, h)
            last = proposal.t_new >= self._t_end
            # Where a method has no nodes, the end is solved as any stage.
            unsolved = last and self._arrival is Arrival.DUE and result.away is None
            unsolved = unsolved and result.sigmas[-1] < BRANCH_SIGMA
            if self._lingering and (result.lost_branch or unsolved):
                self._lost_branch, self._redo = True, h
                self.replaced += 1
                return StepDecision.REPLACED
            ends_beside = last and result.sigmas[-1] < SINGULAR_END_SIGMA
            if ends_beside and self._arrival is Arrival.WATCHED and not self._lingering:
                self._arrival, self._redo = Arrival.DUE, h
                # The first step of a run knows no other slope, and would prepare nothing.
                self._slope = self._slope or slope
                self.replaced += 1
                return StepDecision.REPLACED
            if self._redone < MAX_REDONE and not (self._known or self._lingering):
                better = self._better_step(h, result.sigmas, slope, last)
                if better is not None and 0.0 < better < h:
                    self._redo = better
                    self._redone += 1
                    self.replaced += 1
                    return StepDecision.REPLACED
        decision = self._inner.decide(proposal, result)
        self._redo = None
        self._redone = 0
        if decision is StepDecision.REJECTED and self._arrival < self._watched:
            # What was prepared without nodes was another step to the end.
            self._arrival, self._lost_branch = self._watched, False
        if decision is StepDecision.ACCEPTED and result is not None:
            slowest = 0.5 * self._slope
            self._slope = slope if slope > slowest else slowest
            self._zero = self._expected = None
            self._turning = False
            self._lost_branch = self._lost_branch and not result.quiet
            ahead = None
            if not result.quiet:
                if result.sigmas[-1] < WATCHED_SIGMA:
                    extreme = extreme_sigma(places.abscissae, places.middle[0], result.sigmas)
                    slow = self._slope * proposal.h < SLOW_SIGMA_CHANGE
                    self._turning = slow or abs(extreme) < TURNING_SIGMA
                ahead = zero_ahead(*places.middle, result.sigmas)
                if ahead is not None:
                    self._zero = result.t + proposal.h * ahead
                    self._zero_error = error_of_parabola(
                        places.abscissae, places.middle[0], result.sigmas, ahead
                    )
            expected = expected_zero(result.sigmas, ahead)
            self._expected = None if expected is None else result.t + proposal.h * expected
        return decision


class SlopeOfSigma(ControlWrapper):
    """Wraps ``inner`` step-size control without placing steps.

    It measures how fast sigma changes, by which the zone is widened for fast passages.
    """

    def __init__(
        self, inner: StepSizeControl, scheme: ButcherTableau, t_end: float = np.inf
    ) -> None:
        super().__init__(inner, t_end)
        self._members = tuple(inverse_abscissae(scheme.member(stiff)) for stiff in (False, True))
        self._inverse = self._members[False]
        self._slope = 0.0

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The inner proposal."""
        self._inverse = self._members[memory.stiff]
        memory.sigma_slope = self._slope
        return self._inner.propose(t, limit, memory)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """The inner decision."""
        decision = self._inner.decide(proposal, result)
        if decision is StepDecision.ACCEPTED and result is not None:
            slope = sigma_slope(self._inverse, result.sigmas, proposal.h)
            self._slope = max(slope, 0.5 * self._slope)
        return decision
