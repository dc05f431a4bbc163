r"""Critical configurations: where the closures are singular, or would be but for a residual.

A combination u of the closure rows is critical at q* if it is stationary there and all other
combinations are closed,

    G(q*)^T u = 0,   g(q*) - (u . g(q*)) u = 0,   |u| = 1.

Its residual delta = u . g(q*) decides.  It is 0 at a singular configuration, where two branches of
closed configurations cross; bars that differ by d leave a residual of about d.  The closed
configurations then are the two hyperbolas w^T H w / 2 = -delta of which the crossing branches are
the asymptotes: the motion avoids the singular configuration and leaves along the other asymptote.
H is the Hessian of u . g, w a displacement that keeps the other combinations closed.

Quantities are in units (:mod:`srm_mbs.dynamics.constraints.geometry`).  With drives, a
configuration is a place (q, t).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry, column_groups
from srm_mbs.model.lazy import cached_property

Jacobians = Callable[[FloatArray], FloatArray]
"""G (k, rows, n) in units at k places."""
ITERATIONS = 12
DIFFERENCE = 1e-5
"""Step (units) of the central differences of G^T u."""
CONVERGED = 1e-14
"""Size of the equations of a critical configuration at which the search ends."""
DECIDED = 1e-8
"""Distance at which the residual, which is stationary, is known to rounding."""
ACCEPTED = 1e-11
"""Size of them from which the search has failed."""
FROZEN = 1e-2
"""Newton step (units) from which on the Hessian is not evaluated again."""
CONVERGING = 0.5
"""Ratio of the sizes of the equations in two iterations from which it is, too: next to a turn of a
drive the curvature by time is far from that where the search began."""
APPROACH = 0.5
"""Distance from a known critical configuration after Newton's first step, over that before it,
below which the search leads there."""
RIDGE = 1e-5
"""Added to the Hessian, and taken from its counterpart for u: configurations that are critical
together, such as those of a free base, and combinations that are, such as those of loops that are
singular at once, stay where they are."""
TIME_RIDGE = 1e-8
"""The same for time, of which the curvature is small where a drive turns back next to a singular
configuration: it is in proportion to the part that the drive has in u."""
LARGEST_DEVIATION = 0.5
"""Distance of a configuration from its hyperbola, over that from the critical configuration, from
which it is not beside that one."""
STRAIGHT = 1e-3
"""Largest deviation of the slope of rates from that of a branch, over it, at a critical
configuration, besides the size of its layer."""
DEFINITE = 1e-3
"""Ratio of the two curvatures of a saddle below which branches are almost tangent."""


class CriticalPlace(NamedTuple):
    """Where the closures are critical, and how nearly they are singular there.

    Attributes
    ----------
    q : (nq,)
        The configuration, as the geometry takes it.
    residual
        As of :class:`CriticalConfiguration`; its sign is that of u, which is arbitrary.
    """

    q: FloatArray
    residual: float


@dataclass(frozen=True, eq=False)
class CriticalConfiguration:
    """A critical configuration of the closures.

    Attributes
    ----------
    geometry
        The closures, and drives if there are any.
    q : (nq,)
        The configuration, as the geometry takes it.
    rows : (rank, rows)
        Independent combinations of the normalised rows.
    u : (rank,)
        The critical combination of them, of unit length.
    delta
        u . g, of the normalised rows.
    searched : (n, n)
        H next to q, to the accuracy that the search needed.
    """

    geometry: ClosureGeometry
    q: FloatArray
    rows: FloatArray
    u: FloatArray
    delta: float
    searched: FloatArray

    @cached_property
    def hessian(self) -> FloatArray:
        """H (n, n): second derivative of u . g by the coordinates."""
        return _hessian(self.geometry, self.weights, self.q, self.geometry.jacobians)

    @cached_property
    def weights(self) -> FloatArray:
        """u over the rows of the closures in row units (rows,)."""
        out: FloatArray = (self.u @ self.rows) / self.geometry.row_size
        return out

    @property
    def residual(self) -> float:
        """delta, in row units: relative to the size of the mechanism."""
        return self.delta / float(np.linalg.norm(self.weights))

    def in_turns_of(self, q: FloatArray) -> CriticalConfiguration | None:
        """The same with the whole turns of q (nq,); None if the closures count turns."""
        turned = self.geometry.in_turns_of(q, self.q)
        g, G = equations(self.geometry, self.rows, turned)
        holds = float(np.abs(_equations(g, G, self.u, float(self.u @ g))).max()) < DECIDED
        return replace(self, q=turned) if holds else None


def equations(
    geometry: ClosureGeometry, rows: FloatArray, q: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The independent combinations ``rows`` of g (rank,) and of G (rank, n), normalised, at q."""
    g, G = geometry.closure(q)
    return rows @ (g / geometry.row_size), rows @ (G / geometry.row_size[:, None])


