"""Paths of points in space, in their plane or in three projections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from srm_mbs._kernel.workspace import workspace
from srm_mbs.dynamics.constraints.wrenches import Placements
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.point_motion import Place, given_point, point_name
from srm_mbs.dynamics.scaling import coordinate_units
from srm_mbs.errors import InputError
from srm_mbs.model.anchors import Anchor, resolve_moving
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.plotting.figure import (
    FONT_SIZE,
    LINES,
    TICK_STEPS,
    WIDTH,
    finish,
    legend,
    line_styles,
    linear_axis,
    marks,
    plain,
    prepare,
    some_of,
)
from srm_mbs.visualization.plotting.sampling import read_smoothly

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from srm_mbs._typing import BoolArray, FloatArray

FLATNESS_TOLERANCE = 1e-6
"""Extent of a coordinate, over the largest one, below which it is constant."""
SMALLEST_PATH = 1e-6
"""Extent of a path, over the size of the mechanism, below which a point does not move."""
HEIGHTS = (2.4, 6.0)
"""Smallest and largest height (inch) of a figure in a plane."""
AXES = "xyz"
VIEWS = ((0, 2, "from the front"), (1, 2, "from the right"), (0, 1, "from above"))
Places = dict[str, Place]
"""Points by name."""


def moving_points(mechanism: Mechanism, points: Sequence[Anchor | str]) -> Places:
    """The places of ``points`` of links that move, by the names that plots show.

    Raises
    ------
    InputError
        If one of them does not exist or lies on the ground, or there are none.
    """
    given: Any = points
    if isinstance(points, Sequence) and not isinstance(points, str):
        given = [given_point(mechanism, p, "points") if isinstance(p, str) else p for p in points]
    placed = resolve_moving(mechanism.model, given, "points")
    if not placed:
        raise InputError("no points are given", element="points", remedy="Leave the option out")
    return {point_name(point): place for point, place in zip(points, placed)}


def draw_path(solution: SimulationResult, points: Sequence[Anchor | str] | None = None) -> Figure:
    """Paths of points, with equal axes, their starts and ends marked.

    One view if they lie in planes normal to an axis of the world, otherwise three views.

    Parameters
    ----------
    points
        Points of links, for example ``[srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))]``; by default the
        origins of joints and anchors of closures that move, or centres of mass if none does.

    Raises
    ------
    InputError
        If one of them does not exist or lies on the ground, or none moves.
    """
    mechanism = solution.mechanism
    run = read_smoothly(solution)
    notes: list[str] = []
    if points is None:
        places, notes = some_places(solution, run, len(LINES))
    else:
        places = moving_points(mechanism, points)
    paths = _paths(run, places)
    together = np.concatenate(list(paths.values()))
    extents = np.array([max(np.ptp(path[:, k]) for path in paths.values()) for k in range(3)])
    flat = extents <= FLATNESS_TOLERANCE * max(extents.max(), SMALLEST_PATH)
    if flat.all():
        raise InputError(
            f"none of the points moves from t = {run.t[0]:g} to {run.t[-1]:g} s",
            element="points",
            remedy="Name a point that moves, or draw a run that goes on",
        )
    figure = _in_plane(paths, flat, together) if flat.any() else _from_three_sides(paths, together)
    finish(figure, solution, notes)
    return figure


def _paths(run: SimulationResult, places: Places) -> dict[str, FloatArray]:
    """Positions (n, 3) m in the world of each point."""
    model = run.mechanism.model
    placed = Placements.at(model, workspace(model), run.q)
    return {name: placed.of(*place)[1] for name, place in places.items()}


def some_places(
    solution: SimulationResult, run: SimulationResult, most: int
) -> tuple[Places, list[str]]:
    """At most ``most`` of the places that are drawn by default, and a note on the others.

    Raises
    ------
    InputError
        If none moves.
    """
    places = default_places(solution, run)
    if not places:
        raise InputError(
            "no joint, closure or centre of mass of the mechanism moves along a path",
            element="points",
            remedy='Name points, for example points=[srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))]',
        )
    left = list(places)[most:]
    notes = [f"Left out: {some_of(left)}; points=[...], or --point, names others."] if left else []
    return {name: places[name] for name in list(places)[:most]}, notes


def default_places(solution: SimulationResult, run: SimulationResult) -> Places:
    """The origins of joints and the anchors of closures that move, or else centres of mass; none
    where nothing moves along a path."""
    mechanism = solution.mechanism
    model = mechanism.model
    places: Places = {
        name: (model.getJointId(name), pin.SE3.Identity()) for name in mechanism.joint_names
    }
    for segment in solution.segments:
        for loop in segment.mechanism.loops:
            ends = loop.resolve(model) if loop.anchors else ()
            for joint, placement in ends[:1] if ends and ends[0][0] else ends[1:]:
                places.setdefault(f"closure {loop.name}", (joint, placement))
    size = coordinate_units(mechanism, mechanism.q0, mechanism.v0).length
    found = _different(run, places, SMALLEST_PATH * size)
    if found:
        return found
    # One rotating body, or several about one point.
    centres = {}
    for name in mechanism.joint_names:
        inertia = model.inertias[model.getJointId(name)]
        if inertia.mass > 0.0:
            place = (model.getJointId(name), pin.SE3(np.eye(3), inertia.lever))
            centres[f"centre of mass of the body at {name}"] = place
    return _different(run, centres, SMALLEST_PATH * size)


def _different(run: SimulationResult, places: Places, least: float) -> Places:
    """The ``places`` whose path has an extent above ``least`` (m), each point once."""
    found: dict[str, FloatArray] = {}
    for name, path in _paths(run, places).items():
        moves = bool(np.ptp(path, axis=0).max() > least)
        if moves and all(np.abs(path - other).max() > least for other in found.values()):
            found[name] = path
    return {name: places[name] for name in found}


def _in_plane(paths: dict[str, FloatArray], flat: BoolArray, together: FloatArray) -> Figure:
    moving = [k for k in range(3) if not flat[k]]
    if len(moving) == 1:
        moving = sorted({*moving, 2 if moving[0] != 2 else 0})
    wide, high = np.ptp(together, axis=0)[moving]
    height = float(np.clip(1.2 + 0.7 * WIDTH * high / wide, *HEIGHTS)) if wide else HEIGHTS[1]
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots()
    _view(axes, paths, (moving[0], moving[1]), together)
    legend(axes, beside=True)
    return figure


def _from_three_sides(paths: dict[str, FloatArray], together: FloatArray) -> Figure:
    figure = Figure(figsize=(WIDTH, 6.0), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    for axes, (x, y, title) in zip(panels, VIEWS):
        _view(axes, paths, (x, y), together)
        axes.set_title(title, loc="left", fontsize=FONT_SIZE + 0.5)
    handles, labels = panels[0].get_legend_handles_labels()
    panels[3].set_axis_off()
    panels[3].legend(handles, labels, loc="center left", frameon=False, fontsize=FONT_SIZE)
    return figure


def _view(
    axes: Axes, paths: dict[str, FloatArray], which: tuple[int, int], together: FloatArray
) -> None:
    prepare(axes, "both")
    x, y = which
    size = float(np.ptp(together, axis=0).max())
    for axis, k in (("x", x), ("y", y)):
        factor = linear_axis(axes, [together], f"{AXES[k]} ", "m", size=size, axis=axis)
    for number, ((name, path), style) in enumerate(zip(paths.items(), line_styles(len(paths)))):
        # Dashes of overlapping turns merge to a line: numbers distinguish the paths in grey.
        label = plain(name) if len(paths) == 1 else f"{number + 1} {plain(name)}"
        axes.plot(path[:, x] / factor, path[:, y] / factor, label=label, **style)
        for index, marker in ((0, "o"), (-1, "s")):
            shape = marks(style["color"], marker, 5.5)
            axes.plot(path[index, x] / factor, path[index, y] / factor, **shape)
        if len(paths) > 1:
            axes.annotate(
                str(number + 1),
                (path[0, x] / factor, path[0, y] / factor),
                (5, 4),
                textcoords="offset points",
                fontsize=FONT_SIZE - 1.0,
            )
    axes.plot([], [], label="start", **marks("black", "o", 5.5))
    axes.plot([], [], label="end", **marks("black", "s", 5.5))
    axes.set_aspect("equal", adjustable="datalim")
    for own in (axes.xaxis, axes.yaxis):
        own.set_major_locator(MaxNLocator(6, steps=TICK_STEPS))
