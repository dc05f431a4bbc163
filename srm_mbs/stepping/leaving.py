"""The multiplier along a motion that leaves a singular configuration.

The stages of the first steps lie so close to the singular configuration that the direct solve
magnifies their errors.  They are given a multiplier known beforehand: the motion is integrated from
node to node with the multiplier interpolated, the multiplier is solved for at the nodes, and so on
until it does not change.  The solve at a node is the direct one, or next to the singular
configuration that of its branch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.methods.base import ErrorNorm, Memory
from srm_mbs.methods.history import WINDOW, MultiplierHistory
from srm_mbs.methods.psrm import PSRM
from srm_mbs.methods.zone import ZONE_LARGEST
from srm_mbs.systems.base import Zone
from srm_mbs.systems.branch_limit import branch_next_to
from srm_mbs.systems.closure_geometry import ClosureGeometry
from srm_mbs.systems.multibody import ClosedSystem

AHEAD = WINDOW - 1
"""Nodes of a block ahead of its start."""
REACH = 0.2
"""Largest motion (units) over a block."""
SHARE = 1.0
"""Longest block as a part of the mechanism's characteristic time."""
BLOCKS = 12
LEFT = 0.02
"""sigma from which the singular configuration has been left."""
DIRECT_SIGMA = ZONE_LARGEST
"""sigma from which a node is solved directly."""
ROUNDS = 8
FORESEEN = 4
"""Nodes that the first multipliers are extrapolated from."""
CONVERGED = 1e-11
CONTRACTED = 1e-6
"""Change of the multiplier, relative to it, up to which rounding may end the contraction."""


@dataclass(frozen=True, eq=False)
class Point:
    """A state of the motion: rate (2 nv,), multiplier (nv,) and sigma there."""

    state: FloatArray
    rate: FloatArray
    multiplier: FloatArray
    sigma: float


def free_acceleration(system: ClosedSystem, t: float, state: FloatArray) -> FloatArray:
    """M^-1 f (nv,): the acceleration with every row dropped."""
    nothing = np.zeros(system.nv)
    terms = system.evaluate(t, state, Zone(np.inf, lambda _: nothing))
    return terms.rate()[system.nv :].copy()


def _solved(
    system: ClosedSystem, geometry: ClosureGeometry, t: float, x: FloatArray, direct: float
) -> Point | None:
    """The point of the motion at x (nx,), which is moved onto the closures; None if it cannot."""
    sigma = system.evaluate(t, x).sigma
    if sigma >= direct:
        for _ in range(2):  # the rates again, where the corrected position is
            x = system.retract(x, -system.evaluate(t, x).correction())
        terms = system.evaluate(t, x)
        return Point(x, terms.rate().copy(), terms.multiplier().copy(), terms.sigma)
    nothing = np.zeros(system.nv)
    strong = Zone(2.0 * direct, lambda _: nothing)
    x = system.retract(x, -system.evaluate(t, x, strong).correction())
    q, v = system.split(x)
    rank = system.mechanism.structure.rank
    _, limit = branch_next_to(geometry, rank, geometry.at(q, t), geometry.rates(v))
    if limit is None:
        return None
    v = v - limit.off_branch(v)
    x = np.concatenate([q, v])
    free = free_acceleration(system, t, x)
    multiplier = limit.multiplier(v, free)
    return Point(x, np.concatenate([v, free - multiplier]), multiplier, sigma)


def _span(rate: FloatArray, unit: FloatArray, longest: float) -> float:
    """Time (s) in which the motion covers REACH, at most ``longest``."""
    speed = float(np.abs(rate[: len(unit)] / unit).max())
    acceleration = float(np.abs(rate[len(unit) :] / unit).max())
    # Solves speed T + acceleration T^2 / 2 = REACH without cancellation.
    root = np.sqrt(speed**2 + 2.0 * acceleration * REACH)
    return longest if root == 0.0 else min(longest, float(2.0 * REACH / (speed + root)))


def block_of(
    system: ClosedSystem,
    geometry: ClosureGeometry,
    start: Point,
    times: FloatArray,
    norm: ErrorNorm,
    direct: float,
    foreseen: bool = False,
) -> list[Point] | None:
    """The motion at ``times``, the first of which is that of ``start``; None if it cannot be.

    Parameters
    ----------
    direct
        sigma from which a node is solved directly.
    foreseen
        At first the multiplier is extrapolated from node to node: from a start that is far enough
        from the singular configuration.  Otherwise it is at first that of the start.
    """
    method = PSRM("dop853")
    values = np.tile(start.multiplier, (len(times), 1))
    change = np.inf
    for attempt in range(ROUNDS):
        points = [start]
        history = MultiplierHistory(times, values)
        for t, t_next in pairwise(times.tolist()):
            here = points[-1]
            if foreseen and attempt == 0:
                nodes = slice(max(0, len(points) - FORESEEN), len(points))
                solved = np.array([point.multiplier for point in points[nodes]])
                history = MultiplierHistory(times[nodes], solved)
            # Known everywhere: every stage takes the interpolated multiplier.
            known = replace(history, known_until=np.inf, known_below=np.inf)
            memory = Memory(here.rate, here.sigma, system.magnitudes(here.state), known)
            result = method.step(system, t, t_next - t, here.state, memory, norm)
            point = _solved(system, geometry, t_next, result.state, direct)
            if point is None:
                return None
            points.append(point)
        improved = np.array([point.multiplier for point in points])
        old, change = change, float(np.abs((improved - values) / geometry.coordinate_unit).max())
        values = improved
        scale = float(np.abs(values / geometry.coordinate_unit).max())
        if attempt == 0:
            continue
        if change <= CONVERGED * scale or not change < 0.5 * old:
            break
    return points if change <= CONTRACTED * scale else None


def known_multipliers(
    system: ClosedSystem,
    geometry: ClosureGeometry,
    t: float,
    start: Point,
    norm: ErrorNorm,
    t_end: float,
) -> MultiplierHistory:
    """The multiplier of the motion from ``start`` at ``t`` until it has left.

    Raises
    ------
    InputError
        If the motion is so slow that it does not leave, or it cannot be followed.
    EvaluationError
        If the mechanism cannot be evaluated on the way.
    """
    longest = SHARE / system.mechanism.structure.units.rate
    times, points = [t], [start]
    for _ in range(BLOCKS):
        span = min(_span(points[-1].rate, geometry.coordinate_unit, longest), t_end - times[-1])
        block_times = np.linspace(times[-1], times[-1] + span, AHEAD + 1)
        block = block_of(system, geometry, points[-1], block_times, norm, DIRECT_SIGMA)
        if block is None:
            break
        times += block_times[1:].tolist()
        points += block[1:]
        if points[-1].sigma >= LEFT or times[-1] >= t_end * (1.0 - 1e-12):
            break
    if points[-1].sigma < LEFT and times[-1] < t_end * (1.0 - 1e-12):
        raise InputError(
            "the start is next to a singular configuration, which the motion does not leave "
            f"(sigma = {points[-1].sigma:.1e} at t = {times[-1]:.3g} s)",
            element="v0",
            remedy="Start with more speed, or further away",
        )
    return MultiplierHistory(
        np.array(times),
        np.array([point.multiplier for point in points]),
        known_until=times[-1],
        # Above every sigma there: a step that mixes known and solved multipliers loses its order.
        known_below=2.0 * max(point.sigma for point in points),
    )
