"""Paths of points in space, in their plane or in three projections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from srm_mbs._kernel.workspace import workspace
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
Places = dict[str, tuple[int, pin.SE3]]
"""Points by name: joint, and placement in it."""


def draw_path(solution: SimulationResult, points: Sequence[Anchor] | None = None) -> Figure:
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
    notes = []
    if points is None:
        paths = _default_paths(solution, run)
        if not paths:
            raise InputError(
                "no joint, closure or centre of mass of the mechanism moves along a path",
                element="points",
                remedy='Name points, for example points=[srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))]',
            )
        left = list(paths)[len(LINES) :]
        paths = {name: paths[name] for name in list(paths)[: len(LINES)]}
        if left:
            notes.append(f"Left out: {some_of(left)}; points=[...], or --point, names others.")
    else:
        placed = resolve_moving(mechanism.model, points, "points")
        if not placed:
            raise InputError("no points are given", element="points", remedy="Leave the option out")
        paths = _paths(run, {_name(point): place for point, place in zip(points, placed)})
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


def _name(anchor: Anchor) -> str:
    if not any(anchor.xyz):
        return anchor.where
    return f"{anchor.where} ({', '.join(f'{x:.4g}' for x in anchor.xyz)})"


def _paths(run: SimulationResult, places: Places) -> dict[str, FloatArray]:
    """Positions (n, 3) m in the world of each point."""
    model = run.mechanism.model
    data = workspace(model)
    paths = {name: np.empty((len(run.t), 3)) for name in places}
    for i, q in enumerate(run.q):
        pin.forwardKinematics(model, data, q)
        for name, (joint, placement) in places.items():
            paths[name][i] = data.oMi[joint].act(placement.translation)
    return paths


def _default_paths(solution: SimulationResult, run: SimulationResult) -> dict[str, FloatArray]:
    """Paths of the origins of joints, of the anchors of closures, or of centres of mass."""
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
    paths = _different(_paths(run, places), SMALLEST_PATH * size)
    if paths:
        return paths
    # One rotating body, or several about one point.
    centres = {}
    for name in mechanism.joint_names:
        inertia = model.inertias[model.getJointId(name)]
        if inertia.mass > 0.0:
            place = (model.getJointId(name), pin.SE3(np.eye(3), inertia.lever))
            centres[f"centre of mass of the body at {name}"] = place
    return _different(_paths(run, centres), SMALLEST_PATH * size)


def _different(paths: dict[str, FloatArray], least: float) -> dict[str, FloatArray]:
    """Those of the ``paths`` with an extent above ``least`` (m), each point once."""
    found: dict[str, FloatArray] = {}
    for name, path in paths.items():
        moves = bool(np.ptp(path, axis=0).max() > least)
        if moves and all(np.abs(path - other).max() > least for other in found.values()):
            found[name] = path
    return found


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
