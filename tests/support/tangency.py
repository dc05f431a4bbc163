"""A slider-crank that a four-bar drives just up to its singular configuration, or over it and back.

In the x-y plane, gravity along -y.  The four-bar (input 0.5 m, coupler 1.5 m) takes the equal
slider-crank's crank by a point 1 m along it.  Where input and coupler align, at input 0, the crank
turns back; the ground pivot of the input, ``reach`` too close, lies so that this happens at the
singular configuration of the slider-crank for ``reach`` = 0.  There sigma vanishes with the square
of time, and the two branches are tangent: rod = -crank and rod at the crank's pivot have the same
rates.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support.mechanisms import add_link, along_x, rod
from tests.support.turning import Motion

G = 9.81
INPUT, COUPLER, BAR = 0.5, 1.5, 2.0
FIRST, RATE = -1.2, 6.0
"""Input at the start (rad), and its rate (rad/s)."""


def _pivot(reach: float) -> np.ndarray:
    return np.array([reach - INPUT - COUPLER, 1.0])


def _along(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def _across(angle: float) -> np.ndarray:
    return np.array([-np.sin(angle), np.cos(angle)])


def _angles(psi: float, reach: float) -> tuple[float, float]:
    """Absolute angles of coupler and crank at the input angle ``psi``: two circles meet."""
    p = _pivot(reach) + INPUT * _along(psi)
    r = np.hypot(*p)
    crank = np.arctan2(p[1], p[0]) - np.arccos((r * r + 1.0 - COUPLER**2) / (2.0 * r))
    to = _along(crank) - p
    return float(np.arctan2(to[1], to[0])), float(crank)


def _rod(crank: float, longer: float) -> tuple[float, float]:
    """Absolute angle of the rod and its rate over that of the crank; a longer rod keeps its side,
    with the tip behind the crank."""
    if not longer:
        return -crank, -1.0
    length = BAR + longer
    # Without the difference of 1 and a number next to it.
    cosine = -np.sqrt(longer * (BAR + length) + (BAR * np.cos(crank)) ** 2) / length
    angle = np.arctan2(-BAR * np.sin(crank) / length, cosine)
    return float(angle), float(-BAR * np.cos(crank) / (length * cosine))


def _rates(psi: float, reach: float) -> np.ndarray:
    """Rates of coupler and crank over that of the input."""
    coupler, crank = _angles(psi, reach)
    closure = np.column_stack([COUPLER * _across(coupler), -_across(crank)])
    return np.linalg.solve(closure, -INPUT * _across(psi))


def mechanism(reach: float, longer: float = 0.0) -> srm.Mechanism:
    """It moves with ``RATE`` from ``FIRST``, rod = -crank but for a rod that is ``longer`` (m), all
    bars uniform with 1 kg."""
    model = pin.Model()
    model.name = "tangency"
    model.gravity.linear = np.array([0.0, -G, 0.0])
    pivot = pin.SE3(np.eye(3), np.append(_pivot(reach), 0.0))
    ground = pin.SE3.Identity()
    bars = (
        ("input", 0, pivot, INPUT),
        ("coupler", 1, along_x(INPUT), COUPLER),
        ("crank", 0, ground, BAR),
        ("rod", 3, along_x(BAR), BAR + longer),
    )
    for name, parent, placement, length in bars:
        add_link(model, parent, pin.JointModelRZ(), name, rod(1.0, length), placement)
    loops = (
        srm.LoopClosure(
            "point",
            srm.Anchor("coupler", xyz=(COUPLER, 0.0, 0.0)),
            srm.Anchor("crank", xyz=(1.0, 0.0, 0.0)),
            name="four_bar",
        ),
        srm.LoopClosure(
            "point_on_plane",
            srm.Anchor("rod", xyz=(BAR + longer, 0.0, 0.0)),
            srm.Anchor("world"),
            (0.0, 1.0, 0.0),
            "slide",
        ),
    )
    coupler, crank = _angles(FIRST, reach)
    dcoupler, dcrank = _rates(FIRST, reach)
    rod_angle, slope = _rod(crank, longer)
    q = np.array([FIRST, coupler - FIRST, crank, rod_angle - crank])
    v = RATE * np.array([1.0, dcoupler - 1.0, dcrank, (slope - 1.0) * dcrank])
    return srm.Mechanism(model, loops, q0=q, v0=v)


def inputs(reach: float, times: np.ndarray, longer: float = 0.0) -> np.ndarray:
    """The input angle at ``times``, by SciPy from the conservation of energy; it does not stop."""

    def energies(psi: float) -> tuple[float, float]:
        """Twice the kinetic energy over the square of the input's rate, and the potential."""
        (coupler, crank), (dcoupler, dcrank) = _angles(psi, reach), _rates(psi, reach)
        centre = INPUT * _across(psi) + 0.5 * COUPLER * dcoupler * _across(coupler)
        (angle, slope), length = _rod(crank, longer), BAR + longer
        rod_centre = dcrank * (BAR * _across(crank) + 0.5 * length * slope * _across(angle))
        square = INPUT**2 / 3.0 + centre @ centre + (COUPLER * dcoupler) ** 2 / 12.0
        square += dcrank**2 * (BAR**2 / 3.0 + (length * slope) ** 2 / 12.0)
        square += rod_centre @ rod_centre
        height = 1.5 * INPUT * np.sin(psi) + 0.5 * COUPLER * np.sin(coupler)
        height += 1.5 * BAR * np.sin(crank) + 0.5 * length * np.sin(angle)
        return float(square), G * float(height)

    square, potential = energies(FIRST)
    total = 0.5 * square * RATE**2 + potential

    def field(t: float, y: np.ndarray) -> list[float]:
        square, potential = energies(float(y[0]))
        return [float(np.sqrt(2.0 * (total - potential) / square))]

    run = solve_ivp(field, (0.0, times[-1]), [FIRST], "DOP853", times, rtol=1e-13, atol=1e-13)
    assert run.success
    return np.asarray(run.y[0])


