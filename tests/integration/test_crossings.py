"""``solution.crossings``: which passages are listed, and what is said about them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import brentq

import srm_mbs as srm
from srm_mbs.dynamics.constraints import structure
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.integration import singular_passages as crossings_module
from srm_mbs.integration.kernel import dense_output as kernel_steps
from srm_mbs.integration.singular_passages import ConstraintMonitor
from tests.support import reduced, turning
from tests.support.backends import needs_kernel, on_both, slowly_on_both
from tests.support.bundled import load
from tests.support.mechanisms import (
    along_x,
    ball_dead_point,
    floating_slider_crank,
    rod,
    slider_crank_of_points,
)
from tests.support.slider_crank import moving

PI = np.pi

# mechanism, joint, its angle at a singular configuration (modulo pi)
SINGULAR_AT = {
    "slider_crank_whirl": ("crank", PI / 2.0),
    "parallelogram": ("crank", 0.0),
    "n_four_bar_2": ("crank_0", 0.0),
    "spatial_dead_point": ("crank", 2.0 * PI / 3.0),
}


def run(name: str, t_end: float, tableau: str = "dop853", tol: float = 1e-8) -> srm.Solution:
    return srm.simulate(load(name), t_end, tableau=tableau, rtol=tol, atol=tol)


def passages_of(solution: srm.Solution, name: str) -> np.ndarray:
    """Times at which the run's own dense output passes the singular angle."""
    joint, angle = SINGULAR_AT[name]
    index = solution.mechanism.joint(joint).idx_q

    def f(t: Any) -> np.ndarray:
        return np.sin(solution(t)[0][..., index] - angle)

    t = np.linspace(0.0, float(solution.t[-1]), 20001)
    values = f(t)
    changes = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    return np.array([brentq(f, t[k], t[k + 1], xtol=1e-14) for k in changes])


def times(solution: srm.Solution) -> np.ndarray:
    return np.array([crossing.time for crossing in solution.crossings])


@pytest.mark.parametrize("tableau", ["tvd32", "dopr54", "dop853"])
@pytest.mark.parametrize("name", ["slider_crank_whirl", "parallelogram", "n_four_bar_2"])
def test_the_coarsest_runs_list_every_passage(name: str, tableau: str) -> None:
    solution = run(name, 10.0, tableau, 1e-4)
    assert times(solution) == pytest.approx(passages_of(solution, name), abs=1e-3)


@pytest.mark.parametrize("name", SINGULAR_AT)
def test_passages_are_listed_at_their_times(name: str) -> None:
    solution = run(name, 3.0, tol=1e-9)
    assert times(solution) == pytest.approx(passages_of(solution, name), abs=1e-6)


def test_a_motion_that_turns_back_before_a_singular_configuration_passes_none() -> None:
    """Its energy lifts the crank to 0.02 rad before the vertical: sigma falls to 0.06 and rises."""
    rate = np.sqrt(1.5 * reduced.G * np.sin(PI / 2.0 - 0.02))
    solution = srm.simulate(moving(0.0, rate), 6.5, rtol=1e-9)
    turning = solution(np.linspace(0.0, 6.5, 6501))[0][:, 0].max()
    assert PI / 2.0 - turning == pytest.approx(0.02, abs=1e-4)
    assert turning - solution.q[-1, 0] > 0.3
    assert solution.crossings == ()


@pytest.mark.parametrize("longer", [1e-3, 1e-5])
def test_a_linkage_that_is_only_almost_singular_passes_nothing(longer: float) -> None:
    """With a rod longer than the crank the slider-crank turns without a singular configuration."""
    base = load("slider_crank_whirl")
    (loop,) = base.loops
    tip = srm.Anchor("rod", xyz=(2.0 + longer, 0.0, 0.0))
    mechanism = srm.Mechanism(
        base.model, (srm.LoopClosure(loop.type, tip, loop.b, loop.axis, "pin"),), q0=base.q0
    )
    start = srm.assemble(mechanism, {"crank": PI / 4.0}, {"crank": 6.0}, guess={"rod": -PI / 2.0})
    solution = srm.simulate(mechanism, 1.0, q0=start.q, v0=start.v, rtol=1e-8)
    assert solution.success
    turned = abs(float(solution.q[-1, 0] - solution.q[0, 0]))
    assert turned > 3.0
    assert {crossing.kind for crossing in solution.crossings} <= {"avoided"}


