"""What energy a run gained is the work of everything that acted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.simulation import energy_balance
from tests.support.bundled import load
from tests.support.mechanisms import DISTINCT_MODELS, rod
from tests.support.reduced import G


def changed(name: str, damping=None, friction=None, forces=()) -> srm.Mechanism:
    """A bundled mechanism with joint damping, joint friction or force elements."""
    bundled = load(name)
    model = bundled.model.copy()
    if damping is not None:
        model.damping = np.array(damping)
    if friction is not None:
        model.friction = np.array(friction)
    return srm.Mechanism(
        model,
        bundled.loops,
        q0=bundled.q0,
        v0=bundled.v0,
        forces=forces or bundled.forces,
        friction_speed=0.05,
    )


def push(t: float, q: np.ndarray, v: np.ndarray) -> list[float]:
    return [5.0 * np.sin(3.0 * t) - 0.2 * v[0], 0.3, *np.zeros(len(v) - 2)]


COUPLER = srm.Anchor("coupler", xyz=(0.7, 0.1, 0.2))
GROUND = srm.Anchor("world", xyz=(0.4, -1.0, 0.8))
ELEMENTS: dict[str, srm.ForceElement] = {
    "spring_damper": srm.SpringDamper(
        COUPLER, GROUND, stiffness=20.0, damping=1.5, rest_length=0.5, name="it"
    ),
    "torsion_spring": srm.TorsionSpring("crank", 3.0, 0.2, 0.4, name="it"),
    "coupling_spring": srm.CouplingSpring(
        ("crank", "coupler"), (0.6, -1.5), 4.0, 0.3, 0.2, name="it"
    ),
    "torque": srm.JointTorque("crank", 0.7, name="it", law=srm.Sine(1.0, omega=5.0, offset=1.0)),
    "limit_spring": srm.LimitSpring("crank", 30.0, 5.0, upper=1.2, depth=0.1, name="it"),
    "wrench": srm.Wrench(COUPLER, (0.3, 0.0, 1.0), (0.1, 0.4, 0.2), "link", name="it"),
    "bushing": srm.Bushing(
        COUPLER, GROUND, (5.0, 6.0, 7.0, 0.1, 0.2, 0.3), (0.3, 0.2, 0.1, 0.02, 0.03, 0.04), "it"
    ),
}


def closing(name: str, longest: float) -> float:
    mechanism = load(name)
    t_end = min(mechanism.defaults.t_end or 1.0, longest)
    balance = srm.simulate(mechanism, t_end, rtol=1e-10).energy_balance
    assert balance.scale > 1e-3
    return balance.relative


@pytest.mark.parametrize("name", DISTINCT_MODELS)
def test_it_closes_on_the_bundled_mechanisms(name: str) -> None:
    assert closing(name, 0.05) < 1e-10


@pytest.mark.stress
@pytest.mark.parametrize("name", DISTINCT_MODELS)
def test_it_closes_on_the_bundled_mechanisms_over_ten_seconds(name: str) -> None:
    assert closing(name, 10.0) < 1e-8


def test_it_closes_with_rotors_on_the_joints() -> None:
    mechanism = changed("slider_crank_regular", damping=[0.1, 0.1])
    model = mechanism.model.copy()
    model.armature = np.array([0.5, 0.3])
    turning = srm.Mechanism(model, mechanism.loops, q0=mechanism.q0, v0=mechanism.v0)
    assert srm.simulate(turning, 1.0, rtol=1e-10).energy_balance.relative < 1e-10


def test_it_closes_with_a_sampled_controller_also_when_it_was_saved(tmp_path: Path) -> None:
    mechanism = changed("slider_crank_regular")
    run = srm.simulate(mechanism, 1.0, rtol=1e-10, controller=push, sample_time=0.03)
    assert np.abs(run.energy_balance.works["controller"]).max() > 0.1
    assert run.energy_balance.relative < 1e-10
    run.save(tmp_path / "run.npz")
    assert srm.load_solution(tmp_path / "run.npz").energy_balance.relative < 1e-10


@pytest.mark.parametrize("name", ["slider_crank_regular", "slider_crank"])
def test_it_closes_with_damping_friction_and_a_controller(name: str) -> None:
    mechanism = changed(name, damping=[0.3, 0.2], friction=[0.5, 0.1])
    balance = srm.simulate(mechanism, 2.0, rtol=1e-10, controller=push).energy_balance
    assert set(balance.works) == {"controller", "joint damping", "joint friction"}
    assert all(np.abs(work).max() > 0.05 for work in balance.works.values())
    assert balance.relative < 1e-10


@pytest.mark.parametrize("kind", [kind for kind in srm.FORCE_TYPES if kind != "limit_spring"])
def test_it_closes_with_every_smooth_force_element(kind: str) -> None:
    mechanism = changed("spatial_four_bar", forces=(ELEMENTS[kind],))
    balance = srm.simulate(mechanism, 1.5, rtol=1e-10).energy_balance
    assert np.abs(balance.works["force it"]).max() > 1e-3
    assert balance.relative < 1e-10


@pytest.mark.parametrize("rtol", [1e-6, 1e-8, 1e-10, 1e-11, 1e-12])
def test_a_limit_spring_opens_it_by_a_tolerance_at_each_end_of_its_rise_and_nowhere_else(
    rtol: float,
) -> None:
    """The force is not smooth where the spring sets in and where its rise ends, so that the error
    of a step across is the whole of what control allows; all other steps are of order 8."""
    mechanism = changed("spatial_four_bar", forces=(ELEMENTS["limit_spring"],))
    run = srm.simulate(mechanism, 1.5, rtol=rtol)
    balance = run.energy_balance
    assert np.abs(balance.works["force it"]).max() > 1e-3
    angle = run.joint("crank")[0]
    across = np.zeros(len(angle) - 1, dtype=bool)
    for place in (1.2, 1.3):
        across |= (angle[:-1] - place) * (angle[1:] - place) <= 0.0
    assert across.sum() == 4  # in and out again, once each
    opened = np.abs(np.diff(balance.residual)) / balance.scale
    assert opened[across].sum() < 4 * rtol
    assert opened[~across].sum() < 0.1 * rtol + 1e-12


@pytest.fixture(scope="module")
def everything() -> srm.Solution:
    """A run on which everything acts: controller, damping, friction, a spring, a drive."""
    spring = srm.SpringDamper(
        srm.Anchor("coupler_left"), GROUND, stiffness=3.0, damping=0.5, rest_length=0.2
    )
    start = changed("five_bar", 4 * [0.3], 4 * [0.5], (spring,))
    mechanism = replace(start, drives=(srm.Drive(srm.Sine(0.3, omega=3.0), "crank_left"),))
    state = srm.assemble(mechanism, mechanism.q0)
    mechanism = mechanism.with_state(state.q, state.v)
    return srm.simulate(mechanism, 0.5, rtol=1e-10, controller=push)


def test_it_closes_where_everything_acts(everything: srm.Solution) -> None:
    assert len(everything.energy_balance.works) == 5
    assert everything.energy_balance.relative < 1e-10


@pytest.mark.parametrize("left_out", energy_balance.TERMS, ids=lambda term: term.__name__)
def test_a_missing_term_opens_it(
    left_out, everything: srm.Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tuple(term for term in energy_balance.TERMS if term is not left_out)
    monkeypatch.setattr(energy_balance, "TERMS", kept)
    assert everything.at(everything.t).energy_balance.relative > 1e-3


def test_works_are_those_of_the_pendulum_equation() -> None:
    """theta'' I = -m g l/2 cos theta - d w - F tanh(w/v_s) + u(t), works as further states."""
    model = pin.Model()
    model.name = "pendulum"
    joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "hinge")
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    model.damping = np.array([0.1])
    model.friction = np.array([0.2])
    mechanism = srm.Mechanism(model, q0=[0.3], v0=[2.0], friction_speed=0.1)

    def torque(t: float) -> float:
        return float(np.sin(2.0 * t))

    def field(t: float, y: np.ndarray) -> list[float]:
        theta, w = y[:2]
        damping, friction = -0.1 * w, -0.2 * np.tanh(w / 0.1)
        # RY turns x towards -z
        pull = 0.5 * G * np.cos(theta)
        return [
            w,
            3.0 * (pull + damping + friction + torque(t)),
            damping * w,
            friction * w,
            torque(t) * w,
        ]

    times = np.linspace(0.3, 2.0, 7)
    exact = solve_ivp(
        field, (0.0, 2.0), [0.3, 2.0, 0, 0, 0], "DOP853", times, rtol=1e-12, atol=1e-13
    ).y
    solution = srm.simulate(
        mechanism, 2.0, rtol=1e-11, controller=lambda t, q, v: [torque(t)], t_eval=times
    )
    balance = solution.energy_balance
    for k, name in enumerate(("joint damping", "joint friction", "controller")):
        np.testing.assert_allclose(balance.works[name], exact[2 + k], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(balance.kinetic, exact[1] ** 2 / 6.0, rtol=1e-9)
    assert np.abs(balance.residual).max() < 1e-10


def test_it_can_be_read_at_any_times_and_ends_at_a_terminal_event() -> None:
    mechanism = changed("slider_crank_regular", damping=[0.3, 0.2])

    def slow(t: float, q: np.ndarray, v: np.ndarray) -> float:
        return float(v[0] - 3.9)

    slow.terminal = True
    solution = srm.simulate(mechanism, 5.0, rtol=1e-10, events=[slow])
    assert solution.status == "event"
    whole = solution.energy_balance
    assert whole.relative < 1e-10
    some = solution.at(solution.t[[2, 0, 1]]).energy_balance
    np.testing.assert_allclose(
        some.works["joint damping"], whole.works["joint damping"][[2, 0, 1]], rtol=1e-13
    )


def test_impacts_take_what_restitution_says() -> None:
    """A damped mass falls on a floor: at each impact 1 - e^2 of its kinetic energy is lost."""
    model = pin.Model()
    slide = model.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(slide, rod(2.0), pin.SE3.Identity())
    model.damping = np.array([0.5])
    mechanism = srm.Mechanism(model, q0=[1.0])
    floor = srm.Event(
        lambda t, q, v: float(q[0]), direction=-1, action=lambda t, q, v: (q, -0.8 * v)
    )
    solution = srm.simulate(mechanism, 2.0, events=floor, rtol=1e-10)
    assert solution.t_events is not None
    speeds = solution.v_events[0][:, 0]
    assert len(speeds) >= 3
    balance = solution.energy_balance
    assert balance.relative < 1e-10
    lost = -0.5 * 2.0 * (1.0 - 0.8**2) * speeds**2
    np.testing.assert_allclose(balance.works["events"][-1], lost.sum(), rtol=1e-10)
    times = np.array([1.9, 0.2, 0.7])
    some, again = solution.at(times).energy_balance, solution.at(np.sort(times)).energy_balance
    np.testing.assert_array_equal(some.t, times)
    for name in ("events", "joint damping"):
        np.testing.assert_allclose(some.works[name], again.works[name][[2, 0, 1]], rtol=1e-12)
    assert some.works["events"][1] == 0.0
    assert np.abs(some.residual).max() < 1e-9


def test_a_loaded_run_with_a_controller_says_why_it_has_none(tmp_path: Path) -> None:
    solution = srm.simulate(load("slider_crank_regular"), 0.1, controller=push)
    solution.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    with pytest.raises(srm.InputError, match="energy balance of a loaded run with a controller"):
        loaded.energy_balance  # noqa: B018


def test_a_balance_without_works_reads_no_dense_output(monkeypatch: pytest.MonkeyPatch) -> None:
    run = srm.simulate(load("n_four_bar_2"), 0.5)
    monkeypatch.setattr(type(run), "at", lambda *_: pytest.fail("dense output was read"))
    assert run.energy_balance.works == {}
    assert run.energy_balance.relative < 1e-5


def test_the_work_of_dampers_takes_the_stages_of_the_run_and_no_dense_output(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The reference is Gauss quadrature on the dense output, which output times inside each step
    cause."""
    run = srm.simulate(load("stewart_platform"), 0.5, rtol=1e-8)
    halves = 0.5 * (run.t[1:] + run.t[:-1])
    by_gauss = run.at(np.sort(np.concatenate([run.t, halves]))).energy_balance
    monkeypatch.setattr(type(run), "at", lambda *_: pytest.fail("dense output was read"))
    balance = run.energy_balance
    assert list(balance.works) == [f"force spring_{i}" for i in range(1, 7)]
    for name, work in balance.works.items():
        assert np.abs(work - by_gauss.works[name][::2]).max() < 1e-10 * balance.scale
    assert balance.relative < 1e-10


@pytest.mark.parametrize("name", ["stewart_platform", "delta_robot"])
def test_works_of_dampers_by_the_kernel_are_those_of_the_powers_at_the_stages(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = srm.simulate(load(name), 5.0)
    ends = run.t[::3]
    found = run.element_works(ends)
    assert (found is None) == (run.backend == "python")
    some = run.at(ends).energy_balance.works
    monkeypatch.setattr(type(run), "element_works", lambda run, t: None)
    for force, expected in run.energy_balance.works.items():
        rounding = 1e-14 * np.abs(expected).max()
        np.testing.assert_allclose(some[force], expected[::3], atol=rounding, rtol=1e-13)


def test_works_are_not_summed_over_stages_where_one_cannot_be_or_a_time_lies_within_a_step() -> (
    None
):
    run = srm.simulate(load("stewart_platform"), 1.0)
    assert run.element_works(0.5 * run.t[1:2]) is None
    stopped = srm.simulate(
        load("stewart_platform"), 1.0, events=srm.Event(lambda t, q, v: t - 0.51, terminal=True)
    )
    assert stopped.element_works(stopped.t) is None
    assert stopped.energy_balance.relative < 1e-6
