"""Columns of numbers from CSV files, found by their names."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, counted, known_names, naming
from srm_mbs.formats.files import check_name, open_regular, shortened
from srm_mbs.model.reach import Reach

LARGEST_TABLE = 10**9
"""Bytes of a CSV file."""
MOST_NUMBERS = 5 * 10**7
"""Cells of a table."""
MOST_COLUMNS = 1000
CHUNK = 4 * 10**6
"""Bytes of a table that are read at once; no line is longer."""
QUOTED_CHUNK = 10_000
"""Rows with quotes that are converted at once."""
_SEPARATE = "Separate columns by commas, and write decimal points"
GIVE_NUMBERS = "Give one finite number in every column"

FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")
"""Beginnings of cells that a spreadsheet computes or takes apart, full-width signs included."""


def text_cell(text: str) -> str:
    """``text`` as a cell that spreadsheets take as text: a formula begins with an apostrophe.

    A carriage return, which the csv module leaves unquoted, is escaped.
    """
    text = text.replace("\r", r"\r")
    return f"'{text}" if text.startswith(FORMULA) else text


def cell_text(cell: str) -> str:
    """The text that :func:`text_cell` wrote as ``cell``."""
    return cell[1:] if cell.startswith("'") and cell[1:].startswith(FORMULA) else cell


@dataclass(frozen=True)
class CsvTable:
    """The numbers of a CSV file: separated by commas, the first line naming the columns.

    Attributes
    ----------
    file
        Its path, for messages.
    names
        Of the columns.
    values : (n, k)
        The cells below the first line, without empty lines; nan where a cell is no number.
    faults
        Column -> the first of its rows whose cell is no number, from 0, and the reason; -1 stands
        for all columns.
    """

    file: str
    names: tuple[str, ...]
    values: FloatArray
    faults: dict[int, tuple[int, str]] = field(default_factory=dict)

    def columns(self, names: Sequence[str]) -> FloatArray:
        """The columns ``names`` (n, k), in that order.

        Raises
        ------
        InputError
            Naming the file, and the line or column that is wrong.
        """
        for name in names:
            if self.names.count(name) != 1:
                missing = name not in self.names
                raise InputError(
                    f"there is no column {name!r}" if missing else f"two columns {name!r}",
                    file=self.file,
                    element="first line",
                    remedy=_SEPARATE if ";" in "".join(self.names) else known_names(self.names),
                )
        wanted = [self.names.index(name) for name in names]
        wrong = [self.faults[k] for k in (-1, *wanted) if k in self.faults]
        if wrong:
            row, reason = min(wrong)
            raise InputError(
                f"row {row + 1} of the table is wrong: {reason}",
                file=self.file,
                remedy=GIVE_NUMBERS,
            )
        everything = wanted == list(range(len(self.names)))
        return self.values if everything else self.values[:, wanted]


def read_csv(path: Path) -> CsvTable:
    """The table in the file ``path``.

    Raises
    ------
    InputError
        If it cannot be read, or is too large.
    """
    with open_regular(path, LARGEST_TABLE) as stream, naming(file=str(path)):
        try:
            return _Reader(str(path)).table(stream)
        except UnicodeDecodeError as error:
            raise InputError(
                f"it is not UTF-8 text: {error.reason}",
                file=str(path),
                remedy="Save it as UTF-8",
            ) from error
        except (OSError, csv.Error) as error:
            raise InputError(
                f"the table cannot be read: {shortened(str(error))}",
                file=str(path),
                remedy="Give a CSV file of numbers",
            ) from error


class _Reader:
    """Converts the rows of one table, in blocks: those of numbers only by NumPy."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.names: tuple[str, ...] = ()
        # Grows where it is: a list of blocks and their concatenation would take twice the memory.
        self.numbers = bytearray()
        self.count = 0
        self.faults: dict[int, tuple[int, str]] = {}

    def table(self, stream: IO[bytes]) -> CsvTable:
        chunks = _chunks(stream, self.file)
        quoted: list[bytes] = []
        for chunk in chunks:
            if b'"' in chunk:  # a quoted cell may go on in the next chunk
                quoted = [chunk]
                break
            lines = chunk
            if not self.names:
                header, _, lines = lines.lstrip(b" \t,\n").partition(b"\n")
                self.header(next(csv.reader([header.decode("utf-8")]), []))
            if lines.strip() and not self.block_of_numbers(lines):
                self.rows(csv.reader(lines.decode("utf-8").split("\n")))
        if quoted:
            self.rows(csv.reader(_lines(chain(quoted, chunks))))
        found = np.frombuffer(self.numbers) if self.count else np.empty(0)
        values = found.reshape(self.count, len(self.names))
        return CsvTable(self.file, self.names, values, self.faults)

    def header(self, cells: Iterable[str]) -> None:
        self.names = tuple(cell_text(cell.strip()) for cell in cells)
        if len(self.names) > MOST_COLUMNS:
            raise self.fault(f"it has more than {MOST_COLUMNS} columns", "Give fewer columns")
        for name in self.names:
            check_name(name, "first line")

    def fault(self, problem: str, remedy: str) -> InputError:
        return InputError(problem, file=self.file, remedy=remedy)

    def block_of_numbers(self, lines: bytes) -> bool:
        """Read ``lines`` if every one of them has as many numbers as there are columns; whether
        that is so."""
        lines = lines.strip(b"\n")
        characters = np.frombuffer(lines, np.uint8)
        ends = np.flatnonzero(characters == ord("\n"))
        commas = np.flatnonzero(characters == ord(","))
        before = np.concatenate([[0], np.searchsorted(commas, ends), [len(commas)]])
        width = len(self.names)
        if (np.diff(before) != width - 1).any():
            return False
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of NumPy, about what is no number
            try:
                values = np.fromstring(lines.replace(b"\n", b",").decode("ascii"), sep=",")
            except (DeprecationWarning, ValueError):
                return False
        if len(values) != (len(ends) + 1) * width:
            return False
        self.append(values.reshape(-1, width))
        return True

    def append(self, block: FloatArray) -> None:
        self.numbers += block.tobytes()
        self.count += len(block)
        if self.count * len(self.names) > MOST_NUMBERS:
            raise self.fault(f"it has more than {MOST_NUMBERS} cells", "Leave out columns or rows")

    def rows(self, rows: Iterable[list[str]]) -> None:
        """Read rows of text, each of which may have cells that are no numbers."""
        block: list[list[float]] = []
        for cells in rows:
            if not any(cell.strip() for cell in cells):
                continue
            if not self.names:
                self.header(cells)
                continue
            block.append(self.row(cells, self.count + len(block)))
            if len(block) == QUOTED_CHUNK:
                self.append(np.array(block))
                block = []
        if block:
            self.append(np.array(block))

    def row(self, cells: list[str], at: int) -> list[float]:
        width = len(self.names)
        if len(cells) != width:
            reason = f"{counted(len(cells), 'value')}, {counted(width, 'column')}"
            self.faults.setdefault(-1, (at, reason))
            return [np.nan] * width
        out = []
        for k, cell in enumerate(cells):
            try:
                out.append(float(cell))
            except ValueError:
                self.faults.setdefault(k, (at, f"{shortened(cell)!r} is not a number"))
                out.append(np.nan)
        return out


