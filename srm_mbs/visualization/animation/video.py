"""Images and videos of a run, rendered by a headless browser.

Playwright opens the page of :func:`srm_mbs.visualization.animation.playback.export_html` in
headless Chromium, which draws a picture at each requested time.
"""

from __future__ import annotations

import base64
import io
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from srm_mbs.errors import CHECK_WRITING, InputError, get_logger, safe_repr, unwritable
from srm_mbs.formats.files import whole_file
from srm_mbs.integration.dense_output import checked_time
from srm_mbs.model.numbers import positive_number
from srm_mbs.simulation.monitoring import Counted, counting
from srm_mbs.simulation.options import check_progress
from srm_mbs.visualization.animation.overlays import ViewOptions
from srm_mbs.visualization.animation.page import write_file
from srm_mbs.visualization.animation.playback import check_fps, page_of
from srm_mbs.visualization.animation.trajectory import DrawableMotion

log = get_logger(__name__)

PRINT_RESOLUTION = 300.0
"""Dots per inch of an image whose size is given by a name."""
LARGEST_SIDE = 8192
"""Largest width or height in pixels of the canvas of Chromium without a graphics card."""
FILMS = (".gif", ".mp4")
FRAME = "frame_{:05d}.png"
"""Names of the pictures of a film in a folder, from 1."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER_OPTIONS = (
    *("--headless", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
"""Options of Chromium without a graphics card and without a network."""
TEMPORARY_PREFIX = "srm-mbs-"
"""Prefix of the names of temporary folders, which have the page and the profile of the browser."""
LOCKING_TIME = 60.0
"""Age (s) of a temporary folder above which its program has locked it, unless it was killed."""
_PREPARE = """async ([width, height, front]) => {
  viewer.renderer.setPixelRatio(2);
  viewer.set_3d_pane_size();
  window.requestAnimationFrame = () => 0;  // pictures are drawn when they are taken,
  viewer.renderer.domElement.style.display = "none";  // and not on the screen
  const sheet = () => Object.assign(document.createElement("canvas"), { width, height });
  const draw = (pen) => {
    viewer.render();
    pen.drawImage(viewer.renderer.domElement, 0, 0, width, height);
  };
  // What does not move is drawn once: the background, and the notes in front.
  const back = sheet(), picture = sheet(), pen = picture.getContext("2d");
  const parts = viewer.scene.children, shown = parts.map((part) => part.visible);
  for (const part of parts) part.visible = false;
  draw(back.getContext("2d"));
  parts.forEach((part, i) => { part.visible = shown[i]; });
  viewer.scene.background = null;
  const notes = front && Object.assign(new Image(), { src: `data:image/png;base64,${front}` });
  if (notes) await notes.decode();
  window.photograph = (t) => {
    seek(t);
    pen.drawImage(back, 0, 0);
    draw(pen);
    if (notes) pen.drawImage(notes, 0, 0);
    return picture.toDataURL("image/png").split(",")[1];
  };
}"""
"""Twice as many pixels in each direction, which are averaged: software rendering does not smooth
the edges enough by itself.  Most of the time of a picture goes into its pixels."""
_FRAMES = """new Promise(resolve =>
  requestAnimationFrame(() => requestAnimationFrame(resolve)))"""
_FRONT = """html, body, #view { background: transparent !important; }
canvas { visibility: hidden; }"""
"""Style of the page without its picture."""
BARE = "#bar, #corner, .dg { display: none !important; } #panel { max-height: none !important; }"
"""Style of the page in images: no controls, and nothing to be scrolled to."""


@contextmanager
def browser() -> Iterator[Any]:
    """A headless Chromium, playwright's ``Browser``.

    Raises
    ------
    InputError
        If playwright or Chromium is missing, or Chromium does not start.
    """
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError as error:
        raise InputError(
            "pictures and films need playwright, which is not installed",
            remedy='Install it: pip install "srm-mbs[render]"; or use solution.export_html(path)',
        ) from error
    # Chromium refuses its sandbox to root, whose files it would not protect.
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    with ExitStack() as stack:
        folder = stack.enter_context(private_folder())
        with _temporary_files_in(folder):  # those of playwright: the profile
            playwright = stack.enter_context(sync_playwright())
        found = [_program(name) for name in BROWSERS]
        found.append(playwright.chromium.executable_path)
        path = next((path for path in found if path and Path(path).exists()), None)
        if path is None:
            raise InputError(
                "pictures and films need Chromium, which is not installed",
                remedy="Install chromium from your system, or run: playwright install chromium",
            )
        try:
            chromium = playwright.chromium.launch(
                executable_path=path,
                args=[*BROWSER_OPTIONS, *(["--no-sandbox"] if root else [])],
                chromium_sandbox=not root,
                env=dict(os.environ),
            )
        except Error as error:
            reason = (error.message.strip().splitlines() or ["it gives no reason"])[0]
            if "sandboxing failed" in error.message:
                reason = "its sandbox does not work here"
            raise InputError(
                f"the browser does not start: {reason}",
                file=path,
                remedy="Use the Chromium of your system, and check that user namespaces are "
                "allowed; or use solution.export_html(path)",
            ) from error
        stack.callback(chromium.close)
        yield chromium


def _program(name: str) -> str | None:
    """Absolute path of a program, None if there is none; not one of the working folder."""
    found = shutil.which(name)
    return found if found is not None and os.path.isabs(found) else None


@contextmanager
def private_folder() -> Iterator[Path]:
    """A temporary folder that only its user can read, removed at the end of a ``with`` block.

    The next one removes what killed programs of the same user have left: folders that no living
    program has locked.
    """
    _remove_left_folders()
    with tempfile.TemporaryDirectory(prefix=TEMPORARY_PREFIX) as name, _locked(name):
        yield Path(name)


@contextmanager
def _locked(folder: str) -> Iterator[bool]:
    """Whether this program has the lock of ``folder``, which it loses when it ends in any way;
    False also where folders cannot be locked."""
    if os.name != "posix":
        yield False
        return
    import fcntl

    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield os.fstat(opened).st_uid == os.geteuid()
    finally:
        os.close(opened)


def _remove_left_folders() -> None:
    oldest = time.time() - LOCKING_TIME
    for entry in Path(tempfile.gettempdir()).glob(f"{TEMPORARY_PREFIX}*"):
        with suppress(OSError):  # it is somebody else's, or is gone
            if entry.lstat().st_mtime > oldest:
                continue
            with _locked(str(entry)) as left:
                if left:
                    shutil.rmtree(entry, ignore_errors=True)


@contextmanager
def _temporary_files_in(folder: Path) -> Iterator[None]:
    """Processes that are started within make their temporary files in ``folder``."""
    before = os.environ.get("TMPDIR")
    os.environ["TMPDIR"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["TMPDIR"]
        else:
            os.environ["TMPDIR"] = before


@contextmanager
def photographer(
    solution: DrawableMotion,
    size: tuple[int, int],
    fps: float,
    view: ViewOptions,
    times: Sequence[float],
    chromium: Any = None,
    style: str = BARE,
) -> Iterator[Callable[[float], bytes]]:
    """A function from a time of the run (s) to a PNG.

    Parameters
    ----------
    solution
        The run.
    size
        Width and height in pixels.
    fps
        Key frames per second, between which the browser interpolates linearly.
    view
        The overlays.
    times
        Times (s) of the pictures, which get key frames of their own.
    chromium
        A :func:`browser` to use, which stays open; a new one by default.
    style
        Style sheet that is added to that of the page.

    Raises
    ------
    InputError
        If ``size`` is not valid, an overlay cannot be drawn, or Chromium or playwright is missing.
    """
    width, height = _checked_pixels(size)
    own = browser() if chromium is None else nullcontext(chromium)
    with private_folder() as folder, own as opened:
        file = folder / "page.html"
        file.write_bytes(page_of(solution, fps, view, panel=False, extra=times).encode())
        page = opened.new_page(viewport={"width": width, "height": height})
        page.goto(file.as_uri())
        page.wait_for_function("viewer.scene_tree.children.mechanism !== undefined")
        page.add_style_tag(content=style)
        page.evaluate(_FRAMES)  # the page has taken its size, and the legend its bars
        front = None
        if page.evaluate("about.notes.length > 0"):
            over = page.add_style_tag(content=_FRONT)
            front = base64.b64encode(page.screenshot(omit_background=True)).decode("ascii")
            over.evaluate("tag => tag.remove()")
        page.evaluate(_PREPARE, [width, height, front])
        start = solution.span[0]

        def photograph(t: float) -> bytes:
            return base64.b64decode(page.evaluate("t => photograph(t)", t - start))

        yield photograph
        page.close()


def export_image(
    solution: DrawableMotion,
    path: str | Path,
    *,
    t: float | None,
    size: str | tuple[float, float],
    dpi: float | None,
    view: ViewOptions,
) -> None:
    """Write an image of a run at one time.

    Parameters
    ----------
    solution
        The run.
    path
        Name of the ``.png``; an existing one is replaced.
    t
        Time (s) in the run; None for its end.
    size
        Width and height in pixels; with ``dpi`` in inches.  ``"column"`` (3.5 inch wide) and
        ``"page"`` (7 inch) are two thirds as high as wide.
    dpi
        Dots per inch, for print; 300 with a name of a size.
    view
        The overlays.

    Raises
    ------
    InputError
        If ``t`` lies outside the run, ``path`` is no ``.png`` or cannot be written, or Chromium or
        playwright is missing.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise InputError(
            f"pictures are PNG files, not {path.suffix!r}", file=str(path), remedy="Name it .png"
        )
    start, end = solution.span
    t = end if t is None else checked_time(t, start, end, "t")
    pixels, density = image_pixels(size, dpi)
    with photographer(solution, pixels, 60.0, view, [t]) as photograph:
        picture = photograph(t)
    write_file(path, picture if density is None else _with_density(picture, density))


