r"""The stabilised index-2 equations in the peers' coordinates, multipliers as rates.

    q' = v - G^T mu,   M v' = tau - nle - G^T lam,   G v = 0,   g = 0

with lam = L', mu = K' for states L, K: then the equations have index 1 in (q, v, L, K)', which is
how the authors of ``scipy_dae`` advise to write them, and multipliers do not enter error tests.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.work_precision.problems.base import Problem
from benchmarks.work_precision.trees import Equations

Array = Any


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

    def states(self, y: Array) -> tuple[Array, Array]:
        """(q, v) from y (n, nq + nv + 2 m)."""
        return y[:, : self.nq], y[:, self.nq : self.nq + self.nv]
