"""Plots of a run: ``solution.plot``.

Imported on first use, because Matplotlib is slow to import.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srm_mbs.errors import InputError, known_names, safe_repr
from srm_mbs.formats.files import checked_path
from srm_mbs.visualization.plotting.dae import draw_dae_run, draw_dae_state
from srm_mbs.visualization.plotting.energy import draw_balance
from srm_mbs.visualization.plotting.figure import (
    FONT_SIZE,
    RESOLUTION,
    check_suffix,
    save,
    settings_of,
)
from srm_mbs.visualization.plotting.joints import draw_phase, draw_state
from srm_mbs.visualization.plotting.path import draw_path
from srm_mbs.visualization.plotting.points import draw_points
from srm_mbs.visualization.plotting.poses import draw_poses
from srm_mbs.visualization.plotting.print_size import (
    check_pixels,
    checked_resolution,
    checked_size,
    set_size,
)
from srm_mbs.visualization.plotting.reactions import draw_reactions
from srm_mbs.visualization.plotting.run import draw_run, draw_sigma

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srm_mbs.simulation.dae_result import DaeResult
    from srm_mbs.simulation.result import SimulationResult

__all__ = ["KINDS", "check_options", "plot_dae", "plot_solution"]

Kinds = Mapping[str, "Callable[..., Figure]"]
"""Kinds of plot by name: functions of a run and of the options of the plot."""

KINDS: Kinds = {
    "run": draw_run,
    "state": draw_state,
    "balance": draw_balance,
    "reactions": draw_reactions,
    "sigma": draw_sigma,
    "phase": draw_phase,
    "path": draw_path,
    "point": draw_points,
    "poses": draw_poses,
}
"""Kinds of plots of a run of a mechanism."""

COMMON = ("title", "size", "dpi")
"""Options of every kind."""

DAE_KINDS: Kinds = {"run": draw_dae_run, "state": draw_dae_state}
"""Kinds of plots of a run of a DAE."""


def check_options(kind: str, options: Iterable[str], kinds: Kinds = KINDS) -> None:
    """Refuse an unknown kind of plot, or options that it does not have.

    Raises
    ------
    InputError
        With the known kinds or options.
    """
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(
            f"there is no kind of picture {safe_repr(kind)}",
            element="kind",
            remedy=known_names(kinds),
        )
    _, *known = inspect.signature(kinds[kind]).parameters
    known += COMMON
    for name in options:
        if name not in known:
            raise InputError(
                f"a picture of kind {safe_repr(kind)} has no such option",
                element=name,
                remedy=known_names(known),
            )


def plot_solution(
    solution: SimulationResult, path: str | Path | None, kind: str, options: Mapping[str, Any]
) -> Figure:
    """Plot a run; see :meth:`srm_mbs.Solution.plot`, whose keywords are ``options``."""
    return _plot(KINDS, solution, path, kind, **given_options(options))


def plot_dae(
    solution: DaeResult, path: str | Path | None, kind: str, options: Mapping[str, Any]
) -> Figure:
    """Plot a run of a DAE; see :meth:`srm_mbs.DaeSolution.plot`, whose keywords are ``options``."""
    return _plot(DAE_KINDS, solution, path, kind, **given_options(options))


def given_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """The ``options`` that differ from their defaults, None and False."""
    return {name: value for name, value in options.items() if not (value is None or value is False)}


def _plot(
    kinds: Kinds,
    solution: Any,
    path: str | Path | None,
    kind: str,
    title: str | None = None,
    size: Any = None,
    dpi: Any = None,
    **options: Any,
) -> Figure:
    check_options(kind, options, kinds)
    inches = None if size is None else checked_size(size)
    resolution = RESOLUTION if dpi is None else checked_resolution(dpi)
    if title is not None and not isinstance(title, str):
        raise InputError(
            f"{safe_repr(title)} is not a text", element="title", remedy="Give a string"
        )
    file = None if path is None else checked_path(path)
    if file is not None:
        check_suffix(file)
    figure = kinds[kind](solution, **options)
    if title is not None:
        figure.suptitle(title, fontsize=FONT_SIZE + 1.5, parse_math=False)
    # Also without a file: that of savefig, where the figure is saved by its user.
    figure.set_dpi(resolution)
    if inches is not None:
        set_size(figure, inches)
    if file is not None:
        if file.suffix.lower() == ".png":
            check_pixels(figure)
        save(figure, file, settings_of(solution))
    return figure
