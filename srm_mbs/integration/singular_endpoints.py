r"""Runs that start on a singular configuration, and runs that end beside one.

There the direct solve for the multiplier yhat magnifies rounding by 1/sigma^2.  Both kinds of runs
are made by nodes of the branch (:mod:`srm_mbs.integration.methods.branch_nodes`), in a time that is
proportional to the number of loops.  Other starts, and ends of methods that have no such nodes, are
given multipliers that are known beforehand, and the stages interpolate them:

* At a start on, or almost on, a singular configuration the multiplier comes from the limit of the
  constraint algebra on the branch that the initial velocity belongs to
  (:mod:`srm_mbs.dynamics.singularities.branch_limit`).  The stages of the first steps lie as close;
  their multipliers are found by collocation until the motion has departed.
* A step that ends beside a singular configuration cannot extrapolate its multipliers, because the
  steps before are too long.  They are found by collocation from well before up to the end; nothing
  is evaluated after it.

Collocation (:class:`BranchMotion`): the motion is integrated from node to node with the multiplier
interpolated between the nodes, the multiplier is solved for at the nodes, and both are repeated
until it does not change.  The solve at a node is the direct one, or next to the singular
configuration that on the branch of the motion.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.singularities.branch_limit import BranchCurve, BranchLimit, branch_next_to
from srm_mbs.dynamics.singularities.branches import branch_tangents
from srm_mbs.dynamics.singularities.local_analysis import SingularConfiguration
from srm_mbs.dynamics.system import SingularityAnalysis, System, Zone
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.integration.control.placement import SINGULAR_END_SIGMA
from srm_mbs.integration.methods.base import (
    DelegatingMethod,
    ErrorNorm,
    IntegratorState,
    Method,
)
from srm_mbs.integration.methods.branch_nodes import BranchNodes
from srm_mbs.integration.methods.multiplier_history import WINDOW, MultiplierHistory
from srm_mbs.integration.methods.near_singular import LARGEST_ZONE_SIGMA
from srm_mbs.integration.methods.psrm import PSRM
from srm_mbs.integration.methods.split_step import SplitStep

BLOCK_STEPS = WINDOW - 1
"""Steps of a collocation block: its nodes are as many as one interpolation uses."""
BLOCK_MOTION = 0.2
"""Largest motion over a block (rad, scene diagonals)."""
BLOCK_TIME = 1.0
"""Longest block, in characteristic times of the mechanism."""
DEPARTURE_BLOCKS = 12
"""Blocks of full length within which a motion must depart from its singular start."""
SMALLEST_BLOCK = 1.0 / 32.0
"""Part of its full length to which a block of a departure is shortened, at most, where the
multipliers vary more than its nodes resolve: forces may have shorter times than the motion."""
DEPARTED_SIGMA = 0.02
"""sigma from which a motion has departed from a singular configuration."""
MAX_ITERATIONS = 8
"""Iterations of the multipliers at the nodes of a block."""
EXTRAPOLATION_NODES = 4
"""Nodes from which the first multipliers of an arrival are extrapolated."""
MULTIPLIER_CONVERGED = 1e-11
"""Relative change of the multipliers at which the iteration ends."""
MULTIPLIER_TOLERANCE = 1e-6
"""Largest relative change of the multipliers in the last iteration; rounding may end the
contraction early."""
VANISHING_MULTIPLIER = 1e-9
"""The same over the square of the velocity (rad/s, scene diagonals/s), for multipliers that vanish:
what is left of them is rounding of terms of that size.  Over a block it changes the velocity by a
fifth of this part."""
ARRIVAL_BLOCKS = (1, 2, 4)
"""Numbers of blocks that an arrival tries in turn, until the error is small enough; where rounding
prevents that, the best of them is used."""
ARRIVAL_ERROR, LARGEST_ARRIVAL_ERROR = 0.1, 10.0
"""Error of interpolating the multipliers of an arrival, over the tolerance: small enough, and the
largest that is used."""
KNOWN_SIGMA_FACTOR = 2.0
"""Known multipliers are used below this multiple of the largest sigma at the nodes: a step that
mixes known and solved multipliers loses its order."""
NEAR_SINGULAR_SIGMA = 0.05
"""sigma below which a singular configuration is looked for."""
DIRECT_DISTANCE = 1e-3
"""Distance (rad, scene diagonals) from the singular configuration from which the direct solve is
accurate."""
UNDETERMINED_SIGMA = 1e-5
"""sigma below which a start is refused if no singular configuration explains it."""
TANGENCY_TOLERANCE = 1e-6
"""Largest part of the initial velocity off the branch's tangents, relative to it."""
ON_BRANCH = 1e-9
"""Largest distance (rad, scene diagonals) of a start from the polynomial through nodes of its
branch.  Next to an avoided singular configuration, with the residual delta, it is delta over the
distance from it, at most the root of delta."""
BRANCH_LIMIT_TOLERANCE = 1e-7
"""Largest error of the constraint algebra's limit on a branch that could be followed."""
BRANCHES_LISTED = 4
"""Branches listed in a message, at most."""


