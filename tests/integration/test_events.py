"""Events: when they happen, which count, where they end a run, and what they refuse."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import EventError
from srm_mbs.integration.control.step_size import FixedStep
from srm_mbs.integration.driver import integrate
from srm_mbs.integration.events import EventWatch, prepare_events
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.visualization.animation.trajectory import sample_motion
from tests.support import reduced
from tests.support.convergence import fitted_order
from tests.support.mechanisms import along_x, floating_ring, rod
from tests.support.slider_crank import PERIOD, START, off_branch
from tests.support.snapshots import check_refusals


@pytest.fixture(scope="module")
def slider_crank() -> srm.Mechanism:
    return srm.load("slider_crank")


def rate(t: float, q: Any, v: Any) -> float:
    return float(v[0])


def event(function: Callable[..., Any], terminal: Any = None, direction: float = 0.0) -> Any:
    """A fresh function with these attributes."""

    def copy(*arguments: Any) -> Any:
        return function(*arguments)

    copy.__name__ = function.__name__
    copy.terminal, copy.direction = terminal, direction  # type: ignore[attr-defined]
    return copy


def at(moment: float) -> Callable[..., float]:
    """An event function that is zero at that time (s)."""
    return lambda t, q, v: t - moment


def by_scipy(
    function: Callable[..., float], t_end: float, terminal: bool = False, direction: float = 0.0
) -> np.ndarray:
    """Times at which a ``function`` of the crank's angle is zero, by SciPy."""
    run = solve_ivp(
        reduced.slider_crank(),
        (0.0, t_end),
        START,
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
        events=event(lambda t, y: function(t, y, None), terminal, direction),
        max_step=0.05,
    )
    found: np.ndarray = run.t_events[0]
    return found


def times(solution: srm.Solution, i: int = 0) -> np.ndarray:
    assert solution.t_events is not None
    return solution.t_events[i]


def errors_of_turning_points(mechanism: srm.Mechanism, tableau: str, tol: float) -> np.ndarray:
    solution = srm.simulate(mechanism, 20.0, tableau=tableau, rtol=tol, atol=tol, events=rate)
    assert len(times(solution)) == 9
    return np.abs(times(solution) - PERIOD / 2.0 * np.arange(1, 10))


def test_turning_points_of_the_crank_come_every_half_period(slider_crank: srm.Mechanism) -> None:
    """Its rate is zero at the start as well, which is no event."""
    assert errors_of_turning_points(slider_crank, "dop853", 1e-10).max() < 1e-10


def test_errors_of_event_times_fall_with_the_tolerance(slider_crank: srm.Mechanism) -> None:
    tolerances = np.array([1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10])
    errors = [errors_of_turning_points(slider_crank, "dopr54", tol).max() for tol in tolerances]
    assert 0.8 < fitted_order(tolerances, errors) < 1.1


@pytest.mark.parametrize("tableau", ["tvd32", "dopr54", "dop853"])
def test_states_of_events_are_those_of_the_dense_output(
    slider_crank: srm.Mechanism, tableau: str
) -> None:
    solution = srm.simulate(slider_crank, 5.0, tableau=tableau, events=[rate])
    assert solution.q_events is not None
    assert solution.v_events is not None
    q, v = solution(times(solution))
    # To round-off: a compiled run is read by the kernel, its events are located in Python.
    assert np.abs(solution.q_events[0] - q).max() < 1e-14
    assert np.abs(solution.v_events[0] - v).max() < 1e-14
    assert np.abs(v[:, 0]).max() < 1e-14


@pytest.mark.parametrize("direction", [-1.0, 0.0, 1.0])
def test_directions_count_as_they_do_in_scipy(
    slider_crank: srm.Mechanism, direction: float
) -> None:
    def passes(t: float, q: Any, v: Any) -> float:
        return float(q[0] - 1.4 * np.pi)

    reference = by_scipy(passes, 10.0, direction=direction)
    solution = srm.simulate(
        slider_crank, 10.0, rtol=1e-9, atol=1e-9, events=event(passes, direction=direction)
    )
    assert len(reference) > 1
    assert times(solution) == pytest.approx(reference, rel=0.0, abs=1e-8)


