"""Singular passages of a run, found after the fact on its dense output.

The recorded sigmas tell between which stages sigma may have passed zero; where they are blunt, the
smallest singular values of the closures at the stages do.  There the smallest
singular value of the closures is followed on the dense output.  A minimum of it is a passage if the
part of G that loses rank changes sign across it, as it does when the motion goes through, or
changes altogether, when it leaves on another branch; a motion that turns back, or passes by, keeps
it.

Where a run came to a singular configuration without the momentum to pass it.

Several branches of the motion meet at a singular configuration, and momentum chooses one.  A
motion that comes to rest there, or turns back so close to it that its error could decide, has no
unique continuation.  The run keeps the branch it came along; what it could not know is listed here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.dynamics.constraints.geometry import geometry_of
from srm_mbs.dynamics.constraints.structure import BLUNT
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.dynamics.singularities.branches import branch_tangents
from srm_mbs.dynamics.singularities.local_analysis import (
    Participants,
    SingularConfiguration,
    analyse_singular,
    nearest_singular,
    participants,
    smallest_singular_value,
)
from srm_mbs.integration.dense_output import PLACEMENTS, DenseOutput, StepData
from srm_mbs.integration.methods.butcher import ButcherTableau

SLACK = 1.5
"""How much faster sigma may change between two stages than it was seen to change around them."""
NEAR_ZERO = 0.05
"""Part of the sigmas around that sigma must be able to reach between two stages."""
LINGERS = 0.05
"""sigma below which a motion is close to a singular configuration, wherever it comes from."""
SUBDIVISION = 4
"""Samples on the dense output per interval between two stages."""
LEFT_AT = 0.02
"""Part of the largest value of a window from which a minimum has been left."""
DEEP = 0.5
"""A minimum must be lower than this part of its neighbours."""
CERTAIN = 1e-5
"""Below this part of the values around, a minimum is at a singular configuration; above, one must
be found next to it."""
CLOSE = 0.2
"""How close, compared with the motion around the minimum."""
TURNED_BACK = 0.9
"""Cosine from which what is lost is the same before and after: the motion did not go through."""
TOUCHES = 1e-6
"""Below this part of the values around, it touched the singular configuration nevertheless."""
ALIKE = 2.0
"""Singular values up to this multiple of the smallest vanish with it."""
REFINEMENTS = 12
WITHIN = 0.3
"""How far (units) from the dense output the singular configuration is looked for."""
BESIDE = 0.05
"""Part of the values around at which the velocity is taken before and after a passage."""


class ConstraintMonitor:
    """The closures and drives along the dense output of a run."""

    def __init__(self, system: ClosedSystem, dense: DenseOutput) -> None:
        mechanism = system.mechanism
        self.geometry = geometry_of(mechanism, mechanism.q0)
        self.rank = mechanism.structure.rank
        self._system = system
        self._dense = dense

    def states(self, t: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """(q, v) at the times t (k,)."""
        return [self._system.split(state) for state in self._dense(t)]

    def place(self, t: float) -> FloatArray:
        """Configuration at t, as the geometry takes it."""
        return self.geometry.at(self.states(np.array([t]))[0][0], t)

    def smallest(self, t: FloatArray) -> FloatArray:
        """Last structural singular value of the normalised G at the times t (k,)."""
        geometry = self.geometry
        places = (geometry.at(q, time) for time, (q, _) in zip(t.tolist(), self.states(t)))
        return np.array([smallest_singular_value(geometry, x, self.rank) for x in places])

    def minimum(self, t: FloatArray, values: FloatArray) -> tuple[float, float]:
        """Time and value of the minimum bracketed by t (3,), values (3,) there.

        The square of the value is a parabola where the motion passes.
        """
        times, squares = t.tolist(), (values**2).tolist()
        for _ in range(REFINEMENTS):
            a, b, c = times
            fa, fb, fc = squares
            bend = (fc - fb) / (c - b) - (fb - fa) / (b - a)
            if not bend > 0.0:
                break
            slope = (fb - fa) / (b - a)
            new = 0.5 * (a + b) - 0.5 * slope * (c - a) / bend
            if not a < new < c or abs(new - b) <= 1e-10 * (c - a):
                break
            value = float(self.smallest(np.array([new]))[0]) ** 2
            left = new < b
            if value < fb:
                times = [a, new, b] if left else [b, new, c]
                squares = [fa, value, fb] if left else [fb, value, fc]
            else:
                times = [new, b, c] if left else [a, b, new]
                squares = [value, fb, fc] if left else [fa, fb, value]
        return times[1], float(np.sqrt(squares[1]))


@dataclass(frozen=True)
class Crossing:
    """A passage through a singular configuration.

    What is not in the constructor is computed when it is read.

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
        What kept the stages away: ``"a priori"`` (the step was shortened in advance), ``"redone"``
        (it was redone with another length), ``"zone"`` (a stage came too close and took the
        predicted multiplier) or ``""``.
    """

    time: float
    sigma_before: float
    sigma: float
    rank: int
    placement: str
    _watched: ConstraintMonitor = field(repr=False, compare=False)
    _beside: float = field(repr=False, compare=False)
    _range: tuple[float, float] = field(repr=False, compare=False)

    @cached_property
    def singular(self) -> SingularConfiguration | None:
        """The local analysis at the exactly singular configuration nearest to the passage; None
        if there is none close to it."""
        watched = self._watched
        found = nearest_singular(watched.geometry, watched.place(self.time), watched.rank, WITHIN)
        return None if found is None else analyse_singular(watched.geometry, found, watched.rank)

    @property
    def configuration(self) -> FloatArray | None:
        """That configuration (nq,)."""
        return None if self.singular is None else self.singular.q[: self._watched.geometry.model.nq]

    @cached_property
    def participants(self) -> Participants:
        """The rows that lose rank; that nearly do if there is no singular configuration, as where
        a drive leads almost up to its dead point."""
        if self.singular is not None:
            return self.singular.participants
        watched = self._watched
        left, size, _ = np.linalg.svd(watched.geometry.normalised(watched.place(self.time)))
        size = size[: watched.rank]
        return participants(watched.geometry, left[:, : watched.rank][:, size < ALIKE * size[-1]])

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
        """Rates (n,) in units, extrapolated to the passage from before and from behind."""
        out: list[FloatArray | None] = []
        for side in (-1.0, 1.0):
            times = self.time + side * self._beside * np.array([1.0, 2.0])
            if not (self._range[0] <= times.min() and times.max() <= self._range[1]):
                out.append(None)
                continue
            (_, near), (_, far) = self._watched.states(times)
            out.append(self._watched.geometry.rates(2.0 * near - far))
        return out[0], out[1]

    @cached_property
    def _tangents(self) -> FloatArray:
        """Directions (k, n) of the branches."""
        singular = self.singular
        if singular is None:
            return np.zeros((0, len(self._watched.geometry.unit)))
        arriving, leaving = self._velocities
        return branch_tangents(singular, leaving if arriving is None else arriving)

    @property
    def branches(self) -> FloatArray:
        """Velocity directions (k, nv) of the branches that meet there, of unit length in units.

        With more than one degree of freedom: on each branch the one nearest to the arriving
        velocity (:func:`srm_mbs.dynamics.singularities.branches.branch_tangents`).  Empty if they
        are not isolated; of a driven mechanism also where it has freedom besides its drives.
        """
        tangents = self._tangents[:, : self._watched.geometry.model.nv]
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
        """Index in ``branches`` of the branch before the passage; None if it cannot be told."""
        return self._branch_of(self._velocities[0])

    @cached_property
    def left_on(self) -> int | None:
        """Index in ``branches`` of the branch after the passage; None if it cannot be told."""
        return self._branch_of(self._velocities[1])

    @property
    def switched(self) -> bool:
        """Whether the run left on another branch than it arrived on."""
        before, after = self.arrived_on, self.left_on
        return before is not None and after is not None and before != after


def _recorded(abscissae: FloatArray, steps: StepData) -> tuple[FloatArray, FloatArray]:
    """Times and sigmas of the stages in order of time, each time once."""
    order = np.argsort(abscissae[1:], kind="stable") + 1
    h = np.diff(steps.times)
    t = (steps.times[:-1, None] + h[:, None] * abscissae[order]).ravel()
    sigma = steps.sigmas[:, order].ravel()
    step_of = np.repeat(np.arange(steps.count), len(order))
    t = np.concatenate([steps.times[:1], t])
    sigma = np.concatenate([steps.sigmas[0, :1], sigma])
    step_of = np.concatenate([[0], step_of])
    fresh = np.concatenate([[True], np.diff(t) > 1e-9 * h[step_of[1:]]])
    return t[fresh], sigma[fresh]


def _may_vanish(t: FloatArray, sigma: FloatArray, around: int) -> BoolArray:
    """Between which neighbouring samples (k - 1,) sigma may have come close to zero."""
    dt = np.diff(t)
    slope = np.abs(np.diff(sigma)) / dt
    widest = _largest(slope, around, around)
    size = _largest(sigma, around, around + 1)[:-1]
    lowest = 0.5 * (sigma[:-1] + sigma[1:] - SLACK * widest * dt)
    # A run that lingers next to a singular configuration takes steps far below its distance.
    lingers = np.minimum(sigma[:-1], sigma[1:]) < LINGERS
    out: BoolArray = (lowest < NEAR_ZERO * size) | lingers
    return out


def _largest(values: FloatArray, before: int, after: int) -> FloatArray:
    """The largest of each value (n,) and its neighbours, as far as there are any."""
    padded = np.pad(values, (before, after), constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, before + after + 1)
    out: FloatArray = windows.max(axis=1)
    return out


def _windows(t: FloatArray, marked: BoolArray) -> list[FloatArray]:
    """Sampling times of each run of marked intervals, one interval more on either side."""
    grown = marked.copy()
    grown[:-1] |= marked[1:]
    grown[1:] |= marked[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], grown.astype(int), [0]])))
    fractions = np.arange(SUBDIVISION) / SUBDIVISION
    out = []
    for first, last in zip(edges[::2], edges[1::2]):
        nodes = t[first : last + 1]
        times = nodes[:-1, None] + np.diff(nodes)[:, None] * fractions
        out.append(np.append(times.ravel(), nodes[-1]))
    return out


def _minima(values: FloatArray) -> list[tuple[int, int, int]]:
    """Indices of the minima inside ``values``, each with those on both sides where it is left.

    Small minima between the same sides are one: dense output is rough where steps are tiny.
    """
    level = max(LEFT_AT * float(values.max()), 1e-12)
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


def _turned(
    watched: ConstraintMonitor, time: float, certain: bool, before: float, after: float
) -> float | None:
    """Cosine between what G has lost at ``time`` as it is ``before`` and ``after``.

    -1 if the motion went through, 1 if it turned back or passed by, in between if it left on
    another branch.  None if nothing is lost: unless it is ``certain`` that it is, a singular
    configuration must lie close to the motion, compared with how far that moves.
    """
    geometry = watched.geometry
    q, q_before, q_after = (watched.place(t) for t in (time, before, after))
    if not certain:
        found = nearest_singular(geometry, q, watched.rank, WITHIN)
        if found is None:
            return None
        moved = np.linalg.norm(geometry.difference(q_before, q_after))
        if not np.linalg.norm(geometry.difference(q, found)) < CLOSE * moved:
            return None
        q = found
    left, size, right = np.linalg.svd(geometry.normalised(q))
    rank = int(np.sum(size > max(100.0 * size[watched.rank - 1], 1e-9)))
    a, b = (
        (left[:, rank:].T @ geometry.normalised(x) @ right[rank:].T).ravel()
        for x in (q_before, q_after)
    )
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def _placement(steps: StepData, i: int) -> str:
    # At the end of a step the next one's stages may be those that came too close.
    if any(k in steps.zones for k in (i - 1, i, i + 1)):
        return "zone"
    here = PLACEMENTS[int(steps.placements[i])]
    # Placing may shorten the step before, so that the next one passes in the middle.
    return here or (PLACEMENTS[int(steps.placements[i - 1])] if i else "")


def passage_at(watched: ConstraintMonitor, steps: StepData, time: float, beside: float) -> Crossing:
    """The passage of a run at ``time`` (s), whose velocity is taken ``beside`` (s) it."""
    i = int(np.clip(np.searchsorted(steps.times, time) - 1, 0, steps.count - 1))
    return Crossing(
        time,
        float(steps.sigmas[i, 0]),
        float(steps.sigmas[i].min()),
        int(steps.ranks[i]),
        _placement(steps, i),
        watched,
        beside,
        (float(steps.times[0]), steps.end),
    )


def find_crossings(
    system: OpenSystem | ClosedSystem,
    scheme: ButcherTableau,
    steps: StepData,
    dense: DenseOutput,
) -> tuple[Crossing, ...]:
    """All passages of a run, in order of time."""
    if not isinstance(system, ClosedSystem) or not steps.count:
        return ()
    abscissae = np.append(scheme.c, 1.0)
    t, sigma = _recorded(abscissae, steps)
    inside = t <= steps.end
    t, sigma = t[inside], sigma[inside]
    if len(t) < 3 or not np.isfinite(sigma).all():
        return ()
    watched = ConstraintMonitor(system, dense)
    if system.structure.sigma_ref < BLUNT:
        sigma = watched.smallest(t)
        sigma = sigma / np.median(sigma)
    found: list[Crossing] = []
    for times in _windows(t, _may_vanish(t, sigma, scheme.n_stages)):
        values = watched.smallest(times)
        scale = float(values.max())
        for first, k, last in _minima(values):
            near = slice(k - 1, k + 2)
            time, value = watched.minimum(times[near], values[near])
            before, after = float(times[first]), float(times[last])
            sides = values[[first, last]]
            if not value < DEEP * sides.min():
                continue
            turned = _turned(watched, time, value < CERTAIN * scale, before, after)
            if turned is None or (turned > TURNED_BACK and value > TOUCHES * scale):
                continue
            slope = float(max(sides[0] / (time - before), sides[1] / (after - time)))
            found.append(passage_at(watched, steps, time, BESIDE * scale / slope))
    return tuple(found)


LOOKED_AT = 0.02
"""sigma below which a motion that turns back is looked at."""
UNDECIDED = 100.0
"""Distance to the singular configuration (units), over rtol, below which errors could decide."""
SLOW = 0.01
"""Part of the largest speed of a run below which its end is without momentum."""
STANDSTILL_WITHIN = 0.05
"""How far (units) the singular configuration is looked for."""
SAMPLES = 21


@dataclass(frozen=True)
class Bifurcation:
    """A singular configuration that was reached without the momentum to choose a branch.

    Attributes
    ----------
    start, end
        Time (s) at which the motion came so close, and left or ended.
    distance
        Smallest distance to the singular configuration (rad, scene diagonals).
    stopped
        Whether the run ended there because it could not go on.
    """

    start: float
    end: float
    distance: float
    stopped: bool
    _passage: Crossing = field(repr=False, compare=False)

    @property
    def singular(self) -> SingularConfiguration | None:
        """Its local analysis; None if none was found close to the motion."""
        return self._passage.singular

    @property
    def configuration(self) -> FloatArray | None:
        """The singular configuration (nq,)."""
        return self._passage.configuration

    @property
    def loops(self) -> tuple[str, ...]:
        """Names of the loops whose rows lose rank there."""
        return self._passage.loops

    @property
    def drives(self) -> tuple[str, ...]:
        """Names of the drives whose rows do so with them."""
        return self._passage.drives

    @property
    def branches(self) -> FloatArray:
        """Velocity directions (k, nv) of the branches that meet there; see
        :attr:`~srm_mbs.integration.singular_passages.Crossing.branches`."""
        return self._passage.branches

    @property
    def kept(self) -> int | None:
        """Index in ``branches`` of the branch that the run came along and kept; None if it cannot
        be told."""
        return self._passage.arrived_on

    def __str__(self) -> str:
        span = f"From t = {self.start:.6g} to {self.end:.6g} s the motion stayed"
        moment = f"At t = {self.start:.6g} s the motion turned back"
        kept = "" if self.kept is None else f", number {self.kept}"
        did = "stopped there" if self.stopped else f"kept the one it came along{kept}"
        return (
            f"{span if self.end > self.start else moment} next to a singular "
            f"configuration of {self._passage.participants} without the "
            f"momentum to choose one of the {len(self.branches)} branches that meet there: the run "
            f"{did} (solution.bifurcations)"
        )


def _turns_back(nq: int, steps: StepData, unit: FloatArray) -> set[int]:
    """Indices of the steps next to a singular configuration in which the motion reverses."""
    v = steps.states[:, nq:] / unit
    reverses = (v[:-1] * v[1:]).sum(axis=1) <= 0.0
    close = steps.sigmas.min(axis=1) < LOOKED_AT
    return set(np.flatnonzero(reverses & close).tolist())


def _slow(nq: int, steps: StepData, unit: FloatArray) -> bool:
    """Whether the run ends slowly, compared with its fastest: one that cannot go on while it moves
    has another trouble than its momentum."""
    speeds = np.linalg.norm(steps.states[:, nq:] / unit, axis=1)
    return bool(speeds[-1] <= SLOW * speeds.max())


def _ranges(marked: list[int], steps: StepData) -> list[tuple[int, int]]:
    """First and last of the ``marked`` steps between which the motion does not get away."""
    out: list[tuple[int, int]] = []
    for i in marked:
        if out and steps.sigmas[out[-1][1] : i + 1].max() < LOOKED_AT:
            out[-1] = (out[-1][0], i)
        else:
            out.append((i, i))
    return out


def _closest(watched: ConstraintMonitor, t: FloatArray) -> float:
    """When, within the times t (SAMPLES,), sigma is smallest."""
    sigma = watched.smallest(t)
    k = int(np.argmin(sigma))
    if 0 < k < SAMPLES - 1:
        return watched.minimum(t[k - 1 : k + 2], sigma[k - 1 : k + 2])[0]
    return float(t[k])


def _turn(watched: ConstraintMonitor, t: FloatArray) -> float:
    """When, within the times t (k,), the motion turns back."""
    from scipy.optimize import brentq

    unit = watched.geometry.coordinate_unit

    def rates(times: FloatArray) -> FloatArray:
        return np.array([v for _, v in watched.states(times)]) / unit

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


def find_bifurcations(
    system: OpenSystem | ClosedSystem,
    steps: StepData,
    dense: DenseOutput,
    rtol: float,
    failed: bool,
) -> tuple[Bifurcation, ...]:
    """The singular configurations that a run reached without momentum, in order of time.

    Parameters
    ----------
    failed
        Whether the run could not go on from its last state.
    """
    if not isinstance(system, ClosedSystem) or not steps.count:
        return ()
    if not steps.held.any() and not steps.sigmas.min() < LOOKED_AT:
        return ()
    held = set(np.flatnonzero(steps.held).tolist())
    unit = system.mechanism.structure.units.coordinate
    turning = _turns_back(system.nq, steps, unit)
    last = steps.count - 1
    stops = failed and steps.sigmas[last].min() < LOOKED_AT and _slow(system.nq, steps, unit)
    marked = sorted(held | turning | ({last} if stops else set()))
    found: list[Bifurcation] = []
    if not marked:
        return ()
    watched = ConstraintMonitor(system, dense)
    for first, final in _ranges(marked, steps):
        t = np.linspace(steps.times[first], min(steps.times[final + 1], steps.end), SAMPLES)
        stayed = final > first or first in held
        stopped = bool(stops and final == last)
        # Where a motion turns back tells whether it had the momentum to pass: it may have passed
        # and come back within the step.
        closest = _closest(watched, t) if stayed or stopped else _turn(watched, t)
        q = watched.place(closest)
        singular = nearest_singular(watched.geometry, q, watched.rank, STANDSTILL_WITHIN)
        if singular is None:
            continue
        distance = float(np.linalg.norm(watched.geometry.difference(singular, q)))
        if not (stayed or stopped or distance < UNDECIDED * rtol):
            continue
        begin, end = (float(t[0]), float(t[-1])) if stayed else (closest, closest)
        # The way it came is told from where the motion was faster.
        passage = passage_at(watched, steps, begin, float(t[-1] - t[0]) / (final + 1 - first))
        found.append(Bifurcation(begin, end, distance, stopped, passage))
    return tuple(found)
