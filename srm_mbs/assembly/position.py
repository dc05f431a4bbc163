r"""Assembly of positions: the closure equations as a root-finding problem.

It has two stages on the configuration manifold: a trust-region least-squares solve from the guess
(SciPy), whose residual has the intended closed configuration as its only zero, and Newton's
iteration on the closure rows to round-off.  The guess determines the branch: if the closed
configuration that was found lies far from it, others are searched and the nearest is the result.

The last part is about position limits of joints: which are violated, and assembly within them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.compiled_rows import ClosureRows, compiled_rows
from srm_mbs.dynamics.constraints.geometry import (
    ClosureGeometry,
    loop_rows,
    turning_coordinates,
)
from srm_mbs.dynamics.constraints.newton import newton
from srm_mbs.dynamics.constraints.row_algebra import min_norm_solution, smallest_singular_value
from srm_mbs.dynamics.constraints.rows import support, world_jacobian
from srm_mbs.dynamics.scaling import coordinate_units, row_angles
from srm_mbs.dynamics.singularities.local_analysis import refine_singular_point
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.forces import OPEN_LIMIT, LimitSpring
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_model

CONSTRAINT_TOLERANCE = 1e-12
"""Largest closure error of an assembled state, in rad and in scene diagonals."""
EXACTLY_CLOSED = 1e-15
"""Closure error, in the same units, that is rounding: no step makes it smaller for certain."""
AXES_TOLERANCE = 1e-2
"""Largest mismatch of an assembled state: larger ones have axes in the opposite sense."""
RANK_TOLERANCE = 1e-10
"""Relative singular value below which a direction does not move the closures."""
SINGULAR_ROUNDING = 1e-13
"""Singular value of normalised rows below which it is rounding of zero."""
NEARLY_SINGULAR = 1e-4
"""Singular value below which a closed configuration may be an inaccurate singular one."""
FAR = 0.5
"""Motion of a joint (rad, scene diagonals) from the guess beyond which nearer closed configurations
are searched."""
OTHER_STARTS = 8
"""Random starts of that search."""
SEARCH_STEPS = 200
"""Evaluations of the trust-region solve."""
RESTART_STEPS = 100
"""The same of each restart, so that loops that cannot close are refused in reasonable time."""
STEPS_TOGETHER = 25
"""The same where groups of loops can be closed one by one."""
POLISHING_EVALUATIONS = 61
"""Evaluations of Newton's iteration after it."""
KEPT_GROUPS = 64
"""Mechanisms whose groups of loops are kept: variants have the same."""
NO_BOUNDS = (-np.inf, np.inf)
"""Bounds of motions that have none."""
FIRST_STEP = 0.1
"""Longest first step (rad, scene diagonals) of Newton's iteration that replaces a trust-region
solve."""
CONTRACTED = 1e-9
"""Step, in the same units, after which the next is rounding."""
CONTRACTING_STEPS = 8
"""Steps of that iteration."""
PERTURBATIONS = (0.05, 0.2, 0.5, 1.0, 1.5, 2.0)
"""Sizes (rad, scene diagonals) of the restarts if the search from the guess itself fails."""


@per_model
def _compiled_loop_rows(mechanism: MechanismData) -> ClosureRows:
    if not mechanism.drives:
        return compiled_rows(mechanism)
    return ClosureRows(mechanism.model, loop_rows(mechanism))


@lru_cache(maxsize=KEPT_GROUPS)
def _groups(pattern: bytes, nv: int, counts: tuple[int, ...]) -> list[tuple[list[int], IndexArray]]:
    """:attr:`ClosureProblem.groups` of loops with these ``counts`` of rows, whose entries may
    differ from zero where ``pattern`` (rows, nv) is true; nothing may change them."""
    out: list[tuple[list[int], set[int]]] = []
    moves, row = np.frombuffer(pattern, dtype=bool).reshape(-1, nv), 0
    for number, count in enumerate(counts):
        own = set(np.flatnonzero(moves[row : row + count].any(axis=0)).tolist())
        numbers, row = [number], row + count
        for group in [group for group in out if group[1] & own]:
            out.remove(group)
            numbers, own = [*group[0], *numbers], group[1] | own
        out.append((sorted(numbers), own))
    return [(numbers, np.array(sorted(own), dtype=int)) for numbers, own in out]


