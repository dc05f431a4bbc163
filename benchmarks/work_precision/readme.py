"""One figure and one table for the README, from a results file.

    python -m benchmarks.work_precision.readme [RESULTS.json] [--docs DIR] [--readme FILE]

Rewrites what stands between the two marks in the README, or puts it before the section "Measured".
The results, in brief, and the figure go to the documentation.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from benchmarks.work_precision import plots, records
from benchmarks.work_precision.counting import LEVELS
from benchmarks.work_precision.records import FLOOR, OURS, Results
from benchmarks.work_precision.tables import (
    DEFAULT_VARIANT,
    Best,
    best,
    markdown,
    milliseconds,
    simulators,
)

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NAME = "work_precision.json"
BEGIN, END = "<!-- work-precision: begin -->", "<!-- work-precision: end -->"
BEFORE = "## Measured"
SHOWN = ("slider_crank_whirl", "slider_crank_regular", "n_four_bar_2", "walking_robot")
"""Problems of the figure, as far as they were measured."""


def _triple(entries: Sequence[Best | None]) -> str:
    return " / ".join(milliseconds(entry and entry.seconds) for entry in entries)


def _ratio(theirs: Best | None, ours: Best | None) -> str:
    return f"{theirs.seconds / ours.seconds:.2g}" if theirs and ours else "-"


def table(results: Results) -> str:
    """Our default, the best simulator and the reduced equation at every level, in CPU ms."""
    rows = []
    for problem, facts in results.problems.items():
        ours = [best(results, problem, [OURS], level, DEFAULT_VARIANT) for level in LEVELS]
        peers = [best(results, problem, simulators(results), level) for level in LEVELS]
        floor = [best(results, problem, [FLOOR], level) for level in LEVELS]
        names = dict.fromkeys(results.peers[entry.peer] for entry in peers if entry)
        rows.append(
            (
                facts["title"],
                _triple(ours),
                _triple(peers),
                "; ".join(names) or "none",
                " / ".join(_ratio(peer, own) for peer, own in zip(peers, ours)),
                _triple(floor) if any(floor) else "",
            )
        )
    levels = " / ".join(f"{level:.0e}" for level in LEVELS)
    header = (
        f"CPU ms at error {levels}",
        "srm_mbs",
        "best simulator",
        "which",
        "its time over ours",
        "reduced by hand",
    )
    return markdown(header, rows)


def block(results: Results, figure: str) -> str:
    """What stands between the marks; ``figure`` is the path of the picture from the README."""
    versions = results.versions
    names = ("pin", "mujoco", "exudyn", "scikit-sundae", "scipy-dae", "scipy")
    limit = results.settings.get("limit")
    option = "" if limit is None else f" --limit {limit:g}"
    until = "" if limit is None else f" with runs of up to {limit:g} s"
    listed = ", ".join(f"{name} {versions[name]}" for name in names if versions.get(name))
    return "\n".join(
        [
            BEGIN,
            f"![CPU time against error]({figure})",
            "",
            table(results),
            "",
            f"`srm-mbs benchmark --out DIR --sections work{option}` measures this (least of "
            f"{results.settings['repeats']} runs, one thread, {results.machine['processor']}, "
            f"{listed}): integration and output at 100 times, the error is the largest over them. "
            "A setting counts for an error only if it and every tighter one reach it. Ours is the "
            "default, the others are the best of their variants (Baumgarte rates, softness); a "
            f"dash: not reached{until}.",
            END,
        ]
    )


def rewritten(text: str, new: str) -> str:
    """``text`` with the marked block replaced by ``new``, or ``new`` before "Measured".

    Raises
    ------
    ValueError
        If one mark is there without the other, or neither they nor that section.
    """
    begins, ends = text.count(BEGIN), text.count(END)
    if (begins, ends) == (1, 1) and text.index(BEGIN) < text.index(END):
        start, rest = text.split(BEGIN)
        return start + new + rest.split(END)[1]
    if (begins, ends) != (0, 0) or text.count(f"\n{BEFORE}\n") != 1:
        raise ValueError(f"there is no single pair of marks and no single section {BEFORE!r}")
    return text.replace(f"\n{BEFORE}\n", f"\n## Beside other simulators\n\n{new}\n\n{BEFORE}\n")


def main(given: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", nargs="?", type=Path, metavar="RESULTS.json")
    parser.add_argument("--docs", type=Path, default=DOCS, metavar="DIR")
    parser.add_argument("--readme", type=Path, default=ROOT / "README.md", metavar="FILE")
    arguments = parser.parse_args(given)
    kept = arguments.docs / NAME
    results = records.load(arguments.results or kept)
    results.save(kept, brief=True)
    # The page shows what is kept: numbers rounded twice could differ from it in the last digit.
    results = records.load(kept)
    picture = kept.with_suffix(".png")
    shown = [problem for problem in SHOWN if problem in results.problems]
    plots.overview(results, shown or list(results.problems)[:4]).savefig(picture, dpi=130)
    readme = arguments.readme
    path = Path(os.path.relpath(picture, readme.parent)).as_posix()
    text = readme.read_text(encoding="utf-8")
    readme.write_text(rewritten(text, block(results, path)), encoding="utf-8")
    print(f"written: {kept}, {picture}, {readme}")


if __name__ == "__main__":
    main()
