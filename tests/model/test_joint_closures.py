"""Mechanisms closed by every kind of joint, against exact solutions; how they are assembled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.model.closures import perpendicular_basis
from tests.integration.kernel.test_kernel import agree
from tests.support.backends import needs_kernel, on_both
from tests.support.lockstep import compare
from tests.support.mechanisms import add_link
from tests.support.reduced import trajectory

assert_close = partial(np.testing.assert_allclose, rtol=0.0)

RTOL = 1e-10


class Tree:
    """A pin.Model built body by body; every body has its joint's name."""

    def __init__(self, gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.model = pin.Model()
        self.model.gravity.linear = np.array(gravity)

    def body(
        self,
        name: str,
        joint: Any,
        parent: str = "universe",
        at: tuple[float, float, float] = (0.0, 0.0, 0.0),
        turned: Any = None,
        mass: float = 1.0,
        lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
        inertia: float = 0.1,
    ) -> Tree:
        pose = pin.SE3(np.eye(3) if turned is None else turned, np.array(at))
        body = pin.Inertia(mass, np.array(lever), inertia * np.eye(3))
        add_link(self.model, self.model.getJointId(parent), joint, name, body, pose)
        return self

    def closed(self, loop: srm.LoopClosure, v: dict[str, float], **q: float) -> srm.Mechanism:
        mechanism = srm.Mechanism(self.model, (loop,))
        state = srm.assemble(mechanism, v=v, guess=q)
        return mechanism.with_state(state.q, state.v)


def check_motion(
    run: srm.Solution,
    crank: str,
    inertia: Callable[[Any], Any],
    potential: Callable[[Any], Any] = lambda angle: 0.0,
) -> FloatArray:
    """The crank of a conservative mechanism with one degree of freedom, I(a) a'^2/2 + V(a) = E.

    Compares its rate with the one that follows from the energy at every time, and the time of the
    whole run with the integral of da/a'.  Returns the angles.
    """
    angle, rate = run.joint(crank)
    energy = 0.5 * inertia(angle[0]) * rate[0] ** 2 + potential(angle[0])

    def expected(a: Any) -> Any:
        return np.sqrt(2.0 * (energy - potential(a)) / inertia(a))

    assert run.success
    assert_close(rate, expected(angle), atol=2e-8)
    time = quad(lambda a: 1.0 / expected(a), angle[0], angle[-1], epsabs=1e-12, limit=200)[0]
    assert time == pytest.approx(run.t[-1], abs=2e-8)
    assert run.drift.max() < 1e-8
    assert np.abs(run.energy - run.energy[0]).max() < 1e-8 * max(1.0, abs(energy))
    return angle


BETA, SHAFTS = 0.6, (0.3, 0.2)


def hooke_joint() -> srm.Mechanism:
    """Two shafts (kg m^2) at the angle BETA."""
    beta, (Ia, Ib) = BETA, SHAFTS
    bent = Rotation.from_euler("z", beta).as_matrix()
    tree = Tree().body("a", pin.JointModelRX(), inertia=Ia)
    tree.body("b", pin.JointModelRX(), turned=bent, inertia=Ib)
    loop = srm.LoopClosure(
        "universal",
        srm.Anchor("a"),
        srm.Anchor("b"),
        axis_a=(0.0, 1.0, 0.0),
        axis_b=(0.0, 0.0, 1.0),
        name="cross",
    )
    return tree.closed(loop, {"a": 3.0})


@on_both
def test_a_hooke_joint_between_two_shafts(backend: str) -> None:
    """tan a = tan b cos(beta): the driven shaft runs unevenly, twice per turn."""
    beta, (Ia, Ib) = BETA, SHAFTS
    mechanism = hooke_joint()
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.redundant_rows == ("cross.x", "cross.y", "cross.z")
    run = srm.simulate(mechanism, 5.0, rtol=RTOL, backend=backend)

    def ratio(a: Any) -> Any:
        return np.cos(beta) / (np.cos(a) ** 2 * np.cos(beta) ** 2 + np.sin(a) ** 2)

    a = check_motion(run, "a", lambda a: Ia + Ib * ratio(a) ** 2)
    assert a[-1] > 4.0 * np.pi
    b, b_rate = run.joint("b")
    assert_close(b, np.unwrap(np.arctan2(np.sin(a), np.cos(a) * np.cos(beta))), atol=1e-9)
    assert_close(b_rate, ratio(a) * run.joint("a")[1], atol=1e-8)


def guided_slider_crank() -> srm.Mechanism:
    """Crank r, rod l, block m on an inclined guide through the crank's axis."""
    r, length, guide = 0.4, 1.0, 0.3
    tree = Tree().body("crank", pin.JointModelRY(), inertia=0.05)
    tree.body("rod", pin.JointModelRY(), "crank", (r, 0, 0), mass=2.0, lever=(0.5, 0, 0))
    tree.body("block", pin.JointModelRY(), "rod", (length, 0, 0), mass=3.0)
    turned = srm.Anchor("world", rpy=(0.0, guide, 0.0))
    loop = srm.LoopClosure("prismatic", srm.Anchor("block"), turned, (1.0, 0.0, 0.0), "guide")
    return tree.closed(loop, {"crank": 6.0}, crank=0.9, rod=-0.8, block=0.2)


@on_both
def test_a_slider_crank_whose_block_slides_in_a_prismatic_guide(backend: str) -> None:
    r, length, guide = 0.4, 1.0, 0.3
    along = (np.cos(guide), 0.0, -np.sin(guide))
    mechanism = guided_slider_crank()
    assert mechanism.degrees_of_freedom == 1
    assert len(mechanism.redundant_rows) == 3
    run = srm.simulate(mechanism, 2.5, rtol=RTOL, backend=backend)

    def rod_at(angle: Any) -> tuple[Any, Any]:
        """Rod's angle and the block's distance, from the guide and along it."""
        tilt = np.arcsin(-r * np.sin(angle) / length)
        return tilt, r * np.cos(angle) + length * np.cos(tilt)

    def inertia(crank: Any) -> Any:
        angle = crank - guide
        tilt, _ = rod_at(angle)
        slope = -r * np.cos(angle) / (length * np.cos(tilt))  # d tilt / d angle
        centre = (
            -r * np.sin(angle) - 0.5 * length * np.sin(tilt) * slope,
            r * np.cos(angle) + 0.5 * length * np.cos(tilt) * slope,
        )
        block = -r * np.sin(angle) - length * np.sin(tilt) * slope
        rod = 2.0 * (centre[0] ** 2 + centre[1] ** 2) + 0.1 * slope**2
        return 0.05 + rod + 3.0 * block**2

    crank = check_motion(run, "crank", inertia)
    assert crank[-1] - crank[0] > 4.0 * np.pi
    tilt, reach = rod_at(crank - guide)
    assert_close(crank + run.joint("rod")[0], tilt + guide, atol=1e-9)
    assert_close(crank + run.joint("rod")[0] + run.joint("block")[0], guide, atol=1e-9)
    data = mechanism.model.createData()
    for q, distance in zip(run.q[::20], reach[::20]):
        pin.forwardKinematics(mechanism.model, data, q)
        assert_close(data.oMi[3].translation, distance * np.array(along), atol=1e-9)


def scotch_yoke() -> srm.Mechanism:
    """A block, hinged to the crank, flat in the slot of a yoke that slides along gravity."""
    r, g = 0.5, 9.81
    tree = Tree((-g, 0.0, 0.0)).body("yoke", pin.JointModelPX(), mass=2.0)
    tree.body("crank", pin.JointModelRY(), inertia=0.4)
    tree.body("block", pin.JointModelRY(), "crank", (r, 0.0, 0.0), mass=0.7)
    loop = srm.LoopClosure(
        "planar", srm.Anchor("block"), srm.Anchor("yoke"), (1.0, 0.0, 0.0), "slot"
    )
    return tree.closed(loop, {"crank": 9.0}, crank=0.3)


@on_both
def test_a_scotch_yoke_with_a_block_flat_in_its_slot(backend: str) -> None:
    """x = r cos(a), and the block stays parallel to the slot."""
    r, g = 0.5, 9.81
    mechanism = scotch_yoke()
    assert mechanism.degrees_of_freedom == 1
    assert len(mechanism.redundant_rows) == 1
    run = srm.simulate(mechanism, 2.0, rtol=RTOL, backend=backend)
    crank = check_motion(
        run,
        "crank",
        lambda a: 0.4 + 0.7 * r**2 + 2.0 * (r * np.sin(a)) ** 2,
        lambda a: 2.7 * g * r * np.cos(a),
    )
    assert crank[-1] - crank[0] > 4.0 * np.pi
    assert_close(run.joint("yoke")[0], r * np.cos(crank), atol=1e-9)
    assert_close(run.joint("block")[0], -crank, atol=1e-9)


def elbow_coupling() -> srm.Mechanism:
    """The elbow coupling: a pin with legs along x and y in holes at radius r of two shafts.

    Leg x turns and slides in shaft a (about x), leg y in shaft b (about y) by the closure.  The pin
    never turns, so b = a, and both legs slide by r cos(a).  Past a = pi/2 momentum keeps it on this
    branch.
    """
    r, m = 0.4, 1.5
    tree = Tree().body("a", pin.JointModelRX(), inertia=0.2)
    tree.body("sleeve", pin.JointModelRX(), "a", (0.0, r, 0.0), mass=0.0, inertia=0.0)
    tree.body("pin", pin.JointModelPX(), "sleeve", mass=m)
    tree.body("b", pin.JointModelRY(), inertia=0.3)
    loop = srm.LoopClosure(
        "cylindrical",
        srm.Anchor("pin"),
        srm.Anchor("b", xyz=(r, 0.0, 0.0)),
        (0.0, 1.0, 0.0),
        "hole",
    )
    return tree.closed(loop, {"a": 4.0}, a=0.2, sleeve=-0.2, pin=r, b=-0.2)


@on_both
def test_a_bent_pin_that_slides_in_two_shafts_turns_them_alike(backend: str) -> None:
    r, m = 0.4, 1.5
    mechanism = elbow_coupling()
    assert mechanism.degrees_of_freedom == 1
    run = srm.simulate(mechanism, 2.0, rtol=RTOL, backend=backend)
    a = check_motion(run, "a", lambda a: 0.5 + m * r**2 * (1.0 + np.sin(a) ** 2))
    assert a[-1] > 2.0 * np.pi
    assert len(run.crossings) >= 2
    assert_close(run.joint("b")[0], -a, atol=1e-8)
    assert_close(run.joint("sleeve")[0], -a, atol=1e-8)
    assert_close(run.joint("pin")[0], r * np.cos(a), atol=1e-8)


def distance_four_bar() -> tuple[srm.Mechanism, Callable[[Any], tuple[FloatArray, float]]]:
    """Crank and rocker in a vertical plane, a massless rod between their tips; and their law.

    The law, by hand: (a, b) and rates -> accelerations and tension (N), with the rod's vector
    d = rocker tip - crank tip and phi = |d| - L.
    """
    crank, rocker, base, g = 0.5, 0.8, 1.1, 9.81
    tree = Tree((0.0, 0.0, -g))
    tree.body("crank", pin.JointModelRY(), mass=1.0, lever=(0.2, 0.0, 0.0), inertia=0.05)
    place = (base, 0.0, 0.0)
    tree.body("rocker", pin.JointModelRY(), at=place, mass=1.5, lever=(0.4, 0, 0), inertia=0.08)
    loop = srm.LoopClosure(
        "distance",
        srm.Anchor("rocker", xyz=(rocker, 0.0, 0.0)),
        srm.Anchor("crank", xyz=(crank, 0.0, 0.0)),
        name="rod",
    )
    start = srm.Mechanism(tree.model, (loop,), q0=[-0.6, -1.8])
    state = srm.assemble(start, v={"crank": 1.0})
    moved = np.array([0.05 + 0.2**2, 0.08 + 1.5 * 0.4**2])

    def rod(a: float, b: float) -> FloatArray:
        tip_a = crank * np.array([np.cos(a), -np.sin(a)])
        return rocker * np.array([np.cos(b), -np.sin(b)]) + np.array([base, 0.0]) - tip_a

    def law(x: Any) -> tuple[FloatArray, float]:
        a, b, a_rate, b_rate = x
        d = rod(a, b)
        along_a = crank * np.array([-np.sin(a), -np.cos(a)])
        along_b = rocker * np.array([-np.sin(b), -np.cos(b)])
        rate = along_b * b_rate - along_a * a_rate
        inward_a = -crank * np.array([np.cos(a), -np.sin(a)]) * a_rate**2
        inward_b = -rocker * np.array([np.cos(b), -np.sin(b)]) * b_rate**2
        size = np.linalg.norm(d)
        n = d / size
        gradient = np.array([-n @ along_a, n @ along_b])
        curved = n @ (inward_b - inward_a) + (rate @ rate - (n @ rate) ** 2) / size
        force = np.array([g * 0.2 * np.cos(a), 1.5 * g * 0.4 * np.cos(b)])
        tension = (gradient @ (force / moved) + curved) / (gradient @ (gradient / moved))
        return (force - gradient * tension) / moved, float(tension)

    assert start.loops[0].length == pytest.approx(np.linalg.norm(rod(-0.6, -1.8)), rel=1e-15)
    return start.with_state(state.q, state.v), law


@on_both
def test_a_four_bar_whose_coupler_is_a_distance(backend: str) -> None:
    mechanism, law = distance_four_bar()
    assert mechanism.degrees_of_freedom == 1
    t = np.linspace(0.0, 2.0, 21)[1:]
    run = srm.simulate(mechanism, 2.0, rtol=1e-10, backend=backend)
    start = [*mechanism.q0, *mechanism.v0]
    expected = trajectory(lambda t, x: [*x[2:], *law(x)[0]], start, t)
    assert_close(np.hstack(run(t)), expected, atol=1e-8)
    assert run.drift.max() < 1e-9
    assert np.abs(run.energy - run.energy[0]).max() < 1e-8
    # The rod pulls the crank (b) towards the rocker (a), along the line, without a moment.
    tension = np.array([law(x)[1] for x in np.hstack([run.q, run.v])])
    assert_close(run.reaction_multipliers["rod"][:, 0], tension, atol=1e-7)
    assert_close(np.linalg.norm(run.reactions["rod"][:, :3], axis=1), np.abs(tension), atol=1e-7)
    assert not run.reactions["rod"][:, 3:].any()


def geared_pair() -> srm.Mechanism:
    """A heavy arm geared to a wheel."""
    tree = Tree((0.0, 0.0, -9.81)).body("arm", pin.JointModelRY(), lever=(0.4, 0, 0))
    tree.body("wheel", pin.JointModelRY(), at=(1, 0, 0))
    loop = srm.LoopClosure("coupling", joints=("arm", "wheel"), ratio=-0.7, offset=0.2)
    return tree.closed(loop, {"arm": 1.0}, arm=0.3)


MECHANISMS: dict[str, Callable[[], srm.Mechanism]] = {
    "universal": hooke_joint,
    "prismatic": guided_slider_crank,
    "planar": scotch_yoke,
    "cylindrical": elbow_coupling,
    "coupling": geared_pair,
    "distance": lambda: distance_four_bar()[0],
}


@needs_kernel
@pytest.mark.parametrize("kind", MECHANISMS)
def test_the_kernel_repeats_every_attempt_of_the_reference(kind: str) -> None:
    agree(compare(MECHANISMS[kind](), 1.0, rtol=1e-8))


# --- assembly -----------------------------------------------------------------------------------

KINDS = ("prismatic", "cylindrical", "planar", "universal", "distance")


def tied_body(kind: str, rng: np.random.Generator) -> srm.Mechanism:
    """A free body tied to the ground, anchors and axes anywhere."""
    tree = Tree().body("body", pin.JointModelFreeFlyer())
    a, b = (
        srm.Anchor(link, xyz=tuple(rng.uniform(-1, 1, 3)), rpy=tuple(rng.uniform(-1.5, 1.5, 3)))
        for link in ("body", "world")
    )
    keys: dict[str, Any] = {"axis": tuple(rng.standard_normal(3))}
    if kind == "universal":
        keys = {f"axis_{side}": tuple(rng.standard_normal(3)) for side in "ab"}
    elif kind == "distance":
        keys = {"length": 0.7}
    elif kind in ("point", "frame"):
        keys = {}
    return srm.Mechanism(tree.model, (srm.LoopClosure(kind, a, b, name="tie", **keys),))


def relative(mechanism: srm.Mechanism, q: FloatArray) -> pin.SE3:
    """Placement of a in b."""
    data = mechanism.model.createData()
    pin.forwardKinematics(mechanism.model, data, q)
    Ta, Tb = (data.oMi[j] * inside for j, inside in mechanism.loops[0].resolve(mechanism.model))
    return Tb.actInv(Ta)


def turned_by(mechanism: srm.Mechanism, turn: FloatArray) -> FloatArray:
    """A configuration in which a is turned in b by the rotation vector ``turn``, and apart."""
    (_, in_a), (_, in_b) = mechanism.loops[0].resolve(mechanism.model)
    between = pin.SE3(Rotation.from_rotvec(turn).as_matrix(), np.array([0.3, -0.2, 0.4]))
    pose = in_b * between * in_a.inverse()
    return pin.SE3ToXYZQUAT(pose)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(2))
