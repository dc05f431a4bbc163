"""Through singular configurations: right branch, accuracy, drift, work."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support import reduced, slider_crank
from tests.support.references import error_across
from tests.support.slider_crank import START, off_branch, passages


def run(name: str, t_end: float, tableau: str = "dop853", tol: float = 1e-8) -> srm.Solution:
    return srm.simulate(srm.load(name), t_end, tableau=tableau, rtol=tol, atol=tol)


def times(solution: srm.Solution) -> np.ndarray:
    return np.array([crossing.time for crossing in solution.crossings])


def error_at_end(solution: srm.Solution, theta: float, omega: float, joint: str = "crank") -> float:
    position, rate = solution.joint(joint)
    return max(abs(position[-1] - theta), abs(rate[-1] - omega))


@pytest.fixture(scope="module")
def long_run() -> srm.Solution:
    """Slider-crank to t = 100 with dop853 at 1e-8."""
    return run("slider_crank", 100.0)


def crank_at(exact: dict[str, Any], t: str) -> tuple[float, float]:
    theta, omega = exact["slidercrank"]["theta1,omega1"][t]
    return float(theta), float(omega)


def test_slider_crank_stays_on_its_branch_through_all_47_passages(long_run: srm.Solution) -> None:
    assert long_run.success
    t = np.linspace(0.0, 100.0, 5001)
    q, v = long_run(t)
    assert off_branch(q) < 1e-6
    assert off_branch(v) < 1e-6


def test_every_passage_is_listed_at_its_time(long_run: srm.Solution) -> None:
    assert times(long_run) == pytest.approx(passages(47), abs=1e-4)


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
@pytest.mark.parametrize("tol", [1e-4, 1.78e-5, 1e-5, 1e-6])
def test_coarse_runs_list_every_passage_too(tableau: str, tol: float) -> None:
    found = times(run("slider_crank", 100.0, tableau, tol))
    assert found == pytest.approx(passages(47), abs=0.02)


def test_slider_crank_is_exact_to_1e_6_after_100_seconds_with_dop853(
    long_run: srm.Solution, exact: dict[str, Any]
) -> None:
    assert error_at_end(long_run, *crank_at(exact, "100")) < 1e-6


def test_slider_crank_is_exact_to_1e_5_after_100_seconds_with_dopr54(exact: dict[str, Any]) -> None:
    solution = run("slider_crank", 100.0, "dopr54")
    assert error_at_end(solution, *crank_at(exact, "100")) < 1e-5


@pytest.mark.parametrize("t", ["0.8", "1", "2", "5", "10", "20", "34.5", "70"])
def test_dense_output_is_exact_on_the_way(
    t: str, long_run: srm.Solution, exact: dict[str, Any]
) -> None:
    theta, omega = crank_at(exact, t)
    q, v = long_run(float(t))
    assert abs(q[0] - theta) < 1e-6
    assert abs(v[0] - omega) < 1e-6


def test_closure_drift_stays_at_round_off_and_energy_is_kept(long_run: srm.Solution) -> None:
    assert long_run.drift[:, 0].max() <= 1e-10
    energy = long_run.energy
    assert np.abs(energy / energy[0] - 1.0).max() <= 1e-6


def test_drift_between_the_steps_stays_within_the_tolerance() -> None:
    mechanism = srm.load("slider_crank")
    solution = srm.simulate(
        mechanism, 20.0, rtol=1e-8, atol=1e-8, t_eval=np.linspace(0.0, 20.0, 1999)
    )
    assert solution.drift[:, 0].max() < 1e-8
    assert solution.drift[:, 1].max() < 1e-6


def test_work_is_bounded(long_run: srm.Solution, exact: dict[str, Any]) -> None:
    assert long_run.stats.evaluations <= 17_000
    economic = run("slider_crank", 100.0, tol=1e-6)
    assert economic.stats.evaluations <= 10_000
    assert error_at_end(economic, *crank_at(exact, "100")) < 1e-6


def test_slider_body_with_a_redundant_row_passes_as_well() -> None:
    solution = run("slider_crank_slider", 100.0)
    assert solution.mechanism.redundant_rows == ("pin.y",)
    assert reduced.error_at_end(solution, reduced.slider_crank(0.5), START) < 1e-5
    theta = solution.joint("crank")[0][-1]
    assert solution.joint("slider")[0][-1] == pytest.approx(4.0 * np.cos(theta), abs=1e-5)


def test_whirling_slider_crank_is_exact_to_1e_5() -> None:
    solution = run("slider_crank_whirl", 10.0)
    assert error_at_end(solution, 25.8858770871720776, 2.07434062447342553) < 1e-5


def test_parallelogram_keeps_its_branch_through_its_change_points(exact: dict[str, Any]) -> None:
    solution = run("parallelogram", 10.0)
    theta, omega = map(float, exact["parallelogram"]["theta,omega"]["10"])
    assert error_at_end(solution, theta, omega) < 1e-5
    assert np.abs(solution.joint("rocker")[0] - solution.joint("crank")[0]).max() < 1e-6
    assert len(solution.crossings) == int(theta // np.pi)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_n_four_bar_passes_its_n_fold_singular_configurations(n: int) -> None:
    solution = run(f"n_four_bar_{n}", 10.0)
    theta, omega = reduced.integrate(reduced.n_four_bar(n), [np.pi / 2, -1.0], 10.0)
    for i in range(n + 1):
        assert error_at_end(solution, theta, omega, f"crank_{i}") < 1e-5


def test_published_digits_of_the_two_four_bar_are_met() -> None:
    solution = run("n_four_bar_2", 10.0, tol=1e-10)
    angle = solution.joint("crank_0")[0][-1]
    assert np.cos(angle) == pytest.approx(0.3284581115, abs=1e-8)
    assert np.sin(angle) == pytest.approx(0.9445185382, abs=1e-8)


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
def test_no_evaluated_stage_lies_on_a_singular_point(tableau: str) -> None:
    solution = run("slider_crank", 20.0, tableau, tol=1e-6)
    assert solution.stats.placements > 0
    assert solution.steps.sigmas.min() > 1e-3


def test_the_zone_carries_a_run_whose_steps_are_too_small_to_step_over() -> None:
    solution = srm.simulate(srm.load("slider_crank"), 1.3, rtol=1e-12, max_step=5e-4)
    assert solution.success
    assert solution.stats.zone_steps > 0
    in_the_zone = solution.crossings[0].time + np.linspace(-1e-3, 1e-3, 201)
    assert off_branch(solution(in_the_zone)[0]) < 1e-8
    q, v = solution(np.linspace(0.0, 1.3, 201))
    assert off_branch(q) < 1e-11
    assert off_branch(v) < 1e-11
    assert slider_crank.error(solution) < 1e-11


def test_fixed_steps_are_placed_and_return_to_the_grid() -> None:
    solution = srm.simulate(srm.load("slider_crank"), 5.0, tableau="dopr54", step=0.05)
    assert solution.success
    assert solution.stats.placements + solution.stats.replaced > 0
    grid = 0.05 * np.arange(101)
    assert np.abs(solution.t[:, None] - grid).min(axis=0).max() < 1e-12
    assert slider_crank.error(solution) < 1e-5


@pytest.mark.parametrize(
    "name", ["parallelogram", "n_four_bar_2", "n_four_bar_5", "spatial_dead_point"]
)
@pytest.mark.parametrize("rtol", [1e-10, 1e-11])
def test_short_steps_of_low_order_pass_and_keep_to_the_tolerance(name: str, rtol: float) -> None:
    """Rounding counts the more the shorter the steps that cross."""
    error, _ = error_across(name, 0.02, rtol=rtol, tableau="tvd32")
    assert error < 5.0 * rtol
