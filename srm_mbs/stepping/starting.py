"""Starts on, or almost on, a singular configuration.

There the direct solve of the first stage errs by round-off over the square of the distance.  The
multiplier comes from the limit of the constraint algebra on the branch that the initial velocity
belongs to (:mod:`srm_mbs.systems.branch_limit`), and for the first steps it is known beforehand
(:mod:`srm_mbs.stepping.leaving`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.mechanism import Mechanism
from srm_mbs.methods.base import ErrorNorm, Memory, Method
from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.stepping.leaving import DIRECT_SIGMA, Point, free_acceleration, known_multipliers
from srm_mbs.systems.base import System
from srm_mbs.systems.branch_limit import BranchLimit, branch_next_to
from srm_mbs.systems.branches import branch_tangents
from srm_mbs.systems.closure_geometry import ClosureGeometry
from srm_mbs.systems.driven_geometry import geometry_of
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem
from srm_mbs.systems.singular import SingularConfiguration

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
    memory: Memory | None = None,
) -> Memory:
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
