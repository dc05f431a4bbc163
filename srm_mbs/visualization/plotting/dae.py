"""Plots of a run of a DAE, which has neither joints nor units."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.simulation.dae_result import DaeResult
from srm_mbs.visualization.plotting.figure import (
    BLACK,
    FONT_SIZE,
    Draw,
    Lines,
    above_zero,
    curve,
    draw_line,
    draw_lines,
    in_panels,
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

MAX_PANELS = 4
"""Most panels of states, or of multipliers, on a page."""


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
        panels = in_panels({f"{letter}[{i}]": own for i, own in enumerate(values.T)})
        draws += [partial(_lines, t=t, lines=part, title=title) for part in panels[:MAX_PANELS]]
        left += [name for part in panels[MAX_PANELS:] for name in part]
    notes = [f"Left out: {some_of(left)}."] if left else []
    return time_panels(solution, draws, notes)


def _drift(axes: Axes, solution: DaeResult) -> str:
    drift, note = above_zero(solution.drift, SMALLEST_DRIFT)
    draw_line(axes, solution.t, drift, color=BLACK, **curve(len(drift)))
    log_axis(axes)
    axes.set_ylabel(r"$\Vert g\Vert$", fontsize=FONT_SIZE)
    return f"constraint errors{note}"


def _lines(axes: Axes, t: FloatArray, lines: Lines, title: str) -> str:
    draw_lines(axes, t, lines, linear_axis(axes, [*lines.values()], title, "", size=0.0))
    return title
