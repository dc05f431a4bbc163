r"""Rank, null vectors, weakest singular value and shortest solution of rows A x = b.

Few coordinates: singular values.  Many: the pivoted factorisation A^T Pi = Q R on the pattern of A
(:mod:`srm_mbs.systems.pivoting`), whose cost follows the graph of the loops.  Both say the same
unless A has singular values, or pivots, next to the cut.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.systems.ordering import LARGE
from srm_mbs.systems.pivoting import CompiledAlgebra, RowAlgebra, row_algebra
from srm_mbs.systems.projection import PIVOT_ZERO

INERT = 1e-9
"""Rows of A below this are zero, as the out-of-plane ones of a planar loop."""


@dataclass(frozen=True)
class Ranked:
    """What is left of A (m, n) when singular values, or pivots, below a cut are zero.

    Attributes
    ----------
    null : (n, n - rank)
        Orthonormal basis of the x with A x = 0.
    solve
        b (m,) -> the shortest x (n,) with A x = b, as far as there is one.
    """

    null: FloatArray
    solve: Callable[[FloatArray], FloatArray]


def ranked(A: FloatArray, cut: float) -> Ranked:
    """A (m, n) with everything below ``cut`` as zero."""
    algebra = _pivoted(A, cut)
    if algebra is not None:
        return Ranked(algebra.complement(), algebra.solve)
    left, size, right = np.linalg.svd(A)
    rank = int(np.sum(size > cut))

    def solve(b: FloatArray) -> FloatArray:
        out: FloatArray = right[:rank].T @ ((left[:, :rank].T @ b) / size[:rank])
        return out

    return Ranked(right[rank:].T, solve)


def null_basis(A: FloatArray, cut: float) -> FloatArray:
    """Orthonormal basis (n, n - rank) of the x with A x = 0, for A (m, n) with everything below
    ``cut`` as zero."""
    algebra = _pivoted(A, cut)
    if algebra is not None:
        return algebra.complement()
    _, size, right = np.linalg.svd(A)
    out: FloatArray = right[int(np.sum(size > cut)) :].T
    return out


def shortest(A: FloatArray, b: FloatArray, rcond: float) -> FloatArray:
    """The shortest x (n,) with the least |A x - b|; what is below rcond times the largest singular
    value is zero.  By pivots, the rows in use are satisfied and dependent ones left out."""
    longest = float(np.sqrt((A * A).sum(axis=1).max(initial=0.0)))
    algebra = _pivoted(A, rcond * longest)
    if algebra is not None:
        return algebra.solve(b)
    out: FloatArray = np.asarray(np.linalg.lstsq(A, b, rcond=rcond)[0], dtype=np.float64)
    return out


def weakest(A: FloatArray, zero: float) -> float:
    """The smallest singular value of A (m, n) above ``zero``; infinite if there is none."""
    found = _weakest_pivoted(A, zero)
    if found is not None:
        return found[1]
    size = np.linalg.svd(A, compute_uv=False)
    return float(size[size > zero].min(initial=np.inf))


def singular_value(A: FloatArray, k: int) -> float:
    """The k-th largest singular value of A (m, n), k from 1."""
    found = _weakest_pivoted(A, PIVOT_ZERO)
    if found is not None and found[0] == k:
        return found[1]
    return float(np.linalg.svd(A, compute_uv=False)[k - 1])


def _pivoted(A: FloatArray, cut: float) -> RowAlgebra | None:
    """The factorisation of A by the kernel, if it is there and A has many columns."""
    if A.shape[1] <= LARGE:
        return None
    algebra = row_algebra(A != 0.0)
    if not isinstance(algebra, CompiledAlgebra):
        return None
    algebra.factor(None, A, cut)
    return algebra


def _weakest_pivoted(A: FloatArray, zero: float) -> tuple[int, float] | None:
    """Rank and weakest singular value, by the factorisation of the rows that are not zero; None
    where these depend on each other: the rows in use have other singular values."""
    rows = A[np.sqrt((A * A).sum(axis=1)) > INERT]
    algebra = _pivoted(rows, zero)
    if algebra is None or not 0 < algebra.rank == len(rows):
        return None
    from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

    n = A.shape[1]
    # A^+ A^+T has the largest eigenvalue 1 / weakest^2.
    inverse = LinearOperator(
        (n, n), matvec=lambda x: algebra.solve(algebra.multiplier(np.ravel(x))), dtype=float
    )
    start = np.random.default_rng(0).standard_normal(n)
    try:
        values = eigsh(inverse, 1, which="LM", v0=start, return_eigenvectors=False)
    except ArpackError:
        return None
    return algebra.rank, float(1.0 / np.sqrt(values[0]))
