r"""The curve of all closed configurations of a mechanism of one degree of freedom.

With one degree of freedom left, g(q) = 0 is a curve, which is followed by pseudo-arclength
continuation from a configuration on it: a step along the tangent, the null vector of G, then
Newton's iteration in the plane across it (E. Allgower, K. Georg, *Introduction to Numerical
Continuation Methods*, SIAM 2003, chapters 2, 6).  It passes the dead points of each joint, where
that turns back, without a distinction between joints.  Where the closures lose rank, branches
cross; the curve continues along its tangent.

Most curves are closed: the mechanism comes back to where it began, with hinges that have turned by
whole turns.  Others are followed both ways, up to where they end or leave a large region.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.assembly.continuation import (
    BENDS,
    CLOSE,
    CORRECTION,
    ITERATIONS,
    LARGEST_STEP,
    SMALLEST_STEP,
    Met,
    Waypoint,
    singular_on,
)
from srm_mbs.assembly.position import CONSTRAINT_TOLERANCE, RANK_TOLERANCE, ClosureProblem
from srm_mbs.dynamics.constraints.newton import newton
from srm_mbs.dynamics.scaling import angle_coordinates, periodic_coordinates
from srm_mbs.dynamics.singularities.local_analysis import smallest_singular_value

MOST_TURNS = 12
"""Turns of a joint from the start after which a curve that is not closed is left."""
FARTHEST = 10.0
"""The same for a displacement, in scene diagonals."""
SAME = 1e-6
"""Distance, in units, of two configurations that are the same."""


@dataclass(frozen=True, eq=False)
class ClosedCurve:
    """Configurations on the curve, in order.

    Attributes
    ----------
    q : (k, nq), tangents : (k, nv)
        Configurations, and unit tangents there in units of the coordinates.
    lengths : (k,)
        Arclength in units from the start, which is at 0; negative before it.
    closed
        Whether the last configuration is the first one but for whole turns.
    met
        The singular configurations on it, with the displacement of the crank from the start.
    """

    q: FloatArray
    tangents: FloatArray
    lengths: FloatArray
    closed: bool
    met: tuple[Met, ...]


@dataclass(frozen=True, eq=False)
class _Passed:
    """A configuration (nq,) on the curve, its tangent (nv,), and the arclength and the motion (nv,)
    from the start, in units."""

    q: FloatArray
    tangent: FloatArray
    length: float
    travelled: FloatArray


class CurveFollower:
    """Follows the curve through q (nq,), a closed, regular configuration.

    Parameters
    ----------
    problem
        The closures.
    q
        The start.
    rank
        Structural rank of the closures, one less than the number of coordinates.
    crank
        Velocity index of the coordinate that first increases.
    """

    def __init__(self, problem: ClosureProblem, q: FloatArray, rank: int, crank: int) -> None:
        self.problem, self.start, self.rank, self.crank = problem, q, rank, crank
        along = self.tangent(q)
        self.first = along if along[crank] >= 0.0 else -along
        model = problem.model
        self._periodic = periodic_coordinates(model)
        self._reach = np.where(angle_coordinates(model), MOST_TURNS * 2.0 * np.pi, FARTHEST)

    def tangent(self, q: FloatArray, before: FloatArray | None = None) -> FloatArray:
        """Unit tangent (nv,) at q, in the sense of ``before``; next to a singular configuration,
        where there are several, ``before`` itself."""
        problem = self.problem
        if before is not None and smallest_singular_value(problem, q, self.rank) < CLOSE:
            return before
        along: FloatArray = np.linalg.svd(problem.normalised(q))[2][self.rank]
        return along if before is None or along @ before >= 0.0 else -along

    def closed_at(self, guess: FloatArray, across: FloatArray) -> tuple[FloatArray, float] | None:
        """The configuration on the curve in the plane normal to ``across`` (nv,) through ``guess``
        (nq,), and its distance from that in units; None if Newton's iteration finds none."""
        problem = self.problem

        def linearise(
            at: tuple[FloatArray, FloatArray],
        ) -> tuple[float, Callable[[], tuple[FloatArray, FloatArray]]]:
            q, moved = at
            g, G = problem.closure(q)

            def next_point() -> tuple[FloatArray, FloatArray]:
                right = np.append(g, across @ moved)
                step = np.linalg.lstsq(np.vstack([G, across]), right, rcond=RANK_TOLERANCE)[0]
                return problem.move(q, -step), moved - step

            return float(np.abs(g).max()), next_point

        (found, moved), error = newton((guess, 0.0 * across), linearise, ITERATIONS)
        return (found, float(np.linalg.norm(moved))) if error <= CONSTRAINT_TOLERANCE else None

    def back_to_start(self, q: FloatArray) -> FloatArray:
        """The motion (nv,) from q to the start, in units, less whole turns of its hinges."""
        way = self.problem.difference(q, self.start)
        turns = np.round(way / (2.0 * np.pi))
        return np.asarray(np.where(self._periodic, way - 2.0 * np.pi * turns, way))

    def run(self, along: FloatArray) -> tuple[list[_Passed], bool]:
        """Follow the curve along the tangent ``along`` (nv,) of the start.

        Returns
        -------
        tuple
            What is passed after the start, and whether the last one is the start again.
        """
        problem, length, here, s = self.problem, LARGEST_STEP, self.start, 0.0
        travelled = np.zeros(len(along))
        passed: list[_Passed] = []

        def add(q: FloatArray, tangent: FloatArray) -> None:
            nonlocal here, s, travelled
            way = problem.difference(here, q)
            travelled = travelled + way
            s += float(np.linalg.norm(way))
            here = q
            passed.append(_Passed(q, tangent, s, travelled))

        begun = along
        while length >= SMALLEST_STEP and np.all(np.abs(travelled) <= self._reach):
            left = self.back_to_start(here)
            ahead = float(left @ along)
            near = s > LARGEST_STEP and np.linalg.norm(left) <= LARGEST_STEP
            if near and ahead > 0.0 and along @ begun > BENDS:
                found = self.closed_at(problem.move(here, ahead * along), along)
                target = problem.move(here, left)
                if found and np.linalg.norm(problem.difference(found[0], target)) <= SAME:
                    add(target, begun)
                    return passed, True
            found = self.closed_at(problem.move(here, length * along), along)
            if found is not None and found[1] <= CORRECTION * length:
                turned = self.tangent(found[0], along)
                if turned @ along > BENDS:
                    add(found[0], turned)
                    along, length = turned, min(LARGEST_STEP, 2.0 * length)
                    continue
            length *= 0.5
        return passed, False

    def curve(self) -> ClosedCurve:
        """The whole curve."""
        start = _Passed(self.start, self.first, 0.0, np.zeros(len(self.first)))
        after, closed = self.run(self.first)
        before = [] if closed else self.run(-self.first)[0]
        earlier = [_Passed(p.q, -p.tangent, -p.length, p.travelled) for p in reversed(before)]
        whole = [*earlier, start, *after]
        columns = np.array([self.crank])
        points = [Waypoint(p.q, p.travelled[columns], p.length) for p in whole]
        return ClosedCurve(
            np.array([p.q for p in whole]),
            np.array([p.tangent for p in whole]),
            np.array([p.length for p in whole]),
            closed,
            singular_on(self.problem, points, columns, self.rank),
        )
