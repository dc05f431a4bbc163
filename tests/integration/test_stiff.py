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
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Linearisation
from srm_mbs.integration.methods.linear_split_step import LinearSplitStep, linearised
from srm_mbs.integration.methods.stiffness import count_stiffness
from srm_mbs.integration.methods.tableaus import get_tableau
from tests.support.commands import run as command
from tests.support.convergence import fitted_order, observed_order, turning
from tests.support.mechanisms import floating_ring
from tests.support.reduced import parallelogram, regular_slider_crank, slider_crank
from tests.support.stiff import (
    braced_four_bar,
    braced_reference,
    bushed_four_bar,
    bushed_reference,
    by_radau,
    by_turns,
    driven_reference,
    follower,
    guided_four_bar,
    parallelogram_with_disc,
    rubbing,
    rubbing_slider_crank,
)
from tests.support.turning import lifted, sprung

BACKENDS = ("kernel", "python")
SLOW_PYTHON = ("kernel", pytest.param("python", marks=pytest.mark.stress))


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


def test_stiff_forces_of_a_controller_leave_at_least_order_four() -> None:
    """The problem of Prothero and Robinson: x' = -rate (x - sin t) + cos t, with a mass; the
    largest error of all stiffnesses, those between the orders included."""
    steps, errors = (0.05, 0.03, 0.02), np.zeros((2, 3))
    for rate in (1e2, 1e3, 1e6):
        mechanism, force = follower(rate)
        for k, h in enumerate(steps):
            run = srm.simulate(mechanism, 2.0, tableau="rodas5p", step=h, controller=force)
            own = abs(run.q[:, 0] - np.sin(run.t)).max(), abs(run.v[:, 0] - np.cos(run.t)).max()
            errors[:, k] = np.maximum(errors[:, k], own)
    assert errors.max() < 1e-8
    positions, rates = (fitted_order(steps, own) for own in errors)
    assert positions >= 4.5
    assert rates >= 4.0


# Linearisation

ROBOTS = Path(__file__).parents[1] / "data" / "robots"


def coupled_panda() -> srm.Mechanism:
    """An arm with damping, friction and a spring, whose first joints are coupled."""
    arm = srm.load(ROBOTS / "example_robot_data" / "panda.urdf")
    model, names = arm.model.copy(), arm.joint_names
    rubs = np.arange(model.nv) < 5
    model.damping, model.friction = np.where(rubs, 30.0, 0.0), np.where(rubs, 5.0, 0.0)
    links = [f.name for f in model.frames if f.type == pin.FrameType.BODY]
    spring = srm.SpringDamper(
        srm.Anchor(links[1]), srm.Anchor(links[-1]), stiffness=2e3, damping=5.0, rest_length=0.2
    )
    gear = srm.LoopClosure("coupling", joints=(names[0], names[1]), ratio=0.5)
    return replace(arm, model=model, forces=(spring,), loops=(gear,))


@pytest.mark.parametrize(
    "mechanism",
    [
        lambda: srm.load(ROBOTS / "dm_control" / "humanoid.xml"),
        lambda: srm.load(ROBOTS / "example_robot_data" / "simple_humanoid.urdf"),
        coupled_panda,
    ],
    ids=["free joint, damped", "composite joints", "coupling, spring, friction"],
)
def test_closed_form_derivatives_are_those_of_differences(
    mechanism: Callable[[], srm.Mechanism], monkeypatch: pytest.MonkeyPatch
) -> None:
    system = make_system(mechanism())
    n = system.tangent_size
    norm = ErrorNorm(np.full(n, 1e-6), 1e-6)
    random = 0.3 * np.random.default_rng(0).standard_normal(n)
    start = np.concatenate([system.mechanism.q0, system.mechanism.v0])
    state = system.retract(start, random)
    memory = LinearSplitStep(get_tableau("rodas5p")).start(system, 0.0, state, norm)

    def found() -> Linearisation:
        return linearised(system, 0.0, 1e-3, state, memory, norm, None)

    closed = found()
    assert system.derivatives(state, closed.rate[system.nv :]) is not None
    monkeypatch.setattr(type(system), "derivatives", lambda *_: None)
    differences = found()
    for name in ("J", "by_laws", "by_coordinates"):
        own, other = getattr(closed, name), getattr(differences, name)
        np.testing.assert_allclose(
            own, other, rtol=1e-6, atol=1e-6 * np.abs(other).max(initial=1.0)
        )


