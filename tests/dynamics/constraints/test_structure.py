"""Ranks, degrees of freedom and redundant rows, whatever the start, the units and the pose."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints import structure
from srm_mbs.dynamics.constraints.projection import symmetric
from srm_mbs.dynamics.constraints.rows import Elimination, LoopKinematics
from srm_mbs.dynamics.constraints.structure import ManifoldSampler, Structure, analyse
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem, make_system
from tests.support.bundled import load
from tests.support.mechanisms import (
    DISTINCT_MODELS,
    add_link,
    along_x,
    floating_ring,
    rescaled,
    rod,
    start_terms,
    with_slider_mass,
)

assert_close = partial(np.testing.assert_allclose, rtol=0.0)


Z_AXIS = (0.0, 0.0, 1.0)

# name: (nv, rank, redundant rows)
JANSEN = tuple(
    f"{side}_{k}_{pin}.y"
    for k in range(2)
    for side in ("left", "right")
    for pin in ("above", "below", "ankle")
)
KLANN = ("elbow.y", "knee.y", "elbow_r.y", "knee_r.y")
KNOWN = {
    "bricard": (5, 4, ()),
    "delta_robot": (21, 18, ()),
    "differential": (6, 4, ()),
    "five_bar": (4, 2, ("pin.y",)),
    "flyball_governor": (4, 0, ()),
    "four_bar": (3, 2, ("pin.y",)),
    "jansen_walker": (25, 24, JANSEN),
    "klann_walker": (9, 8, KLANN),
    "n_four_bar_1": (3, 2, ("pin_0.y",)),
    "n_four_bar_2": (5, 4, ("pin_0.y", "pin_1.y")),
    "parallelogram": (3, 2, ("pin.y",)),
    "pendulum_chain": (3, 0, ()),
    "quick_return": (5, 4, ("A.y", "D.y")),
    "scissor_lift": (5, 4, ("upper.y",)),
    "simple_pendulum": (1, 0, ()),
    "slider_crank": (2, 1, ()),
    "slider_crank_regular": (2, 1, ()),
    "slider_crank_slider": (3, 2, ("pin.y",)),
    "slider_crank_whirl": (2, 1, ()),
    "spatial_four_bar": (5, 3, ()),
    "spatial_dead_point": (4, 2, ()),
    "spatial_slider_crank": (4, 3, ()),
    "squeezing_mechanism": (7, 6, ("pin_k3.y", "pin_k4.y", "pin_k6.y")),
    "stephenson_six_bar": (5, 4, ("knee.y", "top.y")),
    "stewart_platform": (24, 18, ()),
    "toggle_press": (5, 4, ("D.y", "A.y")),
    "watt_six_bar": (5, 4, ("knee.y", "top.y")),
    "wiper": (5, 5, ("P:rod.y", "Q.y")),
}
CLOSED_MODELS = tuple(name for name in KNOWN if KNOWN[name][1] and name != "wiper")
"""Those with closures alone: a drive of the wiper has a row, too."""


def started(name: str, q: list[float], v: list[float] | None = None) -> srm.Mechanism:
    """A bundled mechanism analysed from another start."""
    mechanism = load(name)
    return srm.Mechanism(mechanism.model, mechanism.loops, np.array(q), v)


def same(a: Structure, b: Structure) -> bool:
    return (
        (a.rank, a.sigma_ref, a.samples, a.notes) == (b.rank, b.sigma_ref, b.samples, b.notes)
        and np.array_equal(a.row_scale, b.row_scale)
        and np.array_equal(a.kept, b.kept)
    )


# --- bundled mechanisms -------------------------------------------------------------------------


@pytest.mark.parametrize("name", DISTINCT_MODELS)
def test_rank_degrees_of_freedom_and_redundant_rows_are_known(name: str) -> None:
    mechanism = load(name)
    nv, rank, redundant = KNOWN[name]
    assert mechanism.structure.rank == rank
    assert mechanism.degrees_of_freedom == nv - rank
    assert mechanism.redundant_rows == redundant
    assert mechanism.structure.pivoted_redundancy == (name == "bricard")
    assert mechanism.structure.notes == ()


@pytest.mark.parametrize("n", [1, 3, 10, 20])
def test_the_n_four_bar_has_one_degree_of_freedom_for_every_n(n: int) -> None:
    mechanism = srm.n_four_bar(n)
    assert mechanism.structure.rank == 2 * n
    assert mechanism.degrees_of_freedom == 1
    assert mechanism.redundant_rows == tuple(f"pin_{i}.y" for i in range(n))


def test_a_floating_ring_of_ball_joints_loses_three_of_its_fifteen() -> None:
    ring = floating_ring()
    assert (ring.model.nv, ring.structure.rank, ring.degrees_of_freedom) == (15, 3, 12)


@pytest.mark.parametrize("name", CLOSED_MODELS)
def test_the_analysis_is_deterministic(name: str) -> None:
    mechanism = load(name)
    np.random.seed(1)  # noqa: NPY002 - the global generator must not matter
    first = analyse(mechanism)
    np.random.seed(2)  # noqa: NPY002
    assert same(first, analyse(mechanism))
    assert same(first, mechanism.structure)


def test_the_structure_is_found_once_and_kept_with_another_state() -> None:
    mechanism = srm.load("four_bar", gravity=(0.0, 0.0, 0.0))
    assert mechanism.structure is mechanism.structure
    moved = mechanism.with_state(mechanism.q0, 2.0 * mechanism.v0)
    assert moved.structure.row_scale is mechanism.structure.row_scale, "not analysed again"
    assert moved.structure.units.rate != mechanism.structure.units.rate


@pytest.mark.parametrize("name", CLOSED_MODELS)
def test_sigma_of_the_start_is_about_one_and_its_rank_is_the_structural_one(name: str) -> None:
    mechanism = load(name)
    terms = start_terms(mechanism)
    assert 0.1 < terms.sigma < 10.0
    assert terms.rank == mechanism.structure.rank


# --- singular and open starts -------------------------------------------------------------------

SINGULAR = {
    "slider-crank, folded down": ("slider_crank", [1.5 * np.pi, -3.0 * np.pi], [1.0, -2.0]),
    "slider-crank, other branch": ("slider_crank", [1.5 * np.pi, np.pi], [1.0, 0.0]),
    "slider-crank, folded up": ("slider_crank", [0.5 * np.pi, -np.pi], [1.0, -2.0]),
    "with slider": ("slider_crank_slider", [1.5 * np.pi, -3.0 * np.pi, 0.0], [1.0, -2.0, 4.0]),
    "parallelogram, right": ("parallelogram", [0.0, 0.0, 0.0], [1.0, -1.0, 1.0]),
    "parallelogram, left": ("parallelogram", [np.pi, -np.pi, np.pi], [1.0, -1.0, 1.0]),
    "four-bar N = 1": ("n_four_bar_1", [0.0, 0.0, 0.0], [1.0, -1.0, 1.0]),
    "four-bars N = 2": ("n_four_bar_2", [0.0] * 5, [1.0, -1.0, 1.0, -1.0, 1.0]),
}


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
@pytest.mark.parametrize("case", SINGULAR)
def test_a_singular_start_gives_the_rank_of_a_regular_one(case: str, moving: bool) -> None:
    name, q, v = SINGULAR[case]
    mechanism = started(name, q, v if moving else None)
    found, regular = mechanism.structure, load(name).structure
    assert found.rank == regular.rank
    assert found.redundant_rows == regular.redundant_rows
    assert found.notes == ()
    assert 0.25 < found.sigma_ref / regular.sigma_ref < 4.0
    assert start_terms(mechanism).sigma < 1e-14


@pytest.mark.parametrize("name", CLOSED_MODELS)
def test_an_open_start_gives_the_rank_of_a_closed_one(name: str) -> None:
    mechanism = load(name)
    unassembled = srm.Mechanism(mechanism.model, mechanism.loops).structure
    assert unassembled.rank == mechanism.structure.rank
    assert unassembled.redundant_rows == mechanism.redundant_rows


# --- redundancy ---------------------------------------------------------------------------------


def test_open_configurations_would_give_bricards_linkage_a_wrong_rank() -> None:
    """Why the rank is measured on closed configurations only."""
    system = ClosedSystem(load("bricard"))
    rng = np.random.default_rng(0)
    for _ in range(5):
        state = np.concatenate([rng.uniform(-1, 1, 5), np.zeros(5)])
        system.evaluate(0.0, state)
        assert np.linalg.matrix_rank(system.loops.G, tol=1e-3) == 5


def test_bricards_linkage_keeps_its_rank_along_its_motion() -> None:
    mechanism = load("bricard")
    run = srm.simulate(mechanism, 2.0, rtol=1e-8)
    assert run.success
    assert run.drift[:, 0].max() < 1e-9
    assert np.ptp(run.energy) < 1e-5
    moved = srm.Mechanism(mechanism.model, mechanism.loops, run.q[-1])
    assert (moved.structure.rank, moved.redundant_rows) == (4, ())


@pytest.mark.parametrize("name", ["four_bar", "spatial_four_bar", "slider_crank", "n_four_bar_2"])
def test_duplicated_loops_change_neither_rank_nor_motion(name: str) -> None:
    mechanism = load(name)
    copies = tuple(replace(loop, name=f"{loop.name}_again") for loop in mechanism.loops)
    doubled = srm.Mechanism(mechanism.model, mechanism.loops + copies, mechanism.q0, mechanism.v0)
    rank = mechanism.structure.rank
    assert doubled.structure.rank == rank
    assert doubled.structure.pivoted_redundancy == rank
    assert_close(start_terms(doubled).rate(), start_terms(mechanism).rate(), atol=1e-11)


def four_bar(loop: srm.LoopClosure, pose: pin.SE3) -> srm.Mechanism:
    """The bundled four_bar's bars in any pose, closed by ``loop`` between coupler and rocker."""
    model = pin.Model()
    hinge = pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))
    crank = add_link(model, 0, hinge, "crank", at=pose)
    add_link(model, crank, hinge, "coupler", rod(2.0, 2.0), along_x(1.0))
    add_link(model, 0, hinge, "rocker", rod(1.5, 1.5), pose * along_x(2.2))
    return srm.Mechanism(model, (loop,), q0=np.array([1.0, -0.674, 1.413]))


