r"""Stages next to a singular configuration.

**On the branch.**  A stage lies off the closure manifold by its own error (dq, dv).  Next to a
singular configuration that error turns the null space of G, and the acceleration changes by

    2 w dv + w^2 dq,   w = |d sigma / dt| / sigma.

Where a step crosses the singular configuration, w h does not shrink with the step, and the scheme
falls to the order of its stages.  Evaluated at its projection on the manifold (Newton steps with
the factorisation of each evaluation) a stage sees the smooth field on the branch, and the scheme
keeps its order.

**In the zone.**  Rounding in a direct solve for the multiplier grows like 1/sigma^2.  Stages with
sigma < sigma_z, where it exceeds the tolerance, take a predicted multiplier
(:class:`~srm_mbs.dynamics.system.Zone`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System, Terms, Zone
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory

LARGEST_ZONE_SIGMA = 1e-3
"""Largest sigma_z: the zone begins here where rounding exceeds the tolerance, or there is none
(fixed steps), and at a smaller sigma otherwise (:meth:`BranchStages.known_from`)."""
UNCERTAINTY_SIGMA_CHANGE = 5 * LARGEST_ZONE_SIGMA
"""Change of sigma over a step from which the uncertainty of the predicted multiplier counts as
error; counting it always would trap the step-size control next to the singular configuration."""
DIRECT_HIT_SIGMA = 1e-6
"""sigma below which any prediction is better than the direct solve."""
MIN_PREDICTION_NODES = 3
"""Nodes of the history from which a prediction is better than the direct solve."""
WATCHED_SIGMA = 0.05
"""sigma below which a step prepares for singular configurations."""
NEAR_STEPS = 4.0
"""Steps that start with sigma below NEAR_STEPS |d sigma / dt| h are next to a singular
configuration; of sweeps, which keep their constraint errors for about eps, those with sigma below
NEAR_STEPS |d sigma / dt| max(h, eps)."""
FIRST_ORDER_SIGMA = 0.3
"""sigma below which every step of a system of first order is next to a singular configuration.  A
stage off the branch by c h^2 has a rate that errs by c h^2 |d sigma / dt|/sigma: a scheme of the
order p loses h^(p + 1)/sigma^(p - 1) in a step: over the steps from NEAR_STEPS on, h^2 in all."""
FAR_STEPS = 8.0
"""Distance from a singular configuration, in steps, from which a step prepares nothing for one."""
MAX_PROJECTIONS = 4
"""Newton steps of one stage; the error is squared each time."""
AMBIGUOUS_DISTANCE = 0.1
"""Distance of a stage from the branch, over sigma, above which it is not projected: Newton's method
might lead to another branch."""
HELD_ERROR = 0.1
"""Error over the tolerance up to which a slow motion is held on its branch, not extrapolated."""
POSITION_ROUNDING = 16.0 * np.finfo(float).eps
"""Largest rounding of the positions (rad, scene diagonals)."""
USUAL_ROUNDING = 1.0 / 32.0
"""Usual rounding of the positions, over POSITION_ROUNDING: half a unit in the last place."""
CROSSING_SIGMA = 0.5
"""sigma at the ends of a step across a singular configuration, over its change of sigma."""
FLOOR_STEPS = 100.0
"""Distance before a singular configuration, in steps, from which steps are kept long enough for
rounding."""
LARGEST_FLOOR = 1e-7
"""Largest relative error that is accepted as rounding: above, a run had better stop."""


def zone_from(history: MultiplierHistory | None, threshold: float, end: float) -> Zone | None:
    """The zone sigma < ``threshold`` of a step to the time ``end`` (s).

    None without nodes; for direct hits only while there are few nodes.
    """
    if history is None or not history.begun:
        return None
    known = history.known_below if end <= history.known_until else 0.0
    if len(history.times) < MIN_PREDICTION_NODES:
        threshold = min(threshold, DIRECT_HIT_SIGMA)
    return Zone(max(threshold, known), history.predict_near, history.normals)


@dataclass
class BranchStages:
    """The stages of one step next to a singular configuration, evaluated on their branch.

    Parameters
    ----------
    norm, weights : (n,)
        Error norm and weights of the step.
    sigma_change
        |d sigma / dt| h, of the last steps.
    history
        The multipliers that the zone of the step predicts from; None for sweeps that need no zone.
    end
        End of the step (s).
    lingering
        Whether the motion lingers: its stages next to the singular configuration are solved by
        nodes of the branch.

    Attributes
    ----------
    near
        Whether the step is next to a singular configuration.
    zone
        The zone of the step.
    inaccurate_below
        sigma below which a direct solve errs by more than the tolerance, if such solves are made
        because predictions err by more; else 0.
    floor : (n,)
        Error that rounding leaves in a step of this length across a singular configuration; part of
        the weights.  It grows like 1/h^2.  Counted from before the configuration on, it keeps the
        steps so long that their own errors are above it: shorter ones are no more accurate, and
        would be rejected for ever.  0 away from singular configurations.
    projected
        Whether any stage was moved.
    """

    system: System
    memory: IntegratorState
    norm: ErrorNorm
    weights: FloatArray
    h: float
    sigma_change: float
    history: MultiplierHistory | None
    end: float
    lingering: bool = field(default=False, kw_only=True)
    near: bool = field(init=False)
    zone: Zone | None = field(init=False)
    inaccurate_below: float = field(init=False)
    floor: FloatArray = field(init=False)
    projected: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self.floor = np.zeros_like(self.weights)
        # All stages of a step or none: a mixture of both loses the order.
        self.near = self.memory.sigma < self.reach() or self.lingering
        threshold = LARGEST_ZONE_SIGMA
        holds = False
        self.inaccurate_below = 0.0
        if self.memory.sigma < WATCHED_SIGMA + NEAR_STEPS * self.sigma_change:
            threshold = self.known_from(1.0)
            holds = threshold < LARGEST_ZONE_SIGMA and self.holding_suffices(threshold)
            # The tolerance alone determines the zone; its predictions and projections need to be
            # as accurate as rounding allows.
            if not self.lingering:
                self.floor = self._floor()
                self.weights = self.weights + self.floor
            uncertain = self.uncertainty()
            if uncertain > 1.0 and not holds:
                # A prediction that errs by more than the tolerance is no better than a direct
                # solve that does.
                self.inaccurate_below = threshold
                threshold = self.known_from(uncertain)
        self.zone = zone_from(self.history, threshold, self.end)
        if self.zone is not None and holds:
            self.zone = replace(self.zone, predict=lambda _: None)

    def reach(self) -> float:
        """sigma below which the step is next to a singular configuration."""
        near = NEAR_STEPS * self.sigma_change if self.sigma_change > 0.0 else WATCHED_SIGMA
        return near if self.system.multiplier_part.start else max(near, FIRST_ORDER_SIGMA)

    def __call__(
        self, terms: Terms, t: float, c: float, x: FloatArray
    ) -> tuple[Terms, FloatArray, FloatArray | None]:
        """Terms at the projection of the stage ``x`` on its branch, the projected state, and the
        difference that was subtracted.

        ``terms``, ``x`` and None where the projection would change less than ``norm.negligible`` of
        the tolerance, or than rounding.

        Parameters
        ----------
        terms
            As evaluated at ``x``.
        c
            Abscissa of the stage.
        """
        moved: FloatArray | None = None
        if not (self.near and c > 0.0):
            return terms, x, moved
        change = max(self.sigma_change, abs(terms.sigma - self.memory.sigma) / c)
        for _ in range(MAX_PROJECTIONS):
            sigma = terms.sigma
            if terms.rank_deficient or not sigma > 0.0:
                break
            error = terms.correction()
            if self.system.position_norm(error) > AMBIGUOUS_DISTANCE * sigma:
                break
            effect = self.norm(self.effect_on_rates(error, sigma, change), self.weights)
            if effect <= self.norm.negligible:
                break
            if effect <= self.norm(self.rounding(sigma, change, True), self.weights):
                break
            moved = error.copy() if moved is None else moved + error
            x = self.system.retract(x, -error)
            terms = self.system.evaluate(t, x, self.zone)
            self.projected = True
        return terms, x, moved

    def effect_on_rates(self, error: FloatArray, sigma: float, change: float) -> FloatArray:
        """Change (n,) of h times the tangent rate by the normal ``error`` (n,) of a stage."""
        part, size = self.system.multiplier_part, np.abs(error)
        reach = change / sigma
        of_part = 2.0 * reach * size[part]
        if part.start:
            of_part += (reach * reach / self.h) * size[: part.start]
        out = np.zeros(len(error))
        out[part] = of_part
        return out

    def rounding(self, sigma: float, change: float, projected: bool) -> FloatArray:
        """Change (n,) of h times the tangent rate by rounding at a stage with ``sigma``.

        Next to a singular configuration it may exceed the tolerance, and more so the shorter the
        step; an error estimate below it is meaningless.  A projection determines positions to
        POSITION_ROUNDING / sigma.
        """
        error = (POSITION_ROUNDING / sigma if projected else POSITION_ROUNDING) * self.norm.one
        part = self.system.multiplier_part
        if part.start:
            error[part] = change / (self.h * sigma) * error[: part.start]
        return self.effect_on_rates(error, sigma, change)

    def _floor(self) -> FloatArray:
        change = self.sigma_change
        near = min(WATCHED_SIGMA, FLOOR_STEPS * change)
        if not (self.memory.sigma < near and self.norm.negligible > 0.0):
            return np.zeros_like(self.weights)
        noise = self.rounding(CROSSING_SIGMA * change, change, True)
        return np.minimum(USUAL_ROUNDING * noise, LARGEST_FLOOR * self.norm.one)

    def widened(
        self,
        weights: FloatArray,
        scheme: ButcherTableau,
        sigmas: FloatArray,
        direct_from: float = 0.0,
    ) -> FloatArray:
        """``weights`` (n,), increased by the effect of rounding on the error estimate of a step of
        ``scheme`` with ``sigmas`` (s + 1,) at its stages, solved directly from ``direct_from`` on.
        """
        weights = weights + self.floor
        # Below the threshold of the zone nothing is solved for directly.  Where that is smaller
        # than the tolerance requires, shorter steps predict better, and rounding does not count.
        least = max(direct_from, 0.0 if self.zone is None else self.zone.threshold)
        direct = min((sigma for sigma in sigmas[1:].tolist() if sigma >= least), default=np.inf)
        lowest = max(direct, self.inaccurate_below)
        if scheme.error is None or not 0.0 < lowest < NEAR_STEPS * self.sigma_change:
            return weights
        noise = self.rounding(lowest, self.sigma_change, self.projected)
        wide: FloatArray = weights + np.abs(scheme.error).max() * noise
        return wide

    def holding_suffices(self, threshold: float) -> bool:
        """Whether the motion is so slow that holding it tangential to the normals of the last node,
        at ``threshold``, causes an error, |a| threshold + v^2, well below the tolerance."""
        part = self.system.multiplier_part
        if not part.start or self.memory.history is None or self.memory.history.normals is None:
            return False
        v, a = self.memory.rate[: part.start], self.memory.rate[part]
        speed = self.system.position_norm(np.concatenate([v, a]))
        error = np.zeros_like(self.weights)
        error[part] = self.h * (threshold * np.abs(a) + speed * np.abs(v))
        return self.norm(error, self.weights) < HELD_ERROR

    def uncertainty(self) -> float:
        """Error of the multiplier predicted for the end of the step, over the tolerance; 0 where
        there are too few nodes to estimate it."""
        if self.history is None or len(self.history.times) < MIN_PREDICTION_NODES:
            return 0.0
        error = np.zeros_like(self.weights)
        error[self.system.multiplier_part] = self.h * self.history.uncertainty(self.end)
        return self.norm(error, self.weights)

    def known_from(self, allowed: float) -> float:
        """sigma from which the direct solve errs by less than ``allowed`` tolerances; at most, and
        without a tolerance (fixed steps), LARGEST_ZONE_SIGMA."""
        if self.norm.negligible == 0.0:
            return LARGEST_ZONE_SIGMA
        part = self.system.multiplier_part
        error = self.rounding(1.0, self.sigma_change, False)
        error[part] += self.h * POSITION_ROUNDING * np.abs(self.memory.rate[part])
        return float(min(LARGEST_ZONE_SIGMA, np.sqrt(self.norm(error, self.weights) / allowed)))
