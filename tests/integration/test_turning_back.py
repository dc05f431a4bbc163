"""Motions that turn back, or are slow, next to a singular configuration: errors fall with rtol.

References: motions that drives prescribe, and SciPy on the reduced equations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.integration.control.placement import extreme_sigma
from srm_mbs.integration.methods.branch_nodes import BranchNodes
from tests.support import reduced, turning
from tests.support.backends import needs_kernel, on_both
from tests.support.bundled import load
from tests.support.lockstep import compare

REACHES = [side * 10.0**-k for side in (1.0, -1.0) for k in range(1, 8)] + [0.0]
FEW = [1e-3, -1e-5, 0.0]
TOLERANCES = (1e-4, 1e-6, 1e-9, 1e-12)
DRIVEN = (turning.driven, turning.driven_with_pendulum)


def check(motion: turning.Motion, rtol: float, **options: str) -> srm.Solution:
    solution = srm.simulate(motion.mechanism, motion.t_end, rtol=rtol, **options)
    assert motion.error(solution) < 1e-10 + 100.0 * rtol
    return solution


@on_both
@pytest.mark.parametrize("reach", FEW)
@pytest.mark.parametrize("make", DRIVEN)
def test_a_drive_turns_back_next_to_a_change_point(
    make: Callable[[float, float], turning.Motion], reach: float, backend: str
) -> None:
    for rtol in (1e-6, 1e-12):
        check(make(reach, 3.0), rtol, backend=backend)


@on_both
@pytest.mark.parametrize("reach", FEW)
def test_a_swing_turns_back_next_to_a_change_point(reach: float, backend: str) -> None:
    for rtol in (1e-6, 1e-12):
        check(turning.lifted(reach), rtol, backend=backend)


@on_both
@pytest.mark.parametrize(("reach", "rate"), [(1e-3, 10.0), (-1e-5, 1e-6)])
def test_a_mechanism_turns_back_while_its_base_moves(
    reach: float, rate: float, backend: str
) -> None:
    for rtol in (1e-6, 1e-12):
        check(turning.on_a_cart(reach, rate), rtol, backend=backend)


@on_both
@pytest.mark.parametrize(
    ("beside", "rate"), [(1e-2, 0.0), (-1e-4, 1e-6), (1e-7, 0.0), (0.0, 1e-6), (1e-3, 1e-2)]
)
def test_a_slow_motion_passes_a_singular_configuration_or_turns_before_it(
    beside: float, rate: float, backend: str
) -> None:
    for rtol in (1e-6, 1e-12):
        check(turning.slow(beside, rate), rtol, backend=backend)


def test_steps_that_end_next_to_a_slow_turn_do_not_spoil_the_output_there() -> None:
    """Roundings of the start decide how near to the turn a step ends."""
    motion = turning.slow(1e-6, 1e-2)
    start = motion.mechanism
    for roundings in range(-15, 16, 2):
        q = start.q0 * (1.0 + roundings * np.finfo(float).eps)
        check(replace(motion, mechanism=start.with_state(q, start.v0)), 1e-12)


@on_both
@pytest.mark.parametrize(("amplitude", "rate"), [(1e-4, 0.0), (0.0, 1e-4), (1e-7, 0.0)])
def test_small_swings_about_a_singular_configuration_start_and_have_momentum_enough(
    amplitude: float, rate: float, backend: str
) -> None:
    motion = turning.hanging(amplitude, rate)
    for rtol in (1e-4, 1e-8, 1e-12) if backend == "kernel" else (1e-8,):
        solution = check(motion, rtol, backend=backend)
        if amplitude != 1e-7:
            assert solution.bifurcations == ()


def test_a_motion_that_turns_back_on_a_singular_configuration_says_so_at_every_tolerance() -> None:
    for rtol in TOLERANCES:
        solution = check(turning.lifted(0.0), rtol)
        assert len(solution.bifurcations) >= 1
        assert "turned back next to a singular configuration" in solution.message
        assert check(turning.lifted(-1e-3), rtol).bifurcations == ()


def test_fixed_steps_start_at_rest_next_to_a_singular_configuration() -> None:
    motion = turning.hanging(1e-4, 0.0)
    solution = srm.simulate(motion.mechanism, motion.t_end, step=0.05, tableau="dop853")
    assert motion.error(solution) < 1e-10


@needs_kernel
@pytest.mark.parametrize("motion", [turning.driven_with_pendulum(1e-5, 3.0), turning.lifted(-1e-4)])
def test_the_kernel_turns_back_as_the_reference_does(motion: turning.Motion) -> None:
    found = compare(motion.mechanism, motion.t_end, rtol=1e-9)
    assert found.decisions == []
    assert found.zones == 0
    assert max(found.state, found.near) < 1e-11
    assert max(found.h, found.sigma) < 1e-9


@pytest.mark.parametrize("angle", [1e-3, 1e-5, -1e-8, 0.0])
def test_nodes_solve_where_nothing_can_be_solved_for(angle: float) -> None:
    """At crank angle ``angle`` with 2 rad/s: (8/9) a'' = -g cos(a), moved off the branch."""
    system = ClosedSystem(load("parallelogram"))
    nodes = BranchNodes(system)
    before = np.concatenate([0.01 * turning.ALIKE, 2.0 * turning.ALIKE])
    away = nodes.find_direction(0.0, before)
    assert away is not None
    assert len(away) == 1
    exact = np.concatenate([angle * turning.ALIKE, 2.0 * turning.ALIKE])
    off = 1e-6 * np.array([0.0, 0.0, 1.0, 0.0, 1.0, 0.0])
    assert nodes.solve(0.0, exact + off, away[0])
    acceleration = reduced.parallelogram()(0.0, [nodes.state[0], nodes.state[3]])[1]
    np.testing.assert_allclose(nodes.state[:3], nodes.state[0] * turning.ALIKE, atol=1e-13)
    np.testing.assert_allclose(nodes.state[3:], nodes.state[3] * turning.ALIKE, atol=1e-11)
    np.testing.assert_allclose(nodes.rate[3:], acceleration * turning.ALIKE, atol=1e-10)
    np.testing.assert_allclose(nodes.state, exact, atol=2e-6)


def test_a_motion_turns_back_where_the_extreme_of_sigma_is_small() -> None:
    """sigma = |s|, s a parabola of the time with its extreme at 0.3, 0.5 or 2 steps."""
    c = np.array([0.0, 0.1, 0.3, 0.45, 0.7, 0.9, 1.0])
    for extreme, at in product((0.01, 0.0, -0.01, -0.3), (0.3, 0.5, 2.0)):
        s = extreme + 0.4 * (c - at) ** 2
        expected = extreme if s[0] >= 0.0 else -extreme
        assert extreme_sigma(c, 3, np.abs(s)) == pytest.approx(expected, abs=1e-12)
    assert abs(extreme_sigma(c, 3, np.abs(0.5 - c))) > 1e3
    # two loops that pass, one after the other
    assert extreme_sigma(c, 3, np.minimum(np.abs(0.3 - c), np.abs(0.8 - c))) == np.inf


# --- the whole grid -------------------------------------------------------------------------------


@pytest.mark.stress
@pytest.mark.parametrize("tableau", ["dop853", "dopr54"])
@pytest.mark.parametrize("rate", [10.0, 1.0, 0.1, 1e-2])
def test_driven_motions_turn_back_anywhere(rate: float, tableau: str) -> None:
    for reach, rtol in product(REACHES, TOLERANCES):
        check(turning.driven(reach, rate), rtol, tableau=tableau)


@pytest.mark.stress
@pytest.mark.parametrize("tableau", ["dop853", "dopr54"])
@pytest.mark.parametrize("rate", [10.0, 3.0, 1.0])
def test_driven_motions_with_further_freedom_turn_back_anywhere(rate: float, tableau: str) -> None:
    for reach, rtol in product(REACHES, TOLERANCES):
        check(turning.driven_with_pendulum(reach, rate), rtol, tableau=tableau)


@pytest.mark.stress
@pytest.mark.parametrize("tableau", ["dop853", "dopr54"])
def test_swings_turn_back_anywhere(tableau: str) -> None:
    for reach, rtol in product(REACHES, TOLERANCES):
        check(turning.lifted(reach), rtol, tableau=tableau)


@pytest.mark.stress
@pytest.mark.parametrize("tableau", ["dop853", "dopr54"])
@pytest.mark.parametrize("rate", [10.0, 1.0, 1e-2, 1e-4, 1e-6])
def test_mechanisms_turn_back_anywhere_while_their_base_moves(rate: float, tableau: str) -> None:
    for reach, rtol in product(REACHES, TOLERANCES):
        check(turning.on_a_cart(reach, rate), rtol, tableau=tableau)


@pytest.mark.stress
@pytest.mark.parametrize("tableau", ["dop853", "dopr54"])
@pytest.mark.parametrize("rate", [10.0, 1.0, 1e-2, 1e-4, 1e-6, 0.0])
def test_slow_motions_are_right_anywhere(rate: float, tableau: str) -> None:
    if rate == 1.0 and tableau == "dopr54":
        pytest.skip("passages with momentum: at rtol = 1e-4 the instability magnifies their errors")
    for beside, rtol in product(REACHES, TOLERANCES):
        if rate != 0.0 or beside != 0.0:  # else at rest in the equilibrium, on all branches
            check(turning.slow(beside, rate), rtol, tableau=tableau)


@on_both
@pytest.mark.parametrize("singular_tolerance", [1e-9, 0.0])
@pytest.mark.parametrize("joint", ["crank", "rocker"])
@pytest.mark.parametrize("rtol", [1e-6, 1e-9])
def test_equal_bars_that_a_drive_turns_back_have_no_residual(
    backend: str, joint: str, rtol: float, singular_tolerance: float
) -> None:
    """The drive turns back on the change point: Newton's steps for the critical configuration
    only halve the distance there, and end far from it."""
    start = np.array([1.0, -1.0, 1.0])
    driven = replace(load("parallelogram"), drives=(srm.Drive(srm.Sine(1.0, omega=3.0), joint),))
    driven = driven.with_state(start, 3.0 * start)

    run = srm.simulate(
        driven, 2.0, rtol=rtol, singular_tolerance=singular_tolerance, backend=backend
    )

    assert np.abs(run.q - np.outer(1.0 + np.sin(3.0 * run.t), start)).max() < 1e-8
    assert "residual" not in run.message
    assert "turned back" in run.message
    assert " 0 branches" not in run.message


@on_both
def test_each_turn_of_a_drive_short_of_a_change_point_is_listed_as_avoided(backend: str) -> None:
    """Next to the turn the law bends in time far more than where the search begins.  The residual
    is quadratic in the distance that the drive leaves."""
    residuals = []
    for reach in (-1e-3, -1e-2):
        motion = turning.driven(reach, 1.0)
        run = srm.simulate(motion.mechanism, 6.0 * motion.t_end, rtol=1e-4, backend=backend)
        turns = [passage.time / motion.t_end for passage in run.crossings]
        np.testing.assert_allclose(turns, np.arange(6) + 0.5, atol=1e-4)
        assert {passage.kind for passage in run.crossings} == {"avoided"}
        sizes = [passage.residual for passage in run.crossings]
        np.testing.assert_allclose(sizes, sizes[0], rtol=1e-6)
        residuals.append(sizes[0])
    assert residuals[1] == pytest.approx(100.0 * residuals[0], rel=0.01)
