"""Bodies and joints as the text of a URDF, in the dialect of ``docs/formats.md``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import pinocchio as pin

from srm_mbs.anchors import WORLD
from srm_mbs.arrays import FloatArray
from srm_mbs.loading.joint_graph import Body, Joint

JOINT_FRAME = "::joint_frame"
"""Added to a joint's name: the massless link at the joint where its child's frame is elsewhere."""


def numbers(values: Iterable[float]) -> str:
    """Numbers as URDF writes them, with every digit."""
    return " ".join(repr(float(value) + 0.0) for value in values)


def rpy(rotation: FloatArray) -> tuple[float, float, float]:
    """Fixed-axis roll, pitch and yaw (rad) of a rotation (3, 3), accurate at any pitch.

    Near pitch = pi/2 the roll is ill-conditioned; pitch and yaw are therefore read off the
    rotation without that roll, so that the errors cancel.
    """
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    rest = rotation @ pin.rpy.rpyToMatrix(-roll, 0.0, 0.0)
    return roll, math.atan2(-rest[2, 0], rest[2, 2]), math.atan2(-rest[0, 1], rest[1, 1])


def is_identity(placement: pin.SE3) -> bool:
    """Whether a placement moves nothing by more than rounding."""
    return bool(placement.isIdentity(1e-13))


def origin(parent: Element, placement: pin.SE3) -> None:
    """Add ``<origin>`` to an element, unless it is the identity."""
    if not is_identity(placement):
        SubElement(
            parent,
            "origin",
            xyz=numbers(placement.translation),
            rpy=numbers(rpy(placement.rotation)),
        )


def anchor(link: str, placement: pin.SE3) -> dict[str, Any]:
    """An anchor of a description."""
    out: dict[str, Any] = {"link": link}
    if not is_identity(placement):
        out["xyz"] = [float(x) + 0.0 for x in placement.translation]
        out["rpy"] = [float(x) + 0.0 for x in rpy(placement.rotation)]
    return out


def _inertial(link: Element, inertia: pin.Inertia) -> None:
    node = SubElement(link, "inertial")
    origin(node, pin.SE3(np.eye(3), inertia.lever))
    SubElement(node, "mass", value=numbers([inertia.mass]))
    moments = inertia.inertia
    entries = {
        "i" + "xyz"[i] + "xyz"[j]: numbers([moments[i, j]]) for i in range(3) for j in range(i, 3)
    }
    SubElement(node, "inertia", entries)


def _joint(robot: Element, joint: Joint, child: str) -> None:
    node = SubElement(robot, "joint", name=joint.name, type=joint.type)
    origin(node, joint.in_parent)
    SubElement(node, "parent", link=joint.parent)
    SubElement(node, "child", link=child)
    if joint.type not in ("fixed", "floating", "spherical"):
        SubElement(node, "axis", xyz=numbers(joint.axis))
    if joint.second_axis is not None:
        SubElement(node, "axis2", xyz=numbers(joint.second_axis))
    if joint.type == "screw":
        SubElement(node, "thread_pitch", value=numbers([joint.pitch]))
    if joint.type in ("revolute", "prismatic", "screw"):
        limits = {"lower": joint.lower, "upper": joint.upper}
        limits |= {"effort": joint.effort, "velocity": joint.speed}
        SubElement(node, "limit", {key: numbers([value]) for key, value in limits.items()})
    dynamics = {"damping": joint.damping, "friction": joint.friction, "armature": joint.armature}
    acting = {key: numbers([value]) for key, value in dynamics.items() if value}
    if acting:
        SubElement(node, "dynamics", acting)


def urdf_text(name: str, bodies: Iterable[Body], joints: Sequence[Joint]) -> str:
    """Text of a URDF.

    A link keeps the frame that the file gave it.  Where the joint that carries it is elsewhere,
    a massless link stands at the joint, and the link is fixed to that.

    Parameters
    ----------
    name
        Of the robot.
    bodies
        Every body; the ground (``world``) is added where a joint starts from it.
    joints
        A tree: every body but one is the child of one joint.
    """
    robot = Element("robot", name=name or "robot")
    if any(joint.parent == WORLD for joint in joints):
        SubElement(robot, "link", name=WORLD)
    for body in bodies:
        link = SubElement(robot, "link", name=body.name)
        if body.inertia is not None:
            _inertial(link, body.inertia)
        link.extend(body.visuals)
    for joint in joints:
        back = joint.in_child.inverse()
        if joint.type == "fixed":
            merged = Joint(joint.name, "fixed", joint.parent, joint.child, joint.in_parent * back)
            _joint(robot, merged, joint.child)
        elif is_identity(joint.in_child):
            _joint(robot, joint, joint.child)
        else:
            frame = joint.name + JOINT_FRAME
            SubElement(robot, "link", name=frame)
            _joint(robot, joint, frame)
            held = Joint(frame + "::fixed", "fixed", frame, joint.child, back)
            _joint(robot, held, joint.child)
    indent(robot)
    return tostring(robot, encoding="unicode") + "\n"
