"""The contract between a system and the time stepping.

A *state* is one flat array; a mechanism uses x = (q, v) of length nq + nv.  A *tangent* is an
array of the size of the system's tangent space; a mechanism uses (dq, dv) of length 2 nv with
dq in the Lie algebra of the configuration manifold.  Stepping is written once against this
contract and never looks inside a state.

The state on the closures that is nearest to a given one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from srm_mbs._typing import FloatArray
from srm_mbs.errors import EvaluationError


@dataclass(frozen=True)
class Zone:
    """What a stage needs to know when it falls next to a singular configuration.

    Attributes
    ----------
    threshold
        sigma_z: pivots below ``threshold`` (relative to the structural reference) are dropped.
    predict
        t -> (nv,), the multiplier yhat extrapolated from nodes outside the zone; None at times
        that the nodes say nothing about.
    normals : (nv, k) or None
        M-orthonormal normals of the closures at the last node, the weakest last.  A motion that
        lingers, with too little momentum to pass, is held tangential to them.
    """

    threshold: float
    predict: Callable[[float], FloatArray | None]
    normals: FloatArray | None = None


class Terms(Protocol):
    """Answers about one evaluated stage, each at its own cost.

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
        """Whether the normals of the zone took the place of the dropped rows."""

    def normals(self) -> FloatArray:
        """M-orthonormal normals of the closures (nv, rank), the weakest last; (nv, 0) where the
        motion has a part along them, with drives: it cannot be held tangential then."""

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
        """The exact multiplier in the form that sweeps carry: yhat, or y of some DAEs."""

    def sweep(self, previous: FloatArray, eps: float) -> tuple[FloatArray, FloatArray]:
        """Tangent rate and new multiplier of one SRM sweep, given the ``previous`` sweep's.

        Mechanisms, (2.6): (v - E g/eps, M^-1 f - yhat_s), yhat_s = P (yhat_{s-1} + v/eps), with
        drives P yhat_{s-1} + E (G v - s')/eps.
        DAEs, (2.2): (f - B y_s,), y_s = y_{s-1} + T g/eps, or (2.4), which carries B y.
        """


class System(Protocol):
    """What both a mechanism and a DAE offer to the stepping."""

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
        """Whether ``end`` is within the chart at ``start``, and what is one step further cannot
        seem to be."""

    def chart_rate(self, delta: FloatArray, rate: FloatArray) -> FloatArray:
        """Rate of the chart coordinate ``delta`` for the tangent rate at retract(state, delta)."""

    def rate_change(self, delta: FloatArray) -> FloatArray:
        """Change of the tangent rate that follows from moving the state by ``delta`` alone, the
        accelerations kept: (dv, 0) for a mechanism, whose q' is v."""

    def position_norm(self, delta: FloatArray) -> float:
        """Largest motion of the positions in ``delta``, in units (rad, scene diagonals)."""

    def state_scale(self, state: FloatArray) -> FloatArray:
        """|x_i| of the error weights, per tangent component."""

    def constraint_residual(self, t: float, state: FloatArray) -> float:
        """Largest closure error at ``state``, in row units (scene diagonals, rad); 0 if open."""

    def step_limit(self, state: FloatArray) -> float:
        """Largest step for which the chart stays well inside its domain (s)."""


ROUNDS = 30
CLOSED = 1e-13
"""Motion (units) of a correction from which the closures are satisfied to rounding."""


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
    for _ in range(ROUNDS):
        correction = system.evaluate(t, state).correction()
        state = system.retract(state, -correction)
        if system.position_norm(correction) < CLOSED:
            return state
    raise EvaluationError("no configuration that closes the loops was found near the one given")
