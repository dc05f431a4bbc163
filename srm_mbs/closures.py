r"""The types of loop closure, as data.

A closure ties an anchor frame *a* on one body to an anchor frame *b* on another.  With the
position p of a's origin and the rotation R of a's axes, both in b's frame, every type below is
a set of scalar rows of two kinds:

* *position rows*   g = d . p,      d a constant unit vector in b;
* *alignment rows*  g = n . (R u),  u constant in a, n constant in b (zero when they are
  perpendicular; used with R u close to a vector that is perpendicular to n).

A new type of this family is one more entry of :data:`CLOSURE_TYPES`; its Jacobian, its
:math:`\dot G v`, its reactions and its assembly follow from the two kinds of row.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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


@dataclass(frozen=True)
class RowSet:
    """Rows of one closure in its own anchors.

    Attributes
    ----------
    directions : (k, 3) unit vectors d in b of the position rows
    alignments : (r, 2, 3) pairs (u in a, n in b) of the alignment rows
    matched : (c, 3) axes, the same components in a and b, that must coincide with their sign;
        assembly uses them, because the alignment rows alone also admit the reversed axis
    labels : k + r names, position rows first
    """

    directions: FloatArray
    alignments: FloatArray
    matched: FloatArray
    labels: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.labels)


@dataclass(frozen=True)
class ClosureType:
    """One type of closure: its name, whether it takes an axis, and its rows."""

    name: str
    needs_axis: bool
    rows: Callable[[FloatArray], RowSet]
    summary: str


_NO_ROWS = np.zeros((0, 3))
_NO_ALIGNMENTS = np.zeros((0, 2, 3))
_XYZ = np.eye(3)


def _point(_: FloatArray) -> RowSet:
    return RowSet(_XYZ, _NO_ALIGNMENTS, _NO_ROWS, ("x", "y", "z"))


def _frame(_: FloatArray) -> RowSet:
    x, y, z = _XYZ
    # At R = 1 the rates of these rows are the components of the relative angular velocity.
    alignments = np.array([[y, z], [z, x], [x, y]])
    return RowSet(_XYZ, alignments, _XYZ, ("x", "y", "z", "rx", "ry", "rz"))


def _revolute(axis: FloatArray) -> RowSet:
    n1, n2 = perpendicular_basis(axis)
    alignments = np.array([[axis, n1], [axis, n2]])
    return RowSet(_XYZ, alignments, axis[None], ("x", "y", "z", "axis_1", "axis_2"))


def _point_on_line(axis: FloatArray) -> RowSet:
    return RowSet(
        np.array(perpendicular_basis(axis)), _NO_ALIGNMENTS, _NO_ROWS, ("normal_1", "normal_2")
    )


def _point_on_plane(axis: FloatArray) -> RowSet:
    return RowSet(axis[None].copy(), _NO_ALIGNMENTS, _NO_ROWS, ("normal",))


CLOSURE_TYPES: Mapping[str, ClosureType] = MappingProxyType(
    {
        closure.name: closure
        for closure in (
            ClosureType("point", False, _point, "ball joint: the two origins coincide"),
            ClosureType("frame", False, _frame, "weld: the two frames coincide"),
            ClosureType("revolute", True, _revolute, "hinge: origins and axes coincide"),
            ClosureType(
                "point_on_line", True, _point_on_line, "a's origin on the line of b along axis"
            ),
            ClosureType(
                "point_on_plane",
                True,
                _point_on_plane,
                "a's origin in the plane through b's origin with normal axis",
            ),
        )
    }
)
