"""Playing a run in the browser: live with :func:`play`, or from one file with :func:`export_html`.

Both draw with meshcat and hand the motion to its animation, so that the browser plays it in real
time and its time slider scrubs through it.
"""

from __future__ import annotations

import atexit
import base64
import contextlib
import html
import io
import json
import logging
import math
import sys
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srm_mbs.errors import InputError
from srm_mbs.scene import ASPECT, draw_scene, import_meshcat

if TYPE_CHECKING:
    from srm_mbs.motion import Playable

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
) -> Any:
    """Play a run in the browser, in real time, over and over.

    "Open Controls" in the page has pause, play, the time slider and the speed (``timeScale``).
    The page is served by a local process of meshcat's.

    Parameters
    ----------
    solution
        The run; one that failed is played up to its end.
    fps
        Key frames per second; between them the browser interpolates.  Fewer are taken where
        their number would get too large (:data:`srm_mbs.scene.MAX_BODY_FRAMES`).
    open_browser
        Open a browser window; otherwise only serve the page.  Its address is logged.
    block
        Wait until Ctrl+C, and then stop serving.  By default in a script, whose end would also be
        that of the page, and not in an interactive session.

    Returns
    -------
    meshcat.Visualizer
        To add to the scene, or for :func:`close`.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number, or meshcat is missing or cannot start.
    """
    fps = check_fps(fps)
    meshcat = import_meshcat()
    visualizer = _start_server(meshcat)
    try:
        # Without a limit, sending to a server that has died would wait for ever.
        visualizer.window.zmq_socket.setsockopt(_zmq().RCVTIMEO, int(1000.0 * REPLY_TIME))
        draw_scene(meshcat, visualizer, solution, fps)
        visualizer.window.zmq_socket.setsockopt(_zmq().RCVTIMEO, -1)
    except _zmq().ZMQError as error:
        close(visualizer)
        raise InputError(f"meshcat's server does not answer: {error}") from error
    except BaseException:
        close(visualizer)
        raise
    address = visualizer.url()
    log.info("%s is played at %s", solution.mechanism.name, address)
    if open_browser and not webbrowser.open(address, new=2):
        log.warning("no browser could be opened; open %s", address)
    if block is None:
        block = not (hasattr(sys, "ps1") or sys.flags.interactive)
    if block:
        try:
            while visualizer.window.server_proc.poll() is None:
                time.sleep(0.1)
        except KeyboardInterrupt:
            log.info("stopped")
        finally:
            close(visualizer)
    return visualizer


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
    window.zmq_socket.close(linger=0)


@atexit.register
def _close_all() -> None:
    while _open_visualizers:
        close(_open_visualizers[-1])


def _zmq() -> Any:
    import zmq

    return zmq


def _start_server(meshcat: Any) -> Any:
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):  # meshcat prints the address
            visualizer = meshcat.Visualizer()
    except Exception as error:  # a process, a port, a socket: anything may fail here
        details = " ".join([str(error), *printed.getvalue().split("\n")[-2:]]).strip()
        raise InputError(
            f"meshcat cannot start its server: {details}",
            remedy="solution.export_html(path) needs none",
        ) from error
    # Kept until closed: an abandoned process and socket would warn when collected.
    _open_visualizers.append(visualizer)
    return visualizer


# Export -------------------------------------------------------------------------------------


class _Recorder:
    """Stands in for meshcat's window: keeps the commands instead of sending them to a server."""

    def __init__(self) -> None:
        self.commands: list[dict[str, Any]] = []

    def send(self, command: Any) -> None:
        self.commands.append(command.lower())


