r"""The terms of an evaluation of a mechanism, recorded and written as C.

One pass over the tree, in the frame of one body or of the ground.  With the columns J_k of a
joint's motions about the origin of this frame, V the spatial velocity of its body, p its parent,
and u, w its linear and angular velocity against the parent, the accelerations without those of
rates are

    V = V_p + sum J_k v_k,     \alpha = \alpha_p + \omega_p x w,     a_0 = -gravity,
    a(x) = a(o) + ([\alpha] + [\omega]^2) (x - o),     a(o) = a_p(o) + (\omega_p + \omega) x u,
    F = (m a(c), c x m a(c) + I \alpha + \omega x I \omega),
    nle_k = J_k . (sum of F over the subtree),
    M_jk = J_j . (Y J_k)   for j on the way from the ground to k,

with o the origin of the body, c, I its mass centre and moments, and Y the inertia of the subtree of
k: these are Newton's and Euler's equations and the composite rigid-body
algorithm (R. Featherstone, Rigid Body Dynamics Algorithms, 2008, chapters 5 and 6), as Pinocchio
has them.  The rows are those of :mod:`srm_mbs.dynamics.constraints.rows`, the forces those of
:mod:`srm_mbs.dynamics.forces`.

Left to the kernel: bushings, whose kinematics the terms compute, forces along coordinates (damping,
friction, controllers), motions of drives, laws over time, whose values the terms take, and all
algebra.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from srm_mbs.integration.generated.differentiation import Direction
from srm_mbs.integration.generated.expressions import (
    PARAMETER,
    Expression,
    Guard,
    Output,
    Recorder,
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
from srm_mbs.integration.generated.vectors import (
    Matrix,
    Moments,
    Vector,
    add,
    cross,
    dot,
    product,
    scaled,
    subtract,
    times,
    transposed,
)

Row = dict[int, Expression]
"""Entries by their numbers."""


class Column(NamedTuple):
    """The motion of a body by one rate; linear: that of its point at the base of its tree."""

    in_v: int
    linear: Vector
    angular: Vector
    base: Vector


class Place(NamedTuple):
    """Where a body is: its points are counted from the base of its tree."""

    rotation: Matrix
    origin: Vector
    base: Vector
    own: Vector
    """Where on the body its origin is."""

    def point(self, local: Vector) -> Vector:
        """The place of a point of the body."""
        return add(self.origin, times(self.rotation, subtract(local, self.own)))


class Body(NamedTuple):
    """A body that moves; the velocity is of its point at the base of its tree, the acceleration of
    its own origin."""

    place: Place
    velocity: Vector
    spin: Vector
    bias: Vector
    spin_bias: Vector
    gradient: Matrix
    """Of the acceleration, by the place of a point: :func:`gradient_of`."""

    @property
    def rotation(self) -> Matrix:
        """From the axes of the body."""
        return self.place.rotation

    def point(self, local: Vector) -> Vector:
        """The place of a point of the body."""
        return self.place.point(local)

    def point_velocity(self, x: Vector) -> Vector:
        """Velocity of its point at ``x``."""
        return add(self.velocity, cross(self.spin, x))

    def point_bias(self, x: Vector) -> Vector:
        """Acceleration of its point at ``x``, without those of the joints."""
        return add(self.bias, times(self.gradient, subtract(x, self.place.origin)))


def gradient_of(spin: Vector, spin_bias: Vector) -> Matrix:
    """[alpha] + [omega]^2, with the matrices of cross products."""
    (x, y, z), (a, b, c) = spin, spin_bias
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return (
        (-(yy + zz), xy - c, xz + b),
        (xy + c, -(xx + zz), yz - a),
        (xz - b, yz + a, -(xx + yy)),
    )


def turning_moment(body: Body, own: Moments) -> Vector:
    r"""I \alpha + \omega x I \omega of a body about its mass centre.

    It is the sum of x x (B x) dm with the gradient B of the acceleration, in which products of the
    spin are known already: two thirds of the operations of both products with I.
    """
    (x, y, z), (a, b, c) = body.spin, body.spin_bias
    (_, xy, xz), (yx, _, yz), (zx, zy, _) = body.gradient
    xx, yy, zz = x * x, y * y, z * z
    return (
        own.xx * a + (y * z) * (own.zz - own.yy) + own.xz * yx - own.xy * zx + own.yz * (yy - zz),
        own.yy * b + (x * z) * (own.xx - own.zz) + own.xy * zy - own.yz * xy + own.xz * (zz - xx),
        own.zz * c + (x * y) * (own.yy - own.xx) + own.yz * xz - own.xz * yz + own.xy * (xx - yy),
    )


class Inertia(NamedTuple):
    """Mass, mass centre and moments about it, in the axes of the frame."""

    mass: Expression
    centre: Vector
    moments: Moments

    def plus(self, other: Inertia) -> Inertia:
        """Both bodies together."""
        if other.mass.is_zero:
            return Inertia(self.mass, self.centre, self.moments.plus(other.moments))
        if self.mass.is_zero:
            return Inertia(other.mass, other.centre, self.moments.plus(other.moments))
        mass = self.mass + other.mass
        share = other.mass / mass
        apart = subtract(other.centre, self.centre)
        reduced = self.mass * share
        x, y, z = apart
        shifted = Moments(
            reduced * (y * y + z * z),
            -(reduced * (x * y)),
            -(reduced * (x * z)),
            reduced * (x * x + z * z),
            -(reduced * (y * z)),
            reduced * (x * x + y * y),
        )
        centre = add(self.centre, scaled(share, apart))
        return Inertia(mass, centre, self.moments.plus(other.moments).plus(shifted))


def seen_from(base: Vector, x: Vector, of: Vector) -> Vector:
    """The point ``x``, which is counted from the base ``of``, counted from another."""
    return x if base is of else add(x, subtract(of, base))


GROUND = -1
"""Number of the body that does not move."""


class Trace:
    """Records the terms of a structure in the frame of the body of a motion, or of the ground."""

    def __init__(self, structure: Structure, frame: int = GROUND) -> None:
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
        self.joints = [self._joint(motion) for motion in structure.motions]
        self.places = self._places(frame)
        ground, gravity = self.places[GROUND], self.take(structure.gravity)
        bias = times(ground.rotation, (-gravity[0], -gravity[1], -gravity[2]))
        spin_bias = times(ground.rotation, (-gravity[3], -gravity[4], -gravity[5]))
        still = self.nothing
        self.ground = Body(ground, still, still, bias, spin_bias, gradient_of(still, spin_bias))
        self.accelerations = [zero] * structure.nv
        """Those of the rates; without them, terms are nonlinear effects and bias."""
        self.held = recorder.leaf("held")
        self.guards: list[Guard] = []
        self.outputs: list[Output] = []
        self.bodies: list[Body] = []
        self.roots: list[int] = []
        """Of each motion, the first one of its subtree on the ground: the number of its cell."""
        self.cells: dict[int, int] = {}
        """Those of the rates."""
        self.columns: list[list[Column]] = []
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

    def body(self, joint: int) -> Body:
        """The body of a joint of the model."""
        number = self.structure.bodies[joint]
        return self.ground if number < 0 else self.bodies[number]

    def cell_of(self, rates: Iterable[int]) -> int:
        """The cell that most of the rates belong to; -1 without any."""
        found = Counter(self.cells[j] for j in rates).most_common(1)
        return found[0][0] if found else -1

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
            axes = transposed(self._of_quaternion(first + 3))
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
            along = scaled(self.take(motion.pitch)[0], axis)
            return rotation, scaled(q[first], along), [(along, axis)]
        if kind == "prismatic":
            axis = self.vector(motion.axis)
            return units, scaled(q[first], axis), [(axis, none)]
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

    def base(self, motion: Motion) -> Vector:
        """The base of a tree, by its first motion; none by others."""
        return self.vector(motion.base) if motion.base.length else self.nothing

    def _places(self, frame: int) -> dict[int, Place]:
        """Where the bodies are in the frame of one of them: those on its way to the ground, and
        then the others.

        In the frame of the ground rounding follows the size of a tree, not its distance from the
        origin of the world: every tree has a base.
        """
        motions = self.structure.motions
        out = {frame: Place(self.units, self.nothing, self.nothing, self.nothing)}
        number = frame
        while number >= 0:
            motion, (rotation, origin, _, _) = motions[number], out[number]
            placed, at = self.placement(motion.placement)
            turned, moved, _ = self.joints[number]
            before = product(rotation, transposed(turned))
            above = product(before, transposed(placed))
            way = add(times(above, at), times(before, moved))
            number = motion.parent
            out[number] = Place(above, subtract(origin, way), self.nothing, self.base(motion))
        for number, motion in enumerate(motions):
            if number not in out:
                parent = out[motion.parent]
                placed, at = self.placement(motion.placement)
                turned, moved, _ = self.joints[number]
                before = product(parent.rotation, placed)
                base = parent.base
                way = times(before, moved)
                if motion.parent < 0 and frame == GROUND:
                    base = self.base(motion)
                    if motion.base.length and motion.kind in ("free", "planar"):
                        base, way = add(base, way), self.nothing
                else:
                    at = add(self.base(motion), at)
                origin = add(parent.point(at), way)
                out[number] = Place(product(before, turned), origin, base, self.nothing)
        return out

    def _move(self, number: int, motion: Motion) -> None:
        """Append the body of ``motion`` and its columns."""
        parent = self.ground if motion.parent < 0 else self.bodies[motion.parent]
        self.roots.append(number if motion.parent < 0 else self.roots[motion.parent])
        place = self.places[number]
        rotation, origin, base, _ = place
        own = []
        linear, angular, ahead = self.nothing, self.nothing, self.nothing
        _, _, subspace = self.joints[number]
        at = seen_from(parent.place.base, origin, base)
        bias, spin_bias = parent.point_bias(at), parent.spin_bias
        for i, (shift, turn) in enumerate(subspace, motion.in_v):
            along, about = times(rotation, shift), times(rotation, turn)
            column = Column(i, add(along, cross(origin, about)), about, base)
            own.append(column)
            linear = add(linear, scaled(self.v[i], column.linear))
            angular = add(angular, scaled(self.v[i], about))
            ahead = add(ahead, scaled(self.v[i], along))
            bias = add(bias, scaled(self.accelerations[i], along))
            spin_bias = add(spin_bias, scaled(self.accelerations[i], about))
        spin = add(parent.spin, angular)
        # A helical joint turns about the direction in which it moves.
        turning = parent.spin if motion.kind == "helical" else spin
        bias = add(bias, cross(add(parent.spin, turning), ahead))
        spin_bias = add(spin_bias, cross(parent.spin, angular))
        velocity = add(parent.velocity, linear)
        gradient = gradient_of(spin, spin_bias)
        self.bodies.append(Body(place, velocity, spin, bias, spin_bias, gradient))
        self.columns.append(own)
        self.cells |= dict.fromkeys((column.in_v for column in own), self.roots[-1])

    # -- inertia

    def _inertia(self, motion: Motion, body: Body) -> Inertia:
        mass, x, y, z, *moments = self.take(motion.inertia)
        own = Moments(*moments)
        if not own.is_zero:
            own = own.turned(body.rotation)
        return Inertia(mass, body.point((x, y, z)), own)

    def _force(self, body: Body, inertia: Inertia) -> tuple[Vector, Vector]:
        """The wrench about the frame's origin that accelerates a body."""
        force, moment = self.nothing, self.nothing
        if not inertia.mass.is_zero:
            force = scaled(inertia.mass, body.point_bias(inertia.centre))
            moment = cross(inertia.centre, force)
        if not inertia.moments.is_zero:
            moment = add(moment, turning_moment(body, inertia.moments))
        return force, moment

    def tree(self) -> None:
        """Kinematics, and the outputs M and nle."""
        self.move()
        self._mass_matrix()
        for i, value in enumerate(self.inverse_dynamics()):
            self.outputs.append(Output(f"nle[{i}]", value, self.cell_of([i])))

    def move(self) -> None:
        """Bodies, their columns and their inertias."""
        for number, motion in enumerate(self.structure.motions):
            self._move(number, motion)
        pairs = zip(self.structure.motions, self.bodies)
        self.inertias = [self._inertia(motion, body) for motion, body in pairs]

    def inverse_dynamics(self) -> list[Expression]:
        """The forces (nv) that the accelerations take, without armature: of none, those of gravity
        and velocities."""
        motions = self.structure.motions
        wrenches = [self._force(body, own) for body, own in zip(self.bodies, self.inertias)]
        out = [self.recorder.zero] * self.structure.nv
        for number in range(len(motions) - 1, -1, -1):
            parent = motions[number].parent
            force, moment = wrenches[number]
            for column in self.columns[number]:
                out[column.in_v] = dot(column.linear, force) + dot(column.angular, moment)
            if parent >= 0:
                above = wrenches[parent]
                wrenches[parent] = add(above[0], force), add(above[1], moment)
        return out

    def _mass_matrix(self) -> None:
        composite, armature = list(self.inertias), self.take(self.structure.armature)
        for number in range(len(composite) - 1, -1, -1):
            parent = self.structure.motions[number].parent
            for column in self.columns[number]:
                self._mass_column(column, number, composite[number], armature)
            if parent >= 0:
                composite[parent] = composite[parent].plus(composite[number])

    def _mass_column(
        self, column: Column, number: int, subtree: Inertia, armature: list[Expression]
    ) -> None:
        """The entries of M of a column and those on the way to the ground."""
        speed = add(column.linear, cross(column.angular, subtree.centre))
        force = scaled(subtree.mass, speed)
        moment = add(cross(subtree.centre, force), subtree.moments.times(column.angular))
        nv = self.structure.nv
        above = number
        while above >= 0:
            for other in self.columns[above]:
                if other.in_v > column.in_v:
                    continue
                value = dot(other.linear, force) + dot(other.angular, moment)
                if other.in_v == column.in_v:
                    value = value + armature[column.in_v]
                target = f"M[{column.in_v * nv + other.in_v}]"
                self.outputs.append(Output(target, value, self.roots[number]))
            above = self.structure.motions[above].parent

    def between(self, a: Body, at_a: Vector, b: Body, at_b: Vector) -> Vector:
        """From a point of b to one of a."""
        if b is self.ground:  # what does not move is subtracted from what does not
            return subtract(at_a, seen_from(a.place.base, at_b, b.place.base))
        return subtract(seen_from(b.place.base, at_a, a.place.base), at_b)

    # -- closures

    def rows(self) -> None:
        """The outputs g, bias and G."""
        g, bias, G = self.closure_rows()
        for row in g:
            cell = self.cell_of(G[row])
            values = {f"g[{row}]": g[row], f"bias[{row}]": bias[row]}
            values |= {f"G[{row}][{j}]": entry for j, entry in G[row].items()}
            self.outputs += [Output(target, value, cell) for target, value in values.items()]

    def closure_rows(self) -> tuple[Row, Row, dict[int, Row]]:
        """g, bias and the entries of G, by rows."""
        columns = self.columns_by_rate()
        g: Row = {}
        bias: Row = {}
        G: dict[int, Row] = {}
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
        return g, bias, G

    def columns_by_rate(self) -> dict[int, Column]:
        """The columns of the Jacobian, by the rate of each."""
        return {column.in_v: column for own in self.columns for column in own}

    def _positions(
        self,
        closure: Closure,
        columns: dict[int, Column],
        g: Row,
        bias: Row,
        G: dict[int, Row],
    ) -> None:
        directions, distances = self.take(closure.directions), self.take(closure.distances)
        if not directions and not distances:
            return
        a, b = self.body(closure.joint_a), self.body(closure.joint_b)
        x = a.point(self.vector(closure.at_a))
        apart = self.between(a, x, b, b.point(self.vector(closure.at_b)))
        seen = seen_from(b.place.base, x, a.place.base)
        rate = subtract(a.point_velocity(x), b.point_velocity(seen))
        change = subtract(a.point_bias(x), b.point_bias(seen))
        change = subtract(change, scaled(self.recorder.constant(2.0), cross(b.spin, rate)))
        moved = []
        for j, sign in closure.support:
            at = seen_from(columns[j].base, x, a.place.base)
            moved.append((j, sign, add(columns[j].linear, cross(columns[j].angular, at))))
        row = closure.first_row

        def along(d: Vector, value: Expression, acceleration: Expression) -> None:
            nonlocal row
            g[row], bias[row] = value, acceleration
            G[row] = {j: dot(d, point) * float(sign) for j, sign, point in moved}
            row += 1

        for k in range(0, len(directions), 3):
            d = times(b.rotation, (directions[k], directions[k + 1], directions[k + 2]))
            along(d, dot(d, apart), dot(d, change))
        for k in range(0, len(distances), 2):
            length, factor = distances[k], distances[k + 1]
            distance = self.recorder.call("sqrt", dot(apart, apart))
            coincident = self.take(self.structure.coincident)[0]
            cell = self.cell_of(j for j, _ in closure.support)
            self.guards.append(Guard(distance, coincident * length, cell))
            d = scaled(factor / distance, apart)
            across = cross(d, rate)
            turning = dot(across, across) / (factor * distance)
            along(d, factor * (distance - length), dot(d, change) + turning)

    def _alignments(
        self,
        closure: Closure,
        columns: dict[int, Column],
        g: Row,
        bias: Row,
        G: dict[int, Row],
    ) -> None:
        numbers = self.take(closure.alignments)
        a, b = self.body(closure.joint_a), self.body(closure.joint_b)
        w = subtract(a.spin, b.spin)
        change = subtract(subtract(a.spin_bias, b.spin_bias), cross(b.spin, a.spin))
        row = closure.first_row + closure.directions.length // 3 + closure.distances.length // 2
        for k in range(0, len(numbers), 6):
            m = times(a.rotation, (numbers[k], numbers[k + 1], numbers[k + 2]))
            n = times(b.rotation, (numbers[k + 3], numbers[k + 4], numbers[k + 5]))
            moment = cross(m, n)
            turning = add(cross(change, m), cross(w, cross(w, m)))
            g[row], bias[row] = dot(n, m), dot(n, turning)
            G[row] = {
                j: dot(moment, columns[j].angular) * float(sign) for j, sign in closure.support
            }
            row += 1

    def _coordinates(
        self,
        own: CoordinateRow,
        g: Row,
        bias: Row,
        G: dict[int, Row],
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
        accelerated = sum((c * self.accelerations[j] for j, c in entries.items()), zero)
        bias[own.row] = accelerated - 2.0 * (curvature * (rate * rate))

    def bushing_bodies(self) -> None:
        """The outputs B and J: placements and velocities in the axes of the bodies, and columns of
        the Jacobian in world axes."""
        for k, joint in enumerate(self.structure.bushing_joints):
            body, cell = self.body(joint), self.roots[self.structure.bodies[joint]]
            inverse = transposed(body.rotation)
            velocity = times(inverse, body.point_velocity(body.place.origin))
            columns = [entry for column in inverse for entry in column]
            motion = (*velocity, *times(inverse, body.spin))
            for i, values in enumerate((columns, body.place.origin, motion), 3 * k):
                self.outputs += [
                    Output(f"B[{i}][{n}]", value, cell) for n, value in enumerate(values)
                ]
        own = self.columns_by_rate()
        for j in self.structure.bushing_columns:
            values = (*own[j].linear, *own[j].angular)
            self.outputs += [
                Output(f"J[{6 * j + n}]", value, self.cells[j]) for n, value in enumerate(values)
            ]

    # -- forces

    def forces(self) -> None:
        """The outputs tau and lawful, which the terms add to, own and values."""
        tau, lawful, own = self.generalised_forces()
        zero = self.recorder.zero
        for j, value in own.items():
            acting = self.recorder.choose(self.held, zero, value)
            lawful[j] = lawful.get(j, zero) + acting
        for name, forces in (("tau", tau), ("lawful", lawful)):
            self.outputs += [
                Output(f"{name}[{j}]", self.recorder.leaf(f"{name}[{j}]") + value, self.cells[j])
                for j, value in forces.items()
                if not value.is_zero
            ]
        self.outputs += [Output(f"own[{j}]", value, self.cells[j]) for j, value in own.items()]

    def generalised_forces(self) -> tuple[Row, Row, Row]:
        """Those of elements without laws, and with laws between links, without bushings; and the
        laws of coordinates."""
        columns, zero = self.columns_by_rate(), self.recorder.zero
        tau: Row = {}
        lawful: Row = {}
        own: Row = {}
        for force in self.structure.forces:
            kind = force.kind
            to = tau if kind in LAWLESS else own if kind in ON_COORDINATES else lawful
            for j, value in self._generalised(force, columns):
                to[j] = to.get(j, zero) + value
        return tau, lawful, own

    def acting(self, law: int, value: Expression, rates: Iterable[int]) -> Expression:
        """The value of a law of an element on these rates, or what is held in its place."""
        self.outputs.append(Output(f"values[{law}]", value, self.cell_of(rates)))
        return self.recorder.choose(self.held, self.recorder.leaf(f"y[{law}]"), value)

    def _generalised(
        self, force: Force, columns: dict[int, Column]
    ) -> list[tuple[int, Expression]]:
        """The generalised forces of an element, with their columns."""
        k, d, rest = self.take(force.coefficients)
        factors = self.take(force.factors)
        kind = force.kind
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
            value = k * self._stretched(force, stretch) + d * rate
            if force.numbers.length:
                _, friction, speed = self.take(force.numbers)
                value = value + friction * self.recorder.call("tanh", rate / speed)
            value = self.acting(force.held, -value, force.columns)
            return [(j, factor * value) for j, factor in zip(force.columns, factors)]
        point, acting, moment = (
            self._wrench(force) if kind == "wrench" else self._spring(force, k, d, rest)
        )
        base = self.body(force.joint_a).place.base
        return self.moved_by(columns, force.columns, factors, point, base, acting, moment)

    def moved_by(
        self,
        columns: dict[int, Column],
        moving: Sequence[int],
        factors: Sequence[Expression],
        point: Vector,
        base: Vector,
        force: Vector,
        moment: Vector,
    ) -> list[tuple[int, Expression]]:
        """The generalised forces of a force at a point, counted from ``base``, and a moment."""
        out = []
        for j, factor in zip(moving, factors):
            column = columns[j]
            about_base = add(moment, cross(seen_from(column.base, point, base), force))
            value = dot(column.linear, force) + dot(column.angular, about_base)
            out.append((j, factor * value))
        return out

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

    def _stretched(self, force: Force, beyond: Expression) -> Expression:
        """The stretch of a spring ``beyond`` its rest length, without its slack."""
        if not force.numbers.length:
            return beyond
        call, slack = self.recorder.call, self.take(force.numbers)[0]
        return beyond - call("fmin", call("fmax", beyond, self.recorder.zero), slack)

    def _frame(self, joint: int, placement: Span) -> tuple[Matrix, Vector]:
        body = self.body(joint)
        rotation, at = self.placement(placement)
        return product(body.rotation, rotation), body.point(at)

    def _wrench(self, force: Force) -> tuple[Vector, Vector, Vector]:
        """Point, force and moment of a wrench."""
        fx, fy, fz, mx, my, mz = self._over_time(force)
        rotation, at = self._frame(force.joint_a, force.at_a)
        if force.in_link_axes:
            return at, times(rotation, (fx, fy, fz)), times(rotation, (mx, my, mz))
        axes = self.ground.rotation
        return at, times(axes, (fx, fy, fz)), times(axes, (mx, my, mz))

    def _spring(
        self, force: Force, k: Expression, d: Expression, rest: Expression
    ) -> tuple[Vector, Vector, Vector]:
        """The same of a spring and damper between two points."""
        a, b = self.body(force.joint_a), self.body(force.joint_b)
        _, at_a = self._frame(force.joint_a, force.at_a)
        _, at_b = self._frame(force.joint_b, force.at_b)
        apart = self.between(a, at_a, b, at_b)
        if d.is_zero:
            rate = self.nothing
        else:
            rate = subtract(a.point_velocity(at_a), b.point_velocity(at_b))
        if force.held < 0:
            return at_a, self._spring_without_length(apart, rate, k, d), self.nothing
        length = self.recorder.call("sqrt", dot(apart, apart))
        coincident = self.take(self.structure.coincident)[0]
        self.guards.append(Guard(length, coincident * rest, self.cell_of(force.columns)))
        inverse = 1.0 / length
        if force.numbers.length:  # the ends of a rope may meet
            inverse = self.recorder.choose(length, inverse, self.recorder.zero)
        line = scaled(inverse, apart)
        value = -(k * self._stretched(force, length - rest) + d * dot(line, rate))
        return at_a, scaled(self.acting(force.held, value, force.columns), line), self.nothing

    def _spring_without_length(
        self, apart: Vector, rate: Vector, k: Expression, d: Expression
    ) -> Vector:
        """Its force, which has no direction of its own where the points meet."""
        acting = scaled(-k, apart)
        if d.is_zero:
            return acting
        length = self.recorder.call("sqrt", dot(apart, apart))
        along = scaled(dot(scaled(1.0 / length, apart), rate) / length, apart)
        # Points that meet move along the line that joins them.
        choose = self.recorder.choose
        along = (
            choose(length, along[0], rate[0]),
            choose(length, along[1], rate[1]),
            choose(length, along[2], rate[2]),
        )
        return subtract(acting, scaled(d, along))


LAWLESS = ("joint_torque", "wrench")
"""Kinds of forces that neither damp nor store energy."""
ON_COORDINATES = ("torsion_spring", "limit_spring")
"""Those whose law is that of a coordinate."""


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


def record_terms(structure: Structure, frame: int) -> RecordedTerms:
    """The terms of ``structure``, recorded in the frame of this body.

    ``frame`` is the number of a motion or GROUND, in whose frame bushings take their bodies.

    Raises
    ------
    UnsupportedElementError
        If two points of an element coincide in every configuration.
    """
    trace = Trace(structure, frame)
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
