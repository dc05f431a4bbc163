"""Progress bar of a run: simulated time, step size, drift; on a terminal only."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from srm_mbs.arrays import FloatArray
from srm_mbs.stepping.loop import Tick
from srm_mbs.systems.base import System

REFRESH = 0.1
"""Seconds between two updates; more often would slow the run."""


def progress_of(
    progress: bool | Tick, system: System, t_end: float
) -> AbstractContextManager[Tick | None]:
    """What the option ``progress`` asks for: the caller's own tick, a bar, or nothing."""
    if callable(progress):
        return nullcontext(progress)
    return progress_bar(system, t_end) if progress else nullcontext(None)


@contextmanager
def progress_bar(system: System, t_end: float) -> Iterator[Tick | None]:
    """A tick that draws a progress bar on standard error; None where that is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("simulating"),
        BarColumn(),
        TextColumn("t = {task.completed:.3f} / {task.total:.6g} s"),
        TextColumn("{task.fields[detail]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("run", total=t_end, detail="")
        last = 0.0

        def tick(t: float, h: float, state: FloatArray) -> None:
            nonlocal last
            now = time.perf_counter()
            if now - last < REFRESH and t < t_end:
                return
            last = now
            detail = f"h = {h:.2e} s"
            if system.has_constraints:
                detail += f"  drift = {system.closure_gap(t, state):.1e}"
            bar.update(task, completed=t, detail=detail)

        yield tick
