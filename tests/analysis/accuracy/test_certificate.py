"""How accurate a run is, by its certificate, against what it truly is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.analysis.accuracy.assessment import Assessment, assess_errors
from srm_mbs.analysis.accuracy.error_estimate import (
    Comparison,
    Readings,
    compare,
    observed_order,
    parted_at,
)
from tests.support.bundled import load
from tests.support.references import observed, reference


def finding(certificate: srm.Certificate, topic: str) -> Assessment:
    return next(found for found in certificate.findings if found.topic == topic)


def joint(certificate: srm.Certificate, name: str) -> Any:
    return next(row for row in certificate.estimate.joints if row.joint == name)


def true_error(name: str, solution: srm.Solution) -> np.ndarray:
    """Largest true error of the first joint's position and rate at 200 times."""
    t, exact = reference(name, solution.span[1], 200)
    error = np.abs(observed(name, solution, t) - exact)
    nq = solution.mechanism.model.nq
    columns = [0, nq if exact.shape[1] > 2 else 1]
    return error.max(axis=0)[columns]


# --- the estimate --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("slider_crank", {"rtol": 1e-6}),
        ("slider_crank", {"rtol": 1e-5, "tableau": "dopr54"}),
        ("slider_crank_whirl", {"rtol": 1e-8}),
        ("n_four_bar_2", {"rtol": 1e-4}),
        ("spatial_dead_point", {"rtol": 1e-6}),
        ("four_bar", {"rtol": 1e-6}),
        ("four_bar", {"rtol": 1e-5, "tableau": "tvd32"}),
        ("pendulum_chain", {"rtol": 1e-7}),
        ("slider_crank", {"step": 0.02, "tableau": "erk4"}),
        ("four_bar", {"step": 0.005, "tableau": "trap"}),
        ("pendulum_chain", {"step": 0.01, "tableau": "erk4"}),
    ],
)
def test_the_estimated_error_is_the_true_one_within_a_factor_of_two(
    name: str, options: dict[str, Any]
) -> None:
    t_end = 5.0 if name.startswith("slider") else 3.0
    solution = srm.simulate(load(name), t_end, **options)
    certificate = srm.certify(solution)
    row = joint(certificate, solution.mechanism.joint_names[0])
    true = true_error(name, solution)
    assert true.min() > 1e-13
    # The estimate is taken at more times than the true error, which the maxima show.
    np.testing.assert_array_less(true / 2.0, [row.position, row.rate])
    np.testing.assert_array_less([row.position, row.rate], 2.0 * true)


def test_the_estimate_has_the_largest_error_between_the_ends_of_steps() -> None:
    # Evenly spaced times miss it: 3 % of it are then estimated.
    run, exact = (srm.simulate(load("toggle_press"), 3.0, rtol=rtol) for rtol in (1e-4, 1e-11))
    times = run.steps.times
    t = (times[:-1, None] + np.outer(np.diff(times), np.linspace(0.05, 0.95, 19))).ravel()
    largest = compare(run, exact, t, Readings(run)).largest
    assert srm.certify(run).estimate.size == pytest.approx(largest, rel=0.2)


@pytest.mark.parametrize(("tableau", "order"), [("trap", 2), ("erk4", 4)])
def test_at_fixed_steps_the_observed_order_is_that_of_the_scheme(tableau: str, order: int) -> None:
    solution = srm.simulate(load("four_bar"), 1.0, step=0.01, tableau=tableau)
    certificate = srm.certify(solution)
    estimate = certificate.estimate
    assert estimate.order == pytest.approx(order, abs=0.15)
    assert estimate.expected_order == order
    assert [trial.setting for trial in estimate.trials] == [0.01, 0.005, 0.0025]
    assert finding(certificate, "order").grade == "good"


