"""Closure rows: g against placements, G and Gdot v against finite differences of g.

The configurations are open (the loops do not close there), because a row and its derivatives must
be right off the closure manifold too: stages and corrections live there.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import LoopKinematics, row_wrenches
from srm_mbs.dynamics.constraints.structure import Structure
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.dynamics.scaling import Units
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.kernel import backend
from srm_mbs.integration.kernel.marshalling import system_struct
from srm_mbs.integration.kernel.system import make_kernel_system
from srm_mbs.model.anchors import WORLD, Anchor
from srm_mbs.model.closures import CLOSURE_TYPES, LoopClosure, perpendicular_basis

assert_close = partial(np.testing.assert_allclose, rtol=0.0)

TYPES = tuple(name for name, kind in CLOSURE_TYPES.items() if "a" in kind.needs)
"""Those between anchors; tests/test_couplings.py has those between joints."""
GRAVITY = np.array([3.0, -5.0, -9.81])

# Anchors of a closure: both branches of the tree, one branch and the ground, one chain.
PLACES = {
    "two branches": ("leg_3", "arm_3"),
    "body and ground": ("arm_4", WORLD),
    "ground and body": (WORLD, "leg_2"),
    "descendant and ancestor": ("leg_4", "leg_1"),
    "ancestor and descendant": ("arm_1", "arm_4"),
}
SEEDS = (0, 1, 2)


def random_placement(rng: np.random.Generator) -> pin.SE3:
    return pin.SE3(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1.0, 1.0, 3))


@cache
def tree(seed: int) -> pin.Model:
    """Two branches of joints of every kind, in an order that depends on ``seed``."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    leg = [
        pin.JointModelFreeFlyer(),
        pin.JointModelRevoluteUnaligned(axis),
        pin.JointModelSpherical(),
        pin.JointModelPrismaticUnaligned(axis[::-1].copy()),
    ]
    arm = [
        pin.JointModelPlanar(),
        pin.JointModelRUBY(),
        pin.JointModelRZ(),
        pin.JointModelSphericalZYX(),
    ]
    rng.shuffle(leg)  # type: ignore[arg-type]
    rng.shuffle(arm)  # type: ignore[arg-type]
    model = pin.Model()
    for branch, joints in (("leg", leg), ("arm", arm)):
        parent = 0
        for number, joint in enumerate(joints, 1):
            name = f"{branch}_{number}"
            parent = model.addJoint(parent, joint, random_placement(rng), f"{name}_joint")
            model.appendBodyToJoint(parent, pin.Inertia.FromSphere(1.0, 0.3), pin.SE3.Identity())
            # The link's frame is not the joint's: anchors must be taken through it.
            model.addBodyFrame(name, parent, random_placement(rng), 0)
    model.gravity.linear = GRAVITY
    return model


def random_state(model: pin.Model, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.0, 1.0, model.nv))
    return q, rng.uniform(-1.0, 1.0, model.nv)


def random_anchor(link: str, rng: np.random.Generator) -> Anchor:
    return Anchor(link, xyz=tuple(rng.uniform(-1, 1, 3)), rpy=tuple(rng.uniform(-1.5, 1.5, 3)))


def random_loop(kind: str, place: str, rng: np.random.Generator) -> LoopClosure:
    link_a, link_b = PLACES[place]
    keys = (*CLOSURE_TYPES[kind].needs, *CLOSURE_TYPES[kind].takes)
    axes = {key: tuple(rng.standard_normal(3)) for key in keys if key.startswith("axis")}
    anchors = random_anchor(link_a, rng), random_anchor(link_b, rng)
    length = rng.uniform(0.5, 2.0) if "length" in keys else None
    return LoopClosure(kind, *anchors, **axes, length=length, name=f"{kind} {place}")


