"""What open and closed mechanisms share besides their states: applied forces, energy, counts.

The forces tau are those of the controller, joint damping and friction, and force elements.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.controllers import Controller, called
from srm_mbs.systems.forces import resolved_forces
from srm_mbs.systems.held import HeldForce
from srm_mbs.systems.loops import COINCIDENT
from srm_mbs.systems.manifold import Manifold
from srm_mbs.systems.projection import PIVOT_SHARE, PIVOT_WINDOW
from srm_mbs.workspaces import workspace

_NO_ROWS = np.zeros(0)


class Mechanics(Manifold):
    """A mechanism and the controller that acts on it, whatever its closures."""

    carries_yhat = True
    predicts = True

    def __init__(self, mechanism: Mechanism, controller: Controller | None) -> None:
        super().__init__(mechanism)
        self.multiplier_part = slice(self.nv, 2 * self.nv)
        self.multiplier_size = self.nv
        self.evaluations = 0
        self._controller = controller
        damping, friction = self.model.damping, self.model.friction
        self._damping = damping.copy() if np.count_nonzero(damping) else None
        self._friction = friction.copy() if np.count_nonzero(friction) else None
        self._friction_speed = mechanism.friction_speed
        self._forces = resolved_forces(mechanism)
        self._first, self._last = -np.inf, np.inf

    def __reduce__(self) -> tuple[Any, ...]:
        # Terms and workspaces share memory, which copies of them would not.
        return type(self), (self.mechanism, self._controller)

    # Made when the reference first evaluates: the compiled kernel has its own.
    @cached_property
    def data(self) -> pin.Data:
        """Pinocchio's workspace."""
        return workspace(self.model)

    @property
    def controlled(self) -> bool:
        """Whether a controller acts."""
        return self._controller is not None

    @property
    def calls_forces(self) -> bool:
        """Whether force elements are functions of the user."""
        return self._forces is not None and self._forces.calls

    def called_force(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """Generalised forces (nv,) of the Python functions that act: the controller, unless its
        output is held, and those among the force elements."""
        tau = np.zeros(self.nv) if self.held is not None else self.controlled_force(t, q, v)
        if self._forces is not None and self._forces.calls:
            tau = tau + self._forces.called(self.data, q, v, t)
        return tau

    @property
    def held(self) -> HeldForce | None:
        """The controller, if it is one whose output is held between samples."""
        return self._controller if isinstance(self._controller, HeldForce) else None

    def count(self, evaluations: int, factorisations: int) -> None:
        """Count what the compiled kernel did for this system."""
        self.evaluations += evaluations

    def between(self, first: float, last: float) -> None:
        """Evaluate at times within [``first``, ``last``] (s) only, the nearer of them for others:
        on one side of a breakpoint, whatever ``evaluate`` is given."""
        self._first, self._last = first, last

    def controlled_force(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """Generalised forces (nv,) of the controller, as :func:`called` returns them."""
        if self._controller is None:
            return np.zeros(self.nv)
        return called(self._controller, t, q, v)

    def damping_force(self, v: FloatArray) -> FloatArray:
        """Joint damping -d v, for the rates v (nv,) or (n, nv)."""
        if self._damping is None:
            return np.zeros(v.shape)
        out: FloatArray = -self._damping * v
        return out

    def friction_force(self, v: FloatArray) -> FloatArray:
        """Joint friction -F tanh(v / v_s), for the rates v (nv,) or (n, nv)."""
        if self._friction is None:
            return np.zeros(v.shape)
        out: FloatArray = -self._friction * np.tanh(v / self._friction_speed)
        return out

    def applied_force(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray | None:
        """Controller, joint damping and joint friction (nv,); None if there is none of them."""
        force = None if self._damping is None else self.damping_force(v)
        if self._friction is not None:
            rubbing = self.friction_force(v)
            force = rubbing if force is None else force + rubbing
        if self._controller is None:
            return force
        tau = self.controlled_force(t, q, v)
        return tau if force is None else tau + force

    def constants(self) -> dict[str, Any]:
        """Everything that does not change, for the compiled kernel (:mod:`srm_mbs.compiled`)."""
        fixed: dict[str, Any] = self.mechanism.derived("constants", self._constants)
        return fixed | self.constants_of_start()

    def constants_of_start(self) -> dict[str, Any]:
        """Those among :meth:`constants` that depend on the start, or that the model may change."""
        return {
            "unit": self._unit,
            "gap_scale": _NO_ROWS,
            "damping": self._damping,
            "friction": self._friction,
        }

    def _constants(self) -> dict[str, Any]:
        """Those that do not depend on the start."""
        return {
            "loops": [],
            "joint_rows": [],
            "eliminations": [],
            "drives": [],
            "rows": 0,
            "structural_rank": 0,
            "sigma_ref": 1.0,
            "algebra": "auto",
            "order": [],
            "pivot_share": PIVOT_SHARE,
            "pivot_window": PIVOT_WINDOW,
            "friction_speed": float(self._friction_speed),
            "forces": [] if self._forces is None else self._forces.constants(),
            "coincident": COINCIDENT,
        } | self.chart_constants()

    def kinetic_energy(self, q: FloatArray, v: FloatArray) -> float:
        """Kinetic energy (J), rotors on the joints (armature) included."""
        energy = float(pin.computeKineticEnergy(self.model, self.data, q, v))
        # Pinocchio's mass matrix has the armature, its energy does not.
        return energy + 0.5 * float(self.model.armature @ (v * v))

    def energy(self, state: FloatArray) -> float:
        """Kinetic plus potential energy (J), of gravity and springs."""
        q, v = self.split(state)
        energy = self.kinetic_energy(q, v)
        energy += float(pin.computePotentialEnergy(self.model, self.data, q))
        return energy if self._forces is None else energy + self._forces.energy(self.data, q)
