"""Vectors, rotations and inertia tensors of expressions."""

from __future__ import annotations

from typing import NamedTuple

from srm_mbs.integration.generated.expressions import CONSTANT, Expression

Vector = tuple[Expression, Expression, Expression]
Matrix = tuple[Vector, Vector, Vector]
"""Row by row."""


def add(a: Vector, b: Vector) -> Vector:
    """a + b"""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def subtract(a: Vector, b: Vector) -> Vector:
    """a - b"""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scaled(s: Expression, a: Vector) -> Vector:
    """s a"""
    return s * a[0], s * a[1], s * a[2]


def dot(a: Vector, b: Vector) -> Expression:
    """a . b"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """a x b"""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def times(R: Matrix, a: Vector) -> Vector:
    """R a"""
    return dot(R[0], a), dot(R[1], a), dot(R[2], a)


def transposed(R: Matrix) -> Matrix:
    """R^T"""
    return (
        (R[0][0], R[1][0], R[2][0]),
        (R[0][1], R[1][1], R[2][1]),
        (R[0][2], R[1][2], R[2][2]),
    )


def product(R: Matrix, S: Matrix) -> Matrix:
    """R S"""
    columns = transposed(S)
    return (
        (dot(R[0], columns[0]), dot(R[0], columns[1]), dot(R[0], columns[2])),
        (dot(R[1], columns[0]), dot(R[1], columns[1]), dot(R[1], columns[2])),
        (dot(R[2], columns[0]), dot(R[2], columns[1]), dot(R[2], columns[2])),
    )


class Moments(NamedTuple):
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

    def turned(self, R: Matrix) -> Moments:
        """R I R^T"""
        aligned = self.xy.is_zero and self.xz.is_zero and self.yz.is_zero
        if aligned and not any(entry.depends == CONSTANT for row in R for entry in row):
            return self._turned_about_axes(R)
        T = product(product(R, self.matrix), transposed(R))
        return Moments(T[0][0], T[0][1], T[0][2], T[1][1], T[1][2], T[2][2])

    def _turned_about_axes(self, R: Matrix) -> Moments:
        """R I R^T = zz 1 + (xx - zz) x x^T + (yy - zz) y y^T, with columns x and y of R.

        With the zeros of a rotation about one axis, moments about it need no sum, and round once.
        """
        x, y, _ = transposed(R)
        a, b = scaled(self.xx - self.zz, x), scaled(self.yy - self.zz, y)
        return Moments(
            self.zz + (a[0] * x[0] + b[0] * y[0]),
            a[0] * x[1] + b[0] * y[1],
            a[0] * x[2] + b[0] * y[2],
            self.zz + (a[1] * x[1] + b[1] * y[1]),
            a[1] * x[2] + b[1] * y[2],
            self.zz + (a[2] * x[2] + b[2] * y[2]),
        )

    def plus(self, other: Moments) -> Moments:
        return Moments(*(a + b for a, b in zip(self, other)))

    @property
    def is_zero(self) -> bool:
        return all(entry.is_zero for entry in self)
