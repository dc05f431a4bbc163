r"""Closing loops: the closure equations of a mechanism as a root-finding problem.

Two stages on the configuration manifold: a trust-region least-squares solve from the guess
(SciPy), whose residual has the intended closing as its only zero, and Gauss-Newton on the closure
rows to round-off.  The guess chooses the branch: where the closing found lies far from it, others
are looked for and the nearest is taken.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.mechanism import LoopClosure, Mechanism
from srm_mbs.systems.loops import LoopKinematics, support, world_jacobian
from srm_mbs.systems.structure import ROUNDING_ROW
from srm_mbs.systems.units import coordinate_units, row_units

CLOSED = 1e-12
"""Largest closure error of an assembled state, in rad and in scene diagonals."""
RANK = 1e-10
"""Relative singular value below which a direction does not move the closures."""
NEARLY_SINGULAR = 1e-4
"""Singular value below which a closing may be an inaccurate singular one."""
FAR = 0.5
"""Motion of a joint (rad, scene diagonals) from the guess beyond which nearer closings are looked
for."""
OTHER_STARTS = 8
SEARCH_STEPS = 200
PERTURBATIONS = (0.05, 0.2, 0.5, 1.0, 1.5, 2.0)
"""Sizes (rad, scene diagonals) of the restarts when the guess itself leads nowhere."""


class ClosureProblem:
    """Closure equations of a mechanism in the free coordinates."""

    def __init__(self, mechanism: Mechanism, start: FloatArray) -> None:
        self.mechanism = mechanism
        self.start = start
        # Gravity cancels in Gdot v, but its rounding would not at small rates.
        self.model = mechanism.model.copy()
        self.model.gravity.linear = np.zeros(3)
        self.data = self.model.createData()
        self.rows = LoopKinematics(self.model, mechanism.loops)
        units = coordinate_units(mechanism, start, np.zeros(self.model.nv))
        self.unit = units.coordinate
        self.length = units.length
        self.row_unit = row_units(mechanism.loops, units.length)

    def closure(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """g over row units (rows,), and G over row units times coordinate units (rows, nv)."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        self.rows.update(self.data, with_bias=False)
        return self.rows.g / self.row_unit, self.rows.G / self.row_unit[:, None] * self.unit

    @cached_property
    def row_size(self) -> FloatArray:
        """Usual norm of the rows of G in :meth:`closure`: rms over open configurations (rows,).

        One size for the position rows of a loop and one for its alignments; 1 where all are zero.
        """
        rng = np.random.default_rng(0)
        squares = np.zeros(len(self.row_unit))
        uncancelled = np.zeros(2)
        for _ in range(8):
            spread = rng.uniform(-np.pi, np.pi, self.model.nv) * self.unit
            _, G = self.closure(pin.integrate(self.model, self.start, spread))
            squares += (G**2).sum(axis=1) / 8
            # What rows would measure if nothing in them cancelled: their rounding is eps of it.
            J = world_jacobian(self.data)
            turn = np.linalg.norm(J[3:], axis=0) * self.unit
            shift = np.linalg.norm(J[:3], axis=0) * self.unit / self.length + turn
            uncancelled += np.array([shift @ shift, turn @ turn]) / 8
        at = 0
        for loop in self.mechanism.loops:
            middle, end = at + len(loop.rows.directions), at + loop.rows.count
            for block, whole in zip((slice(at, middle), slice(middle, end)), uncancelled):
                if block.stop > block.start:
                    mean = squares[block].mean()
                    # Always satisfied: rounding must not be scaled up to a row.
                    squares[block] = mean if mean > ROUNDING_ROW**2 * whole else whole
            at = end
        return np.sqrt(np.where(squares > 0.0, squares, 1.0))

    def normalised(self, q: FloatArray) -> FloatArray:
        """G of :meth:`closure`, rows over their usual size: what ranks are judged by."""
        return self.closure(q)[1] / self.row_size[:, None]

    def bias(self, q: FloatArray, u: FloatArray) -> FloatArray:
        """Gdot v, rows over their usual size, for the rates u (nv,) in units."""
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        pin.nonLinearEffects(self.model, self.data, q, u * self.unit)
        self.rows.update(self.data)
        return self.rows.bias / self.row_unit / self.row_size

    def mismatch(self, q: FloatArray) -> FloatArray:
        """Closing residual whose only zero is the intended closing: gaps and axis differences."""
        self.closure(q)
        parts = []
        for loop in self.mechanism.loops:
            Ta, Tb = self._anchors(loop)
            parts.append(loop.rows.directions @ Tb.actInv(Ta.translation) / self.length)
            if len(loop.rows.matched):
                R = Tb.rotation.T @ Ta.rotation
                parts.append((loop.rows.matched @ R.T - loop.rows.matched).ravel())
        return np.concatenate(parts)

    def mismatch_jacobian(self, q: FloatArray) -> FloatArray:
        """Derivative of :meth:`mismatch` for motions of the joints, in units (entries, nv)."""
        _, G = self.closure(q)
        parts, at = [], 0
        for loop in self.mechanism.loops:
            parts.append(G[at : at + len(loop.rows.directions)])
            at += loop.rows.count
            if len(loop.rows.matched):
                Ta, Tb = self._anchors(loop)
                moves = support(self.model, loop.a.resolve(self.model)[0])
                moves = moves - support(self.model, loop.b.resolve(self.model)[0])
                turn = Tb.rotation.T @ (world_jacobian(self.data)[3:] * moves * self.unit)
                R = Tb.rotation.T @ Ta.rotation
                parts += [-pin.skew(m) @ turn for m in loop.rows.matched @ R.T]
        return np.concatenate(parts)

    def gaps(self, q: FloatArray) -> dict[str, tuple[float | None, float | None]]:
        """Gap (m) and misalignment (rad) of each loop at q; None where a type has none."""
        self.closure(q)
        out = {}
        for loop in self.mechanism.loops:
            Ta, Tb = self._anchors(loop)
            gap = angle = None
            if len(loop.rows.directions):
                gap = float(np.linalg.norm(loop.rows.directions @ Tb.actInv(Ta.translation)))
            if len(loop.rows.matched):
                R = Tb.rotation.T @ Ta.rotation
                # chord of the unit vectors -> angle, accurate for small ones
                chords = np.linalg.norm(loop.rows.matched @ R.T - loop.rows.matched, axis=1)
                angle = float(np.max(2.0 * np.arcsin(np.minimum(0.5 * chords, 1.0))))
            out[loop.name] = (gap, angle)
        return out

    def _anchors(self, loop: LoopClosure) -> tuple[pin.SE3, pin.SE3]:
        joint_a, in_a = loop.a.resolve(self.model)
        joint_b, in_b = loop.b.resolve(self.model)
        return self.data.oMi[joint_a] * in_a, self.data.oMi[joint_b] * in_b

    def move(self, q: FloatArray, free: IndexArray, delta: Any) -> FloatArray:
        """q (+) delta, delta (k,) in units over the free coordinates (indices)."""
        full = np.zeros(self.model.nv)
        full[free] = delta * self.unit[free]
        return pin.integrate(self.model, q, full)  # type: ignore[no-any-return]

    def distance(self, q: FloatArray) -> float:
        """From the start to q: the norm of the joint motions in units."""
        return float(np.linalg.norm(pin.difference(self.model, self.start, q) / self.unit))

    def unwound(self, q: FloatArray) -> FloatArray:
        """q without full turns of its hinges away from the start."""
        q = q.copy()
        for joint in list(self.model.joints)[1:]:
            if joint.nq == joint.nv == 1 and joint.shortname().startswith("JointModelR"):
                turns = np.round((q[joint.idx_q] - self.start[joint.idx_q]) / (2.0 * np.pi))
                if turns:
                    q[joint.idx_q] -= 2.0 * np.pi * turns
        return q

    def closed(self, q: FloatArray) -> bool:
        """Whether every loop is closed as intended, axes in the right sense."""
        g, _ = self.closure(q)
        return float(np.abs(g).max()) <= CLOSED and float(np.abs(self.mismatch(q)).max()) < 1e-6


