"""Progress bars: of a run (simulated time, step size, drift), of a sweep; on a terminal only."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from srm_mbs.arrays import FloatArray
from srm_mbs.stepping.loop import Tick
from srm_mbs.systems.base import System

Counted = Callable[[int, int], object]
"""Told (done, total)."""
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
                detail += f"  drift = {system.closure_gap(t, state):.1e}"
            draw(t, detail)

        yield tick


@contextmanager
def counting(progress: bool | Counted, what: str, total: int) -> Iterator[Counted | None]:
    """What is told after each of ``total`` things: the caller's function, a bar, or nothing."""
    if callable(progress):
        yield progress
    elif not progress:
        yield None
    else:
        counted = f"{{task.completed:.0f}} / {{task.total:.0f}} {what}"
        with _bar("sweeping", counted, total) as draw:
            yield None if draw is None else lambda done, _: draw(done, "")