# --- driven, and with a further freedom -----------------------------------------------------------

END = 0.35
SWING, SWINGING = 1.6, 4.0
"""Amplitude (rad) and angular frequency (rad/s) of a driven input."""
PHASE = float(np.arcsin(FIRST / SWING))
PENDULUM = (-1.0, 2.0)
"""Absolute angle (rad) and rate (rad/s) of the pendulum at the start."""


def _second_rates(psi: float, reach: float) -> np.ndarray:
    """Second derivatives of coupler and crank by the input."""
    (coupler, crank), (dcoupler, dcrank) = _angles(psi, reach), _rates(psi, reach)
    known = INPUT * _along(psi) + COUPLER * dcoupler**2 * _along(coupler)
    closure = np.column_stack([COUPLER * _across(coupler), -_across(crank)])
    return np.linalg.solve(closure, known - dcrank**2 * _along(crank))


def _input(t: Any) -> tuple[Any, Any, Any]:
    """Angle, rate and acceleration of a driven input."""
    phase = SWINGING * t + PHASE
    speed = SWING * SWINGING
    return SWING * np.sin(phase), speed * np.cos(phase), -speed * SWINGING * np.sin(phase)


def _turning(angle: float, length: float, first: float, second: float) -> np.ndarray:
    """First and second derivatives (2, 2) of ``length`` along ``angle``."""
    n = _across(angle)
    return length * np.array([first * n, second * n - first**2 * _along(angle)])


def _bars(psi: float, reach: float) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Of each bar, first and second derivatives by the input of its centre (2, 2) and of its angle
    (2,) over that of a unit radius of gyration; of the crank's tip those of its place."""
    (coupler, crank), (dcoupler, dcrank) = _angles(psi, reach), _rates(psi, reach)
    ecoupler, ecrank = _second_rates(psi, reach)
    joint = _turning(psi, INPUT, 1.0, 0.0)
    tip = _turning(crank, BAR, dcrank, ecrank)
    bars = [
        (0.5 * joint, INPUT * np.array([1.0, 0.0])),
        (
            joint + 0.5 * _turning(coupler, COUPLER, dcoupler, ecoupler),
            COUPLER * np.array([dcoupler, ecoupler]),
        ),
        (0.5 * tip, BAR * np.array([dcrank, ecrank])),
        (tip + 0.5 * _turning(-crank, BAR, -dcrank, -ecrank), -BAR * np.array([dcrank, ecrank])),
    ]
    return [(centre, turn / np.sqrt(12.0)) for centre, turn in bars], tip


