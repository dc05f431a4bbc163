r"""Position, velocity and acceleration of points of links, in the axes of the world.

For a point p of a body whose joint is at o, with the spatial velocity (v, w) and acceleration
(a, alpha) of the body at o and r = p - o:

    p' = v + w x r,        p'' = a + w x v + alpha x r + w x (w x r).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.wrenches import Placements
from srm_mbs.errors import InputError, known_names, safe_repr
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData

Place = tuple[int, pin.SE3]
"""A point of a body: the joint that carries it, 0 for the ground, and its placement in that."""


class PointMotion:
    """Motion of a point over time; each part is computed when it is read first.

    Attributes
    ----------
    position : (n, 3) m
        In the world.
    velocity : (n, 3) m/s
        Its rate.
    acceleration : (n, 3) m/s^2
        Its second rate, by the equations of motion.
    """

    def __init__(self, read: Callable[[str], FloatArray]) -> None:
        self._read = read

    def __repr__(self) -> str:
        return "PointMotion(position, velocity, acceleration)"

    @cached_property
    def position(self) -> FloatArray:
        return self._read("position")

    @cached_property
    def velocity(self) -> FloatArray:
        return self._read("velocity")

    @cached_property
    def acceleration(self) -> FloatArray:
        return self._read("acceleration")


def point_positions(model: pin.Model, place: Place, q: FloatArray) -> FloatArray:
    """Positions (n, 3) m of a point at the configurations q (n, nq)."""
    return Placements.at(model, workspace(model), q).of(*place)[1]


def point_velocities(model: pin.Model, place: Place, q: FloatArray, v: FloatArray) -> FloatArray:
    """Velocities (n, 3) m/s of a point at n states q (n, nq), v (n, nv)."""
    return _rates(model, place, q, v, np.zeros(v.shape))[0]


def point_accelerations(
    model: pin.Model, place: Place, q: FloatArray, v: FloatArray, a: FloatArray
) -> FloatArray:
    """Accelerations (n, 3) m/s^2 of a point at n states with the accelerations a (n, nv)."""
    return _rates(model, place, q, v, a)[1]


def _rates(
    model: pin.Model, place: Place, q: FloatArray, v: FloatArray, a: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Velocities and accelerations (n, 3)."""
    joint, inside = place
    data, r = workspace(model), inside.translation
    own = np.zeros((len(q), 4, 3))
    R = np.empty((len(q), 3, 3))
    for i in range(len(q)):
        pin.forwardKinematics(model, data, q[i], v[i], a[i])
        twist, rate = data.v[joint], data.a[joint]
        own[i] = twist.linear, twist.angular, rate.linear, rate.angular
        R[i] = data.oMi[joint].rotation
    linear, w, bias, alpha = np.moveaxis(own, 1, 0)
    velocity = linear + np.cross(w, r)
    acceleration = bias + np.cross(alpha, r) + np.cross(w, velocity)
    return (R @ velocity[..., None])[..., 0], (R @ acceleration[..., None])[..., 0]


def given_point(mechanism: MechanismData, point: Any, element: str) -> Anchor:
    """``point`` as an anchor: an anchor, or the name of a point that the mechanism has.

    Raises
    ------
    InputError
        If it is neither; the message lists the names that there are.
    """
    if isinstance(point, Anchor):
        return point
    named: Mapping[str, Anchor] = getattr(mechanism, "points", {})
    if isinstance(point, str) and point in named:
        return named[point]
    problem = f"there is no point {safe_repr(point)}"
    if isinstance(point, str) and named:
        raise InputError(problem, element=element, remedy=known_names(named))
    raise InputError(
        problem if isinstance(point, str) else f"{safe_repr(point)} is not a point of a link",
        element=element,
        remedy='Give for example srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))',
    )


def place_of(mechanism: MechanismData, point: Any, element: str = "point") -> Place:
    """The place of an anchor, or of a named point.

    Raises
    ------
    InputError
        If there is no such point, link or frame; the message lists those there are.
    """
    anchor = given_point(mechanism, point, element)
    try:
        return anchor.resolve(mechanism.model)
    except InputError as error:
        error.element = element
        raise


def point_name(point: Any) -> str:
    """Name of a point in legends and tables: its own, or that of its link with its coordinates."""
    if isinstance(point, str):
        return point
    if not any(point.xyz):
        return str(point.where)
    return f"{point.where} ({', '.join(f'{x:.4g}' for x in point.xyz)})"
