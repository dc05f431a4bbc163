"""P1 and P2: slider-cranks, whirling through singular configurations, and regular.

The peers have no closure that keeps a point on a plane: they get a massless slider in the middle
of a chain, ground - slider - rod, whose end is closed at the crank's tip.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from benchmarks.work_precision.problems.base import Problem, ReducedModel, crank
from benchmarks.work_precision.trees import PointClosure, Tree
from tests.support import reduced

START = math.pi / 4.0  # rad, crank angle


def _rod(mass: float, length: float) -> pin.Inertia:
    transverse = mass * length**2 / 12.0
    centre = np.array([length / 2.0, 0.0, 0.0])
    return pin.Inertia(mass, centre, np.diag([1e-3 * transverse, transverse, transverse]))


def tree(crank_length: float, rod_length: float, rod_mass: float, speed: float) -> Tree:
    """Crank of 1 kg, massless slider, rod; x along the slide, gravity along -y."""
    model = pin.Model()
    model.gravity.linear = np.array([0.0, -reduced.G, 0.0])
    origin = pin.SE3.Identity()
    first = model.addJoint(0, pin.JointModelRZ(), origin, "crank")
    model.appendBodyToJoint(first, _rod(1.0, crank_length), origin)
    slider = model.addJoint(0, pin.JointModelPX(), origin, "slider")
    rod = model.addJoint(slider, pin.JointModelRZ(), origin, "rod")
    model.appendBodyToJoint(rod, _rod(rod_mass, rod_length), origin)
    closure = PointClosure(first, (crank_length, 0.0, 0.0), rod, (rod_length, 0.0, 0.0), (0, 1))
    x, y = crank_length * math.cos(START), crank_length * math.sin(START)
    reach = math.sqrt(rod_length**2 - y**2)
    # rod tip: (s + b cos phi, b sin phi) = (x, y), differentiated with respect to the crank angle
    rod_rate = -x / reach
    slider_rate = -y + y * rod_rate
    q0 = np.array([START, x + reach, math.pi - math.asin(y / rod_length)])
    return Tree(model, (closure,), q0, speed * np.array([1.0, slider_rate, rod_rate]))


def whirl(speed: float = 2.0) -> Problem:
    """Equal bars of 2 m and 1 kg; the bundled slider_crank_whirl, with any start speed (rad/s)."""

    def mechanism() -> srm.Mechanism:
        loaded = srm.load("slider_crank_whirl")
        # Its rate is held by the crank's alone: everything scales with the speed.
        return loaded if speed == 2.0 else loaded.with_state(loaded.q0, loaded.v0 * (speed / 2.0))

    return Problem(
        "slider_crank_whirl",
        "P1: slider-crank with equal bars, whirling through singular configurations, 10 s",
        10.0,
        mechanism,
        lambda: tree(2.0, 2.0, 1.0, speed),
        crank,
        rates=1,
        reduced=ReducedModel(reduced.slider_crank(), (START, speed)),
        singular=True,
        planar=(0, 1),
    )


def regular() -> Problem:
    """Crank 1 m 1 kg, rod 3 m 3 kg: the bundled slider_crank_regular."""
    return Problem(
        "slider_crank_regular",
        "P2: slider-crank with a rod three times the crank, no singular configuration, 10 s",
        10.0,
        lambda: srm.load("slider_crank_regular"),
        lambda: tree(1.0, 3.0, 3.0, 4.0),
        crank,
        rates=1,
        reduced=ReducedModel(reduced.regular_slider_crank(), (START, 4.0)),
        planar=(0, 1),
    )
