"""Degrees of freedom counted and true; joints that are stuck or idle; rows that share a load."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.mobility import IdleMotion
from tests.model.test_joint_closures import Tree
from tests.support.mechanisms import floating_ring

WORLD = srm.Anchor("world")


def counts(mechanism: srm.Mechanism) -> tuple[int, int | None, int, int]:
    found = mechanism.mobility
    assert found.gruebler == found.joint_freedoms - found.rows
    assert found.degrees_of_freedom == found.joint_freedoms - found.rank
    return found.gruebler, found.planar_gruebler, found.rank, found.degrees_of_freedom


def test_a_planar_loop_is_counted_in_the_plane() -> None:
    mechanism = srm.load("four_bar")
    assert counts(mechanism) == (0, 1, 2, 1)
    found = mechanism.mobility
    assert found.redundant_rows == found.indeterminate_rows == ("pin.y",)
    assert found.unreachable_joints == ()
    assert found.idle == ()
    assert mechanism.with_state(mechanism.q0, mechanism.v0).mobility is found


def test_a_parallelogram_on_three_cranks_moves_against_both_counts() -> None:
    """Three equal parallel cranks under one bar: planar count 0, true 1."""
    tree = Tree()
    tree.body("crank", pin.JointModelRY(), lever=(0.5, 0, 0))
    tree.body("bar", pin.JointModelRY(), "crank", (1, 0, 0))
    for k in (1, 2):
        tree.body(f"crank_{k}", pin.JointModelRY(), at=(k, 0, 0), lever=(0.5, 0, 0))
    loops = tuple(
        srm.LoopClosure(
            "point", srm.Anchor("bar", xyz=(k, 0, 0)), srm.Anchor(f"crank_{k}", xyz=(1, 0, 0))
        )
        for k in (1, 2)
    )
    mechanism = srm.Mechanism(tree.model, loops, q0=[0.7, -0.7, 0.7, 0.7])
    assert counts(mechanism) == (-2, 0, 3, 1)
    assert mechanism.mobility.pivoted_redundancy == 1
    # Out of the plane, and along the cranks: x in the axes of the crank that is anchor b.
    assert set(mechanism.mobility.indeterminate_rows) == {
        f"{loop.name}.{row}" for loop in loops for row in "xy"
    }


def test_bricards_linkage_moves_although_the_count_says_it_cannot() -> None:
    mechanism = srm.load("bricard")
    assert counts(mechanism) == (0, None, 4, 1)
    found = mechanism.mobility
    assert found.pivoted_redundancy == 1
    assert found.redundant_rows == ()
    assert found.indeterminate_rows
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    G = geometry.normalised(mechanism.q0)
    for i, name in enumerate(mechanism.structure.row_names):
        others = np.linalg.matrix_rank(np.delete(G, i, axis=0), tol=1e-9)
        # Where the others do what this row does, the load that it carries is undetermined.
        if others == 4:
            assert name in found.indeterminate_rows


def test_a_stiff_triangle_and_a_pendulum() -> None:
    """Two hinges of a triangle are stuck, the pendulum is free of the loop."""
    tree = Tree().body("one", pin.JointModelRY(), lever=(0.5, 0, 0))
    tree.body("two", pin.JointModelRY(), "one", (1, 0, 0), lever=(0.5, 0, 0))
    tree.body("pendulum", pin.JointModelRY(), at=(5, 0, 0), lever=(0.5, 0, 0))
    loop = srm.LoopClosure(
        "point", srm.Anchor("two", xyz=(1, 0, 0)), srm.Anchor("world", xyz=(1, 0, 0)), name="tip"
    )
    state = srm.assemble(srm.Mechanism(tree.model, (loop,), q0=[-1.0, 2.0, 0.1]))
    mechanism = srm.Mechanism(tree.model, (loop,), q0=state.q)
    assert counts(mechanism) == (0, 1, 2, 1)
    found = mechanism.mobility
    assert found.unreachable_joints == ("one", "two")
    assert found.idle == (IdleMotion(("pendulum",), 1),)


def test_the_spin_of_a_rod_between_ball_joints_is_idle() -> None:
    """As a ball joint of Pinocchio's, and as three hinges with massless links between them."""
    four_bar = srm.load("spatial_four_bar").mobility
    (idle,) = four_bar.idle
    assert idle.directions == 1
    assert idle.joints == ("coupler", "coupler_elevation", "coupler_spin")
    crank = Tree().body("crank", pin.JointModelRZ(), lever=(0.2, 0, 0))
    crank.body("rod", pin.JointModelSpherical(), "crank", (0.4, 0, 0), lever=(0.5, 0, 0))
    crank.body("rocker", pin.JointModelRY(), at=(1.2, 0, 0), lever=(0, 0, 0.3))
    loop = srm.LoopClosure(
        "point", srm.Anchor("rod", xyz=(1.0, 0, 0)), srm.Anchor("rocker", xyz=(0, 0, 0.6)), name="c"
    )
    guess = srm.Mechanism(crank.model, (loop,))
    found = guess.with_state(srm.assemble(guess).q, np.zeros(5)).mobility
    assert found.idle == (IdleMotion(("rod",), 1),)
    assert found.degrees_of_freedom == 2
    assert found.indeterminate_rows == ()


