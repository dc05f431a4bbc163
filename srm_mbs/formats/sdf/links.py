"""Links of an SDF file with their inertias and visuals, and the frames that place them.

Names follow SDF 1.7 and later (``http://sdformat.org/tutorials?tut=pose_frame_semantics``): every
link, joint, frame and nested model is a frame of its model; ``a::b`` is the frame b of the nested
model a; ``__model__`` is a model's own frame.  Older files are a special case: they have no other
frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs.errors import InputError, naming
from srm_mbs.formats.graph.joint_graph import Body, inertia_at
from srm_mbs.formats.graph.spanning_tree_to_urdf import numbers, visual
from srm_mbs.formats.meshes import enclosed, read_mesh, solid
from srm_mbs.formats.xml import XmlValues, words
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.coordinates import UNIT_LENGTH_TOLERANCE
from srm_mbs.model.reach import Reach

MODEL = "__model__"
SEPARATOR = "::"
RESERVED = ("world", "__model__", "__root__")
FRAMES_SINCE = (1, 7)
"""The first version in which links, joints and models are frames."""
ROTATION_FORMATS = {"euler_rpy": 6, "quat_xyzw": 7}
"""Formats of a pose, and how many numbers each has."""


@dataclass(frozen=True)
class Scope:
    """Context of an element: prefix of its names, its file, and that file's version.

    Attributes
    ----------
    depth
        Number of includes around the file.
    own
        Name, without prefix, of the frame of the model; a model that is merged into another has
        one of its own.
    """

    prefix: str
    file: str
    version: tuple[int, int]
    depth: int = 0
    own: str = MODEL

    def full(self, name: str) -> str:
        """Full name of ``name`` in this context; ``world`` means the ground everywhere."""
        if name == WORLD:
            return WORLD
        return self.prefix + (self.own if name == MODEL else name)


def joint_frame(name: str, version: tuple[int, int]) -> str:
    """Name of a joint's frame; before SDF 1.7 nothing refers to it, and links may have its name."""
    return name if version >= FRAMES_SINCE else f"{name}{SEPARATOR}__joint__"


def pose(values: XmlValues, node: Element, where: str, scope: Scope) -> tuple[pin.SE3, str]:
    """The ``<pose>`` of an element, and the name of the frame that it names: x y z and roll pitch
    yaw, or x y z and a quaternion x y z w."""
    child = node.find("pose")
    if child is None:
        return pin.SE3.Identity(), ""
    older = scope.version < FRAMES_SINCE
    known = ("frame",) if older else ("relative_to", "degrees", "rotation_format")
    values.attributes(child, where, known)
    relative_to = child.get(known[0], "").strip()
    degrees = values.truth(child.get("degrees", "false"), where, "degrees")
    form = child.get("rotation_format", "euler_rpy")
    if form not in ROTATION_FORMATS:
        raise values.unknown(where, f"there is no rotation_format {form!r}", ROTATION_FORMATS)
    if not (child.text or "").strip():
        return pin.SE3.Identity(), relative_to
    found = values.numbers(child.text, ROTATION_FORMATS[form], where, "<pose>")
    xyz, turn = found[:3], found[3:]
    if form == "euler_rpy":
        R = pin.rpy.rpyToMatrix(np.deg2rad(turn) if degrees else turn)
    else:
        length = float(np.linalg.norm(turn))
        if abs(length - 1.0) > UNIT_LENGTH_TOLERANCE:
            problem = f"the quaternion of <pose> has length {length:.6g}"
            raise values.fault(where, problem, "Give a unit quaternion")
        R = pin.Quaternion(turn / length).matrix()
    return pin.SE3(R, xyz), relative_to


@dataclass
class _Frame:
    relative_to: str
    placement: pin.SE3
    where: str
    body: str | None
    attached_to: str


