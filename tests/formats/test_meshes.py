"""Meshes: what is read, as what, and what is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pinocchio as pin  # noqa: F401 - its converters are those of coal
import pytest

import srm_mbs as srm
from srm_mbs.formats.meshes import enclosed, read_mesh
from tests.support.sdf_files import cassie

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
"""A tetrahedron of volume 1, seen counterclockwise from outside."""
NUMBERS = " ".join(f"{x:g}" for x in CORNERS.ravel())
DAE = f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.1"/><up_axis>Y_UP</up_axis></asset>
<library_images><image id="i"><init_from>../secret.png</init_from></image></library_images>
<library_geometries><geometry id="g"><mesh>
<source id="s"><float_array id="a" count="12">{NUMBERS}</float_array><technique_common>
<accessor source="#a" count="4" stride="3"/></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices>{{primitive}}
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node>{{place}}
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#w"/></scene></COLLADA>"""
INPUT = '<input semantic="VERTEX" source="#v" offset="{}"/>'
INDICES = " ".join(str(k) for face in FACES for k in face)
TRIANGLES = f"<triangles count='4'>{INPUT.format(0)}<p>{INDICES}</p></triangles>"


def dae(primitive: str = TRIANGLES, place: str = "") -> str:
    return DAE.format(primitive=primitive, place=place)


def binary_stl() -> bytes:
    triangles = (struct.pack("<12fH", 0, 0, 0, *CORNERS[list(face)].ravel(), 0) for face in FACES)
    return b"solid, but binary".ljust(80) + struct.pack("<I", 4) + b"".join(triangles)


def msh() -> bytes:
    """With four normals and texture coordinates, which are skipped."""
    counts = np.array([4, 4, 4, 4], "<i4").tobytes()
    return (
        counts
        + CORNERS.astype("<f4").tobytes()
        + np.ones(4 * 5, "<f4").tobytes()
        + np.array(FACES, "<i4").tobytes()
    )


def ascii_stl() -> str:
    facets = (
        "facet normal 0 0 0\n outer loop\n"
        + "".join(f"  vertex {x:g} {y:e} {z:g}\n" for x, y, z in CORNERS[list(face)])
        + " endloop\nendfacet\n"
        for face in FACES
    )
    return "solid of vertex groups\n" + "".join(facets) + "endsolid\n"


def obj(faces: str) -> str:
    vertices = "".join(f"v {x:g} {y:g} {z:g} 0.5 0.5 0.5\n" for x, y, z in CORNERS)
    return f"mtllib /etc/passwd\nvn 0 0 1\nvt 0 0\n{vertices}usemtl stone\n{faces}"


TETRAHEDRA: dict[str, tuple[str, str | bytes]] = {
    "MSH": ("a.msh", msh()),
    "binary STL": ("a.stl", binary_stl()),
    "ASCII STL": ("a.STL", ascii_stl()),
    "OBJ": ("a.obj", obj("f 1 3 2\nf 1//1 2//1 4//1\nf 1/1 4/1 3/1\nf 2/1/1 3/1/1 \\\n4/1/1\n")),
    "OBJ, counted from the end": ("a.obj", obj("f -4 -2 -3\nf -4 -3 -1\nf -4 -1 -2\nf -3 -2 -1\n")),
    "DAE": ("a.dae", dae(place="<scale>10 10 10</scale>")),
    "DAE, polygons": (
        "a.dae",
        dae(
            f"<polylist count='4'>{INPUT.format(1)}<input semantic='NORMAL' offset='0'/>"
            f"<vcount>3 3 3 3</vcount><p>9 {INDICES.replace(' ', ' 9 ')}</p></polylist>",
            "<matrix>0 -10 0 0 10 0 0 0 0 0 10 0 0 0 0 1</matrix><rotate>0 0 1 -90</rotate>",
        ),
    ),
}


@pytest.mark.parametrize("case", TETRAHEDRA)
def test_a_tetrahedron_is_read(case: str, tmp_path: Path) -> None:
    name, content = TETRAHEDRA[case]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    vertices, faces = read_mesh(tmp_path / name)
    assert len(faces) == 4
    volume, centre, about = enclosed(vertices, faces)
    np.testing.assert_allclose(volume, 1.0)
    np.testing.assert_allclose(centre, CORNERS.mean(axis=0), atol=1e-12)
    # Of a tetrahedron: V/80 of the sum of squares of 4 corner coordinates for one in the origin.
    second = np.diag([1.0, 4.0, 9.0]) / 10.0 - np.outer([1, 2, 3], [1, 2, 3]) / 16.0
    second += (np.outer([1, 2, 3], [1, 2, 3]) - np.diag([1.0, 4.0, 9.0])) / 20.0
    np.testing.assert_allclose(about, np.trace(second) * np.eye(3) - second, atol=1e-12)


