"""Positions of a mechanism at several times in one picture, seen along one direction.

The classical figure of a linkage: each body is a bar, or a plate if it has three points or more,
between its joints, the anchors of closures, and the chosen points of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

from srm_mbs._kernel.workspace import workspace
from srm_mbs.dynamics.constraints.wrenches import Placements
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import is_angle
from srm_mbs.errors import InputError, known_names, safe_repr
from srm_mbs.integration.dense_output import checked_time
from srm_mbs.model.anchors import Anchor, one_degree_joint
from srm_mbs.model.numbers import finite_array
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.animation.shapes import bar_ends, rods
from srm_mbs.visualization.plotting.figure import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    TICK_STEPS,
    VERMILION,
    WIDTH,
    draw_line,
    finish,
    finite,
    legend,
    linear_axis,
    plain,
    prepare,
)
from srm_mbs.visualization.plotting.path import Places, moving_points
from srm_mbs.visualization.plotting.sampling import read_smoothly

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from srm_mbs._typing import FloatArray

COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY)
"""Colours of the bodies, in the order of the joints; they repeat."""
PATHS: tuple[tuple[str, Any], ...] = ((VERMILION, "-"), (BLACK, (0, (4, 1.5))), (GREY, "-"))
"""Colours and dashes of the paths; they repeat."""
DEFAULT_POSES = 6
"""Number of positions, evenly spaced over the run, where no times are given."""
MAX_POSES = 200
"""Most positions: more cannot be distinguished."""
PALEST = 0.25
"""Strength of the colour of the oldest position; that of the newest is 1."""
PLATE = 0.2
"""Strength of the colour of a plate over that of its edge."""
LOOKS = {"x": (-1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, -1.0)}
"""Directions of view along the axes of the world: from the right, from the front, from above."""
PARALLEL = 1e-6
"""Sine of the angle below which two directions are parallel."""
SHORTEST_BAR = 1e-6
"""Length of a bar over the largest one, below which it is a point."""
HEIGHTS = (2.4, 8.0)
"""Smallest and largest height (inch) of the figure."""
MARGIN = 0.08
"""Room around the mechanism, over its size."""
TIME_TOLERANCE = 1e-13
"""Tolerance of the time at which the crank has an angle, over the span of the run."""
UNITS = {"m": 1.0, "mm": 1e3}


@dataclass(frozen=True)
class _Picture:
    """The plane of a picture: its axes in the world, (2, 3), right and up, and the unit."""

    axes: FloatArray
    factor: float

    def of(self, points: FloatArray) -> FloatArray:
        """Coordinates (..., 2) in the unit of points (..., 3) m of the world."""
        return np.asarray(self.factor * (points @ self.axes.T))


def draw_poses(
    solution: SimulationResult,
    at: Sequence[float] | None = None,
    crank: str | None = None,
    points: Sequence[Anchor | str] | None = None,
    view: Any = None,
    unit: str = "m",
) -> Figure:
    """The mechanism at several times, older positions paler, with the paths of points.

    Parameters
    ----------
    at
        Times (s) in the run; with ``crank`` its positions, in degrees or m, each where the joint
        has it first.  By default six times, evenly spaced.
    crank
        Name of a joint of one degree of freedom.
    points
        Points whose paths over the whole run are drawn: anchors, or names of points of the
        mechanism.
    view
        Direction of view: ``"x"``, ``"y"``, ``"z"`` (normal to the picture) or a vector (3,) in the
        world; by default the normal of the plane of motion, or ``"y"`` if there is none.
    unit
        Of the axes, ``"m"`` or ``"mm"``.

    Raises
    ------
    InputError
        If a time lies outside the run, the crank has not the position, a point does not exist or
        lies on the ground, or an option has no such value.
    """
    mechanism = solution.mechanism
    if unit not in UNITS:
        raise InputError(
            f"lengths are not drawn in {safe_repr(unit)}", element="unit", remedy=known_names(UNITS)
        )
    places = {} if points is None else moving_points(mechanism, points)
    look = (plane_normal(mechanism) if view is None else _direction(view)) or LOOKS["y"]
    picture = _Picture(_axes_of(np.array(look)), UNITS[unit])
    times = _times(solution, at, crank)
    poses = solution.at(times)
    figure = Figure(figsize=(WIDTH, 5.0), layout="constrained")
    axes = figure.subplots()
    prepare(axes, "both")
    drawn = [np.zeros((1, 2))]
    for k, t in enumerate(poses.t):
        strength = 1.0 - (1.0 - PALEST) * (1.0 - (k + 1) / len(times))
        drawn.append(_draw_pose(axes, _active(solution, t), poses.q[k], picture, places, strength))
    run = read_smoothly(solution) if places else poses
    paths = _positions(run, places, picture)
    for (name, path), (colour, dashes) in zip(paths.items(), cycle(PATHS)):
        style: dict[str, Any] = {"color": colour, "linestyle": dashes, "linewidth": 1.1}
        draw_line(axes, path[:, 0], path[:, 1], label=plain(f"path of {name}"), zorder=3.1, **style)
        drawn.append(path)
    _frame(figure, axes, np.concatenate(drawn[1:]), picture, unit)
    legend(axes, beside=False)
    finish(figure, solution, [_note(solution, times, at, crank)])
    return figure


def plane_normal(mechanism: Mechanism) -> tuple[float, ...] | None:
    """Normal (3,) of the plane of motion in the world, None if the joints leave every plane.

    Hinges have their axes along it, slides across it; without hinges, two slides give it.
    """
    model = mechanism.model
    data = workspace(model)
    # Pinocchio returns a single column as a vector.
    columns = pin.computeJointJacobians(model, data, np.array(mechanism.q0)).reshape(6, model.nv)
    turns, slides = [], []
    for joint in range(1, model.njoints):
        first, count = model.joints[joint].idx_v, model.joints[joint].nv
        # Columns of spatial velocities about the origin of the world.
        for linear, angular in (
            np.split(column, 2) for column in columns[:, first : first + count].T
        ):
            if np.any(angular):
                turns.append(angular)
            else:
                slides.append(linear)
    if not turns:
        normals = [np.cross(slides[0], slide) for slide in slides]
        turns = [normal for normal in normals if np.linalg.norm(normal) > PARALLEL]
    if not turns:
        return None
    normal = turns[0] / np.linalg.norm(turns[0])
    flat = all(np.linalg.norm(np.cross(normal, t)) <= PARALLEL * np.linalg.norm(t) for t in turns)
    if not flat or any(abs(normal @ s) > PARALLEL * np.linalg.norm(s) for s in slides):
        return None
    # Of the two sides, that of the views along the axes of the world.
    sides = normal @ np.sum(list(LOOKS.values()), axis=0)
    return tuple((normal if sides >= 0.0 else -normal).tolist())


def _direction(view: Any) -> tuple[float, ...]:
    if isinstance(view, str) and view in LOOKS:
        return LOOKS[view]
    numbers = finite_array(view, (3,))
    if numbers is None or not np.linalg.norm(numbers) > 0.0:
        raise InputError(
            f"{safe_repr(view)} is not a direction of view",
            element="view",
            remedy='Give "x", "y", "z" or a vector, for example (1.0, 1.0, -0.5)',
        )
    return tuple((numbers / np.linalg.norm(numbers)).tolist())


def _axes_of(look: FloatArray) -> FloatArray:
    """Axes (2, 3) to the right and up of a picture seen along ``look`` (3,); z is up, or else y."""
    above = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(look, above)) <= PARALLEL:
        above = np.array([0.0, 1.0, 0.0])
    right = np.cross(look, above)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(right, look)])


def _times(solution: SimulationResult, at: Any, crank: str | None) -> FloatArray:
    """Increasing times (s) of the positions."""
    start, end = solution.span
    if at is None:
        if crank is not None:
            raise InputError(
                "its positions are not given", element="crank", remedy="Give for example at=[0, 90]"
            )
        return np.unique(np.linspace(start, end, DEFAULT_POSES))
    given = finite_array(at, (len(at),)) if isinstance(at, (Sequence, np.ndarray)) else None
    if given is None or not 0 < len(given) <= MAX_POSES:
        raise InputError(
            f"{safe_repr(at)} is not a list of 1 to {MAX_POSES} numbers",
            element="at",
            remedy="Give for example at=[0.0, 0.1, 0.2]",
        )
    if crank is not None:
        return np.unique(_times_of(solution, crank, given))
    return np.unique([checked_time(t, start, end, "at") for t in given])


def _times_of(solution: SimulationResult, crank: str, values: FloatArray) -> FloatArray:
    """First times (s) at which the ``crank`` has the ``values`` (n,), degrees (modulo 360) or m."""
    model = solution.mechanism.model
    one_degree_joint(model, crank, "crank", "Give a joint of one degree of freedom")
    turning = is_angle(model, crank)
    run = read_smoothly(solution)

    def errors(positions: FloatArray, wanted: float) -> FloatArray:
        if not turning:
            return np.asarray(positions - wanted)
        return np.asarray(np.remainder(positions - wanted + np.pi, 2.0 * np.pi) - np.pi)

    times = []
    for value in values:
        wanted = float(np.radians(value)) if turning else float(value)
        known = errors(run.joint(crank)[0], wanted)
        # A jump from half a turn to minus half a turn is no root.
        root = (known[:-1] * known[1:] <= 0.0) & (np.abs(np.diff(known)) < np.pi)
        if len(known) == 1:
            root = known == 0.0
        if not root.any():
            unit = "degrees" if turning else "m"
            raise InputError(
                f"joint {crank!r} is not at {value:g} {unit} during the run",
                element="at",
                remedy="Give positions that it passes",
            )
        first = int(np.argmax(root))
        low, high = run.t[first], run.t[min(first + 1, len(known) - 1)]
        sign = np.sign(known[first])
        while sign and high - low > TIME_TOLERANCE * max(abs(high), high - run.t[0]):
            middle = 0.5 * (low + high)
            if middle in (low, high):
                break
            error = errors(solution.at([middle]).joint(crank)[0], wanted)[0]
            low, high = (middle, high) if np.sign(error) == sign else (low, middle)
        times.append(high if sign else low)
    return np.array(times)


def _active(solution: SimulationResult, t: float) -> Mechanism:
    """The mechanism of the segment at ``t`` (s): events add and remove closures."""
    before = [segment.mechanism for segment in solution.segments if segment.span[0] <= t]
    return before[-1] if before else solution.mechanism


def _positions(run: SimulationResult, places: Places, picture: _Picture) -> dict[str, FloatArray]:
    model = run.mechanism.model
    placed = Placements.at(model, workspace(model), run.q)
    return {name: picture.of(placed.of(*place)[1]) for name, place in places.items()}


def _draw_pose(
    axes: Axes,
    mechanism: Mechanism,
    q: FloatArray,
    picture: _Picture,
    places: Places,
    strength: float,
) -> FloatArray:
    """Draw one position, and return its points (n, 2)."""
    model = mechanism.model
    placed = Placements.at(model, workspace(model), q[None])
    ends, masses = bar_ends(mechanism, mechanism.loops)
    chosen: dict[int, list[FloatArray]] = {}
    for joint, inside in places.values():
        chosen.setdefault(joint, []).append(inside.translation)
    corners: list[FloatArray] = []
    for joint in range(model.njoints):
        own = [*ends[joint], *chosen.get(joint, ())]
        if joint == 0:  # a floating body has no pivot in the ground
            free = [model.jointPlacements[k].translation for k in _floating(model)]
            own = [end for end in own if not any(np.array_equal(end, other) for other in free)]
        local = np.array(own if joint == 0 else [np.zeros(3), *own]).reshape(-1, 3)
        world = placed.origin[0, joint] + local @ placed.rotation[0, joint].T
        seen = finite(picture.of(world))
        corners.append(seen)
        if joint == 0:
            axes.plot(seen[:, 0], seen[:, 1], **GROUND)
            continue
        colour = _pale(COLOURS[(joint - 1) % len(COLOURS)], strength)
        outline = _hull(seen)
        # Plates below all bars and paths, which they would hide.
        fill: dict[str, Any] = {"facecolor": _pale(colour, PLATE), "linewidth": 0.0}
        edge: dict[str, Any] = {
            "facecolor": "none",
            "edgecolor": colour,
            "linewidth": 1.8,
            "joinstyle": "round",
        }
        axes.add_patch(Polygon(outline, closed=True, zorder=1.0 + 0.4 * strength, **fill))
        axes.add_patch(Polygon(outline, closed=True, zorder=2.0 + strength, **edge))
        ink = _pale(BLACK, strength)
        pins = seen[: 1 + len(ends[joint])]
        if joint in masses:
            pins = pins[:1]
            axes.plot(*seen[1:2].T, marker="o", color=colour, markersize=6.0, zorder=2.1 + strength)
        pin_style: dict[str, Any] = {"color": ink, "marker": "o", "markersize": 3.6}
        pin_style |= {"markerfacecolor": "white", "markeredgewidth": 0.9, "linestyle": "none"}
        axes.plot(pins[:, 0], pins[:, 1], zorder=2.2 + strength, **pin_style)
        tips = seen[1 + len(ends[joint]) :]
        if len(tips):
            dot: dict[str, Any] = {
                "marker": "o",
                "linestyle": "none",
                "markersize": 3.2,
                "zorder": 2.3 + strength,
            }
            axes.plot(*tips.T, color=_pale(VERMILION, strength), **dot)
    for rod in rods(mechanism):
        sides = rod.resolve(model)
        world = np.array(
            [
                placed.origin[0, joint] + placed.rotation[0, joint] @ inside.translation
                for joint, inside in sides
            ]
        )
        line = finite(picture.of(world))
        axes.plot(*line.T, color=_pale(GREY, strength), linewidth=1.2, zorder=2.0 + strength)
    return np.concatenate(corners)


GROUND: dict[str, Any] = {
    **{"marker": "s", "linestyle": "none", "color": GREY, "markersize": 8.0, "zorder": 1.8},
}
"""Marks of the points of the ground."""


def _floating(model: pin.Model) -> list[int]:
    """Joints that leave a body of the tree's root free in space."""
    roots = (joint for joint in range(1, model.njoints) if model.parents[joint] == 0)
    return [joint for joint in roots if model.joints[joint].nv == 6]


