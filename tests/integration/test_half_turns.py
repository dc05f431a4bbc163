"""Bushings that turn by more than half a turn, where their moments jump, against references."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support.backends import on_both
from tests.support.convergence import fitted_order

AXIAL = 0.4
"""Moment of inertia about the axle, kg m^2."""
STIFFNESS = 2.5
"""Of the bushing about the axle, N m/rad."""
INERTIA = np.diag([0.3, 0.35, AXIAL])
STIFFNESSES = np.array([1.5, 3.0, STIFFNESS])
DAMPING = 0.05
T_END = 6.0


def wheel(joint: Any, v0: Any, stiffness: Any, damping: float = 0.0) -> srm.Mechanism:
    """A body on ``joint``, without gravity, that a bushing holds."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    index = model.addJoint(0, joint, pin.SE3.Identity(), "axle")
    model.appendBodyToJoint(index, pin.Inertia(1.0, np.zeros(3), INERTIA), pin.SE3.Identity())
    model.addBodyFrame("wheel", index, pin.SE3.Identity(), 0)
    rubber = srm.Bushing(
        srm.Anchor("wheel"),
        srm.Anchor("world"),
        (0.0, 0.0, 0.0, *stiffness),
        (0.0, 0.0, 0.0, damping, damping, damping),
        name="rubber",
    )
    return srm.Mechanism(model, forces=[rubber], v0=v0)


def spinning(t: np.ndarray, speed: float) -> np.ndarray:
    """Rate of the wheel on its axle: an oscillator from rest angle to half a turn, then from minus
    half a turn with the same rate, and so on."""
    w = np.sqrt(STIFFNESS / AXIAL)
    amplitude = speed / w
    passing = np.arcsin(np.pi / amplitude) / w
    since = (t + passing) % (2.0 * passing) - passing
    out: np.ndarray = speed * np.cos(w * since)
    return out


@on_both
@pytest.mark.parametrize(
    "joint", [pin.JointModelRZ(), pin.JointModelRUBZ(), pin.JointModelSpherical()]
)
def test_errors_fall_with_the_tolerance_where_a_bushing_turns_on(joint: Any, backend: str) -> None:
    speed = 1.05 * np.pi * np.sqrt(STIFFNESS / AXIAL)
    mechanism = wheel(joint, speed * np.eye(joint.nv)[-1], (0.0, 0.0, STIFFNESS))
    for rtol in (1e-3, 1e-6, 1e-9, 1e-12):
        run = srm.simulate(mechanism, T_END, rtol=rtol, backend=backend)
        assert run.success, run.message
        assert len(run.steps.breaks) == 6
        assert "half a turn" in run.message
        t = np.linspace(0.0, T_END, 201)
        error = np.abs(run(t)[1][:, -1] - spinning(t, speed)).max() / speed
        assert error < 20.0 * rtol + 1e-12
    assert np.ptp(run.energy) < 1e-11 * run.energy[0]


def tumbling(t_end: float, v0: np.ndarray) -> tuple[np.ndarray, int]:
    """Angular velocity (3,) at ``t_end`` in axes of the body by SciPy, and the number of jumps.

    Of a quaternion that follows the motion the angle is 2 atan2(|v|, w): half a turn is passed
    where w vanishes, and the opposite quaternion is that beyond.
    """

    def field(t: float, y: np.ndarray) -> np.ndarray:
        w, v, omega = y[0], y[1:4], y[4:]
        size = np.linalg.norm(v)
        angle = 2.0 * np.arctan2(size, w)
        turn = 2.0 * v if size < 1e-12 else angle * v / size
        X = pin.skew(turn)
        factor = 1.0 / 12.0
        if angle > 1e-2:
            factor = 1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle))
        else:
            factor += angle**2 / 720.0 + angle**4 / 30240.0
        L = np.eye(3) + 0.5 * X + factor * X @ X
        moment = -L.T @ (STIFFNESSES * turn + DAMPING * L @ omega)
        change = np.linalg.solve(INERTIA, moment - np.cross(omega, INERTIA @ omega))
        return np.concatenate([[-0.5 * v @ omega], 0.5 * (w * omega + np.cross(v, omega)), change])

    def half_turn(t: float, y: np.ndarray) -> float:
        return float(y[0])

    half_turn.terminal, half_turn.direction = True, -1.0  # type: ignore[attr-defined]
    t, y, jumps = 0.0, np.concatenate([[1.0, 0.0, 0.0, 0.0], v0]), 0
    while t < t_end:
        run = solve_ivp(field, (t, t_end), y, "DOP853", events=half_turn, rtol=3e-14, atol=1e-14)
        t, y = run.t[-1], run.y[:, -1]
        if run.status == 1:
            y[:4] *= -1.0 / np.linalg.norm(y[:4])
            jumps += 1
    return y[4:], jumps


