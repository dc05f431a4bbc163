r"""The terms of an evaluation of a mechanism, recorded and written as C.

One pass over the tree, in world axes about the world's origin.  With the columns J_k of a joint's
motions, V and A the spatial velocity and bias acceleration of its body, and p its parent,

    V = V_p + sum J_k v_k,     A = A_p + V_p x sum J_k v_k,     A_0 = -gravity,
    F = (m a, c x m a + I \alpha + \omega x I \omega),     nle_k = J_k . (sum of F over the subtree)
    M_jk = J_j . (Y J_k)   for j on the way from the ground to k,

with c, I mass centre and moments of the body, a the acceleration of the mass centre and Y the
inertia of the subtree of k: these are Newton's and Euler's equations and the composite rigid-body
algorithm (R. Featherstone, Rigid Body Dynamics Algorithms, 2008, chapters 5 and 6), as Pinocchio
has them.  The rows are those of :mod:`srm_mbs.dynamics.constraints.rows`, the forces those of
:mod:`srm_mbs.dynamics.forces`.

Left to the kernel: bushings, whose kinematics the terms compute, forces along coordinates (damping,
friction, controllers), motions of drives, laws over time, whose values the terms take, and all
algebra.
"""

from __future__ import annotations

from typing import NamedTuple

from srm_mbs.integration.generated.algebra import algebra_of
from srm_mbs.integration.generated.differentiation import Direction
from srm_mbs.integration.generated.expressions import (
    PARAMETER,
    Expression,
    Guard,
    Output,
    Recorder,
    write_c,
)
from srm_mbs.integration.generated.structure import (
    MINUS_ONE,
    ONE,
    ZERO,
    Closure,
    CoordinateRow,
    Force,
    Motion,
    Span,
    Structure,
    UnsupportedElementError,
)

Vector = tuple[Expression, Expression, Expression]
Matrix = tuple[Vector, Vector, Vector]
"""Row by row."""

ABI = 1
"""Version of the functions that the kernel calls: ``interface_version`` in generated.cpp."""


