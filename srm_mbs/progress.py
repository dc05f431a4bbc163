"""Progress bar of a run: simulated time, step size, drift; on a terminal only."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from srm_mbs.arrays import FloatArray
from srm_mbs.stepping.loop import Tick
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem

REFRESH = 0.1
"""Seconds between two updates; more often would slow the run."""


@contextmanager
def progress_bar(system: OpenSystem | ClosedSystem, t_end: float) -> Iterator[Tick | None]:
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
                detail += f"  drift = {system.closure_gap(state):.1e}"
            bar.update(task, completed=t, detail=detail)

        yield tick