@pytest.mark.parametrize(("terminal", "count"), [(True, 1), (1, 1), (3, 3), (np.int64(2), 2)])
def test_a_terminal_event_ends_the_run_at_its_occurrence(
    slider_crank: srm.Mechanism, terminal: Any, count: int
) -> None:
    solution = srm.simulate(slider_crank, 20.0, rtol=1e-9, events=event(rate, terminal))
    assert (solution.status, solution.success) == ("event", True)
    assert solution.t[-1] == pytest.approx(count * PERIOD / 2.0, abs=1e-7)
    assert len(times(solution)) == count
    assert "event 'rate'" in solution.message
    assert ("occurrence" in solution.message) == (count > 1)
    assert solution.t[-1] == times(solution)[-1]
    assert abs(solution.v[-1, 0]) < 1e-14
    assert np.array_equal(solution.q[-1], solution(solution.t[-1])[0])
    assert (np.diff(solution.t) > 0.0).all()


@pytest.mark.parametrize("terminal", [None, False, 0])
def test_other_events_do_not_end_the_run(slider_crank: srm.Mechanism, terminal: Any) -> None:
    solution = srm.simulate(slider_crank, 5.0, events=event(rate, terminal))
    assert solution.status == "finished"
    assert len(times(solution)) == 2


def test_nothing_of_the_run_goes_beyond_a_terminal_event(slider_crank: srm.Mechanism) -> None:
    """The last step does; dense output, drift, passages, playback and samples end at the event."""

    end = PERIOD / 4.0 - 0.01  # just before the passage
    stop = event(at(end), True)
    solution = srm.simulate(slider_crank, 5.0, events=[stop, rate])
    assert solution.t[-1] == pytest.approx(end, abs=1e-15)
    assert solution.steps.times[-1] > end + 0.01
    assert solution.crossings == ()
    assert len(solution.drift) == len(solution.energy) == len(solution.t)
    assert solution.drift[-1, 0] < 1e-8
    with pytest.raises(ValueError, match="the run covers"):
        solution(end + 1e-3)
    assert sample_motion(solution, (1,), 30.0).times[-1] == solution.t[-1]
    assert solution.plot().axes[-1].get_xlim()[1] < end + 0.02
    sampled = srm.simulate(slider_crank, 5.0, t_eval=np.linspace(0.0, 5.0, 51), events=stop)
    assert sampled.t[-1] == pytest.approx(1.0)
    assert len(sampled.t) == 11


def test_events_after_a_terminal_one_in_the_same_step_are_left_out(
    slider_crank: srm.Mechanism,
) -> None:
    solution = srm.simulate(
        slider_crank,
        1.0,
        step=0.5,
        tableau="erk4",
        events=[at(0.62), event(at(0.7), True), at(0.71), at(0.7), event(at(0.8), True)],
    )
    assert [len(times(solution, i)) for i in range(5)] == [1, 1, 0, 1, 0]
    assert solution.t[-1] == pytest.approx(0.7, abs=1e-15)


@pytest.mark.parametrize("level", [0.2, 0.02, 1e-3, 0.0, -1e-3])
def test_a_terminal_event_next_to_a_singular_passage_is_as_exact_as_any(
    slider_crank: srm.Mechanism, level: float
) -> None:
    def height(t: float, q: Any, v: Any) -> float:
        return float(q[0] - 1.5 * np.pi - level)

    (reference,) = by_scipy(height, 3.0, terminal=True)
    solution = srm.simulate(slider_crank, 3.0, rtol=1e-9, atol=1e-9, events=event(height, True))
    assert solution.status == "event"
    assert abs(solution.t[-1] - reference) < 1e-8
    assert off_branch(solution.q) < 1e-8


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
@pytest.mark.parametrize("depth", [1e-3, 1e-4, 1e-5])
def test_two_zeros_in_one_step_are_both_found(
    slider_crank: srm.Mechanism, tableau: str, depth: float
) -> None:
    """Around the turning point at half a period, 4 to 37 times closer than the step is long."""

    def dips(t: float, q: Any, v: Any) -> float:
        return float(q[0] - 1.25 * np.pi - depth)

    step = 0.23
    solution = srm.simulate(slider_crank, 3.0, tableau=tableau, step=step, events=dips)
    before, after = times(solution)
    assert np.searchsorted(solution.t, before) == np.searchsorted(solution.t, after)
    acceleration = reduced.slider_crank()(0.0, [1.25 * np.pi, 0.0])[1]
    assert after - before == pytest.approx(2.0 * np.sqrt(2.0 * depth / acceleration), rel=0.02)
    assert 0.5 * (before + after) == pytest.approx(0.5 * PERIOD, abs=1e-3)


def test_many_zeros_in_a_long_step_are_all_found() -> None:
    """As many as the dense output of dop853 has degrees, in one step of an open chain."""

    def wave(t: float, q: Any, v: Any) -> float:
        return float(np.sin(6.5 * np.pi * (t + 0.03)))

    solution = srm.simulate(srm.load("pendulum_chain"), 1.0, step=1.0, events=wave)
    assert solution.stats.steps == 1
    assert times(solution) == pytest.approx(np.arange(1, 7) / 6.5 - 0.03, abs=1e-15)


