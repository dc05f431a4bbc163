"""The kernel's sparse algebra for many loops is the dense one: terms, pivots and decisions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints import row_algebra
from srm_mbs.dynamics.constraints.row_algebra import GRAPH_ORDER_ABOVE
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.dynamics.system import Zone
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.kernel.marshalling import system_struct
from srm_mbs.integration.kernel.system import make_kernel_system
from tests.integration.kernel.test_kernel import agree
from tests.support import reduced
from tests.support.lockstep import compare
from tests.support.mechanisms import (
    along_x,
    floating_ring,
    floating_slider_crank,
    rod,
    slider_crank_of_points,
)

pytestmark = pytest.mark.skipif(kernel.core is None, reason=f"no kernel: {kernel.missing}")

MECHANISMS: dict[str, Callable[[], srm.Mechanism]] = {
    "n_four_bar_3": lambda: srm.n_four_bar(3),
    "n_four_bar_10": lambda: srm.n_four_bar(10),
    "parallelogram": lambda: srm.load("parallelogram"),
    "spatial_four_bar": lambda: srm.load("spatial_four_bar"),
    "spatial_dead_point": lambda: srm.load("spatial_dead_point"),
    "squeezing_mechanism": lambda: srm.load("squeezing_mechanism"),
    "free and ball joints": floating_ring,
    "hinges of two points": lambda: slider_crank_of_points(0.01),
    "islands": lambda: islands((1.0, 1.3)),
    "many islands": lambda: islands(tuple(np.linspace(1.0, 1.3, 40))),
}


def add_bar(model: pin.Model, parent: int, at: float, length: float, name: str) -> int:
    """A hinged bar of 1 kg/m, ``at`` (m) along the x axis of its parent; its joint."""
    joint: int = model.addJoint(parent, pin.JointModelRY(), along_x(at), name)
    model.appendBodyToJoint(joint, rod(length, length, 1.0), pin.SE3.Identity())
    model.addBodyFrame(name, joint, pin.SE3.Identity(), 0)
    return joint


def between(kind: str, name: str, a: tuple[str, float], b: tuple[str, float]) -> srm.LoopClosure:
    """A closure between points of two bars: their names, and distances (m) along them."""
    anchors = (srm.Anchor(bar, xyz=(x, 0.0, 0.0)) for bar, x in (a, b))
    return srm.LoopClosure(kind, *anchors, name=name)


def assembled(model: pin.Model, loops: list[srm.LoopClosure], guess: Any) -> srm.Mechanism:
    mechanism = srm.Mechanism(model, loops, q0=np.array(guess), v0=np.zeros(model.nv))
    start = srm.assemble(mechanism)
    return mechanism.with_state(start.q, start.v)


def islands(lengths: tuple[float, ...], floating: bool = False) -> srm.Mechanism:
    """Four-bars side by side, on the ground or on a free body, with couplers of these lengths (m),
    from crooked positions."""
    model = pin.Model()
    model.name = "islands"
    base = 0
    if floating:
        base = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "base")
        model.appendBodyToJoint(base, rod(1.0, 50.0, 1.0), pin.SE3.Identity())
    loops = []
    for k, length in enumerate(lengths):
        crank = add_bar(model, base, 4.0 * k, 0.6, f"crank_{k}")
        add_bar(model, crank, 0.6, length, f"coupler_{k}")
        add_bar(model, base, 4.0 * k + 1.2, 0.8, f"rocker_{k}")
        ends = (f"coupler_{k}", length), (f"rocker_{k}", 0.8)
        loops.append(between("point", f"loop_{k}", *ends))
    guess = pin.neutral(model)
    guess[-3 * len(lengths) :] = np.tile([-1.2, 0.9, -1.9], len(lengths))
    return assembled(model, loops, guess)


def dense_and_sparse(mechanism: srm.Mechanism) -> tuple[ClosedSystem, Any, Any]:
    """The reference, and the kernel with the dense and with the sparse algebra."""
    system = ClosedSystem(mechanism)
    dense, sparse = (
        kernel.core.System(
            system.model, system_struct(system.constants() | {"algebra": choice}), None
        )
        for choice in ("dense", "sparse")
    )
    assert sparse.sparse
    assert not dense.sparse
    return system, dense, sparse


def states(mechanism: srm.Mechanism, count: int) -> list[np.ndarray]:
    """Random states from next to the start to anywhere."""
    rng = np.random.default_rng(7)
    model = mechanism.model
    out = []
    for spread in np.logspace(-8.0, 0.0, count):
        q = pin.integrate(model, mechanism.q0, spread * rng.uniform(-1.0, 1.0, model.nv))
        out.append(np.concatenate([q, mechanism.v0 + spread * rng.standard_normal(model.nv)]))
    return out


def places(mechanism: srm.Mechanism, name: str) -> list[int]:
    """Coordinates of the cranks or the couplers of an N-four-bar, along the chain."""
    count = sum(joint.startswith(name) for joint in mechanism.joint_names)
    return [mechanism.joint(f"{name}{k}").idx_v for k in range(count)]


def flat(mechanism: srm.Mechanism, angle: float, bent: int = 0) -> np.ndarray:
    """A state of an N-four-bar with its cranks ``angle`` (rad) off the N-fold singularity, and
    ``bent`` of them further off."""
    nv = mechanism.model.nv
    cranks, couplers = places(mechanism, "crank_"), places(mechanism, "coupler_")
    q = np.zeros(nv)
    q[cranks], q[couplers] = angle, -angle
    q[cranks[:bent]] += 0.3
    q[couplers[:bent]] -= 0.3
    return np.concatenate([q, np.random.default_rng(0).standard_normal(nv)])


def alike(
    found: dict[str, Any],
    expected: dict[str, Any],
    weakest: float | None = None,
    same_pivots: bool = True,
) -> None:
    """Ranks and sigma, and the rest to 1e-12 over the weakest pivot in use (sigma by default),
    which magnifies rounding.  Other pivots have another sigma, and that alone."""
    assert found["rank"] == expected["rank"]
    if same_pivots:
        assert abs(found["sigma"] - expected["sigma"]) < 1e-13
    else:
        assert 0.5 < found["sigma"] / expected["sigma"] < 2.0
    lowest = min(1.0, expected["sigma"] if weakest is None else weakest)
    for key in ("rate", "multiplier", "correction"):
        size = np.abs(expected[key]).max() + 1.0
        assert np.abs(found[key] - expected[key]).max() < 1e-12 * size / lowest, key


def reference_terms(system: ClosedSystem, x: np.ndarray) -> dict[str, Any]:
    terms = system.evaluate(0.0, x)
    return {
        "rank": terms.rank,
        "sigma": terms.sigma,
        "rate": terms.rate(),
        "multiplier": terms.multiplier(),
        "correction": terms.correction(),
    }


@pytest.mark.parametrize("name", MECHANISMS)
def test_its_terms_are_those_of_the_dense_algebra_and_of_the_reference(name: str) -> None:
    mechanism = MECHANISMS[name]()
    system, dense, sparse = dense_and_sparse(mechanism)
    for x in states(mechanism, 25):
        found = sparse.terms(0.0, x)
        alike(found, dense.terms(0.0, x))
        alike(found, reference_terms(system, x))


@pytest.mark.parametrize("n", [3, 10, 40, 100])
def test_its_terms_are_the_dense_ones_up_to_the_singularity_of_a_chain(n: int) -> None:
    mechanism = srm.n_four_bar(n)
    system, dense, sparse = dense_and_sparse(mechanism)
    for angle in (1.5, 0.8, 0.3, 1e-2, 1e-4, 1e-6):
        x = flat(mechanism, angle)
        found = sparse.terms(0.0, x)
        alike(found, dense.terms(0.0, x), same_pivots=system.nv <= GRAPH_ORDER_ABOVE)
        alike(found, reference_terms(system, x))


def test_its_terms_are_the_dense_ones_where_all_rows_share_the_coordinates_of_one_body() -> None:
    """All columns meet in its rows, more than 64 of them, which are reflected together."""
    mechanism = islands(tuple(np.linspace(1.0, 1.3, 40)), floating=True)
    system, dense, sparse = dense_and_sparse(mechanism)
    assert system.constants()["order"]
    for x in states(mechanism, 5):
        found = sparse.terms(0.0, x)
        alike(found, dense.terms(0.0, x), same_pivots=False)
        # Where the body is does not count; the reference has the rounding of its place.
        at_origin = np.concatenate([np.zeros(3), x[3:]])
        alike(found, reference_terms(system, at_origin))


@pytest.mark.parametrize("n", [3, 10, 40, 100])
def test_it_drops_the_pivots_that_the_dense_algebra_drops(n: int) -> None:
    """In the zone, on the singularity itself, and with some of the loops singular only."""
    mechanism = srm.n_four_bar(n)
    system, dense, sparse = dense_and_sparse(mechanism)
    ranks = set()
    zeros = np.zeros(system.nv)
    for angle in (1e-2, 1e-5, 0.0):
        for bent in (0, n // 2, n + 1):
            x = flat(mechanism, angle, bent)
            for threshold in (-1.0, 1e-3, 0.05):
                expected = dense.terms(0.0, x, threshold)
                ranks.add(expected["rank"])
                weakest = max(threshold, 1e-3) if expected["rank"] < 2 * n else None
                found = sparse.terms(0.0, x, threshold)
                if system.nv <= GRAPH_ORDER_ABOVE:
                    alike(found, expected, weakest)
                    continue
                # Pivots of 0.05 or so lie on either side of the threshold with another order.
                if (angle, threshold) != (1e-2, 0.05):
                    assert found["rank"] == expected["rank"]
                zone = None if threshold < 0.0 else Zone(threshold, lambda t: zeros)
                assert found["rank"] == system.evaluate(0.0, x, zone).rank
    assert {n, 2 * n} < ranks


@pytest.fixture
def forced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every kernel of a closed mechanism has the sparse algebra."""
    constants = ClosedSystem.constants
    monkeypatch.setattr(ClosedSystem, "constants", lambda s: constants(s) | {"algebra": "sparse"})


