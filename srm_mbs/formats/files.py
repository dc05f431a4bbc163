"""Files of strangers read within bounds, and files written whole or not at all.

Every text and binary file that a user names is read here, and every file that the package writes is
written here.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import IO

from srm_mbs.errors import InputError, missing_folder

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LARGEST_FILE = 64 * 10**6
"""Bytes of a file that is read, unless the caller allows more."""
LONGEST_SUFFIX = 12
"""Characters of a suffix that the name of a temporary file keeps: programs choose formats by it."""

_TEMPORARY = re.compile(r"\.srm-[0-9a-f]{16}(?:\..*)?")
"""Names of temporary files."""

# Without O_NONBLOCK, opening a pipe waits for somebody to write; O_BINARY is of Windows.
_READING = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def open_regular(
    path: str | os.PathLike[str], largest: int = LARGEST_FILE, missing: str = "Check the path"
) -> IO[bytes]:
    """``path`` opened for reading in binary mode.

    Parameters
    ----------
    largest
        Size (bytes) of a file that is not refused.
    missing
        Remedy if there is no such file.

    Raises
    ------
    InputError
        If the file cannot be opened, is a directory, device, pipe or socket, or is larger.
    """
    name = os.fspath(path)
    try:
        opened = os.open(name, _READING)
    except FileNotFoundError as error:
        raise InputError("there is no such file", file=name, remedy=missing) from error
    except OSError as error:
        raise InputError(
            f"it cannot be read: {error.strerror}",
            file=name,
            remedy="Give the path of a readable file",
        ) from error
    except ValueError as error:  # a null character
        raise InputError(
            f"it is not a file name: {error}", file=repr(name), remedy="Correct the path"
        ) from error
    status = os.fstat(opened)
    if not stat.S_ISREG(status.st_mode):
        os.close(opened)
        kind = "a directory" if stat.S_ISDIR(status.st_mode) else "no regular file"
        raise InputError(f"it is {kind}", file=name, remedy="Give a file")
    if status.st_size > largest:
        os.close(opened)
        raise InputError(
            f"it has {status.st_size / 1e6:.0f} MB, more than {largest / 1e6:.0f} MB",
            file=name,
            remedy="Give a smaller file",
        )
    return os.fdopen(opened, "rb")


def read_bytes(path: str | os.PathLike[str], largest: int = LARGEST_FILE) -> bytes:
    """The content of the regular file ``path``; raises :class:`InputError` as
    :func:`open_regular` does."""
    with open_regular(path, largest) as file:
        content = file.read(largest + 1)
    if len(content) > largest:  # it grows, or its file system does not tell its size
        raise InputError(
            f"it has more than {largest / 1e6:.0f} MB",
            file=os.fspath(path),
            remedy="Give a smaller file",
        )
    return content


def read_text(path: str | os.PathLike[str]) -> str:
    """The UTF-8 text of the regular file ``path``, without a byte order mark, with ``\\n`` at the
    ends of lines.

    Raises
    ------
    InputError
        As :func:`open_regular`, or if the content is not UTF-8.
    """
    content = read_bytes(path)
    try:
        text = content.decode("utf-8-sig")  # Windows editors mark it
    except UnicodeDecodeError as error:
        raise InputError(
            f"it is not UTF-8 text: {error.reason} at byte {error.start}",
            file=os.fspath(path),
            remedy="Save it as UTF-8",
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


LONGEST_QUOTE = 60
"""Characters of a file that a message quotes."""
LONGEST_NAME = 1000
"""Characters of the name of a link, joint, closure ... or file."""


def shortened(text: str) -> str:
    """``text`` for a message: on one line, and at most :data:`LONGEST_QUOTE` characters of it."""
    text = " ".join(text[: 4 * LONGEST_QUOTE].split())
    return text if len(text) <= LONGEST_QUOTE else text[: LONGEST_QUOTE - 3] + "..."


def check_name(text: str, where: str) -> None:
    """Refuse the name ``text`` of the element ``where`` if it is longer than
    :data:`LONGEST_NAME`, or has characters that do not print.

    Raises
    ------
    InputError
        If it is.
    """
    if len(text) <= LONGEST_NAME and text.isprintable():
        return
    long = len(text) > LONGEST_NAME
    raise InputError(
        f"the name {shortened(text)!r} has {len(text)} characters"
        if long
        else f"the name {shortened(text)!r} has characters that do not print",
        element=where,
        remedy=f"Give at most {LONGEST_NAME} printable characters",
    )


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path in the folder of ``path``, with its suffix; the file written there takes
    the place of ``path`` at the end of a ``with`` block that raises nothing.

    Until then ``path`` is what it was, whatever interrupts the program.  A device or a pipe is
    written to as it is.  The temporary file is locked while it is written, where locks of files
    exist (``flock``); those that killed programs left in the folder, which nobody holds, are
    removed.

    Raises
    ------
    InputError
        If ``path`` is not a file name.
    OSError
        If the file cannot be written, is write-protected, or nothing was written; it names
        ``path``.
    """
    path = checked_path(path)
    target = Path(os.path.realpath(path))  # a link stays a link
    if target.exists() and not target.is_file():
        yield target
        return
    if target.exists() and not os.access(target, os.W_OK):
        # Replacing it needs permissions of the folder only.
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))
    temporary: Path | None = None
    held: int | None = None
    try:
        while temporary is None:
            # Known before it exists: Ctrl-C may come at any moment.
            temporary = _beside(target)
            if fcntl is not None:
                held = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
                if not _is_locked(held):
                    os.close(held)
                    temporary = held = None
        _remove_abandoned(target.parent)
        yield temporary
        _finish(temporary, target)
    except OSError as error:
        raise _about(error, path, temporary) from error
    finally:
        # In this order: others may remove what nobody holds.
        if temporary is not None:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        if held is not None:
            os.close(held)


