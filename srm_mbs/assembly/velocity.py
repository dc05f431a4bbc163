r"""Assembly of velocities: rates that satisfy the closures of a closed configuration.

They solve G v = s', the rates of the drives, 0 in the rows of the loops.  Where the configuration
is singular, that is not enough: a motion through it also has u^T (Gdot v - s'') = 0 for every left
null vector u of G (the tangents of the branches).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.assembly.diagnosis import quoted
from srm_mbs.assembly.position import ClosureProblem
from srm_mbs.dynamics.constraints.geometry import DriveRows
from srm_mbs.dynamics.constraints.row_algebra import (
    null_basis,
    rank_revealing_qr,
    smallest_singular_value,
)
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.singularities.branch_limit import BRANCH_RESOLUTION, BranchLimit, branch_limit
from srm_mbs.dynamics.singularities.local_analysis import (
    SINGULAR,
    SingularConfiguration,
    analyse_singular,
    nearest_singular,
)
from srm_mbs.errors import AssemblyError
from srm_mbs.model.coordinates import free_coordinates

RATE_TOLERANCE = 1e-12
"""Largest |G v - s'| of assembled rates, in units per second."""
CLOSURE_ROUNDING, LARGEST_RATE_ERROR = 1e-14, 1e-8
"""Closure error of q, which over the distance from a singular configuration is an error of G v, and
the largest such error: the square root of round-off."""
AT_REST = 1e-14
"""Part of the given rates below which the fitted rates are rounding of zero."""
EXACTLY, NEARLY = 1e-12, 1e-3
"""Singular values of G, rows over their usual size, between which rates come from the branch."""
CURVATURE = 1e-7
"""Largest u^T (Gdot v) of consistent rates, over the square of the rates."""


def assemble_velocity(
    mechanism: Mechanism,
    problem: ClosureProblem,
    q: FloatArray,
    v: FloatArray,
    held: tuple[str, ...],
    analysed: Mechanism,
) -> FloatArray:
    """The rates (nv,) nearest to v that a motion of ``mechanism`` through q has.

    Parameters
    ----------
    mechanism, problem
        The mechanism and its closure equations.
    q : (nq,), v : (nv,)
        A configuration with closed loops, and the requested rates.
    held
        Joints whose rates stay as in ``v``.
    analysed
        The mechanism, with q as its initial configuration: its structure is asked for.

    Raises
    ------
    AssemblyError
        If there are none, naming the held rates or drives that contradict the closures.
    """
    drives = DriveRows(mechanism, problem, q)
    _, G = problem.closure(q)
    G = np.concatenate([G, drives.rows])
    prescribed = np.concatenate([np.zeros(len(G) - len(drives.rates)), drives.rates])
    normalised = np.concatenate([problem.normalised(q), drives.rows])
    smallest = 0.0 if len(drives.rates) else problem.smallest_value(q)
    if not smallest > EXACTLY:
        smallest = smallest_singular_value(normalised, EXACTLY)
    conditions, close = _conditions(analysed, problem, q, drives, smallest)
    fastest = float(np.abs(np.concatenate([v / problem.unit, drives.rates])).max())

    def onto_rows(
        u: FloatArray, free: IndexArray, to: _Conditions
    ) -> tuple[FloatArray, FloatArray]:
        """The rates nearest to u that satisfy the linear conditions, and the null space of these
        in the free coordinates."""
        moved = rank_revealing_qr(to.rows[:, free], SINGULAR)
        u = u.copy()
        for _ in range(2):  # the second pass removes the rounding of the first
            u[free] -= moved.solve(to.rows @ u - to.right)
        if np.abs(u).max() <= AT_REST * fastest:
            u[:] = 0.0  # rounding, which has no direction
        return u, moved.null

    def fit(u: FloatArray, free: IndexArray, to: _Conditions) -> FloatArray | None:
        """The rates nearest to u that satisfy the conditions; None if there are none."""
        u, null = onto_rows(u, free, to)
        independent = len(free) - null.shape[1] == to.used
        return _onto_tangent(u, free, null, _no_curvature if independent else to.curvature)

    def solve(names: Iterable[str]) -> tuple[FloatArray, float, bool]:
        """Rates in units, the largest G v left, and whether a motion has these rates."""
        free = free_coordinates(mechanism, names)
        start = v / problem.unit
        u = fit(start, free, conditions)
        if u is not None and close is not None:
            limit = branch_limit(close, q, u)
            u = u if limit is None else fit(u, free, _on_branch(limit, problem.unit, drives))
        moves = u is not None
        if u is None:
            u, _ = onto_rows(start, free, conditions)
        return u, float(np.abs(G @ u - prescribed).max()), moves

    # Next to a singular configuration q lies off its branch by round-off over the distance.
    smallest = min(smallest, 1.0)
    tolerance = max(RATE_TOLERANCE, min(CLOSURE_ROUNDING / smallest, LARGEST_RATE_ERROR))
    tolerance *= max(1.0, fastest)
    solved, error, moves = solve(held)
    if error <= tolerance and moves:
        return solved * problem.unit
    guilty = []
    for name in held:
        _, left, moves_without = solve([other for other in held if other != name])
        if left <= tolerance and moves_without:
            guilty.append(name)
    guilty = guilty or list(held)
    driven = quoted(drive.name for drive in mechanism.drives)
    if error > tolerance and not held:
        what = (
            f"the drives ({driven}) contradict the closures, or each other "
            f"(by {error:.2e} in units per second)"
        )
    elif error > tolerance:
        against = f"the closures or the drives ({driven})" if driven else "the closures"
        what = f"the held rates of {quoted(held)} contradict {against} (G v = {error:.2e})"
    elif held:
        what = f"no motion through this singular configuration has the rates of {quoted(held)}"
    else:
        what = "no motion through this singular configuration has rates close to these"
    remedy = f"Change or free one of {quoted(guilty)}" if guilty else "Give other rates"
    if driven and not held:
        remedy = "Change or remove a drive, or start where the motion can follow it"
    if smallest_singular_value(normalised, 1e-13) < 10.0 * SINGULAR:
        remedy += (
            "; the held positions lie so close to a singular configuration that the rates are not "
            "determined: give them with all digits, or further away"
        )
    raise AssemblyError(
        what,
        residuals=problem.loop_residuals(q),
        q=q,
        held=tuple(guilty),
        element="initial.v",
        remedy=remedy,
    )


