"""MJCF (MuJoCo's XML, https://mujoco.readthedocs.io/en/stable/XMLreference.html) to a URDF tree
and closures.

The tree is read here and not by Pinocchio, whose reader keeps the first body of the world only,
drops ``<equality><joint>`` and activates what is inactive.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.formats.document import Document
from srm_mbs.formats.graph.spanning_tree_to_urdf import GraphTranslator
from srm_mbs.formats.mjcf.attributes import IGNORED_SECTIONS, SECTIONS, MjcfValues
from srm_mbs.formats.mjcf.bodies import BodyReader
from srm_mbs.formats.mjcf.equality import EqualityReader
from srm_mbs.formats.mjcf.geoms import Mesh
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.xml import parse_xml

GRAVITY = "0 0 -9.81"
LARGEST_INCLUDE_DEPTH = 20
"""Largest number of files that include each other."""
FORCES_OFF = ("passive", "spring", "damper", "frictionloss", "constraint")
"""Flags that would disable forces that this package applies."""


def _expanded(values: MjcfValues, node: Element, folder: Path, depth: int = 0) -> None:
    """Replace each ``<include>`` by the contents of its file."""
    for i, child in reversed(list(enumerate(node))):
        if child.tag != "include":
            _expanded(values, child, folder, depth)
            continue
        name = child.get("file", "")
        where = f"<include> {name!r}"
        if depth >= LARGEST_INCLUDE_DEPTH:
            raise values.fault(
                where, f"more than {LARGEST_INCLUDE_DEPTH} files include each other", "Break it"
            )
        try:
            text = (folder / name).read_text(encoding="utf-8-sig")
        except (OSError, ValueError) as error:
            raise values.fault(
                where,
                f"it cannot be read: {error}",
                "Check the path, which is relative to the model",
            ) from error
        root = parse_xml(text, str(folder / name))
        values.check_depth(root)
        _expanded(values, root, folder, depth + 1)
        node.remove(child)
        for k, inner in enumerate(root):
            node.insert(i + k, inner)


def _compiler(values: MjcfValues, node: Element) -> None:
    """Read a ``<compiler>``."""
    where, compiler = "<compiler>", values.compiler
    values.known(node, where)
    for key in ("usethread", "fusestatic", "discardvisual"):
        if key in node.attrib:
            values.truth(node.get(key), where, key)
    given = node.attrib
    if "angle" in given:
        compiler.degrees = values.choice(given, "angle", ("degree", "radian"), where) == "degree"
    values.choice(given, "coordinate", ("local",), where)
    compiler.sequence = given.get("eulerseq", compiler.sequence)
    if len(compiler.sequence) != 3 or not set(compiler.sequence) <= set("xyzXYZ"):
        raise values.fault(where, f"eulerseq is {compiler.sequence!r}", "Write three of xyzXYZ")
    compiler.autolimits = values.flag(given, "autolimits", compiler.autolimits, where)
    if "inertiafromgeom" in given:
        known = ("auto", "true", "false")
        compiler.inertia_from_geom = values.choice(given, "inertiafromgeom", known, where)
    if values.flag(given, "balanceinertia", False, where):
        raise values.fault(where, "balanceinertia is not read by this version", "Remove it")
    for key, name in (
        ("boundmass", "bound_mass"),
        ("boundinertia", "bound_inertia"),
        ("settotalmass", "total_mass"),
    ):
        setattr(compiler, name, values.number(given, key, getattr(compiler, name), where))
    if "inertiagrouprange" in given:
        low, high = values.get(given, "inertiagrouprange", 2, "", where)
        compiler.groups = (int(low), int(high))
    folder = given.get("meshdir", given.get("assetdir", compiler.mesh_folder))
    compiler.mesh_folder = folder


def _option(values: MjcfValues, nodes: list[Element]) -> tuple[list[float], bool]:
    """Gravity, and whether equality constraints are switched off."""
    gravity, disabled = GRAVITY, False
    for node in nodes:
        values.known(node, "<option>")
        values.children(node, "<option>", ("flag",), ())
        gravity = node.get("gravity", gravity)
        for key in ("density", "viscosity"):
            if values.number(node.attrib, key, 0.0, "<option>") != 0.0:
                raise values.fault("<option>", f"the {key} of a medium is not read", "Remove it")
        for flag in node.findall("flag"):
            for key, word in flag.attrib.items():
                off = word == "disable"
                if key in FORCES_OFF and off:
                    raise values.fault(
                        "<option>", f'<flag {key}="disable"> is not read', "Remove what is disabled"
                    )
                if key == "gravity" and off:
                    gravity = "0 0 0"
                disabled |= key == "equality" and off
    return values.numbers(gravity, 3, "<option>", "gravity").tolist(), disabled


def _assets(values: MjcfValues, tree: BodyReader, section: Element) -> None:
    """Mesh files and colours, by name."""
    for node in section:
        if node.tag not in ("mesh", "material"):
            continue
        where = f"<{node.tag}> {node.get('name', '')!r}"
        given = values.resolved(node, "", where)
        if node.tag == "material":
            if "rgba" in given:
                tree.colours[given.get("name", "")] = given["rgba"]
        elif "file" in given:
            path = Path(values.compiler.mesh_folder) / given["file"]
            scale = values.get(given, "scale", 3, "1 1 1", where)
            moved = "refpos" in given or "refquat" in given
            inertia = "" if moved else given.get("inertia", "legacy")
            name = given.get("name") or path.stem
            axes = _mesh_axes(values, given, scale, where)
            tree.meshes[name] = Mesh(path.as_posix(), scale, inertia, axes)


def _mesh_axes(values: MjcfValues, given: dict[str, str], scale: FloatArray, where: str) -> pin.SE3:
    """Placement of the axes of a mesh file in those of the mesh.

    MuJoCo makes S R^T (x - p) of a vertex x, with the scale S, ``refpos`` p and ``refquat`` R.
    """
    p = values.get(given, "refpos", 3, "0 0 0", where)
    turned = values.get(given, "refquat", 4, "1 0 0 0", where)
    w, x, y, z = values.direction(turned, where, "refquat")
    R = pin.Quaternion(w, x, y, z).matrix()
    if np.ptp(scale) > 0.0 and not np.allclose(R, np.eye(3)):
        values.remark("a mesh with refquat and an unequal scale is drawn unturned", where)
        R = np.eye(3)
    return pin.SE3(R.T, -scale * (R.T @ p))


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
    values.check_depth(root)
    _expanded(values, root, Path(file).parent)
    values.check_depth(root)
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
    gravity, disabled = _option(values, root.findall("option"))
    tree = BodyReader(values)
    for node in root.findall("asset"):
        _assets(values, tree, node)
    worlds = root.findall("worldbody")
    for node in worlds:
        tree.world(node)
    if not tree.bodies:
        raise values.fault("<worldbody>", "there is no <body>", "Add one for every body")
    tree.rescale()
    closures = EqualityReader(values, tree)
    for node in root.findall("equality"):
        closures.equality(node, disabled)
    for node in root.findall("tendon"):
        closures.tendons(node)
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
    entries: dict[str, Any] = {"gravity": gravity, **made.entries}
    _add(entries, "loop", closures.loops)
    _add(entries, "force", [*tree.forces, *closures.forces])
    _add(entries, "lock", closures.lock)
    if closures.held:
        entries["initial"] = {"q": closures.held}
    return replace(made, entries=entries, notes=(*made.notes, *values.notes()))


def _add(entries: dict[str, Any], key: str, more: list[Any]) -> None:
    if more:
        entries[key] = [*entries.get(key, ()), *more]
