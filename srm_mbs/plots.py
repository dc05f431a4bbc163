"""The run plot: drift, energy, sigma and step sizes over time.

Matplotlib's object interface only: no pyplot, so no display and no global state.  Imported when a
plot is asked for, because matplotlib is slow to import.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from srm_mbs.errors import InputError
from srm_mbs.systems.units import row_dimensions

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from srm_mbs.arrays import FloatArray
    from srm_mbs.solution import Solution

FORMATS = (".png", ".pdf", ".svg")
"""Suffixes under which a figure can be saved."""
SMALLEST_DRIFT = 1e-17
"""Drift that is exactly zero is drawn here, since a logarithmic axis has no zero."""
FULL_LINES = 80
"""More singular passages than this are marked by ticks: full lines would fill the panels."""
LARGE_DOTS = 400
"""Up to this many steps their dots are large."""
FEW_DECADES = 50.0
"""Below this ratio of its limits a logarithmic axis has ticks at 1, 2, 5, not just at decades."""
NARROWEST = 8.0
"""Smallest ratio of the limits of such an axis, so that there are always ticks on it."""

# Okabe and Ito's palette: distinct for the colour-blind, and of different lightness in print.
BLACK, BLUE, VERMILION, GREY = "#000000", "#0072B2", "#D55E00", "#8C8C8C"

WIDTH = 7.0
"""Width of the figure (inch), within the text of an A4 or letter page."""
FONT_SIZE = 8.5
RESOLUTION = 200
"""Dots per inch of a png."""


def check_suffix(path: Path) -> None:
    """Refuse a file name whose suffix is no format of figures.

    Raises
    ------
    InputError
        Naming the suffixes that are.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            f"figures cannot be saved as {path.suffix!r}",
            file=str(path),
            remedy=f"Use one of {', '.join(FORMATS)}",
        )


def plot_run(solution: Solution, path: Path | None = None) -> Figure:
    """Drift, energy, sigma and step sizes of a run over time, in panels with one time axis.

    Drift and energy are drawn at ``solution.t``, sigma and step sizes at the steps.  Without
    loops there is neither drift nor sigma, and their panels are left out.

    Parameters
    ----------
    solution
        A run, finished or not.
    path
        Where to save the figure; the suffix decides the format: png, pdf or svg.

    Raises
    ------
    InputError
        If the suffix is another one; nothing is drawn then.
    OSError
        If the file cannot be written.
    """
    if path is not None:
        check_suffix(path)
    draws = [_energy, _step_sizes]
    if solution.mechanism.constrained:
        draws = [_drift, _energy, _sigma, _step_sizes]
    figure = Figure(figsize=(WIDTH, 0.7 + 1.65 * len(draws)), layout="constrained")
    panels = figure.subplots(len(draws), sharex=True, squeeze=False)[:, 0]
    # A state that runs away overflows in its drift and energy: the curves just end there.
    with np.errstate(over="ignore", invalid="ignore"):
        for letter, draw, axes in zip("abcd", draws, panels):
            _prepare(axes)
            title = draw(axes, solution)
            axes.set_title(f"({letter}) {title}", loc="left", fontsize=FONT_SIZE + 0.5)
            _legend(axes)
    start, end = solution.steps.times[0], solution.steps.end
    margin = 0.01 * (end - start) or 1.0
    panels[-1].set_xlim(start - margin, end + margin)
    panels[-1].set_xlabel("time (s)", fontsize=FONT_SIZE)
    figure.align_ylabels(panels)
    # Names are the user's: a "$" in them is no formula.
    figure.suptitle(_title(solution), fontsize=FONT_SIZE + 1.5, parse_math=False)
    if path is not None:
        figure.savefig(path, format=path.suffix.lower()[1:], dpi=RESOLUTION)
    return figure


def _title(solution: Solution) -> str:
    settings = solution.settings
    control = f"rtol = {settings.rtol:.3g}"
    if settings.step is not None:
        control = f"fixed step {settings.step:.6g} s"
    parts = [solution.mechanism.name, settings.method, settings.tableau, control]
    title = ", ".join(part for part in parts if part)
    if not solution.success:
        title += f"\n{solution.status} at t = {solution.steps.end:.6g} s"
    return title


