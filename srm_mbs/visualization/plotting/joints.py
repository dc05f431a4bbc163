"""Positions and rates of joints over time, and phase portraits: rate over position.

A joint of several degrees of freedom is drawn as
:class:`~srm_mbs.visualization.joint_components.Component` objects, one for each axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, known_names, safe_repr
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.joint_components import Component, components
from srm_mbs.visualization.plotting.figure import (
    BLACK,
    BLUE,
    FONT_SIZE,
    PER_TIME,
    VERMILION,
    WIDTH,
    Abscissa,
    draw_lines,
    finish,
    linear_axis,
    mark_times,
    marks,
    marks_note,
    plain,
    prepare,
    some_of,
    title_columns,
    wrapped,
)
from srm_mbs.visualization.plotting.sampling import read_forces, read_smoothly, with_gaps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOISE_RATIO = 0.1
"""Noise of the coordinates of a run, whose changes are drawn as constant, over its tolerance."""
LARGEST_NOISE_TOLERANCE = 1e-6
"""Largest tolerance for this noise, so that plots of loose runs show small motions."""
MAX_ROWS = 8
"""Most rows of panels on a page."""
LABEL_WIDTH = 16
SEVERAL_FREEDOMS_NOTE = (
    "Joints of several degrees of freedom: rotations as vectors (axis times angle); rates in the "
    "moving body's axes."
)
MAX_PORTRAITS = 6
"""Most phase portraits that are drawn by default."""
PORTRAIT_COLUMNS = 3
NARROW_TICKS = 4
"""Intervals between the ticks of a panel that shares its row."""
MARKERS_NOTE = "Circles: start; squares: end"


def chosen_joints(mechanism: Mechanism, joints: Sequence[str] | None) -> tuple[str, ...]:
    """The names ``joints``, each checked; all that there are if it is None.

    Raises
    ------
    InputError
        If one does not exist or is named twice, or none is named.
    """
    if joints is None:
        return mechanism.joint_names
    names = checked_names(joints, "joints", 'Give for example joints=["crank"]')
    for name in names:
        try:
            mechanism.joint(name)
        except InputError as error:
            error.element = "joints"
            raise
    return names


def checked_names(names: Any, element: str, remedy: str) -> tuple[str, ...]:
    """``names`` as a tuple of different names.

    Raises
    ------
    InputError
        About ``element`` if there are none, one is named twice, or they are no strings.
    """
    single = isinstance(names, str)
    found = () if single or not isinstance(names, Sequence) else tuple(names)
    if not found or not all(isinstance(name, str) for name in found):
        raise InputError(
            f"{safe_repr(names)} is not a list of names", element=element, remedy=remedy
        )
    for name in found:
        if found.count(name) > 1:
            raise InputError(f"{name!r} is named twice", element=element, remedy="Name it once")
    return found


def noise(run: SimulationResult) -> float:
    """Part of the typical magnitude below which changes of coordinates of ``run`` are noise."""
    return NOISE_RATIO * min(run.settings.rtol, LARGEST_NOISE_TOLERANCE)


def draw_state(
    solution: SimulationResult,
    joints: Sequence[str] | None = None,
    accelerations: bool = False,
    x: str | None = None,
    unit: str | None = None,
) -> Figure:
    """Position and rate of each joint over time or over another joint.

    Parameters
    ----------
    joints
        Names of joints; by default all that fit on a page, and a note names the others.
    accelerations
        Whether to draw the accelerations, too.
    x, unit
        Joint on the horizontal axis instead of time, and its unit (:class:`.figure.Abscissa`).

    Raises
    ------
    InputError
        If there is no such joint; for accelerations of a loaded run that had a controller.
    """
    names = chosen_joints(solution.mechanism, joints)
    abscissa = Abscissa(solution, x, unit)
    run = (
        read_forces(solution, lambda run: run.accelerations)
        if accelerations
        else read_smoothly(solution)
    )
    rows: list[Component] = []
    left: list[str] = []
    for name in names:
        own = list(components(run, name))
        # Joints that are requested by name are always drawn.
        if joints is None and (left or (rows and len(rows) + len(own) > MAX_ROWS)):
            left.append(name)
        else:
            rows += own
    figure = Figure(figsize=(WIDTH, 0.9 + 1.2 * len(rows)), layout="constrained")
    columns = 3 if accelerations else 2
    panels = figure.subplots(len(rows), columns, sharex=True, squeeze=False)
    for row, own in zip(rows, panels):
        part = f"{row.part} " if row.part else ""
        name = f"{plain(wrapped(row.joint, LABEL_WIDTH))}\n{part}"
        curves = [row.positions, row.rates]
        if accelerations:
            curves.append(run.accelerations[:, row.own])
        for axes, values, label, per, size in zip(own, curves, (name, "", ""), PER_TIME, row.sizes):
            prepare(axes)
            mark_times(axes, solution, labelled=False, abscissa=abscissa)
            measured = f"{row.unit}{per}"
            factor = linear_axis(axes, [values], label, measured, size=size, noise=noise(solution))
            draw_lines(axes, abscissa.of(run), dict(zip(row.names, values.T)), factor)
    title_columns(figure, panels, ("position", "rate", "acceleration"), abscissa)
    notes = marks_note(solution)
    if any(len(row.names) > 1 for row in rows):
        notes.append(SEVERAL_FREEDOMS_NOTE)
    if left:
        notes.append(
            f"Left out: {some_of(left)}; joints=[...], or --joint, draws those that it names."
        )
    finish(figure, solution, notes)
    return figure


def draw_phase(solution: SimulationResult, joints: Sequence[str] | None = None) -> Figure:
    """Rate over position of joints with one degree of freedom.

    Parameters
    ----------
    joints
        Names of joints; by default the first :data:`MAX_PORTRAITS` with one degree of freedom, and
        a note names the others.

    Raises
    ------
    InputError
        If there is no such joint, or it has more than one degree of freedom.
    """
    mechanism = solution.mechanism
    names = chosen_joints(mechanism, joints)
    single = [name for name in names if mechanism.joint(name).nv == 1]
    for name in names:
        if name not in single and (joints is not None or not single):
            raise InputError(
                f"joint {name!r} has {mechanism.joint(name).nv} degrees of freedom, and no "
                "phase portrait",
                element="joints",
                remedy=known_names(single) if single else 'Draw the kind "state"',
            )
    shown = single if joints is not None else single[:MAX_PORTRAITS]
    run = read_smoothly(solution)
    passages = solution.at([crossing.time for crossing in solution.crossings])
    columns = min(PORTRAIT_COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    height = 2.1 if columns > 1 else 3.4
    figure = Figure(figsize=(WIDTH, 0.9 + height * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    ticks = 5 if len(shown) == 1 else NARROW_TICKS
    for name, axes in zip(shown, panels):
        _portrait(axes, solution, run, passages, name, ticks)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    left = [name for name in names if name not in shown]
    notes = [MARKERS_NOTE + ("; plus signs: singular passages." if solution.crossings else ".")]
    if left:
        notes.append(f"Left out: {some_of(left)}; joints=[...], or --joint, names others.")
    finish(figure, solution, notes)
    return figure


def _portrait(
    axes: Axes,
    solution: SimulationResult,
    run: SimulationResult,
    passages: SimulationResult,
    name: str,
    ticks: int,
) -> None:
    """Rate over position of the joint ``name``, its start, its end and the singular passages."""
    prepare(axes, "both")
    (component,) = components(run, name)
    position, rate = component.positions[:, 0], component.rates[:, 0]
    unit, sizes = component.unit, component.sizes
    axis = partial(linear_axis, axes, noise=noise(solution), ticks=ticks)
    x = axis([position], "position ", unit, size=sizes[0], axis="x")
    y = axis([rate], "rate ", f"{unit}/s", size=sizes[1])
    path = (with_gaps(solution, run.t, values) for values in (position / x, rate / y))
    axes.plot(*path, color=BLUE, linewidth=0.9)
    if len(passages.t):
        at = passages.joint(name)
        axes.plot(at[0] / x, at[1] / y, **marks(VERMILION, "+", 6.0))
    for index, marker in ((0, "o"), (-1, "s")):
        axes.plot(position[index] / x, rate[index] / y, **marks(BLACK, marker, 5.5))
    axes.set_title(plain(name), loc="left", fontsize=FONT_SIZE + 0.5)
