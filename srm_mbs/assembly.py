r"""Consistent initial states: close the loops, then make the rates fit.

Positions are found in two stages on the configuration manifold: a trust-region least-squares
solve from the guess (SciPy), whose residual has the intended closing as its only zero, and
Gauss-Newton on the closure rows to round-off.  The guess chooses the branch.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.coordinates import set_position, set_rate
from srm_mbs.errors import AssemblyError, InputError
from srm_mbs.mechanism import LoopClosure, Mechanism
from srm_mbs.systems.loops import LoopKinematics
from srm_mbs.systems.units import coordinate_units, row_units

CLOSED = 1e-12
"""Largest closure error of an assembled state, in rad and in scene diagonals."""
RATE_TOLERANCE = 1e-12
RANK = 1e-10
"""Relative singular value below which a direction does not move the closures."""
PERTURBATIONS = (0.05, 0.2, 0.5, 1.0, 1.5, 2.0)
"""Sizes (rad, scene diagonals) of the restarts when the guess itself leads nowhere."""


@dataclass(frozen=True, eq=False)
class Assembly:
    """A consistent state.

    Attributes
    ----------
    q : (nq,), v : (nv,)
        Configuration and velocity with closed loops and consistent rates.
    residuals : (rows,)
        Closure errors left at q, m and rad.
    rate_residuals : (rows,)
        G v left, m/s and rad/s.
    free_directions : (nv, k)
        Basis of the velocities that keep the loops closed at q, orthonormal in units of 1 rad
        and the scene diagonal.  More columns than degrees of freedom: q is singular.
    singular : bool
        Whether the closures have lost rank at q against the mechanism's structural rank.
    """

    q: FloatArray
    v: FloatArray
    residuals: FloatArray
    rate_residuals: FloatArray
    free_directions: FloatArray
    singular: bool


class _Problem:
    """Closure equations of a mechanism in the free coordinates."""

    def __init__(self, mechanism: Mechanism, start: FloatArray) -> None:
        self.mechanism = mechanism
        self.model = mechanism.model
        self.data = self.model.createData()
        self.rows = LoopKinematics(self.model, mechanism.loops)
        units = coordinate_units(mechanism, start, np.zeros(self.model.nv))
        self.unit = units.coordinate
        self.length = units.length
        self.row_unit = row_units(mechanism.loops, units.length)

    def closure(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """g over row units (rows,), and G over row units times coordinate units (rows, nv)."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        self.rows.update(self.data, with_bias=False)
        return self.rows.g / self.row_unit, self.rows.G / self.row_unit[:, None] * self.unit

    def mismatch(self, q: FloatArray) -> FloatArray:
        """Closing residual whose only zero is the intended closing: gaps and axis differences."""
        self.closure(q)
        parts = []
        for loop in self.mechanism.loops:
            Ta, Tb = self._anchors(loop)
            parts.append(loop.rows.directions @ Tb.actInv(Ta.translation) / self.length)
            if len(loop.rows.matched):
                R = Tb.rotation.T @ Ta.rotation
                parts.append((loop.rows.matched @ R.T - loop.rows.matched).ravel())
        return np.concatenate(parts)

    def gaps(self, q: FloatArray) -> dict[str, tuple[float | None, float | None]]:
        """Gap (m) and misalignment (rad) of each loop at q; None where a type has none."""
        self.closure(q)
        out = {}
        for loop in self.mechanism.loops:
            Ta, Tb = self._anchors(loop)
            gap = angle = None
            if len(loop.rows.directions):
                gap = float(np.linalg.norm(loop.rows.directions @ Tb.actInv(Ta.translation)))
            if len(loop.rows.matched):
                R = Tb.rotation.T @ Ta.rotation
                # chord of the unit vectors -> angle, accurate for small ones
                chords = np.linalg.norm(loop.rows.matched @ R.T - loop.rows.matched, axis=1)
                angle = float(np.max(2.0 * np.arcsin(np.minimum(0.5 * chords, 1.0))))
            out[loop.name] = (gap, angle)
        return out

    def _anchors(self, loop: LoopClosure) -> tuple[pin.SE3, pin.SE3]:
        joint_a, in_a = loop.a.resolve(self.model)
        joint_b, in_b = loop.b.resolve(self.model)
        return self.data.oMi[joint_a] * in_a, self.data.oMi[joint_b] * in_b

    def move(self, q: FloatArray, free: IndexArray, delta: Any) -> FloatArray:
        """q (+) delta, delta (k,) in units over the free coordinates (indices)."""
        full = np.zeros(self.model.nv)
        full[free] = delta * self.unit[free]
        return pin.integrate(self.model, q, full)  # type: ignore[no-any-return]

    def closed(self, q: FloatArray) -> bool:
        """Whether every loop is closed as intended, axes in the right sense."""
        g, _ = self.closure(q)
        return float(np.abs(g).max()) <= CLOSED and float(np.abs(self.mismatch(q)).max()) < 1e-6


