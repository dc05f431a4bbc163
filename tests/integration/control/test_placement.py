"""The slope of sigma by which steps are placed."""

from __future__ import annotations

import numpy as np
import pytest

from srm_mbs.integration.control.placement import inverse_abscissae, sigma_slope
from srm_mbs.integration.methods.tableaus import get_tableau


def test_a_jump_of_a_sigma_that_scatters_is_a_slope_over_the_whole_step_at_most_fourfold() -> None:
    scheme = get_tableau("dop853")
    jumped = np.where(scheme.abscissae > 0.0, 0.4, 0.3)
    assert sigma_slope(inverse_abscissae(scheme), jumped, 1.0) > 1.8
    assert sigma_slope(inverse_abscissae(scheme, True), jumped, 1.0) == pytest.approx(0.4)


def test_the_slope_of_a_passage_is_half_known_wherever_in_a_step_its_zero_lies() -> None:
    scheme = get_tableau("dop853")
    for zero in np.linspace(0.0, 1.0, 41):
        sigmas = 2.0 * np.abs(scheme.abscissae - zero)
        assert (
            1.0 - 1e-12 <= sigma_slope(inverse_abscissae(scheme, True), sigmas, 1.0) <= 2.0 + 1e-12
        )
