"""The drawing of a planar linkage: its points and bars in one pose, checked and in SI units."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from itertools import combinations, pairwise
from typing import Any, NamedTuple, Self

from srm_mbs.errors import InputError, counted, known_names, naming
from srm_mbs.formats.files import check_name
from srm_mbs.formats.graph.joint_graph import ROOT_JOINT
from srm_mbs.formats.planar.shapes import (
    Point,
    difference,
    direction_angle,
    fitted,
    own_axes,
    turned,
)
from srm_mbs.formats.toml.schema import LENGTH_UNITS, PlanarBar, PlanarEntry, PlanarSlider
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.copies import copied
from srm_mbs.model.lazy import cached_property

RESERVED = (WORLD, "universe", ROOT_JOINT)
"""Names of the ground, of Pinocchio's first frame, and of the joint of a base."""
MOST_PARTS = 2000
"""Points, bars and sliders of a linkage: the analysis of larger ones takes minutes."""
SIZES = (1e-9, 1e9)
"""Sizes of a drawing (m), and lengths over the size; others are of another unit, or a mistake."""
KEPT_NAMES = 64
"""Linkages whose names are known to be good: variants of a linkage have the same."""
COINCIDENT = 1e-9
"""Distance of two points, over the size of the drawing, at which they are the same."""


def fault(element: str, problem: str, remedy: str) -> InputError:
    """The error about one element of the drawing."""
    return InputError(problem, element=element, remedy=remedy)


@lru_cache(maxsize=KEPT_NAMES)
def _check_names(points: tuple[str, ...], parts: tuple[tuple[str, str], ...]) -> None:
    """Refuse names of points, and of parts with their kinds, that cannot be, and too many."""
    known: set[str] = set()
    for kind, name in (*(("point", name) for name in points), *parts):
        element = f"{kind} {name!r}"
        check_name(name, kind)
        if not name or ":" in name:
            raise fault(element, "a name has characters, and no colon", "Give another name")
        if name in RESERVED:
            raise fault(element, f"the name {name!r} is reserved", "Rename it")
        if kind == "point":
            continue
        if name in known:
            raise fault(element, "the name is used twice", "Give every part its own name")
        known.add(name)
    if len(points) + len(parts) > MOST_PARTS:
        raise fault(
            "planar",
            f"the linkage has more than {MOST_PARTS} points, bars and sliders",
            "Give fewer",
        )


class Change(NamedTuple):
    """All that some numbers of a drawing change, whatever they are.

    Attributes
    ----------
    points
        Names of the points that may move.
    bodies
        The bars and sliders whose shape or frame may change.
    masses
        Those whose mass or inertia may change otherwise.
    """

    points: frozenset[str]
    bodies: frozenset[str]
    masses: frozenset[str]

    def reaches(self, body: str, point: str) -> bool:
        """Whether a point may be elsewhere in a body."""
        return body in self.bodies or point in self.points