def _search(problem: ClosureProblem, q: FloatArray, free: IndexArray) -> FloatArray:
    """Least-squares solve of the closing residual over the free coordinates, from q.

    To round-off: next to closings that are not isolated, or where G loses rank, convergence is
    slow, and stopping early would leave the rest to Newton's steps, which may lead anywhere.
    """
    from scipy.optimize import least_squares

    def jacobian(delta: FloatArray) -> FloatArray:
        full = np.zeros(problem.model.nv)
        full[free] = delta * problem.unit[free]
        chart = pin.dIntegrate(problem.model, q, full, pin.ARG1)
        at_end = problem.mismatch_jacobian(problem.move(q, free, delta)) / problem.unit
        out: FloatArray = ((at_end @ chart) * problem.unit)[:, free]
        return out

    found = least_squares(
        lambda delta: problem.mismatch(problem.move(q, free, delta)),
        np.zeros(len(free)),
        jac=jacobian,
        method="trf",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=SEARCH_STEPS,
    )
    return problem.move(q, free, found.x)


def _polish(problem: ClosureProblem, q: FloatArray, free: IndexArray) -> FloatArray:
    """Gauss-Newton on the closure rows until they stop improving."""
    g, G = problem.closure(q)
    best, error = q, float(np.abs(g).max())
    for _ in range(60):
        if error == 0.0:
            break
        step = np.linalg.lstsq(G[:, free], g, rcond=RANK)[0]
        q = problem.move(q, free, -step)
        g, G = problem.closure(q)
        new_error = float(np.abs(g).max())
        if not new_error < error:
            break
        best, error = q, new_error
    return best


