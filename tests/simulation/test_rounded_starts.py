"""Starts at positions so large that their rounding limits the accuracy of a run."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.scaling import position_rounding
from srm_mbs.simulation.failure_causes import failure_cause
from tests.support.bundled import finished, load
from tests.support.mechanisms import add_link

TURN = 2.0 * np.pi
BELOW = (
    r"rtol = 1e-12 is below the rounding of the initial positions \(the joint 'crank' starts at "
)


def turned(name: str, turns: float) -> srm.Mechanism:
    """A bundled mechanism whose first joint, a hinge, starts so many turns further on."""
    mechanism = load(name)
    q0 = mechanism.q0.copy()
    q0[0] += TURN * turns
    return dataclasses.replace(mechanism, q0=q0)


def test_a_tolerance_below_the_rounding_of_the_start_is_raised_to_it_with_a_warning() -> None:
    """The rounding of 6.3e7 rad is 7.5e-9 rad.  A run at 1e-12 would control it in 600,000 steps,
    and err by more: by 1e-5 rad."""
    turns = 1e7
    near, far = load("four_bar"), turned("four_bar", turns)
    expected = finished(near, 5.0, rtol=1e-12).q[-1]
    with pytest.warns(srm.SrmWarning, match=BELOW + r"6\.28e\+07 rad, known to 7e-09 rad\)"):
        run = srm.simulate(far, 5.0, rtol=1e-12)
    assert run.success
    assert run.settings.rtol == np.spacing(far.q0[0])
    assert run.stats.evaluations < 2 * finished(near, 5.0, rtol=1e-8).stats.evaluations
    np.testing.assert_allclose(run.q[-1] - (far.q0 - near.q0), expected, rtol=0.0, atol=1e-6)


def test_the_start_of_the_run_counts_not_that_of_the_mechanism() -> None:
    far = turned("four_bar", 1e7)
    assert finished(far, 0.01, rtol=1e-12, q0=load("four_bar").q0).settings.rtol == 1e-12
    with pytest.warns(srm.SrmWarning, match=BELOW):
        srm.simulate(load("four_bar"), 0.01, rtol=1e-12, q0=far.q0)


def test_a_simulator_raises_its_tolerance_as_a_run_does() -> None:
    with pytest.warns(srm.SrmWarning, match=BELOW):
        srm.Simulator(turned("four_bar", 1e7), rtol=1e-12)


def test_fixed_steps_have_no_tolerance_to_raise() -> None:
    assert finished(turned("four_bar", 1e7), 0.01, step=1e-3).success


def test_tolerances_above_the_rounding_of_the_start_stay() -> None:
    assert finished(turned("four_bar", 1000.0), 0.1, rtol=1e-12).settings.rtol == 1e-12
    assert finished(turned("four_bar", 1e7), 0.1, rtol=1e-8).settings.rtol == 1e-8


def test_the_certificate_of_such_a_run_compares_it_with_a_looser_one() -> None:
    q0 = turned("four_bar", 1e7).q0
    with pytest.warns(srm.SrmWarning, match=BELOW):
        run = srm.simulate(load("four_bar"), 1.0, rtol=1e-12, q0=q0)
    assert "The comparison run is looser" in str(srm.certify(run))


@pytest.mark.parametrize(
    ("name", "turns", "named"),
    [
        ("four_bar", 1e6, True),
        ("four_bar", 1e4, False),
        ("pendulum_chain", 1e6, False),
    ],
)
def test_a_failure_names_the_rounding_of_a_start_that_closures_do_not_bear(
    name: str, turns: float, named: bool
) -> None:
    mechanism = turned(name, turns)
    cause = failure_cause(mechanism, 0.0, mechanism.q0, None)
    assert (cause is not None) is named
    if cause is not None:
        assert "the joint 'crank' starts at 6.28e+06 rad, known to 9e-10 rad" in cause.clause


def floating() -> srm.Mechanism:
    """A floating body with a ball joint and a slide on it, beside a planar joint."""
    model = pin.Model()
    body = pin.Inertia.FromSphere(1.0, 0.5)
    base = add_link(model, 0, pin.JointModelFreeFlyer(), "base", body, pin.SE3.Identity())
    ball = add_link(model, base, pin.JointModelSpherical(), "ball", body, pin.SE3.Identity())
    add_link(model, ball, pin.JointModelPX(), "slide", body, pin.SE3.Identity())
    add_link(model, 0, pin.JointModelPlanar(), "table", body, pin.SE3.Identity())
    return srm.Mechanism(model)


@pytest.mark.parametrize("place", [2, 5, 9, 12])
def test_the_place_of_a_free_body_and_rotations_have_no_rounding_that_counts(place: int) -> None:
    mechanism = floating()
    q = np.zeros(mechanism.model.nq)
    q[place] = 1e9
    assert position_rounding(mechanism, q).relative < 1e-300


def test_the_rounding_of_a_slide_is_relative_to_the_size_of_the_mechanism() -> None:
    mechanism = floating()
    q = np.zeros(mechanism.model.nq)
    q[11] = -1e9
    length = mechanism.structure.units.length
    rounding = position_rounding(mechanism, q)
    assert rounding == (np.spacing(1e9) / length, 9, -1e9)
    assert rounding.absolute == np.spacing(1e9)


def test_mechanisms_without_joint_coordinates_have_no_rounding() -> None:
    model = pin.Model()
    add_link(
        model,
        0,
        pin.JointModelSpherical(),
        "ball",
        pin.Inertia.FromSphere(1.0, 0.5),
        pin.SE3.Identity(),
    )
    assert finished(srm.Mechanism(model), 0.1, rtol=1e-13).settings.rtol == 1e-13
