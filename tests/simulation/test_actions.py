"""Events that act: impacts, clutches and closures that let go, against exact solutions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support import reduced
from tests.support.backends import on_both
from tests.support.bundled import load
from tests.support.snapshots import check_messages, refused

G = 9.81


def one_joint(joint: Any, name: str = "slide") -> pin.Model:
    model = pin.Model()
    model.name = name
    index = model.addJoint(0, joint, pin.SE3.Identity(), name)
    model.appendBodyToJoint(index, pin.Inertia(2.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    model.addBodyFrame(name, index, pin.SE3.Identity(), 0)
    return model


@pytest.fixture(scope="module")
def ball() -> srm.Mechanism:
    """A mass on a vertical prismatic joint, 1 m above the floor."""
    return srm.Mechanism(one_joint(pin.JointModelPZ()), q0=[1.0])


def height(t: float, q: Any, v: Any) -> float:
    return float(q[0])


def floor(restitution: float, **options: Any) -> srm.Event:
    return srm.Event(height, direction=-1, action=lambda t, q, v: (q, -restitution * v), **options)


def bounces(restitution: float, t_end: float) -> np.ndarray:
    """Times of the impacts: flights last 2 e^k v_0 / g."""
    times, speed = [np.sqrt(2.0 / G)], np.sqrt(2.0 * G)
    while times[-1] < t_end and len(times) < 50:
        speed *= restitution
        times.append(times[-1] + 2.0 * speed / G)
    return np.array(times[:-1])


@on_both
@pytest.mark.parametrize(("restitution", "step"), [(0.7, None), (0.7, 0.05), (0.9, None)])
def test_a_ball_bounces_at_the_exact_times_to_the_exact_heights(
    ball: srm.Mechanism, restitution: float, step: float | None, backend: str
) -> None:
    solution = srm.simulate(
        ball, 2.4, events=floor(restitution), step=step, backend=backend, tableau="dop853"
    )
    exact = bounces(restitution, 2.4)
    assert solution.t_events is not None
    assert len(exact) >= 3
    assert np.abs(solution.t_events[0] - exact).max() < 1e-13
    assert len(solution.segments) == len(exact) + 1  # type: ignore[attr-defined]
    tops = 0.5 * (exact[1:] + exact[:-1])
    heights, rates = solution(tops)
    powers = restitution ** (2.0 * np.arange(1, len(exact)))
    assert np.abs(heights[:, 0] - powers).max() < 1e-13
    assert np.abs(rates).max() < 1e-12
    energy = solution.at(tops).energy
    assert np.abs(energy - 2.0 * G * powers).max() < 1e-11


def test_a_jump_has_two_rows_and_dense_output_the_later(ball: srm.Mechanism) -> None:
    solution = srm.simulate(ball, 1.0, events=floor(0.5))
    assert solution.t_events is not None
    (at,) = solution.t_events[0][:1]
    (rows,) = np.nonzero(solution.t == at)
    assert len(rows) == 2
    assert solution.v[rows[1], 0] == pytest.approx(-0.5 * solution.v[rows[0], 0], rel=1e-12)
    assert solution(at)[1][0] > 0.0
    assert solution(np.nextafter(at, 0.0))[1][0] < 0.0
    assert np.all(np.diff(solution.t) >= 0.0)
    assert solution.drift.shape == (len(solution.t), 2)
    assert solution.span == (0.0, 1.0)
    position, rate = solution.joint("slide")
    assert np.array_equal(position, solution.q[:, 0])
    assert np.array_equal(rate, solution.v[:, 0])
    given = srm.simulate(ball, 1.0, events=floor(0.5), t_eval=np.array([0.1, at, 0.9]))
    assert np.array_equal(given.v, solution(np.array([0.1, at, 0.9]))[1])
    shuffled = np.array([0.9, 0.1, 0.6])
    assert np.array_equal(solution.at(shuffled).energy, solution.at(shuffled[::-1]).energy[::-1])


def test_chattering_ends_the_run_where_the_bounces_accumulate(ball: srm.Mechanism) -> None:
    solution = srm.simulate(ball, 3.0, events=floor(0.5))
    assert solution.status == "failed"
    assert "chatters" in solution.message
    accumulation = np.sqrt(2.0 / G) * (1.0 + 0.5) / (1.0 - 0.5)
    assert solution.t[-1] == pytest.approx(accumulation, abs=1e-7)
    with pytest.raises(srm.SimulationError, match="chatters"):
        srm.simulate(ball, 3.0, events=floor(0.5), raise_on_failure=True)


def test_a_slow_impact_can_be_held(ball: srm.Mechanism) -> None:
    plane = srm.Anchor("world", xyz=(1.0, 0.0, 0.0))
    held = ball.with_loop(
        srm.LoopClosure("point_on_plane", srm.Anchor("slide"), plane, (0.0, 0.0, 1.0), "floor")
    )

    def hit(t: float, q: Any, v: Any) -> Any:
        return srm.Switch(held) if abs(v[0]) < 0.1 else (q, -0.5 * v)

    solution = srm.simulate(ball, 3.0, events=srm.Event(height, direction=-1, action=hit))
    assert solution.success
    assert solution.t[-1] == 3.0
    assert abs(solution.q[-1, 0]) < 1e-9
    assert abs(solution.v[-1, 0]) < 1e-12
    reactions = solution.reactions["floor"]
    assert reactions[0, 2] == 0.0
    assert reactions[-1, :3] == pytest.approx([0.0, 0.0, -2.0 * G], abs=1e-9)


def flywheels() -> srm.Mechanism:
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    for name, inertia in (("a", 3.0), ("b", 2.0)):
        index = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), name)
        body = pin.Inertia(1.0, np.zeros(3), inertia * np.eye(3))
        model.appendBodyToJoint(index, body, pin.SE3.Identity())
        model.addBodyFrame(name, index, pin.SE3.Identity(), 0)
    return srm.Mechanism(model, v0=[10.0, -2.0])


def clock(at: float) -> Any:
    return lambda t, q, v: t - at


@on_both
def test_a_clutch_conserves_angular_momentum(backend: str) -> None:
    """It closes at 1 s under whatever angle, and opens again at 2 s."""
    wheels = flywheels()

    def close(t: float, q: Any, v: Any) -> srm.Switch:
        clutch = srm.LoopClosure(
            "coupling", joints=("a", "b"), ratio=1.0, offset=float(q[0] - q[1]), name="clutch"
        )
        return srm.Switch(wheels.with_loop(clutch))

    events = [
        srm.Event(clock(1.0), action=close),
        srm.Event(
            clock(2.0), action=lambda t, q, v: srm.Switch(wheels, v=v + np.array([1.0, 0.0]))
        ),
    ]
    solution = srm.simulate(wheels, 3.0, events=events, backend=backend)
    assert solution.success
    together = (3.0 * 10.0 - 2.0 * 2.0) / 5.0
    q, v = solution(np.array([0.5, 1.0, 1.5, 2.5]))
    assert v == pytest.approx(
        np.array([[10.0, -2.0], *2 * [[together, together]], [together + 1.0, together]]),
        abs=1e-12,
    )
    assert q[2] == pytest.approx([10.0 + 0.5 * together, -2.0 + 0.5 * together], abs=1e-12)
    segments = solution.segments  # type: ignore[attr-defined]
    assert [len(segment.mechanism.loops) for segment in segments] == [0, 1, 0]
    assert [segment.degrees_of_freedom[0] for segment in segments] == [2, 1, 2]
    energy = solution.energy
    assert energy[0] - energy[-1] > 0.0


@on_both
def test_a_closure_lets_go_and_the_mechanism_falls_on_freely(backend: str) -> None:
    """The slider-crank loses its pin: from there it is the open chain from that state."""
    mechanism = load("slider_crank")
    freed = mechanism.without_loop("pin")
    options: dict[str, Any] = {"rtol": 1e-10, "backend": backend}
    event = srm.Event(clock(0.8), action=lambda t, q, v: srm.Switch(freed))
    solution = srm.simulate(mechanism, 1.5, events=[event], **options)
    before = srm.simulate(mechanism, 0.8, **options)
    after = srm.simulate(freed, 0.7, q0=before.q[-1], v0=before.v[-1], **options)
    assert np.abs(solution.q[-1] - after.q[-1]).max() < 1e-8
    assert np.abs(solution.v[-1] - after.v[-1]).max() < 1e-8
    held = solution.t < 0.8
    reactions = np.linalg.norm(solution.reactions["pin"], axis=1)
    assert reactions[held].min() > 1e-3
    assert np.all(reactions[solution.t > 0.8] == 0.0)
    assert len(solution.crossings) == len(before.crossings)


@on_both
def test_a_drive_lets_go(backend: str) -> None:
    """The crank turns at constant speed, passes a singular configuration, and is then free."""
    free = load("slider_crank")
    speed = 4.0
    driven = srm.Mechanism(
        free.model,
        free.loops,
        drives=(srm.Drive(srm.ConstantSpeed(speed), joint="crank"),),
        q0=free.q0,
        v0=[speed, -2.0 * speed],
    )
    event = srm.Event(clock(0.6), action=lambda t, q, v: srm.Switch(driven.without_drive("crank")))
    options: dict[str, Any] = {"rtol": 1e-10, "backend": backend}
    solution = srm.simulate(driven, 1.2, events=[event], **options)
    assert solution.success
    angle = float(free.q0[0]) + speed * 0.6
    q, v = solution(0.6)
    assert q[0] == pytest.approx(angle, abs=1e-12)
    assert v[0] == pytest.approx(speed, abs=1e-9)
    after = srm.simulate(free, 0.6, q0=q, v0=v, **options)
    assert np.abs(solution.q[-1] - after.q[-1]).max() < 1e-8
    # Another event leaves the drive as it was: it goes on, not from the new state.
    nothing = srm.Event(clock(0.3), action=lambda t, q, v: None)
    on = srm.simulate(driven, 0.9, events=[nothing], **options)
    assert on.success
    assert on.q[-1, 0] == pytest.approx(float(free.q0[0]) + speed * 0.9, abs=1e-11)


@on_both
@pytest.mark.parametrize("law", [srm.ConstantSpeed(speed=6.0), srm.Sine(amplitude=0.4, omega=9.0)])
def test_a_drive_engages_where_it_finds_its_joint(law: Any, backend: str, tmp_path: Path) -> None:
    free = load("slider_crank_regular")
    driven = replace(free, drives=[srm.Drive(law, joint="crank")])
    event = srm.Event(clock(0.3), action=lambda t, q, v: srm.Switch(driven))
    run = srm.simulate(free, 0.8, events=event, backend=backend, rtol=1e-9)
    assert run.success, run.message
    curve = law.curve()
    t = np.linspace(0.3, 0.8, 21)
    found = run(t)[0][:, 0]
    wanted = np.array([curve(s)[0] for s in t])
    assert np.abs(found - wanted - (run(0.3)[0][0] - wanted[0])).max() < 1e-12
    # The rates jump as the closures have it; from there the motion is that of a driven start.
    before, after = run.segments  # type: ignore[attr-defined]
    assert np.abs(after.q[0] - before.q[-1]).max() < 1e-9
    assert after.v[0, 0] == pytest.approx(curve(0.3)[1], abs=1e-12)
    assert run.drift.max() < 1e-9
    run.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    assert np.array_equal(loaded.drive_forces["crank"], run.drive_forces["crank"])


@pytest.mark.parametrize("beside", [0.0, 1e-9, -1e-9])
@on_both
def test_an_event_may_act_next_to_a_singular_configuration(backend: str, beside: float) -> None:
    mechanism = load("slider_crank")
    plain = srm.simulate(mechanism, 3.0, rtol=1e-11)
    at = plain.crossings[0].time + beside
    event = srm.Event(clock(at), action=lambda t, q, v: (q, v))
    run = srm.simulate(mechanism, 3.0, rtol=1e-9, events=event, backend=backend)
    assert run.success, run.message
    assert np.abs(run.q[-1] - plain.q[-1]).max() < 1e-9
    assert run.drift.max() < 1e-10


@on_both
def test_a_state_from_which_no_run_can_start_ends_the_run_with_everything_kept(
    backend: str,
) -> None:
    mechanism = load("slider_crank")
    (passage, *_) = srm.simulate(mechanism, 2.0, rtol=1e-10).crossings
    stop = srm.Event(clock(passage.time), action=lambda t, q, v: (q, 0.0 * v))
    run = srm.simulate(mechanism, 2.0, rtol=1e-10, events=stop, backend=backend)
    assert run.status == "failed"
    assert "after the action" in run.message
    assert "singular" in run.message
    assert run.t[-1] == pytest.approx(passage.time)


def test_ctrl_c_in_an_action_keeps_the_segments(ball: srm.Mechanism) -> None:
    def stopped(t: float, q: Any, v: Any) -> None:
        raise KeyboardInterrupt

    run = srm.simulate(ball, 1.0, events=srm.Event(clock(0.25), action=stopped))
    assert run.status == "interrupted"
    assert run.t[-1] == pytest.approx(0.25)


def test_an_impact_in_a_loop_keeps_the_loop_and_loses_the_energy_it_should() -> None:
    """The crank hits a stop: with one degree of freedom the whole velocity turns, times e."""
    mechanism = load("slider_crank")
    e = 0.6

    def hit(t: float, q: Any, v: Any) -> Any:
        return q, srm.impact(mechanism, q, v, [1.0, 0.0], e)

    stop = srm.Event(lambda t, q, v: q[0] - 5.2, direction=-1, action=hit)
    solution = srm.simulate(mechanism, 1.5, events=[stop], rtol=1e-10)
    assert solution.t_events is not None
    assert len(solution.t_events[0]) >= 1
    at = solution.t_events[0][0]
    first, second = np.flatnonzero(solution.t == at)[:2]
    assert solution.v[second] == pytest.approx(-e * solution.v[first], rel=1e-7)
    assert solution.drift.max() < 1e-7
    level = solution.energy[0]
    before = 0.0
    kinetic = (
        solution.v[first]
        @ pin.crba(mechanism.model, mechanism.model.createData(), solution.q[first])
        @ solution.v[first]
    )
    assert before + level - solution.energy[second] == pytest.approx(
        0.5 * kinetic * (1.0 - e**2), rel=1e-6
    )


def test_an_action_may_run_the_mechanism_that_it_acts_on() -> None:
    """The kernel system of the run around it is lent to nobody meanwhile."""
    mechanism = load("four_bar")

    def stop(acted: bool) -> srm.Event:
        def hit(t: float, q: Any, v: Any) -> Any:
            if acted:
                srm.simulate(mechanism, 0.2)
                srm.simulate(mechanism, 0.2, q0=q, v0=v).at([0.1])
            return q, srm.impact(mechanism, q, v, [1.0, 0.0, 0.0], 0.8)

        start = mechanism.q0[0]
        return srm.Event(lambda t, q, v: start + 0.1 - q[0], direction=-1, action=hit)

    alone, beside = (srm.simulate(mechanism, 2.0, events=stop(acted)) for acted in (False, True))
    assert len(alone.segments) > 1
    np.testing.assert_array_equal(alone.t, beside.t)
    np.testing.assert_array_equal(alone.v, beside.v)


def test_an_impact_of_two_masses_conserves_momentum() -> None:
    """Newton's law between free bodies, elastic: equal masses exchange their velocities."""
    model = one_joint(pin.JointModelPX(), "a")
    index = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "b")
    model.appendBodyToJoint(index, pin.Inertia(2.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    pair = srm.Mechanism(model, q0=[0.0, 1.0], v0=[3.0, -1.0])
    assert srm.impact(pair, pair.q0, pair.v0, [-1.0, 1.0], 1.0) == pytest.approx([-1.0, 3.0])
    assert srm.impact(pair, pair.q0, pair.v0, [-1.0, 1.0], 0.0) == pytest.approx([1.0, 1.0])


def three_balls(height: float, lower: float, **options: Any) -> srm.Solution:
    """Dropped from ``height``, one of them from ``lower`` below it, and reflected elastically."""
    model = pin.Model()
    for name in "abc":
        index = model.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), name)
        model.appendBodyToJoint(index, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())

    def stop(gap: Any, k: int) -> srm.Event:
        def hit(t: float, q: Any, v: Any) -> Any:
            v[k] *= -1.0
            return q, v

        return srm.Event(gap, direction=-1, action=hit)

    stops = [
        stop(lambda t, q, v: q[0], 0),
        stop(lambda t, q, v: np.sin(q[1]), 1),
        stop(lambda t, q, v: q[2] ** 3 + q[2], 2),
    ]
    balls = srm.Mechanism(model, q0=[height, height, height - lower])
    solution = srm.simulate(balls, 1.0, events=stops, **options)
    assert solution.success, solution.message
    return solution


