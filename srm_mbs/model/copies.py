"""Frozen dataclasses: copies with other attributes, of which a sweep makes many, and their text."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

Copied = TypeVar("Copied")


def copied(one: Copied, **changed: Any) -> Copied:
    """A copy of ``one`` with other attributes, without its constructor and its checks, which take
    several times as long; what it computed and keeps as attributes, the copy has, too."""
    out, set_ = object.__new__(type(one)), object.__setattr__
    for name, value in (vars(one) | changed).items():
        set_(out, name, value)
    return out


def short_repr(one: Any) -> str:
    """Class and fields of ``one``, without those that have their defaults, of which a closure or a
    drive has many."""
    values = ((entry.name, getattr(one, entry.name), entry.default) for entry in fields(one))
    shown = (
        f"{name}={value!r}"
        for name, value, default in values
        if not (value is default or (type(value) is type(default) and value == default))
    )
    return f"{type(one).__name__}({', '.join(shown)})"
