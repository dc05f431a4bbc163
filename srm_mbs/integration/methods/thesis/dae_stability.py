"""Whether the sweeps of a DAE that carry y damp their constraint errors.

Their terms in 1/eps make of a constraint error d

    d' = -G B T d/eps,    T = I or (GB)^T,

so that a step multiplies it by R(-h mu/eps) for every eigenvalue mu of G B T, with the stability
function R of the scheme.  With T = (GB)^-1 all mu are 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from srm_mbs.dynamics.dae import DaeSystem
from srm_mbs.errors import EvaluationError, time_text
from srm_mbs.integration.driver import RunRecord
from srm_mbs.integration.messages import RunFailure, StopReason
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.thesis.regularisation import (
    real_stability_limit,
    stability_function,
)
from srm_mbs.integration.methods.thesis.sweep import SweepNode, SweepResult

EXAMINED_STEPS = 10
"""Steps before a failure whose sweeps are examined."""
EIGENVALUE_ROUNDING = 1e-9
"""Rounding of an eigenvalue, over the largest."""


def instability(
    system: DaeSystem,
    scheme: ButcherTableau,
    record: RunRecord,
    start: Sequence[SweepNode],
    eps: Callable[[float], float] | None,
) -> RunFailure | None:
    """Why the sweeps of a failed run are unstable; None if they are not.

    Parameters
    ----------
    record
        The run.
    start
        The sweeps at its start.
    eps
        The regularisation (s) of a step; None if it is not known.
    """
    cases: list[tuple[float, float, float, SweepNode]] = []
    nodes, t = start, record.t0
    for result in record.steps[-EXAMINED_STEPS:]:
        nodes = result.sweeps if isinstance(result, SweepResult) else ()
        t = result.t + result.h
        cases += [(t, result.h, node.eps, node) for node in nodes if node.eps > 0.0]
    if record.attempts and record.attempts[-1].t == t and eps is not None:
        h = record.attempts[-1].h
        cases += [(t, h, eps(h), node) for node in nodes]
    worst, failure = 1.0 + EIGENVALUE_ROUNDING, None
    for t, h, size, node in reversed(cases):
        try:
            damped = system.damping(t, node.state)
        except EvaluationError:
            continue
        largest = float(np.abs(damped).max())
        lowest = float(damped.real.min())
        if lowest < -EIGENVALUE_ROUNDING * largest:
            return RunFailure(
                StopReason.UNSTABLE_SWEEPS,
                f"At t = {time_text(t)} G B has an eigenvalue of {lowest:.3g} (real part), and T "
                '= I drives sweeps away from the constraints along it: use T = "transpose" or '
                '"inverse".',
            )
        growth = max(abs(stability_function(scheme, -h * mu / size)) for mu in damped.tolist())
        if growth > worst:
            worst, radius = growth, h * largest / size
            failure = RunFailure(
                StopReason.UNSTABLE_SWEEPS,
                f"The sweeps are unstable: at t = {time_text(t)} h |G B T|/eps = {radius:.3g} "
                f"(spectral radius), and {scheme.name} is stable up to "
                f'{real_stability_limit(scheme):.3g}: use T = "inverse", or a larger eps.',
            )
    return failure
