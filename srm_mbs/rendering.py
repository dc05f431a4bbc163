"""Pictures and films of a run, drawn by a browser without a window.

The page of :func:`srm_mbs.playback.export_html` is opened in headless Chromium, which playwright
drives, and photographed at the wanted times: what is seen is what the browser plays.
"""

from __future__ import annotations

import io
import math
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srm_mbs.errors import InputError
from srm_mbs.playback import check_fps, export_html

if TYPE_CHECKING:
    from srm_mbs.motion import Playable

SIZE = (900, 600)
"""Width and height of a picture in pixels; other shapes than 3 to 2 leave margins."""
FILMS = (".gif", ".mp4")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER_OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)
"""Chromium as root, without a graphics card and without a network."""
_SETTLED = """async t => {
  viewer.animator.pause();
  viewer.animator.seek(t);
  viewer.set_dirty();
  const frame = () => new Promise(resolve => requestAnimationFrame(resolve));
  await frame(); await frame();
}"""
_BARE = "#bar, .dg { display: none !important; }"


@contextmanager
def browser() -> Iterator[Any]:
    """A headless Chromium, playwright's ``Browser``.

    Raises
    ------
    InputError
        If playwright or Chromium is missing.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise InputError(
            "pictures and films need playwright, which is not installed",
            remedy="pip install 'srm-mbs[render]', or look at solution.export_html(path)",
        ) from error
    with sync_playwright() as playwright:
        found = [shutil.which(name) for name in BROWSERS]
        found.append(playwright.chromium.executable_path)
        path = next((path for path in found if path and Path(path).exists()), None)
        if path is None:
            raise InputError(
                "pictures and films need Chromium, which is not installed",
                remedy="Install your system's chromium, or run: playwright install chromium",
            )
        chromium = playwright.chromium.launch(executable_path=path, args=list(BROWSER_OPTIONS))
        try:
            yield chromium
        finally:
            chromium.close()


@contextmanager
def _photographer(
    solution: Playable, size: tuple[int, int], fps: float, drawn: dict[str, Any]
) -> Iterator[Any]:
    """A function from a time of the run (s) to a PNG."""
    width, height = size
    if not (isinstance(width, int) and isinstance(height, int) and min(size) > 0):
        raise InputError(
            f"size = {size!r} is not a width and a height in pixels",
            element="size",
            remedy="Give for example size=(900, 600)",
        )
    with tempfile.TemporaryDirectory() as folder, browser() as chromium:
        file = Path(folder) / "page.html"
        export_html(solution, file, fps=fps, panel=False, **drawn)
        page = chromium.new_page(viewport={"width": width, "height": height})
        page.goto(file.as_uri())
        page.wait_for_function("viewer.scene_tree.children.mechanism !== undefined")
        page.add_style_tag(content=_BARE)
        start = solution.span[0]

        def photograph(t: float) -> bytes:
            page.evaluate(_SETTLED, t - start)
            picture: bytes = page.screenshot()
            return picture

        yield photograph


def _written(path: Path, content: bytes) -> None:
    try:
        path.write_bytes(content)
    except OSError as error:
        raise InputError(f"it cannot be written: {error.strerror}", file=str(path)) from error


def export_image(
    solution: Playable,
    path: str | Path,
    *,
    t: float | None = None,
    size: tuple[int, int] = SIZE,
    **drawn: Any,
) -> None:
    """Write a picture of a run at one time.

    Parameters
    ----------
    solution
        The run.
    path
        Name of the ``.png``; an existing one is replaced.
    t
        Time (s) in the run; its end by default.
    size
        Width and height in pixels.
    drawn
        ``trace``, ``gaps`` and ``reactions`` of :func:`srm_mbs.playback.export_html`.

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
    t = end if t is None else t
    if not start <= t <= end:
        raise InputError(
            f"t = {t!r} lies outside the run, from {start:g} to {end:g} s",
            element="t",
            remedy="Give a time of the run",
        )
    with _photographer(solution, size, 60.0, drawn) as photograph:
        _written(path, photograph(t))