@on_both
@pytest.mark.parametrize("rtol", [1e-6, pytest.param(1e-9, marks=pytest.mark.stress)])
@pytest.mark.parametrize("lower", [0.0, 1e-13, 1e-10])
def test_impacts_that_are_simultaneous_but_for_rounding_all_act(
    lower: float, rtol: float, backend: str
) -> None:
    solution = three_balls(0.7, lower, rtol=rtol, backend=backend)
    assert solution.t_events is not None
    first = np.sqrt(1.4 / G)
    for times in solution.t_events:
        assert times == pytest.approx([first], abs=1e-9)
    rest = 1.0 - first
    exact = np.sqrt(1.4 * G) * rest - 0.5 * G * rest**2
    assert solution.q[-1] == pytest.approx([exact] * 3, abs=1e-8)


@on_both
@pytest.mark.parametrize("height", [1.0, 1.3])
@pytest.mark.parametrize("lower", [1e-10, 1e-9])
def test_two_impacts_at_once_act_just_after_a_third(
    lower: float, height: float, backend: str
) -> None:
    """The step in which they lie is so short that a part of it is less than the rounding of t."""
    solution = three_balls(height, lower, backend=backend)
    assert solution.t_events is not None
    for times in solution.t_events:
        assert times == pytest.approx([np.sqrt(2.0 * height / G)], abs=1e-9)


