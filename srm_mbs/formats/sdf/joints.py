"""Joints of an SDF file."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.formats.graph.joint_graph import (
    THREAD_PITCH,
    Body,
    Direction,
    Joint,
    metres_per_turn,
)
from srm_mbs.formats.sdf.links import FRAMES_SINCE, MODEL, Frames, Scope, joint_frame
from srm_mbs.formats.xml import XmlValues, words
from srm_mbs.model.forces import OPEN_LIMIT

TYPES = {
    "revolute": ("axis",),
    "continuous": ("axis",),
    "prismatic": ("axis",),
    "screw": ("axis",),
    "universal": ("axis", "axis2"),
    "revolute2": ("axis", "axis2"),
    "ball": (),
    "fixed": (),
    "gearbox": ("axis", "axis2"),
}
"""Types of joint, and the axes that each of them has."""
JOINT_READ = words(
    "pose parent child axis axis2 thread_pitch screw_thread_pitch gearbox_ratio "
    "gearbox_reference_body"
)
JOINT_IGNORED = ("physics", "sensor", "provide_feedback", "plugin")
AXIS_READ = ("xyz", "use_parent_model_frame", "dynamics", "limit", "initial_position", "mimic")
DYNAMICS = {
    "damping": "damping",
    "friction": "friction",
    "stiffness": "spring_stiffness",
    "rest": "spring_reference",
}
"""What a joint has, and the element of ``<dynamics>`` that gives it."""
LIMITS = {"lower": "lower", "upper": "upper", "effort": "effort", "speed": "velocity"}
"""What a joint has, and the element of ``<limit>`` that gives it."""
LIMIT_IGNORED = ("stiffness", "dissipation")
DRAKE_MIMIC = re.compile(r"\{[^}]*drake[^}]*\}mimic")
ANGLE_COSINE_TOLERANCE = 1e-9
"""Rounding of the cosine of the angle between two axes that are parallel or perpendicular."""
GEAR_AXIS_TOLERANCE = 1e-6
"""Rounding of the cosine of the angle between the axes of a gearbox and of a hinge."""
SECOND_AXIS_SUFFIX = "::axis2"
"""Suffix of the joint of a second axis that is a joint of its own."""


@dataclass(frozen=True, eq=False)
class Axis:
    """An ``<axis>``: direction in the joint's frame, and what it says of its coordinate.

    Attributes
    ----------
    acting
        Keys of :data:`DYNAMICS` and :data:`LIMITS`.
    """

    direction: Direction
    acting: dict[str, float]
    mimic: Element | None


class JointReader:
    """Reads joints, and turns gearboxes and mimics into couplings when all joints are known.

    Parameters
    ----------
    values, frames
        The file and its frames.

    Attributes
    ----------
    joints
        Those read so far.
    between
        Massless bodies between joints of one axis each.
    """

    def __init__(self, values: XmlValues, frames: Frames) -> None:
        self.values, self.frames = values, frames
        self.joints: list[Joint] = []
        self.between: dict[str, Body] = {}
        self._gearboxes: list[tuple[Joint, Scope, Element, list[FloatArray]]] = []
        self._mimics: list[tuple[str, Scope, Element]] = []

    def read(self, node: Element, scope: Scope) -> None:
        """One ``<joint>``, whose frame has been added to the frames."""
        name = scope.prefix + node.get("name", "")
        where = f"joint {name!r}"
        values = self.values
        rotor = self._motor(node, where)
        foreign = [child for child in node if DRAKE_MIMIC.fullmatch(child.tag)]
        for mimic in foreign:
            node.remove(mimic)
        values.attributes(node, where, ("name", "type"))
        values.children(node, where, JOINT_READ, JOINT_IGNORED)
        kind = node.get("type", "")
        if kind not in TYPES:
            raise values.unknown(where, f"there is no joint type {kind!r}", TYPES)
        parent, child = (self._end(node, side, scope, where) for side in ("parent", "child"))
        if parent == child:
            problem = f"parent and child are both {parent!r}"
            raise values.fault(where, problem, "Join two different links")
        at = self.frames.placement(joint_frame(name, scope.version), where)
        axes = [
            self._axis(node, tag, at, where, scope)
            for tag in TYPES[kind]
            if node.find(tag) is not None or kind != "gearbox"
        ]
        for tag in ("axis", "axis2"):
            if tag not in TYPES[kind] and node.find(tag) is not None:
                values.remark(
                    f"<{tag}> of a {kind} joint means nothing; its limits and dynamics do not act",
                    name,
                )
        in_parent, in_child = (
            self.frames.placement(end, where).actInv(at) for end in (parent, child)
        )
        joint = Joint(name, "fixed", parent, child, in_parent, in_child)
        match kind:
            case "gearbox":
                directions = [at.rotation @ np.array(axis.direction) for axis in axes]
                self._gearboxes.append((joint, scope, node, directions))
                return
            case "fixed":
                self.joints.append(joint)
            case "ball":
                self.joints.append(replace(joint, type="spherical"))
            case "universal" | "revolute2":
                self._two_axes(joint, *axes)
            case "screw":
                pitch = self._pitch(node, name)
                self.joints.append(_along(replace(joint, type="screw", pitch=pitch), axes[0]))
            case _:
                # Without limits also "revolute": its angle counts turns, and none of them acts.
                one = "prismatic" if kind == "prismatic" else "revolute"
                moving = replace(joint, type=one)
                if rotor and axes[0].acting.get("effort") != 0.0:
                    values.remark(
                        "the inertia of a motor, drake:rotor_inertia times the square of "
                        "drake:gear_ratio, acts as armature",
                        name,
                    )
                    moving = replace(moving, armature=rotor)
                self.joints.append(_along(moving, axes[0]))
        self._mimics += [(name, scope, axis.mimic) for axis in axes if axis.mimic is not None]
        self._mimics += [(name, scope, mimic) for mimic in foreign]

    def _motor(self, node: Element, where: str) -> float:
        """Take out what Drake says of a motor: the inertia (kg m^2, kg) that the joint sees, which
        Drake leaves out where the limit of effort is zero."""
        found = []
        for tag, default in (("rotor_inertia", 0.0), ("gear_ratio", 1.0)):
            child = node.find(f"{{*}}{tag}")
            text = str(default) if child is None else child.text
            found.append(float(self.values.numbers(text, 1, where, f"<drake:{tag}>")[0]))
            if child is not None:
                node.remove(child)
        if found[0] < 0.0:
            raise self.values.fault(where, "<drake:rotor_inertia> is negative", "Give it >= 0")
        return found[0] * found[1] ** 2

    def _end(self, node: Element, side: str, scope: Scope, where: str) -> str:
        """The link that a joint's parent or child belongs to."""
        text = (node.findtext(side) or "").strip()
        if not text:
            raise self.values.fault(where, f"it has no <{side}>", f"Name its {side} link")
        return self.frames.body(scope.full(text), where)

    def _two_axes(self, joint: Joint, first: Axis, second: Axis) -> None:
        cosine = float(np.dot(first.direction, second.direction))
        if 1.0 - abs(cosine) < ANGLE_COSINE_TOLERANCE:
            where = f"joint {joint.name!r}"
            raise self.values.fault(where, "its two axes are parallel", "Correct <axis2>")
        forces = ("damping", "friction", "stiffness")
        acts = any(axis.mimic or any(map(axis.acting.get, forces)) for axis in (first, second))
        if abs(cosine) < ANGLE_COSINE_TOLERANCE and not acts:
            joint = replace(joint, axis=first.direction, second_axis=second.direction)
            self.joints.append(replace(joint, type="universal"))
            return
        # Two hinges and a massless cross have any angle between the axes, and forces on both.
        cross = Body(joint.name + "::cross")
        self.between[cross.name] = cross
        one = replace(joint, type="revolute", child=cross.name, in_child=pin.SE3.Identity())
        other = replace(
            joint,
            name=joint.name + SECOND_AXIS_SUFFIX,
            type="revolute",
            parent=cross.name,
            in_parent=pin.SE3.Identity(),
        )
        self.joints += [_along(one, first), _along(other, second)]

    def _pitch(self, node: Element, name: str) -> float:
        """Metres per turn; the older ``<thread_pitch>`` is converted as libsdformat does."""
        values, where = self.values, f"joint {name!r}"
        if node.find("screw_thread_pitch") is not None:
            return values.child_number(node, "screw_thread_pitch", where, 0.0)
        if node.find("thread_pitch") is None:
            raise values.fault(where, "it has no <screw_thread_pitch>", "Give it, in m per turn")
        per_metre = values.child_number(node, "thread_pitch", where, 0.0)
        if per_metre == 0.0:
            raise values.fault(where, "<thread_pitch> is zero", "Give <screw_thread_pitch>")
        values.remark(THREAD_PITCH, name)
        return metres_per_turn(per_metre)

    def _axis(self, joint: Element, tag: str, at: pin.SE3, where: str, scope: Scope) -> Axis:
        """The axis in the element ``tag`` of a joint whose frame is placed at ``at``."""
        values, version = self.values, scope.version
        node = joint.find(tag)
        if node is None:
            raise values.fault(where, f"it has no <{tag}>", "Add it")
        where = f"{where}, <{tag}>"
        values.children(node, where, AXIS_READ, ())
        xyz = node.find("xyz")
        direction, frame = np.array([0.0, 0.0, 1.0]), ""
        if xyz is not None:
            values.attributes(xyz, where, ("expressed_in",) if version >= FRAMES_SINCE else ())
            direction = values.numbers(xyz.text, 3, where, "<xyz>")
            frame = xyz.get("expressed_in", "")
        direction = values.direction(direction, where, "the axis")
        if version < FRAMES_SINCE:
            in_model = version < (1, 5)
            if values.child_truth(node, "use_parent_model_frame", where, in_model):
                frame = MODEL
        elif node.find("use_parent_model_frame") is not None:
            raise values.fault(
                where,
                f"<use_parent_model_frame> does not exist in SDF {version[0]}.{version[1]}",
                'Write <xyz expressed_in="__model__">',
            )
        if frame:
            turn = self.frames.placement(scope.full(frame), where).rotation
            direction = at.rotation.T @ turn @ direction
        if values.child_number(node, "initial_position", where, 0.0) != 0.0:
            raise values.fault(
                where, "<initial_position> is not read by this version", "Pose the links instead"
            )
        x, y, z = direction.tolist()
        acting = self._dynamics(node.find("dynamics"), where)
        acting |= self._limits(node.find("limit"), where)
        return Axis((x, y, z), acting, node.find("mimic"))

    def _dynamics(self, node: Element | None, where: str) -> dict[str, float]:
        if node is None:
            return {}
        self.values.children(node, where, DYNAMICS.values(), ())
        found = {}
        for key, tag in DYNAMICS.items():
            found[key] = self.values.child_number(node, tag, where, 0.0)
            if key != "rest" and found[key] < 0.0:
                raise self.values.fault(where, f"<{tag}> is negative", "Give a value >= 0")
        return found

    def _limits(self, node: Element | None, where: str) -> dict[str, float]:
        if node is None:
            return {}
        self.values.children(node, where, LIMITS.values(), LIMIT_IGNORED)
        found = {}
        for key, tag in LIMITS.items():
            text = node.findtext(tag)
            value = None if text is None else self.values.limit(text, where, f"<{tag}>")
            # -1 as effort or velocity means no limit.
            if value is not None and (value >= 0.0 or key in ("lower", "upper")):
                found[key] = float(np.clip(value, -OPEN_LIMIT, OPEN_LIMIT))
        if found.get("lower", -OPEN_LIMIT) > found.get("upper", OPEN_LIMIT):
            raise self.values.fault(where, "<lower> is above <upper>", "Exchange them")
        return found

    # Couplings ------------------------------------------------------------------------------

    def couplings(self) -> list[dict[str, Any]]:
        """The gearboxes and mimics as closures of the type ``coupling``."""
        return [
            *(self._gearbox(*gearbox) for gearbox in self._gearboxes),
            *(self._mimic(*mimic) for mimic in self._mimics),
        ]

    def _gearbox(
        self, joint: Joint, scope: Scope, node: Element, directions: list[FloatArray]
    ) -> dict[str, Any]:
        """theta_2 = -ratio theta_1, with the angles of parent and child against the reference
        body; ``directions`` (3,) of their axes in the world."""
        where = f"joint {joint.name!r}"
        named = (node.findtext("gearbox_reference_body") or "").strip()
        if not named or len(directions) != 2:
            missing = "<axis> and <axis2>" if named else "<gearbox_reference_body>"
            raise self.values.fault(where, f"a gearbox needs {missing}", "Add it")
        ratio = self.values.child_number(node, "gearbox_ratio", where, 1.0)
        if ratio == 0.0:
            problem = "<gearbox_ratio> is zero"
            raise self.values.fault(where, problem, "Give the ratio of the angles")
        reference = self.frames.body(scope.full(named), where)
        (first, sign_1), (second, sign_2) = (
            self._hinge(reference, body, direction, where)
            for body, direction in zip((joint.parent, joint.child), directions)
        )
        ratio = -ratio * sign_1 * sign_2
        return {"name": joint.name, "type": "coupling", "joints": [second, first], "ratio": ratio}

    def _hinge(
        self, reference: str, body: str, direction: FloatArray, where: str
    ) -> tuple[str, float]:
        """The hinge between a gearbox's reference body and ``body``, and its sign about
        ``direction``."""
        for i, joint in enumerate(self.joints):
            if joint.type != "revolute" or {joint.parent, joint.child} != {reference, body}:
                continue
            turn = self.frames.placement(joint.parent, "").rotation @ joint.in_parent.rotation
            cosine = float(turn @ np.array(joint.axis) @ direction)
            if 1.0 - abs(cosine) < GEAR_AXIS_TOLERANCE:
                self.joints[i] = replace(joint, coupled=True)
                forwards = joint.parent == reference
                return joint.name, math.copysign(1.0, cosine if forwards else -cosine)
        raise self.values.fault(
            where,
            f"no revolute joint about its axis leads from its reference body {reference!r} "
            f"to {body!r}",
            "Add such joints: a gearbox is read as a coupling of two of them",
        )

    def _mimic(self, name: str, scope: Scope, node: Element) -> dict[str, Any]:
        values, where = self.values, f"joint {name!r}, <mimic>"
        if DRAKE_MIMIC.fullmatch(node.tag):  # with attributes in place of elements
            values.attributes(node, where, ("joint", "multiplier", "offset"))
            for key in ("multiplier", "offset"):
                if key in node.attrib:
                    SubElement(node, key).text = node.attrib[key]
        else:
            values.attributes(node, where, ("joint", "axis"))
            values.children(node, where, ("multiplier", "offset", "reference"), ())
        leader = scope.prefix + node.get("joint", "")
        if node.get("axis", "axis") != "axis":
            raise values.fault(where, "the second axis of a joint cannot lead", "Use axis")
        ratio = values.child_number(node, "multiplier", where, 1.0)
        offset, reference = (
            values.child_number(node, tag, where, 0.0) for tag in ("offset", "reference")
        )
        at = {joint.name: i for i, joint in enumerate(self.joints)}
        for end in (name, leader):
            if end not in at or self.joints[at[end]].type not in ("revolute", "prismatic"):
                problem = f"there is no revolute or prismatic joint {end!r}"
                raise values.fault(where, problem, "Couple two of those")
            self.joints[at[end]] = replace(self.joints[at[end]], coupled=True)
        out = {"name": f"{name}::mimic", "type": "coupling", "joints": [name, leader]}
        return {**out, "ratio": ratio, "offset": offset - ratio * reference}


def _along(joint: Joint, axis: Axis) -> Joint:
    acting: dict[str, Any] = dict(axis.acting)
    return replace(joint, axis=axis.direction, **acting)
