"""Style of all figures, and figures of panels over one time axis.

Colours, line styles, axes, legends, marks and notes, and how figures are saved.  Only Matplotlib's
object interface is used, not pyplot: no display and no global state.
"""

from __future__ import annotations

import string
import textwrap
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
    NullLocator,
    ScalarFormatter,
)
from numpy.typing import NDArray

from srm_mbs.dynamics.scaling import is_angle
from srm_mbs.errors import InputError, get_logger, known_names, safe_repr, time_text
from srm_mbs.formats.files import writing
from srm_mbs.model.anchors import one_degree_joint
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.plotting.sampling import Run, jumps, passages, thinned

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from srm_mbs._typing import FloatArray

log = get_logger(__name__)

FORMATS = (".png", ".pdf", ".svg")
"""Suffixes under which a figure can be saved."""
TEXT_AS_TEXT: dict[Any, Any] = {"pdf.fonttype": 42, "svg.fonttype": "none"}
"""Fonts in a file: journals refuse the Type 3 fonts that are Matplotlib's default in a .pdf, and
programs can change the letters of an .svg only where they are no outlines."""
FEW_DECADES = 50.0
"""Below this ratio of its limits a logarithmic axis has ticks within the decades."""
SMALLEST_LOG_RATIO = 8.0
"""Smallest ratio of the limits of such an axis, so that it always has ticks."""
LARGE_DOTS = 400
"""Largest number of steps with large dots."""
FEW_POINTS = 50
"""Lines through fewer points have markers, without which a single point would be invisible."""
TICK_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
"""Leading digits of the distance of ticks."""
ANGLE_STEPS = (1.0, 1.5, 3.0, 4.5, 9.0, 10.0)
"""Steps between the ticks of an axis in degrees."""
PLAIN_POWERS = range(-2, 4)
"""Powers of ten whose values are written in full at the ticks."""
SMALLEST_RELATIVE_RANGE = 1e-6
"""Smallest range of an axis over its values: ticks that differ in the seventh digit are noise."""

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
"""Colours of lines with their dashes, which distinguish them in grey print."""

WIDE_TICKS, NARROW_TICKS = 10, 5
"""Largest numbers of intervals between the ticks of a horizontal axis, and of one of three side by
side."""
WIDTH = 7.0
"""Width of the figure (inch), within the text of an A4 or letter page."""
FONT_SIZE = 8.5
RESOLUTION = 200
"""Dots per inch of a png."""
TITLE_LINE = 92
"""Characters on the line of a panel's title; longer legends are placed beside the
panel."""
NAME_WIDTH = 22
"""Characters of a line of a legend beside a panel."""
MAX_FULL_LINES = 80
"""Largest number of singular passages that are marked by full lines; more are marked by ticks."""
NOTE_WIDTH = 122
"""Characters of a line of notes below the panels."""
MAX_LISTED_NAMES = 6
"""Most names that a note lists of those that are left out."""
MARKED: tuple[tuple[Callable[[Run], list[float]], str, str, dict[str, Any]], ...] = (
    (
        passages,
        "singular passage",
        "singular passages (dashed)",
        {"color": BLACK, "linewidth": 0.5, "linestyle": (0, (4, 3))},
    ),
    (
        jumps,
        "action of an event",
        "actions of events (dotted)",
        {"color": GREY, "linewidth": 0.9, "linestyle": (0, (1, 1.5))},
    ),
)
"""Vertical lines: their times (s), their meaning in a legend and in a note, and their style."""
PER_TIME = ("", "/s", "/s²")
"""Units of positions, rates and accelerations after that of the positions."""
Draw = Callable[["Axes"], str]
"""Draws into a panel and returns its title."""
Lines = Mapping[str, "FloatArray"]
"""Values (n,) over time, by the name that the legend shows."""


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
            remedy=known_names(FORMATS),
        )


