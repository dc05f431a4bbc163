"""Files that the file of a mechanism may name."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import srm_mbs as srm
from srm_mbs.cli.app import app
from srm_mbs.formats.load import models_folder
from srm_mbs.model.reach import Reach
from srm_mbs.visualization.animation.shapes import Mesh, visuals_of
from tests.support.urdf_files import tree

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
VISUAL = '<visual><geometry><mesh filename="{}"/></geometry></visual></link>'


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for a model, beside one with a mesh, ``other/a.obj``."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for folder in ("model", "other"):
        (tmp_path / folder).mkdir()
    (tmp_path / "other" / "a.obj").write_text(TETRAHEDRON)
    return tmp_path / "model"


def drawn(mechanism: srm.Mechanism) -> bool:
    """Whether the mechanism is drawn with its mesh."""
    return any(isinstance(visual.shape, Mesh) for visual in visuals_of(mechanism))


def robot(model: Path, mesh: str) -> Path:
    path = model / "robot.urdf"
    path.write_text(tree().replace("</link>", VISUAL.format(mesh), 1))
    return path


def test_a_mesh_outside_is_drawn_only_if_the_caller_allows_it(
    model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("../other/a.obj", str(model.parent / "other" / "a.obj"), "package://other/a.obj"):
        path = robot(model, name)
        assert not drawn(srm.load(path))
        assert "allow_outside=True (--allow-outside)" in caplog.text
        caplog.clear()
        assert drawn(srm.load(path, allow_outside=True))
        assert drawn(srm.load(path, mesh_dirs=[model.parent / "other"]))
        assert drawn(srm.load(path, mesh_dirs=str(model.parent / "other")))
        caplog.clear()


def test_a_symbolic_link_does_not_lead_outside(model: Path) -> None:
    (model / "a.obj").symlink_to(model.parent / "other" / "a.obj")
    path = robot(model, "a.obj")
    assert not drawn(srm.load(path))
    assert drawn(srm.load(path, allow_outside=True))


@pytest.mark.parametrize(("own", "rest"), [("a.obj", ["coupler", "rocker"]), ("gone.obj", [])])
def test_one_warning_sums_up_missing_meshes_and_bars_stand_for_their_links(
    own: str, rest: list[str], model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (model / "a.obj").write_text(TETRAHEDRON)
    urdf = (models_folder().parent / "urdf" / "four_bar.urdf").read_text()
    missing = VISUAL.format("package://gone/bar.obj").removesuffix("</link>")
    urdf = re.sub("(<visual>.*?</visual>\\s*)+", missing, urdf, flags=re.DOTALL)
    crank = urdf.index("bar.obj", urdf.index('link name="crank"'))
    (model / "robot.urdf").write_text(
        urdf[:crank].removesuffix("package://gone/") + own + urdf[crank + 7 :]
    )
    tables = (models_folder() / "four_bar.toml").read_text()
    (model / "robot.toml").write_text(tables.replace("../urdf/four_bar", "robot"))
    mechanism = srm.load(model / "robot.toml", mesh_dirs=[model.parent / "other"])
    names = ["world", *mechanism.joint_names]
    visuals = visuals_of(mechanism)
    assert {names[v.joint] for v in visuals if isinstance(v.shape, Mesh)} == (
        {"crank"} if rest else set()
    )
    bars = {names[v.joint] for v in visuals if not isinstance(v.shape, Mesh)}
    assert bars == {"world", *(rest or mechanism.joint_names)}
    (record,) = caplog.records
    said = record.getMessage()
    gone = 3 if rest else 4
    assert said.startswith(f"{gone} of 4 visuals are not drawn, of the links 'world', ")
    assert "there is no mesh file 'package://gone/bar.obj'" in said
    assert f"Searched in {model}, {model.parent / 'other'};" in said


@pytest.mark.skipif(os.sep != "/", reason="a backslash separates folders here")
def test_a_path_of_windows_to_a_mesh_is_named_as_such(
    model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert not drawn(srm.load(robot(model, "meshes\\a.obj")))
    assert "Write / instead of \\ in the path." in caplog.text


@pytest.mark.parametrize(
    ("scale", "doubted"),
    [("1000 1000 1000", True), ("150 150 150", True), ("1 1 1", False), ("1e-4 1e-4 1e-4", False)],
)
def test_a_mesh_in_mm_on_a_moving_body_is_doubted(
    scale: str, doubted: bool, model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The tree of 1.03 m has a mesh with a box of sqrt(3) m, ``scale`` times."""
    (model / "a.obj").write_text(TETRAHEDRON)
    visual = VISUAL.format("a.obj").replace("/></geo", f' scale="{scale}"/></geo')
    on_ground = tree().replace('<link name="base"/>', f'<link name="base">{visual}')
    for link, moves, text in (
        ("ground", False, on_ground),
        ("link", True, tree().replace("</link>", visual, 1)),
    ):
        (model / f"{link}.urdf").write_text(text)
        caplog.clear()
        visuals_of(srm.load(model / f"{link}.urdf"))
        assert ("lengths of meshes are in m" in caplog.text) == (doubted and moves)
        if doubted and moves:
            size = np.sqrt(3.0) * float(scale.split()[0])
            assert f"is {size:.3g} m large" in caplog.text