@pytest.mark.parametrize("tol", [1e-4, 1e-5])
@pytest.mark.parametrize("tableau", ["tvd32", "dopr54", "dop853"])
@pytest.mark.parametrize(
    "name", ["four_bar", "five_bar", "slider_crank_regular", "spatial_four_bar"]
)
def test_regular_motions_list_no_passage(name: str, tableau: str, tol: float) -> None:
    assert run(name, 5.0, tableau, tol).crossings == ()


@needs_kernel
@pytest.mark.parametrize("tableau", ["tvd32", "dop853"])
def test_the_kernel_finds_the_same_minima_of_sigma(tableau: str) -> None:
    """sigma of random motions at the stages of a run, with steps of different lengths."""
    solution, rng = srm.simulate(load("four_bar"), 4.0, tableau=tableau), np.random.default_rng(3)
    scheme, found = solution.scheme, set()
    t = solution.steps.stage_times(scheme)
    for level in np.linspace(-0.2, 1.0, 60):
        waves = np.sin(np.multiply.outer(rng.uniform(1.0, 20.0, 3), t) + rng.uniform(0.0, 6.0))
        sigmas = np.abs(level + 0.2 * np.tensordot(rng.uniform(0.0, 1.0, 3), waves, axes=1))
        steps = replace(solution.steps, sigmas=sigmas, stop=rng.uniform(*t[-1, [0, -1]]))
        expected = crossings_module.recorded_dips(scheme, steps)
        by_kernel = kernel_steps.recorded_dips(scheme, steps)
        found.add(expected is None)
        if expected is None or by_kernel is None:
            assert expected is by_kernel
            continue
        np.testing.assert_array_equal(by_kernel.samples, expected.samples)
        np.testing.assert_array_equal(by_kernel.tops, expected.tops)
    assert found == {True, False}


def beside_change_points(family: str, reach: float) -> srm.Mechanism:
    motion = turning.lifted(reach) if family == "lifted" else getattr(turning, family)(reach, 1.0)
    return motion.mechanism


