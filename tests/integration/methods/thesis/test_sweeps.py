"""SRM and the forms of PSRM with sweeps: orders beside theory, singular passages, tolerances.

The split form has its own tests (``test_orders.py``, ``test_singular_passages.py``).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from tests.support import slider_crank
from tests.support.bundled import load
from tests.support.convergence import fitted_order, observed_order, turning
from tests.support.references import error_across
from tests.support.snapshots import check_refusals

COARSE = (2e-2, 1e-2, 5e-3)
FINE = (1e-2, 5e-3, 2.5e-3)
RESTARTED = {"restart": True, "carry": True}


@pytest.mark.parametrize(
    ("method", "steps", "theory", "tolerance"),
    [
        # eps = h: min(m, p), as far as stage order and linear interpolation (order 2) allow
        pytest.param(srm.SRM("fe", 1), COARSE, 1.0, 0.1, marks=pytest.mark.stress),
        pytest.param(srm.SRM("trap", 2), FINE, 2.0, 0.1, marks=pytest.mark.stress),
        (srm.SRM("tvd32", 2), COARSE, 2.0, 0.1),
        (srm.SRM("erk4", 4), COARSE, 2.0, 0.1),
        pytest.param(srm.SRM("dopr54", 5), COARSE, 3.0, 0.15, marks=pytest.mark.stress),
        (srm.SRM("erk4", 3, **RESTARTED), COARSE, 2.0, 0.1),
        pytest.param(srm.SRM("tvd32", 3, restart=True), COARSE, 1.0, 0.1, marks=pytest.mark.stress),
        (srm.PSRM("erk4", "simple"), FINE, 2.0, 0.1),
        pytest.param(srm.PSRM("trap", "simple"), FINE, 2.0, 0.1, marks=pytest.mark.stress),
        pytest.param(
            srm.PSRM("trap", "simple", eps=0.1),
            (5e-3, 2.5e-3, 1.25e-3),
            1.0,
            0.15,
            marks=pytest.mark.stress,
        ),
        (srm.PSRM("erk4", correction="sweep", interpolation="linear"), FINE, 8 / 3, 0.25),
        (srm.PSRM("dopr54", correction="sweep"), COARSE, 13 / 3, 0.25),
        pytest.param(
            srm.PSRM("tvd32", correction="sweep", eps=0.1),
            COARSE,
            3.0,
            0.15,
            marks=pytest.mark.stress,
        ),
        pytest.param(
            srm.PSRM("erk4", correction="sweep", eps=0.1),
            COARSE,
            4.0,
            0.2,
            marks=pytest.mark.stress,
        ),
        (srm.PSRM("erk4", correction="fused", eps=0.1), COARSE, 4.0, 0.2),
        (srm.PSRM("dopr54", correction="fused", eps=0.1), COARSE, 5.0, 0.25),
    ],
    ids=str,
)
def test_observed_orders_on_a_mechanism(
    method: Any, steps: tuple[float, ...], theory: float, tolerance: float
) -> None:
    order = observed_order(turning("slider_crank_regular", 2.0), method, steps)
    assert order == pytest.approx(theory, abs=tolerance)


def runs_within(
    method: Any, t_end: float, tolerances: dict[float, float], passages: int | None = None
) -> list[srm.Solution]:
    """Runs of slider_crank whose errors are within the bound of each tolerance; the number of
    their ``passages``, where it is given, is checked as well."""
    runs = []
    for tol, bound in tolerances.items():
        run = srm.simulate(load("slider_crank"), t_end, method=method, rtol=tol, atol=tol)
        assert slider_crank.error(run) < bound
        assert passages is None or len(run.crossings) == passages
        runs.append(run)
    return runs


@pytest.mark.parametrize(
    ("method", "bounds"),
    [
        pytest.param(srm.PSRM("tvd32", correction="sweep"), (1e-4, 1e-6), marks=pytest.mark.stress),
        (srm.PSRM("dopr54", correction="sweep"), (1e-5, 1e-7)),
        (srm.PSRM("dop853", correction="sweep"), (1e-6, 1e-7)),
        pytest.param(srm.PSRM("tvd32", correction="fused"), (1e-4, 1e-6), marks=pytest.mark.stress),
        pytest.param(
            srm.PSRM("dopr54", correction="fused"), (1e-5, 1e-7), marks=pytest.mark.stress
        ),
        (srm.PSRM("dop853", correction="fused"), (1e-6, 1e-7)),
    ],
    ids=str,
)
def test_exact_sweeps_pass_singular_configurations_and_follow_the_tolerance(
    method: srm.PSRM, bounds: tuple[float, float]
) -> None:
    runs_within(method, 5.0, dict(zip((1e-5, 1e-7), bounds)), passages=2)


@pytest.mark.parametrize("method", [srm.SRM("tvd32", 3), srm.SRM("tvd32", 3, **RESTARTED)], ids=str)
def test_srm_passes_singular_configurations_with_the_step_of_the_thesis(method: srm.SRM) -> None:
    solution = srm.simulate(load("slider_crank"), 2.0, method=method, step=5e-3)
    assert slider_crank.error(solution) < 1e-3
    assert slider_crank.off_branch(solution.q) < 1e-3
    assert solution.drift[:, 0].max() < 1e-4


@pytest.mark.parametrize(
    ("method", "bounds"),
    [
        (srm.SRM("tvd32", 3, **RESTARTED), (1e-4, 1e-5)),
        pytest.param(srm.PSRM("tvd32", "simple"), (1e-4, 1e-5), marks=pytest.mark.stress),
        pytest.param(srm.SRM("tvd32", 3, eps=0.003), (2e-4, 2e-5), marks=pytest.mark.stress),
        (srm.PSRM("tvd32", correction="sweep", interpolation="auto"), (3e-4, 3e-5)),
    ],
    ids=str,
)
def test_adaptive_sweeps_pass_a_singular_configuration_and_follow_the_tolerance(
    method: Any, bounds: tuple[float, float]
) -> None:
    """The steps do not become short there."""
    for solution in runs_within(method, 1.6, dict(zip((1e-4, 1e-5), bounds)), passages=1):
        assert solution.stats.rejected < 0.2 * solution.stats.steps


@pytest.mark.stress
@pytest.mark.parametrize(
    ("method", "bounds"),
    [
        (srm.SRM("tvd32", 3, **RESTARTED), (2e-3, 1e-4)),
        (srm.PSRM("tvd32", "simple"), (3e-4, 3e-5)),
        (srm.PSRM("tvd32", correction="sweep"), (2e-2, 2e-3)),
        (srm.PSRM("tvd32", correction="sweep", interpolation="auto"), (1e-2, 1e-3)),
        (srm.PSRM("dopr54", correction="sweep"), (2e-3, 2e-4)),
        (srm.PSRM("dop853", correction="fused"), (1e-4, 5e-6)),
        (srm.SRM("tvd32", 3, eps=0.003), (1e-3, 2e-4)),
    ],
    ids=str,
)
def test_adaptive_sweeps_meet_no_impasse_where_the_thesis_control_does(
    method: Any, bounds: tuple[float, float]
) -> None:
    """The thesis' estimate compares two sweeps' trajectories and stalls near t = 34.5."""
    for solution, bound in zip(runs_within(method, 40.0, dict(zip((1e-4, 1e-5), bounds))), bounds):
        assert slider_crank.off_branch(solution.q) < bound


@pytest.mark.parametrize(
    ("method", "steps", "order"),
    [
        (srm.PSRM("dopr54", correction="fused", eps=0.1), (0.02, 0.01, 0.005), 5.0),
        pytest.param(
            srm.PSRM("dopr54", correction="sweep", eps=0.1),
            (0.02, 0.01, 0.005),
            5.0,
            marks=pytest.mark.stress,
        ),
        (srm.SRM("tvd32", 3, **RESTARTED), (0.04, 0.02, 0.01), 2.0),
    ],
    ids=str,
)
def test_orders_hold_through_spatial_dead_points(
    method: Any, steps: tuple[float, ...], order: float
) -> None:
    """Curved branches: a stage evaluated off them would see a null space turned by its error over
    its distance, which does not fall with the step."""
    mechanism = load("spatial_dead_point")
    reference = srm.simulate(mechanism, 1.5, rtol=1e-12, atol=1e-12)
    assert len(reference.crossings) == 2
    errors = []
    for h in steps:
        solution = srm.simulate(mechanism, 1.5, method=method, step=h)
        errors.append(np.abs(solution.q[-1] - reference.q[-1]).max())
    assert fitted_order(steps, errors) > order - 0.3


@pytest.mark.stress
def test_a_mechanism_that_turns_in_many_short_steps_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Stages evaluated where they are, and constraint errors that pile up uncounted: sweeps off
    the closures turn at the passage."""
    monkeypatch.setattr("srm_mbs.integration.methods.near_singular.NEAR_STEPS", 0.0)
    monkeypatch.setattr("srm_mbs.integration.methods.thesis.sweep.NEAR_STEPS", 0.0)
    monkeypatch.setattr("srm_mbs.integration.methods.thesis.iterated_sweeps.SETTLING_RATIO", 0.0)
    monkeypatch.setattr(
        "srm_mbs.integration.methods.thesis.iterated_sweeps.may_be_taken_over", lambda *_: False
    )
    method = srm.PSRM("dopr54", correction="sweep", interpolation="linear")
    solution = srm.simulate(load("slider_crank"), 1.5, method=method, rtol=1e-4, atol=1e-4)
    assert slider_crank.off_branch(solution.q) > 0.1
    assert "the velocity turned" in solution.message


