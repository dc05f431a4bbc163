r"""Loop closures as immutable data; :mod:`srm_mbs.dynamics.constraints.rows` evaluates them.

A closure ties an anchor frame *a* on one body to an anchor frame *b* on another, or joints to each
other.  With the position p of a's origin and the rotation R of a's axes, both in b's frame, and the
coordinates q_i of joints with one degree of freedom, every type below is a set of scalar rows of
four kinds:

* *position rows*   g = d . p,      d a constant unit vector in b;
* *distance rows*   g = |p| - L,    L a length;
* *alignment rows*  g = n . (R u),  u constant in a, n constant in b (zero when they are
  perpendicular; used with R u close to a vector that is perpendicular to n);
* *joint rows*      g = sum c_i q_i - s - sum a_k y^k,  k = 2, 3, ...,  y = sum b_i q_i; c_i, s, a_k
  and b_i constant.

A new type made of these is one more entry of :data:`CLOSURE_TYPES`; its Jacobian, its
:math:`\dot G v`, its reactions and its assembly follow from the kinds of row.

The fields of :class:`LoopClosure` are the one list of the keys of a closure: descriptions
(:mod:`srm_mbs.formats.toml.schema`) and saved runs (:mod:`srm_mbs.simulation.storage`) read them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.errors import InputError, known_names, safe_repr
from srm_mbs.model.anchors import Anchor, check_apart, name_places, one_degree_joint
from srm_mbs.model.copies import copied, short_repr
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import (
    checked_name,
    finite_array,
    finite_number,
    finite_numbers,
    plain,
    unit_vector,
)


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
    """g = sum c_i q_i - s - sum a_k y^k over joints with one coordinate and one degree of freedom.

    Attributes
    ----------
    joints
        Their names.
    coefficients
        c_i; products with q_i have the unit of the offset.
    offset
        s, in the unit of the row: that of the first joint (rad or m) where c_1 is a pure number.
    arguments
        b_i, of y = sum b_i q_i, where there are powers; empty in a linear row.
    powers
        a_2, a_3, ...; empty in a linear row.
    """

    joints: tuple[str, ...]
    coefficients: tuple[float, ...]
    offset: float = 0.0
    arguments: tuple[float, ...] = ()
    powers: tuple[float, ...] = ()

    def gradient(self, q: FloatArray) -> FloatArray:
        """dg/dq_i (n, joints) at the coordinates q (n, joints)."""
        out = np.tile(self.coefficients, (len(q), 1))
        if self.powers:
            b = np.array(self.arguments)
            slope = np.polynomial.Polynomial((0.0, 0.0, *self.powers)).deriv()
            out -= np.outer(slope(q @ b), b)
        return out


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
        assembly uses them, because the alignment rows alone also admit the reversed axis (a
        type without any, as the universal joint, is its alignment rows alone)
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

    @cached_property
    def blocks(self) -> tuple[slice, slice, slice]:
        """The rows that are lengths (position and distance rows), alignments, and joint rows."""
        lengths = len(self.directions) + len(self.distances)
        joints = lengths + len(self.alignments)
        return slice(0, lengths), slice(lengths, joints), slice(joints, self.count)

    @cached_property
    def unambiguous(self) -> IndexArray:
        """The rows whose only zeros are the intended closed configurations: where the closure
        matches axes, the zeros of its alignments also have them reversed."""
        lengths, alignments, joints = self.blocks
        own = np.arange(self.count)
        turns = own[:0] if len(self.matched) else own[alignments]
        return np.concatenate([own[lengths], turns, own[joints]])

    def without(self, labels: Collection[str]) -> RowSet:
        """The same rows but those called ``labels``."""
        kept = np.array([label not in labels for label in self.labels])
        own = [kept[block] for block in self.blocks]
        k = len(self.directions)
        return replace(
            self,
            labels=tuple(label for label in self.labels if label not in labels),
            directions=self.directions[own[0][:k]],
            distances=tuple(np.array(self.distances)[own[0][k:]].tolist()),
            alignments=self.alignments[own[1]],
            joint_rows=tuple(row for row, keep in zip(self.joint_rows, own[2]) if keep),
        )


@dataclass(frozen=True)
class ClosureValues:
    """Constants of the rows of a closure: unit axes (3,) and a length (m), as far as its type has
    them."""

    axis: FloatArray = field(default_factory=lambda: np.zeros(3))
    axis_a: FloatArray = field(default_factory=lambda: np.zeros(3))
    axis_b: FloatArray = field(default_factory=lambda: np.zeros(3))
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
        A short description.
    """

    name: str
    needs: tuple[str, ...]
    rows: Callable[[ClosureValues], RowSet]
    summary: str
    takes: tuple[str, ...] = ()


