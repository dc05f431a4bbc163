"""MJCF (MuJoCo's XML, https://mujoco.readthedocs.io/en/stable/XMLreference.html) to a URDF tree
and closures.

The tree is read here and not by Pinocchio, whose reader keeps the first body of the world only,
drops ``<equality><joint>`` and activates what is inactive.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.formats.document import Document
from srm_mbs.formats.graph.joint_graph import ROOT_JOINT
from srm_mbs.formats.graph.spanning_tree_to_urdf import GraphTranslator
from srm_mbs.formats.mjcf.actuators import ActuatorReader
from srm_mbs.formats.mjcf.attributes import Attributes, MjcfValues
from srm_mbs.formats.mjcf.bodies import BodyReader
from srm_mbs.formats.mjcf.equality import EqualityReader
from srm_mbs.formats.mjcf.keyframes import KeyframeReader
from srm_mbs.formats.mjcf.parts import main_part
from srm_mbs.formats.translation import Options, Translation

GRAVITY = "0 0 -9.81"
GROUPS = tuple(range(1, 32))
"""Counts of groups of actuators."""
THIN = {"density": (2.0, "kg/m^3"), "viscosity": (1e-4, "Pa s")}
"""Media whose drag is left out, with a note: gases such as air."""
INCLUDED = {
    "passive": ("spring", "damper", "gravcomp"),
    "constraint": ("equality", "frictionloss"),
}
"""Flags that disable several kinds of force, and those kinds."""


def _option(values: MjcfValues, nodes: list[Element]) -> tuple[FloatArray, set[int]]:
    """Gravity (3,), and the groups of actuators that are switched off; kinds of force that are
    go into ``values``."""
    gravity = GRAVITY
    groups: set[int] = set()
    for node in nodes:
        given = values.own(node, "<option>")
        values.children(node, "<option>", ("flag",), ())
        gravity = given.text("gravity", gravity)
        if given.text("actuatorgroupdisable"):
            groups |= set(map(int, given.numbers("actuatorgroupdisable", GROUPS).tolist()))
        for flag in node.findall("flag"):
            off = {key for key, word in flag.attrib.items() if word == "disable"}
            values.off |= off.union(*(INCLUDED.get(key, ()) for key in off))
    if "gravity" in values.off:
        gravity = "0 0 0"
    return values.numbers(gravity, 3, "<option>", "gravity"), groups


def _check_medium(values: MjcfValues, nodes: list[Element]) -> None:
    """Refuse a medium in which bodies move, unless it is as thin as air."""
    for node in nodes:
        given = Attributes(values, node.attrib, "<option>")
        for key, (most, unit) in THIN.items():
            if given.number(key) > most:
                problem = f"the drag of a medium does not act, and its {key} is above {most} {unit}"
                raise given.fault(problem, f"Remove {key} if the drag is negligible")
            if given.number(key):
                values.remark(f"the drag of the medium ({key}) does not act", "<option>")


def translate(document: Document, options: Options) -> Translation:
    """Translate an MJCF file.

    Parameters
    ----------
    document
        The file; its path is also where the files that it includes are searched.
    options
        Joints to cut: bodies of MJCF are a tree, so that any name is an error.

    Raises
    ------
    InputError
        Naming the file, the element and the remedy.
    """
    file, root = document.file, document.xml
    values = MjcfValues(file)
    if root.tag != "mujoco":
        raise InputError(
            f"the root element is <{root.tag}>, not <mujoco>", file=file, remedy="Give an MJCF file"
        )
    part = main_part(values, root, options.reach)
    if options.cut:
        raise values.fault(
            "cut", "the joints of an MJCF file are a tree: nothing is to be cut", "Remove cut"
        )
    gravity, disabled = _option(values, root.findall("option"))
    tree = BodyReader(part, options.reach)
    for node in root.findall("worldbody"):
        tree.world(node)
    if not tree.bodies:
        raise values.fault("<worldbody>", "there is no <body>", "Add one for every body")
    if tree.order:
        _check_medium(values, root.findall("option"))
    tree.rescale()
    tree.add_rotors()
    tree.resolve_springdampers()
    closures = EqualityReader(tree)
    for each in tree.parts:
        closures.read(each)
    actuators = ActuatorReader(tree, closures.lock, disabled)
    for each in tree.parts:
        actuators.read(each)
    actuators.finish()
    pairs = sum(len(node) for each in tree.parts for node in each.root.findall("contact"))
    if pairs:
        why = "contact between bodies does not act"
        values.remark(why, f"{pairs} element(s) of <contact> ignored")
    root_body = next(iter(tree.free), next(iter(tree.bodies)))
    graph = GraphTranslator(
        file,
        root.get("model") or "mujoco",
        tree.bodies,
        tree.placements,
        tree.joints,
        root_body,
        tree.free,
    )
    made = graph.translate()
    joints = {joint.get("name", "") for joint in made.tree.findall("joint")}
    joints -= set(closures.lock)
    if made.entries.get("base") == "floating":
        joints.add(ROOT_JOINT)
    keyframes = KeyframeReader(values, tree)
    start = keyframes.start(options.keyframe, bool(closures.loops), joints)
    if closures.held:
        start["q"] = start.get("q", {}) | closures.held
    return made.extended(
        values.notes(),
        gravity=gravity.tolist(),
        loop=closures.loops,
        force=[*tree.forces, *closures.forces],
        actuators=actuators.actuators,
        gravity_compensation=tree.compensated,
        lock=closures.lock,
        initial=start,
    )
