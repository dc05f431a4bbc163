"""Runs and grid points that end on a singular configuration, or just before or behind one."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.integration import singular_endpoints
from srm_mbs.integration.control.placement import error_of_parabola
from tests.support import reduced, slider_crank
from tests.support.backends import on_both
from tests.support.bundled import load
from tests.support.lockstep import compare
from tests.support.slider_crank import PERIOD, START, off_branch

BESIDE = (-1e-3, -1e-4, -1e-5, -1e-6, -1e-8, -1e-12, 0.0, 1e-9, 1e-6, 1e-4)
"""Ends (s) from the time of the singular configuration."""


EVERYWHERE = pytest.mark.parametrize(
    "name", ["slider_crank", "parallelogram", "n_four_bar_2", "spatial_dead_point"]
)


def motion(name: str) -> tuple[reduced.Field, list[float], float]:
    """Reduced equations of a bundled mechanism, its start, and the crank's angle from theirs."""
    mechanism = load(name)
    crank = 0 if name.startswith("n_four_bar") else mechanism.joint("crank").idx_q
    start = [float(mechanism.q0[crank]), float(mechanism.v0[0])]
    if name == "slider_crank":
        return reduced.slider_crank(), start, 0.0
    if name == "parallelogram":
        return reduced.parallelogram(), start, 0.0
    if name == "spatial_dead_point":
        return reduced.spatial_dead_point(), [start[0] - np.pi / 6.0, start[1]], np.pi / 6.0
    return reduced.n_four_bar(int(name.rsplit("_", 1)[1])), start, 0.0


@lru_cache(maxsize=8)
def near_first_passage(name: str) -> tuple[float, list[float]]:
    """A time (s) just before the first singular configuration, and angle and rate of the crank."""
    field, start, _ = motion(name)
    t = srm.simulate(load(name), 2.0, rtol=1e-8).crossings[0].time - 5e-3
    return t, reduced.integrate(field, start, t).tolist()


@lru_cache(maxsize=8)
def first_passage(name: str) -> float:
    """Time (s) of the first singular configuration, where the crank's angle is a multiple of a
    quarter turn."""
    field, _, _ = motion(name)
    before, state = near_first_passage(name)
    angle = np.round(state[0] / (np.pi / 2.0)) * np.pi / 2.0
    t = before + 5e-3
    for _ in range(4):
        theta, omega = reduced.integrate(field, state, t - before)
        t -= (theta - angle) / omega
    return float(t)


def error_of_a_run_to_the_first_passage(
    name: str, tableau: str, tol: float, beside: float
) -> float:
    """Largest error of the crank's angle and rate at the end, over the tolerance."""
    field, _, off = motion(name)
    before, state = near_first_passage(name)
    t_end = first_passage(name) + beside
    solution = srm.simulate(load(name), t_end, tableau=tableau, rtol=tol, atol=tol)
    assert solution.success
    theta, omega = reduced.integrate(field, state, t_end - before)
    crank = 0 if off == 0.0 else solution.mechanism.joint("crank").idx_q
    wrong = max(abs(solution.q[-1, crank] - off - theta), abs(solution.v[-1, 0] - omega))
    assert solution.drift[-1].max() < max(tol, 1e-10)
    return float(wrong / tol)


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
@pytest.mark.parametrize("tol", [1e-6, 1e-9])
@pytest.mark.parametrize("beside", [0.0, 1e-9, -1e-6, 1e-3])
def test_a_run_may_end_on_a_singular_configuration(tableau: str, tol: float, beside: float) -> None:
    t_end = PERIOD / 4.0 + beside
    solution = srm.simulate(load("slider_crank"), t_end, tableau=tableau, rtol=tol, atol=tol)
    assert solution.stats.steps < 60
    assert slider_crank.error(solution) < tol


@on_both
@pytest.mark.parametrize("rtol", [1e-5, 1e-6, 1e-8])
def test_a_run_may_end_on_a_singular_configuration_after_one_step(
    rtol: float, backend: str
) -> None:
    for angle in np.linspace(0.02, 0.46, 10):
        for rate in (4.0, 12.0):

            def stretched(t: float, y: Any) -> Any:
                return y[0]

            stretched.terminal = True  # type: ignore[attr-defined]
            run = solve_ivp(
                reduced.parallelogram(),
                (0.0, 1.0),
                [-angle, rate],
                "DOP853",
                events=stretched,
                rtol=1e-13,
                atol=1e-13,
            )
            solution = srm.simulate(
                load("parallelogram"),
                run.t[-1],
                q0=[-angle, angle, -angle],
                v0=[rate, -rate, rate],
                rtol=rtol,
                backend=backend,
            )
            assert solution.success
            expected = run.y[1, -1] * np.array([1.0, -1.0, 1.0])
            assert np.abs(solution.v[-1] - expected).max() < 30.0 * rtol * rate


