r"""The algebra of a DAE at one point: E = B (GB)^-1, P = E G, rank and sigma.

Column-pivoted QR of the scaled G^T = Q_G R_G and B = Q_B R_B; with C = Q_G^T Q_B,

    E r = Q_B C^-1 R_G^-T r,    P w = Q_B C^-1 Q_G^T w,

so that where rows of G, or columns of B, become dependent only the cosines of the angles in C are
divided by: P stays bounded there (thesis, (2.4)), which products with (GB)^-1 would not.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.systems.projection import PIVOT_ZERO, pivoted_qr


class ObliqueProjection:
    """Factorisation of G and B at one point; reused.

    Parameters
    ----------
    rows : (ny,), columns : (ny,)
        Typical norms of the rows of G and the columns of B.
    reference : (3,)
        Typical ``sizes``; 1 if not known.

    Attributes
    ----------
    factorisations
        How many factorisations were done.
    sizes : (3,)
        The last pivot of the scaled G^T, that of the scaled B, and the smallest cosine in C.
    sigma
        The smallest of these three numbers over its reference.
    rank
        Number of directions in use.
    """

    def __init__(
        self,
        rows: FloatArray,
        columns: FloatArray,
        reference: FloatArray | None = None,
    ) -> None:
        self.rows, self.columns = rows, columns
        self.reference = np.ones(3) if reference is None else reference
        self.factorisations = 0
        self.size = len(rows)
        self.rank = self.size
        self.sigma = np.inf
        self.weak = False

    def factor(self, G: FloatArray, B: FloatArray, threshold: float | None) -> None:
        """Factorise G (ny, nx) and B (nx, ny).

        ``threshold`` drops the directions in which G or B is below ``threshold`` times its
        reference (the zone); ``None`` uses all.

        Raises
        ------
        EvaluationError
            If G or B is not finite, or G B is singular though neither G nor B loses rank.
        """
        self.factorisations += 1
        ny = self.size
        if not (np.isfinite(G).all() and np.isfinite(B).all()):
            raise EvaluationError("G or B is not finite")
        packed, order, tau, g_pivots = pivoted_qr(np.asfortranarray((G / self.rows[:, None]).T))
        packed_b, _, tau_b, b_pivots = pivoted_qr(np.asfortranarray(B / self.columns))
        floor = PIVOT_ZERO if threshold is None else max(PIVOT_ZERO, threshold)
        rank = ny
        while rank and not (
            g_pivots[rank - 1] > floor * self.reference[0]
            and b_pivots[rank - 1] > floor * self.reference[1]
        ):
            rank -= 1
        self.rank, self.weak = rank, rank < ny
        self.order = order[:rank]
        self.R = packed[:rank, :rank]
        self.Q_G = lapack.dorgqr(packed[:, :rank], tau[:rank])[0] if rank else packed[:, :0]
        self.Q_B = lapack.dorgqr(packed_b[:, :rank], tau_b[:rank])[0] if rank else packed_b[:, :0]
        left, cosines, right = np.linalg.svd(self.Q_G.T @ self.Q_B)
        cosine = float(cosines[-1]) if rank else 1.0
        if cosine < PIVOT_ZERO:
            raise EvaluationError(
                "G B is singular though neither G nor B loses rank: x' does not stay bounded there"
            )
        self.inverse = (right.T / cosines) @ left.T
        self.sizes = np.array([g_pivots[ny - 1], b_pivots[ny - 1], cosine])
        self.sigma = float((self.sizes / self.reference).min())

    def lift(self, residual: FloatArray) -> FloatArray:
        """E r (nx,) for ``residual`` r (ny,): B (GB)^-1 r."""
        if self.rank == 0:
            return np.zeros(self.Q_B.shape[0])
        scaled = (residual / self.rows)[self.order]
        z = lapack.dtrtrs(self.R, scaled, lower=0, trans=1)[0]
        lifted: FloatArray = self.Q_B @ (self.inverse @ z)
        return lifted

    def project(self, w: FloatArray) -> FloatArray:
        """P w (nx,)."""
        projected: FloatArray = self.Q_B @ (self.inverse @ (self.Q_G.T @ w))
        return projected
