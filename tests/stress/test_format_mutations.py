"""Loops in the words of other tools, mutated in every place: refused in our words, or another
mechanism; never a crash, and never the same as if nothing had been said."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest

from tests.formats.urdf.test_urdf_loops import BAR, HINGE, SLIDER
from tests.stress.isolation import fault_of, load_isolated

pytestmark = pytest.mark.stress

TILT = 1.2  # rad, of the rod against the crank at q = 0
TIP = (0.5 + math.cos(TILT), 0.0, -math.sin(TILT))  # m, of the rod: where the slider stands
TURNED = 'rpy="0.3 0.2 0.1"'
GARBAGE = ("", "x", "nan", "1e999", "1 2")


def tree(closing: str = "") -> str:
    """Crank, rod and slider, closed at q = 0, with two dials that the crank turns."""
    bars = "".join(BAR.format(name=name, half=0.3) for name in ("crank", "rod", "dial", "disk"))
    rod = HINGE.format(name="b", parent="crank", child="rod", xyz="0.5 0 0", more="")
    joints = [
        HINGE.format(name="a", parent="ground", child="crank", xyz="0 0 0", more=""),
        rod.replace("<origin ", f'<origin rpy="0 {TILT} 0" '),
        '<joint name="guide" type="prismatic"><parent link="ground"/><child link="slider"/>'
        f'<origin xyz="{TIP[0]!r} 0 {TIP[2]!r}"/><axis xyz="1 0 0"/>'
        '<limit lower="-9" upper="9" effort="1" velocity="1"/></joint>',
        HINGE.format(name="c", parent="ground", child="dial", xyz="0 1 0", more="MIMIC"),
        HINGE.format(name="d", parent="ground", child="disk", xyz="0 2 0", more=""),
    ]
    parts = [
        '<robot name="loops"><link name="ground"/>',
        bars,
        SLIDER,
        *joints,
        closing,
        "</robot>",
    ]
    return "".join(parts)


DRAKE = """<drake:{0} {1} xmlns:drake="http://drake.mit.edu">
  <drake:{0}_body_A name="rod"/><drake:{0}_body_B name="slider"/>
  <drake:{0}_p_AP value="1 0 0"/><drake:{0}_p_BQ value="0 0 {2}"/>{3}</drake:{0}>"""
NUMBERS = "".join(
    f'<drake:linear_spring_damper_{key} value="{value}"/>'
    for key, value in (("free_length", 0.4), ("stiffness", 3), ("damping", 2))
)
ELEMENTS = (
    f"""<loop name="plus" type="spherical">
      <predecessor link="rod"><origin xyz="1 0 0" {TURNED}/></predecessor>
      <successor link="slider"/></loop>""",
    f"""<loop_joint name="isaac" type="spherical"><link1 link="rod" xyz="1 0 0" {TURNED}/>
      <link2 link="slider"/></loop_joint>""",
    """<constraint name="urdfdom" type="revolute"><parent link="rod"/>
      <parent_origin xyz="1 0 0"/><parent_axis xyz="0 1 0"/><child link="slider"/>
      </constraint>""",
    DRAKE.format("ball_constraint", 'name="ball"', 0, ""),
    DRAKE.format("linear_spring_damper", "", 0.2, NUMBERS),
    """<gazebo><joint name="gz" type="revolute"><parent>rod</parent><child>slider</child>
      <pose>0 0 0 0.1 0 0</pose><axis><xyz>0 0.9950041652780258 -0.09983341664682815</xyz></axis>
      </joint></gazebo>""",
    '<joint name="pin" type="revolute"><parent link="rod"/><child link="slider"/>'
    '<origin xyz="1 0 0"/><axis xyz="0 -1 0"/><dynamics damping="0.3"/></joint>',
    '<coupling name="gear"><predecessor link="crank"/><successor link="disk"/><ratio value="2"/>'
    "</coupling>",
    '<mimic joint="a" multiplier="2" offset="0.5"/>',
)


def robot(element: str) -> str:
    if element.startswith("<mimic"):
        return tree().replace("MIMIC", element)
    return tree(element).replace("MIMIC", "")


def below(root: Element, original: Element) -> list[tuple[Element, Element]]:
    """(parent, element) of what the element under test added to the tree."""
    known = {ElementTree.tostring(node) for node in original}
    parents = [(root, node) for node in root if ElementTree.tostring(node) not in known]
    found = []
    while parents:
        parent, node = parents.pop()
        if node.tag != "joint" or node.get("name") != "c":
            found.append((parent, node))
            parents += [(node, child) for child in node]
        else:
            found += [(node, child) for child in node if child.tag == "mimic"]
    return found


Change = Callable[[Element, Element], object]
"""Changes an element, given with its parent."""


READ_ONCE = ("origin", "parent", "child", "axis", "dynamics")
"""Elements of a joint of which one is read if the others are equal."""


def changes(parent: Element, node: Element) -> Iterator[tuple[str, bool, Change]]:
    """What is done to ``node``, and whether it must be refused."""
    yield "deleted", False, lambda parent, node: parent.remove(node)
    # Two springs without a name are two springs; equal elements of a joint are read once.
    twice = not node.tag.endswith("}linear_spring_damper") and node.tag not in READ_ONCE
    yield "twice", twice, lambda parent, node: parent.append(copy.deepcopy(node))
    # Elements of <gazebo> other than joints are ignored with a note.
    acts = parent.tag != "gazebo"
    yield "misspelt", acts, lambda _, node: setattr(node, "tag", node.tag + "_x")
    acts = node.tag != "gazebo"
    yield "with more", acts, lambda _, node: ElementTree.SubElement(node, "more")
    for key in node.attrib:
        yield f"without {key}", False, lambda _, node, key=key: node.attrib.pop(key)

        def rename(_: Element, node: Element, key: str = key) -> None:
            node.set(key + "x", node.attrib.pop(key))

        yield f"{key} misspelt", True, rename
        for text in GARBAGE if key != "name" or "body" in node.tag else ():
            yield f"{key}={text!r}", True, lambda _, node, new=(key, text): node.set(*new)
    for text in GARBAGE if (node.text or "").strip() else ():
        yield f"text {text!r}", True, lambda _, node, text=text: setattr(node, "text", text)


def mutations(element: str) -> list[tuple[str, bool, str]]:
    """(what was done, whether it must be refused, text) of every mutation of one element."""
    text = robot(element)
    original = ElementTree.fromstring(robot(""))
    out = []
    for i, (above, here) in enumerate(below(ElementTree.fromstring(text), original)):
        for what, refused, change in changes(above, here):
            root = ElementTree.fromstring(text)
            parent, node = below(root, original)[i]
            tag = node.tag.rsplit("}", 1)[-1]
            change(parent, node)
            out.append((f"<{tag}> {what}", refused, ElementTree.tostring(root, encoding="unicode")))
    return out


YAML = "closed_loop: [[end, eye]]\ntype: [3d]\njoint_name: [d, c]\njoint_type: [FIXED, UJOINT_XY]\n"
FRAMES = (
    '<link name="end"/><joint name="e" type="fixed"><parent link="rod"/><child link="end"/>'
    '<origin xyz="1 0 0"/></joint><link name="eye"/><joint name="f" type="fixed">'
    '<parent link="slider"/><child link="eye"/></joint>'
)


def yaml_mutations() -> list[tuple[str, bool, str]]:
    """Every word of the YAML lost, misspelt, made a number or a list."""
    words = ["closed_loop", "end", "eye", "type", "3d", "joint_name", "d", "c", "joint_type"]
    words += ["FIXED", "UJOINT_XY"]
    out = []
    for word in words:
        for new in (word + "_x", "3", "[]", "~", "{a: 1}", "'", "\t"):
            for before, after in (("", ":"), ("[", "]"), ("[", ","), (" ", "]")):
                old = f"{before}{word}{after}"
                if old in YAML:
                    text = YAML.replace(old, f"{before}{new}{after}", 1)
                    out.append((f"{old} made {new!r}", True, text))
                    break
    for line in YAML.splitlines(keepends=True):
        out.append((f"{line.strip()} deleted", True, YAML.replace(line, "")))
        out.append((f"{line.strip()} twice", False, YAML.replace(line, line + line)))
    return out


def wrong(original: dict[str, Any], got: dict[str, Any], refused: bool) -> str | None:
    """What is wrong with an outcome."""
    fault = fault_of(got)
    if fault is not None or got["is"] == "refused":
        return fault
    if refused:
        return "loaded"
    same = all(got[part] == original[part] for part in ("tree", "loops", "names"))
    noted = got["remarks"] > original["remarks"]
    return "nothing has changed" if same and not noted else None


@pytest.mark.timeout(600)
@pytest.mark.parametrize("element", ELEMENTS, ids=lambda text: text[1:].split(" ")[0].split(">")[0])
def test_a_mutated_loop_is_refused_or_another_mechanism(element: str, tmp_path: Path) -> None:
    _check(robot(element), mutations(element), "robot.urdf", tmp_path)


@pytest.mark.timeout(600)
def test_a_mutated_yaml_is_refused(tmp_path: Path) -> None:
    found = [case for case in yaml_mutations() if "twice" not in case[0]]
    _check(YAML, found, "robot.yaml", tmp_path, robot(FRAMES))


def _check(
    original: str, cases: list[tuple[str, bool, str]], name: str, folder: Path, urdf: str = ""
) -> None:
    assert len(cases) > 20
    paths = []
    for i, text in enumerate([original, *(text for _, _, text in cases)]):
        at = folder / str(i)
        at.mkdir()
        if urdf:
            (at / "robot.urdf").write_text(urdf)
        (at / name).write_text(text)
        paths.append(str(at / name))
    results = load_isolated(paths)
    first = results[paths[0]]
    assert first["is"] == "loaded", first["message"]
    assert np.isfinite(first["start"][0]).all()
    faults = [
        f"{what}: {why}"
        for (what, refused, _), path in zip(cases, paths[1:])
        if (why := wrong(first, results[path], refused))
    ]
    assert not faults, f"{len(faults)} of {len(cases)}:\n" + "\n".join(faults)
