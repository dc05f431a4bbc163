"""A run may start where another one ended, whatever the tolerance of that one was."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.backends import on_both

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


@on_both
def test_a_start_off_the_closures_is_refused_at_a_loose_tolerance(backend: str) -> None:
    mechanism = srm.load("quick_return")
    with pytest.raises(srm.InputError, match="violates the closures"):
        srm.simulate(
            mechanism, 0.1, rtol=1e-2, q0=mechanism.q0 + 1e-4 * np.eye(1, len(mechanism.q0))[0],
            v0=mechanism.v0, backend=backend,
        )  # fmt: skip
