"""Joints dragged through given values, against what triangles say."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rows import closure_errors
from tests.support.mechanisms import add_link


def gaps(path: srm.FollowedPath) -> float:
    mechanism = path.mechanism
    rest = np.zeros((len(path.path), mechanism.model.nv))
    return float(np.abs(closure_errors(mechanism.model, mechanism.loops, path.path, rest)[0]).max())


def test_a_crank_turned_once_returns_to_the_start() -> None:
    mechanism = srm.load("four_bar")
    start = mechanism.q0
    path = srm.follow(mechanism, {"crank": start[0] + np.linspace(0.0, 2.0 * np.pi, 13)})
    assert path.complete
    assert path.branch_kept
    assert path.limit is None
    assert path.singular == ()
    np.testing.assert_allclose(path.q[0], start, atol=1e-14)
    # the coupler turns back against the crank, the rocker rocks
    np.testing.assert_allclose(path.q[-1] - start, [2.0 * np.pi, -2.0 * np.pi, 0.0], atol=1e-13)
    np.testing.assert_allclose(path.q[:, 0], start[0] + np.linspace(0.0, 2.0 * np.pi, 13))
    assert gaps(path) < 1e-12
    for q in path.q:
        np.testing.assert_allclose(
            srm.assemble(mechanism, {"crank": q[0]}, guess={"coupler": q[1], "rocker": q[2]}).q,
            q,
            atol=1e-11,
        )


@pytest.mark.parametrize("to", [4.0, -4.0])
def test_a_rocker_stops_where_crank_and_coupler_are_in_line(to: float) -> None:
    """Crank 1, coupler 2, rocker 1.5, ground 2.2: the pin is 3 or 1 from the crank's pivot."""
    path = srm.follow(srm.load("four_bar"), {"rocker": [to]})
    assert not path.complete
    assert len(path.q) == 0
    reach = 3.0 if to < 0.0 else 1.0
    angle = np.pi - np.arccos((1.5**2 + 2.2**2 - reach**2) / (2.0 * 1.5 * 2.2))
    np.testing.assert_allclose(path.limit.values["rocker"], angle, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sin(path.limit.q[1])), 0.0, atol=1e-7)
    assert path.branch_kept
    assert f"no further than rocker = {angle:.6f}"[:30] in path.message
    assert "turns back" in path.message


def test_a_slider_crank_of_equal_bars_is_dragged_through_its_singular_configurations() -> None:
    """On its branch the rod turns twice as fast as the crank; on the other it stays folded."""
    mechanism = srm.load("slider_crank")
    # the quarter turns are singular, one of them is a value itself, and the way goes back and forth
    values = np.array([5.5, np.pi, 1.0, 0.5 * np.pi, 2.0, 0.0, -7.0, 5.5])
    path = srm.follow(mechanism, {"crank": values})
    assert path.complete
    assert path.branch_kept
    np.testing.assert_allclose(path.q, np.column_stack([values, -2.0 * values]), atol=1e-12)
    np.testing.assert_allclose(path.path[:, 1], -2.0 * path.path[:, 0], atol=1e-9)
    met = [point.values["crank"] / np.pi for point in path.singular]
    np.testing.assert_allclose(
        met, [1.5, 0.5, 0.5, 0.5, -0.5, -1.5, -1.5, -0.5, 0.5, 1.5], atol=1e-7
    )
    assert {point.loops for point in path.singular} == {("pin",)}


def test_two_cranks_are_dragged_together_and_stop_together() -> None:
    mechanism = srm.load("five_bar")
    start = mechanism.q0[[0, 2]]
    both = {"crank_left": start[0] + 0.3, "crank_right": start[1] - 0.2}
    path = srm.follow(mechanism, both)
    assert path.complete
    np.testing.assert_allclose(path.q[0][[0, 2]], list(both.values()), atol=1e-14)
    stopped = srm.follow(mechanism, {"crank_left": 5.0, "crank_right": start[1]})
    assert stopped.limit.values["crank_right"] == pytest.approx(start[1], abs=1e-12)
    # the two couplers are in line there: their directions, sums of the angles of each side
    left, right = stopped.limit.q[:2].sum(), stopped.limit.q[2:].sum()
    np.testing.assert_allclose(np.sin(left - right), 0.0, atol=1e-6)


def test_what_is_not_dragged_moves_as_little_as_possible() -> None:
    mechanism = srm.load("five_bar")
    path = srm.follow(mechanism, {"crank_left": mechanism.q0[0] + 1e-3})
    basis = srm.assemble(mechanism, mechanism.q0).free_directions
    shortest = basis @ basis[0] / (basis[0] @ basis[0]) * 1e-3
    np.testing.assert_allclose(path.q[0] - mechanism.q0, shortest, atol=1e-6)


def test_a_path_can_be_played() -> None:
    path = srm.follow(srm.load("four_bar"), {"crank": [2.0, 1.0]})
    motion = path.motion(2.0)
    np.testing.assert_array_equal(motion(0.0)[0], path.path[0])
    np.testing.assert_allclose(motion(2.0)[0], path.q[-1])


def test_a_path_and_its_motion_are_shown_in_one_line_each() -> None:
    mechanism = srm.load("four_bar")
    path = srm.follow(mechanism, {"crank": mechanism.q0[0] + np.linspace(0.0, 0.5, 40)})
    assert repr(path) == (
        f"FollowedPath('four_bar', 40 values reached, {len(path.path)} configurations, "
        "0 singular, 'all values were reached')"
    )
    assert repr(path.motion(2.0)) == (
        f"JointMotion('four_bar', t=0..2 s, {len(path.path)} configurations)"
    )


def test_a_path_that_leads_to_infinity_ends() -> None:
    """A slide on a wall, which a straight guide on a hinge pushes: its place is cot(angle), and as
    the angle falls to zero the path leads to infinity."""
    model = pin.Model()
    body = pin.Inertia.FromSphere(1.0, 0.1)
    for name, joint in (("guide", pin.JointModelRY()), ("slide", pin.JointModelPX())):
        place = pin.SE3(np.eye(3), np.array([0.0, 0.0, 1.0 if name == "guide" else 0.0]))
        add_link(model, 0, joint, name, body, place)
    line = srm.LoopClosure(
        "point_on_line", srm.Anchor("slide"), srm.Anchor("guide"), axis=(1.0, 0.0, 0.0), name="line"
    )
    mechanism = srm.Mechanism(model, (line,), q0=[0.25 * np.pi, 1.0])
    path = srm.follow(mechanism, {"guide": [0.0]})
    assert not path.complete
    assert "cannot be followed beyond" in path.message
    assert len(path.q) == 0
    assert path.limit.values["guide"] < 0.02
    np.testing.assert_allclose(path.path[:, 1] * np.tan(path.path[:, 0]), 1.0, atol=1e-9)
