"""Compiles C into shared libraries and keeps them for the user, below the folder for caches.

A library lies under the SHA-256 of its source, the flags, the compiler and the processor; beside it
lies the SHA-256 of its own bytes, so that what a full disk or a crash left is never loaded.  Files
appear by renaming, whole or not at all.  The folder belongs to the user alone: others could put
code there that runs as the user.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple, TypeVar

from srm_mbs.errors import get_logger

log = get_logger(__name__)

# Products and sums are fused, which rounds once instead of twice; nothing else is allowed that
# changes a result.
FLAGS = ("-std=c11", "-O2", "-fPIC", "-shared", "-ffp-contract=fast", "-fno-math-errno")
LARGEST = 64 * 2**20
"""Bytes of the cache; the files used least recently go first."""
PATIENCE = 120.0
"""Time (s) after which a compiler counts as hanging."""
_ABANDONED = 3600.0
"""Age (s) of files without a library that no compilation can still be about to rename."""

Loaded = TypeVar("Loaded")


class CompilationError(Exception):
    """There is no compiler, or it failed.

    Attributes
    ----------
    remedy
        An imperative.
    """

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem)
        self.remedy = remedy


class Compiler(NamedTuple):
    """A C compiler.

    Attributes
    ----------
    command
        With the flags that choose the processor.
    identity
        Path, size and time of change of its program.
    """

    command: tuple[str, ...]
    identity: str


class Compiled(NamedTuple):
    """A library and how it was found.

    Attributes
    ----------
    seconds
        Time (s) that its compilation took; 0 if it was found in the cache.
    path
        Where it lies in the cache; None if it could not be kept.
    """

    seconds: float
    path: Path | None


@cache
def compiler() -> Compiler | None:
    """The C compiler: the environment variable CC, else cc; None without one."""
    command = shlex.split(os.environ.get("CC", "")) or ["cc"]
    found = shutil.which(command[0])
    if found is None:
        return None
    program = os.path.realpath(found)
    state = os.stat(program)
    intel = platform.machine().lower() in ("x86_64", "amd64", "i686")
    native = "-march=native" if intel else "-mcpu=native"
    identity = f"{program} {state.st_size} {state.st_mtime_ns}"
    return Compiler((found, *command[1:], native), identity)


@cache
def processor() -> str:
    """The properties of this processor that a compiler sees when it compiles for it."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(errors="replace").split("\n\n", 1)[0].splitlines()
        kept = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU ")
        return "\n".join(line for line in lines if line.startswith(kept))
    return f"{platform.machine()} {platform.processor()} {platform.platform()}"


def cache_folder() -> Path:
    """Where compiled code lies: the environment variable SRM_MBS_CACHE, else srm-mbs below
    XDG_CACHE_HOME or the system's folder for caches.

    The folder need not exist.
    """
    own = os.environ.get("SRM_MBS_CACHE", "")
    if os.path.isabs(own):
        return Path(own)
    given = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(given):
        base = Path(given)
    else:
        base = Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache")
    return base / "srm-mbs" / "code"


def unsafe_reason(folder: Path) -> str | None:
    """Why code in ``folder`` is not loaded: others could write there; None if only the user can."""
    state = os.lstat(folder)
    if not stat.S_ISDIR(state.st_mode):
        return f"{folder} is no folder"
    if state.st_uid != os.getuid():
        return f"{folder} belongs to another user"
    if stat.S_IMODE(state.st_mode) & 0o077:
        return f"{folder} is open to other users"
    return None


def _usable_folder() -> Path | None:
    """The cache, made if need be; None where it cannot be used."""
    try:
        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        unsafe = unsafe_reason(folder)
    except (OSError, RuntimeError) as error:  # RuntimeError: no home
        unsafe = str(error)
    if unsafe is None:
        return folder
    log.info("compiled code is not kept: %s", unsafe)
    return None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _key(source: str, chosen: Compiler) -> str:
    parts = (source, *FLAGS, *chosen.command, chosen.identity, processor())
    return _digest("\0".join(parts).encode())


def _intact(library: Path) -> bool:
    """Whether ``library`` is what was written there."""
    try:
        return library.with_suffix(".sha256").read_text() == _digest(library.read_bytes())
    except (OSError, UnicodeDecodeError):
        return False


def load_cached(source: str, load: Callable[[Path], Loaded]) -> tuple[Loaded, Compiled] | None:
    """As :func:`compile_and_load`, but None where the cache has no library of ``source``."""
    chosen = compiler()
    folder = None if chosen is None else _usable_folder()
    if chosen is None or folder is None:
        return None
    library = folder / f"{_key(source, chosen)}.so"
    if not _intact(library):
        return None
    try:
        loaded = load(library)
    except ValueError:
        return None
    with suppress(OSError):
        os.utime(library)
    return loaded, Compiled(0.0, library)


