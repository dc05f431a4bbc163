"""Prescribed motions, such as mode shapes and dragged joints, that are animated like runs.

:class:`AnimationMixin` has the methods that show a motion: those of runs and of prescribed motions.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.errors import InputError
from srm_mbs.formats.files import checked_path
from srm_mbs.model.numbers import finite_array

if TYPE_CHECKING:
    from srm_mbs.visualization.animation.playback import Embedded


class AnimationMixin:
    """Animations of a :class:`~srm_mbs.Solution` or :class:`~srm_mbs.JointMotion`.

    meshcat and the modules that draw with it are imported on first use.
    """

    def play(self, **options: Any) -> None:
        """Play the motion in the browser; see
        :func:`srm_mbs.visualization.animation.playback.play`."""
        from srm_mbs.visualization.animation.playback import play

        play(self, **options)  # type: ignore[arg-type]

    def show(self, **options: Any) -> Embedded:
        """The animation as the output of a notebook cell; see
        :func:`srm_mbs.visualization.animation.playback.show_in_notebook`."""
        from srm_mbs.visualization.animation.playback import show_in_notebook

        return show_in_notebook(self, **options)  # type: ignore[arg-type]

    def export_html(self, path: str | Path, **options: Any) -> None:
        """Write a self-contained page with the animation; see
        :func:`srm_mbs.visualization.animation.playback.export_html`."""
        from srm_mbs.visualization.animation.playback import export_html

        export_html(self, checked_path(path), **options)  # type: ignore[arg-type]

    def export_image(self, path: str | Path, **options: Any) -> None:
        """Write a picture at one time; see
        :func:`srm_mbs.visualization.animation.video.export_image`."""
        from srm_mbs.visualization.animation.video import export_image

        export_image(self, path, **options)  # type: ignore[arg-type]

    def export_video(self, path: str | Path, **options: Any) -> None:
        """Write a video; see :func:`srm_mbs.visualization.animation.video.export_video`."""
        from srm_mbs.visualization.animation.video import export_video

        export_video(self, path, **options)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class JointMotion(AnimationMixin):
    """Configurations of a mechanism over time.

    Attributes
    ----------
    mechanism
        The mechanism.
    t : (n,) s, q : (n, nq)
        Increasing times, and closed configurations there.
    """

    mechanism: Mechanism
    t: FloatArray
    q: FloatArray

    def __post_init__(self) -> None:
        check_mechanism(self.mechanism)
        nq = self.mechanism.model.nq
        for name, wanted in (("t", "times (n,)"), ("q", f"configurations (n, {nq})")):
            array = finite_array(getattr(self, name))
            if array is None or array.ndim != (1 if name == "t" else 2):
                raise InputError(
                    f"{name} is not an array of finite {wanted}",
                    element="motion",
                    remedy=f"Give increasing times (n,) and configurations (n, {nq})",
                )
            object.__setattr__(self, name, array)
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

    @property
    def segments(self) -> tuple[JointMotion]:
        """The motion itself: no event divides it."""
        return (self,)

    def __call__(self, t: Any) -> tuple[FloatArray, FloatArray]:
        """q and v at ``t`` (s), a scalar or a vector, by geodesic interpolation of the frames.

        Returns shapes (nq,), (nv,) for a scalar, (k, nq), (k, nv) for a vector; the motion is at
        rest outside its span.
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