@needs_kernel
@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
@pytest.mark.parametrize(
    ("family", "reach"),
    [
        *(("lifted", reach) for reach in (1e-4, 1e-5, -1e-7, -1e-4, -1e-2)),
        *(("driven", reach) for reach in (1e-3, 1e-5, -1e-5)),
        *(("driven_with_pendulum", reach) for reach in (1e-4, -1e-5)),
    ],
)
def test_the_kernel_tells_turns_beside_singular_configurations_as_the_reference(
    family: str, reach: float, tableau: str
) -> None:
    solution = srm.simulate(beside_change_points(family, reach), 6.0, rtol=1e-7, tableau=tableau)
    scheme, steps, analysis = solution.scheme, solution.steps, solution.system.singularities
    dips = crossings_module.recorded_dips(scheme, steps)
    assert analysis is not None
    assert dips is not None
    dense = kernel_steps.dense_output(solution.system, scheme, steps, "kernel")
    monitor = ConstraintMonitor(analysis, dense, solution.settings.singular_tolerance)
    told = dense.turns(scheme, dips, monitor.tolerance)  # type: ignore[attr-defined]
    expected = crossings_module.recorded_turns(monitor, scheme, steps, dips)
    assert len(told.samples) < len(dips.samples)
    np.testing.assert_array_equal(told.samples, expected.samples)
    np.testing.assert_array_equal(told.tops, expected.tops)
    np.testing.assert_array_equal(told.at_turns, expected.at_turns)
    assert expected.turns is not None
    assert bool(expected.turns) == (reach > 0.0)
    for own, other in zip(told.turns, expected.turns, strict=True):
        assert own.top == other.top
        np.testing.assert_allclose(own.times, other.times, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(own.values, other.values, rtol=1e-6)


@pytest.mark.parametrize("reach", [-1e-3, -3.7e-4, -1e-4])
def test_turns_of_a_drive_that_avoid_a_configuration_are_searched(reach: float) -> None:
    solution = srm.simulate(beside_change_points("driven", reach), 6.0, rtol=1e-7)
    scheme, steps, analysis = solution.scheme, solution.steps, solution.system.singularities
    dips = crossings_module.recorded_dips(scheme, steps)
    assert analysis is not None
    assert dips is not None
    monitor = ConstraintMonitor(analysis, solution._dense, solution.settings.singular_tolerance)
    told = kernel_steps.recorded_turns(monitor, scheme, steps, dips)
    np.testing.assert_array_equal(told.samples, dips.samples)
    assert not told.turns
    assert not len(told.at_turns)


@pytest.mark.parametrize("family", ["driven", "driven_with_pendulum"])
@pytest.mark.parametrize(("tolerance", "listed"), [(1e-9, 0), (0.0, 2)])
def test_turns_of_a_drive_are_listed_where_the_run_followed_the_residual(
    family: str, tolerance: float, listed: int
) -> None:
    # The drive turns at t = pi and 3 pi, 1e-5 rad before the change point: the residual is 4e-11.
    mechanism = beside_change_points(family, -1e-5)
    solution = srm.simulate(mechanism, 12.0, rtol=1e-7, singular_tolerance=tolerance)
    assert [crossing.kind for crossing in solution.crossings] == ["avoided"] * listed


@slowly_on_both
@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
@pytest.mark.parametrize("family", ["driven", "driven_with_pendulum"])
@pytest.mark.parametrize("reach", [-1e-5, -1.5e-4, -3.7e-4, -1e-3, -1.65e-2, -4e-2])
def test_every_turn_of_a_drive_before_a_change_point_is_listed(
    family: str, reach: float, rtol: float, backend: str
) -> None:
    mechanism = beside_change_points(family, reach)
    options: dict[str, Any] = {"rtol": rtol, "backend": backend, "singular_tolerance": 0.0}
    crossings = srm.simulate(mechanism, 30.0, **options).crossings
    assert [crossing.kind for crossing in crossings] == ["avoided"] * 5
    turns = np.pi * np.array([1.0, 3.0, 5.0, 7.0, 9.0])
    np.testing.assert_allclose([crossing.time for crossing in crossings], turns, atol=1e-4)


@on_both
@pytest.mark.parametrize("away", [1e-8, -1e-7, 1e-6, -1e-5])
@pytest.mark.parametrize("family", ["driven", "driven_with_pendulum"])
@pytest.mark.parametrize("reach", [1e-5, -1e-5, -1e-4, -3.2e-4])
def test_the_critical_configuration_next_to_a_turn_of_a_drive_is_found_from_beside_it(
    family: str, reach: float, away: float, backend: str
) -> None:
    solution = srm.simulate(beside_change_points(family, reach), 4.0, backend=backend)
    compiled = {"kernel": kernel_steps.critical_near, "python": crossings_module.critical_near}
    analysis = solution.system.singularities
    assert analysis is not None
    monitor = ConstraintMonitor(analysis, solution._dense, 0.0, compiled[backend])
    there, beside = monitor.critical(PI), monitor.critical(PI + away)
    assert there is not None
    assert beside is not None
    assert abs(beside.residual) == pytest.approx(abs(there.residual), rel=1e-3)


@slowly_on_both
@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
@pytest.mark.parametrize("family", ["driven", "driven_with_pendulum"])
@pytest.mark.parametrize("reach", [4e-7, 1e-5, 1e-4, 1e-2])
def test_a_drive_that_turns_beyond_a_change_point_passes_it_twice(
    family: str, reach: float, rtol: float, backend: str
) -> None:
    mechanism = beside_change_points(family, reach)
    crossings = srm.simulate(mechanism, 30.0, rtol=rtol, backend=backend).crossings
    assert [crossing.kind for crossing in crossings] == ["passed"] * 10
    times = [crossing.time for crossing in crossings]
    np.testing.assert_allclose(times, passed_twice(reach), atol=1e-4)


@on_both
def test_a_turn_that_shows_as_two_minima_of_sigma_passes_twice(backend: str) -> None:
    """sigma is lower at the turn than at the stages around the first passage."""
    reach = 0.0032471776
    mechanism = beside_change_points("driven", reach)
    options: dict[str, Any] = {"rtol": 9.18356697e-7, "tableau": "dopr54", "backend": backend}
    crossings = srm.simulate(mechanism, 6.0, **options).crossings
    times = [crossing.time for crossing in crossings]
    np.testing.assert_allclose(times, passed_twice(reach)[:2], atol=1e-5)


@slowly_on_both
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("name", ["folded", "parallelogram"])
@pytest.mark.parametrize("reach", [-1.4268e-2, -2.1917e-3, -3.2617e-6, 2e-6, 1e-3])
def test_every_turn_of_a_driven_four_bar_is_listed(
    name: str, reach: float, side: float, backend: str
) -> None:
    mechanism = turning.driven_four_bar(name, reach, side)
    options: dict[str, Any] = {"backend": backend, "singular_tolerance": 0.0, "tableau": "dopr54"}
    crossings = srm.simulate(mechanism, 30.0, **options).crossings
    expected = ["passed"] * 10 if reach > 0.0 else ["avoided"] * 5
    assert [crossing.kind for crossing in crossings] == expected


@pytest.mark.stress
@pytest.mark.parametrize("seed", range(150))
def test_random_turns_of_a_drive_are_listed_as_often_as_they_pass(seed: int) -> None:
    rng = np.random.default_rng(seed)
    family = str(rng.choice(["driven", "driven_with_pendulum", "folded", "parallelogram"]))
    reach = float(rng.choice([-1.0, 1.0])) * 10.0 ** rng.uniform(-5.9, -1.2)
    options: dict[str, Any] = {
        "rtol": 10.0 ** rng.uniform(-9.0, -4.0),
        "tableau": str(rng.choice(["dop853", "dopr54"])),
        "singular_tolerance": 0.0,
    }
    if family.startswith("driven"):
        mechanism = beside_change_points(family, reach)
    else:
        mechanism = turning.driven_four_bar(family, reach, float(rng.choice([-1.0, 1.0])))
    crossings = srm.simulate(mechanism, 30.0, **options).crossings
    expected = ["passed"] * 10 if reach > 0.0 else ["avoided"] * 5
    assert [crossing.kind for crossing in crossings] == expected


def passed_twice(reach: float) -> np.ndarray:
    """Times (10,) s at which a crank that is driven to ``reach`` and back five times passes 0: it
    is at reach - SWING - SWING cos(t)."""
    away = np.pi - np.arccos((reach - turning.SWING) / turning.SWING)
    turns = np.pi * np.array([1.0, 3.0, 5.0, 7.0, 9.0])
    return np.sort(np.concatenate([turns - away, turns + away]))


def test_a_start_on_a_singular_configuration_is_no_passage() -> None:
    assert srm.simulate(moving(1.5 * PI, 1.0), 0.5).crossings == ()


def test_an_open_chain_passes_none() -> None:
    assert run("pendulum_chain", 0.5).crossings == ()


# --- what is said about a passage ---------------------------------------------------------------


@pytest.fixture(scope="module")
def whirl() -> srm.Solution:
    return run("slider_crank_whirl", 4.0)


def test_sigma_before_and_at_the_closest_stage_are_those_of_the_step(whirl: srm.Solution) -> None:
    for crossing in whirl.crossings:
        step = np.searchsorted(whirl.steps.times, crossing.time) - 1
        assert crossing.sigma_before == whirl.steps.sigmas[step, 0]
        assert crossing.sigma == whirl.steps.sigmas[step].min()
        assert 0.0 < crossing.sigma <= crossing.sigma_before
        assert crossing.rank == 1


def test_the_loop_and_row_that_lose_rank_are_named(whirl: srm.Solution) -> None:
    assert {crossing.loops for crossing in whirl.crossings} == {("pin",)}
    assert {crossing.rows for crossing in whirl.crossings} == {("pin.normal",)}


def test_all_loops_that_lose_rank_are_named() -> None:
    first, *_ = run("n_four_bar_2", 1.0).crossings
    assert first.loops == ("pin_0", "pin_1")
    assert first.rows == ("pin_0.x", "pin_1.x")
    assert first.singular is not None
    assert first.singular.nullity == 2


def test_the_configuration_is_exactly_singular(whirl: srm.Solution) -> None:
    for crossing in whirl.crossings:
        assert crossing.configuration is not None
        crank, rod = crossing.configuration
        assert np.cos(crank) == pytest.approx(0.0, abs=1e-13)
        assert np.cos(crank + rod) == pytest.approx(0.0, abs=1e-13)
        assert abs(crank - whirl(crossing.time)[0][0]) < 1e-6


def test_how_the_stages_were_kept_away_is_recorded() -> None:
    placed = run("slider_crank", 10.0)
    assert "a priori" in {crossing.placement for crossing in placed.crossings}
    assert np.sum(placed.steps.placements == 1) <= placed.stats.placements
    # fixed steps that end on the singular configuration
    mechanism = load("slider_crank_whirl")
    step = run("slider_crank_whirl", 1.0, tol=1e-11).crossings[0].time / 50.0
    hit = srm.simulate(mechanism, 70.0 * step, step=step, placement="off")
    assert [crossing.placement for crossing in hit.crossings] == ["zone"]
    assert hit.stats.zone_steps > 0
    untouched = srm.simulate(load("slider_crank_whirl"), 4.0, placement="off", rtol=1e-6)
    assert {crossing.placement for crossing in untouched.crossings} <= {"", "zone"}


def test_redone_steps_are_recorded_where_they_were_redone() -> None:
    solution = run("parallelogram", 10.0, tol=1e-7)
    redone = np.flatnonzero(solution.steps.placements == 2)
    assert len(redone) > 0
    assert solution.stats.replaced >= len(redone)
    starts = solution.steps.times[redone]
    tried = np.array([attempt["t"] for attempt in solution.attempts])
    assert np.isin(starts, tried).all()


def test_the_tangents_and_the_branch_that_was_kept(whirl: srm.Solution) -> None:
    for crossing in whirl.crossings:
        assert len(crossing.branches) == 2
        expected = np.array([[1.0, -2.0], [1.0, 0.0]]) / np.array([[np.sqrt(5.0)], [1.0]])
        rate = whirl(crossing.time)[1][0]
        order = np.argsort(np.abs(crossing.branches[:, 1]))[::-1]
        np.testing.assert_allclose(
            crossing.branches[order] * np.sign(rate), expected * 1.0, atol=1e-9
        )
        assert crossing.arrived_on == crossing.left_on == order[0]
        assert not crossing.switched


@pytest.mark.parametrize("start", [ball_dead_point, floating_slider_crank])
def test_passages_of_balls_and_free_bases_keep_their_branch(start: Any) -> None:
    mechanism = start()
    if start is floating_slider_crank:
        mechanism = mechanism.with_state(floating_slider_crank(away=-0.5).q0, mechanism.v0)
    solution = srm.simulate(mechanism, 1.0, rtol=1e-8, atol=1e-8)
    assert len(solution.crossings) >= 1
    for crossing in solution.crossings:
        assert len(crossing.branches) == 2
        assert crossing.arrived_on == crossing.left_on == 0
        assert not crossing.switched


def test_a_passage_at_the_very_end_of_a_run_is_listed_and_left_open() -> None:
    whole = run("slider_crank", 2.0, tol=1e-9)
    t = whole.crossings[0].time
    cut = srm.simulate(load("slider_crank"), t + 1e-3, rtol=1e-9, atol=1e-9)
    (crossing,) = cut.crossings
    assert crossing.time == pytest.approx(t, abs=1e-6)
    assert crossing.left_on is None
    assert not crossing.switched


def test_passages_survive_saving(whirl: srm.Solution, tmp_path: Path) -> None:
    whirl.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    assert loaded.crossings == whirl.crossings
    for a, b in zip(loaded.crossings, whirl.crossings):
        assert (a.loops, a.placement, a.left_on) == (b.loops, b.placement, b.left_on)
        assert np.array_equal(a.branches, b.branches)
        assert a.configuration is not None
        assert b.configuration is not None
        assert np.array_equal(a.configuration, b.configuration)


def test_what_is_expensive_is_computed_when_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    solution = run("slider_crank_whirl", 4.0)
    calls: list[int] = []
    analyse = crossings_module.analyse_singular

    def counted(*arguments: Any) -> Any:
        calls.append(1)
        return analyse(*arguments)

    monkeypatch.setattr(crossings_module, "analyse_singular", counted)
    first, *_ = solution.crossings
    assert (first.time, first.sigma, first.placement) is not None
    assert calls == []
    assert first.loops == ("pin",)
    assert len(first.branches) == 2
    assert len(calls) == 1


def slender_slider_crank(thickness: float, twist: float = 0.0) -> srm.Mechanism:
    """slider_crank with ball joints, which closures hold as hinges, and rods of that ratio of axial
    to transverse inertia; the hinges' frames are turned by ``twist`` (rad) about their axis."""
    base = load("slider_crank")
    model = pin.Model()
    model.name = "slender_slider_crank"
    model.gravity.linear = base.model.gravity.linear
    crank = model.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), "crank")
    tip = model.addJoint(crank, pin.JointModelSpherical(), along_x(2.0), "rod")
    for joint, name in ((crank, "crank"), (tip, "rod")):
        model.appendBodyToJoint(joint, rod(1.0, 2.0, thickness), pin.SE3.Identity())
        model.addBodyFrame(name, joint, pin.SE3.Identity(), 0)
    axis = (0.0, 1.0, 0.0)
    tip, turned = (2.0, 0.0, 0.0), (0.0, twist, 0.0)
    end, pin_joint = srm.Anchor("crank", xyz=tip, rpy=turned), srm.Anchor("rod", xyz=tip)
    ground = srm.Anchor("world", rpy=turned)
    loops = (
        srm.LoopClosure("revolute", srm.Anchor("crank", rpy=turned), ground, axis, "pivot"),
        srm.LoopClosure("revolute", srm.Anchor("rod", rpy=turned), end, axis, "hinge"),
        srm.LoopClosure("point_on_plane", pin_joint, srm.Anchor("world"), (0.0, 0.0, 1.0), "pin"),
    )
    halves = -0.5 * base.q0
    q = [x for half in halves for x in (0.0, np.sin(half), 0.0, np.cos(half))]
    return srm.Mechanism(model, loops, q0=q)


