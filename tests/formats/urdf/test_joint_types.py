"""Joint types that URDF has no word for: spherical, universal and screw joints of the dialect."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.integration.kernel import backend
from tests.integration.kernel.test_kernel import agree
from tests.support.dynamics import mass_matrix
from tests.support.lockstep import compare
from tests.support.snapshots import check_messages, refused
from tests.support.urdf_files import LINK, placement, text

PITCH = 0.3  # m per turn
AXIS, AXIS2 = (2.0, 1.0, 2.0), (0.0, -3.0, 4.0)
PLACES = {
    "swivel": ((0.0, 0.1, 0.2), (0.3, -0.4, 0.5)),
    "cardan": ((0.4, 0.0, 0.1), (0.1, 0.7, -0.2)),
    "hinge": ((0.3, 0.1, 0.0), (0.0, 0.2, 0.9)),
    "thread": ((0.2, 0.0, -0.1), (-0.5, 0.1, 0.3)),
}
MASSES = {"swivel": 1.5, "cardan": 0.8, "hinge": 0.5, "thread": 0.7}
OWN = {
    "swivel": '<dynamics damping="0.3" friction="0.1"/>',
    "cardan": '<axis xyz="2 1 2"/><axis2 xyz="0 -3 4"/><dynamics damping="0.2"/>',
    "hinge": '<axis xyz="0 1 0"/><limit lower="-2" upper="3" effort="4" velocity="5"/>'
    '<dynamics damping="0.7"/>',
    "thread": f'<axis xyz="0 0 2"/><thread_pitch value="{PITCH}"/><limit lower="-9" upper="8"/>'
    '<dynamics damping="0.4" friction="0.05"/>',
}
TYPES = {"swivel": "spherical", "cardan": "universal", "hinge": "revolute", "thread": "screw"}


def urdf(own: dict[str, str] = OWN, types: dict[str, str] = TYPES) -> str:
    """A chain, each link named like the joint that moves it; a tip welded to the last one."""
    out, parent = ['<robot name="joints"><link name="base"/>'], "base"
    for i, name in enumerate(types):
        xyz, rpy = PLACES[name]
        out.append(LINK.format(name=name, mass=MASSES[name], y=0.1 * i))
        out.append(
            f'<joint name="{name}" type="{types[name]}"><parent link="{parent}"/>'
            f'<child link="{name}"/><origin xyz="{text(xyz)}" rpy="{text(rpy)}"/>'
            f"{own[name]}</joint>"
        )
        parent = name
    out.append(
        f'<link name="tip"/><joint name="weld" type="fixed"><parent link="{parent}"/>'
        '<child link="tip"/><origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/></joint></robot>'
    )
    return "\n".join(out)


def load(folder: Path, urdf_text: str, description: str = "") -> srm.Mechanism:
    (folder / "joints.urdf").write_text(urdf_text)
    path = folder / "joints.toml"
    path.write_text(f'format = 1\nurdf = "joints.urdf"\n{description}')
    return srm.load(path)


def elementary(*names: str) -> pin.Model:
    """The chain of these joints as Pinocchio's elementary joints: two hinges for the universal
    joint, a hinge and a slide for the screw."""
    model = pin.Model()
    unit = {axis: np.array(axis) / np.linalg.norm(axis) for axis in (AXIS, AXIS2)}
    kinds: dict[str, list[Any]] = {
        "swivel": [pin.JointModelSpherical()],
        "cardan": [pin.JointModelRevoluteUnaligned(unit[axis]) for axis in (AXIS, AXIS2)],
        "hinge": [pin.JointModelRY()],
        "thread": [pin.JointModelRZ(), pin.JointModelPZ()],
    }
    tensor = np.array([[0.03, 0.002, 0.0], [0.002, 0.05, 0.001], [0.0, 0.001, 0.06]])
    parent = 0
    for i, name in enumerate(names):
        at = placement(*PLACES[name])
        for k, joint in enumerate(kinds[name]):
            parent = model.addJoint(parent, joint, at, f"{name}_{k}")
            at = pin.SE3.Identity()
        centre = placement((0.2, 0.1 * i, 0.1), (0.3, 0.0, 0.1))
        inertia = pin.Inertia(MASSES[name], np.zeros(3), tensor)
        model.appendBodyToJoint(parent, inertia, centre)
    tip = placement((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    model.addFrame(pin.Frame("tip", parent, tip, pin.FrameType.OP_FRAME))
    return model


def expansion(nv: int) -> FloatArray:
    """The elementary coordinates from the nv own ones: the slide moves with the screw, the last."""
    return np.vstack([np.eye(nv), PITCH / (2.0 * np.pi) * np.eye(nv)[-1]])


def tip_at(model: pin.Model, q: FloatArray) -> pin.SE3:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId("tip")].copy()


def test_spherical_universal_and_screw_joints_are_those_of_elementary_joints(
    tmp_path: Path,
) -> None:
    model, reference = load(tmp_path, urdf()).model, elementary(*TYPES)
    assert list(model.names)[1:] == list(TYPES)
    assert (model.nq, model.nv) == (8, 7)
    E = expansion(7)
    rng = np.random.default_rng(1)
    for _ in range(5):
        q = pin.integrate(model, pin.neutral(model), rng.uniform(-2.0, 2.0, 7))
        v = rng.standard_normal(7)
        p, w = np.append(q, E[-1, -1] * q[-1]), E @ v
        M = E.T @ mass_matrix(reference, p) @ E
        np.testing.assert_allclose(mass_matrix(model, q), M, atol=1e-14)
        nle = pin.nonLinearEffects(reference, reference.createData(), p, w)
        ours = pin.nonLinearEffects(model, model.createData(), q, v)
        np.testing.assert_allclose(ours, E.T @ nle, atol=1e-13)
        assert tip_at(model, q).isApprox(tip_at(reference, p), 1e-13)


def test_limits_damping_friction_and_the_other_joints_are_carried_over(tmp_path: Path) -> None:
    model = load(tmp_path, urdf()).model
    np.testing.assert_allclose(model.damping, [0.3, 0.3, 0.3, 0.2, 0.2, 0.7, 0.4])
    np.testing.assert_allclose(model.friction, [0.1, 0.1, 0.1, 0.0, 0.0, 0.0, 0.05])
    at = [model.joints[model.getJointId(name)].idx_q for name in ("hinge", "thread")]
    np.testing.assert_allclose(model.lowerPositionLimit[at], [-2.0, -9.0])
    np.testing.assert_allclose(model.upperPositionLimit[at], [3.0, 8.0])
    assert (model.effortLimit[5], model.velocityLimit[5]) == (4.0, 5.0)


def test_a_locked_joint_of_these_types_is_removed(tmp_path: Path) -> None:
    """The tip stays where the locked joints hold it."""
    held = 'lock = ["cardan", "thread"]\n[initial]\nq = { cardan = [0.3, -0.4], thread = 2.0 }\n'
    whole = load(tmp_path, urdf()).model
    model = load(tmp_path, urdf(), held).model
    assert list(model.names)[1:] == ["swivel", "hinge"]
    q = pin.neutral(whole)
    q[4:6], q[7] = (0.3, -0.4), 2.0
    assert tip_at(whole, q).isApprox(tip_at(model, pin.neutral(model)), 1e-13)


CLOSED = """
[[loop]]
name = "end"
type = "point"
a = { link = "tip" }
b = { link = "world", xyz = [0.7, 0.2, 0.3] }

