"""Prescribed motions, such as mode shapes and dragged joints, that are animated like runs.

:class:`AnimationMixin` has the methods that show a motion: those of runs and of prescribed motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.errors import InputError, time_text
from srm_mbs.formats.files import checked_path
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.numbers import finite_array
from srm_mbs.simulation.monitoring import Counted
from srm_mbs.visualization.animation.crank_motion import CrankPositions
from srm_mbs.visualization.animation.trajectory import DrawableMotion

if TYPE_CHECKING:
    from srm_mbs.visualization.animation.playback import Embedded


class AnimationMixin:
    """Animations of a :class:`~srm_mbs.Solution` or :class:`~srm_mbs.JointMotion`.

    meshcat and the modules that draw with it are imported on first use.
    """

    @property
    def _drawable(self: Any) -> DrawableMotion:
        """This motion itself: the classes with these methods are such motions."""
        motion: DrawableMotion = self
        return motion

    def play(
        self,
        *,
        fps: float = 60.0,
        open_browser: bool = True,
        block: bool | None = None,
        trace: Sequence[Anchor] = (),
        gaps: bool = False,
        reactions: bool = False,
        arrows: bool = False,
    ) -> None:
        """Play the motion in the browser; see
        :func:`srm_mbs.visualization.animation.playback.play`.

        Parameters
        ----------
        fps
            Key frames per second.
        open_browser
            Open a browser window; otherwise only serve the page.  Its address is logged.
        block
            Wait until Ctrl-C; by default in a script, and not in an interactive session.
        trace
            Points whose paths are drawn, for example ``[srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))]``.
        gaps
            Draw the gaps of the closures, exaggerated by a factor that the panel gives.
        reactions
            Colour the closures by the magnitude of their reaction force.
        arrows
            Draw the forces and moments in joints and closures, of drives and of force elements.

        Raises
        ------
        InputError
            If ``fps`` is not a positive number, an overlay cannot be drawn, or meshcat is missing
            or cannot start.
        """
        from srm_mbs.visualization.animation.overlays import ViewOptions
        from srm_mbs.visualization.animation.playback import play

        view = ViewOptions(trace, gaps, reactions, arrows)
        play(self._drawable, fps=fps, open_browser=open_browser, block=block, view=view)

    def show(
        self,
        *,
        height: int = 420,
        fps: float = 60.0,
        trace: Sequence[Anchor] = (),
        gaps: bool = False,
        reactions: bool = False,
        arrows: bool = False,
        panel: bool = True,
    ) -> Embedded:
        """The animation as the output of a notebook cell; see
        :func:`srm_mbs.visualization.animation.playback.show_in_notebook`.

        Parameters
        ----------
        height
            Of the frame, pixels.
        fps, trace, gaps, reactions, arrows, panel
            As for :meth:`export_html`.

        Raises
        ------
        InputError
            If ``height`` is not a positive whole number, or as for :meth:`export_html`.
        """
        from srm_mbs.visualization.animation.overlays import ViewOptions
        from srm_mbs.visualization.animation.playback import show_in_notebook

        view = ViewOptions(trace, gaps, reactions, arrows)
        return show_in_notebook(self._drawable, height=height, fps=fps, view=view, panel=panel)

    def export_html(
        self,
        path: str | Path,
        *,
        fps: float = 60.0,
        trace: Sequence[Anchor] = (),
        gaps: bool = False,
        reactions: bool = False,
        arrows: bool = False,
        panel: bool = True,
    ) -> None:
        """Write a self-contained page with the animation; see
        :func:`srm_mbs.visualization.animation.playback.export_html`.

        Parameters
        ----------
        path
            Name of the file, usually ``.html``; an existing one is replaced.
        fps, trace, gaps, reactions, arrows
            As for :meth:`play`.
        panel
            Whether the page has the panel and the marks of singular passages.

        Raises
        ------
        InputError
            If ``fps`` is not a positive number, an overlay cannot be drawn, meshcat is missing, or
            the file cannot be written.
        """
        from srm_mbs.visualization.animation.overlays import ViewOptions
        from srm_mbs.visualization.animation.playback import export_html

        view = ViewOptions(trace, gaps, reactions, arrows)
        export_html(self._drawable, checked_path(path), fps=fps, view=view, panel=panel)

    def export_image(
        self,
        path: str | Path,
        *,
        t: float | None = None,
        size: str | tuple[float, float] = (900, 600),
        dpi: float | None = None,
        trace: Sequence[Anchor] = (),
        gaps: bool = False,
        reactions: bool = False,
        arrows: bool = False,
    ) -> None:
        """Write a picture at one time; see
        :func:`srm_mbs.visualization.animation.video.export_image`.

        Parameters
        ----------
        path
            Name of the ``.png``; an existing one is replaced.
        t
            Time (s) in the run; its end by default.
        size
            Width and height in pixels, of which ratios other than 3 to 2 have margins; with ``dpi``
            in inches.  ``"column"`` (3.5 inch wide) and
            ``"page"`` (7 inch) are two thirds as high as wide.
        dpi
            Dots per inch, for print; 300 with a name of a size.
        trace, gaps, reactions, arrows
            As for :meth:`play`.

        Raises
        ------
        InputError
            If ``t`` lies outside the run, ``path`` is no ``.png`` or cannot be written, an overlay
            cannot be drawn, or Chromium or playwright is missing.
        """
        from srm_mbs.visualization.animation.overlays import ViewOptions
        from srm_mbs.visualization.animation.video import export_image

        view = ViewOptions(trace, gaps, reactions, arrows)
        export_image(self._drawable, path, t=t, size=size, dpi=dpi, view=view)

    def export_video(
        self,
        path: str | Path,
        *,
        fps: float = 25.0,
        speed: float = 1.0,
        size: tuple[int, int] = (720, 480),
        progress: bool | Counted = False,
        trace: Sequence[Anchor] = (),
        gaps: bool = False,
        reactions: bool = False,
        arrows: bool = False,
    ) -> None:
        """Write a video; see :func:`srm_mbs.visualization.animation.video.export_video`.

        Parameters
        ----------
        path
            Name of the ``.gif`` or ``.mp4``; without a suffix a folder for numbered pictures.
        fps
            Frames per second of video.
        speed
            Seconds of the run per second of video.
        size
            Width and height in pixels.
        progress
            True for a progress bar, or a callable (done, total).
        trace, gaps, reactions, arrows
            As for :meth:`play`.

        Raises
        ------
        InputError
            If ``path`` has another suffix, is a folder that is not empty, or cannot be written, a
            number is not positive, an overlay cannot be drawn, or Chromium, playwright or ffmpeg is
            missing.
        """
        from srm_mbs.visualization.animation.overlays import ViewOptions
        from srm_mbs.visualization.animation.video import export_video

        view = ViewOptions(trace, gaps, reactions, arrows)
        export_video(
            self._drawable, path, fps=fps, speed=speed, size=size, progress=progress, view=view
        )


@dataclass(frozen=True, eq=False, repr=False)
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

    def __repr__(self) -> str:
        first, last = self.span
        return (
            f"JointMotion({self.mechanism.name!r}, t={time_text(first)}..{time_text(last)} s, "
            f"{len(self.t)} configurations)"
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


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class CrankMotion(CrankPositions, JointMotion):
    """All closed configurations of one branch, in order: the result of
    :func:`srm_mbs.kinematics`.

    A crank that turns fully passes them at a constant rate, from 0 rad on; another one goes back
    and forth between its dead points.  The page of such a motion has a slider for the crank in
    place of the time, and its bodies can be dragged.

    Attributes
    ----------
    mechanism, t, q
        As of a :class:`JointMotion`.
    crank
        Name of the joint.
    positions : (n,)
        Its positions, rad or m.
    rates : (n, nv)
        dq/dq_crank: rates of all coordinates for a unit rate of the crank; large next to its dead
        points.
    start
        Time (s) of the initial configuration of the mechanism.
    turns
        Whether the crank turns fully.
    closed
        Whether the last configuration is the first one: the motion may be repeated without a jump.
    marks
        Dead points and singular configurations, in order.
    transmission_angle : (n,) rad
        Of a four-bar or slider-crank; None for others.
    """
