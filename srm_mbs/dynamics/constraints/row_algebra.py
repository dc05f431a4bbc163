r"""Column-pivoted QR of L^-1 G^T, used to analyse rank and mobility.

    M = L L^T,   W = L^-1 G^T,   W Pi = Q R,

as in :mod:`srm_mbs.dynamics.constraints.projection`, but with a threshold of its own for the
pivots, and with the null space of the rows.  The module has three parts.

*Order of the rows.*  Two rows are neighbours if they have coordinates, or ancestors of these, in
common.  With many coordinates the rows are factorised in the order of minimum degree, in postorder
of the elimination tree: along a chain of loops from one end to the other, in a tree of loops from
the leaves to the root.  Source: J. A. George, J. W. H. Liu, The evolution of the minimum degree
ordering algorithm, SIAM Review 31 (1989) 1.

*The factorisation* :class:`RowAlgebra`, by the kernel (``algebra.cpp``), whose sparse algebra
follows the graph of many loops, or by LAPACK where there is no kernel.

*Rank, null space, smallest singular value and minimum-norm solution* of A x = b.  With few
coordinates they come from the singular values of A.  With many they come from the factorisation
with M = 1, which costs a fraction of that; both agree unless A has singular values, or pivots, next
to the threshold.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import pinocchio as pin
from scipy.linalg import lapack

from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.dynamics.constraints.projection import (
    PIVOT_SHARE,
    PIVOT_WINDOW,
    PIVOT_ZERO,
    cholesky,
    pivoted_qr,
    swept_qr,
    unwhiten,
    whiten,
)
from srm_mbs.errors import EvaluationError
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import vector_elements

GRAPH_ORDER_ABOVE = 64
"""Coordinates above which pivots are taken along the graph of the loops."""

KERNEL_ABOVE = 0
"""Coordinates above which row algebra runs on the compiled kernel, where there is one: it takes a
tenth of the time of calls of LAPACK where these are few."""

SPARSE_ABOVE = 64
"""Columns above which singular values come from a sparse factorisation."""

COMPILED_ABOVE = 16
"""Columns above which singular values along a motion come from factorisations on the kernel."""

IN_ORDER = 1
"""Window of pivots of a factorisation for singular values alone: any order has the same, and with
the rows in that of the graph R fills least."""

CLEAR_GAP = 100.0
"""Ratio of neighbouring pivots from which the rows of the smaller ones depend on the others."""

VANISHING = 100.0
"""Singular values up to this multiple of the smallest vanish with it."""

ORTHOGONAL = 1e-12
"""Cosine of two vectors below which they are orthogonal but for rounding."""

LEAST_VALUE = 1e-9
"""Singular values below this vanish."""

LARGEST_FILL = 0.5
"""Largest part of the entries of W that are not zero for which an order is computed."""

LEAST_COMMON = 16
"""Number of loops that share a coordinate up to which the coordinate makes them neighbours."""


KEPT_ORDERS = 32
"""Patterns of which the order and the columns of rows are kept."""


def graph_order(pattern: BoolArray, parents: Sequence[int]) -> tuple[int, ...]:
    """All rows along the graph of the loops; () for up to 64 coordinates, or if W is full.

    Parameters
    ----------
    pattern : (rows, nv)
        Which entries of G may differ from zero.
    parents : (nv,)
        The next coordinate to the root, or -1.
    """
    if pattern.shape[1] <= GRAPH_ORDER_ABOVE or not len(pattern):
        return ()
    return _ordered(pattern.shape, np.packbits(pattern).tobytes(), tuple(parents))


@lru_cache(maxsize=KEPT_ORDERS)
def _ordered(shape: tuple[int, int], bits: bytes, parents: tuple[int, ...]) -> tuple[int, ...]:
    size = shape[0] * shape[1]
    pattern = np.unpackbits(np.frombuffer(bits, np.uint8), count=size).reshape(shape).astype(bool)
    supports = [_with_ancestors(np.flatnonzero(row).tolist(), parents) for row in pattern]
    if sum(map(len, supports)) > LARGEST_FILL * size:
        return ()
    alike: dict[frozenset[int], list[int]] = {}
    for row, support in enumerate(supports):
        alike.setdefault(support, []).append(row)
    groups = list(alike.values())
    order = _postordered(*_eliminated(_neighbours(list(alike))))
    return tuple(row for group in order for row in groups[group])


def _with_ancestors(support: Sequence[int], parents: Sequence[int]) -> frozenset[int]:
    found: set[int] = set()
    for k in support:
        while k >= 0 and k not in found:
            found.add(k)
            k = parents[k]
    return frozenset(found)


def _neighbours(supports: Sequence[frozenset[int]]) -> list[set[int]]:
    """The supports that each one meets; coordinates that very many have in common do not count."""
    of: dict[int, list[int]] = {}
    for k, support in enumerate(supports):
        for coordinate in support:
            of.setdefault(coordinate, []).append(k)
    most = max(LEAST_COMMON, 10 * int(np.sqrt(len(supports))))
    found: list[set[int]] = [set() for _ in supports]
    for together in of.values():
        if len(together) <= most:
            for k in together:
                found[k].update(together)
    for k, others in enumerate(found):
        others.discard(k)
    return found


def _eliminated(neighbours: list[set[int]]) -> tuple[list[int], list[int]]:
    """Nodes in the order of their degree when they are eliminated, which makes their neighbours
    meet, and the next neighbour to be eliminated, or -1."""
    heap = [(len(others), k) for k, others in enumerate(neighbours)]
    heapq.heapify(heap)
    place: dict[int, int] = {}
    met: list[set[int]] = [set() for _ in neighbours]
    while heap:
        degree, k = heapq.heappop(heap)
        if k in place or degree != len(neighbours[k]):
            continue
        place[k] = len(place)
        met[k] = others = neighbours[k]
        for other in others:
            own = neighbours[other]
            own |= others
            own -= {k, other}
            heapq.heappush(heap, (len(own), other))
    parents = [min(others, key=place.__getitem__, default=-1) for others in met]
    return list(place), parents


def _postordered(order: Sequence[int], parents: Sequence[int]) -> list[int]:
    """``order`` with each node after those that it is the parent of, and next to them."""
    children: dict[int, list[int]] = {}
    for k in order:
        children.setdefault(parents[k], []).append(k)
    out: list[int] = []
    waiting = children.get(-1, [])[:]
    # From the root each node before its children, the last ones first; then reversed.
    while waiting:
        k = waiting.pop()
        out.append(k)
        waiting += children.get(k, [])
    return out[::-1]


class RowAlgebra(Protocol):
    """A factorisation of M and G, and the products and solutions that it gives.

    Attributes
    ----------
    rank
        Number of pivots that are not below the cut: the rows in use.
    pivots : (min(nv, rows),)
        |R_kk|, falling.  With many coordinates they are taken along the graph of the loops
        (:func:`~srm_mbs.dynamics.constraints.projection.swept_qr`), and sorted here.
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
        """(1 - P) w (nv,): the part of w in the null space of the rows in use, M-orthogonally."""

    def solve(self, g: FloatArray) -> FloatArray:
        """E g (nv,): the shortest x in the metric M with G x = g (rows,) in the rows in use."""


