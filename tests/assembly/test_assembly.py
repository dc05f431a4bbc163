"""Consistent initial states: closed loops, chosen branches, rates, and what cannot be met."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.assembly import position
from srm_mbs.assembly.assemble import Assembly
from tests.support.bundled import load, rewritten
from tests.support.mechanisms import DISTINCT_MODELS, along_x, floating_ring, rescaled, rod
from tests.support.snapshots import check_messages, refused

PI = np.pi
CLOSED = 1e-12


def anchors(mechanism: srm.Mechanism, loop: srm.LoopClosure, q: FloatArray) -> list[pin.SE3]:
    """World placements of a and b by plain forward kinematics."""
    model = mechanism.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    out = []
    for anchor in (loop.a, loop.b):
        offset = pin.SE3(pin.rpy.rpyToMatrix(np.array(anchor.rpy)), np.array(anchor.xyz))
        if anchor.link == "world":
            out.append(offset)
        elif anchor.link is not None:
            frame = model.getFrameId(anchor.link, pin.FrameType.BODY)
            out.append(data.oMf[frame] * offset)
        else:
            out.append(data.oMf[model.getFrameId(anchor.frame)] * offset)
    return out


def opening(mechanism: srm.Mechanism, q: FloatArray) -> float:
    """Largest gap (m) or misalignment (sine) of the loops, signs of axes included."""
    worst = 0.0
    for loop in mechanism.loops:
        a, b = anchors(mechanism, loop, q)
        gap = b.actInv(a.translation)
        R = b.rotation.T @ a.rotation
        axis = np.array(loop.axis if loop.axis else (0.0, 0.0, 0.0))
        errors = {
            "point": [gap],
            "frame": [gap, (R - np.eye(3)).ravel()],
            "revolute": [gap, R @ axis - axis],
            "point_on_line": [gap - axis * (axis @ gap)],
            "point_on_plane": [np.atleast_1d(axis @ gap)],
        }[loop.type]
        worst = max(worst, *(float(np.linalg.norm(error)) for error in errors))
    return worst


def check(mechanism: srm.Mechanism, state: Assembly) -> None:
    """Closed and consistent, judged without the package's own closure code."""
    length = max(mechanism.structure.units.length, 1e-300)
    assert opening(mechanism, state.q) <= 2 * CLOSED * max(length, 1.0)
    assert pin.isNormalized(mechanism.model, state.q, 1e-12)
    assert np.abs(state.residuals).max() <= CLOSED * max(length, 1.0)
    speed = max(1.0, float(np.abs(state.v).max()))
    assert np.abs(state.rate_residuals).max() <= CLOSED * max(length, 1.0) * speed
    # G v by differences of the loops' opening along the motion.
    h = 1e-6
    for sign in (1, -1):
        moved = pin.integrate(mechanism.model, state.q, sign * h * state.v)
        assert opening(mechanism, moved) <= 50 * h**2 * max(length, 1.0) * speed**2 + 1e-11


def wrapped(angle: Any) -> Any:
    return (np.asarray(angle) + PI) % (2 * PI) - PI


# --- bundled mechanisms -------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*DISTINCT_MODELS, "n_four_bar_7"])
def test_a_loaded_mechanism_is_closed_and_its_rates_fit(name: str) -> None:
    mechanism = load(name)
    if mechanism.loops:
        state = srm.assemble(mechanism, mechanism.q0, mechanism.v0)
        if all(loop.joints is None for loop in mechanism.loops):
            check(mechanism, state)
        np.testing.assert_array_equal(state.q, mechanism.q0)
        np.testing.assert_allclose(state.v, mechanism.v0, rtol=0, atol=1e-14)
        assert not state.singular
        assert state.free_directions.shape == (mechanism.model.nv, mechanism.degrees_of_freedom)


@pytest.mark.parametrize("name", ["four_bar", "five_bar", "spatial_four_bar", "slider_crank"])
def test_held_values_are_kept_to_the_last_bit(name: str) -> None:
    mechanism = load(name)
    held, value = ("crank_left", 1.9) if name == "five_bar" else ("crank", 1.1)
    state = srm.assemble(mechanism, q={held: value})
    assert state.q[mechanism.joint(held).idx_q] == value
    check(mechanism, state)


def test_an_open_chain_takes_its_values_as_they_are() -> None:
    mechanism = load("pendulum_chain")
    state = srm.assemble(mechanism, q={"link_1": 0.7}, v={"link_2": -3.0})
    assert state.q[1] == 0.7
    assert list(state.v) == [0.0, 0.0, -3.0]
    assert state.residuals.size == state.rate_residuals.size == 0
    assert state.free_directions.shape == (3, 3)
    assert not state.singular


def test_assembly_is_deterministic() -> None:
    mechanism = load("four_bar")
    states = [srm.assemble(mechanism, q={"crank": 2.0}, guess={"coupler": 2.5}) for _ in range(2)]
    assert np.array_equal(states[0].q, states[1].q)
    assert np.array_equal(states[0].v, states[1].v)


# --- branches -----------------------------------------------------------------------------------


