"""The same mechanism in other units takes the same steps, and in other coordinates the same
passages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from tests.support import maximal, reduced
from tests.support.bundled import load
from tests.support.mechanisms import add_link, rescaled, start_terms, with_slider_mass
from tests.support.references import observed, reference

# Powers of four scale every quantity, square roots included, without rounding.
EXACT = [{"length": 4.0**5}, {"mass": 4.0**5}, {"time": 4.0}, {"length": 4.0**-4, "time": 16.0}]
ROUNDED = [{"length": 1000.0}, {"length": 1e-3}, {"mass": 1e3}, {"time": 10.0}, {"time": 1e-2}]


def in_both_units(
    name: str, scale: dict[str, float], t_end: float, **options: Any
) -> tuple[srm.Solution, srm.Solution, np.ndarray]:
    """A run, that of the rescaled mechanism, and the times of the latter in the original unit."""
    mechanism, time = load(name), scale.get("time", 1.0)
    plain = srm.simulate(mechanism, t_end, **options)
    scaled = srm.simulate(rescaled(mechanism, **scale), t_end * time, **options)
    assert scaled.success
    return plain, scaled, scaled.t / time


@pytest.mark.parametrize("scale", EXACT, ids=str)
@pytest.mark.parametrize("tableau", ["dop853", "dopr54"])
@pytest.mark.parametrize("name", ["slider_crank", "slider_crank_slider", "pendulum_chain"])
def test_rescaling_without_rounding_repeats_every_step(
    name: str, tableau: str, scale: dict[str, float]
) -> None:
    plain, scaled, t = in_both_units(name, scale, 5.0, rtol=1e-7, tableau=tableau)
    assert np.array_equal(t, plain.t)
    assert scaled.stats.evaluations == plain.stats.evaluations


@pytest.mark.parametrize("scale", ROUNDED, ids=str)
@pytest.mark.parametrize(
    "name", ["four_bar", "pendulum_chain", "slider_crank_regular", "squeezing_mechanism"]
)
def test_rescaling_with_rounding_takes_the_same_steps_on_regular_mechanisms(
    name: str, scale: dict[str, float]
) -> None:
    """The squeezing mechanism has no gravity and starts at rest: forces give its unit of rates."""
    t_end = 0.01 if name == "squeezing_mechanism" else 5.0
    plain, _, t = in_both_units(name, scale, t_end, rtol=1e-7)
    assert len(t) == len(plain.t)
    assert np.allclose(t, plain.t, rtol=1e-4)


@pytest.mark.parametrize("scale", ROUNDED, ids=str)
def test_singular_passages_are_the_same_in_other_units(scale: dict[str, float]) -> None:
    """Rounding next to a singular configuration changes single steps, not what happens."""
    plain, scaled, _ = in_both_units("slider_crank_slider", scale, 20.0, rtol=1e-7)
    assert len(scaled.crossings) == len(plain.crossings)
    assert scaled.stats.evaluations == pytest.approx(plain.stats.evaluations, rel=0.15)
    assert scaled.joint("crank")[0][-1] == pytest.approx(plain.joint("crank")[0][-1], abs=1e-5)


UNITS = [{"length": 1000.0, "mass": 1e-6, "time": 1000.0}, {"length": 0.1, "mass": 1e3}]


def times_of(solution: srm.Solution) -> np.ndarray:
    return np.array([crossing.time for crossing in solution.crossings])


@pytest.mark.parametrize("scale", UNITS, ids=str)
@pytest.mark.parametrize("name", ["slider_crank", "spatial_dead_point", "n_four_bar_2"])
def test_units_change_neither_passages_nor_errors(name: str, scale: dict[str, float]) -> None:
    plain, scaled, _ = in_both_units(name, scale, 3.0, rtol=1e-8)
    time = scale.get("time", 1.0)
    assert times_of(scaled) / time == pytest.approx(times_of(plain), abs=1e-9)
    for a, b in zip(scaled.crossings, plain.crossings):
        assert (a.loops, a.left_on) == (b.loops, b.left_on)
    assert scaled.stats.evaluations == pytest.approx(plain.stats.evaluations, rel=0.05)
    assert abs(scaled.stats.placements - plain.stats.placements) <= 4
    t, exact = reference(name, 3.0, 30)
    error = np.abs(observed(name, plain, t) - exact).max()
    values = observed(name, scaled, t * time) * [1.0, time]
    assert np.abs(values - exact).max() < 2.0 * error + 1e-10


def screwed(pitch: float) -> srm.Mechanism:
    """slider_crank_slider with its slider of 0.5 kg on a screw of ``pitch`` (m/rad): its coordinate
    is an angle, as behind a reduction gear."""
    base = load("slider_crank_slider")
    model = pin.Model()
    model.gravity.linear = base.model.gravity.linear
    unit = np.ones(base.model.nv)
    for j in range(1, base.model.njoints):
        name, joint = base.model.names[j], base.model.joints[j]
        inertia = base.model.inertias[j]
        if name == "slider":
            unit[joint.idx_v] = 1.0 / pitch
            joint = pin.JointModelHX(pitch)
            inertia = pin.Inertia(inertia.mass, np.zeros(3), np.zeros((3, 3)))
        place = base.model.jointPlacements[j]
        add_link(model, base.model.parents[j], joint, name, inertia, place)
    (pin_,) = base.loops
    # The rows in the rod's axes: those of the slider would turn with the screw.
    loop = srm.LoopClosure("point", pin_.b, pin_.a, name="pin")
    return srm.Mechanism(model, (loop,), q0=base.q0 * unit, v0=base.v0 * unit)


def crank_error(solution: srm.Solution, start: list[float], field: Any, t: np.ndarray) -> float:
    """Largest error of angle and rate of the joint ``crank`` over ``t``."""
    joint = solution.mechanism.joint("crank")
    exact = reduced.trajectory(field, start, t)
    q, v = solution(t)
    rate = v[:, joint.idx_v + joint.nv - 1]
    if joint.nq == joint.nv:
        off = q[:, joint.idx_q] - exact[:, 0]
    else:  # planar joint: x, y, cos, sin
        off = np.arctan2(q[:, joint.idx_q + 3], q[:, joint.idx_q + 2]) - exact[:, 0]
        off = (off + np.pi) % (2.0 * np.pi) - np.pi
    return float(max(np.abs(off).max(), np.abs(rate - exact[:, 1]).max()))


REST = [7 * np.pi / 4, 0.0]


def passages(field: Any, start: list[float], t: np.ndarray) -> int:
    """How often the crank's angle passes pi/2 + k pi."""
    angle = reduced.trajectory(field, start, t)[:, 0]
    return int(np.sum(np.diff(np.floor((angle - np.pi / 2) / np.pi)) != 0))


