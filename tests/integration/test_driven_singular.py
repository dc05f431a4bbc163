"""Drives through singular configurations: what is listed, starts there, ends there.

Two mechanisms: equal bars with a slider, whose drive has dead points of its own, and equal bars on
a lift, where the drive moves the lift and the crank is free.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support.backends import on_both, slowly_on_both
from tests.support.bundled import load
from tests.support.mechanisms import along_x, ball_dead_point, rod

OMEGA = 3.0
TOP = 0.5 * np.pi


def slid(angle: float, law: str = "slider") -> srm.Mechanism:
    """Bars of 2 m whose slider, or crank, is driven so that the crank turns at OMEGA."""
    if law == "slider":
        sine = srm.Sine(4.0, omega=OMEGA, phase=angle + 0.5 * np.pi)
        drive = srm.Drive(sine, "slider")
    else:
        drive = srm.Drive(srm.ConstantSpeed(OMEGA), "crank")
    q = np.array([angle, -2.0 * angle, 4.0 * np.cos(angle)])
    v = OMEGA * np.array([1.0, -2.0, -4.0 * np.sin(angle)])
    return replace(load("slider_crank_slider"), drives=(drive,), q0=q, v0=v)


def towards_the_dead_point(short: float, omega: float = 2.0, swing: float = 0.5) -> srm.Mechanism:
    """The slider goes by twice its ``swing`` (m) to ``short`` (m) of 4 m, where the bars are in
    line, and back."""
    start = 4.0 - short - 2.0 * swing
    law = srm.Sine(swing, omega=omega, phase=-0.5 * np.pi, offset=start + swing)
    drive = srm.Drive(law, "slider", absolute=True)
    mechanism = replace(load("slider_crank_slider"), drives=(drive,))
    angle = np.arccos(0.25 * start)
    state = srm.assemble(mechanism, [-angle, 2.0 * angle, start])
    return mechanism.with_state(state.q, state.v)


def lifted(law: srm.Law, angle: float, rate: float) -> srm.Mechanism:
    """Two bars of 2 m and 1 kg; crank's pivot and the line of the rod's tip are on a lift."""
    model = pin.Model()
    model.name = "lifted_slider_crank"
    lift = model.addJoint(0, pin.JointModelPZ(), pin.SE3.Identity(), "lift")
    model.appendBodyToJoint(lift, pin.Inertia.Random(), pin.SE3.Identity())
    crank = model.addJoint(lift, pin.JointModelRY(), pin.SE3.Identity(), "crank")
    tip = model.addJoint(crank, pin.JointModelRY(), along_x(2.0), "rod")
    for joint, name in ((lift, "lift"), (crank, "crank"), (tip, "rod")):
        model.addBodyFrame(name, joint, pin.SE3.Identity(), 0)
        if joint != lift:
            model.appendBodyToJoint(joint, rod(1.0, 2.0), pin.SE3.Identity())
    loop = srm.LoopClosure(
        "point_on_plane",
        srm.Anchor("rod", xyz=(2.0, 0.0, 0.0)),
        srm.Anchor("lift"),
        (0.0, 0.0, 1.0),
        name="pin",
    )
    q, v = np.array([0.3, -angle, 2.0 * angle]), np.array([0.0, -rate, 2.0 * rate])
    mechanism = srm.Mechanism(model, (loop,), q0=q, v0=v)
    mechanism = replace(mechanism, drives=(srm.Drive(law, "lift"),))
    v[0] = mechanism.drive_curves["lift"](0.0)[1]
    return mechanism.with_state(q, v)


def free_crank(law: srm.Law, angle: float, rate: float, t_end: float) -> Any:
    """Angle and rate of the crank on the lift: gravity is felt as g + s''.

    The kinetic energy is (2/3 + 2 sin^2) m l^2 rate^2 / 2, the potential one m (g + s'') l sin.
    """

    def field(t: float, y: Any) -> list[float]:
        sine, cosine = np.sin(y[0]), np.cos(y[0])
        inertia = 4.0 * (2.0 / 3.0 + 2.0 * sine**2)
        weight = 2.0 * (9.81 + law.curve(0.3)(t)[2])
        return [y[1], -(8.0 * sine * cosine * y[1] ** 2 + weight * cosine) / inertia]

    done = solve_ivp(
        field, (0.0, t_end), [angle, rate], method="DOP853", rtol=3e-14, atol=1e-14, max_step=0.05
    )
    return done.y[:, -1]


LAWS: dict[str, Callable[[], srm.Law]] = {
    "sine": lambda: srm.Sine(0.5, omega=4.0, phase=0.3),
    "polynomial": lambda: srm.Polynomial([0.0, 1.0, -0.6, 0.4, -0.05]),
    "standstill": lambda: srm.ConstantSpeed(0.0),
    # Its third derivative jumps at the knots, the first of which is the start.
    "table": lambda: srm.Table(np.linspace(0.0, 4.0, 9), 0.3 * np.sin(np.linspace(0.0, 7.0, 9))),
}


def crank_error(solution: srm.Solution, exact: Any) -> float:
    """Largest error of the angle and the rate of the crank on the lift at the end."""
    assert solution.success, solution.message
    return float(np.abs([-solution.q[-1, 1] - exact[0], -solution.v[-1, 1] - exact[1]]).max())


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "angle",
    [
        TOP,
        TOP + 1e-9,
        *(pytest.param(TOP + x, marks=pytest.mark.stress) for x in (-1e-6, 1e-4)),
        TOP - 5e-3,
        -TOP,
    ],
)
def test_a_driven_mechanism_starts_on_and_next_to_a_singular_configuration(
    law: str, angle: float
) -> None:
    chosen = LAWS[law]()
    mechanism = lifted(chosen, angle, 2.0)
    exact = free_crank(chosen, angle, 2.0, 1.7)
    for rtol in (1e-6, 1e-9):
        solution = srm.simulate(mechanism, 1.7, rtol=rtol, atol=rtol)
        assert crank_error(solution, exact) < 100.0 * rtol
        assert solution.drift.max() < 1e-9


SUDDEN_LAWS: dict[str, Callable[[], srm.Law]] = {
    "vibration": lambda: srm.Sine(3e-3, omega=100.0, phase=0.3),
    "knots": lambda: srm.Table(
        [0.0, 0.01, 0.02, 0.03, 0.05, 0.1, 2.0], [0.0, 0.0, 3e-3, 3e-3, 0.0, 2e-3, 0.1]
    ),
}
"""Of these a motion feels much while it turns by a fraction of a radian."""


@on_both
@pytest.mark.parametrize("law", SUDDEN_LAWS)
def test_forces_that_change_while_a_motion_leaves_a_singular_start_are_resolved(
    law: str, backend: str
) -> None:
    chosen = SUDDEN_LAWS[law]()
    mechanism = lifted(chosen, TOP, 2.0)
    exact = free_crank(chosen, TOP, 2.0, 0.3)
    for rtol in (1e-6, 1e-9):
        solution = srm.simulate(mechanism, 0.3, rtol=rtol, backend=backend)
        assert crank_error(solution, exact) < 100.0 * rtol
        assert solution.drift.max() < 1e-9
        simulator = srm.Simulator(mechanism, rtol=rtol, backend=backend)
        q, v = simulator.step(0.3)
        assert np.abs([-q[1] - exact[0], -v[1] - exact[1]]).max() < 100.0 * rtol


@pytest.mark.parametrize("beside", [0.0, 1e-9, -1e-6, 1e-5, -1e-4, 1e-3])
@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
def test_a_driven_run_may_end_on_and_next_to_a_singular_configuration(
    rtol: float, beside: float
) -> None:
    law = LAWS["sine"]()
    fine = srm.simulate(lifted(law, 1.0, 2.0), 2.0, rtol=1e-11)
    t_end = fine.crossings[0].time + beside
    exact = free_crank(law, 1.0, 2.0, t_end)
    solution = srm.simulate(lifted(law, 1.0, 2.0), t_end, rtol=rtol, atol=rtol)
    assert crank_error(solution, exact) < 20.0 * rtol


@pytest.mark.parametrize("beside", [0.0, 1e-9, -1e-5, 1e-4])
def test_a_driven_run_goes_on_from_a_breakpoint_next_to_a_singular_configuration(
    beside: float,
) -> None:
    law = LAWS["sine"]()
    mechanism = lifted(law, 1.0, 2.0)
    t = srm.simulate(mechanism, 2.0, rtol=1e-11).crossings[0].time + beside
    exact = free_crank(law, 1.0, 2.0, 2.0)
    for rtol in (1e-6, 1e-9):
        solution = srm.simulate(mechanism, 2.0, rtol=rtol, atol=rtol, breakpoints=[t])
        assert crank_error(solution, exact) < 100.0 * rtol
        assert t in solution.steps.times
        assert not any(crossing.switched for crossing in solution.crossings)


@on_both
@pytest.mark.parametrize("angle", [0.0, 1e-9, -1e-5, 1e-3, TOP, TOP - 1e-6, np.pi])
def test_the_dead_point_of_a_drive_is_a_start_and_a_passage_like_any_other(
    angle: float, backend: str
) -> None:
    """In line with the slider's way the bars cannot be driven, but carry their momentum on."""
    t = np.linspace(0.0, 3.0, 31)
    solution = srm.simulate(slid(angle), 3.0, rtol=1e-8, t_eval=t, backend=backend)
    assert solution.success, solution.message
    crank, rate = solution.joint("crank")
    np.testing.assert_allclose(crank, angle + OMEGA * t, atol=1e-12)
    np.testing.assert_allclose(rate, OMEGA, atol=1e-9)