def _checked_pixels(size: Any) -> tuple[int, int]:
    """Width and height in pixels.

    Raises
    ------
    InputError
        Unless ``size`` is two positive whole numbers of at most LARGEST_SIDE.
    """
    try:
        width, height = size
    except (TypeError, ValueError):
        width = height = None
    if not (isinstance(width, int) and isinstance(height, int) and min(width, height) > 0):
        raise InputError(
            f"size = {safe_repr(size)} is not a width and a height in pixels",
            element="size",
            remedy="Give for example size=(900, 600)",
        )
    return _drawable(width, height, "size", "a smaller size")


def _drawable(width: int, height: int, element: str, instead: str) -> tuple[int, int]:
    """Width and height, unless the browser does not draw as many pixels.

    Raises
    ------
    InputError
        About ``element``, if one is above LARGEST_SIDE.
    """
    if max(width, height) > LARGEST_SIDE:
        raise InputError(
            f"a picture of {width} by {height} pixels is larger than the browser draws",
            element=element,
            remedy=f"Give {instead}: up to {LARGEST_SIDE} pixels",
        )
    return width, height


def image_pixels(size: Any, dpi: float | None) -> tuple[tuple[int, int], float | None]:
    """Pixels of an image of ``size``: pixels or a name, with ``dpi`` inches or a name; and its dots
    per inch, None of pixels.

    Raises
    ------
    InputError
        As :func:`export_image` about its size.
    """
    if dpi is None and not isinstance(size, str):
        return _checked_pixels(size), None
    return _print(size, dpi)


