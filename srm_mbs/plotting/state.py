"""Positions and rates of joints over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from srm_mbs.plotting.components import Component, chosen_joints, components, noise
from srm_mbs.plotting.panels import (
    draw_line,
    finish,
    mark_times,
    marks_note,
    some_of,
    time_axis,
)
from srm_mbs.plotting.sampling import read_smoothly
from srm_mbs.plotting.style import (
    FONT_SIZE,
    WIDTH,
    legend,
    line_styles,
    linear_axis,
    plain,
    prepare,
    wrapped,
)
from srm_mbs.solution import Solution

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from srm_mbs.arrays import FloatArray

MOST_ROWS = 8
"""Rows of panels that fit on a page."""
LABEL_WIDTH = 16
SEVERAL = (
    "Joints of several degrees of freedom: rotations as vectors (axis times angle); rates in the "
    "moving body's axes."
)


def draw_state(solution: Solution, joints: Sequence[str] | None = None) -> Figure:
    """Position and rate of each joint over time.

    Parameters
    ----------
    joints
        Names of joints; by default all, as far as they fit on a page, and a note names the others.

    Raises
    ------
    InputError
        If there is no such joint.
    """
    names = chosen_joints(solution.mechanism, joints)
    run = read_smoothly(solution)
    rows: list[Component] = []
    left: list[str] = []
    for name in names:
        own = list(components(run, name))
        # Those that were asked for by name are drawn however long the picture gets.
        if joints is None and (left or (rows and len(rows) + len(own) > MOST_ROWS)):
            left.append(name)
        else:
            rows += own
    figure = Figure(figsize=(WIDTH, 0.9 + 1.2 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), 2, sharex=True, squeeze=False)
    for row, pair in zip(rows, panels):
        what = f"{row.what} " if row.what else ""
        name = f"{plain(wrapped(row.joint, LABEL_WIDTH))}\n{what}"
        for axes, values, label, unit, size in zip(
            pair, (row.positions, row.rates), (name, ""), (row.unit, f"{row.unit}/s"), row.sizes
        ):
            _panel(axes, solution, run.t, values, row.names, size, (label, unit))
    for axes, title in zip(panels[0], ("position", "rate")):
        axes.set_title(title, loc="left", fontsize=FONT_SIZE + 0.5)
    for axes in panels.flat:
        legend(axes, beside=False)
    for column in panels.T:
        time_axis(solution, list(column))
        figure.align_ylabels(list(column))
    notes = marks_note(solution)
    if any(len(row.names) > 1 for row in rows):
        notes.append(SEVERAL)
    if left:
        notes.append(
            f"Left out: {some_of(left)}; joints=[...], or --joint, draws those that it names."
        )
    finish(figure, solution, notes)
    return figure


def _panel(
    axes: Axes,
    solution: Solution,
    t: FloatArray,
    values: FloatArray,
    names: tuple[str, ...],
    size: float,
    label: tuple[str, str],
) -> None:
    prepare(axes)
    mark_times(axes, solution, labelled=False)
    factor = linear_axis(axes, [values], *label, size=size, noise=noise(solution))
    for name, own, style in zip(names, np.transpose(values), line_styles(len(names))):
        draw_line(axes, t, own / factor, label=name or None, **style)