@dataclass(frozen=True, eq=False)
class Point:
    """A state of the motion (nx,); rate (2 nv,), multiplier (nv,) and sigma there."""

    state: FloatArray
    rate: FloatArray
    multiplier: FloatArray
    sigma: float


class NodeMaker(Protocol):
    """Makes the nodes of a :class:`BranchMotion`."""

    def nodes(
        self,
        points: list[Point],
        times: FloatArray,
        values: FloatArray,
        direct: float,
        curve: BranchCurve | None,
        extrapolated: int,
    ) -> tuple[list[Point], FloatArray | None]:
        """The motion at ``times`` (k,) s, with the multiplier interpolated between ``values``
        (k, nv), and the multiplier solved for at each node.

        Parameters
        ----------
        points
            The motion at the first of ``times``.
        direct
            sigma from which a node is solved directly.
        curve
            The algebra on the branch, for nodes closer to the singular configuration.
        extrapolated
            With more than 0, the multiplier is extrapolated from so many nodes before.

        Returns
        -------
        points
            The nodes up to the last one that could be solved.
        state : (nx,) or None
            That of the next node, if the curve is missing or does not reach it.
        """


class LayerStart(Protocol):
    """Begins motions in the layers of critical configurations that are nearly singular."""

    @property
    def under_way(self) -> bool:
        """Whether it began one that is still to be made."""

    def begin(self, t: float, state: FloatArray) -> bool:
        """Whether the motion from ``state`` (nx,) at ``t`` (s) starts in a layer, and is to be
        followed along its curve: its first stage is not needed."""


class MakesNodes(ABC):
    """A system that makes its nodes itself, as one in the kernel does; others take those of the
    reference."""

    @abstractmethod
    def node_maker(self, norm: ErrorNorm) -> NodeMaker:
        """For motions next to a singular configuration."""

    @abstractmethod
    def branch_nodes(self) -> BranchNodes:
        """For stages next to a singular configuration."""


