r"""Terms of one evaluated point of a semi-explicit DAE, :mod:`srm_mbs.systems.dae`.

One sweep of the SRM: y_s = y_{s-1} + T g/eps, x_s' = f - B y_s, (2.2) of the thesis with T = I or
(GB)^T; and for T = (GB)^-1 the form (2.4), which carries yhat = B y instead of y,

    yhat_s = P yhat_{s-1} + E g/eps,    P = E G,

and passes isolated singularities of G B, where P and yhat stay bounded and y need not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import EvaluationError

if TYPE_CHECKING:
    from srm_mbs.systems.dae import DaeSystem


class DaeTerms:
    """Terms of one evaluated point."""

    def __init__(self, system: DaeSystem) -> None:
        self._system = system
        self._p = system.projection
        self.t = 0.0
        self.x = self.f = self.B = self.G = np.zeros(0)
        self.predicted: FloatArray | None = None
        self._g: FloatArray | None = None

    def load(self, t: float, x: FloatArray, f: FloatArray, B: FloatArray, G: FloatArray) -> None:
        """The values at a new point."""
        self.t, self.x, self.f, self.B, self.G = t, x, f, B, G
        self._g = None

    @property
    def sigma(self) -> float:
        return self._p.sigma

    @property
    def rank(self) -> int:
        return self._p.rank

    @property
    def weak(self) -> bool:
        return self._p.weak

    @property
    def held(self) -> bool:
        return False

    def normals(self) -> FloatArray:
        return np.zeros((len(self.x), 0))

    def _residual(self) -> FloatArray:
        if self._g is None:
            self._g = self._system.call("g", self.t, self.x)
        return self._g

    def _gamma(self) -> FloatArray:
        return self.G @ self.f + self._system.time_derivative(self.t, self.x)

    def _completed(self, strong: FloatArray) -> FloatArray:
        """The strong part of yhat plus (1 - P_s) yhat_pred."""
        if self.predicted is None:
            return strong
        return strong + self.predicted - self._p.project(self.predicted)

    def rate(self) -> FloatArray:
        return self.f - self.multiplier()

    def multiplier(self) -> FloatArray:
        return self._completed(self._p.lift(self._gamma()))

    def prediction(self) -> FloatArray:
        if self._system.carries_yhat:
            return self.multiplier()
        if not self.weak:
            y = np.linalg.solve(self.G @ self.B, self._gamma())
            return y.astype(np.float64, copy=False)
        return self._system.factor_of(self.multiplier(), self.B)

    def project(self, w: FloatArray) -> FloatArray:
        return self._p.project(w)

    def gap(self) -> float:
        return 0.0

    def correction(self) -> FloatArray:
        return self._p.lift(self._residual())

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        g = self._residual()
        if self._system.carries_yhat:
            yhat = self._completed(self._p.project(previous) + self._p.lift(g) / eps)
            return self.f - yhat, yhat
        with np.errstate(over="ignore", invalid="ignore"):  # of sweeps that are unstable
            scaled = g if self._system.T == "identity" else (self.G @ self.B).T @ g
            y = previous + scaled / eps
            rate = self.f - self.B @ y
        if not (np.isfinite(rate).all() and np.isfinite(y).all()):
            raise EvaluationError("the multiplier of a sweep grows beyond all numbers")
        return rate, y
