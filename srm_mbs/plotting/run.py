"""The run plot: drift, energy, sigma and step sizes over time."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.plotting.panels import Draw, draw_line, time_panels
from srm_mbs.plotting.sampling import constrained
from srm_mbs.plotting.steps import sigma_panel, step_panel
from srm_mbs.plotting.style import (
    BLACK,
    FONT_SIZE,
    VERMILION,
    curve,
    finite,
    linear_axis,
    log_axis,
)
from srm_mbs.solution import Solution
from srm_mbs.systems.units import row_dimensions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALLEST_DRIFT = 1e-17
"""Drift that is exactly zero is drawn here, since a logarithmic axis has no zero."""


def draw_run(solution: Solution) -> Figure:
    """Drift, energy, sigma and step sizes of a run over time, in panels with one time axis.

    Drift and energy are drawn at ``solution.t``, sigma and step sizes at the steps.  Without
    loops there is neither drift nor sigma, and their panels are left out.
    """
    energy: Draw = partial(_energy, solution=solution)
    draws = [energy, step_panel(solution)]
    if constrained(solution):
        drift: Draw = partial(_drift, solution=solution)
        draws = [drift, energy, sigma_panel(solution), step_panel(solution)]
    return time_panels(solution, draws)


def _drift(axes: Axes, solution: Solution) -> str:
    found = {part for each in solution.segments for part in row_dimensions(each.mechanism)}
    parts = [part for part in ("m", "rad") if part in found]
    units = (", ".join(parts), ", ".join(f"{part}/s" for part in parts))
    names = (r"$\Vert g\Vert$", r"$\Vert G\,v\Vert$")
    drift = np.maximum(finite(solution.drift), SMALLEST_DRIFT)
    # The positions as dots: at round-off a line would jump to and fro between a few values.
    rate = {"color": VERMILION, **curve(len(solution.t))}
    position = {"color": BLACK, "linestyle": "none", "marker": ".", "markersize": 2.0}
    for column, style in ((1, rate), (0, position)):
        label = f"{names[column]} ({units[column]})"
        draw_line(axes, solution.t, drift[:, column], label=label, **style)
    log_axis(axes)
    axes.set_ylabel("drift", fontsize=FONT_SIZE)
    floor = finite(solution.drift) < SMALLEST_DRIFT
    return "closure errors" + (f" (zeros drawn at {SMALLEST_DRIFT:.0e})" if floor.any() else "")


def _energy(axes: Axes, solution: Solution) -> str:
    change = finite(solution.energy - solution.energy[:1])
    factor = linear_axis(axes, [change], "energy change\n", "J", size=0.0)
    draw_line(axes, solution.t, change / factor, color=BLACK, **curve(len(change)))
    from_start = not len(solution.t) or solution.t[0] == solution.steps.times[0]
    since = "the start" if from_start else f"t = {solution.t[0]:.6g} s"
    return f"total energy relative to {since}"
