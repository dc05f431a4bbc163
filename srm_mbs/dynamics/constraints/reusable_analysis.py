"""The load-time analysis of a mechanism, for variants of it.

Whether it is valid for a variant is checked by a short walk from its start.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import compress
from statistics import median

import numpy as np
import pinocchio as pin

from srm_mbs.dynamics.constraints.projection import PIVOT_ZERO
from srm_mbs.dynamics.constraints.rheonomic import DrivenKinematics, unscaled_rows
from srm_mbs.dynamics.constraints.structure import (
    CLOSED,
    CLOSING_STEPS,
    RANK_GAP,
    STRUCTURAL_PIVOT,
    ZERO_ROW,
    ManifoldSampler,
    RandomSteps,
    Structure,
    random_steps,
    row_names,
    rows_in_use,
    structure_of,
)
from srm_mbs.dynamics.scaling import anchor_points, coordinate_units
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.mechanism import MechanismData

CHECKED_STEPS = 6
"""Closed configurations, beside the start, in which an analysis of a variant is checked."""
KEPT_WALKS = 16
"""Walks that are kept, by the number of coordinates."""
SIMILAR = 4.0
"""Largest ratio of row norms, and of last pivots, of two mechanisms with one analysis."""


@dataclass(frozen=True, eq=False)
class ReusableAnalysis:
    """The analysis of a mechanism, with what a short walk from its start finds, for variants of it:
    mechanisms of the same topology with other numbers.

    Attributes
    ----------
    structure
        The analysis.
    lengths
        Largest norm of each row, over its scale, on the walk.
    last_pivot
        Median of the last structural pivot.
    rows, in_use
        The rows of the closures, unscaled, and those that are kept, scaled.
    loops, carriers
        The closures, and the :meth:`~srm_mbs.model.anchors.Anchor.carrier` of each anchor.
    """

    structure: Structure
    lengths: list[float]
    last_pivot: float
    rows: DrivenKinematics
    in_use: DrivenKinematics
    loops: tuple[LoopClosure, ...]
    carriers: tuple[tuple[pin.SE3 | None, ...], ...]

    @classmethod
    def of(cls, mechanism: MechanismData) -> ReusableAnalysis | None:
        """The analysis of ``mechanism``; None if its closures have no rank, or an uncertain one."""
        structure = structure_of(mechanism)
        walked = None if structure.notes else _walked(structure, mechanism)
        if walked is None:
            return None
        rows, in_use = unscaled_rows(mechanism), rows_in_use(mechanism)
        model, loops = mechanism.model, mechanism.loops
        carriers = tuple(tuple(end.carrier(model) for end in loop.anchors) for loop in loops)
        return cls(structure, *walked, rows, in_use, loops, carriers)

    def lend_rows(self, mechanism: MechanismData) -> None:
        """Give ``mechanism``, a variant whose tree has the same bodies, joints and frames, the
        unscaled rows with the places of its own closures, where these alone differ."""
        loops = mechanism.loops
        if mechanism.drives or len(loops) != len(self.loops):
            return  # points that drives move are anchors, too
        if any(loop.rows is not own.rows for loop, own in zip(loops, self.loops)):
            return
        origins = [
            first.origin_of(anchor, carrier)
            for loop, own, carriers in zip(loops, self.loops, self.carriers)
            for first, anchor, carrier in zip(own.anchors, loop.anchors, carriers)
        ]
        found = [origin for origin in origins if origin is not None]
        rows = self.rows.moved(loops, found) if len(found) == len(origins) else None
        if rows is not None:
            unscaled_rows.keep(mechanism, rows)
            anchor_points.keep(mechanism, rows.anchors())

    def lend_rows_in_use(self, mechanism: MechanismData) -> None:
        """The same with the rows in use, for a variant that has this analysis and the rows of
        :meth:`lend_rows`."""
        unscaled = unscaled_rows.kept(mechanism)
        if unscaled is not None and unscaled.idle is self.rows.idle:
            rows = self.in_use.moved(mechanism.loops, unscaled.origins)
            if rows is not None:
                rows_in_use.keep(mechanism, rows)

    def for_variant(self, mechanism: MechanismData) -> Structure | None:
        """The analysis in the units of ``mechanism``, a variant; None where it is not valid.

        It is valid if both have the same rows and, on the walk from the start of the variant, the
        ranks of all rows and of those of the loops are those of the analysis, the same rows are
        zero, and the norms of rows and the last pivot differ from those of the mechanism that was
        analysed by the factor ``SIMILAR`` at most.  An analysis of the variant itself would then
        differ in its scales alone, by about as much.

        Raises
        ------
        EvaluationError
            If the mass matrix is not positive definite where it is evaluated.
        """
        structure = self.structure
        rows = unscaled_rows.kept(mechanism)
        lent = rows is not None and rows.idle is self.rows.idle
        if not lent and structure.row_names != row_names(mechanism):
            return None
        walked = _walked(structure, mechanism)
        if walked is None:
            return None
        lengths, pivot = walked
        ratios = [lengths[row] / self.lengths[row] for row in structure.kept_rows]
        ratios.append(pivot / self.last_pivot)
        if not (min(ratios) > 1.0 / SIMILAR and max(ratios) < SIMILAR):
            return None
        return structure.at(mechanism)


@lru_cache(maxsize=KEPT_WALKS)
def _steps(nv: int) -> RandomSteps:
    """The steps of the walk, the same for all mechanisms of ``nv`` coordinates; read-only."""
    steps = random_steps(np.random.default_rng(0), CHECKED_STEPS, nv)
    for array in steps:
        array.setflags(write=False)
    return steps


def _walked(structure: Structure, mechanism: MechanismData) -> tuple[list[float], float] | None:
    """A walk of ``CHECKED_STEPS`` from the start of ``mechanism``, with the row scales of
    ``structure``: the largest norm of each row, and the median of the last structural pivot; None
    if it contradicts the ranks and zero rows of that, or finds nothing."""
    rank = structure.rank
    sampler = ManifoldSampler(mechanism, coordinate_units(mechanism, mechanism.q0, mechanism.v0))
    sampler.scale, sampler.eliminations = structure.row_scale, structure.eliminations
    start, error = sampler.close(mechanism.q0, CLOSING_STEPS)
    if not rank or not error < CLOSED:
        return None
    walk = [_steps(int(mechanism.model.nv))]
    samples = sampler.explore_along(start, walk, mechanism.v0, sample_start=True)
    sampler.end()
    # Lists, because there are few numbers: a reduction of NumPy takes as long as all this.
    pivots, largest = samples.pivots.tolist(), samples.largest.tolist()
    ranks = _ranks(pivots)
    if max(ranks) != rank or max(_ranks(samples.of_loops.tolist())) != structure.loop_rank:
        return None
    in_use = [row >= sampler.closed or size > ZERO_ROW for row, size in enumerate(largest)]
    if in_use != structure.kept.tolist() or not all(compress(largest, in_use)):
        return None
    last = [own[rank - 1] for own, found in zip(pivots, ranks) if found == rank]
    redundant = max((pivot for own in pivots for pivot in own[rank:]), default=0.0)
    if rank < len(pivots[0]) and min(last) < RANK_GAP * max(redundant, PIVOT_ZERO):
        return None
    return largest, median(last)


def _ranks(pivots: list[list[float]]) -> list[int]:
    """The number of independent rows in each of several configurations."""
    return [sum(pivot > STRUCTURAL_PIVOT for pivot in own) for own in pivots]