@EVERYWHERE
@pytest.mark.parametrize("tol", [1e-6, 1e-10])
def test_how_near_a_singular_configuration_a_run_ends_does_not_show(name: str, tol: float) -> None:
    for beside in (-1e-5, 1e-9) if tol == 1e-6 else (-1e-4, -1e-8, 1e-6):
        assert error_of_a_run_to_the_first_passage(name, "dop853", tol, beside) < 2.0


@pytest.mark.stress
@EVERYWHERE
@pytest.mark.parametrize("tol", [1e-5, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11])
def test_runs_end_next_to_singular_configurations_at_every_tolerance(name: str, tol: float) -> None:
    for beside in BESIDE:
        error = error_of_a_run_to_the_first_passage(name, "dop853", tol, beside)
        # At 1e-11 it is rounding: in the nodes, and in the step up to them.
        assert error < (20.0 if tol < 1e-10 else 2.0)


@pytest.mark.stress
@EVERYWHERE
@pytest.mark.parametrize("tol", [1e-5, 1e-7, 1e-9])
def test_runs_of_lower_order_end_next_to_singular_configurations(name: str, tol: float) -> None:
    for beside in BESIDE:
        assert error_of_a_run_to_the_first_passage(name, "dopr54", tol, beside) < 2.0


@pytest.mark.parametrize(
    ("name", "beside"), [("slider_crank", 1e-6), ("slider_crank", -1e-4), ("n_four_bar_2", -1e-6)]
)
def test_the_kernel_prepares_for_such_an_end_as_the_reference_does(
    name: str, beside: float
) -> None:
    comparison = compare(load(name), first_passage(name) + beside, rtol=1e-8)
    assert comparison.arrivals == 1
    assert not comparison.decisions
    assert comparison.h < 1e-9
    assert comparison.near < 1e-10


def test_a_zero_of_sigma_is_not_foreseen_where_sigma_is_no_parabola() -> None:
    """sigma falls by a polynomial of third degree, or jumps where pivots change."""
    c = np.array([0.0, 0.1, 0.3, 0.45, 0.7, 0.9, 1.0])
    cubic = c * (c - 0.45) * (c - 1.0)
    for a, b, ahead in ((-0.1, 0.0, 1.5), (-0.1, -0.02, 2.0), (-0.3, 0.05, 1.2)):
        parabola = 0.3 + c * (a + c * b)
        assert error_of_parabola(c, 3, parabola, ahead) < 1e-14
        expected = 0.01 * ahead * (ahead - 0.45) * (ahead - 1.0)
        assert error_of_parabola(c, 3, parabola + 0.01 * cubic, ahead) == pytest.approx(expected)
    jumps = 0.3 - 0.1 * c + np.array([0.0, 0.0, 0.005, 0.0, 0.0, 0.0, 0.0])
    assert error_of_parabola(c, 3, jumps, 2.0) > singular_endpoints.SINGULAR_END_SIGMA


