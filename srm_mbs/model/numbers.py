"""Numbers of a given shape, truth values, words and names: the one check of what users give."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from numbers import Integral
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, known_names, safe_repr

LARGEST_MAGNITUDE = 1e30
"""Largest magnitude of a number in a file, in SI units: the squares of larger ones may overflow in
sums."""

FEW = 32
"""Numbers up to which lists are faster than arrays."""


def finite_array(
    values: Any, shape: tuple[int | None, ...] | None = None, *, new: bool = True
) -> FloatArray | None:
    """``values`` as an array; None unless they are numbers, real, finite, without masked elements,
    and of that shape.

    Parameters
    ----------
    values
        Anything.
    shape
        Lengths of the axes, None for an axis of any length; without a shape, any is accepted.
    new
        Whether it is a copy, which changes of ``values`` do not reach.
    """
    if type(values) is np.ndarray and values.dtype == float and shape in (None, values.shape):
        return (values.copy() if new else values) if all_finite(values) else None
    try:
        if np.ma.is_masked(values):
            return None  # NumPy drops masks
        array = real_array(values, new=new, booleans=False)
    except Exception:  # objects may raise anything
        return None
    fits = shape in (None, array.shape) or (
        len(shape) == array.ndim
        and all(length in (None, actual) for length, actual in zip(shape, array.shape))
    )
    if not fits:
        return None
    return array if all_finite(array) else None


def real_array(values: Any, *, new: bool = True, booleans: bool = True) -> FloatArray:
    """``values`` as an array of floats of any shape; ``new`` as of :func:`finite_array`, and
    ``booleans``: whether truth values count as 0 and 1, as those that functions return do.

    Raises
    ------
    TypeError
        If they are texts, dates or complex, all of which NumPy converts, the last with no more than
        a warning.
    Exception
        Whatever their conversion raises.
    """
    given = np.array(values, order="C") if new else np.asarray(values)
    if given.dtype == float:
        return given
    of_objects = given.dtype.kind == "O"
    known = _NUMBER_KINDS if booleans else _NUMBER_KINDS.replace("b", "")
    if given.dtype.kind not in known or (of_objects and any(map(_is_text, given.flat))):
        kind = "complex values" if given.dtype.kind == "c" else "values that are no numbers"
        raise TypeError(kind)
    return given.astype(float)


_NUMBER_KINDS = "biufO"
"""Kinds of NumPy's data types whose elements may be real numbers; objects such as fractions too."""


def _is_text(value: Any) -> bool:
    return isinstance(value, str | bytes | bytearray)


def all_finite(array: FloatArray) -> bool:
    """Whether no element of ``array`` is infinite or NaN."""
    # Of a list where there are few, because a reduction of NumPy takes five times as long.
    if array.size <= FEW:
        return all(map(math.isfinite, array.ravel().tolist()))
    return bool(np.logical_and.reduce(np.isfinite(array), axis=None))


def vector_elements(vector: Any) -> list[Any]:
    """The elements of one of Pinocchio's vectors of numbers or names.

    By index, because iterations over them end with an exception of C++, which takes three times as
    long as the rest; vectors of objects have a quick ``tolist`` of their own.
    """
    return [vector[i] for i in range(len(vector))]


def flag(value: Any, name: str) -> bool:
    """``value``, the argument ``name``, as a truth value.

    Raises
    ------
    InputError
        If it is neither True nor False, 1 and 0 included.
    """
    if isinstance(value, bool | np.bool_) or (isinstance(value, int) and value in (0, 1)):
        return bool(value)
    raise InputError(
        f"{name} = {safe_repr(value)} is neither True nor False",
        element=name,
        remedy="Give True or False",
    )


def choice(value: Any, known: Iterable[str], name: str) -> str:
    """``value``, the argument ``name``, as one of the ``known`` words.

    Raises
    ------
    InputError
        If it is anything else.
    """
    words = tuple(known)
    if isinstance(value, str) and value in words:
        return value
    raise InputError(
        f"there is no {name} {safe_repr(value)}",
        element=name,
        remedy=known_names(words),
    )


def name_list(given: Any, element: str) -> tuple[str, ...]:
    """``given``, one name or several, as a tuple; messages name ``element``.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if isinstance(given, str):
        return (plain(given),)
    try:
        names = tuple(given)
    except Exception:  # objects may raise anything
        names = (None,)
    if not all(isinstance(name, str) for name in names):
        raise InputError(
            f"{element} = {safe_repr(given)} is not a list of names",
            element=element,
            remedy="Give a list of names",
        )
    return tuple(map(plain, names))


def named_values(given: Any, element: str) -> Mapping[str, Any]:
    """``given``, name -> value; empty for None; messages name ``element``.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(
            f"{element} = {safe_repr(given)} does not have a value for each name",
            element=element,
            remedy="Give a dictionary: name -> value",
        )
    return {plain(key) if isinstance(key, str) else key: value for key, value in given.items()}


