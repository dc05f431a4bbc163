"""Load-time analysis of the closures: row scales, structural rank, redundant rows.

A random walk on the closure manifold, with several restarts, visits closed configurations: the
start may itself be singular, and open random configurations alone give the wrong rank for
over-constrained loops.

Source: docs/notation.md, "Load-time analysis" and "Manifold sampling".
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import take_idle, workspace
from srm_mbs._typing import BoolArray, FloatArray, IndexArray
from srm_mbs.dynamics.constraints.compiled_rows import CompiledSampler, Limits, compiled_rows
from srm_mbs.dynamics.constraints.newton import newton
from srm_mbs.dynamics.constraints.projection import (
    PIVOT_ZERO,
    cholesky,
    pivoted_qr,
    symmetric,
    unwhiten,
    whiten,
)
from srm_mbs.dynamics.constraints.rheonomic import DrivenKinematics, unscaled_rows
from srm_mbs.dynamics.constraints.row_algebra import (
    RowAlgebra,
    coordinate_parents,
    row_algebra,
    trees,
)
from srm_mbs.dynamics.constraints.rows import Elimination, world_jacobian
from srm_mbs.dynamics.scaling import Units, coordinate_units, row_units
from srm_mbs.errors import EvaluationError, get_logger
from srm_mbs.model.copies import copied
from srm_mbs.model.drives import in_order_of_rows
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_model, per_start, per_tree
from srm_mbs.model.validation import check_inertia

log = get_logger(__name__)

OPEN_SAMPLES = 24
"""Random open configurations from which rows are scaled."""
WALK_AMPLITUDE = 0.5
"""Largest step of the walk, in units."""
ROUNDING_ROW = 1e-12
"""Rows of one kind whose rms stays below this part of their uncancelled terms are rounding."""
NULL = 1e-7
"""Pivots (of scaled rows) below this leave their direction free on the walk."""
PARALLEL = 0.3
"""Part of a row that is left of it without its shares in others, below which it is nearly
parallel to them."""
DEPENDENT = 1e-6
"""The same, below which it follows from them."""
CLOSING_RANK = 1e-9
"""Pivots below this part of the largest do not close loops."""
CLOSURE_ROUNDING = 1e-14
"""Closure error, in row units, at which Newton's iteration ends."""
STUCK = 1e-9
"""Closure error, in row units, below which an iteration that gains nothing ends."""
CLOSED = 1e-11
"""Closure error, in row units, below which a configuration is closed."""
CLOSING_STEPS = 30
"""Steps of Newton's iteration onto the closures."""
HALVINGS = 8
"""Lengths of a step of a walk that are tried, each half of the one before."""
RESTARTS = 10
"""Number of walks from the start."""
WALK_STEPS = 12
"""Number of steps of a walk."""
STRUCTURAL_PIVOT = 1e-6
"""A pivot (of scaled rows) above this counts as independent."""
ZERO_ROW = 1e-9
"""A scaled row that stays below this in every closed sample is zero."""
SMALL_REFERENCE_PIVOT = 0.1
"""A last structural pivot with a median below this is close to zero everywhere: rows are
eliminated and scaled again."""
BALANCING_SAMPLES = 12
"""Closed configurations in which rows are measured against each other."""
RANK_GAP = 1e3
"""Smallest ratio of the smallest structural to the largest redundant pivot without a warning."""


class RandomSteps(NamedTuple):
    """Directions (n, nv) and lengths (n,), in units, of the steps of a walk."""

    directions: FloatArray
    reaches: FloatArray


def random_steps(rng: np.random.Generator, steps: int, nv: int) -> RandomSteps:
    """Steps of one walk of ``nv`` coordinates."""
    directions, reaches = np.empty((steps, nv)), np.empty(steps)
    for k in range(steps):
        rng.standard_normal(out=directions[k])
        reaches[k] = WALK_AMPLITUDE * rng.uniform(0.2, 1.0)
    return RandomSteps(directions, reaches)


@per_tree
def coordinate_tree(mechanism: MechanismData) -> tuple[list[int], list[slice]]:
    """The next coordinate to the root of each, and those of each tree that is rooted in the
    ground."""
    return coordinate_parents(mechanism.model), trees(mechanism.model)


