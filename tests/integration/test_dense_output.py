"""Dense output: accuracy, continuity, drift, any time in range."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.backends import needs_kernel, on_both
from tests.support.bundled import load
from tests.support.mechanisms import add_link, floating_ring, random_state


@pytest.mark.parametrize(("tableau", "bound"), [("dopr54", 1e-5), ("dop853", 1e-6)])
def test_dense_output_is_as_accurate_as_the_steps(tableau: str, bound: float) -> None:
    mechanism = load("four_bar")
    t = np.linspace(0.0, 2.0, 777)
    fine = srm.simulate(mechanism, 2.0, rtol=1e-12, atol=1e-12, t_eval=t)
    coarse = srm.simulate(mechanism, 2.0, rtol=1e-8, atol=1e-8, tableau=tableau)
    q, v = coarse(t)
    assert np.abs(q - fine.q).max() < bound
    assert np.abs(v - fine.v).max() < 10 * bound


def every_group() -> srm.Mechanism:
    """An open chain of a free, a (cos, sin), a planar, a ball and a plain joint, in motion."""
    model = pin.Model()
    model.name = "every_group"
    kinds = ("FreeFlyer", "RUBZ", "Planar", "Spherical", "RX")
    last = 0
    for name in kinds:
        last = add_link(model, last, getattr(pin, f"JointModel{name}")(), name)
    _, v = random_state(model, seed=3)
    return srm.Mechanism(model, (), v0=4.0 * v)


@needs_kernel
@pytest.mark.parametrize("name", ["four_bar", "stewart_platform", "slider_crank", "every_group"])
def test_readings_between_ends_of_steps_err_by_what_is_allowed(name: str) -> None:
    """Against a run a thousand times as accurate; they take fewer evaluations."""
    mechanism, rtol = every_group() if name == "every_group" else load(name), 1e-7
    solution, exact = (
        srm.simulate(mechanism, 2.0, rtol=r, backend="kernel") for r in (rtol, 1e-3 * rtol)
    )
    t = np.linspace(0.0, 2.0, 301)
    units = mechanism.structure.units
    allowed = rtol * units.state
    counts, found = [], []
    for read in (lambda: solution.states(t, allowed), lambda: solution.states(t)):
        before = solution.system.evaluations
        found.append(read())
        counts.append(solution.system.evaluations - before)
    assert counts[0] < 0.5 * counts[1]
    ends, dense = (
        np.abs(solution.observables.differences(exact.states(t), own) / allowed).max()
        for own in found
    )
    assert ends < dense + 1.0


@pytest.mark.parametrize("tableau", ["fe", "trap", "heun", "tvd32", "erk4", "dopr54", "dop853"])
def test_the_interpolant_joins_the_corrected_states(tableau: str) -> None:
    mechanism = load("slider_crank")
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
    solution = srm.simulate(load("slider_crank"), 4.0, rtol=1e-9)
    t = np.linspace(0.1, 3.9, 200)
    (q_after, _), (q_before, _) = solution(t + 1e-5), solution(t - 1e-5)
    assert np.abs((q_after - q_before) / 2e-5 - solution(t)[1]).max() < 1e-6


def test_closures_hold_between_the_steps_within_the_tolerance() -> None:
    solution = srm.simulate(
        load("four_bar"), 3.0, rtol=1e-8, atol=1e-8, t_eval=np.linspace(0.0, 3.0, 1501)
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
    solution = srm.simulate(load("four_bar"), 1.0)
    q, v = solution(0.3)
    assert q.shape == v.shape == (3,)
    t = np.array([0.9, 0.1, 0.5, 0.1])
    qs, _ = solution(t)
    assert qs.shape == (4, 3)
    assert np.array_equal(qs[1], qs[3])
    assert np.array_equal(qs[1], solution(0.1)[0])


@pytest.mark.parametrize("t", [-0.1, 1.1, np.nan])
def test_times_outside_the_run_are_refused(t: float) -> None:
    solution = srm.simulate(load("four_bar"), 1.0)
    with pytest.raises(ValueError, match="the run covers t = 0 to 1"):
        solution(t)


def test_extra_stages_are_evaluated_only_when_dense_output_is_read() -> None:
    mechanism = load("four_bar")
    solution = srm.simulate(mechanism, 1.0)
    spent = solution.stats.evaluations
    assert solution._system.evaluations == spent
    solution(0.5)
    assert solution._system.evaluations == spent + 3
    solution(0.5)
    assert solution._system.evaluations == spent + 3


def rotor(rate: float, *forces: srm.ForceElement) -> srm.Mechanism:
    """A rotor of 1 kg m^2 with a (cos, sin) joint, without gravity."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    joint = model.addJoint(0, pin.JointModelRUBZ(), pin.SE3.Identity(), "spin")
    model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    return srm.Mechanism(model, v0=[rate], forces=forces)