def tip_loop(kind: str, turn: np.ndarray, axis: np.ndarray | None = None) -> srm.LoopClosure:
    """Loop between the tips of coupler and rocker with anchors turned by ``turn`` (3, 3)."""
    rpy = tuple(pin.rpy.matrixToRpy(turn))
    return srm.LoopClosure(
        kind,
        srm.Anchor("coupler", xyz=(2.0, 0.0, 0.0), rpy=rpy),
        srm.Anchor("rocker", xyz=(1.5, 0.0, 0.0), rpy=rpy),
        None if axis is None else tuple(turn.T @ axis),
        name="pin",
    )


POSES = {
    "upright": pin.SE3.Identity(),
    "tilted": pin.SE3(pin.exp3(np.array([0.4, -0.9, 0.3])), np.array([0.3, 5.0, -2.0])),
    "far away": pin.SE3(pin.exp3(np.array([2.0, 0.1, -0.7])), np.array([-700.0, 300.0, 900.0])),
}
TURNS = {"straight anchors": np.eye(3), "turned anchors": pin.exp3(np.array([0.5, 0.2, -1.1]))}
NORMAL = np.array([0.0, 1.0, 0.0])

every_pose = pytest.mark.parametrize("pose", POSES)
every_turn = pytest.mark.parametrize("turn", TURNS)


