"""Copies with other attributes, for objects of which a sweep makes many."""

from __future__ import annotations

from typing import Any, TypeVar

Copied = TypeVar("Copied")


def copied(one: Copied, **changed: Any) -> Copied:
    """A copy of ``one`` with other attributes, without its constructor and its checks, which take
    several times as long; what it computed and keeps as attributes, the copy has, too."""
    out, set_ = object.__new__(type(one)), object.__setattr__
    for name, value in (vars(one) | changed).items():
        set_(out, name, value)
    return out
