r"""The constraint algebra on a branch, at and next to a singular configuration.

On a branch the projector P and the vector z = E Gdot v, which make up the multiplier
yhat = P M^-1 f + z, are smooth functions of the configuration, also where the closures are
singular.  There, however, the direct solve errs by round-off over sigma^2.  So P and z are computed

* at the singular configuration from the limit formula
(:mod:`srm_mbs.dynamics.singularities.local_analysis`),
* at regular configurations on both sides of it from the direct solve,

all on one curve in the branch, and interpolated to the requested configuration.  The curve,
q (+) tau w (+) a normal part, is kinematic: no forces act, and w is any direction that leads away
from the singular configurations.  With drives it is a curve of (q, t), with P and z of those times;
the residual of the rates, P v - E s', is an affine function of v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.projection import cholesky, unwhiten, whiten
from srm_mbs.dynamics.singularities.local_analysis import (
    VANISHING,
    SingularConfiguration,
    analyse_singular,
    determined_solution,
    nearest_singular,
    refine_singular_point,
)


def lagrange_weights(nodes: FloatArray, t: float) -> FloatArray:
    """Weights (k,) of the polynomial through ``nodes`` (k,), distinct times, at ``t``."""
    k = len(nodes)
    weights = np.ones(k)
    for i in range(k):
        for j in range(k):
            if i != j:
                weights[i] *= (t - nodes[j]) / (nodes[i] - nodes[j])
    return weights


NODES = np.array([-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0])
CENTRE = 4
"""Nodes of the curve, in spacings from its centre, and the index of the centre among them."""
SPACINGS = (0.03, 0.015, 0.0075, 0.06)
"""Distances of the nodes, in units; the first that is accurate enough is used, else the best."""
ACCURATE = 1e-11
"""Estimated error of P at which no other spacing is tried."""
CURVE_MARGIN = 2
"""Nodes at each end of a curve beyond which it is not used."""
CURVE_ACCURACY = 1e-10
"""Largest estimated error of P of a curve that is used for other configurations."""
CLOSING_ITERATIONS = 15
CONSTRAINT_TOLERANCE = 1e-12
"""Largest closure error of a node, in row units."""
STEP_ROUNDING = 1e-14
"""Step of Newton's iteration (units) at which it ends."""
BRANCH_RESOLUTION = 5e-8
"""Distance (units) from a singular configuration above which a configuration determines its branch:
there round-off over the distance is a twentieth of it."""
NEAR = 1e-2
"""Largest distance (units) of the requested configuration from the singular one."""


def _at_zero(times: FloatArray, values: FloatArray) -> FloatArray:
    """The polynomial through ``values`` (k, ...) at ``times`` (k,), at zero."""
    return np.tensordot(lagrange_weights(times, 0.0), values, axes=1)


