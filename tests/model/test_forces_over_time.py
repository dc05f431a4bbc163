"""Forces that depend on time or on limits: laws, tables, springs at joint limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import srm_mbs as srm
from srm_mbs.dynamics.forces import ForceKinematics
from tests.model.test_drives import pendulum, written
from tests.support.backends import needs_kernel, on_both
from tests.support.bundled import finished
from tests.support.lockstep import compare
from tests.support.mechanisms import add_link
from tests.support.snapshots import check_messages, refused

KNOTS = np.array([0.0, 0.2, 0.45, 0.7, 1.0, 1.3, 1.7, 2.0])


def bead(mass: float = 2.0) -> srm.Mechanism:
    """A mass on three sliders and a hinge, without gravity: link ``bead`` at the end."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    parent = 0
    for name, joint in zip("xyz", (pin.JointModelPX, pin.JointModelPY, pin.JointModelPZ)):
        parent = model.addJoint(parent, joint(), pin.SE3.Identity(), name)
    inertia = pin.Inertia(mass, np.zeros(3), 0.5 * np.eye(3))
    add_link(model, parent, pin.JointModelRZ(), "bead", inertia)
    return srm.Mechanism(model)


def sampled(seed: int) -> srm.Table:
    return srm.Table(KNOTS, np.random.default_rng(seed).normal(size=len(KNOTS)))


@on_both
def test_a_sine_torque_drives_a_pendulum_as_scipy_says(backend: str) -> None:
    law = srm.Sine(3.0, frequency_hz=0.8, phase=0.3, offset=0.5)
    mechanism = replace(pendulum(), forces=(srm.JointTorque("a", law=law),))
    solution = srm.simulate(mechanism, 3.0, rtol=1e-10, backend=backend)
    about = mechanism.model.inertias[1].inertia[2, 2] + 0.25

    def rate(t: float, x: np.ndarray) -> list[float]:
        torque = 0.5 + 3.0 * np.sin(2.0 * np.pi * 0.8 * t + 0.3)
        return [x[1], (torque - 9.81 * 0.5 * np.cos(x[0])) / about]

    exact = solve_ivp(rate, (0.0, 3.0), [0.4, 0.0], method="DOP853", rtol=1e-12, atol=1e-12)
    assert solution.q[-1, 0] == pytest.approx(exact.y[0, -1], abs=1e-8)
    assert solution.energy_balance.relative < 1e-9


@on_both
def test_a_wrench_from_tables_moves_a_mass_by_the_integrals_of_its_splines(backend: str) -> None:
    laws = tuple(sampled(seed) for seed in range(6))
    at = srm.Anchor("bead", xyz=(0.3, 0.0, 0.0))
    wrench = srm.Wrench(at, law=laws, name="thrust")
    solution = finished(
        replace(bead(), forces=(wrench,)), 2.0, rtol=1e-10, backend=backend, t_eval=KNOTS
    )
    for k in range(3):
        twice = CubicSpline(KNOTS, laws[k].values).antiderivative(2)
        once = CubicSpline(KNOTS, laws[k].values).antiderivative(1)
        np.testing.assert_allclose(solution.q[:, k], twice(KNOTS) / 2.0, atol=1e-9)
        np.testing.assert_allclose(solution.v[:, k], once(KNOTS) / 2.0, atol=1e-9)


def test_steps_end_on_the_knots_of_a_table_and_the_order_is_kept() -> None:
    mechanism = replace(pendulum(), forces=(srm.JointTorque("a", 2.0, law=sampled(3)),))
    assert mechanism.breakpoints(0.0, 2.0) == tuple(KNOTS[2:-2])
    assert set(KNOTS[2:-2]) <= set(srm.simulate(mechanism, 2.0).t)
    times = np.linspace(0.1, 2.0, 20)
    exact = srm.simulate(mechanism, 2.0, rtol=1e-12, atol=1e-12, max_step=0.02, t_eval=times)
    errors = []
    steps = np.array([0.02, 0.01, 0.005, 0.0025]) * 0.97  # no knot lies on all of these grids
    for h in steps:
        run = srm.simulate(mechanism, 2.0, method=srm.PSRM("erk4"), step=h, t_eval=times)
        errors.append(np.abs(run.q - exact.q).max())
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] > 3.8


