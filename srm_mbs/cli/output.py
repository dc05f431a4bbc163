"""Output of commands: messages, tables, files and exit status; arguments that they share."""

from __future__ import annotations

import io
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, ParamSpec, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo

from srm_mbs.errors import (
    AnalysisError,
    FailedRunWarning,
    InputError,
    SrmError,
    SrmWarning,
    get_logger,
    printable,
    unwritable,
)

log = get_logger(__name__)

RUN_FAILED, BAD_INPUT, FAULT, INTERRUPTED = 1, 2, 70, 130
"""Exit status; that of a fault of the package is EX_SOFTWARE of sysexits.h."""
REPORT_IT = "Report this fault of srm-mbs, with the output of --verbose"
"""Remedy for what no user can mend."""
Given = ParamSpec("Given")


def option(metavar: str, help: str, **more: Any) -> Any:
    """An option that takes a value; ``more`` are further arguments of ``typer.Option``."""
    return typer.Option(metavar=metavar, help=help, **more)


def several(name: str, metavar: str, help: str, **more: Any) -> Any:
    """An option that may be given several times, for a parameter of type ``list[str] | None``."""
    return typer.Option(name, metavar=metavar, help=f"{help} May be given several times.", **more)


Run = Annotated[
    Path, typer.Argument(metavar="RUN", help="A run saved with 'srm-mbs simulate --out'.")
]
Html = Annotated[Path | None, option("FILE.html", "Write the animation as one page.")]
AllowOutside = Annotated[
    bool,
    typer.Option("--allow-outside", help="Let the file name meshes and other files anywhere."),
]
HTML_SUFFIXES = (".html", ".htm")


def say(kind: str, text: object) -> None:
    """One unwrapped line on standard error."""
    echo(f"{kind}: {' '.join(str(text).split())}", err=True)


def echo(text: str, err: bool = False) -> None:
    """One line on standard output, or on standard error; what a terminal would act on is shown
    escaped."""
    typer.echo(printable(text), err=err)


def flush_output() -> None:
    """Write what is left for standard output; if nobody can take it, drop it without a word."""
    for stream in (sys.stdout, sys.stderr):
        if stream is None:  # closed before the program began
            continue
        try:
            stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, stream.fileno())
                os.close(nowhere)


