r"""Zeros of sigma, from its values at the stages of a step.

sigma is the modulus of a smooth quantity: at a passage it has a kink.  With the sign turned behind
it, the values follow a polynomial of low degree.
"""

from __future__ import annotations

import math

import numpy as np

from srm_mbs.arrays import FloatArray

AHEAD = 3.0
"""Zeros are looked for within this many steps."""


def misfit(basis: FloatArray, values: FloatArray) -> tuple[float, FloatArray]:
    """Norm of the residual of the least-squares fit of ``values``, and its coefficients."""
    coefficients = np.linalg.lstsq(basis, values, rcond=None)[0]
    return float(np.linalg.norm(basis @ coefficients - values)), np.asarray(
        coefficients, dtype=np.float64
    )


def real_roots(p0: float, p1: float, p2: float = 0.0) -> list[float]:
    """Real roots of p0 + p1 x + p2 x^2, ascending."""
    if p2 == 0.0:
        return [-p0 / p1] if p1 else []
    discriminant = p1 * p1 - 4.0 * p2 * p0
    if discriminant < 0.0:
        return []
    # Of the two forms of a root, the one that does not cancel.
    q = -0.5 * (p1 + math.copysign(math.sqrt(discriminant), p1))
    return sorted([q / p2, p0 / q]) if q else [0.0]


def zero_within(abscissae: FloatArray, sigmas: FloatArray) -> float | None:
    """Where in (0, 1 + a little] the step passes a zero of sigma; None if it does not.

    Parameters
    ----------
    abscissae, sigmas : (s + 1,)
        Fractions of the step, and sigma there.
    """
    order = np.argsort(abscissae, kind="stable")
    c, sigma = abscissae[order], sigmas[order]
    top = float(sigma.max())
    if not top > 0.0:
        return None
    degree = 2 if len(c) > 4 else 1
    basis = np.vander(c, degree + 1)
    best, zero = np.inf, None
    for k in range(1, len(c) + 1):
        after = float(c[k]) if k < len(c) else 1.1
        if after <= c[k - 1]:
            continue
        signed = np.where(np.arange(len(c)) < k, sigma, -sigma)
        error, coefficients = misfit(basis, signed)
        if not error < best:
            continue
        for root in real_roots(*coefficients[::-1].tolist()):
            if c[k - 1] - 0.02 <= root <= after + 0.02:
                best, zero = error, root
                break
    return zero


def zero_ahead(k: int, c: float, sigmas: FloatArray) -> float | None:
    """Where sigma will vanish, in steps from the start of the last one (> 1); None if it does not
    fall, or not within ``AHEAD`` steps.

    A parabola through the start, the stage ``k`` with the abscissa ``c``, and the end; a line if
    that has no zero ahead.
    """
    start, end = float(sigmas[0]), float(sigmas[-1])
    if not end < start:
        return None
    middle = float(sigmas[k])
    line = start / (start - end)
    zero = line
    if 0.1 < c < 0.9:
        # sigma = start + a x + b x^2 through (c, middle) and (1, end)
        b = ((middle - start) / c - (end - start)) / (c - 1.0)
        a = end - start - b
        root = a * a - 4.0 * b * start
        if root >= 0.0 and a < 0.0:
            zero = 2.0 * start / (-a + np.sqrt(root))
        elif a + 2.0 * b >= 0.0 or root < 0.0:
            return None if line > AHEAD else line
    return (
        float(zero)
        if 1.0 < zero < AHEAD
        else (line if 1.0 < line < AHEAD and zero <= 1.0 else None)
    )