def test_terminal_events_count_over_all_segments(ball: srm.Mechanism) -> None:
    solution = srm.simulate(ball, 3.0, events=[floor(0.7, terminal=3)])
    assert solution.status == "event"
    assert solution.t[-1] == pytest.approx(bounces(0.7, 2.4)[2], abs=1e-12)
    assert "occurrence" not in solution.message or "3" in solution.message
    tops = srm.Event(lambda t, q, v: v[0], direction=-1)
    both = srm.simulate(ball, 2.0, events=[floor(0.7), tops])
    assert both.t_events is not None
    exact = bounces(0.7, 2.0)
    assert both.t_events[1][: len(exact) - 1] == pytest.approx(0.5 * (exact[1:] + exact[:-1]))


def test_samples_go_on_over_a_jump(ball: srm.Mechanism) -> None:
    calls: list[float] = []

    def controller(t: float, q: Any, v: Any) -> list[float]:
        calls.append(t)
        return [1.0]

    solution = srm.simulate(ball, 1.0, events=floor(0.5), controller=controller, sample_time=0.1)
    assert solution.success
    assert calls == pytest.approx(np.arange(10) * 0.1)


def test_a_run_of_segments_is_saved_and_loaded(ball: srm.Mechanism, tmp_path: Path) -> None:
    solution = srm.simulate(ball, 1.5, events=floor(0.6))
    solution.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    assert np.array_equal(loaded.t, solution.t)
    assert np.array_equal(loaded.v, solution.v)
    t = np.linspace(0.0, 1.5, 77)
    assert np.array_equal(loaded(t)[0], solution(t)[0])
    assert loaded.message == solution.message
    assert loaded.t_events is not None
    assert solution.t_events is not None
    assert np.array_equal(loaded.t_events[0], solution.t_events[0])
    solution.to_csv(tmp_path / "run.csv")
    assert len((tmp_path / "run.csv").read_text().splitlines()) > len(solution.t)
    solution.plot(tmp_path / "run.png")