def evaluate(
    model: pin.Model,
    rows: LoopKinematics,
    q: FloatArray,
    v: FloatArray,
    data: pin.Data | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """g, G and Gdot v at (q, v)."""
    data = model.createData() if data is None else data
    pin.crba(model, data, q, pin.Convention.WORLD)
    pin.nonLinearEffects(model, data, q, v)
    rows.update(data, q)
    return rows.g.copy(), rows.G.copy(), rows.bias.copy()


def anchor_placement(model: pin.Model, q: FloatArray, anchor: Anchor) -> tuple[FloatArray, ...]:
    """Rotation and origin of an anchor in the world, from the URDF reading of xyz and rpy."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    name = anchor.link if anchor.link is not None else anchor.frame
    rotation, origin = np.eye(3), np.zeros(3)
    if name != WORLD:
        frame = data.oMf[model.getFrameId(name)]
        rotation, origin = frame.rotation, frame.translation
    own = Rotation.from_euler("xyz", anchor.rpy).as_matrix()
    return rotation @ own, origin + rotation @ np.array(anchor.xyz)


def relative_placement(
    model: pin.Model, q: FloatArray, loop: LoopClosure
) -> tuple[FloatArray, FloatArray]:
    """Rotation R and position p of anchor a in anchor b."""
    Ra, pa = anchor_placement(model, q, loop.a)
    Rb, pb = anchor_placement(model, q, loop.b)
    return Rb.T @ Ra, Rb.T @ (pa - pb)


def extrapolated(difference: Callable[[float], FloatArray], step: float) -> FloatArray:
    """Richardson extrapolation of a central difference, error O(step^6)."""
    coarse, middle, fine = difference(step), difference(step / 2), difference(step / 4)
    first, second = (4 * middle - coarse) / 3, (4 * fine - middle) / 3
    return (16 * second - first) / 15


every_row = pytest.mark.parametrize("kind", TYPES)
every_place = pytest.mark.parametrize("place", tuple(PLACES))
every_seed = pytest.mark.parametrize("seed", SEEDS)


@every_row
@every_place
@every_seed
def test_jacobian_is_the_derivative_of_the_rows(kind: str, place: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    model = tree(seed)
    loop = random_loop(kind, place, rng)
    q, v = random_state(model, rng)
    rows = LoopKinematics(model, (loop,))
    _, G, _ = evaluate(model, rows, q, v)
    data = model.createData()

    def moved(delta: FloatArray) -> FloatArray:
        return evaluate(model, rows, pin.integrate(model, q, delta), v, data)[0]

    for column, e in enumerate(np.eye(model.nv)):
        expected = extrapolated(lambda h, e=e: (moved(h * e) - moved(-h * e)) / (2 * h), 4e-3)
        assert_close(G[:, column], expected, atol=2e-11)
    assert np.abs(G).max(axis=1).min() > 1e-2  # the test sees every row move


@every_row
@every_place
@every_seed
def test_bias_is_the_derivative_of_the_rates_at_constant_body_velocity(
    kind: str, place: str, seed: int
) -> None:
    rng = np.random.default_rng([seed, 2])
    model = tree(seed)
    loop = random_loop(kind, place, rng)
    q, v = random_state(model, rng)
    rows = LoopKinematics(model, (loop,))
    _, _, bias = evaluate(model, rows, q, v)

    def rate(tau: float) -> FloatArray:
        return evaluate(model, rows, pin.integrate(model, q, tau * v), v)[1] @ v

    expected = extrapolated(lambda h: (rate(h) - rate(-h)) / (2 * h), 4e-3)
    assert_close(bias, expected, atol=5e-11 * max(1.0, np.abs(expected).max()))
    assert np.abs(bias).min() > 1e-3


@every_row
@every_seed
def test_bias_is_the_second_derivative_of_the_gap_itself(kind: str, seed: int) -> None:
    """Independent of G: second differences of rows computed from placements."""
    rng = np.random.default_rng([seed, 3])
    model = tree(seed)
    loop = random_loop(kind, "two branches", rng)
    q, v = random_state(model, rng)
    bias = evaluate(model, LoopKinematics(model, (loop,)), q, v)[2]

    def g(tau: float) -> FloatArray:
        moved = pin.integrate(model, q, tau * v)
        return rows_from_placements(loop, *relative_placement(model, moved, loop))

    expected = extrapolated(lambda h: (g(h) - 2 * g(0.0) + g(-h)) / h**2, 4e-2)
    assert_close(bias, expected, atol=2e-8 * max(1.0, np.abs(expected).max()))


def rows_from_placements(loop: LoopClosure, R: FloatArray, p: FloatArray) -> FloatArray:
    """The rows of every type written out, for a's rotation R and position p in b."""
    if loop.type == "point":
        return p
    turns = [R[2, 1], R[0, 2], R[1, 0]]
    if loop.type == "frame":
        return np.array([*p, *turns])
    if loop.type == "universal":
        return np.array([*p, np.array(loop.axis_b) @ R @ np.array(loop.axis_a)])
    if loop.type == "distance":
        return np.array([np.linalg.norm(p) - loop.length])
    axis = np.array(loop.axis)
    n1, n2 = perpendicular_basis(axis)
    if loop.type == "revolute":
        return np.array([*p, n1 @ R @ axis, n2 @ R @ axis])
    if loop.type == "prismatic":
        return np.array([n1 @ p, n2 @ p, *turns])
    if loop.type == "cylindrical":
        return np.array([n1 @ p, n2 @ p, n1 @ R @ axis, n2 @ R @ axis])
    if loop.type == "planar":
        return np.array([axis @ p, n1 @ R @ axis, n2 @ R @ axis])
    if loop.type == "point_on_line":
        return np.array([n1 @ p, n2 @ p])
    if loop.type == "point_on_plane":
        return np.array([axis @ p])
    raise AssertionError(f"this test does not know the rows of {loop.type!r}: write them down here")


@every_row
@every_place
@every_seed
def test_rows_are_the_gaps_between_the_placements_of_the_anchors(
    kind: str, place: str, seed: int
) -> None:
    rng = np.random.default_rng([seed, 4])
    model = tree(seed)
    loop = random_loop(kind, place, rng)
    q, v = random_state(model, rng)
    g = evaluate(model, LoopKinematics(model, (loop,)), q, v)[0]
    expected = rows_from_placements(loop, *relative_placement(model, q, loop))
    assert_close(g, expected, atol=3e-14)
    assert len(g) == loop.rows.count == len(loop.row_names) == len(set(loop.row_names))


@every_row
@every_seed
def test_gravity_does_not_enter_the_bias(kind: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 5])
    model = tree(seed).copy()
    loops = tuple(random_loop(kind, place, rng) for place in PLACES)
    q, v = random_state(model, rng)
    rows = LoopKinematics(model, loops)
    found = []
    for gravity in (np.zeros(3), GRAVITY, -1e3 * GRAVITY):
        model.gravity.linear = gravity
        found.append(evaluate(model, rows, q, v))
    for g, G, bias in found[1:]:
        np.testing.assert_array_equal(g, found[0][0])
        np.testing.assert_array_equal(G, found[0][1])
        assert_close(bias, found[0][2], atol=1e-10)  # 1e4 m/s^2 cancelled
    assert_close(found[1][2], found[0][2], atol=1e-13)


