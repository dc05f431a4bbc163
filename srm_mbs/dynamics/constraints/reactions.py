r"""Reaction forces and multipliers of the closures, and the forces of the drives.

From yhat = M^{-1} G^T lam the multipliers follow as the solution of (L^{-1} G^T) lam = L^T yhat
over all rows whose norm, in the scaled rows, is least.  Singular values beyond the rank of the
solve hold the closure error only and are left out.  The wrench that a exerts on b is C^T lam with
the rows C of the closure taken at b's origin.  A drive exerts -lam on its coordinate.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.projection import cholesky, whiten
from srm_mbs.dynamics.constraints.rheonomic import DrivenKinematics
from srm_mbs.dynamics.constraints.rows import row_wrenches
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.model.drives import in_order_of_rows


def reactions_at(
    system: OpenSystem | ClosedSystem, t: FloatArray, q: FloatArray, v: FloatArray
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Wrenches {loop: (n, 6)} and multipliers {loop: (n, rows)} at n states.

    Wrenches are force (N) then moment (N m) that a exerts on b, at b's origin, in world axes.
    Next to a singular configuration the multipliers grow without bound, as they do in the
    mechanism.
    """
    mechanism = system.mechanism
    model = mechanism.model
    wrenches = {loop.name: np.zeros((len(t), 6)) for loop in mechanism.loops if loop.anchors}
    multipliers = {loop.name: np.zeros((len(t), loop.rows.count)) for loop in mechanism.loops}
    for i, lam, data in _multipliers(system, t, q, v):
        at = 0
        for loop in mechanism.loops:
            own = lam[at : at + loop.rows.count]
            at += loop.rows.count
            multipliers[loop.name][i] = own
            if loop.anchors:
                wrenches[loop.name][i] = row_wrenches(loop, model, data).T @ own
    return wrenches, multipliers


def drive_forces_at(
    system: OpenSystem | ClosedSystem, t: FloatArray, q: FloatArray, v: FloatArray
) -> dict[str, FloatArray]:
    """Force (N) or torque (N m) of each drive {name: (n,)} at n states, on its coordinate in the
    positive sense."""
    drives = system.mechanism.drives
    forces = {drive.name: np.zeros(len(t)) for drive in drives}
    ordered = in_order_of_rows(drives)
    for i, lam, _ in _multipliers(system, t, q, v):
        for drive, own in zip(ordered, lam[len(lam) - len(ordered) :]):
            forces[drive.name][i] = -own
    return forces


def _multipliers(
    system: OpenSystem | ClosedSystem, t: FloatArray, q: FloatArray, v: FloatArray
) -> Iterator[tuple[int, FloatArray, pin.Data]]:
    """Number of the state, lam (rows,) of all rows, unscaled, and data with the placements; nothing
    for a mechanism without closures."""
    if not system.has_constraints:
        return
    mechanism = system.mechanism
    model = mechanism.model
    rows = DrivenKinematics(model, mechanism.loops, mechanism.drives)
    scale = mechanism.structure.row_scale
    data = workspace(model)
    for i in range(len(t)):
        terms = system.evaluate(t[i], np.concatenate([q[i], v[i]]))
        yhat = terms.multiplier().copy()
        rows.evaluate(model, data, q[i])
        U = cholesky(data.M)
        W = whiten(U, (rows.G / scale[:, None]).T)
        left, singular, right = np.linalg.svd(W, full_matrices=False)
        k = terms.rank
        yield i, ((left[:, :k].T @ (U @ yhat)) / singular[:k]) @ right[:k] / scale, data
