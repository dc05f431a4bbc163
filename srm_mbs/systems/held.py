"""Forces held between samples, as a digital controller holds its outputs."""

from __future__ import annotations

import math
from bisect import bisect_right

from srm_mbs.arrays import FloatArray


class HeldForce:
    """Generalised forces that are constant from one sample to the next.

    A controller (:mod:`srm_mbs.systems.controllers`): called at any time of a run, also after it,
    it returns what acted then; right-continuous.
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self.values: list[FloatArray] = []

    def hold(self, t: float, force: FloatArray) -> None:
        """``force`` (nv,), N and N m, acts from ``t`` (s) on, which is later than all before."""
        self.times.append(t)
        self.values.append(force)

    def only(self, force: FloatArray) -> None:
        """``force`` (nv,) acts at all times."""
        self.times, self.values = [-math.inf], [force]

    def __call__(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """The force (nv,) at ``t``."""
        if t >= self.times[-1]:
            return self.values[-1]
        return self.values[max(0, bisect_right(self.times, t) - 1)]