@every_seed
def test_bias_vanishes_at_rest_under_gravity(seed: int) -> None:
    rng = np.random.default_rng([seed, 6])
    model = tree(seed)
    loops = tuple(random_loop(kind, place, rng) for kind in TYPES for place in PLACES)
    q, v = random_state(model, rng)
    rows = LoopKinematics(model, loops)
    assert_close(evaluate(model, rows, q, 0 * v)[2], 0.0, atol=1e-13)


@every_seed
def test_bias_is_quadratic_in_the_rates(seed: int) -> None:
    rng = np.random.default_rng([seed, 7])
    model = tree(seed)
    loops = tuple(random_loop(kind, place, rng) for kind in TYPES for place in PLACES)
    q, v = random_state(model, rng)
    rows = LoopKinematics(model, loops)
    once = evaluate(model, rows, q, v)[2]
    assert_close(evaluate(model, rows, q, -3 * v)[2], 9 * once, atol=1e-12)


@every_row
@every_seed
def test_every_row_moves_only_the_joints_between_its_anchors(kind: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 8])
    model = tree(seed)
    q, v = random_state(model, rng)
    between = {
        "descendant and ancestor": ("leg_2", "leg_3", "leg_4"),
        "ancestor and descendant": ("arm_2", "arm_3", "arm_4"),
        "body and ground": ("arm_1", "arm_2", "arm_3", "arm_4"),
    }
    for place, links in between.items():
        loop = random_loop(kind, place, rng)
        _, G, _ = evaluate(model, LoopKinematics(model, (loop,)), q, v)
        moving = np.zeros(model.nv, dtype=bool)
        for link in links:
            joint = model.joints[model.getJointId(f"{link}_joint")]
            moving[joint.idx_v : joint.idx_v + joint.nv] = True
        assert not G[:, ~moving].any(), place
        assert G[:, moving].any(), place


