"""Observed orders of convergence of the split PSRM (see ``tests/convergence.py``)."""

from __future__ import annotations

import pinocchio as pin
import pytest

import srm_mbs as srm
from tests.support.convergence import observed_order, turning
from tests.support.mechanisms import floating_ring


@pytest.mark.parametrize("tableau", ["fe", "trap", "heun", "tvd32", "erk4"])
def test_split_psrm_has_the_order_of_its_tableau(tableau: str) -> None:
    order = observed_order(turning("slider_crank_regular", 2.0), srm.PSRM(tableau))
    assert order == pytest.approx(srm.TABLEAUS[tableau].order, abs=0.2)


def test_split_psrm_with_dopr54_has_order_five() -> None:
    order = observed_order(turning("four_bar", 4.0), srm.PSRM("dopr54"))
    assert order == pytest.approx(5.0, abs=0.2)


def test_split_psrm_with_dop853_has_order_at_least_seven_and_a_half() -> None:
    assert observed_order(turning("slider_crank_regular", 2.0), srm.PSRM("dop853")) >= 7.5


@pytest.mark.parametrize("tableau", ["fe", "trap", "heun", "tvd32", "erk4"])
def test_configurations_on_lie_groups_keep_the_full_order(tableau: str) -> None:
    order = observed_order(floating_ring(), srm.PSRM(tableau))
    assert order == pytest.approx(srm.TABLEAUS[tableau].order, abs=0.2)


def test_high_orders_survive_on_lie_groups() -> None:
    ring = floating_ring()
    assert observed_order(ring, srm.PSRM("dopr54"), (0.04, 0.02, 0.01)) >= 4.8
    assert observed_order(ring, srm.PSRM("dop853")) >= 7.5


def test_planar_roots_keep_the_full_order() -> None:
    ring = floating_ring(root=pin.JointModelPlanar())
    assert observed_order(ring, srm.PSRM("erk4")) == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize("eps", [0.05, 0.5])
def test_a_finite_regularisation_keeps_the_order(eps: float) -> None:
    order = observed_order(turning("slider_crank_regular", 2.0), srm.PSRM("erk4", eps=eps))
    assert order == pytest.approx(4.0, abs=0.3)
