r"""The motion next to a singular configuration, from nodes of its branch on both sides of it.

On a branch the multiplier yhat = P M^-1 f + E (Gdot v - s'') is a smooth function of the state, and
so are the motion onto the branch and the velocity off it.  At the singular configuration none of
them can be solved for; next to it rounding grows like 1/sigma^2.  A stage x = (q, v) there takes
them from the polynomial through eight *nodes*, evaluated at the stage itself:

    q_k = q (+) (k w + d_k),   k = +-1, ..., +-4,

where w is a direction that leads away from the singular configurations, and d_k the motion onto the
closures along the normals at q_k: q_k is the point of the branch nearest to q (+) k w in the mass
metric.  The row of a drive goes with the node, which closes it where k w leads it to; its rate and
acceleration are those of the drive.  Then

    q_on = q (+) d(0),   v_on = v - o(0),   o_k = P_k v - E_k s',
    yhat_k = E_k (G_k a + Gdot_k v_k - s''),   v_k = v - o_k,   a = M^-1 f at (q_on, v_on).

Nothing is extrapolated in time: a motion may stay as long as it likes, and turn where it likes.

The direction is that in which sigma changes most, among the velocities that satisfy the closures,
the drives' own included.  Only its being smooth matters: from stage to stage it follows the branch.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import BranchSystem, BranchTerms, System, onto_closures
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.methods.touching_branches import (
    StageOnBranch,
    TouchingBranch,
    touching_frame,
)

BRANCH_SIGMA = 3e-3
"""sigma below which stages of a motion that lingers are solved by nodes."""
KNOWN_DIRECTION_SIGMA = 1e-6
"""sigma from which a state determines the direction: below, rounding turns it."""
DIRECTION_PROBE = 0.1
"""Motion (rad, scene diagonals) by which the change of sigma is measured, over sigma."""
NODE_SPACING = 0.02
"""Distance between nodes (rad, scene diagonals)."""
SPACING_DOUBLINGS = 2
"""Times that it is doubled, at most, until it suffices."""
FIRST_NODE_SIGMA = 0.01
"""sigma of the first nodes for which the spacing suffices.  Where branches touch, sigma grows with
the square of the distance, and none does.  Every node needs half of it: where another loop is next
to its own singular configuration, nodes are no better than the stage."""
MAX_CLOSINGS = 12
"""Iterations of one node onto the closures."""
LARGEST_CLOSING = 0.5
"""Largest motion of the first of them, over the spacing: beyond it lies another branch."""
CLOSING_ACCURACY = 1e-12
"""Motion (rad, scene diagonals) of the last of them; the next one would be a hundredth of it."""
CLOSING_ROUNDING = 1e-10
"""Largest motion (rad, scene diagonals) of one that is no smaller than the one before: rounding,
which grows with the number of loops and like 1/sigma."""
PROPORTIONAL = (0.4, 0.6)
"""sigma at half a spacing over that at a whole one, where it vanishes in proportion to the
distance; where branches touch it is a quarter."""
LARGEST_MISFIT = 1e-6
"""Largest difference of the multiplier from that of the polynomial without the outermost nodes,
over the accelerations at the nodes: at the stage, they may balance."""

_PLACES = np.array([-1, 1, -2, 2, -3, 3, -4, 4], dtype=np.float64)
_VALUE = np.array([0.8, 0.8, -0.4, -0.4, 4 / 35, 4 / 35, -1 / 70, -1 / 70])
"""Weights of the value at 0 of the polynomial through all nodes."""
_COARSE = np.array([0.75, 0.75, -0.3, -0.3, 0.05, 0.05, 0.0, 0.0])
"""The same without the outermost two."""
_SLOPE = np.array([-0.8, 0.8, 0.2, -0.2, -4 / 105, 4 / 105, 1 / 280, -1 / 280])
"""Weights of the slope at 0."""


class BranchNodes(StageOnBranch):
    """Solves stages of ``system`` by nodes of their branch: after :meth:`solve` it is the stage.

    Parameters
    ----------
    finds_laws
        Whether the laws of forces are found as well.
    singular
        As of :class:`~srm_mbs.integration.methods.base.ErrorNorm`.

    Attributes
    ----------
    laws : (m,)
        Laws of forces at the stage.  What closures leave of the forces F of joined ones,
        F - M P M^-1 F, is smooth on the branch.
    """

    def __init__(
        self, system: BranchSystem, finds_laws: bool = False, singular: float = np.inf
    ) -> None:
        self._system, self._finds_laws, self._singular = system, finds_laws, singular
        self.laws = np.zeros(0)

    def _sigma_at(self, t: float, state: FloatArray, move: FloatArray) -> float:
        moved = self._system.retract(state, np.concatenate([move, np.zeros_like(move)]))
        return self._system.evaluate(t, moved).sigma

    def find_direction(self, t: float, state: FloatArray) -> FloatArray | None:
        """A direction (1, nv) of the branch that leads away from the singular configuration, as
        long as nodes are apart, or the frame of the branch (f + 1, nv) where branches touch; None
        if the ``state`` (nx,) does not determine it."""
        system = self._system
        terms = system.evaluate(t, state)
        sigma = terms.sigma
        if terms.rank_deficient or not sigma > KNOWN_DIRECTION_SIGMA:
            return None
        tangents = terms.branch_tangents()[0].T
        if not len(tangents):
            return None
        slopes = np.ones(len(tangents))
        if len(tangents) > 1:
            for i, f in enumerate(tangents):
                length = DIRECTION_PROBE * sigma / system.position_norm(f)
                ahead, behind = (self._sigma_at(t, state, side * f) for side in (length, -length))
                slopes[i] = (ahead - behind) / length
        if not slopes.any():
            return None
        away = self.spaced(t, state, slopes @ tangents)
        if away is None:
            return touching_frame(system, t, state, tangents, slopes)
        return away[None]

    def spaced(self, t: float, state: FloatArray, w: FloatArray) -> FloatArray | None:
        """The direction w (nv,), as long as nodes are apart; None if no spacing
        suffices."""
        size = self._system.position_norm(w)
        if not size > 0.0:
            return None
        w = w / size
        for doublings in range(SPACING_DOUBLINGS + 1):
            spacing = NODE_SPACING * 2.0**doublings
            sides = [self._sigma_at(t, state, side * spacing * w) for side in (1.0, -1.0)]
            if min(sides) >= FIRST_NODE_SIGMA:
                return spacing * w
        return None

    def distance(self, t: float, state: FloatArray, sigma: float, away: FloatArray) -> float:
        """Distance (rad, scene diagonals) of the ``state`` (nx,), with ``sigma``, from where sigma
        vanishes along ``away`` (nv,); NaN where it does so not in proportion to the distance.

        From half the length of ``away`` on, that at which sigma vanishes if it falls at its
        steepest."""
        spacing = self._system.position_norm(away)
        near, far = (
            [self._sigma_at(t, state, side * part * away) for side in (1.0, -1.0)]
            for part in (0.5, 1.0)
        )
        change = max(abs(there - sigma) for there in far)
        if sigma > 0.5 * change:
            return spacing * sigma / change if change > 0.0 else np.inf
        least, most = PROPORTIONAL
        if not least <= sum(near) / sum(far) <= most:
            return np.nan
        return spacing * abs(far[0] - far[1]) / sum(far)

    def _follow(
        self, t: float, state: FloatArray, move: FloatArray, spacing: float
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """The node (nx,) at ``state`` (+) ``move`` (nv,), its motion onto the closures (nv,) and
        the velocity off the branch (nv,)."""
        system = self._system
        v = state[-system.nv :]
        closing = np.zeros_like(move)
        last = np.inf
        for iteration in range(MAX_CLOSINGS):
            node = system.retract(state, np.concatenate([move + closing, np.zeros_like(move)]))
            terms = system.evaluate(t, node)
            if terms.rank_deficient or not terms.sigma > 0.5 * FIRST_NODE_SIGMA:
                return None
            if iteration == 0:
                allowed = terms.driven_residuals() - self._residuals
            further = terms.project(closing) - terms.closing(allowed)
            change = system.position_norm(further - closing)
            closing = further
            if iteration == 0 and change > LARGEST_CLOSING * spacing:
                return None
            settled = iteration > 1 and not change < last
            if settled and not change < CLOSING_ROUNDING:
                return None
            last = change
            if settled or change < CLOSING_ACCURACY:
                off = terms.correction()[system.nv :]
                node[-system.nv :] = v - off
                return node, closing, off
        return None

    def _avoided(self, terms: BranchTerms) -> bool:
        """Whether the closures between the nodes are open by more than a branch may be: they avoid
        the singular configuration, and the nodes are on two curves.

        sigma |E g| is the residual of the critical combination of rows, and not that of others."""
        if not terms.constraint_residual() > self._singular:
            return False
        off = terms.correction()[: self._system.nv]
        return terms.sigma * self._system.position_norm(off) > self._singular

    def solve(self, t: float, state: FloatArray, away: FloatArray) -> bool:
        """Solve the stage ``state`` (nx,) at t (s); whether it could be solved."""
        system, nv = self._system, self._system.nv
        self._residuals = system.evaluate(t, state).driven_residuals()
        spacing = system.position_norm(away)
        found = []
        for k in _PLACES.tolist():
            followed = self._follow(t, state, k * away, spacing)
            if followed is None:
                return False
            found.append(followed)
        closings = np.array([closing for _, closing, _ in found])
        off = np.array([off for *_, off in found])
        self.moved = np.concatenate([-_VALUE @ closings, _VALUE @ off])
        self.away = (away + _SLOPE @ closings)[None]
        self.state = system.retract(state, -self.moved)
        terms = system.evaluate(t, self.state)
        if self._avoided(terms):
            return False
        free = terms.free_acceleration()
        joined = None
        if self._finds_laws:
            joined = system.joined_laws()
            self.laws = system.laws if joined is None else joined[0].copy()
        multipliers, size = [], 0.0
        for weight, (node, *_) in zip(_VALUE.tolist(), found):
            terms = system.evaluate(t, node)
            if joined is not None:
                self.laws -= weight * terms.momentum(terms.project(joined[1]))
            multipliers.append(terms.multiplier_of(free))
            size = max(size, system.position_norm(terms.free_acceleration()))
        values = np.array(multipliers)
        self.multiplier = _VALUE @ values
        size += system.position_norm(self.multiplier)
        misfit = system.position_norm((_VALUE - _COARSE) @ values)
        self.rate = np.concatenate([self.state[-nv:], free - self.multiplier])
        return misfit <= LARGEST_MISFIT * size


class StageNodes(BranchNodes):
    """The nodes for the stages of one step, all with the same direction.

    Parameters
    ----------
    system
        The mechanism.
    t, state
        Start of the step (s) and the state there (nx,).
    direction : (1, nv), (f + 1, nv) or None
        That of :meth:`find_direction` there; None to find it when a stage needs it.
    finds_laws, singular
        As for :class:`BranchNodes`.

    Attributes
    ----------
    used
        Whether a stage was solved.
    lost
        Whether one could not be solved; then no other is.
    """

    def __init__(
        self,
        system: BranchSystem,
        t: float,
        state: FloatArray,
        direction: FloatArray | None,
        finds_laws: bool = False,
        singular: float = np.inf,
    ) -> None:
        super().__init__(system, finds_laws, singular)
        self._start, self._direction = (t, state), direction
        self._touching: TouchingBranch | None = None
        self.used = self.lost = False

    def solve_stage(self, t: float, state: FloatArray) -> bool:
        """Solve the stage ``state`` (nx,); whether it could be solved."""
        if self.lost:
            return False
        known = self._direction is not None
        if not known:
            self._direction = self.find_direction(*self._start)
        solved = self._solve_along(t, state)
        if not solved and not known:
            # From a start far away, or past a bend, the motion itself leads along its branch.
            away = self.spaced(t, state, state[-self._system.nv :])
            if away is not None:
                self._direction = away[None]
                solved = self.solve(t, state, away)
        self.used, self.lost = self.used or solved, not solved
        return solved

    def _solve_along(self, t: float, state: FloatArray) -> bool:
        if self._direction is None:
            return False
        if len(self._direction) > 1:
            if self._finds_laws:  # which nodes of branches that touch do not
                return False
            return self._solve_touching(t, state, self._direction)
        return self.solve(t, state, self._direction[0])

    def _solve_touching(self, t: float, state: FloatArray, direction: FloatArray) -> bool:
        if self._touching is None:
            self._touching = TouchingBranch(self._system, *self._start, direction)
        return self._touching.solve(t, state, self)


def onto_closed_branch(
    system: System, t: float, state: FloatArray, singular: float = np.inf
) -> FloatArray:
    """``state`` (nx,) moved along the normals onto the closures, or next to a singular
    configuration onto its branch, velocities by the M-orthogonal projection.

    ``singular`` is as of :class:`~srm_mbs.integration.methods.base.ErrorNorm`.
    At a distance d from the singular configuration, the normals of the closures at a state that is
    e off the branch are turned by e / d against those of the branch.

    Raises
    ------
    EvaluationError
        As :func:`~srm_mbs.dynamics.system.onto_closures`.
    """
    branch_system = system.branch_system
    if branch_system is not None:
        with suppress(EvaluationError):  # the projection meets it, or does without
            if branch_system.evaluate(t, state).sigma < BRANCH_SIGMA:
                nodes = StageNodes(branch_system, t, state, None, singular=singular)
                if nodes.solve_stage(t, state):
                    return nodes.state
    return onto_closures(system, t, state)
