"""What a run says in the log: how it is made, how it ended, which singular passages it had."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from srm_mbs.methods.base import ErrorNorm, Method
from srm_mbs.stepping.crossings import Crossing

if TYPE_CHECKING:
    from srm_mbs.dae_solution import DaeSolution
    from srm_mbs.solution import Solution

log = logging.getLogger(__name__)

TOLD = 50
"""Passages of a run that are listed."""


def log_start(
    name: str, t0: float, t_end: float, method: Method, norm: ErrorNorm, step: float | None, by: str
) -> None:
    """The settings of a run of ``name``, which ``by`` computes."""
    if not log.isEnabledFor(logging.INFO):
        return
    size = f"rtol {norm.rtol:g}" if step is None else f"steps of {step:g} s"
    log.info(
        "%s: from t = %g to %g s with %s %s, %s, by the %s",
        name,
        t0,
        t_end,
        type(method).__name__,
        method.scheme.name,
        size,
        by,
    )


def log_end(name: str, solution: Solution | DaeSolution) -> None:
    """Statistics, and the passages, which are looked for only if they are wanted.

    Looking for thousands of them takes seconds: who pressed Ctrl-C has the solution before it.
    """
    stats = solution.stats
    log.info(
        "%s: %s after %d steps (%d rejected, %d redone at singular configurations) and "
        "%d evaluations in %.3g s",
        name,
        solution.status,
        stats.steps,
        stats.rejected,
        stats.replaced,
        stats.evaluations,
        stats.wall_time,
    )
    log.info("%s: %s", name, solution.message)
    if log.isEnabledFor(logging.DEBUG) and solution.status != "interrupted":
        _log_passages(name, getattr(solution, "crossings", ()))


def _log_passages(name: str, crossings: Sequence[Crossing]) -> None:
    for crossing in crossings[:TOLD]:
        log.debug(
            "%s: singular configuration of %s passed at t = %.9g s",
            name,
            crossing.participants.names,
            crossing.time,
        )
    if len(crossings) > TOLD:
        log.debug("%s: and %d more", name, len(crossings) - TOLD)
