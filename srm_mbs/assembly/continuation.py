r"""Dragging joints: closed configurations along given values of some coordinates.

The unknowns are the configuration and a path parameter s.  With the dragged coordinates h and their
values H(s), straight from knot to knot and s its length (in units), the path solves

    g(q) = 0,   h - H(s) = 0,

followed by pseudo-arclength continuation: a step along the tangent, Newton's iteration across it
(E. Allgower, K. Georg, *Introduction to Numerical Continuation Methods*, SIAM 2003, chapters 2, 6).
Where dh/ds of the tangent vanishes, the path turns back: the joints reach no further value.  Where
the closures lose rank, branches cross; the path continues along its tangent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.assembly.position import (
    CONSTRAINT_TOLERANCE,
    RANK_TOLERANCE,
    ClosureProblem,
    onto_singular_point,
)
from srm_mbs.dynamics.constraints.newton import newton
from srm_mbs.dynamics.singularities.local_analysis import (
    analyse_singular,
    nearest_singular,
    smallest_singular_value,
)

LARGEST_STEP, SMALLEST_STEP = 0.1, 1e-9
"""Arclength of a step, in units."""
ITERATIONS = 12
CORRECTION = 0.3
"""Largest correction of a step, as a part of it."""
BENDS = 0.95
"""Smallest cosine between the tangents at the ends of a step."""
LONGEST, STEEPEST = 100.0, 300.0
"""Length of a path in units, and more of it over the way of the dragged coordinates, after which it
leads away without end: a slide moves to infinity as the dragged joints come near to a value."""
CLOSE = 1e-5
"""Singular value of the closures below which the tangent is that of the step before."""
BETWEEN = 1.2
"""How much longer the way over a singular configuration may be than the way past it."""


@dataclass(frozen=True, eq=False)
class Met:
    """A singular configuration on the way: q (nq,), the loops that lose rank, the dragged values
    (rad, m)."""

    q: FloatArray
    loops: tuple[str, ...]
    values: FloatArray


@dataclass(frozen=True, eq=False)
class Drag:
    """The path of the dragged coordinates, up to where it ended.

    Attributes
    ----------
    q : (m, nq)
        Configurations at the first m knots.
    path : (k, nq), values : (k, n)
        All configurations on the way, and the dragged coordinates there (rad, m).
    turned
        Whether the path turned back before the last knot; then the last entry of ``path`` is where.
    complete
        Whether all knots were reached.
    cosine
        Smallest cosine of the angle by which the tangent turned from one configuration to the next.
    met
        Singular configurations on the way.
    """

    q: FloatArray
    path: FloatArray
    values: FloatArray
    turned: bool
    complete: bool
    cosine: float
    met: tuple[Met, ...]


@dataclass(frozen=True, eq=False)
class Waypoint:
    """Configuration (nq,), dragged coordinates (n,) in units, and parameter."""

    q: FloatArray
    h: FloatArray
    s: float


_Moved = tuple[Waypoint, FloatArray]
"""A point, and its motion (nv + 1,) from where Newton's iteration began."""


class _Follower:
    """The path, followed segment by segment, each between two knots."""

    def __init__(
        self, problem: ClosureProblem, columns: IndexArray, rank: int, start: FloatArray
    ) -> None:
        self.problem, self.columns, self.rank = problem, columns, rank
        nv = problem.model.nv
        self.free = np.setdiff1d(np.arange(nv), columns)
        self.selection = np.eye(nv)[columns]
        self.points = [Waypoint(start, np.zeros(len(columns)), 0.0)]
        self.tangents: list[FloatArray] = []
        self.cosine = 1.0
        self.endless = False

    def segment(self, s: float, values: FloatArray, slope: FloatArray) -> None:
        """From s on the dragged coordinates are values + slope (s' - s)."""
        self.base, self.values, self.slope = s, values, slope

    def rows(self, G: FloatArray) -> FloatArray:
        """Derivatives of g and h - H(s) by (q, s), for the Jacobian G (m, nv) of g."""
        below = np.column_stack([self.selection, -self.slope])
        return np.vstack([np.column_stack([G, np.zeros(len(G))]), below])

    def tangent(self, q: FloatArray, before: FloatArray | None) -> FloatArray:
        """Unit tangent (nv + 1,) of the path at q, in the sense of ``before``, or of rising s."""
        problem = self.problem
        near = smallest_singular_value(problem, q, self.rank) < CLOSE
        if near and before is not None:
            return before
        null = np.linalg.svd(self.rows(problem.normalised(q)))[2][self.rank + len(self.columns) :]
        # With further freedom left, the shortest way.
        along = null[0] if len(null) == 1 else null.T @ null[:, -1]
        along = along / np.linalg.norm(along)
        sense = along[-1] if before is None or len(null) > 1 else along @ before
        return np.asarray(along if sense >= 0.0 else -along)

    def correct(self, guess: Waypoint, across: FloatArray) -> tuple[Waypoint, float] | None:
        """Newton's iteration from ``guess`` in the plane normal to ``across``: the point and how
        far it is from the guess, or None."""
        problem = self.problem

        def linearise(at: _Moved) -> tuple[float, Callable[[], _Moved]]:
            point, moved = at
            g, G = problem.closure(point.q)
            miss = point.h - (self.values + self.slope * (point.s - self.base))

            def next_point() -> _Moved:
                system = np.vstack([self.rows(G), across])
                right = np.concatenate([g, miss, [across @ moved]])
                step = np.linalg.lstsq(system, right, rcond=RANK_TOLERANCE)[0]
                q = problem.move(point.q, -step[:-1])
                return Waypoint(q, point.h - step[self.columns], point.s - step[-1]), moved - step

            return max(np.abs(g).max(), np.abs(miss).max(initial=0.0)), next_point

        (best, moved), error = newton((guess, np.zeros(len(across))), linearise, ITERATIONS)
        return (best, float(np.linalg.norm(moved))) if error <= CONSTRAINT_TOLERANCE else None

    def advance(self, length: float, end: float) -> tuple[Waypoint, float] | None:
        """A step of ``length`` along the tangent, or less to s = end; its point and correction."""
        here, along = self.points[-1], self.tangents[-1]
        fixed = along[-1] > 0.0 and here.s + length * along[-1] >= end
        across = along
        if fixed:
            length = (end - here.s) / along[-1]
            across = np.eye(len(along))[-1]
        move = length * along
        guess = Waypoint(
            self.problem.move(here.q, move[:-1]),
            here.h + move[self.columns],
            end if fixed else here.s + move[-1],
        )
        found = self.correct(guess, across)
        if found is None or not fixed:
            # A point beyond the knot is none of this segment: a shorter step comes before it.
            return None if found is None or found[0].s > end else found
        point, correction = found
        sharp = onto_singular_point(self.problem, point.q, self.free)
        return Waypoint(sharp, point.h, end), correction

    def run(self, end: float) -> bool:
        """Follow the path to s = end; False if it turns back before, or ends."""
        length, growing, travelled = LARGEST_STEP, True, 0.0
        longest = LONGEST + STEEPEST * (end - self.points[-1].s)
        while self.points[-1].s < end:
            if travelled > longest:
                self.endless = True
                return False
            along = self.tangents[-1]
            step = min(length, (end - self.points[-1].s) / along[-1]) if along[-1] > 0.0 else length
            found = self.advance(length, end)
            if found is not None and found[1] <= CORRECTION * step:
                point = found[0]
                ahead = self.tangent(point.q, along)
                cosine = float(ahead @ along)
                back = ahead[-1] <= 0.0 or cosine < 0.0
                if point.s > self.points[-1].s and not back and cosine > BENDS:
                    self.cosine = min(self.cosine, cosine)
                    travelled += step
                    self.points.append(point)
                    self.tangents.append(ahead)
                    if growing:
                        length = min(LARGEST_STEP, 2.0 * length)
                    continue
                growing = growing and not back
            length = 0.5 * min(length, step)
            if length < SMALLEST_STEP:
                return False
        return True


