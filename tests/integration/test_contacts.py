"""Contacts that touch where a run or a segment of it begins, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.backends import on_both

G = 9.81


def masses(count: int, joint: Any, gravity: float = 0.0) -> pin.Model:
    """Bodies of 1 kg on joints along one axis of the world."""
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -gravity])
    for k in range(count):
        index = model.addJoint(0, joint, pin.SE3.Identity(), f"ball{k}")
        body = pin.Inertia(1.0, np.zeros(3), 0.1 * np.eye(3))
        model.appendBodyToJoint(index, body, pin.SE3.Identity())
        model.addBodyFrame(f"ball{k}", index, pin.SE3.Identity(), 0)
    return model


def impacts(count: int, diameter: float, restitution: float = 1.0) -> list[srm.Event]:
    """Newton's law of restitution between neighbours of the same mass."""

    def between(k: int) -> srm.Event:
        def collide(t: float, q: Any, v: Any) -> Any:
            mean, half = 0.5 * (v[k] + v[k + 1]), 0.5 * restitution * (v[k + 1] - v[k])
            v[k], v[k + 1] = mean + half, mean - half
            return q, v

        return srm.Event(lambda t, q, v: q[k + 1] - q[k] - diameter, direction=-1, action=collide)

    return [between(k) for k in range(count - 1)]


def occurrences(solution: srm.Solution) -> list[int]:
    assert solution.t_events is not None
    return [len(times) for times in solution.t_events]


@on_both
@pytest.mark.parametrize("distance", [0.0, 0.77])
@pytest.mark.parametrize("diameter", [1.0, 0.1])
@pytest.mark.parametrize(("moving", "count"), [(1, 5), (2, 4), (2, 5), (3, 5)])
def test_as_many_balls_leave_a_cradle_as_arrive(
    moving: int, count: int, diameter: float, distance: float, backend: str
) -> None:
    """Elastic impacts of touching balls exchange velocities: each pair meets at the same instant
    as often as moving balls have to pass it."""
    speed, t_end = 1.3, 2.0
    q0 = diameter * np.arange(count, dtype=float)
    q0[:moving] -= distance
    v0 = np.where(np.arange(count) < moving, speed, 0.0)
    cradle = srm.Mechanism(masses(count, pin.JointModelPX()), q0=q0, v0=v0)
    run = srm.simulate(cradle, t_end, events=impacts(count, diameter), backend=backend)
    assert run.success, run.message
    assert run.v[-1] == pytest.approx(v0[::-1], abs=1e-13)
    hit = distance / speed
    # The row of balls in contact is as if the moving ones went on through the others.
    passed = np.sort(np.where(v0 > 0.0, q0 + distance, q0))
    after = passed + v0[::-1] * (t_end - hit)
    assert run.q[-1] == pytest.approx(after, abs=1e-12)
    pairs = np.arange(1, count)
    expected = [sum(k <= pair < k + count - moving for k in range(1, moving + 1)) for pair in pairs]
    assert occurrences(run) == expected
    assert run.t_events is not None
    assert np.concatenate(run.t_events) == pytest.approx(np.full(sum(expected), hit), abs=1e-12)
    assert len(run.segments) == (1 if distance == 0.0 else 2)


@on_both
def test_a_ball_that_starts_on_the_floor_with_downward_speed_bounces_at_once(backend: str) -> None:
    speed, e = 2.0, 0.8
    ball = srm.Mechanism(masses(1, pin.JointModelPZ(), G), v0=[-speed])
    floor = srm.Event(lambda t, q, v: q[0], direction=-1, action=lambda t, q, v: (q, -e * v))
    run = srm.simulate(ball, 0.7, events=floor, backend=backend)
    assert run.success, run.message
    assert run.t_events is not None
    assert run.v_events is not None
    first = 2.0 * e * speed / G
    second = first * (1.0 + e)
    assert run.t_events[0] == pytest.approx([0.0, first, second], abs=1e-13)
    assert run.v_events[0][:, 0] == pytest.approx([-speed, -e * speed, -(e**2) * speed], abs=1e-12)
    assert run.v[0, 0] == pytest.approx(e * speed, abs=1e-15)
    rest = 0.7 - second
    assert run.q[-1, 0] == pytest.approx(e**3 * speed * rest - 0.5 * G * rest**2, abs=1e-12)


@on_both
def test_a_ball_that_starts_on_the_floor_with_upward_speed_comes_back(backend: str) -> None:
    """It returns within the first of the equal parts in which a step is examined."""
    speed = 1e-3
    ball = srm.Mechanism(masses(1, pin.JointModelPZ(), G), v0=[speed])
    floor = srm.Event(lambda t, q, v: q[0], direction=-1, action=lambda t, q, v: (q, -v))
    run = srm.simulate(ball, 0.01, events=floor, backend=backend)
    assert run.t_events is not None
    exact = 2.0 * speed / G * np.arange(1, 50)
    assert len(run.t_events[0]) == 49
    assert run.t_events[0] == pytest.approx(exact, abs=1e-12)


