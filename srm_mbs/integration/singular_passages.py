"""Singular configurations that a run passed, or reached without momentum.

Both are found after the run, on its dense output.

* A *crossing* is a passage through a singular configuration.  The recorded sigmas show between
  which stages sigma may have passed zero; where sigma is not sharp enough (a slender mechanism),
  the smallest singular values of the closures at the stages do.  There the smallest singular value
  of the closures is followed on the dense output.  A minimum of it is a crossing if the part of G
  that loses rank changes sign across it (the motion passes through), or changes altogether (it
  departs on another branch); where the motion turns back, or passes by, that part stays the same.
  Where all rates change their sign, that part there and on both sides tells whether the motion
  passed twice or not at all, however close to the singular configuration it turned back.
* A *bifurcation* is a singular configuration at which the motion comes to rest, or turns back so
  close to it that it could not be told from one that rests there.  Several branches meet there;
  momentum chooses one, and without momentum the continuation is not unique.  The run keeps the
  branch that it arrived on, and lists the place.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections.abc import Callable, Collection, Generator, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import TypeVar

import numpy as np

from srm_mbs._typing import BoolArray, FloatArray, IndexArray
from srm_mbs.dynamics.constraints.geometry import separated_pattern
from srm_mbs.dynamics.constraints.row_algebra import (
    SingularValues,
    active_rows,
)
from srm_mbs.dynamics.constraints.structure import SMALL_REFERENCE_PIVOT
from srm_mbs.dynamics.singularities.branches import branch_tangents
from srm_mbs.dynamics.singularities.critical import (
    CriticalPlace,
    critical_configuration,
    first_step_length,
)
from srm_mbs.dynamics.singularities.local_analysis import (
    Participants,
    SingularConfiguration,
    analyse_singular,
    nearest_singular,
    participants,
)
from srm_mbs.dynamics.system import SingularityAnalysis, System
from srm_mbs.errors import time_text
from srm_mbs.integration.critical_passages import ROUNDED_RESIDUAL, exact_up_to
from srm_mbs.integration.dense_output import CRITICAL, STEP_PLACEMENTS, DenseOutput, StepData
from srm_mbs.integration.methods.butcher import SAME_STAGE, ButcherTableau
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_model

SLOPE_MARGIN = 1.5
"""Largest change of sigma per time between two stages, over the largest that was recorded around
them."""
VANISHING_SIGMA = 0.05
"""Part of the sigmas around below which sigma between two stages counts as possibly zero."""
LINGERING_SIGMA = 0.05
"""sigma below which a motion is close to a singular configuration, whatever the sigmas around."""
SAMPLES_PER_INTERVAL = 4
"""Samples on the dense output per interval between two stages."""
DEPARTED_VALUE = 0.02
"""Part of the largest singular value of a window above which the motion has left a minimum."""
LEAST_DEPARTED = 1e-12
"""The same value where that part is rounding."""
MINIMUM_DEPTH = 0.5
"""Largest value of a minimum, over those at its sides."""
SINGULAR_VALUE = 1e-5
"""Part of the values around below which a minimum is at a singular configuration; above, one must
be found next to it."""
CLOSE_DISTANCE = 0.2
"""Largest distance of the singular configuration from a minimum, over the motion around it."""
TURNED_BACK_COSINE = 0.9
"""Cosine above which the part of G that loses rank is the same before and after: the motion turned
back or passed by."""
TOUCHING_VALUE = 1e-6
"""Part of the values around below which such a motion touched the singular configuration."""
UNTOUCHED_VALUE = 2.0 * TOUCHING_VALUE
"""The same part from which a motion that turned back certainly did not."""
VANISHING_TOGETHER = 2.0
"""Singular values up to this multiple of the smallest vanish with it."""
AVOIDED_SIGMA = 0.4
"""sigma where a motion is closest to a critical configuration from which it passes none: the layer
is so wide that the motion in it is a regular one, whether or not it is followed along its curve."""
RECORDED_DEPTH = 0.75
"""Largest of the lowest sigmas between recorded samples, over those at the sides, of a minimum that
is examined: sigma differs from the singular values by some per cent."""
BESIDE_TURN = np.array([0.5, 0.8, 1.0, 1.25, 2.0])
"""Times at which a crossing beside a turn is looked for, over the one expected."""
STRAIGHT_AT = np.array([0.5, 1.0])
"""Where a singular value is compared with a straight line, over the time from its zero to the next
sample."""
NEXT_TO_SAMPLE = 0.2
"""Distance of a crossing from a sample, over the interval, below which that shows no slope."""
LEAST_SLOPE = 0.7
"""sigma over the time from a crossing, over that next to it, below which the motion may turn
back."""
LOW_SIGMA = 2.0
"""sigma, over that of a minimum that steps resolve, up to which the minimum of the singular value
is looked for."""
SAMPLES_AROUND = 100
"""Samples on either side of a crossing at which that is looked for."""
EVERY = 4
"""Of these, one of so many shows where the part of G that loses rank changes its sign."""
FAR_SIGMA = 0.4
"""sigma above which it has left the crossing."""
ROUNDED_PART = 1e-12
"""Size of that part, over the largest around, below which its sign may be rounding."""
ROOT_TOLERANCE = 1e-3
"""Accuracy of the times at which it vanishes, over the distance of those between which it does."""
HIDDEN_WITHIN = 0.1
"""Time around them in which a further crossing is looked for, over that from the first one."""
SAME_PASSAGE = 1e-3
"""Distance in time of two crossings that are one, over that in which the singular value falls to a
twentieth of those around."""
TURN_AT = 0.5 ** np.arange(16, -1, -1)
"""Where the part of G that loses rank is evaluated on the way to the next sample, over it: between
any two zeros lies one."""
DIP_WIDTHS = (1, 3)
"""Recorded intervals on either side of a minimum in which it is looked for, one after the other."""
MAX_REFINEMENTS = 12
"""Steps of the search for the minimum of a singular value."""
SMALLEST_REFINEMENT = 1e-7
"""Step of that search, over the time in which it began, below which the next one, far shorter, is
beyond the accuracy of the run."""
CROSSING_SEARCH = 0.3
"""Distance (rad, scene diagonals) from the dense output within which the singular configuration of
a crossing is looked for."""
BEYOND_REACH = 1.25
"""First step of that search, over its reach and the motion around, from which nothing is there."""
LEAST_SIGNED = 1e-8
"""Value over those at the sides at which the zero of a value with a sign is found."""
SIGNED_DECREASE = 0.5
"""Value over the smallest one so far from which on it has no sign that would change at a zero."""
VELOCITY_VALUE = 0.05
"""Part of the values around at which the velocity is taken before and after a crossing."""
REVERSAL_STEPS = 2
"""Steps of Newton's iteration for the time at which a motion turns back."""
REVERSAL_SIGMA = 0.02
"""sigma below which a motion that turns back may have met a bifurcation."""
UNDECIDED_DISTANCE = 3e-6
"""Distance to the singular configuration (rad, scene diagonals) below which a motion that turns
back reaches it: the same at every tolerance."""
UNDECIDED_VALUE = 1e-4
"""Last structural singular value where a motion turns back above which it is farther away."""
RESTING_SPEED = 0.05
"""Speed where a motion turns back, over those around, above which it goes on in another freedom."""
RESTING_SIGMA = 1e-7
"""sigma at all stages of a step below which a motion without momentum rests."""
WITHOUT_MOMENTUM = 0.01
"""Part of the largest speed of a run below which it ends without momentum."""
BIFURCATION_SEARCH = 0.05
"""Distance (rad, scene diagonals) from the motion within which the singular configuration of a
bifurcation is looked for."""
SAMPLES = 21
"""Samples of the motion next to a bifurcation."""

T = TypeVar("T")
Search = Generator[FloatArray, FloatArray, T]
"""A search that yields times (k,) s, is sent the last structural singular values (k,) there, and
returns its result."""


@per_model
def singular_values(mechanism: MechanismData) -> SingularValues:
    """Singular values of the separated rows of closures and drives."""
    return SingularValues(separated_pattern(mechanism))


@per_model
def turning_columns(mechanism: MechanismData) -> list[int]:
    """The coordinates, of nv, that the rows of closures and drives depend on: of a motion that
    turns back next to a singular configuration they change their sign."""
    used = np.logical_or.reduce(separated_pattern(mechanism), axis=0)
    return np.flatnonzero(used[: mechanism.model.nv]).tolist()


