"""Dense output: accuracy, continuity, drift, any time in range."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.mechanisms import floating_ring


@pytest.mark.parametrize(("tableau", "bound"), [("dopr54", 1e-5), ("dop853", 1e-6)])
def test_dense_output_is_as_accurate_as_the_steps(tableau: str, bound: float) -> None:
    mechanism = srm.load("four_bar")
    t = np.linspace(0.0, 2.0, 777)
    fine = srm.simulate(mechanism, 2.0, rtol=1e-12, atol=1e-12, t_eval=t)
    coarse = srm.simulate(mechanism, 2.0, rtol=1e-8, atol=1e-8, tableau=tableau)
    q, v = coarse(t)
    assert np.abs(q - fine.q).max() < bound
    assert np.abs(v - fine.v).max() < 10 * bound


@pytest.mark.parametrize("tableau", ["fe", "trap", "heun", "tvd32", "erk4", "dopr54", "dop853"])
def test_the_interpolant_joins_the_corrected_states(tableau: str) -> None:
    mechanism = srm.load("slider_crank")
    solution = srm.simulate(mechanism, 2.0, tableau=tableau, step=0.02)
    nodes = solution.steps.times
    q, v = solution(nodes)
    assert np.abs(q - solution.q).max() < 1e-13
    assert np.abs(v - solution.v).max() < 1e-12
    inside = nodes[1:-1]
    before, after = solution(inside - 1e-9), solution(inside + 1e-9)
    assert np.abs(before[0] - after[0]).max() < 1e-7
    assert np.abs(before[1] - after[1]).max() < 1e-7


def test_the_interpolant_is_a_motion_its_rates_are_its_derivative() -> None:
    solution = srm.simulate(srm.load("slider_crank"), 4.0, rtol=1e-9)
    t = np.linspace(0.1, 3.9, 200)
    (q_after, _), (q_before, _) = solution(t + 1e-5), solution(t - 1e-5)
    assert np.abs((q_after - q_before) / 2e-5 - solution(t)[1]).max() < 1e-6


def test_closures_hold_between_the_steps_within_the_tolerance() -> None:
    solution = srm.simulate(
        srm.load("four_bar"), 3.0, rtol=1e-8, atol=1e-8, t_eval=np.linspace(0.0, 3.0, 1501)
    )
    assert solution.drift[:, 0].max() < 1e-8
    assert solution.drift[:, 1].max() < 1e-6


def test_dense_output_on_lie_groups_stays_on_the_manifold_and_is_accurate() -> None:
    ring = floating_ring()
    t = np.linspace(0.0, 2.0, 101)
    solution = srm.simulate(ring, 2.0, rtol=1e-8, atol=1e-8)
    reference = srm.simulate(ring, 2.0, rtol=1e-12, atol=1e-12, t_eval=t)
    q, v = solution(t)
    for a, b in zip(q, reference.q):
        assert pin.isNormalized(ring.model, a, 1e-12)
        assert np.abs(pin.difference(ring.model, a, b)).max() < 1e-6
    assert np.abs(v - reference.v).max() < 1e-5


def test_a_scalar_time_gives_vectors_and_times_may_come_in_any_order() -> None:
    solution = srm.simulate(srm.load("four_bar"), 1.0)
    q, v = solution(0.3)
    assert q.shape == v.shape == (3,)
    t = np.array([0.9, 0.1, 0.5, 0.1])
    qs, _ = solution(t)
    assert qs.shape == (4, 3)
    assert np.array_equal(qs[1], qs[3])
    assert np.array_equal(qs[1], solution(0.1)[0])


@pytest.mark.parametrize("t", [-0.1, 1.1, np.nan])
def test_times_outside_the_run_are_refused(t: float) -> None:
    solution = srm.simulate(srm.load("four_bar"), 1.0)
    with pytest.raises(ValueError, match="dense output covers t = 0 to 1"):
        solution(t)


def test_extra_stages_are_evaluated_only_when_dense_output_is_read() -> None:
    mechanism = srm.load("four_bar")
    solution = srm.simulate(mechanism, 1.0)
    spent = solution.stats.evaluations
    assert solution._system.evaluations == spent
    solution(0.5)
    assert solution._system.evaluations == spent + 3
    solution(0.5)
    assert solution._system.evaluations == spent + 3


def test_dense_output_inside_the_zone_uses_the_prediction_of_the_run() -> None:
    solution = srm.simulate(srm.load("slider_crank"), 1.3, rtol=1e-12, max_step=5e-4)
    assert solution.stats.zone_steps > 0
    centre = solution.crossings[0].time
    q, _ = solution(np.linspace(centre - 1e-3, centre + 1e-3, 201))
    assert np.abs(q[:, 1] + 2.0 * q[:, 0]).max() < 1e-8


def test_angles_of_continuous_joints_are_unwrapped() -> None:
    """A free rotor with a (cos, sin) joint turns at constant rate, many turns per step."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    joint = model.addJoint(0, pin.JointModelRUBZ(), pin.SE3.Identity(), "spin")
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    mechanism = srm.Mechanism(model, v0=[3.0])
    solution = srm.simulate(mechanism, 40.0)
    position, rate = solution.joint("spin")
    assert position == pytest.approx(3.0 * solution.t, abs=1e-6)
    assert rate == pytest.approx(3.0)
    t = np.linspace(0.0, 40.0, 997)
    sampled = srm.simulate(mechanism, 40.0, t_eval=t)
    assert sampled.joint("spin")[0] == pytest.approx(3.0 * t, abs=1e-6)
