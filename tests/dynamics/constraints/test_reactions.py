"""Reactions: known forces of static and moving mechanisms, work, and redundant closures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import null_space

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.reactions import reactions_at
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.forces import ForceKinematics
from srm_mbs.dynamics.multibody import ClosedSystem, make_system
from tests.support.bundled import load
from tests.support.mechanisms import (
    ANCHORED_MODELS,
    CLOSED_MODELS,
    add_link,
    along_x,
    floating_ring,
    rod,
)

assert_close = partial(np.testing.assert_allclose, rtol=0.0)

G = 9.81
every_closed_model = pytest.mark.parametrize("name", CLOSED_MODELS)
every_anchored_model = pytest.mark.parametrize("name", ANCHORED_MODELS)


def at_state(
    mechanism: srm.Mechanism, q: FloatArray, v: FloatArray
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Wrenches (6,) and multipliers (rows,) of every loop at one state."""
    system = make_system(mechanism)
    found = reactions_at(system, np.zeros(1), q[None], v[None])
    wrenches, multipliers = (
        {name: rows[0] for name, rows in table.items()}
        for table in (found.closures, found.multipliers)
    )
    return wrenches, multipliers


def jacobian(mechanism: srm.Mechanism, q: FloatArray) -> FloatArray:
    """G (rows, nv) of all rows at q (nq,)."""
    rows = LoopKinematics(mechanism.model, mechanism.loops)
    rows.evaluate(mechanism.model, mechanism.model.createData(), q)
    return rows.G


def wrench(mechanism: srm.Mechanism, v: FloatArray | None = None) -> FloatArray:
    """Wrench (6,) of the only loop at the start."""
    wrenches, _ = at_state(mechanism, mechanism.q0, mechanism.v0 if v is None else v)
    (only,) = wrenches.values()
    return only


# --- known forces -------------------------------------------------------------------------------


def propped_bar(angle: float, swapped: bool = False) -> srm.Mechanism:
    """A bar (2 kg, 1.5 m) on a hinge at the origin, its tip held by the ground."""
    model = pin.Model()
    hinge = pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))
    add_link(model, 0, hinge, "bar", rod(2.0, 1.5))
    tip = srm.Anchor("bar", xyz=(1.5, 0.0, 0.0))
    hook = srm.Anchor("world", xyz=(1.5 * np.cos(angle), 0.0, 1.5 * np.sin(angle)))
    a, b = (hook, tip) if swapped else (tip, hook)
    return srm.Mechanism(model, (srm.LoopClosure("point", a, b, name="hook"),), np.array([angle]))


@pytest.mark.parametrize("angle", [0.0, 0.7, -1.2, 3.0])
def test_a_propped_bar_presses_on_its_hook_with_half_its_weight_across(angle: float) -> None:
    """Moments about the hinge; along the bar hinge and hook share: the least force is none."""
    mechanism = propped_bar(angle)
    across = np.array([-np.sin(angle), 0.0, np.cos(angle)])
    expected = -0.5 * 2.0 * G * np.cos(angle) * across  # bar a on ground b
    assert_close(wrench(mechanism), [*expected, 0, 0, 0], atol=1e-13)


def test_swapping_the_anchors_of_a_ball_reverses_its_force() -> None:
    assert_close(wrench(propped_bar(0.7, swapped=True)), -wrench(propped_bar(0.7)), atol=1e-13)


def free_body(mass: float, lever: tuple[float, float, float]) -> pin.Model:
    model = pin.Model()
    inertia = pin.Inertia(mass, np.array(lever), np.diag([0.3, 0.4, 0.5]))
    add_link(model, 0, pin.JointModelFreeFlyer(), "body", inertia)
    return model


def pose(rpy: tuple[float, float, float], xyz: tuple[float, float, float]) -> pin.SE3:
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz))


def anchor(link: str, placement: pin.SE3) -> srm.Anchor:
    rpy = tuple(pin.rpy.matrixToRpy(placement.rotation))
    return srm.Anchor(link, xyz=tuple(placement.translation), rpy=rpy)


