"""The tree of bodies of an MJCF file.

Joint positions are zero in the pose of the file: MuJoCo's value there, a joint's ``ref``, is
subtracted from its limits and from the rest position of its spring.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.formats.graph.joint_graph import NO_LIMIT, Body, Joint
from srm_mbs.formats.graph.spanning_tree_to_urdf import anchor
from srm_mbs.formats.mjcf.attributes import BODY_IGNORED, BODY_READ, MjcfValues
from srm_mbs.formats.mjcf.geoms import Geom, Mesh, inertia_of, read_geom, visuals_of
from srm_mbs.model.anchors import WORLD

JOINT_TYPES = ("hinge", "slide", "ball", "free")
"""The default first."""
URDF_TYPES = {"hinge": "revolute", "slide": "prismatic", "ball": "spherical"}


class BodyReader:
    """Collects bodies, joints and sites of one file.

    Attributes
    ----------
    bodies, placements
        By name; placements in the world in the pose of the file.
    joints
        One for each joint of MuJoCo; welded bodies have a fixed one.
    free
        Bodies with a free joint, and its name.
    sites
        Body and placement in it, by name.
    forces
        Springs of ball joints.
    references
        ``ref`` of the joints, by name.
    """

    def __init__(self, values: MjcfValues) -> None:
        self.values = values
        self.bodies: dict[str, Body] = {}
        self.placements: dict[str, pin.SE3] = {WORLD: pin.SE3.Identity()}
        self.joints: list[Joint] = []
        self.free: dict[str, str] = {}
        self.sites: dict[str, tuple[str, pin.SE3]] = {}
        self.forces: list[dict[str, Any]] = []
        self.references: dict[str, float] = {}
        self.meshes: dict[str, Mesh] = {}
        self.colours: dict[str, str] = {}
        self._names: set[str] = set()
        self._moving: set[str] = set()

    def world(self, node: Element) -> None:
        """Read a ``<worldbody>``."""
        self._contents(node, WORLD, pin.SE3.Identity(), "", {})

    # Bodies ---------------------------------------------------------------------------------

    def body(self, node: Element, parent: str, around: pin.SE3, childclass: str) -> None:
        """Read a ``<body>`` in the frame ``around`` of ``parent``."""
        values = self.values
        name = node.get("name") or f"body_{len(self.placements)}"
        where = f"body {name!r}"
        if name in self.placements or name == WORLD:
            problem = "two bodies have this name" if name != WORLD else "'world' is the ground"
            raise values.fault(where, problem, "Rename one of them")
        values.known(node, where)
        given = node.attrib
        if values.flag(given, "mocap", False, where):
            raise values.fault(where, "mocap bodies are not read by this version", "Remove mocap")
        if values.number(given, "gravcomp", 0.0, where) != 0.0:
            raise values.fault(where, "gravcomp is not read by this version", "Remove it")
        childclass = node.get("childclass", childclass)
        in_parent = around * values.placement(given, where)
        self.placements[name] = self.placements[parent] * in_parent
        found: dict[str, list[Any]] = {"joint": [], "geom": [], "inertial": []}
        self.bodies[name] = Body(name)
        if parent in self._moving or any(c.tag in ("joint", "freejoint") for c in node):
            self._moving.add(name)
        # Joints first: they precede those of nested bodies.
        self._joints(node, name, parent, in_parent, childclass)
        self._contents(node, name, pin.SE3.Identity(), childclass, found)
        self.bodies[name] = self._finished(name, found["inertial"], found["geom"])

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
        many = ("geom", "site", "body", "frame", "joint")
        values.children(node, where, BODY_READ, BODY_IGNORED, many)
        for child in node:
            match child.tag:
                case "inertial":
                    found.get("inertial", []).append((child, around))
                case "geom" if name == WORLD:
                    read_geom(values, child, childclass, around, name)
                    values.ignore("<geom> of the world")
                case "geom":
                    found["geom"].append(read_geom(values, child, childclass, around, name))
                case "site":
                    self._site(child, name, around, childclass)
                case "body":
                    self.body(child, name, around, childclass)
                case "frame":
                    values.known(child, where)
                    inner = around * values.placement(child.attrib, f"{where}, <frame>")
                    if child.find("joint") is not None or child.find("freejoint") is not None:
                        raise values.fault(
                            where, "a joint inside a <frame> is not read", "Put it into the body"
                        )
                    inside = child.get("childclass", childclass)
                    self._contents(child, name, inner, inside, found)
                case "joint" | "freejoint" if name == WORLD:
                    raise values.fault("<worldbody>", "the world has no joints", "Put it in a body")

    def _site(self, node: Element, body: str, around: pin.SE3, childclass: str) -> None:
        name = node.get("name")
        where = f"site {name!r}"
        given = self.values.resolved(node, childclass, where)
        placement = around * self.values.placement(given, where)
        if "fromto" in given:
            ends = self.values.numbers(given["fromto"], 6, where, "fromto")
            placement = around * pin.SE3(np.eye(3), 0.5 * (ends[:3] + ends[3:]))
        if name:
            if name in self.sites:
                raise self.values.fault(where, "two sites have this name", "Rename one of them")
            self.sites[name] = (body, placement)

    def _finished(
        self, name: str, inertials: list[tuple[Element, pin.SE3]], geoms: list[Geom]
    ) -> Body:
        """The body with its inertia and visuals."""
        values = self.values
        compiler = values.compiler
        where = f"body {name!r}"
        visuals = [v for g in geoms for v in visuals_of(values, g, self.meshes, self.colours)]
        if name not in self._moving and compiler.total_mass <= 0.0:
            return Body(name, None, tuple(visuals))
        inertia: pin.Inertia | None = None
        if len(inertials) > 1:
            raise values.fault(where, "<inertial> is given twice", "Keep one")
        use_geoms = compiler.inertia_from_geom
        if inertials and use_geoms != "true":
            node, around = inertials[0]
            inertia = around.act(self._inertial(node, where))
        elif use_geoms != "false":
            low, high = compiler.groups
            for geom in geoms:
                if not low <= geom.group <= high:
                    continue
                part = inertia_of(geom, self.meshes, values.file)
                if part is not None:
                    inertia = part if inertia is None else inertia + part
        return Body(name, self._bounded(inertia), tuple(visuals))

    def _inertial(self, node: Element, where: str) -> pin.Inertia:
        values = self.values
        values.known(node, f"{where}, <inertial>")
        given = node.attrib
        if "mass" not in given:
            raise values.fault(where, "<inertial> has no mass", "Give it")
        mass = values.number(given, "mass", 0.0, where)
        placed = values.placement(given, f"{where}, <inertial>")
        if "fullinertia" in given:
            xx, yy, zz, xy, xz, yz = values.get(given, "fullinertia", 6, "", where)
            about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            if "diaginertia" in given:
                raise values.fault(where, "fullinertia and diaginertia are both given", "Keep one")
        else:
            about = np.diag(values.get(given, "diaginertia", 3, "0 0 0", where))
        turn = placed.rotation
        return pin.Inertia(mass, placed.translation, turn @ about @ turn.T)

    def _bounded(self, inertia: pin.Inertia | None) -> pin.Inertia | None:
        """The inertia with at least the mass and principal moments that the compiler demands."""
        compiler = self.values.compiler
        if not (compiler.bound_mass or compiler.bound_inertia):
            return inertia
        inertia = pin.Inertia.Zero() if inertia is None else inertia
        principal, axes = np.linalg.eigh(inertia.inertia)
        about = axes @ np.diag(np.maximum(principal, compiler.bound_inertia)) @ axes.T
        return pin.Inertia(max(inertia.mass, compiler.bound_mass), inertia.lever, about)

    def rescale(self) -> None:
        """Scale all inertias so that the total mass is ``settotalmass``."""
        wanted = self.values.compiler.total_mass
        total = sum(body.inertia.mass for body in self.bodies.values() if body.inertia is not None)
        if wanted <= 0.0 or total <= 0.0:
            return
        for name, body in self.bodies.items():
            if body.inertia is not None:
                factor = wanted / total
                inertia = body.inertia
                scaled = pin.Inertia(factor * inertia.mass, inertia.lever, factor * inertia.inertia)
                self.bodies[name] = replace(body, inertia=scaled)

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
            raise self.values.fault(
                f"joint {name!r}", "two joints have this name", "Rename one of them"
            )
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
            values.known(node, where)
            given, kind = dict(node.attrib), "free"
        else:
            given = values.resolved(node, childclass, where)
            kind = values.choice(given, "type", JOINT_TYPES, where)
        acting = self._acting(given, where)
        if kind == "free":
            if parent != WORLD or not alone:
                raise values.fault(
                    where, "only a body of the world, with no other joint, moves freely", "Use ball"
                )
            if any(acting.values()):
                raise values.fault(
                    where,
                    "damping, friction, armature and stiffness of a free joint are not read",
                    "Set them to 0",
                )
            self.free[child] = name
            return None
        where_it_is = pin.SE3(np.eye(3), values.get(given, "pos", 3, "0 0 0", where))
        placed = Joint(name, URDF_TYPES[kind], parent, child, at * where_it_is, where_it_is)
        if kind == "ball":
            self._ball_spring(placed, acting.pop("stiffness"))
            return replace(placed, **acting)
        axis = values.direction(values.get(given, "axis", 3, "0 0 1", where), where, "axis")
        x, y, z = axis.tolist()
        ref, rest = (self._coordinate(given, key, kind, where) for key in ("ref", "springref"))
        self.references[name] = ref
        return replace(
            placed,
            axis=(x, y, z),
            rest=rest - ref,
            **self._limits(given, kind, ref, where),
            **acting,
        )

    def _acting(self, given: dict[str, str], where: str) -> dict[str, Any]:
        values = self.values
        if values.flag(given, "actuatorgravcomp", False, where):
            values.ignore("actuatorgravcomp attribute")
        if "springdamper" in given and values.get(given, "springdamper", 2, "", where).any():
            raise values.fault(
                where, "springdamper is not read by this version", "Give stiffness and damping"
            )
        found = {
            ours: values.number(given, theirs, 0.0, where)
            for ours, theirs in (
                ("stiffness", "stiffness"),
                ("damping", "damping"),
                ("friction", "frictionloss"),
                ("armature", "armature"),
            )
        }
        for key, value in found.items():
            if value < 0.0:
                raise values.fault(where, f"its {key} is negative", "Give a value >= 0")
        if found["friction"]:
            values.remark(
                "frictionloss acts as smoothed Coulomb friction, not as MuJoCo's soft constraint",
                where,
            )
        return found

    def _coordinate(self, given: dict[str, str], key: str, kind: str, where: str) -> float:
        value = self.values.number(given, key, 0.0, where)
        return self.values.angle(value) if kind == "hinge" else value

    def _limits(self, given: dict[str, str], kind: str, ref: float, where: str) -> dict[str, Any]:
        values = self.values
        word = values.choice(given, "limited", ("auto", "true", "false"), where)
        if "range" not in given or word == "false":
            return {}
        if word == "auto" and not values.compiler.autolimits:
            raise values.fault(where, "it has a range, but autolimits is off", "Write limited")
        low, high = values.get(given, "range", 2, "", where)
        if low == high == 0.0:
            return {}
        if low >= high:
            raise values.fault(where, "the range does not increase", "Exchange the two")
        if kind == "hinge":
            low, high = values.angle(low), values.angle(high)
        clipped: FloatArray = np.clip([low - ref, high - ref], -NO_LIMIT, NO_LIMIT)
        return {"lower": float(clipped[0]), "upper": float(clipped[1])}

    def _ball_spring(self, joint: Joint, stiffness: float) -> None:
        """The spring of a ball joint, with a moment of -k times the rotation vector: a bushing."""
        if stiffness:
            self.forces.append(
                {
                    "type": "bushing",
                    "name": f"{joint.name}::spring",
                    "a": anchor(joint.child, joint.in_child),
                    "b": anchor(joint.parent, joint.in_parent),
                    "stiffness": [0.0, 0.0, 0.0, stiffness, stiffness, stiffness],
                }
            )
