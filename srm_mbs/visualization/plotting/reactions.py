"""Reactions of closures and joints, and the forces of couplings and drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.dynamics.constraints.wrenches import moved
from srm_mbs.dynamics.scaling import is_angle
from srm_mbs.errors import InputError, known_names
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.plotting.figure import (
    LINES,
    Abscissa,
    Draw,
    Lines,
    draw_lines,
    finite,
    in_panels,
    largest_size,
    linear_axis,
    mark_times,
    marks_note,
    plain,
    some_of,
    time_panels,
)
from srm_mbs.visualization.plotting.joints import checked_names, chosen_joints
from srm_mbs.visualization.plotting.sampling import read_forces

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srm_mbs._typing import FloatArray
    from srm_mbs.model.closures import LoopClosure

MAX_PIECES = 1000
"""Number of parts from which steps are divided no further: each time needs a solution."""
PERCENTILE = 98.0
"""Percentile of the drawn values with which peaks are compared."""
PEAK_RATIO = 6.0
"""Values above this times the percentile are cut: reactions peak at singular passages."""
AXIS_RATIO = 1.6
"""End of an axis with cut peaks, over the percentile."""
MAX_PANELS = 8
"""Most panels of multipliers that are drawn by default."""
ROUNDING = 1e-9
"""Part of the largest force, for moments times the scene diagonal, that is rounding."""
JOINT_FORCES = ((True, "torque ", "N m"), (False, "force ", "N"))
"""Name and unit of a force on a joint, whose position is an angle or not."""


def draw_reactions(
    solution: SimulationResult,
    loops: Sequence[str] | None = None,
    rows: bool = False,
    joints: Sequence[str] | None = None,
    x: str | None = None,
    unit: str | None = None,
) -> Figure:
    """Forces and moments in the closures and joints, and the forces of couplings and drives.

    Forces and moments that are rounding are left out.

    Parameters
    ----------
    loops, joints
        Names of closures and of joints; by default those with the largest forces that fit in a
        panel, and a note names the others.  Where some are named, only these are drawn, and no
        drives.
    rows
        Draw the multipliers of the rows of each closure instead of the norms of force and moment,
        and no joints unless they are named.
    x, unit
        Joint on the horizontal axis instead of time, and its unit (:class:`.figure.Abscissa`).

    Raises
    ------
    InputError
        If a closure or joint does not exist, nothing carries a force, or the run was loaded and had
        a controller.
    """
    mechanisms = [segment.mechanism for segment in solution.segments]
    found = {loop.name: loop for mechanism in mechanisms for loop in mechanism.loops}
    drives = any(mechanism.drives for mechanism in mechanisms)
    everything = loops is None and joints is None
    if loops is not None:
        loops = checked_names(loops, "loops", 'Give for example loops=["pin"]')
        for name in loops:
            if name not in found:
                raise InputError(
                    f"there is no closure {name!r}",
                    element="loops",
                    remedy=known_names(found),
                )
    if joints is not None:
        joints = chosen_joints(solution.mechanism, joints)
    abscissa = Abscissa(solution, x, unit)
    run = read_forces(solution, lambda run: run.reactions, MAX_PIECES)
    drawing = _Drawing(run, abscissa)
    if everything or loops is not None:
        (_by_row if rows else _by_loop)(drawing, found, loops)
    if joints is not None or (everything and not rows):
        _by_joint(drawing, joints)
    if drives and everything:
        _drives(drawing)
    notes = marks_note(solution)
    if undetermined := drawing.undetermined(solution):
        notes.append(
            f"Equilibrium does not determine {some_of(undetermined)}: values of least norm."
        )
    if drawing.left:
        notes.append(
            f"Left out: {some_of(drawing.left)}; loops=[...] and joints=[...], or --loop and "
            "--joint, draw those that they name."
        )
    if drawing.rounding:
        notes.append(f"Left out as rounding: {some_of(drawing.rounding)}.")
    if not drawing.draws:
        raise InputError(
            "nothing in the run carries a force",
            element="kind",
            remedy='Draw another kind, for example "state"',
        )
    return time_panels(solution, drawing.draws, notes, height=1.9, abscissa=abscissa)


class _Drawing:
    """Panels of a figure, and what they leave out.

    Parameters
    ----------
    run
        The run at the times that are drawn.
    abscissa
        The horizontal axis.

    Attributes
    ----------
    draws
        The panels.
    left, rounding
        Names of what is left out because there is no room, and because it is rounding.
    shown
        Names of the closures and joints that are drawn.
    """

    def __init__(self, run: SimulationResult, abscissa: Abscissa) -> None:
        self.run, self.abscissa = run, abscissa
        self.draws: list[Draw] = []
        self.left: list[str] = []
        self.rounding: list[str] = []
        self.shown: dict[str, None] = {}
        everything = [*run.reactions.values(), *run.joint_reactions.values()]
        self._force = max((largest_size(wrench[:, :3]) for wrench in everything), default=0.0)
        self._length = run.mechanism.structure.units.length

    def wrenches(
        self, wrenches: Mapping[str, FloatArray], where: str, about: str, fitting: bool
    ) -> None:
        """Panels of the norms of forces and moments; only those that fit if ``fitting``."""
        forces = {name: np.linalg.norm(wrench[:, :3], axis=1) for name, wrench in wrenches.items()}
        if fitting:
            order = sorted(forces, key=lambda name: -_percentile([forces[name]]))
            self.left += [name for name in forces if name in order[len(LINES) :]]
            forces = {name: own for name, own in forces.items() if name in order[: len(LINES)]}
        moments = {name: np.linalg.norm(wrenches[name][:, 3:], axis=1) for name in forces}
        self.shown |= dict.fromkeys(forces)
        least = ROUNDING * self._force
        for lines, what, unit, title, zero in (
            (forces, "force ", "N", f"forces in the {where}", least),
            (moments, "moment ", "N m", f"moments in the {where}, {about}", least * self._length),
        ):
            large = {name: own for name, own in lines.items() if largest_size(own) > zero}
            self.rounding += [f"{what}in {name}" for name in lines if name not in large]
            for part in in_panels(large):
                self.panel(part, what, unit, title)

    def undetermined(self, solution: SimulationResult) -> list[str]:
        """Rows and components of what is drawn that equilibrium does not determine."""
        given = (*solution.indeterminate_reactions, *solution.indeterminate_joint_reactions)
        return [name for name in given if name.rpartition(".")[0] in self.shown]

    def panel(self, lines: Lines, name: str, unit: str, title: str) -> None:
        """A panel of ``lines`` in ``unit``, with the label ``name`` of its axis."""
        self.draws.append(_panel(self.run, self.abscissa, lines, name, unit, title))


def _by_loop(
    drawing: _Drawing, found: Mapping[str, LoopClosure], names: Sequence[str] | None
) -> None:
    """Norms of force and moment of closures, couplings by the force on their first joint."""
    run = drawing.run
    tied = {name: _at_contact(run, found[name]) for name in names or found if found[name].anchors}
    drawing.wrenches(tied, "closures", "about the origins of their anchors a", names is None)
    coupled = [name for name in names or found if not found[name].anchors]
    drawing.shown |= dict.fromkeys(coupled)
    first = {name: found[name].rows.joint_rows[0].joints[0] for name in coupled}
    couplings = run.coupling_forces
    for turning, what, unit in JOINT_FORCES:
        lines = {
            f"{name}, on {joint}": couplings[name][:, 0]
            for name, joint in first.items()
            if is_angle(run.mechanism.model, joint) == turning
        }
        for part in in_panels(lines):
            drawing.panel(part, what, unit, "couplings, on their first joints")


def _at_contact(run: SimulationResult, loop: LoopClosure) -> FloatArray:
    """The reaction (n, 6) about the origin of a, at which the forces of all rows act."""
    at_a, at_b = (run.motion_of(place).position for place in loop.resolve(run.mechanism.model))
    return moved(run.reactions[loop.name], at_a - at_b)


def _by_joint(drawing: _Drawing, names: Sequence[str] | None) -> None:
    """Norms of force and moment of joints."""
    reactions = drawing.run.joint_reactions
    chosen = {name: reactions[name] for name in names or reactions}
    drawing.wrenches(chosen, "joints", "about their origins", names is None)


def _by_row(
    drawing: _Drawing, found: Mapping[str, LoopClosure], names: Sequence[str] | None
) -> None:
    """The multipliers of each closure, rows of one unit in a panel."""
    run, draws, left = drawing.run, drawing.draws, drawing.left
    for name in names or found:
        loop = found[name]
        panels = []
        _, alignments, joints = loop.rows.blocks
        turning = [is_angle(run.mechanism.model, r.joints[0]) for r in loop.rows.joint_rows]
        numbers = range(loop.rows.count)
        angles = [*numbers[alignments], *(i for i, t in zip(numbers[joints], turning) if t)]
        for own, unit in (([i for i in numbers if i not in angles], "N"), (angles, "N m")):
            lines = {loop.rows.labels[i]: run.reaction_multipliers[name][:, i] for i in own}
            if lines:
                title = f"multipliers of {plain(name)}"
                panels.append(_panel(run, drawing.abscissa, lines, "multiplier ", unit, title))
        if names is None and (left or (draws and len(draws) + len(panels) > MAX_PANELS)):
            left.append(name)
        else:
            draws += panels
            drawing.shown[name] = None


def _drives(drawing: _Drawing) -> None:
    run = drawing.run
    model = run.mechanism.model
    turning = {
        drive.name: drive.joint is not None and is_angle(model, drive.joint)
        for each in run.segments
        for drive in each.mechanism.drives
    }
    for turns, what, unit in JOINT_FORCES:
        lines = {n: own for n, own in run.drive_forces.items() if turning[n] == turns}
        if lines:
            drawing.panel(lines, what, unit, "drives")


def _panel(
    run: SimulationResult, abscissa: Abscissa, lines: Lines, name: str, unit: str, title: str
) -> Draw:
    """A panel of ``lines`` in ``unit``, with the label ``name`` of its axis."""

    def draw(axes: Axes) -> str:
        mark_times(axes, run, labelled=False, abscissa=abscissa)
        shown = list(lines.values())
        top = AXIS_RATIO * _percentile(shown)
        largest = max(map(largest_size, shown))
        cut = largest > PEAK_RATIO / AXIS_RATIO * top > 0.0
        if cut:
            shown = [np.clip(values, -top, top) for values in shown]
        factor = linear_axis(axes, shown, name, unit, size=0.0)
        draw_lines(axes, abscissa.of(run), lines, factor)
        if not cut:
            return title
        low = min(float(np.nanmin(finite(values))) for values in shown)
        axes.set_ylim(min(0.0, 1.05 * low / factor), top / factor)
        return f"{title}; peaks to {largest:.2g} {unit} are cut"

    return draw


def _percentile(lines: Sequence[FloatArray]) -> float:
    together = np.abs(np.concatenate(lines))
    together = together[np.isfinite(together)]
    return float(np.percentile(together, PERCENTILE)) if len(together) else 0.0
