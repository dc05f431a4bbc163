"""Load-time analysis of the closures: row scales, structural rank, redundant rows.

A walk on the closure manifold (docs/notation.md, "The walk") visits
closed configurations from several restarts, because the start may itself be singular, and open
random configurations alone give the wrong rank for over-constrained loops.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from srm_mbs.arrays import BoolArray, FloatArray, IndexArray
from srm_mbs.drives import in_order_of_rows
from srm_mbs.inertias import check_inertia
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.loops import Elimination
from srm_mbs.systems.projection import PIVOT_ZERO
from srm_mbs.systems.units import Units, coordinate_units
from srm_mbs.systems.walking import Walker

log = logging.getLogger(__name__)

RESTARTS = 10
WALK_STEPS = 12
STRUCTURAL_PIVOT = 1e-6
"""A pivot (of scaled rows) above this counts as independent."""
ZERO_ROW = 1e-9
"""A scaled row that stays below this in every closed sample is zero."""
BLUNT = 0.1
"""A last structural pivot whose usual size is below this is told apart from zero too late."""
BALANCING_SAMPLES = 12
"""Closed configurations in which rows are measured against each other."""
RANK_GAP = 1e3
"""Smallest ratio of the smallest structural to the largest redundant pivot without a warning."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Constant facts about the closures and drives of a mechanism.

    Attributes
    ----------
    row_names
        Names of all rows, ``loop.row``, then those of the drives.
    row_scale : (rows,)
        Every row is divided by its scale: the rms of ||L^-1 G^T row|| over open configurations,
        averaged over the rows of one kind in a closure; where that leaves the last pivot small
        everywhere, the row's usual distance from the span of the others.
    kept : (rows,) bool
        False for rows that are zero on every closed sample; the solve leaves them out.  Rows of
        drives are always kept.
    rank
        Structural rank: the largest number of pivots above 1e-6 over the closed samples.
    loop_rank
        The same of the loops alone.
    sigma_ref
        Median of the last structural pivot over the samples of that rank.
    units
        Units of the coordinates at q0.
    samples
        Number of closed configurations visited.
    notes
        Sentences for the user, such as a weak gap between structural and redundant pivots.
    eliminations
        Rows that are taken off others, in this order, where rows of closures between the same
        bodies are nearly parallel.
    """

    row_names: tuple[str, ...]
    row_scale: FloatArray
    kept: BoolArray
    rank: int
    loop_rank: int
    sigma_ref: float
    units: Units
    samples: int
    notes: tuple[str, ...]
    eliminations: tuple[Elimination, ...] = ()

    def at(self, mechanism: Mechanism) -> Structure:
        """The same facts with the units of ``mechanism``, which differs in its start only."""
        return replace(self, units=coordinate_units(mechanism, mechanism.q0, mechanism.v0))

    @property
    def redundant_rows(self) -> tuple[str, ...]:
        """Names of the rows that the solve leaves out."""
        return tuple(name for name, keep in zip(self.row_names, self.kept) if not keep)

    @property
    def pivoted_redundancy(self) -> int:
        """Number of further redundant rows, chosen by pivoting at every evaluation."""
        return int(np.sum(self.kept)) - self.rank


def _closed(mechanism: Mechanism, walker: Walker, rng: np.random.Generator) -> Iterator[FloatArray]:
    """The closed configurations that the analysis looks at."""
    start, error = walker.close(mechanism.q0, iterations=100)
    if error < 1e-11:
        yield start
    else:
        start = np.array(mechanism.q0)
    yield from walker.walk(start, rng, RESTARTS, WALK_STEPS, mechanism.v0)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Closed configurations and, there, the pivots (n, k) of all rows, those (n, l) of the loops
    alone, and the largest norms (rows,) of rows."""

    configurations: list[FloatArray]
    pivots: FloatArray
    of_loops: FloatArray
    largest: FloatArray

    def ranks(self) -> IndexArray:
        """The number (n,) of independent rows in each."""
        ranks: IndexArray = (self.pivots > STRUCTURAL_PIVOT).sum(axis=1)
        return ranks

    def last_pivots(self, rank: int) -> FloatArray:
        """The last structural pivot in the configurations of that rank."""
        last: FloatArray = self.pivots[self.ranks() == rank, rank - 1]
        return last