def complement(u: FloatArray) -> FloatArray:
    """An orthonormal basis (k - 1, k) of the vectors orthogonal to u (k,), of unit length."""
    full = np.linalg.qr(u[:, None], mode="complete")[0]
    return full[:, 1:].T


def _hessian(
    geometry: ClosureGeometry,
    weights: FloatArray,
    q: FloatArray,
    jacobians: Jacobians,
    at_q: FloatArray | None = None,
) -> FloatArray:
    """The second derivative (n, n) of ``weights`` . g by central differences, or by forward ones
    from the first derivative ``at_q`` (n,).

    Coordinates that no rows have in common change together."""
    groups, related = column_groups(geometry.mechanism)
    n = len(geometry.unit)
    moves = np.zeros((len(groups), n))
    for move, group in zip(moves, groups):
        move[group] = DIFFERENCE

    def gradients(sign: float) -> FloatArray:
        places = np.array([geometry.move(q, sign * move) for move in moves])
        out: FloatArray = weights @ jacobians(places)
        return out

    if at_q is None:
        changes = (gradients(1.0) - gradients(-1.0)) / (2.0 * DIFFERENCE)
    else:
        changes = (gradients(1.0) - at_q) / DIFFERENCE
    out = np.zeros((n, n))
    for change, group in zip(changes, groups):
        out[:, group] = np.where(related[:, group], change[:, None], 0.0)
    return out


def _equations(g: FloatArray, G: FloatArray, u: FloatArray, delta: float) -> FloatArray:
    """(G^T u, g - delta u), which vanishes at a critical configuration."""
    return np.concatenate([G.T @ u, g - delta * u])


def _ridge(geometry: ClosureGeometry) -> FloatArray:
    """The matrix (n, n) that is added to the Hessian."""
    ridge = np.full(len(geometry.unit), RIDGE)
    ridge[geometry.model.nv :] = TIME_RIDGE
    return np.diag(ridge)