def four_bar_branches(crank: float) -> list[FloatArray]:
    """(coupler, rocker) joint angles of the two closings, by the law of cosines."""
    A = np.array([np.cos(crank), np.sin(crank)])
    D = np.array([2.2, 0.0])
    base = np.linalg.norm(D - A)
    along = (4.0 - 2.25 + base**2) / (2.0 * base)
    across = np.sqrt(4.0 - along**2)
    e = (D - A) / base
    out = []
    for side in (1.0, -1.0):
        B = A + along * e + side * across * np.array([-e[1], e[0]])
        coupler = np.arctan2(B[1] - A[1], B[0] - A[0]) - crank
        out.append(np.array([coupler, np.arctan2(B[1] - D[1], B[0] - D[0])]))
    return out


@pytest.mark.parametrize("crank", np.linspace(-3.0, 3.0, 7))
@pytest.mark.parametrize("branch", [0, 1])
def test_the_guess_chooses_the_branch_of_a_four_bar(crank: float, branch: int) -> None:
    mechanism = load("four_bar")
    coupler, rocker = four_bar_branches(crank)[branch]
    state = srm.assemble(
        mechanism, q={"crank": crank}, guess={"coupler": coupler + 0.1, "rocker": rocker - 0.1}
    )
    np.testing.assert_allclose(state.q, [crank, coupler, rocker], rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(60))
def test_a_poor_guess_leads_to_the_nearest_branch_of_a_four_bar(seed: int) -> None:
    rng = np.random.default_rng(seed)
    crank = rng.uniform(-PI, PI)
    branches = four_bar_branches(crank)
    guess = branches[rng.integers(2)] + rng.uniform(-2.0, 2.0, 2)
    state = srm.assemble(
        load("four_bar"), q={"crank": crank}, guess={"coupler": guess[0], "rocker": guess[1]}
    )
    check(load("four_bar"), state)
    distances = [float(np.linalg.norm(wrapped(guess - branch))) for branch in branches]
    nearest = branches[int(np.argmin(distances))]
    found = state.q[1:]
    if abs(distances[0] - distances[1]) > 1e-6:
        np.testing.assert_allclose(wrapped(found - nearest), 0.0, atol=1e-11)
    # And to the turn that the guess is in.
    assert np.abs(found - guess).max() <= PI + 1e-9