@needs_kernel
def test_both_backends_make_the_same_steps_with_forces_over_time() -> None:
    at = srm.Anchor("bead", xyz=(0.3, 0.0, 0.0))
    forces = (
        srm.Wrench(at, law=tuple(sampled(k) for k in range(6)), frame="link", name="six"),
        srm.Wrench(at, (1.0, 2.0, 0.0), law=srm.Sine(2.0, omega=3.0), name="one"),
        srm.JointTorque("x", 2.0, law=srm.Polynomial([1.0, -2.0, 0.5])),
        srm.LimitSpring("y", 50.0, 2.0, lower=-0.05, upper=0.05),
    )
    comparison = compare(replace(bead(), forces=forces), 1.5, rtol=1e-8)
    assert comparison.decisions == []
    assert max(comparison.h, comparison.state) < 1e-12


AT_A = srm.Anchor("a")
REFUSED: dict[str, Callable[[], Any]] = {
    "a number as law": lambda: srm.JointTorque("a", law=3.0),  # type: ignore[arg-type]
    "three laws for one number": lambda: srm.JointTorque("a", law=(srm.Sine(1.0, omega=1.0),) * 3),
    "a law of a zero wrench": lambda: srm.Wrench(AT_A, law=srm.Sine(1.0, omega=1.0)),
    "no stiffness": lambda: srm.LimitSpring("a"),
    "no depth": lambda: srm.LimitSpring("a", 1.0, depth=0.0),
    "no limits": lambda: replace(pendulum(), forces=(srm.LimitSpring("a", 1.0),)),
    "limits of a continuous joint": lambda: replace(
        pendulum(pin.JointModelRUBZ()), forces=(srm.LimitSpring("a", 1.0, lower=0.0),)
    ),
    "a run longer than a table": lambda: srm.simulate(
        replace(pendulum(), forces=(srm.JointTorque("a", law=sampled(0), name="kick"),)), 2.5
    ),
    "a number as function": lambda: srm.UserForce(3.0),  # type: ignore[arg-type]
    "a function on the ground": lambda: replace(
        pendulum(), forces=(srm.UserForce(np.zeros, srm.Anchor("world")),)
    ),
}
TORQUE = 'type = "torque"\njoint = "crank"\n'
IN_FILES = {
    "no torque": TORQUE,
    "a column without table": f'{TORQUE}value = "x"',
    "law and table": f'{TORQUE}table = "x.csv"\nlaw = {{ type = "sine" }}',
    "no amplitude": f'{TORQUE}law = {{ type = "sine" }}',
    "no file": 'type = "wrench"\nat = { link = "rod" }\ntable = "none.csv"',
    "no stiffness": 'type = "limit_spring"\njoint = "crank"',
    "an unknown key of a law": f'{TORQUE}law = {{ type = "sine", x = 1 }}',
}


def test_malformed_forces_over_time_are_refused(tmp_path: Path) -> None:
    messages = {case: refused(call) for case, call in REFUSED.items()}
    for case, keys in IN_FILES.items():
        path = written(tmp_path, f"[[force]]\n{keys}\n")
        messages[f"in a file: {case}"] = refused(partial(srm.load, path), tmp_path)
    check_messages("forces_over_time", messages)


# Springs at joint limits


def falling(damping: float = 0.0, **limits: Any) -> srm.Mechanism:
    """A pendulum that falls on a stop 0.5 rad below the horizontal."""
    stop = srm.LimitSpring("a", 4000.0, damping, lower=-0.5, depth=0.02, **limits)
    return replace(pendulum(), forces=(stop,))


@on_both
def test_a_pendulum_bounces_on_its_limit_without_loss(backend: str) -> None:
    solution = finished(falling(), 4.0, rtol=1e-9, backend=backend)
    angle, rate = solution.joint("a")
    assert -0.6 < angle.min() < -0.5
    assert np.sum(np.diff(np.sign(rate)) > 0.0) >= 3  # it came back three times
    assert np.ptp(solution.energy) < 1e-6
    assert "limits" not in solution.message


def test_damping_takes_energy_from_the_bounces() -> None:
    solution = srm.simulate(falling(damping=20.0), 4.0, rtol=1e-9)
    assert solution.energy[-1] < solution.energy[0] - 1.0
    assert solution.energy_balance.relative < 1e-7


