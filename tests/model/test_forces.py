"""Force elements: their forces are those of their formulas, their energies, and Newton's laws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.analysis.summary import force_rows
from srm_mbs.cli.tables import equilibrium_rows
from srm_mbs.dynamics.multibody import make_system
from tests.support.bundled import finished
from tests.support.dynamics import mass_matrix
from tests.support.mechanisms import add_link, random_state, rod
from tests.support.snapshots import check_messages, check_refusals, refused

Coordinates = Callable[[FloatArray], FloatArray]

ANCHOR_A = srm.Anchor("arm", xyz=(0.3, -0.2, 0.5), rpy=(0.4, -0.3, 1.1))
ANCHOR_B = srm.Anchor("tray", xyz=(-0.1, 0.4, 0.2), rpy=(-0.7, 0.2, 0.5))
GROUND = srm.Anchor("world", xyz=(0.8, -0.6, 1.1), rpy=(0.3, 0.6, -0.2))


def tree() -> pin.Model:
    """A free body, a ball, a hinge with an oblique axis, a slide, and a branch with a hinge."""
    model = pin.Model()
    model.name = "tree"
    axis = np.array([1.0, 2.0, -2.0]) / 3.0
    joints: tuple[tuple[str, int, Any], ...] = (
        ("base", 0, pin.JointModelFreeFlyer()),
        ("ball", 1, pin.JointModelSpherical()),
        ("hinge", 2, pin.JointModelRevoluteUnaligned(axis)),
        ("slide", 3, pin.JointModelPY()),
        ("branch", 1, pin.JointModelRZ()),
    )
    links = ("base", "boom", "arm", "tray", "tail")
    rng = np.random.default_rng(4)
    for (name, parent, joint), link in zip(joints, links):
        at, body = (
            pin.SE3(pin.rpy.rpyToMatrix(rng.uniform(-1, 1, 3)), rng.uniform(-0.5, 0.5, 3))
            for _ in range(2)
        )
        index = model.addJoint(parent, joint, at, name)
        model.appendBodyToJoint(index, rod(rng.uniform(0.5, 2.0), 0.8), body)
        model.addBodyFrame(link, index, pin.SE3.Identity(), 0)
    return model


TREE = tree()


def placement(model: pin.Model, q: FloatArray, anchor: srm.Anchor) -> tuple[FloatArray, FloatArray]:
    """Rotation and origin of an anchor, from Pinocchio's frames and SciPy's rotations."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    R, p = np.eye(3), np.zeros(3)
    if anchor.link != "world":
        place = data.oMf[model.getFrameId(str(anchor.link), pin.FrameType.BODY)]
        R, p = place.rotation, place.translation
    inside = Rotation.from_euler("xyz", anchor.rpy).as_matrix()
    return R @ inside, R @ np.array(anchor.xyz) + p


def coordinates(element: Any) -> Coordinates:
    """The coordinates y(q) of a spring or damper: a distance (1,), a joint's position (1,), or the
    position and rotation vector of a in b (6,)."""
    if isinstance(element, srm.TorsionSpring):
        index = TREE.joints[TREE.getJointId(element.joint)].idx_q
        return lambda q: q[index : index + 1]
    if isinstance(element, srm.CouplingSpring):
        places = [TREE.joints[TREE.getJointId(name)].idx_q for name in element.joints]
        return lambda q: np.array([np.dot(element.coefficients, q[places])])

    def y(q: FloatArray) -> FloatArray:
        (Ra, pa), (Rb, pb) = placement(TREE, q, element.a), placement(TREE, q, element.b)
        if isinstance(element, srm.SpringDamper):
            return np.array([np.linalg.norm(pa - pb)])
        return np.concatenate([Rb.T @ (pa - pb), Rotation.from_matrix(Rb.T @ Ra).as_rotvec()])

    return y


RESTS = ("rest_length", "rest_angle", "rest")


def rest(element: Any) -> float:
    """y where the spring is relaxed, in each component."""
    return float(next((getattr(element, key) for key in RESTS if hasattr(element, key)), 0.0))


def stretch(element: Any, y: FloatArray) -> FloatArray:
    """y beyond where the spring is relaxed: one length, or those of a slack."""
    beyond, slack = y - rest(element), getattr(element, "slack", 0.0)
    return np.where(beyond < 0.0, beyond, np.maximum(beyond - slack, 0.0))


def friction(element: Any, rate: FloatArray) -> FloatArray:
    """The force of dry friction at the default friction speed of a mechanism, 0.01."""
    return float(getattr(element, "friction", 0.0)) * np.tanh(rate / 0.01)


def slope(of: Coordinates, q: FloatArray) -> FloatArray:
    """d(coordinates)/dq in the tangent space (rows, nv): central differences of order 4."""
    columns = []
    h = 1e-3
    for direction in np.eye(TREE.nv):
        near, far = (
            of(pin.integrate(TREE, q, step * direction))
            - of(pin.integrate(TREE, q, -step * direction))
            for step in (h, 2.0 * h)
        )
        columns.append((8.0 * near - far) / (12.0 * h))
    return np.array(columns).T


def exerted(
    forces: tuple[srm.ForceElement, ...], q: FloatArray, v: FloatArray, model: pin.Model = TREE
) -> FloatArray:
    """Generalised forces (nv,), from the change of the accelerations."""
    state = np.concatenate([q, v])
    accelerations = [
        make_system(srm.Mechanism(model, forces=elements)).evaluate(0.0, state).rate()[model.nv :]
        for elements in ((), forces)
    ]
    return mass_matrix(model, q) @ (accelerations[1] - accelerations[0])  # type: ignore[no-any-return]


