r"""Stages next to a singular configuration, evaluated on the branch of the motion.

A stage lies off the closure manifold by its own error (dq, dv).  At a distance phi from a
singular configuration that error turns the null space of G by dq / phi, and the acceleration by

    (2 s dv + s^2 dq),   s = |d sigma / dt| / sigma,

which does not shrink with the step where the step crosses the singular configuration: phi is a
fraction of the step there, and the crossing falls to the order of its stages.  Evaluated at its
projection on the manifold (Newton steps with the factorisation of each evaluation) a stage sees
the smooth field on the branch, and the scheme keeps its order.
"""

from __future__ import annotations

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.methods.base import ErrorNorm
from srm_mbs.systems.base import System, Terms, Zone

NEAR = 3.0
"""Only stages with sigma below NEAR |d sigma / dt| h are looked at."""
PROJECTIONS = 4
"""Newton steps at most; the error squares each time."""
AMBIGUOUS = 0.1
"""A stage that lies off the branch by more than this fraction of sigma is evaluated where it is:
Newton might lead to another branch."""
ROUNDING = 16.0 * np.finfo(float).eps
"""Rounding of the positions, in units: below ROUNDING / sigma a correction is noise."""


def turning(system: System, error: FloatArray, reach: float, h: float) -> FloatArray:
    """Change (n,) of h times the tangent rate by the normal ``error`` (n,) of a stage.

    ``reach`` is h |d sigma / dt| / sigma, the step over the distance to the singular point.
    """
    part = system.multiplier_part
    out = np.zeros_like(error)
    out[part] = 2.0 * reach * np.abs(error[part])
    if part.start:
        out[part] += (reach * reach / h) * np.abs(error[: part.start])
    return out


def rounding_effect(
    system: System, size: FloatArray, sigma: float, sigma_change: float, h: float, projected: bool
) -> FloatArray:
    """What rounding at a stage with ``sigma`` does to h times the tangent rate (n,).

    Next to a singular configuration it may exceed the tolerance, and more so the shorter the step:
    an error estimate below it says nothing.  A projection knows positions to ROUNDING / sigma.

    Parameters
    ----------
    size : (n,)
        What counts as "one" for each tangent component.
    projected
        Whether the stage was projected.
    """
    turn = sigma_change / (h * sigma)
    error = (ROUNDING / sigma if projected else ROUNDING) * size
    part = system.multiplier_part
    if part.start:
        error[part] = turn * error[: part.start]
    return turning(system, error, h * turn, h)


def on_branch(
    system: System,
    terms: Terms,
    t: float,
    x: FloatArray,
    zone: Zone | None,
    h: float,
    sigma_change: float,
    norm: ErrorNorm,
    weights: FloatArray,
) -> tuple[Terms, FloatArray, FloatArray | None]:
    """Terms at the projection of the stage ``x`` on its branch, the projected state, and what was
    subtracted.

    Returns ``terms``, ``x`` and None where projecting would change nothing that counts: less
    than ``norm.negligible`` of the tolerance, or than rounding.

    Parameters
    ----------
    terms
        As evaluated at ``x``, outside the zone.
    sigma_change
        |d sigma / dt| h.
    weights : (n,)
        Error weights of the step.
    """
    moved: FloatArray | None = None
    for _ in range(PROJECTIONS):
        sigma = terms.sigma
        if terms.weak or not sigma < NEAR * sigma_change:
            break
        error = terms.correction()
        if system.size(error) > AMBIGUOUS * sigma:
            break
        effect = norm(turning(system, error, sigma_change / sigma, h), weights)
        if effect <= norm.negligible:
            break
        noise = rounding_effect(system, norm.atol / norm.rtol, sigma, sigma_change, h, True)
        if effect <= norm(noise, weights):
            break
        moved = error if moved is None else moved + error
        x = system.retract(x, -error)
        terms = system.evaluate(t, x, zone)
    return terms, x, moved
