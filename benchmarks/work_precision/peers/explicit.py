"""Explicit integrators that several peers share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.work_precision.peers.base import RunFailedError

Array = Any
Field = Callable[[float, Array], Array]


def dop853(field: Field, start: Array, times: Array, tolerance: float) -> tuple[Array, int]:
    """y (n, k) at ``times`` by SciPy's DOP853 at rtol = atol, and its steps.

    Raises
    ------
    RunFailedError
        If the integrator gives up.
    """
    with np.errstate(all="ignore"):
        run = solve_ivp(
            field, (0.0, times[-1]), start, "DOP853", times, rtol=tolerance, atol=tolerance
        )
    if not run.success:
        raise RunFailedError(run.message)
    return run.y.T, run.nfev // 12


def rk4(
    field: Field,
    start: Array,
    times: Array,
    substeps: int,
    project: Callable[[Array], Array] | None = None,
) -> Array:
    """y (n, k) at ``times`` by the classical Runge-Kutta scheme, ``substeps`` from one to the
    next.

    Raises
    ------
    RunFailedError
        If the state is no longer finite.
    """
    out = np.empty((len(times), len(start)))
    y, t = start, 0.0
    with np.errstate(all="ignore"):
        for i, time in enumerate(times):
            h = (time - t) / substeps
            half = 0.5 * h
            for _ in range(substeps):
                k1 = field(t, y)
                k2 = field(t + half, y + half * k1)
                k3 = field(t + half, y + half * k2)
                k4 = field(t + h, y + h * k3)
                y = y + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
                if project is not None:
                    y = project(y)
                t += h
            if not np.isfinite(y).all():
                raise RunFailedError(f"the state is no longer finite at t = {time:.3g} s")
            out[i] = y
            t = float(time)
    return out
