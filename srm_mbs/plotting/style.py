"""One look for all pictures: colours, line styles, axes, legends, and how figures are saved.

Matplotlib's object interface only: no pyplot, so no display and no global state.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
    ScalarFormatter,
)

from srm_mbs.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srm_mbs.arrays import FloatArray

log = logging.getLogger(__name__)

FORMATS = (".png", ".pdf", ".svg")
"""Suffixes under which a figure can be saved."""
FEW_DECADES = 50.0
"""Below this ratio of its limits a logarithmic axis has ticks within the decades."""
NARROWEST = 8.0
"""Smallest ratio of the limits of such an axis, so that there are always ticks on it."""
LARGE_DOTS = 400
"""Up to this many steps their dots are large."""
FEW_POINTS = 50
"""Lines through fewer points have dots on them, without which a single one would be invisible."""
ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)
"""First digits of the distance of ticks."""
PLAIN_POWERS = range(-2, 4)
"""Powers of ten of values that are written in full on the ticks."""
NARROW = 1e-6
"""Smallest length of an axis over its values: ticks that differ in the seventh digit are noise."""

# Okabe and Ito's palette: distinct for the colour-blind, and of different lightness in print.
BLACK, BLUE, VERMILION, GREY = "#000000", "#0072B2", "#D55E00", "#8C8C8C"
GREEN, ORANGE, PURPLE, SKY = "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
PALETTE = (BLACK, ORANGE, BLUE, GREEN, VERMILION, PURPLE, SKY, GREY)
LINES: tuple[tuple[str, Any], ...] = (
    (BLUE, "-"),
    (VERMILION, (0, (5, 1.5))),
    (BLACK, (0, (1.2, 1.2))),
    (GREEN, (0, (6, 1.5, 1.2, 1.5))),
    (ORANGE, (0, (9, 2))),
    (PURPLE, (0, (4, 1.2, 1.2, 1.2, 1.2, 1.2))),
)
"""Colours of lines with their dashes, by which they are told apart in grey print."""

WIDTH = 7.0
"""Width of the figure (inch), within the text of an A4 or letter page."""
FONT_SIZE = 8.5
RESOLUTION = 200
"""Dots per inch of a png."""
TITLE_LINE = 92
"""Characters on the line of a panel's title; a legend that does not fit stands beside the panel."""
NAME_WIDTH = 22
"""Characters of a line of a legend beside a panel."""


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
            remedy=f"Known: {', '.join(FORMATS)}",
        )


def save(figure: Figure, path: Path) -> None:
    """Write ``figure`` in the format that the suffix of ``path`` names.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    figure.savefig(path, format=path.suffix.lower()[1:], dpi=RESOLUTION)
    log.info("written: %s", path)


def prepare(axes: Axes, grid: str = "y", size: float = FONT_SIZE) -> None:
    """Ticks, grid (``x``, ``y`` or ``both``) and frame."""
    axes.tick_params(labelsize=size - 0.5, which="both", direction="in")
    axes.grid(axis=grid, color="#E4E4E4", linewidth=0.5)  # type: ignore[arg-type]
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def wrapped(name: str, width: int = NAME_WIDTH) -> str:
    """``name`` in lines of at most ``width`` characters, broken behind spaces, or else behind "_",
    "-", "." or "/", where there are any."""
    lines, rest = [], name
    while len(rest) > width:
        cuts = (max(rest.rfind(mark, 0, width) for mark in marks) + 1 for marks in (" ", "_-./"))
        cut = next((cut for cut in cuts if cut > width // 3), width)
        lines.append(rest[:cut].rstrip())
        rest = rest[cut:]
    return "\n".join([*lines, rest])


def fits(axes: Axes, title: str, line: int = TITLE_LINE) -> bool:
    """Whether the legend has room on the line of the panel's ``title``, of ``line`` characters."""
    labels = axes.get_legend_handles_labels()[1]
    # A "$" of a formula is not seen, nor is the command between it and its pair.
    seen = sum(5 if "$" in label else len(label) for label in labels)
    return seen + 5 * len(labels) + len(title) <= line


