"""Static equilibria, against minimisation of the potential energy of reduced models."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import minimize_scalar

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from tests.support.bundled import load
from tests.support.mechanisms import rod
from tests.support.reduced import G

SPRING = load("squeezing_mechanism").forces[1]


def loaded_squeezer(wind: float = 0.05) -> srm.Mechanism:
    """The squeezing mechanism with a torsion spring in place of its motor."""
    bundled = load("squeezing_mechanism")
    forces = (SPRING, srm.TorsionSpring("beta", wind, 0.0, 0.0))
    return srm.Mechanism(bundled.model, bundled.loops, q0=bundled.q0, forces=forces)


def potential(mechanism: srm.Mechanism, joint: str, start: np.ndarray) -> Callable:
    """Potential energy over the angle of ``joint``, other joints closed by assembly, from the
    distances and heights that Pinocchio's kinematics gives."""
    model, data = mechanism.model, mechanism.model.createData()

    def energy(angle: float) -> float:
        q = np.array(start)
        q[mechanism.joint(joint).idx_q] = angle
        q = srm.assemble(mechanism, q, hold=[joint]).q
        pin.forwardKinematics(model, data, q)
        total = 0.0
        for j in range(1, model.njoints):
            centre = data.oMi[j].act(model.inertias[j].lever)
            total -= model.inertias[j].mass * model.gravity.linear @ centre
        for force in mechanism.forces:
            if isinstance(force, srm.TorsionSpring):
                turned = q[mechanism.joint(force.joint).idx_q] - force.rest_angle
                total += 0.5 * force.stiffness * turned**2
            else:
                ends = []
                for anchor in (force.a, force.b):
                    body, inside = anchor.resolve(model)
                    ends.append(data.oMi[body].act(inside.translation))
                length = np.linalg.norm(ends[0] - ends[1])
                total += 0.5 * force.stiffness * (length - force.rest_length) ** 2
        return float(total)

    return energy


def slope(energy: Callable, x: float, h: float = 1e-3) -> float:
    near, far = energy(x + h) - energy(x - h), energy(x + 2 * h) - energy(x - 2 * h)
    return (8.0 * near - far) / (12.0 * h)


def bend(energy: Callable, x: float, h: float = 1e-2) -> float:
    near, far = energy(x + h) + energy(x - h), energy(x + 2 * h) + energy(x - 2 * h)
    return (16.0 * near - far - 30.0 * energy(x)) / (12.0 * h * h)


def test_a_pendulum_hangs_and_stands() -> None:
    model = pin.Model()
    model.appendBodyToJoint(
        model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "hinge"),
        rod(),
        pin.SE3.Identity(),
    )
    mechanism = srm.Mechanism(model, q0=[-0.5 * np.pi])  # upright: nothing pulls
    hanging = srm.equilibrium(mechanism)
    np.testing.assert_allclose(np.cos(hanging.q), 0.0, atol=1e-13)
    np.testing.assert_allclose(np.sin(hanging.q), 1.0)
    np.testing.assert_allclose(hanging.eigenvalues, 1.5 * G, rtol=1e-11)
    assert hanging.stable
    standing = srm.equilibrium(mechanism, [-1.2], search="nearest")
    np.testing.assert_allclose(standing.q, -0.5 * np.pi, atol=1e-13)
    np.testing.assert_allclose(standing.eigenvalues, -1.5 * G, rtol=1e-11)
    assert not standing.stable


@pytest.mark.parametrize(
    ("mechanism", "joint"),
    [
        (load("four_bar"), "crank"),
        (load("slider_crank_regular"), "crank"),
        (loaded_squeezer(), "beta"),
    ],
    ids=["four_bar", "slider_crank", "squeezer"],
)
def test_a_loop_rests_where_its_potential_energy_is_least(mechanism, joint: str) -> None:
    found = srm.equilibrium(mechanism)
    at = float(found.q[mechanism.joint(joint).idx_q])
    energy = potential(mechanism, joint, found.q)
    # Comparing energies finds a minimum to the square root of round-off only.
    best = minimize_scalar(energy, bounds=(at - 0.3, at + 0.3), options={"xatol": 1e-9})
    np.testing.assert_allclose(at, best.x, atol=3e-7)
    assert abs(slope(energy, at)) < 1e-10 * bend(energy, at)
    assert found.stable
    assert not found.neutral
    assert not found.singular
    # omega^2 of the linearisation, which does not use potentials
    twice = srm.linearise(mechanism, found.q).eigenvalues
    np.testing.assert_allclose(np.sqrt(found.eigenvalues[0]), np.abs(twice), rtol=1e-7)


