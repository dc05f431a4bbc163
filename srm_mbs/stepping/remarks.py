"""What the message of a run says about its methods' limits."""

from __future__ import annotations

from collections.abc import Sequence

from srm_mbs.methods.base import ErrorNorm, StepResult

TOLD = 5
"""Times listed."""
DRIFTED = 10.0
"""Constraint error over tolerance from which a run says so."""


def turns(times: Sequence[float], what: str, remedy: str) -> str:
    """A sentence naming the times at which the motion may have changed its branch.

    Parameters
    ----------
    times
        Of the guard's suspects (s).
    what
        "the velocity turned".
    remedy
        A sentence.
    """
    if not times:
        return ""
    listed = ", ".join(f"{t:.6g}" for t in times[:TOLD]) + (", ..." if len(times) > TOLD else "")
    return (
        f" Next to singular configurations, up to t = {listed} s, {what} and no shorter step "
        f"mended it: the motion may have changed its branch. {remedy}"
    )


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
