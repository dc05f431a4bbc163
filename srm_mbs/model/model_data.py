"""A Pinocchio model as plain data, as JSON has it, and the model that such data describe.

Pinocchio's own archives hold the memory of a model, indices included, and reading one that was
changed reads and writes out of bounds.  Data name joints by type, placement and inertia; indices
follow when the joints are added.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pinocchio as pin
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    model_validator,
)

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError

MOST_JOINTS = 5_000
"""Joints of a model: Pinocchio's matrices of it have as many rows and columns."""
MOST_FRAMES = 20_000
"""Frames or bodies of a model."""
LONGEST_NAME = 1000
"""Characters of a name."""
ORTHONORMAL = 1e-9
"""Deviation of R R^T from the identity that is rounding."""
POSITION_LIMITS = ("lowerPositionLimit", "upperPositionLimit", "positionLimitMargin")
"""Vectors of a model with one number per configuration component (nq,)."""
VELOCITY_VECTORS = (
    *("armature", "damping", "friction", "rotorInertia", "rotorGearRatio"),
    *("effortLimit", "lowerEffortLimit", "upperEffortLimit"),
    *("velocityLimit", "lowerVelocityLimit", "upperVelocityLimit"),
    *("lowerDryFrictionLimit", "upperDryFrictionLimit"),
)
"""Vectors of a model with one number per velocity component (nv,)."""
VECTORS = POSITION_LIMITS + VELOCITY_VECTORS
_PLAIN = (
    *("RX", "RY", "RZ", "RUBX", "RUBY", "RUBZ", "PX", "PY", "PZ", "HX", "HY", "HZ"),
    *("FreeFlyer", "Planar", "Spherical", "SphericalZYX", "Translation"),
)
"""Types of joints made without an axis; H joints have a pitch."""


def plain_numbers(values: list[Any]) -> list[Any]:
    """``values``, from JSON, if they are numbers; infinite ones and NaN among them.

    One check of the list: pydantic would make an error of each of a million wrong items.
    """
    if not all(
        type(value) is float or (type(value) is int and abs(value) < 2**63) for value in values
    ):
        raise ValueError("it does not consist of numbers")
    return values


def finite_numbers(values: list[Any]) -> list[Any]:
    """``values``, from JSON, if they are finite numbers."""
    if not np.isfinite(np.array(plain_numbers(values), dtype=float)).all():
        raise ValueError("it has numbers that are no finite number")
    return values


def _orthonormal(numbers: list[float]) -> list[float]:
    R = np.reshape(finite_numbers(numbers)[:9], (3, 3)).astype(float)
    if not np.allclose(R @ R.T, np.eye(3), atol=ORTHONORMAL, rtol=0) or np.linalg.det(R) < 0.0:
        raise ValueError("the first nine numbers are not a rotation")
    return numbers


Name = Annotated[str, Field(max_length=LONGEST_NAME)]
Index = Annotated[int, Field(ge=0, le=MOST_FRAMES, strict=True)]
Vector3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Placement = Annotated[list[Any], Field(min_length=12, max_length=12), AfterValidator(_orthonormal)]
"""Rotation row by row, and translation."""
InertiaNumbers = Annotated[
    list[Any], Field(min_length=10, max_length=10), AfterValidator(finite_numbers)
]
"""Mass, centre of mass (3), and I_xx, I_xy, I_xz, I_yy, I_yz, I_zz about it."""
Numbers = Annotated[list[Any], AfterValidator(plain_numbers)]
MOST_KEYS = 100
"""Entries of an object, many more than any has: each wrong one makes an error of its own."""


class StrictData(BaseModel):
    """Data of strangers: no further entries, no other types, and few errors at a time."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_many(cls, values: Any) -> Any:
        if isinstance(values, dict) and len(values) > MOST_KEYS:
            raise ValueError(f"it has {len(values)} entries")
        return values


class JointTypeData(StrictData):
    """Type of a joint, and the numbers that it is made with."""

    type: str
    axes: Annotated[list[Vector3], Field(max_length=2)] = []
    numbers: Annotated[list[FiniteFloat], Field(max_length=3)] = []
    parts: Annotated[list[PartData], Field(max_length=MOST_JOINTS)] = []


class PartData(StrictData):
    """A joint inside a composite joint."""

    kind: JointTypeData
    placement: Placement


class JointData(StrictData):
    """A joint, its parent, and the inertia that it carries."""

    name: Name
    parent: Index
    kind: JointTypeData
    placement: Placement
    inertia: InertiaNumbers


class FrameData(StrictData):
    """A frame on a joint; ``inertia`` is its share of the joint's."""

    name: Name
    type: Literal["OP_FRAME", "JOINT", "FIXED_JOINT", "BODY", "SENSOR"]
    joint: Index
    parent: Index
    placement: Placement
    inertia: InertiaNumbers