SIX_K, SIX_C = (50.0, 80.0, 20.0, 3.0, 9.0, 5.0), (2.0, 0.7, 1.1, 0.3, 0.8, 0.5)
CASES: dict[str, Any] = {
    "spring between links": srm.SpringDamper(ANCHOR_A, ANCHOR_B, 70.0, 3.0, 0.4),
    "spring to the ground": srm.SpringDamper(ANCHOR_A, GROUND, 70.0, 3.0, 0.4),
    "spring from the ground": srm.SpringDamper(GROUND, ANCHOR_B, 12.0, 0.0, 5.0),
    "damper across a branch": srm.SpringDamper(ANCHOR_A, srm.Anchor("tail"), damping=2.5),
    "torsion spring": srm.TorsionSpring("hinge", 6.0, 0.4, 0.3),
    "spring of a slide": srm.TorsionSpring("slide", 60.0, 4.0, -0.2),
    "spring on several joints": srm.CouplingSpring(
        ("branch", "slide", "hinge"), (0.4, -2.0, 0.7), 30.0, 2.0, 0.1
    ),
    "taut spring": srm.SpringDamper(ANCHOR_A, ANCHOR_B, 70.0, 3.0, 0.0, slack=0.1),
    "pushed spring": srm.SpringDamper(ANCHOR_A, ANCHOR_B, 70.0, 3.0, 9.0, slack=0.1),
    "slack spring": srm.SpringDamper(ANCHOR_A, ANCHOR_B, 70.0, 3.0, 0.0, slack=9.0),
    "slack and friction on several joints": srm.CouplingSpring(
        ("branch", "slide", "hinge"), (0.4, -2.0, 0.7), 30.0, 2.0, -0.2, slack=0.3, friction=4.0
    ),
    "bushing between links": srm.Bushing(ANCHOR_A, ANCHOR_B, SIX_K, SIX_C),
    "bushing to the ground": srm.Bushing(ANCHOR_A, GROUND, SIX_K, SIX_C),
    "bushing from the ground": srm.Bushing(GROUND, ANCHOR_B, SIX_K),
}
every_case = pytest.mark.parametrize("element", CASES.values(), ids=CASES)


# --- forces and energies ------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@every_case
def test_a_force_follows_from_its_coordinates_by_virtual_work(element: Any, seed: int) -> None:
    """tau = -(dy/dq)^T (K (y - y_0) + C dy/dt) without slack and friction, with y from frames and
    SciPy's rotations."""
    q, v = random_state(TREE, seed)
    y = coordinates(element)
    Y = slope(y, q)
    pulled = np.array(element.stiffness) * stretch(element, y(q)) + friction(element, Y @ v)
    expected = -Y.T @ (pulled + np.array(element.damping) * (Y @ v))
    found = exerted((element,), q, v)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@every_case
def test_the_energy_of_a_spring_is_that_of_its_coordinates(element: Any) -> None:
    q, v = random_state(TREE, 5)
    state = np.concatenate([q, v])
    with_, without = (
        make_system(srm.Mechanism(TREE, forces=forces)).energy(state) for forces in ((element,), ())
    )
    stretched = stretch(element, coordinates(element)(q))
    expected = 0.5 * float(np.sum(np.array(element.stiffness) * stretched**2))
    assert with_ - without == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "element",
    [
        srm.SpringDamper(ANCHOR_A, ANCHOR_B, damping=3.0),
        srm.SpringDamper(GROUND, ANCHOR_B, damping=3.0),
        srm.TorsionSpring("hinge", damping=0.4),
        srm.Bushing(ANCHOR_A, ANCHOR_B, damping=SIX_C),
    ],
    ids=["between links", "from the ground", "joint", "bushing"],
)
def test_dampers_never_give_power(element: srm.ForceElement, seed: int) -> None:
    q, v = random_state(TREE, seed, 3.0)
    assert exerted((element,), q, v) @ v < 0.0


def test_forces_add_up() -> None:
    q, v = random_state(TREE, 6)
    elements = tuple(replace(element, name=name) for name, element in CASES.items())
    each = sum(exerted((element,), q, v) for element in elements)
    np.testing.assert_allclose(exerted(elements, q, v), each, rtol=1e-11, atol=1e-11)


def test_a_torque_acts_on_its_joint_alone() -> None:
    q, v = random_state(TREE, 7)
    elements = (
        srm.JointTorque("hinge", 1.5),
        srm.JointTorque("slide", -2.0),
        srm.JointTorque("ball", (0.1, 0.2, 0.3)),
        srm.JointTorque("base", (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)),
        srm.JointTorque("branch", (0.7,)),
    )
    expected = np.zeros(TREE.nv)
    expected[:6] = [1, 2, 3, 4, 5, 6]
    expected[6:9] = [0.1, 0.2, 0.3]
    expected[9:] = [1.5, -2.0, 0.7]
    np.testing.assert_allclose(exerted(elements, q, v), expected, atol=1e-12)


@pytest.mark.parametrize("frame", ["world", "link"])
def test_the_power_of_a_wrench_is_that_of_force_and_moment(frame: Any) -> None:
    """F . (velocity of the point) + M . (angular velocity), both by differences of placements."""
    force, moment = (1.0, -2.0, 3.0), (0.5, 0.4, -0.3)
    q, _ = random_state(TREE, 8)
    tau = exerted((srm.Wrench(ANCHOR_A, force, moment, frame),), q, np.zeros(TREE.nv))
    R, _ = placement(TREE, q, ANCHOR_A)
    F, M = (np.array(x) if frame == "world" else R @ np.array(x) for x in (force, moment))

    def moved(there: FloatArray) -> FloatArray:
        """Position, and rotation vector from here, in world axes."""
        turned, at = placement(TREE, there, ANCHOR_A)
        return np.concatenate([at, Rotation.from_matrix(turned @ R.T).as_rotvec()])

    expected = slope(moved, q).T @ np.concatenate([F, M])
    np.testing.assert_allclose(tau, expected, rtol=1e-9, atol=1e-9)


