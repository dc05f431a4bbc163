"""Options of ``simulate``, its failures, and what it refuses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.errors import ControllerError
from tests.support.mechanisms import along_x, floating_ring, rod
from tests.support.snapshots import check_messages, refused


@pytest.fixture(scope="module")
def four_bar() -> srm.Mechanism:
    return srm.load("four_bar")


def test_defaults_are_sensible_without_any_option(four_bar: srm.Mechanism) -> None:
    solution = srm.simulate(four_bar, 1.0)
    assert solution.success
    assert solution.status == "finished"
    assert solution.settings.tableau == "auto"
    assert solution.settings.rtol == 1e-6
    assert solution.t[0] == 0.0
    assert solution.t[-1] == 1.0
    assert solution.q.shape == (len(solution.t), 3)
    assert solution.v.shape == (len(solution.t), 3)


def test_t_eval_gives_exactly_those_times_and_does_not_change_the_steps(
    four_bar: srm.Mechanism,
) -> None:
    t = np.array([0.0, 0.1, 0.11, 0.5, 1.0])
    sampled = srm.simulate(four_bar, 1.0, t_eval=t)
    plain = srm.simulate(four_bar, 1.0)
    assert np.array_equal(sampled.t, t)
    assert np.array_equal(sampled.steps.times, plain.steps.times)
    q, v = plain(t)
    assert np.array_equal(sampled.q, q)
    assert np.array_equal(sampled.v, v)


def test_an_initial_state_may_be_given(four_bar: srm.Mechanism) -> None:
    state = srm.assemble(four_bar, {"crank": 2.0}, {"crank": -1.0})
    solution = srm.simulate(four_bar, 0.5, q0=state.q, v0=state.v)
    assert solution.q[0, 0] == 2.0
    assert solution.v[0, 0] == -1.0
    assert four_bar.q0[0] == 1.0, "the mechanism itself is unchanged"


def test_a_controller_acts_as_generalised_force() -> None:
    """A driven pendulum chain against SciPy on aba with the same torque."""
    mechanism = srm.load("pendulum_chain")
    model, data = mechanism.model, mechanism.model.createData()

    def torque(t: float, q: Any, v: Any) -> np.ndarray:
        return np.array([20.0 * np.sin(3.0 * t), -2.0 * v[1], 0.5 * q[2]])

    def field(t: float, x: np.ndarray) -> np.ndarray:
        q, v = x[:3], x[3:]
        return np.concatenate([v, pin.aba(model, data, q, v, torque(t, q, v))])

    start = np.concatenate([mechanism.q0, mechanism.v0])
    theirs = solve_ivp(field, (0, 3), start, method="DOP853", rtol=1e-12, atol=1e-12)
    ours = srm.simulate(mechanism, 3.0, controller=torque, rtol=1e-10)
    assert np.abs(ours.q[-1] - theirs.y[:3, -1]).max() < 1e-8


def test_a_controller_acts_on_a_closed_loop(four_bar: srm.Mechanism) -> None:
    """Power balance: the energy gained is the work of the crank torque."""

    def torque(t: float, q: Any, v: Any) -> np.ndarray:
        return np.array([5.0 * np.cos(t), 0.0, 0.0])

    t = np.linspace(0.0, 2.0, 4001)
    solution = srm.simulate(four_bar, 2.0, controller=torque, rtol=1e-10, t_eval=t)
    power = 5.0 * np.cos(t) * solution.joint("crank")[1]
    work = np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(t))
    assert solution.energy[-1] - solution.energy[0] == pytest.approx(work, rel=1e-5)


def test_joint_damping_takes_energy_out() -> None:
    mechanism = srm.load("four_bar")
    model = mechanism.model.copy()
    model.damping = np.full(3, 0.3)
    mechanism = replace(mechanism, model=model)
    t = np.linspace(0.0, 2.0, 4001)
    solution = srm.simulate(mechanism, 2.0, rtol=1e-10, t_eval=t)
    lost = 0.3 * (solution.v**2).sum(axis=1)
    work = np.sum(0.5 * (lost[1:] + lost[:-1]) * np.diff(t))
    assert solution.energy[0] - solution.energy[-1] == pytest.approx(work, rel=1e-5)


def test_ctrl_c_keeps_the_partial_solution(four_bar: srm.Mechanism) -> None:
    def interrupt(t: float, h: float, state: Any) -> None:
        if t > 0.5:
            raise KeyboardInterrupt

    solution = srm.simulate(four_bar, 10.0, progress=interrupt)
    assert solution.status == "interrupted"
    assert not solution.success
    assert 0.5 < solution.t[-1] < 10.0
    assert "Interrupted at t =" in solution.message
    q, _ = solution(0.25)
    assert np.isfinite(q).all()


def test_a_controller_that_raises_ends_the_run_with_what_was_computed(
    four_bar: srm.Mechanism,
) -> None:
    def failing(t: float, q: Any, v: Any) -> np.ndarray:
        if t > 0.3:
            raise RuntimeError("sensor lost")
        return np.zeros(3)

    solution = srm.simulate(four_bar, 1.0, controller=failing)
    assert solution.status == "failed"
    assert "sensor lost" in solution.message
    assert 0.0 < solution.t[-1] <= 0.3
    with pytest.raises(srm.SimulationError, match="sensor lost") as caught:
        srm.simulate(four_bar, 1.0, controller=failing, raise_on_failure=True)
    assert caught.value.solution.t[-1] == solution.t[-1]


@pytest.mark.parametrize("bad", [np.full(3, np.nan), np.zeros(2), "text"], ids=str)
def test_a_controller_that_returns_nonsense_is_named(four_bar: srm.Mechanism, bad: Any) -> None:
    with pytest.raises(ControllerError, match="the controller r"):
        srm.simulate(four_bar, 1.0, controller=lambda t, q, v: bad)
    good = np.zeros(3)
    solution = srm.simulate(four_bar, 1.0, controller=lambda t, q, v: good if t < 0.2 else bad)
    assert solution.status == "failed"
    assert "controller" in solution.message
    assert isinstance(solution.error, ControllerError)


def test_a_mechanism_that_blows_up_returns_what_was_computed() -> None:
    mechanism = srm.load("pendulum_chain")
    solution = srm.simulate(mechanism, 100.0, tableau="fe", step=0.4)
    assert solution.status == "failed"
    assert "Stopped at t =" in solution.message
    assert np.isfinite(solution.q).all()


def test_a_locked_up_error_estimate_ends_the_run_instead_of_hanging(
    four_bar: srm.Mechanism,
) -> None:
    """A torque that jumps at every call cannot be integrated: bounded attempts, then a message."""
    rng = np.random.default_rng(0)
    solution = srm.simulate(
        four_bar, 1.0, controller=lambda t, q, v: 1e9 * rng.standard_normal(3), rtol=1e-8
    )
    assert solution.status == "failed"
    assert "error estimate" in solution.message


def test_loose_tolerances_are_capped_with_a_warning(four_bar: srm.Mechanism) -> None:
    for tableau, method, loosest in (
        ("dop853", "psrm", 1e-2),
        ("dopr54", "psrm", 1e-3),
        ("tvd32", "srm", 1e-4),
    ):
        with pytest.warns(srm.SrmWarning, match=f"rtol = 0.1 is looser than {loosest:g}"):
            solution = srm.simulate(four_bar, 0.5, rtol=0.1, method=method, tableau=tableau)
        assert solution.settings.rtol == loosest


def test_tolerances_below_round_off_are_raised_with_a_warning(four_bar: srm.Mechanism) -> None:
    with pytest.warns(srm.SrmWarning, match="below round-off: using 1.0e-12"):
        srm.simulate(four_bar, 0.01, rtol=1e-16)
    for tableau, tightest in (("dop853", 1e-12), ("dopr54", 1e-12), ("tvd32", 1e-11)):
        expected = "rtol = 1e-13 is below round-off next to singular configurations"
        with pytest.warns(srm.SrmWarning, match=f"{expected}.*using {tightest:.1e}"):
            solution = srm.simulate(four_bar, 0.01, rtol=1e-13, tableau=tableau)
        assert solution.settings.rtol == tightest


def test_mechanisms_without_closures_may_ask_for_tighter_tolerances() -> None:
    pendulum = srm.load("simple_pendulum")
    assert srm.simulate(pendulum, 0.01, rtol=1e-13).settings.rtol == 1e-13
    with pytest.warns(srm.SrmWarning, match=r"below round-off: using 2\.2e-14"):
        srm.simulate(pendulum, 0.01, rtol=1e-14)


INVALID: list[dict[str, Any]] = [
    {"t_end": -1.0},
    {"t_end": float("nan")},
    {"t_end": "late"},
    {"t0": "now"},
    {"t0": 2.0},
    {"step": 0.0},
    {"step": "small"},
    {"max_step": -1.0},
    {"first_step": float("inf")},
    {"rtol": -1e-6},
    {"rtol": "tight"},
    {"rtol": None},
    {"atol": [1e-6, 1e-6]},
    {"atol": 0.0},
    {"atol": [1e-6, -1.0, 1e-6]},
    {"atol": np.inf},
    {"atol": "tight"},
    {"method": "newmark"},
    {"method": 3},
    {"method": srm.PSRM},
    {"method": srm.SRM(T="inverse")},
    {"method": srm.PSRM(), "tableau": "dopr54"},
    {"tableau": "rk45"},
    {"tableau": "erk4"},
    {"backend": "fortran"},
    {"backend": "kernel", "method": "srm"},
    {"t_eval": [0.0, 2.0]},
    {"t_eval": [0.5, 0.2]},
    {"t_eval": ["now"]},
    {"t_eval": [[0.0, 0.5]]},
    {"q0": np.zeros(2)},
    {"q0": "home"},
    {"q0": {"crank": 1.0}},
    {"q0": np.zeros(3)},
    {"v0": [[1.0], [2.0, 3.0]]},
    {"v0": np.ones(3)},
    {"v0": {"crank": 1.0}},
    {"v0": np.full(3, np.nan)},
    {"controller": 3},
    {"sample_time": 0.1},
    {"placement": "best"},
    {"singular_times": [1.0]},
    {"breakpoints": [[0.5]]},
    {"progress": "loud"},
    {"mechanism": "four_bar"},
]
INVALID_METHODS: list[dict[str, Any]] = [
    {"prediction": "simple", "correction": "split"},
    {"prediction": "extrapolated"},
    {"prediction": ["exact"]},
    {"correction": "late"},
    {"eps": -1.0},
    {"tableau": "nonsense"},
]


def test_invalid_options_are_refused_before_any_stepping(four_bar: srm.Mechanism) -> None:
    messages = {
        f"simulate {options}": refused(
            lambda: srm.simulate(**({"mechanism": four_bar, "t_end": 1.0} | options))  # noqa: B023
        )
        for options in INVALID
    }
    for options in INVALID_METHODS:
        messages[f"PSRM {options}"] = refused(lambda: srm.PSRM(**options))  # noqa: B023
    check_messages("options", messages)


@pytest.mark.parametrize("option", ["method", "tableau", "backend", "placement"])
def test_names_of_options_have_one_spelling(four_bar: srm.Mechanism, option: str) -> None:
    name = {"method": "psrm", "tableau": "dop853", "backend": "python", "placement": "automatic"}
    chosen: dict[str, Any] = {option: name[option]}
    assert srm.simulate(four_bar, 0.1, **chosen).success
    chosen = {option: name[option].upper()}
    with pytest.raises(srm.InputError, match=rf"there is no {option} .*{name[option]}") as wrong:
        srm.simulate(four_bar, 0.1, **chosen)
    assert wrong.value.element == option


@pytest.mark.parametrize("name", ["DOP853", "dopr54"])
def test_a_tableau_in_place_of_a_method_is_told_where_it_belongs(
    four_bar: srm.Mechanism, name: str
) -> None:
    remedy = f'is a tableau, not a method. Give tableau="{name.lower()}"'
    with pytest.raises(srm.InputError, match=remedy):
        srm.simulate(four_bar, 0.1, method=name)


def test_an_assembly_as_initial_state_is_told_which_part_of_it_to_give(
    four_bar: srm.Mechanism,
) -> None:
    start: Any = srm.assemble(four_bar, {"crank": 2.0})
    with pytest.raises(srm.InputError, match=r"Give its q$"):
        srm.simulate(four_bar, 1.0, q0=start, v0=start.v)
    with pytest.raises(srm.InputError, match=r"Give its v$"):
        srm.simulate(four_bar, 1.0, q0=start.q, v0=start)


@pytest.mark.parametrize("backend", ["kernel", "python"])
@pytest.mark.parametrize(("step", "longest"), [(0.1, 0.1), (0.1, 0.05), (0.02, 0.002)])
def test_fixed_steps_that_a_longest_step_divides_reach_the_end(
    four_bar: srm.Mechanism, backend: str, step: float, longest: float
) -> None:
    """Ten times 0.1 s, added up, are less than 1 s by a unit of rounding."""
    run = srm.simulate(four_bar, 1.0, step=step, max_step=longest, backend=backend)
    assert run.success, run.message
    assert len(run.t) == round(1.0 / longest) + 1
    np.testing.assert_allclose(np.diff(run.t), longest, rtol=1e-8)


def test_max_step_and_first_step_are_obeyed(four_bar: srm.Mechanism) -> None:
    solution = srm.simulate(four_bar, 1.0, max_step=0.01, first_step=1e-4)
    h = np.diff(solution.steps.times)
    assert h[0] == pytest.approx(1e-4)
    assert h.max() <= 0.01 * (1 + 1e-12)


def test_fixed_steps_keep_the_grid_and_shorten_the_last(four_bar: srm.Mechanism) -> None:
    solution = srm.simulate(four_bar, 1.03, step=0.1, tableau="erk4")
    assert solution.t == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.03])


def test_rotations_per_step_stay_inside_the_chart() -> None:
    ring = floating_ring()
    solution = srm.simulate(ring, 5.0, rtol=1e-4)
    turned = np.diff(solution.steps.times)[:, None] * np.linalg.norm(
        solution.v[:-1].reshape(-1, 5, 3)[:, 1:], axis=2
    )
    assert turned.max() <= 1.5 * (1 + 1e-9)


def test_a_step_that_turns_a_ball_joint_too_far_is_refused_not_integrated_wrongly() -> None:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelSpherical(), pin.SE3.Identity(), "ball")
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    mechanism = srm.Mechanism(model)

    def kick(t: float, q: Any, v: Any) -> np.ndarray:
        return np.array([0.0, 50.0, 0.0])

    fixed = srm.simulate(mechanism, 2.0, controller=kick, tableau="erk4", step=0.5)
    assert fixed.status == "failed"
    assert "turns too far within one step" in fixed.message
    adaptive = srm.simulate(mechanism, 2.0, controller=kick)
    assert adaptive.success


def test_default_tolerances_of_rates_follow_gravity_or_else_the_start() -> None:
    mechanism = srm.load("four_bar")
    units = mechanism.structure.units
    assert units.rate == pytest.approx(np.sqrt(9.81 / units.length))
    solution = srm.simulate(mechanism, 0.1, rtol=1e-7)
    assert solution.settings.atol == pytest.approx([1e-7] * 3 + [1e-7 * units.rate] * 3)
    weightless = srm.load("four_bar", gravity=(0.0, 0.0, 0.0))
    rate = np.median(np.abs(mechanism.v0))
    assert weightless.structure.units.rate == pytest.approx(rate)
    faster = weightless.with_state(weightless.q0, 100.0 * weightless.v0)
    assert faster.structure.units.rate == pytest.approx(100.0 * rate)
    assert faster.structure.sigma_ref == weightless.structure.sigma_ref


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_a_fixed_step_so_long_that_the_loops_come_apart_fails(
    four_bar: srm.Mechanism, step: float
) -> None:
    solution = srm.simulate(four_bar, 1.0, step=step)
    assert solution.status == "failed"
    assert "smaller step" in solution.message
    assert solution.drift[:, 0].max() < 0.03


def test_states_are_read_only(four_bar: srm.Mechanism) -> None:
    solution = srm.simulate(four_bar, 0.1)
    for array in (solution.q, solution.v, solution.t):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 99.0


def test_times_may_miss_the_end_by_rounding(four_bar: srm.Mechanism) -> None:
    solution = srm.simulate(four_bar, 0.3, t_eval=np.arange(4) * 0.1)
    assert len(solution.t) == 4


def test_leaving_joint_limits_is_said() -> None:
    model = pin.Model()
    joint = model.addJoint(
        0,
        pin.JointModelRY(),
        along_x(0.0),
        "swing",
        np.full(1, 1e3),
        np.full(1, 1e3),
        np.full(1, -0.5),
        np.full(1, 0.5),
    )
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    solution = srm.simulate(srm.Mechanism(model), 1.0)
    assert solution.success
    assert "limits do not act; these joints left theirs: swing." in solution.message


@pytest.mark.parametrize("backend", ["python", "auto"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"t_eval": [0.0, 0.1]},
        # Back within the limits, by an action, before the end.
        {"events": srm.Event(lambda t, q, v: t - 0.09, action=lambda t, q, v: (0.0 * q, v))},
        {"events": srm.Event(lambda t, q, v: t - 0.09, action=lambda t, q, v: (q, v))},
    ],
    ids=["steps", "outputs", "back", "segments"],
)
def test_joints_that_start_beyond_their_limits_are_not_said_to_have_left_them(
    options: dict[str, Any], backend: str
) -> None:
    model = pin.Model()
    for name in ("inside", "left", "beyond"):
        joint = model.addJoint(0, pin.JointModelRY(), along_x(0.0), name)
        model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    model.lowerPositionLimit, model.upperPositionLimit = np.full(3, -0.5), np.full(3, 0.5)
    bars = srm.Mechanism(model, v0=[0.0, 9.0, 0.0])
    solution = srm.simulate(bars, 0.1, q0=[0.0, 0.0, 0.7], backend=backend, **options)
    assert (
        " Joint limits do not act; these joints left theirs: left; these joints started beyond "
        "theirs: beyond."
    ) in solution.message


@pytest.mark.parametrize("backend", ["python", "auto"])
def test_a_progress_callable_sees_every_accepted_step_and_changes_nothing(
    four_bar: srm.Mechanism, backend: str
) -> None:
    seen: list[float] = []

    def spoil(t: float, h: float, x: Any) -> None:
        seen.append(t)
        x[:] = np.nan

    spoilt = srm.simulate(four_bar, 0.5, progress=spoil, backend=backend)
    plain = srm.simulate(four_bar, 0.5, backend=backend)
    assert seen == plain.steps.times[1:].tolist()
    assert np.array_equal(spoilt.q, plain.q)


def test_two_runs_are_identical(four_bar: srm.Mechanism) -> None:
    a, b = (srm.simulate(four_bar, 1.0) for _ in range(2))
    assert np.array_equal(a.q, b.q)
    assert np.array_equal(a.t, b.t)


def test_a_second_run_looks_nothing_up_in_the_model_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mechanism = srm.load("squeezing_mechanism")
    first = srm.simulate(mechanism, 1e-3)

    def refuse(*_: Any) -> None:
        raise AssertionError("an anchor is looked up again")

    monkeypatch.setattr(srm.Anchor, "resolve", refuse)
    for backend in ("auto", "python"):
        again = srm.simulate(mechanism, 1e-3, backend=backend)
        moved = srm.simulate(
            mechanism, 1e-3, q0=mechanism.q0.copy(), v0=mechanism.v0.copy(), backend=backend
        )
        assert np.abs(again.q[-1] - first.q[-1]).max() < 1e-10
        assert np.array_equal(again.q, moved.q)


def test_runs_of_one_mechanism_do_not_share_what_they_work_on(four_bar: srm.Mechanism) -> None:
    """Dense output and energies of a run stay what they were after another one."""
    t = np.linspace(0.0, 0.5, 7)
    first = srm.simulate(four_bar, 0.5, backend="python")
    known = srm.simulate(four_bar, 0.5, backend="python").at(t)
    other = srm.assemble(four_bar, {"crank": 2.0}, {"crank": -1.0})
    second = srm.simulate(four_bar, 0.5, q0=other.q, v0=other.v, backend="python")
    assert np.abs(second.q[-1] - first.q[-1]).max() > 0.1
    assert np.array_equal(first.at(t).q, known.q)
    assert np.array_equal(first.at(t).energy, known.energy)
    assert first.drift.max() < 1e-9


def test_a_start_that_does_not_fit_is_refused_whatever_ran_before(
    four_bar: srm.Mechanism,
) -> None:
    srm.simulate(four_bar, 0.1)
    with pytest.raises(srm.InputError, match="violates the closures"):
        srm.simulate(four_bar, 0.1, q0=four_bar.q0 + np.array([1e-3, 0.0, 0.0]))
    srm.simulate(four_bar, 0.1)
    floating = floating_ring()
    with pytest.raises(srm.InputError, match="unit length"):
        floating.with_state(2.0 * floating.q0, floating.v0)


def test_messages_name_late_times_with_all_their_digits() -> None:
    mechanism = srm.load("slider_crank")
    with pytest.raises(srm.InputError, match="between 1000000 and t_end = 1000003 s"):
        srm.simulate(mechanism, 1000003.0, t0=1e6, t_eval=[1000004.0])
    with pytest.raises(srm.InputError, match="ends at 1000003 s, before it starts at 1000004 s"):
        srm.simulate(mechanism, 1000003.0, t0=1000004.0)
    event = srm.Event(lambda t, q, v: t - 1000002.25, terminal=True)
    for run in (
        srm.simulate(mechanism, 1000003.5, t0=1e6),
        srm.simulate(mechanism, 1000005.0, t0=1e6, events=event),
    ):
        assert f"t = {run.t[-1]:.10g} s" in run.message
        assert f"t=1000000..{run.t[-1]:.10g} s" in repr(run)


@pytest.mark.parametrize("t0", [0.0, 1.0, 1e9])
@pytest.mark.parametrize(
    "options", [{}, {"backend": "python"}, {"step": 1e-3}, {"tableau": "rodas5p"}]
)
def test_a_run_may_be_as_short_as_the_rounding_of_its_time(
    four_bar: srm.Mechanism, t0: float, options: dict[str, Any]
) -> None:
    for roundings in (1, 2, 5):
        end = t0 + roundings * np.spacing(t0)
        run = srm.simulate(four_bar, end, t0=t0, **options)
        assert run.success, run.message
        assert run.t[-1] == end
        moved = run.q[-1] - four_bar.q0
        np.testing.assert_allclose(moved, (end - t0) * four_bar.v0, rtol=1e-3, atol=2e-15)
