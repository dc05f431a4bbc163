"""Step-size control: the length of the next step, and whether the last one is accepted.

The decision on a step is separate from making it.  One control may wrap another
(:class:`ControlWrapper`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, StepResult

SAFETY = 0.9
"""Safety factor of the next step."""
MIN_FACTOR, MAX_FACTOR = 0.2, 5.0
"""Smallest and largest ratio of a step to the one before."""
PROPORTIONAL_EXPONENT, INTEGRAL_EXPONENT = 0.4, 0.7
"""h_new = h 0.9 xi^(-0.7/k) xi_old^(0.4/k): PI control after Gustafsson."""
MIN_OLD_ERROR_RATIO = 1e-4
"""Smallest error ratio of the step before that counts."""
MIN_ERROR_RATIO = 1e-10
"""Smallest error ratio of a step that counts."""
RATE_OVERFLOW = 1e100
"""Size of a rate from which its products may overflow."""
PROBE_LENGTH = 0.01
"""Length of the step that probes how fast rates change, over that in which the state would change
by itself; the change that the first step may make."""
LONGEST_FIRST = 100.0
"""Longest first step, over that probe."""
AT_REST = 1e-6
"""Time in which rates would change by themselves, over the length of the probe, below which they
may be those of a rest that drives, or forces over time, end."""
REST_PROBES = (0.41, 0.07)
"""Parts of the first smooth interval at which the end of a rest shows that is over at its end."""
REST_ENDS = 1e3
"""Change of the rates there, over that at the end of the run, from which it is no rounding."""
REST_FACTOR = 4.0
"""Ratio of the times at which the end of the rest is looked for."""
CLOCK_ROUNDING = 1e-10
"""Rounding of the time at the end of a step, over the length of the step, from which it counts."""
UNEVALUATED_ERROR_RATIO = 1e6
"""Error ratio of a step whose stages could not be evaluated or are not finite."""


Grid = tuple[float, float]
"""Where a grid of fixed steps begins, and its spacing (s)."""


class StepDecision(Enum):
    """Decision on a proposed step."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    REPLACED = "replaced"
    """The step is redone with another length so that no stage lies on a singular point."""


@dataclass(frozen=True)
class Proposal:
    """A step of length ``h`` that ends at ``t_new`` (exactly, where that is a given time).

    Attributes
    ----------
    placed
        Whether it was made shorter so that no stage lies on a singular configuration.
    singular_arrival
        Whether the run, or its smooth interval, is about to end beside one: the multipliers up to
        there are found first (:func:`~srm_mbs.integration.singular_endpoints.singular_arrival`),
        and a step is proposed again.
    """

    h: float
    t_new: float
    placed: bool = False
    singular_arrival: bool = False

    @classmethod
    def over(cls, t: float, h: float, placed: bool = False) -> Proposal:
        """A step from ``t`` (s) of about the length ``h`` (s).

        Times far from zero are coarse: the motion is to advance by what the clock does, or the
        errors of many steps add up.
        """
        t_new = t + h
        if math.ulp(t_new) > CLOCK_ROUNDING * h:
            h = t_new - t
        return cls(h, t_new, placed)


class StepSizeControl(Protocol):
    """Decides on step lengths."""

    adaptive: bool

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The next step from ``t``, at most ``limit`` long where the control is adaptive."""

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Decide on a step; ``result`` is None if a stage could not be evaluated."""

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """A step ends on ``end`` (s): a breakpoint, or the end of the run.

        With ``grid`` fixed steps count from its start; other controls have none.
        """

    def moved(self, t: float) -> None:
        """The run is at ``t`` (s) by steps that no control proposed."""

    def next_zero(self) -> float | None:
        """When (s) sigma is expected to vanish; None if that is not to be seen."""


class ControlWrapper:
    """Step-size control around ``inner``, which decides unless a subclass does.

    Parameters
    ----------
    t_end
        End of the run (s).

    Attributes
    ----------
    placed, replaced
        How many steps were changed in advance, and redone afterwards.
    """

    def __init__(self, inner: StepSizeControl, t_end: float = np.inf) -> None:
        self._inner = inner
        self._t_end = t_end
        self.adaptive = inner.adaptive
        self.placed = 0
        self.replaced = 0

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The inner proposal."""
        return self._inner.propose(t, limit, memory)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """The inner decision."""
        return self._inner.decide(proposal, result)

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`StepSizeControl`."""
        self._t_end = end
        self._inner.set_target_time(end, grid)

    def moved(self, t: float) -> None:
        """See :class:`StepSizeControl`."""
        self._inner.moved(t)

    def next_zero(self) -> float | None:
        """See :class:`StepSizeControl`."""
        return self._inner.next_zero()

    def suspect_times(self) -> list[float]:
        """Times (s) up to which the motion may have changed its branch: none."""
        return []


