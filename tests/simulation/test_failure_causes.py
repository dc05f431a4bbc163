"""Messages of runs that fail lead with the cause: unstable sampled controllers, dead points."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.errors import FailedRunWarning
from srm_mbs.simulation.failure_causes import dead_point, inertialess_motion
from tests.support.backends import on_both
from tests.support.bundled import load

T = 0.01
"""Sample time (s)."""


def damper(gain: float) -> Callable[..., Any]:
    return lambda t, q, v: {"crank": -gain * v[0]}


@on_both
@pytest.mark.parametrize("gain", [1000.0, pytest.param(3000.0, marks=pytest.mark.stress)])
def test_an_unstable_sampled_controller_is_the_cause_that_a_run_names(
    backend: str, gain: float
) -> None:
    options: dict[str, Any] = {"sample_time": T, "backend": backend}
    with pytest.warns(FailedRunWarning):
        solution = srm.simulate(load("four_bar"), 2.0, controller=damper(gain), **options)
    assert re.match(
        r"Stopped at t = 0\.0\d s: the sampled forces are unstable: the torque of the joint "
        r"'crank' grew and changed its sign at each of the last \d samples, to \S+ N m, and the "
        r"largest rate is that of '\w+', \S+ rad/s\. Shorten the sample time",
        solution.message,
    )
    assert "locked" not in solution.message
    torques = [force[0] for force in solution.held.values]
    assert all(a * b < 0.0 and abs(b) > abs(a) for a, b in pairwise(torques))
    named = float(re.search(r"samples, to (\S+) N m", solution.message).group(1))  # type: ignore[union-attr]
    assert named == pytest.approx(-gain * solution.v[-1, 0], rel=1e-2)
    rate = float(re.search(r", (\S+) rad/s", solution.message).group(1))  # type: ignore[union-attr]
    assert abs(rate) == pytest.approx(np.abs(solution.v[-1]).max(), rel=1e-2)


@on_both
def test_a_noisy_controller_is_the_cause_that_a_run_names(backend: str) -> None:
    noise = np.random.default_rng(0)

    def noisy(t: float, q: Any, v: Any) -> Any:
        return [0.0, 1e6 * noise.normal(), 0.0]

    options: dict[str, Any] = {"backend": backend, "controller": noisy}
    with pytest.warns(FailedRunWarning):
        solution = srm.simulate(load("four_bar"), 1e6, max_step=1e-3, **options)
    assert re.search(
        r"the controller is not a function of t, q and v: called twice there, it returned \S+ and "
        r"\S+ for the joint 'coupler'\. .* Give sample_time",
        solution.message,
    )
    held = srm.simulate(load("four_bar"), 0.1, sample_time=T, **options)
    assert held.success


@on_both
def test_an_interrupted_run_says_how_many_steps_remain_and_what_shortens_them(
    backend: str,
) -> None:
    def interrupt(t: float, h: float, state: Any) -> None:
        if t > 0.0:
            raise KeyboardInterrupt

    def remaining(t_end: float, **options: Any) -> tuple[float, str]:
        solution = srm.simulate(load("four_bar"), t_end, progress=interrupt, **options)
        assert solution.status == "interrupted"
        said = re.search(r"step was (\S+) s long; (\S+) such steps remain\.(.*)", solution.message)
        assert said is not None
        length = solution.steps.times[-1] - solution.steps.times[-2]
        assert float(said[1]) == pytest.approx(length, rel=0.06)
        return float(said[2]) * length / (t_end - solution.t[-1]), said[3]

    few, said = remaining(1.0, backend=backend)
    assert few == pytest.approx(1.0, rel=0.06)
    assert not said
    for options, remedy in (
        ({"controller": lambda t, q, v: [0.0, 0.0, 0.0]}, "Give sample_time"),
        ({"step": 1e-3}, "Give a longer step"),
        ({}, "A larger rtol"),
    ):
        many, said = remaining(1e6, backend=backend, **options)
        assert many == pytest.approx(1.0, rel=0.06)
        assert remedy in said
    assert 'method="psrm"' in remaining(1e6, method="srm")[1]


@on_both
def test_a_simulator_names_forces_that_grow_with_every_step(backend: str) -> None:
    simulator = srm.Simulator(load("four_bar"), backend=backend)
    law = damper(1000.0)

    def control() -> None:
        for _ in range(200):
            simulator.step(T, law(simulator.t, simulator.q, simulator.v))

    with pytest.raises(srm.SimulationError, match="the torque of the joint 'crank' grew") as caught:
        control()
    t = simulator.t
    assert str(caught.value).startswith(f"Stopped at t = {t:.6g} s: the sampled forces are unst")
    # The next attempt is that of the caller, with other forces.
    simulator.step(1e-6)
    simulator.reset()
    simulator.step(T, [-1.0, 0.0, 0.0])


@on_both
@pytest.mark.parametrize("gain", [3.0, 30.0])
def test_stable_controllers_and_relays_run_to_the_end(backend: str, gain: float) -> None:
    """A relay reverses at every sample as well, but does not grow."""
    relay: Any = lambda t, q, v: {"crank": gain * (-1.0) ** round(t / T)}  # noqa: E731
    for controller in (damper(gain), relay):
        solution = srm.simulate(
            load("four_bar"), 1.0, controller=controller, sample_time=T, backend=backend
        )
        assert solution.success


def rocker_linkage(speed: float) -> srm.Mechanism:
    """A linkage whose driven bar cannot turn round."""
    return srm.planar(
        points={"O": (0, 0), "A": (80, 0), "B": (120, 80), "C": (150, 0)},
        bars={"crank": ("O", "A"), "coupler": ("A", "B"), "rocker": ("B", "C")},
        ground=("O", "C"),
        unit="mm",
        mass_per_length=1.0,
        drives={"O": speed},
    )


def largest_angle() -> float:
    """Angle (rad) of the driven bar with coupler and rocker in line, by the law of cosines."""
    a, b, c, ground = 80.0, math.hypot(40, 80), math.hypot(30, 80), 150.0
    return math.acos((a**2 + ground**2 - (b + c) ** 2) / (2.0 * a * ground))


@on_both
@pytest.mark.parametrize("speed", [3.0, -3.0])
@pytest.mark.parametrize("step", [None, 0.01])
def test_a_drive_at_its_dead_point_is_named_first_with_its_limit(
    backend: str, speed: float, step: float | None
) -> None:
    with pytest.warns(FailedRunWarning):
        solution = srm.simulate(rocker_linkage(speed), 3.0, backend=backend, step=step)
    found = re.match(
        r"Stopped at t = \S+ s: the drive 'O' is at its dead point: the joint 'O' is at (\S+) rad, "
        r"and the closures let it go to (\S+) rad at (most|least)\. With step",
        solution.message,
    )
    assert found is not None, solution.message
    assert float(found[1]) == pytest.approx(solution.joint("O")[0][-1], rel=1e-5)
    assert float(found[2]) == pytest.approx(math.copysign(largest_angle(), speed), rel=1e-5)
    assert found[3] == ("most" if speed > 0.0 else "least")
    assert "Let the drive turn back before" in solution.message
    assert "may lead where" not in solution.message


@on_both
def test_a_simulator_names_the_drive_at_its_dead_point(backend: str) -> None:
    simulator = srm.Simulator(rocker_linkage(3.0), backend=backend)

    def go_on() -> None:
        for _ in range(300):
            simulator.step(0.01)

    with pytest.raises(srm.SimulationError, match=r"^Stopped at .*: the drive 'O' is at its dead"):
        go_on()
    assert simulator.t == pytest.approx(largest_angle() / 3.0, rel=1e-5)


def test_of_two_drives_that_at_its_dead_point_is_named() -> None:
    """The five-bar is left with one degree of freedom for each of its cranks."""
    five_bar = load("five_bar")
    drives = (
        srm.Drive(srm.ConstantSpeed(0.0), "crank_left"),
        srm.Drive(srm.ConstantSpeed(1.0), "crank_right"),
    )
    start = srm.assemble(replace(five_bar, drives=drives), v=None)
    mechanism = replace(five_bar, drives=drives, q0=start.q, v0=start.v)
    solution = srm.simulate(mechanism, 10.0)
    assert not solution.success
    assert "the drive 'crank_right' is at its dead point" in solution.message


def chain() -> tuple[srm.Mechanism, float]:
    """A five-bar that stretches where its driven bar goes furthest, and the angle (rad) there, by
    the law of cosines; its other bars move freely."""
    A, B, C, D, E = points = np.array([(0, 0), (-0.5, 0.6), (0.2, 0.3), (0.9, 0.4), (1.4, 0)])
    bars = {"left": "AB", "left_coupler": "BC", "right_coupler": "CD", "right": "DE"}
    linkage = srm.planar(
        points=dict(zip("ABCDE", map(tuple, points))),
        bars={name: tuple(ends) for name, ends in bars.items()},
        ground=("A", "E"),
        mass_per_length=1.0,
    )
    driven, ground = np.linalg.norm(B - A), np.linalg.norm(E - A)
    reach = sum(np.linalg.norm(b - a) for a, b in ((B, C), (C, D), (D, E)))
    return linkage, math.acos((driven**2 + ground**2 - reach**2) / (2.0 * driven * ground))


@on_both
@pytest.mark.parametrize(("idle", "speed"), [(True, 1.0), (True, -1.0), (False, 1.0)])
def test_a_dead_point_of_a_mechanism_with_further_freedom_is_named(
    backend: str, idle: bool, speed: float
) -> None:
    """The slider-crank's rod spins, which moves nothing else; the five-bar is pulled straight."""
    if idle:
        mechanism, joint, limit = load("spatial_dead_point"), "rod", math.asin(2.0 / 2.5)
    else:
        mechanism, limit = chain()
        joint = "A"
    assert mechanism.degrees_of_freedom == 2
    driven = replace(mechanism, drives=(srm.Drive(srm.ConstantSpeed(speed), joint),))
    start = srm.assemble(driven, v=None)
    driven = replace(driven, q0=start.q, v0=start.v)
    assert dead_point(driven, 0.0, start.q) is None
    with pytest.warns(FailedRunWarning):
        solution = srm.simulate(driven, 6.0, backend=backend)
    extreme, most = math.copysign(limit, speed), "most" if speed > 0.0 else "least"
    assert (
        f"the drive '{joint}' is at its dead point: the joint '{joint}' is at {extreme:.6g} rad, "
        f"and the closures let it go to {extreme:.6g} rad at {most}. "
    ) in solution.message


