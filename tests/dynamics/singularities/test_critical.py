"""The search for critical configurations: its derivatives, and ones that are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry, column_groups
from srm_mbs.dynamics.constraints.structure import structure_of
from srm_mbs.dynamics.singularities.critical import (
    CriticalConfiguration,
    critical_configuration,
    first_step_length,
)
from tests.support.bundled import load

TURN = 2.0 * np.pi
FIRST, SECOND = np.array([np.pi / 2, -np.pi]), np.array([-np.pi / 2, np.pi])
"""Singular configurations of the slider-crank."""
BESIDE = np.array([0.1, -0.2])


class Counting(ClosureGeometry):
    """Closures that count how often they are evaluated."""

    evaluations = 0

    def closure(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        self.evaluations += 1
        return super().closure(q)


def search(geometry: ClosureGeometry, q: Any, reach: float, *known: CriticalConfiguration) -> Any:
    rank = structure_of(geometry.mechanism).rank
    return critical_configuration(geometry, rank, np.asarray(q), reach, known)


@pytest.mark.parametrize("turns", [0, 3, -40])
def test_a_known_critical_configuration_is_found_by_two_evaluations_in_any_turn(turns: int) -> None:
    mechanism = load("slider_crank")
    geometry = Counting(mechanism, mechanism.q0)
    known = search(geometry, FIRST + BESIDE, 0.6)
    whole = TURN * turns * np.array([1.0, -2.0])
    near = FIRST + whole - 1.5 * BESIDE
    geometry.evaluations = 0

    found = search(geometry, near, 0.6, known)

    assert geometry.evaluations == 2
    np.testing.assert_allclose(found.q, FIRST + whole, atol=1e-12)
    assert found.residual == known.residual
    again = search(geometry, near, 0.6)
    np.testing.assert_allclose(found.q, again.q, atol=1e-12)


def test_a_known_critical_configuration_does_not_hide_the_one_that_the_search_leads_to() -> None:
    mechanism = load("slider_crank")
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    known = search(geometry, FIRST + BESIDE, 0.6)

    found = search(geometry, SECOND + BESIDE, 10.0, known)

    np.testing.assert_allclose(found.q, SECOND, atol=1e-9)


def test_whole_turns_lead_elsewhere_where_closures_count_them() -> None:
    """A wheel that follows half the angle of the crank is elsewhere after an odd number of turns
    alone: the configuration that is known there is not closed."""
    crank = load("slider_crank")
    model = crank.model.copy()
    joint = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "wheel")
    model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    gear = srm.LoopClosure(type="coupling", name="gear", joints=("wheel", "crank"), ratio=0.5)
    mechanism = srm.Mechanism(model, (*crank.loops, gear))
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    order = [model.joints[model.getJointId(name)].idx_q for name in ("crank", "rod", "wheel")]

    def placed(crank_angle: float, rod: float, wheel: float) -> FloatArray:
        out = np.zeros(3)
        out[order] = crank_angle, rod, wheel
        return out

    known = search(geometry, placed(*FIRST, np.pi / 4), 0.6)
    one_turn = placed(FIRST[0] + TURN, FIRST[1] - 2.0 * TURN, np.pi / 4 + np.pi)

    assert known.in_turns_of(placed(FIRST[0] + 2 * TURN, FIRST[1], np.pi / 4 + TURN)) is not None
    assert known.in_turns_of(one_turn) is None
    found = search(geometry, one_turn + 0.05, 0.6, known)
    np.testing.assert_allclose(found.q, one_turn, atol=1e-9)


@pytest.mark.parametrize("name", ["klann_walker", "slider_crank", "delta_robot"])
def test_the_search_leaves_a_reach_that_is_shorter_than_its_first_step_at_once(name: str) -> None:
    mechanism = load(name)
    geometry, q = Counting(mechanism, mechanism.q0), mechanism.q0
    length = first_step_length(geometry, mechanism.structure.rank, q, geometry.jacobians)
    counts = []
    for reach in (0.99 * length, 1.01 * length):
        geometry.evaluations = 0
        found = search(geometry, q, reach)
        counts.append(geometry.evaluations)
        assert found is None or reach > length
    assert counts[0] < counts[1]


@pytest.mark.parametrize("name", ["n_four_bar_20", "delta_robot", "jansen_walker", "differential"])
def test_coordinates_that_change_together_give_the_derivatives_of_each_alone(name: str) -> None:
    """Differences of G^T u one coordinate at a time, through ``pin.integrate``."""
    mechanism = load(name)
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    rank, n, h = mechanism.structure.rank, mechanism.model.nv, 1e-5
    rows = np.linalg.qr(np.random.default_rng(1).normal(size=(len(geometry.row_unit), rank)))[0].T
    u = np.full(rank, rank**-0.5)
    at = CriticalConfiguration(geometry, mechanism.q0, rows, u, 0.0, np.zeros((n, n)))

    def gradient(e: FloatArray) -> FloatArray:
        q = pin.integrate(mechanism.model, mechanism.q0, e * geometry.unit)
        out: FloatArray = at.weights @ geometry.closure(q)[1]
        return out

    alone = np.array([(gradient(e) - gradient(-e)) / (2.0 * h) for e in h * np.eye(n)]).T

    np.testing.assert_allclose(at.hessian, alone, rtol=0.0, atol=1e-9 * np.abs(alone).max() + 1e-9)
    groups, _ = column_groups(mechanism)
    assert sorted(j for group in groups for j in group) == list(range(n))


def test_the_loops_of_a_chain_need_no_more_differences_than_a_few_of_them() -> None:
    assert len(column_groups(load("n_four_bar_20"))[0]) <= 6
