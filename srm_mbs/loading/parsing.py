"""From the text of a description to its tables, and the words for what is wrong in it.

Unknown keys, wrong types and non-finite numbers become one :class:`InputError` that names the
file, the key and the remedy.
"""

from __future__ import annotations

import tomllib
from typing import Any, get_args

from pydantic import ValidationError

from srm_mbs.closures import CLOSURE_TYPES
from srm_mbs.errors import InputError
from srm_mbs.forces import FORCE_TYPES
from srm_mbs.loading.description import Description
from srm_mbs.loading.entries import FORCE_ENTRIES, StrictEntry
from srm_mbs.loading.translation import MODEL_KEYS

PROBLEMS: dict[str, tuple[str | None, str]] = {
    "string_type": ("a text is wanted", "Put it in quotes"),
    "list_type": ("a list is wanted", "Write [...], or [[...]] above each table of a list"),
    "dict_type": ("a table is wanted", "Write { key = value } or [...] above its keys"),
    "model_attributes_type": ("a table is wanted", "Write { key = value } or [...] above its keys"),
    "model_type": ("a table is wanted", "Write { key = value } or [...] above its keys"),
    "number": (None, "Give a finite number"),
    "greater_than": (None, "Give a positive number"),
    "too_short": (None, "Give the right number of values"),
    "too_long": (None, "Give the right number of values"),
    "literal_error": (None, "Choose one of those"),
    "bool_type": ("true or false is wanted", "Write true or false without quotes"),
}
"""By pydantic's type of error: the problem (None: pydantic's own words) and the remedy."""


def parse_description(text: str, file: str) -> Description:
    """Parse and check the TOML ``text`` of ``file``.

    Raises
    ------
    InputError
        Naming the file, the key or line, and the remedy.
    """
    try:
        raw = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # an endless integer, nesting without end
        raise InputError(
            f"this is not valid TOML: {error}",
            file=file,
            remedy="Correct it there; text stands in quotes, lists in [ ]",
        ) from error
    try:
        description = Description.model_validate(raw)
    except ValidationError as error:
        key, problem, remedy = _explain(error)
        if key == "format":
            remedy = "Write: format = 1"
        raise InputError(problem, file=file, element=key, remedy=remedy) from error
    given = [key for key in MODEL_KEYS if getattr(description, key) is not None]
    if len(given) != 1:
        raise InputError(
            f"{' and '.join(given)} are both given" if given else "this key is missing",
            file=file,
            element=given[0] if given else "urdf",
            remedy=f"Give one of {', '.join(MODEL_KEYS)}",
        )
    for i, entry in enumerate(description.loop):
        if entry.type not in CLOSURE_TYPES:
            raise InputError(
                f"there is no closure type {entry.type!r}",
                file=file,
                element=f"loop[{i}].type",
                remedy=f"Known: {', '.join(CLOSURE_TYPES)}",
            )
        for side in "ab":
            if side in CLOSURE_TYPES[entry.type].needs and getattr(entry, side) is None:
                raise InputError(
                    "this key is missing", file=file, element=f"loop[{i}].{side}", remedy="Add it"
                )
    return description


def _location(error: Any) -> tuple[int | str, ...]:
    """Where an error is, without the type of force that pydantic puts behind its number."""
    location: tuple[int | str, ...] = error["loc"]
    if location[:1] == ("force",) and len(location) > 2 and location[2] in FORCE_TYPES:
        return (*location[:2], *location[3:])
    return location


def _key_path(location: tuple[int | str, ...]) -> str:
    path = ""
    for part in location:
        if isinstance(part, int):
            path += f"[{part}]"
        else:
            path += f".{part}" if path else part
    return path


def _known_keys(location: tuple[int | str, ...]) -> str:
    """Keys of the table that holds ``location``, a location of pydantic's."""
    table: type[StrictEntry] = Description
    if location[0] == "force" and len(location) > 2:
        table = FORCE_ENTRIES[str(location[2])]
    for part in location[:-1]:
        if isinstance(part, int) or part not in table.model_fields:
            continue
        annotation = table.model_fields[part].annotation
        for choice in (annotation, *get_args(annotation)):
            if isinstance(choice, type) and issubclass(choice, StrictEntry):
                table = choice
    return ", ".join(table.model_fields)


def _explain(error: ValidationError) -> tuple[str, str, str]:
    """Key, problem and remedy of the first thing that is wrong."""
    first = error.errors()[0]
    location = _location(first)
    key = _key_path(location)
    if first["type"] == "extra_forbidden":
        name = str(location[-1])
        return key, f"unknown key {name!r}", f"Known: {_known_keys(first['loc'])}"
    if first["type"] == "union_tag_not_found":
        return f"{key}.type", "this key is missing", f"Known: {', '.join(FORCE_TYPES)}"
    if first["type"] == "union_tag_invalid":
        tag = first["input"]["type"]
        known = f"Known: {', '.join(FORCE_TYPES)}"
        return f"{key}.type", f"there is no force type {_shown(tag)}", known
    if first["type"] == "missing":
        return key, "this key is missing", "Add it"
    message = f"{first['msg'][0].lower()}{first['msg'][1:]}"
    problem, remedy = PROBLEMS.get(first["type"], (None, "Correct the value"))
    if location[0] == "initial" and first["type"] == "number":
        remedy = "Give a finite number, or a list of them for a joint with several coordinates"
    return key, f"{problem or message}, not {_shown(first.get('input'))}", remedy


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python prints no integer of more than 4300 digits
        return "this one"
    return text if len(text) < 60 else text[:57] + "..."
