"""Progress and log of runs.

Progress bars show simulated time, step size and drift of a run, or the cases of a sweep, on a
terminal only.  The log says how a run is made, how it ended, and which singular configurations it
passed.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.errors import get_logger
from srm_mbs.integration.driver import RunStatus, Tick
from srm_mbs.integration.methods.base import ErrorNorm
from srm_mbs.integration.singular_passages import Crossing
from srm_mbs.simulation.options import RunOptions
from srm_mbs.simulation.result import RunOutcome

log = get_logger(__name__)

LISTED_PASSAGES = 50
"""Passages of a run that are listed."""


def log_start(name: str, options: RunOptions, norm: ErrorNorm, by: str) -> None:
    """Log the checked options of a run of ``name`` that the backend ``by`` makes."""
    if not log.isEnabledFor(logging.INFO):
        return
    step, method = options.step, options.method
    size = f"rtol {norm.rtol:g}" if step is None else f"steps of {step:g} s"
    log.info(
        "%s: from t = %g to %g s with %s %s, %s, backend %s",
        name,
        options.t0,
        options.t_end,
        type(method).__name__,
        method.scheme.name,
        size,
        by,
    )


def log_end(name: str, solution: RunOutcome) -> None:
    """Log the statistics, and for DEBUG the passages: a search for thousands takes seconds.

    After Ctrl-C there is no search, so that the solution comes at once.
    """
    if not log.isEnabledFor(logging.INFO):
        return
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
    if not log.isEnabledFor(logging.DEBUG) or solution.status is RunStatus.INTERRUPTED:
        return
    crossings: Sequence[Crossing] = getattr(solution, "crossings", ())
    for crossing in crossings[:LISTED_PASSAGES]:
        log.debug(
            "%s: singular configuration of %s passed at t = %.9g s",
            name,
            crossing.participants.names,
            crossing.time,
        )
    if len(crossings) > LISTED_PASSAGES:
        log.debug("%s: and %d more", name, len(crossings) - LISTED_PASSAGES)


Counted = Callable[[int, int], object]
"""Called with (done, total)."""
REFRESH = 0.1
"""Seconds between two updates; more often would slow the run."""


_NO_TICK: AbstractContextManager[None] = nullcontext(None)


def progress_of(
    progress: bool | Tick, system: System, t_end: float
) -> AbstractContextManager[Tick | None]:
    """The callback of the option ``progress``: the caller's own, a progress bar, or none."""
    if callable(progress):
        return nullcontext(progress)
    return progress_bar(system, t_end) if progress else _NO_TICK


@contextmanager
def _bar(label: str, counted: str, total: float) -> Iterator[Callable[[float, str], None] | None]:
    """A function (completed, detail) that draws a bar on standard error; None if no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn(label),
        BarColumn(),
        TextColumn(counted),
        TextColumn("{task.fields[detail]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("run", total=total, detail="")
        yield lambda completed, detail: bar.update(task, completed=completed, detail=detail)


@contextmanager
def progress_bar(system: System, t_end: float) -> Iterator[Tick | None]:
    """A tick that draws a progress bar on standard error; None where that is no terminal."""
    with _bar("simulating", "t = {task.completed:.3f} / {task.total:.6g} s", t_end) as draw:
        if draw is None:
            yield None
            return
        last = 0.0

        def tick(t: float, h: float, state: FloatArray) -> None:
            nonlocal last
            now = time.perf_counter()
            if now - last < REFRESH and t < t_end:
                return
            last = now
            detail = f"h = {h:.2e} s"
            if system.has_constraints:
                detail += f"  drift = {system.constraint_residual(t, state):.1e}"
            draw(t, detail)

        yield tick


@contextmanager
def counting(
    progress: bool | Counted, what: str, total: int, doing: str = "sweeping"
) -> Iterator[Counted | None]:
    """The callback after each of ``total`` items: the caller's own, a progress bar, or none."""
    if callable(progress):
        yield progress
    elif not progress:
        yield None
    else:
        counted = f"{{task.completed:.0f}} / {{task.total:.0f}} {what}"
        with _bar(doing, counted, total) as draw:
            yield None if draw is None else lambda done, _: draw(done, "")
