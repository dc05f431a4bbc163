r"""Closures and drives as pure numbers, with time as one more coordinate.

The rows g(q) - s(t) of drives depend on (q, t) as those of closures do on q, and time passes
evenly: with the coordinates (q, t) and the rates (v, 1), and ' for the derivative by t,

    [G, -s'] (v, 1) = 0,     [G, -s'] (v', 0) + (Gdot v - s'') = 0.

So what holds of singular configurations of closures, their branches and the constraint algebra on
them, holds of drives in (q, t), where t has no inertia of its own: it is prescribed.  Where the
rows G of closures and drives lose rank on a motion, [G, -s'] does, since G v = s' has a solution.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.drives import in_order_of_rows
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.closure_geometry import ClosureGeometry
from srm_mbs.systems.driven import DrivenKinematics
from srm_mbs.systems.units import constraint_units


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

    def __init__(self, mechanism: Mechanism, start: FloatArray, t: float | None = None) -> None:
        super().__init__(mechanism, start)
        units = mechanism.structure.units
        curves = mechanism.drive_curves
        if t is not None:
            curves = {name: curve.piece(t) for name, curve in curves.items()}
        drives = in_order_of_rows(mechanism.drives)
        closures = len(self.row_unit)
        self.drives = tuple(drive.name for drive in drives)
        self.row_unit = constraint_units(mechanism, units)
        self._rows = DrivenKinematics(self.model, mechanism.loops, mechanism.drives, curves)
        fastest = units.rate
        for drive, unit in zip(drives, self.row_unit[closures:].tolist()):
            _, rate, bend = curves[drive.name](0.0 if t is None else t)
            fastest = max(fastest, abs(rate) / unit, float(np.sqrt(abs(bend) / unit)))
        self.unit = np.append(self.coordinate_unit, 1.0 / fastest)

    @cached_property
    def row_size(self) -> FloatArray:
        """Usual norm of the rows of G (rows,): that of closures, 1 for drives."""
        of_closures = ClosureGeometry(self.mechanism, self.start).row_size
        return np.concatenate([of_closures, np.ones(len(self.drives))])

    def _update(self, place: FloatArray, with_bias: bool) -> FloatArray:
        """Evaluate the rows at (q, t); their Gdot v, without what the laws add."""
        self._rows.update(self.data, place[:-1], with_bias)
        bias = self._rows.bias.copy()
        self._rows.move_to(float(place[-1]))
        return bias

    def closure(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(g - s) over row units (rows,), and [G, -s'] over row units times units (rows, n)."""
        pin.crba(self.model, self.data, place[:-1], pin.Convention.WORLD)
        self._update(place, with_bias=False)
        jacobian = np.column_stack([self._rows.G, -self._rows.pushed])
        return self._rows.g / self.row_unit, jacobian / self.row_unit[:, None] * self.unit

    def bias(self, place: FloatArray, u: FloatArray) -> FloatArray:
        """Gdot v - s'' (dt)^2, rows over their usual size, for the rates u = (v, dt) in units."""
        q, rates = place[:-1], u * self.unit
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        pin.nonLinearEffects(self.model, self.data, q, rates[:-1])
        own = self._update(place, with_bias=True)
        out: FloatArray = own + (self._rows.bias - own) * rates[-1] ** 2
        return out / self.row_unit / self.row_size

    def move(self, place: FloatArray, delta: Any, free: IndexArray | None = None) -> FloatArray:
        """(q, t) (+) delta, delta in units: (n,), or (k,) over the ``free`` of them (indices)."""
        full = np.zeros(len(self.unit))
        own = slice(None) if free is None else free
        full[own] = delta * self.unit[own]
        return np.append(pin.integrate(self.model, place[:-1], full[:-1]), place[-1] + full[-1])

    def difference(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Motion (n,) from a to b, in units."""
        moved = pin.difference(self.model, a[:-1], b[:-1])
        out: FloatArray = np.append(moved, b[-1] - a[-1]) / self.unit
        return out

    def at(self, q: FloatArray, t: float) -> FloatArray:
        """The place (q, t)."""
        return np.append(q, t)

    def rates(self, v: FloatArray) -> FloatArray:
        """(v, 1) in units (n,), for the velocity v (nv,)."""
        out: FloatArray = np.append(v, 1.0) / self.unit
        return out


def geometry_of(mechanism: Mechanism, q: FloatArray, t: float | None = None) -> ClosureGeometry:
    """The closures of a mechanism, and its drives if it has any; parameters as for
    :class:`DrivenGeometry`."""
    return DrivenGeometry(mechanism, q, t) if mechanism.drives else ClosureGeometry(mechanism, q)
