"""Closure rows: g against placements, G and Gdot v against finite differences of g.

The configurations are open (the loops do not close there), because a row and its derivatives must
be right off the closure manifold too: stages and corrections live there.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.constraints.structure import Structure
from srm_mbs.dynamics.constraints.wrenches import Placements, row_wrenches
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.dynamics.scaling import Units
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.kernel import backend
from srm_mbs.integration.kernel.marshalling import system_struct
from srm_mbs.integration.kernel.system import make_kernel_system
from srm_mbs.model.anchors import WORLD, Anchor
from srm_mbs.model.closures import CLOSURE_TYPES, LoopClosure, perpendicular_basis
from tests.support.backends import needs_kernel
from tests.support.dynamics import evaluate_rows
from tests.support.mechanisms import random_state
from tests.support.snapshots import check_refusals

assert_close = partial(np.testing.assert_allclose, rtol=0.0)

TYPES = tuple(name for name, kind in CLOSURE_TYPES.items() if "a" in kind.needs)
"""Those between anchors; test_couplings.py has those between joints."""
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


def random_anchor(link: str, rng: np.random.Generator) -> Anchor:
    return Anchor(link, xyz=tuple(rng.uniform(-1, 1, 3)), rpy=tuple(rng.uniform(-1.5, 1.5, 3)))


def random_loop(kind: str, place: str, rng: np.random.Generator) -> LoopClosure:
    link_a, link_b = PLACES[place]
    keys = (*CLOSURE_TYPES[kind].needs, *CLOSURE_TYPES[kind].takes)
    axes = {key: tuple(rng.standard_normal(3)) for key in keys if key.startswith("axis")}
    anchors = random_anchor(link_a, rng), random_anchor(link_b, rng)
    length = rng.uniform(0.5, 2.0) if "length" in keys else None
    return LoopClosure(kind, *anchors, **axes, length=length, name=f"{kind} {place}")


@dataclass(frozen=True)
class Scene:
    """A tree, closures on it, and a state in which they are open."""

    model: pin.Model
    loops: tuple[LoopClosure, ...]
    q: FloatArray
    v: FloatArray
    rng: np.random.Generator

    @property
    def loop(self) -> LoopClosure:
        """The only closure."""
        (loop,) = self.loops
        return loop

    @cached_property
    def kinematics(self) -> LoopKinematics:
        return LoopKinematics(self.model, self.loops)

    def rows(self, q: FloatArray | None = None) -> tuple[FloatArray, FloatArray, FloatArray]:
        """g, G and Gdot v of the closures at (q, v)."""
        return evaluate_rows(self.model, self.kinematics, self.q if q is None else q, self.v)

    def relative(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation R and position p of anchor a in anchor b."""
        Ra, pa = anchor_placement(self.model, q, self.loop.a)
        Rb, pb = anchor_placement(self.model, q, self.loop.b)
        return Rb.T @ Ra, Rb.T @ (pa - pb)

    def moved(self, delta: FloatArray) -> FloatArray:
        """The configuration at q + delta (nv,)."""
        return pin.integrate(self.model, self.q, delta)

    def closed_at(self, relative: pin.SE3) -> Scene:
        """The closure with anchor b moved so that a has the placement ``relative`` in b."""
        link = self.loop.b.link
        wanted = pin.SE3(*anchor_placement(self.model, self.q, self.loop.a)) * relative.inverse()
        body = pin.SE3(*anchor_placement(self.model, self.q, Anchor(link)))
        return replace(self, loops=(replace(self.loop, b=anchor_at(link, body.actInv(wanted))),))


def scene(seed: int, *closures: tuple[str, str]) -> Scene:
    """Closures of given kinds at given places, with anchors, axes and a state from ``seed``."""
    rng = np.random.default_rng([seed, 2])
    model = tree(seed % len(SEEDS))
    loops = tuple(random_loop(kind, place, rng) for kind, place in closures)
    return Scene(model, loops, *random_state(model, rng), rng)


EVERYWHERE = tuple((kind, place) for kind in TYPES for place in PLACES)
"""Closures of all kinds at all places."""


