"""How fast a page plays a run, against the clock of this process, on a machine that may be busy.

A frame may come late by any time: the page and this process are two of many. So the time of the
run is read where the page's animation advances it, between two readings of the page's clock, and
the page's clock is compared with that of this process between two readings of the latter. What is
asserted then holds however long the pauses between the readings are.
"""

from __future__ import annotations

import time
from itertools import pairwise
from typing import Any

PACE = 0.02
RESOLUTION = 2e-4
"""Seconds: browsers round their clock to 0.1 ms."""

# [clock before, clock after, time of the run] of every frame while the run is played.
RECORD = """async seconds => {
  const animator = viewer.animator, frames = [];
  const update = animator.update;
  animator.update = function () {
    const before = performance.now();
    update.call(this);
    frames.push([before / 1000, performance.now() / 1000, this.time]);
  };
  if (!animator.playing) document.getElementById("toggle").click();
  const until = performance.now() + 1000 * seconds;
  while (performance.now() < until || frames.length < 4)
    await new Promise(resolve => setTimeout(resolve, Math.max(until - performance.now(), 20)));
  document.getElementById("toggle").click();
  delete animator.update;
  return [frames, animator.duration];
}"""


def _clocks(page: Any) -> tuple[float, float, float]:
    """The page's clock, and two readings of this process's clock around it, as close as can be."""
    readings = []
    for _ in range(10):
        before = time.perf_counter()
        there = page.evaluate("performance.now() / 1000")
        readings.append((time.perf_counter() - before, there, before))
    width, there, before = min(readings)
    return there, before, before + width


def play_and_time(page: Any, seconds: float) -> tuple[float, float, float]:
    """Play for about ``seconds``: the time of the run, and the least and most it took by the clock.

    A run that starts again at its end goes on being counted.
    """
    there, before, after = _clocks(page)
    frames, duration = page.evaluate(RECORD, seconds)
    there_end, before_end, after_end = _clocks(page)
    elapsed = there_end - there
    assert before_end - after - RESOLUTION <= elapsed <= after_end - before + RESOLUTION
    # The first frame only starts the animation's clock.
    frames = frames[1:]
    (first_before, first_after, first), (last_before, last_after, last) = frames[0], frames[-1]
    assert last_after - first_before > 0.5 * seconds
    restarts = sum(b[2] < a[2] for a, b in pairwise(frames))
    return last - first + restarts * duration, last_before - first_after, last_after - first_before


def assert_pace(page: Any, seconds: float, speed: float = 1.0) -> float:
    """The page plays at ``speed`` to 2 %; returns the time of the run that was played (s)."""
    played, least, most = play_and_time(page, seconds)
    assert (1.0 - PACE) * speed * least <= played <= (1.0 + PACE) * speed * most
    return played
