"""Load-time analysis of the closures: row scales, structural rank, redundant rows.

A walk on the closure manifold (docs/notation.md, "The walk") visits
closed configurations from several restarts, because the start may itself be singular, and open
random configurations alone give the wrong rank for over-constrained loops.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import BoolArray, FloatArray
from srm_mbs.drives import in_order_of_rows
from srm_mbs.errors import EvaluationError
from srm_mbs.inertias import check_inertia
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.driven import DrivenKinematics
from srm_mbs.systems.loops import world_jacobian
from srm_mbs.systems.pivoting import RowAlgebra, row_algebra, trees
from srm_mbs.systems.projection import PIVOT_ZERO, cholesky, unwhiten, whiten
from srm_mbs.systems.units import Units, coordinate_units, row_units
from srm_mbs.workspaces import workspace

log = logging.getLogger(__name__)

OPEN_SAMPLES = 24
RESTARTS = 10
WALK_STEPS = 12
WALK_AMPLITUDE = 0.5
STRUCTURAL_PIVOT = 1e-6
"""A pivot (of scaled rows) above this counts as independent."""
ROUNDING_ROW = 1e-12
"""Rows of one kind whose rms stays below this part of their uncancelled terms are rounding."""
ZERO_ROW = 1e-9
"""A scaled row that stays below this in every closed sample is zero."""
NULL = 1e-7
"""Pivots (of scaled rows) below this leave their direction free on the walk."""
CLOSING_RANK = 1e-9
"""Pivots below this part of the largest do not close loops."""
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
        averaged over the rows of one kind in a closure.
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


class Walker:
    """Closes loops and walks on the closure manifold.

    Parameters
    ----------
    mechanism, units
        The mechanism, and the units in which it counts.

    Attributes
    ----------
    scale : (rows,)
        Scale by which rows are divided; ones until :meth:`set_scale`.
    """

    def __init__(self, mechanism: Mechanism, units: Units) -> None:
        self.model = mechanism.model
        self.data = workspace(self.model)
        self.units = units
        self.row_unit = row_units(mechanism, units)
        self._rows = DrivenKinematics(self.model, mechanism.loops, mechanism.drives)
        self.closed = len(self.row_unit)
        self.scale = np.ones(len(self._rows.g))
        pattern = self._rows.pattern()
        self._all = row_algebra(pattern, self.model)
        driven = self.closed < len(self.scale)
        self._loops = row_algebra(pattern[: self.closed], self.model) if driven else self._all
        self._plain = row_algebra(pattern[: self.closed])
        self._trees = trees(self.model)
        self._factorised: FloatArray | None = None

    def _evaluate(self, q: FloatArray) -> None:
        """g and G of all rows, and M in ``data``, at q."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        self._rows.update(self.data, q, with_bias=False)
        self._factorised = None

    def factorised(self, q: FloatArray) -> tuple[RowAlgebra, RowAlgebra]:
        """The algebra of all scaled rows, and that of the loops', in the mass metric at q."""
        if self._factorised is not q:
            self._evaluate(q)
            G = self._rows.G / self.scale[:, None]
            self._all.factor(self.data.M, G, NULL)
            if self._loops is not self._all:
                self._loops.factor(self.data.M, G[: self.closed], NULL)
            self._factorised = q
        return self._all, self._loops

    def close(self, q: FloatArray, iterations: int = 30) -> tuple[FloatArray, float]:
        """Newton's iteration onto the closure manifold by shortest steps in units; q and the
        largest error left, in row units."""
        if not self.closed:
            return q, 0.0
        unit, own = self.units.coordinate, slice(self.closed)
        for iteration in range(iterations + 1):
            self._evaluate(q)
            g = self._rows.g[own] / self.row_unit
            error = float(np.abs(g).max())
            if error < 1e-14 or iteration == iterations:
                break
            by_unit = self._rows.G[own] / self.row_unit[:, None] * unit
            try:
                longest = np.sqrt((by_unit * by_unit).sum(axis=1).max())
                self._plain.factor(None, by_unit, CLOSING_RANK * longest)
            except EvaluationError:
                break
            q = pin.integrate(self.model, q, -self._plain.solve(g) * unit)
        return q, error

    def set_scale(self, mechanism: Mechanism, rng: np.random.Generator) -> None:
        """Row scales from open random configurations, isotropic per closure and kind of row."""
        squares = np.zeros_like(self.scale)
        uncancelled = np.zeros(2)
        for _ in range(OPEN_SAMPLES):
            spread = rng.uniform(-np.pi, np.pi, self.model.nv) * self.units.coordinate
            rows, _ = self.factorised(pin.integrate(self.model, mechanism.q0, spread))
            squares += rows.row_squares
            # What rows would measure if nothing in them cancelled: their rounding is eps of it.
            J = world_jacobian(self.data)
            turn = np.linalg.norm(J[3:], axis=0)
            shift = np.linalg.norm(J[:3], axis=0) + self.units.length * turn
            for tree in self._trees:
                U = cholesky(self.data.M[tree, tree])
                mobility = (whiten(U, np.eye(len(U))) ** 2).sum(axis=0)
                uncancelled += [mobility @ each[tree] ** 2 for each in (shift, turn)]
        squares /= OPEN_SAMPLES
        uncancelled /= OPEN_SAMPLES
        at = 0
        for loop in mechanism.loops:
            lengths, turns, joints = loop.rows.blocks
            own = squares[at : at + loop.rows.count]
            scale = self.scale[at : at + loop.rows.count]
            for block, whole in zip((lengths, turns), uncancelled):
                mean = own[block].mean() if block.stop > block.start else 0.0
                if mean <= ROUNDING_ROW**2 * whole:
                    mean = whole  # always satisfied: keep rounding from being scaled up to a row
                scale[block] = np.sqrt(mean) if mean > 0.0 else 1.0
            scale[joints] = np.sqrt(own[joints])  # constant entries: nothing cancels
            at += loop.rows.count
        driven = squares[at:]
        self.scale[at:] = np.sqrt(np.where(driven > 0.0, driven, 1.0))

    def _isotropic(self, white: FloatArray) -> FloatArray:
        """L^-T white (nv,), where M was evaluated last: no direction preferred in its metric."""
        out = np.empty_like(white)
        for tree in self._trees:
            out[tree] = unwhiten(cholesky(self.data.M[tree, tree]), white[tree])
        return out

    def step(self, q: FloatArray, direction: FloatArray, reach: float) -> FloatArray | None:
        """A closed configuration about ``reach`` units from q along ``direction``; None if none."""
        size = np.abs(direction / self.units.coordinate).max()
        if not size > 0.0:
            return None
        move = direction * (reach / size)
        for _ in range(8):
            closed, error = self.close(pin.integrate(self.model, q, move))
            if error < 1e-11:
                return closed
            move = 0.5 * move
        return None

    def walk(
        self,
        start: FloatArray,
        rng: np.random.Generator,
        restarts: int,
        steps: int,
        first: FloatArray | None = None,
    ) -> Iterator[FloatArray]:
        """Closed configurations of ``restarts`` random walks of ``steps`` steps from ``start``.

        The first steps of two of them go along the velocity ``first`` (nv,) and against it, unless
        it is zero.
        """
        along = [] if first is None or not np.abs(first).max() > 0.0 else [first, -first]
        for restart in range(restarts):
            q = start
            for k in range(steps):
                # Drives take no part: they lead along the closed configurations, wherever that is.
                _, rows = self.factorised(q)
                if rows.rank == self.model.nv:
                    break
                direction = rows.tangential(self._isotropic(rng.standard_normal(self.model.nv)))
                if k == 0 and restart < len(along):
                    direction = along[restart]
                closed = self.step(q, direction, WALK_AMPLITUDE * rng.uniform(0.2, 1.0))
                if closed is not None:
                    q = closed
                    yield q


