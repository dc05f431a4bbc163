"""SDF (``http://sdformat.org``) to a URDF tree and closures.

Models are read with their links, joints, frames and nested or included models.  The joints of a
file form a graph; :mod:`srm_mbs.formats.graph.joint_graph` chooses those that are cut.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from xml.etree.ElementTree import Element

import pinocchio as pin

from srm_mbs.errors import InputError
from srm_mbs.formats.document import Document
from srm_mbs.formats.graph.joint_graph import Body, Joint
from srm_mbs.formats.graph.spanning_tree_to_urdf import GraphTranslator
from srm_mbs.formats.sdf.joints import JointReader
from srm_mbs.formats.sdf.links import (
    MODEL,
    RESERVED,
    SEPARATOR,
    Frames,
    PlaceOf,
    joint_frame,
    pose,
    read_link,
)
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.xml import XmlValues, parse_xml
from srm_mbs.model.anchors import WORLD

OLDEST, NEWEST = (1, 3), (1, 12)
MODEL_READ = ("pose", "link", "joint", "frame", "model", "include", "static")
MODEL_IGNORED = (
    "self_collide",
    "allow_auto_disable",
    "enable_wind",
    "plugin",
    "gripper",
)
WORLD_READ = ("model", "include", "frame", "joint", "gravity")
WORLD_IGNORED = (
    "light",
    "physics",
    "scene",
    "plugin",
    "gui",
    "wind",
    "atmosphere",
    "spherical_coordinates",
    "magnetic_field",
    "audio",
    "road",
)
MANY = ("link", "joint", "frame", "model", "include")
GRAVITY = "0 0 -9.8"
"""SDF's default in a ``<world>``."""
LARGEST_INCLUDE_DEPTH = 20
"""Largest number of files that include each other."""


@dataclass(frozen=True)
class _Scope:
    """Context of an element: prefix of its names, its file, and that file's version."""

    prefix: str
    file: str
    version: tuple[int, int]
    depth: int = 0

    def inside(self, name: str) -> _Scope:
        return _Scope(f"{self.prefix}{name}{SEPARATOR}", self.file, self.version, self.depth)


