"""Motions that can be drawn: their elements over time, and their bodies at the key frames.

A run or a prescribed motion is a :class:`DrawableMotion`.  Actions of events change its closures
and forces, so each of these has :data:`ActiveIntervals`.  A :class:`BodyMotion` has the placements
of the bodies at the key frames of an animation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import get_logger
from srm_mbs.model.closures import LoopClosure

log = get_logger(__name__)

MAX_BODY_FRAMES = 30_000
"""Key frames of all bodies together; in a page one costs up to 90 bytes, so 2.7 MB at most."""
MIN_FPS = 10.0
"""Key frames per second below which the limit above is not kept: motion would look wrong."""
INTERPOLATION_TOLERANCE = 0.003
"""Largest distance of a body from its path between key frames, over the size of the motion; also
the largest angle (rad)."""
ACCURATE_PART = 0.98
"""Part of the intervals between key frames that keep the tolerance."""

ActiveIntervals = tuple[tuple[float, float], ...]
"""Disjoint intervals of time (s), in order: each includes its first time, not its last."""
Element = TypeVar("Element")


class DrawableMotion(Protocol):
    """A run or a prescribed motion: configurations of a mechanism over time."""

    @property
    def mechanism(self) -> Mechanism:
        """The mechanism, as it is at the start."""

    @property
    def span(self) -> tuple[float, float]:
        """Start and end (s)."""

    @property
    def segments(self) -> Sequence[DrawableMotion]:
        """Parts of the motion between the actions of events, in order; itself without any."""

    def __call__(self, t: Any) -> tuple[FloatArray, FloatArray]:
        """q (n, nq) and v (n, nv) at times ``t`` (n,) s."""


# Active intervals ---------------------------------------------------------------------------


def active_elements(
    motion: DrawableMotion, elements_of: Callable[[Mechanism], Iterable[Element]]
) -> list[tuple[Element, ActiveIntervals | None]]:
    """The elements of all segments of a motion, each once, with its active intervals.

    Parameters
    ----------
    motion
        The run or motion.
    elements_of
        Selects the elements of a mechanism, for example its closures.

    Returns
    -------
    list of (element, intervals)
        In order of first appearance; the intervals are None for an element that is always active.
    """
    segments = motion.segments
    if len(segments) == 1:
        return [(element, None) for element in elements_of(motion.mechanism)]
    found: list[tuple[Element, list[tuple[float, float]]]] = []
    for segment in segments:
        start, end = segment.span
        for element in elements_of(segment.mechanism):
            intervals = next(
                (own for other, own in found if other is element or other == element), None
            )
            if intervals is None:
                intervals = []
                found.append((element, intervals))
            goes_on = intervals and intervals[-1][1] == start
            intervals.append((intervals.pop()[0] if goes_on else start, end))
    whole = [(segments[0].span[0], segments[-1].span[1])]
    return [
        (element, None if intervals == whole else tuple(intervals)) for element, intervals in found
    ]


def active_closures(motion: DrawableMotion) -> list[tuple[LoopClosure, ActiveIntervals | None]]:
    """The closures of a motion with their active intervals (:func:`active_elements`)."""
    return active_elements(motion, lambda mechanism: mechanism.loops)


def active_at(times: FloatArray, intervals: ActiveIntervals | None, end: float) -> BoolArray:
    """Which of ``times`` (n,) s are in ``intervals``; an interval up to the ``end`` (s) of the
    motion includes it."""
    if intervals is None:
        return np.ones(len(times), dtype=bool)
    inside = np.zeros(len(times), dtype=bool)
    for first, last in intervals:
        inside |= (first <= times) & ((times < last) | (last >= end))
    return inside


# Placements at key frames -------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """Placements of the bodies at the key frames.

    Attributes
    ----------
    joints
        Indices of the joints that carry the bodies, k of them.
    times : (n,) s
        From the start to the end of the motion, uniform except for requested extra times; one only
        if the motion has no duration.
    positions : (n, k, 3) m
        Origins of the joint frames in the world.
    quaternions : (n, k, 4)
        Their rotations, (x, y, z, w), of continuous sign.
    parts
        Into how many each interval of the requested key frames is divided for the fastest body.
    """

    joints: tuple[int, ...]
    times: FloatArray
    positions: FloatArray
    quaternions: FloatArray
    parts: int = 1

    @property
    def rate(self) -> float:
        """Key frames per second; 1 if there is only one."""
        if len(self.times) == 1:
            return 1.0
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0]))

    @property
    def frames(self) -> list[float]:
        """``times`` in units of 1/:attr:`rate` from the start: 0, 1, 2 ... if they are uniform."""
        numbers = ((self.times - self.times[0]) * self.rate).round(6).tolist()
        return [int(number) if number.is_integer() else number for number in numbers]

    def needed_frames(self, rows: FloatArray) -> BoolArray:
        """Which key frames (n,) are needed of a body that moves by ``rows``: the requested ones,
        and as many between them as :data:`INTERPOLATION_TOLERANCE` demands.

        Parameters
        ----------
        rows : (n, 3) m or (n, 4)
            Its positions, or quaternions of continuous sign.
        """
        numbers = np.array(self.frames)
        whole = numbers == np.round(numbers)
        size = float(np.ptp(self.positions.reshape(-1, 3), axis=0).max(initial=0.0)) or 1.0
        strides = [s for s in range(self.parts, 1, -1) if self.parts % s == 0]
        for stride in strides:
            kept: BoolArray = ~whole | (numbers % stride == 0)
            between = np.column_stack(
                [np.interp(numbers, numbers[kept], column[kept]) for column in rows.T]
            )
            off = np.linalg.norm(between - rows, axis=1)
            # A small angle is twice the distance of unit quaternions.
            if (2.0 * off if rows.shape[1] == 4 else off / size).max() <= INTERPOLATION_TOLERANCE:
                return kept
        return np.ones(len(numbers), dtype=bool)

    def path(self, joint: int, placement: pin.SE3) -> FloatArray:
        """Positions (n, 3) m in the world of a point fixed to a joint (0: the ground)."""
        from scipy.spatial.transform import Rotation

        offset = np.array(placement.translation)
        if joint == 0:
            return np.tile(offset, (len(self.times), 1))
        k = self.joints.index(joint)
        turned = Rotation.from_quat(self.quaternions[:, k]).apply(offset)
        return np.asarray(self.positions[:, k] + turned)

    def placement(self, joint: int, frame: int) -> pin.SE3:
        """Placement in the world of a joint frame (0: the ground) at a key frame."""
        if joint == 0:
            return pin.SE3.Identity()
        k = self.joints.index(joint)
        rotation = pin.Quaternion(self.quaternions[frame, k]).matrix()
        return pin.SE3(rotation, self.positions[frame, k])


def sample_motion(
    motion: DrawableMotion,
    joints: tuple[int, ...],
    fps: float,
    others: int = 0,
    extra: Iterable[float] = (),
) -> BodyMotion:
    """Forward kinematics of a motion at uniform times, and at ``extra`` ones.

    Parameters
    ----------
    motion
        The run, read by its dense output, or a prescribed motion.
    joints
        Indices of joints of its model.
    fps
        Requested key frames per second.  There are more where linear interpolation between them
        would leave the paths of the bodies (:data:`INTERPOLATION_TOLERANCE`), and fewer if all
        bodies together had more than :data:`MAX_BODY_FRAMES`, but at least the smaller of
        :data:`MIN_FPS` and ``fps``.
    others
        Number of other animated nodes that have as many key frames.
    extra
        Times (s) in the motion that get key frames of their own.
    """
    start, end = motion.span
    duration = end - start
    wanted = duration * fps * (1.0 - 1e-12)  # rounding must not add one to a whole number
    count = max(1, len(joints) + others)
    allowed = max(MAX_BODY_FRAMES // count, math.ceil(min(MIN_FPS, fps) * duration))
    intervals = math.ceil(min(wanted, allowed))
    sampled, needed = _sampled(motion, joints, np.linspace(start, end, intervals + 1))
    parts = 1  # each interval is divided into as many parts: the requested key frames stay
    while intervals and parts < (more := min(math.ceil(needed / intervals), allowed // intervals)):
        parts = more
        times = np.linspace(start, end, parts * intervals + 1)
        sampled, needed = _sampled(motion, joints, times)
    sampled = replace(sampled, parts=parts)
    if max(wanted, needed) > allowed:
        log.info(
            "%d bodies over %g s: %.3g key frames per second instead of %.3g",
            count,
            duration,
            sampled.rate,
            max(wanted, needed) / duration,
        )
    times = sampled.times
    apart = [t for t in extra if np.abs(times - t).min() * sampled.rate > 1e-6]
    if not apart:
        return sampled
    # Frames are numbered by a rate that the extra ones change: all are kept.
    return _sampled(motion, joints, np.union1d(times, apart))[0]


def _sampled(
    motion: DrawableMotion, joints: tuple[int, ...], times: FloatArray
) -> tuple[BodyMotion, int]:
    """Placements at ``times`` (n,) s, and the number of intervals that the tolerance needs."""
    model = motion.mechanism.model
    data = workspace(model)
    placements = np.empty((len(times), len(joints), 7))
    rates = np.empty((len(times), len(joints), 6))
    for i, (q, v) in enumerate(zip(*motion(times))):
        pin.forwardKinematics(model, data, q, v)
        for k, joint in enumerate(joints):
            placements[i, k] = pin.SE3ToXYZQUAT(data.oMi[joint])
            rates[i, k] = pin.getVelocity(model, data, joint, pin.LOCAL_WORLD_ALIGNED).vector
    quaternions = continuous_sign(placements[:, :, 3:])
    sampled = BodyMotion(joints, times, placements[:, :, :3], quaternions)
    excess = _interpolation_error(sampled, rates) / INTERPOLATION_TOLERANCE
    intervals = len(times) - 1
    # The error is quadratic in the length of short intervals.
    needed = math.ceil(intervals * min(math.sqrt(excess), 4.0)) if excess > 1.0 else intervals
    return sampled, needed


def continuous_sign(quaternions: FloatArray) -> FloatArray:
    """``quaternions`` (n, ..., 4) with signs so that each is closer to its predecessor: q and -q
    are the same rotation."""
    turns_back = np.sum(quaternions[1:] * quaternions[:-1], axis=-1, keepdims=True) < 0.0
    signs = np.cumprod(np.where(turns_back, -1.0, 1.0), axis=0)
    return np.concatenate([quaternions[:1], signs * quaternions[1:]])


def _interpolation_error(motion: BodyMotion, rates: FloatArray) -> float:
    """Error of linear interpolation between the key frames.

    The larger of distance over the size of the motion and angle (rad), at the quantile
    :data:`ACCURATE_PART` of the intervals, so that a single jolt does not ask for many frames.
    ``rates`` (n, k, 6) of the joint frames (m/s, rad/s, world axes) reveal rotations that key
    frames alias: one and a half turns between two of them look like half a turn.
    """
    from scipy.spatial.transform import Rotation

    if not rates[1:].size:
        return 0.0
    h = np.diff(motion.times)[:, None, None]
    places, quaternions = motion.positions, motion.quaternions
    size = float(np.ptp(places.reshape(-1, 3), axis=0).max())
    first, second = (
        Rotation.from_quat(q.reshape(-1, 4)) for q in (quaternions[:-1], quaternions[1:])
    )
    turned = (second * first.inv()).as_rotvec().reshape(len(h), -1, 3)
    chords = np.concatenate([np.diff(places, axis=0), turned], axis=2) / h
    # A cubic whose slopes at both ends differ from that of the chord by d deviates by h d / 4.
    off = 0.25 * h[:, :, 0, None] * np.maximum(abs(rates[:-1] - chords), abs(rates[1:] - chords))
    distances = np.linalg.norm(off[:, :, :3], axis=2) / (size or 1.0)
    turns = np.linalg.norm(off[:, :, 3:], axis=2)
    return float(np.quantile(np.maximum(distances, turns).max(axis=1), ACCURATE_PART))
