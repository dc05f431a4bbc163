"""Check of a URDF before Pinocchio reads it.

Pinocchio's parser drops unknown content without a message: unknown elements, a second joint with
the same child, a whole <inertial> whose numbers are separated by a newline.  Everything that would
change the mechanism is therefore checked on the XML.  Unknown elements and attributes are refused,
ignored ones are counted and removed; what remains has its numbers written afresh.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs.errors import SrmWarning
from srm_mbs.formats.graph.joint_graph import ROOT_JOINT, inertia_at, inertia_tensor
from srm_mbs.formats.urdf.graph import Graph, origin_placement
from srm_mbs.formats.urdf.joint_types import EXTENDED_TYPES
from srm_mbs.formats.xml import NAMESPACED, XmlFile, local_name, parse_numbers, words
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.numbers import LARGEST_MAGNITUDE

LOOP_ELEMENTS = ("loop_joint", "loop", "constraint", "coupling")
IGNORED = {
    "robot": words(
        "material transmission gazebo sensor ros2_control verbose frame collision_filter_group"
    ),
    "link": words(
        "visual collision contact self_filter sensor self_collision_checking collision_checking "
        "surface kinematic gravity"
    ),
    "joint": words("safety_controller calibration joint_properties"),
}
READ = {
    "robot": ("link", "joint"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": words("origin parent child axis axis2 thread_pitch limit dynamics"),
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
    "axis2": ("xyz",),
    "thread_pitch": ("value",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction", "armature"),
}
INFORMATIVE = {
    "joint": ("independent",),
    "link": ("concave",),
    "limit": words("twist command_effort current gear_velocity acceleration deceleration jerk"),
    "dynamics": ("D", "K", "mu_coulomb", "mu_viscous", "coulomb_window"),
}
"""Attributes of other tools found in published files, with or without a prefix: ignored, with a
note."""
PREFIXED = ("collision_filter_group",)
"""Elements of a robot that Drake writes with a prefix: ignored, with a note."""
DRAWN_ONLY = ("material", "visual")
"""Elements that are removed without a note: they do not act."""
SHAPES = (*DRAWN_ONLY, "collision")
"""Elements in which an inertia would be lost."""
MANY = ("link", "joint")
"""Elements that may be there several times."""
DESCRIBE_LOOP = "Describe the loop as [[loop]] in a TOML description and remove the element"


class ElementChecker(XmlFile):
    """Checks of elements and attributes of a URDF; faults are :class:`InputError`."""

    def __init__(self, file: str) -> None:
        super().__init__(file)
        self.notes: list[str] = []

    def vector(self, node: Element, key: str, where: str, count: int = 3) -> list[float]:
        """``count`` finite numbers of attribute ``key``, which is rewritten in one form."""
        text, tag = node.get(key), local_name(node)
        if text is None:
            raise self.fault(where, f"<{tag}> has no {key!r}", f'Give {key}="..."')
        # Limits do not act, and exporters write the largest double there.
        largest = sys.float_info.max if tag == "limit" else LARGEST_MAGNITUDE
        values = parse_numbers(text, largest)
        if values is None or len(values) != count:
            values = self.numbers(text, count, where, f"<{tag} {key}>", largest).tolist()
        node.set(key, " ".join(map(repr, values)))
        return values

    def vector_or_zero(self, node: Element | None, key: str, where: str) -> list[float]:
        """Three numbers; zero without the attribute."""
        if node is None or node.get(key) is None:
            return [0.0, 0.0, 0.0]
        return self.vector(node, key, where)

    def number(self, node: Element, key: str, where: str) -> float:
        """The finite number of attribute ``key``."""
        return self.vector(node, key, where, 1)[0]

    def number_or(self, default: float, node: Element | None, key: str, where: str) -> float:
        """The number of attribute ``key``; ``default`` without the attribute."""
        return default if node is None or node.get(key) is None else self.number(node, key, where)

    def attributes(self, node: Element, where: str, count: bool = True) -> None:
        """Refuse unknown attributes; count and remove those that are ignored, or leave them."""
        known = INFORMATIVE.get(node.tag, ())
        ignored = [key for key in node.attrib if NAMESPACED.sub("", key) in known]
        if node.tag in ATTRIBUTES:
            self.only(node, where, ATTRIBUTES[node.tag], ignored)
        if count:
            for key in ignored:
                self.ignore(f"<{node.tag} {NAMESPACED.sub('', key)}> attribute")
                del node.attrib[key]

    def children(self, node: Element, where: str) -> None:
        """Refuse unknown elements of ``node``; count and remove those that are ignored."""
        read, ignored = READ[node.tag], IGNORED.get(node.tag, ())
        for child in list(node):
            tag, local = child.tag, local_name(child)
            before = f"{where}, " if where else ""
            if tag in read:
                self.attributes(child, where)
                if tag not in READ and len(child):
                    problem = f"unknown element <{child[0].tag}> in <{tag}>"
                    raise self.fault(where, problem, "Remove it")
            elif tag in ignored or (node.tag == "robot" and local in PREFIXED):
                self.nothing_acts_in(child, f"{before}<{local}>")
                if tag not in DRAWN_ONLY:
                    self.ignore(f"<{local}> element")
                for _ in child.iter("plugin"):
                    self.ignore("<plugin> element")
                node.remove(child)
            elif "xacro" in tag.rsplit("}", 1)[0] and tag != local:
                raise self.fault(
                    f"{before}<xacro:{local}>",
                    "this is a xacro macro, not URDF",
                    "Run xacro on the file first",
                )
            elif local in LOOP_ELEMENTS or tag != local:
                raise self.fault(
                    f"{before}<{local}>",
                    f"the element <{local}> (a loop, coupling or force of another tool) is not "
                    "read by this version",
                    DESCRIBE_LOOP,
                )
            else:
                problem = f"unknown element <{tag}> in <{node.tag}>"
                raise self.unknown(where or f"<{tag}>", problem, (*read, *ignored))
        for tag in read:
            found = node.findall(tag)
            if tag in MANY or len(found) < 2:
                continue
            first, *others = found
            if len(first) or any(other.attrib != first.attrib or len(other) for other in others):
                raise self.fault(where, f"<{tag}> is given twice", "Keep one")
            for other in others:
                node.remove(other)
            self.ignore(f"repeated <{tag}> element")

    def nothing_acts_in(self, node: Element, where: str) -> None:
        """Refuse loops and couplings in an element that is ignored as a whole, and inertia in one
        that is only drawn: the link would lose it."""
        for inner in node.iter():
            if inner.tag in (*LOOP_ELEMENTS, "mimic"):
                raise self.fault(
                    f"{where}, <{inner.tag}>",
                    f"the element <{inner.tag}> (a loop or coupling) inside <{node.tag}> is not "
                    "read by this version",
                    DESCRIBE_LOOP,
                )
            if node.tag in SHAPES and inner.tag in ("inertial", "mass", "inertia"):
                raise self.fault(
                    where,
                    f"<{inner.tag}> inside <{node.tag}> would not act",
                    "Put <mass> and <inertia> into the <inertial> of the link",
                )

    def named(self, root: Element, tag: str, count: bool = True) -> dict[str, Element]:
        """The elements of that tag by name; ``count`` as for :meth:`attributes`."""
        found: dict[str, Element] = {}
        for node in root.findall(tag):
            self.attributes(node, f"<{tag}>", count)
            name = node.get("name")
            if not name:
                raise self.fault(f"<{tag}>", "it has no name", 'Give name="..."')
            if name in found:
                where = f"{tag} {name!r}"
                raise self.fault(where, f"two {tag}s have this name", "Rename one of them")
            found[name] = node
        return found

    def origin(self, node: Element, where: str) -> None:
        for key in ("xyz", "rpy"):
            self.vector_or_zero(node.find("origin"), key, where)


URDF_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
JOINT_TYPES = (*URDF_TYPES, *EXTENDED_TYPES)
WITH_AXIS = ("revolute", "continuous", "prismatic", "planar", "universal", "screw")
WITH_LIMIT = ("revolute", "continuous", "prismatic", "screw")
UNIVERSE = "universe"
"""Pinocchio's name for the ground."""
PARALLEL_AXES_TOLERANCE = 1e-6
"""Axes of a universal joint at an angle (rad) below this are parallel."""
LARGEST_TREE_DEPTH = 1000
"""Largest number of links between the root and a leaf: Pinocchio's recursive parser overflows the
stack in deeper trees."""
POINT_MASS_GYRATION_SQUARED = 1e-18
"""Square of the radius of gyration (m^2) below which it is rounding: a nanometre."""