@every_seed
def test_scales_divide_the_rows_and_only_kept_rows_are_evaluated(seed: int) -> None:
    rng = np.random.default_rng([seed, 9])
    model = tree(seed)
    loops = tuple(
        random_loop(kind, place, rng) for kind, place in zip(TYPES * 2, [*PLACES, *PLACES])
    )
    q, v = random_state(model, rng)
    g, G, bias = evaluate(model, LoopKinematics(model, loops), q, v)
    scale = rng.uniform(0.1, 10.0, len(g))
    for trial in range(6):
        keep = rng.random(len(g)) < (1.0, 0.5, 0.5, 0.5, 0.2, 0.0)[trial]
        part = evaluate(model, LoopKinematics(model, loops, scale, keep), q, v)
        for own, whole in zip(part, (g, G, bias)):
            by = scale if whole.ndim == 1 else scale[:, None]
            assert_close(own, (whole / by)[keep], rtol=1e-13, atol=1e-14)


def test_update_without_bias_leaves_the_rows_the_same() -> None:
    rng = np.random.default_rng(10)
    model = tree(0)
    loops = tuple(random_loop(kind, place, rng) for kind in TYPES for place in PLACES)
    q, v = random_state(model, rng)
    g, G, _ = evaluate(model, LoopKinematics(model, loops), q, v)
    rows = LoopKinematics(model, loops)
    data = model.createData()
    pin.crba(model, data, q, pin.Convention.WORLD)
    rows.update(data, q, with_bias=False)
    np.testing.assert_array_equal(rows.g, g)
    np.testing.assert_array_equal(rows.G, G)


def free_motion(loop: LoopClosure, rng: np.random.Generator) -> pin.SE3:
    """A relative placement of a in b that the closure allows."""
    axis = np.zeros(3) if loop.axis is None else np.array(loop.axis)
    any_rotation = Rotation.random(random_state=rng).as_matrix()
    about_axis = Rotation.from_rotvec(rng.uniform(-3, 3) * axis).as_matrix()
    if loop.type == "prismatic":
        return pin.SE3(np.eye(3), rng.uniform(-2, 2) * axis)
    if loop.type == "cylindrical":
        return pin.SE3(about_axis, rng.uniform(-2, 2) * axis)
    if loop.type == "planar":
        offset = rng.uniform(-2, 2, 3)
        return pin.SE3(about_axis, offset - axis * (axis @ offset))
    if loop.type == "universal":
        # The axes made perpendicular in one way, then turns about each of them.
        u, n = np.array(loop.axis_a), np.array(loop.axis_b)
        across = perpendicular_basis(n)[0]
        start = Rotation.align_vectors(across[None], u[None])[0]
        about_a, about_b = (Rotation.from_rotvec(rng.uniform(-3, 3) * w) for w in (u, n))
        return pin.SE3((about_b * start * about_a).as_matrix(), np.zeros(3))
    if loop.type == "distance":
        direction = rng.standard_normal(3)
        return pin.SE3(any_rotation, loop.length * direction / np.linalg.norm(direction))
    if loop.type == "point":
        return pin.SE3(any_rotation, np.zeros(3))
    if loop.type == "frame":
        return pin.SE3.Identity()
    if loop.type == "revolute":
        return pin.SE3(about_axis, np.zeros(3))
    if loop.type == "point_on_line":
        return pin.SE3(any_rotation, rng.uniform(-2, 2) * axis)
    if loop.type == "point_on_plane":
        offset = rng.uniform(-2, 2, 3)
        return pin.SE3(any_rotation, offset - axis * (axis @ offset))
    raise AssertionError(f"this test does not know the free motion of {loop.type!r}")


def closed_by_anchor(
    model: pin.Model, q: FloatArray, loop: LoopClosure, relative: pin.SE3
) -> LoopClosure:
    """``loop`` with anchor b moved so that a has the placement ``relative`` in b."""
    Ra, pa = anchor_placement(model, q, loop.a)
    wanted = pin.SE3(Ra, pa) * relative.inverse()
    Rl, pl = anchor_placement(model, q, Anchor(loop.b.link))
    inside = pin.SE3(Rl, pl).actInv(wanted)
    anchor = Anchor(
        loop.b.link,
        xyz=tuple(inside.translation),
        rpy=tuple(Rotation.from_matrix(inside.rotation).as_euler("xyz")),
    )
    return replace(loop, b=anchor)


