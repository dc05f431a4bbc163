"""Variants of a mechanism have the structure of their origin, with other parameters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.generated.code import structure_of_mechanism
from srm_mbs.integration.generated.structure import Origin, parameters_of_variant, structure_of

BARS = """format = 1
[parameters]
crank = 0.4
mass = 1.2
height = 0.1
along = 10.0
[planar]
angle = "deg"
ground = ["O"]
mass_per_length = "=mass"
gravity = [0.0, -9.81]
[planar.points]
O = [0.02, "=height"]
A = ["=0.6*crank", "=0.8*crank"]
B = ["=0.6*crank + 0.9", 0.3]
[[planar.bar]]
name = "crank"
points = ["O", "A"]
[[planar.bar]]
name = "rod"
points = ["A", "B"]
[[planar.slider]]
name = "ram"
point = "B"
along = "=along"
mass = "=mass"
"""
DRIVE = """[[planar.drive]]
pin = "O"
type = "constant_speed"
speed = 90.0
"""


@pytest.fixture(params=["", DRIVE], ids=["free", "driven"])
def bars(request: pytest.FixtureRequest, tmp_path: Path) -> srm.Mechanism:
    path = tmp_path / "bars.toml"
    path.write_text(BARS + request.param, encoding="utf-8")
    return srm.load(path)


def origin(mechanism: srm.Mechanism) -> Origin:
    """A mechanism as the origin of others."""
    constants = make_system(mechanism).constants()
    return Origin.of(mechanism, *structure_of(mechanism.model, constants))


def parameters(variant: srm.Mechanism, base: srm.Mechanism) -> np.ndarray | None:
    """The parameters of a variant, found from those of another one."""
    return parameters_of_variant(variant, origin(base))


@pytest.mark.parametrize("values", [{}, {"crank": 0.42}, {"mass": 1.5}, {"crank": 0.3, "mass": 9}])
def test_parameters_of_a_variant_are_those_of_its_own_structure_to_the_last_bit(
    values: dict[str, float], bars: srm.Mechanism
) -> None:
    variant = bars.with_parameters(**values)
    structure, expected = structure_of(variant.model, make_system(variant).constants())
    assert structure == origin(bars).structure
    found = parameters(variant, bars)
    assert found is not None
    assert np.array_equal(found, expected)
    known, own = structure_of_mechanism(variant)
    assert known is structure_of_mechanism(bars)[0]
    assert np.array_equal(own, expected)


@pytest.mark.parametrize(
    ("values", "why"),
    [({"height": 0.0}, "a number of a placement is 0"), ({"along": 12.0}, "an axis is another")],
)
def test_a_variant_with_other_zeros_or_axes_has_its_own_structure(
    values: dict[str, float], why: str, bars: srm.Mechanism
) -> None:
    variant = bars.with_parameters(**values)
    # Only mechanisms of one tree are compared.
    other_tree = variant.tree_results is not bars.tree_results
    assert other_tree or parameters(variant, bars) is None, why
    structure, expected = structure_of_mechanism(variant)
    assert (structure, expected.tolist()) == (
        (own := structure_of(variant.model, make_system(variant).constants()))[0],
        own[1].tolist(),
    )


def test_changes_of_anything_else_are_found(bars: srm.Mechanism) -> None:
    lighter, damped = bars.model.copy(), bars.model.copy()
    lighter.gravity.linear = np.array([0.0, 0.0, -1.62])
    damped.damping = np.full(bars.model.nv, 0.1)
    anchor = srm.Anchor("rod")
    wind = srm.Wrench(anchor, (1.0, 0.0, 0.0), name="wind")
    for other in (
        replace(bars, model=lighter),
        replace(bars, model=damped),
        replace(bars, loops=()),
        replace(bars, forces=(wind,)),
        srm.load("klann_walker"),
    ):
        found = parameters(other, bars)
        structure, own = structure_of(other.model, make_system(other).constants())
        if found is not None:
            assert structure == origin(bars).structure
            assert np.array_equal(found, own)
        else:
            assert structure != origin(bars).structure or not np.array_equal(
                own, origin(bars).parameters
            )
    assert parameters(replace(bars, forces=(wind,)), bars) is None