class SdfReader:
    """Collects links, joints and frames of one file and those it includes."""

    def __init__(self, file: str) -> None:
        self.values = XmlValues(file)
        self.frames = Frames(file)
        self.bodies: dict[str, Body] = {}
        self.fixed: list[str] = []
        self._has_model = True  # and not a world with several
        self.reader = JointReader(self.values, self.frames)
        self._joint_nodes: list[tuple[Element, _Scope]] = []

    def place(self, node: Element, where: str, scope: _Scope) -> tuple[pin.SE3, str]:
        """The ``<pose>`` of an element, and the name of the frame that it names."""
        child = node.find("pose")
        if child is None:
            return pin.SE3.Identity(), ""
        older = scope.version < (1, 7)
        known = ("frame",) if older else ("relative_to", "degrees", "rotation_format")
        self.values.attributes(child, where, known)
        degrees = child.get("degrees")
        form = child.get("rotation_format", "euler_rpy")
        if form not in ("euler_rpy", "quat_xyzw"):
            raise self.values.fault(
                where, f"there is no rotation_format {form!r}", "Known: euler_rpy, quat_xyzw"
            )
        in_degrees = degrees is not None and self.values.truth(degrees, where, "degrees")
        placement = pose(self.values, child.text, where, in_degrees, form == "quat_xyzw")
        return placement, child.get("frame" if older else "relative_to", "").strip()

    def own_place(self, scope: _Scope) -> PlaceOf:
        """A reader of poses that are relative to the enclosing element only."""

        def place_of(node: Element, where: str) -> pin.SE3:
            placement, relative_to = self.place(node, where, scope)
            if relative_to:
                raise self.values.fault(
                    where,
                    f"the pose inside a link is relative to {relative_to!r}",
                    "Give it relative to the link",
                )
            return placement

        return place_of

    def name(self, node: Element, scope: _Scope) -> str:
        """Full name of an element."""
        name = (node.get("name") or "").strip()
        if not name or name in RESERVED or SEPARATOR in name:
            problem = f"the name {name!r} is reserved" if name else "it has no name"
            raise self.values.fault(f"<{node.tag}>", problem, f"Give the {node.tag} a name")
        return scope.prefix + name

    # Models ---------------------------------------------------------------------------------

    def model(
        self, node: Element, scope: _Scope, around: str, placed: pin.SE3 | None = None
    ) -> str:
        """Read a model whose names begin with ``scope.prefix``; returns its canonical link.

        ``around`` is the prefix of the enclosing model; ``placed`` the pose of an ``<include>``.
        """
        where = f"model {scope.prefix.removesuffix(SEPARATOR) or node.get('name', '')!r}"
        values = self.values
        values.attributes(node, where, ("name", "canonical_link"))
        if node.get("placement_frame"):
            raise values.fault(where, "placement_frame is not read by this version", "Remove it")
        values.children(node, where, MODEL_READ, MODEL_IGNORED, MANY)
        placement, relative_to = self.place(node, where, scope)
        if placed is not None:
            placement, relative_to = placed, ""
        reference = f"{around}{relative_to}" if relative_to not in ("", WORLD) else ""
        if not reference:
            nested = around or (scope.prefix and self._has_model)
            reference = f"{around}{MODEL}" if nested else WORLD
        links = [self.link(link, scope) for link in node.findall("link")]
        nested_links = [self.nested(child, scope) for child in node.findall("model")]
        nested_links += [self.include(child, scope) for child in node.findall("include")]
        for frame in node.findall("frame"):
            self.frame(frame, scope)
        for joint in node.findall("joint"):
            self.joint_frame(joint, scope)
        if not links and not nested_links:
            raise values.fault(where, "there is no <link>", "Add one for every body")
        canonical = (links + nested_links)[0]
        chosen = node.get("canonical_link")
        if chosen:
            canonical = f"{scope.prefix}{chosen}"
            if canonical not in self.bodies:
                raise values.fault(
                    where, f"there is no link {chosen!r} (canonical_link)", "Name one of its links"
                )
        self.frames.add(f"{scope.prefix}{MODEL}", reference, placement, where, body=canonical)
        static = node.find("static")
        if static is not None and values.truth(static.text, where, "<static>"):
            self.fixed += [link for link in self.bodies if link.startswith(scope.prefix)]
        return canonical

    def nested(self, node: Element, scope: _Scope) -> str:
        """A model inside a model; outside, its name means its own frame."""
        name = self.name(node, scope)
        inner = _Scope(name + SEPARATOR, scope.file, scope.version, scope.depth)
        canonical = self.model(node, inner, scope.prefix)
        own = f"{inner.prefix}{MODEL}"
        self.frames.add(name, own, pin.SE3.Identity(), f"model {name!r}", body=canonical)
        return canonical

    def link(self, node: Element, scope: _Scope) -> str:
        name = self.name(node, scope)
        where = f"link {name!r}"
        placement, relative_to = self.place(node, where, scope)
        reference = scope.prefix + (relative_to or MODEL)
        self.frames.add(name, reference, placement, where, body=name)
        self.bodies[name] = read_link(self.values, node, name, self.own_place(scope))
        return name

    def frame(self, node: Element, scope: _Scope) -> None:
        name = self.name(node, scope)
        where = f"frame {name!r}"
        self.values.attributes(node, where, ("name", "attached_to"))
        self.values.children(node, where, ("pose",), ())
        placement, relative_to = self.place(node, where, scope)
        outside = MODEL if scope.prefix or self._has_model else WORLD
        attached = node.get("attached_to") or outside
        to, held = (
            WORLD if other == WORLD else scope.prefix + other
            for other in (relative_to or attached, attached)
        )
        self.frames.add(name, to, placement, where, attached_to=held)

    def joint_frame(self, node: Element, scope: _Scope) -> None:
        """Place a joint's frame; the joint is read when all frames are known."""
        name = self.name(node, scope)
        where = f"joint {name!r}"
        placement, relative_to = self.place(node, where, scope)
        child = (node.findtext("child") or "").strip()
        reference = relative_to or child
        full = WORLD if reference == WORLD else scope.prefix + reference
        held = WORLD if child == WORLD else scope.prefix + child
        own = joint_frame(name, scope.version)
        self.frames.add(own, full, placement, where, attached_to=held)
        self._joint_nodes.append((node, scope))

    def include(self, node: Element, scope: _Scope) -> str:
        """A model in another file, beside this one."""
        uri = (node.findtext("uri") or "").strip()
        where = f"<include> {uri!r}"
        values = self.values
        values.attributes(node, where, ("merge",))
        values.children(node, where, ("uri", "name", "pose", "static"), ("plugin",))
        for what in ("merge", "placement_frame"):
            if node.get(what) is not None or node.find(what) is not None:
                raise values.fault(where, f"{what} is not read by this version", "Remove it")
        if scope.depth >= LARGEST_INCLUDE_DEPTH:
            raise values.fault(
                where, f"more than {LARGEST_INCLUDE_DEPTH} files include each other", "Break it"
            )
        path, text = self._included(uri, scope.file, where)
        root = self.checked(parse_xml(text, str(path)), str(path))
        model = root.find("model")
        if model is None:
            raise values.fault(where, f"{str(path)!r} holds no <model>", "Include a model")
        given = (node.findtext("name") or "").strip() or model.get("name", "")
        node.set("name", given)
        name = self.name(node, scope)
        version = self.version(root, str(path))
        inner = _Scope(name + SEPARATOR, str(path), version, scope.depth + 1)
        placed = None
        if node.find("pose") is not None:
            placed, relative_to = self.place(node, where, scope)
            if relative_to:
                raise values.fault(
                    where, "its pose is relative to another frame", "Give it in the model's frame"
                )
        if node.find("static") is not None and model.find("static") is None:
            model.append(node.find("static"))  # type: ignore[arg-type]
        canonical = self.model(model, inner, scope.prefix, placed)
        own = f"{inner.prefix}{MODEL}"
        self.frames.add(name, own, pin.SE3.Identity(), where, body=canonical)
        return canonical

    def _included(self, uri: str, file: str, where: str) -> tuple[Path, str]:
        """Path and text of an included file; a folder means the model in it."""
        parts = urlsplit(uri)
        if parts.scheme not in ("", "model", "file") or not uri:
            raise self.values.fault(
                where, "files are read from this machine only", "Put the model beside the file"
            )
        folder = Path(file).parent
        below = unquote(f"{parts.netloc}{parts.path}")
        tried = [folder / below]
        if parts.scheme == "model":
            tried += [above / below for above in folder.absolute().parents]
        for path in tried:
            try:
                if path.is_dir():
                    path = _of_folder(path)
                if path.is_file():
                    return path, path.read_text(encoding="utf-8-sig")
            except (OSError, ValueError):
                continue
        raise self.values.fault(
            where,
            "there is no such model beside the file or in the folders above it",
            "Put it there, or write the path",
        )

    # Files ----------------------------------------------------------------------------------

    def checked(self, root: Element, file: str) -> Element:
        """The root element of an SDF file."""
        self.values.check_depth(root)
        if root.tag != "sdf":
            raise InputError(
                f"the root element is <{root.tag}>, not <sdf>", file=file, remedy="Give an SDF file"
            )
        return root

    def version(self, root: Element, file: str) -> tuple[int, int]:
        """Major and minor version of an SDF file."""
        text = root.get("version", "")
        match = re.fullmatch(r"([0-9]{1,3})\.([0-9]{1,3})", text)
        found = (int(match[1]), int(match[2])) if match else (0, 0)
        if not OLDEST <= found <= NEWEST:
            raise InputError(
                f"SDF version {text!r} is not read",
                file=file,
                element="<sdf>",
                remedy=f"Known: {OLDEST[0]}.{OLDEST[1]} to {NEWEST[0]}.{NEWEST[1]}",
            )
        return found

    def read(self, root: Element) -> tuple[str, str, dict[str, Any]]:
        """Read the whole file: its name, the root link, and entries that are no loops."""
        file = self.values.file
        self.checked(root, file)
        version = self.version(root, file)
        self.values.attributes(root, "<sdf>", ("version",))
        self.values.children(root, "<sdf>", ("model", "world"), ("actor", "light"))
        model, world = root.find("model"), root.find("world")
        scope = _Scope("", file, version)
        entries: dict[str, Any] = {}
        if model is not None and world is None:
            canonical = self.model(model, scope, "")
            name = self.name(model, scope)
        elif world is not None and model is None:
            canonical, entries = self.world(world, scope)
            name = world.get("name", "")
        else:
            raise self.values.fault("<sdf>", "a file holds one <model> or one <world>", "Give one")
        for node, where in self._joint_nodes:
            self.reader.read(node, where.prefix, where.version)
        return name, canonical, entries

    def world(self, node: Element, scope: _Scope) -> tuple[str, dict[str, Any]]:
        """A world with models, whose names are prefixes of those of their links."""
        self.values.children(node, "<world>", WORLD_READ, WORLD_IGNORED, MANY)
        self._has_model = False
        models = [self.nested(model, scope) for model in node.findall("model")]
        models += [self.include(model, scope) for model in node.findall("include")]
        if not models:
            raise self.values.fault("<world>", "there is no <model>", "Add one")
        for frame in node.findall("frame"):
            self.frame(frame, scope)
        for joint in node.findall("joint"):
            self.joint_frame(joint, scope)
        gravity = node.findtext("gravity", GRAVITY)
        numbers = self.values.numbers(gravity, 3, "<world>", "<gravity>")
        return models[0], {"gravity": numbers.tolist()}

    def static(self) -> None:
        """Fix the links of static models to the ground, and drop the joints between them."""
        if not self.fixed:
            return
        held = set(self.fixed)
        within = [j for j in self.reader.joints if {j.parent, j.child} <= held | {WORLD}]
        for joint in within:
            self.reader.joints.remove(joint)
            self.values.remark("joints of static models do not move", joint.name)
        self.reader.joints += [
            Joint(f"{link}::static", "fixed", WORLD, link, self.frames.placement(link, ""))
            for link in self.fixed
        ]


