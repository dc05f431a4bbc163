"""SDF (``http://sdformat.org``) to a URDF tree and closures.

Models are read with their links, joints, frames and nested or included models.  The joints of a
file form a graph; :mod:`srm_mbs.formats.graph.joint_graph` chooses those that are cut.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import pinocchio as pin

from srm_mbs.errors import InputError, naming
from srm_mbs.formats.document import Document
from srm_mbs.formats.files import read_text, shortened
from srm_mbs.formats.graph.joint_graph import Body, Joint
from srm_mbs.formats.graph.spanning_tree_to_urdf import GraphTranslator
from srm_mbs.formats.sdf.joints import JointReader
from srm_mbs.formats.sdf.links import (
    MODEL,
    RESERVED,
    SEPARATOR,
    Frames,
    LinkReader,
    Scope,
    joint_frame,
    pose,
)
from srm_mbs.formats.translation import Options, Translation
from srm_mbs.formats.xml import XmlValues, parse_xml, words
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.reach import Reach

OLDEST, NEWEST = (1, 3), (1, 12)
MODEL_READ = ("pose", "link", "joint", "frame", "model", "include", "static")
MODEL_IGNORED = ("self_collide", "allow_auto_disable", "enable_wind", "plugin", "gripper")
WORLD_READ = ("model", "include", "frame", "joint", "gravity")
WORLD_IGNORED = words(
    "light physics scene plugin gui wind atmosphere spherical_coordinates magnetic_field audio road"
)
MANY = ("link", "joint", "frame", "model", "include")
GRAVITY = "0 0 -9.8"
"""SDF's default in a ``<world>``."""


