"""Starts where the closed configurations form a cone: a five-bar whose bars are all in line.

Its two degrees of freedom meet there in rates w with w^T B w = 0, a cone: every direction on it is
one of a branch of its own, and the rates of a start choose it.  With a driven bar one degree of
freedom is left beside the drive.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support import reduced
from tests.support.backends import slowly_on_both

CRANK, ROD, LINK, ROCKER = 1.0, 1.3, 0.7, 0.9
"""Lengths (m) of the bars; link and rocker lie on each other."""


def in_line(crank: float, across: float, root: int) -> srm.Mechanism:
    """The five-bar with the rate ``crank`` (rad/s); ``across`` (m/s) is that of the pin between rod
    and link; two rates of the rocker fit, of which ``root`` chooses.

    Of the absolute rates w, CRANK w_1 + ROD w_2 = ROCKER w_4 - LINK w_3 = across keeps the loop
    closed, and CRANK w_1^2 + ROD w_2^2 = ROCKER w_4^2 - LINK w_3^2 to second order.
    """
    x = np.cumsum([0.0, CRANK, ROD, LINK, -ROCKER])
    mechanism = srm.planar(
        points={name: (place, 0.0) for name, place in zip("OABCD", x.tolist())},
        bars={"crank": ("O", "A"), "rod": ("A", "B"), "link": ("B", "C"), "rocker": ("C", "D")},
        ground=("O", "D"),
        mass_per_length=1.0,
    )
    rod = (across - CRANK * crank) / ROD
    squares = CRANK * crank**2 + ROD * rod**2
    quadratic = [
        ROCKER - ROCKER**2 / LINK,
        2.0 * ROCKER * across / LINK,
        -(across**2) / LINK - squares,
    ]
    rocker = float(np.roots(quadratic)[root].real)
    link = (ROCKER * rocker - across) / LINK
    rates = {"O": crank, "A": rod - crank, "D": rocker, "C": link - rocker}
    v = np.array([rates[name] for name in mechanism.joint_names])
    return mechanism.with_state(mechanism.q0, v)


def driven(mechanism: srm.Mechanism, joint: str) -> srm.Mechanism:
    """With a drive that goes on at the rate of that joint."""
    rate = float(mechanism.v0[mechanism.joint_names.index(joint)])
    return replace(mechanism, drives=(srm.Drive(srm.ConstantSpeed(rate), joint),))


DRIVEN = [(), ("O",), ("D",), ("A",)]
STARTS = [(1.0, 1.0, 0), (0.5, 2.0, 0), (-1.0, 1.0, 1), (1.0, 3.0, 1), (0.0, 1.0, 0)]


@slowly_on_both
@pytest.mark.parametrize("joint", DRIVEN, ids=lambda joint: "".join(joint) or "free")
@pytest.mark.parametrize("start", STARTS)
def test_the_motion_is_the_one_that_arrives_at_the_start_when_it_is_reversed(
    start: tuple[float, float, int], joint: tuple[str, ...], backend: str
) -> None:
    """SciPy on the index-1 equations back from the end, up to where they are ill-conditioned; the
    polynomial through its last states goes on to the start."""
    plain = in_line(*start)
    mechanism = driven(plain, *joint) if joint else plain
    late = np.linspace(0.2, 0.02, 10) / np.abs(mechanism.v0).max()
    run = srm.simulate(mechanism, late[0], rtol=1e-10, atol=1e-12, backend=backend)
    assert run.success, run.message
    assert run.drift.max() < 1e-10
    back = solve_ivp(
        reduced.index_one(plain, joint),
        (late[0], late[-1]),
        np.concatenate([run.q[-1], run.v[-1]]),
        method="DOP853",
        t_eval=late,
        rtol=1e-12,
        atol=1e-13,
    )
    assert back.success
    q, v = run(late)
    assert np.abs(back.y.T - np.hstack([q, v])).max() < 1e-7
    fitted = np.polynomial.Polynomial.fit
    at_start = [fitted(late, values, len(late) - 1)(0.0) for values in back.y]
    np.testing.assert_allclose(at_start[:4], mechanism.q0, atol=1e-7)
    np.testing.assert_allclose(at_start[4:], mechanism.v0, atol=1e-5)


@slowly_on_both
@pytest.mark.parametrize("joint", ["O", "A"])
def test_rates_off_the_cone_are_refused_with_the_nearest_ones_on_it(
    joint: str, backend: str
) -> None:
    """Assembled from there they are on it, and the motion starts."""
    mechanism = driven(in_line(1.0, 1.0, 0), joint)
    off = np.array(mechanism.v0)
    link, rocker = (mechanism.joint_names.index(name) for name in "CD")
    off[rocker] += 0.5
    off[link] += (ROCKER - LINK) / LINK * 0.5  # keeps the loop closed
    with pytest.raises(srm.InputError, match=r"nearest rates along a branch are \(D 9\."):
        srm.simulate(mechanism, 0.1, v0=off, backend=backend)
    state = srm.assemble(mechanism, mechanism.q0, off)
    assert np.abs(state.v - off).max() < 0.5
    run = srm.simulate(mechanism, 0.02, v0=state.v, rtol=1e-9, backend=backend)
    assert run.success, run.message
    assert run.energy_balance.relative < 1e-8
