r"""The constraint algebra of one stage: E, P, rank and sigma from one pivoted factorisation.

With M = L L^T and W = L^{-1} G^T a column-pivoted QR, W Pi = Q R, gives (docs/notation.md)

    E g = L^{-T} Q R^{-T} Pi^T g,        P v = L^{-T} Q Q^T L^T v,
    yhat = E gamma,                      gamma = W^T (L^{-1} f) + Gdot v.

Householder reflections (LAPACK geqp3) keep Q orthogonal to round-off, so that no
reorthogonalisation is needed.  Truncating or damping small pivots would delete the weak direction
next to a singular configuration; pivots are dropped for redundancy only, or in the zone, where a
prediction takes their place.

LAPACK is called directly: the checks of ``scipy.linalg.qr`` and ``solve_triangular`` take 10 to
30 us each, as long as a whole stage of a small mechanism.  What every stage calls has its arguments
by position, because a name takes half as long as a solve.

The next pivot is the column of the largest remaining norm.  With many loops the search follows
their graph instead (:func:`swept_qr`): the fill-in of a pivot then stays next to it, so that the
cost of the kernel's sparse factorisation grows linearly with the number of loops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg import blas, lapack

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.errors import EvaluationError

PIVOT_ZERO = 1e-13
"""Pivots (of scaled rows) below this are zero."""

_UPPER, _TRANSPOSED = 0, 1
"""Arguments ``lower`` and ``trans`` of ``dtrtrs``."""


def cholesky(M: FloatArray) -> FloatArray:
    """U (nv, nv), upper, with M = U^T U; reads the upper triangle of M only.

    Raises
    ------
    EvaluationError
        If M is not positive definite or not finite.
    """
    U, info = lapack.dpotrf(M)
    if info != 0:
        raise EvaluationError(
            "the mass matrix is not positive definite or not finite "
            f"(leading minor {info}): a joint that moves no inertia, or a state that is not finite"
        )
    return U  # type: ignore[no-any-return]


def symmetric(M: FloatArray) -> FloatArray:
    """M (nv, nv) whole, of which Pinocchio computes the upper triangle."""
    upper = np.triu(M)
    return upper + np.triu(upper, 1).T


def whiten(U: FloatArray, right: FloatArray) -> FloatArray:
    """L^-1 right = U^-T right, for ``right`` (n,) or (n, k)."""
    return lapack.dtrtrs(U, right, _UPPER, _TRANSPOSED)[0]  # type: ignore[no-any-return]


def _whiten_in_place(U: FloatArray, right: FloatArray) -> None:
    """As :func:`whiten`, for ``right`` (n, k) in Fortran's order, which it replaces."""
    # No unit diagonal, the leading dimension of U, and leave to overwrite.
    lapack.dtrtrs(U, right, _UPPER, _TRANSPOSED, 0, len(U), 1)


def unwhiten(U: FloatArray, right: FloatArray) -> FloatArray:
    """L^-T right = U^-1 right, for ``right`` (n,) or (n, k)."""
    return lapack.dtrtrs(U, right)[0]  # type: ignore[no-any-return]


def pivoted_qr(W: FloatArray) -> tuple[FloatArray, IndexArray, FloatArray, FloatArray]:
    """Column-pivoted QR of W (nv, m): packed factor, permutation (m,), tau, |R_kk| (k,).

    The packed factor has R above and on its diagonal, the reflections of Q below it.
    """
    packed, permutation, tau, _, _ = lapack.dgeqp3(W)
    return packed, permutation - 1, tau, np.abs(packed.diagonal())  # LAPACK counts from 1


def q_columns(packed: FloatArray, tau: FloatArray, rank: int) -> FloatArray:
    """The first ``rank`` columns of Q (nv, rank) from :func:`pivoted_qr`."""
    if rank == 0:
        return packed[:, :0]
    return lapack.dorgqr(packed[:, :rank], tau[:rank])[0]  # type: ignore[no-any-return]


PIVOT_SHARE = 0.01
"""Least norm of a pivot column, over the largest, where some columns depend on others."""

PIVOT_WINDOW = 16
"""Number of neighbouring columns along the graph, the largest of which is the next pivot."""

ALIKE = 1.0 - 1e-8
"""Ratio of squared norms above which they count as equal: rounding may make that difference."""

ABOVE = 1.0 + 1e-12
"""Ratio of a norm to a floor up to which it counts as below it: rounding may move it there."""