@on_both
def test_runs_start_at_any_time(ball: srm.Mechanism, backend: str) -> None:
    """A force of t, from 1 s on; a drive or a table would do the same."""
    options: dict[str, Any] = {"backend": backend, "rtol": 1e-10}
    force = srm.simulate(ball, 3.0, controller=lambda t, q, v: [np.sin(t)], **options)
    q, v = force(1.0)
    late = srm.simulate(
        ball, 3.0, t0=1.0, q0=q, v0=v, controller=lambda t, q, v: [np.sin(t)], **options
    )
    assert late.t[0] == 1.0
    assert np.abs(late.q[-1] - force.q[-1]).max() < 1e-9


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda t, q, v: 1 / 0, "raised ZeroDivisionError"),
        (lambda t, q, v: 3, "it returned 3. Return None, the state (q, v), or srm.Switch"),
        (lambda t, q, v: (q,), "Return None, the state (q, v), or srm.Switch(mechanism)"),
        (lambda t, q, v: flywheels(), "it returned Mechanism('"),
        (lambda t, q, v: (q, [1.0, 2.0]), "finite numbers"),
        (lambda t, q, v: srm.Switch(None), "same joints"),  # type: ignore[arg-type]
        (lambda t, q, v: srm.Switch(flywheels()), "same joints"),
    ],
)
def test_a_bad_action_ends_the_run_with_everything_kept(
    ball: srm.Mechanism, action: Any, message: str
) -> None:
    solution = srm.simulate(ball, 2.0, events=srm.Event(height, direction=-1, action=action))
    assert solution.status == "failed"
    assert message in solution.message
    assert "'height'" in solution.message
    assert solution.t[-1] == pytest.approx(np.sqrt(2.0 / G))


