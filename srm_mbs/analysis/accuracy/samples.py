"""Samples of a run, at which its accuracy is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.simulation.result import SimulationResult

MAX_STEP_ENDS = 2000
"""Most ends of steps at which two runs that disagree are compared."""
MAX_SAMPLED_ENDS = 100
"""Most groups of successive steps of which one end each is sampled."""
EVEN_TIMES = 501
"""Number of evenly spaced times at which they are compared as well, by dense output."""
READ_STEPS = ((4, 60), (2, 120), (2, 120))
"""Where dense output takes further stages, it is read in some steps instead: those with the largest
error estimates, the longest ones, and some at even distances.  Of each kind their fewest number,
and the number of steps of which one is read; together a thirtieth."""
READ_AT = np.array([0.2, 0.5, 0.8])
"""Fractions of these steps at which it is read."""


@dataclass(frozen=True, eq=False)
class Samples:
    """A smooth part of a run at ends of its steps, and between them.

    Attributes
    ----------
    run
        The part at these ends, and where it ends.
    whole
        Number of ends of whole steps: of all but a step that an event ended.
    between
        The part at times between them (:func:`times_between`).
    """

    run: SimulationResult
    whole: int
    between: SimulationResult


def sampled(part: SimulationResult) -> Samples:
    """The samples of a smooth part of a run."""
    run = at_ends(part)
    # The last one may be an event within the last step.
    whole = len(run.t) - (part.steps.stop is not None)
    return Samples(run, whole, part.at(times_between(part)))


def at_ends(solution: SimulationResult) -> SimulationResult:
    """The run at :func:`sampled_ends` of its parts: few output times, or none, do not represent
    it.  Of several segments at both sides of each jump, if output times were not asked for."""
    parts = solution.segments
    if solution.t_eval is None and (len(parts) > 1 or solution.steps.count <= MAX_SAMPLED_ENDS):
        return solution
    ends = [np.append(part.steps.times[:-1], part.steps.end)[sampled_ends(part)] for part in parts]
    return solution.at(np.unique(np.concatenate(ends)))


def sampled_ends(part: SimulationResult) -> IndexArray:
    """Ends (k,) of steps of a smooth part of a run that represent it: its start and its end and, of
    each group of successive steps, that where the closures had to be corrected most; and those of
    all steps in which rows of closures may have been dropped."""
    steps, n = part.steps, part.steps.count
    length = -(-n // MAX_SAMPLED_ENDS)
    if length <= 1:
        return np.arange(n + 1)
    size = np.zeros((-(-n // length), length))
    if steps.corrections.size:
        corrections = np.abs(steps.corrections / part.mechanism.structure.units.state)
        size.flat[:n] = corrections.max(axis=1)
    chosen = np.zeros(n + 1, dtype=bool)
    chosen[0] = chosen[n] = True
    chosen[np.arange(1, n + 1, length) + size.argmax(axis=1)] = True
    if steps.between_nodes:
        chosen[np.array(steps.between_nodes) + 1] = True
    return np.flatnonzero(chosen)


def sample_times(solution: SimulationResult, *, fixed: bool = False) -> FloatArray:
    """Times (n,) s at which runs are compared closely: ends of steps, and times between them.

    With ``fixed`` the ends only, at which the method has its order.
    """
    start, end = solution.span
    ends = solution.steps.times
    ends = ends[(ends >= start) & (ends <= end)]
    if len(ends) > MAX_STEP_ENDS:
        ends = ends[np.unique(np.linspace(0, len(ends) - 1, MAX_STEP_ENDS).astype(int))]
    if fixed:
        return np.union1d(ends, [end])
    between = [times_between(part) for part in solution.segments]
    return np.unique(np.concatenate((ends, *between)))


def sample_states(
    solution: SimulationResult, samples: Sequence[Samples]
) -> tuple[FloatArray, FloatArray]:
    """The times (n,) s of these samples of a run, and the states (n, nq + nv); of a run of several
    segments its :func:`sample_times`."""
    (own, *others) = samples
    if others:
        times = sample_times(solution)
        return times, solution.states(times)
    run, between, whole = own.run, own.between, own.whole
    times = np.concatenate((run.t[:whole], between.t))
    q, v = np.concatenate((run.q[:whole], between.q)), np.concatenate((run.v[:whole], between.v))
    states = np.hstack((q, v))
    order = times.argsort(kind="stable")
    times, states = times[order], states[order]
    twice = times[1:] == times[:-1]
    if np.logical_or.reduce(twice):
        last = np.append(~twice, True)
        times, states = times[last], states[last]
    return times, states


def times_between(part: SimulationResult) -> FloatArray:
    """Times (n,) s, ascending, at which dense output shows the error of a smooth part of a run
    between the ends of its steps: evenly spaced ones, or within some steps (READ_STEPS)."""
    (start, end), steps = part.span, part.steps
    n = steps.count
    if not n or not len(part.scheme.dense.extra_c):
        return np.linspace(start, end, EVEN_TIMES)
    lengths = steps.times[1:] - steps.times[:-1]
    by_error, by_length, even = (max(fewest, n // of) for fewest, of in READ_STEPS)
    chosen = np.zeros(n, dtype=bool)
    chosen[steps.error_ratios.argsort()[-by_error:]] = True
    chosen[lengths.argsort()[-by_length:]] = True
    chosen[:: -(-n // even)] = True
    times: FloatArray = (steps.times[:-1] + READ_AT[:, None] * lengths)[:, chosen].T.ravel()
    return times if steps.stop is None else times[times <= end]
