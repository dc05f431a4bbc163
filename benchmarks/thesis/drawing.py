"""How the pictures look: one style, small files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from PIL import Image

from benchmarks.thesis.entries import Rows
from srm_mbs.visualization.plotting.figure import BLACK, BLUE, GREY, VERMILION, prepare
from srm_mbs.visualization.plotting.figure import PALETTE as COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["BLACK", "BLUE", "COLOURS", "GREY", "MARKERS", "VERMILION"]

MARKERS = "osD^vP*X"
WIDTH, FONT_SIZE = 6.6, 8.0
RESOLUTION = 100
PALETTE = 64
"""Colours of a PNG: enough for smooth lines, and a third of the size."""
LONGEST_LINE = 80
"""Characters of numbers up to which print and ours stand side by side in a table."""
ADVANCE = 0.602
"""Width of a character of the tables' font over its size."""
APART = 0.1
"""Orders that differ by more are marked in the tables."""


def panels(rows: int, height: float, columns: int = 1, **options: Any) -> tuple[Figure, Any]:
    """A figure of ``height`` (inch) with axes in the style of the pictures."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for one in axes.ravel():
        prepare(one, "both", FONT_SIZE)
    return figure, axes


def label(axes: Axes, x: str = "", y: str = "", title: str = "") -> None:
    """Labels with units, and the panel's title."""
    axes.set_xlabel(x, fontsize=FONT_SIZE)
    axes.set_ylabel(y, fontsize=FONT_SIZE)
    axes.set_title(title, loc="left", fontsize=FONT_SIZE + 0.5)


def legend(axes: Axes, beside: bool = False, **options: Any) -> None:
    """A legend in the panel, or to its right."""
    if beside:
        options |= {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "borderaxespad": 0.0}
    axes.legend(fontsize=FONT_SIZE - 1.0, frameon=False, **options)


def save(figure: Figure, path: Path) -> None:
    """As a PNG with a small palette."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=RESOLUTION)
    picture = Image.open(buffer).convert("RGB")
    small = picture.quantize(PALETTE, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


def shown(value: Any) -> str:
    """A cell of a table."""
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def differs(printed: Any, ours: Any) -> bool:
    """Whether two cells differ by more than :data:`APART`; decimal strings by any digit."""
    if isinstance(printed, (int, float)) and isinstance(ours, (int, float)):
        return abs(printed - ours) > APART
    return bool(printed != ours)


def draw_table(path: Path, title: str, printed: Rows, ours: Rows) -> None:
    """Printed and our values side by side, or below each other where the numbers are long.

    Cells that differ are marked by an asterisk.
    """
    columns = list(next(iter(printed.values())))
    width = max(len(shown(v)) for row in printed.values() for v in row.values())
    names = max(len(name) for name in printed)
    stacked = 2 * len(columns) * (width + 2) > LONGEST_LINE
    # Columns of characters: print and ours, or a word that says which.
    pitch = width + 3 if stacked else 2 * (width + 3)
    first = names + (9 if stacked else 2)
    lines = (2 if stacked else 1) * len(printed) + (2 if stacked else 3)
    advance = 0.96 / max(first + len(columns) * pitch, 60)
    figure = Figure(figsize=(WIDTH, 0.12 + 0.19 * lines))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    size = min(FONT_SIZE, 72 * WIDTH * advance / ADVANCE)

    def write(column: float, line: int, text: str, **style: Any) -> None:
        style = {"family": "DejaVu Sans Mono", "fontsize": size} | style
        axes.text(0.02 + advance * column, 1.0 - (line + 0.65) / lines, text, **style)

    def cell(column: float, line: int, print_: Any, own: Any) -> None:
        mark = "*" if differs(print_, own) else ""
        write(column, line, shown(own) + mark, color=VERMILION if mark else BLUE)

    write(0, 0, title, family="DejaVu Sans", fontsize=FONT_SIZE + 0.5, weight="bold")
    for k, column in enumerate(columns):
        write(first + k * pitch, 1, column.replace("eps", "ε"), weight="bold")
        if not stacked:
            write(first + k * pitch, 2, "print")
            write(first + k * pitch + width + 3, 2, "ours", color=BLUE)
    line = 2 if stacked else 3
    for row, cells in printed.items():
        write(0, line, row)
        if stacked:
            write(names + 2, line, "print")
            write(names + 2, line + 1, "ours", color=BLUE)
        for k, column in enumerate(columns):
            at = first + k * pitch
            write(at, line, shown(cells[column]))
            if stacked:
                cell(at, line + 1, cells[column], ours[row][column])
            else:
                cell(at + width + 3, line, cells[column], ours[row][column])
        line += 2 if stacked else 1
    save(figure, path)
