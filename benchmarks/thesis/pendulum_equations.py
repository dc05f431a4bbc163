r"""What only figures 1.3, 5.1 and 5.2 need: the pendulum without a constraint-preserving method.

Unit mass, unit length, p = (x, z), p'' = (0, -g) - 2 y p, started at (1, 0) at rest.  States are
(x, z, x', z') in m and m/s, followed by y (1/s^2) where it is a state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.thesis.systems import GRAVITY
from srm_mbs._typing import FloatArray
from srm_mbs.integration.methods.butcher import ButcherTableau

Field = Callable[[float, Any], list[float]]
START = np.array([1.0, 0.0, 0.0, 0.0, 0.0])


def _motion(state: Any, y: float) -> list[float]:
    x, z, vx, vz = state[:4]
    return [vx, vz, -2.0 * x * y, -GRAVITY - 2.0 * z * y]


def index_reduced(t: float, state: Any) -> list[float]:
    """The third derivative of the constraint, solved for y'; nothing keeps the constraint."""
    x, z, vx, vz, y = state
    rate = -4.0 * (x * vx + z * vz) * y - 1.5 * GRAVITY * vz
    return [*_motion(state, y), rate / (x * x + z * z)]


def regularised(eps: float) -> Field:
    """(1.13): y' = g/eps, with the index-2 constraint g = 2 (x x' + z z')."""

    def field(t: float, state: Any) -> list[float]:
        x, z, vx, vz, y = state
        return [*_motion(state, y), 2.0 * (x * vx + z * vz) / eps]

    return field


def baumgarte(c0: float) -> Field:
    """(1.19) for that constraint: y = (GB)^-1 (c0 g + G f), state without y."""

    def field(t: float, state: Any) -> list[float]:
        x, z, vx, vz = state
        rate = 2.0 * (vx * vx + vz * vz) - 2.0 * GRAVITY * z
        y = (c0 * 2.0 * (x * vx + z * vz) + rate) / (4.0 * (x * x + z * z))
        return _motion(state, y)

    return field


def fixed_steps(
    field: Field, scheme: ButcherTableau, start: FloatArray, t_end: float, h: float
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and states (n, k) of the plain explicit scheme; ends where it overflows."""
    states = [start]
    rates = np.zeros((scheme.n_stages, len(start)))
    n = round(t_end / h)
    for step in range(n):
        for j in range(scheme.n_stages):
            stage = states[-1] + h * (scheme.A[j, :j] @ rates[:j])
            rates[j] = field((step + scheme.c[j]) * h, stage)
        new = states[-1] + h * (scheme.b @ rates)
        if not np.abs(new).max() < 1e3:
            break
        states.append(new)
    return h * np.arange(len(states)), np.array(states)
