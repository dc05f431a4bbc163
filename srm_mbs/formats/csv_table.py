"""Columns of numbers from CSV files, found by their names."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError

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
    """The cells of a CSV file: numbers separated by commas, the first line naming the columns.

    Attributes
    ----------
    file
        Its path, for messages.
    names
        Of the columns.
    rows
        The cells below the first line; empty lines are left out.
    """

    file: str
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

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
                    remedy=f"Known: {', '.join(self.names) or 'none'}",
                )
        wanted = [self.names.index(name) for name in names]
        out = np.empty((len(self.rows), len(wanted)))
        for i, row in enumerate(self.rows):
            try:
                if len(row) != len(self.names):
                    raise ValueError(f"{len(row)} values, {len(self.names)} columns")
                out[i] = [float(row[k]) for k in wanted]
            except ValueError as error:
                raise InputError(
                    f"row {i + 1} of the table is wrong: {error}",
                    file=self.file,
                    remedy="Give one finite number in every column",
                ) from error
        return out


def read_csv(path: Path) -> CsvTable:
    """The table in the file ``path``.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            cells = [tuple(row) for row in csv.reader(stream) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise InputError(
            f"the table cannot be read: {error}",
            file=str(path),
            remedy="Give a CSV file of numbers",
        ) from error
    header, *rows = cells or [()]
    return CsvTable(str(path), tuple(cell_text(cell.strip()) for cell in header), tuple(rows))


class CsvFolder:
    """The CSV files that a description names, each read once.

    Parameters
    ----------
    folder
        Where relative paths begin.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[Path, CsvTable] = {}

    def table(self, name: str) -> CsvTable:
        """The table of the file ``name``; raises :class:`InputError` as :func:`read_csv` does."""
        path = self._folder / name
        if path not in self._read:
            self._read[path] = read_csv(path)
        return self._read[path]