def _beside(target: Path) -> Path:
    """The path of a temporary file in the folder of ``target``."""
    suffix = target.suffix if len(target.suffix) <= LONGEST_SUFFIX else ""
    return target.with_name(f".srm-{secrets.token_hex(8)}{suffix}")


def _is_locked(opened: int) -> bool:
    """Lock a temporary file; False if another writer took it for abandoned before that."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # not every file system can
        return True
    return os.fstat(opened).st_nlink > 0


def _remove_abandoned(folder: Path) -> None:
    """Remove the temporary files in ``folder`` that no writer holds: those of killed programs."""
    if fcntl is None:
        return
    with suppress(OSError):  # the folder cannot be listed
        for path in [folder / name for name in os.listdir(folder) if _TEMPORARY.fullmatch(name)]:
            with suppress(OSError):  # held, removed by another writer, or somebody else's
                opened = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_NOFOLLOW)
                try:
                    fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if stat.S_ISREG(os.fstat(opened).st_mode):
                        path.unlink()
                finally:
                    os.close(opened)


def _finish(temporary: Path, target: Path) -> None:
    """Put the written file onto the disk, then in the place of ``target``."""
    with suppress(OSError):  # a new file has the mode that open() gives it
        temporary.chmod(stat.S_IMODE(target.stat().st_mode))
    with temporary.open("rb+") as file:
        if not os.fstat(file.fileno()).st_size:  # the program that was to write it did not
            raise OSError(errno.EIO, "nothing was written")
        os.fsync(file.fileno())
    os.replace(temporary, target)
    if os.name == "posix":
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            with suppress(OSError):  # not every file system can
                os.fsync(folder)
        finally:
            os.close(folder)


def _about(error: OSError, path: str | os.PathLike[str], temporary: Path | None) -> OSError:
    """``error``, naming ``path`` in place of the temporary file, and a folder that is missing."""
    made = temporary is not None
    if error.errno is None or (made and error.filename not in (None, str(temporary), temporary)):
        return error
    missing = missing_folder(path)
    reason = error.strerror or os.strerror(error.errno)
    return OSError(error.errno, ". ".join(missing) if missing else reason, os.fspath(path))


@contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """A binary file that becomes ``path`` at the end; see :func:`whole_file`."""
    with whole_file(path) as temporary, temporary.open("wb") as file:
        yield file


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write ``content``; see :func:`whole_file`."""
    with writing(path) as file:
        file.write(content)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write ``text`` as UTF-8, lone surrogates escaped; see :func:`whole_file`."""
    write_bytes(path, utf8(text))


def write_texts(texts: Mapping[Path, str]) -> None:
    """Write several files, path -> text, of which none is replaced before all are on the disk.

    They are replaced in the order given; see :func:`whole_file`.
    """
    with ExitStack() as stack:
        for path, text in reversed(list(texts.items())):  # the first is replaced first
            temporary = stack.enter_context(whole_file(path))
            with temporary.open("wb") as file:
                file.write(utf8(text))
                file.flush()
                if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                    os.fsync(file.fileno())


def utf8(text: str) -> bytes:
    """``text`` in UTF-8; a lone surrogate, which UTF-8 has no code for, as ``\\udc80``."""
    return text.encode("utf-8", "backslashreplace")


def checked_path(path: object, element: str = "path") -> Path:
    """``path`` as a path.

    Raises
    ------
    InputError
        If it is not a string or a path, is empty, or contains a null character; it names the
        argument ``element``.
    """
    try:
        name = os.fspath(path)  # type: ignore[call-overload]
        if isinstance(name, str):
            name = str.__str__(name)  # a subclass formats itself as it likes
        os.fsencode(name)  # lone surrogates have no bytes
    except UnicodeEncodeError as error:
        raise InputError(
            f"{name!r} is not a file name", element=element, remedy="Give the path of a file"
        ) from error
    except Exception as error:  # objects may raise anything
        raise InputError(
            f"{type(path).__name__} is not a type of paths",
            element=element,
            remedy="Give a string or a pathlib.Path",
        ) from error
    if not isinstance(name, str) or not name or "\0" in name:
        raise InputError(
            f"{name!r} is not a file name", element=element, remedy="Give the path of a file"
        )
    return Path(name)


def file_name(path: str) -> str:
    """The last part of a path of any operating system."""
    return re.split(r"[\\/]", path)[-1]