@pytest.mark.parametrize("swapped", [False, True], ids=["body on ground", "ground on body"])
def test_a_welded_weight_loads_its_weld_with_its_weight_and_moment(swapped: bool) -> None:
    """Off-centre weight, anchors turned and offset on both sides."""
    placement = pose((0.3, -0.5, 1.1), (0.4, -0.2, 0.9))
    inside = pose((-1.0, 0.2, 0.6), (0.1, 0.3, -0.2))
    lever = (0.25, -0.1, 0.4)
    q = pin.SE3ToXYZQUAT(placement)
    body, ground = anchor("body", inside), anchor("world", placement * inside)
    a, b = (ground, body) if swapped else (body, ground)
    loop = srm.LoopClosure("frame", a, b, name="weld")
    mechanism = srm.Mechanism(free_body(3.0, lever), (loop,), q)
    assert mechanism.degrees_of_freedom == 0
    origin = (placement * inside).translation
    weight = np.array([0.0, 0.0, -3.0 * G])
    moment = np.cross(placement.act(np.array(lever)) - origin, weight)
    expected = np.concatenate([weight, moment])
    found = wrench(mechanism)
    assert_close(found, -expected if swapped else expected, atol=1e-12)
    assert np.linalg.norm(moment) > 1.0


def hinged_rod(angle: float) -> srm.Mechanism:
    """A rod (2 kg, 1.5 m) that only a revolute closure holds, in the x-z plane."""
    placement = pin.SE3(pin.exp3(np.array([0.0, -angle, 0.0])), np.zeros(3))
    model = pin.Model()
    add_link(model, 0, pin.JointModelFreeFlyer(), "rod", rod(2.0, 1.5))
    loop = srm.LoopClosure(
        "revolute", srm.Anchor("rod"), srm.Anchor("world"), (0.0, -1.0, 0.0), name="hinge"
    )
    return srm.Mechanism(model, (loop,), pin.SE3ToXYZQUAT(placement))


@pytest.mark.parametrize("rate", [0.0, 3.0])
@pytest.mark.parametrize("angle", [0.0, 0.6, -np.pi / 2])
def test_a_swinging_rod_loads_its_hinge_with_weight_and_inertia(angle: float, rate: float) -> None:
    """theta'' = -3 g cos / (2 l); the hinge feels the weight less m a of the centre of mass."""
    mechanism = hinged_rod(angle)
    m, length = 2.0, 1.5
    acceleration = -1.5 * G * np.cos(angle) / length
    along = np.array([np.cos(angle), 0.0, np.sin(angle)])
    across = np.array([-np.sin(angle), 0.0, np.cos(angle)])
    inertia = m * 0.5 * length * (acceleration * across - rate**2 * along)
    force = np.array([0.0, 0.0, -m * G]) - inertia
    found = wrench(mechanism, np.array([0, 0, 0, 0, -rate, 0]))
    assert_close(found, [*force, 0, 0, 0], atol=1e-11)


def test_a_hinge_out_of_the_plane_of_the_load_feels_a_moment() -> None:
    """Rod along the hinge axis: a cantilever, free to turn about itself."""
    model = pin.Model()
    add_link(model, 0, pin.JointModelFreeFlyer(), "rod", rod(2.0, 1.5))
    loop = srm.LoopClosure("revolute", srm.Anchor("rod"), srm.Anchor("world"), (1, 0, 0))
    mechanism = srm.Mechanism(model, (loop,))
    expected = [0.0, 0.0, -2.0 * G, 0.0, 0.75 * 2.0 * G, 0.0]  # (0.75, 0, 0) x weight
    assert_close(wrench(mechanism), expected, atol=1e-12)


