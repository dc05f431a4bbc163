r"""Static equilibria: configurations in which gravity, force elements and closures balance.

In minimal coordinates z around the current configuration
(:mod:`srm_mbs.dynamics.constraints.local_coordinates`) the forces at rest are Q(z) = S^T f, S the
velocities per unit z', and an equilibrium has Q = 0.  With K = -dQ/dz, the Hessian of the potential
if there is one, *stable* equilibria are found by trust-region steps (K + mu) p = Q along which the
forces do positive work, the *nearest* one by Levenberg-Marquardt steps on Q.  S^T f = S^T M v',
with the constrained acceleration v' at rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.assembly.assemble import assemble
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.local_coordinates import (
    ChartPoint,
    TangentChart,
    differences,
    tangent_basis,
)
from srm_mbs.dynamics.constraints.reactions import reactions_at
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.singularities.local_analysis import (
    SINGULAR,
    TAU,
    nearest_singular,
    smallest_singular_value,
)
from srm_mbs.errors import AnalysisError, InputError, KnownKeys, get_logger
from srm_mbs.model.coordinates import free_coordinates, joint_coordinates
from srm_mbs.model.numbers import choice, name_list

log = get_logger(__name__)

MAX_ITERATIONS = 150
LARGEST_STEP = 0.5
"""Largest radius of the trust region, rad and scene diagonals."""
MAX_TRAVEL = 30.0
"""Length of descent (rad, scene diagonals) after which the potential has no minimum: some turns of
a crank."""
STEP_TOLERANCE = 1e-13
"""Largest last Newton step, rad and scene diagonals."""
SMALLEST_STEP = 1e-9
"""Step (rad, scene diagonals) whose work is rounding."""
NEUTRAL_STIFFNESS = 1e-8
"""Stiffness that is regarded as zero, over inertia times the squared characteristic rate."""
FORCE_TOLERANCE = 1e-7
"""Largest residual force at an equilibrium, over the larger of stiffness and inertia times the
squared characteristic rate."""
SINGULAR_TOLERANCE = 1e-5
"""Singular value of the closures below which an equilibrium is a singular configuration."""
SINGULAR_RADIUS = 1e-3
"""Distance (rad, scene diagonals) within which this singular configuration is computed."""


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A static equilibrium.

    Attributes
    ----------
    q : (nq,)
        The configuration, loops closed.
    multipliers : {loop: (rows,)}, reactions : {loop: (6,)}
        As ``reaction_multipliers`` and ``reactions`` of a solution, at rest.
    joint_reactions : {joint: (6,)}
        As ``joint_reactions`` of a solution, holding forces included.
    holding : {joint: (n,)}
        Forces (N, N m) at the held joints.
    residual
        Largest residual force on a motion of the mechanism (N m; N times the scene diagonal).
    eigenvalues : (k,)
        Generalised eigenvalues of stiffness and mass matrix on the closures, 1/s^2, ascending: the
        squared circular frequencies of small undamped oscillations.
    modes : (nv, k)
        Their joint motions; the largest entry, in units, is 1.
    stable
        Whether all eigenvalues are positive; also True if nothing can move.
    neutral
        Whether an eigenvalue is zero: neighbouring configurations are equilibria as well, or
        nearly.
    singular
        Whether q is a singular configuration.  ``eigenvalues`` and ``stable`` then refer to the
        branch of the search.
    """

    q: FloatArray
    multipliers: Mapping[str, FloatArray] = field(repr=False)
    reactions: Mapping[str, FloatArray] = field(repr=False)
    joint_reactions: Mapping[str, FloatArray] = field(repr=False)
    holding: Mapping[str, FloatArray]
    residual: float
    eigenvalues: Any
    modes: Any = field(repr=False)
    stable: bool
    neutral: bool
    singular: bool


