"""Positive numbers and integers as arguments: one rule for all functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.model.numbers import positive_integer, positive_number

COUNTS: dict[str, Callable[[Any], Any]] = {
    "starts": lambda n: srm.assembly_modes(srm.load("four_bar"), starts=n),
    "iterations": lambda n: srm.SRM(iterations=n),
    "chunk": lambda n: srm.sweep(srm.load("four_bar"), [{}], measure=len, t_end=1.0, chunk=n),
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
