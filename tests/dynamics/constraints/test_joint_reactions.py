"""Reactions of the joints: free-body balances of every body, forces on the axes, indeterminacy."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from tests.support.bundled import finished, load
from tests.support.mechanisms import DISTINCT_MODELS, add_link, along_x, floating_ring, rod

assert_close = partial(np.testing.assert_allclose, rtol=0.0)

G = 9.81
PARTS = ("fx", "fy", "fz", "mx", "my", "mz")
T_END = 0.3
"""Length (s) of the runs."""
every_model = pytest.mark.parametrize("name", [*DISTINCT_MODELS, "n_four_bar_5"])


def output_times(name: str) -> np.ndarray:
    """Seven times; the crank of the squeezing mechanism makes more than two turns in 0.03 s."""
    return np.linspace(0.0, 0.03 if name == "squeezing_mechanism" else T_END, 7)


class FreeBody:
    """The forces on one body at one time, with their moments about the world origin."""

    def __init__(self) -> None:
        self.force, self.moment = np.zeros(3), np.zeros(3)
        self.largest = np.zeros(2)

    def add(self, at: FloatArray, force: FloatArray, moment: FloatArray | None = None) -> None:
        turning = np.cross(at, force) + (0.0 if moment is None else moment)
        self.force, self.moment = self.force + force, self.moment + turning
        sizes = np.linalg.norm(force), np.linalg.norm(turning)
        self.largest = np.maximum(self.largest, sizes)


def spring_force(
    force: srm.SpringDamper, places: dict[str, pin.SE3], rates: dict[str, Any]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points of both ends, and the force on the first, of k (l - l0) + d l'."""
    ends, speeds = [], []
    for anchor in (force.a, force.b):
        assert anchor.link is not None
        ends.append(places[anchor.link].act(np.array(anchor.xyz)))
        v, w = rates[anchor.link]
        speeds.append(v + np.cross(w, ends[-1] - places[anchor.link].translation))
    apart, rate = ends[0] - ends[1], speeds[0] - speeds[1]
    length = np.linalg.norm(apart)
    line = apart / length
    pull = force.stiffness * (length - (force.rest_length or 0.0)) + force.damping * (rate @ line)
    return ends[0], ends[1], -pull * line


