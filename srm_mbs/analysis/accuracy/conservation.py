"""What a run should keep, and how well it does: closed loops, and the balance of energy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.analysis.accuracy.error_estimate import sample_times
from srm_mbs.dynamics.constraints.rheonomic import constraint_errors
from srm_mbs.dynamics.scaling import constraint_angles
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.simulation.result import SimulationResult


@dataclass(frozen=True)
class Drift:
    """The largest closure errors of one unit.

    Attributes
    ----------
    unit
        ``m`` or ``rad``.
    position, rate
        At the ends of steps: of the rows g in ``unit``, of G v in ``unit``/s; norms of all rows.
    between_position, between_rate
        The same on the dense output, at evenly spaced times between them as well.
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
    """How well the energy balance of a run closes, at the ends of its steps.

    Attributes
    ----------
    residual
        The largest of energy gained less all works, J.
    scale
        The energy that took part, J (:attr:`srm_mbs.EnergyBalance.scale`).
    relative
        One over the other; 0 where nothing moved but for rounding.
    works
        Names of what did work.
    rounding
        Residual that rounding alone may leave, J (:attr:`srm_mbs.EnergyBalance.rounding`).
    """

    residual: float
    scale: float
    relative: float
    works: tuple[str, ...]
    rounding: float


def drift_of(solution: SimulationResult) -> tuple[Drift, ...]:
    """The drift of a run, for each unit of its closure rows and drives; empty for an open chain."""
    found: dict[str, tuple[FloatArray, FloatArray, float]] = {}
    for part in solution.segments:
        mechanism = part.mechanism
        if not mechanism.constrained:
            continue
        ends = part.steps.times
        if part.steps.stop is not None:  # an event in the middle of the last step
            ends = ends[:-1]
        angles = constraint_angles(mechanism)
        for unit, own in (("m", ~angles), ("rad", angles)):
            if not own.any():
                continue
            scale = mechanism.structure.units.length if unit == "m" else 1.0
            largest = []
            for times in (ends, sample_times(part)):
                run = part.at(times)
                errors = constraint_errors(mechanism, run.t, run.q, run.v)
                largest.append([np.linalg.norm(e[:, own], axis=1).max() for e in errors])
            at_ends, between = np.array(largest)
            if unit in found:
                at_ends = np.maximum(at_ends, found[unit][0])
                between = np.maximum(between, found[unit][1])
                scale = max(scale, found[unit][2])
            found[unit] = at_ends, between, scale
    return tuple(
        Drift(
            unit,
            float(at_ends[0]),
            float(at_ends[1]),
            float(between[0]),
            float(between[1]),
            float(at_ends[0]) / scale,
        )
        for unit, (at_ends, between, scale) in found.items()
    )


def energy_error(solution: SimulationResult) -> EnergyError | str:
    """How well the energy balance closes; why it cannot be computed, if so."""
    if solution.t_eval is not None:  # few times, or none, would tell little of the run
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
