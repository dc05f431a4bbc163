"""Singular times that the user gives, and the thesis' halved step."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.integration.control.prescribed_times import (
    CLEARANCE_AHEAD,
    STAGE_CLEARANCE,
    AvoidTimes,
)
from srm_mbs.integration.control.step_size import FixedStep
from srm_mbs.integration.methods.base import IntegratorState
from tests.support.bundled import load
from tests.support.slider_crank import PERIOD, off_branch, passages
from tests.support.snapshots import check_refusals

PASSAGES = passages(5)
"""When the thesis' slider-crank is singular."""
CLEAR = STAGE_CLEARANCE * (1.0 - 1e-6)


@pytest.fixture(scope="module")
def slider_crank() -> srm.Mechanism:
    return load("slider_crank")


def clearance(t: np.ndarray, scheme: srm.ButcherTableau, times: np.ndarray) -> float:
    """Smallest distance of a stage or end from ``times``, in steps."""
    h = np.diff(t)
    abscissae = np.unique(np.append(scheme.c[scheme.c > 0.0], 1.0))
    stages = t[:-1, None] + h[:, None] * abscissae
    return float((np.abs(stages[:, :, None] - times).min(axis=2) / h[:, None]).min())


def error_at_ten(solution: srm.Solution, exact: dict[str, Any]) -> float:
    """Largest error of angle and rate of the crank at t = 10."""
    end = [float(x) for x in exact["slidercrank"]["theta1,omega1"]["10"]]
    return float(np.abs([solution.q[-1, 0] - end[0], solution.v[-1, 0] - end[1]]).max())


@pytest.mark.parametrize("placement", ["automatic", "halved", "off"])
@pytest.mark.parametrize("tableau", ["tvd32", "dopr54", "dop853"])
def test_no_stage_comes_near_a_given_time(
    slider_crank: srm.Mechanism, tableau: str, placement: str
) -> None:
    rtol = 1e-5 if tableau == "tvd32" else 1e-8
    solution = srm.simulate(
        slider_crank, 10.0, tableau=tableau, rtol=rtol, placement=placement, singular_times=PASSAGES
    )
    assert solution.success
    assert clearance(solution.steps.times, solution.scheme, PASSAGES) >= CLEAR
    assert off_branch(solution.q) < 1e-9
    assert solution.stats.zone_steps == 0


def test_given_times_alone_take_a_run_through_singular_configurations_exactly(
    slider_crank: srm.Mechanism, exact: dict[str, Any]
) -> None:
    """At them the mechanism may be anything: no sigma is looked at."""
    solution = srm.simulate(slider_crank, 10.0, rtol=1e-9, placement="off", singular_times=PASSAGES)
    assert error_at_ten(solution, exact) < 1e-8
    assert solution.settings.singular_times == tuple(PASSAGES)
    assert solution.settings.placement == "off"


@pytest.mark.parametrize("tableau", ["fe", "trap", "heun", "tvd32", "erk4", "dopr54", "dop853"])
def test_fixed_steps_are_split_at_given_times_and_return_to_the_grid(tableau: str) -> None:
    mechanism = load("four_bar")
    times = np.array([0.1, 0.125, 0.2033, 0.35, 0.475])
    solution = srm.simulate(
        mechanism, 0.5, tableau=tableau, step=0.05, singular_times=times, placement="off"
    )
    grid = 0.05 * np.arange(11)
    apart = np.abs(solution.t[:, None] - grid).min(axis=0)
    on_it = np.isin(grid.round(9), [0.1, 0.35])  # these grid points are themselves to be avoided
    assert apart[~on_it].max() < 1e-12
    assert (apart[on_it] > 1e-4).all()
    assert clearance(solution.t, solution.scheme, times) >= CLEAR
    assert solution.stats.placements > 0
    assert solution.stats.replaced == 0


def test_times_on_an_open_chain_are_avoided_as_well() -> None:
    """A force that jumps at known times is no singular configuration, but wants the same."""
    times = np.array([0.3, 0.6])
    solution = srm.simulate(load("pendulum_chain"), 1.0, singular_times=times)
    assert clearance(solution.t, solution.scheme, times) >= CLEAR


@pytest.mark.parametrize("tableau", ["trap", "tvd32", "erk4", "dopr54", "dop853"])
def test_any_times_are_avoided_with_few_steps(tableau: str) -> None:
    """Random times, in clusters down to round-off, on a grid of steps; no mechanism involved."""
    rng = np.random.default_rng(0)
    scheme = srm.TABLEAUS[tableau]
    done: Any = SimpleNamespace(state=np.zeros(1))
    memory = IntegratorState(np.zeros(1), 1.0, np.zeros(1))
    for _ in range(200):
        middle = rng.uniform(0.5, 9.5, 3)
        spread = 10.0 ** rng.uniform(-16, 0, 3)
        times = np.concatenate([middle, middle + 0.1 * spread])
        times = np.append(times, 0.5 * rng.integers(1, 20, 2))
        control = AvoidTimes(FixedStep(0.0, 10.0, 0.5), scheme, times, 10.0, 0.5)
        t = [0.0]
        while t[-1] < 10.0:
            proposal = control.propose(t[-1], np.inf, memory)
            assert t[-1] < proposal.t_new <= 10.0
            assert proposal.h <= 0.5 * (1 + 1e-9)
            control.decide(proposal, done)
            t.append(proposal.t_new)
            assert len(t) < 400
        nodes = np.array(t)
        assert clearance(nodes, scheme, times) >= CLEAR
        # where a step ends, the next one still has room to pass the time
        ahead = times[:, None] - nodes[1:]
        steps = np.broadcast_to(np.diff(nodes), ahead.shape)
        assert (ahead[ahead > 0.0] >= CLEARANCE_AHEAD * steps[ahead > 0.0] * (1 - 1e-9)).all()