class SdfReader:
    """Collects links, joints and frames of one file and those it includes."""

    def __init__(self, file: str, reach: Reach) -> None:
        self.reach = reach
        self.values = XmlValues(file)
        self.frames = Frames(self.values)
        self.bodies: dict[str, Body] = {}
        self.fixed: list[str] = []
        self._has_model = True  # and not a world with several
        self.links = LinkReader(self.values, self.frames, reach)
        self.joints = JointReader(self.values, self.frames)
        self._link_nodes: list[tuple[Element, str, Scope]] = []
        self._joint_nodes: list[tuple[Element, Scope]] = []

    def name(self, node: Element, scope: Scope) -> str:
        """Full name of an element."""
        name = (node.get("name") or "").strip()
        if not name or name in RESERVED:
            problem = f"the name {name!r} is reserved" if name else "it has no name"
            raise self.values.fault(f"<{node.tag}>", problem, f"Give the {node.tag} a name")
        return scope.prefix + name

    # Models ---------------------------------------------------------------------------------

    def model(
        self,
        node: Element,
        scope: Scope,
        outer: Scope | None = None,
        placed: tuple[pin.SE3, str] | None = None,
    ) -> str:
        """Read a model whose names begin with ``scope.prefix``; returns its canonical link.

        ``outer`` is the context of an enclosing model or world; ``placed`` the pose of an
        ``<include>`` and the frame that it names.
        """
        where = f"model {scope.prefix.removesuffix(SEPARATOR) or node.get('name', '')!r}"
        values = self.values
        values.attributes(node, where, ("name", "canonical_link", "placement_frame"))
        values.children(node, where, MODEL_READ, MODEL_IGNORED, MANY)
        placement, relative_to = pose(values, node, where, scope)
        if placed is not None:
            placement, relative_to = placed
        reference = WORLD
        if outer is not None:
            around = relative_to not in ("", WORLD)
            reference = outer.full(relative_to) if around else self.frame_around(outer)
        before = len(self.bodies)
        links = self.contents(node, scope)
        if not links:
            raise values.fault(where, "there is no <link>", "Add one for every body")
        canonical = links[0]
        chosen = node.get("canonical_link")
        if chosen:
            canonical = f"{scope.prefix}{chosen}"
            if canonical not in self.bodies:
                problem = f"there is no link {chosen!r} (canonical_link)"
                raise values.fault(where, problem, "Name one of its links")
        own = scope.full(MODEL)
        posed = node.get("placement_frame")
        if posed:  # the pose is that of this frame
            placement = placement * self.frames.within(own, scope.full(posed), where).inverse()
        self.frames.add(own, reference, placement, where, body=canonical)
        if outer is not None and scope.prefix != outer.prefix:
            # Outside, the name of a model means its own frame.
            name = scope.prefix.removesuffix(SEPARATOR)
            self.frames.add(name, own, pin.SE3.Identity(), where, body=canonical)
        if values.child_truth(node, "static", where, False):
            self.fixed += list(self.bodies)[before:]
        return canonical

    def frame_around(self, scope: Scope) -> str:
        """The frame in which what has no other reference is placed: the model's, or the world."""
        in_model = scope.prefix or self._has_model or scope.own != MODEL
        return scope.full(MODEL) if in_model else WORLD

    def contents(self, node: Element, scope: Scope) -> list[str]:
        """Read the contents of a model or world; returns its links and the canonical links of its
        models, own and merged ones first."""
        canonical, merged = [], [part for part in node.findall("include") if self._merges(part)]
        for part in node:
            if part.tag == "link" and self._is_ground(part, scope):
                continue
            if part.tag == "link":
                canonical.append(self.link(part, scope))
            elif part in merged:
                canonical.append(self.include(part, scope))
        for model in node.findall("model"):
            inner = Scope(
                self.name(model, scope) + SEPARATOR, scope.file, scope.version, scope.depth
            )
            canonical.append(self.model(model, inner, scope))
        others = [part for part in node.findall("include") if part not in merged]
        canonical += [self.include(part, scope) for part in others]
        for frame in node.findall("frame"):
            self.frame(frame, scope)
        for joint in node.findall("joint"):
            self.joint_frame(joint, scope)
        return canonical

    def _is_ground(self, node: Element, scope: Scope) -> bool:
        """Whether a link stands for the ground: it has its name, and no inertia.

        For Gazebo the joints of such a link are on the ground, and for Bullet the link is static.
        """
        if (node.get("name") or "").strip() != WORLD or node.find("inertial") is not None:
            return False
        model = scope.prefix.removesuffix(SEPARATOR) or "the file"
        self.values.remark("a link called 'world' without <inertial> is the ground", model)
        return True

    def link(self, node: Element, scope: Scope) -> str:
        name = self.name(node, scope)
        where = f"link {name!r}"
        placement, relative_to = pose(self.values, node, where, scope)
        self.frames.add(name, scope.full(relative_to or MODEL), placement, where, body=name)
        self.bodies[name] = Body(name)
        self._link_nodes.append((node, name, scope))
        return name

    def frame(self, node: Element, scope: Scope) -> None:
        name = self.name(node, scope)
        where = f"frame {name!r}"
        self.values.attributes(node, where, ("name", "attached_to"))
        self.values.children(node, where, ("pose",), ())
        placement, relative_to = pose(self.values, node, where, scope)
        held = node.get("attached_to")
        attached_to = scope.full(held) if held else self.frame_around(scope)
        to = scope.full(relative_to) if relative_to else attached_to
        self.frames.add(name, to, placement, where, attached_to=attached_to)

    def joint_frame(self, node: Element, scope: Scope) -> None:
        """Place a joint's frame; the joint is read when all frames are known."""
        name = self.name(node, scope)
        where = f"joint {name!r}"
        placement, relative_to = pose(self.values, node, where, scope)
        child = (node.findtext("child") or "").strip()
        to, held = scope.full(relative_to or child), scope.full(child)
        own = joint_frame(name, scope.version)
        self.frames.add(own, to, placement, where, attached_to=held)
        self._joint_nodes.append((node, scope))

    def _merges(self, node: Element) -> bool:
        """Whether the contents of an included model become those of the model around it."""
        return self.values.truth(node.get("merge", "false"), "<include>", "merge")

    def include(self, node: Element, scope: Scope) -> str:
        """A model in another file, beside this one."""
        uri = (node.findtext("uri") or "").strip()
        where = f"<include> {shortened(uri)!r}"
        values = self.values
        values.attributes(node, where, ("merge",))
        known = ("uri", "name", "pose", "static", "placement_frame")
        values.children(node, where, known, ("plugin",))
        values.check_include(scope.depth, where)
        path = self._included(uri, scope.file, where)
        included = Document(read_text(path), str(path))
        values.count_included(included.text, where)
        root = included.xml
        for note in included.notes:
            values.remark(note, where)
        version = self.version(root, str(path))
        model = root.find("model")
        if model is None:
            raise values.fault(where, f"{str(path)!r} holds no <model>", "Include a model")
        node.set("name", (node.findtext("name") or "").strip() or model.get("name", ""))
        name = self.name(node, scope)
        placed = None if node.find("pose") is None else pose(values, node, where, scope)
        if node.find("placement_frame") is not None:
            model.set("placement_frame", (node.findtext("placement_frame") or "").strip())
        static = node.find("static")
        if static is not None and model.find("static") is None:
            model.append(static)
        inner = Scope(name + SEPARATOR, str(path), version, scope.depth + 1)
        if self._merges(node):
            local = name.removeprefix(scope.prefix)
            inner = replace(inner, prefix=scope.prefix, own=f"_merged__{local}__model__")
        return self.model(model, inner, scope, placed)

    def _included(self, uri: str, file: str, where: str) -> Path:
        """Path of an included file; a folder means the model in it."""
        if uri.partition("://")[0] not in ("model", "file", uri) or not uri:
            raise self.values.fault(
                where, "files are read from this machine only", "Put the model beside the file"
            )
        with naming(file=self.values.file, element=where):
            return self.reach.find(uri, Path(file).parent, "included model", self._of_folder)

    def _of_folder(self, folder: Path) -> Path:
        """The SDF file of a model's folder: that of ``model.config``, or ``model.sdf``."""
        config = folder / "model.config"
        if config.is_file():
            root = parse_xml(read_text(self.reach.check(config, "file")), str(config))
            found = [(node.text or "").strip() for node in root.iter("sdf")]
            if found and found[-1]:
                return folder / found[-1]
        return folder / "model.sdf"

    # Files ----------------------------------------------------------------------------------

    def version(self, root: Element, file: str) -> tuple[int, int]:
        """Major and minor version of an SDF file with this root element."""
        if root.tag != "sdf":
            raise InputError(
                f"the root element is <{root.tag}>, not <sdf>", file=file, remedy="Give an SDF file"
            )
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

    def read(self, root: Element) -> tuple[str, str, list[float]]:
        """Read the whole file: its name, the root link, and gravity, empty in a file of a model."""
        values = self.values
        scope = Scope("", values.file, self.version(root, values.file))
        values.attributes(root, "<sdf>", ("version",))
        values.children(root, "<sdf>", ("model", "world"), ("actor", "light"))
        model, world = root.find("model"), root.find("world")
        gravity: list[float] = []
        if model is not None and world is None:
            canonical = self.model(model, scope)
            name = self.name(model, scope)
        elif world is not None and model is None:
            # Names of its models are prefixes of those of their links.
            values.children(world, "<world>", WORLD_READ, WORLD_IGNORED, MANY)
            self._has_model = False
            name, models = world.get("name", ""), self.contents(world, scope)
            if not models:
                raise values.fault("<world>", "there is no <model>", "Add one")
            canonical = models[0]
            text = world.findtext("gravity", GRAVITY)
            gravity = values.numbers(text, 3, "<world>", "<gravity>").tolist()
        else:
            raise values.fault("<sdf>", "a file holds one <model> or one <world>", "Give one")
        for node, link, inside in self._link_nodes:
            self.bodies[link] = self.links.read(node, link, inside)
        for node, inside in self._joint_nodes:
            self.joints.read(node, inside)
        return name, canonical, gravity

    def static(self) -> None:
        """Fix the links of static models to the ground, and drop the joints between them."""
        if not self.fixed:
            return
        held = set(self.fixed)
        within = [j for j in self.joints.joints if {j.parent, j.child} <= held | {WORLD}]
        for joint in within:
            self.joints.joints.remove(joint)
            self.values.remark("joints of static models do not move", joint.name)
        self.joints.joints += [
            Joint(f"{link}::static", "fixed", WORLD, link, self.frames.placement(link, ""))
            for link in self.fixed
        ]


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
    reader = SdfReader(document.file, options.reach)
    name, root, gravity = reader.read(document.xml)
    couplings = reader.joints.couplings()
    reader.static()
    where = {link: reader.frames.placement(link, f"link {link!r}") for link in reader.bodies}
    bodies = {**reader.bodies, **reader.joints.between}
    graph = GraphTranslator(document.file, name, bodies, where, reader.joints.joints, root)
    made = graph.translate(options.cut)
    return made.extended(
        reader.values.notes(),
        gravity=gravity,
        loop=couplings,
        gravity_compensation=dict.fromkeys(reader.links.weightless, 1.0),
    )
