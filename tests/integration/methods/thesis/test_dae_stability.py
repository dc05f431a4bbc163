"""Sweeps of DAEs that do not damp their constraint errors: what the message says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.integration.methods.thesis.regularisation import real_stability_limit
from tests.support.daes import START_TWO, problem_two


def pendulum(sign: float = 1.0) -> srm.SemiExplicitDAE:
    """x = (p, v) of a point on a circle, constrained by p . v = 0: G B = |p|^2."""
    return srm.SemiExplicitDAE(
        f=lambda t, x: np.array([x[2], x[3], 0.0, -9.81]),
        B=lambda t, x: sign * np.array([0.0, 0.0, x[0], x[1]]),
        g=lambda t, x: x[0] * x[2] + x[1] * x[3],
        G=lambda t, x: np.array([x[2], x[3], x[0], x[1]]),
    )


def test_sweeps_that_become_unstable_far_from_singular_points_say_so() -> None:
    """|p| of the first sweep grows, since p . v = O(eps) there, until 2 |p|^4 is beyond 2.79."""
    method = srm.SRM("erk4", 4, eps="0.5h", T="transpose")
    solution = srm.solve_dae(pendulum(), (0.0, 5.0), [1.0, 0.0, 0.0, 0.0], method=method, step=5e-3)
    assert not solution.success
    assert "The sweeps are unstable" in solution.message
    assert "erk4 is stable up to 2.79" in solution.message
    assert "singular" not in solution.message


@pytest.mark.parametrize("T", ["identity", "transpose"])
@pytest.mark.parametrize("tableau", ["trap", "tvd32", "erk4"])
def test_the_limit_named_is_the_one_at_which_runs_turn_unstable(tableau: str, T: str) -> None:
    """A pendulum of length 2: G B = 4 at the start, so that G B T = 4 or 16."""
    size = {"identity": 4.0, "transpose": 16.0}[T]
    limit = real_stability_limit(srm.TABLEAUS[tableau])
    for factor, stable in ((0.7, True), (1.5, False)):
        method = srm.SRM(tableau, 1, eps=f"{size / (factor * limit):.6f}h", T=T)
        solution = srm.solve_dae(
            pendulum(), (0.0, 0.5), [2.0, 0.0, 0.0, 0.0], method=method, step=2e-3
        )
        assert solution.success is stable, solution.message
        assert ("The sweeps are unstable" in solution.message) is not stable


@pytest.mark.parametrize("options", [{"step": 0.01}, {"rtol": 1e-4, "atol": 1e-4}], ids=str)
def test_a_matrix_b_of_the_other_sign_is_named_as_the_cause(options: dict[str, Any]) -> None:
    """With T = I the terms in 1/eps then drive the sweeps away, whatever the step."""
    method = srm.SRM("tvd32", restart=True, carry=True)
    start = [1.0, 0.0, 0.0, 0.0]
    solution = srm.solve_dae(pendulum(-1.0), (0.0, 1.0), start, method=method, **options)
    assert not solution.success
    assert "G B has an eigenvalue of -1 (real part)" in solution.message
    mended = srm.SRM("tvd32", restart=True, carry=True, T="inverse")
    assert srm.solve_dae(pendulum(-1.0), (0.0, 1.0), start, method=mended, step=0.01).success


def test_unstable_sweeps_end_without_warnings() -> None:
    """Any warning is an error in these tests."""
    method = srm.SRM("erk4", 4, eps="0.5h", T="transpose")
    problem = problem_two(B=lambda t, x: 1e6 * x)
    solution = srm.solve_dae(problem, (0.0, 1.0), START_TWO, method=method, step=0.01)
    assert not solution.success
    assert "The sweeps are unstable" in solution.message


def test_messages_of_daes_do_not_speak_of_mechanisms() -> None:
    def blows_up(t: float, x: Any) -> np.ndarray:
        return np.array([0.0, 1.0 / max(0.5 - t, 0.0) ** 2 if t < 0.5 else np.inf])

    problem = srm.SemiExplicitDAE(
        f=blows_up,
        B=lambda t, x: np.array([1.0, 0.0]),
        g=lambda t, x: x[0],
        G=lambda t, x: np.array([1.0, 0.0]),
    )
    for options in ({}, {"step": 0.02}):
        solution = srm.solve_dae(problem, (0.0, 1.0), [0.0, 0.0], **options)
        assert not solution.success
        assert "solution.x[-1]" in solution.message
        assert "mechanism" not in solution.message
        assert "closures" not in solution.message


@pytest.mark.parametrize(
    ("tableau", "m", "limit"), [("tvd32", 3, 1.2), ("tvd32", 2, 1.4), ("dopr54", 3, 2.2)]
)
def test_carried_multipliers_are_stable_up_to_the_limits_of_the_docstring(
    tableau: str, m: int, limit: float
) -> None:
    for factor, stable in ((0.85, True), (1.25, False)):
        eps = f"{1.0 / (factor * limit):.6f}h"
        method = srm.SRM(tableau, m, restart=True, carry=True, T="inverse", eps=eps)
        solution = srm.solve_dae(
            pendulum(), (0.0, 4.0), [1.0, 0.0, 0.0, 0.0], method=method, step=0.02
        )
        assert solution.success is stable, solution.message
        assert ("a larger eps" in solution.message) is not stable