@dataclass(frozen=True, eq=False)
class ReferenceNodes:
    """:class:`NodeMaker` by the Python reference; ``geometry`` has the closures."""

    system: System
    analysis: SingularityAnalysis
    geometry: ClosureGeometry
    norm: ErrorNorm

    def nodes(
        self,
        points: list[Point],
        times: FloatArray,
        values: FloatArray,
        direct: float,
        curve: BranchCurve | None,
        extrapolated: int,
    ) -> tuple[list[Point], FloatArray | None]:
        """See :class:`NodeMaker`."""
        system, method, found = self.system, PSRM("dop853"), list(points)
        history = MultiplierHistory(times, values)
        for t, t_next in pairwise(times[len(found) - 1 :].tolist()):
            here = found[-1]
            if extrapolated:
                nodes = slice(max(0, len(found) - extrapolated), len(found))
                solved = np.array([point.multiplier for point in found[nodes]])
                history = MultiplierHistory(times[nodes], solved)
            # Known everywhere: every stage takes the interpolated multiplier.
            known = replace(history, known_until=np.inf, known_below=np.inf)
            scale = system.state_scale(here.state)
            memory = IntegratorState(here.rate, here.sigma, scale, known)
            state = method.step(system, t, t_next - t, here.state, memory, self.norm).state
            point = self._solve(t_next, state, direct, curve)
            if point is None:
                return found, state
            found.append(point)
        return found, None

    def _solve(
        self, t: float, x: FloatArray, direct: float, curve: BranchCurve | None
    ) -> Point | None:
        """The point of the motion at x (nx,), which is moved onto the closures."""
        system = self.system
        sigma = system.evaluate(t, x).sigma
        if sigma >= direct:
            for _ in range(2):  # the rates again, where the corrected position is
                x = system.retract(x, -system.evaluate(t, x).correction())
            terms = system.evaluate(t, x)
            return Point(x, terms.rate().copy(), terms.multiplier().copy(), terms.sigma)
        if curve is None:
            return None
        x = onto_branch(system, t, x, direct)
        q, v = self.analysis.split(x)
        at = curve.parameter(self.geometry.at(q, t))
        if at is None:
            return None
        v = v - curve.off_branch(at, v)
        x = np.concatenate([q, v])
        free = free_acceleration(system, t, x)
        multiplier = curve.multiplier(at, v, free)
        return Point(x, np.concatenate([v, free - multiplier]), multiplier, sigma)


def onto_branch(system: System, t: float, x: FloatArray, direct: float) -> FloatArray:
    """x (nx,) moved onto the closures by the rows that are not small at the sigma ``direct``."""
    strong = Zone.without_prediction(2.0 * direct, system.multiplier_size)
    return system.retract(x, -system.evaluate(t, x, strong).correction())


def free_acceleration(system: System, t: float, state: FloatArray) -> FloatArray:
    """M^-1 f (nv,): the acceleration with every row dropped."""
    nv = system.multiplier_size
    terms = system.evaluate(t, state, Zone.without_prediction(np.inf, nv))
    return terms.rate()[nv:].copy()


