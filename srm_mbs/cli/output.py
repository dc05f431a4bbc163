"""Output of commands: messages, tables, files and exit status; arguments that they share."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, ParamSpec, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo

from srm_mbs.errors import CHECK_WRITING, InputError, SrmError, SrmWarning

RUN_FAILED, BAD_INPUT = 1, 2
"""Exit status."""
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
Model = Annotated[
    str,
    typer.Argument(
        metavar="MODEL",
        help="A bundled mechanism (see 'srm-mbs models'), a .toml description, or a file of "
        "another format, recognised by its content (docs/formats.md).",
    ),
]
Html = Annotated[Path | None, option("FILE.html", "Write the animation as one page.")]
AllowOutside = Annotated[
    bool,
    typer.Option("--allow-outside", help="Let the file name meshes and other files anywhere."),
]
HTML_SUFFIXES = (".html", ".htm")


def say(kind: str, text: object) -> None:
    """One unwrapped line on standard error."""
    typer.echo(f"{kind}: {' '.join(str(text).split())}", err=True)


class Lines(logging.Handler):
    """Log records as lines like those of errors and warnings."""

    def emit(self, record: logging.LogRecord) -> None:
        say(record.levelname.lower(), record.getMessage())


def reported(command: Callable[Given, None]) -> Callable[Given, None]:
    """Decorator of commands: warnings and expected errors become single lines, errors exit with 2.

    Errors name an option as on the command line: ``--t-end``, not ``t_end``.
    """

    @wraps(command)
    def run(*args: Given.args, **kwargs: Given.kwargs) -> None:
        try:
            with _warnings_as_lines():
                command(*args, **kwargs)
        except BrokenPipeError:
            raise  # the reader of a pipe has ended: typer exits silently
        except SrmError as error:
            if isinstance(error, InputError) and error.element is not None:
                error.element = _as_written(error.element, command)
            say("error", error)
            raise typer.Exit(BAD_INPUT) from error
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            say("error", f"{where}{error.strerror or error}")
            raise typer.Exit(BAD_INPUT) from error

    return run


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        say("warning", message)

    with warnings.catch_warnings():
        warnings.simplefilter("always", SrmWarning)
        warnings.showwarning = show
        yield


def _as_written(element: str, command: Callable[..., None]) -> str:
    hint = get_type_hints(command, include_extras=True).get(element)
    for given in getattr(hint, "__metadata__", ()):
        if isinstance(given, OptionInfo):
            # Within Annotated the first argument of typer.Option is its name, if any is given.
            name = given.default
            return name if isinstance(name, str) else "--" + element.replace("_", "-")
        if isinstance(given, ArgumentInfo):
            return str(given.metavar)
    return element


def table(rows: Iterable[Iterable[str]], header: Iterable[str] = ()) -> None:
    """Aligned columns on standard output; wrapped on a terminal, never in a pipe."""
    from rich.console import Console
    from rich.table import Table

    names = tuple(header)
    grid = Table(*names, box=None, show_header=bool(names), pad_edge=False, padding=(0, 2, 0, 0))
    for row in rows:
        grid.add_row(*row)
    # No markup: "[0]" in a name is text.
    width = None if sys.stdout.isatty() else 10_000
    console = Console(width=width, markup=False, emoji=False, highlight=False)
    with console.capture() as captured:
        console.print(grid)
    # rich pads the last column with spaces.
    typer.echo("\n".join(line.rstrip() for line in captured.get().splitlines()))


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
        remedy = f"Use {' or '.join(suffixes)}"
    elif not folder.is_dir():
        problem, remedy = f"there is no folder {str(folder)!r}", "Make it first"
    elif path.is_dir():
        problem, remedy = "it is a folder", "Give a file name"
    elif not os.access(path if path.exists() else folder, os.W_OK):
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
                reason = error.strerror or error
                error = InputError(
                    f"it cannot be written: {reason}", file=str(path), remedy=CHECK_WRITING
                )
            say("error", f"{path}: {str(error).removeprefix(f'{path}: ')}")
            failed = True
        else:
            written.append(path)
    return written, failed


def say_written(path: Path) -> None:
    """Name a written file on standard output."""
    typer.echo(f"written: {path}")
