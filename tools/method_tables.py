"""The table of tableaus and backends on ``docs/methods.md``, from ``docs/work_precision.json``.

    python -m tools.method_tables

Run from a checkout after the benchmark was recorded again.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1] / "docs"
BEGIN, END = "<!-- variants: begin -->\n", "<!-- variants: end -->\n"
VARIANTS = ("dop853, auto", "dopr54, auto", "dop853, python")
PROBLEMS = ("slider_crank_whirl", "spatial_four_bar", "walking_robot")
RTOL = (1e-4, 1e-6, 1e-8, 1e-10)


def table(results: dict[str, Any]) -> str:
    """CPU time and error of every variant, a row for each problem and tolerance.

    A dash where the sweep of the benchmark had ended, at its limit of time.
    """
    found = {
        (row["problem"], row["variant"], row["setting"]): row
        for row in results["measurements"]
        if row["peer"] == "ours"
    }
    lines = [
        "| problem | rtol | dop853: ms, error | dopr54: ms, error | dop853, Python reference: ms |",
        "|---|---|---|---|---|",
    ]
    for problem in PROBLEMS:
        for rtol in RTOL:
            best, fifth, python = (found.get((problem, variant, rtol)) for variant in VARIANTS)
            cells = [
                f"{1e3 * row['cpu']['least']:.3g}, {row['error']:.0e}" if row else "-"
                for row in (best, fifth)
            ]
            cells.append(f"{1e3 * python['cpu']['least']:.3g}" if python else "-")
            lines.append(f"| {problem} | {rtol:.0e} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def filled(page: str, results: dict[str, Any]) -> str:
    """``page`` with the table between its marks."""
    before, rest = page.split(BEGIN)
    return before + BEGIN + table(results) + END + rest.split(END)[1]


def main() -> None:
    page = DOCS / "methods.md"
    results = json.loads((DOCS / "work_precision.json").read_text(encoding="utf-8"))
    page.write_text(filled(page.read_text(encoding="utf-8"), results), encoding="utf-8")


if __name__ == "__main__":
    main()