@every_row
@every_place
@every_seed
def test_rows_vanish_wherever_the_closure_is_satisfied(kind: str, place: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 11])
    model = tree(seed)
    q, v = random_state(model, rng)
    loop = random_loop(kind, place, rng)
    closed = closed_by_anchor(model, q, loop, free_motion(loop, rng))
    g = evaluate(model, LoopKinematics(model, (closed,)), q, v)[0]
    assert_close(g, 0.0, atol=1e-13)


@every_row
@every_seed
def test_rows_are_nonzero_where_the_closure_is_violated(kind: str, seed: int) -> None:
    """Each of the motions that a closure forbids shows in its rows, to first order."""
    rng = np.random.default_rng([seed, 12])
    model = tree(seed)
    q, v = random_state(model, rng)
    loop = random_loop(kind, "two branches", rng)
    free = free_motion(loop, rng)
    axis = np.zeros(3) if loop.axis is None else np.array(loop.axis)
    n1, n2 = perpendicular_basis(axis) if axis.any() else (np.zeros(3), np.zeros(3))
    eye = list(np.eye(3))
    crossed = np.zeros(3)
    if loop.type == "universal":
        crossed = np.cross(free.rotation @ np.array(loop.axis_a), np.array(loop.axis_b))
    shifts, turns = {
        "point": (eye, []),
        "frame": (eye, eye),
        "revolute": (eye, [n1, n2]),
        "prismatic": ([n1, n2], eye),
        "cylindrical": ([n1, n2], [n1, n2]),
        "universal": (eye, [crossed]),
        "planar": ([axis], [n1, n2]),
        "distance": ([free.translation / (loop.length or 1.0)], []),
        "point_on_line": ([n1, n2], []),
        "point_on_plane": ([axis], []),
    }[kind]
    size = 1e-4
    found = []
    for shift in shifts:
        moved = pin.SE3(free.rotation, free.translation + size * np.array(shift))
        closed = closed_by_anchor(model, q, loop, moved)
        found.append(evaluate(model, LoopKinematics(model, (closed,)), q, v)[0])
    for turn in turns:
        turned = Rotation.from_rotvec(size * turn).as_matrix() @ free.rotation
        closed = closed_by_anchor(model, q, loop, pin.SE3(turned, free.translation))
        found.append(evaluate(model, LoopKinematics(model, (closed,)), q, v)[0])
    # As many independent rows as forbidden motions, none of them weaker than the others.
    singular = np.linalg.svd(np.array(found) / size, compute_uv=False)
    assert_close(singular, 1.0, atol=1e-3)
    assert np.array(found).shape == (loop.rows.count, loop.rows.count)


def test_rates_of_a_closed_frame_are_the_relative_velocity_in_its_axes() -> None:
    rng = np.random.default_rng(13)
    model = tree(1)
    q, v = random_state(model, rng)
    loop = random_loop("frame", "two branches", rng)
    loop = closed_by_anchor(model, q, loop, pin.SE3.Identity())
    G = evaluate(model, LoopKinematics(model, (loop,)), q, v)[1]
    data = model.createData()
    pin.computeJointJacobians(model, data, q)
    pin.framesForwardKinematics(model, data, q)
    twists = []
    for anchor in (loop.a, loop.b):
        joint, placement = anchor.resolve(model)
        at = data.oMi[joint] * placement
        twists.append(
            at.toActionMatrixInverse()
            @ pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.WORLD)
            @ v
        )
    assert_close(G @ v, twists[0] - twists[1], atol=1e-13)