@dataclass(eq=False)
class BranchMotion:
    """The motion next to a singular configuration, by collocation of its multiplier.

    Parameters
    ----------
    system, analysis
        The mechanism, and its :attr:`~srm_mbs.dynamics.system.System.singularities`.
    geometry
        Its closures.
    norm
        Error norm of the run.
    maker
        Makes the nodes.
    curve
        The algebra along the branch, if it is known; nodes that it does not reach replace it.
    """

    system: System
    analysis: SingularityAnalysis
    geometry: ClosureGeometry
    norm: ErrorNorm
    maker: NodeMaker
    curve: BranchCurve | None = None

    @classmethod
    def of(
        cls,
        system: System,
        geometry: ClosureGeometry,
        analysis: SingularityAnalysis,
        norm: ErrorNorm,
        limit: BranchLimit | None = None,
    ) -> BranchMotion:
        """The motion of ``system``, which makes its nodes if it can."""
        maker: NodeMaker
        if isinstance(system, MakesNodes):
            maker = system.node_maker(norm)
        else:
            maker = ReferenceNodes(system, analysis, geometry, norm)
        curve = None if limit is None else limit.curve()
        return cls(system, analysis, geometry, norm, maker, curve)

    def _solve(self, t: float, x: FloatArray, direct: float) -> Point | None:
        """The point of the motion at x (nx,) from a new curve; None if there is none."""
        system, geometry = self.system, self.geometry
        sigma = system.evaluate(t, x).sigma
        x = onto_branch(system, t, x, direct)
        q, v = self.analysis.split(x)
        _, limit = branch_next_to(
            geometry, self.analysis.rank, geometry.at(q, t), geometry.rates(v)
        )
        if limit is None:
            return None
        self.curve = limit.curve()
        v = v - limit.off_branch(v)
        x = np.concatenate([q, v])
        free = free_acceleration(system, t, x)
        multiplier = limit.multiplier(v, free)
        return Point(x, np.concatenate([v, free - multiplier]), multiplier, sigma)

    def block(
        self, start: Point, times: FloatArray, direct: float, extrapolated: bool = False
    ) -> list[Point] | None:
        """The motion at ``times`` (s), the first of which is that of ``start``; None if the
        iteration does not converge.

        Parameters
        ----------
        direct
            sigma from which a node is solved directly.
        extrapolated
            Whether the first multipliers are extrapolated from node to node, for a start that is
            far enough from the singular configuration; otherwise they are that of the start.
        """
        unit = self.geometry.coordinate_unit
        values = np.tile(start.multiplier, (len(times), 1))
        change = np.inf
        for iteration in range(MAX_ITERATIONS):
            points = [start]
            count = EXTRAPOLATION_NODES if extrapolated and iteration == 0 else 0
            while len(points) < len(times):
                points, left = self.maker.nodes(points, times, values, direct, self.curve, count)
                if left is not None:
                    point = self._solve(float(times[len(points)]), left, direct)
                    if point is None:
                        return None
                    points.append(point)
            improved = np.array([point.multiplier for point in points])
            old, change = change, float(np.abs((improved - values) / unit).max())
            values = improved
            largest = float(np.abs(values / unit).max())
            if iteration == 0:
                continue
            if change <= MULTIPLIER_CONVERGED * largest or not change < 0.5 * old:
                break
        speed = float(np.abs(start.rate[: len(unit)] / unit).max())
        allowed = max(MULTIPLIER_TOLERANCE * largest, VANISHING_MULTIPLIER * speed**2)
        return points if change <= allowed else None

    def _block_time(self, rate: FloatArray, longest: float) -> float:
        """Time (s) in which the motion covers BLOCK_MOTION, at most ``longest``."""
        unit = self.geometry.coordinate_unit
        speed = float(np.abs(rate[: len(unit)] / unit).max())
        acceleration = float(np.abs(rate[len(unit) :] / unit).max())
        # Solves speed T + acceleration T^2 / 2 = BLOCK_MOTION without cancellation.
        root = np.sqrt(speed**2 + 2.0 * acceleration * BLOCK_MOTION)
        return longest if root == 0.0 else min(longest, float(2.0 * BLOCK_MOTION / (speed + root)))

    def is_slow(self, rate: FloatArray) -> bool:
        """Whether a motion with the tangent ``rate`` (2 nv,) moves by less than DEPARTED_SIGMA over
        the longest block."""
        longest = BLOCK_TIME / self.analysis.rate_unit
        unit = np.tile(self.geometry.coordinate_unit, 2)
        speed, acceleration = np.abs(rate / unit).reshape(2, -1).max(axis=1).tolist()
        return bool(longest * (speed + 0.5 * longest * acceleration) < DEPARTED_SIGMA)

    def departure(
        self, t: float, start: Point, t_end: float, memory: IntegratorState
    ) -> MultiplierHistory:
        """The multipliers of the motion from ``start`` at ``t`` until it has departed; ``memory``
        is that of the start.

        Raises
        ------
        InputError
            If the motion is so slow that it does not depart, or it cannot be followed.
        EvaluationError
            If the mechanism cannot be evaluated on the way.
        """
        longest = BLOCK_TIME / self.analysis.rate_unit
        times, points = [t], [start]
        covered, part = 0.0, 1.0
        while covered < DEPARTURE_BLOCKS:
            whole = self._block_time(points[-1].rate, longest)
            found = self._departing_block(times[-1], points[-1], whole, part, t_end, memory)
            if found is None:
                break
            block_times, block, part = found
            covered += part
            times += block_times[1:].tolist()
            points += block[1:]
            if points[-1].sigma >= DEPARTED_SIGMA or times[-1] >= t_end * (1.0 - 1e-12):
                break
        if points[-1].sigma < DEPARTED_SIGMA and times[-1] < t_end * (1.0 - 1e-12):
            raise InputError(
                "the start is next to a singular configuration, which the motion does not leave "
                f"(sigma = {points[-1].sigma:.1e} at t = {times[-1]:.3g} s)",
                element="v0",
                remedy="Start with more speed, or further away",
            )
        return _known(np.array(times), points, times[-1])

    def _departing_block(
        self,
        t: float,
        start: Point,
        whole: float,
        part: float,
        t_end: float,
        memory: IntegratorState,
    ) -> tuple[FloatArray, list[Point], float] | None:
        """A block from ``t`` over ``part`` of the time ``whole`` (s), or over less where its nodes
        do not resolve the multipliers: its times, its points, and the part that it covers; None if
        there is none.  It is the first that is accurate enough, or else the best."""
        best, found = np.inf, None
        while part >= SMALLEST_BLOCK:
            span = min(part * whole, t_end - t)
            times = np.linspace(t, t + span, BLOCK_STEPS + 1)
            block = self.block(start, times, LARGEST_ZONE_SIGMA)
            if block is not None:
                error = _interpolation_error(
                    _known(times, block, t + span), memory, self.norm, span
                )
                if found is None or error < best:
                    best, found = error, (times, block, part)
                if error < ARRIVAL_ERROR:
                    break
            part *= 0.5
        return found

    def arrival(self, t: float, start: Point, end: float, blocks: int) -> MultiplierHistory | None:
        """The multipliers of the motion from ``start`` at ``t`` to ``end`` (s) by ``blocks`` blocks
        of nodes; None if the iteration does not converge."""
        times = np.linspace(t, end, blocks * BLOCK_STEPS + 1)
        points = [start]
        for k in range(blocks):
            nodes = times[k * BLOCK_STEPS : (k + 1) * BLOCK_STEPS + 1]
            block = self.block(points[-1], nodes, SINGULAR_END_SIGMA, extrapolated=True)
            if block is None:
                return None
            points += block[1:]
        # A step to the end may end a rounding after it.
        return _known(times, points, end + 4.0 * float(np.spacing(abs(end))))


