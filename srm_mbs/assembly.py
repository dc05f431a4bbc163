r"""Consistent initial states: close the loops, then make the rates fit.

Positions come from :mod:`srm_mbs.closing`.  Rates solve G v = s', the rates of the drives, 0 in
the rows of the loops.  Where the configuration is singular, that is not enough: a motion through it
also has u^T (Gdot v - s'') = 0 for every left null vector u of G (the tangents of the branches).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.closing import ClosureProblem, close_loops
from srm_mbs.closing_failure import cannot_close, free_coordinates, limits_in_the_way, quoted
from srm_mbs.coordinates import set_position, set_rate
from srm_mbs.driven_start import with_absolute_drives
from srm_mbs.errors import AssemblyError, EvaluationError, InputError
from srm_mbs.joint_limits import beyond_limits, close_within_limits
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.branch_limit import TELLS_THE_BRANCH, BranchLimit, branch_limit
from srm_mbs.systems.driven import DriveRows
from srm_mbs.systems.singular import (
    SINGULAR,
    SingularConfiguration,
    analyse_singular,
    nearest_singular,
)

RATE_TOLERANCE = 1e-12
ROUNDING, LOOSEST = 1e-14, 1e-8
"""Closure error of q, which over the distance from a singular configuration is an error of G v, and
the largest such error: the square root of round-off."""
AT_REST = 1e-14
"""Part of the given rates up to which what remains of them is rounding."""
EXACTLY, NEARLY = 1e-12, 1e-3
"""Singular values of G, rows over their usual size, between which rates come from the branch."""
CURVATURE = 1e-7
"""Largest u^T (Gdot v) of consistent rates, over the square of the rates."""


@dataclass(frozen=True, eq=False)
class Assembly:
    """A consistent state.

    Attributes
    ----------
    q : (nq,), v : (nv,)
        Configuration and velocity with closed loops and consistent rates.
    residuals : (rows,)
        Closure errors left at q, m and rad; those of the drives last.
    rate_residuals : (rows,)
        G v - s' left, m/s and rad/s.
    free_directions : (nv, k)
        Basis of the velocities that keep the loops closed and the drives still at q, orthonormal
        when divided by the units of the coordinates (1 rad, the scene diagonal).  More columns
        than degrees of freedom: q is singular.
    singular : bool
        Whether the closures have lost rank at q against the mechanism's structural rank.
    """

    q: FloatArray
    v: FloatArray
    residuals: FloatArray
    rate_residuals: FloatArray
    free_directions: FloatArray
    singular: bool


def _positions(
    mechanism: Mechanism,
    problem: ClosureProblem,
    start: FloatArray,
    held: tuple[str, ...],
    limits: bool,
) -> FloatArray:
    free = free_coordinates(mechanism, held)
    q = close_loops(problem, start, free)
    if not problem.closed(q):
        raise cannot_close(mechanism, problem, start, held, q)
    if not limits or not beyond_limits(mechanism, q):
        return q
    within = close_within_limits(problem, start, free)
    if within is None:
        raise limits_in_the_way(mechanism, problem, held, q)
    return within


@dataclass(frozen=True, eq=False)
class _Conditions:
    """What the rates u (nv,) of a motion, in units, satisfy: rows u = right, curvature(u) = 0."""

    rows: FloatArray
    right: FloatArray
    curvature: Callable[[FloatArray], FloatArray]


def _with_drives(
    rows: FloatArray, drives: DriveRows, curvature: Callable[[FloatArray], FloatArray]
) -> _Conditions:
    """Those of the closures, rows u = 0, and of the drives."""
    right = np.concatenate([np.zeros(len(rows)), drives.rates])
    return _Conditions(np.concatenate([rows, drives.rows]), right, curvature)


def _on_branch(limit: BranchLimit, unit: FloatArray, drives: DriveRows) -> _Conditions:
    """Those on one branch next to a singular configuration: the normal part vanishes."""
    normal = limit.projector * unit / unit[:, None]
    return _with_drives(normal, drives, lambda u: np.zeros(0))


def _conditions(
    mechanism: Mechanism, problem: ClosureProblem, q: FloatArray, drives: DriveRows
) -> tuple[_Conditions, SingularConfiguration | None]:
    """The conditions at q, and the singular configuration so close to q that rates choose the
    branch and not q."""
    normalised = problem.normalised(q)
    left, singular, _ = np.linalg.svd(np.concatenate([normalised, drives.rows]))
    left = left[:, int(np.sum(singular > SINGULAR)) :]

    def curvature(u: FloatArray) -> FloatArray:
        bias = np.concatenate([problem.bias(q, u), drives.bias(u)])
        out: FloatArray = left.T @ bias
        return out

    here = _with_drives(normalised, drives, curvature)
    singular = np.linalg.svd(normalised, compute_uv=False)
    if not np.any((singular > EXACTLY) & (singular < NEARLY)):
        return here, None
    # G determines the rates to round-off over the square of the distance: use the branch.
    rank = mechanism.structure.loop_rank
    found = nearest_singular(problem, q, rank, reach=10.0 * NEARLY)
    if found is None:
        return here, None
    close = analyse_singular(problem, found, rank)
    away = problem.difference(found, q)
    if np.linalg.norm(away) > TELLS_THE_BRANCH:
        limit = branch_limit(close, q, away)
        return (here if limit is None else _on_branch(limit, problem.unit, drives)), None
    return _with_drives(problem.normalised(found), drives, close.curvature), close


def _rates(
    mechanism: Mechanism,
    problem: ClosureProblem,
    q: FloatArray,
    v: FloatArray,
    held: tuple[str, ...],
) -> FloatArray:
    drives = DriveRows(mechanism, problem, q)
    _, G = problem.closure(q)
    G = np.concatenate([G, drives.rows])
    asked = np.concatenate([np.zeros(len(G) - len(drives.rates)), drives.rates])
    normalised = np.concatenate([problem.normalised(q), drives.rows])
    singular = np.linalg.svd(normalised, compute_uv=False)
    conditions, close = _conditions(mechanism, problem, q, drives)
    fastest = float(np.abs(np.concatenate([v / problem.unit, drives.rates])).max())

    def fit(u: FloatArray, free: IndexArray, to: _Conditions) -> FloatArray | None:
        """The rates nearest to u that satisfy the conditions; None if there are none."""
        _, s, right = np.linalg.svd(to.rows[:, free])
        rank = int(np.sum(s > SINGULAR))
        inverse = np.linalg.pinv(to.rows[:, free], rcond=SINGULAR / max(s[:1].sum(), SINGULAR))
        u = u.copy()
        for _ in range(2):  # the second pass removes the rounding of the first
            u[free] -= inverse @ (to.rows @ u - to.right)
        if np.abs(u).max() <= AT_REST * fastest:
            u[:] = 0.0  # what is left is rounding, which has no direction
        return _onto_tangent(u, free, right[rank:].T, to.curvature)

    def solve(names: Iterable[str]) -> tuple[FloatArray, float, bool]:
        """Rates in units, the largest G v left, and whether a motion has these rates."""
        free = free_coordinates(mechanism, names)
        u = fit(v / problem.unit, free, conditions)
        if u is not None and close is not None:
            limit = branch_limit(close, q, u)
            u = u if limit is None else fit(u, free, _on_branch(limit, problem.unit, drives))
        if u is None:
            start = v / problem.unit
            linear = replace(conditions, curvature=lambda u: np.zeros(0))
            nearest = fit(start, free, linear)
            closest = start if nearest is None else nearest
            return start, float(np.abs(G @ closest - asked).max()), False
        return u, float(np.abs(G @ u - asked).max()), True

    # Next to a singular configuration q lies off its branch by round-off over the distance.
    smallest = float(singular[singular > EXACTLY].min(initial=1.0))
    tolerance = max(RATE_TOLERANCE, min(ROUNDING / smallest, LOOSEST))
    tolerance *= max(1.0, fastest)

    def consistent(error: float, moves: bool) -> bool:
        return error <= tolerance and moves

    solved, error, moves = solve(held)
    if consistent(error, moves):
        return solved * problem.unit
    guilty = [
        name for name in held if consistent(*solve([h for h in held if h != name])[1:])
    ] or list(held)
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
    if np.any((singular > 1e-13) & (singular < 10.0 * SINGULAR)):
        remedy += (
            "; the held positions lie so close to a singular configuration that the rates are not "
            "determined: give them with all digits, or further away"
        )
    raise AssemblyError(
        what,
        residuals=problem.gaps(q),
        q=q,
        held=tuple(guilty),
        element="initial.v",
        remedy=remedy,
    )


def _onto_tangent(
    u: FloatArray,
    free: IndexArray,
    null: FloatArray,
    curvature: Callable[[FloatArray], FloatArray],
) -> FloatArray | None:
    """The rates nearest to u (nv,) that a motion has: ``curvature`` zero; None if there are none.

    They differ from u by combinations of the columns of ``null`` in the ``free`` coordinates.
    """
    from scipy.optimize import least_squares

    size = float(np.abs(u).max())
    if size == 0.0 or np.abs(curvature(u)).max(initial=0.0) <= CURVATURE * size**2:
        return u
    if not null.shape[1]:
        return None

    def bent(w: FloatArray) -> FloatArray:
        out = u.copy()
        out[free] += size * (null @ w)
        return out

    rng = np.random.default_rng(0)
    best = None
    for start in (np.zeros(null.shape[1]), *rng.uniform(-2.0, 2.0, (8, null.shape[1]))):
        found = least_squares(
            lambda w: curvature(bent(w)) / size**2, start, xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        closer = best is None or np.linalg.norm(found.x) < np.linalg.norm(best)
        if closer and np.abs(found.fun).max() <= CURVATURE:
            best = found.x
    return None if best is None else bent(best)


def _vector(values: Any, size: int, what: str) -> FloatArray:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise InputError(
            f"{what} must be {size} finite numbers",
            element=what,
            remedy="Give an array, or a mapping from joint names to values",
        )
    return array


def _check_distances(problem: ClosureProblem, start: FloatArray) -> None:
    """Refuse a guess in which the points of a ``distance`` coincide."""
    try:
        problem.closure(start)
    except EvaluationError as error:
        raise InputError(
            f"the loops cannot be evaluated at the guess: {error}",
            element="initial.guess",
            remedy='Give another guess, or use type = "point" if they are to coincide',
        ) from error


def assemble(
    mechanism: Mechanism,
    q: Mapping[str, Any] | Any = None,
    v: Mapping[str, Any] | Any = None,
    *,
    guess: Mapping[str, Any] | None = None,
    hold: Iterable[str] | None = None,
    limits: bool = False,
) -> Assembly:
    """Close the loops and make the rates consistent.

    Parameters
    ----------
    mechanism
        Its q0 is the guess for everything that is not given.
    q
        Joint name -> position (rad, m, or a list, see :mod:`srm_mbs.coordinates`), held exactly
        unless ``hold`` says otherwise; or a
        configuration (nq,), of which only the joints in ``hold`` are held.
    v
        Joint name -> rate, held exactly; or a velocity (nv,), which is changed as little as
        possible.  Rates not given are the least-norm ones: at a singular configuration, those of
        the branch on which the norm is least; give one more rate to choose another branch.
    guess
        Joint name -> position from which assembly starts; chooses the branch (the closing
        nearest to it that was found, in rad and scene diagonals).
    hold
        Names of the joints whose position is held; by default those named in ``q``.  If given,
        the other positions in ``q`` are guesses.
    limits
        Stay within the position limits of the joints.

    Returns
    -------
    Assembly
        With |g| <= 1e-12 in rad and scene diagonals, |G v| <= 1e-12 in those per second.  Next to
        a singular configuration, at distance d, the rates are those of the branch, exact to
        round-off over d; |G v| may be as large.

    Raises
    ------
    AssemblyError
        If the loops cannot close (with each loop's gap, the closest configuration, the held joints
        or limits in the way, and the nearest values of held joints that close), or if held values
        or rates contradict each other (naming them).
    InputError
        For unknown joints or malformed values, or a guess in which the points of a ``distance``
        coincide.
    """
    model = mechanism.model
    start = np.array(mechanism.q0)
    for name, value in (guess or {}).items():
        if isinstance(q, Mapping) and name in q:
            raise InputError(
                f"joint {name!r} is held in q and guessed in guess",
                element="guess",
                remedy="Keep one of the two",
            )
        set_position(mechanism, start, name, value)
    held: tuple[str, ...] = ()
    if isinstance(q, Mapping):
        for name, value in q.items():
            set_position(mechanism, start, name, value)
        held = tuple(q)
    elif q is not None:
        start = _vector(q, model.nq, "q")
        start = pin.normalize(model, start)
        if not (np.isfinite(start).all() and pin.isNormalized(model, start, 1e-9)):
            raise InputError(
                "q has a quaternion, or a (cos, sin) pair, of length zero",
                element="q",
                remedy="Use pinocchio.normalize(model, q)",
            )
    if hold is not None:
        held = (hold,) if isinstance(hold, str) else tuple(hold)
        for name in held:
            mechanism.joint(name)
    rates = np.zeros(model.nv)
    held_rates: tuple[str, ...] = ()
    if isinstance(v, Mapping):
        for name, value in v.items():
            set_rate(mechanism, rates, name, value)
        held_rates = tuple(v)
    elif v is not None:
        rates = _vector(v, model.nv, "v")
    if not mechanism.constrained:
        return Assembly(start, rates, np.zeros(0), np.zeros(0), np.eye(model.nv), False)
    held, to_close = with_absolute_drives(mechanism, start, held)
    problem = ClosureProblem(to_close, start)
    closed = start.copy()
    if to_close.loops:
        _check_distances(problem, start)
        closed = _positions(to_close, problem, start, held, limits)
    if to_close is not mechanism:
        problem = ClosureProblem(mechanism, start)
    for name in held:  # moving a quaternion by nothing rounds it
        joint = mechanism.joint(name)
        own = slice(joint.idx_q, joint.idx_q + joint.nq)
        closed[own] = start[own]
    consistent = _rates(mechanism, problem, closed, rates, held_rates)
    drives = DriveRows(mechanism, problem, closed)
    _, singular, right = np.linalg.svd(np.concatenate([problem.normalised(closed), drives.rows]))
    residuals, rate_residuals = mechanism.with_state(closed, consistent).initial_errors
    rank = int(np.sum(singular > SINGULAR))
    return Assembly(
        closed,
        consistent,
        residuals,
        rate_residuals,
        problem.unit[:, None] * right[rank:].T,
        model.nv - rank > mechanism.degrees_of_freedom,
    )