@every_pose
@every_turn
def test_a_planar_loop_closed_by_a_hinge_has_rank_two_in_every_pose(pose: str, turn: str) -> None:
    """Its alignment rows are rounding, which must not be scaled up to rows."""
    mechanism = four_bar(tip_loop("revolute", TURNS[turn], NORMAL), POSES[pose])
    assert mechanism.structure.rank == 2
    assert mechanism.degrees_of_freedom == 1
    assert {"pin.axis_1", "pin.axis_2"} <= set(mechanism.redundant_rows)
    assert mechanism.structure.notes == ()


@every_pose
@every_turn
def test_a_planar_loop_closed_by_a_ball_has_rank_two_in_every_pose(pose: str, turn: str) -> None:
    mechanism = four_bar(tip_loop("point", TURNS[turn]), POSES[pose])
    assert (mechanism.structure.rank, mechanism.degrees_of_freedom) == (2, 1)
    # With straight anchors one row is normal to the plane; otherwise pivoting decides.
    dropped = ("pin.y",) if turn == "straight anchors" else ()
    assert mechanism.redundant_rows == dropped
    assert mechanism.structure.pivoted_redundancy == 1 - len(dropped)


@every_pose
@every_turn
def test_a_loop_that_is_always_satisfied_has_rank_zero_and_no_algebra(pose: str, turn: str) -> None:
    """A tip that stays in the plane of motion anyway."""
    mechanism = four_bar(tip_loop("point_on_plane", TURNS[turn], NORMAL), POSES[pose])
    assert (mechanism.structure.rank, mechanism.degrees_of_freedom) == (0, 3)
    assert mechanism.redundant_rows == ("pin.normal",)
    system = make_system(mechanism)
    assert isinstance(system, OpenSystem)
    assert system.factorisations == 0


