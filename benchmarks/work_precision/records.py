"""What a benchmark writes: one JSON file, from which plots and tables are made."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

SCHEMA = 1
OURS, FLOOR, TAYLOR = "ours", "reduced", "taylor"
"""Names of the two peers that are not counted among the other simulators."""
DIGITS = 5
"""Significant digits of the numbers in the file."""
BRIEF_DIGITS = 4
"""Those in a brief file: times scatter more."""


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
    """Seconds to build a peer's model, what its first call took more than the later ones, and what
    a C compiler took; None without one."""

    problem: str
    peer: str
    build: float
    first_call: float | None
    compiler: float | None = None


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

    def save(self, path: Path, brief: bool = False) -> None:
        """Write to ``path``; complete at any moment.

        A brief file is for the repository: of the repeats' times it has the least and the median,
        and fields of measurements with their default are left out.
        """
        data = _plain(asdict(self), BRIEF_DIGITS if brief else DIGITS)
        if brief:
            data["measurements"] = [_brief(row) for row in data["measurements"]]
        separators = (",", ":") if brief else (", ", ": ")
        # A row per line: files stay small, and differences between two can be read.
        entries = [f"{json.dumps(key)}: {_rows(value, separators)}" for key, value in data.items()]
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


def continued(
    path: Path,
    fresh: Results,
    sections: Sequence[str],
    problems: Sequence[str],
    peers: Sequence[str],
) -> Results:
    """``fresh`` with the results in ``path`` that will not be measured again.

    Parameters
    ----------
    sections, problems, peers
        What will be: names of sections, and of problems and peers in the section "work".

    Raises
    ------
    ValueError
        If the file has another schema, or was measured on another machine, with other versions or
        with other settings: such numbers do not compare.
    """
    old = load(path)
    for what in ("machine", "versions", "settings"):
        if getattr(old, what) != getattr(fresh, what):
            raise ValueError(f"{path} was measured with other {what}")

    def again(row: Measurement | Preparation | Skipped) -> bool:
        if row.peer not in peers:
            return False
        if row.problem is None:  # of the section on reliability
            return "reliability" in sections
        return "work" in sections and row.problem in problems

    return replace(
        fresh,
        problems=old.problems,
        peers=old.peers,
        measurements=[row for row in old.measurements if not again(row)],
        preparations=[row for row in old.preparations if not again(row)],
        skipped=[row for row in old.skipped if not again(row)],
        reliability=[] if "reliability" in sections else old.reliability,
        unneeded=[] if "unneeded" in sections else old.unneeded,
        scaling={} if "scaling" in sections else old.scaling,
    )


def _rows(value: Any, separators: tuple[str, str]) -> str:
    if isinstance(value, list) and value:
        rows = (json.dumps(row, allow_nan=False, separators=separators) for row in value)
        lines = ",\n ".join(rows)
        return f"[\n {lines}\n]"
    return json.dumps(value, allow_nan=False, separators=separators)


def _plain(value: Any, digits: int) -> Any:
    """``value`` with floats of so many digits; those that JSON has not are None."""
    if isinstance(value, dict):
        return {key: _plain(entry, digits) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry, digits) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    return value


def _brief(row: dict[str, Any]) -> dict[str, Any]:
    """A measurement without the times of single repeats and without what has its default."""
    defaults = {field.name: field.default for field in fields(Measurement)}
    brief = {key: value for key, value in row.items() if value != defaults[key]}
    for times in brief.keys() & {"cpu", "wall"}:
        brief[times] = {key: value for key, value in row[times].items() if key != "all"}
    return brief
