"""Evaluators of the force elements on one joint: torques, springs, limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.forces import JointTorque, LimitSpring, TorsionSpring
from srm_mbs.systems.force_evaluators import OverTime


class JointTorqueEvaluator:
    """A :class:`~srm_mbs.forces.JointTorque`, resolved against a model."""

    def __init__(self, model: pin.Model, force: JointTorque) -> None:
        joint = model.joints[model.getJointId(force.joint)]
        self.own = slice(joint.idx_v, joint.idx_v + joint.nv)
        self.torque = OverTime(np.atleast_1d(np.array(force.torque, dtype=float)), force.law)

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        tau[self.own] += self.torque.at(t)

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        return 0.0

    def constants(self) -> dict[str, Any]:
        return {"kind": 1, "in_v": self.own.start} | self.torque.constants()


class TorsionSpringEvaluator:
    """A :class:`~srm_mbs.forces.TorsionSpring`, resolved against a model."""

    def __init__(self, model: pin.Model, force: TorsionSpring) -> None:
        joint = model.joints[model.getJointId(force.joint)]
        self.in_q, self.in_v = joint.idx_q, joint.idx_v
        self.stiffness, self.damping = force.stiffness, force.damping
        self.rest_angle = force.rest_angle

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        turned = q[self.in_q] - self.rest_angle
        tau[self.in_v] -= self.stiffness * turned + self.damping * v[self.in_v]

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        return 0.5 * self.stiffness * float(q[self.in_q] - self.rest_angle) ** 2

    def constants(self) -> dict[str, Any]:
        return {
            "kind": 2,
            "in_q": self.in_q,
            "in_v": self.in_v,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "rest": self.rest_angle,
        }


class LimitSpringEvaluator:
    """A :class:`~srm_mbs.forces.LimitSpring`, resolved against a model."""

    def __init__(self, model: pin.Model, force: LimitSpring) -> None:
        joint = model.joints[model.getJointId(force.joint)]
        self.in_q, self.in_v = joint.idx_q, joint.idx_v
        self.stiffness, self.damping = force.stiffness, force.damping
        self.lower, self.upper, self.depth = force.resolved(model)

    def _beyond(self, q: FloatArray) -> float:
        position = float(q[self.in_q])
        return max(position - self.upper, 0.0) + min(position - self.lower, 0.0)

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        beyond = self._beyond(q)
        if beyond == 0.0:
            return
        x = min(abs(beyond) / self.depth, 1.0)
        contact = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        tau[self.in_v] -= contact * (self.stiffness * beyond + self.damping * v[self.in_v])

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        """The integral of k d S(d / depth)."""
        beyond, depth = abs(self._beyond(q)), self.depth
        x = min(beyond / depth, 1.0)
        inside = depth**2 * x**5 * (2.0 + x * (6.0 / 7.0 * x - 2.5))
        return self.stiffness * (inside + 0.5 * max(beyond**2 - depth**2, 0.0))

    def constants(self) -> dict[str, Any]:
        return {
            "kind": 5,
            "in_q": self.in_q,
            "in_v": self.in_v,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "numbers": np.array([self.lower, self.upper, self.depth]),
        }
