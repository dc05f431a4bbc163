r"""The motion next to a singular configuration where branches touch instead of crossing.

There sigma grows with the square of the distance, and P in the mass metric may turn within less
than the distance at which closures can be solved for: nodes for P
(:mod:`srm_mbs.integration.methods.branch_nodes`) would have to be too far apart.  The branch itself
is smooth beyond that.  Let W (nv, f) be a basis of its velocities, whatever the drives, where the
step begins, its first column the direction w in which sigma changes most, and p (nv, f) the dual
basis, p^T W = 1.  *Nodes* q_k on both sides, at p^T (q_k (-) q_n) = (x_k, z), with closed loops,
are the same distance z along the other velocities as the stage that they solve, and

    T_k,   G T_k = 0,   p^T T_k = 1,

is smooth on the branch.  Polynomials through all nodes give the place q of the stage, the curve
through it with its derivatives q' and q'', and T; with drives, whose rates are D = (d rates) T,
the stage moves on the branch to where they are.  Then

    v_on = T s,   v' = T s' + b,   b = dT/dt s,   D s = the rates of the drives,
    T^T M (v_on - v) = D^T mu,   T^T M (v' - M^-1 f) = D^T nu,

because closures do no work.  The part of b along the curve is that of q''; with f > 1 the rest is
interpolated from the nodes, b_k = -E (Gdot v_k) + T_k p^T E (Gdot v_k), v_k = T_k s.  Columns of T
but the first, along which sigma does not change, have little to do with the loop that is singular,
so that the rounding of E, which grows like 1/sigma, does not enter.

The first guess of a node is on the parabola that the branch follows where the step begins: both
branches have its tangent, and only one its curvature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import BranchSystem, BranchTerms

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
SETTLED = 1e-13
"""The last motion (rad, scene diagonals) along the branch to where its drives are."""
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
    away : (1, nv) or (f + 1, nv)
        The direction of the branch there, as long as nodes are apart, or its frame.
    """

    state: FloatArray
    rate: FloatArray
    multiplier: FloatArray
    moved: FloatArray
    away: FloatArray


@dataclass(frozen=True)
class Node:
    """A closed configuration.

    Attributes
    ----------
    off, motion : (nv,)
        Motions to it from the parabola, and from the start of the step.
    tangents : (nv, f)
        Velocities that satisfy the closures, whatever the drives, with unit rates.
    driven : (d, f)
        Rates of the drives along them.
    residuals : (d,)
        Those of the drives.
    """

    off: FloatArray
    motion: FloatArray
    tangents: FloatArray
    driven: FloatArray
    residuals: FloatArray


def touching_frame(
    system: BranchSystem, t: float, state: FloatArray, tangents: FloatArray, slopes: FloatArray
) -> FloatArray:
    """The frame (f + 1, nv) of a branch at a ``state`` (nx,) where it has ``tangents`` (f, nv) with
    ``slopes`` (f,) of sigma: the direction in which that changes most, TOUCHING long, f - 1 in
    which it does not change, and half the curvature of the branch along the first."""
    steepest = int(np.argmax(np.abs(slopes)))
    others = tangents - np.outer(slopes / slopes[steepest], tangents[steepest])
    w = slopes @ tangents
    w = w / system.position_norm(w)
    moving = state.copy()
    moving[-system.nv :] = w
    bend = -0.5 * system.evaluate(t, moving).multiplier_of(np.zeros(system.nv))
    frame: FloatArray = np.vstack([TOUCHING * w, np.delete(others, steepest, axis=0), bend])
    return frame