class _Statics:
    """Forces and stiffness at rest, on the closures."""

    def __init__(self, mechanism: Mechanism, q: FloatArray, free: IndexArray) -> None:
        self.geometry = ClosureGeometry(mechanism, q)
        self.free = free
        self.system = make_system(mechanism)
        self.rate = mechanism.structure.units.rate
        self.rest = np.zeros(mechanism.model.nv)
        self.sense = 1.0  # -1 reverses the forces: maxima of the potential become minima
        self.basis, _ = tangent_basis(self.geometry, q, free)

    def chart(self, q: FloatArray) -> TangentChart:
        """Minimal coordinates around q; at a singular configuration along the previous branch."""
        basis, _ = tangent_basis(self.geometry, q, self.free)
        if basis.shape == self.basis.shape:
            self.basis = basis
        return TangentChart(self.geometry, q, self.basis, self.free)

    def unbalanced(self, q: FloatArray) -> FloatArray:
        """M v' (nv,) at rest, in units: the force that accelerates the mechanism."""
        state = np.concatenate([q, self.rest])
        rate = self.system.evaluate(0.0, state).rate()[len(self.rest) :]
        self.geometry.closure(q)
        out: FloatArray = self.sense * (self.geometry.mass() @ (rate / self.geometry.unit))
        return out

    def force(self, point: ChartPoint) -> FloatArray:
        """Q (k,)."""
        return point.slopes.T @ self.unbalanced(point.q)

    def at(self, chart: TangentChart, z: FloatArray) -> ChartPoint:
        point = chart.point(z)
        if point is None:
            raise AnalysisError(
                "the loops do not close next to this configuration",
                q=chart.q,
                remedy="Give another start: this one may be beside a singular configuration, or at "
                "a dead point of a joint in hold=",
            )
        return point

    def centre(self, chart: TangentChart) -> ChartPoint:
        return self.at(chart, np.zeros(chart.size))

    def stiffness(self, chart: TangentChart) -> FloatArray:
        """K = -dQ/dz (k, k)."""
        steps = np.full(chart.size, TAU)
        return -differences(lambda z: self.force(self.at(chart, z)), steps)

    def inertia(self, chart: TangentChart) -> FloatArray:
        """Mass matrix (k, k) of the minimal coordinates."""
        S = self.centre(chart).slopes
        self.geometry.closure(chart.q)
        out: FloatArray = S.T @ self.geometry.mass() @ S
        return out

    def force_unit(self, chart: TangentChart) -> float:
        """Inertia times the squared characteristic rate (N m)."""
        inertia = np.linalg.eigvalsh(self.inertia(chart)).max(initial=0.0)
        return float(self.rate**2 * inertia)

    def imbalance(self, q: FloatArray) -> float:
        """Largest residual force, over stiffness or inertia times the squared rate."""
        chart = self.chart(q)
        if not chart.size:
            return 0.0
        scale = max(self.force_unit(chart), float(np.abs(self.stiffness(chart)).max()))
        return float(np.abs(self.force(self.centre(chart))).max()) / scale


def _work(statics: _Statics, chart: TangentChart, p: FloatArray) -> float | None:
    """Work of the forces along z = 0 ... p, by Gauss quadrature; None if the loops do not close."""
    points, weights = np.polynomial.legendre.leggauss(4)
    total = 0.0
    for x, w in zip(points, weights):
        point = chart.point(0.5 * (x + 1.0) * p)
        if point is None:
            return None
        total += 0.5 * w * float(statics.force(point) @ p)
    return total


def _descend(statics: _Statics, q: FloatArray) -> FloatArray:
    """Trust-region steps along which the forces do work, until Newton steps converge."""
    radius, travelled = 0.1, 0.0
    for _ in range(MAX_ITERATIONS):
        if travelled > MAX_TRAVEL:
            break
        chart = statics.chart(q)
        Q, K = statics.force(statics.centre(chart)), statics.stiffness(chart)
        K = 0.5 * (K + K.T)
        values, vectors = np.linalg.eigh(K)
        floor = NEUTRAL_STIFFNESS * statics.force_unit(chart)
        along = vectors.T @ Q
        if values.min(initial=0.0) > -floor:
            soft = (np.abs(values) <= floor) & (np.abs(along) <= floor)
            newton = np.where(soft, 0.0, along / np.where(soft, 1.0, np.maximum(values, floor)))
        else:
            newton = np.full(len(values), np.inf)
        if np.abs(newton).max(initial=0.0) <= radius:
            p = vectors @ newton
            if np.abs(p).max(initial=0.0) <= STEP_TOLERANCE:
                return q
        else:
            p = vectors @ _bounded(values, along, radius)
        predicted = float(Q @ p - 0.5 * p @ K @ p)
        work = _work(statics, chart, p)
        size = float(np.abs(p).max(initial=0.0))
        end = chart.point(p)
        if end is not None and work is not None and work > 0.1 * predicted:
            q, travelled = end.q, travelled + size
            radius = (
                min(LARGEST_STEP, max(radius, 2.0 * size)) if work > 0.7 * predicted else radius
            )
        elif size <= SMALLEST_STEP:
            return end.q if end is not None and not np.isinf(newton).any() else q
        else:
            radius = 0.3 * size
    raise AnalysisError(
        "no stable equilibrium was found: the forces go on doing work",
        q=q,
        remedy="Look for a force that nothing balances, as gravity on a free body (hold= keeps its "
        "joint), or give another start",
    )


