"""The tables of a mechanism description and the types of their values, checked with pydantic.

One class per table; what they make is in :mod:`srm_mbs.formats.toml.description`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, StrictBool, StrictStr
from pydantic_core import PydanticCustomError

from srm_mbs.model.mechanism import FRICTION_SPEED

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


class StrictEntry(BaseModel):
    """A table without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class AnchorEntry(StrictEntry):
    """``{ link = "rod", xyz = [...], rpy = [...] }``, or with ``frame`` instead of ``link``."""

    link: StrictStr | None = None
    frame: StrictStr | None = None
    xyz: Vector = [0.0, 0.0, 0.0]
    rpy: Vector = [0.0, 0.0, 0.0]


class LoopEntry(StrictEntry):
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


class ForceEntry(StrictEntry):
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


class LawEntry(StrictEntry):
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


class InitialEntry(StrictEntry):
    """``[initial]``: held positions and rates, and guesses, by joint name."""

    q: dict[StrictStr, JointValue] = {}
    v: dict[StrictStr, JointValue] = {}
    guess: dict[StrictStr, JointValue] = {}


class SimulationEntry(StrictEntry):
    """``[simulation]``: defaults of the command line."""

    t_end: Annotated[Number, Field(gt=0)] | None = None
    rtol: Annotated[Number, Field(gt=0)] | None = None
    atol: Annotated[Number, Field(gt=0)] | None = None


class TopEntry(StrictEntry):
    """The top of a description, and with it all that it holds."""

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
