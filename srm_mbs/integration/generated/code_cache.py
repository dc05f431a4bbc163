"""Compiles C into shared libraries and keeps them for the user, below the folder for caches.

A library lies under the SHA-256 of what determines its source, the flags, the compiler and the
processor; beside it lies the SHA-256 of its own bytes, so that what a full disk or a crash left is
never loaded.  Files appear by renaming, whole or not at all.  The folder belongs to the user alone:
others could put code there that runs as the user.

:func:`compile_and_load` waits for the compiler, :class:`Compilation` lets it work beside the
program.  No thread does: a program with one must not fork.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import IO, NamedTuple, NoReturn, TypeVar

from platformdirs import user_cache_path

from srm_mbs.errors import get_logger

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

log = get_logger(__name__)

# Products and sums are fused, which rounds once instead of twice; nothing else is allowed that
# changes a result.  Thousands of statements without a branch have few common subexpressions between
# blocks; GCC's register allocator, which takes a third of the time there, need not weigh each spill
# against hundreds of others; nor do its searches for equal loads and dead stores find more where
# they look past hundreds of stores, which each of them would do for each load (a quarter of the
# time).  Clang warns of what it does not know of these.
_SEARCHES = {
    "lra-max-considered-reload-pseudos": 20,
    "max-cselib-memory-locations": 100,
    "sccvn-max-alias-queries-per-access": 100,
    "dse-max-alias-queries-per-store": 10,
    "max-dse-active-local-stores": 50,
}
FLAGS = (
    *("-std=c11", "-O2", "-fPIC", "-ffp-contract=fast", "-fno-math-errno"),
    "-fno-gcse",
    *[text for name, most in _SEARCHES.items() for text in ("--param", f"{name}={most}")],
)
# Of C's library, the process has what the code takes of it; macOS links nothing without it.
_LINKING = ("-shared", *(("-nostdlib",) if sys.platform == "linux" else ()), "-lm")
# Terms are scalars, of which a compiler finds pairs but hardly fours: to put these together takes
# more instructions than it saves.  The algebra names the vectors that it has.
_INTEL = ("-march=native", "-mprefer-vector-width=128")
LARGEST = 64 * 2**20
"""Bytes of the cache; the files used least recently go first."""
PATIENCE = 120.0
"""Time (s) after which a compiler counts as hanging."""
_ABANDONED = 3600.0
"""Age (s) of files without a library that no compilation can still be about to rename."""

_WORK = "srm-mbs-new-"
"""Beginning of the names of files and folders that are not whole yet."""
# The user may have named a folder that has other files, too.
_OWN = re.compile(rf"[0-9a-f]{{64}}\.(so|sha256|lock)|{_WORK}.*")
_ZIG_FOLDERS = ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")
_MESSAGES = "messages"
"""File with what a compiler says."""
NICENESS = 5
"""Added to that of the process for compilers in the background: on a core that is busy otherwise
they get a quarter of it (weights 335 and 1024 of Linux)."""
_WAIT = 0.02
"""Time (s) between two looks at what another process compiles."""

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
    folders
        Environment variables that name folders of its own.
    """

    command: tuple[str, ...]
    identity: str
    folders: tuple[str, ...] = ()


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
    """The C compiler: the environment variable CC, else cc, else that of the package ``ziglang``;
    None without one."""
    try:
        named = shlex.split(os.environ.get("CC", ""))
    except ValueError:  # an open quotation: no program has this name
        return None
    command = named or ["cc"]
    found = shutil.which(command[0])
    if found is not None and (named or not _offers_installation(found)):
        return _at(found, command[1:])
    zig = None if named else _zig()
    return None if zig is None else _at(zig, ["cc"], _ZIG_FOLDERS)


