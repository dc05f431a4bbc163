"""Finite numbers of a given shape: the one check of numbers that users hand over."""

from __future__ import annotations

from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError

LARGEST_MAGNITUDE = 1e30
"""Of a number in a file, in SI units: the squares of larger ones may overflow in sums."""


def finite_array(values: Any, shape: tuple[int | None, ...] | None = None) -> FloatArray | None:
    """``values`` as a new array; None unless it is real, finite and of that shape.

    Parameters
    ----------
    values
        Anything.
    shape
        Lengths of the axes, None for an axis of any length; without a shape, any is accepted.
    """
    try:
        if not np.isrealobj(values):  # NumPy drops imaginary parts with no more than a warning
            return None
        array = np.array(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return None
    if shape is not None and (
        array.ndim != len(shape)
        or any(length not in (None, given) for length, given in zip(shape, array.shape))
    ):
        return None
    return array if np.isfinite(array).all() else None


def finite_numbers(values: Any, count: int, name: str, remedy: str) -> tuple[float, ...]:
    """``values`` as a tuple of ``count`` finite floats.

    Raises
    ------
    InputError
        About the element ``name``, with that ``remedy``, if they are anything else.
    """
    array = finite_array(values, (count,))
    if array is None:
        raise InputError(
            f"{name} must be {count} finite numbers, not {values!r}", element=name, remedy=remedy
        )
    return tuple(array.tolist())


def vector(values: Any, name: str) -> tuple[float, float, float]:
    """``values`` as three finite floats.

    Raises
    ------
    InputError
        About the element ``name``, if they are anything else.
    """
    x, y, z = finite_numbers(values, 3, name, "Give [x, y, z]")
    return (x, y, z)
