"""The structure of a mechanism, on which its generated code depends, and the numbers in it.

:func:`structure_of` splits the constants of a system into a :class:`Structure`, which is hashable,
and a vector of parameters.  The structure knows of each number only whether it is 0 or not and,
where it is a sign or part of a direction, whether it is 1 or -1, so that mechanisms of one topology
share one function.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.rheonomic import DrivenKinematics
from srm_mbs.dynamics.constraints.structure import rows_in_use
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.model.model_data import TreeNumbers, joint_type_data, tree_numbers

ROUNDING = 2.0**-52
"""Part of a body's moments that is rounding."""
ROTATION_ROUNDING = 4.0 * ROUNDING
"""Part of a rotation's unit that is rounding: files give placements as products of rotations."""
SMALLEST_LIMB = 4
"""Motions of limbs that are matched, at least."""
MOST_DIFFERENT = 0.1
"""Part of the numbers of two limbs that are of another kind in one of them, at most."""
ZERO, ONE, MINUS_ONE, OTHER = range(4)
"""Codes of numbers."""
_OF_ANY = frozenset([OTHER])
"""Codes of numbers that may be any but ``_OF_OTHERS``."""
_OF_OTHERS = frozenset([0.0, 1.0, -1.0])


class Span(NamedTuple):
    """Consecutive numbers of the vector of parameters."""

    start: int
    length: int


class Motion(NamedTuple):
    """A joint of one of the elementary kinds, with its body.

    Attributes
    ----------
    kind
        ``revolute``, ``unbounded``, ``prismatic``, ``helical``, ``free``, ``planar``,
        ``spherical`` or ``translation``.
    parent
        Number of the motion before it in the tree; -1 for the ground.
    in_q, in_v
        Its first places in q and v.
    axis, pitch, placement
        Unit axis (3) and pitch (m/rad) of the kinds that have them; rotation, row by row, and
        translation (12) from the parent, on the ground from the base.
    base
        Place on the ground (3) from which the places in its tree are counted, of the first motion
        of a tree: ``Workspace`` of workspace.hpp.
    inertia
        Mass, centre of mass (3), moments about it (6: xx, xy, xz, yy, yz, zz), in its own axes.
    """

    kind: str
    parent: int
    in_q: int
    in_v: int
    axis: Span
    pitch: Span
    placement: Span
    base: Span
    inertia: Span


class Closure(NamedTuple):
    """The rows of a closure: ``ClosureRows`` of system.hpp; ``support`` has pairs of column and
    sign."""

    joint_a: int
    joint_b: int
    first_row: int
    at_a: Span
    at_b: Span
    directions: Span
    distances: Span
    alignments: Span
    support: tuple[tuple[int, int], ...]


class CoordinateRow(NamedTuple):
    """``JointRow`` of system.hpp."""

    row: int
    in_q: tuple[int, ...]
    in_v: tuple[int, ...]
    coefficients: Span
    offset: Span
    arguments: Span
    powers: Span


class Subtraction(NamedTuple):
    """``Elimination`` of system.hpp."""

    row: int
    other: int
    factor: Span
    columns: tuple[int, ...]


class Force(NamedTuple):
    """``ForceElement`` of forces.hpp, ``kind`` a name.

    Attributes
    ----------
    factors
        ``signs`` of the columns.
    coefficients
        Stiffness, damping and rest (3).
    laws
        Number of the first curve of its numbers among those of the mechanism, and their count.
    held
        Number of its law among those that stiff steps hold; -1: it has none, or that of its
        coordinate.
    """

    kind: str
    joint_a: int
    joint_b: int
    at_a: Span
    at_b: Span
    columns: tuple[int, ...]
    factors: Span
    positions: tuple[int, ...]
    coefficients: Span
    in_q: int
    in_v: int
    in_link_axes: bool
    numbers: Span
    laws: Span
    held: int