def test_a_constant_force_through_the_centre_of_mass_is_gravity() -> None:
    """A weight as a wrench on each link, in place of the model's gravity."""
    q, v = random_state(TREE, 9)
    light = TREE.copy()
    light.gravity.linear = np.zeros(3)
    links = ("base", "boom", "arm", "tray", "tail")
    weights = tuple(
        srm.Wrench(srm.Anchor(link, xyz=tuple(inertia.lever)), (0.0, 0.0, -9.81 * inertia.mass))
        for link, inertia in zip(links, list(TREE.inertias)[1:])
    )
    state = np.concatenate([q, v])
    heavy = make_system(srm.Mechanism(TREE)).evaluate(0.0, state).rate()
    pushed = make_system(srm.Mechanism(light, forces=weights)).evaluate(0.0, state).rate()
    np.testing.assert_allclose(pushed, heavy, rtol=1e-11, atol=1e-11)


# --- in loops -----------------------------------------------------------------------------------

COUPLER, TIP = srm.Anchor("coupler", xyz=(1.2, 0.0, 0.3)), srm.Anchor("world", xyz=(1.0, 0.1, 2.0))
IN_LOOP = (
    srm.SpringDamper(COUPLER, TIP, 40.0, 2.0, 0.5),
    srm.SpringDamper(srm.Anchor("crank", xyz=(0.5, 0.0, 0.0)), srm.Anchor("rocker"), 10.0, 0.0, 1),
    srm.TorsionSpring("rocker", 3.0, 0.1, 1.0),
    srm.JointTorque("crank", 0.5),
    srm.Wrench(COUPLER, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), "link"),
    srm.Bushing(srm.Anchor("crank"), srm.Anchor("coupler"), SIX_K, SIX_C),
)


def test_in_a_loop_forces_act_like_a_controller_that_exerts_them() -> None:
    closed = srm.load("four_bar")
    model = closed.model
    state = np.concatenate([closed.q0, closed.v0])
    q, v = closed.q0, closed.v0
    tau = exerted(IN_LOOP, q, v, model)  # of the open chain
    assert np.abs(tau).min() > 1.0
    by_elements = make_system(replace(closed, forces=IN_LOOP))
    by_controller = make_system(closed, lambda t, q, v: tau)
    np.testing.assert_allclose(
        by_elements.evaluate(0.0, state).rate(),
        by_controller.evaluate(0.0, state).rate(),
        rtol=1e-12,
    )


@pytest.mark.parametrize("name", ["four_bar", "pendulum_chain"])
def test_elements_controller_and_joint_damping_act_together(name: str) -> None:
    mechanism = srm.load(name)
    model = mechanism.model.copy()
    torque, push = 0.7, np.array([0.1, 0.2, 0.3])
    first = mechanism.joint_names[0]
    state = np.concatenate([mechanism.q0, mechanism.v0 + 0.3])
    model.damping = np.full(3, 0.4)
    whole = make_system(
        replace(mechanism, model=model, forces=(srm.JointTorque(first, torque),)),
        lambda t, q, v: push,
    )
    one = make_system(mechanism, lambda t, q, v: [torque + push[0], *push[1:]] - 0.4 * v)
    np.testing.assert_allclose(
        whole.evaluate(0.0, state).rate(), one.evaluate(0.0, state).rate(), rtol=1e-12
    )


@pytest.mark.parametrize("tableau", ["dop853", "dopr54"])
def test_energy_is_conserved_by_springs_in_a_loop(tableau: str) -> None:
    springs = (
        srm.SpringDamper(COUPLER, TIP, 400.0, 0.0, 0.5),
        srm.TorsionSpring("rocker", 30.0, 0.0, 1.0),
        srm.Bushing(srm.Anchor("rocker"), srm.Anchor("world", xyz=(2.0, 0.3, 0.1)), SIX_K),
    )
    mechanism = replace(srm.load("four_bar"), forces=springs)
    solution = finished(mechanism, 3.0, rtol=1e-11, tableau=tableau)
    scale = np.ptp(solution.energy - replaced_energy(solution))
    assert scale > 10.0  # the springs store and give much energy
    assert np.abs(solution.energy - solution.energy[0]).max() < 1e-9 * scale
    assert solution.drift[:, 0].max() < 1e-12


def replaced_energy(solution: srm.Solution) -> FloatArray:
    """Energy of the states of a run without that of its force elements."""
    bare = make_system(replace(solution.mechanism, forces=()))
    return np.array([bare.energy(np.concatenate(x)) for x in zip(solution.q, solution.v)])


# --- laws and exact motions ---------------------------------------------------------------------


def two_free_bodies() -> pin.Model:
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    for name, mass in (("one", 1.0), ("two", 2.5)):
        add_link(model, 0, pin.JointModelFreeFlyer(), name, rod(mass))
    return model


ONE, TWO = srm.Anchor("one", xyz=(1.0, 0.1, 0.0)), srm.Anchor("two", xyz=(0.0, 0.2, 0.1))


@pytest.mark.parametrize(
    "element",
    [
        srm.SpringDamper(ONE, TWO, 30.0, 0.5, 0.7),
        srm.Bushing(ONE, TWO, (30.0, 20.0, 10.0, 4.0, 2.0, 3.0), (0.3,) * 6),
    ],
    ids=["spring_damper", "bushing"],
)
def test_two_free_bodies_keep_their_momentum(element: srm.ForceElement) -> None:
    """Newton's third law: forces and moments on the two are opposite."""
    model = two_free_bodies()
    q, v = random_state(model, 2, 0.8)
    mechanism = srm.Mechanism(model, forces=(element,), q0=q, v0=v)
    solution = srm.simulate(mechanism, 2.0, rtol=1e-11)
    data = model.createData()
    momenta = []
    for q, v in zip(solution.q, solution.v):
        pin.computeCentroidalMomentum(model, data, q, v)
        about_origin = data.hg.angular + np.cross(data.com[0], data.hg.linear)
        momenta.append(np.concatenate([data.hg.linear, about_origin]))
    assert np.abs(np.array(momenta) - momenta[0]).max() < 1e-9
    assert np.abs(solution.v - solution.v[0]).max() > 0.5
    assert np.all(np.diff(solution.energy) < 0.0)