def imbalance(solution: srm.Solution) -> float:
    """Largest part of m a_c and of dL/dt about the world origin, of every body, that the reactions,
    weights, springs, wrenches and forces of the user leave open, over the largest of them."""
    mechanism = solution.mechanism
    model = mechanism.model
    data = model.createData()
    body = pin.FrameType.BODY
    joints = solution.joint_reactions
    worst = 0.0
    for i, (t, q, v, a) in enumerate(
        zip(solution.t, solution.q, solution.v, solution.accelerations)
    ):
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        places = {"world": pin.SE3.Identity()}
        rates = {"world": (np.zeros(3), np.zeros(3))}
        on = {"world": 0}
        for frame in model.frames:
            if frame.type == body:
                placement = data.oMi[frame.parentJoint] * frame.placement
                velocity = frame.placement.actInv(data.v[frame.parentJoint])
                R = placement.rotation
                places[frame.name] = placement
                rates[frame.name] = R @ velocity.linear, R @ velocity.angular
                on[frame.name] = frame.parentJoint
        bodies = [FreeBody() for _ in range(model.njoints)]
        for name, wrenches in joints.items():
            j = model.getJointId(name)
            at, (force, moment) = data.oMi[j].translation, np.split(wrenches[i], 2)
            bodies[j].add(at, force, moment)
            bodies[model.parents[j]].add(at, -force, -moment)
        for loop in mechanism.loops:
            if not loop.anchors:
                continue
            (ja, _), (jb, inside) = loop.resolve(model)
            at, (force, moment) = (
                (data.oMi[jb] * inside).translation,
                np.split(solution.reactions[loop.name][i], 2),
            )
            bodies[jb].add(at, force, moment)
            bodies[ja].add(at, -force, -moment)
        for drive in mechanism.drives:
            if drive.a is None or drive.b is None:
                continue
            (ja, Ma), (jb, Mb) = (anchor.resolve(model) for anchor in (drive.a, drive.b))
            Ta, Tb = data.oMi[ja] * Ma, data.oMi[jb] * Mb
            gap = Ta.translation - Tb.translation
            line = gap / np.linalg.norm(gap) if drive.distance else Tb.rotation @ drive.axis
            push = solution.drive_forces[drive.name][i] * line
            bodies[ja].add(Ta.translation, push)
            bodies[jb].add(Ta.translation, -push)
        for element in mechanism.forces:
            if isinstance(element, srm.SpringDamper):
                at_a, at_b, pull = spring_force(element, places, rates)
                bodies[on[element.a.where]].add(at_a, pull)
                bodies[on[element.b.where]].add(at_b, -pull)
            elif isinstance(element, srm.Wrench):
                placement = places[element.at.where]
                factor = 1.0 if element.law is None else element.law.curve()(t)[0]
                force, moment = factor * np.array(element.force), factor * np.array(element.moment)
                if element.frame == "link":
                    turned = pin.rpy.rpyToMatrix(np.array(element.at.rpy))
                    force, moment = (placement.rotation @ turned @ x for x in (force, moment))
                at = placement.act(np.array(element.at.xyz))
                bodies[on[element.at.where]].add(at, force, moment)
            elif isinstance(element, srm.UserForce) and element.at is not None:
                given = np.asarray(element.function(t, q, v))
                at = places[element.at.where].act(np.array(element.at.xyz))
                bodies[on[element.at.where]].add(at, given[:3], given[3:])
            else:
                assert getattr(element, "a", None) is None, "a force that this balance lacks"
        for j in range(1, model.njoints):
            inertia, R = model.inertias[j], data.oMi[j].rotation
            w, turn = data.v[j].angular, data.a[j].angular
            lever = inertia.lever
            speed = data.v[j].linear + np.cross(w, lever)
            acceleration = data.a[j].linear + np.cross(turn, lever) + np.cross(w, speed)
            spin = inertia.inertia @ turn + np.cross(w, inertia.inertia @ w)
            centre = data.oMi[j].act(lever)
            bodies[j].add(centre, inertia.mass * model.gravity.linear)
            bodies[j].add(centre, -inertia.mass * (R @ acceleration), -(R @ spin))
        sizes = np.max([own.largest for own in bodies[1:]], axis=0)
        for own in bodies[1:]:
            left = np.array([np.linalg.norm(own.force), np.linalg.norm(own.moment)])
            worst = max(worst, float((left / np.where(sizes > 0.0, sizes, 1.0)).max()))
    return worst


def on_axes(solution: srm.Solution) -> dict[str, FloatArray]:
    """Part (n,) of each reaction that does work on a joint of one degree of freedom."""
    model = solution.mechanism.model
    data = model.createData()
    found = {}
    for name, wrenches in solution.joint_reactions.items():
        joint = solution.mechanism.joint(name)
        if joint.nv != 1:
            continue
        rows = []
        for q, wrench in zip(solution.q, wrenches):
            pin.computeJointJacobians(model, data, q)
            frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            J = pin.getJointJacobian(model, data, model.getJointId(name), frame)
            rows.append(J.reshape(6, -1)[:, joint.idx_v] @ wrench)
        found[name] = np.array(rows)
    return found


# --- every body is in balance ---------------------------------------------------------------------


@every_model
def test_every_body_of_every_bundled_mechanism_is_in_balance(name: str) -> None:
    times = output_times(name)
    run = finished(load(name), times[-1], t_eval=times)
    assert set(run.joint_reactions) == set(run.mechanism.joint_names)
    assert imbalance(run) < 1e-9


