"""Stiff mechanisms: a loop closed by a bushing, joints that rub, dampers that follow a motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs._typing import FloatArray

RATE = 5.0
"""Stiffness over damping of the bushing (1/s)."""
A, B = (2.0, 0.0, 0.0), (1.5, 0.0, 0.0)
"""The pin of the four-bar on the coupler and on the rocker."""


def bushed_four_bar(tau: float) -> srm.Mechanism:
    """The four-bar whose pin is a bushing with the damping 1 kg / ``tau`` (s), overdamped: its
    direction against the links turns with them."""
    open_chain = srm.load("four_bar").without_loop("pin")
    c = 1.0 / tau
    planar = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    bushing = srm.Bushing(
        a=srm.Anchor("coupler", xyz=A),
        b=srm.Anchor("rocker", xyz=B),
        stiffness=tuple(RATE * c * planar),
        damping=tuple(c * planar),
        name="pin",
    )
    return replace(open_chain, forces=(bushing,))


def bushed_reference(mechanism: srm.Mechanism, tau: float, t_end: float) -> FloatArray:
    """Its state at ``t_end`` (s): Radau on Pinocchio's aba, the force in the rocker's axes by
    hand."""
    model = mechanism.model
    data = model.createData()
    frames = [model.getFrameId(name, pin.FrameType.BODY) for name in ("coupler", "rocker")]
    c = 1.0 / tau

    def field(t: float, y: FloatArray) -> FloatArray:
        q, v = y[: model.nq], y[model.nq :]
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        points, jacobians = [], []
        for frame, at in zip(frames, (A, B)):
            J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            arm = data.oMf[frame].rotation @ np.array(at)
            points.append(data.oMf[frame].translation + arm)
            jacobians.append(J[:3] - pin.skew(arm) @ J[3:])
        # The rocker's own point at the coupler's pin: the damper sees the motion from its axes.
        J = pin.getFrameJacobian(model, data, frames[1], pin.LOCAL_WORLD_ALIGNED)
        arm = points[0] - data.oMf[frames[1]].translation
        relative = jacobians[0] - (J[:3] - pin.skew(arm) @ J[3:])
        force = -RATE * c * (points[0] - points[1]) - c * (relative @ v)
        force[1] = 0.0
        return np.concatenate([v, pin.aba(model, data, q, v, relative.T @ force)])

    start = np.concatenate([mechanism.q0, mechanism.v0])
    run = solve_ivp(field, (0.0, t_end), start, method="Radau", rtol=1e-10, atol=1e-11)
    assert run.success
    end: FloatArray = run.y[:, -1]
    return end


def rubbing(name: str, friction: float, speed: float) -> srm.Mechanism:
    """A bundled mechanism with ``friction`` in all joints and the friction speed ``speed``."""
    mechanism = srm.load(name)
    model = mechanism.model.copy()
    model.friction = np.full(model.nv, friction)
    return replace(mechanism, model=model, friction_speed=speed)


def follower(rate: float) -> tuple[srm.Mechanism, Callable[..., FloatArray]]:
    """A block of 1 kg and the force of a damper, of ``rate`` (1/s), to the motion sin t: from the
    start at rest on it, x = sin t."""
    model = pin.Model()
    model.gravity.linear = np.zeros(3)
    joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    model.addBodyFrame("block", joint, pin.SE3.Identity(), 0)

    def force(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        return -np.sin(t) - rate * (v - np.cos(t)) - rate * (q - np.sin(t))

    return srm.Mechanism(model, v0=[1.0]), force
