"""A prescribed motion that can be played like a run: mode shapes, dragged joints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.mechanism import Mechanism


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
class JointMotion:
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
                f"times of shape {self.t.shape} and configurations of shape {self.q.shape} are no "
                "motion",
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

    def play(self, **options: Any) -> None:
        """Play it in the browser; see :func:`srm_mbs.playback.play`."""
        from srm_mbs.playback import play

        play(self, **options)

    def export_html(self, path: str | Path, **options: Any) -> None:
        """Write a page with the animation; see :func:`srm_mbs.playback.export_html`."""
        from srm_mbs.playback import export_html

        export_html(self, Path(path), **options)

    def export_image(self, path: str | Path, **options: Any) -> None:
        """Write a picture at one time; see :func:`srm_mbs.rendering.export_image`."""
        from srm_mbs.rendering import export_image

        export_image(self, path, **options)

    def export_video(self, path: str | Path, **options: Any) -> None:
        """Write a film; see :func:`srm_mbs.rendering.export_video`."""
        from srm_mbs.rendering import export_video

        export_video(self, path, **options)
