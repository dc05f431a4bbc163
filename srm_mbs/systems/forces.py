"""Generalised forces of the force elements, from the kinematics of one evaluation.

The elements on joints are in ``joint_forces``, those on links in ``link_forces``; here are the
functions of the user, and all elements of a mechanism together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import ControllerError
from srm_mbs.force_element import ForceElement
from srm_mbs.forces import Bushing, JointTorque, LimitSpring, SpringDamper, TorsionSpring, Wrench
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.controllers import unusable
from srm_mbs.systems.force_evaluators import Evaluator, HeldAnchor, about_origin
from srm_mbs.systems.joint_forces import (
    JointTorqueEvaluator,
    LimitSpringEvaluator,
    TorsionSpringEvaluator,
)
from srm_mbs.systems.link_forces import BushingEvaluator, SpringDamperEvaluator, WrenchEvaluator
from srm_mbs.systems.loops import world_jacobian
from srm_mbs.systems.projection import cholesky, whiten
from srm_mbs.user_forces import UserForce
from srm_mbs.workspaces import workspace


class _UserForceEvaluator:
    """A :class:`~srm_mbs.user_forces.UserForce`, resolved against a model."""

    def __init__(self, model: pin.Model, force: UserForce) -> None:
        self.name, self.function = force.name, force.function
        self.at = None if force.at is None else HeldAnchor(model, force.at)
        self.size = model.nv if force.at is None else 6

    def add(self, tau: FloatArray, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> None:
        try:
            given = np.asarray(self.function(t, q.copy(), v.copy()), dtype=float)
        except Exception as error:
            raise ControllerError(
                f"the force {self.name!r} raised {error!r} at t = {t:.6g} s"
            ) from error
        trouble = unusable(given, self.size)
        if trouble:
            raise ControllerError(
                f"the force {self.name!r} returned {trouble} at t = {t:.6g} s; it must return "
                f"{self.size} finite numbers"
            )
        if self.at is None:
            tau += given
            return
        wrench = about_origin(given[:3], given[3:], self.at.placement(data).translation)
        tau += (world_jacobian(data).T @ wrench) * self.at.support

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        return 0.0

    def constants(self) -> dict[str, Any]:
        raise TypeError("the compiled kernel calls back for it")


def friction_time(mechanism: Mechanism) -> float:
    """Shortest time (s) in which friction stops a slow joint of the open tree at q0.

    1 over the largest eigenvalue of M^-1 diag(F)/v_s; infinite without friction.  Steps of
    explicit schemes stay below a few times it while a joint rests.

    Raises
    ------
    EvaluationError
        If the mass matrix is not positive definite.
    """
    model = mechanism.model
    rough = np.flatnonzero(model.friction)
    if not rough.size:
        return np.inf
    U = cholesky(pin.crba(model, workspace(model), mechanism.q0))
    roots = np.zeros((model.nv, rough.size), order="F")
    roots[rough, range(rough.size)] = np.sqrt(model.friction[rough] / mechanism.friction_speed)
    return float(1.0 / np.linalg.norm(whiten(U, roots), 2) ** 2)


_EVALUATORS = {
    SpringDamper: SpringDamperEvaluator,
    JointTorque: JointTorqueEvaluator,
    TorsionSpring: TorsionSpringEvaluator,
    Wrench: WrenchEvaluator,
    Bushing: BushingEvaluator,
    LimitSpring: LimitSpringEvaluator,
    UserForce: _UserForceEvaluator,
}


def resolved_forces(mechanism: Mechanism) -> ForceKinematics | None:
    """The force elements of ``mechanism``, resolved once; None if it has none."""
    forces: ForceKinematics | None = mechanism.derived(
        "forces",
        lambda: ForceKinematics(mechanism.model, mechanism.forces) if mechanism.forces else None,
    )
    return forces


class ForceKinematics:
    """All force elements of a mechanism.

    Parameters
    ----------
    model, forces
        The tree and its elements.
    """

    def __init__(self, model: pin.Model, forces: Sequence[ForceElement]) -> None:
        self._model, self._nv = model, model.nv
        self._elements: list[Evaluator] = [
            _EVALUATORS[type(force)](model, force) for force in forces
        ]

    def generalised(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> FloatArray:
        """tau (nv,) in N and N m at q (nq,), v (nv,) and t (s).

        ``data`` must hold placements, velocities and the world Jacobian at that state: of crba in
        the WORLD convention and nonLinearEffects, or of forwardKinematics and
        computeJointJacobians.

        Raises
        ------
        EvaluationError
            If the points of a spring with a rest length coincide.
        ControllerError
            If a function of the user raises, or returns anything but finite numbers.
        """
        tau = np.zeros(self._nv)
        for element in self._elements:
            element.add(tau, data, q, v, t)
        return tau

    def energy(self, data: pin.Data, q: FloatArray) -> float:
        """Potential energy (J) of springs and bushings; ``data`` must hold the placements."""
        return sum(element.energy(data, q) for element in self._elements)

    @property
    def calls(self) -> bool:
        """Whether there are functions of the user among the elements."""
        return any(isinstance(element, _UserForceEvaluator) for element in self._elements)

    def called(self, data: pin.Data, q: FloatArray, v: FloatArray, t: float) -> FloatArray:
        """tau (nv,) of those functions alone; ``data`` is a workspace."""
        pin.forwardKinematics(self._model, data, q, v)
        pin.computeJointJacobians(self._model, data, q)
        tau = np.zeros(self._nv)
        for element in self._elements:
            if isinstance(element, _UserForceEvaluator):
                element.add(tau, data, q, v, t)
        return tau

    def constants(self) -> list[dict[str, Any]]:
        """What the compiled kernel needs of each element but the functions of the user."""
        return [
            element.constants()
            for element in self._elements
            if not isinstance(element, _UserForceEvaluator)
        ]
