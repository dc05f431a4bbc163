"""Observed orders of convergence: the fitted slope over fixed steps, away from singularities.

Slopes of log(largest error over five times) against log(h) in the asymptotic range of each
tableau.  dopr54's leading error coefficients are so small that steps above 1e-2 s show higher
slopes on these problems, hence its finer steps.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs.dynamics.mechanism import Mechanism

STEPS = {
    "fe": (2e-3, 1e-3, 5e-4),
    "trap": (1e-2, 5e-3, 2.5e-3),
    "heun": (1e-2, 5e-3, 2.5e-3),
    "tvd32": (2e-2, 1e-2, 5e-3),
    "erk4": (4e-2, 2e-2, 1e-2),
    "dopr54": (1e-2, 5e-3, 2.5e-3),
    "dop853": (0.2, 0.1, 0.05),
}
SAMPLES = np.linspace(0.2, 1.0, 5)


def fitted_order(steps: Any, errors: Any) -> float:
    """Slope of log(error) against log(step)."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


@cache
def turning(name: str, rate: float) -> Mechanism:
    """A bundled mechanism with its crank at 1 rad and ``rate`` rad/s."""
    mechanism = srm.load(name)
    state = srm.assemble(mechanism, {"crank": 1.0}, {"crank": rate})
    return mechanism.with_state(state.q, state.v)


@cache
def reference_of(mechanism: Mechanism) -> srm.Solution:
    return srm.simulate(mechanism, 1.0, rtol=1e-12, atol=1e-13, max_step=0.02, t_eval=SAMPLES)


def observed_order(
    mechanism: Mechanism, method: srm.PSRM, steps: tuple[float, ...] | None = None
) -> float:
    steps = steps or STEPS[method.scheme.name]
    reference = reference_of(mechanism)
    errors = []
    for h in steps:
        solution = srm.simulate(mechanism, 1.0, method=method, step=h, t_eval=SAMPLES)
        assert solution.stats.placements == 0, "orders are measured away from singularities"
        dq = [pin.difference(mechanism.model, a, b) for a, b in zip(solution.q, reference.q)]
        errors.append(max(np.abs(dq).max(), np.abs(solution.v - reference.v).max()))
    return fitted_order(steps, errors)
