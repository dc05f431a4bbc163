"""All assembly modes, against intersections of circles."""

from __future__ import annotations

from itertools import product

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import brentq

import srm_mbs as srm
from srm_mbs.assembly.position import beyond_limits
from srm_mbs.cli.tables import mode_rows
from srm_mbs.dynamics.scaling import periodic_coordinates
from tests.support.bundled import load
from tests.support.mechanisms import along_x, rod

Z = pin.JointModelRZ


def planar(chains: dict[str, tuple[tuple[float, float], list[float]]]) -> pin.Model:
    """Chains of hinges about z: name -> (base, lengths); links are ``name_0``, ``name_1``, ..."""
    model = pin.Model()
    for name, (base, lengths) in chains.items():
        parent, place = 0, pin.SE3(np.eye(3), np.array([*base, 0.0]))
        for k, length in enumerate(lengths):
            parent = model.addJoint(parent, Z(), place, f"{name}_{k}")
            model.appendBodyToJoint(parent, rod(1.0, length), pin.SE3.Identity())
            model.addBodyFrame(f"{name}_{k}", parent, pin.SE3.Identity(), 0)
            place = along_x(length)
    return model


def circles(p: np.ndarray, r: float, q: np.ndarray, s: float) -> list[np.ndarray]:
    """Where the circles about p and q with radii r and s intersect."""
    d = q - p
    distance = np.linalg.norm(d)
    along = (distance**2 + r**2 - s**2) / (2.0 * distance)
    if abs(along) > r:
        return []
    across = np.sqrt(r**2 - along**2) * np.array([-d[1], d[0]]) / distance
    middle = p + along * d / distance
    return [middle + across, middle - across]


def tips(mechanism: srm.Mechanism, mode: srm.Assembly, link: str, length: float) -> np.ndarray:
    data = mechanism.model.createData()
    pin.forwardKinematics(mechanism.model, data, mode.q)
    joint = mechanism.model.getJointId(link)
    return data.oMi[joint].act(np.array([length, 0.0, 0.0]))[:2]


def test_a_four_bar_has_the_two_modes_of_its_circles() -> None:
    mechanism = srm.load("four_bar")
    modes = srm.assembly_modes(mechanism, {"crank": 1.0}, starts=40)
    data = mechanism.model.createData()
    pins = []
    for mode in modes:
        pin.forwardKinematics(mechanism.model, data, mode.q)
        at = data.oMi[mechanism.model.getJointId("coupler")].act(np.array([2.0, 0.0, 0.0]))
        pins.append(at[[0, 2]])
    end = np.array([np.cos(1.0), np.sin(1.0)])
    exact = circles(end, 2.0, np.array([2.2, 0.0]), 1.5)
    order = sorted(exact, key=lambda point: np.linalg.norm(point - pins[0]))
    np.testing.assert_allclose(pins, order, atol=1e-12)
    assert [mode.held for mode in modes] == [("crank",)] * 2
    assert sum(mode.found for mode in modes) <= modes[0].starts == 40
    assert min(mode.found for mode in modes) >= 10
    np.testing.assert_allclose(modes[0].q, mechanism.q0, atol=1e-12)  # the nearest one first


def test_angles_lie_within_the_limits_of_their_joints_where_turns_allow_it() -> None:
    mechanism = srm.load("four_bar")
    limited = {"coupler": (-1.0, 1.0), "rocker": (-np.pi, np.pi)}
    model = mechanism.model
    low, high = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    for name, limits in limited.items():
        low[mechanism.joint(name).idx_q], high[mechanism.joint(name).idx_q] = limits
    model.lowerPositionLimit, model.upperPositionLimit = low, high
    modes = srm.assembly_modes(mechanism, {"crank": 1.0}, starts=40)
    end, pivot = np.array([np.cos(1.0), np.sin(1.0)]), np.array([2.2, 0.0])
    exact = []
    for meet in circles(end, 2.0, pivot, 1.5):
        coupler, rocker = (np.arctan2(*(meet - place)[::-1]) for place in (end, pivot))
        exact.append((1.0, coupler - 1.0, rocker))
    # The second one's coupler is beyond its limits at every turn, and stays nearest to the start.
    np.testing.assert_allclose([mode.q for mode in modes], exact, atol=1e-12)
    assert beyond_limits(mechanism, modes[0].q) == {}
    assert list(beyond_limits(mechanism, modes[1].q)) == ["coupler"]
    [first, second] = mode_rows(mechanism, modes)
    assert first[2] == ""
    assert second[2] == "beyond the limits of coupler"


