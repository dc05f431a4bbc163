"""Playback in the browser: from a local server, from one file, or in the output of a notebook.

:func:`play`, :func:`export_html` and :func:`show_in_notebook` draw with meshcat and its animation,
so that the browser plays the motion in real time and its time slider scrubs through it.
"""

from __future__ import annotations

import atexit
import sys
import time
import webbrowser
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from srm_mbs.errors import get_logger
from srm_mbs.model.numbers import positive_integer, positive_number
from srm_mbs.visualization.animation.meshcat_scene import draw_picture, import_meshcat
from srm_mbs.visualization.animation.overlays import NO_OVERLAYS, ViewOptions
from srm_mbs.visualization.animation.page import (
    FOLDER,
    make_page,
    page_data,
    render,
    write_file,
)
from srm_mbs.visualization.animation.scene import Picture, make_picture
from srm_mbs.visualization.animation.trajectory import DrawableMotion
from srm_mbs.visualization.animation.window import Window

log = get_logger(__name__)

REPLY_TIME = 30.0
"""Time (s) for the server of the page to accept one command."""

# Playing ------------------------------------------------------------------------------------


def check_fps(fps: Any) -> float:
    """``fps`` as a positive number.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number.
    """
    return positive_number(fps, "fps", " of key frames per second", "Give for example fps=60")


_open_visualizers: list[Any] = []


def play(
    solution: DrawableMotion,
    *,
    fps: float = 60.0,
    open_browser: bool = True,
    block: bool | None = None,
    view: ViewOptions = NO_OVERLAYS,
) -> Any:
    """Play a run in the browser, in real time and repeatedly.

    The page is that of :func:`export_html`, served by a local process to this machine only, under
    an address that has a random part.

    Parameters
    ----------
    solution
        The run, or a prescribed motion; a run that failed is played up to its end.
    fps, view
        As for :func:`export_html`.
    open_browser
        Open a browser window; otherwise only serve the page.  Its address is logged.
    block
        Wait until Ctrl-C, and then stop serving.  The default is True in a script, whose end would
        also end the page, and False in an interactive session.

    Returns
    -------
    meshcat.Visualizer
        For :func:`close`, or to add to the scene.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number, an overlay cannot be drawn, or meshcat is missing or
        cannot start.
    """
    picture = make_picture(solution, check_fps(fps), view)
    page = make_page(solution.mechanism.name, page_data(solution, picture), None)
    visualizer = serve(page, picture)
    show(visualizer, solution.mechanism.name, open_browser=open_browser)
    if block is None:
        block = not (hasattr(sys, "ps1") or sys.flags.interactive)
    if block:
        wait(visualizer)
    return visualizer


def wait(visualizer: Any) -> None:
    """Serve until Ctrl-C, then :func:`close`."""
    try:
        while visualizer.window.server_proc.poll() is None:
            time.sleep(0.1)
    except KeyboardInterrupt:
        log.info("playback stopped")
    finally:
        close(visualizer)


def close(visualizer: Any) -> None:
    """Stop serving the page of :func:`play`; an open page keeps playing.

    Parameters
    ----------
    visualizer
        Returned by :func:`play`; closing it twice is harmless.
    """
    if visualizer in _open_visualizers:
        _open_visualizers.remove(visualizer)
    visualizer.window.close()


@atexit.register
def _close_all() -> None:
    while _open_visualizers:
        close(_open_visualizers[-1])


def serve(page: str, picture: Picture) -> Any:
    """Serve ``page``, and draw ``picture`` in it.

    Returns
    -------
    meshcat.Visualizer
        For :func:`close`.

    Raises
    ------
    InputError
        If the server does not start, or does not answer.
    """
    meshcat = import_meshcat()
    window = Window(page)
    visualizer = meshcat.Visualizer(window=window)
    # Kept until closed: garbage collection of an open process or socket gives a warning.
    _open_visualizers.append(visualizer)
    try:
        with window.answering(REPLY_TIME):
            draw_picture(visualizer, picture)
    except BaseException:
        close(visualizer)
        raise
    return visualizer


