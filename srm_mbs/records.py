"""What a run records about itself: work done, settings, and the steps that did not stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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


ATTEMPT = np.dtype([("t", float), ("h", float), ("error_ratio", float), ("verdict", "U8")])
"""A step that did not stand: its start and length (s), error estimate over tolerance, and whether
it was ``"rejected"`` for its error or ``"replaced"`` because of a singular configuration."""
