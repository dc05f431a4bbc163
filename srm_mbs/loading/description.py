"""The schema of a mechanism description (TOML), checked with pydantic.

Unknown keys, wrong types and non-finite numbers become one :class:`InputError` that names the
file, the key and the remedy.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    StrictBool,
    StrictStr,
    ValidationError,
)
from pydantic_core import PydanticCustomError

from srm_mbs.anchors import Anchor
from srm_mbs.closures import CLOSURE_TYPES
from srm_mbs.drives import Drive
from srm_mbs.errors import InputError
from srm_mbs.force_element import ForceElement
from srm_mbs.forces import FORCE_TYPES
from srm_mbs.loading.laws import LAW_KEYS, law_from, with_law
from srm_mbs.loading.translation import MODEL_KEYS
from srm_mbs.loop_closure import LoopClosure
from srm_mbs.mechanism import FRICTION_SPEED

LARGEST = 1e30
"""Numbers beyond this have lost their meaning, and their squares may overflow."""


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise PydanticCustomError("number", "a finite number is wanted")
    if not abs(value) <= LARGEST:
        raise PydanticCustomError("number", "a finite number of sensible size is wanted")
    return float(value)


def _joint_value(value: Any) -> float | list[float]:
    if isinstance(value, list) and value:
        return [_number(part) for part in value]
    return _number(value)


Number = Annotated[float, PlainValidator(_number)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
SixNumbers = Annotated[list[Number], Field(min_length=6, max_length=6)]
JointValue = Annotated[float | list[float], PlainValidator(_joint_value)]
Base = Literal["fixed", "floating", "planar"]

PROBLEMS = {
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


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class AnchorEntry(_Strict):
    """``{ link = "rod", xyz = [...], rpy = [...] }``, or with ``frame`` instead of ``link``."""

    link: StrictStr | None = None
    frame: StrictStr | None = None
    xyz: Vector = [0.0, 0.0, 0.0]
    rpy: Vector = [0.0, 0.0, 0.0]


class LoopEntry(_Strict):
    """One ``[[loop]]``."""

    name: StrictStr = ""
    type: StrictStr
    a: AnchorEntry | None = None
    b: AnchorEntry | None = None
    axis: Vector | None = None
    axis_a: Vector | None = None
    axis_b: Vector | None = None
    length: Number | None = None
    joints: list[StrictStr] | None = None
    ratio: Number | None = None
    coefficients: list[Number] | None = None
    offset: Number | None = None


class ForceEntry(_Strict):
    """What every ``[[force]]`` has; ``type`` tells which of the following it is."""

    type: str
    name: StrictStr = ""


class SpringDamperEntry(ForceEntry):
    """A ``[[force]]`` of type ``spring_damper``; the keys are those of the element."""

    type: Literal["spring_damper"]
    a: AnchorEntry
    b: AnchorEntry
    stiffness: Number = 0.0
    damping: Number = 0.0
    rest_length: Number | None = None


class LawEntry(_Strict):
    """A law over time; which keys it takes depends on its type."""

    type: StrictStr
    speed: Number | None = None
    amplitude: Number | None = None
    frequency_hz: Number | None = None
    omega: Number | None = None
    phase: Number | None = None
    offset: Number | None = None
    coefficients: list[Number] | None = None
    target: Number | None = None
    duration: Number | None = None
    start: Number | None = None
    t: list[Number] | None = None
    values: list[Number] | None = None
    table: StrictStr | None = None
    time: StrictStr | None = None
    value: StrictStr | None = None


class TorqueEntry(ForceEntry):
    """A ``[[force]]`` of type ``torque``: a number, a law that multiplies it, or a table."""

    type: Literal["torque"]
    joint: StrictStr
    torque: JointValue | None = None
    law: LawEntry | None = None
    table: StrictStr | None = None
    time: StrictStr | None = None
    value: StrictStr | None = None


class TorsionSpringEntry(ForceEntry):
    """A ``[[force]]`` of type ``torsion_spring``."""

    type: Literal["torsion_spring"]
    joint: StrictStr
    stiffness: Number = 0.0
    damping: Number = 0.0
    rest_angle: Number = 0.0


class WrenchEntry(ForceEntry):
    """A ``[[force]]`` of type ``wrench``."""

    type: Literal["wrench"]
    at: AnchorEntry
    force: Vector = [0.0, 0.0, 0.0]
    moment: Vector = [0.0, 0.0, 0.0]
    frame: Literal["world", "link"] = "world"
    law: LawEntry | None = None
    table: StrictStr | None = None
    time: StrictStr | None = None


class LimitSpringEntry(ForceEntry):
    """A ``[[force]]`` of type ``limit_spring``."""

    type: Literal["limit_spring"]
    joint: StrictStr
    stiffness: Number
    damping: Number = 0.0
    lower: Number | None = None
    upper: Number | None = None
    depth: Number | None = None


class BushingEntry(ForceEntry):
    """A ``[[force]]`` of type ``bushing``."""

    type: Literal["bushing"]
    a: AnchorEntry
    b: AnchorEntry
    stiffness: SixNumbers = [0.0] * 6
    damping: SixNumbers = [0.0] * 6


AnyForceEntry = Annotated[
    SpringDamperEntry
    | TorqueEntry
    | TorsionSpringEntry
    | WrenchEntry
    | BushingEntry
    | LimitSpringEntry,
    Field(discriminator="type"),
]
FORCE_ENTRIES: dict[str, type[ForceEntry]] = {
    "spring_damper": SpringDamperEntry,
    "torque": TorqueEntry,
    "torsion_spring": TorsionSpringEntry,
    "wrench": WrenchEntry,
    "bushing": BushingEntry,
    "limit_spring": LimitSpringEntry,
}


class DriveEntry(LawEntry):
    """One ``[[drive]]``: what moves, and the keys of its law."""

    name: StrictStr = ""
    joint: StrictStr | None = None
    a: AnchorEntry | None = None
    b: AnchorEntry | None = None
    axis: Vector | None = None
    distance: StrictBool = False
    absolute: StrictBool = False


class InitialEntry(_Strict):
    """``[initial]``: held positions and rates, and guesses, by joint name."""

    q: dict[StrictStr, JointValue] = {}
    v: dict[StrictStr, JointValue] = {}
    guess: dict[StrictStr, JointValue] = {}


class SimulationEntry(_Strict):
    """``[simulation]``: defaults of the command line."""

    t_end: Annotated[Number, Field(gt=0)] | None = None
    rtol: Annotated[Number, Field(gt=0)] | None = None
    atol: Annotated[Number, Field(gt=0)] | None = None


class Description(_Strict):
    """A whole description."""

    format: Literal[1]
    name: StrictStr = ""
    urdf: StrictStr | None = None
    sdf: StrictStr | None = None
    mjcf: StrictStr | None = None
    cut: list[StrictStr] = []
    base: Base = "fixed"
    gravity: Vector = [0.0, 0.0, -9.81]
    lock: list[StrictStr] = []
    limits: Literal["reported", "spring"] = "reported"
    friction_speed: Annotated[Number, Field(gt=0)] = FRICTION_SPEED
    loop: list[LoopEntry] = []
    force: list[AnyForceEntry] = []
    drive: list[DriveEntry] = []
    initial: InitialEntry = InitialEntry()
    simulation: SimulationEntry = SimulationEntry()

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
        out = []
        for i, entry in enumerate(self.loop):
            with _labelled("loop", i, entry.name) as label:
                out.append(LoopClosure(**_with_anchors(label, entry)))
        return tuple(out)

    def coupled_joints(self) -> frozenset[str]:
        """Names of the joints that take part in a coupling."""
        return frozenset(name for entry in self.loop for name in entry.joints or ())

    def anchors(self) -> Iterator[tuple[str, AnchorEntry]]:
        """Every anchor with its key, ``loop[0].a`` for example."""
        entries: list[tuple[str, Iterable[tuple[str, Any]]]] = [
            *((f"loop[{i}]", entry) for i, entry in enumerate(self.loop)),
            *((f"force[{i}]", entry) for i, entry in enumerate(self.force)),
            *((f"drive[{i}]", entry) for i, entry in enumerate(self.drive)),
        ]
        for where, entry in entries:
            for key, value in entry:
                if isinstance(value, AnchorEntry):
                    yield f"{where}.{key}", value

    def force_elements(self, folder: Path | None) -> tuple[ForceElement, ...]:
        """The force elements; tables are read from ``folder``, None leaves out those that have one.

        Raises
        ------
        InputError
            For a value that an element cannot take, an anchor without link or frame, or a table
            that cannot be read.
        """
        out = []
        for i, entry in enumerate(self.force):
            with _labelled("force", i, entry.name) as label:
                values = _with_anchors(label, entry)
                law = values.get("law")
                if law is not None:
                    values["law"] = {key: getattr(law, key) for key in LAW_KEYS}
                if folder is None and (values.get("law") or values.get("table")):
                    continue
                if isinstance(entry, TorqueEntry | WrenchEntry):
                    values = with_law(values, folder or Path())
                out.append(FORCE_TYPES[values.pop("type")](**values))
        return tuple(out)

    def drives(self, folder: Path) -> tuple[Drive, ...]:
        """The drives; tables are read from ``folder``, unless their paths are absolute.

        Raises
        ------
        InputError
            For a law or value that a drive cannot take, or a table that cannot be read.
        """
        out = []
        for i, entry in enumerate(self.drive):
            with _labelled("drive", i, entry.name or entry.joint or "") as label:
                anchors = {
                    side: None if given is None else _anchor(label, side, given)
                    for side, given in (("a", entry.a), ("b", entry.b))
                }
                out.append(
                    Drive(
                        law_from({key: getattr(entry, key) for key in LAW_KEYS}, folder),
                        joint=entry.joint,
                        axis=entry.axis,
                        distance=entry.distance,
                        absolute=entry.absolute,
                        name=entry.name,
                        **anchors,
                    )
                )
        return tuple(out)


@contextmanager
def _labelled(kind: str, index: int, name: str) -> Iterator[str]:
    """Call an element by its name or number in errors that do not name it yet."""
    label = f"{kind} {name!r}" if name else f"{kind}[{index}]"
    try:
        yield label
    except InputError as error:
        if not (error.element or "").startswith(kind):
            error.element = f"{label}: {error.element}" if error.element else label
        raise


def _anchor(label: str, side: str, given: AnchorEntry) -> Anchor:
    try:
        return Anchor(given.link, given.frame, _triple(given.xyz), _triple(given.rpy))
    except InputError as error:
        what = "" if error.element == "anchor" else f": {error.element}"
        error.element = f"{label}, anchor {side}{what}"
        raise


def _with_anchors(label: str, entry: LoopEntry | ForceEntry) -> dict[str, Any]:
    """The keys of an element, its anchors made."""
    return {
        key: _anchor(label, key, value) if isinstance(value, AnchorEntry) else value
        for key, value in entry
    }


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)


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
    table: type[_Strict] = Description
    if location[0] == "force" and len(location) > 2:
        table = FORCE_ENTRIES[str(location[2])]
    for part in location[:-1]:
        if isinstance(part, int) or part not in table.model_fields:
            continue
        annotation = table.model_fields[part].annotation
        for choice in (annotation, *get_args(annotation)):
            if isinstance(choice, type) and issubclass(choice, _Strict):
                table = choice
    return ", ".join(table.model_fields)


def _explain(error: ValidationError) -> tuple[str, str, str | None]:
    """Key, problem and remedy of the first thing that is wrong."""
    first = error.errors()[0]
    location = _location(first)
    key = _key_path(location)
    if first["type"] == "extra_forbidden":
        name = str(location[-1])
        return key, f"unknown key {name!r}", f"Known here: {_known_keys(first['loc'])}"
    if first["type"] == "union_tag_not_found":
        return f"{key}.type", "this key is missing", f"Known: {', '.join(FORCE_TYPES)}"
    if first["type"] == "union_tag_invalid":
        tag = first["input"]["type"]
        known = f"This version knows {', '.join(FORCE_TYPES)}"
        return f"{key}.type", f"there is no force type {_shown(tag)}", known
    if first["type"] == "missing":
        return key, "this key is missing", "Add it"
    message = f"{first['msg'][0].lower()}{first['msg'][1:]}"
    problem, remedy = PROBLEMS.get(first["type"], (None, None))
    if location[0] == "initial" and first["type"] == "number":
        remedy = "Give a finite number, or a list of them for a joint with several coordinates"
    return key, f"{problem or message}, not {_shown(first.get('input'))}", remedy


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python prints no integer of more than 4300 digits
        return "this one"
    return text if len(text) < 60 else text[:57] + "..."


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
                remedy=f"This version knows {', '.join(CLOSURE_TYPES)}",
            )
        for side in "ab":
            if side in CLOSURE_TYPES[entry.type].needs and getattr(entry, side) is None:
                raise InputError(
                    "this key is missing", file=file, element=f"loop[{i}].{side}", remedy="Add it"
                )
    return description