def _add(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _subtract(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _scaled(s: Expression, a: Vector) -> Vector:
    return s * a[0], s * a[1], s * a[2]


def _dot(a: Vector, b: Vector) -> Expression:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _times(R: Matrix, a: Vector) -> Vector:
    return _dot(R[0], a), _dot(R[1], a), _dot(R[2], a)


def _transposed(R: Matrix) -> Matrix:
    return (
        (R[0][0], R[1][0], R[2][0]),
        (R[0][1], R[1][1], R[2][1]),
        (R[0][2], R[1][2], R[2][2]),
    )


def _product(R: Matrix, S: Matrix) -> Matrix:
    columns = _transposed(S)
    return (
        (_dot(R[0], columns[0]), _dot(R[0], columns[1]), _dot(R[0], columns[2])),
        (_dot(R[1], columns[0]), _dot(R[1], columns[1]), _dot(R[1], columns[2])),
        (_dot(R[2], columns[0]), _dot(R[2], columns[1]), _dot(R[2], columns[2])),
    )


class _Moments(NamedTuple):
    """A symmetric tensor."""

    xx: Expression
    xy: Expression
    xz: Expression
    yy: Expression
    yz: Expression
    zz: Expression

    def times(self, a: Vector) -> Vector:
        return (
            self.xx * a[0] + self.xy * a[1] + self.xz * a[2],
            self.xy * a[0] + self.yy * a[1] + self.yz * a[2],
            self.xz * a[0] + self.yz * a[1] + self.zz * a[2],
        )

    @property
    def matrix(self) -> Matrix:
        return (
            (self.xx, self.xy, self.xz),
            (self.xy, self.yy, self.yz),
            (self.xz, self.yz, self.zz),
        )

    def plus(self, other: _Moments) -> _Moments:
        return _Moments(*(a + b for a, b in zip(self, other)))

    @property
    def is_zero(self) -> bool:
        return all(entry.is_zero for entry in self)


class _Column(NamedTuple):
    """A column of the world Jacobian: the motion of a body by one rate."""

    in_v: int
    linear: Vector
    angular: Vector


class _Body(NamedTuple):
    """A body in world axes; velocity and acceleration are of its point at the world's origin."""

    rotation: Matrix
    origin: Vector
    velocity: Vector
    spin: Vector
    bias: Vector
    spin_bias: Vector

    def point(self, local: Vector) -> Vector:
        """The place of a point of the body."""
        return _add(self.origin, _times(self.rotation, local))

    def point_velocity(self, x: Vector) -> Vector:
        """Velocity of its point at ``x``."""
        return _add(self.velocity, _cross(self.spin, x))

    def point_bias(self, x: Vector) -> Vector:
        """Acceleration of its point at ``x``, without those of the joints."""
        carried = _cross(self.spin, self.point_velocity(x))
        return _add(_add(self.bias, _cross(self.spin_bias, x)), carried)


class _Inertia(NamedTuple):
    """Mass, mass centre and moments about it, in world axes."""

    mass: Expression
    centre: Vector
    moments: _Moments

    def plus(self, other: _Inertia) -> _Inertia:
        """Both bodies together."""
        if other.mass.is_zero:
            return _Inertia(self.mass, self.centre, self.moments.plus(other.moments))
        if self.mass.is_zero:
            return _Inertia(other.mass, other.centre, self.moments.plus(other.moments))
        mass = self.mass + other.mass
        share = other.mass / mass
        apart = _subtract(other.centre, self.centre)
        reduced = self.mass * share
        x, y, z = apart
        shifted = _Moments(
            reduced * (y * y + z * z),
            -(reduced * (x * y)),
            -(reduced * (x * z)),
            reduced * (x * x + z * z),
            -(reduced * (y * z)),
            reduced * (x * x + y * y),
        )
        centre = _add(self.centre, _scaled(share, apart))
        return _Inertia(mass, centre, self.moments.plus(other.moments).plus(shifted))


class _Trace:
    """Records the terms of a structure."""

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        self.recorder = recorder = Recorder()
        known = {ZERO: recorder.zero, ONE: recorder.one, MINUS_ONE: recorder.constant(-1.0)}
        self.parameters = [
            known.get(code) or recorder.leaf(f"p[{i}]", PARAMETER)
            for i, code in enumerate(structure.codes)
        ]
        self.q = [recorder.leaf(f"q[{i}]") for i in range(structure.nq)]
        self.v = [recorder.leaf(f"v[{i}]") for i in range(structure.nv)]
        zero, one = recorder.zero, recorder.one
        self.nothing: Vector = (zero, zero, zero)
        self.units: Matrix = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
        gravity = self.take(structure.gravity)
        self.ground = _Body(
            self.units,
            self.nothing,
            self.nothing,
            self.nothing,
            (-gravity[0], -gravity[1], -gravity[2]),
            (-gravity[3], -gravity[4], -gravity[5]),
        )
        self.guards: list[Guard] = []
        self.outputs: list[Output] = []
        self.bodies: list[_Body] = []
        self.columns: list[list[_Column]] = []
        """Of each motion, its own."""

    def take(self, span: Span) -> list[Expression]:
        return self.parameters[span.start : span.start + span.length]

    def vector(self, span: Span) -> Vector:
        x, y, z = self.take(span)
        return x, y, z

    def placement(self, span: Span) -> tuple[Matrix, Vector]:
        n = self.take(span)
        rotation = (n[0], n[1], n[2]), (n[3], n[4], n[5]), (n[6], n[7], n[8])
        return rotation, (n[9], n[10], n[11])

    def body(self, joint: int) -> _Body:
        """The body of a joint of the model."""
        number = self.structure.bodies[joint]
        return self.ground if number < 0 else self.bodies[number]

    def directions(self) -> tuple[list[Direction], list[Direction]]:
        """Rates of change of q and v along each of their tangent coordinates.

        Those of q are body velocities: q moves as by ``pinocchio.integrate``, which is the chart
        of a step at its start (:mod:`srm_mbs.dynamics.manifold`).
        """
        one = self.recorder.one
        positions: list[Direction] = []
        for motion in self.structure.motions:
            positions += self._moves(motion)
        return positions, [{rate: one} for rate in self.v]

    def _moves(self, motion: Motion) -> list[Direction]:
        """The directions of q that the rates of a motion have."""
        q, first, kind, one = self.q, motion.in_q, motion.kind, self.recorder.one
        if kind == "unbounded":
            return [self._turns_pair(first)]
        if kind == "planar":
            c, s = q[first + 2], q[first + 3]
            along: list[Direction] = [{q[first]: c, q[first + 1]: s}]
            return [*along, {q[first]: -s, q[first + 1]: c}, self._turns_pair(first + 2)]
        if kind == "spherical":
            return self._turns_quaternion(first)
        if kind == "free":
            axes = _transposed(self._of_quaternion(first + 3))
            shifts: list[Direction] = [dict(zip(q[first : first + 3], axis)) for axis in axes]
            return [*shifts, *self._turns_quaternion(first + 3)]
        count = 3 if kind == "translation" else 1
        return [{q[first + i]: one} for i in range(count)]

    def _turns_pair(self, first: int) -> Direction:
        """That of a cosine and a sine."""
        c, s = self.q[first], self.q[first + 1]
        return {c: -s, s: c}

    def _turns_quaternion(self, first: int) -> list[Direction]:
        """Those of a unit quaternion, by the spins about the axes of the body."""
        x, y, z, w = (0.5 * entry for entry in self.q[first : first + 4])
        own = self.q[first : first + 4]
        rates = (w, z, -y, -x), (-z, w, x, -y), (y, -x, w, -z)
        return [dict(zip(own, rate)) for rate in rates]

    # -- joints

    def _about(self, axis: Vector, c: Expression, s: Expression) -> Matrix:
        """The rotation about a unit axis by the angle with this cosine and sine."""
        x, y, z = axis
        d = 1.0 - c
        units = sum(not entry.is_zero for entry in axis)
        if units == 1:  # x^2 + y^2 + z^2 = 1, of an axis that is a unit vector of its frame
            ones = [self.recorder.one if not entry.is_zero else c for entry in axis]
            return (
                (ones[0], -(z * s), y * s),
                (z * s, ones[1], -(x * s)),
                (-(y * s), x * s, ones[2]),
            )
        return (
            ((x * x) * d + c, (x * y) * d - z * s, (x * z) * d + y * s),
            ((x * y) * d + z * s, (y * y) * d + c, (y * z) * d - x * s),
            ((x * z) * d - y * s, (y * z) * d + x * s, (z * z) * d + c),
        )

    def _of_quaternion(self, first: int) -> Matrix:
        """The rotation of the unit quaternion (x, y, z, w) in q."""
        x, y, z, w = self.q[first : first + 4]
        tx, ty, tz = 2.0 * x, 2.0 * y, 2.0 * z
        return (
            (1.0 - (ty * y + tz * z), ty * x - tz * w, tz * x + ty * w),
            (ty * x + tz * w, 1.0 - (tx * x + tz * z), tz * y - tx * w),
            (tz * x - ty * w, tz * y + tx * w, 1.0 - (tx * x + ty * y)),
        )

    def _joint(self, motion: Motion) -> tuple[Matrix, Vector, list[tuple[Vector, Vector]]]:
        """Rotation, translation, and the columns (linear, angular) of the motion in its axes."""
        q, first, kind = self.q, motion.in_q, motion.kind
        none, units = self.nothing, self.units
        if kind in ("revolute", "unbounded", "helical"):
            axis = self.vector(motion.axis)
            if kind == "unbounded":
                c, s = q[first], q[first + 1]
            else:
                c, s = self.recorder.call("cos", q[first]), self.recorder.call("sin", q[first])
            rotation = self._about(axis, c, s)
            if kind != "helical":
                return rotation, none, [(none, axis)]
            along = _scaled(self.take(motion.pitch)[0], axis)
            return rotation, _scaled(q[first], along), [(along, axis)]
        if kind == "prismatic":
            axis = self.vector(motion.axis)
            return units, _scaled(q[first], axis), [(axis, none)]
        shifts = [(unit, none) for unit in units]
        turns = [(none, unit) for unit in units]
        if kind == "translation":
            return units, (q[first], q[first + 1], q[first + 2]), shifts
        if kind == "spherical":
            return self._of_quaternion(first), none, turns
        if kind == "planar":
            rotation = self._about(units[2], q[first + 2], q[first + 3])
            at = (q[first], q[first + 1], self.recorder.zero)
            return rotation, at, [*shifts[:2], turns[2]]
        rotation = self._of_quaternion(first + 3)
        return rotation, (q[first], q[first + 1], q[first + 2]), [*shifts, *turns]

    def _move(self, motion: Motion) -> None:
        """Append the body of ``motion`` and its columns."""
        parent = self.ground if motion.parent < 0 else self.bodies[motion.parent]
        placed, at = self.placement(motion.placement)
        turned, moved, subspace = self._joint(motion)
        before = _product(parent.rotation, placed)
        rotation = _product(before, turned)
        origin = _add(parent.point(at), _times(before, moved))
        own = []
        linear, angular = self.nothing, self.nothing
        for i, (shift, turn) in enumerate(subspace, motion.in_v):
            ahead, about = _times(rotation, shift), _times(rotation, turn)
            column = _Column(i, _add(ahead, _cross(origin, about)), about)
            own.append(column)
            linear = _add(linear, _scaled(self.v[i], column.linear))
            angular = _add(angular, _scaled(self.v[i], column.angular))
        spin = parent.spin
        bias = _add(_cross(spin, linear), _cross(parent.velocity, angular))
        self.bodies.append(
            _Body(
                rotation,
                origin,
                _add(parent.velocity, linear),
                _add(spin, angular),
                _add(parent.bias, bias),
                _add(parent.spin_bias, _cross(spin, angular)),
            )
        )
        self.columns.append(own)

    # -- inertia

    def _inertia(self, motion: Motion, body: _Body) -> _Inertia:
        mass, x, y, z, *moments = self.take(motion.inertia)
        own = _Moments(*moments)
        if not own.is_zero:
            R = body.rotation
            T = _product(_product(R, own.matrix), _transposed(R))
            own = _Moments(T[0][0], T[0][1], T[0][2], T[1][1], T[1][2], T[2][2])
        return _Inertia(mass, body.point((x, y, z)), own)

    def _force(self, body: _Body, inertia: _Inertia) -> tuple[Vector, Vector]:
        """The wrench about the world's origin that accelerates a body."""
        force, moment = self.nothing, self.nothing
        if not inertia.mass.is_zero:
            force = _scaled(inertia.mass, body.point_bias(inertia.centre))
            moment = _cross(inertia.centre, force)
        if not inertia.moments.is_zero:
            momentum = inertia.moments.times(body.spin)
            moment = _add(moment, inertia.moments.times(body.spin_bias))
            moment = _add(moment, _cross(body.spin, momentum))
        return force, moment

    def tree(self) -> None:
        """Kinematics, and the outputs M and nle."""
        motions, nv = self.structure.motions, self.structure.nv
        for motion in motions:
            self._move(motion)
        own = [self._inertia(motion, body) for motion, body in zip(motions, self.bodies)]
        wrenches = [self._force(body, inertia) for body, inertia in zip(self.bodies, own)]
        composite = list(own)
        armature = self.take(self.structure.armature)
        nle = [self.recorder.zero] * nv
        for number in range(len(motions) - 1, -1, -1):
            parent = motions[number].parent
            force, moment = wrenches[number]
            subtree = composite[number]
            for column in self.columns[number]:
                nle[column.in_v] = _dot(column.linear, force) + _dot(column.angular, moment)
                self._mass_column(column, number, subtree, armature)
            if parent >= 0:
                composite[parent] = composite[parent].plus(subtree)
                above = wrenches[parent]
                wrenches[parent] = _add(above[0], force), _add(above[1], moment)
        self.outputs += [Output(f"nle[{i}]", value) for i, value in enumerate(nle)]

    def _mass_column(
        self, column: _Column, number: int, subtree: _Inertia, armature: list[Expression]
    ) -> None:
        """The entries of M of a column and those on the way to the ground."""
        speed = _add(column.linear, _cross(column.angular, subtree.centre))
        force = _scaled(subtree.mass, speed)
        moment = _add(_cross(subtree.centre, force), subtree.moments.times(column.angular))
        nv = self.structure.nv
        above = number
        while above >= 0:
            for other in self.columns[above]:
                if other.in_v > column.in_v:
                    continue
                value = _dot(other.linear, force) + _dot(other.angular, moment)
                if other.in_v == column.in_v:
                    value = value + armature[column.in_v]
                self.outputs.append(Output(f"M[{column.in_v * nv + other.in_v}]", value))
            above = self.structure.motions[above].parent

    # -- closures

    def rows(self) -> None:
        """The outputs g, bias and G."""
        columns = {column.in_v: column for own in self.columns for column in own}
        g: dict[int, Expression] = {}
        bias: dict[int, Expression] = {}
        G: dict[int, dict[int, Expression]] = {}
        for closure in self.structure.closures:
            self._positions(closure, columns, g, bias, G)
            self._alignments(closure, columns, g, bias, G)
        for own in self.structure.coordinate_rows:
            self._coordinates(own, g, bias, G)
        for row, other, factor, changed in self.structure.subtractions:
            by = self.take(factor)[0]
            g[row] = g[row] - by * g[other]
            bias[row] = bias[row] - by * bias[other]
            zero = self.recorder.zero
            for j in changed:
                G[row][j] = G[row].get(j, zero) - by * G[other].get(j, zero)
        for row in g:
            self.outputs += [Output(f"g[{row}]", g[row]), Output(f"bias[{row}]", bias[row])]
            self.outputs += [Output(f"G[{row}][{j}]", entry) for j, entry in G[row].items()]

    def _positions(
        self,
        closure: Closure,
        columns: dict[int, _Column],
        g: dict[int, Expression],
        bias: dict[int, Expression],
        G: dict[int, dict[int, Expression]],
    ) -> None:
        directions, distances = self.take(closure.directions), self.take(closure.distances)
        if not directions and not distances:
            return
        a, b = self.body(closure.joint_a), self.body(closure.joint_b)
        x = a.point(self.vector(closure.at_a))
        apart = _subtract(x, b.point(self.vector(closure.at_b)))
        rate = _subtract(a.point_velocity(x), b.point_velocity(x))
        change = _subtract(a.point_bias(x), b.point_bias(x))
        change = _subtract(change, _scaled(self.recorder.constant(2.0), _cross(b.spin, rate)))
        moved = [
            (j, sign, _add(columns[j].linear, _cross(columns[j].angular, x)))
            for j, sign in closure.support
        ]
        row = closure.first_row

        def along(d: Vector, value: Expression, acceleration: Expression) -> None:
            nonlocal row
            g[row], bias[row] = value, acceleration
            G[row] = {j: _dot(d, point) * float(sign) for j, sign, point in moved}
            row += 1

        for k in range(0, len(directions), 3):
            d = _times(b.rotation, (directions[k], directions[k + 1], directions[k + 2]))
            along(d, _dot(d, apart), _dot(d, change))
        for k in range(0, len(distances), 2):
            length, factor = distances[k], distances[k + 1]
            distance = self.recorder.call("sqrt", _dot(apart, apart))
            coincident = self.take(self.structure.coincident)[0]
            self.guards.append(Guard(distance, coincident * length))
            d = _scaled(factor / distance, apart)
            across = _cross(d, rate)
            turning = _dot(across, across) / (factor * distance)
            along(d, factor * (distance - length), _dot(d, change) + turning)

    def _alignments(
        self,
        closure: Closure,
        columns: dict[int, _Column],
        g: dict[int, Expression],
        bias: dict[int, Expression],
        G: dict[int, dict[int, Expression]],
    ) -> None:
        numbers = self.take(closure.alignments)
        a, b = self.body(closure.joint_a), self.body(closure.joint_b)
        w = _subtract(a.spin, b.spin)
        change = _subtract(_subtract(a.spin_bias, b.spin_bias), _cross(b.spin, a.spin))
        row = closure.first_row + closure.directions.length // 3 + closure.distances.length // 2
        for k in range(0, len(numbers), 6):
            m = _times(a.rotation, (numbers[k], numbers[k + 1], numbers[k + 2]))
            n = _times(b.rotation, (numbers[k + 3], numbers[k + 4], numbers[k + 5]))
            moment = _cross(m, n)
            turning = _add(_cross(change, m), _cross(w, _cross(w, m)))
            g[row], bias[row] = _dot(n, m), _dot(n, turning)
            G[row] = {
                j: _dot(moment, columns[j].angular) * float(sign) for j, sign in closure.support
            }
            row += 1

    def _coordinates(
        self,
        own: CoordinateRow,
        g: dict[int, Expression],
        bias: dict[int, Expression],
        G: dict[int, dict[int, Expression]],
    ) -> None:
        zero = self.recorder.zero
        coefficients, powers = self.take(own.coefficients), self.take(own.powers)
        value, rate = -self.take(own.offset)[0], zero
        entries = dict(zip(own.in_v, coefficients))
        for c, i in zip(coefficients, own.in_q):
            value = value + c * self.q[i]
        curvature = zero
        if powers:
            arguments = self.take(own.arguments)
            y = zero
            for b, i, j in zip(arguments, own.in_q, own.in_v):
                y = y + b * self.q[i]
                rate = rate + b * self.v[j]
            power = slope = zero
            for a in (*reversed(powers), zero, zero):  # Horner's scheme
                curvature = curvature * y + slope
                slope = slope * y + power
                power = power * y + a
            value = value - power
            for b, j in zip(arguments, own.in_v):
                entries[j] = entries[j] - slope * b
        g[own.row], G[own.row] = value, entries
        bias[own.row] = -2.0 * (curvature * (rate * rate))

    def bushing_bodies(self) -> None:
        """The outputs B and J: placements and velocities in the axes of the bodies, and columns of
        the world Jacobian."""
        for k, joint in enumerate(self.structure.bushing_joints):
            body = self.body(joint)
            inverse = _transposed(body.rotation)
            velocity = _times(inverse, body.point_velocity(body.origin))
            columns = [entry for column in inverse for entry in column]
            motion = (*velocity, *_times(inverse, body.spin))
            for i, values in enumerate((columns, body.origin, motion), 3 * k):
                self.outputs += [Output(f"B[{i}][{n}]", value) for n, value in enumerate(values)]
        own = {column.in_v: column for columns in self.columns for column in columns}
        for j in self.structure.bushing_columns:
            values = (*own[j].linear, *own[j].angular)
            self.outputs += [Output(f"J[{6 * j + n}]", value) for n, value in enumerate(values)]

    # -- forces

    def forces(self) -> None:
        """The outputs tau, which the terms add to."""
        columns = {column.in_v: column for own in self.columns for column in own}
        tau: dict[int, Expression] = {}
        for force in self.structure.forces:
            for j, value in self._generalised(force, columns):
                tau[j] = tau.get(j, self.recorder.zero) + value
        self.outputs += [
            Output(f"tau[{j}]", self.recorder.leaf(f"tau[{j}]") + value)
            for j, value in tau.items()
            if not value.is_zero
        ]

    def _generalised(
        self, force: Force, columns: dict[int, _Column]
    ) -> list[tuple[int, Expression]]:
        """The generalised forces of an element, with their columns."""
        k, d, rest = self.take(force.coefficients)
        factors = self.take(force.factors)
        kind = FORCE_KINDS[force.kind]
        if kind == "joint_torque":
            return list(enumerate(self._over_time(force), force.in_v))
        if kind == "torsion_spring":
            value = k * (self.q[force.in_q] - rest) + d * self.v[force.in_v]
            return [(force.in_v, -value)]
        if kind == "limit_spring":
            return [(force.in_v, self._limit(force, k, d))]
        if kind == "coupling_spring":
            stretch, rate = -rest, self.recorder.zero
            for factor, i, j in zip(factors, force.positions, force.columns):
                stretch = stretch + factor * self.q[i]
                rate = rate + factor * self.v[j]
            value = -(k * stretch + d * rate)
            return [(j, factor * value) for j, factor in zip(force.columns, factors)]
        point, acting, moment = (
            self._wrench(force) if kind == "wrench" else self._spring(force, k, d, rest)
        )
        about_origin = _add(moment, _cross(point, acting))
        return [
            (
                j,
                factor * (_dot(columns[j].linear, acting) + _dot(columns[j].angular, about_origin)),
            )
            for j, factor in zip(force.columns, factors)
        ]

    def _over_time(self, force: Force) -> list[Expression]:
        """The numbers of an element, times the values of their laws."""
        numbers = self.take(force.numbers)
        first, count = force.laws
        if not count:
            return numbers
        laws = [self.recorder.leaf(f"s[{first + i}]") for i in range(count)]
        return [
            number * (laws[0] if count == 1 else law)
            for number, law in zip(numbers, laws * (len(numbers) if count == 1 else 1))
        ]

    def _limit(self, force: Force, k: Expression, d: Expression) -> Expression:
        call = self.recorder.call
        lower, upper, depth = self.take(force.numbers)
        position, rate = self.q[force.in_q], self.v[force.in_v]
        above = call("fmax", position - upper, self.recorder.zero)
        beyond = above + call("fmin", position - lower, self.recorder.zero)
        x = call("fmin", call("fabs", beyond) / depth, self.recorder.one)
        contact = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        return -(contact * (k * beyond + d * rate))

    def _frame(self, joint: int, placement: Span) -> tuple[Matrix, Vector]:
        body = self.body(joint)
        rotation, at = self.placement(placement)
        return _product(body.rotation, rotation), body.point(at)

    def _wrench(self, force: Force) -> tuple[Vector, Vector, Vector]:
        """Point, force and moment of a wrench."""
        fx, fy, fz, mx, my, mz = self._over_time(force)
        rotation, at = self._frame(force.joint_a, force.at_a)
        if force.in_link_axes:
            return at, _times(rotation, (fx, fy, fz)), _times(rotation, (mx, my, mz))
        return at, (fx, fy, fz), (mx, my, mz)

    def _spring(
        self, force: Force, k: Expression, d: Expression, rest: Expression
    ) -> tuple[Vector, Vector, Vector]:
        """The same of a spring and damper between two points."""
        a, b = self.body(force.joint_a), self.body(force.joint_b)
        _, at_a = self._frame(force.joint_a, force.at_a)
        _, at_b = self._frame(force.joint_b, force.at_b)
        apart = _subtract(at_a, at_b)
        length = self.recorder.call("sqrt", _dot(apart, apart))
        factor = -k
        if not rest.is_zero:
            coincident = self.take(self.structure.coincident)[0]
            self.guards.append(Guard(length, coincident * rest))
            factor = factor * (1.0 - rest / length)
        acting = _scaled(factor, apart)
        if not d.is_zero:
            rate = _subtract(a.point_velocity(at_a), b.point_velocity(at_b))
            along = _scaled(_dot(_scaled(1.0 / length, apart), rate) / length, apart)
            # Points that meet move along the line that joins them.
            choose = self.recorder.choose
            along = (
                choose(length, along[0], rate[0]),
                choose(length, along[1], rate[1]),
                choose(length, along[2], rate[2]),
            )
            acting = _subtract(acting, _scaled(d, along))
        return at_a, acting, self.nothing


FORCE_KINDS = (
    *("spring_damper", "joint_torque", "torsion_spring", "wrench", "bushing", "limit_spring"),
    "coupling_spring",
)
"""As forces.hpp numbers them."""


class RecordedTerms(NamedTuple):
    """The terms of a structure as expressions.

    Attributes
    ----------
    parameters
        Leaves that C reads as p[0], p[1], ..., and constants in the places of 0, 1 and -1.
    q, v
        The leaves of the state.
    outputs
        Places in C, as ``M[3]``, and what they are: M, nle, g, bias, G, tau, B, J.
    guards
        Distances of points that must not coincide.
    along_q, along_v
        The directions of the tangent coordinates (nv each): body velocities.
    """

    parameters: list[Expression]
    q: list[Expression]
    v: list[Expression]
    outputs: list[Output]
    guards: list[Guard]
    along_q: list[Direction]
    along_v: list[Direction]


def record_terms(structure: Structure) -> RecordedTerms:
    """The terms of ``structure``, recorded.

    Raises
    ------
    UnsupportedElementError
        If two points of an element coincide in every configuration.
    """
    trace = _Trace(structure)
    try:
        trace.tree()
        trace.rows()
        trace.forces()
        trace.bushing_bodies()
    except ZeroDivisionError as error:
        why = "the two points of an element coincide in every configuration"
        raise UnsupportedElementError(why) from error
    directions = trace.directions()
    return RecordedTerms(
        trace.parameters, trace.q, trace.v, trace.outputs, trace.guards, *directions
    )


class Source(NamedTuple):
    """The C of a structure, and the number of its statements."""

    text: str
    operations: int


def source_of(structure: Structure) -> Source:
    """The C source of the terms of ``structure``.

    It defines ``srm_mbs_sizes``, the sizes of its arguments; ``srm_mbs_constants``, which computes
    k from the parameters p; ``srm_mbs_terms``, of an evaluation; ``srm_mbs_factor``, its algebra
    (generated.hpp).

    Raises
    ------
    UnsupportedElementError
        If two points of an element coincide in every configuration.
    """
    recorded = record_terms(structure)
    written = write_c(recorded.outputs, recorded.guards)
    laws = sum(force.laws.length for force in structure.forces)
    sizes = (
        *(ABI, structure.nq, structure.nv, structure.rows, structure.rank),
        *(len(structure.codes), written.constant_count, laws, len(structure.bushing_joints)),
    )
    text = _TEMPLATE.format(
        sizes=", ".join(map(str, sizes)), constants=written.constants, terms=written.terms
    )
    text += algebra_of(structure.nv, structure.rows, structure.rank)
    return Source(text, written.operations)


_TEMPLATE = """\
/* Terms of a mechanism, generated by srm-mbs.
 *
 * q, v: coordinates and rates; p: parameters; k: what depends on them alone; s: values of laws.
 * M: upper triangle, column by column; nle, tau, g, bias; G[row][column]; B, J: kinematics of
 * the bodies of bushings. */
#include <math.h>

const int srm_mbs_sizes[] = {{{sizes}}};

void srm_mbs_constants(const double *restrict p, double *restrict k) {{
{constants}
}}

int srm_mbs_terms(const double *restrict q, const double *restrict v, const double *restrict k,
                  const double *restrict s, double *restrict M, double *restrict nle,
                  double *restrict tau, double *restrict g, double *restrict bias,
                  double *const *G, double *const *B, double *J) {{
{terms}
  return 0;
}}
"""
