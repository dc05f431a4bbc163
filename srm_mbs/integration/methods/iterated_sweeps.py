r"""Steps made of sweeps: SRM, and the forms of PSRM whose corrector is a sweep.

A step is a first multiplier yhat_0(t) and ``iterations`` corrector sweeps, sweep s with the
multiplier of sweep s - 1 (docs/notation.md, "Sweeps").  Sweeps either keep their own trajectories
for the whole run, as in the thesis, or all start from the accepted state of the last one.

The error estimate is the embedded pair of the last sweep.  It is never the difference of two
sweeps' trajectories: these drift apart, and their gap does not fall with the step (the impasse of
the thesis, section 5.7).  The pair of one sweep does not see what more sweeps would correct; this
shows in the constraint error.  What a step adds to it, (E g, E c) at its end less exp(-h/eps) of
that at its start, counts as well.  Constraint errors last for about eps, which may be many steps:
in two sweeps that carry yhat, where eps is longer than the steps, it is counted over
1 - exp(-h/eps), the error at which such steps would settle.  All parts vanish with the step.
Sweeps with own histories are off the closures by what their histories left, which no step mends:
their runs report it.

Next to a singular configuration the algebra of all sweeps is evaluated on the branch
(:class:`~srm_mbs.integration.methods.sweep.OnBranch`), and own histories that are too far off the
closures to tell the branch are restarted from the accepted state.

The zone serves the exact prediction only.  Multipliers of sweeps carry their initial layers and
errors of order eps; extrapolated, they stalled runs that pass without (measured).  Where rounding
leaves sweeps no way, the split form makes the steps
(:mod:`srm_mbs.integration.methods.iterated_sweeps`).

Where sweeps cannot pass a singular configuration, the split form does.

Sweeps take short steps: their error is a power of eps, which is about as long as a step.  Next to a
singular configuration their algebra has to be evaluated on the branch (:mod:`.branch`), and what
rounding of the positions, u, does to h times the acceleration there is

    2 w h |v| u / sigma^2,   w = |d sigma / dt| / sigma.

A step that crosses has stages at a fraction of |d sigma / dt| h, so that this grows like 1/h^2 as
steps get shorter, and no tolerance below it can be kept, however short the step.  Longer steps can:
the limit of infinitely many sweeps, whose multiplier is E gamma, is the split form of the same
tableau (:mod:`.split`), and its error has the order of the tableau.  It takes over before the
configuration, and hands back behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System, Terms
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, StepResult, SweepNode
from srm_mbs.integration.methods.butcher import ButcherTableau, DenseExtension
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.integration.methods.near_singular import (
    AMBIGUOUS,
    COUNT_UNCERTAINTY_ABOVE,
    NEAR,
    WATCHED,
    BranchStages,
)
from srm_mbs.integration.methods.regularisation import Regularisation, real_stability_limit
from srm_mbs.integration.methods.split_step import history_after, split_step
from srm_mbs.integration.methods.sweep import (
    Answer,
    OnBranch,
    Start,
    Sweep,
    multipliers_between,
    nodes_of,
    sweep_over,
)

RESOLVED = 0.25
"""Part of a step's change of sigma at which the stages of a well placed step lie that crosses a
singular configuration, about."""


def can_hand_over(system: System, scheme: ButcherTableau, norm: ErrorNorm) -> bool:
    """Whether sweeps of ``system`` may hand over to the split form: with step-size control, and if
    they carry yhat, which can be predicted and stays bounded."""
    adaptive = norm.negligible > 0.0 and scheme.error is not None
    return adaptive and system.has_constraints and system.predicts and system.carries_yhat


def unresolved(stages: BranchStages) -> bool:
    """Whether a singular configuration is near that a step like that of ``stages`` cannot cross
    within the tolerance, because of rounding."""
    change = stages.sigma_change
    if not (stages.memory.sigma < WATCHED and change > 0.0):
        return False
    noise = stages.rounding(RESOLVED * change, change, True)
    return stages.norm(noise, stages.weights) > 1.0


def first_history(terms: Terms, t: float, node: SweepNode) -> MultiplierHistory:
    """What the split form predicts from that takes over from sweeps at ``t``, with ``terms``."""
    if node.history is not None:
        return node.history
    return MultiplierHistory.begin(t, terms.multiplier().copy())


def split_passing(
    system: System,
    scheme: ButcherTableau,
    t: float,
    h: float,
    state: FloatArray,
    memory: IntegratorState,
    norm: ErrorNorm,
    remembers: bool,
) -> StepResult:
    """A step of the split form for sweeps, which all stand where it ends.

    Parameters
    ----------
    remembers
        Whether the sweeps keep a history of their own.
    """
    node = memory.sweeps[-1]
    history = node.history
    if not node.passing or history is None:
        terms = system.evaluate(t, state)
        history = first_history(terms, t, node)
        memory = replace(memory, rate=terms.rate().copy(), sigma=terms.sigma)
    inner = replace(memory, history=history, sweeps=())
    result = split_step(system, scheme, t, h, state, inner, norm, 1.0)
    result.passing = True
    result.rates = _with_extra_stages(system, scheme, state, result)
    passing = float(result.sigmas[-1]) < WATCHED
    multiplier = node.multiplier if result.multiplier is None else result.multiplier
    kept: MultiplierHistory | None = history_after(history, result)
    if not passing:
        multiplier = system.evaluate(t + h, result.state).multiplier().copy()
        kept = MultiplierHistory.begin(t + h, multiplier) if remembers else None
    end = SweepNode(result.state, multiplier, None, 0.0, kept, 0.0, multiplier, passing)
    result.sweeps = (end,) * len(memory.sweeps)
    return result


def _with_extra_stages(
    system: System, scheme: ButcherTableau, state: FloatArray, result: StepResult
) -> FloatArray:
    """Chart rates at all nodes, as sweeps give them."""
    A, c = scheme.dense.extra_A, scheme.dense.extra_c.tolist()
    stages = len(result.rates)
    rates = np.zeros((stages + len(c), system.tangent_size))
    rates[:stages] = result.rates
    for k, ck in enumerate(c):
        delta = (result.h * A[k]) @ rates
        x = system.retract(state, delta)
        terms = system.evaluate(result.t + ck * result.h, x, result.zone)
        rates[stages + k] = system.chart_rate(delta, terms.rate())
    return rates


APART = 0.1
"""Constraint error after a step, in row units, from which its sweeps are said to have come apart.
Looser than for corrected steps: the sweeps of a coarse step leave errors of order eps^m."""
EPS_SHRINKS = 0.7
"""eps falls at most by this factor from one accepted step to the next.  With eps proportional to
the trial step, shorter steps would not make a step's change small (v h/eps stays), and an error
estimate above the tolerance would stay there."""
LASTS = 0.5
"""h/eps below which a constraint error is counted as it settles.  Above, schemes do not damp like
exp(-h/eps), and what they leave would count however short the step."""
_MANY = int(np.iinfo(np.int64).max)


class First(Enum):
    """The multiplier that the first corrector sweep is given."""

    ZERO = "0"
    HELD = "that of the last sweep at the start of the step"
    EXACT = "the exact one, on a predictor sweep's own trajectory"
    FUSED = "the exact one, at the corrector's own stages"


def _corrector(previous: FloatArray, eps: float) -> Answer:
    return lambda terms, j: terms.sweep(previous[j], eps)


def _on_branch(stages: BranchStages, eps: float | None) -> OnBranch | None:
    """None where sweeps carry y, which need not stay bounded next to a singular configuration."""
    return OnBranch(stages, eps) if stages.system.carries_yhat else None


def _predictor(terms: Terms, j: int) -> tuple[FloatArray, FloatArray]:
    return terms.rate(), terms.prediction()


@dataclass(frozen=True, eq=False)
class IteratedSweeps:
    """The common engine; users see :class:`~srm_mbs.integration.methods.srm.SRM` and PSRM.

    Parameters
    ----------
    scheme
        Runge-Kutta data.
    first
        Multiplier of the first sweep.
    iterations
        Number m of corrector sweeps.
    own_history
        Whether every sweep keeps its own trajectory.
    eps
        Regularisation as a function of the step.
    interpolant
        From :func:`~srm_mbs.integration.methods.sweep.interpolant`.
    """

    scheme: ButcherTableau
    first: First
    iterations: int
    own_history: bool
    eps: Regularisation
    interpolant: DenseExtension | str

    def start(
        self, system: System, t: float, state: FloatArray, norm: ErrorNorm
    ) -> IntegratorState:
        """All sweeps at ``state``; own histories with multiplier 0, as in the thesis."""
        terms = system.evaluate(t, state)
        memory = IntegratorState(terms.rate().copy(), terms.sigma, system.state_scale(state))
        multiplier = np.zeros(system.multiplier_size)
        if self.first is not First.ZERO and system.predicts:
            multiplier = terms.prediction().copy()
        history = None
        if self._exact and system.has_constraints:
            history = MultiplierHistory.begin(t, terms.multiplier())
        node = SweepNode(state, multiplier, None, 0.0, history)
        if memory.sigma < WATCHED and can_hand_over(system, self.scheme, norm):
            node = replace(node, history=first_history(terms, t, node), passing=True)
        memory.sweeps = (node,) * (self.iterations if self.own_history else 1)
        return memory

    @property
    def _exact(self) -> bool:
        return self.first in (First.EXACT, First.FUSED)

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
        eps = max(self.eps(h), EPS_SHRINKS * memory.sweeps[-1].eps)
        if not (math.isfinite(eps) and eps > 0.0):
            raise EvaluationError(f"eps = {eps} for the step {h:.1e} s")
        change = h * memory.sigma_slope
        gathered, restarted = self._gathered(system, memory, change)
        kept = memory.sweeps[-1].history
        weights = norm.weights(memory.state_scale)
        stages = BranchStages(system, gathered, norm, weights, h, change, kept, t + h, eps)
        if can_hand_over(system, self.scheme, norm) and (
            memory.sweeps[-1].passing or unresolved(stages)
        ):
            return split_passing(system, self.scheme, t, h, state, memory, norm, self._exact)
        memory = gathered
        make = self._own_sweeps if self.own_history else self._restarted_sweeps
        runs = make(system, t, h, eps, memory, stages)
        last = runs[-1]
        self._check_closures(system, t + h, last.state, h, eps)

        state_scale = system.state_scale(last.state)
        error_ratio, drift_ratio = self._estimate(t, h, eps, state_scale, stages, last)
        ends = runs if self.own_history else runs[-1:]
        sweeps = tuple(
            self._end(system, node, run, t + h, eps) for node, run in zip(memory.sweeps, ends)
        )
        weak = any(run.rank_deficient for run in runs)
        return StepResult(
            t=t,
            h=h,
            state=last.state,
            rates=last.rates,
            end_rate=last.end_rate,
            correction=np.zeros(0),
            error_ratio=error_ratio,
            sigmas=np.min([run.sigmas for run in runs], axis=0),
            rank=min(run.rank for run in runs),
            zone=stages.zone if weak else None,
            history=kept if weak else None,
            multiplier=None,
            state_scale=state_scale,
            sweeps=sweeps,
            drift_ratio=drift_ratio,
            off=max(node.off for node in sweeps),
            restarted=restarted,
        )

    def _estimate(
        self,
        t: float,
        h: float,
        eps: float,
        state_scale: FloatArray,
        stages: BranchStages,
        last: Sweep,
    ) -> tuple[float, float]:
        """Error estimate of the ``last`` sweep, and its constraint error, over tolerance."""
        scheme, s = self.scheme, self.scheme.n_stages
        if scheme.error is None:
            return 0.0, 0.0
        system, norm, memory, history = stages.system, stages.norm, stages.memory, stages.history
        weights = norm.weights(np.maximum(memory.state_scale, state_scale))
        weights = stages.widened(weights, scheme, last.sigmas)
        error = h * np.abs(scheme.error @ last.rates[: s + 1])
        if history is not None and stages.sigma_change > COUNT_UNCERTAINTY_ABOVE:
            for j in last.rank_deficient:
                if j < s:
                    uncertainty = history.uncertainty(t + scheme.c[j] * h)
                    part = system.multiplier_part
                    error[part] += h * abs(scheme.b[j]) * uncertainty
        if last.off is None:
            return norm(error, weights), 0.0
        settled = 0.0
        if last.off_before is not None:
            decay = math.exp(-h / eps)
            added = np.abs(last.off - decay * last.off_before)
            error = np.maximum(error, added)
            lowest = float(last.sigmas.min())
            lasting = self._exact and system.carries_yhat and h < LASTS * eps
            if lasting and lowest > 0.0:
                turning = norm(stages.turning(last.off_before, lowest), weights)
                settled = max(0.0, norm(added, weights) - turning) / -math.expm1(-h / eps)
        return max(norm(error, weights), settled), norm(last.off, weights)

    def accept(self, memory: IntegratorState, result: StepResult) -> None:
        """Move ``memory`` to the end of an accepted step."""
        memory.rate = result.end_rate
        memory.sigma = float(result.sigmas[-1])
        memory.state_scale = result.state_scale
        memory.sweeps = result.sweeps

    def resume(
        self, system: System, t: float, state: FloatArray, memory: IntegratorState, norm: ErrorNorm
    ) -> IntegratorState:
        """``memory`` behind a breakpoint; see :class:`~srm_mbs.integration.methods.base.Method`.

        Multipliers of corrector sweeps follow from positions and velocities alone, (2.6), and do
        not jump; own histories go on.
        """
        fresh = self.start(system, t, state, norm)
        fresh.sigma_slope, fresh.steps = memory.sigma_slope, memory.steps
        if self.own_history and not fresh.sweeps[-1].passing:
            first = fresh.sweeps[-1].history
            fresh.sweeps = tuple(replace(node, rate=None, history=first) for node in memory.sweeps)
        return fresh

    def _own_sweeps(
        self,
        system: System,
        t: float,
        h: float,
        eps: float,
        memory: IntegratorState,
        stages: BranchStages,
    ) -> list[Sweep]:
        """Every sweep from its own state; the fused form is its one sweep with another equation."""
        fused = self.first is First.FUSED
        given = memory.sweeps[0].given
        first = np.zeros(system.multiplier_size) if given is None else given
        previous = np.tile(first, (len(nodes_of(self.scheme).c), 1))
        near, zone = _on_branch(stages, eps), stages.zone
        runs: list[Sweep] = []
        for k, node in enumerate(memory.sweeps):
            answer = _corrector(previous, eps)
            if fused:

                def answer(terms: Terms, j: int) -> tuple[FloatArray, FloatArray]:
                    return terms.sweep(terms.prediction(), eps)

            if node.rate is not None and math.isclose(eps, node.eps, rel_tol=1e-12):
                start = Start(node.rate, node.multiplier, memory.sigma, _MANY)
            else:
                terms = system.evaluate(t, node.state, zone)
                rate = answer(terms, 0)[0]
                if near is not None:
                    terms, rate, *_ = near(terms, t, 1.0, node.state, 0, answer)
                start = Start(
                    rate.copy(), node.multiplier, terms.sigma, terms.rank, terms.rank_deficient
                )
            final = k + 1 == len(memory.sweeps)
            run = sweep_over(
                system,
                self.scheme,
                t,
                h,
                node.state,
                answer,
                start,
                zone,
                near,
                exact=fused,
                off=True,
            )
            runs.append(run)
            if not final:
                previous = multipliers_between(
                    system, self.scheme, self.interpolant, t, h, run, answer, zone, near
                )
        return runs

    def _restarted_sweeps(
        self,
        system: System,
        t: float,
        h: float,
        eps: float,
        memory: IntegratorState,
        stages: BranchStages,
    ) -> list[Sweep]:
        """All sweeps from the accepted state, whose evaluation they share."""
        node, zone = memory.sweeps[-1], stages.zone
        terms, moved = system.evaluate(t, node.state, zone), None
        if _on_branch(stages, eps) is not None:
            terms, _, moved = stages(terms, t, 1.0, node.state)
        starts: list[Start] = []
        multiplier = np.zeros(system.multiplier_size)
        if self.first is First.HELD:
            multiplier = node.multiplier
        exact = self.first is First.EXACT
        if exact:
            multiplier = terms.prediction().copy()
            starts.append(
                Start(
                    terms.rate().copy(), multiplier, terms.sigma, terms.rank, terms.rank_deficient
                )
            )
        off_before = terms.correction() + (0.0 if moved is None else moved)
        previous = np.tile(multiplier, (len(nodes_of(self.scheme).c), 1))
        for _ in range(self.iterations):
            rate, multiplier = (part.copy() for part in terms.sweep(multiplier, eps))
            rate, multiplier = OnBranch(stages, eps).with_own_terms(rate, multiplier, moved)
            starts.append(Start(rate, multiplier, terms.sigma, terms.rank, terms.rank_deficient))
        runs: list[Sweep] = []
        for k, start in enumerate(starts):
            predictor, final = exact and k == 0, k + 1 == len(starts)
            answer = _predictor if predictor else _corrector(previous, eps)
            near = _on_branch(stages, None if predictor else eps)
            run = sweep_over(
                system,
                self.scheme,
                t,
                h,
                node.state,
                answer,
                start,
                zone,
                near,
                exact=exact,
                off=final,
            )
            runs.append(run if run.off is None else replace(run, off_before=off_before))
            if not final:
                previous = multipliers_between(
                    system, self.scheme, self.interpolant, t, h, run, answer, zone, near
                )
        return runs

    def _gathered(
        self, system: System, memory: IntegratorState, change: float
    ) -> tuple[IntegratorState, bool]:
        """``memory`` with own histories restarted where they could change the branch, and whether.

        The first sweeps are off the closures by eps (yhat - y_0), a part of sigma next to a
        singular configuration: there they follow a neighbouring level of g, which turns off.  All
        sweeps then start again from the accepted state, with its multiplier for y_0: no initial
        layer, and they are off by eps times the change of yhat since.
        """
        if not (self.own_history and self.first is First.ZERO and system.carries_yhat):
            return memory, False
        off = max(node.off for node in memory.sweeps)
        if not off > AMBIGUOUS * max(0.0, memory.sigma - NEAR * change):
            return memory, False
        last = memory.sweeps[-1]
        node = replace(last, rate=None, given=last.multiplier)
        return replace(memory, sweeps=(node,) * len(memory.sweeps)), True

    def _end(self, system: System, node: SweepNode, run: Sweep, t: float, eps: float) -> SweepNode:
        multiplier = run.multipliers[self.scheme.n_stages]
        history = node.history
        if history is not None and run.exact is not None:
            history = history.extended(t, run.exact)
        off = 0.0 if run.off is None else system.position_norm(run.off)
        rate = run.end_rate if self.own_history else None
        return SweepNode(run.state, multiplier, rate, eps, history, off, node.given)

    def _check_closures(
        self, system: System, t: float, state: FloatArray, h: float, eps: float
    ) -> None:
        """Refuse a step whose sweeps came apart.

        Raises
        ------
        EvaluationError
            Names the stability limit, where the ratio h/eps is beyond it.
        """
        if not system.has_constraints:
            return
        if np.isfinite(state).all() and system.constraint_residual(t, state) < APART:
            return
        limit = real_stability_limit(self.scheme)
        reason = (
            f"; h/eps = {h / eps:.3g} is beyond {limit:.3g}, up to which {self.scheme.name} is "
            "stable: use a larger eps or a smaller step"
            if h / eps > limit
            else f" with h/eps = {h / eps:.3g}; use a larger eps, fewer sweeps or a smaller step"
        )
        raise EvaluationError(f"the sweeps leave the constraints{reason}")
