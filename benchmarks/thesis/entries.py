"""What is written about one table or figure: the printed values, ours, and why they differ."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

PRINTED: Mapping[str, Any] = json.loads(
    (Path(__file__).parent / "printed.json").read_text(encoding="utf-8")
)
"""Values printed in the thesis, by key."""

TABLES = tuple(f"table5.{k}" for k in range(1, 8))
FIGURES = ("figure1.3", *(f"figure5.{k}" for k in range(1, 17)))
KEYS = TABLES + FIGURES
"""Every table and figure that is regenerated."""

Rows = Mapping[str, Mapping[str, Any]]
"""row -> column -> value."""


@dataclass(frozen=True)
class Entry:
    """One table or figure.

    Attributes
    ----------
    key
        One of :data:`KEYS`; its PNG is ``<key>.png``.
    title
        What it shows.
    setup
        Problem, method and parameters, with those that the thesis does not print.
    printed, ours
        Values of the same shape where both exist.
    difference
        Where they differ, and why.
    """

    key: str
    title: str
    setup: str
    printed: Any
    ours: Any
    difference: str

    @property
    def slopes(self) -> bool:
        """Whether a figure draws the errors behind a table of slopes."""
        return "slopes_of" in PRINTED[self.key]

    @property
    def png(self) -> str:
        """File name of its picture."""
        return f"{self.key}.png"


def write(entries: list[Entry], path: Path) -> None:
    """The entries as JSON: key -> the other attributes."""
    record = {}
    for entry in sorted(entries, key=lambda entry: KEYS.index(entry.key)):
        values = asdict(entry) | {"png": entry.png}
        record[values.pop("key")] = values
    path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
