"""Samples of runs by the kernel, against the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.integration.dense_output import DenseOutput
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.run_samples import MAX_SAMPLED_ENDS, READ_AT, READ_STEPS, run_samples
from tests.support.bundled import load

pytestmark = pytest.mark.skipif(kernel.core is None, reason=f"no kernel: {kernel.missing}")


def later(t: float, q: Any, v: Any) -> float:
    return float(t - 1.2345)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("four_bar", {}),
        ("bricard", {"rtol": 1e-9}),
        ("stewart_platform", {}),
        ("klann_walker", {}),
        ("slider_crank", {"rtol": 1e-11}),
        ("pendulum_chain", {}),
        ("four_bar", {"max_step": 0.01}),
        ("four_bar", {"tableau": "dopr54"}),
        ("four_bar", {"tableau": "dopr54", "events": srm.Event(later, terminal=True)}),
        ("delta_robot", {"events": srm.Event(later, terminal=True)}),
    ],
)
def test_samples_of_the_kernel_are_those_of_the_reference(
    name: str, options: dict[str, Any]
) -> None:
    run = srm.simulate(load(name), 3.0, backend="kernel", **options)
    found = run.samples()
    unit = run.mechanism.structure.units.state
    dense = DenseOutput(run.system, run.scheme, run.steps)
    expected = run_samples(run.scheme, run.steps, dense, unit)
    np.testing.assert_array_equal(found.times, expected.times)
    assert found.ends == expected.ends
    assert found.whole == expected.whole == len(found.times) - ("events" in options)
    np.testing.assert_allclose(found.states, expected.states, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_a_long_run_is_sampled_at_its_start_its_end_and_where_closures_were_corrected_most(
    backend: Any,
) -> None:
    run = srm.simulate(load("four_bar"), 3.0, max_step=0.02, backend=backend)
    steps, samples = run.steps, run.samples()
    assert MAX_SAMPLED_ENDS < steps.count < 2 * MAX_SAMPLED_ENDS
    ends = samples.times[samples.ends]
    assert (ends[0], ends[-1]) == run.span
    sizes = np.abs(steps.corrections / run.mechanism.structure.units.state).max(axis=1)
    assert steps.times[1 + sizes.argmax()] in ends
    # Of two successive steps the end of one, and that of the run.
    assert (steps.count + 1) // 2 + 1 <= len(ends) <= (steps.count + 1) // 2 + 2
    between = np.setdiff1d(samples.times, ends)
    place = np.searchsorted(steps.times, between) - 1
    fractions = (between - steps.times[place]) / np.diff(steps.times)[place]
    np.testing.assert_allclose(fractions.reshape(-1, 3), np.tile(READ_AT, (len(between) // 3, 1)))
    assert int(steps.error_ratios.argmax()) in place


@pytest.mark.parametrize("backend", ["kernel", "python"])
def test_of_a_long_run_a_bounded_number_of_steps_is_read(backend: Any) -> None:
    run = srm.simulate(load("four_bar"), 3.0, max_step=0.0015, backend=backend)
    samples = run.samples()
    assert run.steps.count >= 2000
    between = np.setdiff1d(samples.times, run.steps.times)
    assert len(between) <= len(READ_AT) * sum(most for *_, most in READ_STEPS)
