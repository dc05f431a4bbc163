"""Joints of an SDF file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.formats.graph.joint_graph import NO_LIMIT, Body, Direction, Joint
from srm_mbs.formats.sdf.links import Frames, joint_frame
from srm_mbs.formats.xml import XmlValues
from srm_mbs.model.anchors import WORLD

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
JOINT_READ = (
    "pose",
    "parent",
    "child",
    "axis",
    "axis2",
    "thread_pitch",
    "screw_thread_pitch",
    "gearbox_ratio",
    "gearbox_reference_body",
)
JOINT_IGNORED = ("physics", "sensor", "provide_feedback", "plugin")
AXIS_READ = ("xyz", "use_parent_model_frame", "dynamics", "limit", "initial_position", "mimic")
DYNAMICS_READ = ("damping", "friction", "spring_reference", "spring_stiffness")
LIMIT_READ = ("lower", "upper", "effort", "velocity")
LIMIT_IGNORED = ("stiffness", "dissipation")
ANGLE_COSINE_TOLERANCE = 1e-9
"""Of the cosine of the angle between two axes that are parallel or perpendicular."""
SECOND_AXIS_SUFFIX = "::axis2"
"""Suffix of the joint of a second axis that is a joint of its own."""


@dataclass(frozen=True, eq=False)
class Axis:
    """An ``<axis>``: direction in the joint's frame, and what it says of its coordinate."""

    direction: Direction
    dynamics: dict[str, float]
    limits: dict[str, float]
    mimic: Element | None


@dataclass(frozen=True, eq=False)
class Gearbox:
    """A gearbox joint: the angles of two other joints are coupled."""

    name: str
    reference: str
    parent: str
    child: str
    ratio: float
    axes: tuple[FloatArray, FloatArray]


