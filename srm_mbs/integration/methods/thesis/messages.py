"""Sentences about sweeps in the message of a run: drift, split takeovers, restarts."""

from __future__ import annotations

from collections.abc import Sequence

from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.integration.methods.thesis.sweep import SweepResult

REPORTED_DRIFT = 10.0
"""Constraint error of the last sweep, over the tolerance, from which a message reports it."""


def drift(steps: Sequence[SweepResult], norm: ErrorNorm) -> str:
    """A sentence about a last sweep whose constraint error exceeds the tolerance."""
    worst = max(steps, key=lambda step: step.drift_ratio, default=None)
    if norm.negligible == 0.0 or worst is None or not worst.drift_ratio > REPORTED_DRIFT:
        return ""
    return (
        f" The last sweep was off the constraints by up to {worst.drift_ratio:.2g} times the "
        f"tolerance (at t = {worst.t + worst.h:.6g} s), which no step-size control mends: sweeps "
        "are accurate to a power of eps. Use restarted sweeps (restart=True, carry=True), a "
        "smaller eps, or PSRM."
    )


def takeovers(steps: Sequence[SweepResult]) -> str:
    """A sentence about the steps that the split form made (split takeover)."""
    times = [step.t for step in steps if step.taken_over]
    if not times:
        return ""
    return (
        f" {len(times)} steps next to singular configurations, the first at t = {times[0]:.6g} s, "
        "are of the split PSRM: rounding would have exceeded the tolerance in sweeps."
    )


def restarts(steps: Sequence[SweepResult]) -> str:
    """A sentence about sweeps with own histories that were restarted."""
    times = [step.t for step in steps if step.restarted]
    if not times:
        return ""
    return (
        f" The sweeps gave up their own histories in {len(times)} steps, first at "
        f"t = {times[0]:.6g} s: sigma was falling, they were too far off the constraints to tell "
        "the branch if a singular configuration came, and started again from the accepted state."
    )