def show(visualizer: Any, name: str, *, open_browser: bool) -> None:
    """Log the address of the page and, on request, open it."""
    address = visualizer.url()
    log.info("%s is played at %s", name, address)
    if open_browser and not webbrowser.open(address, new=2):
        log.warning("no browser could be opened; open %s", address)


# Export -------------------------------------------------------------------------------------


class _Recorder:
    """Replaces meshcat's window: records the commands instead of sending them to a server."""

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        self.commands.append(command.lower())


def export_html(
    solution: DrawableMotion,
    path: str | Path,
    *,
    fps: float = 60.0,
    view: ViewOptions = NO_OVERLAYS,
    panel: bool = True,
) -> None:
    """Write one file that plays a run in any browser, without a network or a server.

    The animation starts at once and repeats.  The bar below has pause, play, the speed, and the
    time slider with marks at singular passages.  The panel has the time and, for a run, drift,
    energy and sigma at that time.  The mouse rotates, shifts and zooms the picture.
    Spring-dampers between two points are drawn.

    Parameters
    ----------
    solution
        The run, or a prescribed motion; a run that failed is shown up to its end.
    path
        Name of the file, usually ``.html``; an existing one is replaced.
    fps
        Key frames per second, between which the browser interpolates linearly.  More are used
        where the error of interpolation would be visible, such as in short runs of fast mechanisms,
        and fewer above :data:`srm_mbs.visualization.animation.trajectory.MAX_BODY_FRAMES` key
        frames of all bodies together, to keep the file below 5 MB unless there are mesh files or
        very many bodies, or the run takes the better part of an hour.
    view
        The overlays.
    panel
        Whether the page has the panel and the marks.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number, an overlay cannot be drawn, meshcat is missing, or the
        file cannot be written.
    """
    page = page_of(solution, fps, view, panel=panel)
    write_file(Path(path), page.encode())


def page_of(
    solution: DrawableMotion,
    fps: float,
    view: ViewOptions,
    *,
    panel: bool,
    extra: Iterable[float] = (),
) -> str:
    """The page of :func:`export_html`, with key frames at ``extra`` times (s); errors as there."""
    picture = make_picture(solution, check_fps(fps), view, extra)
    recorder = _Recorder()
    draw_picture(import_meshcat().Visualizer(window=recorder), picture)
    data = page_data(solution, picture, panel=panel)
    return make_page(solution.mechanism.name, data, recorder.commands)


@dataclass(frozen=True)
class Embedded:
    """A page that a notebook shows as the value of a cell, through ``_repr_html_``.

    The notebook contains the page, which needs neither a server nor a network, and plays in
    exported HTML too.

    Attributes
    ----------
    page
        The page of :func:`srm_mbs.visualization.animation.playback.export_html`.
    height
        Of the frame, pixels; it is as wide as the cell.
    """

    page: str = field(repr=False)
    height: int

    def _repr_html_(self) -> str:
        return render(FOLDER, "notebook.html.j2", page=self.page, height=self.height)


def show_in_notebook(
    solution: DrawableMotion,
    *,
    height: int,
    fps: float,
    view: ViewOptions,
    panel: bool,
) -> Embedded:
    """The animation of a run as the value of a notebook cell.

    Parameters
    ----------
    solution
        The run, or a prescribed motion.
    height
        Of the frame, pixels.
    fps, view, panel
        Those of :func:`srm_mbs.visualization.animation.playback.export_html`.

    Raises
    ------
    InputError
        If ``height`` is not a positive whole number, or as for
        :func:`srm_mbs.visualization.animation.playback.export_html`.
    """
    height = positive_integer(height, "height", "Give for example height=420", " of pixels")
    page = page_of(solution, fps, view, panel=panel)
    return Embedded(page, height)
