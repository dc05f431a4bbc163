"""Actuators of a loaded MJCF file beside MuJoCo's own."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin

import srm_mbs as srm


def check_forces(path: Path, mechanism: srm.Mechanism, states: int = 5) -> float:
    """The forces of the actuators at random states and controls are MuJoCo's ``qfrc_actuator``;
    returns the largest of them.

    Joints have the same names in both, and so have actuators, unless the file names none of them;
    those that ``mechanism`` does not have get no control.
    """
    theirs = mujoco.MjModel.from_xml_path(str(path))
    named = [theirs.actuator(i).name for i in range(theirs.nu)]
    numbers = {name: i for i, name in enumerate(named if any(named) else mechanism.actuators)}
    assert len(numbers) == theirs.nu
    state, model = mujoco.MjData(theirs), mechanism.model
    rng = np.random.default_rng(3)
    largest = 0.0
    for _ in range(states):
        q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.2, 1.2, model.nv))
        v = rng.standard_normal(model.nv)
        controls = {name: float(2.0 * rng.standard_normal()) for name in mechanism.actuators}
        mujoco.mj_resetData(theirs, state)
        for name, control in controls.items():
            state.ctrl[numbers[name]] = control
        addresses = []
        for name in mechanism.joint_names:
            joint = mechanism.joint(name)
            if joint.nq == 1:
                at = theirs.joint(name).id
                state.qpos[theirs.jnt_qposadr[at]] += q[joint.idx_q]
                state.qvel[theirs.jnt_dofadr[at]] = v[joint.idx_v]
                addresses.append((joint.idx_v, theirs.jnt_dofadr[at]))
        mujoco.mj_forward(theirs, state)
        tau = srm.actuator_controller(mechanism, controls)(0.0, q, v)
        own, other = np.array(addresses).T
        np.testing.assert_allclose(tau[own], state.qfrc_actuator[other], rtol=1e-12, atol=1e-12)
        assert not np.delete(tau, own).any()
        largest = max(largest, float(np.abs(tau).max()))
    return largest