def test_passages_that_only_a_drive_makes_singular_are_listed_with_it() -> None:
    solution = srm.simulate(slid(0.5), 5.0, rtol=1e-8)
    times = (np.arange(1, 10) * 0.5 * np.pi - 0.5) / OMEGA
    found = solution.crossings
    assert [crossing.time for crossing in found] == pytest.approx(times, abs=1e-7)
    for k, crossing in enumerate(found, 1):
        dead_point = k % 2 == 0
        assert crossing.loops == ("pin",)
        assert crossing.drives == (("slider",) if dead_point else ())
        assert crossing.rows == (("pin.x",) if dead_point else ("pin.z",))
        assert crossing.configuration is not None
        assert crossing.configuration[0] == pytest.approx(k * 0.5 * np.pi, abs=1e-9)
        # At a dead point the bars may turn back; resting in the other branch's bars in line with
        # the pivot is no motion, because the slider goes on.
        along = np.array([1.0, -2.0, 0.0 if dead_point else -4.0 * np.sin(k * 0.5 * np.pi)])
        length = np.linalg.norm(along / solution.mechanism.structure.units.coordinate)
        along = along / solution.mechanism.structure.units.coordinate / length
        wanted = [along, -along] if dead_point else [along]
        np.testing.assert_allclose(crossing.branches, wanted, atol=1e-6)
        assert crossing.arrived_on == crossing.left_on == 0
        assert not crossing.switched
    # What the closures leave free changes at theirs alone.
    changes = srm.mobility_map(solution).changes
    assert [change.time for change in changes] == pytest.approx(times[::2], abs=1e-7)
    assert {change.degrees_of_freedom for change in changes} == {2}


