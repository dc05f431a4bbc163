"""Closures, forces, drives and laws as plain values for JSON, and back; no field is listed here.

An anchor is an object without ``type``, a law one with its ``type``; tuples are lists.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, TypeVar

from srm_mbs.model.anchors import Anchor
from srm_mbs.model.forces import FORCE_TYPES, ForceElement
from srm_mbs.model.laws import LAW_TYPES, Law

Element = TypeVar("Element")


def to_plain(element: Any) -> dict[str, Any]:
    """The fields of a closure, force or drive as JSON has them."""
    return {key.name: _plain(getattr(element, key.name)) for key in fields(element)}


def force_to_plain(force: ForceElement) -> dict[str, Any]:
    """:func:`to_plain` of a force, with its type."""
    return {"type": force.type} | to_plain(force)


def from_plain(kind: type[Element], values: Mapping[str, Any]) -> Element:
    """The element of the class ``kind`` from what :func:`to_plain` made of it."""
    return kind(**{key: _value(value) for key, value in values.items()})


def force_from_plain(values: Mapping[str, Any]) -> ForceElement:
    """The force from what :func:`force_to_plain` made of it."""
    rest = {key: _value(value) for key, value in values.items() if key != "type"}
    return FORCE_TYPES[values["type"]](**rest)


def _plain(value: Any) -> Any:
    if isinstance(value, Law):
        return {"type": value.type} | asdict(value)  # type: ignore[call-overload]
    if isinstance(value, Anchor):
        return asdict(value)
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


def _value(plain: Any) -> Any:
    if isinstance(plain, list):
        return tuple(map(_value, plain))
    if not isinstance(plain, Mapping):
        return plain
    if "type" not in plain:
        return Anchor(**plain)
    values = dict(plain)
    return LAW_TYPES[values.pop("type")](**values)
