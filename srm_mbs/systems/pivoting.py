r"""The pivoted factorisation of rows in a metric, for what is found out about a mechanism.

    M = L L^T,   W = L^-1 G^T,   W Pi = Q R,

as in :mod:`srm_mbs.systems.projection`, but with its own cut of the pivots, and with the
vectors that the rows do not see.  With M = 1 and all pivots above a cut it takes the place of
singular values and least squares, at a fraction of their cost.  For many coordinates the kernel
makes it, whose sparse algebra follows the graph of the loops; its twin is ``algebra.cpp``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import pinocchio as pin
from scipy.linalg import lapack

from srm_mbs.arrays import BoolArray, FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.systems.ordering import LARGE, graph_order
from srm_mbs.systems.projection import (
    PIVOT_SHARE,
    PIVOT_WINDOW,
    PIVOT_ZERO,
    cholesky,
    pivoted_qr,
    swept_qr,
    unwhiten,
    whiten,
)


class RowAlgebra(Protocol):
    """One factorisation, and what follows from it.

    Attributes
    ----------
    rank
        Number of pivots that are not below the cut: the rows in use.
    pivots : (min(nv, rows),)
        |R_kk|, falling.  With many coordinates they are taken along the graph of the loops
        (:func:`~srm_mbs.systems.projection.swept_qr`), and sorted here.
    row_squares : (rows,)
        Squares of the columns of W.
    """

    @property
    def rank(self) -> int: ...
    @property
    def pivots(self) -> FloatArray: ...
    @property
    def row_squares(self) -> FloatArray: ...

    def factor(self, M: FloatArray | None, G: FloatArray, cut: float = 0.0) -> None:
        """Factorise M (nv, nv), of which the upper triangle is read, None for 1, and G (rows, nv).

        Raises
        ------
        EvaluationError
            If M is not positive definite, or anything is not finite.
        """

    def tangential(self, w: FloatArray) -> FloatArray:
        """(1 - P) w (nv,): the part of w that the rows in use do not see, in the metric M."""

    def solve(self, g: FloatArray) -> FloatArray:
        """E g (nv,): the shortest x in the metric M with G x = g (rows,) in the rows in use."""

    def multiplier(self, white: FloatArray) -> FloatArray:
        """Pi R^-1 Q^T white (rows,), zero in rows that are not in use: the transpose of
        :meth:`solve` where M = 1."""

    def complement(self) -> FloatArray:
        """Orthonormal basis (nv, nv - rank) of L^T x over all x that the rows in use do not see."""


class DenseAlgebra:
    """:class:`RowAlgebra` by LAPACK, with pivots along ``order`` if there is one."""

    def __init__(self, order: Sequence[int] = ()) -> None:
        self._graph_order = order
        self.rank = 0
        self.pivots = self.row_squares = np.zeros(0)

    def factor(self, M: FloatArray | None, G: FloatArray, cut: float = 0.0) -> None:
        """See :class:`RowAlgebra`."""
        self._U = None if M is None else cholesky(M)
        W = np.asfortranarray(G.T) if self._U is None else whiten(self._U, np.asfortranarray(G.T))
        self.row_squares = (W * W).sum(axis=0)
        if not np.isfinite(self.row_squares).all():
            raise EvaluationError("the closures are not finite")
        floor = max(PIVOT_ZERO, cut)
        if self._graph_order:
            found = swept_qr(W, self._graph_order, min(W.shape), floor)
        else:
            found = pivoted_qr(W)
        self._packed, self._order, self._tau, pivots = found
        small = np.flatnonzero(pivots < floor)
        self.rank = int(small[0]) if small.size else len(pivots)
        self.pivots = np.sort(pivots)[::-1] if self._graph_order else pivots

    def _times_q(self, x: FloatArray, transposed: bool = False) -> FloatArray:
        """Q x or Q^T x for x (nv, k), with the reflections of the rows in use."""
        if self.rank == 0:
            return x
        # dormqr(side, trans, reflections, tau, x, size of its workspace)
        out: FloatArray = lapack.dormqr(
            "L",
            "T" if transposed else "N",
            self._packed[:, : self.rank],
            self._tau[: self.rank],
            np.asfortranarray(x),
            64 * x.shape[1],
        )[0]
        return out

    def tangential(self, w: FloatArray) -> FloatArray:
        """See :class:`RowAlgebra`."""
        white = (w if self._U is None else self._U @ w)[:, None]
        inside = self._times_q(white, transposed=True)
        inside[: self.rank] = 0.0
        return self._coloured(self._times_q(inside)[:, 0])

    def solve(self, g: FloatArray) -> FloatArray:
        """See :class:`RowAlgebra`."""
        x = np.zeros((self._packed.shape[0], 1))
        if self.rank:
            R = self._packed[: self.rank, : self.rank]
            x[: self.rank, 0] = whiten(R, g[self._order[: self.rank]])
        return self._coloured(self._times_q(x)[:, 0])

    def multiplier(self, white: FloatArray) -> FloatArray:
        """See :class:`RowAlgebra`."""
        out = np.zeros(self._packed.shape[1])
        if self.rank:
            R = self._packed[: self.rank, : self.rank]
            inside = self._times_q(white[:, None], transposed=True)[: self.rank, 0]
            out[self._order[: self.rank]] = unwhiten(R, inside)
        return out

    def complement(self) -> FloatArray:
        """See :class:`RowAlgebra`."""
        nv = self._packed.shape[0]
        return self._times_q(np.eye(nv)[:, self.rank :])

    def _coloured(self, white: FloatArray) -> FloatArray:
        return white if self._U is None else unwhiten(self._U, white)


class CompiledAlgebra:
    """:class:`RowAlgebra` by the kernel: sparse where that pays."""

    def __init__(self, twin: Any) -> None:
        self._twin = twin
        self._one: FloatArray | None = None

    @property
    def entries(self) -> int:
        """Numbers that Q and R hold."""
        return self._twin.entries  # type: ignore[no-any-return]

    @property
    def rank(self) -> int:
        """See :class:`RowAlgebra`."""
        return self._twin.rank  # type: ignore[no-any-return]

    @property
    def pivots(self) -> FloatArray:
        """See :class:`RowAlgebra`."""
        falling: FloatArray = np.sort(self._twin.pivots)[::-1]
        return falling

    @property
    def row_squares(self) -> FloatArray:
        """See :class:`RowAlgebra`."""
        return self._twin.row_squares  # type: ignore[no-any-return]

    def factor(self, M: FloatArray | None, G: FloatArray, cut: float = 0.0) -> None:
        """See :class:`RowAlgebra`."""
        if M is None:
            if self._one is None:
                self._one = np.eye(G.shape[1])
            M = self._one
        try:
            self._twin.factor(np.asfortranarray(M), np.ascontiguousarray(G), cut)
        except ArithmeticError:
            cholesky(M)  # says whether it is the mass matrix
            raise EvaluationError("the closures are not finite") from None

    def tangential(self, w: FloatArray) -> FloatArray:
        """See :class:`RowAlgebra`."""
        return self._twin.tangential(np.ascontiguousarray(w))  # type: ignore[no-any-return]

    def solve(self, g: FloatArray) -> FloatArray:
        """See :class:`RowAlgebra`."""
        return self._twin.solve(np.ascontiguousarray(g))  # type: ignore[no-any-return]

    def multiplier(self, white: FloatArray) -> FloatArray:
        """See :class:`RowAlgebra`."""
        return self._twin.multiplier(np.ascontiguousarray(white))  # type: ignore[no-any-return]

    def complement(self) -> FloatArray:
        """See :class:`RowAlgebra`."""
        basis: FloatArray = self._twin.complement()
        return basis.T


def row_algebra(
    pattern: BoolArray, model: pin.Model | None = None, choice: str = "auto"
) -> RowAlgebra:
    """The algebra of rows with entries where ``pattern`` (rows, nv) is true.

    Parameters
    ----------
    model
        The tree, if M is its mass matrix, and not 1.
    choice
        ``"dense"``: LAPACK; ``"kernel"``: the kernel; ``"auto"``: the kernel for many coordinates.
    """
    from srm_mbs._kernel import core

    rows, nv = pattern.shape
    parents = [-1] * nv if model is None else coordinate_parents(model)
    order = graph_order(pattern, parents)
    if core is None or choice == "dense" or (choice == "auto" and nv <= LARGE) or not rows:
        return DenseAlgebra(order)
    supports = [np.flatnonzero(p).tolist() for p in pattern]
    return CompiledAlgebra(
        core.Algebra(parents, supports, list(order), PIVOT_SHARE, PIVOT_WINDOW, "auto")
    )


def coordinate_parents(model: pin.Model) -> list[int]:
    """The next coordinate to the root of each velocity component (nv,); -1 at the root."""
    parents = [-1] * int(model.nv)
    for i in range(1, model.njoints):
        joint, parent = model.joints[i], model.joints[int(model.parents[i])]
        above = parent.idx_v + parent.nv - 1 if model.parents[i] else -1
        for k in range(joint.idx_v, joint.idx_v + joint.nv):
            parents[k], above = above, k
    return parents


def trees(model: pin.Model) -> list[slice]:
    """Velocity components of each tree that stands on the ground: the blocks of M."""
    starts = [model.joints[i].idx_v for i in range(1, model.njoints) if not model.parents[i]]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], int(model.nv)])]
