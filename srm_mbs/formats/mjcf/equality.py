"""Equality constraints and tendons of MJCF as closures and springs.

MuJoCo's constraints are soft (``solref``, ``solimp``); the closures are rigid.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.formats.graph.spanning_tree_to_urdf import anchor
from srm_mbs.formats.mjcf.attributes import (
    JOINT_EQUALITY,
    MAIN,
    TENDON_EQUALITY,
    Attributes,
)
from srm_mbs.formats.mjcf.bodies import BodyReader
from srm_mbs.formats.mjcf.parts import Part
from srm_mbs.model.anchors import WORLD

KINDS = ("connect", "weld", "joint", "tendon")
REFUSED = ("flex", "flexvert", "flexstrain", "distance")
ACTING = {
    "stiffness": "spring",
    "damping": "damper",
    "frictionloss": "frictionloss",
    "armature": "",
}
"""Attributes by which a tendon acts, and the flags that switch them off."""
POLYNOMIALS = {"joint": JOINT_EQUALITY, "tendon": TENDON_EQUALITY}
"""Attributes of equality constraints between coordinates."""
Placed = tuple[str, pin.SE3]
"""A body and a placement in its frame."""


class EqualityReader:
    """Reads ``<equality>`` and ``<tendon>`` of the files when all bodies are known.

    Attributes
    ----------
    loops, forces, lock, held
        Entries ``loop``, ``force``, ``lock`` and ``initial.q`` of a description.
    """

    def __init__(self, tree: BodyReader) -> None:
        self.values, self.tree = tree.values, tree
        self._fixed_tendons: dict[str, Element] = {}
        self.loops: list[dict[str, Any]] = []
        self.forces: list[dict[str, Any]] = []
        self.lock: list[str] = []
        self.held: dict[str, float] = {}

    def read(self, part: Part) -> None:
        """Read the constraints and tendons of a file."""
        self.values = values = part.values
        tendons: list[tuple[str, Element]] = []
        for section in part.attached("tendon"):
            values.children(section, "<tendon>", ("spatial", "fixed"), (), ("spatial", "fixed"))
            for i, node in enumerate(section):
                name = node.get("name") or f"{values.prefix}{node.tag}_tendon_{i + 1}"
                tendons.append((name, node))
                if node.tag == "fixed":
                    self._fixed_tendons[name] = node
        for section in part.attached("equality"):
            self.equality(section)
        self._springs(tendons)

    # Equality -------------------------------------------------------------------------------

    def equality(self, section: Element) -> None:
        """Read an ``<equality>`` section."""
        values = self.values
        disabled = "equality" in values.off
        kinds = {
            "connect": self._connect,
            "weld": self._weld,
            "joint": self._joint,
            "tendon": self._tendon,
        }
        values.children(section, "<equality>", (*KINDS, *REFUSED), (), (*KINDS, *REFUSED))
        for node in section:
            count = len(self.loops) + len(self.lock)
            name = node.get("name") or f"{values.prefix}{node.tag}_{count + 1}"
            given = self._given(node, f"equality {name!r} (<{node.tag}>)")
            if disabled or not given.flag("active", True):
                values.remark("equality constraints that are not active are left out", name)
                continue
            if node.tag in REFUSED:
                raise given.fault(
                    f"<{node.tag}> equality constraints are not read by this version",
                    'Remove it, or write active="false"',
                )
            if given.text("solref") or given.text("solimp"):
                values.remark("solref and solimp (softness) do not act: closures are rigid", name)
            kinds[node.tag](name, given)

    def _given(self, node: Element, where: str) -> Attributes:
        values = self.values
        if node.tag in REFUSED:
            return Attributes(values, node.attrib, where)
        if node.tag in POLYNOMIALS:  # not the joints and tendons of the file
            values.attributes(node, where, (*POLYNOMIALS[node.tag], "solref", "solimp"))
            name = node.get("class", MAIN)
            if name not in values.classes:
                raise values.fault(where, f"there is no default class {name!r}", "Define it")
            defaults = values.classes[name].get("equality", {})
            return Attributes(values, {**defaults, **node.attrib}, where)
        return values.resolved(node, "", where, "equality")

    def _bodies(self, given: Attributes) -> list[str]:
        """``body1`` and ``body2``, by default the ground."""
        names = [given.text("body1"), given.text("body2", WORLD)]
        for key, name in zip(("body1", "body2"), names):
            if name not in self.tree.placements:
                problem = f"there is no body {name!r} ({key})" if name else f"it has no {key}"
                raise self.values.unknown(given.where, problem, self.tree.placements)
        return names

    def _sites(self, given: Attributes) -> list[Placed]:
        """Bodies and placements of site1 and site2; empty if bodies are given."""
        keys = [key for key in ("site1", "site2") if key in given]
        if len(keys) == 1 or (keys and ("body1" in given or "body2" in given)):
            raise given.fault("it needs two sites, or bodies, and not both", "Give site1 and site2")
        return [self.site(given.text(key), given.where) for key in keys]

    def site(self, name: str, where: str) -> Placed:
        """Body and placement in it of a site."""
        if name not in self.tree.sites:
            raise self.values.unknown(where, f"there is no site {name!r}", self.tree.sites)
        return self.tree.sites[name]

    def _close(self, name: str, kind: str, ends: Sequence[Placed], given: Attributes) -> None:
        a, b = ends
        if a[0] == b[0]:
            raise given.fault(f"both ends are on the body {a[0]!r}", "Use two bodies")
        self.loops.append({"name": name, "type": kind, "a": anchor(*a), "b": anchor(*b)})

    def _connect(self, name: str, given: Attributes) -> None:
        ends = self._sites(given)
        if not ends:
            first, second = self._bodies(given)
            if "anchor" not in given:
                raise given.fault("it has no anchor", "Give it, in body1's frame")
            at = pin.SE3(np.eye(3), given.numbers("anchor", 3))
            placements = self.tree.placements
            if self.values.compiler.in_world:
                at = placements[first].inverse() * at
            ends = [(first, at), (second, placements[second].actInv(placements[first] * at))]
        self._close(name, "point", [(body, _point(at)) for body, at in ends], given)

    def _weld(self, name: str, given: Attributes) -> None:
        may_turn = given.number("torquescale", 1.0) == 0.0
        if "torquescale" in given and not may_turn:
            self.values.remark("torquescale does not act: closures are rigid", name)
        ends = self._sites(given)
        if not ends:
            first, second = self._bodies(given)
            at = pin.SE3(np.eye(3), given.numbers("anchor", 3, "0 0 0"))
            pose = given.numbers("relpose", 7, "0 1 0 0 0 0 0")
            if pose[3:].any():
                # MuJoCo holds the anchor, not body2's origin, at the position of relpose.
                what = "the quaternion of relpose"
                turn = self.values.quaternion(pose[3:], given.where, what)
                in_first = pin.SE3(turn, pose[:3])
            else:
                placements = self.tree.placements
                in_first = placements[first].actInv(placements[second]) * at
            ends = [(first, in_first), (second, at)]
        if may_turn:  # MuJoCo's rows of the rotation are zero
            self._close(name, "point", [(body, _point(at)) for body, at in ends], given)
        else:
            self._close(name, "frame", ends, given)

    def _joint(self, name: str, given: Attributes) -> None:
        """q_1 = a_0 + a_1 q_2 + ... with positions that are zero at the references of MuJoCo."""
        names = [given.text(key) for key in ("joint1", "joint2") if key in given]
        if "joint1" not in given:
            raise given.fault("it has no joint1", "Name the joint that follows")
        if len(names) == 2 and names[0] == names[1]:
            raise given.fault("joint1 and joint2 are the same", "Name two joints")
        self._couple(name, given, [{joint: 1.0} for joint in names])

    def _tendon(self, name: str, given: Attributes) -> None:
        """L_1 = a_0 + a_1 L_2 + ... of the lengths of fixed tendons, against those of the
        references."""
        if "tendon1" not in given:
            raise given.fault("it has no tendon1", "Name a fixed tendon")
        sides = []
        for key in ("tendon1", "tendon2"):
            if key in given:
                found = given.text(key)
                if found not in self._fixed_tendons:
                    problem = f"there is no fixed tendon {found!r}"
                    raise self.values.unknown(given.where, problem, self._fixed_tendons)
                sides.append(self._coefficients(found, self._fixed_tendons[found]))
        self._couple(name, given, sides)

    def _coefficients(self, name: str, node: Element) -> dict[str, float]:
        """Factors of the positions of joints in the length of a fixed tendon."""
        out: dict[str, float] = defaultdict(float)
        for child in node:
            given = Attributes(self.values, child.attrib, f"tendon {name!r}, <{child.tag}>")
            out[given.text("joint")] += given.number("coef")
        return out

    def _couple(self, name: str, given: Attributes, sides: Sequence[Mapping[str, float]]) -> None:
        """y_1 = a_0 + a_1 y_2 + ..., each y a sum of multiples of joint positions; without y_2,
        y_1 = a_0."""
        polynomial = np.array([0.0, 1.0, 0.0, 0.0, 0.0])
        coefficients = given.numbers("polycoef", (1, 2, 3, 4, 5), "0 1 0 0 0")
        polynomial[: coefficients.size] = coefficients
        for joint in (joint for side in sides for joint in side):
            if joint not in self.tree.references:
                problem = f"there is no hinge or slide {joint!r}"
                raise self.values.unknown(given.where, problem, self.tree.references)
        if len(sides) > 1 and polynomial[2:].any():
            self._couple_by_polynomial(name, given, sides, polynomial)
            return
        factors = defaultdict(float, sides[0])
        for joint, factor in sides[-1].items() if len(sides) > 1 else ():
            factors[joint] -= float(polynomial[1]) * factor
        match [(joint, factor) for joint, factor in factors.items() if factor]:
            case [(joint, factor)]:
                self.lock.append(joint)
                if polynomial[0]:
                    self.held[joint] = float(polynomial[0]) / factor
            case [(joint, factor), (other, its_own)]:
                self.loops.append(
                    {
                        "name": name,
                        "type": "coupling",
                        "joints": [joint, other],
                        "ratio": -its_own / factor + 0.0,
                        "offset": float(polynomial[0]) / factor,
                    }
                )
            case []:
                raise given.fault("it couples no joint", 'Remove it, or write active="false"')
            case terms:
                self.loops.append(
                    {
                        "name": name,
                        "type": "coupling",
                        "joints": [joint for joint, _ in terms],
                        "coefficients": [factor for _, factor in terms],
                        "offset": float(polynomial[0]),
                    }
                )

    def _couple_by_polynomial(
        self,
        name: str,
        given: Attributes,
        sides: Sequence[Mapping[str, float]],
        polynomial: FloatArray,
    ) -> None:
        """y_1 = a_0 + a_1 y_2 + ... + a_4 y_2^4, powers whose coefficient is zero at the end left
        out."""
        left, right = ({j: factor for j, factor in side.items() if factor} for side in sides)
        if not left or not right:
            raise given.fault("a side of it has no joint", 'Remove it, or write active="false"')
        entry = {
            "name": name,
            "type": "coupling",
            "joints": [*left, *(joint for joint in right if joint not in left)],
            "polynomial": np.trim_zeros(polynomial, "b").tolist(),
        }
        if [*left.values(), *right.values()] != [1.0, 1.0] or left.keys() == right.keys():
            for key, side in (("coefficients", left), ("arguments", right)):
                entry[key] = [side.get(joint, 0.0) for joint in entry["joints"]]
        self.loops.append(entry)

    # Tendons --------------------------------------------------------------------------------

    def _springs(self, tendons: Sequence[tuple[str, Element]]) -> None:
        """Read the forces of tendons: springs between two sites and those of fixed tendons act;
        the rest is no force."""
        values = self.values
        for name, node in tendons:
            where = f"tendon {name!r}"
            if node.tag == "spatial":
                given = values.resolved(node, "", where, "tendon")
            else:
                defaults = values.classes[MAIN].get("tendon", {})
                given = Attributes(values, {**defaults, **node.attrib}, where)
            stiffness, damping, friction, armature = (
                0.0 if flag in values.off else given.number(key) for key, flag in ACTING.items()
            )
            if not (stiffness or damping or friction or armature):
                values.ignore("<tendon> without stiffness or damping")
                continue
            rest = np.resize(given.numbers("springlength", (1, 2), "-1"), 2)
            if rest[0] > rest[1]:
                raise given.fault("its springlength decreases", "Exchange the two")
            if node.tag == "fixed":
                acting = {"stiffness": stiffness, "damping": damping, "friction": friction}
                self._fixed_spring(name, node, where, acting, armature, rest)
                continue
            ends = [child.get("site", "") for child in node if child.tag == "site"]
            for refused, problem in (
                (
                    not len(node) == len(ends) == 2,
                    "it is a spring or damper that does not go between two sites",
                ),
                (friction, "its frictionloss would act along a line"),
                (armature, "its armature would act along a line"),
            ):
                if refused:
                    raise given.fault(
                        f"{problem}, which is not read by this version",
                        "Remove its stiffness, damping, frictionloss or armature",
                    )
            (body_a, at_a), (body_b, at_b) = (self.site(end, where) for end in ends)
            length = float(rest[0])
            if length < 0.0:
                places = self.tree.placements
                apart = (places[body_a] * at_a).translation - (places[body_b] * at_b).translation
                length = float(np.linalg.norm(apart))
                rest[:] = length
            self.forces.append(
                {
                    "type": "spring_damper",
                    "name": name,
                    "a": anchor(body_a, _point(at_a)),
                    "b": anchor(body_b, _point(at_b)),
                    "stiffness": stiffness,
                    "damping": damping,
                    "rest_length": length,
                    **_not_zero(slack=float(rest[1]) - length),
                }
            )

    def _fixed_spring(
        self,
        name: str,
        node: Element,
        where: str,
        acting: Mapping[str, float],
        armature: float,
        rest: FloatArray,
    ) -> None:
        """The spring, damper and friction ``acting`` in a fixed tendon, whose length is a sum of
        joint positions; its spring is relaxed between the two lengths ``rest``, by default at the
        springrefs."""
        references, factors = self.tree.references, self._coefficients(name, node)
        for joint in factors:
            if joint not in references:
                problem = f"there is no hinge or slide {joint!r}"
                raise self.values.unknown(where, problem, references)
        terms = {joint: factor for joint, factor in factors.items() if factor}
        if not terms:
            raise self.values.fault(where, "it acts on no joint", "Remove its stiffness")
        if armature:
            self._add_armature(name, terms, armature)
        if not any(acting.values()):
            return
        low, high = rest.tolist()
        if low == high == -1.0:
            low = high = sum(factor * self.tree.rests[joint] for joint, factor in terms.items())
        if acting["friction"]:
            self.values.remark(
                "frictionloss acts as smoothed Coulomb friction, not as MuJoCo's soft constraint",
                where,
            )
        self.forces.append(
            {
                "type": "coupling_spring",
                "name": name,
                "joints": list(terms),
                "coefficients": list(terms.values()),
                "stiffness": acting["stiffness"],
                "damping": acting["damping"],
                "rest": low - sum(terms[joint] * references[joint] for joint in terms),
                **_not_zero(slack=high - low, friction=acting["friction"]),
            }
        )

    def _add_armature(self, name: str, terms: Mapping[str, float], armature: float) -> None:
        """The armature of a fixed tendon: of its one joint, or of a joint of its own whose position
        is the length of the tendon, from that at the references."""
        if len(terms) == 1:
            ((joint, factor),) = terms.items()
            self.tree.add_armature(joint, factor**2 * armature)
            return
        joint = self.tree.add_tendon(name, next(iter(terms)), armature)
        self.values.remark("the armature of a tendon acts on a joint of its own", joint)
        self.loops.append(
            {
                "name": joint,
                "type": "coupling",
                "joints": [joint, *terms],
                "coefficients": [1.0, *(-factor for factor in terms.values())],
            }
        )


def _not_zero(**values: float) -> dict[str, float]:
    return {key: value for key, value in values.items() if value}


def _point(placement: pin.SE3) -> pin.SE3:
    """The placement of the same origin without rotation."""
    return pin.SE3(np.eye(3), placement.translation)
