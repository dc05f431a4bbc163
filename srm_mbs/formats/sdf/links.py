"""Links of an SDF file with their inertias and visuals, and the frames that place them.

Names follow SDF 1.7 and later (``http://sdformat.org/tutorials?tut=pose_frame_semantics``): every
link, joint, frame and nested model is a frame of its model; ``a::b`` is the frame b of the nested
model a; ``__model__`` is a model's own frame.  Older files are a special case: they have no other
frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlsplit
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs.errors import InputError
from srm_mbs.formats.graph.joint_graph import Body, inertia_at
from srm_mbs.formats.graph.spanning_tree_to_urdf import numbers, visual
from srm_mbs.formats.xml import XmlValues, words
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.coordinates import UNIT_LENGTH_TOLERANCE

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
    """

    prefix: str
    file: str
    version: tuple[int, int]
    depth: int = 0

    def full(self, name: str) -> str:
        """Full name of ``name`` in this context; ``world`` means the ground everywhere."""
        return WORLD if name == WORLD else self.prefix + name


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


def own_pose(values: XmlValues, node: Element, where: str, scope: Scope) -> pin.SE3:
    """The ``<pose>`` of an element inside a link, which may be relative to the link only."""
    placement, relative_to = pose(values, node, where, scope)
    if relative_to:
        problem = f"the pose inside a link is relative to {relative_to!r}"
        raise values.fault(where, problem, "Give it relative to the link")
    return placement


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
                problem = f"its pose is relative to itself: {' -> '.join((*chain, name))}"
                raise self.values.fault(frame.where, problem, "Break the ring of relative_to")
            chain.append(name)
            name = frame.relative_to
        at = self._found[name]
        for each in reversed(chain):
            at = at * self._frames[each].placement
            self._found[each] = at
        return at

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
    "audio_sink audio_source battery light particle_emitter plugin"
)
INERTIAL_READ = ("pose", "frame", "mass", "inertia")
MOMENTS = {"ixx": 1.0, "iyy": 1.0, "izz": 1.0, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
"""With the defaults of SDF."""
DEFAULTS = "without <inertial>, <mass> or <inertia> SDF's defaults count (1 kg, 1 kg m^2)"


def read_link(values: XmlValues, node: Element, name: str, scope: Scope) -> Body:
    """One link; its pose is not read here.

    Parameters
    ----------
    values, node
        The file and the ``<link>``.
    name
        Its full name.
    scope
        Where it is.
    """
    where = f"link {name!r}"
    values.attributes(node, where, ("name",))
    values.children(node, where, LINK_READ, LINK_IGNORED, ("visual",))
    for tag, acts in (("gravity", True), ("kinematic", False), ("static", False)):
        if values.child_truth(node, tag, where, acts) != acts:
            problem = f"<{tag}>{node.findtext(tag)}</{tag}> is not simulated by this version"
            raise values.fault(where, problem, "Remove it")
    visuals = [_visual(values, visual, name, scope) for visual in node.findall("visual")]
    return Body(
        name,
        _inertia(values, node.find("inertial"), where, scope),
        tuple(visual for visual in visuals if visual is not None),
    )


def _inertia(values: XmlValues, node: Element | None, where: str, scope: Scope) -> pin.Inertia:
    if node is None:
        values.remark(DEFAULTS, where)
        return pin.Inertia(1.0, np.zeros(3), np.eye(3))
    values.attributes(node, where, ("auto",))
    if values.truth(node.get("auto", "false"), where, "auto"):
        raise values.fault(
            where,
            "<inertial auto> (inertia from the collision shapes) is not read by this version",
            "Write <mass> and <inertia>",
        )
    for tag in ("fluid_added_mass", "density"):
        if node.find(tag) is not None:
            raise values.fault(where, f"<{tag}> is not read by this version", "Remove it")
    values.children(node, where, INERTIAL_READ, ())
    inertia = node.find("inertia")
    if inertia is None or node.find("mass") is None:
        values.remark(DEFAULTS, where)
    if inertia is not None:
        values.children(inertia, where, MOMENTS, ())
    mass = values.child_number(node, "mass", where, 1.0)
    moments = [values.child_number(inertia, key, where, MOMENTS[key]) for key in MOMENTS]
    return inertia_at(own_pose(values, node, where, scope), mass, moments)


SHAPES = {
    "box": {"size": (3, "1 1 1")},
    "sphere": {"radius": (1, "1")},
    "cylinder": {"radius": (1, "1"), "length": (1, "1")},
    "mesh": {"scale": (3, "1 1 1")},
}
"""Shapes that URDF has as well: their elements, with count and defaults of the numbers in these."""


def _visual(values: XmlValues, node: Element, link: str, scope: Scope) -> Element | None:
    """A ``<visual>`` of URDF; None, counted, if URDF has no such shape."""
    where = f"link {link!r}, visual {node.get('name', '')!r}"
    placement = own_pose(values, node, where, scope)
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
