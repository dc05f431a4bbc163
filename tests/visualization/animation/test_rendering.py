"""Pictures and films of runs, taken in a real browser."""

from __future__ import annotations

import io
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.visualization.animation import video as rendering
from srm_mbs.visualization.animation.overlays import ViewOptions
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
    view = make_picture(solution, fps, ViewOptions()).view
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
    "t", [0.4, *(pytest.param(t, marks=pytest.mark.stress) for t in (0.0, 0.9, 1.5))]
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
def test_a_picture_for_print_has_the_size_in_inches(tmp_path: Path) -> None:
    from PIL import Image

    for options, shape, dpi in (
        ({"size": "column"}, (1050, 700), 300.0),
        ({"size": (3.0, 2.0), "dpi": 100}, (300, 200), 100.0),
    ):
        image = picture_of(run(), tmp_path / "print.png", t=0.4, **options)
        with Image.open(tmp_path / "print.png") as picture:
            assert picture.size == shape
            assert picture.info["dpi"] == pytest.approx((dpi, dpi), abs=0.1)
        expected = seen_at(run(), bob(run(), 0.4), 60.0, shape)
        np.testing.assert_allclose(orange_at(image), expected, atol=3.0)


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
def test_the_pictures_of_a_film_may_be_written_into_a_folder(tmp_path: Path) -> None:
    from PIL import Image

    solution, folder, done = run(), tmp_path / "frames", []
    solution.export_video(
        folder, fps=2.0, size=(450, 300), progress=lambda count, _: done.append(count)
    )
    names = [f"frame_{k:05d}.png" for k in range(1, 5)]  # 0 to 1.5 s
    assert sorted(path.name for path in folder.iterdir()) == names
    assert done == [1, 2, 3, 4]
    for k in (0, 2):
        image = np.asarray(Image.open(folder / names[k]).convert("RGB")) / 255.0
        expected = seen_at(solution, bob(solution, 0.5 * k), 2.0, (450, 300))
        np.testing.assert_allclose(orange_at(image), expected, atol=3.0)
    with pytest.raises(srm.InputError, match="the folder is not empty"):
        solution.export_video(folder)
    said = run_command("simulate", "simple_pendulum", "--video", folder, status=2)
    assert "error: --video: " in said.replace(f"{folder}: ", "")
    assert "steps" not in said


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
        (["--at", "0.4"], "--at: it is about a picture, and none is asked for"),
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


@pytest.mark.stress
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


@pytest.mark.stress
@pytest.mark.browser
def test_the_command_line_gives_an_image_its_size_for_print(tmp_path: Path) -> None:
    from PIL import Image

    saved = tmp_path / "run.npz"
    run().save(saved)
    for options, shape, dpi in (
        (["--size", "column"], (1050, 700), 300.0),
        (["--size", "3,2.5", "--dpi", "100"], (300, 250), 100.0),
        (["--size", "320,200"], (320, 200), None),
    ):
        name = tmp_path / "print.png"
        run_command("play", saved, "--image", name, "--at", "0.4", *options)
        with Image.open(name) as picture:
            assert picture.size == shape
            found = picture.info.get("dpi")
            assert found == (None if dpi is None else pytest.approx((dpi, dpi), abs=0.1))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--size", "column"], "--size: it is about a picture, and none is asked for"),
        (["--dpi", "300"], "--dpi: it is about a picture, and none is asked for"),
        (["--image", "a.png", "--dpi", "300"], "--dpi: the size in inches is missing"),
        (["--image", "a.png", "--size", "9,x"], "--size: '9,x' is not a size"),
        (["--image", "a.png", "--size", "0,600"], "is not a width and a height in pixels"),
        (["--image", "a.png", "--size", "4.5,600"], "is not a width and a height in pixels"),
        (["--image", "a.png", "--size", "poster"], "'poster' is not a size. Write 900,600"),
        (["--image", "a.png", "--size", "900x600"], "'900x600' is not a size. Write 900,600"),
        (["--image", "a.png", "--size", "9000,600"], "larger than the browser draws"),
        (["--image", "a.png", "--size", "90,60", "--dpi", "300"], "larger than the browser draws"),
    ],
)
def test_a_size_without_its_image_or_that_is_none_is_refused_before_the_run(
    options: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = run_command("simulate", "simple_pendulum", *options, status=2)
    assert words in said
    assert "steps" not in said


def test_an_unknown_kind_of_film_is_refused_before_the_run(tmp_path: Path) -> None:
    film = tmp_path / "film.avi"
    assert "--video" in run_command("simulate", "simple_pendulum", "--video", film, status=2)


def test_without_playwright_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "playwright.sync_api", None)
    with pytest.raises(srm.InputError, match=r'pip install "srm-mbs\[render\]"'):
        run().export_image(tmp_path / "a.png")


