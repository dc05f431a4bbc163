r"""The motion next to a singular configuration where branches touch instead of crossing.

There sigma grows with the square of the distance, and P in the mass metric may turn within less
than the distance at which closures can be solved for: nodes for P
(:mod:`srm_mbs.integration.methods.branch_nodes`) would have to be too far apart.  With one degree
of freedom the branch itself is smooth beyond that.  *Nodes* q_k on both sides, with
g(q_k) = 0, give it as a polynomial,

    q(y) = q (+) delta(y),   delta(y_k) = q_k (-) q,   y = p . delta,

p the direction in which the step begins, in units.  A stage (q, v) is moved to the point with
y = 0, and with q' and q'' there

    v_on = s q',   s = q' . M v / m,   m = q' . M q',
    v' = q' s' + q'' s^2,   s' = q' . M (a - q'' s^2) / m,   a = M^-1 f at (q_on, v_on),

because the closures do no work.  The first guess of a node is on the parabola that the motion
follows where the step begins: both branches have its tangent, and only one its curvature.
"""

from __future__ import annotations

import math

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import BranchSystem

TOUCHING = 0.1
"""Distance (rad, scene diagonals) of the first nodes from the middle between them, at least.  A
direction of the branch of this length says that branches touch."""
FARTHEST = 0.2
"""The same, at most."""
NODE_SPACING = 0.05
"""Distance of the others from each other."""
EACH_SIDE = 8
"""Nodes on each side."""
SAMPLES = 8
"""Places on each side, as far apart, at which sigma shows where the first nodes have to be."""
LEAST_SIGMA = 1e-3
"""sigma of the nodes, at least."""
FIRST_NODE_SIGMA = 3e-3
"""sigma of the first nodes."""
MAX_CLOSINGS = 12
"""Newton steps of one node onto the closures."""
LARGEST_CLOSING = 0.5
"""The first of them, over NODE_SPACING: beyond it lies the other branch."""
CLOSING_ACCURACY = 1e-10
"""The last of them (rad, scene diagonals): the next one would be rounding."""
LARGEST_MISFIT = 1e-10
"""Largest distance of the polynomial from that without the outermost nodes."""
LARGEST_RESIDUAL = 1e-13
"""Closure error (row units) of a point of the polynomial, above which the branches do not meet."""


def polynomial_weights(places: FloatArray) -> FloatArray:
    """Weights (3, k) of the value and of the first and second derivative at 0 of the polynomial
    through values at ``places`` (k,), none of them 0."""
    apart = places[:, None] - places
    np.fill_diagonal(apart, 1.0)
    factors = -places / apart
    np.fill_diagonal(factors, 1.0)
    value = factors.prod(axis=1)
    inverse = 1.0 / places
    first = inverse - inverse.sum()
    second = first**2 + inverse**2 - (inverse**2).sum()
    weights: FloatArray = value * np.array([np.ones_like(value), first, second])
    return weights


class StageOnBranch:
    """A stage that nodes of its branch solved.

    Attributes
    ----------
    state : (nx,), rate : (2 nv,), multiplier : (nv,)
        The stage on its branch, its tangent rate and its multiplier.
    moved : (2 nv,)
        What was subtracted from the stage.
    away : (nv,)
        The direction of the branch there, as long as nodes are apart, or TOUCHING.
    """

    state: FloatArray
    rate: FloatArray
    multiplier: FloatArray
    moved: FloatArray
    away: FloatArray


