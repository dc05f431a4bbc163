"""Motions that turn back, or are slow, next to a singular configuration, with exact references.

The crank of the parallelogram turns back where its angle is ``reach`` beyond the change point at 0
(before it, if negative).  On the parallelogram's branch crank and rocker turn alike and the coupler
translates, so that every point of it moves on a circle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support import reduced
from tests.support.bundled import load
from tests.support.change_point import CHANGE_POINTS, AlmostChangePoint
from tests.support.mechanisms import along_x, rod

G = 9.81
SWING = 0.4
TOP = np.pi / 2.0
"""Crank angle of slider_crank at its upper singular configuration, an unstable equilibrium."""
SAMPLES = 25
ALIKE = np.array([1.0, -1.0, 1.0])
"""Rates of crank, coupler and rocker on the branch, over the crank's."""


@dataclass(frozen=True)
class Motion:
    """A mechanism at its start, the length of the run (s), and t (k,) -> exact q and v (k, nv)."""

    mechanism: srm.Mechanism
    t_end: float
    exact: Callable[[Any], tuple[np.ndarray, np.ndarray]]

    def error(self, solution: srm.Solution) -> float:
        """Largest error of positions, and of rates over the largest rate (at least 1)."""
        assert solution.success, solution.message
        t = np.linspace(0.0, self.t_end, SAMPLES)
        q, v = solution(t)
        exact_q, exact_v = self.exact(t)
        speed = max(1.0, float(np.abs(exact_v).max()))
        return float(max(np.abs(q - exact_q).max(), np.abs(v - exact_v).max() / speed))


def _solved(field: reduced.Field, start: Any, t: Any) -> np.ndarray:
    run = solve_ivp(field, (0.0, t[-1]), start, "DOP853", t_eval=t, rtol=3e-14, atol=1e-16)
    assert run.success
    return np.asarray(run.y)


def _parallelogram(angle: float, rate: float) -> srm.Mechanism:
    return load("parallelogram").with_state(angle * ALIKE, rate * ALIKE)


def _crank(reach: float, rate: float, t: Any) -> tuple[Any, Any, Any]:
    """Angle, rate and acceleration of a crank that is driven to ``reach`` and back."""
    phase = rate * t
    return (
        reach - SWING - SWING * np.cos(phase),
        SWING * rate * np.sin(phase),
        SWING * rate * rate * np.cos(phase),
    )


def _drive(reach: float, rate: float) -> srm.Drive:
    law = srm.Sine(SWING, omega=rate, phase=-TOP, offset=reach - SWING)
    return srm.Drive(law, "crank", absolute=True)


def driven(reach: float, rate: float) -> Motion:
    """The crank is driven, with ``rate`` (rad/s), up to ``reach`` and back; nothing is free."""
    angle, speed, _ = _crank(reach, rate, 0.0)
    mechanism = replace(_parallelogram(angle, speed), drives=(_drive(reach, rate),))

    def exact(t: Any) -> tuple[np.ndarray, np.ndarray]:
        angle, speed, _ = _crank(reach, rate, t)
        return np.outer(angle, ALIKE), np.outer(speed, ALIKE)

    return Motion(mechanism, 2.0 * np.pi / rate, exact)


def driven_four_bar(name: str, reach: float, side: float) -> srm.Mechanism:
    """A change-point four-bar (:data:`tests.support.change_point.CHANGE_POINTS`) whose crank is
    driven, at 1 rad/s, from one ``side`` (1 or -1) of its change point up to ``reach`` and back."""
    four_bar = AlmostChangePoint(*CHANGE_POINTS[name], 0.0)
    there = np.pi * (four_bar.levels[0] != 0.0)
    start = there + side * (reach - 2.0 * SWING)
    mechanism = replace(four_bar, start=float(start % (2.0 * np.pi)), speed=1.0).mechanism()
    law = srm.Sine(
        side * SWING, phase=-TOP, offset=float(mechanism.q0[0]) + side * SWING, omega=1.0
    )
    drive = srm.Drive(law, "crank", absolute=True)
    return replace(mechanism, drives=(drive,)).with_state(mechanism.q0, 0.0 * mechanism.v0)