def export_video(
    solution: Playable,
    path: str | Path,
    *,
    fps: float = 25.0,
    speed: float = 1.0,
    size: tuple[int, int] = (720, 480),
    **drawn: Any,
) -> None:
    """Write a film of a run.

    Parameters
    ----------
    solution
        The run.
    path
        Name of the ``.gif``, which Pillow writes, or ``.mp4``, for which ``ffmpeg`` or the
        package imageio-ffmpeg must be installed; an existing one is replaced.
    fps
        Pictures per second of film; browsers slow a GIF of more than 50 down.
    speed
        Seconds of the run per second of film.
    size
        Width and height in pixels.
    drawn
        ``trace``, ``gaps`` and ``reactions`` of :func:`srm_mbs.playback.export_html`.

    Raises
    ------
    InputError
        If ``path`` has another suffix or cannot be written, a number is not positive, or Chromium,
        playwright or ffmpeg is missing.
    """
    path = Path(path)
    kind = path.suffix.lower()
    fps = check_fps(fps)
    if kind not in FILMS:
        raise InputError(
            f"films are .gif or .mp4 files, not {path.suffix!r}", file=str(path), element="path"
        )
    if not (math.isfinite(speed) and speed > 0.0):
        raise InputError(f"speed = {speed!r} is not a positive number", element="speed")
    encoder = _encoder()
    if kind == ".mp4" and encoder is None:
        raise InputError(
            "an .mp4 needs the encoder ffmpeg, which is not installed",
            file=str(path),
            remedy="Install ffmpeg, or pip install imageio-ffmpeg, or write a .gif",
        )
    start, end = solution.span
    count = max(1, math.floor((end - start) / speed * fps * (1.0 + 1e-12)) + 1)
    times = start + np.arange(count) * (speed / fps)
    with _photographer(solution, size, fps / min(speed, 1.0), drawn) as photograph:
        pictures = [photograph(min(float(t), end)) for t in times]
    if kind == ".gif":
        _written(path, _gif(pictures, fps))
    else:
        _encode(str(encoder), pictures, fps, path)


def _encoder() -> str | None:
    """ffmpeg of the system, or the one that the package imageio-ffmpeg brings."""
    found = shutil.which("ffmpeg")
    if found is None:
        try:
            import imageio_ffmpeg

            found = imageio_ffmpeg.get_ffmpeg_exe()
        except (ImportError, RuntimeError):
            return None
    return str(found)


def _gif(pictures: Sequence[bytes], fps: float) -> bytes:
    from PIL import Image

    first, *others = [
        Image.open(io.BytesIO(picture)).convert("P", palette=Image.Palette.ADAPTIVE)
        for picture in pictures
    ]
    out = io.BytesIO()
    # The format counts hundredths of a second: the film as a whole keeps time.
    ends = [round(100.0 * k / fps) for k in range(len(pictures) + 1)]
    waits = [10 * (end - begin) for begin, end in pairwise(ends)]
    first.save(out, "GIF", save_all=True, append_images=others, duration=waits, loop=0)
    return out.getvalue()


def _encode(encoder: str, pictures: Sequence[bytes], fps: float, path: Path) -> None:
    """Feed the pictures to ffmpeg as H.264 that every player shows."""
    command = [
        *(encoder, "-loglevel", "error", "-y", "-f", "image2pipe", "-framerate", f"{fps:g}"),
        # H.264 wants even sides.
        *("-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", str(path)),
    ]
    done = subprocess.run(command, input=b"".join(pictures), capture_output=True, check=False)
    if done.returncode:
        words = done.stderr.decode(errors="replace").strip().splitlines()
        raise InputError(
            f"ffmpeg cannot write it: {words[-1] if words else done.returncode}", file=str(path)
        )
