"""A run may start where another one ended, whatever the tolerance of that one was."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.backends import on_both, slowly_on_both

CASES = [
    ("quick_return", {"rtol": 1e-3, "tableau": "dopr54"}),
    ("bricard", {"rtol": 1e-3}),  # its unit, the scene diagonal, is another one at the end
    ("five_bar", {"rtol": 1e-4}),
    ("wiper", {"rtol": 1e-2, "t_eval": [0.2, 1.0]}),
    ("spatial_slider_crank", {"rtol": 1e-3, "step": 0.02}),
]


@on_both
@pytest.mark.parametrize(("name", "options"), CASES)
def test_a_run_starts_where_another_one_ended(
    name: str, options: dict[str, Any], backend: str
) -> None:
    mechanism = srm.load(name)
    first = srm.simulate(mechanism, 1.0, backend=backend, **options)
    assert first.success
    again = srm.simulate(mechanism, 0.05, q0=first.q[-1], v0=first.v[-1], backend=backend)
    assert again.success
    assert np.array_equal(again.q[0], first.q[-1])
    # The end is moved onto the closures by less than the tolerance of the run.
    q, v = first(1.0)
    rate = mechanism.structure.units.rate
    assert np.abs(first.q[-1] - q).max() < options["rtol"]
    assert np.abs(first.v[-1] - v).max() < options["rtol"] * (rate + np.abs(v).max())


@on_both
def test_a_run_starts_where_an_event_ended_another_one(backend: str) -> None:
    mechanism = srm.load("five_bar")
    event = srm.Event(lambda t, q, v: t - 0.4321, terminal=True)
    first = srm.simulate(mechanism, 1.0, rtol=1e-3, events=event, backend=backend)
    assert first.status == "event"
    assert srm.simulate(mechanism, 0.1, q0=first.q[-1], v0=first.v[-1], backend=backend).success


def _state(mechanism: srm.Mechanism, q: Any, v: Any) -> Any:
    """q and v in the units of the mechanism, for mechanisms without balls and free bodies."""
    unit = mechanism.structure.units.state
    return np.concatenate([q, v]) / unit


SAMPLES = [
    ("quick_return", 1e-2),
    ("five_bar", 1e-2),
    ("klann_walker", 1e-4),
    ("spatial_slider_crank", 1e-3),
    ("spatial_four_bar", 1e-5),
    ("wiper", 1e-3),  # driven
]


@slowly_on_both
@pytest.mark.parametrize(("name", "rtol"), SAMPLES)
def test_a_run_starts_in_any_state_of_another_one(name: str, rtol: float, backend: str) -> None:
    mechanism = srm.load(name)
    whole = srm.simulate(mechanism, 1.0, rtol=rtol, backend=backend)
    exact = srm.simulate(mechanism, 1.0, rtol=1e-10, backend=backend)
    moved = 0
    for t in np.linspace(0.13, 0.91, 8):
        q, v = whole(t)
        rest = srm.simulate(mechanism, 1.0, t0=t, q0=q, v0=v, rtol=rtol, backend=backend)
        assert rest.success
        if not np.array_equal(rest.q[0], q):
            moved += 1
            assert rest.drift[0].max() < 1e-11
        start = _state(mechanism, rest.q[0], rest.v[0])
        given = _state(mechanism, q, v)
        assert np.abs(start - given).max() < 10.0 * rtol * (1.0 + np.abs(given).max())
        end = _state(mechanism, exact.q[-1], exact.v[-1])
        error = np.abs(_state(mechanism, rest.q[-1], rest.v[-1]) - end).max()
        assert error < 3.0 * rtol * (1.0 + np.abs(end).max())
    assert moved


@on_both
def test_a_moved_start_is_that_of_a_run_from_there(backend: str) -> None:
    mechanism = srm.load("quick_return")
    q, v = srm.simulate(mechanism, 1.0, rtol=1e-3, backend=backend)(0.37)
    first = srm.simulate(mechanism, 0.2, q0=q, v0=v, rtol=1e-3, backend=backend)
    assert not np.array_equal(first.q[0], q)
    again = srm.simulate(mechanism, 0.2, q0=first.q[0], v0=first.v[0], rtol=1e-3, backend=backend)
    assert np.array_equal(again.q, first.q)
    assert np.array_equal(again.v, first.v)
    assert np.array_equal(first.mechanism.q0, first.q[0])  # from where it is made again
    own = srm.simulate(mechanism.with_state(q, v), 0.2, rtol=1e-3, backend=backend)
    assert np.array_equal(own.q, first.q)


@on_both
def test_a_consistent_start_stays_as_it_is(backend: str) -> None:
    mechanism = srm.load("quick_return")
    q = mechanism.q0 + 1e-9
    run = srm.simulate(mechanism, 0.1, q0=q, rtol=1e-2, backend=backend)
    assert np.array_equal(run.q[0], q)


@on_both
def test_contacts_at_the_start_begin_on_the_closures(backend: str) -> None:
    mechanism = srm.load("five_bar")
    q, v = srm.simulate(mechanism, 1.0, rtol=1e-2, backend=backend)(0.4)
    seen = []

    def stop(t: float, q: Any, v: Any) -> tuple[Any, Any]:
        seen.append((q, v))
        return q, -v

    sign = np.sign(v[0])
    event = srm.Event(lambda t, x, _: sign * (q[0] - x[0]), direction=-1.0, action=stop)
    run = srm.simulate(mechanism, 0.01, q0=q, v0=v, rtol=1e-2, events=event, backend=backend)
    assert run.success, run.message
    at, rate = seen[0]
    assert 0.0 < np.abs(at - q).max() < 1e-1
    assert np.abs(rate - v).max() < 0.1 * (1.0 + np.abs(v).max())
    assert run.drift[0].max() < 1e-11


@on_both
def test_a_simulator_goes_back_to_its_own_states(backend: str) -> None:
    mechanism = srm.load("five_bar")
    simulator = srm.Simulator(mechanism, rtol=1e-2, backend=backend)
    violated = 0
    for _ in range(12):
        q, v = simulator.step(0.1)
        t = simulator.t
        at, rate = simulator.reset(q, v, t)
        violated += not np.array_equal(rate, v)
        assert np.abs(at - q).max() < 1e-2
        assert np.abs(rate - v).max() < 1e-2 * (1.0 + np.abs(v).max())
        started = srm.Simulator(mechanism.with_state(q, v), rtol=1e-2, backend=backend)
        assert np.array_equal(started.q, at)
        assert np.array_equal(started.v, rate)
    assert violated


@on_both
def test_a_start_is_refused_beyond_the_tolerance(backend: str) -> None:
    mechanism = srm.load("quick_return")
    off = np.eye(1, len(mechanism.q0))[0]
    near, far = mechanism.q0 + 1e-4 * off, mechanism.q0 + 0.3 * off

    def start(q: Any, rtol: float, atol: Any = None) -> srm.Solution:
        options = {"rtol": rtol, "atol": atol, "backend": backend}
        return srm.simulate(mechanism, 0.1, q0=q, v0=mechanism.v0, **options)

    assert start(near, 1e-2).success
    assert start(near, 1e-9, 1e-3).success
    for q, rtol, why in (
        (near, 1e-6, "; the way onto them is .* times the tolerance of the run"),
        (far, 1e-2, "Use"),
    ):
        with pytest.raises(srm.InputError, match=why) as refused:
            start(q, rtol)
        assert "Use srm.assemble(mechanism, q=..., v=...)" in str(refused.value)
        closed = srm.assemble(mechanism, q=q, v=mechanism.v0)
        options = {"rtol": rtol, "backend": backend}
        assert srm.simulate(mechanism, 0.1, q0=closed.q, v0=closed.v, **options).success


@on_both
def test_the_remedy_of_a_driven_start_follows_the_drives(backend: str) -> None:
    mechanism = srm.load("wiper")
    q0, v0 = srm.simulate(mechanism, 1.0, rtol=1e-2, backend=backend)(0.3)
    options = {"t0": 0.3, "rtol": 1e-9, "backend": backend}
    with pytest.raises(srm.InputError, match="times the tolerance of the run") as refused:
        srm.simulate(mechanism, 0.4, q0=q0, v0=v0, **options)
    call = "srm.Simulator(mechanism).reset(q0, v0, 0.3, project=True)"
    assert f"Use {call}, which returns a consistent q and v" in str(refused.value)
    q, v = srm.Simulator(mechanism).reset(q0, v0, 0.3, project=True)
    assert srm.simulate(mechanism, 0.4, q0=q, v0=v, **options).success


@on_both
def test_a_start_whose_branch_is_open_is_refused(backend: str) -> None:
    # An equal-length slider-crank: both branches, rod = -2 crank and rod = const, meet at pi/2.
    mechanism = srm.load("slider_crank")
    angle = 0.5 * np.pi + 1e-4
    q0 = np.array([angle, -2.0 * angle + 1e-4])
    v0 = np.array([1.0, -2.0])
    with pytest.raises(srm.InputError, match="leaves its branch open next to") as refused:
        srm.simulate(mechanism, 0.1, q0=q0, v0=v0, rtol=1e-3, backend=backend)
    call = "srm.Simulator(mechanism).reset(q0, v0, project=True)"
    assert f"on the branch of v0: {call} returns it" in str(refused.value)
    q, v = srm.Simulator(mechanism).reset(q0, v0, project=True)
    run = srm.simulate(mechanism, 0.1, q0=q, v0=v, rtol=1e-3, backend=backend)
    assert np.abs(run.q[:, 1] + 2.0 * run.q[:, 0]).max() < 1e-9


@on_both
def test_a_state_is_projected_after_thousands_of_turns(backend: str) -> None:
    mechanism = srm.load("four_bar")
    simulator = srm.Simulator(mechanism, backend=backend)
    for turns in (3000, 4001, 20002, 50003):
        q = mechanism.q0 + np.array([2.0 * np.pi * turns, -2.0 * np.pi * turns, 1e-5])
        at, _ = simulator.reset(q, mechanism.v0, project=True)
        assert np.abs(at - q).max() < 1e-4
        assert np.abs(mechanism.with_state(at, mechanism.v0).initial_errors[0]).max() < 1e-10


def _circle() -> srm.SemiExplicitDAE:
    """A point on the unit circle with the angle t + (1 - cos 3t)/6."""

    def f(t: float, x: Any) -> Any:
        rate = 1.0 + 0.5 * np.sin(3.0 * t)
        return np.array([x[0] - rate * x[1], rate * x[0] + x[1]])

    return srm.SemiExplicitDAE(
        f=f, B=lambda t, x: x, g=lambda t, x: 0.5 * (x @ x - 1.0), G=lambda t, x: x
    )


@pytest.mark.parametrize("rtol", [1e-4, 1e-5])
def test_a_run_of_a_dae_starts_in_any_state_of_another_one(rtol: float) -> None:
    angle = 5.0 + (1.0 - np.cos(15.0)) / 6.0
    whole = srm.solve_dae(_circle(), (0.0, 5.0), [1.0, 0.0], rtol=rtol)
    moved = 0
    for t in np.linspace(0.1, 4.9, 7):
        x, _ = whole(t)
        rest = srm.solve_dae(_circle(), (t, 5.0), x, rtol=rtol)
        moved += not np.array_equal(rest.x[0], x)
        assert np.abs(rest.x[0] - x).max() < rtol
        assert np.abs(rest.x[-1] - [np.cos(angle), np.sin(angle)]).max() < 0.3 * rtol
    assert moved


def test_the_start_of_a_dae_is_refused_beyond_the_tolerance_with_one_that_fits() -> None:
    for off, t in ((1.02, 0.3), (1.2, 2.0)):
        with pytest.raises(srm.InputError, match="times the tolerance of the run") as refused:
            srm.solve_dae(_circle(), (t, t + 0.1), [0.0, off], rtol=1e-4)
        found = re.search(r"constraints: (\[.*\]) is on them", str(refused.value))
        assert found
        assert srm.solve_dae(_circle(), (t, t + 0.1), json.loads(found[1]), rtol=1e-4).success
