"""MJCF (MuJoCo's XML, https://mujoco.readthedocs.io/en/stable/XMLreference.html) to a URDF tree
and closures.

The tree is read here and not by Pinocchio, whose reader keeps the first body of the world only,
drops ``<equality><joint>`` and activates what is inactive.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, naming
from srm_mbs.formats.document import Document
from srm_mbs.formats.files import read_text, shortened
from srm_mbs.formats.graph.joint_graph import ROOT_JOINT
from srm_mbs.formats.graph.spanning_tree_to_urdf import GraphTranslator
from srm_mbs.formats.mjcf.attributes import IGNORED_SECTIONS, SECTIONS, MjcfValues
from srm_mbs.formats.mjcf.bodies import BodyReader
from srm_mbs.formats.mjcf.equality import EqualityReader
from srm_mbs.formats.mjcf.geoms import INERTIAS, Mesh
from srm_mbs.formats.mjcf.keyframes import KeyframeReader
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.xml import check_tree, parse_xml
from srm_mbs.model.reach import Reach

GRAVITY = "0 0 -9.81"
THIN = {"density": (2.0, "kg/m^3"), "viscosity": (1e-4, "Pa s")}
"""Media whose drag is left out, with a note: gases such as air."""
INCLUDED = {
    "passive": ("spring", "damper", "gravcomp"),
    "constraint": ("equality", "frictionloss"),
}
"""Flags that disable several kinds of force, and those kinds."""


def _expanded(
    values: MjcfValues, node: Element, folder: Path, reach: Reach, depth: int = 0
) -> None:
    """Replace each ``<include>`` by the contents of its file."""
    for i, child in reversed(list(enumerate(node))):
        if child.tag != "include":
            _expanded(values, child, folder, reach, depth)
            continue
        name = child.get("file", "")
        where = f"<include> {shortened(name)!r}"
        values.check_include(depth, where)
        with naming(file=values.file, element=where):
            path = reach.find(name, folder, "included file")
        text = read_text(path)
        values.count_included(text, where)
        root = parse_xml(text, str(path))
        _expanded(values, root, folder, reach, depth + 1)
        node.remove(child)
        for k, inner in enumerate(root):
            node.insert(i + k, inner)


def _compiler(values: MjcfValues, node: Element) -> None:
    """Read a ``<compiler>``."""
    given, compiler = values.own(node, "<compiler>"), values.compiler
    for key in ("usethread", "fusestatic", "discardvisual"):
        given.flag(key)
    if "angle" in given:
        compiler.degrees = given.choice("angle", ("degree", "radian")) == "degree"
    if given.choice("coordinate", ("local", "global")) == "global":
        raise given.fault(
            'coordinate="global" was removed from MuJoCo itself',
            "Convert it: load and save it in MuJoCo 2.3.3 or older",
        )
    compiler.sequence = given.text("eulerseq", compiler.sequence)
    if len(compiler.sequence) != 3 or not set(compiler.sequence) <= set("xyzXYZ"):
        raise given.fault(f"eulerseq is {compiler.sequence!r}", "Write three of xyzXYZ")
    compiler.autolimits = given.flag("autolimits", compiler.autolimits)
    if "inertiafromgeom" in given:
        compiler.inertia_from_geom = given.choice("inertiafromgeom", ("auto", "true", "false"))
    compiler.balance_inertia = given.flag("balanceinertia", compiler.balance_inertia)
    compiler.bound_mass = given.number("boundmass", compiler.bound_mass)
    compiler.bound_inertia = given.number("boundinertia", compiler.bound_inertia)
    compiler.total_mass = given.number("settotalmass", compiler.total_mass)
    if "inertiagrouprange" in given:
        low, high = given.numbers("inertiagrouprange", 2)
        compiler.groups = (int(low), int(high))
    folder = given.text("assetdir", compiler.mesh_folder)
    compiler.mesh_folder = given.text("meshdir", folder)


def _option(values: MjcfValues, nodes: list[Element]) -> FloatArray:
    """Gravity (3,); kinds of force that are switched off go into ``values``."""
    gravity = GRAVITY
    for node in nodes:
        given = values.own(node, "<option>")
        values.children(node, "<option>", ("flag",), ())
        gravity = given.text("gravity", gravity)
        for key, (most, unit) in THIN.items():
            if given.number(key) > most:
                problem = f"the drag of a medium does not act, and its {key} is above {most} {unit}"
                raise given.fault(problem, f"Remove {key} if the drag is negligible")
            if given.number(key):
                values.remark(f"the drag of the medium ({key}) does not act", "<option>")
        for flag in node.findall("flag"):
            off = {key for key, word in flag.attrib.items() if word == "disable"}
            values.off |= off.union(*(INCLUDED.get(key, ()) for key in off))
    if "gravity" in values.off:
        gravity = "0 0 0"
    return values.numbers(gravity, 3, "<option>", "gravity")


def _assets(values: MjcfValues, tree: BodyReader, section: Element) -> None:
    """Mesh files and colours, by name."""
    for node in section:
        if node.tag not in ("mesh", "material"):
            continue
        given = values.resolved(node, "", f"<{node.tag}> {node.get('name', '')!r}")
        if node.tag == "material":
            if "rgba" in given:
                tree.colours[given.text("name")] = given.text("rgba")
        elif "file" in given:
            path = Path(values.compiler.mesh_folder) / given.text("file")
            scale = given.numbers("scale", 3, "1 1 1")
            inertia = given.choice("inertia", INERTIAS)
            origin = given.numbers("refpos", 3, "0 0 0")
            quaternion = given.numbers("refquat", 4, "1 0 0 0")
            turn = values.quaternion(quaternion, given.where, "refquat")
            name = given.text("name") or path.stem
            tree.meshes[name] = mesh = Mesh(path.as_posix(), scale, inertia, origin, turn)
            if not mesh.is_similar:
                what = "a mesh with refquat and an unequal scale is drawn unturned"
                values.remark(what, given.where)


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
    values.attributes(root, "<mujoco>", ("model",))
    _expanded(values, root, Path(file).parent, options.reach)
    with naming(file=file):
        check_tree(root)
    if options.cut:
        raise values.fault(
            "cut", "the joints of an MJCF file are a tree: nothing is to be cut", "Remove cut"
        )
    if root.find("deformable") is not None:
        raise values.fault("<deformable>", "deformable bodies are not read", "Remove it")
    values.children(root, "<mujoco>", SECTIONS, IGNORED_SECTIONS, SECTIONS)
    for node in root.findall("compiler"):
        _compiler(values, node)
    for node in root.findall("default"):
        values.read_defaults(node)
    gravity = _option(values, root.findall("option"))
    tree = BodyReader(values, options.reach)
    for node in root.findall("asset"):
        _assets(values, tree, node)
    for node in root.findall("worldbody"):
        tree.world(node)
    if not tree.bodies:
        raise values.fault("<worldbody>", "there is no <body>", "Add one for every body")
    tree.rescale()
    tree.add_rotors()
    tree.resolve_springdampers()
    closures = EqualityReader(values, tree, root.findall("tendon"))
    for node in root.findall("equality"):
        closures.equality(node)
    closures.springs()
    for tag, why in (
        ("contact", "contact between bodies does not act"),
        ("actuator", "actuators give no force"),
    ):
        count = sum(len(node) for node in root.findall(tag))
        if count:
            values.remark(why, f"{count} element(s) of <{tag}> ignored")
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
    keyframes = KeyframeReader(values, tree, root.findall("keyframe"))
    start = keyframes.start(options.keyframe, bool(closures.loops), joints)
    if closures.held:
        start["q"] = start.get("q", {}) | closures.held
    return made.extended(
        values.notes(),
        gravity=gravity.tolist(),
        loop=closures.loops,
        force=[*tree.forces, *closures.forces],
        gravity_compensation=tree.compensated,
        lock=closures.lock,
        initial=start,
    )
