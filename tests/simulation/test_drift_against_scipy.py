"""Beside SciPy on the index-1 equations: drift, singular passages, agreement where regular."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.dynamics.multibody import ClosedSystem
from tests.support import reduced


def scipy_run(mechanism: srm.Mechanism, t_end: float, tol: float, t_eval: Any = None) -> Any:
    start = np.concatenate([mechanism.q0, mechanism.v0])
    field = reduced.index_one(mechanism)
    return solve_ivp(field, (0.0, t_end), start, method="DOP853", rtol=tol, atol=tol, t_eval=t_eval)


def closure_error(mechanism: srm.Mechanism, states: Any) -> np.ndarray:
    """Largest scaled |g| and |G v| per state (n, 2)."""
    system = ClosedSystem(mechanism)
    return np.array([[np.abs(part).max() for part in system.residuals(x)] for x in states.T])


def test_scipy_fails_to_pass_the_singular_configuration_and_ours_does_not() -> None:
    mechanism = srm.load("slider_crank")
    t = np.linspace(0.0, 10.0, 201)
    theirs = scipy_run(mechanism, 10.0, 1e-8, t)
    ours = srm.simulate(mechanism, 10.0, rtol=1e-8, atol=1e-8, t_eval=t)
    assert ours.success
    assert np.abs(ours.q[:, 1] + 2.0 * ours.q[:, 0]).max() < 1e-6
    stopped = not theirs.success
    left_branch = np.abs(theirs.y[1] + 2.0 * theirs.y[0]).max() > 1e-2
    assert stopped or left_branch


@pytest.mark.parametrize("name", ["slider_crank_regular", "four_bar", "spatial_four_bar"])
def test_unstabilised_scipy_drifts_and_ours_does_not(name: str) -> None:
    mechanism = srm.load(name)
    theirs = scipy_run(mechanism, 10.0, 1e-6)
    ours = srm.simulate(mechanism, 10.0, rtol=1e-6, atol=1e-6)
    drift = closure_error(mechanism, theirs.y)
    kept = closure_error(mechanism, np.hstack([ours.q, ours.v]).T)
    assert drift[-1, 0] > 1e-7
    assert kept[:, 0].max() < 1e-12
    assert drift[:, 0].max() > 1e4 * kept[:, 0].max()
    # theirs grows, ours does not: the second half is no worse than the first
    half = len(kept) // 2
    assert kept[half:, 0].max() < 10.0 * max(kept[:half, 0].max(), 1e-14)


@pytest.mark.parametrize("name", ["slider_crank_regular", "four_bar", "spatial_four_bar"])
def test_both_agree_to_the_tolerance_on_a_regular_mechanism(name: str) -> None:
    mechanism = srm.load(name)
    t = np.linspace(0.0, 2.0, 41)
    theirs = scipy_run(mechanism, 2.0, 1e-11, t)
    ours = srm.simulate(mechanism, 2.0, rtol=1e-8, atol=1e-8, t_eval=t)
    difference = np.abs(np.hstack([ours.q, ours.v]) - theirs.y.T)
    assert difference.max() < 2e-6


def test_regular_slider_crank_agrees_with_lagrange_by_hand() -> None:
    mechanism = srm.load("slider_crank_regular")
    solution = srm.simulate(mechanism, 10.0, rtol=1e-10, atol=1e-10)
    theta, omega = reduced.integrate(reduced.regular_slider_crank(), [np.pi / 4, 4.0], 10.0)
    position, rate = solution.joint("crank")
    assert position[-1] == pytest.approx(theta, abs=1e-7)
    assert rate[-1] == pytest.approx(omega, abs=1e-7)


@pytest.mark.parametrize("t", ["0.5", "1", "2", "5", "10"])
def test_four_bar_agrees_with_the_taylor_reference(t: str, exact: dict[str, Any]) -> None:
    state = [float(x) for x in exact["fourbar"]["state p(9),v(9)"][t]]
    mechanism = srm.load("four_bar")
    solution = srm.simulate(mechanism, float(t), rtol=1e-10, atol=1e-10)
    crank, coupler, rocker = (solution.joint(n) for n in ("crank", "coupler", "rocker"))
    angles = np.array([crank[0][-1], crank[0][-1] + coupler[0][-1], rocker[0][-1]])
    rates = np.array([crank[1][-1], crank[1][-1] + coupler[1][-1], rocker[1][-1]])
    # the reference measures its third bar from D and its second from B: angles agree mod 2 pi
    difference = np.exp(1j * angles) - np.exp(1j * np.array([state[2], state[5], state[8]]))
    assert np.abs(difference).max() < 1e-8
    assert np.abs(rates - np.array([state[11], state[14], state[17]])).max() < 1e-7