def _search(problem: _Problem, q: FloatArray, free: IndexArray) -> FloatArray:
    """Least-squares solve of the closing residual over the free coordinates, from q."""
    from scipy.optimize import least_squares

    found = least_squares(
        lambda delta: problem.mismatch(problem.move(q, free, delta)),
        np.zeros(len(free)),
        method="trf",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=200,
    )
    return problem.move(q, free, found.x)


def _polish(problem: _Problem, q: FloatArray, free: IndexArray) -> tuple[FloatArray, int]:
    """Gauss-Newton on the closure rows until they stop improving; q and the iterations used."""
    g, G = problem.closure(q)
    best, error = q, float(np.abs(g).max())
    iterations = 0
    while error > 0.0 and iterations < 60:
        iterations += 1
        step = np.linalg.lstsq(G[:, free], g, rcond=RANK)[0]
        q = problem.move(q, free, -step)
        g, G = problem.closure(q)
        new_error = float(np.abs(g).max())
        if not new_error < error:
            break
        best, error = q, new_error
    return best, iterations


def _onto_singular_point(problem: _Problem, q: FloatArray, free: IndexArray) -> FloatArray:
    """Sharpen a double root: Newton on [g; u^T G] with u the left null vectors of G.

    At a singular configuration g has a double root in the free coordinates, which Gauss-Newton
    finds only to the square root of round-off.  Returns q unchanged where this does not help.
    """

    def equations(x: FloatArray, left: FloatArray) -> FloatArray:
        g, G = problem.closure(x)
        return np.concatenate([g, (left @ G[:, free]).ravel()])

    x = q
    error = np.inf
    best = q
    for _ in range(8):
        _, G = problem.closure(x)
        left, singular, _ = np.linalg.svd(G[:, free])
        rank = int(np.sum(singular > 1e-4))
        null = left[:, rank:].T
        value = equations(x, null)
        new_error = float(np.abs(value).max())
        if not new_error < error:
            break
        best, error = x, new_error
        tau = 1e-6
        jacobian = np.array(
            [
                equations(problem.move(x, free, tau * e), null)
                - equations(problem.move(x, free, -tau * e), null)
                for e in np.eye(len(free))
            ]
        ).T / (2.0 * tau)
        x = problem.move(x, free, -np.linalg.lstsq(jacobian, value, rcond=1e-9)[0])
    if error < 1e-11 and float(np.abs(pin.difference(problem.model, q, best)).max()) < 1e-4:
        return best
    return q


def _close(problem: _Problem, start: FloatArray, free: IndexArray) -> FloatArray:
    """The closed configuration that the guess ``start`` leads to, or the closest one found."""
    if not len(free):
        return start
    rng = np.random.default_rng(0)
    best, best_gap = start, float(np.linalg.norm(problem.mismatch(start)))
    for size in (0.0, *PERTURBATIONS):
        q = start
        if size:
            q = problem.move(start, free, rng.uniform(-size, size, len(free)))
        if np.linalg.norm(problem.mismatch(q)) > CLOSED:
            q = _search(problem, q, free)
        q, iterations = _polish(problem, q, free)
        if problem.closed(q):
            return _onto_singular_point(problem, q, free) if iterations > 10 else q
        gap = float(np.linalg.norm(problem.mismatch(q)))
        if gap < best_gap:
            best, best_gap = q, gap
    return best


def _describe(gaps: Mapping[str, tuple[float | None, float | None]]) -> str:
    parts = []
    for name, (gap, angle) in gaps.items():
        values = [] if gap is None else [f"{gap:.3g} m"]
        values += [] if angle is None else [f"{angle:.3g} rad"]
        parts.append(f"{name}: {', '.join(values)}")
    return "; ".join(parts)


def _free_coordinates(mechanism: Mechanism, held: Iterable[str]) -> IndexArray:
    """Velocity indices of the joints that are not held."""
    free = np.ones(mechanism.model.nv, dtype=bool)
    for name in held:
        joint = mechanism.joint(name)
        free[joint.idx_v : joint.idx_v + joint.nv] = False
    return np.flatnonzero(free)


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(repr(name) for name in names)


def _positions(
    mechanism: Mechanism, problem: _Problem, start: FloatArray, held: tuple[str, ...]
) -> FloatArray:
    q = _close(problem, start, _free_coordinates(mechanism, held))
    if problem.closed(q):
        return q
    gaps = problem.gaps(q)
    remaining = f"remaining gaps: {_describe(gaps)}"
    guilty = [
        name
        for name in held
        if problem.closed(
            _close(problem, start, _free_coordinates(mechanism, [h for h in held if h != name]))
        )
    ]
    if not guilty and len(held) > 1:
        everything_free = _close(problem, start, _free_coordinates(mechanism, ()))
        guilty = list(held) if problem.closed(everything_free) else []
    if guilty:
        raise AssemblyError(
            f"the loops cannot close with the held values of {_quoted(held)}; {remaining}",
            residuals=gaps,
            q=q,
            held=tuple(guilty),
            element="initial.q",
            remedy=f"Change or free one of {_quoted(guilty)}: with it free, the loops close"
            if len(guilty) < len(held) or len(held) == 1
            else "Free some of them: put them into guess instead of q",
        )
    raise AssemblyError(
        f"the loops cannot be closed from this guess; {remaining}",
        residuals=gaps,
        q=q,
        element="initial.guess",
        remedy="Check the anchors and link lengths, or give a guess closer to a closed "
        "configuration; the closest one found is in the error's q",
    )


