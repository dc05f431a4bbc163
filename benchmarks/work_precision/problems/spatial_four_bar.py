"""Spatial four-bar (RSSR): one spatial loop, two degrees of freedom, regular."""

from __future__ import annotations

import srm_mbs as srm
from benchmarks.work_precision.problems.base import Problem, state
from benchmarks.work_precision.trees import tree_of


def spatial_four_bar() -> Problem:
    """The bundled spatial_four_bar."""
    mechanism = lambda: srm.load("spatial_four_bar")  # noqa: E731
    return Problem(
        "spatial_four_bar",
        "Spatial four-bar with two ball joints, no singular configuration, 10 s",
        10.0,
        mechanism,
        lambda: tree_of(mechanism()),
        state,
        rates=5,
    )
