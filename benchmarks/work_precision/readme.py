"""The figure and the tables of CPU time against error in docs/benchmarks.md and in the README.

    python -m benchmarks.work_precision.readme [RESULTS.json] [--docs DIR] [--readme FILE]

Rewrites the text between the two marks of each page: docs/benchmarks.md has all problems, the
README three of them.  The results, in brief, and the figure are stored with the documentation.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from benchmarks.work_precision import plots, records
from benchmarks.work_precision.counting import LEVELS
from benchmarks.work_precision.records import FLOOR, OURS, TAYLOR, Results
from benchmarks.work_precision.tables import (
    DEFAULT_VARIANTS,
    KERNEL_VARIANTS,
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
PAGE = "benchmarks.md"
SHOWN = ("slider_crank_whirl", "slider_crank_regular", "n_four_bar_2", "walking_robot")
"""Problems of the figure, as far as they were measured."""
SUMMARY = ("slider_crank_whirl", "slider_crank_regular", "walking_robot")
"""Problems of the table in the README, as far as they were measured."""


def _triple(entries: Sequence[Best | None]) -> str:
    return " / ".join(milliseconds(entry and entry.seconds) for entry in entries)


def _ratio(theirs: Best | None, ours: Best | None) -> str:
    if not (theirs and ours):
        return "-"
    ratio = theirs.seconds / ours.seconds
    return f"{ratio:.2g}" if ratio < 99.5 else f"{ratio:.0f}"


def _measured(results: Results, problems: Sequence[str]) -> list[str]:
    """Those of ``problems`` that were measured, or the first of all."""
    measured = [problem for problem in problems if problem in results.problems]
    return measured or list(results.problems)[: len(problems)]


def table(results: Results, problems: Sequence[str] | None = None) -> str:
    """Our default, with generated code and without it, the best simulator and equations written by
    hand at every level, in CPU ms; what compilation took, of heyoka its first run more than others.

    Parameters
    ----------
    problems
        A row for each; all by default.
    """
    rows = []
    for problem in problems or list(results.problems):
        facts = results.problems[problem]
        ours = [best(results, problem, [OURS], level, DEFAULT_VARIANTS) for level in LEVELS]
        kernel = [best(results, problem, [OURS], level, KERNEL_VARIANTS) for level in LEVELS]
        peers = [best(results, problem, simulators(results), level) for level in LEVELS]
        floor = [best(results, problem, [FLOOR], level) for level in LEVELS]
        taylor = [best(results, problem, [TAYLOR], level) for level in LEVELS]
        own = [row for row in results.preparations if row.problem == problem]
        compiler = next((row.compiler for row in own if row.peer == OURS), None)
        compilation = next((row.first_call for row in own if row.peer == TAYLOR), None)
        names = dict.fromkeys(results.peers[entry.peer] for entry in peers if entry)
        rows.append(
            (
                facts["title"],
                _triple(ours),
                f"{compiler:.2g}" if compiler else "",
                _triple(kernel) if any(kernel) else "",
                _triple(peers),
                "; ".join(names) or "none",
                " / ".join(_ratio(peer, own) for peer, own in zip(peers, ours)),
                _triple(floor) if any(floor) else "",
                _triple(taylor) if any(taylor) else "",
                f"{compilation:.2g}" if compilation else "",
            )
        )
    levels = " / ".join(f"{level:.0e}" for level in LEVELS)
    header = (
        f"CPU ms at error {levels}",
        "srm_mbs",
        "its code compiles, s",
        "srm_mbs, kernel without code",
        "best other simulator",
        "which",
        "ratio",
        "equations by hand, SciPy",
        "equations by hand, heyoka",
        "heyoka compiles, s",
    )
    return markdown(header, rows)


def _until(results: Results, words: str) -> str:
    """``words`` with the limit (s) of a run; empty without limit."""
    limit = results.settings.get("limit")
    return "" if limit is None else words.format(limit=f"{limit:g}")


def _marked(lines: Sequence[str]) -> str:
    return "\n".join([BEGIN, *lines, END])


def summary(results: Results, figure: str) -> str:
    """Text between the marks of the README; ``figure`` is the path of the picture from there."""
    return _marked(
        [
            f"![CPU time against error]({figure})",
            "",
            table(results, _measured(results, SUMMARY)),
            "",
            "Default settings against the best variant of the best other simulator, on one thread; "
            "a dash: error not reached" + _until(results, " within\n{limit} s of CPU time") + ".  "
            "All problems and conditions: [Benchmarks](docs/benchmarks.md).",
        ]
    )


def block(results: Results, figure: str) -> str:
    """Text between the marks of docs/benchmarks.md; ``figure`` as in :func:`summary`."""
    versions = results.versions
    names = ("pin", "mujoco", "exudyn", "scikit-sundae", "scipy-dae", "scipy", "heyoka")
    option = _until(results, " --limit {limit}")
    until = _until(results, " with runs of up to {limit} s")
    listed = ", ".join(f"{name} {versions[name]}" for name in names if versions.get(name))
    return _marked(
        [
            f"![CPU time against error]({figure})",
            "",
            table(results),
            "",
            f"`srm-mbs benchmark --out DIR --sections work{option}` measures this (least of "
            f"{results.settings['repeats']} runs, one thread, {results.machine['processor']}, "
            f"{listed}). A run includes integration and output at 100 times; its error is the "
            "largest over these times. A setting counts for an error only if it and every tighter "
            "setting reach it. The column srm_mbs has the default settings, the others the best of "
            f"their variants (Baumgarte rates, softness). A dash: not reached{until}.  Generated "
            "code is compiled before; heyoka compiles in its first run, here at the loosest "
            "tolerance.",
        ]
    )


def rewritten(text: str, new: str) -> str:
    """``text`` with the marked block replaced by ``new``.

    Raises
    ------
    ValueError
        If the text does not have exactly one pair of marks.
    """
    if (text.count(BEGIN), text.count(END)) != (1, 1) or text.index(BEGIN) > text.index(END):
        raise ValueError("the text does not have exactly one pair of marks")
    start, rest = text.split(BEGIN)
    return start + new + rest.split(END)[1]


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
    plots.overview(results, _measured(results, SHOWN)).savefig(picture, dpi=130)
    pages = {arguments.docs / PAGE: block, arguments.readme: summary}
    for page, written in pages.items():
        path = Path(os.path.relpath(picture, page.parent)).as_posix()
        text = page.read_text(encoding="utf-8")
        page.write_text(rewritten(text, written(results, path)), encoding="utf-8")
    print(f"written: {kept}, {picture}, {', '.join(map(str, pages))}")


if __name__ == "__main__":
    main()