def _pale(colour: Any, strength: float) -> tuple[float, float, float]:
    """A colour mixed with white: without transparency, crossing bars keep their colours."""
    red, green, blue = (1.0 - strength * (1.0 - part) for part in to_rgb(colour))
    return red, green, blue


def _hull(points: FloatArray) -> FloatArray:
    """Corners (k, 2) of the convex hull of points (n, 2) in order, or the ends of their line."""
    if not np.isfinite(points).all():
        return points[:1]
    size = float(np.ptp(points, axis=0).max())
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
    sides = []
    for half in (ordered, ordered[::-1]):
        side: list[FloatArray] = []
        for point in half:
            while len(side) > 1:
                first, second = side[-1] - side[-2], point - side[-2]
                if first[0] * second[1] - first[1] * second[0] > SHORTEST_BAR * size * size:
                    break
                side.pop()
            side.append(point)
        sides.append(side[:-1])
    return np.array([*sides[0], *sides[1]]) if sides[0] else points[:1]


def _frame(figure: Figure, axes: Axes, drawn: FloatArray, picture: _Picture, unit: str) -> None:
    """Equal axes around the ``drawn`` points (n, 2), labels, and the height of the figure."""
    known = drawn[np.isfinite(drawn).all(axis=1)]
    known = known if len(known) else np.zeros((1, 2))
    low, high = known.min(axis=0), known.max(axis=0)
    extent = float((high - low).max()) or 1.0
    low, high = low - MARGIN * extent, high + MARGIN * extent
    for axis, direction, a, b in zip("xy", picture.axes, low, high):
        name = _axis_name(direction)
        linear_axis(axes, [np.array([1.0])], f"{name} ", unit, axis=axis)
        axes.set(**{f"{axis}lim": (a, b)})
    axes.set_aspect("equal", adjustable="box")
    for own in (axes.xaxis, axes.yaxis):
        own.set_major_locator(MaxNLocator(6, steps=TICK_STEPS))
    wide, tall = high - low
    figure.set_size_inches(WIDTH, float(np.clip(1.2 + 0.85 * WIDTH * tall / wide, *HEIGHTS)))


def _axis_name(direction: FloatArray) -> str:
    for k, name in enumerate("xyz"):
        if abs(direction[k]) >= 1.0 - PARALLEL:
            return name if direction[k] > 0.0 else f"-{name}"
    return "along ({:.2g}, {:.2g}, {:.2g})".format(*(direction + 0.0))


def _note(solution: SimulationResult, times: FloatArray, at: Any, crank: str | None) -> str:
    if crank is not None:
        unit = "degrees" if is_angle(solution.mechanism.model, crank) else "m"
        values = ", ".join(f"{float(value):g}" for value in at)  # texts on the command line
        return f"Positions where {crank} is at {values} {unit}; earlier ones are paler."
    values = ", ".join(f"{t:.4g}" for t in times)
    return f"Positions at t = {values} s; earlier ones are paler."
