"""The picture of a motion: bodies, their motion, overlays, and the place of the camera."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.visualization.animation.overlays import (
    Overlays,
    ViewOptions,
    active_rods,
    active_springs,
    make_overlays,
    overlay_joints,
)
from srm_mbs.visualization.animation.shapes import Visual, visuals_of
from srm_mbs.visualization.animation.trajectory import (
    BodyMotion,
    DrawableMotion,
    active_closures,
    sample_motion,
)

FIELD_OF_VIEW = 25.0
"""Vertical, degrees: narrow, so that planar mechanisms look planar."""
ASPECT = 1.5
"""Width over height of the window for which the picture is made."""
FILLED_PART = 0.84
"""Part of the window that the points in view fill."""
SMALLEST_DISTANCE = 1e-9
"""Distance of the camera (m) below which there is nothing to show."""
CAMERA_FRAMES = 300
"""Key frames from which the place of the camera is computed."""
FREE_JOINTS = ("JointModelFreeFlyer", "JointModelPlanar")
FOLLOW_RATIO = 1.5
"""The camera follows a mechanism that is free in space if a fixed camera would show it smaller by
more than this factor."""

# Camera -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class View:
    """Place and direction of the camera.

    Attributes
    ----------
    target : (3,) m
        The point in the world that it looks at.
    axes : (3, 3)
        Unit vectors to the right, upwards and forward as its rows.
    distance
        From the camera to the target, m.
    ends
        Left, right and upper end of what is in view, from the middle, in half heights of the
        picture.
    """

    target: FloatArray
    axes: FloatArray
    distance: float
    ends: tuple[float, float, float] = (-ASPECT, ASPECT, 1.0)


def choose_view(mechanism: Mechanism, points: FloatArray) -> View:
    """The view that shows all ``points`` (n, 3) m.

    The camera looks along the normal of the plane of planar mechanisms, from -y, +z or +x, and at
    others from the front, the right and above.
    """
    forward = _view_direction(mechanism)
    up = np.array([0.0, 0.0, 1.0]) if forward[2] > -0.99 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(right, forward), forward])
    seen = points @ axes.T
    centre = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    offsets = seen - centre
    half = math.tan(math.radians(0.5 * FIELD_OF_VIEW))
    slope = FILLED_PART * half
    needed = np.abs(offsets[:, :2]) / [slope * ASPECT, slope] - offsets[:, 2:]
    distance = float(needed.max())
    if not distance > SMALLEST_DISTANCE:
        return View(centre @ axes, axes, 1.0)
    across, upwards = (offsets[:, :2] / (half * (distance + offsets[:, 2:]))).T
    ends = float(across.min()), float(across.max()), float(upwards.max())
    return View(centre @ axes, axes, distance, ends)


def _view_direction(mechanism: Mechanism) -> FloatArray:
    """Unit vector from the camera to the mechanism."""
    model = mechanism.model
    jacobian = pin.computeJointJacobians(model, workspace(model), np.array(mechanism.q0))
    size = np.abs(jacobian).max(initial=0.0)
    for normal, forward in ((1, (0.0, 1.0, 0.0)), (2, (0.0, 0.0, -1.0)), (0, (-1.0, 0.0, 0.0))):
        # Planar: no joint translates along the normal, or rotates about another axis.
        out_of_plane = [normal, *(3 + axis for axis in range(3) if axis != normal)]
        if np.abs(jacobian[out_of_plane]).max(initial=0.0) <= 1e-9 * size:
            return np.array(forward)
    direction = np.array([-0.62, 1.0, -0.5])
    return np.asarray(direction / np.linalg.norm(direction))


# The picture ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Picture:
    """All that is drawn of a motion.

    Attributes
    ----------
    mechanism
        The mechanism at the start.
    visuals
        Shapes of the bodies.
    motion
        Of the joints that carry them, and of those that the overlays read.
    overlays
        Springs, paths, gaps and reactions.
    view
        Place of the camera at the start.
    along : (n, 3) m or None
        Displacement of a camera that follows the mechanism, at the key frames; None if it is fixed.
    """

    mechanism: Mechanism
    visuals: list[Visual]
    motion: BodyMotion
    overlays: Overlays
    view: View
    along: FloatArray | None = None


def make_picture(
    motion: DrawableMotion, fps: float, options: ViewOptions, extra: Iterable[float] = ()
) -> Picture:
    """Key frames of everything that is drawn of ``motion``.

    ``fps`` is the requested number of key frames per second, and ``extra`` are times (s) that get
    one (:func:`~srm_mbs.visualization.animation.trajectory.sample_motion`).

    Raises
    ------
    InputError
        If an overlay of ``options`` cannot be drawn.
    """
    mechanism = motion.mechanism
    options.check(*(segment.mechanism for segment in motion.segments))
    loops = active_closures(motion)
    visuals = visuals_of(mechanism, loops)
    joints = {visual.joint for visual in visuals} - {0} | overlay_joints(motion, options)
    others = 2 * (len(active_springs(motion)) + len(active_rods(motion))) + len(options.trace)
    others += len(loops) * (2 * options.gaps + 2 * options.reactions)
    bodies = sample_motion(motion, tuple(sorted(joints)), fps, others, extra)
    points = points_in_view(visuals, bodies)
    extent = _extent(points)
    carried = [visual for visual in visuals if visual.joint]
    along = _displacement(mechanism, carried, bodies)
    if along is not None:
        near = points_in_view(carried, bodies, along)
        if extent > FOLLOW_RATIO * _extent(near):
            points, travelled, extent = near, extent, _extent(near)
        else:
            along = None
    overlays = make_overlays(motion, options, bodies, extent)
    if along is not None:
        overlays.notes.append(
            {"text": f"the picture goes along with the mechanism, which travels {travelled:.3g} m"}
        )
    else:
        points = np.concatenate([points, overlays.points()])
    return Picture(mechanism, visuals, bodies, overlays, choose_view(mechanism, points), along)


def _extent(points: FloatArray) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0))) or 1.0


def _displacement(
    mechanism: Mechanism, carried: list[Visual], motion: BodyMotion
) -> FloatArray | None:
    """Mean displacement (n, 3) m of the bodies; None if a joint ties one to the ground."""
    model = mechanism.model
    bases = [joint for joint in range(1, model.njoints) if model.parents[joint] == 0]
    tied = any(model.joints[joint].shortname() not in FREE_JOINTS for joint in bases)
    if tied or not carried or len(motion.times) == 1:
        return None
    drawn = [motion.joints.index(joint) for joint in sorted({visual.joint for visual in carried})]
    middle = motion.positions[:, drawn].mean(axis=1)
    return np.asarray(middle - middle[0])


def points_in_view(
    visuals: list[Visual], motion: BodyMotion, along: FloatArray | None = None
) -> FloatArray:
    """Corners (n, 3) m of the bounding boxes of all shapes at sampled key frames.

    Relative to a camera that has moved by ``along`` (frames, 3) m; it is fixed by default.
    """
    chosen = np.unique(np.linspace(0, len(motion.times) - 1, CAMERA_FRAMES).astype(int))
    corners: dict[int, list[FloatArray]] = {0: [np.empty((0, 3))]}
    for visual in visuals:
        corners.setdefault(visual.joint, []).append(visual.corners())
    points = [np.concatenate(corners.pop(0))]
    moved = np.zeros((1, 3)) if along is None else along[chosen]
    for joint, own in corners.items():
        k = motion.joints.index(joint)
        matrices = Rotation.from_quat(motion.quaternions[chosen, k]).as_matrix()
        places = motion.positions[chosen, k] - moved
        turned = np.concatenate(own) @ matrices.transpose(0, 2, 1)
        points.append((turned + places[:, None]).reshape(-1, 3))
    return np.concatenate(points)