class Bushing(NamedTuple):
    """A bushing, which the kernel evaluates, because its moments depend on the step, and of which
    stiff steps take derivatives.

    Attributes
    ----------
    factors
        ``signs`` of the columns.
    coefficients
        Stiffness (6) and damping (6).
    held
        Numbers of the laws (6) of its forces and moments, as of :class:`Force`.
    """

    joint_a: int
    joint_b: int
    at_a: Span
    at_b: Span
    columns: tuple[int, ...]
    factors: Span
    coefficients: Span
    held: tuple[int, ...]


class Structure(NamedTuple):
    """All of it.

    Attributes
    ----------
    codes
        ZERO, ONE, MINUS_ONE or OTHER, which may be any, for each number of the vector of
        parameters.
    bodies
        Number of the motion that carries the body of each joint of the model; -1 for the ground.
    bushing_joints, bushing_columns
        Joints of the bodies between which bushings act, without the ground, and rates that move
        them.
    held
        Number of the laws of elements between links that stiff steps hold: ``ForceLaws`` of
        forces.hpp, without those of coordinates.
    passive
        Whether damping or friction acts on a coordinate.
    """

    nq: int
    nv: int
    rows: int
    rank: int
    gravity: Span
    armature: Span
    coincident: Span
    motions: tuple[Motion, ...]
    bodies: tuple[int, ...]
    closures: tuple[Closure, ...]
    coordinate_rows: tuple[CoordinateRow, ...]
    subtractions: tuple[Subtraction, ...]
    forces: tuple[Force, ...]
    bushings: tuple[Bushing, ...]
    held: int
    passive: bool
    bushing_joints: tuple[int, ...]
    bushing_columns: tuple[int, ...]
    codes: bytes


class Origin(NamedTuple):
    """A mechanism whose structure others may have.

    Attributes
    ----------
    tree, gravity, armature
        Numbers of its model.
    idle
        Of its rows in use, which rows share that were moved; None without effective closures.
    places
        Where the parameters have the places of the anchors of its closures.
    structure, parameters
        What :func:`structure_of` gives.
    """

    tree: TreeNumbers
    gravity: bytes
    armature: bytes
    idle: deque[Any] | None
    places: list[int]
    structure: Structure
    parameters: FloatArray

    @classmethod
    def of(cls, mechanism: Mechanism, structure: Structure, parameters: FloatArray) -> Origin:
        """``mechanism`` with its structure as an origin."""
        model, rows = mechanism.model, _rows(mechanism)
        numbers = model.gravity.vector.tobytes(), model.armature.tobytes()
        idle = None if rows is None else rows.idle
        ends = [end for closure in structure.closures for end in (closure.at_a, closure.at_b)]
        places = [place for start, n in ends for place in range(start, start + n)]
        tree = tree_numbers(model)
        return cls(tree, *numbers, idle, places, structure, parameters)


class UnsupportedElementError(Exception):
    """The mechanism has an element that is not generated; the message names it as a clause."""


_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
_ALIGNED = {"R": "revolute", "RUB": "unbounded", "P": "prismatic", "H": "helical"}
_UNALIGNED = {
    "RevoluteUnaligned": "revolute",
    "RevoluteUnboundedUnaligned": "unbounded",
    "PrismaticUnaligned": "prismatic",
    "HelicalUnaligned": "helical",
}
_WHOLE = {
    "FreeFlyer": "free",
    "Planar": "planar",
    "Spherical": "spherical",
    "Translation": "translation",
}
_SIZES = {"free": (7, 6), "planar": (4, 3), "spherical": (4, 3), "translation": (3, 3)}
"""Numbers of coordinates and of rates of the kinds that have more than one rate."""
_NO_PLACEMENT = (*np.eye(3).ravel().tolist(), 0.0, 0.0, 0.0)


class _Part(NamedTuple):
    """An elementary motion of a joint, before its body."""

    kind: str
    axis: Sequence[float]
    pitch: Sequence[float]
    placement: Sequence[float]