class Frames:
    """The frames of a file by full name; placed in any order, resolved on demand.

    Full names have the names of all nested models in front; the frame of the outermost model is
    ``__model__``.
    """

    def __init__(self, values: XmlValues) -> None:
        self.values = values
        self._frames: dict[str, _Frame] = {}
        self._found = {WORLD: pin.SE3.Identity()}

    def add(
        self,
        name: str,
        relative_to: str,
        placement: pin.SE3,
        where: str,
        *,
        body: str | None = None,
        attached_to: str = WORLD,
    ) -> None:
        """Place a frame; it is part of the link ``body``, by default of that of ``attached_to``."""
        if name in self._frames:
            problem = f"two links, joints, frames or models of one model are called {name!r}"
            raise self.values.fault(where, problem, "Rename one of them")
        self._frames[name] = _Frame(relative_to, placement, where, body, attached_to)

    def _unknown(self, name: str, where: str) -> InputError:
        problem = f"there is no link, joint, frame or model {name!r}"
        return self.values.unknown(where, problem, (WORLD, *self._frames))

    def placement(self, name: str, where: str) -> pin.SE3:
        """Placement of a frame in the world.

        Raises
        ------
        InputError
            If there is no such frame, or it is placed relative to itself.
        """
        chain: list[str] = []
        while name not in self._found:
            if name not in self._frames:
                raise self._unknown(name, self._frames[chain[-1]].where if chain else where)
            frame = self._frames[name]
            if name in chain:
                raise self._ring([*chain, name])
            chain.append(name)
            name = frame.relative_to
        at = self._found[name]
        for each in reversed(chain):
            at = at * self._frames[each].placement
            self._found[each] = at
        return at

    def within(self, model: str, name: str, where: str) -> pin.SE3:
        """Placement of a frame in that of the model around it, which is not yet placed.

        Raises
        ------
        InputError
            If there is no such frame in the model, or it is placed relative to itself.
        """
        at, seen = pin.SE3.Identity(), [name]
        while name != model:
            if name not in self._frames:
                raise self._unknown(name, where)
            frame = self._frames[name]
            at, name = frame.placement * at, frame.relative_to
            if name in seen:
                raise self._ring([*seen, name])
            seen.append(name)
        return at

    def _ring(self, chain: list[str]) -> InputError:
        problem = f"its pose is relative to itself: {' -> '.join(chain)}"
        where = self._frames[chain[-1]].where
        return self.values.fault(where, problem, "Break the ring of relative_to")

    def body(self, name: str, where: str) -> str:
        """Name of the link that a frame is part of, or ``world``.

        Raises
        ------
        InputError
            If there is no such frame, or it is attached to itself.
        """
        seen: list[str] = []
        while name != WORLD:
            if name not in self._frames:
                raise self._unknown(name, where)
            frame = self._frames[name]
            if frame.body is not None:
                return frame.body
            if name in seen:
                problem = f"it is attached to itself: {' -> '.join((*seen, name))}"
                raise self.values.fault(frame.where, problem, "Break the ring of attached_to")
            seen.append(name)
            name = frame.attached_to
        return WORLD