class SamplerAlgebras(NamedTuple):
    """The algebra of all rows and of those of the loops in the mass metric, one and the same
    without drives, and of those of the loops in units."""

    all: RowAlgebra
    loops: RowAlgebra
    in_units: RowAlgebra


KEPT_ALGEBRAS = 4
"""Algebras of one pattern that wait for the sampler of the next variant, at most."""


@per_tree
def _idle_algebras(mechanism: MechanismData) -> dict[bytes, deque[SamplerAlgebras]]:
    """Algebras that no sampler uses, by the pattern of the rows."""
    return {}


class ManifoldSampler:
    """Closes loops and walks on the closure manifold.

    Parameters
    ----------
    mechanism, units
        The mechanism, and the units of its coordinates and rows.

    Attributes
    ----------
    scale : (rows,)
        Scale by which rows are divided; ones until :meth:`set_scale`.
    eliminations
        Rows that are subtracted from others; none until :meth:`separate`.
    """

    def __init__(self, mechanism: MechanismData, units: Units) -> None:
        self._mechanism = mechanism
        self.model = mechanism.model
        self.units = units
        self.row_unit = row_units(mechanism, units)
        rows = unscaled_rows(mechanism)
        self._rows = compiled_rows(mechanism)
        self.closed = len(self.row_unit)
        self.scale = np.ones(len(rows.g))
        self.eliminations: tuple[Elimination, ...] = ()
        pattern = self._pattern = rows.pattern()
        parents, self._trees = coordinate_tree(mechanism)
        self._idle = _idle_algebras(mechanism).setdefault(
            pattern.tobytes(), deque(maxlen=KEPT_ALGEBRAS)
        )
        algebras = take_idle(self._idle)
        if algebras is None:
            of_all = row_algebra(pattern, parents)
            own, driven = pattern[: self.closed], self.closed < len(self.scale)
            of_loops = row_algebra(own, parents) if driven else of_all
            algebras = SamplerAlgebras(of_all, of_loops, row_algebra(own))
        self._algebras = algebras
        self._all, self._loops, self._in_units = algebras
        self._factorised: FloatArray | None = None

    def end(self) -> None:
        """Leave the algebras to the sampler of another variant: this one has no further use."""
        self._idle.append(self._algebras)

    @cached_property
    def _to_units(self) -> FloatArray:
        """From G to rows over their unit, of coordinates over theirs."""
        return self.units.coordinate / self.row_unit[:, None]

    @cached_property
    def data(self) -> pin.Data:
        """Pinocchio's workspace, of the reference."""
        return workspace(self.model)

    def _scaled(self, q: FloatArray) -> FloatArray:
        """G (rows, nv) of the rows after the eliminations, over their scale; M at q in ``data``."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        _, G = self._rows.at(q)
        if self.eliminations:
            G = G.copy()
        for row, other, factor in self.eliminations:
            G[row] -= factor * G[other]
        return G / self.scale[:, None]

    def factorised(self, q: FloatArray) -> tuple[RowAlgebra, RowAlgebra]:
        """The algebra of all scaled rows, and that of the loops', in the mass metric at q."""
        if self._factorised is not q:
            G = self._scaled(q)
            self._all.factor(self.data.M, G, NULL)
            if self._loops is not self._all:
                self._loops.factor(self.data.M, G[: self.closed], NULL)
            self._factorised = q
        return self._all, self._loops

    def close(self, q: FloatArray, iterations: int) -> tuple[FloatArray, float]:
        """Newton's iteration onto the closure manifold by shortest steps in units; q and the
        largest error left, in row units."""
        if not self.closed:
            return q, 0.0
        found = self._rows.close(
            self._in_units, self.row_unit, self.units.coordinate, q, _limits(iterations)
        )
        if found is not None:
            return found
        against, own = -self.units.coordinate, slice(self.closed)

        def linearise(q: FloatArray) -> tuple[float, Callable[[], FloatArray | None]]:
            g, G = self._rows.at(q)
            g = g[own] / self.row_unit

            def step() -> FloatArray | None:
                by_unit = G[own] * self._to_units
                try:
                    longest = math.sqrt(np.einsum("ij,ij->i", by_unit, by_unit).max())
                    self._in_units.factor(None, by_unit, CLOSING_RANK * longest)
                except EvaluationError:
                    return None
                return pin.integrate(self.model, q, self._in_units.solve(g) * against)  # type: ignore[no-any-return]

            return float(np.abs(g).max()), step

        limits = _limits(iterations)
        return newton(
            q,
            linearise,
            limits.evaluations,
            tolerance=limits.tolerance,
            rounding=limits.rounding,
            monotone=False,
        )

    def _compiled(self) -> CompiledSampler | None:
        """Walks by the kernel, with the scale and the eliminations that there are now."""
        rows, others, shares = zip(*self.eliminations) if self.eliminations else ((), (), ())
        return self._rows.sampler(
            self._algebras,
            _limits(CLOSING_STEPS),
            scale=self.scale,
            row_unit=self.row_unit,
            unit=self.units.coordinate,
            length=self.units.length,
            trees=[tree.start for tree in self._trees] + [int(self.model.nv)],
            eliminated=list(rows),
            others=list(others),
            shares=np.array(shares, dtype=float),
            null_pivot=NULL,
            closed=CLOSED,
            halvings=HALVINGS,
        )

    def _open_norms(self, spreads: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sums over configurations that are ``spreads`` (n, nv) away from q0: squares (rows,) of
        the norms of rows and, if no terms in rows cancelled, of one along a direction and of one of
        an alignment (2,), of whose norms the rounding is eps times."""
        compiled = self._compiled()
        found = None if compiled is None else compiled.open_norms(self._mechanism.q0, spreads)
        if found is not None:
            return found
        squares, uncancelled = np.zeros_like(self.scale), np.zeros(2)
        for spread in spreads:
            rows, _ = self.factorised(pin.integrate(self.model, self._mechanism.q0, spread))
            squares += rows.row_squares
            J = world_jacobian(self.data)
            turn = np.linalg.norm(J[3:], axis=0)
            shift = np.linalg.norm(J[:3], axis=0) + self.units.length * turn
            for tree in self._trees:
                U = cholesky(self.data.M[tree, tree])
                mobility = (whiten(U, np.eye(len(U))) ** 2).sum(axis=0)
                uncancelled += [mobility @ each[tree] ** 2 for each in (shift, turn)]
        return squares, uncancelled

    def set_scale(self, rng: np.random.Generator) -> None:
        """Row scales from open random configurations, isotropic per closure and kind of row."""
        spreads = rng.uniform(-np.pi, np.pi, (OPEN_SAMPLES, self.model.nv)) * self.units.coordinate
        squares, uncancelled = self._open_norms(spreads)
        squares /= OPEN_SAMPLES
        uncancelled /= OPEN_SAMPLES
        at = 0
        for loop in self._mechanism.loops:
            lengths, turns, joints = loop.rows.blocks
            own = squares[at : at + loop.rows.count]
            scale = self.scale[at : at + loop.rows.count]
            for block, whole in zip((lengths, turns), uncancelled):
                mean = own[block].mean() if block.stop > block.start else 0.0
                if mean <= ROUNDING_ROW**2 * whole:
                    mean = whole  # always satisfied: keep rounding from being scaled up to a row
                scale[block] = np.sqrt(mean) if mean > 0.0 else 1.0
            scale[joints] = np.sqrt(own[joints])  # no kinematics in them: no rounding
            at += loop.rows.count
        driven = squares[at:]
        self.scale[at:] = np.sqrt(np.where(driven > 0.0, driven, 1.0))

    def distances(self, q: FloatArray) -> FloatArray:
        """How far each scaled row (rows,) in use at q is from the span of the others in use, in
        the mass metric; NaN for rows that are not in use.

        1/||E e_i|| for row i: E e_i is the smallest velocity that changes that row alone.
        """
        rows, _ = self.factorised(q)
        count = len(self.scale)
        X = np.array([rows.solve(row) for row in np.eye(count)])
        size = np.sqrt(np.maximum(((X @ symmetric(self.data.M)) * X).sum(axis=1), 0.0))
        # A row is no further from a span than it is long, unless it is not in use.
        used = size * np.sqrt(rows.row_squares) > 0.5
        return np.where(used, 1.0 / np.where(used, size, 1.0), np.nan)

    def separate(self, samples: Sequence[FloatArray], kept: BoolArray) -> None:
        """Find eliminations for rows that are nearly parallel to others between the same bodies.

        An example are two points next to each other that hold a hinge: the difference of their
        rows, which prevents a rotation, is small everywhere.  Without the elimination the last
        pivot is small everywhere, too, and shows a loss of rank only where it is smaller still.

        Parameters
        ----------
        samples
            Closed configurations.
        kept : (rows,) bool
            Rows that take part.
        """
        groups: dict[bytes, list[int]] = {}
        closures = [loop for loop in self._mechanism.loops for _ in loop.row_names]
        for row, loop in enumerate(closures):
            if kept[row] and not loop.rows.joint_rows:
                groups.setdefault(self._pattern[row].tobytes(), []).append(row)
        parts = []
        for q in samples:
            white = self._scaled(q).T
            for tree in self._trees:
                white[tree] = whiten(cholesky(self.data.M[tree, tree]), white[tree])
            parts.append(white)
        scales = self.scale.tolist()
        found: list[Elimination] = []
        for rows in groups.values():
            W = np.concatenate([white[:, rows] for white in parts])
            size = np.linalg.norm(W, axis=0)
            basis: list[int] = []
            for k in pivoted_qr(W)[1].tolist():
                shares = np.linalg.lstsq(W[:, basis], W[:, k], rcond=None)[0]
                left = W[:, k] - W[:, basis] @ shares
                length = np.linalg.norm(left)
                if not length > DEPENDENT * size[k]:
                    continue
                if length < PARALLEL * size[k]:
                    W[:, k] = left
                    row = rows[k]
                    found += [
                        Elimination(row, rows[j], share * scales[row] / scales[rows[j]])
                        for j, share in zip(basis, shares.tolist())
                    ]
                basis.append(k)
        self.eliminations = tuple(found)
        self._factorised = None

    def balance(self, samples: Sequence[FloatArray]) -> None:
        """Scale each row by its usual distance from the span of the others.

        Where the rows of one closure differ much in norm, as those that hold a slender body do,
        their common scale makes some of them small everywhere, and a pivot that vanishes is the
        last one only once it is smaller still.  A row over its own usual distance is about 1 unless
        it is close to dependent on the others.
        """
        scale = self.scale.copy()
        for i, distances in enumerate(np.array([self.distances(q) for q in samples]).T):
            known = distances[np.isfinite(distances)]
            if known.size:
                scale[i] *= np.median(known)
        self.scale = scale
        self._factorised = None

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
        for _ in range(HALVINGS):
            closed, error = self.close(pin.integrate(self.model, q, move), CLOSING_STEPS)
            if error < CLOSED:
                return closed
            move = 0.5 * move
        return None

    def samples(self, configurations: Iterable[FloatArray]) -> Samples:
        """Pivots and norms of the rows at closed configurations."""
        visited, pivots, of_loops = [], [], []
        largest = np.zeros(len(self.scale))
        for q in configurations:
            rows, loops = self.factorised(q)
            np.maximum(largest, np.sqrt(rows.row_squares), out=largest)
            visited.append(q)
            pivots.append(rows.pivots)
            of_loops.append(loops.pivots)
        return Samples(visited, np.array(pivots), np.array(of_loops), largest)

    def explore(
        self,
        start: FloatArray,
        rng: np.random.Generator,
        restarts: int,
        steps: int,
        first: FloatArray | None = None,
        *,
        sample_start: bool = False,
    ) -> Samples:
        """Samples on ``restarts`` random walks of ``steps`` steps from ``start``, which is closed
        if it is to be a sample, the first one.

        The first steps of two of them go along the velocity ``first`` (nv,) and against it, unless
        it is zero.
        """
        walks = (random_steps(rng, steps, int(self.model.nv)) for _ in range(restarts))
        return self.explore_along(start, walks, first, sample_start=sample_start)

    def explore_along(
        self,
        start: FloatArray,
        walks: Iterable[RandomSteps],
        first: FloatArray | None = None,
        *,
        sample_start: bool = False,
    ) -> Samples:
        """:meth:`explore` by walks that were drawn."""
        along = [] if first is None or not first.any() else [first, -first]
        compiled = self._compiled()
        parts = []
        for restart, steps in enumerate(walks):
            draws = (
                sample_start and restart == 0,
                *steps,
                along[restart] if restart < len(along) else None,
            )
            found = None if compiled is None else compiled.walk(start, *draws)
            part = self.samples(self._walk(start, *draws)) if found is None else Samples(*found)
            if len(part.configurations):
                parts.append(part)
        return Samples.joined(parts, len(self.scale))

    def walk(
        self, start: FloatArray, rng: np.random.Generator, restarts: int, steps: int
    ) -> Sequence[FloatArray]:
        """The closed configurations of :meth:`explore`."""
        return list(self.explore(start, rng, restarts, steps).configurations)

    def _walk(
        self,
        q: FloatArray,
        sample_start: bool,
        directions: FloatArray,
        reaches: FloatArray,
        first: FloatArray | None,
    ) -> Iterator[FloatArray]:
        """One walk of :meth:`explore`, as ``ScaledSampler::walk`` of the kernel has it.

        Drives may move: every closed configuration counts, driven there or not.
        """
        if sample_start:
            yield q
        for k, (direction, reach) in enumerate(zip(directions, reaches)):
            _, rows = self.factorised(q)
            if rows.rank == self.model.nv:
                return
            if k == 0 and first is not None:
                direction = first
            else:
                direction = rows.tangential(self._isotropic(direction))
            closed = self.step(q, direction, reach)
            if closed is not None:
                q = closed
                yield q


@dataclass(frozen=True, eq=False)
class Samples:
    """Closed configurations (n, nq) and, there, the pivots (n, k) of all rows, those (n, l) of the
    loops alone, and the largest norms (rows,) of rows."""

    configurations: Sequence[FloatArray] | FloatArray
    pivots: FloatArray
    of_loops: FloatArray
    largest: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Samples], rows: int) -> Samples:
        """All samples of ``parts``, of ``rows`` rows."""
        if not parts:
            nothing = np.zeros((0, 0))
            return cls([], nothing, nothing, np.zeros(rows))
        if len(parts) == 1:
            return parts[0]
        configurations = [q for part in parts for q in part.configurations]
        pivots = np.concatenate([part.pivots for part in parts])
        of_loops = np.concatenate([part.of_loops for part in parts])
        largest = np.max([part.largest for part in parts], axis=0)
        return cls(configurations, pivots, of_loops, largest)

    def ranks(self) -> IndexArray:
        """The number (n,) of independent rows in each."""
        return np.count_nonzero(self.pivots > STRUCTURAL_PIVOT, axis=1)  # type: ignore[no-any-return]

    def last_pivots(self, rank: int) -> FloatArray:
        """The last structural pivot in the configurations of that rank."""
        return self.pivots[self.ranks() == rank, rank - 1]  # type: ignore[no-any-return]


def _limits(iterations: int) -> Limits:
    """Where Newton's iteration onto the closures ends: ``iterations`` steps at most."""
    return Limits(iterations + 1, CLOSURE_ROUNDING, STUCK, CLOSING_RANK)


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
        Sentences for the user, such as one about structural and redundant pivots of similar size.
    eliminations
        Rows that are subtracted from others, in this order, where rows of closures between the
        same bodies are nearly parallel.
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

    def at(self, mechanism: MechanismData) -> Structure:
        """The same facts with the units of ``mechanism``, which differs in its start only."""
        units = coordinate_units(mechanism, mechanism.q0, mechanism.v0)
        return self if units is self.units else copied(self, units=units)

    @cached_property
    def kept_rows(self) -> list[int]:
        """Numbers of the rows that are kept."""
        return self.kept.nonzero()[0].tolist()

    @property
    def redundant_rows(self) -> tuple[str, ...]:
        """Names of the rows that the solve leaves out."""
        return tuple(name for name, keep in zip(self.row_names, self.kept) if not keep)

    @property
    def pivoted_redundancy(self) -> int:
        """Number of further redundant rows, chosen by pivoting at every evaluation."""
        return int(np.sum(self.kept)) - self.rank


def _explored(
    mechanism: MechanismData, sampler: ManifoldSampler, rng: np.random.Generator
) -> Samples:
    """The closed configurations that the analysis looks at."""
    start, error = sampler.close(mechanism.q0, iterations=100)
    closed = error < CLOSED
    start = start if closed else np.array(mechanism.q0)
    return sampler.explore(start, rng, RESTARTS, WALK_STEPS, mechanism.v0, sample_start=closed)


def _balanced(sampler: ManifoldSampler, samples: Samples, rank: int) -> Samples:
    """``samples`` after :meth:`ManifoldSampler.separate` and :meth:`ManifoldSampler.balance`; as
    they are, with their scale, if that does not raise the last pivot or makes more rows
    independent."""
    regular = np.flatnonzero(samples.ranks() == rank)
    chosen = regular[:: -(-len(regular) // BALANCING_SAMPLES)]
    scale = sampler.scale
    measured = [samples.configurations[i] for i in chosen]
    sampler.separate(measured, samples.largest > ZERO_ROW)
    sampler.balance(measured)
    again = sampler.samples(samples.configurations)
    before = float(np.median(samples.last_pivots(rank)))
    if int(again.ranks().max()) == rank and np.median(again.last_pivots(rank)) > before:
        return again
    sampler.scale, sampler.eliminations = scale, ()
    return samples


def row_names(mechanism: MechanismData) -> tuple[str, ...]:
    """Names of all rows: ``loop.row``, then those of the drives."""
    names = [name for loop in mechanism.loops for name in loop.row_names]
    return (*names, *(drive.name for drive in in_order_of_rows(mechanism.drives)))


def analyse(mechanism: MechanismData) -> Structure:
    """Row scales, structural rank, reference pivot and zero rows of ``mechanism``.

    Deterministic: the walk uses a fixed seed.  Source: docs/notation.md, "Manifold sampling".

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
    sampler = ManifoldSampler(mechanism, units)
    sampler.set_scale(rng)
    samples = _explored(mechanism, sampler, rng)
    if not len(samples.configurations):
        note = "no closed configuration was found: the loops do not close near the initial guess"
        kept = np.ones(len(names), dtype=bool)
        rank, loop_rank = (min(rows, mechanism.model.nv) for rows in (len(names), sampler.closed))
        return Structure(names, sampler.scale, kept, rank, loop_rank, 1.0, units, 0, (note,))
    notes: list[str] = []
    kept = samples.largest > ZERO_ROW
    kept[sampler.closed :] = True
    loop_rank = int((samples.of_loops > STRUCTURAL_PIVOT).sum(axis=1).max())
    rank = int(samples.ranks().max())
    if rank and np.median(samples.last_pivots(rank)) < SMALL_REFERENCE_PIVOT:
        samples = _balanced(sampler, samples, rank)
    sigma_ref = float(np.median(samples.last_pivots(rank))) if rank else 1.0
    if rank < loop_rank + len(mechanism.drives):
        driven = ", ".join(repr(drive.name) for drive in mechanism.drives)
        notes.append(
            f"the drives ({driven}) prescribe motions that follow from the closures or from each "
            "other: they must agree, and their forces are those of least norm"
        )
    if 0 < rank < samples.pivots.shape[1]:
        smallest_pivot = float(samples.last_pivots(rank).min())
        redundant = max(float(samples.pivots[:, rank:].max()), PIVOT_ZERO)
        if smallest_pivot < RANK_GAP * redundant:
            notes.append(
                f"the rank {rank} of the closures is uncertain: smallest independent pivot "
                f"{smallest_pivot:.1e}, largest redundant pivot {redundant:.1e}"
            )
            log.warning("%s: %s", mechanism.name, notes[-1])
    return Structure(
        names,
        sampler.scale,
        kept,
        rank,
        loop_rank,
        sigma_ref,
        units,
        len(samples.configurations),
        tuple(notes),
        sampler.eliminations,
    )


@per_start
def structure_of(mechanism: MechanismData) -> Structure:
    """The :func:`analyse` of ``mechanism``, made once."""
    return analyse(mechanism)


@per_model
def rows_in_use(mechanism: MechanismData) -> DrivenKinematics:
    """The kept, scaled rows of closures and drives; only copies of their workspace are
    evaluated."""
    structure = structure_of(mechanism)
    return DrivenKinematics(
        mechanism.model,
        mechanism.loops,
        mechanism.drives,
        structure.row_scale,
        structure.kept,
        structure.eliminations,
    )