def driven_with_pendulum(reach: float, rate: float) -> Motion:
    """As :func:`driven`, with a rod of 1 m and 1 kg that swings at the tip of the rocker.

    With its angle chi from the horizontal and the acceleration (x'', z'') of the tip,
    chi'' / 3 = -((g + z'') cos chi - x'' sin chi) / 2.
    """
    model = load("parallelogram").model.copy()
    rocker = model.getJointId("rocker")
    pendulum = model.addJoint(rocker, pin.JointModelRY(), along_x(1.0), "pendulum")
    model.appendBodyToJoint(pendulum, rod(1.0, 1.0), pin.SE3.Identity())
    model.addBodyFrame("pendulum", pendulum, pin.SE3.Identity(), 0)
    # Coordinates are angles about y or -y: positive ones lift or lower.
    data = model.createData()
    pin.forwardKinematics(model, data, np.array([0.0, 0.0, 0.3, 0.0]))
    lifts = float(np.sign(data.oMi[pendulum].translation[2]))
    pin.forwardKinematics(model, data, np.array([0.0, 0.0, 0.0, 0.3]))
    turns = float(np.sign(data.oMi[pendulum].rotation[2, 0]))
    chi = [turns, 0.5 * turns]

    def field(t: float, y: Any) -> list[float]:
        angle, speed, acceleration = _crank(reach, rate, t)
        sine, cosine = np.sin(angle), np.cos(angle)
        x = -sine * acceleration - cosine * speed**2
        z = lifts * (cosine * acceleration - sine * speed**2)
        return [y[1], -1.5 * ((G + z) * np.cos(y[0]) - x * np.sin(y[0]))]

    def whole(crank: Any, own: Any) -> np.ndarray:
        return np.column_stack([np.outer(crank, ALIKE), turns * (own - lifts * crank)])

    def exact(t: Any) -> tuple[np.ndarray, np.ndarray]:
        angle, speed, _ = _crank(reach, rate, t)
        own = _solved(field, chi, t)
        return whole(angle, own[0]), whole(speed, own[1])

    angle, speed, _ = _crank(reach, rate, 0.0)
    q, v = whole(np.array([angle]), chi[0])[0], whole(np.array([speed]), chi[1])[0]
    mechanism = srm.Mechanism(model, load("parallelogram").loops, q0=q, v0=v)
    mechanism = replace(mechanism, drives=(_drive(reach, rate),)).with_state(q, v)
    return Motion(mechanism, 2.0 * np.pi / rate, exact)


def lifted(reach: float) -> Motion:
    """The parallelogram swings, by its own momentum, up from below to ``reach``."""
    rate = np.sqrt(2.0 * 9.0 / 8.0 * G * (1.0 + np.sin(reach)))

    def exact(t: Any) -> tuple[np.ndarray, np.ndarray]:
        angle, speed = _solved(reduced.parallelogram(), [-TOP, rate], t)
        return np.outer(angle, ALIKE), np.outer(speed, ALIKE)

    return Motion(_parallelogram(-TOP, rate), 3.0, exact)


REST = -0.3
"""Angle (rad) of the crank at which the springs of :func:`sprung` are at rest."""


def sprung(reach: float, stiffness: float, damping: float) -> Motion:
    """Springs and dampers on all joints of the parallelogram, of ``stiffness`` (N m/rad) and
    ``damping`` (N m s/rad) on its crank, turn it back at ``reach`` in the middle of the run."""
    springs, dampers = np.array([1.0, 0.05, 0.1]), np.array([1.0, 0.1, 0.3])

    def field(t: float, y: Any) -> list[float]:
        torque = -springs.sum() * stiffness * (y[0] - REST) - dampers.sum() * damping * y[1]
        return [y[1], (torque - 3.0 * G * np.cos(y[0])) / (8.0 / 3.0)]

    def back(t: float, y: Any) -> list[float]:
        return [-x for x in field(t, y)]

    half = min(0.4, 1.2 / np.sqrt(springs.sum() * stiffness / (8.0 / 3.0)))
    start = _solved(back, [reach, 0.0], np.array([0.0, half]))[:, -1]
    mechanism = _parallelogram(start[0], start[1])
    forces = tuple(
        srm.TorsionSpring(name, stiffness=k * stiffness, damping=c * damping, rest_angle=REST * w)
        for name, w, k, c in zip(mechanism.model.names[1:], ALIKE, springs, dampers)
    )

    def exact(t: Any) -> tuple[np.ndarray, np.ndarray]:
        angle, speed = _solved(field, start, t)
        return np.outer(angle, ALIKE), np.outer(speed, ALIKE)

    return Motion(replace(mechanism, forces=forces), 2.0 * half, exact)