def _sampled(walker: Walker, configurations: Iterable[FloatArray]) -> _Samples:
    rows, closed_rows, nv = len(walker.scale), walker.closed, walker.model.nv
    visited: list[FloatArray] = []
    pivots: list[FloatArray] = []
    of_loops: list[FloatArray] = []
    largest = np.zeros(rows)
    for q in configurations:
        every, loops = walker.factorised(q)
        np.maximum(largest, np.sqrt(every.row_squares), out=largest)
        visited.append(q)
        pivots.append(every.pivots)
        of_loops.append(loops.pivots)

    def stacked(found: list[FloatArray], count: int) -> FloatArray:
        return np.array(found) if found else np.zeros((0, min(count, nv)))

    return _Samples(visited, stacked(pivots, rows), stacked(of_loops, closed_rows), largest)


def _balanced(walker: Walker, samples: _Samples, rank: int) -> _Samples:
    """``samples`` after :meth:`Walker.separate` and :meth:`Walker.balance`; as they are, with
    their scale, if that does not raise the last pivot or makes more rows independent."""
    regular = np.flatnonzero(samples.ranks() == rank)
    chosen = regular[:: -(-len(regular) // BALANCING_SAMPLES)]
    scale = walker.scale
    measured = [samples.configurations[i] for i in chosen]
    walker.separate(measured, samples.largest > ZERO_ROW)
    walker.balance(measured)
    again = _sampled(walker, samples.configurations)
    before = float(np.median(samples.last_pivots(rank)))
    if int(again.ranks().max()) == rank and np.median(again.last_pivots(rank)) > before:
        return again
    walker.scale, walker.eliminations = scale, ()
    return samples


def row_names(mechanism: Mechanism) -> tuple[str, ...]:
    """Names of all rows: ``loop.row``, then those of the drives."""
    names = [name for loop in mechanism.loops for name in loop.row_names]
    return (*names, *(drive.name for drive in in_order_of_rows(mechanism.drives)))


def analyse(mechanism: Mechanism) -> Structure:
    """Row scales, structural rank, reference pivot and zero rows of ``mechanism``.

    Deterministic: the walk uses a fixed seed.  Source: docs/notation.md, "The walk".

    Raises
    ------
    InputError
        If a joint moves no inertia.
    EvaluationError
        If the mass matrix is not positive definite where the walk evaluates it.
    """
    check_inertia(mechanism.model)
    units = coordinate_units(mechanism, mechanism.q0, mechanism.v0)
    names = row_names(mechanism)
    if not names:
        return Structure((), np.ones(0), np.ones(0, bool), 0, 0, 1.0, units, 0, ())
    rng = np.random.default_rng(0)
    walker = Walker(mechanism, units)
    walker.set_scale(mechanism, rng)
    samples = _sampled(walker, _closed(mechanism, walker, rng))
    notes: list[str] = []
    if not samples.configurations:
        notes.append(
            "no closed configuration was found: the loops do not close near the initial guess"
        )
        kept = np.ones(len(names), dtype=bool)
        rank = min(len(names), mechanism.model.nv)
        closed = min(walker.closed, mechanism.model.nv)
        return Structure(names, walker.scale, kept, rank, closed, 1.0, units, 0, tuple(notes))
    kept = samples.largest > ZERO_ROW
    kept[walker.closed :] = True
    loop_rank = int((samples.of_loops > STRUCTURAL_PIVOT).sum(axis=1).max())
    rank = int(samples.ranks().max())
    if rank and np.median(samples.last_pivots(rank)) < BLUNT:
        samples = _balanced(walker, samples, rank)
    sigma_ref = float(np.median(samples.last_pivots(rank))) if rank else 1.0
    if rank < loop_rank + len(mechanism.drives):
        driven = ", ".join(repr(drive.name) for drive in mechanism.drives)
        notes.append(
            f"the drives ({driven}) prescribe motions that follow from the closures or from each "
            "other: they must agree, and their forces are those of least norm"
        )
    if 0 < rank < samples.pivots.shape[1]:
        weakest = float(samples.last_pivots(rank).min())
        redundant = max(float(samples.pivots[:, rank:].max()), PIVOT_ZERO)
        if weakest < RANK_GAP * redundant:
            notes.append(
                f"the rank {rank} of the closures is uncertain: smallest independent pivot "
                f"{weakest:.1e}, largest redundant pivot {redundant:.1e}"
            )
            log.warning("%s: %s", mechanism.name, notes[-1])
    visited = len(samples.configurations)
    return Structure(
        names,
        walker.scale,
        kept,
        rank,
        loop_rank,
        sigma_ref,
        units,
        visited,
        tuple(notes),
        walker.eliminations,
    )
