"""Causes of failures that a reader can act on: controllers that are unstable or no functions of the
state, joints that move no inertia, drives at their dead points, and starts at positions so large
that their rounding exceeds what closures are held to.

A run fails where its steps fail, and says so; these causes come first in its message.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.local_coordinates import ChartPoint, TangentChart, tangent_basis
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import (
    PositionRounding,
    is_angle,
    rotating_coordinates,
    start_rounding,
)
from srm_mbs.dynamics.singularities.critical import CurveThroughSaddle, critical_configuration
from srm_mbs.errors import ControllerError, joined_names, safe_repr
from srm_mbs.integration.messages import FailureCause
from srm_mbs.model.coordinates import free_coordinates, joint_coordinates, position_of
from srm_mbs.model.drives import Drive
from srm_mbs.model.validation import ARTICULATED_INERTIA_TOLERANCE

REVERSALS, RUNAWAY_REVERSALS = 3, 2
"""Samples in a row at which a force grows and changes its sign, from which it counts as one that
excites the motion instead of damping it: in a run that failed, and with rates beyond use."""
RUNAWAY = 100.0
"""Motion between two samples, in units of the coordinates, that no controller samples on purpose:
16 turns of a joint."""
NEAR_DEAD_POINT = 0.05
"""Part of a driven coordinate in the motion of its mechanism, below which it is next to its dead
point; and its largest distance from there, in its unit."""
NARROW_LAYER = 1e-3
"""Width (units) of the layer of a critical configuration up to which the dead point of a drive in
it is that of the hyperbola; in wider ones differences show it."""
NEWTON_STEPS = 20
SLOPE_STEP = 1e-4
"""Step of the difference for the second derivative of a coordinate along the motion."""
FLAT = 1e-9
"""Slope of a coordinate along the motion that is zero."""
IDLE = 1e-5
"""Second derivative of a coordinate, over the largest, along freedoms that do not move it."""
MOVING_PART = 0.1
"""Part of a coordinate in a motion, over the largest, from which its joint takes part."""
COARSE = 1e-10
"""Rounding of a position, over its unit, from which it may be what a run fails by: a hundred times
the largest closure error of a start."""


class HeldForceWatch:
    """Watches forces that are held from sample to sample, as those of a digital controller.

    A gain that is too large for the sample time gives a force that reverses at every sample and
    grows, with rates that grow with it, until no step is short enough.

    Parameters
    ----------
    mechanism
        The mechanism on which they act.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism
        self._unit = mechanism.structure.units.coordinate
        nv = mechanism.model.nv
        self._force, self._reversals = np.zeros(nv), np.zeros(nv, dtype=int)
        self._v = np.zeros(nv)

    def add(self, force: FloatArray, v: FloatArray) -> None:
        """A sample: ``force`` (nv,), N and N m, is held from now on; ``v`` (nv,) are the rates."""
        last = self._force
        grown = (force * last < 0.0) & (np.abs(force) > np.abs(last))
        self._reversals = np.where(grown, self._reversals + 1, 0)
        self._force, self._v = force, v

    def cause(self, interval: float | None = None) -> FailureCause | None:
        """The unstable controller that the last samples show; None if they show none.

        With ``interval`` (s) only one whose rates are beyond use: a joint would move by more than
        :data:`RUNAWAY` until the next sample.
        """
        worst = int(np.argmax(self._reversals))
        if self._reversals[worst] < (REVERSALS if interval is None else RUNAWAY_REVERSALS):
            return None
        moves = np.abs(self._v) / self._unit
        if interval is not None and not moves.max() * interval > RUNAWAY:
            return None
        mechanism = self._mechanism
        force_joint, fast_joint = (_joint_of(mechanism, i) for i in (worst, int(np.argmax(moves))))
        torque = "torque" if self._unit[worst] == 1.0 else "force"
        force = f"{self._force[worst]:.3g}"
        rate = f"{self._v[np.argmax(moves)]:.3g}"
        return FailureCause(
            f"the sampled forces are unstable: the {torque} of the joint {safe_repr(force_joint)} "
            f"grew and changed its sign at each of the last {self._reversals[worst]} samples, to "
            f"{force} {'N m' if torque == 'torque' else 'N'}, and the largest rate is that of "
            f"{safe_repr(fast_joint)}, {rate} {_rate_unit(mechanism, fast_joint)}",
            "Shorten the sample time, or lower the gains of the controller",
        )

    def stop_runaway(self, t: float, interval: float) -> None:
        """End the run at ``t`` (s) if the rates are beyond use.

        Raises
        ------
        ControllerError
            With the :meth:`cause`.
        """
        cause = self.cause(interval)
        if cause is not None:
            raise ControllerError(f"{cause.clause}. {cause.remedy}", t)


