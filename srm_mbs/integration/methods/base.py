"""The contract of a method: make one step, say how good it is.

A method is a tableau plus where its multiplier comes from.  It proposes a state; whether the
step stands is for step-size control to judge, and only :meth:`Method.accept` moves the memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System, Zone
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory

NEGLIGIBLE = 1e-3
"""Fraction of the tolerance that is not worth an evaluation."""


@dataclass(frozen=True)
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
    """

    atol: FloatArray
    rtol: float
    negligible: float = NEGLIGIBLE

    @property
    def one(self) -> FloatArray:
        """What the tolerances call "one" (n,), a unit for each component."""
        return self.atol / self.rtol

    def weights(self, state_scale: FloatArray) -> FloatArray:
        """atol + rtol |x| (n,)."""
        return self.atol + self.rtol * state_scale

    def __call__(self, error: FloatArray, weights: FloatArray) -> float:
        """The norm of ``error`` (n,) for ``weights`` (n,)."""
        scaled = error / weights
        return float(np.sqrt(scaled @ scaled / scaled.size))


@dataclass(frozen=True, eq=False)
class SweepNode:
    """Where one sweep stands at the end of a step.

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
    off
        How far it is off the closures, in units.
    given
        With own histories, y_0: the constant multiplier that the first sweep is given; None for 0.
    passing
        Whether the split form passes a singular configuration for the sweeps
        (:mod:`srm_mbs.integration.methods.iterated_sweeps`).
    """

    state: FloatArray
    multiplier: FloatArray
    rate: FloatArray | None
    eps: float
    history: MultiplierHistory | None
    off: float = 0.0
    given: FloatArray | None = None
    passing: bool = False


@dataclass
class IntegratorState:
    """What a method carries from one accepted step to the next.

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
    sweeps
        For methods with sweeps: where each one stands, the last one last.
    """

    rate: FloatArray
    sigma: float
    state_scale: FloatArray
    history: MultiplierHistory | None = None
    sigma_slope: float = 0.0
    steps: int = 0
    sweeps: tuple[SweepNode, ...] = ()

    def set_first_stage(
        self, rate: FloatArray, multiplier: FloatArray, history: MultiplierHistory
    ) -> None:
        """Replace the first stage of a step next to a singular configuration, where the direct
        solve is inaccurate, by ``rate`` (n,) and ``multiplier`` (nv,), with the ``history`` of
        known multipliers."""
        self.rate = rate
        if self.history is not None:
            self.history = history
        self.sweeps = tuple(
            replace(
                node,
                multiplier=multiplier if np.any(node.multiplier) else node.multiplier,
                history=None if node.history is None else history,
            )
            for node in self.sweeps
        )


@dataclass(slots=True)
class StepResult:
    """A proposed step from ``t`` to ``t + h``.

    Attributes
    ----------
    state
        State at the end, corrected.
    rates : (s + 1, n) or (s + 1 + e, n)
        Chart rates of the stages and of the end point; what the dense output is made of.  Methods
        with sweeps add those of the e extra stages of the tableau's extension.
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
    zone
        The zone, if any stage fell into it, else None.
    history
        The multiplier history behind that zone, else None.
    multiplier : (m,) or None
        yhat at the end point; None if the end point lies in the zone.
    state_scale : (n,)
        |x| of the error weights at the end.
    sweeps
        For methods with sweeps: where each one stands at the end.
    drift_ratio
        For methods with sweeps and an embedded pair: constraint error that the last sweep has left
        at the end, over tolerance; else 0.
    off
        For methods with sweeps: how far any of them is off the closures at the end, in units.
    restarted
        Whether sweeps with own histories started from the accepted state in this step.
    passing
        For methods with sweeps: whether the split form made this step for them.
    placement
        How the driver placed it around a singular configuration: ``""``, ``"a priori"`` or
        ``"redone"``.
    quiet
        Whether the whole step is so far from singular configurations that nothing needs a look.
    slope
        Of a quiet step: |d sigma / dt| (1/s), the largest over the step and to its middle stage.
    constraint_residual
        Largest closure error before a full correction, in row units, rows that are not in use
        included; 0 if the correction is partial.
    held
        Whether a stage lingered next to a singular configuration and was held on its branch.
    normals
        Normals of the closures at an end point next to a singular configuration, else None.
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
    zone: Zone | None
    history: MultiplierHistory | None
    multiplier: FloatArray | None
    state_scale: FloatArray
    sweeps: tuple[SweepNode, ...] = ()
    drift_ratio: float = 0.0
    off: float = 0.0
    restarted: bool = False
    passing: bool = False
    placement: str = ""
    quiet: bool = False
    slope: float = 0.0
    constraint_residual: float = 0.0
    held: bool = False
    normals: FloatArray | None = None


class Method(Protocol):
    """One-step method on a :class:`~srm_mbs.dynamics.system.System`."""

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
        """``memory`` behind a breakpoint at ``t``, where forces may have jumped: nothing that
        depends on those before it is kept.

        Raises
        ------
        EvaluationError
            If the first stage cannot be evaluated.
        """
