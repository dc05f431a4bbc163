"""What is handed to the compiled kernel and back: numbers of the algorithm, what a run remembers.

Matrices of the reference have their vectors in columns, those of the kernel in rows.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from srm_mbs.integration import breakpoints, driver, singular_endpoints
from srm_mbs.integration.control import branch_guard, placement, step_size
from srm_mbs.integration.control.step_size import StepDecision
from srm_mbs.integration.methods import near_singular, split_step
from srm_mbs.integration.methods.base import IntegratorState
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.multiplier_history import MultiplierHistory

VERDICTS = (StepDecision.ACCEPTED, StepDecision.REJECTED, StepDecision.REPLACED)
"""What the kernel numbers from 0: ``StepDecision`` in control.hpp."""
CONSTANTS = {
    "watched": near_singular.WATCHED,
    "near": near_singular.NEAR,
    "far": near_singular.FAR,
    "ambiguous": near_singular.AMBIGUOUS,
    "held": near_singular.HELD,
    "rounding": near_singular.ROUNDING,
    "usual": near_singular.USUAL,
    "crosses": near_singular.CROSSES,
    "lead": near_singular.LEAD,
    "most_floor": near_singular.MOST_FLOOR,
    "zone_largest": near_singular.ZONE_LARGEST,
    "count_uncertainty_above": near_singular.COUNT_UNCERTAINTY_ABOVE,
    "hit": near_singular.HIT,
    "projections": near_singular.PROJECTIONS,
    "fewest": near_singular.FEWEST,
    "gap_every": split_step.RESIDUAL_EVERY,
    "safety": step_size.SAFETY,
    "min_factor": step_size.MIN_FACTOR,
    "max_factor": step_size.MAX_FACTOR,
    "proportional": step_size.PROPORTIONAL_EXPONENT,
    "integral": step_size.INTEGRAL_EXPONENT,
    "xi_old_floor": step_size.MIN_OLD_ERROR_RATIO,
    "xi_floor": step_size.MIN_ERROR_RATIO,
    "failed_evaluation": step_size.UNEVALUATED_ERROR_RATIO,
    "sigma_change": placement.SIGMA_CHANGE,
    "too_close": placement.TOO_CLOSE,
    "clearance": placement.CLEARANCE,
    "ahead": placement.PREDICTION_STEPS,
    "max_redone": placement.MAX_REDONE,
    "beside": placement.SINGULAR_END_SIGMA,
    "arrival_change": placement.ARRIVAL_SIGMA_CHANGE,
    "turned": branch_guard.VELOCITY_JUMP,
    "guard_max_redone": branch_guard.MAX_REDONE,
    "smallest_step": driver.SMALLEST_STEP,
    "standstill": driver.STANDSTILL,
    "large_correction": driver.LARGE_CORRECTION,
    "open": driver.RESIDUAL_EXAMINED,
    "lost": driver.LARGEST_RESIDUAL,
    "watched_steps": driver.WATCHED_STEPS,
    "look": singular_endpoints.NEAR_SINGULAR_SIGMA,
    "closer": breakpoints.CLOSER,
    "allowed": breakpoints.ALLOWED,
}
"""Every number of the algorithm, from the module of the reference that has it."""


FIRST_STEP = (step_size.RATE_OVERFLOW, step_size.PROBE_LENGTH, step_size.LONGEST_FIRST)
"""Those of the first step."""


@lru_cache(maxsize=64)
def scheme_data(scheme: ButcherTableau) -> dict[str, Any]:
    """``scheme`` as the kernel reads it."""
    gaps = np.array(scheme.gaps)
    return {
        "A": scheme.A,
        "b": scheme.b,
        "c": scheme.c,
        "error": scheme.error,
        "controller_order": scheme.controller_order or 1,
        "gap_centres": gaps[:, 0].copy(),
        "gap_half_widths": gaps[:, 1].copy(),
    }


def history_data(history: MultiplierHistory | None) -> dict[str, Any] | None:
    """``history`` as the kernel reads it; None is none."""
    if history is None:
        return None
    normals = history.normals
    return {
        "times": np.ascontiguousarray(history.times),
        "values": np.ascontiguousarray(history.values),
        "known_until": history.known_until,
        "known_below": history.known_below,
        "normals": None if normals is None else np.ascontiguousarray(normals.T),
    }


def history_from(data: dict[str, Any]) -> MultiplierHistory:
    """What the kernel gave back, as a history."""
    normals = data["normals"]
    return MultiplierHistory(
        data["times"],
        data["values"],
        data["known_until"],
        data["known_below"],
        None if normals is None else normals.T,
    )


def memory_data(memory: IntegratorState) -> dict[str, Any]:
    """``memory`` as the kernel reads it."""
    return {
        "rate": np.ascontiguousarray(memory.rate),
        "magnitude": np.ascontiguousarray(memory.state_scale),
        "sigma": memory.sigma,
        "sigma_slope": memory.sigma_slope,
        "steps": memory.steps,
        "history": history_data(memory.history),
    }


def memory_from(data: dict[str, Any]) -> IntegratorState:
    """What the kernel gave back, as a memory."""
    history = data["history"]
    return IntegratorState(
        data["rate"],
        data["sigma"],
        data["magnitude"],
        None if history is None else history_from(history),
        data["sigma_slope"],
        data["steps"],
    )
