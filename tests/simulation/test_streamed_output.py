"""Runs with output times that do not keep their steps."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.integration.kernel import driver
from srm_mbs.simulation import streamed_output
from tests.support.backends import needs_kernel, on_both
from tests.support.bundled import load
from tests.support.mechanisms import floating_ring
from tests.support.memory import ON_LINUX

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs keep as few steps as they can."""
    monkeypatch.setattr(streamed_output, "KEPT_BYTES", 1.0)
    monkeypatch.setattr(streamed_output, "BLOCK_BYTES", 1.0)


def streamed(run: srm.Solution) -> bool:
    return run._run.steps is None


@on_both
@pytest.mark.usefixtures("few_steps")
@pytest.mark.parametrize(
    ("name", "t_end"), [("slider_crank", 40.0), ("four_bar", 8.0), ("parallelogram", 8.0)]
)
def test_outputs_without_steps_are_those_with_them_bit_by_bit(
    name: str, t_end: float, backend: str
) -> None:
    mechanism = load(name)
    t = np.linspace(0.1, t_end, 41)
    whole = srm.simulate(mechanism, t_end, backend=backend)
    run = srm.simulate(mechanism, t_end, t_eval=t, backend=backend)
    assert streamed(run)
    read = whole.at(t)
    assert np.array_equal(run.t, read.t)
    assert np.array_equal(run.q, read.q)
    assert np.array_equal(run.v, read.v)
    assert np.array_equal(run.drift, read.drift)
    assert np.array_equal(run.energy, read.energy)
    assert run.span == whole.span
    assert run.message == whole.message
    assert run.stats.steps == whole.stats.steps
    assert run.stats.evaluations == whole.stats.evaluations
    assert [str(place) for place in run.bifurcations] == [str(p) for p in whole.bifurcations]
    for joint in mechanism.joint_names:
        assert run.joint(joint)[0] == pytest.approx(read.joint(joint)[0], abs=1e-12)
    assert streamed(run)
    # The rest makes the run again.
    assert [c.time for c in run.crossings] == [c.time for c in whole.crossings]
    assert np.array_equal(run(0.77)[0], whole(0.77)[0])
    assert np.array_equal(run.steps.states, whole.steps.states)


@pytest.mark.usefixtures("few_steps")
def test_a_loop_of_free_bodies_with_breakpoints_and_samples_is_read_the_same() -> None:
    ring = floating_ring()
    t = np.linspace(0.0, 1.0, 17)

    def brake(t: float, q: Any, v: Any) -> Any:
        return -0.02 * v

    options: dict[str, Any] = {"controller": brake, "sample_time": 0.004, "breakpoints": [0.333]}
    whole = srm.simulate(ring, 1.0, **options)
    run = srm.simulate(ring, 1.0, t_eval=t, **options)
    assert streamed(run)
    assert np.array_equal(run.q, whole.at(t).q)
    assert np.array_equal(run.v, whole.at(t).v)


@pytest.mark.usefixtures("few_steps")
def test_what_needs_the_steps_of_a_controlled_run_says_what_to_do() -> None:
    def damper(t: float, q: Any, v: Any) -> list[float]:
        return [-0.01 * float(v[0]), 0.0]

    run = srm.simulate(load("slider_crank"), 40.0, t_eval=[1.0, 40.0], controller=damper)
    assert streamed(run)
    assert run.energy.shape == (2,)
    for read in (lambda: run(0.5), lambda: run.crossings, lambda: run.plot()):
        with pytest.raises(srm.InputError, match="Run it without t_eval"):
            read()


@pytest.mark.usefixtures("few_steps")
def test_such_a_run_is_saved_pickled_and_certified_as_any_other(tmp_path: Path) -> None:
    mechanism = load("slider_crank")
    run = srm.simulate(mechanism, 40.0, t_eval=[1.0, 40.0])
    assert streamed(run)
    again = pickle.loads(pickle.dumps(run))
    assert np.array_equal(again.q, run.q)
    run.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    assert np.array_equal(loaded.q, run.q)
    assert loaded.stats.steps == run.stats.steps
    certificate = srm.certify(run, again=False)
    assert certificate.energy is not None
    assert certificate.energy.relative < 1e-6


@pytest.mark.usefixtures("few_steps")
def test_a_run_that_fails_or_stops_keeps_the_outputs_before() -> None:
    mechanism = load("slider_crank")
    t = np.linspace(0.5, 60.0, 120)
    stop = srm.Event(lambda t, q, v: t - 33.3, terminal=True)
    run = srm.simulate(mechanism, 60.0, t_eval=t, events=stop)
    assert streamed(run)
    assert run.status == "event"
    assert run.span == (0.0, 33.3)
    assert np.array_equal(run.t, t[t <= 33.3])
    assert len(run.q) == len(run.t)


LONG_RUN = """
import sys
import numpy as np, srm_mbs as srm
from tests.support.memory import growth
mechanism = srm.load("slider_crank_whirl")
srm.simulate(mechanism, 1.0)
t_end = float(sys.argv[1]) * 2.0 * np.pi / abs(float(mechanism.v0[0]))
runs = []
used = growth(lambda: runs.append(srm.simulate(mechanism, t_end, t_eval=[0.5 * t_end, t_end])))
assert runs[0].success, runs[0].message
print(runs[0].stats.steps, used)
"""


@pytest.mark.skipif(not ON_LINUX, reason="reads /proc/self/status")
@pytest.mark.stress
def test_ten_thousand_turns_with_two_output_times_take_little_memory() -> None:
    command = [sys.executable, "-c", LONG_RUN, "10000"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    steps, megabytes = map(float, done.stdout.split())
    assert steps > 100_000
    # The steps alone would take 600 bytes each.
    assert megabytes < 100.0


@needs_kernel
def test_a_run_whose_steps_would_fill_the_memory_ends_and_says_to_give_output_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mechanism = load("squeezing_mechanism")  # whose motor has no limit: ever more steps a second
    whole = srm.simulate(mechanism, 1.0, backend="kernel")
    monkeypatch.setattr(driver, "NOTICEABLE_BYTES", 1e6)
    monkeypatch.setattr(driver, "free_memory", lambda: 5e6)
    with pytest.warns(srm.FailedRunWarning):
        ended = srm.simulate(mechanism, 1.0, backend="kernel")
    assert not ended.success
    assert "half of the memory that was left. Everything up to there is kept. Give t_eval" in (
        ended.message
    )
    count = len(ended.t)
    assert 1000 < count < len(whole.t)
    np.testing.assert_array_equal(ended.t, whole.t[:count])
    np.testing.assert_array_equal(ended.q, whole.q[:count])
    motor = srm.Drive(srm.ConstantSpeed(6.0), joint="crank")
    driven = replace(load("slider_crank_regular"), drives=(motor,))
    driven = driven.with_state(srm.assemble(driven).q, srm.assemble(driven).v)
    with pytest.warns(srm.FailedRunWarning):
        turning = srm.simulate(driven, 1e6, max_step=1e-3, backend="kernel")
    assert turning.message.endswith("the run then keeps no other state.")
    sampled = srm.simulate(mechanism, 1.0, t_eval=[0.5, 1.0], backend="kernel")
    assert sampled.success
    np.testing.assert_array_equal(sampled.q, whole([0.5, 1.0])[0])