@pytest.mark.parametrize("turns", [-3, -1, 1, 2])
def test_the_guess_chooses_the_turn_too(turns: int) -> None:
    mechanism = load("four_bar")
    start = mechanism.q0
    state = srm.assemble(
        mechanism,
        q={"crank": start[0]},
        guess={"coupler": start[1] + 2 * PI * turns + 0.7, "rocker": start[2] - 0.3},
    )
    np.testing.assert_allclose(
        state.q, [start[0], start[1] + 2 * PI * turns, start[2]], rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("seed", [0, 8, 19, 26, 37])
def test_no_hinge_is_wound_up(seed: int) -> None:
    """However poor the guess, every angle stays within half a turn of it."""
    mechanism = load("n_four_bar_2")
    guess = mechanism.q0 + np.random.default_rng(seed).uniform(-3.0, 3.0, 5)
    state = srm.assemble(mechanism, guess, hold=["crank_0"])
    check(mechanism, state)
    assert np.abs(state.q - guess).max() <= PI + 1e-9


@pytest.mark.parametrize("away", [0.12, 1e-3, -0.6])
@pytest.mark.parametrize("angle", [-0.01, 1.0, -2.5])
def test_a_guess_next_to_a_continuum_of_closings_leads_to_the_nearest(
    angle: float, away: float
) -> None:
    """With the cranks on the ground line, coupler and second crank turn about the same point."""
    mechanism = load("n_four_bar_1")
    guess = {"coupler_0": angle + 0.5 * away, "crank_1": angle - 0.5 * away}
    state = srm.assemble(mechanism, q={"crank_0": 0.0}, guess=guess)
    check(mechanism, state)
    assert state.q == pytest.approx([0.0, angle, angle], abs=1e-9)
    # There the second crank may turn, the first may not.
    rates = srm.assemble(mechanism, state.q, [1.0, 1.0, 1.0]).v
    assert rates[0] == pytest.approx(0.0, abs=1e-12)
    assert rates[1] == pytest.approx(rates[2])


@pytest.mark.parametrize("n", [3, 12])
def test_a_long_chain_of_loops_follows_its_guess(n: int) -> None:
    mechanism = srm.n_four_bar(n)
    rng = np.random.default_rng(n)
    guess = {
        name: value + rng.uniform(-0.3, 0.3)
        for name, value in zip(mechanism.joint_names, mechanism.q0)
        if name != "crank_0"
    }
    state = srm.assemble(mechanism, q={"crank_0": 1.2}, guess=guess, v={"crank_0": 2.0})
    check(mechanism, state)
    for i in range(n + 1):
        assert state.q[mechanism.joint(f"crank_{i}").idx_q] == pytest.approx(1.2, abs=1e-11)
        assert state.v[mechanism.joint(f"crank_{i}").idx_v] == pytest.approx(2.0, abs=1e-11)


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1.0, 1e6])
def test_assembly_does_not_depend_on_the_unit_of_length(size: float) -> None:
    small = rescaled(load("slider_crank_slider"), length=size)
    plain = load("slider_crank_slider")
    options: dict[str, Any] = {"guess": {"rod": -1.9}, "v": {"crank": 2.0}}
    state = srm.assemble(small, q={"crank": 1.0}, **options)
    reference = srm.assemble(plain, q={"crank": 1.0}, **options)
    np.testing.assert_allclose(state.q / [1, 1, size], reference.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(state.v / [1, 1, size], reference.v, rtol=0, atol=1e-11)


# --- singular starts ----------------------------------------------------------------------------

HALF = PI / 2
SINGULAR_STARTS = [
    # mechanism, held, guess, the closing
    ("slider_crank", {"crank": HALF}, {"rod": -3.0}, [HALF, -PI]),
    ("slider_crank", {"crank": HALF}, {"rod": -3.5}, [HALF, -PI]),
    ("slider_crank", {"crank": HALF}, {"rod": -2.0}, [HALF, -PI]),
    ("slider_crank", {"crank": HALF}, {"rod": 0.4}, [HALF, PI]),
    ("slider_crank", {"crank": 3 * HALF}, {"rod": -9.0}, [3 * HALF, -3 * PI]),
    ("slider_crank", {"crank": 3 * HALF}, {"rod": 3.3}, [3 * HALF, PI]),
    ("slider_crank", {"crank": 7 * HALF}, {"rod": -22.1}, [7 * HALF, -7 * PI]),
    ("slider_crank_whirl", {"crank": -HALF}, {"rod": 3.1}, [-HALF, PI]),
    ("slider_crank_slider", {"crank": HALF}, {"rod": -3.1, "slider": 0.2}, [HALF, -PI, 0.0]),
    ("slider_crank_slider", {"slider": 0.0, "crank": HALF}, {"rod": -3.1}, [HALF, -PI, 0.0]),
    ("parallelogram", {"crank": 0.0}, {"coupler": 0.2, "rocker": -0.1}, [0.0, 0.0, 0.0]),
    ("parallelogram", {"crank": 0.0}, {"coupler": 0.01, "rocker": 0.3}, [0.0, 0.0, 0.0]),
    ("parallelogram", {"crank": PI}, {"coupler": -3.0, "rocker": 3.3}, [PI, -PI, PI]),
    ("parallelogram", {"rocker": 0.0}, {"coupler": 0.1, "crank": 0.1}, [0.0, 0.0, 0.0]),
]


@pytest.mark.parametrize(("name", "held", "guess", "closing"), SINGULAR_STARTS)
def test_a_singular_closing_is_found_to_round_off(
    name: str, held: dict[str, float], guess: dict[str, float], closing: list[float]
) -> None:
    mechanism = load(name)
    state = srm.assemble(mechanism, q=held, guess=guess)
    np.testing.assert_allclose(state.q, closing, rtol=0, atol=1e-10)
    check(mechanism, state)
    assert state.singular
    assert state.free_directions.shape[1] == mechanism.degrees_of_freedom + 1


@pytest.mark.parametrize("n", [1, 2, 5])
def test_an_n_four_bar_with_horizontal_cranks_has_n_plus_one_freedoms(n: int) -> None:
    mechanism = srm.n_four_bar(n)
    flat = dict.fromkeys(mechanism.joint_names[1:], 0.0)
    state = srm.assemble(mechanism, q={"crank_0": 0.0}, guess=flat)
    assert state.singular
    assert state.free_directions.shape == (2 * n + 1, n + 1)
    assert mechanism.degrees_of_freedom == 1


@pytest.mark.parametrize("crank", [HALF, 3 * HALF])
def test_a_description_may_start_at_a_singular_configuration(crank: float, tmp_path: Path) -> None:
    held = ("5.497787143782138", repr(crank))
    guess = ("-10.995574287564276", repr(-2 * crank + 0.2))
    mechanism = srm.load(rewritten(tmp_path, "slider_crank", held, guess))
    np.testing.assert_allclose(mechanism.q0, [crank, -2 * crank], rtol=0, atol=1e-10)
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.structure.rank == 1


@pytest.mark.parametrize("distance", [1e-2, 1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("offset", [0.3, -0.2])
def test_a_regular_closing_near_a_singular_one_is_not_drawn_to_it(
    distance: float, offset: float
) -> None:
    """Off the vertical by d, the two closings are 2 d apart; both are known exactly."""
    mechanism = load("slider_crank")
    crank = HALF - distance
    state = srm.assemble(mechanism, q={"crank": crank}, guess={"rod": -PI + offset})
    # sin(crank) + sin(crank + rod) = 0: the rod mirrors the crank, or lies on it.
    errors = [abs(state.q[1] + 2 * crank), abs(wrapped(state.q[1] - PI))]
    assert min(errors) < 1e-14 / distance
    assert not state.singular
    rates = srm.assemble(mechanism, q=state.q, hold=["crank"], v={"crank": 1.0}).v
    expected = -2.0 if errors[0] < errors[1] else 0.0
    assert rates[1] == pytest.approx(expected, abs=1e-13 / distance**2)


TANGENTS = [
    # mechanism, closing, held rates, all rates (None: there is no motion)
    ("slider_crank", [HALF, -PI], {"crank": 2.0, "rod": -4.0}, [2.0, -4.0]),
    ("slider_crank", [HALF, -PI], {"crank": 2.0, "rod": 0.0}, [2.0, 0.0]),
    ("slider_crank", [HALF, -PI], {"rod": -4.0}, [2.0, -4.0]),
    ("slider_crank", [HALF, -PI], {"crank": 2.0}, [2.0, 0.0]),  # the smaller rates
    ("slider_crank", [HALF, -PI], {"crank": 2.0, "rod": -2.0}, None),
    ("slider_crank", [HALF, -PI], {"crank": 2.0, "rod": 1.0}, None),
    ("slider_crank_slider", [HALF, -PI, 0.0], {"crank": 2.0, "slider": -8.0}, [2.0, -4.0, -8.0]),
    ("slider_crank_slider", [HALF, -PI, 0.0], {"slider": -8.0}, [2.0, -4.0, -8.0]),
    ("slider_crank_slider", [HALF, -PI, 0.0], {"crank": 2.0, "slider": 0.0}, [2.0, 0.0, 0.0]),
    ("slider_crank_slider", [HALF, -PI, 0.0], {"crank": 2.0, "slider": -3.0}, None),
    # A parallelogram's rocker turns with the crank, an antiparallelogram's against it:
    # sides 1 and 2, both branches have G v = 0 and the one relation quadratic in the rates.
    ("parallelogram", [0.0, 0.0, 0.0], {"crank": 6.0, "rocker": 6.0}, [6.0, -6.0, 6.0]),
    ("parallelogram", [PI, -PI, PI], {"crank": 6.0, "rocker": 6.0}, [6.0, -6.0, 6.0]),
    ("parallelogram", [PI, -PI, PI], {"crank": 6.0, "rocker": -2.0}, [6.0, -2.0, -2.0]),
    ("parallelogram", [0.0, 0.0, 0.0], {"crank": 6.0, "rocker": 5.0}, None),
    ("parallelogram", [0.0, 0.0, 0.0], {"crank": 6.0, "rocker": 0.0}, None),
]


@pytest.mark.parametrize(("name", "closing", "held", "rates"), TANGENTS)
def test_rates_at_a_singular_start_are_those_of_a_motion(
    name: str, closing: list[float], held: dict[str, float], rates: list[float] | None
) -> None:
    mechanism = load(name)
    if rates is None:
        with pytest.raises(srm.AssemblyError) as caught:
            srm.assemble(mechanism, np.array(closing), held)
        for needle in ("initial.v", "singular", "no motion", *map(repr, held)):
            assert needle in str(caught.value)
        assert caught.value.held == tuple(held)
        return
    state = srm.assemble(mechanism, np.array(closing), held)
    np.testing.assert_allclose(state.v, rates, rtol=0, atol=1e-12)
    for joint, rate in held.items():
        assert state.v[mechanism.joint(joint).idx_v] == rate


@pytest.mark.parametrize("name", ["slider_crank", "parallelogram", "slider_crank_slider"])
@pytest.mark.parametrize("seed", range(3))
def test_free_rates_at_a_singular_start_belong_to_a_branch(name: str, seed: int) -> None:
    """Along such rates the loops open by the third order only; along others, by the second."""
    mechanism = load(name)
    closing = {start[0]: start[3] for start in SINGULAR_STARTS}[name]
    v = np.random.default_rng(seed).uniform(-5.0, 5.0, mechanism.model.nv)
    state = srm.assemble(mechanism, np.array(closing), v)
    h = 1e-3
    for sign in (1, -1):
        ahead = srm.assemble(mechanism, state.q + sign * h * state.v)  # the nearest closing
        assert np.abs(ahead.q - state.q - sign * h * state.v).max() < 20 * h**2 * 25


def test_rates_within_round_off_of_a_singular_start_are_refused() -> None:
    """At pi/2 typed with eight digits, the rod's angle decides its rate and is not known."""
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(
            load("slider_crank"), q={"crank": 1.5707963}, guess={"rod": -3.0}, v={"crank": 2.0}
        )
    for needle in ("'crank'", "close to a singular configuration", "all digits"):
        assert needle in str(caught.value)
    at_rest = srm.assemble(load("slider_crank"), q={"crank": 1.5707963}, guess={"rod": -3.0})
    check(load("slider_crank"), at_rest)


# --- closings that only look closed -------------------------------------------------------------


def free_body(loop: srm.LoopClosure) -> srm.Mechanism:
    """A body free in space, closed on the ground by ``loop``."""
    model = pin.Model()
    body = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    model.appendBodyToJoint(body, rod(), pin.SE3.Identity())
    model.addBodyFrame("body", body, pin.SE3.Identity(), 0)
    return srm.Mechanism(model, (loop,))


GROUND = srm.Anchor("world", xyz=(0.3, -0.2, 0.5), rpy=(0.4, -0.7, 1.1))
GRIP = srm.Anchor("body", xyz=(0.2, 0.1, -0.3), rpy=(-0.5, 0.3, 2.0))
DIAGONAL = (0.48, -0.6, 0.64)


def posed(mechanism: srm.Mechanism, turn: FloatArray) -> FloatArray:
    """q for which a stands on b's origin, turned by ``turn`` (rotation vector in b)."""
    _, in_a = mechanism.loops[0].a.resolve(mechanism.model)
    _, in_b = mechanism.loops[0].b.resolve(mechanism.model)
    placement = in_b * pin.SE3(pin.exp3(turn), np.zeros(3)) * in_a.inverse()
    return pin.SE3ToXYZQUAT(placement)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), DIAGONAL])
