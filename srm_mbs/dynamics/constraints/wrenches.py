r"""Wrenches of closures on bodies, and the share of each joint of the tree in carrying them.

Wrenches are force (N) then moment (N m) in world axes.  A row with the multiplier lam exerts the
generalised forces -G^T lam: a wrench on b at b's origin, and its opposite on a at the same point.
The joint of a body carries, from its parent to it, the inertial wrenches of all bodies of its
subtree less the wrenches that act on them from outside of the tree's joints.

All functions take n states at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.model.closures import LoopClosure


def bodies_of(loop: LoopClosure, model: pin.Model) -> tuple[int, int]:
    """Joints that carry the anchors a and b of a closure; 0 for the ground."""
    (a, _), (b, _) = loop.resolve(model)
    return a, b


@dataclass(frozen=True, eq=False)
class Placements:
    """Placements of all joints at n states, in world axes.

    Attributes
    ----------
    rotation : (n, njoints, 3, 3)
        Axes of the bodies; those of joint 0 are the world's.
    origin : (n, njoints, 3) m
        Origins of the joints.
    """

    rotation: FloatArray
    origin: FloatArray

    @classmethod
    def empty(cls, model: pin.Model, n: int) -> Self:
        """Room for n states, to be filled by :meth:`take`."""
        return cls(np.empty((n, model.njoints, 3, 3)), np.empty((n, model.njoints, 3)))

    @classmethod
    def at(cls, model: pin.Model, data: pin.Data, q: FloatArray) -> Self:
        """The wrenches at the configurations q (n, nq); ``data`` is a workspace."""
        placed = cls.empty(model, len(q))
        for i, row in enumerate(q):
            pin.forwardKinematics(model, data, row)
            placed.take(i, data)
        return placed

    def take(self, i: int, data: pin.Data) -> None:
        """Copy the placements that ``data`` holds to the state number ``i``."""
        rotation, origin = self.rotation[i], self.origin[i]
        for j, placement in enumerate(data.oMi):
            rotation[j], origin[j] = placement.rotation, placement.translation

    def of(self, joint: int, inside: pin.SE3) -> tuple[FloatArray, FloatArray]:
        """Axes (n, 3, 3) and origin (n, 3) m of the frame ``inside`` the body of ``joint``."""
        R = self.rotation[:, joint]
        return R @ inside.rotation, self.origin[:, joint] + R @ inside.translation


def row_wrenches(loop: LoopClosure, model: pin.Model, placed: Placements) -> FloatArray:
    """Wrench on b, at b's origin in world axes, per unit multiplier of each row: (n, rows, 6).

    For closures between anchors.  a's body feels the opposite wrench at the same point.
    """
    (Ra, at_a), (Rb, at_b) = (placed.of(*place) for place in loop.resolve(model))
    gap = at_a - at_b
    out = np.zeros((len(gap), loop.rows.count, 6))
    row = 0
    for d in loop.rows.directions:
        out[:, row, :3] = Rb @ d
        out[:, row, 3:] = np.cross(gap, out[:, row, :3])
        row += 1
    if loop.rows.distances:  # along the line through both origins
        out[:, row, :3] = gap / np.linalg.norm(gap, axis=1, keepdims=True)
        row += 1
    for u, n in loop.rows.alignments:
        out[:, row, 3:] = np.cross(Ra @ u, Rb @ n)
        row += 1
    return out


def moved(wrenches: FloatArray, by: FloatArray) -> FloatArray:
    """The ``wrenches`` (..., 6) about points that lie ``by`` (..., 3) m farther."""
    force = wrenches[..., :3]
    return np.concatenate([force, wrenches[..., 3:] - np.cross(by, force)], axis=-1)


def about_origin(
    on_b: FloatArray, loop: LoopClosure, model: pin.Model, placed: Placements
) -> FloatArray:
    """Wrenches on b at b's origin, (n, ..., 6), as wrenches about the world origin."""
    at_b = placed.of(*loop.resolve(model)[1])[1]
    return moved(on_b, -at_b.reshape(len(at_b), *(1,) * (on_b.ndim - 2), 3))


def add_between(loads: FloatArray, bodies: tuple[int, int], on_b: FloatArray) -> None:
    """Add the wrenches ``on_b`` (k, 6), about the world origin, to the ``loads`` (k, njoints, 6) of
    the second of two ``bodies``, and their opposites to those of the first."""
    a, b = bodies
    loads[:, b] += on_b
    loads[:, a] -= on_b


def sums_of_subtrees(model: pin.Model, loads: FloatArray) -> FloatArray:
    """For each joint the sum of the ``loads`` (k, njoints, 6), wrenches on the bodies about one
    point, over the bodies of its subtree: (k, njoints, 6)."""
    whole = loads.copy()
    for joint in range(model.njoints - 1, 0, -1):
        whole[:, model.parents[joint]] += whole[:, joint]
    return whole