class DenseAlgebra:
    """:class:`RowAlgebra` by LAPACK, with pivots along ``order`` if there is one."""

    def __init__(self, order: Sequence[int] = ()) -> None:
        self._graph_order = order
        self.rank = 0
        self.pivots = self.row_squares = np.zeros(0)

    def factor(self, M: FloatArray | None, G: FloatArray, cut: float = 0.0) -> None:
        self._U = None if M is None else cholesky(M)
        W = G.T if self._U is None else whiten(self._U, G.T)
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
        return lapack.dormqr(  # type: ignore[no-any-return]
            side="L",
            trans="T" if transposed else "N",
            a=self._packed[:, : self.rank],
            tau=self._tau[: self.rank],
            c=x,
            lwork=64 * x.shape[1],
        )[0]

    def tangential(self, w: FloatArray) -> FloatArray:
        white = (w if self._U is None else self._U @ w)[:, None]
        inside = self._times_q(white, transposed=True)
        inside[: self.rank] = 0.0
        return self._coloured(self._times_q(inside)[:, 0])

    def solve(self, g: FloatArray) -> FloatArray:
        x = np.zeros((self._packed.shape[0], 1))
        if self.rank:
            R = self._packed[: self.rank, : self.rank]
            x[: self.rank, 0] = whiten(R, g[self._order[: self.rank]])
        return self._coloured(self._times_q(x)[:, 0])

    def _coloured(self, white: FloatArray) -> FloatArray:
        return white if self._U is None else unwhiten(self._U, white)


