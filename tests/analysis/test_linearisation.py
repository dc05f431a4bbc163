"""Linearisations on the closures, against solutions by hand and reduced models."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import fsolve

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rows import closure_errors
from tests.support.backends import on_both
from tests.support.bundled import load
from tests.support.mechanisms import along_x, rod
from tests.support.reduced import G, index_one, n_four_bar, regular_slider_crank, slider_crank

DERIVATIVE = ((1, 0.75), (2, -0.15), (3, 1.0 / 60.0))


def jacobian(field: Callable, x: np.ndarray, step: float = 2e-3) -> np.ndarray:
    """Of field(0, x), differences of order 6."""
    columns = [
        sum(
            w / step * (np.array(field(0.0, x + k * step * e)) - field(0.0, x - k * step * e))
            for k, w in DERIVATIVE
        )
        for e in np.eye(len(x))
    ]
    return np.array(columns).T


def chain(joints: list, **options) -> srm.Mechanism:
    model = pin.Model()
    parent = 0
    for i, joint in enumerate(joints):
        parent = model.addJoint(parent, joint, along_x(1.0 if i else 0.0), f"joint_{i}")
        model.appendBodyToJoint(parent, rod(), pin.SE3.Identity())
        model.addBodyFrame(f"link_{i}", parent, pin.SE3.Identity(), 0)
    return srm.Mechanism(model, **options)


def reduced_four_bar(mechanism: srm.Mechanism) -> Callable:
    """(crank, rate) -> (rate, acceleration): closed by fsolve, the dense index-1 equations."""
    equations = index_one(mechanism)
    rows = [0, 2]  # of its three, y is zero

    def closing(rest: np.ndarray, crank: float) -> np.ndarray:
        q = np.array([crank, *rest])[None]
        return closure_errors(mechanism.model, mechanism.loops, q, np.zeros((1, 3)))[0][0][rows]

    def field(t: float, y: np.ndarray) -> np.ndarray:
        rest = fsolve(closing, mechanism.q0[1:], (y[0],), xtol=1e-13)
        q = np.array([y[0], *rest])
        columns = [
            closure_errors(mechanism.model, mechanism.loops, q[None], e[None])[1][0][rows]
            for e in np.eye(3)
        ]
        v = np.array([1.0, *np.linalg.solve(np.array(columns[1:]).T, -columns[0])]) * y[1]
        return np.array([y[1], equations(0.0, np.concatenate([q, v]))[3]])

    return field


def test_a_hanging_rod_swings_with_the_root_of_g_over_its_reduced_length() -> None:
    found = srm.linearise(chain([pin.JointModelRY()], q0=[0.5 * np.pi]))
    np.testing.assert_allclose(
        found.eigenvalues, np.sqrt(1.5 * G) * np.array([1j, -1j]), atol=1e-11
    )
    assert found.coordinates == found.inputs == ("joint_0",)
    np.testing.assert_allclose(found.B, [[0.0], [3.0]], atol=1e-13)
    np.testing.assert_allclose(found.drift, 0.0, atol=1e-14)
    np.testing.assert_allclose(found.frequencies, np.sqrt(1.5 * G) / (2.0 * np.pi), rtol=1e-12)


def test_a_damped_spring_has_the_eigenvalues_of_its_equation() -> None:
    spring = srm.TorsionSpring("joint_0", 50.0, 4.0, 0.0)
    mechanism = chain([pin.JointModelPX()], forces=[spring])
    found = srm.linearise(mechanism)
    np.testing.assert_allclose(found.A, [[0.0, 1.0], [-50.0, -4.0]], atol=1e-10)
    np.testing.assert_allclose(found.damping_ratios, 2.0 / np.sqrt(50.0), rtol=1e-11)
    assert found.stable


def test_a_ball_joint_swings_in_two_directions_and_spins() -> None:
    q = [0.0, np.sin(np.pi / 4.0), 0.0, np.cos(np.pi / 4.0)]
    found = srm.linearise(chain([pin.JointModelSpherical()], q0=q))
    swing = np.sqrt(1.5 * G)
    assert found.coordinates == ("joint_0[0]", "joint_0[1]", "joint_0[2]")
    np.testing.assert_allclose(np.sort(np.abs(found.eigenvalues)), [0, 0] + 4 * [swing], atol=1e-6)
    np.testing.assert_allclose(found.eigenvalues.real, 0.0, atol=1e-6)


def test_a_spinning_top_has_the_derivatives_of_eulers_equations() -> None:
    """z' = w + z x w / 2 + ... (rotation vector, body rates), I w' = -w x I w about the pivot."""
    mechanism = chain([pin.JointModelSpherical()])
    mechanism.model.gravity.linear = np.zeros(3)
    w = np.array([0.7, -1.1, 2.3])
    found = srm.linearise(srm.Mechanism(mechanism.model), [0.0, 0.0, 0.0, 1.0], w)
    inertia = np.diag([0.24 / 12.0, 1.0 / 3.0, 1.0 / 3.0])
    turned = np.linalg.solve(inertia, pin.skew(inertia @ w) - pin.skew(w) @ inertia)
    exact = np.block([[-0.5 * pin.skew(w), np.eye(3)], [np.zeros((3, 3)), turned]])
    np.testing.assert_allclose(found.A, exact, atol=1e-9)
    np.testing.assert_allclose(found.drift[:3], w)


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("slider_crank_regular", lambda mechanism: regular_slider_crank()),
        ("four_bar", reduced_four_bar),
        ("n_four_bar_2", lambda mechanism: n_four_bar(2)),
    ],
)
def test_a_moving_loop_has_the_derivatives_of_its_reduced_model(name: str, field) -> None:
    mechanism = load(name)
    crank = mechanism.joint_names[0]
    found = srm.linearise(mechanism, coordinates=crank)
    state = np.array([mechanism.q0[0], mechanism.v0[0]])
    reduced = field(mechanism)
    np.testing.assert_allclose(found.A, jacobian(reduced, state), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.drift, reduced(0.0, state), rtol=1e-11, atol=1e-11)


def test_the_differences_have_order_six() -> None:
    mechanism = chain([pin.JointModelRY()], q0=[0.4])
    exact = -1.5 * G * np.sin(0.4)
    steps = np.array([0.4, 0.2, 0.1])
    errors = [abs(srm.linearise(mechanism, step=h).A[1, 0] - exact) for h in steps]
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 6.0, atol=0.3)
    np.testing.assert_allclose(np.log2(errors[1] / errors[2]), 6.0, atol=0.1)


def test_inputs_push_as_torques_of_a_controller_do() -> None:
    mechanism = load("five_bar")
    found = srm.linearise(mechanism, inputs=["crank_left", "crank_right"])
    for k, name in enumerate(found.inputs):
        torque = np.zeros(mechanism.model.nv)
        torque[mechanism.joint(name).idx_v] = 0.7
        pushed = srm.linearise(mechanism, controller=lambda t, q, v, torque=torque: torque)
        np.testing.assert_allclose(pushed.drift - found.drift, 0.7 * found.B[:, k], atol=1e-12)


def test_a_controller_closes_the_loop() -> None:
    mechanism = load("four_bar")
    still = srm.equilibrium(mechanism, search="nearest").q
    plant = srm.linearise(mechanism, still, inputs="crank", coordinates="crank")
    assert plant.eigenvalues.real.max() > 1.0
    K = np.array([[60.0, 8.0]])

    def law(t: float, q: np.ndarray, v: np.ndarray) -> list[float]:
        return [-K[0, 0] * (q[0] - still[0]) - K[0, 1] * v[0], 0.0, 0.0]

    closed = srm.linearise(mechanism, still, controller=law, coordinates="crank")
    np.testing.assert_allclose(closed.A, plant.A - plant.B @ K, atol=1e-8)
    assert closed.stable


def test_friction_damps_with_its_slope_at_rest() -> None:
    mechanism = chain([pin.JointModelRY()], q0=[0.5 * np.pi], friction_speed=1e-3)
    mechanism.model.friction = np.array([0.2])
    found = srm.linearise(srm.Mechanism(mechanism.model, q0=mechanism.q0, friction_speed=1e-3))
    np.testing.assert_allclose(found.A[1], [-1.5 * G, -3.0 * 0.2 / 1e-3], rtol=1e-9)


def test_mode_shapes_are_closed_motions_that_can_be_played(tmp_path: Path) -> None:
    mechanism = load("five_bar")
    found = srm.linearise(mechanism, srm.equilibrium(mechanism).q)
    motion = found.mode_shape(2, amplitude=0.4)
    g, _ = closure_errors(mechanism.model, mechanism.loops, motion.q, np.zeros((121, 4)))
    assert np.abs(g).max() < 1e-12
    np.testing.assert_allclose(motion.span[1], 1.0 / found.frequencies[2])
    away = motion.q - found.q
    assert 0.35 < np.abs(away).max() < 0.45
    np.testing.assert_allclose(away[0], away[-1], atol=1e-12)
    # small ones follow the eigenvector
    small = found.mode_shape(2, amplitude=1e-5)
    np.testing.assert_allclose(small.q[0] - found.q, 1e-5 * found.modes[:, 2].real, atol=1e-9)
    q, v = motion(0.5 * motion.t[3] + 0.5 * motion.t[4])
    np.testing.assert_allclose(q, 0.5 * (motion.q[3] + motion.q[4]), atol=1e-14)
    np.testing.assert_allclose(v * (motion.t[4] - motion.t[3]), motion.q[4] - motion.q[3])
    motion.export_html(tmp_path / "mode.html", fps=20)
    assert (tmp_path / "mode.html").stat().st_size > 100_000


def test_inconsistent_rates_are_refused() -> None:
    mechanism = load("four_bar")
    with pytest.raises(
        srm.InputError, match=r"^v: the state violates the closures: row pin\.[xz] by"
    ):
        srm.linearise(mechanism, mechanism.q0, [1.0, 0.0, 0.0])


def test_a_linearisation_is_one_line_and_its_matrices_are_printed() -> None:
    found = srm.linearise(load("stewart_platform"))
    assert repr(found) == (
        f"Linearisation('stewart_platform', {len(found.coordinates)} coordinates, "
        f"{len(found.inputs)} inputs, not stable)"
    )
    printed = str(found)
    for matrix in (found.A, found.B, found.drift, found.eigenvalues):
        assert str(matrix) in printed
    assert "object at" not in printed


@on_both
def test_states_of_a_loose_run_are_linearised_on_the_closures(backend: str) -> None:
    """They are moved as the start of a run is; the derivatives are those of the reduced model at
    the state that the result names."""
    mechanism = load("four_bar")
    run = srm.simulate(mechanism, 2.0, rtol=1e-3, backend=backend)
    t = np.array([0.65, 1.05, 1.1, 1.75, 1.85])
    assert run.at(t).drift.max(axis=1).min() > 1e-4
    for time in t:
        q, v = run(time)
        found = srm.linearise(mechanism, q, v, coordinates="crank", rtol=1e-3)
        assert 0.0 < found.moved < 10.0
        assert f"{found.moved:.2g}" in str(found)
        start = srm.simulate(mechanism, 1e-3, q0=q, v0=v, rtol=1e-3, backend=backend)
        np.testing.assert_allclose(found.q, start.q[0], atol=1e-13)
        np.testing.assert_allclose(found.v, start.v[0], atol=1e-12)
        exact = jacobian(reduced_four_bar(found.mechanism), np.array([found.q[0], found.v[0]]))
        np.testing.assert_allclose(found.A, exact, rtol=1e-7, atol=1e-7)


def test_states_farther_from_the_closures_than_their_run_allows_are_refused() -> None:
    mechanism = load("four_bar")
    q, v = srm.simulate(mechanism, 2.0, rtol=1e-3)(1.85)
    with pytest.raises(
        srm.InputError, match=r"row pin.*or give the rtol of the run that the state"
    ):
        srm.linearise(mechanism, q, v)
    with pytest.raises(srm.InputError, match=r"the state violates the closures: row pin"):
        srm.linearise(mechanism, q + 0.05, v, rtol=1e-3)


def test_states_on_the_closures_stay_as_they_are() -> None:
    mechanism = load("four_bar")
    found = srm.linearise(mechanism)
    assert found.moved == 0.0
    assert "moved" not in str(found)
    np.testing.assert_array_equal(found.q, mechanism.q0)


@pytest.mark.parametrize("distance", [1e-2, 1e-3, 1e-4, 1e-5])
def test_beside_a_singular_configuration_the_state_is_not_moved_by_rounding(
    distance: float,
) -> None:
    """A Newton step on closures that are open by rounding moves the state by that over sigma."""
    mechanism, reduced = load("slider_crank"), slider_crank()
    state = np.array([0.5 * np.pi - distance, 1.3])
    found = srm.linearise(
        mechanism, state[0] * np.array([1, -2]), state[1] * np.array([1, -2]), coordinates="crank"
    )
    np.testing.assert_allclose(found.drift, reduced(0.0, state), rtol=1e-6)
    np.testing.assert_allclose(found.A, jacobian(reduced, state), atol=1e-8)