class JointReader:
    """Reads joints, and turns gearboxes and mimics into couplings when all joints are known.

    Parameters
    ----------
    values, frames
        The file and its frames.
    """

    def __init__(self, values: XmlValues, frames: Frames) -> None:
        self.values, self.frames = values, frames
        self.joints: list[Joint] = []
        self.between: dict[str, Body] = {}
        self._frame_of: dict[str, str] = {}
        self._gearboxes: list[Gearbox] = []
        self._mimics: list[tuple[str, str, Element]] = []

    def fault(self, name: str, problem: str, remedy: str) -> InputError:
        return self.values.fault(f"joint {name!r}", problem, remedy)

    def read(self, node: Element, prefix: str, version: tuple[int, int]) -> None:
        """One ``<joint>`` of the model whose names begin with ``prefix``.

        Its frame must have been added to the frames.
        """
        name = prefix + node.get("name", "")
        where = f"joint {name!r}"
        values = self.values
        self._frame_of[name] = joint_frame(name, version)
        values.attributes(node, where, ("name", "type"))
        values.children(node, where, JOINT_READ, JOINT_IGNORED)
        kind = node.get("type", "")
        if kind not in TYPES:
            raise self.fault(name, f"there is no joint type {kind!r}", f"Known: {', '.join(TYPES)}")
        ends = [self.end(node, side, prefix, name) for side in ("parent", "child")]
        if ends[0] == ends[1]:
            raise self.fault(
                name, f"parent and child are both {ends[0]!r}", "Join two different links"
            )
        axes = [
            self._axis(node.find(tag), tag, name, prefix, version)
            for tag in TYPES[kind]
            if node.find(tag) is not None or kind != "gearbox"
        ]
        for tag in ("axis", "axis2"):
            if tag not in TYPES[kind] and node.find(tag) is not None:
                values.remark(
                    f"<{tag}> of a {kind} joint means nothing; its limits and dynamics do not act",
                    name,
                )
        if kind == "gearbox":
            self._gearboxes.append(self._gearbox(node, name, prefix, (ends[0], ends[1]), axes))
            return
        at = self._placement(name)
        in_parent, in_child = (self.frames.placement(end, where).actInv(at) for end in ends)
        joint = Joint(name, "fixed", ends[0], ends[1], in_parent, in_child)
        self._add(joint, kind, axes, node)
        for axis in axes:
            if axis.mimic is not None:
                self._mimics.append((name, prefix, axis.mimic))

    def _placement(self, name: str) -> pin.SE3:
        """Placement of a joint's frame in the world."""
        return self.frames.placement(self._frame_of[name], f"joint {name!r}")

    def end(self, node: Element, side: str, prefix: str, name: str) -> str:
        """The link that a joint's parent or child belongs to."""
        text = (node.findtext(side) or "").strip()
        if not text:
            raise self.fault(name, f"it has no <{side}>", f"Name its {side} link")
        return self.frames.body(text if text == WORLD else prefix + text, f"joint {name!r}")

    def _add(self, joint: Joint, kind: str, axes: list[Axis], node: Element) -> None:
        match kind:
            case "fixed":
                self.joints.append(joint)
            case "ball":
                self.joints.append(replace(joint, type="spherical"))
            case "universal" | "revolute2":
                self._two_axes(joint, axes)
            case "screw":
                pitch = self._pitch(node, joint.name)
                self.joints.append(_along(replace(joint, type="screw", pitch=pitch), axes[0]))
            case _:
                # Without limits also "revolute": its angle counts turns, and none of them acts.
                one = "prismatic" if kind == "prismatic" else "revolute"
                self.joints.append(_along(replace(joint, type=one), axes[0]))

    def _two_axes(self, joint: Joint, axes: list[Axis]) -> None:
        first, second = axes
        cosine = float(np.dot(first.direction, second.direction))
        if 1.0 - abs(cosine) < ANGLE_COSINE_TOLERANCE:
            raise self.fault(joint.name, "its two axes are parallel", "Correct <axis2>")
        acts = any(axis.dynamics[key] for axis in axes for key in axis.dynamics if key != "rest")
        if abs(cosine) < ANGLE_COSINE_TOLERANCE and not acts and not (first.mimic or second.mimic):
            self.joints.append(
                replace(
                    joint,
                    type="universal",
                    axis=first.direction,
                    second_axis=second.direction,
                )
            )
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
        where = f"joint {name!r}"
        given = node.find("screw_thread_pitch")
        if given is not None:
            return float(self.values.numbers(given.text, 1, where, "<screw_thread_pitch>")[0])
        older = node.find("thread_pitch")
        if older is None:
            raise self.fault(name, "it has no <screw_thread_pitch>", "Give it, in m per turn")
        per_metre = float(self.values.numbers(older.text, 1, where, "<thread_pitch>")[0])
        if per_metre == 0.0:
            raise self.fault(name, "<thread_pitch> is zero", "Give <screw_thread_pitch>")
        self.values.remark(
            "<thread_pitch> x is read as libsdformat converts it, -2 pi/x metres per turn", name
        )
        return -2.0 * math.pi / per_metre

    def _axis(
        self, node: Element | None, tag: str, name: str, prefix: str, version: tuple[int, int]
    ) -> Axis:
        where = f"joint {name!r}, <{tag}>"
        values = self.values
        if node is None:
            raise values.fault(f"joint {name!r}", f"it has no <{tag}>", "Add it")
        values.children(node, where, AXIS_READ, ())
        xyz = node.find("xyz")
        direction = np.array([0.0, 0.0, 1.0])
        if xyz is not None:
            values.attributes(xyz, where, ("expressed_in",) if version >= (1, 7) else ())
            direction = values.numbers(xyz.text, 3, where, "<xyz>")
        direction = values.direction(direction, where, "the axis")
        frame = "" if xyz is None else xyz.get("expressed_in", "")
        older = node.find("use_parent_model_frame")
        if version < (1, 7):
            in_model = version < (1, 5)
            if older is not None:
                in_model = values.truth(older.text, where, "<use_parent_model_frame>")
            frame = "__model__" if in_model else ""
        elif older is not None:
            raise values.fault(
                where,
                f"<use_parent_model_frame> does not exist in SDF {version[0]}.{version[1]}",
                'Write <xyz expressed_in="__model__">',
            )
        if frame:
            turn = self.frames.placement(prefix + frame, where).rotation
            direction = self._placement(name).rotation.T @ turn @ direction
        start = node.find("initial_position")
        if start is not None and values.numbers(start.text, 1, where, "<initial_position>").any():
            raise values.fault(
                where, "<initial_position> is not read by this version", "Pose the links instead"
            )
        x, y, z = direction.tolist()
        return Axis(
            (x, y, z),
            self._dynamics(node.find("dynamics"), where),
            self._limits(node.find("limit"), where),
            node.find("mimic"),
        )

    def _dynamics(self, node: Element | None, where: str) -> dict[str, float]:
        found = dict.fromkeys(DYNAMICS_READ, 0.0)
        if node is not None:
            self.values.children(node, where, DYNAMICS_READ, ())
            for child in node:
                if child.tag in found:
                    what = f"<{child.tag}>"
                    found[child.tag] = float(self.values.numbers(child.text, 1, where, what)[0])
                    if child.tag != "spring_reference" and found[child.tag] < 0.0:
                        raise self.values.fault(where, f"{what} is negative", "Give a value >= 0")
        return {
            "damping": found["damping"],
            "friction": found["friction"],
            "stiffness": found["spring_stiffness"],
            "rest": found["spring_reference"],
        }

    def _limits(self, node: Element | None, where: str) -> dict[str, float]:
        found: dict[str, float] = {}
        if node is not None:
            self.values.children(node, where, LIMIT_READ, LIMIT_IGNORED)
            for child in node:
                if child.tag in LIMIT_READ:
                    value = self.values.limit(child.text or "", where, f"<{child.tag}>")
                    found[child.tag] = float(np.clip(value, -NO_LIMIT, NO_LIMIT))
        if found.get("lower", -NO_LIMIT) > found.get("upper", NO_LIMIT):
            raise self.values.fault(where, "<lower> is above <upper>", "Exchange them")
        for tag, key in (("effort", "effort"), ("velocity", "speed")):
            value = found.pop(tag, NO_LIMIT)
            found[key] = value if value >= 0.0 else NO_LIMIT  # -1 means no limit
        return found

    # Couplings ------------------------------------------------------------------------------

    def _gearbox(
        self, node: Element, name: str, prefix: str, ends: tuple[str, str], axes: list[Axis]
    ) -> Gearbox:
        where = f"joint {name!r}"
        reference = (node.findtext("gearbox_reference_body") or "").strip()
        if not reference or len(axes) != 2:
            missing = "<axis> and <axis2>" if reference else "<gearbox_reference_body>"
            raise self.fault(name, f"a gearbox needs {missing}", "Add it")
        ratio = self.values.numbers(
            node.findtext("gearbox_ratio", "1"), 1, where, "<gearbox_ratio>"
        )[0]
        if ratio == 0.0:
            raise self.fault(name, "<gearbox_ratio> is zero", "Give the ratio of the angles")
        turn = self._placement(name).rotation
        one, other = (turn @ np.array(axis.direction) for axis in axes)
        full = self.frames.body(WORLD if reference == WORLD else prefix + reference, where)
        return Gearbox(name, full, *ends, float(ratio), (one, other))

    def _hinge(self, gear: Gearbox, body: str, axis: FloatArray) -> tuple[str, float]:
        """The hinge between a gearbox's reference body and ``body``, and its sign about axis."""
        for i, joint in enumerate(self.joints):
            if joint.type != "revolute" or {joint.parent, joint.child} != {gear.reference, body}:
                continue
            turn = self.frames.placement(joint.parent, "").rotation @ joint.in_parent.rotation
            cosine = float(turn @ np.array(joint.axis) @ axis)
            if 1.0 - abs(cosine) < 1e-6:
                self.joints[i] = replace(joint, coupled=True)
                forwards = joint.parent == gear.reference
                return joint.name, math.copysign(1.0, cosine if forwards else -cosine)
        raise self.fault(
            gear.name,
            f"no revolute joint about its axis leads from its reference body {gear.reference!r} "
            f"to {body!r}",
            "Add such joints: a gearbox is read as a coupling of two of them",
        )

    def couplings(self) -> list[dict[str, Any]]:
        """The gearboxes and mimics as closures of the type ``coupling``.

        A gearbox holds theta_2 = -ratio theta_1, with the angles of its parent and its child
        against the reference body.
        """
        out = []
        for gear in self._gearboxes:
            first, sign_1 = self._hinge(gear, gear.parent, gear.axes[0])
            second, sign_2 = self._hinge(gear, gear.child, gear.axes[1])
            ratio = -gear.ratio * sign_1 * sign_2
            out.append(
                {
                    "name": gear.name,
                    "type": "coupling",
                    "joints": [second, first],
                    "ratio": ratio,
                }
            )
        for name, prefix, node in self._mimics:
            out.append(self._mimic(name, prefix, node))
        return out

    def _mimic(self, name: str, prefix: str, node: Element) -> dict[str, Any]:
        where = f"joint {name!r}, <mimic>"
        self.values.attributes(node, where, ("joint", "axis"))
        self.values.children(node, where, ("multiplier", "offset", "reference"), ())
        leader = prefix + node.get("joint", "")
        if node.get("axis", "axis") != "axis":
            raise self.values.fault(where, "the second axis of a joint cannot lead", "Use axis")
        number = {
            tag: float(self.values.numbers(node.findtext(tag, default), 1, where, f"<{tag}>")[0])
            for tag, default in (("multiplier", "1"), ("offset", "0"), ("reference", "0"))
        }
        for end in (name, leader):
            joint = next((joint for joint in self.joints if joint.name == end), None)
            if joint is None or joint.type not in ("revolute", "prismatic"):
                raise self.values.fault(
                    where,
                    f"there is no revolute or prismatic joint {end!r}",
                    "Couple two of those",
                )
            self.joints[self.joints.index(joint)] = replace(joint, coupled=True)
        return {
            "name": f"{name}::mimic",
            "type": "coupling",
            "joints": [name, leader],
            "ratio": number["multiplier"],
            "offset": number["offset"] - number["multiplier"] * number["reference"],
        }


def _along(joint: Joint, axis: Axis) -> Joint:
    acting: dict[str, Any] = {**axis.dynamics, **axis.limits}
    return replace(joint, axis=axis.direction, **acting)