class Above(srm.Event):
    """The event 0.25 m above the zero of its function."""

    def __call__(self, t: float, q: Any, v: Any) -> Any:
        return super().__call__(t, q, v) - 0.25


@on_both
@pytest.mark.parametrize("action", [None, lambda t, q, v: None])
def test_an_event_of_a_subclass_has_its_own_value_with_an_action_as_without(
    ball: srm.Mechanism, action: Any, backend: str
) -> None:
    solution = srm.simulate(ball, 1.0, events=Above(height, action=action), backend=backend)
    assert solution.t_events[0] == pytest.approx([np.sqrt(2.0 * 0.75 / G)])


@pytest.mark.filterwarnings("ignore:Casting complex values")  # would be an error of its own
@on_both
@pytest.mark.parametrize("imaginary", [0.0, 2.0])
@pytest.mark.parametrize("place", [0, 1], ids=["q", "v"])
def test_a_complex_state_from_an_action_is_refused_as_other_wrong_ones_are(
    ball: srm.Mechanism, place: int, imaginary: float, backend: str
) -> None:
    factors = [1.0, 1.0]
    factors[place] = 1.0 + 1j * imaginary
    of_q, of_v = factors
    for action in (
        lambda t, q, v: (of_q * q, of_v * v),
        lambda t, q, v: ([of_q * q[0]], [of_v * v[0]]),
        lambda t, q, v: srm.Switch(ball, q=of_q * q, v=of_v * v),
    ):
        event = srm.Event(height, direction=-1, action=action)
        solution = srm.simulate(ball, 2.0, events=event, backend=backend)
        assert solution.status == "failed"
        name = "qv"[place]
        said = f"cannot be carried out: {name}: {name} does not consist of 1 finite numbers"
        assert f"the action of the event 'height' {said}" in solution.message


