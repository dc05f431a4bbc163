"""The contract between a system and the time integration.

A *state* is one flat array; a mechanism uses x = (q, v) of length nq + nv.  A *tangent* is an
array of the size of the system's tangent space; a mechanism uses (dq, dv) of length 2 nv with
dq in the Lie algebra of the configuration manifold.  Integration is written once against this
contract.  It looks inside a state only where a system offers :attr:`System.singularities` and
:attr:`System.branch_system`, the optional capabilities of mechanisms with closures.

:func:`onto_closures` moves a state of any system onto its closures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.errors import EvaluationError


@dataclass(frozen=True)
class Zone:
    """How a stage next to a singular configuration is evaluated.

    Attributes
    ----------
    threshold
        sigma_z: pivots below ``threshold`` (relative to the structural reference) are dropped.
    predict
        t -> (nv,), the multiplier yhat extrapolated from nodes outside the zone; None at times
        too far from the nodes.
    normals : (nv, k) or None
        M-orthonormal normals of the closures at the last node, the weakest last.  A motion that
        lingers, with too little momentum to pass, is held tangential to them.
    predicts
        False where the multiplier of the dropped rows is zero at all times.
    """

    threshold: float
    predict: Callable[[float], FloatArray | None]
    normals: FloatArray | None = None
    predicts: bool = True

    @classmethod
    def without_prediction(cls, threshold: float, nv: int) -> Zone:
        """The zone whose dropped rows have no multiplier."""
        nothing = np.zeros(nv)
        return cls(threshold, lambda _: nothing, predicts=False)


class Terms(Protocol):
    """The quantities of one evaluated stage, each computed when it is asked for.

    Arrays are valid until the system's next ``evaluate``.
    """

    @property
    def sigma(self) -> float:
        """Distance to a singular configuration; about 1 in a regular one, ``inf`` if open."""

    @property
    def rank(self) -> int:
        """Number of independent closure rows in use at this stage."""

    @property
    def rank_deficient(self) -> bool:
        """Whether rows were dropped at this stage, whose part of the multiplier is predicted."""

    @property
    def held(self) -> bool:
        """Whether the normals of the zone replace the dropped rows."""

    def normals(self) -> FloatArray:
        """M-orthonormal normals (nv, k) of the weakest closures, that of the weakest last; (nv, 0)
        with drives, which move the mechanism along them: it cannot be held tangential then."""

    def rate(self) -> FloatArray:
        """Tangent rate (2 nv,): (v, M^-1 f - yhat)."""

    def multiplier(self) -> FloatArray:
        """The multiplier yhat = M^-1 G^T lam = E gamma (nv,)."""

    def project(self, w: FloatArray) -> FloatArray:
        """P w (nv,): the M-orthogonal projection of w on the constraint normals."""

    def constraint_residual(self) -> float:
        """Largest |g|, of all rows, in row units; 0 where there are none."""

    def correction(self) -> FloatArray:
        """(E g, E c) (2 nv,): what to subtract from the state to satisfy g = 0 and c = 0.

        With drives g is g - s(t), and c = G v - s'(t).
        """

    def prediction(self) -> FloatArray:
        """The exact multiplier in the form that sweeps carry: yhat, or y of DAEs with T = I or
        (GB)^T."""

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        """Tangent rate and new multiplier of one SRM sweep, given the ``previous`` sweep's.

        Mechanisms, (2.6): (v - E g/eps, M^-1 f - yhat_s), yhat_s = P (yhat_{s-1} + v/eps), with
        drives P yhat_{s-1} + E (G v - s')/eps.
        DAEs, (2.2): (f - B y_s,), y_s = y_{s-1} + T g/eps, or (2.4), which carries B y.
        """


@dataclass(frozen=True, eq=False)
class SingularityAnalysis:
    """The closures of a mechanism as equations, from which singular configurations are found.

    A state of such a system is x = (q, v), a tangent (dq, dv).

    Attributes
    ----------
    q0 : (nq,)
        Configuration at which the mechanism starts.
    rank
        Structural rank of the rows of closures and drives.
    sigma_reference
        Usual size of the last structural pivot, by which sigma is divided.
    coordinate_unit : (nv,)
        1 rad for angles, the scene diagonal (m) for translations.
    rate_unit
        Characteristic rate (1/s).
    geometry
        (q (nq,), t (s) or None, the default) -> the closure equations with units measured at q,
        and the laws of the drives as they are at t
        (:func:`~srm_mbs.dynamics.constraints.geometry.geometry_of`).
    driven
        Whether there are drives.
    """

    q0: FloatArray
    rank: int
    sigma_reference: float
    coordinate_unit: FloatArray
    rate_unit: float
    geometry: Callable[..., ClosureGeometry]
    driven: bool

    def split(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Views (q, v) of a state (nx,), or of states (n, nx)."""
        nq = len(self.q0)
        return state[..., :nq], state[..., nq:]


@dataclass(frozen=True, eq=False)
class AccelerationDerivatives:
    """Derivatives of the accelerations (k,) at a stage.

    Attributes
    ----------
    by_forces : (k, k)
        By the forces.
    by_positions, by_velocities : (k, k)
        By the chart coordinates at the stage, while the forces are held.
    forces
        (t (s), state (nx,)) -> (k,), all forces but those of inertia, gravity and closures; as an
        evaluation, it finds :attr:`System.laws`.
    """

    by_forces: FloatArray
    by_positions: FloatArray
    by_velocities: FloatArray
    forces: Callable[[float, FloatArray], FloatArray]


class System(Protocol):
    """The equations of a mechanism, or of a DAE, as time integration evaluates them."""

    has_constraints: bool
    tangent_size: int
    evaluations: int
    multiplier_part: slice
    """Where the multiplier yhat acts in a tangent: (nv, 2 nv) for a mechanism."""
    multiplier_size: int
    """Length of what sweeps carry: nv for a mechanism; nx or ny for a DAE."""
    carries_yhat: bool
    """Whether sweeps carry yhat, which the zone replaces next to a singular configuration."""
    predicts: bool
    """Whether the exact multiplier is known: False for a DAE whose g_t is needed and not given."""
    time_unit: str
    """Unit of times in messages after a space, " s"; empty for a DAE, whose t may be anything."""
    sigma_scatters: bool
    """Whether sigma jumps when other pivots are taken, along the graph of many loops."""

    @property
    def wraps(self) -> bool:
        """Whether angles count no turns, so that :meth:`difference` asks for a tangent near by."""

    @property
    def time_dependent(self) -> bool:
        """Whether rates may depend on time itself."""

    @property
    def laws(self) -> FloatArray:
        """Values (m,) of the laws of forces at the stage evaluated last, as
        :meth:`apply_laws` counts them."""

    @property
    def friction_sums(self) -> FloatArray:
        """The rates on which friction acts, sums of v with coefficients (n, k)."""

    @property
    def friction_speed(self) -> float:
        """Change of such a rate over which friction changes its sign."""

    def friction_tolerance(self, v: FloatArray) -> FloatArray:
        """Errors (n,) of a tangent from which the friction at the rates ``v`` (k,) is another;
        infinite where there is none."""

    def apply_laws(self, values: FloatArray | None) -> None:
        """Let ``values`` (m,) act in evaluations in place of the laws of forces that damp or store
        energy; None for the laws themselves."""

    def derivatives(
        self, state: FloatArray, accelerations: FloatArray
    ) -> AccelerationDerivatives | None:
        """Derivatives at the ``state`` (nx,) evaluated last, with the ``accelerations`` (k,) there;
        None if only differences give them.  Other terms of the stage are lost."""

    @property
    def singularities(self) -> SingularityAnalysis | None:
        """Data for the analysis of singular configurations; None without closures, and for DAEs,
        whose equations are known at single points only."""

    @property
    def branch_system(self) -> BranchSystem | None:
        """The system itself, where stages can be solved on their branch; None without closures, and
        for DAEs."""

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Terms:
        """Factorise at one stage.

        Raises
        ------
        EvaluationError
            If the state is not finite or the mass matrix is not positive definite.
        """

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """Move along the tangent ``delta`` from ``state``; a new state."""

    def difference(
        self, start: FloatArray, end: FloatArray, near: FloatArray | None = None
    ) -> FloatArray:
        """The tangent that moves ``start`` to ``end``: the inverse of :meth:`retract`.

        Angles that count no turns take the shortest way, or the turn nearest to that of the tangent
        ``near``.
        """

    def reachable(self, start: FloatArray, end: FloatArray) -> bool:
        """Whether ``end`` lies within the chart at ``start`` with a margin: no point one step
        further can seem to lie in it."""

    def chart_rate(self, delta: FloatArray, rate: FloatArray) -> FloatArray:
        """Rate of the chart coordinate ``delta`` for the tangent rate at retract(state, delta)."""

    def rate_change(self, delta: FloatArray) -> FloatArray:
        """Change of the tangent rate that follows from moving the state by ``delta`` alone, the
        accelerations kept: (dv, 0) for a mechanism, whose q' is v."""

    def position_norm(self, delta: FloatArray) -> float:
        """Largest motion of the positions in ``delta``, in units (rad, scene diagonals)."""

    def position_rounding(self, state: FloatArray) -> float:
        """Largest distance of a position from the next floating-point number, in units."""

    def state_scale(self, state: FloatArray) -> FloatArray:
        """|x_i| of the error weights, per tangent component."""

    def constraint_residual(self, t: float, state: FloatArray) -> float:
        """Largest closure error at ``state``, in row units (scene diagonals, rad); 0 if open."""

    def step_limit(self, state: FloatArray) -> float:
        """Largest step for which the chart stays well inside its domain (s)."""

    def rescale(self, t: float, state: FloatArray) -> bool:
        """Adapt sizes to which sigma is relative to ``state`` at ``t`` (s), from where a step
        begins; whether they changed, so that the first stage is to be evaluated again."""

    def begin_step(self, t: float, state: FloatArray) -> None:
        """Begin a step from ``state`` at ``t`` (s): forces that jump somewhere go on smoothly up
        to its end."""

    def end_step(self) -> None:
        """End the step begun last: forces are those at a state alone."""

    def past_jump(self, t: float, state: FloatArray) -> float:
        """Time (s) by which a step to ``state`` at ``t`` (s) passed a jump of forces, estimated
        there: 0 up to rounding, negative before it, infinite without an estimate."""


class BranchTerms(Terms, Protocol):
    """The quantities of one evaluated stage from which branches of closed configurations are
    computed next to a singular configuration."""

    def free_acceleration(self) -> FloatArray:
        """M^-1 f (nv,)."""

    def momentum(self, v: FloatArray) -> FloatArray:
        """M v (nv,)."""

    def multiplier_of(self, a: FloatArray) -> FloatArray:
        """E (G a + Gdot v - s'') (nv,) of the free acceleration ``a`` (nv,)."""

    def driven_residuals(self) -> FloatArray:
        """g - s of the rows of the drives."""

    def closing(self, allowed: FloatArray) -> FloatArray:
        """E g (nv,), without ``allowed`` of the rows of the drives."""

    def branch_tangents(self) -> tuple[FloatArray, FloatArray]:
        """M-orthonormal velocities (nv, k) that satisfy the closures, whatever the drives, and the
        rates (d, k) of the drives along them."""


class BranchSystem(System, Protocol):
    """A mechanism with closures, whose stages next to a singular configuration are solved on their
    branch of the closed configurations."""

    nv: int

    @property
    def singularities(self) -> SingularityAnalysis:
        """Data for the analysis of singular configurations."""

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> BranchTerms:
        """As :meth:`System.evaluate`."""

    def joined_laws(self) -> tuple[FloatArray, FloatArray] | None:
        """At the stage evaluated last, the forces F (nv,) of laws of which the system takes what
        closures leave, and M^-1 F; None if it takes them as they are."""

    def working_force(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """Generalised forces (nv,) that do work: all but those of inertia and of closures."""

    def inertial_force(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """-C(q, v) v (nv,): Coriolis and centrifugal forces."""


MAX_NEWTON_STEPS = 30
CLOSURE_TOLERANCE = 1e-13
"""Largest motion (rad, scene diagonals) of the last Newton step: the closures are then satisfied to
rounding."""
ROUNDED_MOTION = 16.0
"""Largest motion of Newton steps that are rounding of the positions, over that."""


def onto_closures(system: System, t: float, state: FloatArray) -> FloatArray:
    """``state`` moved along the normals of the closures onto them: positions by Newton's method,
    velocities by the M-orthogonal projection v - P v.

    The projected velocity is that after an inelastic impact: constraint impulses G^T lam change
    M v, and nothing else does.

    Raises
    ------
    EvaluationError
        If a configuration on the way cannot be evaluated, or none is found.
    """
    if not system.has_constraints:
        return state
    before = np.inf
    for _ in range(MAX_NEWTON_STEPS):
        terms = system.evaluate(t, state)
        closed = terms.constraint_residual() < CLOSURE_TOLERANCE
        correction = terms.correction()
        state = system.retract(state, -correction)
        size = system.position_norm(correction)
        if size < CLOSURE_TOLERANCE:
            return state
        # Next to a singular configuration steps end at the rounding of the closures over sigma,
        # after thousands of turns at that of the angles.
        if size >= before and (closed or size < ROUNDED_MOTION * system.position_rounding(state)):
            return state
        before = size
    raise EvaluationError("no configuration that closes the loops was found near the one given")