def _prepare(axes: Axes) -> None:
    axes.tick_params(labelsize=FONT_SIZE - 0.5, which="both", direction="in")
    axes.grid(axis="y", color="#E4E4E4", linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _legend(axes: Axes) -> None:
    """A legend above the panel, on the line of its title, where there are no data."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            handles,
            labels,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(handles),
            frameon=False,
            borderaxespad=0.0,
            borderpad=0.2,
            handlelength=1.4,
            fontsize=FONT_SIZE - 0.5,
        )


def _log_axis(axes: Axes) -> None:
    """A logarithmic axis with labelled ticks, whatever the range of its data."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    if high / low < FEW_DECADES:
        if high / low < NARROWEST:
            middle = np.sqrt(low * high)
            axes.set_ylim(middle / np.sqrt(NARROWEST), middle * np.sqrt(NARROWEST))
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        axes.yaxis.set_major_locator(LogLocator(numticks=6))
        axes.yaxis.set_minor_formatter(NullFormatter())


def _drift(axes: Axes, solution: Solution) -> str:
    parts = row_dimensions(solution.mechanism)
    units = (", ".join(parts), ", ".join(f"{part}/s" for part in parts))
    names = (r"$\Vert g\Vert$", r"$\Vert G\,v\Vert$")
    drift = _finite(solution.drift)
    # The positions as dots: at round-off a line would jump to and fro between a few values.
    rate = {"color": VERMILION, **_curve(solution.t)}
    position = {"color": BLACK, "linestyle": "none", "marker": ".", "markersize": 2.0}
    for column, style in ((1, rate), (0, position)):
        axes.plot(
            solution.t,
            np.maximum(drift[:, column], SMALLEST_DRIFT),
            label=f"{names[column]} ({units[column]})",
            **style,
        )
    _log_axis(axes)
    axes.set_ylabel("drift", fontsize=FONT_SIZE)
    floor = drift < SMALLEST_DRIFT
    return "closure errors" + (f" (zeros drawn at {SMALLEST_DRIFT:.0e})" if floor.any() else "")


def _energy(axes: Axes, solution: Solution) -> str:
    change = _finite(solution.energy - solution.energy[:1])
    largest = float(np.nanmax(np.abs(change), initial=0.0))
    # The power of ten goes into the label: matplotlib's own would lie on the panel's title.
    power = int(np.floor(np.log10(largest))) if largest > 0.0 else 0
    if -2 <= power <= 3:
        power = 0
    unit = "J" if power == 0 else rf"$10^{{{power}}}$ J"
    axes.plot(solution.t, change / 10.0**power, color=BLACK, **_curve(solution.t))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel(f"energy change\n({unit})", fontsize=FONT_SIZE)
    from_start = not len(solution.t) or solution.t[0] == solution.steps.times[0]
    since = "the start" if from_start else f"t = {solution.t[0]:.6g} s"
    return f"total energy relative to {since}"


def _sigma(axes: Axes, solution: Solution) -> str:
    steps = solution.steps
    _passages(axes, solution)
    # A line through every stage: a step leaps over a singular passage, its stages show the dip.
    abscissae = np.append(solution.scheme.c, 1.0)
    times = steps.times[:-1, None] + abscissae * np.diff(steps.times)[:, None]
    order = np.argsort(times, axis=None, kind="stable")
    axes.plot(
        times.ravel()[order],
        _finite(steps.sigmas.ravel()[order]),
        color=GREY,
        linewidth=0.8,
        label="stages",
    )
    axes.plot(
        steps.times[1:],
        _finite(steps.sigmas[:, -1]),
        color=BLUE,
        linestyle="none",
        label="step ends",
        **_dots(steps.count),
    )
    axes.set_ylim(bottom=0.0, top=None if steps.count else 1.0)
    axes.set_ylabel(r"$\sigma$ (relative)", fontsize=FONT_SIZE)
    return "distance from singular configurations"


def _step_sizes(axes: Axes, solution: Solution) -> str:
    steps = solution.steps
    _passages(axes, solution)
    axes.plot(
        steps.times[:-1],
        np.diff(steps.times),
        color=BLUE,
        linestyle="none",
        label="accepted",
        **_dots(steps.count),
    )
    crosses = {"rejected": (solution.rejected, VERMILION, "x")}
    crosses["redone"] = (solution.replaced, BLACK, "+")
    for label, (attempts, colour, marker) in crosses.items():
        if len(attempts):
            axes.plot(
                attempts[:, 0],
                attempts[:, 1],
                color=colour,
                marker=marker,
                markersize=4.0,
                markeredgewidth=0.9,
                linestyle="none",
                label=label,
            )
    _log_axis(axes)
    axes.set_ylabel("step size (s)", fontsize=FONT_SIZE)
    return "steps"


def _passages(axes: Axes, solution: Solution) -> None:
    """Mark the singular passages by thin vertical lines, or by ticks where they are many."""
    times = [crossing.time for crossing in solution.crossings]
    if times:
        axes.vlines(
            times,
            0.0,
            1.0 if len(times) <= FULL_LINES else 0.06,
            transform=axes.get_xaxis_transform(),
            color=BLACK,
            linewidth=0.5,
            linestyle=(0, (4, 3)),
            label="singular passage",
        )


def _finite(values: FloatArray) -> FloatArray:
    """Values with gaps where they are not finite: nothing is drawn there."""
    return np.where(np.isfinite(values), values, np.nan)


def _curve(t: FloatArray) -> dict[str, Any]:
    """Line properties; few points get dots, without which a single one would be invisible."""
    return {"linewidth": 0.9, "marker": "." if len(t) < 50 else "", "markersize": 3.0}


def _dots(count: int) -> dict[str, Any]:
    """Marker properties for one mark per step: smaller where there are many."""
    return {"marker": ".", "markersize": 3.5 if count <= LARGE_DOTS else 2.0}
