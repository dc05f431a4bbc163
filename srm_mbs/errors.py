"""Exceptions and warnings of the package.

Every exception carries the data that failed, so that a program can react to it without
parsing the text.  Bad input raises :class:`InputError` before any stepping; a run that
cannot go on returns a partial :class:`~srm_mbs.Solution` and raises
:class:`SimulationError` only on request.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import unicodedata
import warnings
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

__version__ = "0.1.0"
"""Version of the package; the ground layer holds it, so that every layer can name it."""

CHECK_WRITING = "Check the folder, its permissions and the space on the disk"
"""Remedy for a file that cannot be written."""

LONGEST_SHOWN = 300
"""Characters of the representation of a value that a message shows."""
MOST_LISTED = 24
"""Names that a message lists: those of the keys of any table or element, not of a large model."""

_PRINTABLE_ASCII = re.compile(r"[\x20-\x7e]*")
_ESCAPED = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Unicode categories: control, format (bidirectional overrides among them), surrogate, line and
paragraph separator."""
_SHORT = {"\t": r"\t", "\n": r"\n", "\r": r"\r"}


def safe_repr(value: object) -> str:
    """The representation of ``value`` for a message, of at most LONGEST_SHOWN characters.

    It exists for every value: the representation of an object may raise anything, and Python
    writes no integer of more than 4300 digits.
    """
    try:
        text = str.__str__(repr(value))
    except Exception:
        return f"<{type(value).__name__} without representation>"
    return text if len(text) <= LONGEST_SHOWN else f"{text[: LONGEST_SHOWN - 3]}..."


def raised(name: str, error: BaseException, when: str = "") -> str:
    """The clause that the function ``name`` of the user raised ``error``, ``when`` ("at t = 1 s"),
    with the last line of the function's own file that ran, if any did.

    The file is named without its folder, because messages are saved with runs.
    """
    clause = f"{name} raised {safe_repr(error)}{when and f' {when}'}"
    package = os.path.dirname(__file__) + os.sep
    place, own = "", None
    trace = error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if own is None and not code.co_filename.startswith(package):
            own = code.co_filename
        if code.co_filename == own:
            file = os.path.basename(code.co_filename)
            place = f", in {code.co_name!r} ({file}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return clause + place


def printable(text: object, keep: str = "") -> str:
    """``text`` with characters that a terminal would act on shown as in Python's strings.

    Names and texts of foreign files contain them: ``\\x1b`` begins commands of terminals, and
    ``\\u202e`` reverses what follows.  A backslash stays one, so that nothing is escaped twice.

    Parameters
    ----------
    keep
        Characters that stay as they are, such as the ends of lines.
    """
    try:
        words = str.__str__(str(text))  # a subclass of str formats itself as it likes
    except Exception:  # of the text of an exception, for example
        words = safe_repr(text)
    if _PRINTABLE_ASCII.fullmatch(words):
        return words
    return "".join(
        character
        if character in keep or unicodedata.category(character) not in _ESCAPED
        else _SHORT.get(character) or character.encode("unicode_escape").decode("ascii")
        for character in words
    )


Values = TypeVar("Values")


class KnownKeys(dict[str, Values]):
    """A table by name whose :class:`KeyError` lists the names that there are."""

    def __missing__(self, key: object) -> Values:
        raise KeyError(f"there is no {safe_repr(key)}. {known_names(self)}")


def known_names(names: Iterable[str]) -> str:
    """The remedy that lists ``names``: the first MOST_LISTED, and how many more there are."""
    return f"Known: {joined_names(names)}"


def joined_names(names: Iterable[str]) -> str:
    """The first MOST_LISTED of ``names``, and how many more there are; "none" without any."""
    every = tuple(names)
    more = len(every) - MOST_LISTED
    listed = ", ".join(every[:MOST_LISTED]) or "none"
    return f"{listed} and {more} more" if more > 0 else listed


def time_text(t: float) -> str:
    """A time (s) for a message: six digits, and of 1000 s and more three after the point."""
    return f"{t:.6g}" if abs(t) < 1000.0 else f"{round(t, 3):.15g}"


def counted(count: int, noun: str) -> str:
    """``1 degree``, ``2 degrees``: a ``noun`` with a regular plural."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


class _Printable(logging.Filter):
    """Escapes the texts of log records, as :func:`printable` does."""

    def filter(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        shown = printable(text)
        if shown != text:
            record.msg, record.args = shown, ()
        return True


def get_logger(name: str) -> logging.Logger:
    """The logger ``name``; control characters in its messages are shown escaped."""
    logger = logging.getLogger(name)
    if not any(isinstance(known, _Printable) for known in logger.filters):
        logger.addFilter(_Printable())
    return logger


class SrmError(Exception):
    """Base class of everything that this package raises on purpose.

    Its text shows control characters of names escaped (:func:`printable`).
    """

    def __str__(self) -> str:
        return printable(super().__str__(), keep="\n")

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies, also in other processes, have the attributes; nothing is constructed again."""
        return _unconstructed, (type(self), self.args), self.__dict__


def _unconstructed(kind: type[SrmError], arguments: tuple[Any, ...]) -> SrmError:
    return kind.__new__(kind, *arguments)


