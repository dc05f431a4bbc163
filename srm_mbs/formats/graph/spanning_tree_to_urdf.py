"""From a graph of joints to a URDF tree, with closures and springs of the joints that are cut.

The URDF is in the dialect of ``docs/formats.md``.  A joint that is cut becomes the closure with the
same freedom; :data:`CLOSURE_OF` has the names of joint types of all formats.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, naming
from srm_mbs.formats.graph.joint_graph import (
    ROOT_JOINT,
    Body,
    Joint,
    SpanningTree,
    components,
    spanning_tree,
)
from srm_mbs.formats.translation import Translation
from srm_mbs.model.anchors import WORLD

JOINT_FRAME = "::joint_frame"
"""Suffix of the massless link at a joint whose child has its frame elsewhere."""


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


IDENTITY_ROUNDING = 1e-13
"""Entries of a placement, m and rad, that are rounding of the identity's."""


def is_identity(placement: pin.SE3) -> bool:
    """Whether a placement is the identity within rounding."""
    return bool(placement.isIdentity(IDENTITY_ROUNDING))


def origin(parent: Element, placement: pin.SE3) -> None:
    """Add ``<origin>`` to an element, unless it is the identity."""
    if not is_identity(placement):
        SubElement(
            parent,
            "origin",
            xyz=numbers(placement.translation),
            rpy=numbers(rpy(placement.rotation)),
        )


def visual(
    placement: pin.SE3, shape: str, sizes: Mapping[str, str], rgba: Iterable[float] | None
) -> Element:
    """A ``<visual>``: the element ``shape`` of its geometry with the attributes ``sizes``; red,
    green, blue and opacity."""
    out = Element("visual")
    origin(out, placement)
    SubElement(SubElement(out, "geometry"), shape, dict(sizes))
    if rgba is not None:
        SubElement(SubElement(out, "material", name=""), "color", rgba=numbers(rgba))
    return out


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


