"""Fingerprint of anything that can be pickled, equal in all processes, to recognise a sweep.

The bytes of a pickle depend on which equal objects are identical.  Here a value is divided as
pickle does, and every part is hashed by its contents.  The fingerprint of a function covers its
name, code, defaults, attributes, closure variables, and the global numbers, texts, tuples of these
and mechanisms that it reads, not the functions that it calls; that of an object that can be called
covers its ``__call__``, too.

``joblib.hash`` would not do: it pickles functions by name, so that it does not notice a changed
function and cannot hash a lambda, and it distinguishes lists from tuples and NumPy scalars from
Python's, which cases read from other sources mix.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.dynamics.mechanism import Mechanism

_IGNORED_FIELDS = ("name", "source", "defaults", "notes")
"""Fields of a mechanism that influence neither a run nor what is measured of it."""


def fingerprint(value: Any) -> str:
    """The fingerprint of ``value``, 32 hexadecimal digits.

    Raises
    ------
    TypeError, pickle.PicklingError
        If ``value`` has a part that cannot be pickled.
    """
    hashed = hashlib.blake2b(digest_size=16)
    _add(value, hashed.update, [])
    return hashed.hexdigest()


def _add(value: Any, put: Any, enclosing: list[int]) -> None:
    """Hash ``value``, which the objects with the ids ``enclosing`` contain."""
    if id(value) in enclosing:  # a reference to an enclosing object
        put(b"<again>%d" % enclosing.index(id(value)))
        return
    tag, parts = _parts(value)
    head = tag.encode()
    put(struct.pack("<q", len(head)) + head)
    if isinstance(parts, bytes):
        put(struct.pack("<q", len(parts)) + parts)
        return
    put(struct.pack("<q", len(parts)))
    enclosing.append(id(value))
    for part in parts:
        _add(part, put, enclosing)
    enclosing.pop()


def _parts(value: Any) -> tuple[str, bytes | list[Any]]:
    """A tag for the type of ``value``, and its contents: bytes, or further values."""
    if isinstance(value, np.generic):
        value = value.item()
    kind = type(value).__qualname__
    match value:
        case None | bool() | int() | str():
            return kind, repr(value).encode()
        case float():
            return kind, struct.pack("<d", value)
        case bytes():
            return kind, value
        case list() | tuple() if type(value) in (list, tuple):
            return "sequence", list(value)
        case set() | frozenset():
            return kind, sorted(fingerprint(part).encode() for part in value)
        case Mapping():
            # In the order of the fingerprints of the keys: the order of insertion does not count.
            items = sorted(value.items(), key=lambda item: fingerprint(item[0]))
            return "mapping", [part for item in items for part in item]
        case np.ndarray() if value.dtype != object:
            return "array", [str(value.dtype), value.shape, np.ascontiguousarray(value).tobytes()]
        case np.ndarray():
            return "objects", [value.shape, value.tolist()]
        case Mechanism():
            names = [field.name for field in fields(value) if field.name not in _IGNORED_FIELDS]
            return kind, [getattr(value, name) for name in names]
        case pin.Model():
            return kind, value.saveToString().encode()
        case type() | ModuleType() | BuiltinFunctionType():
            return "named", _name(value).encode()
        case FunctionType():
            cells = [cell.cell_contents for cell in value.__closure__ or ()]
            own = [value.__code__, value.__dict__, value.__defaults__, value.__kwdefaults__]
            return "function", [_name(value), *own, _constants(value), *cells]
        case MethodType():
            return "method", [value.__func__, value.__self__]
        case CodeType():
            # Cases are given by the names of arguments.
            arguments = value.co_varnames[: value.co_argcount + value.co_kwonlyargcount]
            code = [value.co_code, value.co_exceptiontable]
            return "code", [*code, arguments, value.co_names, *value.co_consts]
    if is_dataclass(value):  # without cached attributes
        parts = [getattr(value, field.name) for field in fields(value)]
    else:
        parts = _reduced(value)
    if callable(value) and isinstance(type(value).__call__, FunctionType):
        parts.append(type(value).__call__)
    return f"object {_name(type(value))}", parts


def _constants(function: FunctionType) -> dict[str, Any]:
    """The global constants that a function reads, by name."""
    names: set[str] = set()
    codes = [function.__code__]
    while codes:
        code = codes.pop()
        names.update(code.co_names)
        codes += [part for part in code.co_consts if isinstance(part, CodeType)]
    found = {name: function.__globals__.get(name) for name in names if not name.startswith("__")}
    return {name: value for name, value in found.items() if value is not None and _fixed(value)}


def _fixed(value: Any) -> bool:
    """Whether nothing changes a value: lists, for example, may count what was called."""
    if isinstance(value, tuple | frozenset):
        return all(map(_fixed, value))
    return isinstance(value, bool | int | float | str | bytes | Mechanism)


def _name(value: Any) -> str:
    return f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', value.__name__)}"


def _reduced(value: Any) -> list[Any]:
    """The parts of an object that pickle stores."""
    reduced = value.__reduce_ex__(4)
    if isinstance(reduced, str):
        return [reduced]
    make, arguments, state, items, pairs = (*reduced, None, None, None)[:5]
    state = dict(state) if isinstance(state, Mapping) else state
    return [make, arguments, state, list(items or ()), list(pairs or ())]