LINEAR = srm.PSRM("dopr54", correction="sweep", interpolation="linear")


@pytest.mark.parametrize("tol", [1e-4, pytest.param(1e-5, marks=pytest.mark.stress)])
def test_constraint_errors_of_restarted_sweeps_stay_near_the_tolerance(tol: float) -> None:
    """They last for about eps, many steps: what a step adds says little about what is left.  The
    estimate counts them as they settle."""
    solution = srm.simulate(load("slider_crank_regular"), 3.0, method=LINEAR, rtol=tol, atol=tol)
    assert solution.success
    assert solution.drift[:, 1].max() < 12.0 * tol


@pytest.mark.stress
@pytest.mark.parametrize(("tol", "error"), [(1e-4, 0.05), (1e-5, 0.01)])
def test_two_sweeps_with_linear_interpolation_pass_singular_configurations(
    tol: float, error: float
) -> None:
    """To t = 70, 33 of them, with steps that do not become short."""
    solution = srm.simulate(load("slider_crank"), 70.0, method=LINEAR, rtol=tol)
    reference = srm.simulate(load("slider_crank"), 70.0, rtol=1e-11)
    assert solution.success
    assert "turned" not in solution.message
    assert len(solution.crossings) == len(reference.crossings)
    assert np.abs(solution.q[-1] - reference.q[-1]).max() < error
    assert slider_crank.off_branch(solution.q) < 10.0 * tol
    assert np.diff(solution.steps.times).min() > 1e-3


