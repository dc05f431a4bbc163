"""Reactions of the closures, and the forces of couplings and drives, over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.dynamics.scaling import is_angle
from srm_mbs.errors import ControllerError, EvaluationError, InputError, known_names
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.plotting.figure import (
    LINES,
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
from srm_mbs.visualization.plotting.joints import checked_names
from srm_mbs.visualization.plotting.sampling import read_smoothly

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
JOINT_FORCES = ((True, "torque ", "N m"), (False, "force ", "N"))
"""Name and unit of a force on a joint, whose position is an angle or not."""


def draw_reactions(
    solution: SimulationResult, loops: Sequence[str] | None = None, rows: bool = False
) -> Figure:
    """Forces and moments in the closures, and the forces of couplings and drives.

    Parameters
    ----------
    loops
        Names of closures; by default those with the largest forces that fit in a panel, and a note
        names the others.  Drives are drawn if no closure is named.
    rows
        Draw the multipliers of the rows of each closure instead of the norms of force and moment.

    Raises
    ------
    InputError
        If a closure does not exist, nothing has a reaction, or the run was loaded and had a
        controller.
    """
    mechanisms = [segment.mechanism for segment in solution.segments]
    found = {loop.name: loop for mechanism in mechanisms for loop in mechanism.loops}
    drives = any(mechanism.drives for mechanism in mechanisms)
    if not found and not drives:
        raise InputError(
            f"the mechanism {solution.mechanism.name!r} has neither closures nor drives, and so no "
            "reactions",
            element="kind",
            remedy='Draw another kind, for example "state" or "balance"',
        )
    if loops is not None:
        loops = checked_names(loops, "loops", 'Give for example loops=["pin"]')
        for name in loops:
            if name not in found:
                raise InputError(
                    f"there is no closure {name!r}",
                    element="loops",
                    remedy=known_names(found),
                )
    run = _readable(solution)
    draws, left = (_by_row if rows else _by_loop)(run, found, loops)
    if drives and loops is None:
        draws += _drives(run)
    notes = [*marks_note(solution), *_indeterminate(solution, loops or list(found))]
    if left:
        notes.append(
            f"Left out: {some_of(left)}; loops=[...], or --loop, draws those that it names."
        )
    return time_panels(solution, draws, notes, height=1.9)


def _readable(solution: SimulationResult) -> SimulationResult:
    """The run at smooth times; without the end of a failed run if there are no forces there."""
    run = read_smoothly(solution, MAX_PIECES)
    try:
        _ = run.reactions
    except (ControllerError, EvaluationError) as error:
        if solution.success:
            raise
        if len(run.t) < 2:
            raise InputError(
                f"the run has no reactions: {error}",
                element="kind",
                remedy='Draw another kind, for example "state"',
            ) from error
        run = solution.at(run.t[:-1])
    return run


def _indeterminate(solution: SimulationResult, loops: Sequence[str]) -> list[str]:
    own = [row for row in solution.indeterminate_reactions if row.rpartition(".")[0] in loops]
    if not own:
        return []
    return [f"Equilibrium does not determine {some_of(own)}: values of least norm."]


def _by_loop(
    run: SimulationResult, found: Mapping[str, LoopClosure], names: Sequence[str] | None
) -> tuple[list[Draw], list[str]]:
    """Norms of force and moment of closures, couplings by the force on their first joint."""
    tied = [name for name in names or found if found[name].anchors]
    forces = {name: np.linalg.norm(run.reactions[name][:, :3], axis=1) for name in tied}
    left: list[str] = []
    if names is None:
        largest = sorted(tied, key=lambda name: -_percentile([forces[name]]))[: len(LINES)]
        left = [name for name in tied if name not in largest]
        forces = {name: own for name, own in forces.items() if name in largest}
    moments = {
        name: np.linalg.norm(run.reactions[name][:, 3:], axis=1)
        for name in forces
        if _takes_moments(found[name])
    }
    draws: list[Draw] = []
    if forces:
        draws.append(_panel(run, forces, "force ", "N", "forces in the closures"))
    if moments:
        title = "moments in the closures, about the origins of their anchors b"
        draws.append(_panel(run, moments, "moment ", "N m", title))
    coupled = [name for name in names or found if not found[name].anchors]
    first = {name: found[name].rows.joint_rows[0].joints[0] for name in coupled}
    couplings = run.coupling_forces
    for turning, what, unit in JOINT_FORCES:
        lines = {
            f"{name}, on {joint}": couplings[name][:, 0]
            for name, joint in first.items()
            if is_angle(run.mechanism.model, joint) == turning
        }
        title = "couplings, on their first joints"
        draws += [_panel(run, part, what, unit, title) for part in in_panels(lines)]
    return draws, left


def _takes_moments(loop: LoopClosure) -> bool:
    """Whether its reaction has a moment about the origin of b, except that of the closure error."""
    return bool(len(loop.rows.alignments)) or 0 < len(loop.rows.directions) < 3


def _by_row(
    run: SimulationResult, found: Mapping[str, LoopClosure], names: Sequence[str] | None
) -> tuple[list[Draw], list[str]]:
    """The multipliers of each closure, rows of one unit in a panel."""
    draws: list[Draw] = []
    left: list[str] = []
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
                panels.append(_panel(run, lines, "multiplier ", unit, title))
        if names is None and (left or (draws and len(draws) + len(panels) > MAX_PANELS)):
            left.append(name)
        else:
            draws += panels
    return draws, left


def _drives(run: SimulationResult) -> list[Draw]:
    model = run.mechanism.model
    turning = {
        drive.name: drive.joint is not None and is_angle(model, drive.joint)
        for each in run.segments
        for drive in each.mechanism.drives
    }
    draws = []
    for turns, what, unit in JOINT_FORCES:
        lines = {n: own for n, own in run.drive_forces.items() if turning[n] == turns}
        if lines:
            draws.append(_panel(run, lines, what, unit, "drives"))
    return draws


def _panel(run: SimulationResult, lines: Lines, name: str, unit: str, title: str) -> Draw:
    """A panel of ``lines`` in ``unit``, with the label ``name`` of its axis."""

    def draw(axes: Axes) -> str:
        mark_times(axes, run, labelled=False)
        shown = list(lines.values())
        top = AXIS_RATIO * _percentile(shown)
        largest = max(map(largest_size, shown))
        cut = largest > PEAK_RATIO / AXIS_RATIO * top > 0.0
        if cut:
            shown = [np.clip(values, -top, top) for values in shown]
        factor = linear_axis(axes, shown, name, unit, size=0.0)
        draw_lines(axes, run.t, lines, factor)
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
