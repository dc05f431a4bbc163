"""Diagnosis of loops that do not close: their residuals, and the held joints or limits that
prevent it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.assembly.continuation import CLOSE, drag
from srm_mbs.assembly.position import ClosureProblem, assemble_positions, beyond_limits
from srm_mbs.dynamics.constraints.local_coordinates import tangent_basis
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import is_angle
from srm_mbs.dynamics.singularities.local_analysis import SINGULAR, smallest_singular_value
from srm_mbs.errors import AssemblyError
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.coordinates import free_coordinates, joint_coordinates, position_of


def quoted(names: Iterable[str]) -> str:
    """The names in quotes, with commas."""
    return ", ".join(repr(name) for name in names)


def _rounded(value: float) -> float:
    """A position (m, rad) for a message: what is below the rounding of closures is zero."""
    return round(value, 12) + 0.0  # without the sign of a zero


def _described(loop_residuals: Mapping[str, tuple[float | None, float | None]]) -> str:
    parts = []
    for name, (gap, angle) in loop_residuals.items():
        values = [] if gap is None else [f"{_rounded(gap):.3g} m"]
        values += [] if angle is None else [f"{_rounded(angle):.3g} rad"]
        parts.append(f"{name}: {', '.join(values)}")
    return "; ".join(parts)


PARALLEL_TOLERANCE = 1e-6
"""Sine of the angle between axes that are parallel."""
CORRECT_AXIS = "Correct that axis, or the rotation of the place of its joint or closure in the link"
HINGES_OF_A_LOOP = 3
"""Least number of hinges from which the direction of most is known."""


def _hinge_of_closure(
    loop: LoopClosure, data: pin.Data, anchors: Iterable[tuple[int, pin.SE3]]
) -> FloatArray | None:
    """The axis (3,), a unit vector in the world, about which a closure of the type ``revolute``
    turns; None for other types, or where the two links do not agree about it."""
    if loop.type != "revolute" or loop.axis is None:
        return None
    axis = np.array(loop.axis) / np.linalg.norm(loop.axis)
    a, b = (data.oMi[joint].rotation @ place.rotation @ axis for joint, place in anchors)
    return b if np.linalg.norm(np.cross(a, b)) <= PARALLEL_TOLERANCE else None


def inclined_axes(mechanism: Mechanism) -> dict[str, str]:
    """Hinges, joints or the closure, whose axis, with all joints at zero, is inclined to those of
    the other hinges of a loop, which are parallel: the element -> a clause that says so.

    Loops that may move with axes in any direction are left out: those with more joints than rows,
    or with joints of several degrees of freedom.
    """
    model = mechanism.model
    data = workspace(model)
    pin.computeJointJacobians(model, data, pin.neutral(model))
    axes = np.array(data.J).reshape(6, -1)[3:].T
    found = {}
    for loop in mechanism.loops:
        if not loop.anchors:
            continue
        anchors = loop.resolve(model)
        a, b = (set(model.supports[joint].tolist()) for joint, _ in anchors)
        joints = sorted(a ^ b)
        if len(joints) > loop.rows.count or any(model.joints[joint].nv > 1 for joint in joints):
            continue
        turning = [(model.names[joint], axes[model.joints[joint].idx_v]) for joint in joints]
        hinges = [(name, axis) for name, axis in turning if axis.any()]
        closing = _hinge_of_closure(loop, data, anchors)
        if closing is not None:
            hinges.append((loop.name, closing))
        if len(hinges) < HINGES_OF_A_LOOP:
            continue
        directions = np.array([axis for _, axis in hinges])
        across = np.linalg.norm(np.cross(directions[None], directions[:, None]), axis=2)
        apart = across > PARALLEL_TOLERANCE
        odd = np.flatnonzero(apart.sum(axis=1) == len(hinges) - 1)
        if len(odd) != 1 or np.delete(np.delete(apart, odd, 0), odd, 1).any():
            continue
        others = [k for k in range(len(hinges)) if k != odd[0]]
        angle = np.degrees(np.arcsin(min(across[odd[0], others[0]], 1.0)))
        name, axis = hinges[odd[0]]
        of_closure = axis is closing
        element = f"{'loop' if of_closure else 'joint'} {name!r}"
        found[element] = (
            f"in the loop {loop.name!r} the axis of the {'closure' if of_closure else element} is "
            f"inclined by {angle:.3g} degrees to those of {quoted(hinges[k][0] for k in others)}, "
            "which are parallel"
        )
    return found


def cannot_close(
    mechanism: Mechanism,
    problem: ClosureProblem,
    start: FloatArray,
    held: tuple[str, ...],
    q: FloatArray,
) -> AssemblyError:
    """The error about loops that do not close from ``start`` with ``held`` joints.

    ``q`` (nq,) is the closest configuration that was found.
    """
    loop_residuals = problem.loop_residuals(q)
    remaining = f"remaining gaps: {_described(loop_residuals)}"
    if inclined := inclined_axes(mechanism):
        return AssemblyError(
            f"{'; '.join(inclined.values())}: the loops cannot be closed; {remaining}",
            residuals=loop_residuals,
            q=q,
            element=next(iter(inclined)),
            remedy=CORRECT_AXIS,
        )
    closings = {}
    for name in held:
        others = tuple(other for other in held if other != name)
        closed = assemble_positions(problem, start, free_coordinates(mechanism, others))
        if problem.closed(closed):
            closings[name] = closed
    guilty = tuple(closings)
    if not guilty and len(held) > 1:
        everything_free = assemble_positions(problem, start, free_coordinates(mechanism, ()))
        guilty = held if problem.closed(everything_free) else ()
    if not guilty:
        return AssemblyError(
            f"the loops cannot be closed from this guess; {remaining}",
            residuals=loop_residuals,
            q=q,
            element="initial.guess",
            remedy="Check the anchors and link lengths, or give a guess closer to a closed "
            "configuration; the closest one found is in the error's q",
        )
    nearest = {
        name: value
        for name, closed in closings.items()
        if (value := _nearest(mechanism, problem, start, closed, name, held)) is not None
    }
    remedy = "Free some of them: leave them out, or give them as guesses"
    if len(guilty) < len(held) or len(held) == 1:
        remedy = f"Change or free one of {quoted(guilty)}: with it free, the loops close"
    if nearest:
        values = ", ".join(
            f"{name} = {_rounded(value):.9g} {'rad' if is_angle(mechanism.model, name) else 'm'}"
            for name, value in nearest.items()
        )
        remedy += f"; nearest values that close, one at a time: {values}"
    return AssemblyError(
        f"the loops cannot close with the held values of {quoted(held)}; {remaining}",
        residuals=loop_residuals,
        q=q,
        held=guilty,
        nearest=nearest,
        element="initial.q",
        remedy=remedy,
    )


def _nearest(
    mechanism: Mechanism,
    problem: ClosureProblem,
    start: FloatArray,
    closed: FloatArray,
    name: str,
    held: tuple[str, ...],
) -> float | None:
    """The position of joint ``name`` nearest to that in ``start`` with which the loops close.

    Dragged there from ``closed``, where it was free; None for a joint of several degrees of
    freedom, or where branches meet.
    """
    if mechanism.joint(name).nv != 1:
        return None
    here = position_of(mechanism, closed, name)
    columns = joint_coordinates(mechanism, (name, *(other for other in held if other != name)))
    rank = mechanism.structure.loop_rank
    if smallest_singular_value(problem, closed, rank) < CLOSE:
        return None
    basis, _ = tangent_basis(problem, closed, np.arange(problem.model.nv))
    if np.linalg.matrix_rank(basis[columns], tol=SINGULAR) < len(columns):
        return here  # the other held joints leave it no choice
    target = np.zeros((1, len(columns)))
    target[0, 0] = position_of(mechanism, start, name) - here
    end = drag(problem, closed, columns, target, rank)
    return here + float(end.values[-1, 0])


def limits_in_the_way(
    mechanism: Mechanism, problem: ClosureProblem, held: tuple[str, ...], q: FloatArray
) -> AssemblyError:
    """The error about loops that close at ``q`` (nq,), but nowhere within the joint limits."""
    beyond = beyond_limits(mechanism, q)
    parts = [f"{name} at {at:.6g}, limit {limit:.6g}" for name, (at, limit) in beyond.items()]
    return AssemblyError(
        f"the loops close, but not within the limits of {quoted(beyond)}: {'; '.join(parts)}",
        residuals=problem.loop_residuals(q),
        q=q,
        held=tuple(name for name in held if name in beyond),
        limits=tuple(beyond),
        element="limits",
        remedy="Widen these limits, change the held values, or give a guess on another branch",
    )
