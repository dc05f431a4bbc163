"""The difference of two runs over time: what a certificate takes for the error of one of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.plotting.panels import mark_times, time_panels
from srm_mbs.plotting.style import FONT_SIZE, line_styles, log_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srm_mbs.analysis.comparison import Comparison
    from srm_mbs.solution import Solution

DECADES = 1e-9
"""Least difference that is drawn, over the largest: none at the start would make the axis long."""


def draw_errors(solution: Solution, comparison: Comparison) -> Figure:
    """Largest difference of positions and of rates, in units, over time."""
    size = comparison.size
    lowest = DECADES * comparison.largest
    size = np.where(size > lowest, size, np.nan)

    def draw(axes: Axes) -> str:
        mark_times(axes, solution)
        for label, values, style in zip(("positions", "rates"), size.T, line_styles(2)):
            axes.plot(comparison.t, values, label=label, **style)
        log_axis(axes)
        axes.set_ylabel("largest difference\n(relative to units)", fontsize=FONT_SIZE)
        return "difference to the other run"

    return time_panels(solution, [draw], height=2.3)