@pytest.mark.parametrize(
    ("thickness", "twist"), [(1e-8, 0.0), (1e-4, 0.0), (1e-4, 0.25 * PI), (1e-2, 0.0), (1.0, 0.0)]
)
@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
def test_slender_bodies_held_by_closures_pass_like_hinges_in_the_tree(
    thickness: float, twist: float, rtol: float
) -> None:
    """Rows that turn a rod about its axis are 1/sqrt(thickness) as large as those beside them."""
    expected = srm.simulate(load("slider_crank"), 10.0, rtol=1e-12)
    solution = srm.simulate(slender_slider_crank(thickness, twist), 10.0, rtol=rtol)
    found = solution.crossings
    assert times(solution) == pytest.approx(times(expected), abs=1e-4)
    assert all(c.loops == ("pin",) and not c.switched for c in found)
    t = np.linspace(0.1, 10.0, 100)
    quaternions = solution(t)[0].reshape(100, 2, 4)
    angles = -2.0 * np.arctan2(quaternions[:, :, 1], quaternions[:, :, 3])
    error = np.angle(np.exp(1j * (angles - expected(t)[0])))
    assert np.abs(error).max() < 0.1 * rtol


@pytest.mark.parametrize("thickness", [1e-4, 1e-2])
def test_passages_are_listed_where_the_last_pivot_stays_small_everywhere(
    thickness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it would where balancing the rows made more of them independent."""
    monkeypatch.setattr(structure, "SMALL_REFERENCE_PIVOT", 0.0)
    mechanism = slender_slider_crank(thickness)
    assert mechanism.structure.sigma_ref < crossings_module.SMALL_REFERENCE_PIVOT
    expected = srm.simulate(srm.load("slider_crank"), 10.0, rtol=1e-10)
    found = srm.simulate(mechanism, 10.0, rtol=1e-6)
    assert times(found) == pytest.approx(times(expected), abs=1e-4)
    assert all(c.loops == ("pin",) and not c.switched for c in found.crossings)


@cache
def passing() -> srm.Solution:
    return srm.simulate(load("slider_crank"), 6.0, rtol=1e-12)


@pytest.mark.parametrize("apart", [2.0, 0.1, 1e-2, 1e-4])
@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
def test_hinges_of_two_points_next_to_each_other_pass_like_hinges(
    apart: float, rtol: float, tmp_path: Path
) -> None:
    """What holds them against turning is small everywhere; passages must be seen from afar."""
    expected = passing()
    mechanism = slider_crank_of_points(apart)
    assert mechanism.structure.rank == 11
    assert mechanism.structure.sigma_ref > 0.1
    solution = srm.simulate(mechanism, 6.0, rtol=rtol)
    solution.save(tmp_path / "run.npz")
    for found in (solution, srm.load_solution(tmp_path / "run.npz")):
        assert times(found) == pytest.approx(times(expected), abs=1e-4)
        assert {"pin_0", "pin_1"} & set(found.crossings[0].loops)
        assert not any(c.switched for c in found.crossings)
        t = np.linspace(0.1, 6.0, 60)
        quaternions = found(t)[0].reshape(60, 2, 7)[:, :, 3:]
        angles = 2.0 * np.arctan2(quaternions[:, :, 1], quaternions[:, :, 3])
        off = angles + np.cumsum(expected(t)[0], axis=1)
        assert np.abs(np.angle(np.exp(1j * off))).max() < 10.0 * rtol


@on_both
@pytest.mark.parametrize("reach", [3e-2, 1e-3, 1e-4])
@pytest.mark.parametrize(
    "turned", [turning.driven, turning.driven_with_pendulum, turning.on_a_cart]
)
def test_a_motion_that_turns_back_beyond_a_singular_configuration_passes_it_twice(
    turned: Callable[[float, float], turning.Motion], reach: float, backend: str
) -> None:
    """The crank is at its change point, at angle 0, where the exact motion says."""
    motion = turned(reach, 0.5)
    crank = motion.mechanism.model.joints[motion.mechanism.model.getJointId("crank")].idx_q
    t = np.linspace(0.0, motion.t_end, 4001)
    angle = motion.exact(t)[0][:, crank]
    k = np.flatnonzero(angle[:-1] * angle[1:] < 0.0)
    expected = t[k] + (t[k + 1] - t[k]) * angle[k] / (angle[k] - angle[k + 1])
    assert len(expected) == 2
    for tableau, rtol in (("dop853", 1e-6), ("dop853", 1e-9), ("dopr54", 1e-8)):
        run = srm.simulate(
            motion.mechanism, motion.t_end, rtol=rtol, tableau=tableau, backend=backend
        )
        assert [crossing.kind for crossing in run.crossings] == ["passed"] * 2
        apart = expected[1] - expected[0]
        assert np.abs(times(run) - expected).max() < 0.01 * apart + 1e-5 * motion.t_end


@pytest.mark.parametrize("amplitude", [3e-2, 3e-3])
def test_the_search_costs_as_much_per_passage_in_a_swing_that_stays_close(
    amplitude: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hanging bars swing through the singular configuration: sigma is small all the time."""
    theta = 1.5 * np.pi + amplitude
    examined: list[int] = []
    smallest = ConstraintMonitor.smallest

    def counted(monitor: ConstraintMonitor, t: np.ndarray) -> np.ndarray:
        examined.append(len(t))
        return smallest(monitor, t)

    monkeypatch.setattr(ConstraintMonitor, "smallest", counted)
    mechanism = load("slider_crank")
    for t_end, rtol in ((10.0, 1e-6), (40.0, 1e-6), (40.0, 1e-10)):
        swing = srm.simulate(mechanism, t_end, q0=[theta, -2.0 * theta], v0=[0.0, 0.0], rtol=rtol)
        assert swing.success
        examined.clear()
        found = swing.crossings
        # To first order (4/3 + 4) theta'' = -g cos theta, which passes twice in a period.
        period = 2.0 * np.pi * np.sqrt(16.0 / 3.0 / reduced.G)
        times = 0.25 * period + 0.5 * period * np.arange(len(found))
        assert len(found) == int((t_end - 0.25 * period) / (0.5 * period)) + 1
        assert np.abs([c.time for c in found] - times).max() < 0.05
        assert sum(examined) < 30 * len(found)


def test_loops_that_lose_rank_with_many_others_are_named_in_little_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    many = srm.n_four_bar(20)
    (passage, *_) = srm.simulate(many, 2.0).crossings
    calls: list[Any] = []
    closure = ClosureGeometry.closure

    def counted(geometry: Any, q: Any) -> Any:
        calls.append(q)
        return closure(geometry, q)

    monkeypatch.setattr(ClosureGeometry, "closure", counted)
    assert passage.singular is not None
    assert passage.singular.nullity == 20
    assert passage.loops == tuple(loop.name for loop in many.loops)
    # Too many branches to list.
    assert passage.branches.shape == (0, many.model.nv)
    assert len(calls) < 200


def test_the_calls_for_singular_values_do_not_grow_with_the_number_of_passages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The states that they are computed at grow in proportion to it."""
    sizes: list[int] = []
    smallest = ConstraintMonitor.smallest

    def counted(self: ConstraintMonitor, t: np.ndarray) -> np.ndarray:
        sizes.append(len(t))
        return smallest(self, t)

    monkeypatch.setattr(ConstraintMonitor, "smallest", counted)
    passages, calls, states = [], [], []
    for t_end in (10.0, 100.0):
        sizes.clear()
        passages.append(len(srm.simulate(load("parallelogram"), t_end).crossings))
        calls.append(len(sizes))
        states.append(sum(sizes))
    assert passages[1] > 9 * passages[0] > 100
    assert calls[1] < calls[0] + 10 < 40
    assert states[1] / passages[1] < 1.1 * states[0] / passages[0]
