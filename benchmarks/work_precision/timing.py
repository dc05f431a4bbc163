"""CPU and wall time of repeated calls."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.work_precision import threads

REPEATS = 5


@dataclass(frozen=True)
class Times:
    """Seconds of every repeat, their least and their median."""

    least: float
    median: float
    all: tuple[float, ...]

    @classmethod
    def of(cls, seconds: list[float]) -> Times:
        return cls(min(seconds), statistics.median(seconds), tuple(seconds))


def once(call: Callable[[], Any]) -> tuple[float, float, Any]:
    """CPU seconds, wall seconds and result of one call."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return time.process_time() - cpu, time.perf_counter() - wall, result


def repeated(call: Callable[[], Any], repeats: int = REPEATS) -> tuple[Times, Times]:
    """CPU and wall times of ``repeats`` calls; garbage is collected in between, not during them."""
    cpu_times, wall_times = [], []
    for _ in range(repeats):
        gc.collect()
        cpu, wall, _ = once(call)
        threads.check(cpu, wall)
        cpu_times.append(cpu)
        wall_times.append(wall)
    return Times.of(cpu_times), Times.of(wall_times)