@dataclass(frozen=True, eq=False)
class BranchCurve:
    """The constraint algebra along a branch of one degree of freedom, by interpolation.

    The curve of a :class:`BranchLimit` then contains every configuration of the branch close to it.
    P and -E s' are interpolated to the parameter of a configuration; z, which is quadratic in the
    velocity of the branch, is known at the nodes for one velocity each.

    Attributes
    ----------
    geometry
        The closures, and the drives if there are any.
    place
        The configuration at which the parameter is zero, as the geometry takes it.
    along : (n,)
        The parameter of a motion in units.
    nodes : (k,)
        Parameters of the nodes.
    normal : (k, nv, n)
        [P, -E s'] there, in units.
    velocities : (k, nv), quadratic : (k, nv)
        A velocity of the branch at each node, and E (Gdot v - s'') for it.
    """

    geometry: ClosureGeometry
    place: FloatArray
    along: FloatArray
    nodes: FloatArray
    normal: FloatArray
    velocities: FloatArray
    quadratic: FloatArray

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest parameter at which the curve is used: between inner nodes."""
        first, *_, last = sorted(self.nodes.tolist())[CURVE_MARGIN:-CURVE_MARGIN]
        return first, last

    def parameter(self, place: FloatArray) -> float | None:
        """The parameter of a configuration; None outside of the range."""
        found = float(self.along @ self.geometry.difference(self.place, place))
        first, last = self.range
        return found if first <= found <= last else None

    def off_branch(self, at: float, v: FloatArray) -> FloatArray:
        """P v - E s' (nv,) at the parameter ``at``, which leads off the branch."""
        normal = np.tensordot(lagrange_weights(self.nodes, at), self.normal, axes=1)
        unit = self.geometry.coordinate_unit
        return normal @ self.geometry.rates(v) * unit

    def multiplier(self, at: float, v: FloatArray, free: FloatArray) -> FloatArray:
        """yhat (nv,) at the parameter ``at`` for the velocity v of the branch and the acceleration
        ``free`` = M^-1 f without closures, both (nv,)."""
        unit = self.geometry.coordinate_unit
        weights = lagrange_weights(self.nodes, at)
        normal = np.tensordot(weights, self.normal, axes=1)[:, : len(unit)]
        own = v - (self.normal @ self.geometry.rates(v)) * unit
        squares = (self.velocities**2).sum(axis=1)
        shares = (own * self.velocities).sum(axis=1) / np.where(squares > 0.0, squares, 1.0)
        z = (weights * shares**2) @ self.quadratic
        return normal @ (free / unit) * unit + z  # type: ignore[no-any-return]


