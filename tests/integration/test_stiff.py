"""Stiff problems: accuracy and cost of the linearly implicit steps, and when runs take them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from tests.support.convergence import fitted_order, observed_order, turning
from tests.support.mechanisms import floating_ring
from tests.support.stiff import bushed_four_bar, bushed_reference, follower, rubbing

BACKENDS = ("kernel", "python")


def end_of(solution: srm.Solution) -> FloatArray:
    assert solution.success, solution.message
    return np.concatenate([solution.q[-1], solution.v[-1]])


# Order


@pytest.mark.parametrize(
    ("mechanism", "steps"),
    [
        (turning("slider_crank_regular", 2.0), (0.02, 0.015, 0.01, 0.005)),
        (turning("four_bar", 4.0), (0.04, 0.02, 0.01)),
        (floating_ring(), (0.08, 0.04, 0.02, 0.01)),
    ],
    ids=["planar", "four-bar", "Lie group"],
)
def test_rodas5p_has_order_five_on_closed_loops(
    mechanism: srm.Mechanism, steps: tuple[float, ...]
) -> None:
    assert observed_order(mechanism, srm.PSRM("rodas5p"), steps) >= 4.7


@pytest.mark.parametrize("rate", [1e3, 1e6])
def test_stiff_forces_of_a_controller_leave_at_least_order_four(rate: float) -> None:
    """The problem of Prothero and Robinson: x' = -rate (x - sin t) + cos t, with a mass."""
    mechanism, force = follower(rate)
    steps = (0.2, 0.15, 0.1, 0.075)
    errors = []
    for h in steps:
        run = srm.simulate(mechanism, 3.0, tableau="rodas5p", step=h, controller=force)
        errors.append(abs(run.q[:, 0] - np.sin(run.t)).max())
    assert errors[-1] < 1e-5
    assert fitted_order(steps, errors) >= 3.9


# Accuracy and cost


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("tau", [1e-4, 1e-6])
def test_a_loop_closed_by_a_bushing_follows_its_equations(tau: float, backend: str) -> None:
    mechanism, t_end = bushed_four_bar(tau), 0.1
    expected = bushed_reference(mechanism, tau, t_end)
    run = srm.simulate(mechanism, t_end, rtol=1e-7, backend=backend)
    assert abs(end_of(run)[:3] - expected[:3]).max() < 1e-5
    assert run.settings.stiff


def test_the_cost_does_not_grow_with_the_damping_of_a_bushing() -> None:
    steps = [
        srm.simulate(bushed_four_bar(tau), 1.0, rtol=1e-6, tableau="rodas5p").stats.steps
        for tau in (1e-4, 1e-6, 1e-8)
    ]
    assert max(steps) < 2 * min(steps)


@pytest.mark.parametrize("backend", BACKENDS)
def test_joints_that_rub_come_to_rest_at_loose_tolerances(backend: str) -> None:
    """Pendulum with -F tanh(v/v_s), v_s = 1e-5, against Radau on the formula: m l = m l^2 = 1."""
    F, speed = 2.0, 1e-5
    mechanism = rubbing("simple_pendulum", F, speed)
    rtol = 1e-4
    run = srm.simulate(mechanism, 6.0, rtol=rtol, backend=backend)
    model = mechanism.model
    data = model.createData()

    def load(q: float) -> float:
        return float(pin.computeGeneralizedGravity(model, data, np.array([q]))[0])

    start = [mechanism.q0[0], mechanism.v0[0]]
    reference = solve_ivp(
        lambda t, y: [y[1], -load(y[0]) - F * np.tanh(y[1] / speed)],
        (0.0, 6.0),
        start,
        method="Radau",
        rtol=1e-9,
        atol=1e-11,
    )
    assert abs(end_of(run)[0] - reference.y[0, -1]) < 10.0 * rtol
    assert run.stats.steps < 400