def test_the_order_is_observed_exactly_where_errors_follow_a_power() -> None:
    for settings, order in (([0.1, 0.05, 0.025], 4.0), ([1e-4, 1e-5, 1e-6], 1.0)):
        errors = 3.0 * np.array(settings) ** order
        differences = (errors[:2] - errors[2]).tolist()
        assert observed_order(settings, differences) == pytest.approx(order, rel=1e-12)
    assert observed_order([1e-4, 1e-5, 1e-6], [1e-9, 2e-9]) == 0.0
    assert observed_order([1e-4, 1e-5, 1e-6], [1e-13, 1e-14]) is None


def test_with_step_size_control_errors_fall_with_the_tolerance() -> None:
    solution = srm.simulate(load("four_bar"), 3.0, rtol=1e-5, tableau="tvd32")
    certificate = srm.certify(solution)
    estimate = certificate.estimate
    assert estimate.order == pytest.approx(1.0, abs=0.15)
    np.testing.assert_allclose([t.setting for t in estimate.trials], [1e-5, 1e-6, 1e-7])
    assert finding(certificate, "error over tolerance").grade == "good"


def test_the_second_run_takes_the_tolerance_that_is_given() -> None:
    solution = srm.simulate(load("four_bar"), 1.0, rtol=1e-6, atol=1e-7)
    certificate = srm.certify(solution, rtol=1e-10)
    np.testing.assert_allclose(
        [t.setting for t in certificate.estimate.trials], [1e-6, 1e-8, 1e-10]
    )
    again = srm.simulate(load("four_bar"), 1.0, rtol=1e-10, atol=1e-11)
    assert certificate.estimate.trials[-1].steps == again.stats.steps


def test_a_looser_second_run_gives_a_bound() -> None:
    solution = srm.simulate(load("four_bar"), 1.0, rtol=1e-10)
    certificate = srm.certify(solution, rtol=1e-6)
    assert certificate.estimate.bound
    assert "looser" in finding(certificate, "estimated error").text
    assert joint(certificate, "crank").position > true_error("four_bar", solution)[0]


def test_differences_at_round_off_have_no_order() -> None:
    certificate = srm.certify(srm.simulate(load("four_bar"), 0.5, rtol=1e-12))
    assert certificate.estimate.order is None
    assert certificate.grade == "good"


def falling(differences: tuple[float, ...], order: float | None) -> str:
    """Grade of how the error falls, for a run with these differences to the tightest."""
    run = srm.simulate(load("slider_crank"), 0.5)
    estimate = srm.certify(run).estimate
    trials = [replace(estimate.trials[0], difference=d) for d in (*differences, None)]
    changed = replace(estimate, trials=tuple(trials), order=order, size=differences[0])
    found = assess_errors(run, changed)
    return next(one.grade for one in found if one.topic == "error over tolerance")


def test_differences_that_do_not_fall_are_bad_unless_they_are_rounding() -> None:
    assert falling((3e-2, 3e-2), 0.0) == "poor"
    assert falling((3e-7, 3e-7), 0.0) == "fair"
    assert falling((3e-11, 3e-11), 0.0) == "good"
    assert falling((4e-11, 4e-13), None) == "good"
    assert falling((3e-13, 3e-13), None) == "good"
    assert falling((3e-10,), None) == "unknown"


def test_a_joint_that_does_not_move_has_no_relative_error() -> None:
    mechanism = load("simple_pendulum")
    down = mechanism.with_state([-np.pi / 2], [0.0])
    row = joint(srm.certify(srm.simulate(down, 1.0)), mechanism.joint_names[0])
    assert row.relative_position is None or row.travel < 1e-12


def test_angles_of_continuous_joints_are_compared_with_their_turns() -> None:
    model = pin.Model()
    model.addJoint(0, pin.JointModelRUBZ(), pin.SE3.Identity(), "wheel")
    model.appendBodyToJoint(1, pin.Inertia.FromSphere(1.0, 0.1), pin.SE3.Identity())
    runs = [
        srm.simulate(srm.Mechanism(model, q0=[1.0, 0.0], v0=[rate]), 5.0) for rate in (10.0, 12.0)
    ]
    found = compare(*runs, np.linspace(0.0, 5.0, 11), Readings(runs[0]))
    (row,) = found.comparison().joints
    assert (row.unit, row.position, row.travel) == ("rad", pytest.approx(10.0), pytest.approx(50.0))


