"""Functions of the user that fail: at their first call, and later; names that do not exist."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.errors import ControllerError, EventError
from tests.support.bundled import finished, load

Function = Callable[..., Any]
backends = pytest.mark.parametrize("backend", ["python", "kernel"])


def mistaken(t: float, q: Any, v: Any) -> Any:
    return q["crank"]  # a bug that Python reports as an IndexError


def later(function: Function, good: Any, after: float = 0.05) -> Function:
    """``good`` until ``after`` (s), then ``function``."""
    return lambda t, q, v: good if t < after else function(t, q, v)


def wrong_shape(t: float, q: Any, v: Any) -> Any:
    return [1.0, 2.0, 3.0, 4.0]


def with_force(function: Function) -> srm.Mechanism:
    force = srm.UserForce(function, name="wind")
    return replace(load("slider_crank"), forces=(force,))


def run(kind: str, function: Function, **options: Any) -> srm.Solution:
    """A run with ``function`` as its controller, sampled controller, force or event."""
    mechanism = load("slider_crank")
    if kind == "force":
        mechanism = with_force(function)
    elif kind == "event":
        options["events"] = [function]
    elif kind == "acting event":
        options["events"] = [srm.Event(function, action=lambda t, q, v: (q, v))]
    else:
        options["controller"] = function
        if kind == "sampled controller":
            options["sample_time"] = 0.01
    return srm.simulate(mechanism, 0.3, **options)


KINDS = ("controller", "sampled controller", "force", "event", "acting event")
every_kind = pytest.mark.parametrize("kind", KINDS)


@backends
@every_kind
def test_a_function_that_raises_at_its_first_call_raises_at_once(kind: str, backend: str) -> None:
    expected = EventError if "event" in kind else ControllerError
    with pytest.raises(expected, match=r"raised IndexError.* at t = 0 s") as caught:
        run(kind, mistaken, backend=backend)
    cause = caught.value.__cause__
    assert isinstance(cause, IndexError)
    frames = traceback.extract_tb(cause.__traceback__)
    assert frames[-1].name == "mistaken"
    assert isinstance(caught.value, srm.SrmError)


@backends
@every_kind
def test_a_function_of_other_arguments_is_named_with_what_python_says(
    kind: str, backend: str
) -> None:
    """No line of it runs, so that the exception has no traceback of its own."""
    with pytest.raises(srm.SrmError, match=r"raised TypeError\(.*takes 2 positional arguments"):
        run(kind, lambda t, q: 0.0, backend=backend)  # type: ignore[misc]


@backends
@every_kind
def test_a_function_that_returns_another_shape_at_first_raises_at_once(
    kind: str, backend: str
) -> None:
    with pytest.raises(srm.SrmError, match=r"returned .* at t = 0 s; it must return"):
        run(kind, wrong_shape, backend=backend)


@backends
@every_kind
def test_a_later_failure_keeps_the_run_and_its_traceback(kind: str, backend: str) -> None:
    good = 1.0 if "event" in kind else [0.0, 0.0]
    solution = run(kind, later(mistaken, good), backend=backend, max_step=0.02)
    assert solution.status == "failed"
    assert 0.0 < solution.span[1] <= 0.08
    assert isinstance(solution.error, EventError if "event" in kind else ControllerError)
    cause = solution.error.__cause__
    assert isinstance(cause, IndexError)
    assert traceback.extract_tb(cause.__traceback__)[-1].name == "mistaken"
    assert solution.at([0.0]).error is solution.error


@pytest.mark.filterwarnings("error")
@backends
def test_a_run_that_fails_gives_one_warning_with_its_message(backend: str) -> None:
    with pytest.warns(srm.SrmWarning) as caught:
        solution = run("controller", later(mistaken, [0.0, 0.0]), backend=backend)
    assert solution.status == "failed"
    (warning,) = caught
    assert str(warning.message) == solution.message
    assert warning.filename == __file__


@pytest.mark.filterwarnings("error")
def test_a_dae_that_fails_gives_one_warning_with_its_message() -> None:
    """x' = 1 - y with x = 0 asks for y = 1, and the function f is no longer defined at t = 0.5."""
    problem = srm.SemiExplicitDAE(
        f=lambda t, x: np.ones(1) if t < 0.5 else np.full(1, np.nan),
        B=lambda t, x: np.ones((1, 1)),
        g=lambda t, x: x,
        G=lambda t, x: np.ones((1, 1)),
    )
    with pytest.warns(srm.SrmWarning) as caught:
        solution = srm.solve_dae(problem, (0.0, 1.0), [0.0], max_step=0.1)
    assert solution.status == "failed"
    assert [str(warning.message) for warning in caught] == [solution.message]


