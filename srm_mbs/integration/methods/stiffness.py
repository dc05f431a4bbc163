r"""Whether a problem is stiff: seen from its explicit steps, and from its linearised equations.

The last two stages of an explicit step, the end point among them, lie at the same time.  In a
stiff problem their arguments differ along the fastest mode, by (dq, dv), and their rates by
(dv, da).  With lambda the eigenvalue of the mode, |da| = |lambda| |dv| = |lambda|^2 |dq|.  Both
ratios have to show it: a vibration that steps follow has every ratio |da| / |dv|, depending on its
phase.
Counted are steps with h |lambda| next to the bound of stability and beyond (E. Hairer, G. Wanner,
*Solving Ordinary Differential Equations II*, 2nd edition, Springer 1996, IV.2).
"""

from __future__ import annotations

import math

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState
from srm_mbs.integration.methods.butcher import ButcherTableau

STIFF_STEPS = 15
"""Steps that show that a problem is stiff, or that it no longer is."""
OTHER_STEPS = 6
"""Steps in a row that show no stiffness, after which those before count no more."""
DEAR_STEPS = 2
"""Least of them that show that linearly implicit steps are too dear, after those that they take to
grow: they double at least, up to the length from which they pay."""
NOT_STIFF = 2.0
"""h |lambda| of a linearly implicit step, over its cost, up to which an explicit one would do: it
is stable for three times as long a step."""
UNRESOLVED = 2.0
"""Change of a rate over a step, in friction speeds, from which its stages miss the change of the
friction."""
REVERSAL_SHARE = 0.1
"""Error of a quadrature with some ten nodes across a jump, over the step times the jump."""
SHORTEST = 1e-300
"""Step (s) that is taken for shorter ones, whose inverse overflows: a run may last one rounding."""
POWER_ITERATIONS = 6
"""Products with the linearised equations that estimate their largest eigenvalue."""


def stiffness_of(system: System, h: float, difference: FloatArray, change: FloatArray) -> float:
    """h |lambda| from the ``difference`` (n,) of two arguments at the same time and the ``change``
    (n,) of their rates; NaN where they do not differ."""
    k = system.multiplier_part.start
    size = system.position_norm
    if not k:
        apart = size(difference)
        return h * size(change) / apart if apart > 0.0 else math.nan
    dq, dv, da = size(difference[:k]), size(difference[k:]), size(change[k:])
    if not (dq > 0.0 and dv > 0.0):
        return math.nan
    return h * min(da / dv, math.sqrt(da / dq))


def chatters(
    h: float, v: FloatArray, accelerations: FloatArray, weights: FloatArray, sums: FloatArray
) -> bool:
    """Whether the derivative of a rate with friction varies over a step of ``h`` (s) by more than
    what would stop it within the step, and by more than the tolerance: stages take its sign at
    random.

    Parameters
    ----------
    v : (2, k), accelerations : (j, k)
        Rates at the ends of the step, and their derivatives at its stages.
    weights : (k,)
        Tolerances of the rates.
    sums : (n, k)
        The rates that have friction, as sums of v.
    """
    change = h * np.ptp(accelerations @ sums.T, axis=0)
    sizes = np.maximum(np.abs(v @ sums.T).max(axis=0), np.abs(sums) @ weights)
    return bool((change > sizes).any())


def reversal_error(
    h: float, rates: FloatArray, accelerations: FloatArray, sums: FloatArray, speed: float
) -> FloatArray:
    """Errors (k,) of the rates of coordinates on which friction acts that changes its sign within a
    step of ``h`` (s) whose stages do not resolve that; 0 for others.

    The acceleration then jumps within the step, and an embedded pair, which takes it for smooth,
    finds the error of that by chance only.

    Parameters
    ----------
    rates, accelerations : (2, k)
        At the ends of the step.
    sums : (n, k)
        The rates that have friction, as sums of those.
    speed
        Rate within which the friction changes its sign.
    """
    before, after = sums @ rates[0], sums @ rates[1]
    turned = (before * after < 0.0) & (np.abs(after - before) > UNRESOLVED * speed)
    jump = np.abs(accelerations[1] - accelerations[0])
    return np.where((sums[turned] != 0.0).any(axis=0), REVERSAL_SHARE * h * jump, 0.0)


def stopping_tolerance(norm: ErrorNorm) -> FloatArray:
    """Largest tolerances (n,) of coordinates on which friction acts: those of the unit.

    Friction F stops a mass m of the rate v after the distance m v^2 / (2 F), which errs by m v / F
    times the error of v: a tolerance that grew with v would err the more, the faster it was.
    """
    unit = norm.one if norm.unit is None else norm.unit
    return np.maximum(norm.atol, norm.rtol * unit)


def count_stiffness(
    memory: IntegratorState, stiffness: float, cost: float, scheme: ButcherTableau
) -> None:
    """Take an accepted step of ``scheme`` with that ``stiffness`` and ``cost`` into account.

    Linearly implicit steps end where they do not pay: where the problem is not stiff, or where
    differences make them dear, and the tolerance does not allow steps as long as that.  An explicit
    step is at the bound of its stability then, and would count as stiff at once, so that after each
    try that did not pay twice as many such steps are needed for the next.
    """
    if scheme.implicit is None:
        if memory.stiff or scheme.stable_to is None:
            return
        if stiffness > scheme.stable_to:
            memory.stiff_steps += 1
            memory.other_steps = 0
        elif memory.stiff_steps:
            memory.other_steps += 1
            if memory.other_steps == OTHER_STEPS:
                memory.stiff_steps = memory.other_steps = 0
        if memory.stiff_steps >= max(memory.needed_steps, STIFF_STEPS):
            memory.stiff, memory.stiff_steps, memory.other_steps = True, 0, 0
            memory.saved_steps = 0.0
    elif memory.stiff:
        share = stiffness / (NOT_STIFF * cost)
        memory.saved_steps += share - 1.0
        memory.stiff_steps = memory.stiff_steps + 1 if share < 1.0 else 0
        if memory.stiff_steps >= max(DEAR_STEPS + math.log2(cost), STIFF_STEPS / cost):
            memory.stiff, memory.stiff_steps = False, 0
            paid = memory.saved_steps > 0.0 or stiffness < NOT_STIFF
            memory.needed_steps = STIFF_STEPS if paid else 2 * max(memory.needed_steps, STIFF_STEPS)


def largest_eigenvalue(J: FloatArray, h: float, unit: FloatArray, k: int) -> float:
    """Estimate of h |lambda| for the largest eigenvalue lambda of ``J`` (n, n).

    Parameters
    ----------
    unit : (n,)
        Units of the components.
    k
        Number of positions among them: rates are measured in units of positions over ``h``.
    """
    h = max(h, SHORTEST)
    scale = np.concatenate([unit[:k], unit[:k] / h]) if k else unit
    x = scale * np.where(np.arange(len(unit)) % 2, -1.0, 1.0)
    last = 1.0
    for iteration in range(POWER_ITERATIONS):
        if iteration == POWER_ITERATIONS - 2:
            last = float(np.abs(x / scale).max())
            if not last > 0.0:
                return 0.0
            x, last = x / last, 1.0
        x = h * (J @ x)
    return math.sqrt(float(np.abs(x / scale).max()))
