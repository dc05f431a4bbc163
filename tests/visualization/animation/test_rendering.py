"""Pictures and films of runs, taken in a real browser."""

from __future__ import annotations

import math
import subprocess
import sys
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.visualization.animation import video as rendering
from srm_mbs.visualization.animation.overlays import OverlayOptions
from srm_mbs.visualization.animation.scene import FIELD_OF_VIEW, make_picture
from tests.support.commands import run as run_command
from tests.support.commands import run_apart
from tests.support.screenshots import pixels

ORANGE = np.array([0.902, 0.624, 0.0])


@cache
def run() -> srm.Solution:
    """A second and a half of the pendulum, whose bob is an orange ball at 1 m."""
    return srm.simulate(srm.load("simple_pendulum"), 1.5)


class Lent:
    """A browser that whoever closes it has not got to himself."""

    def __init__(self, browser: Any) -> None:
        self._browser = browser

    def __getattr__(self, name: str) -> Any:
        return getattr(self._browser, name)

    def close(self) -> None:
        pass


@pytest.fixture(autouse=True)
def one_browser(browser: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chromium is launched as it always is, for the fixture, and only lent to each picture."""
    path = browser.browser_type.executable_path
    chromium = SimpleNamespace(executable_path=path, launch=lambda **options: Lent(browser))
    playwright = nullcontext(SimpleNamespace(chromium=chromium))
    monkeypatch.setattr("playwright.sync_api.sync_playwright", lambda: playwright)


def orange_at(image: Any) -> np.ndarray:
    """Mean column and row of the orange pixels."""
    lengths = np.linalg.norm(image, axis=2)
    hue = image @ ORANGE / np.linalg.norm(ORANGE) > 0.99 * lengths
    return np.argwhere(hue & (lengths > 0.3)).mean(axis=0)[::-1]


def picture_of(solution: srm.Solution, path: Path, **options: Any) -> Any:
    """Red, green and blue (height, width, 3), 0 to 1, of an image that is written to ``path``."""
    solution.export_image(path, **options)
    return pixels(path.read_bytes())


def seen_at(solution: srm.Solution, place: Any, fps: float, size: tuple[int, int]) -> np.ndarray:
    """Column and row of a point (3,) m in a picture of ``size``."""
    view = make_picture(solution, fps, OverlayOptions()).view
    x, y, depth = view.axes @ (np.asarray(place) - view.target)
    half = 0.5 * np.array(size)
    scale = half[1] / math.tan(math.radians(0.5 * FIELD_OF_VIEW)) / (view.distance + depth)
    return half + scale * np.array([x, -y])


def bob(solution: srm.Solution, t: float) -> tuple[float, float, float]:
    """The place (m) of the bob at t."""
    angle = solution(t)[0][0]
    return math.cos(angle), 0.0, math.sin(angle)


@pytest.mark.browser
@pytest.mark.parametrize(
    "t", [0.4, 1.5, *(pytest.param(t, marks=pytest.mark.stress) for t in (0.0, 0.9))]
)
def test_the_bob_is_where_forward_kinematics_puts_it(tmp_path: Path, t: float) -> None:
    image = picture_of(run(), tmp_path / "picture.png", t=t)
    assert image.shape == (600, 900, 3)
    expected = seen_at(run(), bob(run(), t), 60.0, (900, 600))
    np.testing.assert_allclose(orange_at(image), expected, atol=2.5)


@pytest.mark.browser
def test_a_picture_shows_the_end_by_default_and_no_controls(tmp_path: Path) -> None:
    a = picture_of(run(), tmp_path / "a.png", size=(450, 300))
    b = picture_of(run(), tmp_path / "b.png", size=(450, 300), t=1.5)
    np.testing.assert_allclose(a, b, atol=0.02)
    assert np.ptp(a[-40:], axis=(0, 1)).max() < 0.1, "the background only"


@pytest.mark.browser
def test_a_film_has_the_length_of_the_run_over_its_speed(tmp_path: Path) -> None:
    from PIL import Image

    solution = run()
    solution.export_video(tmp_path / "film.gif", fps=12.0, speed=3.0, size=(300, 200))
    with Image.open(tmp_path / "film.gif") as film:
        assert film.size == (300, 200)
        waits = []
        for k in range(film.n_frames):  # type: ignore[attr-defined]
            film.seek(k)
            waits.append(film.info["duration"])
        assert len(waits) == 7
        # Seven pictures from 0 to 0.5 s of film, the last one shown as long as the others.
        assert sum(waits) == pytest.approx(1000.0 * 7 / 12.0, abs=10.0)


@pytest.mark.browser
def test_an_mp4_is_written_by_ffmpeg(tmp_path: Path) -> None:
    run().export_video(tmp_path / "film.mp4", fps=10.0, size=(301, 201))
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"


def test_a_film_without_its_encoder_and_a_time_without_its_picture_are_refused_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendering.shutil, "which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    for options, words in (
        (["--video", str(tmp_path / "film.mp4")], "ffmpeg, which is not installed"),
        (["--at", "0.4"], "--at: it is the time of a picture, and none is asked for"),
    ):
        said = run_command("simulate", "simple_pendulum", *options, status=2)
        assert words in said
        assert "steps" not in said


def test_a_picture_of_a_time_outside_a_saved_run_is_refused_by_its_option(tmp_path: Path) -> None:
    srm.simulate(srm.load("simple_pendulum"), 2.0, t0=1.0).save(tmp_path / "run.npz")
    options = ["--image", str(tmp_path / "image.png"), "--at", "0.5"]
    said = run_command("play", tmp_path / "run.npz", *options, status=2)
    assert "error: --at: 0.5 s lies outside the run, from 1 to 2 s" in said


@pytest.mark.browser
@pytest.mark.parametrize("suffix", [".gif", pytest.param(".mp4", marks=pytest.mark.stress)])
def test_the_frames_of_a_film_from_the_command_line_show_the_bob_where_it_is(
    tmp_path: Path, suffix: str
) -> None:
    saved, film = tmp_path / "run.npz", tmp_path / f"film{suffix}"
    solution = srm.simulate(srm.load("simple_pendulum"), 0.5)
    solution.save(saved)
    run_command("play", saved, "--video", film)
    width, height = 720, 480
    decoder = [str(rendering.encoder_of(Path("any.mp4"))), "-loglevel", "error", "-i", str(film)]
    raw = subprocess.run(
        [*decoder, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True, check=True
    )
    frames = np.frombuffer(raw.stdout, np.uint8).reshape(-1, height, width, 3) / 255.0
    assert len(frames) == 13  # 25 per second, and the one at the start
    for t in (0.0, 0.2, 0.48):
        expected = seen_at(solution, bob(solution, t), 25.0, (width, height))
        np.testing.assert_allclose(orange_at(frames[round(t * 25.0)]), expected, atol=3.0)


@pytest.mark.browser
def test_the_command_line_writes_pictures_of_a_run_and_of_a_saved_one(tmp_path: Path) -> None:
    saved, first, second = (str(tmp_path / name) for name in ("run.npz", "a.png", "b.png"))
    options = ["--t-end", "1.5", "--out", saved, "--image", first, "--at", "0.4"]
    # In a process of its own, which launches its browser.
    alone = run_apart("simulate", "simple_pendulum", *options)
    assert alone.returncode == 0, alone.stderr
    run_command("play", saved, "--image", second, "--at", "0.4")
    a, b = (pixels(Path(name).read_bytes()) for name in (first, second))
    np.testing.assert_allclose(orange_at(a), orange_at(b), atol=0.5)


def test_an_unknown_kind_of_film_is_refused_before_the_run(tmp_path: Path) -> None:
    film = tmp_path / "film.avi"
    assert "--video" in run_command("simulate", "simple_pendulum", "--video", film, status=2)


def test_without_playwright_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "playwright.sync_api", None)
    with pytest.raises(srm.InputError, match=r'pip install "srm-mbs\[render\]"'):
        run().export_image(tmp_path / "a.png")


def test_a_folder_that_is_not_there_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(srm.InputError, match="cannot be written"):
        run().export_image(tmp_path / "nowhere" / "a.png", size=(60, 40))


@pytest.mark.browser
def test_the_colour_of_a_closure_is_seen_although_it_lies_within_a_body(tmp_path: Path) -> None:
    solution = srm.simulate(srm.load("slider_crank"), 3.0)
    pictures = [
        picture_of(solution, tmp_path / "picture.png", t=2.4, reactions=reactions)
        for reactions in (True, False)
    ]
    crank = solution(2.4)[0][0]  # two bars of 2 m, their end on the x axis
    place = (4.0 * math.cos(crank), 0.0, 0.0)
    column, row = seen_at(solution, place, 60.0, (900, 600)).round().astype(int)
    here = (slice(row - 3, row + 4), slice(column - 3, column + 4))
    assert np.abs(pictures[0][here] - pictures[1][here]).max(axis=2).min() > 0.1