@every_row
def test_an_anchor_on_a_frame_equals_the_same_anchor_on_its_link(kind: str) -> None:
    rng = np.random.default_rng(14)
    model = tree(2).copy()
    inside = random_placement(rng)
    link = model.frames[model.getFrameId("leg_3")]
    model.addFrame(
        pin.Frame("tip", link.parentJoint, link.placement * inside, pin.FrameType.OP_FRAME)
    )
    loop = random_loop(kind, "two branches", rng)
    offset = anchor_offset(loop.a)
    whole = inside * offset
    on_link = replace(
        loop,
        a=Anchor(
            "leg_3",
            xyz=tuple(whole.translation),
            rpy=tuple(Rotation.from_matrix(whole.rotation).as_euler("xyz")),
        ),
    )
    on_frame = replace(loop, a=Anchor(frame="tip", xyz=loop.a.xyz, rpy=loop.a.rpy))
    q, v = random_state(model, rng)
    for x, y in zip(
        evaluate(model, LoopKinematics(model, (on_link,)), q, v),
        evaluate(model, LoopKinematics(model, (on_frame,)), q, v),
    ):
        assert_close(x, y, atol=1e-13)


def anchor_offset(anchor: Anchor) -> pin.SE3:
    return pin.SE3(Rotation.from_euler("xyz", anchor.rpy).as_matrix(), np.array(anchor.xyz))


@every_row
@every_place
def test_wrenches_of_the_rows_do_the_work_that_the_multipliers_do(kind: str, place: str) -> None:
    """Power of the row wrenches on the anchors' bodies is -lam . (G v), also in open loops."""
    rng = np.random.default_rng(15)
    model = tree(0)
    loop = random_loop(kind, place, rng)
    q, v = random_state(model, rng)
    G = evaluate(model, LoopKinematics(model, (loop,)), q, v)[1]
    data = model.createData()
    pin.forwardKinematics(model, data, q, v)
    wrenches = row_wrenches(loop, model, data)
    at_b = anchor_placement(model, q, loop.b)[1]
    powers = []
    for anchor in (loop.a, loop.b):
        joint, _ = anchor.resolve(model)
        twist = data.oMi[joint].act(data.v[joint])
        velocity = twist.linear + np.cross(twist.angular, at_b)
        powers.append(wrenches @ np.concatenate([velocity, twist.angular]))
    # On b the wrench, on a its opposite at the same point: together -G^T lam.
    assert_close(powers[1] - powers[0], -(G @ v), atol=1e-13)


@pytest.mark.parametrize(
    "axis",
    [*np.eye(3), *-np.eye(3), [1, 1, 1], [1, -1e-9, 0], [0, 1e-300, 1], [-0.3, 0.5, -0.8]],
)
def test_perpendicular_basis_completes_a_right_handed_frame(axis: list[float]) -> None:
    unit = np.array(axis, dtype=float) / np.linalg.norm(axis)
    frame = np.array([unit, *perpendicular_basis(unit)])
    assert_close(frame @ frame.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(frame) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("k", range(3))
def test_perpendicular_basis_of_a_coordinate_axis_is_the_other_coordinate_axes(
    k: int, sign: float
) -> None:
    for vector in perpendicular_basis(sign * np.eye(3)[k]):
        assert sorted(np.abs(vector)) == [0.0, 0.0, 1.0]


@every_row
def test_rows_of_a_type_are_unit_and_alignments_perpendicular(kind: str) -> None:
    rng = np.random.default_rng(16)
    rows = random_loop(kind, "two branches", rng).rows
    count = len(rows.directions) + len(rows.distances) + len(rows.alignments)
    assert rows.count == count
    assert [block.stop - block.start for block in rows.blocks] == [
        count - len(rows.alignments), len(rows.alignments), 0
    ]  # fmt: skip
    assert_close(np.linalg.norm(rows.directions, axis=1), 1.0, atol=1e-15)
    assert_close(rows.directions @ rows.directions.T, np.eye(len(rows.directions)), atol=1e-15)
    for u, n in rows.alignments:
        if kind != "universal":  # whose axes are perpendicular where it is assembled
            assert u @ n == pytest.approx(0.0, abs=1e-15)
        assert np.linalg.norm(u) == pytest.approx(1.0)
        assert np.linalg.norm(n) == pytest.approx(1.0)
    assert_close(np.linalg.norm(rows.matched, axis=1), 1.0, atol=1e-15)


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "cylindrical", "planar"])
def test_a_reversed_axis_satisfies_the_rows_but_not_the_matched_axes(kind: str) -> None:
    rng = np.random.default_rng(17)
    model = tree(0)
    q, v = random_state(model, rng)
    loop = random_loop(kind, "two branches", rng)
    across = perpendicular_basis(np.array(loop.axis))[0] if kind != "prismatic" else np.eye(3)[0]
    reversed_ = pin.SE3(Rotation.from_rotvec(np.pi * across).as_matrix(), np.zeros(3))
    closed = closed_by_anchor(model, q, loop, reversed_)
    assert_close(evaluate(model, LoopKinematics(model, (closed,)), q, v)[0], 0.0, atol=1e-13)
    R, _ = relative_placement(model, q, closed)
    assert np.abs(closed.rows.matched @ R.T - closed.rows.matched).max() > 0.5