def point_on_slides(gravity: float = 9.81) -> pin.Model:
    """A mass of 2 kg that moves freely in the x-z plane."""
    model = pin.Model()
    model.gravity.linear = np.array([0.0, 0.0, -gravity])
    x = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "x")
    add_link(model, x, pin.JointModelPZ(), "ball", pin.Inertia(2.0, np.zeros(3), 0.01 * np.eye(3)))
    return model


@pytest.mark.parametrize("damping", [0.0, 0.6])
def test_a_spring_pendulum_moves_as_scipy_computes_it_in_polar_coordinates(damping: float) -> None:
    m, k, l0, g = 2.0, 80.0, 1.0, 9.81
    spring = srm.SpringDamper(srm.Anchor("ball"), srm.Anchor("world"), k, damping, l0)

    def field(t: float, y: FloatArray) -> list[float]:
        length, angle, rate, turn = y  # angle from the downward vertical
        return [
            rate,
            turn,
            length * turn**2 + g * np.cos(angle) - (k * (length - l0) + damping * rate) / m,
            (-g * np.sin(angle) - 2.0 * rate * turn) / length,
        ]

    start = [1.3, 0.9, 0.4, -0.5]
    run = solve_ivp(field, (0.0, 5.0), start, "DOP853", rtol=1e-13, atol=1e-13)
    length, angle, rate, turn = start
    s, c = np.sin(angle), np.cos(angle)
    mechanism = srm.Mechanism(
        point_on_slides(g),
        forces=(spring,),
        q0=[length * s, -length * c],
        v0=[rate * s + length * turn * c, -rate * c + length * turn * s],
    )
    solution = srm.simulate(mechanism, 5.0, rtol=1e-12)
    length, angle = run.y[:2, -1]
    np.testing.assert_allclose(
        solution.q[-1], [length * np.sin(angle), -length * np.cos(angle)], atol=1e-10
    )
    if not damping:
        scale = np.ptp(replaced_energy(solution))
        assert np.abs(solution.energy - solution.energy[0]).max() < 1e-9 * scale


@pytest.mark.parametrize("kind", [pin.JointModelRX(), pin.JointModelPX()])
def test_a_damped_joint_oscillates_as_its_formula_says(kind: Any) -> None:
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    add_link(model, 0, kind, "joint", pin.Inertia(2.0, np.zeros(3), 2.0 * np.eye(3)))
    k, c, rest, torque = 50.0, 1.2, 0.3, 5.0
    forces = (srm.TorsionSpring("joint", k, c, rest), srm.JointTorque("joint", torque))
    mechanism = srm.Mechanism(model, forces=forces, q0=[1.0])
    solution = srm.simulate(mechanism, 4.0, rtol=1e-11)
    decay, centre = c / 4.0, rest + torque / k
    omega = np.sqrt(k / 2.0 - decay**2)
    t = solution.t
    swing = np.cos(omega * t) + decay / omega * np.sin(omega * t)
    expected = centre + (1.0 - centre) * np.exp(-decay * t) * swing
    np.testing.assert_allclose(solution.q[:, 0], expected, atol=1e-9)


def test_a_bushing_is_linear_at_small_rotations() -> None:
    """-K p and -K phi on a body next to its frame on the ground."""
    model = two_free_bodies()
    at = srm.Anchor("world", xyz=(1.0, 0.1, 0.0))
    bushing = srm.Bushing(ONE, at, SIX_K)
    move = 1e-6 * np.array([1.0, -2.0, 3.0, 0.5, 2.0, -1.0])
    q = pin.neutral(model)
    q[:3] = move[:3] - np.cross(move[3:], ONE.xyz)
    q[3:7] = pin.Quaternion(pin.exp3(move[3:])).coeffs()
    tau = exerted((bushing,), q, np.zeros(12), model)
    expected = -np.array(SIX_K) * move
    np.testing.assert_allclose(tau[:3], expected[:3], rtol=1e-5)
    np.testing.assert_allclose(
        tau[3:6], expected[3:] + np.cross(ONE.xyz, expected[:3]), rtol=1e-5, atol=1e-11
    )


# --- joint friction -----------------------------------------------------------------------------

SPEED = 0.02


def rubbing(friction: float, slope: float = 0.0, v0: float = 0.0, mass: float = 2.0) -> Any:
    """A block on a slide that falls by ``slope`` (rad), with friction in N."""
    model = pin.Model()
    model.gravity.linear = 9.81 * np.array([np.sin(slope), 0.0, -np.cos(slope)])
    add_link(model, 0, pin.JointModelPX(), "slide", pin.Inertia(mass, np.zeros(3), np.eye(3)))
    model.friction = np.array([friction])
    return srm.Mechanism(model, v0=[v0], friction_speed=SPEED)


def test_friction_stops_a_block_as_its_formula_says() -> None:
    """m v' = -F tanh(v/s): sinh(v/s) falls as exp(-F t/(m s)); before that, v falls by F/m t."""
    F, m, v0 = 3.0, 2.0, 1.5
    solution = srm.simulate(rubbing(F, v0=v0, mass=m), 1.2, rtol=1e-10)
    t = solution.t
    # ln sinh(v0/s) without overflow
    exponent = v0 / SPEED - np.log(2.0) + np.log1p(-np.exp(-2.0 * v0 / SPEED)) - F * t / (m * SPEED)
    expected = SPEED * np.arcsinh(np.exp(exponent))
    np.testing.assert_allclose(solution.v[:, 0], expected, rtol=1e-7, atol=1e-9)
    # Coulomb's law: the distance to the stop is v0^2 m/(2F), up to the smoothing.
    assert solution.q[-1, 0] == pytest.approx(v0**2 * m / (2.0 * F), rel=1e-3)
    assert np.all(np.diff(solution.energy) <= 1e-12)


