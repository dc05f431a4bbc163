"""Terms of one stage of a mechanism: what a method asks of it, in tangent coordinates.

The systems (:mod:`srm_mbs.systems.multibody`) fill them in; the algebra of the closures is in
:mod:`srm_mbs.systems.projection`.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import blas

from srm_mbs.arrays import FloatArray
from srm_mbs.systems.driven import DrivenKinematics
from srm_mbs.systems.loops import LoopKinematics
from srm_mbs.systems.projection import Projection, unwhiten

_largest = blas.idamax


class OpenTerms:
    """Terms of a mechanism without closures: the acceleration, and no algebra."""

    sigma = np.inf
    rank = 0
    weak = False
    held = False

    def __init__(self, nv: int) -> None:
        self._rate = np.zeros(2 * nv)
        self._nv = nv

    def normals(self) -> FloatArray:
        return np.zeros((self._nv, 0))

    def rate(self) -> FloatArray:
        return self._rate

    def multiplier(self) -> FloatArray:
        return np.zeros(self._nv)

    def project(self, w: FloatArray) -> FloatArray:
        return np.zeros(self._nv)

    def gap(self) -> float:
        return 0.0

    def correction(self) -> FloatArray:
        return np.zeros(2 * self._nv)

    def prediction(self) -> FloatArray:
        return np.zeros(self._nv)

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        return self._rate, np.zeros(self._nv)


class ClosedTerms:
    """Terms of one stage of a closed-loop mechanism."""

    def __init__(
        self,
        projection: Projection,
        loops: LoopKinematics | DrivenKinematics,
        gap_scale: FloatArray,
    ) -> None:
        self._p = projection
        self._loops = loops
        self._pushed = loops.pushed if isinstance(loops, DrivenKinematics) else None
        self._gap_scale = gap_scale
        self.v = np.zeros(0)
        self.predicted: FloatArray | None = None
        self.sigma = projection.sigma
        self.weak = projection.weak

    @property
    def rank(self) -> int:
        return self._p.rank

    def _completed(self, white: FloatArray) -> FloatArray:
        """The strong part of a multiplier, in L^T coordinates, plus (1 - P_s) yhat_pred."""
        if self.predicted is None:
            return white
        p = self._p
        prediction = p.U @ self.predicted
        return white + prediction - p.Q @ (p.Q.T @ prediction)

    @property
    def held(self) -> bool:
        return self._p.held is not None

    def normals(self) -> FloatArray:
        if self._pushed is not None:
            return np.zeros((self.v.size, 0))
        return self._p.normals()

    def _white_multiplier(self) -> FloatArray:
        return self._completed(self._p.white_multiplier)

    def rate(self) -> FloatArray:
        p = self._p
        nv = self.v.size
        white = p.white_multiplier if self.predicted is None else self._white_multiplier()
        out = np.empty(2 * nv)
        out[:nv] = self.v
        out[nv:] = unwhiten(p.U, p.white_force - white)
        return out

    def multiplier(self) -> FloatArray:
        return self._p.unwhiten(self._white_multiplier())

    def prediction(self) -> FloatArray:
        return self.multiplier()

    def project(self, w: FloatArray) -> FloatArray:
        return self._p.project(w)

    def _white_rates(self, w: FloatArray, s: float = 1.0) -> FloatArray:
        """L^T (P w - s E s'): with w = v and s = 1 that of the rates that violate G v = s'."""
        p = self._p
        white = p.white_project(w)
        return white if self._pushed is None else white - s * p.normal(self._pushed[p.order])

    def gap(self) -> float:
        gaps = self._loops.g * self._gap_scale
        return abs(float(gaps.item(_largest(gaps))))

    def correction(self) -> FloatArray:
        p = self._p
        nv = self.v.size
        right = np.empty((nv, 2), order="F")
        right[:, 0] = p.normal(self._loops.g[p.order])
        right[:, 1] = self._white_rates(self.v)
        return p.unwhiten(right).ravel(order="F")

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        p = self._p
        nv = self.v.size
        right = np.empty((nv, 3), order="F")
        right[:, 0] = p.normal(self._loops.g[p.order])
        right[:, 1] = self._completed(self._white_rates(previous + self.v / eps, 1.0 / eps))
        right[:, 2] = p.white_force - right[:, 1]
        back = p.unwhiten(right)
        rate = np.concatenate([self.v - back[:, 0] / eps, back[:, 2]])
        return rate, back[:, 1]