@every_model
def test_joints_without_forces_on_their_axes_carry_none_there(name: str) -> None:
    """What is left on an axis is damping, friction, springs, torques, drives and couplings, all but
    the last two from their definitions; the closures hold to the drift of the run."""
    mechanism = load(name)
    times = output_times(name)
    run = finished(mechanism, times[-1], t_eval=times, rtol=1e-9)
    model = mechanism.model
    expected = -model.damping * run.v
    if model.friction.any():
        expected -= model.friction * np.tanh(run.v / mechanism.friction_speed)
    for force in mechanism.forces:
        if isinstance(force, srm.TorsionSpring):
            angle, rate = run.joint(force.joint)
            at = mechanism.joint(force.joint).idx_v
            expected[:, at] -= force.stiffness * (angle - force.rest_angle) + force.damping * rate
        elif isinstance(force, srm.JointTorque):
            expected[:, mechanism.joint(force.joint).idx_v] += force.torque
    for drive in mechanism.drives:
        assert drive.joint is not None
        expected[:, mechanism.joint(drive.joint).idx_v] += run.drive_forces[drive.name]
    for loop in mechanism.loops:
        for joint, own in zip(loop.joints or (), run.coupling_forces.get(loop.name, np.zeros(0)).T):
            expected[:, mechanism.joint(joint).idx_v] += own
    sizes = [np.abs(rows).max() for rows in run.joint_reactions.values()]
    for joint, found in on_axes(run).items():
        own = expected[:, mechanism.joint(joint).idx_v]
        assert_close(found, own, atol=1e-7 * max(1.0, *sizes))


# --- known forces ---------------------------------------------------------------------------------


def pendulum(**more: Any) -> srm.Mechanism:
    model = pin.Model()
    add_link(model, 0, pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0])), "bar", rod())
    for name, value in more.pop("of_model", {}).items():
        setattr(model, name, np.array([value]))
    return srm.Mechanism(model, q0=np.array([0.4]), v0=np.array([1.5]), **more)


def test_a_pendulum_hangs_on_its_hinge_with_weight_and_centrifugal_force() -> None:
    """theta'' = -3 g cos / (2 l) for a uniform rod, theta from the horizontal."""
    run = finished(pendulum(), 0.5, rtol=1e-10)
    angle, rate = run.joint("bar")
    acceleration = -1.5 * G * np.cos(angle)
    along = np.column_stack([np.cos(angle), 0.0 * angle, np.sin(angle)])
    across = np.column_stack([-np.sin(angle), 0.0 * angle, np.cos(angle)])
    force = 0.5 * (acceleration[:, None] * across - rate[:, None] ** 2 * along)
    force[:, 2] += G
    assert_close(run.joint_reactions["bar"][:, :3], force, atol=1e-10)
    assert_close(run.joint_reactions["bar"][:, 3:], 0.0, atol=1e-10)


def test_the_moment_on_an_axis_is_what_acts_on_the_joint_less_what_turns_the_rotor() -> None:
    """Controller, damping and friction act between parent and child; armature is no part of it."""
    mechanism = pendulum(of_model={"damping": 0.3, "friction": 0.2, "armature": 0.7})
    run = finished(mechanism, 0.5, controller=lambda t, q, v: np.array([2.0 + t]))
    (rate,) = run.v.T
    friction = 0.2 * np.tanh(rate / mechanism.friction_speed)
    rotor = 0.7 * run.accelerations[:, 0]
    expected = 2.0 + run.t - 0.3 * rate - friction - rotor
    assert_close(on_axes(run)["bar"], expected, atol=1e-11)
    assert imbalance(run) < 1e-12


def assembled(mechanism: srm.Mechanism) -> srm.Mechanism:
    start = srm.assemble(mechanism)
    return mechanism.with_state(start.q, start.v)


def test_a_drive_acts_on_the_axis_of_its_joint() -> None:
    drive = srm.Drive(srm.ConstantSpeed(2.0), joint="crank")
    mechanism = replace(load("four_bar"), drives=(drive,))
    run = finished(assembled(mechanism), 0.5)
    assert_close(on_axes(run)["crank"], run.drive_forces["crank"], atol=1e-7)
    assert np.abs(run.drive_forces["crank"]).max() > 1.0
    assert imbalance(run) < 1e-9


