"""Evaluators of the force elements on links: springs between points, wrenches, bushings."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.forces import Bushing, SpringDamper, Wrench
from srm_mbs.systems.force_evaluators import HeldAnchor, OverTime, about_origin, point_velocity
from srm_mbs.systems.loops import COINCIDENT, world_jacobian


class SpringDamperEvaluator:
    """A :class:`~srm_mbs.forces.SpringDamper`, resolved against a model."""

    def __init__(self, model: pin.Model, force: SpringDamper) -> None:
        self.name = force.name
        self.a, self.b = HeldAnchor(model, force.a), HeldAnchor(model, force.b)
        self.support = self.a.support - self.b.support
        self.stiffness, self.damping = force.stiffness, force.damping
        self.rest_length = float(force.rest_length or 0.0)

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        at_a = self.a.placement(data).translation
        at_b = self.b.placement(data).translation
        apart = at_a - at_b
        length = sqrt(apart @ apart)
        if length < COINCIDENT * self.rest_length:
            raise EvaluationError(
                f"the two points of the force {self.name!r} coincide: its direction is not "
                "determined"
            )
        # k (l - l0) apart/l, without dividing where l = l0 = 0.
        force = -self.stiffness * apart
        if self.rest_length:
            force *= 1.0 - self.rest_length / length
        if self.damping:
            rate = point_velocity(self.a.velocity(data), at_a)
            rate -= point_velocity(self.b.velocity(data), at_b)
            # Points that meet move along the line that joins them.
            along = apart * ((apart / length) @ rate / length) if length else rate
            force -= self.damping * along
        tau += (world_jacobian(data).T @ about_origin(force, np.zeros(3), at_a)) * self.support

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        apart = self.a.placement(data).translation - self.b.placement(data).translation
        return 0.5 * self.stiffness * (sqrt(apart @ apart) - self.rest_length) ** 2

    def constants(self) -> dict[str, Any]:
        return {
            "kind": 0,
            "a": self.a.constants(),
            "b": self.b.constants(),
            "support": self.support,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "rest": self.rest_length,
        }


class WrenchEvaluator:
    """A :class:`~srm_mbs.forces.Wrench`, resolved against a model."""

    def __init__(self, model: pin.Model, force: Wrench) -> None:
        self.at = HeldAnchor(model, force.at)
        self.turns = force.frame == "link"
        self.wrench = OverTime(np.array([*force.force, *force.moment]), force.law)

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        at = self.at.placement(data)
        numbers = self.wrench.at(t)
        force, moment = numbers[:3], numbers[3:]
        if self.turns:
            force, moment = at.rotation @ force, at.rotation @ moment
        wrench = about_origin(force, moment, at.translation)
        tau += (world_jacobian(data).T @ wrench) * self.at.support

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        return 0.0

    def constants(self) -> dict[str, Any]:
        return {
            "kind": 3,
            "a": self.at.constants(),
            "support": self.at.support,
            "turns": self.turns,
        } | self.wrench.constants()


class BushingEvaluator:
    """A :class:`~srm_mbs.forces.Bushing`, resolved against a model."""

    def __init__(self, model: pin.Model, force: Bushing) -> None:
        self.a, self.b = HeldAnchor(model, force.a), HeldAnchor(model, force.b)
        self.support = self.a.support - self.b.support
        self.stiffness, self.damping = np.array(force.stiffness), np.array(force.damping)
        self.damped = bool(np.any(self.damping))

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        Ta, Tb = self.a.placement(data), self.b.placement(data)
        relative = Tb.actInv(Ta)
        turn = pin.log3(relative.rotation)
        # dphi/dt is Jlog3 w for w in a's axes, and L^T w in b's: Jlog3 R^T = Jlog3^T.
        L = pin.Jlog3(relative.rotation)
        force = self.stiffness[:3] * relative.translation
        moment = self.stiffness[3:] * turn
        if self.damped:
            # b's axes and origin move along: what is left is the motion seen from b.
            W = self.a.velocity(data) - self.b.velocity(data)
            rate = Tb.rotation.T @ point_velocity(W, Ta.translation)
            spin = L.T @ (Tb.rotation.T @ W.angular)
            force = force + self.damping[:3] * rate
            moment = moment + self.damping[3:] * spin
        wrench = about_origin(-(Tb.rotation @ force), -(Tb.rotation @ (L @ moment)), Ta.translation)
        tau += (world_jacobian(data).T @ wrench) * self.support

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        relative = self.b.placement(data).actInv(self.a.placement(data))
        moved = np.concatenate([relative.translation, pin.log3(relative.rotation)])
        return 0.5 * float(self.stiffness @ (moved * moved))

    def constants(self) -> dict[str, Any]:
        return {
            "kind": 4,
            "a": self.a.constants(),
            "b": self.b.constants(),
            "support": self.support,
            "numbers": np.concatenate([self.stiffness, self.damping]).astype(float),
        }