def test_a_closing_is_the_intended_one_also_from_a_reversed_guess(kind: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 77])
    mechanism = tied_body(kind, rng)
    (loop,) = mechanism.loops
    axis = np.array(loop.axis or rng.standard_normal(3))
    across = np.cross(axis, rng.standard_normal(3))
    guess = turned_by(mechanism, across / np.linalg.norm(across) * 3.1)
    if loop.axis is not None:
        assert axis @ relative(mechanism, guess).rotation @ axis < -0.99
    state = srm.assemble(mechanism, guess)
    found = relative(mechanism, state.q)
    assert state.free_directions.shape[1] == 6 - loop.rows.count
    p, R = found.translation, found.rotation
    if loop.axis is not None:
        assert_close(R @ axis, axis, atol=1e-11)
    if kind == "prismatic":
        assert_close(R, np.eye(3), atol=1e-11)
    if kind in ("prismatic", "cylindrical"):
        assert_close(p, axis * (axis @ p), atol=1e-11)
    elif kind == "planar":
        assert axis @ p == pytest.approx(0.0, abs=1e-11)
    elif kind == "universal":
        assert_close(p, 0.0, atol=1e-11)
        assert np.array(loop.axis_b) @ R @ np.array(loop.axis_a) == pytest.approx(0.0, abs=1e-11)
    elif kind == "distance":
        assert np.linalg.norm(p) == pytest.approx(0.7, abs=1e-11)


