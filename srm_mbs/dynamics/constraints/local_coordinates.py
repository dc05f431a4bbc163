r"""Minimal coordinates of a mechanism around a closed configuration.

Let N (nv, k) span the velocities that keep the loops closed at q_0, and L (k, nv) pick k numbers of
a displacement, L N = 1.  Every z (k,) near zero is then one closed configuration q(z): the one with

    q = q_0 (+) u,   L u = z,   g(q) = 0,

found by Newton's iteration.  Its velocities are v = V w with L V = 1, G V = 0, and z' = R w with
R = L D^{-1} V, where D is the derivative of (+); R = 1 unless there are ball, planar or free
joints.  Everything is in units (:mod:`srm_mbs.dynamics.constraints.geometry`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.newton import newton
from srm_mbs.dynamics.singularities.local_analysis import SINGULAR, THIRD_ORDER
from srm_mbs.model.lazy import cached_property

CONSTRAINT_TOLERANCE = 1e-12
"""Largest closure error of a point of the chart, in row units."""
ROUNDING = 1e-15
"""Closure error, in row units, that a further step would not make smaller: next to a singular
configuration it would move the point by that over the smallest singular value."""
RANK_TOLERANCE = 1e-10
"""Singular value, over the usual norm of G, below which a direction does not move the closures."""
ITERATIONS = 20


def tangent_basis(
    geometry: ClosureGeometry, q: FloatArray, free: IndexArray
) -> tuple[FloatArray, FloatArray]:
    """Orthonormal velocities (nv, k), in units, that keep the loops closed while only the ``free``
    coordinates move; and all singular values of the normalised G of these, falling."""
    _, singular, right = np.linalg.svd(geometry.normalised(q)[:, free])
    rank = int(np.sum(singular > SINGULAR))
    basis = np.zeros((geometry.model.nv, len(free) - rank))
    basis[free] = right[rank:].T
    return basis, singular


@dataclass(frozen=True, eq=False)
class ChartPoint:
    """A closed configuration q (nq,), its displacement u (nv,) from the centre of its chart."""

    chart: TangentChart
    q: FloatArray
    u: FloatArray

    @cached_property
    def velocities(self) -> FloatArray:
        """V (nv, k): velocities on the closures with L V = 1.

        Where the closures lose rank, the directions that are lost keep their part of the basis.
        """
        chart = self.chart
        cut = RANK_TOLERANCE * float(np.linalg.norm(chart.geometry.row_size))
        G = chart.geometry.closure(self.q)[1]
        moves = G @ chart.complement
        size = float(np.linalg.norm(moves))
        if size <= cut:
            return chart.basis
        back = np.linalg.lstsq(moves, G @ chart.basis, rcond=cut / size)[0]
        return chart.basis - chart.complement @ back

    @cached_property
    def rate_matrix(self) -> FloatArray:
        """R (k, k): z' = R w."""
        D = self.chart.derivative(self.u)
        if D is None:
            return np.eye(self.chart.size)
        return np.asarray(self.chart.left @ np.linalg.solve(D, self.velocities))

    @property
    def slopes(self) -> FloatArray:
        """V R^{-1} (nv, k): velocities for unit rates of z."""
        return np.asarray(np.linalg.solve(self.rate_matrix.T, self.velocities.T).T)


class TangentChart:
    """Minimal coordinates z around q.

    Parameters
    ----------
    geometry
        The closures.
    q : (nq,)
        A closed configuration, the centre.
    basis : (nv, k)
        N, in units.
    free
        Indices of the coordinates that may move.
    chosen
        Indices of k coordinates that z shall be (L picks them); by default z are the components
        along ``basis``, which must be orthonormal then.
    """

    def __init__(
        self,
        geometry: ClosureGeometry,
        q: FloatArray,
        basis: FloatArray,
        free: IndexArray,
        chosen: IndexArray | None = None,
    ) -> None:
        self.geometry, self.q = geometry, q
        model = geometry.model
        self.size = basis.shape[1]
        self._flat = model.nq == model.nv
        self.basis: FloatArray = basis
        self.left: FloatArray = basis.T
        if chosen is None:
            own = np.linalg.svd(basis[free].T)[2][self.size :].T
            self.complement: FloatArray = np.zeros((model.nv, own.shape[1]))
            self.complement[free] = own
        else:
            self.basis = basis @ np.linalg.inv(basis[chosen])
            self.left = np.eye(model.nv)[chosen]
            self.complement = np.eye(model.nv)[:, np.setdiff1d(free, chosen)]

    def derivative(self, u: FloatArray) -> FloatArray | None:
        """D (nv, nv) at the displacement u (nv,): velocity in units per u'; None where it is 1."""
        if self._flat:
            return None
        unit = self.geometry.unit
        D = pin.dIntegrate(self.geometry.model, self.q, u * unit, pin.ARG1)
        return D * unit / unit[:, None]  # type: ignore[no-any-return]

    def point(self, z: FloatArray) -> ChartPoint | None:
        """The closed configuration with these coordinates (k,); None if none was found."""
        geometry = self.geometry

        def linearise(u: FloatArray) -> tuple[float, Callable[[], FloatArray]]:
            g, G = geometry.closure(geometry.move(self.q, u))

            def step() -> FloatArray:
                D = self.derivative(u)
                moves = G @ self.complement if D is None else G @ D @ self.complement
                return u - self.complement @ np.linalg.lstsq(moves, g, rcond=RANK_TOLERANCE)[0]

            return float(np.abs(g).max(initial=0.0)), step

        u, error = newton(self.basis @ z, linearise, ITERATIONS, tolerance=ROUNDING)
        return (
            ChartPoint(self, geometry.move(self.q, u), u) if error <= CONSTRAINT_TOLERANCE else None
        )


def differences(function: Callable[[FloatArray], FloatArray], steps: FloatArray) -> FloatArray:
    """Jacobian (m, n) of a function (n,) -> (m,) at zero by central differences of order 6.

    ``steps`` (n,) are the steps of the arguments.
    """
    if not len(steps):
        return np.zeros((len(function(steps)), 0))
    columns = []
    for j, tau in enumerate(steps):
        e = np.zeros(len(steps))
        e[j] = tau
        columns.append(
            sum(
                (weight / tau * (function(k * e) - function(-k * e)) for k, weight in THIRD_ORDER),
                start=np.zeros(1),
            )
        )
    return np.column_stack(columns)
