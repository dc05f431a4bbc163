"""Playing a run in the browser: live with :func:`play`, or from one file with :func:`export_html`.

Both draw with meshcat and hand the motion to its animation, so that the browser plays it in real
time and its time slider scrubs through it.

A run in a notebook: the page of ``export_html`` inside the output of a cell.

Nothing here needs IPython: notebooks ask what they show for ``_repr_html_``.
"""

from __future__ import annotations

import atexit
import html
import logging
import math
import sys
import time
import webbrowser
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srm_mbs.errors import InputError
from srm_mbs.model.anchors import Anchor
from srm_mbs.visualization.animation.meshcat_scene import draw_picture, import_meshcat
from srm_mbs.visualization.animation.overlays import OverlayOptions
from srm_mbs.visualization.animation.page import make_page, read_out, write_page
from srm_mbs.visualization.animation.scene import ASPECT, Picture, make_picture
from srm_mbs.visualization.animation.server import SERVERLESS, start_server

if TYPE_CHECKING:
    from srm_mbs.visualization.animation.joint_motion import Playable

log = logging.getLogger(__name__)

REPLY_TIME = 30.0  # s, for meshcat's server to accept one command

# Playing ------------------------------------------------------------------------------------


def check_fps(fps: Any) -> float:
    """``fps`` as a positive number.

    Raises
    ------
    InputError
        If it is none.
    """
    try:
        value = float(fps)
    except (TypeError, ValueError):
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(
            f"fps = {fps!r} is not a positive number of key frames per second",
            element="fps",
            remedy="Give for example fps=60",
        )
    return value


_open_visualizers: list[Any] = []


def play(
    solution: Playable,
    *,
    fps: float = 60.0,
    open_browser: bool = True,
    block: bool | None = None,
    trace: Sequence[Anchor] = (),
    gaps: bool = False,
    reactions: bool = False,
) -> Any:
    """Play a run in the browser, in real time, over and over.

    The page is that of :func:`export_html`, served by a local process.

    Parameters
    ----------
    solution
        The run; one that failed is played up to its end.
    fps, trace, gaps, reactions
        As for :func:`export_html`.
    open_browser
        Open a browser window; otherwise only serve the page.  Its address is logged.
    block
        Wait until Ctrl-C, and then stop serving.  By default in a script, whose end would also be
        that of the page, and not in an interactive session.

    Returns
    -------
    meshcat.Visualizer
        To add to the scene, or for :func:`close`.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number, what is asked for cannot be drawn, or meshcat is
        missing or cannot start.
    """
    meshcat = import_meshcat()
    picture = make_picture(solution, check_fps(fps), OverlayOptions(trace, gaps, reactions))
    about = about_picture(solution, picture, panel=True)
    visualizer = serve(meshcat, make_page(meshcat, solution.mechanism.name, about, None), picture)
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
    """Stop serving the page of :func:`play`; a page that is open goes on playing.

    Parameters
    ----------
    visualizer
        What :func:`play` returned; closing it twice is harmless.
    """
    window = visualizer.window
    if visualizer in _open_visualizers:
        _open_visualizers.remove(visualizer)
    process = window.server_proc
    process.kill()
    process.wait()
    for stream in (process.stdout, process.stderr):
        stream.close()
    if window.zmq_socket is not None:
        window.zmq_socket.close(linger=0)


@atexit.register
def _close_all() -> None:
    while _open_visualizers:
        close(_open_visualizers[-1])


def _zmq() -> Any:
    import zmq

    return zmq


@contextmanager
def answered(window: Any, seconds: float, remedy: str = SERVERLESS) -> Iterator[None]:
    """While the server has ``seconds`` to accept each command, instead of for ever.

    Raises
    ------
    InputError
        If it does not, or has stopped.
    """
    if window.server_proc.poll() is not None:
        raise InputError("meshcat's server has stopped", remedy=remedy)
    zmq = _zmq()
    try:
        if window.zmq_socket is None:
            window.connect_zmq()
        window.zmq_socket.setsockopt(zmq.RCVTIMEO, int(1000.0 * seconds))
        yield
        window.zmq_socket.setsockopt(zmq.RCVTIMEO, -1)
    except zmq.ZMQError as error:
        if window.zmq_socket is not None:
            # A socket that waits for an answer takes no other command.
            window.zmq_socket.close(linger=0)
            window.connect_zmq()
        raise InputError(f"meshcat's server does not answer: {error}", remedy=remedy) from error


def serve(meshcat: Any, page: str, picture: Picture) -> Any:
    """Serve ``page``, and draw in it.

    Returns
    -------
    meshcat.Visualizer
        For :func:`close`.

    Raises
    ------
    InputError
        If the server does not start, or does not answer.
    """
    process, commands, address = start_server(page)
    kind = meshcat.visualizer.ViewerWindow
    window = kind.__new__(kind)  # its constructor starts a server of its own, or leaves a socket
    window.server_proc, window.zmq_url, window.web_url = process, commands, address
    window.zmq_socket = None
    visualizer = meshcat.Visualizer(window=window)
    # Kept until closed: an abandoned process and socket would warn when collected.
    _open_visualizers.append(visualizer)
    try:
        with answered(window, REPLY_TIME):
            draw_picture(meshcat, visualizer, picture)
    except BaseException:
        close(visualizer)
        raise
    return visualizer


