"""A mechanism stepped from outside: the same motion as a run, and what control loops need."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from threading import Event, Thread
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.backends import needs_kernel, on_both
from tests.support.mechanisms import floating_ring
from tests.support.memory import ON_LINUX, growth
from tests.support.snapshots import check_messages, refused


@on_both
def test_two_threads_do_not_use_one_simulator_at_once(backend: str) -> None:
    inside, go_on = Event(), Event()

    def wait(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if t > 0.0:
            inside.set()
            go_on.wait(10.0)
        return np.zeros(3)

    mechanism = replace(srm.load("four_bar"), forces=(srm.UserForce(wait, name="wait"),))
    simulator = srm.Simulator(mechanism, backend=backend)
    thread = Thread(target=simulator.step, args=(0.1,))
    thread.start()
    assert inside.wait(10.0)
    for call in (
        lambda: simulator.step(0.1),
        simulator.reset,
        simulator.set_state,
        simulator.clone,
    ):
        with pytest.raises(srm.InputError, match="another thread uses this simulator"):
            call()
    go_on.set()
    thread.join()
    alone = srm.Simulator(mechanism, backend=backend)
    alone.step(0.1)
    np.testing.assert_array_equal(simulator.q, alone.q)
    assert simulator.clone().t == simulator.t


@pytest.fixture(scope="module")
def slider_crank() -> srm.Mechanism:
    return srm.load("slider_crank")


@on_both
@pytest.mark.parametrize("dt", [0.01, 0.37])
def test_steps_follow_the_motion_through_singular_configurations(
    slider_crank: srm.Mechanism, backend: str, dt: float
) -> None:
    simulator = srm.Simulator(slider_crank, rtol=1e-9, backend=backend)
    for _ in range(round(2.6 / dt)):
        q, v = simulator.step(dt)
    exact = srm.simulate(slider_crank, simulator.t, rtol=1e-12)
    assert len(exact.crossings) == 1
    assert np.abs(q - exact.q[-1]).max() < 1e-9
    assert np.abs(v - exact.v[-1]).max() < 1e-8
    assert np.array_equal(simulator.q, q)
    assert np.array_equal(simulator.v, v)
    assert simulator.stats.steps >= round(2.6 / dt)


@on_both
def test_held_forces_are_those_of_a_sampled_controller(
    slider_crank: srm.Mechanism, backend: str
) -> None:
    """At different inner steps, within the tolerance."""

    def law(t: float, q: Any, v: Any) -> np.ndarray:
        return np.array([4.0 * np.sin(5.0 * t) - v[0], 0.0])

    simulator = srm.Simulator(slider_crank, rtol=1e-10, backend=backend)
    for k in range(40):
        simulator.step(0.05, law(0.05 * k, simulator.q, simulator.v))
    run = srm.simulate(slider_crank, 2.0, controller=law, sample_time=0.05, rtol=1e-10)
    assert np.abs(simulator.q - run.q[-1]).max() < 1e-9
    assert np.abs(simulator.v - run.v[-1]).max() < 1e-8


@on_both
@pytest.mark.parametrize(("tableau", "order"), [("erk4", 4.0), ("tvd32", 3.0)])
def test_fixed_inner_steps_have_the_order_of_the_tableau(
    slider_crank: srm.Mechanism, backend: str, tableau: str, order: float
) -> None:
    exact = srm.simulate(
        slider_crank,
        0.9,
        controller=lambda t, q, v: [3.0 if int(t / 0.3 + 1e-9) % 2 else -3.0, 0.0],
        breakpoints=[0.3, 0.6],
        rtol=1e-12,
    )
    errors = []
    for step in (0.02, 0.01, 0.005):
        simulator = srm.Simulator(slider_crank, step=step, tableau=tableau, backend=backend)
        for k in range(3):
            simulator.step(0.3, [3.0 if k % 2 else -3.0, 0.0])
        errors.append(np.abs(simulator.q - exact.q[-1]).max())
        assert simulator.stats.steps == 3 * round(0.3 / step)
    assert np.log2(errors[0] / errors[-1]) / 2.0 > order - 0.3


@on_both
@pytest.mark.parametrize("step", [None, 0.02])
@pytest.mark.parametrize("name", ["slider_crank", "ring"])
def test_a_clone_continues_identically_and_independently(
    name: str, step: float | None, backend: str
) -> None:
    mechanism = floating_ring() if name == "ring" else srm.load(name)
    force = np.linspace(0.0, 0.1, mechanism.model.nv)
    original = srm.Simulator(mechanism, step=step, backend=backend)
    assert np.array_equal(original.clone().step(0.05)[0], original.step(0.05)[0])
    for k in range(6):
        original.step(0.05, k * force)
    copy = original.clone()
    here = copy.t, copy.q, copy.v
    ahead = [original.step(0.05, force) for _ in range(10)]
    assert (copy.t, copy.q.tolist(), copy.v.tolist()) == (
        here[0],
        here[1].tolist(),
        here[2].tolist(),
    )
    for q, v in ahead:
        again = copy.step(0.05, force)
        assert np.array_equal(again[0], q)
        assert np.array_equal(again[1], v)
    assert copy.t == original.t


@on_both
def test_a_clone_knows_the_force_that_acted_before(
    slider_crank: srm.Mechanism, backend: str
) -> None:
    simulator = srm.Simulator(slider_crank, rtol=1e-4, backend=backend)
    for torque in (0.0, 30.0, 30.0):
        simulator.step(0.1, [torque, 0.0])
    clone = simulator.clone()
    for each in (simulator, clone):
        each.step(0.1, [0.0, 0.0])
    assert np.array_equal(clone.v, simulator.v)


def test_copies_are_clones(slider_crank: srm.Mechanism) -> None:
    simulator = srm.Simulator(slider_crank)
    simulator.step(0.1)
    for other in (copy.copy(simulator), copy.deepcopy(simulator)):
        other.step(0.1)
        assert simulator.t == 0.1
        assert other.t == 0.2


@on_both
def test_steps_within_rounding_move_the_time_and_spoil_nothing(
    slider_crank: srm.Mechanism, backend: str
) -> None:
    simulator = srm.Simulator(slider_crank, rtol=1e-9, backend=backend)
    plain = srm.Simulator(slider_crank, rtol=1e-9, backend=backend)
    for _ in range(3):
        simulator.step(1e-17)
    for each in (simulator, plain):
        each.step(1.0)
    simulator.step(np.spacing(1.0))
    assert simulator.t == 1.0 + np.spacing(1.0)
    for each in (simulator, plain):
        each.step(0.5)
    assert simulator.t == pytest.approx(1.5, abs=1e-15)
    assert np.abs(simulator.q - plain.q).max() < 1e-9


@on_both
def test_the_rounding_of_times_does_not_add_up_over_equal_steps(
    slider_crank: srm.Mechanism, backend: str
) -> None:
    """Ten times 0.1 adds up to 1 - 1.1e-16, a hundred times to 10 - 2e-14."""
    simulator = srm.Simulator(slider_crank, rtol=1e-3, backend=backend)
    simulator.reset(t=2.0)
    for _ in range(100):
        simulator.step(0.1)
    assert simulator.t == 12.0
    simulator.step(12.7 - simulator.t)
    assert simulator.t == 12.7
    for _ in range(50):
        simulator.step(0.1)
    copy = simulator.clone()
    for each in (simulator, copy):
        for _ in range(50):
            each.step(0.1)
        assert each.t == 12.7 + 100 * 0.1
    copy.reset(t=12.7)
    assert copy.t == 12.7


@on_both
def test_times_are_of_double_precision_whatever_the_type_of_a_step(
    slider_crank: srm.Mechanism, backend: str
) -> None:
    simulator = srm.Simulator(slider_crank, backend=backend)
    simulator.reset(t=1000.0)
    dt = np.float32(0.001)
    for _ in range(10):
        simulator.step(dt)
    assert simulator.t == pytest.approx(1000.0 + 10 * float(dt), abs=1e-11)


@on_both
def test_states_may_be_changed_in_place(slider_crank: srm.Mechanism, backend: str) -> None:
    simulator = srm.Simulator(slider_crank, backend=backend)
    q, v = simulator.step(0.1)
    before = q.copy(), v.copy()
    for array in (q, v, simulator.q, simulator.v):
        array[:] = np.nan
    np.testing.assert_array_equal((simulator.q, simulator.v), before)


@on_both
def test_forces_may_be_changed_in_place(slider_crank: srm.Mechanism, backend: str) -> None:
    simulator, other = (srm.Simulator(slider_crank, backend=backend) for _ in range(2))
    tau = np.zeros(2)
    for k in range(10):
        tau[0] = k
        simulator.step(0.05, tau)
        other.step(0.05, [float(k), 0.0])
    assert np.array_equal(simulator.q, other.q)


@on_both
def test_a_reset_repeats_the_run_to_the_last_bit(slider_crank: srm.Mechanism, backend: str) -> None:
    simulator = srm.Simulator(slider_crank, backend=backend)
    first = [simulator.step(0.05, [0.3, 0.0]) for _ in range(30)]
    q, _ = simulator.reset()
    assert np.array_equal(q, slider_crank.q0)
    assert simulator.t == 0.0
    second = [simulator.step(0.05, [0.3, 0.0]) for _ in range(30)]
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(first, second))
    assembly = srm.assemble(slider_crank, q={"crank": 1.2}, v={"crank": 0.7})
    q, _ = simulator.reset(assembly.q, assembly.v, t=5.0)
    assert simulator.t == 5.0
    assert np.array_equal(q, assembly.q)
    simulator.step(0.1)
    assert simulator.t == 5.1
    run = srm.simulate(slider_crank, 0.1, q0=assembly.q, v0=assembly.v, rtol=1e-10)
    assert np.abs(simulator.q - run.q[-1]).max() < 1e-6


def test_states_off_the_closures_can_be_projected(slider_crank: srm.Mechanism) -> None:
    simulator = srm.Simulator(slider_crank)
    simulator.step(0.3)
    q, v = simulator.q, simulator.v
    off = np.array([0.0, 0.01])
    simulator.set_state(q + off, v + 20.0 * off[::-1], project=True)
    assert simulator.t == 0.3
    moved, rate = simulator.q, simulator.v
    assert np.abs(moved - q).max() < 0.02
    # On both bars of the slider-crank: theta_2 = -2 theta_1.
    assert moved[1] - q[1] == pytest.approx(-2.0 * (moved[0] - q[0]), abs=1e-12)
    assert rate[1] == pytest.approx(-2.0 * rate[0], abs=1e-12)
    simulator.step(0.1)


@pytest.mark.parametrize("beside", [0.0, 1e-9, -1e-7, 1e-5])
def test_states_beside_a_singular_configuration_are_projected_onto_their_branch(
    beside: float,
) -> None:
    """Those of a run are 1e-9 off it; the bars of this parallelogram stay parallel."""
    parallelogram = srm.load("parallelogram")
    run = srm.simulate(parallelogram, 0.5)
    q, v = run(run.crossings[0].time + beside)
    simulator = srm.Simulator(parallelogram)
    simulator.set_state(q, v, project=True)
    moved, rate = simulator.q, simulator.v
    assert np.abs(moved - q).max() < 1e-9
    assert np.abs(rate - rate[0] * np.array([1.0, -1.0, 1.0])).max() < 1e-9


@on_both
def test_a_failed_step_raises_and_leaves_the_last_good_state(
    slider_crank: srm.Mechanism, backend: str
) -> None:
    simulator = srm.Simulator(slider_crank, backend=backend)
    simulator.step(0.2)
    with pytest.raises(srm.SimulationError, match=r"Stopped at t = 0\.2"):
        simulator.step(0.1, [1e150, 0.0])
    assert simulator.t == pytest.approx(0.2, abs=1e-3)
    assert np.isfinite(simulator.q).all()
    closed = srm.assemble(slider_crank, q={"crank": float(simulator.q[0])})
    assert np.abs(closed.q - simulator.q).max() < 1e-8
    simulator.reset()
    simulator.step(0.2)


@on_both
def test_forces_may_be_named_by_their_joints(backend: str) -> None:
    ring = floating_ring()
    joint = ring.joint("b")
    tau = np.zeros(ring.model.nv)
    tau[joint.idx_v : joint.idx_v + joint.nv] = 1.0, -0.5, 0.2
    simulators = [srm.Simulator(ring, backend=backend) for _ in range(3)]
    for simulator, force in zip(simulators, (tau, {"b": [1.0, -0.5, 0.2]}, {}), strict=True):
        for _ in range(3):
            simulator.step(0.05, force)
    by_number, by_name, none = (np.append(s.q, s.v) for s in simulators)
    assert np.array_equal(by_number, by_name)
    assert np.abs(none - by_name).max() > 1e-3


@on_both
def test_bad_steps_and_times_are_refused(slider_crank: srm.Mechanism, backend: str) -> None:
    simulator = srm.Simulator(slider_crank, backend=backend)
    simulator.step(0.1)
    messages = {}
    for start in ("on the way", "at the start"):
        t = simulator.t
        for dt in (0.0, np.nan, "soon", None):
            messages[f"dt = {dt} {start}"] = refused(lambda: simulator.step(dt))  # noqa: B023
        for tau in ([1.0], [np.nan, 0.0], "x", {"shaft": 1.0}, {"crank": [1.0, 2.0]}):
            refusal = refused(lambda: simulator.step(0.1, tau))  # noqa: B023
            messages[f"tau = {tau} {start}"] = refusal
        assert simulator.t == t
        simulator.reset()
    for t in (np.nan, "now"):
        messages[f"t = {t}"] = refused(lambda: simulator.reset(t=t))  # noqa: B023
    simulator.reset(t=1e15)
    messages["dt below rounding"] = refused(lambda: simulator.step(0.01))
    messages["pickle"] = refused(lambda: pickle.dumps(simulator))
    q, v = slider_crank.q0, slider_crank.v0
    off = np.array([0.0, 0.01])
    messages["q off the closures"] = refused(lambda: simulator.set_state(q + off))
    messages["v off the closures"] = refused(lambda: simulator.set_state(v=v + off))
    messages["q too short"] = refused(lambda: simulator.reset(q[:1]))
    messages["v too short"] = refused(lambda: simulator.reset(v=v[:1]))
    messages["q too short to be projected"] = refused(lambda: simulator.reset(q[:1], project=True))
    messages["q of a reset off the closures"] = refused(lambda: simulator.reset(q + off, v))
    messages["v of a reset off the closures"] = refused(lambda: simulator.reset(q, v + off))
    assert np.array_equal(simulator.q, q)
    floating = srm.Simulator(floating_ring(), backend=backend)
    messages["quaternion of length 2"] = refused(lambda: floating.reset(2.0 * floating.q))
    check_messages("simulator", messages)


def test_other_methods_run_on_the_reference(slider_crank: srm.Mechanism) -> None:
    simulator = srm.Simulator(slider_crank, method=srm.SRM("erk4"), step=0.002)
    for _ in range(10):
        simulator.step(0.01)
    exact = srm.simulate(slider_crank, 0.1, rtol=1e-10)
    assert np.abs(simulator.q - exact.q[-1]).max() < 1e-5


def test_a_reset_to_another_time_needs_a_state_that_follows_the_drives() -> None:
    four_bar = srm.load("four_bar")
    driven = replace(four_bar, drives=(srm.Drive(srm.ConstantSpeed(6.0), "crank"),))
    start = srm.assemble(driven, driven.q0)
    driven = driven.with_state(start.q, start.v)
    run = srm.simulate(driven, 0.7, rtol=1e-10)
    simulator = srm.Simulator(driven, rtol=1e-10)

    with pytest.raises(srm.InputError, match="violates the drives: row crank"):
        simulator.reset(t=1e-3)
    simulator.reset(*run(0.4), t=0.4)

    np.testing.assert_allclose(simulator.step(0.3)[0], run.q[-1], rtol=0.0, atol=1e-9)


def test_joints_of_many_degrees_are_stepped() -> None:
    ring = floating_ring()
    simulator = srm.Simulator(ring, rtol=1e-9)
    for _ in range(10):
        simulator.step(0.1)
    after = srm.simulate(ring, simulator.t, rtol=1e-11)
    assert np.abs(pin.difference(ring.model, simulator.q, after.q[-1])).max() < 1e-7
    assert np.abs(simulator.v - after.v[-1]).max() < 1e-7


@on_both
@pytest.mark.parametrize("dt", [0.1, 0.07])
def test_drives_have_their_knots_between_steps_and_on_them(backend: str, dt: float) -> None:
    """The crank follows a table with kinks in its acceleration."""
    free = srm.load("slider_crank")
    start = float(free.q0[0])
    law = srm.Table([0.0, 0.3, 0.5, 2.0], [0.0, 0.2, 0.5, 1.5])
    drive = srm.Drive(law, joint="crank")
    rest = srm.Mechanism(free.model, free.loops, drives=(drive,), q0=free.q0)
    state = srm.assemble(rest)
    mechanism = rest.with_state(state.q, state.v)
    simulator = srm.Simulator(mechanism, backend=backend, tableau="dopr54", rtol=1e-9)
    run = srm.simulate(mechanism, 1.0, backend=backend, tableau="dopr54", rtol=1e-9)
    for _ in range(round(0.98 / dt)):
        q, v = simulator.step(dt)
        exact = run(simulator.t)
        assert np.abs(q - exact[0]).max() < 1e-8
        assert np.abs(v - exact[1]).max() < 1e-7
    assert simulator.stats.rejected <= 3
    assert abs(q[0] - start) > 0.5


@needs_kernel
@pytest.mark.skipif(not ON_LINUX, reason="reads /proc/self/status")
def test_memory_does_not_grow(slider_crank: srm.Mechanism) -> None:
    simulator = srm.Simulator(slider_crank, tableau="erk4", step=1e-3, backend="kernel")

    def run(steps: int) -> None:
        for k in range(steps):
            simulator.step(1e-3, [0.1 * (k % 3), 0.0])

    run(2_000)
    assert growth(lambda: run(10_000)) < 1.0  # MB; records of 10 000 steps would take 5
