"""The commands ``plot`` and ``report``, for saved runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

import srm_mbs
from srm_mbs.cli.output import (
    HTML_SUFFIXES,
    AllowOutside,
    Run,
    check_output,
    echo,
    option,
    reported,
    say_written,
    several,
    table,
)
from srm_mbs.cli.playback import NAMED_POINT, points_or_names
from srm_mbs.errors import InputError


@reported
def plot(
    run: Run,
    out: Annotated[
        Path | None,
        option(
            "FILE",
            "Write the picture to this .png, .pdf or .svg.",
            show_default="RUN.png, or RUN_KIND.png for other kinds than run",
        ),
    ] = None,
    kind: Annotated[
        str,
        option(
            "KIND",
            "Kind of picture: run (drift, energy, sigma, steps), state (joints over time), "
            "balance (energies and works), reactions, sigma (with all kinds of steps), phase (rate "
            "over position), path (of points in space), point (their motion over time), poses "
            "(of the mechanism, in one picture).",
        ),
    ] = "run",
    joints: Annotated[
        list[str] | None,
        several("--joint", "NAME", "Draw this joint, with state, phase and reactions."),
    ] = None,
    loops: Annotated[
        list[str] | None, several("--loop", "NAME", "Draw this closure, with reactions.")
    ] = None,
    rows: Annotated[
        bool, typer.Option("--rows", help="Draw the multiplier of each row, with reactions.")
    ] = False,
    points: Annotated[
        list[str] | None,
        several(
            "--point",
            NAMED_POINT,
            "Draw this point, by its name or of a link (m, in the link's frame), with path, point "
            "and poses.",
        ),
    ] = None,
    accelerations: Annotated[
        bool, typer.Option("--accelerations", help="Draw accelerations, too, with state.")
    ] = False,
    x: Annotated[
        str | None,
        typer.Option(
            "--x",
            metavar="JOINT",
            help="Draw over this joint instead of time, with state, reactions and point.",
        ),
    ] = None,
    unit: Annotated[
        str | None,
        option("rad|deg|m|mm", "Unit of that joint, or of poses.", show_default="rad, m"),
    ] = None,
    at: Annotated[
        str | None,
        option(
            "T,T,...",
            "Times (s) of poses; with --crank its positions (degrees, m).",
            show_default="six, evenly spaced",
        ),
    ] = None,
    crank: Annotated[
        str | None, typer.Option("--crank", metavar="JOINT", help="Joint of --at, with poses.")
    ] = None,
    view: Annotated[
        str | None,
        option(
            "x|y|z|X,Y,Z",
            "Direction of view, with poses.",
            show_default="across the plane of motion",
        ),
    ] = None,
    title: Annotated[
        str | None, option("TEXT", "Title of the picture.", show_default="that of the run")
    ] = None,
    size: Annotated[
        str | None,
        option(
            "column|page|WIDTH,HEIGHT",
            "Size of the picture (inch): 3.5 wide for a column, 7 for a page.",
            show_default="that of the kind",
        ),
    ] = None,
    dpi: Annotated[
        float | None, option("N", "Dots per inch of a .png.", show_default="200")
    ] = None,
) -> None:
    """Draw a picture of a saved run."""
    from srm_mbs.visualization.plotting import check_options
    from srm_mbs.visualization.plotting.figure import FORMATS

    wanted: dict[str, Any] = {
        "joints": joints,
        "loops": loops,
        "rows": rows,
        "points": points_or_names(points),
        "accelerations": accelerations,
        "x": x,
        "unit": unit,
        "at": _numbers(at),
        "crank": crank,
        "view": _numbers(view),
        "title": title,
        "size": _numbers(size),
        "dpi": dpi,
    }
    # A number or a text that was given counts, zero and empty too.
    options: dict[str, Any] = {
        name: value for name, value in wanted.items() if value or isinstance(value, float | str)
    }
    check_options(kind, options)
    solution = srm_mbs.load_solution(run)
    name = run.stem if kind == "run" else f"{run.stem}_{kind}"
    path = run.with_name(f"{name}.png") if out is None else out
    check_output(path, "--out", FORMATS)
    solution.plot(path, kind, **options)
    say_written(path)


def _numbers(text: str | None) -> list[float] | str | None:
    """The numbers between commas in ``text``, or itself where it is something else."""
    try:
        return None if text is None else [float(number) for number in text.split(",")]
    except ValueError:
        return text


@reported
def report(
    run: Run,
    out: Annotated[
        Path | None,
        option("OUT.html", "Write the page to this file.", show_default="RUN_report.html"),
    ] = None,
    no_animation: Annotated[
        bool,
        typer.Option("--no-animation", help="Leave out the animation: a small file."),
    ] = False,
    rtol: Annotated[
        float | None,
        option(
            "R",
            "Relative tolerance of the second run, for the error estimate; runs with fixed "
            "steps are repeated with smaller ones.",
            show_default="a hundredth of the run's",
        ),
    ] = None,
    no_second_run: Annotated[
        bool,
        typer.Option("--no-second-run", help="Leave out the second run and the error estimate."),
    ] = False,
    allow_outside: AllowOutside = False,
    full_paths: Annotated[
        bool,
        typer.Option("--full-paths", help="Name the folders of the mechanism's files in the page."),
    ] = False,
) -> None:
    """Write one page about a saved run.

    It has the mechanism, motion, settings, accuracy and plots.  The run is repeated at tighter
    tolerances, to estimate its error.
    """
    from srm_mbs.analysis.report.report import write_report

    path = run.with_name(f"{run.stem}_report.html") if out is None else out
    check_output(path, "--out", HTML_SUFFIXES)
    if no_second_run and rtol is not None:
        raise InputError(
            "it is the tolerance of the second run, which --no-second-run leaves out",
            element="--rtol",
            remedy="Leave out one of the two",
        )
    solution = srm_mbs.load_solution(run, allow_outside=allow_outside)
    if not no_second_run:
        echo("repeating the run, to estimate its error", err=True)
    certificate = srm_mbs.certify(solution, rtol=rtol, again=not no_second_run, progress=True)
    write_report(
        solution,
        path,
        animation=not no_animation,
        certificate=certificate,
        full_paths=full_paths,
    )
    table((found.topic, found.grade, found.text) for found in certificate.findings)
    say_written(path)
