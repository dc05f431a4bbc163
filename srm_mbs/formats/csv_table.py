"""Columns of numbers from CSV files, found by their names."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError


def _cells(path: Path) -> list[list[str]]:
    """Lines of a CSV file that are not empty, the header first."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = [row for row in csv.reader(stream) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        raise InputError(
            f"the table cannot be read: {error}",
            file=str(path),
            remedy="Give a CSV file of numbers",
        ) from error
    return rows or [[]]


def table_columns(path: Path) -> tuple[str, ...]:
    """Names of the columns of a CSV file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    return tuple(cell.strip() for cell in _cells(path)[0])


def read_table(path: Path, columns: Sequence[str]) -> FloatArray:
    """Columns (n, k) of a CSV file with a header line.

    Parameters
    ----------
    path
        The file: numbers separated by commas, the first line naming the columns.
    columns
        Names of the wanted columns, in that order.

    Raises
    ------
    InputError
        Naming the file, and the line or column that is wrong.
    """
    file = str(path)
    rows = _cells(path)
    header = [cell.strip() for cell in rows[0]]
    for name in columns:
        if header.count(name) != 1:
            raise InputError(
                f"there is no column {name!r}" if name not in header else f"two columns {name!r}",
                file=file,
                element="first line",
                remedy=f"Known: {', '.join(header) or 'none'}",
            )
    wanted = [header.index(name) for name in columns]
    out = np.empty((len(rows) - 1, len(wanted)))
    for i, row in enumerate(rows[1:]):
        try:
            if len(row) != len(header):
                raise ValueError(f"{len(row)} values, {len(header)} columns")
            out[i] = [float(row[k]) for k in wanted]
        except ValueError as error:
            raise InputError(
                f"row {i + 1} of the table is wrong: {error}",
                file=file,
                remedy="Give one finite number in every column",
            ) from error
    return out
