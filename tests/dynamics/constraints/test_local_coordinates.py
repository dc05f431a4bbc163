"""Minimal coordinates next to singular configurations."""

from __future__ import annotations

import numpy as np
import pytest

from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.local_coordinates import TangentChart
from tests.support.bundled import load


@pytest.mark.parametrize("off", [0.0, 8e-15, -3e-14])
@pytest.mark.parametrize("tilt", [0.0, 1e-12])
def test_velocities_follow_the_branch_where_every_row_vanishes(off: float, tilt: float) -> None:
    """Crank and rod in line, the slider below the pivot: G is zero but for rounding."""
    mechanism = load("slider_crank")
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    q = np.array([1.5 * np.pi, -3.0 * np.pi + off])
    branch = np.array([-1.0, 2.0]) / np.sqrt(5.0)
    basis = branch + tilt * np.array([2.0, 1.0])
    chart = TangentChart(geometry, q, basis[:, None], np.arange(2))
    point = chart.point(np.zeros(1))
    assert point is not None
    np.testing.assert_allclose(point.velocities[:, 0], branch, rtol=0.0, atol=1e-11)
