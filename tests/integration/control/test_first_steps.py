"""First steps out of a rest that a drive ends: rate and acceleration of the drive begin at zero."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.model.laws import Curve, Law
from tests.support.backends import on_both
from tests.support.bundled import load
from tests.support.mechanisms import add_link

T_END = 1.003
"""End of the runs (s), no multiple of a period."""


@dataclass(frozen=True)
class Cycloid(Law):
    """s = way (x - sin(2 pi x) / (2 pi)), x = t / period: it rests once in every period."""

    type: ClassVar[str] = "cycloid"
    way: float
    period: float

    def curve(self, initial: float = 0.0) -> Curve:
        wave = (-self.way / (2.0 * np.pi), 2.0 * np.pi / self.period, 0.0)
        return Curve(pieces=((0.0, self.way / self.period),), sines=(wave,))


LAWS: dict[str, tuple[Law, float]] = {
    "fourth power": (srm.Polynomial([0.0, 0.0, 0.0, 0.0, 0.5]), 1.0),
    "ninth power": (srm.Polynomial([0.0] * 9 + [0.5]), 1.0),
    "slow cycloid": (Cycloid(1.0, 10.0), 10.0),
    "cycloid": (Cycloid(0.3, 1.0), 1.0),
    "fast cycloid": (Cycloid(1e-3, 0.03), 0.03),
}
"""Laws, and their time scales (s)."""


def hung_on_a_cart(law: Law) -> srm.Mechanism:
    """A rod of 1 m and 1 kg that hangs at rest from a driven cart, but for the rounding of pi."""
    model = pin.Model()
    model.name = "cart"
    cart = add_link(model, 0, pin.JointModelPX(), "cart")
    add_link(model, cart, pin.JointModelRY(), "rod")
    drive = srm.Drive(law, "cart")
    return srm.Mechanism(model, drives=(drive,), q0=[0.0, 0.5 * np.pi], v0=[0.0, 0.0])


@on_both
@pytest.mark.parametrize("name", LAWS)
def test_what_a_drive_takes_along_out_of_rest_moves_as_reduced_equations_have_it(
    name: str, backend: str
) -> None:
    """(1/3) phi'' = (g cos phi + s'' sin phi) / 2 for the rod's angle phi below the horizontal."""
    law, scale = LAWS[name]
    curve = law.curve(0.0)
    rod = srm.simulate(hung_on_a_cart(law), T_END, rtol=1e-9, backend=backend)
    exact = solve_ivp(
        lambda t, y: [y[1], 1.5 * (9.81 * np.cos(y[0]) + curve(t)[2] * np.sin(y[0]))],
        (0.0, T_END),
        [0.5 * np.pi, 0.0],
        method="DOP853",
        rtol=1e-13,
        atol=1e-14,
        max_step=0.05 * scale,
    )
    assert rod.success, rod.message
    assert np.abs([rod.q[-1, 1], rod.v[-1, 1]] - exact.y[:, -1]).max() < 1e-7
    assert 1e-3 * min(scale, T_END) < rod.steps.times[1] < 0.5 * scale


@on_both
@pytest.mark.parametrize("mechanism", ["four_bar", "slider_crank_slider", "parallelogram"])
@pytest.mark.parametrize("name", LAWS)
def test_closed_mechanisms_leave_their_rest_in_no_more_steps_than_from_a_chosen_first_one(
    name: str, mechanism: str, backend: str
) -> None:
    law, scale = LAWS[name]
    loaded = load(mechanism)
    crank = loaded.joint_names[0]
    driven = replace(loaded, drives=(srm.Drive(law, crank),))
    state = srm.assemble(driven, driven.q0)
    driven = driven.with_state(state.q, state.v)
    own = srm.simulate(driven, T_END, backend=backend)
    chosen = srm.simulate(driven, T_END, first_step=0.02 * min(scale, T_END), backend=backend)
    assert own.success, own.message
    assert "stiff" not in own.message.lower()
    assert own.stats.steps <= chosen.stats.steps + 3
    assert own.stats.rejected <= chosen.stats.rejected + 1
    curve = law.curve(0.0)
    moved = own.joint(crank)[0] - own.joint(crank)[0][0]
    expected = [curve(t)[0] - curve(0.0)[0] for t in own.t.tolist()]
    np.testing.assert_allclose(moved, expected, atol=1e-12)
