"""Overconstrained loops whose data are rounded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.model.closures import LoopClosure

HINGE = (
    '<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="{x} 0 0" rpy="{turned}"/><axis xyz="0 1 0"/></joint>'
)
BAR = (
    '<link name="{name}"><inertial><origin xyz="{half} 0 0"/><mass value="1"/>'
    '<inertia ixx="0.001" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/>'
    "</inertial></link>"
)
LOOP = """
format = 1
urdf = "four_bar.urdf"
{keys}
[[loop]]
name = "pin"
type = "revolute"
axis = [0, 1, 0]
a = {{ link = "coupler", xyz = [2, 0, 0] }}
b = {{ link = "rocker", xyz = [1.5, {error}, 0] }}

[initial]
q = {{ crank = -1.0 }}
v = {{ crank = 1.0 }}
guess = {{ coupler = 0.8, rocker = -1.2 }}
"""


def four_bar(folder: Path, error: float, keys: str = "") -> Path:
    """A four-bar, planar but for the directions of its hinges, which are off by about ``error``
    (rad), as is the place of one of them (m)."""
    bars = (("crank", 1.0), ("coupler", 2.0), ("rocker", 1.5))
    hinges = (
        ("crank", "world", 0.0, (0.0, 0.0)),
        ("coupler", "crank", 1.0, (1.0, 0.7)),
        ("rocker", "world", 2.2, (-1.0, 0.3)),
    )
    parts = [BAR.format(name=name, half=0.5 * x, moment=x * x / 12) for name, x in bars]
    for name, parent, x, (roll, yaw) in hinges:
        turned = f"{roll * error} 0 {yaw * error}"
        parts.append(HINGE.format(name=name, parent=parent, child=name, x=x, turned=turned))
    text = '<robot name="four_bar"><link name="world"/>' + "".join(parts) + "</robot>"
    (folder / "four_bar.urdf").write_text(text)
    path = folder / "four_bar.toml"
    path.write_text(LOOP.format(error=error, keys=keys))
    return path


def test_loops_that_close_to_the_digits_of_their_file_are_refused_with_residual_and_option(
    tmp_path: Path,
) -> None:
    with pytest.raises(srm.AssemblyError, match=r"close to 7.9e-09 .*closing_tolerance") as caught:
        srm.load(four_bar(tmp_path, 6e-9))
    assert "--closing-tolerance" in caught.value.remedy


@pytest.mark.parametrize("error", [pytest.param(6e-9, marks=pytest.mark.stress), 1e-5])
def test_rows_that_the_others_imply_are_left_out_to_a_stated_tolerance(
    error: float, tmp_path: Path
) -> None:
    """The plane mechanism is the reference: out of the plane the motion has errors of second
    order."""
    exact = srm.load(four_bar(tmp_path, 0.0))
    mechanism = srm.load(four_bar(tmp_path, error), closing_tolerance=6.0 * error)
    (note,) = (note for note in mechanism.notes if "closing tolerance" in note)
    assert "pin.y, pin.axis_1, pin.axis_2" in note
    assert mechanism.loops[0].row_names == ("pin.x", "pin.z")
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.structure.rank == mechanism.structure.kept.sum() == 2
    assert np.abs(mechanism.initial_errors[0]).max() < 1e-14
    run, reference = (srm.simulate(m, 2.0, rtol=1e-10) for m in (mechanism, exact))
    assert run.success
    np.testing.assert_allclose(run(2.0)[0], reference(2.0)[0], atol=1e-9 + 10.0 * error**2)
    assert run.drift.max() < 1e-11
    # Another configuration closes to rounding as well, and a saved run keeps the rows.
    state = srm.assemble(mechanism, {"crank": 0.3}, guess={"coupler": 0.5, "rocker": -1.0})
    assert np.abs(state.residuals).max() < 1e-12
    run.save(tmp_path / "run.npz")
    again = srm.load_solution(tmp_path / "run.npz")
    assert again.mechanism.loops == mechanism.loops
    assert again.reaction_multipliers["pin"].shape[1] == 2


def test_the_tolerance_holds_along_the_motion_and_not_only_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(srm.AssemblyError, match=r"along the motion .* more than the closing toler"):
        srm.load(four_bar(tmp_path, 6e-9, "closing_tolerance = 5e-9"))


def test_a_tolerance_does_not_close_loops_that_are_further_apart(tmp_path: Path) -> None:
    with pytest.raises(srm.AssemblyError, match=r"cannot be closed.* rad\."):
        srm.load(four_bar(tmp_path, 1e-3), closing_tolerance=1e-6)


@pytest.mark.stress
def test_loops_that_close_in_isolated_configurations_only_move_with_a_tolerance(
    tmp_path: Path,
) -> None:
    """Of a ball in place of the hinge one row is implied: three rows for three joints."""
    path = four_bar(tmp_path, 6e-9)
    hinge = 'type = "revolute"\naxis = [0, 1, 0]'
    path.write_text(path.read_text().replace(hinge, 'type = "point"'))
    with pytest.raises(srm.AssemblyError, match=r"held values of 'crank'.*closing_tolerance"):
        srm.load(path)
    mechanism = srm.load(path, closing_tolerance=1e-7)
    assert mechanism.loops[0].without == ("y",)
    assert mechanism.degrees_of_freedom == 1
    crank = mechanism.joint("crank").idx_q
    np.testing.assert_allclose(mechanism.q0[crank : crank + 2], [np.cos(1.0), -np.sin(1.0)])


@pytest.mark.stress
def test_bars_that_do_not_reach_are_no_matter_of_rounding(tmp_path: Path) -> None:
    """Crank and coupler, in line, miss a point of the ground by 1e-8 m: away from there no row
    follows from the others."""
    path = four_bar(tmp_path, 0.0)
    loop = """format = 1
    urdf = "four_bar.urdf"
    closing_tolerance = 1e-7
    [[loop]]
    name = "tip"
    type = "point"
    a = { link = "coupler", xyz = [2, 0, 0] }
    b = { link = "world", xyz = [3.00000001, 0, 0] }
    """
    path.write_text(loop)
    with pytest.raises(srm.AssemblyError, match=r"cannot be closed.* tip: 1e-08 m"):
        srm.load(path)


def test_exact_loops_are_as_they_are_without_a_tolerance(tmp_path: Path) -> None:
    exact = srm.load(four_bar(tmp_path, 0.0))
    tolerant = srm.load(four_bar(tmp_path, 0.0), closing_tolerance=1e-6)
    assert tolerant.loops == exact.loops
    np.testing.assert_array_equal(tolerant.q0, exact.q0)


def test_rows_that_a_closure_leaves_out_are_those_of_its_type(tmp_path: Path) -> None:
    a, b = srm.Anchor(link="coupler"), srm.Anchor(link="rocker")
    weld = LoopClosure("frame", a, b, without=("y", "rx", "rz"))
    assert weld.rows.labels == ("x", "z", "ry")
    np.testing.assert_array_equal(weld.rows.directions, np.eye(3)[[0, 2]])
    np.testing.assert_array_equal(
        weld.rows.alignments, LoopClosure("frame", a, b).rows.alignments[1:2]
    )
    with pytest.raises(srm.InputError, match=r"has no row 'w'.*Known: x, y, z"):
        LoopClosure("point", a, b, without=("w",))
    with pytest.raises(srm.InputError, match="all its rows"):
        LoopClosure("point", a, b, without=("x", "y", "z"))
    model = srm.load(four_bar(tmp_path, 0.0)).model
    assert srm.Mechanism(model, [weld]).to_pinocchio().without == (weld.name,)
