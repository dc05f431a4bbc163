"""Geoms of MJCF: their inertia and their visuals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, naming
from srm_mbs.formats.graph.spanning_tree_to_urdf import numbers, visual
from srm_mbs.formats.meshes import enclosed, read_mesh, solid, surface
from srm_mbs.formats.mjcf.attributes import GEOMS, Attributes, MjcfValues, z_along
from srm_mbs.model.reach import Reach

DENSITY = 1000.0
"""kg/m^3, MuJoCo's default."""
SIZES = {"sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3}
"""How many sizes each solid shape needs; radii and half lengths, m."""
ALONG = ("capsule", "cylinder", "ellipsoid", "box")
"""Shapes that may be given by two ends."""
MASSLESS = ("plane",)
INERTIAS = ("legacy", "convex", "exact", "shell")
"""Ways to the inertia of a mesh, the default first."""
GIVE_INERTIAL = "Give the body an <inertial>"


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh of ``<asset>``.

    A vertex x of the file is S R^T (x - p) in the axes of the mesh.

    Attributes
    ----------
    file
        As the model names it.
    scale : (3,)
        The diagonal of S.
    inertia
        How its inertia is found, one of :data:`INERTIAS`.
    origin, turn : (3,), (3, 3)
        p and R.
    """

    file: str
    scale: FloatArray
    inertia: str
    origin: FloatArray
    turn: FloatArray

    @property
    def axes(self) -> pin.SE3:
        """Placement of the axes of the file in those of the mesh, if S and R commute."""
        turn = self.turn if self.is_similar else np.eye(3)
        return pin.SE3(turn.T, -self.scale * (turn.T @ self.origin))

    @property
    def is_similar(self) -> bool:
        """Whether S and R commute, as those of a mesh do that is turned or stretched, not both."""
        return np.ptp(self.scale) == 0.0 or np.allclose(self.turn, np.eye(3))


@dataclass(frozen=True, eq=False)
class Geom:
    """A shape in its body's frame; ``sizes`` (3,) as MuJoCo has them."""

    kind: str
    placement: pin.SE3
    sizes: FloatArray
    mass: float | None
    density: float
    group: int
    given: Attributes


def read_geom(
    values: MjcfValues, node: Element, childclass: str, around: pin.SE3, body: str
) -> Geom:
    """One ``<geom>``, in the frame ``around`` of its body.

    Raises
    ------
    InputError
        Naming the geom.
    """
    name = node.get("name")
    which = f"geom {name!r}" if name else "a <geom> without name"
    given = values.resolved(node, childclass, f"body {body!r}, {which}")
    kind = given.choice("type", GEOMS)
    if "mesh" in given and "type" not in given:
        kind = "mesh"
    placement = given.placement()
    sizes = np.zeros(3)
    needed = SIZES.get(kind, 0)
    found = given.numbers("size", (1, 2, 3)) if given.text("size").strip() else np.zeros(0)
    if needed:
        if "fromto" in given:
            if kind not in ALONG:
                raise given.fault(f"a {kind} takes no fromto", "Give pos and size")
            both = given.numbers("fromto", 6)
            along = both[:3] - both[3:]  # as MuJoCo turns it
            turn = z_along(values.direction(along, given.where, "fromto"))
            placement = pin.SE3(turn, 0.5 * (both[:3] + both[3:]))
            wide = found[:1] if needed == 2 else np.repeat(found[:1], 2)
            found = np.append(wide, 0.5 * float(np.linalg.norm(along)))
        if len(found) < needed or (found[:needed] <= 0.0).any():
            raise given.fault(f"a {kind} needs {needed} positive size(s)", "Give size")
        sizes[:needed] = found[:needed]
    mass = given.number("mass") if "mass" in given else None
    if mass is not None and mass < 0.0:
        raise given.fault("its mass is negative", "Give a mass >= 0")
    density = given.number("density", DENSITY)
    if density < 0.0:
        raise given.fault("its density is negative", "Give a density >= 0")
    if given.flag("shellinertia"):
        raise given.fault("shellinertia is not read by this version", "Give <inertial>")
    group = int(given.number("group"))
    return Geom(kind, around * placement, sizes, mass, density, group, given)


def inertia_of(geom: Geom, meshes: Mapping[str, Mesh], reach: Reach) -> pin.Inertia | None:
    """Inertia of a solid shape in its body's frame; None without mass.

    ``reach`` says where mesh files may lie.

    Raises
    ------
    InputError
        For a shape whose inertia is not computed here.
    """
    if geom.kind in MASSLESS or geom.mass == 0.0 or (geom.mass is None and geom.density == 0.0):
        return None
    if geom.kind == "mesh":
        own = _of_mesh(geom.given, meshes.get(geom.given.text("mesh")), reach)
    elif geom.kind in SIZES:
        volume, moments = solid(geom.kind, geom.sizes)
        own = pin.Inertia(volume, np.zeros(3), volume * np.diag(moments))
    else:
        raise geom.given.fault(
            f"the inertia of a {geom.kind} is not computed by this version", GIVE_INERTIAL
        )
    density = geom.density if geom.mass is None else geom.mass / own.mass
    return geom.placement.act(pin.Inertia(density * own.mass, own.lever, density * own.inertia))


def _of_mesh(given: Attributes, mesh: Mesh | None, reach: Reach) -> pin.Inertia:
    """Inertia that a mesh stands for, as MuJoCo finds it, at unit density.

    ``exact`` is that of the solid which the triangles enclose, ``convex`` that of its convex hull,
    ``shell`` that of the triangles; ``legacy`` counts every tetrahedron of a triangle and the
    centroid as positive.
    """
    if mesh is None:
        raise given.fault("its mesh has no file", f"{GIVE_INERTIAL}, or the <mesh> a file")
    with naming(file=given.values.file, element=given.where):
        path = reach.find(mesh.file, given.values.folder, "mesh file")
    try:
        vertices, faces = read_mesh(path)
    except InputError as error:
        problem = f"the mesh file {mesh.file!r} cannot be read: {error.problem}"
        raise given.fault(problem, error.remedy) from error
    placed = (vertices - mesh.origin) @ mesh.turn * mesh.scale
    if np.prod(mesh.scale) < 0.0:
        faces = faces[:, ::-1]
    if mesh.inertia == "convex":
        from scipy.spatial import ConvexHull, QhullError

        try:
            faces = ConvexHull(placed).simplices
        except QhullError as error:
            problem = f"the points of {mesh.file!r} have no convex hull of positive volume"
            raise given.fault(problem, GIVE_INERTIAL) from error
    if mesh.inertia == "shell":
        size, centre, about = surface(placed, faces)
    else:
        size, centre, about = enclosed(placed, faces, unsigned=mesh.inertia != "exact")
    if not size > 0.0:
        raise given.fault(f"the triangles of {mesh.file!r} enclose no volume", GIVE_INERTIAL)
    return pin.Inertia(size, centre, about)


def visuals_of(geom: Geom, meshes: Mapping[str, Mesh], colours: Mapping[str, str]) -> list[Element]:
    """``<visual>`` elements of URDF; none, with a remark, for a shape that URDF does not have.

    Parameters
    ----------
    geom
        The shape.
    meshes
        Those of ``<asset>``, by name.
    colours
        Red, green, blue, opacity of the materials of ``<asset>``, by name.
    """
    given, at, (a, b, c) = geom.given, geom.placement, geom.sizes
    shapes: list[tuple[pin.SE3, str, dict[str, str]]] = []
    match geom.kind:
        case "sphere":
            shapes = [(at, "sphere", {"radius": numbers([a])})]
        case "box":
            shapes = [(at, "box", {"size": numbers([2 * a, 2 * b, 2 * c])})]
        case "cylinder" | "capsule":
            shapes = [(at, "cylinder", {"radius": numbers([a]), "length": numbers([2 * b])})]
            if geom.kind == "capsule":
                ends = [at * pin.SE3(np.eye(3), np.array([0.0, 0.0, z])) for z in (-b, b)]
                shapes += [(end, "sphere", {"radius": numbers([a])}) for end in ends]
        case "mesh" if given.text("mesh") in meshes:
            mesh = meshes[given.text("mesh")]
            own = {"filename": mesh.file, "scale": numbers(mesh.scale)}
            shapes = [(at * mesh.axes, "mesh", own)]
        case kind:
            given.values.remark(f"a geom of the type {kind} is not drawn", given.where)
    text = given.text("rgba", colours.get(given.text("material"), ""))
    rgba = given.values.numbers(text, 4, given.where, "rgba") if shapes and text else None
    return [visual(*shape, rgba) for shape in shapes]