class ModelData(StrictData):
    """A model: joints without the universe, frames without its first one, and vectors."""

    name: Name
    gravity: Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)]
    base_inertia: InertiaNumbers
    joints: Annotated[list[JointData], Field(max_length=MOST_JOINTS)]
    frames: Annotated[list[FrameData], Field(max_length=MOST_FRAMES)]
    bodies: Annotated[int, Field(ge=1, le=MOST_FRAMES)]
    """Pinocchio's count of bodies, the universe included; no computation reads it."""
    vectors: Annotated[dict[Name, Numbers], Field(max_length=MOST_KEYS)]


def _placement_numbers(placement: pin.SE3) -> list[float]:
    return [*placement.rotation.ravel().tolist(), *placement.translation.tolist()]


def _placement(numbers: list[float]) -> pin.SE3:
    return pin.SE3(np.reshape(numbers[:9], (3, 3)), np.array(numbers[9:]))


def _inertia_numbers(inertia: pin.Inertia) -> list[float]:
    upper = inertia.inertia[np.triu_indices(3)]
    return [float(inertia.mass), *inertia.lever.tolist(), *upper.tolist()]


class TreeNumbers(NamedTuple):
    """Numbers of every joint of a model, the universe's first.

    Attributes
    ----------
    placements : (njoints, 12)
        Placement in its parent: rotation row by row, then translation (m).
    bodies : (njoints, 10)
        Its body: mass (kg), centre of mass (m), and xx, xy, xz, yy, yz, zz (kg m^2) about it.
    """

    placements: FloatArray
    bodies: FloatArray


def tree_numbers(model: pin.Model) -> TreeNumbers:
    """The numbers of ``model``, by the kernel where there is one: Pinocchio's Python objects take a
    microsecond for each placement and body."""
    if core is not None:
        return TreeNumbers(*core.tree_numbers(model))
    return TreeNumbers(
        np.array([_placement_numbers(at) for at in model.jointPlacements.tolist()]),
        np.array([_inertia_numbers(body) for body in model.inertias.tolist()]),
    )


def _inertia(numbers: list[float]) -> pin.Inertia:
    moments = np.zeros((3, 3))
    moments[np.triu_indices(3)] = numbers[4:]
    return pin.Inertia(numbers[0], np.array(numbers[1:4]), moments + np.triu(moments, 1).T)


def _axis_of_subspace(joint: Any) -> list[float]:
    """The axis of a joint that does not tell it: the angular part of its motion subspace."""
    data = joint.createData()
    joint.calc(data, np.array([1.0, 0.0]))
    return [float(x) for x in data.S[3:]]


def joint_type_data(joint: Any) -> dict[str, Any]:
    """A joint as :class:`JointTypeData` has it."""
    own = joint.extract()
    kind = joint.shortname().removeprefix("JointModel")
    out: dict[str, Any] = {"type": kind}
    if kind == "Composite":
        parts = zip(own.joints, own.jointPlacements)
        out["parts"] = [
            {"kind": joint_type_data(part), "placement": _placement_numbers(at)}
            for part, at in parts
        ]
    elif kind == "RevoluteUnboundedUnaligned":
        out["axes"] = [_axis_of_subspace(joint)]
    else:
        axes = [getattr(own, name) for name in ("axis", "axis1", "axis2") if hasattr(own, name)]
        names = ("pitch", "radius_x", "radius_y", "radius_z")
        out["axes"] = [axis.tolist() for axis in axes]
        out["numbers"] = [float(getattr(own, name)) for name in names if hasattr(own, name)]
    return out


def model_to_data(model: pin.Model) -> dict[str, Any]:
    """``model`` as :class:`ModelData` has it, in lists, strings and numbers."""
    return {
        "name": model.name,
        "gravity": model.gravity.vector.tolist(),
        "base_inertia": _inertia_numbers(model.inertias[0]),
        "joints": [
            {
                "name": model.names[i],
                "parent": int(model.parents[i]),
                "kind": joint_type_data(model.joints[i]),
                "placement": _placement_numbers(model.jointPlacements[i]),
                "inertia": _inertia_numbers(model.inertias[i]),
            }
            for i in range(1, model.njoints)
        ],
        "frames": [
            {
                "name": frame.name,
                "type": frame.type.name,
                "joint": int(frame.parentJoint),
                "parent": int(frame.parentFrame),
                "placement": _placement_numbers(frame.placement),
                "inertia": _inertia_numbers(frame.inertia),
            }
            for frame in list(model.frames)[1:]
        ],
        "bodies": int(model.nbodies),
        "vectors": {name: getattr(model, name).tolist() for name in VECTORS},
    }