@pytest.mark.parametrize("place", ["two branches", "body and ground", "ground and body"])
def test_points_that_coincide_have_no_distance(place: str) -> None:
    rng = np.random.default_rng(18)
    model = tree(0)
    q, v = random_state(model, rng)
    loop = random_loop("distance", place, rng)
    closed = closed_by_anchor(model, q, loop, pin.SE3.Identity())
    with pytest.raises(EvaluationError, match=rf"points of the loop 'distance {place}' coincide"):
        evaluate(model, LoopKinematics(model, (closed,)), q, v)


def test_every_type_says_what_it_needs_and_takes() -> None:
    axis = ("revolute", "prismatic", "cylindrical", "planar", "point_on_line", "point_on_plane")
    needs = dict.fromkeys(axis, ("a", "b", "axis")) | {
        "point": ("a", "b"),
        "frame": ("a", "b"),
        "universal": ("a", "b", "axis_a", "axis_b"),
        "distance": ("a", "b"),
        "coupling": ("joints",),
    }
    assert {name: kind.needs for name, kind in CLOSURE_TYPES.items()} == needs
    takes = {"distance": ("length",), "coupling": ("ratio", "coefficients", "offset")}
    for name, kind in CLOSURE_TYPES.items():
        assert kind.takes == takes.get(name, ())
        assert kind.name == name
        assert kind.summary


SOUND: dict[str, dict[str, Any]] = {
    "a": {"a": Anchor("leg_3")},
    "b": {"b": Anchor("arm_3")},
    "axis": {"axis": (1.0, 0.0, 0.0)},
    "axis_a": {"axis_a": (1.0, 0.0, 0.0)},
    "axis_b": {"axis_b": (0.0, 1.0, 0.0)},
    "length": {"length": 1.0},
    "joints": {"joints": ("x", "y"), "ratio": 2.0},
}
"""For each key, values that a closure can have."""


@pytest.mark.parametrize("kind", CLOSURE_TYPES)
def test_a_missing_or_superfluous_key_is_refused_with_the_remedy(kind: str) -> None:
    needs = CLOSURE_TYPES[kind].needs
    good: dict[str, Any] = {}
    for key in needs:
        good |= SOUND[key]
    assert LoopClosure(kind, **good).name.startswith(f"{kind}_")
    for key in needs:
        less = {name: value for name, value in good.items() if name != key}
        with pytest.raises(srm.InputError, match=rf"a {kind} closure needs .*Give \"{key} = "):
            LoopClosure(kind, **less)
    for key, values in SOUND.items():
        if key in needs or key in CLOSURE_TYPES[kind].takes:
            continue
        with pytest.raises(srm.InputError, match=rf"a {kind} closure takes no {key}.*Remove"):
            LoopClosure(kind, **good | {key: values[key]})
    for key in needs:
        if key.startswith("axis"):
            with pytest.raises(srm.InputError, match=rf"the {key} is zero\. Give a direction"):
                LoopClosure(kind, **good | {key: (0.0, 0.0, 0.0)})


def test_a_length_must_be_positive_and_zero_is_a_point() -> None:
    a, b = Anchor("leg_3"), Anchor("arm_3")
    with pytest.raises(srm.InputError, match=r'of 0 has no direction\. Use type = "point"'):
        LoopClosure("distance", a, b, length=0.0)
    with pytest.raises(srm.InputError, match="-1 m is negative"):
        LoopClosure("distance", a, b, length=-1.0)
    with pytest.raises(srm.InputError, match="length must be 1 finite numbers"):
        LoopClosure("distance", a, b, length=np.nan)


