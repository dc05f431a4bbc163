r"""The adaptive method of the thesis: sweeps with their own histories, and its step-size control.

This is what the thesis did, for figures 5.15 and 5.16; the package estimates and controls
differently.  Sweep s starts every step where sweep s itself ended the last one, and the error is
the difference of two sweeps,

    e = x_m - xhat_{m-1},    xhat_{m-1} by the embedded weights from sweep m - 1's own stages.

As h -> 0 it tends to the gap x_m - x_{m-1} of the two trajectories at the start of the step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.integration.control.step_size import Proposal, StepDecision
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.tableaus import get_tableau
from srm_mbs.integration.methods.thesis.sweep import (
    Answer,
    Start,
    Sweep,
    SweepEquation,
    SweepNode,
    SweepResult,
    SweepState,
    interpolant,
)

SAFETY, LARGEST_FACTOR = 0.8, 5.0
"""alpha and alpha_max of appendix B."""


def _corrector(previous: FloatArray, eps: float) -> Answer:
    return lambda terms, j: terms.sweep(previous[j], eps)


@dataclass(frozen=True)
class PublishedSRM:
    """SRM with ``iterations`` sweeps, own histories, error estimated across sweeps m and m - 1.

    Attributes
    ----------
    eps
        Regularisation (s); None for eps = h.
    """

    tableau: str
    iterations: int
    eps: float | None = None

    @property
    def scheme(self) -> ButcherTableau:
        """The Runge-Kutta data."""
        return get_tableau(self.tableau)

    def start(self, system: System, t: float, state: FloatArray, norm: ErrorNorm) -> SweepState:
        """All sweeps at ``state`` with multiplier 0."""
        terms = system.evaluate(t, state)
        memory = SweepState(terms.rate().copy(), terms.sigma, system.state_scale(state))
        node = SweepNode(state, np.zeros(system.multiplier_size), None, 0.0, None)
        memory.sweeps = (node,) * self.iterations
        return memory

    def step(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: SweepState,
        norm: ErrorNorm,
    ) -> SweepResult:
        """One step; see :class:`~srm_mbs.integration.methods.base.Method`."""
        scheme, s = self.scheme, self.scheme.n_stages
        eps = h if self.eps is None else self.eps
        how = interpolant(scheme, "auto")
        previous = np.zeros((scheme.dense.n_rates, system.multiplier_size))
        runs: list[Sweep] = []
        for node in memory.sweeps:
            answer = _corrector(previous, eps)
            if node.rate is None:
                terms = system.evaluate(t, node.state)
                rate, _ = answer(terms, 0)
                start = Start.of(terms, rate, node.multiplier)
            else:
                start = Start(node.rate, node.multiplier, memory.sigma, len(node.state))
            equation = SweepEquation(system, scheme, t, h, answer)
            runs.append(equation.integrate(node.state, start))
            previous = equation.multipliers_at_nodes(runs[-1], how)
        last = runs[-1]
        state_scale = np.maximum(np.abs(memory.sweeps[-1].state), np.abs(last.state))
        error_ratio = 0.0
        if scheme.error is not None and self.iterations > 1:
            lower = runs[-2]
            embedded = lower.state - h * (scheme.error @ lower.rates[: s + 1])
            error_ratio = norm(last.state - embedded, norm.weights(state_scale))
        return SweepResult(
            t=t,
            h=h,
            state=last.state,
            rates=last.rates,
            end_rate=last.end_rate,
            correction=np.zeros(0),
            error_ratio=error_ratio,
            sigmas=last.sigmas,
            rank=last.rank,
            state_scale=state_scale,
            sweeps=tuple(
                SweepNode(
                    run.state,
                    run.multipliers[s],
                    None if self.eps is None else run.end_rate,
                    eps,
                    None,
                )
                for run in runs
            ),
        )

    def gap(self, memory: SweepState, norm: ErrorNorm) -> float:
        """||x_m - x_{m-1}|| over the tolerance, where the sweeps stand."""
        last, lower = memory.sweeps[-1].state, memory.sweeps[-2].state
        return norm(last - lower, norm.weights(np.abs(last)))

    def accept(self, memory: SweepState, result: SweepResult) -> None:
        """Move ``memory`` to the end of an accepted step."""
        memory.rate = result.end_rate
        memory.sigma = float(result.sigmas[-1])
        memory.state_scale = result.state_scale
        memory.sweeps = result.sweeps


class PublishedControl:
    """Appendix B: h_new = h min(a_max, max(1/a_max, a xi^(-1/(q + 1)))), with forced steps.

    Parameters
    ----------
    t_end, first_step
        End of the run and length of the first step (s).
    order
        q.
    smallest
        Steps of this length (s) are taken whatever their error: forced.

    Attributes
    ----------
    accepted, rejected, forced
        Numbers of steps; forced ones are accepted as well.
    """

    adaptive = True

    def __init__(self, t_end: float, first_step: float, order: int, smallest: float) -> None:
        self._t_end, self._h, self._q, self._smallest = t_end, first_step, order, smallest
        self._just_rejected = False
        self.accepted = self.rejected = self.forced = 0

    def propose(self, t: float, limit: float, memory: SweepState) -> Proposal:
        """The step that the last error allows."""
        if t + self._h >= self._t_end:
            return Proposal(self._t_end - t, self._t_end)
        return Proposal(self._h, t + self._h)

    def next_zero(self) -> float | None:
        """None: the published control does not look for singular configurations."""
        return None

    def decide(self, proposal: Proposal, result: SweepResult | None) -> StepDecision:
        """Accept if xi <= 1, or if the step cannot be made smaller."""
        xi = math.inf if result is None else result.error_ratio
        largest = 1.0 if self._just_rejected else LARGEST_FACTOR
        raw = SAFETY * max(xi, 1e-12) ** (-1.0 / (self._q + 1))
        factor = min(largest, max(1.0 / LARGEST_FACTOR, raw))
        self._h = max(self._smallest, proposal.h * factor)
        forced = xi > 1.0 and proposal.h <= self._smallest * (1.0 + 1e-9)
        if result is None or (xi > 1.0 and not forced):
            self.rejected += 1
            self._just_rejected = True
            return StepDecision.REJECTED
        self.accepted += 1
        self.forced += forced
        self._just_rejected = False
        return StepDecision.ACCEPTED