@pytest.mark.parametrize("exponent", [-6, -3, 1, 6])
def test_the_mass_of_the_slider_changes_no_branch(exponent: int) -> None:
    mass = 10.0**exponent
    mechanism = with_slider_mass(mass)
    solution = srm.simulate(mechanism, 5.0, rtol=1e-8)
    assert solution.success
    t = np.linspace(0.0, 5.0, 101)[1:]
    field = reduced.slider_crank(mass)
    assert crank_error(solution, REST, field, t) < 1e-8
    assert len(solution.crossings) == passages(field, REST, t)
    assert not any(crossing.switched for crossing in solution.crossings)
    assert 0.5 < start_terms(mechanism).sigma < 2.0


@pytest.mark.parametrize("pitch", [1e-3, 0.1, 100.0])
def test_a_gear_ratio_changes_no_passage(pitch: float) -> None:
    """Steps may be shorter: a screw counts in radians, of which many make a length."""
    plain = srm.simulate(load("slider_crank_slider"), 5.0, rtol=1e-8)
    geared = srm.simulate(screwed(pitch), 5.0, rtol=1e-8)
    assert geared.success
    assert times_of(geared) == pytest.approx(times_of(plain), abs=1e-7)
    t = np.linspace(0.0, 5.0, 51)[1:]
    assert crank_error(geared, REST, reduced.slider_crank(0.5), t) < 1e-8
    assert geared.stats.evaluations < 3 * plain.stats.evaluations
    for a, b in zip(geared.crossings, plain.crossings):
        assert (a.rank, a.switched) == (b.rank, False)


CASES = {
    "slider_crank": (maximal.slider_crank, reduced.slider_crank(), REST),
    "parallelogram": (maximal.parallelogram, reduced.parallelogram(), [1.0, 6.0]),
}


@pytest.mark.parametrize("joints", maximal.JOINTS)
@pytest.mark.parametrize("name", CASES)
def test_maximal_coordinates_pass_as_a_tree_does(name: str, joints: str) -> None:
    make, field, start = CASES[name]
    t_end = 3.0
    t = np.linspace(0.0, t_end, 31)[1:]
    tree = srm.simulate(load(name), t_end, rtol=1e-8)
    solution = srm.simulate(make(joints), t_end, rtol=1e-8)
    assert solution.success
    assert solution.mechanism.degrees_of_freedom == 1
    assert times_of(solution) == pytest.approx(times_of(tree), abs=1e-7)
    assert not any(crossing.switched for crossing in solution.crossings)
    assert crank_error(solution, start, field, t) < 1e-8
    assert crank_error(tree, start, field, t) < 1e-8


@pytest.mark.parametrize("joints", maximal.JOINTS)
@pytest.mark.parametrize("name", CASES)
def test_sigma_has_the_same_size_in_maximal_coordinates(name: str, joints: str) -> None:
    make, _, _ = CASES[name]
    system, tree = make_system(make(joints)), make_system(load(name))
    ratios = []
    for angle in np.arange(0.1, 2.0 * np.pi, 0.4):
        apart = make(joints, angle)
        q = [angle, -2.0 * angle] if name == "slider_crank" else [angle, -angle, angle]
        here = system.evaluate(0.0, np.concatenate([apart.q0, apart.v0])).sigma
        ratios.append(here / tree.evaluate(0.0, np.array(q + len(q) * [0.0])).sigma)
    assert min(ratios) > 0.5
    assert max(ratios) < 2.0


@pytest.mark.parametrize("at", [0.0, 1e-17, 3e-16])
def test_points_that_coincide_but_for_rounding_give_no_length(at: float) -> None:
    model = pin.Model()
    for name, offset in (("a", 0.0), ("b", at)):
        place = pin.SE3(np.eye(3), np.array([0.3, 0.0, 0.3 + offset]))
        inertia = pin.Inertia(1.0, np.zeros(3), np.eye(3))
        add_link(model, 0, pin.JointModelRZ(), name, inertia, place)
    units = srm.Mechanism(model, q0=[0.1, 0.2]).structure.units
    assert units.length == 1.0
    assert units.rate == pytest.approx(np.sqrt(9.81))