def _point(_: ClosureValues) -> RowSet:
    return RowSet(("x", "y", "z"), _XYZ)


_RELATIVE_ROTATION = np.array([[_XYZ[1], _XYZ[2]], [_XYZ[2], _XYZ[0]], [_XYZ[0], _XYZ[1]]])
"""At R = 1 the rates of these alignments are the components of the relative angular velocity."""


def _frame(_: ClosureValues) -> RowSet:
    return RowSet(("x", "y", "z", "rx", "ry", "rz"), _XYZ, _RELATIVE_ROTATION, _XYZ)


def _axis_rows(axis: FloatArray) -> FloatArray:
    """The two alignments that keep ``axis`` of a parallel to ``axis`` of b."""
    n1, n2 = perpendicular_basis(axis)
    return np.array([[axis, n1], [axis, n2]])


def _revolute(values: ClosureValues) -> RowSet:
    labels = ("x", "y", "z", "axis_1", "axis_2")
    return RowSet(labels, _XYZ, _axis_rows(values.axis), values.axis[None])


def _prismatic(values: ClosureValues) -> RowSet:
    across = np.array(perpendicular_basis(values.axis))
    return RowSet(("normal_1", "normal_2", "rx", "ry", "rz"), across, _RELATIVE_ROTATION, _XYZ)


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

_TYPES = (
    ClosureType("point", _ANCHORS, _point, "ball joint: the two origins coincide"),
    ClosureType("frame", _ANCHORS, _frame, "weld: the two frames coincide"),
    ClosureType("revolute", _WITH_AXIS, _revolute, "hinge: origins and axes coincide"),
    ClosureType(
        "prismatic", _WITH_AXIS, _prismatic, "slider: a moves in b along axis, without turn"
    ),
    ClosureType("cylindrical", _WITH_AXIS, _cylindrical, "a slides along axis and turns about it"),
    ClosureType(
        "universal",
        (*_ANCHORS, "axis_a", "axis_b"),
        _universal,
        "Hooke joint: the origins coincide, axis_a of a is perpendicular to axis_b of b",
    ),
    ClosureType("planar", _WITH_AXIS, _planar, "a moves in the plane of b with normal axis"),
    ClosureType(
        "point_on_line", _WITH_AXIS, _point_on_line, "a's origin on the line of b along axis"
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
        "gear, cam: a linear or polynomial relation of joint coordinates",
        ("ratio", "coefficients", "offset", "polynomial", "arguments"),
    ),
)
CLOSURE_TYPES: Mapping[str, ClosureType] = MappingProxyType({kind.name: kind for kind in _TYPES})
"""The closures by their type in a description."""


_ALWAYS = ("type", "name", "without")
"""Keys of every closure."""
UNIT_LENGTH_TOLERANCE = 1e-9
"""Deviation of the length of a unit vector from 1 that is rounding."""
_ROW_SHAPES = {"directions": (3,), "alignments": (2, 3), "matched": (3,)}
"""Shapes of the vectors of one row of a :class:`RowSet`."""

COINCIDENCE_TOLERANCE = 1e-9
"""Distance of two points, over their distance from the world's origin, that is rounding."""


def _key(words: str, form: str) -> Any:
    """A key of a closure, None by default; for messages its name with an article, and its form."""
    return field(default=None, metadata={"words": words, "remedy": f"Give {form}"})


def _text(value: Any) -> str:
    return plain(value) if isinstance(value, str) else safe_repr(value)


def _listed(value: Any) -> tuple[Any, ...]:
    if isinstance(value, str):
        return (value,)
    try:
        return tuple(value)
    except Exception:  # objects may raise anything
        return ()