LINK_READ = ("pose", "inertial", "visual", "gravity", "kinematic", "static")
LINK_IGNORED = words(
    "collision self_collide enable_wind must_be_base_link velocity_decay sensor projector "
    "audio_sink audio_source battery light particle_emitter plugin contact"
)
INERTIAL_READ = ("pose", "frame", "mass", "inertia", "density")
INERTIAL_IGNORED = ("auto_inertia_params",)
MOMENTS = {"ixx": 1.0, "iyy": 1.0, "izz": 1.0, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
"""With the defaults of SDF."""
DEFAULTS = "without <inertial>, <mass> or <inertia> SDF's defaults count (1 kg, 1 kg m^2)"


WEIGHTLESS = (
    "gravity does not act (<gravity>false): a force carries the weight; the energy contains its "
    "potential, and the balance the work of the force"
)
DENSITY = 1000.0
"""kg/m^3, SDF's default."""
SHAPES = {
    "box": {"size": (3, "1 1 1")},
    "sphere": {"radius": (1, "1")},
    "cylinder": {"radius": (1, "1"), "length": (1, "1")},
    "mesh": {"scale": (3, "1 1 1")},
}
"""Shapes that URDF has as well: their elements, with count and defaults of the numbers in these."""
SOLIDS = {
    **SHAPES,
    "capsule": {"radius": (1, "0.5"), "length": (1, "1")},
    "ellipsoid": {"radii": (3, "1 1 1")},
}
"""Shapes whose inertia is computed, likewise."""
HALVES: dict[str, tuple[float, ...]] = {
    "box": (0.5, 0.5, 0.5),
    "sphere": (1.0,),
    "cylinder": (1.0, 0.5),
    "capsule": (1.0, 0.5),
    "ellipsoid": (1.0, 1.0, 1.0),
}
"""Factors from their sizes to radii and half lengths."""


class LinkReader:
    """Reads links when all frames are known.

    Parameters
    ----------
    values, frames
        The file and its frames.
    reach
        Where mesh files may lie.

    Attributes
    ----------
    weightless
        Links on which gravity does not act.
    """

    def __init__(self, values: XmlValues, frames: Frames, reach: Reach) -> None:
        self.values, self.frames, self.reach = values, frames, reach
        self.weightless: list[str] = []

    def read(self, node: Element, name: str, scope: Scope) -> Body:
        """One ``<link>`` of this full name; its pose has been added to the frames."""
        values, where = self.values, f"link {name!r}"
        values.attributes(node, where, ("name",))
        values.children(node, where, LINK_READ, LINK_IGNORED, ("visual",))
        for tag in ("kinematic", "static"):
            if values.child_truth(node, tag, where, False):
                problem = f"<{tag}>{node.findtext(tag)}</{tag}> is not simulated by this version"
                raise values.fault(where, problem, "Remove it")
        if not values.child_truth(node, "gravity", where, True):
            values.remark(WEIGHTLESS, name)
            self.weightless.append(name)
        visuals = [self._visual(visual, name, scope) for visual in node.findall("visual")]
        return Body(
            name,
            self._inertia(node, name, scope),
            tuple(visual for visual in visuals if visual is not None),
        )

    def _placement(self, node: Element, link: str, where: str, scope: Scope) -> pin.SE3:
        """Placement in its link of an element that may be posed relative to any frame."""
        placement, relative_to = pose(self.values, node, where, scope)
        if not relative_to:
            return placement
        at = self.frames.placement(scope.full(relative_to), where)
        return self.frames.placement(link, where).actInv(at * placement)

    def _inertia(self, link: Element, name: str, scope: Scope) -> pin.Inertia:
        values, where, node = self.values, f"link {name!r}", link.find("inertial")
        if node is None:
            values.remark(DEFAULTS, where)
            return pin.Inertia(1.0, np.zeros(3), np.eye(3))
        values.attributes(node, where, ("auto",))
        if node.find("fluid_added_mass") is not None:
            raise values.fault(where, "<fluid_added_mass> is not read", "Remove it")
        values.children(node, where, INERTIAL_READ, INERTIAL_IGNORED)
        if values.truth(node.get("auto", "false"), where, "auto"):
            return self._of_collisions(link, node, name, scope)
        inertia = node.find("inertia")
        if inertia is None or node.find("mass") is None:
            values.remark(DEFAULTS, where)
        if inertia is not None:
            values.children(inertia, where, MOMENTS, ())
        mass = values.child_number(node, "mass", where, 1.0)
        moments = [values.child_number(inertia, key, where, MOMENTS[key]) for key in MOMENTS]
        return inertia_at(self._placement(node, name, where, scope), mass, moments)

    def _of_collisions(
        self, link: Element, inertial: Element, name: str, scope: Scope
    ) -> pin.Inertia:
        """The sum of the inertias of the collision shapes, as libsdformat has it: ``<density>`` of
        a collision counts before that of ``<inertial>``; a given ``<mass>`` is that of all."""
        values, where = self.values, f"link {name!r}"
        density = values.child_number(inertial, "density", where, DENSITY)
        total = pin.Inertia.Zero()
        for node in link.findall("collision"):
            inside = f"{where}, collision {node.get('name', '')!r}"
            shape = node.find("geometry/*")
            if shape is None or shape.tag not in SOLIDS:
                tag = "no geometry" if shape is None else f"the shape <{shape.tag}>"
                problem = f"<inertial auto> of {tag} is not computed by this version"
                raise values.fault(inside, problem, "Write <mass> and <inertia>")
            own = self._solid(shape, inside, Path(scope.file).parent)
            rho = values.child_number(node, "density", inside, density)
            at = self._placement(node, name, inside, scope)
            total += at.act(pin.Inertia(rho * own.mass, own.lever, rho * own.inertia))
        if not total.mass > 0.0:
            problem = "<inertial auto> finds no <collision> with mass"
            raise values.fault(where, problem, "Write <mass> and <inertia>")
        factor = values.child_number(inertial, "mass", where, total.mass) / total.mass
        values.remark("<inertial auto>: mass and inertia are those of the collision shapes", name)
        return pin.Inertia(factor * total.mass, total.lever, factor * total.inertia)

    def _solid(self, shape: Element, where: str, folder: Path) -> pin.Inertia:
        """Inertia of a shape at unit density, in its own frame."""
        values, kind = self.values, shape.tag
        sizes = [
            size
            for key, (count, default) in SOLIDS[kind].items()
            for size in values.numbers(shape.findtext(key, default), count, where, f"<{key}>")
        ]
        if kind != "mesh":
            if min(sizes) <= 0.0:
                raise values.fault(where, f"a size of its <{kind}> is not positive", "Correct it")
            halves = np.zeros(3)
            halves[: len(sizes)] = np.multiply(sizes, HALVES[kind])
            volume, moments = solid(kind, halves)
            return pin.Inertia(volume, np.zeros(3), volume * np.diag(moments))
        if shape.find("submesh") is not None:
            problem = "the inertia of a <submesh> is not computed by this version"
            raise values.fault(where, problem, "Write <mass> and <inertia>")
        with naming(file=values.file, element=where):
            path = self.reach.find(shape.findtext("uri", "").strip(), folder, "mesh file")
        vertices, faces = read_mesh(path)
        volume, centre, moments = enclosed(vertices * sizes, faces)
        if not volume > 0.0:
            problem = f"the triangles of {path.name!r} enclose no volume, or are inside out"
            raise values.fault(where, problem, "Write <mass> and <inertia>")
        return pin.Inertia(volume, centre, moments)

    def _visual(self, node: Element, link: str, scope: Scope) -> Element | None:
        """A ``<visual>`` of URDF; None, counted, if URDF has no such shape."""
        values, where = self.values, f"link {link!r}, visual {node.get('name', '')!r}"
        placement = self._placement(node, link, where, scope)
        shape = node.find("geometry/*")
        if shape is None or shape.tag not in SHAPES:
            tag = "no geometry" if shape is None else shape.tag
            values.remark(f"a <visual> of the shape <{tag}> is not drawn", f"link {link!r}")
            return None
        sizes = {
            key: numbers(values.numbers(shape.findtext(key, default), count, where, f"<{key}>"))
            for key, (count, default) in SHAPES[shape.tag].items()
        }
        if shape.tag == "mesh":
            sizes = {"filename": mesh_name(shape.findtext("uri", "")), **sizes}
        colour = node.findtext("material/diffuse") or node.findtext("material/ambient")
        rgba = None
        if colour is not None:
            rgba = [*values.numbers(colour, (3, 4), where, "its colour"), 1.0][:4]
        return visual(placement, shape.tag, sizes, rgba)


def mesh_name(uri: str) -> str:
    """The file name in URDF of a mesh of SDF: ``package://`` in place of ``model://``."""
    uri = uri.strip()
    return f"package://{uri[len('model://') :]}" if urlsplit(uri).scheme == "model" else uri
