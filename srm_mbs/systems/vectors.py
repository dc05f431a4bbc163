"""Three numbers as plain floats: products of them before NumPy would have started."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from srm_mbs.arrays import FloatArray

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