@pytest.mark.parametrize("angle", [PI, PI - 1e-9, PI - 1e-3, 2.5])
def test_a_weld_is_never_closed_half_a_turn_off(
    axis: tuple[float, float, float], angle: float
) -> None:
    mechanism = free_body(srm.LoopClosure("frame", GRIP, GROUND))
    state = srm.assemble(mechanism, posed(mechanism, angle * np.array(axis)))
    check(mechanism, state)
    a, b = anchors(mechanism, mechanism.loops[0], state.q)
    np.testing.assert_allclose(a.homogeneous, b.homogeneous, rtol=0, atol=1e-12)
    assert state.free_directions.shape == (6, 0)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), DIAGONAL])
@pytest.mark.parametrize("angle", [PI, PI - 1e-9, PI - 1e-3, 2.5])
@pytest.mark.parametrize("spin", [0.0, 1.0, 3.0])
def test_a_hinge_is_never_closed_with_its_axis_reversed(
    axis: tuple[float, float, float], angle: float, spin: float
) -> None:
    mechanism = free_body(srm.LoopClosure("revolute", GRIP, GROUND, axis=axis))
    across = np.cross(axis, (0.3, 0.5, -0.8))
    turn = angle * across / np.linalg.norm(across)
    turn = pin.log3(pin.exp3(turn) @ pin.exp3(spin * np.array(axis)))
    state = srm.assemble(mechanism, posed(mechanism, turn))
    check(mechanism, state)
    a, b = anchors(mechanism, mechanism.loops[0], state.q)
    np.testing.assert_allclose(a.rotation @ axis, b.rotation @ axis, rtol=0, atol=1e-12)
    assert state.free_directions.shape == (6, 1)


