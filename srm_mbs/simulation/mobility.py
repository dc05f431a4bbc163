"""Degrees of freedom along a run: what the closures leave, and where that changes.

The momentary degrees of freedom are nv minus the rank of G.  They exceed the structural number only
on singular configurations, which a run passes between two output times: those come from
``solution.crossings`` and ``solution.bifurcations``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.local_coordinates import tangent_basis
from srm_mbs.dynamics.singularities.local_analysis import SINGULAR
from srm_mbs.errors import InputError
from srm_mbs.model.coordinates import coordinate_names
from srm_mbs.model.lazy import cached_property
from srm_mbs.simulation.result import SimulationResult, check_run
from srm_mbs.simulation.segmented_result import SegmentedResult

NUMBERS_AT_ONCE = 2**22
"""Numbers of singular vectors that are held at once."""


@dataclass(frozen=True)
class MobilityChange:
    """Where a run met a singular configuration.

    Attributes
    ----------
    time
        When it was closest to it (s).
    degrees_of_freedom
        Momentary degrees of freedom on it.
    loops
        The loops whose rows lose rank there.
    """

    time: float
    degrees_of_freedom: int
    loops: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class MobilityMap:
    """Degrees of freedom along a run.

    Attributes
    ----------
    t : (n,) s
        The times of the solution.
    degrees_of_freedom : (n,) int
        nv minus the rank of the closures, momentarily.
    rank : (n,) int
        Rank of the closures.
    singular_values : (n, k)
        Singular values of G in units, rows over their usual size, falling.
    distance : (n,)
        The last of them that the structural rank counts: 0 on a singular configuration; inf
        without closures.
    participation : (n, nv)
        How much each coordinate takes part in what the closures leave free: 1 freely, 0 not at all.
    coordinates : nv names
        Of the coordinates.
    """

    t: FloatArray
    degrees_of_freedom: NDArray[np.int_]
    rank: NDArray[np.int_]
    singular_values: FloatArray
    distance: FloatArray
    participation: FloatArray
    coordinates: tuple[str, ...]
    _solution: SimulationResult = field(repr=False)

    def __repr__(self) -> str:
        freedom = ", ".join(str(count) for count in np.unique(self.degrees_of_freedom))
        return f"MobilityMap({len(self.t)} times, degrees of freedom {freedom})"

    @cached_property
    def changes(self) -> tuple[MobilityChange, ...]:
        """Singular configurations that the run met, in order of time."""
        solution = self._solution
        mechanism = solution.mechanism
        structural = mechanism.structure.loop_rank
        if not structural:
            return ()
        met = [(c.time, c.configuration, c.loops) for c in solution.crossings]
        met += [(b.start, b.configuration, b.loops) for b in solution.bifurcations]
        geometry = ClosureGeometry(mechanism, mechanism.q0)
        everything = np.arange(mechanism.model.nv)
        changes = []
        for time, q, loops in sorted(met, key=lambda entry: entry[0]):
            if q is None:
                continue
            freedom = tangent_basis(geometry, q, everything)[0].shape[1]
            # Where only the drives lose rank, what the closures leave free is the same.
            if freedom > mechanism.model.nv - structural:
                changes.append(MobilityChange(time, freedom, loops))
        return tuple(changes)


def mobility_map(solution: SimulationResult) -> MobilityMap:
    """Degrees of freedom, rank and what can move at the times of ``solution``; see
    :meth:`srm_mbs.simulation.result.SimulationResult.at` for other times.

    Raises
    ------
    InputError
        For a run of several segments, which may have different mechanisms.
    """
    check_run(solution)
    if isinstance(solution, SegmentedResult):
        raise InputError(
            "a run with event actions has no single map: its mechanism may change",
            element="solution",
            remedy="Give one of solution.segments",
        )
    mechanism = solution.mechanism
    model = mechanism.model
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    structural = mechanism.structure.loop_rank
    shape = len(geometry.row_unit), model.nv
    count = len(solution.t)
    table = np.empty((count, min(shape)))
    rank = np.empty(count, dtype=int)
    parts = np.empty((count, model.nv))
    at_once = max(1, NUMBERS_AT_ONCE // max(1, sum(shape) ** 2))
    for first in range(0, count, at_once):
        own = slice(first, first + at_once)
        jacobians = solution.observables.jacobians(solution.t[own], solution.q[own])
        G = geometry.normalised_rows(jacobians[:, : shape[0], : shape[1]])  # without drives
        _, table[own], right = np.linalg.svd(G)
        rank[own] = (table[own] > SINGULAR).sum(axis=1)
        free = np.arange(model.nv) >= rank[own, None]
        parts[own] = np.sqrt(((right * free[:, :, None]) ** 2).sum(axis=1))
    return MobilityMap(
        solution.t,
        model.nv - rank,
        rank,
        table,
        table[:, structural - 1] if structural else np.full(count, np.inf),
        parts,
        coordinate_names(mechanism),
        solution,
    )
