"""Exceptions of the package, which other processes raise as well."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm


def no_such_file() -> None:
    srm.load("no_such_mechanism")


def loops_that_do_not_close() -> None:
    srm.assemble(srm.load("four_bar"), {"crank": 0.0, "rocker": 3.0})


def equilibrium_that_is_not_found() -> None:
    falling = srm.planar(
        points={"A": (0.0, 0.0), "B": (1.0, 0.0)},
        bars={"bar": ("B", "A")},
        ground=(),
        sliders={"slide": {"point": "A", "along": (0.0, 1.0)}},
        mass_per_length=1.0,
    )
    srm.equilibrium(falling)


def dividing(t: float, q: Any, v: Any) -> Any:
    return np.zeros(3) / (t < 0.1)


def run_that_fails() -> None:
    with np.errstate(all="ignore"):
        srm.simulate(srm.load("four_bar"), 1.0, controller=dividing, raise_on_failure=True)


def controller_that_fails() -> None:
    srm.simulate(srm.load("four_bar"), 1.0, controller=lambda t, q, v: "nothing")


@pytest.mark.parametrize(
    "fail",
    [
        no_such_file,
        loops_that_do_not_close,
        equilibrium_that_is_not_found,
        run_that_fails,
        controller_that_fails,
    ],
)
@pytest.mark.parametrize("copied", [lambda error: pickle.loads(pickle.dumps(error)), copy.copy])
def test_copies_of_an_error_say_what_it_says(fail: Callable[[], None], copied: Any) -> None:
    with pytest.raises(srm.SrmError) as caught:
        fail()
    error = caught.value
    other = copied(error)
    assert type(other) is type(error)
    assert str(other) == str(error)
    assert vars(other).keys() == vars(error).keys()


def by_nothing(t: float) -> float:
    return 1.0 / (t < 0.1)


LINE = by_nothing.__code__.co_firstlineno + 1


@pytest.mark.parametrize("backend", ["python", "kernel"])
@pytest.mark.parametrize(
    "options",
    [
        {"controller": lambda t, q, v: [by_nothing(t), 0.0, 0.0]},
        {"controller": lambda t, q, v: [by_nothing(t), 0.0, 0.0], "sample_time": 0.05},
        {"events": lambda t, q, v: by_nothing(t)},
        {"events": srm.Event(lambda t, q, v: t - 0.5, action=lambda t, q, v: by_nothing(t))},
    ],
    ids=["controller", "sampled", "event", "action"],
)
def test_the_message_names_the_line_of_a_function_that_raises(
    options: dict[str, Any], backend: str
) -> None:
    """Below the first function of the user, and without the folder of its file."""
    with pytest.warns(srm.FailedRunWarning):
        solution = srm.simulate(srm.load("four_bar"), 1.0, backend=backend, **options)
    assert f", in 'by_nothing' (test_errors.py, line {LINE})." in solution.message
    assert not solution.success


def test_a_library_that_raises_is_not_the_place_that_is_named() -> None:
    def solving(t: float, q: Any, v: Any) -> Any:
        return np.linalg.solve(np.zeros((3, 3)), q)

    with pytest.raises(srm.FunctionError, match=r"in 'solving' \(test_errors\.py, line \d+\)$"):
        srm.simulate(srm.load("four_bar"), 1.0, controller=solving)


def test_an_error_on_request_has_the_cause_of_the_failure() -> None:
    with np.errstate(all="ignore"), pytest.raises(srm.SimulationError) as caught:
        srm.simulate(srm.load("four_bar"), 1.0, controller=dividing, raise_on_failure=True)
    assert caught.value.__cause__ is caught.value.solution.error
    assert isinstance(caught.value.__cause__, srm.ControllerError)


def test_an_error_in_another_process_arrives_and_the_process_goes_on() -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        with pytest.raises(srm.InputError, match="there is no bundled mechanism") as caught:
            pool.submit(no_such_file).result()
        assert caught.value.remedy.startswith("Known: ")
        with pytest.raises(srm.AssemblyError) as open_loops:
            pool.submit(loops_that_do_not_close).result()
        assert open_loops.value.residuals["pin"][0] is not None
