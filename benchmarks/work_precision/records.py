"""What a benchmark writes: one JSON file, from which plots and tables are made."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

SCHEMA = 1
OURS, FLOOR = "ours", "reduced"
"""Names of the two peers that are not counted among the other simulators."""
DIGITS = 5
"""Significant digits of the numbers in the file."""


@dataclass(frozen=True)
class Measurement:
    """One peer on one problem at one setting.

    ``error``: largest over the samples, lengths in m, angles in rad, rates over the problem's
    unit; ``drift``: largest closure error (m); ``energy``: largest change of energy (J).
    ``status``: ``ok``, ``failed`` (did not reach the end, or is not finite), ``over budget``.
    Times are of the repeats, without the first, untimed call.  All numbers None unless ``ok``.
    """

    problem: str
    peer: str
    variant: str
    kind: str
    setting: float
    status: str
    message: str = ""
    error: float | None = None
    drift: float | None = None
    energy: float | None = None
    evaluations: int | None = None
    steps: int | None = None
    cpu: dict[str, Any] | None = None
    wall: dict[str, Any] | None = None


@dataclass(frozen=True)
class Preparation:
    """Seconds to build a peer's model, and what its first call took more than the later ones."""

    problem: str
    peer: str
    build: float
    first_call: float | None


@dataclass(frozen=True)
class Skipped:
    """A peer that was left out, and why."""

    peer: str
    reason: str
    problem: str | None = None


@dataclass
class Results:
    """Everything of one run of the benchmark."""

    machine: dict[str, Any]
    versions: dict[str, Any]
    settings: dict[str, Any]
    problems: dict[str, Any] = field(default_factory=dict)
    peers: dict[str, str] = field(default_factory=dict)
    measurements: list[Measurement] = field(default_factory=list)
    preparations: list[Preparation] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)
    reliability: list[dict[str, Any]] = field(default_factory=list)
    unneeded: list[dict[str, Any]] = field(default_factory=list)
    scaling: dict[str, Any] = field(default_factory=dict)
    schema: int = SCHEMA

    def save(self, path: Path) -> None:
        """Write to ``path``; complete at any moment."""
        data = _plain(asdict(self))
        # A row per line: files stay small, and differences between two can be read.
        entries = [f"{json.dumps(key)}: {_rows(value)}" for key, value in data.items()]
        text = "{\n" + ",\n".join(entries) + "\n}"
        scratch = path.with_suffix(".part")
        scratch.write_text(text + "\n", encoding="utf-8")
        scratch.replace(path)


def load(path: Path) -> Results:
    """Results that :meth:`Results.save` wrote.

    Raises
    ------
    ValueError
        If the file has another schema.
    """
    data = json.loads(path.read_text(encoding="utf-8"))
    if data.get("schema") != SCHEMA:
        raise ValueError(f"{path} has schema {data.get('schema')!r}, this version reads {SCHEMA}")
    data["measurements"] = [Measurement(**row) for row in data["measurements"]]
    data["preparations"] = [Preparation(**row) for row in data["preparations"]]
    data["skipped"] = [Skipped(**row) for row in data["skipped"]]
    return Results(**data)


def _rows(value: Any) -> str:
    if isinstance(value, list) and value:
        lines = ",\n ".join(json.dumps(row, allow_nan=False) for row in value)
        return f"[\n {lines}\n]"
    return json.dumps(value, allow_nan=False)


def _plain(value: Any) -> Any:
    """``value`` with floats of DIGITS digits; those that JSON has not are None."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value