def _parts(kind: Mapping[str, Any], name: str, placement: Sequence[float]) -> list[_Part]:
    """A joint, as :class:`~srm_mbs.model.model_data.JointTypeData` has it, as elementary ones."""
    own: str = kind["type"]
    if own in _WHOLE:
        return [_Part(_WHOLE[own], (), (), placement)]
    if own in _UNALIGNED:
        return [_Part(_UNALIGNED[own], kind["axes"][0], kind.get("numbers", ()), placement)]
    if own[:-1] in _ALIGNED and own[-1] in _AXES:
        return [_Part(_ALIGNED[own[:-1]], _AXES[own[-1]], kind.get("numbers", ()), placement)]
    if own == "Universal":
        first, second = kind["axes"]
        return [
            _Part("revolute", first, (), placement),
            _Part("revolute", second, (), _NO_PLACEMENT),
        ]
    if own == "SphericalZYX":
        return [
            _Part("revolute", _AXES[letter], (), placement if letter == "Z" else _NO_PLACEMENT)
            for letter in "ZYX"
        ]
    if own == "Composite":
        out = []
        for i, part in enumerate(kind["parts"]):
            at = _product(placement, part["placement"]) if i == 0 else part["placement"]
            out += _parts(part["kind"], name, at)
        return out
    raise UnsupportedElementError(f"the joint {name!r} is of the type {own}")


def _product(first: Sequence[float], second: Sequence[float]) -> list[float]:
    """Two placements one after the other."""
    a, b = np.asarray(first), np.asarray(second)
    R = a[:9].reshape(3, 3)
    rotation = R @ b[:9].reshape(3, 3)
    return [*rotation.ravel().tolist(), *(a[9:] + R @ b[9:]).tolist()]


class _Numbers:
    """Collects the parameters, after the ``values`` that there are."""

    def __init__(self, values: Iterable[float] = ()) -> None:
        self.values = list(values)
        self.units: list[Span] = []
        """Those among which 1 and -1 are no sizes, but signs or directions."""

    def take(self, values: Any, units: bool = False) -> Span:
        """Append ``values``."""
        span = Span(len(self.values), len(values))
        self.values.extend(values)
        if units:
            self.units.append(span)
        return span

    def codes(self) -> bytes:
        """The code of each number."""
        values = np.array(self.values, dtype=float)
        out = np.where(values == 0.0, ZERO, OTHER).astype(np.uint8)
        for start, count in self.units:
            own = slice(start, start + count)
            out[own][values[own] == 1.0] = ONE
            out[own][values[own] == -1.0] = MINUS_ONE
        return out.tobytes()

    def rotated(self, placement: Sequence[float]) -> Span:
        """Append a placement (12); of its rotation, what is rounding is left out."""
        span = self.take(_turn(placement), units=True)
        return Span(span.start, span.length + self.take(placement[9:]).length)


def _turn(placement: Sequence[float]) -> list[float]:
    """The rotation (9) of a placement (12), without what is rounding."""
    rotation = list(placement[:9])
    return rotation if rotation == _UNTURNED else [_rounded(x) for x in rotation]


_UNTURNED = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def _rounded(x: float) -> float:
    """An entry of a rotation without what is rounding of 0, 1 or -1."""
    nearest = round(x)
    return float(nearest) if abs(x - nearest) <= ROTATION_ROUNDING else float(x)


def _inertia(body: Sequence[float]) -> list[float]:
    """The parameters of a body, a row of :class:`~srm_mbs.model.model_data.TreeNumbers`."""
    # With plain numbers, because NumPy takes several times as long for so few.
    mass, moments = body[0], body[4:]
    rounding = ROUNDING * max(map(abs, moments))
    tensor = [0.0 if abs(moment) <= rounding else moment for moment in moments]
    return [*([0.0] * 4 if mass == 0.0 else body[:4]), *tensor]


