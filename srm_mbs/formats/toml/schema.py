"""The tables of a description, checked with pydantic.

The tables of closures, forces, drives and laws are derived from the fields of the classes in
:mod:`srm_mbs.model`; no key of theirs is listed here.  The classes are dataclasses and not pydantic
models because they are constructed in Python far more often than read from files: their
constructors take positional arguments, raise :class:`~srm_mbs.errors.InputError` with a remedy, and
cost no import of pydantic.  A description is stricter than a constructor: numbers are no strings
and no booleans, tables have no unknown keys, and tables of numbers may come from CSV files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import pydantic
from pydantic import BaseModel, ConfigDict, PlainValidator, StrictBool, StrictStr, create_model
from pydantic_core import PydanticCustomError

from srm_mbs.model.actuators import Actuator
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.drives import Drive
from srm_mbs.model.forces import FORCE_TYPES
from srm_mbs.model.laws import LAW_TYPES, Law
from srm_mbs.model.mechanism import FRICTION_SPEED
from srm_mbs.model.numbers import LARGEST_MAGNITUDE


def _number(value: Any) -> float:
    if type(value) is float and abs(value) <= LARGEST_MAGNITUDE:
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise PydanticCustomError("number", "a finite number is wanted")
    if not abs(value) <= LARGEST_MAGNITUDE:
        raise PydanticCustomError("number", "a finite number of sensible size is wanted")
    return float(value)


def _joint_value(value: Any) -> float | list[float]:
    if isinstance(value, list) and value:
        return [_number(part) for part in value]
    return _number(value)


def _massless(value: Any) -> str | dict[str, float]:
    if value in ("refused", "fix"):
        return str(value)
    if isinstance(value, Mapping) and set(value) == {"mass", "inertia"}:
        numbers = {key: _number(part) for key, part in value.items()}
        if min(numbers.values()) > 0.0:
            return numbers
    raise PydanticCustomError("massless", "a treatment of massless ends is wanted")


def _direction(value: Any) -> float | list[float] | list[str]:
    if not isinstance(value, list):
        return _number(value)
    if len(value) != 2:
        raise PydanticCustomError("direction", "a direction of the plane is wanted")
    if all(isinstance(part, str) for part in value):
        return value
    return [_number(part) for part in value]


Number = Annotated[float, PlainValidator(_number)]
Direction = Annotated[float | list[float] | list[str], PlainValidator(_direction)]
"""A direction in the plane: an angle against x, two components, or the names of two points."""
Massless = Annotated[str | dict[str, float], PlainValidator(_massless)]
Positive = Annotated[Number, pydantic.Field(gt=0)]
NotNegative = Annotated[Number, pydantic.Field(ge=0)]
JointValue = Annotated[float | list[float], PlainValidator(_joint_value)]


def _list_of(count: int) -> Any:
    return Annotated[list[Number], pydantic.Field(min_length=count, max_length=count)]


Vector = Annotated[list[Number], pydantic.Field(min_length=3, max_length=3)]
Base = Literal["fixed", "floating", "planar"]


class StrictEntry(BaseModel):
    """A table without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


# -- tables derived from the classes of elements ---------------------------------------------


def _entry_type(hint: Any, count: int) -> Any:
    """The type of a value in a description for a field of type ``hint``.

    ``count`` is the length of a list whose type does not say it, or 0.
    """
    if hint is float:
        return Number
    if hint in (str, bool):
        return StrictStr if hint is str else StrictBool
    if hint is Anchor:
        return AnchorEntry
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return hint
    if origin in (Union, UnionType):
        return _union_type(parts, count)
    if origin is tuple and parts[-1] is not Ellipsis:
        return _list_of(len(parts))
    if origin in (tuple, Sequence):
        return _list_of(count) if count else list[_entry_type(parts[0], 0)]  # type: ignore[misc]
    raise TypeError(f"no table of a description can hold a {hint!r}")  # pragma: no cover


def _union_type(parts: tuple[Any, ...], count: int) -> Any:
    optional = type(None) in parts
    if Law in parts:
        kind: Any = LawEntry
    elif float in parts and len(parts) > 1 + optional:
        kind = JointValue
    else:  # of several classes, as of a closure type, descriptions know the first
        kind = _entry_type(parts[0], count)
    return kind | None if optional else kind


def _keys(kind: Any, without: Sequence[str] = ()) -> dict[str, Any]:
    """Keys of the class ``kind`` with their types and defaults, as pydantic takes them."""
    hints = get_type_hints(kind)
    return {
        key.name: (_entry_type(hints[key.name], key.metadata.get("count", 0)), _default(key))
        for key in fields(kind)
        if key.name not in without
    }