def _known(times: FloatArray, points: list[Point], until: float) -> MultiplierHistory:
    """The multipliers at ``points``, known up to the time ``until`` (s)."""
    return MultiplierHistory(
        times,
        np.array([point.multiplier for point in points]),
        known_until=until,
        known_below=KNOWN_SIGMA_FACTOR * max(point.sigma for point in points),
    )


def singular_arrival(
    system: System,
    t: float,
    state: FloatArray,
    memory: IntegratorState,
    norm: ErrorNorm,
    end: float,
) -> IntegratorState:
    """``memory`` at ``t`` (s), with the multipliers known up to ``end`` (s), the end of the run or
    of its smooth interval; all stages are evaluated by ``system``.

    Unchanged where they cannot be found: the steps are then made as everywhere else.
    """
    analysis = system.singularities
    if analysis is None or memory.history is None:
        return memory
    geometry = analysis.geometry(analysis.split(state)[0], t)
    motion = BranchMotion.of(system, geometry, analysis, norm)
    try:
        multiplier = system.evaluate(t, state).multiplier().copy()
        here = Point(state, memory.rate, multiplier, memory.sigma)
        best = LARGEST_ARRIVAL_ERROR
        for blocks in ARRIVAL_BLOCKS:
            history = motion.arrival(t, here, end, blocks)
            if history is None:
                continue
            error = _interpolation_error(history, memory, norm, end - t)
            if error < best:
                best, memory.history = error, history
            if error < ARRIVAL_ERROR:
                break
    except (EvaluationError, np.linalg.LinAlgError):
        # A step will meet it, too, and say so; or the search has left all numbers.
        pass
    return memory


def _interpolation_error(
    history: MultiplierHistory, memory: IntegratorState, norm: ErrorNorm, span: float
) -> float:
    """Error of interpolating between the nodes over ``span`` (s), over the tolerance."""
    nv = history.values.shape[1]
    error = np.zeros(2 * nv)
    for a, b in ((0, 1), (-2, -1)):
        between = 0.5 * float(history.times[a] + history.times[b])
        error[nv:] = np.maximum(error[nv:], span * history.uncertainty(between))
    return norm(error, norm.weights(memory.state_scale))