def _signs(support: FloatArray) -> tuple[tuple[int, int], ...]:
    return tuple((int(j), int(support[j])) for j in np.flatnonzero(support))


_NO_ANCHOR = (0, np.array(_NO_PLACEMENT))


def structure_of(model: pin.Model, constants: Mapping[str, Any]) -> tuple[Structure, FloatArray]:
    """Structure and parameters of a system.

    Parameters
    ----------
    model
        Its tree.
    constants
        From :meth:`~srm_mbs.dynamics.multibody.Mechanics.constants`.

    Raises
    ------
    UnsupportedElementError
        If no code can be generated for an element.
    """
    numbers = _Numbers()
    motions, bodies = _tree(model, numbers)
    fields: dict[str, Any] = {
        "nq": int(model.nq),
        "nv": int(model.nv),
        "rows": int(constants["rows"]),
        "rank": int(constants["structural_rank"]),
        "gravity": numbers.take(model.gravity.vector.tolist()),
        "armature": numbers.take(model.armature.tolist()),
        "coincident": numbers.take([float(constants["coincident"])]),
        "motions": motions,
        "bodies": bodies,
        **_rows_of_closures(numbers, constants),
        "passive": any(constants[key] is not None for key in ("damping", "friction")),
    }
    fields |= _forces(numbers, constants["forces"])
    bushings = [force for force in constants["forces"] if force["kind"] == "bushing"]
    joints = [int(force[end][0]) for force in bushings for end in ("a", "b")]
    columns = {int(j) for force in bushings for j in np.flatnonzero(force["support"])}
    # In the order in which they are met, as generated.cpp's caller has them.
    fields["bushing_joints"] = tuple(dict.fromkeys(joint for joint in joints if joint))
    fields["bushing_columns"] = tuple(sorted(columns))
    codes = _matched(motions, numbers.codes())
    return Structure(codes=codes, **fields), np.array(numbers.values, dtype=float)


def _matched(motions: Sequence[Motion], codes: bytes) -> bytes:
    """The codes, where limbs that nearly have the same have the same.

    Two neighbours with equal joints, as the legs of a robot, may differ in few zeros: one has a
    rotation where the other has none.  With OTHER for these, all their operations are equal
    (:mod:`srm_mbs.integration.generated.pairs`).
    """
    children: list[list[int]] = [[] for _ in motions]
    for i, motion in enumerate(motions):
        if motion.parent >= 0:
            children[motion.parent].append(i)
    numbers_of_forms: dict[tuple[object, ...], int] = {}
    forms, sizes = [0] * len(motions), [1] * len(motions)
    siblings: dict[tuple[int, int], list[int]] = {}
    for i in reversed(range(len(motions))):
        own = motions[i]
        # Sums divide by masses: those are equal, or none.
        form = (own.kind, codes[own.inertia.start], *[forms[child] for child in children[i]])
        forms[i] = numbers_of_forms.setdefault(form, len(numbers_of_forms))
        sizes[i] += sum(sizes[child] for child in children[i])
        if sizes[i] >= SMALLEST_LIMB:
            siblings.setdefault((own.parent, forms[i]), []).insert(0, i)
    out = np.frombuffer(codes, dtype=np.uint8).copy()
    for alike in siblings.values():
        for pair in zip(alike[::2], alike[1::2]):
            one, other = (_comparable(limb, motions, children) for limb in pair)
            differ = out[one] != out[other]
            if np.count_nonzero(differ) <= MOST_DIFFERENT * len(one):
                out[one[differ]] = out[other[differ]] = OTHER
    return out.tobytes()


def _comparable(
    limb: int, motions: Sequence[Motion], children: Sequence[Sequence[int]]
) -> IndexArray:
    """Places of the numbers of a limb, depth first, without the masses."""
    places: list[int] = []
    left = [limb]
    while left:
        own = motions[left[-1]]
        left[-1:] = children[left[-1]]
        for start, length in (own.axis, own.placement):
            places += range(start, start + length)
        places += range(own.inertia.start + 1, own.inertia.start + own.inertia.length)
    return np.array(places)


