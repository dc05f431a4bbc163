"""Where a run is read for a picture, and how much of it a picture can show."""

from __future__ import annotations

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.simulation.dae_result import DaeResult
from srm_mbs.simulation.result import SimulationResult

SMOOTH = 8
"""Pieces of each step: between the ends of steps of high order curves bend."""
LEAST = 240
"""Pieces of a run of few steps."""
MOST = 12_000
"""Pieces from which steps are divided no further."""
COLUMNS = 1600
"""Columns of a picture: about twice as many as a page or a screen tells apart."""
ROWS = 800


Run = SimulationResult | DaeResult


def passages(solution: Run) -> list[float]:
    """Times (s) of the singular passages that were looked for; none of a DAE."""
    found = solution.crossings if isinstance(solution, SimulationResult) else ()
    return [crossing.time for crossing in found]


def jumps(solution: Run) -> list[float]:
    """Times (s) of the actions of events."""
    if not isinstance(solution, SimulationResult):
        return []
    return [segment.span[0] for segment in solution.segments[1:]]


def constrained(solution: SimulationResult) -> bool:
    """Whether there are closures or drives in any part of the run."""
    return any(segment.mechanism.constrained for segment in solution.segments)


def read_smoothly(solution: SimulationResult, most: int = MOST) -> SimulationResult:
    """The run read so often that curves are smooth: at the ends of its steps, and between them.

    Its times increase.  Each action of an event has two, of which the first is the last number
    before it: the states there are those before and after the jump.

    Parameters
    ----------
    most
        Pieces from which steps are divided no further: fewer for what is slow to compute.
    """
    times = _times(solution, most)
    if np.array_equal(times, solution.t):
        return solution  # which may have computed already what is asked of it
    return solution.at(times)


def _times(solution: SimulationResult, most: int) -> FloatArray:
    segments = solution.segments
    steps = sum(segment.steps.count for segment in segments)
    parts = []
    for segment in segments:
        start, end = segment.span
        if segment is not segments[-1]:
            if not end > start:
                continue
            end = np.nextafter(end, start)
        times = segment.steps.times
        parts.append(between(np.append(times[times < end], end), steps, most))
    return np.unique(np.concatenate(parts))


def between(ends: FloatArray, steps: int, most: int = MOST) -> FloatArray:
    """The ``ends`` (n,) of steps with times between them, in a run of so many ``steps``."""
    pieces = max(1, min(max(SMOOTH, -(-LEAST // max(1, steps))), most // max(1, steps)))
    inside = np.arange(pieces) / pieces
    return np.append(ends[:-1, None] + np.diff(ends)[:, None] * inside, ends[-1])


def broken(
    solution: SimulationResult, t: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``t`` (n,) and ``values`` (n, ...) with a gap (nan) at each jump."""
    at = np.searchsorted(t, jumps(solution))
    return np.insert(t, at, np.nan), np.insert(values, at, np.nan, axis=0)


def thinned(t: FloatArray, values: FloatArray) -> IndexArray:
    """Indices of what is seen of a line through increasing ``t`` (n,) and ``values`` (n,).

    Of each column of the picture the first, last, lowest and highest point: no extreme is lost.
    All indices if there are not many more.
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
    """Indices of marks at ``x``, ``y`` (n,) that do not lie upon each other in a picture.

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
