"""Conserved quantities of a run: drift of the closures, residual of the energy balance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.analysis.accuracy.samples import Samples
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import constraint_angles
from srm_mbs.errors import EvaluationError, InputError
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


@per_model
def _rows_by_unit(mechanism: Mechanism) -> list[tuple[str, BoolArray | slice, float]]:
    """Unit, rows and scale of the closure rows and drives of each unit."""
    angles = constraint_angles(mechanism)
    units = ("m", ~angles, mechanism.structure.units.length), ("rad", angles, 1.0)
    return [
        (unit, slice(None) if own.all() else own, scale) for unit, own, scale in units if own.any()
    ]


def _largest_norm(errors: FloatArray) -> float:
    """Of the rows of ``errors`` (n, k)."""
    return math.sqrt(np.maximum.reduce(np.add.reduce(errors * errors, axis=1)))


def drift_of(samples: Sequence[Samples]) -> tuple[Drift, ...]:
    """The drift of a run, for each unit of its closure rows and drives; empty for an open chain.

    Parameters
    ----------
    samples
        Of each of its segments.
    """
    found: dict[str, list[list[float]]] = {}
    for part in samples:
        run, nq = part.run, part.run.mechanism.model.nq
        if not run.mechanism.constrained:
            continue
        ends = [errors[: len(part.ends)] for errors in run.invariants[:2]]
        q, v = part.even_states[:, :nq], part.even_states[:, nq:]
        between = run.observables.closure_errors(part.even, q, v)
        for unit, own, scale in _rows_by_unit(run.mechanism):
            largest = [_largest_norm(errors[:, own]) for errors in ends]
            more = [_largest_norm(errors[:, own]) for errors in between]
            found.setdefault(unit, []).append([*largest, *np.maximum(largest, more), scale])
    worst = {unit: np.max(parts, axis=0).tolist() for unit, parts in found.items()}
    return tuple(
        Drift(unit, *(*largest, largest[0] / scale)) for unit, (*largest, scale) in worst.items()
    )


def energy_error(solution: SimulationResult) -> EnergyError | str:
    """Residual of the energy balance, or the reason why it cannot be computed.

    Parameters
    ----------
    solution
        The run at the ends of its steps (:func:`~srm_mbs.analysis.accuracy.samples.at_ends`).
    """
    try:
        balance = solution.energy_balance
    except (InputError, EvaluationError) as error:
        return str(error)
    return EnergyError(
        balance.largest_residual,
        balance.scale,
        balance.relative,
        tuple(balance.works),
        balance.rounding,
    )
