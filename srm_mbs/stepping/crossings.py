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


def _misfit(basis: FloatArray, values: FloatArray) -> tuple[float, FloatArray]:
    """Norm of the residual of the least-squares fit of ``values``, and its coefficients."""
    coefficients = np.linalg.lstsq(basis, values, rcond=None)[0]
    return float(np.linalg.norm(basis @ coefficients - values)), np.asarray(
        coefficients, dtype=np.float64
    )


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

    plain, _ = _misfit(basis, sigma)
    best: tuple[float, float] | None = None
    for k in range(1, len(c)):
        if c[k] <= c[k - 1]:
            continue
        signed = np.where(np.arange(len(c)) < k, sigma, -sigma)
        error, coefficients = _misfit(basis, signed)
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


def _zero_among(t: FloatArray, sigma: FloatArray, low: int) -> float | None:
    """Time at which sigma changes sign next to its local minimum ``low``, from three samples on
    each side, whichever steps they belong to; None if no change of sign explains them."""
    best: tuple[float, float] | None = None
    for after in (low, low + 1):  # the zero lies before, or behind, the lowest sample
        here = slice(max(0, after - 3), min(len(t), after + 3))
        left = after - here.start
        if left < 2 or here.stop - after < 2:
            continue
        width = t[here.stop - 1] - t[here.start]
        x = (t[here] - t[after - 1]) / width
        signed = np.where(np.arange(len(x)) < left, sigma[here], -sigma[here])
        basis = np.vander(x, 3 if len(x) > 4 else 2)

        plain, _ = _misfit(basis, sigma[here])
        error, coefficients = _misfit(basis, signed)
        gap = x[left] - x[left - 1]
        inside = [
            float(root.real)
            for root in np.roots(coefficients)
            if abs(root.imag) < 1e-9 and -0.2 * gap <= root.real <= 1.2 * gap
        ]
        if inside and error < CLEARLY_BETTER * plain and (best is None or error < best[0]):
            best = (error, float(t[after - 1] + inside[0] * width))
    return None if best is None else best[1]


def _between_the_steps(
    abscissae: FloatArray, steps: StepData, found: list[Crossing]
) -> list[Crossing]:
    """Passages at minima of sigma that no single step explains: few stages, or a long step."""
    order = np.argsort(abscissae[1:], kind="stable") + 1
    h = np.diff(steps.times)
    t = (steps.times[:-1, None] + h[:, None] * abscissae[order]).ravel()
    sigma = steps.sigmas[:, order].ravel()
    step_of = np.repeat(np.arange(steps.count), len(order))
    fresh = np.concatenate([[True], np.diff(t) > 1e-9 * h[step_of[1:]]])
    t, sigma, step_of = t[fresh], sigma[fresh], step_of[fresh]
    known = np.array([crossing.time for crossing in found])
    more: list[Crossing] = []
    lowest = np.flatnonzero((sigma[1:-1] <= sigma[:-2]) & (sigma[1:-1] <= sigma[2:])) + 1
    for low in lowest:
        around = sigma[max(0, low - 6) : low + 7]
        h_here = h[step_of[low]]
        if not sigma[low] < DEEP * around.max():
            continue
        if known.size and np.abs(known - t[low]).min() < h_here:
            continue
        zero = _zero_among(t, sigma, int(low))
        if zero is not None and not (more and zero - more[-1].time < 0.05 * h_here):
            more.append(Crossing(zero, float(sigma[low]), int(steps.ranks[step_of[low]])))
    return more


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
    if steps.count and np.isfinite(steps.sigmas).all():
        found += _between_the_steps(abscissae, steps, found)
    return tuple(sorted(found, key=lambda crossing: crossing.time))