def save(figure: Figure, path: Path, about: str) -> None:
    """Write ``figure`` in the format that the suffix of ``path`` names, whole or not at all.

    Text stays text: TrueType fonts in a .pdf, letters in an .svg.  The metadata of the file have
    the title, and ``about``, the settings of the run.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    suffix = path.suffix.lower()[1:]
    title = figure.get_suptitle().replace("\n", " ")
    metadata = {"Title": title, "Subject" if suffix == "pdf" else "Description": about}
    with writing(path) as file, rc_context(TEXT_AS_TEXT):
        figure.savefig(file, format=suffix, dpi=figure.dpi, metadata=metadata)
    log.info("written: %s", path)


def prepare(axes: Axes, grid: str = "y", size: float = FONT_SIZE) -> None:
    """Ticks, grid (``x``, ``y`` or ``both``) and frame."""
    axes.tick_params(labelsize=size - 0.5, which="both", direction="in")
    axes.grid(axis=grid, color="#E4E4E4", linewidth=0.5)  # type: ignore[arg-type]
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def wrapped(name: str, width: int = NAME_WIDTH) -> str:
    """``name`` in lines of at most ``width`` characters, broken after spaces, or else after "_",
    "-", "." or "/"."""
    lines, rest = [], name
    while len(rest) > width:
        cuts = (max(rest.rfind(mark, 0, width) for mark in marks) + 1 for marks in (" ", "_-./"))
        cut = next((cut for cut in cuts if cut > width // 3), width)
        lines.append(rest[:cut].rstrip())
        rest = rest[cut:]
    return "\n".join([*lines, rest])


def legend_fits(axes: Axes) -> bool:
    """Whether the legend fits on the line of the panel's title."""
    labels = axes.get_legend_handles_labels()[1]
    # A formula between "$" is shorter than its source.
    seen = sum(5 if "$" in label else len(label) for label in labels)
    return seen + 5 * len(labels) + len(axes.get_title(loc="left")) <= TITLE_LINE


def legend(axes: Axes, *, beside: bool) -> None:
    """A legend outside the data: beside the panel, or above it, on the line of its title."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    options: dict[str, Any]
    if beside:
        labels = [label if "$" in label else wrapped(label) for label in labels]
        options = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "handlelength": 2.6}
    else:
        options = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": len(handles)}
        options |= {"borderpad": 0.2, "handlelength": 1.9, "columnspacing": 1.2}
    size = FONT_SIZE - 0.5
    axes.legend(handles, labels, frameon=False, fontsize=size, borderaxespad=0.0, **options)


def line_styles(count: int) -> list[dict[str, Any]]:
    """Colour and dashes of ``count`` lines of a panel; they repeat after the sixth."""
    styles = islice(cycle(LINES), count)
    return [{"color": c, "linestyle": dashes, "linewidth": 0.9} for c, dashes in styles]


def curve(count: int) -> dict[str, Any]:
    """Properties of a line through ``count`` points."""
    return {"linewidth": 0.9, "marker": "." if count < FEW_POINTS else "", "markersize": 3.0}


def dots(colour: str, count: int) -> dict[str, Any]:
    """Properties of one marker for each of ``count`` steps: smaller if there are many."""
    size = 3.5 if count <= LARGE_DOTS else 2.0
    return {"color": colour, "linestyle": "none", "marker": ".", "markersize": size}


def marks(colour: str, marker: str, size: float = 4.0) -> dict[str, Any]:
    """Properties of markers that are not filled."""
    return {
        "color": colour,
        "marker": marker,
        "markersize": size,
        "markeredgewidth": 0.9,
        "fillstyle": "none",
        "linestyle": "none",
    }


def log_axis(axes: Axes) -> None:
    """A logarithmic axis with labelled ticks for any range of its data."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    if high / low < SMALLEST_LOG_RATIO:
        middle, half = np.sqrt(low * high), np.sqrt(SMALLEST_LOG_RATIO)
        axes.set_ylim(middle / half, middle * half)
        low, high = axes.get_ylim()
    if high / low < FEW_DECADES:
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

    The label includes a power of ten: that of Matplotlib would overlap the panel's title.

    Parameters
    ----------
    values
        All values along this axis.
    name, unit
        The label; a name that ends with a line break is placed above the unit.
    size
        Typical magnitude of the values.
    noise
        Changes below this part of ``size`` are drawn as constant; so are those below
        :data:`SMALLEST_RELATIVE_RANGE` of the values.
    axis
        ``x`` or ``y``.
    ticks
        Largest number of intervals between ticks.

    Returns
    -------
    float
        The power of ten by which the values must be divided.
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
    own = getattr(axes, f"{axis}axis")
    own.set_major_locator(MaxNLocator(ticks, steps=TICK_STEPS))
    formatter = ScalarFormatter(useOffset=False)
    formatter.set_scientific(False)
    own.set_major_formatter(formatter)
    prefix = "" if power == 0 else rf"$10^{{{power}}}$ "
    measured = f"{prefix}{unit}".rstrip()
    own.set_label_text(f"{name}({measured})" if measured else name, fontsize=FONT_SIZE)
    if high - low <= max(least, SMALLEST_RELATIVE_RANGE * largest):
        half = max(0.05 * abs(low + high), 0.0 if largest > size else least)
        if max(abs(low), abs(high)) <= least:
            half = size or 1.0
        middle = 0.5 * (low + high)
        axes.set(**{f"{axis}lim": ((middle - half) / factor, (middle + half) / factor)})
    return factor


def plain(name: str) -> str:
    """A name of the user as literal text: neither a formula, nor hidden from legends by its "_"."""
    return f" {name}" if name.startswith("_") else name.replace("$", r"\$")