class TouchingBranch:
    """Solves the stages of one step by the nodes of their branch.

    Parameters
    ----------
    system
        The mechanism.
    t, state
        Start of the step (s), the state there (nx,).
    frame : (f + 1, nv)
        That of :func:`touching_frame` there.
    """

    def __init__(
        self, system: BranchSystem, t: float, state: FloatArray, frame: FloatArray
    ) -> None:
        self._system, self._start = system, state
        unit = system.singularities.coordinate_unit
        tangents = frame[:-1] / np.array([[system.position_norm(row)] for row in frame[:-1]])
        scaled = tangents / unit**2
        self._tangents, self._along = tangents, np.linalg.solve(scaled @ tangents.T, scaled)
        self._bend = frame[-1] - (self._along @ frame[-1]) @ tangents
        self._none = np.zeros(system.nv)
        self._beside = np.zeros(0)
        self.nodes: list[Node] = []
        self._places = np.zeros(0)
        bounds = self._bounds(t)
        if bounds is None:
            return
        centre, reach = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
        if reach > FARTHEST:
            return
        distances = max(TOUCHING, reach) + NODE_SPACING * np.arange(EACH_SIDE)
        self._places = centre + np.column_stack([-distances, distances]).ravel()

    def _place(self, x: float, off: FloatArray) -> FloatArray:
        """The motion (nv,) from the start to x on the parabola, moved by ``off`` (nv,)."""
        out: FloatArray = x * self._tangents[0] + x**2 * self._bend + off
        return out + self._beside @ self._tangents[1:] if len(self._beside) else out

    def _moved(self, motion: FloatArray, v: FloatArray) -> FloatArray:
        state = self._system.retract(self._start, np.concatenate([motion, self._none]))
        state[-len(v) :] = v
        return state

    def _bounds(self, t: float) -> tuple[float, float] | None:
        """The ends of the part around the lowest sigma where it is below that of the first
        nodes; None if it is too long."""
        x = NODE_SPACING * np.arange(-SAMPLES, SAMPLES + 1)
        places = [self._moved(self._place(at, self._none), self._none) for at in x.tolist()]
        roots = np.sqrt([self._system.evaluate(t, place).sigma for place in places])
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

    def _node(self, t: float, x: float, off: FloatArray) -> Node | None:
        """The node at x, by Newton's method from the parabola moved by ``off`` (nv,); None if it
        does not find it."""
        system, last = self._system, np.inf
        for iteration in range(MAX_CLOSINGS):
            motion = self._place(x, off)
            terms = system.evaluate(t, self._moved(motion, self._none))
            if terms.rank_deficient or not terms.sigma > LEAST_SIGMA:
                return None
            residuals = terms.driven_residuals()
            closing = terms.closing(residuals)
            basis, driven = terms.branch_tangents()
            if basis.shape[1] != len(self._along):
                return None
            inverse = np.linalg.inv(self._along @ basis)
            tangents, driven = basis @ inverse, driven @ inverse
            closing = closing - tangents @ (self._along @ closing)
            change = system.position_norm(closing)
            off = off - closing
            if iteration == 0 and change > LARGEST_CLOSING * NODE_SPACING:
                return None
            if change < CLOSING_ACCURACY:
                return Node(off, self._place(x, off), tangents, driven, residuals)
            if iteration > 1 and not change < last:
                return None
            last = change
        return None

    def _follow(self, t: float, beside: FloatArray) -> bool:
        """Find the nodes ``beside`` (f - 1,) the step's start; whether there are any."""
        if self.nodes and np.array_equal(beside, self._beside):
            return True
        self._beside = beside
        known, self.nodes = self.nodes, []
        for k, x in enumerate(self._places.tolist()):
            off = known[k].off if known else self.nodes[k - 2].off if k > 1 else self._none
            node = self._node(t, x, off)
            if node is None:
                return False
            self.nodes.append(node)
        return len(self.nodes) > 0

    def _settled(self, t: float, z: FloatArray) -> FloatArray | None:
        """The point (nx,) of the branch where the drives have the rates z (f,); None if there is
        none."""
        system = self._system
        for _ in range(MAX_CLOSINGS):
            if not self._follow(t, z[1:]):
                return None
            value = polynomial_weights(self._places - z[0])[0]
            motions = np.array([node.motion for node in self.nodes])
            misfit = polynomial_weights(self._places[:-2] - z[0])[0] @ motions[:-2]
            misfit -= value @ motions
            if system.position_norm(misfit) > LARGEST_MISFIT:
                return None
            on = self._moved(value @ motions, self._none)
            terms = system.evaluate(t, on)
            residuals = terms.driven_residuals()
            shift = np.zeros(len(z))
            if len(residuals):
                tangents, driven = self._mean(value)
                found = _shared(terms, tangents, driven, shift, -residuals)
                if found is None:
                    return None
                shift = found
            if system.position_norm(shift @ self._tangents) < SETTLED:
                return on if terms.constraint_residual() <= LARGEST_RESIDUAL else None
            z = z + shift
        return None

    def _mean(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Tangents (nv, f) and rates of the drives along them (d, f), with ``weights`` (k,)."""
        tangents = sum(w * node.tangents for w, node in zip(weights.tolist(), self.nodes))
        return tangents, sum(w * node.driven for w, node in zip(weights.tolist(), self.nodes))

    def _targets(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Rates and accelerations (d,) of the drives at t (s)."""
        node, nv = self.nodes[-1], len(self._none)
        terms = self._system.evaluate(t, self._moved(node.motion, self._none))
        seen = np.array([terms.correction()[nv:], terms.multiplier_of(self._none)])
        rates, accelerations = -seen @ self._along.T @ node.driven.T
        return rates, accelerations

    def _curvature(self, t: float, node: Node, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Accelerations (nv,), and those of the drives (d,) but for their own, of a motion through
        ``node`` whose rates s (f,) are constant."""
        terms = self._system.evaluate(t, self._moved(node.motion, node.tangents @ s))
        multiplier = terms.multiplier_of(self._none)
        part = self._along @ multiplier
        return node.tangents @ part - multiplier, node.driven @ part

    def solve(self, t: float, state: FloatArray, stage: StageOnBranch) -> bool:
        """Solve the stage ``state`` (nx,) at t (s) as ``stage``; whether it could be solved."""
        system, nv, along = self._system, self._system.nv, self._along
        if not len(self._places):
            return False
        on = self._settled(t, along @ system.difference(self._start, state)[:nv])
        if on is None:
            return False
        # In the chart at a point of the branch, derivatives are those of the motion.
        motions = np.array(
            [
                system.difference(on, self._moved(node.motion, self._none))[:nv]
                for node in self.nodes
            ]
        )
        weights = polynomial_weights(motions @ along[0])
        tangents, driven = self._mean(weights[0])
        residuals = np.array([node.residuals for node in self.nodes])
        _, tangent, bend = weights @ motions
        _, drive_rate, drift = weights @ residuals
        rates, further = along @ tangent, along @ bend
        tangents[:, 0] = (tangent - tangents[:, 1:] @ rates[1:]) / rates[0]
        driven[:, 0] = (drive_rate - driven[:, 1:] @ rates[1:]) / rates[0]
        bend, drift = bend - tangents @ further, drift - driven @ further
        targets, accelerations = self._targets(t) if len(driven) else (self._none[:0],) * 2
        terms = system.evaluate(t, on)
        s = _shared(terms, tangents, driven, terms.momentum(state[-nv:]) @ tangents, targets)
        if s is None:
            return False
        part = s[0] / rates[0]
        bend, drift = part**2 * bend, part**2 * drift
        if len(s) > 1:
            for w, node in zip(weights[0].tolist(), self.nodes):
                for sign, own in ((1.0, s), (-1.0, part * rates)):
                    more, of_drives = self._curvature(t, node, own)
                    bend, drift = bend + sign * w * more, drift + sign * w * of_drives
        on[-nv:] = tangents @ s
        terms = system.evaluate(t, on)
        free = terms.free_acceleration()
        momentum = terms.momentum(free - bend) @ tangents
        change = _shared(terms, tangents, driven, momentum, accelerations - drift)
        if change is None:
            return False
        acceleration = tangents @ change + bend
        stage.state, stage.multiplier = on, free - acceleration
        stage.rate = np.concatenate([on[-nv:], acceleration])
        stage.moved = -system.difference(state, on)
        stage.moved[nv:] = state[-nv:] - on[-nv:]
        size = system.position_norm(tangents[:, 0])
        curvature = 0.5 * (weights[2] @ motions) / size**2
        stage.away = np.vstack([TOUCHING / size * tangents[:, 0], tangents.T[1:], curvature])
        return True


def _shared(
    terms: BranchTerms,
    tangents: FloatArray,
    driven: FloatArray,
    momentum: FloatArray,
    targets: FloatArray,
) -> FloatArray | None:
    """The rates (f,) along ``tangents`` (nv, f) with the ``momentum`` (f,) along them and the rates
    ``targets`` (d,) of the drives; None if these do not determine each other."""
    f, d = len(momentum), len(targets)
    if d > f:
        return None
    whole = np.zeros((f + d, f + d))
    whole[:f, :f] = tangents.T @ np.array([terms.momentum(row) for row in tangents.T]).T
    whole[:f, f:], whole[f:, :f] = driven.T, driven
    try:
        return np.linalg.solve(whole, np.concatenate([momentum, targets]))[:f]
    except np.linalg.LinAlgError:
        return None