def test_a_linearisation_in_closed_form_takes_no_evaluation_for_each_coordinate() -> None:
    run = srm.simulate(coupled_panda(), 0.2, tableau="rodas5p")
    tried = run.stats.steps + run.stats.rejected
    assert run.stats.evaluations < 12 * tried


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


def test_a_stiff_damper_on_joints_of_a_tree_runs_alike_on_both_backends() -> None:
    """The joints of an open chain are linearised one by one unless forces act on several."""
    chain = srm.load("pendulum_chain")
    cable = srm.CouplingSpring(chain.joint_names[:2], (1.0, -0.7), damping=1e5)
    mechanism = replace(chain, forces=(cable,))
    runs = [srm.simulate(mechanism, 1.0, rtol=1e-8, backend=b) for b in BACKENDS]
    assert all(run.success and run.settings.stiff for run in runs)
    assert runs[0].stats.steps == runs[1].stats.steps
    np.testing.assert_allclose(runs[0].q[-1], runs[1].q[-1], atol=1e-8)


def test_friction_on_several_joints_runs_alike_on_both_backends() -> None:
    """It acts on a sum of rates that turns back while the joints do not."""
    chain = srm.load("pendulum_chain")
    cable = srm.CouplingSpring(chain.joint_names[:2], (1.0, -0.7), friction=4.0)
    mechanism = replace(chain, forces=(cable,), friction_speed=1e-4)
    runs = [srm.simulate(mechanism, 0.5, rtol=1e-6, backend=b) for b in BACKENDS]
    assert all(run.success and run.settings.stiff for run in runs)
    assert abs(runs[0].stats.steps - runs[1].stats.steps) <= 0.1 * runs[0].stats.steps
    np.testing.assert_allclose(runs[0].q[-1], runs[1].q[-1], atol=1e-6)
    model = chain.model
    data = model.createData()

    def field(t: float, y: FloatArray) -> FloatArray:
        q, v = np.split(y, 2)
        along = np.zeros(model.nv)
        along[:2] = 1.0, -0.7
        force = -4.0 * np.tanh(along @ v / 1e-4) * along - model.damping * v
        return np.concatenate([v, pin.aba(model, data, q, v, force)])

    start = np.concatenate([chain.q0, chain.v0])
    expected = solve_ivp(field, (0.0, 0.5), start, method="Radau", rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(runs[0].q[-1], expected.y[: model.nq, -1], atol=1e-5)


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


@pytest.mark.parametrize("backend", SLOW_PYTHON)
def test_the_cost_does_not_grow_with_forces_that_closures_take_up(backend: str) -> None:
    """A bushing with two directions on one degree of freedom: across the path of its point the
    force is proportional to the damping, and no motion follows from it."""
    steps, ends = [], []
    for tau in (1e-4, 1e-6, 1e-8):
        run = srm.simulate(guided_four_bar(tau), 0.15, tableau="rodas5p", backend=backend)
        steps.append(run.stats.steps)
        ends.append(end_of(run)[:3])
    assert max(steps) < 1.6 * min(steps)
    # The limit of infinite damping is met to the order of the time constant.
    np.testing.assert_allclose(ends[1], ends[2], rtol=0.0, atol=1e-5)


@pytest.mark.stress
def test_a_bushing_without_leverage_vibrates_as_its_reduced_equation_does() -> None:
    """Overdamped at first, and from the dead point of its damping on a vibration of 134 rad/s."""
    tau = 1e-4
    mechanism, times = braced_four_bar(tau), np.linspace(0.05, 0.6, 12)
    expected = braced_reference(mechanism, tau, times)
    for rtol in (1e-4, 1e-6):
        run = srm.simulate(mechanism, times[-1], rtol=rtol)
        q, v = run(times)
        np.testing.assert_allclose(q[:, 0], expected[:, 0], rtol=0.0, atol=10.0 * rtol)
        np.testing.assert_allclose(v[:, 0], expected[:, 1], rtol=0.0, atol=50.0 * rtol)
    ((start, end),) = run.settings.stiff
    assert start < 0.1 < end < times[-1]


# Singular configurations, drives, friction that turns


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_a_stiff_motion_passes_a_singular_configuration(rtol: float, backend: str) -> None:
    """Equal bars, driven from 45 to 137 degrees by an overdamped spring on the crank: the bars
    fold at 90 degrees.  2 (4/3 + 4 sin^2) theta'' = ... - c theta' - k (theta - 2.4), by Radau."""
    c, rest = 1e5, 2.4
    spring = srm.TorsionSpring("crank", stiffness=5.0 * c, rest_angle=rest, damping=c)
    mechanism = srm.load("slider_crank_whirl")
    times = np.linspace(0.05, 0.5, 10)
    run = srm.simulate(
        replace(mechanism, forces=(spring,)), 0.5, t_eval=times, rtol=rtol, backend=backend
    )
    free = slider_crank()

    def field(t: float, y: FloatArray) -> list[float]:
        torque = 0.5 * (-c * y[1] - 5.0 * c * (y[0] - rest))
        return [y[1], free(t, y)[1] + torque / (4.0 / 3.0 + 4.0 * np.sin(y[0]) ** 2)]

    expected = by_radau(field, [mechanism.q0[0], mechanism.v0[0]], times)
    assert run.success
    assert run.settings.stiff
    assert run.q[0, 0] < 0.5 * np.pi < run.q[-1, 0]
    np.testing.assert_allclose(run.q[:, 0], expected[:, 0], rtol=0.0, atol=20.0 * rtol)
    np.testing.assert_allclose(run.v[:, 0], expected[:, 1], rtol=0.0, atol=100.0 * rtol)
    assert run.stats.steps < 300


@pytest.mark.parametrize("backend", BACKENDS)
def test_driven_stiff_mechanisms_follow_their_reduced_equations(backend: str) -> None:
    tau, t_end = 1e-6, 0.2
    mechanism = bushed_four_bar(tau)
    drive = srm.Drive(srm.ConstantSpeed(float(mechanism.v0[0])), "crank")
    run = srm.simulate(replace(mechanism, drives=(drive,)), t_end, rtol=1e-7, backend=backend)
    assert run.settings.stiff
    expected = driven_reference(mechanism, tau, t_end)
    np.testing.assert_allclose(end_of(run)[:3], expected, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("backend", SLOW_PYTHON)
def test_friction_that_changes_its_direction_is_resolved(backend: str) -> None:
    """A pendulum, at rest at the start, that turns back twice, v_s = 1e-4, and when it does."""
    F, speed = 0.2, 1e-4
    mechanism = rubbing("simple_pendulum", F, speed)
    turning_back = srm.Event(lambda t, q, v: v[0])
    run = srm.simulate(mechanism, 2.5, rtol=1e-7, events=turning_back, backend=backend)
    model = mechanism.model
    data = model.createData()

    def field(t: float, y: FloatArray) -> list[float]:
        load = pin.computeGeneralizedGravity(model, data, y[:1])[0]
        return [y[1], -load - F * np.tanh(y[1] / speed)]

    start = [mechanism.q0[0], mechanism.v0[0]]
    reference = solve_ivp(
        field, (0.0, 2.5), start, "Radau", rtol=1e-9, atol=1e-11, events=lambda t, y: y[1]
    )
    assert run.t_events is not None
    found = run.t_events[0]
    assert len(found) == 2
    np.testing.assert_allclose(found, reference.t_events[0][1:], rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(end_of(run), reference.y[:, -1], rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("rtol", [1e-4, pytest.param(1e-6, marks=pytest.mark.stress), 1e-8])
def test_errors_of_runs_with_friction_are_within_ten_tolerances(rtol: float) -> None:
    """The crank of a slider-crank turns back until it rests, v_s = 1e-5, against Radau on the
    reduced equation."""
    F, speed = 5.0, 1e-5
    mechanism = rubbing("slider_crank_regular", F, speed)
    model = mechanism.model.copy()
    model.friction = np.where(np.arange(model.nv) == 0, F, 0.0)
    field = regular_slider_crank(lambda rate: -F * float(np.tanh(rate / speed)))
    times = np.linspace(0.2, 10.0, 50)
    expected = by_radau(field, [mechanism.q0[0], mechanism.v0[0]], times)
    run = srm.simulate(replace(mechanism, model=model), 10.0, rtol=rtol)
    assert run.settings.stiff
    assert abs(run(times)[0][:, 0] - expected[:, 0]).max() < 10.0 * rtol


@pytest.mark.parametrize("factor", [0.867, 1.0, 1.033, 1.267, 1.3])
def test_errors_of_fast_rates_do_not_grow_where_friction_slows_the_motion_down(
    factor: float,
) -> None:
    """A slider-crank that almost stops under the friction of its joints multiplies an error of its
    rate by 8 to 25 on the way, against integration from turn to turn."""
    mechanism, times = rubbing("slider_crank_regular", 0.5, 1e-6), np.linspace(0.1, 10.0, 100)
    v0 = factor * mechanism.v0
    expected = rubbing_slider_crank(0.5, np.array([mechanism.q0[0], v0[0]]), times)
    for rtol in (3e-4, 1e-4, 1e-5):
        run = srm.simulate(mechanism, 10.0, v0=v0, rtol=rtol)
        assert abs(run(times)[0][:, 0] - expected).max() < 10.0 * rtol


@pytest.mark.stress
@pytest.mark.parametrize("factor", [0.8, 1.1, 1.2, 1.6])
def test_errors_of_a_slider_crank_that_rubs_are_those_of_its_start(factor: float) -> None:
    """It multiplies an error of its start by 40 to 440: runs err by less than half of what one
    tolerance there becomes."""
    mechanism, times = rubbing("slider_crank_regular", 0.5, 1e-5), np.linspace(0.1, 10.0, 100)
    v0 = factor * mechanism.v0
    start = np.array([mechanism.q0[0], v0[0]])
    expected = rubbing_slider_crank(0.5, start, times)
    beside = rubbing_slider_crank(0.5, start + np.array([1e-5, 0.0]), times)
    grown = abs(beside - expected).max() / 1e-5
    assert grown > 40.0
    for rtol in (1e-4, 1e-5, 1e-6):
        run = srm.simulate(mechanism, 10.0, v0=v0, rtol=rtol)
        assert abs(run(times)[0][:, 0] - expected).max() < 0.5 * grown * rtol


@pytest.fixture(scope="module")
def turning_four_bar() -> tuple[srm.Mechanism, FloatArray, FloatArray]:
    """Joints turn back fifteen times; times, and positions by integration from turn to turn."""
    mechanism, times = rubbing("four_bar", 0.5, 1e-5), np.linspace(0.1, 4.0, 40)
    return mechanism, times, by_turns(mechanism, "crank", 0.5, times)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("rtol", [3e-4, 1e-4, 1e-6])
def test_joints_that_turn_back_against_friction_keep_the_tolerance(
    turning_four_bar: tuple[srm.Mechanism, FloatArray, FloatArray], rtol: float, backend: str
) -> None:
    mechanism, times, expected = turning_four_bar
    run = srm.simulate(mechanism, 4.0, rtol=rtol, backend=backend)
    assert abs(run(times)[0] - expected).max() < 10.0 * rtol
    assert run.stats.rejected < 0.2 * run.stats.steps


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_friction_sets_in_within_the_tolerance_where_a_motion_begins(
    rtol: float, backend: str
) -> None:
    """A pendulum falls from rest, v_s = 1e-6: the friction is constant from the first moment."""
    F = 0.5
    mechanism = rubbing("simple_pendulum", F, 1e-6)
    model = mechanism.model
    data = model.createData()
    falls = -np.sign(pin.computeGeneralizedGravity(model, data, mechanism.q0)[0])

    def field(t: float, y: FloatArray) -> list[float]:
        load = pin.computeGeneralizedGravity(model, data, y[:1])[0]
        return [y[1], -load - falls * F]

    times = np.linspace(0.05, 1.0, 20)
    start = [mechanism.q0[0], 0.0]
    expected = solve_ivp(field, (0.0, 1.0), start, "DOP853", times, rtol=1e-12, atol=1e-12).y
    run = srm.simulate(mechanism, 1.0, v0=[0.0], rtol=rtol, backend=backend)
    q, v = run(times)
    assert abs(q[:, 0] - expected[0]).max() < 2.0 * rtol
    assert abs(v[:, 0] - expected[1]).max() < 5.0 * rtol


@pytest.mark.parametrize("friction", [0.5, 2.0])
def test_four_bars_with_friction_converge_with_the_tolerance(friction: float) -> None:
    mechanism = rubbing("four_bar", friction, 1e-5)
    times = np.linspace(0.2, 10.0, 50)
    expected = srm.simulate(mechanism, 10.0, rtol=1e-10, tableau="rodas5p")(times)[0]
    for rtol in (1e-5, 1e-6, 1e-7):
        run = srm.simulate(mechanism, 10.0, rtol=rtol)
        assert abs(run(times)[0] - expected).max() < 15.0 * rtol


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
        "coupling": (coupled_panda(), {"t_end": 0.02}),
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


@pytest.mark.parametrize("backend", SLOW_PYTHON)
def test_implicit_steps_that_cost_more_than_they_save_are_left(backend: str) -> None:
    """At that tolerance they are little longer than explicit ones at the bound of stability, and
    one of them takes 6 times the evaluations: differences by 52 coordinates and rates."""
    platform = srm.load("stewart_platform")
    model = platform.model.copy()
    model.damping = np.full(model.nv, 300.0)
    options: dict[str, Any] = {"rtol": 1e-10, "backend": backend}
    auto, explicit = (
        srm.simulate(replace(platform, model=model), 3.0, tableau=tableau, **options)
        for tableau in ("auto", "dop853")
    )
    assert auto.steps.stiff.any()
    assert auto.stats.evaluations < 1.3 * explicit.stats.evaluations
    np.testing.assert_allclose(end_of(auto), end_of(explicit), rtol=0.0, atol=1e-9)


def test_a_try_of_implicit_steps_that_did_not_pay_doubles_what_the_next_one_needs() -> None:
    scheme = get_tableau("auto")
    memory = IntegratorState(np.zeros(2), np.inf, np.ones(2))

    def explicit_steps() -> int:
        count = 0
        while not memory.stiff:
            count_stiffness(memory, 7.0, 1.0, scheme)
            count += 1
        return count

    def implicit_steps(*stiffness: float) -> int:
        count = 0
        while memory.stiff:
            size = stiffness[min(count, len(stiffness) - 1)]
            count_stiffness(memory, size, 8.0, scheme.member(True))
            count += 1
        return count

    assert [(explicit_steps(), implicit_steps(7.0)) for _ in range(3)] == [
        (15, 5),
        (30, 5),
        (60, 5),
    ]
    assert (explicit_steps(), implicit_steps(1000.0, 7.0)) == (120, 6)  # the first one paid
    assert (explicit_steps(), implicit_steps(7.0)) == (15, 5)
    assert (explicit_steps(), implicit_steps(1.0)) == (30, 5)  # not stiff for a while
    assert explicit_steps() == 15


# Singular configurations


@pytest.mark.parametrize("backend", SLOW_PYTHON)
@pytest.mark.parametrize("tableau", ["auto", "rodas5p"])
@pytest.mark.parametrize("tau", [1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize("rate", [5.3, 4.7])
def test_stiff_motions_pass_singular_configurations_and_turn_back_beside_them(
    rate: float, tau: float, tableau: str, backend: str
) -> None:
    """At 4.7 rad/s at the bottom the parallelogram almost reaches its change points."""
    mechanism, field, start = parallelogram_with_disc(tau, rate)
    times = np.linspace(0.0, 2.0, 41)
    expected = by_radau(field, start, times, rtol=1e-11)
    for rtol in (1e-4, 1e-6, 1e-8, 1e-9):
        run = srm.simulate(mechanism, 2.0, rtol=rtol, tableau=tableau, backend=backend)
        assert run.success, run.message
        assert run.stats.steps < 400
        q, _ = run(times)
        assert np.abs(q[:, 0] - expected[:, 0]).max() < 10.0 * rtol
        assert np.abs(np.abs(q[:, 3]) - np.abs(expected[:, 1])).max() < rtol


@pytest.mark.parametrize("backend", SLOW_PYTHON)
@pytest.mark.parametrize("reach", [0.3, 0.08, 1e-3, -1e-3, -0.1])
def test_rodas5p_passes_singular_configurations_as_accurately_as_others(
    reach: float, backend: str
) -> None:
    motion = lifted(reach)
    passages = len(srm.simulate(motion.mechanism, motion.t_end, rtol=1e-10).crossings)
    for rtol in (1e-4, 1e-6, 1e-8):
        run = srm.simulate(
            motion.mechanism, motion.t_end, rtol=rtol, tableau="rodas5p", backend=backend
        )
        assert motion.error(run) < 20.0 * rtol
        assert run.stats.steps < 400
        assert len(run.crossings) == passages


@pytest.mark.parametrize("backend", SLOW_PYTHON)
@pytest.mark.parametrize("reach", [3e-3, 1e-3, 1e-4, -1e-4, -1e-3])
@pytest.mark.parametrize(("stiffness", "damping"), [(40.0, 0.5), (400.0, 1.0), (4000.0, 20.0)])
def test_rodas5p_turns_back_beside_singular_configurations_within_the_tolerance(
    stiffness: float, damping: float, reach: float, backend: str
) -> None:
    """More springs and dampers than degrees of freedom: what closures leave of them follows from
    nodes of the branch."""
    motion = sprung(reach, stiffness, damping)
    for rtol in (1e-6, 1e-8, 1e-9, 1e-10, 1e-11):
        run = srm.simulate(
            motion.mechanism, motion.t_end, rtol=rtol, tableau="rodas5p", backend=backend
        )
        assert motion.error(run) < 20.0 * rtol
        assert run.stats.steps < 300


def test_kernel_and_reference_turn_back_alike_beside_a_singular_configuration() -> None:
    motion = sprung(1e-3, 400.0, 1.0)
    kernel, reference = (
        srm.simulate(motion.mechanism, motion.t_end, rtol=1e-8, tableau="rodas5p", backend=backend)
        for backend in BACKENDS
    )
    assert kernel.stats.steps == pytest.approx(reference.stats.steps, rel=0.1)
    np.testing.assert_allclose(end_of(kernel), end_of(reference), rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("rtol", [1e-6, 1e-7, 1e-8])
def test_dry_friction_that_turns_back_in_a_dead_point_takes_the_energy_of_its_work(
    rtol: float,
) -> None:
    mechanism = rubbing("spatial_dead_point", 0.05, 1e-5)
    run = srm.simulate(mechanism, 4.0, rtol=rtol)
    assert run.success, run.message
    times = np.linspace(0.0, 4.0, 20001)
    _, v = run(times)
    power = 0.05 * np.abs(v).sum(axis=1)
    work = float((0.5 * (power[1:] + power[:-1]) * np.diff(times)).sum())
    data = mechanism.model.createData()
    energies = [
        pin.computeMechanicalEnergy(mechanism.model, data, run.q[i], run.v[i]) for i in (0, -1)
    ]
    assert energies[0] - energies[1] == pytest.approx(work, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "field"),
    [("slider_crank_whirl", slider_crank()), ("parallelogram", parallelogram())],
)
def test_rodas5p_keeps_order_five_through_singular_configurations(
    name: str, field: Callable[..., Any]
) -> None:
    mechanism, steps, errors = srm.load(name), (0.02, 0.015, 0.01, 0.0075, 0.005), []
    start = [mechanism.q0[0], mechanism.v0[0]]
    exact = solve_ivp(field, (0.0, 1.5), start, "DOP853", rtol=3e-14, atol=1e-16).y[:, -1]
    for h in steps:
        run = srm.simulate(mechanism, 1.5, tableau="rodas5p", step=h)
        assert run.success
        errors.append(max(abs(run.q[-1, 0] - exact[0]), abs(run.v[-1, 0] - exact[1])))
    assert len(run.crossings) > 0
    assert fitted_order(steps, errors) > 4.7


# Sweeps and the command line


@pytest.mark.parametrize("tableau", ["auto", "rodas5p"])
def test_sweeps_make_stiff_runs_as_single_runs_do(tableau: str) -> None:
    mechanism = bushed_four_bar(1e-6)
    cases = [{"q0": mechanism.q0, "v0": factor * mechanism.v0} for factor in (1.0, 0.5)]
    swept = srm.sweep(
        mechanism, cases, 0.1, tableau=tableau, measure=lambda run: {"q": run.q[-1, 1]}
    )
    for case, own in zip(cases, swept.table["q"]):
        start = mechanism.with_state(**case)
        assert own == srm.simulate(start, 0.1, tableau=tableau).q[-1, 1]


@pytest.mark.parametrize("tableau", ["auto", "rodas5p"])
def test_the_command_line_takes_the_tableaus_for_stiff_problems(
    tableau: str, tmp_path: Path
) -> None:
    out = tmp_path / "run.npz"
    shown = command(
        "simulate", "flyball_governor", "--t-end", 0.1, "--tableau", tableau, "--out", out
    )
    saved = srm.load_solution(out)
    own = srm.simulate(srm.load("flyball_governor"), 0.1, tableau=tableau)
    assert saved.settings == own.settings
    assert np.array_equal(saved.q, own.q)
    assert ("Stiff, with steps of rodas5p" in shown) == (tableau == "auto")


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


# Directions without inertia

HEAD = """<robot name="head"><link name="base"/><link name="yoke"/>
<link name="head"><inertial><origin xyz="0.02 0 0.1"/><mass value="1.3"/>
<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="roll" type="continuous"><parent link="base"/><child link="yoke"/>
<axis xyz="1 0 0"/>{dynamics}</joint>
<joint name="yaw" type="continuous"><parent link="yoke"/><child link="head"/>
<axis xyz="0 0 1"/>{dynamics}</joint></robot>"""
"""A point mass in the plane of two axes: it moves along one direction only."""


def test_damping_moves_a_joint_that_has_no_inertia_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "head.urdf").write_text(HEAD.format(dynamics='<dynamics damping="0.5"/>'))
    path = tmp_path / "head.toml"
    path.write_text('format = 1\nurdf = "head.urdf"\ngravity = [3.0, 4.0, -9.81]\n')
    mechanism = srm.load(path)
    (note,) = mechanism.notes
    assert "'roll' moves vanishes in one direction" in note
    run = srm.simulate(mechanism, 1.0, rtol=1e-7)
    model = mechanism.model.copy()
    model.armature = np.full(2, 1e-8)
    data = model.createData()

    def field(t: float, y: FloatArray) -> FloatArray:
        q, v = y[:2], y[2:]
        q = np.ravel(np.column_stack([np.cos(q), np.sin(q)]))
        return np.concatenate([v, pin.aba(model, data, q, v, -0.5 * v)])

    reference = solve_ivp(field, (0.0, 1.0), np.zeros(4), method="Radau", rtol=1e-9, atol=1e-11)
    angles = [run.joint(name)[0][-1] for name in ("roll", "yaw")]
    np.testing.assert_allclose(angles, reference.y[:2, -1], rtol=0.0, atol=1e-6)


def test_without_damping_such_a_start_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "head.urdf"
    path.write_text(HEAD.format(dynamics=""))
    with pytest.raises(srm.InputError, match="the joint 'roll' moves no inertia there"):
        srm.load(path)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("tableau", ["auto", "rodas5p"])
def test_a_transient_shorter_than_any_step_is_passed_over(tableau: str, backend: str) -> None:
    """A block of 1e-24 kg, pushed with 1 N against 1 N s/m."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "rail")
    inertia = pin.Inertia(1e-24, np.zeros(3), 1e-24 * np.eye(3))
    model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    model.addBodyFrame("block", joint, pin.SE3.Identity(), 0)
    model.damping = np.ones(1)
    block = srm.Mechanism(model, forces=(srm.JointTorque("rail", 1.0),))
    run = srm.simulate(block, 1.0, tableau=tableau, backend=backend)
    assert end_of(run) == pytest.approx([1.0, 1.0], abs=1e-8)
    assert run.stats.steps < 50
    explicit = srm.simulate(block, 1.0, tableau="dop853", backend=backend)
    assert "below the round-off" in explicit.message
