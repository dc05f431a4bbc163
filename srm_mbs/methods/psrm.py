r"""The Predicted Sequential Regularization Method in its split form.

Exact prediction, and the corrector as a splitting at the step end (docs/notation.md): the
stages integrate

    q' = v,   v' = M^{-1} f - E gamma,

and at the end point x^- = (q^-, v^-), with the same factorisation as the stage evaluated there,

    q = q^- (+) (-theta E g),   v = v^- - theta P v^-,   theta = 1 - exp(-h / eps).

eps -> 0 (theta = 1) is the default.  The end stage serves as the next step's first stage with
q' = corrected v, so that a step costs as many evaluations as the tableau has stages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.methods.base import ErrorNorm, Memory, StepResult
from srm_mbs.methods.branch import NEAR, on_branch, rounding_effect
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.methods.tableaus import get_tableau
from srm_mbs.systems.base import System, Zone

ZONE_FLOOR = 1e-3
"""Smallest sigma_z; smaller values failed at tight tolerances."""
ZONE_PER_STEP = 0.0
"""sigma_z as a fraction of the change of sigma over the step."""
COUNT_UNCERTAINTY_ABOVE = 5 * ZONE_FLOOR
"""h * slope of sigma from which the uncertainty of the predicted multiplier counts as error;
counting it always would trap the step-size control next to the singular configuration."""


@dataclass(frozen=True)
class PSRM:
    """Split PSRM.

    Parameters
    ----------
    tableau
        Name in :data:`srm_mbs.TABLEAUS`, or a :class:`ButcherTableau`.
    prediction
        ``"exact"``: the multiplier of every stage from the acceleration-level equations.
    correction
        ``"split"``: the corrector sweep as a splitting at the step end.
    eps
        Regularisation parameter (s); ``None`` for the limit eps -> 0.

    Raises
    ------
    InputError
        For an unknown tableau, a variant that this version does not have, or eps <= 0.
    """

    tableau: str | ButcherTableau = "dop853"
    prediction: str = "exact"
    correction: str = "split"
    eps: float | None = None

    def __post_init__(self) -> None:
        try:
            get_tableau(self.tableau)
        except ValueError as error:
            raise InputError(str(error), element="tableau") from error
        if (self.prediction, self.correction) != ("exact", "split"):
            raise InputError(
                f"PSRM with prediction={self.prediction!r}, correction={self.correction!r} "
                "is not in this version",
                element="method",
                remedy='Use prediction="exact", correction="split"',
            )
        if self.eps is not None and not (math.isfinite(self.eps) and self.eps > 0.0):
            raise InputError(
                f"eps = {self.eps!r} is not a positive number",
                element="eps",
                remedy="Give seconds, or None for the limit eps -> 0",
            )

    @property
    def scheme(self) -> ButcherTableau:
        """The Runge-Kutta data."""
        return get_tableau(self.tableau)

    def start(self, system: System, t: float, state: FloatArray, norm: ErrorNorm) -> Memory:
        """First stage, and the first node of the multiplier history."""
        terms = system.evaluate(t, state)
        memory = Memory(terms.rate().copy(), terms.sigma, system.magnitudes(state))
        if system.has_constraints:
            memory.history = MultiplierHistory.begin(t, terms.multiplier())
        return memory

    def step(
        self, system: System, t: float, h: float, state: FloatArray, memory: Memory, norm: ErrorNorm
    ) -> StepResult:
        """One step; see :class:`~srm_mbs.methods.base.Method`."""
        scheme = self.scheme
        s, A, c = scheme.n_stages, scheme.A, scheme.c
        history = memory.history
        sigma_change = h * memory.sigma_slope
        zone = None
        if history is not None:
            zone = Zone(max(ZONE_FLOOR, ZONE_PER_STEP * sigma_change), history.predict)
        weights = norm.weights(memory.magnitude)
        moved = None
        projected = False
        rates = np.empty((s + 1, system.tangent_size))
        sigmas = np.full(s + 1, memory.sigma)
        rates[0] = memory.rate
        weak_stages: list[int] = []
        rank = np.iinfo(np.int64).max
        for j in range(1, s + 1):
            end = j == s
            delta = (h * (scheme.b if end else A[j, :j])) @ rates[:j]
            x = system.retract(state, delta)
            terms = system.evaluate(t + h if end else t + c[j] * h, x, zone)
            sigmas[j] = terms.sigma
            if zone is not None and terms.sigma < 1.0:
                slope = max(sigma_change, abs(terms.sigma - memory.sigma) / (1.0 if end else c[j]))
                terms, x, moved = on_branch(
                    system, terms, t + h if end else t + c[j] * h, x, zone, h, slope, norm, weights
                )
                projected = projected or moved is not None
            rate = terms.rate()
            rates[j] = system.chart_rate(delta, rate)
            rank = min(rank, terms.rank)
            if terms.weak:
                weak_stages.append(j)
        magnitude = system.magnitudes(x)
        if history is not None:
            theta = 1.0 if self.eps is None else -math.expm1(-h / self.eps)
            correction = theta * terms.correction()
            new_state = system.retract(x, -correction)
            end_rate = rate - system.rate_change(correction)
            if moved is not None:
                correction = correction + moved
            multiplier = None if terms.weak else terms.multiplier().copy()
        else:
            correction = np.zeros(0)
            new_state, end_rate, multiplier = x, rate.copy(), None
        error_ratio = 0.0
        if scheme.error is not None:
            error = h * np.abs(scheme.error @ rates)
            if history is not None and sigma_change > COUNT_UNCERTAINTY_ABOVE:
                for j in weak_stages:
                    if j < s:
                        uncertainty = history.uncertainty(t + c[j] * h)
                        error[system.multiplier_part] += h * abs(scheme.b[j]) * uncertainty
            weights = norm.weights(np.maximum(memory.magnitude, magnitude))
            lowest = float(sigmas[1:].min())
            if history is not None and lowest < NEAR * sigma_change:
                one = norm.atol / norm.rtol
                noise = rounding_effect(system, one, lowest, sigma_change, h, projected)
                weights = weights + np.abs(scheme.error).max() * noise
            error_ratio = norm(error, weights)
        return StepResult(
            t=t,
            h=h,
            state=new_state,
            rates=rates,
            end_rate=end_rate,
            correction=correction,
            error_ratio=error_ratio,
            sigmas=sigmas,
            rank=rank,
            zone=zone if weak_stages else None,
            history=history if weak_stages else None,
            multiplier=multiplier,
            magnitude=magnitude,
        )

    def accept(self, memory: Memory, result: StepResult) -> None:
        """Move ``memory`` to the end of an accepted step."""
        memory.rate = result.end_rate
        memory.sigma = float(result.sigmas[-1])
        memory.magnitude = result.magnitude
        if result.multiplier is not None and memory.history is not None:
            memory.history = memory.history.extended(result.t + result.h, result.multiplier)
