"""``robot.yaml`` beside ``robot.urdf``: loops as Gepetto's example-parallel-robots describe them.

Parallel lists, whose names are frames and joints of the URDF:

* ``closed_loop``, pairs of frames, and ``type``: ``6d`` makes the frames coincide, ``3d`` their
  origins;
* ``joint_name`` and ``joint_type``: joints that are of another type than the URDF says,
  ``SPHERICAL``, ``UJOINT_XY`` (two angles, about x, then about the turned y; likewise the other
  pairs), ``FIXED`` (held at zero);
* ``name_mot``: the joints with motors, which is only noted.
"""

from __future__ import annotations

import re
import reprlib  # of nested anchors and aliases: repr would write out all of them
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

from srm_mbs.errors import InputError, known_names
from srm_mbs.formats.document import Document
from srm_mbs.formats.files import check_name, shortened
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.urdf import loops as urdf_loops

KEYS = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")
LARGEST_YAML = 10**6
"""Characters of the YAML file."""
LARGEST_YAML_DEPTH = 20
"""Values in each other, the stream and the document included."""
PAIRED = {"closed_loop": "type", "joint_name": "joint_type"}
"""Lists of the same length."""
CLOSURES = {"3d": "point", "6d": "frame"}
UNIVERSAL = re.compile(r"UJOINT_([XYZ])([XYZ])\Z")
AXES = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}
REPLACEABLE = ("revolute", "continuous", "prismatic", "floating", "planar")


def recognises(document: Document) -> bool:
    """Whether a text has one of the keys at the beginning of a line."""
    return re.search(rf"^({'|'.join(KEYS)})[ \t]*:", document.text, re.MULTILINE) is not None


def translate(document: Document, options: Options) -> Translation:
    """The URDF beside a YAML file, its joints of the right types, and the closures.

    Raises
    ------
    InputError
        Naming the key at fault.
    """
    lists = _read(document.text)
    beside = _urdf_beside(Path(document.file))
    options.reach.check(beside, "URDF")
    urdf = Document.read(beside)
    plain = urdf_loops.translate(urdf, options)
    root = plain.tree
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    frames = {*joints, *(link.get("name", "") for link in root.findall("link"))}
    fixed = []
    for name, kind in zip(lists["joint_name"], lists["joint_type"]):
        if name not in joints:
            raise _unknown("joint_name", "joint", name, joints)
        if _retype(joints[name], name, kind):
            fixed.append(name)
    loops = []
    for pair, kind in zip(lists["closed_loop"], lists["type"]):
        for name in pair:
            if name not in frames:
                raise _unknown("closed_loop", "frame", name, frames)
        a, b = ({"frame": name} for name in pair)
        closure = CLOSURES[kind.lower()]
        loops.append({"name": "_".join(pair), "type": closure, "a": a, "b": b})
    entries = dict(plain.entries)
    entries["loop"] = [*entries.get("loop", ()), *loops]
    if fixed:
        entries["lock"] = fixed
    notes = [*urdf.notes, *plain.notes]
    motors = lists["name_mot"]
    missing = [name for name in motors if name not in joints]
    for note, names in (
        ("joints with motors (name_mot), which exert nothing here", motors),
        ("name_mot names no joints of the URDF", missing),
    ):
        if names:
            notes.append(f"{note}: {', '.join(names)}")
    return Translation(root, None, entries, tuple(notes), urdf_file=urdf.file)


def _fault(element: str, problem: str, remedy: str) -> InputError:
    return InputError(problem, element=element, remedy=remedy)


def _unknown(key: str, what: str, name: str, known: Iterable[str]) -> InputError:
    return _fault(key, f"the URDF has no {what} {name!r}", known_names(sorted(known)))