@pytest.mark.parametrize("moment", [0.5, 1.0])
@pytest.mark.parametrize("direction", [0.0, 1.0])
def test_a_zero_on_the_boundary_of_two_steps_or_at_the_end_is_one_event(
    slider_crank: srm.Mechanism, moment: float, direction: float
) -> None:
    passes = event(at(moment), direction=direction)
    solution = srm.simulate(slider_crank, 1.0, step=0.25, tableau="erk4", events=passes)
    assert moment in solution.t
    assert times(solution).tolist() == [moment]


def test_a_function_that_stays_zero_is_no_event(slider_crank: srm.Mechanism) -> None:
    assert len(times(srm.simulate(slider_crank, 1.0, events=lambda t, q, v: 0.0))) == 0


@pytest.mark.parametrize("offset", [0.0, 1e-15, -1e-15])
def test_a_run_continued_from_an_event_does_not_meet_it_again(offset: float) -> None:
    """A pendulum that passes its lowest point upwards, up to rounding."""
    mechanism = srm.load("pendulum_chain")

    def lowest(t: float, q: Any, v: Any) -> float:
        return float(q[0] + 0.5 * np.pi)

    first = srm.simulate(mechanism, 10.0, events=event(lowest, True))
    assert first.status == "event"
    q0 = first.q[-1].copy()
    q0[0] += offset
    second = srm.simulate(mechanism, 5.0, q0=q0, v0=first.v[-1], events=event(lowest, True))
    assert second.t[-1] > 0.1


def test_events_change_neither_steps_nor_states(slider_crank: srm.Mechanism) -> None:
    plain = srm.simulate(slider_crank, 5.0)
    watched = srm.simulate(slider_crank, 5.0, events=rate)
    assert plain.t_events is plain.q_events is plain.v_events is None
    assert np.array_equal(plain.t, watched.t)
    assert np.array_equal(plain.q, watched.q)
    # three extra stages of dop853 in each step
    assert watched.stats.evaluations == plain.stats.evaluations + 3 * plain.stats.steps


def test_events_may_come_from_a_generator(slider_crank: srm.Mechanism) -> None:
    listed = srm.simulate(slider_crank, 5.0, events=[rate])
    made = srm.simulate(slider_crank, 5.0, events=(event(rate) for _ in range(2)))
    assert np.array_equal(times(made, 1), times(listed))
    assert made.request is not None
    assert len(list(made.request.events)) == 2
    swept = srm.sweep(
        slider_crank,
        [{}, {}],
        5.0,
        events=(event(rate) for _ in range(2)),
        measure=lambda run: {"found": len(times(run, 1))},
    )
    assert swept.table["found"].tolist() == [len(times(listed))] * 2


def test_events_see_copies(slider_crank: srm.Mechanism) -> None:
    def vandal(t: float, q: Any, v: Any) -> float:
        value = float(v[0])
        q[:], v[:] = 99.0, 99.0
        return value

    spoilt = srm.simulate(slider_crank, 5.0, events=vandal)
    plain = srm.simulate(slider_crank, 5.0, events=rate)
    assert np.array_equal(spoilt.q, plain.q)
    assert np.array_equal(times(spoilt), times(plain))


def test_events_on_lie_groups_have_states_on_the_manifold() -> None:
    ring = floating_ring()

    def upside(t: float, q: Any, v: Any) -> float:
        return float(pin.Quaternion(*q[[6, 3, 4, 5]]).toRotationMatrix()[2, 2] - 0.5)

    solution = srm.simulate(ring, 5.0, rtol=1e-8, events=upside)
    fine = srm.simulate(ring, 5.0, rtol=1e-11, events=upside)
    assert len(times(solution)) >= 2
    assert np.abs(times(solution) - times(fine)).max() < 1e-6
    assert solution.q_events is not None
    for t, q in zip(times(solution), solution.q_events[0]):
        assert pin.isNormalized(ring.model, q, 1e-12)
        assert abs(upside(t, q, None)) < 1e-14


def test_events_of_systems_that_are_no_mechanism_take_states() -> None:
    mechanism = srm.load("pendulum_chain")
    system, method, norm = make_system(mechanism), srm.PSRM("dopr54"), ErrorNorm(np.ones(6), 1e-6)
    x0 = np.concatenate([mechanism.q0, mechanism.v0])

    def third_rate(t: float, x: Any) -> float:
        return float(x[5] - 0.1)

    found = prepare_events(third_rate, lambda function: function)
    watch = EventWatch(method.scheme, found, x0.size)
    memory = method.start(system, 0.0, x0, norm)
    control = FixedStep(0.0, 2.0, 0.01)
    record = integrate(system, method, control, norm, memory, x0, 0.0, 2.0, events=watch)
    assert record.status == "finished"
    (at,), (states,) = watch.found()
    assert len(at) > 0
    assert states.shape == (len(at), 6)
    assert np.abs(states[:, 5] - 0.1).max() < 1e-14


