"""Tables from results alone; nothing is measured here."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.work_precision.counting import LEVELS, Point, cheapest
from benchmarks.work_precision.records import FLOOR, OURS, TAYLOR, Results

DEFAULT_VARIANTS = ("dop853, auto", "auto, auto")
"""What somebody gets who sets nothing but the tolerance: the first, or the second where the problem
is stiff."""

KERNEL_VARIANTS = ("dop853, kernel", "auto, kernel")
"""The same without code that is compiled for the mechanism, where the defaults have it."""


@dataclass(frozen=True)
class Best:
    """The cheapest counting setting of a peer: its CPU seconds, and its name."""

    seconds: float
    peer: str
    variant: str
    setting: str


def sweeps(results: Results, problem: str, peer: str) -> dict[str, list[Point]]:
    """The sweeps of a peer by variant; the cost is the least CPU time (s)."""
    out: dict[str, list[Point]] = defaultdict(list)
    for row in results.measurements:
        if (row.problem, row.peer) != (problem, peer):
            continue
        cost = math.inf if row.cpu is None else row.cpu["least"]
        out[row.variant].append(Point(row.setting, row.error, cost, row))
    return dict(out)


def best(
    results: Results,
    problem: str,
    peers: Iterable[str],
    level: float,
    variants: Collection[str] | None = None,
) -> Best | None:
    """The cheapest counting setting over ``peers`` and their variants, or some of these."""
    found: list[Best] = []
    for peer in peers:
        for name, sweep in sweeps(results, problem, peer).items():
            if variants is not None and name not in variants:
                continue
            point = cheapest(sweep, level)
            if point is not None:
                row = point.record
                found.append(Best(point.cost, peer, name, f"{row.kind} {row.setting:.0e}"))
    return min(found, key=lambda entry: entry.seconds) if found else None


def simulators(results: Results) -> list[str]:
    """The measured peers without us and without those that integrate equations written by hand."""
    return [peer for peer in results.peers if peer not in (OURS, FLOOR, TAYLOR)]


def ratio_rows(results: Results, level: float) -> list[dict[str, Any]]:
    """One row per problem: ours, the best peer, the floor (ms of CPU), and the ratios.

    ``against_peer`` is the peer's time over ours: above 1 we are faster.  ``against_floor`` is our
    time over the floor's.
    """
    out = []
    for problem in results.problems:
        ours = best(results, problem, [OURS], level, DEFAULT_VARIANTS)
        peer = best(results, problem, simulators(results), level)
        floor = best(results, problem, [FLOOR], level)
        out.append(
            {
                "problem": problem,
                "ours": ours,
                "peer": peer,
                "floor": floor,
                "against_peer": peer.seconds / ours.seconds if ours and peer else None,
                "against_floor": ours.seconds / floor.seconds if ours and floor else None,
            }
        )
    return out


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def milliseconds(seconds: float | None) -> str:
    """Three digits; a dash for None."""
    return "-" if seconds is None else f"{1e3 * seconds:.3g}"


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _ratios(results: Results) -> Iterable[str]:
    for level in LEVELS:
        yield f"### Error {level:.0e}\n"
        yield markdown(
            ("problem", "ours (ms)", "best peer (ms)", "which", "peer / ours", "reduced (ms)",
             "ours / reduced"),
            (
                (
                    row["problem"],
                    milliseconds(row["ours"] and row["ours"].seconds),
                    milliseconds(row["peer"] and row["peer"].seconds),
                    f"{results.peers[row['peer'].peer]} {row['peer'].variant}".strip()
                    if row["peer"]
                    else "none reaches it",
                    _number(row["against_peer"]),
                    milliseconds(row["floor"] and row["floor"].seconds),
                    _number(row["against_floor"]),
                )
                for row in ratio_rows(results, level)
            ),
        ) + "\n"  # fmt: skip


def _everyone(results: Results) -> str:
    def cell(problem: str, peer: str, variant: str | None) -> str:
        if not sweeps(results, problem, peer):
            return ""
        found = [best(results, problem, [peer], level, variant) for level in LEVELS]
        return " / ".join(milliseconds(entry and entry.seconds) for entry in found)

    rows: list[tuple[str, str, str | None]] = []
    for peer, title in results.peers.items():
        if peer == OURS:
            names = {row.variant for row in results.measurements if row.peer == OURS}
            rows += [(f"{title}: {name}", peer, name) for name in sorted(names)]
        else:
            rows.append((title, peer, None))
    return markdown(
        ("", *results.problems),
        (
            (label, *(cell(problem, peer, variant) for problem in results.problems))
            for label, peer, variant in rows
        ),
    )


def _problems(results: Results) -> str:
    return markdown(
        ("problem", "", "degrees of freedom", "nv", "loops", "reference", "accurate to"),
        (
            (
                name,
                facts["title"],
                str(facts["degrees_of_freedom"]),
                str(facts["nv"]),
                str(facts["loops"]),
                facts["reference"],
                f"{facts['reference_accuracy']:.1e}",
            )
            for name, facts in results.problems.items()
        ),
    )


def _reliability(results: Results) -> str:
    return markdown(
        ("problem", "peer", "setting", "right branch", "median error", "worst error"),
        (
            (
                row["problem"],
                row["title"],
                row["setting"],
                f"{row['right']} of {len(row['runs'])}",
                "-" if row["median"] is None else f"{row['median']:.1e}",
                "-" if row["worst"] is None else f"{row['worst']:.1e}",
            )
            for row in results.reliability
        ),
    )


def _unneeded(results: Results) -> str:
    return markdown(
        ("what is skipped", "measured on", "as it is (ms)", "not skipped (ms)", "factor"),
        (
            (
                row["item"],
                row["case"],
                milliseconds(row["skipped"]),
                milliseconds(row["done"]),
                _number(row["done"] / row["skipped"], 3),
            )
            for row in results.unneeded
        ),
    )


def _scaling(results: Results) -> Iterable[str]:
    for title, rows in results.scaling.items():
        if not rows:
            continue
        keys = list(rows[0])
        yield f"### {title}\n"
        yield markdown(keys, ([_cell(row[key]) for key in keys] for row in rows)) + "\n"


def _cell(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else "-" if value is None else str(value)


def text(results: Results) -> str:
    """All tables as Markdown."""
    machine = ", ".join(f"{key} {value}" for key, value in results.machine.items())
    versions = ", ".join(f"{key} {value}" for key, value in results.versions.items() if value)
    settings = results.settings
    parts = [
        "# Work and precision\n",
        f"{machine}. {versions}, backend {settings.get('backend', 'unknown')}. CPU time of one "
        f"thread, least of {settings.get('repeats', '-')}; a setting counts for a level only if it "
        f"and every tighter one reach it. Sweeps end at {settings.get('limit', '-')} s a run.\n",
    ]
    if settings.get("backend") == "python":
        parts.append("srm_mbs was measured on its Python reference, not on the compiled kernel.\n")
    if results.measurements:
        parts += ["## Ours beside the best peer\n", *_ratios(results)]
        levels = " / ".join(f"{level:.0e}" for level in LEVELS)
        parts += [f"## Everyone: CPU ms at error {levels}\n", _everyone(results), ""]
        parts += ["## Problems and their references\n", _problems(results), ""]
        parts += ["## Build, C compiler and first call, not in the times above (ms)\n"]
        rows = (
            (row.problem, results.peers[row.peer], milliseconds(row.build),
             milliseconds(row.compiler), milliseconds(row.first_call))
            for row in results.preparations
        )  # fmt: skip
        header = ("problem", "peer", "build", "C compiler", "first call, extra")
        parts += [markdown(header, rows), ""]
    if results.reliability:
        parts += ["## Reliability, settings that nobody tuned\n", _reliability(results), ""]
    if results.unneeded:
        parts += ["## What a scene does not need\n", _unneeded(results), ""]
    if results.scaling:
        parts += ["## Cost against size\n", *_scaling(results)]
    if results.skipped:
        parts += ["## Left out\n"]
        rows = ((row.problem or "all", row.peer, row.reason) for row in results.skipped)
        parts += [markdown(("problem", "peer", "why"), rows), ""]
    return "\n".join(parts)


def write(results: Results, folder: Path) -> Path:
    """Write ``tables.md``; returns the file."""
    path = folder / "tables.md"
    path.write_text(text(results), encoding="utf-8")
    return path
