"""Reading within bounds, writing whole or not at all."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import pytest

import srm_mbs as srm
from srm_mbs.formats import files
from srm_mbs.formats.files import (
    checked_path,
    open_regular,
    read_bytes,
    read_text,
    whole_file,
    write_text,
    write_texts,
)

posix = pytest.mark.skipif(os.name != "posix", reason="devices and pipes of POSIX")
locks = pytest.mark.skipif(files.fcntl is None, reason="locks of files")


@posix
@pytest.mark.timeout(10)
def test_a_pipe_is_refused_without_waiting_for_a_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")

    with pytest.raises(srm.InputError, match="no regular file"):
        read_bytes(tmp_path / "pipe")


@posix
@pytest.mark.parametrize("path", ["/dev/zero", "/dev/null"])
def test_a_device_is_refused(path: str) -> None:
    with pytest.raises(srm.InputError, match="no regular file"):
        read_bytes(path)


def test_a_folder_a_missing_file_and_a_bad_name_are_refused_by_name(tmp_path: Path) -> None:
    for path, says in [(tmp_path, "directory"), (tmp_path / "no", "no such"), ("a\0b", "name")]:
        with pytest.raises(srm.InputError, match=says) as caught:
            open_regular(path)
        assert caught.value.file
        assert caught.value.remedy


def test_a_file_above_the_largest_size_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(10**12)  # of which nothing is on the disk

    with pytest.raises(srm.InputError, match="more than 64 MB"):
        read_bytes(path)


def test_text_has_neither_a_mark_nor_ends_of_lines_of_another_system(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes(b"\xef\xbb\xbfone\r\ntwo\rthree\n")

    assert read_text(path) == "one\ntwo\nthree\n"


def test_what_is_no_text_is_refused_without_showing_it(tmp_path: Path) -> None:
    path = tmp_path / "text"
    path.write_bytes(b"secret \xff")

    with pytest.raises(srm.InputError, match="not UTF-8 text") as caught:
        read_text(path)
    assert "secret" not in str(caught.value)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def fail() -> None:
        with whole_file(path) as temporary:
            temporary.write_text("half of the new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()

    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["file.txt"]


def test_a_write_replaces_the_file_and_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    path.chmod(0o640)

    write_text(path, "new")

    assert path.read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert os.listdir(tmp_path) == ["file.txt"]


def test_the_temporary_file_has_the_suffix_that_programs_choose_formats_by(tmp_path: Path) -> None:
    with whole_file(tmp_path / "film.mp4") as temporary:
        assert temporary.suffix == ".mp4"
        assert temporary.parent == tmp_path
        temporary.write_bytes(b"film")

    assert (tmp_path / "film.mp4").read_bytes() == b"film"


def test_a_write_of_nothing_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(b"old")

    with pytest.raises(OSError, match=r"nothing was written.*film\.mp4"), whole_file(path):
        pass  # an encoder that ends without a word

    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["film.mp4"]


WRITER = """
import sys
from pathlib import Path
from srm_mbs.formats.files import whole_file
with whole_file(Path(sys.argv[1])) as temporary:
    temporary.write_text("half of it")
    print(temporary.name, flush=True)
    sys.stdin.readline()
    temporary.write_text("all of it")