def test_without_speed_or_off_the_branches_a_driven_start_is_refused() -> None:
    still = slid(0.0)
    with pytest.raises(srm.InputError, match=r"loops 'pin'; drives 'slider'\) and its velocity is"):
        srm.simulate(replace(still, v0=0.5 * np.array(still.v0)), 1.0)
    rest = replace(
        slid(TOP, "crank"), drives=(srm.Drive(srm.MinimumJerk(2.0, 1.0), "crank"),), v0=np.zeros(3)
    )
    with pytest.raises(srm.InputError, match=r"singular configuration of the closures.*at rest"):
        srm.simulate(rest, 1.0)


@pytest.mark.parametrize("name", ["n_four_bar_2", "parallelogram", "spatial_dead_point", "ball"])
def test_a_run_from_a_singular_passage_goes_on_like_the_one_that_came_through(name: str) -> None:
    """Nullity two, redundant rows, far from any symmetry, nq != nv."""
    mechanism = ball_dead_point() if name == "ball" else load(name)
    crank = mechanism.joint_names[0]
    speed = float(mechanism.v0[0]) or 1.0
    mechanism = replace(mechanism, drives=(srm.Drive(srm.ConstantSpeed(speed), crank),))
    state = srm.assemble(mechanism, mechanism.q0, mechanism.v0)
    mechanism = mechanism.with_state(state.q, state.v)
    through = srm.simulate(mechanism, 4.0, rtol=1e-11)
    first = through.crossings[0]
    assert not first.switched
    assert first.configuration is not None
    start = mechanism.with_state(first.configuration, through(first.time)[1])
    t = np.linspace(0.0, min(4.0 - first.time, 1.5), 11)
    solution = srm.simulate(start, t[-1], rtol=1e-9, t_eval=t)
    assert solution.success, solution.message
    for q, v, now in zip(solution.q, solution.v, t + first.time):
        expected = through(now)
        moved = pin.difference(mechanism.model, q, expected[0])
        assert np.abs(moved).max() < 1e-7
        assert np.abs(v - expected[1]).max() < 1e-6
    assert solution.energy_balance.relative < 1e-8


