"""Results compute what they hold when it is first read."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.simulation import runner

READ = ("t", "q", "v", "attempts", "message", "stats", "settings", "bifurcations")


def values(solution: srm.Solution) -> list[Any]:
    """Everything that is computed late; the time that the run took is left out."""
    found = [getattr(solution, name) for name in READ]
    stats = solution.stats
    found[READ.index("stats")] = (stats.steps, stats.rejected, stats.evaluations, stats.zone_steps)
    return found


def same(a: list[Any], b: list[Any]) -> bool:
    """Whether two lists of values are equal to the last bit."""
    return all(np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y for x, y in zip(a, b))


def test_the_message_is_made_once_and_not_before_it_is_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[object] = []
    sentences = runner.bifurcation_sentences

    def counted(*arguments: Any) -> Any:
        made.append(arguments)
        return sentences(*arguments)

    monkeypatch.setattr(runner, "bifurcation_sentences", counted)
    solution = srm.simulate(srm.load("slider_crank"), 1.0, backend=srm.backend())
    if solution.settings.backend != "python":  # the reference keeps arrays, not its steps
        assert not made
    assert solution.message == "The run reached t = 1 s." == solution.message
    assert len(made) == 1


def test_what_is_read_after_other_runs_is_what_the_run_left() -> None:
    mechanism = srm.load("slider_crank_whirl")
    at_once = values(srm.simulate(mechanism, 3.0))
    late = srm.simulate(mechanism, 3.0)
    for speed in (0.5, 1.5):
        values(srm.simulate(mechanism, 2.0, v0=speed * mechanism.v0))
    assert same(values(late), at_once)


def test_a_result_that_nobody_read_is_pickled_whole() -> None:
    solution = srm.simulate(srm.load("slider_crank"), 2.0, rtol=1e-7)
    other = pickle.loads(pickle.dumps(solution))
    assert same(values(other), values(solution))
    assert np.array_equal(other(1.234)[0], solution(1.234)[0])


def test_reading_a_result_calls_no_function_of_the_user() -> None:
    mechanism = srm.load("four_bar")
    calls: list[float] = []

    def controller(t: float, q: Any, v: Any) -> Any:
        calls.append(t)
        return -0.1 * v

    solution = srm.simulate(mechanism, 0.5, controller=controller)
    made = len(calls)
    values(solution)
    assert len(calls) == made > 0


def test_the_measures_of_a_sweep_are_those_of_dense_output_at_the_ends() -> None:
    for options in ({}, {"t_eval": [0.5, 0.75]}):
        solution = srm.simulate(srm.load("slider_crank"), 1.0, rtol=1e-8, **options)
        measures = srm.standard_measures(solution)
        ends = solution.at(solution.span)
        assert measures["t_end"] == 1.0
        assert measures["drift"] == pytest.approx(ends.drift[1, 0], abs=1e-15)
        change = ends.energy[1] - ends.energy[0]
        assert measures["energy_change"] == pytest.approx(change, abs=1e-13)


def test_everything_that_a_run_gives_is_shown_in_one_line() -> None:
    solution = srm.simulate(srm.load("four_bar"), 0.5)
    assert (
        repr(srm.mobility_map(solution))
        == f"MobilityMap({len(solution.t)} times, degrees of freedom 1)"
    )
    balance = repr(solution.energy_balance)
    assert balance.startswith(f"EnergyBalance({len(solution.t)} times, residual at most ")
    assert balance.endswith(" J, works=[])")
    point = solution.point(srm.Anchor("coupler"))
    assert repr(point) == "PointMotion(position, velocity, acceleration)"
