"""Overconstrained loops that close only to the accuracy of their data.

The rows of an overconstrained loop depend on each other: a planar four-bar has five rows of a hinge
where two would do.  With exact data a row that follows from others is satisfied wherever they are;
with rounded data (axes that are parallel to 1e-9) all rows together have no solution, and in place
of the motion there are isolated configurations of least squares.  Data that are accurate to a
stated tolerance contain the answer: the implied rows are left out, if the others determine the same
motion and the implied rows are satisfied to the tolerance along it.  What remains are closures like
any others, which assembly, runs and analyses satisfy to rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.assembly.position import CONSTRAINT_TOLERANCE, ClosureProblem, close_positions
from srm_mbs.dynamics.constraints.projection import pivoted_qr
from srm_mbs.dynamics.constraints.row_algebra import min_norm_solution
from srm_mbs.dynamics.constraints.structure import (
    CLOSING_STEPS,
    STRUCTURAL_PIVOT,
    WALK_AMPLITUDE,
    ManifoldSampler,
)
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import coordinate_units
from srm_mbs.errors import AssemblyError

NEIGHBOURS = 12
"""Configurations next to the start in which ranks are measured: the start may be singular."""
SETTLING_STEPS = 40
"""Steps of the iteration onto the configuration of least squares."""
SETTLED = 1e-14
"""Its last step, in units."""
LARGEST_SHARE = 10.0
"""Singular value of implied rows, over the tolerance and the largest one."""
WORST_CHOICE = 1e-3
"""Least singular value of the rows that are kept, over that of all rows."""
WALKS, STEPS = 4, 8
"""Walks along the motion on which the implied rows are measured, and their steps."""


def without_implied_rows(mechanism: Mechanism, tolerance: float) -> tuple[Mechanism, str]:
    """The mechanism without the rows of its closures that the others imply to ``tolerance``.

    Parameters
    ----------
    mechanism
        Its q0 is the guess.
    tolerance
        Largest distance (m) and misalignment (rad) of the complete loops, at the closest
        configuration and along the motion.

    Returns
    -------
    mechanism, note
        The mechanism, not assembled, and a sentence about it; as it is, with an empty one, if no
        rows are implied, if they are implied exactly, or if the loops are open by more.

    Raises
    ------
    AssemblyError
        If the loops are open by more than the tolerance along the motion; if which rows are implied
        changes along it.
    """
    if not mechanism.loops:
        return mechanism, ""
    problem = ClosureProblem(mechanism, mechanism.q0)
    # Data that err by the tolerance turn implied rows by as much.
    zero = max(STRUCTURAL_PIVOT, LARGEST_SHARE * tolerance / float(problem.row_unit.min()))
    everything = np.arange(problem.model.nv)
    closest = _settled(problem, close_positions(problem, mechanism.q0, everything), zero)
    if _largest(problem, closest) > tolerance:
        return mechanism, ""
    near = [closest, *_neighbours(problem, closest, tolerance, zero)]
    # Not normalised: rows that are all implied would be scaled up to rows like any others.
    rows = [problem.closure(q)[1] for q in near]
    ranks = [np.linalg.matrix_rank(G, rtol=zero) for G in rows]
    rank = int(max(ranks))
    exact = CONSTRAINT_TOLERANCE * max(1.0, problem.units.length)
    if rank == len(rows[0]) or max(_largest(problem, q) for q in near) <= exact:
        return mechanism, ""
    refused = partial(_refused, problem, closest)
    regular = [G for G, own in zip(rows, ranks) if own == rank]
    kept = _independent_rows(regular, rank)
    if kept is None:
        raise refused(
            "which rows of the loops follow from the others changes along the motion, so that none "
            "can be left out",
            "Give more digits in the file",
        )
    reduced, left_out = _left_out(mechanism, kept)
    worst = max(_largest(problem, q) for q in (closest, *_motion(reduced, closest)))
    if worst > tolerance:
        raise refused(
            f"along the motion the loops close to {worst:.3g} (m, rad) only, more than the closing "
            "tolerance",
            f"Check the anchors and link lengths, or give at least {1.1 * worst:.1e} if that is "
            "the accuracy of the file",
        )
    return reduced, (
        f"the loops close to {worst:.1e} (m, rad) only: {', '.join(left_out)} follow from the "
        f"other rows to the closing tolerance of {tolerance:g} and are left out"
    )


def _settled(problem: ClosureProblem, q: FloatArray, zero: float) -> FloatArray:
    """The configuration of least squares next to q (nq,): Gauss-Newton steps in which the singular
    values of dependent rows, below ``zero`` times the largest, count as zero."""
    for _ in range(SETTLING_STEPS):
        g, G = problem.closure(q)
        step = min_norm_solution(G, g, zero)
        q = problem.move(q, -step)
        if not np.abs(step).max() > SETTLED:
            break
    return q


def _largest(problem: ClosureProblem, q: FloatArray) -> float:
    """The largest distance (m) or misalignment (rad) of the loops at q (nq,)."""
    found = [value for pair in problem.loop_residuals(q).values() for value in pair]
    return max(value for value in found if value is not None)


def _neighbours(
    problem: ClosureProblem, q: FloatArray, tolerance: float, zero: float
) -> Iterator[FloatArray]:
    """Configurations around q (nq,) in which the loops are as good as closed."""
    rng = np.random.default_rng(0)
    for _ in range(NEIGHBOURS):
        spread = rng.uniform(-WALK_AMPLITUDE, WALK_AMPLITUDE, problem.model.nv)
        found = _settled(problem, problem.move(q, spread), zero)
        if _largest(problem, found) <= tolerance:
            yield found


def _independent_rows(samples: Sequence[FloatArray], rank: int) -> IndexArray | None:
    """Indices (rank,) of rows that have the rank of all rows G (rows, nv) in every sample.

    Of the choices by pivoted QR in each sample, the one whose least singular value, over that of
    all rows, is the largest; None if it is small.
    """
    weakest = [np.linalg.svd(G, compute_uv=False)[rank - 1] for G in samples]
    best, found = WORST_CHOICE, None
    for G in samples:
        choice = np.sort(pivoted_qr(G.T)[1][:rank])
        parts = [np.linalg.svd(other[choice], compute_uv=False)[-1] for other in samples]
        worst = float(min(np.array(parts) / weakest))
        if worst > best:
            best, found = worst, choice
    return found


def _left_out(mechanism: Mechanism, kept: IndexArray) -> tuple[Mechanism, list[str]]:
    """The mechanism with the rows ``kept`` alone, and the names of the others."""
    loops, left_out, at = [], [], 0
    for loop in mechanism.loops:
        labels = [label for row, label in enumerate(loop.rows.labels, at) if row not in kept]
        left_out += [f"{loop.name}.{label}" for label in labels]
        if len(labels) < loop.rows.count:
            loops.append(replace(loop, without=(*loop.without, *labels)) if labels else loop)
        at += loop.rows.count
    return replace(mechanism, loops=tuple(loops)), left_out


def _motion(reduced: Mechanism, start: FloatArray) -> Iterator[FloatArray]:
    """Configurations along the motion of the ``reduced`` mechanism from ``start`` (nq,)."""
    units = coordinate_units(reduced, start, np.zeros(reduced.model.nv))
    sampler = ManifoldSampler(reduced, units)
    closed, _ = sampler.close(start, CLOSING_STEPS)
    yield closed
    yield from sampler.walk(closed, np.random.default_rng(0), WALKS, STEPS)


def _refused(problem: ClosureProblem, q: FloatArray, why: str, remedy: str) -> AssemblyError:
    return AssemblyError(
        why,
        residuals=problem.loop_residuals(q),
        q=q,
        element="closing_tolerance",
        remedy=remedy,
    )
