"""Shapes with a motion of their own, beside the bodies: springs, gaps, points.

Springs and gaps are of unit length along z; the animation turns and stretches them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.spans import Spans
from srm_mbs.visuals import Colour, Shape

if TYPE_CHECKING:
    from srm_mbs.scene import Motion


@dataclass(frozen=True, eq=False)
class Moving:
    """A shape with a motion of its own.

    Attributes
    ----------
    name
        Of its node in the page.
    parts
        Shapes with their colours; along z from 0 to 1 where the motion stretches.
    positions : (n, 3) m, quaternions : (n, 4), scales : (n, 3)
        At the key frames, in the world; no scales where it keeps its size.
    colours : (n, 3) or None
        Over time.
    in_front
        Seen through everything before it, as closures lie within the bodies.
    spans
        When it is there (s); None for always.
    """

    name: str
    parts: tuple[tuple[Shape, pin.SE3, Colour], ...]
    positions: FloatArray
    quaternions: FloatArray
    scales: FloatArray | None = None
    colours: FloatArray | None = None
    in_front: bool = False
    spans: Spans | None = None


@dataclass(frozen=True, eq=False)
class Trace:
    """The path ``points`` (n, 3) m of a point, in the world."""

    name: str
    points: FloatArray
    colour: Colour


def path_of(motion: Motion, joint: int, placement: pin.SE3) -> FloatArray:
    """Positions (n, 3) m in the world of a point fixed to a joint (0: the ground)."""
    offset = np.array(placement.translation)
    if joint == 0:
        return np.tile(offset, (len(motion.times), 1))
    k = motion.joints.index(joint)
    axis, w = motion.quaternions[:, k, :3], motion.quaternions[:, k, 3:]
    across = 2.0 * np.cross(axis, offset)
    turned = offset + w * across + np.cross(axis, across)
    return np.asarray(motion.positions[:, k] + turned)


def no_turn(count: int) -> FloatArray:
    return np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))


def turns_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3), rad in the world, between quaternions (..., 4) x, y, z, w."""
    a, wa, b, wb = first[..., :3], first[..., 3:], second[..., :3], second[..., 3:]
    axis = wa * b - wb * a - np.cross(b, a)
    w = wa * wb + np.sum(a * b, axis=-1, keepdims=True)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, w)
    return np.asarray(axis * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0))


def turns_along(directions: FloatArray) -> FloatArray:
    """Quaternions (n, 4) x, y, z, w that turn z to ``directions`` (n, 3), of continuous sign and,
    since each follows its predecessor the shortest way, without twist."""
    turn = pin.Quaternion.Identity()
    here = np.array([0.0, 0.0, 1.0])
    out = np.empty((len(directions), 4))
    for i, direction in enumerate(directions):
        size = float(np.linalg.norm(direction))
        if size > 0.0:
            there = direction / size
            turn = pin.Quaternion.FromTwoVectors(here, there) * turn
            turn.normalize()
            here = there
        out[i] = turn.coeffs()
    flips = np.where(np.sum(out[1:] * out[:-1], axis=1) < 0.0, -1.0, 1.0)
    out[1:] *= np.cumprod(flips)[:, None]
    return out


def stretched(
    name: str,
    parts: tuple[tuple[Shape, pin.SE3, Colour], ...],
    starts: FloatArray,
    arrows: FloatArray,
) -> Moving:
    lengths = np.linalg.norm(arrows, axis=1)
    # A scale of zero has no inverse, which three.js needs for the light.
    scales = np.column_stack([np.ones((len(lengths), 2)), np.maximum(lengths, 1e-9)])
    return Moving(name, parts, starts, turns_along(arrows), scales)
