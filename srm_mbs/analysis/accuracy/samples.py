"""Samples of a run, at which its accuracy is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.simulation.result import SimulationResult

MAX_STEP_ENDS = 2000
"""Most ends of steps at which two runs are compared."""
EVEN_TIMES = 501
"""Number of evenly spaced times at which they are compared as well, by dense output."""
FEWEST_EVEN_TIMES = 25
"""Fewest of them where each costs further stages; up to a fifth of the steps is read then."""


@dataclass(frozen=True, eq=False)
class Samples:
    """A smooth part of a run at the ends of its steps, and between them.

    Attributes
    ----------
    run
        The part, at all ends of its steps (:func:`at_ends`).
    ends : (k,) s
        The ends of steps, of which all but a step that an event ended are whole.
    even : (n,) s
        Evenly spaced times.
    even_states : (n, nq + nv)
        The states there, by dense output.
    """

    run: SimulationResult
    ends: FloatArray
    even: FloatArray
    even_states: FloatArray


def sampled(part: SimulationResult) -> Samples:
    """The samples of a smooth part of a run."""
    ends, even = part.steps.times, even_times(part)
    if part.steps.stop is not None:  # an event within the last step
        ends = ends[:-1]
    return Samples(at_ends(part), ends, even, part.states(even))


def at_ends(solution: SimulationResult) -> SimulationResult:
    """The run at the ends of its steps: few output times, or none, do not represent it."""
    if solution.t_eval is None:
        return solution
    ends = [[*part.steps.times[:-1], part.steps.end] for part in solution.segments]
    return solution.at(np.unique(np.concatenate(ends)))


def sample_times(solution: SimulationResult, *, fixed: bool = False) -> FloatArray:
    """Times (n,) s at which a run is compared: ends of its steps, and evenly spaced ones.

    With ``fixed`` the ends only, at which the method has its order.
    """
    start, end = solution.span
    ends = solution.steps.times
    ends = ends[(ends >= start) & (ends <= end)]
    if len(ends) > MAX_STEP_ENDS:
        ends = ends[np.unique(np.linspace(0, len(ends) - 1, MAX_STEP_ENDS).astype(int))]
    if fixed:
        return np.union1d(ends, [end])
    return np.union1d(ends, even_times(solution))


def sample_states(
    solution: SimulationResult, samples: Sequence[Samples]
) -> tuple[FloatArray, FloatArray]:
    """The :func:`sample_times` (n,) s of a run with these samples, and the states (n, nq + nv)."""
    (own, *others) = samples
    if others or len(own.ends) > MAX_STEP_ENDS:
        times = sample_times(solution)
        return times, solution.states(times)
    times = np.concatenate((own.ends, own.even))
    order = times.argsort(kind="stable")
    times = times[order]
    last = np.append(times[1:] > times[:-1], True)  # of equal ones
    states = np.concatenate((solution.steps.states[: len(own.ends)], own.even_states))
    return times[last], states[order[last]]


def even_times(solution: SimulationResult) -> FloatArray:
    """Evenly spaced times (s) from start to end: EVEN_TIMES, or fewer where dense output takes
    further stages in each step that it is read in."""
    count = EVEN_TIMES
    if len(solution.scheme.dense.extra_c):
        count = min(count, max(FEWEST_EVEN_TIMES, solution.steps.count // 5))
    return np.linspace(*solution.span, count)
