"""Closures as Pinocchio's constraint models, and back: the same rows."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from tests.support.dynamics import evaluate_rows
from tests.support.snapshots import check_refusals


def placement(rng: np.random.Generator) -> pin.SE3:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))


def tree(seed: int = 0) -> pin.Model:
    """A branching tree with ball, sliding and turning joints."""
    rng = np.random.default_rng(seed)
    model = pin.Model()
    kinds = [pin.JointModelSpherical(), pin.JointModelRX(), pin.JointModelPY(), pin.JointModelRZ()]
    for k, (parent, kind) in enumerate(zip((0, 1, 1, 3), kinds)):
        at, link = placement(rng), placement(rng)
        joint = model.addJoint(parent, kind, at, f"j{k}")
        model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
        model.addBodyFrame(f"link_{k}", joint, link, 0)
    return model


def constraint(kind: str, model: pin.Model, joints: tuple[int, int], seed: int) -> Any:
    rng = np.random.default_rng(seed)
    one, two = (placement(rng) for _ in range(2))
    if kind.startswith("rigid"):
        type_ = pin.ContactType.CONTACT_3D if "3" in kind else pin.ContactType.CONTACT_6D
        return pin.RigidConstraintModel(
            type_, model, joints[0], one, joints[1], two, pin.ReferenceFrame.LOCAL
        )
    made = {"point": pin.PointAnchorConstraintModel, "frame": pin.FrameAnchorConstraintModel}
    anchor = made[kind.removeprefix("wrapped_")](model, joints[0], one, joints[1], two)
    return pin.ConstraintModel(anchor) if kind.startswith("wrapped") else anchor


def of_pinocchio(model: pin.Model, given: Any, q: Any) -> tuple[Any, np.ndarray]:
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    pin.computeJointJacobians(model, data, q)
    constraint_data = given.createData()
    given.calc(model, data, constraint_data)
    J = pin.getConstraintJacobian(model, data, given, constraint_data)
    own = constraint_data.extract() if hasattr(constraint_data, "extract") else constraint_data
    return own.c1Mc2, np.array(J)


@pytest.mark.parametrize("joints", [(2, 4), (4, 2), (0, 4), (3, 0)])
@pytest.mark.parametrize("kind", ["point", "wrapped_point", "rigid3", "frame", "rigid6"])
def test_rows_and_jacobians_are_those_of_pinocchio(kind: str, joints: tuple[int, int]) -> None:
    model = tree()
    given = constraint(kind, model, joints, 1)
    (loop,) = srm.closures_from_pinocchio(model, given)
    rng = np.random.default_rng(2)
    for _ in range(3):
        q = pin.integrate(model, pin.neutral(model), rng.normal(size=model.nv))
        g, G, _ = evaluate_rows(model, LoopKinematics(model, (loop,)), q, np.zeros(model.nv))
        relative, J = of_pinocchio(model, given, q)
        swapped = joints[1] == 0  # b is the world
        if swapped:
            relative = relative.inverse()
        p, R = relative.translation, relative.rotation
        assert g[:3] == pytest.approx(p, abs=1e-12)
        if kind.endswith("point") or kind == "rigid3":
            if swapped:
                continue  # theirs are the rates of b in a
            if kind == "rigid3":  # velocities of two points; ours is that seen from b
                data = model.createData()
                pin.computeJointJacobians(model, data, q)
                local = pin.getJointJacobian(model, data, joints[0], pin.ReferenceFrame.LOCAL)
                turning = given.joint1_placement.rotation.T @ local[3:]
                J = -J - np.cross(turning.T, p).T
            assert pytest.approx(J, abs=1e-11) == G[:3]
            continue
        # Spatial velocity of a in b, at b's origin and in its axes; that of b in a if swapped.
        V = J if kind == "frame" else -J
        if swapped:
            V = -relative.action @ V
        moved = V[:3] + np.cross(V[3:].T, p).T
        assert pytest.approx(moved, abs=1e-11) == G[:3]
        axes = loop.rows.alignments
        for k, (u, n) in enumerate(axes):
            rate = np.array([n @ np.cross(w, R @ u) for w in V[3:].T])
            assert G[3 + k] == pytest.approx(rate, abs=1e-11)


def test_a_mechanism_goes_to_pinocchio_and_comes_back() -> None:
    mechanism = srm.load("spatial_four_bar")
    found = mechanism.to_pinocchio()
    assert found.names == ("ball",)
    assert found.without == ()
    again = srm.Mechanism.from_pinocchio(
        mechanism.model, found.models, q0=mechanism.q0, v0=mechanism.v0
    )
    assert [loop.name for loop in again.loops] == ["ball"]
    end = srm.simulate(mechanism, 0.5, rtol=1e-9).q[-1]
    assert np.abs(srm.simulate(again, 0.5, rtol=1e-9).q[-1] - end).max() < 1e-9


def test_pinocchio_finds_the_same_accelerations() -> None:
    mechanism = srm.load("spatial_four_bar")
    model = mechanism.model
    rigid = mechanism.to_pinocchio().models
    data = model.createData()
    datas = pin.StdVec_RigidConstraintData()
    for one in rigid:
        datas.append(one.createData())
    pin.initConstraintDynamics(model, data, rigid, datas)
    settings = pin.ProximalSettings(1e-14, 1e-10, 20)
    theirs = pin.constraintDynamics(
        model, data, mechanism.q0, mechanism.v0, np.zeros(model.nv), rigid, datas, settings
    )
    ours = srm.simulate(mechanism, 1e-6).accelerations[0]
    assert np.abs(theirs - ours).max() < 1e-6 * np.abs(ours).max()


def test_closures_without_a_model_are_named() -> None:
    found = srm.load("slider_crank").to_pinocchio()
    assert len(found.models) == 0
    assert found.without == ("pin",)


def test_constraints_without_a_closure_are_refused() -> None:
    model = tree()
    shifted = constraint("point", model, (1, 2), 0)
    shifted.desired_constraint_offset = np.array([0.0, 0.0, 0.1])
    desired = constraint("rigid6", model, (1, 2), 0)
    desired.desired_contact_placement = placement(np.random.default_rng(0))
    bare = pin.Model()
    joint = bare.addJoint(0, pin.JointModelRX(), pin.SE3.Identity(), "bare")
    given: dict[str, tuple[pin.Model, Any]] = {
        "joint limits": (model, [pin.JointLimitConstraintModel(model, [2])]),
        "a desired offset": (model, shifted),
        "a desired placement": (model, desired),
        "a joint without frame": (
            bare, pin.PointAnchorConstraintModel(bare, joint, pin.SE3.Identity())
        ),
        "a joint of a larger model": (pin.Model(), constraint("point", model, (1, 2), 0)),
        "a number": (model, [3.0]),
    }  # fmt: skip
    calls = {case: partial(srm.closures_from_pinocchio, *pair) for case, pair in given.items()}
    check_refusals("pinocchio_constraints", calls)


def test_equal_names_are_told_apart() -> None:
    model = tree()
    pair = [constraint("point", model, (1, 4), k) for k in range(2)]
    names = [loop.name for loop in srm.closures_from_pinocchio(model, pair)]
    assert len(set(names)) == 2