@every_pose
@every_turn
@pytest.mark.parametrize("kind", ["point", "revolute"])
def test_a_four_bar_moves_alike_in_every_pose_and_with_every_closure(
    kind: str, pose: str, turn: str
) -> None:
    flat = load("four_bar")
    axis = None if kind == "point" else NORMAL
    mechanism = four_bar(tip_loop(kind, TURNS[turn], axis), POSES[pose])
    model = mechanism.model.copy()
    model.gravity.linear = POSES[pose].rotation @ np.array([0.0, 0.0, -9.81])
    posed = srm.Mechanism(model, mechanism.loops, flat.q0, flat.v0)
    assert_close(start_terms(posed).rate()[3:], start_terms(flat).rate()[3:], atol=1e-9)


@every_pose
@every_turn
def test_a_coupler_cut_in_two_and_welded_moves_like_the_whole_one(pose: str, turn: str) -> None:
    """Three of the six rows of the weld are redundant, in directions that no single row has."""
    flat = load("four_bar")
    crank, coupler, rocker = flat.q0
    rates = flat.v0
    half = pin.exp3(np.array([0.0, -np.pi, 0.0]))  # the second half points back
    model = pin.Model()
    model.gravity.linear = POSES[pose].rotation @ np.array([0.0, 0.0, -9.81])
    hinge = pin.JointModelRevoluteUnaligned(np.array([0.0, -1.0, 0.0]))
    first = add_link(model, 0, hinge, "crank", at=POSES[pose])
    add_link(model, first, hinge, "first_half", at=along_x(1.0))
    second = add_link(model, 0, hinge, "rocker", rod(1.5, 1.5), POSES[pose] * along_x(2.2))
    add_link(model, second, hinge, "second_half", at=along_x(1.5))
    tip = (1.0, 0.0, 0.0)
    a = srm.Anchor("first_half", xyz=tip, rpy=tuple(pin.rpy.matrixToRpy(TURNS[turn])))
    b = srm.Anchor("second_half", xyz=tip, rpy=tuple(pin.rpy.matrixToRpy(half @ TURNS[turn])))
    back = crank + coupler + np.pi - rocker
    v = np.array([rates[0], rates[1], rates[2], rates[0] + rates[1] - rates[2]])
    mechanism = srm.Mechanism(
        model,
        (srm.LoopClosure("frame", a, b, name="weld"),),
        np.array([crank, coupler, rocker, back]),
        v,
    )
    assert (mechanism.structure.rank, mechanism.degrees_of_freedom) == (3, 1)
    assert mechanism.structure.notes == ()
    found, whole = start_terms(mechanism).rate(), start_terms(flat).rate()
    assert_close(found[4:7], whole[3:], atol=1e-9)