def test_the_force_of_a_limit_is_the_slope_of_its_energy_and_smooth() -> None:
    spring = srm.LimitSpring("a", 300.0, lower=-0.5, upper=0.7, depth=0.1)
    mechanism = replace(pendulum(), forces=(spring,))
    forces = ForceKinematics(mechanism.model, mechanism.forces)
    data, rest = mechanism.model.createData(), np.zeros(1)

    def torque(x: float) -> float:
        pin.computeJointJacobians(mechanism.model, data, np.array([x]))
        return float(forces.generalised(data, np.array([x]), rest, 0.0)[0])

    def energy(x: float) -> float:
        return forces.energy(data, np.array([x]))

    h = 1e-5
    for x in (-0.9, -0.6, -0.55, -0.51, -0.2, 0.5, 0.72, 0.78, 0.8, 0.95):
        slope = (energy(x + h) - energy(x - h)) / (2.0 * h)
        assert torque(x) == pytest.approx(-slope, abs=1e-6)
    assert torque(-0.2) == torque(0.7) == 0.0
    assert torque(0.95) == pytest.approx(-300.0 * 0.25)
    # F, F' and F'' vanish at the limit and are continuous where the contact is full.
    assert abs(torque(0.7 + 1e-3)) < 300.0 * 1e-3 * 10.0 * 1e-6 * 1.01
    for x in (0.8, -0.6):
        values = [torque(x + k * 1e-3) for k in (-2, -1, 0, 1, 2)]
        before, after = values[0] - 2 * values[1] + values[2], values[2] - 2 * values[3] + values[4]
        assert abs(before - after) < 2e-3


def test_limits_of_the_model_are_the_default() -> None:
    model = pendulum().model.copy()
    model.lowerPositionLimit[:] = -0.5
    model.upperPositionLimit[:] = 1.5
    spring = srm.LimitSpring("a", 10.0)
    assert spring.resolved(model) == (-0.5, 1.5, 0.01)
    model.upperPositionLimit[:] = -0.3
    assert spring.resolved(model) == pytest.approx((-0.5, -0.3, 0.002))
    assert srm.LimitSpring("a", 10.0, upper=1e40).resolved(model)[1] == np.inf


# Descriptions and saved runs


def test_a_description_has_forces_over_time(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 6)
    rows = np.column_stack([t, np.cos(t), t**2])
    np.savetxt(tmp_path / "load.csv", rows, delimiter=",", header="t,fx,mz", comments="")
    text = """
[[force]]
type = "torque"
joint = "crank"
torque = 2.0
law = { type = "sine", amplitude = 1.5, frequency_hz = 2.0 }
[[force]]
type = "torque"
joint = "rod"
table = "load.csv"
value = "fx"
[[force]]
type = "wrench"
at = { link = "rod" }
table = "load.csv"
[[force]]
type = "limit_spring"
joint = "crank"
stiffness = 100.0
lower = -1.0
"""
    mechanism = srm.load(written(tmp_path, text))
    sine, table, wrench, limit = mechanism.forces
    assert sine == srm.JointTorque("crank", 2.0, law=srm.Sine(1.5, frequency_hz=2.0))
    assert table == srm.JointTorque("rod", law=srm.Table(t, np.cos(t)))
    zero = srm.Polynomial([0.0])
    laws = (srm.Table(t, np.cos(t)), zero, zero, zero, zero, srm.Table(t, t**2))
    assert wrench == srm.Wrench(srm.Anchor("rod"), law=laws)
    assert limit == srm.LimitSpring("crank", 100.0, lower=-1.0)
    solution = srm.simulate(mechanism, 0.5)
    solution.save(tmp_path / "run.npz")
    (tmp_path / "load.csv").unlink()
    loaded = srm.load_solution(tmp_path / "run.npz")
    assert loaded.mechanism.forces == mechanism.forces
    np.testing.assert_array_equal(loaded.reactions["pin"], solution.reactions["pin"])


# Functions of the user


