"""Observed orders of convergence of the split PSRM (see ``tests/support/convergence.py``)."""

from __future__ import annotations

from collections.abc import Callable

import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.convergence import observed_order, turning
from tests.support.mechanisms import floating_ring

LOW = ["fe", "trap", "heun", "tvd32", "erk4"]


@pytest.mark.parametrize(
    ("tableau", "mechanism"),
    [
        *((tableau, lambda: turning("slider_crank_regular", 2.0)) for tableau in LOW),
        ("dopr54", lambda: turning("four_bar", 4.0)),
        *((tableau, floating_ring) for tableau in LOW),
        ("erk4", lambda: floating_ring(root=pin.JointModelPlanar())),
    ],
    ids=[*LOW, "dopr54", *(f"{tableau} on a Lie group" for tableau in LOW), "planar root"],
)
def test_split_psrm_has_the_order_of_its_tableau(
    tableau: str, mechanism: Callable[[], srm.Mechanism]
) -> None:
    order = observed_order(mechanism(), srm.PSRM(tableau))
    assert order == pytest.approx(srm.TABLEAUS[tableau].order, abs=0.2)


def test_high_orders_hold_on_lie_groups_too() -> None:
    """So does dop853: its errors reach round-off before its order shows exactly."""
    ring = floating_ring()
    assert observed_order(ring, srm.PSRM("dopr54"), (0.04, 0.02, 0.01)) >= 4.8
    for mechanism in (ring, turning("slider_crank_regular", 2.0)):
        assert observed_order(mechanism, srm.PSRM("dop853")) >= 7.5


@pytest.mark.parametrize("eps", [0.05, 0.5])
def test_a_finite_regularisation_keeps_the_order(eps: float) -> None:
    order = observed_order(turning("slider_crank_regular", 2.0), srm.PSRM("erk4", eps=eps))
    assert order == pytest.approx(4.0, abs=0.3)