def test_a_switch_to_closures_that_are_open_is_refused() -> None:
    wheels = flywheels()
    clutch = srm.LoopClosure("coupling", joints=("a", "b"), ratio=1.0, name="clutch")
    event = srm.Event(clock(1.0), action=lambda t, q, v: srm.Switch(wheels.with_loop(clutch)))
    solution = srm.simulate(wheels, 2.0, events=event)
    assert solution.status == "failed"
    assert "violates the closures" in solution.message


def test_an_event_is_shown_with_its_attributes() -> None:
    event = srm.Event(height, direction=-1, action=height)
    assert repr(event) == "Event(height, direction=-1, terminal=False, action=height)"
    assert repr(srm.Event(height)) == "Event(height, direction=0.0, terminal=False, action=None)"


def test_bad_events_and_loops_are_refused(ball: srm.Mechanism) -> None:
    pinned = load("slider_crank")

    def falling(t: float, q: Any, v: Any) -> float:
        return float(q[0])

    falling.action = "stop"  # type: ignore[attr-defined]
    calls = {
        "event of a number": lambda: srm.Event(3),  # type: ignore[arg-type]
        "action of a number": lambda: srm.Event(height, action=3),  # type: ignore[arg-type]
        "action of a text": lambda: srm.simulate(ball, 1.0, events=falling),
        "terminal = -1": lambda: srm.simulate(ball, 1.0, events=floor(0.5, terminal=-1)),
        "with a loop twice": lambda: pinned.with_loop(pinned.loops[0]),
        "restitution above 1": lambda: srm.impact(ball, ball.q0, ball.v0, [1.0], 2.0),
        "two rates of a ball": lambda: srm.impact(ball, ball.q0, [1.0, 2.0], [1.0]),
        "normal of another shape": lambda: srm.impact(ball, ball.q0, ball.v0, [1.0, 0.0]),
        "normal that nothing moves along": lambda: srm.impact(ball, ball.q0, ball.v0, [0.0]),
    }
    check_messages("actions", {case: refused(call) for case, call in calls.items()})
    with pytest.raises(srm.InputError, match=r"there is no loop 'x'\. Known: 'pin'"):
        pinned.without_loop("x")
    with pytest.raises(srm.InputError, match="there is no drive 'crank'"):
        pinned.without_drive("crank")