def test_a_run_says_how_far_sweeps_with_own_histories_are_off_the_closures() -> None:
    """A floor of order eps^m: no step mends it, so the run goes on and says so."""
    four_bar = load("four_bar")
    own = srm.simulate(four_bar, 1.0, method=srm.SRM("tvd32", 3, eps=0.01), rtol=1e-4, atol=1e-4)
    assert own.success
    assert "off the constraints by up to" in own.message
    restarted = srm.simulate(four_bar, 1.0, method="srm", rtol=1e-4, atol=1e-4)
    assert "off the constraints" not in restarted.message
    fixed = srm.simulate(four_bar, 0.1, method=srm.SRM("tvd32", 3, eps=0.01), step=5e-3)
    assert "off the constraints" not in fixed.message


@pytest.mark.parametrize(
    "method",
    [
        "srm",
        pytest.param(srm.PSRM("dopr54", "simple"), marks=pytest.mark.stress),
        pytest.param(srm.SRM("dopr54", 3, **RESTARTED), marks=pytest.mark.stress),
        srm.PSRM("tvd32", "simple"),
    ],
    ids=str,
)
def test_errors_of_adaptive_sweeps_fall_with_the_tolerance(method: Any) -> None:
    mechanism = turning("slider_crank_regular", 2.0)
    reference = srm.simulate(mechanism, 1.0, rtol=1e-12, atol=1e-12)
    errors = []
    for tol in (1e-4, 1e-5, 1e-6):
        solution = srm.simulate(mechanism, 1.0, method=method, rtol=tol, atol=tol)
        assert solution.success, solution.message
        errors.append(np.abs(solution.v[-1] - reference.v[-1]).max())
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.5 * errors[1]
    assert errors[0] < 2e-3


def test_the_error_estimate_vanishes_with_the_step() -> None:
    """No impasse: neither the gap between sweeps nor eps = h leaves a floor."""
    mechanism = turning("slider_crank_regular", 2.0)
    solution = srm.simulate(
        mechanism, 0.5, method=srm.SRM("tvd32", 3, **RESTARTED), rtol=1e-5, atol=1e-5
    )
    small = np.diff(solution.steps.times) < 0.2 * np.diff(solution.steps.times).max()
    assert solution.success
    assert solution.steps.error_ratios.max() <= 1.0
    assert not small.any() or solution.steps.error_ratios[small].max() < 1.0
    assert solution.stats.rejected < solution.stats.steps


