"""Loops inside a URDF: removed from its tree and written as closures of a description.

* the loop elements of other tools (:mod:`srm_mbs.formats.urdf.loop_elements`);
* a child link with two parents: the second joint becomes a closure of its freedom, closed at the
  joint's zero; one whose coordinate is needed keeps it, with a share of the link;
* ``<mimic>``: a coupling q = multiplier q_other + offset;
* pairs of frames ``closing_<name>_1`` and ``closing_<name>_2`` of onshape-to-robot;
* Drake's joints and motors are rewritten (:mod:`srm_mbs.formats.urdf.drake`).

A URDF without any of them remains as it is.

onshape-to-robot writes a mate whose name begins with ``closing_`` as two frames, which in its URDFs
are links on fixed joints.  A revolute mate gets two more frames, 0.1 m along its axis:
``closing_<name>_1_z`` and ``closing_<name>_2_z``.  For the other mates (ball, fastened, slider) the
URDF does not contain the type: the origins are joined, with a note.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import pinocchio as pin

from srm_mbs.errors import known_names
from srm_mbs.formats.document import Document
from srm_mbs.formats.graph.spanning_tree_to_urdf import numbers, placement, satisfied_note
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.urdf.drake import rewrite
from srm_mbs.formats.urdf.gazebo_links import hang_links, has_links
from srm_mbs.formats.urdf.graph import ONE_DEGREE, Graph, link_of
from srm_mbs.formats.urdf.loop_elements import LoopElements, coupling
from srm_mbs.formats.urdf.validation import ElementChecker

CLOSING = re.compile(r"(closing_.+)_1\Z")
SATISFIED = 1e-6
"""Distance (m, rad) of two frames on one body, which is rounding of the file."""
SHARED = {"mass": ("value",), "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
"""Attributes in an <inertial> of which each part of a link has its share."""


def _named_by(own: Mapping[str, Any]) -> set[str]:
    """Links and frames at which the description itself has closures."""
    found = set()
    for loop in own.get("loop", ()):
        for side in "ab":
            end = loop.get(side, {})
            if isinstance(end, Mapping):
                found |= {str(end.get("link")), str(end.get("frame"))}
    return found


def closing_frames(
    links: Iterable[str], own: Mapping[str, Any]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Closures of the pairs among ``links``, and notes.

    Pairs at which the description ``own`` has a closure are left to it.
    """
    names = list(links)
    known, described = set(names), _named_by(own)
    loops: list[dict[str, Any]] = []
    notes: list[str] = []
    for link in names:
        match = CLOSING.match(link)
        if match is None:
            continue
        name, other = match[1], f"{match[1]}_2"
        if other not in known:
            notes.append(f"the link {link!r} has no partner {other!r}: no loop is closed there")
            continue
        if {link, other} & described:
            notes.append(f"{name!r} is closed as the description says")
            continue
        loop = {"name": name, "type": "point", "a": {"link": other}, "b": {"link": link}}
        if {f"{link}_z", f"{other}_z"} <= known:
            loop |= {"type": "revolute", "axis": [0.0, 0.0, 1.0]}
        else:
            notes.append(
                f"{name!r} joins the origins of {link!r} and {other!r} (closure point): the file "
                "does not say the type of this mate; a [[loop]] between the two replaces it"
            )
        loops.append(loop)
    return loops, notes


def translate(document: Document, options: Options) -> Translation:
    """A URDF without its loops, and these as entries of a description.

    Raises
    ------
    InputError
        Naming the element that cannot be read.
    """
    root = document.xml
    extended = ElementChecker(document.file)
    found = rewrite(root, extended)
    notes = extended.notes
    fixed_base = (options.base or options.own.get("base", "fixed")) == "fixed"
    elements = LoopElements(document.file, Graph(root), fixed_base)
    compensated: dict[str, float] = {}
    if has_links(root):
        compensated = hang_links(root, elements, options.reach)
        found = True
    held = elements.screws(root)
    found |= _cut_second_parents(root, elements, options, notes, held) or bool(held)
    elements.graph = graph = Graph(root)
    found |= elements.read(root)
    found |= _mimics(elements, options, notes)
    loops, remarks = closing_frames(graph.links, options.own)
    elements.loops.extend(loops)
    notes += remarks
    satisfied = [loop for loop in elements.loops if _is_satisfied(loop, graph)]
    if satisfied:
        elements.loops = [loop for loop in elements.loops if loop not in satisfied]
        elements.forces = [
            force
            for force in elements.forces
            if force["type"] != "bushing" or not _is_satisfied(force, graph)
        ]
        notes.append(satisfied_note(loop["name"] or loop["type"] for loop in satisfied))
    entries: dict[str, Any] = {}
    if elements.loops:
        entries["loop"] = _named(elements.loops, options.own.get("loop", ()))
    if compensated:
        entries["gravity_compensation"] = compensated
    if elements.forces:
        entries["force"] = _named(elements.forces, options.own.get("force", ()))
    if found:
        elements.named(root, "joint")
        notes += [*elements.notes, *elements.ignored_notes()]
    text = None if found else partial(str, document.text)
    return Translation(root, text, entries, tuple(notes))


