"""The motion of a run as a table: options of ``simulate``, and the command ``csv``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import srm_mbs
from srm_mbs.cli.output import (
    PrintedLines,
    Run,
    check_output,
    option,
    reported,
    say_written,
    several,
)
from srm_mbs.cli.playback import NAMED_POINT, points_or_names
from srm_mbs.errors import InputError, naming

if TYPE_CHECKING:
    from srm_mbs._typing import FloatArray
    from srm_mbs.api import Solution
    from srm_mbs.dynamics.mechanism import Mechanism

STANDARD_OUTPUT = Path("-")
MOST_ROWS = 10_000_000
"""Of a table at equal times."""
Every = Annotated[
    float | None,
    option(
        "S",
        "Write a row of the table every S seconds instead.",
        show_default="the times of the run, mostly its steps",
    ),
]
Points = Annotated[
    list[str] | None,
    several(
        "--point",
        NAMED_POINT,
        "Add the motion of this point, by its name or of a link (m, in the link's frame), to "
        "the table.",
    ),
]


def check_table(path: Path | None, name: str) -> None:
    """Refuse the file of a table, given to the option ``name``, that cannot be written; ``-`` is
    standard output.

    Raises
    ------
    InputError
        As :func:`~srm_mbs.cli.output.check_output`.
    """
    check_output(None if path == STANDARD_OUTPUT else path, name, (".csv",))


def table_points(mechanism: Mechanism, given: list[str] | None) -> list[srm_mbs.Anchor | str]:
    """The points of ``--point``.

    Raises
    ------
    InputError
        If one is malformed, or the mechanism does not have it.
    """
    from srm_mbs.dynamics.point_motion import place_of

    points = points_or_names(given)
    for point in points:
        place_of(mechanism, point, "--point")
    return points


def equal_times(every: float, start: float, end: float) -> FloatArray:
    """Times (k,) s from ``start`` to ``end`` (s), ``every`` seconds apart.

    Raises
    ------
    InputError
        For an interval that is not positive, or more than :data:`MOST_ROWS` of them.
    """
    length = end - start
    if not every > 0.0 or length / every > MOST_ROWS:
        raise InputError(
            f"an interval of {every:g} s gives no table of {length:g} s",
            element="--every",
            remedy=f"Give at least {max(length, 1e-300) / MOST_ROWS:.1g} s",
        )
    import numpy as np

    count = int(length / every * (1.0 + 1e-12)) + 1
    # A last time that rounding moves beyond the end is the end.
    times: FloatArray = np.minimum(start + every * np.arange(count), end)
    return times


def print_table(
    solution: Solution,
    times: FloatArray | None,
    points: Sequence[srm_mbs.Anchor | str],
    reactions: bool = False,
) -> None:
    """Print the table that ``solution.to_csv`` writes."""
    from srm_mbs.simulation.csv_export import write_csv

    shown = solution if times is None else solution.at(times)
    write_csv(shown, PrintedLines(), points, reactions)


@reported
def csv(
    run: Run,
    out: Annotated[
        Path | None,
        option("FILE.csv", "Write the table to this file; - prints it.", show_default="RUN.csv"),
    ] = None,
    every: Every = None,
    points: Points = None,
    reactions: Annotated[
        bool, typer.Option("--reactions", help="Add the reactions of closures and joints.")
    ] = False,
) -> None:
    """Write the motion of a saved run as a table."""
    path = run.with_name(f"{run.stem}.csv") if out is None else out
    check_table(path, "--out")
    solution = srm_mbs.load_solution(run)
    added = table_points(solution.mechanism, points)
    times = None if every is None else equal_times(every, *solution.span)
    # Of a saved run with a controller there are none.
    with naming(file=str(run), element="--reactions"):
        if path == STANDARD_OUTPUT:
            print_table(solution, times, added, reactions)
        else:
            solution.to_csv(path, times, points=added, reactions=reactions)
            say_written(path)