class Drawing:
    """The points of a linkage, and where the bodies that they lie on have them.

    Parameters
    ----------
    entry
        The section ``[planar]``.

    Attributes
    ----------
    unit, angle
        Factors to m and rad.
    points
        Positions in m as drawn, by name.
    bars, sliders
        By name.
    order
        Names of the points of each bar, from that at which it begins.
    ground
        Names of the points on the ground.
    bodies
        Names of the ground, the bars and the sliders that have mass, in this order.

    Raises
    ------
    InputError
        Naming the point, bar or slider that cannot be.
    """

    def __init__(self, entry: PlanarEntry) -> None:
        self.unit = LENGTH_UNITS[entry.unit]
        self.angle = math.radians(1.0) if entry.angle == "deg" else 1.0
        self._draw(entry)
        self.ground = tuple(entry.ground)
        self._check_names()
        self._known_nearest: dict[frozenset[str], float] = {}
        """Results of :meth:`_nearest`."""
        self.order: dict[str, list[str]] = {bar.name: bar.points for bar in entry.bar}
        self.bodies = (WORLD, *self.bars, *(s.name for s in entry.slider if s.mass))
        self._check_ground()
        for bar in entry.bar:
            self._check_bar(bar)
        for slider in entry.slider:
            self.point(slider.point, f"slider {slider.name!r}")
        for slider in entry.slider:
            self._check_slider(slider)
        self._check_use()
        self._check_lengths()
        self._shapes = {name: self._shape(name) for name in self.bars}

    def _draw(self, entry: PlanarEntry) -> None:
        """Take the numbers of ``entry``."""
        self.entry, unit = entry, self.unit
        self.points: dict[str, Point] = {
            name: (unit * x, unit * y) for name, (x, y) in entry.points.items()
        }
        self.bars: dict[str, PlanarBar] = {bar.name: bar for bar in entry.bar}
        self.sliders: dict[str, PlanarSlider] = {each.name: each for each in entry.slider}
        sides = [max(side) - min(side) for side in zip(*self.points.values())]
        self.size = math.sqrt(sum(side * side for side in sides))
        """Diagonal (m) of the drawing."""

    def varied(self, entry: PlanarEntry, change: Change) -> Self | None:
        """The drawing with the numbers of ``entry``, in which nothing but what ``change`` allows
        differs; None where a check may refuse it, or where bodies gain or lose their mass."""
        out = copied(self)
        out._draw(entry)
        if not SIZES[0] <= out.size <= SIZES[1] or not out._is_plain(self, change):
            return None
        out._shapes = self._shapes | {
            name: out._shape(name) for name in self.bars if name in change.bodies
        }
        return out

    def _is_plain(self, other: Drawing, change: Change) -> bool:
        """Whether no check refuses this drawing, another one of which was checked."""
        if any(
            bool(own.mass) != bool(other.sliders[name].mass) for name, own in self.sliders.items()
        ):
            return False
        limit = COINCIDENT * self.size
        if other._nearest(change.bodies) <= limit:
            return False
        for name in self.bars:
            if name in change.bodies:
                pairs = combinations(self.bars[name].points, 2)
                if min(self._apart(a, b) for a, b in pairs) <= limit:
                    return False
        try:
            for bar in self.bars.values():
                if bar.length is not None:
                    self._check_bar(bar)
            self._check_lengths()
            for slider in self.sliders.values():
                self.direction(slider)
        except InputError:
            return False
        return True

    def _nearest(self, others: frozenset[str]) -> float:
        """Least distance (m) of two points of a bar that is none of ``others``."""
        if others not in self._known_nearest:
            self._known_nearest[others] = min(
                (
                    self._apart(a, b)
                    for name, bar in self.bars.items()
                    if name not in others
                    for a, b in combinations(bar.points, 2)
                ),
                default=math.inf,
            )
        return self._known_nearest[others]

    # -- checks ------------------------------------------------------------------------------

    def _check_names(self) -> None:
        named = [("bar", bar.name) for bar in self.entry.bar]
        named += [("slider", slider.name) for slider in self.entry.slider]
        _check_names(tuple(self.points), tuple(named))
        if self.points and not SIZES[0] <= self.size <= SIZES[1]:
            raise fault(
                "points", f"the drawing measures {self.size:g} m", "Correct the points, or the unit"
            )
        if not named:
            raise fault("planar", "the linkage has no bar", "Give bars, each with its points")

    def point(self, name: str, element: str) -> Point:
        """Position of a point in m as drawn; errors are about ``element``."""
        if name not in self.points:
            raise fault(element, f"there is no point {name!r}", known_names(self.points))
        return self.points[name]

    def _check_ground(self) -> None:
        if not self.ground and all(slider.on for slider in self.entry.slider):
            raise fault("ground", "no point is on the ground", "Name the points that stay in place")
        for name in self.ground:
            self.point(name, "ground")
            if self.ground.count(name) > 1:
                raise fault("ground", f"point {name!r} is named twice", "Name it once")

    def _check_bar(self, bar: PlanarBar) -> None:
        element = f"bar {bar.name!r}"
        if len(bar.points) < 2:
            found = counted(len(bar.points), "point")
            raise fault(element, f"it has {found}", "Give two points or more")
        for name in bar.points:
            self.point(name, element)
            if bar.points.count(name) > 1:
                raise fault(element, f"point {name!r} is named twice", "Name it once")
        for a, b in combinations(bar.points, 2):
            if self._apart(a, b) <= COINCIDENT * self.size:
                raise fault(
                    element, f"the points {a!r} and {b!r} coincide", "Move one of them, or use one"
                )
        fixed = [name for name in bar.points if name in self.ground]
        if len(fixed) > 1:
            names = " and ".join(map(repr, fixed))
            raise fault(
                element,
                f"its points {names} are on the ground: it cannot move",
                "Remove the bar, or one of the points from ground",
            )
        given = (bar.mass, bar.mass_per_length, self.entry.mass_per_length)
        mass = next((number for number in given if number is not None), None)
        if mass is None:
            raise fault(element, "it has no mass", "Give mass_per_length (kg/m), or its mass (kg)")
        if bar.inertia and not mass:
            raise fault(element, "it has a moment of inertia without mass", "Give its mass (kg)")
        if bar.mass is not None and bar.mass_per_length is not None:
            raise fault(element, "mass and mass_per_length are given", "Give one of them")
        if bar.length is not None and not (
            SIZES[0] * self.size <= self.unit * bar.length <= SIZES[1] * self.size
        ):
            raise fault(
                element, f"the length {bar.length:g} does not fit the drawing", "Correct it"
            )
        if bar.length is not None and len(bar.points) != 2:
            raise fault(
                element,
                f"one length does not determine a bar of {len(bar.points)} points",
                'Give the lengths between pairs of its points: lengths={("A", "B"): ...} in '
                "Python, [[planar.length]] in TOML",
            )

    def _check_slider(self, slider: PlanarSlider) -> None:
        element = f"slider {slider.name!r}"
        if slider.on and slider.on not in self.bars:
            raise fault(element, f"there is no bar {slider.on!r}", known_names(self.bars))
        on = self.bars[slider.on].points if slider.on else self.ground
        if slider.point in on:
            where = f"bar {slider.on!r}" if slider.on else "the ground"
            raise fault(
                element,
                f"its point {slider.point!r} is fixed on {where}, on which it slides",
                "Let it slide on another bar, or give it another point",
            )
        others = [name for name in self.carriers(slider.point) if name != slider.name]
        if not others and not slider.mass:
            raise fault(
                element,
                f"nothing moves with it: no bar has the point {slider.point!r}",
                "Give it a mass, or a bar with this point",
            )
        self.direction(slider)

    def _check_use(self) -> None:
        used = {name for bar in self.entry.bar for name in bar.points}
        used |= {slider.point for slider in self.entry.slider}
        used |= {name for spring in self.entry.spring for name in (spring.a, spring.b)}
        for name in self.points:
            if name not in used:
                raise fault(
                    f"point {name!r}", "nothing uses it", "Give it to a bar, or remove the point"
                )

    # -- geometry ----------------------------------------------------------------------------

    def _apart(self, a: str, b: str) -> float:
        """Distance (m) of two points as drawn."""
        return math.dist(self.points[a], self.points[b])

    def carriers(self, point: str) -> list[str]:
        """The bodies that have a point: the ground, bars, and sliders with mass."""
        return list(self._carriers[point])

    @property
    def carried(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """All points, and the bodies that have each."""
        return tuple((point, tuple(bodies)) for point, bodies in self._carriers.items())

    @cached_property
    def _carriers(self) -> dict[str, list[str]]:
        found: dict[str, list[str]] = {name: [] for name in self.points}
        for name in self.ground:
            found[name].append(WORLD)
        for bar in self.entry.bar:
            for name in bar.points:
                found[name].append(bar.name)
        for slider in self.entry.slider:
            if slider.mass:
                found[slider.point].append(slider.name)
        return found

    def coinciding(self) -> list[tuple[str, str]]:
        """Pairs of different points at one place of the drawing."""
        order = sorted(self.points, key=self.points.__getitem__)
        return [(a, b) for a, b in pairwise(order) if self._apart(a, b) <= COINCIDENT * self.size]

    def direction(self, slider: PlanarSlider) -> float:
        """Angle (rad) of the line of a slider against x as drawn."""
        element = f"slider {slider.name!r}"
        along: Any = slider.along
        if not isinstance(along, list):
            return self.angle * float(along)
        if all(isinstance(part, str) for part in along):
            vector = difference(self.point(along[1], element), self.point(along[0], element))
        else:
            vector = along[0], along[1]
        if not any(vector):
            raise fault(element, "its line has no direction", "Give a direction that is not zero")
        return direction_angle(vector)

    def begin(self, bar: str, point: str) -> None:
        """Let a bar begin at one of its points."""
        points = self.order[bar]
        if points[0] != point:
            self.order[bar] = [point, *(name for name in points if name != point)]
            self._shapes[bar] = self._shape(bar)

    def body_angle(self, body: str) -> float:
        """Angle (rad) of the x axis of a body as drawn: of a bar, from the first to the second of
        its points; of a slider, that of the bar on which it slides."""
        if body in self.order:
            first, second, *_ = self.order[body]
            return direction_angle(difference(self.points[second], self.points[first]))
        on = self.sliders[body].on if body in self.sliders else ""
        return self.body_angle(on) if on else 0.0

    def _lengths(self, bar: str) -> dict[tuple[int, int], float]:
        """The given lengths (m) between points of a bar, by their indices in its order."""
        length, points = self.bars[bar].length, self.order[bar]
        out = {} if length is None else {(0, 1): self.unit * length}
        for each in self.entry.length:
            if set(each.between) <= set(points):
                i, j = sorted(map(points.index, each.between))
                out[i, j] = self.unit * each.length
        return out

    def _shape(self, bar: str) -> list[Point]:
        """The points of a bar in its own axes."""
        given, points = self._lengths(bar), self.order[bar]
        if len(points) == 2:
            return [(0.0, 0.0), (given.get((0, 1), self._apart(*points)), 0.0)]
        drawn = [self.points[name] for name in points]
        if given:
            with naming(element=f"bar {bar!r}"):
                drawn = fitted(drawn, given)
        return own_axes(drawn)

    def _check_lengths(self) -> None:
        """Refuse lengths between points that no bar has, and of another order than the drawing."""
        for each in self.entry.length:
            element = f"length {each.between[0]!r} to {each.between[1]!r}"
            for name in each.between:
                self.point(name, element)
            if each.between[0] == each.between[1]:
                raise fault(element, "the two points are one", "Give two points of a bar")
            if not SIZES[0] * self.size <= self.unit * each.length <= SIZES[1] * self.size:
                raise fault(
                    element, f"{each.length:g} does not fit the drawing", "Correct the length"
                )
            if not any(set(each.between) <= set(bar.points) for bar in self.entry.bar):
                raise fault(element, "no bar has both points", "Give two points of one bar")

    def shape(self, bar: str) -> list[Point]:
        """The points of a bar in its own axes (m), in its order."""
        return self._shapes[bar]

    def on_body(self, body: str, at: Point, point: str = "") -> Point:
        """A place of the drawing, that of the point if it is one of a bar, in axes of a body whose
        origin is the ground's, the first point of a bar, or the point of a slider."""
        if body in self.order:
            points = self.order[body]
            if point in points:
                return self._shapes[body][points.index(point)]
            return turned(difference(at, self.points[points[0]]), -self.body_angle(body))
        if body in self.sliders:
            origin = self.points[self.sliders[body].point]
            return turned(difference(at, origin), -self.body_angle(body))
        return at


def listed(names: Iterable[str]) -> str:
    """Names in a message."""
    return ", ".join(map(repr, names))
