"""Time constants of damping, friction and springs, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.analysis.summary import stiff_rows
from srm_mbs.analysis.time_constants import stiff_elements, time_constants
from srm_mbs.model.forces import ForceElement

MASS = 2.0
GROUND = srm.Anchor("world")


def sliding(damping: float = 0.0, friction: float = 0.0) -> srm.Mechanism:
    """A block of 2 kg on a rail."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "rail")
    model.appendBodyToJoint(joint, pin.Inertia(MASS, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    model.addBodyFrame("block", joint, pin.SE3.Identity(), 0)
    model.damping, model.friction = np.array([damping]), np.array([friction])
    return srm.Mechanism(model, friction_speed=1e-3)


def test_of_a_joint_they_are_inertia_over_damping_and_over_friction() -> None:
    (damped,) = time_constants(sliding(damping=8.0))
    assert (damped.element, damped.coefficient) == ("rail", "damping 8 N s/m")
    assert damped.seconds == pytest.approx(MASS / 8.0, rel=1e-14)
    (rough,) = time_constants(sliding(friction=5.0))
    assert rough.coefficient == "friction 5 N at 0.001 m/s"
    assert rough.seconds == pytest.approx(MASS * 1e-3 / 5.0, rel=1e-14)
    (both,) = time_constants(sliding(damping=8.0, friction=5.0))
    assert both == rough
    assert time_constants(sliding()) == []


def test_of_an_elbow_the_inertia_is_the_articulated_one() -> None:
    chain = srm.load("pendulum_chain")
    model = chain.model.copy()
    model.damping = np.array([0.0, 3.0, 0.0])
    M = pin.crba(model, model.createData(), chain.q0)
    M = np.triu(M) + np.triu(M, 1).T
    (found,) = time_constants(replace(chain, model=model))
    assert found.seconds == pytest.approx(1.0 / (3.0 * np.linalg.inv(M)[1, 1]), rel=1e-12)


def test_of_a_loop_the_inertia_is_that_of_the_whole_mechanism() -> None:
    """With one degree of freedom v ~ v0, and d w^2 / (v^T M v) is the rate."""
    loop = srm.load("four_bar")
    model = loop.model.copy()
    model.damping = np.array([0.0, 3.0, 0.0])
    M = pin.crba(model, model.createData(), loop.q0)
    v = loop.v0
    energy = float(v @ (np.triu(M) + np.triu(M, 1).T) @ v)
    (found,) = time_constants(replace(loop, model=model))
    assert found.seconds == pytest.approx(energy / (3.0 * v[1] ** 2), rel=1e-9)


def test_a_joint_that_a_drive_holds_has_none() -> None:
    loop = srm.load("four_bar")
    model = loop.model.copy()
    model.damping = np.full(3, 3.0)
    crank = loop.joint_names[0]
    drive = srm.Drive(srm.ConstantSpeed(1.0), joint=crank)
    driven = srm.Mechanism(model, loop.loops, q0=loop.q0, drives=(drive,))
    assert time_constants(driven) == []


@pytest.mark.parametrize(
    ("element", "coefficient", "seconds"),
    [
        (
            srm.SpringDamper(
                srm.Anchor("block"), srm.Anchor("world", xyz=(2.0, 0, 0)), 0.0, 40.0, 1.0
            ),
            "damping 40 N s/m",
            MASS / 40.0,
        ),
        (
            srm.SpringDamper(srm.Anchor("block"), GROUND, 50.0, 0.0, 0.0),
            "stiffness 50 N/m",
            np.sqrt(MASS / 50.0),
        ),
        (
            srm.Bushing(srm.Anchor("block"), GROUND, (9.0,) * 6, (40.0,) * 6),
            "damping 40 N s/m",
            MASS / 40.0,
        ),
        (srm.TorsionSpring("rail", 50.0, 0.0), "stiffness 50 N/m", np.sqrt(MASS / 50.0)),
        (
            srm.CouplingSpring(("rail",), (2.0,), damping=40.0),
            "damping 40 N s/m",
            MASS / 160.0,
        ),
        (
            srm.CouplingSpring(("rail",), (2.0,), friction=0.3),
            "friction 0.3 N at 0.001 m/s",
            MASS / (4.0 * 0.3 / 0.001),
        ),
        (srm.LimitSpring("rail", 9.0, 40.0, upper=1.0), "damping 40 N s/m", MASS / 40.0),
    ],
    ids=lambda value: getattr(value, "type", ""),
)
def test_of_force_elements_they_are_those_of_their_directions(
    element: ForceElement, coefficient: str, seconds: float
) -> None:
    (found,) = time_constants(replace(sliding(), forces=(element,)))
    assert found.element == f"force {element.name}"
    assert found.coefficient == coefficient
    assert found.seconds == pytest.approx(seconds, rel=1e-12)


def test_stiff_is_what_is_far_faster_than_the_mechanism() -> None:
    block = sliding(damping=1.0)
    rate = block.structure.units.rate
    slow, fast = (sliding(damping=MASS * rate * factor) for factor in (100.0, 300.0))
    assert stiff_elements(slow) == []
    assert [one.element for one in stiff_elements(fast)] == ["rail"]
    assert list(stiff_rows(fast)) == [
        ("rail", f"damping {300.0 * MASS * rate:.6g} N s/m", f"{1.0 / (300.0 * rate):.2g} s")
    ]


def test_no_bundled_mechanism_without_damping_is_stiff() -> None:
    assert stiff_elements(srm.load("four_bar")) == []
