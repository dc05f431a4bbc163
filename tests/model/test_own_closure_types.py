"""Closure types of one's own, given as objects in place of a name (docs/extending.md)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.analysis.summary import loop_rows
from srm_mbs.model.closures import ClosureType, ClosureValues, JointRow, RowSet
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


def test_a_type_of_the_package_is_the_same_by_its_name_and_as_an_object() -> None:
    for name, kind in srm.CLOSURE_TYPES.items():
        if kind.needs == ("a", "b"):
            by_name = srm.LoopClosure(name, MASS, WORLD)
            assert srm.LoopClosure(kind, MASS, WORLD) == by_name
    assert srm.LoopClosure(srm.CLOSURE_TYPES["distance"], MASS, WORLD).type == "distance"


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


ONE_AXIS = np.array([[0.0, 1.0, 0.0]])
OF_PLANE = ("a", "b", "axis")


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        (lambda v: None, "the rows of the type 'own' are None. Return a RowSet"),
        (lambda v: RowSet(("x",), v.axis), "are not unit vectors. Give an array of shape (n, 3)"),
        (lambda v: RowSet(("x",), 2.0 * ONE_AXIS), "are not unit vectors"),
        (lambda v: RowSet(("x",), np.nan * ONE_AXIS), "are not unit vectors"),
        (lambda v: RowSet(("x",), alignments=ONE_AXIS), "Give an array of shape (n, 2, 3)"),
        (lambda v: RowSet(("x",), distances=(np.nan,)), "the distances (nan,) are not positive"),
        (lambda v: RowSet(("x",), distances=(-1.0,)), "the distances (-1.0,) are not positive"),
        (lambda v: RowSet(("x", "y"), ONE_AXIS), "1 rows have the labels ('x', 'y')"),
        (lambda v: RowSet(("x", "x"), np.eye(3)[:2]), "2 rows have the labels ('x', 'x')"),
        (lambda v: RowSet(("x", "x"), ONE_AXIS), "1 rows have the labels ('x', 'x')"),
        (lambda v: RowSet("x", ONE_AXIS), "1 rows have the labels 'x'"),
        (lambda v: RowSet(([],), ONE_AXIS), "1 rows have the labels ([],)"),
        (lambda v: RowSet(()), "0 rows have the labels ()"),
    ],
)
def test_rows_that_cannot_be_evaluated_are_refused_with_their_closure(
    rows: Callable[[ClosureValues], Any], problem: str
) -> None:
    own = ClosureType("own", OF_PLANE, rows, "of a test")
    with pytest.raises(srm.InputError) as caught:
        srm.LoopClosure(own, MASS, WORLD, axis=(0.0, 1.0, 0.0), name="c")
    assert str(caught.value).startswith("loop 'c': ")
    assert problem in str(caught.value)


def test_rows_may_be_lists_and_integers() -> None:
    own = ClosureType("own", OF_PLANE, lambda v: RowSet(["y"], [[0, 1, 0]]), "of a test")  # type: ignore[arg-type]
    rows = srm.LoopClosure(own, MASS, WORLD, axis=(0.0, 1.0, 0.0)).rows
    assert rows.labels == ("y",)
    np.testing.assert_array_equal(rows.directions, ONE_AXIS)


def test_a_type_that_needs_an_unknown_key_is_refused_with_the_keys_that_there_are() -> None:
    own = ClosureType("own", ("a", "b", "radius"), _rows, "of a test")
    with pytest.raises(srm.InputError, match=r"'own' needs or takes 'radius'.* Known: a, b, axis"):
        srm.LoopClosure(own, MASS, WORLD)


def test_rows_between_anchors_need_anchors() -> None:
    own = ClosureType("own", ("axis",), lambda v: RowSet(("x",), v.axis[None]), "of a test")
    with pytest.raises(srm.InputError, match="rows between anchors need a and b"):
        srm.LoopClosure(own, axis=(0.0, 1.0, 0.0))


JOINTS = ("first", "second")


def _squared(values: ClosureValues) -> RowSet:
    """q_first = ratio q_second^2."""
    row = values.joint_row
    factor = -row.coefficients[1]
    own = JointRow(row.joints, (1.0, 0.0), arguments=(0.0, 1.0), powers=(factor,))
    return RowSet(("square",), joint_rows=(own,))


def test_a_relation_of_joints_of_ones_own_acts_and_is_shown_as_it_is() -> None:
    square = ClosureType("square", ("joints", "ratio"), _squared, "of a test")
    closure = srm.LoopClosure(square, joints=JOINTS, ratio=0.5, name="cam")
    model = pin.Model()
    for name in JOINTS:
        add_link(model, 0, pin.JointModelRY(), name, pin.Inertia(1.0, np.zeros(3), np.eye(3)))
    mechanism = srm.Mechanism(model, loops=[closure], q0=[0.5, 1.0], v0=[1.0, 1.0])
    run = srm.simulate(mechanism, 1.0)
    assert run.q[:, 0] == pytest.approx(0.5 * run.q[:, 1] ** 2, abs=1e-12)
    assert next(loop_rows(mechanism))[3] == "+1 first = 0 +0.5 y^2, y = +1 second"


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        (lambda row: [JointRow(("first",), (1.0,))], "is not over the joints of the closure"),
        (lambda row: [JointRow(("other",), (1.0,))], "is not over the joints of the closure"),
        (lambda row: [JointRow(JOINTS, (1.0,))], "coefficients must be 2 finite numbers"),
        (lambda row: [JointRow(JOINTS, (1.0, np.inf))], "coefficients must be 2 finite numbers"),
        (lambda row: [JointRow(JOINTS, (1.0, 1.0), powers=(1.0,))], "arguments must be 2 finite"),
        (lambda row: [row, JointRow(JOINTS, (1.0, 1.0))], "is joined with other rows"),
    ],
)
def test_joint_rows_that_cannot_be_evaluated_are_refused(
    rows: Callable[[JointRow], list[JointRow]], problem: str
) -> None:
    def own(values: ClosureValues) -> RowSet:
        made = tuple(rows(values.joint_row))
        return RowSet(tuple("xyz"[: len(made)]), joint_rows=made)

    kind = ClosureType("own", ("joints", "ratio"), own, "of a test")
    with pytest.raises(srm.InputError) as caught:
        srm.LoopClosure(kind, joints=JOINTS, ratio=2.0)
    assert problem in str(caught.value)


def test_a_joint_row_beside_rows_between_anchors_is_refused() -> None:
    def own(values: ClosureValues) -> RowSet:
        return RowSet(("x", "gear"), values.axis[None], joint_rows=(values.joint_row,))

    kind = ClosureType("own", (*OF_PLANE, "joints", "ratio"), own, "of a test")
    with pytest.raises(srm.InputError, match="a joint row is joined with other rows"):
        srm.LoopClosure(kind, MASS, WORLD, axis=(0.0, 1.0, 0.0), joints=JOINTS, ratio=2.0)