class BranchLimit:
    """P and z = E (Gdot v - s'') on one branch at q.

    Parameters
    ----------
    centre
        The singular configuration on the curve, or q itself.
    q
        A configuration on the branch, as the geometry takes it (:meth:`ClosureGeometry.at`).
    frame : (n, d)
        Velocities in units, close to the branch's tangents, in which the curve is straight.
    tangent : (n, d)
        Tangent space of the branch at the centre, orthonormal, in units.
    direction : (n,)
        w: a velocity in that space that leads away from the singular configurations, in units.

    Attributes
    ----------
    direction
        As given, with 1 as its largest part.
    accuracy
        Estimated error of P; infinite if the branch could not be followed.
    """

    def __init__(
        self,
        centre: SingularConfiguration,
        q: FloatArray,
        frame: FloatArray,
        tangent: FloatArray,
        direction: FloatArray,
    ) -> None:
        self._centre = centre
        self._geometry = centre.geometry
        self._frame, self._tangent = frame, tangent
        self._place = q
        self.direction = direction = direction / np.abs(direction).max()
        self._unit = self._geometry.coordinate_unit
        self.accuracy = np.inf
        self._normal = np.full((len(self._unit), len(self._geometry.unit)), np.nan)
        gap = self._geometry.difference(q, centre.q)
        start = float(gap @ direction) / float(direction @ direction)
        for spacing in SPACINGS:
            times = start + spacing * NODES
            nodes = [self._follow(q, time * direction) for time in times]
            nodes[CENTRE] = centre.q
            found = [node for node in nodes if node is not None]
            if len(found) < len(nodes):
                continue
            values = np.array([self._normal_part(k, node) for k, node in enumerate(found)])
            normal = _at_zero(times, values)
            accuracy = float(np.abs(normal - _at_zero(times[1:-1], values[1:-1])).max())
            if accuracy < self.accuracy:
                self.accuracy, self._normal = accuracy, normal
                self._times, self._nodes, self._normals = times, found, values
            if accuracy < ACCURATE:
                break

    def _follow(self, q: FloatArray, move: FloatArray) -> FloatArray | None:
        """The configuration of the branch near q (+) move, moved off it along the normals only."""
        geometry, frame = self._geometry, self._frame
        x = geometry.move(q, move)
        moved = np.zeros(len(move))
        for _ in range(CLOSING_ITERATIONS):
            g, G = geometry.closure(x)
            rows = np.concatenate([G, frame.T])
            right = np.concatenate([g, frame.T @ moved])
            step = -np.linalg.lstsq(rows, right, rcond=1e-10)[0]
            x, moved = geometry.move(x, step), moved + step
            if np.abs(step).max() < STEP_ROUNDING:
                break
        g, _ = geometry.closure(x)
        if not (
            np.abs(g).max() < CONSTRAINT_TOLERANCE
            and np.abs(moved).max() < 0.5 * np.abs(move).max()
        ):
            return None
        return x

    def _generalised_inverse(self, q: FloatArray, right: FloatArray) -> FloatArray:
        """E right (nv, k) in units, for ``right`` (rows, k) of the normalised G, at a regular q."""
        rank, nv = self._centre.structural_rank, len(self._unit)
        G = self._geometry.normalised(q)[:, :nv]
        U = cholesky(self._geometry.mass())
        X, size, Yt = np.linalg.svd(whiten(U, G.T), full_matrices=False)
        inner = (Yt[:rank] @ right) / size[:rank, None]
        return unwhiten(U, X[:, :rank] @ inner)

    def _normal_part(self, k: int, node: FloatArray) -> FloatArray:
        """[P, -E s'] (nv, n) at node k, in units: P alone without drives."""
        nv = len(self._unit)
        if k != CENTRE:
            return self._generalised_inverse(node, self._geometry.normalised(node))
        self._geometry.closure(node)
        M = self._geometry.mass()
        # Of the branch's velocities with the time's own rate, the nearest in the mass metric.
        tangent, ahead = _with_time(self._tangent, nv)
        onto = tangent @ np.linalg.solve(tangent.T @ M @ tangent, tangent.T @ M)
        P = np.eye(nv) - onto
        return np.column_stack([P, -P @ ahead])

    @property
    def projector(self) -> FloatArray:
        """P (nv, nv) in the model's coordinates."""
        nv = len(self._unit)
        return self._normal[:, :nv] * self._unit[:, None] / self._unit

    def _off(self, normal: FloatArray, v: FloatArray) -> FloatArray:
        """[P, -E s'] (v, 1) (nv,) in the model's coordinates, for ``normal`` = [P, -E s']."""
        return normal @ self._geometry.rates(v) * self._unit

    def off_branch(self, v: FloatArray) -> FloatArray:
        """P v - E s' (nv,): the part of the velocity v (nv,) that leads off the branch."""
        return self._off(self._normal, v)

    def _quadratic_at(self, k: int, node: FloatArray, v: FloatArray) -> FloatArray:
        """E (Gdot v - s'') (nv,) at node k for the velocity v (nv,) of the branch there."""
        if k == CENTRE:
            acceleration = self._centre.limit_acceleration(v, np.zeros(len(v)))
            return -acceleration if acceleration is not None else np.zeros(len(v))
        bias = self._geometry.bias(node, self._geometry.rates(v))
        return self._generalised_inverse(node, bias[:, None])[:, 0] * self._unit

    def quadratic(self, v: FloatArray) -> FloatArray:
        """z = E (Gdot v - s'') (nv,) at q for the velocity v (nv,), model coordinates."""
        values = [
            self._quadratic_at(k, node, v - self._off(normal, v))
            for k, (node, normal) in enumerate(zip(self._nodes, self._normals))
        ]
        return _at_zero(self._times, np.array(values))

    def curve(self) -> BranchCurve | None:
        """The algebra along the curve; None if the branch has more than one degree of freedom, or
        the curve is not accurate."""
        geometry, unit, direction = self._geometry, self._unit, self.direction
        if self._frame.shape[1] != 1 or not self.accuracy < CURVE_ACCURACY:
            return None
        v = direction[: len(unit)] * unit
        if len(direction) > len(unit):  # time passes at its own rate
            if direction[-1] == 0.0:
                return None
            v = v / (direction[-1] * geometry.unit[-1])
        own = [v - self._off(normal, v) for normal in self._normals]
        values = [self._quadratic_at(k, x, w) for k, (x, w) in enumerate(zip(self._nodes, own))]
        along = self._frame[:, 0] / float(self._frame[:, 0] @ direction)
        nodes = np.array([along @ geometry.difference(self._place, node) for node in self._nodes])
        return BranchCurve(
            geometry, self._place, along, nodes, self._normals, np.array(own), np.array(values)
        )

    def multiplier(self, v: FloatArray, free: FloatArray) -> FloatArray:
        """yhat (nv,) at q for the velocity v and the acceleration ``free`` = M^-1 f without
        closures, both (nv,)."""
        return self.projector @ free + self.quadratic(v)