def test_friction_at_rest_creeps_by_its_formula() -> None:
    """On a slope below the friction: v = v_s artanh(load / F)."""
    F, speed = 2.0, 1e-5
    run = srm.simulate(rubbing("simple_pendulum", F, speed), 8.0, rtol=1e-6)
    model = run.mechanism.model
    q = float(run.q[-1, 0])
    load = float(pin.computeGeneralizedGravity(model, model.createData(), np.array([q]))[0])
    assert run.v[-1, 0] == pytest.approx(speed * np.arctanh(-load / F), rel=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_extreme_joint_damping_in_a_file_runs(backend: str) -> None:
    mechanism = srm.load("four_bar")
    model = mechanism.model.copy()
    model.damping = np.full(model.nv, 1e9)
    run = srm.simulate(replace(mechanism, model=model), 1.0, backend=backend)
    assert run.success
    assert run.stats.steps < 500
    assert abs(run.v[-1]).max() < 1e-6


def test_a_stiff_damper_on_several_joints_runs_alike_on_both_backends() -> None:
    """Joint coordinates y = q_a - q_b/2 creep with the damping, so that the four-bar hardly moves:
    the moment of the weight on y is c dy/dt."""
    cable = srm.CouplingSpring(("crank", "rocker"), (1.0, -0.5), damping=1e5)
    mechanism = replace(srm.load("four_bar"), forces=(cable,))
    runs = [srm.simulate(mechanism, 1.0, rtol=1e-8, backend=b) for b in BACKENDS]
    assert all(run.success and run.settings.stiff and run.stats.steps < 300 for run in runs)
    np.testing.assert_allclose(runs[0].q[-1], runs[1].q[-1], atol=1e-8)
    free = srm.load("four_bar")
    # By virtual work, dE/dt = -c y'^2 while the kinetic energy is negligible.
    crank, rocker = (runs[0].joint(name)[1] for name in ("crank", "rocker"))
    late = runs[0].t > 0.1
    lost = np.gradient(srm.simulate(free, 1e-9).energy[0] - runs[0].energy, runs[0].t)
    power = 1e5 * (crank - 0.5 * rocker) ** 2
    np.testing.assert_allclose(lost[late][1:-1], power[late][1:-1], rtol=0.05)


def test_undamped_stiff_springs_stay_with_explicit_steps() -> None:
    """A vibration that steps have to follow is not stiff."""
    mechanism = srm.load("four_bar")
    spring = srm.TorsionSpring(joint="crank", stiffness=1e6, rest_angle=1.0)
    for rtol in (1e-3, 1e-6, 1e-9):
        run = srm.simulate(replace(mechanism, forces=(spring,)), 0.3, rtol=rtol)
        own = srm.simulate(replace(mechanism, forces=(spring,)), 0.3, rtol=rtol, tableau="dop853")
        assert not run.settings.stiff
        assert run.stats.steps == own.stats.steps
        assert np.array_equal(run.q, own.q)


# Both backends


def user_damper(t: float, q: Any, v: Any) -> FloatArray:
    return -1e5 * np.asarray(v)


def swaying(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
    return np.array([np.sin(5.0 * t), 0.0, 0.0])


def cases() -> dict[str, tuple[srm.Mechanism, dict[str, Any]]]:
    follower_mechanism, force = follower(1e5)
    ring = floating_ring()
    damped = ring.model.copy()
    damped.damping = np.where(np.arange(damped.nv) < 6, 0.0, 1e4)
    driven = srm.load("four_bar")
    own = srm.UserForce(user_damper, name="damper")
    return {
        "bushing": (bushed_four_bar(1e-6), {}),
        "friction": (rubbing("four_bar", 2.0, 1e-3), {"t_end": 6.0, "rtol": 1e-8}),
        "governor": (srm.load("flyball_governor"), {}),
        "controller": (follower_mechanism, {"controller": force}),
        "sampled": (bushed_four_bar(1e-6), {"controller": swaying, "sample_time": 5e-2}),
        "user force": (replace(driven, forces=(own,)), {"t_end": 0.1}),
        "Lie group": (replace(ring, model=damped), {}),
    }


@pytest.mark.parametrize("tableau", ["auto", "rodas5p"])
@pytest.mark.parametrize("name", list(cases()))
def test_kernel_and_reference_make_the_same_steps(name: str, tableau: str) -> None:
    mechanism, options = cases()[name]
    given = {"t_end": 0.3, "tableau": tableau, "rtol": 1e-6} | options
    kernel, reference = (srm.simulate(mechanism, **given, backend=b) for b in BACKENDS)
    assert kernel.success
    # Where steps grow from a very short first one, rounding decides by how much.
    first, other = kernel.steps.states[1], reference.steps.states[1]
    np.testing.assert_allclose(first, other, rtol=0.0, atol=1e-9)
    assert kernel.stats.steps == pytest.approx(reference.stats.steps, rel=0.15)
    np.testing.assert_allclose(end_of(kernel), end_of(reference), rtol=0.0, atol=2e-5)
    times = np.linspace(0.0, float(kernel.t[-1]), 41)
    for read, other in zip(kernel(times), reference(times)):
        np.testing.assert_allclose(read, other, rtol=0.0, atol=2e-4)


# What runs say


def test_a_run_says_where_it_was_stiff_and_keeps_it(tmp_path: Path) -> None:
    run = srm.simulate(bushed_four_bar(1e-6), 0.2)
    ((start, end),) = run.settings.stiff
    assert 0.0 < start < 1e-3
    assert end == 0.2
    assert "Stiff, with steps of rodas5p: t = " in run.message
    assert run.settings.tableau == "auto"
    run.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    assert loaded.settings == run.settings
    times = np.linspace(0.0, 0.2, 33)
    assert np.array_equal(loaded(times)[0], run(times)[0])


def test_a_tableau_named_by_the_user_is_kept_and_the_message_says_what_to_use() -> None:
    run = srm.simulate(bushed_four_bar(1e-4), 0.02, tableau="dop853")
    assert "The run is stiff from t = " in run.message
    assert 'Use tableau="auto" or "rodas5p"' in run.message
    assert srm.simulate(srm.load("four_bar"), 1.0, tableau="dop853").settings.stiff == ()


def test_output_times_read_stiff_runs_as_their_steps_do() -> None:
    mechanism, times = bushed_four_bar(1e-6), np.linspace(0.0, 0.5, 11)
    read = srm.simulate(mechanism, 0.5, t_eval=times)
    whole = srm.simulate(mechanism, 0.5)
    np.testing.assert_allclose(read.q, whole(times)[0], rtol=0.0, atol=1e-13)
    assert read.settings.stiff == whole.settings.stiff


def test_dense_output_of_stiff_steps_is_within_the_tolerance() -> None:
    mechanism = bushed_four_bar(1e-4)
    loose, tight = (srm.simulate(mechanism, 0.5, rtol=rtol) for rtol in (1e-6, 1e-9))
    times = np.linspace(0.01, 0.5, 200)
    at_ends = abs(loose(tight.t[-1:])[0] - tight.q[-1]).max()
    inside = abs(loose(times)[0] - tight(times)[0]).max()
    assert inside < max(20.0 * at_ends, 1e-4)


def test_events_and_their_actions_go_on_with_stiff_steps() -> None:
    bounce = srm.Event(lambda t, q, v: q[0] - 1.05, action=lambda t, q, v: (q, v), direction=1.0)
    mechanism = bushed_four_bar(1e-6)
    run = srm.simulate(mechanism, 0.3, events=bounce)
    plain = srm.simulate(mechanism, 0.3)
    assert run.success
    assert len(run.segments) == 2
    assert run.segments[1].steps.stiff[0]
    np.testing.assert_allclose(end_of(run)[:3], end_of(plain)[:3], rtol=0.0, atol=1e-4)


def test_breakpoints_keep_the_scheme_in_use() -> None:
    mechanism = bushed_four_bar(1e-6)
    run = srm.simulate(mechanism, 0.3, breakpoints=[0.1, 0.2])
    assert len(run.settings.stiff) == 1
    plain = srm.simulate(mechanism, 0.3)
    np.testing.assert_allclose(end_of(run)[:3], end_of(plain)[:3], rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_simulator_takes_stiff_steps(backend: str) -> None:
    mechanism = bushed_four_bar(1e-6)
    simulator = srm.Simulator(mechanism, backend=backend)
    for _ in range(20):
        simulator.step(0.01)
    assert simulator.stats.steps < 1500
    clone = simulator.clone()
    q, _ = simulator.step(0.01)
    assert np.array_equal(clone.step(0.01)[0], q)
    plain = srm.simulate(mechanism, 0.21, rtol=1e-8)
    assert abs(q - plain.q[-1]).max() < 1e-3


def test_a_run_that_is_no_longer_stiff_returns_to_explicit_steps() -> None:
    """A stiff damper that acts up to 0.2 s only."""
    mechanism = srm.load("four_bar")

    def brake(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        return -1e5 * v * (t <= 0.2)

    run = srm.simulate(
        replace(mechanism, v0=np.zeros(3)), 2.0, controller=brake, breakpoints=[0.2], rtol=1e-8
    )
    ((_, end),) = run.settings.stiff
    assert 0.2 < end < 1.0
    free = srm.simulate(mechanism.moved(*run(0.2)), 1.8, rtol=1e-10, tableau="dop853")
    np.testing.assert_allclose(end_of(run), end_of(free), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("kind", [srm.SRM, lambda name: srm.PSRM(name, correction="sweep")])
def test_sweeps_refuse_implicit_schemes(kind: Callable[[str], Any]) -> None:
    with pytest.raises(ValueError, match="sweeps are explicit, the tableau 'rodas5p' is not"):
        kind("rodas5p")


def test_a_stiff_dae_is_solved() -> None:
    """x' = -1e5 (x - cos t) - sin t beside z = 1."""
    rate = 1e5

    def f(t: float, x: FloatArray) -> FloatArray:
        return np.array([-rate * (x[0] - np.cos(t)) - np.sin(t), 0.0])

    problem = srm.SemiExplicitDAE(
        f=f,
        B=lambda t, x: np.array([[0.0], [1.0]]),
        g=lambda t, x: np.array([x[1] - 1.0]),
        G=lambda t, x: np.array([[0.0, 1.0]]),
    )
    run = srm.solve_dae(problem, (0.0, 2.0), [1.0, 1.0], rtol=1e-6)
    assert run.success
    assert abs(run.x[-1, 0] - np.cos(2.0)) < 1e-5
    assert run.stats.steps < 500
