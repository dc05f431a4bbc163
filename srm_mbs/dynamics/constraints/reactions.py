r"""Reactions of closures and joints, multipliers, and the forces of the drives.

From yhat = M^{-1} G^T lam the multipliers follow as the solution of (L^{-1} G^T) lam = L^T yhat
over all rows whose norm, in the scaled rows, is least.  Singular values beyond the rank of the
solve hold the closure error only and are left out.  The wrench that a exerts on b is C^T lam with
the rows C of the closure taken at b's origin.  A drive exerts -lam on its coordinate.

The wrench that the parent link exerts on the child of a joint is, by the Newton-Euler equations of
the bodies of the child's subtree S,

    f_j = sum over i in S of (I_i a_i + v_i x* I_i v_i - f_i),

with gravity as an acceleration in a_i, and f_i the wrenches of closures and of force elements
between links on the body i.  What acts on the coordinates of a joint (controllers, drives, springs,
damping, friction) acts between parent and child, and so is part of f_j; a rotor (armature) is no
part of the child: its inertia takes its share of the force on the coordinate before the child.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import accumulate
from typing import NamedTuple, Self, cast

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.compiled_rows import ClosureRows
from srm_mbs.dynamics.constraints.projection import cholesky, whiten
from srm_mbs.dynamics.constraints.rheonomic import DrivenKinematics, driven_closures
from srm_mbs.dynamics.constraints.wrenches import (
    Placements,
    about_origin,
    add_between,
    bodies_of,
    moved,
    row_wrenches,
    sums_of_subtrees,
)
from srm_mbs.dynamics.controllers import HeldForce
from srm_mbs.dynamics.forces import resolved_forces
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.errors import KnownKeys
from srm_mbs.model.drives import in_order_of_rows
from srm_mbs.model.mechanism import per_tree

_System = OpenSystem | ClosedSystem
BLOCK = 1024
"""States that are computed at once, so that the placements of long runs do not fill the memory."""


@dataclass(frozen=True, eq=False)
class Reactions:
    """Forces within a mechanism at n states.

    Wrenches are force (N) then moment (N m) in world axes.  Next to a singular configuration
    multipliers grow without bound, as they do in the mechanism, and with them all others.

    Attributes
    ----------
    closures : {loop: (n, 6)}
        Wrench that a exerts on b, at b's origin, of each closure between anchors.
    multipliers : {loop: (n, rows)}
        lam of each closure.
    drives : {drive: (n,)}
        Force (N) or torque (N m) on the driven coordinate in the positive sense.
    joints : {joint: (n, 6)}
        Wrench that the parent link exerts on the child, at the origin of the joint.
    """

    closures: dict[str, FloatArray]
    multipliers: dict[str, FloatArray]
    drives: dict[str, FloatArray]
    joints: dict[str, FloatArray]

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Reactions of the same mechanism at the states of all ``parts``, one after the other."""
        tables = ([getattr(part, field.name) for part in parts] for field in fields(cls))
        return cls(
            *(
                KnownKeys(
                    (name, np.concatenate([own[name] for own in of_parts])) for name in of_parts[0]
                )
                for of_parts in tables
            )
        )


def reactions_at(
    system: _System,
    t: FloatArray,
    q: FloatArray,
    v: FloatArray,
    forces: FloatArray | None = None,
) -> Reactions:
    """The reactions at n states q (n, nq), v (n, nv) at the times t (n,) s.

    With ``forces`` (n, nv), N and N m, the held force of the ``system`` is one of them at each
    state.

    Raises
    ------
    EvaluationError, ControllerError
        If the equations of motion cannot be evaluated at one of them.
    """
    blocks = [slice(i, i + BLOCK) for i in range(0, max(len(t), 1), BLOCK)]
    return Reactions.joined(
        [
            _block(system, t[own], q[own], v[own], None if forces is None else forces[own])
            for own in blocks
        ]
    )


def _block(
    system: _System, t: FloatArray, q: FloatArray, v: FloatArray, held: FloatArray | None
) -> Reactions:
    """:func:`reactions_at`, with all intermediate results in memory at once."""
    mechanism, n = system.mechanism, len(t)
    model = mechanism.model
    closures = [*mechanism.loops, *driven_closures(mechanism.drives)]
    lam = np.zeros((n, sum(closure.rows.count for closure in closures)))
    inertial, loads = np.zeros((2, n, model.njoints, 6))
    placed = Placements.empty(model, n)
    data, forces = workspace(model), resolved_forces(mechanism)
    for i, own, a in _multipliers(system, t, q, v, held):
        if own is not None:
            lam[i] = own
        pin.forwardKinematics(model, data, q[i], v[i])
        placed.take(i, data)
        if forces is not None:
            for one, other, wrench in forces.between_links(data, q[i], v[i], t[i]):
                loads[i, one] += wrench
                loads[i, other] -= wrench
        pin.rnea(model, data, q[i], v[i], a)
        for j, force in enumerate(data.f):
            inertial[i, j] = force.vector
    wrenches = []
    for closure, rows in zip(closures, _names(mechanism).rows):
        if closure.anchors:
            at_b = np.einsum("nrk,nr->nk", row_wrenches(closure, model, placed), lam[:, rows])
            on_b = about_origin(at_b, closure, model, placed)
            add_between(loads, bodies_of(closure, model), on_b)
            wrenches.append(at_b)
    halves = inertial.reshape(n, model.njoints, 2, 3, 1)
    turned = (placed.rotation[:, :, None] @ halves).reshape(inertial.shape)
    joints = turned - moved(sums_of_subtrees(model, loads), placed.origin)
    on_b = np.array(wrenches).reshape(len(wrenches), n, 6)
    return named_reactions(mechanism, lam, on_b, joints)


