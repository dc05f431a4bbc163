"""Starts on, or almost on, a singular configuration.

There the direct solve of the first stage errs by round-off over the square of the distance.  The
multiplier comes from the limit of the constraint algebra on the branch that the initial velocity
belongs to (:mod:`srm_mbs.dynamics.singularities.branch_limit`), and for the first steps it is known
beforehand (:mod:`srm_mbs.integration.singular_endpoints`).

The multiplier along a motion that leaves a singular configuration.

The stages of the first steps lie so close to the singular configuration that the direct solve
magnifies their errors.  They are given a multiplier known beforehand: the motion is integrated from
node to node with the multiplier interpolated, the multiplier is solved for at the nodes, and so on
until it does not change.  The solve at a node is the direct one, or next to the singular
configuration that of its branch.

Ends beside a singular configuration.

A step that ends there has stages so near that rounding in their direct solves exceeds the
tolerance; their multipliers cannot be predicted from the steps before either, which are too long.
So the multiplier is found first, by collocation from well before up to the end, as for a motion
that leaves a singular configuration (:mod:`srm_mbs.integration.singular_endpoints`): at nodes from
which all stages take it interpolated, the last ones solved on the branch of the motion.  Nothing is
evaluated behind the end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry, geometry_of
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.dynamics.singularities.branch_limit import BranchLimit, branch_next_to
from srm_mbs.dynamics.singularities.branches import branch_tangents
from srm_mbs.dynamics.singularities.local_analysis import SingularConfiguration
from srm_mbs.dynamics.system import System, Zone
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.integration.control.placement import BESIDE
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method
from srm_mbs.integration.methods.multiplier_history import WINDOW, MultiplierHistory
from srm_mbs.integration.methods.near_singular import ZONE_LARGEST
from srm_mbs.integration.methods.psrm import PSRM
from srm_mbs.model.mechanism import Mechanism

AHEAD = WINDOW - 1
"""Nodes of a block ahead of its start."""
REACH = 0.2
"""Largest motion (units) over a block."""
SHARE = 1.0
"""Longest block as a part of the mechanism's characteristic time."""
DEPARTURE_BLOCKS = 12
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
            memory = IntegratorState(here.rate, here.sigma, system.state_scale(here.state), known)
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
    for _ in range(DEPARTURE_BLOCKS):
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


ARRIVAL_BLOCKS = (1, 2, 4)
"""Blocks of nodes up to the end: as many as the tolerance asks for, the best of them where rounding
is in the way."""
SUFFICES, LARGEST = 0.1, 10.0
"""Error of interpolating the multiplier, over the tolerance, that is no matter, and the largest."""
ABOVE = 2.0
"""What is known holds below this multiple of the largest sigma at the nodes: a step that mixes
known and solved multipliers loses its order."""


def arrive(
    system: OpenSystem | ClosedSystem,
    t: float,
    state: FloatArray,
    memory: IntegratorState,
    norm: ErrorNorm,
    end: float,
) -> IntegratorState:
    """``memory`` at ``t`` (s), with the multipliers known up to ``end``, of the run or its piece.

    Unchanged where they cannot be found: the steps are then made as everywhere else.
    """
    if not isinstance(system, ClosedSystem) or memory.history is None:
        return memory
    geometry = geometry_of(system.mechanism, system.split(state)[0], t)
    try:
        multiplier = system.evaluate(t, state).multiplier().copy()
        here = Point(state, memory.rate, multiplier, memory.sigma)
        best = LARGEST
        for blocks in ARRIVAL_BLOCKS:
            history = _known(system, geometry, t, here, norm, end, blocks)
            if history is None:
                continue
            error = _error(history, memory, norm, end - t)
            if error < best:
                best, memory.history = error, history
            if error < SUFFICES:
                break
    except (EvaluationError, np.linalg.LinAlgError):
        # A step will meet it, too, and say so; or the search has left all numbers.
        pass
    return memory


def _known(
    system: ClosedSystem,
    geometry: ClosureGeometry,
    t: float,
    here: Point,
    norm: ErrorNorm,
    end: float,
    blocks: int,
) -> MultiplierHistory | None:
    times = np.linspace(t, end, blocks * AHEAD + 1)
    points = [here]
    for k in range(blocks):
        nodes = times[k * AHEAD : (k + 1) * AHEAD + 1]
        block = block_of(system, geometry, points[-1], nodes, norm, BESIDE, foreseen=True)
        if block is None:
            return None
        points += block[1:]
    return MultiplierHistory(
        times,
        np.array([point.multiplier for point in points]),
        # A step to the end may end a rounding behind it.
        known_until=end + 4.0 * float(np.spacing(abs(end))),
        known_below=ABOVE * max(point.sigma for point in points),
    )


def _error(
    history: MultiplierHistory, memory: IntegratorState, norm: ErrorNorm, span: float
) -> float:
    """Error of interpolating between the nodes over ``span`` (s), over the tolerance."""
    nv = history.values.shape[1]
    error = np.zeros(2 * nv)
    for a, b in ((0, 1), (-2, -1)):
        between = 0.5 * float(history.times[a] + history.times[b])
        error[nv:] = np.maximum(error[nv:], span * history.uncertainty(between))
    return norm(error, norm.weights(memory.state_scale))


LOOK = 0.05
"""sigma below which a singular configuration is looked for."""
DIRECT_FROM = 1e-3
"""Distance (units) from the singular configuration from which the direct solve is accurate."""
UNDECIDED = 1e-5
"""sigma below which a start is refused if no singular configuration explains it."""
TANGENT = 1e-6
"""Largest part of the initial velocity off the branch's tangents, relative to it."""
FOLLOWED = 1e-7
"""Largest error of the limit on a branch that could be followed."""
SHOWN = 4
"""Branches listed in a message."""


