"""Equality constraints and tendons of MJCF as closures and springs.

MuJoCo's constraints are soft (``solref``, ``solimp``); the closures are rigid.
"""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs.formats.graph.spanning_tree_to_urdf import anchor
from srm_mbs.formats.mjcf.attributes import JOINT_EQUALITY, MjcfValues
from srm_mbs.formats.mjcf.bodies import BodyReader
from srm_mbs.model.anchors import WORLD

KINDS = ("connect", "weld", "joint")
REFUSED = ("tendon", "flex", "flexvert", "flexstrain", "distance")


class EqualityReader:
    """Reads ``<equality>`` and ``<tendon>`` when all bodies are known.

    Attributes
    ----------
    loops, forces, lock, held
        Entries ``loop``, ``force``, ``lock`` and ``initial.q`` of a description.
    """

    def __init__(self, values: MjcfValues, tree: BodyReader) -> None:
        self.values, self.tree = values, tree
        self.loops: list[dict[str, Any]] = []
        self.forces: list[dict[str, Any]] = []
        self.lock: list[str] = []
        self.held: dict[str, float] = {}

    # Equality -------------------------------------------------------------------------------

    def equality(self, section: Element, disabled: bool) -> None:
        """Read an ``<equality>`` section; ``disabled`` by the flag of ``<option>``."""
        values = self.values
        values.children(section, "<equality>", (*KINDS, *REFUSED), (), (*KINDS, *REFUSED))
        for node in section:
            name = node.get("name") or f"{node.tag}_{len(self.loops) + len(self.lock) + 1}"
            where = f"equality {name!r} (<{node.tag}>)"
            given = self._given(node, where)
            if disabled or not values.flag(given, "active", True, where):
                values.remark("equality constraints that are not active are left out", name)
                continue
            if node.tag in REFUSED:
                raise values.fault(
                    where,
                    f"<{node.tag}> equality constraints are not read by this version",
                    'Remove it, or write active="false"',
                )
            if given.get("solref") or given.get("solimp"):
                values.remark("solref and solimp (softness) do not act: closures are rigid", name)
            {"connect": self._connect, "weld": self._weld, "joint": self._joint}[node.tag](
                name, given, where
            )

    def _given(self, node: Element, where: str) -> dict[str, str]:
        values = self.values
        if node.tag in REFUSED:
            return dict(node.attrib)
        if node.tag == "joint":  # not the joints of the tree
            values.attributes(node, where, (*JOINT_EQUALITY, "solref", "solimp"))
            name = node.get("class", "main")
            if name not in values.classes:
                raise values.fault(where, f"there is no default class {name!r}", "Define it")
            return {**values.classes[name].get("equality", {}), **node.attrib}
        return values.resolved(node, "", where, "equality")

    def _body(self, given: dict[str, str], key: str, where: str, default: str = "") -> str:
        name = given.get(key, default)
        if name not in self.tree.placements:
            known = ", ".join(self.tree.placements)
            problem = f"there is no body {name!r} ({key})" if name else f"it has no {key}"
            raise self.values.fault(where, problem, f"Known: {known}")
        return name

    def _sites(self, given: dict[str, str], where: str) -> list[tuple[str, pin.SE3]] | None:
        """Bodies and placements of site1 and site2; None if bodies are given."""
        keys = [key for key in ("site1", "site2") if key in given]
        if not keys:
            return None
        if len(keys) == 1 or "body1" in given or "body2" in given:
            raise self.values.fault(
                where, "it needs two sites, or bodies, and not both", "Give site1 and site2"
            )
        return [self.site(given[key], where) for key in keys]

    def site(self, name: str, where: str) -> tuple[str, pin.SE3]:
        """Body and placement in it of a site."""
        if name not in self.tree.sites:
            known = ", ".join(self.tree.sites) or "none"
            raise self.values.fault(where, f"there is no site {name!r}", f"Known: {known}")
        return self.tree.sites[name]

    def _close(
        self, name: str, kind: str, a: tuple[str, pin.SE3], b: tuple[str, pin.SE3], where: str
    ) -> None:
        if a[0] == b[0]:
            raise self.values.fault(where, f"both ends are on the body {a[0]!r}", "Use two bodies")
        self.loops.append({"name": name, "type": kind, "a": anchor(*a), "b": anchor(*b)})

    def _connect(self, name: str, given: dict[str, str], where: str) -> None:
        sites = self._sites(given, where)
        if sites is not None:
            points = [(body, pin.SE3(np.eye(3), at.translation)) for body, at in sites]
            self._close(name, "point", points[0], points[1], where)
            return
        first = self._body(given, "body1", where)
        second = self._body(given, "body2", where, WORLD)
        if "anchor" not in given:
            raise self.values.fault(where, "it has no anchor", "Give it, in body1's frame")
        at = pin.SE3(np.eye(3), self.values.get(given, "anchor", 3, "", where))
        world = self.tree.placements[first].act(at.translation)
        other = pin.SE3(np.eye(3), self.tree.placements[second].actInv(world))
        self._close(name, "point", (first, at), (second, other), where)

    def _weld(self, name: str, given: dict[str, str], where: str) -> None:
        if "torquescale" in given:
            self.values.remark("torquescale does not act: closures are rigid", name)
        sites = self._sites(given, where)
        if sites is not None:
            self._close(name, "frame", sites[0], sites[1], where)
            return
        first = self._body(given, "body1", where)
        second = self._body(given, "body2", where, WORLD)
        at = pin.SE3(np.eye(3), self.values.get(given, "anchor", 3, "0 0 0", where))
        pose = self.values.get(given, "relpose", 7, "0 1 0 0 0 0 0", where)
        if pose[3:].any():
            # MuJoCo holds the anchor, not body2's origin, at the position of relpose.
            w, x, y, z = self.values.direction(pose[3:], where, "the quaternion of relpose")
            in_first = pin.SE3(pin.Quaternion(w, x, y, z).matrix(), pose[:3])
        else:
            placements = self.tree.placements
            in_first = placements[first].actInv(placements[second]) * at
        self._close(name, "frame", (first, in_first), (second, at), where)

    def _joint(self, name: str, given: dict[str, str], where: str) -> None:
        """q_1 = a_0 + a_1 q_2 with positions that are zero at the references of MuJoCo."""
        coefficients = self.values.numbers(
            given.get("polycoef", "0 1 0 0 0"), (1, 2, 3, 4, 5), where, "polycoef"
        )
        coefficients = np.concatenate(
            [coefficients, [0.0, 1.0, 0.0, 0.0, 0.0][coefficients.size :]]
        )
        names = [given[key] for key in ("joint1", "joint2") if key in given]
        if "joint1" not in given:
            raise self.values.fault(where, "it has no joint1", "Name the joint that follows")
        for joint in names:
            if joint not in self.tree.references:
                known = ", ".join(self.tree.references) or "none"
                raise self.values.fault(
                    where, f"there is no hinge or slide {joint!r}", f"Known: {known}"
                )
        offset, ratio = float(coefficients[0]), float(coefficients[1])
        if len(names) == 1:
            self.lock.append(names[0])
            if offset:
                self.held[names[0]] = offset
            return
        if coefficients[2:].any():
            raise self.values.fault(
                where,
                "the coefficients of the powers 2 to 4 in polycoef are not zero",
                "Give a linear relation of two joints; others are not read by this version",
            )
        if names[0] == names[1]:
            raise self.values.fault(where, "joint1 and joint2 are the same", "Name two joints")
        self.loops.append(
            {"name": name, "type": "coupling", "joints": names, "ratio": ratio, "offset": offset}
        )

    # Tendons --------------------------------------------------------------------------------

    def tendons(self, section: Element) -> None:
        """Read a ``<tendon>`` section: springs between two sites act, the rest is no force."""
        values = self.values
        values.children(section, "<tendon>", ("spatial", "fixed"), (), ("spatial", "fixed"))
        for i, node in enumerate(section):
            name = node.get("name") or f"{node.tag}_tendon_{i + 1}"
            where = f"tendon {name!r}"
            if node.tag == "spatial":
                given = values.resolved(node, "", where, "tendon")
            else:
                given = {**values.classes["main"].get("tendon", {}), **node.attrib}
            acting = {
                key: values.number(given, key, 0.0, where)
                for key in ("stiffness", "damping", "frictionloss", "armature")
            }
            if not any(acting.values()):
                values.ignore("<tendon> without stiffness or damping")
                continue
            ends = [child.get("site", "") for child in node if child.tag == "site"]
            rest = values.numbers(given.get("springlength", "-1"), (1, 2), where, "springlength")
            if (
                node.tag == "fixed"
                or len(node) != 2
                or len(ends) != 2
                or acting["frictionloss"]
                or acting["armature"]
                or len(set(rest.tolist())) != 1
            ):
                raise values.fault(
                    where,
                    "only springs and dampers between two sites, with one rest length, are read",
                    "Remove its stiffness, damping, frictionloss and armature",
                )
            (body_a, at_a), (body_b, at_b) = (self.site(end, where) for end in ends)
            length = float(rest[0])
            if length < 0.0:
                places = self.tree.placements
                apart = (places[body_a] * at_a).translation - (places[body_b] * at_b).translation
                length = float(np.linalg.norm(apart))
            self.forces.append(
                {
                    "type": "spring_damper",
                    "name": name,
                    "a": anchor(body_a, pin.SE3(np.eye(3), at_a.translation)),
                    "b": anchor(body_b, pin.SE3(np.eye(3), at_b.translation)),
                    "stiffness": acting["stiffness"],
                    "damping": acting["damping"],
                    "rest_length": length,
                }
            )
