"""Samples of a run, at which its accuracy is measured: some ends of steps, and times between them.

:func:`run_samples` is the reference; the compiled kernel has the same in
:mod:`srm_mbs.integration.kernel.dense_output`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.integration.dense_output import DenseOutput, StepData
from srm_mbs.integration.methods.butcher import ButcherTableau

MAX_SAMPLED_ENDS = 100
"""Most groups of successive steps of which one end each is sampled."""
EVEN_TIMES = 501
"""Number of evenly spaced times between the ends, by dense output."""
READ_STEPS = ((4, 60, 20), (2, 120, 10), (2, 120, 10))
"""Where dense output takes further stages, it is read in some steps instead: those with the largest
error estimates, the longest ones, and some at even distances.  Of each kind their fewest number,
the number of steps of which one is read, together a thirtieth, and their largest number."""
READ_AT = np.array([0.2, 0.5, 0.8])
"""Fractions of these steps at which it is read."""


class RunSamples(NamedTuple):
    """A smooth part of a run at samples.

    Attributes
    ----------
    times : (n,) s, states : (n, nx)
        The ends of whole steps that are sampled and the times between them, ascending; and after
        them where an event ended the run within a step.
    ends
        Indices of the ends of steps, the last one where the run ended.
    whole
        Number of the samples without that within a step.
    """

    times: FloatArray
    states: FloatArray
    ends: list[int]
    whole: int


def run_samples(
    scheme: ButcherTableau, steps: StepData, dense: DenseOutput, unit: FloatArray
) -> RunSamples:
    """The samples of a smooth part of a run; ``unit`` (m,): of its motions and rates.

    Raises
    ------
    InputError, EvaluationError
        As of a call of ``dense``.
    """
    ends = np.append(steps.times[:-1], steps.end)[sampled_ends(steps, unit)]
    cut = bool(steps.end < steps.times[-1])  # by an event
    whole_ends = ends[: len(ends) - cut]
    whole = np.union1d(whole_ends, times_between(scheme, steps))
    times = np.append(whole, ends[len(whole_ends) :])
    at_ends = np.searchsorted(whole, whole_ends).tolist()
    return RunSamples(times, dense(times), at_ends + [len(whole)] * cut, len(whole))


def sampled_ends(steps: StepData, unit: FloatArray) -> IndexArray:
    """Ends (k,) of steps that represent a run: its start and its end and, of each group of
    successive steps, that where the closures had to be corrected most, in their ``unit`` (m,); and
    those of all steps in which rows of closures may have been dropped."""
    n = steps.count
    length = -(-n // MAX_SAMPLED_ENDS)
    if length <= 1:
        return np.arange(n + 1)
    size = np.zeros((-(-n // length), length))
    if steps.corrections.size:
        size.flat[:n] = (np.abs(steps.corrections) * (1.0 / unit)).max(axis=1)
    chosen = np.zeros(n + 1, dtype=bool)
    chosen[0] = chosen[n] = True
    chosen[np.arange(1, n + 1, length) + size.argmax(axis=1)] = True
    if steps.between_nodes:
        chosen[np.array(steps.between_nodes) + 1] = True
    return np.flatnonzero(chosen)


def times_between(scheme: ButcherTableau, steps: StepData) -> FloatArray:
    """Times (n,) s, ascending, at which dense output shows the error of a run between the ends of
    its steps: evenly spaced ones, or within some steps (READ_STEPS)."""
    n = steps.count
    if not n or not len(scheme.dense.extra_c):
        return np.linspace(steps.times[0], steps.end, EVEN_TIMES)
    lengths = steps.times[1:] - steps.times[:-1]
    by_error, by_length, even = (min(max(fewest, n // of), most) for fewest, of, most in READ_STEPS)
    chosen = np.zeros(n, dtype=bool)
    chosen[steps.error_ratios.argsort(kind="stable")[-by_error:]] = True
    chosen[lengths.argsort(kind="stable")[-by_length:]] = True
    chosen[:: -(-n // even)] = True
    within = steps.times[:-1] + READ_AT[:, None] * lengths
    times: FloatArray = within[:, chosen].T.ravel()
    return times if steps.stop is None else times[times <= steps.end]
