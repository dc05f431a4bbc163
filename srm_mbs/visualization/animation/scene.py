"""What there is to draw of a run: the bodies, their motion, what is beside them, and the view."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.visualization.animation.overlays import (
    OverlayOptions,
    Overlays,
    joints_of,
    make_overlays,
    springs_of,
    turns_between,
)
from srm_mbs.visualization.animation.shapes import Visual, visuals_of
from srm_mbs.visualization.animation.trajectory import loops_of, parts_of

if TYPE_CHECKING:
    from srm_mbs.visualization.animation.joint_motion import Playable

log = logging.getLogger(__name__)

MAX_BODY_FRAMES = 30_000
"""Key frames of all bodies together; in a page one costs up to 90 bytes, so 2.7 MB at most."""
MIN_FPS = 10.0
"""Key frames per second below which the limit above is not kept: motion would look wrong."""

BESIDE = 0.003
"""Largest distance of a body from its place between key frames, over the size of the motion."""
KEPT = 0.98
"""Part of the key frames that keep to it."""

FIELD_OF_VIEW = 25.0  # degrees, vertical: narrow, so that planar mechanisms look planar
ASPECT = 1.5  # width by height of the window that the picture is made for
FILLED = 0.84  # of the window
SMALLEST = 1e-9  # distance of the camera (m) below which there is nothing to see
SAMPLES = 300  # frames that are looked at to find the camera's place
FREE = ("JointModelFreeFlyer", "JointModelPlanar")
ALONG_FROM = 5.0
"""The picture goes along with a mechanism that is free in space and would be seen so many times
smaller if it stood still."""


# Motion -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Motion:
    """Placements of bodies over a run.

    Attributes
    ----------
    joints
        Indices of the joints that carry the bodies, k of them.
    times : (n,) s
        From the start to the end of the run, uniform but for those that were asked for; one only if
        the run has no length.
    positions : (n, k, 3) m
        Origins of the joint frames in the world.
    quaternions : (n, k, 4)
        Their rotations, (x, y, z, w), of continuous sign.
    """

    joints: tuple[int, ...]
    times: FloatArray
    positions: FloatArray
    quaternions: FloatArray

    @property
    def rate(self) -> float:
        """Key frames per second; 1 if there is only one."""
        if len(self.times) == 1:
            return 1.0
        return float((len(self.times) - 1) / (self.times[-1] - self.times[0]))

    @property
    def frames(self) -> list[float]:
        """``times`` counted in :attr:`rate`: 0, 1, 2 ... if they are uniform."""
        numbers = ((self.times - self.times[0]) * self.rate).round(6).tolist()
        return [int(number) if number.is_integer() else number for number in numbers]


def sample_motion(
    solution: Playable,
    joints: tuple[int, ...],
    fps: float,
    others: int = 0,
    extra: Iterable[float] = (),
) -> Motion:
    """Forward kinematics of the dense output at uniform times, and at ``extra`` ones.

    Parameters
    ----------
    solution
        The run, or a motion.
    joints
        Indices of joints of its model.
    fps
        Wanted key frames per second.  There are more if otherwise bodies, which go straight
        between them, left their paths (:data:`BESIDE`), and fewer if all bodies together had more
        than :data:`MAX_BODY_FRAMES`, but at least :data:`MIN_FPS` or ``fps``, the smaller one.
    others
        Number of other things that have as many key frames.
    extra
        Times (s) in the run at which bodies are in their place exactly.
    """
    start, end = solution.span
    duration = end - start
    wanted = duration * fps * (1.0 - 1e-12)  # rounding must not add one to a whole number
    count = max(1, len(joints) + others)
    allowed = max(MAX_BODY_FRAMES // count, math.ceil(min(MIN_FPS, fps) * duration))
    intervals = math.ceil(min(wanted, allowed))
    motion, needed = _sampled(solution, joints, np.linspace(start, end, intervals + 1))
    parts = 1  # of each interval: the key frames that were wanted stay
    while intervals and parts < min(math.ceil(needed / intervals), allowed // intervals):
        parts = min(math.ceil(needed / intervals), allowed // intervals)
        times = np.linspace(start, end, parts * intervals + 1)
        motion, needed = _sampled(solution, joints, times)
    if max(wanted, needed) > allowed:
        log.info(
            "%d bodies over %g s: %.3g key frames per second instead of %.3g",
            count,
            duration,
            motion.rate,
            max(wanted, needed) / duration,
        )
    times = motion.times
    apart = [t for t in extra if np.abs(times - t).min() * motion.rate > 1e-6]
    if not apart:
        return motion
    return _sampled(solution, joints, np.union1d(times, apart))[0]


def _sampled(solution: Playable, joints: tuple[int, ...], times: FloatArray) -> tuple[Motion, int]:
    """The motion at ``times`` (n,) s, and the number of intervals that it needs."""
    model = solution.mechanism.model
    data = workspace(model)
    placements = np.empty((len(times), len(joints), 7))
    rates = np.empty((len(times), len(joints), 6))
    for i, (q, v) in enumerate(zip(*solution(times))):
        pin.forwardKinematics(model, data, q, v)
        for k, joint in enumerate(joints):
            placements[i, k] = pin.SE3ToXYZQUAT(data.oMi[joint])
            rates[i, k] = pin.getVelocity(model, data, joint, pin.LOCAL_WORLD_ALIGNED).vector
    quaternions = placements[:, :, 3:]
    # q and -q are the same rotation: take the one near its predecessor.
    flips = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=2) < 0.0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(flips, axis=0)[:, :, None]
    motion = Motion(joints, times, placements[:, :, :3], quaternions)
    excess = _beside(motion, rates) / BESIDE
    intervals = len(times) - 1
    # The distance falls with the square of the interval, once these are short.
    return motion, math.ceil(intervals * min(math.sqrt(excess), 4.0)) if excess > 1.0 else intervals


def _beside(motion: Motion, rates: FloatArray) -> float:
    """How far bodies are beside their places between the key frames, over the size of the motion.

    The larger of distance and turn (rad).  All but a few intervals keep to it, so that a jolt does
    not ask for many.  ``rates`` (n, k, 6) of the joint frames (m/s, rad/s, world axes) show turns
    that key frames miss: one and a half between two of them looks like a half.
    """
    if not rates[1:].size:
        return 0.0
    h = np.diff(motion.times)[:, None, None]
    places, quaternions = motion.positions, motion.quaternions
    chords = np.zeros((len(h), rates.shape[1], 6))
    size = float(np.ptp(places.reshape(-1, 3), axis=0).max())
    chords[:, :, :3] = np.diff(places, axis=0) / h
    chords[:, :, 3:] = turns_between(quaternions[:-1], quaternions[1:]) / h
    # A cubic that leaves a chord of length h with slope d at both ends is h d / 4 beside it.
    off = 0.25 * h[:, :, 0, None] * np.maximum(abs(rates[:-1] - chords), abs(rates[1:] - chords))
    distances = np.linalg.norm(off[:, :, :3], axis=2) / (size or 1.0)
    turns = np.linalg.norm(off[:, :, 3:], axis=2)
    return float(np.quantile(np.maximum(distances, turns).max(axis=1), KEPT))


# Camera -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class View:
    """Where the camera looks, and from where.

    Attributes
    ----------
    target : (3,) m
        The point in the world that it looks at.
    axes : (3, 3)
        Unit vectors to the right, upwards and forward as its rows.
    distance
        From the camera to the target, m.
    """

    target: FloatArray
    axes: FloatArray
    distance: float


def choose_view(mechanism: Mechanism, points: FloatArray) -> View:
    """The view that shows all ``points`` (n, 3) m.

    Planar mechanisms are seen along the normal of their plane: from -y, +z or +x.  Others are
    seen from the front, the right and above.
    """
    forward = _view_direction(mechanism)
    up = np.array([0.0, 0.0, 1.0]) if forward[2] > -0.99 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(right, forward), forward])
    seen = points @ axes.T
    centre = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    offsets = seen - centre
    slope = FILLED * math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    needed = np.abs(offsets[:, :2]) / [slope * ASPECT, slope] - offsets[:, 2:]
    distance = float(needed.max())
    return View(centre @ axes, axes, distance if distance > SMALLEST else 1.0)


def _view_direction(mechanism: Mechanism) -> FloatArray:
    """Unit vector from the camera to the mechanism."""
    model = mechanism.model
    jacobian = pin.computeJointJacobians(model, workspace(model), np.array(mechanism.q0))
    size = np.abs(jacobian).max(initial=0.0)
    for normal, forward in ((1, (0.0, 1.0, 0.0)), (2, (0.0, 0.0, -1.0)), (0, (-1.0, 0.0, 0.0))):
        # Planar: no joint moves along the normal, or turns about anything else.
        out_of_plane = [normal, *(3 + axis for axis in range(3) if axis != normal)]
        if np.abs(jacobian[out_of_plane]).max(initial=0.0) <= 1e-9 * size:
            return np.array(forward)
    direction = np.array([-0.62, 1.0, -0.5])
    return np.asarray(direction / np.linalg.norm(direction))


# The picture ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Picture:
    """All that is drawn of a run.

    Attributes
    ----------
    visuals
        Shapes of the bodies.
    motion
        Of the joints that carry them, and of those that the overlays are computed from.
    overlays
        What is drawn beside them.
    view
        The camera's place, at the start of the run.
    along : (n, 3) m or None
        How far the camera has gone along with the mechanism at the key frames; None if it stands
        still.
    """

    mechanism: Mechanism
    visuals: list[Visual]
    motion: Motion
    overlays: Overlays
    view: View
    along: FloatArray | None = None


def make_picture(
    solution: Playable, fps: float, wanted: OverlayOptions, extra: Iterable[float] = ()
) -> Picture:
    """Key frames of everything that is drawn of ``solution``.

    ``fps`` is the wanted number of key frames per second, and ``extra`` are times that get one
    (:func:`sample_motion`).

    Raises
    ------
    InputError
        If what is ``wanted`` cannot be drawn.
    """
    mechanism = solution.mechanism
    wanted.check(*(part for part, _ in parts_of(solution)))
    loops = loops_of(solution)
    visuals = visuals_of(mechanism, loops)
    joints = {visual.joint for visual in visuals} - {0} | joints_of(solution, wanted)
    others = 2 * len(springs_of(solution)) + len(wanted.trace)
    others += len(loops) * (2 * wanted.gaps + 2 * wanted.reactions)
    motion = sample_motion(solution, tuple(sorted(joints)), fps, others, extra)
    points = seen_points(visuals, motion)
    extent = _extent(points)
    moving = [visual for visual in visuals if visual.joint]
    along = _way(mechanism, moving, motion)
    if along is not None:
        near = seen_points(moving, motion, along)
        if extent > ALONG_FROM * _extent(near):
            points, travelled, extent = near, extent, _extent(near)
        else:
            along = None
    overlays = make_overlays(solution, wanted, motion, extent)
    if along is not None:
        overlays.notes.append(
            {"text": f"the picture goes along with the mechanism, which travels {travelled:.3g} m"}
        )
    else:
        points = np.concatenate([points, overlays.points()])
    return Picture(mechanism, visuals, motion, overlays, choose_view(mechanism, points), along)


def _extent(points: FloatArray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0))) or 1.0


def _way(mechanism: Mechanism, moving: list[Visual], motion: Motion) -> FloatArray | None:
    """How far (n, 3) m the bodies have come on average; None if a joint holds one to the ground."""
    model = mechanism.model
    bases = [joint for joint in range(1, model.njoints) if model.parents[joint] == 0]
    held = any(model.joints[joint].shortname() not in FREE for joint in bases)
    if held or not moving or len(motion.times) == 1:
        return None
    drawn = [motion.joints.index(joint) for joint in sorted({visual.joint for visual in moving})]
    middle = motion.positions[:, drawn].mean(axis=1)
    return np.asarray(middle - middle[0])


def seen_points(
    visuals: list[Visual], motion: Motion, along: FloatArray | None = None
) -> FloatArray:
    """Corners (n, 3) m of all shapes at sampled times, as seen by who has gone ``along``."""
    chosen = np.unique(np.linspace(0, len(motion.times) - 1, SAMPLES).astype(int))
    corners: dict[int, list[FloatArray]] = {0: [np.empty((0, 3))]}
    for visual in visuals:
        corners.setdefault(visual.joint, []).append(visual.corners())
    points = [np.concatenate(corners.pop(0))]
    for joint, own in corners.items():
        k = motion.joints.index(joint)
        together = np.concatenate(own)
        for i in chosen:
            rotation = pin.Quaternion(motion.quaternions[i, k]).matrix()
            place = motion.positions[i, k] - (0.0 if along is None else along[i])
            points.append(together @ rotation.T + place)
    return np.concatenate(points)
