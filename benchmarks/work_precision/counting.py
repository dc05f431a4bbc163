"""Which setting counts for an accuracy level, and what it costs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

LEVELS = (1e-3, 1e-6, 1e-9)


@dataclass(frozen=True)
class Point:
    """One setting of a sweep.

    ``tightness`` orders a sweep: the tolerance or the step, smaller is tighter.  ``error`` is None
    where the run failed.  ``record`` is what the point was made from.
    """

    tightness: float
    error: float | None
    cost: float
    record: Any = None


def reaches(point: Point, level: float) -> bool:
    """Whether the error is finite and within ``level``."""
    return point.error is not None and point.error <= level


def counting(sweep: Iterable[Point], level: float) -> list[Point]:
    """The points that count: each, and every tighter one, reaches ``level``; tightest first.

    A user who picks a setting cannot know that a looser one was lucky.
    """
    out: list[Point] = []
    for point in sorted(sweep, key=lambda point: point.tightness):
        if not reaches(point, level):
            break
        out.append(point)
    return out


def cheapest(sweep: Sequence[Point], level: float) -> Point | None:
    """The counting point of least cost; None if none counts."""
    points = counting(sweep, level)
    return min(points, key=lambda point: point.cost) if points else None