def _rates(
    mechanism: Mechanism, problem: _Problem, q: FloatArray, v: FloatArray, held: tuple[str, ...]
) -> FloatArray:
    _, G = problem.closure(q)

    def solve(names: Iterable[str]) -> tuple[FloatArray, float]:
        free = _free_coordinates(mechanism, names)
        u = v / problem.unit
        for _ in range(2):  # the second pass removes the rounding of the first
            u[free] -= np.linalg.lstsq(G[:, free], G @ u, rcond=RANK)[0]
        return u * problem.unit, float(np.abs(G @ u).max())

    tolerance = RATE_TOLERANCE * max(1.0, float(np.abs(v / problem.unit).max()))
    solved, error = solve(held)
    if error <= tolerance:
        return solved
    guilty = [
        name for name in held if solve([h for h in held if h != name])[1] <= tolerance
    ] or list(held)
    raise AssemblyError(
        f"the held rates of {_quoted(held)} contradict the closures (G v = {error:.2e})",
        residuals=problem.gaps(q),
        q=q,
        held=tuple(guilty),
        element="initial.v",
        remedy=f"Change or free one of {_quoted(guilty)}",
    )


def assemble(
    mechanism: Mechanism,
    q: Mapping[str, Any] | Any = None,
    v: Mapping[str, Any] | Any = None,
    *,
    guess: Mapping[str, Any] | None = None,
    hold: Iterable[str] | None = None,
) -> Assembly:
    """Close the loops and make the rates consistent.

    Parameters
    ----------
    mechanism
        Its q0 is the guess for everything that is not given.
    q
        Joint name -> position (rad, m, or a list, see :mod:`srm_mbs.coordinates`), held exactly;
        or a configuration (nq,), of which only the joints in ``hold`` are held.
    v
        Joint name -> rate, held exactly; or a velocity (nv,), which is changed as little as
        possible.  Rates not given are the least-norm ones.
    guess
        Joint name -> position from which assembly starts; chooses the branch.
    hold
        Names of the joints whose position is held; by default those named in ``q``.

    Returns
    -------
    Assembly
        With |g| <= 1e-12 in rad and scene diagonals, |G v| <= 1e-12 in those per second.

    Raises
    ------
    AssemblyError
        If the loops cannot close (with each loop's gap and the closest configuration), or if held
        values or rates contradict each other (naming them).
    InputError
        For unknown joints or malformed values.
    """
    model = mechanism.model
    start = np.array(mechanism.q0)
    for name, value in (guess or {}).items():
        set_position(mechanism, start, name, value)
    held: tuple[str, ...] = ()
    if isinstance(q, Mapping):
        for name, value in q.items():
            set_position(mechanism, start, name, value)
        held = tuple(q)
    elif q is not None:
        start = np.array(q, dtype=float)
        if start.shape != (model.nq,) or not np.isfinite(start).all():
            raise InputError(f"q must be {model.nq} finite numbers", element="q")
        start = pin.normalize(model, start)
    if hold is not None:
        held = tuple(hold)
        for name in held:
            mechanism.joint(name)
    rates = np.zeros(model.nv)
    held_rates: tuple[str, ...] = ()
    if isinstance(v, Mapping):
        for name, value in v.items():
            set_rate(mechanism, rates, name, value)
        held_rates = tuple(v)
    elif v is not None:
        rates = np.array(v, dtype=float)
        if rates.shape != (model.nv,) or not np.isfinite(rates).all():
            raise InputError(f"v must be {model.nv} finite numbers", element="v")
    if not mechanism.loops:
        return Assembly(start, rates, np.zeros(0), np.zeros(0), np.eye(model.nv), False)
    problem = _Problem(mechanism, start)
    closed = _positions(mechanism, problem, start, held)
    consistent = _rates(mechanism, problem, closed, rates, held_rates)
    _, G = problem.closure(closed)
    residuals, rate_residuals = problem.rows.g.copy(), problem.rows.G @ consistent
    _, singular, right = np.linalg.svd(G)
    # sqrt of round-off: a singular closing is known no better where it could not be sharpened
    rank = int(np.sum(singular > 1e-7))
    return Assembly(
        closed,
        consistent,
        residuals,
        rate_residuals,
        right[rank:].T,
        model.nv - rank > mechanism.degrees_of_freedom,
    )