def hinged_chain(kinds: str, axis: tuple[float, float, float]) -> srm.Mechanism:
    """Two one-metre rods on hinges along ``kinds``, held by a hinge in the ground at (2, 0, 0)."""
    model = pin.Model()
    parent = 0
    for i, kind in enumerate(kinds):
        joint = getattr(pin, f"JointModelR{kind.upper()}")()
        parent = model.addJoint(parent, joint, along_x(1.0 if i else 0.0), f"j{i}")
        model.appendBodyToJoint(parent, rod(), pin.SE3.Identity())
        model.addBodyFrame(f"l{i}", parent, pin.SE3.Identity(), 0)
    tip = srm.Anchor(f"l{len(kinds) - 1}", xyz=(1.0, 0.0, 0.0))
    ground = srm.Anchor("world", xyz=(1.2, 0.0, 0.0))
    return srm.Mechanism(model, (srm.LoopClosure("revolute", tip, ground, axis, "hinge"),))


def test_an_axis_that_can_only_be_closed_reversed_is_an_error() -> None:
    """All hinges along y; the last one's axis, turned by half a turn about x, points along -y."""
    mechanism = hinged_chain("yy", (0.0, 1.0, 0.0))
    closed = srm.assemble(mechanism, guess={"j0": -0.9, "j1": 1.8})
    check(mechanism, closed)
    loop = mechanism.loops[0]
    turned = replace(loop, a=replace(loop.a, rpy=(PI, 0.0, 0.0)))
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(srm.Mechanism(mechanism.model, (turned,)), closed.q)
    gap, angle = caught.value.residuals["hinge"]
    assert gap is not None
    assert angle == pytest.approx(PI, abs=1e-6)
    assert "3.14 rad" in str(caught.value)


@pytest.mark.parametrize("seed", range(4))
def test_an_arm_is_welded_to_its_target_from_a_poor_guess(seed: int) -> None:
    """Six hinges, one pose: closed exactly, or refused with the loop's name."""
    rng = np.random.default_rng(seed)
    model = pin.Model()
    parent = 0
    for i, kind in enumerate("ZYYXYX"):
        joint = getattr(pin, f"JointModelR{kind}")()
        parent = model.addJoint(parent, joint, along_x(0.5 if i else 0.0), f"j{i}")
        model.appendBodyToJoint(parent, rod(length=0.5), pin.SE3.Identity())
        model.addBodyFrame(f"l{i}", parent, pin.SE3.Identity(), 0)
    q = rng.uniform(-1.2, 1.2, 6)
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    target = data.oMi[6]
    ground = srm.Anchor(
        "world", xyz=tuple(target.translation), rpy=tuple(pin.rpy.matrixToRpy(target.rotation))
    )
    mechanism = srm.Mechanism(model, (srm.LoopClosure("frame", srm.Anchor("l5"), ground),))
    for spread in (0.3, 1.5):
        state = srm.assemble(mechanism, q + rng.uniform(-spread, spread, 6))
        check(mechanism, state)