def _onto_singular_point(problem: ClosureProblem, q: FloatArray, free: IndexArray) -> FloatArray:
    """Sharpen a double root: Newton on g = 0 together with the loss of rank of G.

    At a singular configuration g has a double root in the free coordinates, which Gauss-Newton
    finds only to the square root of round-off.  G loses rank where the Schur complement S of its
    well-conditioned part vanishes.  Returns q unchanged where this does not help.
    """

    def normalised(x: FloatArray) -> FloatArray:
        return problem.normalised(x)[:, free]

    left, singular, right = np.linalg.svd(normalised(q))
    if not np.any((singular > 1e-13) & (singular < NEARLY_SINGULAR)):
        return q
    rank = int(np.sum(singular > NEARLY_SINGULAR))

    def equations(x: FloatArray) -> FloatArray:
        g, _ = problem.closure(x)
        turned = left.T @ normalised(x) @ right.T
        strong, up, down = turned[:rank, :rank], turned[:rank, rank:], turned[rank:, :rank]
        schur = turned[rank:, rank:] - down @ np.linalg.solve(strong, up)
        return np.concatenate([g, schur.ravel()])

    rows = len(problem.row_unit)
    # A regular closing close to a singular one must stay: g may not become larger.
    allowed = max(2e-15, float(np.abs(problem.closure(q)[0]).max()))
    tau = 1e-6
    x, value = q, equations(q)
    for _ in range(8):
        jacobian = np.array(
            [
                equations(problem.move(x, free, tau * e))
                - equations(problem.move(x, free, -tau * e))
                for e in np.eye(len(free))
            ]
        ).T / (2.0 * tau)
        x = problem.move(x, free, -np.linalg.lstsq(jacobian, value, rcond=1e-9)[0])
        moved = float(np.abs(pin.difference(problem.model, q, x) / problem.unit).max())
        if not moved < NEARLY_SINGULAR:
            return q
        value = equations(x)
        g_size, loss = np.abs(value[:rows]).max(), np.abs(value[rows:]).max()
        if g_size <= allowed and loss < 1e-13:
            return x
    return q


def close_loops(problem: ClosureProblem, start: FloatArray, free: IndexArray) -> FloatArray:
    """The closed configuration nearest to the guess ``start``, or the closest one to closed."""
    if not len(free):
        return start
    rng = np.random.default_rng(0)

    def attempt(q: FloatArray) -> FloatArray:
        if np.linalg.norm(problem.mismatch(q)) > CLOSED:
            q = _search(problem, q, free)
        return problem.unwound(_polish(problem, q, free))

    best, best_gap = start, float(np.linalg.norm(problem.mismatch(start)))
    for size in (0.0, *PERTURBATIONS):
        spread = rng.uniform(-size, size, len(free)) if size else np.zeros(len(free))
        q = attempt(problem.move(start, free, spread))
        if problem.closed(q):
            break
        gap = float(np.linalg.norm(problem.mismatch(q)))
        if gap < best_gap:
            best, best_gap = q, gap
    else:
        return best
    away = (pin.difference(problem.model, start, q) / problem.unit)[free]
    far = float(np.abs(away).max())
    if far > FAR:
        # Another branch may be nearer: look on the other side of the guess and around it.
        others = [-0.5 * away, -away]
        others += list(rng.uniform(-far, far, (OTHER_STARTS, len(free))))
        for other in others:
            candidate = attempt(problem.move(start, free, other))
            if problem.distance(candidate) < problem.distance(q) and problem.closed(candidate):
                q = candidate
    return _onto_singular_point(problem, q, free)
