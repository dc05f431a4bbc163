"""Paths of a mechanism whose joints are dragged through given values, on one branch.

The continuation method is in :mod:`srm_mbs.assembly.continuation`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.assembly.assemble import assemble
from srm_mbs.assembly.continuation import drag
from srm_mbs.assembly.position import ClosureProblem
from srm_mbs.dynamics.constraints.local_coordinates import tangent_basis
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.scaling import is_angle
from srm_mbs.dynamics.singularities.local_analysis import SINGULAR
from srm_mbs.errors import InputError, get_logger, safe_repr
from srm_mbs.model.coordinates import position_of
from srm_mbs.model.numbers import finite_array, named_values, positive_number
from srm_mbs.visualization.animation.joint_motion import JointMotion

log = get_logger(__name__)

LONGEST_WAY = 1e4
"""Length of the way of a joint (rad, scene diagonals): 1600 turns, in 10^5 steps; the rounding of
positions ends a path after 30,000."""
BRANCH_COSINE = 0.9
"""Smallest cosine between successive tangents on one branch."""


@dataclass(frozen=True, eq=False)
class PathPoint:
    """A configuration on a path: the dragged joints' ``values`` (rad, m), ``q`` (nq,), and for a
    singular one the ``loops`` whose rows lose rank."""

    values: Mapping[str, float]
    q: FloatArray
    loops: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class FollowedPath:
    """A path along which joints were dragged.

    Attributes
    ----------
    mechanism
        The mechanism.
    q : (m, nq)
        Configurations at the first m of the given values; all of them if it is ``complete``.
    complete
        Whether all values were reached.
    limit
        Turning point of the path, beyond which the dragged joints cannot move; None if the path is
        complete.
    singular
        Singular configurations on the path, in order.
    branch_kept
        Whether the angle between the tangents of successive configurations was always small.
    path : (k, nq)
        All configurations on the path.
    message
        The end of the path, as a sentence.
    """

    mechanism: Mechanism
    q: FloatArray
    complete: bool
    limit: PathPoint | None
    singular: tuple[PathPoint, ...]
    branch_kept: bool
    path: FloatArray
    message: str

    def __repr__(self) -> str:
        return (
            f"FollowedPath({self.mechanism.name!r}, {len(self.q)} values reached, "
            f"{len(self.path)} configurations, {len(self.singular)} singular, {self.message!r})"
        )

    def motion(self, duration: float = 3.0) -> JointMotion:
        """The path as a motion of ``duration`` (s), which can be animated.

        Raises
        ------
        InputError
            If the duration is not positive.
        """
        end = positive_number(duration, "duration", " of seconds")
        times = np.linspace(0.0, end, len(self.path)) if len(self.path) > 1 else np.zeros(1)
        return JointMotion(self.mechanism, times, self.path)


def _dragged(mechanism: Mechanism, values: Mapping[str, Any]) -> FloatArray:
    """The values (n, joints) of the dragged joints."""
    columns = []
    for name, given in named_values(values, "values").items():
        joint = mechanism.joint(name)
        array = finite_array(given)
        if joint.nv != 1 or array is None or array.ndim > 1 or not array.size:
            raise InputError(
                f"joint {name!r} cannot be dragged along {safe_repr(given)}",
                element="values",
                remedy="Give finite numbers (rad, m) for a joint of one degree of freedom",
            )
        columns.append(np.atleast_1d(array))
    if not columns or len({len(column) for column in columns}) > 1:
        raise InputError(
            f"the joints have {[len(column) for column in columns]} values",
            element="values",
            remedy="Name at least one joint, and give each the same number of values",
        )
    return np.column_stack(columns)


def follow(mechanism: Mechanism, values: Mapping[str, Any], q: Any = None) -> FollowedPath:
    """Drag joints through values, closing the loops on the way and staying on one branch.

    Parameters
    ----------
    values
        Joint name -> positions (n,) (rad, m; angles unwrapped) that are reached in order, along
        straight lines, from the start to the first of them.
    q : (nq,)
        The start; by default the initial configuration.

    Raises
    ------
    InputError
        For malformed values, joints that cannot be dragged independently, or a start on a singular
        configuration.
    AssemblyError
        If the start cannot be closed.
    """
    check_mechanism(mechanism)
    mechanism = mechanism.undriven  # dragged joints replace the drives
    wanted = _dragged(mechanism, values)
    if not mechanism.loops:
        raise InputError(
            "a mechanism without loops has nothing to follow",
            element="loop",
            remedy="Set its joints directly: they do not depend on each other",
        )
    start = assemble(mechanism, q, hold=list(values))
    problem = ClosureProblem(mechanism, start.q)
    columns = np.array([mechanism.joint(name).idx_v for name in values])
    if start.singular:
        raise InputError(
            "the path starts on a singular configuration, where branches meet",
            element="q",
            remedy="Start next to it, on the branch that is meant",
        )
    basis, _ = tangent_basis(problem, start.q, np.arange(mechanism.model.nv))
    if np.linalg.matrix_rank(basis[columns], tol=SINGULAR) < len(columns):
        if len(columns) == 1 and basis.shape[1]:
            (name,) = values
            stuck = name in mechanism.mobility.unreachable_joints
            why = "no motion of it moves that joint" if stuck else "it is at a dead point"
            raise InputError(
                f"{name} does not move here while the mechanism does: {why}",
                element="values",
                remedy="Drag another joint" if stuck else "Start next to it, or drag another joint",
            )
        raise InputError(
            f"{', '.join(values)} cannot be dragged independently of each other here",
            element="values",
            remedy=f"Drag at most {basis.shape[1]}, which move independently",
        )
    here = np.array([position_of(mechanism, start.q, name) for name in values])
    ways = np.abs(np.diff(np.vstack([here, wanted]), axis=0)).sum(axis=0) / problem.unit[columns]
    for name, way in zip(values, ways.tolist()):
        if not way <= LONGEST_WAY:
            raise InputError(
                f"the way of {name} through its values is {way:.3g} times "
                f"{'1 rad' if is_angle(mechanism.model, name) else 'the size of the mechanism'}, "
                f"and at most {LONGEST_WAY:g} can be followed",
                element="values",
                remedy="Give values in rad and m, near the start",
            )
    found = drag(problem, start.q, columns, wanted - here, mechanism.structure.rank)

    def named(displacement: FloatArray) -> dict[str, float]:
        return dict(zip(values, (here + displacement).tolist()))

    singular = tuple(PathPoint(named(met.values), met.q, met.loops) for met in found.met)
    limit = None if found.complete else PathPoint(named(found.values[-1]), found.path[-1])
    reached = found.q[1:].copy()
    for k, name in enumerate(values):  # without rounding
        joint = mechanism.joint(name)
        if joint.nq == 1:
            reached[:, joint.idx_q] = wanted[: len(reached), k]
    message = _message(limit, found.turned)
    log.debug("%s: %s", mechanism.name, message)
    return FollowedPath(
        mechanism,
        reached,
        found.complete,
        limit,
        singular,
        found.cosine > BRANCH_COSINE,
        found.path,
        message,
    )


def _message(limit: PathPoint | None, turned: bool) -> str:
    if limit is None:
        return "all values were reached"
    at = ", ".join(f"{name} = {value:.9g}" for name, value in limit.values.items())
    if turned:
        return f"no further than {at}: the path turns back there"
    return f"no further than {at}: the path cannot be followed beyond"