def anchor_at(link: str, placement: pin.SE3) -> Anchor:
    rpy = Rotation.from_matrix(placement.rotation).as_euler("xyz")
    return Anchor(link, xyz=tuple(placement.translation), rpy=tuple(rpy))


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
    here = scene(seed, (kind, place))
    _, G, _ = here.rows()
    for column, e in enumerate(np.eye(here.model.nv)):

        def difference(h: float, e: FloatArray = e) -> FloatArray:
            forward, back = (here.rows(here.moved(step * e))[0] for step in (h, -h))
            return (forward - back) / (2 * h)

        assert_close(G[:, column], extrapolated(difference, 4e-3), atol=2e-11)
    assert np.abs(G).max(axis=1).min() > 1e-2  # the test sees every row move


@every_row
@every_place
@every_seed
def test_bias_is_the_derivative_of_the_rates_at_constant_body_velocity(
    kind: str, place: str, seed: int
) -> None:
    here = scene(seed, (kind, place))
    _, _, bias = here.rows()

    def rate(tau: float) -> FloatArray:
        return here.rows(here.moved(tau * here.v))[1] @ here.v

    expected = extrapolated(lambda h: (rate(h) - rate(-h)) / (2 * h), 4e-3)
    assert_close(bias, expected, atol=5e-11 * max(1.0, np.abs(expected).max()))
    assert np.abs(bias).min() > 1e-3


@every_row
@every_seed
def test_bias_is_the_second_derivative_of_the_gap_itself(kind: str, seed: int) -> None:
    """Independent of G: second differences of rows computed from placements."""
    here = scene(seed, (kind, "two branches"))

    def g(tau: float) -> FloatArray:
        return rows_from_placements(here, here.moved(tau * here.v))

    expected = extrapolated(lambda h: (g(h) - 2 * g(0.0) + g(-h)) / h**2, 4e-2)
    assert_close(here.rows()[2], expected, atol=2e-8 * max(1.0, np.abs(expected).max()))


def rows_from_placements(at: Scene, q: FloatArray) -> FloatArray:
    """The rows of every type written out, for a's rotation R and position p in b."""
    loop = at.loop
    R, p = at.relative(q)
    axis, axis_a, axis_b = (np.array(u or (1, 0, 0)) for u in (loop.axis, loop.axis_a, loop.axis_b))
    n1, n2 = perpendicular_basis(axis)
    across, aligned = [n1 @ p, n2 @ p], [n1 @ R @ axis, n2 @ R @ axis]
    turns = [R[2, 1], R[0, 2], R[1, 0]]
    rows: dict[Any, list[Any]] = {
        "point": [p],
        "frame": [p, turns],
        "revolute": [p, aligned],
        "prismatic": [across, turns],
        "cylindrical": [across, aligned],
        "universal": [p, axis_b @ R @ axis_a],
        "planar": [axis @ p, aligned],
        "distance": [np.linalg.norm(p) - (loop.length or 0.0)],
        "point_on_line": [across],
        "point_on_plane": [axis @ p],
    }
    return np.hstack(rows[loop.type])


@every_row
@every_place
@every_seed
def test_rows_are_the_gaps_between_the_placements_of_the_anchors(
    kind: str, place: str, seed: int
) -> None:
    here = scene(seed, (kind, place))
    g, _, _ = here.rows()
    assert_close(g, rows_from_placements(here, here.q), atol=3e-14)
    names = here.loop.row_names
    assert len(g) == here.loop.rows.count == len(names) == len(set(names))


@every_row
@every_seed
def test_gravity_does_not_enter_the_bias(kind: str, seed: int) -> None:
    here = scene(seed, *((kind, place) for place in PLACES))
    found = []
    for gravity in (np.zeros(3), GRAVITY, -1e3 * GRAVITY):
        model = here.model.copy()
        model.gravity.linear = gravity
        found.append(replace(here, model=model).rows())
    for g, G, bias in found[1:]:
        np.testing.assert_array_equal(g, found[0][0])
        np.testing.assert_array_equal(G, found[0][1])
        assert_close(bias, found[0][2], atol=1e-10)  # 1e4 m/s^2 cancelled
    assert_close(found[1][2], found[0][2], atol=1e-13)


@every_seed
def test_bias_is_quadratic_in_the_rates(seed: int) -> None:
    """So it vanishes at rest, also under gravity."""
    here = scene(seed, *EVERYWHERE)
    at_rest, once, back = (replace(here, v=k * here.v).rows()[2] for k in (0, 1, -3))
    assert_close(at_rest, 0.0, atol=1e-13)
    assert_close(back, 9 * once, atol=1e-12)


