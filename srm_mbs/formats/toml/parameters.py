"""Parameters of a description, and arithmetic over them wherever a number stands.

A text that begins with ``=`` is an expression.  It is parsed by :mod:`ast` and evaluated node by
node, in floating point only: nothing but the operators, functions and constants listed here exists,
so that the file of a stranger can neither call Python nor make it compute without end.
"""

from __future__ import annotations

import ast
import keyword
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from functools import lru_cache
from typing import Any, NamedTuple

from pydantic import BaseModel

from srm_mbs.errors import InputError, counted, known_names, safe_repr
from srm_mbs.formats.files import shortened
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import LARGEST_MAGNITUDE, finite_number, named_values

LONGEST_EXPRESSION = 200
"""Characters of an expression, which bound how deep it is nested."""
MOST_PARAMETERS = 1000
"""Parameters of a description."""
DEEPEST_CHAIN = 50
"""Parameters of which each is an expression over the next."""
PARAMETERS = "parameters"
"""Key of the table of parameters, and the element of faults of values that are given instead."""
TABLE = "[parameters]"
"""The element of faults of the table."""

Place = tuple[str | int, ...]
"""Keys and indices that lead to a value of a description."""
Nested = dict[Any, Any]
"""Numbers of values of a description by their places, one table in the other."""

BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: math.pow,
}
UNARY: Mapping[type[ast.unaryop], Callable[[float], float]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
CONSTANTS: Mapping[str, float] = {"pi": math.pi}
FUNCTIONS: Mapping[str, tuple[Callable[..., float], int, int]] = {
    "sqrt": (math.sqrt, 1, 1),
    "sin": (math.sin, 1, 1),
    "cos": (math.cos, 1, 1),
    "tan": (math.tan, 1, 1),
    "atan2": (math.atan2, 2, 2),
    "abs": (abs, 1, 1),
    "min": (min, 2, LONGEST_EXPRESSION),
    "max": (max, 2, LONGEST_EXPRESSION),
    "radians": (math.radians, 1, 1),
    "degrees": (math.degrees, 1, 1),
}
"""Functions of expressions with their least and largest number of arguments; angles in rad."""


def is_expression(value: Any) -> bool:
    """Whether ``value`` of a description is an expression."""
    return isinstance(value, str) and value.startswith("=")


class Resolved:
    """A description whose expressions have values.

    Parameters
    ----------
    tables
        Its tables, as ``tomllib`` gives them; they are left as they are.
    given
        Values of parameters instead of those of the file.
    file
        Name of the file in messages.

    Attributes
    ----------
    numbers
        Of the expressions, in the order of :func:`expressions`.
    values
        Of all parameters.
    notes
        One about parameters that nothing uses, if there are any.

    Raises
    ------
    InputError
        Naming file, key, expression and remedy; also for a value of a parameter that is unknown or
        that nothing uses.
    """

    def __init__(self, tables: Mapping[str, Any], given: Mapping[str, float], file: str) -> None:
        self._tables = tables
        try:
            known = _Parameters(tables.get(PARAMETERS, {}), given)
            self.numbers = [
                known.evaluated(text, key) for text, key in _expressions(_Tables(tables)).texts
            ]
            self.values = known.values()
        except InputError as error:
            error.file = error.file or file
            raise
        idle = [name for name in self.values if name not in known.used]
        for name in given:
            if name in idle:
                raise InputError(
                    f"nothing in the description uses the parameter {name!r}",
                    file=file,
                    element=PARAMETERS,
                    remedy=f'Use it in an expression, as "={name}", or leave its value out',
                )
        names = ", ".join(map(repr, idle))
        self.notes = (f"no expression uses the parameters {names}",) if idle else ()

    @cached_property
    def entries(self) -> Mapping[str, Any]:
        """The tables with numbers in place of expressions, and without parameters; the same object
        if there are neither."""
        if not self.numbers and PARAMETERS not in self._tables:
            return self._tables
        rest = {key: value for key, value in self._tables.items() if key != PARAMETERS}
        changed = _expressions(_Tables(self._tables)).nested
        return dict(with_numbers(rest, changed, self.numbers))


class _Parameters:
    """The parameters of a description, evaluated when they are first used."""

    def __init__(self, table: Any, given: Mapping[str, float]) -> None:
        if not isinstance(table, dict):
            raise InputError(
                f"a table is wanted, not {shortened(safe_repr(table))}",
                element=TABLE,
                remedy="Write [parameters] above lines of the form crank = 0.268",
            )
        if len(table) > MOST_PARAMETERS:
            raise InputError(
                f"there are more than {MOST_PARAMETERS} parameters",
                element=TABLE,
                remedy="Remove some",
            )
        for name in table:
            if not name.isidentifier() or keyword.iskeyword(name) or name in _RESERVED:
                raise InputError(
                    f"{name!r} cannot be the name of a parameter",
                    element=TABLE,
                    remedy="Give a name of letters, digits and _, other than that of a function "
                    "or constant",
                )
        for name in given:
            if name not in table:
                raise InputError(
                    f"there is no parameter {safe_repr(name)}",
                    element=PARAMETERS,
                    remedy=known_names(table),
                )
        self._table: dict[str, Any] = {**table, **given}
        self._values: dict[str, float] = {}
        self._open: list[str] = []
        self.used: set[str] = set()

    def values(self) -> dict[str, float]:
        """All values, in the order of the file."""
        return {name: self._value(name) for name in self._table}

    def _value(self, name: str) -> float:
        """The value of a parameter that there is."""
        if name not in self._values:
            key = f"{PARAMETERS}.{name}"
            if name in self._open:
                circle = " -> ".join([*self._open[self._open.index(name) :], name])
                raise InputError(
                    f"the parameters depend on each other: {circle}",
                    element=key,
                    remedy="Give one of them a number",
                )
            if len(self._open) >= DEEPEST_CHAIN:
                raise InputError(
                    f"more than {DEEPEST_CHAIN} parameters are defined each by the next",
                    element=key,
                    remedy="Give one of them a number",
                )
            self._open.append(name)
            self._values[name] = self._defined(self._table[name], key)
            self._open.pop()
        return self._values[name]

    def _defined(self, value: Any, key: str) -> float:
        if is_expression(value):
            return self.evaluated(value, key)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not abs(value) <= LARGEST_MAGNITUDE:
            raise InputError(
                f"a finite number is wanted, not {shortened(safe_repr(value))}",
                element=key,
                remedy='Give a number, or an expression such as "=2*crank"',
            )
        return float(value)

    def evaluated(self, text: str, key: str) -> float:
        """The value of the expression ``text`` of ``key``."""
        if len(text) > LONGEST_EXPRESSION:
            raise InputError(
                f"the expression {_quoted(text)} has more than {LONGEST_EXPRESSION} characters",
                element=key,
                remedy="Split it into several parameters",
            )
        try:
            body = _parsed(text)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise InputError(
                f"{_quoted(text)} is not an expression",
                element=key,
                remedy='Write arithmetic, as "=2*crank" or "=sqrt(a**2 + b**2)"',
            ) from error
        try:
            value = self._node(body, text, key)
        except ArithmeticError as error:
            raise _no_value(text, key) from error
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise _no_value(text, key) from error
        if not abs(value) <= LARGEST_MAGNITUDE:
            raise _no_value(text, key)
        return value

    def _node(self, node: ast.expr, text: str, key: str) -> float:
        """The value of a node of the expression ``text``."""
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return float(number)
            case ast.Name(id=name) if name in CONSTANTS:
                return CONSTANTS[name]
            case ast.Name(id=name) if name in FUNCTIONS:
                raise InputError(
                    f"in {_quoted(text)} the function {name} has no arguments",
                    element=key,
                    remedy=f"Write {name}(...)",
                )
            case ast.Name(id=name):
                if name not in self._table:
                    raise InputError(
                        f"in {_quoted(text)} there is no parameter {name!r}",
                        element=key,
                        remedy=known_names(self._table),
                    )
                self.used.add(name)
                return self._value(name)
            case ast.BinOp(left=left, op=op, right=right) if type(op) in BINARY:
                return BINARY[type(op)](self._node(left, text, key), self._node(right, text, key))
            case ast.UnaryOp(op=sign, operand=operand) if type(sign) in UNARY:
                return UNARY[type(sign)](self._node(operand, text, key))
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                values = [self._node(each, text, key) for each in arguments]
                return self._call(name, values, text, key)
        power = isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor)
        raise InputError(
            f"{_quoted(text)} has something else than arithmetic",
            element=key,
            remedy="Write ** for powers"
            if power
            else f"Use numbers, parameters, + - * / ** ( ), and {', '.join(_RESERVED)}",
        )

    @staticmethod
    def _call(name: str, arguments: list[float], text: str, key: str) -> float:
        if name not in FUNCTIONS:
            raise InputError(
                f"in {_quoted(text)} there is no function {shortened(name)!r}",
                element=key,
                remedy=known_names(FUNCTIONS),
            )
        function, least, most = FUNCTIONS[name]
        if not least <= len(arguments) <= most:
            wanted = f"{least}" if least == most else f"at least {least}"
            raise InputError(
                f"in {_quoted(text)} the function {name} has {counted(len(arguments), 'argument')}",
                element=key,
                remedy=f"Give it {wanted}",
            )
        return float(function(*arguments))


