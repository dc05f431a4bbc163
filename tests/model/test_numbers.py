"""Positive numbers and integers as arguments: one rule for all functions."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.model.numbers import finite_array, positive_integer, positive_number, real_array
from tests.support.bundled import load

COUNTS: dict[str, Callable[[Any], Any]] = {
    "starts": lambda n: srm.assembly_modes(load("four_bar"), starts=n),
    "iterations": lambda n: srm.SRM(iterations=n),
    "chunk": lambda n: srm.sweep(load("four_bar"), [{}], measure=len, t_end=1.0, chunk=n),
    "n": srm.n_four_bar,
}


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize("value", [True, 0, -1, 2.0, "2", [1]], ids=repr)
def test_a_count_that_is_no_positive_integer_is_refused(name: str, value: Any) -> None:
    with pytest.raises(srm.InputError, match="is not a positive whole number") as refused:
        COUNTS[name](value)
    assert refused.value.element == name


def test_a_count_may_be_an_integer_of_numpy() -> None:
    assert srm.SRM(iterations=np.int64(2)) == srm.SRM(iterations=2)
    assert len(srm.n_four_bar(np.int8(2)).loops) == len(srm.n_four_bar(2).loops)
    count = positive_integer(np.uint8(3), "n", "Give one")
    assert count == 3
    assert type(count) is int


@pytest.mark.parametrize("value", [0, -1.0, np.nan, np.inf, "fast", None, [1.0, 2.0]], ids=repr)
def test_a_speed_that_is_no_positive_number_is_refused(value: Any) -> None:
    run = srm.simulate(srm.load("simple_pendulum"), 0.1)
    with pytest.raises(srm.InputError, match="is not a positive number"):
        run.export_video("film.gif", speed=value)
    with pytest.raises(srm.InputError, match=r"speed = .* is not a positive number of m/s"):
        positive_number(value, "speed", " of m/s")


@pytest.mark.parametrize("t", ["soon", np.nan, [0.0, 0.1], 0.2, -0.1], ids=repr)
def test_a_time_of_a_picture_that_is_none_of_the_run_is_refused(t: Any) -> None:
    run = srm.simulate(srm.load("simple_pendulum"), 0.1)
    save = partial(run.export_image, "picture.png")
    with pytest.raises(srm.InputError, match="Give a time of the run") as refused:
        save(t=t)
    assert refused.value.element == "t"


NO_NUMBERS = [
    *("0.5", b"0.5", np.str_("0.5"), np.array("0.5"), bytearray(b"0.5")),
    *(True, np.True_, 0.5j, np.timedelta64(1, "s"), np.datetime64(1, "s")),
]
ENDS = (srm.Anchor("rod"), srm.Anchor("crank"))
NUMBERS: dict[str, Callable[[Any], Any]] = {
    **{
        name: partial(lambda name, x: srm.simulate(load("four_bar"), 0.1, **{name: x}), name)
        for name in ("t0", "rtol", "step", "first_step", "max_step", "sample_time")
    },
    "t_end": lambda x: srm.simulate(load("four_bar"), x),
    "crank": lambda x: srm.assemble(load("four_bar"), {"crank": x}),
    "dt": lambda x: srm.Simulator(load("four_bar")).step(x),
    "length": lambda x: srm.LoopClosure("distance", *ENDS, length=x),
    "stiffness": lambda x: srm.SpringDamper(*ENDS, stiffness=x),
    "speed": srm.ConstantSpeed,
    "amplitude": lambda x: srm.linearise(load("four_bar")).mode_shape(0, x),
}


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", NO_NUMBERS, ids=repr)
def test_what_is_no_number_is_refused_by_the_name_of_the_argument(name: str, value: Any) -> None:
    with pytest.raises(srm.InputError) as refused:
        NUMBERS[name](value)
    assert name in str(refused.value)


@pytest.mark.parametrize(
    "number", [0.5, np.float32(0.5), np.float64(0.5), np.array(0.5), Fraction(1, 2), Decimal("0.5")]
)
def test_a_number_of_any_type_is_the_float_that_it_equals(number: Any) -> None:
    expected = srm.simulate(load("four_bar"), 0.5, step=0.25)
    found = srm.simulate(load("four_bar"), number, step=number / 2)
    np.testing.assert_array_equal(found.t, expected.t)
    np.testing.assert_array_equal(found.q, expected.q)


def test_arrays_of_texts_are_no_numbers_and_of_truth_values_only_those_that_functions_return() -> (
    None
):
    for values in (["1", "2"], [1.0, "2"], np.array(["1"], dtype=object), [True, False]):
        assert finite_array(values) is None
    np.testing.assert_array_equal(real_array([True, False]), [1.0, 0.0])
    with pytest.raises(srm.InputError, match="t_eval"):
        srm.simulate(load("four_bar"), 1.0, t_eval=["0.1", "0.2"])
    with pytest.raises(srm.InputError, match="q0"):
        srm.simulate(load("four_bar"), 1.0, q0=["1", "2", "3"])
    with pytest.raises(srm.ControllerError, match="nothing"):
        srm.simulate(load("four_bar"), 1.0, controller=lambda t, q, v: ["nothing", "1", "2"])
    with pytest.raises(srm.EventError, match="no numbers"):
        srm.simulate(load("four_bar"), 1.0, events=lambda t, q, v: "1.0")
