"""Closure rows without forces: g, G and Gdot v as pure numbers, for geometry on the loops.

Drives are not part of it: what is singular here is singular whatever the motion.  With them, and
time as one more coordinate, it is :mod:`srm_mbs.systems.driven_geometry`.

Coordinates count in their units (1 rad, the scene diagonal), rows in theirs; *normalised* rows are
divided by their usual size, so that ranks can be judged.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.loops import LoopKinematics, world_jacobian
from srm_mbs.systems.units import coordinate_units, row_units
from srm_mbs.systems.walking import DEPENDENT, ROUNDING_ROW
from srm_mbs.workspaces import workspace


class ClosureGeometry:
    """Closure equations of a mechanism.

    Parameters
    ----------
    mechanism
        Its model and loops.
    start : (nq,)
        Configuration at which units are measured.

    Attributes
    ----------
    coordinate_unit : (nv,), length, row_unit : (rows,)
        Units of the coordinates, the scene diagonal (m), units of the rows.
    unit : (n,)
        Units of all that moves here: the coordinates, n = nv.
    drives
        Names of the drives whose rows follow those of the loops: none.
    """

    def __init__(self, mechanism: Mechanism, start: FloatArray) -> None:
        self.mechanism = mechanism
        self.start = start
        # Gravity cancels in Gdot v, but its rounding would not at small rates.
        self.model = mechanism.model.copy()
        self.model.gravity.linear = np.zeros(3)
        self.data = workspace(self.model)
        self.rows = LoopKinematics(self.model, mechanism.loops)
        units = coordinate_units(mechanism, start, np.zeros(self.model.nv))
        self.unit = self.coordinate_unit = units.coordinate
        self.length = units.length
        self.row_unit = row_units(mechanism, units)
        self.drives: tuple[str, ...] = ()

    def closure(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """g over row units (rows,), and G over row units times coordinate units (rows, nv)."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        self.rows.update(self.data, q, with_bias=False)
        return self.rows.g / self.row_unit, self.rows.G / self.row_unit[:, None] * self.unit

    @cached_property
    def row_size(self) -> FloatArray:
        """Usual norm of the rows of G in :meth:`closure`: rms over open configurations (rows,).

        One size for the lengths of a loop and one for its alignments; 1 where all are zero.
        """
        rng = np.random.default_rng(0)
        squares = np.zeros(len(self.row_unit))
        uncancelled = np.zeros(2)
        for _ in range(8):
            spread = rng.uniform(-np.pi, np.pi, self.model.nv) * self.unit
            _, G = self.closure(pin.integrate(self.model, self.start, spread))
            squares += (G**2).sum(axis=1) / 8
            # What rows would measure if nothing in them cancelled: their rounding is eps of it.
            J = world_jacobian(self.data)
            turn = np.linalg.norm(J[3:], axis=0) * self.unit
            shift = np.linalg.norm(J[:3], axis=0) * self.unit / self.length + turn
            uncancelled += np.array([shift @ shift, turn @ turn]) / 8
        at = 0
        for loop in self.mechanism.loops:
            own = squares[at : at + loop.rows.count]
            for block, whole in zip(loop.rows.blocks[:2], uncancelled):
                if block.stop > block.start:
                    mean = own[block].mean()
                    # Always satisfied: rounding must not be scaled up to a row.
                    own[block] = mean if mean > ROUNDING_ROW**2 * whole else whole
            at += loop.rows.count
        return np.sqrt(np.where(squares > 0.0, squares, 1.0))

    def normalised(self, q: FloatArray) -> FloatArray:
        """G of :meth:`closure`, rows over their usual size: what ranks are judged by."""
        return self.closure(q)[1] / self.row_size[:, None]

    @cached_property
    def _shares(self) -> list[tuple[int, int, float]]:
        """The eliminations of the load-time analysis, between normalised rows."""
        eliminations = self.mechanism.structure.eliminations
        if not eliminations:
            return []
        size = (self.row_unit * self.row_size).tolist()
        return [(e.row, e.other, e.factor * size[e.other] / size[e.row]) for e in eliminations]

    def _without_shares(self, q: FloatArray) -> FloatArray:
        G = self.normalised(q)
        for row, other, share in self._shares:
            G[row] -= share * G[other]
        return G

    @cached_property
    def _left(self) -> FloatArray:
        """Size of what is left of each row (rows,), where the mechanism starts."""
        start = self.at(self.mechanism.q0, 0.0)
        before, left = (
            np.linalg.norm(rows, axis=1)
            for rows in (self.normalised(start), self._without_shares(start))
        )
        out: FloatArray = np.where(left > DEPENDENT * before, left / np.maximum(before, left), 1.0)
        return out

    def separated(self, q: FloatArray) -> FloatArray:
        """As :meth:`normalised`, where nearly parallel rows of closures between the same bodies
        are replaced by their differences, as large as themselves: what is small everywhere hides
        no singular configuration."""
        return self._without_shares(q) / self._left[:, None] if self._shares else self.normalised(q)

    def bias(self, q: FloatArray, u: FloatArray) -> FloatArray:
        """Gdot v, rows over their usual size, for the rates u (nv,) in units."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        pin.nonLinearEffects(self.model, self.data, q, u * self.unit)
        self.rows.update(self.data, q)
        return self.rows.bias / self.row_unit / self.row_size

    def mass(self) -> FloatArray:
        """Mass matrix (nv, nv) for rates in units, where the closures were evaluated last."""
        upper, unit = np.triu(self.data.M), self.coordinate_unit
        out: FloatArray = (upper + np.triu(upper, 1).T) * unit * unit[:, None]
        return out

    def at(self, q: FloatArray, t: float) -> FloatArray:
        """What the other methods take for the configuration q (nq,) at the time t (s): q itself."""
        return q

    def rates(self, v: FloatArray) -> FloatArray:
        """Rates (n,) in units of a motion with the velocity v (nv,)."""
        out: FloatArray = v / self.unit
        return out

    def move(self, q: FloatArray, delta: Any, free: IndexArray | None = None) -> FloatArray:
        """q (+) delta, delta in units: (nv,), or (k,) over the ``free`` coordinates (indices)."""
        full = np.zeros(self.model.nv)
        own = slice(None) if free is None else free
        full[own] = delta * self.unit[own]
        return pin.integrate(self.model, q, full)  # type: ignore[no-any-return]

    def difference(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Motion (nv,) from a to b, in units."""
        return pin.difference(self.model, a, b) / self.unit  # type: ignore[no-any-return]
