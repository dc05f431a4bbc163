"""Values and names in messages: whatever the value is, and however many names there are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.errors import LONGEST_SHOWN, MOST_LISTED, known_names, printable, safe_repr

HUGE = 10**5000
"""An integer that Python does not write as text."""


class Unshowable:
    """An object that has no representation."""

    def __repr__(self) -> str:
        raise RuntimeError("not to be shown")

    __str__ = __repr__


class Text(str):
    """A text that formats itself with an exception."""

    def __format__(self, how: str) -> str:
        raise RuntimeError("not to be shown")

    __str__ = Unshowable.__repr__


class Telling:
    """An object whose representation is such a text."""

    def __repr__(self) -> str:
        return Text("telling")


def test_every_value_has_a_representation() -> None:
    assert safe_repr("a\nb") == r"'a\nb'"
    assert safe_repr(3.5) == "3.5"
    assert safe_repr(Unshowable()) == "<Unshowable without representation>"
    assert safe_repr(HUGE) == "<int without representation>"
    assert safe_repr([Unshowable(), HUGE]) == "<list without representation>"
    assert f"{safe_repr(Telling())}" == "telling"
    assert printable(Unshowable()) == "<Unshowable without representation>"


def test_a_long_representation_is_cut() -> None:
    shown = safe_repr("x" * 10**6)
    assert len(shown) == LONGEST_SHOWN
    assert shown.startswith("'xxx")
    assert shown.endswith("...")


def test_a_list_of_many_names_ends_with_their_number() -> None:
    names = [f"joint_{k}" for k in range(1000)]
    assert known_names(names[:2]) == "Known: joint_0, joint_1"
    assert known_names(names[:MOST_LISTED]).endswith(f", {names[MOST_LISTED - 1]}")
    assert known_names(names).endswith(f", {names[MOST_LISTED - 1]} and {1000 - MOST_LISTED} more")
    assert known_names([]) == "Known: none"


def _raise_unshowable(t: float, q: np.ndarray, v: np.ndarray) -> Any:
    class OddError(Unshowable, Exception):
        pass

    raise OddError


VALUES = {  # pytest cannot show them either
    "an object": Unshowable(),
    "an integer": HUGE,
    "a negative integer": -HUGE,
    "a list": [HUGE],
    "a dictionary": {"a": Unshowable()},
}


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES.keys())
@pytest.mark.parametrize(
    "call",
    [
        lambda value: srm.simulate(srm.load("four_bar"), value),
        lambda value: srm.simulate(srm.load("four_bar"), 0.1, method=value),
        lambda value: srm.simulate(srm.load("four_bar"), 0.1, controller=value),
        lambda value: srm.load("four_bar", base=value),
        lambda value: srm.load("four_bar", gravity=value),
        lambda value: srm.load("four_bar").joint(value),
        lambda value: srm.Anchor("rod", xyz=value),
        lambda value: srm.LoopClosure(value, srm.Anchor("a"), srm.Anchor("b")),
        lambda value: srm.ConstantSpeed(value),
        lambda value: srm.UserForce(value),
        lambda value: srm.sweep(value, [{}], 0.1),
    ],
)
def test_an_argument_without_representation_is_refused(
    call: Callable[[Any], Any], value: Any
) -> None:
    with pytest.raises(srm.InputError) as caught:
        call(value)
    assert "without representation" in str(caught.value) or caught.value.element


def test_a_function_that_raises_what_cannot_be_shown_is_named_in_a_message() -> None:
    mechanism = srm.load("four_bar")
    with pytest.raises(srm.SrmError) as caught:
        srm.simulate(mechanism, 0.1, controller=_raise_unshowable)
    assert "the controller raised <OddError without representation>" in str(caught.value)
