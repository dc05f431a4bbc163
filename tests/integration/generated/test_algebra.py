"""The generated algebra of random systems with zeros is that of LAPACK."""

from __future__ import annotations

import ctypes
import shutil
from typing import Any

import numpy as np
import pytest
from scipy.linalg import qr, solve_triangular

from srm_mbs._typing import FloatArray
from srm_mbs.integration.generated.algebra import algebra_of
from srm_mbs.integration.generated.code_cache import compile_and_load
from srm_mbs.integration.generated.source import PROTOTYPES

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


class _Algebra:
    """A random tree of ``nv`` coordinates with rows on few of them, the last one on all, of which
    ``dependent`` are sums of others; and its algebra."""

    def __init__(self, nv: int, rows: int, dependent: int) -> None:
        rng = np.random.default_rng(nv)
        parents = [int(rng.integers(-1, i)) for i in range(nv)]
        U = np.diag(rng.uniform(0.5, 2.0, nv))  # M = U U^T has no entries off the tree
        paths = []
        for i, parent in enumerate(parents):
            paths.append([i] + (paths[parent] if parent >= 0 else []))
            U[paths[i][1:], i] = rng.normal(size=len(paths[i]) - 1)
        self.M = U @ U.T
        self.G = np.zeros((rows, nv))
        for row in self.G:
            ends = rng.integers(0, nv, 2)
            moving = sorted(set(paths[ends[0]]) ^ set(paths[ends[1]])) or [int(ends[0])]
            row[moving] = rng.normal(size=len(moving))
        for k in range(dependent):
            self.G[k] = self.G[k + dependent] + self.G[k + 2 * dependent]
        self.G[-1] = rng.normal(size=nv)
        self.rank = int(np.linalg.matrix_rank(self.G))
        mass = {(j, i) for i in range(nv) for j in paths[i]}
        entries = [(int(row), int(i)) for row, i in np.argwhere(self.G[:-1])]
        source = PROTOTYPES + algebra_of(nv, rows, self.rank, mass, entries)
        self.library: Any = compile_and_load(source, lambda path: ctypes.CDLL(str(path)))[0]
        size = ctypes.c_size_t.in_dll(self.library, "srm_mbs_factors_size").value
        self._memory = np.zeros(size + 64, dtype=np.uint8)
        self.at = ctypes.c_void_p(-(-self._memory.ctypes.data // 64) * 64)

    def factor(self, M: FloatArray, f: FloatArray, bias: FloatArray, G: FloatArray) -> Any:
        """The result of the function, and L^-1 f, gamma, |R_kk| and the squares of columns."""
        rows, nv = G.shape
        out = [np.zeros(n) for n in (nv, rows, self.rank, rows)]
        given = [np.asfortranarray(M), f, bias, np.ascontiguousarray(G)]
        return self.library.srm_mbs_factor(self.at, *map(_pointer, [*given, *out])), *out

    def call(self, name: str, x: FloatArray, size: int = 0, *numbers: int) -> FloatArray:
        """A function of a vector, in place or with a result of ``size``."""
        out = np.zeros(size) if size else x.copy()
        vectors = [x, out] if size else [out]
        getattr(self.library, f"srm_mbs_{name}")(self.at, *numbers, *map(_pointer, vectors))
        return out


def _pointer(array: FloatArray) -> Any:
    return array.ctypes.data_as(ctypes.c_void_p)


@pytest.mark.parametrize(
    ("nv", "rows", "dependent"), [(2, 1, 0), (7, 9, 2), (9, 10, 2), (31, 36, 4)]
)
def test_generated_algebra_of_trees_with_sparse_and_dependent_rows_is_lapacks(
    nv: int, rows: int, dependent: int
) -> None:
    algebra = _Algebra(nv, rows, dependent)
    M, G, rank = algebra.M, algebra.G, algebra.rank
    rng = np.random.default_rng(1)
    f, bias, z, x = rng.normal(size=nv), rng.normal(size=rows), *rng.normal(size=(2, nv))
    failed, white, gamma, pivots, squares = algebra.factor(M, f, bias, G)
    assert not failed
    L = np.linalg.cholesky(M)
    W = solve_triangular(L, G.T, lower=True)
    Q, R, _ = qr(W, mode="economic", pivoting=True)
    Q = Q[:, :rank]
    close = {"rtol": 1e-13 * np.linalg.cond(M), "atol": 1e-13 * np.linalg.cond(M)}
    np.testing.assert_allclose(pivots, np.abs(np.diag(R))[:rank], **close)
    np.testing.assert_allclose(squares, (W**2).sum(axis=0), **close)
    np.testing.assert_allclose(gamma, G @ np.linalg.solve(M, f) + bias, **close)
    np.testing.assert_allclose(algebra.call("unwhiten", white), np.linalg.solve(M, f), **close)
    np.testing.assert_allclose(algebra.call("whiten_force", f), white, **close)
    velocity = algebra.call("whiten_velocity", z)
    np.testing.assert_allclose(algebra.call("unwhiten", velocity), z, **close)
    np.testing.assert_allclose(velocity @ velocity, z @ M @ z, **close)
    # The shortest motion, in kinetic energy, with the rates G z: its pivots solve all rows.
    close["atol"] *= np.linalg.cond(R[:rank, :rank])
    normal = algebra.call("normal", G @ z, nv, rank)
    expected = np.linalg.solve(L.T, Q @ (Q.T @ (L.T @ z)))
    np.testing.assert_allclose(algebra.call("unwhiten", normal), expected, **close)
    multiplier = algebra.call("multiplier", x, rows, rank)
    np.testing.assert_allclose(multiplier @ (G @ z), x @ normal, **close)
    turned = algebra.call("times_q", x, 0, rank, 1)
    np.testing.assert_allclose(algebra.call("times_q", turned, 0, rank, 0), x, **close)
    algebra.library.srm_mbs_pivot_rows.restype = ctypes.POINTER(ctypes.c_int)
    places = algebra.library.srm_mbs_pivot_rows(algebra.at)[:nv]
    assert sorted(places) == list(range(nv))
    # Motions along other places than those of the pivots leave all rows as they are.
    turned[places[:rank]] = 0.0
    tangent = algebra.call("unwhiten", algebra.call("times_q", turned, 0, rank, 0))
    np.testing.assert_allclose(G @ tangent, np.zeros(rows), **close)


def test_generated_algebra_says_what_is_not_positive_definite_or_not_a_number() -> None:
    algebra = _Algebra(9, 10, 2)
    f, bias = np.ones(9), np.zeros(10)
    assert algebra.factor(-algebra.M, f, bias, algebra.G)[0] == 1
    G = algebra.G.copy()
    G[tuple(np.argwhere(G)[0])] = np.nan
    failed, *_, pivots, _ = algebra.factor(algebra.M, f, bias, G)
    assert not failed
    assert np.isnan(pivots[-1])
