"""The contract of a one-step method: make a step, and estimate its error.

A method is a Runge-Kutta tableau and a source of multipliers.  It proposes a state.  Step-size
control decides whether the step is accepted, and only :meth:`Method.accept` changes the memory.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System, Zone
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory
from srm_mbs.integration.methods.tableaus import get_tableau
from srm_mbs.model.lazy import cached_property

NEGLIGIBLE = 1e-3
"""Effect of an evaluation, over the tolerance, below which it is not made."""


@dataclass(frozen=True, eq=False)
class ErrorNorm:
    """Weighted root mean square of the thesis, (B.4).

    xi = sqrt(mean_i (e_i / (atol_i + rtol max(|x_i|, |x_new,i|)))^2) over the tangent components.

    Attributes
    ----------
    atol : (n,)
        Absolute tolerance per tangent component.
    rtol
        Relative tolerance.
    negligible
        Fraction of the tolerance below which an effect is not worth an evaluation; 0 for fixed
        steps, which have no tolerance.
    unit : (n,) or None
        Usual sizes of the tangent components; None for :attr:`one`.
    singular
        Residual (row units) of a configuration between nodes of a branch up to which the closures
        have that branch; beyond it they avoid the singular configuration on it.
    """

    atol: FloatArray
    rtol: float
    negligible: float = NEGLIGIBLE
    unit: FloatArray | None = None
    singular: float = np.inf

    @cached_property
    def one(self) -> FloatArray:
        """atol / rtol (n,): the size at which both tolerances allow the same error."""
        return self.atol / self.rtol

    def weights(self, state_scale: FloatArray) -> FloatArray:
        """atol + rtol |x| (n,)."""
        return self.atol + self.rtol * state_scale

    def __call__(self, error: FloatArray, weights: FloatArray) -> float:
        """The norm of ``error`` (n,) for ``weights`` (n,)."""
        scaled = error / weights
        return float(np.sqrt(scaled @ scaled / scaled.size))


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A system linearised at the start of a step, in the chart there.

    Attributes
    ----------
    rate : (n,)
        The tangent rate there.
    J : (n, n)
        Derivatives of the chart rates by the chart coordinates.
    by_time : (n,)
        Their derivatives by time.
    applied, laws : (m,)
        What acts in place of the laws of forces there, and what they are.
    by_coordinates : (m, n)
        Derivatives of the laws by the chart coordinates.
    by_laws : (n, m)
        Derivatives of the chart rates by what acts in place of the laws.
    places
        Whether they are those of the rates on the branch next to a singular configuration, and
        whether nodes of it solve them.
    differences
        Evaluations that regular rates were differentiated by; 0 next to a singular configuration.
    """

    rate: FloatArray
    J: FloatArray
    by_time: FloatArray
    applied: FloatArray
    laws: FloatArray
    by_coordinates: FloatArray
    by_laws: FloatArray
    places: tuple[bool, bool]
    differences: int


@dataclass
class IntegratorState:
    """Memory of a method between accepted steps.

    Attributes
    ----------
    rate : (n,)
        Tangent rate at the current state: the first stage of the next step.
    sigma
        sigma there.
    state_scale : (n,)
        |x| of the error weights there.
    history
        Multipliers at recent step ends outside the zone; None without closures.
    sigma_slope
        |d sigma / dt| (1/s) seen by step-size control; it widens the zone for fast passages.
    steps
        Number of accepted steps.
    lingering
        Whether the motion turns back next to a singular configuration, is slow there, or starts or
        ends there, so that its stages are solved by nodes of the branch.
    stiff
        Whether the problem was found to be stiff.
    stiff_steps, other_steps
        Steps that speak for a change of ``stiff``, and those after the last of them that do not
        (:mod:`srm_mbs.integration.methods.stiffness`).
    needed_steps, saved_steps
        Such steps after which the problem counts as stiff; what linearly implicit steps have saved
        since it does, in steps.
    laws : (m,) or None
        Values of the laws of forces that linearly implicit steps carry; None after other steps.
    linearisation
        The equations linearised at the current state, once a step has needed them.
    """

    rate: FloatArray
    sigma: float
    state_scale: FloatArray
    history: MultiplierHistory | None = None
    sigma_slope: float = 0.0
    steps: int = 0
    lingering: bool = False
    stiff: bool = False
    stiff_steps: int = 0
    other_steps: int = 0
    needed_steps: int = 0
    saved_steps: float = 0.0
    laws: FloatArray | None = None
    linearisation: Linearisation | None = None

    def set_first_stage(
        self, rate: FloatArray, multiplier: FloatArray, history: MultiplierHistory
    ) -> None:
        """Replace the first stage of a step next to a singular configuration, where the direct
        solve is inaccurate, by ``rate`` (n,) and ``multiplier`` (nv,), with the ``history`` of
        known multipliers."""
        self.rate = rate
        if self.history is not None:
            self.history = history


