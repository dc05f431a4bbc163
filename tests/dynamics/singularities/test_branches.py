"""Branches through singular configurations: dead points, tangents, which branch a run keeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.singularities.branches import branch_tangents
from srm_mbs.integration.singular_passages import find_crossings
from tests.support import reduced
from tests.support.mechanisms import ball_dead_point, floating_slider_crank
from tests.support.singularities import singular_at

PI = np.pi


@pytest.mark.parametrize(
    ("start", "tol", "bound"),
    [("hinges", 1e-6, 1e-3), ("hinges", 1e-8, 2e-6), ("ball joint", 1e-8, 2e-6)],
)
def test_the_crank_passes_its_spatial_dead_points_on_its_branch(
    start: str, tol: float, bound: float
) -> None:
    mechanism = ball_dead_point() if start == "ball joint" else srm.load("spatial_dead_point")
    solution = srm.simulate(mechanism, 10.0, rtol=tol, atol=tol)
    angle, rate = solution.joint("crank")
    if start == "hinges":
        angle = angle - np.pi / 6.0
    expected = reduced.integrate(reduced.spatial_dead_point(), [-np.pi / 6.0, 4.0], 10.0)
    assert [angle[-1], rate[-1]] == pytest.approx(list(expected), abs=bound)
    assert len(solution.crossings) == 11


# --- tangents -----------------------------------------------------------------------------------


def test_the_tangents_of_a_slider_crank_are_its_two_motions() -> None:
    singular = singular_at(srm.load("slider_crank"), [1.5 * PI, -3.0 * PI])
    tangents = branch_tangents(singular)
    expected = [[1.0, 0.0], [1.0 / np.sqrt(5.0), -2.0 / np.sqrt(5.0)]]
    np.testing.assert_allclose(tangents, expected, atol=1e-12)


FLAT: dict[str, Any] = {
    "slider_crank_slider": [1.5 * PI, -3.0 * PI, 0.0],
    "parallelogram": [0.0, 0.0, 0.0],
    "folded parallelogram": [PI, -PI, PI],
    "n_four_bar_1": [0.0, 0.0, 0.0],
    "n_four_bar_2": [0.0] * 5,
    "n_four_bar_3": [0.0] * 7,
}


@pytest.mark.parametrize("case", FLAT)
def test_each_tangent_leads_to_closed_configurations(case: str) -> None:
    """The closing nearest to q (+) h u is at most O(h^2) from it: u is a motion's direction."""
    mechanism = srm.load(case.split()[-1])
    singular = singular_at(mechanism, FLAT[case])
    tangents = branch_tangents(singular)
    assert len(tangents) == 2
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1.0)
    assert abs(tangents[0] @ tangents[1]) < 0.99
    geometry = singular.geometry
    errors = []
    for h in (2e-2, 1e-2):
        worst = 0.0
        for u in (*tangents, *-tangents):
            moved = geometry.move(singular.q, h * u)
            closed = srm.assemble(mechanism, moved).q
            worst = max(worst, float(np.abs(geometry.difference(moved, closed)).max()))
        errors.append(worst)
    assert errors[1] < 1e-3
    assert errors[1] < 1e-12 or errors[0] / errors[1] > 3.5


@pytest.mark.parametrize("start", [ball_dead_point, floating_slider_crank])
def test_tangents_for_an_arriving_velocity_keep_what_it_has_along_the_branch(start: Any) -> None:
    """v_a - v is M-orthogonal to the branch, so momenta of free bases and idle spins are kept."""
    mechanism = start() if start is floating_slider_crank else ball_dead_point(PI / 2.0, 4.0)
    singular = singular_at(mechanism, mechanism.q0)
    geometry = singular.geometry
    rng = np.random.default_rng(3)
    arriving = mechanism.v0 / geometry.unit
    arriving = arriving + singular.null @ (0.3 * rng.standard_normal(singular.null.shape[1]))
    tangents = branch_tangents(singular, arriving)
    assert len(tangents) == 2
    geometry.closure(singular.q)
    M = geometry.mass()
    for u in tangents:
        assert np.abs(geometry.normalised(singular.q) @ u).max() < 1e-10
        assert np.abs(singular.curvature(u)).max() < 1e-10
        space = singular.branch(u)
        assert space is not None
        assert space.shape[1] == mechanism.degrees_of_freedom
        v = u * ((u @ M @ arriving) / (u @ M @ u))
        assert np.abs(space.T @ M @ (arriving - v)).max() < 1e-9 * np.abs(M @ arriving).max()