@pytest.mark.parametrize(
    ("place", "links"),
    [
        ("descendant and ancestor", ("leg_2", "leg_3", "leg_4")),
        ("ancestor and descendant", ("arm_2", "arm_3", "arm_4")),
        ("body and ground", ("arm_1", "arm_2", "arm_3", "arm_4")),
    ],
)
@every_row
@every_seed
def test_every_row_moves_only_the_joints_between_its_anchors(
    kind: str, place: str, links: tuple[str, ...], seed: int
) -> None:
    here = scene(seed, (kind, place))
    _, G, _ = here.rows()
    moving = np.zeros(here.model.nv, dtype=bool)
    for link in links:
        joint = here.model.joints[here.model.getJointId(f"{link}_joint")]
        moving[joint.idx_v : joint.idx_v + joint.nv] = True
    assert not G[:, ~moving].any()
    assert G[:, moving].any()


@every_seed
def test_scales_divide_the_rows_and_only_kept_rows_are_evaluated(seed: int) -> None:
    here = scene(seed, *zip(TYPES * 2, [*PLACES, *PLACES]))
    whole = here.rows()
    scale = here.rng.uniform(0.1, 10.0, len(whole[0]))
    for share in (1.0, 0.5, 0.5, 0.5, 0.2, 0.0):
        keep = here.rng.random(len(scale)) < share
        rows = LoopKinematics(here.model, here.loops, scale, keep)
        for part, all_ in zip(evaluate_rows(here.model, rows, here.q, here.v), whole):
            by = scale if all_.ndim == 1 else scale[:, None]
            assert_close(part, (all_ / by)[keep], rtol=1e-13, atol=1e-14)


def test_update_without_bias_leaves_the_rows_the_same() -> None:
    here = scene(3, *EVERYWHERE)
    g, G, _ = here.rows()
    rows = LoopKinematics(here.model, here.loops)
    data = here.model.createData()
    pin.crba(here.model, data, here.q, pin.Convention.WORLD)
    rows.update(data, here.q)
    np.testing.assert_array_equal(rows.g, g)
    np.testing.assert_array_equal(rows.G, G)


def free_motion(loop: LoopClosure, rng: np.random.Generator) -> pin.SE3:
    """A relative placement of a in b that the closure allows."""
    axis, u, n = (np.array(u or (1, 0, 0)) for u in (loop.axis, loop.axis_a, loop.axis_b))
    fixed, any_rotation = Rotation.identity(), Rotation.random(random_state=rng)
    about_axis, about_u, about_n = (
        Rotation.from_rotvec(rng.uniform(-3, 3) * w) for w in (axis, u, n)
    )
    # The axes of the cross made perpendicular in one way, then turns about each of them.
    crossed = about_n * Rotation.align_vectors(perpendicular_basis(n)[0], u)[0] * about_u
    offset, along = rng.uniform(-2, 2, 3), rng.uniform(-2, 2) * axis
    in_plane = offset - axis * (axis @ offset)
    at_length = (loop.length or 0.0) * offset / np.linalg.norm(offset)
    here = np.zeros(3)
    motions: dict[Any, tuple[Rotation, FloatArray]] = {
        "point": (any_rotation, here),
        "frame": (fixed, here),
        "revolute": (about_axis, here),
        "prismatic": (fixed, along),
        "cylindrical": (about_axis, along),
        "universal": (crossed, here),
        "planar": (about_axis, in_plane),
        "distance": (any_rotation, at_length),
        "point_on_line": (any_rotation, along),
        "point_on_plane": (any_rotation, in_plane),
    }
    rotation, translation = motions[loop.type]
    return pin.SE3(rotation.as_matrix(), translation)


@every_row
@every_place
@every_seed
def test_rows_vanish_wherever_the_closure_is_satisfied(kind: str, place: str, seed: int) -> None:
    here = scene(seed, (kind, place))
    assert_close(here.closed_at(free_motion(here.loop, here.rng)).rows()[0], 0.0, atol=1e-13)


