"""Pinocchio's ``constraintDynamics`` as the peers call it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.work_precision.peers.base import Budget
from benchmarks.work_precision.problems.base import Problem
from benchmarks.work_precision.trees import Equations

Array = Any
REDUNDANT_MU = 1e-10
"""Proximal parameter where rows are redundant (planar loops): zero gives NaN there."""
ACCURACY, ITERATIONS = 1e-13, 10


class PinocchioDynamics:
    """y' for y = (q, v): ``constraintDynamics`` with Baumgarte rate ``gain``, ``aba`` without
    closures."""

    def __init__(self, problem: Problem, gain: float = 0.0) -> None:
        tree = problem.tree
        self.equations = Equations(tree)
        model = self.model = tree.model
        self.data = model.createData()
        self.nq, self.nv = model.nq, model.nv
        self.start = np.concatenate([tree.q0, tree.v0])
        self._flat = tree.flat
        self._models = pin.StdVec_RigidConstraintModel()
        self._datas = pin.StdVec_RigidConstraintData()
        for closure in tree.closures:
            constraint = pin.RigidConstraintModel(
                pin.ContactType.CONTACT_3D,
                model,
                closure.a,
                pin.SE3(np.eye(3), np.array(closure.in_a)),
                closure.b,
                pin.SE3(np.eye(3), np.array(closure.in_b)),
                pin.ReferenceFrame.LOCAL,
            )
            if gain:
                constraint.setBaumgarteCorrectorParameters(
                    pin.BaumgarteCorrectorParameters(gain**2, 2.0 * gain)
                )
            self._models.append(constraint)
            self._datas.append(constraint.createData())
        if tree.closures:
            pin.initConstraintDynamics(model, self.data, self._models, self._datas)
        redundant = any(len(closure.rows) < 3 for closure in tree.closures)
        self._proximal = pin.ProximalSettings(
            ACCURACY, REDUNDANT_MU if redundant else 0.0, ITERATIONS
        )
        self._closed = bool(tree.closures)

    def acceleration(self, q: Array, v: Array) -> Array:
        """v' (nv,), a view."""
        tau = self.equations.applied(q, v)
        if not self._closed:
            return pin.aba(self.model, self.data, q, v, tau)
        return pin.constraintDynamics(
            self.model, self.data, q, v, tau, self._models, self._datas, self._proximal
        )

    def field(self, budget: Budget) -> Callable[[float, Array], Array]:
        """(t, y) -> y'."""
        nq = self.nq
        equations = self.equations

        def flat(t: float, y: Array) -> Array:
            budget.tick()
            out = np.empty_like(y)
            out[:nq] = y[nq:]
            out[nq:] = self.acceleration(y[:nq], y[nq:])
            return out

        def free(t: float, y: Array) -> Array:
            budget.tick()
            q, v = equations.normalised(y[:nq]), y[nq:]
            out = np.empty_like(y)
            out[:nq] = equations.position_rate(q, v)
            out[nq:] = self.acceleration(q, v)
            return out

        return flat if self._flat else free