@pytest.mark.parametrize("angle", [7 * np.pi / 4, 0.3, 2.0, 4.6])
@pytest.mark.parametrize("rate", [0.0, 3.0])
def test_the_plane_of_the_slider_crank_feels_the_force_of_the_rods_equation(
    angle: float, rate: float
) -> None:
    """Lagrange's equation of the rod's own angle phi, with N the force of the plane on its tip:

    (4/3) phi'' + 2 th'' cos(th - phi) - 2 th'^2 sin(th - phi) = (2 N - g) cos phi,  phi = -th.
    """
    s, c = np.sin(angle), np.cos(angle)
    acceleration = (-4.0 * s * c * rate**2 - G * c) / (4.0 / 3.0 + 4.0 * s * s)
    left = -4.0 / 3.0 * acceleration + 2.0 * acceleration * np.cos(2 * angle)
    left -= 2.0 * rate**2 * np.sin(2 * angle)
    normal = 0.5 * (left / c + G)
    mechanism = load("slider_crank")
    wrenches, multipliers = at_state(
        mechanism, np.array([angle, -2 * angle]), np.array([rate, -2 * rate])
    )
    # The rod a presses on the ground b; the moment is about the ground's origin.
    expected = [0.0, 0.0, -normal, 0.0, 4.0 * c * normal, 0.0]
    assert_close(wrenches["pin"], expected, atol=1e-11 / abs(c))
    assert_close(multipliers["pin"], [-normal], atol=1e-11 / abs(c))


@pytest.mark.parametrize("crank_rate", [0.0, 4.0, -7.0])
def test_every_bar_of_the_four_bar_obeys_newton_and_euler(crank_rate: float) -> None:
    """The closure's force on the rocker and the coupler, against plane dynamics of each bar."""
    mechanism = load("four_bar")
    q = mechanism.q0
    v = mechanism.v0 * (crank_rate / mechanism.v0[0])
    rate = make_system(mechanism).evaluate(0.0, np.concatenate([q, v])).rate()
    acceleration = rate[3:]
    wrenches, _ = at_state(mechanism, q, v)
    force = wrenches["pin"][[0, 2]]  # of the coupler on the rocker, in the x-z plane
    assert wrenches["pin"][1] == pytest.approx(0.0, abs=1e-12)
    weight = np.array([0.0, -G])

    def moment(r: FloatArray, f: FloatArray) -> float:
        return float(r[0] * f[1] - r[1] * f[0])

    def bar(angle: float, speed: float, turn: float) -> tuple[FloatArray, FloatArray]:
        along, across = np.array([np.cos(angle), np.sin(angle)]), [-np.sin(angle), np.cos(angle)]
        return along, turn * np.array(across) - speed**2 * along

    # Rocker: 1.5 kg, 1.5 m, about its ground pivot.
    along, _ = bar(q[2], v[2], acceleration[2])
    euler = moment(1.5 * along, force) + moment(0.75 * along, 1.5 * weight)
    assert euler == pytest.approx(1.5 * 1.5**2 / 3.0 * acceleration[2], abs=1e-10)
    # Coupler: 2 kg, 2 m; the force of the crank follows from Newton and must satisfy Euler.
    crank_along, crank_tip = bar(q[0], v[0], acceleration[0])
    along, relative = bar(q[0] + q[1], v[0] + v[1], acceleration[0] + acceleration[1])
    at_crank = 2.0 * (crank_tip + relative) - 2.0 * weight + force
    euler = moment(along, -force) + moment(-along, at_crank)
    assert euler == pytest.approx(2.0 * 2.0**2 / 12.0 * (acceleration[:2].sum()), abs=1e-10)
    # Crank: 1 kg, 1 m, about its ground pivot.
    euler = moment(crank_along, -at_crank) + moment(0.5 * crank_along, weight)
    assert euler == pytest.approx(acceleration[0] / 3.0, abs=1e-10)


# --- work and dynamics --------------------------------------------------------------------------


