"""Bytes of model files and meshes, damaged at random: each file is read, or refused with an
InputError; no other exception, no crash."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.formats.csv_table import read_csv
from srm_mbs.formats.meshes import read_mesh
from tests.formats.test_meshes import ascii_stl, binary_stl, dae, obj
from tests.stress.isolation import fault_of, load_isolated
from tests.support.mjcf_files import FOUR_BAR
from tests.support.sdf_files import four_bar
from tests.support.urdf_files import tree

pytestmark = pytest.mark.stress

MODELS, PARTS = 400, 1500
"""Mutations of each model file, and of each mesh and table."""
TOKENS = [
    *(b"\0", b"\xff", b"\xef\xbb\xbf", b"<", b">", b'"', b"'", b"&", b"&#0;", b"&#x202e;", b"]]>"),
    *(
        b"<!--",
        b"<![CDATA[",
        b"<?xml?>",
        b"xmlns='x'",
        b"a:b='1'",
        b"nan",
        b"-inf",
        b"1e999",
        b"-0",
    ),
    *(
        b"[",
        b"]",
        b"{",
        b"}",
        b"=",
        b".",
        b",",
        b"\n",
        b"\r",
        b"\t",
        b"#",
        b"-1",
        b"99999999999999",
    ),
    *(b"1" * 5000, "\u202e".encode(), "\U0001f916".encode(), b"\\u0000", b"!!python/object:x"),
]
DESCRIPTION = """format = 1
urdf = "good.urdf"
[[loop]]
name = "ring"
type = "point"
a = { link = "shin", xyz = [0.1, 0.2, 0.3] }
b = { link = "rim" }
[[force]]
type = "torque"
joint = "hip"
torque = 1.0
[initial]
q = { hip = 0.1 }
guess = { knee = 0.2 }
"""
GEPETTO = "joint_name: [hip, knee]\njoint_type: [SPHERICAL, FIXED]\nname_mot: [knee]\n"
FILES = {
    "robot.urdf": tree(joints={"wheel": '<mimic joint="hip" multiplier="2"/>'}),
    "tree.urdf": tree(),
    "robot.toml": DESCRIPTION,
    "robot.sdf": four_bar(),
    "robot.xml": FOUR_BAR,
    "good.yaml": GEPETTO,
}


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """``content`` after one to three changes at random places."""
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(content) + 1))
        length = int(rng.choice([1, 2, 5, 20, 200]))
        other = int(rng.integers(len(content) + 1))
        match rng.integers(5):
            case 0:
                content = content[:at] + content[at + length :]
            case 1:
                content = content[:at] + TOKENS[rng.integers(len(TOKENS))] + content[at:]
            case 2:
                content = content[:at] + content[other : other + length] + content[at:]
            case 3:
                content = content[:at] + rng.bytes(length) + content[at + length :]
            case _:
                content = content[:at] if rng.random() < 0.3 else content[:at] * 2 + content[at:]
    return content


@pytest.mark.parametrize("name", FILES)
def test_a_damaged_model_file_is_read_or_refused(name: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(len(name))
    paths = []
    for k in range(MODELS):
        folder = tmp_path / str(k)
        folder.mkdir()
        if name in ("robot.toml", "good.yaml"):
            (folder / "good.urdf").write_text(tree())
        (folder / name).write_bytes(damaged(FILES[name].encode(), rng))
        paths.append(str(folder / name))
    outcomes = load_isolated(paths)
    faults = {path: fault_of(got) for path, got in outcomes.items()}
    assert not {path: fault for path, fault in faults.items() if fault}
    assert {got["is"] for got in outcomes.values()} == {"loaded", "refused"}


PARTS_OF_MODELS: dict[str, tuple[bytes, Callable[[Path], object]]] = {
    "a.stl": (binary_stl(), read_mesh),
    "b.stl": (ascii_stl().encode(), read_mesh),
    "a.obj": (obj("f 1 3 2\nf 1 2 4\nf 1 4 3 2\n").encode(), read_mesh),
    "a.dae": (dae().encode(), read_mesh),
    "a.csv": (b't,value\n0,1\n"1",2\n2,3\n\n3,4\n', lambda path: read_csv(path).columns(["t"])),
    "b.csv": (b"t,value\n0,1\n1,2\n2,3\n3,4\n", lambda path: read_csv(path).columns(["t"])),
}


@pytest.mark.parametrize("name", PARTS_OF_MODELS)
def test_a_damaged_mesh_or_table_is_read_or_refused(name: str, tmp_path: Path) -> None:
    content, read = PARTS_OF_MODELS[name]
    rng = np.random.default_rng(len(content))
    files = []
    for _ in range(PARTS):
        (tmp_path / name).write_bytes(damaged(content, rng))
        try:
            read(tmp_path / name)
        except srm.InputError as error:
            files.append(error.file)
    assert set(files) == {str(tmp_path / name)}
    assert len(files) < PARTS
