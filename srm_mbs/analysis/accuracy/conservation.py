"""Conserved quantities of a run: drift of the closures, residual of the energy balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srm_mbs.analysis.accuracy.samples import at_ends
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.observables import Invariants
from srm_mbs.dynamics.scaling import constraint_angles
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.integration.run_samples import RunSamples
from srm_mbs.model.mechanism import per_model
from srm_mbs.simulation.result import SimulationResult


@dataclass(frozen=True)
class Drift:
    """The largest closure errors in one unit.

    Attributes
    ----------
    unit
        ``m`` or ``rad``.
    position, rate
        Norms over all rows of g, in ``unit``, and of G v, in ``unit``/s, at ends of steps.
    between_position, between_rate
        The same, also with the dense output at times between them.
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


@dataclass(frozen=True)
class _RowsByUnit:
    """The closure rows and drives of each unit that they have.

    Attributes
    ----------
    units
        Each unit, and the size of the mechanism in it.
    order, starts
        Indices of the rows, those of one unit after those of the other, and where these begin.
    """

    units: list[tuple[str, float]]
    order: list[int]
    starts: list[int]


@per_model
def _rows_by_unit(mechanism: Mechanism) -> _RowsByUnit:
    angles = constraint_angles(mechanism)
    own = {"m": np.flatnonzero(~angles).tolist(), "rad": np.flatnonzero(angles).tolist()}
    sizes = {"m": mechanism.structure.units.length, "rad": 1.0}
    units = [unit for unit in own if own[unit]]
    starts = [0, *(len(own[unit]) for unit in units)][: len(units)]
    return _RowsByUnit([(unit, sizes[unit]) for unit in units], own["m"] + own["rad"], starts)


def invariants_of(part: SimulationResult, samples: RunSamples) -> Invariants:
    """Closure errors, with a group of rows for each unit, and energies of a segment of a run."""
    rows = _rows_by_unit(part.mechanism)
    return part.observables.invariants(*samples, rows.order, rows.starts)


def drift_of(
    parts: Sequence[SimulationResult], invariants: Sequence[Invariants]
) -> tuple[Drift, ...]:
    """The drift of a run, for each unit of its closure rows and drives; empty for an open chain.

    Parameters
    ----------
    parts, invariants
        Its segments, and of each its :func:`invariants_of`.
    """
    found: dict[str, list[list[float]]] = {}
    for part, own in zip(parts, invariants):
        units = _rows_by_unit(part.mechanism).units
        whole = np.maximum(own.at_ends, own.within).tolist()
        for k, (unit, scale) in enumerate(units):
            largest = [each[i] for each in (own.at_ends, whole) for i in (k, k + len(units))]
            found.setdefault(unit, []).append([*largest, scale])
    worst = {unit: np.maximum.reduce(parts).tolist() for unit, parts in found.items()}
    return tuple(
        Drift(unit, *(*largest, largest[0] / scale)) for unit, (*largest, scale) in worst.items()
    )


def energy_error(
    solution: SimulationResult, samples: Sequence[RunSamples], invariants: Sequence[Invariants]
) -> EnergyError | str:
    """Residual of the energy balance, or the reason why it cannot be computed.

    Parameters
    ----------
    samples, invariants
        Of each segment of the run, and its :func:`invariants_of`.
    """
    try:
        if len(samples) > 1:
            balance = at_ends(solution).energy_balance
        else:
            ((times, _, ends, _),) = samples
            balance = solution.balance_at(times[ends], invariants[0].energies)
    except (InputError, EvaluationError) as error:
        return str(error)
    return EnergyError(
        balance.largest_residual,
        balance.scale,
        balance.relative,
        tuple(balance.works),
        balance.rounding,
    )
