"""Closure types of one's own, given as objects in place of a name (docs/extending.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.analysis.summary import loop_rows
from srm_mbs.model.closures import ClosureType, ClosureValues, RowSet
from tests.support.backends import needs_kernel
from tests.support.mechanisms import add_link


def _rows(values: ClosureValues) -> RowSet:
    return RowSet(("height", "radius"), values.axis[None], distances=(values.length,))


CIRCLE = ClosureType("point_on_circle", ("a", "b", "axis", "length"), _rows, "on a circle")
MASS, WORLD = srm.Anchor("mass"), srm.Anchor("world")


def pendulum() -> srm.Mechanism:
    model = pin.Model()
    inertia = pin.Inertia(1.0, np.zeros(3), np.zeros((3, 3)))
    add_link(model, 0, pin.JointModelTranslation(), "mass", inertia)
    closure = srm.LoopClosure(CIRCLE, MASS, WORLD, axis=(0.0, 2.0, 0.0), length=0.5)
    return srm.Mechanism(model, loops=[closure], q0=[0.5, 0.0, 0.0])


def test_a_closure_type_of_ones_own_is_named_like_any_other() -> None:
    mechanism = pendulum()
    (loop,) = mechanism.loops
    assert loop.name == "point_on_circle_mass_world"
    assert loop.row_names == (f"{loop.name}.height", f"{loop.name}.radius")
    assert [row[:2] for row in loop_rows(mechanism)] == [(loop.name, "point_on_circle")]
    assert mechanism.degrees_of_freedom == 1


def test_a_key_that_a_closure_type_of_ones_own_needs_is_asked_for() -> None:
    with pytest.raises(srm.InputError, match="a point_on_circle closure needs a length"):
        srm.LoopClosure(CIRCLE, MASS, WORLD, axis=(0.0, 1.0, 0.0))
    with pytest.raises(srm.InputError, match="a point_on_circle closure takes no ratio"):
        srm.LoopClosure(CIRCLE, MASS, WORLD, axis=(0.0, 1.0, 0.0), length=1.0, ratio=2.0)


@needs_kernel
def test_both_backends_run_a_closure_type_of_ones_own() -> None:
    ends = [srm.simulate(pendulum(), 1.0, backend=name).q[-1] for name in ("kernel", "python")]
    assert ends[0] == pytest.approx(ends[1], abs=1e-10)


def test_a_run_with_a_closure_type_of_ones_own_is_not_saved_and_says_so(tmp_path: Path) -> None:
    run = srm.simulate(pendulum(), 0.1)
    with pytest.raises(srm.InputError, match="closure type 'point_on_circle' is not one of the"):
        run.save(tmp_path / "run.npz")
    assert not (tmp_path / "run.npz").exists()
