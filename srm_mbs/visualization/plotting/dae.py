"""Plots of a run of a DAE, which has neither joints nor units."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.simulation.dae_result import DaeResult
from srm_mbs.visualization.plotting.figure import (
    BLACK,
    FONT_SIZE,
    LINES,
    Draw,
    curve,
    draw_line,
    finite,
    line_styles,
    linear_axis,
    log_axis,
    some_of,
    time_panels,
)
from srm_mbs.visualization.plotting.run import SMALLEST_DRIFT, sigma_panel, step_panel
from srm_mbs.visualization.plotting.sampling import between

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srm_mbs._typing import FloatArray

MAX_LINES = 4 * len(LINES)
"""Most lines of states, or of multipliers, on a page."""


def draw_dae_run(solution: DaeResult) -> Figure:
    """Drift at ``solution.t``, sigma and step sizes."""
    drift: Draw = partial(_drift, solution=solution)
    return time_panels(solution, [drift, sigma_panel(solution), step_panel(solution)])


def draw_dae_state(solution: DaeResult) -> Figure:
    """States and multipliers over time, several lines in a panel."""
    ends = solution.steps.times[solution.steps.times < solution.span[1]]
    t = between(np.append(ends, solution.span[1]), solution.steps.count)
    x, y = solution(t)
    draws: list[Draw] = []
    left: list[str] = []
    for letter, values, title in (("x", x, "states"), ("y", y, "multipliers")):
        names = [f"{letter}[{i}]" for i in range(values.shape[1])]
        left += names[MAX_LINES:]
        for first in range(0, min(len(names), MAX_LINES), len(LINES)):
            own = slice(first, min(first + len(LINES), MAX_LINES))
            draws.append(partial(_lines, t=t, values=values[:, own], names=names[own], title=title))
    notes = [f"Left out: {some_of(left)}."] if left else []
    return time_panels(solution, draws, notes)


def _drift(axes: Axes, solution: DaeResult) -> str:
    drift = finite(solution.drift)
    shown = np.maximum(drift, SMALLEST_DRIFT)
    draw_line(axes, solution.t, shown, color=BLACK, **curve(len(shown)))
    log_axis(axes)
    axes.set_ylabel(r"$\Vert g\Vert$", fontsize=FONT_SIZE)
    floor = bool((drift < SMALLEST_DRIFT).any())
    return "constraint errors" + (f" (zeros drawn at {SMALLEST_DRIFT:.0e})" if floor else "")


def _lines(axes: Axes, t: FloatArray, values: FloatArray, names: list[str], title: str) -> str:
    factor = linear_axis(axes, [values], title, "", size=0.0)
    for name, own, style in zip(names, values.T, line_styles(len(names))):
        draw_line(axes, t, own / factor, label=name, **style)
    return title
