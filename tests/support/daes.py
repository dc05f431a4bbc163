"""DAEs of index 2 with known solutions."""

from __future__ import annotations

from typing import Any

import numpy as np

import srm_mbs as srm


def problem_one(p: int) -> srm.SemiExplicitDAE:
    """Thesis, problem 1: x' = -y, 0 = x - t^p; x = t^p, y = -p t^(p-1)."""
    return srm.SemiExplicitDAE(
        f=lambda t, x: np.zeros(1),
        B=lambda t, x: np.ones(1),
        g=lambda t, x: x[0] - t**p,
        G=lambda t, x: np.ones(1),
        g_t=lambda t, x: -p * t ** (p - 1),
    )


def problem_two(**changed: Any) -> srm.SemiExplicitDAE:
    """Thesis, problem 2: x = (exp(-t), sin t), y = exp(t)."""
    functions: dict[str, Any] = {
        "f": lambda t, x: np.array([1 - np.exp(-t), np.cos(t) + np.exp(t) * np.sin(t)]),
        "B": lambda t, x: x,
        "g": lambda t, x: 0.5 * (x[0] ** 2 + x[1] ** 2 - np.exp(-2 * t) - np.sin(t) ** 2),
        "G": lambda t, x: x,
        "g_t": lambda t, x: np.exp(-2 * t) - np.sin(t) * np.cos(t),
    }
    return srm.SemiExplicitDAE(**functions | changed)


START_TWO = np.array([1.0, 0.0])


def solution_two(t: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.array([np.exp(-t), np.sin(t)]).T, np.exp(t)


def passing_singularity() -> srm.SemiExplicitDAE:
    """G B = x_1^2 (1 + x_1^2) on the parabola x_2 = x_1^2/2, whose vertex the solution passes.

    g = x_1 (x_2 - x_1^2/2), B = G^T, f = (1, 0) + n with the unit normal n: x' is the projection
    of (1, 0) on the tangent, so that x_1' = 1/(1 + x_1^2) and x_1 + x_1^3/3 = t + const.
    """

    def jacobian(t: float, x: Any) -> np.ndarray:
        return np.array([x[1] - 1.5 * x[0] ** 2, x[0]])

    return srm.SemiExplicitDAE(
        f=lambda t, x: np.array([1.0, 0.0]) + np.array([-x[0], 1.0]) / np.hypot(1.0, x[0]),
        B=jacobian,
        g=lambda t, x: x[0] * (x[1] - 0.5 * x[0] ** 2),
        G=jacobian,
    )


START_PASSING = np.array([-1.0, 0.5])


def solution_passing(t: float) -> np.ndarray:
    """x at time t for the start (-1, 1/2): the real root of x_1 + x_1^3/3 = t - 4/3."""
    roots = np.roots([1.0 / 3.0, 0.0, 1.0, 4.0 / 3.0 - t])
    x = float(roots[np.abs(roots.imag) < 1e-9].real[0])
    return np.array([x, 0.5 * x * x])
