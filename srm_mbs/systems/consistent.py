"""The state on the closures that is nearest to a given one."""

from __future__ import annotations

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.systems.base import System

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
        if system.size(correction) < CLOSED:
            return state
    raise EvaluationError("no configuration that closes the loops was found near the one given")
