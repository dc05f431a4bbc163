"""Quantities at many states by the kernel agree with the Python reference."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints import row_algebra
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry, geometry_of, separated_pattern
from srm_mbs.dynamics.constraints.reactions import Reactions
from srm_mbs.dynamics.constraints.row_algebra import SingularValues
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.observables import Observables
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.kernel.observables import CompiledObservables
from tests.support.bundled import load
from tests.support.mechanisms import DISTINCT_MODELS, floating_ring, random_state

pytestmark = pytest.mark.skipif(kernel.core is None, reason=f"no kernel: {kernel.missing}")

COUNT = 7
GROUND = srm.Anchor("world", xyz=(0.1, -0.2, 0.3))
LINK = srm.Anchor("coupler", xyz=(0.05, 0.02, -0.03), rpy=(0.3, -0.2, 0.5))
ELEMENTS: dict[str, tuple[srm.ForceElement, ...]] = {
    "springs with damping": (
        srm.SpringDamper(LINK, GROUND, 30.0, 2.0, 0.2, "strut"),
        srm.SpringDamper(LINK, GROUND, 30.0, 0.0, 0.2, "without damping"),
        srm.SpringDamper(LINK, GROUND, 0.0, 3.0, 0.0, "damper"),
        srm.SpringDamper(LINK, GROUND, 30.0, 1.0, 0.0, "rope", slack=0.3),
    ),
    "a bushing": (
        srm.Bushing(LINK, GROUND, (5.0, 6.0, 7.0, 1.0, 2.0, 3.0), (0.5,) * 6, "bushing"),
    ),
    "springs on joints": (
        srm.TorsionSpring("crank", 4.0, 0.7, 0.3, name="torsion"),
        srm.LimitSpring("crank", 100.0, 3.0, lower=-0.4, upper=0.5, depth=0.3, name="limit"),
        srm.CouplingSpring(("crank", "coupler"), (1.0, -2.0), 6.0, 0.4, 0.1, name="coupling"),
        srm.CouplingSpring(
            ("crank", "coupler"), (0.5, 1.0), 6.0, 0.0, 0.1, "belt", slack=0.3, friction=0.2
        ),
    ),
    "loads": (
        srm.JointTorque("crank", 2.0, name="torque"),
        srm.Wrench(LINK, (1.0, 2.0, 3.0), (0.3, 0.2, 0.1), "link", name="wrench"),
        srm.UserForce(lambda t, q, v: -0.3 * v * (1.0 + t), name="function"),
    ),
}


def states(mechanism: srm.Mechanism) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times and states of any kind, which need not be closed."""
    rng = np.random.default_rng(5)
    found = [random_state(mechanism.model, rng) for _ in range(COUNT)]
    q, v = (np.array(numbers) for numbers in zip(*found))
    return rng.uniform(0.0, 1.0, COUNT), q, v


def both(mechanism: srm.Mechanism) -> tuple[Observables, Observables]:
    system = make_system(mechanism)
    return CompiledObservables(system), Observables(system)


def same(found: FloatArray, expected: FloatArray) -> None:
    """Equal to 1e-12 of the largest number."""
    assert found.shape == expected.shape
    np.testing.assert_allclose(
        found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max(initial=1.0)
    )