class Lines(logging.Handler):
    """Log records as lines like those of errors and warnings."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.levelname.lower(), record.getMessage())


def reported(command: Callable[Given, None]) -> Callable[Given, None]:
    """Decorator of commands: warnings and expected errors become single lines; errors exit with 2,
    searches that find nothing with 1.

    Errors name an option as on the command line: ``--t-end``, not ``t_end``.
    """

    @wraps(command)
    def run(*args: Given.args, **kwargs: Given.kwargs) -> None:
        try:
            with _warnings_as_lines():
                command(*args, **kwargs)
        except BrokenPipeError:
            raise  # the reader of a pipe has ended: typer exits silently
        except KeyboardInterrupt as error:
            say("error", "interrupted")
            raise typer.Exit(INTERRUPTED) from error
        except SrmError as error:
            if isinstance(error, InputError) and error.element is not None:
                error.element = _as_written(error, error.element, command)
            say("error", error)
            raise typer.Exit(
                RUN_FAILED if isinstance(error, AnalysisError) else BAD_INPUT
            ) from error
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            say("error", f"{where}{error.strerror or error}")
            raise typer.Exit(BAD_INPUT) from error
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:  # a fault of the package; --verbose shows where
            for line in traceback.format_exception(error):
                log.debug("%s", line)
            say("error", f"unexpected {type(error).__name__}: {error}. {REPORT_IT}")
            raise typer.Exit(FAULT) from error

    return run


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        say("warning", message)

    with warnings.catch_warnings():
        warnings.simplefilter("always", SrmWarning)
        warnings.simplefilter("ignore", FailedRunWarning)  # commands say how a run ended
        warnings.showwarning = show
        yield


OPTIONS_OF = {
    "q": ("hold",),
    "initial.q": ("q", "hold"),
    "initial.v": ("v",),
    "inputs": ("actuated",),
    "coordinates": ("coordinate",),
    "actuators": ("control",),
}
"""Parameters of commands whose values arrive in the element of an error, unless a file gave it."""


def _as_written(error: InputError, element: str, command: Callable[..., None]) -> str:
    """``element`` of ``error`` by the name of its option or argument of ``command``."""
    hints = get_type_hints(command, include_extras=True)
    names = (element, *(OPTIONS_OF.get(element, ()) if error.file is None else ()))
    hint = next((hints[name] for name in names if name in hints), None)
    for given in getattr(hint, "__metadata__", ()):
        if isinstance(given, OptionInfo):
            # Within Annotated the first argument of typer.Option is its name, if any is given.
            name = given.default
            return name if isinstance(name, str) else "--" + element.replace("_", "-")
        if isinstance(given, ArgumentInfo):
            return str(given.metavar)
    return element


def table(rows: Iterable[Iterable[str]], header: Sequence[str] = (), err: bool = False) -> None:
    """Aligned columns on standard output, or on standard error; wrapped on a terminal, never in a
    pipe."""
    from rich.console import Console
    from rich.table import Table

    names = map(printable, header)
    grid = Table(*names, box=None, show_header=bool(header), pad_edge=False, padding=(0, 2, 0, 0))
    for row in rows:
        grid.add_row(*map(printable, row))
    # No markup: "[0]" in a name is text.
    stream = sys.stderr if err else sys.stdout
    width = None if stream is not None and stream.isatty() else 10_000
    console = Console(width=width, markup=False, emoji=False, highlight=False)
    with console.capture() as captured:
        console.print(grid)
    # rich pads the last column with spaces.
    typer.echo("\n".join(line.rstrip() for line in captured.get().splitlines()), err=err)


class PrintedLines(io.TextIOBase):
    """A text file whose lines are printed by :func:`echo`."""

    def write(self, text: str) -> int:
        """Print ``text``, which ends with the end of a line."""
        echo(text.removesuffix("\n"))
        return len(text)


# -- output files -----------------------------------------------------------------------------


def check_output(path: Path | None, option: str, suffixes: tuple[str, ...]) -> None:
    """Refuse a file that cannot be written, before a long run; None is no file.

    Raises
    ------
    InputError
        If its suffix is not one of ``suffixes``, or it cannot be written.
    """
    if path is None:
        return
    problem = remedy = ""
    folder = path.parent
    if path.suffix.lower() not in suffixes:
        problem = f"the suffix {path.suffix!r} is not known here"
        *others, last = suffixes
        remedy = f"Use {', '.join(others)} or {last}" if others else f"Use {last}"
    elif not folder.is_dir():
        problem, remedy = f"there is no folder {str(folder)!r}", "Make it first"
    elif path.is_dir():
        problem, remedy = "it is a folder", "Give a file name"
    elif not (os.access(folder, os.W_OK) and (os.access(path, os.W_OK) or not path.exists())):
        problem, remedy = "it cannot be written", "Check its permissions"
    if problem:
        raise InputError(problem, file=str(path), element=option, remedy=remedy)


def write_files(
    files: Iterable[tuple[Path | None, Callable[[Path], object]]],
) -> tuple[list[Path], bool]:
    """Write each file whose path is not None, also after the failure of another one.

    Returns
    -------
    (written, failed)
        Paths of the written files, and whether a file could not be written, which is reported.
    """
    written, failed = [], False
    for path, write in files:
        if path is None:
            continue
        try:
            write(path)
        except (OSError, SrmError) as error:
            if isinstance(error, OSError):
                error = unwritable(path, error)
            say("error", f"{path}: {str(error).removeprefix(f'{path}: ')}")
            failed = True
        else:
            written.append(path)
    return written, failed


def say_written(path: Path) -> None:
    """Name a written file on standard output."""
    echo(f"written: {path}")