def _chunks(stream: IO[bytes], file: str) -> Iterator[bytes]:
    """The content in pieces of whole lines that end in ``\\n``, without a byte order mark."""
    rest, first = b"", True
    while read := stream.read(CHUNK):
        if first:
            read, first = read.removeprefix(b"\xef\xbb\xbf"), False
        held = read.endswith(b"\r")  # of \r\n, perhaps
        whole = rest + (read[:-1] if held else read)
        whole = whole.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
        lines, end, rest = whole.rpartition(b"\n")
        if held:
            rest += b"\r"
        if len(rest) > CHUNK:
            raise InputError(
                f"a line has more than {CHUNK / 1e6:.0f} MB", file=file, remedy=GIVE_NUMBERS
            )
        if end:
            yield lines + end
    if rest:
        yield rest.replace(b"\r", b"\n") + b"\n"


def _lines(chunks: Iterable[bytes]) -> Iterator[str]:
    for chunk in chunks:
        for line in chunk.split(b"\n")[:-1]:
            yield line.decode("utf-8") + "\n"


class CsvFolder:
    """The CSV files that a description names, each read once.

    Parameters
    ----------
    folder
        Where relative paths begin.
    reach
        Where the files may lie.
    """

    def __init__(self, folder: Path, reach: Reach) -> None:
        self._folder, self._reach = folder, reach
        self._read: dict[str, CsvTable] = {}

    def table(self, name: str) -> CsvTable:
        """The table of the file ``name``; raises :class:`InputError` as :func:`read_csv` does, and
        if it is out of reach."""
        if name not in self._read:
            path = self._folder / name
            self._reach.find(name, self._folder, "table")
            self._read[name] = read_csv(path)
        return self._read[name]
