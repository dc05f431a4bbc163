"""The schema of a mechanism description (TOML), checked with pydantic.

Unknown keys, wrong types and non-finite numbers become one :class:`InputError` that names the
file, the key and the remedy.
"""

from __future__ import annotations

import tomllib
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AllowInfNan,
    BaseModel,
    ConfigDict,
    Field,
    StrictFloat,
    StrictInt,
    StrictStr,
    ValidationError,
)

from srm_mbs.closures import CLOSURE_TYPES
from srm_mbs.errors import InputError
from srm_mbs.mechanism import Anchor, LoopClosure

Number = Annotated[StrictFloat | StrictInt, AllowInfNan(False)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
JointValue = Number | Annotated[list[Number], Field(min_length=1)]
Base = Literal["fixed", "floating", "planar"]

LATER = {
    "force": "force elements are not read by this version; use a controller for them",
    "drive": "drives are not read by this version",
    "sdf": "SDF files are not read by this version; give a URDF",
    "mjcf": "MJCF files are not read by this version; give a URDF",
}


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
    a: AnchorEntry
    b: AnchorEntry
    axis: Vector | None = None


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
    urdf: StrictStr
    base: Base = "fixed"
    gravity: Vector = [0.0, 0.0, -9.81]
    lock: list[StrictStr] = []
    loop: list[LoopEntry] = []
    initial: InitialEntry = InitialEntry()
    simulation: SimulationEntry = SimulationEntry()

    def closures(self) -> tuple[LoopClosure, ...]:
        """The loop closures.

        Raises
        ------
        InputError
            For an unknown type, a wrong axis, or an anchor without link or frame.
        """
        out = []
        for i, entry in enumerate(self.loop):
            label = f"loop {entry.name!r}" if entry.name else f"loop[{i}]"
            try:
                anchors = {}
                for side, given in (("a", entry.a), ("b", entry.b)):
                    label_side = f"{label}, anchor {side}"
                    try:
                        anchors[side] = Anchor(
                            given.link, given.frame, _triple(given.xyz), _triple(given.rpy)
                        )
                    except InputError as error:
                        error.element = f"{label_side}: {error.element}"
                        raise
                axis = None if entry.axis is None else _triple(entry.axis)
                out.append(LoopClosure(entry.type, anchors["a"], anchors["b"], axis, entry.name))
            except InputError as error:
                if not (error.element or "").startswith("loop"):
                    error.element = f"{label}: {error.element}" if error.element else label
                raise
        return tuple(out)


def _triple(values: list[Any]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def _key_path(location: tuple[int | str, ...]) -> str:
    path = ""
    for part in location:
        if isinstance(part, int):
            path += f"[{part}]"
        elif part.startswith(("function", "constrained", "float", "int", "list[")):
            continue  # pydantic names the branches of a union; a reader does not need them
        else:
            path += f".{part}" if path else part
    return path


def _known_keys(location: tuple[int | str, ...]) -> str:
    table: type[_Strict] = Description
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
    location = first["loc"]
    key = _key_path(location)
    if first["type"] == "extra_forbidden":
        name = str(location[-1])
        if len(location) == 1 and name in LATER:
            return key, LATER[name], "Remove it"
        return key, f"unknown key {name!r}", f"Known here: {_known_keys(location)}"
    if first["type"] == "missing":
        return key, "this key is missing", "Add it"
    given = repr(first.get("input"))
    shown = given if len(given) < 60 else given[:57] + "..."
    return key, f"{first['msg'][0].lower()}{first['msg'][1:]}, not {shown}", None


def parse_description(text: str, file: str) -> Description:
    """Parse and check the TOML ``text`` of ``file``.

    Raises
    ------
    InputError
        Naming the file, the key or line, and the remedy.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"this is not valid TOML: {error}", file=file) from error
    try:
        description = Description.model_validate(raw)
    except ValidationError as error:
        key, problem, remedy = _explain(error)
        if key == "format":
            remedy = "Write: format = 1"
        raise InputError(problem, file=file, element=key, remedy=remedy) from error
    for i, entry in enumerate(description.loop):
        if entry.type not in CLOSURE_TYPES:
            raise InputError(
                f"there is no closure type {entry.type!r}",
                file=file,
                element=f"loop[{i}].type",
                remedy=f"This version knows {', '.join(CLOSURE_TYPES)}",
            )
    return description