def _print(size: Any, dpi: float | None) -> tuple[tuple[int, int], float]:
    """Pixels of a picture of ``size`` (inch, or a name), and its dots per inch.

    Raises
    ------
    InputError
        If one is not valid, or the picture has more pixels than the browser draws.
    """
    # Matplotlib, which this imports, is slow to import.
    from srm_mbs.visualization.plotting.print_size import (
        WIDTHS,
        checked_resolution,
        checked_size,
    )

    size = checked_size(size)
    density = PRINT_RESOLUTION if dpi is None else checked_resolution(dpi)
    inches = (WIDTHS[size], WIDTHS[size] / 1.5) if isinstance(size, str) else size
    width, height = (round(side * density) for side in inches)
    return _drawable(width, height, "dpi", "a smaller size or fewer dots per inch"), density


def _with_density(picture: bytes, density: float) -> bytes:
    """A PNG that says how many dots are an inch."""
    from PIL import Image

    out = io.BytesIO()
    Image.open(io.BytesIO(picture)).save(out, "PNG", dpi=(density, density), optimize=True)
    return out.getvalue()


def export_video(
    solution: DrawableMotion,
    path: str | Path,
    *,
    fps: float,
    speed: float,
    size: tuple[int, int],
    progress: bool | Counted,
    view: ViewOptions,
) -> None:
    """Write a video of a run, or its pictures into a folder.

    Parameters
    ----------
    solution
        The run.
    path
        Name of the ``.gif``, which Pillow writes, or ``.mp4``, for which ``ffmpeg`` or the
        package imageio-ffmpeg must be installed; an existing one is replaced.  Without a suffix a
        folder, new or empty, for numbered pictures: ``frame_00001.png`` ...
    fps
        Frames per second of video; browsers play a GIF of more than 50 more slowly.
    speed
        Seconds of the run per second of video.
    size
        Width and height in pixels.
    progress
        True for a progress bar (on a terminal only), or a callable (done, total) that is called
        after each picture.
    view
        The overlays.

    Raises
    ------
    InputError
        If ``path`` has another suffix, is a folder that is not empty, or cannot be written, a
        number is not positive, or Chromium, playwright or ffmpeg is missing.
    """
    path = Path(path)
    kind = path.suffix.lower()
    fps = check_fps(fps)
    check_progress(progress, "(done, total)")
    if not kind:
        check_frames_folder(path, "path")
    elif kind not in FILMS:
        raise InputError(
            f"films are .gif or .mp4 files, not {path.suffix!r}",
            file=str(path),
            element="path",
            remedy="Name it .gif or .mp4, or without a suffix a folder",
        )
    speed = positive_number(speed, "speed", remedy="Give a positive number: 1 is real time")
    encoder = encoder_of(path) if kind else None
    start, end = solution.span
    count = max(1, math.floor((end - start) / speed * fps * (1.0 + 1e-12)) + 1)
    times = np.minimum(start + np.arange(count) * (speed / fps), end).tolist()
    with photographer(solution, size, fps / min(speed, 1.0), view, times) as photograph:
        taken = _photographs(photograph, times, progress)
        if not kind:
            _write_frames(path, taken)
            return
        pictures = list(taken)
    if encoder is None:
        write_file(path, _gif(pictures, fps))
    else:
        _encode(encoder, pictures, fps, path)