def test_parts_of_a_free_ring_spin_between_their_ball_joints() -> None:
    """The base moves all of it; each ball joint turns what is behind it about the line through it
    and the closing ball joint."""
    found = floating_ring().mobility
    expected = [(("a",), 6), (("b",), 1), (("c",), 1), (("d",), 1)]
    assert [(motion.joints, motion.directions) for motion in found.idle] == expected


def test_an_open_chain_has_no_idle_joints() -> None:
    found = srm.load("pendulum_chain").mobility
    assert found.rows == found.rank == 0
    assert found.gruebler == found.degrees_of_freedom == found.joint_freedoms
    assert found.idle == found.unreachable_joints == found.indeterminate_rows == ()


@pytest.mark.parametrize(
    ("joints", "expected"),
    [
        (["PX", "PZ"], True),
        (["PX", "PY", "PZ"], False),
        (["RY", "PX", "RY", "PZ"], True),
        (["RY", "PY"], False),
        (["RY", "RX"], False),
        (["Planar"], True),
    ],
)
def test_what_moves_in_a_plane_is_recognised(joints: list[str], expected: bool) -> None:
    tree = Tree()
    for parent, (k, kind) in zip(["universe", "0", "1", "2"], enumerate(joints)):
        tree.body(str(k), getattr(pin, f"JointModel{kind}")(), parent, (0.3, 0, 0))
    found = srm.Mechanism(tree.model).mobility
    assert (found.planar_gruebler is not None) == expected


def table(legs: list[tuple[float, float]], lever: tuple[float, float]) -> srm.Mechanism:
    """A table of 2 kg, its centre of mass at ``lever``, on point-like legs."""
    tree = Tree((0.0, 0.0, -10.0))
    tree.body("top", pin.JointModelFreeFlyer(), mass=2.0, lever=(*lever, 0.3))
    loops = tuple(
        srm.LoopClosure(
            "point_on_plane", srm.Anchor("top", xyz=(x, y, 0.0)), WORLD, (0, 0, 1), name=f"leg_{k}"
        )
        for k, (x, y) in enumerate(legs)
    )
    return srm.Mechanism(tree.model, loops)


def loads(mechanism: srm.Mechanism) -> np.ndarray:
    run = srm.simulate(mechanism, 0.01, step=0.01)
    assert run.indeterminate_reactions == mechanism.mobility.indeterminate_rows
    return np.array([-wrench[0, 2] for wrench in run.reactions.values()])


def test_three_legs_carry_what_statics_says_and_four_share_it_somehow() -> None:
    lever = (0.1, -0.2)
    three = table([(1, 1), (-1, 1), (0, -1)], lever)
    assert three.mobility.indeterminate_rows == ()
    statics = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -1.0]])
    expected = np.linalg.solve(statics, 20.0 * np.array([1.0, *lever]))
    np.testing.assert_allclose(loads(three), expected, atol=1e-9)
    corners = [(1, 1), (-1, 1), (-1, -1), (1, -1)]
    four = table(corners, lever)
    assert four.mobility.pivoted_redundancy == 1
    assert four.mobility.indeterminate_rows == tuple(f"leg_{k}.normal" for k in range(4))
    found = loads(four)
    positions = np.array([[1, *corner] for corner in corners], dtype=float).T
    np.testing.assert_allclose(positions @ found, 20.0 * np.array([1.0, *lever]), atol=1e-9)
    # Of least norm in the scaled rows: nothing along the one combination that carries nothing.
    scale = four.structure.row_scale
    assert scale**2 * found @ [1, -1, 1, -1] == pytest.approx(0.0, abs=1e-8)