def drag(
    problem: ClosureProblem, q: FloatArray, columns: IndexArray, values: FloatArray, rank: int
) -> Drag:
    """Drag coordinates of a closed configuration along ``values``.

    Parameters
    ----------
    problem
        The closures.
    q : (nq,)
        A closed, regular configuration, the first knot.
    columns : (n,)
        Velocity indices of the dragged coordinates; they must move independently of each other.
    values : (k, n)
        The further knots, as displacements of these coordinates from q (rad, m).
    rank
        Structural rank of the closures.
    """
    unit = problem.unit[columns]
    knots = np.vstack([np.zeros(len(columns)), values / unit])
    follower = _Follower(problem, columns, rank, q)
    reached, complete = [q], True
    old: FloatArray | None = None
    for knot, way in zip(knots, np.diff(knots, axis=0)):
        start, length = follower.points[-1].s, float(np.linalg.norm(way))
        if start + length == start:
            reached.append(follower.points[-1].q)
            continue
        slope = way / length
        follower.segment(start, knot, slope)
        before = None if old is None else _carried(follower.tangents[-1], old, slope)
        follower.tangents.append(follower.tangent(follower.points[-1].q, before))
        old = slope
        if not follower.run(start + length):
            complete = False
            break
        reached.append(follower.points[-1].q)
    steep = follower.tangents[-1][-1] < np.sqrt(SMALLEST_STEP) * 10.0
    turned = not complete and steep and not follower.endless
    path = follower.points
    return Drag(
        np.array(reached),
        np.array([point.q for point in path]),
        np.array([point.h for point in path]) * unit,
        turned,
        complete,
        follower.cosine,
        singular_on(problem, path, columns, rank),
    )


def _carried(tangent: FloatArray, old: FloatArray, new: FloatArray) -> FloatArray | None:
    """The tangent of a segment with the slope ``new``, from that of one with ``old`` along it."""
    ratio = float(new @ old / (old @ old))
    if tangent[-1] <= 0.0 or np.abs(new - ratio * old).max() > 1e-12 * np.abs(new).max():
        return None
    out = np.append(tangent[:-1] / tangent[-1] * ratio, 1.0)
    return np.asarray(out / np.linalg.norm(out))


def singular_on(
    problem: ClosureProblem, path: Sequence[Waypoint], columns: IndexArray, rank: int
) -> tuple[Met, ...]:
    """Singular configurations on a path: next to minima of the last structural singular value."""
    sizes = np.array([smallest_singular_value(problem, point.q, rank) for point in path])
    padded = np.concatenate([[np.inf], sizes, [np.inf]])
    found: list[Met] = []
    for i in np.flatnonzero((sizes < padded[:-2]) & (sizes <= padded[2:])).tolist():
        sides = [path[max(i - 1, 0)].q, path[min(i + 1, len(path) - 1)].q]
        width = float(np.linalg.norm(problem.difference(*sides)))
        if i in (0, len(path) - 1) and sizes[i] > CLOSE:
            continue
        q = nearest_singular(problem, path[i].q, rank, max(width, CLOSE))
        if q is None:
            continue
        detour = sum(np.linalg.norm(problem.difference(side, q)) for side in sides)
        if detour > BETWEEN * width + CLOSE:
            continue
        away = problem.difference(path[i].q, q)[columns]
        met = (path[i].h + away) * problem.unit[columns]
        found.append(Met(q, analyse_singular(problem, q, rank).participants.loops, met))
    return tuple(found)