def _default(key: Field[Any]) -> Any:
    if key.default is MISSING or key.metadata.get("needed"):
        return ...
    return list(key.default) if isinstance(key.default, tuple) else key.default


def _optional(keys: Mapping[str, Any]) -> dict[str, Any]:
    """The same keys, none of which is needed."""
    return {name: (kind | None, None) for name, (kind, _) in keys.items()}


def _entry(name: str, doc: str, keys: Mapping[str, Any]) -> type[StrictEntry]:
    return create_model(name, __base__=StrictEntry, __doc__=doc, __module__=__name__, **keys)


AnchorEntry: Any = _entry(
    "AnchorEntry",
    '``{ link = "rod", xyz = [...], rpy = [...] }``, or with ``frame`` instead of ``link``.',
    _keys(Anchor),
)
TABLE_KEYS = ("table", "time", "value")
"""Keys of a table in a CSV file: its path, and the names of its columns, by default t and value."""
_TABLE = dict.fromkeys(TABLE_KEYS, (StrictStr | None, None))
_LAW = {
    "type": (StrictStr, ...),
    **{k: v for kind in LAW_TYPES.values() for k, v in _optional(_keys(kind)).items()},
    **_TABLE,
}
LAW_KEYS = tuple(_LAW)
"""All keys that laws have."""
LawEntry: Any = _entry(
    "LawEntry", "A law over time; which keys it takes depends on its type.", _LAW
)
_NAME = {"name": (StrictStr, "")}
LoopEntry: Any = _entry("LoopEntry", "One ``[[loop]]``.", {**_NAME, **_keys(LoopClosure)})
DriveEntry: Any = _entry(
    "DriveEntry",
    "One ``[[drive]]``: the motion that is prescribed, and the keys of its law.",
    {**_LAW, **_NAME, **_keys(Drive, ("law", "name"))},
)
ActuatorEntry: Any = _entry("ActuatorEntry", "One of ``[actuators]``.", _keys(Actuator))
CSV_KEYS = {"torque": TABLE_KEYS, "wrench": TABLE_KEYS[:2]}
"""Keys by which forces take their values over time from a CSV file."""


def _force_entry(name: str, kind: Callable[..., Any]) -> Any:
    type_ = {"type": (Literal[name], ...)}
    table = {key: _TABLE[key] for key in CSV_KEYS.get(name, ())}
    keys = {**type_, **_NAME, **_keys(kind, ("name",)), **table}
    return _entry(f"{kind.__name__}Entry", f"A ``[[force]]`` of type ``{name}``.", keys)


FORCE_ENTRIES: dict[str, Any] = {
    name: _force_entry(name, kind) for name, kind in FORCE_TYPES.items()
}
"""The tables of forces by their type."""
AnyForceEntry: Any = Annotated[
    Union[tuple(FORCE_ENTRIES.values())],  # noqa: UP007 - the members are computed
    pydantic.Field(discriminator="type"),
]

# -- the other tables ------------------------------------------------------------------------


PlanePoint = Annotated[list[Number], pydantic.Field(min_length=2, max_length=2)]
Pair = Annotated[list[StrictStr], pydantic.Field(min_length=2, max_length=2)]
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
"""Units of the lengths of a planar linkage, in m."""


class PlanarBar(StrictEntry):
    """One ``[[planar.bar]]``: a rigid body through two points, or a plate through more.

    ``length`` is that of a bar of two points; ``mass`` (kg), ``mass_per_length`` (kg/m),
    ``inertia`` (kg m^2) about the centre of mass and normal to the plane, ``centre`` as drawn.
    """

    name: StrictStr
    points: list[StrictStr]
    length: Positive | None = None
    mass: NotNegative | None = None
    mass_per_length: NotNegative | None = None
    inertia: NotNegative | None = None
    centre: PlanePoint | None = None


class PlanarSlider(StrictEntry):
    """One ``[[planar.slider]]``: ``point`` moves along a line of the ground, or of the bar ``on``.

    With ``mass`` (kg) it is a body of that name, which keeps the orientation of its line and has
    ``inertia`` (kg m^2).
    """

    name: StrictStr
    point: StrictStr
    along: Direction
    on: StrictStr = ""
    mass: NotNegative = 0.0
    inertia: NotNegative = 0.0


class PlanarLength(StrictEntry):
    """One ``[[planar.length]]``: the distance of two points of a bar."""

    between: Pair
    length: Positive


class PlanarSpring(StrictEntry):
    """One ``[[planar.spring]]``: spring (N/m) and damper (N s/m) between two points."""

    a: StrictStr
    b: StrictStr
    stiffness: NotNegative = 0.0
    damping: NotNegative = 0.0
    rest_length: NotNegative | None = None
    name: StrictStr = ""


