"""The same mechanism in other units takes the same steps."""

from __future__ import annotations

import numpy as np
import pytest

import srm_mbs as srm
from tests.mechanisms import rescaled

# Powers of four scale every quantity, square roots included, without rounding.
EXACT = [{"length": 4.0**5}, {"mass": 4.0**5}, {"time": 4.0}, {"length": 4.0**-4, "time": 16.0}]
ROUNDED = [{"length": 1000.0}, {"length": 1e-3}, {"mass": 1e3}, {"time": 10.0}, {"time": 1e-2}]


def relative_times(solution: srm.Solution, scale: dict[str, float]) -> np.ndarray:
    return solution.t / scale.get("time", 1.0)


@pytest.mark.parametrize("scale", EXACT, ids=str)
@pytest.mark.parametrize("tableau", ["dop853", "dopr54"])
@pytest.mark.parametrize("name", ["slider_crank", "slider_crank_slider", "pendulum_chain"])
def test_rescaling_without_rounding_repeats_every_step(
    name: str, tableau: str, scale: dict[str, float]
) -> None:
    mechanism = srm.load(name)
    plain = srm.simulate(mechanism, 5.0, rtol=1e-7, tableau=tableau)
    time = scale.get("time", 1.0)
    scaled = srm.simulate(rescaled(mechanism, **scale), 5.0 * time, rtol=1e-7, tableau=tableau)
    assert np.array_equal(relative_times(scaled, scale), plain.t)
    assert scaled.stats.evaluations == plain.stats.evaluations


@pytest.mark.parametrize("scale", ROUNDED, ids=str)
@pytest.mark.parametrize("name", ["four_bar", "pendulum_chain", "slider_crank_regular"])
def test_rescaling_with_rounding_takes_the_same_steps_on_regular_mechanisms(
    name: str, scale: dict[str, float]
) -> None:
    mechanism = srm.load(name)
    plain = srm.simulate(mechanism, 5.0, rtol=1e-7)
    time = scale.get("time", 1.0)
    scaled = srm.simulate(rescaled(mechanism, **scale), 5.0 * time, rtol=1e-7)
    assert len(scaled.t) == len(plain.t)
    assert np.allclose(relative_times(scaled, scale), plain.t, rtol=1e-4)


@pytest.mark.parametrize("scale", ROUNDED, ids=str)
def test_singular_passages_are_the_same_in_other_units(scale: dict[str, float]) -> None:
    """Rounding next to a singular configuration changes single steps, not what happens."""
    mechanism = srm.load("slider_crank_slider")
    time = scale.get("time", 1.0)
    scaled = srm.simulate(rescaled(mechanism, **scale), 20.0 * time, rtol=1e-7)
    plain = srm.simulate(mechanism, 20.0, rtol=1e-7)
    assert scaled.success
    assert len(scaled.crossings) == len(plain.crossings)
    assert scaled.stats.evaluations == pytest.approx(plain.stats.evaluations, rel=0.15)
    assert scaled.joint("crank")[0][-1] == pytest.approx(plain.joint("crank")[0][-1], abs=1e-5)