def legend(axes: Axes, *, beside: bool) -> None:
    """A legend where there are no data: beside the panel, or above it, on the line of its title."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    options: dict[str, Any] = {"frameon": False, "fontsize": FONT_SIZE - 0.5}
    options["borderaxespad"] = 0.0
    if beside:
        labels = [label if "$" in label else wrapped(label) for label in labels]
        options |= {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "handlelength": 2.6}
    else:
        options |= {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": len(handles)}
        options |= {"borderpad": 0.2, "handlelength": 1.9, "columnspacing": 1.2}
    axes.legend(handles, labels, **options)


def line_styles(count: int) -> list[dict[str, Any]]:
    """Colour and dashes of ``count`` lines of a panel; behind the sixth they begin again."""
    styles = islice(cycle(LINES), count)
    return [{"color": c, "linestyle": dashes, "linewidth": 0.9} for c, dashes in styles]


def curve(count: int) -> dict[str, Any]:
    """Properties of a line through ``count`` points."""
    return {"linewidth": 0.9, "marker": "." if count < FEW_POINTS else "", "markersize": 3.0}


def dots(count: int) -> dict[str, Any]:
    """Properties of one mark per step: smaller where there are many."""
    size = 3.5 if count <= LARGE_DOTS else 2.0
    return {"linestyle": "none", "marker": ".", "markersize": size}


def marks(colour: str, marker: str, size: float = 4.0) -> dict[str, Any]:
    """Properties of marks that are not filled."""
    return {
        "color": colour,
        "marker": marker,
        "markersize": size,
        "markeredgewidth": 0.9,
        "fillstyle": "none",
        "linestyle": "none",
    }


def log_axis(axes: Axes) -> None:
    """A logarithmic axis with labelled ticks, whatever the range of its data."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    if high / low < FEW_DECADES:
        if high / low < NARROWEST:
            middle = np.sqrt(low * high)
            axes.set_ylim(middle / np.sqrt(NARROWEST), middle * np.sqrt(NARROWEST))
        low, high = axes.get_ylim()
        subs = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if high / low < 10.0 else (1.0, 2.0, 5.0)
        axes.yaxis.set_major_locator(LogLocator(subs=subs))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        axes.yaxis.set_major_locator(LogLocator(numticks=6))
        axes.yaxis.set_minor_formatter(NullFormatter())


def linear_axis(
    axes: Axes,
    values: Sequence[FloatArray],
    name: str,
    unit: str,
    *,
    size: float = 1.0,
    noise: float = 1e-9,
    axis: str = "y",
    ticks: int = 5,
) -> float:
    """Label and few ticks, written in full, of an axis for ``values``.

    A power of ten goes into the label: matplotlib's own would lie on the panel's title.

    Parameters
    ----------
    values
        All that is drawn along this axis.
    name, unit
        The label; a name that ends with a line break stands above the unit.
    size
        What is of ordinary size here.
    noise
        Changes below this part of it are no motion, and drawn as constant; so are those below
        :data:`NARROW` of the values.
    axis
        ``x`` or ``y``.
    ticks
        Intervals between ticks, at most.

    Returns
    -------
    float
        The power of ten: divide by it what is drawn.
    """
    known = [v[np.isfinite(v)] for v in values]
    low = min((float(v.min()) for v in known if v.size), default=0.0)
    high = max((float(v.max()) for v in known if v.size), default=0.0)
    largest = max(abs(low), abs(high))
    least = noise * size
    if not largest > least:
        largest = size
    power = int(np.floor(np.log10(largest))) if largest > 0.0 else 0
    power = 0 if power in PLAIN_POWERS else power
    factor = 10.0**power
    own = axes.yaxis if axis == "y" else axes.xaxis
    own.set_major_locator(MaxNLocator(ticks, steps=ROUND))
    formatter = ScalarFormatter(useOffset=False)
    formatter.set_scientific(False)
    own.set_major_formatter(formatter)
    prefix = "" if power == 0 else rf"$10^{{{power}}}$ "
    measured = f"{prefix}{unit}".rstrip()
    own.set_label_text(f"{name}({measured})" if measured else name, fontsize=FONT_SIZE)
    if high - low <= max(least, NARROW * largest):
        half = max(0.1 * abs(0.5 * (low + high)), 0.0 if largest > size else least)
        if max(abs(low), abs(high)) <= least:
            half = size or 1.0
        ends = (0.5 * (low + high) - half) / factor, (0.5 * (low + high) + half) / factor
        (axes.set_ylim if axis == "y" else axes.set_xlim)(*ends)
    return factor


def plain(name: str) -> str:
    """A name of the user as it is: neither a formula, nor hidden from legends by its "_"."""
    return f" {name}" if name.startswith("_") else name.replace("$", r"\$")


def finite(values: FloatArray) -> FloatArray:
    """Values with gaps where they are not finite: nothing is drawn there."""
    return np.where(np.isfinite(values), values, np.nan)
