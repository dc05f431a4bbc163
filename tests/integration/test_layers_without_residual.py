"""Layers whose residual counts as zero (``singular_tolerance``): motions go straight through them.

The reference is the four-bar whose bars fit exactly, on one of the branches that cross, in closed
form (:class:`tests.support.change_point.StraightOn`).  The place in a layer is known to its width.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.integration.test_almost_singular import slider_crank
from tests.support import reduced
from tests.support.backends import needs_kernel, on_both
from tests.support.change_point import CHANGE_POINTS, AlmostChangePoint, StraightOn, turned

SPEED = 10.0


def four_bar(name: str, d: float, start: float = -0.3, speed: float = SPEED) -> srm.Mechanism:
    return AlmostChangePoint(*CHANGE_POINTS[name], d, start=start, speed=speed).mechanism()


def straight(name: str, mechanism: srm.Mechanism, t: float) -> tuple[Any, Any]:
    """q and v at t, from the start of the mechanism straight on."""
    q, v = mechanism.q0, mechanism.v0
    motion, p = StraightOn.of(name, q), float(turned(q[0]))
    kinetic = 0.5 * float(motion.energies(np.array(p))[0]) * v[0] ** 2
    return motion.after(p, kinetic, float(np.sign(v[0])), t)


def assert_ends(run: srm.Solution, exact: tuple[Any, Any], error: float) -> None:
    assert run.success, run.message
    assert np.abs(turned(run.q[-1] - exact[0])).max() < error
    assert np.abs(run.v[-1] - exact[1]).max() < SPEED * error


@on_both
@pytest.mark.parametrize(
    ("name", "d", "rtol", "start", "speed"),
    [
        ("folded", 3e-10, 1e-6, -0.3, 10.0),
        ("folded", 4.8e-10, 7.3e-7, -0.419, 8.91),
        ("parallelogram", -1.1e-10, 2.5e-7, -0.338, 12.37),
        ("parallelogram", 2.92e-10, 5.9e-7, -0.279, 9.47),
        ("folded", 1e-13, 1e-10, -0.3, 10.0),
        ("folded", -3e-14, 1e-12, -0.3, 10.0),
    ],
)
def test_a_residual_that_counts_as_zero_is_passed_straight_at_a_low_price(
    name: str, d: float, rtol: float, start: float, speed: float, backend: str
) -> None:
    mechanism = four_bar(name, d, start, speed)
    t_end = 1.6 * abs(start) / speed

    run = srm.simulate(mechanism, t_end, rtol=rtol, backend=backend)

    assert_ends(run, straight(name, mechanism, t_end), 100.0 * rtol + 3.0 * np.sqrt(abs(d)))
    assert run.stats.evaluations < 200


@pytest.mark.stress
@needs_kernel
@pytest.mark.parametrize("seed", range(10))
def test_layers_of_any_width_are_passed_straight_at_any_tolerance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for name in 15 * list(CHANGE_POINTS):
        d, rtol = (
            rng.choice([-1.0, 1.0]) * 10 ** rng.uniform(-14.5, -9.3),
            10 ** rng.uniform(-9, -3),
        )
        start, speed = -rng.uniform(0.1, 0.5), rng.uniform(5.0, 15.0)
        mechanism, t_end = four_bar(name, d, start, speed), 1.6 * abs(start) / speed
        run = srm.simulate(mechanism, t_end, rtol=rtol)
        exact = straight(name, mechanism, t_end)
        assert_ends(run, exact, 100.0 * rtol + 10.0 * np.sqrt(abs(d)))


def on_its_curve(
    name: str, d: float, place: float, heading: float, speed: float = SPEED
) -> tuple[srm.Mechanism, float]:
    """A start in the layer, ``place`` times its width from the middle, towards ``heading``, and
    its kinetic energy (J)."""
    almost = AlmostChangePoint(*CHANGE_POINTS[name], d)
    kappa, lam = almost.levels
    width = np.sqrt(4.0 * abs(kappa) / almost.products[0])
    p = place * width
    if kappa < 0.0:
        p = 0.5 * np.pi + 0.5 * p
    elif lam < 0.0:
        ratio = np.sqrt(almost.products[0] / (almost.products[1] - kappa))
        p = float(np.arcsin(ratio * np.sin(0.5 * p)))
    angles, slopes = almost.motion(np.array(p))
    rate = heading * speed / np.abs(slopes).max()
    q, v = (np.array([x[0], x[1] - x[0], x[2]]) for x in (angles, rate * slopes))
    kinetic = 0.5 * float(almost.energies(np.array(p))[0]) * rate**2
    return almost.mechanism().with_state(q, v), kinetic


@on_both
@pytest.mark.parametrize("name", CHANGE_POINTS)
@pytest.mark.parametrize(
    ("d", "rtol", "place"),
    [(1e-10, 1e-6, -3.0), (-1e-10, 1e-9, 2.0), (1e-11, 1e-4, -1.5), (-1e-12, 1e-6, 30.0)],
)
@pytest.mark.parametrize("heading", [1.0, -1.0])
def test_a_start_in_a_layer_leaves_along_the_branch_where_it_is(
    name: str, d: float, rtol: float, place: float, heading: float, backend: str
) -> None:
    (mechanism, kinetic), t_end = on_its_curve(name, d, place, heading), 0.05
    motion, p = StraightOn.of(name, mechanism.q0), float(turned(mechanism.q0[0]))
    ahead = float(np.sign(motion.joints(p, 1.0)[1] @ mechanism.v0))

    run = srm.simulate(mechanism, t_end, rtol=rtol, backend=backend)

    assert_ends(run, motion.after(p, kinetic, ahead, t_end), 100.0 * rtol + 30.0 * np.sqrt(abs(d)))


@on_both
@pytest.mark.parametrize("name", CHANGE_POINTS)
@pytest.mark.parametrize(("d", "rtol"), [(3e-10, 1e-6), (-1e-10, 1e-9), (1e-11, 1e-4)])
def test_a_state_in_the_middle_of_a_straight_passage_starts_a_run(
    name: str, d: float, rtol: float, backend: str
) -> None:
    mechanism, t_end = four_bar(name, d), 0.08
    whole = srm.simulate(mechanism, t_end, rtol=rtol, backend=backend)
    exact = straight(name, mechanism, t_end)
    for place in (-300.0, -3.0, -0.5, 0.0, 0.02, 0.3, 1.0, 40.0):
        t = whole.crossings[0].time + place * np.sqrt(2.0 * abs(d)) / SPEED
        q, v = whole(t)
        rest = srm.simulate(mechanism, t_end, t0=t, q0=q, v0=v, rtol=rtol, backend=backend)
        assert_ends(rest, exact, 100.0 * rtol + 3.0 * np.sqrt(abs(d)))


@on_both
@pytest.mark.parametrize("speed", [3.0, -3.0])
@pytest.mark.parametrize(
    ("name", "d", "rtol"), [("folded", 1e-10, 1e-6), ("parallelogram", -5e-10, 1e-9)]
)
def test_a_driven_mechanism_starts_in_such_a_layer(
    name: str, d: float, rtol: float, speed: float, backend: str
) -> None:
    free, t_end = four_bar(name, d, -0.3 * np.sign(speed), speed), 0.2
    drive = srm.Drive(srm.ConstantSpeed(speed), "crank")
    mechanism = replace(free, drives=(drive,))
    whole = srm.simulate(mechanism, t_end, rtol=rtol, backend=backend)
    motion = StraightOn.of(name, mechanism.q0)
    exact = motion.joints(float(turned(mechanism.q0[0])) + speed * t_end, speed)
    assert_ends(whole, exact, 100.0 * rtol + 3.0 * np.sqrt(abs(d)))
    for place in (-30.0, -1.2, -0.1, 0.01, 0.3, 3.0):
        t = 0.1 + place * np.sqrt(2.0 * abs(d)) / 3.0
        q, v = whole(t)
        rest = srm.simulate(mechanism, t_end, t0=t, q0=q, v0=v, rtol=rtol, backend=backend)
        assert_ends(rest, exact, 100.0 * rtol + 3.0 * np.sqrt(abs(d)))


@on_both
@pytest.mark.parametrize(
    ("name", "d", "place", "speed"),
    [("folded", 1e-10, -3.0, 0.3), ("parallelogram", -1e-11, 2.0, 0.1)],
)
def test_a_slow_start_leaves_such_a_layer_before_gravity_turns_it_back(
    name: str, d: float, place: float, speed: float, backend: str
) -> None:
    mechanism, kinetic = on_its_curve(name, d, place, 1.0, speed)
    motion, p = StraightOn.of(name, mechanism.q0), float(turned(mechanism.q0[0]))
    ahead = float(np.sign(motion.joints(p, 1.0)[1] @ mechanism.v0))
    t_end = 0.02 * speed

    run = srm.simulate(mechanism, t_end, rtol=1e-6, backend=backend)

    assert_ends(run, motion.after(p, kinetic, ahead, t_end), 1e-4 + 30.0 * np.sqrt(abs(d)) / speed)


@on_both
@pytest.mark.parametrize(
    ("d", "rtol", "stiffness", "rest", "t_end"),
    [(-2.1e-12, 8.3e-6, 101.73, -1.7676, 0.4978), (-6.3e-13, 1.04e-7, 85.66, -1.4766, 0.5576)],
)
def test_a_spring_that_slows_a_straight_passage_down_is_resolved(
    d: float, rtol: float, stiffness: float, rest: float, t_end: float, backend: str
) -> None:
    """The equal slider-crank on its straight branch, where the rod turns by -2 theta."""
    almost = slider_crank(d)
    spring = srm.TorsionSpring("rod", stiffness=stiffness, rest_angle=rest)
    free = reduced.slider_crank()

    def field(t: float, y: Any) -> list[float]:
        moment = 2.0 * stiffness * (-2.0 * y[0] - rest)
        return [y[1], free(t, y)[1] + moment / (8.0 / 3.0 + 8.0 * np.sin(y[0]) ** 2)]

    theta, omega = reduced.integrate(field, [almost.q0[0], almost.v0[0]], t_end)

    run = srm.simulate(replace(almost, forces=(spring,)), t_end, rtol=rtol, backend=backend)

    assert run.success, run.message
    assert np.abs(run.q[-1] - [theta, -2.0 * theta]).max() < 30.0 * rtol + 10.0 * np.sqrt(abs(d))
    assert abs(run.v[-1, 0] - omega) < 10.0 * (30.0 * rtol + 10.0 * np.sqrt(abs(d)))
