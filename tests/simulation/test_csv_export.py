"""Runs as tables of comma-separated values."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.formats.csv_table import cell_text, read_csv
from tests.support.mechanisms import along_x, floating_ring, rod


def read(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return header, np.array([[float(cell) for cell in row] for row in rows])


def test_a_table_gives_the_same_floats_back(tmp_path: Path) -> None:
    solution = srm.simulate(srm.load("slider_crank"), 5.0)
    path = tmp_path / "run.csv"
    solution.to_csv(path)
    header, table = read(path)
    assert header == [
        "t (s)",
        "crank (rad)",
        "rod (rad)",
        "crank rate (rad/s)",
        "rod rate (rad/s)",
        "||g|| (m)",
        "||G v|| (m/s)",
        "energy (J)",
    ]
    assert np.array_equal(table[:, 0], solution.t)
    assert np.array_equal(table[:, 1:3], solution.q)
    assert np.array_equal(table[:, 3:5], solution.v)
    assert np.array_equal(table[:, 5:7], solution.drift)
    assert np.array_equal(table[:, 7], solution.energy)


@pytest.mark.parametrize("kind", [list, np.array])
def test_times_may_be_chosen_in_any_order(tmp_path: Path, kind: type) -> None:
    solution = srm.simulate(srm.load("slider_crank"), 5.0)
    chosen = [4.0, 0.0, 2.5, 5.0]
    solution.to_csv(tmp_path / "run.csv", kind(chosen))
    _, table = read(tmp_path / "run.csv")
    q, v = solution(chosen)
    assert table[:, 0].tolist() == chosen
    assert np.array_equal(table[:, 1:5], np.hstack([q, v]))
    assert np.array_equal(table[:, 7], solution.at(chosen).energy)


@pytest.mark.parametrize("wrong", [[0.0, 6.0], [-0.1], 1.0, [[1.0]], [np.nan]], ids=str)
def test_times_outside_the_run_are_refused(tmp_path: Path, wrong: object) -> None:
    solution = srm.simulate(srm.load("slider_crank"), 5.0)
    with pytest.raises(ValueError, match=r"the run covers|Give a vector"):
        solution.to_csv(tmp_path / "run.csv", wrong)
    assert not (tmp_path / "run.csv").exists()


def test_free_and_ball_joints_have_one_column_per_component(tmp_path: Path) -> None:
    ring = floating_ring()
    solution = srm.simulate(ring, 0.5)
    solution.to_csv(tmp_path / "ring.csv")
    header, table = read(tmp_path / "ring.csv")
    assert header[1:8] == ["a.x (m)", "a.y (m)", "a.z (m)", "a.qx", "a.qy", "a.qz", "a.qw"]
    assert header[8:12] == ["b.qx", "b.qy", "b.qz", "b.qw"]
    assert header[20:23] == ["a.vx (m/s)", "a.vy (m/s)", "a.vz (m/s)"]
    assert header[23:29] == [f"{j}.w{k} (rad/s)" for j in "ab" for k in "xyz"]
    assert np.array_equal(table[:, 1:35], np.hstack([solution.q, solution.v]))


def test_sliders_have_lengths_and_continuous_joints_unwrapped_angles(tmp_path: Path) -> None:
    model = pin.Model()
    slider = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slider")
    model.appendBodyToJoint(slider, rod(), pin.SE3.Identity())
    wheel = model.addJoint(slider, pin.JointModelRUBY(), along_x(1.0), "wheel, left")
    model.appendBodyToJoint(wheel, rod(), pin.SE3.Identity())
    mechanism = srm.Mechanism(model, v0=np.array([0.0, 30.0]))
    solution = srm.simulate(mechanism, 2.0)
    solution.to_csv(tmp_path / "run.csv")
    header, table = read(tmp_path / "run.csv")
    names = ["slider (m)", "wheel, left (rad)", "slider rate (m/s)", "wheel, left rate (rad/s)"]
    assert header == ["t (s)", *names, "energy (J)"]
    assert np.array_equal(table[:, 2], solution.joint("wheel, left")[0])
    assert table[-1, 2] > 40.0


def test_planar_and_unusual_joints_are_named(tmp_path: Path) -> None:
    model = pin.Model()
    base = model.addJoint(0, pin.JointModelPlanar(), pin.SE3.Identity(), "base")
    model.appendBodyToJoint(base, rod(), pin.SE3.Identity())
    cardan = model.addJoint(base, pin.JointModelSphericalZYX(), along_x(1.0), "cardan")
    model.appendBodyToJoint(cardan, rod(), pin.SE3.Identity())
    solution = srm.simulate(srm.Mechanism(model, v0=0.1 * np.ones(6)), 0.1)
    solution.to_csv(tmp_path / "run.csv")
    header, table = read(tmp_path / "run.csv")
    assert header[1:5] == ["base.x (m)", "base.y (m)", "base.cos", "base.sin"]
    assert header[5:8] == ["cardan.q0", "cardan.q1", "cardan.q2"]
    assert header[8:11] == ["base.vx (m/s)", "base.vy (m/s)", "base.wz (rad/s)"]
    assert header[11:14] == ["cardan.v0", "cardan.v1", "cardan.v2"]
    assert np.array_equal(table[:, 1:14], np.hstack([solution.q, solution.v]))


def test_closures_with_alignment_rows_have_drift_in_radians_too(tmp_path: Path) -> None:
    base = srm.load("four_bar")
    pin_loop = base.loops[0]
    hinge = srm.LoopClosure("revolute", pin_loop.a, pin_loop.b, (0.0, 1.0, 0.0))
    mechanism = srm.Mechanism(base.model, (hinge,), q0=base.q0, v0=base.v0)
    srm.simulate(mechanism, 0.1).to_csv(tmp_path / "run.csv")
    header, _ = read(tmp_path / "run.csv")
    assert header[-3:-1] == ["||g|| (m; rad)", "||G v|| (m/s; rad/s)"]


def test_a_loaded_run_and_an_unfinished_one_have_tables(tmp_path: Path) -> None:
    def fails(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if t > 0.5:
            raise ValueError("no power")
        return np.zeros(3)

    solution = srm.simulate(srm.load("four_bar"), 2.0, controller=fails)
    assert not solution.success
    solution.save(tmp_path / "run.npz")
    solution.to_csv(tmp_path / "a.csv")
    srm.load_solution(tmp_path / "run.npz").to_csv(tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert len(read(tmp_path / "a.csv")[1]) == len(solution.t)


def test_a_table_ends_at_a_terminal_event(tmp_path: Path) -> None:
    def half(t: float, q: np.ndarray, v: np.ndarray) -> float:
        return t - 0.5

    half.terminal = True  # type: ignore[attr-defined]
    solution = srm.simulate(srm.load("four_bar"), 2.0, events=half)
    solution.to_csv(tmp_path / "run.csv")
    _, table = read(tmp_path / "run.csv")
    assert table[-1, 0] == solution.t[-1] == pytest.approx(0.5)


def formula_named() -> srm.Mechanism:
    """A pendulum whose joint has the name of a formula."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "=1+cmd|' /C calc'!A0")
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    return srm.Mechanism(model, v0=np.array([-1.0]))


