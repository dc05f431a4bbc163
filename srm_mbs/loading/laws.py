"""Laws as descriptions write them: a type, and the keys of that type."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from srm_mbs.errors import InputError
from srm_mbs.laws import LAW_TYPES, Law, Table, read_table

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
            remedy=f"This version knows {', '.join(LAW_TYPES)}",
        )
    given = {key: entry[key] for key in LAW_KEYS[1:] if entry[key] is not None}
    keys = fields(kind)  # type: ignore[arg-type]
    accepted = [*(key.name for key in keys), *(TABLE_KEYS if kind is Table else ())]
    for key in given:
        if key not in accepted:
            raise InputError(
                f"a law of type {kind.type!r} takes no {key}",
                remedy=f"It takes {', '.join(accepted)}",
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