def test_joints_on_groups_are_assembled_on_their_manifold() -> None:
    ring = floating_ring()
    rng = np.random.default_rng(2)
    for spread in (0.1, 0.8):
        start = pin.integrate(ring.model, ring.q0, rng.uniform(-spread, spread, ring.model.nv))
        state = srm.assemble(ring, start, rng.standard_normal(ring.model.nv))
        check(ring, state)
        held = srm.assemble(ring, start, hold=["a", "b"])
        check(ring, held)
        np.testing.assert_array_equal(held.q[:11], pin.normalize(ring.model, start)[:11])


# --- what cannot be closed ----------------------------------------------------------------------


def reach(target: float) -> srm.Mechanism:
    """Three one-metre bars hanging on each other, the tip tied to a point on the x axis."""
    chain = load("pendulum_chain")
    tip = srm.Anchor("link_2", xyz=(1.0, 0.0, 0.0))
    tie = srm.LoopClosure("point", tip, srm.Anchor("world", xyz=(target, 0.0, 0.0)), name="tie")
    return srm.Mechanism(chain.model, (tie,))


def test_a_loop_out_of_reach_is_named_with_its_gap_and_the_closest_configuration() -> None:
    mechanism = reach(3.25)
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(mechanism, guess={"link_0": 0.5, "link_1": -0.3, "link_2": 0.7})
    error = caught.value
    for needle in ("cannot be closed", "tie: 0.25 m", "initial.guess", "Check the anchors"):
        assert needle in str(error)
    gap, angle = error.residuals["tie"]
    assert gap == pytest.approx(0.25, abs=1e-6)
    assert angle is None
    assert error.held == ()
    # Stretched out towards the point.
    assert np.abs(wrapped(np.cumsum(error.q))).max() < 2e-2
    assert opening(mechanism, error.q) == pytest.approx(gap, rel=1e-9)


def test_a_loop_at_the_end_of_its_reach_is_closed() -> None:
    mechanism = reach(3.0)
    state = srm.assemble(mechanism, guess={"link_0": 0.2, "link_1": -0.3, "link_2": 0.1})
    check(mechanism, state)


def test_every_open_loop_is_listed_with_its_own_gap() -> None:
    mechanism = reach(3.25)
    hook = srm.LoopClosure(
        "revolute",
        srm.Anchor("link_0"),
        srm.Anchor("world"),
        axis=(1.0, 0.0, 0.0),
        name="hook",
    )
    both = srm.Mechanism(mechanism.model, (*mechanism.loops, hook))
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(both, q={"link_0": 0.4})
    error = caught.value
    assert set(error.residuals) == {"tie", "hook"}
    assert error.residuals["hook"] == (
        pytest.approx(0.0, abs=1e-12),
        pytest.approx(0.4, abs=1e-9),
    )
    assert "hook: " in str(error)
    assert "0.4 rad" in str(error)
    assert "tie: 0." in str(error)


@pytest.mark.parametrize(
    ("held", "guilty"),
    [
        ({"crank": 1.0, "rocker": 3.0}, ("rocker",)),  # no crank angle reaches that rocker
        ({"crank": 1.0, "rocker": 1.5}, ("crank", "rocker")),
        ({"crank": 1.0, "coupler": -0.5}, ("crank", "coupler")),
        ({"crank": 1.0, "coupler": -0.5, "rocker": 1.4}, ("crank", "coupler", "rocker")),
    ],
)
def test_contradicting_held_values_are_named(
    held: dict[str, float], guilty: tuple[str, ...]
) -> None:
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(load("four_bar"), q=held)
    error = caught.value
    assert error.element == "initial.q"
    assert set(error.held) <= set(held)
    assert set(error.held) == set(guilty)
    for name in held:
        assert repr(name) in str(error)
    assert "pin: " in str(error)
    assert error.remedy is not None
    assert "free" in error.remedy.lower()
    # The held values stand in the closest configuration.
    for name, value in held.items():
        assert error.q[load("four_bar").joint(name).idx_q] == value


def test_consistent_held_values_may_be_redundant() -> None:
    mechanism = load("four_bar")
    crank, coupler, rocker = mechanism.q0
    state = srm.assemble(mechanism, q={"crank": crank, "coupler": coupler, "rocker": rocker})
    np.testing.assert_array_equal(state.q, mechanism.q0)


def test_a_held_value_of_an_unrelated_joint_is_not_blamed() -> None:
    mechanism = reach(3.25)
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(mechanism, q={"link_0": 0.0})
    assert caught.value.held == ()
    assert caught.value.residuals["tie"][0] == pytest.approx(0.25, abs=1e-6)


