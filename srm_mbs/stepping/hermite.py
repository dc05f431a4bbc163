r"""Dense output next to singular configurations: Hermite interpolation of accepted states.

Where a step passes, or almost touches, a singular configuration, the rates of its stages carry the
rounding of the stage over its distance to that configuration, which the weights of a continuous
extension multiply.  The accepted states and their rates do not: they lie further away.  States
between them follow from the polynomial through the states and rates at the nearest ends of steps,
in the chart at the start of the step.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.systems.base import System

if TYPE_CHECKING:
    from srm_mbs.stepping.dense import StepData

NODES = (4, 6, 8)
"""Numbers of ends of steps: polynomials of degree 7, 11 and 15."""
SPACING = 0.1
"""Smallest distance of the ends of steps that are used, over the length of the step: closer ones
would magnify their rounding."""
CLOSE = 1.0
"""A step is close to a singular configuration if its smallest sigma is below CLOSE times the change
of sigma over a step."""
PROBES = np.array([0.25, 0.5, 0.75])
"""Fractions of the step at which polynomials are compared."""


def close_to_singular(abscissae: FloatArray, sigmas: FloatArray) -> bool:
    """Whether stages of the step (abscissae and sigma, (s + 1,)) lie close to a zero of sigma."""
    if not np.isfinite(sigmas).all():
        return False
    change = float(np.max(np.abs(sigmas[1:] - sigmas[0]) / abscissae[1:]))
    return bool(sigmas.min() < CLOSE * change)


class HermiteStep:
    """The interpolant of one step.

    Degree 11 where degree 15 confirms it better than it confirms degree 7: between steps of very
    different lengths a higher degree is not better.

    Parameters
    ----------
    system, steps, step
        The run, and the number of the step.
    weights : (k,)
        Those of the rates over a whole step, as far as they are in ``steps``.
    """

    def __init__(self, system: System, steps: StepData, step: int, weights: FloatArray) -> None:
        self._system = system
        self._steps = steps
        self._step = step
        self._weights = weights
        # Rates jump at breakpoints: a polynomial goes no further.
        self._piece = steps.piece(step)
        self._start = steps.states[step]
        self._h = steps.times[step + 1] - steps.times[step]
        polynomials = [self._through(count) for count in NODES]
        values = [polynomial(PROBES) for polynomial in polynomials]
        changes = [float(np.abs(b - a).max()) for a, b in pairwise(values)]
        self._polynomial = polynomials[1 if changes[1] <= changes[0] else 0]

    def _nodes(self, count: int) -> list[int]:
        """Indices of up to ``count`` ends of steps around the step, none too close together."""
        times, near = self._steps.times, SPACING * self._h
        states, reachable = self._steps.states, self._system.reachable
        first, last = self._piece
        before, after = [self._step], [self._step + 1]
        i, j = self._step - 1, self._step + 2
        while len(before) + len(after) < count and (i >= first or j <= last):
            left = i >= first and (j > last or len(before) <= len(after))
            if left:
                if times[before[-1]] - times[i] >= near:
                    if reachable(self._start, states[i]):
                        before.append(i)
                    else:
                        first = i
                i -= 1
            else:
                if times[j] - times[after[-1]] >= near:
                    if reachable(self._start, states[j]):
                        after.append(j)
                    else:
                        last = j
                j += 1
        return sorted(before + after)

    def _moved(self, node: int) -> FloatArray:
        """Motion (m,) from the step to a node, in the charts of the steps between: turns included,
        however the rates change within a step."""
        steps = self._steps
        own = slice(min(node, self._step), max(node, self._step))
        count = len(self._weights)
        h = np.diff(steps.times[own.start : own.stop + 1])
        moved: FloatArray = self._weights @ np.tensordot(h, steps.rates[own, :count], axes=1)
        return moved if node > self._step else -moved

    def _through(self, count: int) -> Callable[[FloatArray], FloatArray]:
        from scipy.interpolate import KroghInterpolator

        steps = self._steps
        last = self._piece[1]
        t0 = steps.times[self._step]
        points: list[float] = []
        values: list[FloatArray] = []
        for i in self._nodes(count):
            delta = self._system.difference(self._start, steps.states[i], self._moved(i))
            rate = steps.rate_at(i, last)
            points += 2 * [(steps.times[i] - t0) / self._h]
            values += [delta, self._h * self._system.chart_rate(delta, rate)]
        return KroghInterpolator(np.array(points), np.array(values))  # type: ignore[no-any-return]

    def __call__(self, theta: FloatArray) -> FloatArray:
        """States (k, nx) at the fractions ``theta`` (k,) of the step."""
        deltas = self._polynomial(theta)
        return np.array([self._system.retract(self._start, delta) for delta in deltas])
