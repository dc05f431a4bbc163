"""What is handed to the compiled kernel and back: numbers of the algorithm, what a run remembers.

Matrices of the reference have their vectors in columns, those of the kernel in rows.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from srm_mbs.methods import branch, split, zone
from srm_mbs.methods.base import Memory
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.stepping import (
    breakpoints,
    guard,
    kinks,
    loop,
    placement,
    starting,
    stepsize,
    turning,
)
from srm_mbs.stepping.stepsize import Verdict

VERDICTS = (Verdict.ACCEPTED, Verdict.REJECTED, Verdict.REPLACED)
"""What the kernel numbers from 0: ``Verdict`` in control.hpp."""
CONSTANTS = {
    "watched": branch.WATCHED,
    "near": branch.NEAR,
    "far": branch.FAR,
    "ambiguous": branch.AMBIGUOUS,
    "held": branch.HELD,
    "rounding": branch.ROUNDING,
    "usual": branch.USUAL,
    "crosses": branch.CROSSES,
    "lead": branch.LEAD,
    "most_floor": branch.MOST_FLOOR,
    "zone_largest": zone.ZONE_LARGEST,
    "count_uncertainty_above": zone.COUNT_UNCERTAINTY_ABOVE,
    "hit": zone.HIT,
    "projections": branch.PROJECTIONS,
    "fewest": zone.FEWEST,
    "gap_every": split.GAP_EVERY,
    "safety": stepsize.SAFETY,
    "min_factor": stepsize.MIN_FACTOR,
    "max_factor": stepsize.MAX_FACTOR,
    "proportional": stepsize.PROPORTIONAL,
    "integral": stepsize.INTEGRAL,
    "xi_old_floor": stepsize.XI_OLD_FLOOR,
    "xi_floor": stepsize.XI_FLOOR,
    "failed_evaluation": stepsize.FAILED_EVALUATION,
    "sigma_change": placement.SIGMA_CHANGE,
    "too_close": placement.TOO_CLOSE,
    "clearance": placement.CLEARANCE,
    "ahead": kinks.AHEAD,
    "max_redone": placement.MAX_REDONE,
    "beside": placement.BESIDE,
    "arrival_change": placement.ARRIVAL,
    "turned": turning.TURNED,
    "guard_max_redone": guard.MAX_REDONE,
    "smallest_step": loop.SMALLEST_STEP,
    "standstill": loop.STANDSTILL,
    "large_correction": loop.LARGE_CORRECTION,
    "open": loop.OPEN,
    "lost": loop.LOST,
    "watched_steps": loop.WATCHED_STEPS,
    "look": starting.LOOK,
    "closer": breakpoints.CLOSER,
    "allowed": breakpoints.ALLOWED,
}
"""Every number of the algorithm, from the module of the reference that has it."""


FIRST_STEP = (stepsize.OVERFLOW, stepsize.PROBE, stepsize.LONGEST_FIRST)
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


def memory_data(memory: Memory) -> dict[str, Any]:
    """``memory`` as the kernel reads it."""
    return {
        "rate": np.ascontiguousarray(memory.rate),
        "magnitude": np.ascontiguousarray(memory.magnitude),
        "sigma": memory.sigma,
        "sigma_slope": memory.sigma_slope,
        "steps": memory.steps,
        "history": history_data(memory.history),
    }


def memory_from(data: dict[str, Any]) -> Memory:
    """What the kernel gave back, as a memory."""
    history = data["history"]
    return Memory(
        data["rate"],
        data["sigma"],
        data["magnitude"],
        None if history is None else history_from(history),
        data["sigma_slope"],
        data["steps"],
    )
