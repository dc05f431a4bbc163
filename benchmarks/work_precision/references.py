"""Reference solutions: read from small files beside this module, or from reduced equations.

``python -m benchmarks.work_precision.make_references`` writes the files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

Array = Any
FOLDER = Path(__file__).parent / "references"


@dataclass(frozen=True, eq=False)
class Reference:
    """``observed`` (n, k) at the samples; ``accuracy``: how far two computations of it differ."""

    observed: Array
    accuracy: float
    method: str


def read(name: str) -> Reference:
    """The stored reference of problem ``name``."""
    with np.load(FOLDER / f"{name}.npz") as data:
        return Reference(data["observed"], float(data["accuracy"]), str(data["method"]))


def write(name: str, reference: Reference) -> Path:
    """Store ``reference``; returns the file."""
    path = FOLDER / f"{name}.npz"
    np.savez_compressed(
        path,
        observed=np.asarray(reference.observed, dtype=float),
        accuracy=reference.accuracy,
        method=reference.method,
    )
    return path


def by_scipy(field: Callable[[float, Any], Any], start: Array, times: Array) -> Array:
    """y (n, k) at ``times`` by SciPy's DOP853 near round-off."""
    run = solve_ivp(
        field,
        (0.0, times[-1]),
        np.asarray(start, dtype=float),
        "DOP853",
        t_eval=times,
        rtol=3e-14,
        atol=1e-15,
        max_step=float(times[0]) / 4.0,
    )
    if not run.success:
        raise RuntimeError(run.message)
    return run.y.T


def by_extrapolation(
    field: Callable[[Any, Any], Any], start: Array, times: Array, substeps: int, levels: int = 8
) -> Array:
    """y (n, k) at ``times`` by extrapolated modified midpoint steps (Gragg), order 2 ``levels``.

    Works in the precision of ``start``.  It rounds more than Runge-Kutta schemes do: for
    ``numpy.longdouble``.
    """
    y = np.asarray(start)
    kind = y.dtype.type
    counts = [2 * (j + 1) for j in range(levels)]
    out = []
    t = kind(0)
    for time in times:
        H = (kind(time) - t) / substeps
        for _ in range(substeps):
            y = _extrapolated(field, t, y, H, counts)
            t = t + H
        t = kind(time)
        out.append(y)
    return np.array(out)


def _extrapolated(
    field: Callable[[Any, Any], Any], t: Any, y: Array, H: Any, counts: list[int]
) -> Array:
    kind = y.dtype.type
    slope = np.asarray(field(t, y), dtype=kind)
    previous: list[Array] = []
    for j, n in enumerate(counts):
        h = H / kind(n)
        before, here = y, y + h * slope
        for i in range(1, n):
            rate = np.asarray(field(t + kind(i) * h, here), dtype=kind)
            before, here = here, before + 2 * h * rate
        row = [(before + here + h * np.asarray(field(t + H, here), dtype=kind)) / 2]
        for k in range(j):
            ratio = (kind(n) / kind(counts[j - k - 1])) ** 2
            row.append(row[k] + (row[k] - previous[k]) / (ratio - 1))
        previous = row
    return previous[-1]


def by_gauss(
    field: Callable[[float, Any], Any],
    start: Array,
    times: Array,
    substeps: int,
    stages: int = 6,
    project: Callable[[Array], Array] = lambda y: y,
) -> Array:
    """y (n, k) at ``times`` by Gauss collocation of order 2 ``stages``, fixed-point iteration.

    ``project`` is applied after every step.
    """
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    c, b = 0.5 * (nodes + 1.0), 0.5 * weights
    powers = np.arange(stages)
    # A V = C with V_jk = c_j^k, C_jk = c_j^(k+1) / (k+1): exact for polynomials.
    V = c[:, None] ** powers
    A = np.linalg.solve(V.T, (c[:, None] ** (powers + 1) / (powers + 1)).T).T
    y = np.asarray(start, dtype=float)
    out = []
    t = 0.0
    for time in times:
        h = (time - t) / substeps
        for k in range(substeps):
            begin = t + k * h
            K = np.tile(np.asarray(field(begin, y)), (stages, 1))
            change = last = np.inf
            for _ in range(100):
                new = np.array([field(begin + h * x, y + h * (a @ K)) for x, a in zip(c, A)])
                last, change = change, h * np.abs(new - K).max()
                K = new
                if change == 0.0 or (change < 1e-13 * (1.0 + np.abs(y).max()) and change >= last):
                    break
            else:
                raise RuntimeError(f"the stages at t = {begin:.3g} s do not converge")
            y = project(y + h * (b @ K))
        t = float(time)
        out.append(y)
    return np.array(out)


def reduced_reference(
    field: Callable[[Any, Any], Any], start: tuple[float, float], times: Array
) -> Reference:
    """A one-degree model, extrapolated in extended precision with two step sizes."""
    extended = np.array(start, dtype=np.longdouble)
    coarse, fine = (by_extrapolation(field, extended, times, k) for k in (3, 4))
    return Reference(
        fine.astype(float),
        float(np.abs(fine - coarse).max()),
        "reduced equation, extrapolated midpoint rule of order 16 in extended precision",
    )
