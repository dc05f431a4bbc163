"""A prescribed motion that can be played like a run: mode shapes, dragged joints.

What runs and prescribed motions have in common: they can be looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.model.mechanism import Mechanism

if TYPE_CHECKING:
    from srm_mbs.visualization.animation.playback import Embedded


class AnimationMixin:
    """Base of :class:`~srm_mbs.Solution` and :class:`~srm_mbs.JointMotion`.

    Upward imports, made when something is to be seen.
    """

    def play(self, **options: Any) -> None:
        """Play it in the browser; see :func:`srm_mbs.visualization.animation.playback.play`."""
        from srm_mbs.visualization.animation.playback import play

        play(self, **options)  # type: ignore[arg-type]

    def show(self, **options: Any) -> Embedded:
        """What a notebook shows as the animation; see
        :func:`srm_mbs.visualization.animation.playback.show_in_notebook`."""
        from srm_mbs.visualization.animation.playback import show_in_notebook

        return show_in_notebook(self, **options)  # type: ignore[arg-type]

    def export_html(self, path: str | Path, **options: Any) -> None:
        """Write a self-contained page with the animation; see
        :func:`srm_mbs.visualization.animation.playback.export_html`."""
        from srm_mbs.visualization.animation.playback import export_html

        export_html(self, Path(path), **options)  # type: ignore[arg-type]

    def export_image(self, path: str | Path, **options: Any) -> None:
        """Write a picture at one time; see
        :func:`srm_mbs.visualization.animation.video.export_image`."""
        from srm_mbs.visualization.animation.video import export_image

        export_image(self, path, **options)  # type: ignore[arg-type]

    def export_video(self, path: str | Path, **options: Any) -> None:
        """Write a film; see :func:`srm_mbs.visualization.animation.video.export_video`."""
        from srm_mbs.visualization.animation.video import export_video

        export_video(self, path, **options)  # type: ignore[arg-type]


class Playable(Protocol):
    """What :mod:`srm_mbs.visualization.animation.playback` needs of a run or a motion."""

    @property
    def mechanism(self) -> Mechanism:
        """What moves."""

    @property
    def span(self) -> tuple[float, float]:
        """Start and end (s)."""

    def __call__(self, t: Any) -> tuple[FloatArray, FloatArray]:
        """q and v at times ``t``."""


@dataclass(frozen=True, eq=False)
class JointMotion(AnimationMixin):
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
