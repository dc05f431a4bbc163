"""Singular configurations passed slowly, touched, or passed twice in a row: sigma far from linear.

References: SciPy on the reduced equations, and motions that a controller makes exact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support import reduced, tangency, turning
from tests.support.backends import on_both
from tests.support.slider_crank import moving, off_branch

TOP = np.pi / 2.0
"""Crank angle of slider_crank at its upper singular configuration, an unstable equilibrium."""
TABLEAUS = pytest.mark.parametrize("tableau", ["dop853", "dopr54"])


@TABLEAUS
@pytest.mark.parametrize("rate", [1.0, 0.1, 0.01, 1e-3])
def test_slow_passages_follow_the_reduced_equation(tableau: str, rate: float) -> None:
    """``rate`` (rad/s) at the top, from 2 s before to 0.2 s after; deviations grow there by
    exp(1.36 t), and over this range by 20."""
    field = reduced.slider_crank()
    before, after, tol = 2.0, 0.2, 1e-10
    t = np.linspace(0.0, before + after, 45)
    back = solve_ivp(
        lambda t, y: [-x for x in field(t, y)],
        (0.0, before),
        [TOP, rate],
        "DOP853",
        rtol=3e-14,
        atol=1e-16,
    )
    start = back.y[:, -1]
    exact = solve_ivp(field, (0.0, t[-1]), start, "DOP853", t, rtol=3e-14, atol=1e-16)
    solution = srm.simulate(moving(*start), t[-1], rtol=tol, tableau=tableau)
    assert solution.success
    q, v = solution(t)
    assert np.abs(q[:, 0] - exact.y[0]).max() < 100.0 * tol
    assert np.abs(v[:, 0] - exact.y[1]).max() < 100.0 * tol
    assert off_branch(q) < 10.0 * tol
    crossing = solution.crossings[-1]
    assert abs(crossing.time - before) * rate < 100.0 * tol
    assert not crossing.switched
    assert solution.bifurcations == ()


SWING, FREQUENCY = 0.4, 2.0


def swung(reach: float, tableau: str, tol: float = 1e-8) -> tuple[srm.Solution, np.ndarray]:
    """slider_crank driven to crank = TOP + reach + SWING (-1 - cos(2 t)), so ``reach`` beyond the
    singular configuration and back, twice, and when it was there."""
    middle = TOP + reach - SWING

    def torque(t: float, q: Any, v: Any) -> list[float]:
        # (8/3 + 8 sin^2) a'' + 8 sin cos a'^2 + 2 g cos = torque, from the kinetic energy
        s, c = np.sin(q[0]), np.cos(q[0])
        wanted = SWING * FREQUENCY**2 * np.cos(FREQUENCY * t)
        return [
            (8.0 / 3.0 + 8.0 * s * s) * wanted + 8.0 * s * c * v[0] ** 2 + 2.0 * reduced.G * c,
            0.0,
        ]

    solution = srm.simulate(
        moving(middle - SWING, 0.0), 2.0 * np.pi, rtol=tol, tableau=tableau, controller=torque
    )
    assert solution.success
    t = np.linspace(0.0, 2.0 * np.pi, 161)
    q, v = solution(t)
    angle = middle - SWING * np.cos(FREQUENCY * t)
    rate = SWING * FREQUENCY * np.sin(FREQUENCY * t)
    error = np.maximum(np.abs(q[:, 0] - angle), np.abs(v[:, 0] - rate))
    assert off_branch(q) < 100.0 * tol
    return solution, error


@TABLEAUS
@pytest.mark.parametrize("reach", [0.3, 0.03, 0.01, 1e-3, 1e-4])
def test_a_motion_that_turns_back_beyond_passes_twice(tableau: str, reach: float) -> None:
    solution, error = swung(reach, tableau)
    assert error.max() < 1e-7
    half = np.arccos(1.0 - reach / SWING) / FREQUENCY
    exact = [turn + side * half for turn in (np.pi / 2, 3 * np.pi / 2) for side in (-1.0, 1.0)]
    found = [crossing.time for crossing in solution.crossings]
    assert len(found) == 4
    # where the motion turns, an error of the angle is one of time over the rate
    rate = np.sqrt(2.0 * SWING * reach) * FREQUENCY
    assert np.abs(np.array(found) - exact).max() < 1e-7 / rate
    assert not any(crossing.switched for crossing in solution.crossings)
    assert solution.bifurcations == ()


@TABLEAUS
@pytest.mark.parametrize("reach", [-0.1, -0.01, -1e-3, -1e-4])
def test_a_motion_that_turns_back_before_passes_nowhere(tableau: str, reach: float) -> None:
    solution, error = swung(reach, tableau)
    assert error.max() < 1e-7
    assert solution.crossings == ()
    assert solution.bifurcations == ()


@on_both
@pytest.mark.parametrize("reach", [1e-2, 1e-3, 1e-4, 1e-5, -1e-5, -1e-4, -1e-3, -1e-2])
def test_swings_pass_twice_where_they_turn_back_beyond_and_never_where_before(
    reach: float, backend: str
) -> None:
    """Both change points of the parallelogram, at the angles 0 and -pi of its crank."""
    motion, t_end = turning.lifted(reach), 6.0
    solution = srm.simulate(motion.mechanism, t_end, rtol=1e-9, backend=backend)
    assert solution.success
    start = [float(motion.mechanism.q0[0]), float(motion.mechanism.v0[0])]
    exact = solve_ivp(
        reduced.parallelogram(),
        (0.0, t_end),
        start,
        "DOP853",
        events=lambda t, y: np.sin(y[0]),
        max_step=1e-3,
        rtol=3e-14,
        atol=1e-16,
    )
    expected = exact.t_events[0]
    assert len(expected) == (10 if reach > 0.0 else 0)
    found = [crossing.time for crossing in solution.crossings]
    # where the motion turns, an error of the angle is one of time over the rate
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7 / np.sqrt(abs(reach)))
    assert {crossing.kind for crossing in solution.crossings} <= {"passed"}


@pytest.mark.parametrize("reach", [1e-3, 1e-4])
def test_a_run_that_an_event_ends_between_two_passages_has_the_first(reach: float) -> None:
    mechanism = turning.lifted(reach).mechanism
    first, second, *_ = srm.simulate(mechanism, 1.0, rtol=1e-9).crossings

    def halfway(t: float, q: Any, v: Any) -> float:
        return t - 0.5 * (first.time + second.time)

    cut = srm.simulate(mechanism, 1.0, rtol=1e-9, events=[srm.Event(halfway, terminal=True)])
    assert cut.status == "event"
    assert [crossing.time for crossing in cut.crossings] == pytest.approx([first.time], abs=1e-9)


@TABLEAUS
def test_a_motion_that_just_reaches_a_singular_configuration_says_so(tableau: str) -> None:
    """It comes to rest there, where nothing chooses a branch; it keeps the one it came along."""
    solution, error = swung(0.0, tableau)
    assert error.max() < 1e-5
    for time in (np.pi / 2, 3 * np.pi / 2):
        assert any(b.start - 0.01 < time < b.end + 0.01 for b in solution.bifurcations)
    assert not any(crossing.switched for crossing in solution.crossings)
    assert "momentum" in solution.message


END = 0.35


def touched(
    reach: float, tableau: str, tol: float = 1e-8, backend: str = "auto"
) -> tuple[srm.Solution, float]:
    """The mechanism of tests.support.tangency, and the error of its input angle."""
    mechanism = tangency.mechanism(reach)
    solution = srm.simulate(mechanism, END, rtol=tol, tableau=tableau, backend=backend)
    assert solution.success
    t = np.linspace(0.0, END, 36)[1:]
    q, _ = solution(t)
    assert np.abs(q[:, 3] + 2.0 * q[:, 2]).max() < 1e-10 + 1e-3 * tol
    return solution, float(np.abs(q[:, 0] - tangency.inputs(reach, t)).max())


@TABLEAUS
@pytest.mark.parametrize("reach", [0.05, 0.01, 1e-3])
def test_a_linkage_that_turns_just_beyond_passes_twice(tableau: str, reach: float) -> None:
    """At reach 1e-3 sigma stays below 1e-3 in between."""
    solution, error = touched(reach, tableau)
    assert error < 1e-7
    q, _ = solution(np.array([crossing.time for crossing in solution.crossings]))
    assert len(q) == 2
    assert np.abs(q[:, 2] - TOP).max() < 1e-6
    assert all(crossing.loops == ("slide",) for crossing in solution.crossings)
    assert not any(crossing.switched for crossing in solution.crossings)


@TABLEAUS
@pytest.mark.parametrize("reach", [-0.01, -1e-3, -1e-4])
def test_a_linkage_that_turns_just_before_passes_nowhere(tableau: str, reach: float) -> None:
    solution, error = touched(reach, tableau)
    assert error < 1e-7
    assert {crossing.kind for crossing in solution.crossings} <= {"avoided"}


ALL_TOLERANCES = [
    1e-6,
    1e-9,
    1e-12,
    *(pytest.param(x, marks=pytest.mark.stress) for x in (1e-5, 1e-8, 1e-10, 1e-11)),
]
BACKENDS = ["kernel", "python"]


@TABLEAUS
@pytest.mark.parametrize("tol", ALL_TOLERANCES)
def test_where_branches_touch_the_motion_stays_on_its_own(tableau: str, tol: float) -> None:
    """State and rates are the same on both branches; the smooth continuation is kept."""
    solution, error = touched(0.0, tableau, tol)
    assert error < 1e-10 + 100.0 * tol
    assert len(solution.crossings) == 1


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("tol", [1e-6, 1e-9, 1e-12])
@pytest.mark.parametrize("reach", [0.1, 1e-3, 1e-5, 1e-7, -1e-7, -1e-5, -1e-3, -0.01, -0.1])
@pytest.mark.stress
def test_errors_fall_with_the_tolerance_however_far_the_linkage_reaches(
    reach: float, tol: float, backend: str
) -> None:
    _, error = touched(reach, "dop853", tol, backend)
    assert error < 1e-10 + 100.0 * tol


FREEDOM = {
    "driven": (True, False),
    "driven, free": (True, True),
    "driven, ball joint": (True, True, True),
    "free": (False, True),
    "free, ball joint": (False, True, True),
}
REACHES = (0.0, 0.1, 1e-3, 1e-5, 1e-7, -1e-7, -1e-5, -1e-3, -0.1)


def touched_otherwise(freedom: str, reach: float, tol: float, backend: str) -> None:
    motion = tangency.moving(reach, *FREEDOM[freedom])
    solution = srm.simulate(motion.mechanism, motion.t_end, rtol=tol, backend=backend)
    assert motion.error(solution) < 1e-10 + 100.0 * tol


@pytest.mark.parametrize(
    ("freedom", "tol", "backend"),
    [
        ("driven", 1e-10, "python"),
        ("driven", 1e-10, "kernel"),
        ("driven, free", 1e-10, "kernel"),
        ("free", 1e-10, "kernel"),
        *(pytest.param(name, 1e-8, "python", marks=pytest.mark.stress) for name in FREEDOM),
    ],
)
def test_branches_of_driven_and_of_freer_linkages_touch(
    freedom: str, tol: float, backend: str
) -> None:
    touched_otherwise(freedom, 0.0, tol, backend)


@pytest.mark.stress
@pytest.mark.parametrize("freedom", FREEDOM)
@pytest.mark.parametrize("tol", [1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
@pytest.mark.parametrize("reach", REACHES)
def test_errors_of_driven_and_of_freer_linkages_fall_with_the_tolerance(
    reach: float, tol: float, freedom: str
) -> None:
    touched_otherwise(freedom, reach, tol, "kernel")


def test_kernel_and_reference_touch_alike() -> None:
    kernel, reference = (touched(0.0, "dop853", 1e-8, backend)[0] for backend in BACKENDS)
    assert kernel.stats.steps == reference.stats.steps
    np.testing.assert_allclose(kernel.q[-1], reference.q[-1], rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("longer", [1e-4, 1e-8, 1e-10, 1e-12])
def test_branches_that_almost_touch_are_none_of_this_mechanism(longer: float) -> None:
    """A rod that is longer than the crank keeps its side, the closer the faster it turns."""
    t, tol = np.linspace(0.0, END, 36)[1:], 1e-9
    solution = srm.simulate(tangency.mechanism(0.0, longer), END, rtol=tol, singular_tolerance=0.0)
    error = np.abs(solution(t)[0][:, 0] - tangency.inputs(0.0, t, longer)).max()
    assert error < 1e-10 + 100.0 * tol
    assert {crossing.kind for crossing in solution.crossings} <= {"avoided"}
