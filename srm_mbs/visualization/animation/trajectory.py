"""What is there during which part of a run, whose events may change its closures and forces."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.simulation.result import SimulationResult

if TYPE_CHECKING:
    from srm_mbs.dynamics.mechanism import Mechanism
    from srm_mbs.model.closures import LoopClosure
    from srm_mbs.visualization.animation.joint_motion import Playable

Spans = tuple[tuple[float, float], ...]
"""Intervals of time (s), apart and in order: from the first to before the second."""
Thing = TypeVar("Thing")


def parts_of(solution: Playable) -> list[tuple[Mechanism, tuple[float, float]]]:
    """The mechanisms of a run in order, each with its interval of time (s)."""
    segments = solution.segments if isinstance(solution, SimulationResult) else (solution,)
    return [(segment.mechanism, segment.span) for segment in segments]


def spans_of(
    solution: Playable, things: Callable[[Mechanism], Iterable[Thing]]
) -> list[tuple[Thing, Spans | None]]:
    """``things`` of all mechanisms of a run, each once, with when they are there.

    Returns
    -------
    list of (thing, spans)
        In the order in which they come; None for what is there all the time.
    """
    parts = parts_of(solution)
    if len(parts) == 1:
        return [(thing, None) for thing in things(solution.mechanism)]
    found: list[tuple[Thing, list[tuple[float, float]]]] = []
    for mechanism, (start, end) in parts:
        for thing in things(mechanism):
            spans = next((own for other, own in found if other is thing or other == thing), None)
            if spans is None:
                spans = []
                found.append((thing, spans))
            if spans and spans[-1][1] == start:
                start_before, _ = spans.pop()
                spans.append((start_before, end))
            else:
                spans.append((start, end))
    whole = [(parts[0][1][0], parts[-1][1][1])]
    return [(thing, None if spans == whole else tuple(spans)) for thing, spans in found]


def loops_of(solution: Playable) -> list[tuple[LoopClosure, Spans | None]]:
    """The closures of a run, with when they are there."""
    return spans_of(solution, lambda mechanism: mechanism.loops)


def within(times: FloatArray, spans: Spans | None, end: float) -> BoolArray:
    """Which of ``times`` (n,) s are in ``spans``; a span up to ``end``, that of the run, has it."""
    if spans is None:
        return np.ones(len(times), dtype=bool)
    inside = np.zeros(len(times), dtype=bool)
    for first, last in spans:
        inside |= (first <= times) & ((times < last) | (last >= end))
    return inside
