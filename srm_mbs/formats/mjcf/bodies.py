"""The tree of bodies of an MJCF file.

Joint positions are zero in the pose of the file: MuJoCo's value there, a joint's ``ref``, is
subtracted from its limits and from the rest position of its spring.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import replace
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.formats.graph.joint_graph import FREEDOM, Body, Joint, inertia_at
from srm_mbs.formats.graph.spanning_tree_to_urdf import anchor
from srm_mbs.formats.mjcf.attributes import BODY_IGNORED, BODY_READ, Attributes, MjcfValues
from srm_mbs.formats.mjcf.geoms import Geom, Mesh, inertia_of, read_geom, visuals_of
from srm_mbs.formats.mjcf.parts import Part, attached_part
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.forces import OPEN_LIMIT
from srm_mbs.model.reach import Reach

JOINT_TYPES = ("hinge", "slide", "ball", "free")
"""The default first."""
MOST_REPLICATED = 2000
"""Number of elements that the replicates of a file add: a line of text makes no more than some
hundred bodies, which load in two seconds."""
REFUSED = {
    "flexcomp": "a deformable body",
    "composite": "a chain or net of bodies",
}
"""Elements of a body that are refused, and what they are."""
FLAGS = {"stiffness": "spring", "damping": "damper", "friction": "frictionloss"}
"""Properties of a joint, and the flags that switch them off."""
_LINEAR, _ANGULAR = np.eye(6)[:3], np.eye(6)[3:]
MOTIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "fixed": lambda axis: np.zeros((0, 6)),
    "revolute": lambda axis: axis[None] @ _ANGULAR,
    "prismatic": lambda axis: axis[None] @ _LINEAR,
    "spherical": lambda axis: _ANGULAR,
    "floating": lambda axis: np.eye(6),
}
"""Twists (freedom, 6) of the joints, linear then angular, in their frames."""
URDF_TYPES = {"hinge": "revolute", "slide": "prismatic", "ball": "spherical"}


class BodyReader:
    """Collects bodies, joints and sites of one file, and of those that are attached to it.

    Attributes
    ----------
    bodies, placements
        By name; placements in the world in the pose of the file.
    joints
        One for each joint of MuJoCo; welded bodies have a fixed one.
    order
        Name, type and body of each joint of MuJoCo, in the order of the file.
    free
        Free joints by body.
    sites
        Body and placement in it, by name.
    forces
        Springs of ball joints.
    references, rests
        ``ref`` and ``springref`` of the joints, by name.
    efforts
        Lowest and highest force of all actuators together (``actuatorfrcrange``), by joint.
    added
        Armatures of free joints by body.
    compensated
        Part of the weight that does not act (``gravcomp``), by body.
    parts
        The files: the main one first.
    """

    def __init__(self, part: Part, reach: Reach) -> None:
        self.reach = reach
        self.parts = [part]
        self._part, self._depth = part, 0
        self._total_mass = part.values.compiler.total_mass
        self.bodies: dict[str, Body] = {}
        self.placements: dict[str, pin.SE3] = {WORLD: pin.SE3.Identity()}
        self.joints: list[Joint] = []
        self.order: list[tuple[str, str, str]] = []
        self.free: dict[str, Joint] = {}
        self.added: dict[str, float] = {}
        self.sites: dict[str, tuple[str, pin.SE3]] = {}
        self.forces: list[dict[str, Any]] = []
        self.references: dict[str, float] = {}
        self.rests: dict[str, float] = {}
        self.efforts: dict[str, tuple[float, float]] = {}
        self.compensated: dict[str, float] = {}
        self.meshes: dict[str, Mesh] = dict(part.meshes)
        self.colours: dict[str, str] = dict(part.colours)
        self._names: set[str] = set()
        self._moving: set[str] = set()
        self._replicated = 0
        self._timed: dict[str, tuple[float, float]] = {}

    @property
    def values(self) -> MjcfValues:
        """The values of the file that is being read, at the end the main one."""
        return self._part.values

    def world(self, node: Element) -> None:
        """Read a ``<worldbody>``."""
        self._contents(node, WORLD, pin.SE3.Identity(), "", defaultdict(list))

    # Bodies ---------------------------------------------------------------------------------

    def body(self, node: Element, parent: str, around: pin.SE3, childclass: str) -> None:
        """Read a ``<body>`` in the frame ``around`` of ``parent``."""
        values = self.values
        name = node.get("name") or f"body_{len(self.placements)}"
        where = f"body {name!r}"
        if name in self.placements or name == WORLD:
            problem = "two bodies have this name" if name != WORLD else "'world' is the ground"
            raise values.fault(where, problem, "Rename one of them")
        given = values.own(node, where)
        if given.flag("mocap"):
            values.remark("a mocap body stays where the file has it", where)
        childclass = given.text("childclass", childclass)
        inside = pin.SE3.Identity()
        if values.compiler.in_world:
            at = (
                given.placement()
                if "pos" in given
                else self._inertial_frame(node, name, childclass)
            )
            in_parent = around * at
            inside = at.inverse()
        else:
            in_parent = around * given.placement()
        self.placements[name] = self.placements[parent] * in_parent
        found: dict[str, list[Any]] = defaultdict(list)
        self.bodies[name] = Body(name)
        if parent in self._moving or any(c.tag in ("joint", "freejoint") for c in node):
            self._moving.add(name)
        # Joints first: they precede those of nested bodies.
        self._joints(node, name, parent, in_parent, childclass)
        self._contents(node, name, inside, childclass, found)
        self.bodies[name] = body = self._finished(name, found["inertial"], found["geom"])
        compensated = 0.0 if "gravcomp" in values.off else given.number("gravcomp")
        if compensated and body.inertia is not None and name in self._moving:
            self.compensated[name] = compensated

    def _contents(
        self,
        node: Element,
        name: str,
        around: pin.SE3,
        childclass: str,
        found: dict[str, list[Any]],
    ) -> None:
        """Read the elements of a body or of a ``<frame>``; geoms and inertials into ``found``."""
        values = self.values
        where = f"body {name!r}"
        for tag, what in REFUSED.items():
            if node.find(tag) is not None:
                raise values.fault(where, f"<{tag}> ({what}) is not read", "Remove it")
        for tag in ("frame", "replicate", "attach") if values.compiler.in_world else ():
            if node.find(tag) is not None:
                problem = f'<{tag}> is not read where coordinate="global"'
                raise values.fault(where, problem, "Write the file in local coordinates")
        many = ("geom", "site", "body", "frame", "joint", "replicate", "attach")
        values.children(node, where, BODY_READ, BODY_IGNORED, many)
        for child in node:
            match child.tag:
                case "inertial":
                    found["inertial"].append((child, around))
                case "geom":
                    found["geom"].append(read_geom(values, child, childclass, around, name))
                    if name == WORLD:
                        values.ignore("<geom> of the world")
                case "site":
                    self._site(child, name, around, childclass)
                case "body":
                    self.body(child, name, around, childclass)
                case "frame":
                    given = values.own(child, f"{where}, <frame>")
                    if child.find("joint") is not None or child.find("freejoint") is not None:
                        raise values.fault(
                            where, "a joint inside a <frame> is not read", "Put it into the body"
                        )
                    inside = given.text("childclass", childclass)
                    self._contents(child, name, around * given.placement(), inside, found)
                case "attach":
                    self._attach(child, name, around, found)
                case "replicate":
                    for copied, place in self._replicas(child, where):
                        self._contents(copied, name, around * place, childclass, found)
                case "joint" | "freejoint" if name == WORLD:
                    raise values.fault("<worldbody>", "the world has no joints", "Put it in a body")

    def _attach(
        self, node: Element, name: str, around: pin.SE3, found: dict[str, list[Any]]
    ) -> None:
        """Read an ``<attach>``: a body of another file, or all that is in its world."""
        given = self.values.own(node, f"body {name!r}, <attach> {node.get('model', '')!r}")
        outer, part = self._part, attached_part(self._part, given, self.reach, self._depth)
        self.parts.append(part)
        self.meshes |= part.meshes
        self.colours |= part.colours
        wanted, first = given.text("body"), len(self.order)
        contents = part.contents()
        self._part, self._depth = part, self._depth + 1
        if not wanted:
            taken = Element("frame")
            taken.extend(contents)
            self._contents(taken, name, around, "", found)
        elif wanted == WORLD:
            taken = Element("body", name=part.values.prefix + WORLD)
            taken.extend(contents)
            self.body(taken, name, around, "")
        else:
            match part.body(part.values.prefix + wanted):
                case taken, childclass:
                    self.body(taken, name, around, childclass)
                case _:
                    raise given.fault(f"the model has no body {wanted!r}", "Name one of its bodies")
        self._part, self._depth = outer, self._depth - 1
        part.joints = slice(first, len(self.order))
        inside = set(taken.iter())
        part.left_out = {
            inner.get("name", "")
            for outside in contents
            for inner in outside.iter()
            if inner not in inside and inner.tag in ("body", "joint", "freejoint", "site")
        } - {""}

    def _replicas(self, node: Element, where: str) -> Iterator[tuple[Element, pin.SE3]]:
        """The copies of a ``<replicate>``, whose names end with their numbers, and the placement of
        each."""
        values = self.values
        given = values.own(node, f"{where}, <replicate>")
        count = int(given.number("count"))
        if count < 1 or count != given.number("count"):
            raise given.fault("count is not a positive whole number", "Give the number of copies")
        self._replicated += count * sum(1 for _ in node.iter())
        if self._replicated > MOST_REPLICATED:
            raise given.fault(
                f"it makes more than {MOST_REPLICATED} elements", "Give a lower count"
            )
        if node.find("joint") is not None or node.find("freejoint") is not None:
            raise given.fault("a joint inside a <replicate> is not read", "Put it into a body")
        if next(node.iter("attach"), None) is not None:
            raise given.fault("<attach> inside a <replicate> is not read", "Write each by itself")
        angles = given.numbers("euler", 3, "0 0 0")
        offset, place = given.numbers("offset", 3, "0 0 0"), pin.SE3.Identity()
        for k in range(count):
            copied = deepcopy(node)
            for inner in copied.iter():
                if "name" in inner.attrib:
                    number = str(k).zfill(len(str(count - 1)))
                    inner.attrib["name"] += given.text("sep") + number
            yield copied, place
            # MuJoCo multiplies the angles, not the rotation.
            place = pin.SE3(values.euler((k + 1) * angles), place.act(offset))

    def _site(self, node: Element, body: str, around: pin.SE3, childclass: str) -> None:
        name = node.get("name")
        where = f"site {name!r}"
        given = self.values.resolved(node, childclass, where)
        placement = around * given.placement()
        if "fromto" in given:
            ends = given.numbers("fromto", 6)
            placement = around * pin.SE3(np.eye(3), 0.5 * (ends[:3] + ends[3:]))
        if name:
            if name in self.sites:
                raise given.fault("two sites have this name", "Rename one of them")
            self.sites[name] = (body, placement)

    def _inertial_frame(self, node: Element, name: str, childclass: str) -> pin.SE3:
        """The frame in the world of a body without ``pos``, in global coordinates: that of its
        ``<inertial>``, else the centre of mass of its geoms with the axes of the world."""
        values, around = self.values, pin.SE3.Identity()
        inertial = node.find("inertial")
        if inertial is not None:
            return values.own(inertial, f"body {name!r}, <inertial>").placement()
        found = [read_geom(values, geom, childclass, around, name) for geom in node.findall("geom")]
        inertia = self._of_geoms(found)
        if inertia is None:
            problem = "it has neither a pos nor an inertia, which would place it"
            raise values.fault(f"body {name!r}", problem, "Give pos")
        return pin.SE3(np.eye(3), inertia.lever)

    def _of_geoms(self, geoms: list[Geom]) -> pin.Inertia | None:
        """Inertia of the geoms of a body; None without mass."""
        inertia: pin.Inertia | None = None
        low, high = self.values.compiler.groups
        for geom in geoms:
            part = inertia_of(geom, self.meshes, self.reach) if low <= geom.group <= high else None
            if part is not None:
                inertia = part if inertia is None else inertia + part
        return inertia

    def _finished(
        self, name: str, inertials: list[tuple[Element, pin.SE3]], geoms: list[Geom]
    ) -> Body:
        """The body with its inertia and visuals."""
        compiler = self.values.compiler
        where = f"body {name!r}"
        visuals = [v for geom in geoms for v in visuals_of(geom, self.meshes, self.colours)]
        if name not in self._moving and self._total_mass <= 0.0:
            return Body(name, None, tuple(visuals))
        inertia: pin.Inertia | None = None
        if len(inertials) > 1:
            raise self.values.fault(where, "<inertial> is given twice", "Keep one")
        use_geoms = compiler.inertia_from_geom
        if inertials and use_geoms != "true":
            node, around = inertials[0]
            inertia = around.act(_inertial(self.values.own(node, f"{where}, <inertial>")))
        elif use_geoms != "false":
            inertia = self._of_geoms(geoms)
        return Body(name, self._bounded(inertia), tuple(visuals))

    def _bounded(self, inertia: pin.Inertia | None) -> pin.Inertia | None:
        """The inertia with at least the mass and principal moments that the compiler demands."""
        compiler = self.values.compiler
        if not (compiler.bound_mass or compiler.bound_inertia or compiler.balance_inertia):
            return inertia
        inertia = pin.Inertia.Zero() if inertia is None else inertia
        principal, axes = np.linalg.eigh(inertia.inertia)
        principal = np.maximum(principal, compiler.bound_inertia)
        if compiler.balance_inertia and principal[0] + principal[1] < principal[2]:
            principal[:] = principal.mean()
        about = axes @ np.diag(principal) @ axes.T
        return pin.Inertia(max(inertia.mass, compiler.bound_mass), inertia.lever, about)

    def add_rotors(self) -> None:
        """Add the armatures a of free joints, which add a to each diagonal element of their mass
        matrices: so does a weightless body with the mass a at the joint and moments of inertia a.
        """
        for name, armature in self.added.items():
            rotor = self._name(f"{name}::rotor", "")
            inertia = pin.Inertia(armature, np.zeros(3), armature * np.eye(3))
            self.bodies[rotor] = Body(rotor, inertia)
            self.placements[rotor] = self.placements[name]
            self.joints.append(Joint(rotor, "fixed", name, rotor))
            self.compensated[rotor] = 1.0
            self.values.remark("the armature of a free joint is a body without weight", rotor)

    def add_armature(self, name: str, armature: float) -> None:
        """Add to the armature of the joint ``name``."""
        k = next(k for k, joint in enumerate(self.joints) if joint.name == name)
        self.joints[k] = replace(self.joints[k], armature=self.joints[k].armature + armature)

    def add_tendon(self, name: str, joint: str, armature: float) -> str:
        """Add a joint that moves nothing but its armature, for the tendon ``name``, beside the body
        that ``joint`` moves, and return its name."""
        added = self._name(f"{name}::tendon", "")
        carrier = next(one.child for one in self.joints if one.name == joint)
        self.bodies[added] = Body(added)
        self.placements[added] = self.placements[carrier]
        self.joints.append(Joint(added, "prismatic", carrier, added, armature=armature))
        return added

    def rescale(self) -> None:
        """Scale all inertias so that the total mass is ``settotalmass``."""
        wanted = self._total_mass
        total = sum(body.inertia.mass for body in self.bodies.values() if body.inertia is not None)
        if wanted <= 0.0 or total <= 0.0:
            return
        factor = wanted / total
        for name, body in self.bodies.items():
            if (inertia := body.inertia) is not None:
                scaled = pin.Inertia(factor * inertia.mass, inertia.lever, factor * inertia.inertia)
                self.bodies[name] = replace(body, inertia=scaled)

    def resolve_springdampers(self) -> None:
        """Replace ``springdamper``, a time constant T (s) and a damping ratio z, by stiffness and
        damping as MuJoCo's compiler does: I/(T z)^2 and 2 I/T, with I = 1/mean of the joint's part
        of the diagonal of M^-1 in the pose of the file."""
        if not self._timed:
            return
        mobility, first = self._mobility()
        for k, joint in enumerate(self.joints):
            if joint.name not in self._timed:
                continue
            timeconst, ratio = self._timed[joint.name]
            at = first[joint.name]
            inertia = 1.0 / float(mobility[at : at + FREEDOM[joint.type]].mean())
            off = self.values.off
            stiffness = 0.0 if "spring" in off else inertia / (timeconst * ratio) ** 2
            damping = 0.0 if "damper" in off else 2.0 * inertia / timeconst
            if joint.type == "spherical":
                self._spring(joint, stiffness)
                stiffness = 0.0
            self.joints[k] = replace(joint, stiffness=stiffness, damping=damping)

    def _mobility(self) -> tuple[FloatArray, dict[str, int]]:
        """Diagonal (nv,) of the inverse of the mass matrix in the pose of the file, and the first
        velocity component of each joint by name."""
        above = {joint.child: joint for joint in (*self.joints, *self.free.values())}
        first: dict[str, int] = {}
        nv = 0
        for joint in above.values():
            first[joint.name] = nv
            nv += FREEDOM[joint.type]
        twists, armature = np.zeros((6, nv)), np.zeros(nv)
        for joint in above.values():
            at = first[joint.name]
            own = slice(at, at + FREEDOM[joint.type])
            place = self.placements[joint.child] * joint.in_child
            motions = MOTIONS[joint.type](np.array(joint.axis))
            twists[:, own] = place.toActionMatrix() @ motions.T
            armature[own] = joint.armature
        M = np.diag(armature)
        for name, body in self.bodies.items():
            if body.inertia is None:
                continue
            moving, at_body = np.zeros(nv, dtype=bool), name
            while at_body in above:
                joint = above[at_body]
                moving[first[joint.name] : first[joint.name] + FREEDOM[joint.type]] = True
                at_body = joint.parent
            own_twists = self.placements[name].inverse().toActionMatrix() @ twists * moving
            M += own_twists.T @ body.inertia.matrix() @ own_twists
        try:
            return np.diag(np.linalg.inv(M)), first
        except np.linalg.LinAlgError:
            name = next(iter(self._timed))
            raise self.values.fault(
                f"joint {name!r}",
                "the inertia that springdamper refers to is zero",
                "Give stiffness and damping",
            ) from None

    # Joints ---------------------------------------------------------------------------------

    def _joints(
        self, node: Element, name: str, parent: str, in_parent: pin.SE3, childclass: str
    ) -> None:
        """The joints of a body, in series, with massless bodies between them."""
        nodes = [child for child in node if child.tag in ("joint", "freejoint")]
        if not nodes:
            self.joints.append(
                Joint(self._name(f"{name}::weld", ""), "fixed", parent, name, in_parent)
            )
            return
        start, at = parent, in_parent
        for i, child in enumerate(nodes):
            last = i == len(nodes) - 1
            end = name if last else f"{name}::{i + 1}"
            if not last:
                self.bodies[end] = Body(end)
                self.placements[end] = self.placements[name]
            joint = self._joint(child, start, end, at, childclass, len(nodes) == 1)
            if joint is not None:
                self.joints.append(joint)
            start, at = end, pin.SE3.Identity()

    def _name(self, default: str, given: str) -> str:
        name = given or default
        if name in self._names:
            where = f"joint {name!r}"
            raise self.values.fault(where, "two joints have this name", "Rename one of them")
        self._names.add(name)
        return name

    def _joint(
        self, node: Element, parent: str, child: str, at: pin.SE3, childclass: str, alone: bool
    ) -> Joint | None:
        """A joint; None for a free one."""
        values = self.values
        name = self._name(f"{child}::joint", node.get("name", ""))
        where = f"joint {name!r}"
        if node.tag == "freejoint":
            given, kind = values.own(node, where), "free"
        else:
            given = values.resolved(node, childclass, where)
            kind = given.choice("type", JOINT_TYPES)
        self.order.append((name, kind, child))
        acting = _acting(given)
        timeconst, ratio = given.numbers("springdamper", 2, "0 0").tolist()
        if timeconst or ratio:
            if not (timeconst > 0.0 and ratio > 0.0) or kind == "free":
                raise given.fault(
                    "springdamper is not two positive numbers of a hinge, slide or ball",
                    "Give stiffness and damping",
                )
            self._timed[name] = timeconst, ratio
            acting["stiffness"] = 0.0
        if kind == "free":
            if parent != WORLD or not alone:
                raise given.fault(
                    "only a body of the world, with no other joint, moves freely", "Use ball"
                )
            self._spring(Joint(name, "floating", parent, child, at), acting.pop("stiffness"))
            if armature := acting.pop("armature"):
                self.added[child] = armature
            self.free[child] = Joint(name, "floating", parent, child, at, **acting)
            return None
        in_body = pin.SE3.Identity()
        if values.compiler.in_world:
            in_body = self.placements[child].inverse()
        where_it_is = pin.SE3(np.eye(3), in_body.act(given.numbers("pos", 3, "0 0 0")))
        placed = Joint(name, URDF_TYPES[kind], parent, child, at * where_it_is, where_it_is)
        if kind == "ball":
            self._spring(placed, acting.pop("stiffness"))
            return replace(placed, **acting)
        x, y, z = (in_body.rotation @ given.direction("axis", "0 0 1")).tolist()
        in_si = values.angle if kind == "hinge" else float
        self.references[name] = ref = in_si(given.number("ref"))
        self.rests[name] = in_si(given.number("springref"))
        rest = self.rests[name] - ref
        limits = _limits(given, in_si, ref)
        effort = given.limited_range("actuatorfrcrange", "actuatorfrclimited")
        if effort is not None:
            self.efforts[name] = effort
        return replace(placed, axis=(x, y, z), rest=rest, **limits, **acting)

    def _spring(self, joint: Joint, stiffness: float) -> None:
        """The spring of a ball or free joint, with a moment of -k times the rotation vector and a
        force of -k times the displacement: a bushing."""
        if stiffness:
            moves = 0.0 if joint.type == "spherical" else stiffness
            self.forces.append(
                {
                    "type": "bushing",
                    "name": f"{joint.name}::spring",
                    "a": anchor(joint.child, joint.in_child),
                    "b": anchor(joint.parent, joint.in_parent),
                    "stiffness": [moves, moves, moves, stiffness, stiffness, stiffness],
                }
            )


def _inertial(given: Attributes) -> pin.Inertia:
    """The inertia in the frame in which the ``<inertial>`` is placed."""
    if "mass" not in given:
        raise given.fault("<inertial> has no mass", "Give it")
    if "fullinertia" in given and "diaginertia" in given:
        raise given.fault("fullinertia and diaginertia are both given", "Keep one")
    if "fullinertia" in given:
        moments = given.numbers("fullinertia", 6)
    else:
        moments = np.append(given.numbers("diaginertia", 3, "0 0 0"), np.zeros(3))
    return inertia_at(given.placement(), given.number("mass"), moments)


def _acting(given: Attributes) -> dict[str, Any]:
    """Stiffness, damping, friction and armature of a joint."""
    if given.flag("actuatorgravcomp"):
        given.values.ignore("actuatorgravcomp attribute")
    found = {
        "stiffness": given.number("stiffness"),
        "damping": given.number("damping"),
        "friction": given.number("frictionloss"),
        "armature": given.number("armature"),
    }
    for key, value in found.items():
        if value < 0.0:
            raise given.fault(f"its {key} is negative", "Give a value >= 0")
    for key, flag in FLAGS.items():
        if flag in given.values.off:
            found[key] = 0.0
    if found["friction"]:
        given.values.remark(
            "frictionloss acts as smoothed Coulomb friction, not as MuJoCo's soft constraint",
            given.where,
        )
    return found


def _limits(given: Attributes, in_si: Callable[[float], float], ref: float) -> dict[str, Any]:
    """``lower`` and ``upper`` against the pose of the file; none without a range."""
    found = given.limited_range("range", "limited")
    if found is None:
        return {}
    low, high = found
    clipped: FloatArray = np.clip([in_si(low) - ref, in_si(high) - ref], -OPEN_LIMIT, OPEN_LIMIT)
    return {"lower": float(clipped[0]), "upper": float(clipped[1])}