def test_a_spreadsheet_takes_a_name_that_begins_like_a_formula_as_text(tmp_path: Path) -> None:
    solution = srm.simulate(formula_named(), 0.1)
    solution.to_csv(tmp_path / "run.csv")
    header, table = read(tmp_path / "run.csv")

    assert header[1] == "'=1+cmd|' /C calc'!A0 (rad)"
    assert table[0, 2] == -1.0  # numbers are as they are
    names = ["=1+cmd|' /C calc'!A0 (rad)", "t (s)"]
    assert np.array_equal(
        read_csv(tmp_path / "run.csv").columns(names), table[:, [1, 0]]
    )  # and its columns are found by their names


@pytest.mark.parametrize("text", ["=1", "+1", "-1", "@A1", "\tx", "\rx", "\n=1", "\uff1d1"])
def test_texts_of_a_sweep_are_no_formulas_and_numbers_stay(text: str, tmp_path: Path) -> None:
    cases = {text: {}, "plain": {}}
    swept = srm.sweep(
        formula_named(), cases, 0.01, measure=lambda solution: {text: text, "number": -2.5}
    )
    swept.to_csv(tmp_path / "sweep.csv")

    with (tmp_path / "sweep.csv").open(newline="", encoding="utf-8") as file:
        header, first, second = csv.reader(file)
    assert header[0] == "case"
    assert header[-2:] == [f"'{text}", "number"]
    assert (first[0], second[0]) == (f"'{text}", "plain")
    assert first[-2:] == [f"'{text}", "-2.5"]
    assert cell_text(first[0]) == text
