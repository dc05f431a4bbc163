r"""Rows of loops and drives together, g(q) - s(t).

The row of a drive is that of a closure, or of a joint coordinate, with a prescribed motion s(t):

    g(q) - s(t) = 0,     G v - s'(t) = 0,     G v' + Gdot v - s''(t) = 0.

The rows of the loops come first, then those of driven points, then those of driven joints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.dynamics.constraints.rows import Elimination, LoopKinematics, all_rows, closure_errors
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.drives import NOMINAL_LENGTH, Drive, in_order_of_rows
from srm_mbs.model.laws import Curve
from srm_mbs.model.mechanism import MechanismData


class DrivenKinematics:
    """Rows of all closures and drives of a mechanism, at one time.

    Parameters
    ----------
    model, loops, drives
        The tree, its closures, and its drives in any order.
    curves
        s of each drive by its name; without them the rows are g(q) alone.
    scale, keep, eliminations
        As for :class:`~srm_mbs.dynamics.constraints.rows.LoopKinematics`, over all rows; those of
        drives are always kept and are not changed by eliminations.

    Attributes
    ----------
    g : (m,), G : (m, nv), bias : (m,)
        g - s, the Jacobian of g, and Gdot v - s'', after :meth:`update` and :meth:`move_to`.
    pushed : (m,)
        s', so that the closure rates are G v - pushed.
    """

    def __init__(
        self,
        model: pin.Model,
        loops: Sequence[LoopClosure],
        drives: Sequence[Drive],
        curves: dict[str, Curve] | None = None,
        scale: FloatArray | None = None,
        keep: BoolArray | None = None,
        eliminations: Sequence[Elimination] = (),
    ) -> None:
        ordered = in_order_of_rows(drives)
        points = [drive.closure for drive in ordered if drive.closure is not None]
        self._joints = [drive for drive in ordered if drive.closure is None]
        closed = sum(loop.rows.count for loop in (*loops, *points))
        total = closed + len(self._joints)
        scale = np.ones(total) if scale is None else scale
        keep = np.ones(total, dtype=bool) if keep is None else keep
        self._inner = LoopKinematics(
            model, [*loops, *points], scale[:closed], keep[:closed], eliminations
        )
        start = len(self._inner.g)
        m = start + len(self._joints)
        self.g, self.bias, self.target_rate = np.zeros(m), np.zeros(m), np.zeros(m)
        self.G = np.zeros((m, model.nv))
        self._closed = slice(0, start)
        self._coordinates: list[tuple[int, int, bool, float]] = []
        for row, (drive, size) in enumerate(zip(self._joints, scale[closed:].tolist()), start):
            joint = model.joints[model.getJointId(drive.joint)]
            self.G[row, joint.idx_v] = 1.0 / size
            self._coordinates.append((row, joint.idx_q, joint.nq == 2, 1.0 / size))
        first = m - len(ordered)
        self._driven_rows = [
            (
                first + k,
                1.0 / float(scale[total - len(ordered) + k]),
                # The row of a distance is |p| - NOMINAL_LENGTH.
                curves[drive.name].shifted(-NOMINAL_LENGTH)
                if drive.distance
                else curves[drive.name],
            )
            for k, drive in enumerate(ordered)
            if curves is not None
        ]
        self._in_v = [model.joints[model.getJointId(d.joint)].idx_v for d in self._joints]

    def pattern(self) -> BoolArray:
        """Which entries of G (m, nv) may differ from zero."""
        joints = self.G[self._closed.stop :] != 0.0
        return np.concatenate([self._inner.pattern(), joints])

    def constants(self) -> dict[str, Any]:
        """Constants of the closures for the compiled kernel, those of driven points included."""
        return self._inner.constants()

    def drive_constants(self) -> list[dict[str, Any]]:
        """Constants of each drive for the compiled kernel."""
        joints = {row: (k, wound) for row, k, wound, _ in self._coordinates}
        in_v = {c[0]: k for c, k in zip(self._coordinates, self._in_v)}
        drives = []
        for row, factor, curve in self._driven_rows:
            in_q, wound = joints.get(row, (-1, False))
            drives.append(
                {"row": row, "factor": factor, "in_q": in_q, "in_v": in_v.get(row, -1)}
                | {"wound": wound, "curve": curve.constants()}
            )
        return drives

    def update(self, data: pin.Data, q: FloatArray, with_bias: bool = True) -> None:
        """Evaluate g and G, and Gdot v unless ``with_bias`` is false, with s = 0.

        ``data`` as for :meth:`~srm_mbs.dynamics.constraints.rows.LoopKinematics.update`, at q
        (nq,).
        """
        inner, own = self._inner, self._closed
        inner.update(data, q, with_bias)
        self.g[own], self.G[own], self.bias[own] = inner.g, inner.G, inner.bias
        for row, k, wound, factor in self._coordinates:
            angle = math.atan2(q[k + 1], q[k]) if wound else q[k]
            self.g[row] = factor * angle
            self.bias[row] = 0.0

    def move_to(self, t: float) -> None:
        """Subtract s, s' and s'' at t (s) from the rows of :meth:`update`."""
        for row, factor, curve in self._driven_rows:
            s, rate, bend = curve(t)
            self.g[row] -= factor * s
            self.target_rate[row] = factor * rate
            self.bias[row] -= factor * bend
        for row, _, wound, factor in self._coordinates:
            if wound:  # the turn that is nearest
                self.g[row] = factor * math.remainder(self.g[row] / factor, 2.0 * math.pi)


def constraint_errors(
    mechanism: MechanismData, t: FloatArray, q: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """g - s (n, rows) in m and rad, and G v - s' (n, rows), of all rows at n states.

    Parameters
    ----------
    t : (n,), q : (n, nq), v : (n, nv)
        Times (s) and states.
    """
    model = mechanism.model
    if not mechanism.drives:
        return closure_errors(model, mechanism.loops, q, v, all_rows(mechanism))
    rows = DrivenKinematics(model, mechanism.loops, mechanism.drives, mechanism.drive_curves)
    data = workspace(model)
    g = np.empty((len(q), len(rows.g)))
    c = np.empty_like(g)
    for i in range(len(q)):
        pin.crba(model, data, q[i], pin.Convention.WORLD)
        rows.update(data, q[i], with_bias=False)
        rows.move_to(t[i])
        g[i] = rows.g
        c[i] = rows.G @ v[i] - rows.target_rate
    return g, c
