"""Conversion between joint values as users write them and Pinocchio's coordinates.

A one-degree joint takes one number (rad or m), also a URDF ``continuous`` joint, which Pinocchio
stores as (cos, sin).  Other joints take lists in Pinocchio's order: position xyz then quaternion
xyzw for a free flyer, a quaternion xyzw for a ball joint, [x, y, angle] or [x, y, cos, sin] for a
planar joint; rates are linear then angular, in the moving body's frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.errors import InputError, safe_repr
from srm_mbs.model.mechanism import MechanismData
from srm_mbs.model.numbers import finite_array, name_list

UNIT_LENGTH_TOLERANCE = 1e-3
"""Largest deviation from 1 of the length of a quaternion, or (cos, sin) pair, that users give."""


def _numbers(value: Any, name: str, accepted: dict[int, str]) -> FloatArray:
    """One number or a list of them as an array, of one of the accepted lengths."""
    if type(value) is float and 1 in accepted and math.isfinite(value):
        return np.array((value,))  # without the checks of what else users give
    array = finite_array(value)
    if array is None or array.ndim > 1 or array.size not in accepted:
        wanted = " or ".join(accepted.values())
        raise InputError(
            f"joint {name!r} cannot take the value {safe_repr(value)}",
            remedy=f"Give {wanted}",
        )
    return np.atleast_1d(array)


def set_position(mechanism: MechanismData, q: FloatArray, name: str, value: Any) -> None:
    """Write the position ``value`` of joint ``name`` into ``q`` (nq,), in place.

    Raises
    ------
    InputError
        For an unknown joint, or a value of the wrong length or not finite.
    """
    write_position(mechanism.joint(name), q, name, value)


def write_position(joint: Any, q: FloatArray, name: str, value: Any) -> None:
    """:func:`set_position` for Pinocchio's joint model ``joint``, called ``name`` in messages."""
    own = slice(joint.idx_q, joint.idx_q + joint.nq)
    if joint.nv == 1:
        angle = _numbers(value, name, {1: "one finite number (rad or m)"})[0]
        q[own] = angle if joint.nq == 1 else (np.cos(angle), np.sin(angle))
        return
    accepted = {joint.nq: f"{joint.nq} finite numbers in Pinocchio's order"}
    planar = joint.shortname() == "JointModelPlanar"
    if planar:
        accepted[3] = "[x, y, angle]"
    array = _numbers(value, name, accepted)
    if planar and array.size == 3:
        array = np.array([array[0], array[1], np.cos(array[2]), np.sin(array[2])])
    if joint.nq != joint.nv:
        # The group part is last: a quaternion, or (cos, sin).
        part = slice(array.size - (2 if planar else 4), None)
        length = float(np.linalg.norm(array[part]))
        if abs(length - 1.0) > UNIT_LENGTH_TOLERANCE:
            raise InputError(
                f"joint {name!r}: the rotation part of {safe_repr(value)} has length {length:.6g}",
                remedy="Give a unit quaternion (x, y, z, w), or a unit (cos, sin) pair",
            )
        array[part] /= length
    q[own] = array


def write_positions(model: pin.Model, q: FloatArray, values: Mapping[str, Any]) -> None:
    """:func:`write_position` of all ``values``, joint -> position, of joints of ``model``."""
    sizes, places = model.nqs, model.idx_qs
    for name, value in values.items():
        number = model.getJointId(name)
        if type(value) is float and sizes[number] == 1 and math.isfinite(value):
            q[places[number]] = value  # a joint model costs more than the rest
        else:
            write_position(model.joints[number], q, name, value)


def set_rate(mechanism: MechanismData, v: FloatArray, name: str, value: Any) -> None:
    """Write the rate ``value`` of joint ``name`` into ``v`` (nv,), in place.

    Raises
    ------
    InputError
        For an unknown joint, or a value of the wrong length or not finite.
    """
    write_rate(mechanism.joint(name), v, name, value)


def write_rate(joint: Any, v: FloatArray, name: str, value: Any) -> None:
    """:func:`set_rate` for Pinocchio's joint model ``joint``, called ``name`` in messages."""
    accepted = "one finite number (rad/s or m/s)" if joint.nv == 1 else f"{joint.nv} finite numbers"
    v[joint.idx_v : joint.idx_v + joint.nv] = _numbers(value, name, {joint.nv: accepted})


def coordinate_names(mechanism: MechanismData) -> tuple[str, ...]:
    """A name for each velocity component (nv,): the joint's, or ``joint[i]`` if it has several."""
    names = []
    for name in mechanism.joint_names:
        count = mechanism.joint(name).nv
        names += [name] if count == 1 else [f"{name}[{i}]" for i in range(count)]
    return tuple(names)


def joint_coordinates(mechanism: MechanismData, names: Iterable[str]) -> IndexArray:
    """Velocity indices of the joints ``names``, in that order.

    Raises
    ------
    InputError
        For an unknown joint, or one that is named twice.
    """
    indices: list[int] = []
    for name in name_list(names, "joints"):
        joint = mechanism.joint(name)
        if joint.idx_v in indices:
            raise InputError(f"joint {safe_repr(name)} is named twice", remedy="Name it once")
        indices += range(joint.idx_v, joint.idx_v + joint.nv)
    return np.array(indices, dtype=int)


def free_coordinates(mechanism: MechanismData, held: Iterable[str]) -> IndexArray:
    """Velocity indices of the joints that are not held."""
    names = set(held)
    if not names:
        return np.arange(mechanism.model.nv)
    free = np.ones(mechanism.model.nv, dtype=bool)
    free[joint_coordinates(mechanism, names)] = False
    return np.flatnonzero(free)


def position_of(mechanism: MechanismData, q: FloatArray, name: str) -> float:
    """Position (rad or m) of the one-degree joint ``name`` in q (nq,)."""
    joint = mechanism.joint(name)
    own = q[joint.idx_q : joint.idx_q + joint.nq]
    return float(own[0] if joint.nq == 1 else np.arctan2(own[1], own[0]))