def test_forces_of_a_drive_that_lets_go_are_those_of_its_time() -> None:
    free = load("slider_crank")
    crank = srm.Drive(srm.ConstantSpeed(4.0), joint="crank")
    driven = srm.Mechanism(free.model, free.loops, drives=(crank,), q0=free.q0, v0=[4.0, -8.0])
    event = srm.Event(clock(0.3), action=lambda t, q, v: srm.Switch(driven.without_drive("crank")))
    solution = srm.simulate(driven, 0.6, events=[event])
    before = srm.simulate(driven, 0.3).at([0.1, 0.2])
    read = solution.at([0.1, 0.5, 0.2])
    np.testing.assert_allclose(
        read.drive_forces["crank"][[0, 2]], before.drive_forces["crank"], rtol=1e-4
    )
    assert read.drive_forces["crank"][1] == 0.0
    np.testing.assert_array_equal(read.drive_rates["crank"], [4.0, 0.0, 4.0])


# --- next to singular configurations ------------------------------------------------------------

BESIDE = [-1e-4, -1e-7, -1e-9, 0.0, 1e-12, 1e-8, 1e-6, 1e-3]
"""Times (s) between a passage through a singular configuration and an action."""


@on_both
@pytest.mark.parametrize("name", ["slider_crank", "parallelogram"])
@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_an_action_beside_a_singular_configuration_leaves_the_motion_on_its_branch(
    name: str, rtol: float, backend: str
) -> None:
    """Each one slows the mechanism down, or turns it back, in proportion: along its branch."""
    mechanism = load(name)
    field = {"slider_crank": reduced.slider_crank, "parallelogram": reduced.parallelogram}[name]()
    start = [float(mechanism.q0[0]), float(mechanism.v0[0])]
    passage = srm.simulate(mechanism, 1.5, rtol=1e-10).crossings[0].time
    along = np.array({"slider_crank": [1.0, -2.0], "parallelogram": [1.0, -1.0, 1.0]}[name])
    for beside, factor in zip(BESIDE, [0.8, -0.5] * 4):
        at, t_end = passage + beside, passage + 0.5
        given: list[np.ndarray] = []

        def act(t: float, q: Any, v: Any, factor: float = factor, given: Any = given) -> Any:
            given.append(v)
            return q, factor * v

        event = srm.Event(clock(at), action=act)
        run = srm.simulate(mechanism, t_end, events=event, rtol=rtol, backend=backend)
        assert run.success, run.message
        angle, rate = reduced.integrate(field, start, at)
        exact = reduced.integrate(field, [angle, factor * rate], t_end - at)
        assert abs(run.q[-1, 0] - exact[0]) < 0.01 * rtol
        assert abs(run.v[-1, 0] - exact[1]) < 0.01 * rtol
        assert np.abs(given[0] - given[0][0] * along).max() < 1e-8


@on_both
def test_an_action_that_leads_off_every_branch_is_refused_with_the_branches(backend: str) -> None:
    mechanism = load("slider_crank")
    passage = srm.simulate(mechanism, 1.5, rtol=1e-10).crossings[0].time
    event = srm.Event(clock(passage), action=lambda t, q, v: (q, [v[0], -1.5 * v[0]]))
    run = srm.simulate(mechanism, 1.5, events=event, backend=backend)
    assert run.status == "failed"
    assert run.t[-1] == pytest.approx(passage, abs=1e-9)
    assert "its velocity is not tangent to any branch: 2 branches cross there" in run.message