def finite(values: FloatArray) -> FloatArray:
    """Values with nan where they are not finite: nothing is drawn there."""
    return np.where(np.isfinite(values), values, np.nan)


def largest_size(values: FloatArray) -> float:
    """Largest finite magnitude of ``values``, 0 if there is none."""
    return float(np.nanmax(np.abs(finite(values)), initial=0.0))


def above_zero(values: FloatArray, least: float) -> tuple[FloatArray, str]:
    """Values >= 0 raised to ``least`` for a logarithmic axis, and a note on that for the title."""
    values = finite(values)
    note = f" (zeros drawn at {least:.0e})" if (values < least).any() else ""
    return np.maximum(values, least), note


class Abscissa:
    """The horizontal axis of panels: time, or the position of a joint.

    Parameters
    ----------
    solution
        The run.
    joint
        Name of a joint of one degree of freedom; by default the axis is time.
    unit
        Of the joint: ``rad`` or ``deg`` for angles, ``m`` or ``mm`` for lengths; rad and m by
        default.

    Raises
    ------
    InputError
        If there is no such joint, it has several degrees of freedom, or the unit is not one of its
        positions.
    """

    def __init__(self, solution: Run, joint: str | None = None, unit: str | None = None) -> None:
        self._solution, self._joint = solution, None
        self._factor, self.turns = 1.0, False
        self.label = f"time{seconds(solution)}"
        if joint is None or not isinstance(solution, SimulationResult):
            if unit is not None:
                raise InputError(
                    "it is the unit of the joint on the horizontal axis, and that is time",
                    element="unit",
                    remedy='Give for example x="crank" too, or leave it out',
                )
            return
        model = solution.mechanism.model
        one_degree_joint(model, joint, "x", "Give a joint of one degree of freedom")
        self.turns = is_angle(model, joint)
        factors = {"rad": 1.0, "deg": 180.0 / np.pi} if self.turns else {"m": 1.0, "mm": 1e3}
        unit = next(iter(factors)) if unit is None else unit
        if unit not in factors:
            raise InputError(
                f"joint {joint!r} has no positions in {safe_repr(unit)}",
                element="unit",
                remedy=known_names(factors),
            )
        self._joint, self._factor, self._unit = joint, factors[unit], unit
        self.label = f"{plain(joint)} ({unit})"

    def of(self, run: Run) -> FloatArray:
        """Values (n,) at the times of ``run``."""
        if self._joint is None or not isinstance(run, SimulationResult):
            return run.t
        return self._factor * run.joint(self._joint)[0]

    def at(self, times: Sequence[float]) -> FloatArray:
        """Values (k,) at ``times`` (s)."""
        if self._joint is None or not isinstance(self._solution, SimulationResult):
            return np.asarray(times, dtype=float)
        return self.of(self._solution.at(times))

    def finish(self, panels: Sequence[Axes], ticks: int = WIDE_TICKS) -> None:
        """Limits, label and ticks, with at most ``ticks`` intervals, below the last of ``panels``,
        which share the axis."""
        last = panels[-1]
        last.set_xlabel(self.label, fontsize=FONT_SIZE)
        if self._joint is None:
            start, end = self._solution.span
            margin = 0.01 * (end - start) or 1.0
            last.set_xlim(start - margin, end + margin)
        else:
            for axes in panels:
                axes.margins(x=0.01)
        steps = ANGLE_STEPS if self._factor != 1.0 and self.turns else TICK_STEPS
        last.xaxis.set_major_locator(MaxNLocator(ticks, steps=steps))


def time_panels(
    solution: Run,
    draws: Sequence[Draw],
    notes: Sequence[str] = (),
    height: float = 1.65,
    abscissa: Abscissa | None = None,
) -> Figure:
    """Panels below each other, each of ``height`` (inch) and drawn by one of ``draws``, over time
    or over another ``abscissa``."""
    figure = Figure(figsize=(WIDTH, 0.7 + height * len(draws)), layout="constrained")
    panels = list(figure.subplots(len(draws), sharex=True, squeeze=False)[:, 0])
    # Drift and energy of a divergent state overflow: the curves end there.
    with np.errstate(over="ignore", invalid="ignore"):
        for letter, draw, axes in zip(string.ascii_lowercase, draws, panels):
            prepare(axes)
            title = draw(axes)
            axes.set_title(f"({letter}) {title}", loc="left", fontsize=FONT_SIZE + 0.5)
    # Legends are placed alike: one beside its panel makes all panels narrower.
    beside = not all(legend_fits(axes) for axes in panels)
    for axes in panels:
        legend(axes, beside=beside)
    (Abscissa(solution) if abscissa is None else abscissa).finish(panels)
    figure.align_ylabels(panels)
    finish(figure, solution, notes)
    return figure


