"""Actuators: their forces, their checks, and what keeps them."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from tests.support.bundled import load
from tests.support.commands import run

DESCRIPTION = """format = 1
name = "swing"
[planar]
points = { O = [0, 0], A = [1, 0] }
bar = [{ name = "bar", points = ["O", "A"], mass = 1 }]
ground = ["O"]
[actuators.hip]
joint = "O"
type = "position"
kp = 40
damping_ratio = 0.5
gear = 2
force_range = [-3, 3]
[actuators.push]
joint = "O"
"""


def described(folder: Path, text: str = DESCRIPTION) -> Path:
    path = folder / "swing.toml"
    path.write_text(text)
    return path


def driven(**actuators: srm.Actuator) -> srm.Mechanism:
    """A four-bar with actuators."""
    return replace(load("four_bar"), actuators=actuators)


def tau(mechanism: srm.Mechanism, controls: Any, q: float = 0.3, v: float = -2.0) -> FloatArray:
    """The forces at a position and rate of the first joint."""
    state = np.zeros(mechanism.model.nq), np.zeros(mechanism.model.nv)
    state[0][0], state[1][0] = q, v
    return srm.actuator_controller(mechanism, controls)(0.5, *state)


@pytest.mark.parametrize(
    ("actuator", "control", "expected"),
    [
        (srm.Actuator("crank"), 1.5, 1.5),
        (srm.Actuator("crank", gear=-3.0, gain=2.0, bias=0.5), 1.5, -3.0 * 3.5),
        (srm.Actuator("crank", gear=2.0, control_range=(-1, 1)), 1.5, 2.0),
        (srm.Actuator("crank", gear=2.0, force_range=(-1, 0.25)), 1.5, 0.5),
        (srm.Actuator("crank", "position", kp=10.0, kv=0.5), 1.0, 10.0 * 0.7 + 0.5 * 2.0),
        (srm.Actuator("crank", "position", gear=2.0, kp=10.0), 1.0, 2.0 * 10.0 * (1.0 - 0.6)),
        (srm.Actuator("crank", "position", kp=10.0, reference=0.2), 1.0, 5.0),
        (srm.Actuator("crank", "position", kp=10.0, gain=0.0, force_range=(-1, 9)), 1.0, -1.0),
        (srm.Actuator("crank", "velocity", kv=4.0), 1.0, 12.0),
        (srm.Actuator("crank", "velocity", kv=4.0, gear=0.5), 1.0, 0.5 * 4.0 * 2.0),
    ],
)
def test_the_force_is_the_clipped_law_times_the_gear(
    actuator: srm.Actuator, control: float, expected: float
) -> None:
    found = tau(driven(a=actuator), {"a": control})
    np.testing.assert_allclose(found, [expected, 0.0, 0.0], rtol=1e-15)


def test_actuators_of_one_joint_add_and_those_without_control_have_zero() -> None:
    mechanism = driven(
        a=srm.Actuator("crank", "position", kp=10.0),
        b=srm.Actuator("crank", gear=2.0),
        c=srm.Actuator("rocker"),
    )
    np.testing.assert_allclose(tau(mechanism, {"b": 1.0, "c": 4.0}), [2.0 - 3.0, 0.0, 4.0])
    np.testing.assert_allclose(tau(mechanism, None), [-3.0, 0.0, 0.0])


def test_a_damping_ratio_is_that_of_the_inertia_at_zero() -> None:
    mechanism = driven(a=srm.Actuator("crank", "position", kp=9.0, gear=3.0, damping_ratio=0.7))
    model = mechanism.model
    inertia = pin.crba(model, model.createData(), pin.neutral(model))[0, 0]
    assert mechanism.actuators["a"].kv == pytest.approx(2.0 * 0.7 * np.sqrt(9.0 * inertia / 9.0))
    assert mechanism.actuators["a"].damping_ratio == 0.0
    assert replace(mechanism, name="again").actuators == mechanism.actuators


def test_controls_may_be_functions_of_time_or_of_the_state() -> None:
    mechanism = driven(a=srm.Actuator("crank"), b=srm.Actuator("rocker"))
    both = tau(mechanism, {"a": lambda t: 4.0 * t, "b": 3})
    np.testing.assert_array_equal(both, [2.0, 0.0, 3.0])
    state = tau(mechanism, lambda t, q, v: {"b": t * v[0] * q[0]})
    np.testing.assert_allclose(state, [0.0, 0.0, 0.5 * -2.0 * 0.3])


@pytest.mark.parametrize("backend", ["python", "kernel"])
@pytest.mark.parametrize("sample_time", [None, 0.02])
def test_a_run_with_actuators_is_one_with_their_forces(
    backend: str, sample_time: float | None
) -> None:
    mechanism = driven(hip=srm.Actuator("crank", "position", kp=30.0, kv=3.0, gear=0.5))
    controller = srm.actuator_controller(mechanism, {"hip": lambda t: 0.2 * t})
    runs = [
        srm.simulate(
            mechanism, 0.5, controller=each, backend=backend, sample_time=sample_time, rtol=1e-9
        )
        for each in (
            controller,
            lambda t, q, v: {"crank": 0.5 * (30.0 * (0.2 * t - 0.5 * q[0]) - 1.5 * v[0])},
        )
    ]
    np.testing.assert_allclose(runs[0].q[-1], runs[1].q[-1], rtol=1e-9)
    free = srm.simulate(mechanism, 0.5)
    assert np.abs(runs[0].q[-1] - free.q[-1]).max() > 0.01


def test_a_simulator_takes_the_forces_of_actuators() -> None:
    mechanism = driven(hip=srm.Actuator("crank", gear=2.0))
    controller = srm.actuator_controller(mechanism, {"hip": 1.5})
    first, second = srm.Simulator(mechanism), srm.Simulator(mechanism)
    for _ in range(3):
        first.step(0.01, controller(first.t, first.q, first.v))
        second.step(0.01, [3.0, 0.0, 0.0])
    np.testing.assert_array_equal(first.q, second.q)


def test_a_controller_can_be_pickled() -> None:
    mechanism = driven(hip=srm.Actuator("crank", gear=2.0, force_range=(-1, 1)))
    controller = srm.actuator_controller(mechanism, {"hip": 0.25})
    again = pickle.loads(pickle.dumps(controller))
    np.testing.assert_array_equal(again(0.0, mechanism.q0, mechanism.v0), [0.5, 0.0, 0.0])


# --- what keeps them -----------------------------------------------------------------------------


def _saved(mechanism: srm.Mechanism, folder: Path) -> srm.Mechanism:
    srm.simulate(mechanism, 0.01).save(folder / "run.npz")
    return srm.load_solution(folder / "run.npz").mechanism


def _converted(mechanism: srm.Mechanism, folder: Path) -> srm.Mechanism:
    srm.convert(folder / "swing.toml", folder / "made.toml")
    return srm.load(folder / "made.toml")


@pytest.mark.parametrize(
    "through",
    [
        _saved,
        _converted,
        lambda mechanism, folder: mechanism.with_state([0.5], [1.0]),
        lambda mechanism, folder: pickle.loads(pickle.dumps(mechanism)),
    ],
    ids=["saved", "converted", "state", "pickled"],
)
def test_a_mechanism_keeps_its_actuators(
    through: Callable[[srm.Mechanism, Path], srm.Mechanism], tmp_path: Path
) -> None:
    mechanism = srm.load(described(tmp_path))
    assert list(mechanism.actuators) == ["hip", "push"]
    assert mechanism.actuators["hip"].force_range == (-3.0, 3.0)
    assert through(mechanism, tmp_path).actuators == mechanism.actuators


def test_a_description_replaces_an_actuator_of_its_file_by_name(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body name="arm"><joint name="j"/><geom size="0.1" pos="0.1 0 0"/>'
        '</body></worldbody><actuator><motor name="a" joint="j"/><motor name="b" joint="j"/>'
        "</actuator></mujoco>"
    )
    text = 'format = 1\nmjcf = "arm.xml"\n[actuators.b]\njoint = "j"\ngear = 7.0\n'
    mechanism = srm.load(described(tmp_path, text))
    assert mechanism.actuators == {"a": srm.Actuator("j"), "b": srm.Actuator("j", gear=7.0)}


def test_actuators_of_locked_joints_are_left_out_with_a_note(tmp_path: Path) -> None:
    text = DESCRIPTION.replace("A = [1, 0] }", "A = [1, 0], B = [2, 0] }").replace(
        "mass = 1 }]", 'mass = 1 }, { name = "end", points = ["A", "B"], mass = 1 }]'
    )
    text = text.replace('joint = "O"\ntype', 'joint = "A"\ntype').replace(
        "[planar]", 'lock = ["A"]\n[planar]'
    )
    mechanism = srm.load(described(tmp_path, text))
    assert list(mechanism.actuators) == ["push"]
    assert "actuators of joints that are locked are left out: 'hip'" in mechanism.notes


def test_the_command_line_lists_actuators_and_takes_controls(tmp_path: Path) -> None:
    path = described(tmp_path)
    shown = run("info", path)
    assert "actuator  type      joint  values" in shown
    assert "gear 2, kp 40, kv " in shown
    found = tmp_path / "run.npz"
    run("simulate", path, "--t-end", 0.2, "--control", "push=30", "--out", found)
    expected = srm.simulate(
        srm.load(path), 0.2, controller=srm.actuator_controller(srm.load(path), {"push": 30.0})
    )
    np.testing.assert_array_equal(srm.load_solution(found).q, expected.q)


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"type": "servo"}, "there is no type 'servo'"),
        ({"gear": 0.0}, "gear is zero"),
        ({"gear": np.nan}, "gear = nan is not a finite number"),
        ({"type": "position"}, "a position servo has no kp"),
        ({"type": "velocity", "kp": 1.0}, "a velocity servo has no kv"),
        ({"control_range": (1.0, -1.0)}, "two finite numbers that do not decrease"),
        ({"force_range": (1.0,)}, "two finite numbers that do not decrease"),
        ({"damping_ratio": 1.0}, "damping_ratio is not a positive number"),
        ({"type": "position", "kp": 1, "kv": 1, "damping_ratio": 1}, "without kv"),
        ({"type": "position", "kp": -1, "damping_ratio": 1}, "kp is negative"),
    ],
)
def test_a_wrong_actuator_is_refused(given: dict[str, Any], problem: str) -> None:
    with pytest.raises(srm.InputError) as caught:
        srm.Actuator("crank", **given)
    assert problem in str(caught.value)


@pytest.mark.parametrize(
    ("actuators", "problem"),
    [
        ({"a": srm.Actuator("wheel")}, "actuator 'a': there is no moving joint 'wheel'"),
        ({"a": 3}, "is not a name and an actuator"),
        ([srm.Actuator("crank")], "does not have a value for each name"),
        ({"": srm.Actuator("crank")}, "is not a name and an actuator"),
    ],
)
def test_a_mechanism_checks_its_actuators(actuators: Any, problem: str) -> None:
    with pytest.raises(srm.InputError) as caught:
        replace(load("four_bar"), actuators=actuators)
    assert problem in str(caught.value)


def test_a_position_servo_needs_an_angle_that_counts_turns() -> None:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRUBX(), pin.SE3.Identity(), "wheel")
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    srm.Mechanism(model, actuators={"a": srm.Actuator("wheel", "velocity", kv=1.0)})
    with pytest.raises(srm.InputError, match="does not count turns"):
        srm.Mechanism(model, actuators={"a": srm.Actuator("wheel", "position", kp=1.0)})


@pytest.mark.parametrize(
    ("controls", "problem"),
    [
        ({"hop": 1.0}, "there is no actuator 'hop'. Known: hip"),
        ({"hip": "x"}, "'x' is neither a finite number nor a function of t"),
        ({"hip": np.inf}, "is neither a finite number nor a function of t"),
        ([1.0], "does not have a value for each name"),
    ],
)
def test_wrong_controls_are_refused(controls: Any, problem: str) -> None:
    with pytest.raises(srm.InputError) as caught:
        srm.actuator_controller(driven(hip=srm.Actuator("crank")), controls)
    assert problem in str(caught.value)


def test_a_mechanism_without_actuators_has_no_controller() -> None:
    with pytest.raises(srm.InputError, match="'four_bar' has no actuators"):
        srm.actuator_controller(load("four_bar"), {})


@pytest.mark.parametrize(
    ("controls", "problem"),
    [
        ({"hip": lambda t: "x"}, "the control of the actuator 'hip' is 'x' at t = 0 s"),
        ({"hip": lambda t, q, v: 0.0}, "actuator 'hip', a function of t, raised TypeError("),
        (lambda t, q, v: 3.0, "the function of the controls returned 3.0 at t = 0 s"),
        (lambda t, q, v: {"hop": 1.0}, "names the actuator 'hop' at t = 0 s"),
        (lambda t, q, v: {"hip": None}, "the control of the actuator 'hip' is None"),
        (lambda t, q, v: 1 / 0, "the controller raised ZeroDivisionError"),
    ],
)
def test_a_function_that_returns_something_else_ends_the_run(controls: Any, problem: str) -> None:
    mechanism = driven(hip=srm.Actuator("crank"))
    controller = srm.actuator_controller(mechanism, controls)
    with pytest.raises(srm.SrmError) as caught:
        srm.simulate(mechanism, 0.1, controller=controller)
    assert problem in str(caught.value)