def swept_qr(
    W: FloatArray, order: Sequence[int], rank: int, floor: float
) -> tuple[FloatArray, IndexArray, FloatArray, FloatArray]:
    """As :func:`pivoted_qr`, with pivots along ``order`` (m,).

    The next pivot is the largest in a window that moves along the order, so that neighbouring
    columns are pivoted as by :func:`pivoted_qr`.  If it is below ``floor``, all columns in the
    window wait for the next sweep, which runs in the opposite direction, so that pivots below the
    floor come after all others.  If ``rank`` is less than the number of columns, columns below
    ``PIVOT_SHARE`` of the largest norm at the start of the sweep wait, too: columns that depend on
    others but for the error of a stage must not take the place of independent ones.  The kernel
    has the same algorithm in ``swept_projection.cpp``.

    Parameters
    ----------
    rank
        Number of pivots; columns that are left over come last, with |R_kk| = 0.
    floor
        Zero or more; a smaller pivot is not in use.
    """
    A = np.array(W, order="F")
    tau = np.zeros(min(A.shape))
    pivots = np.zeros(len(tau))
    taken: list[int] = []
    waiting = list(order)
    forward = True
    while len(taken) < rank:
        largest = float(np.sqrt((A[len(taken) :, waiting] ** 2).sum(axis=0).max()))
        if not math.isfinite(largest):
            pivots[:] = math.nan
            break
        least = PIVOT_SHARE * largest if rank < A.shape[1] else 0.0
        if largest > floor * ABOVE:
            least = max(least, floor)
        deferred: list[int] = []
        before = k = len(taken)
        coming = waiting[::-1] if forward else waiting[:]
        window: list[int] = []
        open_ = np.zeros(A.shape[1], bool)
        open_[waiting] = True
        while k < rank:
            while coming and len(window) < PIVOT_WINDOW:
                window.append(coming.pop())
            if not window:
                break
            squares = (A[k:, window] ** 2).sum(axis=0)
            place = int(np.argmax(squares >= ALIKE * squares.max()))
            size = math.sqrt(squares[place])
            if size == 0.0 or size < least:
                deferred += window
                window = []
                continue
            j = window.pop(place)
            column = A[k:, j]
            alpha = float(column[0])
            beta = -math.copysign(size, alpha)
            tau[k] = (beta - alpha) / beta
            v = column / (alpha - beta)
            v[0] = 1.0
            open_[j] = False
            others = A[k:, open_]
            A[k:, open_] = others - np.outer(tau[k] * v, v @ others)
            A[k:, j] = v
            A[k, j] = beta
            pivots[k] = size
            taken.append(j)
            k += 1
        deferred += window + coming[::-1]
        if k == before:
            break
        waiting = deferred if forward else deferred[::-1]
        forward = not forward
    permutation = np.array(taken + waiting)
    return np.asfortranarray(A[:, permutation]), permutation, tau, pivots


