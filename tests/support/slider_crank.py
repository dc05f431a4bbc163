"""The bundled slider_crank, two equal bars: its motion by SciPy, its branch, starts on that."""

from __future__ import annotations

from typing import Any

import numpy as np

import srm_mbs as srm
from tests.support import reduced
from tests.support.bundled import load

PERIOD = 4.29657624142677449
"""Of the motion from rest (s): at rest every half period, singular a quarter after that."""
START = [7.0 * np.pi / 4.0, 0.0]
"""Angle (rad) and rate (rad/s) of the crank at the start of the bundled mechanism."""


def passages(count: int) -> np.ndarray:
    """Times (count,) of the first singular configurations (s)."""
    return PERIOD / 4.0 + PERIOD / 2.0 * np.arange(count)


def state(angle: float, rate: float) -> dict[str, Any]:
    """Start at that angle and rate of the crank, on the branch where the rod mirrors the crank."""
    return {"q0": [angle, -2.0 * angle], "v0": [rate, -2.0 * rate]}


def moving(angle: float, rate: float) -> srm.Mechanism:
    """The mechanism with that start."""
    start = state(angle, rate)
    return load("slider_crank").with_state(np.array(start["q0"]), np.array(start["v0"]))


def off_branch(q: np.ndarray) -> float:
    """Largest |rod + 2 crank| of the configurations q (k, 2), or rates: 0 on that branch."""
    return float(np.abs(q[..., 1] + 2.0 * q[..., 0]).max())


def error(solution: srm.Solution, start: list[float] | None = None) -> float:
    """Largest error of the crank's angle and rate at the end of a run from ``start``."""
    return reduced.error_at_end(solution, reduced.slider_crank(), START if start is None else start)