def _newton_step(
    g: FloatArray, G: FloatArray, u: FloatArray, delta: float, H: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The step of (q, u) that keeps the length of u; H with its ridge."""
    rank, n = G.shape
    size = n + rank
    matrix, value = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    matrix[:n, :n], matrix[:n, n:-1] = H, G.T
    matrix[n:-1, :n] = G
    matrix[n:-1, -1], matrix[-1, n:-1] = -u, u
    matrix[n:-1, n:-1] -= (delta + RIDGE) * np.eye(rank)
    value[:-1] = _equations(g, G, u, delta)
    step = np.linalg.solve(matrix, -value)
    return step[:n], step[n:-1]


def critical_configuration(
    geometry: ClosureGeometry,
    structural_rank: int,
    q: FloatArray,
    reach: float,
    known: Iterable[CriticalConfiguration] = (),
    singular_to: float = 0.0,
    jacobians: Jacobians | None = None,
) -> CriticalConfiguration | None:
    """The critical configuration near q, found by Newton's iteration for (q, u).

    It starts from the last left singular vector of the normalised G at q.

    Parameters
    ----------
    structural_rank
        Rank of the closures in regular configurations.
    q : (nq,)
        A configuration, as the geometry takes it; it need not be closed.
    reach
        Largest motion of a coordinate, in units.
    known
        Isolated critical configurations of this mechanism, without drives, found before.  The
        search ends where its first step leads to one of them, or to one but for whole turns.
    singular_to
        Residual (row units) up to which the configuration is singular: it is then known well
        enough where its residual is.
    jacobians
        Another function than that of ``geometry`` for G (k, rows, n) at k places.

    Returns
    -------
    CriticalConfiguration or None
        None if there is none within reach.
    """
    jacobians = jacobians or geometry.jacobians
    g, G = geometry.closure(q)
    size = geometry.row_size
    rows = np.linalg.svd(G / size[:, None])[0][:, :structural_rank].T
    g, G = rows @ (g / size), rows @ (G / size[:, None])
    u = np.zeros(structural_rank)
    u[-1] = 1.0
    delta, ridge = float(u @ g), _ridge(geometry)
    weights = (u @ rows) / size
    for one in known:
        away = geometry.difference(q, geometry.in_turns_of(q, one.q))
        if not np.abs(away).max() < reach:
            continue
        H = one.searched * np.sign(weights @ one.weights)
        first, _ = _newton_step(g, G, u, delta, H + ridge)
        if np.linalg.norm(first - away) < APPROACH * np.linalg.norm(away):
            turned = one.in_turns_of(q)
            if turned is not None:
                return turned
    x, moved, best, last = q, np.inf, np.inf, np.inf
    found: CriticalConfiguration | None = None
    for i in range(ITERATIONS):
        error = float(np.abs(_equations(g, G, u, delta)).max())
        if not error < best and error < ACCEPTED:
            break
        # The curvature by time follows from the part of a drive in u, which has none at first.
        early = bool(geometry.drives) and i < 2
        if early or moved > FROZEN or not error < CONVERGING * last:
            H = _hessian(geometry, (u @ rows) / size, x, jacobians, G.T @ u)
        last = error
        if error < best:
            best, found = error, CriticalConfiguration(geometry, x, rows, u, delta, H)
            decided = error <= DECIDED and abs(found.residual) <= singular_to
            if decided or error <= CONVERGED:
                return found
        step, turn = _newton_step(g, G, u, delta, H + ridge)
        moved = float(np.abs(step).max())
        if not moved < reach:
            return None
        x, u = geometry.move(x, step), u + turn
        u = u / np.linalg.norm(u)
        if not np.abs(geometry.difference(q, x)).max() < reach:
            return None
        g, G = equations(geometry, rows, x)
        delta = float(u @ g)
    return found if best < ACCEPTED else None


def first_step_length(
    geometry: ClosureGeometry, structural_rank: int, q: FloatArray, jacobians: Jacobians
) -> float:
    """Largest motion of a coordinate (units) in the first step of :func:`critical_configuration`
    from a closed configuration q (nq,).

    It takes few derivatives.  With u the last left singular vector of the normalised G and
    G^T u = sigma v, a step that keeps the other combinations closed and the length of u lies in the
    span of v and the null space of G, and H dq = -sigma v there.

    Parameters
    ----------
    structural_rank, jacobians
        As for :func:`critical_configuration`.
    """
    size = geometry.row_size
    G = jacobians(q[None])[0]
    left, values, right = np.linalg.svd(G / size[:, None])
    weights = left[:, structural_rank - 1] / size
    span = right[structural_rank - 1 :]
    places = np.array([geometry.move(q, DIFFERENCE * along) for along in span])
    changes = (weights @ jacobians(places) - weights @ G) / DIFFERENCE
    matrix, value = span @ (changes.T + _ridge(geometry) @ span.T), np.zeros(len(span))
    value[0] = -values[structural_rank - 1]
    return float(np.abs(np.linalg.solve(matrix, value) @ span).max())


class CurveThroughSaddle:
    """The closed configurations next to a critical one of a mechanism with one degree of freedom.

    They are curves in the plane of the displacements that keep the other combinations closed:
    beside a residual each is a hyperbola with a coordinate that grows along it, beta, and one that
    keeps its sign.

    Parameters
    ----------
    critical
        The critical configuration.
    q
        A configuration on the curve, as the geometry takes it.
    exact
        Whether the residual counts as zero: the curve then leads straight through q*.
    rates : (n,)
        Of a motion from q anywhere in the layer of a residual that counts as zero, in units: the
        curve is the branch along which they lead.

    Attributes
    ----------
    beta
        That of q.
    width
        |beta| at which the curve leaves its asymptotes; 0 if it leads straight through q*.
    layer
        As ``width``, also if the residual counts as zero.
    along : (n,)
        Direction of beta.

    Raises
    ------
    ValueError
        If the critical configuration is no saddle, or q is not on a curve beside it.
    """

    def __init__(
        self,
        critical: CriticalConfiguration,
        q: FloatArray,
        exact: bool,
        rates: FloatArray | None = None,
    ) -> None:
        geometry = self._geometry = critical.geometry
        self._critical = critical
        rank, n = critical.rows.shape[0], len(geometry.unit)
        if n - rank != 1:
            raise ValueError("the closed configurations are no curves")
        self._strong = complement(critical.u)
        _, G = equations(geometry, critical.rows, critical.q)
        plane = np.linalg.svd(self._strong @ G)[2][-2:].T
        form = plane.T @ critical.hessian @ plane
        (low, high), axes = np.linalg.eigh(0.5 * (form + form.T))
        if not (low < 0.0 < high and min(-low, high) > DEFINITE * max(-low, high)):
            raise ValueError("the critical configuration is no saddle")
        delta = critical.delta
        # delta > 0: the coordinate of the negative curvature keeps its sign.
        kept, along = (axes[:, 0], axes[:, 1]) if delta > 0.0 else (axes[:, 1], axes[:, 0])
        self._kept, self.along = plane @ kept, plane @ along
        of_kept, of_along = (-low, high) if delta > 0.0 else (high, -low)
        self._exact = exact
        self._delta = delta
        self._level = 0.0 if exact else 2.0 * abs(delta) / of_kept
        self._ratio = of_along / of_kept
        self.width = float(np.sqrt(self._level / self._ratio))
        self.layer = float(np.sqrt(2.0 * abs(delta) / of_along))
        away = geometry.difference(critical.q, q)
        self.beta = float(self.along @ away)
        beside = float(self._kept @ away)
        self._sign = float(np.sign(beside if not exact else beside * self.beta))
        distance, nearest = float(np.linalg.norm(away)), 0.0
        if rates is not None:
            # Along each hyperbola d kept / d beta has the sign of kept / beta, and at q* it is the
            # slope of a branch: the rates tell the branch, also where the place does not.
            ahead, aside = float(self.along @ rates), float(self._kept @ rates)
            if ahead == 0.0:
                raise ValueError("the rates lead nowhere")
            slope = aside / ahead
            self._sign = float(np.sign(slope))
            nearest = self.layer * float(np.sqrt(self._ratio))  # of the hyperbola
            straight = abs(abs(slope) / np.sqrt(self._ratio) - 1.0) < STRAIGHT + nearest
            if distance < LARGEST_DEVIATION * nearest and not straight:
                raise ValueError("the rates do not lead along a branch")
        off = float(np.linalg.norm(away - self.hyperbola(self.beta)[0]))
        if not off < LARGEST_DEVIATION * distance + nearest:
            raise ValueError("the configuration is not on a curve beside the critical one")

    def hyperbola(self, beta: float) -> tuple[FloatArray, FloatArray]:
        """The point of the hyperbola at ``beta``, as a displacement (n,) from q*, and its
        derivative."""
        kept = np.sqrt(self._level + self._ratio * beta * beta)
        slope = self._ratio * beta / kept if kept else np.sqrt(self._ratio)
        if self._exact and beta:
            kept, slope = kept * np.sign(beta), slope * np.sign(beta)
        kept, slope = self._sign * kept, self._sign * slope
        return beta * self.along + kept * self._kept, self.along + slope * self._kept

    def turn_of(self, i: int) -> tuple[float, float] | None:
        """beta at which the coordinate ``i`` turns back along the hyperbola, and the sign of its
        second derivative there; None if it does not."""
        along = float(self.along[i])
        kept = self._sign * float(np.sqrt(self._ratio) * self._kept[i])
        if not abs(along) < abs(kept):
            return None
        return self.width * float(np.sinh(np.arctanh(-along / kept))), float(np.sign(kept))

    def linearised(
        self, x: FloatArray, beta: float, closed: bool = False
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Newton's equations for the configuration at ``beta``, at x (nq,) next to it.

        Returns
        -------
        step : (n,)
            The step from x, in units.
        tangent : (n,)
            Direction of the curve, of which the part ``along`` is 1.
        matrix : (n, n)
            Of the equations: the rows of the closures, the critical combination after the others,
            and ``along``.

        ``closed``: with the residual closed, also if it counts as zero.
        """
        critical, geometry = self._critical, self._geometry
        target = self._delta if self._exact and not closed else 0.0
        g, G = equations(geometry, critical.rows, x)
        off = float(self.along @ geometry.difference(critical.q, x)) - beta
        value = np.concatenate([self._strong @ g, [critical.u @ g - target, off]])
        matrix = np.vstack([self._strong @ G, critical.u @ G, self.along])
        sides = np.column_stack([-value, np.append(np.zeros(len(value) - 1), 1.0)])
        step, tangent = np.linalg.solve(matrix, sides).T
        return step, tangent, matrix

    def bend(self, x: FloatArray, rates: FloatArray, matrix: FloatArray) -> FloatArray:
        """A second derivative (n,) of the motion by time, in units, that keeps the closures closed
        at the ``rates`` (n,), in units; ``matrix`` as in :meth:`linearised`."""
        bias = self._critical.rows @ self._geometry.bias(x, rates)
        turning = np.concatenate([self._strong @ bias, [self._critical.u @ bias, 0.0]])
        out: FloatArray = -np.linalg.solve(matrix, turning)
        return out
