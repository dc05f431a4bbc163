"""A prescribed motion that can be played like a run: mode shapes, dragged joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.mechanism import Mechanism
from srm_mbs.shown import Shown


class Playable(Protocol):
    """What :mod:`srm_mbs.playback` needs of a run or a motion."""

    @property
    def mechanism(self) -> Mechanism:
        """What moves."""

    @property
    def span(self) -> tuple[float, float]:
        """Start and end (s)."""

    def __call__(self, t: Any) -> tuple[FloatArray, FloatArray]:
        """q and v at times ``t``."""


@dataclass(frozen=True, eq=False)
class JointMotion(Shown):
    """Configurations over time.

    Attributes
    ----------
    mechanism
        What moves.
    t : (n,) s, q : (n, nq)
        Increasing times, and closed configurations there.
    """

    mechanism: Mechanism
    t: FloatArray
    q: FloatArray

    def __post_init__(self) -> None:
        nq = self.mechanism.model.nq
        if self.q.shape != (len(self.t), nq) or not len(self.t) or np.any(np.diff(self.t) <= 0.0):
            raise InputError(
                f"times of shape {self.t.shape} and configurations of shape {self.q.shape} do not "
                "make a motion",
                element="motion",
                remedy=f"Give increasing times (n,) and configurations (n, {nq})",
            )

    @property
    def span(self) -> tuple[float, float]:
        """Start and end (s)."""
        return float(self.t[0]), float(self.t[-1])

    def __call__(self, t: Any) -> tuple[FloatArray, FloatArray]:
        """q and v at ``t`` (s), a scalar or a vector: straight from frame to frame.

        Returns shapes (nq,), (nv,) for a scalar, (k, nq), (k, nv) for a vector; beyond the ends
        the motion stands still.
        """
        times = np.atleast_1d(np.asarray(t, dtype=float))
        model = self.mechanism.model
        q, v = np.empty((len(times), model.nq)), np.zeros((len(times), model.nv))
        for i, time in enumerate(times):
            k = int(np.clip(np.searchsorted(self.t, time, side="right") - 1, 0, len(self.t) - 1))
            if k == len(self.t) - 1 or time <= self.t[0]:
                q[i] = self.q[k]
                continue
            h = self.t[k + 1] - self.t[k]
            move = pin.difference(model, self.q[k], self.q[k + 1])
            q[i] = pin.integrate(model, self.q[k], (time - self.t[k]) / h * move)
            v[i] = move / h
        return (q[0], v[0]) if np.ndim(t) == 0 else (q, v)
