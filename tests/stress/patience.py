"""A limit to runs that crawl."""

from __future__ import annotations

from srm_mbs._typing import FloatArray


class Patience:
    """Progress callback that interrupts a run after ``most_steps`` steps, as Ctrl-C does."""

    def __init__(self, most_steps: int) -> None:
        self.steps, self.most_steps = 0, most_steps

    def __call__(self, t: float, h: float, state: FloatArray) -> None:
        self.steps += 1
        if self.steps >= self.most_steps:
            raise KeyboardInterrupt
