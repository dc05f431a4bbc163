r"""Steps made of sweeps: SRM, and the forms of PSRM whose corrector is a sweep.

A step is a first multiplier yhat_0(t) and ``iterations`` corrector sweeps, sweep s with the
multiplier of sweep s - 1 (docs/notation.md, "Sweeps").  Sweeps either keep their own trajectories
for the whole run, as in the thesis, or all start from the accepted state of the last one.

The error estimate is the embedded pair of the last sweep.  It is never the difference of two
sweeps' trajectories: these drift apart, and their difference does not fall with the step (the
impasse of the thesis, section 5.7).  The pair of one sweep does not see what more sweeps would
correct; this shows in the constraint error.  The constraint error that a step adds, (E g, E c) at
its end less exp(-h/eps) of that at its start, counts as well.  Constraint errors last for about
eps, which may be many steps: in two sweeps that carry yhat, where eps is longer than the steps, it
is counted over 1 - exp(-h/eps), the error at which such steps would settle.  All parts vanish with
the step.  Sweeps with own histories also keep the constraint errors of their past, which no step
reduces: their runs report it.

Next to a singular configuration the algebra of all sweeps is evaluated on the branch
(:class:`~srm_mbs.integration.methods.thesis.sweep.OnBranch`), and own histories that are too far
from the closures to determine the branch are restarted from the accepted state.

The zone serves the exact prediction only.  Multipliers of sweeps carry their initial layers and
errors of order eps; runs that extrapolate them stall where others pass (measured).

**Split takeover.**  Sweeps take short steps: their error is a power of eps, which is about as long
as a step.  Next to a singular configuration rounding of the positions, u, changes h times the
acceleration by

    2 w h |v| u / sigma^2,   w = |d sigma / dt| / sigma.

A step that crosses has stages at a fraction of |d sigma / dt| h, so that this grows like 1/h^2 as
steps get shorter, and no tolerance below it can be kept, however short the step.  Longer steps can:
the limit of infinitely many sweeps, whose multiplier is E gamma, is the split form of the same
tableau (:mod:`srm_mbs.integration.methods.split_step`), and its error has the order of the tableau.
It makes the steps from before the configuration to after it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System, Terms
from srm_mbs.errors import EvaluationError, time_text
from srm_mbs.integration.methods.base import ErrorNorm, StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau, DenseExtension
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.integration.methods.near_singular import (
    AMBIGUOUS_DISTANCE,
    NEAR_STEPS,
    UNCERTAINTY_SIGMA_CHANGE,
    WATCHED_SIGMA,
)
from srm_mbs.integration.methods.split_step import SplitStep, history_after
from srm_mbs.integration.methods.thesis.regularisation import Regularisation, real_stability_limit
from srm_mbs.integration.methods.thesis.sweep import (
    Answer,
    OnBranch,
    Start,
    Sweep,
    SweepEquation,
    SweepNode,
    SweepResult,
    SweepStages,
    SweepState,
    nodes_of,
)

PLACED_STAGE_SIGMA = 0.25
"""Smallest sigma of the stages of a well placed step across a singular configuration, over its
change of sigma, about."""
LARGEST_RESIDUAL = 0.1
"""Constraint residual after a step, in row units, from which its sweeps have come apart.  Larger
than for corrected steps: the sweeps of a coarse step leave errors of order eps^m."""
EPS_DECREASE = 0.7
"""Smallest ratio of eps to that of the last accepted step.  With eps proportional to the trial
step, shorter steps would not make a step's change small (v h/eps stays), and an error estimate
above the tolerance would stay there."""
SETTLING_RATIO = 0.5
"""h/eps below which a constraint error is counted as it settles.  Above, schemes do not damp like
exp(-h/eps), and what they leave would count however short the step."""
REPORTED_DRIFT = 10.0
"""Constraint error of the last sweep, over the tolerance, from which a message reports it."""
_NO_RANK = int(np.iinfo(np.int64).max)
"""Rank of a first stage that was evaluated in the step before."""


def may_be_taken_over(system: System, scheme: ButcherTableau, norm: ErrorNorm) -> bool:
    """Whether the split form may take over from sweeps of ``system``: with step-size control, and
    if they carry yhat, which can be predicted and stays bounded."""
    adaptive = norm.negligible > 0.0 and scheme.error is not None
    return adaptive and system.has_constraints and system.predicts and system.carries_yhat


def unresolved(stages: SweepStages) -> bool:
    """Whether a singular configuration is near that a step like that of ``stages`` cannot cross
    within the tolerance, because of rounding."""
    change = stages.sigma_change
    if not (stages.memory.sigma < WATCHED_SIGMA and change > 0.0):
        return False
    noise = stages.rounding(PLACED_STAGE_SIGMA * change, change, True)
    return stages.norm(noise, stages.weights) > 1.0


def first_history(terms: Terms, t: float, node: SweepNode) -> MultiplierHistory:
    """The multipliers from which the split form predicts after it took over from sweeps at ``t``,
    with ``terms``."""
    if node.history is not None:
        return node.history
    return MultiplierHistory.begin(t, terms.multiplier().copy())


def split_takeover(
    system: System,
    scheme: ButcherTableau,
    t: float,
    h: float,
    state: FloatArray,
    memory: SweepState,
    norm: ErrorNorm,
    remembers: bool,
) -> SweepResult:
    """A step of the split form for sweeps, which all continue from its end.

    Parameters
    ----------
    remembers
        Whether the sweeps keep a history of their own.
    """
    node = memory.sweeps[-1]
    history = node.history
    if not node.taken_over or history is None:
        terms = system.evaluate(t, state)
        history = first_history(terms, t, node)
        memory = replace(memory, rate=terms.rate().copy(), sigma=terms.sigma)
    inner = replace(memory, history=history, sweeps=())
    result = SplitStep(scheme).step(system, t, h, state, inner, norm)
    near = float(result.sigmas[-1]) < WATCHED_SIGMA
    multiplier = node.multiplier if result.multiplier is None else result.multiplier
    kept: MultiplierHistory | None = history_after(history, result)
    rates = _with_extra_stages(system, scheme, state, result)
    if not near:
        multiplier = system.evaluate(t + h, result.state).multiplier().copy()
        kept = MultiplierHistory.begin(t + h, multiplier) if remembers else None
    end = SweepNode(result.state, multiplier, None, 0.0, kept, 0.0, multiplier, near)
    made = {own.name: getattr(result, own.name) for own in fields(result)} | {"rates": rates}
    return SweepResult(**made, sweeps=(end,) * len(memory.sweeps), taken_over=True)


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


class First(Enum):
    """The multiplier that the first corrector sweep is given."""

    ZERO = "0"
    HELD = "that of the last sweep at the start of the step"
    EXACT = "the exact one, on a predictor sweep's own trajectory"
    FUSED = "the exact one, at the corrector's own stages"


def _corrector(previous: FloatArray, eps: float) -> Answer:
    return lambda terms, j: terms.sweep(previous[j], eps)


def _on_branch(stages: SweepStages, eps: float | None) -> OnBranch | None:
    """None where sweeps carry y, which need not stay bounded next to a singular configuration."""
    return OnBranch(stages, eps) if stages.system.carries_yhat else None


def _fused(eps: float) -> Answer:
    return lambda terms, _: terms.sweep(terms.prediction(), eps)


def _predictor(terms: Terms, j: int) -> tuple[FloatArray, FloatArray]:
    return terms.rate(), terms.prediction()


@dataclass(frozen=True, eq=False)
class IteratedSweeps:
    """The steps of :class:`~srm_mbs.integration.methods.thesis.srm.SRM`, and of the forms of
    :class:`~srm_mbs.integration.methods.psrm.PSRM` with sweeps.

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
        From :func:`~srm_mbs.integration.methods.thesis.sweep.interpolant`.
    """

    scheme: ButcherTableau
    first: First
    iterations: int
    own_history: bool
    eps: Regularisation
    interpolant: DenseExtension | str

    def start(self, system: System, t: float, state: FloatArray, norm: ErrorNorm) -> SweepState:
        """All sweeps at ``state``; own histories with multiplier 0, as in the thesis."""
        terms = system.evaluate(t, state)
        memory = SweepState(terms.rate().copy(), terms.sigma, system.state_scale(state))
        multiplier = np.zeros(system.multiplier_size)
        if self.first is not First.ZERO and system.predicts:
            multiplier = terms.prediction().copy()
        history = None
        if self._exact and system.has_constraints:
            history = MultiplierHistory.begin(t, terms.multiplier())
        node = SweepNode(state, multiplier, None, 0.0, history)
        if memory.sigma < WATCHED_SIGMA and may_be_taken_over(system, self.scheme, norm):
            node = replace(node, history=first_history(terms, t, node), taken_over=True)
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
        memory: SweepState,
        norm: ErrorNorm,
    ) -> SweepResult:
        """One step; see :class:`~srm_mbs.integration.methods.base.Method`."""
        eps = max(self.eps(h), EPS_DECREASE * memory.sweeps[-1].eps)
        if not (math.isfinite(eps) and eps > 0.0):
            raise EvaluationError(f"eps = {eps} for the step {h:.1e}{system.time_unit}")
        change = h * memory.sigma_slope
        gathered = self._gathered(system, memory, change)
        kept = memory.sweeps[-1].history
        weights = norm.weights(memory.state_scale)
        stages = SweepStages(system, gathered, norm, weights, h, change, kept, t + h, eps)
        if may_be_taken_over(system, self.scheme, norm) and (
            memory.sweeps[-1].taken_over or unresolved(stages)
        ):
            return split_takeover(system, self.scheme, t, h, state, memory, norm, self._exact)
        runs = (self._own_sweeps if self.own_history else self._restarted_sweeps)(t, stages)
        last = runs[-1]
        self._check_closures(stages, last.state)

        state_scale = system.state_scale(last.state)
        error_ratio, drift_ratio = self._estimate(t, stages, state_scale, last)
        ends = runs if self.own_history else runs[-1:]
        sweeps = tuple(self._end(stages, node, run) for node, run in zip(gathered.sweeps, ends))
        weak = any(run.rank_deficient for run in runs)
        return SweepResult(
            t=t,
            h=h,
            state=last.state,
            rates=last.rates,
            end_rate=last.end_rate,
            correction=np.zeros(0),
            error_ratio=error_ratio,
            sigmas=np.min([run.sigmas for run in runs], axis=0),
            rank=min(run.rank for run in runs),
            state_scale=state_scale,
            zone=stages.zone if weak else None,
            history=kept if weak else None,
            sweeps=sweeps,
            drift_ratio=drift_ratio,
            closure_distance=max(node.closure_distance for node in sweeps),
            restarted=gathered is not memory,
        )

    def _estimate(
        self, t: float, stages: SweepStages, state_scale: FloatArray, last: Sweep
    ) -> tuple[float, float]:
        """Error estimate of the ``last`` sweep, and its constraint error, over tolerance."""
        scheme, s = self.scheme, self.scheme.n_stages
        if scheme.error is None:
            return 0.0, 0.0
        system, norm, h, eps = stages.system, stages.norm, stages.h, stages.eps
        history = stages.history
        weights = norm.weights(np.maximum(stages.memory.state_scale, state_scale))
        weights = stages.widened(weights, scheme, last.sigmas)
        error = h * np.abs(scheme.error @ last.rates[: s + 1])
        if history is not None and stages.sigma_change > UNCERTAINTY_SIGMA_CHANGE:
            for j in last.rank_deficient:
                if j < s:
                    uncertainty = history.uncertainty(t + scheme.c[j] * h)
                    error[system.multiplier_part] += h * abs(scheme.b[j]) * uncertainty
        if last.off is None:
            return norm(error, weights), 0.0
        settled = 0.0
        if last.off_before is not None:
            decay = math.exp(-h / eps)
            added = np.abs(last.off - decay * last.off_before)
            error = np.maximum(error, added)
            lowest = float(last.sigmas.min())
            lasting = self._exact and system.carries_yhat and h < SETTLING_RATIO * eps
            if lasting and lowest > 0.0:
                rotation = norm(stages.rotation_drift(last.off_before, lowest), weights)
                settled = max(0.0, norm(added, weights) - rotation) / -math.expm1(-h / eps)
        return max(norm(error, weights), settled), norm(last.off, weights)

    def accept(self, memory: SweepState, result: SweepResult) -> None:
        """Move ``memory`` to the end of an accepted step."""
        memory.rate = result.end_rate
        memory.sigma = float(result.sigmas[-1])
        memory.state_scale = result.state_scale
        memory.sweeps = result.sweeps

    def resume(
        self, system: System, t: float, state: FloatArray, memory: SweepState, norm: ErrorNorm
    ) -> SweepState:
        """``memory`` after a breakpoint; see :class:`~srm_mbs.integration.methods.base.Method`.

        Multipliers of corrector sweeps follow from positions and velocities alone, (2.6), and do
        not jump; own histories continue.
        """
        fresh = self.start(system, t, state, norm)
        fresh.sigma_slope, fresh.steps = memory.sigma_slope, memory.steps
        if self.own_history and not fresh.sweeps[-1].taken_over:
            first = fresh.sweeps[-1].history
            fresh.sweeps = tuple(replace(node, rate=None, history=first) for node in memory.sweeps)
        return fresh

    def _own_sweeps(self, t: float, stages: SweepStages) -> list[Sweep]:
        """Every sweep from its own state; the fused form is its one sweep with another equation."""
        system, memory, eps, zone = stages.system, stages.memory, stages.eps, stages.zone
        fused = self.first is First.FUSED
        constant = memory.sweeps[0].first_multiplier
        first = np.zeros(system.multiplier_size) if constant is None else constant
        previous = np.tile(first, (len(nodes_of(self.scheme).c), 1))
        near = _on_branch(stages, eps)
        runs: list[Sweep] = []
        equation: SweepEquation | None = None
        for node in memory.sweeps:
            if equation is not None:
                previous = equation.multipliers_at_nodes(runs[-1], self.interpolant)
            answer = _fused(eps) if fused else _corrector(previous, eps)
            equation = SweepEquation(system, self.scheme, t, stages.h, answer, zone, near)
            if node.rate is not None and math.isclose(eps, node.eps, rel_tol=1e-12):
                start = Start(node.rate, node.multiplier, memory.sigma, _NO_RANK)
            else:
                terms = system.evaluate(t, node.state, zone)
                rate = answer(terms, 0)[0]
                if near is not None:
                    # With c = 1 it moves to the branch as the end of a step does.
                    terms, rate, *_ = near(terms, t, 1.0, node.state, 0, answer)
                start = Start.of(terms, rate, node.multiplier)
            runs.append(equation.integrate(node.state, start, exact=fused, off=True))
        return runs

    def _restarted_sweeps(self, t: float, stages: SweepStages) -> list[Sweep]:
        """All sweeps from the accepted state, whose evaluation they share."""
        system, eps, zone = stages.system, stages.eps, stages.zone
        node = stages.memory.sweeps[-1]
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
            starts.append(Start.of(terms, terms.rate(), multiplier))
        off_before = terms.correction() + (0.0 if moved is None else moved)
        previous = np.tile(multiplier, (len(nodes_of(self.scheme).c), 1))
        for _ in range(self.iterations):
            rate, multiplier = (part.copy() for part in terms.sweep(multiplier, eps))
            rate, multiplier = OnBranch(stages, eps).with_own_terms(rate, multiplier, moved)
            starts.append(Start.of(terms, rate, multiplier))
        runs: list[Sweep] = []
        equation: SweepEquation | None = None
        for start in starts:
            if equation is not None:
                previous = equation.multipliers_at_nodes(runs[-1], self.interpolant)
            predictor = exact and not runs
            answer = _predictor if predictor else _corrector(previous, eps)
            near = _on_branch(stages, None if predictor else eps)
            equation = SweepEquation(system, self.scheme, t, stages.h, answer, zone, near)
            last = start is starts[-1]
            runs.append(equation.integrate(node.state, start, exact=exact, off=last))
        runs[-1] = replace(runs[-1], off_before=off_before)
        return runs

    def _gathered(self, system: System, memory: SweepState, change: float) -> SweepState:
        """``memory`` with own histories restarted where they could change the branch.

        The distance of the first sweeps from the closures is eps (yhat - y_0), a part of sigma next
        to a singular configuration: there they follow a neighbouring level of g, which bends away.
        All sweeps then start again from the accepted state, with its multiplier for y_0, without an
        initial layer, and their distance is eps times the change of yhat since.
        """
        if not (self.own_history and self.first is First.ZERO and system.carries_yhat):
            return memory
        off = max(node.closure_distance for node in memory.sweeps)
        if not off > AMBIGUOUS_DISTANCE * max(0.0, memory.sigma - NEAR_STEPS * change):
            return memory
        last = memory.sweeps[-1]
        node = replace(last, rate=None, first_multiplier=last.multiplier)
        return replace(memory, sweeps=(node,) * len(memory.sweeps))

    def _end(self, stages: SweepStages, node: SweepNode, run: Sweep) -> SweepNode:
        """``node`` at the end of the step."""
        multiplier = run.multipliers[self.scheme.n_stages]
        history = node.history
        if history is not None and run.exact is not None:
            history = history.extended(stages.end, run.exact)
        off = 0.0 if run.off is None else stages.system.position_norm(run.off)
        rate = run.end_rate if self.own_history else None
        return SweepNode(
            run.state, multiplier, rate, stages.eps, history, off, node.first_multiplier
        )

    def _check_closures(self, stages: SweepStages, state: FloatArray) -> None:
        """Refuse a step to ``state`` whose sweeps came apart.

        Raises
        ------
        EvaluationError
            Names the stability limit, where the ratio h/eps is beyond it.
        """
        system = stages.system
        if not system.has_constraints:
            return
        if np.isfinite(state).all() and (
            system.constraint_residual(stages.end, state) < LARGEST_RESIDUAL
        ):
            return
        limit, ratio = real_stability_limit(self.scheme), stages.h / stages.eps
        reason = (
            f"; h/eps = {ratio:.3g} is beyond {limit:.3g}, up to which {self.scheme.name} is "
            "stable: use a larger eps or a smaller step"
            if ratio > limit
            else f" with h/eps = {ratio:.3g}; use a larger eps, fewer sweeps or a smaller step"
        )
        raise EvaluationError(f"the sweeps leave the constraints{reason}")

    def run_messages(self, steps: Sequence[StepResult], norm: ErrorNorm) -> str:
        """Sentences about restarts, split takeovers and drift in a run with ``steps``."""
        made = [step for step in steps if isinstance(step, SweepResult)]
        restarted = [step.t for step in made if step.restarted]
        taken_over = [step.t for step in made if step.taken_over]
        text = ""
        if restarted:
            text += (
                f" The sweeps gave up their own histories in {len(restarted)} steps, first at "
                f"t = {time_text(restarted[0])}: sigma was falling, they were too far off the "
                "constraints to tell the branch if a singular configuration came, and started "
                "again from the accepted state."
            )
        if taken_over:
            text += (
                f" {len(taken_over)} steps next to singular configurations, the first at "
                f"t = {time_text(taken_over[0])}, are of the split PSRM: rounding would have "
                "exceeded the tolerance in sweeps."
            )
        worst = max(made, key=lambda step: step.drift_ratio, default=None)
        if norm.negligible > 0.0 and worst is not None and worst.drift_ratio > REPORTED_DRIFT:
            text += (
                f" The last sweep was off the constraints by up to {worst.drift_ratio:.2g} times "
                f"the tolerance (at t = {time_text(worst.t + worst.h)}), which no step-size "
                "control mends: sweeps are accurate to a power of eps. Use restarted sweeps "
                "(restart=True, carry=True), a smaller eps, or PSRM."
            )
        return text
