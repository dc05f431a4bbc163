r"""Closure rows on Pinocchio kinematics: g, G and Gdot v.

For one closure let H be the frame with the axes of anchor b and its origin at anchor a.  In H

    W = H^{-1}(V_a - V_b) = (r, w)          relative velocity; r = p' as b sees it
    B = H^{-1}(A_a - A_b - V_b x V_a)       its rate without the joint accelerations

(V, A spatial velocities and bias accelerations in world axes at the world origin), so that a
position row g = d . p, a distance row g = |p| - L, d = p/|p|, and an alignment row g = n . m,
m = R u, have

    G  = d^T X_lin (J_a - J_b),             Gdot v = d . (B_lin + w x r),
    G  = d^T X_lin (J_a - J_b),             Gdot v = d . (B_lin + w x r) + |d x r|^2/|p|,
    G  = (m x n)^T X_ang (J_a - J_b),       Gdot v = n . (B_ang x m + w x (w x m)),

with X = H^{-1} as a 6 x 6 matrix and J the world-frame joint Jacobian.  A joint row, the relation
g = sum c_i q_i - s - P(y) of joint coordinates with y = sum b_i q_i, has the entries
c_i - P'(y) b_i in G, and Gdot v = -P''(y) (sum b_i v_i)^2; without P they are constant and 0.

Vectors of three numbers are plain floats here, because NumPy's overhead is many times the cost of
their products.  They are in the axes of the joint that carries b (the world's for a closure to the
ground).  With e = R_b d and x the origin of anchor a, both in world axes, d^T X_lin = (e, x x e):
one product with J is left for all rows together.  B_lin + w x r is A_a(x) - A_b(x) - 2 omega_b x r,
with the classical acceleration A(x) = a + alpha x x + omega x (v + omega x x) of the point of a
body that is at x.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple, Self, cast

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import idle_pool, workspace
from srm_mbs._typing import BoolArray, FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.copies import copied
from srm_mbs.model.lazy import cached_property

Vector = Sequence[float]
"""Three numbers."""
Triple = tuple[float, float, float]


def cross3(a: Vector, b: Vector) -> Triple:
    """a x b."""
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def cross(a: Vector | FloatArray, b: Vector | FloatArray) -> FloatArray:
    """a x b as an array; ``numpy.cross`` costs ten times as much on three numbers."""
    return np.array(cross3(a, b))  # type: ignore[arg-type]


def plus_cross(c: Vector, a: Vector, b: Vector) -> Triple:
    """c + a x b."""
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    return cx + (ay * bz - az * by), cy + (az * bx - ax * bz), cz + (ax * by - ay * bx)


def plus_crosses(c: Vector, a: Vector, b: Vector, d: Vector, e: Vector) -> Triple:
    """c + a x b + d x e."""
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    dx, dy, dz = d
    ex, ey, ez = e
    return (
        cx + (ay * bz - az * by) + (dy * ez - dz * ey),
        cy + (az * bx - ax * bz) + (dz * ex - dx * ez),
        cz + (ax * by - ay * bx) + (dx * ey - dy * ex),
    )


def minus(a: Vector, b: Vector) -> Triple:
    """a - b."""
    ax, ay, az = a
    bx, by, bz = b
    return ax - bx, ay - by, az - bz


def dot(a: Vector, b: Vector) -> float:
    """a . b."""
    ax, ay, az = a
    bx, by, bz = b
    return ax * bx + ay * by + az * bz


def to_world(R: Sequence[Vector], a: Vector) -> Triple:
    """R a."""
    x, y, z = a
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z


def from_world(R: Sequence[Vector], a: Vector) -> Triple:
    """R^T a."""
    x, y, z = a
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    return xx * x + yx * y + zx * z, xy * x + yy * y + zy * z, xz * x + yz * y + zz * z


class _JointTerm(NamedTuple):
    """c q of one joint in a joint row."""

    coefficient: float
    in_q: int
    in_v: int
    continuous: bool
    """Whether q is an angle that is stored as (cos, sin)."""
    argument: float
    """b, of the argument y of the powers."""


class _ScaledJointRow(NamedTuple):
    """A joint row over its scale."""

    terms: list[_JointTerm]
    offset: float
    powers: list[float]
    """a_2, a_3, ... of P(y); empty in a linear row."""


class _JointRows:
    """The kept, scaled joint rows of one closure.

    Attributes
    ----------
    pattern : (count, nv) bool
        Which entries of their Jacobian may differ from zero.
    is_constant
        Whether all rows are linear.
    G : (count, nv)
        Their Jacobian, constant or after :meth:`evaluate`.
    """

    def __init__(
        self, model: pin.Model, loop: LoopClosure, scale: FloatArray, keep: BoolArray, start: int
    ) -> None:
        kept = [(row, float(s)) for row, s, k in zip(loop.rows.joint_rows, 1.0 / scale, keep) if k]
        self.first_row, self.count = start, len(kept)
        self.support = np.zeros(model.nv)  # the world Jacobian has no part in them
        self.G = np.zeros((self.count, model.nv))
        self.pattern = np.zeros(self.G.shape, dtype=bool)
        self._rows: list[_ScaledJointRow] = []
        for own, used, (row, factor) in zip(self.G, self.pattern, kept):
            terms = []
            arguments = row.arguments or (0.0,) * len(row.joints)
            for c, b, name in zip(row.coefficients, arguments, row.joints):
                joint = model.joints[model.getJointId(name)]
                terms.append(_JointTerm(factor * c, joint.idx_q, joint.idx_v, joint.nq == 2, b))
                own[joint.idx_v] = factor * c
                used[joint.idx_v] = c != 0.0 or b != 0.0
            powers = [factor * a for a in row.powers]
            self._rows.append(_ScaledJointRow(terms, factor * row.offset, powers))
        self.is_constant = not any(row.powers for row in self._rows)

    def copy_workspace(self) -> _JointRows:
        """The same rows with memory of their own."""
        other = copy(self)
        other.G = self.G.copy()
        return other

    def constants(self) -> list[dict[str, Any]]:
        """Constants of each row for the compiled kernel."""
        return [
            {
                "row": number,
                "coefficients": np.array([term.coefficient for term in row.terms]),
                "in_q": [term.in_q for term in row.terms],
                "in_v": [term.in_v for term in row.terms],
                "offset": row.offset,
                "arguments": np.array([term.argument for term in row.terms if row.powers]),
                "powers": np.array(row.powers),
            }
            for number, row in enumerate(self._rows, self.first_row)
        ]

    def bind(self, data: pin.Data) -> None:
        """Do nothing: joint rows depend on q and v alone."""

    def evaluate(self, q: FloatArray, v: FloatArray | None, out: list[float]) -> None:
        """Append for each row six zeros for G, which no wrenches give, then g, then Gdot v.

        Angles that are stored as (cos, sin), of which drives have rows, are in [-pi, pi].
        """
        for own, (terms, offset, powers) in zip(self.G, self._rows):
            g, bias = -offset, 0.0
            for c, k, _, continuous, _ in terms:
                g += c * (math.atan2(q[k + 1], q[k]) if continuous else q[k])
            if powers:
                y = sum(term.argument * q[term.in_q] for term in terms)
                value, slope, curvature = _powers(powers, y)
                g -= value
                for term in terms:
                    own[term.in_v] = term.coefficient - slope * term.argument
                if v is not None:
                    bias = -curvature * sum(term.argument * v[term.in_v] for term in terms) ** 2
            out += 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, g, bias


def _powers(powers: Sequence[float], y: float) -> Triple:
    """P, P' and P'' of P(y) = sum a_k y^k, ``powers`` = a_2, a_3, ..., by Horner's scheme."""
    value = slope = half_curvature = 0.0
    for a in (*reversed(powers), 0.0, 0.0):
        half_curvature = half_curvature * y + slope
        slope = slope * y + value
        value = value * y + a
    return value, slope, 2.0 * half_curvature


COINCIDENT = 1e-9
"""Distance of two points, over its nominal length, below which it has no direction."""


def world_jacobian(data: pin.Data) -> FloatArray:
    """The joint Jacobian (6, nv) in world axes; Pinocchio hands out (6,) where nv = 1."""
    J: FloatArray = data.J
    return J if J.ndim == 2 else J[:, None]


def placement_numbers(placement: pin.SE3) -> FloatArray:
    """Rotation, row by row, then translation (12,)."""
    return np.concatenate([placement.rotation.ravel(), placement.translation])


def support(model: pin.Model, joint: int) -> FloatArray:
    """1.0 at the velocity components (nv,) that move ``joint``, else 0.0."""
    mask = np.zeros(model.nv)
    while joint:
        first = model.idx_vs[joint]
        mask[first : first + model.nvs[joint]] = 1.0
        joint = int(model.parents[joint])
    return mask


class _Body:
    """Placement of a joint in the world, and its velocity and bias acceleration in its own axes.

    The acceleration contains -gravity.  Every attribute is a function that reads the current
    numbers of ``data``.
    """

    def __init__(self, data: pin.Data, joint: int) -> None:
        # Pinocchio's arrays are views on data: finding one costs more than reading it.
        placement, velocity, bias = data.oMi[joint], data.v[joint], data.a_gf[joint]
        self.rotation = placement.rotation.tolist
        self.origin = placement.translation.tolist
        self.velocity = velocity.linear.tolist
        self.spin = velocity.angular.tolist
        self.bias = bias.linear.tolist
        self.spin_bias = bias.angular.tolist


class _LoopRows:
    """The kept, scaled rows of one closure between anchors, resolved against a model."""

    def __init__(
        self, model: pin.Model, loop: LoopClosure, scale: FloatArray, keep: BoolArray, start: int
    ) -> None:
        self.name = loop.name
        (self.joint_a, in_a), (self.joint_b, in_b) = loop.resolve(model)
        rows = loop.rows
        k, turns = len(rows.directions), rows.blocks[1]
        inverse = 1.0 / scale
        # The rows in the axes of the joints, as plain floats.
        directions = (rows.directions * inverse[:k, None])[keep[:k]]
        self._d: list[list[float]] = (directions @ in_b.rotation.T).tolist()
        # With their factor, the inverse of the row scale.
        self._distances = [
            (length, float(factor))
            for length, factor, kept in zip(rows.distances, inverse[k:], keep[k:])
            if kept
        ]
        pairs = rows.alignments[keep[turns]]
        # The row scale sits in n, so that no evaluation has to divide.
        self._un = [
            ((in_a.rotation @ u).tolist(), (in_b.rotation @ n).tolist())
            for u, n in zip(pairs[:, 0], pairs[:, 1] * inverse[turns][keep[turns], None])
        ]
        self._at_a: list[float] = in_a.translation.tolist()
        self._at_b: list[float] = in_b.translation.tolist()
        # Of places counted from bases: where the point of b is, on the ground from the base of a,
        # and the base of a seen from that of b.
        self._target, self.apart = self._at_b, [0.0, 0.0, 0.0]
        self.support = support(model, self.joint_a) - support(model, self.joint_b)
        self.first_row = start
        self.count = len(self._d) + len(self._distances) + len(self._un)

    @cached_property
    def _unmoved(self) -> dict[str, Any]:
        """The :meth:`constants` that are the same in other places."""
        return {
            "joint_a": self.joint_a,
            "joint_b": self.joint_b,
            "directions": np.array(self._d, dtype=float).ravel(),
            "distances": np.array(self._distances, dtype=float).ravel(),
            "alignments": np.array(self._un, dtype=float).ravel(),
            "support": self.support,
            "first_row": self.first_row,
        }

    def constants(self) -> dict[str, Any]:
        return self._unmoved | {"at_a": np.array(self._at_a), "at_b": np.array(self._at_b)}

    def origins(self) -> list[tuple[int, list[float]]]:
        """Joint, and origin (3,) in its axes, of both anchors."""
        return [(self.joint_a, self._at_a), (self.joint_b, self._at_b)]

    def moved(self, name: str, at_a: list[float], at_b: list[float]) -> _LoopRows:
        """The same rows of a closure ``name`` with the origins of its anchors at these places."""
        other = self.copy_workspace()
        other.name, other._at_a, other._at_b, other._target = name, at_a, at_b, at_b
        other._unmoved = self._unmoved
        return other

    def bind(self, data: pin.Data) -> None:
        """Read the bodies of ``data`` from now on."""
        self._a, self._b = _Body(data, self.joint_a), _Body(data, self.joint_b)

    def copy_workspace(self) -> _LoopRows:
        """The same rows, to be bound to other data."""
        # As copy() does, which takes three times as long.
        other = object.__new__(_LoopRows)
        other.name, other.first_row, other.count = self.name, self.first_row, self.count
        other.joint_a, other.joint_b, other.support = self.joint_a, self.joint_b, self.support
        other._distances = self._distances
        other._at_a, other._at_b, other._d, other._un = self._at_a, self._at_b, self._d, self._un
        other._target, other.apart = self._target, self.apart
        return other

    def count_from(self, bases: FloatArray) -> None:
        """Expect data of a model that is counted from ``bases``."""
        a, b = bases[self.joint_a], bases[self.joint_b]
        self.apart = (a - b).tolist()
        if self.joint_b == 0:  # what does not move is subtracted from what does not
            self._target = (np.array(self._at_b) - a).tolist()

    def evaluate(self, q: FloatArray, v: FloatArray | None, out: list[float]) -> None:
        """Append for each row (force, moment) of G = (force, moment) J, then g, then Gdot v."""
        with_bias = v is not None  # the data have the velocities
        if self._d or self._distances:
            self._positions(with_bias, out)
        if self._un:
            self._alignments(with_bias, out)

    def _positions(self, with_bias: bool, out: list[float]) -> None:
        a, b, ground = self._a, self._b, self.joint_b == 0
        Ra, at_a = a.rotation(), self._at_a
        rx, ry, rz = to_world(Ra, at_a)
        ox, oy, oz = a.origin()
        x = at_b = (rx + ox, ry + oy, rz + oz)
        if not ground:
            Rb = b.rotation()
            px, py, pz = self.apart
            at_b = from_world(Rb, minus((x[0] + px, x[1] + py, x[2] + pz), b.origin()))
        if with_bias:
            spin = a.spin()
            speed = plus_cross(a.velocity(), spin, at_a)
            bias = to_world(Ra, plus_crosses(a.bias(), a.spin_bias(), at_a, spin, speed))
            if ground:
                bias = minus(bias, b.bias())  # the ground's is -gravity, as in every body's
                if self._distances:
                    r = to_world(Ra, speed)
            else:
                spin = b.spin()
                sx, sy, sz = from_world(Rb, to_world(Ra, speed))
                cx, cy, cz = plus_cross(b.velocity(), spin, at_b)
                # omega_b x (carried + 2 r), r = speed - carried
                twice = (2.0 * sx - cx, 2.0 * sy - cy, 2.0 * sz - cz)
                r = sx - cx, sy - cy, sz - cz
                carried = plus_crosses(b.bias(), b.spin_bias(), at_b, spin, twice)
                bias = minus(from_world(Rb, bias), carried)
        else:
            r = bias = (0.0, 0.0, 0.0)
        p = minus(at_b, self._target)
        for d in self._d:
            e = d if ground else to_world(Rb, d)
            out += *e, *cross3(x, e), dot(d, p), dot(d, bias)
        for length, factor in self._distances:
            apart = math.sqrt(dot(p, p))
            if apart < COINCIDENT * length:
                raise EvaluationError(
                    f"the two points of the loop {self.name!r} coincide: their distance has no "
                    "direction"
                )
            by = factor / apart
            px, py, pz = p
            d = [by * px, by * py, by * pz]
            e = d if ground else to_world(Rb, d)
            across = cross3(d, r)
            out += e
            out += cross3(x, e)
            out += factor * (apart - length), dot(d, bias) + dot(across, across) / (by * apart**2)

    def _alignments(self, with_bias: bool, out: list[float]) -> None:
        a, b = self._a, self._b
        Ra, Rb = a.rotation(), b.rotation()
        if with_bias:
            carried = b.spin()
            spin = from_world(Rb, to_world(Ra, a.spin()))
            w = minus(spin, carried)
            bias = minus(from_world(Rb, to_world(Ra, a.spin_bias())), b.spin_bias())
            bias = minus(bias, cross3(carried, spin))
        else:
            w = bias = (0.0, 0.0, 0.0)
        for u, n in self._un:
            m = from_world(Rb, to_world(Ra, u))
            out += 0.0, 0.0, 0.0
            out += to_world(Rb, cross3(m, n))
            out += dot(n, m), dot(n, plus_cross(cross3(bias, m), w, cross3(w, m)))


class Trees(NamedTuple):
    """A model whose places are counted from the bases of its trees.

    A tree is all that hangs on one joint of the ground, and its *base* the place of that joint.
    From the origin of the world, a place 1 km away is known to 1e-13 m, and next to a singular
    configuration errors are rounding over sigma.  With the joints of the ground at the origin, a
    model has the same mass matrix and forces, and rows of closures that differ in rounding alone.

    Attributes
    ----------
    model
        With the joints of the ground at the origin of the world.
    bases : (njoints, 3) m
        Of the tree of each joint, in the world; of the ground 0.
    """

    model: pin.Model
    bases: FloatArray


def trees_of(model: pin.Model) -> Trees | None:
    """``model`` with its bases; None if all are at the origin, or gravity turns, so that places
    count."""
    bases = np.zeros((model.njoints, 3))
    for joint in range(1, model.njoints):
        parent = int(model.parents[joint])
        bases[joint] = bases[parent] if parent else model.jointPlacements[joint].translation
    if model.gravity.angular.any() or not bases.any():
        return None
    moved = model.copy()
    for joint in range(1, model.njoints):
        if model.parents[joint] == 0:
            moved.jointPlacements[joint] = pin.SE3(
                model.jointPlacements[joint].rotation, np.zeros(3)
            )
    return Trees(moved, bases)


class Elimination(NamedTuple):
    """Subtract ``factor`` times the row ``other`` from the row ``row``, both unscaled.

    Both belong to closures between the same bodies, so that the factor is constant.
    """

    row: int
    other: int
    factor: float


class LoopKinematics:
    """Rows of all closures of a mechanism.

    Parameters
    ----------
    model, loops
        The tree and its closures.
    scale : (rows,)
        Rows are divided by it; ones by default (then g is in m and rad, lengths unscaled).
    keep : (rows,) bool
        Rows to evaluate; all by default.
    eliminations
        Applied one after the other to the rows that are kept; none by default.

    Attributes
    ----------
    g : (m,), G : (m, nv), bias : (m,)
        Closure errors, their Jacobian in tangent coordinates, and Gdot v, after :meth:`update`.
    target_rate : (m,)
        s' of the drives, so that the rates of the errors are G v - s'; 0 in the rows of loops.
    idle
        Kernel systems with these rows that nobody uses, also of mechanisms where they are moved.
    """

    def __init__(
        self,
        model: pin.Model,
        loops: Sequence[LoopClosure],
        scale: FloatArray | None = None,
        keep: BoolArray | None = None,
        eliminations: Sequence[Elimination] = (),
    ) -> None:
        total = sum(loop.rows.count for loop in loops)
        scale = np.ones(total) if scale is None else scale
        mask = np.ones(total, dtype=bool) if keep is None else np.asarray(keep, dtype=bool)
        self._loops: list[_LoopRows | _JointRows] = []
        supports = [np.zeros((0, model.nv))]
        self._anchored = 0
        at = m = 0
        for loop in loops:
            rows = slice(at, at + loop.rows.count)
            kind = _JointRows if loop.rows.joint_rows else _LoopRows
            resolved = kind(model, loop, scale[rows], mask[rows], m)
            at = rows.stop
            if not resolved.count:
                continue
            self._loops.append(resolved)
            supports.append(np.tile(resolved.support, (resolved.count, 1)))
            m += resolved.count
            if isinstance(resolved, _LoopRows):
                self._anchored = m
        self._support = np.concatenate(supports)
        place = (np.cumsum(mask) - 1).tolist()
        size = scale.tolist()
        self._eliminations = [
            Elimination(place[row], place[other], factor * size[other] / size[row])
            for row, other, factor in eliminations
        ]
        self.idle = idle_pool(model.nv)
        self._to_b: FloatArray | None = None
        self._allocate()

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"idle": deque(maxlen=self.idle.maxlen)}

    def _allocate(self) -> None:
        m = len(self._support)
        self._numbers = np.zeros(8 * m)
        table = self._numbers.reshape(m, 8)
        self.g, self.bias = table[:, 6], table[:, 7]
        self.G = np.zeros(self._support.shape)
        self._is_masked = bool((self._support != 1.0).any())
        self._wrenches, self._anchored_G = table[: self._anchored, :6], self.G[: self._anchored]
        self._joint_rows = [rows for rows in self._loops if isinstance(rows, _JointRows)]
        self.target_rate = np.zeros(m)
        self._data: pin.Data | None = None

    def copy_workspace(self) -> Self:
        """The same rows with memory of their own: anchors are not looked up again."""
        other = copy(self)
        other._loops = [loop.copy_workspace() for loop in self._loops]
        other._allocate()
        return other

    def moved(self, loops: Sequence[LoopClosure], origins: Sequence[list[float]]) -> Self | None:
        """The same rows of ``loops``, with other :attr:`origins` in a tree of the same bodies and
        joints, and with the same idle kernel systems; None unless all are between anchors and have
        rows.

        They share the workspace: evaluate a copy of it (:meth:`copy_workspace`).
        """
        if self._joint_rows or len(loops) != len(self._loops):
            return None
        moved = [
            cast(_LoopRows, rows).moved(loop.name, at_a, at_b)
            for rows, loop, at_a, at_b in zip(self._loops, loops, origins[::2], origins[1::2])
        ]
        return copied(self, _loops=moved, origins=list(origins))

    def count_from(self, bases: FloatArray) -> Self:
        """Expect from now on that :meth:`update` finds places, velocities and the Jacobian of each
        tree counted from its base, one of ``bases`` (njoints, 3), as :class:`Trees` has them."""
        own = [rows for rows in self._loops if isinstance(rows, _LoopRows)]
        for rows in own:
            rows.count_from(bases)
        # Wrenches about the base of b: its moments are those about a's and apart x force.
        self._to_b = np.tile(np.eye(6), (self._anchored, 1, 1))
        for rows in own:
            turn = pin.skew(np.array(rows.apart))
            self._to_b[rows.first_row : rows.first_row + rows.count, 3:, :3] = turn
        self._of_b = self._support[: self._anchored] < 0.0
        return self

    @cached_property
    def origins(self) -> list[list[float]]:
        """Origins (3,) of the anchors a and b of all closures that have rows, each in the axes of
        its joint."""
        return [origin for _, origin in self.anchors()]

    def anchors(self) -> list[tuple[int, list[float]]]:
        """Joint, and origin (3,) in its axes, of the anchors of all closures that have rows."""
        own = [rows for rows in self._loops if isinstance(rows, _LoopRows)]
        return [end for rows in own for end in rows.origins()]

    @property
    def is_constant(self) -> bool:
        """Whether G is constant: all rows are linear relations of joint coordinates."""
        return not self._anchored and all(rows.is_constant for rows in self._joint_rows)

    def pattern(self) -> BoolArray:
        """Which entries of G (m, nv) may differ from zero."""
        out: BoolArray = self._support != 0.0
        for rows in self._joint_rows:
            out[rows.first_row : rows.first_row + rows.count] = rows.pattern
        return out

    def constants(self) -> dict[str, Any]:
        """Constants for the compiled kernel: ``loops`` between anchors, ``joint_rows``,
        ``eliminations``."""
        return {
            "loops": [loop.constants() for loop in self._loops if isinstance(loop, _LoopRows)],
            "joint_rows": [row for rows in self._joint_rows for row in rows.constants()],
            "eliminations": [
                (e.row, e.other, e.factor, np.flatnonzero(self._support[e.row]).tolist())
                for e in self._eliminations
            ],
        }

    def update(self, data: pin.Data, q: FloatArray, v: FloatArray | None = None) -> None:
        """Evaluate g and G at the configuration q (nq,), and Gdot v if the rates v (nv,) are given.

        ``data`` must hold crba in the WORLD convention (placements, world Jacobian) and, for the
        bias, nonLinearEffects (velocities, bias accelerations) at the current state; after
        :meth:`count_from` of the model that is counted so.

        Raises
        ------
        EvaluationError
            If the points of a ``distance`` coincide.
        """
        if data is not self._data:
            self._data, self._J = data, world_jacobian(data)
            for loop in self._loops:
                loop.bind(data)
        numbers: list[float] = []
        for loop in self._loops:
            loop.evaluate(q, v, numbers)
        self._numbers[:] = numbers
        G = self.G
        np.dot(self._wrenches, self._J, self._anchored_G)
        if self._to_b is not None:
            on_b = (self._to_b @ self._wrenches[:, :, None])[:, :, 0]
            np.copyto(self._anchored_G, on_b @ self._J, where=self._of_b)
        if self._is_masked:
            np.multiply(G, self._support, G)
        for rows in self._joint_rows:
            G[rows.first_row : rows.first_row + rows.count] = rows.G
        for row, other, factor in self._eliminations:
            for each in (G, self.g, self.bias):
                each[row] -= factor * each[other]

    def evaluate(
        self, model: pin.Model, data: pin.Data, q: FloatArray, v: FloatArray | None = None
    ) -> None:
        """Compute the kinematics in ``data`` at q (nq,), and :meth:`update`; Gdot v if v (nv,) is
        given."""
        pin.crba(model, data, q, pin.Convention.WORLD)
        if v is not None:
            pin.nonLinearEffects(model, data, q, v)
        self.update(data, q, v)

    def move_to(self, t: float) -> None:
        """Do nothing: the rows of loops do not depend on the time t (s)."""

    def errors(
        self, model: pin.Model, data: pin.Data, t: FloatArray, q: FloatArray, v: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """g - s and G v - s' (n, rows) at n times t (n,) and states q (n, nq), v (n, nv); ``data``
        is a workspace."""
        g, c = np.empty((2, len(q), len(self.g)))
        for i in range(len(q)):
            self.evaluate(model, data, q[i])
            self.move_to(t[i])
            g[i], c[i] = self.g, self.G @ v[i] - self.target_rate
        return g, c


def closure_errors(
    model: pin.Model, loops: Sequence[LoopClosure], q: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """g (n, rows) in m and rad, and G v (n, rows), of all rows at n states q (n, nq), v (n, nv)."""
    rows = LoopKinematics(model, loops)
    return rows.errors(model, workspace(model), np.zeros(len(q)), q, v)