@pytest.mark.parametrize(
    ("tableau", "fraction"),
    [("trap", 0.5), ("erk4", 0.25), ("dopr54", 0.25), ("dop853", 0.25)],
)
def test_a_step_that_ends_on_a_singular_point_is_halved_as_in_the_thesis(
    slider_crank: srm.Mechanism, tableau: str, fraction: float
) -> None:
    """h/2 (h/4 with inner stages), then h over the point, then back to the grid."""
    h = PERIOD / 4.0 / 400.0
    solution = srm.simulate(slider_crank, 410 * h, tableau=tableau, step=h, placement="halved")
    assert solution.success
    last = 399 * h
    (replaced,) = solution.replaced
    assert replaced == pytest.approx([last, h], rel=1e-9)
    around = solution.t[399:403] - last
    assert around == pytest.approx(h * np.array([0.0, fraction, 1.0 + fraction, 2.0]), abs=1e-9)
    assert solution.t[403:] == pytest.approx(h * np.arange(402, 411), rel=1e-12)
    assert (solution.stats.placements, solution.stats.replaced) == (0, 1)
    assert len(solution.rejected) == 0
    assert off_branch(solution.q) < 1e-6


def test_the_halved_step_is_as_exact_as_the_automatic_placement(
    slider_crank: srm.Mechanism, exact: dict[str, Any]
) -> None:
    """The grid meets the passages at its points; without placement the zone has to do it."""
    step = PERIOD / 4.0 / 40.0
    errors = {}
    for placement in ("automatic", "halved"):
        solution = srm.simulate(
            slider_crank, 10.0, step=step, tableau="dopr54", placement=placement
        )
        assert solution.stats.placements + solution.stats.replaced >= 4
        errors[placement] = error_at_ten(solution, exact)
    assert errors["halved"] < 2.0 * errors["automatic"] < 1e-6


def test_a_run_that_ends_on_a_singular_point_does_not_halve_for_ever(
    slider_crank: srm.Mechanism,
) -> None:
    solution = srm.simulate(
        slider_crank, PERIOD / 4.0, step=PERIOD / 400.0, tableau="erk4", placement="halved"
    )
    assert solution.success
    assert solution.stats.replaced == 0
    assert solution.stats.steps == 100


@pytest.mark.parametrize("tableau", ["dopr54", "dop853"])
def test_the_halved_step_works_with_step_size_control(
    slider_crank: srm.Mechanism, tableau: str
) -> None:
    """A first step that ends on the passage, and one that does so later."""
    start = srm.simulate(slider_crank, PERIOD / 4.0 - 0.05, rtol=1e-10)
    solution = srm.simulate(
        slider_crank,
        1.0,
        q0=start.q[-1],
        v0=start.v[-1],
        tableau=tableau,
        first_step=0.05,
        placement="halved",
    )
    assert solution.success
    assert solution.t[1:3] == pytest.approx([0.0125, 0.0625], rel=1e-4)
    assert solution.replaced == pytest.approx(np.array([[0.0, 0.05]]))
    assert off_branch(solution.q) < 1e-8


def test_no_placement_leaves_fixed_steps_alone(slider_crank: srm.Mechanism) -> None:
    solution = srm.simulate(slider_crank, 2.0, step=0.05, tableau="dopr54", placement="off")
    assert solution.t == pytest.approx(0.05 * np.arange(41))
    assert (solution.stats.placements, solution.stats.replaced) == (0, 0)


def test_times_outside_the_run_are_ignored_and_equal_ones_count_once() -> None:
    mechanism = load("four_bar")
    given = srm.simulate(mechanism, 1.0, singular_times=(-3.0, 0.5, 0.5, 7.0))
    assert given.settings.singular_times == (0.5,)
    plain = srm.simulate(mechanism, 1.0)
    outside = srm.simulate(mechanism, 1.0, singular_times=[7.0])
    assert np.array_equal(outside.t, plain.t)


REFUSED: dict[str, dict[str, Any]] = {
    "at the start": {"singular_times": [0.0, 0.5]},
    "at the end": {"singular_times": [1.0]},
    "almost at the end": {"singular_times": [1.0 - 1e-12]},
    "no sequence": {"singular_times": 0.5},
    "a matrix": {"singular_times": [[0.5]]},
    "no number": {"singular_times": [np.nan]},
    "a word": {"singular_times": ["noon"]},
    "at a breakpoint": {"breakpoints": [0.5], "singular_times": [0.5]},
    "unknown placement": {"placement": "manual"},
    "no placement": {"placement": None},
}


def test_bad_options_are_refused_before_any_stepping() -> None:
    run = partial(srm.simulate, load("four_bar"), 1.0)
    check_refusals("placement", {case: partial(run, **given) for case, given in REFUSED.items()})
