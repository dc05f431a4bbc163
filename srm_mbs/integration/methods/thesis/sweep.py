r"""One explicit Runge-Kutta sweep over a step, and its multiplier as the next sweep sees it.

Sweep s integrates its own equation with the multiplier of sweep s - 1 at the same times
(docs/notation.md).  All sweeps of a step are evaluated at the same *nodes*: the stages of the
tableau, the end of the step, and the extra stages of its continuous extension if there are any.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System, Terms, Zone
from srm_mbs.integration.methods.base import IntegratorState, StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau, DenseExtension
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.integration.methods.near_singular import NEAR_STEPS, WATCHED_SIGMA, BranchStages
from srm_mbs.model.numbers import choice

Answer = Callable[[Terms, int], tuple[FloatArray, FloatArray]]
"""(terms, node) -> tangent rate and multiplier there; the equation that a sweep integrates."""

INTERPOLATIONS = ("auto", "linear")
"""Interpolations of SRM; PSRM has ``"stages"`` as well."""
GOOD_EXTENSION = 4
"""Order from which an extension is used to interpolate the multiplier."""
ROTATION_MARGIN = 2.0
"""Safety factor of the change of a constraint error by the rotation of the closures."""

REGULARISERS = ("identity", "transpose", "inverse")
"""The matrices T of (2.2): I, (GB)^T, (GB)^-1."""


@dataclass(frozen=True, eq=False)
class SweepNode:
    """One sweep at the end of a step.

    Attributes
    ----------
    state : (nx,)
        The sweep's own state.
    multiplier
        Its multiplier there, in the form that the system's sweeps carry.
    rate : (n,) or None
        Its tangent rate there; None if the next step has to evaluate it.
    eps
        The regularisation (s) of that rate.
    history
        Its multipliers at recent step ends outside the zone; None where sweeps need no zone.
    closure_distance
        Its distance from the closures (rad, scene diagonals).
    first_multiplier
        With own histories, y_0: the constant multiplier of the first sweep; None for 0.
    taken_over
        Whether the split form makes the steps of the sweeps here (split takeover,
        :mod:`srm_mbs.integration.methods.thesis.iterated_sweeps`).
    """

    state: FloatArray
    multiplier: FloatArray
    rate: FloatArray | None
    eps: float
    history: MultiplierHistory | None
    closure_distance: float = 0.0
    first_multiplier: FloatArray | None = None
    taken_over: bool = False


@dataclass
class SweepState(IntegratorState):
    """Memory of a method with sweeps.

    Attributes
    ----------
    sweeps
        The sweeps at the current state, the last one last.
    """

    sweeps: tuple[SweepNode, ...] = ()

    def set_first_stage(
        self, rate: FloatArray, multiplier: FloatArray, history: MultiplierHistory
    ) -> None:
        """As for other methods, and for each sweep that carries a multiplier or a history."""
        super().set_first_stage(rate, multiplier, history)
        self.sweeps = tuple(
            replace(
                node,
                multiplier=multiplier if np.any(node.multiplier) else node.multiplier,
                history=None if node.history is None else history,
            )
            for node in self.sweeps
        )


@dataclass(slots=True)
class SweepResult(StepResult):
    """A proposed step of a method with sweeps.

    Attributes
    ----------
    sweeps
        The sweeps at the end.
    drift_ratio
        With an embedded pair: constraint error of the last sweep at the end, over tolerance;
        else 0.
    closure_distance
        Largest distance of any sweep from the closures at the end (rad, scene diagonals).
    restarted
        Whether sweeps with own histories started from the accepted state in this step.
    taken_over
        Whether the split form made this step (split takeover).
    """

    sweeps: tuple[SweepNode, ...] = ()
    drift_ratio: float = 0.0
    closure_distance: float = 0.0
    restarted: bool = False
    taken_over: bool = False


def sweep_nodes(memory: IntegratorState) -> tuple[SweepNode, ...]:
    """The sweeps of ``memory``; none for a method without sweeps."""
    return memory.sweeps if isinstance(memory, SweepState) else ()


def carried_multipliers(
    start: Sequence[SweepNode], steps: Sequence[StepResult]
) -> list[FloatArray]:
    """The last sweep's multiplier at the start and at the end of each step; none without sweeps."""
    ends = [step.sweeps for step in steps if isinstance(step, SweepResult)]
    return [nodes[-1].multiplier for nodes in (start, *ends) if nodes]