# --- rates --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["four_bar", "five_bar", "spatial_four_bar", "n_four_bar_2"])
def test_rates_change_as_little_as_possible(name: str) -> None:
    mechanism = load(name)
    model = mechanism.model
    v = np.random.default_rng(1).standard_normal(model.nv)
    state = srm.assemble(mechanism, mechanism.q0, v)
    check(mechanism, state)
    # The projection onto the free directions (all joints are hinges: one unit).
    free = state.free_directions
    np.testing.assert_allclose(state.v, free @ (free.T @ v), rtol=0, atol=1e-12)
    np.testing.assert_allclose(free.T @ free, np.eye(free.shape[1]), atol=1e-13)


def test_free_directions_keep_the_loops_closed_and_are_orthonormal_in_units() -> None:
    mechanism = load("slider_crank_slider")
    state = srm.assemble(mechanism)
    for v in state.free_directions.T:
        np.testing.assert_allclose(srm.assemble(mechanism, state.q, v).v, v, atol=1e-12)
    by_unit = state.free_directions / mechanism.structure.units.coordinate[:, None]
    np.testing.assert_allclose(by_unit.T @ by_unit, np.eye(by_unit.shape[1]), atol=1e-12)


def test_free_rates_are_the_smallest_that_fit() -> None:
    mechanism = load("five_bar")
    state = srm.assemble(mechanism, mechanism.q0, {"crank_left": 1.0})
    check(mechanism, state)
    # Of the two-dimensional space of motions, the smallest with this rate of the left crank.
    first = mechanism.joint("crank_left").idx_v
    basis = state.free_directions
    weights = basis[first] / (basis[first] @ basis[first])
    np.testing.assert_allclose(state.v, basis @ weights, rtol=0, atol=1e-12)


def test_without_rates_a_mechanism_rests() -> None:
    assert not srm.assemble(load("spatial_four_bar")).v.any()


def test_contradicting_held_rates_are_named() -> None:
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(load("four_bar"), load("four_bar").q0, {"crank": 4.0, "rocker": 4.0})
    error = caught.value
    assert error.element == "initial.v"
    assert error.held == ("crank", "rocker")
    for needle in ("held rates of 'crank', 'rocker'", "contradict", "G v", "Change or free"):
        assert needle in str(error)


def test_of_contradicting_held_rates_the_guilty_one_is_found() -> None:
    """At a dead point of the crank the rocker cannot move; the crank's rate is free."""
    mechanism = load("slider_crank_slider")
    q = np.array([0.0, 0.0, 4.0])  # stretched: the slider is at rest whatever the crank does
    for rates in ({"crank": 1.0, "slider": 1.0}, {"slider": 1.0}):
        with pytest.raises(srm.AssemblyError) as caught:
            srm.assemble(mechanism, q, rates)
        assert caught.value.held == ("slider",)
    assert srm.assemble(mechanism, q, {"crank": 1.0, "slider": 0.0}).v[1] == pytest.approx(-2.0)


def test_consistent_held_rates_may_be_redundant() -> None:
    mechanism = load("four_bar")
    held = dict(zip(mechanism.joint_names, mechanism.v0))
    state = srm.assemble(mechanism, mechanism.q0, held)
    np.testing.assert_allclose(state.v, mechanism.v0, rtol=0, atol=1e-15)


# --- arguments ----------------------------------------------------------------------------------


def test_joints_named_in_hold_are_held_and_others_are_guesses() -> None:
    mechanism = load("four_bar")
    start = mechanism.q0 + np.array([0.2, 0.05, 0.02])
    for hold in (["crank"], ("crank",), "crank"):
        state = srm.assemble(mechanism, start, hold=hold)
        assert state.q[0] == start[0]
        check(mechanism, state)
    both = srm.assemble(mechanism, q={"crank": 1.2, "rocker": 1.4}, hold=["rocker"])
    assert both.q[2] == 1.4
    assert both.q[0] != 1.2
    free = srm.assemble(mechanism, start)
    assert (free.q != start).all()


FAULTY: list[dict[str, Any]] = [
    {"q": {"crnk": 1.0}},
    {"v": {"crnk": 1.0}},
    {"guess": {"crnk": 1.0}},
    {"hold": ["crnk"]},
    {"q": {"crank": 1.0}, "guess": {"crank": 1.0}},
    {"q": {"crank": float("nan")}},
    {"q": {"crank": "one"}},
    {"q": {"crank": None}},
    {"q": {"crank": [1.0, 2.0]}},
    {"q": {"crank": 1j}},
    {"q": {"crank": [[1.0]]}},
    {"v": {"crank": float("inf")}},
    {"v": {"crank": [1.0, 2.0]}},
    {"q": [1.0, 2.0]},
    {"q": [float("nan"), 0.0, 0.0]},
    {"q": [[0.0], [0.0], [0.0]]},
    {"q": "abc"},
    {"q": [[1.0], 2.0, 3.0]},
    {"v": [1.0]},
    {"v": [float("inf"), 0.0, 0.0]},
    {"v": 3.0},
]