def same_invariants(
    compiled: Observables, reference: Observables, t: FloatArray, x: FloatArray
) -> None:
    """The largest norms of groups of closure rows, and the energies, as those of the reference."""
    nq = reference.mechanism.model.nq
    order = list(range(reference.closure_errors(t, x[:, :nq], x[:, nq:])[0].shape[1]))[::-1]
    for starts in ([0], [0, len(order) // 3]):
        numbers = t, x, [0, 2, COUNT - 1], COUNT - 1, order, starts
        for found, expected in zip(compiled.invariants(*numbers), reference.invariants(*numbers)):
            same(np.array(found), np.array(expected))


@pytest.mark.parametrize(
    "name", ["stewart_platform", "delta_robot", "bricard", "n_four_bar_2", "spatial_four_bar"]
)
def test_closures_and_energies_of_many_states_are_those_of_the_reference(name: str) -> None:
    mechanism = load(name)
    t, q, v = states(mechanism)
    compiled, reference = both(mechanism)
    for found, expected in zip(
        compiled.closure_errors(t, q, v), reference.closure_errors(t, q, v), strict=True
    ):
        same(found, expected)
    same(compiled.jacobians(t, q), reference.jacobians(t, q))
    same(compiled.energies(q, v), reference.energies(q, v))
    same_invariants(compiled, reference, t, np.hstack([q, v]))


def test_rows_of_drives_have_the_rate_of_their_motion() -> None:
    mechanism = load("five_bar")
    joint = mechanism.joint_names[0]
    drive = srm.Drive(joint=joint, law=srm.Sine(0.3, omega=2.0), name="motor")
    driven = srm.Mechanism(
        mechanism.model, mechanism.loops, q0=mechanism.q0, v0=mechanism.v0, drives=(drive,)
    )
    t, q, v = states(driven)
    compiled, reference = both(driven)
    for found, expected in zip(compiled.closure_errors(t, q, v), reference.closure_errors(t, q, v)):
        same(found, expected)
    assert np.abs(compiled.jacobians(t, q)[:, -1, -1]).min() > 1e-3
    same(compiled.jacobians(t, q), reference.jacobians(t, q))


def test_motions_between_many_states_are_those_of_the_reference() -> None:
    for mechanism in (floating_ring(), load("stewart_platform"), load("four_bar")):
        kernel_ones, reference = both(mechanism)
        _, q, v = states(mechanism)
        here = np.hstack([q, v])
        there = np.roll(here, 1, axis=0)
        width = 2 * mechanism.model.nv
        unit, order = np.linspace(0.5, 3.0, width), list(range(width - 1, -1, -1))
        turned, angles = [1], np.linspace(-1.0, 1.0, len(there))[:, None]
        missing = np.where(np.arange(len(there)) == 1, np.nan, angles[:, 0])[:, None]
        for start, *motions in (
            (here,),
            (here[:1],),  # from one state to each
            (here, turned, angles),
            (here, turned, missing),
        ):
            numbers = start, there, unit, order, [0, 1, width // 2], *motions
            found, expected = (
                own.largest_differences(*numbers) for own in (kernel_ones, reference)
            )
            for one, other in zip(found, expected):
                np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_closures_on_lie_groups_are_those_of_the_reference() -> None:
    ring = floating_ring()
    model = ring.model.copy()
    model.armature = np.linspace(0.1, 1.0, model.nv)
    mechanism = dataclasses.replace(ring, model=model)
    t, q, v = states(mechanism)
    compiled, reference = both(mechanism)
    for found, expected in zip(compiled.closure_errors(t, q, v), reference.closure_errors(t, q, v)):
        same(found, expected)
    same(compiled.jacobians(t, q), reference.jacobians(t, q))
    same(compiled.energies(q, v), reference.energies(q, v))
    same_invariants(compiled, reference, t, np.hstack([q, v]))


def test_powers_at_stages_are_those_of_the_states_there() -> None:
    """On Lie groups; of the reference by its own states, of the kernel in one call."""
    ring = floating_ring()
    ends = srm.Anchor(ring.model.names[2], xyz=(0.1, 0.2, 0.3)), srm.Anchor("world")
    strut = srm.SpringDamper(*ends, 30.0, 2.0, 0.2, "strut")
    # Its force is along the line that joins the points, also where it has no spring.
    damper = srm.SpringDamper(*ends, 0.0, 3.0, 0.0, "damper")
    mechanism = dataclasses.replace(ring, forces=(strut, damper))
    t, q, v = states(mechanism)
    steps = np.sort(t), np.hstack([q, v])
    rates = np.random.default_rng(7).standard_normal((COUNT - 1, 3, 2 * mechanism.model.nv))
    A, c, chosen = np.array([[0.2, 0.0], [0.3, 0.5]]), np.array([0.2, 0.8]), np.array([1, 4])
    compiled, reference = both(mechanism)
    found, expected = (
        own.stage_powers(chosen, *steps, rates, A, c) for own in (compiled, reference)
    )
    assert found["strut"].shape == (2, 2)
    for name in ("strut", "damper"):
        same(found[name], expected[name])
        same(compiled.powers(t, q, v)[name], reference.powers(t, q, v)[name])
    for own in (compiled, reference):  # of a run without steps
        assert own.stage_powers(chosen[:0], *steps, rates, A, c)["strut"].shape == (0, 2)
    h = steps[0][5] - steps[0][4]
    moved = 0.3 * rates[4, 0] + 0.5 * rates[4, 1]
    place = pin.integrate(mechanism.model, q[4], h * moved[: mechanism.model.nv])
    rate = v[4] + h * moved[mechanism.model.nv :]
    there = reference.powers(steps[0][4:5] + 0.8 * h, place[None], rate[None])["strut"]
    same(expected["strut"][1, 1:], there)


@pytest.mark.parametrize("kind", ELEMENTS)
def test_powers_and_potentials_of_elements_are_those_of_the_reference(kind: str) -> None:
    bare = load("spatial_four_bar")
    forces = ELEMENTS[kind]
    mechanism = srm.Mechanism(bare.model, bare.loops, q0=bare.q0, v0=bare.v0, forces=forces)
    t, q, v = states(mechanism)
    compiled, reference = both(mechanism)
    found, expected = compiled.powers(t, q, v), reference.powers(t, q, v)
    assert list(found) == list(expected) == [f.name for f in forces if f.name != "without damping"]
    for name, power in expected.items():
        assert np.abs(power).max() > 0.0
        same(found[name], power)
    same(compiled.energies(q, v), reference.energies(q, v))


def test_a_force_without_direction_is_refused_by_both_alike() -> None:
    bare = load("spatial_four_bar")
    bearing = srm.Anchor("world", xyz=tuple(bare.model.jointPlacements[1].translation))
    strut = srm.SpringDamper(srm.Anchor("crank"), bearing, 8.0, 1.0, 0.5, "strut")
    mechanism = srm.Mechanism(bare.model, bare.loops, q0=bare.q0, v0=bare.v0, forces=(strut,))
    for observables in both(mechanism):
        with pytest.raises(EvaluationError, match="'strut' coincide"):
            observables.powers(*states(mechanism))


def test_states_of_another_size_are_refused() -> None:
    compiled, _ = both(load("four_bar"))
    t, q, v = states(load("four_bar"))
    with pytest.raises(ValueError, match="do not fit"):
        compiled.closure_errors(t[:-1], q, v)
    with pytest.raises(ValueError, match="do not fit"):
        compiled.jacobians(t, v[:, :-1])


@pytest.mark.parametrize(("loops", "spread"), [(2, 0.0), (40, 0.0), (40, 0.3)])
def test_singular_values_of_many_rows_are_those_of_lapack(loops: int, spread: float) -> None:
    mechanism = srm.n_four_bar(loops)
    rng = np.random.default_rng(1)
    q = mechanism.q0 + spread * rng.standard_normal((5, mechanism.model.nq))
    geometry, rank = geometry_of(mechanism, mechanism.q0), mechanism.structure.rank
    compiled, _ = both(mechanism)
    rows = geometry.separated_rows(compiled.jacobians(np.zeros(5), q))
    found = SingularValues(separated_pattern(mechanism))(rows, rank)
    expected = np.linalg.svd(rows, compute_uv=False)[:, rank - 1]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-15)
    one_by_one = np.array([geometry.separated(place) for place in q])
    same(rows, one_by_one)


def agrees_with_lapack(mechanism: srm.Mechanism, t: FloatArray, q: FloatArray) -> FloatArray:
    """The values of the kernel, which are those of the plain computation to rounding."""
    geometry, rank = geometry_of(mechanism, mechanism.q0), mechanism.structure.rank
    values = SingularValues(separated_pattern(mechanism))
    compiled, reference = both(mechanism)
    found = compiled.smallest_values(geometry, values, rank, t, q)
    rows = geometry.separated_rows(reference.jacobians(t, q))
    expected = np.linalg.svd(rows, compute_uv=False)[:, rank - 1]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=4e-15)
    return found


@pytest.mark.parametrize("name", DISTINCT_MODELS)
def test_smallest_singular_values_are_those_of_the_plain_computation(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dependent rows (Bricard's mechanism), rows that are zero (planar loops), and drives."""
    monkeypatch.setattr(row_algebra, "COMPILED_ABOVE", 0)
    mechanism = load(name)
    if mechanism.structure.rank:
        t, q, _ = states(mechanism)
        agrees_with_lapack(mechanism, t, np.vstack([mechanism.q0, q[1:]]))


@pytest.mark.parametrize("loops", [6, 20, 40])
@pytest.mark.parametrize("angle", [1e-3, 1e-7, 1e-12, 0.0])
def test_smallest_singular_values_reach_zero_where_all_loops_are_singular_at_once(
    loops: int, angle: float
) -> None:
    """With horizontal cranks rows vanish, and as many singular values as there are loops."""
    mechanism = srm.n_four_bar(loops)
    cranks = np.isclose(mechanism.q0, np.pi / 2.0)
    q = np.where(cranks, angle, -angle)
    found = agrees_with_lapack(mechanism, np.zeros(1), q[None])
    assert found[0] <= angle + 1e-15


def test_smallest_singular_values_of_nearly_parallel_rows_are_those_of_their_differences(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(row_algebra, "COMPILED_ABOVE", 0)
    mechanism = floating_ring()
    bare = geometry_of(mechanism, mechanism.q0)
    t, q, _ = states(mechanism)
    agrees_with_lapack(mechanism, t, q)
    shared = ClosureGeometry(mechanism, mechanism.q0)
    shared.__dict__["shares"] = [(1, 0, 0.75), (2, 1, -0.5)]
    values = SingularValues(np.ones_like(separated_pattern(mechanism)))
    compiled, reference = both(mechanism)
    rows = shared.separated_rows(reference.jacobians(t, q))
    k = int(np.linalg.matrix_rank(rows[0]))
    found = compiled.smallest_values(shared, values, k, t, q)
    expected = np.linalg.svd(rows, compute_uv=False)[:, k - 1]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=4e-15)
    others = compiled.smallest_values(bare, values, k, t, q)
    assert np.abs(others - found).max() > 1e-3


def test_rows_of_another_system_are_refused() -> None:
    mechanism, other = srm.n_four_bar(8), srm.n_four_bar(9)
    geometry = geometry_of(mechanism, mechanism.q0)
    values = SingularValues(separated_pattern(mechanism))
    compiled, _ = both(mechanism)
    compiled.smallest_values(
        geometry, values, mechanism.structure.rank, np.zeros(1), mechanism.q0[None]
    )
    rows, algebra, _ = compiled._separated[1]  # type: ignore[index]
    with (
        both(other)[0].all_rows() as kernel_system,  # type: ignore[attr-defined]
        pytest.raises(ValueError, match="not those of the system"),
    ):
        kernel_system.smallest_values(rows, algebra, np.zeros(1), other.q0[None])


def driven(name: str, speeds: dict[str, float]) -> srm.Mechanism:
    """A bundled mechanism whose joints turn at constant speeds (rad/s)."""
    drives = tuple(srm.Drive(srm.ConstantSpeed(speed), joint) for joint, speed in speeds.items())
    mechanism = dataclasses.replace(load(name), drives=drives)
    start = srm.assemble(mechanism, mechanism.q0, mechanism.v0)
    return mechanism.with_state(start.q, start.v)


FIVE_BAR = {"crank_left": 2.0, "crank_right": -1.0}


@pytest.mark.parametrize(("name", "speeds"), [("wiper", None), ("five_bar", FIVE_BAR)])
def test_forces_of_drives_are_those_of_the_reference(
    name: str, speeds: dict[str, float] | None
) -> None:
    mechanism = load(name) if speeds is None else driven(name, speeds)
    run = srm.simulate(mechanism, 0.05)
    compiled, reference = both(mechanism)
    found = compiled.drive_forces(run.t, run.q, run.v)
    expected = reference.drive_forces(run.t, run.q, run.v)
    assert list(found) == list(expected) == [drive.name for drive in mechanism.drives]
    for name, force in expected.items():
        assert np.abs(force).max() > 0.0
        np.testing.assert_allclose(found[name], force, rtol=0.0, atol=1e-11 * np.abs(force).max())


def test_forces_of_drives_beside_dependent_rows_are_those_of_the_reference() -> None:
    """One row of Bricard's mechanism depends on the others wherever it is closed."""
    mechanism = driven("bricard", {"hinge_1": 1.0})
    (drive,) = mechanism.drives
    run = srm.simulate(mechanism, 0.3)
    compiled, reference = both(mechanism)
    found = compiled.drive_forces(run.t, run.q, run.v)[drive.name]
    expected = reference.drive_forces(run.t, run.q, run.v)[drive.name]
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11 * np.abs(expected).max())


def assert_same_reactions(mechanism: srm.Mechanism, tolerance: float = 1e-9) -> None:
    """Compare the reactions along a run, relative to the largest one."""
    run = srm.simulate(mechanism, 0.005)
    compiled, reference = (each.reactions(run.t, run.q, run.v) for each in both(mechanism))
    assert_equal_reactions(compiled, reference, tolerance)
    a, b = (each.accelerations(run.t, run.q, run.v) for each in both(mechanism))
    np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-10 * np.abs(b).max())


def assert_equal_reactions(compiled: Reactions, reference: Reactions, tolerance: float) -> None:
    for key in ("closures", "multipliers", "drives", "joints"):
        found, expected = getattr(compiled, key), getattr(reference, key)
        assert list(found) == list(expected)
        size = max((np.abs(own).max(initial=0.0) for own in expected.values()), default=0.0)
        for name, own in expected.items():
            assert found[name].shape == own.shape
            np.testing.assert_allclose(found[name], own, rtol=0.0, atol=tolerance * size)


def test_reactions_under_held_forces_are_those_of_the_reference() -> None:
    """Samples every 0.1 s; times of the run in any order, also those of samples."""
    mechanism = load("four_bar")
    run = srm.simulate(
        mechanism, 0.5, controller=lambda t, q, v: [3.0 - 9.0 * t, -v[1], 2.0], sample_time=0.1
    )
    at = run.at(np.array([0.3, 0.12, 0.1, 0.45, 0.0, 0.3]))
    compiled, reference = CompiledObservables(run.system), Observables(run.system)
    expected = reference.reactions(at.t, at.q, at.v)
    assert_equal_reactions(compiled.reactions(at.t, at.q, at.v), expected, 1e-12)
    same(compiled.accelerations(at.t, at.q, at.v), reference.accelerations(at.t, at.q, at.v))
    without = Observables(make_system(mechanism)).reactions(at.t, at.q, at.v)
    assert np.abs(without.closures["pin"] - expected.closures["pin"]).max() > 0.1


@pytest.mark.parametrize("name", [*DISTINCT_MODELS, "n_four_bar_12"])
def test_reactions_are_those_of_the_reference(name: str) -> None:
    assert_same_reactions(load(name))


@pytest.mark.parametrize("kind", ["springs with damping", "a bushing", "loads"])
def test_reactions_under_forces_between_links_are_those_of_the_reference(kind: str) -> None:
    elements = tuple(e for e in ELEMENTS[kind] if not isinstance(e, srm.UserForce))
    assert_same_reactions(dataclasses.replace(load("four_bar"), forces=elements))


def test_reactions_of_redundant_hinges_are_those_of_the_reference() -> None:
    """Their axis rows depend on the others: the values of least norm."""
    ball = load("four_bar")
    hinges = tuple(
        dataclasses.replace(p, type="revolute", axis=(0.0, 1.0, 0.0)) for p in ball.loops
    )
    assert_same_reactions(dataclasses.replace(ball, loops=hinges))
    assert_same_reactions(
        dataclasses.replace(
            ball, loops=(*hinges, *(dataclasses.replace(p, name=f"again {p.name}") for p in hinges))
        )
    )
    assert_same_reactions(driven("five_bar", FIVE_BAR))


def test_reactions_with_functions_of_the_user_are_those_of_the_reference() -> None:
    mechanism = dataclasses.replace(load("four_bar"), forces=ELEMENTS["loads"])
    assert_same_reactions(mechanism, 1e-14)


def test_threads_read_the_reactions_of_one_mechanism_alike() -> None:
    mechanism = load("four_bar")
    runs = [srm.simulate(mechanism, 1.0) for _ in range(8)]
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda run: run.joint_reactions, runs))
    for each in found:
        for name, wrench in each.items():
            np.testing.assert_array_equal(wrench, found[0][name])