def _closed_samples(
    mechanism: Mechanism, walker: Walker, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pivots (n, k) of all rows, those (n, l) of the loops alone, and largest row norms (m,) over
    closed configurations."""
    rows, closed_rows = len(walker.scale), walker.closed
    pivots: list[FloatArray] = []
    of_loops: list[FloatArray] = []
    largest = np.zeros(rows)

    def record(q: FloatArray) -> None:
        every, loops = walker.factorised(q)
        np.maximum(largest, np.sqrt(every.row_squares), out=largest)
        pivots.append(every.pivots)
        if closed_rows < rows:
            of_loops.append(loops.pivots)

    start, error = walker.close(mechanism.q0, iterations=100)
    if error < 1e-11:
        record(start)
    else:
        start = np.array(mechanism.q0)
    for q in walker.walk(start, rng, RESTARTS, WALK_STEPS, mechanism.v0):
        record(q)
    if closed_rows == rows:
        of_loops = pivots

    def stacked(found: list[FloatArray], count: int) -> FloatArray:
        return np.array(found) if found else np.zeros((0, min(count, mechanism.model.nv)))

    return stacked(pivots, rows), stacked(of_loops, closed_rows), largest


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
    pivots, of_loops, largest = _closed_samples(mechanism, walker, rng)
    notes: list[str] = []
    if not len(pivots):
        notes.append(
            "no closed configuration was found: the loops do not close near the initial guess"
        )
        kept = np.ones(len(names), dtype=bool)
        rank = min(len(names), mechanism.model.nv)
        closed = min(walker.closed, mechanism.model.nv)
        return Structure(names, walker.scale, kept, rank, closed, 1.0, units, 0, tuple(notes))
    kept = largest > ZERO_ROW
    kept[walker.closed :] = True
    loop_rank = int((of_loops > STRUCTURAL_PIVOT).sum(axis=1).max())
    ranks = (pivots > STRUCTURAL_PIVOT).sum(axis=1)
    rank = int(ranks.max())
    sigma_ref = float(np.median(pivots[ranks == rank, rank - 1])) if rank else 1.0
    if rank < loop_rank + len(mechanism.drives):
        driven = ", ".join(repr(drive.name) for drive in mechanism.drives)
        notes.append(
            f"the drives ({driven}) prescribe motions that follow from the closures or from each "
            "other: they must agree, and their forces are those of least norm"
        )
    if 0 < rank < pivots.shape[1]:
        weakest = float(pivots[ranks == rank, rank - 1].min())
        redundant = max(float(pivots[:, rank:].max()), PIVOT_ZERO)
        if weakest < RANK_GAP * redundant:
            notes.append(
                f"the rank {rank} of the closures is uncertain: smallest independent pivot "
                f"{weakest:.1e}, largest redundant pivot {redundant:.1e}"
            )
            log.warning("%s: %s", mechanism.name, notes[-1])
    return Structure(
        names, walker.scale, kept, rank, loop_rank, sigma_ref, units, len(pivots), tuple(notes)
    )
