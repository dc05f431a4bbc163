"""Mechanisms, loaded once for all tests of a process, and runs that finish.

Tests that change how a mechanism is loaded call ``srm.load`` instead.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
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


def rewritten(
    folder: Path, name: str, *changes: tuple[str, str], urdf: tuple[tuple[str, str], ...] = ()
) -> Path:
    """Path of a bundled description in ``folder``, with its URDF, both with texts replaced."""
    source = load(name).source
    assert source is not None
    texts = {}
    for suffix, text, pairs in (
        ("urdf", source.urdf, urdf),
        ("toml", source.description, ((f"../urdf/{name}", name), *changes)),
    ):
        for old, new in pairs:
            assert old in text, f"{old!r} is not in the text to be changed"
            text = text.replace(old, new)
        texts[suffix] = folder / f"{name}.{suffix}"
        texts[suffix].write_text(text, encoding="utf-8")
    return texts["toml"]


@cache
def problem(name: str) -> Problem:
    """A problem of the benchmarks."""
    return PROBLEMS[name]()