def test_a_mesh_of_a_robot_is_that_of_another_reader(tmp_path: Path) -> None:
    import coal  # type: ignore[import-untyped]

    path = cassie("cassie").parents[1] / "meshes" / "knee.stl"
    vertices, faces = read_mesh(path)
    other = coal.MeshLoader().load(str(path), np.ones(3))
    assert len(faces) == other.num_tris
    volume, centre, about = enclosed(vertices, faces)
    np.testing.assert_allclose(volume, other.computeVolume(), rtol=1e-5)
    np.testing.assert_allclose(centre, np.array(other.computeCOM()), atol=1e-6)
    expected = np.array(other.computeMomentofInertiaRelatedToCOM())
    np.testing.assert_allclose(about, expected, atol=1e-5 * np.abs(expected).max())


def test_a_concave_polygon_is_cut_inside(tmp_path: Path) -> None:
    corners = [(0, 0), (4, 0), (4, 4), (2, 1), (0, 4)]  # a fan about the first would leave it
    text = "".join(f"v {x} {y} 0\n" for x, y in corners) + "f 2 3 4 5 1\n"
    (tmp_path / "a.obj").write_text(text)
    vertices, faces = read_mesh(tmp_path / "a.obj")
    sides = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    areas = 0.5 * np.cross(sides[:, 0], sides[:, 1])[:, 2]
    assert (areas > 0.0).all()
    np.testing.assert_allclose(areas.sum(), 10.0)


CYCLE = '<instance_node url="#w"/>'
REFUSED: dict[str, tuple[str, str | bytes, str]] = {
    "glTF": ("a.gltf", "{}", "'.gltf' are not read"),
    "glTF named as OBJ": ("a.obj", '{"buffers": [{"uri": "secret"}]}', "no triangles"),
    "no suffix": ("a", "v 0 0 0", "are not read"),
    "MSH that is too short": ("a.msh", msh()[:-1], "not a mesh of type"),
    "MSH with negative numbers": ("a.msh", np.array([4, -1, 0, 3], "<i4").tobytes(), "not a mesh"),
    "text as STL": ("a.stl", "ssh-rsa AAAA", "not a mesh of type"),
    "STL that is too short": ("a.stl", binary_stl()[:-1], "not a mesh of type"),
    "STL with half a triangle": ("a.stl", "solid\nvertex 1 2 3\nvertex 1 2 3\n", "no triangles"),
    "not a number": ("a.stl", ascii_stl().replace("vertex 1", "vertex nan"), "not finite"),
    "OBJ with a face too many": ("a.obj", obj("f 1 2 9\n"), "not there"),
    "OBJ with vertex 0": ("a.obj", obj("f 0 1 2\n"), "vertex 0"),
    "OBJ of bytes": ("a.obj", b"v 0 0 0\0", "not a mesh of type"),
    "XML that is no COLLADA": ("a.dae", "<robot/>", "its root element is <robot>"),
    "DAE with entities": ("a.dae", "<!DOCTYPE a [<!ENTITY b 'c'>]><COLLADA/>", "entities"),
    "DAE without a scene": ("a.dae", "<COLLADA/>", "no scene"),
    "DAE that instantiates itself": ("a.dae", dae(place=CYCLE.replace("#w", "#n")), "no triangles"),
    "DAE with a wrong index": ("a.dae", dae(TRIANGLES.replace("0 2 1", "0 2 7")), "not there"),
    "DAE with a wrong offset": ("a.dae", dae(TRIANGLES.replace('"0"', '"-3"')), "offset"),
    "DAE with a wrong count": ("a.dae", dae().replace('count="4" s', 'count="9" s'), "fewer"),
}
REFUSED["DAE that instantiates itself"] = (
    "a.dae",
    dae(place=CYCLE.replace("#w", "#n")).replace("<node>", '<node id="n">'),
    "too many",
)


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_mesh_is_refused(case: str, tmp_path: Path) -> None:
    name, content, says = REFUSED[case]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(srm.InputError, match=says) as caught:
        read_mesh(tmp_path / name)
    assert caught.value.file == str(tmp_path / name)
    assert "AAAA" not in str(caught.value)
