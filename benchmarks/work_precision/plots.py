"""Plots from a results file alone.

python -m benchmarks.work_precision.plots DIR/results.json --out DIR
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.work_precision import records
from benchmarks.work_precision.counting import LEVELS, Point, cheapest
from benchmarks.work_precision.tables import sweeps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# After Okabe and Ito, told apart by colour-blind readers; marker and line differ as well, so that
# a black-and-white print can be read.
STYLES = {
    "ours": ("#0072B2", "o", "-", 2.4),
    "reduced": ("#000000", "s", ":", 1.2),
    "pinocchio_dop853": ("#E69F00", "^", "--", 1.2),
    "pinocchio_dop853_baumgarte": ("#D55E00", "v", "-", 1.2),
    "pinocchio_rk4_baumgarte": ("#009E73", "D", "-", 1.2),
    "pinocchio_rk4_projected": ("#009E73", "P", "--", 1.2),
    "mujoco": ("#CC79A7", "X", "-", 1.2),
    "exudyn": ("#CC79A7", "*", "--", 1.2),
    "sundials_ida": ("#56B4E9", "<", "-.", 1.2),
    "scipy_dae_radau": ("#56B4E9", ">", ":", 1.2),
    "reduced_radau": ("#000000", "d", "-.", 1.2),
    "reduced_cvode": ("#D55E00", "h", "-.", 1.2),
    "reduced_ida": ("#E69F00", "p", ":", 1.2),
    "taylor": ("#56B4E9", "H", "-", 1.2),
}
OTHER = ("#777777", ".", "-", 1.0)
SHOWN_ERRORS = (1e-13, 10.0)


def _best_variant(variants: dict[str, list[Point]]) -> str:
    """The variant that reaches most levels, then the cheapest at the last of them."""

    def rank(name: str) -> tuple[float, float]:
        costs = [cheapest(variants[name], level) for level in LEVELS]
        reached = [point.cost for point in costs if point is not None]
        return -len(reached), reached[-1] if reached else 0.0

    return min(variants, key=rank)


def _work_precision(
    axes: Axes, results: records.Results, problem: str, variants: bool = True
) -> None:
    """Draw ``problem``; without ``variants`` the peers' names alone are in the legend."""
    for peer, title in results.peers.items():
        found = sweeps(results, problem, peer)
        if not found:
            continue
        colour, marker, line, width = STYLES.get(peer, OTHER)
        names = list(found) if peer == records.OURS else [_best_variant(found)]
        for k, name in enumerate(names):
            points = [p for p in found[name] if p.error is not None and p.error > 0.0]
            if not points:
                continue
            points.sort(key=lambda point: -point.tightness)
            axes.plot(
                [1e3 * point.cost for point in points],
                [point.error for point in points],
                color=colour,
                marker=marker,
                linestyle=(line, "--", ":", "-.")[k] if peer == records.OURS else line,
                linewidth=width,
                markersize=4.5,
                markerfacecolor=colour if k == 0 else "white",
                label=f"{title}, {name}" if name and (variants or peer == records.OURS) else title,
            )
    axes.set(xscale="log", yscale="log", xlabel="CPU time (ms)", ylabel="largest error (m, rad)")
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, SHOWN_ERRORS[0]), min(high, SHOWN_ERRORS[1]))
    axes.grid(visible=True, which="major", color="#cccccc", linewidth=0.5)
    accuracy = results.problems[problem]["reference_accuracy"]
    if accuracy > axes.get_ylim()[0]:
        axes.axhline(accuracy, color="#999999", linewidth=0.8)
        axes.annotate(
            "accuracy of the reference",
            (1.0, accuracy),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            fontsize=7,
            color="#666666",
        )


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def work_precision(results: records.Results, problem: str) -> Figure:
    """Error over CPU time of every peer on ``problem``: for each peer its best variant."""
    figure = _figure(7.2, 6.2)
    axes = figure.subplots()
    _work_precision(axes, results, problem)
    figure.suptitle(results.problems[problem]["title"], fontsize=9)
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=7
    )
    return figure


def overview(results: records.Results, problems: Sequence[str]) -> Figure:
    """:func:`work_precision` of several problems in one figure, two in a row."""
    rows = (len(problems) + 1) // 2
    figure = _figure(9.5, 3.4 * rows + 1.2)
    panels = figure.subplots(rows, 2, squeeze=False).flat
    labels = {}
    for problem, axes in zip(problems, panels):
        _work_precision(axes, results, problem, variants=False)
        axes.set_title(results.problems[problem]["title"].split(",")[0], fontsize=9)
        for handle, label in zip(*axes.get_legend_handles_labels()):
            labels.setdefault(label, handle)
    for axes in list(panels):
        axes.remove()
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=3, fontsize=8)
    return figure


def scaling(results: records.Results, title: str) -> Figure:
    """Microseconds per evaluation over size, ours beside Pinocchio's own function."""
    rows = results.scaling[title]
    size = next(iter(rows[0]))
    figure = _figure(6.0, 4.2)
    axes = figure.subplots()
    columns = [key for key in rows[0] if key.endswith("(us)")]
    for k, key in enumerate(columns):
        points = [(row[size], row[key]) for row in rows if row[key] is not None]
        if points:
            colour, marker, *_ = list(STYLES.values())[k]
            axes.plot(*zip(*points), color=colour, marker=marker, label=key.removesuffix(" (us)"))
    axes.set(xscale="log", yscale="log", xlabel=size, ylabel="CPU time (us)")
    axes.grid(visible=True, which="major", color="#cccccc", linewidth=0.5)
    axes.set_title(title, fontsize=9)
    axes.legend(fontsize=7)
    return figure


def draw(results: records.Results, folder: Path) -> list[Path]:
    """Save every plot that ``results`` has data for; returns the files."""
    measured = {row.problem for row in results.measurements if row.error is not None}
    figures = {
        f"work_precision_{problem}": work_precision(results, problem)
        for problem in results.problems
        if problem in measured
    }
    for title, rows in results.scaling.items():
        if rows and any(key.endswith("(us)") for key in rows[0]):
            figures[f"scaling_{title.split(',')[0].replace(' ', '_').lower()}"] = scaling(
                results, title
            )
    written = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=160)
        written.append(path)
    return written


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path, metavar="RESULTS.json")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for path in draw(records.load(arguments.results), arguments.out):
        print(f"written: {path}")


if __name__ == "__main__":
    main()
