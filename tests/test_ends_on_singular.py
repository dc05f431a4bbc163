"""Runs and grid points that end exactly on a singular configuration."""

from __future__ import annotations

import numpy as np
import pytest

import srm_mbs as srm
from tests import reduced

PERIOD = 4.29657624142677449


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
@pytest.mark.parametrize("tol", [1e-6, 1e-9])
@pytest.mark.parametrize("beside", [0.0, 1e-9, -1e-6, 1e-3])
def test_a_run_may_end_on_a_singular_configuration(tableau: str, tol: float, beside: float) -> None:
    t_end = PERIOD / 4.0 + beside
    solution = srm.simulate(srm.load("slider_crank"), t_end, tableau=tableau, rtol=tol, atol=tol)
    assert solution.success
    assert solution.stats.steps < 60
    theta, omega = reduced.integrate(reduced.slider_crank(), [7.0 * np.pi / 4.0, 0.0], t_end)
    assert abs(solution.q[-1, 0] - theta) < 5.0 * tol
    # Just before it dop853's last stages are solved for directly, with rounding over sigma^2.
    assert abs(solution.v[-1, 0] - omega) < (20.0 if beside == -1e-6 else 5.0) * tol


@pytest.mark.parametrize("tableau", ["erk4", "dopr54", "dop853"])
def test_a_grid_point_on_a_singular_configuration_is_stepped_over(tableau: str) -> None:
    step = PERIOD / 160.0
    solution = srm.simulate(srm.load("slider_crank"), PERIOD / 2.0, step=step, tableau=tableau)
    assert solution.success
    assert solution.stats.steps <= 82
    assert solution.steps.sigmas.min() > 1e-3
    assert np.abs(solution.q[:, 1] + 2.0 * solution.q[:, 0]).max() < 1e-9
    grid = step * np.arange(81)
    off = np.abs(solution.t[:, None] - grid).min(axis=1) > 1e-12
    assert off.sum() <= 2
