"""The command ``plot``: pictures of a saved run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

import srm_mbs
from srm_mbs.cli_output import Run, check_output, reported
from srm_mbs.cli_playback import given_points
from srm_mbs.errors import InputError

OPTIONS = {"joints": "--joint", "loops": "--loop", "rows": "--rows", "points": "--point"}
"""Options of a picture in Python, and here."""


@reported()
def plot(
    run: Run,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the picture to this .png, .pdf or .svg.",
            show_default="RUN.png, or RUN_KIND.png for other kinds than run",
        ),
    ] = None,
    kind: Annotated[
        str,
        typer.Option(
            metavar="KIND",
            help="Kind of picture: run (drift, energy, sigma, steps), state (joints over time), "
            "balance (energies and works), reactions, sigma (with all kinds of steps), phase (rate "
            "over position), path (of points in space).",
        ),
    ] = "run",
    joint: Annotated[
        list[str] | None,
        typer.Option(
            "--joint",
            metavar="NAME",
            help="Draw this joint, with state and phase. May be given several times.",
        ),
    ] = None,
    loop: Annotated[
        list[str] | None,
        typer.Option(
            "--loop",
            metavar="NAME",
            help="Draw this closure, with reactions. May be given several times.",
        ),
    ] = None,
    rows: Annotated[
        bool, typer.Option("--rows", help="Draw the multiplier of each row, with reactions.")
    ] = False,
    point: Annotated[
        list[str] | None,
        typer.Option(
            "--point",
            metavar="LINK:X,Y,Z",
            help="Draw this point of a link (m, in the link's frame), with path. "
            "May be given several times.",
        ),
    ] = None,
) -> None:
    """Draw a picture of a saved run."""
    from srm_mbs.plotting import FORMATS, check_options

    wanted: dict[str, Any] = {
        "joints": joint,
        "loops": loop,
        "rows": rows or None,
        "points": given_points(point, "--point") if point else None,
    }
    options = {name: value for name, value in wanted.items() if value is not None}
    try:
        check_options(kind, options)
        solution = srm_mbs.load_solution(run)
        path = out
        if path is None:
            name = run.stem if kind == "run" else f"{run.stem}_{kind}"
            path = run.with_name(f"{name}.png")
        check_output(path, "--out", FORMATS)
        solution.plot(path, kind, **options)
    except InputError as error:
        if error.element in ("kind", *OPTIONS):
            error.element = OPTIONS.get(error.element, "--kind")
        raise
    typer.echo(f"written: {path}")
