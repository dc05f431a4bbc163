"""An assembly that fails says why."""

from __future__ import annotations

import numpy as np
import pytest

import srm_mbs as srm
from tests.support.bundled import load

# Crank 1, coupler 2, rocker 1.5, ground 2.2: the rocker's range.
LOWEST = np.pi - np.arccos((1.5**2 + 2.2**2 - 9.0) / (2.0 * 1.5 * 2.2))
HIGHEST = np.pi - np.arccos((1.5**2 + 2.2**2 - 1.0) / (2.0 * 1.5 * 2.2))


def limited(name: str, **ranges: tuple[float, float]) -> srm.Mechanism:
    bundled = load(name)
    model = bundled.model.copy()
    low, high = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    for joint, (least, largest) in ranges.items():
        i = bundled.joint(joint).idx_q
        low[i], high[i] = least, largest
    model.lowerPositionLimit, model.upperPositionLimit = low, high
    return srm.Mechanism(model, bundled.loops, q0=bundled.q0)


@pytest.mark.parametrize(("asked", "nearest"), [(3.0, HIGHEST), (0.5, LOWEST)])
def test_it_names_the_nearest_value_of_the_held_joint_that_closes(asked, nearest) -> None:
    mechanism = load("four_bar")
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(mechanism, {"rocker": asked})
    error = caught.value
    assert error.held == ("rocker",)
    np.testing.assert_allclose(error.nearest["rocker"], nearest, atol=1e-11)
    assert f"rocker = {nearest:.6f}"[:14] in str(error)
    gap, angle = error.residuals["pin"]
    assert gap > 0.01
    assert angle is None
    # just inside it closes, just outside it does not
    inwards = np.sign(2.0 - nearest) * 1e-6
    srm.assemble(mechanism, {"rocker": nearest + inwards})
    with pytest.raises(srm.AssemblyError):
        srm.assemble(mechanism, {"rocker": nearest - inwards})


def test_of_two_contradicting_values_each_gets_the_one_that_fits_the_other() -> None:
    mechanism = load("four_bar")
    with pytest.raises(srm.AssemblyError) as caught:
        srm.assemble(mechanism, {"crank": 1.0, "rocker": 1.6})
    assert set(caught.value.nearest) == {"crank", "rocker"}
    for name, other in (("crank", {"rocker": 1.6}), ("rocker", {"crank": 1.0})):
        fits = srm.assemble(mechanism, {name: caught.value.nearest[name], **other}).q
        assert fits.shape == (3,)


def test_limits_choose_the_branch_within_them() -> None:
    bundled = load("four_bar")
    other = srm.assembly_modes(bundled, {"crank": 1.0}, starts=20)[1].q
    mechanism = limited("four_bar", rocker=(other[2] - 0.3, other[2] + 0.3))
    free = srm.assemble(mechanism, {"crank": 1.0})
    np.testing.assert_allclose(free.q, bundled.q0, atol=1e-12)
    within = srm.assemble(mechanism, {"crank": 1.0}, limits=True)
    np.testing.assert_allclose(within.q, other, atol=1e-10)
    # where they are kept anyway nothing changes
    np.testing.assert_array_equal(
        srm.assemble(bundled, {"crank": 1.0}, limits=True).q,
        srm.assemble(bundled, {"crank": 1.0}).q,
    )


def test_limits_in_the_way_are_named() -> None:
    mechanism = limited("four_bar", rocker=(2.0, 2.5), coupler=(-3.0, 3.0))
    with pytest.raises(srm.AssemblyError, match="not within the limits of 'rocker'") as caught:
        srm.assemble(mechanism, {"crank": 1.0}, limits=True)
    assert caught.value.limits == ("rocker",)
    assert "rocker at 1.41" in str(caught.value)
    assert "limit 2" in str(caught.value)
    held = limited("four_bar", crank=(1.5, 2.0))
    with pytest.raises(srm.AssemblyError, match="limits of 'crank'") as caught:
        srm.assemble(held, {"crank": 1.0}, limits=True)
    assert caught.value.held == ("crank",)