def _free(reach: float) -> Any:
    """(psi, chi, psi', chi') of input and pendulum, by d'Alembert's principle."""
    weight = np.array([0.0, -G])

    def field(t: float, y: Any) -> list[float]:
        psi, chi, rate, swing = y
        bars, tip = _bars(psi, reach)
        n = _across(chi)
        mass = sum(c[0] @ c[0] + a[0] * a[0] for c, a in bars) + tip[0] @ tip[0]
        both = 0.5 * tip[0] @ n
        force = sum(c[0] @ (weight - c[1] * rate**2) - a[0] * a[1] * rate**2 for c, a in bars)
        left = weight - tip[1] * rate**2 + 0.5 * swing**2 * _along(chi)
        matrix = np.array([[mass, both], [both, 1.0 / 3.0]])
        forces = [force + tip[0] @ left, 0.5 * n @ left]
        return [rate, swing, *np.linalg.solve(matrix, forces)]

    return field


def _carried(reach: float) -> Any:
    """(chi, chi') of the pendulum on the tip of a crank whose input is driven."""

    def field(t: float, y: Any) -> list[float]:
        psi, rate, acceleration = _input(t)
        tip = _bars(float(psi), reach)[1]
        of_tip = tip[0] * acceleration + tip[1] * rate**2 + np.array([0.0, G])
        return [y[1], -1.5 * float(of_tip @ _across(y[0]))]

    return field


def _solved(field: Any, start: Any, t: Any) -> np.ndarray:
    run = solve_ivp(field, (0.0, t[-1]), start, "DOP853", t, rtol=3e-14, atol=1e-15)
    assert run.success
    return np.asarray(run.y)


def moving(reach: float, driven: bool, pendulum: bool, ball: bool = False) -> Motion:
    """The linkage with its input driven by a sine or free, with or without a rod of 1 m and 1 kg
    that swings at the tip of the crank: on a hinge, or in the same plane on a ball joint."""
    own = mechanism(reach)
    model = own.model.copy()
    if pendulum:
        hinge = pin.JointModelSpherical() if ball else pin.JointModelRZ()
        thick = rod(1.0, 1.0)
        thick.inertia = thick.inertia + 0.01 * np.diag([1.0, 0.0, 0.0])  # regular about the rod
        add_link(model, model.getJointId("crank"), hinge, "pendulum", thick, along_x(BAR))
    order = [model.getJointId(name) for name in ("input", "coupler", "crank", "rod")]

    def whole(psi: Any, rate: Any, chi: Any, swing: Any) -> tuple[np.ndarray, np.ndarray]:
        coupler, crank = np.array([_angles(x, reach) for x in psi]).T
        dcoupler, dcrank = np.array([_rates(x, reach) for x in psi]).T * rate
        q, v = np.zeros((len(psi), model.nq)), np.zeros((len(psi), model.nv))
        angles = [psi, coupler - psi, crank, -2.0 * crank]
        rates = [rate, dcoupler - rate, dcrank, -2.0 * dcrank]
        for joint, angle, own_rate in zip(order, angles, rates):
            q[:, model.idx_qs[joint]], v[:, model.idx_vs[joint]] = angle, own_rate
        if pendulum:
            joint, half = model.getJointId("pendulum"), 0.5 * (chi - crank)
            at, last = model.idx_qs[joint], model.idx_vs[joint] + model.nvs[joint] - 1
            q[:, at : at + model.nqs[joint]] = (
                np.column_stack([0.0 * half, 0.0 * half, np.sin(half), np.cos(half)])
                if ball
                else 2.0 * half[:, None]
            )
            v[:, last] = swing - dcrank
        return q, v

    def exact(t: Any) -> tuple[np.ndarray, np.ndarray]:
        if not driven:
            psi, chi, rate, swing = _solved(
                _free(reach), [FIRST, PENDULUM[0], RATE, PENDULUM[1]], t
            )
            return whole(psi, rate, chi, swing)
        psi, rate, _ = _input(t)
        chi, swing = _solved(_carried(reach), PENDULUM, t) if pendulum else (psi, rate)
        return whole(psi, rate, chi, swing)

    first = float(_input(0.0)[1]) if driven else RATE
    (q,), (v,) = whole(*np.array([[FIRST], [first], [PENDULUM[0]], [PENDULUM[1]]]))
    moved = srm.Mechanism(model, own.loops, q0=q, v0=v)
    if driven:
        law = srm.Sine(SWING, omega=SWINGING, phase=PHASE)
        moved = replace(moved, drives=(srm.Drive(law, "input", absolute=True),))
    return Motion(moved.with_state(q, v), END, exact)
