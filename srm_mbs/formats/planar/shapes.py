"""Bars of a planar linkage: their shape from lengths, their inertia, and how they are drawn.

Everything here is in the plane of the drawing (x, y); :func:`in_space` maps it to the x-z plane of
the world, where positive angles turn from x to z about -y.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.formats.graph.spanning_tree_to_urdf import numbers, visual

FIT_TOLERANCE = 1e-13
"""Residual of lengths, over the largest of them, at which the shape of a bar has them."""
FIT_ITERATIONS = 100
"""Newton steps after which lengths are taken for impossible."""
DIVERGED = 1e12
"""Coordinates over the largest of the lengths at which Newton's method has failed."""
COLLINEAR = 1e-12
"""Distance of points from a line, over the size of the bar, that is rounding."""
PALETTE = (
    (0.0, 0.447, 0.698, 1.0),
    (0.902, 0.624, 0.0, 1.0),
    (0.0, 0.62, 0.451, 1.0),
    (0.8, 0.475, 0.655, 1.0),
    (0.835, 0.369, 0.0, 1.0),
    (0.337, 0.706, 0.914, 1.0),
)
"""Colours of the bars (red, green, blue, opacity), after Okabe and Ito."""
GREY = (0.55, 0.57, 0.6, 1.0)
DARK = (0.15, 0.16, 0.18, 1.0)


Point = tuple[float, float]
"""x and y of the drawing (m): plain numbers, since NumPy takes ten times as long for so few."""


def in_space(point: Point, layer: float = 0.0) -> FloatArray:
    """The point (x, y) of the drawing in the world, (x, -layer, y), in m."""
    return np.array([point[0], -layer, point[1]])


def difference(a: Point, b: Point) -> Point:
    """a - b."""
    return a[0] - b[0], a[1] - b[1]


