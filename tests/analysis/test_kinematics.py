"""All closed configurations of a branch, against the formulas of triangles and gears."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.analysis.test_linkage import angle_of, four_bar
from tests.support.bundled import load
from tests.support.commands import run
from tests.support.mechanisms import add_link, rod
from tests.support.snapshots import refused

A, B, C, D = 1.0, 2.0, 1.5, 2.2
"""Crank, coupler, output and ground of a crank-rocker."""


def assert_closed(motion: srm.CrankMotion) -> None:
    for q in motion.q[::45]:
        closed = srm.assemble(motion.mechanism, q, hold=list(motion.mechanism.joint_names))
        np.testing.assert_allclose(closed.q, q, atol=1e-9)


def test_a_crank_rocker_turns_from_zero_with_the_angles_of_its_triangles() -> None:
    motion = srm.kinematics(four_bar(A, B, C, D), "crank")
    assert (motion.turns, motion.closed, motion.marks) == (True, True, ())
    phi = motion.positions
    np.testing.assert_allclose(phi, np.radians(np.arange(361)), atol=1e-12)
    np.testing.assert_allclose(motion.q[:, 0], phi, atol=1e-12)
    # The diagonal from the tip of the crank to the pivot of the output.
    diagonal = np.sqrt(A * A + D * D - 2.0 * A * D * np.cos(phi))
    angle = np.arccos((B * B + C * C - diagonal**2) / (2.0 * B * C))
    np.testing.assert_allclose(
        motion.transmission_angle, np.minimum(angle, np.pi - angle), atol=1e-9
    )
    below = np.arctan2(A * np.sin(phi), D - A * np.cos(phi))
    psi = np.pi - below - np.arccos((C * C + diagonal**2 - B * B) / (2.0 * C * diagonal))
    np.testing.assert_allclose(motion.track("output"), psi, atol=1e-9)
    # Both ends of the coupler have the same velocity along it.
    theta = phi + motion.track("coupler")
    ratio = A * np.sin(phi - theta) / (C * np.sin(psi - theta))
    np.testing.assert_allclose(motion.rates[:, 2], ratio, atol=1e-8)
    # The page begins where the mechanism does.
    start = motion.mechanism.q0[0] % (2.0 * np.pi)
    assert motion.start == pytest.approx(4.0 * start / (2.0 * np.pi), abs=1e-9)


def test_the_rocker_as_a_crank_goes_over_both_dead_points_through_all_positions() -> None:
    linkage = four_bar(A, B, C, D)
    motion = srm.kinematics(linkage, "output")
    assert (motion.turns, motion.closed) == (False, True)
    # Crank and coupler are in line there.
    ends = [np.pi - angle_of(C, D, B + A), np.pi - angle_of(C, D, B - A)]
    assert sorted(motion.dead_points) == pytest.approx(sorted(ends), abs=1e-9)
    assert [motion.positions.min(), motion.positions.max()] == pytest.approx(sorted(ends), abs=1e-3)
    assert np.ptp(np.unwrap(motion.q[:, 0])) == pytest.approx(2.0 * np.pi, abs=1e-9)
    # In equal small steps, each a closed configuration that the turn of the crank has, too.
    assert np.abs(np.diff(motion.q, axis=0)).max() < 0.05
    turn = srm.kinematics(linkage, "crank")
    phi = motion.q[:, 0] % (2.0 * np.pi)
    for column, name in ((1, "coupler"), (2, "output")):
        expected = np.interp(phi, turn.positions, turn.track(name))
        off = np.angle(np.exp(1j * (motion.q[:, column] - expected)))
        assert np.abs(off).max() < 1e-3  # between the degrees of the turn
    # With the sign of the rate the crank goes on where the rocker turns back.
    changes = np.flatnonzero(np.diff(np.sign(motion.rates[:, 0])))
    assert len(changes) == 2


def test_equal_bars_go_straight_on_through_their_singular_configurations() -> None:
    motion = srm.kinematics(load("slider_crank_slider"), "crank")
    assert motion.turns
    assert motion.singular_positions == pytest.approx([0.5 * np.pi, 1.5 * np.pi], abs=1e-9)
    assert motion.dead_points == ()
    x = motion.track("slider")
    stroke = np.abs(x[0])
    assert stroke > 1.0
    # The other branch stays at zero.
    np.testing.assert_allclose(x, x[0] * np.cos(motion.positions), atol=1e-9 * stroke)


def test_a_gear_is_followed_until_both_wheels_have_come_back() -> None:
    """Wheels of 20 and 30 teeth: three turns of the small one are two of the large one."""
    model = pin.Model()
    for name in ("small", "large"):
        add_link(model, 0, pin.JointModelRZ(), name, rod(1.0, 0.3))
    gear = srm.LoopClosure("coupling", joints=("large", "small"), polynomial=(0.0, -20.0 / 30.0))
    wheels = srm.Mechanism(model, (gear,), np.array([0.5, -1.0 / 3.0]))
    motion = srm.kinematics(wheels, "small")
    assert (motion.turns, motion.closed) == (True, True)
    assert np.ptp(motion.positions) == pytest.approx(6.0 * np.pi, abs=1e-12)
    assert np.ptp(motion.track("large")) == pytest.approx(4.0 * np.pi, abs=1e-9)
    assert motion.t[-1] == 12.0
    np.testing.assert_allclose(motion.q[:, 1], -motion.q[:, 0] / 1.5, atol=1e-9)


def test_a_branch_without_an_end_is_left_far_away_on_both_sides() -> None:
    """A rack on a pinion does not come back to where it was."""
    model = pin.Model()
    add_link(model, 0, pin.JointModelRZ(), "pinion", rod(1.0, 0.3))
    add_link(model, 0, pin.JointModelPX(), "rack", rod(1.0, 0.3))
    mesh = srm.LoopClosure("coupling", joints=("rack", "pinion"), polynomial=(0.0, 0.1))
    motion = srm.kinematics(srm.Mechanism(model, (mesh,), np.zeros(2)), "pinion")
    assert (motion.turns, motion.closed, motion.marks) == (False, False, ())
    np.testing.assert_allclose(motion.q[:, 1], 0.1 * motion.q[:, 0], atol=1e-12)
    assert motion.positions[0] < -10.0
    assert motion.positions[-1] > 10.0
    assert motion(motion.start)[0] == pytest.approx([0.0, 0.0], abs=1e-3)


@pytest.mark.parametrize(
    ("name", "crank"), [("toggle_press", "ram"), ("klann_walker", "upper"), ("bricard", "hinge_3")]
)
def test_every_position_is_closed_and_next_to_the_one_before(name: str, crank: str) -> None:
    motion = srm.kinematics(load(name), crank)
    assert motion.closed
    assert_closed(motion)
    steps = [pin.difference(motion.mechanism.model, *pair) for pair in zip(motion.q, motion.q[1:])]
    assert np.abs(steps).max() < 0.05
    # At a dead point the crank is farther than next to it.
    for mark in motion.marks:
        here = motion.positions[np.abs(motion.t - mark.time).argmin()]
        assert here == pytest.approx(mark.position, abs=1e-3)


def test_the_motion_of_a_crank_is_shown_in_one_line() -> None:
    turning = srm.kinematics(load("slider_crank"), "crank")
    assert repr(turning) == (
        f"CrankMotion('slider_crank', crank='crank', turns fully, "
        f"{len(turning.singular_positions)} singular, {len(turning.q)} configurations)"
    )
    swinging = srm.kinematics(load("four_bar"), "rocker")
    assert "crank='rocker', 2 dead points, 0 singular" in repr(swinging)


def test_other_mechanisms_are_refused() -> None:
    assert "2 degrees of freedom" in refused(lambda: srm.kinematics(load("five_bar"), "crank_left"))
    assert "without loops" in refused(lambda: srm.kinematics(load("simple_pendulum"), "pendulum"))
    assert "no moving joint 'wheel'" in refused(lambda: srm.kinematics(load("four_bar"), "wheel"))
    singular = load("slider_crank").with_state(np.array([0.5 * np.pi, np.pi]), np.zeros(2))
    assert "branches meet" in refused(lambda: srm.kinematics(singular, "crank"))


def test_the_command_line_writes_the_page_and_says_what_it_passes(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    said = run("linkage", "four_bar", "--crank", "crank", "--kinematics", str(page))
    assert f"written: {page}" in said
    assert "crank turns fully" in said
    assert "transmission angle" in said
    assert page.stat().st_size < 2.5e6
    said = run("linkage", "slider_crank", "--crank", "crank", "--kinematics", str(page))
    assert "crank = 1.57079633 rad, loops pin" in said
    said = run("linkage", "four_bar", "--crank", "crank", "--trace", "coupler:1,0,0", status=2)
    assert "--trace: it is drawn in the page" in said


@pytest.mark.parametrize("analysis", [srm.kinematics, srm.linkage_report])
def test_a_joint_that_no_motion_moves_is_no_crank(analysis) -> None:
    """A body on the rocker of a four-bar whose hinge a second closure locks."""
    four_bar = load("four_bar")
    model = four_bar.model.copy()
    rocker = model.getJointId("rocker")
    add_link(model, rocker, pin.JointModelRY(), "stuck")
    lock = srm.LoopClosure("frame", srm.Anchor("stuck"), srm.Anchor("rocker"), name="lock")
    mechanism = srm.Mechanism(model, (*four_bar.loops, lock), q0=[*four_bar.q0, 0.0])
    with pytest.raises(srm.InputError, match="no motion of the mechanism moves the joint 'stuck'"):
        analysis(mechanism, "stuck")