def test_multipliers_balance_gravity() -> None:
    mechanism = load("four_bar")
    found = srm.equilibrium(mechanism)
    model, data = mechanism.model, mechanism.model.createData()
    weight = pin.computeGeneralizedGravity(model, data, found.q)
    pin.crba(model, data, found.q, pin.Convention.WORLD)
    rows = LoopKinematics(model, mechanism.loops)
    rows.update(data, mechanism.q0)
    np.testing.assert_allclose(rows.G.T @ found.multipliers["pin"], -weight, atol=1e-11)
    axes = data.oMi[model.getJointId("rocker")].rotation  # rows count in b's axes
    np.testing.assert_allclose(
        found.reactions["pin"][:3], axes @ found.multipliers["pin"], atol=1e-11
    )


def test_held_joints_need_the_slope_of_the_potential() -> None:
    mechanism = load("four_bar")
    energy = potential(mechanism, "crank", mechanism.q0)
    held = srm.equilibrium(mechanism, hold="crank")
    np.testing.assert_allclose(held.q, mechanism.q0, atol=1e-13)
    np.testing.assert_allclose(held.holding["crank"], slope(energy, 1.0), rtol=1e-9)
    # one of two: the rest moves to where it balances, and the torque is still dV/dq there
    five = load("five_bar")
    found = srm.equilibrium(five, hold=["crank_left"])
    assert abs(found.q - five.q0).max() > 0.1
    assert found.stable
    motion = srm.simulate(
        five,
        0.5,
        q0=found.q,
        v0=np.zeros(4),
        controller=lambda t, q, v: [found.holding["crank_left"][0], 0.0, 0.0, 0.0],
    )
    assert np.abs(motion.v).max() < 1e-8


def test_an_equilibrium_on_a_singular_configuration_is_reported() -> None:
    """Crank and rod of equal length hang one on the other, the slider below the pivot."""
    mechanism = load("slider_crank")
    for search in ("stable", "nearest"):
        found = srm.equilibrium(mechanism, search=search)
        assert found.singular
        np.testing.assert_allclose(np.cos(found.q[0]), 0.0, atol=1e-13)
        # 4/3 + 4 sin^2 = 16/3 times theta'' = -g cos theta (tests.support.reduced.slider_crank)
        np.testing.assert_allclose(found.eigenvalues, 9.81 * 3.0 / 16.0, rtol=1e-8)
        assert found.stable


def test_motions_that_nothing_resists_are_neutral() -> None:
    found = srm.equilibrium(load("spatial_four_bar"))  # its coupler can spin
    assert found.neutral
    assert not found.stable
    np.testing.assert_allclose(found.eigenvalues[0], 0.0, atol=1e-10)
    assert found.eigenvalues[1] > 1.0


def test_a_torque_on_a_wheel_that_nothing_resists_has_no_equilibrium() -> None:
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    hinge = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "wheel")
    model.appendBodyToJoint(hinge, rod(), pin.SE3.Identity())
    mechanism = srm.Mechanism(model, forces=[srm.JointTorque("wheel", 1.0)])
    with pytest.raises(srm.AnalysisError, match="go on doing work"):
        srm.equilibrium(mechanism)
    resting = srm.equilibrium(srm.Mechanism(model))  # without it every angle is one
    assert resting.neutral
    np.testing.assert_array_equal(resting.q, [0.0])


def test_where_there_is_no_equilibrium_it_says_so() -> None:
    bundled = load("four_bar")
    forces = [srm.JointTorque("crank", 500.0)]
    mechanism = srm.Mechanism(bundled.model, bundled.loops, q0=bundled.q0, forces=forces)
    for search in ("stable", "nearest"):
        with pytest.raises(srm.AnalysisError, match=r"no .*equilibrium was found") as caught:
            srm.equilibrium(mechanism, search=search)
        assert caught.value.q.shape == (3,)


def test_an_equilibrium_is_shown_by_its_state_without_its_reactions() -> None:
    shown = repr(srm.equilibrium(load("stewart_platform")))
    assert "stable=" in shown
    assert "eigenvalues=array(" in shown
    assert "reactions" not in shown
    assert len(shown) < 1000
