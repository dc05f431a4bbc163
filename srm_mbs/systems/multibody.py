r"""Mechanisms as systems: the evaluation of a stage, without closures and with them.

    q' = v,   M(q) v' = f(q, v, t) - G^T lam,   g(q) = s(t),   f = tau - nle(q, v),

s the motion of the drives, 0 in the rows of the loops; tau the applied forces.  States and their
moves are in ``manifold``, the applied forces and the energy in ``mechanics``, the answers of an
evaluated stage in ``mechanism_terms``.  Only these, ``loops``, ``driven``, ``forces`` and the
load-time analysis call Pinocchio algorithms.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.linalg import blas

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.base import Terms, Zone
from srm_mbs.systems.controllers import Controller
from srm_mbs.systems.driven import DrivenKinematics
from srm_mbs.systems.loops import LoopKinematics
from srm_mbs.systems.mechanics import Mechanics
from srm_mbs.systems.mechanism_terms import ClosedTerms, OpenTerms
from srm_mbs.systems.ordering import LARGE, graph_order
from srm_mbs.systems.pivoting import coordinate_parents
from srm_mbs.systems.projection import Projection
from srm_mbs.systems.units import constraint_units

_WORLD = pin.Convention.WORLD
_sum_of_sizes = blas.dasum
_OVERFLOW = 1e100
"""Size of a state from which products of its rates may overflow."""


class OpenSystem(Mechanics):
    """A mechanism without effective closures: plain ``aba``."""

    has_constraints = False
    factorisations = 0

    def __init__(self, mechanism: Mechanism, controller: Controller | None = None) -> None:
        super().__init__(mechanism, controller)
        self._zero = np.zeros(self.nv)
        self._terms = OpenTerms(self.nv)

    def closure_gap(self, t: float, state: FloatArray) -> float:
        """0: there is no closure."""
        return 0.0

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Terms:
        """v' = aba(q, v, tau); see :class:`~srm_mbs.systems.base.System`."""
        self.evaluations += 1
        t = min(max(t, self._first), self._last)
        q, v = state[: self.nq], state[self.nq :]
        force = self.applied_force(t, q, v)
        if self._forces is not None:
            pin.forwardKinematics(self.model, self.data, q, v)
            pin.computeJointJacobians(self.model, self.data)
            elements = self._forces.generalised(self.data, q, v, t)
            force = elements if force is None else force + elements
        rate = self._terms.rate()
        rate[: self.nv] = v
        rate[self.nv :] = pin.aba(
            self.model, self.data, q, v, self._zero if force is None else force
        )
        if not np.isfinite(rate).all():
            raise EvaluationError("the acceleration is not finite")
        return self._terms


