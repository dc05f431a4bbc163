"""Shapes of the bodies of a mechanism, each with a colour and fixed to one joint of the tree.

The shapes are the ``<visual>`` elements of the URDF.  Each is placed through the frame of its link
in the simulated model, which accounts for locked joints and moving bases.  A mechanism without
visuals is drawn as bars between its joints and loop anchors.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import coordinate_units
from srm_mbs.errors import InputError, get_logger, joined_names
from srm_mbs.formats.meshes import read_mesh
from srm_mbs.formats.xml import parse_numbers, parse_xml
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.mechanism import Source
from srm_mbs.visualization.animation.trajectory import ActiveIntervals

log = get_logger(__name__)

Colour = tuple[float, float, float, float]

PALETTE: tuple[Colour, ...] = (  # after Okabe and Ito: distinct for colour-blind readers too
    (0.000, 0.447, 0.698, 1.0),
    (0.902, 0.624, 0.000, 1.0),
    (0.000, 0.620, 0.451, 1.0),
    (0.800, 0.475, 0.655, 1.0),
    (0.337, 0.706, 0.914, 1.0),
)
GROUND_COLOUR: Colour = (0.55, 0.57, 0.60, 1.0)
PIN_COLOUR: Colour = (0.15, 0.16, 0.18, 1.0)
ANCHOR_COLOUR: Colour = (0.835, 0.369, 0.000, 1.0)
BAR_THICKNESS = 0.025
"""Thickness of a bar over the mechanism's extent, in drawings without visuals."""
LARGEST_MESH = 100.0
"""Size of the mesh of a moving body, over that of the mechanism, above which a unit is doubtful."""


@dataclass(frozen=True)
class Box:
    """A box centred at the origin; ``size`` (3,) m along x, y, z."""

    size: tuple[float, float, float]


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about the z axis, centred at the origin; m."""

    radius: float
    length: float


@dataclass(frozen=True)
class Sphere:
    """A sphere about the origin; m."""

    radius: float


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: ``vertices`` (n, 3) m, ``faces`` (k, 3) indices."""

    vertices: FloatArray
    faces: Any


Shape = Box | Cylinder | Sphere | Mesh


def bounding_box(shape: Shape) -> FloatArray:
    """Lower and upper corner (2, 3) m in the frame of the shape."""
    match shape:
        case Mesh(vertices):
            return np.array([vertices.min(axis=0), vertices.max(axis=0)])
        case Box(size):
            half = 0.5 * np.array(size)
        case Cylinder(radius, length):
            half = np.array([radius, radius, 0.5 * length])
        case Sphere(radius):
            half = np.full(3, radius)
    return np.array([-half, half])


@dataclass(frozen=True, eq=False)
class Visual:
    """One shape on one body.

    Attributes
    ----------
    joint
        Index of the joint that carries it; 0 is the ground.
    placement
        Of the shape in the joint's frame.
    colour
        Red, green, blue and opacity, 0 to 1.
    active
        When it is drawn (s); None for always.
    """

    joint: int
    placement: pin.SE3
    shape: Shape
    colour: Colour
    active: ActiveIntervals | None = None

    def corners(self) -> FloatArray:
        """Corners (8, 3) m of its bounding box, in the joint's frame."""
        low, high = bounding_box(self.shape)
        choice = np.array(list(np.ndindex(2, 2, 2)))
        corners = np.where(choice == 0, low, high)
        return np.asarray(corners @ self.placement.rotation.T + self.placement.translation)


def visuals_of(
    mechanism: Mechanism, loops: Sequence[tuple[LoopClosure, ActiveIntervals | None]] | None = None
) -> list[Visual]:
    """Shapes of ``mechanism``: those of its URDF or, if there are none, bars.

    Parameters
    ----------
    mechanism
        The mechanism.
    loops
        Closures with their active intervals: bars end at their anchors, which are marked.  Those
        of ``mechanism`` by default.

    Mesh files are searched where :class:`~srm_mbs.model.reach.Reach` says.  Those that cannot be
    read are left out, with one warning; bars stand for bodies that have no other visual.
    """
    loops = [(loop, None) for loop in mechanism.loops] if loops is None else loops
    found, left_out = _urdf_visuals(mechanism)
    if not found:
        bars = _skeleton(mechanism, loops, set(range(mechanism.model.njoints)))
    else:
        drawn = {visual.joint for visual in found}
        bare = {fault.joint for fault in left_out} - drawn
        bars = _skeleton(mechanism, loops, bare) if bare else []
    if left_out and mechanism.source is not None:
        log.warning("%s", _left_out_text(left_out, len(found), mechanism.source))
    for text in islice(_oversized(mechanism, found), 1):
        log.warning("%s", text)
    return [*found, *bars]


# The URDF -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _LeftOut:
    """A ``<visual>`` of ``link``, on ``joint``, that cannot be drawn, and why."""

    link: str
    joint: int
    why: InputError