def _rates(mechanism: Mechanism, v: FloatArray) -> str:
    """``joint rate`` of the joints that move in v (nv,)."""
    parts = []
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        own = v[joint.idx_v : joint.idx_v + joint.nv]
        if np.abs(own).max() > 1e-9 * np.abs(v).max():
            values = [f"{0.0 + value:.4g}" for value in np.where(np.abs(own) < 1e-12, 0.0, own)]
            parts.append(
                f"{name} {values[0] if len(values) == 1 else '[' + ', '.join(values) + ']'}"
            )
    return ", ".join(parts)


def describe_branches(singular: SingularConfiguration, u: FloatArray) -> str:
    """The branches at a singular configuration in words: ratios of the joint rates."""
    geometry = singular.geometry
    tangents = branch_tangents(singular, u if np.any(u) else None)
    if not len(tangents):
        return "its branches cannot be listed"
    unit = geometry.coordinate_unit
    listed = [
        _rates(geometry.mechanism, tangent[: len(unit)] * unit) for tangent in tangents[:SHOWN]
    ]
    more = f" and {len(tangents) - SHOWN} more" if len(tangents) > SHOWN else ""
    return (
        f"{len(tangents)} branches cross there, with rates in the ratios "
        f"({'), ('.join(listed)}){more}"
    )


def _refuse(singular: SingularConfiguration, u: FloatArray, why: str) -> InputError:
    return InputError(
        f"the start is a singular configuration of {singular.participants} {why}: "
        f"{describe_branches(singular, u)}",
        element="v0",
        remedy="Give rates along one branch: srm.assemble(mechanism, q, v) with the rate of one "
        "joint held makes the others fit",
    )


def _limit(
    geometry: ClosureGeometry, rank: int, place: FloatArray, v: FloatArray, sigma: float
) -> BranchLimit | None:
    """The algebra at the start, from its branch; None if the direct solve is accurate there.

    Raises
    ------
    InputError
        If v does not choose one branch, or is not the velocity of any.
    """
    u = geometry.rates(v)
    singular, limit = branch_next_to(geometry, rank, place, u)
    if singular is None:
        if sigma >= UNDECIDED:
            return None
        raise InputError(
            f"the start is almost a singular configuration (sigma = {sigma:.1e}), but none can be "
            "found next to it, so that the direction of the motion stays undetermined",
            element="q0",
            remedy="Start further away, at sigma above 1e-3",
        )
    if float(np.linalg.norm(geometry.difference(singular.q, place))) >= DIRECT_FROM:
        return None
    speed = float(np.abs(u).max())
    if limit is None and not np.any(v):
        raise _refuse(singular, u, "at rest, from where the motion is not unique")
    if limit is None:
        raise _refuse(singular, u, "and its velocity does not choose one branch")
    if not limit.accuracy < FOLLOWED:
        raise _refuse(singular, u, "and the branch of its velocity cannot be followed")
    off = float(np.abs(limit.off_branch(v) / geometry.coordinate_unit).max())
    if off > TANGENT * speed:
        raise _refuse(singular, u, "and its velocity is not tangent to any branch")
    return limit


def start(
    system: OpenSystem | ClosedSystem,
    method: Method,
    t: float,
    state: FloatArray,
    norm: ErrorNorm,
    t_end: float,
    evaluator: System | None = None,
    memory: IntegratorState | None = None,
) -> IntegratorState:
    """The memory of ``method`` at the initial state, also on a singular configuration.

    Parameters
    ----------
    t_end
        End of the run (s): nothing is evaluated beyond it.
    evaluator
        Evaluates the first stage; ``system`` by default.
    memory
        Of a run that goes on here, at a breakpoint, with the first stage evaluated directly;
        changed here.  Such a motion need not leave the singular configuration.

    Raises
    ------
    InputError
        On a singular configuration: at rest, or with a velocity that is not tangent to one
        branch (the message names the loops and the branches); or if the motion does not leave it.
    EvaluationError
        If the start, or what lies ahead of it, cannot be evaluated.
    """
    begins = memory is None
    if memory is None:
        memory = method.start(system if evaluator is None else evaluator, t, state, norm)
    if not isinstance(system, ClosedSystem) or not memory.sigma < LOOK:
        return memory
    mechanism = system.mechanism
    q, v = system.split(state)
    geometry = geometry_of(mechanism, q, t)
    try:
        rank = mechanism.structure.rank
        limit = _limit(geometry, rank, geometry.at(q, t), v, memory.sigma)
    except InputError:
        if begins or memory.sigma < UNDECIDED:
            raise
        return memory
    if limit is None:
        return memory
    free = free_acceleration(system, t, state)
    multiplier = limit.multiplier(v, free)
    memory.rate = np.concatenate([v, free - multiplier])
    here = Point(state, memory.rate, multiplier, memory.sigma)
    history = MultiplierHistory.begin(t, multiplier)
    if begins or memory.sigma < DIRECT_SIGMA:
        try:
            history = known_multipliers(system, geometry, t, here, norm, t_end)
        except InputError:
            if begins:
                raise
    if memory.history is not None:
        memory.history = history
    memory.sweeps = tuple(
        replace(
            node,
            multiplier=multiplier if np.any(node.multiplier) else node.multiplier,
            history=None if node.history is None else history,
        )
        for node in memory.sweeps
    )
    return memory