def _with_time(tangent: FloatArray, nv: int) -> tuple[FloatArray, FloatArray]:
    """The velocities (nv, k) of a tangent space (n, d) with t' = 0, and one with t' = 1: (nv, 1)
    with drives, (nv, 0) without."""
    if len(tangent) == nv:
        return tangent, np.zeros((nv, 0))
    passing = tangent[nv]
    _, _, turned = np.linalg.svd(passing[None])
    ahead = tangent[:nv] @ passing / (passing @ passing)
    return tangent[:nv] @ turned[1:].T, ahead[:, None]


def steepest(singular: SingularConfiguration, tangent: FloatArray, u: FloatArray) -> FloatArray:
    """The shortest velocity (n,) in the branch that leaves the singular configurations as u does.

    ``tangent`` (n, d) is the branch's tangent space, u (n,) a velocity in it, all in units.
    Motions that no closure restricts, such as that of a free base, are left out.  Where the forms
    do not vanish on that space the branches are a cone, which has it along u alone.
    """
    null = singular.null
    effects = np.array([singular.hessians(t) @ null for t in tangent.T])
    if np.abs(effects @ (null.T @ tangent)).max() <= VANISHING:
        null = null - tangent @ (tangent.T @ null)
        effects = np.array([singular.hessians(t) @ null for t in tangent.T])
    effects = effects.reshape(len(effects), -1).T
    wanted = effects @ (tangent.T @ u)
    return tangent @ determined_solution(effects, wanted)


def branch_limit(
    singular: SingularConfiguration, q: FloatArray, u: FloatArray
) -> BranchLimit | None:
    """The algebra at q on the branch that u (n,), in units, is a velocity of.

    None if u does not single out one branch (see :meth:`SingularConfiguration.branch`), or if
    there is no singular configuration on the curve through q.
    """
    frame = singular.branch(u)
    if frame is None:
        return None
    direction = steepest(singular, frame, frame @ (frame.T @ u))
    along = direction / np.linalg.norm(direction)
    # The singular configuration on the curve: from q along w and the normals only.
    others = frame - np.outer(along, along @ frame)
    basis, size, _ = np.linalg.svd(others, full_matrices=False)
    geometry = singular.geometry
    found = refine_singular_point(
        geometry, q, singular.rank, NEAR, closed=1e-14, fixed=basis[:, size > 0.5]
    )
    if found is None:
        return None
    centre = analyse_singular(geometry, found, singular.structural_rank)
    tangent = centre.branch(direction)
    return None if tangent is None else BranchLimit(centre, q, frame, tangent, direction)


def branch_next_to(
    geometry: ClosureGeometry, structural_rank: int, q: FloatArray, u: FloatArray
) -> tuple[SingularConfiguration | None, BranchLimit | None]:
    """The singular configuration next to q, and the algebra at q on its branch.

    The branch is that of the velocity u (n,), in units, or if u does not choose one that of q.
    None, None if there is no singular configuration within NEAR; None for the limit if neither
    chooses a branch.
    """
    found = nearest_singular(geometry, q, structural_rank, NEAR)
    if found is None:
        return None, None
    singular = analyse_singular(geometry, found, structural_rank)
    limit = branch_limit(singular, q, u)
    away = geometry.difference(found, q)
    if limit is None and np.linalg.norm(away) > BRANCH_RESOLUTION:
        limit = branch_limit(singular, q, away)
    return singular, limit