def test_friction_holds_a_block_on_a_slope_but_for_a_creep() -> None:
    F, load = 5.0, 2.0 * 9.81 * np.sin(0.2)
    assert load < F
    solution = srm.simulate(rubbing(F, 0.2), 1.0, rtol=1e-8)
    creep = SPEED * np.arctanh(load / F)
    assert solution.v[-1, 0] == pytest.approx(creep, rel=1e-7)
    assert solution.q[-1, 0] < creep


def test_a_load_above_the_friction_accelerates_the_block() -> None:
    F, load = 3.0, 2.0 * 9.81 * np.sin(0.2)
    assert load > F
    solution = srm.simulate(rubbing(F, 0.2), 2.0, rtol=1e-8)
    slope = np.diff(solution.v[-2:, 0]) / np.diff(solution.t[-2:])
    assert slope[0] == pytest.approx((load - F) / 2.0, rel=1e-6)


@pytest.mark.parametrize("name", ["four_bar", "pendulum_chain"])
def test_friction_acts_beside_damping_on_open_and_closed_mechanisms(name: str) -> None:
    mechanism = srm.load(name)
    model = mechanism.model.copy()
    model.friction = np.array([0.3, 0.0, 0.7])
    model.damping = np.array([0.0, 0.2, 0.1])
    v = mechanism.v0 + np.array([0.01, -0.02, 0.3])
    rough = replace(mechanism, model=model, friction_speed=SPEED)
    by_hand = -np.array([0.3, 0.0, 0.7]) * np.tanh(v / SPEED) - np.array([0.0, 0.2, 0.1]) * v
    state = np.concatenate([mechanism.q0, v])
    np.testing.assert_allclose(
        make_system(rough).evaluate(0.0, state).rate(),
        make_system(mechanism, lambda t, q, v: by_hand).evaluate(0.0, state).rate(),
        rtol=1e-12,
        atol=1e-12,
    )


def test_the_friction_speed_is_saved(tmp_path: Path) -> None:
    solution = srm.simulate(rubbing(3.0, v0=1.0), 0.1)
    solution.save(tmp_path / "run.npz")
    loaded = srm.load_solution(tmp_path / "run.npz").mechanism
    assert loaded.friction_speed == SPEED
    np.testing.assert_array_equal(loaded.model.friction, [3.0])


# --- units --------------------------------------------------------------------------------------


def test_at_rest_without_gravity_forces_give_the_unit_of_rates() -> None:
    """The pull of a spring on one body; the other, and directions across it, do not count."""
    model = two_free_bodies()
    spring = srm.SpringDamper(srm.Anchor("one", xyz=(0.5, 0.0, 0.0)), GROUND, 300.0, 1.0, 0.2)
    q = pin.neutral(model)
    q[:3] = np.array(GROUND.xyz) - np.array([2.5, 0.0, 0.0])  # along the rod, through its centre
    resting = srm.Mechanism(model, forces=(spring,), q0=q)
    units = resting.structure.units
    acceleration = 300.0 * (2.0 - 0.2) / 1.0
    assert units.rate == pytest.approx(np.sqrt(acceleration / units.length), rel=1e-12)
    moving = resting.with_state(q, np.full(12, 3.0))
    expected = np.median([3.0 / units.length] * 6 + [3.0] * 6)
    assert moving.structure.units.rate == pytest.approx(expected)
    heavy = model.copy()
    heavy.gravity.linear = np.array([0.0, 0.0, -9.81])
    falling = srm.Mechanism(heavy, forces=(spring,), q0=q).structure.units
    assert falling.rate == pytest.approx(np.sqrt(9.81 / units.length))


def test_forces_that_cannot_be_evaluated_at_the_start_leave_the_unit_of_rates_at_one() -> None:
    spring = srm.SpringDamper(srm.Anchor("ball"), srm.Anchor("world"), 8.0, 0.0, 0.5)
    assert srm.Mechanism(point_on_slides(0.0), forces=(spring,)).structure.units.rate == 1.0


# --- points that coincide -----------------------------------------------------------------------


def test_a_spring_without_length_is_an_oscillator_through_its_point() -> None:
    spring = srm.SpringDamper(srm.Anchor("ball"), srm.Anchor("world"), 8.0, 0.0, 0.0)
    mechanism = srm.Mechanism(point_on_slides(0.0), forces=(spring,), v0=[1.0, -0.5])
    solution = srm.simulate(mechanism, 5.0, rtol=1e-11)
    swing = 0.5 * np.sin(2.0 * solution.t)  # k/m = 4
    np.testing.assert_allclose(solution.q, np.outer(swing, [1.0, -0.5]), atol=1e-9)


def test_a_damper_acts_along_the_motion_of_points_that_meet() -> None:
    damper = srm.SpringDamper(srm.Anchor("ball"), srm.Anchor("world"), damping=3.0)
    v = np.array([0.6, -0.8])
    for q in (np.zeros(2), 1e-9 * v, 1e-200 * v, -0.3 * v):
        tau = exerted((damper,), q, v, point_on_slides())
        np.testing.assert_allclose(tau, -3.0 * v, rtol=1e-8)


def test_a_run_through_coinciding_points_of_a_spring_with_length_says_so() -> None:
    spring = srm.SpringDamper(srm.Anchor("ball"), srm.Anchor("world"), 8.0, 0.0, 0.5, "strut")
    mechanism = srm.Mechanism(point_on_slides(), forces=(spring,))
    solution = srm.simulate(mechanism, 1.0)
    assert not solution.success
    assert "'strut' coincide" in solution.message
    assert "not determined" in solution.message
    assert len(solution.t) == 1
    assert np.isfinite(solution.q).all()


