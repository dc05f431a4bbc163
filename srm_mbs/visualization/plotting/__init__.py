"""Plots of a run: ``solution.plot``.

Imported on first use, because Matplotlib is slow to import.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srm_mbs.errors import InputError
from srm_mbs.visualization.plotting.dae import draw_dae_run, draw_dae_state
from srm_mbs.visualization.plotting.energy import draw_balance
from srm_mbs.visualization.plotting.figure import FORMATS, check_suffix, save
from srm_mbs.visualization.plotting.joints import draw_phase, draw_state
from srm_mbs.visualization.plotting.path import draw_path
from srm_mbs.visualization.plotting.reactions import draw_reactions
from srm_mbs.visualization.plotting.run import draw_run, draw_sigma

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srm_mbs.simulation.dae_result import DaeResult
    from srm_mbs.simulation.result import SimulationResult

__all__ = ["FORMATS", "KINDS", "Kind", "check_options", "plot_dae", "plot_solution"]


@dataclass(frozen=True)
class Kind:
    """A kind of plot.

    Attributes
    ----------
    draw
        Function (solution, **options) -> figure.
    options
        Names of its options.
    """

    draw: Callable[..., Figure]
    options: tuple[str, ...] = ()


KINDS = {
    "run": Kind(draw_run),
    "state": Kind(draw_state, ("joints",)),
    "balance": Kind(draw_balance),
    "reactions": Kind(draw_reactions, ("loops", "rows")),
    "sigma": Kind(draw_sigma),
    "phase": Kind(draw_phase, ("joints",)),
    "path": Kind(draw_path, ("points",)),
}
"""The kinds of plot of a run, by name."""

DAE_KINDS = {"run": Kind(draw_dae_run), "state": Kind(draw_dae_state)}
"""The kinds of plot of a run of a DAE, by name."""


def check_options(
    kind: str, options: Iterable[str] = (), kinds: Mapping[str, Kind] = KINDS
) -> None:
    """Refuse an unknown kind of plot, or options that it does not have.

    Raises
    ------
    InputError
        With the known kinds or options.
    """
    if kind not in kinds:
        raise InputError(
            f"there is no kind of picture {kind!r}",
            element="kind",
            remedy=f"Known: {', '.join(kinds)}",
        )
    known = kinds[kind].options
    for name in options:
        if name not in known:
            raise InputError(
                f"a picture of kind {kind!r} has no such option",
                element=name,
                remedy=f"Known: {', '.join(known) or 'none'}",
            )


def plot_solution(
    solution: SimulationResult, path: str | Path | None = None, kind: str = "run", **options: Any
) -> Figure:
    """Plot a run; see :meth:`srm_mbs.Solution.plot`."""
    check_options(kind, options)
    return _drawn(partial(KINDS[kind].draw, solution, **options), path)


def plot_dae(solution: DaeResult, path: str | Path | None = None, kind: str = "run") -> Figure:
    """Plot a run of a DAE; see :meth:`srm_mbs.DaeSolution.plot`."""
    check_options(kind, kinds=DAE_KINDS)
    return _drawn(partial(DAE_KINDS[kind].draw, solution), path)


def _drawn(draw: Callable[[], Figure], path: str | Path | None) -> Figure:
    """The figure, saved if a path is given, whose suffix is checked first."""
    if path is None:
        return draw()
    check_suffix(Path(path))
    figure = draw()
    save(figure, Path(path))
    return figure