class CompiledAlgebra:
    """:class:`RowAlgebra` by the kernel's ``algebra``: sparse where that pays."""

    def __init__(self, algebra: Any) -> None:
        self._algebra = algebra
        self._one: FloatArray | None = None

    @property
    def entries(self) -> int:
        """Numbers that Q and R hold."""
        return self._algebra.entries  # type: ignore[no-any-return]

    @property
    def rank(self) -> int:
        return self._algebra.rank  # type: ignore[no-any-return]

    @property
    def pivots(self) -> FloatArray:
        return np.sort(self._algebra.pivots)[::-1]

    @property
    def row_squares(self) -> FloatArray:
        return self._algebra.row_squares  # type: ignore[no-any-return]

    def factor(self, M: FloatArray | None, G: FloatArray, cut: float = 0.0) -> None:
        if M is None:
            if self._one is None:
                self._one = np.eye(G.shape[1])
            M = self._one
        try:
            self._algebra.factor(np.asfortranarray(M), np.ascontiguousarray(G), cut)
        except ArithmeticError:
            cholesky(M)  # raises if the fault is in the mass matrix
            raise EvaluationError("the closures are not finite") from None

    def tangential(self, w: FloatArray) -> FloatArray:
        return self._algebra.tangential(np.ascontiguousarray(w))  # type: ignore[no-any-return]

    def solve(self, g: FloatArray) -> FloatArray:
        return self._algebra.solve(np.ascontiguousarray(g))  # type: ignore[no-any-return]

    def multiplier(self, white: FloatArray) -> FloatArray:
        """Pi R^-1 Q^T white (rows,), zero in rows that are not in use: the transpose of
        :meth:`solve` where M = 1."""
        return self._algebra.multiplier(np.ascontiguousarray(white))  # type: ignore[no-any-return]

    @property
    def compiled(self) -> Any:
        """The kernel's own."""
        return self._algebra

    def combinations(self, G: FloatArray) -> FloatArray:
        """Of each row of G (rows, nv), which was factorised with M = 1, the combination (rows,
        rows) of the rows in use nearest to it; rows that are not in use have no part in any."""
        return self._algebra.combinations(np.ascontiguousarray(G))  # type: ignore[no-any-return]

    def complement(self) -> FloatArray:
        """Orthonormal basis (nv, nv - rank) of L^T x over the null space x of the rows in use."""
        return self._algebra.complement().T  # type: ignore[no-any-return]

    def smallest_of_all(self, G: FloatArray) -> float:
        """The smallest singular value of all rows of G (rows, nv), however small; in one call."""
        try:
            return self._algebra.smallest(np.ascontiguousarray(G))  # type: ignore[no-any-return]
        except ArithmeticError:
            raise EvaluationError("the closures are not finite") from None

    def smallest(self, G: FloatArray, cut: float) -> tuple[int, float]:
        """Rank of G, with pivots below ``cut`` as zero, and its smallest singular value, 0 if rows
        depend on each other; in one call, so that threads may share the algebra."""
        try:
            return self._algebra.weakest(np.ascontiguousarray(G), cut)  # type: ignore[no-any-return]
        except ArithmeticError:
            raise EvaluationError("the closures are not finite") from None


def row_algebra(pattern: BoolArray, parents: Sequence[int] | None = None) -> RowAlgebra:
    """The algebra of rows with entries where ``pattern`` (rows, nv) is true: by the kernel, or by
    LAPACK without one or for at most ``KERNEL_ABOVE`` coordinates.

    Parameters
    ----------
    parents
        Those of the coordinates (:func:`coordinate_parents`), if M is a mass matrix, and not 1.
    """
    from srm_mbs._kernel import core

    rows, nv = pattern.shape
    parents = [-1] * nv if parents is None else parents
    order = graph_order(pattern, parents)
    if core is None or nv <= KERNEL_ABOVE or not rows:
        return DenseAlgebra(order)
    return _compiled(pattern, parents, order)


def _compiled(
    pattern: BoolArray,
    parents: Sequence[int],
    order: Sequence[int],
    window: int = PIVOT_WINDOW,
) -> CompiledAlgebra:
    from srm_mbs._kernel import core

    supports = _supports(pattern.shape, np.packbits(pattern).tobytes())
    return CompiledAlgebra(
        core.Algebra(list(parents), supports, list(order), PIVOT_SHARE, window, "auto")  # type: ignore[union-attr]
    )


@lru_cache(maxsize=KEPT_ORDERS)
def _supports(shape: tuple[int, int], bits: bytes) -> list[list[int]]:
    """The columns of each row of a pattern, from its bits; nothing may change them.  Variants of a
    mechanism have the same."""
    entries = np.unpackbits(np.frombuffer(bits, dtype=np.uint8), count=shape[0] * shape[1])
    return [np.flatnonzero(row).tolist() for row in entries.reshape(shape)]