class _Tables:
    """The tables of a description, as a key: variants of a description have the same object."""

    def __init__(self, entries: Mapping[str, Any]) -> None:
        self.entries = entries

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Tables) and self.entries is other.entries

    def __hash__(self) -> int:
        return id(self.entries)


class _Expressions(NamedTuple):
    """The expressions of a description, but for those of its parameters.

    Attributes
    ----------
    places, nested
        Where they are.
    texts
        Text and key, in words, of each.
    """

    places: tuple[Place, ...]
    nested: Nested
    texts: tuple[tuple[str, str], ...]


def expressions(entries: Mapping[str, Any]) -> tuple[Place, ...]:
    """Where the tables of a description have expressions, but for those of its parameters."""
    return _expressions(_Tables(entries)).places


@lru_cache(maxsize=4)
def _expressions(tables: _Tables) -> _Expressions:
    """The expressions of a description: variants have the same."""
    rest = {key: value for key, value in tables.entries.items() if key != PARAMETERS}
    found = dict(_places(rest, ()))
    texts = []
    for (first, *inner), text in found.items():
        parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in inner)
        texts.append((text, f"{first}{''.join(parts)}"))
    return _Expressions(tuple(found), nested(found), tuple(texts))


def nested(places: Iterable[Place]) -> Nested:
    """The numbers, from 0, of ``places``, for :func:`with_numbers`."""
    out: Nested = {}
    for number, place in enumerate(places):
        inside: Any = out
        for part in place[:-1]:
            inside = inside.setdefault(part, {})
        inside[place[-1]] = number
    return out


def with_numbers(tables: Any, changed: Nested, numbers: Sequence[float]) -> Any:
    """Tables, checked or not, with ``numbers`` in the places of :func:`nested`; what has none of
    these is not copied."""
    parts = {
        key: numbers[inner]
        if isinstance(inner, int)
        else with_numbers(
            getattr(tables, key) if isinstance(tables, BaseModel) else tables[key],
            inner,
            numbers,
        )
        for key, inner in changed.items()
    }
    if isinstance(tables, BaseModel):
        return tables.model_copy(update=parts)
    out = copy(tables)
    for key, value in parts.items():
        out[key] = value
    return out


def _places(value: Any, place: Place) -> Iterator[tuple[Place, str]]:
    """The places of expressions in a part of a description, and their texts."""
    if is_expression(value):
        yield place, value
    elif isinstance(value, dict):
        for name, part in value.items():
            yield from _places(part, (*place, name))
    elif isinstance(value, list):
        for i, part in enumerate(value):
            yield from _places(part, (*place, i))


@lru_cache(maxsize=MOST_PARAMETERS)
def _parsed(text: str) -> ast.expr:
    """The tree of an expression: variants of a description have the same."""
    return ast.parse(text[1:].strip(), mode="eval").body


_RESERVED = (*CONSTANTS, *FUNCTIONS)


def _quoted(text: str) -> str:
    """An expression in messages."""
    return repr(shortened(text))


def _no_value(text: str, key: str) -> InputError:
    return InputError(
        f"{_quoted(text)} has no finite value of sensible size",
        element=key,
        remedy="Correct the expression or the values of its parameters",
    )


def given_parameters(values: Any) -> dict[str, float]:
    """``values``, name -> number, as :func:`srm_mbs.load` takes them.

    Raises
    ------
    InputError
        If they are anything else.
    """
    out = {}
    for name, value in named_values(values, PARAMETERS).items():
        if not isinstance(name, str):
            raise InputError(
                f"{safe_repr(name)} is not the name of a parameter",
                element=PARAMETERS,
                remedy="Give a dictionary: name -> value",
            )
        shown = safe_repr(name)
        if isinstance(value, bool | str):
            raise InputError(
                f"the parameter {shown} = {safe_repr(value)} is not a finite number",
                element=PARAMETERS,
                remedy="Give a finite number",
            )
        number = finite_number(value, f"the parameter {shown}", PARAMETERS)
        if abs(number) > LARGEST_MAGNITUDE:
            raise InputError(
                f"the parameter {shown} = {number!r} is not a number of sensible size",
                element=PARAMETERS,
                remedy="Give a finite number of sensible size",
            )
        out[name] = number
    return out
