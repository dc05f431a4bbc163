"""Size and resolution of a figure: those of a journal's column or page, or any number of inches."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from srm_mbs.errors import InputError, safe_repr
from srm_mbs.model.numbers import finite_array
from srm_mbs.visualization.plotting.figure import (
    FONT_SIZE,
    NOTE_WIDTH,
    TITLE_LINE,
    WIDTH,
    wrapped,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srm_mbs._typing import FloatArray

WIDTHS = {"column": 3.5, "page": WIDTH}
"""Widths (inch) by name: one column of a two-column journal (89 mm), and the text of a page."""
LARGEST_SIZE = 100.0
"""Largest width or height (inch) of a figure."""
RESOLUTIONS = (20.0, 2400.0)
"""Smallest and largest dots per inch of a .png."""
MAX_PIXELS = 4e8
"""Most pixels of a .png: an A0 poster at 500 dots per inch."""
NARROW = 0.75 * WIDTH
"""Width (inch) below which titles are broken and legends stand below them."""
LEGEND_ROOM = 2.0
"""Space (points) between a legend and the title above it."""
USED = 0.8
"""Part of the width of a narrow figure that a panel has: the rest are labels of its axis."""
MIN_TICKS = 2
"""Fewest intervals of a horizontal axis."""
LEGEND: dict[str, Any] = {
    **{"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "frameon": False},
    **{"borderaxespad": 0.0, "borderpad": 0.2, "handlelength": 1.9, "columnspacing": 1.0},
}
SMALLEST_HEIGHT = 2.4
"""Height (inch) below which a picture with equal axes is not scaled."""

Size = str | tuple[float, float]


def checked_size(size: Any) -> Size:
    """Width and height (inch) of a figure, or a name of :data:`WIDTHS`.

    Raises
    ------
    InputError
        Unless ``size`` is such a name, or two positive numbers of at most LARGEST_SIZE.
    """
    if isinstance(size, str) and size in WIDTHS:
        return size
    numbers = finite_array(size, (2,))
    if numbers is None or not np.all((numbers > 0.0) & (numbers <= LARGEST_SIZE)):
        raise InputError(
            f"{safe_repr(size)} is not the size of a figure",
            element="size",
            remedy='Give "column", "page", or width and height in inches, (7.0, 5.0) for example, '
            f"up to {LARGEST_SIZE:g}",
        )
    return float(numbers[0]), float(numbers[1])


def checked_resolution(dpi: Any) -> float:
    """Dots per inch of a .png.

    Raises
    ------
    InputError
        Unless it is a number within :data:`RESOLUTIONS`.
    """
    number = finite_array(dpi, ())
    low, high = RESOLUTIONS
    if number is None or not low <= number <= high:
        raise InputError(
            f"{safe_repr(dpi)} is not a number of dots per inch",
            element="dpi",
            remedy=f"Give a number from {low:g} to {high:g}, for example 300",
        )
    return float(number)


def set_size(figure: Figure, size: Size) -> None:
    """Give a figure its size, and lay out anew what a narrow one would cut."""
    width, height = figure.get_size_inches()
    if isinstance(size, tuple):
        width, height = size
    else:
        if any(axes.get_aspect() == 1.0 for axes in figure.axes):
            height = max(height * WIDTHS[size] / width, min(height, SMALLEST_HEIGHT))
        width = WIDTHS[size]
    figure.set_size_inches(width, height)
    if width < NARROW:
        _narrow(figure, width / WIDTH)


def check_pixels(figure: Figure) -> None:
    """Refuse a picture of more pixels than a program opens.

    Raises
    ------
    InputError
        If it has more than :data:`MAX_PIXELS`.
    """
    pixels: FloatArray = figure.get_size_inches() * figure.dpi
    if math.prod(pixels) > MAX_PIXELS:
        raise InputError(
            f"a .png would have {pixels[0]:.0f} by {pixels[1]:.0f} pixels",
            element="dpi",
            remedy="Give a smaller size or fewer dots per inch, or save it as .pdf",
        )


def _narrow(figure: Figure, part: float) -> None:
    """Fit titles, notes, legends and ticks to ``part`` of the usual width."""
    title, notes = figure.get_suptitle(), figure.get_supxlabel()
    if title:
        lines = title.splitlines()
        label = "\n".join(wrapped(line, int(USED * TITLE_LINE * part)) for line in lines)
        figure.suptitle(label, fontsize=FONT_SIZE + 1.5, parse_math=False)
    if notes:
        joined = " ".join(notes.splitlines())
        label = textwrap.fill(joined, int(NOTE_WIDTH * part))
        figure.supxlabel(label, x=0.01, ha="left", fontsize=FONT_SIZE - 1.0, parse_math=False)
    # "acceleration" above the last of three columns.
    columns = max((_columns(axes) for axes in figure.axes), default=1)
    font = FONT_SIZE + (0.5 if columns < 3 else -2.0)
    for axes in figure.axes:
        if own := axes.get_title(loc="left"):
            room = int(USED * TITLE_LINE * part / columns)
            label = textwrap.fill(own, room, break_long_words=False)
            axes.set_title(label, loc="left", fontsize=font)
        locator = axes.xaxis.get_major_locator()
        if isinstance(locator, MaxNLocator):
            locator.set_params(nbins=max(MIN_TICKS, round(10 * part / columns)))
        _legend_below_title(figure, axes, USED * WIDTH * part / columns, font)


def _columns(axes: Axes) -> int:
    spec = axes.get_subplotspec()
    return 1 if spec is None else spec.get_gridspec().ncols


def _legend_below_title(figure: Figure, axes: Axes, width: float, font: float) -> None:
    """Put the legend between the title, in size ``font``, and the panel, of ``width`` (inch)."""
    legend = axes.get_legend()
    if legend is None or not axes.axison:
        return
    handles, labels = axes.get_legend_handles_labels()
    size = legend.get_texts()[0].get_fontsize()
    for count in range(len(labels), 0, -1):
        legend = axes.legend(handles, labels, ncols=count, fontsize=size, **LEGEND)
        extent = legend.get_window_extent()
        if extent.width <= figure.dpi * width:
            break
    pad = extent.height * 72.0 / figure.dpi + LEGEND_ROOM
    title = axes.get_title(loc="left")
    axes.set_title(title, loc="left", fontsize=font, pad=pad)