@dataclass(slots=True)
class StepResult:
    """A proposed step from ``t`` to ``t + h``.

    Attributes
    ----------
    state
        State at the end, corrected.
    rates : (s + 1, n) or (s + 1 + e, n)
        Chart rates of the stages and of the end point, from which dense output is computed; also
        of the e extra stages of the tableau's extension, where a method evaluates them.
    end_rate : (n,)
        Tangent rate at the corrected end point.
    correction : (n,)
        What was subtracted from the uncorrected end point x^-.
    error_ratio
        Error estimate over tolerance; 0 for a scheme without an embedded pair.
    sigmas : (s + 1,)
        sigma at the start, the inner stages and the end.
    rank
        Smallest number of rows in use at any stage.
    state_scale : (n,)
        |x| of the error weights at the end.
    zone
        The zone, if any stage fell into it, else None.
    history
        The multiplier history that the zone predicts from, else None.
    multiplier : (m,) or None
        yhat at the end point; None if the end point lies in the zone.
    placement
        How the driver placed it around a singular configuration: ``""``, ``"a priori"``,
        ``"redone"``, or ``"critical"`` for the motion from node to node past a critical
        configuration (:mod:`srm_mbs.integration.critical_passages`).
    quiet
        Whether the whole step is so far from singular configurations that no check is needed.
    slope
        Of a quiet step: |d sigma / dt| (1/s), the largest over the step and to its middle stage.
    constraint_residual
        Largest closure error before a full correction, in row units, rows that are not in use
        included; 0 if the correction is partial.
    held
        Whether a stage lingered next to a singular configuration and was held on its branch.
    normals
        Normals of the closures at an end point next to a singular configuration, else None.
    away : (1, nv), (f + 1, nv) or None
        Direction or frame of the branch at an end point that its nodes solved.
    lost_branch
        Whether nodes of the branch were wanted and not found.
    stiff
        Whether the problem had been found to be stiff before the step.
    laws : (m,) or None
        The laws of forces at the end of a linearly implicit step.
    stiffness
        Estimate of h |lambda|, lambda the largest eigenvalue of the linearised equations; NaN if
        the step does not show it.
    cost
        Evaluations of a linearly implicit step and its linearisation, over those of its stages.
    """

    t: float
    h: float
    state: FloatArray
    rates: FloatArray
    end_rate: FloatArray
    correction: FloatArray
    error_ratio: float
    sigmas: FloatArray
    rank: int
    state_scale: FloatArray
    zone: Zone | None = None
    history: MultiplierHistory | None = None
    multiplier: FloatArray | None = None
    placement: str = ""
    quiet: bool = False
    slope: float = 0.0
    constraint_residual: float = 0.0
    held: bool = False
    normals: FloatArray | None = None
    away: FloatArray | None = None
    lost_branch: bool = False
    stiff: bool = False
    laws: FloatArray | None = None
    stiffness: float = np.nan
    cost: float = 1.0


class Method(Protocol):
    """One-step method on a :class:`~srm_mbs.dynamics.system.System`.

    A method may also have ``run_messages(steps, norm)``: sentences for the message of a run about
    the limits of the method that its accepted steps met
    (:func:`method_messages`).
    """

    @property
    def scheme(self) -> ButcherTableau:
        """The Runge-Kutta data."""

    def start(
        self, system: System, t: float, state: FloatArray, norm: ErrorNorm
    ) -> IntegratorState:
        """Evaluate the first stage."""

    def step(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: IntegratorState,
        norm: ErrorNorm,
    ) -> StepResult:
        """Propose a step; changes nothing but the system's workspace.

        Raises
        ------
        EvaluationError
            If a stage cannot be evaluated.
        """

    def accept(self, memory: IntegratorState, result: StepResult) -> None:
        """Move ``memory`` to the end of an accepted step."""

    def resume(
        self, system: System, t: float, state: FloatArray, memory: IntegratorState, norm: ErrorNorm
    ) -> IntegratorState:
        """``memory`` after a breakpoint at ``t``, where forces may have jumped: nothing that
        depends on the forces before it is kept.

        Raises
        ------
        EvaluationError
            If the first stage cannot be evaluated.
        """


class DelegatingMethod(ABC):
    """A method whose steps are those of another one, its ``stepper``."""

    tableau: str | ButcherTableau

    @cached_property
    def scheme(self) -> ButcherTableau:
        """The Runge-Kutta data."""
        return get_tableau(self.tableau)

    @property
    @abstractmethod
    def stepper(self) -> Method:
        """The method that makes the steps."""

    def start(
        self, system: System, t: float, state: FloatArray, norm: ErrorNorm
    ) -> IntegratorState:
        """Evaluate the first stage; see :class:`Method`."""
        return self.stepper.start(system, t, state, norm)

    def step(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: IntegratorState,
        norm: ErrorNorm,
    ) -> StepResult:
        """Propose a step; see :class:`Method`."""
        return self.stepper.step(system, t, h, state, memory, norm)

    def accept(self, memory: IntegratorState, result: StepResult) -> None:
        """Move ``memory`` to the end of an accepted step."""
        self.stepper.accept(memory, result)

    def resume(
        self, system: System, t: float, state: FloatArray, memory: IntegratorState, norm: ErrorNorm
    ) -> IntegratorState:
        """``memory`` after a breakpoint at ``t``; see :class:`Method`."""
        return self.stepper.resume(system, t, state, memory, norm)

    def run_messages(self, steps: Sequence[StepResult], norm: ErrorNorm) -> str:
        """Sentences about limits that the accepted ``steps`` of a run met; see :class:`Method`."""
        return method_messages(self.stepper, steps, norm)


def method_messages(method: Method, steps: Sequence[StepResult], norm: ErrorNorm) -> str:
    """Sentences of ``method`` about its limits that the accepted ``steps`` of a run met."""
    own = getattr(method, "run_messages", None)
    return "" if own is None else str(own(steps, norm))