def loaded_ring() -> srm.Mechanism:
    """Four rods in a ring of ball joints, free in space, with every element between links."""
    ring = floating_ring(pin.JointModelFreeFlyer())

    def thrust(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        return np.array([1.0 + t, -2.0, 0.5, 0.1, v[0], -0.2])

    tip, middle = (0.7, 0.1, -0.2), (0.5, 0.0, 0.0)
    return replace(
        ring,
        forces=(
            srm.SpringDamper(
                srm.Anchor("a", xyz=middle), srm.Anchor("c", xyz=tip), 50.0, 2.0, 0.3, name="s"
            ),
            srm.Wrench(
                srm.Anchor("b", xyz=tip, rpy=(0.3, 0.2, 1.0)),
                force=(1.0, 2.0, 3.0),
                moment=(0.5, 0.0, -0.4),
                frame="link",
                law=srm.Sine(1.0, 3.0),
                name="w",
            ),
            srm.UserForce(thrust, at=srm.Anchor("d", xyz=tip), name="u"),
        ),
    )


@pytest.mark.parametrize("backend", ["python", "kernel"])
def test_forces_between_links_enter_the_reactions(backend: str) -> None:
    run = finished(loaded_ring(), 0.4, backend=backend, t_eval=np.linspace(0.0, 0.4, 5))
    assert imbalance(run) < 1e-9
    assert_close(run.joint_reactions["a"], 0.0, atol=1e-9)  # the ring is free in space


def test_a_bushing_loads_joints_as_the_closure_that_it_replaces() -> None:
    """A stiff bushing instead of the weld of a bar that a hinge holds already: at rest the hinge
    carries what the bushing leaves it."""
    model = pin.Model()
    add_link(model, 0, pin.JointModelRY(), "bar", rod(2.0, 1.5))
    inside = {"xyz": (1.5, 0.0, 0.0)}
    element = srm.Bushing(
        srm.Anchor("bar", **inside),
        srm.Anchor("world", **inside),
        stiffness=(1e3, 1e3, 1e3, 10.0, 20.0, 30.0),
        damping=(5.0, 5.0, 5.0, 0.1, 0.1, 0.1),
        name="bushing",
    )
    mechanism = srm.Mechanism(model, forces=(element,), q0=np.array([0.01]), v0=np.array([0.3]))
    run = finished(mechanism, 0.2)
    angle, rate = run.joint("bar")
    # The tip of the bar in the world, relative to where it was, and the force on it.
    tip = np.column_stack([np.cos(angle) - 1.0, 0.0 * angle, -np.sin(angle)]) * 1.5
    speed = np.column_stack([-np.sin(angle), 0.0 * angle, -np.cos(angle)]) * 1.5 * rate[:, None]
    pull = -1e3 * tip - 5.0 * speed
    centre = np.column_stack([np.cos(angle), 0.0 * angle, -np.sin(angle)]) * 0.75
    turn = run.accelerations[:, 0]
    across = np.column_stack([-np.sin(angle), 0.0 * angle, -np.cos(angle)]) * 0.75
    acceleration = turn[:, None] * across - rate[:, None] ** 2 * centre
    expected = 2.0 * acceleration - pull - 2.0 * np.array([0.0, 0.0, -G])
    assert_close(run.joint_reactions["bar"][:, :3], expected, atol=1e-10)
    assert_close(on_axes(run)["bar"], 0.0, atol=1e-10)


def test_drives_of_points_load_the_joints_of_their_links() -> None:
    base = load("five_bar")
    names = base.joint_names
    assert base.degrees_of_freedom == 2
    moving = [f.name for f in base.model.frames if f.type == pin.FrameType.BODY][-1]
    law = srm.Sine(0.02, 3.0)
    drive = srm.Drive(
        law, a=srm.Anchor(moving, xyz=(0.1, 0.0, 0.0)), b=srm.Anchor("world"), axis=(1.0, 0.0, 0.0)
    )
    run = finished(assembled(replace(base, drives=(drive,))), 0.2)
    assert imbalance(run) < 1e-9
    assert set(run.joint_reactions) == set(names)


def test_inverse_dynamics_and_equilibria_have_the_same_reactions() -> None:
    mechanism = load("four_bar")
    run = finished(mechanism, 0.4, controller=lambda t, q, v: np.array([3.0 * t, 0.0, 0.0]))
    motor = srm.inverse_dynamics(mechanism, run, actuated="crank")
    for name, wrench in run.joint_reactions.items():
        assert_close(motor.joint_reactions[name], wrench, atol=1e-6)
    still = srm.equilibrium(mechanism)
    weight = sum(inertia.mass for inertia in list(mechanism.model.inertias)[1:]) * G
    grounded = [
        still.joint_reactions[name][2]
        for name in mechanism.joint_names
        if mechanism.model.parents[mechanism.model.getJointId(name)] == 0
    ]
    on_ground = sum(
        wrench[2] * (1.0 if loop.b is not None and loop.b.link != "world" else -1.0)
        for loop, wrench in zip(mechanism.loops, still.reactions.values())
        if "world" in {anchor.link for anchor in loop.anchors}
    )
    assert sum(grounded) + on_ground == pytest.approx(weight, rel=1e-9)


# --- couplings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "slopes"),
    [
        # s = 0.1 + 0.05 y + 0.2 y^2 - 0.03 y^3 of the last angle y.
        ({"joints": ("slide", "arm")}, lambda p, q: [0.0, -p.deriv()(q[1]), 1.0]),
        # 2 s - 0.4 phi = p(y), y = 0.5 phi + phi_2: a row of all three joints.
        (
            {
                "joints": ("slide", "crank", "arm"),
                "coefficients": (2.0, -0.4, 0.0),
                "arguments": (0.0, 0.5, 1.0),
            },
            lambda p, q: [
                -0.4 - 0.5 * p.deriv()(0.5 * q[0] + q[1]),
                -p.deriv()(0.5 * q[0] + q[1]),
                2.0,
            ],
        ),
    ],
    ids=["two joints", "three joints"],
)
def test_a_polynomial_coupling_loads_each_axis_by_its_slope(kind: Any, slopes: Any) -> None:
    """A spatial arm whose slider follows its angles by a cam.  The bodies are in balance; on the
    axes are the couplings' forces, which are in the ratio of the derivatives of its equation."""
    powers = (0.1, 0.05, 0.2, -0.03)
    model = pin.Model()
    crank = add_link(model, 0, pin.JointModelRY(), "crank", rod(1.2))
    arm = add_link(model, crank, pin.JointModelRZ(), "arm", rod(0.7), along_x(1.0))
    add_link(model, arm, pin.JointModelPX(), "slide", rod(0.5, 0.3), along_x(0.4))
    coupling = srm.LoopClosure("coupling", name="cam", polynomial=powers, **kind)
    bare = srm.Mechanism(model, (coupling,))
    start = srm.assemble(bare, {"crank": 0.3, "arm": -0.7}, {"crank": 1.0, "arm": 2.0})
    run = finished(bare.with_state(start.q, start.v), T_END, t_eval=np.linspace(0.0, T_END, 7))
    assert imbalance(run) < 1e-9
    p = np.polynomial.Polynomial(powers)
    rows = np.array([slopes(p, q) for q in run.q])
    forces = np.column_stack([on_axes(run)[name] for name in ("crank", "arm", "slide")])
    lam = forces[:, 2] / rows[:, 2]
    assert np.abs(lam).min() > 0.1
    assert_close(forces, lam[:, None] * rows, atol=1e-9 * np.abs(forces).max())
    for joint, own in zip(kind["joints"], run.coupling_forces["cam"].T):
        found = on_axes(run)[joint]
        assert_close(own, found, atol=1e-9 * np.abs(forces).max())