def _bounded(values: FloatArray, along: FloatArray, radius: float) -> FloatArray:
    """Minimiser of -along.p + p.values.p/2 over |p| <= radius, in the eigenvectors' axes."""
    from scipy.optimize import brentq

    along = along.copy()
    lowest = float(values[0])
    scale = max(float(np.abs(values).max()), float(np.abs(along).max()) / radius, 1e-100)
    # At a maximum the force is zero: leave it along the direction of lowest stiffness.
    along[0] += np.copysign(1e-8 * scale * radius, along[0])

    def excess(mu: float) -> float:
        return float(np.linalg.norm(along / (values + mu))) - radius

    low = max(0.0, -lowest) + 1e-14 * scale
    high = max(0.0, -lowest) + float(np.linalg.norm(along)) / radius + scale
    if excess(low) <= 0.0:
        return along / (values + low)
    out: FloatArray = along / (values + float(brentq(excess, low, high, xtol=1e-14 * scale)))
    return out


def _nearest(statics: _Statics, start: FloatArray) -> FloatArray:
    """Levenberg-Marquardt steps; if they end in a local minimum of |Q|, descent or ascent."""
    found = _balance(statics, start)
    if statics.imbalance(found) <= FORCE_TOLERANCE:
        return found
    ends = []
    for statics.sense in (1.0, -1.0):
        with suppress(AnalysisError):
            end = _descend(statics, start)
            if statics.imbalance(end) <= FORCE_TOLERANCE:
                ends.append(end)
    statics.sense = 1.0
    distances = [np.linalg.norm(statics.geometry.difference(start, end)) for end in ends]
    return ends[int(np.argmin(distances))] if ends else found


def _balance(statics: _Statics, q: FloatArray) -> FloatArray:
    """Levenberg-Marquardt steps on Q = 0."""
    damping = 1e-3
    chart = statics.chart(q)
    Q = statics.force(statics.centre(chart))
    for _ in range(MAX_ITERATIONS):
        K = statics.stiffness(chart)
        left, values, right = np.linalg.svd(K)
        soft = NEUTRAL_STIFFNESS * statics.force_unit(chart)
        used = values > soft
        size = np.inf
        while size > STEP_TOLERANCE:
            mu = damping * values[0] if len(values) else 0.0
            inverse = np.where(used, values / (values**2 + mu**2 + (values == 0.0)), 0.0)
            p = right.T @ (inverse * (left.T @ Q))
            size = float(np.abs(p).max(initial=0.0))
            end = chart.point(p) if size <= LARGEST_STEP else None
            if end is not None:
                there = statics.chart(end.q)
                after = statics.force(statics.centre(there))
                if np.linalg.norm(after) < np.linalg.norm(Q):
                    break
            damping = max(10.0 * damping, 1e-12)
            if damping > 1e12:
                size = 0.0
        else:
            return q
        q, chart, Q, damping = end.q, there, after, 0.1 * damping if damping > 1e-12 else 0.0
    return q