def coordinate_parents(model: pin.Model) -> list[int]:
    """The next coordinate to the root of each velocity component (nv,); -1 at the root."""
    parents = [-1] * int(model.nv)
    bodies, starts, sizes = map(vector_elements, (model.parents, model.idx_vs, model.nvs))
    for i in range(1, model.njoints):
        parent = bodies[i]
        above = starts[parent] + sizes[parent] - 1 if parent else -1
        for k in range(starts[i], starts[i] + sizes[i]):
            parents[k], above = above, k
    return parents


def trees(model: pin.Model) -> list[slice]:
    """Velocity components of each tree that is rooted in the ground: the blocks of M."""
    at, parents = vector_elements(model.idx_vs), vector_elements(model.parents)
    starts = [at[i] for i in range(1, model.njoints) if not parents[i]]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], int(model.nv)])]


INERT = 1e-9
"""Rows of A below this are zero, as the out-of-plane ones of a planar loop."""


@dataclass(frozen=True)
class RankRevealingQR:
    """Null space and solution of A x = b, with singular values, or pivots, below a cut as zero.

    Attributes
    ----------
    null : (n, n - rank)
        Orthonormal basis of the x with A x = 0.
    solve
        b (m,) -> the shortest x (n,) with A x = b, as far as there is one.
    """

    null: FloatArray
    solve: Callable[[FloatArray], FloatArray]


def rank_revealing_qr(A: FloatArray, cut: float) -> RankRevealingQR:
    """Null space and solution of A (m, n)."""
    algebra = _pivoted(A, cut)
    if algebra is not None:
        return RankRevealingQR(algebra.complement(), algebra.solve)
    left, size, right = np.linalg.svd(A)
    rank = int(np.sum(size > cut))

    def solve(b: FloatArray) -> FloatArray:
        return right[:rank].T @ ((left[:, :rank].T @ b) / size[:rank])  # type: ignore[no-any-return]

    return RankRevealingQR(right[rank:].T, solve)


def null_basis(A: FloatArray, cut: float) -> FloatArray:
    """Orthonormal basis (n, n - rank) of the x with A x = 0, for A (m, n) with everything below
    ``cut`` as zero."""
    return rank_revealing_qr(A, cut).null


def min_norm_solution(A: FloatArray, b: FloatArray, rcond: float) -> FloatArray:
    """The shortest x (n,) that minimises |A x - b|; singular values below rcond times the largest
    count as zero.  With many columns the rows in use are satisfied, dependent ones are left out."""
    longest = float(np.sqrt((A * A).sum(axis=1).max(initial=0.0)))
    algebra = _pivoted(A, rcond * longest)
    if algebra is not None:
        return algebra.solve(b)
    return np.asarray(np.linalg.lstsq(A, b, rcond=rcond)[0], dtype=np.float64)


def smallest_singular_value(A: FloatArray, zero: float) -> float:
    """The smallest singular value of A (m, n) above ``zero``; infinite if there is none."""
    found = SingularValues(A != 0.0).smallest(A, zero)
    if found is not None:
        return found[1]
    size = np.linalg.svd(A, compute_uv=False)
    return float(size[size > zero].min(initial=np.inf))


def active_rows(A: FloatArray) -> BoolArray:
    """Which rows of A (..., m, n) are not zero (..., m)."""
    active: BoolArray = np.sqrt(np.einsum("...ij,...ij->...i", A, A)) > INERT
    return active