class PlanarTorque(StrictEntry):
    """One ``[[planar.torque]]``: N m on a pin, N on a slider."""

    pin: StrictStr
    torque: Number


class PlanarLoad(StrictEntry):
    """One ``[[planar.load]]``: a constant force (N) on a point, in the directions x, y."""

    point: StrictStr
    force: PlanePoint


PlanarDrive: Any = _entry(
    "PlanarDrive",
    "One ``[[planar.drive]]``: the motion of a pin or slider, and the keys of its law.",
    {"pin": (StrictStr, ...), **_LAW, "absolute": (StrictBool, False)},
)


class PlanarEntry(StrictEntry):
    """``[planar]``: a planar linkage by its points and bars (docs/formats.md)."""

    unit: Literal["m", "cm", "mm", "in"] = "m"
    angle: Literal["rad", "deg"] = "rad"
    points: dict[StrictStr, PlanePoint]
    bar: list[PlanarBar]
    ground: list[StrictStr]
    slider: list[PlanarSlider] = pydantic.Field(default_factory=list)
    length: list[PlanarLength] = pydantic.Field(default_factory=list)
    mass_per_length: NotNegative | None = None
    gravity: PlanePoint | None = None
    start: dict[StrictStr, Number] = pydantic.Field(default_factory=dict)
    rates: dict[StrictStr, Number] = pydantic.Field(default_factory=dict)
    spring: list[PlanarSpring] = pydantic.Field(default_factory=list)
    torque: list[PlanarTorque] = pydantic.Field(default_factory=list)
    load: list[PlanarLoad] = pydantic.Field(default_factory=list)
    drive: list[PlanarDrive] = pydantic.Field(default_factory=list)


class OverrideEntry(StrictEntry):
    """One ``[[override]]``: changes of a joint or a link of the file (docs/formats.md).

    ``scale`` multiplies the place of the joint in its parent, or mass and moments of inertia of the
    link, these ``inertia_scale`` as well; ``xyz`` (m) is added to the place of the joint or of the
    centre of mass, ``mass`` (kg) and ``inertia`` (kg m^2; xx, xy, xz, yy, yz, zz) to the link's.
    """

    joint: StrictStr | None = None
    link: StrictStr | None = None
    scale: Positive = 1.0
    inertia_scale: Positive = 1.0
    xyz: Vector = [0.0, 0.0, 0.0]
    mass: Number = 0.0
    inertia: Annotated[list[Number], pydantic.Field(min_length=6, max_length=6)] = [0.0] * 6


class InitialEntry(StrictEntry):
    """``[initial]``: held positions and rates, and guesses, by joint name."""

    q: dict[StrictStr, JointValue] = {}
    v: dict[StrictStr, JointValue] = {}
    guess: dict[StrictStr, JointValue] = {}


class SimulationEntry(StrictEntry):
    """``[simulation]``: defaults of the command line."""

    t_end: Positive | None = None
    rtol: Positive | None = None
    atol: Positive | None = None


class TopEntry(StrictEntry):
    """A whole description.

    Pydantic copies a default that can change, which takes longer than to make it.
    """

    format: Literal[1]
    name: StrictStr = ""
    urdf: StrictStr | None = None
    sdf: StrictStr | None = None
    mjcf: StrictStr | None = None
    planar: PlanarEntry | None = None
    parameters: dict[StrictStr, Number] = pydantic.Field(default_factory=dict)
    cut: list[StrictStr] = pydantic.Field(default_factory=list)
    base: Base = "fixed"
    gravity: Vector = [0.0, 0.0, -9.81]
    gravity_compensation: dict[StrictStr, Number] = pydantic.Field(default_factory=dict)
    lock: list[StrictStr] = pydantic.Field(default_factory=list)
    massless: Massless = "refused"
    closing_tolerance: NotNegative = 0.0
    limits: Literal["reported", "spring"] = "reported"
    friction_speed: Positive = FRICTION_SPEED
    loop: list[LoopEntry] = pydantic.Field(default_factory=list)
    force: list[AnyForceEntry] = pydantic.Field(default_factory=list)
    drive: list[DriveEntry] = pydantic.Field(default_factory=list)
    points: dict[StrictStr, AnchorEntry] = pydantic.Field(default_factory=dict)
    override: list[OverrideEntry] = pydantic.Field(default_factory=list)
    actuators: dict[StrictStr, ActuatorEntry] = pydantic.Field(default_factory=dict)
    initial: InitialEntry = pydantic.Field(default_factory=InitialEntry)
    simulation: SimulationEntry = pydantic.Field(default_factory=SimulationEntry)
