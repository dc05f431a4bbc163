"""Units of coordinates, rows and rates.

Tolerances and rules for steps count in these units, so that the same mechanism in millimetres, with
other masses or on another time scale, takes the same steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import scratch, workspace
from srm_mbs._typing import BoolArray, FloatArray, IndexArray
from srm_mbs.dynamics.constraints.projection import cholesky, unwhiten, whiten
from srm_mbs.dynamics.constraints.rheonomic import driven_closures
from srm_mbs.dynamics.constraints.rows import world_jacobian
from srm_mbs.dynamics.forces import resolved_forces
from srm_mbs.errors import EvaluationError
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_model, per_start, per_tree
from srm_mbs.model.model_data import TreeNumbers, tree_numbers

RELATIVE_ROUNDING = 1e-12
"""Accelerations below this part of the largest are rounding of zero; so is a scene diagonal below
this part of the distance from the origin, or of the largest radius of gyration."""


@dataclass(frozen=True, eq=False)
class Units:
    """Characteristic sizes of a mechanism.

    Attributes
    ----------
    length
        Scene diagonal (m): bounding box of joints, centres of mass and anchors at q0; 1 where they
        are all at one point.
    coordinate : (nv,)
        1 rad for angles, ``length`` for translations.
    rate
        Characteristic rate (1/s): sqrt(g / length); without gravity the median of the initial
        rates over their units, as far as they are not zero; at rest that of sqrt(|a| / unit), with
        the accelerations a that the force elements give the open tree; 1 if there are none.  A
        median, so that a fast rotor does not loosen the tolerances of the slow coordinates.
    """

    length: float
    coordinate: FloatArray
    rate: float

    @cached_property
    def state(self) -> FloatArray:
        """Units (2 nv,) of positions, then of rates."""
        return np.concatenate([self.coordinate, self.coordinate * self.rate])


@per_model
def row_angles(mechanism: MechanismData) -> BoolArray:
    """Which closure rows (rows,) are in rad; the others are in m.

    Joint rows are in the unit of their first joint.
    """
    return _angles(mechanism.model, mechanism.loops)


KEPT_UNITS = 64
"""Configurations whose units a mechanism keeps at most."""


def constraint_angles(mechanism: MechanismData) -> BoolArray:
    """Which rows (rows,) are in rad, those of the drives after those of the loops."""
    driven = _angles(mechanism.model, driven_closures(mechanism.drives))
    return np.concatenate([row_angles(mechanism), driven])


def _angles(model: pin.Model, closures: Sequence[LoopClosure]) -> BoolArray:
    out: list[bool] = []
    for closure in closures:
        lengths, alignments, _ = closure.rows.blocks
        out += [False] * lengths.stop + [True] * (alignments.stop - alignments.start)
        out += [is_angle(model, row.joints[0]) for row in closure.rows.joint_rows]
    return np.array(out, dtype=bool)


def is_angle(model: pin.Model, name: str) -> bool:
    """Whether the coordinate of a joint with one degree of freedom is an angle."""
    return bool(angle_coordinates(model)[model.joints[model.getJointId(name)].idx_v])


def angle_coordinates(model: pin.Model) -> BoolArray:
    """Which velocity components (nv,) are in rad/s; the others are in m/s."""
    data = workspace(model)
    pin.computeJointJacobians(model, data, pin.neutral(model))
    return _angle_components(data)


@per_tree
def rotating_coordinates(mechanism: MechanismData) -> list[int]:
    """The velocity components that are in rad/s."""
    return np.flatnonzero(angle_coordinates(mechanism.model)).tolist()


def periodic_coordinates(model: pin.Model) -> BoolArray:
    """Which velocity components (nv,) belong to angles that count turns in q, while a whole turn
    leads back to the same place: those of hinges and universal joints, not those of screws."""
    out: BoolArray = np.zeros(model.nv, dtype=bool)
    joints = [(i, joint) for i, joint in enumerate(model.joints) if i and joint.nq == joint.nv]
    turning = angle_coordinates(model)
    data = workspace(model)
    start = pin.neutral(model)
    pin.forwardKinematics(model, data, start)
    before = {i: data.liMi[i].copy() for i, _ in joints}
    for k in range(max((joint.nv for _, joint in joints), default=0)):  # one of each at a time
        q = start.copy()
        moved = [(i, joint.idx_v + k) for i, joint in joints if k < joint.nv]
        q[[model.joints[i].idx_q + k for i, _ in moved]] += 2.0 * np.pi
        pin.forwardKinematics(model, data, q)
        for i, component in moved:
            out[component] = turning[component] and data.liMi[i].isApprox(before[i], 1e-9)
    return out


@per_tree
def vector_coordinates(mechanism: MechanismData) -> IndexArray:
    """Index into q of each velocity component (nv,), -1 where q is not a vector space there."""
    index = np.full(mechanism.model.nv, -1)
    for joint in mechanism.model.joints.tolist()[1:]:
        if joint.nq == joint.nv:
            index[joint.idx_v : joint.idx_v + joint.nv] = range(joint.idx_q, joint.idx_q + joint.nq)
    return index


class PositionRounding(NamedTuple):
    """How closely the joint coordinates of a configuration are known.

    Attributes
    ----------
    relative
        The largest distance of a coordinate from the next floating-point number, over its unit.
    coordinate
        Its velocity index; -1 without coordinates that are numbers.
    position
        The coordinate itself, in rad or m.
    """

    relative: float
    coordinate: int
    position: float

    @property
    def absolute(self) -> float:
        """The distance itself, in rad or m."""
        return float(np.spacing(abs(self.position)))


def position_rounding(mechanism: MechanismData, q: FloatArray) -> PositionRounding:
    """The rounding of the :func:`vector_coordinates` of q (nq,), in the units at the start of
    ``mechanism``.

    Those of planar and free joints do not count: where a body is that hangs on nothing does not
    change how it moves.
    """
    in_q, in_v, unit = _scalars(mechanism)
    if not len(in_q):
        return PositionRounding(0.0, -1, 0.0)
    relative = np.spacing(np.abs(q[in_q])) / unit
    worst = int(relative.argmax())
    return PositionRounding(float(relative[worst]), int(in_v[worst]), float(q[in_q[worst]]))


@per_start
def _scalars(mechanism: MechanismData) -> tuple[IndexArray, IndexArray, FloatArray]:
    """Indices into q and into v of the :func:`vector_coordinates`, and their units."""
    place = vector_coordinates(mechanism)
    in_v = np.flatnonzero(place >= 0)
    return (
        place[in_v],
        in_v,
        coordinate_units(mechanism, mechanism.q0, mechanism.v0).coordinate[in_v],
    )


@per_start
def start_rounding(mechanism: MechanismData) -> PositionRounding:
    """:func:`position_rounding` of the initial positions."""
    return position_rounding(mechanism, mechanism.q0)


def row_dimensions(mechanism: MechanismData) -> tuple[str, ...]:
    """Units that closure errors have, drives included: "m", "rad" or both, in this order."""
    angles = constraint_angles(mechanism)
    return tuple(unit for unit, own in (("m", ~angles), ("rad", angles)) if own.any())


def _angle_components(data: pin.Data) -> BoolArray:
    """Which velocity components (nv,) turn something, by the Jacobian in ``data``."""
    out: BoolArray = np.abs(world_jacobian(data)[3:]).max(axis=0) > 1e-9
    return out


def row_units(mechanism: MechanismData, units: Units) -> FloatArray:
    """Units of the closure rows (rows,): the scene diagonal (m) for lengths, 1 rad for alignments.

    A joint row is as large as its largest term, |c_i| times the unit of joint i, so that neither
    the rounding of a large ratio nor the pitch of a screw makes it impossible to close.  Closure
    errors over these are pure numbers, independent of the unit of length.
    """
    count = sum(loop.rows.count for loop in mechanism.loops)
    return constraint_units(mechanism, units)[:count]


def constraint_units(mechanism: MechanismData, units: Units) -> FloatArray:
    """Units of all rows (rows,), those of the drives after those of the loops; read-only."""
    known = _known_row_units(mechanism)
    if units not in known:
        closures = [*mechanism.loops, *driven_closures(mechanism.drives)]
        found = _units_of(closures, mechanism.model, units)
        found.setflags(write=False)
        if len(known) >= KEPT_UNITS:
            known.clear()
        known[units] = found
    return known[units]


@per_model
def _known_row_units(mechanism: MechanismData) -> dict[Units, FloatArray]:
    """Units of all rows, by the units that they follow from."""
    return {}


def _units_of(closures: Sequence[LoopClosure], model: pin.Model, units: Units) -> FloatArray:
    out: list[float] = []
    for closure in closures:
        lengths, alignments, _ = closure.rows.blocks
        out += [units.length] * lengths.stop + [1.0] * (alignments.stop - alignments.start)
        for row in closure.rows.joint_rows:
            joints = (model.joints[model.getJointId(name)] for name in row.joints)
            terms = zip(row.coefficients, joints)
            out.append(max(abs(c) * float(units.coordinate[j.idx_v]) for c, j in terms))
    return np.array(out)


@per_model
def _known_units(mechanism: MechanismData) -> dict[tuple[bytes, bytes], Units]:
    """Units with gravity, which do not depend on v, by gravity and q."""
    return {}


def coordinate_units(mechanism: MechanismData, q: FloatArray, v: FloatArray) -> Units:
    """Units of ``mechanism`` at the configuration q (nq,) and velocity v (nv,)."""
    gravity = mechanism.model.gravity.linear
    if not any(gravity.tolist()):
        return _units_at(mechanism, q, v)
    known, key = _known_units(mechanism), (gravity.tobytes(), q.tobytes())
    if key not in known:
        _keep_units(mechanism, key, _units_at(mechanism, q, v))
    return known[key]


def keep_units(mechanism: MechanismData, q: FloatArray, diagonal: float) -> None:
    """Take the units at q (nq,) from now on from the ``diagonal`` (m) of the scene there, which the
    kernel computed; they are asked for again where they depend on rates."""
    gravity = mechanism.model.gravity.linear.tobytes()
    size = _norm(gravity)
    if size == 0.0:
        return
    length = diagonal or 1.0
    coordinate = np.full(mechanism.model.nv, length)
    coordinate[rotating_coordinates(mechanism)] = 1.0
    units = Units(length, coordinate, math.sqrt(size / length))
    _keep_units(mechanism, (gravity, q.tobytes()), units)


def _keep_units(mechanism: MechanismData, key: tuple[bytes, bytes], units: Units) -> None:
    known = _known_units(mechanism)
    if len(known) >= KEPT_UNITS:
        known.clear()
    known[key] = units


@lru_cache(maxsize=KEPT_UNITS)
def _norm(vector: bytes) -> float:
    """Norm of a vector, from its bytes: variants have the same gravity."""
    return float(np.linalg.norm(np.frombuffer(vector)))


def _units_at(mechanism: MechanismData, q: FloatArray, v: FloatArray) -> Units:
    model = mechanism.model
    data = scratch(model)
    pin.computeJointJacobians(model, data, q)
    length = _diagonal(mechanism, data) or 1.0
    coordinate = np.where(_angle_components(data), 1.0, length)
    rate = math.sqrt(_norm(model.gravity.linear.tobytes()) / length)
    if rate == 0.0:
        rates = np.abs(v) / coordinate
        if not rates.any() and mechanism.forces:
            pulled = np.abs(_acceleration_by_forces(mechanism, q)) / coordinate
            rates = np.sqrt(np.where(pulled > RELATIVE_ROUNDING * pulled.max(), pulled, 0.0))
        rates = rates[rates > 0.0]
        rate = float(np.median(rates)) if rates.size else 1.0
    return Units(length, coordinate, rate)


def scene_diagonal(mechanism: MechanismData, q: FloatArray) -> float:
    """Diagonal (m) of the bounding box of joints, centres of mass and anchors at q (nq,); 0 where
    they are all at one point, up to rounding."""
    data = workspace(mechanism.model)
    pin.forwardKinematics(mechanism.model, data, q)
    return _diagonal(mechanism, data)


def _diagonal(mechanism: MechanismData, data: pin.Data) -> float:
    """:func:`scene_diagonal` at the placements of ``data``."""
    joints, points = _marked_points(mechanism)
    places = np.array([place.homogeneous for place in data.oMi.tolist()])[joints]
    # Without BLAS, which rounds differently on different processors: as the kernel does.
    corners = places[:, :3, 3] + (places[:, :3, :3] * points[:, None]).sum(axis=2)
    diagonal = math.sqrt(np.square(corners.max(axis=0) - corners.min(axis=0)).sum())
    farthest = float(np.abs(corners).max())
    known_to = RELATIVE_ROUNDING * max(farthest, _gyration(mechanism))
    return diagonal if diagonal > known_to else 0.0


@per_model
def _gyration(mechanism: MechanismData) -> float:
    """The largest radius of gyration (m) of a body about its centre of mass."""
    squares = [body.trace / body.mass for body in body_numbers(mechanism) if body.mass > 0.0]
    return float(np.sqrt(max(squares, default=0.0)))


class BodyNumbers(NamedTuple):
    """Mass (kg), centre of mass (3,) m in the axes of its joint, and trace of the inertia about it
    (kg m^2) of a body."""

    mass: float
    lever: list[float]
    trace: float


@per_model
def numbers_of_tree(mechanism: MechanismData) -> TreeNumbers:
    """The numbers of its model, which the analyses of a load share."""
    return tree_numbers(mechanism.model)


@per_model
def body_numbers(mechanism: MechanismData) -> list[BodyNumbers]:
    """Those of the bodies of all joints, the ground's first."""
    return [
        # Lumping and shifting may round the trace of a point mass to a negative number.
        BodyNumbers(mass, lever, max(xx + yy + zz, 0.0))
        for mass, *lever, xx, _, _, yy, _, zz in numbers_of_tree(mechanism).bodies.tolist()
    ]


