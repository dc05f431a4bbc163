"""Motion of points: positions, velocities and accelerations, against differences and formulas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from tests.simulation.test_csv_export import read
from tests.support.bundled import finished, load
from tests.support.commands import error_line, run
from tests.support.mechanisms import floating_ring

MIDDLE = srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))


def test_a_point_of_a_crank_runs_on_a_circle() -> None:
    """Radius 2 m: x' = r w, x'' = r w' and r w^2."""
    solution = finished(load("slider_crank"), 1.0)
    tip = solution.point(srm.Anchor("crank", xyz=(2.0, 0.0, 0.0)))
    _, rate = solution.joint("crank")
    turn = solution.accelerations[:, 0]
    np.testing.assert_allclose(np.linalg.norm(tip.position, axis=1), 2.0, rtol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(tip.velocity, axis=1), 2.0 * abs(rate), rtol=1e-12)
    inwards = -np.einsum("nk,nk->n", tip.acceleration, tip.position) / 2.0
    np.testing.assert_allclose(inwards, 2.0 * rate**2, atol=1e-11)
    whole = np.linalg.norm(tip.acceleration, axis=1)
    np.testing.assert_allclose(whole, 2.0 * np.hypot(turn, rate**2), rtol=1e-11)


@pytest.mark.parametrize("backend", ["python", "kernel"])
@pytest.mark.parametrize("name", ["ring", "stewart_platform", "jansen_walker"])
def test_velocity_and_acceleration_are_the_rates_of_the_position(name: str, backend: str) -> None:
    mechanism = floating_ring() if name == "ring" else load(name)
    link = {"ring": "c", "stewart_platform": "platform", "jansen_walker": "left_0_foot"}[name]
    solution = finished(mechanism, 0.2, backend=backend, rtol=1e-11)
    anchor = srm.Anchor(link, xyz=(0.3, -0.2, 0.1))
    h = 1e-4
    t = np.linspace(2.0 * h, 0.2 - 2.0 * h, 7)
    here = solution.at(t).point(anchor)
    after, before = (solution.at(t + d).point(anchor) for d in (h, -h))
    size = np.abs(here.acceleration).max()
    rate = (after.position - before.position) / (2.0 * h)
    np.testing.assert_allclose(here.velocity, rate, atol=1e-6 * size)
    rate = (after.velocity - before.velocity) / (2.0 * h)
    np.testing.assert_allclose(here.acceleration, rate, atol=1e-4 * size)


def test_points_of_the_ground_rest() -> None:
    motion = finished(load("four_bar"), 0.1).point(srm.Anchor("world", xyz=(1.0, 2.0, 3.0)))
    assert (motion.position == [1.0, 2.0, 3.0]).all()
    assert not motion.velocity.any()
    assert not motion.acceleration.any()


def test_pins_of_a_planar_linkage_are_points_by_name() -> None:
    """Every bar keeps its length: |d|^2 is constant, d d' = 0 and d d'' = -|d'|^2 for its ends."""
    linkage = srm.planar(
        points={"O": (0, 0), "A": (40, 0), "B": (120, 80), "C": (150, 0)},
        bars={"crank": ("O", "A"), "coupler": ("A", "B"), "rocker": ("B", "C")},
        ground=("O", "C"),
        unit="mm",
        mass_per_length=1.0,
    )
    solution = srm.simulate(linkage, 0.3, rtol=1e-10, t_eval=np.linspace(0.0, 0.3, 7))
    ground, A, B, C = (solution.point(name) for name in "OABC")
    for one, other, length in (
        (ground, A, 0.04),
        (A, B, np.hypot(0.08, 0.08)),
        (B, C, np.hypot(0.03, 0.08)),
        (ground, C, 0.15),
    ):
        gaps = np.linalg.norm(one.position - other.position, axis=1)
        np.testing.assert_allclose(gaps, length, rtol=1e-9)
        along, turning = one.position - other.position, one.velocity - other.velocity
        np.testing.assert_allclose((along * turning).sum(axis=1), 0.0, atol=1e-9)
        bent = (along * (one.acceleration - other.acceleration)).sum(axis=1)
        np.testing.assert_allclose(bent, -(turning**2).sum(axis=1), rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(C.velocity, 0.0)
    assert np.abs(B.velocity).max() > 0.1


def test_points_go_on_through_actions_of_events() -> None:
    mechanism = load("four_bar")
    freed = mechanism.without_loop("pin")
    event = srm.Event(lambda t, q, v: t - 0.2, action=lambda t, q, v: srm.Switch(freed))
    solution = srm.simulate(mechanism, 0.4, events=[event])
    assert len(solution.segments) == 2
    anchor = srm.Anchor("coupler", xyz=(1.0, 0.0, 0.0))
    motion = solution.point(anchor)
    parts = [part.point(anchor) for part in solution.segments]
    for which in ("position", "velocity", "acceleration"):
        expected = np.concatenate([getattr(part, which) for part in parts])
        np.testing.assert_array_equal(getattr(motion, which), expected)


def test_a_loaded_run_with_a_controller_has_positions_and_velocities_of_points(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.npz"
    ran = finished(load("slider_crank"), 0.2, controller=lambda t, q, v: [np.sin(t), 0.0])
    ran.save(path)
    motion, own = srm.load_solution(path).point(MIDDLE), ran.point(MIDDLE)
    np.testing.assert_array_equal(motion.position, own.position)
    np.testing.assert_array_equal(motion.velocity, own.velocity)
    with pytest.raises(srm.InputError, match="controllers are not saved"):
        _ = motion.acceleration


def test_the_table_of_a_loaded_run_with_a_controller_has_what_is_known_of_points(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.npz"
    ran = finished(load("slider_crank"), 0.2, controller=lambda t, q, v: [np.sin(t), 0.0])
    ran.save(path)
    ran.to_csv(tmp_path / "before.csv", points=[MIDDLE])
    with pytest.warns(srm.SrmWarning, match="no accelerations of points: .*are not saved"):
        srm.load_solution(path).to_csv(tmp_path / "after.csv", points=[MIDDLE])
    before, after = (
        np.genfromtxt(tmp_path / f"{name}.csv", delimiter=",", dtype=str, comments=None)
        for name in ("before", "after")
    )
    known = [
        " ax (" not in name and " ay (" not in name and " az (" not in name for name in before[0]
    ]
    assert len(known) - sum(known) == 3
    np.testing.assert_array_equal(after, before[:, known])


@pytest.mark.parametrize(
    ("point", "words"),
    [
        ("C", "there is no point 'C'. Give for example"),
        (3, "3 is not a point of a link"),
        (srm.Anchor("rood"), "there is no link 'rood'. Known: "),
    ],
    ids=["name", "number", "link"],
)
def test_unknown_points_are_refused(point: object, words: str) -> None:
    solution = finished(load("slider_crank"), 0.1)
    with pytest.raises(srm.InputError) as caught:
        solution.point(point)  # type: ignore[arg-type]
    assert words in str(caught.value)
    assert str(caught.value).startswith("point: ")


def test_tables_have_points_and_reactions_on_request(tmp_path: Path) -> None:
    solution = finished(load("slider_crank"), 0.5)
    path = tmp_path / "run.csv"
    solution.to_csv(path, points=[MIDDLE], reactions=True)
    header, table = read(path)
    assert '"' not in path.read_text()
    name = "rod (1; 0; 0)"
    columns = {head: table[:, k] for k, head in enumerate(header)}
    motion = solution.point(MIDDLE)
    for k, axis in enumerate("xyz"):
        assert np.array_equal(columns[f"{name} {axis} (m)"], motion.position[:, k])
        assert np.array_equal(columns[f"{name} v{axis} (m/s)"], motion.velocity[:, k])
        assert np.array_equal(columns[f"{name} a{axis} (m/s^2)"], motion.acceleration[:, k])
    heads = ("fx (N)", "fy (N)", "fz (N)", "mx (N m)", "my (N m)", "mz (N m)")
    for k, part in enumerate(heads):
        assert np.array_equal(columns[f"closure pin {part}"], solution.reactions["pin"][:, k])
        for joint in ("crank", "rod"):
            wrench = solution.joint_reactions[joint]
            assert np.array_equal(columns[f"joint {joint} {part}"], wrench[:, k])


def test_the_command_simulate_adds_points_to_its_table(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    run("simulate", "slider_crank", "--t-end", "0.2", "--csv", path, "--point", "rod:1,0,0")
    header, _ = read(path)
    assert "rod (1; 0; 0) ax (m/s^2)" in header
    for options, words in (
        (("--point", "rod:1,0,0"), "Give --csv too"),
        (("--csv", path, "--point", "rd:1,0,0"), "there is no link 'rd'"),
        (("--csv", path, "--point", "C"), "there is no point 'C'"),
    ):
        line = error_line(run("simulate", "slider_crank", "--t-end", "0.1", *options, status=2))
        assert line.startswith("error: --point: ")
        assert words in line