@every_pose
def test_a_point_on_a_hinges_own_axis_is_no_constraint(pose: str) -> None:
    model = pin.Model()
    axis = np.array([0.6, 0.0, 0.8])
    add_link(model, 0, pin.JointModelRevoluteUnaligned(axis), "hinge", at=POSES[pose])
    point = 1.7 * axis
    loop = srm.LoopClosure(
        "point",
        srm.Anchor("hinge", xyz=tuple(point)),
        srm.Anchor("world", xyz=tuple(POSES[pose].act(point))),
        name="bearing",
    )
    mechanism = srm.Mechanism(model, (loop,), q0=np.array([0.3]))
    assert (mechanism.structure.rank, mechanism.degrees_of_freedom) == (0, 1)
    assert len(mechanism.redundant_rows) == 3


def test_a_truss_has_no_degree_of_freedom() -> None:
    """Two bars from the ground that meet at their tips."""
    model = pin.Model()
    for name, at in (("left", 0.0), ("right", 1.0)):
        add_link(model, 0, pin.JointModelRY(), name, at=along_x(at))
    tip = (1.0, 0.0, 0.0)
    loop = srm.LoopClosure("point", srm.Anchor("left", xyz=tip), srm.Anchor("right", xyz=tip))
    mechanism = srm.Mechanism(model, (loop,), q0=np.array([-np.pi / 3, -2 * np.pi / 3]))
    assert (mechanism.structure.rank, mechanism.degrees_of_freedom) == (2, 0)
    assert_close(start_terms(mechanism).rate(), 0.0, atol=1e-13)


def test_loops_that_cannot_close_give_a_note_and_no_exception() -> None:
    mechanism = load("four_bar")
    loop = mechanism.loops[0]
    far = replace(loop, a=replace(loop.a, xyz=(20.0, 0.0, 0.0)))
    found = srm.Mechanism(mechanism.model, (far,), mechanism.q0).structure
    assert found.samples == 0
    assert len(found.notes) == 1
    assert "no closed configuration was found" in found.notes[0]


def test_a_narrow_gap_between_independent_and_redundant_pivots_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(structure, "RANK_GAP", 1e15)
    with caplog.at_level(logging.WARNING, logger="srm_mbs"):
        found = analyse(load("four_bar"))
    assert found.rank == 2
    assert "the rank 2 of the closures is uncertain" in found.notes[0]
    assert "uncertain" in caplog.text


@pytest.mark.parametrize("mass", [1e-6, 1e-3, 1e3, 1e6])
def test_a_very_light_or_heavy_body_does_not_change_the_rank(mass: float) -> None:
    found = with_slider_mass(mass).structure
    assert (found.rank, found.redundant_rows, found.notes) == (2, ("pin.y",), ())


# --- units --------------------------------------------------------------------------------------

EXACT = [{"length": 4.0**5}, {"mass": 4.0**-6}, {"time": 4.0}, {"length": 4.0**-4, "mass": 16.0}]
ROUNDED = [{"length": 1e3}, {"length": 1e-3}, {"mass": 1e3}, {"length": 1e6, "mass": 1e9}]


@pytest.mark.parametrize("scale", EXACT, ids=str)
@pytest.mark.parametrize("name", CLOSED_MODELS)
def test_units_that_are_powers_of_four_change_no_bit_of_sigma(
    name: str, scale: dict[str, float]
) -> None:
    plain = load(name)
    scaled = rescaled(plain, **scale)
    assert scaled.structure.rank == plain.structure.rank
    assert scaled.redundant_rows == plain.redundant_rows
    assert scaled.structure.sigma_ref == plain.structure.sigma_ref
    assert start_terms(scaled).sigma == start_terms(plain).sigma