def _left_out_text(left_out: Sequence[_LeftOut], drawn: int, source: Source) -> str:
    """The warning about visuals that are left out, with the folders that were searched."""
    links = dict.fromkeys(fault.link for fault in left_out)
    first = left_out[0].why
    folders = source.reach.searched(Path(source.urdf_path).parent)
    several = "" if len(left_out) == 1 else ", the first"
    return (
        f"{len(left_out)} of {len(left_out) + drawn} visuals are not drawn, of the links "
        f"{joined_names(map(repr, links))}{several}: {first.problem}. {first.remedy}. Searched in "
        f"{joined_names(map(str, folders))}; give other folders with mesh_dirs= (--mesh-dirs)"
    )


def _urdf_visuals(mechanism: Mechanism) -> tuple[list[Visual], list[_LeftOut]]:
    """The visuals of the URDF, and those that cannot be drawn."""
    source, model = mechanism.source, mechanism.model
    found: list[Visual] = []
    left_out: list[_LeftOut] = []
    if source is None:
        return found, left_out
    root = parse_xml(source.urdf, source.urdf_path)
    # A colour may be defined anywhere, and be used by its name anywhere else.
    colours: dict[str, Element] = {}
    for material in root.iter("material"):
        if (colour := material.find("color")) is not None:
            colours.setdefault(material.get("name", ""), colour)
    for link in root.findall("link"):
        for element in link.findall("visual"):
            name = link.get("name", "")
            frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
            joint = int(frame.parentJoint)
            try:
                visual = Visual(
                    joint,
                    frame.placement * _origin(element),
                    _shape(element, source),
                    _colour(element, colours) or _default_colour(joint),
                )
            except InputError as error:
                left_out.append(_LeftOut(name, joint, error))
            else:
                found.append(visual)
    return found, left_out


def _oversized(mechanism: Mechanism, visuals: Sequence[Visual]) -> Iterator[str]:
    """Sentences about meshes of moving bodies whose files may be in mm."""
    for visual in visuals:
        if visual.joint and isinstance(visual.shape, Mesh):
            size = float(np.linalg.norm(np.diff(bounding_box(visual.shape), axis=0)))
            scene = coordinate_units(mechanism, mechanism.q0, mechanism.v0).length
            if size > LARGEST_MESH * scene:
                yield (
                    f"the mesh of the joint {mechanism.model.names[visual.joint]!r} is {size:.3g} "
                    f"m large, in a mechanism of {scene:.3g} m: lengths of meshes are in m; those "
                    'of files in mm take scale="0.001 0.001 0.001" in <mesh>'
                )


def _numbers(element: Element, key: str, default: str) -> list[float]:
    """As many finite numbers of attribute ``key`` as ``default`` has."""
    text = element.get(key, default)
    values, count = parse_numbers(text), len(default.split())
    if values is None or len(values) != count:
        raise InputError(
            f"<{element.tag} {key}={text!r}> is not {count} finite number(s)",
            remedy=f"Write {count} number(s)",
        )
    return values


def _default_colour(joint: int) -> Colour:
    return PALETTE[(joint - 1) % len(PALETTE)] if joint else GROUND_COLOUR


def _colour(visual: Element, colours: dict[str, Element]) -> Colour | None:
    material = visual.find("material")
    if material is None:
        return None
    colour = material.find("color")
    if colour is None:
        colour = colours.get(material.get("name", ""))
    if colour is None:
        return None
    red, green, blue, opacity = np.clip(_numbers(colour, "rgba", "1 1 1 1"), 0.0, 1.0).tolist()
    return (red, green, blue, opacity)


def _origin(visual: Element) -> pin.SE3:
    origin = visual.find("origin")
    if origin is None:
        return pin.SE3.Identity()
    rpy = np.array(_numbers(origin, "rpy", "0 0 0"))
    return pin.SE3(pin.rpy.rpyToMatrix(rpy), np.array(_numbers(origin, "xyz", "0 0 0")))


def _shape(visual: Element, source: Source) -> Shape:
    """The shape of a ``<visual>``; raises InputError if it cannot be drawn."""
    element = visual.find("geometry/*")
    if element is None:
        raise InputError("it has no geometry", remedy="Add <geometry>")
    match element.tag:
        case "box":
            x, y, z = _numbers(element, "size", "0 0 0")
            return Box((x, y, z))
        case "cylinder":
            (radius,), (length,) = (_numbers(element, key, "0") for key in ("radius", "length"))
            return Cylinder(radius, length)
        case "sphere":
            (radius,) = _numbers(element, "radius", "0")
            return Sphere(radius)
        case "mesh":
            scale = np.array(_numbers(element, "scale", "1 1 1"))
            return _mesh(element.get("filename", ""), scale, source)
        case tag:
            raise InputError(
                f"there is no geometry {tag!r}", remedy="Known: box, cylinder, sphere, mesh"
            )


def _mesh(name: str, scale: FloatArray, source: Source) -> Mesh:
    """Triangles in metres of the mesh file that a URDF names.

    Raises
    ------
    InputError
        If there is no such file, it is out of reach, or it is no mesh.
    """
    path = source.reach.find(name, Path(source.urdf_path).parent, "mesh file")
    try:
        vertices, faces = read_mesh(path)
    except InputError as error:
        raise InputError(
            f"the mesh file {name!r} cannot be read: {error.problem}", remedy=error.remedy
        ) from error
    return Mesh(vertices * scale, faces)