def compile_and_load(
    source: str, load: Callable[[Path], Loaded], patience: float = PATIENCE
) -> tuple[Loaded, Compiled]:
    """The library of ``source``, from the cache or compiled, as ``load`` makes it of its path.

    Parameters
    ----------
    source
        C11.
    load
        Raises ValueError for a library that cannot be loaded, which is then compiled again.
    patience
        Time (s) that the compiler has.

    Raises
    ------
    CompilationError
        If there is no compiler, or it fails.
    """
    chosen = compiler()
    if chosen is None:
        raise CompilationError(
            "there is no C compiler: no program cc was found, and the environment variable CC "
            "names none",
            "Install a C compiler",
        )
    found = load_cached(source, load)
    if found is not None:
        return found
    folder, key = _usable_folder(), _key(source, chosen)
    library = None if folder is None else folder / f"{key}.so"
    with tempfile.TemporaryDirectory(prefix="srm-mbs-") as made_in:
        started = time.perf_counter()
        made = Path(made_in, f"{key}.so")
        _compile(source, made, chosen, patience)
        seconds = time.perf_counter() - started
        kept = None if library is None else _keep(made, library)
        try:
            # What is mapped stays there when its file goes.
            return load(made), Compiled(seconds, kept)
        except ValueError as error:
            problem = f"the code that {chosen.command[0]} made cannot be loaded: {error}"
            raise CompilationError(problem, "Use another C compiler") from error


def _compile(source: str, made: Path, chosen: Compiler, patience: float) -> None:
    """Compile ``source`` into the library ``made``."""
    text = made.with_suffix(".c")
    text.write_text(source)
    command = [*chosen.command, *FLAGS, "-o", str(made), str(text), "-lm"]
    name = chosen.command[0]
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            cwd=made.parent,
            start_new_session=True,
        )
    except OSError as error:
        problem = f"the C compiler {name} cannot be run: {error}"
        raise CompilationError(problem, "Install a C compiler") from error
    try:
        _, said = process.communicate(timeout=patience)
    except BaseException as error:
        # Compilers start others, which would go on.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        if isinstance(error, subprocess.TimeoutExpired):
            problem = f"the C compiler {name} made nothing within {patience:g} s"
            raise CompilationError(problem, "Use another C compiler") from error
        raise
    if process.returncode or not made.is_file():
        last = next((line for line in reversed(said.splitlines()) if line.strip()), "no message")
        raise CompilationError(f"the C compiler {name} failed: {last}", "Use another C compiler")


def _keep(made: Path, library: Path) -> Path | None:
    """Copy a new library into the cache; where it lies there, or None if it could not be."""
    content = made.read_bytes()
    try:
        _write(library, content)
        _write(library.with_suffix(".sha256"), _digest(content).encode())
        _shrink(library.parent)
    except OSError as error:
        log.info("compiled code is not kept: %s", error)
        return None
    return library


def _write(path: Path, content: bytes) -> None:
    """Write a file that appears whole or not at all."""
    number, name = tempfile.mkstemp(dir=path.parent, prefix="new-")
    try:
        with open(number, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise


def _shrink(folder: Path) -> None:
    """Remove what was used least recently, down to LARGEST, and what was abandoned."""
    found = []
    for path in folder.iterdir():
        with suppress(OSError):  # others may remove files meanwhile
            state = path.stat()
            if path.suffix == ".so":
                found.append((state.st_mtime, state.st_size, path))
            elif path.name.startswith("new-") and time.time() - state.st_mtime > _ABANDONED:
                path.unlink()
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= LARGEST:
            return
        _remove(path)
        total -= size


def _remove(library: Path) -> None:
    for path in (library.with_suffix(".sha256"), library):
        with suppress(FileNotFoundError):
            path.unlink()


def clear() -> tuple[int, int]:
    """Remove all compiled code of this user: number of libraries, and bytes.

    Raises
    ------
    OSError
        If files cannot be removed.
    """
    count = size = 0
    folder = cache_folder()
    if not folder.is_dir():
        return 0, 0
    for path in folder.iterdir():
        if path.suffix not in (".so", ".sha256") and not path.name.startswith("new-"):
            continue
        size += path.lstat().st_size
        count += path.suffix == ".so"
        path.unlink()
    return count, size


def contents() -> tuple[int, int]:
    """Number of libraries in the cache, and bytes."""
    folder = cache_folder()
    sizes = [path.stat().st_size for path in folder.glob("*.so")] if folder.is_dir() else []
    return len(sizes), sum(sizes)
