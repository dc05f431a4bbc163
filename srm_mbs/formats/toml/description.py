"""A whole description: from its text to checked tables, and from these to elements.

Unknown keys, wrong types and numbers that are not finite become one :class:`InputError` that names
the file, the key and the remedy.  The keys themselves are in :mod:`srm_mbs.formats.toml.schema`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, Self, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from srm_mbs.errors import InputError, known_names, naming
from srm_mbs.formats.csv_table import CsvFolder
from srm_mbs.formats.files import check_name, shortened
from srm_mbs.formats.toml.schema import (
    CSV_KEYS,
    FORCE_ENTRIES,
    LAW_KEYS,
    TABLE_KEYS,
    AnchorEntry,
    StrictEntry,
    TopEntry,
)
from srm_mbs.formats.translation import MODEL_KEYS, PLANAR
from srm_mbs.formats.xml import parse_numbers
from srm_mbs.model.actuators import Actuator, naming_actuator
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import CLOSURE_TYPES, LoopClosure
from srm_mbs.model.drives import Drive
from srm_mbs.model.forces import FORCE_TYPES, ForceElement
from srm_mbs.model.laws import LAW_TYPES, Law, Polynomial, Samples, Table
from srm_mbs.model.reach import Reach

Element = TypeVar("Element")

COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
"""Columns of the table of a wrench; those that are missing are zero."""


class Description(TopEntry):
    """A whole description: the keys of :class:`~srm_mbs.formats.toml.schema.TopEntry`."""

    @property
    def model_file(self) -> tuple[str, str]:
        """Key and path of the file that holds the links and joints."""
        return next((key, name) for key in MODEL_KEYS if (name := getattr(self, key)) is not None)

    def closures(self) -> tuple[LoopClosure, ...]:
        """The loop closures.

        Raises
        ------
        InputError
            For an unknown type, a wrong axis, or an anchor without link or frame.
        """
        return self._elements("loop", lambda values: LoopClosure(**values))

    def refuse_identical_closures(self) -> None:
        """Refuse two closures that are the same but for their names, before any analysis.

        Raises
        ------
        InputError
            Naming both.
        """
        first: dict[str, tuple[str, str]] = {}
        for i, entry in enumerate(self.loop):
            label = f"loop {entry.name!r}" if entry.name else f"loop[{i}]"
            same = repr([value for key, value in entry if key != "name"])
            other, name = first.setdefault(same, (label, entry.name))
            # Equal names are another error.
            if other != label and not (name and name == entry.name):
                raise InputError(
                    f"it is the same closure as {other}", element=label, remedy="Remove one of them"
                )

    def coupled_joints(self) -> frozenset[str]:
        """Names of the joints whose angles count turns: those that take part in a coupling, or in a
        spring on several joints, or have a position servo."""
        together = [*self.loop, *(entry for entry in self.force if hasattr(entry, "joints"))]
        servos = {entry.joint for entry in self.actuators.values() if entry.kp}
        return frozenset(servos).union(*(entry.joints or () for entry in together))

    def with_locked(self, joints: Collection[str]) -> Self:
        """The same description with ``joints`` locked as well, and without their couplings."""
        loops = [entry for entry in self.loop if not set(joints).intersection(entry.joints or ())]
        lock = [*self.lock, *(name for name in joints if name not in self.lock)]
        return self.model_copy(update={"loop": loops, "lock": lock})

    def anchors(self) -> Iterator[tuple[str, Any]]:
        """Every anchor with its key, ``loop[0].a`` for example."""
        for kind in ("loop", "force", "drive"):
            for i, entry in enumerate(getattr(self, kind)):
                for key, value in entry:
                    if isinstance(value, AnchorEntry):
                        yield f"{kind}[{i}].{key}", value
        yield from ((f"points.{name}", anchor) for name, anchor in self.points.items())

    def named_points(self) -> dict[str, Anchor]:
        """The points of ``[points]`` by name.

        Raises
        ------
        InputError
            For an anchor without link or frame.
        """
        return {name: _anchor(f"points.{name}", "", entry) for name, entry in self.points.items()}

    def named_actuators(self) -> tuple[dict[str, Actuator], tuple[str, ...]]:
        """The actuators of ``[actuators]`` by name, without those of locked joints, and a note
        about these.

        Raises
        ------
        InputError
            For a value that an actuator cannot take.
        """
        found: dict[str, Actuator] = {}
        for name, entry in self.actuators.items():
            with naming_actuator(name):
                found[name] = Actuator(**dict(entry))
        idle = [name for name, actuator in found.items() if actuator.joint in self.lock]
        if not idle:
            return found, ()
        return {name: one for name, one in found.items() if name not in idle}, (
            f"actuators of joints that are locked are left out: {', '.join(map(repr, idle))}",
        )

    def force_elements(self, tables: CsvFolder | None) -> tuple[ForceElement, ...]:
        """The force elements; without ``tables`` those that follow a law are left out.

        Raises
        ------
        InputError
            For a value that an element cannot take, an anchor without link or frame, or a table
            that cannot be read.
        """

        def make(values: dict[str, Any]) -> ForceElement | None:
            kind = values.pop("type")
            if kind in CSV_KEYS:
                if tables is None and (values["law"] or values["table"]):
                    return None
                values = _with_law(kind, values, tables or CsvFolder(Path(), Reach()))
            made: ForceElement = FORCE_TYPES[kind](**values)
            return made

        return tuple(force for force in self._elements("force", make) if force is not None)

    def drives(self, tables: CsvFolder) -> tuple[Drive, ...]:
        """The drives.

        Raises
        ------
        InputError
            For a law or value that a drive cannot take, or a table that cannot be read.
        """

        def make(values: dict[str, Any]) -> Drive:
            law = _law({key: values.pop(key) for key in LAW_KEYS}, tables)
            return Drive(law, **values)

        return self._elements("drive", make)

    def _elements(
        self, kind: str, make: Callable[[dict[str, Any]], Element]
    ) -> tuple[Element, ...]:
        """The elements that ``make`` constructs from the tables ``[[kind]]``; errors name them."""
        out = []
        for i, entry in enumerate(getattr(self, kind)):
            name = entry.name or (kind == "drive" and entry.joint)
            label = f"{kind} {name!r}" if name else f"{kind}[{i}]"
            try:
                out.append(make(_with_anchors(label, entry)))
            except InputError as error:
                if not (error.element or "").startswith(kind):
                    error.element = f"{label}: {error.element}" if error.element else label
                raise
        return tuple(out)


def _with_anchors(label: str, entry: BaseModel) -> dict[str, Any]:
    """The keys of an element, with :class:`Anchor` in place of the tables of anchors."""
    return {
        key: _anchor(label, key, value) if isinstance(value, AnchorEntry) else value
        for key, value in entry
    }


def _anchor(label: str, side: str, entry: Any) -> Anchor:
    try:
        return Anchor(**dict(entry))
    except InputError as error:
        what = "" if error.element == "anchor" else f": {error.element}"
        error.element = f"{label}, anchor {side}{what}" if side else f"{label}{what}"
        raise


# -- laws ------------------------------------------------------------------------------------


def _law(entry: Mapping[str, Any], tables: CsvFolder) -> Law:
    """The law of ``entry``, keys and their values, None for those that are not given.

    Raises
    ------
    InputError
        For an unknown type, a key that the type needs or does not take, or a malformed table.
    """
    kind = LAW_TYPES.get(entry["type"])
    if kind is None:
        raise InputError(
            f"there is no law of type {entry['type']!r}",
            remedy=known_names(LAW_TYPES),
        )
    given = {key: value for key, value in entry.items() if key != "type" and value is not None}
    keys = fields(kind)  # type: ignore[arg-type]
    accepted = [*(key.name for key in keys), *(TABLE_KEYS if kind is Table else ())]
    for key in given:
        if key not in accepted:
            raise InputError(
                f"a law of type {kind.type!r} takes no {key}",
                remedy=known_names(accepted),
            )
    if kind is Table and "table" in given:
        if "t" in given or "values" in given:
            raise InputError(
                "the values are given twice", remedy="Give table, or t and values, not both"
            )
        return _table_law(given, tables)
    _refuse_columns(given)
    missing = [key.name for key in keys if key.default is MISSING and key.name not in given]
    if missing:
        raise InputError(
            f"a law of type {kind.type!r} needs {' and '.join(missing)}",
            remedy='Give them, or table = "file.csv"' if kind is Table else "Add it",
        )
    return kind(**given)


def _table_law(keys: Mapping[str, Any], tables: CsvFolder) -> Table:
    """The law of the columns, by default t and value, of a table in a CSV file."""
    names = (keys.get("time") or "t", keys.get("value") or "value")
    # Nothing changes the numbers of a table: laws share them.
    return Table(*map(Samples, tables.table(keys["table"]).columns(names).T))


def _refuse_columns(given: Mapping[str, Any]) -> None:
    """Refuse the names of columns where there is no table."""
    for key in TABLE_KEYS[1:]:
        if given.get(key) is not None:
            raise InputError(
                f"{key} names a column, but there is no table", remedy='Give table = "file.csv"'
            )


def _with_law(kind: str, values: Mapping[str, Any], tables: CsvFolder) -> dict[str, Any]:
    """The keys of a torque or wrench with its law made, in place of those of its table.

    Raises
    ------
    InputError
        If law and table are both given, neither of them nor a torque, or a table is malformed.
    """
    out = {key: value for key, value in values.items() if key not in TABLE_KEYS}
    if values["law"] is not None:
        if any(values.get(key) is not None for key in TABLE_KEYS):
            raise InputError("law and table are given", remedy="Give one of them")
        out["law"] = _law(dict(values["law"]), tables)
    elif values["table"] is None:
        _refuse_columns(values)
        if kind == "torque" and values["torque"] is None:
            raise InputError("there is no torque", remedy="Give torque, law or table")
    elif kind == "torque":
        out["law"] = _table_law(values, tables)
    else:
        out["law"] = _wrench_laws(values["table"], values["time"], tables)
    return out


def _wrench_laws(file: str, time: str | None, tables: CsvFolder) -> tuple[Law, ...]:
    """The six laws of a wrench from the columns that its table has."""
    table = tables.table(file)
    there = [name for name in COMPONENTS if name in table.names]
    if not there:
        raise InputError(
            f"the table has none of the columns {', '.join(COMPONENTS)}",
            file=table.file,
            remedy="Name the columns of force and moment in the first line",
        )
    t, *columns = map(Samples, table.columns((time or "t", *there)).T)
    laws: dict[str, Law] = {name: Table(t, column) for name, column in zip(there, columns)}
    return tuple(laws.get(name, Polynomial([0.0])) for name in COMPONENTS)


LARGEST_DESCRIPTION = 16 * 10**6
"""Characters of a description."""
LARGEST_KEY_DEPTH = 50
"""Parts of a dotted key."""
LARGEST_VALUE_DEPTH = 50
"""Tables and lists in each other."""
_KEY_PART = r"""(?>[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
TABLE_TWICE = re.compile(r"Cannot declare .* twice", re.DOTALL)
"""Message of tomllib about a second [loop], which is meant as [[loop]]."""
ESCAPE = re.compile(r"Unescaped '\\'|Invalid hex value")
"""Messages of tomllib about what a backslash begins in double quotes, as in C:/Users of Windows."""
DEEP_KEY = re.compile(rf"(?<![A-Za-z0-9_-])(?>{_KEY_PART}[ \t]*+\.[ \t]*+){{{LARGEST_KEY_DEPTH}}}")
"""Keys with more parts than that, for which the time of tomllib grows as their square."""

# -- text to tables --------------------------------------------------------------------------


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """The tables of the TOML ``text`` of ``file``.

    Raises
    ------
    InputError
        If it is not valid TOML.
    """
    if len(text) > LARGEST_DESCRIPTION:
        raise InputError(
            f"the description has more than {LARGEST_DESCRIPTION / 1e6:.0f} MB",
            file=file,
            remedy='Put long tables of numbers into CSV files: table = "file.csv"',
        )
    if DEEP_KEY.search(text):
        raise InputError(
            f"a key has more than {LARGEST_KEY_DEPTH} parts",
            file=file,
            remedy="Give a key of a description",
        )
    try:
        entries = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # an endless integer, nesting without end
        remedy = (
            "Correct it there; text stands in quotes, as keys with blanks or accents do, "
            "lists in [ ]"
        )
        if TABLE_TWICE.match(str(error)):
            remedy = (
                "Write double brackets above each table of a list, as [[loop]], and other tables "
                "once"
            )
        elif ESCAPE.match(str(error)):
            remedy = r"Write / instead of \ in paths, or the text in single quotes"
        raise InputError(
            f"this is not valid TOML: {_without_quotes(error)}", file=file, remedy=remedy
        ) from error
    with naming(file=file):
        _check_texts(entries)
    return entries


def _without_quotes(error: Exception) -> str:
    """The message of ``tomllib``, which may quote the file, with the position."""
    words, at, position = str(error).rpartition(" (at ")
    return f"{shortened(words)}{at}{position}" if at else shortened(position)


def _check_texts(entries: Mapping[str, Any]) -> None:
    """Refuse keys and texts that :func:`~srm_mbs.formats.files.check_name` refuses (all texts are
    names or paths), and values nested deeper than :data:`LARGEST_VALUE_DEPTH`."""
    level: list[tuple[str, Any]] = list(entries.items())
    for key in entries:
        check_name(key, "a key")
    for _ in range(LARGEST_VALUE_DEPTH):
        inner: list[tuple[str, Any]] = []
        for name, value in level:
            if isinstance(value, str):
                check_name(value, name)
            elif isinstance(value, dict):
                for key in value:
                    check_name(key, name)
                inner.extend((name, part) for part in value.values())
            elif isinstance(value, list):
                inner.extend((name, part) for part in value)
        level = inner
    if level:
        raise InputError(
            f"more than {LARGEST_VALUE_DEPTH} values are nested",
            element=level[0][0],
            remedy="Remove what no description has",
        )


def check_description(entries: Mapping[str, Any], file: str) -> Description:
    """The tables of a description, as ``tomllib`` gives them, checked.

    Raises
    ------
    InputError
        Naming the file, the key and the remedy.
    """
    try:
        description = Description.model_validate(entries)
    except ValidationError as error:
        key, problem, remedy = _explain(error)
        key = _with_names(key, entries)
        if key == "format":
            remedy = "Write: format = 1"
        raise InputError(problem, file=file, element=key, remedy=remedy) from error
    sources = (*MODEL_KEYS, PLANAR)
    given = [key for key in sources if getattr(description, key) is not None]
    if len(given) != 1:
        raise InputError(
            f"{' and '.join(given)} are both given" if given else "this key is missing",
            file=file,
            element=given[0] if given else "urdf",
            remedy=f"Give one of {', '.join(sources)}",
        )
    for i, entry in enumerate(description.loop):
        if entry.type not in CLOSURE_TYPES:
            raise InputError(
                f"there is no closure type {entry.type!r}",
                file=file,
                element=f"loop[{i}].type",
                remedy=known_names(CLOSURE_TYPES),
            )
        for side in "ab":
            if side in CLOSURE_TYPES[entry.type].needs and getattr(entry, side) is None:
                raise InputError(
                    "this key is missing", file=file, element=f"loop[{i}].{side}", remedy="Add it"
                )
    return description


# -- messages of pydantic in terms of the file -----------------------------------------------

PROBLEMS: dict[str, tuple[str | None, str]] = {
    "string_type": ("a text is wanted", "Put it in quotes"),
    "list_type": ("a list is wanted", "Write [...]"),
    "dict_type": ("a table is wanted", "Write { key = value } or [...] above its keys"),
    "model_attributes_type": ("a table is wanted", "Write { key = value } or [...] above its keys"),
    "model_type": ("a table is wanted", "Write { key = value } or [...] above its keys"),
    "number": (None, "Give a finite number"),
    "greater_than": (None, "Give a positive number"),
    "greater_than_equal": (None, "Give a number of at least 0"),
    "massless": (None, 'Write "fix", or { mass = m, inertia = I } with positive numbers'),
    "direction": (None, "Give an angle, [x, y], or the names of two points"),
    "literal_error": (None, "Choose one of those"),
    "bool_type": ("true or false is wanted", "Write true or false without quotes"),
}
"""By pydantic's type of error: the problem (None: pydantic's own words) and the remedy."""


def _explain(error: ValidationError) -> tuple[str, str, str]:
    """Key, problem and remedy of the first error."""
    errors = error.errors()
    first = errors[0]
    if first["type"] == "missing":  # an unknown key beside it is that key, mistyped
        beside = (e for e in errors if e["type"] == "extra_forbidden" and _beside(e, first))
        first = next(beside, first)
    location = _location(first)
    key = _key_path(location)
    if first["type"] == "extra_forbidden":
        name = str(location[-1])
        return key, f"unknown key {name!r}", f"Known: {_known_keys(first['loc'])}"
    if first["type"] == "union_tag_not_found":
        return f"{key}.type", "this key is missing", known_names(FORCE_TYPES)
    if first["type"] == "union_tag_invalid":
        tag = first["input"]["type"]
        known = known_names(FORCE_TYPES)
        return f"{key}.type", f"there is no force type {_shortened(tag)}", known
    if first["type"] == "missing":
        return key, "this key is missing", "Add it"
    if first["type"] in ("too_short", "too_long"):  # lists have one length
        (count,) = {first["ctx"].get(bound) for bound in ("min_length", "max_length")} - {None}
        given = _shortened(first.get("input"))
        return key, f"{count} values are wanted, not {given}", f"Give {count} values"
    message = f"{first['msg'][0].lower()}{first['msg'][1:]}"
    problem, remedy = PROBLEMS.get(first["type"], (None, "Correct the value"))
    if first["type"] == "list_type" and isinstance(first.get("input"), dict):
        remedy = "Write [[...]] above each table of the list"
    elif first["type"] == "list_type" and isinstance(first.get("input"), str):
        numbers = parse_numbers(first["input"].replace(",", " "))
        remedy = f"Write [{', '.join(f'{x:g}' for x in numbers)}]" if numbers else remedy
    if location[0] == "initial" and first["type"] == "number":
        remedy = "Give a finite number, or a list of them for a joint with several coordinates"
    return key, f"{problem or message}, not {_shortened(first.get('input'))}", remedy


def _beside(error: Any, other: Any) -> bool:
    """Whether two errors are about keys of one table."""
    return bool(error["loc"][:-1] == other["loc"][:-1])


def _location(error: Any) -> tuple[int | str, ...]:
    """The location of an error, without the type of force that pydantic adds after its number."""
    location: tuple[int | str, ...] = error["loc"]
    if location[:1] == ("force",) and len(location) > 2 and location[2] in FORCE_TYPES:
        return (*location[:2], *location[3:])
    return location


def _key_path(location: tuple[int | str, ...]) -> str:
    path = ""
    for part in location:
        path += f"[{part}]" if isinstance(part, int) else f".{part}"
    return path.removeprefix(".")


def _with_names(key: str, entries: Mapping[str, Any]) -> str:
    """A key of the section ``[planar]`` with the name of its bar or slider instead of a number."""
    found = re.match(r"planar\.(bar|slider)\[(\d+)\]", key)
    if found is None:
        return key
    table = entries[PLANAR][found[1]][int(found[2])]
    name = table.get("name") if isinstance(table, dict) else None
    return f"planar.{found[1]} {name!r}{key[found.end() :]}" if isinstance(name, str) else key


def _known_keys(location: tuple[int | str, ...]) -> str:
    """Keys of the table that holds ``location``, as pydantic gives it."""
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


def _shortened(value: Any) -> str:
    """``repr`` of a value for messages, at most 60 characters of it."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no integer of more than 4300 digits
        return "this one"
    return text if len(text) < 60 else text[:57] + "..."