def unrepeatable(
    mechanism: Mechanism,
    force: Callable[[float, FloatArray, FloatArray], FloatArray],
    t: float,
    q: FloatArray,
    v: FloatArray,
) -> FailureCause | None:
    """The controller with the ``force`` (nv,) that returns another one when it is called again with
    the same t (s), q (nq,) and v (nv,); None if it does not."""
    try:
        first, second = force(t, q, v), force(t, q, v)
    except ControllerError:
        return None
    worst = int(np.argmax(np.abs(first - second)))
    if first[worst] == second[worst]:
        return None
    return FailureCause(
        "the controller is not a function of t, q and v: called twice there, it returned "
        f"{first[worst]:.3g} and {second[worst]:.3g} for the joint "
        f"{safe_repr(_joint_of(mechanism, worst))}",
        "Give sample_time, with which its force is held between samples",
    )


def _joint_of(mechanism: Mechanism, coordinate: int) -> str:
    """Name of the joint that has the velocity component ``coordinate``."""
    owners = {
        i: name for name in mechanism.joint_names for i in joint_coordinates(mechanism, [name])
    }
    return owners[coordinate]


def _rate_unit(mechanism: Mechanism, joint: str) -> str:
    if mechanism.joint(joint).nv > 1:
        return "(rad/s or m/s)"
    return "rad/s" if is_angle(mechanism.model, joint) else "m/s"


def dead_point(mechanism: Mechanism, t: float, q: FloatArray) -> FailureCause | None:
    """The drive that runs into its dead point at ``t`` (s) and ``q`` (nq,): its joint is at an
    extreme position of the motion that the closures and the other drives leave; None if there is
    none.  Drives that do so together are all at theirs: it is that of the fastest.

    Without this drive the mechanism has the coordinates z.  Newton's method finds dq_drive/dz = 0,
    where the second derivatives show whether that is an extreme; they are zero for idle freedoms,
    such as the spin of a rod between balls.  Rates are those of the laws: that of a joint next to
    its dead point may have lost its sign.
    """
    drives = [drive for drive in mechanism.drives if drive.joint is not None]
    if len(drives) < len(mechanism.drives):
        return None  # rows of driven points are not among those of the closures
    unit = mechanism.structure.units.coordinate
    rates = {name: curve(t)[1] for name, curve in mechanism.drive_curves.items()}

    def speed(drive: Drive) -> float:
        return abs(rates[drive.name] / float(unit[_coordinate_of(mechanism, drive)]))

    for drive in sorted(drives, key=speed, reverse=True):
        turn = _turn_in_layer(mechanism, drive, q) or _turn_of(mechanism, drive, q)
        if turn is not None and rates[drive.name] * turn[1] < 0.0:  # not beyond the dead point
            return _at_dead_point(mechanism, drive, q, *turn)
    return None


def _coordinate_of(mechanism: Mechanism, drive: Drive) -> int:
    return int(joint_coordinates(mechanism, [str(drive.joint)])[0])


def _turn_in_layer(mechanism: Mechanism, drive: Drive, q: FloatArray) -> tuple[float, float] | None:
    """As :func:`_turn_of`, in the layer of a critical configuration; None if there is none, it is
    wide, or the drive is not the only one of a mechanism with one degree of freedom."""
    idle = replace(mechanism, drives=())
    geometry, own = ClosureGeometry(idle, q), _coordinate_of(mechanism, drive)
    rank = idle.structure.rank
    if len(mechanism.drives) > 1 or len(geometry.unit) - rank != 1:
        return None
    try:
        critical = critical_configuration(geometry, rank, q, NEAR_DEAD_POINT)
        if critical is None:
            return None
        curve = CurveThroughSaddle(critical, q, False)
    except (ValueError, np.linalg.LinAlgError):
        return None
    turn = curve.turn_of(own) if curve.width < NARROW_LAYER else None
    if turn is None:
        return None
    to_turn = curve.hyperbola(turn[0])[0] - geometry.difference(critical.q, q)
    return float(to_turn[own]), turn[1]