def parameters_of_variant(mechanism: Mechanism, origin: Origin) -> FloatArray | None:
    """The parameters of a mechanism with the structure of ``origin``, whose tree it has; None
    unless the two differ in placements and inertias of joints of one degree of freedom, and in
    numbers of closures, alone, and have neither force elements nor couplings.

    They are those of :func:`structure_of`, in a tenth of its time where most are the same.
    """
    structure, model = origin.structure, mechanism.model
    if mechanism.forces or structure.forces or structure.bushings or structure.coordinate_rows:
        return None
    if len(structure.motions) != model.njoints - 1 or mechanism.structure.rank != structure.rank:
        return None
    if model.gravity.vector.tobytes() != origin.gravity:
        return None
    if model.armature.tobytes() != origin.armature:
        return None
    if any(model.damping.tolist() + model.friction.tolist()) != structure.passive:
        return None
    out, tree, rows = origin.parameters.copy(), tree_numbers(model), _rows(mechanism)
    if rows is not None and rows.idle is origin.idle:  # the places alone are others
        out[origin.places] = [x for place in rows.origins for x in place]
    elif rows is not None:
        numbers = _Numbers(out[: sum(structure.coincident)].tolist())
        found = _rows_of_closures(numbers, rows.constants())
        if len(rows.g) != structure.rows or structure._replace(**found) != structure:
            return None
        out[:] = numbers.values
    for joint in _differing_rows(tree.placements, origin.tree.placements):
        placement, motion = tree.placements[joint].tolist(), structure.motions[joint - 1]
        base, above = (placement[9:], [0.0] * 3) if motion.base.length else ([], placement[9:])
        _write(out, motion.base, base)
        _write(out, motion.placement, [*_turn(placement), *above])
    for joint in _differing_rows(tree.bodies, origin.tree.bodies):
        _write(out, structure.motions[joint - 1].inertia, _inertia(tree.bodies[joint].tolist()))
    # Where a number was 0, a sign or no sign, the structure is another.
    changed = (out != origin.parameters).nonzero()[0]
    codes = np.frombuffer(structure.codes, np.uint8)[changed].tolist()
    same = _OF_ANY.issuperset(codes) and _OF_OTHERS.isdisjoint(out[changed].tolist())
    return out if same else None


def _rows(mechanism: Mechanism) -> DrivenKinematics | None:
    """The rows in use; None without effective closures."""
    return rows_in_use(mechanism) if mechanism.structure.rank else None


def _differing_rows(numbers: FloatArray, others: FloatArray) -> list[int]:
    """Numbers of the joints whose rows differ."""
    return (np.flatnonzero((numbers != others)[1:].any(axis=1)) + 1).tolist()


def _write(parameters: FloatArray, span: Span, values: Sequence[float] | FloatArray) -> None:
    parameters[span.start : span.start + span.length] = values


def _tree(model: pin.Model, numbers: _Numbers) -> tuple[tuple[Motion, ...], tuple[int, ...]]:
    numbers_of_joints = tree_numbers(model)
    motions: list[Motion] = []
    bodies = [-1]
    massless = [0.0] * 10
    straight = not model.gravity.angular.any()
    for i in range(1, model.njoints):
        joint, placement = model.joints[i], numbers_of_joints.placements[i].tolist()
        body = numbers_of_joints.bodies[i].tolist()
        base: list[float] = []
        if not model.parents[i] and straight:
            base, placement[9:] = placement[9:], [0.0] * 3
        parts = _parts(joint_type_data(joint), model.names[i], placement)
        parent, in_q, in_v = bodies[int(model.parents[i])], int(joint.idx_q), int(joint.idx_v)
        for part in parts:
            own = _inertia(body) if part is parts[-1] else massless
            spans = numbers.take(part.axis, units=True), numbers.take(part.pitch)
            placed = numbers.rotated(part.placement), numbers.take(base)
            motions.append(
                Motion(part.kind, parent, in_q, in_v, *spans, *placed, numbers.take(own))
            )
            parent, base = len(motions) - 1, []
            nq, nv = _SIZES.get(part.kind, (2 if part.kind == "unbounded" else 1, 1))
            in_q, in_v = in_q + nq, in_v + nv
        bodies.append(parent)
    return tuple(motions), tuple(bodies)


