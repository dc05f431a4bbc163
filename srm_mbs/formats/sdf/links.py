"""Links of an SDF file with their inertias and visuals, and the frames that place them.

Names follow SDF 1.7 and later (``http://sdformat.org/tutorials?tut=pose_frame_semantics``): every
link, joint, frame and nested model is a frame of its model; ``a::b`` is the frame b of the nested
model a; ``__model__`` is a model's own frame.  Older files are a special case: they have no other
frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from urllib.parse import urlsplit
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import pinocchio as pin

from srm_mbs.errors import InputError
from srm_mbs.formats.graph.joint_graph import Body
from srm_mbs.formats.graph.spanning_tree_to_urdf import numbers, origin
from srm_mbs.formats.xml import XmlValues
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.coordinates import UNIT_LENGTH_TOLERANCE

MODEL = "__model__"
SEPARATOR = "::"
RESERVED = ("world", "__model__", "__root__")


def joint_frame(name: str, version: tuple[int, int]) -> str:
    """Name of a joint's frame; before SDF 1.7 nothing refers to it, and links may have its name."""
    return name if version >= (1, 7) else f"{name}{SEPARATOR}__joint__"


def pose(
    values: XmlValues, text: str | None, where: str, degrees: bool, quaternion: bool
) -> pin.SE3:
    """A pose from its text: x y z and roll pitch yaw, or x y z and a quaternion x y z w."""
    if not (text or "").split():
        return pin.SE3.Identity()
    numbers = values.numbers(text, 7 if quaternion else 6, where, "<pose>")
    if not quaternion:
        angles = np.deg2rad(numbers[3:]) if degrees else numbers[3:]
        return pin.SE3(pin.rpy.rpyToMatrix(angles), numbers[:3])
    length = float(np.linalg.norm(numbers[3:]))
    if abs(length - 1.0) > UNIT_LENGTH_TOLERANCE:
        raise values.fault(
            where, f"the quaternion of <pose> has length {length:.6g}", "Give a unit quaternion"
        )
    return pin.SE3(pin.Quaternion(numbers[3:] / length).matrix(), numbers[:3])


@dataclass
class _Frame:
    relative_to: str
    placement: pin.SE3
    where: str
    body: str | None
    attached_to: str


@dataclass
class Frames:
    """The frames of a file by full name; placed in any order, resolved on demand.

    Full names have the names of all nested models in front; the frame of the outermost model is
    ``__model__``.
    """

    file: str
    _frames: dict[str, _Frame] = field(default_factory=dict)
    _found: dict[str, pin.SE3] = field(default_factory=dict)

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
            raise InputError(
                f"two links, joints, frames or models of one model are called {name!r}",
                file=self.file,
                element=where,
                remedy="Rename one of them",
            )
        self._frames[name] = _Frame(relative_to, placement, where, body, attached_to)

    def _unknown(self, name: str, where: str) -> InputError:
        return InputError(
            f"there is no link, joint, frame or model {name!r}",
            file=self.file,
            element=where,
            remedy=f"Known: {', '.join((WORLD, *self._frames))}",
        )

    def placement(self, name: str, where: str) -> pin.SE3:
        """Placement of a frame in the world.

        Raises
        ------
        InputError
            If there is no such frame, or it is placed relative to itself.
        """
        chain: list[str] = []
        while name != WORLD and name not in self._found:
            if name not in self._frames:
                raise self._unknown(name, self._frames[chain[-1]].where if chain else where)
            if name in chain:
                raise InputError(
                    f"its pose is relative to itself: {' -> '.join((*chain, name))}",
                    file=self.file,
                    element=self._frames[name].where,
                    remedy="Break the ring of relative_to",
                )
            chain.append(name)
            name = self._frames[name].relative_to
        at = pin.SE3.Identity() if name == WORLD else self._found[name]
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
                raise InputError(
                    f"it is attached to itself: {' -> '.join((*seen, name))}",
                    file=self.file,
                    element=frame.where,
                    remedy="Break the ring of attached_to",
                )
            seen.append(name)
            name = frame.attached_to
        return WORLD


PlaceOf = Callable[[Element, str], pin.SE3]