@dataclass
class SweepStages(BranchStages):
    """:class:`~srm_mbs.integration.methods.near_singular.BranchStages` of a step of sweeps.

    Parameters
    ----------
    eps
        Regularisation (s); a sweep keeps a constraint error for about as long.
    """

    memory: SweepState
    eps: float = 0.0

    def reach(self) -> float:
        """sigma below which the step is next to a singular configuration.

        By time, not by steps alone: errors kept over many short steps grow like 1/sigma^2 in the
        multiplier, and with h ~ sigma^1.5, which keeps that small, no run arrives.
        """
        spans = max(1.0, self.eps / self.h)
        return NEAR_STEPS * spans * self.sigma_change if self.sigma_change > 0.0 else WATCHED_SIGMA

    def rotation_drift(self, off: FloatArray, sigma: float) -> FloatArray:
        """Largest change (n,) over the step of the distance ``off`` (n,) of a sweep from the
        closures, because these rotate next to ``sigma``.

        It is a part of ``off`` however short the step: no shorter step makes it smaller.
        """
        reach = self.sigma_change / sigma
        effect = self.effect_on_rates(off, sigma, self.sigma_change)
        return ROTATION_MARGIN * (effect + reach * np.abs(off))


@dataclass(frozen=True, eq=False)
class Nodes:
    """The nodes at which the sweeps of a scheme are evaluated: s stages, the end, e extra stages.

    Attributes
    ----------
    c : (s + 1 + e,)
        Abscissae.
    A : (s + 1 + e, s + 1 + e)
        Weights of the rates before each node.
    """

    c: FloatArray
    A: FloatArray


@lru_cache(maxsize=64)
def nodes_of(scheme: ButcherTableau) -> Nodes:
    """The nodes of ``scheme`` with its default extension."""
    s, extension = scheme.n_stages, scheme.dense
    n = extension.n_rates
    A = np.zeros((n, n))
    A[:s, :s] = scheme.A
    A[s, :s] = scheme.b
    A[s + 1 :] = extension.extra_A
    return Nodes(np.concatenate([scheme.c, [1.0], extension.extra_c]), A)


def interpolant(
    scheme: ButcherTableau, interpolation: str, known: tuple[str, ...] = INTERPOLATIONS
) -> DenseExtension | str:
    """How the multiplier of a sweep reaches the nodes of the next.

    ``"auto"``: by the continuous extension where the tableau has one of order 4 or more (the
    thesis' own for dopr54), linearly for the others, as in the thesis.  ``"linear"``: between the
    ends of the step.  ``"stages"``: the values at the sweep's own stages.

    Raises
    ------
    InputError
        For a name that is not ``known``.
    """
    if choice(interpolation, known, "interpolation") != "auto":
        return interpolation
    extension = scheme.extensions.get("thesis", scheme.dense)
    return extension if extension.order >= GOOD_EXTENSION else "linear"


@dataclass(frozen=True, eq=False)
class Start:
    """A sweep at the start of a step, where it is evaluated already.

    Attributes
    ----------
    rate : (n,)
        Tangent rate.
    multiplier : (k,)
        The sweep's multiplier.
    sigma, rank, rank_deficient
        Of the evaluation.
    """

    rate: FloatArray
    multiplier: FloatArray
    sigma: float
    rank: int
    rank_deficient: bool = False

    @classmethod
    def of(cls, terms: Terms, rate: FloatArray, multiplier: FloatArray) -> Start:
        """With the ``rate`` and the ``multiplier`` that follow from ``terms``."""
        return cls(rate.copy(), multiplier, terms.sigma, terms.rank, terms.rank_deficient)


@dataclass(frozen=True, eq=False)
class Sweep:
    """A sweep over one step.

    Attributes
    ----------
    start : (nx,)
        State at the start.
    state : (nx,)
        State at the end.
    rates : (s + 1 + e, n)
        Chart rates at the nodes.
    multipliers : (s + 1 + e, k)
        Multipliers at the nodes, at the stages' own states.
    end_rate : (n,)
        Tangent rate at the end.
    sigmas : (s + 1,)
    rank
        The smallest of any node.
    rank_deficient
        Nodes with dropped rows.
    exact
        yhat by the exact prediction at the end point if it was asked for, else None.
    off : (n,) or None
        How far the end point lies off the closures, (E g, E c), if it was asked for.
    off_before : (n,) or None
        The same at the start of the step, where it is known.
    """

    start: FloatArray
    state: FloatArray
    rates: FloatArray
    multipliers: FloatArray
    end_rate: FloatArray
    sigmas: FloatArray
    rank: int
    rank_deficient: tuple[int, ...]
    exact: FloatArray | None
    off: FloatArray | None
    off_before: FloatArray | None = None


