"""Planar linkages of one degree of freedom by closed formulas: circles that meet, and Lagrange's
equation of the crank.  Nothing is shared with the package.

Points are complex numbers x + j y in a way that formulas stay analytic: they are arrays (2,), whose
components may be complex, so that derivatives are those of the complex step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

Point = np.ndarray
Points = Mapping[str, Point]
STEP = 1e-30
"""Of the complex step, which has no cancellation."""
G = 9.81


def point(x: complex, y: complex) -> Point:
    return np.array([x, y])


def length(a: Point, b: Point) -> complex:
    """Analytic, unlike ``np.linalg.norm``."""
    d = b - a
    return complex(np.sqrt(d[0] * d[0] + d[1] * d[1]))


def polar(centre: Point, radius: float, angle: complex) -> Point:
    return centre + radius * point(np.cos(angle), np.sin(angle))


def meeting(a: Point, from_a: float, b: Point, from_b: float, left: bool) -> Point:
    """The point at given distances from a and b, to the left of the way from a to b or not."""
    d = length(a, b)
    along = (d * d + from_a**2 - from_b**2) / (2.0 * d)
    across = np.sqrt(from_a**2 - along * along)
    u = (b - a) / d
    return a + along * u + (across if left else -across) * point(-u[1], u[0])


def is_left(a: Point, b: Point, c: Point) -> bool:
    """Whether c lies to the left of the way from a to b."""
    u, v = b - a, c - a
    return bool(u[0] * v[1] - u[1] * v[0] > 0.0)


def carried(a: Point, b: Point, drawn: Sequence[Point]) -> Point:
    """The third of the ``drawn`` points of a plate, whose first two are at a and b."""
    first, second, third = drawn
    u, w = second - first, third - first
    size = float(u @ u)
    x, y = (u @ w) / size, (u[0] * w[1] - u[1] * w[0]) / size
    d = b - a
    return a + x * d + y * point(-d[1], d[0])


@dataclass
class OneDegree:
    """Lagrange's equation of the crank angle.

    Attributes
    ----------
    places
        Crank angle (rad) to the points by name (m).
    bars
        Pairs of points with the mass (kg) of the slender bar between them.
    masses
        Point masses (kg) by point.
    flywheel
        Moment of inertia on the crank (kg m^2).
    springs
        Pairs of points with stiffness (N/m), damping (N s/m) and rest length (m).
    """

    places: Callable[[complex], Points]
    bars: Mapping[tuple[str, str], float]
    masses: Mapping[str, float] = field(default_factory=dict)
    flywheel: float = 0.0
    springs: Mapping[tuple[str, str], tuple[float, float, float]] = field(default_factory=dict)

    def potential(self, angle: complex) -> complex:
        at = self.places(angle)
        out = sum(m * G * at[p][1] for p, m in self.masses.items())
        out += sum(m * G * 0.5 * (at[p][1] + at[q][1]) for (p, q), m in self.bars.items())
        for (p, q), (stiffness, _, rest) in self.springs.items():
            out += 0.5 * stiffness * (length(at[p], at[q]) - rest) ** 2
        return complex(out)

    def _rates(self, angle: float) -> tuple[Points, Points]:
        """The points and their derivatives by the crank angle."""
        at = self.places(angle + STEP * 1j)
        return {k: p.real for k, p in at.items()}, {k: p.imag / STEP for k, p in at.items()}

    def inertia(self, angle: float) -> float:
        """Generalised inertia (kg m^2): twice the kinetic energy at unit rate."""
        at, rates = self._rates(angle)
        out = self.flywheel + sum(m * rates[p] @ rates[p] for p, m in self.masses.items())
        for (p, q), m in self.bars.items():
            middle, d, w = 0.5 * (rates[p] + rates[q]), at[q] - at[p], rates[q] - rates[p]
            turning = (d[0] * w[1] - d[1] * w[0]) / (d @ d)
            out += m * (middle @ middle + turning**2 * (d @ d) / 12.0)
        return float(out)

    def inertia_slope(self, angle: float) -> float:
        """Central differences of fourth order."""
        h = 1e-3
        near = self.inertia(angle + h) - self.inertia(angle - h)
        far = self.inertia(angle + 2 * h) - self.inertia(angle - 2 * h)
        return (8.0 * near - far) / (12.0 * h)

    def damping(self, angle: float) -> float:
        """Generalised damping (N m s)."""
        at, rates = self._rates(angle)
        out = 0.0
        for (p, q), (_, damping, _) in self.springs.items():
            d = at[q] - at[p]
            out += damping * float(d @ (rates[q] - rates[p])) ** 2 / float(d @ d)
        return out

    def torque(self, angle: float, rate: float, acceleration: float) -> float:
        """The torque on the crank that the motion needs (N m)."""
        weight = self.potential(angle + STEP * 1j).imag / STEP
        gyroscopic = 0.5 * self.inertia_slope(angle) * rate**2
        return self.inertia(angle) * acceleration + gyroscopic + weight + self.damping(angle) * rate

    def __call__(self, t: float, state: np.ndarray) -> list[float]:
        angle, rate = map(float, state)
        return [rate, -self.torque(angle, rate, 0.0) / self.inertia(angle)]
