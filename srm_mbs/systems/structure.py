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
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.driven import DrivenKinematics
from srm_mbs.systems.loops import LoopKinematics, world_jacobian
from srm_mbs.systems.projection import PIVOT_ZERO, cholesky, pivoted_qr, unwhiten, whiten
from srm_mbs.systems.units import Units, coordinate_units, row_units

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
        self.data = self.model.createData()
        self.units = units
        self.rows = LoopKinematics(self.model, mechanism.loops)
        self.row_unit = row_units(mechanism, units)
        self._all = DrivenKinematics(self.model, mechanism.loops, mechanism.drives)
        self.closed = len(self.rows.g)
        self.scale = np.ones(len(self._all.g))

    def evaluate(self, q: FloatArray) -> None:
        """g and G of ``rows``, the loops', and M in ``data``, at q."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        self.rows.update(self.data, q, with_bias=False)

    def white(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """W = L^-1 G^T (nv, m) of all scaled rows, those of the loops first, and the Cholesky
        factor U (nv, nv), at q."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        self._all.update(self.data, q, with_bias=False)
        U = cholesky(self.data.M)
        return whiten(U, np.asfortranarray((self._all.G / self.scale[:, None]).T)), U

    def close(self, q: FloatArray, iterations: int = 30) -> tuple[FloatArray, float]:
        """Gauss-Newton onto the closure manifold; q and the largest error left, in row units."""
        if not self.closed:
            return q, 0.0
        unit = self.units.coordinate
        for _ in range(iterations):
            self.evaluate(q)
            g = self.rows.g / self.row_unit
            if np.abs(g).max() < 1e-14:
                break
            by_unit = self.rows.G / self.row_unit[:, None] * unit
            step = np.linalg.lstsq(by_unit, g, rcond=1e-9)[0] * unit
            if not np.isfinite(step).all():
                break
            q = pin.integrate(self.model, q, -step)
        self.evaluate(q)
        return q, float(np.abs(self.rows.g / self.row_unit).max())

    def set_scale(self, mechanism: Mechanism, rng: np.random.Generator) -> None:
        """Row scales from open random configurations, isotropic per closure and kind of row."""
        squares = np.zeros_like(self.scale)
        uncancelled = np.zeros(2)
        for _ in range(OPEN_SAMPLES):
            spread = rng.uniform(-np.pi, np.pi, self.model.nv) * self.units.coordinate
            W, U = self.white(pin.integrate(self.model, mechanism.q0, spread))
            squares += (W**2).sum(axis=0)
            # What rows would measure if nothing in them cancelled: their rounding is eps of it.
            J = world_jacobian(self.data)
            turn = np.linalg.norm(J[3:], axis=0)
            shift = np.linalg.norm(J[:3], axis=0) + self.units.length * turn
            uncancelled += [(whiten(U, np.diag(each)) ** 2).sum() for each in (shift, turn)]
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
                W, U = self.white(q)
                # Drives take no part: they lead along the closed configurations, wherever that is.
                left, singular, _ = np.linalg.svd(W[:, : self.closed], full_matrices=True)
                rank = int(np.sum(singular > 1e-7))
                null = left[:, rank:]
                if null.shape[1] == 0:
                    break
                # Projected, not combined from the columns of null: their choice is LAPACK's.
                direction = unwhiten(U, null @ (null.T @ rng.standard_normal(len(U))))
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
        W, _ = walker.white(q)
        np.maximum(largest, np.linalg.norm(W, axis=0), out=largest)
        pivots.append(pivoted_qr(W)[3])
        if closed_rows < rows:
            W = W[:, :closed_rows]
            of_loops.append(pivoted_qr(W)[3] if closed_rows else np.zeros(0))

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
    EvaluationError
        If the mass matrix is not positive definite.
    """
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
