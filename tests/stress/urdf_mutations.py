"""Mutations of URDFs: elements and attributes deleted, duplicated, renamed, retyped."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from tests.stress.mutation import (
    GARBAGE,
    LOOPS,
    NAMES,
    REFUSED,
    REFUSED_OR_NOTED,
    START,
    THE_SAME_WITH_A_NOTE,
    TREE,
    Expectation,
    Files,
    Mutation,
    legal,
    misspelt,
    one_of,
    unchanged,
)

DRAWN = ("visual", "collision", "material")
KNOWN_TAGS = (
    *("link", "joint", "inertial", "origin", "mass", "inertia", "parent", "child", "axis"),
    *("limit", "dynamics", "mimic", "visual", "collision", "material", "transmission", "gazebo"),
    *("sensor", "contact", "calibration", "safety_controller", "geometry"),
)
KNOWN_ATTRIBUTES = (
    *("name", "type", "xyz", "rpy", "value", "link", "ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
    *("lower", "upper", "effort", "velocity", "damping", "friction", "rising", "k_position"),
)
NAMING = ("name", "link", "type")
OPTIONAL = {"origin": {"xyz": "0 0 0", "rpy": "0 0 0"}, "axis": {"xyz": "1 0 0"}}
"""Optional elements of joints and inertials: what URDF says when they are missing."""
MASSLESS = {"ixx": "0", "iyy": "0", "izz": "0", "ixy": "0", "ixz": "0", "iyz": "0"}
MOVING = (TREE, LOOPS, START)
Outcome = tuple[str, Expectation, str | None, str | None] | None
"""Change, expectation, the mutated text if it is no XML, the text with a default written out."""


@dataclass(frozen=True)
class Place:
    """An element: where it hangs, and whether it is only drawn."""

    parent: Element | None
    node: Element
    drawn: bool

    @property
    def tag(self) -> str:
        return str(self.node.tag)

    @property
    def path(self) -> str:
        name = self.node.get("name") or (self.parent is not None and self.parent.get("name")) or ""
        return f"<{self.tag}> ({name})"


def places(root: Element) -> list[Place]:
    """All elements below ``root``, and ``root``."""
    found = [Place(None, root, False)]

    def walk(parent: Element, drawn: bool) -> None:
        for node in parent:
            here = drawn or node.tag in DRAWN
            found.append(Place(parent, node, here))
            walk(node, here)

    walk(root, False)
    return found


def shifted(numbers: str) -> str:
    """Other numbers, as many."""
    return " ".join(f"{1.1 * float(x) + 0.01:.6g}" for x in numbers.split())


class UrdfMutator:
    """Draws mutations of the URDF of one bundled mechanism."""

    def __init__(self, model: str, files: Files, joints_in_description: set[str]) -> None:
        self.model, self.files = model, files
        self.described = joints_in_description

    def draw(self, rng: np.random.Generator) -> Mutation | None:
        """A random mutation; None if the drawn operation does not apply to the drawn element."""
        root = ElementTree.fromstring(self.files.urdf)
        drawn = bool(rng.random() < 0.12)
        candidates = [place for place in places(root) if place.drawn == drawn]
        tag = one_of(sorted({place.tag for place in candidates}), rng)
        place = one_of([place for place in candidates if place.tag == tag], rng)
        operation = one_of(
            [
                self.delete_element,
                self.duplicate_element,
                self.rename_element,
                self.delete_attribute,
                self.duplicate_attribute,
                self.rename_attribute,
                self.retype_attribute,
            ],
            rng,
        )
        outcome = operation(root, place, rng)
        if outcome is None:
            return None
        change, expectation, text, written_out = outcome
        text = text or ElementTree.tostring(root, encoding="unicode")
        return Mutation(
            self.model,
            f"urdf: {change}",
            Files(self.files.toml, text),
            expectation,
            None if written_out is None else Files(self.files.toml, written_out),
        )

    def delete_element(self, root: Element, place: Place, rng: np.random.Generator) -> Outcome:
        parent, node, tag = place.parent, place.node, place.tag
        if parent is None:
            return None
        change = f"{place.path} deleted"
        written_out = None
        if place.drawn or (tag == "link" and node.get("name") == "world"):
            expectation = unchanged()  # the ground needs no link
        elif tag in OPTIONAL or tag == "inertial":
            expectation = legal(*MOVING)
            if tag == "inertial":
                node.clear()
                ElementTree.SubElement(node, "mass", value="0")
                ElementTree.SubElement(node, "inertia", MASSLESS)
            else:
                node.attrib = dict(OPTIONAL[tag])
            written_out = ElementTree.tostring(root, encoding="unicode")
        else:
            expectation = REFUSED
        parent.remove(node)
        return change, expectation, None, written_out

    def duplicate_element(self, root: Element, place: Place, rng: np.random.Generator) -> Outcome:
        if place.parent is None:
            return None
        place.parent.insert(list(place.parent).index(place.node), copy.deepcopy(place.node))
        # Equal elements without others in them are read once, as urdfdom does.
        once = place.parent is not root and not len(place.node)
        expectation = THE_SAME_WITH_A_NOTE if once else REFUSED
        if place.drawn:
            expectation = unchanged()
        return f"{place.path} duplicated", expectation, None, None

    def rename_element(self, root: Element, place: Place, rng: np.random.Generator) -> Outcome:
        node, old = place.node, place.tag
        known = bool(rng.random() < 0.5)
        new = str(rng.choice(KNOWN_TAGS)) if known else misspelt(old, rng)
        if new == old:
            return None
        change = f"{place.path} renamed <{new}>"
        node.tag = new
        if place.drawn and place.parent is not None and place.parent.tag not in ("robot", "link"):
            expectation = legal()  # not read; but loops and inertia there are refused
        else:
            expectation = REFUSED_OR_NOTED if known else REFUSED
        return change, expectation, None, None

    def delete_attribute(self, root: Element, place: Place, rng: np.random.Generator) -> Outcome:
        node, tag = place.node, place.tag
        if not node.attrib:
            return None
        key = str(rng.choice(sorted(node.attrib)))
        change = f"{place.path} without {key}"
        written_out = None
        if place.drawn or (tag == "limit" and key in ("lower", "upper")):
            expectation = unchanged()
        elif tag == "dynamics":
            expectation = legal(*MOVING)
        elif tag == "origin":
            expectation = legal(*MOVING)
            node.set(key, OPTIONAL["origin"][key])
            written_out = ElementTree.tostring(root, encoding="unicode")
        else:
            expectation = REFUSED
        del node.attrib[key]
        return change, expectation, None, written_out

    def duplicate_attribute(self, root: Element, place: Place, rng: np.random.Generator) -> Outcome:
        """An attribute twice is no XML; only the text can say it."""
        if not place.node.attrib:
            return None
        key = str(rng.choice(sorted(place.node.attrib)))
        place.node.set("zzz", "MARK")
        text = ElementTree.tostring(root, encoding="unicode")
        text = text.replace('zzz="MARK"', f'{key}="{place.node.get(key)}"')
        return f"{place.path} with {key} twice", REFUSED, text, None

    def rename_attribute(self, root: Element, place: Place, rng: np.random.Generator) -> Outcome:
        node, tag = place.node, place.tag
        if not node.attrib:
            return None
        key = str(rng.choice(sorted(node.attrib)))
        known = bool(rng.random() < 0.5)
        new = str(rng.choice(KNOWN_ATTRIBUTES)) if known else misspelt(key, rng)
        if new in node.attrib:
            return None
        node.set(new, node.attrib.pop(key))
        change = f"{place.path}: {key} renamed {new}"
        if place.drawn:
            return change, unchanged(), None, None
        if tag == "origin" and {key, new} == {"xyz", "rpy"}:
            return change, legal(*MOVING), None, None
        return change, REFUSED, None, None

    def retype_attribute(self, root: Element, place: Place, rng: np.random.Generator) -> Outcome:
        node, tag = place.node, place.tag
        if not node.attrib:
            return None
        key = str(rng.choice(sorted(node.attrib)))
        old = node.get(key, "")
        expectation = REFUSED
        sensible = bool(rng.random() < 0.4)
        if key in NAMING:
            new, expectation = self._other_name(root, place, key, sensible, rng)
        elif sensible:
            new = "7" if place.drawn else shifted(old)
            expectation = unchanged() if tag == "limit" else legal(*MOVING)
        else:
            new = str(rng.choice(GARBAGE))
        if new == old:
            return None
        node.set(key, new)
        if place.drawn:
            expectation = unchanged()
        return f"{place.path}: {key}={old!r} made {new!r}", expectation, None, None

    def _other_name(
        self, root: Element, place: Place, key: str, sensible: bool, rng: np.random.Generator
    ) -> tuple[str, Expectation]:
        tag, old = place.tag, place.node.get(key, "")
        if key == "type":
            known = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar"]
            if sensible:
                new = str(rng.choice([kind for kind in known if kind != old]))
                return new, legal(*MOVING, NAMES)
            return str(rng.choice(["", "x", "hinge", old.upper(), f" {old}"])), REFUSED
        if not sensible:
            unnamed = rng.random() < 0.3
            new = "" if unnamed else "no_such_name"
            if unnamed or tag in ("parent", "child", "link") or old in self.described:
                return new, REFUSED
            return new, unchanged(NAMES)
        if tag == "robot":
            return "another name", unchanged(NAMES)
        kind = "joint" if tag == "joint" else "link"
        names = [node.get("name", "") for node in root.findall(kind)]
        new = str(rng.choice([name for name in names if name != old] or [old]))
        return new, legal(*MOVING, NAMES) if tag in ("parent", "child") else REFUSED
