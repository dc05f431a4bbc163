r"""Mechanisms as systems: the equations of motion, without closures and with them.

    q' = v,   M(q) v' = f(q, v, t) - G^T lam,   g(q) = s(t),   f = tau - nle(q, v),

with s the motion of the drives, 0 in the rows of the loops, and tau the forces of the controller,
joint damping and friction, and force elements.

:class:`OpenSystem` and :class:`ClosedSystem` evaluate a stage; :class:`OpenTerms` and
:class:`ClosedTerms` hold its quantities in tangent coordinates.  States and their moves are in
:mod:`srm_mbs.dynamics.manifold`, the algebra of the closures in
:mod:`srm_mbs.dynamics.constraints.projection`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.linalg import blas

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.geometry import geometry_of
from srm_mbs.dynamics.constraints.projection import (
    PIVOT_SHARE,
    PIVOT_WINDOW,
    Projection,
    cholesky,
    unwhiten,
    whiten,
)
from srm_mbs.dynamics.constraints.rheonomic import DrivenKinematics
from srm_mbs.dynamics.constraints.row_algebra import graph_order
from srm_mbs.dynamics.constraints.rows import COINCIDENT, Trees, trees_of
from srm_mbs.dynamics.constraints.structure import coordinate_tree, rows_in_use
from srm_mbs.dynamics.controllers import Controller, HeldForce, evaluate_controller
from srm_mbs.dynamics.forces import (
    HALF_TURN_ROUNDING,
    LOCATED_HALF_TURN,
    BushingStep,
    Evaluator,
    ForceKinematics,
    friction_sums,
    resolved_forces,
)
from srm_mbs.dynamics.manifold import Manifold
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import constraint_units
from srm_mbs.dynamics.system import (
    AccelerationDerivatives,
    BranchSystem,
    SingularityAnalysis,
    Terms,
    Zone,
)
from srm_mbs.errors import EvaluationError
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import per_model, per_start


class OpenTerms:
    """Terms of a mechanism without closures: the acceleration, and no algebra."""

    sigma = np.inf
    rank = 0
    rank_deficient = False
    held = False

    def __init__(self, nv: int) -> None:
        self._rate = np.zeros(2 * nv)
        self._nv = nv

    def normals(self) -> FloatArray:
        return np.zeros((self._nv, 0))

    def rate(self) -> FloatArray:
        return self._rate

    def multiplier(self) -> FloatArray:
        return np.zeros(self._nv)

    def project(self, w: FloatArray) -> FloatArray:
        return np.zeros(self._nv)

    def constraint_residual(self) -> float:
        return 0.0

    def correction(self) -> FloatArray:
        return np.zeros(2 * self._nv)

    def prediction(self) -> FloatArray:
        return np.zeros(self._nv)

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        return self._rate, np.zeros(self._nv)


class ClosedTerms:
    """Terms of the stage of a closed-loop mechanism that was evaluated last, from the factorisation
    of the ``system``.

    Attributes
    ----------
    v : (nv,)
        Velocity.
    predicted : (nv,) or None
        yhat of the zone, of which the part of dropped rows is used.
    white_multiplier : (nv,)
        L^T yhat.
    """

    def __init__(self, system: ClosedSystem) -> None:
        self._system, self._p, self._loops = system, system.projection, system.loops
        self.v = np.zeros(system.nv)
        self.predicted: FloatArray | None = None
        self.white_multiplier = self.v

    @property
    def sigma(self) -> float:
        return self._p.sigma

    @property
    def rank(self) -> int:
        return self._p.rank

    @property
    def rank_deficient(self) -> bool:
        return self._p.rank_deficient

    @property
    def held(self) -> bool:
        return self._p.held is not None

    def normals(self) -> FloatArray:
        return np.zeros((self.v.size, 0)) if self._system.driven else self._p.weak_normals()

    def rate(self) -> FloatArray:
        p = self._p
        return np.concatenate([self.v, unwhiten(p.U, p.white_force - self.white_multiplier)])

    def multiplier(self) -> FloatArray:
        return self._p.unwhiten(self.white_multiplier)

    def prediction(self) -> FloatArray:
        return self.multiplier()

    def project(self, w: FloatArray) -> FloatArray:
        return self._p.project(w)

    def _white_rates(self, w: FloatArray, s: float = 1.0) -> FloatArray:
        """L^T (P w - s E s'): with w = v and s = 1 that of the rates that violate G v = s'."""
        p = self._p
        white = p.white_project(w)
        if not self._system.driven:
            return white
        return white - s * p.normal(self._loops.target_rate)

    def constraint_residual(self) -> float:
        return float(np.abs(self._loops.g * self._system.residual_scale).max())

    def correction(self) -> FloatArray:
        p = self._p
        position = p.normal(self._loops.g)
        return np.concatenate([p.unwhiten(position), p.unwhiten(self._white_rates(self.v))])

    def free_acceleration(self) -> FloatArray:
        """M^-1 f (nv,)."""
        return self._p.unwhiten(self._p.white_force)

    def momentum(self, v: FloatArray) -> FloatArray:
        """M v (nv,)."""
        p = self._p
        momentum: FloatArray = p.U.T @ (p.U @ v)
        return momentum

    def multiplier_of(self, a: FloatArray) -> FloatArray:
        """E (G a + Gdot v - s'') (nv,) of the free acceleration ``a`` (nv,)."""
        p = self._p
        return p.unwhiten(p.white_project(a) + p.normal(self._loops.bias))

    def driven_residuals(self) -> FloatArray:
        """g - s of the rows of the drives."""
        return self._loops.g[self._loops.driven_rows].copy()

    def closing(self, allowed: FloatArray) -> FloatArray:
        """E g (nv,), without ``allowed`` of the rows of the drives."""
        g = self._loops.g.copy()
        g[self._loops.driven_rows] -= allowed
        return self._p.unwhiten(self._p.normal(g))

    def branch_tangents(self) -> tuple[FloatArray, FloatArray]:
        """M-orthonormal velocities (nv, k) that satisfy the closures, whatever the drives, and the
        rates (d, k) of the drives along them."""
        p, rows = self._p, self._loops.driven_rows
        units = np.eye(len(self._loops.g))[:, rows]
        driven = np.array([p.normal(unit) for unit in units.T]).reshape(-1, len(self.v))
        free = p.complement()
        own: list[FloatArray] = []
        own_rates: list[FloatArray] = []
        for white, rates in zip(driven, np.eye(len(driven))):
            size = np.linalg.norm(white)
            for _ in range(2):
                for other, its in zip(own, own_rates):
                    part = other @ white
                    white, rates = white - part * other, rates - part * its
            left = np.linalg.norm(white)
            if left > DEPENDENT_DRIVE * size:
                own.append(white / left)
                own_rates.append(rates / left)
        none = np.zeros((len(driven), free.shape[1]))
        return p.unwhiten(np.column_stack([free, *own])), np.column_stack([none, *own_rates])

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        p = self._p
        position = p.unwhiten(p.normal(self._loops.g))
        white = self._white_rates(previous + self.v / eps, 1.0 / eps)
        if self.predicted is not None:
            white = p.completed(white, self.predicted)
        rate = np.concatenate([self.v - position / eps, p.unwhiten(p.white_force - white)])
        return rate, p.unwhiten(white)


@per_model
def _constants(mechanism: Mechanism) -> dict[str, Any]:
    """:meth:`Mechanics.constants_of_model`, once a system of the mechanism has filled it in."""
    return {}


class Mechanics(Manifold):
    """Applied forces, energy and constants of a mechanism and its controller, open or closed."""

    carries_yhat = True
    predicts = True
    time_unit = " s"
    sigma_scatters = False
    residual_scale = np.zeros(0)
    """Factor (m,) from each scaled row in use to row units."""

    def __init__(self, mechanism: Mechanism, controller: Controller | None) -> None:
        super().__init__(mechanism)
        self.multiplier_part = slice(self.nv, 2 * self.nv)
        self.multiplier_size = self.nv
        self.evaluations = 0
        self._controller = controller
        self._damping: FloatArray = self.model.damping.copy()
        self._friction: FloatArray = self.model.friction.copy()
        # Of a list, because any() of a short array costs five times as much.
        self.is_damped = any(self._damping.tolist())
        self.has_friction = any(self._friction.tolist())
        self._is_loaded = self.is_damped or self.has_friction or controller is not None
        self.friction_speed = mechanism.friction_speed
        self._forces = resolved_forces(mechanism)
        self._first, self._last = -np.inf, np.inf
        self._bushings: dict[Evaluator, BushingStep] = {}
        self._applied: FloatArray | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # Terms and workspaces share memory, which copies of them would not.
        return type(self), (self.mechanism, self._controller)

    # Allocated when the reference first evaluates; the compiled kernel has its own.
    @cached_property
    def data(self) -> pin.Data:
        """Pinocchio's workspace."""
        return workspace(self.model)

    @cached_property
    def _no_force(self) -> FloatArray:
        return np.zeros(self.nv)

    @cached_property
    def _laws_at(self) -> tuple[FloatArray, FloatArray]:
        """q and v of the stage evaluated last."""
        return np.zeros(self.nq), self._no_force

    @property
    def origins(self) -> Sequence[Sequence[float]]:
        """Those of the anchors of the closures in use, each in the axes of its joint."""
        return ()

    @property
    def controlled(self) -> bool:
        """Whether a controller acts."""
        return self._controller is not None

    @cached_property
    def time_dependent(self) -> bool:
        """Whether drives, laws of forces, functions of the user or a controller act, which may
        depend on time; one whose output is held does not."""
        forces = [] if self._forces is None else self._forces.constants()
        laws = any(len(force.get("curves", ())) for force in forces)
        acts = self.controlled and self.held is None
        return acts or self.has_user_forces or laws or bool(self.mechanism.drives)

    @property
    def has_user_forces(self) -> bool:
        """Whether force elements are functions of the user."""
        return self._forces is not None and self._forces.has_user_forces

    def callback_force(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """Generalised forces (nv,) of the Python functions that act: the controller, unless its
        output is held, and those among the force elements."""
        tau = np.zeros(self.nv) if self.held is not None else self.controlled_force(t, q, v)
        if self._forces is not None and self._forces.has_user_forces:
            tau = tau + self._forces.user_forces(self.data, q, v, t)
        return tau

    @property
    def held(self) -> HeldForce | None:
        """The controller, if it is one whose output is held between samples."""
        return self._controller if isinstance(self._controller, HeldForce) else None

    def count(self, evaluations: int, factorisations: int) -> None:
        """Add the work of the compiled kernel for this system to the counters."""
        self.evaluations += evaluations

    def restart(self) -> None:
        """Begin another run: the counters are zero."""
        self.evaluations = 0

    def between(self, first: float, last: float) -> None:
        """Limit the times of evaluations to [``first``, ``last``] (s): the equations on one side of
        a breakpoint, where its other side would be evaluated otherwise."""
        self._first, self._last = first, last
        self.end_step()

    def end_step(self) -> None:
        """See :class:`~srm_mbs.dynamics.system.System`."""
        self._bushings = {}

    def rescale(self, t: float, state: FloatArray) -> bool:
        """False: the sizes are those of the mechanism."""
        return False

    def begin_step(self, t: float, state: FloatArray) -> None:
        """See :class:`~srm_mbs.dynamics.system.System`."""
        if self._forces is not None and self._forces.bushings:
            self._bushings = self._forces.begin_step(self.data, *self.split(state), t)

    def past_jump(self, t: float, state: FloatArray) -> float:
        """See :class:`~srm_mbs.dynamics.system.System`; the moments of bushings jump at half a
        turn."""
        if self._forces is None or not self._bushings:
            return -np.inf
        return self._forces.past_half_turn(self.data, *self.split(state), t, self._bushings)

    @contextmanager
    def everywhere(self) -> Iterator[None]:
        """Within this context, evaluations are not limited to any times."""
        limits = self._first, self._last
        self.between(-np.inf, np.inf)
        try:
            yield
        finally:
            self.between(*limits)

    def controlled_force(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """Generalised forces (nv,) of the controller; 0 without one."""
        if self._controller is None:
            return np.zeros(self.nv)
        return evaluate_controller(self._controller, self.mechanism, t, q, v)

    def damping_force(self, v: FloatArray) -> FloatArray:
        """Joint damping -d v, for the rates v (nv,) or (n, nv)."""
        return -self._damping * v if self.is_damped else np.zeros(v.shape)

    def friction_force(self, v: FloatArray) -> FloatArray:
        """Joint friction -F tanh(v / v_s), for the rates v (nv,) or (n, nv)."""
        if not self.has_friction:
            return np.zeros(v.shape)
        return -self._friction * np.tanh(v / self.friction_speed)

    @cached_property
    def friction_sums(self) -> FloatArray:
        """See :class:`~srm_mbs.dynamics.system.System`."""
        return friction_sums(self.model, self._forces)

    @cached_property
    def _law_coordinates(self) -> IndexArray:
        """Velocity indices of the coordinates with a law."""
        acted = (self._damping != 0.0) | (self._friction != 0.0)
        if self._forces is not None:
            acted[self._forces.coordinates()] = True
        return np.flatnonzero(acted)

    @cached_property
    def _joined(self) -> ForceKinematics | None:
        """The elements, if the generalised forces of all laws are one law; see
        :attr:`ClosedSystem.laws`."""
        return None

    @property
    def laws(self) -> FloatArray:
        """Values (m,) of the laws of forces at the stage evaluated last: those of the coordinates
        with damping, friction, springs or limits, then those of the elements between links."""
        q, v = self._laws_at
        along = self.damping_force(v) + self.friction_force(v)
        between: list[FloatArray] = []
        if self._forces is not None:
            springs, between = self._forces.laws(self.data, q, v, self._bushings)
            along = along + springs
        return np.concatenate([along[self._law_coordinates], *between])

    def friction_tolerance(self, v: FloatArray) -> FloatArray:
        """See :class:`~srm_mbs.dynamics.system.System`."""
        limits = np.full(2 * self.nv, np.inf)
        for row in self.friction_sums:
            own = np.flatnonzero(row)
            size = self.friction_speed + FRICTION_PART * abs(float(row @ v))
            at = self.nv + own
            limits[at] = np.minimum(limits[at], size / np.abs(row[own]))
        return limits

    def apply_laws(self, values: FloatArray | None) -> None:
        """See :class:`~srm_mbs.dynamics.system.System`."""
        self._applied = values

    def _passive_force(self, v: FloatArray) -> FloatArray:
        """Damping and friction, or what acts in place of the laws of the coordinates."""
        if self._applied is None:
            damping = self.damping_force(v)
            return damping + self.friction_force(v) if self.has_friction else damping
        if self._joined is not None:
            return self._applied
        force = np.zeros(self.nv)
        force[self._law_coordinates] = self._applied[: len(self._law_coordinates)]
        return force

    def _element_force(
        self, forces: ForceKinematics, t: float, q: FloatArray, v: FloatArray
    ) -> FloatArray:
        """The generalised forces (nv,) of the elements, or of what acts in place of their laws."""
        if self._applied is None:
            return forces.generalised(self.data, q, v, t, self._bushings)
        if self._joined is not None:
            return forces.without_laws(self.data, q, v, t)
        applied = self._applied[len(self._law_coordinates) :]
        return forces.generalised_with(self.data, q, v, t, applied, self._bushings)

    def applied_force(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """Controller, joint damping and joint friction (nv,)."""
        force = self._passive_force(v)
        return force if self._controller is None else self.controlled_force(t, q, v) + force

    def _forces_at(self, t: float, state: FloatArray) -> FloatArray:
        """All forces (nv,) but those of inertia, gravity and closures."""
        t = min(max(t, self._first), self._last)
        q, v = state[: self.nq], state[self.nq :]
        loaded = self._is_loaded or self._applied is not None
        force = self.applied_force(t, q, v) if loaded else self._no_force
        if self._forces is not None:
            pin.forwardKinematics(self.model, self.data, q, v)
            pin.computeJointJacobians(self.model, self.data)
            force = force + self._element_force(self._forces, t, q, v)
        self._laws_at = q, v
        return force

    def _tree_derivatives(
        self, state: FloatArray, accelerations: FloatArray, normals: FloatArray
    ) -> AccelerationDerivatives | None:
        """See :class:`~srm_mbs.dynamics.system.System`, for closures whose G is constant, with
        their M-orthonormal ``normals`` N (nv, k): da = (M^-1 - N N^T) (df - dID), ID the inverse
        dynamics."""
        model = self.model
        if model.gravity.angular.any():
            return None
        q, v = state[: self.nq], state[self.nq :]
        by_q, by_v, M = pin.computeRNEADerivatives(model, self.data, q, v, accelerations)
        U = cholesky(M)
        by_forces = unwhiten(U, whiten(U, np.eye(self.nv))) - normals @ normals.T
        return AccelerationDerivatives(
            by_forces, -by_forces @ by_q, -by_forces @ by_v, self._forces_at
        )

    def working_force(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """Generalised forces (nv,) that do work: all but those of inertia and of closures."""
        force = self._forces_at(t, np.concatenate([q, v]))
        gravity: FloatArray = pin.computeGeneralizedGravity(self.model, self.data, q)
        return force - gravity

    def inertial_force(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """-C(q, v) v (nv,): Coriolis and centrifugal forces."""
        gravity: FloatArray = pin.computeGeneralizedGravity(self.model, self.data, q).copy()
        effects: FloatArray = pin.nonLinearEffects(self.model, self.data, q, v)
        return gravity - effects

    def constants(self) -> dict[str, Any]:
        """Everything that does not change, for the compiled kernel
        (:mod:`srm_mbs.integration.kernel`)."""
        known = _constants(self.mechanism)
        if not known:
            known |= self.constants_of_model()
        return known | self.constants_of_start()

    def constants_of_start(self) -> dict[str, Any]:
        """Those among :meth:`constants` that depend on the start, or that the model may change."""
        return {
            "unit": self._unit,
            "residual_scale": self.residual_scale,
            "damping": self._damping if self.is_damped else None,
            "friction": self._friction if self.has_friction else None,
            "friction_speed": float(self.friction_speed),
        }

    def constants_of_model(self) -> dict[str, Any]:
        """Those that do not depend on the start."""
        return {
            "loops": [],
            "joint_rows": [],
            "eliminations": [],
            "drives": [],
            "rows": 0,
            "structural_rank": 0,
            "sigma_ref": 1.0,
            "algebra": "auto",
            "order": [],
            "pivot_share": PIVOT_SHARE,
            "pivot_window": PIVOT_WINDOW,
            "forces": [] if self._forces is None else self._forces.constants(),
            "coincident": COINCIDENT,
            "half_turn": np.array([HALF_TURN_ROUNDING, LOCATED_HALF_TURN]),
        } | self.chart_constants()

    def kinetic_energy(self, q: FloatArray, v: FloatArray) -> float:
        """Kinetic energy v^T M v / 2 (J), rotors on the joints (armature) included."""
        # computeKineticEnergy of Pinocchio contains the armature of some joint types only.
        return 0.5 * float(v @ pin.crba(self.model, self.data, q) @ v)

    def energy(self, state: FloatArray) -> float:
        """Kinetic plus potential energy (J), of gravity and springs."""
        q, v = self.split(state)
        energy = self.kinetic_energy(q, v)
        energy += float(pin.computePotentialEnergy(self.model, self.data, q))
        return energy if self._forces is None else energy + self._forces.energy(self.data, q)


_WORLD = pin.Convention.WORLD
FRICTION_PART = 0.01
"""Part of a rate, beside the friction speed, by which stiff steps may err where friction acts: a
tolerance far above that speed never lets a joint come to rest."""
DEPENDENT_DRIVE = 1e-10
"""Part of a drive's motion without those of others below which it is one of theirs."""
_OVERFLOW = 1e100
"""Sum of |x_i| of a state above which products of its rates may overflow."""


class OpenSystem(Mechanics):
    """A mechanism without effective closures: plain ``aba``."""

    has_constraints = False
    factorisations = 0
    singularities = None
    branch_system = None

    def __init__(self, mechanism: Mechanism, controller: Controller | None = None) -> None:
        super().__init__(mechanism, controller)
        self._terms = OpenTerms(self.nv)

    def constraint_residual(self, t: float, state: FloatArray) -> float:
        """0: there is no closure."""
        return 0.0

    def largest_residuals(self, state: FloatArray, t: float) -> tuple[float, float]:
        """Zeros: there is no closure."""
        return 0.0, 0.0

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Terms:
        """v' = aba(q, v, tau); see :class:`~srm_mbs.dynamics.system.System`."""
        self.evaluations += 1
        q, v = state[: self.nq], state[self.nq :]
        force = self._forces_at(t, state)
        rate = self._terms.rate()
        rate[: self.nv] = v
        rate[self.nv :] = pin.aba(self.model, self.data, q, v, force)
        if not blas.dasum(rate) < np.inf:
            raise EvaluationError("the acceleration is not finite")
        return self._terms

    def impulse_response(self, q: FloatArray, n: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As :meth:`ClosedSystem.impulse_response`, without closures."""
        U = cholesky(pin.crba(self.model, self.data, q, _WORLD))
        along = unwhiten(U, whiten(U, n))
        return along, along

    def derivatives(
        self, state: FloatArray, accelerations: FloatArray
    ) -> AccelerationDerivatives | None:
        """See :class:`~srm_mbs.dynamics.system.System`."""
        return self._tree_derivatives(state, accelerations, np.zeros((self.nv, 0)))


@per_model
def _graph_order(mechanism: Mechanism) -> tuple[int, ...]:
    """The rows in use along the graph of the loops; () for few coordinates."""
    return graph_order(rows_in_use(mechanism).pattern(), coordinate_tree(mechanism)[0])


@per_start
def _residual_scale(mechanism: Mechanism) -> FloatArray:
    """Factor (m,) from each scaled row in use to row units."""
    structure = mechanism.structure
    unit = constraint_units(mechanism, structure.units)
    return (structure.row_scale / unit)[structure.kept]


class ClosedSystem(Mechanics):
    """A mechanism with closures.  Each Pinocchio algorithm is called once per evaluation."""

    has_constraints = True

    def __init__(self, mechanism: Mechanism, controller: Controller | None = None) -> None:
        super().__init__(mechanism, controller)
        self.structure = structure = mechanism.structure
        self.driven = bool(mechanism.drives)
        self.residual_scale = _residual_scale(mechanism)
        self._order = _graph_order(mechanism)
        self.sigma_scatters = bool(self._order)
        self.projection = Projection(structure.rank, structure.sigma_ref, self._order)

    @cached_property
    def loops(self) -> DrivenKinematics:
        """The rows of closures and drives that are in use, with memory of their own."""
        rows, trees = self._followed_rows(), self._trees
        return rows if trees is None else rows.count_from(trees.bases)

    def _followed_rows(self) -> DrivenKinematics:
        curves = self.mechanism.drive_curves
        return rows_in_use(self.mechanism).copy_workspace().follow(curves)

    @cached_property
    def _trees(self) -> Trees | None:
        # Rows of coordinates alone have no places.
        return trees_of(self.model) if rows_in_use(self.mechanism).anchors() else None

    @cached_property
    def _of_closures(self) -> tuple[pin.Model, pin.Data]:
        """Model and workspace of the closures; forces of elements have places in the world."""
        trees = self._trees
        return (self.model, self.data) if trees is None else (trees.model, workspace(self.model))

    @cached_property
    def _terms(self) -> ClosedTerms:
        return ClosedTerms(self)

    @cached_property
    def _mass_matrix(self) -> FloatArray:
        """View (nv, nv) of what crba writes: finding it takes as long as a solve."""
        return self._of_closures[1].M  # type: ignore[no-any-return]

    @cached_property
    def _joined(self) -> ForceKinematics | None:
        forces = self._forces
        if forces is None or not forces.has_laws:
            return None
        count = len(self._law_coordinates) + forces.law_count
        return forces if count > self.nv - self.structure.rank else None

    @property
    def laws(self) -> FloatArray:
        """As for open mechanisms; but more laws than degrees of freedom are one, because closures
        may take up forces far larger than those that move the mechanism: M (1 - P) M^-1 times
        their generalised forces (nv,), which is what closures leave of them."""
        force = self._joined_force()
        return super().laws if force is None else self.projection.tangential_force(force)

    def _joined_force(self) -> FloatArray | None:
        if self._joined is None:
            return None
        q, v = self._laws_at
        force = self.damping_force(v) + self.friction_force(v)
        return force + self._joined.of_laws(self.data, q, v, self._bushings)

    def joined_laws(self) -> tuple[FloatArray, FloatArray] | None:
        """See :class:`~srm_mbs.dynamics.system.BranchSystem`."""
        force = self._joined_force()
        return None if force is None else (force, self.projection.acceleration_by(force))

    def constants(self) -> dict[str, Any]:
        """As for open mechanisms, and the closures."""
        own = super().constants()
        if not self.mechanism.drives:
            return own
        return own | {"drives": self._followed_rows().drive_constants()}

    def constants_of_model(self) -> dict[str, Any]:
        """As for open mechanisms, and the rows of the closures."""
        rows = rows_in_use(self.mechanism)  # of the reference the system has a workspace of its own
        own = {
            "rows": len(rows.g),
            "structural_rank": self.structure.rank,
            "sigma_ref": self.structure.sigma_ref,
            "order": list(self._order),
        }
        return super().constants_of_model() | rows.constants() | own

    @property
    def origins(self) -> Sequence[Sequence[float]]:
        """Those of the anchors of the rows in use."""
        return rows_in_use(self.mechanism).origins

    def count(self, evaluations: int, factorisations: int) -> None:
        """Add the work of the compiled kernel for this system to the counters."""
        super().count(evaluations, factorisations)
        self.projection.factorisations += factorisations

    def restart(self) -> None:
        """Begin another run: the counters are zero."""
        super().restart()
        self.projection.factorisations = 0

    # Of the system, because it refers to the mechanism: kept there, each would keep the other.
    @cached_property
    def singularities(self) -> SingularityAnalysis:
        """Data for the analysis of singular configurations."""
        units = self.structure.units
        return SingularityAnalysis(
            self.mechanism.q0,
            self.structure.rank,
            self.structure.sigma_ref,
            units.coordinate,
            units.rate,
            partial(geometry_of, self.mechanism),
            self.driven,
        )

    @property
    def branch_system(self) -> BranchSystem:
        """The system itself."""
        return self

    @property
    def factorisations(self) -> int:
        """How often the constraint algebra was factorised."""
        return self.projection.factorisations

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> ClosedTerms:
        """Factorise M and G at ``state``; see :class:`~srm_mbs.dynamics.system.System`.

        crba in the WORLD convention leaves placements and the world Jacobian in ``data``,
        nonLinearEffects the velocities and bias accelerations: the closures need no further call.
        """
        self.evaluations += 1
        # First, because LAPACK may factorise numbers that are not finite without reporting it.
        if not blas.dasum(state) < _OVERFLOW:
            raise EvaluationError("the state is not finite, or overflows")
        t = min(max(t, self._first), self._last)
        (model, data), nq = self._of_closures, self.nq
        q, v = state[:nq], state[nq:]
        pin.crba(model, data, q, _WORLD)
        f = -pin.nonLinearEffects(model, data, q, v)
        if self._is_loaded or self._applied is not None:
            f += self.applied_force(t, q, v)
        if self._forces is not None:
            if data is not self.data:
                pin.forwardKinematics(self.model, self.data, q, v)
                pin.computeJointJacobians(self.model, self.data)
            f += self._element_force(self._forces, t, q, v)
        self._laws_at = q, v
        loops = self.loops
        loops.update(data, q, v)
        if self.driven:
            loops.move_to(t)
        projection = self.projection
        threshold = None if zone is None else zone.threshold
        projection.factor(self._mass_matrix, loops.G, f, loops.bias, threshold)
        predicted = None
        if projection.rank_deficient and zone is not None:
            predicted = zone.predict(t)
            if predicted is None:
                missing = projection.structural_rank - projection.rank
                if zone.normals is None or zone.normals.shape[1] < missing:
                    raise EvaluationError(
                        "the motion stays next to a singular configuration with too little "
                        "momentum to tell its branch"
                        if not self.mechanism.drives
                        else "the drives keep the motion next to a singular configuration, or "
                        "lead to one that it cannot pass"
                    )
                projection.hold(zone.normals)
        terms = self._terms
        terms.v, terms.predicted = v, predicted
        terms.white_multiplier = projection.white_multiplier
        if predicted is not None:
            terms.white_multiplier = projection.completed(terms.white_multiplier, predicted)
        return terms

    def impulse_response(self, q: FloatArray, n: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Changes of the velocities at q (nq,) by an impulse n (nv,): M^-1 n without the closures,
        and (1 - P) M^-1 n with their impulses.

        Raises
        ------
        EvaluationError
            As :meth:`evaluate`.
        """
        loops, p = self.loops, self.projection
        loops.evaluate(*self._of_closures, q)
        p.factor(self._mass_matrix, loops.G, n, np.zeros(len(loops.g)), None)
        white = p.white_force
        return p.unwhiten(white), p.unwhiten(white - p.Q @ (p.Q.T @ white))

    def derivatives(
        self, state: FloatArray, accelerations: FloatArray
    ) -> AccelerationDerivatives | None:
        """See :class:`~srm_mbs.dynamics.system.System`: of linear closures of joint coordinates,
        whose G is constant."""
        p = self.projection
        if not self.loops.is_constant or self._joined is not None or p.rank_deficient:
            return None
        return self._tree_derivatives(state, accelerations, p.normals())

    def constraint_residual(self, t: float, state: FloatArray) -> float:
        """max |g| over row units; see :class:`~srm_mbs.dynamics.system.System`."""
        g, _ = self.residuals(state, t)
        return float(np.max(np.abs(g) * self.residual_scale))

    def residuals(self, state: FloatArray, t: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Scaled g - s (m,) and G v - s' (m,) of the kept rows at the time t (s)."""
        q, v = self.split(state)
        rows = self.loops
        rows.evaluate(*self._of_closures, q)
        rows.move_to(t)
        return rows.g.copy(), rows.G @ v - rows.target_rate

    def largest_residuals(self, state: FloatArray, t: float) -> tuple[float, float]:
        """The largest of :meth:`residuals`, and of their rates."""
        g, c = (float(np.abs(part).max()) for part in self.residuals(state, t))
        return g, c


def make_system(
    mechanism: Mechanism, controller: Controller | None = None
) -> OpenSystem | ClosedSystem:
    """The cheapest system that is right for ``mechanism``."""
    if mechanism.structure.rank == 0:
        return OpenSystem(mechanism, controller)
    return ClosedSystem(mechanism, controller)