CART = 2.0
"""Mass (kg) of the cart of :func:`on_a_cart`."""


def _cart_field(lift: float) -> reduced.Field:
    """(x, a, x', a') of cart and crank: with the masses 1, 2 and 1 kg of the bars,

    (m + 4) x'' - 3 sin(a) a'' = 3 cos(a) a'^2,   (8/3) a'' - 3 sin(a) x'' = -3 g cos(a).
    """

    def field(t: float, y: Any) -> list[float]:
        sine, cosine = np.sin(y[1]), np.cos(y[1])
        mass = np.array([[CART + 4.0, -3.0 * sine], [-3.0 * sine, 8.0 / 3.0]])
        force = np.array([3.0 * cosine * y[3] ** 2, -3.0 * G * lift * cosine])
        return [y[2], y[3], *np.linalg.solve(mass, force)]

    return field


def on_a_cart(reach: float, rate: float) -> Motion:
    """The parallelogram on a cart that rolls along x, with ``rate`` (m/s) when the crank turns
    back; nothing is driven."""
    own = load("parallelogram")
    model = pin.Model()
    model.name = "cart"
    model.gravity = own.model.gravity
    cart = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "cart")
    inertia = pin.Inertia(CART, np.zeros(3), np.eye(3))
    model.appendBodyToJoint(cart, inertia, pin.SE3.Identity())
    model.addBodyFrame("cart", cart, pin.SE3.Identity(), 0)
    new = {0: cart}
    for i in range(1, own.model.njoints):
        parent, place = new[own.model.parents[i]], own.model.jointPlacements[i]
        new[i] = model.addJoint(parent, own.model.joints[i], place, own.model.names[i])
        model.appendBodyToJoint(new[i], own.model.inertias[i], pin.SE3.Identity())
    for frame in own.model.frames:
        if frame.type == pin.FrameType.BODY and frame.parentJoint > 0:
            model.addBodyFrame(frame.name, new[frame.parentJoint], frame.placement, 0)
    data = model.createData()
    pin.forwardKinematics(model, data, np.array([0.0, 0.3, 0.0, 0.0]))
    lift = float(np.sign(data.oMi[new[2]].translation[2]))
    field, half = _cart_field(lift), 0.6

    def back(t: float, y: Any) -> list[float]:
        return [-x for x in field(t, y)]

    turn = [0.0, lift * reach, rate, 0.0]
    start = _solved(back, turn, np.array([0.0, half]))[:, -1]

    def whole(x: Any, crank: Any) -> np.ndarray:
        return np.column_stack([x, np.outer(crank, ALIKE)])

    def exact(t: Any) -> tuple[np.ndarray, np.ndarray]:
        x, crank, dx, rates = _solved(field, start, t)
        return whole(x, crank), whole(dx, rates)

    q, v = whole(start[:1], start[1:2])[0], whole(start[2:3], start[3:])[0]
    return Motion(srm.Mechanism(model, own.loops, q0=q, v0=v), 2.0 * half, exact)


def slow(beside: float, rate: float) -> Motion:
    """The slider-crank that is at TOP + ``beside`` with ``rate`` (rad/s) in the middle of the run;
    deviations grow there by exp(1.36 t)."""
    field = reduced.slider_crank()
    half = min(2.0, 2.0 / rate) if rate > 0.0 else 2.0

    def back(t: float, y: Any) -> list[float]:
        return [-x for x in field(t, y)]

    start = _solved(back, [TOP + beside, rate], np.array([0.0, half]))[:, -1]
    along = np.array([1.0, -2.0])

    def exact(t: Any) -> tuple[np.ndarray, np.ndarray]:
        angle, speed = _solved(field, start, t)
        return np.outer(angle, along), np.outer(speed, along)

    mechanism = load("slider_crank").with_state(start[0] * along, start[1] * along)
    return Motion(mechanism, 2.0 * half, exact)


def hanging(amplitude: float, rate: float) -> Motion:
    """The slider-crank swings about its lower singular configuration, where it hangs."""
    field = reduced.slider_crank()
    start = [3.0 * TOP + amplitude, rate]
    along = np.array([1.0, -2.0])

    def exact(t: Any) -> tuple[np.ndarray, np.ndarray]:
        angle, speed = _solved(field, start, t)
        return np.outer(angle, along), np.outer(speed, along)

    mechanism = load("slider_crank").with_state(start[0] * along, start[1] * along)
    return Motion(mechanism, 10.0, exact)
