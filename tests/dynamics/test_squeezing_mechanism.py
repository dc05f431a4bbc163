"""The bundled squeezing_mechanism against the published solution of the benchmark."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.mechanisms import start_terms

PUBLISHED: dict[str, Any] = json.loads(
    (Path(__file__).parents[1] / "data" / "public_benchmarks.json").read_text(encoding="utf-8")
)["andrews"]
ANGLES = [name.strip().lower() for name in PUBLISHED["order of q"].split(",")]
LOOPS = ("pin_k3", "pin_k4", "pin_k6")
T_END = PUBLISHED["t_end"]


@cache
def run(rtol: float, tableau: str = "dop853") -> srm.Solution:
    solution = srm.simulate(srm.load("squeezing_mechanism"), T_END, rtol=rtol, tableau=tableau)
    assert solution.success
    return solution


def end(solution: srm.Solution) -> np.ndarray:
    """The last angles in the published order."""
    return np.array([solution.joint(name)[0][-1] for name in ANGLES])


def test_it_is_assembled_where_the_benchmark_starts() -> None:
    mechanism = srm.load("squeezing_mechanism")
    start = [mechanism.q0[mechanism.joint(name).idx_q] for name in ANGLES]
    np.testing.assert_allclose(start, np.array(PUBLISHED["q0"], dtype=float), atol=1e-15)
    np.testing.assert_array_equal(mechanism.v0, 0.0)
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.redundant_rows == tuple(f"{loop}.y" for loop in LOOPS)
    assert mechanism.defaults.t_end == T_END


def test_the_initial_accelerations_are_the_published_ones() -> None:
    """The consistent initial values of the test set: beta'', Theta'', then zeros."""
    mechanism = srm.load("squeezing_mechanism")
    rate = start_terms(mechanism).rate()[mechanism.model.nv :]
    accelerations = {name: float(rate[mechanism.joint(name).idx_v]) for name in ANGLES}
    assert accelerations.pop("beta") == pytest.approx(14222.4439199541138705911625887, rel=1e-12)
    assert accelerations.pop("theta") == pytest.approx(-10666.8329399655854029433719415, rel=1e-12)
    np.testing.assert_allclose(list(accelerations.values()), 0.0, atol=1e-7)


@pytest.mark.parametrize(
    ("tableau", "rtol", "bound"),
    [("dop853", 1e-10, 2e-9), ("dopr54", 1e-10, 2e-9), ("dop853", 1e-6, 1e-6)],
)
def test_it_ends_in_the_published_configuration(tableau: str, rtol: float, bound: float) -> None:
    """The published digits are good to 1.4e-9."""
    expected = np.array(PUBLISHED["q_end"], dtype=float)
    assert np.abs(end(run(rtol, tableau)) - expected).max() < bound


def test_two_tolerances_agree_beyond_the_published_digits() -> None:
    assert np.abs(end(run(1e-10)) - end(run(1e-12))).max() < 1e-11


def test_its_multipliers_are_the_published_ones() -> None:
    """Forces of the rod's pin on each arm, x and z, are the benchmark's multipliers."""
    reactions = run(1e-12).reactions
    found = np.concatenate([reactions[loop][-1][[0, 2]] for loop in LOOPS])
    expected = np.array(PUBLISHED["lambda_end"], dtype=float)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    for loop in LOOPS:
        assert np.abs(reactions[loop][:, 1]).max() < 1e-11


def test_the_motor_s_work_is_the_change_of_energy() -> None:
    """Kinetic energy and that of the spring: 0.033 N m times the angle of the motor."""
    solution = run(1e-10)
    angle = solution.joint("beta")[0]
    work = PUBLISHED["mom"] * (angle - angle[0])
    assert np.abs(solution.energy - solution.energy[0] - work).max() < 1e-12 * work[-1]


def test_its_loops_stay_closed() -> None:
    solution = run(1e-10)
    assert solution.drift[:, 0].max() < 1e-15  # m
    assert solution.drift[:, 1].max() < 1e-11  # m/s
    assert not solution.crossings
