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

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry

ITERATIONS = 12
DIFFERENCE = 1e-5
"""Step (units) of the central differences of G^T u."""
CONVERGED = 1e-14
"""Size of the equations of a critical configuration at which the search ends."""
DECIDED = 1e-8
"""Distance at which the residual, which is stationary, is known to rounding."""
ACCEPTED = 1e-11
"""Size of them from which the search has failed."""
FROZEN = 1e-3
"""Newton step (units) from which on the Hessian is not evaluated again."""
RIDGE = 1e-5
"""Added to the Hessian, and taken from its counterpart for u: configurations that are critical
together, such as those of a free base, and combinations that are, such as those of loops that are
singular at once, stay where they are."""
LARGEST_DEVIATION = 0.5
"""Distance of a configuration from its hyperbola, over that from the critical configuration, from
which it is not beside that one."""
DEFINITE = 1e-3
"""Ratio of the two curvatures of a saddle below which branches are almost tangent."""


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
    """

    geometry: ClosureGeometry
    q: FloatArray
    rows: FloatArray
    u: FloatArray

    @cached_property
    def hessian(self) -> FloatArray:
        """H (n, n): second derivative of u . g by the coordinates."""
        return _hessian(self.geometry, self.rows, self.u, self.q)

    @cached_property
    def combination(self) -> FloatArray:
        """u over the rows of the closures in row units (rows,), of unit length."""
        weights = (self.u @ self.rows) / self.geometry.row_size
        out: FloatArray = weights / np.linalg.norm(weights)
        return out

    @cached_property
    def residual(self) -> float:
        """delta, in row units: relative to the size of the mechanism."""
        return float(self.combination @ self.geometry.closure(self.q)[0])


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
    geometry: ClosureGeometry, rows: FloatArray, u: FloatArray, q: FloatArray
) -> FloatArray:
    combination = (u @ rows) / geometry.row_size

    def gradient(e: FloatArray) -> FloatArray:
        out: FloatArray = combination @ geometry.closure(geometry.move(q, e))[1]
        return out

    steps = DIFFERENCE * np.eye(len(geometry.unit))
    columns = [(gradient(e) - gradient(-e)) / (2.0 * DIFFERENCE) for e in steps]
    return np.array(columns).T


def critical_configuration(
    geometry: ClosureGeometry, structural_rank: int, q: FloatArray, reach: float
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

    Returns
    -------
    CriticalConfiguration or None
        None if there is none within reach.
    """
    left = np.linalg.svd(geometry.normalised(q))[0]
    rows = left[:, :structural_rank].T
    u = np.zeros(structural_rank)
    u[-1] = 1.0
    n, x, diagonal = len(geometry.unit), q, np.eye(structural_rank)
    g, G = equations(geometry, rows, x)
    delta = float(u @ g)
    moved, best, found = np.inf, np.inf, (x, u)
    for _ in range(ITERATIONS):
        value = np.concatenate([G.T @ u, g - delta * u, [0.0]])
        size = float(np.abs(value).max())
        if not size < best and size < ACCEPTED:
            break
        if size < best:
            best, found = size, (x, u)
        if size <= CONVERGED:
            break
        if moved > FROZEN:
            H = _hessian(geometry, rows, u, x) + RIDGE * np.eye(n)
        matrix = np.zeros((len(value), len(value)))
        matrix[:n, :n], matrix[:n, n:-1] = H, G.T
        matrix[n:-1, :n], matrix[n:-1, n:-1] = G, diagonal * -(delta + RIDGE)
        matrix[n:-1, -1], matrix[-1, n:-1] = -u, u
        step = np.linalg.solve(matrix, -value)
        moved = float(np.abs(step[:n]).max())
        if not moved < reach:
            return None
        x, u = geometry.move(x, step[:n]), u + step[n:-1]
        u = u / np.linalg.norm(u)
        if not np.abs(geometry.difference(q, x)).max() < reach:
            return None
        g, G = equations(geometry, rows, x)
        delta = float(u @ g)
    if not best < ACCEPTED:
        return None
    x, u = found
    return CriticalConfiguration(geometry, x, rows, u)


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

    def __init__(self, critical: CriticalConfiguration, q: FloatArray, exact: bool) -> None:
        geometry = self._geometry = critical.geometry
        self._critical = critical
        rank, n = critical.rows.shape[0], len(geometry.unit)
        if n - rank != 1:
            raise ValueError("the closed configurations are no curves")
        self._strong = complement(critical.u)
        g, G = equations(geometry, critical.rows, critical.q)
        plane = np.linalg.svd(self._strong @ G)[2][-2:].T
        form = plane.T @ critical.hessian @ plane
        (low, high), axes = np.linalg.eigh(0.5 * (form + form.T))
        if not (low < 0.0 < high and min(-low, high) > DEFINITE * max(-low, high)):
            raise ValueError("the critical configuration is no saddle")
        delta = float(critical.u @ g)
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
        off = float(np.linalg.norm(away - self.hyperbola(self.beta)[0]))
        if not off < LARGEST_DEVIATION * float(np.linalg.norm(away)):
            raise ValueError("the configuration is not on a curve beside the critical one")

    def hyperbola(self, beta: float) -> tuple[FloatArray, FloatArray]:
        """The point of the hyperbola at ``beta``, as a displacement (n,) from q*, and its
        derivative."""
        kept = np.sqrt(self._level + self._ratio * beta * beta)
        slope = self._ratio * beta / kept
        if self._exact:
            kept, slope = kept * np.sign(beta), slope * np.sign(beta)
        kept, slope = self._sign * kept, self._sign * slope
        return beta * self.along + kept * self._kept, self.along + slope * self._kept

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
