"""Degrees of freedom by Gruebler's count and by the rank; redundant rows, stuck and idle joints.

The analysis uses the initial configuration and others of random walks on the closure manifold, as
far as the closures have their structural rank there: single configurations may be singular.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry, DriveRows
from srm_mbs.dynamics.constraints.rheonomic import driven_closures
from srm_mbs.dynamics.constraints.row_algebra import null_basis
from srm_mbs.dynamics.constraints.rows import world_jacobian
from srm_mbs.dynamics.constraints.structure import ManifoldSampler, row_names, structure_of
from srm_mbs.dynamics.constraints.wrenches import (
    Placements,
    about_origin,
    add_between,
    bodies_of,
    moved,
    row_wrenches,
    sums_of_subtrees,
)
from srm_mbs.dynamics.scaling import constraint_units
from srm_mbs.model.mechanism import MechanismData, per_model

RESTARTS = 4
STEPS = 4
RANK = 1e-7
"""Singular value of normalised rows, and rate in units, below which it counts as zero."""
DETERMINED = 1e-8
"""Part of a row's square norm outside the row space below which its multiplier is unique."""

COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
"""Names of the components of a wrench."""


@dataclass(frozen=True)
class IdleMotion:
    """A joint that moves without moving a loop, all others at rest.

    Attributes
    ----------
    joints
        The joint; several where massless links between them make them one.
    directions
        How many of its degrees of freedom are idle.
    """

    joints: tuple[str, ...]
    directions: int


@dataclass(frozen=True)
class Mobility:
    """Degrees of freedom of a mechanism without its drives, by Gruebler's count and by the rank.

    Attributes
    ----------
    joint_freedoms, rows
        nv, and the number of closure rows.
    gruebler
        Count nv - rows, as in space.
    planar_gruebler
        That count with the rows that act in the plane; None if the mechanism is not planar.
    rank, degrees_of_freedom
        Structural rank of the rows, and nv minus it.
    redundant_rows
        Rows that are zero in every closed configuration; left out of the solve.
    pivoted_redundancy
        Number of further redundant rows, which pivoting leaves out at every evaluation.
    indeterminate_rows
        Rows, ``loop.row`` or the name of a drive, whose multipliers equilibrium does not
        determine: redundant ones, and those that depend on each other.  Reactions give the values
        of least norm.
    indeterminate_joints
        Components of what the joints of the tree carry that depend on these multipliers:
        ``joint.fx`` to ``joint.mz``, force and moment along the axes of the world.
    unreachable_joints
        Joints that no motion of the mechanism moves.
    idle
        Motions of one joint that move no loop, such as the spin of a rod between two ball joints.
        Empty without loops.
    """

    joint_freedoms: int
    rows: int
    gruebler: int
    planar_gruebler: int | None
    rank: int
    degrees_of_freedom: int
    redundant_rows: tuple[str, ...]
    pivoted_redundancy: int
    indeterminate_rows: tuple[str, ...]
    indeterminate_joints: tuple[str, ...]
    unreachable_joints: tuple[str, ...]
    idle: tuple[IdleMotion, ...]


@per_model
def mobility(mechanism: MechanismData) -> Mobility:
    """The degrees of freedom of ``mechanism`` without its drives.

    Raises
    ------
    EvaluationError
        If the mass matrix is not positive definite.
    """
    driven, mechanism = mechanism, mechanism.undriven
    structure = structure_of(mechanism)
    nv, rows, rank = mechanism.model.nv, len(structure.row_names), structure.rank
    samples = _samples(mechanism)
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    compounds = _compounds(mechanism)
    names = row_names(driven)
    undetermined = np.zeros(len(names))
    free: list[tuple[FloatArray, FloatArray]] = []
    rates = np.zeros(nv)
    idle = [len(columns) for _, columns in compounds]
    for q in samples if names else ():
        G = geometry.normalised(q) if rows else np.zeros((0, nv))
        null = null_basis(G, RANK)
        if nv - null.shape[1] != rank:
            continue
        np.maximum(rates, np.linalg.norm(null, axis=1), out=rates)
        for k, (_, columns) in enumerate(compounds):
            if not idle[k]:
                continue
            moved = int(np.sum(np.linalg.svd(G[:, columns], compute_uv=False) > RANK))
            idle[k] = min(idle[k], len(columns) - moved)
        if driven.drives:
            G = np.vstack([G, DriveRows(driven, geometry, q).rows])
        dependent = null_basis(G.T, RANK)
        if len(G) - dependent.shape[1] == structure_of(driven).rank:
            np.maximum(undetermined, (dependent**2).sum(axis=1), out=undetermined)
            free.append((q, dependent))
    loaded = _carried_by_joints(driven, geometry, free)
    return Mobility(
        joint_freedoms=nv,
        rows=rows,
        gruebler=nv - rows,
        planar_gruebler=nv - int(structure.kept.sum()) if _planar(mechanism, samples) else None,
        rank=rank,
        degrees_of_freedom=nv - rank,
        redundant_rows=structure.redundant_rows,
        pivoted_redundancy=structure.pivoted_redundancy if rows else 0,
        indeterminate_rows=tuple(n for n, u in zip(names, undetermined) if u > DETERMINED),
        indeterminate_joints=tuple(
            f"{name}.{part}"
            for name in mechanism.joint_names
            for part, size in zip(COMPONENTS, loaded[mechanism.model.getJointId(name)])
            if size > RANK
        ),
        unreachable_joints=_unreachable(mechanism, rates) if rows else (),
        idle=tuple(
            IdleMotion(joints, count) for (joints, _), count in zip(compounds, idle) if count
        )
        if rows
        else (),
    )