def test_one_loop_may_be_determined_beside_one_that_is_not() -> None:
    """A door on two hinges beside a four-bar whose plane needs no force."""
    tree = Tree((0.0, 0.0, -10.0)).body("door", pin.JointModelRZ(), lever=(0.4, 0, 0))
    tree.body("arm", pin.JointModelRY(), at=(5, 0, 0), lever=(0.5, 0, 0))
    tree.body("stay", pin.JointModelSpherical(), "arm", (1, 0, 0), lever=(0.5, 0, 0))
    loops = (
        srm.LoopClosure(
            "revolute", srm.Anchor("door", xyz=(0, 0, 2)), srm.Anchor("world", xyz=(0, 0, 2)),
            (0, 0, 1), name="hinge",
        ),
        srm.LoopClosure(
            "point_on_line", srm.Anchor("stay", xyz=(1, 0, 0)), srm.Anchor("world"), (1, 0, 0),
            name="rail",
        ),
    )  # fmt: skip
    start = srm.Mechanism(tree.model, loops)
    state = srm.assemble(start, guess={"arm": -0.6, "stay": [0.0, 0.6, 0.0, 0.8]})
    mechanism = start.with_state(state.q, np.zeros(5))
    found = mechanism.mobility
    assert found.redundant_rows == tuple(f"hinge.{row}" for row in loops[0].rows.labels)
    assert found.indeterminate_rows == found.redundant_rows


@pytest.mark.parametrize("name", ["five_bar", "parallelogram", "slider_crank", "n_four_bar_2"])
def test_the_counts_of_bundled_models_are_consistent(name: str) -> None:
    mechanism = srm.load(name)
    found = mechanism.mobility
    assert counts(mechanism)[3] == mechanism.degrees_of_freedom
    assert set(found.redundant_rows) <= set(found.indeterminate_rows)
    redundant = len(found.redundant_rows) + found.pivoted_redundancy
    assert found.rank + redundant == found.rows
    assert bool(found.indeterminate_rows) == bool(redundant)
    if found.planar_gruebler is not None:
        assert found.planar_gruebler >= found.gruebler


def test_compounds_end_at_mass_anchors_and_branches() -> None:
    """Hinges in a row are one joint only where nothing else holds the links between."""

    def chain(masses: list[float], anchored: str | None = None) -> Any:
        tree = Tree()
        for (parent, k), mass in zip(pairwise(["universe", "0", "1", "2"]), masses):
            joint = pin.JointModelRevoluteUnaligned(np.eye(3)[int(k)])
            tree.body(k, joint, parent, mass=mass, inertia=0.1 if mass else 0.0)
        end = srm.Anchor("2", xyz=(1.0, 0.0, 0.0))
        loops = [srm.LoopClosure("point_on_plane", end, WORLD, (0, 0, 1), name="floor")]
        if anchored is not None:
            at = srm.Anchor(anchored, xyz=(0, 0.0, 0.0))
            loops.append(srm.LoopClosure("point_on_plane", at, WORLD, (0, 0, 1), name="other"))
        return srm.Mechanism(tree.model, tuple(loops)).mobility

    assert chain([0.0, 0.0, 1.0]).idle == (IdleMotion(("0", "1", "2"), 2),)
    assert [m.joints for m in chain([1.0, 1.0, 1.0]).idle] == []
    assert [m.joints for m in chain([0.0, 1.0, 1.0]).idle] == [("0", "1")]


def test_drives_take_freedoms_and_share_what_they_hold_together() -> None:
    """Mobility counts the loops; two motors on one degree of freedom cannot be told apart."""
    loaded = srm.load("four_bar")

    def driven(*names: str) -> srm.Mechanism:
        drives = tuple(srm.Drive(srm.ConstantSpeed(0.0), joint=name) for name in names)
        return replace(loaded, drives=drives)

    one = driven("crank")
    assert one.degrees_of_freedom == 0
    assert one.mobility.degrees_of_freedom == 1
    assert one.mobility.unreachable_joints == ()
    assert one.mobility.indeterminate_rows == ("pin.y",)
    two = driven("crank", "rocker")
    assert set(two.mobility.indeterminate_rows) == {"pin.x", "pin.y", "pin.z", "crank", "rocker"}