def plain(text: str) -> str:
    """``text`` without what a subclass of str adds, which formats itself as it likes."""
    return str.__str__(text)


def checked_name(name: Any, what: str) -> str:
    """``name``, of ``what``, such as a force, as a text.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if not isinstance(name, str):
        raise InputError(
            f"the name {safe_repr(name)} is not a text", element=what, remedy="Give a text, or none"
        )
    return plain(name)


def finite_number(
    value: Any, name: str, element: str, remedy: str = "Give a finite number"
) -> float:
    """``value``, called ``name`` in messages, as a finite float.

    Raises
    ------
    InputError
        About ``element``, with the ``remedy``, if it is anything else.
    """
    number = _number(value)
    if number is None:
        raise InputError(
            f"{name} = {safe_repr(value)} is not a finite number",
            element=element,
            remedy=remedy,
        )
    return number


def positive_number(
    value: Any, name: str, unit: str = "", remedy: str = "Give a positive number"
) -> float:
    """``value``, the argument ``name``, as a positive finite float; messages say its ``unit``, such
    as ``" of seconds"``.

    Raises
    ------
    InputError
        With that ``remedy``, if it is anything else.
    """
    number = value if type(value) is float else _number(value)
    if number is None or not 0.0 < number < math.inf:
        raise InputError(
            f"{name} = {safe_repr(value)} is not a positive number{unit}",
            element=name,
            remedy=remedy,
        )
    return number


def positive_integer(value: Any, name: str, remedy: str, unit: str = "") -> int:
    """``value``, the argument ``name``, as an integer of at least 1; ``unit`` as of
    :func:`positive_number`.

    Raises
    ------
    InputError
        With that ``remedy``, if it is anything else, True included.
    """
    whole = isinstance(value, Integral) and not isinstance(value, bool | np.timedelta64)
    if not whole or value < 1:
        raise InputError(
            f"{name} = {safe_repr(value)} is not a positive whole number{unit}",
            element=name,
            remedy=remedy,
        )
    return int(value)


def _is_finite_float(value: Any) -> bool:
    return type(value) is float and math.isfinite(value)


def _number(value: Any) -> float | None:
    """``value`` as a float; None unless it is one finite number."""
    if type(value) in (float, np.float64):  # as :func:`finite_array`, in a tenth of its time
        return float(value) if math.isfinite(value) else None
    array = finite_array(value, ())
    return None if array is None else float(array)


def finite_numbers(
    values: Any, count: int, name: str, remedy: str, element: str | None = None
) -> tuple[float, ...]:
    """``values``, called ``name`` in messages, as a tuple of ``count`` finite floats.

    Raises
    ------
    InputError
        About ``element``, by default ``name``, with that ``remedy``, if they are anything else.
    """
    plain_list = type(values) in (tuple, list) and len(values) == count
    if plain_list and all(map(_is_finite_float, values)):
        return tuple(values)
    array = finite_array(values, (count,))
    if array is None:
        raise InputError(
            f"{name} must be {count} finite numbers, not {safe_repr(values)}",
            element=element or name,
            remedy=remedy,
        )
    return tuple(array.tolist())


def vector(values: Any, name: str, element: str | None = None) -> tuple[float, float, float]:
    """``values``, called ``name`` in messages, as three finite floats.

    Raises
    ------
    InputError
        About ``element``, by default ``name``, if they are anything else.
    """
    if type(values) in (tuple, list) and len(values) == 3:
        x, y, z = values
        if type(x) is type(y) is type(z) is float and math.isfinite(x + y + z):
            return (x, y, z)
    x, y, z = finite_numbers(values, 3, name, "Give [x, y, z]", element)
    return (x, y, z)


def unit_vector(values: Any, name: str, element: str) -> tuple[float, float, float]:
    """The direction of ``values``, called ``name`` in messages: three floats of norm 1.

    Raises
    ------
    InputError
        About ``element``, if they are not three finite numbers, or all zero.
    """
    direction = np.array(vector(values, name, element))
    size = float(np.linalg.norm(direction))
    if size == 0.0:
        raise InputError(f"the {name} is zero", element=element, remedy="Give a direction")
    x, y, z = (direction / size).tolist()
    return (x, y, z)
