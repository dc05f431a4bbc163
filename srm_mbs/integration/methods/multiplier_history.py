"""Multipliers of recent steps, extrapolated into the zone around a singular configuration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.singularities.branch_limit import lagrange_weights
from srm_mbs.model.lazy import cached_property

LARGEST_EXTRAPOLATION = 4.0
"""Longest extrapolation beyond the last node, over the time that the nodes span."""
WINDOW = 9
"""Nodes of an interpolation between nodes on both sides."""
KEPT_NODES = 5
"""Nodes kept for extrapolation; a higher degree amplifies round-off, and extrapolation over many
steps is unstable."""


@dataclass(frozen=True, eq=False)
class MultiplierHistory:
    """The last multipliers yhat outside the zone, oldest first.

    Immutable: a step keeps the history that it used, for its dense output.

    Attributes
    ----------
    times : (k,) s
    values : (k, nv)
    known_until, known_below
        Of a start on a singular configuration, whose nodes lie ahead: until that time (s), and
        where sigma is smaller, they are more accurate than the direct solve.
    normals
        Of the last node, if it lies next to a singular configuration; see
        :class:`~srm_mbs.dynamics.system.Zone`.
    away : (1, nv), (f + 1, nv) or None
        Direction or frame of the branch at the last node, if nodes of the branch solved it; see
        :mod:`~srm_mbs.integration.methods.branch_nodes`.
    """

    times: FloatArray
    values: FloatArray
    known_until: float = -np.inf
    known_below: float = 0.0
    normals: FloatArray | None = None
    away: FloatArray | None = None

    @classmethod
    def begin(cls, t: float, value: FloatArray) -> MultiplierHistory:
        """History with one node."""
        return cls(np.array([t]), value[None].copy())

    @cached_property
    def begun(self) -> bool:
        """Whether there is a node."""
        return len(self.times) > 0

    def emptied(self) -> MultiplierHistory:
        """Without nodes: far from singular configurations none are kept."""
        return MultiplierHistory(self.times[:0], self.values[:0])

    def extended(
        self,
        t: float,
        value: FloatArray,
        normals: FloatArray | None = None,
        away: FloatArray | None = None,
    ) -> MultiplierHistory:
        """With the multiplier ``value`` (nv,) at ``t`` added; the newest ``KEPT_NODES`` nodes.

        Nodes ahead of ``t`` are dropped.
        """
        before = self.times < t
        times = np.concatenate([self.times[before], [t]])[-KEPT_NODES:]
        values = np.concatenate([self.values[before], value[None]])[-KEPT_NODES:]
        return MultiplierHistory(times, values, normals=normals, away=away)

    def _around(self, t: float) -> slice:
        """The nodes to use at ``t``: all, unless there are more than WINDOW."""
        count = len(self.times)
        first = int(np.searchsorted(self.times, t)) - WINDOW // 2
        first = max(0, min(first, count - WINDOW))
        return slice(first, first + WINDOW)

    def predict(self, t: float) -> FloatArray:
        """yhat (nv,) extrapolated, or between nodes interpolated, to ``t``."""
        nodes = self._around(t)
        return lagrange_weights(self.times[nodes], t) @ self.values[nodes]

    def predict_near(self, t: float) -> FloatArray | None:
        """yhat (nv,) extrapolated to ``t``; None if that lies too far beyond the nodes."""
        span = float(self.times[-1] - self.times[0])
        if span > 0.0 and t > max(self.times[-1] + LARGEST_EXTRAPOLATION * span, self.known_until):
            return None
        return self.predict(t)

    def uncertainty(self, t: float) -> FloatArray:
        """|yhat_pred - the prediction without the oldest node| (nv,); 0 with a single node."""
        nodes = self._around(t)
        times, values = self.times[nodes], self.values[nodes]
        if len(times) < 2:
            return np.zeros(values.shape[1])
        lower = lagrange_weights(times[1:], t) @ values[1:]
        return np.abs(self.predict(t) - lower)