@pytest.mark.stress
@on_both
def test_a_tumbling_body_agrees_with_scipy_beyond_half_turns(backend: str) -> None:
    v0 = np.array([1.0, -2.0, 11.0])
    expected, jumps = tumbling(T_END, v0)
    assert jumps > 3
    mechanism = wheel(pin.JointModelSpherical(), v0, STIFFNESSES, DAMPING)
    for rtol in (1e-6, 1e-9, 1e-12):
        run = srm.simulate(mechanism, T_END, rtol=rtol, backend=backend)
        assert run.success, run.message
        assert len(run.steps.breaks) == jumps
        # Next to rtol = 1e-12 the rounding of the times of the jumps errs by up to 5e-11.
        assert run.v[-1] == pytest.approx(expected, abs=rtol + 6e-11)


@on_both
def test_stages_on_a_half_turn_have_the_moments_of_their_side(backend: str) -> None:
    """The last stage of a step that ends there, which dense output reads, and the first one of the
    next step."""
    v0 = np.array([1.0, -2.0, 11.0])
    mechanism = wheel(pin.JointModelSpherical(), v0, STIFFNESSES, DAMPING)
    for rtol in np.logspace(-5.0, -9.0, 9):
        run = srm.simulate(mechanism, 0.5, rtol=float(rtol), backend=backend)
        (at,) = run.steps.breaks
        around = np.concatenate([np.linspace(*run.t[at + i : at + i + 2], 4)[1:] for i in (-1, 0)])
        for t, v in zip(around, run(around)[1]):
            assert v == pytest.approx(tumbling(t, v0)[0], abs=rtol + 1e-11)


@pytest.mark.stress
@on_both
def test_fixed_steps_keep_their_order_beyond_half_turns(backend: str) -> None:
    """The steps return to their grid."""
    speed = 1.05 * np.pi * np.sqrt(STIFFNESS / AXIAL)
    mechanism = wheel(pin.JointModelRZ(), [speed], (0.0, 0.0, STIFFNESS))
    steps, errors = [0.02, 0.014, 0.01, 0.007, 0.005], []
    for step in steps:
        run = srm.simulate(mechanism, T_END, tableau="erk4", step=step, backend=backend)
        assert run.success, run.message
        errors.append(abs(run.v[-1, 0] - spinning(run.t[-1:], speed)[0]))
    assert fitted_order(steps, errors) > 3.9


@on_both
def test_a_bushing_that_turns_back_below_half_a_turn_does_not_jump(backend: str) -> None:
    speed = 0.999 * np.pi * np.sqrt(STIFFNESS / AXIAL)
    mechanism = wheel(pin.JointModelRZ(), [speed], (0.0, 0.0, STIFFNESS))
    run = srm.simulate(mechanism, T_END, rtol=1e-9, backend=backend)
    assert not len(run.steps.breaks)
    assert "half a turn" not in run.message
    w = np.sqrt(STIFFNESS / AXIAL)
    assert run.v[:, 0] == pytest.approx(speed * np.cos(w * run.t), abs=1e-7)


@on_both
def test_a_simulator_passes_half_turns(backend: str) -> None:
    speed = 1.05 * np.pi * np.sqrt(STIFFNESS / AXIAL)
    mechanism = wheel(pin.JointModelRZ(), [speed], (0.0, 0.0, STIFFNESS))
    simulator = srm.Simulator(mechanism, rtol=1e-9, backend=backend)
    for _ in range(60):
        simulator.step(0.1)
    expected = spinning(np.array([simulator.t]), speed)[0]
    assert simulator.v[0] == pytest.approx(expected, abs=1e-7)
