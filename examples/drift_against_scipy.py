"""Drift of a four-bar, with SciPy on the index-1 equations and with srm_mbs.

SciPy integrates q'' from [M G^T; G 0] [a; lambda] = [f; -Gdot v], the direct use of Pinocchio's
terms.  These equations do not enforce the closure itself, so its residual grows.
"""

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm

mechanism = srm.load("four_bar")
model, data = mechanism.model, mechanism.model.createData()
nv = model.nv
(loop,) = mechanism.loops
PLANE = [0, 2]  # x and z: the y row of a planar loop is redundant
LOCAL = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def end(anchor: srm.Anchor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, Jacobian and bias acceleration of an anchor, in the x-z plane."""
    frame = model.getFrameId(anchor.link, pin.FrameType.BODY)
    arm = data.oMf[frame].rotation @ np.array(anchor.xyz)
    jacobian = pin.getFrameJacobian(model, data, frame, LOCAL)
    bias = pin.getFrameClassicalAcceleration(model, data, frame, LOCAL)
    w = pin.getFrameVelocity(model, data, frame, LOCAL).angular
    position = data.oMf[frame].translation + arm
    moved = jacobian[:3] - pin.skew(arm) @ jacobian[3:]
    turned = bias.linear + np.cross(bias.angular, arm) + np.cross(w, np.cross(w, arm))
    return position[PLANE], moved[PLANE], turned[PLANE]


def field(t: float, x: np.ndarray) -> np.ndarray:
    """Time derivative (v, a) of x = (q, v), by one dense solve."""
    q, v = x[:nv], x[nv:]
    pin.forwardKinematics(model, data, q, v, np.zeros(nv))
    pin.updateFramePlacements(model, data)
    pin.computeJointJacobians(model, data, q)
    (_, Ja, aa), (_, Jb, ab) = end(loop.a), end(loop.b)
    M, nle = pin.crba(model, data, q), pin.nonLinearEffects(model, data, q, v)
    M = np.triu(M) + np.triu(M, 1).T
    G = Ja - Jb
    kkt = np.block([[M, G.T], [G, np.zeros((2, 2))]])
    return np.concatenate([v, np.linalg.solve(kkt, np.concatenate([-nle, ab - aa]))[:nv]])


def gap(q: np.ndarray) -> float:
    """Residual of the closure: distance of its two anchors (m)."""
    pin.framesForwardKinematics(model, data, q)
    pin.computeJointJacobians(model, data, q)
    return float(np.linalg.norm(end(loop.a)[0] - end(loop.b)[0]))


start = np.concatenate([mechanism.q0, mechanism.v0])
times = np.linspace(0.0, 10.0, 11)
scipy = solve_ivp(field, (0.0, 10.0), start, method="DOP853", rtol=1e-6, atol=1e-6, t_eval=times)
ours = srm.simulate(mechanism, 10.0, rtol=1e-6, atol=1e-6)
print("  t (s)   SciPy, index 1   srm_mbs   (gap of the loop in m; ours the largest so far)")
for t, q in zip(times, scipy.y[:nv].T):
    print(f"{t:7.1f}   {gap(q):14.1e}   {ours.drift[ours.t <= t, 0].max():7.0e}")