@every_row
@every_seed
def test_rows_are_nonzero_where_the_closure_is_violated(kind: str, seed: int) -> None:
    """Each of the motions that a closure forbids shows in its rows, to first order."""
    here = scene(seed, (kind, "two branches"))
    loop = here.loop
    free = free_motion(loop, here.rng)
    axis, axis_a, axis_b = (np.array(u or (1, 0, 0)) for u in (loop.axis, loop.axis_a, loop.axis_b))
    across, eye = list(perpendicular_basis(axis)), list(np.eye(3))
    shifts, turns = {
        "point": (eye, []),
        "frame": (eye, eye),
        "revolute": (eye, across),
        "prismatic": (across, eye),
        "cylindrical": (across, across),
        "universal": (eye, [np.cross(free.rotation @ axis_a, axis_b)]),
        "planar": ([axis], across),
        "distance": ([free.translation / (loop.length or 1.0)], []),
        "point_on_line": (across, []),
        "point_on_plane": ([axis], []),
    }[kind]
    size = 1e-4
    violations = [pin.SE3(free.rotation, free.translation + size * shift) for shift in shifts]
    for turn in turns:
        turned = Rotation.from_rotvec(size * turn).as_matrix() @ free.rotation
        violations.append(pin.SE3(turned, free.translation))
    found = np.array([here.closed_at(violation).rows()[0] for violation in violations])
    # As many independent rows as forbidden motions, none of them weaker than the others.
    assert_close(np.linalg.svd(found / size, compute_uv=False), 1.0, atol=1e-3)
    assert found.shape == (loop.rows.count, loop.rows.count)


def test_rates_of_a_closed_frame_are_the_relative_velocity_in_its_axes() -> None:
    here = scene(1, ("frame", "two branches")).closed_at(pin.SE3.Identity())
    data = here.model.createData()
    pin.forwardKinematics(here.model, data, here.q, here.v)
    twists = []
    for joint, placement in here.loop.resolve(here.model):
        twists.append(placement.actInv(data.v[joint]).vector)
    assert_close(here.rows()[1] @ here.v, twists[0] - twists[1], atol=1e-13)


@every_row
def test_an_anchor_on_a_frame_equals_the_same_anchor_on_its_link(kind: str) -> None:
    here = scene(2, (kind, "two branches"))
    model, a = here.model.copy(), here.loop.a
    inside = random_placement(here.rng)
    link = model.frames[model.getFrameId("leg_3")]
    model.addFrame(
        pin.Frame("tip", link.parentJoint, link.placement * inside, pin.FrameType.OP_FRAME)
    )
    offset = pin.SE3(Rotation.from_euler("xyz", a.rpy).as_matrix(), np.array(a.xyz))
    on_link, on_frame = (
        replace(here, model=model, loops=(replace(here.loop, a=anchor),)).rows()
        for anchor in (
            anchor_at("leg_3", inside * offset),
            Anchor(frame="tip", xyz=a.xyz, rpy=a.rpy),
        )
    )
    for x, y in zip(on_link, on_frame):
        assert_close(x, y, atol=1e-13)


def test_a_coupling_of_one_joint_is_named_after_it() -> None:
    lock = LoopClosure("coupling", joints="crank", coefficients=[1.0])  # type: ignore[arg-type]
    assert lock.name == "coupling_crank"
    assert lock.joints == ("crank",)


def test_closures_drives_and_actuators_show_only_what_was_given() -> None:
    anchor = "Anchor(link='rod', xyz=(1.0, 0.0, 0.0))"
    pin_joint = LoopClosure("point", Anchor("rod", (1.0, 0.0, 0.0)), Anchor(frame="tip"), name="p")
    drive = srm.Drive(srm.ConstantSpeed(2.0), "crank")
    places = f"a={anchor}, b=Anchor(frame='tip')"
    assert repr(pin_joint) == f"LoopClosure(type='point', {places}, name='p')"
    assert repr(drive) == "Drive(law=ConstantSpeed(speed=2.0), joint='crank', name='crank')"
    assert repr(srm.Actuator("crank", gear=2.0)) == "Actuator(joint='crank', gear=2.0)"


def test_an_anchor_on_a_link_takes_its_place_after_the_name() -> None:
    place = (1.0, 0.0, 0.5)
    for given in (place, list(place), np.array(place)):
        assert Anchor("rod", given) == Anchor(link="rod", xyz=place)
    with pytest.raises(srm.InputError, match="either a link or a frame"):
        Anchor("rod", "tip")
    with pytest.raises(srm.InputError, match="xyz must be 3 finite numbers"):
        Anchor("rod", (1.0, 0.0))


