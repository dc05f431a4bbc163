"""Starts, actions of events and turns in and beside the layers of mechanisms whose branches almost
cross.

The reference has no closures: the energy integral of test_almost_singular, which gives the state
anywhere in a layer, and the time there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import srm_mbs as srm
from tests.integration.test_almost_singular import OFFSETS, SPEED, START, Reference, slider_crank
from tests.support.backends import needs_kernel, on_both

T_END = 1.0
PLACES = [-3.0, -1.5, -0.7, -0.2, 0.01, 0.4, 1.0, 2.5]
"""Distances from the corner, over its width."""
EXACT = {"singular_tolerance": 0.0}


def angle_at(reference: Reference, d: float, place: float) -> float:
    """The monotone angle at a ``place`` beside its first corner."""
    return float(reference.sign * (0.5 * np.pi + place * np.sqrt(abs(d))))


def state_at(reference: Reference, angle: float) -> tuple[Any, Any]:
    """Exact q and v at the monotone ``angle``."""
    mass, potential, rates = reference.terms(np.array(angle))
    speed = reference.sign * np.sqrt(2.0 * (reference.energy - float(potential)) / float(mass))
    other = -np.arcsin(reference.short / reference.long * np.sin(angle))
    theta, psi = (angle, other) if reference.by_crank else (other, angle)
    dtheta, dpsi = (speed * float(rate) for rate in rates)
    return np.array([theta, psi - theta]), np.array([dtheta, dpsi - dtheta])


def check_start(d: float, rtol: float, place: float, backend: str) -> None:
    mechanism, reference = slider_crank(d), Reference(d)
    angle = angle_at(reference, d, place)
    q, v = state_at(reference, angle)
    options: dict[str, Any] = {"t0": reference.time(angle), "q0": q, "v0": v, **EXACT}
    solution = srm.simulate(mechanism, T_END, rtol=rtol, backend=backend, **options)
    assert solution.success, solution.message
    assert reference.error(solution) < 10.0 * rtol + 5e-10


@on_both
@pytest.mark.parametrize(
    ("d", "rtol", "place"),
    [(-1e-6, 1e-10, 0.4), (1e-8, 1e-9, 0.01), (1e-10, 1e-6, -0.2), (-1e-12, 1e-6, 1.0)],
)
def test_a_start_in_a_layer_follows_its_curve(
    d: float, rtol: float, place: float, backend: str
) -> None:
    check_start(d, rtol, place, backend)


@on_both
@pytest.mark.parametrize(
    ("d", "rtol", "before"),
    [
        (1e-8, 1e-3, 3.51e-2),
        (-1e-8, 1e-3, 3.51e-2),
        (1e-10, 1e-4, 2.65e-2),
        (-1e-10, 1e-4, 2.77e-2),
    ],
)
def test_a_first_step_across_the_middle_of_a_layer_sees_it(
    d: float, rtol: float, before: float, backend: str
) -> None:
    # sigma is the same at both ends of a step of twice the time ``before`` the corner (s).
    mechanism, reference = slider_crank(d), Reference(d)
    t = reference.time(angle_at(reference, d, 0.0)) - before
    angle = brentq(lambda a: reference.time(a) - t, 0.3 * reference.sign, 1.57 * reference.sign)
    q, v = state_at(reference, angle)
    solution = srm.simulate(mechanism, T_END, t0=t, q0=q, v0=v, rtol=rtol, backend=backend, **EXACT)
    assert solution.success, solution.message
    assert reference.error(solution) < 3.0 * rtol


@on_both
@pytest.mark.parametrize(
    ("d", "rtol", "turns", "before"),
    [(1e-10, 1e-2, 1, 5.6e-3), (1e-10, 1e-2, 9, 4.6e-3), (-1e-10, 1e-2, 5, 6.3e-3)],
)
def test_a_first_step_whose_stages_all_lie_beyond_a_layer_sees_it(
    d: float, rtol: float, turns: int, before: float, backend: str
) -> None:
    mechanism, reference = slider_crank(d), Reference(d)
    corner = (0.5 + turns) * np.pi
    t = reference.time(reference.sign * corner) - before
    ends = (reference.sign * (corner - x) for x in (1.0, 0.0))
    q, v = state_at(reference, brentq(lambda angle: reference.time(angle) - t, *ends))
    solution = srm.simulate(
        mechanism, t + 0.5, t0=t, q0=q, v0=v, rtol=rtol, backend=backend, **EXACT
    )
    assert solution.success, solution.message
    assert reference.error(solution) < 10.0 * rtol


@pytest.mark.stress
@needs_kernel
@pytest.mark.parametrize("d", OFFSETS)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
def test_starts_anywhere_in_layers_of_any_width_follow_their_curve(d: float, rtol: float) -> None:
    for place in PLACES:
        check_start(d, rtol, place, "kernel")


def at_time(when: float, action: Any = None, terminal: bool = False) -> srm.Event:
    return srm.Event(lambda t, q, v: t - when, direction=1, action=action, terminal=terminal)


def time_at(d: float, place: float) -> float:
    reference = Reference(d)
    return reference.time(angle_at(reference, d, place))


def check_action(d: float, rtol: float, place: float, backend: str) -> None:
    """An action that changes nothing changes nothing."""
    mechanism, reference = slider_crank(d), Reference(d)
    seen: list[Any] = []
    event = at_time(time_at(d, place), lambda t, q, v: seen.append((t, q, v)))
    solution = srm.simulate(mechanism, T_END, rtol=rtol, events=event, backend=backend, **EXACT)
    assert solution.success, solution.message
    assert len(seen) == 1
    # The place in a layer is known to rounding over its width.
    assert max(reference.errors(*seen[0])) < 100.0 * rtol + 5e-7
    assert reference.error(solution) < 10.0 * rtol + 5e-10


@on_both
@pytest.mark.parametrize(
    ("d", "rtol", "place"),
    [(-1e-2, 1e-6, 0.4), (-1e-6, 1e-8, 0.0), (1e-10, 1e-6, -0.7), (-1e-12, 1e-9, 2.5)],
)
def test_an_action_in_a_layer_finds_the_motion_on_its_curve(
    d: float, rtol: float, place: float, backend: str
) -> None:
    check_action(d, rtol, place, backend)


@pytest.mark.stress
@needs_kernel
@pytest.mark.parametrize("d", OFFSETS)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
def test_actions_anywhere_in_layers_of_any_width_change_nothing(d: float, rtol: float) -> None:
    for place in PLACES:
        check_action(d, rtol, place, "kernel")


@on_both
@pytest.mark.parametrize(("d", "place"), [(-1e-5, 0.1), (1e-9, -0.5), (-1e-11, 1.0)])
def test_an_action_that_reverses_the_motion_in_a_layer_leads_back(
    d: float, place: float, backend: str
) -> None:
    mechanism, when = slider_crank(d), time_at(d, place)
    event = at_time(when, lambda t, q, v: (q, -v))
    solution = srm.simulate(
        mechanism, 2.0 * when, rtol=1e-9, events=event, backend=backend, **EXACT
    )
    np.testing.assert_allclose(solution.q[-1], mechanism.q0, atol=1e-8)
    np.testing.assert_allclose(solution.v[-1], -mechanism.v0, atol=1e-7)


@on_both
def test_the_end_at_an_event_in_a_layer_is_one_state_everywhere(
    backend: str, tmp_path: Path
) -> None:
    mechanism, when = slider_crank(-1e-6), time_at(-1e-6, -0.2)
    options: dict[str, Any] = {"rtol": 1e-6, "backend": backend, **EXACT}
    event = at_time(when, terminal=True)
    solution = srm.simulate(mechanism, T_END, events=event, **options)
    assert solution.status == "event"
    end = np.concatenate([solution.q[-1], solution.v[-1]])
    saved = tmp_path / "run.npz"
    solution.save(saved)
    loaded = srm.load_solution(saved)
    for state in (
        np.concatenate(solution(solution.t[-1])),
        np.concatenate([solution.q_events[0][-1], solution.v_events[0][-1]]),
        np.concatenate([loaded.q[-1], loaded.v[-1]]),
    ):
        np.testing.assert_array_equal(state, end)
    went_on = srm.simulate(mechanism, T_END, t0=solution.t[-1], q0=end[:2], v0=end[2:], **options)
    assert Reference(-1e-6).error(went_on) < 1e-5


@on_both
def test_a_simulator_may_be_set_into_a_layer(backend: str) -> None:
    d, place = -1e-9, 0.3
    reference = Reference(d)
    angle = angle_at(reference, d, place)
    simulator = srm.Simulator(slider_crank(d), rtol=1e-8, backend=backend, **EXACT)
    simulator.reset(*state_at(reference, angle), t=reference.time(angle))
    for _ in range(20):
        simulator.step(1e-2)
    assert max(reference.errors(simulator.t, simulator.q, simulator.v)) < 1e-5


def time_of_return(d: float, spring: srm.TorsionSpring) -> float:
    """When the longer rod of a crank on a ``spring`` is back at its start, by SciPy on the angle of
    the crank."""
    reference = Reference(d)

    def rates(t: float, y: Any) -> list[float]:
        # Derivatives by complex steps.
        mass, potential, _ = reference.terms(np.array(y[0] + 1e-30j))
        force = -potential.imag / 1e-30 - spring.stiffness * (y[0] - spring.rest_angle)
        return [y[1], (force - 0.5 * mass.imag / 1e-30 * y[1] ** 2) / mass.real]

    def back(t: float, y: Any) -> float:
        return float(y[0] - START)

    back.direction, back.terminal = -1, True  # type: ignore[attr-defined]
    found = solve_ivp(
        rates, (0.0, 3.0), [START, SPEED], "DOP853", rtol=1e-12, atol=1e-13, events=back
    )
    return float(found.t[-1])


TURNS = [
    (1e-9, 110.0, 1e-9),
    (4e-11, 110.0, 1e-9),
    (4e-8, 114.0, 1e-9),
    (1e-6, 114.0, 1e-9),
    # Nodes on both sides of the layer are on two curves.
    (3.976577e-10, 115.061677, 3.122466e-8),
    (2.1117e-10, 115.0793, 3.0738e-5),
    # The longest step turns back and comes through the layer.
    (3.28e-10, 113.92, 2.1e-5),
]


@on_both
@pytest.mark.parametrize(("d", "stiffness", "rtol"), TURNS)
def test_a_motion_that_turns_back_soon_beyond_a_layer_returns_through_it(
    d: float, stiffness: float, rtol: float, backend: str
) -> None:
    """A spring turns it 0.01 to 0.04 rad beyond; it comes to its start with reversed rates."""
    ideal = slider_crank(d)
    spring = srm.TorsionSpring("crank", stiffness=stiffness, rest_angle=0.3)
    mechanism = replace(ideal, forces=(spring,))
    back = srm.Event(lambda t, q, v: q[0] - ideal.q0[0], direction=-1, terminal=True)
    solution = srm.simulate(mechanism, 3.0, rtol=rtol, events=back, backend=backend, **EXACT)
    assert solution.status == "event", solution.message
    assert "may not have resolved" not in solution.message
    assert [passage.kind for passage in solution.crossings] == ["avoided", "avoided"]
    np.testing.assert_allclose(solution.q[-1], mechanism.q0, atol=1e-9)
    np.testing.assert_allclose(solution.v[-1], -mechanism.v0, atol=rtol)
    assert solution.t[-1] == pytest.approx(time_of_return(d, spring), abs=0.1 * rtol)


def stored(springs: Any, q: Any) -> float:
    return float(sum(0.5 * s.stiffness * (a - s.rest_angle) ** 2 for s, a in zip(springs, q)))


@pytest.mark.stress
@needs_kernel
@pytest.mark.parametrize("seed", range(8))
def test_springs_and_layers_of_any_size_end_where_the_monotone_angle_does(seed: int) -> None:
    random = np.random.default_rng(seed)
    for _ in range(50):
        d = float(random.choice([-1.0, 1.0]) * 10.0 ** -random.uniform(2.5, 11.0))
        rtol = float(10.0 ** -random.uniform(3.0, 10.0))
        springs = tuple(
            srm.TorsionSpring(name, stiffness=k, rest_angle=random.uniform(-1.0, 1.0))
            for name, k in (
                ("crank", random.uniform(1.0, 150.0)),
                ("rod", random.uniform(0.1, 60.0)),
            )
        )
        mechanism, reference = replace(slider_crank(d), forces=springs), Reference(d)
        run = srm.simulate(mechanism, 2.0, rtol=rtol, **EXACT)
        assert run.success, run.message

        energy = reference.energy + stored(springs, mechanism.q0)
        for q, v in zip(run.q, run.v):
            angles, rates = np.cumsum(q), np.cumsum(v)
            own = 0 if reference.by_crank else 1
            other = -np.arcsin(reference.short / reference.long * np.sin(angles[own]))
            assert angles[1 - own] == pytest.approx(float(other), abs=1e-7)
            if abs(np.cos(angles[own])) > 300.0 * reference.width:
                mass, potential, _ = reference.terms(np.array(angles[own]))
                found = 0.5 * float(mass) * rates[own] ** 2 + float(potential) + stored(springs, q)
                assert found == pytest.approx(energy, rel=1000.0 * rtol + 1e-7)