class Projection:
    """Factorisation of M and G at one stage; reused from stage to stage.

    Parameters
    ----------
    rank
        Structural rank: the number of pivots that are used in a regular configuration.
    sigma_ref
        Median of the last structural pivot over the closed samples of the load-time analysis.
    order
        The rows along the graph of the loops, for many of them; see
        :func:`~srm_mbs.dynamics.constraints.row_algebra.graph_order`.

    Attributes
    ----------
    factorisations
        How many factorisations were done; 0 for a mechanism without closures.
    """

    _white = np.zeros((0, 0))  # of no rows and coordinates: the first factor() allocates its own

    def __init__(self, rank: int, sigma_ref: float, order: Sequence[int] = ()) -> None:
        self.structural_rank = rank
        self._graph_order = order
        self.sigma_ref = sigma_ref
        self.factorisations = 0
        self.sigma = np.inf
        self.rank = rank
        self.rank_deficient = False
        self.held: FloatArray | None = None

    def _allocate(self, m: int, nv: int) -> None:
        """Workspace of :meth:`factor` for m rows: (G, f), which becomes (W, L^-1 f) in place, and
        gamma with a number before it, because LAPACK counts rows from 1."""
        right = np.empty((m + 1, nv))
        self._rows, self._force = right[:m], right[m]
        self._white = right.T
        self._W = self._white[:, :m]
        self._one_before = np.zeros(m + 1)
        self._gamma = self._one_before[1:]

    def factor(
        self,
        M: FloatArray,
        G: FloatArray,
        f: FloatArray,
        bias: FloatArray,
        threshold: float | None,
    ) -> None:
        """Factorise M (nv, nv), G (m, nv) and solve for the multiplier with f (nv,), bias (m,).

        ``threshold`` drops every pivot below threshold * sigma_ref (the zone); ``None`` uses all
        structural pivots.
        """
        self.factorisations += 1
        m, nv = G.shape
        if self._white.shape != (nv, m + 1):
            self._allocate(m, nv)
        self._rows[:] = G
        self._force[:] = f
        self.U = cholesky(M)
        _whiten_in_place(self.U, self._white)
        W, self.white_force = self._W, self._force
        # W^T L^-1 f + bias; the zeros and ones are offsets and strides.
        self._gamma[:] = blas.dgemv(1.0, W, self._force, 1.0, bias, 0, 1, 0, 1, _TRANSPOSED)
        structural = self.structural_rank
        floor = PIVOT_ZERO if threshold is None else max(PIVOT_ZERO, threshold * self.sigma_ref)
        if self._graph_order:
            packed, order, tau, pivots = swept_qr(W, self._graph_order, structural, floor)
            self._from_one, self._pivots = order + 1, pivots
            smallest = float(pivots[:structural].min())
        else:
            packed, self._from_one, tau, _, _ = lapack.dgeqp3(W, 3 * (m + 1), 1)
            smallest = abs(packed.item(structural - 1, structural - 1))
        self.sigma = smallest / self.sigma_ref
        if not self.sigma >= 0.0:
            raise EvaluationError("the mass matrix or the closures are not finite")
        rank = structural
        while rank > 0 and abs(packed.item(rank - 1, rank - 1)) < floor:
            rank -= 1
        self.rank = rank
        self.rank_deficient = rank < structural
        if rank < m:
            packed, tau, self._from_one = packed[:, :rank], tau[:rank], self._from_one[:rank]
        self.R = packed
        self.Q = lapack.dorgqr(packed, tau)[0] if rank else packed
        self.held = None
        self.white_multiplier = self._normal(self._one_before.take(self._from_one))

    @property
    def order(self) -> IndexArray:
        """The rows in use (rank,), in the order of their pivots."""
        return self._from_one - 1

    def hold(self, normals: FloatArray) -> None:
        """Keep the motion tangential to the last of ``normals`` (nv, k), which replace the dropped
        rows: their own normals are not determined here."""
        missing = self.structural_rank - self.rank
        white = self.U @ normals[:, -missing:]
        for _ in range(2):
            white = white - self.Q @ (self.Q.T @ white)
        self.held = np.linalg.qr(white)[0]
        self.white_multiplier = self.white_multiplier + self.held @ (
            self.held.T @ (self.white_force - self.white_multiplier)
        )

    def completed(self, white: FloatArray, predicted: FloatArray) -> FloatArray:
        """``white`` (nv,), L^T times a multiplier of the rows in use, and of ``predicted`` (nv,), a
        whole multiplier, the part of the dropped rows: L^T (1 - P) predicted."""
        prediction = self.U @ predicted
        out: FloatArray = white + prediction - self.Q @ (self.Q.T @ prediction)
        return out

    def normals(self) -> FloatArray:
        """L^-T Q (nv, rank): M-orthonormal normals of the rows in use, the weakest last."""
        if not self._graph_order:
            return self.unwhiten(self.Q)
        falling = np.argsort(-self._pivots[: self.rank], kind="stable")
        return self.unwhiten(self.Q[:, falling])

    def weak_normals(self) -> FloatArray:
        """The last of :meth:`normals` (nv, k), those of rows that may lose their rank in a step.

        Along the graph of many loops these are the rows with pivots below ``sigma_ref``, the usual
        smallest one: all normals would be nv numbers for each of the rows.
        """
        if not self._graph_order:
            return self.normals()
        weak = int(np.count_nonzero(self._pivots[: self.rank] < self.sigma_ref))
        return self.normals()[:, self.rank - weak :]

    def complement(self) -> FloatArray:
        """Orthonormal white vectors (nv, nv - rank), orthogonal to the rows in use."""
        return np.linalg.qr(self.Q, mode="complete")[0][:, self.rank :]

    def normal(self, rows: FloatArray) -> FloatArray:
        """L^T E rows (nv,) for errors ``rows`` (m,)."""
        return self._normal(rows.take(self._from_one - 1))

    def _normal(self, right: FloatArray) -> FloatArray:
        """Q R^-T right (nv,) for ``right`` (rank,) in pivot order."""
        if self.rank == 0:
            return np.zeros(self.U.shape[0])
        # Two calls less than by whiten: each stage comes here twice.
        return self.Q.dot(lapack.dtrtrs(self.R, right, _UPPER, _TRANSPOSED)[0])  # type: ignore[no-any-return]

    def unwhiten(self, right: FloatArray) -> FloatArray:
        """L^-T right."""
        return unwhiten(self.U, right)

    def white_project(self, w: FloatArray) -> FloatArray:
        """Q Q^T L^T w (nv,), held normals included."""
        white = self.U.dot(w)
        out: FloatArray = self.Q.dot(self.Q.T.dot(white))
        return out if self.held is None else out + self.held @ (self.held.T @ white)

    def acceleration_by(self, f: FloatArray) -> FloatArray:
        """M^-1 f (nv,) of the forces f (nv,)."""
        return self.unwhiten(whiten(self.U, f))

    def tangential_force(self, f: FloatArray) -> FloatArray:
        """M (1 - P) M^-1 f (nv,): what the rows in use leave of the forces f (nv,)."""
        white = whiten(self.U, f)
        return self.U.T @ (white - self.Q @ (self.Q.T @ white))

    def project(self, w: FloatArray) -> FloatArray:
        """P w (nv,)."""
        return self.unwhiten(self.white_project(w))