[initial]
v = { hinge = 1.5 }
"""


@pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")
def test_the_kernel_repeats_every_attempt_on_these_joints(tmp_path: Path) -> None:
    mechanism = load(tmp_path, urdf(), CLOSED)
    assert mechanism.degrees_of_freedom == 4
    agree(compare(mechanism, 0.5, rtol=1e-7))


def test_a_universal_joint_and_a_screw_move_as_scipy_says(tmp_path: Path) -> None:
    """Open chain on the elementary joints, the screw's slide eliminated."""
    types = {name: TYPES[name] for name in ("cardan", "thread")}
    own = {"cardan": OWN["cardan"], "thread": OWN["thread"].replace('friction="0.05"', "")}
    start = "[initial]\nq = { cardan = [0.5, -0.7] }\nv = { cardan = [1.0, 2.0], thread = -3.0 }\n"
    mechanism = load(tmp_path, urdf(own, types), start)
    model, E = elementary("cardan", "thread"), expansion(3)
    damping = np.array([0.2, 0.2, 0.4])

    def field(t: float, x: FloatArray) -> FloatArray:
        q, v = E @ x[:3], E @ x[3:]
        M = E.T @ mass_matrix(model, q) @ E
        nle = E.T @ pin.nonLinearEffects(model, model.createData(), q, v)
        return np.concatenate([x[3:], np.linalg.solve(M, -nle - damping * x[3:])])

    x0 = np.concatenate([mechanism.q0, mechanism.v0])
    run = solve_ivp(field, (0.0, 1.0), x0, "DOP853", rtol=1e-12, atol=1e-12)
    solution = srm.simulate(mechanism, 1.0, rtol=1e-10)
    end = np.concatenate([solution.q[-1], solution.v[-1]])
    np.testing.assert_allclose(end, run.y[:, -1], atol=2e-9)