@pytest.mark.usefixtures("without_browser")
def test_a_folder_that_is_not_there_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(srm.InputError, match=r"there is no folder .*nowhere'. Make it"):
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


def test_chromium_has_its_sandbox_unless_the_user_is_root(monkeypatch: pytest.MonkeyPatch) -> None:
    launched: list[dict[str, Any]] = []

    def launch(**options: Any) -> Any:
        launched.append(options)
        return SimpleNamespace(close=lambda: None)

    chromium = SimpleNamespace(executable_path=sys.executable, launch=launch)
    playwright = nullcontext(SimpleNamespace(chromium=chromium))
    monkeypatch.setattr("playwright.sync_api.sync_playwright", lambda: playwright)
    for user in (1000, 0):
        monkeypatch.setattr(os, "geteuid", lambda user=user: user)
        with rendering.browser():
            pass
    sandboxed, bare = launched
    assert "--no-sandbox" not in sandboxed["args"]
    assert sandboxed["chromium_sandbox"] is True  # playwright's default is False
    assert "--no-sandbox" in bare["args"]
    assert bare["chromium_sandbox"] is False


def test_a_chromium_that_does_not_start_is_an_input_error(monkeypatch: pytest.MonkeyPatch) -> None:
    from playwright.sync_api import Error

    def launch(**_: Any) -> Any:
        raise Error("closed\nBrowser logs:\nChromium sandboxing failed!")

    chromium = SimpleNamespace(executable_path=sys.executable, launch=launch)
    playwright = nullcontext(SimpleNamespace(chromium=chromium))
    monkeypatch.setattr("playwright.sync_api.sync_playwright", lambda: playwright)
    with (
        pytest.raises(
            srm.InputError, match=r"its sandbox does not work here\. Use the Chromium of"
        ),
        rendering.browser(),
    ):
        pass


@cache
def photograph() -> bytes:
    """A PNG."""
    from PIL import Image

    out = io.BytesIO()
    Image.new("RGB", (60, 40)).save(out, "PNG")
    return out.getvalue()


@pytest.fixture
def without_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every photograph is the same."""
    taken = nullcontext(lambda t: photograph())
    monkeypatch.setattr(rendering, "photographer", lambda *_, **__: taken)


@pytest.mark.usefixtures("without_browser")
@pytest.mark.parametrize("name", ["-y.mp4", "-version.mp4", "http:x.mp4", "-y.gif", "-.png"])
def test_a_name_is_neither_an_option_nor_an_address(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    if name.endswith(".png"):
        run().export_image(name, size=(60, 40))
    else:
        run().export_video(name, fps=2.0, size=(60, 40))
    (written,) = tmp_path.iterdir()
    assert written.name == name
    start = written.read_bytes()[:8]
    assert start[4:8] == b"ftyp" or start[:4] in (b"GIF8", b"\x89PNG")


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """No file of this process can be longer than ``size`` bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