# Bars ---------------------------------------------------------------------------------------


def _skeleton(
    mechanism: Mechanism,
    loops: Sequence[tuple[LoopClosure, ActiveIntervals | None]],
    joints: Collection[int],
) -> list[Visual]:
    """Bars from each of ``joints`` to its child joints and loop anchors, with markers there."""
    ends, masses = bar_ends(mechanism, [loop for loop, _ in loops])
    model = mechanism.model
    anchors = [(*side.resolve(model), active) for loop, active in loops for side in loop.anchors]
    width = BAR_THICKNESS * _extent(mechanism, ends)
    out = []
    for joint in sorted(set(joints) - {0}):
        colour = _default_colour(joint)
        # Bars of a planar mechanism cross in one plane: unequal ones do not flicker there.
        thick = width * (1.0 - 0.08 * (joint % 3))
        for end in ends[joint]:
            length = float(np.linalg.norm(end))
            if length > 0.0:
                bar = Box((thick, thick, length))
                out.append(Visual(joint, _along(0.5 * end, end), bar, colour))
        out.append(_marker(mechanism, joint, width))
    for joint in sorted(set(joints).intersection(masses)):
        centre = pin.SE3(np.eye(3), model.inertias[joint].lever)
        colour = _default_colour(joint)
        out.append(Visual(joint, centre, Sphere(1.5 * width), colour))
    for joint, placement, active in anchors:
        if joint and joint in joints:
            out.append(Visual(joint, placement, Sphere(0.9 * width), ANCHOR_COLOUR, active))
    for end in ends[0] if 0 in joints else ():
        block = Box((2.0 * width,) * 3)
        out.append(Visual(0, pin.SE3(np.eye(3), end), block, GROUND_COLOUR))
    return out


def rods(mechanism: Mechanism) -> list[LoopClosure]:
    """The closures that keep the distance of two points: massless rods, which no body shows."""
    return [
        loop
        for loop in mechanism.loops
        if loop.rows.distances and loop.rows.count == len(loop.rows.distances)
    ]


def bar_ends(
    mechanism: Mechanism, loops: Sequence[LoopClosure]
) -> tuple[list[list[FloatArray]], list[int]]:
    """Where the bars end that join the origin of each joint to its child joints and to the anchors
    of ``loops``.

    Returns
    -------
    list of lists of (3,) m
        For each joint, of which 0 is the ground, in its frame.
    list of int
        Joints without others and anchors beside their origin: their bar ends in the centre of mass.
    """
    model = mechanism.model
    ends: list[list[FloatArray]] = [[] for _ in range(model.njoints)]
    for joint in range(1, model.njoints):
        ends[model.parents[joint]].append(model.jointPlacements[joint].translation)
    for loop in loops:
        for side in loop.anchors:
            joint, placement = side.resolve(model)
            ends[joint].append(placement.translation)
    masses = [
        joint
        for joint in range(1, model.njoints)
        if not np.any(ends[joint]) and np.any(model.inertias[joint].lever)
    ]
    for joint in masses:
        ends[joint].append(model.inertias[joint].lever)
    return ends, masses


def _extent(mechanism: Mechanism, ends: list[list[FloatArray]]) -> float:
    """Diagonal (m) of the box around all joints and bar ends at the initial configuration."""
    data = workspace(mechanism.model)
    pin.forwardKinematics(mechanism.model, data, np.array(mechanism.q0))
    points = [data.oMi[joint].act(end) for joint, own in enumerate(ends) for end in own]
    points += [data.oMi[joint].translation for joint in range(1, mechanism.model.njoints)]
    return float(np.linalg.norm(np.ptp(np.array(points), axis=0))) or 1.0


def _along(centre: FloatArray, direction: FloatArray) -> pin.SE3:
    """Placement at ``centre`` whose z axis points along ``direction``."""
    rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction).matrix()
    return pin.SE3(rotation, centre)


def _marker(mechanism: Mechanism, joint: int, width: float) -> Visual:
    """A pin along the axis of a hinge, a block along that of a slide, otherwise a ball."""
    model = mechanism.model
    kind = model.joints[joint]
    # The joint's own columns of its Jacobian are constant for a hinge or a slide.
    jacobian = pin.computeJointJacobian(model, workspace(model), np.array(mechanism.q0), joint)
    # Pinocchio returns a single column as a vector.
    linear, angular = np.split(jacobian.reshape(6, model.nv)[:, kind.idx_v], 2)
    if kind.nv == 1 and np.any(angular):
        hinge = Cylinder(0.8 * width, 2.4 * width)
        return Visual(joint, _along(np.zeros(3), angular), hinge, PIN_COLOUR)
    if kind.nv == 1:
        block = Box((1.6 * width, 1.6 * width, 3.2 * width))
        return Visual(joint, _along(np.zeros(3), linear), block, PIN_COLOUR)
    return Visual(joint, pin.SE3.Identity(), Sphere(1.2 * width), PIN_COLOUR)