@on_both
def test_inelastic_impacts_of_touching_balls_end_in_a_common_velocity(backend: str) -> None:
    balls = srm.Mechanism(masses(3, pin.JointModelPX()), q0=[0.0, 1.0, 2.0], v0=[3.0, 0.0, 0.0])
    run = srm.simulate(balls, 1.0, events=impacts(3, 1.0, 0.0), backend=backend)
    assert run.success, run.message
    assert run.v[-1] == pytest.approx(np.ones(3), abs=1e-8)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_a_ball_at_rest_on_the_floor_chatters_and_can_be_held(restitution: float) -> None:
    ball = srm.Mechanism(masses(1, pin.JointModelPZ(), G))

    def gap(t: float, q: Any, v: Any) -> float:
        return float(q[0])

    bounce = srm.Event(gap, direction=-1, action=lambda t, q, v: (q, -restitution * v))
    run = srm.simulate(ball, 1.0, events=bounce)
    assert run.status == "failed"
    assert "chatters" in run.message
    assert run.t[-1] == 0.0
    held = ball.with_loop(
        srm.LoopClosure(
            "point_on_plane", srm.Anchor("ball0"), srm.Anchor("world"), (0.0, 0.0, 1.0), "floor"
        )
    )
    hold = srm.Event(gap, direction=-1, action=lambda t, q, v: srm.Switch(held))
    still = srm.simulate(ball, 1.0, events=hold)
    assert still.success, still.message
    assert np.abs(still.q).max() < 1e-12
    assert occurrences(still) == [1]


@on_both
def test_a_ball_that_lands_without_restitution_chatters_instead_of_falling_on(backend: str) -> None:
    ball = srm.Mechanism(masses(1, pin.JointModelPZ(), G), q0=[0.4])
    floor = srm.Event(lambda t, q, v: q[0], direction=-1, action=lambda t, q, v: (q, 0.0 * v))
    run = srm.simulate(ball, 1.0, events=floor, backend=backend)
    assert run.status == "failed"
    assert "chatters" in run.message
    assert run.t[-1] == pytest.approx(np.sqrt(0.8 / G), abs=1e-12)


@on_both
@pytest.mark.parametrize("answers", [True, False])
def test_an_event_that_passes_its_zero_acts_once(answers: bool, backend: str) -> None:
    """A switch and not a stop: the motion goes on through the zero after the action."""
    ball = srm.Mechanism(masses(1, pin.JointModelPZ(), G), q0=[1.0])
    seen: list[float] = []

    def act(t: float, q: Any, v: Any) -> Any:
        seen.append(t)
        return (q, v - 1.0) if answers else None

    trigger = srm.Event(lambda t, q, v: q[0] - 0.5, direction=-1, action=act)
    run = srm.simulate(ball, 0.4, events=trigger, backend=backend)
    assert run.success, run.message
    hit = np.sqrt(1.0 / G)
    assert seen == pytest.approx([hit], abs=1e-12)
    rest = 0.4 - hit
    speed = G * hit + (1.0 if answers else 0.0)
    assert run.q[-1, 0] == pytest.approx(0.5 - speed * rest - 0.5 * G * rest**2, abs=1e-12)


@on_both
@pytest.mark.parametrize("speed", [0.0, 1.7])
def test_balls_that_touch_and_move_together_do_not_collide(speed: float, backend: str) -> None:
    q0 = 0.1 * np.arange(4)
    balls = srm.Mechanism(masses(4, pin.JointModelPX()), q0=q0, v0=np.full(4, speed))
    run = srm.simulate(balls, 50.0, events=impacts(4, 0.1), max_step=0.5, backend=backend)
    assert run.success, run.message
    assert occurrences(run) == [0, 0, 0]
    assert run.q[-1] == pytest.approx(q0 + 50.0 * speed, rel=1e-12)


@on_both
def test_a_contact_at_rest_acts_when_it_is_pressed(backend: str) -> None:
    """Two bodies touch; from t = 0.5 s on a force moves one of them against the other."""
    balls = srm.Mechanism(masses(2, pin.JointModelPX()), q0=[0.0, 0.3])

    def push(t: float, q: Any, v: Any) -> list[float]:
        return [2.0 if t > 0.5 else 0.0, 0.0]

    together = balls.with_loop(
        srm.LoopClosure("coupling", joints=("ball1", "ball0"), ratio=1.0, offset=0.3, name="pair")
    )
    hold = srm.Event(
        lambda t, q, v: q[1] - q[0] - 0.3, direction=-1, action=lambda t, q, v: srm.Switch(together)
    )
    run = srm.simulate(balls, 1.5, events=hold, controller=push, breakpoints=[0.5], backend=backend)
    assert run.success, run.message
    assert run.t_events is not None
    assert run.t_events[0] == pytest.approx([0.5], abs=1e-6)
    assert run.v[-1] == pytest.approx([1.0, 1.0], abs=1e-6)


def test_an_occurrence_that_ends_the_run_is_counted_among_simultaneous_ones() -> None:
    events = impacts(4, 1.0)
    events[1].terminal = 2
    q0 = np.array([-1.0, 0.0, 2.0, 3.0])
    balls = srm.Mechanism(masses(4, pin.JointModelPX()), q0=q0, v0=[1.0, 1.0, 0.0, 0.0])
    run = srm.simulate(balls, 3.0, events=events)
    assert run.status == "event"
    assert "occurrence 2" in run.message
    assert occurrences(run) == [1, 2, 1]
    assert run.t[-1] == pytest.approx(1.0, abs=1e-13)


def test_a_saved_run_has_the_occurrences_at_its_start(tmp_path: Any) -> None:
    balls = srm.Mechanism(masses(3, pin.JointModelPX()), q0=[0.0, 1.0, 2.0], v0=[1.0, 0.0, 0.0])
    run = srm.simulate(balls, 1.0, events=impacts(3, 1.0))
    run.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz")
    assert occurrences(loaded) == occurrences(run) == [1, 1]
    assert loaded.v[-1] == pytest.approx([0.0, 0.0, 1.0])
