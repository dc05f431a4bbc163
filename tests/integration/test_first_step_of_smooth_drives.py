"""Drives that move smoothly from rest to rest: the step that leaves it sees the motion.

Those of tvd32 lie at the start, the middle and the end of a step, where the acceleration of
MinimumJerk is zero.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.backends import on_both

TARGET, DURATION = 0.05, 1.0


def ramp(t: float) -> float:
    """The motion of a MinimumJerk from 0 to TARGET over DURATION (Flash and Hogan 1985)."""
    s = min(t / DURATION, 1.0)
    return TARGET * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def check(name: str, tableau: str, begin: float, end: float, backend: str) -> None:
    """Compare the run to ``end`` (s) of a ramp that begins at ``begin`` (s)."""
    mechanism = srm.load(name)
    start = mechanism.q0[mechanism.joint("crank").idx_q]
    drive = srm.Drive(srm.MinimumJerk(start + TARGET, DURATION, start=begin), "crank")
    driven = replace(mechanism, drives=(drive,), v0=np.zeros(mechanism.model.nv))
    run = srm.simulate(driven, end, tableau=tableau, rtol=1e-4, backend=backend)
    assert run.success, run.message
    times = begin + np.linspace(0.0, DURATION, 9)
    moved = run.at(times).joint("crank")[0] - start
    assert np.abs(moved - [ramp(t - begin) for t in times]).max() < 2e-4


@on_both
@pytest.mark.parametrize("end", [DURATION, 40.0])
@pytest.mark.parametrize("tableau", ["tvd32", "dopr54"])
@pytest.mark.parametrize("name", ["watt_six_bar", "four_bar"])
def test_a_ramp_from_rest_is_followed(name: str, tableau: str, end: float, backend: str) -> None:
    check(name, tableau, 0.0, end, backend)


@on_both
@pytest.mark.parametrize("begin", [0.5, 20.0])
@pytest.mark.parametrize("tableau", ["tvd32", "dop853"])
@pytest.mark.parametrize("name", ["watt_six_bar", "four_bar"])
def test_a_ramp_that_begins_later_is_followed(
    name: str, tableau: str, begin: float, backend: str
) -> None:
    check(name, tableau, begin, begin + 3.0, backend)
