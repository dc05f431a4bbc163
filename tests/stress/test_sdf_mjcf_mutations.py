"""Mutated SDF and MJCF files: refused in our words, naming file and element; never a crash."""

from __future__ import annotations

import copy
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest

from tests.stress.isolation import fault_of, load_isolated
from tests.stress.mutation import GARBAGE, misspelt, one_of
from tests.support.mjcf_files import FOUR_BAR, TREE, TWO_LOOPS
from tests.support.sdf_files import four_bar, joint, link, sdf

pytestmark = pytest.mark.stress

COUNT = 600
ARM = sdf(
    link("base", "0 0 1 0 0.3 0"),
    '<frame name="mount" attached_to="base"><pose>0.1 0 0.2 0 0 1</pose></frame>',
    '<link name="arm"><pose relative_to="mount">0 0.1 0 1 0 0</pose><inertial><mass>2</mass>'
    "<inertia><ixx>0.1</ixx><iyy>0.1</iyy><izz>0.1</izz></inertia></inertial>"
    '<visual name="v"><geometry><box><size>1 1 1</size></box></geometry></visual></link>',
    joint(
        "hinge",
        "revolute",
        "mount",
        "arm",
        '<pose relative_to="base">0 0 0.1 0 0 0</pose>|<limit><lower>-1</lower><upper>1</upper>'
        "</limit><dynamics><damping>0.1</damping><spring_stiffness>3</spring_stiffness></dynamics>",
    ),
    '<model name="tool"><pose relative_to="arm">0 0 0.3 0 0 0</pose>' + link("tip") + "</model>",
    joint(
        "wrist", "universal", "arm", "tool::tip", "<axis2><xyz>1 0 0</xyz></axis2>", axis="0 1 0"
    ),
)
FILES = {
    "four_bar.sdf": four_bar(),
    "arm.sdf": ARM,
    "four_bar.xml": FOUR_BAR,
    "tree.xml": TREE,
    "two_loops.xml": TWO_LOOPS,
}
DRAWN = ("visual", "collision", "material", "rgba", "tendon", "spatial", "site")
NUMERIC = re.compile(r"[-+0-9.e\s]+")


@dataclass(frozen=True)
class Mutated:
    """A mutated file; ``bad``: it must be refused."""

    name: str
    change: str
    text: str
    bad: bool


def _numeric(text: str | None) -> bool:
    return bool(text and text.strip() and NUMERIC.fullmatch(text.strip()))


def mutate(name: str, rng: np.random.Generator) -> Mutated | None:
    """A random mutation; None if the drawn one does not apply to the drawn element."""
    root = ElementTree.fromstring(FILES[name])
    parents = {child: parent for parent in root.iter() for child in parent}
    node = one_of(list(parents), rng)
    parent = parents[node]
    inside: list[Element] = [node]
    while inside[-1] in parents:
        inside.append(parents[inside[-1]])
    acts = not any(each.tag in DRAWN for each in inside)
    keys = sorted(node.attrib)
    key = str(rng.choice(keys)) if keys else ""
    bad = False
    match int(rng.integers(7)):
        case 0:
            parent.remove(node)
            change = f"<{node.tag}> deleted"
        case 1:
            parent.append(copy.deepcopy(node))
            change = f"<{node.tag}> duplicated"
        case 2:
            change = f"<{node.tag}> misspelt"
            node.tag = misspelt(node.tag, rng)
            bad = acts
        case 3 if _numeric(node.text):
            node.text = str(rng.choice(GARBAGE))
            change = f"text of <{node.tag}> made {node.text!r}"
            bad = acts and node.text not in ("", "inf", "1 2", "1 2 3 4") and node.tag != "pose"
        case 4 if key:
            change = f"<{node.tag} {key}> misspelt"
            node.set(misspelt(key, rng), node.attrib.pop(key))
            bad = acts
        case 5 if key and _numeric(node.get(key)):
            old = node.get(key)
            node.set(key, str(rng.choice(GARBAGE)))
            change = f"{key}={old!r} of <{node.tag}> made {node.get(key)!r}"
            bad = acts and node.get(key) not in ("", "1 2", "1 2 3 4", "inf", "nan")
            bad = bad and key not in ("name", "body1", "body2", "joint1", "joint2")
            bad = bad and key not in ("solref", "solimp")
        case 6 if key and key not in ("pos", "axis", "model"):
            change = f"{key}={node.get(key)!r} of <{node.tag}> made a name that is not there"
            node.set(key, "no_such_name")
        case _:
            return None
    return Mutated(name, change, ElementTree.tostring(root, encoding="unicode"), bad)


def draw(count: int, seed: int = 0) -> list[Mutated]:
    """``count`` different mutations over all files."""
    rng = np.random.default_rng(seed)
    found: dict[str, Mutated] = {}
    while len(found) < count:
        mutated = mutate(str(rng.choice(list(FILES))), rng)
        if mutated is not None:
            found.setdefault(mutated.text, mutated)
    return list(found.values())


def complaint(mutated: Mutated, got: dict[str, Any]) -> str | None:
    """What is wrong with an outcome; None if it is as expected."""
    return fault_of(got) or ("loaded" if got["is"] == "loaded" and mutated.bad else None)


@pytest.mark.timeout(900)
def test_a_mutated_file_is_refused_by_name_or_loads(tmp_path: Path) -> None:
    mutations = draw(COUNT)
    paths = []
    for i, mutated in enumerate(mutations):
        path = tmp_path / f"{i}_{mutated.name}"
        path.write_text(mutated.text)
        paths.append(str(path))
    outcomes = load_isolated(paths)
    wrong = [
        f"{mutated.name}, {mutated.change}: {why}"
        for mutated, path in zip(mutations, paths)
        if (why := complaint(mutated, outcomes[path])) is not None
    ]
    assert not wrong, f"{len(wrong)} of {COUNT}:\n" + "\n".join(wrong)
    refused = sum(got["is"] == "refused" for got in outcomes.values())
    assert 0.3 * COUNT < refused < 0.95 * COUNT
