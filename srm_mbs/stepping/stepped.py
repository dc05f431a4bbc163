"""What runs of mechanisms and of DAEs tell about their steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from srm_mbs.arrays import FloatArray
from srm_mbs.stepping.dense import StepData


class Stepped:
    """A run of steps.

    Attributes
    ----------
    steps
        The accepted steps.
    attempts
        The attempted ones: structured array with t, h and verdict.
    status
        ``finished``, ``event`` (a terminal event), ``failed`` or ``interrupted``.
    """

    steps: StepData
    attempts: NDArray[np.void]
    status: str

    @property
    def success(self) -> bool:
        """Whether the end, or a terminal event, was reached."""
        return self.status in ("finished", "event")

    @property
    def span(self) -> tuple[float, float]:
        """Start and end (s) of the run, whatever ``t`` holds."""
        return float(self.steps.times[0]), self.steps.end

    @property
    def rejected(self) -> FloatArray:
        """Start and length (k, 2) s of the steps rejected for their error."""
        return self._attempted("rejected")

    @property
    def replaced(self) -> FloatArray:
        """Start and length (k, 2) s of the steps redone because of a singular configuration."""
        return self._attempted("replaced")

    def _attempted(self, verdict: str) -> FloatArray:
        chosen = self.attempts[self.attempts["verdict"] == verdict]
        return np.column_stack([chosen["t"], chosen["h"]])