@pytest.mark.usefixtures("forced")
@pytest.mark.parametrize(
    ("name", "t_end"),
    [
        ("slider_crank", 4.0),
        ("parallelogram", 3.0),
        ("n_four_bar_2", 4.0),
        ("spatial_four_bar", 1.0),
        ("squeezing_mechanism", 0.01),
    ],
)
def test_every_attempt_of_the_reference_is_repeated_with_it(name: str, t_end: float) -> None:
    agree(compare(srm.load(name), t_end, rtol=1e-6))


@pytest.mark.usefixtures("forced")
@pytest.mark.parametrize(
    ("n", "t_end"), [(6, 2.0), pytest.param(40, 0.8, marks=pytest.mark.stress)]
)
def test_steps_through_the_zone_of_a_chain_are_repeated_with_it(n: int, t_end: float) -> None:
    """Fixed steps over singular configurations: normals, predictions and held normals."""
    mechanism = srm.n_four_bar(n)
    backend = "python" if n < 10 else "kernel"
    crossing = srm.simulate(mechanism, t_end, rtol=1e-10, backend=backend).crossings[0].time
    found = compare(mechanism, t_end, rtol=1e-6, step=crossing / 64.0, placement="off")
    assert found.zones > 0
    assert found.decisions == []
    assert found.near < 2e-12


