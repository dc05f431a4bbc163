"""The cases of a sweep: every accepted form, as a list of named parameter sets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, safe_repr
from srm_mbs.model.mechanism import variant_maker
from srm_mbs.model.numbers import plain

STARTS = ("q0", "v0", "q", "v")
"""Parameters of the start of a given mechanism."""
RESERVED = ("case", "success", "status", "message")
"""Columns of every table, which no parameter or measure may have."""


@dataclass(frozen=True)
class Case:
    """One run of a sweep.

    Attributes
    ----------
    index
        Position among the cases.
    name
        Key in a mapping of cases; otherwise ``index``.
    parameters
        Name -> value.
    """

    index: int
    name: int | str
    parameters: Mapping[str, Any]

    @property
    def where(self) -> str:
        """Place of the case in messages."""
        return f"cases[{safe_repr(self.name)}]"


def varied(source: Mechanism | Callable[..., Any]) -> tuple[str, ...]:
    """Names of the parameters of a description that cases of ``source`` may vary."""
    if not isinstance(source, Mechanism) or variant_maker(source) is None:
        return ()
    return tuple(name for name in source.parameters if name not in STARTS)


def listed(
    source: Mechanism | Callable[..., Any], cases: Any, columns: Any = None, *, free: bool
) -> tuple[Case, ...]:
    """``cases`` in order, checked.

    Parameters
    ----------
    columns
        Further parameters of the cases, name -> a value for each; ``cases`` may then be None.
    free
        Whether parameters of any name are allowed for a given mechanism.

    Raises
    ------
    InputError
        If there are no cases, or one of them, which the message names, is malformed.
    """
    if cases is None and columns is not None:
        found = _from_columns(columns)
    elif isinstance(cases, Mapping):
        found = _from_mapping(cases)
    elif isinstance(cases, Iterable) and not isinstance(cases, str | bytes):
        try:
            found = list(enumerate(cases))
        except Exception:  # objects may raise anything
            found = []
    else:
        found = []
    if cases is not None and columns is not None:
        found = _joined(found, _from_columns(columns))
    out = []
    for index, (name, parameters) in enumerate(found):
        case = Case(index, name, parameters)
        if not isinstance(parameters, Mapping) or not all(isinstance(k, str) for k in parameters):
            raise InputError(
                f"{safe_repr(parameters)} is not a set of parameters",
                element=case.where,
                remedy="Give a dictionary: name of a parameter -> value",
            )
        _check_names(case, source, free)
        out.append(Case(index, name, {plain(k): value for k, value in parameters.items()}))
    if not out:
        raise InputError(
            f"there are no cases in {safe_repr(cases)}",
            element="cases",
            remedy="Give a list of dictionaries, a mapping of names to them, or one of columns",
        )
    return tuple(out)


def _from_mapping(cases: Mapping[Any, Any], element: str = "cases") -> list[tuple[int | str, Any]]:
    """Named cases, or the rows of columns."""
    if all(isinstance(value, Mapping) for value in cases.values()):
        return [(_label(name), cases[name]) for name in cases]
    columns = {name: values for name, values in cases.items() if not np.isscalar(values)}
    try:
        lengths = {name: len(values) for name, values in columns.items()}
    except Exception:  # objects may raise anything
        lengths = {}
    if len(lengths) < len(cases) or len(set(lengths.values())) != 1:
        raise InputError(
            f"the columns have the lengths {lengths}" if lengths else "these are not columns",
            element=element,
            remedy="Give every parameter an array with one entry, or row, per case",
        )
    count = next(iter(lengths.values()))
    return [(k, {name: values[k] for name, values in columns.items()}) for k in range(count)]


def _from_columns(columns: Any) -> list[tuple[int | str, Any]]:
    """The rows of ``parameters``."""
    if not isinstance(columns, Mapping) or not columns:
        raise InputError(
            f"parameters = {safe_repr(columns)} are not columns",
            element="parameters",
            remedy="Give a dictionary: name of a parameter -> a value for each case",
        )
    for name in columns:
        if name in STARTS:
            raise InputError(
                f"{safe_repr(name)} is the start of a case, not a parameter of its mechanism",
                element="parameters",
                remedy="Give it in the cases, or rename the parameter",
            )
    return _from_mapping(columns, "parameters")


def _joined(
    cases: list[tuple[int | str, Any]], rows: list[tuple[int | str, Any]]
) -> list[tuple[int | str, Any]]:
    """The cases, each with the parameters of its row."""
    if len(cases) != len(rows):
        raise InputError(
            f"there are {len(cases)} cases and {len(rows)} values of each parameter",
            element="parameters",
            remedy="Give every parameter a value for each case",
        )
    out = []
    for (name, case), (_, more) in zip(cases, rows):
        if isinstance(case, Mapping):
            if twice := [key for key in more if key in case]:
                raise InputError(
                    f"{safe_repr(twice[0])} is given in the cases as well",
                    element="parameters",
                    remedy="Keep one of the two",
                )
            case = {**case, **more}
        out.append((name, case))
    return out


def _label(name: Any) -> int | str:
    """The key of a case as its name."""
    if isinstance(name, int):
        return name
    try:
        return plain(str(name))
    except Exception:  # objects may raise anything
        return safe_repr(name)


def _check_names(case: Case, source: Mechanism | Callable[..., Any], free: bool) -> None:
    names = set(case.parameters)
    if reserved := sorted(names & set(RESERVED)):
        raise InputError(
            f"{safe_repr(reserved[0])} is a column of every table",
            element=case.where,
            remedy="Give the parameter another name",
        )
    if not isinstance(source, Mechanism):
        return
    own = varied(source)
    unknown = sorted(names - {*STARTS, *own})
    if unknown and not free:
        raise InputError(
            f"a given mechanism has no parameter {safe_repr(unknown[0])}",
            element=case.where,
            remedy=f"Give {', '.join((*STARTS, *own))}; for others a function that makes the "
            "mechanism of a case instead of the mechanism, or options=",
        )
    if names & {"q", "v"} and names & {"q0", "v0"}:
        raise InputError(
            "it has a complete state (q0, v0) and values to assemble one from (q, v)",
            element=case.where,
            remedy="Give one of the two",
        )