def test_faulty_arguments_are_refused() -> None:
    messages = {}
    for arguments in FAULTY:
        case = ", ".join(f"{key} = {value!r}" for key, value in arguments.items())
        messages[case] = refused(partial(srm.assemble, load("four_bar"), **arguments))
    check_messages("assembly_arguments", messages)


def test_a_quaternion_of_length_zero_is_refused() -> None:
    ring = floating_ring()
    with pytest.raises(srm.InputError, match="length zero"):
        srm.assemble(ring, np.zeros(ring.model.nq))


def test_assembly_leaves_the_mechanism_and_its_arguments_alone() -> None:
    mechanism = load("four_bar")
    q, v = mechanism.q0 + 0.1, np.ones(3)
    before = (mechanism.q0.copy(), mechanism.v0.copy(), q.copy(), v.copy())
    srm.assemble(mechanism, q, v)
    for old, new in zip(before, (mechanism.q0, mechanism.v0, q, v)):
        np.testing.assert_array_equal(old, new)


@pytest.mark.parametrize("closure", ["point", "revolute"])
@pytest.mark.parametrize("rate", [4.0, 1e-3, 1e-6, 1e-9])
def test_planar_loops_in_tilted_planes_take_any_rate(
    closure: str, rate: float, tmp_path: Path
) -> None:
    """Rows that are zero up to rounding say nothing about the motion, however slow it is."""
    tilt = (
        '<link name="world"/><joint name="tilt" type="fixed"><parent link="world"/>'
        '<child link="frame"/><origin rpy="0.4 0.5 0.6"/></joint>'
    )
    urdf = (
        ('name="world"', 'name="frame"'),
        ('link="world"', 'link="frame"'),
        ('<link name="frame">', tilt + '<link name="frame">'),
    )
    axis = "\naxis = [0.0, 1.0, 0.0]" if closure == "revolute" else ""
    toml = (
        ("crank = 4.0", f"crank = {rate!r}"),
        ('type = "point"', f'type = "{closure}"{axis}'),
    )
    tilted = srm.load(rewritten(tmp_path, "four_bar", *toml, urdf=urdf))
    assert tilted.degrees_of_freedom == 1
    expected = srm.assemble(load("four_bar"), {"crank": 1.0}, {"crank": rate})
    np.testing.assert_allclose(tilted.v0, expected.v, rtol=1e-9)


def four_bars(couplers: list[float]) -> dict[str, Any]:
    """Arguments of srm.planar: linkages side by side with couplers of these lengths (m)."""
    out: dict[str, Any] = {"points": {}, "bars": {}, "ground": (), "lengths": {}}
    for i, coupler in enumerate(couplers):
        left, A, B, right = (f"{name}{i}" for name in "OABC")
        places = ((0.0, 0.0), (0.0, 0.4), (1.0, 0.8), (1.2, 0.0))
        out["points"] |= {
            name: (3.0 * i + x, z) for name, (x, z) in zip((left, A, B, right), places)
        }
        out["bars"] |= {f"crank{i}": (left, A), f"coupler{i}": (A, B), f"rocker{i}": (B, right)}
        out["ground"] += (left, right)
        out["lengths"][f"coupler{i}"] = coupler
    return out | {"mass_per_length": 1.0}


def test_loops_that_share_no_joint_close_by_themselves() -> None:
    """Those beside a loop that cannot close are closed all the same, and the refusal is prompt."""
    alone = {length: srm.planar(**four_bars([length])) for length in (1.1, 0.9, 1.3)}
    lengths = [1.1, 0.9, 1.3] * 18
    together = srm.planar(**four_bars(lengths))
    for i, length in enumerate(lengths[:6]):
        own = alone[length]
        for pin_ in "OAC":
            here = together.joint(f"{pin_}{i}").idx_q
            there = own.joint(f"{pin_}0").idx_q
            assert together.q0[here] == pytest.approx(own.q0[there], abs=1e-2)
    lengths[7] = 9.0
    started = time.process_time()
    with pytest.raises(srm.AssemblyError) as caught:
        srm.planar(**four_bars(lengths))
    assert time.process_time() - started < 3.0
    gaps = {name: gap for name, (gap, _) in caught.value.residuals.items()}
    assert gaps.pop("B7") == pytest.approx(9.0 - np.hypot(1.2, 0.0) - 0.4 - np.hypot(0.2, 0.8))
    assert max(gap for gap in gaps.values() if gap is not None) < 1e-12


@pytest.mark.parametrize("name", ["four_bar", "four_bar_planar", "five_bar", "squeezing_mechanism"])
def test_a_start_that_closures_determine_is_that_of_the_trust_region_solve(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    contracted = srm.load(name)
    monkeypatch.setattr(position, "FIRST_STEP", 0.0)
    searched = srm.load(name)
    assert np.abs(contracted.q0 - searched.q0).max() < 1e-14
    assert np.abs(contracted.v0 - searched.v0).max() < 1e-12


def test_a_state_is_shown_without_the_basis_of_its_motions() -> None:
    shown = repr(srm.assemble(load("stewart_platform")))
    assert shown.startswith("Assembly(q=array(")
    assert "singular=False" in shown
    assert "free_directions" not in shown
