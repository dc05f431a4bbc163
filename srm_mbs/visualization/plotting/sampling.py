"""Sampling of a run for a plot: at which times, and which points a plot can distinguish."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.errors import ControllerError, EvaluationError, InputError
from srm_mbs.simulation.dae_result import DaeResult
from srm_mbs.simulation.result import SimulationResult

PIECES_PER_STEP = 8
"""Number of parts of each step: curves bend between the ends of steps of high order."""
MIN_PIECES = 240
"""Smallest number of parts of a run of few steps."""
MAX_PIECES = 12_000
"""Number of parts from which steps are divided no further."""
COLUMNS, ROWS = 1600, 800
"""Resolution of a plot: about twice as many as a page or a screen distinguishes."""


Run = SimulationResult | DaeResult


def passages(solution: Run) -> list[float]:
    """Times (s) of the singular passages; a DAE has none."""
    found = solution.crossings if isinstance(solution, SimulationResult) else ()
    return [crossing.time for crossing in found]


def jumps(solution: Run) -> list[float]:
    """Times (s) of the actions of events."""
    if not isinstance(solution, SimulationResult):
        return []
    return [segment.span[0] for segment in solution.segments[1:]]


def constrained(solution: SimulationResult) -> bool:
    """Whether any segment of the run has closures or drives."""
    return any(segment.mechanism.constrained for segment in solution.segments)


def read_smoothly(solution: SimulationResult, most: int = MAX_PIECES) -> SimulationResult:
    """The run at the ends of its steps and between them, so that curves are smooth.

    The times increase.  Each action of an event has two: the preceding floating-point number, with
    the state before the jump, and its own time, with the state after it.

    Parameters
    ----------
    most
        Number of parts from which steps are divided no further: smaller for quantities that are
        slow to compute.
    """
    *_, last = segments = solution.segments
    parts = []
    for segment in segments:
        start, end = segment.span
        if segment is not last:
            if not end > start:
                continue
            end = np.nextafter(end, start)
        times = segment.steps.times
        parts.append(between(np.append(times[times < end], end), solution.steps.count, most))
    times = np.unique(np.concatenate(parts))
    if np.array_equal(times, solution.t):
        return solution  # keeps quantities that it has computed
    return solution.at(times)


def read_forces(
    solution: SimulationResult, read: Callable[[Any], Any], most: int = MAX_PIECES
) -> SimulationResult:
    """Values as of :func:`read_smoothly`; without the end of a failed run if ``read``, which needs
    the equations of motion, cannot be evaluated there.

    Raises
    ------
    InputError
        If there is nothing else.
    """
    run = read_smoothly(solution, most)
    try:
        read(run)
    except (ControllerError, EvaluationError) as error:
        if solution.success:
            raise
        if len(run.t) < 2:
            raise InputError(
                f"the run has no forces: {error}",
                element="kind",
                remedy='Draw another kind, for example "state"',
            ) from error
        run = solution.at(run.t[:-1])
    return run


def between(ends: FloatArray, steps: int, most: int = MAX_PIECES) -> FloatArray:
    """The ``ends`` (n,) of steps with times between them, in a run of ``steps`` steps."""
    steps = max(1, steps)
    pieces = max(1, min(max(PIECES_PER_STEP, -(-MIN_PIECES // steps)), most // steps))
    inside = np.arange(pieces) / pieces
    return np.append(ends[:-1, None] + np.diff(ends)[:, None] * inside, ends[-1])


def with_gaps(solution: SimulationResult, t: FloatArray, values: FloatArray) -> FloatArray:
    """``values`` (n,) at increasing times ``t`` (n,) s, with a nan before each jump."""
    return np.insert(values, np.searchsorted(t, jumps(solution)), np.nan)


def thinned(t: FloatArray, values: FloatArray) -> IndexArray:
    """Indices of the points of a line, ``t`` (n,) and ``values`` (n,), that a plot distinguishes.

    The first, last, lowest and highest point of each column, so that no extreme is lost; all points
    if there are not many more.
    """
    n = len(t)
    if n <= 4 * COLUMNS:
        return np.arange(n)
    edges = np.searchsorted(t, np.linspace(t[0], t[-1], COLUMNS + 1)[1:-1])
    chosen = []
    for first, end in zip([0, *edges], [*edges, n]):
        if end > first:
            own = values[first:end]
            low = np.argmin(np.where(np.isnan(own), np.inf, own))
            high = np.argmax(np.where(np.isnan(own), -np.inf, own))
            chosen += [first, first + low, first + high, end - 1]
    return np.unique(chosen)


def distinct(x: FloatArray, y: FloatArray, *, log: bool = False) -> IndexArray:
    """Indices of markers at ``x``, ``y`` (n,) that do not overlap in a plot.

    Parameters
    ----------
    log
        Whether the axis of ``y`` is logarithmic.
    """
    n = len(x)
    if n <= COLUMNS:
        return np.arange(n)
    heights = np.log(np.where(y > 0.0, y, np.nan)) if log else y
    cells = []
    for values, count in ((x, COLUMNS), (heights, ROWS)):
        known = np.where(np.isfinite(values), values, np.nan)
        if np.isnan(known).all():
            return np.arange(n)
        low, high = np.nanmin(known), np.nanmax(known)
        cell = np.round((known - low) / ((high - low) or 1.0) * count)
        cells.append(np.where(np.isnan(cell), -1.0, cell))
    _, first = np.unique(cells[0] * (ROWS + 2) + cells[1], return_index=True)
    extremes = [np.nanargmin(heights), np.nanargmax(heights)]
    return np.union1d(first, extremes)