@pytest.mark.usefixtures("forced")
def test_a_start_on_a_singular_configuration_is_repeated_with_it() -> None:
    found = compare(floating_slider_crank(), 0.5, rtol=1e-7)
    assert found.decisions == []
    assert found.near < 2e-12


def test_islands_do_not_change_each_other_by_a_bit() -> None:
    mechanism = islands((1.0, 1.3, 1.1))
    _, _, sparse = dense_and_sparse(mechanism)
    rng = np.random.default_rng(3)
    x = states(mechanism, 3)[2]
    alone = sparse.terms(0.0, x)
    others = np.r_[3:9, 12:18]
    x[others] += 0.1 * rng.standard_normal(12)
    moved = sparse.terms(0.0, x)
    for key in ("rate", "correction"):
        assert np.array_equal(moved[key][[0, 1, 2, 9, 10, 11]], alone[key][[0, 1, 2, 9, 10, 11]])
        assert not np.array_equal(moved[key], alone[key])


def test_each_island_moves_as_it_does_alone() -> None:
    lengths = (1.0, 1.3)
    mechanism = islands(lengths)
    _, _, sparse = dense_and_sparse(mechanism)
    together = sparse.terms(0.0, np.r_[mechanism.q0, np.ones(6)])
    for k, length in enumerate(lengths):
        _, dense, _ = dense_and_sparse(islands((length,)))
        rate = dense.terms(0.0, np.r_[mechanism.q0[3 * k : 3 * k + 3], np.ones(3)])["rate"][3:]
        assert np.abs(together["rate"][6 + 3 * k : 9 + 3 * k] - rate).max() < 1e-11


