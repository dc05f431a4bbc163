"""The charts keep their accuracy from tiny to large rotations, on every group that has one."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import partial

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.manifold import (
    ROTATION_PER_STEP,
    GroupJoint,
    dexp_inverse,
    group_joints,
    planar_translation,
)
from srm_mbs.dynamics.multibody import OpenSystem, make_system

assert_close = partial(np.testing.assert_allclose, rtol=0.0)

JOINTS = {
    "so3": pin.JointModelSpherical,
    "se3": pin.JointModelFreeFlyer,
    "se2": pin.JointModelPlanar,
}
GROUPS = {
    "so3": GroupJoint("so3", 0, 3, 0),
    "se3": GroupJoint("se3", 0, 6, 0),
    "se2": GroupJoint("se2", 0, 3, 0),
}
ANGULAR = {"so3": slice(0, 3), "se3": slice(3, 6), "se2": slice(2, 3)}

# Pinocchio's Jlog is wrong by up to 1e-6 from 3e-4 to 3e-3 rad: the package must not be.
ANGLES = (1e-9, 1e-6, 1e-4, 3e-4, 1e-3, 3e-3, 0.03, 0.3, 1.0, 1.5, 2.0, 3.0)

every_group = pytest.mark.parametrize("group", GROUPS)
every_angle = pytest.mark.parametrize("angle", ANGLES)


def single(*joints: object) -> pin.Model:
    """A chain of bodies of unit inertia on ``joints``."""
    model = pin.Model()
    parent = 0
    for i, joint in enumerate(joints):
        parent = model.addJoint(parent, joint, pin.SE3.Identity(), f"joint_{i}")
        model.appendBodyToJoint(parent, pin.Inertia.FromSphere(1.0, 0.5), pin.SE3.Identity())
    return model


def displacement(group: str, angle: float, rng: np.random.Generator) -> FloatArray:
    """A random tangent vector that turns by ``angle`` (rad)."""
    u = rng.standard_normal(GROUPS[group].size)
    u[ANGULAR[group]] *= angle / np.linalg.norm(u[ANGULAR[group]])
    return u


def round_off(angle: float) -> float:
    """Error allowed: rounding, and the tail of the series after 14 terms."""
    return 2e-15 + 100.0 * (angle / (2 * np.pi)) ** 30


def dexp_exactly(joint: GroupJoint, u: FloatArray, w: FloatArray) -> list[Fraction]:
    """Body velocity for the chart rate w at u: sum_k (-ad_u)^k w / (k + 1)!, to 60 digits."""
    ad = [[Fraction(entry) for entry in row] for row in joint.ad(u).tolist()]
    term = [Fraction(entry) for entry in w.tolist()]
    total = list(term)
    for k in range(1, 60):
        term = [-sum(a * b for a, b in zip(row, term)) / (k + 1) for row in ad]
        term = [Fraction(round(entry * 2**200), 2**200) for entry in term]
        total = [a + b for a, b in zip(total, term)]
    return total


@every_group
@every_angle
def test_chart_rate_undoes_the_exact_differential_of_the_exponential(
    group: str, angle: float
) -> None:
    rng = np.random.default_rng(1)
    for _ in range(3):
        u, v = displacement(group, angle, rng), rng.standard_normal(GROUPS[group].size)
        back = dexp_exactly(GROUPS[group], u, dexp_inverse(GROUPS[group], u, v))
        error = max(abs(float(x - Fraction(y))) for x, y in zip(back, v.tolist()))
        assert error <= round_off(angle) * np.linalg.norm(v) * (1 + np.linalg.norm(u))


def derivative(curve: Callable[[float], FloatArray], step: float) -> FloatArray:
    """Central difference with two Richardson extrapolations, error O(step^6)."""

    def difference(h: float) -> FloatArray:
        return (curve(h) - curve(-h)) / (2 * h)

    coarse, middle, fine = difference(step), difference(step / 2), difference(step / 4)
    return (16 * (4 * fine - middle) - (4 * middle - coarse)) / 45


@every_group
@pytest.mark.parametrize("angle", [0.03, 0.3, 1.0, 1.5, 2.5])
def test_chart_rate_is_the_derivative_of_pinocchios_difference(group: str, angle: float) -> None:
    """Fixes the sign convention: body velocities, q_n on the left."""
    rng = np.random.default_rng(2)
    model = single(JOINTS[group]())
    start = pin.integrate(model, pin.neutral(model), displacement(group, 1.1, rng))
    for _ in range(3):
        u, v = displacement(group, angle, rng), rng.standard_normal(model.nv)
        here = pin.integrate(model, start, u)

        def chart(t: float, here: FloatArray = here, v: FloatArray = v) -> FloatArray:
            moved = pin.difference(model, start, pin.integrate(model, here, t * v))
            return np.asarray(moved)

        expected = derivative(chart, 0.01)
        assert_close(dexp_inverse(GROUPS[group], u, v), expected, atol=2e-10 + round_off(angle))
        assert np.abs(expected - v).max() > 0.1 * min(angle, 1.0) * np.abs(v).max() * 0.1


@every_group
def test_chart_rate_at_the_origin_is_the_velocity_itself(group: str) -> None:
    v = np.random.default_rng(3).standard_normal(GROUPS[group].size)
    np.testing.assert_array_equal(dexp_inverse(GROUPS[group], np.zeros_like(v), v), v)


@every_group
@pytest.mark.parametrize("angle", [1e-6, 3e-4, 1.5])
def test_chart_rate_along_the_displacement_is_the_velocity_itself(group: str, angle: float) -> None:
    u = displacement(group, angle, np.random.default_rng(4))
    assert_close(dexp_inverse(GROUPS[group], u, 3.0 * u), 3.0 * u, atol=5e-15)


@every_group
def test_chart_rate_of_rest_is_rest(group: str) -> None:
    u = displacement(group, 0.7, np.random.default_rng(5))
    np.testing.assert_array_equal(dexp_inverse(GROUPS[group], u, 0.0 * u), 0.0 * u)


@every_group
def test_chart_rate_is_linear_in_the_velocity_over_thirty_decades(group: str) -> None:
    rng = np.random.default_rng(6)
    u, v = displacement(group, 1.2, rng), rng.standard_normal(GROUPS[group].size)
    once = dexp_inverse(GROUPS[group], u, v)
    for scale in (2.0**-50, 2.0**50):
        np.testing.assert_array_equal(dexp_inverse(GROUPS[group], u, scale * v), scale * once)


@pytest.mark.parametrize("group", ["se3", "se2"])
@pytest.mark.parametrize("unit", [2.0**-20, 2.0**20])
def test_chart_rate_does_not_depend_on_the_unit_of_length(group: str, unit: float) -> None:
    rng = np.random.default_rng(7)
    u, v = displacement(group, 1.2, rng), rng.standard_normal(GROUPS[group].size)
    scale = np.ones_like(u)
    scale[: ANGULAR[group].start] = unit
    scaled = dexp_inverse(GROUPS[group], scale * u, scale * v) / scale
    assert_close(scaled, dexp_inverse(GROUPS[group], u, v), rtol=1e-14, atol=1e-14)


@every_group
def test_ad_is_the_bracket_of_pinocchios_motions(group: str) -> None:
    rng = np.random.default_rng(8)
    joint = GROUPS[group]
    u, w = rng.standard_normal(joint.size), rng.standard_normal(joint.size)
    inside = {"so3": [3, 4, 5], "se3": list(range(6)), "se2": [0, 1, 5]}[group]

    def motion(x: FloatArray) -> pin.Motion:
        full = np.zeros(6)
        full[inside] = x
        return pin.Motion(full)

    bracket = motion(u).cross(motion(w)).vector
    assert_close(joint.ad(u) @ w, bracket[inside], atol=1e-15)


# --- which joints have a chart ------------------------------------------------------------------


def test_every_group_joint_is_found_at_its_indices() -> None:
    model = single(
        pin.JointModelRX(),
        pin.JointModelSpherical(),
        pin.JointModelRUBZ(),
        pin.JointModelPlanar(),
        pin.JointModelFreeFlyer(),
    )
    assert group_joints(model) == (
        GroupJoint("so3", 1, 3, 1),
        GroupJoint("se2", 5, 3, 7),
        GroupJoint("se3", 8, 6, 11),
    )


@pytest.mark.parametrize(
    "joint",
    [
        pin.JointModelRUBX(),
        pin.JointModelRY(),
        pin.JointModelPrismaticUnaligned(np.array([0.6, 0.0, 0.8])),
        pin.JointModelTranslation(),
        pin.JointModelUniversal(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])),
        pin.JointModelSphericalZYX(),
    ],
    ids=lambda joint: joint.shortname(),
)
def test_joints_with_commuting_coordinates_need_no_chart(joint: object) -> None:
    model = single(joint)
    assert group_joints(model) == ()
    # Moving by u at the constant rate u is one straight line in these coordinates.
    u = np.linspace(0.2, 0.7, model.nv)
    q = pin.neutral(model)
    once = pin.integrate(model, q, u)
    assert_close(
        pin.integrate(model, pin.integrate(model, q, 0.25 * u), 0.75 * u), once, atol=1e-15
    )


def composite(*joints: object) -> pin.JointModelComposite:
    out = pin.JointModelComposite()
    for joint in joints:
        out.addJoint(joint, pin.SE3.Identity())
    return out


@pytest.mark.parametrize(
    "inside",
    [(pin.JointModelPX(), pin.JointModelSpherical()), (pin.JointModelRUBX(), pin.JointModelRY())],
    ids=["ball", "unbounded joint"],
)
def test_a_composite_joint_that_would_need_a_chart_is_refused_by_name(
    inside: tuple[object, ...],
) -> None:
    model = single(composite(*inside))
    with pytest.raises(srm.InputError, match=r"'joint_0'.*JointModelComposite.*not supported"):
        group_joints(model)


def test_a_composite_of_one_degree_joints_needs_no_chart() -> None:
    assert group_joints(single(composite(pin.JointModelRX(), pin.JointModelPY()))) == ()


# --- the chart of a whole mechanism -------------------------------------------------------------


def mixed_system() -> OpenSystem:
    model = single(
        pin.JointModelFreeFlyer(),
        pin.JointModelRUBY(),
        pin.JointModelSpherical(),
        pin.JointModelPZ(),
        pin.JointModelPlanar(),
    )
    system = make_system(srm.Mechanism(model))
    assert isinstance(system, OpenSystem)
    return system


def test_retraction_is_pinocchios_integration_and_adds_rates() -> None:
    rng = np.random.default_rng(9)
    system = mixed_system()
    q = pin.integrate(system.model, pin.neutral(system.model), rng.uniform(-1, 1, system.nv))
    v, delta = rng.standard_normal(system.nv), rng.uniform(-1, 1, 2 * system.nv)
    state = np.concatenate([q, v])
    moved = system.retract(state, delta)
    q_moved, v_moved = system.split(moved)
    assert_close(q_moved, pin.integrate(system.model, q, delta[: system.nv]), atol=1e-15)
    np.testing.assert_array_equal(v_moved, v + delta[system.nv :])
    np.testing.assert_array_equal(state, np.concatenate([q, v]))


def test_chart_rate_of_a_mechanism_is_the_derivative_of_the_retractions_inverse() -> None:
    rng = np.random.default_rng(10)
    system = mixed_system()
    model, nv = system.model, system.nv
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-1, 1, nv))
    delta, rate = rng.uniform(-0.8, 0.8, 2 * nv), rng.standard_normal(2 * nv)
    here = pin.integrate(model, q, delta[:nv])

    def chart(t: float) -> FloatArray:
        moved = pin.difference(model, q, pin.integrate(model, here, t * rate[:nv]))
        return np.asarray(moved)

    before = rate.copy()
    found = system.chart_rate(delta, rate)
    assert_close(found[:nv], derivative(chart, 0.01), atol=2e-10)
    np.testing.assert_array_equal(found[nv:], rate[nv:])
    np.testing.assert_array_equal(rate, before)


def test_chart_rate_of_a_flat_mechanism_is_the_rate_without_a_copy() -> None:
    system = make_system(srm.load("slider_crank"))
    rate = np.arange(4.0)
    assert system.chart_rate(np.ones(4), rate) is rate


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1.5e-8, 1e-7, 1e-5, 1e-3, 0.1, 1.0, -2.0])
def test_a_planar_joint_moves_without_loss_at_small_turns(angle: float) -> None:
    """Pinocchio's own planar integration is wrong by 1e-8 of the displacement at 1e-8 rad."""
    model = single(pin.JointModelPlanar())
    system = make_system(srm.Mechanism(model))
    q = np.array([0.3, -0.2, np.cos(0.7), np.sin(0.7)])
    u = np.array([1.3, -0.4, angle])
    # exp on SE(2) by its power series: displacement = sum (angle J)^k (dx, dy) / (k + 1)!
    term = np.longdouble([1.3, -0.4])
    total = term.copy()
    for k in range(1, 40):
        term = np.longdouble(angle) * np.array([-term[1], term[0]]) / (k + 1)
        total = total + term
    c, s = np.longdouble(q[2]), np.longdouble(q[3])
    expected = np.array(
        [0.3 + c * total[0] - s * total[1], -0.2 + s * total[0] + c * total[1]], dtype=float
    )
    assert_close(planar_translation(q, u), expected, atol=5e-16)
    moved = system.retract(np.concatenate([q, np.zeros(3)]), np.concatenate([u, np.zeros(3)]))
    assert_close(moved[:2], expected, atol=5e-16)
    assert_close(moved[2:4], [np.cos(0.7 + angle), np.sin(0.7 + angle)], atol=5e-16)


def test_steps_are_limited_by_the_fastest_turning_group_joint() -> None:
    system = mixed_system()
    v = np.zeros(system.nv)

    def limit() -> float:
        return system.step_limit(np.concatenate([pin.neutral(system.model), v]))

    assert limit() == np.inf
    start = {joint.group: joint.start for joint in group_joints(system.model)}
    v[start["se3"] : start["se3"] + 3] = 100.0  # translation does not count
    v[6] = 100.0  # nor does a revolute joint
    assert limit() == np.inf
    v[start["se3"] + 3 : start["se3"] + 6] = (0.0, 3.0, 4.0)
    v[start["so3"] : start["so3"] + 3] = (6.0, 0.0, 8.0)
    v[start["se2"] + 2] = -2.0
    assert limit() == pytest.approx(ROTATION_PER_STEP / 10.0, rel=1e-14)
    v[start["se2"] + 2] = -20.0
    assert limit() == pytest.approx(ROTATION_PER_STEP / 20.0, rel=1e-14)