@pytest.mark.parametrize("short", [1e-3, 1e-6, 1e-8])
def test_a_drive_that_stops_short_of_its_dead_point_turns_the_bars_back(short: float) -> None:
    solution = srm.simulate(towards_the_dead_point(short), 2.0, rtol=1e-9)
    assert solution.success, solution.message
    assert {crossing.kind for crossing in solution.crossings} <= {"avoided"}
    crank, _ = solution.joint("crank")
    assert crank.max() == pytest.approx(-np.sqrt(0.5 * short), rel=1e-2)
    slider = 3.5 - short - 0.5 * np.cos(4.0)
    assert crank[-1] == pytest.approx(-np.arccos(0.25 * slider), abs=1e-7)


@on_both
@pytest.mark.parametrize(("swing", "omega"), [(0.1, 0.3), (0.1, 10.0), (0.5, 2.0), (1.0, 0.3)])
@pytest.mark.parametrize("short", [0.05, 0.015, 0.003, 1e-4, 1e-6])
def test_a_drive_that_turns_back_avoids_its_dead_point_alike_at_every_tolerance(
    short: float, swing: float, omega: float, backend: str
) -> None:
    """The passage is listed where sigma falls below 0.4: whether or not steps resolve the turn, at
    half a period."""
    seen = set()
    for rtol in (1e-5, 1e-6, 1e-8):
        mechanism = towards_the_dead_point(short, omega, swing)
        solution = srm.simulate(mechanism, 4.0 / omega, rtol=rtol, backend=backend)
        assert solution.success, solution.message
        listed = [crossing.kind for crossing in solution.crossings]
        assert listed == (["avoided"] if short < 0.05 else [])
        for crossing in solution.crossings:
            assert crossing.time * omega == pytest.approx(np.pi, abs=2e-3)
            assert crossing.drives == ("slider",)
            seen.add(round(abs(crossing.residual), 12))
    assert len(seen) <= 1


def test_a_dead_point_within_the_tolerance_is_passed_and_its_drive_is_named() -> None:
    """Momentum carries the bars on: which way they go differs by less than the tolerance."""
    (crossing,) = srm.simulate(towards_the_dead_point(1e-10), 2.0, rtol=1e-6).crossings
    assert crossing.time == pytest.approx(0.5 * np.pi, abs=1e-6)
    assert crossing.singular is None
    assert (crossing.loops, crossing.drives) == (("pin",), ("slider",))


def test_a_drive_that_leads_beyond_its_dead_point_ends_the_run_there() -> None:
    solution = srm.simulate(towards_the_dead_point(-1e-6), 2.0, rtol=1e-6)
    assert not solution.success
    assert "the drive 'slider' is at its dead point" in solution.message
    assert solution.t[-1] == pytest.approx(0.5 * np.pi, abs=2e-3)


@slowly_on_both
@pytest.mark.parametrize("rtol", [1e-4, 1e-9])
@pytest.mark.parametrize("short", [-1e-4, -0.01, -0.1])
def test_a_run_that_stops_at_a_dead_point_says_when_and_which_drive_and_nothing_of_stiffness(
    short: float, rtol: float, backend: str
) -> None:
    """The slider, at 3.5 m - short - 0.5 m cos(2 t), is at 4 m there."""
    mechanism = towards_the_dead_point(short)
    solution = srm.simulate(mechanism, 2.0, rtol=rtol, backend=backend)
    assert not solution.success
    exact = 0.5 * np.arccos(-1.0 - 2.0 * short)
    assert solution.t[-1] == pytest.approx(exact, abs=1e-5)
    assert f"Stopped at t = {solution.t[-1]:.6g} s: the drive 'slider' is" in solution.message
    assert "the joint 'slider' is at 4 m, and the closures let it go to 4 m" in solution.message
    assert "stiff" not in solution.message.lower()
    assert solution.settings.stiff == ()


@on_both
def test_a_drive_that_comes_to_rest_on_a_change_point_is_told_without_words_about_a_start(
    backend: str,
) -> None:
    bars = load("parallelogram")
    drive = srm.Drive(srm.MinimumJerk(target=0.0, duration=1.0), joint="crank")
    driven = replace(bars, drives=(drive,))
    start = srm.assemble(driven, bars.q0)
    with pytest.warns(srm.FailedRunWarning):
        run = srm.simulate(driven.with_state(start.q, start.v), 2.0, backend=backend)
    assert run.t[-1] == pytest.approx(1.0)
    assert run.message.startswith(
        "Stopped at t = 1 s: at the breakpoint the state is a singular configuration of the "
        "closures (loops 'pin') and its velocity does not choose one branch"
    )
    assert "let drives and forces change beside it" in run.message
    assert "srm.assemble" not in run.message
