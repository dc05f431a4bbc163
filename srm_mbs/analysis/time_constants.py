r"""Time constants of damping, friction and springs at the start: what makes a mechanism stiff.

A force -c n^T v along the direction n of generalised forces, on a mechanism at rest whose closures
hold it along the M-orthonormal normals N, decays in the time

    tau = 1 / (c alpha),   alpha = n^T (M^-1 - N N^T) n,

1/alpha being the inertia moved along n, if nothing else damps it.  Friction F tanh(v/v_s) has
c = F/v_s at rest; a spring k vibrates with tau = 1/sqrt(k alpha).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.projection import cholesky, whiten
from srm_mbs.dynamics.forces import Coefficient, resolved_forces
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, make_system
from srm_mbs.dynamics.scaling import angle_coordinates
from srm_mbs.errors import EvaluationError

STIFF_PART = 5e-3
"""Time constant, over the characteristic time of the mechanism, below which an element is stiff:
the stability limit of explicit steps, about six times it, is then below the steps that the motion
needs."""
HELD_PART = 1e-10
"""Part of alpha without closures below which the closures hold the direction."""


@dataclass(frozen=True)
class TimeConstant:
    """The shortest time constant of a joint or of a force element.

    Attributes
    ----------
    element
        Name of the joint, or "force" and the name of the element.
    coefficient
        Its kind, value and unit: "damping 3 N m s/rad".
    seconds
        tau (s).
    """

    element: str
    coefficient: str
    seconds: float


def time_constants(mechanism: Mechanism) -> list[TimeConstant]:
    """Time constants of all joints and force elements at the start, the shortest first.

    Joints without damping and friction, and elements that neither damp nor store energy, have none;
    nor has what closures and drives hold.

    Raises
    ------
    EvaluationError
        If the start cannot be evaluated.
    """
    named = [*_of_joints(mechanism), *_of_forces(mechanism)]
    if not named:
        return []
    alphas = _mobilities(mechanism, np.column_stack([one.direction for _, one, _ in named]))
    shortest: dict[str, TimeConstant] = {}
    for (name, one, text), alpha in zip(named, alphas.tolist()):
        if not alpha > 0.0:
            continue
        seconds = 1.0 / (one.value * alpha)
        if one.kind == "stiffness":
            seconds = float(np.sqrt(seconds))
        if name not in shortest or seconds < shortest[name].seconds:
            shortest[name] = TimeConstant(name, text, seconds)
    return sorted(shortest.values(), key=lambda one: one.seconds)


def stiff_elements(mechanism: Mechanism) -> list[TimeConstant]:
    """Time constants of :func:`time_constants` that are below STIFF_PART of the characteristic
    time; none where the start cannot be evaluated."""
    try:
        found = time_constants(mechanism)
    except EvaluationError:  # in gimbal lock, which is reported where it matters
        return []
    limit = STIFF_PART / mechanism.structure.units.rate if found else 0.0
    return [one for one in found if one.seconds < limit]


_Named = tuple[str, Coefficient, str]
"""Name of the element, one of its coefficients, and that one as text."""


def _of_joints(mechanism: Mechanism) -> list[_Named]:
    """Damping and friction of the joints."""
    model, speed = mechanism.model, mechanism.friction_speed
    if not (model.damping.any() or model.friction.any()):
        return []
    found: list[_Named] = []
    angles = angle_coordinates(model).tolist()
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        for i in range(joint.idx_v, joint.idx_v + joint.nv):
            direction = np.eye(1, model.nv, i)[0]
            if d := float(model.damping[i]):
                one = Coefficient("damping", d, direction, angles[i])
                found.append((name, one, _text(one)))
            if F := float(model.friction[i]):
                one = Coefficient("friction", F / speed, direction, angles[i])
                found.append((name, one, _friction_text(one, speed)))
    return found


def _of_forces(mechanism: Mechanism) -> list[_Named]:
    """Damping and stiffness of the force elements."""
    forces = resolved_forces(mechanism)
    if forces is None:
        return []
    model, data = mechanism.model, workspace(mechanism.model)
    pin.forwardKinematics(model, data, mechanism.q0, mechanism.v0)
    pin.computeJointJacobians(model, data)
    speed = mechanism.friction_speed
    return [
        (f"force {force.name}", one, _friction_text(one, speed) if rubs else _text(one))
        for force, own in zip(mechanism.forces, forces.coefficients(data))
        for one in own
        for rubs in (one.kind == "friction",)
    ]


def _friction_text(one: Coefficient, speed: float) -> str:
    force, rate = ("N m", "rad/s") if one.angular else ("N", "m/s")
    return f"friction {one.value * speed:.6g} {force} at {speed:g} {rate}"


def _text(one: Coefficient) -> str:
    force, length = ("N m", "rad") if one.angular else ("N", "m")
    unit = f"{force} s/{length}" if one.kind == "damping" else f"{force}/{length}"
    return f"{one.kind} {one.value:.6g} {unit}"


def _mobilities(mechanism: Mechanism, directions: FloatArray) -> FloatArray:
    """alpha (k,) of the ``directions`` (nv, k); 0 for those that closures hold."""
    system = make_system(mechanism)
    if isinstance(system, ClosedSystem):
        system.evaluate(0.0, mechanism.start_state)
        U, normals = system.projection.U, system.projection.normals()
    else:
        model = mechanism.model
        U = cholesky(pin.crba(model, workspace(model), mechanism.q0))
        normals = np.zeros((model.nv, 0))
    free = (whiten(U, directions) ** 2).sum(axis=0)
    left: FloatArray = free - ((normals.T @ directions) ** 2).sum(axis=0)
    return np.where(left > HELD_PART * free, left, 0.0)
