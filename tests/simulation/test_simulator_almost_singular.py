"""Mechanisms whose branches almost cross, stepped in samples.

The references have no closures: the energy integrals of the runs in one piece, and, under forces
that change from sample to sample, the equation of the angle that turns monotonically by SciPy.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.integration.test_almost_singular import OFFSETS, Reference, slider_crank
from tests.support.change_point import CHANGE_POINTS, AlmostChangePoint

T_END = 3.0
BACKENDS = ["kernel", pytest.param("python", marks=pytest.mark.stress)]
SAMPLES = [(1e-4, 0.05), (1e-6, 0.01), (1e-9, 0.002), (1e-12, 0.02)]
GRID = [
    (backend, d, rtol, dt)
    for rtol, dt in SAMPLES
    for backend, offsets in (
        ("kernel", OFFSETS),
        ("python", OFFSETS[:: 7 if dt > 0.005 else 14]),  # it takes seconds
    )
    for d in offsets
]


def case(name: str, d: float) -> tuple[srm.Mechanism, Any]:
    if name == "slider_crank":
        return slider_crank(d), Reference(d)
    four_bar = AlmostChangePoint(*CHANGE_POINTS[name], d)
    return four_bar.mechanism(), four_bar


def state_of(simulator: srm.Simulator) -> Any:
    """As the references take the end of a run."""
    return SimpleNamespace(q=simulator.q[None], v=simulator.v[None], t=np.array([simulator.t]))


def check(name: str, d: float, rtol: float, dt: float, backend: str) -> None:
    mechanism, reference = case(name, d)
    simulator = srm.Simulator(mechanism, rtol=rtol, backend=backend, singular_tolerance=0.0)
    while simulator.t < T_END:
        simulator.step(dt)
    assert reference.error(state_of(simulator)) < 1000.0 * rtol + 1e-9


@pytest.mark.parametrize("name", ["slider_crank", *CHANGE_POINTS])
@pytest.mark.parametrize(
    ("d", "rtol", "dt"), [(1e-2, 1e-9, 0.03), (-1e-6, 1e-6, 0.01), (1e-12, 1e-4, 0.07)]
)
def test_samples_turn_the_corner_as_runs_in_one_piece_do(
    name: str, d: float, rtol: float, dt: float
) -> None:
    check(name, d, rtol, dt, "kernel")


@pytest.mark.stress
@pytest.mark.parametrize("name", ["slider_crank", *CHANGE_POINTS])
@pytest.mark.parametrize(("backend", "d", "rtol", "dt"), GRID)
def test_samples_of_any_difference_turn_the_corner(
    name: str, d: float, rtol: float, dt: float, backend: str
) -> None:
    check(name, d, rtol, dt, backend)


def samples_within(d: float, backend: str, rtol: float) -> tuple[srm.Simulator, Any, list[float]]:
    """A simulator, the time of its first passage, and samples that are dense in its layer."""
    mechanism = slider_crank(d)
    first = srm.simulate(mechanism, 0.5, rtol=rtol, singular_tolerance=0.0).crossings[0].time
    simulator = srm.Simulator(mechanism, rtol=rtol, backend=backend, singular_tolerance=0.0)
    within = np.sqrt(abs(d)) / 8.0 * np.array([-4.0, -2.0, -1.0, -0.3, 0.0, 0.01, 0.5, 1.5, 3.0])
    return simulator, first, [*(first + within).tolist(), first + 0.1, 0.5]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("d", [1e-4, -1e-8, 1e-12])
def test_samples_in_the_layer_lie_on_the_curve(d: float, backend: str) -> None:
    simulator, _, times = samples_within(d, backend, 1e-9)
    reference = Reference(d)
    for t in times:
        simulator.step(t - simulator.t)
        # Rates in the layer turn with the rounding of the angles over its width.
        assert reference.error(state_of(simulator)) < 5e-7
    assert reference.error(state_of(simulator)) < 1e-9


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("d", [1e-3, -1e-6])
def test_forces_may_change_in_the_layer(d: float, backend: str) -> None:
    simulator, _, times = samples_within(d, backend, 1e-9)
    reference = Reference(d)

    def equation(t: float, y: Any, tau: Any) -> Any:
        """Angle, and kinetic energy, which needs no derivative of the inertia."""
        mass, _, (dtheta, dpsi) = reference.terms(y[0])
        theta, psi = angles(y[0])
        power = tau[0] * dtheta + tau[1] * (dpsi - dtheta)
        weight = 9.81 * (3.0 * np.cos(theta) * dtheta + np.cos(psi) * dpsi)
        rate = reference.sign * np.sqrt(2.0 * y[1] / mass)
        return [rate, (power - weight) * rate]

    def angles(x: float) -> tuple[float, float]:
        other = -np.arcsin(reference.short / reference.long * np.sin(x))
        return (x, other) if reference.by_crank else (other, x)

    y = np.array([reference.start, reference.energy - reference.terms(reference.start)[1]])
    for k, t in enumerate(times):
        tau = np.array([40.0 * (-1.0) ** k, 15.0 * np.cos(k)])
        moved = solve_ivp(
            equation, (simulator.t, t), y, "DOP853", args=(tau,), rtol=1e-12, atol=1e-13
        )
        simulator.step(t - simulator.t, tau)
        y = moved.y[:, -1]
        x = simulator.q[0] if reference.by_crank else simulator.q[0] + simulator.q[1]
        rate = simulator.v[0] if reference.by_crank else simulator.v[0] + simulator.v[1]
        assert x == pytest.approx(y[0], abs=2e-8)
        assert rate == pytest.approx(equation(t, y, tau)[0], abs=2e-7)


def test_samples_of_a_controller_end_within_a_passage_as_those_of_a_simulator() -> None:
    mechanism = slider_crank(1e-8)
    first = srm.simulate(mechanism, 0.5, singular_tolerance=0.0).crossings[0].time
    period = (first + 5e-6) / 20.0

    def force(t: float, q: Any, v: Any) -> Any:
        return np.array([30.0 * np.cos(9.0 * t), 0.0])

    options: dict[str, Any] = {"rtol": 1e-9, "singular_tolerance": 0.0}
    whole = srm.simulate(mechanism, 40.0 * period, controller=force, sample_time=period, **options)
    simulator = srm.Simulator(mechanism, **options)
    for k in range(40):
        simulator.step((k + 1) * period - simulator.t, force(k * period, None, None))
    assert [passage.kind for passage in whole.crossings] == ["avoided"]
    np.testing.assert_allclose(simulator.q, whole.q[-1], atol=1e-8)
    np.testing.assert_allclose(simulator.v, whole.v[-1], atol=1e-7)


@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_a_residual_below_the_tolerance_counts_as_zero_in_samples(backend: str) -> None:
    almost, equal = slider_crank(1e-10), slider_crank(0.0)
    first = srm.simulate(equal, 0.5, rtol=1e-9).crossings[0].time
    simulator = srm.Simulator(almost, rtol=1e-6, backend=backend)
    ideal = srm.simulate(equal, 0.5, rtol=1e-11)
    for t in (first - 0.01, first - 1e-5, first, first + 1e-6, first + 0.02, 0.5):
        q, v = simulator.step(t - simulator.t)
        q_ideal, v_ideal = ideal(t)
        np.testing.assert_allclose(q, q_ideal, atol=1e-6)
        np.testing.assert_allclose(v, v_ideal, atol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_clone_made_in_the_layer_continues_identically(backend: str) -> None:
    simulator, _, times = samples_within(-1e-8, backend, 1e-6)
    for t in times[:5]:
        simulator.step(t - simulator.t)
    clone = simulator.clone()
    for t in times[5:]:
        np.testing.assert_array_equal(clone.step(t - clone.t), simulator.step(t - simulator.t))


@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_a_motion_that_is_reversed_before_the_layer_goes_back(backend: str) -> None:
    simulator, first, _ = samples_within(1e-8, backend, 1e-9)
    simulator.step(first - 0.01)
    simulator.set_state(v=-simulator.v)
    simulator.step(first - 0.01)
    np.testing.assert_allclose(simulator.q, simulator.mechanism.q0, atol=1e-7)
    np.testing.assert_allclose(simulator.v, -simulator.mechanism.v0, atol=1e-6)


@pytest.mark.parametrize("value", [-1e-9, float("nan"), "tight"])
def test_a_simulator_refuses_a_tolerance_that_is_no_number(value: Any) -> None:
    with pytest.raises(srm.InputError, match="singular_tolerance"):
        srm.Simulator(slider_crank(0.0), singular_tolerance=value)