@dataclass(frozen=True, eq=False)
class _Conditions:
    """Conditions on the rates u (nv,), in units, of a motion: rows u = right, curvature(u) = 0,
    which says nothing where the rows in use, as many as ``used``, are independent."""

    rows: FloatArray
    right: FloatArray
    curvature: Callable[[FloatArray], FloatArray]
    used: int


def _no_curvature(_: FloatArray) -> FloatArray:
    return np.zeros(0)


def _with_drives(
    rows: FloatArray,
    drives: DriveRows,
    curvature: Callable[[FloatArray], FloatArray],
    used: int = -1,
) -> _Conditions:
    """The conditions of the closures, rows u = 0, and of the drives; without ``used``, rows may
    depend on each other."""
    right = np.concatenate([np.zeros(len(rows)), drives.rates])
    return _Conditions(np.concatenate([rows, drives.rows]), right, curvature, used)


def _on_branch(limit: BranchLimit, unit: FloatArray, drives: DriveRows) -> _Conditions:
    """The conditions on one branch next to a singular configuration: u has no normal part."""
    normal = limit.projector * unit / unit[:, None]
    return _with_drives(normal, drives, _no_curvature)


def _conditions(
    mechanism: Mechanism,
    problem: ClosureProblem,
    q: FloatArray,
    drives: DriveRows,
    smallest: float,
) -> tuple[_Conditions, SingularConfiguration | None]:
    """The conditions at q, the start of ``mechanism``, where ``smallest`` is the smallest singular
    value of the closures, and the singular configuration if q is so close to one that the rates
    determine the branch instead of q."""
    normalised = problem.normalised(q)
    used = np.append(~problem.idle_rows, np.ones(len(drives.rates), dtype=bool))
    left: FloatArray | None = None

    def curvature(u: FloatArray) -> FloatArray:
        nonlocal left
        if left is None:
            left = null_basis(np.concatenate([normalised, drives.rows])[used].T, SINGULAR)
        if not left.shape[1]:
            return np.zeros(0)
        out: FloatArray = left.T @ np.concatenate([problem.bias(q, u), drives.bias(u)])[used]
        return out

    here = _with_drives(normalised, drives, curvature, int(np.count_nonzero(used)))
    if not smallest < NEARLY:
        return here, None
    # G determines the rates to round-off over the square of the distance: use the branch.
    rank = mechanism.structure.loop_rank
    found = nearest_singular(problem, q, rank, reach=10.0 * NEARLY)
    if found is None:
        return here, None
    close = analyse_singular(problem, found, rank)
    away = problem.difference(found, q)
    if np.linalg.norm(away) > BRANCH_RESOLUTION:
        limit = branch_limit(close, q, away)
        return (here if limit is None else _on_branch(limit, problem.unit, drives)), None
    return _with_drives(problem.normalised(found), drives, close.curvature), close


def _onto_tangent(
    u: FloatArray,
    free: IndexArray,
    null: FloatArray,
    curvature: Callable[[FloatArray], FloatArray],
) -> FloatArray | None:
    """The rates nearest to u (nv,) that a motion has: ``curvature`` zero; None if there are none.

    They differ from u by combinations of the columns of ``null`` in the ``free`` coordinates.
    """
    size = float(np.abs(u).max())
    if size == 0.0:
        return u
    largest = float(np.abs(curvature(u)).max(initial=0.0))
    if largest <= CURVATURE * size * size < np.inf:
        return u
    if not null.shape[1] or not np.isfinite(largest):  # squares of the rates overflow
        return None
    from scipy.optimize import least_squares

    def bent(w: FloatArray) -> FloatArray:
        out = u.copy()
        out[free] += size * (null @ w)
        return out

    rng = np.random.default_rng(0)
    zeros = []
    for start in (np.zeros(null.shape[1]), *rng.uniform(-2.0, 2.0, (8, null.shape[1]))):
        found = least_squares(
            lambda w: curvature(bent(w)) / (size * size), start, xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        if np.abs(found.fun).max() <= CURVATURE:
            zeros.append(found.x)
    return bent(min(zeros, key=np.linalg.norm)) if zeros else None
