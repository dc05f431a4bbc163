"""Four-bars that avoid their change points by the length of their coupler.

The reference is the closed form of their motion, without closures and without Pinocchio
(:mod:`tests.support.change_point`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.backends import on_both
from tests.support.change_point import CHANGE_POINTS, AlmostChangePoint

T_END = 5.0
OFFSETS = [sign * 10.0**-k for k in range(1, 13) for sign in (1, -1)]
GRID = [("kernel", d) for d in OFFSETS] + [("python", d) for d in OFFSETS[::5]]
"""The twin runs of the reference are slow, and compared step by step elsewhere."""


def check(name: str, d: float, rtol: float, backend: str) -> None:
    four_bar = AlmostChangePoint(*CHANGE_POINTS[name], d)
    solution = srm.simulate(
        four_bar.mechanism(), T_END, rtol=rtol, singular_tolerance=0.0, backend=backend
    )
    assert solution.success, solution.message
    assert four_bar.error(solution) < 1000.0 * rtol + 1e-9


@pytest.mark.parametrize("name", CHANGE_POINTS)
@pytest.mark.parametrize("d", [1e-2, -1e-5, 1e-8, -1e-11])
@pytest.mark.parametrize(
    ("rtol", "backend"),
    [pytest.param(1e-4, "python", marks=pytest.mark.stress), (1e-9, "kernel")],
)
def test_a_four_bar_next_to_its_change_point_follows_the_length_of_its_coupler(
    name: str, d: float, rtol: float, backend: str
) -> None:
    check(name, d, rtol, backend)


@pytest.mark.stress
@pytest.mark.parametrize("name", CHANGE_POINTS)
@pytest.mark.parametrize(("backend", "d"), GRID)
@pytest.mark.parametrize("rtol", [1e-4, 1e-6, 1e-9, 1e-12])
def test_couplers_of_any_difference_turn_the_corner(
    name: str, d: float, rtol: float, backend: str
) -> None:
    check(name, d, rtol, backend)


@pytest.mark.parametrize("name", CHANGE_POINTS)
@pytest.mark.parametrize("d", [1e-1, -1e-1, 1e-6, -1e-6])
def test_the_closed_form_closes_the_loop_and_its_rates_are_its_derivatives(
    name: str, d: float
) -> None:
    four_bar = AlmostChangePoint(*CHANGE_POINTS[name], d)
    p = np.linspace(0.1, 1.4, 14)
    angles, slopes = four_bar.motion(p)
    coupler = four_bar.coupler + d
    bars = zip((four_bar.crank, coupler, -four_bar.rocker), angles)
    end = sum(length * np.exp(1j * angle) for length, angle in bars)

    np.testing.assert_allclose(end, four_bar.ground, atol=1e-14)
    ahead, behind = (four_bar.motion(p + step)[0] for step in (1e-6, -1e-6))
    np.testing.assert_allclose((ahead - behind) / 2e-6, slopes, rtol=1e-6, atol=1e-6)


def test_a_four_bar_meets_its_change_points_several_times() -> None:
    for name in CHANGE_POINTS:
        four_bar = AlmostChangePoint(*CHANGE_POINTS[name], 1e-6)
        run = srm.simulate(four_bar.mechanism(), T_END, singular_tolerance=0.0)
        assert len(run.crossings) >= 8
        assert {passage.kind for passage in run.crossings} == {"avoided"}


@on_both
@pytest.mark.parametrize(
    ("name", "d", "rtol", "end"),
    [
        ("folded", -1e-11, 1e-4, 2.0 * np.pi),
        ("parallelogram", -5e-11, 1e-4, np.pi),
        ("parallelogram", -1e-7, 1e-6, np.pi),
        ("folded", -1e-9, 1e-6, 2.0 * np.pi),
        ("folded", -1e-10, 1e-8, 2.0 * np.pi),
    ],
)
def test_a_driven_crank_stops_at_its_dead_point_in_a_layer(
    name: str, d: float, rtol: float, end: float, backend: str
) -> None:
    """The crank of a shorter coupler cannot turn past its change point: there is nothing beyond."""
    ideal = AlmostChangePoint(*CHANGE_POINTS[name], d, start=1.3, speed=3.0).mechanism()
    mechanism = replace(ideal, drives=(srm.Drive(srm.ConstantSpeed(3.0), "crank"),))
    with pytest.warns(srm.SrmWarning, match="Stopped"):
        run = srm.simulate(mechanism, 2.0, rtol=rtol, singular_tolerance=0.0, backend=backend)
    assert run.q[-1, 0] == pytest.approx(end, abs=2.0 * np.sqrt(abs(d)))
    assert run.message.startswith("Stopped")
    assert "the drive 'crank' is at its dead point" in run.message