def test_a_joint_in_place_of_a_link_is_refused_with_the_links_that_it_moves() -> None:
    model = srm.load("four_bar").model.copy()
    knob = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "knob")
    with pytest.raises(srm.InputError, match=r"joint of this name moves none: add a link with"):
        Anchor("knob").resolve(model)
    model.addBodyFrame("handle", knob, pin.SE3.Identity(), 0)
    with pytest.raises(srm.InputError, match=r"'knob'\. Known: .*this name moves handle$"):
        Anchor("knob").resolve(model)


@every_row
@every_place
def test_wrenches_of_the_rows_do_the_work_that_the_multipliers_do(kind: str, place: str) -> None:
    """Power of the row wrenches on the anchors' bodies is -lam . (G v), also in open loops."""
    here = scene(0, (kind, place))
    data = here.model.createData()
    pin.forwardKinematics(here.model, data, here.q, here.v)
    placed = Placements.empty(here.model, 1)
    placed.take(0, data)
    wrenches = row_wrenches(here.loop, here.model, placed)[0]
    at_b = anchor_placement(here.model, here.q, here.loop.b)[1]
    powers = []
    for joint, _ in here.loop.resolve(here.model):
        twist = data.oMi[joint].act(data.v[joint])
        velocity = twist.linear + np.cross(twist.angular, at_b)
        powers.append(wrenches @ np.concatenate([velocity, twist.angular]))
    # On b the wrench, on a its opposite at the same point: together -G^T lam.
    assert_close(powers[1] - powers[0], -(here.rows()[1] @ here.v), atol=1e-13)


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
    rows = scene(0, (kind, "two branches")).loop.rows
    lengths, alignments, joints = (block.stop - block.start for block in rows.blocks)
    assert lengths == len(rows.directions) + len(rows.distances)
    assert (alignments, joints) == (len(rows.alignments), 0)
    assert rows.count == lengths + alignments
    assert_close(rows.directions @ rows.directions.T, np.eye(len(rows.directions)), atol=1e-15)
    for u, n in rows.alignments:
        if kind != "universal":  # whose axes are perpendicular where it is assembled
            assert u @ n == pytest.approx(0.0, abs=1e-15)
    assert_close(np.linalg.norm(rows.alignments, axis=2), 1.0, atol=1e-15)
    assert_close(np.linalg.norm(rows.matched, axis=1), 1.0, atol=1e-15)


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "cylindrical", "planar"])
def test_a_reversed_axis_satisfies_the_rows_but_not_the_matched_axes(kind: str) -> None:
    here = scene(0, (kind, "two branches"))
    axis = np.eye(3)[1] if kind == "prismatic" else np.array(here.loop.axis)
    turn = Rotation.from_rotvec(np.pi * perpendicular_basis(axis)[0])
    here = here.closed_at(pin.SE3(turn.as_matrix(), np.zeros(3)))
    assert_close(here.rows()[0], 0.0, atol=1e-13)
    R, _ = here.relative(here.q)
    assert np.abs(here.loop.rows.matched @ R.T - here.loop.rows.matched).max() > 0.5


@pytest.mark.parametrize("place", ["two branches", "body and ground", "ground and body"])
def test_points_that_coincide_have_no_distance(place: str) -> None:
    here = scene(0, ("distance", place)).closed_at(pin.SE3.Identity())
    with pytest.raises(EvaluationError, match=rf"points of the loop 'distance {place}' coincide"):
        here.rows()


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
    coupling = ("ratio", "coefficients", "offset", "polynomial", "arguments")
    takes = {"distance": ("length",), "coupling": coupling}
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