class TouchingBranch:
    """Solves the stages of one step by the nodes of their branch."""

    def __init__(self, system: BranchSystem) -> None:
        self._system = system
        self._nodes: list[FloatArray] = []

    def prepare(self, t: float, state: FloatArray, rate: FloatArray, w: FloatArray) -> bool:
        """Find the nodes for a step from ``state`` (nx,) at t (s) with the tangent ``rate``
        (2 nv,), in the direction w (nv,); whether there are any."""
        system, nv = self._system, self._system.nv
        w = w / system.position_norm(w)
        self._along = w / system.singularities.coordinate_unit**2
        self._along /= self._along @ w
        v, a = rate[:nv], rate[nv:]
        speed = float(self._along @ v)
        if not abs(speed) > 0.0:
            return False
        bend = 0.5 * (a - v * (float(self._along @ a) / speed)) / speed**2
        self._parabola = state, w, bend
        bounds = self._bounds(t)
        if bounds is None:
            return False
        centre, reach = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
        if reach > FARTHEST:
            return False
        reach = max(TOUCHING, reach)
        sides: list[list[FloatArray]] = [[], []]
        for sign, found in zip((-1.0, 1.0), sides):
            off = np.zeros(nv)
            for k in range(EACH_SIDE):
                x = centre + sign * (reach + k * NODE_SPACING)
                closed = self._closed(t, x, off)
                if closed is None:
                    return False
                off = closed
                found.append(self._place(x, off))
        self._nodes = [node for pair in zip(*sides) for node in pair]
        return True

    def _place(self, x: float, off: FloatArray) -> FloatArray:
        """The state at x on the parabola, moved by ``off`` (nv,)."""
        state, w, bend = self._parabola
        return self._system.retract(
            state, np.concatenate([x * w + x**2 * bend + off, np.zeros_like(off)])
        )

    def _bounds(self, t: float) -> tuple[float, float] | None:
        """The ends of the part around the lowest sigma where it is below that of the first
        nodes; None if it is too long."""
        x = NODE_SPACING * np.arange(-SAMPLES, SAMPLES + 1)
        none = np.zeros(self._system.nv)
        roots = np.sqrt([self._system.evaluate(t, self._place(at, none)).sigma for at in x])
        least = math.sqrt(FIRST_NODE_SIGMA)
        lowest = int(roots.argmin())
        ends = []
        for side, last in ((-1, 0), (1, len(x) - 1)):
            k = lowest
            while k != last and not roots[k + side] > least:
                k += side
            if k == last:
                return None
            part = (least - roots[k]) / (roots[k + side] - roots[k])
            ends.append(float(x[k] + side * part * NODE_SPACING))
        return ends[0], ends[1]

    def _closed(self, t: float, x: float, off: FloatArray) -> FloatArray | None:
        """The motion (nv,) from the parabola at x onto the branch, from that of the node before;
        None if Newton's method does not find it."""
        system, last = self._system, np.inf
        for iteration in range(MAX_CLOSINGS):
            terms = system.evaluate(t, self._place(x, off))
            if terms.rank_deficient or not terms.sigma > LEAST_SIGMA:
                return None
            closing = terms.correction()[: system.nv]
            off = off - closing
            change = system.position_norm(closing)
            if iteration == 0 and change > LARGEST_CLOSING * NODE_SPACING:
                return None
            if change < CLOSING_ACCURACY:
                return off
            if iteration > 1 and not change < last:
                return None
            last = change
        return None

    def _seen_from(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (k,) of the nodes, and the motions (k, nv) to them."""
        nv = self._system.nv
        motions = np.array([self._system.difference(state, node)[:nv] for node in self._nodes])
        return motions @ self._along, motions

    def solve(self, t: float, state: FloatArray, stage: StageOnBranch) -> bool:
        """Solve the stage ``state`` (nx,) at t (s) as ``stage``; whether it could be solved."""
        system, nv = self._system, self._system.nv
        places, motions = self._seen_from(state)
        delta = np.zeros(2 * nv)
        delta[:nv] = polynomial_weights(places)[0] @ motions
        on = system.retract(state, delta)
        # In the chart at a point of the branch, derivatives are those of the motion.
        places, motions = self._seen_from(on)
        _, tangent, bend = polynomial_weights(places) @ motions
        coarse = polynomial_weights(places[:-2])[0] @ motions[:-2]
        if system.position_norm(coarse) > LARGEST_MISFIT:
            return False
        terms = system.evaluate(t, on)
        if terms.constraint_residual() > LARGEST_RESIDUAL:
            return False
        momentum = terms.momentum(tangent)
        inertia = float(momentum @ tangent)
        s = float(momentum @ state[-nv:]) / inertia
        on[-nv:] = s * tangent
        free = system.evaluate(t, on).free_acceleration()
        across = s**2 * bend
        acceleration = tangent * (float(momentum @ (free - across)) / inertia) + across
        stage.state, stage.multiplier = on, free - acceleration
        stage.rate = np.concatenate([on[-nv:], acceleration])
        stage.moved = -delta
        stage.moved[nv:] = state[-nv:] - on[-nv:]
        stage.away = TOUCHING / system.position_norm(tangent) * tangent
        return True
