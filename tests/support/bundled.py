"""Mechanisms, loaded once for all tests of a process: most of them only want to have one.

What a test patches while it loads is not in them: such tests call ``srm.load``.
"""

from __future__ import annotations

from functools import cache

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


@cache
def problem(name: str) -> Problem:
    """A problem of the benchmarks."""
    return PROBLEMS[name]()