def _photographs(
    photograph: Callable[[float], bytes], times: Sequence[float], progress: bool | Counted
) -> Iterator[bytes]:
    with counting(progress, "pictures", len(times), "filming") as report:
        for done, t in enumerate(times, 1):
            yield photograph(t)
            if report is not None:
                report(done, len(times))


def check_frames_folder(folder: Path, element: str) -> None:
    """Refuse a folder for the pictures of a film that has files, or cannot be made.

    Raises
    ------
    InputError
        About ``element``.
    """
    problem, remedy = "", CHECK_WRITING
    if not folder.parent.is_dir():
        problem, remedy = f"there is no folder {str(folder.parent)!r}", "Make it first"
    elif folder.exists() and not folder.is_dir():
        problem, remedy = "it is a file", "Name a folder, or a .gif or .mp4"
    elif not os.access(folder if folder.exists() else folder.parent, os.W_OK):
        problem = "it cannot be written"
    elif folder.exists() and any(folder.iterdir()):
        problem, remedy = "the folder is not empty", "Remove its files, or name another folder"
    if problem:
        raise InputError(problem, file=str(folder), element=element, remedy=remedy)


def _write_frames(folder: Path, pictures: Iterable[bytes]) -> None:
    """Write each picture when it is taken: an interrupted film keeps those before."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from error
    for number, picture in enumerate(pictures, 1):
        write_file(folder / FRAME.format(number), picture)


def encoder_of(film: Path) -> str | None:
    """Path of ffmpeg, of the system or of the package imageio-ffmpeg; None for a ``.gif``.

    Raises
    ------
    InputError
        If the video needs ffmpeg and it is not installed.
    """
    if film.suffix.lower() == ".gif":
        return None
    found = _program("ffmpeg")
    if found is None:
        try:
            import imageio_ffmpeg

            found = imageio_ffmpeg.get_ffmpeg_exe()
        except (ImportError, RuntimeError) as error:
            raise InputError(
                "an .mp4 needs the encoder ffmpeg, which is not installed",
                file=str(film),
                remedy="Install ffmpeg, or pip install imageio-ffmpeg, or write a .gif",
            ) from error
    return str(found)


def _gif(pictures: Sequence[bytes], fps: float) -> bytes:
    from PIL import Image

    first, *others = [
        Image.open(io.BytesIO(picture)).convert("P", palette=Image.Palette.ADAPTIVE)
        for picture in pictures
    ]
    out = io.BytesIO()
    # GIF has delays in hundredths of a second: the rounded end times keep the total duration.
    ends = [round(100.0 * k / fps) for k in range(len(pictures) + 1)]
    waits = [10 * (end - begin) for begin, end in pairwise(ends)]
    first.save(out, "GIF", save_all=True, append_images=others, duration=waits, loop=0)
    return out.getvalue()


def _encode(encoder: str, pictures: Sequence[bytes], fps: float, path: Path) -> None:
    """Encode the pictures with ffmpeg as H.264 in the pixel format that every player supports.

    Raises
    ------
    InputError
        If ffmpeg does not write the file; an existing one is left as it is.
    """
    try:
        with whole_file(path) as film:
            command = [
                *(encoder, "-loglevel", "error", "-y"),
                *("-f", "image2pipe", "-framerate", f"{fps:g}", "-i", "-"),
                # H.264 needs an even width and height.
                *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"),
                # A name is neither an option nor an address.
                *("-f", "mp4", f"file:{film}"),
            ]
            done = subprocess.run(
                command, input=b"".join(pictures), capture_output=True, check=False
            )
            if done.returncode:
                words = done.stderr.decode(errors="replace").replace(str(film), str(path))
                lines = words.strip().splitlines()
                raise InputError(
                    f"ffmpeg cannot write it: {lines[-1] if lines else done.returncode}",
                    file=str(path),
                    remedy="Write a .gif, which needs no encoder",
                )
    except OSError as error:
        raise unwritable(path, error) from error
    log.info("written: %s", path)
