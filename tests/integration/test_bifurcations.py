"""Singular configurations reached without the momentum to choose a branch; switched branches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support import reduced, turning
from tests.support.bundled import load
from tests.support.slider_crank import START, off_branch


def swinging_up_to(distance: float) -> srm.Mechanism:
    """The parallelogram from below, with the energy to come to rest ``distance`` (rad) short of
    its change point at crank angle 0."""
    mechanism = load("parallelogram")
    rate = np.sqrt(2.0 * 9.0 / 8.0 * reduced.G * (1.0 - np.sin(distance)))
    state = srm.assemble(
        mechanism,
        {"crank": -np.pi / 2},
        {"crank": rate},
        guess={"coupler": np.pi / 2, "rocker": -np.pi / 2},
    )
    return mechanism.with_state(state.q, state.v)


def damped(seconds: float, rtol: float = 1e-8) -> srm.Solution:
    """The slider-crank, braked at the crank, as it comes to rest hanging: a singular
    configuration."""

    def brake(t: float, q: Any, v: Any) -> np.ndarray:
        return np.array([-4.0 * v[0], 0.0])

    return srm.simulate(load("slider_crank"), seconds, rtol=rtol, controller=brake)


def test_a_motion_that_turns_back_well_before_a_change_point_is_no_bifurcation() -> None:
    solution = srm.simulate(swinging_up_to(1e-3), 3.0, rtol=1e-8)
    assert solution.success
    assert solution.bifurcations == ()
    assert "branch" not in solution.message


def test_a_motion_that_comes_to_rest_on_a_change_point_reports_branches_and_which_it_kept() -> None:
    solution = srm.simulate(swinging_up_to(1e-7), 1.0, rtol=1e-8)
    assert solution.success
    (bifurcation,) = solution.bifurcations
    assert bifurcation.start == pytest.approx(0.558, abs=1e-3)
    assert not bifurcation.driven
    assert bifurcation.distance < 1e-6
    assert bifurcation.loops == ("pin",)
    assert not bifurcation.stopped
    # the parallelogram: crank and rocker turn alike; the other branch is the antiparallelogram
    assert len(bifurcation.branches) == 2
    assert bifurcation.kept is not None
    kept = bifurcation.branches[bifurcation.kept]
    assert np.abs(kept / kept[0]) == pytest.approx([1.0, 1.0, 1.0])
    other = bifurcation.branches[1 - bifurcation.kept]
    assert abs(other[0] - other[2]) > 0.1
    assert np.abs(solution.q[:, 0] - solution.q[:, 2]).max() < 1e-9
    assert "turned back next to a singular configuration" in solution.message
    assert "loops 'pin'" in solution.message
    assert "2 branches" in solution.message


def test_of_a_driven_mechanism_that_rests_on_a_change_point_no_momentum_is_spoken_of() -> None:
    solution = srm.simulate(turning.driven(0.0, 1.0).mechanism, 4.0)
    (bifurcation,) = solution.bifurcations
    assert bifurcation.driven
    assert "turned back next to a singular configuration of" in solution.message
    assert "where branches meet: the run kept" in solution.message
    assert "momentum" not in solution.message


def test_a_braked_mechanism_comes_to_rest_on_a_singular_configuration() -> None:
    solution = damped(120.0)
    assert solution.success
    assert abs(solution.q[-1, 0] - 1.5 * np.pi) < 1e-7
    assert off_branch(solution.q) < 1e-6
    (bifurcation, *_) = solution.bifurcations
    assert bifurcation.loops == ("pin",)
    assert bifurcation.kept is not None
    kept = bifurcation.branches[bifurcation.kept]
    assert kept[1] / kept[0] == pytest.approx(-2.0, abs=1e-6)
    assert "stayed next to a singular configuration" in solution.message


def test_a_braked_mechanism_still_swings_accurately_at_small_amplitudes() -> None:
    solution = damped(40.0)
    free = reduced.slider_crank()

    def field(t: float, y: Any) -> list[float]:
        rate, acceleration = free(t, y)
        return [rate, acceleration - 2.0 * rate / (4.0 / 3.0 + 4.0 * np.sin(y[0]) ** 2)]

    theta, omega = reduced.integrate(field, START, 40.0)
    assert abs(theta - 1.5 * np.pi) < 2e-3, "the amplitude is small"
    assert abs(solution.q[-1, 0] - theta) < solution.settings.rtol
    assert abs(solution.v[-1, 0] - omega) < solution.settings.rtol


@pytest.mark.parametrize("step", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
def test_no_branch_is_switched_silently_by_long_fixed_steps(tableau: str, step: float) -> None:
    solution = srm.simulate(load("parallelogram"), 6.0, tableau=tableau, step=step)
    switched = np.abs(solution.q[:, 0] - solution.q[:, 2]).max() > 0.05
    reported = (
        not solution.success
        or "changed its branch" in solution.message
        or any(crossing.switched for crossing in solution.crossings)
    )
    assert reported or not switched


def test_a_step_that_would_switch_the_branch_is_redone() -> None:
    solution = srm.simulate(load("parallelogram"), 0.8, tableau="dop853", step=0.8)
    assert solution.success
    assert len(solution.replaced) > 0
    assert np.abs(solution.q[:, 0] - solution.q[:, 2]).max() < 1e-2
