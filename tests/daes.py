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


def passing_singularity(rate: float = 1.0) -> srm.SemiExplicitDAE:
    """G B loses rank where x_1 = 0, which the solution x = (t - 1, (t - 1)^2 / 2) passes.

    x' = f - B y with g = x_1 (x_2 - x_1^2 / 2) and B = G^T: on the parabola
    G = x_1 (-x_1, 1) vanishes at the vertex with its direction continuous.  f = (1, 0) + n with
    the unit normal n is projected on the tangent (1, x_1)/sqrt(1 + x_1^2):
    x_1' = 1/(1 + x_1^2) and B y = f - x'.
    """

    def normal(x: Any) -> np.ndarray:
        return np.array([-x[0], 1.0]) / np.hypot(1.0, x[0])

    def jacobian(t: float, x: Any) -> np.ndarray:
        d = x[1] - 0.5 * x[0] ** 2
        return np.array([d - x[0] ** 2, x[0]])

    return srm.SemiExplicitDAE(
        f=lambda t, x: np.array([rate, 0.0]) + normal(x),
        B=jacobian,
        g=lambda t, x: x[0] * (x[1] - 0.5 * x[0] ** 2),
        G=jacobian,
    )
