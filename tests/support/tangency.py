"""A slider-crank that a four-bar drives just up to its singular configuration, or over it and back.

In the x-y plane, gravity along -y.  The four-bar (input 0.5 m, coupler 1.5 m) takes the equal
slider-crank's crank by a point 1 m along it.  Where input and coupler align, at input 0, the crank
turns back; the ground pivot of the input, ``reach`` too close, lies so that this happens at the
singular configuration of the slider-crank for ``reach`` = 0.  There sigma vanishes with the square
of time, and the two branches are tangent: rod = -crank and rod at the crank's pivot have the same
rates.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support.mechanisms import add_link, along_x, rod

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