def critical_near(monitor: ConstraintMonitor, t: float) -> CriticalPlace | None:
    """The critical configuration next to the motion at t (s); None if there is none."""
    geometry, place = monitor.geometry, monitor.place(t)
    found = critical_configuration(
        geometry, monitor.rank, place, CROSSING_SEARCH, jacobians=monitor.jacobians_at
    )
    return None if found is None else CriticalPlace(found.q, found.residual)


class ConstraintMonitor:
    """The closures and drives along the dense output of a run.

    Residuals up to ``tolerance`` (row units) count as zero; ``critical_of`` is
    :func:`critical_near`, or the kernel's.
    """

    def __init__(
        self,
        analysis: SingularityAnalysis,
        dense: DenseOutput,
        tolerance: float = 0.0,
        critical_of: Callable[[ConstraintMonitor, float], CriticalPlace | None] = critical_near,
    ) -> None:
        self._critical_of = critical_of
        self.tolerance = exact_up_to(tolerance)
        self.geometry = analysis.geometry(analysis.q0)
        self.rank = analysis.rank
        self.analysis = analysis
        self.dense = dense
        self._values = singular_values(self.geometry.mechanism)
        self._critical: dict[float, CriticalPlace | None] = {}

    def states(self, t: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """(q, v) at the times t (k,)."""
        return [self.analysis.split(state) for state in self.dense(t)]

    def configurations(self, t: FloatArray) -> FloatArray:
        """q (k, nq) at the times t (k,)."""
        return self.dense(t)[:, : self.geometry.model.nq]

    def place(self, t: float) -> FloatArray:
        """Configuration at t, as the geometry takes it."""
        return self.geometry.at(self.states(np.array([t]))[0][0], t)

    def smallest(self, t: FloatArray) -> FloatArray:
        """Last structural singular value of the normalised G at the times t (k,)."""
        if not len(t):
            return np.zeros(0)
        q = self.configurations(t)
        observables = self.dense.observables
        return observables.smallest_values(self.geometry, self._values, self.rank, t, q)

    def normalised(self, t: FloatArray) -> FloatArray:
        """The normalised G (k, rows, n) at the times t (k,)."""
        return self.geometry.normalised_rows(self._jacobians(t))

    def separated(self, t: FloatArray, q: FloatArray) -> FloatArray:
        """G (k, rows, n), of which :meth:`smallest` gives singular values, at the times t (k,) and
        the configurations q (k, nq)."""
        return self.geometry.separated_rows(self.dense.observables.jacobians(t, q))

    def near_null_spaces(self, G: FloatArray, active: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Null spaces of the ``active`` rows G (k, n) of the normalised ones that vanish at a
        singular configuration, left (k, k - r) and right (n, n - r)."""
        return self._values.of_rows(active).near_null_spaces(G, self.rank)

    def _jacobians(self, t: FloatArray) -> FloatArray:
        return self.dense.observables.jacobians(t, self.configurations(t))

    def critical(self, t: float) -> CriticalPlace | None:
        """The critical configuration next to the motion at t (s); None if there is none."""
        if t not in self._critical:
            self._critical[t] = self._critical_of(self, t)
        return self._critical[t]

    def is_regular(self, t: float, around: Sequence[float]) -> bool:
        """Whether the search for a critical configuration next to the motion at t (s) leaves its
        reach at once, and would from the places at the times ``around`` it as well."""
        geometry, reach = self.geometry, CROSSING_SEARCH
        q, *others = (
            geometry.at(q, time)
            for time, (q, _) in zip((t, *around), self.states(np.array([t, *around])))
        )
        reach += max(float(np.abs(geometry.difference(q, other)).max()) for other in others)
        step = first_step_length(geometry, self.rank, q, self.jacobians_at)
        return step > BEYOND_REACH * reach

    def jacobians_at(self, places: FloatArray) -> FloatArray:
        """As of the geometry, in one call of the observables."""
        nq = self.geometry.model.nq
        t = places[:, nq] if self.geometry.drives else np.zeros(len(places))
        unscaled = self.dense.observables.jacobians(t, places[:, :nq])
        return unscaled * (self.geometry.unit / self.geometry.row_unit[:, None])

    def counted_singular(self, t: float) -> FloatArray | None:
        """The critical configuration next to the motion at t (s) whose residual counts as zero
        without being it; None if there is none."""
        found = self.critical(t)
        if found is None or not ROUNDED_RESIDUAL < abs(found.residual) <= self.tolerance:
            return None
        return found.q

    def avoids(self, t: float) -> bool:
        """Whether the closures have a residual at the critical configuration next to the motion at
        t (s) that the run followed."""
        found = self.critical(t)
        return found is not None and self.follows(found)

    def follows(self, critical: CriticalPlace) -> bool:
        """Whether the run followed the residual at a critical configuration, not counted it as
        zero."""
        return abs(critical.residual) > self.tolerance

    def together(self, searches: Sequence[Search[T]]) -> list[T]:
        """Results of ``searches`` that do not depend on each other.

        All of them are made at once, so that each of their steps takes one call for all.
        """
        found: dict[int, T] = {}
        asked: dict[int, FloatArray] = {}

        def advance(i: int, values: FloatArray | None) -> None:
            try:
                asked[i] = searches[i].send(values)  # type: ignore[arg-type]
            except StopIteration as ended:
                asked.pop(i, None)
                found[i] = ended.value

        for i in range(len(searches)):
            advance(i, None)
        while asked:
            order, times = list(asked), list(asked.values())
            values = self.smallest(np.concatenate(times))
            at = 0
            for i, own in zip(order, times):
                advance(i, values[at : at + len(own)])
                at += len(own)
        return [found[i] for i in range(len(searches))]

    def minimum(self, t: FloatArray, values: FloatArray) -> float:
        """Time of the minimum bracketed by t (3,), values (3,) there."""
        return self.together([_minimum(t, values)])[0][0]


def _minimum(t: FloatArray, values: FloatArray, power: int = 2) -> Search[tuple[float, float]]:
    """Time and value of the minimum bracketed by t (3,), values (3,) there.

    The square of the value is a parabola where the motion passes, the value itself, of ``power`` 1,
    where branches touch.
    """
    times, heights = t.tolist(), (values**power).tolist()
    lowest = sorted(zip(heights, times))
    shortest = SMALLEST_REFINEMENT * (times[2] - times[0])
    # A value that passes zero has a sign: the zero of that is found in fewer steps.
    least = LEAST_SIGNED * float(values[0] + values[2])
    signed = power == 2
    for _ in range(MAX_REFINEMENTS):
        a, b, c = times
        fa, fb, fc = heights
        if signed:
            if math.sqrt(fb) <= least:
                break
            new = _signed_zero(times, [math.sqrt(height) for height in heights])
        else:
            # The lowest are closer than the sides of the bracket, if their parabola has a minimum.
            new = _vertex(lowest)
            if not a < new < c:
                new = _vertex(list(zip(heights, times)))
        if not a < new < c or abs(new - b) <= shortest:
            if not signed:
                break
            signed = False
            continue
        value = float((yield np.array([new]))[0]) ** power
        lowest = sorted([*lowest, (value, new)])[:3]
        signed = signed and value < SIGNED_DECREASE**2 * fb
        left = new < b
        if value < fb:
            times = [a, new, b] if left else [b, new, c]
            heights = [fa, value, fb] if left else [fb, value, fc]
        else:
            times = [new, b, c] if left else [a, b, new]
            heights = [value, fb, fc] if left else [fa, fb, value]
    return times[1], float(heights[1] ** (1.0 / power))


def _vertex(points: Sequence[tuple[float, float]]) -> float:
    """Time of the minimum of the parabola through three ``points``, each a value and its time; NaN
    if it has none."""
    (fa, a), (fb, b), (fc, c) = sorted(points, key=lambda point: point[1])
    if not a < b < c:
        return math.nan
    slope = (fb - fa) / (b - a)
    bend = (fc - fb) / (c - b) - slope
    return 0.5 * (a + b) - 0.5 * slope * (c - a) / bend if bend > 0.0 else math.nan


def _signed_zero(t: Sequence[float], values: Sequence[float]) -> float:
    """Zero by inverse quadratic interpolation of a value that has one between the first and the
    last of three times t, given its sizes ``values`` there; NaN if two of them are equal."""
    (a, b, c), (fa, fb, fc) = t, values
    fc = -fc
    if b > a + fa / (fa - fc) * (c - a):
        fb = -fb
    if fa in (fb, fc) or fb == fc:
        return math.nan
    of_a = a * fb * fc / ((fa - fb) * (fa - fc))
    of_b = b * fa * fc / ((fb - fa) * (fb - fc))
    return of_a + of_b + c * fa * fb / ((fc - fa) * (fc - fb))


@dataclass(frozen=True)
class Crossing:
    """A passage through a singular configuration.

    Attributes other than those of the constructor are computed when they are read.

    Attributes
    ----------
    time
        When the motion was closest to it (s), on the dense output.
    sigma_before
        sigma at the start of the step that passed it.
    sigma
        Smallest sigma of any evaluated stage of that step.
    rank
        Smallest number of closure rows in use in that step.
    placement
        How the stages were kept away: ``"a priori"`` (the step was shortened in advance),
        ``"redone"`` (it was redone with another length), ``"zone"`` (a stage came too close and
        took the predicted multiplier), ``"critical"`` (the motion was followed along the curve of
        closed configurations) or ``""``.
    kind
        ``"passed"``: the motion went straight on, through a singular configuration; or
        ``"avoided"``: the closures have a residual where their branches almost cross, and the
        motion followed the data past it, with sigma below 0.4 where it was closest.  So does that
        of a drive that turns back short of its dead point.
    """

    time: float
    sigma_before: float
    sigma: float
    rank: int
    placement: str
    kind: str
    _monitor: ConstraintMonitor = field(repr=False, compare=False)
    _beside: float = field(repr=False, compare=False)
    _range: tuple[float, float] = field(repr=False, compare=False)

    @cached_property
    def residual(self) -> float | None:
        """Size of the residual of the closures at the critical configuration of the passage, in
        row units (over the scene diagonal, rad): 0 to rounding at a singular one; None if none was
        found (:mod:`srm_mbs.dynamics.singularities.critical`)."""
        found = self._monitor.critical(self.time)
        return None if found is None else abs(found.residual)

    @property
    def by_tolerance(self) -> bool:
        """Whether the motion went straight on because the residual is below ``singular_tolerance``,
        not because it is zero."""
        residual = self.residual
        return self.kind == "passed" and residual is not None and residual > ROUNDED_RESIDUAL

    @cached_property
    def singular(self) -> SingularConfiguration | None:
        """The local analysis at the exactly singular configuration nearest to the passage; None
        if there is none close to it."""
        monitor = self._monitor
        found = nearest_singular(
            monitor.geometry, monitor.place(self.time), monitor.rank, CROSSING_SEARCH
        )
        return None if found is None else analyse_singular(monitor.geometry, found, monitor.rank)

    @property
    def configuration(self) -> FloatArray | None:
        """The exactly singular configuration nearest to the passage (nq,)."""
        return None if self.singular is None else self.singular.q[: self._monitor.geometry.model.nq]

    @cached_property
    def participants(self) -> Participants:
        """The rows that lose rank; that nearly do if there is no singular configuration, as where
        a drive leads almost up to its dead point."""
        if self.singular is not None:
            return self.singular.participants
        monitor = self._monitor
        left, size, _ = np.linalg.svd(monitor.geometry.normalised(monitor.place(self.time)))
        size = size[: monitor.rank]
        return participants(
            monitor.geometry, left[:, : monitor.rank][:, size < VANISHING_TOGETHER * size[-1]]
        )

    @property
    def loops(self) -> tuple[str, ...]:
        """Names of the loops whose rows lose rank."""
        return self.participants.loops

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of those rows, ``loop.row``."""
        return self.participants.rows

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the drives whose rows lose rank with those of the loops."""
        return self.participants.drives

    @cached_property
    def _velocities(self) -> tuple[FloatArray | None, FloatArray | None]:
        """Rates (n,) in units, extrapolated to the crossing from before and from after it."""
        out: list[FloatArray | None] = []
        for side in (-1.0, 1.0):
            times = self.time + side * self._beside * np.array([1.0, 2.0])
            if not (self._range[0] <= times.min() and times.max() <= self._range[1]):
                out.append(None)
                continue
            (_, near), (_, far) = self._monitor.states(times)
            out.append(self._monitor.geometry.rates(2.0 * near - far))
        return out[0], out[1]

    @cached_property
    def _tangents(self) -> FloatArray:
        """Directions (k, n) of the branches."""
        singular = self.singular
        if singular is None:
            return np.zeros((0, len(self._monitor.geometry.unit)))
        arriving, leaving = self._velocities
        return branch_tangents(singular, leaving if arriving is None else arriving)

    @property
    def branches(self) -> FloatArray:
        """Velocity directions (k, nv) of the branches that meet there, of unit length in units.

        With more than one degree of freedom: on each branch the one nearest to the arriving
        velocity (:func:`srm_mbs.dynamics.singularities.branches.branch_tangents`).  Empty if they
        are not isolated; of a driven mechanism also where it has freedom besides its drives.
        """
        tangents = self._tangents[:, : self._monitor.geometry.model.nv]
        size = np.linalg.norm(tangents, axis=1, keepdims=True)
        out: FloatArray = tangents / np.where(size > 0.0, size, 1.0)
        return out

    def _branch_of(self, u: FloatArray | None) -> int | None:
        """Index in ``branches`` of the branch with the rates u (n,)."""
        singular = self.singular
        if u is None or singular is None or not len(self._tangents):
            return None
        off = []
        for direction in self._tangents:
            tangent = singular.branch(direction)
            outside = u if tangent is None else u - tangent @ (tangent.T @ u)
            off.append(float(np.linalg.norm(outside)))
        return int(np.argmin(off))

    @cached_property
    def arrived_on(self) -> int | None:
        """Index in ``branches`` of the branch before the passage; None if unknown."""
        return self._branch_of(self._velocities[0])

    @cached_property
    def left_on(self) -> int | None:
        """Index in ``branches`` of the branch after the passage; None if unknown."""
        return self._branch_of(self._velocities[1])

    @property
    def switched(self) -> bool:
        """Whether the run left on another branch than it arrived on."""
        before, after = self.arrived_on, self.left_on
        return before is not None and after is not None and before != after


def _recorded(scheme: ButcherTableau, steps: StepData) -> tuple[FloatArray, FloatArray]:
    """Times and sigmas of the stages in order of time, each time once, up to the end of the run."""
    t, sigma = _of_stages(scheme, steps)
    inside = t <= steps.end
    return t[inside], sigma[inside]


def _of_stages(scheme: ButcherTableau, steps: StepData) -> tuple[FloatArray, FloatArray]:
    """The same to the end of the last step, which an event may have cut."""
    h = np.diff(steps.times)
    if not np.logical_or.reduce(steps.stiff):  # stages in the same order in all steps
        own = scheme.member(False)
        t = steps.times[:-1, None] + own.abscissae[own.distinct] * h[:, None]
        sigma = steps.sigmas[:, own.distinct]
        return (
            np.concatenate([steps.times[:1], t.ravel()]),
            np.concatenate([steps.sigmas[0, :1], sigma.ravel()]),
        )
    stages = steps.stage_times(scheme)[:, 1:]
    order = np.argsort(stages, axis=1, kind="stable")
    t = np.take_along_axis(stages, order, axis=1).ravel()
    sigma = np.take_along_axis(steps.sigmas[:, 1:], order, axis=1).ravel()
    step_of = np.repeat(np.arange(steps.count), order.shape[1])
    t = np.concatenate([steps.times[:1], t])
    sigma = np.concatenate([steps.sigmas[0, :1], sigma])
    step_of = np.concatenate([[0], step_of])
    fresh = np.concatenate([[True], np.diff(t) > SAME_STAGE * h[step_of[1:]]])
    return t[fresh], sigma[fresh]


def _lowest(t: FloatArray, sigma: FloatArray, around: int) -> FloatArray:
    """Lowest sigma (k - 1,) between neighbouring samples that the slopes ``around`` allow."""
    dt = np.diff(t)
    widest = _largest(np.abs(np.diff(sigma)) / dt, around, around)
    out: FloatArray = 0.5 * (sigma[:-1] + sigma[1:] - SLOPE_MARGIN * widest * dt)
    return out


def _may_vanish(sigma: FloatArray, lowest: FloatArray, around: int) -> BoolArray:
    """Between which neighbouring samples (k - 1,) sigma may have come close to zero."""
    size = _largest(sigma, around, around + 1)[:-1]
    # A run that lingers next to a singular configuration takes steps far below its distance.
    lingers = np.minimum(sigma[:-1], sigma[1:]) < LINGERING_SIGMA
    out: BoolArray = (lowest < VANISHING_SIGMA * size) | lingers
    return out


def _largest(values: FloatArray, before: int, after: int) -> FloatArray:
    """The largest of each value (n,) and its neighbours, as far as there are any."""
    none = np.full(max(before, after), -np.inf)
    largest = np.concatenate([none[:before], values, none[:after]])
    # Two windows make one of the double width, up to the last power of 2; then two overlap.
    width, size = before + after + 1, 1
    while 2 * size <= width:
        largest = np.maximum(largest[:-size], largest[size:])
        size *= 2
    out: FloatArray = np.maximum(largest[: len(values)], largest[width - size :])
    return out


def _windows(marked: BoolArray) -> IndexArray:
    """First and last sample (m, 2) of each run of marked intervals, one interval more on either
    side; no two have a sample in common."""
    grown = marked.copy()
    grown[:-1] |= marked[1:]
    grown[1:] |= marked[:-1]
    edges: IndexArray = np.flatnonzero(np.diff(np.concatenate([[0], grown.astype(int), [0]])))
    return edges.reshape(-1, 2)


@dataclass(frozen=True)
class Turn:
    """Where a motion turned back beyond a singular configuration, between two ends of steps.

    Attributes
    ----------
    times
        Of the one end, of the turn and of the other end (s).
    values
        The smallest singular value there, with the sign of the part of G that would lose rank:
        positive at the turn.
    top
        Sample with the largest sigma of the window.
    """

    times: Sequence[float]
    values: Sequence[float]
    top: int


@dataclass(frozen=True, eq=False)
class RecordedDips:
    """Minima of the recorded sigmas that may be crossings, in order.

    Attributes
    ----------
    samples : (n, 3)
        Indices of samples: the minimum between those on both sides where it is left.
    tops : (n,)
        Sample with the largest sigma in the window of each.
    turns
        Turns beyond singular configurations, which are not among the minima; None before
        :func:`recorded_turns`.
    at_turns : (m, 3)
        As ``samples``, of those at turns, which are no longer among the minima.
    """

    samples: IndexArray
    tops: IndexArray
    turns: Sequence[Turn] | None = None
    at_turns: IndexArray = field(default_factory=lambda: np.zeros((0, 3), dtype=int))

    def __bool__(self) -> bool:
        """Whether there is something to search."""
        return bool(len(self.tops) or self.turns)

    def free(self, count: int) -> IndexArray:
        """First sample and that after the last (n, 2), of ``count``, of those around each minimum
        that belong to no other one."""
        first = np.append(0, self.samples[:-1, 2])
        after = np.append(self.samples[1:, 0], count - 1) + 1
        return np.column_stack([first, after])

    def at_no_turn(self, others: IndexArray, turns: Sequence[Turn]) -> RecordedDips:
        """The minima ``others`` (k,), and the ``turns`` found among the rest."""
        told = np.ones(len(self.tops), dtype=bool)
        told[others] = False
        return RecordedDips(self.samples[others], self.tops[others], turns, self.samples[told])


def recorded_dips(scheme: ButcherTableau, steps: StepData) -> RecordedDips | None:
    """The minima of the sigmas at the stages of ``steps`` that may be crossings; None if there are
    none."""
    return _dips(*_recorded(scheme, steps), scheme.n_stages)


def _dips(t: FloatArray, sigma: FloatArray, around: int) -> RecordedDips | None:
    """As :func:`recorded_dips`, of samples ``sigma`` (k,) at t (k,); each is compared with those
    within ``around`` samples."""
    if len(t) < 3 or not np.isfinite(sigma).all():
        return None
    lowest = _lowest(t, sigma, around)
    windows = _windows(_may_vanish(sigma, lowest, around))
    if not len(windows):
        return None
    dips, window_of = _dips_in(sigma, lowest, windows)
    if not len(dips):
        return None
    tops = [a + int(sigma[a : b + 1].argmax()) for a, b in windows[window_of].tolist()]
    return RecordedDips(dips, np.array(tops))


def _dips_in(
    sigma: FloatArray, lowest: FloatArray, windows: IndexArray
) -> tuple[IndexArray, IndexArray]:
    """Samples (n, 3) of those minima in the ``windows`` (m, 2), and the window (n,) of each.

    ``lowest`` (k - 1,): between the samples.  At the ends of a run the zero may lie before the
    first or after the last of them.
    """
    sizes = windows[:, 1] - windows[:, 0] + 1
    ends = np.cumsum(sizes)
    starts = ends - sizes
    own = np.repeat(np.arange(len(windows)), sizes)
    at = np.arange(len(own))  # the samples of all windows, one window after the other
    place = at + (windows[:, 0] - starts)[own]
    size = sigma[place]
    before, after = np.append(np.inf, size[:-1]), np.append(size[1:], np.inf)
    below, above = lowest[place - 1], lowest[np.minimum(place, len(lowest) - 1)]
    before[starts] = after[ends - 1] = below[starts] = above[ends - 1] = np.inf
    k = np.flatnonzero((size <= before) & (size < after))
    # Of small minima between the same sides, the smallest.
    departed = np.maximum(DEPARTED_VALUE * np.maximum.reduceat(size, starts), LEAST_DEPARTED)
    high = size >= departed[own]
    left, right = high.copy(), high
    left[starts] = right[ends - 1] = True
    left_of = np.maximum.accumulate(np.where(left, at, 0))
    right_of = np.minimum.accumulate(np.where(right, at, len(at))[::-1])[::-1]
    first = left_of[np.maximum(k - 1, starts[own[k]])]
    last = right_of[np.minimum(k + 1, ends[own[k]] - 1)]
    floor = np.minimum(below, above)[k]
    deep = floor < RECORDED_DEPTH * np.minimum(size[first], size[last])
    k, first, last = k[deep], first[deep], last[deep]
    order = np.lexsort((size[k], first))
    chosen = order[np.flatnonzero(np.diff(first[order], prepend=-1))]
    samples = np.column_stack([first[chosen], k[chosen], last[chosen]])
    return place[samples], own[k[chosen]]


def _reversals(
    monitor: ConstraintMonitor, steps: StepData, first: IndexArray, last: IndexArray
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """In which of the ranges of steps from ``first`` to ``last`` (n,) all rates that the rows
    depend on change their sign, once: their indices (k,), and when (k,) s and where (k, nq)."""
    split, unit = monitor.analysis.split, monitor.geometry.coordinate_unit
    columns = turning_columns(monitor.geometry.mechanism)
    rates = (split(steps.states)[1] / unit)[:, columns]
    reverses = np.flatnonzero((rates[:-1] * rates[1:]).sum(axis=1) < 0.0)
    place = np.searchsorted(reverses, first)
    once = np.flatnonzero(np.searchsorted(reverses, last, side="right") == place + 1)
    step = reverses[place[once]]
    change = rates[step + 1] - rates[step]
    size = (change**2).sum(axis=1)
    before, after = ((rates[end] * change).sum(axis=1) for end in (step, step + 1))
    both = (rates[step] ** 2 + rates[step + 1] ** 2).sum(axis=1)
    straight = size * both - before**2 - after**2 < (RESTING_SPEED * size) ** 2
    step, change, before, size = (values[straight] for values in (step, change, before, size))
    start, end = steps.times[step], steps.times[step + 1]
    t = start - before / size * (end - start)
    for _ in range(REVERSAL_STEPS):
        _, v = split(monitor.dense(t))
        along = ((v / unit)[:, columns] * change).sum(axis=1)
        t = np.clip(t - along / size * (end - start), start, end)
    return once[straight], t, monitor.configurations(t)


def recorded_turns(
    monitor: ConstraintMonitor, scheme: ButcherTableau, steps: StepData, dips: RecordedDips
) -> RecordedDips:
    """The minima ``dips`` without those at turns, where all rates change their sign that the rows
    depend on, and the motion certainly did not touch the singular configuration; and those of the
    turns that lie beyond it, not before.

    Of driven mechanisms those before it are left among the minima that lie next to a critical
    configuration of which the motion followed the residual."""
    every = np.arange(len(dips.tops))
    if np.logical_or.reduce(steps.stiff):
        return dips.at_no_turn(every, ())
    columns = scheme.member(False).distinct
    stages, samples = len(columns), dips.samples
    # A turn beyond may show as several minima, less than two steps apart.
    starts = np.flatnonzero(np.append(True, samples[1:, 0] - samples[:-1, 2] >= 2 * stages))
    ends = np.append(starts[1:], len(every)) - 1
    several = ends > starts
    lowest, highest = np.append(starts[several], every), np.append(ends[several], every)
    first = np.maximum(samples[lowest, 0] - 1, 0) // stages
    last = (samples[highest, 2] - 1) // stages
    # Nothing is read beyond an event that ends the run.
    before, after = np.append(-1, samples[:, 1]), np.append(samples[1:, 1], np.iinfo(int).max)
    alone = (
        (steps.times[last + 1] <= steps.end)
        & (before[lowest] < first * stages)
        & (after[highest] > (last + 1) * stages)
    )
    own = np.flatnonzero(alone)
    found, t, q = _reversals(monitor, steps, first[own], last[own])
    if not len(found):
        return dips.at_no_turn(every, ())
    found = own[found]
    lowest, highest, first, last = (values[found] for values in (lowest, highest, first, last))
    tops = dips.tops[lowest]
    times = np.array((steps.times[first], t, steps.times[last + 1]))
    q_first, q_last = (monitor.analysis.split(steps.states[end])[0] for end in (first, last + 1))
    G = monitor.separated(times.ravel(), np.concatenate((q_first, q, q_last)))
    G = G.reshape(3, len(found), *G.shape[1:])
    left, sizes, right = np.linalg.svd(G[1])
    k = monitor.rank - 1
    values = np.einsum("ni,snij,nj->sn", left[:, :, k], G, right[:, k])
    before, value, after = np.abs(values)
    # The largest value of the window follows from the recorded sigmas, about.
    at = np.maximum(tops - 1, 0)
    step, column = at // stages, columns[at % stages]
    untouched = UNTOUCHED_VALUE * steps.sigmas[step, column]
    certain = (sizes[:, :k].min(axis=1, initial=np.inf) > VANISHING_TOGETHER * value) & (
        values[0] * values[2] > 0.0
    )
    far = certain.copy()
    for side, recorded_side in ((before, steps.sigmas[first, 0]), (after, steps.sigmas[last, -1])):
        far &= value * recorded_side > untouched * side
    close = np.flatnonzero(certain & ~far)
    lengths = np.where(tops > 0, np.diff(steps.times)[step], 0.0)
    t_top = steps.times[step] + scheme.member(False).abscissae[column] * lengths
    certain[close] = value[close] > TOUCHING_VALUE * monitor.smallest(t_top[close])
    if monitor.geometry.drives:
        short = certain & (values[0] > 0.0)
        certain[short] = [not monitor.avoids(time) for time in times[1, short].tolist()]
    taken: set[int] = set()
    turns = []
    for i in np.flatnonzero(certain).tolist():  # those of several minima first
        minima = set(range(lowest[i], highest[i] + 1))
        if minima & taken:
            continue
        taken |= minima
        if values[0, i] < 0.0:
            turns.append(Turn(times[:, i].tolist(), values[:, i].tolist(), int(tops[i])))
    return dips.at_no_turn(np.delete(every, list(taken)), turns)


def _times_around(
    t: FloatArray, first: int, k: int, last: int, width: int, count: int
) -> FloatArray:
    """Sampling times around the sample ``k``: ``width`` intervals on either side with ``count``
    samples each, and the samples ``first`` and ``last``."""
    nodes = t[max(first, k - width) : min(last, k + width) + 1]
    fractions = np.arange(count) / count
    inner = (nodes[:-1, None] + np.diff(nodes)[:, None] * fractions).ravel()
    outer = [t[[first]], inner, nodes[-1:], t[[last]]]
    return np.unique(np.concatenate(outer))


def _minima(values: FloatArray, scale: float) -> list[tuple[int, int, int]]:
    """Indices of the minima inside ``values``, each with those on both sides where it is left.

    Small minima between the same sides are one: dense output is rough where steps are tiny.
    ``scale``: the largest value of the window.
    """
    level = max(DEPARTED_VALUE * scale, LEAST_DEPARTED)
    found: dict[tuple[int, int], int] = {}
    for k in np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] < values[2:])) + 1:
        first, last = k - 1, k + 1
        while first > 0 and values[first] < level:
            first -= 1
        while last < len(values) - 1 and values[last] < level:
            last += 1
        sides = int(first), int(last)
        if sides not in found or values[k] < values[found[sides]]:
            found[sides] = int(k)
    return [(first, k, last) for (first, last), k in found.items()]


def _rank_loss_cosine(
    monitor: ConstraintMonitor, time: float, certain: bool, before: float, after: float
) -> float | None:
    """Cosine between the parts of G that lose rank at ``time``, as they are ``before`` and
    ``after`` it (s).

    -1 if the motion passed through, 1 if it turned back or passed by, in between if it departed on
    another branch.  None if G does not lose rank: unless it is ``certain`` that it does, a singular
    configuration must lie close to the motion, compared with how far that moves.
    """
    geometry = monitor.geometry
    G, G_before, G_after = monitor.normalised(np.array([time, before, after]))
    if not certain:
        q, q_before, q_after = (monitor.place(t) for t in (time, before, after))
        found = monitor.counted_singular(time)
        if found is None:
            found = nearest_singular(geometry, q, monitor.rank, CROSSING_SEARCH)
        if found is None:
            return None
        moved = np.linalg.norm(geometry.difference(q_before, q_after))
        if not np.linalg.norm(geometry.difference(q, found)) < CLOSE_DISTANCE * moved:
            return None
        G = geometry.normalised(found)
    # Rows that are zero in all of them have no part.
    active = np.logical_or.reduce(active_rows(np.array([G, G_before, G_after])))
    if not active.all():
        G, G_before, G_after = (rows[active] for rows in (G, G_before, G_after))
    left, right = monitor.near_null_spaces(G, active)
    a, b = ((left.T @ other @ right).ravel() for other in (G_before, G_after))
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def _step_at(steps: StepData, time: float) -> int:
    return min(max(int(steps.times.searchsorted(time)) - 1, 0), steps.count - 1)


def _along_curve(steps: StepData, time: float) -> bool:
    """Whether the motion at ``time`` (s) was followed along the curve of closed configurations."""
    return bool(steps.placements[_step_at(steps, time)] == CRITICAL)


def _crossings_along_curves(monitor: ConstraintMonitor, steps: StepData) -> list[Crossing]:
    """The passages that were followed along the curve of closed configurations.

    Steps of regular motions may follow a curve too, beside a critical configuration far away.
    """
    found = []
    for first, last in steps.critical_ranges:
        lowest = first + int(np.argmin(steps.sigmas[first:last, -1]))
        time = float(steps.times[lowest + 1])
        before, after = steps.times[lowest], steps.times[min(lowest + 2, steps.count)]
        if monitor.geometry.drives:
            # Where a drive turns back sigma is flat, and the ends of steps are far apart.
            around = steps.times[max(lowest - 1, 0)], after
            time = _closest(monitor, np.linspace(*around, SAMPLES))
        critical = monitor.critical(time)
        if critical is None:
            if monitor.is_regular(time, (before, after)):
                continue
            # The steps around it may have their ends too far from it to lead there.
            time = _closest(monitor, np.linspace(before, after, SAMPLES))
            critical = monitor.critical(time)
        if critical is None:
            continue
        beside = 0.25 * float(steps.times[last] - steps.times[first])
        kind = "avoided" if monitor.follows(critical) else "passed"
        if kind == "passed" or steps.sigmas[lowest, -1] < AVOIDED_SIGMA:
            found.append(crossing_at(monitor, steps, time, beside, kind))
    return found


def _resolved_dips(sigma: FloatArray, dips: RecordedDips | None) -> list[int]:
    """Indices of the minima of the recorded ``sigma`` (k,) below AVOIDED_SIGMA, but for those of
    ``dips`` at turns."""
    inner = sigma[1:-1]
    lowest = (inner <= sigma[:-2]) & (inner < sigma[2:]) & (inner < AVOIDED_SIGMA)
    for first, _, last in [] if dips is None else dips.at_turns.tolist():
        lowest[first : last - 1] = False
    return (np.flatnonzero(lowest) + 1).tolist()


def _where_low(sigma: FloatArray, k: int) -> tuple[int, int]:
    """First and last sample next to the minimum ``k`` of ``sigma`` (n,) up to which it stays low.

    The minimum of the singular value lies between them: sigma depends on the inertias as well."""
    least, most = DIP_WIDTHS[-1], SAMPLES_AROUND
    high = sigma > LOW_SIGMA * sigma[k]
    before, after = high[max(k - most, 0) : k][::-1], high[k + 1 : k + 1 + most]
    widths = (int(side.argmax()) + 1 if side.any() else len(side) for side in (before, after))
    left, right = (max(width, least) for width in widths)
    return max(k - left, 0), min(k + right, len(sigma) - 1)


def _avoided_by_steps(
    monitor: ConstraintMonitor,
    steps: StepData,
    t: FloatArray,
    sigma: FloatArray,
    dips: Sequence[int],
    listed: Collection[float],
) -> list[Crossing]:
    """The critical configurations that the motion of a driven mechanism avoided at the ``dips``,
    samples of the recorded ``sigma`` (k,) at t (k,) s, next to which no passage is ``listed`` (s).

    Where a drive turns back, steps may resolve a layer that others follow along the curve.
    """
    found: list[Crossing] = []
    known = sorted(listed)
    width = DIP_WIDTHS[-1]

    def is_known(first: float, last: float) -> bool:
        after = bisect_left(known, first)
        return after < len(known) and known[after] <= last

    for k in dips:
        first, last = float(t[max(k - width, 0)]), float(t[min(k + width, len(t) - 1)])
        if is_known(first, last) or _along_curve(steps, t[k]):
            continue
        beside = 0.25 * (last - first)
        low, high = _where_low(sigma, k)
        times = np.linspace(t[low], t[high], SAMPLES)
        values = monitor.smallest(times)
        minima = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] < values[2:])) + 1
        if not len(minima):
            continue
        lowest = int(minima[np.abs(times[minima] - t[k]).argmin()])
        near = slice(lowest - 1, lowest + 2)
        time = monitor.minimum(times[near], values[near])
        if is_known(time - beside, time + beside) or not monitor.avoids(time):
            continue
        found.append(crossing_at(monitor, steps, time, beside, "avoided"))
        insort(known, time)
    return found


def _placement(steps: StepData, i: int) -> str:
    if steps.placements[i] == CRITICAL:
        return STEP_PLACEMENTS[CRITICAL]
    # At the end of a step the next one's stages may be those that came too close.
    if any(k in steps.zones for k in (i - 1, i, i + 1)):
        return "zone"
    here = STEP_PLACEMENTS[int(steps.placements[i])]
    # Placing may shorten the step before, so that the next one passes in the middle.
    return here or (STEP_PLACEMENTS[int(steps.placements[i - 1])] if i else "")


def crossing_at(
    monitor: ConstraintMonitor, steps: StepData, time: float, beside: float, kind: str = "passed"
) -> Crossing:
    """The crossing of a run at ``time`` (s), whose velocity is taken ``beside`` (s) it."""
    i = _step_at(steps, time)
    return Crossing(
        time,
        float(steps.sigmas[i, 0]),
        float(steps.sigmas[i].min()),
        int(steps.ranks[i]),
        _placement(steps, i),
        kind,
        monitor,
        beside,
        (float(steps.times[0]), steps.end),
    )


def find_crossings(
    system: System,
    scheme: ButcherTableau,
    steps: StepData,
    monitored: Callable[[], tuple[DenseOutput, float]],
    dips_of: Callable[[ButcherTableau, StepData], RecordedDips | None] = recorded_dips,
    turns_of: Callable[..., RecordedDips] = recorded_turns,
    critical_of: Callable[[ConstraintMonitor, float], CriticalPlace | None] = critical_near,
) -> tuple[Crossing, ...]:
    """All crossings of a run, in order of time.

    Parameters
    ----------
    monitored
        Returns its dense output, which runs that stay away from singular configurations do not
        need, and the residual (row units) up to which a critical configuration counts as singular.
    dips_of, turns_of, critical_of
        :func:`recorded_dips`, :func:`recorded_turns` and :func:`critical_near`, or the kernel's.
    """
    analysis = system.singularities
    if analysis is None or not steps.count:
        return ()

    @cache
    def made() -> ConstraintMonitor:
        return ConstraintMonitor(analysis, *monitored(), critical_of)

    if analysis.sigma_reference >= SMALL_REFERENCE_PIVOT:
        recorded = dips_of(scheme, steps)
    else:
        t, _ = _recorded(scheme, steps)
        values = made().smallest(t)
        recorded = _dips(t, values / np.median(values), scheme.n_stages)
    if recorded is not None and recorded.turns is None:
        recorded = turns_of(made(), scheme, steps, recorded)
    resolved: list[int] = []
    if recorded or analysis.driven:
        t, sigma = _recorded(scheme, steps)
        resolved = _resolved_dips(sigma, recorded) if analysis.driven else []
    if not (recorded or steps.critical_ranges or resolved):
        return ()
    monitor, searches = made(), []
    if recorded:
        searches = [
            _crossings_at(monitor, steps, t, sigma, dip, top, slice(*free))
            for dip, top, free in zip(
                recorded.samples.tolist(), recorded.tops.tolist(), recorded.free(len(t)).tolist()
            )
        ]
        searches += [_crossings_beside(monitor, steps, t, turn) for turn in recorded.turns or ()]
    found: dict[float, Crossing] = {}
    for crossings in (*monitor.together(searches), _crossings_along_curves(monitor, steps)):
        for crossing in crossings:
            found.setdefault(crossing.time, crossing)
    for earlier, later in pairwise(sorted(found)):
        if later - earlier < SAME_PASSAGE * found[later]._beside:
            del found[later]
    if resolved:
        for crossing in _avoided_by_steps(monitor, steps, t, sigma, resolved, found):
            found[crossing.time] = crossing
    return tuple(found[time] for time in sorted(found))


def _crossings_at(
    monitor: ConstraintMonitor,
    steps: StepData,
    t: FloatArray,
    sigma: FloatArray,
    dip: Sequence[int],
    top: int,
    free: slice,
) -> Search[list[Crossing]]:
    """The crossings at a minimum of the recorded ``sigma`` (k,), the second of the samples ``dip``.

    ``dip``, ``top``, where sigma of the window is largest, and ``free``, the samples that belong to
    no other minimum, are indices into t (k,).
    """
    first, k, last = dip
    times = t[sorted({first, max(first, k - 1), k, min(k + 1, last), last})]
    if len(times) == 2:  # an interval alone shows no slope from which it could differ
        times = np.insert(times, 1, times.mean())
    values = yield np.concatenate([times, t[[top]]])
    scale, values = float(values[-1]), values[:-1]  # that of the window, about the largest
    if _lowest_between(times, values) >= MINIMUM_DEPTH * values.max():
        return []  # sigma has it alone, as where the order of its pivots changes
    minima, lowest = _minima(values, max(scale, float(values.max()))), None
    if len(minima) == 1:
        near = slice(minima[0][1] - 1, minima[0][1] + 2)
        lowest = yield from _minimum(times[near], values[near])
        if not _vanishes_once(times[near], values[near], lowest, scale):
            lowest = None
    if lowest is None:
        # The widest has the samples of the others.  Stages are less accurate than dense output,
        # whose minimum may lie beyond the sides that they show.
        widest = DIP_WIDTHS[-1]
        windows = [(first, last, width) for width in (DIP_WIDTHS if minima else (widest,))]
        for left, right, width in (*windows, (free.start, free.stop - 1, widest)):
            times = _times_around(t, left, k, right, width, SAMPLES_PER_INTERVAL)
            values = yield times
            minima = _minima(values, max(scale, float(values.max())))
            if minima:
                break
    found = []
    for minimum in minima:
        crossing = yield from _crossing_at(monitor, steps, minimum, scale, times, values, lowest)
        if crossing is not None:
            found.append(crossing)
    return found + (
        yield from _hidden_crossings(monitor, steps, found, scale, t[free], sigma[free])
    )


def _crossings_beside(
    monitor: ConstraintMonitor, steps: StepData, t: FloatArray, turn: Turn
) -> Search[list[Crossing]]:
    """The two crossings next to a ``turn`` beyond a singular configuration; t (k,) s of the
    recorded samples."""
    (before, rest, after), (_, value, _) = turn.times, turn.values
    scale = float((yield t[[turn.top]])[0])
    found = []
    for side, size in ((before, turn.values[0]), (after, turn.values[2])):
        # Next to the turn values are parabolic in time.
        part = math.sqrt(value / (value - size)) * BESIDE_TURN
        times = np.sort(np.append(rest + (side - rest) * np.append(0.0, part[part < 1.0]), side))
        values = yield times
        k = 1 + int(values[1:-1].argmin())
        crossing = yield from _crossing_at(
            monitor, steps, (0, k, len(times) - 1), scale, times, values
        )
        if crossing is not None:
            found.append(crossing)
    return found


def _vanishes_once(
    t: FloatArray, values: FloatArray, lowest: tuple[float, float], scale: float
) -> bool:
    """Whether the singular value with three samples at t (3,), values (3,) there, and the
    ``lowest`` one between vanishes as it does at a single crossing: proportional to time."""
    time, value = lowest
    if not (value < SINGULAR_VALUE * scale and t[0] < time < t[2]):
        return False
    slopes = float(values[0]) / (time - float(t[0])), float(values[2]) / (float(t[2]) - time)
    return max(slopes) < SLOPE_MARGIN * min(slopes)


def _crossing_at(
    monitor: ConstraintMonitor,
    steps: StepData,
    minimum: tuple[int, int, int],
    scale: float,
    times: FloatArray,
    values: FloatArray,
    lowest: tuple[float, float] | None = None,
) -> Search[Crossing | None]:
    """The crossing at a ``minimum`` of the ``values`` (n,) at ``times`` (n,), from
    :func:`_minima`; None if it is none.  ``lowest``: its time and value, if they are known."""
    first, k, last = minimum
    near = slice(k - 1, k + 2)
    before, after = float(times[first]), float(times[last])
    sides = values[[first, last]]
    if not _lowest_between(times[near], values[near]) < MINIMUM_DEPTH * sides.min():
        return None
    time, value = lowest or (yield from _minimum(times[near], values[near]))
    if not value < MINIMUM_DEPTH * sides.min() or _along_curve(steps, time):
        return None
    certain = value < SINGULAR_VALUE * scale
    kind = "passed"
    if not certain and monitor.avoids(time):
        kind = "avoided"
        if monitor.geometry.drives:  # a drive may turn back there
            turned = yield from _minimum(times[near], values[near], power=1)
            time, value = min((time, value), turned, key=lambda found: found[1])
    # A motion that reaches a singular configuration passes or touches it: both are listed.
    elif not value <= TOUCHING_VALUE * scale:
        cosine = _rank_loss_cosine(monitor, time, certain, before, after)
        if cosine is None:
            return None
        if cosine > TURNED_BACK_COSINE:
            time, value = yield from _minimum(times[near], values[near], power=1)
            if value > TOUCHING_VALUE * scale:
                if not monitor.avoids(time):
                    return None
                kind = "avoided"
    slope = float(max(sides[0] / (time - before), sides[1] / (after - time)))
    return crossing_at(monitor, steps, time, VELOCITY_VALUE * scale / slope, kind)


def _hidden_crossings(
    monitor: ConstraintMonitor,
    steps: StepData,
    found: list[Crossing],
    scale: float,
    t: FloatArray,
    sigma: FloatArray,
) -> Search[list[Crossing]]:
    """The crossings next to those ``found`` that the samples ``sigma`` (k,) at t (k,) do not show:
    of motions that turn back beyond the singular configuration, and pass it twice."""
    hidden = []
    for crossing in found:
        if crossing.kind != "passed" or not (yield from _may_turn(crossing.time, t, sigma)):
            continue
        for zero in (yield from _sign_changes(monitor, crossing.time, scale, t)):
            away = HIDDEN_WITHIN * abs(zero - crossing.time)
            times = np.array([max(zero - away, t[0]), zero, min(zero + away, t[-1])])
            if times[0] < zero < times[-1]:
                values = yield times
                other = yield from _crossing_at(monitor, steps, (0, 1, 2), scale, times, values)
                if other is not None:
                    hidden.append(other)
    return hidden


def _nearest_samples(time: float, t: FloatArray) -> tuple[int, int]:
    """Indices into t (k,) of the last sample before and the first after ``time`` (s), but for one
    that is next to it."""
    after = int(t.searchsorted(time))
    before = after - 1
    if 0 < after < len(t):
        shortest = NEXT_TO_SAMPLE * (t[after] - t[before])
        if t[after] - time < shortest:
            after += 1
        elif time - t[before] < shortest:
            before -= 1
    return max(before, 0), min(after, len(t) - 1)


def _may_turn(time: float, t: FloatArray, sigma: FloatArray) -> Search[bool]:
    """Whether the motion may turn back next to a crossing at ``time`` (s).

    Where it does not, the singular value is in proportion to the time from the crossing up to the
    samples next to it, and ``sigma`` (k,) at t (k,) is about so beyond them.
    """
    nearest = _nearest_samples(time, t)
    if not t[nearest[0]] < time < t[nearest[1]]:
        return False  # at an end of the run
    before, after = nearest
    least = LEAST_SLOPE * max(float(sigma[i]) / abs(float(t[i]) - time) for i in nearest)
    for outward in (
        range(before, max(before - SAMPLES_AROUND, -1), -1),
        range(after, min(after + SAMPLES_AROUND, len(t))),
    ):
        for i in outward:
            if sigma[i] < least * abs(float(t[i]) - time):
                return True
            if sigma[i] > FAR_SIGMA:
                break
    values = yield np.concatenate([time + (t[i] - time) * STRAIGHT_AT for i in nearest])
    parts = values.reshape(2, -1) / STRAIGHT_AT
    return not bool((parts.max(axis=1) < SLOPE_MARGIN * parts.min(axis=1)).all())


def _sign_changes(
    monitor: ConstraintMonitor, time: float, scale: float, t: FloatArray
) -> Search[list[float]]:
    """About when (s), next to a crossing at ``time``, the part of G that loses rank there is zero
    again; t (k,): the recorded samples."""
    from scipy.optimize import brentq

    before, after = _nearest_samples(time, t)
    times = np.concatenate(
        [
            t[max(before - SAMPLES_AROUND, 0) : before][::-EVERY][::-1],
            time + (t[before] - time) * TURN_AT[::-1],
            time + (t[after] - time) * TURN_AT,
            t[after + 1 : after + 1 + SAMPLES_AROUND][::EVERY],
        ]
    )
    G = monitor.normalised(np.concatenate([[time], times]))
    active = np.logical_or.reduce(active_rows(G))
    left, right = monitor.near_null_spaces(G[0, active], active)
    parts = (left.T @ G[1:, active] @ right).reshape(len(times), -1)
    reference = parts[times.searchsorted(t[after])]
    along = parts @ reference
    signed = np.abs(along) > ROUNDED_PART * np.abs(along).max()
    times, along = times[signed], along[signed]

    def part(at: float) -> float:
        own = left.T @ monitor.normalised(np.array([at]))[0, active] @ right
        return float(own.ravel() @ reference)

    changes = np.flatnonzero(along[:-1] * along[1:] < 0.0).tolist()
    if len(changes) < 2:
        return []
    # Where the singular value is largest between two zeros.
    tops = [int(np.abs(along[a + 1 : b + 1]).argmax()) + a + 1 for a, b in pairwise(changes)]
    beyond = (yield times[tops]) > UNTOUCHED_VALUE * scale
    real = np.append(beyond, False) | np.append(False, beyond)
    return [
        float(brentq(part, times[k], times[k + 1], xtol=ROOT_TOLERANCE * (times[k + 1] - times[k])))
        for k, is_real in zip(changes, real)
        if is_real and not times[k] <= time <= times[k + 1]
    ]


def _lowest_between(t: FloatArray, values: FloatArray) -> float:
    """Lowest of the ``values`` (k,) between samples at t (k,), with a margin for curvature."""
    samples = list(pairwise(zip(t.tolist(), values.tolist())))
    steepest = max(abs(after - before) / (b - a) for (a, before), (b, after) in samples)
    longest = max(b - a for (a, _), (b, _) in samples)
    lowest: float = values.min() - SLOPE_MARGIN * steepest * longest
    return lowest


@dataclass(frozen=True)
class Bifurcation:
    """A singular configuration that a run reached without the momentum to choose a branch.

    Attributes
    ----------
    start, end
        Time (s) at which the motion came so close, and left or ended.
    distance
        Smallest distance to the singular configuration (rad, scene diagonals).
    stopped
        Whether the run ended there because it could not continue.
    """

    start: float
    end: float
    distance: float
    stopped: bool
    _crossing: Crossing = field(repr=False, compare=False)

    @property
    def singular(self) -> SingularConfiguration | None:
        """Its local analysis; None if none was found close to the motion."""
        return self._crossing.singular

    @property
    def driven(self) -> bool:
        """Whether the drives alone determine the motion, whatever its momentum."""
        monitor = self._crossing._monitor
        return bool(monitor.geometry.model.nv == monitor.rank)

    @property
    def configuration(self) -> FloatArray | None:
        """The singular configuration (nq,)."""
        return self._crossing.configuration

    @property
    def loops(self) -> tuple[str, ...]:
        """Names of the loops whose rows lose rank there."""
        return self._crossing.loops

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the drives whose rows do so with them."""
        return self._crossing.drives

    @property
    def branches(self) -> FloatArray:
        """Velocity directions (k, nv) of the branches that meet there; see
        :attr:`~srm_mbs.integration.singular_passages.Crossing.branches`."""
        return self._crossing.branches

    @property
    def kept(self) -> int | None:
        """Index in ``branches`` of the branch that the run came along and kept; None if
        unknown."""
        return self._crossing.arrived_on

    def __str__(self) -> str:
        span = f"From t = {time_text(self.start)} to {time_text(self.end)} s the motion stayed"
        moment = f"At t = {time_text(self.start)} s the motion turned back"
        kept = "" if self.kept is None else f", number {self.kept}"
        did = "stopped there" if self.stopped else f"kept the one it came along{kept}"
        number = f"{len(self.branches)} " if len(self.branches) else ""
        meet = f"without the momentum to choose one of the {number}branches that meet there"
        if self.driven:
            meet = f"where {number}branches meet"
        return (
            f"{span if self.end > self.start else moment} next to a singular "
            f"configuration of {self._crossing.participants} {meet}: the run {did} "
            "(solution.bifurcations)"
        )


def _ranges(marked: list[int], steps: StepData) -> list[tuple[int, int]]:
    """First and last of the ``marked`` steps between which sigma stays small."""
    out: list[tuple[int, int]] = []
    for i in marked:
        if out and steps.sigmas[out[-1][1] : i + 1].max() < REVERSAL_SIGMA:
            out[-1] = (out[-1][0], i)
        else:
            out.append((i, i))
    return out


def _closest(monitor: ConstraintMonitor, t: FloatArray) -> float:
    """Time (s) within t (SAMPLES,) at which the smallest singular value is smallest."""
    sigma = monitor.smallest(t)
    k = int(np.argmin(sigma))
    if 0 < k < SAMPLES - 1:
        return monitor.minimum(t[k - 1 : k + 2], sigma[k - 1 : k + 2])
    return float(t[k])


def _reversal_time(monitor: ConstraintMonitor, t: FloatArray) -> float:
    """Time (s) within t (k,) at which the motion turns back."""
    from scipy.optimize import brentq

    unit = monitor.geometry.coordinate_unit

    def rates(times: FloatArray) -> FloatArray:
        return np.array([v for _, v in monitor.states(times)]) / unit

    ends = rates(t[[0, -1]])
    direction = ends[0] - ends[1]

    def along(time: float) -> float:
        return float(rates(np.array([time]))[0] @ direction)

    values = rates(t) @ direction
    changes = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    if not len(changes):
        return float(t[np.argmin(np.abs(values))])
    k = int(changes[0])
    return float(brentq(along, t[k], t[k + 1], xtol=1e-12 * (t[-1] - t[0]), rtol=1e-15))


def _turns_back_there(monitor: ConstraintMonitor, steps: StepData, i: int) -> bool:
    """Whether the motion that turns back in step ``i`` does so at rest on a singular
    configuration."""
    t = np.linspace(steps.times[i], min(steps.times[i + 1], steps.end), SAMPLES)
    time = _reversal_time(monitor, t)
    if monitor.smallest(np.array([time]))[0] > UNDECIDED_VALUE:
        return False
    rates = [monitor.geometry.rates(v) for _, v in monitor.states(np.array([t[0], time, t[-1]]))]
    first, there, last = (np.linalg.norm(u[: monitor.geometry.model.nv]) for u in rates)
    if there > RESTING_SPEED * max(first, last):
        return False
    q = monitor.place(time)
    found = nearest_singular(monitor.geometry, q, monitor.rank, BIFURCATION_SEARCH)
    if found is None:
        return False
    distance = np.linalg.norm(monitor.geometry.difference(found, q))
    return bool(distance < UNDECIDED_DISTANCE)


def find_bifurcations(
    system: System,
    steps: StepData,
    dense: Callable[[], DenseOutput],
    failed: bool,
) -> tuple[Bifurcation, ...]:
    """The singular configurations that a run reached without momentum, in order of time.

    Parameters
    ----------
    dense
        Makes the dense output, which most runs do not need for this.
    failed
        Whether the run could not continue from its last state.
    """
    analysis = system.singularities
    if analysis is None or not steps.count:
        return ()
    # The reductions themselves: their methods cost more than they do in a short run.
    near = np.minimum.reduce(steps.sigmas, axis=None) < REVERSAL_SIGMA
    if not (near or np.logical_or.reduce(steps.held)):
        return ()
    held, last = steps.held > 0.0, steps.count - 1
    close = steps.sigmas.min(axis=1) < REVERSAL_SIGMA
    v = steps.states[:, len(analysis.q0) :] / analysis.coordinate_unit
    speeds = np.linalg.norm(v, axis=1)
    reverses = (v[:-1] * v[1:]).sum(axis=1) <= 0.0
    slow = speeds[1:] <= WITHOUT_MOMENTUM * speeds.max()
    rests = slow & (steps.sigmas.max(axis=1) < RESTING_SIGMA)
    # A run that cannot continue while it moves fails for another reason.
    stops = bool(failed and close[-1] and speeds[-1] <= WITHOUT_MOMENTUM * speeds.max())
    marked = held | rests
    marked[last] |= stops
    turning = np.flatnonzero(reverses & close & ~marked)
    if not (marked.any() or len(turning)):
        return ()
    found: list[Bifurcation] = []
    monitor = ConstraintMonitor(analysis, dense())
    for i in turning.tolist():
        marked[i] = _turns_back_there(monitor, steps, i)
    for first, final in _ranges(np.flatnonzero(marked).tolist(), steps):
        t = np.linspace(steps.times[first], min(steps.times[final + 1], steps.end), SAMPLES)
        stayed = bool(final > first or held[first] or rests[first])
        stopped = stops and final == last
        # A motion may pass and come back within the step: whether it had the momentum to pass
        # follows from the place of its reversal.
        closest = _closest(monitor, t) if stayed or stopped else _reversal_time(monitor, t)
        q = monitor.place(closest)
        singular = nearest_singular(monitor.geometry, q, monitor.rank, BIFURCATION_SEARCH)
        if singular is None:
            continue
        distance = float(np.linalg.norm(monitor.geometry.difference(singular, q)))
        begin, end = (float(t[0]), float(t[-1])) if stayed else (closest, closest)
        # The branch of arrival is determined where the motion was faster.
        crossing = crossing_at(monitor, steps, begin, float(t[-1] - t[0]) / (final + 1 - first))
        found.append(Bifurcation(begin, end, distance, stopped, crossing))
    return tuple(found)
