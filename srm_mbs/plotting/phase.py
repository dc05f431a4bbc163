"""Phase portraits: the rate of a joint over its position."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from srm_mbs.errors import InputError
from srm_mbs.plotting.components import chosen_joints, components, noise
from srm_mbs.plotting.panels import finish, some_of
from srm_mbs.plotting.sampling import broken, read_smoothly
from srm_mbs.plotting.style import (
    BLACK,
    BLUE,
    FONT_SIZE,
    VERMILION,
    WIDTH,
    linear_axis,
    marks,
    plain,
    prepare,
)
from srm_mbs.solution import Solution

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_PORTRAITS = 6
COLUMNS = 3
NARROW_TICKS = 4
"""Intervals between the ticks of a panel that shares its row."""
MARKS = "Circles: start; squares: end"


def draw_phase(solution: Solution, joints: Sequence[str] | None = None) -> Figure:
    """Rate over position of joints with one degree of freedom.

    Parameters
    ----------
    joints
        Names of joints; by default the first ones that have one degree of freedom, and a note
        names the others.

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
                remedy=f"Known: {', '.join(single)}" if single else 'Draw the kind "state"',
            )
    shown = single if joints is not None else single[:MOST_PORTRAITS]
    run, passages = read_smoothly(solution), None
    if solution.crossings:
        passages = solution.at([crossing.time for crossing in solution.crossings])
    columns = min(COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    height = 2.1 if columns > 1 else 3.4
    figure = Figure(figsize=(WIDTH, 0.9 + height * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for name, axes in zip(shown, panels):
        _portrait(axes, solution, run, passages, name, alone=len(shown) == 1)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    left = [name for name in names if name not in shown]
    notes = [MARKS + ("; plus signs: singular passages." if solution.crossings else ".")]
    if left:
        notes.append(f"Left out: {some_of(left)}; joints=[...], or --joint, names others.")
    finish(figure, solution, notes)
    return figure


def _portrait(
    axes: Axes, solution: Solution, run: Solution, passages: Solution | None, name: str, alone: bool
) -> None:
    prepare(axes, "both")
    (component,) = components(run, name)
    position, rate = component.positions[:, 0], component.rates[:, 0]
    unit, sizes = component.unit, component.sizes
    options: dict[str, Any] = {"noise": noise(solution), "ticks": 5 if alone else NARROW_TICKS}
    x = linear_axis(axes, [position], "position ", unit, size=sizes[0], axis="x", **options)
    y = linear_axis(axes, [rate], "rate ", f"{unit}/s", size=sizes[1], **options)
    _, line = broken(solution, run.t, rate)
    _, along = broken(solution, run.t, position)
    axes.plot(along / x, line / y, color=BLUE, linewidth=0.9)
    if passages is not None:
        at = passages.joint(name)
        axes.plot(at[0] / x, at[1] / y, **marks(VERMILION, "+", 6.0))
    for index, marker in ((0, "o"), (-1, "s")):
        axes.plot(position[index] / x, rate[index] / y, **marks(BLACK, marker, 5.5))
    axes.set_title(plain(name), loc="left", fontsize=FONT_SIZE + 0.5)