# --- descriptions in Python ---------------------------------------------------------------------


def test_elements_are_immutable_and_named_after_type_and_place() -> None:
    elements = list(CASES.values())
    assert [element.name for element in elements[:2]] == [
        "spring_damper_arm_tray",
        "spring_damper_arm_world",
    ]
    assert srm.JointTorque("hinge", 1.0).name == "torque_hinge"
    assert srm.Wrench(ANCHOR_A, (1.0, 0.0, 0.0)).name == "wrench_arm"
    assert srm.TorsionSpring("hinge", 1.0).name == "torsion_spring_hinge"
    for element in elements:
        with pytest.raises(FrozenInstanceError):
            element.name = "other"
        assert hash(element) == hash(replace(element))
    lists = srm.Bushing(ANCHOR_A, ANCHOR_B, list(SIX_K), np.array(SIX_C))  # type: ignore[arg-type]
    assert lists == srm.Bushing(ANCHOR_A, ANCHOR_B, SIX_K, SIX_C)


WHEEL = pin.Model()
add_link(WHEEL, 0, pin.JointModelRUBX(), "wheel")
NOWHERE = srm.Anchor("am")
SENSELESS: dict[str, Callable[[], Any]] = {
    "a spring without effect": lambda: srm.SpringDamper(ANCHOR_A, GROUND),
    "no rest_length": lambda: srm.SpringDamper(ANCHOR_A, GROUND, 1.0),
    "negative stiffness": lambda: srm.SpringDamper(ANCHOR_A, GROUND, -1.0, 0.0, 1.0),
    "negative damping": lambda: srm.SpringDamper(ANCHOR_A, GROUND, 1.0, -2.0, 1.0),
    "negative rest_length": lambda: srm.SpringDamper(ANCHOR_A, GROUND, 1.0, 0.0, -1.0),
    "a nan": lambda: srm.SpringDamper(ANCHOR_A, GROUND, np.nan, 0.0, 1.0),
    "a text": lambda: srm.SpringDamper(ANCHOR_A, GROUND, "x", 0.0, 1.0),  # type: ignore[arg-type]
    "a spring on no joints": lambda: srm.CouplingSpring((), (), 1.0),
    "a spring on joints that are no names": lambda: srm.CouplingSpring((1, 2), (1.0, 1.0), 1.0),  # type: ignore[arg-type]
    "a spring on one joint twice": lambda: srm.CouplingSpring(("a", "a"), (1.0, 2.0), 1.0),
    "a coefficient too few": lambda: srm.CouplingSpring(("a", "b"), (1.0,), 1.0),
    "a coefficient of zero": lambda: srm.CouplingSpring(("a", "b"), (1.0, 0.0), 1.0),
    "a negative slack": lambda: srm.SpringDamper(ANCHOR_A, GROUND, 1.0, 0.0, 1.0, slack=-1.0),
    "a negative friction": lambda: srm.CouplingSpring(("a", "b"), (1.0, 1.0), friction=-1.0),
    "a spring on joints without effect": lambda: srm.CouplingSpring(("a", "b"), (1.0, 1.0)),
    "a torsion spring without effect": lambda: srm.TorsionSpring("hinge"),
    "an infinite angle": lambda: srm.TorsionSpring("hinge", 1.0, 0.0, np.inf),
    "a torque of nan": lambda: srm.JointTorque("hinge", np.nan),
    "an infinite torque": lambda: srm.JointTorque("ball", (1.0, np.inf, 0.0)),
    "a wrench without effect": lambda: srm.Wrench(ANCHOR_A),
    "two components": lambda: srm.Wrench(ANCHOR_A, (1.0, 2.0)),  # type: ignore[arg-type]
    "an unknown frame": lambda: srm.Wrench(ANCHOR_A, (1.0, 2.0, 3.0), frame="body"),  # type: ignore[arg-type]
    "three stiffnesses": lambda: srm.Bushing(ANCHOR_A, GROUND, (1.0,) * 3),
    "one stiffness": lambda: srm.Bushing(ANCHOR_A, GROUND, 1.0),  # type: ignore[arg-type]
    "a bushing without effect": lambda: srm.Bushing(ANCHOR_A, GROUND),
    "a negative stiffness of six": lambda: srm.Bushing(ANCHOR_A, GROUND, (1.0, 1, 1, 1, 1, -1)),
    "negative friction": lambda: rubbing(-1.0),
    "friction of nan": lambda: rubbing(np.nan),
    **{
        f"a friction_speed of {speed!r}": partial(replace, rubbing(1.0), friction_speed=speed)
        for speed in (0.0, -1.0, np.inf, "slow")
    },
}
UNFIT: dict[str, tuple[pin.Model, srm.ForceElement]] = {
    "torque on no joint": (TREE, srm.JointTorque("hing", 1.0)),
    "one torque on a ball": (TREE, srm.JointTorque("ball", 1.0)),
    "two torques on a hinge": (TREE, srm.JointTorque("hinge", (1.0, 2.0))),
    "spring on a hinge and a ball": (TREE, srm.CouplingSpring(("hinge", "ball"), (1.0, 1.0), 1.0)),
    "spring on a continuous joint and no other": (
        WHEEL,
        srm.CouplingSpring(("wheel",), (1.0,), 1.0),
    ),
    "torsion spring on a ball": (TREE, srm.TorsionSpring("ball", 1.0)),
    "torsion spring on the universe": (TREE, srm.TorsionSpring("universe", 1.0)),
    "torsion spring on a continuous joint": (WHEEL, srm.TorsionSpring("wheel", 1.0)),
    "spring on no link": (TREE, srm.SpringDamper(NOWHERE, GROUND, damping=1.0)),
    "bushing on no link": (TREE, srm.Bushing(ANCHOR_A, NOWHERE, SIX_K)),
    "spring on one body": (TREE, srm.SpringDamper(ANCHOR_A, srm.Anchor("arm"), damping=1.0)),
    "bushing on the ground": (TREE, srm.Bushing(GROUND, srm.Anchor("world"), SIX_K)),
    "wrench on no link": (TREE, srm.Wrench(NOWHERE, (1.0, 0.0, 0.0))),
    "wrench on the ground": (TREE, srm.Wrench(GROUND, (1.0, 0.0, 0.0))),
}


