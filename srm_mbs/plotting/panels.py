"""Figures of panels over one time axis, with titles, legends, marks and notes."""

from __future__ import annotations

import string
import textwrap
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from srm_mbs.plotting.sampling import Run, jumps, passages, thinned
from srm_mbs.plotting.style import (
    BLACK,
    FONT_SIZE,
    GREY,
    ROUND,
    WIDTH,
    finite,
    fits,
    legend,
    prepare,
)
from srm_mbs.solution import Solution

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from srm_mbs.arrays import FloatArray

FULL_LINES = 80
"""More singular passages than this are marked by ticks: full lines would fill the panels."""
NOTE_WIDTH = 122
"""Characters of a line of notes below the panels."""
SHOWN_NAMES = 6
"""Names that a note lists of those that are left out."""
MARKED: tuple[tuple[str, str, float, Any], ...] = (
    ("singular passages (dashed)", BLACK, 0.5, (0, (4, 3))),
    ("actions of events (dotted)", GREY, 0.9, (0, (1, 1.5))),
)
"""Vertical lines: their meaning in a note, colour, width and dashes."""
Draw = Callable[["Axes"], str]
"""Draws into a panel and returns its title."""


def time_panels(
    solution: Run, draws: Sequence[Draw], notes: Sequence[str] = (), height: float = 1.65
) -> Figure:
    """Panels below each other, each by one of ``draws``, of ``height`` (inch)."""
    figure = Figure(figsize=(WIDTH, 0.7 + height * len(draws)), layout="constrained")
    panels = list(figure.subplots(len(draws), sharex=True, squeeze=False)[:, 0])
    # A state that runs away overflows in its drift and energy: the curves just end there.
    with np.errstate(over="ignore", invalid="ignore"):
        for letter, draw, axes in zip(string.ascii_lowercase, draws, panels):
            prepare(axes)
            title = draw(axes)
            axes.set_title(f"({letter}) {title}", loc="left", fontsize=FONT_SIZE + 0.5)
    # All alike: one beside its panel makes all panels narrower.
    beside = not all(fits(axes, axes.get_title(loc="left")) for axes in panels)
    for axes in panels:
        legend(axes, beside=beside)
    time_axis(solution, panels)
    figure.align_ylabels(panels)
    finish(figure, solution, notes)
    return figure


def time_axis(solution: Run, panels: Sequence[Axes]) -> None:
    """The time of the whole run below the last of ``panels``, which share it."""
    start, end = solution.span
    margin = 0.01 * (end - start) or 1.0
    panels[-1].set_xlim(start - margin, end + margin)
    panels[-1].xaxis.set_major_locator(MaxNLocator(10, steps=ROUND))
    panels[-1].set_xlabel(f"time{seconds(solution)}", fontsize=FONT_SIZE)


def finish(figure: Figure, solution: Run, notes: Sequence[str] = ()) -> None:
    """The title of a figure, and what has to be said below its panels."""
    # Names are the user's: a "$" in them is no formula.
    figure.suptitle(run_title(solution), fontsize=FONT_SIZE + 1.5, parse_math=False)
    if notes:
        text = "\n".join(line for note in notes for line in textwrap.wrap(note, NOTE_WIDTH))
        figure.supxlabel(text, x=0.01, ha="left", fontsize=FONT_SIZE - 1.0, parse_math=False)


def run_title(solution: Run) -> str:
    """Mechanism, method, tableau and tolerance; where the run ended if it failed."""
    settings, unit = solution.settings, " s" if seconds(solution) else ""
    name = solution.mechanism.name if isinstance(solution, Solution) else "index-2 DAE"
    control = f"rtol = {settings.rtol:.3g}"
    if settings.step is not None:
        control = f"fixed step {settings.step:.6g}{unit}"
    parts = [name, settings.method, settings.tableau, control]
    title = ", ".join(part for part in parts if part)
    if not solution.success:
        title += f"\n{solution.status} at t = {solution.span[1]:.6g}{unit}"
    return title


def seconds(solution: Run) -> str:
    """The unit of time behind a word; a DAE has none."""
    return " (s)" if isinstance(solution, Solution) else ""


def some_of(names: Sequence[str]) -> str:
    """The first of ``names``, and how many more there are."""
    shown = ", ".join(names[:SHOWN_NAMES])
    more = len(names) - SHOWN_NAMES
    return shown if more <= 0 else f"{shown} and {more} more"


def draw_line(axes: Axes, t: FloatArray, values: FloatArray, **style: Any) -> None:
    """A line through as many of the points as are seen, with gaps where they are not finite."""
    values = finite(values)
    seen = thinned(t, values)
    axes.plot(t[seen], values[seen], **style)


def mark_times(axes: Axes, solution: Run, *, labelled: bool = True) -> None:
    """Mark singular passages, and where the actions of events changed something.

    By thin vertical lines, or by ticks where they are many.

    Parameters
    ----------
    labelled
        Whether the legend says so; otherwise :func:`marks_note` does.
    """
    for times, label, (_, colour, width, dashes) in zip(
        (passages(solution), jumps(solution)), ("singular passage", "action of an event"), MARKED
    ):
        if times:
            axes.vlines(
                times,
                0.0,
                1.0 if len(times) <= FULL_LINES else 0.06,
                transform=axes.get_xaxis_transform(),
                color=colour,
                linewidth=width,
                linestyle=dashes,
                label=label if labelled else "",
            )


def marks_note(solution: Run) -> list[str]:
    """What the vertical lines are, as a note below the panels; none where there are none."""
    there = (bool(passages(solution)), bool(jumps(solution)))
    words = [words for shown, (words, *_) in zip(there, MARKED) if shown]
    return [f"Vertical lines: {'; '.join(words)}."] if words else []