@pytest.mark.parametrize("form", ["sweep", "fused"])
@pytest.mark.parametrize(("tableau", "order"), [("erk4", 4.0), ("dopr54", 5.0)])
def test_dense_output_of_sweeps_has_the_order_of_the_steps(
    form: str, tableau: str, order: float
) -> None:
    mechanism = turning("slider_crank_regular", 2.0)
    method = srm.PSRM(tableau, correction=form, eps=0.2)
    between = np.linspace(0.0, 1.0, 83)
    reference = srm.simulate(mechanism, 1.0, rtol=1e-12, atol=1e-12, t_eval=between)
    errors = []
    for step in (0.01, 0.005):
        solution = srm.simulate(mechanism, 1.0, method=method, step=step)
        errors.append(np.abs(solution(between)[1] - reference.v).max())
    assert np.log2(errors[0] / errors[1]) > order - 0.4


def test_sweeps_evaluate_the_extra_stages_of_dense_output_in_the_step() -> None:
    method = srm.PSRM("dop853", correction="fused")
    mechanism = turning("slider_crank_regular", 2.0)
    solution = srm.simulate(mechanism, 1.0, method=method, rtol=1e-8, atol=1e-8)
    reference = srm.simulate(mechanism, 1.0, rtol=1e-12, atol=1e-12)
    spent = solution._system.evaluations
    t = np.linspace(0.0, 1.0, 41)
    assert np.abs(solution(t)[1] - reference(t)[1]).max() < 1e-6
    assert solution._system.evaluations == spent


def test_a_run_with_sweeps_is_saved_with_its_dense_output(tmp_path: Any) -> None:
    method = srm.PSRM("dop853", correction="fused")
    solution = srm.simulate(load("four_bar"), 0.3, method=method)
    solution.save(tmp_path / "run.npz")
    again = srm.load_solution(tmp_path / "run.npz")
    assert np.array_equal(again(0.123)[0], solution(0.123)[0])


def test_beyond_the_stability_limit_the_run_ends_and_says_so() -> None:
    method = srm.SRM("tvd32", 3, eps=1e-3)
    solution = srm.simulate(turning("slider_crank_regular", 2.0), 1.0, method=method, step=1e-2)
    assert not solution.success
    assert "h/eps = 10 is beyond 2.51" in solution.message
    assert 1 <= len(solution.t) < 100


REFUSED: dict[str, dict[str, Any]] = {
    "unknown tableau": {"tableau": "nonsense"},
    "no sweeps": {"iterations": 0},
    "number of sweeps as a float": {"iterations": 2.0},
    "number of sweeps as a bool": {"iterations": True},
    "eps as a word": {"eps": "fast"},
    "carry without restart": {"carry": True},
    "restart as a word": {"restart": "yes"},
    "carry with many sweeps": {"restart": True, "carry": True, "iterations": 4},
    "unknown T": {"T": "both"},
    "interpolation of PSRM": {"interpolation": "stages"},
}


def test_srm_refuses_what_makes_no_sense() -> None:
    check_refusals("srm", {case: partial(srm.SRM, **given) for case, given in REFUSED.items()})


def test_open_chains_run_with_any_method() -> None:
    chain = load("pendulum_chain")
    reference = srm.simulate(chain, 0.5, rtol=1e-9)
    for method in (srm.SRM("erk4"), srm.PSRM("erk4", correction="sweep")):
        solution = srm.simulate(chain, 0.5, method=method, step=5e-3)
        assert np.abs(solution.q[-1] - reference.q[-1]).max() < 1e-6


@pytest.mark.parametrize(
    ("method", "rtol", "bound"),
    [
        ("srm", 1e-8, 5e-9),
        (srm.SRM("dopr54", **RESTARTED), 1e-8, 1e-10),
        (srm.PSRM("tvd32", prediction="simple"), 1e-8, 5e-9),
        (srm.PSRM("tvd32", correction="sweep"), 1e-11, 5e-11),
        (srm.PSRM("tvd32", correction="fused"), 1e-11, 5e-11),
        (srm.SRM("tvd32", eps=1e-4), 1e-8, 5e-9),
    ],
    ids=["SRM", "SRM dopr54", "simple", "exact", "fused", "own histories"],
)
@pytest.mark.parametrize(
    "name", ["slider_crank", pytest.param("n_four_bar_2", marks=pytest.mark.stress)]
)
def test_passages_that_rounding_closes_to_sweeps_are_made_by_the_split_form(
    method: Any, rtol: float, bound: float, name: str
) -> None:
    """The error of sweeps is a power of eps, about a step: their steps are too short to cross."""
    error, solution = error_across(name, 0.03, method=method, rtol=rtol)
    assert error < bound
    assert "are of the split PSRM" in solution.message