@per_model
def _marked_points(mechanism: MechanismData) -> tuple[IndexArray, FloatArray]:
    """Joints (k,) and points (k, 3) in their axes: the joints themselves, centres of mass, and
    anchors of closures."""
    bodies = enumerate(islice(body_numbers(mechanism), 1, None), 1)
    origin = [0.0, 0.0, 0.0]
    found = [(joint, origin) for joint in range(1, mechanism.model.njoints)]
    found += [(joint, body.lever) for joint, body in bodies if body.mass > 0.0]
    found += anchor_points(mechanism)
    found = found or [(0, origin)]
    return np.array([joint for joint, _ in found]), np.array([point for _, point in found])


@per_model
def anchor_points(mechanism: MechanismData) -> list[tuple[int, list[float]]]:
    """Joint, and origin (3,) in its axes, of every anchor of a closure."""
    closures = [*mechanism.loops, *driven_closures(mechanism.drives)]
    places = [anchor.resolve(mechanism.model) for loop in closures for anchor in loop.anchors]
    return [(joint, placement.translation.tolist()) for joint, placement in places]


def _acceleration_by_forces(mechanism: MechanismData, q: FloatArray) -> FloatArray:
    """M^-1 tau (nv,) of the force elements at rest; zero where they cannot be evaluated."""
    model = mechanism.model
    forces = resolved_forces(mechanism)
    rest = np.zeros(model.nv)
    if forces is None:
        return rest
    data = workspace(model)
    pin.crba(model, data, q, pin.Convention.WORLD)
    pin.nonLinearEffects(model, data, q, rest)
    try:
        tau = forces.generalised(data, q, rest, 0.0)
        U = cholesky(data.M)
    except EvaluationError:  # a run from here reports the fault
        return rest
    return unwhiten(U, whiten(U, tau))
