r"""The stabilised index-2 equations in the peers' coordinates, multipliers as rates.

    q' = v - G^T mu,   M v' = tau - nle - G^T lam,   G v = 0,   g = 0

with lam = L', mu = K' for states L, K: then the equations have index 1 in (q, v, L, K)', which is
how the authors of ``scipy_dae`` advise to write them, and multipliers do not enter error tests.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.work_precision.problems.base import Problem
from benchmarks.work_precision.trees import Equations

Array = Any
DIFFERENCE = 1e-7
"""Step of the differences, relative to values above 1."""


class Stabilised:
    """F(t, y, y') = 0 with y = (q, v, L, K) of a problem."""

    def __init__(self, problem: Problem) -> None:
        tree = problem.tree
        self.equations = equations = Equations(tree)
        self.nq, self.nv, self.m = tree.model.nq, tree.model.nv, equations.m
        self.start = np.concatenate([tree.q0, tree.v0, np.zeros(2 * self.m)])
        acceleration, multiplier = equations.acceleration(tree.q0, tree.v0)
        rate = equations.position_rate(tree.q0, tree.v0)
        self.start_rate = np.concatenate([rate, acceleration, multiplier, np.zeros(self.m)])

    def residual(self, t: float, y: Array, rate: Array) -> Array:
        """F (nq + nv + 2 m,)."""
        nq, nv, m, equations = self.nq, self.nv, self.m, self.equations
        n = nq + nv
        q, v = np.ascontiguousarray(y[:nq]), np.ascontiguousarray(y[nq:n])
        unit = equations.normalised(q)
        out = np.empty(y.size)
        M, f = equations.mass_and_force(unit, v)
        dv = rate[nq:n]
        if not m:
            out[:nq] = rate[:nq] - equations.position_rate(q, v)
            out[nq:] = M @ dv - f
            return out
        lam, mu = rate[n : n + m], rate[n + m :]
        momentum = M @ dv - f
        g, G = equations.gaps(unit)
        out[:nq] = rate[:nq] - equations.position_rate(q, v - G.T @ mu)
        out[nq:n] = momentum + G.T @ lam
        out[n : n + m] = G @ v
        out[n + m :] = g
        return out

    def jacobians(self, t: float, y: Array, rate: Array) -> tuple[Array, Array]:
        """dF/dy by differences in (q, v), and dF/dy' as it stands, both (size, size).

        The solvers' own differences lose the multipliers, whose values are zero, in the rates
        beside them.
        """
        nq, nv, m, equations = self.nq, self.nv, self.m, self.equations
        n = nq + nv
        by_state = np.zeros((y.size, y.size))
        here = self.residual(t, y, rate)
        moved = y.copy()
        for j in range(n):
            moved[j] += DIFFERENCE * max(1.0, abs(y[j]))
            by_state[:, j] = (self.residual(t, moved, rate) - here) / (moved[j] - y[j])
            moved[j] = y[j]
        q = equations.normalised(np.ascontiguousarray(y[:nq]))
        by_rate = np.zeros((y.size, y.size))
        by_rate[:nq, :nq] = np.eye(nq)
        by_rate[nq:n, nq:n] = pin.crba(self.equations.model, self.equations.data, q)
        if m:
            _, G = equations.gaps(q)
            turned = np.array([equations.position_rate(q, row) for row in G])
            by_rate[:nq, n + m :] = turned.T
            by_rate[nq:n, n : n + m] = G.T
        return by_state, by_rate

    def states(self, y: Array) -> tuple[Array, Array]:
        """(q, v) from y (n, nq + nv + 2 m)."""
        return y[:, : self.nq], y[:, self.nq : self.nq + self.nv]