# --- honesty -------------------------------------------------------------------------------------


def test_a_chaotic_motion_is_distinguished_from_an_accurate_one() -> None:
    certificate = srm.certify(srm.simulate(load("pendulum_chain"), 15.0))
    found = finding(certificate, "estimated error")
    assert certificate.estimate.branch is None
    apart = certificate.estimate.apart
    assert f"From t = {apart:.4g} s on" in found.text
    assert finding(certificate, "sensitivity").grade == "fair"
    # What is said of the joints is about the time before.
    assert max(row.position for row in certificate.estimate.joints) < 0.05


@pytest.mark.parametrize("kind", ["branch", "chaos", "elsewhere"])
def test_only_rates_that_differ_at_once_at_a_passage_are_another_branch(kind: str) -> None:
    run = srm.simulate(load("slider_crank"), 6.0)
    first, second = run.crossings[0].time, run.crossings[1].time
    t = np.linspace(0.0, 6.0, 1201)
    rates = np.where(t < (first if kind == "branch" else 0.5 * (first + second)), 1e-8, 1.0)
    if kind == "chaos":
        rates = 1e-8 * np.exp(5.0 * t)
    comparison = Comparison(t, np.column_stack([rates * t, rates]), (), np.zeros(0))
    expected = first if kind == "branch" else None
    assert parted_at(comparison, run, run) == expected


def test_a_second_run_on_another_branch_is_named() -> None:
    run = srm.simulate(load("slider_crank"), 6.0)
    estimate = srm.certify(run).estimate
    assert estimate.branch is None
    (found, *_) = assess_errors(run, replace(estimate, apart=1.3, branch=1.25))
    assert found.grade == "poor"
    assert "at t = 1.25 s on different branches" in found.text


def test_a_run_that_failed_is_judged_up_to_where_it_came() -> None:
    def breaks(t: float, q: Any, v: Any) -> list[float]:
        if t > 1.0:
            raise ValueError("it broke")
        return [0.0, 0.0, 0.0]

    solution = srm.simulate(load("four_bar"), 3.0, controller=breaks)
    assert not solution.success
    certificate = srm.certify(solution)
    assert certificate.grade == "poor"
    assert "failed at t = 0.9" in finding(certificate, "end of the run").text
    assert "stopped as well" in finding(certificate, "second run").text
    assert joint(certificate, "crank").position < 1e-6


def test_a_failure_that_a_tighter_run_does_not_have_is_one_of_the_setting() -> None:
    calls = []

    def breaks_once(t: float, q: Any, v: Any) -> list[float]:
        calls.append(t)
        if len(calls) == 100:
            raise ValueError("once")
        return [0.0, 0.0, 0.0]

    solution = srm.simulate(load("four_bar"), 1.0, controller=breaks_once)
    certificate = srm.certify(solution)
    assert "went on where this one failed" in finding(certificate, "second run").text


def test_a_run_that_failed_at_its_start_has_a_certificate() -> None:
    def broken(t: float, q: Any, v: Any) -> list[float]:
        if t > 0.0:
            raise ValueError("never")
        return [0.0] * 3

    solution = srm.simulate(load("four_bar"), 1.0, controller=broken)
    certificate = srm.certify(solution)
    assert certificate.estimate is None
    assert "no step" in finding(certificate, "estimated error").text


def test_sweeps_with_a_fixed_eps_are_said_to_share_its_error() -> None:
    method = srm.SRM("erk4", iterations=2, eps=0.01)
    solution = srm.simulate(load("slider_crank_regular"), 0.1, method=method, step=0.01)
    assert "eps = 0.01 s" in finding(srm.certify(solution), "regularisation").text