def _is_satisfied(loop: Mapping[str, Any], graph: Graph) -> bool:
    """Whether fixed joints hold the two frames of a closure, or of its bushing, together."""
    if loop["type"] == "universal" or not {"a", "b"} <= loop.keys():
        return False
    frames = []
    for end in (loop["a"], loop["b"]):
        holder, inside = graph.held(end["link"])
        zero = (0.0, 0.0, 0.0)
        frames.append((holder, inside * placement(end.get("xyz", zero), end.get("rpy", zero))))
    (one, here), (other, there) = frames
    return one == other and bool(here.actInv(there).isIdentity(SATISFIED))


def _named(entries: list[dict[str, Any]], own: Any) -> list[dict[str, Any]]:
    """The entries, with names made for those without: from the type and the links."""
    taken = {str(entry.get("name")) for entry in (*entries, *own)}
    counts: dict[str, int] = {}
    out = []
    for entry in entries:
        name = entry.get("name", "")
        if not name:
            ends = entry.get("joints") or [entry[side].get("link") for side in "ab"]
            name = stem = "_".join([entry["type"], *ends])
            while name in taken:
                counts[stem] = counts.get(stem, 1) + 1
                name = f"{stem}_{counts[stem]}"
            taken.add(name)
        out.append({**entry, "name": name})
    return out


# -- children of two parents -----------------------------------------------------------------


def _cut_second_parents(
    root: Element,
    reader: LoopElements,
    options: Options,
    notes: list[str],
    held: Sequence[str],
) -> bool:
    """Remove the joints that close loops and add their closures to ``reader``; whether there were
    any.

    Of several joints with the same child a screw, or one of those ``held``, stays in the tree, and
    otherwise the first.  Of the others those that act, or that a <mimic> refers to, get a share of
    the link.
    """
    by_child: dict[str, list[Element]] = {}
    for joint in reader.named(root, "joint", count=False).values():
        child = link_of(joint, "child")
        if child and link_of(joint, "parent"):
            by_child.setdefault(child, []).append(joint)
    for name in options.cut:
        if name not in reader.graph.joints:
            raise reader.fault("cut", f"there is no joint {name!r}", "Name joints of the file")
    leaders = {mimic.get("joint", "") for mimic in root.iterfind("joint/mimic")}
    cut, parted = [], []
    for child, joints in by_child.items():
        wanted = [joint for joint in joints if joint.get("name") in options.cut]
        others = [joint for joint in joints if joint not in wanted]
        threaded = (j for j in others if j.get("type") == "screw" or j.get("name") in held)
        kept = next(threaded, next(iter(others), None))
        if kept is None:
            raise reader.fault(
                f"joint {wanted[0].get('name', '')!r}",
                f"it cannot be cut: no other joint holds the link {child!r} in the tree",
                "Cut another joint of the loop",
            )
        sharing = []
        for joint in joints:
            name = joint.get("name", "")
            if joint is kept:
                continue
            if name in leaders or name in held or _acts(joint, reader):
                sharing.append(joint)
            else:
                _close(joint, reader)
                root.remove(joint)
                cut.append(name)
        if sharing:
            _share(root, child, sharing, reader)
            parted += [joint.get("name", "") for joint in sharing]
    if cut:
        names = ", ".join(map(repr, cut))
        notes.append(f"the joints {names} close loops: they are cut and became closures")
    if parted:
        names = ", ".join(map(repr, parted))
        notes.append(
            f"the joints {names} close loops and their coordinates are needed: each moves a link "
            "<child>::<joint> with a share of the mass and inertia of its child, which a closure "
            "holds to the child"
        )
    return bool(cut or parted)


def _acts(joint: Element, reader: LoopElements) -> bool:
    """Whether a joint that closes a loop has a thread, a <mimic>, friction or armature, which no
    closure has."""
    dynamics = joint.find("dynamics")
    where = f"joint {joint.get('name', '')!r}, which closes a loop"
    return (
        joint.get("type") == "screw"
        or joint.find("mimic") is not None
        or any(reader.number_or(0.0, dynamics, key, where) for key in ("friction", "armature"))
    )