WRITERS = {
    ".png": srm.Solution.export_image,
    ".gif": srm.Solution.export_video,
    ".mp4": srm.Solution.export_video,
    ".html": srm.Solution.export_html,
    " plot.png": srm.Solution.plot,
    ".svg": srm.Solution.plot,
    ".pdf": srm.Solution.plot,
}


@pytest.mark.usefixtures("without_browser")
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_old_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / f"run{name}"
    path.write_bytes(b"of yesterday")
    with pytest.raises((srm.InputError, OSError)), files_up_to(64):
        WRITERS[name](run(), path)
    assert path.read_bytes() == b"of yesterday"
    assert list(tmp_path.iterdir()) == [path]
    WRITERS[name](run(), path)
    assert path.stat().st_size > 64
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("without_browser")
def test_an_encoder_that_fails_leaves_the_old_film_and_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder, film = tmp_path / "ffmpeg", tmp_path / "film.mp4"
    encoder.write_text(
        '#!/bin/sh\nfor last; do :; done\necho half > "${last#file:}"\n'
        'cat > /dev/null\necho "no space for $last" >&2\nexit 1\n'
    )
    encoder.chmod(0o755)
    film.write_bytes(b"of yesterday")
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    with pytest.raises(srm.InputError, match=r"no space for file:\S*/film\.mp4\. Write a \.gif"):
        run().export_video(film)
    assert film.read_bytes() == b"of yesterday"
    assert {path.name for path in tmp_path.iterdir()} == {"ffmpeg", "film.mp4"}


def test_no_program_of_the_working_folder_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "ffmpeg").write_text("#!/bin/sh\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", os.pathsep.join([".", ""]))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(srm.InputError, match="ffmpeg, which is not installed"):
        rendering.encoder_of(Path("film.mp4"))


def age(folder: Path) -> None:
    """Make ``folder`` older than any program takes to lock it."""
    before = time.time() - 2.0 * rendering.LOCKING_TIME
    os.utime(folder, (before, before))


def test_what_a_killed_program_left_is_removed_by_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = (
        "import time\nfrom srm_mbs.visualization.animation.video import private_folder\n"
        "with private_folder() as folder:\n"
        "    (folder / 'page.html').write_text('')\n"
        "    print(folder, flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parents[3],
        env=os.environ | {"TMPDIR": str(tmp_path)},
    ) as killed:
        assert killed.stdout is not None
        left = Path(killed.stdout.readline().decode().strip())
        assert left.parent == tmp_path
        assert left.stat().st_mode & 0o777 == 0o700
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        age(left)
        with rendering.private_folder():
            assert (left / "page.html").exists()  # its program lives
        killed.kill()
    with rendering.private_folder() as own:
        assert list(tmp_path.iterdir()) == [own]
    assert list(tmp_path.iterdir()) == []


def test_only_old_folders_of_its_own_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "kept"
    new, other, linked = (*(kept / "srm-mbs-new", kept / "another", tmp_path / "linked"),)
    for folder in (kept, new, other, linked):
        folder.mkdir()
    (linked / "thesis.tex").write_text("")
    (kept / "srm-mbs-link").symlink_to(linked)
    (kept / "srm-mbs-notes.txt").write_text("")
    age(other)
    age(kept / "srm-mbs-notes.txt")
    before = set(kept.iterdir())
    monkeypatch.setattr(tempfile, "tempdir", str(kept))
    monkeypatch.setattr(rendering, "LOCKING_TIME", 0.0)  # links have no age of their own
    age_of_new = new.stat().st_mtime
    monkeypatch.setattr(rendering.time, "time", lambda: age_of_new - 1.0)
    with rendering.private_folder():
        pass
    assert set(kept.iterdir()) == before
    monkeypatch.setattr(rendering.time, "time", lambda: age_of_new + 1e6)
    with rendering.private_folder():
        pass
    assert set(kept.iterdir()) == before - {new}
    assert (linked / "thesis.tex").exists()