def urdf_tree(name: str, bodies: Iterable[Body], joints: Sequence[Joint]) -> Element:
    """Root element of a URDF.

    A link keeps the frame that the file gave it.  Where the joint that carries it is elsewhere,
    a massless link is added at the joint, and the link is fixed to that.

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
    return robot


CLOSURE_OF = {
    "revolute": "revolute",
    "continuous": "revolute",
    "hinge": "revolute",
    "prismatic": "prismatic",
    "cylindrical": "cylindrical",
    "planar": "planar",
    "universal": "universal",
    "spherical": "point",
    "ball": "point",
    "fixed": "frame",
}
"""Joint types of all formats, and the closure of the same freedom."""
WITH_AXIS = ("revolute", "prismatic", "cylindrical", "planar")
FIXED_ABOUT_AXIS = ("frame", "prismatic")
"""Closures that fix the rotation of a about the axis."""
AXIS_TOLERANCE = 1e-9
"""Norm of the difference of two unit vectors below which they are the same axis."""


def placement(xyz: Sequence[float] | FloatArray, rpy: Sequence[float] | FloatArray) -> pin.SE3:
    """Placement of a URDF <origin>; m and rad."""
    return pin.SE3(pin.rpy.rpyToMatrix(np.array(rpy)), np.array(xyz))


def closure(
    kind: str,
    name: str,
    parent: tuple[str, pin.SE3],
    child: tuple[str, pin.SE3],
    axis: Sequence[float] | None = None,
    child_axis: Sequence[float] | None = None,
    *,
    fault: Callable[[str, str], Exception],
) -> dict[str, Any]:
    """The ``[[loop]]`` of a joint of type ``kind`` between two links.

    The child is a of the closure, the parent is b: the axis is given in the joint's frame on the
    parent, as URDF and SDF do.

    Parameters
    ----------
    kind
        Joint type in the words of its format.
    name
        Of the closure.
    parent, child
        Link and, in its frame, the joint's frame.
    axis, child_axis : (3,)
        Direction in the frame on the parent and, if it is given separately, in that on the child;
        for a universal joint the two axes of the cross.  x by default.
    fault
        Makes the exception of a problem and its remedy.

    Raises
    ------
    Exception
        What ``fault`` makes, for a type without closure, or axes that do not fit together.
    """
    type_ = CLOSURE_OF.get(kind)
    if type_ is None:
        raise fault(
            f"there is no closure for a joint of type {kind!r}",
            f"Known: {', '.join(CLOSURE_OF)}; or cut the loop at another joint",
        )
    direction = _unit((1.0, 0.0, 0.0) if axis is None else axis, fault)
    other = direction if child_axis is None else _unit(child_axis, fault)
    at = child[1]
    out: dict[str, Any] = {"name": name, "type": type_}
    if type_ == "universal":
        if child_axis is None:
            raise fault("a universal joint needs two axes", "Give both")
        out |= {"axis_a": other.tolist(), "axis_b": direction.tolist()}
    elif type_ in WITH_AXIS:
        out["axis"] = direction.tolist()
        if np.linalg.norm(other - direction) > AXIS_TOLERANCE:
            if type_ in FIXED_ABOUT_AXIS:
                raise fault(
                    f"the axes of a {kind} joint in its two frames differ",
                    "Turn one of the frames so that the axis has the same components in both",
                )
            # About the axis itself the child is free to turn.
            turn = pin.Quaternion.FromTwoVectors(direction, other).matrix()
            at = at * pin.SE3(turn, np.zeros(3))
    return out | {"a": anchor(child[0], at), "b": anchor(*parent)}


def satisfied_note(names: Iterable[str]) -> str:
    """The note about joints between bodies that do not move against each other."""
    return (
        f"the joints {', '.join(map(repr, names))} join bodies that other joints already hold "
        "together there: they are left out"
    )


def bushing(
    name: str,
    kind: str,
    parent: tuple[str, pin.SE3],
    child: tuple[str, pin.SE3],
    axis: Sequence[float],
    *,
    stiffness: float = 0.0,
    damping: float = 0.0,
    rest: float = 0.0,
) -> dict[str, Any]:
    """The ``[[force]]`` that acts as spring and damper of a revolute or prismatic joint.

    It acts in the one direction that the joint leaves free; ``parent``, ``child`` and ``axis`` are
    those of :func:`closure`, ``rest`` is where the spring is relaxed (rad, m).
    """
    # x of both anchors along the axis; b moves on to where the spring is relaxed.
    turn = pin.SE3(
        pin.Quaternion.FromTwoVectors(np.array([1.0, 0.0, 0.0]), np.array(axis)).matrix(),
        np.zeros(3),
    )
    relaxed = pin.SE3.Identity()
    direction = 0
    if CLOSURE_OF[kind] == "prismatic":
        relaxed.translation = np.array([rest, 0.0, 0.0])
    else:
        relaxed.rotation = pin.rpy.rpyToMatrix(rest, 0.0, 0.0)
        direction = 3
    out: dict[str, Any] = {
        "type": "bushing",
        "name": name,
        "a": anchor(child[0], child[1] * turn),
        "b": anchor(parent[0], parent[1] * turn * relaxed),
    }
    for key, value in (("stiffness", stiffness), ("damping", damping)):
        if value:
            out[key] = [value if i == direction else 0.0 for i in range(6)]
    return out


def _unit(axis: Sequence[float], fault: Callable[[str, str], Exception]) -> FloatArray:
    direction = np.array(axis, dtype=float)
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        raise fault("its axis is zero", "Give a direction")
    out: FloatArray = direction / length
    return out


MODEL_FRAME = "__model__"
"""Massless root link of a floating robot: the frame in which the file places its bodies."""


@dataclass(eq=False)
class GraphTranslator:
    """Translates bodies and joints of one file; raises :class:`InputError` at the first fault.

    Attributes
    ----------
    file, name
        Of the file, for messages, and of the robot.
    bodies
        By name, in the order of the file.
    placements
        Of the bodies in the world where every joint's position is zero.
    joints
        Between them.
    root
        The body that floats if nothing connects it with the ground.
    free
        Floating joints of bodies that nothing else connects with the ground, by body.
    notes
        Sentences about the translation.
    """

    file: str
    name: str
    bodies: Mapping[str, Body]
    placements: Mapping[str, pin.SE3]
    joints: Sequence[Joint]
    root: str
    free: Mapping[str, Joint] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def translate(self, cut: Sequence[str] = ()) -> Translation:
        """The tree and the entries ``base``, ``loop`` and ``force``.

        Parameters
        ----------
        cut
            Names of the joints to cut; empty: chosen by :func:`spanning_tree`.
        """
        base, root = self._rooted()
        with naming(file=self.file):
            tree = spanning_tree(self.joints, root, cut)
        entries: dict[str, Any] = {"base": base} if base != "fixed" else {}
        tree, satisfied = self._without_satisfied(tree)
        if tree.cut:
            entries["loop"] = [self._closure(joint) for joint in tree.cut]
        forces = [
            force
            for joint in self.joints
            if joint not in satisfied
            for force in self._springs(joint, joint in tree.cut)
        ]
        if forces:
            entries["force"] = forces
        self._add_notes(tree)
        urdf = urdf_tree(self.name, self.bodies.values(), tree.joints)
        return Translation(urdf, entries=entries, notes=tuple(self.notes))

    def _rooted(self) -> tuple[str, str]:
        """Base and root body; bodies that no joint connects to the ground get a floating joint."""
        parts = [part for part in components(self.bodies, self.joints) if part != [WORLD]]
        free = [part for part in parts if WORLD not in part]
        if len(parts) == 1 and free:
            root, joint = self.root, self.free.get(self.root)
            if not is_identity(self.placements[root]):
                self.bodies = {MODEL_FRAME: Body(MODEL_FRAME), **self.bodies}
                name = f"{MODEL_FRAME}::{root}"
                held = Joint(name, "fixed", MODEL_FRAME, root, self.placements[root])
                self.joints = (held, *self.joints)
                root = MODEL_FRAME
            if joint is None or not (joint.damping or joint.friction):
                return "floating", root
            # With damping it has to stand in the URDF.
            free_base = replace(joint, name=ROOT_JOINT, child=root, in_parent=pin.SE3.Identity())
            self.joints = (*self.joints, free_base)
            return "fixed", WORLD
        for part in free:
            joint = next((self.free[body] for body in part if body in self.free), None)
            if joint is None:
                body = self.root if self.root in part else part[0]
                name = f"{body}::free"
                joint = Joint(name, "floating", WORLD, body, self.placements[body])
                self.notes.append(
                    f"nothing connects {body!r} with the ground: it moves freely by the joint "
                    f"{name!r}"
                )
            self.joints = (*self.joints, joint)
        return "fixed", WORLD

    def _without_satisfied(self, tree: SpanningTree) -> tuple[SpanningTree, list[Joint]]:
        """The tree without those cut joints that join bodies which fixed joints of the tree hold
        together, and these joints: where the bodies are placed, they are satisfied."""
        holder: dict[str, str] = {}
        for joint in tree.joints:
            held = holder.get(joint.parent, joint.parent)
            holder[joint.child] = held if joint.type == "fixed" else joint.child
        satisfied = [
            joint
            for joint in tree.cut
            if holder.get(joint.parent, joint.parent) == holder.get(joint.child, joint.child)
        ]
        if satisfied:
            self.notes.append(satisfied_note(joint.name for joint in satisfied))
        kept = tuple(joint for joint in tree.cut if joint not in satisfied)
        return replace(tree, cut=kept), satisfied

    def _fault(self, joint: Joint, problem: str, remedy: str) -> InputError:
        return InputError(problem, file=self.file, element=f"joint {joint.name!r}", remedy=remedy)

    def _refuse_cut(self, joint: Joint, why: str) -> InputError:
        return self._fault(
            joint,
            f"it closes a loop and has {why}, which no closure has",
            "Name another joint of the loop in cut",
        )

    def _closure(self, joint: Joint) -> dict[str, Any]:
        """The closure for a joint that is cut."""
        for value, why in (
            (joint.friction, "friction"),
            (joint.armature, "armature"),
            (joint.type == "screw", "a thread"),
            (joint.coupled, "a coupling to another joint"),
        ):
            if value:
                raise self._refuse_cut(joint, why)
        return closure(
            joint.type,
            joint.name,
            (joint.parent, joint.in_parent),
            (joint.child, joint.in_child),
            joint.axis,
            joint.second_axis,
            fault=partial(self._fault, joint),
        )

    def _springs(self, joint: Joint, cut: bool) -> Iterator[dict[str, Any]]:
        """Spring and damper of a joint; the damping of a joint of the tree is in the URDF."""
        name = f"{joint.name}::spring"
        if cut and (joint.stiffness or joint.damping):
            if joint.type not in ("revolute", "prismatic"):
                raise self._refuse_cut(joint, "damping or a spring")
            yield bushing(
                name,
                joint.type,
                (joint.parent, joint.in_parent),
                (joint.child, joint.in_child),
                joint.axis,
                stiffness=joint.stiffness,
                damping=joint.damping,
                rest=joint.rest,
            )
        elif joint.stiffness:
            yield {
                "type": "torsion_spring",
                "name": name,
                "joint": joint.name,
                "stiffness": joint.stiffness,
                "rest_angle": joint.rest,
            }

    def _add_notes(self, tree: SpanningTree) -> None:
        """Note the joints that are cut, and those whose parent and child changed places."""
        if tree.cut:
            names = ", ".join(repr(joint.name) for joint in tree.cut)
            self.notes.append(f"the joints {names} close loops: they are cut and became closures")
        turned = [
            repr(joint.name)
            for joint in tree.joints
            if joint.name in tree.reversed and joint.type in ("universal", "spherical", "floating")
        ]
        if turned:
            self.notes.append(
                f"in the tree the joints {', '.join(turned)} start from their child: their "
                "coordinates are those of the parent against the child"
            )
