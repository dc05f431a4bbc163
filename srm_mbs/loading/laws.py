"""Laws as descriptions write them: a type, and the keys of that type."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from srm_mbs.csv_tables import read_table, table_columns
from srm_mbs.errors import InputError
from srm_mbs.laws import LAW_TYPES, Law, Polynomial, Table

TABLE_KEYS = ("table", "time", "value")
"""Keys of a table in a file: its path, and the names of its columns, by default t and value."""
LAW_KEYS = (
    "type",
    *dict.fromkeys(key.name for kind in LAW_TYPES.values() for key in fields(kind)),  # type: ignore[arg-type]
    *TABLE_KEYS,
)
"""All keys that laws have."""


def law_from(entry: Mapping[str, Any], folder: Path) -> Law:
    """The law of ``entry``, keys and their values, None for those that are not given; a table is
    read from ``folder``.

    Raises
    ------
    InputError
        For an unknown type, a key that the type needs or does not take, or a malformed table.
    """
    kind = LAW_TYPES.get(entry["type"])
    if kind is None:
        raise InputError(
            f"there is no law of type {entry['type']!r}",
            remedy=f"Known: {', '.join(LAW_TYPES)}",
        )
    given = {key: entry[key] for key in LAW_KEYS[1:] if entry[key] is not None}
    keys = fields(kind)  # type: ignore[arg-type]
    accepted = [*(key.name for key in keys), *(TABLE_KEYS if kind is Table else ())]
    for key in given:
        if key not in accepted:
            raise InputError(
                f"a law of type {kind.type!r} takes no {key}",
                remedy=f"Known: {', '.join(accepted)}",
            )
    if kind is Table and "table" in given:
        if "t" in given or "values" in given:
            raise InputError(
                "the values are given twice", remedy="Give table, or t and values, not both"
            )
        columns = (given.get("time", "t"), given.get("value", "value"))
        t, values = read_table(folder / given["table"], columns).T.tolist()
        return Table(t, values)
    for key in TABLE_KEYS[1:]:
        if key in given:
            raise InputError(
                f"{key} names a column, but there is no table", remedy='Give table = "file.csv"'
            )
    missing = [key.name for key in keys if key.default is MISSING and key.name not in given]
    if missing:
        raise InputError(
            f"a law of type {kind.type!r} needs {' and '.join(missing)}",
            remedy='Give them, or table = "file.csv"' if kind is Table else "Add it",
        )
    return kind(**given)


COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
"""Columns of the table of a wrench; those that are not there are zero."""


def with_law(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The keys of a torque or wrench with its law made, in place of ``table``, ``time`` and
    ``value``.

    Raises
    ------
    InputError
        If law and table are both given, neither of them nor a torque, or a table is malformed.
    """
    out = {key: value for key, value in values.items() if key not in TABLE_KEYS}
    table, time = values.get("table"), values.get("time")
    named = [key for key in TABLE_KEYS[1:] if values.get(key) is not None]
    if values["law"] is not None:
        if table is not None or named:
            raise InputError("law and table are given", remedy="Give one of them")
        out["law"] = law_from(values["law"], folder)
    elif table is None:
        if named:
            raise InputError(
                f"{named[0]} names a column, but there is no table",
                remedy='Give table = "file.csv"',
            )
        if values["type"] == "torque" and values["torque"] is None:
            raise InputError("there is no torque", remedy="Give torque, law or table")
    elif values["type"] == "torque":
        columns = (time or "t", values["value"] or "value")
        out["law"] = Table(*read_table(folder / table, columns).T.tolist())
    else:
        there = [name for name in COMPONENTS if name in table_columns(folder / table)]
        if not there:
            raise InputError(
                f"the table has none of the columns {', '.join(COMPONENTS)}",
                file=str(folder / table),
                remedy="Name the columns of force and moment in the first line",
            )
        t, *columns_read = read_table(folder / table, (time or "t", *there)).T.tolist()
        laws = {name: Table(t, column) for name, column in zip(there, columns_read)}
        out["law"] = tuple(laws.get(name, Polynomial([0.0])) for name in COMPONENTS)
    return out