class SingularValues:
    """Singular values of matrices whose entries lie in the same places; keeps what follows from
    them.  Threads may share it.

    Parameters
    ----------
    pattern : (rows, columns)
        Which entries may differ from zero.
    """

    def __init__(self, pattern: BoolArray) -> None:
        self._pattern = pattern
        self._algebras: dict[bytes, RowAlgebra] = {}
        self._compiled: dict[tuple[bytes, int], CompiledAlgebra] = {}
        self._parts: dict[bytes, SingularValues] = {}

    @cached_property
    def supports(self) -> list[list[int]]:
        """The columns of each row in which it may have entries, ascending."""
        return [np.flatnonzero(row).tolist() for row in self._pattern]

    def of_rows(self, active: BoolArray) -> SingularValues:
        """Singular values of matrices that consist of the ``active`` rows (rows,)."""
        key = active.tobytes()
        if key not in self._parts:
            self._parts[key] = SingularValues(self._pattern[active])
        return self._parts[key]

    def compiled(self, active: BoolArray, window: int = IN_ORDER) -> CompiledAlgebra | None:
        """The kernel's algebra of the ``active`` rows (rows,); None for few columns, for which
        LAPACK is as fast.  ``window``: number of rows along the graph of the loops of which the
        largest is the next pivot."""
        if self._pattern.shape[1] <= COMPILED_ABOVE or not active.any():
            return None
        key = active.tobytes(), window
        found = self._compiled.get(key)
        if found is None:
            pattern = self._pattern[active]
            parents = [-1] * pattern.shape[1]
            order = graph_order(pattern, parents)
            found = self._compiled[key] = _compiled(pattern, parents, order, window)
        return found

    def __call__(self, matrices: FloatArray, k: int) -> FloatArray:
        """The k-th largest singular values (n,), k from 1, of ``matrices`` (n, rows, columns)."""
        if matrices.shape[2] > SPARSE_ABOVE:
            return np.array([self._of_one(A, k) for A in matrices])
        return np.asarray(np.linalg.svd(matrices, compute_uv=False)[:, k - 1], dtype=np.float64)

    def smallest(self, A: FloatArray, zero: float) -> tuple[int, float] | None:
        """Rank of A (rows, columns) and its smallest singular value, by a sparse factorisation of
        the rows that are not zero; None if there is no kernel, or A has few columns, or where these
        rows depend on each other: the rows in use have other singular values."""
        if A.shape[1] <= SPARSE_ABOVE:
            return None
        active = active_rows(A)
        key = active.tobytes()
        if key not in self._algebras:
            self._algebras[key] = row_algebra(self._pattern[active])
        algebra = self._algebras[key]
        if not isinstance(algebra, CompiledAlgebra):
            return None
        rank, value = algebra.smallest(A[active], zero)
        return (rank, value) if 0 < rank == np.count_nonzero(active) else None

    def near_null_spaces(self, A: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
        """Orthonormal bases (m, m - r) and (n, n - r) of the left and right singular vectors of A
        (m, n) beyond the r singular values above ``VANISHING`` times the k-th largest, k from 1,
        and above ``LEAST_VALUE``: those that vanish where A loses rank.

        With many columns they follow from the factorisation, if its pivots have a clear gap there:
        A = Q R Pi^T with the rows in use first, of which the others are the combinations
        Pi R11^-1 R12, up to rows of the size of the pivots that are left.
        """
        if A.shape[1] > SPARSE_ABOVE:
            found = self._factored_null_spaces(A, k)
            if found is not None:
                return found
        left, size, right = np.linalg.svd(A)
        rank = int(np.sum(size > max(VANISHING * size[k - 1], LEAST_VALUE)))
        return left[:, rank:], right[rank:].T

    def _factored_null_spaces(self, A: FloatArray, k: int) -> tuple[FloatArray, FloatArray] | None:
        every = np.ones(len(A), dtype=bool)
        algebra, in_order = self.compiled(every, PIVOT_WINDOW), self.compiled(every)
        if algebra is None or in_order is None or k > len(A):
            return None
        smallest = in_order.smallest_of_all(A) if k == len(A) else 0.0
        cut = max(VANISHING * smallest, LEAST_VALUE)
        algebra.factor(None, A, cut)
        pivots, rank = algebra.pivots, algebra.rank
        if not 0 < rank < len(pivots) or not pivots[rank - 1] > CLEAR_GAP * pivots[rank]:
            return None
        combinations = algebra.combinations(A)
        others = np.diag(combinations) == 0.0
        null = (np.eye(len(A)) - combinations)[others].T
        gram = null.T @ null
        size = np.sqrt(np.diag(gram))
        # Of loops that lose rank each by themselves the columns are orthogonal.
        if (np.abs(gram - np.diag(size**2)) < ORTHOGONAL * np.outer(size, size)).all():
            return null / size, algebra.complement()
        return np.linalg.qr(null)[0], algebra.complement()

    def _of_one(self, A: FloatArray, k: int) -> float:
        found = self.smallest(A, PIVOT_ZERO)
        if found is not None and found[0] == k:
            return found[1]
        return float(np.linalg.svd(A, compute_uv=False)[k - 1])


def singular_value(A: FloatArray, k: int) -> float:
    """The k-th largest singular value of A (m, n), k from 1."""
    return float(SingularValues(A != 0.0)(A[None], k)[0])


def _pivoted(A: FloatArray, cut: float) -> CompiledAlgebra | None:
    """The factorisation of A by the kernel, if it is there and A has many columns."""
    if A.shape[1] <= SPARSE_ABOVE:
        return None
    algebra = row_algebra(A != 0.0)
    if not isinstance(algebra, CompiledAlgebra):
        return None
    algebra.factor(None, A, cut)
    return algebra