def test_a_saved_run_on_these_joints_is_read_again(tmp_path: Path) -> None:
    solution = srm.simulate(load(tmp_path, urdf(), CLOSED), 0.1)
    solution.save(tmp_path / "run.npz")
    read = srm.load_solution(tmp_path / "run.npz")
    np.testing.assert_array_equal(read(0.05)[0], solution(0.05)[0])
    np.testing.assert_allclose(read.energy, solution.energy, rtol=1e-12)


FAULTS = {
    "no second axis": ("cardan", '<axis xyz="1 0 0"/>'),
    "axes in line": ("cardan", '<axis xyz="1 2 0"/><axis2 xyz="-2 -4 0"/>'),
    "a zero second axis": ("cardan", '<axis xyz="1 2 0"/><axis2 xyz="0 0 0"/>'),
    "a second axis of two numbers": ("cardan", '<axis2 xyz="0 1"/>'),
    "no pitch": ("thread", '<axis xyz="1 0 0"/>'),
    "a pitch of zero": ("thread", '<thread_pitch value="0"/>'),
    "a pitch on a hinge": ("hinge", OWN["hinge"] + '<thread_pitch value="1"/>'),
    "negative friction": ("swivel", '<dynamics friction="-1"/>'),
}


def test_a_faulty_joint_of_these_types_is_named(tmp_path: Path) -> None:
    messages = {}
    for fault, (joint, own) in FAULTS.items():
        text = urdf(OWN | {joint: own})
        messages[fault] = refused(partial(load, tmp_path, text), tmp_path)
    check_messages("joint_types", messages)


@pytest.mark.parametrize("kind", ["floating", "planar"])
@pytest.mark.parametrize("by", ["kernel", "python"])
def test_damping_slows_a_joint_of_several_degrees_exponentially(
    kind: str, by: str, tmp_path: Path
) -> None:
    if by == "kernel" and backend.core is None:
        pytest.skip("no kernel")
    path = tmp_path / "puck.urdf"
    path.write_text(
        '<robot name="puck"><link name="base"/><link name="puck"><inertial><mass value="2"/>'
        '<inertia ixx="2" iyy="2" izz="2" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<joint name="slides" type="{kind}"><parent link="base"/><child link="puck"/>'
        '<axis xyz="0 0 1"/><dynamics damping="0.6"/></joint></robot>'
    )
    mechanism = srm.load(path, gravity=[0.0, 0.0, 0.0])
    v0 = np.arange(1.0, mechanism.model.nv + 1.0)
    speeds = srm.simulate(mechanism, 3.0, v0=v0, rtol=1e-10, backend=by).v
    # Equal moments of inertia: the body axes do not matter.
    kept = np.linalg.norm(speeds[-1]) / np.linalg.norm(v0)
    np.testing.assert_allclose(kept, np.exp(-0.6 / 2.0 * 3.0), rtol=1e-8)