# --- runs of all kinds ----------------------------------------------------------------------------


def test_both_backends_and_other_times_give_the_same_reactions(tmp_path: Path) -> None:
    mechanism = load("slider_crank_regular")
    t = np.linspace(0.0, 1.0, 11)
    runs = [finished(mechanism, 1.0, backend=b, rtol=1e-10) for b in ("python", "kernel")]
    runs[1].save(tmp_path / "run.npz")
    runs.append(srm.load_solution(tmp_path / "run.npz"))
    reference = runs[0].at(t).joint_reactions
    for run in runs[1:]:
        for name, wrench in run.at(t).joint_reactions.items():
            size = np.abs(reference[name]).max()
            assert_close(wrench, reference[name], atol=1e-7 * size)


def test_a_run_with_actions_has_the_reactions_of_each_segment() -> None:
    def down(t: float, q: FloatArray, v: FloatArray) -> float:
        return float(v[0])

    mechanism = pendulum()
    event = srm.Event(down, action=lambda t, q, v: (q, -0.5 + 0.0 * v))
    run = srm.simulate(mechanism, 1.5, events=[event])
    assert run.success
    assert len(run.segments) > 1
    whole = run.joint_reactions["bar"]
    parts = np.concatenate([part.joint_reactions["bar"] for part in run.segments])
    np.testing.assert_array_equal(whole, parts)
    assert len(whole) == len(run.t)


