"""The closure equations in units: g, G and Gdot v as pure numbers, without forces.

Coordinates are counted in their units (1 rad, the scene diagonal), rows in theirs; *normalised*
rows are divided by their usual norm, so that singular values can be compared with a threshold.

:class:`ClosureGeometry` has the closures alone: a configuration that is singular there is singular
in every motion.  :class:`DrivenGeometry` adds the drives, with time as one more coordinate.  The
rows g(q) - s(t) of drives depend on (q, t) as those of closures depend on q, and t' = 1: with the
coordinates (q, t), the rates (v, 1), and ' for the derivative by t,

    [G, -s'] (v, 1) = 0,     [G, -s'] (v', 0) + (Gdot v - s'') = 0.

Therefore the theory of singular configurations of closures, of their branches and of the constraint
algebra on them applies to drives in (q, t), where t is prescribed and has no inertia.  Where the
rows G of closures and drives lose rank on a motion, [G, -s'] does, because G v = s' has a solution.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import BoolArray, FloatArray, IndexArray
from srm_mbs.dynamics.constraints.projection import symmetric
from srm_mbs.dynamics.constraints.rheonomic import DrivenKinematics, all_rows, unscaled_rows
from srm_mbs.dynamics.constraints.rows import LoopKinematics, world_jacobian
from srm_mbs.dynamics.constraints.structure import DEPENDENT, ROUNDING_ROW, structure_of
from srm_mbs.dynamics.scaling import (
    constraint_units,
    coordinate_units,
    periodic_coordinates,
    row_units,
)
from srm_mbs.model.drives import in_order_of_rows, positions
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_model, per_start, per_tree

CLEARLY_MORE = 1e-12
"""Mean square of the norm of a row, in units, above which it is no rounding: that of one without
cancelled terms, 1e-24 of which is rounding, is at most nv^3 in a mechanism at the origin."""
OPEN_SAMPLES = 8
"""Random open configurations from which the usual norms of rows are measured."""
KEPT_SPREADS = 16
"""Sets of random motions that are kept, by the number of coordinates."""


@lru_cache(maxsize=KEPT_SPREADS)
def open_spreads(size: int) -> FloatArray:
    """Motions (n, size) from a start to the open configurations in which the usual norms of rows
    are measured, in units; read-only."""
    out = np.random.default_rng(0).uniform(-np.pi, np.pi, (OPEN_SAMPLES, size))
    out.setflags(write=False)
    return out


class ClosureGeometry:
    """The closure equations of a mechanism, without its drives.

    Parameters
    ----------
    mechanism
        The mechanism, of which the model and the loops count.
    start : (nq,)
        Configuration at which units are measured.

    Attributes
    ----------
    units
        Units at ``start``.
    coordinate_unit : (nv,), row_unit : (rows,)
        Units of the coordinates and of the rows.
    unit : (n,)
        Units of the unknowns: the coordinates, n = nv.
    drives
        Names of the drives whose rows follow those of the loops: none.
    """

    def __init__(self, mechanism: MechanismData, start: FloatArray) -> None:
        self.mechanism = mechanism
        self.start = start
        self.model = mechanism.model
        self.units = coordinate_units(mechanism, start, np.zeros(self.model.nv))
        self.unit = self.coordinate_unit = self.units.coordinate
        self.row_unit = row_units(mechanism, self.units)
        self.drives: tuple[str, ...] = ()

    # Most starts are closed and regular by the kernel alone, which needs none of these.
    @cached_property
    def weightless(self) -> pin.Model:
        """The model without gravity, which cancels in Gdot v, but whose rounding would not at small
        rates."""
        model = self.model.copy()
        model.gravity.linear = np.zeros(3)
        return model

    @cached_property
    def data(self) -> pin.Data:
        """Pinocchio's workspace."""
        return workspace(self.model)

    @cached_property
    def rows(self) -> LoopKinematics:
        """The rows of the loops, unscaled."""
        return loop_rows(self.mechanism).copy_workspace()

    def closure(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """g over row units (rows,), and G over row units times coordinate units (rows, nv)."""
        self.rows.evaluate(self.model, self.data, q)
        return self.rows.g / self.row_unit, self.rows.G / self.row_unit[:, None] * self.unit

    @cached_property
    def commutes(self) -> bool:
        """Whether moves commute: no ball, planar or free joints."""
        joints = self.model.joints.tolist()[1:]
        return all(joint.nq == joint.nv or joint.nv == 1 for joint in joints)

    @cached_property
    def row_size(self) -> FloatArray:
        """Usual norm of the rows of G in :meth:`closure`: rms over open configurations (rows,).

        One size for the lengths of a loop and one for its alignments; 1 where all are zero.
        """
        at_start = self.start is self.mechanism.q0
        return _row_size_at_start(self.mechanism) if at_start else self._measured_row_size()

    @cached_property
    def _open_configurations(self) -> FloatArray:
        """Open configurations (n, nq), from which usual norms are measured."""
        model = self.model
        spreads = open_spreads(int(model.nv)) * self.coordinate_unit
        return np.array([pin.integrate(model, self.start, spread) for spread in spreads])

    def jacobians(self, places: FloatArray) -> FloatArray:
        """G of :meth:`closure` (k, rows, n) at k places, as it takes them."""
        return np.array([self.closure(each)[1] for each in places])

    @cached_property
    def _squares(self) -> FloatArray:
        """Mean squares (rows,) of the norms of rows over the open configurations."""
        G = self.jacobians(self._open_configurations)
        squares: FloatArray = (G * G).sum(axis=(0, 2)) / len(G)
        return squares

    @cached_property
    def _uncancelled(self) -> tuple[float, float]:
        """The same, if no terms in rows cancelled, of one along a direction and of one of an
        alignment: the rounding of a row is eps times its norm."""
        model, places = self.model, self._open_configurations
        J = np.empty((len(places), 6, model.nv))
        for i, q in enumerate(places):
            pin.computeJointJacobians(model, self.data, q)
            J[i] = world_jacobian(self.data)
        turn = np.linalg.norm(J[:, 3:], axis=1) * self.coordinate_unit
        shift = np.linalg.norm(J[:, :3], axis=1) * self.coordinate_unit / self.units.length + turn
        along, turning = ((each * each).sum() / len(places) for each in (shift, turn))
        return float(along), float(turning)

    @cached_property
    def idle_rows(self) -> BoolArray:
        """Which rows (rows,) are rounding in all open configurations: they are always satisfied, as
        those out of the plane of a linkage."""
        idle: BoolArray = self._squares == 0.0
        if ((self._squares < CLEARLY_MORE) & ~idle).any():
            whole, at = np.zeros(len(idle)), 0
            for loop in self.mechanism.loops:
                for block, size in zip(loop.rows.blocks, self._uncancelled):
                    whole[at : at + loop.rows.count][block] = size
                at += loop.rows.count
            idle = self._squares <= ROUNDING_ROW**2 * whole
        return idle

    def _measured_row_size(self) -> FloatArray:
        squares, at = self._squares.copy(), 0
        for loop in self.mechanism.loops:
            own = squares[at : at + loop.rows.count]
            for kind, block in enumerate(loop.rows.blocks[:2]):
                if block.stop > block.start:
                    # The reduction itself: the method takes as long again for a few numbers.
                    mean = np.add.reduce(own[block]) / (block.stop - block.start)
                    if not mean > CLEARLY_MORE and mean <= ROUNDING_ROW**2 * (
                        whole := self._uncancelled[kind]
                    ):
                        mean = whole  # always satisfied: rounding must not be scaled up to a row
                    own[block] = mean
            at += loop.rows.count
        return np.sqrt(np.where(squares > 0.0, squares, 1.0))

    def normalised(self, q: FloatArray) -> FloatArray:
        """G of :meth:`closure`, each row over its usual norm; its singular values give ranks."""
        return self.closure(q)[1] / self.row_size[:, None]

    @cached_property
    def shares(self) -> list[tuple[int, int, float]]:
        """The eliminations of the load-time analysis, between normalised rows: (row, other, share
        of the other row in the row)."""
        eliminations = structure_of(self.mechanism).eliminations
        if not eliminations:
            return []
        size = (self.row_unit * self.row_size).tolist()
        return [(e.row, e.other, e.factor * size[e.other] / size[e.row]) for e in eliminations]

    def _without_shares(self, normalised: FloatArray) -> FloatArray:
        """``normalised`` rows (..., rows, n) after the eliminations."""
        G = normalised.copy()
        for row, other, share in self.shares:
            G[..., row, :] -= share * G[..., other, :]
        return G

    @cached_property
    def left(self) -> FloatArray:
        """Norm of each row (rows,) after the eliminations, over that before them, at q0."""
        normalised = self.normalised(self.at(self.mechanism.q0, 0.0))
        before, left = (
            np.linalg.norm(rows, axis=1) for rows in (normalised, self._without_shares(normalised))
        )
        depends = ~(left > DEPENDENT * before)
        left[depends] = before[depends] = 1.0  # a row of zeros depends on any
        shares: FloatArray = left / np.maximum(before, left)
        return shares

    def _separate(self, normalised: FloatArray) -> FloatArray:
        if not self.shares:
            return normalised
        out: FloatArray = self._without_shares(normalised) / self.left[:, None]
        return out

    def separated(self, q: FloatArray) -> FloatArray:
        """G as from :meth:`normalised`, with the difference in place of one of two nearly parallel
        rows of closures between the same bodies, scaled to their norm.

        Otherwise a singular value that is small everywhere would hide singular configurations."""
        return self._separate(self.normalised(q))

    def normalised_rows(self, jacobians: FloatArray) -> FloatArray:
        """G as from :meth:`normalised`, computed from the rows (..., rows, n) of unscaled
        Jacobians, of closures and drives
        (:meth:`srm_mbs.dynamics.observables.Observables.jacobians`)."""
        return jacobians * self.row_factors

    @cached_property
    def row_factors(self) -> FloatArray:
        """Factors (rows, n) from entries of G to those of normalised rows."""
        return self.unit / (self.row_unit * self.row_size)[:, None]

    def separated_rows(self, jacobians: FloatArray) -> FloatArray:
        """G as from :meth:`separated`, computed from the rows that :meth:`normalised_rows`
        takes."""
        return self._separate(self.normalised_rows(jacobians))

    def bias(self, q: FloatArray, u: FloatArray) -> FloatArray:
        """Gdot v, rows over their usual size, for the rates u (nv,) in units."""
        self.rows.evaluate(self.weightless, self.data, q, u * self.unit)
        return self.rows.bias / self.row_unit / self.row_size

    def mass(self) -> FloatArray:
        """Mass matrix (nv, nv) for rates in units, where the closures were evaluated last."""
        unit = self.coordinate_unit
        return symmetric(self.data.M) * unit * unit[:, None]

    def at(self, q: FloatArray, t: float) -> FloatArray:
        """The unknowns, as the other methods take them, at q (nq,) and t (s): q itself."""
        return q

    def rates(self, v: FloatArray) -> FloatArray:
        """Rates (n,) in units of a motion with the velocity v (nv,)."""
        return v / self.unit

    def move(self, q: FloatArray, delta: Any, free: IndexArray | None = None) -> FloatArray:
        """q (+) delta, delta in units: (nv,), or (k,) over the ``free`` coordinates (indices)."""
        full = np.zeros(self.model.nv)
        own = slice(None) if free is None else free
        full[own] = delta * self.unit[own]
        return pin.integrate(self.model, q, full)  # type: ignore[no-any-return]

    def difference(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Motion (nv,) from a to b, in units."""
        return pin.difference(self.model, a, b) / self.unit  # type: ignore[no-any-return]

    def in_turns_of(self, q: FloatArray, a: FloatArray) -> FloatArray:
        """a with the angles that count whole turns turned next to those of q."""
        periodic = np.flatnonzero(turning_coordinates(self.mechanism))
        whole = np.zeros(len(self.unit))
        whole[periodic] = 2.0 * np.pi * np.round(self.difference(a, q)[periodic] / (2.0 * np.pi))
        return self.move(a, whole)


@per_model
def loop_rows(mechanism: MechanismData) -> LoopKinematics:
    """The rows of the loops, unscaled; geometries copy their workspace."""
    if not mechanism.drives:
        return unscaled_rows(mechanism)
    return LoopKinematics(mechanism.model, mechanism.loops)


@per_start
def _row_size_at_start(mechanism: MechanismData) -> FloatArray:
    """:attr:`ClosureGeometry.row_size` with units measured at q0."""
    return ClosureGeometry(mechanism, mechanism.q0)._measured_row_size()


class DriveRows:
    """The rows of the drives at t = 0 as pure numbers, beside those of a
    :class:`ClosureGeometry`.

    Parameters
    ----------
    mechanism
        Its drives.
    geometry
        Its units, and its model without gravity, whose rounding would not cancel.
    q : (nq,)
        The configuration.

    Attributes
    ----------
    rows : (k, nv), rates : (k,)
        In units: the drives prescribe rows u = rates.
    """

    def __init__(self, mechanism: MechanismData, geometry: ClosureGeometry, q: FloatArray) -> None:
        self.rows, self.rates = np.zeros((0, geometry.model.nv)), np.zeros(0)
        self._kinematics: DrivenKinematics | None = None
        if not mechanism.drives:
            return
        self._geometry, self._q = geometry, q
        self._unit = geometry.unit
        self._kinematics = DrivenKinematics(geometry.model, (), mechanism.drives)
        units = constraint_units(mechanism, geometry.units)
        self._row_unit = units[len(geometry.row_unit) :]
        # Rates and accelerations do not depend on where a law starts, but for its target.
        starts = positions(geometry.model, mechanism.drives, q)
        moving = np.array(
            [d.curve(starts[d.name])(0.0) for d in in_order_of_rows(mechanism.drives)]
        ).reshape(-1, 3)
        self.rates = moving[:, 1] / self._row_unit
        self._accelerations = moving[:, 2] / self._row_unit
        self._kinematics.evaluate(geometry.model, geometry.data, q)
        self.rows = self._kinematics.G / self._row_unit[:, None] * self._unit

    def bias(self, u: FloatArray) -> FloatArray:
        """Gdot v - s'' (k,) for the rates u (nv,) in units."""
        if self._kinematics is None:
            return self.rates
        geometry = self._geometry
        self._kinematics.evaluate(geometry.weightless, geometry.data, self._q, u * self._unit)
        return self._kinematics.bias / self._row_unit - self._accelerations


class DrivenGeometry(ClosureGeometry):
    """Closure and drive equations of a mechanism over places (q, t), (nq + 1,).

    Parameters
    ----------
    mechanism
        Its model, loops and drives.
    start : (nq,)
        Configuration at which units are measured.
    t
        Every law is the piece of it that begins at this time (s) or holds there; without, the whole
        law, whose third derivative may jump.

    Attributes
    ----------
    unit : (nv + 1,)
        Those of the coordinates, and that of time (s), in which drives and mechanism move by one
        unit at most.
    """

    def __init__(self, mechanism: MechanismData, start: FloatArray, t: float | None = None) -> None:
        super().__init__(mechanism, start)
        units = structure_of(mechanism).units
        curves = mechanism.drive_curves
        if t is not None:
            curves = {name: curve.piece(t) for name, curve in curves.items()}
        drives = in_order_of_rows(mechanism.drives)
        closures = len(self.row_unit)
        self.drives = tuple(drive.name for drive in drives)
        self.row_unit = constraint_units(mechanism, units)
        self._rows = DrivenKinematics(self.model, mechanism.loops, drives).follow(curves)
        fastest = units.rate
        for drive, unit in zip(drives, self.row_unit[closures:].tolist()):
            _, rate, acceleration = curves[drive.name](0.0 if t is None else t)
            fastest = max(fastest, abs(rate) / unit, float(np.sqrt(abs(acceleration) / unit)))
        self.unit = np.append(self.coordinate_unit, 1.0 / fastest)

    @cached_property
    def row_size(self) -> FloatArray:
        """Usual norm of the rows of G (rows,): that of closures, 1 for drives."""
        of_closures = ClosureGeometry(self.mechanism, self.start).row_size
        return np.concatenate([of_closures, np.ones(len(self.drives))])

    def closure(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(g - s) over row units (rows,), and [G, -s'] over row units times units (rows, n)."""
        rows = self._rows
        rows.evaluate(self.model, self.data, place[:-1])
        rows.move_to(float(place[-1]))
        jacobian = np.column_stack([rows.G, -rows.target_rate])
        return rows.g / self.row_unit, jacobian / self.row_unit[:, None] * self.unit

    def bias(self, place: FloatArray, u: FloatArray) -> FloatArray:
        """Gdot v - s'' (dt)^2, rows over their usual size, for the rates u = (v, dt) in units."""
        rows, rates = self._rows, u * self.unit
        rows.evaluate(self.weightless, self.data, place[:-1], rates[:-1])
        of_motion = rows.bias.copy()
        rows.move_to(float(place[-1]))
        whole: FloatArray = of_motion + (rows.bias - of_motion) * rates[-1] ** 2
        return whole / self.row_unit / self.row_size

    def move(self, place: FloatArray, delta: Any, free: IndexArray | None = None) -> FloatArray:
        """(q, t) (+) delta, delta in units: (n,), or (k,) over the ``free`` of them (indices)."""
        full = np.zeros(len(self.unit))
        own = slice(None) if free is None else free
        full[own] = delta * self.unit[own]
        return np.append(pin.integrate(self.model, place[:-1], full[:-1]), place[-1] + full[-1])

    def difference(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Motion (n,) from a to b, in units."""
        moved = pin.difference(self.model, a[:-1], b[:-1])
        return np.append(moved, b[-1] - a[-1]) / self.unit

    def at(self, q: FloatArray, t: float) -> FloatArray:
        """The place (q, t)."""
        return np.append(q, t)

    def rates(self, v: FloatArray) -> FloatArray:
        """(v, 1) in units (n,), for the velocity v (nv,)."""
        return np.append(v, 1.0) / self.unit


def geometry_of(mechanism: MechanismData, q: FloatArray, t: float | None = None) -> ClosureGeometry:
    """The closures of a mechanism, and its drives if it has any; parameters as for
    :class:`DrivenGeometry`."""
    return DrivenGeometry(mechanism, q, t) if mechanism.drives else ClosureGeometry(mechanism, q)


def separated_pattern(mechanism: MechanismData) -> BoolArray:
    """Which entries of the separated rows of :func:`geometry_of` may differ from zero."""
    rows = all_rows(mechanism)
    pattern = rows.pattern()
    for elimination in structure_of(mechanism).eliminations:
        pattern[elimination.row] |= pattern[elimination.other]
    if not mechanism.drives:
        return pattern
    driven = np.zeros((len(pattern), 1), dtype=bool)
    driven[rows.driven_rows] = True
    return np.hstack([pattern, driven])


@per_model
def column_groups(mechanism: MechanismData) -> tuple[list[list[int]], BoolArray]:
    """Which unknowns of :func:`geometry_of` may change together in differences of combinations of
    the rows of G, and which unknowns (n, n) have a row in common."""
    pattern = separated_pattern(mechanism)
    related: BoolArray = pattern.T @ pattern
    groups: list[list[int]] = []
    for j, own in enumerate(related):
        apart = (group for group in groups if not (related[group].any(axis=0) & own).any())
        group = next(apart, None)
        if group is None:
            groups.append([j])
        else:
            group.append(j)
    return groups, related


@per_tree
def turning_coordinates(mechanism: MechanismData) -> BoolArray:
    """:func:`~srm_mbs.dynamics.scaling.periodic_coordinates` of a mechanism."""
    return periodic_coordinates(mechanism.model)