@pytest.mark.parametrize("manifest", ["package.xml", "model.config"])
def test_packages_are_within_reach(
    manifest: str, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (model.parent / "other" / manifest).write_text("<package/>")
    assert drawn(srm.load(robot(model, "package://other/a.obj")))
    (model.parent / "other" / manifest).unlink()
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(model.parent / "other"))
    assert drawn(srm.load(robot(model, "package://other/a.obj")))


def test_the_package_of_a_model_is_within_reach(model: Path) -> None:
    (model / "meshes").mkdir()
    (model / "meshes" / "a.obj").write_text(TETRAHEDRON)
    for folder in ("urdf", "here"):
        (model / folder).mkdir()
    assert drawn(srm.load(robot(model / "urdf", "../meshes/a.obj")))
    assert not drawn(srm.load(robot(model / "here", "../meshes/a.obj")))
    (model / "package.xml").write_text("<package/>")
    assert drawn(srm.load(robot(model / "here", "../meshes/a.obj")))


def test_a_name_without_a_package_is_found_in_the_package_of_the_model_and_in_named_folders(
    model: Path,
) -> None:
    path = robot(model, "package:///meshes/a.obj")
    assert not drawn(srm.load(path))
    assert drawn(srm.load(robot(model, "package:///a.obj"), mesh_dirs=[model.parent / "other"]))
    (model / "meshes").mkdir()
    (model / "meshes" / "a.obj").write_text(TETRAHEDRON)
    assert drawn(srm.load(robot(model, "package:///meshes/a.obj")))


def test_the_home_folder_is_no_package(model: Path) -> None:
    path = model.rename(model.parent / "urdf")
    (model.parent / "package.xml").write_text("<package/>")
    assert not drawn(srm.load(robot(path, "../other/a.obj")))
    assert not drawn(srm.load(robot(path, f"package://{path.parent.name}/other/a.obj")))


def test_a_saved_run_does_not_decide_what_is_read(model: Path) -> None:
    run = model / "run.npz"
    mechanism = srm.load(robot(model, "../other/a.obj"), allow_outside=True)
    solution = srm.simulate(mechanism, 0.01)
    assert drawn(solution.mechanism)
    solution.save(run)
    assert not drawn(srm.load_solution(run).mechanism)
    assert drawn(srm.load_solution(run, allow_outside=True).mechanism)
    assert drawn(srm.load_solution(run, mesh_dirs=[model.parent / "other"]).mechanism)


NAMED = {
    "a URDF": ("m.toml", 'format = 1\nurdf = "../other/x"\n'),
    "a table": (
        "m.toml",
        'format = 1\nurdf = "robot.urdf"\n[[drive]]\njoint = "hip"\ntype = "table"\n'
        'table = "../other/x"\n',
    ),
    "an MJCF": ("m.xml", '<mujoco><include file="../other/x"/></mujoco>'),
    "an SDF": (
        "m.sdf",
        "<sdf version='1.9'><model name='m'><include><uri>../other/x</uri></include></model></sdf>",
    ),
    "an SDF by the name of its model": (
        "m.sdf",
        "<sdf version='1.9'><model name='m'><include><uri>model://other</uri></include></model>"
        "</sdf>",
    ),
    "a mesh with inertia": (
        "m.xml",
        '<mujoco><asset><mesh name="m" inertia="exact" file="../other/a.obj"/></asset><worldbody>'
        '<body name="b"><joint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>',
    ),
}


@pytest.mark.parametrize("case", NAMED)
def test_no_file_outside_is_read_without_leave(case: str, model: Path) -> None:
    name, text = NAMED[case]
    (model / name).write_text(text)
    robot(model, "a.obj")
    for secret in ("x", "model.sdf"):
        (model.parent / "other" / secret).write_text("secret 12345")
    with pytest.raises(srm.InputError, match="lies outside") as caught:
        srm.load(model / name)
    assert "allow_outside=True (--allow-outside)" in str(caught.value)
    assert "12345" not in str(caught.value)


def test_every_command_that_loads_a_file_has_the_option(model: Path) -> None:
    (model / "m.toml").write_text('format = 1\nurdf = "../other/robot.urdf"\n')
    (model.parent / "other" / "robot.urdf").write_text(tree())
    path = str(model / "m.toml")
    refused = CliRunner().invoke(app, ["info", path])
    assert refused.exit_code == 2
    assert "--allow-outside" in refused.output
    assert CliRunner().invoke(app, ["info", path, "--allow-outside"]).exit_code == 0
    for command in ("simulate", "convert", "modes", "equilibrium", "linearise", "drag", "play"):
        assert "--allow-outside" in CliRunner().invoke(app, [command, "--help"]).output
    assert "--allow-outside" in CliRunner().invoke(app, ["report", "--help"]).output


def test_wrong_options_are_refused(model: Path) -> None:
    with pytest.raises(srm.InputError, match="mesh_dirs: there is no folder"):
        Reach.of(model / "a", mesh_dirs=[model / "nowhere"])
    with pytest.raises(srm.InputError, match="mesh_dirs = 3 is not a list of folders"):
        srm.load("four_bar", mesh_dirs=3)  # type: ignore[arg-type]
    with pytest.raises(srm.InputError, match="allow_outside = 1 is not"):
        Reach.of(model / "a", allow_outside=1)  # type: ignore[arg-type]