@pytest.mark.parametrize("backend", ["python", "kernel"])
def test_reactions_drive_forces_and_joint_reactions_share_one_pass(
    backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = finished(load("four_bar"), 0.2, backend=backend)
    observables = type(run.observables)
    passes = []

    def counted(self: Any, t: FloatArray, q: FloatArray, v: FloatArray) -> Any:
        passes.append(len(t))
        return made(self, t, q, v)

    made = observables.reactions
    monkeypatch.setattr(observables, "reactions", counted)
    _ = run.joint_reactions, run.reactions, run.drive_forces, run.reaction_multipliers
    _ = run.indeterminate_reactions, run.indeterminate_joint_reactions
    assert passes == [len(run.t)]


# --- what equilibrium does not determine ----------------------------------------------------------


PLANAR = (
    *("four_bar", "five_bar", "parallelogram", "slider_crank_slider", "stephenson_six_bar"),
    *("watt_six_bar", "squeezing_mechanism", "jansen_walker"),
)
"""Mechanisms in the x-z plane whose closures are balls: each has one redundant row, across it."""


@pytest.mark.parametrize("name", PLANAR)
def test_a_load_across_the_plane_changes_what_is_indeterminate_and_nothing_else(name: str) -> None:
    """Opposite forces across the plane on both links of a ball: it may carry them, or the joints;
    the motion remains the same."""
    mechanism = load(name)
    assert set(mechanism.mobility.indeterminate_rows) == {f"{p.name}.y" for p in mechanism.loops}
    pushes = tuple(
        srm.Wrench(anchor, force=(0.0, sign * size, 0.0), name=f"{loop.name} {sign}")
        for size, loop in enumerate(mechanism.loops, start=7)
        for sign, anchor in zip((1.0, -1.0), loop.anchors)
        if anchor.link != "world"
    )
    loaded = replace(mechanism, forces=(*mechanism.forces, *pushes))
    t = np.linspace(0.0, 1e-2, 4)
    runs = [finished(each, t[-1], t_eval=t, rtol=1e-10) for each in (mechanism, loaded)]
    assert imbalance(runs[1]) < 1e-9
    changed = set()
    for joint, wrench in runs[1].joint_reactions.items():
        change = np.abs(wrench - runs[0].joint_reactions[joint]).max(axis=0)
        sizes = np.repeat([np.abs(w).max() for w in np.split(wrench, 2, axis=1)], 3)
        changed |= {f"{joint}.{p}" for p, c in zip(PARTS, change > 1e-6 * (1.0 + sizes)) if c}
    assert changed == set(runs[0].indeterminate_joint_reactions)


def test_a_mechanism_without_redundant_rows_has_no_indeterminate_reaction() -> None:
    for name in ("delta_robot", "stewart_platform", "differential", "pendulum_chain"):
        assert finished(load(name), 0.01).indeterminate_joint_reactions == ()


def test_a_hinge_that_closes_a_planar_loop_leaves_every_moment_in_the_plane_open() -> None:
    """The axis rows of a hinge are redundant, too: moments about x and z are not determined in any
    joint, the forces in the plane are."""
    ball = load("four_bar")
    hinges = tuple(replace(p, type="revolute", axis=(0.0, 1.0, 0.0)) for p in ball.loops)
    runs = [finished(m, 0.3, rtol=1e-10) for m in (ball, replace(ball, loops=hinges))]
    open_parts = {f"{name}.{p}" for name in ball.joint_names for p in ("fy", "mx", "mz")}
    assert set(runs[1].indeterminate_joint_reactions) == open_parts
    t = np.linspace(0.0, 0.3, 5)
    one, other = (run.at(t).joint_reactions for run in runs)
    for name in ball.joint_names:
        assert_close(one[name][:, [0, 2, 4]], other[name][:, [0, 2, 4]], atol=1e-6)
