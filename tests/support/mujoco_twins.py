"""A translated MJCF file beside MuJoCo's own model of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import tomli_w

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.forces import ForceKinematics
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.formats.document import Document
from srm_mbs.formats.mjcf.reader import translate
from srm_mbs.formats.toml.description import check_description, parse_toml
from srm_mbs.formats.translation import Options
from srm_mbs.formats.urdf.parser import build_urdf
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.reach import Reach
from tests.support.dynamics import check_same_span, closure_rows

mujoco = pytest.importorskip("mujoco")


class Twins:
    """The translated file and MuJoCo's model, in the same state."""

    def __init__(self, text: str, path: Path | None = None) -> None:
        """``path``: where files lie that the text names."""
        options = Options() if path is None else Options(reach=Reach.of(path))
        made = self.made = translate(Document(text, str(path or "robot.xml")), options)
        self.entries = made.entries
        self._carried = {}
        for link in made.tree.findall("link"):
            part = made.entries.get("gravity_compensation", {}).get(link.get("name"))
            if part is not None:
                origin = link.find("inertial/origin")
                centre = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
                mass = part * float(link.find("inertial/mass").get("value"))
                self._carried[link.get("name")] = mass, np.array(centre.split(), dtype=float)
        self.model = build_urdf(made.tree, "x.urdf", made.entries.get("base", "fixed")).model
        self.model.gravity.linear = np.array(made.entries["gravity"])
        keys = {key: value for key, value in made.entries.items() if key != "loop"}
        toml = tomli_w.dumps({"format": 1, "urdf": "x.urdf", **keys})
        forces = check_description(parse_toml(toml, ""), "").force_elements(None)
        self.forces = ForceKinematics(self.model, forces)
        if path is None:
            self.theirs = mujoco.MjModel.from_xml_string(text)
        else:
            self.theirs = mujoco.MjModel.from_xml_path(str(path))
        self.theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.offsets: dict[int, FloatArray] = {}
        self.data, self.state = self.model.createData(), mujoco.MjData(self.theirs)

    def put(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """Both in the state (q, v) of ours; returns T (nv, nv): their rates are T times ours, up
        to what :meth:`bias` adds for a free joint."""
        self.q = q
        model, theirs, state = self.model, self.theirs, self.state
        T = np.zeros((model.nv, model.nv))
        for i in range(theirs.njnt):
            name = self._joint_name(i)
            index = model.getJointId(name if model.existJointName(name) else "root_joint")
            joint = model.joints[index]
            at_q, at_v = theirs.jnt_qposadr[i], theirs.jnt_dofadr[i]
            mine = q[joint.idx_q : joint.idx_q + joint.nq]
            own = slice(joint.idx_v, joint.idx_v + joint.nv)
            T[at_v : at_v + joint.nv, own] = np.eye(joint.nv)
            if joint.nq == 1:
                state.qpos[at_q] = theirs.qpos0[at_q] + mine[0]
            elif joint.nq == 4:
                state.qpos[at_q : at_q + 4] = mine[[3, 0, 1, 2]]
            else:
                body = self._body_name(theirs.jnt_bodyid[i])
                inside = model.frames[model.getFrameId(body, pin.FrameType.BODY)].placement
                pose = model.jointPlacements[index] * pin.XYZQUATToSE3(mine)
                placed = pin.SE3ToXYZQUAT(pose * inside)
                state.qpos[at_q : at_q + 7] = placed[[0, 1, 2, 6, 3, 4, 5]]
                # Theirs: the rate of the body's origin in world axes, and its own angular rate.
                T[at_v : at_v + 3, own][:, :3] = pose.rotation
                T[at_v : at_v + 3, own][:, 3:] = -pose.rotation @ pin.skew(inside.translation)
                T[at_v + 3 : at_v + 6, own][:, 3:] = inside.rotation.T
                self.offsets[index] = inside.translation
        state.qvel[:] = T @ v
        mujoco.mj_forward(theirs, state)
        pin.computeAllTerms(model, self.data, q, v)
        pin.computeJointJacobians(model, self.data, q)
        pin.updateFramePlacements(model, self.data)
        return T

    def _body_name(self, body: int) -> str:
        """As the reader names it if the file does not."""
        name = mujoco.mj_id2name(self.theirs, mujoco.mjtObj.mjOBJ_BODY, body)
        return name or f"body_{body}"

    def _joint_name(self, joint: int) -> str:
        """As the reader names it if the file does not."""
        name = mujoco.mj_id2name(self.theirs, mujoco.mjtObj.mjOBJ_JOINT, joint)
        if name:
            return name
        body = self.theirs.jnt_bodyid[joint]
        number = joint - self.theirs.body_jntadr[body] + 1
        last = number == self.theirs.body_jntnum[body]
        return self._body_name(body) + ("" if last else f"::{number}") + "::joint"

    def body(self, name: str) -> tuple[pin.SE3, pin.SE3]:
        """Placement of a body, ours and theirs."""
        ours = self.data.oMf[self.model.getFrameId(name, pin.FrameType.BODY)]
        i = mujoco.mj_name2id(self.theirs, mujoco.mjtObj.mjOBJ_BODY, name)
        return ours, pin.SE3(self.state.xmat[i].reshape(3, 3), self.state.xpos[i])

    def forces_on(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """Generalised forces (nv,) of springs and compensated weights, after :meth:`put`."""
        model, data = self.model, self.data
        out = np.array(self.forces.generalised(data, q, v, 0.0))
        for name, (mass, centre) in self._carried.items():
            frame = model.getFrameId(name, pin.FrameType.BODY)
            J = pin.computeFrameJacobian(
                model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            )
            arm = data.oMf[frame].rotation @ centre
            out -= mass * (J[:3] - pin.skew(arm) @ J[3:]).T @ model.gravity.linear
        return out

    def anchor(self, entry: dict[str, Any]) -> pin.SE3:
        joint, inside = Anchor(**entry).resolve(self.model)
        return self.data.oMi[joint] * inside

    def coupling(self, entry: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
        """g (1,) and G (1, nv) of a coupling of joints."""
        rows = LoopKinematics(self.model, [LoopClosure(**entry)])
        rows.update(self.data, self.q)
        return rows.g, rows.G

    def residuals(self) -> list[FloatArray]:
        """What MuJoCo's residuals of the equality constraints should be."""
        out = []
        for loop in self.entries.get("loop", ()):
            if loop["type"] == "coupling":
                g, G = self.coupling(loop)
                # Those of tendons have a factor of their own.
                out.append(np.abs(g) / np.linalg.norm(G))
                continue
            a, b = self.anchor(loop["a"]), self.anchor(loop["b"])
            out.append(a.translation - b.translation)
            if loop["type"] == "frame":
                angle = np.linalg.norm(pin.log3(b.rotation.T @ a.rotation))
                out.append(np.array([np.sin(0.5 * angle)]))
        return out


def random_states(twins: Twins, count: int = 5) -> list[tuple[FloatArray, FloatArray]]:
    model = twins.model
    rng = np.random.default_rng(4)
    return [
        (
            pin.integrate(model, pin.neutral(model), rng.uniform(-1.2, 1.2, model.nv)),
            rng.standard_normal(model.nv),
        )
        for _ in range(count)
    ]


def check_dynamics(twins: Twins, atol: float = 1e-10) -> None:
    """Poses of bodies, M and the bias with springs and dampers are those of MuJoCo."""
    model, theirs, state = twins.model, twins.theirs, twins.state
    for q, v in random_states(twins):
        T = twins.put(q, v)
        for i in range(1, theirs.nbody):
            body = mujoco.mj_id2name(theirs, mujoco.mjtObj.mjOBJ_BODY, i)
            if not body:
                continue
            ours, other = twins.body(body)
            np.testing.assert_allclose(ours.homogeneous, other.homogeneous, atol=1e-12)
        M = np.zeros((theirs.nv, theirs.nv))
        mujoco.mj_fullM(theirs, state, M)
        ours = np.triu(twins.data.M) + np.triu(twins.data.M, 1).T
        np.testing.assert_allclose(ours, T.T @ M @ T, rtol=1e-10, atol=1e-12)
        # The linear rate of a free joint is in world axes there: it turns against ours.
        turning = np.zeros(model.nv)
        for joint in model.joints:
            if joint.shortname() == "JointModelFreeFlyer":
                own = slice(joint.idx_v, joint.idx_v + 3)
                rate = v[own.stop : own.stop + 3]
                turning[own] = np.cross(rate, v[own] + np.cross(rate, twins.offsets[joint.id]))
        bias = T.T @ (state.qfrc_bias - state.qfrc_passive) + ours @ turning
        mine = twins.data.nle + model.damping * v - twins.forces_on(q, v)
        np.testing.assert_allclose(mine, bias, rtol=1e-9, atol=atol)


def check_residuals(twins: Twins) -> None:
    """The residuals of the equality constraints, and the rows of couplings but for a factor, are
    those of MuJoCo."""
    for q, v in random_states(twins):
        T = twins.put(q, v)
        expected = []
        for loop, rows, jacobian, scale in equality_rows(twins):
            if loop["type"] == "coupling":
                (G,) = twins.coupling(loop)[1]
                length = np.linalg.norm(jacobian)
                theirs = jacobian[0] @ T / length
                G *= np.sign(theirs @ G) / np.linalg.norm(G)
                np.testing.assert_allclose(G, theirs, atol=1e-12)
                expected.append(np.abs(rows) / length)
                continue
            expected.append(rows[:3])
            if loop["type"] == "frame":
                expected.append(np.array([np.linalg.norm(rows[3:]) / scale]))
        for ours, other in zip(twins.residuals(), expected, strict=True):
            np.testing.assert_allclose(ours, other, atol=1e-12)


def equality_rows(twins: Twins) -> list[tuple[dict[str, Any], FloatArray, FloatArray, float]]:
    """Each closure with the residuals (k,) and the Jacobian (k, nv) that MuJoCo has in its place,
    and the factor of its rows of a rotation, after :meth:`Twins.put`.

    A weld whose rotation has the factor zero is a closure ``point``.
    """
    state, theirs = twins.state, twins.theirs
    held = state.efc_type[: state.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    number = state.efc_id[: state.nefc][held]
    rows = state.efc_pos[: state.nefc][held]
    jacobian = state.efc_J.reshape(state.nefc, -1)[held]
    out = []
    loops = list(twins.entries["loop"])
    for constraint in dict.fromkeys(number.tolist()):
        own = number == constraint
        weld = theirs.eq_type[constraint] == mujoco.mjtEq.mjEQ_WELD
        scale = float(theirs.eq_data[constraint, 10]) if weld else 1.0
        loop = loops.pop(0)
        count = {"point": 3, "frame": 6, "coupling": 1}[loop["type"]]
        assert own.sum() == (6 if weld else count)
        out.append((loop, rows[own][:count], jacobian[own][:count], scale))
    assert not loops
    return out


def check_row_space(twins: Twins, mechanism: Mechanism, q: FloatArray) -> None:
    """At a closed configuration the Jacobian of the closures restrains the rates that MuJoCo's
    equality constraints restrain."""
    T = twins.put(q, np.zeros(mechanism.model.nv))
    theirs = np.concatenate([jacobian @ T for _, _, jacobian, _ in equality_rows(twins)])
    check_same_span(closure_rows(mechanism, q), theirs)