def equilibrium(
    mechanism: Mechanism,
    q: Any = None,
    *,
    hold: str | Iterable[str] = (),
    search: Literal["stable", "nearest"] = "stable",
) -> Equilibrium:
    """Find a configuration in which the mechanism stays at rest.

    Gravity, springs, bushings, constant torques and wrenches act, and elements with a law over time
    at their value for t = 0.  Damping and friction vanish at rest (smooth friction has no
    sticking).

    Parameters
    ----------
    q : (nq,) or {joint: position}
        The start of the search; by default the initial configuration.
    hold
        Joints that keep their position.
    search
        ``"stable"`` descends to a stable equilibrium; ``"nearest"`` solves for zero forces, and
        also finds unstable equilibria.

    Raises
    ------
    InputError
        For an unknown joint, or a start on a singular configuration.
    AssemblyError
        If the start cannot be closed.
    AnalysisError
        If there is no equilibrium, or none was found; its ``q`` is the last configuration.
    """
    check_mechanism(mechanism)
    choice(search, ("stable", "nearest"), "search")
    mechanism.refuse_drives("an equilibrium")
    held = name_list(hold, "hold")
    start = assemble(mechanism, q, hold=held)
    if start.singular:
        raise InputError(
            "the search starts on a singular configuration, where branches meet",
            element="q",
            remedy="Start next to it",
        )
    free = free_coordinates(mechanism, held)
    statics = _Statics(mechanism, start.q, free)
    found = (_descend if search == "stable" else _nearest)(statics, start.q)
    left = statics.imbalance(found)
    if left > FORCE_TOLERANCE:
        raise AnalysisError(
            "no equilibrium was found: at the best configuration the forces still accelerate the "
            f"mechanism by {left:.1e} of what they can",
            q=found,
            remedy="Give another start",
        )
    geometry, rank = statics.geometry, mechanism.structure.rank
    singular = rank > 0 and smallest_singular_value(geometry, found, rank) < SINGULAR_TOLERANCE
    if singular:
        exact = nearest_singular(geometry, found, rank, SINGULAR_RADIUS)
        found = found if exact is None else exact
    return _described(mechanism, statics, found, held, bool(singular))


def _described(
    mechanism: Mechanism,
    statics: _Statics,
    q: FloatArray,
    held: tuple[str, ...],
    singular: bool,
) -> Equilibrium:
    from scipy.linalg import eig

    geometry = statics.geometry
    chart = statics.chart(q)
    inertia = statics.inertia(chart)
    values, vectors = np.zeros(0), np.zeros((0, 0))
    if chart.size:
        values, vectors = eig(statics.stiffness(chart), inertia)
        if np.abs(values.imag).max() <= 1e-9 * np.abs(values).max():
            values, vectors = values.real, vectors.real
        order = np.argsort(values.real)
        values, vectors = values[order], vectors[:, order]
    point = statics.centre(chart)
    shapes = point.slopes @ vectors
    shapes = shapes / np.abs(shapes).max(axis=0, initial=0.0)
    neutral = bool(np.any(np.abs(values) <= NEUTRAL_STIFFNESS * statics.rate**2))
    # M v' = f - G^T lam is balanced by the held joints, up to loads shared with closures.
    columns = joint_coordinates(mechanism, held)
    _, G = geometry.closure(q)
    rest = statics.unbalanced(q)
    carried = np.vstack([np.eye(len(rest))[columns], G / geometry.row_size[:, None]]).T
    share = np.linalg.lstsq(carried, rest, rcond=SINGULAR)[0][: len(columns)]
    holding = np.zeros(len(rest))
    holding[columns] = -share / geometry.unit[columns]
    system = make_system(mechanism, lambda t, q, v: holding)
    at_q = reactions_at(system, np.zeros(1), q[None], statics.rest[None])
    multipliers, wrenches, of_joints = (
        KnownKeys((name, rows[0]) for name, rows in part.items())
        for part in (at_q.multipliers, at_q.closures, at_q.joints)
    )
    joints = {name: mechanism.joint(name) for name in held}
    log.debug("%s: equilibrium of %d free directions", mechanism.name, len(values))
    return Equilibrium(
        q,
        multipliers,
        wrenches,
        of_joints,
        {name: holding[j.idx_v : j.idx_v + j.nv] for name, j in joints.items()},
        float(np.abs(statics.force(point)).max(initial=0.0)),
        values,
        geometry.unit[:, None] * shapes,
        bool(not neutral and np.all(np.real(values) > 0.0) and np.isrealobj(values)),
        neutral,
        singular,
    )
