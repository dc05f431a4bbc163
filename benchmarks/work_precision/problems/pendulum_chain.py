"""Open chain of three bars: nothing to close."""

from __future__ import annotations

import srm_mbs as srm
from benchmarks.work_precision.problems.base import Problem, state
from benchmarks.work_precision.trees import tree_of


def pendulum_chain() -> Problem:
    """The bundled pendulum_chain."""
    mechanism = lambda: srm.load("pendulum_chain")  # noqa: E731
    return Problem(
        "pendulum_chain",
        "Open chain of three bars, 4 s",
        4.0,  # chaotic: later, no reference is accurate to 1e-10
        mechanism,
        lambda: tree_of(mechanism()),
        state,
        rates=3,
        planar=(0, 2),
        gains=(),
    )