@pytest.mark.parametrize("n", [10, 40, 100])
def test_an_evaluation_leaves_nothing_behind_for_the_next(n: int) -> None:
    mechanism = srm.n_four_bar(n)
    _, _, sparse = dense_and_sparse(mechanism)
    x = flat(mechanism, 0.7)
    first = sparse.terms(0.0, x)
    for other in (*states(mechanism, 5), flat(mechanism, 0.0), np.full(x.size, np.nan)):
        with nullcontext() if np.isfinite(other).all() else pytest.raises(ArithmeticError):
            sparse.terms(0.0, other)
        again = sparse.terms(0.0, x)
        assert all(np.array_equal(again[key], first[key]) for key in first)


def test_it_is_chosen_for_chains_of_loops_and_not_for_single_loops() -> None:
    for name, sparse in (("four_bar", False), ("spatial_four_bar", False), ("n_four_bar_2", False)):
        assert make_kernel_system(ClosedSystem(srm.load(name))).sparse is sparse
    assert make_kernel_system(ClosedSystem(srm.n_four_bar(20))).sparse
    system = ClosedSystem(srm.load("four_bar"))
    unknown = system.constants() | {"algebra": "banded"}
    with pytest.raises(ValueError, match="auto, dense or sparse"):
        kernel.core.System(system.model, system_struct(unknown), None)


@pytest.mark.usefixtures("forced")
def test_twenty_loops_pass_their_singularity_of_nullity_twenty() -> None:
    t = np.linspace(0.0, 3.0, 31)
    expected = reduced.trajectory(reduced.n_four_bar(20), [np.pi / 2.0, -1.0], t)
    mechanism = srm.n_four_bar(20)
    solution = srm.simulate(mechanism, 3.0, rtol=1e-8, t_eval=t, backend="kernel")
    assert solution.success
    assert len(solution.crossings) >= 2
    cranks = places(mechanism, "crank_")
    assert np.abs(solution.q[:, cranks] - expected[:, :1]).max() < 1e-6
    assert np.abs(solution.v[:, cranks] - expected[:, 1:]).max() < 1e-6


@pytest.mark.parametrize("n", [40, 100])
def test_sigma_falls_with_the_distance_to_the_singularity_of_a_long_chain(n: int) -> None:
    """Which columns are pivots first changes on the way there; sigma must not jump with them."""
    sparse = kernel.core.System(
        (mechanism := srm.n_four_bar(n)).model,
        system_struct(ClosedSystem(mechanism).constants()),
        None,
    )
    angles = np.logspace(-0.5, -6.0, 60)
    slopes = [sparse.terms(0.0, flat(mechanism, angle))["sigma"] / angle for angle in angles]
    assert max(slopes) < 1.2 * min(slopes)


