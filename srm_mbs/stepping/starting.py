"""Starts on, or almost on, a singular configuration.

There the direct solve of the first stage errs by round-off over the square of the distance.  The
multiplier comes from the limit of the constraint algebra on the branch that the initial velocity
belongs to (:mod:`srm_mbs.systems.branch_limit`).  What the stages next to the start are given
instead of the direct solve, in the zone, is interpolated from nodes ahead: the motion is
integrated with the multiplier interpolated, the multiplier is solved for at the nodes, and so on
until it does not change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.mechanism import Mechanism
from srm_mbs.methods.base import ErrorNorm, Memory, Method
from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.methods.psrm import PSRM
from srm_mbs.systems.base import Zone
from srm_mbs.systems.branch_limit import TELLS_THE_BRANCH, BranchLimit, branch_limit
from srm_mbs.systems.branches import branch_tangents
from srm_mbs.systems.closure_geometry import ClosureGeometry
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem
from srm_mbs.systems.singular import SingularConfiguration, analyse_singular, nearest_singular

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
AHEAD = 8
"""Nodes of the multiplier history ahead of the start."""
REACH = 0.2
"""Motion (units) from the start to the last of these nodes."""
NODE_SIGMA = 1e-3
"""Smallest sigma of a node."""
ROUNDS = 10
CONVERGED = 1e-11
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
    listed = [_rates(geometry.mechanism, tangent * geometry.unit) for tangent in tangents[:SHOWN]]
    more = f" and {len(tangents) - SHOWN} more" if len(tangents) > SHOWN else ""
    return (
        f"{len(tangents)} branches cross there, with rates in the ratios "
        f"({'), ('.join(listed)}){more}"
    )


def _refuse(singular: SingularConfiguration, u: FloatArray, why: str) -> InputError:
    loops = ", ".join(map(repr, singular.loops))
    return InputError(
        f"the start is a singular configuration of the closures (loops {loops}) {why}: "
        f"{describe_branches(singular, u)}",
        element="v0",
        remedy="Give rates along one branch: srm.assemble(mechanism, q, v) with the rate of one "
        "joint held makes the others fit",
    )


def _limit(mechanism: Mechanism, q: FloatArray, v: FloatArray, sigma: float) -> BranchLimit | None:
    """The algebra at the start, from its branch; None if the direct solve is accurate there.

    Raises
    ------
    InputError
        If v does not choose one branch, or is not the velocity of any.
    """
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    rank = mechanism.structure.rank
    found = nearest_singular(geometry, q, rank, reach=10.0 * DIRECT_FROM)
    if found is None:
        if sigma >= UNDECIDED:
            return None
        raise InputError(
            f"the start is almost a singular configuration (sigma = {sigma:.1e}), but none can be "
            "found next to it, so that the direction of the motion stays undetermined",
            element="q0",
            remedy="Start further away, at sigma above 1e-3",
        )
    away = geometry.difference(found, q)
    distance = float(np.linalg.norm(away))
    if distance >= DIRECT_FROM:
        return None
    singular = analyse_singular(geometry, found, rank)
    u = v / geometry.unit
    speed = float(np.abs(u).max())
    limit = branch_limit(singular, q, u)
    if limit is None and distance > TELLS_THE_BRANCH:
        limit = branch_limit(singular, q, away)
    if limit is None and speed == 0.0:
        raise _refuse(singular, u, "at rest, from where the motion is not unique")
    if limit is None:
        raise _refuse(singular, u, "and its velocity does not choose one branch")
    if not limit.accuracy < FOLLOWED:
        raise _refuse(singular, u, "and the branch of its velocity cannot be followed")
    off = float(np.abs(limit.projector @ v / geometry.unit).max())
    if off > TANGENT * speed:
        raise _refuse(singular, u, "and its velocity is not tangent to any branch")
    return limit


def _span(rate: FloatArray, unit: FloatArray, longest: float) -> float:
    """Time (s) in which the motion covers REACH, at most ``longest``."""
    speed = float(np.abs(rate[: len(unit)] / unit).max())
    acceleration = float(np.abs(rate[len(unit) :] / unit).max())
    # Solves speed T + acceleration T^2 / 2 = REACH without cancellation.
    root = np.sqrt(speed**2 + 2.0 * acceleration * REACH)
    return longest if root == 0.0 else min(longest, 2.0 * REACH / (speed + root))


def _history(
    system: ClosedSystem,
    t: float,
    state: FloatArray,
    rate: FloatArray,
    multiplier: FloatArray,
    norm: ErrorNorm,
    longest: float,
) -> MultiplierHistory:
    """Multipliers at the start and at nodes ahead; the start alone if none can be had."""
    alone = MultiplierHistory.begin(t, multiplier)
    unit = system.mechanism.structure.units.coordinate
    step = _span(rate, unit, longest) / AHEAD
    method = PSRM("dop853")
    history = MultiplierHistory(
        np.linspace(t, t + AHEAD * step, AHEAD + 1), np.tile(multiplier, (AHEAD + 1, 1))
    )
    change = np.inf
    for _ in range(ROUNDS):
        # Known everywhere: every stage of every step takes the interpolated multiplier.
        known = replace(history, known_until=np.inf, known_below=np.inf)
        memory = Memory(rate, 0.0, system.magnitudes(state), known)
        x = state
        values, sigmas = [multiplier], []
        for time in history.times[1:]:
            x = method.step(system, time - step, step, x, memory, norm).state
            try:
                for _ in range(2):  # the rates again, where the corrected position is
                    x = system.retract(x, -system.evaluate(time, x).correction())
                terms = system.evaluate(time, x)
            except EvaluationError:
                return alone
            if terms.sigma < NODE_SIGMA:
                return alone
            sigmas.append(terms.sigma)
            values.append(terms.multiplier().copy())
            memory.rate = terms.rate().copy()
            memory.magnitude = system.magnitudes(x)
        improved = MultiplierHistory(history.times, np.array(values))
        old, change = change, float(np.abs((improved.values - history.values) / unit).max())
        history = improved
        scale = float(np.abs(history.values / unit).max())
        if change <= CONVERGED * scale or not change < 0.5 * old:
            break
    # Rounding at the nodes ends the contraction; anything larger means that it did not contract.
    if not change <= 1e-6 * scale:
        return alone
    return replace(history, known_until=float(history.times[-1]), known_below=max(sigmas))


def start(
    system: OpenSystem | ClosedSystem,
    method: Method,
    t: float,
    state: FloatArray,
    norm: ErrorNorm,
    t_end: float,
) -> Memory:
    """The memory of ``method`` at the initial state, also on a singular configuration.

    Parameters
    ----------
    t_end
        End of the run (s): nothing is evaluated beyond it.

    Raises
    ------
    InputError
        On a singular configuration: at rest, or with a velocity that is not tangent to one
        branch.  The message names the loops and the branches.
    EvaluationError
        If the first stage cannot be evaluated.
    """
    memory = method.start(system, t, state, norm)
    if not isinstance(system, ClosedSystem) or not memory.sigma < LOOK:
        return memory
    q, v = system.split(state)
    limit = _limit(system.mechanism, q, v, memory.sigma)
    if limit is None:
        return memory
    nv = system.nv
    nothing = np.zeros(nv)
    # With every row dropped the acceleration is M^-1 f.
    free = system.evaluate(t, state, Zone(np.inf, lambda _: nothing)).rate()[nv:].copy()
    multiplier = limit.multiplier(v, free)
    memory.rate = np.concatenate([v, free - multiplier])
    history = _history(system, t, state, memory.rate, multiplier, norm, t_end - t)
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
