r"""Local analysis of a singular configuration of the closures.

At a singular configuration some left null vectors u of G exist only there.  A motion through it
satisfies, besides G v = 0,

    u^T Gdot(v) v = 0                              tangents of the branches,
    3 u^T Gdot(v) v' = -u^T D^3 g[v, v, v]         acceleration along a branch,

where u^T Gdot(v) is the Hessian of u^T g at its critical point, so symmetric and well defined on
Lie groups too, and D^3 g[v, v, v] means d/dtau (Gdot v) along q (+) tau v with constant v.
Permanent redundancies (rows that depend on each other everywhere) have left null vectors as well;
their forms vanish on the velocities that keep the loops closed.

Quantities are in units (:mod:`srm_mbs.dynamics.constraints.geometry`) unless stated otherwise.
With drives, a configuration q (nq,) with rates (nv,) means (q, t), (nq + 1,), with rates (nv + 1,).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.row_algebra import singular_value
from srm_mbs.model.lazy import cached_property

SINGULAR = 1e-7
"""Singular value of the normalised G that counts as zero: the square root of round-off, because a
singular configuration is known no better where it could not be sharpened."""
VANISHING = 1e-7
"""Forms u^T Gdot below this vanish: a permanent redundancy, or a singularity of higher order."""
DETERMINED = 1e-8
"""Smallest singular value of the rows of G and u^T Gdot(v) together, for v of unit size, from which
they single out one branch."""
PARTICIPATES = 1e-6
"""Share in a left null vector from which a row takes part."""
SPARE = 8
"""Values of the forms more than there are forms."""
MIXED_MOTIONS = 8
"""Mixtures of weak motions whose loss of rank is followed where there are more of them."""
POLARISED = 16
"""Coordinates up to which Hessians follow from the bias by polarisation."""
BRANCH_ITERATIONS = 8
SEARCH_ITERATIONS = 20
SEARCH_DIFFERENCE = 1e-6
NEARER = 1e-3
"""Part by which a singular configuration of higher rank must be nearer to be another one."""
WEAK_FACTORS = (10.0, 3.0, 1.0)
"""Singular values up to these multiples of the smallest may vanish together."""
THIRD_ORDER = ((1, 45.0 / 60.0), (2, -9.0 / 60.0), (3, 1.0 / 60.0))
"""Central difference of order 6: with tau = 3e-3 both its errors are near round-off."""
TAU = 3e-3


def determined_solution(rows: FloatArray, right: FloatArray) -> FloatArray:
    """Shortest least-squares solution; singular values below DETERMINED are zero.

    The cut is absolute, because all rows may vanish and only rounding be left.
    """
    left, size, basis = np.linalg.svd(rows, full_matrices=False)
    used = size > DETERMINED
    return basis[used].T @ ((left[:, used].T @ right) / size[used])  # type: ignore[no-any-return]


def refine_singular_point(
    geometry: ClosureGeometry,
    q: FloatArray,
    rank: int,
    reach: float,
    closed: float,
    free: IndexArray | None = None,
    fixed: FloatArray | None = None,
) -> FloatArray | None:
    """Newton's iteration on g = 0 together with G of rank ``rank``, from q nearby.

    At a singular configuration g has a double root, which Gauss-Newton on g alone finds only to
    the square root of round-off.  G has rank ``rank`` where the Schur complement of its
    well-conditioned part vanishes.

    Parameters
    ----------
    reach
        Largest motion of a coordinate, in units.
    closed
        Largest closure error of the result, in row units.
    free
        Indices of the coordinates that may move; all by default.
    fixed : (k, l)
        Directions, in units of the free coordinates, along which the result does not move.

    Returns
    -------
    (nq,) or None
        The singular configuration, or None if there is none within reach.
    """
    free = np.arange(len(geometry.unit)) if free is None else free

    def schur(G: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
        turned = left.T @ (G / geometry.row_size[:, None])[:, free] @ right.T
        strong, up, down = turned[:rank, :rank], turned[:rank, rank:], turned[rank:, :rank]
        return turned[rank:, rank:] - down @ np.linalg.solve(strong, up)

    def equations(x: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
        g, G = geometry.closure(x)
        return np.concatenate([g, schur(G, left, right).ravel()])

    def differences(x: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
        columns = []
        for e in SEARCH_DIFFERENCE * np.eye(len(free)):
            ahead, behind = (equations(geometry.move(x, d, free), left, right) for d in (e, -e))
            columns.append((ahead - behind) / (2.0 * SEARCH_DIFFERENCE))
        return np.array(columns).T

    def loss_derivatives(x: FloatArray, left: FloatArray, motions: FloatArray) -> FloatArray:
        # The blocks beside the strong one vanish at x, so that the Schur complement changes as
        # u^T G w does; and second derivatives of u^T g commute, where moves do.
        weak, columns = left[:, rank:].T / geometry.row_size, []
        for w in SEARCH_DIFFERENCE * motions:
            ahead, behind = (geometry.closure(geometry.move(x, e, free))[1] for e in (w, -w))
            columns.append(weak @ (ahead - behind)[:, free] / (2.0 * SEARCH_DIFFERENCE))
        if not columns:
            return np.zeros((0, len(free)))
        return np.stack(columns, axis=1).reshape(-1, len(free))

    held = np.zeros((len(free), 0)) if fixed is None else fixed
    x, moved = q, np.zeros(len(free))
    for _ in range(SEARCH_ITERATIONS):
        g, G = geometry.closure(x)
        left, singular, right = np.linalg.svd((G / geometry.row_size[:, None])[:, free])
        if not singular[:rank].min(initial=np.inf) > 1e-12:
            return None
        loss = schur(G, left, right)
        if np.abs(g).max() <= closed and np.abs(loss).max(initial=0.0) < 1e-13:
            return x
        if geometry.commutes:
            # With very many weak motions some mixtures of them determine the step.
            mixed = np.eye(loss.shape[1])
            if len(mixed) > MIXED_MOTIONS:
                rng = np.random.default_rng(0)
                mixed = rng.standard_normal((MIXED_MOTIONS, len(mixed))) / np.sqrt(len(mixed))
            value = np.concatenate([g, (loss @ mixed.T).ravel()])
            jacobian = np.concatenate([G[:, free], loss_derivatives(x, left, mixed @ right[rank:])])
        else:
            value = np.concatenate([g, loss.ravel()])
            jacobian = differences(x, left, right)
        system = np.concatenate([jacobian, held.T])
        wanted = np.concatenate([value, held.T @ moved])
        step = np.linalg.lstsq(system, wanted, rcond=1e-9)[0]
        x, moved = geometry.move(x, -step, free), moved - step
        if not np.abs(geometry.difference(q, x)).max() < reach:
            return None
    return None


def nearest_singular(
    geometry: ClosureGeometry, q: FloatArray, structural_rank: int, reach: float
) -> FloatArray | None:
    """The exactly singular closed configuration nearest to q (nq,), found by Newton's iteration.

    Parameters
    ----------
    structural_rank
        Rank of the closures in regular configurations.
    reach
        How far a coordinate may move, in units.

    Returns
    -------
    (nq,) or None
        With |g| <= 1e-14 in row units; None if no singular configuration was found within reach.
    """
    values = np.linalg.svd(geometry.normalised(q), compute_uv=False)
    smallest = values[structural_rank - 1]
    ranks = {
        int(np.sum(values[:structural_rank] > max(factor * smallest, SINGULAR)))
        for factor in WEAK_FACTORS
    }
    best, distance = None, np.inf
    for rank in sorted(ranks):
        if rank == structural_rank:
            rank -= 1
        found = refine_singular_point(geometry, q, rank, reach, closed=1e-14)
        if found is not None:
            away = float(np.linalg.norm(geometry.difference(q, found)))
            # A search for a higher rank ends next to the same configuration, less accurately.
            if away < (1.0 - NEARER) * distance:
                best, distance = found, away
    return best


def smallest_singular_value(
    geometry: ClosureGeometry, q: FloatArray, structural_rank: int
) -> float:
    """The last structural singular value of the normalised, separated G at q."""
    return singular_value(geometry.separated(q), structural_rank)


@dataclass(frozen=True)
class Participants:
    """The rows, loops and drives that lose rank at a singular configuration.

    Attributes
    ----------
    rows, loops, drives
        Names of the closure rows that take part, ``loop.row``, of their loops, and of the drives.
    """

    rows: tuple[str, ...] = ()
    loops: tuple[str, ...] = ()
    drives: tuple[str, ...] = ()

    @property
    def names(self) -> str:
        """Loops and drives in one list."""
        return ", ".join((*self.loops, *self.drives))

    def __str__(self) -> str:
        kinds = (("loops", self.loops), ("drives", self.drives))
        named = "; ".join(f"{kind} {', '.join(map(repr, own))}" for kind, own in kinds if own)
        return f"the closures and drives ({named})" if self.drives else f"the closures ({named})"


def participants(geometry: ClosureGeometry, left: FloatArray) -> Participants:
    """The participants in the left null vectors ``left`` (rows, k) of the normalised G."""
    takes_part = (np.linalg.norm(left, axis=1) > PARTICIPATES).tolist()
    loops = geometry.mechanism.loops
    rows = [(name, loop.name) for loop in loops for name in loop.row_names]
    own = [row for row, involved in zip(rows, takes_part) if involved]
    drives = zip(geometry.drives, takes_part[len(rows) :])
    return Participants(
        tuple(name for name, _ in own),
        tuple(dict.fromkeys(loop for _, loop in own)),
        tuple(name for name, involved in drives if involved),
    )


@dataclass(frozen=True, eq=False)
class SingularConfiguration:
    """A configuration where the closures have lost rank.

    Attributes
    ----------
    geometry
        The closures.
    q : (nq,)
        The configuration, with drives its place (:meth:`ClosureGeometry.at`).
    structural_rank, rank
        Rank of the closures in regular configurations, and here.
    left : (rows, n)
        Orthonormal left null vectors of the normalised G, permanent redundancies included.
    null : (nv, p)
        Orthonormal basis of the velocities (in units) that keep the loops closed.
    """

    geometry: ClosureGeometry
    q: FloatArray
    structural_rank: int
    rank: int
    left: FloatArray
    null: FloatArray

    @cached_property
    def forms(self) -> FloatArray:
        """u_j^T Gdot (n, p, p), symmetric, on the basis ``null``."""
        geometry, q, left, null = self.geometry, self.q, self.left, self.null
        p = null.shape[1]
        if len(null) > POLARISED:
            columns = [self.hessians(direction) @ null for direction in null.T]
            both = np.stack(columns, axis=2) if columns else np.zeros((left.shape[1], 0, 0))
            return 0.5 * (both + both.transpose(0, 2, 1))
        forms = np.zeros((left.shape[1], p, p))
        for a in range(p):
            forms[:, a, a] = left.T @ geometry.bias(q, null[:, a])
            for b in range(a):
                plus = geometry.bias(q, null[:, a] + null[:, b])
                minus = geometry.bias(q, null[:, a] - null[:, b])
                forms[:, a, b] = forms[:, b, a] = 0.25 * (left.T @ (plus - minus))
        return forms

    @property
    def nullity(self) -> int:
        """How many independent rows are lost here."""
        return self.structural_rank - self.rank

    @cached_property
    def true_left(self) -> FloatArray:
        """Left null vectors (rows, k) whose forms do not vanish: the singularity proper."""
        if self.left.shape[1] == self.nullity:  # no permanent redundancies
            return self.left
        # As many values of the forms as there are forms determine which combinations vanish; the
        # forms themselves have an entry for every pair of velocities.
        if len(self.null) > POLARISED:
            # Of a generic velocity, u_j^T Gdot(v) itself vanishes only with the form.
            mixed = np.random.default_rng(0).standard_normal(self.null.shape[1])
            forms = self.hessians(self.null @ mixed / np.sqrt(self.null.shape[1]))
            turned, size, _ = np.linalg.svd(forms @ self.null, full_matrices=False)
            return self.left @ turned[:, size > VANISHING]  # type: ignore[no-any-return]
        count = self.left.shape[1] + SPARE
        motions = self.null @ np.random.default_rng(0).standard_normal((self.null.shape[1], count))
        values = np.array([self.curvature(motion) for motion in motions.T]).T
        turned, size, _ = np.linalg.svd(values / np.sqrt(count), full_matrices=False)
        return self.left @ turned[:, size > VANISHING]  # type: ignore[no-any-return]

    @cached_property
    def participants(self) -> Participants:
        """The rows that take part."""
        # At a singularity of higher order every left null vector is all there is to show.
        vectors = self.true_left if self.true_left.shape[1] else self.left
        return participants(self.geometry, vectors)

    def curvature(self, u: FloatArray) -> FloatArray:
        """u_j^T Gdot(v) v (n,) for the rates u (nv,); zero for the tangent of a branch."""
        return self.left.T @ self.geometry.bias(self.q, u)

    def hessians(self, u: FloatArray) -> FloatArray:
        """u_j^T Gdot(v) (n, nv) for the rates u (nv,).

        By polarisation of the bias, which is quadratic in the rates: exact, no differences.  With
        many coordinates by differences of u_j^T G along the rates, which costs as many evaluations
        for any number: second derivatives of u_j^T g commute where u_j^T G vanishes.
        """
        bias, q = self.geometry.bias, self.q
        if len(u) > POLARISED:
            return self._difference_hessians(u)
        columns = [0.25 * (bias(q, u + e) - bias(q, u - e)) for e in np.eye(len(u))]
        return self.left.T @ np.array(columns).T

    def _difference_hessians(self, u: FloatArray) -> FloatArray:
        size = float(np.abs(u).max())
        total = np.zeros((self.left.shape[1], len(u)))
        if size == 0.0:
            return total
        geometry, left = self.geometry, self.left.T / self.geometry.row_size
        for k, weight in THIRD_ORDER:
            step = k * TAU / size * u
            ahead, behind = (geometry.closure(geometry.move(self.q, e))[1] for e in (step, -step))
            total += weight / TAU * (left @ (ahead - behind))
        return total * size

    def third_derivative(self, u: FloatArray) -> FloatArray:
        """u_j^T D^3 g[v, v, v] (n,) for the rates u (nv,)."""
        size = float(np.abs(u).max())
        if size == 0.0:
            return np.zeros(self.left.shape[1])
        direction = u / size
        total = np.zeros(len(self.geometry.row_unit))
        for k, weight in THIRD_ORDER:
            step = k * TAU * direction
            ahead = self.geometry.bias(self.geometry.move(self.q, step), direction)
            behind = self.geometry.bias(self.geometry.move(self.q, -step), direction)
            total += weight / TAU * (ahead - behind)
        return self.left.T @ total * size**3

    def onto_branch(self, u: FloatArray) -> FloatArray:
        """The rates (nv,) of a branch close to u (nv,), by Newton's iteration from there."""
        G = self.geometry.normalised(self.q)
        scale = float(np.abs(u).max())
        for _ in range(BRANCH_ITERATIONS):
            rows = np.concatenate([G, 2.0 / scale * self.hessians(u)])
            gap = np.concatenate([G @ u, self.curvature(u) / scale])
            step = determined_solution(rows, gap)
            u = u - step
            if np.abs(step).max() <= 1e-15 * scale:
                break
        return u

    def branch(self, u: FloatArray) -> FloatArray | None:
        """Tangent space (nv, d) of the branch that u (nv,) is a velocity of, orthonormal; None if
        u does not single out one branch (at rest, or moving among singular configurations)."""
        size = float(np.abs(u).max())
        if size == 0.0:
            return None
        G = self.geometry.normalised(self.q)
        rows = np.concatenate([G, self.hessians(self.onto_branch(u / size))])
        _, singular, right = np.linalg.svd(rows)
        rank = int(np.sum(singular > DETERMINED))
        if rank != self.structural_rank:
            return None
        return right[rank:].T

    def limit_acceleration(self, v: FloatArray, free: FloatArray) -> FloatArray | None:
        """Acceleration v' (nv,) of the motion through here with the velocity v (nv,).

        Both in the model's coordinates (rad/s, m/s, per second).  Of all accelerations that fit
        the closures to third order, the one nearest to ``free`` (nv,) = M^-1 f in the mass metric
        (Gauss).  None if v does not single out one branch.
        """
        geometry, unit = self.geometry, self.geometry.coordinate_unit
        u = geometry.rates(v)
        size = float(np.abs(u).max())
        if self.branch(u) is None:
            return None
        direction = u / size
        G = geometry.normalised(self.q)
        U = np.linalg.cholesky(geometry.mass()).T
        rows = np.concatenate([G, 3.0 * self.hessians(direction)])
        right = np.concatenate(
            [-geometry.bias(self.q, direction), -self.third_derivative(direction)]
        )
        rows = rows[:, : len(unit)]  # time passes evenly
        gap = right * size**2 - rows @ (free / unit)
        white = np.linalg.solve(U.T, rows.T).T
        fit = determined_solution(white / np.linalg.norm(white, 2), gap / np.linalg.norm(white, 2))
        return free + unit * np.linalg.solve(U, fit)


def analyse_singular(
    geometry: ClosureGeometry, q: FloatArray, structural_rank: int
) -> SingularConfiguration:
    """Null vectors at q (nq,), an exactly singular configuration; more is computed on request."""
    left, singular, right = np.linalg.svd(geometry.normalised(q))
    rank = int(np.sum(singular > SINGULAR))
    return SingularConfiguration(geometry, q, structural_rank, rank, left[:, rank:], right[rank:].T)