@pytest.mark.parametrize("scale", ROUNDED, ids=str)
@pytest.mark.parametrize("name", CLOSED_MODELS)
def test_other_units_change_sigma_by_rounding_only(name: str, scale: dict[str, float]) -> None:
    """The walk must not depend on choices that rounding makes, such as signs of null vectors."""
    plain = load(name)
    scaled = rescaled(plain, **scale)
    assert scaled.structure.rank == plain.structure.rank
    assert scaled.redundant_rows == plain.redundant_rows
    # Bricard's five rows are symmetric: rounding decides which of them the pivots leave out.
    rel = 1e-2 if name == "bricard" else 1e-6
    assert scaled.structure.sigma_ref == pytest.approx(plain.structure.sigma_ref, rel=rel)
    assert start_terms(scaled).sigma == pytest.approx(start_terms(plain).sigma, rel=rel)


@every_pose
def test_the_pose_of_the_mechanism_changes_sigma_little(pose: str) -> None:
    upright, posed = (four_bar(tip_loop("point", np.eye(3)), POSES[at]) for at in ("upright", pose))
    assert posed.structure.sigma_ref == pytest.approx(upright.structure.sigma_ref, rel=1e-6)


def test_row_scales_are_the_same_for_all_rows_of_one_kind_in_a_closure() -> None:
    scale = load("bricard").structure.row_scale
    assert len(set(scale[:3])) == 1
    assert len(set(scale[3:])) == 1
    assert (scale > 0.0).all()


