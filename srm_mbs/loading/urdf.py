"""URDF: checked by us, built by Pinocchio.

Pinocchio's parser drops what it does not know without a word: unknown elements, a second joint
with the same child, joint friction.  Everything that would change the mechanism is therefore
checked on the XML first; what is dropped knowingly is listed in the notes.
"""

from __future__ import annotations

import logging
import math
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
import pinocchio as pin
from defusedxml import DefusedXmlException
from defusedxml import ElementTree as SafeTree

from srm_mbs.errors import InputError, SrmWarning
from srm_mbs.mechanism import WORLD

log = logging.getLogger(__name__)

JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
WITH_AXIS = ("revolute", "continuous", "prismatic", "planar")
LOOP_ELEMENTS = ("loop_joint", "loop", "constraint", "coupling")
IGNORED = {
    "robot": ("material", "transmission", "gazebo", "sensor", "ros2_control", "verbose"),
    "link": (
        "visual",
        "collision",
        "contact",
        "self_filter",
        "sensor",
        "self_collision_checking",
        "collision_checking",
        "surface",
        "kinematic",
        "gravity",
    ),
    "joint": ("safety_controller", "calibration"),
}
READ = {
    "robot": ("link", "joint"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
}
ATTRIBUTES = {
    "link": ("name", "type"),
    "joint": ("name", "type", "dont_collapse"),
    "origin": ("xyz", "rpy"),
    "mass": ("value",),
    "inertia": ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
    "parent": ("link",),
    "child": ("link",),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction", "D", "K", "mu_coulomb", "mu_viscous"),
}
DRAWN_ONLY = ("material", "visual", "collision")
"""Elements whose loss needs no note: they do not act."""


@dataclass(frozen=True)
class UrdfModel:
    """A checked URDF and its tree.

    Attributes
    ----------
    model
        Pinocchio's model, with joint damping from the file.
    notes
        Sentences about what the file holds and this version does not use.
    """

    model: pin.Model
    notes: tuple[str, ...]


class _Checker:
    """Walks a URDF once; raises :class:`InputError` at the first fault."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.notes: list[str] = []
        self._ignored: dict[str, int] = {}

    def fault(self, element: str, problem: str, remedy: str | None = None) -> InputError:
        return InputError(problem, file=self.file, element=element, remedy=remedy)

    def numbers(self, node: Element, key: str, count: int, where: str) -> list[float]:
        """``count`` finite numbers of attribute ``key``."""
        text = node.get(key)
        try:
            values = [float(part) for part in (text or "").split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            wanted = "a finite number" if count == 1 else f"{count} finite numbers"
            raise self.fault(
                where, f"<{node.tag} {key}={text!r}> is not {wanted}", f"Write {wanted}"
            )
        return values

    def attributes(self, node: Element, where: str) -> None:
        known = ATTRIBUTES.get(node.tag)
        for key in node.attrib:
            if known is not None and key not in known:
                raise self.fault(
                    where,
                    f"<{node.tag}> has an unknown attribute {key!r}",
                    f"Known: {', '.join(known)}",
                )

    def children(self, node: Element, where: str) -> None:
        """Refuse unknown elements of ``node``; count those that are ignored."""
        read, ignored = READ[node.tag], IGNORED.get(node.tag, ())
        for child in node:
            tag = child.tag
            local = tag.rsplit("}", 1)[-1].rsplit(":", 1)[-1]
            if tag in read:
                self.attributes(child, where)
            elif tag in ignored:
                self._ignored[tag] = self._ignored.get(tag, 0) + 1
            elif local in LOOP_ELEMENTS or tag != local:
                raise self.fault(
                    f"{where}, <{local}>" if where else f"<{local}>",
                    f"the element <{local}> (a loop, coupling or force of another tool) is not "
                    "read by this version",
                    "Describe the loop as [[loop]] in a TOML description and remove the element",
                )
            else:
                raise self.fault(
                    where or f"<{tag}>",
                    f"unknown element <{tag}> in <{node.tag}>",
                    f"Known: {', '.join((*read, *ignored))}",
                )
        for tag in set(read) - {"link", "joint"}:
            if len(node.findall(tag)) > 1:
                raise self.fault(where, f"<{tag}> stands there twice", "Keep one")

    def named(self, root: Element, tag: str) -> dict[str, Element]:
        found: dict[str, Element] = {}
        for node in root.findall(tag):
            self.attributes(node, f"<{tag}>")
            name = node.get("name")
            if not name:
                raise self.fault(f"<{tag}>", "it has no name", 'Give name="..."')
            if name in found:
                raise self.fault(
                    f"{tag} {name!r}", f"two {tag}s have this name", "Rename one of them"
                )
            found[name] = node
        return found

    def check(self, root: Element, base: str) -> None:
        """The whole file."""
        if root.tag != "robot":
            raise self.fault(f"<{root.tag}>", "the root element is not <robot>")
        self.children(root, "")
        for block in root.findall("gazebo"):
            if block.find("joint") is not None:
                raise self.fault(
                    "<gazebo><joint>",
                    "joints inside <gazebo> close loops and are not read by this version",
                    "Describe the loop as [[loop]] in a TOML description and remove the element",
                )
        links, joints = self.named(root, "link"), self.named(root, "joint")
        if not links:
            raise self.fault("<robot>", "there is no <link>")
        for name, link in links.items():
            self.link(name, link)
        self.tree(links, joints, base)
        for name, joint in joints.items():
            self.joint(name, joint)
        for tag, count in self._ignored.items():
            if tag not in DRAWN_ONLY:
                self.notes.append(f"{count} <{tag}> element(s) do not act and are ignored")

    def link(self, name: str, link: Element) -> None:
        where = f"link {name!r}"
        self.children(link, where)
        inertial = link.find("inertial")
        if inertial is None:
            return
        self.children(inertial, where)
        self.origin(inertial, where)
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is None or inertia is None:
            missing = "mass" if mass is None else "inertia"
            raise self.fault(where, f"<inertial> has no <{missing}>", "Add it")
        (value,) = self.numbers(mass, "value", 1, where)
        if value < 0.0:
            raise self.fault(where, f"the mass {value:g} kg is negative", "Give a mass >= 0")
        xx, yy, zz, xy, xz, yz = (
            self.numbers(inertia, key, 1, where)[0] for key in ATTRIBUTES["inertia"]
        )
        principal = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        rounding = 1e-9 * float(np.abs(principal).max())
        if principal[0] < -rounding:
            raise self.fault(
                where,
                f"a principal moment of inertia is negative ({principal[0]:.3g} kg m^2)",
                "Check the entries of <inertia>",
            )
        if principal[0] + principal[1] < principal[2] - 1e-6 * principal[2] - rounding:
            note = (
                f"link {name!r}: the principal moments of inertia {principal[0]:.3g}, "
                f"{principal[1]:.3g}, {principal[2]:.3g} violate the triangle inequality: "
                "no real body has them"
            )
            self.notes.append(note)
            warnings.warn(f"{self.file}: {note}", SrmWarning, stacklevel=2)

    def origin(self, node: Element, where: str) -> None:
        origin = node.find("origin")
        if origin is None:
            return
        for key in ("xyz", "rpy"):
            if origin.get(key) is not None:
                self.numbers(origin, key, 3, where)

    def tree(self, links: dict[str, Element], joints: dict[str, Element], base: str) -> None:
        parent_joint: dict[str, str] = {}
        parent_link: dict[str, str] = {}
        for name, joint in joints.items():
            ends = {}
            for side in ("parent", "child"):
                node = joint.find(side)
                link = None if node is None else node.get("link")
                if not link:
                    raise self.fault(
                        f"joint {name!r}", f"it has no <{side} link=...>", f"Name its {side} link"
                    )
                if link not in links:
                    raise self.fault(
                        f"joint {name!r}",
                        f"its {side} link {link!r} does not exist",
                        f"Links: {', '.join(links)}",
                    )
                ends[side] = link
            child = ends["child"]
            if child in parent_joint:
                raise self.fault(
                    f"link {child!r}",
                    f"it is the child of two joints, {parent_joint[child]!r} and {name!r}",
                    "Keep one of them and describe the other as [[loop]] in a TOML description",
                )
            parent_joint[child], parent_link[child] = name, ends["parent"]
        roots = [link for link in links if link not in parent_joint]
        if len(roots) != 1:
            problem = (
                "every link has a parent: the joints form a ring"
                if not roots
                else f"{len(roots)} links have no parent joint: {', '.join(roots)}"
            )
            raise self.fault(
                "<robot>", problem, "A URDF needs exactly one root link; close loops by [[loop]]"
            )
        for link in links:
            seen, at = {link}, link
            while at in parent_link:
                at = parent_link[at]
                if at in seen:
                    raise self.fault(
                        f"link {link!r}", "it is its own ancestor", "Close loops by [[loop]]"
                    )
                seen.add(at)
        if WORLD in links and (roots[0] != WORLD or base != "fixed"):
            raise self.fault(
                f"link {WORLD!r}",
                f"{WORLD!r} is reserved for the ground, but here it moves",
                'Rename the link, or use base = "fixed"',
            )

    def joint(self, name: str, joint: Element) -> None:
        where = f"joint {name!r}"
        self.children(joint, where)
        kind = joint.get("type")
        if kind not in JOINT_TYPES:
            raise self.fault(
                where, f"unknown joint type {kind!r}", f"Known: {', '.join(JOINT_TYPES)}"
            )
        self.origin(joint, where)
        if joint.find("mimic") is not None:
            raise self.fault(
                where,
                "<mimic> (a coupling of two joints) is not read by this version",
                "Remove it, or lock the joint",
            )
        axis = joint.find("axis")
        turns = axis is not None and kind in WITH_AXIS
        if axis is not None and turns and not any(self.numbers(axis, "xyz", 3, where)):
            raise self.fault(where, "its axis is zero", "Give a direction")
        limit = joint.find("limit")
        if kind in ("revolute", "prismatic"):
            if limit is None:
                raise self.fault(
                    where,
                    f"a {kind} joint needs <limit lower upper effort velocity>",
                    'Add it, or use type="continuous" for an unlimited angle',
                )
            for key in ("effort", "velocity"):
                self.numbers(limit, key, 1, where)
        if limit is not None:
            for key in limit.attrib:
                self.numbers(limit, key, 1, where)
        dynamics = joint.find("dynamics")
        if dynamics is None:
            return
        for key in dynamics.attrib:
            (value,) = self.numbers(dynamics, key, 1, where)
            if key == "friction" and value != 0.0 and kind != "fixed":
                raise self.fault(
                    where,
                    f"joint friction ({value:g}) is not simulated by this version",
                    "Set it to 0; viscous damping acts",
                )
            if key == "damping" and value < 0.0:
                raise self.fault(where, f"the damping {value:g} is negative", "Give a value >= 0")
            if key not in ("damping", "friction") and value != 0.0:
                self.notes.append(f"{where}: <dynamics {key}> is no URDF attribute and is ignored")


def parse_urdf(text: str, file: str) -> Element:
    """Root element of ``text``.

    Raises
    ------
    InputError
        If it is not well-formed XML, or uses entities or external references.
    """
    try:
        return SafeTree.fromstring(text)  # type: ignore[no-any-return]
    except ParseError as error:
        hint = None
        prefix = re.search(r"unbound prefix", str(error))
        if prefix:
            hint = "An element with a namespace prefix, such as <drake:...>, is not read"
        raise InputError(f"this is not well-formed XML: {error}", file=file, remedy=hint) from error
    except DefusedXmlException as error:
        raise InputError(
            f"the XML uses entities or external references: {error}",
            file=file,
            remedy="Remove them; they are refused for safety",
        ) from error


ROOT_JOINTS: dict[str, Callable[[], Any] | None] = {
    "fixed": None,
    "floating": pin.JointModelFreeFlyer,
    "planar": pin.JointModelPlanar,
}


def _check_inertia(model: pin.Model, file: str) -> None:
    """Refuse a joint that moves no inertia at all: its equation of motion has no solution."""
    moved = np.zeros((model.njoints, 2))
    for joint in range(model.njoints - 1, 0, -1):
        inertia = model.inertias[joint]
        moved[joint] += inertia.mass, np.trace(inertia.inertia)
        moved[model.parents[joint]] += moved[joint]
    for joint in range(1, model.njoints):
        if not moved[joint].any():
            links = [
                f.name
                for f in model.frames
                if f.parentJoint == joint and f.type == pin.FrameType.BODY
            ]
            raise InputError(
                f"neither {', '.join(map(repr, links))} nor anything behind it has inertia",
                file=file,
                element=f"joint {model.names[joint]!r}",
                remedy="Give the moving end of the chain an <inertial>",
            )


def build_urdf(text: str, file: str, base: str) -> UrdfModel:
    """Check ``text`` and build its tree on a fixed, floating or planar base.

    Parameters
    ----------
    text, file
        The URDF and its name for messages.
    base
        ``fixed``, ``floating`` (root joint ``root_joint``, a free flyer) or ``planar`` (motion in
        the x-y plane of the world).

    Raises
    ------
    InputError
        Naming the file, the element and the remedy.
    """
    checker = _Checker(file)
    checker.check(parse_urdf(text, file), base)
    root_joint = ROOT_JOINTS[base]
    try:
        if root_joint is None:
            model = pin.buildModelFromXML(text)
        else:
            model = pin.buildModelFromXML(text, root_joint())
    except Exception as error:  # Boost.Python raises whatever Pinocchio throws
        raise InputError(f"Pinocchio cannot read it: {error}", file=file) from error
    _check_inertia(model, file)
    for note in checker.notes:
        log.info("%s: %s", file, note)
    return UrdfModel(model, tuple(checker.notes))


def lock_joints(model: pin.Model, names: list[str], q: Any) -> pin.Model:
    """``model`` without the joints ``names``, frozen at the configuration ``q`` (nq,).

    Pinocchio finds joints by frame name there, and URDF models give links and joints the same
    names; link frames are renamed while it works.
    """
    working = model.copy()
    mark = "\0link"
    for frame in working.frames:
        if frame.type == pin.FrameType.BODY:
            frame.name += mark
    reduced = pin.buildReducedModel(working, [working.getJointId(name) for name in names], q)
    for frame in reduced.frames:
        frame.name = frame.name.removesuffix(mark)
    return reduced
