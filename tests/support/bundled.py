"""Mechanisms, loaded once for all tests of a process, and runs that finish.

Tests that change how a mechanism is loaded call ``srm.load`` instead.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import pinocchio as pin

import srm_mbs as srm
from benchmarks.work_precision.problems import PROBLEMS
from benchmarks.work_precision.problems.base import Problem


@cache
def _loaded(name: str) -> tuple[srm.Mechanism, pin.Model]:
    mechanism = srm.load(name)
    return mechanism, mechanism.model.copy()


def load(name: str) -> srm.Mechanism:
    """``srm.load(name)``, shared."""
    mechanism, model = _loaded(name)
    assert mechanism.model == model, f"a test has changed {name!r}, which it shares with others"
    return mechanism


def finished(mechanism: srm.Mechanism, t_end: float, **options: Any) -> srm.Solution:
    """``srm.simulate``, which must succeed."""
    solution = srm.simulate(mechanism, t_end, **options)
    assert solution.success, solution.message
    return solution


@cache
def problem(name: str) -> Problem:
    """A problem of the benchmarks."""
    return PROBLEMS[name]()