def test_senseless_and_unfit_elements_are_refused() -> None:
    unfit = {
        case: partial(srm.Mechanism, model, forces=(force,))
        for case, (model, force) in UNFIT.items()
    }
    twice = (srm.JointTorque("hinge", 1.0), srm.JointTorque("hinge", 2.0))
    names = {"a name twice": partial(srm.Mechanism, TREE, forces=twice)}
    check_refusals("force_elements", SENSELESS | unfit | names)


def test_a_damper_acts_on_a_continuous_joint() -> None:
    damper = srm.TorsionSpring("wheel", damping=0.3)
    q, v = np.array([0.6, 0.8]), np.array([2.0])
    np.testing.assert_allclose(exerted((damper,), q, v, WHEEL), [-0.6])


def test_forces_may_be_a_list_and_named_apart() -> None:
    forces = [srm.JointTorque("hinge", 1.0), srm.JointTorque("hinge", 2.0, "second")]
    assert len(srm.Mechanism(TREE, forces=forces).forces) == 2  # type: ignore[arg-type]


def test_a_mechanism_with_another_state_keeps_its_forces() -> None:
    mechanism = replace(srm.load("four_bar"), forces=IN_LOOP)
    assert mechanism.with_state(mechanism.q0, 0.0 * mechanism.v0).forces == IN_LOOP
    assert "torque_crank" in repr(mechanism)


def test_a_run_with_forces_is_saved_and_loaded(tmp_path: Path) -> None:
    q, v = random_state(TREE, 3, 0.5)
    elements = tuple(CASES.values())
    for whole in (
        replace(srm.load("four_bar"), forces=IN_LOOP),
        srm.Mechanism(TREE, forces=elements[:2] + elements[4:6], q0=q, v0=v),
    ):
        solution = srm.simulate(whole, 0.2)
        solution.save(tmp_path / "run.npz")
        loaded = srm.load_solution(tmp_path / "run.npz")
        assert loaded.mechanism.forces == whole.forces
        assert np.array_equal(loaded.energy, solution.energy)
        assert np.array_equal(loaded(0.1)[0], solution(0.1)[0])
        for name in loaded.reactions:
            assert np.array_equal(loaded.reactions[name], solution.reactions[name])


# --- descriptions in files ----------------------------------------------------------------------

FORCES = """
[[force]]
name = "strut"
type = "spring_damper"
a = { link = "coupler", xyz = [1.2, 0.0, 0.3] }
b = { link = "world", xyz = [1.0, 0.1, 2.0] }
stiffness = 40
damping = 2.0
rest_length = 0.5

[[force]]
type = "torsion_spring"
joint = "rocker"
stiffness = 3.0
damping = 0.1
rest_angle = 1.0

[[force]]
type = "torque"
joint = "crank"
torque = 0.5

[[force]]
name = "push"
type = "wrench"
at = { link = "coupler", xyz = [1.2, 0.0, 0.3] }
force = [1.0, 2.0, 3.0]
moment = [0.1, 0.2, 0.3]
frame = "link"

[[force]]
type = "bushing"
a = { frame = "crank" }
b = { link = "coupler", rpy = [0.1, 0.2, 0.3] }
stiffness = [50, 80, 20, 3, 9, 5]
damping = [2.0, 0.7, 1.1, 0.3, 0.8, 0.5]

"""
AS_WRITTEN = (
    srm.SpringDamper(COUPLER, TIP, 40.0, 2.0, 0.5, "strut"),
    srm.TorsionSpring("rocker", 3.0, 0.1, 1.0),
    srm.JointTorque("crank", 0.5),
    srm.Wrench(COUPLER, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3), "link", "push"),
    srm.Bushing(
        srm.Anchor(frame="crank"), srm.Anchor("coupler", rpy=(0.1, 0.2, 0.3)), SIX_K, SIX_C
    ),
)


def write(folder: Path, forces: str, more: str = "") -> Path:
    source = srm.load("four_bar").source
    assert source is not None
    (folder / "bar.urdf").write_text(source.urdf)
    text = source.description.replace("../urdf/four_bar.urdf", "bar.urdf")
    path = folder / "bar.toml"
    path.write_text(
        text.replace("[[loop]]", f"{more}\n[[loop]]").replace("[initial]", f"{forces}[initial]", 1)
    )
    return path


def test_forces_of_a_file_are_those_it_describes(tmp_path: Path) -> None:
    mechanism = srm.load(write(tmp_path, FORCES))
    assert mechanism.forces == AS_WRITTEN
    assert [force.name for force in mechanism.forces] == [
        "strut",
        "torsion_spring_rocker",
        "torque_crank",
        "push",
        "bushing_crank_coupler",
    ]
    again = srm.load(tmp_path / "bar.toml", gravity=[0.0, 0.0, 0.0])
    assert again.forces == AS_WRITTEN


