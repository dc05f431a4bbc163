"""Degrees of freedom along a run."""

from __future__ import annotations

import numpy as np
import pytest

import srm_mbs as srm


def test_a_regular_run_keeps_its_degrees_of_freedom() -> None:
    solution = srm.simulate(srm.load("five_bar"), 1.0)
    found = srm.mobility_map(solution)
    assert set(found.degrees_of_freedom) == set(solution.degrees_of_freedom) == {2}
    assert set(found.rank) == {2}
    assert found.changes == ()
    assert found.distance.min() > 0.01
    assert found.singular_values.shape == (len(solution.t), 3)  # the third row is always zero
    np.testing.assert_allclose(found.singular_values[:, 2], 0.0, atol=1e-12)
    assert found.coordinates == solution.mechanism.joint_names


def test_a_run_that_is_read_nowhere_has_an_empty_map() -> None:
    found = srm.mobility_map(srm.simulate(srm.load("five_bar"), 0.1, t_eval=[]))
    assert found.degrees_of_freedom.shape == (0,)
    assert found.singular_values.shape == (0, 3)
    turn = srm.Event(lambda t, q, v: t - 0.05, action=lambda t, q, v: None)
    late = srm.simulate(srm.load("five_bar"), 0.1, t_eval=[0.07], events=turn)
    assert late.degrees_of_freedom.tolist() == [2]


def test_an_open_chain_moves_freely() -> None:
    found = srm.mobility_map(srm.simulate(srm.load("pendulum_chain"), 0.5))
    assert set(found.degrees_of_freedom) == {3}
    np.testing.assert_allclose(found.participation, 1.0)
    assert np.all(np.isinf(found.distance))


def test_it_changes_where_the_run_passes_singular_configurations() -> None:
    """The slider-crank with equal bars: a second degree of freedom where cos(theta) = 0."""
    solution = srm.simulate(srm.load("slider_crank_whirl"), 2.0, rtol=1e-8)
    found = srm.mobility_map(solution)
    angles = np.array([solution(change.time)[0][0] for change in found.changes])
    assert len(angles) == len(solution.crossings) >= 1
    np.testing.assert_allclose(np.cos(angles), 0.0, atol=1e-6)
    assert {change.degrees_of_freedom for change in found.changes} == {2}
    assert {change.loops for change in found.changes} == {("pin",)}
    assert set(found.degrees_of_freedom) == {1}
    # read exactly there, it is seen in the map, and the rod moves by itself too
    times = np.array([change.time for change in found.changes])
    near = srm.mobility_map(solution.at(times))
    assert near.distance.max() < 1e-6 < found.distance.max()


def test_participation_tells_what_can_move() -> None:
    """At a singular configuration of the slider-crank both bars turn by themselves; elsewhere the
    rod turns twice as fast as the crank."""
    mechanism = srm.load("slider_crank")
    solution = srm.simulate(mechanism, 0.1)
    found = srm.mobility_map(solution)
    np.testing.assert_allclose(
        found.participation, np.tile([1.0, 2.0] / np.sqrt(5.0), (len(solution.t), 1)), atol=1e-9
    )


def test_a_run_with_event_actions_is_read_segment_by_segment() -> None:
    mechanism = srm.load("slider_crank_regular")
    turn = srm.Event(lambda t, q, v: q[0] - 1.0, action=lambda t, q, v: (q, -v))
    solution = srm.simulate(mechanism, 0.5, events=turn)
    with pytest.raises(srm.InputError, match=r"Give one of solution\.segments"):
        srm.mobility_map(solution)
    for segment in solution.segments:
        assert set(srm.mobility_map(segment).degrees_of_freedom) == {1}
    assert set(solution.degrees_of_freedom) == {1}