"""


def writer(path: Path) -> subprocess.Popen[str]:
    """A process that writes ``path``, and waits in the middle for a line."""
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@locks
def test_what_a_killed_writer_leaves_is_removed_by_the_next_and_no_file_in_use(
    tmp_path: Path,
) -> None:
    (tmp_path / ".srm-notes").write_text("of the user")
    with writer(tmp_path / "killed.csv") as killed, writer(tmp_path / "alive.csv") as alive:
        names = [process.stdout.readline().strip() for process in (killed, alive)]
        killed.kill()
        killed.wait()
        assert set(names) < set(os.listdir(tmp_path))

        write_text(tmp_path / "next.csv", "next")

        assert sorted(os.listdir(tmp_path)) == sorted([".srm-notes", names[1], "next.csv"])
        alive.communicate("go on\n")
        assert alive.returncode == 0
    assert sorted(os.listdir(tmp_path)) == [".srm-notes", "alive.csv", "next.csv"]
    assert (tmp_path / "alive.csv").read_text() == "all of it"


@locks
def test_links_and_pipes_that_look_like_temporary_files_harm_nobody(tmp_path: Path) -> None:
    (tmp_path / "good").write_text("good")
    (tmp_path / f".srm-{'0' * 16}").symlink_to(tmp_path / "good")
    os.mkfifo(tmp_path / f".srm-{'1' * 16}.csv")

    write_text(tmp_path / "next.csv", "next")

    assert (tmp_path / "good").read_text() == "good"
    assert (tmp_path / "next.csv").read_text() == "next"


@locks
def test_many_writers_at_once_lose_no_file(tmp_path: Path) -> None:
    def write(k: int) -> None:
        for _ in range(20):
            write_text(tmp_path / f"{k % 4}.txt", f"{k}")

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, range(8)))

    assert sorted(os.listdir(tmp_path)) == [f"{k}.txt" for k in range(4)]
    for k in range(4):
        assert int((tmp_path / f"{k}.txt").read_text()) % 4 == k


@posix
def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real")

    write_text(tmp_path / "link", "new")

    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"


@posix
def test_a_device_is_written_to_as_it_is() -> None:
    write_text("/dev/null", "text")

    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_a_folder_that_is_not_there_is_named_by_the_path_given(tmp_path: Path) -> None:
    path = tmp_path / "no folder" / "file.txt"

    with pytest.raises(OSError, match=r"no folder.file\.txt"):
        write_text(path, "text")


WRITES: dict[str, Callable[[Path], object]] = {
    "save": lambda folder: pendulum_run().save(folder / "run.npz"),
    "csv": lambda folder: pendulum_run().to_csv(folder / "run.csv"),
    "plot": lambda folder: pendulum_run().plot(folder / "run.png"),
    "page": lambda folder: pendulum_run().export_html(folder / "run.html"),
    "report": lambda folder: pendulum_run().report(folder / "run.html", again=False),
    "convert": lambda folder: srm.convert("four_bar", folder / "four_bar.toml"),
}


@cache
def pendulum_run() -> srm.Solution:
    return srm.simulate(srm.load("simple_pendulum"), 0.1)


@pytest.mark.parametrize("name", WRITES)
def test_whatever_is_written_into_a_missing_folder_says_to_make_it(
    name: str, tmp_path: Path
) -> None:
    folder = tmp_path / "results"
    with pytest.raises((srm.InputError, FileNotFoundError)) as refused:
        WRITES[name](folder)
    assert f"there is no folder {str(folder)!r}. Make it first" in str(refused.value)
    folder.mkdir()
    WRITES[name](folder)
    assert any(folder.iterdir())


@posix
def test_a_write_protected_file_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    path.chmod(0o444)
    if os.access(path, os.W_OK):
        pytest.skip("root may write every file")

    with pytest.raises(PermissionError, match=r"file\.txt"):
        write_text(path, "new")

    assert path.read_text() == "old"


def test_of_several_files_none_is_replaced_if_one_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("old")

    with pytest.raises(OSError, match="no folder"):
        write_texts({tmp_path / "a": "new", tmp_path / "no folder" / "b": "new"})
    with pytest.raises(OSError, match="no folder"):
        write_texts({tmp_path / "no folder" / "b": "new", tmp_path / "a": "new"})

    assert (tmp_path / "a").read_text() == "old"
    assert os.listdir(tmp_path) == ["a"]


def test_several_files_are_written_together(tmp_path: Path) -> None:
    write_texts({tmp_path / "a": "first", tmp_path / "b": "second \udc80"})

    assert (tmp_path / "a").read_text() == "first"
    assert (tmp_path / "b").read_text() == "second \\udc80"
    assert sorted(os.listdir(tmp_path)) == ["a", "b"]


class Raising:
    """A path whose name cannot be asked for."""

    def __fspath__(self) -> str:
        raise RuntimeError("no name")


@pytest.mark.parametrize("path", [None, 3, b"bytes", "", "a\0b", ["a"], Raising()])
def test_what_is_no_path_is_refused_by_the_name_of_the_argument(path: object) -> None:
    with pytest.raises(srm.InputError) as caught:
        checked_path(path, "out")

    assert caught.value.element == "out"
