"""Quantities at many states of a mechanism: closure errors, rows of G, energies, powers of forces.

:class:`Observables` is the reference; the compiled kernel has the same in
:mod:`srm_mbs.integration.kernel.observables`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.reactions import Reactions, reactions_at
from srm_mbs.dynamics.constraints.rheonomic import all_rows, constraint_errors
from srm_mbs.dynamics.constraints.row_algebra import SingularValues
from srm_mbs.dynamics.forces import ForceKinematics
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.model.forces import Bushing, ForceElement, SpringDamper, TorsionSpring
from srm_mbs.model.mechanism import MechanismData, per_model

LINEAR = (SpringDamper, TorsionSpring, Bushing)
"""Elements whose force is that of a stiffness and that of a damping."""


NO_ANGLES = np.zeros((0, 0))


def without_spring(force: ForceElement) -> ForceElement:
    """The damper of a linear element; of another one the element itself."""
    if not isinstance(force, LINEAR):
        return force
    none: Any = (0.0,) * 6 if isinstance(force, Bushing) else 0.0
    return replace(force, stiffness=none)


@per_model
def working_elements(mechanism: MechanismData) -> dict[str, ForceKinematics]:
    """The elements that do work beside that of a potential, by name, without their springs."""
    return {
        force.name: ForceKinematics(
            mechanism.model, [without_spring(force)], mechanism.friction_speed
        )
        for force in mechanism.forces
        # A spring without damping and friction does no other work.
        if not force.has_potential
        or np.any(getattr(force, "damping", 1.0))
        or np.any(getattr(force, "friction", 0.0))
    }


@per_model
def conservative_elements(mechanism: MechanismData) -> dict[str, ForceKinematics]:
    """The working elements whose force at rest has a potential: its power is subtracted from
    theirs."""
    return {
        force.name: ForceKinematics(mechanism.model, [force])
        for force in mechanism.forces
        if force.name in working_elements(mechanism)
        and force.has_potential
        and not isinstance(force, LINEAR)
    }


class Invariants(NamedTuple):
    """Closure errors and energies along a motion, which show its error.

    Attributes
    ----------
    at_ends, within
        Largest norm of each group of g - s, and then of each of G v - s', at the ends of steps and
        at the other states.
    energies : (k, 2) J
        As of :meth:`Observables.energies`, at the ends of steps.
    """

    at_ends: list[float]
    within: list[float]
    energies: FloatArray


class Observables:
    """Quantities of the mechanism of ``system`` at n states.

    Times t (n,) are in s, configurations q (n, nq), velocities v (n, nv).
    """

    def __init__(self, system: OpenSystem | ClosedSystem) -> None:
        self.system = system
        self.mechanism = system.mechanism

    def closure_errors(
        self, t: FloatArray, q: FloatArray, v: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """g - s (n, rows) in m and rad, and G v - s' (n, rows), of all rows."""
        return constraint_errors(self.mechanism, t, q, v)

    def invariants(
        self,
        t: FloatArray,
        states: FloatArray,
        ends: list[int],
        whole: int,
        order: list[int],
        starts: list[int],
    ) -> Invariants:
        """Closure errors and energies at the states (n, nx) at the times ``t`` (n,).

        Parameters
        ----------
        ends, whole
            Indices of the states at ends of steps, and number of those, from the first, whose
            closure errors count.
        order, starts
            Indices of the closure rows, one group after the other, and where the groups begin.
        """
        q, v = states[:, : self.mechanism.model.nq], states[:, self.mechanism.model.nq :]
        at_end = np.isin(np.arange(whole), ends)
        at_ends, within = (
            [
                norm
                for errors in self.closure_errors(t[:whole][own], q[:whole][own], v[:whole][own])
                for norm in self.largest_norms(errors, order, starts)
            ]
            for own in (at_end, ~at_end)
        )
        return Invariants(at_ends, within, self.energies(q[ends], v[ends]))

    def jacobians(self, t: FloatArray, q: FloatArray) -> FloatArray:
        """G (n, rows, nv) of all rows; with drives [G, -s'] (n, rows, nv + 1)."""
        mechanism = self.mechanism
        rows, data = all_rows(mechanism), workspace(mechanism.model)
        width = mechanism.model.nv + bool(mechanism.drives)
        out = np.empty((len(q), len(rows.g), width))
        for i in range(len(q)):
            rows.evaluate(mechanism.model, data, q[i])
            rows.move_to(t[i])
            out[i, :, : mechanism.model.nv] = rows.G
            if mechanism.drives:
                out[i, :, -1] = -rows.target_rate
        return out

    def smallest_values(
        self,
        geometry: ClosureGeometry,
        values: SingularValues,
        k: int,
        t: FloatArray,
        q: FloatArray,
    ) -> FloatArray:
        """The k-th largest singular values (n,), k from 1, of the separated rows of ``geometry``;
        ``values`` has the places of their entries."""
        return values(geometry.separated_rows(self.jacobians(t, q)), k)

    def differences(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Motions and changes of the rates (n, 2 nv) from the states a (n, nx) to b (n, nx)."""
        model = self.mechanism.model
        nq = model.nq
        if nq == model.nv:
            return b - a
        moved = [pin.difference(model, *pair) for pair in zip(a[:, :nq], b[:, :nq])]
        rates = b[:, nq:] - a[:, nq:]
        return np.hstack([np.array(moved).reshape(len(a), model.nv), rates])

    def moved(self, states: FloatArray, motions: FloatArray) -> FloatArray:
        """Each of the states (n, nx) moved by one of the motions (n, 2 nv)."""
        if states.shape[1] == motions.shape[1]:
            out: FloatArray = states + motions
            return out
        pairs = zip(states, motions)
        return np.array([self.system.retract(*pair) for pair in pairs]).reshape(states.shape)

    def largest_differences(
        self,
        a: FloatArray,
        b: FloatArray,
        unit: FloatArray,
        order: list[int],
        starts: list[int],
        turned: Sequence[int] = (),
        angles: FloatArray = NO_ANGLES,
    ) -> tuple[FloatArray, list[float]]:
        """Of the :meth:`differences` of states, a (n, nx), or (1, nx) for all of them, and b
        (n, nx): the largest of either over its ``unit`` (2 nv,), as (n, 2), and the largest norm
        at any time of each of m groups of entries.

        Parameters
        ----------
        order, starts
            Indices of the entries, one group after the other, and where the m groups begin.
        turned, angles
            Coordinates that move by other angles (n, k) rad: with the whole turns of joints that
            are stored as cosine and sine.
        """
        x = self.differences(np.broadcast_to(a, b.shape), b)
        x[:, turned] = angles.reshape(len(x), -1)
        size = np.maximum.reduceat(np.abs(x / unit), [0, len(unit) // 2], axis=1)
        return size, self.largest_norms(x, order, starts)

    @staticmethod
    def largest_norms(x: FloatArray, order: list[int], starts: list[int]) -> list[float]:
        """The largest norm in any row of x (n, k) of each group of entries, as in
        :meth:`largest_differences`."""
        squares = np.add.reduceat(x[:, order] ** 2, starts, axis=1)
        out: list[float] = np.sqrt(squares.max(axis=0, initial=0.0)).tolist()
        return out

    def energies(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """Kinetic and potential energy (n, 2) J: of the bodies; of gravity, springs and
        bushings."""
        system = self.system
        out = np.empty((len(q), 2))
        for i, state in enumerate(zip(q, v)):
            kinetic = system.kinetic_energy(*state)
            out[i] = kinetic, system.energy(np.concatenate(state)) - kinetic
        return out

    def drive_forces(self, t: FloatArray, q: FloatArray, v: FloatArray) -> dict[str, FloatArray]:
        """Force (n,) N or torque N m of each drive on its coordinate
        (:class:`~srm_mbs.dynamics.constraints.reactions.Reactions`).

        Raises
        ------
        EvaluationError, ControllerError
            If the equations of motion cannot be evaluated.
        """
        return self.reactions(t, q, v).drives

    def reactions(
        self, t: FloatArray, q: FloatArray, v: FloatArray, forces: FloatArray | None = None
    ) -> Reactions:
        """Reactions of closures and joints, multipliers, and forces of drives; ``forces`` as for
        :func:`~srm_mbs.dynamics.constraints.reactions.reactions_at`.

        Raises
        ------
        EvaluationError, ControllerError
            If the equations of motion cannot be evaluated.
        """
        return reactions_at(self.system, t, q, v, forces)

    def accelerations(self, t: FloatArray, q: FloatArray, v: FloatArray) -> FloatArray:
        """v' (n, nv) of the equations of motion.

        Raises
        ------
        EvaluationError, ControllerError
            If the equations of motion cannot be evaluated.
        """
        nv = self.mechanism.model.nv
        states = np.hstack([q, v])
        rates = [self.system.evaluate(time, x).rate()[nv:].copy() for time, x in zip(t, states)]
        return np.array(rates).reshape(len(rates), nv)

    def powers(self, t: FloatArray, q: FloatArray, v: FloatArray) -> dict[str, FloatArray]:
        """Power (n,) W of each force element but that of its potential, by name.

        Raises
        ------
        EvaluationError
            If a force cannot be evaluated.
        """
        powers = self._powers(working_elements(self.mechanism), t, q, v)
        at_rest = self._powers(conservative_elements(self.mechanism), t, q, v, resting=True)
        return {name: power - at_rest.get(name, 0.0) for name, power in powers.items()}

    def stage_powers(
        self,
        chosen: IndexArray,
        times: FloatArray,
        states: FloatArray,
        rates: FloatArray,
        A: FloatArray,
        c: FloatArray,
    ) -> dict[str, FloatArray]:
        """Power (m, k) W of each force element but that of its potential, by name, at k stages of
        the steps ``chosen`` (m,).

        Parameters
        ----------
        times, states, rates
            Ends (n + 1,) s of all steps, states (n + 1, nx) there and chart rates (n, s or more,
            2 nv) at their stages.
        A, c
            Coefficients (k, s) and abscissae (k,) of the k stages.

        Raises
        ------
        EvaluationError
            If a force cannot be evaluated.
        """
        nq, h = self.mechanism.model.nq, np.diff(times)[chosen]
        motions = h[:, None, None] * (A @ rates[chosen, : A.shape[1]])
        starts = np.repeat(states[chosen], len(c), axis=0)
        stages = self.moved(starts, motions.reshape(len(starts), rates.shape[2]))
        t = times[chosen, None] + np.outer(h, c)
        powers = self.powers(t.ravel(), stages[:, :nq], stages[:, nq:])
        return {name: power.reshape(t.shape) for name, power in powers.items()}

    def _powers(
        self,
        elements: dict[str, ForceKinematics],
        t: FloatArray,
        q: FloatArray,
        v: FloatArray,
        resting: bool = False,
    ) -> dict[str, FloatArray]:
        """Power (n,) of each of ``elements``, or of its force at rest."""
        model, data = self.mechanism.model, workspace(self.mechanism.model)
        powers = {name: np.empty(len(t)) for name in elements}
        for i, (time, position, rate) in enumerate(zip(t, q, v) if elements else ()):
            acting = np.zeros(model.nv) if resting else rate
            pin.computeJointJacobians(model, data, position)
            pin.forwardKinematics(model, data, position, acting)
            for name, element in elements.items():
                powers[name][i] = element.generalised(data, position, acting, time) @ rate
        return powers