LINK_READ = ("pose", "inertial", "visual", "collision", "gravity", "kinematic", "static")
LINK_IGNORED = (
    "self_collide",
    "enable_wind",
    "must_be_base_link",
    "velocity_decay",
    "sensor",
    "projector",
    "audio_sink",
    "audio_source",
    "battery",
    "light",
    "particle_emitter",
    "plugin",
)
INERTIAL_READ = ("pose", "frame", "mass", "inertia")
MOMENTS = {"ixx": 1.0, "iyy": 1.0, "izz": 1.0, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
"""With the defaults of SDF."""
DEFAULTS = "without <inertial>, <mass> or <inertia> SDF's defaults count (1 kg, 1 kg m^2)"


def read_link(values: XmlValues, node: Element, name: str, place_of: PlaceOf) -> Body:
    """One link; its pose is not read here.

    Parameters
    ----------
    values, node
        The file and the ``<link>``.
    name
        Its full name.
    place_of
        Reads the ``<pose>`` of an element, which names no frame.
    """
    where = f"link {name!r}"
    values.attributes(node, where, ("name",))
    values.children(node, where, LINK_READ, LINK_IGNORED, ("visual", "collision"))
    for tag, acts in (("gravity", True), ("kinematic", False), ("static", False)):
        child = node.find(tag)
        if child is not None and values.truth(child.text, where, f"<{tag}>") != acts:
            raise values.fault(
                where, f"<{tag}>{child.text}</{tag}> is not simulated by this version", "Remove it"
            )
    for collision in node.findall("collision"):
        values.ignore(f"<{collision.tag}> element")
    visuals = [_visual(values, visual, name, place_of) for visual in node.findall("visual")]
    return Body(
        name,
        _inertia(values, node.find("inertial"), where, place_of),
        tuple(visual for visual in visuals if visual is not None),
    )


def _inertia(values: XmlValues, node: Element | None, where: str, place_of: PlaceOf) -> pin.Inertia:
    if node is None:
        values.remark(DEFAULTS, where)
        return pin.Inertia(1.0, np.zeros(3), np.eye(3))
    values.attributes(node, where, ("auto",))
    if node.get("auto") is not None and values.truth(node.get("auto"), where, "auto"):
        raise values.fault(
            where,
            "<inertial auto> (inertia from the collision shapes) is not read by this version",
            "Write <mass> and <inertia>",
        )
    for tag in ("fluid_added_mass", "density"):
        if node.find(tag) is not None:
            raise values.fault(where, f"<{tag}> is not read by this version", "Remove it")
    values.children(node, where, INERTIAL_READ, ())
    mass, inertia = node.find("mass"), node.find("inertia")
    if mass is None or inertia is None:
        values.remark(DEFAULTS, where)
    kilograms = 1.0 if mass is None else values.numbers(mass.text, 1, where, "<mass>")[0]
    moments = dict(MOMENTS)
    if inertia is not None:
        values.children(inertia, where, MOMENTS, ())
        for key in MOMENTS:
            child = inertia.find(key)
            if child is not None:
                moments[key] = float(values.numbers(child.text, 1, where, f"<{key}>")[0])
    xx, yy, zz, xy, xz, yz = moments.values()
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    placed = place_of(node, where)
    turn = placed.rotation
    return pin.Inertia(float(kilograms), placed.translation, turn @ about @ turn.T)


def _visual(values: XmlValues, node: Element, link: str, place_of: PlaceOf) -> Element | None:
    """A ``<visual>`` of URDF; None, counted, if URDF has no such shape."""
    where = f"link {link!r}, visual {node.get('name', '')!r}"
    shape = node.find("geometry/*")
    out = Element("visual")
    origin(out, place_of(node, where))
    geometry = SubElement(out, "geometry")

    def value(tag: str, count: int, default: str) -> str:
        text = shape.findtext(tag, default) if shape is not None else default
        return numbers(values.numbers(text, count, where, f"<{tag}>"))

    match "no geometry" if shape is None else shape.tag:
        case "box":
            SubElement(geometry, "box", size=value("size", 3, "1 1 1"))
        case "sphere":
            SubElement(geometry, "sphere", radius=value("radius", 1, "1"))
        case "cylinder":
            sizes = {key: value(key, 1, "1") for key in ("radius", "length")}
            SubElement(geometry, "cylinder", sizes)
        case "mesh":
            name = mesh_name(node.findtext("geometry/mesh/uri", ""))
            SubElement(geometry, "mesh", filename=name, scale=value("scale", 3, "1 1 1"))
        case tag:
            values.remark(f"a <visual> of the shape <{tag}> is not drawn", f"link {link!r}")
            return None
    colour = node.findtext("material/diffuse") or node.findtext("material/ambient")
    if colour is not None:
        rgba = values.numbers(colour, (3, 4), where, "its colour")
        material = SubElement(out, "material", name="")
        SubElement(material, "color", rgba=numbers([*rgba, 1.0][:4]))
    return out


def mesh_name(uri: str) -> str:
    """The file name in URDF of a mesh of SDF: ``package://`` in place of ``model://``."""
    uri = uri.strip()
    return f"package://{uri[len('model://') :]}" if urlsplit(uri).scheme == "model" else uri