def test_a_length_that_is_not_given_is_the_distance_in_the_initial_configuration() -> None:
    rng = np.random.default_rng(19)
    model = tree(0)
    loop = random_loop("distance", "two branches", rng)
    bare = replace(loop, length=None)
    with pytest.raises(srm.InputError, match=r"known only when it is part.*mechanism\.loops"):
        _ = bare.rows
    q, _ = random_state(model, rng)
    mechanism = srm.Mechanism(model, (bare,), q0=q)
    (resolved,) = mechanism.loops
    expected = np.linalg.norm(relative_placement(model, q, loop)[1])
    assert resolved.length == pytest.approx(expected, rel=1e-14)
    other, v = random_state(model, rng)
    assert mechanism.with_state(other, v).loops == (resolved,)  # the guess, not a later start
    closed = closed_by_anchor(model, q, loop, pin.SE3.Identity())
    with pytest.raises(srm.InputError, match=r'coincide in the guess.*Use type = "point"'):
        srm.Mechanism(model, (replace(closed, length=None),), q0=q)


@pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")
@every_row
def test_the_kernel_evaluates_every_type_like_the_reference(kind: str) -> None:
    """g, G and Gdot v enter E g and the acceleration, at open configurations."""
    rng = np.random.default_rng(20)
    model = tree(1)
    loops = tuple(random_loop(kind, place, rng) for place in PLACES)
    for chosen in (*((loop,) for loop in loops), loops[:2]):
        names = tuple(name for loop in chosen for name in loop.row_names)
        units = Units(1.3, np.ones(model.nv), 1.0)
        scale = rng.uniform(0.5, 2.0, len(names))
        structure = Structure(  # the analysis is not what is tested here
            row_names=names,
            row_scale=scale,
            kept=np.ones(len(names), dtype=bool),
            rank=len(names),
            loop_rank=len(names),
            sigma_ref=0.7,
            units=units,
            samples=1,
            notes=(),
        )
        system = ClosedSystem(srm.Mechanism(model, chosen).with_structure(structure))
        for algebra in ("dense", "sparse"):
            constants = system.constants() | {"algebra": algebra}
            kernel_system = backend.core.System(model, system_struct(constants), None)  # type: ignore[union-attr]
            for _ in range(2):
                x = np.concatenate(random_state(model, rng))
                terms = system.evaluate(0.0, x)
                found = kernel_system.terms(0.0, x, -1.0)
                assert found["rank"] == terms.rank
                for what in ("rate", "correction"):
                    expected = getattr(terms, what)()
                    size = 1.0 + np.abs(expected).max()
                    assert_close(found[what], expected, atol=1e-10 * size)
                residual = terms.constraint_residual()
                assert found["constraint_residual"] == pytest.approx(residual, rel=1e-12)
                assert found["sigma"] == pytest.approx(terms.sigma, rel=1e-10)


@pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")
def test_the_kernel_refuses_points_that_coincide_as_well() -> None:
    rng = np.random.default_rng(21)
    model = tree(0)
    q, v = random_state(model, rng)
    loop = random_loop("distance", "two branches", rng)
    closed = closed_by_anchor(model, q, loop, pin.SE3.Identity())
    system = ClosedSystem(srm.Mechanism(model, (closed,)))
    kernel_system = make_kernel_system(system)
    with pytest.raises(ArithmeticError):
        kernel_system.terms(0.0, np.concatenate([q, v]), -1.0)


def test_the_page_of_closures_lists_every_type_with_its_rows_and_keys() -> None:
    page = (Path(__file__).parents[2] / "docs" / "closures.md").read_text(encoding="utf-8")
    found = {
        name: (int(rows), set(re.findall("`([a-z_]+)`", keys)))
        for name, rows, keys in re.findall(r"^\| `(\w+)` \| (\d) \|([^|]*)\|", page, re.MULTILINE)
    }
    expected = {}
    rng = np.random.default_rng(22)
    for name, kind in CLOSURE_TYPES.items():
        keys = {*kind.needs, *kind.takes} - {"a", "b"}
        count = random_loop(name, "two branches", rng).rows.count if name in TYPES else 1
        expected[name] = (count, keys)
    assert found == expected
    blocks = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    for entry in tomllib.loads("\n".join(blocks))["loop"]:
        assert LoopClosure(**entry | {side: Anchor(side) for side in "ab" if side in entry}).rows