def _of_folder(folder: Path) -> Path:
    """The SDF file of a model's folder: the one that ``model.config`` names, or ``model.sdf``."""
    config = folder / "model.config"
    if config.is_file():
        found = re.findall(r"<sdf[^>]*>\s*([^<\s]+)\s*</sdf>", config.read_text(encoding="utf-8"))
        if found:
            return folder / str(found[-1])
    return folder / "model.sdf"


def translate(document: Document, options: Options) -> Translation:
    """Translate an SDF file.

    Parameters
    ----------
    document
        The file; its path is also where the files that it includes are searched.
    options
        The joints to cut; none: chosen by :mod:`srm_mbs.formats.graph.joint_graph`.

    Raises
    ------
    InputError
        Naming the file, the element and the remedy.
    """
    file = document.file
    reader = SdfReader(file)
    name, root, entries = reader.read(document.xml)
    couplings = reader.reader.couplings()
    reader.static()
    where = {link: reader.frames.placement(link, f"link {link!r}") for link in reader.bodies}
    bodies = {**reader.bodies, **reader.reader.between}
    translator = GraphTranslator(file, name, bodies, where, reader.reader.joints, root)
    made = translator.translate(options.cut)
    entries |= made.entries
    if couplings:
        entries["loop"] = [*entries.get("loop", ()), *couplings]
    return replace(made, entries=entries, notes=(*made.notes, *reader.values.notes()))
