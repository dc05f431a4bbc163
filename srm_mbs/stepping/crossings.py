"""Singular passages of a run, found after the fact from the recorded sigmas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.stepping.dense import StepData

CLEARLY_BETTER = 0.2
"""A sign change must reduce the residual of the fit to less than this fraction."""
DEEP = 0.5
"""Only steps in which sigma falls below this fraction of its largest value are examined."""


@dataclass(frozen=True)
class Crossing:
    """A passage through a singular configuration.

    Attributes
    ----------
    time
        When sigma passed zero (s), from a fit to the stages of the step.
    sigma
        Smallest sigma of any evaluated stage of that step.
    rank
        Smallest number of closure rows in use in that step.
    """

    time: float
    sigma: float
    rank: int


def _zero_in_step(abscissae: FloatArray, sigmas: FloatArray) -> float | None:
    """Where in [0, 1] sigma changes sign, if a signed polynomial explains the |sigma| seen.

    sigma is the modulus of a smooth quantity, so that a passage is a kink: with the sign turned
    after it, a low-degree polynomial fits; without, it does not.
    """
    order = np.argsort(abscissae, kind="stable")
    c, sigma = abscissae[order], sigmas[order]
    top = float(sigma.max())
    if not (top > 0.0 and sigma.min() < DEEP * top):
        return None
    degree = 2 if len(c) > 4 else 1
    basis = np.vander(c, degree + 1)

    def residual(values: FloatArray) -> tuple[float, FloatArray]:
        coefficients = np.linalg.lstsq(basis, values, rcond=None)[0]
        misfit = np.linalg.norm(basis @ coefficients - values)
        return float(misfit), np.asarray(coefficients, dtype=np.float64)

    plain, _ = residual(sigma)
    best: tuple[float, float] | None = None
    for k in range(1, len(c)):
        if c[k] <= c[k - 1]:
            continue
        signed = np.where(np.arange(len(c)) < k, sigma, -sigma)
        error, coefficients = residual(signed)
        roots = np.roots(coefficients)
        inside = [
            float(root.real)
            for root in roots
            if abs(root.imag) < 1e-9 and c[k - 1] - 1e-9 <= root.real <= c[k] + 1e-9
        ]
        if inside and (best is None or error < best[0]):
            best = (error, inside[0])
    if best is None or not best[0] < CLEARLY_BETTER * plain + 1e-14 * top:
        return None
    return best[1]


def find_crossings(scheme: ButcherTableau, steps: StepData) -> tuple[Crossing, ...]:
    """All passages of a run, in order of time."""
    abscissae = np.append(scheme.c, 1.0)
    found: list[Crossing] = []
    for i in range(steps.count):
        sigmas = steps.sigmas[i]
        if not np.isfinite(sigmas).all():
            continue
        zero = _zero_in_step(abscissae, sigmas)
        if zero is None:
            continue
        h = steps.times[i + 1] - steps.times[i]
        time = float(steps.times[i] + zero * h)
        crossing = Crossing(time, float(sigmas.min()), int(steps.ranks[i]))
        # A zero on the boundary of two steps is seen by both.
        if found and time - found[-1].time < 0.05 * h:
            continue
        found.append(crossing)
    return tuple(found)