def body_twists(
    mechanism: srm.Mechanism, q: FloatArray, v: FloatArray
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Twists (6,) of both bodies of each loop at b's origin, in world axes."""
    data = mechanism.model.createData()
    pin.forwardKinematics(mechanism.model, data, q, v)
    out = {}
    for loop in mechanism.loops:
        joint_b, in_b = loop.b.resolve(mechanism.model)
        origin = (data.oMi[joint_b] * in_b).translation
        both = []
        for anchor_ in (loop.a, loop.b):
            joint, _ = anchor_.resolve(mechanism.model)
            twist = data.oMi[joint].act(data.v[joint])
            linear = twist.linear + np.cross(twist.angular, origin)
            both.append(np.concatenate([linear, twist.angular]))
        out[loop.name] = (both[0], both[1])
    return out


@every_anchored_model
def test_reactions_do_no_work_in_admissible_motions(name: str) -> None:
    mechanism = load(name)
    q = mechanism.q0
    wrenches, _ = at_state(mechanism, q, mechanism.v0)
    free = null_space(jacobian(mechanism, q))
    assert free.shape[1] == mechanism.degrees_of_freedom
    for direction in free.T:
        twists = body_twists(mechanism, q, direction)
        power = sum(wrenches[k] @ (b - a) for k, (a, b) in twists.items())
        scale = sum(np.abs(w).max() for w in wrenches.values())
        assert power == pytest.approx(0.0, abs=1e-11 * max(1.0, scale))
    against = np.random.default_rng(0).standard_normal(mechanism.model.nv)
    twists = body_twists(mechanism, q, against)
    assert abs(sum(wrenches[k] @ (b - a) for k, (a, b) in twists.items())) > 1e-2


@every_closed_model
def test_multipliers_of_a_run_balance_the_equations_of_motion(name: str) -> None:
    """M a = f - G^T lam at every state of a run, with all rows and in their own units."""
    mechanism = load(name)
    model, nv = mechanism.model, mechanism.model.nv
    t_end = min(0.3, mechanism.defaults.t_end or np.inf)
    run = srm.simulate(mechanism, t_end, rtol=1e-7, t_eval=np.linspace(0.0, t_end, 7))
    assert run.success
    lam = np.hstack([run.reaction_multipliers[loop.name] for loop in mechanism.loops])
    system = make_system(mechanism)
    forces = ForceKinematics(model, mechanism.forces)
    data = model.createData()
    for i, (q, v) in enumerate(zip(run.q, run.v)):
        a = system.evaluate(0.0, np.concatenate([q, v])).rate()[nv:]
        pin.crba(model, data, q, pin.Convention.WORLD)
        pin.nonLinearEffects(model, data, q, v)
        elements = forces.generalised(data, q, v, 0.0)
        inverse_dynamics = pin.rnea(model, data, q, v, a) - elements + model.damping * v
        scale = max(1.0, float(np.abs(inverse_dynamics).max()))
        assert_close(inverse_dynamics, -jacobian(mechanism, q).T @ lam[i], atol=1e-10 * scale)
    assert np.abs(lam).max() > 0.1


@every_anchored_model
def test_wrenches_act_on_the_joints_as_the_multipliers_do(name: str) -> None:
    mechanism = load(name)
    q = mechanism.q0
    wrenches, multipliers = at_state(mechanism, q, mechanism.v0)
    lam = np.concatenate([multipliers[loop.name] for loop in mechanism.loops])
    G = jacobian(mechanism, q)
    for e in np.eye(mechanism.model.nv):
        power = sum(wrenches[k] @ (b - a) for k, (a, b) in body_twists(mechanism, q, e).items())
        assert power == pytest.approx(-lam @ G @ e, abs=1e-11 * max(1.0, np.abs(lam).max()))


def test_applied_forces_and_damping_enter_the_reactions() -> None:
    """The propped bar again: a torque at the hinge is taken by the hook; damping at rest is not."""
    mechanism = propped_bar(0.4)
    system = make_system(mechanism, lambda t, q, v: np.array([6.0 + t]))
    pushed = reactions_at(system, np.array([1.5]), mechanism.q0[None], mechanism.v0[None]).closures
    across = np.array([-np.sin(0.4), 0.0, np.cos(0.4)])
    expected = wrench(mechanism)[:3] + 7.5 / 1.5 * across
    assert_close(pushed["hook"][0], [*expected, 0, 0, 0], atol=1e-13)


@every_closed_model
def test_reactions_are_linear_in_gravity_at_rest_and_in_all_masses(name: str) -> None:
    mechanism = load(name)
    rest = np.zeros(mechanism.model.nv)
    model = mechanism.model.copy()
    model.gravity.linear = np.array([0.0, 0.0, -9.81])
    plain, _ = at_state(srm.Mechanism(model, mechanism.loops, mechanism.q0), mechanism.q0, rest)
    model = model.copy()
    model.gravity.linear = 3.0 * model.gravity.linear
    for j in range(1, model.njoints):
        i = model.inertias[j]
        model.inertias[j] = pin.Inertia(2.0 * i.mass, i.lever, 2.0 * i.inertia)
    loaded, _ = at_state(srm.Mechanism(model, mechanism.loops, mechanism.q0), mechanism.q0, rest)
    for loop, own in plain.items():
        assert_close(loaded[loop], 6.0 * own, atol=1e-10)


def test_a_floating_ring_without_gravity_at_rest_has_no_reactions() -> None:
    ring = floating_ring()
    wrenches, _ = at_state(ring, ring.q0, np.zeros(ring.model.nv))
    assert_close(wrenches["ring"], 0.0, atol=1e-14)
    wrenches, _ = at_state(ring, ring.q0, ring.v0)
    assert np.abs(wrenches["ring"][:3]).max() > 0.1
    assert_close(wrenches["ring"][3:], 0.0, atol=1e-13)


# --- redundancy ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["slider_crank_slider", "four_bar", "five_bar", "n_four_bar_2"])
def test_a_planar_loop_closed_by_a_ball_has_no_force_out_of_its_plane(name: str) -> None:
    mechanism = load(name)
    wrenches, multipliers = at_state(mechanism, mechanism.q0, mechanism.v0)
    for loop in mechanism.loops:
        assert multipliers[loop.name][1] == pytest.approx(0.0, abs=1e-14)
        assert wrenches[loop.name][1] == pytest.approx(0.0, abs=1e-14)
        assert np.abs(wrenches[loop.name][[0, 2]]).max() > 0.1


@pytest.mark.parametrize("name", ["slider_crank", "four_bar", "spatial_four_bar", "n_four_bar_2"])
def test_a_duplicated_loop_shares_its_force_equally(name: str) -> None:
    mechanism = load(name)
    copies = tuple(replace(loop, name=f"{loop.name}_again") for loop in mechanism.loops)
    doubled = srm.Mechanism(mechanism.model, mechanism.loops + copies, mechanism.q0, mechanism.v0)
    plain, _ = at_state(mechanism, mechanism.q0, mechanism.v0)
    found, _ = at_state(doubled, mechanism.q0, mechanism.v0)
    for loop, own in plain.items():
        assert_close(found[loop], 0.5 * own, atol=1e-10)
        assert_close(found[f"{loop}_again"], 0.5 * own, atol=1e-10)


@cache
def moving_bricard() -> tuple[srm.Mechanism, FloatArray, FloatArray]:
    """Bricard's linkage somewhere on its motion, and its state there."""
    mechanism = load("bricard")
    run = srm.simulate(mechanism, 1.3, rtol=1e-9)
    return mechanism, run.q[-1], run.v[-1]


def test_reactions_of_an_overconstrained_loop_have_the_least_norm() -> None:
    mechanism, q, v = moving_bricard()
    _, multipliers = at_state(mechanism, q, v)
    scale = mechanism.structure.row_scale
    lam = multipliers["hinge_6"] * scale
    left, singular, _ = np.linalg.svd(jacobian(mechanism, q) / scale[:, None])
    assert singular[4] < 1e-8 < 1e-2 < singular[3]
    # Nothing along the combination of rows that forces nothing.
    assert left[:, 4] @ lam == pytest.approx(0.0, abs=1e-6)
    assert np.linalg.norm(lam) > 1.0


@pytest.mark.parametrize("size", [1e-15, 1e-13, 1e-11, 1e-9])
def test_reactions_of_an_overconstrained_loop_do_not_feel_small_closure_errors(
    size: float,
) -> None:
    """Off the manifold by ``size`` its fifth row is no longer redundant, by about ``size``."""
    mechanism, q, v = moving_bricard()
    expected, _ = at_state(mechanism, q, v)
    for seed in range(5):
        delta = size * np.random.default_rng(seed).standard_normal(5)
        found, _ = at_state(mechanism, pin.integrate(mechanism.model, q, delta), v)
        assert_close(found["hinge_6"], expected["hinge_6"], atol=1e-9 + 1e3 * size)


# --- shapes -------------------------------------------------------------------------------------


def test_an_open_chain_has_no_reactions() -> None:
    mechanism = load("pendulum_chain")
    assert at_state(mechanism, mechanism.q0, mechanism.v0) == ({}, {})


def test_a_loop_that_is_always_satisfied_transmits_nothing() -> None:
    model = pin.Model()
    add_link(model, 0, pin.JointModelRY(), "bar", at=along_x(0.3))
    loop = srm.LoopClosure(
        "point_on_plane", srm.Anchor("bar", xyz=(1, 0, 0)), srm.Anchor("world"), (0, 1, 0), "plane"
    )
    wrenches, multipliers = at_state(srm.Mechanism(model, (loop,)), np.zeros(1), np.ones(1))
    np.testing.assert_array_equal(wrenches["plane"], np.zeros(6))
    np.testing.assert_array_equal(multipliers["plane"], np.zeros(1))


def test_reactions_of_a_run_have_one_row_per_time_and_keep_the_runs_data() -> None:
    mechanism = load("n_four_bar_2")
    run = srm.simulate(mechanism, 0.2, rtol=1e-6)
    q, v = run.q.copy(), run.v.copy()
    assert set(run.reactions) == {"pin_0", "pin_1"}
    for name in run.reactions:
        assert run.reactions[name].shape == (len(run.t), 6)
        assert run.reaction_multipliers[name].shape == (len(run.t), 3)
        # Position rows of a ball with anchor b on the rotating crank: forces in the crank's axes.
        force = run.reactions[name][:, :3]
        size = np.linalg.norm(run.reaction_multipliers[name], axis=1)
        assert_close(np.linalg.norm(force, axis=1), size, rtol=1e-12)
    np.testing.assert_array_equal(run.q, q)
    np.testing.assert_array_equal(run.v, v)
    first, _ = at_state(mechanism, run.q[0], run.v[0])
    assert_close(
        run.reactions["pin_1"][0], first["pin_1"], atol=1e-12 * np.abs(first["pin_1"]).max()
    )
    by_reference = srm.simulate(mechanism, 0.2, rtol=1e-6, backend="python")
    first, _ = at_state(mechanism, by_reference.q[0], by_reference.v[0])
    np.testing.assert_array_equal(by_reference.reactions["pin_1"][0], first["pin_1"])


def test_reactions_do_not_change_the_system_they_are_computed_with() -> None:
    mechanism = load("four_bar")
    system = make_system(mechanism)
    assert isinstance(system, ClosedSystem)
    state = np.concatenate([mechanism.q0, mechanism.v0])
    before = system.evaluate(0.0, state).rate().copy()
    resting = np.tile(mechanism.q0, (2, 1))
    reactions_at(system, np.zeros(2), resting, 0.0 * resting)
    np.testing.assert_array_equal(system.evaluate(0.0, state).rate(), before)