def _read(text: str) -> dict[str, list[Any]]:
    """The lists by key, of equal length where they belong together; empty where there is none."""
    import yaml

    if len(text) > LARGEST_YAML:
        raise _fault("", f"it has more than {LARGEST_YAML / 1e6:.0f} MB", "Give a smaller file")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check_depth(yaml.parse(text, loader))  # the loader recurses
        raw = yaml.load(text, loader)
    except (yaml.YAMLError, RecursionError, ValueError, TypeError) as error:
        # Its own message quotes lines of the file.
        problem = shortened(getattr(error, "problem", None) or type(error).__name__)
        mark = getattr(error, "problem_mark", None)
        at = "" if mark is None else f" at line {mark.line + 1}, column {mark.column + 1}"
        raise _fault("", f"this is not valid YAML: {problem}{at}", "Correct the file") from error
    if not isinstance(raw, dict):
        raise _fault("", "it holds no keys", f"Give {', '.join(KEYS)}")
    for key in raw:
        if key not in KEYS:
            raise _fault(shortened(str(key)), "this key is unknown", known_names(KEYS))
    lists: dict[str, list[Any]] = {}
    for key in KEYS:
        value = raw.get(key)
        value = [] if value is None else value
        if not isinstance(value, list):
            raise _fault(key, "a list is wanted", "Write [...]")
        lists[key] = value
    for key, other in PAIRED.items():
        if len(lists[key]) != len(lists[other]):
            raise _fault(
                other,
                f"it has {len(lists[other])} entries, {key} has {len(lists[key])}",
                "Give both the same length",
            )
    for pair in lists["closed_loop"]:
        if not isinstance(pair, list) or len(pair) != 2 or not all(map(_is_name, pair)):
            raise _fault(
                "closed_loop",
                f"{reprlib.repr(pair)} is not a pair of frames",
                'Write ["first", "second"]',
            )
    for key in ("type", "name_mot", "joint_name", "joint_type"):
        for entry in lists[key]:
            if not _is_name(entry):
                raise _fault(key, f"{reprlib.repr(entry)} is not text", "Put it in quotes")
            check_name(entry, key)
    for kind in lists["type"]:
        if kind.lower() not in CLOSURES:
            raise _fault("type", f"there is no type {kind!r}", "Known: 3d, 6d")
    for name, count in Counter(lists["joint_name"]).items():
        if count > 1:
            raise _fault("joint_name", f"{name!r} is given twice", "Keep one")
    return lists


def _check_depth(events: Iterable[Any]) -> None:
    """Refuse lists and keys in each other deeper than :data:`LARGEST_YAML_DEPTH`."""
    depth = 0
    for event in events:
        kind = type(event).__name__
        depth += kind.endswith("StartEvent") - kind.endswith("EndEvent")
        if depth > LARGEST_YAML_DEPTH:
            raise _fault("", "its values are nested too deep", "Remove what the format has not")


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _urdf_beside(path: Path) -> Path:
    """The URDF of the same name, else robot.urdf, else the only one in the folder."""
    for candidate in (path.with_suffix(".urdf"), path.with_name("robot.urdf")):
        if candidate.is_file():
            return candidate
    found = sorted(path.parent.glob("*.urdf"))
    if len(found) != 1:
        raise _fault(
            "",
            f"there is no {path.with_suffix('.urdf').name!r} and no 'robot.urdf' beside it",
            "Put the URDF there; it describes the links and joints",
        )
    return found[0]


def _retype(joint: Element, name: str, kind: str) -> bool:
    """Give ``joint`` the type in the YAML file; True if it is to be locked instead."""
    old = joint.get("type")
    if old not in REPLACEABLE:
        raise _fault("joint_type", f"the joint {name!r} is of type {old!r}: it stays", "Remove it")
    if kind == "FIXED":
        return True
    universal = UNIVERSAL.match(kind)
    if kind != "SPHERICAL" and universal is None:
        raise _fault(
            "joint_type",
            f"there is no type {kind!r}",
            "Known: SPHERICAL, FIXED, UJOINT_XY and the other pairs of X, Y, Z",
        )
    for tag in ("axis", "limit"):
        for node in joint.findall(tag):
            joint.remove(node)
    if universal is None:
        joint.set("type", "spherical")
        return False
    first, second = universal.groups()
    if first == second:
        raise _fault("joint_type", f"the axes of {kind!r} are in line", "Give different ones")
    joint.set("type", "universal")
    SubElement(joint, "axis", xyz=AXES[first])
    SubElement(joint, "axis2", xyz=AXES[second])
    return False