def _rows_of_closures(numbers: _Numbers, constants: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a structure for the rows of closures."""
    return {
        "closures": tuple(_closure(numbers, **rows) for rows in constants["loops"]),
        "coordinate_rows": tuple(_row(numbers, **row) for row in constants["joint_rows"]),
        "subtractions": tuple(
            Subtraction(row, other, numbers.take([factor]), tuple(columns))
            for row, other, factor, columns in constants["eliminations"]
        ),
    }


def _closure(
    numbers: _Numbers,
    joint_a: int,
    joint_b: int,
    first_row: int,
    support: FloatArray,
    at_a: FloatArray,
    at_b: FloatArray,
    directions: FloatArray,
    distances: FloatArray,
    alignments: FloatArray,
) -> Closure:
    return Closure(
        joint_a,
        joint_b,
        first_row,
        numbers.take(at_a.tolist()),
        numbers.take(at_b.tolist()),
        numbers.take(directions.tolist(), units=True),
        numbers.take(distances.tolist(), units=True),
        numbers.take(alignments.tolist(), units=True),
        _signs(support),
    )


def _row(
    numbers: _Numbers,
    row: int,
    in_q: Sequence[int],
    in_v: Sequence[int],
    coefficients: FloatArray,
    offset: float,
    arguments: FloatArray,
    powers: FloatArray,
) -> CoordinateRow:
    return CoordinateRow(
        row,
        tuple(in_q),
        tuple(in_v),
        numbers.take(coefficients.tolist(), units=True),
        numbers.take([offset]),
        numbers.take(arguments.tolist(), units=True),
        numbers.take(powers.tolist()),
    )


def _forces(numbers: _Numbers, forces: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The fields of a structure for the force elements."""
    out, bushings = [], []
    laws = held = 0
    for force in forces:
        a, b = force.get("a", _NO_ANCHOR), force.get("b", _NO_ANCHOR)
        support = np.asarray(force.get("support", ()), dtype=float)
        columns = np.flatnonzero(support)
        ends = int(a[0]), int(b[0]), numbers.rotated(a[1].tolist()), numbers.rotated(b[1].tolist())
        moves = tuple(columns.tolist()), numbers.take(support[columns].tolist(), units=True)
        own = np.asarray(force.get("numbers", ()))
        if force["kind"] == "bushing":
            acts = (own[:6] > 0.0) | (own[6:] > 0.0)
            law_of = np.where(acts, held + np.cumsum(acts) - 1, -1)
            bushings.append(
                Bushing(*ends, *moves, numbers.take(own.tolist()), tuple(law_of.tolist()))
            )
            held += int(acts.sum())
            continue
        has_law = force["kind"] == "coupling_spring" or (
            force["kind"] == "spring_damper" and (force["rest"] > 0.0 or own.size)
        )
        curves = len(force.get("curves", ()))
        out.append(
            Force(
                force["kind"],
                *ends,
                *moves,
                tuple(force.get("positions", ())),
                numbers.take([force.get(key, 0.0) for key in ("stiffness", "damping", "rest")]),
                force.get("in_q", 0),
                force.get("in_v", 0),
                bool(force.get("in_link_axes", False)),
                numbers.take(own.tolist()),
                Span(laws, curves),
                held if has_law else -1,
            )
        )
        laws += curves
        held += has_law
    return {"forces": tuple(out), "bushings": tuple(bushings), "held": held}
