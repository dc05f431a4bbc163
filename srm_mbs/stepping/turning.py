"""Turns of the motion over several steps that could not tell the branches.

Sweeps may lie off the constraints by so much that, next to a singular configuration, they cannot
tell its branches.  They then turn in many short steps, each of which looks smooth.  The velocity
(x' of a DAE) is compared across all steps whose sweeps are off the constraints by a part of sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

from srm_mbs.arrays import FloatArray
from srm_mbs.methods.base import StepResult
from srm_mbs.methods.branch import AMBIGUOUS
from srm_mbs.systems.base import System

TURNED = 0.3
"""Part of the velocity by which it may differ from what is expected."""
LEFT = 10.0
"""A passage is over when sigma is this many times its smallest value again."""
PASSED = 0.1
"""Smallest sigma from which nothing singular was passed: sweeps in their initial layers are off the
closures, and velocities that change afterwards have not turned."""


def jumped(system: System, before: FloatArray, after: FloatArray) -> bool:
    """Whether the velocity in the tangent rate ``after`` (n,) is another one than ``before``."""
    jump, *sizes = (system.size(rate) for rate in (after - before, before, after))
    return jump > TURNED * max(sizes)


@dataclass
class _Passage:
    """Steps next to a singular configuration: time and tangent rate at the start and at the end,
    and the smallest sigma so far."""

    t: float
    rate: FloatArray
    end: float
    end_rate: FloatArray
    lowest: float


class AmbiguousPassages:
    """Follows a run step by step."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._turned: list[tuple[float, float]] = []
        self._passage: _Passage | None = None

    def watch(self, t_new: float, result: StepResult) -> None:
        """Look at an accepted step to ``t_new``."""
        passage = self._passage
        if passage is None and result.off == 0.0:
            return
        lowest = float(result.sigmas.min())
        ambiguous = result.off > AMBIGUOUS * lowest
        if passage is None:
            if ambiguous:
                rate = result.rates[0].copy()
                self._passage = _Passage(result.t, rate, t_new, result.end_rate, lowest)
            return
        passage.end, passage.end_rate = t_new, result.end_rate
        passage.lowest = min(passage.lowest, lowest)
        if not ambiguous and result.sigmas[-1] > LEFT * passage.lowest:
            self._turned = self.turned()
            self._passage = None

    @property
    def under_way(self) -> bool:
        """Whether a passage has begun and is not over."""
        return self._passage is not None

    def turned(self) -> list[tuple[float, float]]:
        """Start and end (s) of the passages over which the velocity turned, one that the run ends
        in included."""
        passage = self._passage
        if passage is None or not passage.lowest < PASSED:
            return self._turned
        if not jumped(self._system, passage.rate, passage.end_rate):
            return self._turned
        return [*self._turned, (passage.t, passage.end)]