def _until(t: float, h: float, end: float) -> Proposal:
    """A step of at most ``h`` that neither passes ``end`` nor leaves a sliver before it."""
    remaining = end - t
    if h >= remaining * (1.0 - 1e-12):
        return Proposal(remaining, end)
    if 2.0 * h > remaining:
        h = 0.5 * remaining
    return Proposal.over(t, h)


class PIControl:
    """Proportional-integral control of the error of an embedded pair.

    Parameters
    ----------
    t_end
        Time at which the run ends (s).
    first_step
        Length of the first step (s).
    order
        k: 3 for tvd32, 5 for dopr54, 8 for dop853.
    stiff_order
        k of the steps where the problem is stiff; None for ``order``.
    """

    adaptive = True

    def __init__(
        self, t_end: float, first_step: float, order: int, stiff_order: int | None = None
    ) -> None:
        self._t_end = t_end
        self._h = first_step
        self._orders = order, order if stiff_order is None else stiff_order
        self._order = order
        self._xi_old = 1.0
        self._just_rejected = False

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """The step that the error allows."""
        self._order = self._orders[memory.stiff]
        return _until(t, min(self._h, limit), self._t_end)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Accept if the error ratio xi <= 1; no growth right after a rejection."""
        xi = UNEVALUATED_ERROR_RATIO if result is None else result.error_ratio
        if not xi < UNEVALUATED_ERROR_RATIO:
            xi = UNEVALUATED_ERROR_RATIO
        k = self._order
        if xi > 1.0:
            self._h = proposal.h * max(MIN_FACTOR, SAFETY * xi ** (-1.0 / k))
            self._just_rejected = True
            return StepDecision.REJECTED
        factor = (
            SAFETY
            * max(xi, MIN_ERROR_RATIO) ** (-INTEGRAL_EXPONENT / k)
            * self._xi_old ** (PROPORTIONAL_EXPONENT / k)
        )
        factor = min(MAX_FACTOR, max(MIN_FACTOR, factor))
        if self._just_rejected:
            factor = min(factor, 1.0)
        h = proposal.h * factor
        if proposal.t_new == self._t_end and proposal.h < self._h:
            # Cut to end there: after a breakpoint the step proposed before is the better guess.
            h = max(h, self._h)
        self._h = h
        self._xi_old = max(xi, MIN_OLD_ERROR_RATIO)
        self._just_rejected = False
        return StepDecision.ACCEPTED

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`StepSizeControl`."""
        self._t_end = end

    def moved(self, t: float) -> None:
        """See :class:`StepSizeControl`: the step that the error allows stays."""

    def next_zero(self) -> float | None:
        """See :class:`StepSizeControl`."""
        return None


class FixedStep:
    """Steps on a grid t0 + i step; a shortened step returns to the grid.

    Parameters
    ----------
    t0, t_end
        Range of the run (s); the last step is shortened to end there.
    step
        Grid spacing (s).
    """

    adaptive = False

    def __init__(self, t0: float, t_end: float, step: float) -> None:
        self._t0, self._t_end, self._step = t0, t_end, step
        self._index = 1

    def propose(self, t: float, limit: float, memory: IntegratorState) -> Proposal:
        """To the next grid point, or ``limit`` towards it."""
        target = self._t0 + self._index * self._step
        if target > self._t_end - 1e-9 * self._step:
            target = self._t_end
        if limit < target - t - self._sliver():
            return Proposal.over(t, limit)
        return Proposal(target - t, target)

    def decide(self, proposal: Proposal, result: StepResult | None) -> StepDecision:
        """Accept every step that could be evaluated."""
        if result is None or not np.isfinite(result.state).all():
            return StepDecision.REJECTED
        self.moved(proposal.t_new)
        return StepDecision.ACCEPTED

    def moved(self, t: float) -> None:
        """See :class:`StepSizeControl`: the next step ends on the next grid point."""
        while t >= self._t0 + self._index * self._step - self._sliver():
            self._index += 1

    def next_zero(self) -> float | None:
        """See :class:`StepSizeControl`."""
        return None

    def _sliver(self) -> float:
        """Distance (s) before a grid point that is not worth a step."""
        return max(1e-9, 1e-14 * self._index) * self._step

    def set_target_time(self, end: float, grid: Grid | None = None) -> None:
        """See :class:`StepSizeControl`; without a new grid the old one stays."""
        self._t_end = end
        if grid is not None:
            (self._t0, self._step), self._index = grid, 1


