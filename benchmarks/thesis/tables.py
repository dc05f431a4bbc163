"""Tables 5.1 to 5.7, and figures 5.4 to 5.12, which draw the errors behind tables 5.2 to 5.6."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import srm_mbs as srm
from benchmarks.thesis import drawing
from benchmarks.thesis.arithmetic import problem_two_at_one
from benchmarks.thesis.entries import PRINTED, Entry
from benchmarks.thesis.orders import (
    EPSILONS,
    STEPS,
    STEPS_FIVE,
    Curve,
    curve,
    slope,
    srm_curve,
    srm_fixed_step_curve,
)
from benchmarks.thesis.problems import START_TWO, problem_two
from srm_mbs.integration.methods.base import Method

FIXED_STEP = 0.005
GRIDS = (
    "Grids, which the thesis does not print: eps = h, 11 steps h = 1/10 ... 1/1000; eps = 5h, 9 "
    "steps 1/25 ... 1/1000; fixed step, 8 values of eps = 0.0055 ... 0.08. Error of x at t = 1, "
    "'exact' if at least half of the errors are rounding."
)


COARSE = 10.0
"""How much longer the fixed steps of thinned tables are."""


def _thinned(values: tuple[Any, ...], thin: bool) -> tuple[Any, ...]:
    return values[:3] if thin else values


def _epsilons(thin: bool) -> tuple[float, ...]:
    """eps over a fixed step, well above it in thinned tables."""
    return EPSILONS[-2:] if thin else EPSILONS


def table_one(out: Path, thin: bool) -> list[Entry]:
    """Table 5.1: final values of problem 2 in all digits."""
    printed = PRINTED["table5.1"]["rows"]
    ours: dict[str, dict[str, str]] = {}
    apart = 0.0
    for row in printed:
        tableau, m = row.split(", m = ")
        values = problem_two_at_one(tableau, int(m))
        ours[row] = {name: f"{value:.14f}" for name, value in zip(("x1", "x2", "y"), values)}
        run = srm.solve_dae(
            problem_two(),
            (0.0, 1.0),
            START_TWO,
            method=srm.SRM(tableau=tableau, iterations=int(m), eps=0.005),
            step=0.001,
        )
        package = (*run.x[-1], *run.y[-1])
        apart = max(apart, *(abs(a - b) for a, b in zip(values, package)))
    title = "Table 5.1: problem 2 at t = 1"
    drawing.draw_table(out / "table5.1.png", title, printed, ours)
    difference = (
        "All digits agree. The last digits of y depend on rounding: y accumulates g/eps, and "
        "one rounding of g, divided by eps, is 2e-14. The table is therefore computed with the "
        "single operations of a textbook program (benchmarks/thesis/arithmetic.py); of the "
        "orders of operations tried, it has all printed digits for almost every form of the "
        "continuous extension. The run of the package itself, whose sums are matrix products, "
        f"agrees with it to {apart:.0e}."
    )
    setup = (
        "SRM with own histories, y_0 = 0, T = I, eps = 0.005, h = 0.001; dopr54 with its "
        "continuous extension, the others with linear interpolation of y."
    )
    return [Entry("table5.1", title, setup, printed, ours, difference)]


def _draw_curves(path: Path, title: str, x: str, curves: Mapping[int, Curve]) -> None:
    """Errors over h or eps, one colour for each number of sweeps."""
    figure, axes = drawing.panels(1, 2.9)
    axis = axes[0, 0]
    for k, (m, one) in enumerate(sorted(curves.items())):
        style = {"color": drawing.COLOURS[k], "marker": drawing.MARKERS[k], "markersize": 3.5}
        order = slope(one.values, one.errors)
        axis.loglog(
            one.values,
            [max(error, 1e-17) for error in one.errors],
            linewidth=0.9,
            label=f"m = {m}: {order if isinstance(order, str) else f'{order:.2f}'}",
            **style,
        )
        if one.embedded is not None:
            order = slope(one.values, one.embedded)
            axis.loglog(
                one.values,
                [max(error, 1e-17) for error in one.embedded],
                linewidth=0.7,
                linestyle=(0, (4, 2)),
                markerfacecolor="white",
                label=f"embedded: {order if isinstance(order, str) else f'{order:.2f}'}",
                **style,
            )
    drawing.label(axis, x, "relative error of x at t = 1", title)
    drawing.legend(axis, beside=True, title="sweeps: fitted slope", title_fontsize=7)
    drawing.save(figure, path)


def _orders(
    out: Path,
    key: str,
    figures: tuple[str, ...],
    tableau: str,
    columns: Mapping[str, Mapping[int, Curve]],
    difference: str,
) -> list[Entry]:
    """The table ``key`` of the slopes of ``columns``, and the figures that draw them."""
    printed = PRINTED[key]["rows"]
    ours: dict[str, dict[str, float | str]] = {}
    for row in printed:
        embedded = row.endswith("embedded")
        m = int(row.removesuffix(", embedded").split("= ")[1])
        ours[row] = {}
        for column, curves in columns.items():
            one = curves[m]
            errors = one.embedded if embedded else one.errors
            assert errors is not None  # noqa: S101 - rows "embedded" exist for pairs only
            ours[row][column] = slope(one.values, errors)
    number = key.removeprefix("table")
    title = f"Table {number}: observed orders of SRM, {tableau}"
    setup = f"Problem 1 with p = {srm.TABLEAUS[tableau].order}, SRM with own histories. {GRIDS}"
    drawing.draw_table(out / f"{key}.png", title, printed, ours)
    entries = [Entry(key, title, setup, printed, ours, difference)]
    for figure, (column, curves) in zip(figures, columns.items()):
        ticks = "ε" if column == f"h = {FIXED_STEP}" else "ε (= h)"
        if column == "eps = 5h":
            ticks = "ε = 5h"
        title = (
            f"Figure {figure.removeprefix('figure')}: convergence of SRM, {tableau}, "
            f"{column.replace('eps', 'ε')}"
        )
        _draw_curves(out / f"{figure}.png", title, f"{ticks} (s)", curves)
        entries.append(
            Entry(
                figure,
                title.replace("ε", "eps"),
                f"The errors behind column {column} of table {number}; zeros are drawn at 1e-17.",
                {row: cells[column] for row, cells in printed.items()},
                {row: cells[column] for row, cells in ours.items()},
                f"The slopes are those of table {number}, and differ as explained there.",
            )
        )
    return entries


def _both(tableau: str, sweeps: range, thin: bool) -> dict[str, dict[int, Curve]]:
    """Errors for eps = h and for the fixed step."""
    steps, epsilons = _thinned(STEPS, thin), _epsilons(thin)
    fixed = FIXED_STEP * (COARSE if thin else 1.0)
    return {
        "eps = h": {m: srm_curve(tableau, m, steps, 1.0) for m in sweeps},
        "h = 0.005": {m: srm_fixed_step_curve(tableau, m, epsilons, fixed) for m in sweeps},
    }


def table_two(out: Path, thin: bool) -> list[Entry]:
    """Table 5.2, figures 5.4 and 5.5: trap."""
    difference = "They agree; the slope of m = 1 depends on the grid."
    columns = _both("trap", range(1, 4), thin)
    return _orders(out, "table5.2", ("figure5.4", "figure5.5"), "trap", columns, difference)


def table_three(out: Path, thin: bool) -> list[Entry]:
    """Table 5.3, figures 5.6 and 5.7: tvd32 and its embedded scheme."""
    difference = (
        "They agree, except for the embedded scheme with a fixed step from sweep 3 on: its "
        "error has a minimum over eps, and a slope fitted across the minimum depends on the "
        "ends of the grid."
    )
    columns = _both("tvd32", range(1, 6), thin)
    return _orders(out, "table5.3", ("figure5.6", "figure5.7"), "tvd32", columns, difference)


def table_four(out: Path, thin: bool) -> list[Entry]:
    """Table 5.4, figures 5.8 and 5.9: erk4."""
    difference = (
        "Slopes differ by up to 0.1 because of the grids. m = 5 with eps = h is exact except "
        "for the initial transient exp(-t/eps), visible on the coarsest grids only; print has "
        "4.9974 there, and 'exact' for the fixed step, as here."
    )
    columns = _both("erk4", range(1, 7), thin)
    return _orders(out, "table5.4", ("figure5.8", "figure5.9"), "erk4", columns, difference)


def table_five(out: Path, thin: bool) -> list[Entry]:
    """Table 5.5, figures 5.10 and 5.11: dopr54 and its embedded scheme."""
    difference = (
        "m = 2 and 3 agree. For more sweeps the curves bend: with eps = h the stage order 1 of "
        "explicit schemes on the stiff terms takes over (O(h^2), both in print and here); with "
        "a fixed step the error has a minimum over eps, below which it grows again, and a slope "
        "across it depends on the grid, by up to 0.3. The embedded scheme of sweep 6 with eps = "
        "h has slope 1.9 here, as all its neighbours; print has 0.93."
    )
    columns = _both("dopr54", range(1, 8), thin)
    return _orders(out, "table5.5", ("figure5.10", "figure5.11"), "dopr54", columns, difference)


def table_six(out: Path, thin: bool) -> list[Entry]:
    """Table 5.6, figure 5.12: dopr54 with eps = 5h."""
    difference = (
        "They agree within 0.1 if the coarse end of the grid is h = 1/25. There eps is a fifth "
        "of the run and the errors are far from their asymptote; slopes change by up to 0.7 if "
        "h = 1/10 is fitted as well."
    )
    steps = _thinned(STEPS_FIVE, thin)
    columns = {"eps = 5h": {m: srm_curve("dopr54", m, steps, 5.0) for m in range(1, 9)}}
    return _orders(out, "table5.6", ("figure5.12",), "dopr54", columns, difference)


def table_seven(out: Path, thin: bool) -> list[Entry]:
    """Table 5.7: PSRM with the simple prediction."""
    printed = PRINTED["table5.7"]["rows"]
    few = slice(3, 7, 3) if thin else slice(None)
    steps, epsilons = STEPS[few], _epsilons(thin)
    long = 0.001 * (COARSE if thin else 1.0)
    # With eps = 0.05 the coarsest grid lies at the stability limit h/eps = 2.
    stable = tuple(n for n in steps if n > 10)

    def method(tableau: str, eps: float) -> Method:
        return srm.PSRM(tableau=tableau, prediction="simple", eps=eps)

    def columns(tableau: str) -> dict[str, Curve]:
        scheme = srm.TABLEAUS[tableau]

        def one(values: tuple[float, ...], runs: list[tuple[float, float]]) -> Curve:
            pairs = [(method(tableau, eps), h) for eps, h in runs]
            return curve(scheme.order, values, pairs, scheme.error is not None)

        h = tuple(1.0 / n for n in steps)
        fine = tuple(1.0 / n for n in STEPS_FIVE[few])
        fixed = tuple(1.0 / n for n in stable)
        return {
            "eps = h": one(h, [(x, x) for x in h]),
            "h = 0.001": one(epsilons, [(eps, long) for eps in epsilons]),
            "eps = 5h": one(fine, [(5.0 * x, x) for x in fine]),
            "eps = 0.05": one(fixed, [(0.05, x) for x in fixed]),
        }

    ours: dict[str, dict[str, float | str]] = {}
    curves = {tableau: columns(tableau) for tableau in ("trap", "tvd32", "erk4", "dopr54")}
    for row in printed:
        tableau = row.removesuffix(", embedded")
        ours[row] = {}
        for column, one in curves[tableau].items():
            errors = one.embedded if row.endswith("embedded") else one.errors
            assert errors is not None  # noqa: S101 - rows "embedded" exist for pairs only
            ours[row][column] = slope(one.values, errors)
    title = "Table 5.7: observed orders of PSRM with simple prediction (theory 2, 1, 2, 1)"
    setup = (
        "Problem 1 with p the order of the scheme; the multiplier is held over the step, then one "
        f"corrector sweep. {GRIDS} For eps = 0.05 h = 1/16 ... 1/1000."
    )
    difference = (
        "They agree within 0.05. trap with eps = 5h is 'exact' in print and of order 2 here, as "
        "theory has it: for x = t^2 the multiplier falls by 2h per step, which is g/eps, so that "
        "the error tends to 2 h eps exactly."
    )
    drawing.draw_table(out / "table5.7.png", title, printed, ours)
    return [Entry("table5.7", title, setup, printed, ours, difference)]