def _carried_by_joints(
    mechanism: MechanismData,
    geometry: ClosureGeometry,
    found: list[tuple[FloatArray, FloatArray]],
) -> FloatArray:
    """Largest components (njoints, 6) of the loads of the joints under multipliers that are in
    equilibrium by themselves, over the largest of all joints.

    ``found``: configurations with such multipliers, (rows, k) of the normalised rows.
    """
    model = mechanism.model
    largest = np.zeros((model.njoints, 6))
    if not any(dependent.size for _, dependent in found):
        return largest
    # Normalised rows are divided by their unit and their size, and so are their multipliers.
    size = constraint_units(mechanism, geometry.units).copy()
    size[: len(geometry.row_size)] *= geometry.row_size
    placed = Placements.at(model, workspace(model), np.array([q for q, _ in found]))
    anchored = []
    end = 0
    for closure in (*mechanism.loops, *driven_closures(mechanism.drives)):
        own = slice(end, end + closure.rows.count)
        end = own.stop
        if closure.anchors:
            on_b = row_wrenches(closure, model, placed)
            rows = about_origin(on_b, closure, model, placed)
            anchored.append((own, bodies_of(closure, model), rows))
    for k, (_, dependent) in enumerate(found):
        multipliers = dependent / size[:, None]
        loads = np.zeros((dependent.shape[1], model.njoints, 6))
        for own, bodies, rows in anchored:
            add_between(loads, bodies, multipliers[own].T @ rows[k])
        whole = moved(sums_of_subtrees(model, loads), placed.origin[k])[:, 1:]
        whole[..., 3:] /= geometry.units.length
        sizes = np.linalg.norm(whole, axis=0)
        np.maximum(largest[1:], sizes / (sizes.max() or 1.0), out=largest[1:])
    return largest


def _samples(mechanism: MechanismData) -> list[FloatArray]:
    """The initial configuration, and closed ones around it."""
    samples = [np.array(mechanism.q0)]
    structure = structure_of(mechanism)
    if structure.rank:
        sampler = ManifoldSampler(mechanism, structure.units)
        samples += sampler.walk(samples[0], np.random.default_rng(1), RESTARTS, STEPS)
    return samples


def _unreachable(mechanism: MechanismData, rates: FloatArray) -> tuple[str, ...]:
    """The joints all of whose ``rates`` (nv,) are zero."""
    joints = [(name, mechanism.joint(name)) for name in mechanism.joint_names]
    return tuple(name for name, j in joints if not (rates[j.idx_v : j.idx_v + j.nv] > RANK).any())


def _compounds(mechanism: MechanismData) -> list[tuple[tuple[str, ...], IndexArray]]:
    """Joints with their velocity components; those that massless links make one are joined.

    A ball joint is often described as three hinges.  A link between them must be held by nothing
    else: no closure, no other joint.
    """
    model = mechanism.model
    anchored = {anchor.resolve(model)[0] for loop in mechanism.loops for anchor in loop.anchors}
    coupled = {name for loop in mechanism.loops for name in loop.joints or ()}
    children = [list(model.parents).count(k) for k in range(model.njoints)]
    out: list[tuple[list[str], list[int]]] = []
    where: dict[int, int] = {}
    for k in range(1, model.njoints):
        joint, parent, name = model.joints[k], int(model.parents[k]), model.names[k]
        own = list(range(joint.idx_v, joint.idx_v + joint.nv))
        inertia = model.inertias[parent]
        joins = (
            parent > 0
            and inertia.mass == 0.0
            and not inertia.inertia.any()
            and parent not in anchored
            and children[parent] == 1
            and not {name, model.names[parent]} & coupled
        )
        if joins:
            where[k] = where[parent]
            names, columns = out[where[k]]
            names.append(name)
            columns += own
        else:
            where[k] = len(out)
            out.append(([name], own))
    return [(tuple(names), np.array(columns)) for names, columns in out]


def _planar(mechanism: MechanismData, samples: list[FloatArray]) -> bool:
    """Whether all links move parallel to one plane."""
    model = mechanism.model
    data = workspace(model)
    turns, shifts = [], []
    for q in samples[:: max(1, len(samples) - 1)]:
        pin.computeJointJacobians(model, data, q)
        J = world_jacobian(data)
        for shift, turn in zip(J[:3].T, J[3:].T):
            size = np.linalg.norm(turn)
            if size > RANK:
                turns.append(turn / size)
                shifts.append(shift / max(1.0, float(np.linalg.norm(shift))))
            else:
                shifts.append(shift / np.linalg.norm(shift))
    if not turns:
        return bool(np.linalg.matrix_rank(np.array(shifts), tol=RANK) < 3)
    normal = turns[0]
    parallel = np.abs(np.cross(np.array(turns), normal)).max() < RANK
    return bool(parallel and np.abs(np.array(shifts) @ normal).max() < RANK)