@dataclass(frozen=True)
class OnBranch:
    """Evaluates a sweep next to a singular configuration: its algebra on the branch.

    A sweep lies off the closures by its drift and the error of its stage.  M, f, P and E are taken
    at the projection on the branch, from which (dq, dv) was subtracted; the terms in 1/eps are the
    sweep's own: E g/eps = dq/eps and P v/eps = dv/eps to first order (dx/eps for a DAE).

    Attributes
    ----------
    stages
        Of the step.
    eps
        Regularisation (s); None for a sweep without terms in 1/eps.
    """

    stages: SweepStages
    eps: float | None

    def __call__(
        self, terms: Terms, t: float, c: float, x: FloatArray, j: int, answer: Answer
    ) -> tuple[Terms, FloatArray, FloatArray, FloatArray | None]:
        """Terms of the stage ``x`` with abscissa ``c``, its tangent rate, its multiplier, and what
        was subtracted, if anything."""
        terms, _, moved = self.stages(terms, t, c, x)
        return terms, *self.with_own_terms(*answer(terms, j), moved), moved

    def with_own_terms(
        self, rate: FloatArray, multiplier: FloatArray, moved: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """``rate`` and ``multiplier`` on the branch, with the sweep's own terms of a stage that
        was ``moved`` to it."""
        if moved is None or self.eps is None:
            return rate, multiplier
        system = self.stages.system
        rate = rate + system.rate_change(moved) - moved / self.eps
        return rate, multiplier + moved[system.multiplier_part] / self.eps


@dataclass(frozen=True, eq=False)
class SweepEquation:
    """The equation of one sweep over the step from ``t`` to ``t + h``.

    Parameters
    ----------
    answer
        The equation.
    zone
        The zone of the step.
    near
        How stages next to a singular configuration are evaluated; by default like all others.
    """

    system: System
    scheme: ButcherTableau
    t: float
    h: float
    answer: Answer
    zone: Zone | None = None
    near: OnBranch | None = None

    def evaluate(self, c: float, x: FloatArray) -> Terms:
        """Terms of the state ``x`` at the abscissa ``c``.

        Raises
        ------
        EvaluationError
            If it cannot be evaluated.
        """
        return self.system.evaluate(self.t + c * self.h, x, self.zone)

    def at(
        self, terms: Terms, c: float, x: FloatArray, j: int
    ) -> tuple[Terms, FloatArray, FloatArray, FloatArray | None]:
        """As :class:`OnBranch`, for the node ``j`` with ``terms`` at ``x``."""
        if self.near is None:
            return terms, *self.answer(terms, j), None
        return self.near(terms, self.t + c * self.h, c, x, j, self.answer)

    def integrate(
        self, state: FloatArray, start: Start, *, exact: bool = False, off: bool = False
    ) -> Sweep:
        """The sweep from ``state``, where it is at ``start``.

        Parameters
        ----------
        exact
            Keep yhat by the exact prediction at the end point.
        off
            Keep how far the end point lies off the closures.

        Raises
        ------
        EvaluationError
            If a stage cannot be evaluated.
        """
        system, h = self.system, self.h
        nodes, s = nodes_of(self.scheme), self.scheme.n_stages
        n = len(nodes.c)
        rates = np.empty((n, system.tangent_size))
        multipliers = np.empty((n, start.multiplier.size))
        sigmas = np.empty(s + 1)
        rates[0], multipliers[0], sigmas[0] = start.rate, start.multiplier, start.sigma
        rank = start.rank
        weak = [0] if start.rank_deficient else []
        end_exact: FloatArray | None = None
        end_off: FloatArray | None = None
        for j in range(1, n):
            delta = (h * nodes.A[j, :j]) @ rates[:j]
            x = system.retract(state, delta)
            c = float(nodes.c[j])
            terms = self.evaluate(c, x)
            if j <= s:
                sigmas[j] = terms.sigma
            terms, rate, multipliers[j], moved = self.at(terms, c, x, j)
            rates[j] = system.chart_rate(delta, rate)
            rank = min(rank, terms.rank)
            if terms.rank_deficient:
                weak.append(j)
            if j == s:
                end_state, end_rate = x, rate.copy()
                if exact and not terms.rank_deficient:
                    end_exact = terms.multiplier().copy()
                if off:
                    end_off = terms.correction() + (0.0 if moved is None else moved)
        return Sweep(
            state,
            end_state,
            rates,
            multipliers,
            end_rate,
            sigmas,
            rank,
            tuple(weak),
            end_exact,
            end_off,
        )

    def multipliers_at_nodes(self, sweep: Sweep, how: DenseExtension | str) -> FloatArray:
        """The multiplier of ``sweep`` at all nodes (s + 1 + e, k), for the next sweep.

        An extension gives the state there, at which the equation gives the multiplier; the ends of
        the step keep the values that the sweep has there.

        Parameters
        ----------
        how
            From :func:`interpolant`.
        """
        if how == "stages":
            return sweep.multipliers
        c, end = nodes_of(self.scheme).c, self.scheme.n_stages
        first, last = sweep.multipliers[0], sweep.multipliers[end]
        if isinstance(how, str):
            line: FloatArray = first + c[:, None] * (last - first)
            return line
        out = np.empty_like(sweep.multipliers)
        done: dict[float, int] = {0.0: 0, 1.0: end}
        out[0], out[end] = first, last
        for j, theta in enumerate(c.tolist()):
            if theta in done:
                out[j] = out[done[theta]]
                continue
            delta = (self.h * how.weights(theta)[0]) @ sweep.rates[: how.n_rates]
            x = self.system.retract(sweep.start, delta)
            out[j] = self.at(self.evaluate(theta, x), theta, x, j)[2]
            done[theta] = j
        return out