def doubtful_moments(principal: Any, mass: Any) -> tuple[Any, Any]:
    """Whether principal moments (..., 3), ascending (kg m^2), of bodies of ``mass`` (...,) kg are
    negative, and whether they violate the triangle inequality."""
    least, middle, largest = np.moveaxis(principal, -1, 0)
    rounding = 1e-9 * np.abs(principal).max(axis=-1) + POINT_MASS_GYRATION_SQUARED * mass
    return least < -rounding, least + middle < largest - 1e-6 * largest - rounding


class UrdfChecker(ElementChecker):
    """Walks a URDF once; raises :class:`InputError` at the first fault."""

    def __init__(self, file: str) -> None:
        super().__init__(file)
        self._inertias: dict[str, pin.Inertia] = {}
        self._negative: dict[str, float] = {}

    def check(self, root: Element, base: str, locked: Sequence[str]) -> None:
        """Check the whole file; ``root`` keeps what Pinocchio is to read."""
        self.root(root)
        for block in root.findall("gazebo"):
            for joint in block.iter("joint"):
                if joint.find("child") is not None:
                    raise self.fault(
                        f"<gazebo><joint> {joint.get('name', '')!r}",
                        "a joint deep inside <gazebo> is not read",
                        "Move it up, directly into <gazebo>",
                    )
        self.children(root, "")
        links, joints = self.named(root, "link"), self.named(root, "joint")
        if not links:
            raise self.fault("<robot>", "there is no <link>", "Add one for every body")
        for name, link in links.items():
            self.link(name, link)
        self.tree(links, joints, base)
        self.negative_moments(root, links)
        for name, joint in joints.items():
            self.joint(name, joint, base, name in locked)
        self.notes += self.ignored_notes()

    def root(self, root: Element) -> None:
        """The root element and its attributes, of which the name is kept."""
        if root.tag.endswith("}robot"):
            raise self.fault(
                "<robot>",
                "it has a default namespace (xmlns=...), so that none of its elements is URDF",
                "Remove the attribute xmlns",
            )
        if root.tag != "robot":
            raise self.fault(f"<{root.tag}>", "the root element is not <robot>", "Give a URDF file")
        version = root.get("version", "1.0")
        if version not in ("1", "1.0", "1.1", "1.2"):
            raise self.fault(
                "<robot>", f"there is no URDF version {version!r}", "Known: 1.0, 1.1, 1.2"
            )
        name = root.get("name")
        if not name:
            raise self.fault("<robot>", "it has no name", 'Give name="..."')
        root.attrib.clear()
        root.set("name", name)

    def link(self, name: str, link: Element) -> None:
        where = f"link {name!r}"
        origin = link.find("origin")
        if origin is not None:  # of no meaning in URDF, but exporters write it with zeros
            self.attributes(origin, where)
            for key in ("xyz", "rpy"):
                if any(self.vector_or_zero(origin, key, where)):
                    raise self.fault(
                        where,
                        "<origin> in <link> has no meaning in URDF and would not move anything",
                        "Put it into the joint, <inertial> or <visual> that it belongs to",
                    )
            link.remove(origin)
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
        value = self.number(mass, "value", where)
        if value < 0.0:
            raise self.fault(where, f"the mass {value:g} kg is negative", "Give a mass >= 0")
        moments = [self.number(inertia, key, where) for key in ATTRIBUTES["inertia"]]
        self._inertias[name] = inertia_at(origin_placement(inertial), value, moments)
        principal = np.linalg.eigvalsh(inertia_tensor(moments))
        negative, impossible = doubtful_moments(principal, value)
        if negative:
            self._negative[name] = principal[0]
        elif impossible:
            self.warn(
                f"link {name!r}: the principal moments of inertia {principal[0]:.3g}, "
                f"{principal[1]:.3g}, {principal[2]:.3g} violate the triangle inequality: "
                "no real body has them"
            )

    def warn(self, note: str) -> None:
        """Note what is doubtful, and warn of it."""
        self.notes.append(note)
        warnings.warn(f"{self.file}: {note}", SrmWarning, stacklevel=2)

    def negative_moments(self, root: Element, links: dict[str, Element]) -> None:
        """Refuse negative principal moments, unless those of the whole body that fixed joints make
        of the link and others are positive."""
        if not self._negative:
            return
        graph = Graph(root)
        held = {name: graph.held(name) for name in links}
        for name, least in self._negative.items():
            body = [link for link in links if held[link][0] == held[name][0]]
            total = pin.Inertia.Zero()
            for link in body:
                total += held[link][1].act(self._inertias.get(link, pin.Inertia.Zero()))
            what = f"a principal moment of inertia is negative ({least:.3g} kg m^2)"
            if not np.linalg.eigvalsh(total.inertia)[0] > 0.0:
                raise self.fault(f"link {name!r}", what, "Check the entries of <inertia>")
            self.warn(f"link {name!r}: {what}; with the links fixed to it, all are positive")

    def joint(self, name: str, joint: Element, base: str, locked: bool) -> None:
        where = f"joint {name!r}"
        if name == UNIVERSE or (name == ROOT_JOINT and base != "fixed"):
            raise self.fault(
                where,
                f"the name {name!r} is reserved"
                + (f' with base = "{base}"' if name == ROOT_JOINT else ""),
                "Rename the joint",
            )
        axis = joint.find("axis")
        if axis is not None and not any(self.vector_or_zero(axis, "rpy", where)):
            axis.attrib.pop("rpy", None)  # of no meaning in URDF, but written with zeros
        self.children(joint, where)
        kind = joint.get("type")
        if kind not in JOINT_TYPES:
            raise self.unknown(where, f"there is no joint type {kind!r}", JOINT_TYPES)
        self.origin(joint, where)
        self.axis(joint, kind, where)
        self.only_of(joint, kind, where)
        self.limit(joint, kind, where)
        self.dynamics(joint, kind, where, locked)

    def axis(self, joint: Element, kind: str, where: str) -> None:
        axis = joint.find("axis")
        if axis is not None and kind not in WITH_AXIS:
            joint.remove(axis)
            axis = None
        direction = [1.0, 0.0, 0.0] if axis is None else self.direction(axis, where)
        if kind == "planar" and (direction[:2] != [0.0, 0.0] or direction[2] < 0.0):
            given = " (the default of URDF)" if axis is None else ""
            raise self.fault(
                where,
                f"the normal of a planar joint is read along z only, not {direction}{given}",
                'Write <axis xyz="0 0 1"/> and turn the joint by <origin rpy=...>',
            )

    def direction(self, axis: Element, where: str) -> list[float]:
        """The unit vector of <axis> or <axis2>, written afresh."""
        direction = self.vector(axis, "xyz", where)
        if not any(direction):
            raise self.fault(where, "its axis is zero", "Give a direction")
        # Pinocchio does not normalise a tiny axis, and takes 2 x for an inclined one.
        length = math.hypot(*direction)
        direction = [component / length for component in direction]
        axis.set("xyz", " ".join(map(repr, direction)))
        return direction

    def only_of(self, joint: Element, kind: str, where: str) -> None:
        """<axis2> of a universal joint and <thread_pitch> of a screw."""
        for tag, owner in (("axis2", "universal"), ("thread_pitch", "screw")):
            node = joint.find(tag)
            if (node is not None) != (kind == owner):
                raise self.fault(
                    where,
                    f"a {kind} joint takes no <{tag}>"
                    if node is not None
                    else f"a {owner} joint needs <{tag}>",
                    "Remove it" if node is not None else "Add it",
                )
            if node is None:
                continue
            if tag == "thread_pitch":
                if self.number(node, "value", where) == 0.0:
                    raise self.fault(
                        where, "its thread pitch is zero", 'Give m per turn, or type="revolute"'
                    )
                continue
            axis = joint.find("axis")
            first = [1.0, 0.0, 0.0] if axis is None else self.direction(axis, where)
            second = self.direction(node, where)
            if np.linalg.norm(np.cross(first, second)) < PARALLEL_AXES_TOLERANCE:
                raise self.fault(
                    where, "<axis> and <axis2> are parallel", "Give them different directions"
                )

    def limit(self, joint: Element, kind: str, where: str) -> None:
        limit = joint.find("limit")
        if limit is None:
            if kind in ("revolute", "prismatic"):
                raise self.fault(
                    where,
                    f"a {kind} joint needs <limit lower upper effort velocity>",
                    'Add it, or use type="continuous" for an unlimited angle'
                    if kind == "revolute"
                    else "Add it",
                )
            return
        for key in limit.attrib:
            self.number(limit, key, where)
        if kind not in WITH_LIMIT:
            joint.remove(limit)
            return
        for key in ("effort", "velocity"):
            if limit.get(key) is None and kind in ("continuous", "screw"):
                limit.set(key, "0.0")  # Pinocchio wants both; limits do not act here
            value = self.number(limit, key, where)
            if value < 0.0:
                raise self.fault(
                    where, f"the limit {key} = {value:g} is negative", "Give a value >= 0"
                )
        lower, upper = (self.number_or(0.0, limit, key, where) for key in ("lower", "upper"))
        if lower > upper:
            self.notes.append(
                f"{where}: its limits are none: lower = {lower:g} is above upper = {upper:g}"
            )

    def dynamics(self, joint: Element, kind: str, where: str, locked: bool) -> None:
        dynamics = joint.find("dynamics")
        if dynamics is None:
            return
        for key in dynamics.attrib:
            value = self.number(dynamics, key, where)
            if value < 0.0:
                raise self.fault(where, f"the {key} {value:g} is negative", "Give a value >= 0")
        if not dynamics.attrib:
            joint.remove(dynamics)

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
                    problem = f"its {side} link {link!r} does not exist"
                    raise self.unknown(f"joint {name!r}", problem, links)
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
                "<robot>", problem, "Keep exactly one root link; close loops by [[loop]]"
            )
        depth = {roots[0]: 0}
        for link in links:
            at, path = link, dict[str, None]()
            while at not in depth:
                if at in path:
                    raise self.fault(
                        f"link {at!r}",
                        f"it is its own ancestor: the joints from {parent_link[at]!r} to it form a "
                        "ring",
                        "Close loops by [[loop]] in a TOML description",
                    )
                path[at] = None
                at = parent_link[at]
            for below in reversed(path):
                depth[below] = depth[parent_link[below]] + 1
                if depth[below] > LARGEST_TREE_DEPTH:
                    raise self.fault(
                        f"link {below!r}",
                        f"more than {LARGEST_TREE_DEPTH} joints lie between it and the root link",
                        "Split the chain: Pinocchio cannot read such a deep one",
                    )
        for reserved in (WORLD, UNIVERSE):
            if reserved in links and (roots[0] != reserved or base != "fixed"):
                raise self.fault(
                    f"link {reserved!r}",
                    f"{reserved!r} is reserved for the ground, but here it moves",
                    'Rename the link, or use base = "fixed"'
                    if roots[0] == reserved
                    else "Rename the link",
                )