def refusals() -> dict[str, Callable[[], object]]:
    """Closures that lack a key, have one too many, or have a value that cannot be."""
    calls: dict[str, Callable[[], object]] = {}
    calls["an unknown type"] = partial(LoopClosure, "hinge", Anchor("leg_3"), Anchor("arm_3"))
    for kind, type_ in CLOSURE_TYPES.items():
        good: dict[str, Any] = {}
        for key in type_.needs:
            good |= SOUND[key]
        assert LoopClosure(kind, **good).name.startswith(f"{kind}_")
        for key, values in SOUND.items():
            if key in type_.needs:
                less = {name: value for name, value in good.items() if name != key}
                calls[f"{kind} without {key}"] = partial(LoopClosure, kind, **less)
                if key.startswith("axis"):
                    zero = good | {key: (0.0, 0.0, 0.0)}
                    calls[f"{kind} with a zero {key}"] = partial(LoopClosure, kind, **zero)
            elif key not in type_.takes:
                more = good | {key: values[key]}
                calls[f"{kind} with {key}"] = partial(LoopClosure, kind, **more)
    calls["an axis of two numbers"] = partial(
        LoopClosure, "point_on_plane", Anchor("leg_3"), Anchor("arm_3"), (1.0, 0.0)
    )
    for length in (0.0, -1.0, np.nan):
        calls[f"distance of length {length:g}"] = partial(
            LoopClosure, "distance", Anchor("leg_3"), Anchor("arm_3"), length=length
        )
    return calls


def test_closures_are_refused_by_key_with_a_remedy() -> None:
    check_refusals("closures", refusals())


def test_a_length_that_is_not_given_is_the_distance_in_the_initial_configuration() -> None:
    here = scene(0, ("distance", "two branches"))
    bare = replace(here.loop, length=None)
    with pytest.raises(srm.InputError, match=r"known only when it is part.*mechanism\.loops"):
        _ = bare.rows
    mechanism = srm.Mechanism(here.model, (bare,), q0=here.q)
    (resolved,) = mechanism.loops
    expected = np.linalg.norm(here.relative(here.q)[1])
    assert resolved.length == pytest.approx(expected, rel=1e-14)
    other = random_state(here.model, here.rng)
    assert mechanism.with_state(*other).loops == (resolved,)  # the guess, not a later start
    closed = here.closed_at(pin.SE3.Identity()).loop
    with pytest.raises(srm.InputError, match=r'coincide in the guess.*Use type = "point"'):
        srm.Mechanism(here.model, (replace(closed, length=None),), q0=here.q)


@needs_kernel
@every_row
def test_the_kernel_evaluates_every_type_like_the_reference(kind: str) -> None:
    """g, G and Gdot v enter E g and the acceleration, at open configurations."""
    here = scene(1, *((kind, place) for place in PLACES))
    model, loops, rng = here.model, here.loops, here.rng
    for chosen in (*((loop,) for loop in loops), loops[:2]):
        names = tuple(name for loop in chosen for name in loop.row_names)
        structure = Structure(  # the analysis is not what is tested here
            row_names=names,
            row_scale=rng.uniform(0.5, 2.0, len(names)),
            kept=np.ones(len(names), dtype=bool),
            rank=len(names),
            loop_rank=len(names),
            sigma_ref=0.7,
            units=Units(1.3, np.ones(model.nv), 1.0),
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


@needs_kernel
def test_the_kernel_refuses_points_that_coincide_as_well() -> None:
    here = scene(0, ("distance", "two branches")).closed_at(pin.SE3.Identity())
    kernel_system = make_kernel_system(ClosedSystem(srm.Mechanism(here.model, here.loops)))
    with pytest.raises(ArithmeticError):
        kernel_system.terms(0.0, np.concatenate([here.q, here.v]), -1.0)


def test_the_page_of_closures_lists_every_type_with_its_rows_and_keys() -> None:
    page = (Path(__file__).parents[2] / "docs" / "closures.md").read_text(encoding="utf-8")
    found = {
        name: (int(rows), set(re.findall("`([a-z_]+)`", keys)))
        for name, rows, keys in re.findall(r"^\| `(\w+)` \| (\d) \|([^|]*)\|", page, re.MULTILINE)
    }
    expected = {}
    for name, kind in CLOSURE_TYPES.items():
        keys = {*kind.needs, *kind.takes} - {"a", "b"}
        count = scene(0, (name, "two branches")).loop.rows.count if name in TYPES else 1
        expected[name] = (count, keys)
    assert found == expected
    blocks = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    for entry in tomllib.loads("\n".join(blocks))["loop"]:
        assert LoopClosure(**entry | {side: Anchor(side) for side in "ab" if side in entry}).rows
