"""Branches through singular configurations: dead points, tangents, which branch a run keeps."""

from __future__ import annotations

import numpy as np
import pytest

import srm_mbs as srm
from tests import reduced
from tests.mechanisms import ball_dead_point


def after_ten_seconds() -> tuple[float, float]:
    angle, rate = reduced.integrate(reduced.spatial_dead_point(), [-np.pi / 6.0, 4.0], 10.0)
    return float(angle), float(rate)


@pytest.mark.parametrize(("tol", "bound"), [(1e-6, 1e-3), (1e-8, 2e-6)])
def test_the_crank_passes_its_spatial_dead_points_on_its_branch(tol: float, bound: float) -> None:
    solution = srm.simulate(srm.load("spatial_dead_point"), 10.0, rtol=tol, atol=tol)
    angle, rate = solution.joint("crank")
    expected, expected_rate = after_ten_seconds()
    assert angle[-1] - np.pi / 6.0 == pytest.approx(expected, abs=bound)
    assert rate[-1] == pytest.approx(expected_rate, abs=bound)
    assert len(solution.crossings) == 11


def test_dead_points_are_passed_with_a_ball_joint_too() -> None:
    solution = srm.simulate(ball_dead_point(), 10.0, rtol=1e-8, atol=1e-8)
    angle, rate = solution.joint("crank")
    expected, expected_rate = after_ten_seconds()
    assert angle[-1] == pytest.approx(expected, abs=2e-6)
    assert rate[-1] == pytest.approx(expected_rate, abs=2e-6)