def test_two_arms_that_reach_one_point_have_four_modes() -> None:
    model = planar({"left": ((0.0, 0.0), [1.0, 1.2]), "right": ((2.0, 0.0), [0.9, 1.1])})
    target = np.array([1.1, 0.9])
    loops = [
        srm.LoopClosure(
            "point",
            srm.Anchor(f"{side}_1", xyz=(length, 0.0, 0.0)),
            srm.Anchor("world", xyz=(*target, 0.0)),
            name=side,
        )
        for side, length in (("left", 1.2), ("right", 1.1))
    ]
    mechanism = srm.Mechanism(model, loops, q0=[0.3, 1.0, 2.0, 0.5])
    modes = srm.assembly_modes(mechanism, starts=80)
    found = {
        tuple(
            np.round([*tips(mechanism, m, "left_0", 1.0), *tips(mechanism, m, "right_0", 0.9)], 9)
        )
        for m in modes
    }
    left = circles(np.zeros(2), 1.0, target, 1.2)
    right = circles(np.array([2.0, 0.0]), 0.9, target, 1.1)
    assert found == {tuple(np.round([*a, *b], 9)) for a, b in product(left, right)}
    assert len(modes) == 4


def test_a_3_rrr_platform_has_the_modes_that_a_scan_of_its_angle_finds() -> None:
    """Its elbows are fixed by the cranks; the platform's corners lie at given distances of them.

    The numbers (over 10) are those of C. Innocenti, V. Parenti-Castelli (1992) with six modes.
    """
    elbows = [np.array([0.0, 0.0]), np.array([1.591, 0.0]), np.array([0.0, 1.0])]
    lengths = [1.498, 1.538, 1.2]
    corners = [
        np.zeros(2),
        np.array([1.704, 0.0]),
        max(circles(np.zeros(2), 2.084, np.array([1.704, 0.0]), 1.654), key=lambda c: c[1]),
    ]
    model = planar(
        {
            "one": ((0.0, 0.0), [lengths[0], 1.0]),  # leg and platform
            "two": (tuple(elbows[1]), [lengths[1]]),
            "three": (tuple(elbows[2]), [lengths[2]]),
        }
    )
    loops = [
        srm.LoopClosure(
            "point",
            srm.Anchor(f"{leg}_0", xyz=(lengths[k], 0.0, 0.0)),
            srm.Anchor("one_1", xyz=(*corners[k], 0.0)),
            name=leg,
        )
        for leg, k in (("two", 1), ("three", 2))
    ]
    mechanism = srm.Mechanism(model, loops, q0=[0.5, 0.2, 2.0, -1.0])

    # The platform turned by phi: circles about elbow_k - R corner_k meet in its first corner.
    def miss(phi: float, which: int) -> float:
        R = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
        centres = [e - R @ c for e, c in zip(elbows, corners)]
        meet = circles(centres[0], lengths[0], centres[1], lengths[1])
        return np.linalg.norm(meet[which] - centres[2]) - lengths[2] if meet else np.nan

    exact = []
    grid = np.linspace(-np.pi, np.pi, 2001)
    for which in (0, 1):
        values = np.array([miss(phi, which) for phi in grid])
        changes = np.flatnonzero(values[1:] * values[:-1] < 0.0)
        exact += [brentq(miss, grid[k], grid[k + 1], (which,), xtol=1e-14) for k in changes]
    modes = srm.assembly_modes(mechanism, starts=120)
    assert modes[0].held == ()
    angles = [(m.q[0] + m.q[1] + np.pi) % (2.0 * np.pi) - np.pi for m in modes]
    assert len(exact) == 6
    np.testing.assert_allclose(np.sort(angles), np.sort(exact), atol=1e-10)
    for mode in modes:
        assert np.abs(mode.residuals).max() < 1e-12


