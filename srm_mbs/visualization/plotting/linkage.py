"""Kinematics of a linkage over its crank: positions, ratios, transmission angle."""

from __future__ import annotations

import string
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import is_angle
from srm_mbs.visualization.plotting.figure import (
    ANGLE_STEPS,
    FONT_SIZE,
    RESOLUTION,
    TICK_STEPS,
    WIDTH,
    Lines,
    draw_lines,
    finite,
    in_panels,
    legend,
    legend_fits,
    linear_axis,
    plain,
    prepare,
)

LARGEST_RATIO = 20.0
"""Median of a ratio above this multiple of which it is cut: it grows without bound at limits."""


def draw_linkage(
    mechanism: Mechanism,
    crank: str,
    positions: FloatArray,
    joints: Mapping[str, FloatArray],
    ratios: Mapping[str, FloatArray],
    transmission_angle: FloatArray | None,
) -> Figure:
    """Panels over the ``positions`` (n,) of the ``crank``: those of the other ``joints``, in
    degrees or m, their ``ratios`` dq/dq_crank, and the transmission angle (rad) if there is one."""
    model = mechanism.model
    turning = is_angle(model, crank)
    panels: list[tuple[Lines, str, str, str]] = []
    for angles, unit, factor in ((True, "deg", 180.0 / np.pi), (False, "m", 1.0)):
        own = {name: factor * x for name, x in joints.items() if is_angle(model, name) == angles}
        panels += [(part, "position ", unit, "joints") for part in in_panels(own)]
    for angles, unit in ((True, "rad"), (False, "m")):
        per = f"{unit}/{'rad' if turning else 'm'}"
        own = {
            name: _cut(ratio) for name, ratio in ratios.items() if is_angle(model, name) == angles
        }
        title = f"motion of joints over that of {plain(crank)}"
        panels += [(part, "ratio ", per, title) for part in in_panels(own)]
    if transmission_angle is not None:
        shown = {"transmission angle": np.degrees(transmission_angle)}
        panels.append((shown, "angle ", "deg", "transmission angle"))
    figure = Figure(figsize=(WIDTH, 0.7 + 1.65 * len(panels)), layout="constrained", dpi=RESOLUTION)
    rows = list(figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0])
    x = np.degrees(positions) if turning else positions
    for letter, axes, (lines, name, unit, title) in zip(string.ascii_lowercase, rows, panels):
        prepare(axes)
        factor = linear_axis(axes, [*lines.values()], name, unit, size=0.0)
        draw_lines(axes, x, lines, factor)
        axes.set_title(f"({letter}) {title}", loc="left", fontsize=FONT_SIZE + 0.5)
    beside = not all(legend_fits(axes) for axes in rows)
    for axes in rows:
        legend(axes, beside=beside)
    rows[-1].set_xlabel(f"{plain(crank)} ({'deg' if turning else 'm'})", fontsize=FONT_SIZE)
    rows[-1].margins(x=0.01)
    steps = ANGLE_STEPS if turning else TICK_STEPS
    rows[-1].xaxis.set_major_locator(MaxNLocator(10, steps=steps))
    figure.align_ylabels(rows)
    figure.suptitle(mechanism.name, fontsize=FONT_SIZE + 1.5, parse_math=False)
    return figure


def _cut(ratio: FloatArray) -> FloatArray:
    """A ratio, with nan where it is far larger than usual."""
    known = finite(ratio)
    return np.where(np.abs(known) <= LARGEST_RATIO * np.nanmedian(np.abs(known)), known, np.nan)
