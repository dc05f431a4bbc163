"""Observed orders: fitted slopes of the final error over the step or over eps.

The thesis does not print its grids.  Ours are those with which the slopes of few sweeps, which
depend on the coarse end, come near to print: h = 1/10 ... 1/1000 for eps = h, 1/25 ... 1/1000 for
eps = 5h, and eps = 0.0055 ... 0.08 for a fixed step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import srm_mbs as srm
from benchmarks.thesis.problems import UNIT, problem_one
from srm_mbs.integration.methods.base import Method

STEPS = (10, 16, 25, 40, 63, 100, 158, 250, 400, 630, 1000)
"""Steps per unit time."""
STEPS_FIVE = STEPS[2:]
"""For eps = 5h."""
EPSILONS = tuple(np.geomspace(0.0055, 0.08, 8).tolist())
ROUND_OFF = 1e-12
"""Median error from which a method is exact but for rounding."""
FLOOR = 1e-14
"""Errors below this are not fitted."""


@dataclass(frozen=True)
class Curve:
    """Errors of x at t = 1 over ``values`` of h or eps; ``embedded`` ones if there is a pair."""

    values: tuple[float, ...]
    errors: tuple[float, ...]
    embedded: tuple[float, ...] | None


def slope(values: tuple[float, ...], errors: tuple[float, ...]) -> float | str:
    """The observed order; ``"exact"`` if at least half of the errors are rounding."""
    error = np.array(errors)
    if np.median(error) < ROUND_OFF:
        return "exact"
    fitted = error > FLOOR
    return round(
        float(np.polyfit(np.log(np.array(values)[fitted]), np.log(error[fitted]), 1)[0]), 4
    )


def _errors(p: int, method: Method, h: float) -> tuple[float, float]:
    """|x - 1| at t = 1 by the scheme and by its embedded weights, for x in units of UNIT."""
    run = srm.solve_dae(problem_one(p), (0.0, 1.0), [0.0], method=method, step=h)
    if not run.success:
        raise RuntimeError(f"{method} with h = {h:g}: {run.message}")
    x, scheme = run.x[-1, 0], method.scheme
    lower = x
    if scheme.error is not None:
        last = np.diff(run.t)[-1]
        lower = x - last * (scheme.error @ run.steps.rates[-1, : len(scheme.error), 0])
    return abs(x / UNIT - 1.0), abs(lower / UNIT - 1.0)


def curve(p: int, values: tuple[float, ...], runs: list[tuple[Method, float]], pair: bool) -> Curve:
    """The errors of ``runs``, (method, h), that belong to ``values``."""
    pairs = [_errors(p, method, h) for method, h in runs]
    lower = tuple(error for _, error in pairs) if pair else None
    return Curve(values, tuple(error for error, _ in pairs), lower)


def srm_curve(tableau: str, m: int, steps: tuple[int, ...], factor: float) -> Curve:
    """SRM with eps = ``factor`` h over the step."""
    scheme = srm.TABLEAUS[tableau]
    runs: list[tuple[Method, float]] = [
        (srm.SRM(tableau=tableau, iterations=m, eps=factor / n), 1.0 / n) for n in steps
    ]
    values = tuple(factor / n for n in steps)
    return curve(scheme.order, values, runs, scheme.error is not None)


def srm_fixed_step_curve(tableau: str, m: int, epsilons: tuple[float, ...], h: float) -> Curve:
    """SRM with the fixed step ``h`` over eps."""
    scheme = srm.TABLEAUS[tableau]
    runs: list[tuple[Method, float]] = [
        (srm.SRM(tableau=tableau, iterations=m, eps=eps), h) for eps in epsilons
    ]
    return curve(scheme.order, epsilons, runs, scheme.error is not None)