def show(visualizer: Any, name: str, *, open_browser: bool) -> None:
    """Log where the page is and, if wanted, open it."""
    address = visualizer.url()
    log.info("%s is played at %s", name, address)
    if open_browser and not webbrowser.open(address, new=2):
        log.warning("no browser could be opened; open %s", address)


# Export -------------------------------------------------------------------------------------


class _Recorder:
    """Stands in for meshcat's window: keeps the commands instead of sending them to a server."""

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        self.commands.append(command.lower())


def export_html(
    solution: Playable,
    path: str | Path,
    *,
    fps: float = 60.0,
    trace: Sequence[Anchor] = (),
    gaps: bool = False,
    reactions: bool = False,
    panel: bool = True,
) -> None:
    """Write one file that plays a run in any browser, without a network or a server.

    It starts at once and repeats for ever.  Below are pause, play, the speed, and the time slider
    with the singular passages marked; a panel has the time, and of a run drift, energy and sigma
    there.  The mouse turns, shifts and zooms the picture.  Spring-dampers between two points are
    drawn.

    Parameters
    ----------
    solution
        The run; one that failed is shown up to its end, or as it stood.
    path
        Name of the file, usually ``.html``; an existing one is replaced.
    fps
        Key frames per second; between them the browser goes straight.  More are taken where bodies
        would be seen beside their places, such as in short runs of fast mechanisms, and fewer where
        their number would get too large
        (:data:`srm_mbs.visualization.animation.scene.MAX_BODY_FRAMES`), to keep the file below 5 MB
        unless there are mesh files or very many bodies, or the run takes the better part of an
        hour.
    trace
        Points whose paths are drawn, for example ``[srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))]``.
    gaps
        Draw the gaps of the closures, so much exaggerated that they are seen; the panel gives the
        factor.
    reactions
        Colour the closures by the size of their reaction force, with a legend in the panel.
    panel
        Whether there are the panel and the marks.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number, what is asked for cannot be drawn, meshcat is missing,
        or the file cannot be written.
    """
    drawn = OverlayOptions(trace, gaps, reactions)
    write_page(page_of(solution, fps, drawn, panel=panel), Path(path))


def page_of(
    solution: Playable,
    fps: float,
    wanted: OverlayOptions,
    *,
    panel: bool,
    extra: Iterable[float] = (),
) -> str:
    """The page of :func:`export_html`, with key frames at ``extra`` times (s); errors as there."""
    meshcat = import_meshcat()
    picture = make_picture(solution, check_fps(fps), wanted, extra)
    recorder = _Recorder()
    draw_picture(meshcat, meshcat.Visualizer(window=recorder), picture)
    about = about_picture(solution, picture, panel=panel)
    return make_page(meshcat, solution.mechanism.name, about, recorder.commands)


def about_picture(solution: Playable, picture: Picture, *, panel: bool) -> dict[str, Any]:
    """What the page says about a run and its picture, for
    :func:`srm_mbs.visualization.animation.page.make_page`."""
    about = read_out(solution, picture.motion.times, panel=panel)
    return about | {"notes": picture.overlays.notes, "aspect": ASPECT}


@dataclass(frozen=True)
class Embedded:
    """A page that a notebook shows where it is the value of a cell.

    It stands in the notebook itself, needs neither a server nor a network, and plays in exported
    HTML too.

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
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" title="animation" width="100%" '
            f'height="{self.height}" style="border: 0"></iframe>'
        )


def show_in_notebook(
    solution: Playable,
    *,
    height: int = 420,
    fps: float = 60.0,
    trace: Sequence[Anchor] = (),
    gaps: bool = False,
    reactions: bool = False,
    panel: bool = True,
) -> Embedded:
    """The animation of a run for a notebook: let it be the value of a cell.

    Parameters
    ----------
    solution
        The run, or a motion.
    height
        Of the frame, pixels.
    fps, trace, gaps, reactions, panel
        Those of :func:`srm_mbs.visualization.animation.playback.export_html`.

    Raises
    ------
    InputError
        If ``height`` is not a positive whole number, or as for
        :func:`srm_mbs.visualization.animation.playback.export_html`.
    """
    if not isinstance(height, int) or height <= 0:
        raise InputError(
            f"height = {height!r} is not a positive whole number of pixels",
            element="height",
            remedy="Give for example height=420",
        )
    page = page_of(solution, fps, OverlayOptions(trace, gaps, reactions), panel=panel)
    return Embedded(page, height)