# --- runs of all kinds ---------------------------------------------------------------------------


def test_drift_and_energy_are_those_of_the_run() -> None:
    solution = srm.simulate(load("bricard"), 2.0)
    certificate = srm.certify(solution, again=False)
    assert [row.unit for row in certificate.drift] == ["m", "rad"]
    whole = np.hypot(*(row.position for row in certificate.drift))
    assert whole == pytest.approx(solution.drift[:, 0].max(), rel=0.5)
    assert certificate.energy.relative == solution.energy_balance.relative
    assert certificate.estimate is None
    assert certificate.grade == "unknown"


def hanging_four_bar(rate: float = 0.0) -> srm.Mechanism:
    """The four-bar in its equilibrium, with a rate of its crank (rad/s)."""
    mechanism = load("four_bar")
    state = srm.assemble(mechanism, srm.equilibrium(mechanism).q, v={"crank": rate})
    return mechanism.with_state(state.q, state.v)


def held_four_bar() -> srm.Mechanism:
    """The four-bar, held by a drive that does not move."""
    mechanism = load("four_bar")
    still = replace(mechanism, drives=(srm.Drive(srm.ConstantSpeed(0.0), "crank"),))
    return still.with_state(still.q0, np.zeros(3))


@pytest.mark.parametrize("mechanism", [hanging_four_bar(), held_four_bar()])
def test_the_energy_balance_of_a_mechanism_at_rest_is_not_judged_by_its_rounding(
    mechanism: srm.Mechanism,
) -> None:
    solution = srm.simulate(mechanism, 1.0)
    balance = solution.energy_balance
    # Rounding is all there is, in the residual or in what took part.
    assert 0.0 < balance.kinetic.max() < balance.rounding
    assert balance.relative == 0.0
    found = finding(srm.certify(solution, again=False), "energy balance")
    assert (found.grade, found.text) == ("good", "Nothing moved, and no energy was exchanged.")


def test_the_energy_balance_of_a_tiny_motion_is_good_down_to_the_rounding_of_its_energies() -> None:
    solution = srm.simulate(hanging_four_bar(1e-5), 1.0, rtol=1e-10)
    assert 1e-6 < solution.energy_balance.relative < 1e-2
    found = finding(srm.certify(solution, again=False), "energy balance")
    assert found.grade == "good"
    assert found.text.endswith("That is rounding of the energies.")


@pytest.mark.parametrize("t_eval", [[], [0.0]])
def test_the_energy_is_judged_over_the_whole_run_whatever_times_are_asked_for(
    t_eval: list[float],
) -> None:
    mechanism = load("four_bar")
    runs = (srm.simulate(mechanism, 0.5, t_eval=times) for times in (None, t_eval))
    whole, found = (srm.certify(run, again=False).energy for run in runs)
    assert whole.residual > 0.0
    assert found.residual == pytest.approx(whole.residual, rel=1e-6)
    assert found.scale == pytest.approx(whole.scale)


def test_an_open_chain_has_no_drift() -> None:
    certificate = srm.certify(srm.simulate(load("pendulum_chain"), 0.5))
    assert certificate.drift == ()
    assert finding(certificate, "closed loops").grade == "good"


def test_a_driven_mechanism_keeps_its_drives_as_well() -> None:
    mechanism = replace(
        load("slider_crank_regular"),
        drives=[srm.Drive(srm.ConstantSpeed(speed=6.0), joint="crank")],
    )
    start = srm.assemble(mechanism)
    solution = srm.simulate(mechanism, 1.0, q0=start.q, v0=start.v)
    certificate = srm.certify(solution)
    assert {row.unit for row in certificate.drift} == {"m", "rad"}
    assert certificate.grade == "good"
    assert joint(certificate, "crank").position < 1e-12


