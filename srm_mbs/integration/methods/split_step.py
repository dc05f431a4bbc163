r"""One step of the split PSRM.

Exact prediction, and the corrector as a splitting at the step end (docs/notation.md): the
stages integrate

    q' = v,   v' = M^{-1} f - E gamma,

and at the end point x^- = (q^-, v^-), with the same factorisation as the stage evaluated there,

    q = q^- (+) (-theta E g),   v = v^- - theta P v^-,   theta = 1 - exp(-h / eps).

The end stage is the next step's first stage, with q' = corrected v, so that a step costs as many
evaluations as the tableau has stages, and a few more next to singular configurations
(:mod:`srm_mbs.integration.methods.near_singular`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, StepResult
from srm_mbs.integration.methods.branch_nodes import BRANCH_SIGMA, StageNodes
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.integration.methods.near_singular import (
    FAR_STEPS,
    FIRST_ORDER_SIGMA,
    UNCERTAINTY_SIGMA_CHANGE,
    WATCHED_SIGMA,
    BranchStages,
)
from srm_mbs.integration.methods.stiffness import (
    chatters,
    count_stiffness,
    reversal_error,
    stiffness_of,
    stopping_tolerance,
)

RESIDUAL_EVERY = 16
"""Steps, after the first RESIDUAL_EVERY, from one look at all closure rows to the next."""


class Stages(Protocol):
    """How the rates of a scheme follow from the chart rates of its stages.

    Attributes
    ----------
    stiffness
        As far as it is known before the step.
    cost
        Evaluations of the step, over those of its stages.
    laws : (m,) or None
        Laws of forces at the stage begun last, if the scheme carries them.
    """

    stiffness: float
    cost: float
    laws: FloatArray | None

    def begin(self, j: int) -> None:
        """Prepare the system for the stage ``j``."""

    def rate(self, j: int, rate: FloatArray, laws: FloatArray) -> FloatArray:
        """The rate (n,) of the stage ``j`` in the scheme, from the chart rate and the laws (m,) of
        forces there."""


@lru_cache(maxsize=64)
def later_stages(scheme: ButcherTableau) -> tuple[FloatArray, list[float]]:
    """Weights (k, s) and abscissae (k,) of the stages after the first, and of the end."""
    first = scheme.lead + 1
    return np.vstack([scheme.A[first:], scheme.b]), [*scheme.c[first:].tolist(), 1.0]


@dataclass(frozen=True)
class SplitStep:
    """The steps of the split PSRM; a :class:`~srm_mbs.integration.methods.base.Method`.

    Parameters
    ----------
    scheme
        Runge-Kutta data.
    eps
        Regularisation (s) of a step (s); None for eps -> 0, where theta = 1.
    """

    scheme: ButcherTableau
    eps: Callable[[float], float] | None = None

    @property
    def uses_nodes(self) -> bool:
        """Whether stages of lingering motions are solved by nodes of the branch."""
        return self.eps is None

    def stage_rates(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: IntegratorState,
        norm: ErrorNorm,
        branch: BranchStages | None,
        nodes: StageNodes | None,
        rates: FloatArray,
    ) -> Stages | None:
        """The stages of one step, None where the rates of the scheme are the chart rates; ``rates``
        (s + 1, n) receives those at its start."""
        rates[0] = memory.rate
        return None

    def start(
        self, system: System, t: float, state: FloatArray, norm: ErrorNorm
    ) -> IntegratorState:
        """First stage, and the first node of the multiplier history."""
        terms = system.evaluate(t, state)
        memory = IntegratorState(terms.rate().copy(), terms.sigma, system.state_scale(state))
        if system.has_constraints:
            memory.history = MultiplierHistory.begin(t, terms.multiplier())
        return memory

    def step(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: IntegratorState,
        norm: ErrorNorm,
    ) -> StepResult:
        """One step; see :class:`~srm_mbs.integration.methods.base.Method`."""
        scheme, s = self.scheme, self.scheme.n_stages
        theta = 1.0 if self.eps is None else -math.expm1(-h / self.eps(h))
        all_weights, fractions = later_stages(scheme)
        history, start = memory.history, memory.sigma
        sigma_change = h * memory.sigma_slope
        branch: BranchStages | None = None
        nodes: StageNodes | None = None
        zone = None
        watched = WATCHED_SIGMA if system.multiplier_part.start else FIRST_ORDER_SIGMA
        if history is not None and start < watched + FAR_STEPS * sigma_change:
            weights = norm.weights(memory.state_scale)
            branch_system = system.branch_system
            if memory.lingering and self.uses_nodes and branch_system is not None:
                implicit = scheme.implicit is not None
                nodes = StageNodes(branch_system, t, state, history.away, implicit, norm.singular)
            lingers = nodes is not None
            branch = BranchStages(
                system, memory, norm, weights, h, sigma_change, history, t + h, lingering=lingers
            )
            zone = branch.zone

        # Stages.  Zeros, because each stage weighs all s rates: those still to come with 0.
        rates = np.zeros((s + 1, system.tangent_size))
        weighed = rates[:s]
        first = scheme.lead + 1
        stages = self.stage_rates(system, t, h, state, memory, norm, branch, nodes, rates)
        all_sigmas = [start] * first
        deficient: list[tuple[int, int, bool]] = []
        delta = np.zeros(system.tangent_size)
        for j, stage_weights, fraction in zip(range(first, s + 1), h * all_weights, fractions):
            before, delta = delta, stage_weights.dot(weighed)
            x = system.retract(state, delta)
            if stages is not None:
                stages.begin(j)
            time = t + fraction * h
            terms = system.evaluate(time, x, zone if nodes is None else None)
            sigma = terms.sigma
            all_sigmas.append(sigma)
            if nodes is not None:
                on_branch = sigma < BRANCH_SIGMA and nodes.solve_stage(time, x)
                if on_branch:
                    x, rate = nodes.state, nodes.rate
                    rates[j] = chart_rate = system.chart_rate(delta, rate)
                    if stages is not None and j < s:
                        rates[j] = stages.rate(j, chart_rate, nodes.laws)
                    continue
                if sigma < BRANCH_SIGMA:
                    terms = system.evaluate(time, x, zone)
            if branch is not None:
                terms, x, moved = branch(terms, time, fraction, x)
            rate = terms.rate()
            rates[j] = chart_rate = system.chart_rate(delta, rate)
            if stages is not None and j < s:
                rates[j] = stages.rate(j, chart_rate, system.laws)
            if terms.rank_deficient:
                deficient.append((j, terms.rank, terms.held))
        change = abs(sigma - start)
        quiet = branch is None and sigma > watched + FAR_STEPS * change
        state_scale = system.state_scale(x)

        # Correction at the end.
        multiplier = normals = away = None
        if nodes is not None and on_branch:
            correction, new_state, end_rate = nodes.moved, x, rate
            multiplier, away = nodes.multiplier, nodes.away
        elif history is None:
            correction = np.zeros(0)
            new_state, end_rate = x, rate.copy()
        else:
            correction = terms.correction()
            if theta != 1.0:
                correction = theta * correction
            new_state = system.retract(x, -correction)
            end_rate = rate - system.rate_change(correction)
            near = branch is not None or sigma < WATCHED_SIGMA
            if near and not (quiet or terms.rank_deficient):
                multiplier = terms.multiplier()
                if sigma < WATCHED_SIGMA:
                    normals = terms.normals()
                    normals = normals if normals.shape[1] else None
            if branch is not None and moved is not None:
                correction = correction + moved

        result = StepResult(
            t=t,
            h=h,
            state=new_state,
            rates=rates,
            end_rate=end_rate,
            correction=correction,
            error_ratio=0.0,
            sigmas=np.array(all_sigmas),
            rank=terms.rank,
            state_scale=state_scale,
            multiplier=multiplier,
            stiff=memory.stiff,
        )
        if stages is not None:
            result.stiffness, result.laws = stages.stiffness, stages.laws
            result.cost = stages.cost
        direct_from = BRANCH_SIGMA if nodes is not None and nodes.used else 0.0
        result.error_ratio = self._error_ratio(
            system, memory, norm, result, branch, deficient, direct_from
        )
        tells = branch is None or start >= WATCHED_SIGMA + FAR_STEPS * sigma_change
        last_motion = delta - before if tells else None
        result.stiffness = self._stiffness(system, memory, norm, result, last_motion)
        due = memory.steps < RESIDUAL_EVERY or memory.steps % RESIDUAL_EVERY == 0
        if due and history is not None and theta == 1.0 and away is None:
            result.constraint_residual = terms.constraint_residual()
        if quiet:
            middle, c = scheme.middle
            halfway = abs(all_sigmas[middle] - start) / c
            result.quiet = True
            result.slope = max(change, halfway) / h
            return result
        result.normals, result.away = normals, away
        result.lost_branch = nodes is not None and nodes.lost
        if deficient:
            result.rank = min(rank for _, rank, _ in deficient)
            result.held = any(held for *_, held in deficient)
            result.zone, result.history = zone, history
        return result

    def _error_ratio(
        self,
        system: System,
        memory: IntegratorState,
        norm: ErrorNorm,
        result: StepResult,
        branch: BranchStages | None,
        deficient: list[tuple[int, int, bool]],
        direct_from: float,
    ) -> float:
        """Norm of the embedded error estimate over the tolerance; 0 for schemes without one.

        Parameters
        ----------
        branch
            Next to a singular configuration; None elsewhere.
        deficient
            Stage, rank, and whether it was held, of the stages whose multiplier is predicted.
        direct_from
            sigma above which stages were solved directly, without nodes of their branch.
        """
        scheme, t, h, history = self.scheme, result.t, result.h, memory.history
        if scheme.error is None:
            return 0.0
        error = h * (scheme.error @ result.rates)
        weights = norm.weights(np.maximum(memory.state_scale, result.state_scale))
        k = system.multiplier_part.start
        if len(sums := system.friction_sums):
            ends = np.array([memory.rate, result.end_rate])
            unseen = reversal_error(h, ends[:, :k], ends[:, k:], sums, system.friction_speed)
            error[k:] = np.maximum(np.abs(error[k:]), unseen)
            rubbing = k + np.flatnonzero(sums.any(axis=0))
            weights[rubbing] = np.minimum(weights, stopping_tolerance(norm))[rubbing]
        if scheme.implicit is not None:
            weights = np.minimum(weights, system.friction_tolerance(result.end_rate[:k]))
        if branch is not None and history is not None:
            if deficient and h * memory.sigma_slope > UNCERTAINTY_SIGMA_CHANGE:
                error = np.abs(error)
                for j, *_ in deficient:
                    if j < scheme.n_stages:
                        uncertainty = history.uncertainty(t + scheme.c[j] * h)
                        error[system.multiplier_part] += h * abs(scheme.b[j]) * uncertainty
            weights = branch.widened(weights, scheme, result.sigmas, direct_from)
        return norm(error, weights)

    def _stiffness(
        self,
        system: System,
        memory: IntegratorState,
        norm: ErrorNorm,
        result: StepResult,
        last_motion: FloatArray | None,
    ) -> float:
        """Stiffness of a step, infinite where friction makes joints chatter.

        ``last_motion`` (n,): tangent from the last stage to the end; None next to a singular
        configuration, where it tells nothing.
        """
        scheme, h, stiffness = self.scheme, result.h, result.stiffness
        explicit = False
        if scheme.stable_to is not None and last_motion is not None and norm.negligible > 0.0:
            explicit = True
            change_of_rate = result.rates[-1] - result.rates[-2]
            stiffness = stiffness_of(system, h, last_motion, change_of_rate)
        if (explicit or scheme.implicit is not None) and len(system.friction_sums):
            k = system.multiplier_part.start
            v = np.array([memory.rate[:k], result.end_rate[:k]])
            weights = norm.weights(memory.state_scale)[k:]
            if chatters(h, v, result.rates[:, k:], weights, system.friction_sums):
                return np.inf
        return stiffness

    def accept(self, memory: IntegratorState, result: StepResult) -> None:
        """Move ``memory`` to the end of an accepted step."""
        memory.steps += 1
        memory.rate = result.end_rate
        memory.sigma = float(result.sigmas[-1])
        memory.state_scale = result.state_scale
        memory.linearisation, memory.laws = None, result.laws
        if memory.history is not None:
            memory.history = history_after(memory.history, result)
        count_stiffness(memory, result.stiffness, result.cost, self.scheme)

    def resume(
        self, system: System, t: float, state: FloatArray, memory: IntegratorState, norm: ErrorNorm
    ) -> IntegratorState:
        """``memory`` after a breakpoint; see :class:`~srm_mbs.integration.methods.base.Method`."""
        fresh = self.start(system, t, state, norm)
        fresh.sigma_slope, fresh.steps = memory.sigma_slope, memory.steps
        fresh.stiff, fresh.stiff_steps = memory.stiff, memory.stiff_steps
        fresh.other_steps = memory.other_steps
        fresh.needed_steps, fresh.saved_steps = memory.needed_steps, memory.saved_steps
        return fresh


def history_after(history: MultiplierHistory, result: StepResult) -> MultiplierHistory:
    """``history`` after an accepted step."""
    if result.multiplier is not None:
        return history.extended(result.t + result.h, result.multiplier, result.normals, result.away)
    if result.zone is None and history.begun:
        return history.emptied()
    return history