@pytest.mark.parametrize("seed", range(2))
def test_a_universal_joint_takes_the_sense_of_its_axes_that_is_nearest(seed: int) -> None:
    """The axes' senses are free: the body turns by what is missing to a right angle, not more."""
    rng = np.random.default_rng([seed, 78])
    mechanism = tied_body("universal", rng)
    (loop,) = mechanism.loops
    u, n = np.array(loop.axis_a), np.array(loop.axis_b)
    guess = turned_by(mechanism, rng.uniform(-2.0, 2.0, 3))
    cosine = n @ relative(mechanism, guess).rotation @ u
    state = srm.assemble(mechanism, guess)
    turn = relative(mechanism, guess).rotation.T @ relative(mechanism, state.q).rotation
    angle = np.linalg.norm(Rotation.from_matrix(turn).as_rotvec())
    missing = abs(np.arcsin(cosine))
    assert missing - 1e-9 <= angle < missing + 0.6


def test_a_guess_in_which_the_points_of_a_distance_coincide_is_refused() -> None:
    mechanism = tied_body("distance", np.random.default_rng(5))
    (loop,) = mechanism.loops
    (_, in_a), (_, in_b) = loop.resolve(mechanism.model)
    q = pin.SE3ToXYZQUAT(in_b * in_a.inverse())
    with pytest.raises(
        srm.InputError, match=r"initial\.guess: .*'tie' coincide.*another guess, or"
    ):
        srm.assemble(mechanism, q)
    bare = replace(loop, length=None)
    with pytest.raises(srm.InputError, match="loop 'tie': its two points coincide in the guess"):
        srm.Mechanism(mechanism.model, (bare,), q0=q)