def test_forty_loops_take_the_steps_of_the_reference() -> None:
    found = compare(srm.n_four_bar(40), 0.8, rtol=1e-6)
    assert found.decisions == []
    assert found.near < 2e-12


def hung(seed: int, count: int) -> srm.Mechanism:
    """Four-bars on the ground and on bars of each other, some of them parallelograms (whose two
    ways on meet where they are flat) with a third bar that adds a redundant row."""
    rng = np.random.default_rng(seed)
    on = [int(rng.integers(0, i)) if i and rng.random() < 0.6 else -1 for i in range(count)]
    bars = [str(rng.choice(["crank", "coupler", "rocker"])) for _ in range(count)]
    model = pin.Model()
    model.name = "hung"
    loops: list[srm.LoopClosure] = []
    guess: list[float] = []

    def add(parent: int, at: float, length: float, name: str, angle: float) -> int:
        guess.append(angle)
        return add_bar(model, parent, at, length, name)

    def build(i: int, parent: int, at: float, size: float) -> None:
        flat_way = rng.random() < 0.6
        lengths = np.array([0.5, 1.0, 0.5, 1.0] if flat_way else [0.6, 1.0, 0.8, 1.2]) * size
        angles = (-1.0, 1.0, -1.0) if flat_way else (-1.2, 0.9, -1.9)
        crank = add(parent, at, lengths[0], f"crank_{i}", angles[0])
        carry(i, "crank", crank, lengths[0], size)
        coupler = add(crank, lengths[0], lengths[1], f"coupler_{i}", angles[1])
        carry(i, "coupler", coupler, lengths[1], size)
        rocker = add(parent, at + lengths[3], lengths[2], f"rocker_{i}", angles[2])
        carry(i, "rocker", rocker, lengths[2], size)
        ends = (f"coupler_{i}", lengths[1]), (f"rocker_{i}", lengths[2])
        loops.append(between("point", f"loop_{i}", *ends))
        if flat_way and i % 2:
            ends = (f"crank_{i}", lengths[0] / 2.0), (f"rocker_{i}", lengths[2] / 2.0)
            loops.append(replace(between("distance", f"bar_{i}", *ends), length=lengths[3]))

    def carry(i: int, bar: str, joint: int, length: float, size: float) -> None:
        for k in range(count):
            if on[k] == i and bars[k] == bar:
                build(k, joint, 0.2 * length, 0.6 * size)

    for i in range(count):
        if on[i] < 0:
            build(i, 0, 4.0 * i, 1.0)
    return assembled(model, loops, guess)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.stress)])
def test_loops_hung_on_each_other_run_as_with_the_largest_pivots(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With redundant rows, and through singular configurations of some of them."""

    def run() -> tuple[srm.Mechanism, srm.Solution]:
        mechanism = hung(seed, 24)
        # Two passages are 2e-4 s apart: between the stages of a longer step they are listed as one.
        run = srm.simulate(mechanism, 0.4, rtol=1e-8, max_step=2e-4, backend="kernel")
        return mechanism, run

    mechanism, found = run()
    system = ClosedSystem(mechanism)
    assert system.constants()["order"]
    assert int(mechanism.structure.kept.sum()) > mechanism.structure.rank
    monkeypatch.setattr(row_algebra, "GRAPH_ORDER_ABOVE", 10**6)
    other, expected = run()
    assert not ClosedSystem(other).constants()["order"]
    assert other.structure.rank == mechanism.structure.rank
    assert found.success
    assert expected.success
    assert len(found.crossings) == len(expected.crossings) > 0
    for one, two in zip(found.crossings, expected.crossings):
        assert one.loops == two.loops
        assert abs(one.time - two.time) < 1e-6
    assert np.abs(found.q[-1] - expected.q[-1]).max() < 1e-4
    assert found.stats.evaluations < 1.3 * expected.stats.evaluations