def test_a_crank_that_cannot_be_there_has_no_modes_and_a_singular_one_is_marked() -> None:
    model = planar({"a": ((0.0, 0.0), [1.0, 1.0]), "b": ((3.0, 0.0), [1.0])})
    loop = srm.LoopClosure(
        "point",
        srm.Anchor("a_1", xyz=(1.0, 0.0, 0.0)),
        srm.Anchor("b_0", xyz=(1.0, 0.0, 0.0)),
        name="pin",
    )
    short = srm.Mechanism(model, [loop], q0=[0.1, 0.1, 3.0])
    assert srm.assembly_modes(short, {"a_0": 2.0}, starts=10) == []
    (straight,) = srm.assembly_modes(short, {"a_0": 0.0, "a_1": 0.0}, starts=10)
    np.testing.assert_allclose(np.cos(straight.q[2]), -1.0)
    fold = srm.assembly_modes(srm.load("slider_crank"), {"crank": 0.5 * np.pi}, starts=20)
    assert [mode.singular for mode in fold] == [True]


def test_configurations_that_still_move_are_no_modes() -> None:
    """Stages whose links lie on each other turn freely."""
    mechanism = load("scissor_lift")
    with pytest.warns(srm.SrmWarning, match=r"\d+ of 60 starts .* still moves with foot held"):
        modes = srm.assembly_modes(mechanism, starts=60)
    assert len(modes) == 4
    assert not any(mode.singular for mode in modes)
    assert sum(mode.found for mode in modes) < 60


def test_a_singular_mode_that_does_not_move_stays_one() -> None:
    """The rod of equal bars over the pivot: a double solution, to which Newton's method creeps."""
    (mode,) = srm.assembly_modes(load("slider_crank"), {"crank": 0.5 * np.pi}, starts=20)
    assert mode.singular
    assert mode.found >= 19


def test_the_same_seed_finds_the_same() -> None:
    mechanism = srm.load("five_bar")
    first, again = (srm.assembly_modes(mechanism, starts=20, seed=3) for _ in range(2))
    assert first[0].held == ("crank_left", "crank_right")
    assert [mode.found for mode in first] == [mode.found for mode in again]
    np.testing.assert_array_equal(first[-1].q, again[-1].q)


def guided_rod(*joints: object) -> srm.Mechanism:
    """A crank and a rod on ``joints``, the rod's tip on a line beside the crank's plane."""
    model = pin.Model()
    parent = model.addJoint(0, Z(), pin.SE3.Identity(), "crank")
    model.appendBodyToJoint(parent, rod(), pin.SE3.Identity())
    place = along_x(1.0)
    for k, joint in enumerate(joints):
        parent = model.addJoint(parent, joint, place, f"rod_{k}")
        place = pin.SE3.Identity()
    model.appendBodyToJoint(parent, rod(1.0, 2.5), pin.SE3.Identity())
    model.addBodyFrame("rod", parent, pin.SE3.Identity(), 0)
    tip, line = srm.Anchor("rod", xyz=(2.5, 0.0, 0.0)), srm.Anchor("world", xyz=(0.0, 0.0, 0.4))
    guide = srm.LoopClosure("point_on_line", tip, line, axis=(1.0, 0.0, 0.0), name="guide")
    mechanism = srm.Mechanism(model, (guide,), q0=np.array([0.7, 0.1, -1.0]))
    state = srm.assemble(mechanism, hold=["crank"])
    return mechanism.with_state(state.q, state.v)


def test_whole_turns_of_a_universal_joint_are_no_further_modes() -> None:
    """It has the modes of the two hinges that it consists of."""
    y, z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    cross = guided_rod(pin.JointModelUniversal(y, z))
    hinges = guided_rod(pin.JointModelRY(), Z())
    found, expected = ([mode.q for mode in srm.assembly_modes(m)] for m in (cross, hinges))
    assert len(expected) == 4
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_screw_counts_turns_that_do_not_lead_back_and_a_hinge_turns_that_do() -> None:
    model = pin.Model()
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    parent = 0
    for name, joint in {
        "hinge": pin.JointModelRevoluteUnaligned(y),
        "screw": pin.JointModelHX(0.01),
        "slide": pin.JointModelPX(),
        "cross": pin.JointModelUniversal(x, y),
        "endless": pin.JointModelRUBX(),
        "ball": pin.JointModelSpherical(),
    }.items():
        parent = model.addJoint(parent, joint, pin.SE3.Identity(), name)
    np.testing.assert_array_equal(periodic_coordinates(model), [1, 0, 0, 1, 1, 0, 0, 0, 0])
