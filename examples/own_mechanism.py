"""A mechanism in Python: a pin.Model and a closure.

Two bars of different length hang from the ground and a third bar joins their ends: a four-bar
without a URDF.  The guess determines on which side the coupler lies.
"""

import numpy as np
import pinocchio as pin

import srm_mbs as srm


def add_bar(model: pin.Model, parent: int, name: str, at: float, length: float) -> int:
    """A uniform bar of 1 kg/m along x, hinged about -y (angles from +x towards +z)."""
    placement = pin.SE3(np.eye(3), np.array([at, 0.0, 0.0]))
    hinge = pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))
    joint = model.addJoint(parent, hinge, placement, name)
    moment = length**3 / 12.0
    inertia = pin.Inertia(length, np.array([length / 2, 0, 0]), np.diag([1e-3, moment, moment]))
    model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    model.addBodyFrame(name, joint, pin.SE3.Identity(), 0)
    return joint


model = pin.Model()
model.name = "own four-bar"
crank = add_bar(model, 0, "crank", at=0.0, length=1.0)
add_bar(model, crank, "coupler", at=1.0, length=2.0)
add_bar(model, 0, "rocker", at=2.2, length=1.5)

tip = srm.LoopClosure(
    "point",
    srm.Anchor("coupler", xyz=(2.0, 0.0, 0.0)),
    srm.Anchor("rocker", xyz=(1.5, 0.0, 0.0)),
    name="tip",
)
mechanism = srm.Mechanism(model, loops=[tip])
start = srm.assemble(
    mechanism, {"crank": 1.0}, {"crank": 4.0}, guess={"coupler": -0.7, "rocker": 1.4}
)
print("degrees of freedom:", mechanism.degrees_of_freedom, "redundant:", mechanism.redundant_rows)

solution = srm.simulate(mechanism, 5.0, q0=start.q, v0=start.v)
angle, rate = solution.joint("crank")
print(f"after {solution.t[-1]:g} s the crank is at {angle[-1]:.6f} rad, {rate[-1]:.6f} rad/s")
print("force of the coupler on the rocker at the end (N):", solution.reactions["tip"][-1, :3])
