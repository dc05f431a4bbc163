"""Positions, velocities and accelerations of points of links, over time or over a joint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from srm_mbs.dynamics.scaling import coordinate_units
from srm_mbs.model.anchors import Anchor
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.joint_components import XYZ
from srm_mbs.visualization.plotting.figure import (
    PER_TIME,
    WIDTH,
    Abscissa,
    draw_lines,
    finish,
    linear_axis,
    mark_times,
    marks_note,
    plain,
    prepare,
    title_columns,
    wrapped,
)
from srm_mbs.visualization.plotting.joints import LABEL_WIDTH, noise
from srm_mbs.visualization.plotting.path import moving_points, some_places
from srm_mbs.visualization.plotting.sampling import read_forces, read_smoothly

if TYPE_CHECKING:
    from srm_mbs._typing import FloatArray

MAX_POINTS = 4
"""Most points that are drawn by default."""
PARTS = ("position", "velocity", "acceleration")


def draw_points(
    solution: SimulationResult,
    points: Sequence[Anchor | str] | None = None,
    x: str | None = None,
    unit: str | None = None,
) -> Figure:
    """Position, velocity and acceleration of points, along the axes of the world.

    Parameters
    ----------
    points
        Points of links, for example ``[srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))]``, or names of
        points of the mechanism; by default some that move, and a note names others.
    x, unit
        Joint on the horizontal axis instead of time, and its unit (:class:`.figure.Abscissa`).

    Raises
    ------
    InputError
        If a point does not exist or lies on the ground, or none moves; for a loaded run that had a
        controller.
    """
    mechanism = solution.mechanism
    abscissa = Abscissa(solution, x, unit)
    notes: list[str] = []
    if points is None:
        places, notes = some_places(solution, read_smoothly(solution), MAX_POINTS)
    else:
        places = moving_points(mechanism, points)
    run = read_forces(solution, lambda run: run.accelerations)
    units = coordinate_units(mechanism, mechanism.q0, mechanism.v0)
    figure = Figure(figsize=(WIDTH, 0.9 + 1.5 * len(places)), layout="constrained")
    panels = figure.subplots(len(places), len(PARTS), sharex=True, squeeze=False)
    for (name, place), row in zip(places.items(), panels):
        motion = run.motion_of(place)
        curves: list[FloatArray] = [getattr(motion, part) for part in PARTS]
        least = noise(solution) * units.length
        moves = [k for k in range(3) if np.ptp(curves[0][:, k]) > least]
        label = f"{plain(wrapped(name, LABEL_WIDTH))}\n"
        for order, (axes, values, per) in enumerate(zip(row, curves, PER_TIME)):
            prepare(axes)
            mark_times(axes, solution, labelled=False, abscissa=abscissa)
            lines = {XYZ[k]: values[:, k] for k in moves or range(3)}
            size = units.length * units.rate**order
            own = "" if order else label
            drawn = [*lines.values()]
            factor = linear_axis(axes, drawn, own, f"m{per}", size=size, noise=noise(solution))
            draw_lines(axes, abscissa.of(run), lines, factor)
    title_columns(figure, panels, PARTS, abscissa)
    notes = [*marks_note(solution), *notes, CONSTANT_NOTE]
    finish(figure, solution, notes)
    return figure


CONSTANT_NOTE = "Axes of the world; coordinates that do not change are left out."