def test_no_drive_is_at_a_dead_point_on_its_way_there_or_back() -> None:
    mechanism = rocker_linkage(3.0)
    end = largest_angle() / 3.0
    way = srm.simulate(mechanism, 0.99999 * end)
    for t in (0.0, 0.5 * end, 0.95 * end):
        assert dead_point(mechanism, t, way(t)[0]) is None
    t = 0.99999 * end
    q, _ = way(t)
    assert dead_point(mechanism, t, q) is not None
    assert dead_point(rocker_linkage(-3.0), t, q) is None


@on_both
def test_joints_that_move_no_inertia_are_the_cause_that_a_run_names(backend: str) -> None:
    """Three hinges of massless links carry a body; friction leads it to where two axes coincide."""
    model = pin.Model()
    joints = {"yaw": pin.JointModelRZ(), "pitch": pin.JointModelRY(), "roll": pin.JointModelRZ()}
    for k, (name, joint) in enumerate(joints.items()):
        model.addJoint(k, joint, pin.SE3.Identity(), name)
    body = pin.Inertia(1.0, np.array([0.0, 0.0, -0.3]), np.diag([0.02, 0.03, 0.01]))
    model.appendBodyToJoint(3, body, pin.SE3.Identity())
    model.friction = np.full(3, 0.2)
    start: dict[str, Any] = {"q0": np.array([0.0, 0.3, 0.1]), "v0": np.array([3.0, -1.0, 0.0])}
    mechanism = srm.Mechanism(model=model, loops=(), **start)
    with pytest.warns(FailedRunWarning):
        run = srm.simulate(mechanism, 1.0, backend=backend)
    assert abs(run.q[-1, 1]) < 1e-5
    assert "a motion of the joints 'yaw', 'roll' moves no inertia there" in run.message
    assert inertialess_motion(mechanism, np.array([0.0, 0.01, 0.0])) is None
