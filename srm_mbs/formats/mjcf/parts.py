"""The files of an MJCF model: the main one, and those that ``<attach>`` puts into it.

Each file has compiler settings, default classes and assets of its own, and its meshes lie relative
to it.  The names of what is attached begin with a prefix; materials, meshes, constraints, tendons
and keyframes come with it.  As in MuJoCo the ``<option>`` of an attached file does not act.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

from srm_mbs.errors import naming
from srm_mbs.formats.files import read_text, shortened
from srm_mbs.formats.mjcf.attributes import IGNORED_SECTIONS, SECTIONS, Attributes, MjcfValues
from srm_mbs.formats.mjcf.geoms import INERTIAS, Mesh
from srm_mbs.formats.xml import check_tree, parse_xml, words
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.reach import Reach

MOST_ATTACHED = 20_000
"""Number of elements of all attached models, which load in some seconds."""
PREFIXED = words(
    "name body body1 body2 joint joint1 joint2 jointinparent site site1 site2 refsite cranksite "
    "slidersite tendon tendon1 tendon2 mesh material"
)
"""Attributes that hold names of the file, which get its prefix."""
IN_DEFAULTS = ("mesh", "material")
UNPREFIXED = ("attach", "model")
"""Elements whose names are those of files."""


@dataclass(frozen=True)
class AttachedFile:
    """A ``<model>`` among the assets: its elements, includes expanded, and where it lies."""

    root: Element
    path: Path


@dataclass(eq=False)
class Part:
    """A file as a part of the model.

    Attributes
    ----------
    values
        Its settings and default classes.
    root
        Its elements; its names begin with the prefix.
    meshes, colours, models
        Its assets by name, prefix included but for models.
    joints
        Which of the joints of the model, in MuJoCo's order, are its own.
    left_out
        Names of bodies, joints and sites of the file that are not attached.
    """

    values: MjcfValues
    root: Element
    meshes: dict[str, Mesh] = field(default_factory=dict)
    colours: dict[str, str] = field(default_factory=dict)
    models: dict[str, AttachedFile] = field(default_factory=dict)
    joints: slice = field(default_factory=lambda: slice(None))
    left_out: set[str] = field(default_factory=set)

    def contents(self) -> list[Element]:
        """The elements in the world of the file."""
        return [child for world in self.root.findall("worldbody") for child in world]

    def body(self, name: str) -> tuple[Element, str] | None:
        """The body of this name and the ``childclass`` around it; None if there is none."""
        return next(
            (found for found in _bodies(self.contents()) if found[0].get("name") == name), None
        )

    def attached(self, section: str) -> Iterator[Element]:
        """The sections of constraints, tendons or actuators, without what refers to something that
        is not attached."""
        for node in self.root.findall(section):
            for child in list(node):
                names = {
                    value
                    for inner in child.iter()
                    for key, value in inner.attrib.items()
                    if key in PREFIXED[1:]
                }
                if names & self.left_out:
                    what = "what refers to parts of a model that are not attached is left out"
                    self.values.remark(what, f"<{child.tag}> {child.get('name', '')!r}")
                    self.left_out |= {child.get("name", "")} - {""}
                    node.remove(child)
            yield node


def _bodies(nodes: list[Element], childclass: str = "") -> Iterator[tuple[Element, str]]:
    """Bodies among and inside ``nodes``, with the ``childclass`` around them."""
    for node in nodes:
        if node.tag == "body":
            yield node, childclass
        if node.tag in ("body", "frame"):
            yield from _bodies(list(node), node.get("childclass", childclass))


def main_part(values: MjcfValues, root: Element, reach: Reach) -> Part:
    """The main file.

    Raises
    ------
    InputError
        Naming the element that cannot be read.
    """
    values.attributes(root, "<mujoco>", ("model",))
    _expand(values, root, Path(values.file).parent, reach)
    with naming(file=values.file):
        check_tree(root)
    return _read(Part(values, root), reach, 0)


def attached_part(part: Part, given: Attributes, reach: Reach, depth: int) -> Part:
    """The file that an ``<attach>`` of ``part`` names, with its prefix.

    Parameters
    ----------
    given
        Attributes of the ``<attach>``.
    depth
        In how many attached files it is.
    """
    values, name = part.values, given.text("model")
    values.check_include(depth, given.where)
    if name not in part.models:
        raise values.unknown(given.where, f"there is no model {name!r}", part.models)
    if "prefix" not in given:
        raise given.fault("it has no prefix", 'Give prefix="..."')
    file = part.models[name]
    own = MjcfValues(str(file.path), values.prefix + given.text("prefix"), values.main)
    own.count_attached(sum(1 for _ in file.root.iter()), given.where, MOST_ATTACHED)
    root = deepcopy(file.root)
    _add_prefix(root, own.prefix)
    for option in root.findall("option"):
        if values.compiler.merges and (option.attrib or len(option)):
            problem = f'the <option> of {name!r} would be merged (compiler conflict="merge")'
            raise given.fault(problem, "Move it to the main file")
        values.remark("the <option> of an attached model does not act", given.where)
    return _read(Part(own, root), reach, depth + 1)


def _add_prefix(root: Element, prefix: str) -> None:
    for section in root:
        keys = IN_DEFAULTS if section.tag == "default" else PREFIXED
        for node in section.iter():
            if node.tag in UNPREFIXED:
                continue
            if section.tag == "asset" and node.tag == "mesh" and "file" in node.attrib:
                node.attrib.setdefault("name", Path(node.attrib["file"]).stem)
            for key in keys:
                value = node.get(key, WORLD)
                if value != WORLD:
                    node.set(key, prefix + value)


def _expand(values: MjcfValues, node: Element, folder: Path, reach: Reach, depth: int = 0) -> None:
    """Replace each ``<include>`` by the contents of its file."""
    for i, child in reversed(list(enumerate(node))):
        if child.tag != "include":
            _expand(values, child, folder, reach, depth)
            continue
        name = child.get("file", "")
        where = f"<include> {shortened(name)!r}"
        values.check_include(depth, where)
        with naming(file=values.file, element=where):
            path = reach.find(name, folder, "included file")
        text = read_text(path)
        values.count_included(text, where)
        root = parse_xml(text, str(path))
        _expand(values, root, folder, reach, depth + 1)
        node.remove(child)
        for k, inner in enumerate(root):
            node.insert(i + k, inner)


def _read(part: Part, reach: Reach, depth: int) -> Part:
    """``part`` with its settings, classes and assets."""
    values, root = part.values, part.root
    if root.find("deformable") is not None:
        raise values.fault("<deformable>", "deformable bodies are not read", "Remove it")
    values.children(root, "<mujoco>", SECTIONS, IGNORED_SECTIONS, SECTIONS)
    for node in root.findall("compiler"):
        _compiler(values, node)
    for node in root.findall("default"):
        values.read_defaults(node)
    for section in root.findall("asset"):
        for node in section:
            if node.tag == "model":
                _model(part, node, reach, depth)
            elif node.tag in ("mesh", "material"):
                _asset(part, node)
    return part


def _compiler(values: MjcfValues, node: Element) -> None:
    """Read a ``<compiler>``."""
    given, compiler = values.own(node, "<compiler>"), values.compiler
    for key in ("usethread", "fusestatic", "discardvisual"):
        given.flag(key)
    if "angle" in given:
        compiler.degrees = given.choice("angle", ("degree", "radian")) == "degree"
    if "coordinate" in given:
        compiler.in_world = given.choice("coordinate", ("local", "global")) == "global"
    compiler.sequence = given.text("eulerseq", compiler.sequence)
    if len(compiler.sequence) != 3 or not set(compiler.sequence) <= set("xyzXYZ"):
        raise given.fault(f"eulerseq is {compiler.sequence!r}", "Write three of xyzXYZ")
    compiler.autolimits = given.flag("autolimits", compiler.autolimits)
    if "inertiafromgeom" in given:
        compiler.inertia_from_geom = given.choice("inertiafromgeom", ("auto", "true", "false"))
    if "conflict" in given:
        compiler.merges = given.choice("conflict", ("warning", "merge", "error")) == "merge"
    compiler.balance_inertia = given.flag("balanceinertia", compiler.balance_inertia)
    compiler.bound_mass = given.number("boundmass", compiler.bound_mass)
    compiler.bound_inertia = given.number("boundinertia", compiler.bound_inertia)
    compiler.total_mass = given.number("settotalmass", compiler.total_mass)
    if "inertiagrouprange" in given:
        low, high = given.numbers("inertiagrouprange", 2)
        compiler.groups = (int(low), int(high))
    folder = given.text("assetdir", compiler.mesh_folder)
    compiler.mesh_folder = given.text("meshdir", folder)


def _model(part: Part, node: Element, reach: Reach, depth: int) -> None:
    """Read a file that may be attached."""
    values = part.values
    given = values.own(node, f"<model> {node.get('name', '')!r}")
    file = given.text("file")
    values.check_include(depth, given.where)
    with naming(file=values.file, element=given.where):
        path = reach.find(file, Path(values.file).parent, "model file")
    text = read_text(path)
    values.count_included(text, given.where)
    root = parse_xml(text, str(path))
    if root.tag != "mujoco":
        raise given.fault(
            f"the root element of {shortened(file)!r} is <{root.tag}>, not <mujoco>",
            "Give an MJCF file",
        )
    own = MjcfValues(str(path), "", values.main)
    own.attributes(root, "<mujoco>", ("model",))
    _expand(own, root, path.parent, reach)
    with naming(file=str(path)):
        check_tree(root)
    part.models[given.text("name") or root.get("model", "")] = AttachedFile(root, path)


def _asset(part: Part, node: Element) -> None:
    """Read a mesh file or a colour."""
    values = part.values
    given = values.resolved(node, "", f"<{node.tag}> {node.get('name', '')!r}")
    if node.tag == "material":
        if "rgba" in given:
            part.colours[given.text("name")] = given.text("rgba")
    elif "file" in given:
        path = values.relative(Path(values.compiler.mesh_folder) / given.text("file"))
        scale = given.numbers("scale", 3, "1 1 1")
        inertia = given.choice("inertia", INERTIAS)
        at = given.numbers("refpos", 3, "0 0 0")
        quaternion = given.numbers("refquat", 4, "1 0 0 0")
        turn = values.quaternion(quaternion, given.where, "refquat")
        name = given.text("name") or path.stem
        part.meshes[name] = mesh = Mesh(path.as_posix(), scale, inertia, at, turn)
        if not mesh.is_similar:
            what = "a mesh with refquat and an unequal scale is drawn unturned"
            values.remark(what, given.where)
