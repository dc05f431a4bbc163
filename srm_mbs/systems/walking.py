"""The walk on the closure manifold that the load-time analysis makes, and its scaled rows.

Source: docs/notation.md, "The walk" and "Scales of rows".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin
from scipy.linalg import lapack

from srm_mbs.arrays import BoolArray, FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.driven import DrivenKinematics
from srm_mbs.systems.loops import Elimination, world_jacobian
from srm_mbs.systems.pivoting import RowAlgebra, row_algebra, trees
from srm_mbs.systems.projection import cholesky, unwhiten, whiten
from srm_mbs.systems.units import Units, row_units
from srm_mbs.workspaces import workspace

OPEN_SAMPLES = 24
WALK_AMPLITUDE = 0.5
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
    eliminations
        Rows that are taken off others; none until :meth:`separate`.
    """

    def __init__(self, mechanism: Mechanism, units: Units) -> None:
        self.model = mechanism.model
        self.data = workspace(self.model)
        self.units = units
        self.row_unit = row_units(mechanism, units)
        self._rows = DrivenKinematics(self.model, mechanism.loops, mechanism.drives)
        self.closed = len(self.row_unit)
        self.scale = np.ones(len(self._rows.g))
        self.eliminations: tuple[Elimination, ...] = ()
        pattern = self._pattern = self._rows.pattern()
        self._anchored = [
            at
            for at, closure in enumerate(loop for loop in mechanism.loops for _ in loop.row_names)
            if not closure.rows.joint_rows
        ]
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

    def _scaled(self, q: FloatArray) -> FloatArray:
        """G (rows, nv) of the rows after the eliminations, over their scale."""
        self._evaluate(q)
        G = self._rows.G.copy()
        for row, other, factor in self.eliminations:
            G[row] -= factor * G[other]
        G /= self.scale[:, None]
        return G

    def factorised(self, q: FloatArray) -> tuple[RowAlgebra, RowAlgebra]:
        """The algebra of all scaled rows, and that of the loops', in the mass metric at q."""
        if self._factorised is not q:
            G = self._scaled(q)
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

    def distances(self, q: FloatArray) -> FloatArray:
        """How far each scaled row (rows,) in use at q is from the span of the others in use, in
        the mass metric; NaN for rows that are not in use.

        1/||E e_i|| for row i: E e_i is the smallest velocity that changes that row alone.
        """
        rows, _ = self.factorised(q)
        count = len(self.scale)
        X = np.array([rows.solve(row) for row in np.eye(count)])
        upper = np.triu(self.data.M)
        M = upper + np.triu(upper, 1).T
        size = np.sqrt(np.maximum(((X @ M) * X).sum(axis=1), 0.0))
        # No row is further from any span than it is long; what seems to be is not in use.
        used = size * np.sqrt(rows.row_squares) > 0.5
        out: FloatArray = np.divide(1.0, size, out=np.full(count, np.nan), where=used)
        return out

    def separate(self, samples: Sequence[FloatArray], kept: BoolArray) -> None:
        """Take off rows what makes them nearly parallel to others between the same bodies.

        Such as those of two points next to each other that hold a hinge: their difference, which
        holds it against turning, is small everywhere.  The last pivot then tells that a row is
        about to depend on others only where that is smaller still, whatever the scales.

        Parameters
        ----------
        samples
            Closed configurations.
        kept : (rows,) bool
            Rows that take part.
        """
        groups: dict[bytes, list[int]] = {}
        for row in self._anchored:
            if kept[row]:
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
            for k in (lapack.dgeqp3(W)[1] - 1).tolist():
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

        Where the rows of one closure differ much in size, as those that hold a slender body do,
        their common scale makes some of them small everywhere.  A pivot that vanishes is the last
        one only once it is smaller still.  Against its own distance every row is about 1 unless
        it is about to depend on others, whatever the sizes and directions of those.
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