def test_jumps_of_runs_with_event_actions_are_left_out_of_the_comparison() -> None:
    def down(t: float, q: Any, v: Any) -> float:
        return float(np.cos(q[0]))

    event = srm.Event(down, action=lambda t, q, v: (q, 0.8 * v))
    solution = srm.simulate(load("simple_pendulum"), 4.0, events=[event])
    assert len(solution.segments) > 2
    certificate = srm.certify(solution)
    assert finding(certificate, "estimated error").grade == "good"
    jumps = certificate.estimate.comparison.jumps
    assert len(jumps) == len(solution.segments) - 1
    assert jumps.max() < 1e-5
    # A jump of 20 % at times that differ would be seen.
    assert joint(certificate, solution.mechanism.joint_names[0]).rate < 1e-4


# --- runs from disk ------------------------------------------------------------------------------


def loaded(solution: srm.Solution, folder: Path) -> srm.Solution:
    solution.save(folder / "run.npz")
    return srm.load_solution(folder / "run.npz")


@pytest.mark.parametrize(
    "options",
    [
        {"rtol": 1e-7, "tableau": "dopr54", "max_step": 0.02},
        {"method": srm.SRM("erk4", iterations=2, eps="2h"), "step": 0.02},
        {"events": [lambda t, q, v: float(np.cos(q[0]))], "breakpoints": [0.11]},
    ],
)
def test_a_run_from_disk_is_made_again_as_it_was(tmp_path: Path, options: dict[str, Any]) -> None:
    solution = srm.simulate(load("slider_crank_regular"), 0.2, **options)
    here, there = srm.certify(solution), srm.certify(loaded(solution, tmp_path))
    of_here, of_there = ([t.steps for t in c.estimate.trials] for c in (here, there))
    assert of_here == of_there
    assert there.error == here.error


def test_a_run_that_an_event_ended_is_made_again_up_to_there(tmp_path: Path) -> None:
    def upright(t: float, q: Any, v: Any) -> float:
        return float(np.cos(q[0]))

    upright.terminal = True
    solution = srm.simulate(load("slider_crank"), 5.0, events=upright)
    assert solution.status == "event"
    certificate = srm.certify(loaded(solution, tmp_path))
    assert finding(certificate, "end of the run").grade == "good"
    assert finding(certificate, "estimated error").grade == "good"
    assert certificate.estimate.trials[-1].end == solution.span[1]


def test_functions_that_a_saved_run_has_lost_are_named(tmp_path: Path) -> None:
    force = srm.UserForce(lambda t, q, v: -0.1 * v, name="brake")
    mechanism = replace(load("four_bar"), forces=[force])
    solution = srm.simulate(mechanism, 0.5)
    assert srm.certify(solution).estimate is not None
    certificate = srm.certify(loaded(solution, tmp_path))
    assert certificate.estimate is None
    assert "the function of the force 'brake'" in finding(certificate, "estimated error").text
    assert finding(certificate, "energy balance").grade == "unknown"
    assert finding(certificate, "closed loops").grade == "good"


def test_event_actions_that_a_saved_run_has_lost_are_named(tmp_path: Path) -> None:
    event = srm.Event(lambda t, q, v: float(np.cos(q[0])), action=lambda t, q, v: (q, 0.8 * v))
    solution = srm.simulate(load("simple_pendulum"), 2.0, events=[event])
    certificate = srm.certify(loaded(solution, tmp_path))
    assert "the actions of events" in finding(certificate, "estimated error").text
    assert finding(certificate, "energy balance").grade == "good"


# --- what is printed -----------------------------------------------------------------------------


def test_a_certificate_reads_as_sentences() -> None:
    certificate = srm.certify(srm.simulate(load("four_bar"), 0.5))
    text = str(certificate)
    assert text.startswith("Accuracy of the run of four_bar\n")
    for found in certificate.findings:
        assert f"{found.topic} ({found.grade}): {found.text}" in text
        assert found.text.endswith(".")
    assert "grade='good'" in repr(certificate)
    assert certificate.estimate is not None
    shown = repr(certificate.estimate)
    assert f"size={certificate.estimate.size!r}" in shown
    assert "array(" not in shown
