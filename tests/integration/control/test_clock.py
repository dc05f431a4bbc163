"""Times far from zero are coarse: steps are as long as their times are apart."""

from __future__ import annotations

import numpy as np
import pytest

from srm_mbs.integration.control.step_size import Proposal
from tests.support.backends import on_both
from tests.support.bundled import finished, load


@pytest.mark.parametrize("t", [0.0, 0.3, 1000.0])
def test_steps_at_usual_times_have_the_length_that_was_asked_for(t: float) -> None:
    assert Proposal.over(t, 0.01 / 3.0) == Proposal(0.01 / 3.0, t + 0.01 / 3.0)


@pytest.mark.parametrize("t", [1e6, 1.7e9, -1e9])
def test_steps_at_coarse_times_are_as_long_as_their_times_are_apart(t: float) -> None:
    proposal = Proposal.over(t, 0.01 / 3.0, placed=True)
    assert proposal.h == proposal.t_new - t != 0.01 / 3.0
    assert proposal.h == pytest.approx(0.01 / 3.0, abs=np.spacing(abs(t)))
    assert proposal.placed


@on_both
@pytest.mark.parametrize("t0", [1e6, 1.7e9])
@pytest.mark.parametrize("name", ["four_bar", "slider_crank"])
def test_the_motion_of_a_late_start_is_that_from_time_zero(
    name: str, t0: float, backend: str
) -> None:
    """Seconds since 1970 are known to 2e-7 s; 200 steps whose lengths are not erred by 1e-6 rad."""
    mechanism, options = load(name), {"rtol": 1e-9, "backend": backend}
    early = finished(mechanism, 2.0, **options)
    late = finished(mechanism, t0 + 2.0, t0=t0, **options)
    assert len(late.crossings) == len(early.crossings)
    np.testing.assert_allclose(late.q[-1], early.q[-1], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(late.v[-1], early.v[-1], rtol=0.0, atol=1e-11)
