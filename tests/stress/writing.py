"""Writers that are disturbed: children that write a file while something goes wrong.

``python -m tests.stress.writing FAULT TRIALS FOLDER`` prints one JSON line with the outcomes.  It
forks: the package is imported and the runs are made once, not in every child.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import srm_mbs as srm
from srm_mbs.formats import files
from srm_mbs.visualization.animation.page import write_file

Write = Callable[[Path], object]
"""Writes one version of a file, or of several files, of which the path is the first."""

SIGNALS = {"sigint": signal.SIGINT, "sigterm": signal.SIGTERM, "sigkill": signal.SIGKILL}
FAULTS = ("full disk", "size limit", *SIGNALS, "two writers")
SMALLEST_LIMIT = 100
"""Bytes of the smallest limit of a file size."""
DISK = 16 * 2**20
"""Bytes of the disk that is filled."""


def writers() -> dict[str, tuple[Write, Write]]:
    """Name of the file -> writers of the old and the new version."""
    mechanism = srm.load("four_bar")
    old, new = (srm.simulate(mechanism, t_end) for t_end in (1.0, 3.0))
    sweeps = [srm.sweep(mechanism, [{}] * count, 0.05) for count in (2, 3)]
    return {
        "run.npz": (old.save, new.save),
        "run.csv": (old.to_csv, new.to_csv),
        "sweep.csv": (sweeps[0].to_csv, sweeps[1].to_csv),
        "sweep.parquet": (sweeps[0].to_parquet, sweeps[1].to_parquet),
        "run.html": (_page(old), _page(new)),
        "run.png": (old.plot, new.plot),
        "converted.toml": (_convert("four_bar"), _convert("slider_crank")),
    }


def _page(solution: srm.Solution) -> Write:
    """Writes an animation that is made once: each has new identifiers, and takes a second."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder, "page.html")
        solution.export_html(page)
        content = page.read_bytes()
    return lambda path: write_file(path, content)


def _convert(name: str) -> Write:
    return lambda path: srm.convert(name, path, force=True)


def contents(path: Path) -> dict[str, bytes]:
    """The file ``path`` and those written with it, name -> content."""
    names = (path, path.with_suffix(".urdf")) if path.suffix == ".toml" else (path,)
    return {name.name: name.read_bytes() for name in names if name.exists()}


class Trials:
    """Disturbed writes of the files of :func:`writers`.

    Parameters
    ----------
    fault
        One of FAULTS.
    folder
        An empty folder.
    """

    def __init__(self, fault: str, folder: Path) -> None:
        self._fault, self._folder = fault, folder
        self._random = random.Random(fault)
        self._writers = writers()
        self.mounted = fault == "full disk" and _mount(folder)
        self._versions: dict[str, tuple[dict[str, bytes], dict[str, bytes]]] = {}
        self._seconds: dict[str, float] = {}
        for name, pair in self._writers.items():
            self._versions[name] = (self._version(name, pair[0]), self._version(name, pair[1]))
            started = time.perf_counter()
            os.waitpid(self._child(pair[1], folder / name, lambda: None), 0)
            self._seconds[name] = time.perf_counter() - started
            self._clear()

    def _version(self, name: str, write: Write) -> dict[str, bytes]:
        write(self._folder / name)
        found = contents(self._folder / name)
        self._clear()
        return found

    def _clear(self) -> None:
        for path in self._folder.iterdir():
            path.unlink()

    def close(self) -> None:
        """Remove what was mounted."""
        if self.mounted:
            subprocess.run(["umount", str(self._folder)], check=True)

    def run(self, name: str) -> str:
        """One trial: ``old``, ``new`` or ``mixed`` (of several files), or a fault of its own."""
        path, (old, new) = self._folder / name, self._versions[name]
        for file, content in old.items():
            (self._folder / file).write_bytes(content)
        self._disturbed(name, path)
        filler = self._folder / "filler"
        filler.unlink(missing_ok=True)
        found = contents(path)
        left = set(os.listdir(self._folder)) - set(found)
        self._clear()
        if left and self._fault not in ("sigterm", "sigkill"):
            return f"left behind: {', '.join(sorted(left))}"
        if len(found) < len(old):
            return "lost"
        kinds = {
            "old" if content == old[file] else "new" if content == new[file] else "torn"
            for file, content in found.items()
        }
        if "torn" in kinds:
            return "torn"
        return "mixed" if len(kinds) > 1 else kinds.pop()

    def _disturbed(self, name: str, path: Path) -> None:
        """Write the new version of ``name`` while something goes wrong."""
        old, new = self._writers[name]
        size = sum(len(content) for content in self._versions[name][1].values())
        if self._fault in SIGNALS:
            child = self._child(new, path, lambda: None)
            time.sleep(self._random.uniform(0.0, 1.2) * self._seconds[name])
            os.kill(child, SIGNALS[self._fault])
            os.waitpid(child, 0)
            return
        if self._fault == "two writers":
            both = self._random.sample((old, new), 2)
            children = [self._child(write, path, lambda: None) for write in both]
        elif self._fault == "size limit":
            limit = self._random.randrange(SMALLEST_LIMIT, int(1.2 * size))
            children = [self._child(new, path, lambda: _limit(limit))]
        elif self.mounted:
            free = shutil.disk_usage(self._folder).free - self._random.randrange(int(1.2 * size))
            (self._folder / "filler").write_bytes(bytes(free))
            children = [self._child(new, path, lambda: None)]
        else:
            count = self._random.randrange(3)
            children = [self._child(new, path, lambda: _fail_after(count))]
        for child in children:
            os.waitpid(child, 0)

    def _child(self, write: Write, path: Path, before: Callable[[], None]) -> int:
        """The id of a process that writes ``path``."""
        child = os.fork()
        if child:
            return child
        status = 1
        try:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            before()
            write(path)
            status = 0
        except (OSError, srm.SrmError, KeyboardInterrupt):
            pass
        finally:
            os._exit(status)


def _mount(folder: Path) -> bool:
    """Whether ``folder`` is a small disk of its own now, which only root may mount."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(folder)]
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def _limit(size: int) -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def _fail_after(count: int) -> None:
    """Let the disk be full from the write number ``count`` on, as far as it shows at the end."""
    fsync, calls = os.fsync, 0

    def full(file: int) -> None:
        nonlocal calls
        calls += 1
        if calls > count:
            raise OSError(28, "No space left on device")
        fsync(file)

    files.os.fsync = full  # type: ignore[assignment]


def main(fault: str, count: int, folder: Path) -> dict[str, Any]:
    """Outcomes of ``count`` trials of each file: name -> outcome -> number."""
    # A child of one process with threads: none of them is in the middle of anything.
    warnings.simplefilter("ignore", DeprecationWarning)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # but in the children
    trials = Trials(fault, folder)
    try:
        outcomes = {
            name: Counter(trials.run(name) for _ in range(count)) for name in trials._versions
        }
        return {"mounted": trials.mounted, "outcomes": outcomes}
    finally:
        trials.close()


if __name__ == "__main__":
    outcomes = main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
    sys.stdout.write(json.dumps(outcomes) + "\n")
