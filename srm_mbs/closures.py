r"""The types of loop closure, as data.

A closure ties an anchor frame *a* on one body to an anchor frame *b* on another, or joints to each
other.  With the position p of a's origin and the rotation R of a's axes, both in b's frame, and the
coordinates q_i of joints with one degree of freedom, every type below is a set of scalar rows of
four kinds:

* *position rows*   g = d . p,      d a constant unit vector in b;
* *distance rows*   g = |p| - L,    L a length;
* *alignment rows*  g = n . (R u),  u constant in a, n constant in b (zero when they are
  perpendicular; used with R u close to a vector that is perpendicular to n);
* *joint rows*      g = sum c_i q_i - s,  c_i and s constant.

A new type made of these is one more entry of :data:`CLOSURE_TYPES`; its Jacobian, its
:math:`\dot G v`, its reactions and its assembly follow from the kinds of row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from srm_mbs.arrays import FloatArray


def perpendicular_basis(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors that complete the unit vector ``axis`` (3,) to a right-handed frame.

    For a coordinate axis they are the other two coordinate axes, so that rows that vanish in a
    planar mechanism vanish exactly.
    """
    helper = np.zeros(3)
    helper[(int(np.argmax(np.abs(axis))) + 1) % 3] = 1.0
    first = helper - axis * (axis @ helper)
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


_XYZ = np.eye(3)


@dataclass(frozen=True)
class JointRow:
    """g = sum c_i q_i - offset over joints with one coordinate and one degree of freedom.

    Attributes
    ----------
    joints
        Their names.
    coefficients
        c_i; products with q_i have the unit of the offset.
    offset
        s, in the unit of the row: that of the first joint (rad or m) where c_1 is a pure number.
    """

    joints: tuple[str, ...]
    coefficients: tuple[float, ...]
    offset: float = 0.0


@dataclass(frozen=True)
class RowSet:
    """Rows of one closure in its own anchors, in this order.

    Attributes
    ----------
    directions : (k, 3) unit vectors d in b of the position rows
    distances : the lengths L (m) of the distance rows
    alignments : (r, 2, 3) pairs (u in a, n in b) of the alignment rows
    joint_rows : the joint rows
    matched : (c, 3) axes, the same components in a and b, that must coincide with their sign;
        assembly uses them, because the alignment rows alone also admit the reversed axis.  Where
        there are none, the alignment rows are all that is asked for
    labels : names of all rows
    """

    labels: tuple[str, ...]
    directions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    alignments: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    matched: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    distances: tuple[float, ...] = ()
    joint_rows: tuple[JointRow, ...] = ()

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.labels)

    @property
    def blocks(self) -> tuple[slice, slice, slice]:
        """The rows that are lengths (position and distance rows), alignments, and joint rows."""
        lengths = len(self.directions) + len(self.distances)
        joints = lengths + len(self.alignments)
        return slice(0, lengths), slice(lengths, joints), slice(joints, self.count)


def _no_axis() -> FloatArray:
    return np.zeros(3)


@dataclass(frozen=True)
class ClosureValues:
    """What the rows of a closure are made of: unit axes (3,), m; types read what they need."""

    axis: FloatArray = field(default_factory=_no_axis)
    axis_a: FloatArray = field(default_factory=_no_axis)
    axis_b: FloatArray = field(default_factory=_no_axis)
    length: float = np.nan
    joint_row: JointRow = field(default_factory=lambda: JointRow((), ()))


@dataclass(frozen=True)
class ClosureType:
    """One type of closure.

    Attributes
    ----------
    name
        As in a description.
    needs
        Keys that it must have besides its name and type.
    takes
        Keys that it may have.
    rows
        Its rows.
    summary
        What it is, in a few words.
    """

    name: str
    needs: tuple[str, ...]
    rows: Callable[[ClosureValues], RowSet]
    summary: str
    takes: tuple[str, ...] = ()


def _point(_: ClosureValues) -> RowSet:
    return RowSet(("x", "y", "z"), _XYZ)