class ClosureProblem(ClosureGeometry):
    """The closure equations of a mechanism, and the distance from the intended closed state.

    The rows that were evaluated last are kept: assembly asks several times for those of one
    configuration."""

    _latest: tuple[bytes, FloatArray, FloatArray, FloatArray] | None = None
    _latest_mismatch: tuple[FloatArray, FloatArray] | None = None
    """g of one of them, and the mismatch there."""
    _latest_smallest: tuple[FloatArray, float] | None = None
    """G of one of them, and the smallest singular value there."""

    def closure(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As of every geometry, by the kernel where there is one; nothing may change the arrays."""
        key = q.tobytes()
        if self._latest is None or self._latest[0] != key:
            g, G = _compiled_loop_rows(self.mechanism).at(q)
            found = g / self.row_unit, G / self.row_unit[:, None] * self.unit
            for array in found:
                array.setflags(write=False)
            self._latest = key, q.copy(), *found
        return self._latest[2:]

    def _jacobians(self, q: FloatArray) -> FloatArray:
        G = _compiled_loop_rows(self.mechanism).jacobians(q)
        out: FloatArray = G / self.row_unit[:, None] * self.unit
        return out

    def mass(self) -> FloatArray:
        """As of every geometry."""
        if self._latest is not None:
            pin.crba(self.model, self.data, self._latest[1], pin.Convention.WORLD)
        return super().mass()

    def _placed(self) -> pin.Data:
        """Placements and Jacobian of the joints where the rows were evaluated last."""
        if self._latest is not None:
            pin.computeJointJacobians(self.model, self.data, self._latest[1])
        return self.data

    @cached_property
    def _unambiguous(self) -> list[IndexArray]:
        """For each loop, its :attr:`~srm_mbs.model.closures.RowSet.unambiguous` rows."""
        out, first = [], 0
        for loop in self.mechanism.loops:
            out.append(first + loop.rows.unambiguous)
            first += loop.rows.count
        return out

    @cached_property
    def _matching(self) -> dict[str, tuple[tuple[int, pin.SE3], tuple[int, pin.SE3], FloatArray]]:
        """By name of the loops that match axes: joint and placement in it of both anchors, and the
        sense (nv,) in which the coordinates move a against b."""
        out = {}
        for loop in self.mechanism.loops:
            if len(loop.rows.matched):
                a, b = loop.resolve(self.model)
                moves = support(self.model, a[0]) - support(self.model, b[0])
                out[loop.name] = (a, b, moves)
        return out

    @cached_property
    def groups(self) -> list[tuple[list[int], IndexArray]]:
        """Numbers of the loops, and velocity indices of the coordinates that move them, of the
        smallest groups of loops that share no coordinate: each closes by itself."""
        pattern = loop_rows(self.mechanism).pattern()
        counts = tuple(loop.rows.count for loop in self.mechanism.loops)
        return _groups(pattern.tobytes(), int(self.model.nv), counts)

    def smallest_value(self, q: FloatArray, free: IndexArray | None = None) -> float:
        """The smallest singular value of the normalised rows at q in the columns ``free``, above
        rounding; infinite if there is none."""
        whole = free is None or len(free) == self.model.nv
        rows = self.normalised(q) if whole else self.normalised(q)[:, free]
        if not whole:
            return smallest_singular_value(rows, SINGULAR_ROUNDING)
        if self._latest_smallest is None or self._latest_smallest[0] is not self.closure(q)[1]:
            found = smallest_singular_value(rows, SINGULAR_ROUNDING)
            self._latest_smallest = self.closure(q)[1], found
        return self._latest_smallest[1]

    def part(self, numbers: list[int]) -> ClosureProblem:
        """The closure equations of the loops of these ``numbers``, in the same units."""
        loops = self.mechanism.loops
        counts = np.cumsum([0, *(loop.rows.count for loop in loops)])
        chosen = tuple(loops[number] for number in numbers)
        out = ClosureProblem(replace(self.mechanism, loops=chosen), self.start)
        out.units, out.unit, out.coordinate_unit = self.units, self.unit, self.coordinate_unit
        out.row_unit = np.concatenate(
            [self.row_unit[counts[number] : counts[number + 1]] for number in numbers]
        )
        return out

    def mismatch(self, q: FloatArray) -> FloatArray:
        """Residual whose only zeros are the intended closed configurations: distances (in units)
        and differences of axes."""
        g = self.closure(q)[0]
        if self._latest_mismatch is None or self._latest_mismatch[0] is not g:
            found = self._mismatch(g)
            found.setflags(write=False)
            self._latest_mismatch = g, found
        return self._latest_mismatch[1]

    def linearised(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """:meth:`mismatch`, and its derivative for motions of the joints in units (entries, nv)."""
        g, G = self.closure(q)
        return self._mismatch(g), self._jacobian(G)

    def _mismatch(self, g: FloatArray) -> FloatArray:
        parts = []
        for loop, rows in zip(self.mechanism.loops, self._unambiguous):
            parts.append(g[rows])
            if len(loop.rows.matched):
                parts.append((self._axes_in_b(loop) - loop.rows.matched).ravel())
        return np.concatenate(parts)

    def _jacobian(self, G: FloatArray) -> FloatArray:
        parts = []
        for loop, rows in zip(self.mechanism.loops, self._unambiguous):
            parts.append(G[rows])
            if len(loop.rows.matched):
                _, (joint_b, in_b), moves = self._matching[loop.name]
                data = self._placed()
                into_b = (data.oMi[joint_b] * in_b).rotation.T
                turn = into_b @ (world_jacobian(data)[3:] * moves * self.unit)
                parts += [-pin.skew(axis) @ turn for axis in self._axes_in_b(loop)]
        return np.concatenate(parts)

    def loop_residuals(self, q: FloatArray) -> dict[str, tuple[float | None, float | None]]:
        """Distance (m) and misalignment (rad) of each loop at q; None where a type has none."""
        g = self.closure(q)[0] * self.row_unit
        angles = row_angles(self.mechanism)
        out = {}
        for loop, own in zip(self.mechanism.loops, self._unambiguous):
            rows, turned = g[own], angles[own]
            apart = float(np.linalg.norm(rows[~turned])) if not turned.all() else None
            angle = float(np.linalg.norm(rows[turned])) if turned.any() else None
            if len(loop.rows.matched):
                # chord of the unit vectors -> angle, accurate for small ones
                chords = np.linalg.norm(self._axes_in_b(loop) - loop.rows.matched, axis=1)
                angle = float(np.max(2.0 * np.arcsin(np.minimum(0.5 * chords, 1.0))))
            elif len(loop.rows.alignments):
                angle = float(np.max(np.arcsin(np.minimum(np.abs(rows[turned]), 1.0))))
            out[loop.name] = (apart, angle)
        return out

    def _axes_in_b(self, loop: LoopClosure) -> FloatArray:
        """The matched axes of a in the frame of b (c, 3), where the rows were evaluated last."""
        data = self._placed()
        a, b = (data.oMi[joint] * inside for joint, inside in self._matching[loop.name][:2])
        out: FloatArray = loop.rows.matched @ (b.rotation.T @ a.rotation).T
        return out

    def distance(self, q: FloatArray) -> float:
        """From the start to q: the norm of the joint motions in units."""
        return float(np.linalg.norm(self.difference(self.start, q)))

    @cached_property
    def _periodic(self) -> tuple[IndexArray, IndexArray]:
        """Indices into q and into v of the periodic angles: a whole turn leads to the same
        configuration.  Those of coupled joints are not among them."""
        coupled = {name for loop in self.mechanism.loops for name in loop.joints or ()}
        turning = turning_coordinates(self.mechanism)
        indices = [
            (joint.idx_q + k, joint.idx_v + k)
            for name, joint in zip(self.mechanism.joint_names, self.model.joints.tolist()[1:])
            for k in range(joint.nv)
            if turning[joint.idx_v + k] and name not in coupled
        ]
        in_q, in_v = np.array(indices, dtype=int).reshape(-1, 2).T
        return in_q, in_v

    @property
    def periodic(self) -> IndexArray:
        """Velocity indices of the periodic angles: hinges and universal joints."""
        return self._periodic[1]

    def unwrapped(self, q: FloatArray) -> FloatArray:
        """q with its periodic angles within half a turn of those at the start."""
        if np.abs(q - self.start).max() < 0.5 * np.pi:  # of (cos, sin) pairs and quaternions, too
            return q
        own = self._periodic[0]
        turns = np.round((q[own] - self.start[own]) / (2.0 * np.pi))
        q = q.copy()
        q[own] -= 2.0 * np.pi * turns
        return q

    def closed(self, q: FloatArray) -> bool:
        """Whether every loop is closed, with axes in the intended sense."""
        g, _ = self.closure(q)
        return float(np.abs(g).max()) <= CONSTRAINT_TOLERANCE and (
            float(np.abs(self.mismatch(q)).max()) < AXES_TOLERANCE
        )


def _search(
    problem: ClosureProblem,
    q: FloatArray,
    free: IndexArray,
    steps: int,
    bounds: tuple[Any, Any],
    *,
    near: bool,
) -> FloatArray:
    """Least-squares solve of :meth:`ClosureProblem.mismatch` over the free coordinates, from q.

    It converges to round-off: next to closed configurations that are not isolated, or where G
    loses rank, convergence is slow, and Newton's iteration from a point further away may diverge.

    Along directions that do not move the closures SciPy's steps are as long as the trust region,
    with a sign that rounding determines.  With ``near``, Levenberg's damping, additional rows for
    the step with the size of the residual, keeps the solution next to q (Yamashita, Fukushima: On
    the rate of convergence of the Levenberg-Marquardt method, 2001); it vanishes with the residual,
    whose zeros remain.
    """
    from scipy.optimize import least_squares

    latest: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def linearised(delta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mismatch and its derivative at the end of the motion; few steps are tried in vain."""
        nonlocal latest
        if latest is None or not np.array_equal(latest[0], delta):
            latest = delta.copy(), *problem.linearised(problem.move(q, delta, free))
        return latest[1:]

    def residual(delta: FloatArray) -> FloatArray:
        out: FloatArray = np.append(linearised(delta)[0], zeros)
        return out

    def jacobian(delta: FloatArray) -> FloatArray:
        full = np.zeros(problem.model.nv)
        full[free] = delta * problem.unit[free]
        chart = pin.dIntegrate(problem.model, q, full, pin.ARG1)
        gap, at_end = linearised(delta)
        out: FloatArray = ((at_end / problem.unit @ chart) * problem.unit)[:, free]
        if near:
            damping = max(float(np.linalg.norm(gap)), CONSTRAINT_TOLERANCE)
            out = np.vstack([out, damping * np.eye(len(free))])
        return out

    zeros = np.zeros(len(free) if near else 0)
    found = least_squares(
        residual,
        np.zeros(len(free)),
        jac=jacobian,
        method="trf",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=steps,
        bounds=bounds,
    )
    return problem.move(q, found.x, free)


def polish(problem: ClosureProblem, q: FloatArray, free: IndexArray) -> FloatArray:
    """Newton's iteration on the closure rows, by shortest steps of the ``free`` coordinates."""

    def linearise(q: FloatArray) -> tuple[float, Callable[[], FloatArray]]:
        g, G = problem.closure(q)

        def step() -> FloatArray:
            return problem.move(q, -min_norm_solution(G[:, free], g, RANK_TOLERANCE), free)

        return float(np.abs(g).max()), step

    return newton(q, linearise, POLISHING_EVALUATIONS)[0]


def _contracted(problem: ClosureProblem, q: FloatArray, free: IndexArray) -> FloatArray | None:
    """The closed configuration next to q, if Newton's iteration contracts to it and the closures
    determine all ``free`` coordinates; else None.

    If no step is longer than half the one before, the iteration ends at the one root within twice
    the first step (L. V. Kantorovich), which the trust-region solve from q would find, too.
    """
    longest = FIRST_STEP
    for _ in range(CONTRACTING_STEPS):
        g, G = problem.closure(q)
        step, _, rank, _ = np.linalg.lstsq(G[:, free], g, rcond=RANK_TOLERANCE)
        length = float(np.abs(step).max())
        if rank < len(free) or not length <= longest:
            return None
        q, longest = problem.move(q, -step, free), 0.5 * length
        if length <= CONTRACTED:
            return q
    return None


def onto_singular_point(problem: ClosureProblem, q: FloatArray, free: IndexArray) -> FloatArray:
    """The singular configuration next to q, to round-off (g has a double root there); else q."""
    if not problem.smallest_value(q, free) < NEARLY_SINGULAR:
        return q
    rows = problem.normalised(q)[:, free]
    rank = int(np.sum(np.linalg.svd(rows, compute_uv=False) > NEARLY_SINGULAR))
    # A regular configuration close to a singular one is kept: g must not become larger.
    closed = max(2e-15, float(np.abs(problem.closure(q)[0]).max()))
    found = refine_singular_point(problem, q, rank, NEARLY_SINGULAR, closed, free)
    return q if found is None else found


def close_positions(
    problem: ClosureProblem,
    q: FloatArray,
    free: IndexArray,
    steps: int = SEARCH_STEPS,
    bounds: tuple[Any, Any] = NO_BOUNDS,
) -> FloatArray:
    """The result of assembly from q (nq,) over the ``free`` coordinates, closed or not.

    ``bounds`` are the least and largest motions of these, in units.
    """
    if np.linalg.norm(problem.mismatch(q)) <= CONSTRAINT_TOLERANCE:
        exact = np.abs(problem.closure(q)[0]).max() <= EXACTLY_CLOSED
        return problem.unwrapped(q if exact else polish(problem, q, free))
    if bounds is NO_BOUNDS:
        nearby = _contracted(problem, q, free)
        if nearby is not None:
            nearby = polish(problem, nearby, free)
            if problem.closed(nearby):
                return problem.unwrapped(nearby)
    for near in (True, False):  # without damping where no configuration near q is closed
        found = polish(problem, _search(problem, q, free, steps, bounds, near=near), free)
        if problem.closed(found):
            break
    return problem.unwrapped(found)


def _close_by_groups(
    problem: ClosureProblem, start: FloatArray, q: FloatArray, free: IndexArray
) -> FloatArray:
    """The result of assembly from ``start`` (nq,), group by group, where all together did not
    close from there, but ended in ``q``.

    Groups that Newton's iteration closes from q stay there.  Of the others each is assembled by
    itself, until one of them does not close.
    """
    open_groups = []
    for numbers, columns in problem.groups:
        part, own = problem.part(numbers), np.intersect1d(columns, free)
        closer = polish(part, q, own) if len(own) else q
        if part.closed(closer):
            q = part.unwrapped(closer)
        else:
            open_groups.append((part, columns, own))
    for part, columns, own in open_groups:
        found = assemble_positions(part, start, own)
        if np.linalg.norm(part.mismatch(found)) < np.linalg.norm(part.mismatch(q)):
            q = q.copy()
            for joint in list(problem.model.joints)[1:]:
                if joint.idx_v in columns:
                    q[joint.idx_q : joint.idx_q + joint.nq] = found[
                        joint.idx_q : joint.idx_q + joint.nq
                    ]
        if not part.closed(found):
            break
    return q


def assemble_positions(problem: ClosureProblem, start: FloatArray, free: IndexArray) -> FloatArray:
    """The closed configuration nearest to the guess ``start``, or the closest one to closed."""
    if not len(free):
        return start
    together = len(problem.groups) == 1
    rng: np.random.Generator | None = None  # most starts need none, and making one takes 20 us

    best, best_gap = start, float(np.linalg.norm(problem.mismatch(start)))
    for size in (0.0, *PERTURBATIONS):
        spread = np.zeros(len(free))
        if size:
            rng = rng or np.random.default_rng(0)
            spread = rng.uniform(-size, size, len(free))
        steps = RESTART_STEPS if size else SEARCH_STEPS if together else STEPS_TOGETHER
        q = close_positions(problem, problem.move(start, spread, free), free, steps)
        if problem.closed(q):
            break
        if not together:
            q = _close_by_groups(problem, start, q, free)
            return onto_singular_point(problem, q, free) if problem.closed(q) else q
        gap = float(np.linalg.norm(problem.mismatch(q)))
        if gap < best_gap:
            best, best_gap = q, gap
    else:
        return best
    away = problem.difference(start, q)[free]
    far = float(np.abs(away).max())
    if far > FAR:
        # Another branch may be nearer: look on the other side of the guess and around it.
        rng = rng or np.random.default_rng(0)
        others = [-0.5 * away, -away]
        others += list(rng.uniform(-far, far, (OTHER_STARTS, len(free))))
        for other in others:
            candidate = close_positions(problem, problem.move(start, other, free), free)
            if problem.distance(candidate) < problem.distance(q) and problem.closed(candidate):
                q = candidate
    return onto_singular_point(problem, q, free)


LIMIT_TOLERANCE = 1e-9
"""Largest excess (rad or m) over a position limit that counts as rounding."""
CONTACT = 100.0
"""Angular frequency of a default contact over the mechanism's characteristic rate."""
DAMPING_RATIO = 0.1
SMALLEST_INERTIA = 1e-3
"""Least inertia that a default contact is made for, over the largest of the tree."""
STARTS = 24
SPREAD = 1.5
"""Size of the restarts, rad or scene diagonals."""


def _limited(mechanism: MechanismData) -> list[tuple[str, int, int, float, float]]:
    """(name, index in q, index in v, lowest, highest) of the one-degree joints with limits."""
    model = mechanism.model
    rows = []
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        if joint.nq == joint.nv == 1:
            low = float(model.lowerPositionLimit[joint.idx_q])
            high = float(model.upperPositionLimit[joint.idx_q])
            # Without limits Pinocchio has -inf, inf, or both zero where none were ever set.
            if low < high:
                rows.append((name, joint.idx_q, joint.idx_v, low, high))
    return rows


def beyond_limits(mechanism: MechanismData, q: FloatArray) -> dict[str, tuple[float, float]]:
    """Joint name -> (its position in q (nq,), the limit that it is beyond), rad or m."""
    out = {}
    for name, i, _, low, high in _limited(mechanism):
        if q[i] < low - LIMIT_TOLERANCE:
            out[name] = (float(q[i]), low)
        elif q[i] > high + LIMIT_TOLERANCE:
            out[name] = (float(q[i]), high)
    return out


def turned_within_limits(problem: ClosureProblem, q: FloatArray, free: IndexArray) -> FloatArray:
    """q (nq,), its periodic angles among ``free`` that are beyond their limits turned by whole
    turns to within them, where that is possible."""
    out, periodic = q.copy(), problem.periodic
    for _, i, j, low, high in _limited(problem.mechanism):
        if j in periodic and j in free:
            least = np.ceil((low - LIMIT_TOLERANCE - q[i]) / (2.0 * np.pi))
            most = np.floor((high + LIMIT_TOLERANCE - q[i]) / (2.0 * np.pi))
            if least <= most:
                out[i] += 2.0 * np.pi * np.clip(0.0, least, most)
    return out


def assemble_within_limits(
    problem: ClosureProblem, start: FloatArray, free: IndexArray
) -> FloatArray | None:
    """The closed configuration nearest to ``start`` that was found within all limits, or None."""
    mechanism = problem.mechanism
    rng = np.random.default_rng(0)
    limited = _limited(mechanism)
    found: list[FloatArray] = []
    for k in range(STARTS):
        spread = rng.uniform(-SPREAD, SPREAD, len(free)) if k else np.zeros(len(free))
        q = problem.move(start, spread, free)
        low, high = np.full(problem.model.nv, -np.inf), np.full(problem.model.nv, np.inf)
        for _, i, j, least, largest in limited:
            inside = 1e-6 * min(1.0, largest - least)  # the search starts within its bounds
            if j in free:
                q[i] = np.clip(q[i], least + inside, largest - inside)
            low[j], high[j] = (least - q[i]) / problem.unit[j], (largest - q[i]) / problem.unit[j]
        closed = close_positions(problem, q, free, bounds=(low[free], high[free]))
        # Angles are not unwrapped: one turn more may be within the limits.
        if problem.closed(closed) and not beyond_limits(mechanism, closed):
            found.append(closed)
    return min(found, key=problem.distance, default=None)


def limit_springs(mechanism: MechanismData) -> tuple[LimitSpring, ...]:
    """Springs at all position limits that have none yet, as stiff as the mechanism is fast.

    k = M_jj (100 w)^2 and c = 0.2 sqrt(k M_jj), with the inertia M_jj that the joint moves in the
    open tree at q0 and the mechanism's characteristic rate w
    (:class:`~srm_mbs.dynamics.scaling.Units`): a contact takes about a hundredth of its time.
    """
    there = {force.joint for force in mechanism.forces if isinstance(force, LimitSpring)}
    rate = coordinate_units(mechanism, mechanism.q0, mechanism.v0).rate
    inertia = np.diag(pin.crba(mechanism.model, workspace(mechanism.model), mechanism.q0))
    out = []
    for name, _, j, low, high in _limited(mechanism):
        moved = max(float(inertia[j]), SMALLEST_INERTIA * float(inertia.max()))
        stiffness = moved * (CONTACT * rate) ** 2
        if name not in there and min(abs(low), abs(high)) < OPEN_LIMIT:
            damping = 2.0 * DAMPING_RATIO * float(np.sqrt(stiffness * moved))
            out.append(LimitSpring(name, stiffness, damping, name=f"limit_{name}"))
    return tuple(out)