class ClosedSystem(Mechanics):
    """A mechanism with closures.  Each Pinocchio algorithm is called once per evaluation."""

    has_constraints = True

    def __init__(self, mechanism: Mechanism, controller: Controller | None = None) -> None:
        super().__init__(mechanism, controller)
        self.structure = mechanism.structure
        self._gap_scale: FloatArray = mechanism.at_start("gap_scale", self._gap_scales)
        self._order: tuple[int, ...] = mechanism.derived("order", self._graph_order)
        self.projection = Projection(self.structure.rank, self.structure.sigma_ref, self._order)

    def _graph_order(self) -> tuple[int, ...]:
        """The rows in use along the graph of the loops, if there are many coordinates."""
        if self.nv <= LARGE:  # not worth asking for
            return ()
        return graph_order(self.loops.pattern(), coordinate_parents(self.model))

    def _resolved_loops(self) -> LoopKinematics:
        mechanism, structure = self.mechanism, self.structure
        scale, kept = structure.row_scale, structure.kept
        return LoopKinematics(self.model, mechanism.loops, scale, kept, structure.eliminations)

    def _gap_scales(self) -> FloatArray:
        structure = self.structure
        unit = constraint_units(self.mechanism, structure.units)
        scale: FloatArray = (structure.row_scale / unit)[structure.kept]
        return scale

    @cached_property
    def loops(self) -> LoopKinematics | DrivenKinematics:
        """The rows of closures and drives that are in use, with memory of their own."""
        if self._driven is not None:
            return self._driven
        resolved: LoopKinematics = self.mechanism.derived("loops", self._resolved_loops)
        return resolved.anew()

    @cached_property
    def _driven(self) -> DrivenKinematics | None:
        """Those rows, if there are drives."""
        mechanism, structure = self.mechanism, self.structure
        if not mechanism.drives:
            return None
        curves = mechanism.drive_curves
        scale, kept = structure.row_scale, structure.kept
        return DrivenKinematics(
            self.model,
            mechanism.loops,
            mechanism.drives,
            curves,
            scale,
            kept,
            structure.eliminations,
        )

    @cached_property
    def _mass_matrix(self) -> FloatArray:
        M: FloatArray = self.data.M  # a view on what crba writes
        return M

    @cached_property
    def _terms(self) -> ClosedTerms:
        return ClosedTerms(self.projection, self.loops, self._gap_scale)

    def constants(self) -> dict[str, Any]:
        """As for open mechanisms, and the closures."""
        own = super().constants()
        return own if self._driven is None else own | {"drives": self._driven.moving()}

    def constants_of_start(self) -> dict[str, Any]:
        """As for open mechanisms, and the scales of the closures."""
        return super().constants_of_start() | {"gap_scale": self._gap_scale}

    def _constants(self) -> dict[str, Any]:
        own = {
            "rows": len(self.loops.g),
            "structural_rank": self.structure.rank,
            "sigma_ref": self.structure.sigma_ref,
            "order": list(self._order),
        }
        return super()._constants() | self.loops.constants() | own

    def count(self, evaluations: int, factorisations: int) -> None:
        """Count what the compiled kernel did for this system."""
        super().count(evaluations, factorisations)
        self.projection.factorisations += factorisations

    @property
    def factorisations(self) -> int:
        """How often the constraint algebra was factorised."""
        return self.projection.factorisations

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Terms:
        """Factorise M and G at ``state``; see :class:`~srm_mbs.systems.base.System`.

        crba in the WORLD convention leaves placements and the world Jacobian in ``data``,
        nonLinearEffects the velocities and bias accelerations: the closures need no further call.
        """
        self.evaluations += 1
        # First, because LAPACK may factorise what is not finite without reporting it.
        if not _sum_of_sizes(state) < _OVERFLOW:
            raise EvaluationError("the state is not finite, or overflows")
        t = min(max(t, self._first), self._last)
        model, data, nq = self.model, self.data, self.nq
        q, v = state[:nq], state[nq:]
        pin.crba(model, data, q, _WORLD)
        f = -pin.nonLinearEffects(model, data, q, v)
        force = self.applied_force(t, q, v)
        if force is not None:
            f += force
        if self._forces is not None:
            f += self._forces.generalised(data, q, v, t)
        loops = self.loops
        self._update(t, q)
        projection = self.projection
        threshold = None if zone is None else zone.threshold
        projection.factor(self._mass_matrix, loops.G, f, loops.bias, threshold)
        terms = self._terms
        terms.v = v
        terms.sigma = projection.sigma
        terms.weak = projection.weak
        terms.predicted = None
        if projection.weak and zone is not None:
            terms.predicted = zone.predict(t)
            if terms.predicted is None:
                if zone.normals is None:
                    raise EvaluationError(
                        "the motion stays next to a singular configuration with too little "
                        "momentum to tell its branch"
                        if self._driven is None
                        else "the drives keep the motion next to a singular configuration, or "
                        "lead to one that it cannot pass"
                    )
                projection.hold(zone.normals)
        return terms

    def closure_gap(self, t: float, state: FloatArray) -> float:
        """max |g| over row units; see :class:`~srm_mbs.systems.base.System`."""
        g, _ = self.residuals(state, t)
        return float(np.max(np.abs(g) * self._gap_scale))

    def _update(self, t: float, q: FloatArray, with_bias: bool = True) -> None:
        """The rows at t and q, for which ``data`` has the kinematics."""
        self.loops.update(self.data, q, with_bias)
        if self._driven is not None:
            self._driven.move_to(t)

    def residuals(self, state: FloatArray, t: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Scaled g - s (m,) and G v - s' (m,) of the kept rows at the time t (s)."""
        q, v = self.split(state)
        pin.crba(self.model, self.data, q, _WORLD)
        self._update(t, q, with_bias=False)
        rates = self.loops.G @ v
        return self.loops.g.copy(), rates if self._driven is None else rates - self._driven.pushed


def make_system(
    mechanism: Mechanism, controller: Controller | None = None
) -> OpenSystem | ClosedSystem:
    """The cheapest system that is right for ``mechanism``."""
    if mechanism.structure.rank == 0:
        return OpenSystem(mechanism, controller)
    return ClosedSystem(mechanism, controller)