def export_html(solution: Playable, path: str | Path, *, fps: float = 60.0) -> None:
    """Write one file that plays a run in any browser, without a network or a server.

    It starts at once and repeats for ever.  Below are pause, play and the time slider; the speed
    (``timeScale``) is under "Open Controls".  The mouse turns, shifts and zooms the picture.

    Parameters
    ----------
    solution
        The run; one that failed is shown up to its end, or as it stood.
    path
        Name of the file, usually ``.html``; an existing one is replaced.
    fps
        Key frames per second; between them the browser interpolates.  Fewer are taken where
        their number would get too large (:data:`srm_mbs.scene.MAX_BODY_FRAMES`), to keep the file
        below 5 MB unless there are mesh files or very many bodies.

    Raises
    ------
    InputError
        If ``fps`` is not a positive number, meshcat is missing, or the file cannot be written.
    """
    fps = check_fps(fps)
    meshcat = import_meshcat()
    recorder = _Recorder()
    draw_scene(meshcat, meshcat.Visualizer(window=recorder), solution, fps)
    page = _page(meshcat, solution.mechanism.name, recorder.commands)
    try:
        Path(path).write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"the page cannot be written: {error.strerror}", file=str(path)) from error


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>@title@</title>
<style>
body { margin: 0; background: #eef0f2; font: 15px system-ui, sans-serif; color: #333; }
#meshcat-pane { width: 100vw; height: 100vh; overflow: hidden; }
#bar { position: fixed; left: 0; right: 0; bottom: 0; padding: 10px 18px 12px; gap: 14px;
  align-items: center; background: rgba(255, 255, 255, 0.75); }
#bar:not([hidden]) { display: flex; }
#bar button { font: inherit; width: 5em; padding: 4px 0; cursor: pointer; }
#bar input { flex: 1; min-width: 0; accent-color: #0072b2; }
#bar output { min-width: 9em; text-align: right; font-variant-numeric: tabular-nums; }
</style>
</head>
<body>
<div id="meshcat-pane"></div>
<div id="bar" hidden><button id="toggle">Pause</button>
<input id="time" type="range" min="0" step="any" value="0" aria-label="time"><output></output></div>
<script>@viewer@</script>
<script>
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
for (const text of @commands@) {
  const bytes = atob(text), buffer = new Uint8Array(bytes.length);
  for (let i = 0; i < bytes.length; i++) buffer[i] = bytes.charCodeAt(i);
  viewer.handle_command_bytearray(buffer);
}
// The picture is made for one shape of window: step back in a narrower one.
const narrow = @aspect@ * window.innerHeight / window.innerWidth;
if (narrow > 1) viewer.camera.position.multiplyScalar(narrow);
// A wide slider over meshcat's animator; its own controls remain under "Open Controls".
const animator = viewer.animator, slider = document.getElementById("time");
const toggle = document.getElementById("toggle"), clock = document.querySelector("output");
document.getElementById("bar").hidden = animator.duration === 0;
slider.max = animator.duration;
slider.oninput = () => {
  animator.pause();
  animator.seek(+slider.value);
  animator.display_progress(+slider.value);
};
toggle.onclick = () => animator.playing ? animator.pause() : animator.play();
(function show() {
  slider.value = animator.time;
  toggle.textContent = animator.playing ? "Pause" : "Play";
  clock.value = `${animator.time.toFixed(2)} / ${animator.duration.toFixed(2)} s`;
  requestAnimationFrame(show);
})();
</script>
</body>
</html>
"""


def _page(meshcat: Any, title: str, commands: list[dict[str, Any]]) -> str:
    """meshcat's viewer with ``commands``, as one page.

    Unlike meshcat's own ``static_html``, which needs a running server, it applies the commands in
    order.
    """
    import umsgpack  # type: ignore[import-untyped]

    encoded = []
    for command in commands:
        # Animations are played in single precision anyway, and are most of the file.
        precision = "single" if command["type"] == "set_animation" else "double"
        packed = umsgpack.packb(command, force_float_precision=precision)
        encoded.append(base64.b64encode(packed).decode("ascii"))
    root = Path(meshcat.servers.zmqserver.VIEWER_ROOT)
    parts = {
        "title": html.escape(title),
        "viewer": (root / "main.min.js").read_text(encoding="utf-8"),
        "commands": json.dumps(encoded),
        "aspect": repr(ASPECT),
    }
    page = _PAGE
    # The last first: what is put in may itself hold marks.
    for name in reversed(parts):
        before, after = page.split(f"@{name}@", 1)
        page = before + parts[name] + after
    return page
