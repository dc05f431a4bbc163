"""Drift, energy, sigma, step sizes and error estimates of a run over time."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from srm_mbs.dynamics.scaling import row_dimensions
from srm_mbs.errors import time_text
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.plotting.figure import (
    BLACK,
    BLUE,
    FONT_SIZE,
    GREEN,
    GREY,
    LARGE_DOTS,
    ORANGE,
    PURPLE,
    VERMILION,
    Draw,
    above_zero,
    curve,
    dots,
    draw_line,
    finite,
    linear_axis,
    log_axis,
    mark_times,
    marks,
    marks_note,
    seconds,
    time_panels,
)
from srm_mbs.visualization.plotting.sampling import Run, constrained, distinct

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srm_mbs._typing import FloatArray

SMALLEST_DRIFT = 1e-17
"""Ordinate of a drift of exactly zero on the logarithmic axis."""
SMALLEST_SIGMA = 1e-16
"""Ordinate of a sigma of exactly zero on the logarithmic axis."""


def draw_run(solution: SimulationResult) -> Figure:
    """Drift, energy, sigma and step sizes of a run over time, in panels with one time axis.

    Drift and energy are drawn at ``solution.t``, sigma and step sizes at the steps.  Open chains
    have no panels of drift and sigma.
    """
    energy: Draw = partial(_energy, solution=solution)
    draws = [energy, step_panel(solution)]
    if constrained(solution):
        drift: Draw = partial(_drift, solution=solution)
        draws = [drift, energy, sigma_panel(solution), step_panel(solution)]
    return time_panels(solution, draws)


def _drift(axes: Axes, solution: SimulationResult) -> str:
    found = {part for each in solution.segments for part in row_dimensions(each.mechanism)}
    parts = [part for part in ("m", "rad") if part in found]
    units = (", ".join(parts), ", ".join(f"{part}/s" for part in parts))
    names = (r"$\Vert g\Vert$", r"$\Vert G\,v\Vert$")
    drift, note = above_zero(solution.drift, SMALLEST_DRIFT)
    # Positions as dots: at rounding level a line would jump between a few values.
    rate = {"color": VERMILION, **curve(len(solution.t))}
    position = {"color": BLACK, "linestyle": "none", "marker": ".", "markersize": 2.0}
    for column, style in ((1, rate), (0, position)):
        label = f"{names[column]} ({units[column]})"
        draw_line(axes, solution.t, drift[:, column], label=label, **style)
    log_axis(axes)
    axes.set_ylabel("drift", fontsize=FONT_SIZE)
    return f"closure errors{note}"


def _energy(axes: Axes, solution: SimulationResult) -> str:
    change = finite(solution.energy - solution.energy[:1])
    factor = linear_axis(axes, [change], "energy change\n", "J", size=0.0)
    draw_line(axes, solution.t, change / factor, color=BLACK, **curve(len(change)))
    from_start = not len(solution.t) or solution.t[0] == solution.steps.times[0]
    reference = "the start" if from_start else f"t = {time_text(solution.t[0])} s"
    return f"total energy relative to {reference}"


def sigma_panel(solution: Run, *, log: bool = False) -> Draw:
    """sigma at the ends of the steps, and a line through every stage."""
    return partial(_sigma, solution=solution, log=log)


def step_panel(solution: Run, *, kinds: bool = False) -> Draw:
    """Accepted, rejected and redone steps; with ``kinds``, also those that were placed, those in
    the zone, and those held on their branch."""
    return partial(_step_sizes, solution=solution, kinds=kinds)


def draw_sigma(solution: SimulationResult) -> Figure:
    """sigma, step sizes and error estimates of a run (figures 5.14 to 5.16 of the thesis)."""
    draws = [sigma_panel(solution, log=True)] if constrained(solution) else []
    draws.append(step_panel(solution, kinds=True))
    if solution.settings.step is None:
        draws.append(partial(_errors, solution=solution))
    return time_panels(solution, draws, marks_note(solution), height=1.9)


def _sigma(axes: Axes, solution: Run, log: bool) -> str:
    steps = solution.steps
    mark_times(axes, solution, labelled=not log)
    # A line through every stage: stages show the dip of sigma at a passage that steps jump over.
    times = steps.stage_times(solution.scheme).ravel()
    sigmas, note = finite(steps.sigmas), ""
    if log:
        sigmas, note = above_zero(steps.sigmas, SMALLEST_SIGMA)
    order = np.argsort(times, kind="stable")
    line = sigmas.ravel()[order]
    draw_line(axes, times[order], line, color=GREY, linewidth=0.8, label="stages")
    style = dots(BLUE, steps.count)
    _draw_markers(axes, steps.times[1:], sigmas[:, -1], "step ends", style, log=log)
    if log and steps.count:
        log_axis(axes)
    else:
        axes.set_ylim(bottom=0.0, top=None if steps.count else 1.0)
    axes.set_ylabel(r"$\sigma$ (relative)", fontsize=FONT_SIZE)
    return f"distance from singular configurations{note}"


def _draw_markers(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    label: str,
    style: dict[str, Any],
    *,
    log: bool = True,
) -> None:
    """Markers that do not overlap; ``log`` if the axis of ``y`` is logarithmic."""
    seen = distinct(x, y, log=log)
    axes.plot(x[seen], y[seen], label=label, **style)


def _step_sizes(axes: Axes, solution: Run, kinds: bool) -> str:
    steps = solution.steps
    mark_times(axes, solution, labelled=not kinds)
    for number, (start, end) in enumerate(steps.stiff_intervals):
        label = None if number else "stiff"
        axes.axvspan(start, end, color=ORANGE, alpha=0.15, linewidth=0.0, label=label)
    starts, lengths = steps.times[:-1], np.diff(steps.times)
    _draw_markers(axes, starts, lengths, "accepted", dots(BLUE, steps.count))
    if kinds:
        in_zone = np.isin(np.arange(steps.count), list(steps.zones))
        for label, chosen, colour, marker, size in (
            ("placed", steps.placements > 0.0, GREEN, "o", 5.5),
            ("in the zone", in_zone, PURPLE, "s", 7.0),
            ("held on their branch", steps.held > 0.0, BLACK, "D", 6.0),
        ):
            if chosen.any():
                style = marks(colour, marker, size if steps.count <= LARGE_DOTS else 0.6 * size)
                _draw_markers(axes, starts[chosen], lengths[chosen], label, style)
    for label, attempts, colour, marker in (
        ("rejected", solution.rejected, VERMILION, "x"),
        ("redone", solution.replaced, BLACK, "+"),
    ):
        if len(attempts):
            _draw_markers(axes, attempts[:, 0], attempts[:, 1], label, marks(colour, marker))
    log_axis(axes)
    axes.set_ylabel(f"step size{seconds(solution)}", fontsize=FONT_SIZE)
    return "steps"


def _errors(axes: Axes, solution: SimulationResult) -> str:
    steps = solution.steps
    mark_times(axes, solution, labelled=False)
    axes.axhline(1.0, color=BLACK, linewidth=0.7, linestyle="--")
    rejected = solution.attempts[solution.attempts["verdict"] == "rejected"]
    for label, t, ratios, style in (
        ("accepted", steps.times[:-1], steps.error_ratios, dots(BLUE, steps.count)),
        ("rejected", rejected["t"], rejected["error_ratio"], marks(VERMILION, "x")),
    ):
        # A step without error, or whose evaluation failed, has no marker.
        known = np.isfinite(ratios) & (ratios > 0.0)
        if known.any():
            _draw_markers(axes, t[known], ratios[known], label, style)
    if steps.count:
        log_axis(axes)
    axes.set_ylabel("error over\ntolerance", fontsize=FONT_SIZE)
    return "error estimates, accepted up to 1"