def _at(path: str, arguments: list[str], folders: tuple[str, ...] = ()) -> Compiler | None:
    """The compiler that the program at ``path`` is."""
    path, program = os.path.abspath(path), os.path.realpath(path)  # it runs in another folder
    try:
        state = os.stat(program)
    except OSError:
        return None
    intel = platform.machine().lower() in ("x86_64", "amd64", "i686")
    native = _INTEL if intel else ("-mcpu=native",)
    identity = f"{program} {state.st_size} {state.st_mtime_ns}"
    return Compiler((path, *arguments, *native), identity, folders)


def _offers_installation(path: str) -> bool:
    """Whether this cc of macOS only opens a window that offers to install a compiler."""
    if sys.platform != "darwin" or path != "/usr/bin/cc":
        return False
    command = ["/usr/bin/xcode-select", "--print-path"]
    return subprocess.run(command, capture_output=True, check=False).returncode != 0


def _zig() -> str | None:
    """The compiler of the package ``ziglang``, if that is installed."""
    found = importlib.util.find_spec("ziglang")
    if found is None or found.origin is None:
        return None
    return shutil.which("zig", path=os.path.dirname(found.origin))


@cache
def processor() -> str:
    """The properties of this processor that a compiler sees when it compiles for it."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(errors="replace").split("\n\n", 1)[0].splitlines()
        kept = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU ")
        return "\n".join(line for line in lines if line.startswith(kept))
    return f"{platform.machine()} {platform.processor()} {platform.platform()}"


def cache_folder() -> Path:
    """Where compiled code lies: the environment variable SRM_MBS_CACHE, else srm-mbs below the
    user's folder for caches, on Linux XDG_CACHE_HOME or ~/.cache.

    The folder need not exist.

    Raises
    ------
    FileNotFoundError
        If there is no home to put it in.
    """
    own = os.environ.get("SRM_MBS_CACHE", "")
    if os.path.isabs(own):
        return Path(own)
    problem = "this user has no home, and SRM_MBS_CACHE names no folder for compiled code"
    try:
        folder = user_cache_path("srm-mbs", appauthor=False) / "code"
    except RuntimeError as error:
        raise FileNotFoundError(problem) from error
    if not folder.is_absolute():  # what older versions of platformdirs make of no home
        raise FileNotFoundError(problem)
    return folder


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
    except OSError as error:
        unsafe = str(error)
    if unsafe is None:
        return folder
    log.info("compiled code is not kept: %s", unsafe)
    return None


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _key(identity: str, chosen: Compiler) -> str:
    parts = (identity, *FLAGS, *chosen.command, chosen.identity, processor())
    return _digest("\0".join(parts).encode())


def _intact(library: Path) -> bool:
    """Whether ``library`` is what this user wrote there: others may have put files into a folder
    that was open to them before."""
    try:
        if library.lstat().st_uid != os.getuid():
            return False
        return library.with_suffix(".sha256").read_text() == _digest(library.read_bytes())
    except (OSError, UnicodeDecodeError):
        return False


def keeps_any() -> bool:
    """Whether the cache has any library, whatever it is: some microseconds."""
    try:
        with os.scandir(cache_folder()) as entries:
            return any(entry.name.endswith(".so") for entry in entries)
    except OSError:
        return False


def load_cached(identity: str, load: Callable[[Path], Loaded]) -> tuple[Loaded, Compiled] | None:
    """As :func:`compile_and_load`, but None where the cache has no library of ``identity``."""
    chosen = compiler()
    folder = None if chosen is None else _usable_folder()
    if chosen is None or folder is None:
        return None
    library = folder / f"{_key(identity, chosen)}.so"
    if not _intact(library):
        return None
    try:
        loaded = load(library)
    except ValueError:
        with suppress(OSError):
            _remove(library.with_suffix(".sha256"))
        return None
    with suppress(OSError):
        os.utime(library)
    return loaded, Compiled(0.0, library)


def compile_and_load(
    source: str,
    load: Callable[[Path], Loaded],
    units: int = 1,
    patience: float = PATIENCE,
    identity: str | None = None,
) -> tuple[Loaded, Compiled]:
    """The library of ``source``, from the cache or compiled, as ``load`` makes it of its path.

    Where another process compiles it at this time, that one is waited for.

    Parameters
    ----------
    source
        C11.
    load
        Raises ValueError for a library that cannot be loaded, which is then compiled again.
    units
        Translation units of ``source``, which are compiled at the same time: it has all of them, or
        where the macro UNIT is defined, as 1, 2, ..., that one.
    patience
        Time (s) that the compiler has.
    identity
        Determines ``source``, which it is by default; the library lies under it.

    Raises
    ------
    CompilationError
        If there is no compiler, or it fails.
    """
    identity = source if identity is None else identity
    deadline = time.monotonic() + patience
    while True:
        found = load_cached(identity, load)
        if found is not None:
            return found
        alone = time.monotonic() < deadline
        begun = Compilation.begin(source, units, identity, patience, alone=alone, background=False)
        if begun is not None:
            break
        time.sleep(_WAIT)
    try:
        begun.wait()
        return begun.load(load)
    finally:
        begun.end()


class Compilation:
    """A compiler at work, in a folder of its own; :meth:`end` has to be called.

    It belongs to the process that began it: a fork takes no part in it.
    """

    def __init__(self, key: str, library: Path | None, chosen: Compiler) -> None:
        self._key, self._library, self._compiler = key, library, chosen
        self._processes: list[subprocess.Popen[bytes]] = []
        self._linking: list[str] = []
        self._lock_file: IO[bytes] | None = None
        self._folder: Path | None = None
        self._owner = os.getpid()
        self._patience = PATIENCE
        self._started = time.monotonic()
        self._seconds = 0.0

    @classmethod
    def begin(
        cls,
        source: str,
        units: int,
        identity: str,
        patience: float,
        *,
        alone: bool,
        background: bool,
    ) -> Compilation | None:
        """Start the compiler.

        Parameters
        ----------
        source, units, identity, patience
            As for :func:`compile_and_load`.
        alone
            Whether None is returned where another process compiles the same, or just has.
        background
            Whether it runs at a low priority, and compiles all units as one, which takes less CPU
            time.  One of this process that does, and compiles the same, is ended by one that does
            not.

        Raises
        ------
        CompilationError
            If there is no compiler, or it cannot be started.
        """
        chosen = compiler()
        if chosen is None:
            raise CompilationError(
                "there is no C compiler: no program cc was found, and the environment variable CC "
                "names none",
                "Install a C compiler, or the package ziglang",
            )
        folder, key = _usable_folder(), _key(identity, chosen)
        before = _background.get(key)
        if before is not None and not background:
            before.end()
        made = cls(key, None if folder is None else folder / f"{key}.so", chosen)
        made._patience = patience
        try:
            if alone and not made._locked():
                return None
            if made._lock_file is not None and made._library and _intact(made._library):
                made.end()
                return None
            texts = made._write_units(source, 1 if background else units, folder)
            made._start(texts, NICENESS if background else 0)
        except BaseException:
            made.end()
            raise
        if background:
            _background[key] = made
        return made

    def _locked(self) -> bool:
        """Whether no other process compiles the same: this one is then the one that does."""
        if self._library is None or fcntl is None:
            return True
        path = self._library.with_suffix(".lock")
        try:
            file = open(path, "wb")  # noqa: SIM115 - it is open as long as it is locked
        except OSError:  # a full disk: what follows says so
            return True
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            return False
        except OSError:  # a file system without locks: the last one to finish is kept
            file.close()
            return True
        self._lock_file = file
        return True

    def _write_units(self, source: str, units: int, folder: Path | None) -> list[Path]:
        """Write the units of the source into a new folder.

        It lies in the cache, which is cleaned of the folders of killed processes, or where that has
        no room, elsewhere.
        """
        for place in (folder, None):
            try:
                self._folder = Path(tempfile.mkdtemp(prefix=_WORK, dir=place))
                paths = [self._folder / f"{number}.c" for number in range(1, units + 1)]
                for path in paths:
                    path.write_text(f"#define UNIT {path.stem}\n{source}" if units > 1 else source)
                return paths
            except OSError as error:
                problem = f"the code cannot be written: {error}"
                if self._folder is not None:
                    shutil.rmtree(self._folder, ignore_errors=True)
        raise CompilationError(problem, "Make room for temporary files")

    def _start(self, texts: Sequence[Path], niceness: int) -> None:
        """Start a compiler for each of the ``texts``."""
        command, folder = [*self._compiler.command, *FLAGS], texts[0].parent
        linked = ["-o", str(folder / f"{self._key}.so")]
        if len(texts) == 1:
            self._run([*command, *linked, str(texts[0]), *_LINKING], folder)
        else:
            objects = [str(text.with_suffix(".o")) for text in texts]
            self._linking = [*command, *linked, *objects, *_LINKING]
            for text, made in zip(texts, objects):
                self._run([*command, "-c", "-o", made, str(text)], folder)
        if niceness:
            for process in self._processes:
                with suppress(OSError):  # it may have ended
                    os.setpriority(os.PRIO_PGRP, process.pid, niceness)

    def _run(self, command: Sequence[str], folder: Path) -> None:
        """Start a process in the ``folder`` of the source."""
        environment = {name: str(folder) for name in self._compiler.folders} | os.environ
        try:
            with open(folder / _MESSAGES, "ab") as messages:
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=messages,
                    cwd=folder,
                    env=environment,
                    start_new_session=True,
                )
        except OSError as error:
            problem = f"the C compiler {command[0]} cannot be run: {error}"
            raise CompilationError(problem, "Install a C compiler") from error
        self._processes.append(process)

    def _link(self) -> bool:
        """Start what links the units, if all are compiled and it was not yet; whether it does."""
        command, self._linking, folder = self._linking, [], self._folder
        if not command or folder is None or any(own.returncode for own in self._processes):
            return False
        self._run(command, folder)
        return True

    @property
    def ended(self) -> bool:
        """Whether :meth:`end` was called."""
        return not self._processes

    def poll(self) -> bool:
        """Whether the compiler has ended.

        Raises
        ------
        CompilationError
            As :meth:`wait`.
        """
        working = [process for process in self._processes if process.poll() is None]
        if not working and not self._link():
            self._seconds = time.monotonic() - self._started
            return True
        if time.monotonic() - self._started > self._patience:
            self._hangs()
        return False

    def wait(self) -> None:
        """Wait for the compiler.

        Raises
        ------
        CompilationError
            If it does not end in time.
        """
        deadline = self._started + self._patience
        try:
            for process in self._processes:  # while it grows
                process.wait(max(deadline - time.monotonic(), 0.0))
                if process is self._processes[-1]:
                    self._link()
        except subprocess.TimeoutExpired:
            self._hangs()
        self._seconds = time.monotonic() - self._started

    def _hangs(self) -> NoReturn:
        self.end()
        name = self._compiler.command[0]
        problem = f"the C compiler {name} made nothing within {self._patience:g} s"
        raise CompilationError(problem, "Use another C compiler")

    def load(self, load: Callable[[Path], Loaded]) -> tuple[Loaded, Compiled]:
        """The library, copied into the cache.

        Raises
        ------
        CompilationError
            If the compiler failed, or was ended.
        """
        name, folder = self._compiler.command[0], self._folder
        if self.ended or folder is None:
            raise CompilationError(f"the C compiler {name} was ended", "Compile it again")
        made = folder / f"{self._key}.so"
        failed = any(process.returncode for process in self._processes)
        if failed or not made.is_file():
            said = _last_line(folder / _MESSAGES)
            raise CompilationError(
                f"the C compiler {name} failed: {said}", "Use another C compiler"
            )
        kept = None if self._library is None else _keep(made, self._library)
        try:
            # From here: dlopen takes what it has of the path of a library that was damaged.  What
            # is mapped stays there when its file goes.
            return load(made), Compiled(self._seconds, kept)
        except ValueError as error:
            problem = f"the code that {name} made cannot be loaded: {error}"
            raise CompilationError(
                problem,
                "Use another C compiler, or name a folder in SRM_MBS_CACHE whose libraries may be "
                "loaded: some file systems run nothing",
            ) from error

    def end(self) -> None:
        """End the compiler, if it is at work, and remove its folder."""
        _background.pop(self._key, None)
        processes, folder, file = self._processes, self._folder, self._lock_file
        self._processes, self._folder, self._lock_file = [], None, None
        working = [process for process in processes if process.returncode is None]
        if self._owner != os.getpid():
            for process in working:
                process.returncode = 0  # the fork's: its collection would warn
            return
        for process in working:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # compilers start others
        for process in working:
            process.wait()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        if file is not None:
            with suppress(OSError):
                os.unlink(file.name)
            # Forks have the file open, too.
            fcntl.flock(file, fcntl.LOCK_UN)
            file.close()


_background: dict[str, Compilation] = {}
"""Compilations in the background of this process."""


def end_background() -> None:
    """End all compilations in the background of this process."""
    for compilation in list(_background.values()):
        compilation.end()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=end_background)


def _last_line(path: Path) -> str:
    """The last line of a file that is not empty."""
    try:
        lines = path.read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    return next((line for line in reversed(lines) if line.strip()), "no message")


def _keep(made: Path, library: Path) -> Path | None:
    """Copy a new library into the cache; where it lies there, or None if it could not be."""
    try:
        content = made.read_bytes()
        _write(library, content)
        _write(library.with_suffix(".sha256"), _digest(content).encode())
        _shrink(library.parent)
    except OSError as error:
        log.info("compiled code is not kept: %s", error)
        return None
    return library


def _write(path: Path, content: bytes) -> None:
    """Write a file that appears whole or not at all."""
    number, name = tempfile.mkstemp(dir=path.parent, prefix=_WORK)
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
    for path in _own_files(folder):
        with suppress(OSError):  # others may remove files meanwhile
            state = path.stat()
            if path.suffix == ".so":
                found.append((state.st_mtime, state.st_size, path))
            elif path.name.startswith(_WORK) and time.time() - state.st_mtime > _ABANDONED:
                _remove(path)
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= LARGEST:
            return
        _remove(path.with_suffix(".sha256"))
        _remove(path)
        total -= size


def _own_files(folder: Path) -> list[Path]:
    """Files and folders in ``folder`` that were made here; none where it does not exist."""
    found = folder.iterdir() if folder.is_dir() else ()
    return [path for path in found if _OWN.fullmatch(path.name)]


def _remove(path: Path) -> None:
    """Remove a file, or a folder with all that is in it."""
    with suppress(FileNotFoundError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def clear() -> tuple[int, int]:
    """Remove all compiled code of this user: number of libraries, and bytes.

    Raises
    ------
    OSError
        If files cannot be removed.
    """
    count = size = 0
    for path in _own_files(cache_folder()):
        with suppress(FileNotFoundError):  # a compilation that ends meanwhile removes its files
            size += _size(path)
        count += path.suffix == ".so"
        _remove(path)
    return count, size


def _size(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    files = path.rglob("*") if path.is_dir() else (path,)
    return sum(file.lstat().st_size for file in files if not file.is_dir())


def contents() -> tuple[int, int]:
    """Number of libraries in the cache, and bytes."""
    sizes = [_size(path) for path in _own_files(cache_folder()) if path.suffix == ".so"]
    return len(sizes), sum(sizes)