def named_reactions(
    mechanism: Mechanism, lam: FloatArray, on_b: FloatArray, joints: FloatArray
) -> Reactions:
    """Reactions by name.

    Parameters
    ----------
    lam : (n, rows)
        Multipliers of all rows, those of drives last.
    on_b : (closures, n, 6)
        Wrenches on b of the closures between anchors, those of drives last.
    joints : (n, njoints, 6)
        Wrenches on the children.
    """
    names = _names(mechanism)
    multipliers = [lam[:, own] for own in names.rows]
    driven = multipliers[len(names.loops) :]
    return Reactions(
        KnownKeys(zip(names.between, on_b)),
        KnownKeys(zip(names.loops, multipliers)),
        KnownKeys((drive, -own[:, 0]) for drive, own in zip(names.drives, driven)),
        KnownKeys(zip(mechanism.joint_names, joints.transpose(1, 0, 2)[1:])),
    )


class _Names(NamedTuple):
    """Names of the loops, of those between anchors, and of the drives, and the rows of both."""

    loops: list[str]
    between: list[str]
    drives: list[str]
    rows: list[slice]


@per_tree
def _names(mechanism: Mechanism) -> _Names:
    loops, drives = mechanism.loops, mechanism.drives
    counts = [closure.rows.count for closure in (*loops, *driven_closures(drives))]
    return _Names(
        [loop.name for loop in loops],
        [loop.name for loop in loops if loop.anchors],
        [drive.name for drive in in_order_of_rows(drives)],
        [slice(end - own, end) for own, end in zip(counts, accumulate(counts))],
    )


def _multipliers(
    system: _System, t: FloatArray, q: FloatArray, v: FloatArray, held: FloatArray | None
) -> Iterator[tuple[int, FloatArray | None, FloatArray]]:
    """Number of the state, lam (rows,) of all rows, unscaled, None for a mechanism without
    effective closures, and the acceleration v' (nv,)."""
    mechanism, n = system.mechanism, len(t)
    model = mechanism.model
    accelerations, ranks = np.empty((n, model.nv)), np.zeros(n, dtype=int)
    multipliers = np.empty((n, model.nv))
    closed = system.has_constraints
    for i in range(n):
        if held is not None:
            cast(HeldForce, system.held).only(held[i])
        terms = system.evaluate(t[i], np.concatenate([q[i], v[i]]))
        accelerations[i] = terms.rate()[model.nv :]
        if closed:
            multipliers[i], ranks[i] = terms.multiplier(), terms.rank
    found = _unscaled(mechanism, q, multipliers, ranks) if closed else [None] * n
    yield from zip(range(n), found, accelerations)


def _unscaled(
    mechanism: Mechanism, q: FloatArray, multipliers: FloatArray, ranks: IndexArray
) -> FloatArray:
    """lam (n, rows), of least norm, with E^T lam the ``multipliers`` (n, nv) of rows of these
    ``ranks`` (n,)."""
    model, scale = mechanism.model, mechanism.structure.row_scale
    rows = ClosureRows(model, DrivenKinematics(model, mechanism.loops, mechanism.drives))
    data = workspace(model)
    U = np.empty((len(q), model.nv, model.nv))
    W = np.empty((len(q), model.nv, len(scale)))
    for i in range(len(q)):
        rows.evaluate(q[i])
        U[i] = cholesky(pin.crba(model, data, q[i]))
        W[i] = whiten(U[i], (rows.G / scale[:, None]).T)
    left, singular, right = np.linalg.svd(W, full_matrices=False)
    white = np.einsum("nij,nj->ni", np.triu(U), multipliers)
    parts = np.einsum("nik,ni->nk", left, white)
    used = np.arange(singular.shape[1]) < ranks[:, None]
    shares = np.divide(parts, singular, out=np.zeros_like(parts), where=used)
    lam: FloatArray = np.einsum("nk,nkr->nr", shares, right) / scale
    return lam