@on_both
def test_a_function_acts_as_the_element_that_it_copies(backend: str) -> None:
    mechanism = bead()
    at = srm.Anchor("bead", xyz=(0.3, 0.1, 0.0))
    law = srm.Sine(2.0, omega=3.0, phase=0.4)
    element = srm.Wrench(at, (1.0, 2.0, 0.0), (0.0, 0.0, 0.5), law=law)
    torque = srm.JointTorque("x", 0.7, law=law)

    def wrench(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return 2.0 * np.sin(3.0 * t + 0.4) * np.array([1.0, 2.0, 0.0, 0.0, 0.0, 0.5])

    def push(t: float, q: np.ndarray, v: np.ndarray) -> list[float]:
        return [1.4 * np.sin(3.0 * t + 0.4), 0.0, 0.0, 0.0]

    by_user = (srm.UserForce(wrench, at), srm.UserForce(push))
    assert [force.name for force in by_user] == ["user_wrench", "user_push"]
    a, b = (
        srm.simulate(replace(mechanism, forces=forces), 2.0, rtol=1e-9, backend=backend)
        for forces in ((element, torque), by_user)
    )
    assert b.settings.backend == backend
    np.testing.assert_allclose(a.q[-1], b.q[-1], atol=1e-12)
    assert b.energy_balance.relative < 1e-8
    assert set(b.energy_balance.works) == {"force user_wrench", "force user_push"}


@on_both
def test_a_function_acts_beside_controllers_held_or_not(backend: str) -> None:
    def brake(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return -0.3 * v

    def hold(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([2.0])

    mechanism = replace(pendulum(), forces=(srm.UserForce(brake),))
    damped = replace(
        pendulum(), forces=(srm.TorsionSpring("a", damping=0.3), srm.JointTorque("a", 2.0))
    )
    wanted = srm.simulate(damped, 1.0, rtol=1e-10).q[-1]
    for options in ({}, {"sample_time": 0.1}):
        run = srm.simulate(mechanism, 1.0, rtol=1e-10, controller=hold, backend=backend, **options)
        np.testing.assert_allclose(run.q[-1], wanted, atol=1e-8)


@on_both
def test_a_function_that_fails_ends_the_run_with_its_name(backend: str) -> None:
    def broken(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if t > 0.5:
            raise ValueError("no more")
        return np.zeros(1)

    def grown(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.zeros(3 if t > 0.5 else 1)

    for function, words in ((broken, "no more"), (grown, "must return 1")):
        mechanism = replace(pendulum(), forces=(srm.UserForce(function, name="mine"),))
        run = srm.simulate(mechanism, 1.0, backend=backend)
        assert not run.success
        assert "'mine'" in run.message
        assert words in run.message


def test_a_saved_run_says_that_its_function_is_missing(tmp_path: Path) -> None:
    mechanism = replace(
        srm.load("slider_crank_regular"),
        forces=(srm.UserForce(lambda t, q, v: np.array([np.sin(t), 0.0])),),
    )
    run = srm.simulate(mechanism, 0.5)
    assert np.isfinite(run.reactions["pin"]).all()
    run.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    with pytest.raises(srm.InputError, match="not saved"):
        loaded.reactions  # noqa: B018


def test_springs_at_all_limits_on_request(tmp_path: Path) -> None:
    urdf = """<robot name="arm"><link name="base"/><link name="arm"><inertial><mass value="2"/>
    <origin xyz="0.5 0 0"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>
    </inertial></link><joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="0.3" effort="0" velocity="0"/></joint></robot>"""
    (tmp_path / "arm.urdf").write_text(urdf)
    path = tmp_path / "arm.toml"
    path.write_text('format = 1\nurdf = "arm.urdf"\nlimits = "spring"\n')
    mechanism = srm.load(path)
    (spring,) = mechanism.forces
    assert isinstance(spring, srm.LimitSpring)
    rate = mechanism.structure.units.rate
    assert spring.stiffness == pytest.approx(0.6 * (100.0 * rate) ** 2)
    assert spring.damping == pytest.approx(0.2 * 0.6 * 100.0 * rate)
    assert any(f"hinge {spring.stiffness:.3g}" in note for note in mechanism.notes)
    solution = finished(mechanism, 4.0)
    angle, rate_ = solution.joint("hinge")
    assert 0.3 < angle.max() < 0.35  # it falls on the upper limit and comes to rest there
    assert abs(rate_[-1]) < 0.1
    assert "limits" not in solution.message
    path.write_text('format = 1\nurdf = "arm.urdf"\nlimits = "stop"\n')
    with pytest.raises(srm.InputError, match="limits"):
        srm.load(path)
