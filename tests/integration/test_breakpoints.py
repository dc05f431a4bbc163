"""Forces that jump at known times, and controllers that are sampled: every order is kept."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.integration.breakpoints import smooth_intervals
from tests.support import reduced
from tests.support.backends import needs_kernel, on_both
from tests.support.convergence import fitted_order
from tests.support.lockstep import compare
from tests.support.slider_crank import START
from tests.support.snapshots import check_refusals

PERIOD = 0.37
JUMPS = tuple(k * PERIOD for k in range(1, 9))
T_END = 3.0


@pytest.fixture(scope="module")
def slider_crank() -> srm.Mechanism:
    return srm.load("slider_crank")


@pytest.fixture(scope="module")
def smooth(slider_crank: srm.Mechanism) -> srm.Solution:
    """Through one singular configuration, without breakpoints."""
    return srm.simulate(slider_crank, 2.0, rtol=1e-12)


def torque(t: float, q: Any, v: Any) -> np.ndarray:
    """A smooth torque on the crank that changes its sign at every jump."""
    return np.array([(2.0 + np.sin(3.0 * t)) * (1.0 if int(t / PERIOD) % 2 else -1.0), 0.0])


def pushed(torque: Callable[[float], float], begin: float, end: float, y: Any) -> np.ndarray:
    """Angle and rate of the crank at ``end``, by SciPy from ``y`` at ``begin`` under a torque of
    time."""
    free = reduced.slider_crank()

    def field(t: float, y: Any) -> Any:
        rate, acceleration = free(t, y)
        return [rate, acceleration + torque(t) / (8.0 / 3.0 + 8.0 * np.sin(y[0]) ** 2)]

    run = solve_ivp(field, (begin, end), y, "DOP853", rtol=1e-13, atol=1e-13)
    return np.array(run.y[:, -1])


@pytest.fixture(scope="module")
def exact() -> np.ndarray:
    """State (2,) of the crank at T_END under the torque, from jump to jump."""
    y: Any = START
    for k, (begin, end) in enumerate(pairwise((0.0, *JUMPS, T_END))):
        sign = 1.0 if k % 2 else -1.0
        y = pushed(lambda t, sign=sign: sign * (2.0 + np.sin(3.0 * t)), begin, end, y)
    return np.array(y)


def errors(run: Callable[[float], srm.Solution], steps: list[int], exact: np.ndarray) -> np.ndarray:
    ends = [run(T_END / n) for n in steps]
    return np.array([abs(e.q[-1, 0] - exact[0]) + abs(e.v[-1, 0] - exact[1]) for e in ends])


@on_both
@pytest.mark.parametrize(
    ("tableau", "steps", "order"), [("erk4", [100, 200, 400], 4.0), ("dop853", [24, 36, 48], 8.0)]
)
def test_with_breakpoints_a_scheme_keeps_its_order(
    slider_crank: srm.Mechanism,
    exact: np.ndarray,
    backend: str,
    tableau: str,
    steps: list[int],
    order: float,
) -> None:
    def run(h: float, breakpoints: Any = JUMPS) -> srm.Solution:
        return srm.simulate(
            slider_crank,
            T_END,
            controller=torque,
            breakpoints=breakpoints,
            step=h,
            tableau=tableau,
            backend=backend,
        )

    found = errors(run, steps, exact)
    assert -fitted_order(steps, found) > order - 0.4
    without = errors(lambda h: run(h, ()), steps, exact)
    assert np.all(without > 1e3 * found)


@on_both
def test_step_size_control_meets_jumps_without_rejecting(
    slider_crank: srm.Mechanism, exact: np.ndarray, backend: str
) -> None:
    options: dict[str, Any] = {"controller": torque, "rtol": 1e-9, "backend": backend}
    solution = srm.simulate(slider_crank, T_END, breakpoints=JUMPS, **options)
    assert abs(solution.q[-1, 0] - exact[0]) < 1e-10
    assert set(JUMPS) <= set(solution.t.tolist())
    assert solution.stats.rejected <= 2
    blind = srm.simulate(slider_crank, T_END, **options)
    assert solution.stats.evaluations < 0.3 * blind.stats.evaluations


@pytest.mark.parametrize("method", [srm.SRM("erk4"), srm.SRM("erk4", restart=True, carry=True)])
def test_sweeps_meet_jumps_too(
    slider_crank: srm.Mechanism, exact: np.ndarray, method: srm.SRM
) -> None:
    """What a jump inside a step does is far above the errors of the sweeps."""

    def run(step: float, breakpoints: Any) -> float:
        end = srm.simulate(
            slider_crank,
            T_END,
            controller=torque,
            breakpoints=breakpoints,
            step=step,
            method=method,
        )
        return float(abs(end.q[-1, 0] - exact[0]))

    assert run(T_END / 250, JUMPS) < 0.02 * run(T_END / 250, ())


def test_a_side_of_a_breakpoint_is_what_the_controller_means(slider_crank: srm.Mechanism) -> None:
    """``<``, ``<=`` and a quotient that rounds: the same run to the last bit."""
    at = 3 * 0.1  # 0.30000000000000004
    controllers = (
        lambda t, q, v: [1.0 if t < at else -1.0, 0.0],
        lambda t, q, v: [1.0 if t <= at else -1.0, 0.0],
        lambda t, q, v: [1.0 if t // 0.1 < 3 else -1.0, 0.0],
    )
    ends = [
        srm.simulate(slider_crank, 0.6, controller=c, breakpoints=[0.3, at]).q[-1]
        for c in controllers
    ]
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[0], ends[2])


@needs_kernel
@pytest.mark.parametrize(
    ("tableau", "step"), [("dop853", None), ("dopr54", None), ("erk4", 0.01), ("dop853", 0.05)]
)
def test_every_attempt_between_breakpoints_is_repeated(
    slider_crank: srm.Mechanism, tableau: str, step: float | None
) -> None:
    times = (*JUMPS, 0.371, 0.5, 0.5 + 1e-10, 1.2)
    found = compare(
        slider_crank,
        T_END,
        rtol=1e-7,
        tableau=tableau,
        step=step,
        controller=torque,
        breakpoints=times,
    )
    assert found.entered == len(times)
    assert found.decisions == []
    assert found.h < 1e-13
    assert found.state < 1e-13
    assert found.near < 2e-12
    assert found.rates < 1e-10
    assert found.error < 1e-12


@on_both
@pytest.mark.parametrize("step", [None, 0.01])
@pytest.mark.parametrize("beside", [0.0, 1e-9, -1e-7, 1e-4, -1e-3, 0.01])
def test_a_breakpoint_next_to_a_singular_configuration_changes_nothing(
    slider_crank: srm.Mechanism,
    smooth: srm.Solution,
    beside: float,
    step: float | None,
    backend: str,
) -> None:
    (passage,) = smooth.crossings
    time = passage.time + beside
    options: dict[str, Any] = {"rtol": 1e-9, "step": step, "backend": backend}
    cut = srm.simulate(slider_crank, 2.0, breakpoints=[time, time + 1e-6], **options)
    assert cut.success
    assert np.abs(cut.q[-1] - smooth.q[-1]).max() < 2e-9
    assert len(cut.crossings) == 1
    t = np.linspace(time - 0.05, time + 0.05, 21)
    assert np.abs(cut(t)[0] - smooth(t)[0]).max() < 2e-9


@on_both
def test_a_step_in_the_zone_between_breakpoints_is_read(
    slider_crank: srm.Mechanism, smooth: srm.Solution, backend: str
) -> None:
    """It has no neighbours to be interpolated from."""
    time, h = smooth.crossings[0].time, 0.01
    cut = srm.simulate(
        slider_crank,
        1.5,
        breakpoints=time + h * np.arange(-5, 6),
        step=h,
        placement="off",
        backend=backend,
    )
    assert cut.success
    assert cut.stats.zone_steps > 0
    t = np.linspace(time - 3.0 * h, time + 3.0 * h, 61)
    assert np.abs(cut(t)[0] - smooth(t)[0]).max() < 1e-6


@on_both
def test_a_torque_may_jump_on_a_singular_configuration(
    slider_crank: srm.Mechanism, smooth: srm.Solution, backend: str
) -> None:
    """The multiplier jumps there with the torque; the reduced equation is regular."""
    at = smooth.crossings[0].time
    y = reduced.integrate(reduced.slider_crank(), START, at)
    exact = pushed(lambda t: 20.0, at, 2.0, y)
    solution = srm.simulate(
        slider_crank,
        2.0,
        controller=lambda t, q, v: [20.0 if t > at else 0.0, 0.0],
        breakpoints=[at],
        rtol=1e-9,
        backend=backend,
    )
    assert solution.success
    assert abs(solution.q[-1, 0] - exact[0]) < 1e-8


@on_both
@pytest.mark.parametrize("t_end", [1.0, 1.003])
def test_a_controller_is_sampled_at_multiples_of_its_sample_time(
    slider_crank: srm.Mechanism, backend: str, t_end: float
) -> None:
    calls: list[float] = []

    def controller(t: float, q: Any, v: Any) -> np.ndarray:
        calls.append(t)
        return -2.0 * v

    solution = srm.simulate(
        slider_crank, t_end, controller=controller, sample_time=0.01, backend=backend
    )
    count = 100 if t_end == 1.0 else 101
    assert np.allclose(calls, 0.01 * np.arange(count), rtol=0.0, atol=1e-15)
    assert set(calls) <= set(solution.t.tolist())


def sampled_exactly(gain: float, period: float, t_end: float) -> np.ndarray:
    """The crank under a torque -gain w that is held over each period, by SciPy."""
    y = np.array(START)
    for _ in range(round(t_end / period)):
        y = pushed(lambda t, held=-gain * y[1]: held, 0.0, period, y)
    return y


@on_both
@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
def test_what_a_controller_returned_is_held_between_samples(
    slider_crank: srm.Mechanism, backend: str, tableau: str
) -> None:
    exact = sampled_exactly(3.0, 0.1, 2.0)
    solution = srm.simulate(
        slider_crank,
        2.0,
        controller=lambda t, q, v: [-3.0 * v[0], 0.0],
        sample_time=0.1,
        tableau=tableau,
        rtol=1e-10,
        backend=backend,
    )
    assert abs(solution.q[-1, 0] - exact[0]) < 1e-9
    assert abs(solution.v[-1, 0] - exact[1]) < 1e-9
    # Between samples the dense output and the reactions see what was held then.
    q, v = solution(0.95)
    start, rate = solution(0.9)
    again = srm.simulate(
        slider_crank,
        0.05,
        q0=start,
        v0=rate,
        controller=lambda t, q, v: [-3.0 * rate[0], 0.0],
        rtol=1e-12,
    )
    assert np.abs(q - again.q[-1]).max() < 1e-9
    assert np.abs(v - again.v[-1]).max() < 1e-9
    reactions = solution.at([0.95]).reactions["pin"]
    assert np.abs(reactions - again.reactions["pin"][-1:]).max() < 1e-6


def test_a_saved_run_knows_what_was_held(slider_crank: srm.Mechanism, tmp_path: Path) -> None:
    solution = srm.simulate(
        slider_crank, 1.5, controller=lambda t, q, v: [-3.0 * v[0], 0.0], sample_time=0.05
    )
    solution.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    t = np.linspace(0.0, 1.5, 101)
    assert np.array_equal(loaded(t)[0], solution(t)[0])
    assert np.array_equal(loaded.reactions["pin"], solution.reactions["pin"])


@on_both
def test_a_controller_may_return_the_same_array_every_time(
    slider_crank: srm.Mechanism, backend: str
) -> None:
    buffer = np.zeros(2)

    def reusing(t: float, q: Any, v: Any) -> Any:
        buffer[0] = np.sin(9.0 * t) - v[0]
        return buffer

    runs = [
        srm.simulate(slider_crank, 1.0, controller=controller, sample_time=0.1, backend=backend)
        for controller in (reusing, lambda t, q, v: reusing(t, q, v).copy())
    ]
    t = np.linspace(0.0, 1.0, 37)
    same, fresh = (run.at(t) for run in runs)
    assert np.array_equal(same.q, fresh.q)
    assert np.array_equal(same.reactions["pin"], fresh.reactions["pin"])
    assert abs(same.energy_balance.relative) < 1e-6


@on_both
def test_a_controller_that_fails_at_a_sample_ends_the_run_there(
    slider_crank: srm.Mechanism, backend: str
) -> None:
    def controller(t: float, q: Any, v: Any) -> Any:
        return [0.0] if t > 0.25 else [0.0, 0.0]

    solution = srm.simulate(
        slider_crank, 1.0, controller=controller, sample_time=0.1, backend=backend
    )
    assert solution.status == "failed"
    assert "returned an array of shape (1,)" in solution.message
    assert solution.t[-1] == pytest.approx(0.3)


@needs_kernel
def test_both_backends_find_the_same_events_between_samples(slider_crank: srm.Mechanism) -> None:
    found = []
    for backend in ("python", "kernel"):
        run = srm.simulate(
            slider_crank,
            2.0,
            controller=lambda t, q, v: -2.0 * v,
            sample_time=0.02,
            events=[lambda t, q, v: q[0] - 5.0],
            rtol=1e-10,
            backend=backend,
        )
        assert run.t_events is not None
        found.append(run.t_events[0])
    assert len(found[0]) >= 1
    assert found[1] == pytest.approx(found[0], abs=1e-9)


@needs_kernel
def test_many_breakpoints_cost_little(slider_crank: srm.Mechanism) -> None:
    """20 000 of them: an evaluation and a look at the list each."""
    times = np.arange(1, 20_000) * 5e-5
    solution = srm.simulate(slider_crank, 1.0, breakpoints=times, backend="kernel")
    assert solution.stats.steps <= 20_010
    assert solution.stats.evaluations <= 13 * 20_010


def test_intervals_join_times_that_no_step_fits_between() -> None:
    intervals = smooth_intervals(np.array([0.3, 3 * 0.1, -1.0, 7.0]), np.array([0.6]), 0.0, 1.0)
    assert intervals.ends.tolist() == [0.3, 0.6, 1.0]
    assert intervals.given.tolist() == [False, True]
    assert intervals.last[0] < 0.3 < 3 * 0.1 < intervals.first[1]
    assert intervals.first[0] == -np.inf
    assert intervals.last[-1] == np.inf
    ends = smooth_intervals(np.array([0.0, 1.0]), np.zeros(0), 0.0, 1.0)
    assert ends.count == 1
    assert 0.0 < ends.first[0] < 1e-300
    assert 1.0 - 1e-14 < ends.last[0] < 1.0


REFUSED: dict[str, dict[str, Any]] = {
    "breakpoints as a matrix": {"breakpoints": [[0.1]]},
    "breakpoints as words": {"breakpoints": ["x"]},
    "a breakpoint that is no number": {"breakpoints": [np.nan]},
    "nothing to sample": {"sample_time": 0.1},
    "sample time of zero": {"sample_time": 0.0, "controller": torque},
    "very many samples": {"sample_time": 1e-12, "controller": torque},
    "infinitely many samples": {"sample_time": 1e-310, "controller": torque},
}


def test_bad_options_are_refused(slider_crank: srm.Mechanism) -> None:
    run = partial(srm.simulate, slider_crank, 1.0)
    check_refusals("breakpoints", {case: partial(run, **given) for case, given in REFUSED.items()})