def test_a_run_that_stops_at_a_joint_limit_has_not_left_it() -> None:
    model = pin.Model()
    limits = [np.full(1, value) for value in (1e3, 1e3, -0.5, 0.5)]
    joint = model.addJoint(0, pin.JointModelRY(), along_x(0.0), "swing", *limits)
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    mechanism = srm.Mechanism(model)

    def limit(t: float, q: Any, v: Any) -> float:
        return float(0.5 - abs(q[0]))

    assert "limits" in srm.simulate(mechanism, 1.0).message
    stopped = srm.simulate(mechanism, 1.0, events=event(limit, True))
    assert abs(stopped.q[-1, 0]) == pytest.approx(0.5, abs=1e-15)
    assert "limits" not in stopped.message


def raises(t: float, q: Any, v: Any) -> float:
    if t > 0.7:
        raise RuntimeError("no light")
    return 1.0


def is_nan(t: float, q: Any, v: Any) -> float:
    return float("nan") if t > 0.7 else 1.0


def is_none(t: float, q: Any, v: Any) -> Any:
    return None if t > 0.7 else 1.0


def is_vector(t: float, q: Any, v: Any) -> Any:
    return v if t > 0.7 else 1.0


def is_complex(t: float, q: Any, v: Any) -> Any:
    return np.complex128(1.0 + 1.0j) if t > 0.7 else 1.0


@pytest.mark.filterwarnings("ignore:Casting complex values")  # would be an error of its own
@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (raises, "no light"),
        (is_nan, "returned nan"),
        (is_none, "returned None"),
        (is_vector, "one finite number"),
        (is_complex, "complex values"),
    ],
)
def test_an_event_function_that_fails_ends_the_run_with_what_was_computed(
    slider_crank: srm.Mechanism, bad: Any, words: str
) -> None:
    solution = srm.simulate(slider_crank, 5.0, events=[rate, bad])
    assert solution.status == "failed"
    assert f"the event '{bad.__name__}'" in solution.message
    assert words in solution.message
    assert 0.3 < solution.t[-1] < 1.5
    with pytest.raises(srm.SimulationError, match=words):
        srm.simulate(slider_crank, 5.0, events=bad, raise_on_failure=True)


def test_an_event_that_fails_at_the_start_is_told_by_its_place(slider_crank: srm.Mechanism) -> None:
    with pytest.raises(EventError, match=r"events\[1\]"):
        srm.simulate(slider_crank, 5.0, events=[rate, lambda t, q, v: np.inf])


REFUSED: dict[str, Any] = {
    "a number": 3,
    "a word": [rate, "rate"],
    "a negative number of occurrences": event(rate, terminal=-1),
    "a broken number of occurrences": event(rate, terminal=1.5),
    "occurrences as a word": event(rate, terminal="yes"),
    "occurrences that are no number": event(rate, terminal=float("nan")),
    "direction as a word": event(rate, direction="up"),  # type: ignore[arg-type]
    "direction that is no number": event(rate, direction=float("nan")),
}


def test_bad_events_are_refused_before_any_stepping(slider_crank: srm.Mechanism) -> None:
    run = partial(srm.simulate, slider_crank, 1.0)
    check_refusals("events", {case: partial(run, events=bad) for case, bad in REFUSED.items()})


@pytest.mark.parametrize("place", [1000.0, 1000.1, 1000.2, 1000.3])
def test_a_zero_is_known_to_rounding_without_bisection_after_it_is_found(place: float) -> None:
    """A body in free flight: its position is linear in time but for rounding."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    index = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    body = pin.Inertia(1.0, np.zeros(3), np.eye(3))
    model.appendBodyToJoint(index, body, pin.SE3.Identity())
    seen: list[float] = []

    def reached(t: float, q: Any, v: Any) -> float:
        seen.append(t)
        return float(q[0]) - place

    run = srm.simulate(srm.Mechanism(model, v0=[1.0]), 2000.0, events=reached, max_step=7.1)
    assert run.t_events is not None
    assert run.t_events[0] == pytest.approx([place], abs=1e-12 * place)
    # One at the start, and where a step of dop853 has equal parts: its degree is 7.
    assert len(seen) - 1 - 7 * run.stats.steps <= 8