_TURNS = np.array([[_XYZ[1], _XYZ[2]], [_XYZ[2], _XYZ[0]], [_XYZ[0], _XYZ[1]]])
"""At R = 1 the rates of these alignments are the components of the relative angular velocity."""


def _frame(_: ClosureValues) -> RowSet:
    return RowSet(("x", "y", "z", "rx", "ry", "rz"), _XYZ, _TURNS, _XYZ)


def _axis_rows(axis: FloatArray) -> FloatArray:
    """The two alignments that keep ``axis`` of a parallel to ``axis`` of b."""
    n1, n2 = perpendicular_basis(axis)
    return np.array([[axis, n1], [axis, n2]])


def _revolute(values: ClosureValues) -> RowSet:
    labels = ("x", "y", "z", "axis_1", "axis_2")
    return RowSet(labels, _XYZ, _axis_rows(values.axis), values.axis[None])


def _prismatic(values: ClosureValues) -> RowSet:
    across = np.array(perpendicular_basis(values.axis))
    return RowSet(("normal_1", "normal_2", "rx", "ry", "rz"), across, _TURNS, _XYZ)


def _cylindrical(values: ClosureValues) -> RowSet:
    axis = values.axis
    across = np.array(perpendicular_basis(axis))
    labels = ("normal_1", "normal_2", "axis_1", "axis_2")
    return RowSet(labels, across, _axis_rows(axis), axis[None])


def _universal(values: ClosureValues) -> RowSet:
    cross = np.array([[values.axis_a, values.axis_b]])
    return RowSet(("x", "y", "z", "cross"), _XYZ, cross)


def _planar(values: ClosureValues) -> RowSet:
    axis = values.axis
    return RowSet(("normal", "axis_1", "axis_2"), axis[None].copy(), _axis_rows(axis), axis[None])


def _point_on_line(values: ClosureValues) -> RowSet:
    return RowSet(("normal_1", "normal_2"), np.array(perpendicular_basis(values.axis)))


def _point_on_plane(values: ClosureValues) -> RowSet:
    return RowSet(("normal",), values.axis[None].copy())


def _distance(values: ClosureValues) -> RowSet:
    return RowSet(("distance",), distances=(values.length,))


def _coupling(values: ClosureValues) -> RowSet:
    return RowSet(("coupling",), joint_rows=(values.joint_row,))


_ANCHORS = ("a", "b")
_WITH_AXIS = (*_ANCHORS, "axis")

CLOSURE_TYPES: Mapping[str, ClosureType] = MappingProxyType(
    {
        closure.name: closure
        for closure in (
            ClosureType("point", _ANCHORS, _point, "ball joint: the two origins coincide"),
            ClosureType("frame", _ANCHORS, _frame, "weld: the two frames coincide"),
            ClosureType("revolute", _WITH_AXIS, _revolute, "hinge: origins and axes coincide"),
            ClosureType(
                "prismatic", _WITH_AXIS, _prismatic, "slider: a moves in b along axis, without turn"
            ),
            ClosureType(
                "cylindrical", _WITH_AXIS, _cylindrical, "a slides along axis and turns about it"
            ),
            ClosureType(
                "universal",
                (*_ANCHORS, "axis_a", "axis_b"),
                _universal,
                "Hooke joint: the origins coincide, axis_a of a is perpendicular to axis_b of b",
            ),
            ClosureType(
                "planar", _WITH_AXIS, _planar, "a moves in the plane of b with normal axis"
            ),
            ClosureType(
                "point_on_line",
                _WITH_AXIS,
                _point_on_line,
                "a's origin on the line of b along axis",
            ),
            ClosureType(
                "point_on_plane",
                _WITH_AXIS,
                _point_on_plane,
                "a's origin in the plane through b's origin with normal axis",
            ),
            ClosureType(
                "distance", _ANCHORS, _distance, "rod: the origins keep their distance", ("length",)
            ),
            ClosureType(
                "coupling",
                ("joints",),
                _coupling,
                "gear: a linear relation of joint coordinates",
                ("ratio", "coefficients", "offset"),
            ),
        )
    }
)
"""The closures by their type in a description."""
