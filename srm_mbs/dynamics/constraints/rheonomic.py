r"""Rows of loops and drives together, g(q) - s(t).

The row of a drive is that of a closure, or of a joint coordinate, with a prescribed motion s(t):

    g(q) - s(t) = 0,     G v - s'(t) = 0,     G v' + Gdot v - s''(t) = 0.

The rows of the loops come first, then those of driven points, then those of driven joints.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import LARGE, take_idle, workspace
from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.dynamics.constraints.rows import Elimination, LoopKinematics
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.drives import NOMINAL_LENGTH, Drive, in_order_of_rows
from srm_mbs.model.laws import Curve
from srm_mbs.model.mechanism import MechanismData, per_model

KEPT_JOINTS = 256
"""Driven joints whose closures are kept: analyses ask for them several times."""


def driven_closures(drives: Sequence[Drive]) -> list[LoopClosure]:
    """The closures whose rows are g(q) of the ``drives``, in the order of their rows."""
    return [
        drive.closure or _driven_joint(str(drive.joint), drive.name)
        for drive in in_order_of_rows(drives)
    ]


@lru_cache(maxsize=KEPT_JOINTS)
def _driven_joint(joint: str, name: str) -> LoopClosure:
    """The closure whose row is the coordinate of ``joint``, called ``name``."""
    return LoopClosure("coupling", joints=(joint,), coefficients=(1.0,), name=name)


class _DriveRow(NamedTuple):
    """Constants of the row of a drive, as the compiled kernel names them.

    Attributes
    ----------
    row, factor
        Index of the row, and the inverse of its scale.
    in_q, in_v
        First place of the joint in q and v; -1 for a point.
    wraps
        Whether the coordinate is an angle that is stored as (cos, sin).
    """

    row: int
    factor: float
    in_q: int
    in_v: int
    wraps: bool


class DrivenKinematics(LoopKinematics):
    """Rows of all closures and drives of a mechanism, at one time.

    Parameters
    ----------
    model, loops, drives
        The tree, its closures, and its drives in any order.
    scale, keep, eliminations
        As for :class:`~srm_mbs.dynamics.constraints.rows.LoopKinematics`, over all rows; those of
        drives are always kept and are not changed by eliminations.

    Attributes
    ----------
    g : (m,), G : (m, nv), bias : (m,), target_rate : (m,)
        g - s, the Jacobian of g, Gdot v - s'', and s', after :meth:`update` and :meth:`move_to`.
    """

    def __init__(
        self,
        model: pin.Model,
        loops: Sequence[LoopClosure],
        drives: Sequence[Drive],
        scale: FloatArray | None = None,
        keep: BoolArray | None = None,
        eliminations: Sequence[Elimination] = (),
    ) -> None:
        super().__init__(model, [*loops, *driven_closures(drives)], scale, keep, eliminations)
        self._drives = in_order_of_rows(drives)
        self._first = len(self.g) - len(drives)
        own = np.ones(len(drives)) if scale is None else scale[len(scale) - len(drives) :]
        self._driven = []
        for row, (drive, size) in enumerate(zip(self._drives, own.tolist()), self._first):
            place = (-1, -1, False)
            if drive.joint is not None:
                joint = model.joints[model.getJointId(drive.joint)]
                place = (joint.idx_q, joint.idx_v, joint.nq == 2)
            self._driven.append(_DriveRow(row, 1.0 / size, *place))
        self._curves: list[Curve] = []

    def follow(self, curves: Mapping[str, Curve]) -> Self:
        """Take s of each drive from ``curves``, by its name; until then the rows are g(q) alone."""
        self._curves = [
            # The row of a distance is |p| - NOMINAL_LENGTH.
            curves[drive.name].shifted(-NOMINAL_LENGTH) if drive.distance else curves[drive.name]
            for drive in self._drives
        ]
        return self

    @property
    def driven_rows(self) -> slice:
        """Which rows are those of drives."""
        return slice(self._first, len(self.g))

    def constants(self) -> dict[str, Any]:
        """Constants of the closures for the compiled kernel, those of driven points included."""
        own = super().constants()
        return own | {"joint_rows": [row for row in own["joint_rows"] if row["row"] < self._first]}

    def drive_constants(self) -> list[dict[str, Any]]:
        """Constants of each drive for the compiled kernel."""
        return [
            row._asdict() | {"curve": curve.constants()}
            for row, curve in zip(self._driven, self._curves)
        ]

    def move_to(self, t: float) -> None:
        """Subtract s, s' and s'' at t (s) from the rows of :meth:`update`."""
        for (row, factor, _, _, wraps), curve in zip(self._driven, self._curves):
            s, rate, acceleration = curve(t)
            self.g[row] -= factor * s
            self.target_rate[row] = factor * rate
            self.bias[row] -= factor * acceleration
            if wraps:  # of all turns the nearest
                self.g[row] = factor * math.remainder(self.g[row] / factor, 2.0 * math.pi)


@per_model
def unscaled_rows(mechanism: MechanismData) -> DrivenKinematics:
    """All rows of a mechanism, unscaled and without the motions of its drives; only copies of their
    workspace are evaluated."""
    return DrivenKinematics(mechanism.model, mechanism.loops, mechanism.drives)


@per_model
def _idle_rows(mechanism: MechanismData) -> deque[tuple[DrivenKinematics, pin.Data]]:
    """All rows with a workspace, which :func:`constraint_errors` left."""
    return deque(maxlen=1)


def all_rows(mechanism: MechanismData) -> DrivenKinematics:
    """All rows of a mechanism, unscaled, with the motions of its drives and memory of their own."""
    return unscaled_rows(mechanism).copy_workspace().follow(mechanism.drive_curves)


def constraint_errors(
    mechanism: MechanismData, t: FloatArray, q: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """g - s (n, rows) in m and rad, and G v - s' (n, rows), of all rows at n states.

    Parameters
    ----------
    t : (n,), q : (n, nq), v : (n, nv)
        Times (s) and states.
    """
    model, idle = mechanism.model, _idle_rows(mechanism)
    rows, data = take_idle(idle) or (unscaled_rows(mechanism).copy_workspace(), workspace(model))
    found = rows.follow(mechanism.drive_curves).errors(model, data, t, q, v)
    if model.nv <= LARGE:
        idle.append((rows, data))
    return found