# --- reactions ----------------------------------------------------------------------------------

ALL_KINDS = (
    *KINDS, "point", "frame", "revolute", "point_on_line", "point_on_plane"
)  # fmt: skip


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("kind", ALL_KINDS)
def test_reactions_are_what_a_free_body_needs_to_move_as_it_does(kind: str, swapped: bool) -> None:
    """Newton and Euler for a spinning body: rnea of its acceleration is the wrench on it."""
    rng = np.random.default_rng([KINDS.index(kind) if kind in KINDS else 9, 79])
    mechanism = tied_body(kind, rng)
    model = mechanism.model
    model.gravity.linear = np.array([1.0, -4.0, -9.81])
    (loop,) = mechanism.loops
    if swapped:
        loop = replace(loop, a=loop.b, b=loop.a)
        mechanism = srm.Mechanism(model, (loop,))
    state = srm.assemble(mechanism, v=rng.standard_normal(6))
    mechanism = mechanism.with_state(state.q, state.v)
    run = srm.simulate(mechanism, 0.01, step=0.01)
    system = make_system(mechanism)
    acceleration = system.evaluate(0.0, np.concatenate([state.q, state.v])).rate()[6:]
    data = model.createData()
    needed = pin.rnea(model, data, state.q, state.v, acceleration)  # force, moment: body's axes
    pin.forwardKinematics(model, data, state.q)
    (joint_b, in_b) = loop.resolve(model)[1]
    at_b = (data.oMi[joint_b] * in_b).translation
    given = run.reactions["tie"][0] * (1.0 if swapped else -1.0)
    force, moment = given[:3], given[3:] + np.cross(at_b - data.oMi[1].translation, given[:3])
    R = data.oMi[1].rotation
    assert_close(np.concatenate([R.T @ force, R.T @ moment]), needed, atol=1e-10)
    assert run.indeterminate_reactions == ()
    assert "tie" not in run.coupling_forces