@pytest.mark.filterwarnings("error")
def test_runs_that_end_as_they_were_asked_to_do_not_warn() -> None:
    def height(t: float, q: Any, v: Any) -> float:
        return 0.05 - t

    height.terminal = True  # type: ignore[attr-defined]
    assert run("event", height).status == "event"

    def stop(t: float, h: float, state: Any) -> None:
        raise KeyboardInterrupt

    mechanism = load("slider_crank")
    assert srm.simulate(mechanism, 0.3, progress=stop).status == "interrupted"
    failing = later(mistaken, [0.0, 0.0])
    with pytest.raises(srm.SimulationError):
        srm.simulate(mechanism, 0.3, controller=failing, raise_on_failure=True)


@pytest.mark.filterwarnings("error")
def test_failed_cases_of_a_sweep_are_rows_and_do_not_warn() -> None:
    mechanism = load("slider_crank")
    failing = later(mistaken, [0.0, 0.0])
    table = srm.sweep(mechanism, [{"q0": mechanism.q0}], t_end=0.3, controller=failing).table
    assert table["status"].tolist() == ["failed"]
    assert "raised IndexError" in table["message"][0]
    assert table["t_end"][0] < 0.3


def test_a_run_that_starts_later_fails_at_its_own_start() -> None:
    with pytest.raises(ControllerError, match=r"at t = 2 s"):
        srm.simulate(load("slider_crank"), 3.0, t0=2.0, controller=mistaken)


def test_runs_without_a_failing_function_have_no_error(tmp_path: Path) -> None:
    assert finished(load("slider_crank"), 0.1).error is None
    solution = run("controller", later(mistaken, [0.0, 0.0]))
    solution.save(tmp_path / "run.npz")
    assert srm.load_solution(tmp_path / "run.npz").error is None


def test_names_that_do_not_exist_are_answered_with_those_that_do() -> None:
    solution = finished(load("four_bar"), 0.1)
    for table, known in (
        (solution.reactions, "pin"),
        (solution.reaction_multipliers, "pin"),
        (solution.joint_reactions, "crank, coupler, rocker"),
        (solution.drive_forces, "none"),
        (solution.coupling_forces, "none"),
    ):
        with pytest.raises(KeyError) as caught:
            table["krank"]
        assert caught.value.args == (f"there is no 'krank'. Known: {known}",)
        assert table.get("krank") is None
    balance = srm.simulate(load("four_bar"), 0.1, controller=lambda t, q, v: np.zeros(3))
    with pytest.raises(KeyError, match=r"Known: controller"):
        balance.energy_balance.works["motor"]
    still = srm.equilibrium(load("four_bar"))
    with pytest.raises(KeyError, match=r"Known: pin"):
        still.reactions["tip"]


def test_runs_of_several_segments_list_their_names_too() -> None:
    freed = load("four_bar").without_loop("pin")
    event = srm.Event(lambda t, q, v: t - 0.05, action=lambda t, q, v: srm.Switch(freed))
    solution = srm.simulate(load("four_bar"), 0.1, events=[event])
    with pytest.raises(KeyError, match=r"Known: pin"):
        solution.reactions["tip"]