def _share(root: Element, child: str, joints: Sequence[Element], reader: LoopElements) -> None:
    """Hang on each of ``joints`` an equal share of the link ``child``, which stays the child of
    another joint, and hold them together by closures.

    The parts have one frame: the motion is that of the whole link.
    """
    links = reader.named(root, "link", count=False)
    if child not in links:
        where = f"joint {joints[0].get('name', '')!r}"
        raise reader.unknown(where, f"the link {child!r} does not exist", links)
    inertial = links[child].find("inertial")
    if inertial is not None:
        for node in inertial:
            for key in SHARED.get(node.tag, ()):
                value = reader.number_or(0.0, node, key, f"link {child!r}, <inertial>")
                node.set(key, numbers([value / (1 + len(joints))]))
    for joint in joints:
        name = joint.get("name", "")
        part = f"{child}::{name}"
        if part in links:
            raise reader.fault(f"link {part!r}", "a part of a link gets this name", "Rename it")
        own = SubElement(root, "link", name=part)
        if inertial is not None:
            own.append(deepcopy(inertial))
        for node in joint.findall("child"):
            node.set("link", part)
        ends = (part, pin.SE3.Identity()), (child, pin.SE3.Identity())
        reader.add("fixed", part, *ends, where=f"joint {name!r}")


def _close(joint: Element, reader: LoopElements) -> None:
    """The closure of ``joint``: its frame on the child is the child's own, as it is at q = 0."""
    name = joint.get("name", "")
    where = f"joint {name!r}, which closes a loop"
    kind = reader.kind(joint, where)
    reader.attributes(joint, where)
    reader.children(joint, where)
    limit = joint.find("limit")
    if limit is not None:
        for key in limit.attrib:
            reader.number(limit, key, where)
    damping = reader.number_or(0.0, joint.find("dynamics"), "damping", where)
    if kind == "floating":  # it restrains nothing
        return
    parent, child = (reader.existing(link_of(joint, side), where) for side in ("parent", "child"))
    axes = [
        None if (node := joint.find(tag)) is None else reader.vector(node, "xyz", where)
        for tag in ("axis", "axis2")
    ]
    frame = reader.origin_of(joint.find("origin"), where)
    ends = (parent, frame), (child, pin.SE3.Identity())
    reader.joint(kind, name, *ends, axes, damping=damping, where=where)


# -- mimic -----------------------------------------------------------------------------------


def _mimics(elements: LoopElements, options: Options, notes: list[str]) -> bool:
    """Read and remove every <mimic>; whether there was one."""
    found = False
    locked = options.own.get("lock", ())
    joints = elements.graph.joints
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        where = f"joint {name!r}, <mimic>"
        elements.only(mimic, where, ("joint", "multiplier", "offset"))
        elements.leaf(mimic, where)
        if len(joint.findall("mimic")) > 1:
            raise elements.fault(where, "it is given twice", "Keep one")
        joint.remove(mimic)
        found = True
        if joint.get("type") == "fixed" or name in locked:
            notes.append(f"joint {name!r} does not move: its <mimic> is ignored")
            continue
        leader = mimic.get("joint", "")
        multiplier = elements.number_or(1.0, mimic, "multiplier", where)
        offset = elements.number_or(0.0, mimic, "offset", where)
        problem = _mimic_problem(name, leader, joints, locked)
        if problem:
            raise elements.fault(where, *problem)
        followers, leaders = [name], [leader]
        if multiplier == 0.0:
            leaders = []
        entry = coupling(f"mimic_{name}", followers, leaders, multiplier, offset)
        elements.loops.append(entry)
    return found


def _mimic_problem(
    name: str, leader: str, joints: dict[str, Element], locked: Any
) -> tuple[str, str] | None:
    """Problem and remedy of a <mimic> that cannot be a coupling."""
    if leader not in joints:
        return f"there is no joint {leader!r}", known_names(joints)
    if leader == name:
        return "the joint mimics itself", "Name another joint"
    for joint in (name, leader):
        kind = joints[joint].get("type")
        if kind not in ONE_DEGREE:
            return (
                f"the joint {joint!r} is of type {kind!r}",
                "Name joints with one degree of freedom",
            )
    if leader in locked:
        return f"the joint {leader!r} is locked", f"Lock {name!r} too, where it belongs"
    return None