def test_an_arriving_velocity_on_a_branch_is_its_own_tangent() -> None:
    mechanism = ball_dead_point(PI / 2.0, 4.0)
    singular = singular_at(mechanism, mechanism.q0)
    arriving = mechanism.v0 / singular.geometry.unit
    tangents = branch_tangents(singular, arriving)
    np.testing.assert_allclose(tangents[0], arriving / np.linalg.norm(arriving), atol=1e-11)


def test_rates_assembled_on_a_singular_configuration_lie_along_a_tangent() -> None:
    mechanism = srm.load("parallelogram")
    state = srm.assemble(mechanism, {"crank": 0.0}, {"crank": 1.0, "rocker": 1.0})
    singular = singular_at(mechanism, state.q)
    direction = state.v / np.linalg.norm(state.v)
    chords = np.linalg.norm(branch_tangents(singular) - direction, axis=1)
    assert chords.min() < 1e-7


# --- which branch a run keeps -------------------------------------------------------------------


class Joined:
    """One run after another, as if a step had gone over to other rates between them."""

    def __init__(self, first: srm.Solution, second: srm.Solution) -> None:
        self.first, self.second, self.at = first, second, float(first.t[-1])
        self.observables = first.observables
        a, b = first.steps, second.steps
        names = ("rates", "corrections", "sigmas", "ranks", "error_ratios", "placements", "stiff")
        both = {name: np.concatenate([getattr(a, name), getattr(b, name)]) for name in names}
        self.steps = replace(
            a,
            times=np.concatenate([a.times, self.at + b.times[1:]]),
            states=np.concatenate([a.states[:-1], b.states]),
            zones={},
            **both,
        )

    def __call__(self, times: np.ndarray) -> np.ndarray:
        states = [
            self.first(t) if t < self.at else self.second(min(t - self.at, self.second.t[-1]))
            for t in times
        ]
        rows = [np.concatenate(state) for state in states]
        return np.reshape(rows, (len(times), self.steps.states.shape[1]))


@pytest.mark.parametrize(("ratio", "switched"), [(-2.0, False), (0.0, True)])
def test_a_switch_to_another_branch_is_seen_in_the_velocities(ratio: float, switched: bool) -> None:
    """A slider-crank arrives upright; from there it goes on, or with the rod on the crank."""
    mechanism = srm.load("slider_crank")
    options: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9}
    back = srm.simulate(mechanism, 0.5, q0=[0.5 * PI, -PI], v0=[-3.0, 6.0], **options)
    q0, v0 = back.q[-1], -back.v[-1]
    arriving = srm.simulate(mechanism, 0.5, q0=q0, v0=v0, **options)
    leaving = srm.simulate(mechanism, 0.5, q0=[0.5 * PI, -PI], v0=[3.0, 3.0 * ratio], **options)
    run: Any = Joined(arriving, leaving)
    (crossing,) = find_crossings(
        make_system(mechanism), arriving.scheme, run.steps, lambda: (run, 0.0)
    )
    assert crossing.time == pytest.approx(0.5, abs=1e-5)
    assert crossing.switched is switched
    assert crossing.arrived_on is not None
    assert crossing.left_on is not None
    after = crossing.branches[crossing.left_on]
    assert after[1] / after[0] == pytest.approx(ratio, abs=1e-6)


def test_the_rods_tip_moves_along_the_tangent_of_the_branch_at_dead_points() -> None:
    """On the moving branch the rod's tip slides at -2 a sin(angle) times the crank's rate."""
    mechanism = ball_dead_point(0.0, 6.0)
    solution = srm.simulate(mechanism, 1.0, rtol=1e-8, atol=1e-8)
    data = mechanism.model.createData()
    frame = mechanism.model.getFrameId("rod", pin.FrameType.BODY)
    for crossing in solution.crossings:
        assert crossing.left_on is not None
        assert crossing.configuration is not None
        v = crossing.branches[crossing.left_on]
        q = crossing.configuration
        pin.forwardKinematics(mechanism.model, data, q, v)
        pin.updateFramePlacements(mechanism.model, data)
        rate = pin.getFrameVelocity(
            mechanism.model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        arm = data.oMf[frame].rotation @ np.array([2.5, 0.0, 0.0])
        tip = rate.linear + np.cross(rate.angular, arm)
        assert tip[0] / v[0] == pytest.approx(-4.0 * np.sin(q[0]), abs=1e-8)