def _rates(geometry: ClosureGeometry, v: FloatArray) -> str:
    """``joint rate`` of the joints that move in v (nv,)."""
    parts = []
    for name in geometry.mechanism.joint_names:
        joint = geometry.mechanism.joint(name)
        own = v[joint.idx_v : joint.idx_v + joint.nv]
        if np.abs(own).max() > 1e-9 * np.abs(v).max():
            values = [f"{0.0 + value:.4g}" for value in np.where(np.abs(own) < 1e-12, 0.0, own)]
            parts.append(
                f"{name} {values[0] if len(values) == 1 else '[' + ', '.join(values) + ']'}"
            )
    return ", ".join(parts)


def _nearest_rates(singular: SingularConfiguration, u: FloatArray) -> str:
    """In words, the rates next to u (n,), in units, that belong to a branch; empty if there are
    none.  With drives, time passes at its own rate."""
    geometry = singular.geometry
    size = float(np.abs(u).max())
    near = singular.onto_branch(u) if size > 0.0 else u
    if singular.branch(near) is None or not (
        np.abs(singular.curvature(near)).max() <= TANGENCY_TOLERANCE * size**2
    ):
        return ""
    unit = geometry.coordinate_unit
    if geometry.drives:
        near = near * (u[-1] / near[-1])
    return f"the nearest rates along a branch are ({_rates(geometry, near[: len(unit)] * unit)})"


def describe_branches(singular: SingularConfiguration, u: FloatArray) -> str:
    """The branches at a singular configuration in words: ratios of the joint rates."""
    geometry = singular.geometry
    tangents = branch_tangents(singular, u if np.any(u) else None)
    if not len(tangents):
        return _nearest_rates(singular, u) or "its branches cannot be listed"
    unit = geometry.coordinate_unit
    listed = [
        _rates(geometry, tangent[: len(unit)] * unit) for tangent in tangents[:BRANCHES_LISTED]
    ]
    further = len(tangents) - BRANCHES_LISTED
    more = f" and {further} more" if further > 0 else ""
    cross = "1 branch passes" if len(tangents) == 1 else f"{len(tangents)} branches cross"
    return f"{cross} there, with rates in the ratios ({'), ('.join(listed)}){more}"


def _refusal(singular: SingularConfiguration, u: FloatArray, why: str) -> InputError:
    return InputError(
        f"the state is a singular configuration of {singular.participants} {why}: "
        f"{describe_branches(singular, u)}",
        element="v0",
        remedy="Give rates along one branch: srm.assemble(mechanism, q, v) with the rate of one "
        "joint held makes the others fit",
    )


