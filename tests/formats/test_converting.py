"""Converting: what is written is the same mechanism, whatever it was read from."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

import srm_mbs as srm
from srm_mbs.cli.app import app
from srm_mbs.dynamics.forces import ForceKinematics
from tests.formats.urdf.test_joint_types import urdf as extended_joints
from tests.formats.urdf.test_urdf_loops import (
    CASES,
    PAIR,
    SPRING,
    gazebo,
    second,
    slider_crank,
)
from tests.support import mjcf_files, sdf_files
from tests.support.dynamics import closure, mass_matrix
from tests.support.urdf_files import open_mechanism, tree

YAML = "closed_loop: [[closing_ring_1, closing_ring_2]]\ntype: [6d]\njoint_name: [hip, track]\n"

# File name, text, and files beside it.
INPUTS: dict[str, tuple[str, str, dict[str, str]]] = {
    **{case: ("robot.urdf", tree(element), {}) for case, (element, _) in CASES.items()},
    "mimic": ("robot.urdf", tree(joints={"wheel": '<mimic joint="hip" multiplier="2"/>'}), {}),
    "a second joint": ("robot.urdf", tree(second("revolute", '<dynamics damping="2"/>')), {}),
    "gazebo": ("robot.urdf", tree(gazebo("ball", "")), {}),
    "a spring": ("robot.urdf", tree(SPRING), {}),
    "onshape": ("robot.urdf", tree(PAIR), {}),
    "joint types": ("robot.urdf", extended_joints(), {}),
    "Gepetto": (
        "robot.yaml",
        YAML + "joint_type: [SPHERICAL, UJOINT_XY]\n",
        {"robot.urdf": tree(PAIR)},
    ),
    "SDF": ("robot.sdf", sdf_files.four_bar(), {}),
    "MJCF": ("robot.xml", mjcf_files.FOUR_BAR, {}),
    "a description": (
        "robot.toml",
        'format = 1\nurdf = "model/tree.urdf"\nbase = "floating"\ngravity = [0, 0, -1.6]\n'
        "friction_speed = 0.1\n[initial]\nq = { hip = 0.3 }\n[simulation]\nt_end = 3.0\n",
        {"model/tree.urdf": tree(SPRING)},
    ),
}


def prepare(folder: Path, name: str) -> Path:
    file, text, beside = INPUTS[name]
    for other, content in beside.items():
        (folder / other).parent.mkdir(exist_ok=True)
        (folder / other).write_text(content)
    (folder / file).write_text(text)
    return folder / file


def assert_same(ours: srm.Mechanism, theirs: srm.Mechanism) -> None:
    """Equal M, nonlinear effects, forces, g, G v and Gdot v at random states."""
    model = theirs.model
    assert list(ours.model.names) == list(model.names)
    assert [loop.name for loop in ours.loops] == [loop.name for loop in theirs.loops]
    assert ours.name == theirs.name
    np.testing.assert_array_equal(ours.model.damping, model.damping)
    np.testing.assert_array_equal(ours.model.friction, model.friction)
    np.testing.assert_array_equal(ours.model.gravity.linear, model.gravity.linear)
    np.testing.assert_array_equal(ours.q0, theirs.q0)
    rng = np.random.default_rng(5)
    for _ in range(3):
        q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.0, 1.0, model.nv))
        v = rng.standard_normal(model.nv)
        np.testing.assert_allclose(mass_matrix(ours.model, q), mass_matrix(model, q), atol=1e-13)
        np.testing.assert_allclose(closure(ours, q, v), closure(theirs, q, v), atol=1e-12)
        forces = []
        for mechanism in (ours, theirs):
            tree, data = mechanism.model, mechanism.model.createData()
            pin.crba(tree, data, q, pin.Convention.WORLD)
            force = pin.nonLinearEffects(tree, data, q, v).copy()
            if mechanism.forces:
                elements = ForceKinematics(tree, mechanism.forces)
                force -= elements.generalised(data, q, v, 0.0)
            forces.append(force)
        np.testing.assert_allclose(forces[0], forces[1], atol=1e-12)


@pytest.mark.parametrize("name", INPUTS)
def test_a_converted_file_is_the_same_mechanism(name: str, tmp_path: Path) -> None:
    path = prepare(tmp_path, name)
    out = tmp_path / "out"
    out.mkdir()
    description, urdf, _ = srm.convert(path, out / "converted.toml")
    assert (description, urdf) == (out / "converted.toml", out / "converted.urdf")
    assert_same(open_mechanism(description), open_mechanism(path))
    path.unlink()  # what is written stands by itself
    open_mechanism(description)


@pytest.mark.parametrize("name", ["four_bar", "n_four_bar_2"])
def test_a_bundled_mechanism_can_be_converted(name: str, tmp_path: Path) -> None:
    description, _, _ = srm.convert(name, tmp_path / "own.toml")
    assert_same(srm.load(description), srm.load(name))


def test_what_is_converted_loads_and_moves_alike(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(slider_crank())
    description, _, _ = srm.convert(tmp_path / "robot.urdf", tmp_path / "out.toml", cut=["pin"])
    mechanism = srm.load(description)
    assert mechanism.joint_names == ("a", "b", "guide")
    ours = srm.simulate(mechanism, 0.2)
    theirs = srm.simulate(srm.load(tmp_path / "robot.urdf", cut=["pin"]), 0.2)
    np.testing.assert_array_equal(ours.q, theirs.q)


def test_meshes_are_found_from_the_new_place(tmp_path: Path) -> None:
    mesh = '<visual><geometry><mesh filename="{}"/></geometry></visual></link>'
    names = ("meshes/a.stl", "package://robot/b.stl", "/somewhere/c.stl")
    urdf = tree()
    for name in names:
        urdf = urdf.replace("</link>", mesh.format(name), 1)
    (tmp_path / "robot.urdf").write_text(urdf)
    (tmp_path / "deep").mkdir()
    _, written, _ = srm.convert(tmp_path / "robot.urdf", tmp_path / "deep" / "out.toml")
    text = written.read_text()
    for name in ("../meshes/a.stl", "package://robot/b.stl", "/somewhere/c.stl"):
        assert f'"{name}"' in text


def test_tables_are_found_from_the_new_place(tmp_path: Path) -> None:
    (tmp_path / "motion.csv").write_text("t,value\n0,0\n1,0.3\n2,0.5\n3,0.6\n")
    (tmp_path / "robot.urdf").write_text(tree())
    path = tmp_path / "robot.toml"
    drive = '[[drive]]\njoint = "hip"\ntype = "table"\ntable = "motion.csv"\n'
    path.write_text(f'format = 1\nurdf = "robot.urdf"\n{drive}')
    (tmp_path / "deep").mkdir()
    description, _, _ = srm.convert(path, tmp_path / "deep" / "out.toml")
    copy = srm.load(description, allow_outside=True)
    assert copy.drives == srm.load(path).drives != ()


def test_files_that_stay_in_other_folders_are_noted(tmp_path: Path) -> None:
    mesh = '<visual><geometry><mesh filename="a.stl"/></geometry></visual></link>'
    (tmp_path / "robot.urdf").write_text(tree().replace("</link>", mesh, 1))
    (tmp_path / "deep").mkdir()
    notes = srm.convert(tmp_path / "robot.urdf", tmp_path / "deep" / "out.toml")[2]
    assert any("../a.stl" in note and "allow_outside" in note for note in notes)
    assert not any(
        "a.stl" in n for n in srm.convert(tmp_path / "robot.urdf", tmp_path / "o.toml")[2]
    )


def test_nothing_is_overwritten_unless_asked_for(tmp_path: Path) -> None:
    path = prepare(tmp_path, "a spring")
    out = tmp_path / "out.toml"
    srm.convert(path, out)
    before = out.read_text()
    for present in (out, out.with_suffix(".urdf")):
        with pytest.raises(srm.InputError, match=r"the file exists. .* force=True"):
            srm.convert(path, out)
        present.write_text("old")
    srm.convert(path, out, force=True)
    assert out.read_text() == before
    assert tomllib.loads(before)["force"][0]["type"] == "spring_damper"


def test_an_input_is_never_overwritten(tmp_path: Path) -> None:
    path = prepare(tmp_path, "a spring")
    with pytest.raises(srm.InputError, match="input of the conversion"):
        srm.convert(path, tmp_path / "robot.toml", force=True)
    assert path.read_text() == INPUTS["a spring"][1]


# --- the command ---------------------------------------------------------------------------------


def run(*args: Any) -> Any:
    return CliRunner().invoke(app, [str(arg) for arg in args])


def test_the_command_writes_and_tells_what_was_ignored(tmp_path: Path) -> None:
    path = prepare(tmp_path, "onshape")
    result = run("convert", path, tmp_path / "out.toml")
    assert result.exit_code == 0
    lines = result.output.splitlines()
    assert lines[:2] == [
        f"written: {tmp_path / 'out.toml'}",
        f"written: {tmp_path / 'out.urdf'}",
    ]
    assert lines[2].startswith("note: 'closing_ring' joins the origins")


def test_the_command_takes_joints_to_cut(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(slider_crank())
    result = run("convert", tmp_path / "robot.urdf", tmp_path / "out.toml", "--cut", "pin")
    assert result.exit_code == 0
    assert [
        loop["name"] for loop in tomllib.loads((tmp_path / "out.toml").read_text())["loop"]
    ] == ["pin"]


@pytest.mark.parametrize(
    ("source", "out", "needle"),
    [
        ("robot.urdf", "out.txt", ".toml"),
        ("robot.urdf", "none/out.toml", "none'. Make it first"),
        ("missing.urdf", "out.toml", "no such file"),
        ("robot.urdf", "there.toml", "exists"),
    ],
)
def test_what_cannot_be_converted_has_status_2(
    source: str, out: str, needle: str, tmp_path: Path
) -> None:
    prepare(tmp_path, "a spring")
    (tmp_path / "there.toml").write_text("")
    result = run("convert", tmp_path / source, tmp_path / out)
    assert result.exit_code == 2
    assert needle in result.output
    assert "Traceback" not in result.output
