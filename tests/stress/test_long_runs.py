"""The thesis slider-crank over hundreds and thousands of singular passages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.integration.test_singular_passages import crank_at, error_at_end, run
from tests.support.slider_crank import PERIOD

pytestmark = [pytest.mark.stress, pytest.mark.timeout(600)]

TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
MEASURED = {
    "dop853": {1e-4: 1e-4, 1e-6: 4e-4, 1e-8: 4e-6, 1e-10: 4e-8},
    "dopr54": {1e-4: 0.28, 1e-6: 1.1e-2, 1e-8: 2.0e-4, 1e-10: 2.5e-6, 1e-12: 2.6e-8},
}
"""Errors of the research prototype at t = 1000 s; at most twice as much is allowed here."""


def off_the_branch(solution: srm.Solution, t: np.ndarray) -> float:
    """Largest departure from "the rod mirrors the crank", in angles and rates, at times ``t``."""
    q, v = solution(t)
    return float(max(np.abs(q[:, 1] + 2.0 * q[:, 0]).max(), np.abs(v[:, 1] + 2.0 * v[:, 0]).max()))


def check_passages(solution: srm.Solution, count: int) -> None:
    """Every passage is listed, and the motion is on its branch around and between all of them."""
    assert solution.success, solution.message
    found = np.array([crossing.time for crossing in solution.crossings])
    assert len(found) == count
    # A phase error of the run moves its passages: each is looked for in its own half period.
    expected = PERIOD / 4.0 + PERIOD / 2.0 * np.arange(count)
    assert np.abs(found - expected).max() < PERIOD / 4.0
    around = (found[:, None] + np.linspace(-0.05, 0.05, 11)).ravel()
    between = np.linspace(0.0, solution.t[-1], 4 * count)
    t = np.clip(np.concatenate([around, between]), 0.0, solution.t[-1])
    assert off_the_branch(solution, t) < 100.0 * max(solution.settings.rtol, 1e-8)


@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
def test_slider_crank_is_right_through_465_passages(
    tableau: str, tolerance: float, exact: dict[str, Any]
) -> None:
    solution = run("slider_crank", 1000.0, tableau, tolerance)
    check_passages(solution, 465)
    allowed = 2.0 * MEASURED[tableau].get(tolerance, np.inf)
    assert error_at_end(solution, *crank_at(exact, "1000")) <= allowed


def test_slider_crank_keeps_closures_and_energy_through_4655_passages(
    exact: dict[str, Any],
) -> None:
    """With dopr54, as the prototype; dop853 takes a third more evaluations and errs less."""
    solution = run("slider_crank", 10_000.0, "dopr54", 1e-9)
    assert solution.success
    assert np.abs(solution.q[:, 1] + 2.0 * solution.q[:, 0]).max() < 1e-6
    assert solution.drift[:, 0].max() <= 1e-12
    energy = solution.energy
    assert np.abs(energy - energy[0]).max() <= 5e-5
    assert error_at_end(solution, *crank_at(exact, "10000")) <= 2.0 * 3.6e-3