_UNBOUNDED = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="{} {} {}"/></joint>
</robot>"""


def _unbounded(axis: FloatArray) -> Any:
    """A continuous joint about ``axis``, for which Pinocchio's class has no constructor."""
    if np.abs(axis).max() == 1.0:
        raise ValueError("the axis of a RevoluteUnboundedUnaligned joint is one of the frame")
    return pin.buildModelFromXML(_UNBOUNDED.format(*map(repr, axis.tolist()))).joints[1]


def _two_axes(first: FloatArray, second: FloatArray) -> Any:
    return pin.JointModelUniversal(first, second)


_WITH_AXES: dict[str, tuple[int, int, Callable[..., Any]]] = {
    "RevoluteUnaligned": (1, 0, pin.JointModelRevoluteUnaligned),
    "RevoluteUnboundedUnaligned": (1, 0, _unbounded),
    "PrismaticUnaligned": (1, 0, pin.JointModelPrismaticUnaligned),
    "HelicalUnaligned": (1, 1, pin.JointModelHelicalUnaligned),
    "Universal": (2, 0, _two_axes),
    "Ellipsoid": (0, 3, pin.JointModelEllipsoid),
    **{name: (0, int(name.startswith("H")), getattr(pin, f"JointModel{name}")) for name in _PLAIN},
}
"""Numbers of axes and of other numbers of each type, and its constructor."""


def _joint(kind: JointTypeData) -> Any:
    if kind.type == "Composite":
        out = pin.JointModelComposite()
        for part in kind.parts:
            if part.kind.type == "Composite":
                raise ValueError("a composite joint is part of another")
            out.addJoint(_joint(part.kind), _placement(part.placement))
        if not kind.parts:
            raise ValueError("a composite joint has no parts")
        return out
    if kind.type not in _WITH_AXES:
        raise ValueError(f"there is no joint type {kind.type!r}")
    axes, numbers, make = _WITH_AXES[kind.type]
    if (len(kind.axes), len(kind.numbers)) != (axes, numbers):
        raise ValueError(f"a joint of type {kind.type!r} has {axes} axes and {numbers} numbers")
    vectors = [np.array(axis) for axis in kind.axes]
    if any(abs(float(np.linalg.norm(axis)) - 1.0) > ORTHONORMAL for axis in vectors):
        raise ValueError("the axis of a joint is no unit vector")
    return make(*vectors, *kind.numbers)


def model_from_data(data: Any) -> pin.Model:
    """The model that ``data``, as of :func:`model_to_data`, describe.

    Raises
    ------
    InputError
        If they describe none.
    """
    try:
        return _built(ModelData.model_validate(data))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        message = first["msg"].removeprefix("Value error, ")
        raise _no_model(f"{where[:100]}: {message}" if where else message) from error
    except ValueError as error:
        raise _no_model(str(error)) from error


def _no_model(why: str) -> InputError:
    return InputError(
        f"it describes no Pinocchio model: {why}", element="model", remedy="Save the run again"
    )


def _built(data: ModelData) -> pin.Model:
    model = pin.Model()
    model.name = data.name
    model.gravity = pin.Motion(np.array(data.gravity))
    for i, joint in enumerate(data.joints, 1):
        if joint.parent >= i:
            raise ValueError(f"the parent of joint {joint.name!r} does not stand before it")
        if joint.inertia[0] < 0.0:
            raise ValueError(f"the joint {joint.name!r} carries a negative mass")
        made = _joint(joint.kind)
        model.addJoint(joint.parent, made, _placement(joint.placement), joint.name)
    for k, frame in enumerate(data.frames, 1):
        if frame.joint > len(data.joints) or frame.parent >= k:
            raise ValueError(f"the frame {frame.name!r} is on no joint or frame before it")
        kind = pin.FrameType.names[frame.type]
        at, share = _placement(frame.placement), _inertia(frame.inertia)
        model.addFrame(pin.Frame(frame.name, frame.joint, frame.parent, at, kind, share), False)
    for _ in range(data.bodies - model.nbodies):
        model.appendBodyToJoint(0, pin.Inertia.Zero(), pin.SE3.Identity())
    for i, inertia in enumerate([data.base_inertia, *(joint.inertia for joint in data.joints)]):
        model.inertias[i] = _inertia(inertia)
    if set(data.vectors) != set(VECTORS):
        raise ValueError("the vectors are not those of a model")
    for name, values in data.vectors.items():
        expected = getattr(model, name).shape
        if (len(values),) != expected:
            raise ValueError(f"{name} has {len(values)} numbers, not {expected[0]}")
        getattr(model, name)[:] = values
    return model
