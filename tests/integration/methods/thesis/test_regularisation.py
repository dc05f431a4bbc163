"""The regularisation parameter eps, and up to which h/eps schemes are stable."""

from __future__ import annotations

from typing import Any

import pytest

import srm_mbs as srm
from srm_mbs.integration.methods.thesis.regularisation import parse_eps, real_stability_limit


@pytest.mark.parametrize(
    ("name", "limit"),
    [("fe", 2.0), ("trap", 2.0), ("tvd32", 2.51), ("erk4", 2.79), ("dopr54", 3.31)],
)
def test_real_stability_limits_are_the_known_ones(name: str, limit: float) -> None:
    assert real_stability_limit(srm.TABLEAUS[name]) == pytest.approx(limit, abs=6e-3)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        (0.3, 0.3),
        ("h", 0.01),
        ("5h", 0.05),
        ("0.5 * h", 0.005),
        ("h^0.5", 0.1),
        ("h^(2/3)", 0.01 ** (2 / 3)),
        ("2h**2", 2e-4),
    ],
)
def test_eps_is_a_time_a_multiple_or_a_power_of_the_step(text: Any, value: float) -> None:
    assert parse_eps(text)(0.01) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    "eps", [0.0, -1.0, float("nan"), "-h", "0h", "k", "h^", "h^(1/0)", "h+1", "", None, True, [1]]
)
def test_any_other_eps_is_refused(eps: Any) -> None:
    with pytest.raises(srm.InputError, match="eps"):
        parse_eps(eps)
