"""The energy balance over time: energies, works, and residual."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.plotting.figure import (
    BLACK,
    LINES,
    Draw,
    Lines,
    curve,
    draw_line,
    draw_lines,
    largest_size,
    linear_axis,
    mark_times,
    marks_note,
    time_panels,
)
from srm_mbs.visualization.plotting.sampling import read_smoothly

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srm_mbs._typing import FloatArray
    from srm_mbs.simulation.energy_balance import EnergyBalance

MAX_PIECES = 400
"""Number of parts from which steps are divided no further: works are integrated in each part."""


def draw_balance(solution: SimulationResult) -> Figure:
    """Kinetic and potential energy, the work of all forces, and the residual of the balance.

    The residual is drawn at ``solution.t``; between the steps it is that of the dense output.

    Raises
    ------
    InputError
        For a loaded run that had a controller.
    """
    balance = read_smoothly(solution, MAX_PIECES).energy_balance
    draws: list[Draw] = [partial(_energies, solution=solution, balance=balance)]
    # Work below the error of the balance is rounding.
    error = largest_size(solution.energy_balance.residual)
    sizes = {name: largest_size(work) for name, work in balance.works.items()}
    works = {name: balance.works[name] for name, size in sizes.items() if size > error}
    less = [name for name, size in sizes.items() if 0.0 < size <= error]
    notes = [f"Work of no more than the residual is left out: {', '.join(less)}."] if less else []
    if works:
        draws.append(partial(_works, solution=solution, t=balance.t, works=works))
    draws.append(partial(_residual, solution=solution, balance=solution.energy_balance))
    return time_panels(solution, draws, [*marks_note(solution), *notes], height=1.9)


def _lines(axes: Axes, solution: SimulationResult, t: FloatArray, lines: Lines, name: str) -> None:
    mark_times(axes, solution, labelled=False)
    draw_lines(axes, t, lines, linear_axis(axes, [*lines.values()], name, "J", size=0.0))


def _energies(axes: Axes, solution: SimulationResult, balance: EnergyBalance) -> str:
    # The zero of potential energy is a convention.
    potential = balance.potential - balance.potential[:1]
    total = balance.kinetic + potential
    lines = {"kinetic": balance.kinetic, "potential": potential, "sum": total}
    _lines(axes, solution, balance.t, lines, "energy ")
    return "energies, the potential one from its start"


def _works(axes: Axes, solution: SimulationResult, t: FloatArray, works: Lines) -> str:
    if len(works) > len(LINES):
        largest = sorted(works, key=lambda name: -largest_size(works[name]))
        others = [works[name] for name in largest[len(LINES) - 1 :]]
        shown = {name: works[name] for name in works if name in largest[: len(LINES) - 1]}
        works = shown | {f"{len(others)} others together": np.sum(others, axis=0)}
    _lines(axes, solution, t, works, "work ")
    return "work done on the mechanism"


def _residual(axes: Axes, solution: SimulationResult, balance: EnergyBalance) -> str:
    mark_times(axes, solution, labelled=False)
    residual = balance.residual
    factor = linear_axis(axes, [residual], "residual ", "J", size=0.0)
    draw_line(axes, balance.t, residual / factor, color=BLACK, **curve(len(residual)))
    return f"energy gained less work: at most {balance.relative:.1e} of what took part"
