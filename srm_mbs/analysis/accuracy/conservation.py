"""Conserved quantities of a run: drift of the closures, residual of the energy balance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srm_mbs.analysis.accuracy.error_estimate import even_times
from srm_mbs.dynamics.scaling import constraint_angles
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.simulation.result import SimulationResult


@dataclass(frozen=True)
class Drift:
    """The largest closure errors in one unit.

    Attributes
    ----------
    unit
        ``m`` or ``rad``.
    position, rate
        Norms over all rows of g, in ``unit``, and of G v, in ``unit``/s, at the ends of steps.
    between_position, between_rate
        The same, also with the dense output at evenly spaced times between them.
    relative
        ``position`` over the scene diagonal, or 1 rad.
    """

    unit: str
    position: float
    rate: float
    between_position: float
    between_rate: float
    relative: float


@dataclass(frozen=True)
class EnergyError:
    """Residual of the energy balance of a run, at the ends of its steps.

    Attributes
    ----------
    residual
        The largest |energy gained - work of all forces|, J.
    scale
        The energy that took part, J (:attr:`srm_mbs.EnergyBalance.scale`).
    relative
        ``residual`` over ``scale``; 0 if nothing moved by more than rounding.
    works
        Names of the forces that did work.
    rounding
        Bound of the residual that rounding causes, J (:attr:`srm_mbs.EnergyBalance.rounding`).
    """

    residual: float
    scale: float
    relative: float
    works: tuple[str, ...]
    rounding: float


def drift_of(solution: SimulationResult) -> tuple[Drift, ...]:
    """The drift of a run, for each unit of its closure rows and drives; empty for an open chain."""
    found: dict[str, list[list[float]]] = {}
    for part in solution.segments:
        mechanism = part.mechanism
        if not mechanism.constrained:
            continue
        ends = part.steps.times
        if part.steps.stop is not None:  # an event within the last step
            ends = ends[:-1]
        count = len(ends)
        t, nq = np.concatenate((ends, even_times(part))), mechanism.model.nq
        states = part.states(t)
        errors = part.observables.closure_errors(t, states[:, :nq], states[:, nq:])
        squares = [e * e for e in errors]
        angles = constraint_angles(mechanism)
        length = mechanism.structure.units.length
        for unit, own, scale in (("m", ~angles, length), ("rad", angles, 1.0)):
            if own.any():
                sums = [square @ own for square in squares]
                largest = [float(np.sqrt(each[:count].max())) for each in sums]
                between = [float(np.sqrt(each.max())) for each in sums]
                found.setdefault(unit, []).append([*largest, *between, scale])
    worst = {unit: np.max(parts, axis=0).tolist() for unit, parts in found.items()}
    return tuple(
        Drift(unit, *(*largest, largest[0] / scale)) for unit, (*largest, scale) in worst.items()
    )


def energy_error(solution: SimulationResult) -> EnergyError | str:
    """Residual of the energy balance, or the reason why it cannot be computed."""
    if solution.t_eval is not None:  # few times, or none, do not represent the run
        ends = [[*part.steps.times[:-1], part.steps.end] for part in solution.segments]
        solution = solution.at(np.unique(np.concatenate(ends)))
    try:
        balance = solution.energy_balance
    except (InputError, EvaluationError) as error:
        return str(error)
    residual = float(np.abs(balance.residual).max(initial=0.0))
    return EnergyError(
        residual, balance.scale, balance.relative, tuple(balance.works), balance.rounding
    )
