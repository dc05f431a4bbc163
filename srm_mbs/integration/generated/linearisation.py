r"""The derivatives that a linearly implicit step needs, recorded and written as C.

With accelerations a, multipliers lam of the rows and laws y of forces held at their values,

    r(q, v) = M(q) a + b(q, v) + G(q)^T lam - f(q, v, y),     c(q, v) = G(q) a + (Gdot v)(q, v)

are 0 at an evaluation, and so are their changes: M da + G^T dlam = -dr and G da = -dc.  These are
solved with the factorisation of the evaluation, so that no derivative of M or of G itself is
needed: r is an inverse dynamics, and c the acceleration of the rows.  The laws are F(q, v), and r
is linear in y.  :func:`linearisation_of` writes dr, dc and dF along the tangent coordinates of q
(``pinocchio.integrate``), along v and, of r, along y, as derivatives of the graph that the terms
of an evaluation have (:mod:`srm_mbs.integration.generated.differentiation`).

Of a bushing the kernel gives the rotation vector phi, which depends on the step, and c(|phi|^2) of

    Jlog(phi) = 1 + [phi] / 2 + c [phi]^2,     d phi = Jlog^T w,

w the spin of a against b in the axes of b (:mod:`srm_mbs.dynamics.forces`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from srm_mbs.integration.generated.differentiation import (
    Direction,
    count_derivatives,
    derivatives,
)
from srm_mbs.integration.generated.expressions import Expression, Output
from srm_mbs.integration.generated.structure import ZERO, Bushing, Structure
from srm_mbs.integration.generated.terms import Row, Trace, seen_from
from srm_mbs.integration.generated.vectors import (
    Vector,
    add,
    cross,
    product,
    scaled,
    subtract,
    times,
    transposed,
)
from srm_mbs.integration.generated.writing import write_c

MOST_STATEMENTS = 8000
"""Statements of derivatives, as :func:`count_derivatives` estimates them, up to which they are
generated: they compile in 1 to 3.5 s."""
TURN_SIZE = 5
"""Numbers of each bushing: phi (3), c, and the derivative of c by the square of phi."""


class _Residual(Trace):
    """Records r, c and the laws."""

    def __init__(self, structure: Structure, frame: int) -> None:
        super().__init__(structure, frame)
        leaf = self.recorder.leaf
        self.accelerations = [leaf(f"a[{i}]") for i in range(structure.nv)]
        self.multipliers = [leaf(f"lam[{i}]") for i in range(structure.rows)]
        self.applied = [leaf(f"y[{i}]") for i in range(structure.held)]
        self.laws: Row = {}
        self.along_q, self.along_v = self.directions()

    def acting(self, law: int, value: Expression, rates: Iterable[int]) -> Expression:
        """See :class:`Trace`."""
        self.laws[law] = value
        return self.applied[law]

    def record(self) -> None:
        """r (nv), c and the laws of coordinates, by their numbers."""
        self.move()
        r = self.inverse_dynamics()
        _, self.c, G = self.closure_rows()
        for row, entries in G.items():
            for j, entry in entries.items():
                r[j] = r[j] + self.multipliers[row] * entry
        tau, lawful, self.own = self.generalised_forces()
        for forces in (tau, lawful, *self._bushings()):
            for j, value in forces.items():
                r[j] = r[j] - value
        self.r = r

    def _bushings(self) -> list[Row]:
        return [
            self._bushing(bushing, TURN_SIZE * i)
            for i, bushing in enumerate(self.structure.bushings)
        ]

    def _bushing(self, bushing: Bushing, first: int) -> Row:
        """The generalised forces of a bushing, whose numbers begin with ``first``."""
        columns, zero = self.columns_by_rate(), self.recorder.zero
        numbers = self.take(bushing.coefficients)
        a, b = self.body(bushing.joint_a), self.body(bushing.joint_b)
        at_a, own_b = self.placement(bushing.at_a)[1], self.placement(bushing.at_b)
        point, origin = a.point(at_a), b.point(own_b[1])
        axes = product(b.rotation, own_b[0])
        inverse = transposed(axes)
        factors = self.take(bushing.factors)
        shift = times(inverse, self.between(a, point, b, origin))
        seen = seen_from(b.place.base, point, a.place.base)
        rate = times(inverse, subtract(a.point_velocity(point), b.point_velocity(seen)))
        x, y, z, c, slope = (self.recorder.leaf(f"turn[{first + i}]") for i in range(TURN_SIZE))
        phi = (x, y, z)

        def turned(vector: Vector, sign: float) -> Vector:
            """Jlog, or its transpose, times a vector."""
            across = cross(phi, vector)
            half = scaled(self.recorder.constant(0.5 * sign), across)
            return add(add(vector, half), scaled(c, cross(phi, across)))

        spin = turned(times(inverse, subtract(a.spin, b.spin)), -1.0)
        stretches, rates = (*shift, *phi), (*rate, *spin)
        acting = [zero] * 6
        for i, law in enumerate(bushing.held):
            if law >= 0:
                value = numbers[i] * stretches[i] + numbers[6 + i] * rates[i]
                acting[i] = self.acting(law, value, bushing.columns)
        for j, factor in zip(bushing.columns, factors):
            change = turned(times(inverse, scaled(factor, columns[j].angular)), -1.0)
            by_square = sum((u * du for u, du in zip(phi, change)), zero)
            moves = dict(zip((*phi, c), (*change, 2.0 * slope * by_square)))
            self.along_q[j] = {**self.along_q[j], **moves}
        force = times(axes, (acting[0], acting[1], acting[2]))
        moment = times(axes, turned((acting[3], acting[4], acting[5]), 1.0))
        on_a = self.moved_by(columns, bushing.columns, factors, point, a.place.base, force, moment)
        return {j: -value for j, value in on_a}


class Linearisation(NamedTuple):
    """The C of the derivatives of a structure.

    Attributes
    ----------
    constant_count
        Length of their constants k.
    operations
        Statements of an evaluation.
    """

    text: str
    constant_count: int
    operations: int


_NONE = Linearisation("", 0, 0)


def linearisation_of(structure: Structure, frame: int) -> Linearisation:
    """The C of ``srm_mbs_linear_constants`` and ``srm_mbs_linearise``, recorded in the frame of the
    body of this motion.

    The text is empty where nothing damps, because steps are then not stiff, and where there would
    be more than MOST_STATEMENTS.

    Raises
    ------
    ZeroDivisionError
        If two points of an element coincide in every configuration.
    """
    if not _damped(structure):
        return _NONE
    trace = _Residual(structure, frame)
    trace.record()
    nv, rows, laws = structure.nv, structure.rows, structure.held
    along: list[Direction] = [*trace.along_q, *trace.along_v]
    by_law: list[Direction] = [{y: trace.recorder.one} for y in trace.applied]
    accelerations = [*trace.c.values(), *trace.laws.values()]
    if count_derivatives([*trace.r, *accelerations], along) > MOST_STATEMENTS:
        return _NONE
    outputs: list[Output] = []
    for i, column in enumerate(derivatives(trace.r, [*along, *by_law])):
        outputs += [Output(f"Dr[{i * nv + j}]", value) for j, value in enumerate(column)]
    for i, column in enumerate(derivatives(accelerations, along)):
        by_row = zip(trace.c, column)
        outputs += [Output(f"Dc[{i * rows + row}]", value) for row, value in by_row]
        by_law_number = zip(trace.laws, column[len(trace.c) :])
        outputs += [Output(f"Dl[{i * laws + law}]", value) for law, value in by_law_number]
    for j, value in trace.own.items():
        for name, direction in (("Dq", trace.along_q[j]), ("Dv", trace.along_v[j])):
            outputs.append(Output(f"{name}[{j}]", derivatives([value], [direction])[0][0]))
    written = write_c([out for out in outputs if not out.value.is_zero])
    text = _TEMPLATE.format(constants=written.constants, terms=written.terms)
    return Linearisation(text, written.constant_count, written.operations)


def _damped(structure: Structure) -> bool:
    """Whether damping or friction acts on a coordinate, or an element damps."""
    dampers = [force.coefficients.start + 1 for force in structure.forces]
    # Numbers of coupling springs are slack, friction and its speed.
    dampers += [
        force.numbers.start + 1
        for force in structure.forces
        if force.kind == "coupling_spring" and force.numbers.length
    ]
    for bushing in structure.bushings:
        dampers += range(bushing.coefficients.start + 6, bushing.coefficients.start + 12)
    return structure.passive or any(structure.codes[place] != ZERO for place in dampers)


_TEMPLATE = """
/* Derivatives for linearly implicit steps.
 *
 * a, lam, y: accelerations, multipliers and laws of elements, held; turn: of each bushing phi (3),
 * c and its derivative.  What is not 0 of: Dr (nv, 2 nv + laws) of M a + nle + G^T lam - f, Dc
 * (rows, 2 nv) of G a + bias and Dl (laws, 2 nv) of the laws, column by column, along q, v and y;
 * Dq, Dv (nv) of the laws of coordinates by their own coordinate and rate. */
void srm_mbs_linear_constants(const double *restrict p, double *restrict k) {{
{constants}
}}

void srm_mbs_linearise(const double *restrict q, const double *restrict v,
                       const double *restrict k, const double *restrict s,
                       const double *restrict a, const double *restrict lam,
                       const double *restrict y, const double *restrict turn,
                       double *restrict Dr, double *restrict Dc, double *restrict Dl,
                       double *restrict Dq, double *restrict Dv) {{
{terms}
}}
"""
