"""Joint types that URDF does not have: spherical, universal and screw.

Pinocchio's URDF reader gets floating joints in their place; the model that it returns is then
rebuilt, joint by joint, with the right joint models.

* ``spherical``: a ball; configuration a quaternion xyzw, velocity the angular velocity in the
  child's frame.
* ``universal``: ``<axis>`` is fixed in the parent, ``<axis2>`` in the child; the child is turned by
  the first angle about ``<axis>``, then by the second about the rotated ``<axis2>``.
* ``screw``: an angle about ``<axis>``, and along it ``<thread_pitch value>`` metres for each turn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs.formats.xml import words

MULTIPLE = ("floating", "planar")
"""Types of URDF with several degrees of freedom."""
EXTENDED_TYPES = ("spherical", "universal", "screw")
POSITION_LIMITS = ("lowerPositionLimit", "upperPositionLimit", "positionLimitMargin")
VELOCITY_VECTORS = words(
    """armature rotorInertia rotorGearRatio damping friction effortLimit lowerEffortLimit
    upperEffortLimit velocityLimit lowerVelocityLimit upperVelocityLimit lowerDryFrictionLimit
    upperDryFrictionLimit"""
)


@dataclass(frozen=True)
class JointData:
    """A joint of one of these types.

    Attributes
    ----------
    model
        Pinocchio's joint model.
    limits
        Lowest and highest angle of a screw (rad); infinite where the file gives none.
    damping, friction
        On every coordinate: N m s/rad, N m.
    """

    model: Any
    limits: tuple[float, float]
    damping: float
    friction: float


def _numbers(joint: Element, tag: str, key: str, default: str) -> list[float]:
    node = joint.find(tag)
    text = default if node is None else node.get(key, default)
    return [float(part) for part in text.split()]


def _joint_data(joint: Element) -> JointData:
    axis = np.array(_numbers(joint, "axis", "xyz", "1 0 0"))
    match joint.get("type"):
        case "spherical":
            model = pin.JointModelSpherical()
        case "universal":
            model = pin.JointModelUniversal(axis, np.array(_numbers(joint, "axis2", "xyz", "")))
        case _:
            (pitch,) = _numbers(joint, "thread_pitch", "value", "")
            model = pin.JointModelHelicalUnaligned(axis, pitch / (2.0 * math.pi))
    low, high = (
        _numbers(joint, "limit", key, default)[0]
        for key, default in (("lower", "-inf"), ("upper", "inf"))
    )
    damping, friction = (
        _numbers(joint, "dynamics", key, "0")[0] for key in ("damping", "friction")
    )
    return JointData(model, (low, high), damping, friction)


def take_extended(root: Element) -> dict[str, JointData]:
    """The joints of these types by name; in the checked URDF ``root`` they become floating."""
    found = {}
    for joint in root.findall("joint"):
        if joint.get("type") not in EXTENDED_TYPES:
            continue
        found[joint.get("name", "")] = _joint_data(joint)
        joint.set("type", "floating")
        for tag in ("axis", "axis2", "thread_pitch", "limit", "dynamics"):
            for node in joint.findall(tag):
                joint.remove(node)
    return found


def with_joints(model: pin.Model, joints: Mapping[str, JointData]) -> pin.Model:
    """``model`` with its joints of these names replaced; everything else is copied."""
    if not joints:
        return model
    out = pin.Model()
    out.name = model.name
    out.gravity.linear = model.gravity.linear.copy()
    for i in range(1, model.njoints):
        name = model.names[i]
        kind = joints[name].model if name in joints else model.joints[i]
        out.addJoint(model.parents[i], kind, model.jointPlacements[i], name)
    for i in range(model.njoints):
        out.inertias[i] = model.inertias[i]
    for frame in list(model.frames)[1:]:
        out.addFrame(frame, False)
    for i in range(1, model.njoints):
        _copy_vectors(model, out, i, joints.get(model.names[i]))
    return out


def _copy_vectors(model: pin.Model, out: pin.Model, i: int, given: JointData | None) -> None:
    """Limits, damping and friction of joint ``i``."""
    old, new = model.joints[i], out.joints[i]
    at_q = slice(new.idx_q, new.idx_q + new.nq)
    at_v = slice(new.idx_v, new.idx_v + new.nv)
    if given is None:
        for name in POSITION_LIMITS:
            getattr(out, name)[at_q] = getattr(model, name)[old.idx_q : old.idx_q + old.nq]
        for name in VELOCITY_VECTORS:
            getattr(out, name)[at_v] = getattr(model, name)[old.idx_v : old.idx_v + old.nv]
        return
    if new.nq == 1:
        out.lowerPositionLimit[at_q], out.upperPositionLimit[at_q] = given.limits
    set_dynamics(out, at_v, damping=given.damping, friction=given.friction)


def set_dynamics(
    model: pin.Model,
    at_v: slice,
    armature: float | None = None,
    damping: float | None = None,
    friction: float | None = None,
) -> None:
    """Set those that are given on the velocity coordinates ``at_v``: kg m^2 (kg), N m s/rad
    (N s/m), N m (N)."""
    if armature is not None:
        model.armature[at_v] = armature
    if damping is not None:
        model.damping[at_v] = damping
    if friction is not None:
        model.friction[at_v] = friction
        model.lowerDryFrictionLimit[at_v] = -friction
        model.upperDryFrictionLimit[at_v] = friction