def title_columns(
    figure: Figure, panels: NDArray[Any], titles: Sequence[str], abscissa: Abscissa
) -> None:
    """Titles, legends and horizontal axes of ``panels`` (rows, columns); ``titles`` of at least as
    many columns."""
    for axes, title in zip(panels[0], titles):
        axes.set_title(title, loc="left", fontsize=FONT_SIZE + 0.5)
    # Three columns leave no room for legends: that of the first column explains its row.
    narrow = panels.shape[1] > 2
    for axes in (panels[:, :1] if narrow else panels).flat:
        legend(axes, beside=False)
    for column in panels.T:
        abscissa.finish(list(column), NARROW_TICKS if narrow else WIDE_TICKS)
        figure.align_ylabels(list(column))


def finish(figure: Figure, solution: Run, notes: Sequence[str] = ()) -> None:
    """The title of a figure, and the notes below its panels."""
    # A "$" in a name of the user is no formula.
    figure.suptitle(run_title(solution), fontsize=FONT_SIZE + 1.5, parse_math=False)
    if notes:
        text = "\n".join(line for note in notes for line in textwrap.wrap(note, NOTE_WIDTH))
        figure.supxlabel(text, x=0.01, ha="left", fontsize=FONT_SIZE - 1.0, parse_math=False)


def run_title(solution: Run) -> str:
    """Name of the mechanism; status and end time if the run failed."""
    name = solution.mechanism.name if isinstance(solution, SimulationResult) else "index-2 DAE"
    if solution.success:
        return name
    unit = " s" if seconds(solution) else ""
    return f"{name}\n{solution.status} at t = {time_text(solution.span[1])}{unit}"


def settings_of(solution: Run) -> str:
    """Method, tableau, and tolerance or step of a run, for the metadata of a file."""
    settings, unit = solution.settings, " s" if seconds(solution) else ""
    control = f"rtol = {settings.rtol:.3g}"
    if settings.step is not None:
        control = f"fixed step {settings.step:.6g}{unit}"
    parts = [settings.method, settings.tableau, control]
    return "srm_mbs: " + ", ".join(part for part in parts if part)


def seconds(solution: Run) -> str:
    """The unit of time after a word; a DAE has none."""
    return " (s)" if isinstance(solution, SimulationResult) else ""


def some_of(names: Sequence[str]) -> str:
    """The first of ``names``, and how many more there are."""
    shown = ", ".join(names[:MAX_LISTED_NAMES])
    more = len(names) - MAX_LISTED_NAMES
    return shown if more <= 0 else f"{shown} and {more} more"


def draw_line(axes: Axes, x: FloatArray, values: FloatArray, **style: Any) -> None:
    """A line through the distinguishable points, with gaps where they are not finite."""
    values = finite(values)
    if np.all(np.diff(x) >= 0.0):
        seen = thinned(x, values)
    else:  # a curve that turns back keeps the extremes of both coordinates
        number = np.arange(len(x), dtype=float)
        seen = np.union1d(thinned(number, values), thinned(number, x))
    axes.plot(x[seen], values[seen], **style)


def in_panels(lines: Lines) -> list[Lines]:
    """``lines`` in parts of as many as a panel can distinguish."""
    names = list(lines)
    parts = (names[i : i + len(LINES)] for i in range(0, len(names), len(LINES)))
    return [{name: lines[name] for name in part} for part in parts]


def draw_lines(axes: Axes, x: FloatArray, lines: Lines, factor: float) -> None:
    """Lines of different styles through the values over ``factor``, named in the legend."""
    for (name, values), style in zip(lines.items(), line_styles(len(lines))):
        draw_line(axes, x, values / factor, label=plain(name), **style)


def mark_times(
    axes: Axes, solution: Run, *, labelled: bool = True, abscissa: Abscissa | None = None
) -> None:
    """Mark singular passages and actions of events by vertical lines, or by ticks if they are many.

    Parameters
    ----------
    labelled
        Whether the legend explains them; otherwise :func:`marks_note` does.
    abscissa
        The horizontal axis; time by default.
    """
    for times_of, label, _, style in MARKED:
        if times := times_of(solution):
            top = 1.0 if len(times) <= MAX_FULL_LINES else 0.06
            transform, label = axes.get_xaxis_transform(), label if labelled else ""
            at = times if abscissa is None else abscissa.at(times)
            axes.vlines(at, 0.0, top, transform=transform, label=label, **style)


def marks_note(solution: Run) -> list[str]:
    """A note below the panels that explains the vertical lines, if there are any."""
    meanings = [meaning for times_of, _, meaning, _ in MARKED if times_of(solution)]
    return [f"Vertical lines: {'; '.join(meanings)}."] if meanings else []