class InputError(SrmError, ValueError):
    """Bad input: what is wrong, where, and what to do about it.

    Parameters
    ----------
    problem
        What is wrong: a clause that begins in lower case, without a final full stop.
    file, element
        The file and the element in it (a TOML key path, a URDF element, an argument) at fault.
    remedy
        What the reader can do: an imperative, or ``Known: `` and the names that there are, without
        a final full stop.
    """

    def __init__(
        self,
        problem: str,
        *,
        remedy: str,
        file: str | None = None,
        element: str | None = None,
    ) -> None:
        self.problem = problem
        self.file = file
        self.element = element
        self.remedy = remedy
        super().__init__(problem)

    def __str__(self) -> str:
        where = ": ".join(printable(part) for part in (self.file, self.element) if part)
        text = f"{where}: {self.problem}" if where else self.problem
        return printable(f"{text}. {self.remedy}", keep="\n")

    def located(self, file: str) -> InputError:
        """The same error with ``file`` filled in where it was unknown (the object itself)."""
        if self.file is None:
            self.file = file
        return self


def missing_folder(path: str | os.PathLike[str]) -> tuple[str, str] | None:
    """The problem and its remedy where the folder of a file ``path`` to write does not exist."""
    given, folder = os.path.dirname(path), os.path.dirname(os.path.realpath(path))
    if os.path.exists(folder):
        return None
    named = folder if os.path.exists(given) else given  # a link may lead there
    return f"there is no folder {os.fspath(named)!r}", "Make it first"


def unwritable(path: str | os.PathLike[str], error: OSError) -> InputError:
    """The error about a file or folder ``path`` that the system does not let be written."""
    otherwise = (f"it cannot be written: {error.strerror or error}", CHECK_WRITING)
    problem, remedy = missing_folder(path) or otherwise
    return InputError(problem, file=os.fspath(path), remedy=remedy)


class naming:  # noqa: N801 - used as a function
    """Fill ``file`` and ``element`` into an :class:`InputError` that names none; a context manager,
    which a variant enters a dozen times."""

    __slots__ = ("_element", "_file")

    def __init__(self, *, file: str | None = None, element: str | None = None) -> None:
        self._file, self._element = file, element

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, InputError):
            error.file = error.file or self._file
            error.element = error.element or self._element


class AssemblyError(InputError):
    """The loops cannot be closed, or the held values or rates contradict each other.

    Attributes
    ----------
    residuals
        Gap of each loop, by name: (m or None, rad or None), at the closest configuration.
    q
        The closest configuration found, shape (nq,).
    held
        Names of the held joints that are to blame, where that could be found out.
    nearest
        Positions (rad, m) of such joints that close the loops, the others as they are: nearest to
        the given ones on the branch that was found.
    limits
        Names of the joints whose limits are in the way.
    """

    def __init__(
        self,
        problem: str,
        *,
        residuals: Mapping[str, tuple[float | None, float | None]],
        q: Any,
        held: tuple[str, ...] = (),
        nearest: Mapping[str, float] | None = None,
        limits: tuple[str, ...] = (),
        **where: Any,
    ) -> None:
        super().__init__(problem, **where)
        self.residuals = dict(residuals)
        self.q = q
        self.held = held
        self.nearest = dict(nearest or {})
        self.limits = limits


class AnalysisError(SrmError, RuntimeError):
    """An equilibrium or a path was not found; ``q`` (nq,) is how far the search came."""

    def __init__(self, problem: str, *, q: Any, remedy: str) -> None:
        super().__init__(f"{problem}. {remedy}")
        self.q = q


class EvaluationError(SrmError, ArithmeticError):
    """The equations of motion could not be evaluated at one Runge-Kutta stage."""


class FunctionError(SrmError):
    """A function of the user cannot be used: it raised, or returned something else than it must.

    Attributes
    ----------
    t
        Time (s) of the call; None if it was not one of a controller, force or event at a state.
    """

    def __init__(self, problem: str, t: float | None = None) -> None:
        super().__init__(problem)
        self.t = t


class ControllerError(FunctionError):
    """The user's controller raised, or returned something that is not a finite (nv,) vector."""


class CallbackError(ControllerError):
    """A function of a DAE raised, or returned another shape."""


class EventError(FunctionError):
    """An event function raised, or returned something that is not one finite number."""


class SimulationError(SrmError, RuntimeError):
    """A run failed and the caller asked for an exception.

    Attributes
    ----------
    solution
        The :class:`srm_mbs.Solution` or :class:`srm_mbs.DaeSolution` up to the failure; None for a
        :class:`srm_mbs.Simulator`, which records nothing.
    """

    def __init__(self, message: str, solution: Any) -> None:
        super().__init__(message)
        self.solution = solution


class SrmWarning(UserWarning):
    """A setting was changed to a safe value, or the input is unusual but usable."""

    def __str__(self) -> str:
        return printable(super().__str__(), keep="\n")


class FailedRunWarning(SrmWarning):
    """A run failed before its end; its result holds what was computed so far."""


def warn(message: str, category: type[SrmWarning] = SrmWarning) -> None:
    """Issue a warning of ``category`` that points at the first caller outside the package."""
    package = os.path.dirname(__file__)
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(package):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
