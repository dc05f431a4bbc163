"""Stiff problems: a loop closed by a bushing, dry friction, the governor A05.

The peers integrate the equations in minimal coordinates, with the forces written here by hand.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from benchmarks.work_precision.problems.base import Array, Problem, ReducedModel, crank, state
from benchmarks.work_precision.problems.slider_cranks import tree as slider_crank_tree
from benchmarks.work_precision.trees import Tree
from tests.support import reduced
from tests.support.stiff import bushed_field, bushed_four_bar

TIME_CONSTANT = 1e-6
"""Of the bushing (s)."""
FRICTION, FRICTION_SPEED = 5.0, 1e-5
"""Torque of the friction in the crank's joint (N m), and the rate (rad/s) of its tanh."""
STIFFNESS, DAMPING, REST = 8e5, 4e4, 0.5
"""Spring-dampers of the governor: N/m, N s/m, m."""


def _open_tree(mechanism: srm.Mechanism) -> Tree:
    return Tree(mechanism.model, (), mechanism.q0.copy(), mechanism.v0.copy())


def bushing() -> Problem:
    """The four-bar whose pin is an overdamped bushing."""
    mechanism = bushed_four_bar(TIME_CONSTANT)
    return Problem(
        "bushing",
        "Four-bar closed by an overdamped bushing, time constant 1e-6 s, 1 s",
        1.0,
        lambda: mechanism,
        lambda: _open_tree(mechanism),
        state,
        rates=3,
        reduced=ReducedModel(bushed_field(mechanism, TIME_CONSTANT), tuple(mechanism.start_state)),
        stiff=True,
    )


def friction() -> Problem:
    """The bundled slider_crank_regular with dry friction in the crank's joint, until it rests."""

    def mechanism() -> srm.Mechanism:
        loaded = srm.load("slider_crank_regular")
        model = loaded.model.copy()
        model.friction = np.where(np.arange(model.nv) == 0, FRICTION, 0.0)
        return replace(loaded, model=model, friction_speed=FRICTION_SPEED)

    def torque(rate: float) -> float:
        return -FRICTION * math.tanh(rate / FRICTION_SPEED)

    return Problem(
        "friction",
        "Slider-crank with dry friction, speed of its tanh 1e-5 rad/s, 10 s",
        10.0,
        mechanism,
        lambda: slider_crank_tree(1.0, 3.0, 3.0, 4.0),
        crank,
        rates=1,
        reduced=ReducedModel(reduced.regular_slider_crank(torque), (math.pi / 4.0, 4.0)),
        stiff=True,
    )


def governor() -> Problem:
    """The bundled flyball_governor, A05 of the IFToMM library."""
    loaded = srm.load("flyball_governor")
    model = loaded.model
    data = model.createData()
    slider = model.getFrameId("slider", pin.FrameType.BODY)
    middle = np.array([0.5 * math.cos(math.pi / 6.0), 0.0, -0.25])
    springs = [
        (
            model.getFrameId(f"{side}_rod", pin.FrameType.BODY),
            middle * [sign, 1.0, 1.0],
            np.array([0.05 * sign, 0.0, 0.0]),
        )
        for side, sign in (("left", -1.0), ("right", 1.0))
    ]

    def point(frame: int, at: Array) -> tuple[Array, Array]:
        """Place (3,) and Jacobian (3, nv) of a point of a link."""
        J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        arm = data.oMf[frame].rotation @ at
        return data.oMf[frame].translation + arm, J[:3] - pin.skew(arm) @ J[3:]

    def field(t: float, y: Array) -> Array:
        q, v = y[: model.nq], y[model.nq :]
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        tau = np.zeros(model.nv)
        for rod, on_rod, on_slider in springs:
            (a, J_a), (b, J_b) = point(rod, on_rod), point(slider, on_slider)
            length = math.sqrt((a - b) @ (a - b))
            along = ((a - b) / length) @ (J_a - J_b)
            tau -= (STIFFNESS * (length - REST) + DAMPING * (along @ v)) * along
        return np.concatenate([v, pin.aba(model, data, q, v, tau)])

    return Problem(
        "governor",
        "Flyball governor A05, dampers with a time constant of 4e-5 s, 10 s",
        10.0,
        lambda: loaded,
        lambda: _open_tree(loaded),
        state,
        rates=4,
        reduced=ReducedModel(field, tuple(loaded.start_state)),
        stiff=True,
    )