@pytest.mark.parametrize("backend", ["kernel", "python"])
@pytest.mark.parametrize("beside", [-1e-6, 0.0])
def test_nothing_is_evaluated_behind_an_end_next_to_a_singular_configuration(
    backend: str, beside: float
) -> None:
    t_end = first_passage("slider_crank") + beside
    latest = 0.0

    def controller(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        nonlocal latest
        latest = max(latest, t)
        return np.zeros(2)

    solution = srm.simulate(
        load("slider_crank"), t_end, rtol=1e-8, controller=controller, backend=backend
    )
    assert solution.success
    assert solution.t[-1] == t_end
    assert latest == t_end


@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_a_breakpoint_next_to_a_singular_configuration_costs_no_accuracy(backend: str) -> None:
    passage = first_passage("slider_crank")
    solution = srm.simulate(
        load("slider_crank"),
        1.5 * passage,
        rtol=1e-10,
        atol=1e-10,
        breakpoints=[0.5 * passage, passage - 1e-6],
        backend=backend,
    )
    theta, omega = reduced.integrate(reduced.slider_crank(), START, 1.5 * passage)
    assert abs(solution.q[-1, 0] - theta) < 1e-10
    assert abs(solution.v[-1, 0] - omega) < 2e-10


@pytest.mark.parametrize("tableau", ["erk4", "dopr54", "dop853"])
def test_a_grid_point_on_a_singular_configuration_is_stepped_over(tableau: str) -> None:
    step = PERIOD / 160.0
    solution = srm.simulate(load("slider_crank"), PERIOD / 2.0, step=step, tableau=tableau)
    assert solution.success
    assert solution.stats.steps <= 82
    assert solution.steps.sigmas.min() > 1e-3
    assert off_branch(solution.q) < 1e-9
    grid = step * np.arange(81)
    off = np.abs(solution.t[:, None] - grid).min(axis=1) > 1e-12
    assert off.sum() <= 2


def test_a_search_ahead_of_an_end_that_leaves_all_numbers_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It contracts, or diverges; NumPy raises for singular values of NaN."""
    called = False

    def diverges(*_: object, **__: object) -> None:
        nonlocal called
        called = True
        np.linalg.svd(np.full((2, 2), np.nan))

    monkeypatch.setattr(singular_endpoints.BranchMotion, "block", diverges)
    t = first_passage("slider_crank")
    # With a regularisation there are no nodes of the branch.
    method = srm.PSRM("dop853", eps="h")
    solution = srm.simulate(srm.load("slider_crank"), t, method=method, rtol=1e-8)
    assert solution.success
    assert called


@lru_cache(maxsize=4)
def passage_of_many_loops(loops: int) -> tuple[float, list[float]]:
    """Time (s) at which the crank of the N-four-bar passes the x axis, and its start."""
    mechanism = srm.n_four_bar(loops)
    start = [float(mechanism.q0[0]), float(mechanism.v0[0])]
    t = 0.72
    for _ in range(4):
        theta, omega = reduced.integrate(reduced.n_four_bar(loops), start, t)
        t -= theta / omega
    return float(t), start


MANY_LOOPS = pytest.mark.parametrize(
    "loops", [40, *(pytest.param(n, marks=pytest.mark.stress) for n in (80, 320))]
)


@MANY_LOOPS
@pytest.mark.parametrize("rtol", [1e-6, pytest.param(1e-9, marks=pytest.mark.stress)])
def test_ends_beside_a_passage_of_many_loops_take_no_more_evaluations_than_the_passage(
    loops: int, rtol: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor an analysis of branches, which takes dense algebra of all loops."""
    monkeypatch.setattr(singular_endpoints, "branch_next_to", None)
    mechanism = srm.n_four_bar(loops)
    passage, start = passage_of_many_loops(loops)
    through = srm.simulate(mechanism, passage + 0.3, rtol=rtol).stats
    for beside in (-1e-2, -1e-3, -1.1e-6, -1e-6, -1e-9, 0.0, 1e-6, 1e-3, 1e-2):
        solution = srm.simulate(mechanism, passage + beside, rtol=rtol)
        assert solution.success
        expected = reduced.integrate(reduced.n_four_bar(loops), start, passage + beside)
        wrong = max(abs(solution.q[-1, 0] - expected[0]), abs(solution.v[-1, 0] - expected[1]))
        # Of many loops rounding in direct solves at sigma of 3e-3 is up to 1e-9.
        assert wrong < max(rtol, 2e-9)
        assert solution.stats.steps <= through.steps
        assert solution.stats.evaluations < 2 * through.evaluations


@MANY_LOOPS
def test_starts_beside_a_passage_of_many_loops_need_no_analysis_of_branches(
    loops: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(singular_endpoints, "branch_next_to", None)
    mechanism = srm.n_four_bar(loops)
    passage, start = passage_of_many_loops(loops)
    for beside in (-1e-2, -1e-3, -1e-6, 0.0, 1e-6, 1e-3, 1e-2):
        before = srm.simulate(mechanism, passage + beside, rtol=1e-9)
        solution = srm.simulate(mechanism, 0.3, q0=before.q[-1], v0=before.v[-1], rtol=1e-6)
        assert solution.success
        t = passage + beside + 0.3
        expected = reduced.integrate(reduced.n_four_bar(loops), start, t)
        wrong = max(abs(solution.q[-1, 0] - expected[0]), abs(solution.v[-1, 0] - expected[1]))
        assert wrong < 1e-6
        assert solution.stats.evaluations < 250
