"""Triangles of STL, OBJ, COLLADA and MSH files, read by no importer, and inertia of solids.

Only positions and faces are read: materials and textures, which name other files, are skipped.
Polygons become fans of triangles about their first corner, except that a polygon that such a fan
would leave is cut ear by ear.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, naming
from srm_mbs.formats.files import read_bytes, shortened
from srm_mbs.formats.xml import local_name, parse_xml

SUFFIXES = (".stl", ".obj", ".dae", ".msh")
KNOWN = "Give an STL, OBJ, DAE or MSH file"
LARGEST_MESH = 128 * 10**6
"""Bytes of a mesh file."""
MOST_TRIANGLES = 4 * 10**6
LARGEST_COORDINATE = 1e9
"""Magnitude of a coordinate, in the units of the file."""
NODE_DEPTH = 100
"""Depth of nodes of COLLADA that instantiate each other."""
MOST_INSTANCES = 10_000
"""Nodes and geometries that the scene of a COLLADA file instantiates."""
MSH_HEADER = 16
"""Bytes of an MSH file before its vertices."""
STL_HEADER, STL_TRIANGLE = 84, 50
"""Bytes of a binary STL before its triangles, and of each triangle."""

Triangles = tuple[FloatArray, Any]
"""Vertices (n, 3) and indices of the corners of faces (k, 3)."""


def read_mesh(path: Path) -> Triangles:
    """Vertices (n, 3), m, and faces (k, 3), indices, of the mesh in the file ``path``.

    The unit that a COLLADA file declares is applied; the axis that it declares to point up is not,
    as in other programs that read URDF.

    Raises
    ------
    InputError
        If it is none of these formats, by suffix and by content, is damaged, or has no triangles.
    """
    suffix = path.suffix.lower()
    with naming(file=str(path)):
        if suffix not in SUFFIXES:
            raise InputError(f"meshes of type {suffix[:12]!r} are not read", remedy=KNOWN)
        content = read_bytes(path, LARGEST_MESH)
        try:
            with np.errstate(all="ignore"):  # infinite coordinates are refused below
                vertices, faces = READERS[suffix](content)
        except (ValueError, IndexError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"it is not a mesh of type {suffix!r}: {shortened(str(error))}", remedy=KNOWN
            ) from error
        return _checked(vertices, faces)


def _checked(vertices: FloatArray, faces: Any) -> Triangles:
    if not len(faces):
        raise InputError("it holds no triangles", remedy="Give a mesh with triangles")
    if len(faces) > MOST_TRIANGLES:
        raise InputError(
            f"it has more than {MOST_TRIANGLES} triangles", remedy="Give one with fewer"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError("a face names a vertex that is not there", remedy=KNOWN)
    if not (np.abs(vertices) <= LARGEST_COORDINATE).all():
        raise InputError("a coordinate is not finite or too large", remedy="Correct the mesh")
    return vertices, faces.astype(np.uint32)


# STL ------------------------------------------------------------------------------------------


def _stl(content: bytes) -> Triangles:
    if len(content) >= STL_HEADER:
        count = int.from_bytes(content[STL_HEADER - 4 : STL_HEADER], "little")
        if len(content) == STL_HEADER + STL_TRIANGLE * count:
            return _binary_stl(content, count)
    if b"\0" in content or not content[:512].lstrip().lower().startswith(b"solid"):
        raise ValueError("its size does not agree with its number of triangles")
    words = content.lstrip().partition(b"\n")[2].lower().split()  # the first line has the name
    found = [words[k + 1 : k + 4] for k, word in enumerate(words) if word == b"vertex"]
    if len(found) % 3:
        raise ValueError(f"{len(found)} vertices make no triangles")
    return _merged(np.array(found, dtype=float).reshape(len(found), 3))


def _binary_stl(content: bytes, count: int) -> Triangles:
    layout = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles = np.frombuffer(content, layout, count, STL_HEADER)
    return _merged(triangles["corners"].reshape(-1, 3).astype(float))


def _merged(corners: FloatArray) -> Triangles:
    """The triangles of ``corners`` (3 k, 3), whose equal corners become one vertex."""
    if not len(corners):
        return corners, np.zeros((0, 3), dtype=np.int64)
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    return vertices, faces.reshape(-1, 3)


# MSH ------------------------------------------------------------------------------------------


def _msh(content: bytes) -> Triangles:
    """MuJoCo's binary format: the numbers of vertices, normals, texture coordinates and faces, then
    these."""
    if len(content) < MSH_HEADER:
        raise ValueError("it has no header")
    counts = np.frombuffer(content, "<i4", 4).astype(np.int64)
    vertices, normals, textured, faces = (int(count) for count in counts)
    numbers = 3 * vertices + 3 * normals + 2 * textured + 3 * faces
    if counts.min() < 0 or len(content) != MSH_HEADER + 4 * numbers:
        raise ValueError("its size does not agree with its numbers of vertices and faces")
    places = np.frombuffer(content, "<f4", 3 * vertices, MSH_HEADER).astype(float)
    corners = np.frombuffer(content, "<i4", 3 * faces, len(content) - 12 * faces)
    return places.reshape(-1, 3), corners.reshape(-1, 3).astype(np.int64)


# OBJ ------------------------------------------------------------------------------------------


def _obj(content: bytes) -> Triangles:
    if b"\0" in content:
        raise ValueError("it holds zero bytes")
    content = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    lines = content.splitlines()
    vertices = np.array(
        [line.split(None, 4)[1:4] for line in lines if _keyword(line) == b"v"], dtype=float
    ).reshape(-1, 3)
    before = np.cumsum([_keyword(line) == b"v" for line in lines]) if lines else np.zeros(0, int)
    polygons = []
    for line, count in zip(lines, before.tolist()):
        if _keyword(line) == b"f":
            indices = [int(corner.partition(b"/")[0]) for corner in line.split()[1:]]
            if len(indices) < 3:
                continue
            if not all(indices):
                raise ValueError("a face names the vertex 0")
            polygons.append([i - 1 if i > 0 else count + i for i in indices])
    return vertices, _triangulated(vertices, polygons)


def _keyword(line: bytes) -> bytes:
    head = line[:8].split(None, 1)
    return head[0] if head else b""


# Polygons -------------------------------------------------------------------------------------


def _triangulated(vertices: FloatArray, polygons: Sequence[Sequence[int]]) -> Any:
    """Triangles (k, 3) of polygons, each given by the indices of its corners."""
    sizes = {len(polygon) for polygon in polygons}
    if sizes == {3}:
        return np.array(polygons, dtype=np.int64)
    out: list[Sequence[int]] = []
    for polygon in polygons:
        if len(polygon) == 3:
            out.append(polygon)
        elif min(polygon) < 0 or max(polygon) >= len(vertices):
            raise ValueError("a face names a vertex that is not there")
        else:
            out.extend(_cut(vertices[list(polygon)], polygon))
        if len(out) > MOST_TRIANGLES:
            break
    return np.array(out, dtype=np.int64).reshape(-1, 3)


LARGEST_CONCAVE = 300
"""Corners of a polygon that is cut ear by ear, whose time grows as their cube."""


def _cut(corners: FloatArray, polygon: Sequence[int]) -> list[Sequence[int]]:
    """Triangles of one polygon with ``corners`` (n, 3)."""
    fan: list[Sequence[int]] = [(polygon[0], b, c) for b, c in pairwise(polygon[1:])]
    edges = corners - corners[0]
    normals = np.cross(edges[1:-1], edges[2:])
    normal = normals.sum(axis=0)
    if (normals @ normal >= 0.0).all() or len(polygon) > LARGEST_CONCAVE:
        return fan
    axis = int(np.argmax(np.abs(normal)))
    flat = np.delete(corners, axis, axis=1)
    area = np.roll(flat[:, 1], -1) @ flat[:, 0] - np.roll(flat[:, 0], -1) @ flat[:, 1]
    if area < 0.0:
        flat = flat * [1.0, -1.0]
    left = list(range(len(polygon)))
    out: list[Sequence[int]] = []
    while len(left) > 3:
        ear = next((k for k in range(len(left)) if _is_ear(flat, left, k)), None)
        if ear is None:  # it crosses itself
            return fan
        out.append(tuple(polygon[left[k % len(left)]] for k in (ear - 1, ear, ear + 1)))
        del left[ear]
    return [*out, tuple(polygon[k] for k in left)]


def _is_ear(flat: FloatArray, left: list[int], k: int) -> bool:
    """Whether the corner ``k`` of the polygon ``left`` can be cut off; ``flat`` (n, 2)."""
    triangle = flat[[left[k - 1], left[k], left[(k + 1) % len(left)]]]
    sides = np.roll(triangle, -1, axis=0) - triangle
    if sides[0, 0] * sides[1, 1] - sides[0, 1] * sides[1, 0] <= 0.0:
        return False
    others = flat[
        [i for j, i in enumerate(left) if (j - k) % len(left) not in (0, 1, len(left) - 1)]
    ]
    offsets = others[:, None] - triangle
    return not (sides[:, 0] * offsets[..., 1] - sides[:, 1] * offsets[..., 0] > 0.0).all(1).any()


# COLLADA --------------------------------------------------------------------------------------


def _dae(content: bytes) -> Triangles:
    text = content.decode("utf-8-sig", errors="strict")
    root = parse_xml(text, "")
    if local_name(root) != "COLLADA":
        raise ValueError(f"its root element is <{local_name(root)[:40]}>")
    return _Collada(root).triangles()


class _Collada:
    """The geometries of a COLLADA file, placed as its scene says."""

    def __init__(self, root: Element) -> None:
        self.root = root
        self.by_id = {node.get("id"): node for node in root.iter() if node.get("id")}
        self.instances = 0

    def triangles(self) -> Triangles:
        """All of them in metres, in the axes of the file."""
        vertices, faces, count = [], [], 0
        for own, corners in self._scene():
            vertices.append(own)
            faces.append(corners + count)
            count += len(own)
        if not faces:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        unit = self.root.find("{*}asset/{*}unit")
        metre = float("1" if unit is None else unit.get("meter", "1"))
        return metre * np.concatenate(vertices), np.concatenate(faces)

    def _target(self, node: Element | None, key: str = "url") -> Element | None:
        """The element of this file that ``node`` refers to; those of other files are skipped."""
        name = "" if node is None else node.get(key, "")
        return self.by_id.get(name[1:]) if name.startswith("#") else None

    def _scene(self) -> Iterator[Triangles]:
        scene = self._target(self.root.find("{*}scene/{*}instance_visual_scene"))
        if scene is None:
            raise ValueError("it has no scene")
        for node in scene.findall("{*}node"):
            yield from self._node(node, np.eye(4), 0)

    def _node(self, node: Element, around: FloatArray, depth: int) -> Iterator[Triangles]:
        self.instances += 1
        if depth > NODE_DEPTH or self.instances > MOST_INSTANCES:
            raise ValueError("its scene instantiates too many nodes")
        here = around
        for child in node:
            make = TRANSFORMS.get(local_name(child))
            if make is not None:
                here = here @ make(_floats(child))
        for child in node:
            tag = local_name(child)
            if tag == "node":
                yield from self._node(child, here, depth + 1)
            elif tag == "instance_node" and (target := self._target(child)) is not None:
                yield from self._node(target, here, depth + 1)
            elif tag in ("instance_geometry", "instance_controller"):
                geometry = self._target(child)
                if geometry is not None and tag == "instance_controller":
                    geometry = self._target(geometry.find("{*}skin"), "source")
                if geometry is not None:
                    yield from self._geometry(geometry, here)

    def _geometry(self, geometry: Element, placed: FloatArray) -> Iterator[Triangles]:
        self.instances += 1
        mesh = geometry.find("{*}mesh")
        for part in () if mesh is None else mesh:
            read = PRIMITIVES.get(local_name(part))
            if read is None:
                continue
            vertex = next(
                (i for i in part.findall("{*}input") if i.get("semantic") == "VERTEX"), None
            )
            if vertex is None:
                raise ValueError("a primitive has no vertices")
            vertices = self._positions(vertex) @ placed[:3, :3].T + placed[:3, 3]
            stride = 1 + max(int(i.get("offset", "0")) for i in part.findall("{*}input"))
            offset = int(vertex.get("offset", "0"))
            if not 0 <= offset < stride <= 100:
                raise ValueError("an offset of a primitive is wrong")
            polygons = read(part, lambda p, k=offset, n=stride: _integers(p)[k::n])  # type: ignore[misc]
            yield vertices, _triangulated(vertices, polygons)

    def _positions(self, vertex: Element) -> FloatArray:
        vertices = self._target(vertex, "source")
        inputs = [] if vertices is None else vertices.findall("{*}input")
        position = next((i for i in inputs if i.get("semantic") == "POSITION"), None)
        source = self._target(position, "source")
        accessor = None if source is None else source.find("{*}technique_common/{*}accessor")
        array = None if source is None else source.find("{*}float_array")
        if accessor is None or array is None:
            raise ValueError("a geometry has no positions")
        count, stride = int(accessor.get("count", "0")), int(accessor.get("stride", "3"))
        start = int(accessor.get("offset", "0"))
        values = _floats(array)
        if stride < 3 or start < 0 or count < 0 or start + stride * count > len(values):
            raise ValueError("its positions are fewer than it says")
        return values[start : start + stride * count].reshape(count, stride)[:, :3]


def _floats(node: Element) -> FloatArray:
    return np.array((node.text or "").split(), dtype=float)


def _integers(node: Element) -> list[int]:
    return [int(word) for word in (node.text or "").split()]


def _matrix(values: FloatArray) -> FloatArray:
    return values.reshape(4, 4)


def _translation(values: FloatArray) -> FloatArray:
    out = np.eye(4)
    out[:3, 3] = values.reshape(3)
    return out


def _scale(values: FloatArray) -> FloatArray:
    return np.diag([*values.reshape(3), 1.0])


def _rotation(values: FloatArray) -> FloatArray:
    x, y, z, degrees = values.reshape(4)
    length = float(np.linalg.norm([x, y, z]))
    out = np.eye(4)
    if length > 0.0:
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) / length
        angle = np.deg2rad(degrees)
        out[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return out


def _refused_transform(values: FloatArray) -> FloatArray:
    raise ValueError("<lookat> and <skew> are not read")


TRANSFORMS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "matrix": _matrix,
    "translate": _translation,
    "rotate": _rotation,
    "scale": _scale,
    "lookat": _refused_transform,
    "skew": _refused_transform,
}

Polygons = Any
"""Lists of the indices of corners."""
Corners = Callable[[Element], list[int]]


def _triangles(part: Element, corners: Corners) -> Polygons:
    found = [corner for p in part.findall("{*}p") for corner in corners(p)]
    return np.array(found, dtype=np.int64).reshape(-1, 3)


def _polylist(part: Element, corners: Corners) -> Polygons:
    found = [corner for p in part.findall("{*}p") for corner in corners(p)]
    counts = part.find("{*}vcount")
    ends = np.cumsum([] if counts is None else _integers(counts)).astype(int).tolist()
    if ends and (ends[-1] > len(found) or min(np.diff([0, *ends])) < 0):
        raise ValueError("a polygon has more corners than are given")
    return [found[a:b] for a, b in zip([0, *ends], ends) if b - a > 2]


def _polygons(part: Element, corners: Corners) -> Polygons:
    paths = [*part.findall("{*}p"), *part.findall("{*}ph/{*}p")]
    return [polygon for p in paths if len(polygon := corners(p)) > 2]


def _strips(part: Element, corners: Corners) -> Polygons:
    out = []
    for p in part.findall("{*}p"):
        strip = corners(p)
        for k, (a, b, c) in enumerate(zip(strip, strip[1:], strip[2:])):
            out.append((b, a, c) if k % 2 else (a, b, c))
    return out


def _fans(part: Element, corners: Corners) -> Polygons:
    return [
        (fan[0], b, c)
        for p in part.findall("{*}p")
        for fan in [corners(p)]
        for b, c in pairwise(fan[1:])
    ]


PRIMITIVES: dict[str, Callable[[Element, Corners], Polygons]] = {
    "triangles": _triangles,
    "polylist": _polylist,
    "polygons": _polygons,
    "tristrips": _strips,
    "trifans": _fans,
}

READERS: dict[str, Callable[[bytes], Triangles]] = {
    ".stl": _stl,
    ".obj": _obj,
    ".dae": _dae,
    ".msh": _msh,
}


def solid(kind: str, sizes: FloatArray) -> tuple[float, FloatArray]:
    """Volume (m^3) of a solid shape, and moments per mass (3,) m^2 about its centre.

    ``sizes`` (3,) m are radii and half lengths: of a ``sphere`` the radius; of a ``cylinder`` and a
    ``capsule`` along z the radius and half the length, of the capsule without its ends; of a
    ``box`` and an ``ellipsoid`` the halves along x, y and z.
    """
    a, b, c = sizes
    match kind:
        case "sphere":
            return 4.0 / 3.0 * math.pi * a**3, np.full(3, 0.4 * a**2)
        case "ellipsoid":
            squares = np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2])
            return 4.0 / 3.0 * math.pi * a * b * c, squares / 5.0
        case "box":
            squares = np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2])
            return 8.0 * a * b * c, squares / 3.0
        case "cylinder":
            across = (3.0 * a**2 + 4.0 * b**2) / 12.0
            return 2.0 * math.pi * a**2 * b, np.array([across, across, 0.5 * a**2])
        case _:  # a capsule: a cylinder of half length b between two half balls
            middle, ends = 2.0 * math.pi * a**2 * b, 4.0 / 3.0 * math.pi * a**3
            volume = middle + ends
            # A half ball's centre is 3 a/8 from its flat side.
            apart = 0.4 * a**2 + b**2 + 0.75 * a * b
            across = middle * (3.0 * a**2 + 4.0 * b**2) / 12.0 + ends * apart
            axial = middle * 0.5 * a**2 + ends * 0.4 * a**2
            return volume, np.array([across, across, axial]) / volume


def enclosed(
    vertices: FloatArray, faces: Any, unsigned: bool = False
) -> tuple[float, FloatArray, FloatArray]:
    """Volume (m^3), centroid (3,) m, and moments of inertia (3, 3) m^5 about it at unit density of
    the solid that triangles enclose, whose corners run counterclockwise as seen from outside.

    Sums over the tetrahedra of a triangle and one point, first the centroid of the surface, then
    that of the solid.  With ``unsigned`` every tetrahedron counts as positive: the same for a
    surface that every ray from these points meets once, whichever way its corners run.
    """
    corners = vertices[faces]

    def tetrahedra(point: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Their corners seen from ``point``, their volumes, and the sum of these."""
        seen = corners - point
        volumes = np.linalg.det(seen) / 6.0
        if unsigned:
            volumes = np.abs(volumes)
        return seen, volumes, float(volumes.sum())

    area, point, _ = surface(vertices, faces)
    seen, volumes, volume = tetrahedra(point)
    if not (area > 0.0 and abs(volume) > 0.0):
        return 0.0, np.zeros(3), np.zeros((3, 3))
    centre = point + volumes @ seen.sum(axis=1) / (4.0 * volume)
    seen, volumes, volume = tetrahedra(centre)
    # Of x x^T over a tetrahedron: V/20 (sum of c c^T over its corners + s s^T), one in the origin.
    return volume, centre, _moments(seen, volumes / 20.0)


def surface(vertices: FloatArray, faces: Any) -> tuple[float, FloatArray, FloatArray]:
    """Area (m^2), centroid (3,) m, and moments of inertia (3, 3) m^4 about it at unit density of
    the triangles themselves."""
    corners = vertices[faces]
    edges = np.diff(corners, axis=1)
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    area = float(areas.sum())
    if not area > 0.0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    centre = areas @ corners.mean(axis=1) / area
    # Of x x^T over a triangle: A/12 (sum of c c^T over its corners + s s^T).
    return area, centre, _moments(corners - centre, areas / 12.0)


def _moments(corners: FloatArray, weights: FloatArray) -> FloatArray:
    """Moments (3, 3) of sum_k w_k (sum of c c^T over corners (k, 3, 3) + s s^T, s their sum)."""
    sums = corners.sum(axis=1)
    second = np.einsum("k,kia,kib->ab", weights, corners, corners)
    second += np.einsum("k,ka,kb->ab", weights, sums, sums)
    moments: FloatArray = np.trace(second) * np.eye(3) - second
    return moments