def turned(point: Point, angle: float) -> Point:
    """``point``, turned by ``angle`` (rad), counter-clockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return c * point[0] - s * point[1], s * point[0] + c * point[1]


def direction_angle(vector: Point) -> float:
    """Angle (rad) of a vector against x, in (-pi, pi]."""
    return math.atan2(vector[1], vector[0])


def own_axes(points: Sequence[Point]) -> list[Point]:
    """Points in axes that begin at the first of them, with x towards the second."""
    angle = direction_angle(difference(points[1], points[0]))
    places = [turned(difference(point, points[0]), -angle) for point in points]
    rounding = COLLINEAR * max(max(abs(x), abs(y)) for x, y in places)
    return [(0.0 if abs(x) < rounding else x, 0.0 if abs(y) < rounding else y) for x, y in places]


def fitted(points: Sequence[Point], lengths: Mapping[tuple[int, int], float]) -> list[Point]:
    """The points next to ``points`` that have given distances.

    Newton's method on the squared distances, with the shortest of all corrections at each step.

    Parameters
    ----------
    points
        Approximate positions.
    lengths
        Distances of pairs of them, by their indices.

    Raises
    ------
    InputError
        If no such points are found: lengths that violate the triangle inequality, for example.
    """
    out = np.array(points, dtype=float)
    pairs, wanted = list(lengths), np.array(list(lengths.values()))
    for _ in range(FIT_ITERATIONS):
        apart = np.array([out[i] - out[j] for i, j in pairs])
        residual = wanted**2 - (apart**2).sum(axis=1)
        if np.abs(residual).max() <= FIT_TOLERANCE * wanted.max() ** 2:
            return [(x, y) for x, y in out.tolist()]
        rows = np.zeros((len(pairs), out.size))
        for row, (i, j), d in zip(rows, pairs, apart):
            row[2 * i : 2 * i + 2] = 2.0 * d
            row[2 * j : 2 * j + 2] = -2.0 * d
        out += np.linalg.lstsq(rows, residual, rcond=1e-12)[0].reshape(out.shape)
        if not np.abs(out).max() <= DIVERGED * wanted.max():
            break
    raise InputError(
        "there is no shape with these lengths", remedy="Check the lengths between its points"
    )


def outline(points: Sequence[Point]) -> list[tuple[int, int]]:
    """Edges of the convex hull of points, as pairs of indices: one if they are in line.

    A. M. Andrew, Information Processing Letters 9 (1979) 216.
    """
    if len(points) == 2:
        return [(0, 1)]
    order = sorted(range(len(points)), key=points.__getitem__)
    (left, right), (bottom, top) = ((min(side), max(side)) for side in zip(*points))
    rounding = COLLINEAR * max(right - left, top - bottom) ** 2

    def chain(indices: Iterable[int]) -> list[int]:
        found: list[int] = []
        for i in indices:
            while len(found) > 1:
                (px, py), (ax, ay), (bx, by) = points[found[-2]], points[found[-1]], points[i]
                if (ax - px) * (by - py) - (ay - py) * (bx - px) > rounding:
                    break
                found.pop()
            found.append(i)
        return found

    ring = [*chain(order)[:-1], *chain(reversed(order))[:-1]]
    if len(ring) == 2:
        return [(ring[0], ring[1])]
    return list(zip(ring, [*ring[1:], ring[0]]))


class PlanarInertia(NamedTuple):
    """Inertia of a body in the plane.

    Attributes
    ----------
    mass
        kg.
    centre
        Centre of mass.
    tensor
        xx, xz, yy and zz about it (kg m^2), in the axes x, -y, z of :func:`in_space`; xy and yz are
        zero.
    """

    mass: float
    centre: Point
    tensor: tuple[float, float, float, float]

    def in_space(self) -> pin.Inertia:
        """The same for Pinocchio."""
        out = pin.Inertia(self.mass, in_space(self.centre), np.zeros((3, 3)))
        out.inertia = self.matrix()  # unchecked: the check of the tree does
        return out

    def matrix(self) -> FloatArray:
        """The tensor (3, 3)."""
        xx, xz, yy, zz = self.tensor
        return np.array([[xx, 0.0, xz], [0.0, yy, 0.0], [xz, 0.0, zz]])


class Slender(NamedTuple):
    """Slender bars of 1 kg in all along the outline of points.

    Attributes
    ----------
    length
        Of all bars (m).
    centre
        Centre of mass (m).
    tensor
        As of a :class:`PlanarInertia` (m^2, for 1 kg).
    """

    length: float
    centre: Point
    tensor: tuple[float, float, float, float]

    def body(self, mass: float, centre: Point, moment: float | None) -> PlanarInertia:
        """A body of ``mass`` (kg) about its ``centre``, with this tensor, scaled to a ``moment``
        (kg m^2) in the plane if there is one."""
        xx, xz, yy, zz = self.tensor
        moment = mass * yy if moment is None else moment
        tensor = (moment * xx / yy, moment * xz / yy, moment * yy / yy, moment * zz / yy)
        return PlanarInertia(mass, centre, tensor)


def slender(points: Sequence[Point]) -> Slender:
    """The slender bars along the :func:`outline` of points."""
    ends = [(*points[i], *points[j]) for i, j in outline(points)]
    parts = [math.hypot(c - a, d - b) for a, b, c, d in ends]
    length = math.fsum(parts)
    weights = [part / length for part in parts]
    x = y = xx = xy = yy = 0.0
    for w, (a, b, c, d) in zip(weights, ends):
        x += 0.5 * w * (a + c)
        y += 0.5 * w * (b + d)
    for w, (a, b, c, d) in zip(weights, ends):
        p, q, u, v = c - a, d - b, 0.5 * (a + c) - x, 0.5 * (b + d) - y
        xx += w * (p * p / 12.0 + u * u)
        xy += w * (p * q / 12.0 + u * v)
        yy += w * (q * q / 12.0 + v * v)
    return Slender(length, (x, y), (yy, -xy, xx + yy, xx))


def rod(start: FloatArray, end: FloatArray, radius: float, rgba: Sequence[float]) -> Element:
    """The ``<visual>`` of a cylinder between two points (3,)."""
    along = end - start
    length = float(np.linalg.norm(along))
    rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along / length).matrix()
    sizes = {"radius": numbers([radius]), "length": numbers([length])}
    return visual(pin.SE3(rotation, 0.5 * (start + end)), "cylinder", sizes, rgba)


def bar_visuals(
    points: Sequence[Point], layer: float, width: float, rgba: Sequence[float]
) -> tuple[Element, ...]:
    """A bar as it is drawn: rods along its outline and discs on its points.

    ``layer`` is its distance (m) from the plane, ``width`` that of the rods.
    """
    rods = [
        rod(in_space(points[i], layer), in_space(points[j], layer), 0.4 * width, rgba)
        for i, j in outline(points)
    ]
    half = 0.5 * width
    discs = [
        rod(in_space(p, layer - half), in_space(p, layer + half), 0.7 * width, rgba) for p in points
    ]
    return (*rods, *discs)


def pin_visual(point: Point, layers: Sequence[float], width: float) -> Element:
    """The bolt through the bars in ``layers`` (m) at a point."""
    first, last = min(layers) - 0.7 * width, max(layers) + 0.7 * width
    return rod(in_space(point, first), in_space(point, last), 0.3 * width, DARK)


def block(point: Point, angle: float, layer: float, width: float) -> Element:
    """The sliding block at a point, turned by ``angle`` (rad)."""
    rotation = pin.rpy.rpyToMatrix(0.0, -angle, 0.0)
    sizes = {"size": numbers([3.0 * width, width, 2.0 * width])}
    return visual(pin.SE3(rotation, in_space(point, layer)), "box", sizes, DARK)
