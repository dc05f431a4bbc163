"""Random starts whose motion passes singular configurations: the right branch, every time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from tests.support import reduced

pytestmark = [pytest.mark.stress, pytest.mark.timeout(300)]

STARTS = 50
TIMES = np.linspace(0.0, 10.0, 401)
ON_THE_BRANCH = 1e-5
"""Largest departure from the joint angles and rates that the right branch has (rad, rad/s)."""


@dataclass(frozen=True)
class Case:
    """A bundled mechanism whose configuration follows from its crank angle.

    Attributes
    ----------
    name, crank
        The mechanism and its crank joint.
    field
        The reduced equations of (theta, omega).
    followers
        Ratio of each joint's angle to the crank's on the right branch, in joint order.
    singular
        Function of theta that vanishes at the singular configurations.
    fastest
        Largest initial |omega| (rad/s): slow swings and full turns both occur.
    """

    name: str
    crank: str
    field: reduced.Field
    followers: dict[str, float]
    singular: np.ufunc
    fastest: float


CASES = (
    Case("slider_crank", "crank", reduced.slider_crank(), {"crank": 1.0, "rod": -2.0}, np.cos, 6.0),
    Case(
        "parallelogram",
        "crank",
        reduced.parallelogram(),
        {"crank": 1.0, "coupler": -1.0, "rocker": 1.0},
        np.sin,
        8.0,
    ),
    Case(
        "n_four_bar_2",
        "crank_0",
        reduced.n_four_bar(2),
        {"crank_0": 1, "coupler_0": -1, "crank_1": 1, "coupler_1": -1, "crank_2": 1},
        np.sin,
        8.0,
    ),
)


def starts(case: Case) -> Iterator[tuple[list[float], FloatArray]]:
    """(theta, omega) at the start and (k, 2) at ``TIMES``, of motions with a singular passage."""
    rng = np.random.default_rng(2001)
    found = 0
    while found < STARTS:
        start = [rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-case.fastest, case.fastest)]
        exact = reduced.trajectory(case.field, start, TIMES)
        side = np.sign(case.singular(exact[:, 0]))
        if (side[1:] != side[:-1]).any():
            found += 1
            yield start, exact


def largest_errors(
    case: Case, mechanism: srm.Mechanism, start: list[float], exact: FloatArray, tableau: str
) -> tuple[float, float]:
    """Largest error of angles and rates against ``exact``, and distance from the right branch."""
    theta, omega = start
    ratio = np.array([case.followers[name] for name in mechanism.joint_names])
    q0, v0 = theta * ratio, omega * ratio
    solution = srm.simulate(
        mechanism, TIMES[-1], q0=q0, v0=v0, tableau=tableau, rtol=1e-8, atol=1e-8, t_eval=TIMES
    )
    assert solution.success, solution.message
    crank = mechanism.joint_names.index(case.crank)
    q, v = solution.q, solution.v
    error = max(np.abs(q[:, crank] - exact[:, 0]).max(), np.abs(v[:, crank] - exact[:, 1]).max())
    off = max(
        np.abs(q - q[:, [crank]] * ratio).max(),
        np.abs(v - v[:, [crank]] * ratio).max(),
    )
    return float(error), float(off)


# dopr54 at the same tolerance is about a hundred times less accurate on these problems.
@pytest.mark.parametrize(("tableau", "bound"), [("dop853", 1e-5), ("dopr54", 1e-4)])
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_fifty_random_starts_stay_on_their_branch(case: Case, tableau: str, bound: float) -> None:
    mechanism = srm.load(case.name)
    wrong = []
    for start, exact in starts(case):
        error, off = largest_errors(case, mechanism, start, exact, tableau)
        if not (error <= bound and off <= ON_THE_BRANCH):
            wrong.append(f"theta, omega = {start}: error {error:.1e}, off its branch {off:.1e}")
    assert not wrong, f"{len(wrong)} of {STARTS}:\n" + "\n".join(wrong)