FAULTS = {
    "an unknown type": ('"torque"', '"torqe"'),
    "a number as type": ('"torque"', "3"),
    "no type": ('type = "torque"\n', ""),
    "an unknown key": ("damping = 2.0", "dampin = 2.0"),
    "a key of another type": ("torque = 0.5", "torque = 1\na = 1"),
    "an unknown key in an anchor": ("xyz = [1.2", "xzy = [1.2"),
    "no joint": ('joint = "crank"\n', ""),
    "no torque": ("torque = 0.5\n", ""),
    "no anchor": ('a = { frame = "crank" }\n', ""),
    "a text as stiffness": ("stiffness = 40", 'stiffness = "40"'),
    "a nan": ("torque = 0.5", "torque = nan"),
    "five stiffnesses": ("20, 3, 9, 5]", "20, 3, 9]"),
    "two components": ("[1.0, 2.0, 3.0]", "[1.0, 2.0]"),
    "an unknown frame": ('"link"\n', '"body"\n'),
    "negative stiffness": ("stiffness = 40", "stiffness = -4"),
    "no rest length": ("rest_length = 0.5\n", ""),
    "nothing": (
        "stiffness = 3.0\ndamping = 0.1\n",
        ""),
    "an unknown joint": ('joint = "crank"', 'joint = "crnk"'),
    "an unknown link": (
        'at = { link = "coupler"',
        'at = { link = "cupler"'),
    "no link": ('a = { frame = "crank" }', "a = {}"),
    "one body": ('{ frame = "crank" }', '{ link = "coupler" }'),
    "two torques on a hinge": ("torque = 0.5", "torque = [1, 2]"),
    "a name twice": ('"push"', '"strut"'),
    "a single table": ("[[force]]", "[force]"),
    "no table": (FORCES, "force = [1]\n"),
}  # fmt: skip


def test_a_faulty_force_is_refused_by_key(tmp_path: Path) -> None:
    messages = {}
    for fault, (old, new) in FAULTS.items():
        assert old in FORCES
        text = FORCES.replace(old, new, 1)
        path = write(tmp_path, text) if fault != "no table" else write(tmp_path, "", text)
        messages[fault] = refused(partial(srm.load, path), tmp_path)
        assert messages[fault].startswith(path.name)
    path = write(tmp_path, FORCES, 'lock = ["rocker"]')
    messages["a locked joint"] = refused(partial(srm.load, path), tmp_path)
    check_messages("forces", messages)


def test_info_lists_the_forces(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from srm_mbs.cli.app import app

    result = CliRunner().invoke(app, ["info", str(write(tmp_path, FORCES))])
    assert result.exit_code == 0
    lines = [" ".join(line.split()) for line in result.output.splitlines()]
    assert "force type acts on values" in lines
    shown = {line.split()[0]: line.partition(" ")[2] for line in lines if line}
    assert shown["strut"] == (
        "spring_damper coupler xyz [1.2, 0, 0.3] m, world xyz [1, 0.1, 2] m "
        "stiffness 40 N/m, damping 2 N s/m, rest_length 0.5 m"
    )
    assert shown["torque_crank"] == "torque crank torque 0.5 N m"
    for name, values in {
        "push": "force [1, 2, 3] N, moment [0.1, 0.2, 0.3] N m, frame link",
        "torsion_spring_rocker": "stiffness 3 N m/rad, damping 0.1 N m s/rad, rest_angle 1 rad",
        "bushing_crank_coupler": "stiffness [50, 80, 20] N/m, [3, 9, 5] N m/rad, "
        "damping [2, 0.7, 1.1] N s/m, [0.3, 0.8, 0.5] N m s/rad",
    }.items():
        assert shown[name].endswith(values)


def test_what_acts_on_a_joint_is_listed_in_the_units_of_its_coordinates() -> None:
    model = pin.Model()
    plane = model.addJoint(0, pin.JointModelPlanar(), pin.SE3.Identity(), "plane")
    slide = model.addJoint(plane, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    free = model.addJoint(slide, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")
    for joint in (plane, slide, free):
        model.appendBodyToJoint(joint, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3.Identity())
    acting = [
        srm.JointTorque("plane", [1.0, 2.0, 3.0]),
        srm.JointTorque("free", [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        srm.TorsionSpring("slide", 7.0, 0.5, 0.2),
        srm.JointTorque("slide", 2.0, law=srm.Sine(1.0, 1.0)),
    ]
    mechanism = srm.Mechanism(model, forces=acting)
    assert [row[3] for row in force_rows(mechanism)] == [
        "torque [1, 2] N, [3] N m",
        "torque [1, 2, 3] N, [4, 5, 6] N m",
        "stiffness 7 N/m, damping 0.5 N s/m, rest_angle 0.2 m",
        "torque 2 N, law sine",
    ]
    held = srm.equilibrium(mechanism, hold=("plane", "slide", "free"))
    rows = dict(equilibrium_rows(mechanism, held))
    assert rows["to hold plane"].count(" N, [") == 1
    assert rows["to hold plane"].endswith("] N m")
    assert rows["to hold slide"] == f"{held.holding['slide'][0]:.6g} N"


@pytest.mark.parametrize(
    "joint", [pin.JointModelRZ(), pin.JointModelRUBZ(), pin.JointModelSpherical()]
)
@pytest.mark.parametrize(("share", "named"), [(0.95, False), (1.05, True)])
def test_a_run_says_where_a_bushing_turned_by_more_than_half_a_turn(
    joint: Any, share: float, named: bool
) -> None:
    """A wheel of inertia I with the speed w reaches half a turn if I w^2 > K pi^2."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    index = model.addJoint(0, joint, pin.SE3.Identity(), "axle")
    model.appendBodyToJoint(
        index, pin.Inertia(1.0, np.zeros(3), np.diag([0.3, 0.3, 0.4])), pin.SE3.Identity()
    )
    model.addBodyFrame("wheel", index, pin.SE3.Identity(), 0)
    stiffness = 2.5
    bushing = srm.Bushing(
        srm.Anchor("wheel"), srm.Anchor("world"), (0, 0, 0, 0, 0, stiffness), name="rubber"
    )
    speed = share * np.pi * np.sqrt(stiffness / 0.4)
    v0 = np.zeros(model.nv)
    v0[-1] = speed
    wheel = srm.Mechanism(model, forces=[bushing], v0=v0)
    run = srm.simulate(wheel, 2.0)
    assert ("half a turn" in run.message) == named
    assert ("(rubber)" in run.message) == named