@dataclass(frozen=True, repr=False)
class LoopClosure:
    """One loop closure: between anchors ``a`` and ``b``, or (``coupling``) between joints.

    Parameters
    ----------
    type
        A key of :data:`srm_mbs.model.closures.CLOSURE_TYPES`, or a
        :class:`~srm_mbs.model.closures.ClosureType` of one's own.
    a, b
        The two anchors.
    axis : (3,)
        Direction in b's frame, for the types that have one; normalised here.
    name
        Unique name; by default made from the type and the links or joints.
    axis_a, axis_b : (3,)
        ``universal``: the axes of the cross, in a's and in b's frame; normalised here.
    length
        ``distance``: m; by default the distance in the initial configuration (the guess), which
        :class:`~srm_mbs.dynamics.mechanism.Mechanism` fills in.
    joints
        ``coupling``: names of joints with one degree of freedom.
    ratio, offset
        ``coupling`` of two joints: q_a = ratio q_b + offset, in rad or m; offset 0 by default.
    coefficients
        ``coupling`` of any number of joints, instead of ``ratio``: sum c_i q_i = offset.
    polynomial
        ``coupling`` of two joints, instead of ``ratio`` and ``offset``: a_0, a_1, a_2, ... of
        q_a = a_0 + a_1 q_b + a_2 q_b^2 + ..., in rad or m.
    arguments
        ``polynomial`` of any number of joints: b_i of sum c_i q_i = a_0 + a_1 y + a_2 y^2 + ...
        with y = sum b_i q_i; c_i are ``coefficients``.  Of the two numbers of a joint one may be 0.
    without
        Labels of rows that are left out, because other closures imply them; the others are as they
        are in the type.

    Raises
    ------
    InputError
        For an unknown type; for an anchor, axis or other key that is missing, superfluous or
        cannot be.
    """

    type: str | ClosureType
    a: Anchor | None = _key("an anchor a", '"a = { link = ... }"')  # noqa: RUF009 - a field
    b: Anchor | None = _key("an anchor b", '"b = { link = ... }"')  # noqa: RUF009 - a field
    axis: tuple[float, float, float] | None = _key("an axis", '"axis = [x, y, z]", in b\'s frame')
    name: str = ""
    axis_a: tuple[float, float, float] | None = _key(
        "an axis_a", '"axis_a = [x, y, z]", in a\'s frame'
    )
    axis_b: tuple[float, float, float] | None = _key(
        "an axis_b", '"axis_b = [x, y, z]", in b\'s frame'
    )
    length: float | None = _key("a length", '"length = ...", in m')
    joints: tuple[str, ...] | None = _key("joints", '"joints = [first, second]"')
    ratio: float | None = _key("a ratio", '"ratio = ..."')
    coefficients: tuple[float, ...] | None = _key("coefficients", '"coefficients = [...]"')
    offset: float | None = _key("an offset", '"offset = ..."')
    polynomial: tuple[float, ...] | None = _key("a polynomial", '"polynomial = [...]"')
    arguments: tuple[float, ...] | None = _key("arguments", '"arguments = [...]"')
    without: tuple[str, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        given = self.type
        if isinstance(given, ClosureType) and CLOSURE_TYPES.get(given.name) is given:
            object.__setattr__(self, "type", given.name)
        places = name_places(self._element, self.a, self.b)
        name = checked_name(self.name, "loop")
        if not name:
            name = "_".join((self.type_name, *map(_text, places or _listed(self.joints))))
        object.__setattr__(self, "name", name)
        known = isinstance(self.type, str) and self.type in CLOSURE_TYPES
        if not (known or isinstance(self.type, ClosureType)):
            raise self._fault(
                f"there is no closure type {safe_repr(self.type)}",
                known_names(CLOSURE_TYPES),
            )
        kind = self.kind
        if not known:
            self._check_keys_of(kind)
        for entry in fields(self):
            key, missing = entry.name, getattr(self, entry.name) is None
            if missing and key in kind.needs:
                problem = f"a {kind.name} closure needs {entry.metadata['words']}"
                raise self._fault(problem, entry.metadata["remedy"])
            if not missing and key not in (*_ALWAYS, *kind.needs, *kind.takes):
                raise self._fault(f"a {kind.name} closure takes no {key}", f'Remove "{key}"')
        for key in ("axis", "axis_a", "axis_b"):
            given = getattr(self, key)
            if given is not None:
                object.__setattr__(self, key, unit_vector(given, key, self._element))
        if self.length is not None:
            self._take_length()
        if self.joints is not None:
            self._take_joints(self.joints)
        self._take_without()
        if not known:
            _ = self.rows  # which checks them

    def _check_keys_of(self, kind: ClosureType) -> None:
        """Refuse keys of a type of the user that closures do not have."""
        keys = [entry.name for entry in fields(self) if entry.name not in _ALWAYS]
        for key in (*kind.needs, *kind.takes):
            if key not in keys:
                raise self._fault(
                    f"the closure type {safe_repr(kind.name)} needs or takes {safe_repr(key)}, "
                    "which closures do not have",
                    known_names(keys),
                )

    def between(self, a: Anchor, b: Anchor) -> LoopClosure:
        """The same closure between other places."""
        if self.type != "distance" or self.length is not None:
            _ = self.rows  # in the axes of the anchors, wherever these are: the copy has them, too
        return copied(self, a=a, b=b)

    @property
    def _element(self) -> str:
        """Its name in messages."""
        return f"loop {safe_repr(self.name or self.type_name)}"

    def _fault(self, problem: str, remedy: str) -> InputError:
        return InputError(problem, element=self._element, remedy=remedy)

    def _take_without(self) -> None:
        labels = _listed(self.without)
        known = self._of_type().labels if labels else ()
        for label in labels:
            if label not in known:
                raise self._fault(
                    f"a {self.kind.name} closure has no row {safe_repr(label)}",
                    known_names(known),
                )
        if labels and set(labels) == set(known):
            raise self._fault("all its rows are left out", "Remove the closure")
        object.__setattr__(self, "without", tuple(dict.fromkeys(map(plain, labels))))

    def _take_length(self) -> None:
        length = finite_number(self.length, "length", self._element)
        if length == 0.0:
            raise self._fault(
                "a distance of 0 has no direction",
                'Use type = "point", which makes the two origins coincide',
            )
        if length < 0.0:
            raise self._fault(f"the length {length:g} m is negative", "Give a length > 0")
        object.__setattr__(self, "length", length)

    def _take_joints(self, given: Sequence[str]) -> None:
        joints = _listed(given)
        if not joints or not all(isinstance(name, str) for name in joints):
            raise self._fault(
                f"joints = {safe_repr(given)} is not a list of names",
                'Give "joints = [first, second]"',
            )
        joints = tuple(map(plain, joints))
        for name in joints:
            if joints.count(name) > 1:
                raise self._fault(
                    f"the joint {name!r} is named twice", "Keep one, with the sum of both"
                )
        object.__setattr__(self, "joints", joints)
        if self.polynomial is not None or self.arguments is not None:
            self._take_polynomial(joints)
            return
        if (self.ratio is None) == (self.coefficients is None):
            raise self._fault(
                "a coupling needs a ratio, coefficients or a polynomial"
                if self.ratio is None
                else "a coupling takes either a ratio or coefficients",
                'Give "ratio = ..." (q_a = ratio q_b + offset) or "polynomial = [...]" for two '
                'joints, or "coefficients = [...]" (sum c_i q_i = offset)',
            )
        if self.ratio is not None:
            if len(joints) != 2:
                raise self._fault(
                    f"a ratio relates two joints, not {len(joints)}",
                    "Name two joints, or give coefficients",
                )
            ratio = finite_number(self.ratio, "ratio", self._element)
            object.__setattr__(self, "ratio", ratio)
            numbers: tuple[float, ...] = (ratio,)
        else:
            remedy = "Give one number for each joint"
            numbers = finite_numbers(
                self.coefficients, len(joints), "coefficients", remedy, self._element
            )
            object.__setattr__(self, "coefficients", numbers)
        if 0.0 in numbers:
            raise self._fault(
                "a ratio or coefficient is zero",
                "Remove that joint from the coupling; to hold a joint, name it in lock",
            )
        offset = 0.0 if self.offset is None else self.offset
        object.__setattr__(self, "offset", finite_number(offset, "offset", self._element))

    def _take_polynomial(self, joints: tuple[str, ...]) -> None:
        if self.polynomial is None:
            raise self._fault("arguments without a polynomial", 'Give "polynomial = [...]" as well')
        if self.ratio is not None or self.offset:
            raise self._fault(
                "a polynomial takes no ratio and no offset",
                "Give them as its first two numbers: [offset, ratio, ...]",
            )
        powers = finite_numbers(
            self.polynomial,
            len(_listed(self.polynomial)),
            "polynomial",
            "Give numbers: the constant, the factor of q_b, that of its square and so on",
            self._element,
        )
        if not any(powers[1:]):
            raise self._fault(
                "the polynomial is constant", "Name the joint in lock, which holds it"
            )
        object.__setattr__(self, "polynomial", powers)
        if (self.coefficients is None) != (self.arguments is None):
            raise self._fault(
                "a polynomial takes coefficients and arguments together, or neither",
                "Give both, or neither for a relation of two joints",
            )
        if self.coefficients is None:
            if len(joints) != 2:
                raise self._fault(
                    f"a polynomial relates two joints, not {len(joints)}",
                    "Name two joints, or give coefficients and arguments",
                )
            return
        sides = []
        for key in ("coefficients", "arguments"):
            remedy = "Give one number for each joint"
            numbers = finite_numbers(getattr(self, key), len(joints), key, remedy, self._element)
            object.__setattr__(self, key, numbers)
            sides.append(numbers)
        if not all(map(any, sides)) or not all(map(any, zip(*sides))):
            raise self._fault(
                "coefficients, arguments, or both numbers of a joint are zero",
                "Give each side of the relation a joint, and remove joints that are on neither",
            )

    @property
    def kind(self) -> ClosureType:
        """Its type."""
        return self.type if isinstance(self.type, ClosureType) else CLOSURE_TYPES[self.type]

    @property
    def type_name(self) -> str:
        """The name of its type."""
        return self.type.name if isinstance(self.type, ClosureType) else _text(self.type)

    @property
    def anchors(self) -> tuple[Anchor, ...]:
        """(a, b), or () for a coupling of joints."""
        return () if self.a is None or self.b is None else (self.a, self.b)

    @cached_property
    def rows(self) -> RowSet:
        """The scalar rows of this closure, in its anchors.

        Raises
        ------
        InputError
            If its length is not yet known: it belongs to no mechanism.
        """
        if self.type == "distance" and self.length is None:
            raise self._fault(
                "its length is known only when it is part of a mechanism",
                "Read it from mechanism.loops, or give a length",
            )
        rows = self._of_type()
        return rows.without(self.without) if self.without else rows

    def _of_type(self) -> RowSet:
        """All rows that its type has."""
        given: dict[str, Any] = {
            key: np.array(getattr(self, key))
            for key in ("axis", "axis_a", "axis_b")
            if getattr(self, key) is not None
        }
        if self.length is not None:
            given["length"] = self.length
        if self.joints is not None:
            given["joint_row"] = self._joint_row(self.joints)
        rows = self.kind.rows(ClosureValues(**given))
        return self._checked_rows(rows) if isinstance(self.type, ClosureType) else rows

    def _checked_rows(self, rows: Any) -> RowSet:
        """The ``rows`` that a type of the user returned, their numbers as arrays.

        Raises
        ------
        InputError
            If they are not those of a :class:`RowSet`, or cannot be evaluated.
        """
        if not isinstance(rows, RowSet):
            raise self._fault(
                f"the rows of the type {safe_repr(self.type_name)} are {safe_repr(rows)}",
                "Return a RowSet",
            )
        arrays: dict[str, FloatArray] = {}
        for key, shape in _ROW_SHAPES.items():
            given = getattr(rows, key)
            array = finite_array(given, (None, *shape))
            if array is None or not np.allclose(
                np.linalg.norm(array, axis=-1), 1.0, rtol=0.0, atol=UNIT_LENGTH_TOLERANCE
            ):
                raise self._fault(
                    f"the {key} {safe_repr(given)} are not unit vectors",
                    f"Give an array of shape (n, {', '.join(map(str, shape))})",
                )
            arrays[key] = array
        distances = finite_array(rows.distances, (None,))
        if distances is None or (distances <= 0.0).any():
            raise self._fault(
                f"the distances {safe_repr(rows.distances)} are not positive numbers",
                "Give a list of lengths (m)",
            )
        joint_rows = _listed(rows.joint_rows)
        for row in joint_rows:
            self._check_joint_row(row)
        anchored = len(arrays["directions"]) + len(distances) + len(arrays["alignments"])
        if len(joint_rows) > (0 if anchored else 1):
            raise self._fault(
                "a joint row is joined with other rows", "Give each joint row its own closure"
            )
        if anchored and not self.anchors:
            raise self._fault(
                "rows between anchors need a and b", "Put both among the needs of the type"
            )
        labels = () if isinstance(rows.labels, str) else _listed(rows.labels)
        count = anchored + len(joint_rows)
        named = all(isinstance(label, str) for label in labels)
        if not (count and named and count == len(labels) == len(set(labels))):
            raise self._fault(
                f"{count} rows have the labels {safe_repr(rows.labels)}",
                "Give at least one row, and each a label of its own",
            )
        return replace(
            rows,
            labels=labels,
            distances=tuple(distances.tolist()),
            joint_rows=joint_rows,
            **arrays,
        )

    def _check_joint_row(self, row: Any) -> None:
        """Refuse a joint row of a type of the user that cannot be evaluated."""
        if not isinstance(row, JointRow) or row.joints != self.joints:
            raise self._fault(
                f"the joint row {safe_repr(row)} is not over the joints of the closure",
                "Put joints among the needs of the type, and take values.joint_row.joints",
            )
        for key, count in (
            ("coefficients", len(row.joints)),
            ("arguments", len(row.joints) if row.powers else 0),
            ("powers", len(_listed(row.powers))),
        ):
            remedy = "Give one number for each joint"
            finite_numbers(getattr(row, key), count, key, remedy, self._element)
        finite_number(row.offset, "offset", self._element)

    def _joint_row(self, joints: tuple[str, ...]) -> JointRow:
        """The row of a coupling, the linear part of a polynomial among its coefficients."""
        if self.polynomial is None:
            coefficients = self.coefficients or (1.0, -float(self.ratio or 0.0))
            return JointRow(joints, coefficients, float(self.offset or 0.0))
        constant, slope, *powers = (*self.polynomial, 0.0)
        left, right = self.coefficients or (1.0, 0.0), self.arguments or (0.0, 1.0)
        coefficients = tuple(c - slope * b for c, b in zip(left, right))
        if not any(powers):
            return JointRow(joints, coefficients, constant)
        return JointRow(joints, coefficients, constant, right, tuple(powers))

    @property
    def row_names(self) -> tuple[str, ...]:
        """``loop.row`` for every row."""
        return tuple(f"{self.name}.{label}" for label in self.rows.labels)

    def resolve(self, model: pin.Model) -> tuple[tuple[int, pin.SE3], tuple[int, pin.SE3]]:
        """Joint and placement in it of both anchors, as :meth:`Anchor.resolve` gives them.

        Only for closures that have anchors.
        """
        a, b = self.anchors
        return a.resolve(model), b.resolve(model)

    def check(self, model: pin.Model) -> None:
        """Refuse anchors or joints that ``model`` does not have, or that cannot be tied.

        Raises
        ------
        InputError
            Naming the loop and the remedy.
        """
        if self.anchors:
            a, b = self.anchors
            check_apart(model, a, b, self._element)
        for name in self.joints or ():
            instead = "Couple joints with one degree of freedom"
            joint = one_degree_joint(model, name, self._element, instead)
            if joint.nq != 1:
                raise self._fault(
                    f"the joint {name!r} is stored as (cos, sin), which does not count turns",
                    "Build it as a revolute joint without limits (nq = 1); srm.load does that for "
                    "the continuous joints of a URDF",
                )

    def measured(self, model: pin.Model, q: FloatArray) -> LoopClosure:
        """The same closure, with a length that is not given measured at the configuration q (nq,).

        Raises
        ------
        InputError
            If the two points coincide there.
        """
        if self.type != "distance" or self.length is not None:
            return self
        data = workspace(model)
        pin.forwardKinematics(model, data, q)
        a, b = (data.oMi[joint].act(inside.translation) for joint, inside in self.resolve(model))
        length = float(np.linalg.norm(a - b))
        if length <= COINCIDENCE_TOLERANCE * max(np.linalg.norm(a), np.linalg.norm(b)):
            raise self._fault(
                "its two points coincide in the guess: a distance of 0 has no direction",
                'Use type = "point" if they are to coincide, or give a length or another guess',
            )
        return replace(self, length=length)
