"""Sentences about sweeps in the message of a run: instability, drift, restarts, split takeovers.

The terms in 1/eps of sweeps that carry y make of a constraint error d

    d' = -G B T d/eps,    T = I or (GB)^T,

so that a step multiplies it by R(-h mu/eps) for every eigenvalue mu of G B T, with the stability
function R of the scheme.  With T = (GB)^-1 all mu are 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from srm_mbs.dynamics.dae import DaeSystem
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.driver import RunRecord
from srm_mbs.integration.methods.base import ErrorNorm, StepResult, SweepNode
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.regularisation import real_stability_limit, stability_function

LOOKED_AT = 10
"""Steps before a failure whose sweeps are looked at."""
ROUNDING = 1e-9
"""Part of the largest eigenvalue that is rounding of the others."""


def instability(
    system: DaeSystem,
    scheme: ButcherTableau,
    record: RunRecord,
    begun: Sequence[SweepNode],
    eps: Callable[[float], float] | None,
) -> str:
    """A sentence that says why the sweeps of a failed run are unstable; empty if they are not.

    Parameters
    ----------
    record
        The run.
    begun
        Where the sweeps stood at its start.
    eps
        The regularisation (s) of a step; None if it is not known.
    """
    cases: list[tuple[float, float, float, SweepNode]] = []
    nodes, t = begun, record.t0
    for result in record.steps[-LOOKED_AT:]:
        nodes, t = result.sweeps, result.t + result.h
        cases += [(t, result.h, node.eps, node) for node in nodes if node.eps > 0.0]
    if record.attempts and record.attempts[-1].t == t and eps is not None:
        h = record.attempts[-1].h
        cases += [(t, h, eps(h), node) for node in nodes]
    worst, sentence = 1.0 + ROUNDING, ""
    for t, h, size, node in reversed(cases):
        try:
            damped = system.damping(t, node.state)
        except EvaluationError:
            continue
        largest = float(np.abs(damped).max())
        lowest = float(damped.real.min())
        if lowest < -ROUNDING * largest:
            return (
                f" At t = {t:.6g} G B has an eigenvalue of {lowest:.3g} (real part), and T = I "
                'drives sweeps away from the constraints along it: use T = "transpose" or '
                '"inverse".'
            )
        growth = max(abs(stability_function(scheme, -h * mu / size)) for mu in damped.tolist())
        if growth > worst:
            worst, radius = growth, h * largest / size
            sentence = (
                f" The sweeps are unstable: at t = {t:.6g} h |G B T|/eps = {radius:.3g} "
                f"(spectral radius), and {scheme.name} is stable up to "
                f'{real_stability_limit(scheme):.3g}: use T = "inverse", or a larger eps.'
            )
    return sentence


DRIFTED = 10.0
"""Constraint error over tolerance from which a run says so."""


def drift(steps: Sequence[StepResult], norm: ErrorNorm) -> str:
    """A sentence about sweeps that stay off the constraints by more than the tolerance."""
    worst = max(steps, key=lambda step: step.drift_ratio, default=None)
    if norm.negligible == 0.0 or worst is None or not worst.drift_ratio > DRIFTED:
        return ""
    return (
        f" The last sweep was off the constraints by up to {worst.drift_ratio:.2g} times the "
        f"tolerance (at t = {worst.t + worst.h:.6g} s), which no step-size control mends: sweeps "
        "are accurate to a power of eps. Use restarted sweeps (restart=True, carry=True), a "
        "smaller eps, or PSRM."
    )


def passings(steps: Sequence[StepResult]) -> str:
    """A sentence about the steps that the split form made for sweeps."""
    times = [step.t for step in steps if step.passing]
    if not times:
        return ""
    return (
        f" {len(times)} steps next to singular configurations, the first at t = {times[0]:.6g} s, "
        "are of the split PSRM: rounding would have exceeded the tolerance in sweeps."
    )


def restarts(steps: Sequence[StepResult]) -> str:
    """A sentence about sweeps with own histories that did not keep them."""
    times = [step.t for step in steps if step.restarted]
    if not times:
        return ""
    return (
        f" The sweeps gave up their own histories in {len(times)} steps, first at "
        f"t = {times[0]:.6g} s: sigma was falling, they were too far off the constraints to tell "
        "the branch if a singular configuration came, and started again from the accepted state."
    )
