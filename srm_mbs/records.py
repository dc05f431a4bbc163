"""What a run records about itself: work done, settings, and the steps that did not stand."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Statistics:
    """Work done by a run.

    Attributes
    ----------
    steps, rejected
        Accepted steps, and steps rejected for their error.
    placements, replaced
        Steps shortened in advance, and redone, so that no stage lies on a singular point.
    zone_steps
        Accepted steps with a stage so close to a singular configuration that rows were dropped.
    evaluations
        Evaluations of the equations of motion, the initial step's included.
    factorisations
        Factorisations of the constraint algebra; 0 for an open chain.
    wall_time
        Seconds.
    """

    steps: int
    rejected: int
    placements: int
    replaced: int
    zone_steps: int
    evaluations: int
    factorisations: int
    wall_time: float


@dataclass(frozen=True)
class Settings:
    """How a run was made; kept for saving and for reports."""

    method: str
    tableau: str
    rtol: float
    atol: tuple[float, ...]
    step: float | None
    controlled: bool
    placement: str = "automatic"
    singular_times: tuple[float, ...] = ()
    backend: str = "python"


_REPEATED = (
    *("t0", "method", "tableau", "first_step", "max_step", "events", "controller", "sample_time"),
    *("breakpoints", "placement", "singular_times", "backend"),
)
"""Options of a run that it takes to make it again; those of its start, its accuracy and its output
are elsewhere."""


@dataclass(frozen=True, eq=False)
class Request:
    """What a run was asked for, so that it can be made again with another accuracy.

    Attributes
    ----------
    t_end
        End that was asked for (s).
    options
        Options of :func:`srm_mbs.simulate`, without start, tolerances, step and output.
    lost
        What a saved run does not keep of them, in words.
    """

    t_end: float
    options: Mapping[str, Any]
    lost: tuple[str, ...] = ()

    @classmethod
    def of(cls, t_end: float, options: Mapping[str, Any]) -> Request:
        """From all options of ``simulate``."""
        return cls(t_end, {name: options[name] for name in _REPEATED})


ATTEMPT = np.dtype([("t", float), ("h", float), ("error_ratio", float), ("verdict", "U8")])
"""A step that did not stand: its start and length (s), error estimate over tolerance, and whether
it was ``"rejected"`` for its error or ``"replaced"`` because of a singular configuration."""


def attempt_array(attempts: Iterable[Any]) -> NDArray[np.void]:
    """The ``attempts`` of a run as a structured array (k,) of :data:`ATTEMPT`."""
    rows = [(a.t, a.h, a.error_ratio, a.verdict.value) for a in attempts]
    return np.array(rows, dtype=ATTEMPT)
