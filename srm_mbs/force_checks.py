"""How force elements check the values they are given, and what they say of wrong ones."""

from __future__ import annotations

from dataclasses import field
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.anchors import finite_numbers
from srm_mbs.errors import InputError
from srm_mbs.force_element import ForceElement
from srm_mbs.laws import Law


def in_unit(unit: str, default: Any) -> Any:
    """A field with a unit, for tables; "N m, N": that for angles, then that for lengths."""
    return field(default=default, metadata={"unit": unit})


def fault(force: ForceElement, problem: str, remedy: str) -> InputError:
    """The error of ``force``, to be raised."""
    return InputError(problem, element=f"force {force.name!r}", remedy=remedy)


def take_name(force: ForceElement, *places: str) -> None:
    """The default name, if none is given."""
    if not force.name:
        object.__setattr__(force, "name", "_".join((force.type, *places)))


def take(force: ForceElement, key: str, count: int = 0, lowest: float = -np.inf) -> Any:
    """Check a number, or ``count`` numbers, of ``force`` and store them as float or tuple.

    Raises
    ------
    InputError
        If they are not finite, or below ``lowest``.
    """
    given = getattr(force, key)
    remedy = f"Give a list of {count} finite numbers" if count else "Give a finite number"
    try:
        numbers = finite_numbers(given if count else (given,), count or 1, key, remedy)
    except InputError as error:
        raise fault(force, f"{key} = {given!r} cannot be", remedy) from error
    if min(numbers) < lowest:
        raise fault(force, f"{key} = {given!r} is negative", "Give a value >= 0")
    value = numbers if count else numbers[0]
    object.__setattr__(force, key, value)
    return value


def take_rates(force: ForceElement, count: int = 0) -> None:
    """Check stiffness and damping: not negative, not both zero.

    Raises
    ------
    InputError
        If one is negative or not finite, or both are zero.
    """
    given = [take(force, key, count, 0.0) for key in ("stiffness", "damping")]
    if not np.any(given):
        raise fault(
            force, "stiffness and damping are zero", "Give one of them, or remove the element"
        )


def moving_joint(force: ForceElement, model: pin.Model, name: str) -> Any:
    """Pinocchio's joint ``name``, on which ``force`` acts.

    Raises
    ------
    InputError
        If there is no such moving joint; the message lists those there are.
    """
    names = list(model.names)[1:]
    if name not in names:
        raise fault(
            force, f"there is no moving joint {name!r}", f"Known: {', '.join(names) or 'none'}"
        )
    return model.joints[model.getJointId(name)]


def take_law(force: ForceElement, count: int) -> bool:
    """Check the law of ``force``, one or ``count`` of them; whether there is any.

    Raises
    ------
    InputError
        If it is no law, or there is another number of them.
    """
    law = getattr(force, "law")  # noqa: B009 - the fields of subclasses
    if law is None:
        return False
    laws = tuple(law) if isinstance(law, list | tuple) else (law,)
    if len(laws) not in (1, count) or not all(isinstance(each, Law) for each in laws):
        raise fault(
            force, "law is not a law", f"Give srm.Sine(...) or alike, or a list of {count} of them"
        )
    object.__setattr__(force, "law", laws[0] if len(laws) == 1 else laws)
    return True