def _turn_of(mechanism: Mechanism, drive: Drive, q: FloatArray) -> tuple[float, float] | None:
    """How far the driven coordinate is from where it turns back (units), and its second derivative
    along the motion there; None if it does not, or that is far away."""
    geometry = ClosureGeometry(mechanism, q)
    others = [other.joint for other in mechanism.drives if other.joint and other is not drive]
    free = free_coordinates(mechanism, others)
    own = _coordinate_of(mechanism, drive)
    basis, _ = tangent_basis(geometry, q, free)
    size = basis.shape[1]
    if not size or np.linalg.norm(basis[own]) > NEAR_DEAD_POINT:
        return None
    chart = TangentChart(geometry, q, basis, free)

    def at(z: FloatArray) -> tuple[ChartPoint | None, FloatArray]:
        """The configuration, and the slopes (k,) of the driven coordinate there."""
        point = chart.point(z)
        return point, np.full(size, np.inf) if point is None else point.slopes[own]

    z = np.zeros(size)
    point, slope = at(z)
    for _ in range(NEWTON_STEPS):
        with np.errstate(invalid="ignore"):
            columns = [at(z + step)[1] - at(z - step)[1] for step in SLOPE_STEP * np.eye(size)]
        hessian = np.column_stack(columns) / (2.0 * SLOPE_STEP)
        if not np.isfinite(hessian).all() or np.linalg.norm(slope) <= FLAT:
            break
        z = z - np.linalg.lstsq(hessian, slope, rcond=IDLE)[0]
        point, slope = at(z)
    if point is None or not (np.linalg.norm(slope) <= FLAT and np.isfinite(hessian).all()):
        return None
    bends = np.linalg.eigvalsh(0.5 * (hessian + hessian.T))
    bend = bends[np.argmax(np.abs(bends))]
    # No saddle, from where the joint goes on.
    if bend == 0.0 or (bends / bend < -IDLE).any() or abs(point.u[own]) > NEAR_DEAD_POINT:
        return None
    return float(point.u[own]), float(bend)


def _at_dead_point(
    mechanism: Mechanism, drive: Drive, q: FloatArray, distance: float, bend: float
) -> FailureCause:
    """The cause that :func:`_turn_of` found, of a drive that leads there."""
    name = str(drive.joint)
    here = position_of(mechanism, q, name)
    length = float(mechanism.structure.units.coordinate[_coordinate_of(mechanism, drive)])
    limit = here + distance * length
    unit = "rad" if is_angle(mechanism.model, name) else "m"
    most = "most" if bend < 0.0 else "least"
    return FailureCause(
        f"the drive {safe_repr(drive.name)} is at its dead point: the joint {safe_repr(name)} is "
        f"at {here:.6g} {unit}, and the closures let it go to {limit:.6g} {unit} at {most}",
        f"Let the drive turn back before {limit:.6g} {unit}, or drive another joint",
    )


def inertialess_motion(mechanism: Mechanism, q: FloatArray) -> FailureCause | None:
    """The joints that move together without inertia at ``q`` (nq,), as those on both sides of
    massless links do where their axes coincide; None if there are none."""
    M = pin.crba(mechanism.model, workspace(mechanism.model), q)
    M = np.triu(M) + np.triu(M, 1).T
    size = np.sqrt(M.diagonal())
    if not (np.isfinite(M).all() and (size > 0.0).all()):
        return None
    inertias, motions = np.linalg.eigh(M / size / size[:, None])
    if inertias[0] >= ARTICULATED_INERTIA_TOLERANCE:
        return None
    part = np.abs(motions[:, 0])
    moving = np.flatnonzero(part > MOVING_PART * part.max()).tolist()
    joints = joined_names(dict.fromkeys(safe_repr(_joint_of(mechanism, i)) for i in moving))
    return FailureCause(
        f"a motion of the joints {joints} moves no inertia there, as where the axes on both sides "
        "of massless links coincide: no force determines it",
        "Give the links between these joints inertia, or make them one ball joint",
    )


def rounding_clause(mechanism: Mechanism, rounding: PositionRounding) -> str:
    """Which initial position is known how closely, as a clause."""
    name = _joint_of(mechanism, rounding.coordinate)
    turning = rounding.coordinate in rotating_coordinates(mechanism)
    unit = "rad" if turning else "m"
    return (
        f"the joint {safe_repr(name)} starts at {rounding.position:.3g} {unit}, known to "
        f"{rounding.absolute:.1g} {unit}"
    )


def coarse_start(mechanism: Mechanism) -> FailureCause | None:
    """An initial position whose rounding is beyond what closures and drives are held to; None if
    there is none."""
    rounding = start_rounding(mechanism)
    if not (mechanism.constrained and rounding.relative > COARSE):
        return None
    return FailureCause(
        f"rounding limits how well the loops close: {rounding_clause(mechanism, rounding)}",
        "Start within a few turns of zero and next to the origin, or take a larger rtol",
    )


def failure_cause(
    mechanism: Mechanism, t: float, q: FloatArray, watch: HeldForceWatch | None
) -> FailureCause | None:
    """The cause of a failure at ``t`` (s) and ``q`` (nq,), under the forces that ``watch`` saw;
    None if it is none of those that are known."""
    cause = None if watch is None else watch.cause()
    return (
        cause
        or inertialess_motion(mechanism, q)
        or dead_point(mechanism, t, q)
        or coarse_start(mechanism)
    )