@pytest.mark.parametrize("name", CLOSED_MODELS)
def test_row_scales_are_the_size_of_the_whitened_rows_over_open_configurations(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(structure, "SMALL_REFERENCE_PIVOT", 0.0)
    mechanism = srm.load(name)
    model, units = mechanism.model, mechanism.structure.units
    rows = LoopKinematics(model, mechanism.loops)
    data = model.createData()
    rng = np.random.default_rng(1)
    squares = np.zeros(len(rows.g))
    count = 400
    for _ in range(count):
        spread = rng.uniform(-np.pi, np.pi, model.nv) * units.coordinate
        q = pin.integrate(model, mechanism.q0, spread)
        rows.evaluate(model, data, q)
        inverse = np.linalg.solve(symmetric(data.M), rows.G.T)
        squares += np.einsum("ij,ji->i", rows.G, inverse) / count
    # All bundled closures have position rows only: one kind in each.
    start = 0
    for loop in mechanism.loops:
        own = slice(start, start + loop.rows.count)
        start = own.stop
        size = np.sqrt(squares[own].mean())
        assert_close(mechanism.structure.row_scale[own], size, rtol=0.25)  # 24 samples


BALANCED = (
    *("delta_robot", "klann_walker", "spatial_slider_crank", "squeezing_mechanism"),
    "toggle_press",
)


@pytest.mark.parametrize("name", CLOSED_MODELS)
def test_rows_are_balanced_where_the_last_pivot_would_be_small_everywhere(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = load(name).structure
    monkeypatch.setattr(structure, "SMALL_REFERENCE_PIVOT", 0.0)
    before = analyse(load(name))
    assert found.sigma_ref >= 0.1
    assert (before.sigma_ref < 0.1) == (name in BALANCED)
    if name in BALANCED:
        assert found.sigma_ref > 0.5
        assert same(replace(found, row_scale=before.row_scale, sigma_ref=before.sigma_ref), before)
    else:
        assert same(found, before)


@pytest.mark.parametrize("name", ["bricard", "delta_robot", "squeezing_mechanism", "n_four_bar_40"])
def test_rows_are_measured_by_their_distance_from_the_span_of_the_others(name: str) -> None:
    mechanism = load(name)
    sampler = ManifoldSampler(mechanism, mechanism.structure.units)
    sampler.set_scale(np.random.default_rng(0))
    (q,) = sampler.walk(mechanism.q0, np.random.default_rng(3), 1, 1)
    found = sampler.distances(q)
    used = np.flatnonzero(np.isfinite(found))
    assert len(used) == mechanism.structure.rank
    model, data = mechanism.model, mechanism.model.createData()
    rows = LoopKinematics(model, mechanism.loops)
    rows.evaluate(model, data, q)
    L = np.linalg.cholesky(symmetric(data.M))
    W = np.linalg.solve(L, (rows.G / sampler.scale[:, None]).T)[:, used]
    for k, distance in enumerate(found[used]):
        others = np.delete(W, k, axis=1)
        nearest = others @ np.linalg.lstsq(others, W[:, k], rcond=None)[0]
        assert np.linalg.norm(W[:, k] - nearest) == pytest.approx(distance, rel=1e-9)


@pytest.mark.parametrize(
    "name", ["slider_crank", "wiper", "delta_robot", "squeezing_mechanism", "n_four_bar_40"]
)
def test_the_kernel_walks_as_the_reference_does(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Closures and drives, turns and balls, rows that leave shares of others, sparse algebra."""
    mechanism = load(name)
    found = {}
    for by in ("kernel", "reference"):
        if by == "reference":
            monkeypatch.setattr(ManifoldSampler, "_compiled", lambda self: None)
        sampler = ManifoldSampler(mechanism, mechanism.structure.units)
        sampler.set_scale(np.random.default_rng(0))
        sampler.eliminations = (Elimination(0, 2, 0.3),) if len(sampler.scale) > 1 else ()
        rng = np.random.default_rng(1)
        rates = np.ones(mechanism.model.nv)
        samples = sampler.explore(mechanism.q0, rng, 3, 2, rates, sample_start=True)
        assert len(samples.configurations) > 4
        found[by] = (sampler.scale, *vars(samples).values())
    for own, expected in zip(found["kernel"], found["reference"]):
        assert_close(own, np.array(expected), atol=1e-8)


MOTIONS = {"slider_crank": [1, -2], "parallelogram": [1, -1, 1], "n_four_bar_2": [1, -1, 1, -1, 1]}


@pytest.mark.parametrize("name", MOTIONS)
def test_sigma_is_about_one_in_the_middle_of_the_motion(name: str) -> None:
    system = make_system(load(name))
    sigmas = []
    for angle in np.linspace(0.0, 2.0 * np.pi, 101):
        q = angle * np.array(MOTIONS[name])
        sigmas.append(system.evaluate(0.0, np.concatenate([q, 0.0 * q])).sigma)
    assert 0.75 < np.median(sigmas) < 1.33
    assert min(sigmas) < 0.05


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("bodies", ["named", "not named"])
def test_a_point_mass_on_a_ball_joint_is_refused_by_the_name_of_the_joint(
    closed: bool, bodies: str
) -> None:
    """It has no inertia about its rod: its spin is not determined, closures or not."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), "swivel")
    bob = pin.Inertia(1.0, np.array([1.0, 0.0, 0.0]), np.zeros((3, 3)))
    model.appendBodyToJoint(joint, bob, pin.SE3.Identity())
    model.addFrame(pin.Frame("tip", joint, along_x(1.0), pin.FrameType.OP_FRAME))
    if bodies == "named":
        model.addBodyFrame("bob", joint, pin.SE3.Identity(), 0)
    floor = srm.LoopClosure("point_on_plane", srm.Anchor(frame="tip"), srm.Anchor("world"), Z_AXIS)
    mechanism = srm.Mechanism(model, (floor,) if closed else ())
    carried = "bob" if bodies == "named" else "its body"
    for use in (lambda: srm.simulate(mechanism, 1.0), lambda: mechanism.degrees_of_freedom):
        with pytest.raises(srm.InputError, match=f"joint 'swivel'.*{carried}.*moment of inertia"):
            use()
