"""Newton's iteration onto the closures, g(q) = 0, for every choice of unknowns.

Assembly, path following, minimal coordinates and the load-time analysis differ in what they solve
for and in which metric a step is shortest; they have the iteration in common.  Three searches have
one of their own, because they solve other equations or stop by another rule:
:func:`~srm_mbs.dynamics.system.onto_closures` (positions and velocities of any system, in the mass
metric, until the correction is rounding),
:func:`~srm_mbs.dynamics.singularities.local_analysis.refine_singular_point` (g = 0 together with a
loss of rank) and :class:`~srm_mbs.dynamics.singularities.branch_limit.BranchLimit` (until the step
is rounding, because what is interpolated there is the part along the normals).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

Point = TypeVar("Point")


def newton(
    point: Point,
    linearise: Callable[[Point], tuple[float, Callable[[], Point | None]]],
    evaluations: int,
    *,
    tolerance: float = 0.0,
    rounding: float = 0.0,
    monotone: bool = True,
) -> tuple[Point, float]:
    """Iterate from ``point`` until |g| is at most ``tolerance``.

    Parameters
    ----------
    point
        Unknowns at the start.
    linearise
        point -> (largest |g| there, a function that solves the linear equations and returns the
        next point, or None if they cannot be solved).
    evaluations
        Largest number of evaluations of g.
    rounding
        End, too, where |g| is at most this and the last step has not even halved it: what is left
        is rounding, or a contradiction of the equations.
    monotone
        End, too, as soon as |g| no longer decreases: it is down to rounding, or diverges.

    Returns
    -------
    tuple
        The last point, with ``monotone`` the best one, and the largest |g| there.
    """
    best, error = point, np.inf
    for evaluation in range(evaluations):
        size, step = linearise(point)
        if monotone and not size < error:
            break
        stuck = 0.5 * error < size <= rounding
        best, error = point, size
        if stuck or size <= tolerance or evaluation + 1 == evaluations:
            break
        moved = step()
        if moved is None:
            break
        point = moved
    return best, error
