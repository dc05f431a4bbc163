"""Events, contacts and impacts: the kernel finds what the reference finds."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.contacts import ContactProbe
from srm_mbs.integration.events import EventFunction, EventWatch, MechanismFunction
from srm_mbs.integration.kernel.events import CompiledEventWatch, contact_probe
from srm_mbs.integration.kernel.system import Evaluator, make_kernel_system
from tests.support.backends import needs_kernel

pytestmark = needs_kernel


def dense(times: Any) -> Any:
    """States (k, 2) of a made-up motion."""
    times = np.asarray(times)
    return np.stack([np.sin(7.0 * times), 7.0 * np.cos(7.0 * times)], axis=1)


def events_of(**fields: Any) -> list[EventFunction]:
    """Events with zeros at steps' ends, close pairs and touching ones, in both directions."""
    functions = {
        "rate": lambda t, q, v: v[0],
        "time": lambda t, q, v: t - 0.5,
        "pair": lambda t, q, v: (t - 0.31) ** 2 - 1e-6,
        "touching": lambda t, q, v: (t - 0.7) ** 2,
        "integer": lambda t, q, v: 1 if q[0] > 0.2 else -1,
        "start": lambda t, q, v: q[0],
        "returning": lambda t, q, v: t * (t - 1e-4),
    }
    return [
        EventFunction(name, MechanismFunction(function, 1), 3.0, direction, **fields)
        for name, function in functions.items()
        for direction in (-1.0, 0.0, 1.0)
    ]


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"start_tolerance": 0.0, "floor": 1e-9},
        {"departs": True},
        {"rests": lambda t, state: 1e-3},
    ],
)
@pytest.mark.parametrize("acts", [False, True])
def test_the_kernel_finds_the_events_of_steps_as_the_reference_does(
    fields: dict[str, Any], acts: bool
) -> None:
    scheme, ends = srm.PSRM("dop853").scheme, np.linspace(0.0, 1.0, 5)
    events = events_of(acts=acts, **fields)
    by_kernel = SimpleNamespace(compiled=None, by_reference=dense)
    for chosen in ([event] for event in events) if acts else [events]:
        watches = (
            (EventWatch(scheme, chosen, 2), dense),
            (CompiledEventWatch(scheme, chosen, 1, 1), by_kernel),
        )
        stops = []
        for watch, states in watches:
            watch.begin(0.0, dense([0.0])[0])
            found = None
            for t, t_new in pairwise(ends):
                (end,) = dense([t_new])
                found = found or watch.after_step(t, t_new, end, states)
            stops.append(found and (found.time, found.message, found.state.tolist()))
        assert stops[0] == stops[1]
        (times, states), (same_times, same_states) = (watch.found() for watch, _ in watches)
        for rows, others in zip((*times, *states), (*same_times, *same_states)):
            assert rows.shape == others.shape
            assert rows.tolist() == others.tolist()


@pytest.mark.parametrize("name", ["pendulum_chain", "four_bar", "spatial_four_bar"])
def test_the_kernel_probes_contacts_as_the_reference_does(name: str) -> None:
    mechanism = srm.load(name)
    system = make_system(mechanism)
    evaluator = Evaluator(system, make_kernel_system(system))
    nq, units = mechanism.model.nq, mechanism.structure.units
    state = np.concatenate([mechanism.q0, mechanism.v0])
    start = mechanism.q0[0]
    seen: list[Any] = []

    def gap(t: float, q: Any, v: Any) -> float:
        seen.append(np.concatenate([[t], q, v]))
        return float(q[0] - start)

    event = EventFunction("gap", MechanismFunction(gap, nq), np.inf, -1.0)
    found = []
    for probe in (
        ContactProbe(system, units, 1.0, 0.3, state),
        contact_probe(evaluator, units, 1.0, 0.3, state),
    ):
        seen.clear()
        found.append((probe.contact(event, 1e-12, 0.0, 0.0), np.array(seen)))
    assert found[0][0] == found[1][0]
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-14, abs=1e-14)