_TOO_TIGHT = "the rates at the start are beyond all measure of atol: it is far too small"


def initial_step(
    system: System,
    state: FloatArray,
    memory: IntegratorState,
    norm: ErrorNorm,
    span: float,
    order: int,
    t: float = 0.0,
    smooth: float = np.inf,
) -> float:
    """Length of the first step (s): the thesis' appendix B.2, independent of the unit of time.

    With d0 = ||unit of x||, d1 = ||x'|| and d2 = ||x''|| (an Euler step of 0.01 d0/d1), and the
    time tau = d1/d2: h = min(d0/d1, tau (0.01 / (tau d1))^(1/k)).

    At rest d1 is rounding, or next to it, and tau says nothing.  Where only the passing of time
    changes the rates there, tau is the time scale of that, and d1 the change of the rates over it.
    A drive that moves smoothly from rest to rest shows at its end, or in its middle, no change: it
    is looked for at two more times in the first ``smooth`` seconds, where the equations are smooth.
    """
    smooth = min(smooth, span)
    weights = norm.weights(memory.state_scale)
    # |x| itself may vanish; at the size atol / rtol both tolerances allow the same error.
    d0 = norm(np.maximum(memory.state_scale, norm.one), weights)
    if not np.abs(memory.rate).max() < RATE_OVERFLOW:
        raise EvaluationError("the rates at the start overflow: an input is far too large")
    with np.errstate(over="ignore"):
        d1 = norm(memory.rate, weights)
    if not np.isfinite(d1):
        raise EvaluationError(_TOO_TIGHT)
    if not d1 > 0.0:
        return PROBE_LENGTH * smooth
    h0 = min(PROBE_LENGTH * d0 / d1, span)

    def change(ahead: float, moves: float = 1.0) -> float:
        """Size of the change of the rates over ``ahead`` (s), with the state moving on or not."""
        way = moves * ahead * memory.rate
        probe = system.retract(state, way)
        rate = system.chart_rate(way, system.evaluate(t + ahead, probe).rate())
        with np.errstate(over="ignore"):
            return norm(rate - memory.rate, weights)

    d2 = change(h0) / h0
    if not np.isfinite(d2):
        raise EvaluationError(_TOO_TIGHT)
    longest = LONGEST_FIRST * h0
    if h0 == span:
        for part in REST_PROBES:
            ahead = part * smooth
            changed = change(ahead, 0.0)
            if changed > REST_ENDS * d2 * h0:
                h0, d2 = ahead, changed / ahead
    if not d2 > 0.0:
        return min(longest, span)
    tau = d1 / d2
    if tau < AT_REST * h0 and change(h0, 0.0) > 0.5 * h0 * d2:
        tau, d1 = _end_of_rest(lambda ahead: change(ahead, 0.0), tau, h0)
    return float(min(longest, tau * (PROBE_LENGTH / (tau * d1)) ** (1.0 / order), span))


def longest_from_rest(
    system: System, memory: IntegratorState, norm: ErrorNorm, ahead: float
) -> float:
    """Longest step (s) from a breakpoint of a driven mechanism, in a smooth interval that goes on
    for ``ahead`` (s): unbounded unless it rests.

    A drive that leaves its rest smoothly may have, at the stages of a step over its whole motion,
    the accelerations of the rest.
    """
    analysis = system.singularities
    if analysis is None or not analysis.driven:
        return math.inf
    moved = ahead * norm(memory.rate, norm.weights(memory.state_scale))
    return REST_PROBES[-1] * ahead if moved < norm.negligible else math.inf


def _end_of_rest(
    change: Callable[[float], float], shortest: float, longest: float
) -> tuple[float, float]:
    """The time scale (s) of the ``change`` of the rates with time, from ``shortest`` to ``longest``
    (s), and the change over it, at least one that moves the state by PROBE_LENGTH.

    It is the first time that moves the state by more, and after which the change grows no longer
    at least like the root of the time: with a drive that swings it is a part of the period.
    """
    scale = longest
    while scale > shortest:
        scale /= REST_FACTOR
    found = change(scale)
    while scale < longest:
        further = change(REST_FACTOR * scale)
        if scale * found > PROBE_LENGTH and further < found * REST_FACTOR**0.5:
            break
        scale, found = REST_FACTOR * scale, further
    return scale, max(found, PROBE_LENGTH / scale)