def _limit_at_start(
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
        if sigma >= UNDETERMINED_SIGMA:
            return None
        raise InputError(
            f"the state is almost a singular configuration (sigma = {sigma:.1e}), but none can be "
            "found next to it, so that the direction of the motion stays undetermined",
            element="q0",
            remedy="Start further away, at sigma above 1e-3",
        )
    if float(np.linalg.norm(geometry.difference(singular.q, place))) >= DIRECT_DISTANCE:
        return None
    speed = float(np.abs(u).max())
    if limit is None and not np.any(v):
        raise _refusal(singular, u, "at rest, from where the motion is not unique")
    if limit is None:
        raise _refusal(singular, u, "and its velocity does not choose one branch")
    if not limit.accuracy < BRANCH_LIMIT_TOLERANCE:
        raise _refusal(singular, u, "and the branch of its velocity cannot be followed")
    off = float(np.abs(limit.off_branch(v) / geometry.coordinate_unit).max())
    if off > TANGENCY_TOLERANCE * speed:
        raise _refusal(singular, u, "and its velocity is not tangent to any branch")
    return limit


def _uses_nodes(method: Method) -> bool:
    """Whether the steps of ``method`` solve stages by nodes of the branch."""
    stepper = method.stepper if isinstance(method, DelegatingMethod) else method
    return isinstance(stepper, SplitStep) and stepper.uses_nodes


def _start_by_nodes(system: System, t: float, state: FloatArray, memory: IntegratorState) -> bool:
    """Whether the start is solved by nodes of its branch, or directly because it is far enough from
    the singular configuration; without the analysis of branches, in a time proportional to the
    number of loops.

    With one degree of freedom the velocity, if it is not zero, leads along the branch.  Where sigma
    vanishes in proportion to the distance on it, and the state lies on the polynomial through its
    nodes, there is one branch, and it is singular.
    """
    branch_system = system.branch_system
    if branch_system is None:
        return False
    nodes = system.branch_nodes() if isinstance(system, MakesNodes) else BranchNodes(branch_system)
    v = state[-system.multiplier_size :]
    try:
        away = nodes.spaced(t, state, v)
        if away is None:
            return False
        distance = nodes.distance(t, state, memory.sigma, away)
        if distance >= DIRECT_DISTANCE:
            return memory.sigma >= UNDETERMINED_SIGMA
        if not (distance >= 0.0 and nodes.solve(t, state, away)):
            return False
    except EvaluationError:
        return False  # the search for the singular configuration meets it, or does without
    position, rates = nodes.moved.reshape(2, -1)
    if system.position_norm(position) > ON_BRANCH:
        return False
    if system.position_norm(rates) > TANGENCY_TOLERANCE * system.position_norm(v):
        return False
    memory.lingering = True
    history = replace(MultiplierHistory.begin(t, nodes.multiplier), away=nodes.away)
    rate = np.concatenate([v, nodes.rate[len(v) :]])
    memory.set_first_stage(rate, nodes.multiplier, history)
    return True


def start(
    system: System,
    method: Method,
    t: float,
    state: FloatArray,
    norm: ErrorNorm,
    t_end: float,
    memory: IntegratorState | None = None,
    layers: LayerStart | None = None,
) -> IntegratorState:
    """The memory of ``method`` at the initial state, also on a singular configuration.

    Parameters
    ----------
    t_end
        End of the run (s): nothing is evaluated beyond it.
    memory
        Of a run that continues here, at a breakpoint, with the first stage evaluated directly;
        changed here.  Such a motion need not depart from the singular configuration.
    layers
        Begins motions in layers; None where steps are to leave them.

    Raises
    ------
    InputError
        On a singular configuration: at rest, or with a velocity that is not tangent to one
        branch (the message names the loops and the branches); or if the motion does not depart.
    EvaluationError
        If the start, or what lies ahead of it, cannot be evaluated.
    """
    begins = memory is None
    if memory is None:
        memory = method.start(system, t, state, norm)
    analysis = system.singularities
    if analysis is None or not memory.sigma < NEAR_SINGULAR_SIGMA:
        return memory
    if layers is not None and layers.begin(t, state):
        return memory
    q, v = analysis.split(state)
    geometry = analysis.geometry(q, t)
    one_freedom = not geometry.drives and len(geometry.unit) - analysis.rank == 1
    if one_freedom and _uses_nodes(method) and _start_by_nodes(system, t, state, memory):
        return memory
    try:
        limit = _limit_at_start(geometry, analysis.rank, geometry.at(q, t), v, memory.sigma)
    except InputError:
        if begins or memory.sigma < UNDETERMINED_SIGMA:
            raise
        return memory
    if limit is None:
        return memory
    motion = BranchMotion.of(system, geometry, analysis, norm, limit)
    unit = geometry.coordinate_unit
    free = free_acceleration(system, t, state)
    multiplier = limit.multiplier(v, free)
    rate = np.concatenate([v, free - multiplier])
    history = MultiplierHistory.begin(t, multiplier)
    branch_system = system.branch_system
    if motion.is_slow(rate) and _uses_nodes(method) and branch_system is not None:
        nodes = BranchNodes(branch_system)
        away = nodes.spaced(t, state, limit.direction[: len(unit)] * unit)
        away = None if away is None else away[None]
        history, memory.lingering = replace(history, away=away), away is not None
    elif begins or memory.sigma < LARGEST_ZONE_SIGMA:
        try:
            here = Point(state, rate, multiplier, memory.sigma)
            history = motion.departure(t, here, t_end, memory)
        except InputError:
            if begins:
                raise
    memory.set_first_stage(rate, multiplier, history)
    return memory