def test_angles_of_continuous_joints_are_unwrapped() -> None:
    """A free rotor turns at constant rate, many turns per step."""
    mechanism = rotor(3.0)
    solution = srm.simulate(mechanism, 40.0)
    position, rate = solution.joint("spin")
    assert position == pytest.approx(3.0 * solution.t, abs=1e-6)
    assert rate == pytest.approx(3.0)
    t = np.linspace(0.0, 40.0, 997)
    sampled = srm.simulate(mechanism, 40.0, t_eval=t)
    assert sampled.joint("spin")[0] == pytest.approx(3.0 * t, abs=1e-6)


def test_turns_are_counted_within_steps_in_which_the_rate_changes_by_many_turns() -> None:
    """omega = A cos t: the mean of the rates at the ends of a step is off by several turns."""
    A = 20000.0
    mechanism = rotor(A, srm.JointTorque("spin", A, law=srm.Sine(-1.0, omega=1.0)))
    t = np.linspace(0.0, 10.0, 997)
    event = srm.Event(lambda t, q, v: t - 4.7)
    for options in ({}, {"breakpoints": [3.3, 7.1]}, {"events": [event]}):
        solution = srm.simulate(mechanism, 10.0, rtol=1e-5, **options)
        assert solution.at(t).joint("spin")[0] == pytest.approx(A * np.sin(t), abs=1e-6)


def beside_a_slider_crank(joint: Any, rates: list[float]) -> srm.Mechanism:
    """The slider-crank, and a wheel that turns freely and evenly beside it."""
    base = load("slider_crank")
    model = base.model.copy()
    wheel = model.addJoint(0, joint, pin.SE3.Identity(), "wheel")
    even = pin.Inertia(1.0, np.zeros(3), 0.1 * np.eye(3))
    model.appendBodyToJoint(wheel, even, pin.SE3.Identity())
    q = pin.neutral(model)
    q[: base.model.nq] = base.q0
    return srm.Mechanism(model, base.loops, q0=q, v0=np.concatenate([base.v0, rates]))


@pytest.mark.parametrize("speed", [5.0, 60.0, 300.0])
@pytest.mark.parametrize("kind", ["cosine and sine", "ball"])
def test_joints_that_turn_fast_are_followed_beside_singular_configurations(
    kind: str, speed: float
) -> None:
    """Around passages the states of several steps are interpolated, over which joints may turn by
    many times pi."""
    if kind == "ball":
        axis = np.array([0.6, 0.0, 0.8])
        mechanism = beside_a_slider_crank(pin.JointModelSpherical(), (speed * axis).tolist())
    else:
        axis = np.array([0.0, 1.0, 0.0])
        mechanism = beside_a_slider_crank(pin.JointModelRUBY(), [speed])
    solution = srm.simulate(mechanism, 5.0, rtol=1e-5)
    assert len(solution.crossings) == 2
    data = mechanism.model.createData()
    times = solution.steps.times
    for fraction in (0.2, 0.5, 0.9):
        for t in times[:-1] + fraction * np.diff(times):
            pin.forwardKinematics(mechanism.model, data, solution(t)[0])
            turn = pin.exp3(speed * t * axis)
            assert np.abs(data.oMi[3].rotation - turn).max() < 1e-9


@on_both
def test_a_rotor_that_reverses_fast_is_followed_beside_singular_configurations(
    backend: str,
) -> None:
    """omega = A cos t; the crank goes round slowly, without gravity, past two passages."""
    A = 300.0
    base = beside_a_slider_crank(pin.JointModelRUBY(), [A])
    model = base.model.copy()
    model.gravity.linear = np.zeros(3)
    motor = srm.JointTorque("wheel", 0.1 * A, law=srm.Sine(-1.0, omega=1.0))
    mechanism = srm.Mechanism(model, base.loops, q0=base.q0, v0=[0.5, -1.0, A], forces=[motor])
    solution = srm.simulate(mechanism, 12.0, rtol=1e-4, backend=backend)
    assert len(solution.crossings) == 2
    t = np.linspace(0.0, 12.0, 997)
    q = solution(t)[0]
    own = model.joints[model.getJointId("wheel")].idx_q
    exact = A * np.sin(t)
    np.testing.assert_allclose(q[:, own], np.cos(exact), atol=1e-5)
    np.testing.assert_allclose(q[:, own + 1], np.sin(exact), atol=1e-5)
