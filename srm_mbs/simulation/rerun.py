"""Reruns: the same run with another accuracy."""

from __future__ import annotations

from typing import Any

import numpy as np

from srm_mbs.errors import InputError
from srm_mbs.integration.driver import RunStatus
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.simulation.segmented_result import RESULTS
from srm_mbs.simulation.segmented_run import run

EXTENSION = 0.1
"""Extension of the rerun of a failed run, as a part of its length: the rerun may get further."""


def unsupported_reason(solution: SimulationResult) -> str | None:
    """Why ``solution`` cannot be made again; None if it can."""
    request = solution.request
    if request is None:
        return "the file that it was loaded from does not hold how it was made"
    if request.lost:
        return f"saved runs hold no Python functions, and it had {', '.join(request.lost)}"
    return None


def rerun(
    solution: SimulationResult,
    *,
    rtol: float | None = None,
    step: float | None = None,
    progress: Any = False,
) -> SimulationResult:
    """The run again, from the same start with the same options but another accuracy.

    Functions of the user (controllers, events, forces) are called again.  A run that failed is
    made again for a little longer than it lasted, one that was interrupted as far as it came.

    Parameters
    ----------
    rtol
        Relative tolerance; the absolute ones are changed by the same factor.
    step
        Length (s) of the steps of a run with fixed steps.
    progress
        As for :func:`srm_mbs.simulate`.

    Raises
    ------
    InputError
        If it cannot be made again; the message says why.
    """
    reason, request = unsupported_reason(solution), solution.request
    if reason or request is None:
        raise InputError(
            f"the run cannot be made again: {reason}",
            element="solution",
            remedy="Give the solution itself, before it is saved",
        )
    settings = solution.settings
    start, end = solution.span
    t_end = request.t_end
    if solution.status is RunStatus.INTERRUPTED:
        t_end = end
    elif solution.status is RunStatus.FAILED:
        t_end = min(t_end, end + EXTENSION * max(end - start, EXTENSION * (t_end - start)))
    asked = settings.rtol if rtol is None else rtol
    backend = request.backend
    if settings.backend == "python" and backend == "auto":
        backend = "python"
    options = request._replace(
        t_end=t_end,
        rtol=asked,
        atol=np.array(settings.atol) * (asked / settings.rtol),
        step=settings.step if step is None else step,
        progress=progress,
        backend=backend,
    )
    return run(solution.mechanism, options, RESULTS)
