r"""Steps placed so that no stage lands on a singular configuration.

A wrapper of step-size control (docs/notation.md, "Singular configurations"):

* a priori, when sigma falls, the predicted zero is put at the centre of the widest gap between
  the abscissae of the tableau;
* sigma changes by at most 0.5 per step;
* a posteriori, when a stage came too close, a V is fitted to the sigmas of the step and the step
  is redone, at most three times.
"""

from __future__ import annotations

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.methods.base import Memory, StepResult
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.stepping.stepsize import Proposal, StepSizeControl, Verdict

SIGMA_CHANGE = 0.5
"""Largest change of sigma in one step, by the slope of the last steps."""
TOO_CLOSE = 0.05
"""A stage is too close if sigma < TOO_CLOSE * slope * h."""
FAR_ENOUGH = 0.15
"""No placement when the zero lies nearer than this fraction of the step: it is being left."""
MAX_REDONE = 3


def sigma_slope(abscissae: FloatArray, sigmas: FloatArray, h: float) -> float:
    """max_j |sigma_j - sigma_0| / (c_j h) over the stages with c_j > 0 (1/s)."""
    return float(np.max(np.abs(sigmas[1:] - sigmas[0]) / abscissae[1:])) / h


class SingularityPlacement:
    """Wraps ``inner`` step-size control around singular configurations.

    Attributes
    ----------
    placed, replaced
        How many steps were shortened a priori, and redone a posteriori.
    """

    def __init__(self, inner: StepSizeControl, scheme: ButcherTableau) -> None:
        self._inner = inner
        self._gaps = scheme.gaps
        self._abscissae = np.append(scheme.c, 1.0)
        self.adaptive = inner.adaptive
        self.placed = 0
        self.replaced = 0
        self._slope = 0.0
        self._sigma = np.inf
        self._previous: tuple[float, float] | None = None
        self._redo: float | None = None
        self._redone = 0

    def propose(self, t: float, limit: float, memory: Memory) -> Proposal:
        """The inner proposal, shortened where a stage would come too close."""
        if self._redo is not None:
            limit = min(limit, self._redo)
        if self.adaptive and self._slope > 0.0:
            limit = min(limit, SIGMA_CHANGE / self._slope)
        self._sigma = memory.sigma
        memory.sigma_slope = self._slope
        proposal = self._inner.propose(t, limit, memory)
        if self._redo is None and self._previous is not None:
            h = self._before_the_step(t, proposal.h)
            if h < proposal.h:
                self.placed += 1
                return Proposal(h, t + h, placed=True)
        return proposal

    def _before_the_step(self, t: float, h: float) -> float:
        """The step length that puts a predicted zero of sigma into the widest gap."""
        t_old, sigma_old = self._previous or (t, self._sigma)
        if not self._sigma < sigma_old:
            return h
        distance = self._sigma * (t - t_old) / (sigma_old - self._sigma)
        centre = self._gaps[0][0]
        if distance <= FAR_ENOUGH * h:
            return h
        if distance <= centre * h:
            return distance / centre
        if distance < (1.0 + centre) * h:
            return distance / (1.0 + centre)
        return h

    def _after_the_step(self, h: float, sigmas: FloatArray) -> float | None:
        """A better step length if a stage or the end came too close, else None."""
        c = self._abscissae
        slope = max(self._slope, sigma_slope(c, sigmas, h))
        lowest = 1 + int(np.argmin(sigmas[1:]))
        reach = slope * h
        if not (sigmas[lowest] < TOO_CLOSE * reach and sigmas[0] > FAR_ENOUGH * reach):
            return None
        # The zero lies on one side of the lowest stage: take the side whose V fits better.
        offset = sigmas[lowest] / reach
        fits = [
            (float(np.abs(sigmas - reach * np.abs(c - zero)).sum()), zero)
            for zero in (c[lowest] + offset, c[lowest] - offset)
        ]
        zero = min(fits)[1]
        distance = zero * h
        widest = self._gaps[0][1]
        wide_enough = max(0.6 * widest, 1.5 * TOO_CLOSE)
        choices = [
            distance / centre
            for centre, half_width in self._gaps
            if half_width >= wide_enough and distance / centre <= h
        ]
        if not choices or zero > 0.95:
            return float(distance / (1.0 + self._gaps[0][0]))
        return float(max(choices))

    def judge(self, proposal: Proposal, result: StepResult | None) -> Verdict:
        """Redo a badly placed step; otherwise the inner control's verdict."""
        h = proposal.h
        if result is not None and self._redone < MAX_REDONE:
            better = self._after_the_step(h, result.sigmas)
            if better is not None and 0.0 < better < h:
                self._redo = better
                self._redone += 1
                self.replaced += 1
                return Verdict.REPLACED
        verdict = self._inner.judge(proposal, result)
        self._redo = None
        self._redone = 0
        if verdict is Verdict.ACCEPTED and result is not None:
            slope = sigma_slope(self._abscissae, result.sigmas, h)
            self._slope = max(slope, 0.5 * self._slope)
            self._previous = (result.t, float(result.sigmas[0]))
        return verdict