@pytest.mark.parametrize("kind", KINDS)
def test_reactions_do_no_work_on_what_a_closure_leaves_free(kind: str) -> None:
    """Along a slide no force, about a free axis no moment: the wrench in the axes of b."""
    rng = np.random.default_rng([KINDS.index(kind), 80])
    mechanism = tied_body(kind, rng)
    mechanism.model.gravity.linear = np.array([1.0, -4.0, -9.81])
    (loop,) = mechanism.loops
    state = srm.assemble(mechanism, v=rng.standard_normal(6))
    run = srm.simulate(mechanism.with_state(state.q, state.v), 0.01, step=0.01)
    _, (_, in_b) = loop.resolve(mechanism.model)
    wrench = run.reactions["tie"][0]
    force, moment = in_b.rotation.T @ wrench[:3], in_b.rotation.T @ wrench[3:]
    assert np.linalg.norm(wrench) > 0.1
    axis = np.array(loop.axis or (0.0, 0.0, 1.0))
    free_directions, free_axes = {
        "prismatic": ([axis], []),
        "cylindrical": ([axis], [axis]),
        "planar": (perpendicular_basis(axis), [axis]),
        "universal": ([], [loop.axis_b]),
        "distance": ([], np.eye(3)),
    }[kind]
    for direction in free_directions:
        assert np.array(direction) @ force == pytest.approx(0.0, abs=1e-10)
    for line in free_axes:
        assert np.array(line) @ moment == pytest.approx(0.0, abs=1e-10)
