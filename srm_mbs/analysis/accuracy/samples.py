"""Times of a run of any number of segments, at which its accuracy is measured."""

from __future__ import annotations

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.integration.run_samples import sampled_ends, times_between
from srm_mbs.simulation.result import SimulationResult

MAX_STEP_ENDS = 2000
"""Most ends of steps at which two runs that disagree are compared."""


def at_ends(solution: SimulationResult) -> SimulationResult:
    """A run of several segments at sampled ends of their steps, if output times were asked for: few
    or none do not represent it; else at both sides of each jump."""
    if solution.t_eval is None:
        return solution
    ends = [
        np.append(part.steps.times[:-1], part.steps.end)[
            sampled_ends(part.steps, part.mechanism.structure.units.state)
        ]
        for part in solution.segments
    ]
    return solution.at(np.unique(np.concatenate(ends)))


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
    between = [times_between(part.scheme, part.steps) for part in solution.segments]
    return np.unique(np.concatenate((ends, *between)))
