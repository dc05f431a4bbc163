r"""Closure rows on Pinocchio kinematics: g, G and Gdot v.

For one closure let H be the frame with the axes of anchor b and its origin at anchor a.  In H

    W = H^{-1}(V_a - V_b) = (r, w)          relative velocity; r = p'
    B = H^{-1}(A_a - A_b - V_b x V_a)       its rate without the joint accelerations

(V, A spatial velocities and bias accelerations in world axes at the world origin), so that a
position row g = d . p and an alignment row g = n . m, m = R u, have

    G  = d^T X_lin (J_a - J_b),             Gdot v = d . (B_lin + w x r),
    G  = (m x n)^T X_ang (J_a - J_b),       Gdot v = n . (B_ang x m + w x (w x m)),

with X = H^{-1} as a 6 x 6 matrix and J the world-frame joint Jacobian.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import BoolArray, FloatArray
from srm_mbs.mechanism import LoopClosure


def cross(a: Sequence[float] | FloatArray, b: Sequence[float] | FloatArray) -> FloatArray:
    """a x b; ``numpy.cross`` costs ten times as much on three numbers."""
    ax, ay, az = a
    bx, by, bz = b
    return np.array((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def world_jacobian(data: pin.Data) -> FloatArray:
    """The joint Jacobian (6, nv) in world axes; Pinocchio hands out (6,) where nv = 1."""
    J: FloatArray = data.J
    return J if J.ndim == 2 else J[:, None]


def placement_numbers(placement: pin.SE3) -> FloatArray:
    """Rotation, row by row, then translation (12,)."""
    return np.concatenate([placement.rotation.ravel(), placement.translation])


def support(model: pin.Model, joint: int) -> FloatArray:
    """1.0 at the velocity components (nv,) that move ``joint``, else 0.0."""
    mask = np.zeros(model.nv)
    for ancestor in model.supports[joint]:
        if ancestor:
            j = model.joints[int(ancestor)]
            mask[j.idx_v : j.idx_v + j.nv] = 1.0
    return mask


class _LoopRows:
    """The kept, scaled rows of one closure, resolved against a model."""

    def __init__(
        self, model: pin.Model, loop: LoopClosure, scale: FloatArray, keep: BoolArray, start: int
    ) -> None:
        self.joint_a, self.in_a = loop.a.resolve(model)
        self.joint_b, self.in_b = loop.b.resolve(model)
        rows = loop.rows
        k = len(rows.directions)
        inverse = 1.0 / scale
        self.directions = (rows.directions * inverse[:k, None])[keep[:k]]
        pairs = rows.alignments[keep[k:]]
        # The row scale sits in n, so that no evaluation has to divide.
        self.alignments = [
            (u, n) for u, n in zip(pairs[:, 0], pairs[:, 1] * inverse[k:][keep[k:], None])
        ]
        self.support = support(model, self.joint_a) - support(model, self.joint_b)
        self.position_slice = slice(start, start + len(self.directions))
        self.alignment_start = start + len(self.directions)
        self.count = len(self.directions) + len(self.alignments)

    def constants(self) -> dict[str, Any]:
        return {
            "joint_a": self.joint_a,
            "joint_b": self.joint_b,
            "in_a": placement_numbers(self.in_a),
            "in_b": placement_numbers(self.in_b),
            "directions": np.ascontiguousarray(self.directions, dtype=float).ravel(),
            "alignments": np.array([np.concatenate(pair) for pair in self.alignments]).ravel(),
            "support": self.support,
            "first_row": self.position_slice.start,
        }


class LoopKinematics:
    """Rows of all closures of a mechanism.

    Parameters
    ----------
    model, loops
        The tree and its closures.
    scale : (rows,)
        Rows are divided by it; ones by default (then g is in m and rad, lengths unscaled).
    keep : (rows,) bool
        Rows to evaluate; all by default.

    Attributes
    ----------
    g : (m,), G : (m, nv), bias : (m,)
        Closure errors, their Jacobian in tangent coordinates, and Gdot v, after :meth:`update`.
    """

    def __init__(
        self,
        model: pin.Model,
        loops: Sequence[LoopClosure],
        scale: FloatArray | None = None,
        keep: BoolArray | None = None,
    ) -> None:
        total = sum(loop.rows.count for loop in loops)
        scale = np.ones(total) if scale is None else scale
        mask = np.ones(total, dtype=bool) if keep is None else np.asarray(keep, dtype=bool)
        self._loops: list[_LoopRows] = []
        at = m = 0
        for loop in loops:
            rows = slice(at, at + loop.rows.count)
            resolved = _LoopRows(model, loop, scale[rows], mask[rows], m)
            at = rows.stop
            m += resolved.count
            if resolved.count:
                self._loops.append(resolved)
        self.g = np.zeros(m)
        self.G = np.zeros((m, model.nv))
        self.bias = np.zeros(m)

    def constants(self) -> list[dict[str, Any]]:
        """What the compiled kernel needs of each closure."""
        return [loop.constants() for loop in self._loops]

    def update(self, data: pin.Data, with_bias: bool = True) -> None:
        """Evaluate g and G, and Gdot v unless ``with_bias`` is false.

        ``data`` must hold crba in the WORLD convention (placements, world Jacobian) and, for the
        bias, nonLinearEffects (velocities, bias accelerations) at the current state.
        """
        J = world_jacobian(data)
        oMi, v, a = data.oMi, data.v, data.a_gf
        for loop in self._loops:
            ja, jb = loop.joint_a, loop.joint_b
            Ta = oMi[ja] * loop.in_a if ja else loop.in_a
            Tb = oMi[jb] * loop.in_b if jb else loop.in_b
            H = pin.SE3(Tb.rotation, Ta.translation)
            X = H.toActionMatrixInverse()
            rows = loop.position_slice
            if with_bias:
                # a_gf carries -gravity on every body and on the ground: it cancels here.
                if jb == 0:
                    W = H.actInv(oMi[ja].act(v[ja]))
                    B = H.actInv(oMi[ja].act(a[ja]) - a[0])
                else:
                    Va, Vb = oMi[ja].act(v[ja]), oMi[jb].act(v[jb])
                    W = H.actInv(Va - Vb)
                    B = H.actInv(oMi[ja].act(a[ja]) - oMi[jb].act(a[jb]) - Vb.cross(Va))
            if len(loop.directions):
                self.g[rows] = loop.directions @ Tb.actInv(Ta.translation)
                self.G[rows] = ((loop.directions @ X[:3]) @ J) * loop.support
                if with_bias:  # classicAcceleration: B_lin + w x r
                    self.bias[rows] = loop.directions @ pin.classicAcceleration(W, B)
            if loop.alignments:
                R = Tb.rotation.T @ Ta.rotation
                XJ = (X[3:] @ J) * loop.support
                if with_bias:
                    w, angular = W.angular.tolist(), B.angular.tolist()
                for k, (u, n) in enumerate(loop.alignments, loop.alignment_start):
                    m = R @ u
                    self.g[k] = n @ m
                    self.G[k] = cross(m, n) @ XJ
                    if with_bias:
                        self.bias[k] = n @ (cross(angular, m) + cross(w, cross(w, m)))


def closure_errors(
    model: pin.Model, loops: Sequence[LoopClosure], q: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """g (n, rows) in m and rad, and G v (n, rows), of all rows at n states q (n, nq), v (n, nv)."""
    rows = LoopKinematics(model, loops)
    data = model.createData()
    g = np.empty((len(q), len(rows.g)))
    c = np.empty_like(g)
    for i in range(len(q)):
        pin.crba(model, data, q[i], pin.Convention.WORLD)
        rows.update(data, with_bias=False)
        g[i] = rows.g
        c[i] = rows.G @ v[i]
    return g, c


def row_wrenches(loop: LoopClosure, model: pin.Model, data: pin.Data) -> FloatArray:
    """Wrench on b, at b's origin in world axes, per unit multiplier of each row: (rows, 6).

    ``data`` must hold the joint placements.  Force (3) then moment (3); a's body feels the
    opposite wrench at the same point.
    """
    joint_a, in_a = loop.a.resolve(model)
    joint_b, in_b = loop.b.resolve(model)
    Ta = data.oMi[joint_a] * in_a
    Tb = data.oMi[joint_b] * in_b
    gap = Ta.translation - Tb.translation
    out = []
    for d in loop.rows.directions:
        force = Tb.rotation @ d
        out.append(np.concatenate([force, cross(gap, force)]))
    for u, n in loop.rows.alignments:
        moment = cross(Ta.rotation @ u, Tb.rotation @ n)
        out.append(np.concatenate([np.zeros(3), moment]))
    return np.array(out)
