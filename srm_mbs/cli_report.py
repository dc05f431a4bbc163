"""The command ``report``: one page about a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import srm_mbs
from srm_mbs.cli_output import Run, check_output, reported, table
from srm_mbs.errors import InputError


@reported()
def report(
    run: Run,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.html",
            help="Write the page to this file.",
            show_default="RUN_report.html",
        ),
    ] = None,
    no_animation: Annotated[
        bool,
        typer.Option("--no-animation", help="Leave out the animation: a small file."),
    ] = False,
    rtol: Annotated[
        float | None,
        typer.Option(
            metavar="R",
            help="Relative tolerance of the second run, for the error estimate; runs with fixed "
            "steps are made again with smaller ones.",
            show_default="a hundredth of the run's",
        ),
    ] = None,
    no_second_run: Annotated[
        bool,
        typer.Option("--no-second-run", help="Leave out the second run and the error estimate."),
    ] = False,
) -> None:
    """Write one page about a saved run.

    It has the mechanism, motion, settings, accuracy and plots.  The run is made again at tighter
    tolerances, to estimate its error.
    """
    from srm_mbs.report import write_report

    path = run.with_name(f"{run.stem}_report.html") if out is None else out
    check_output(path, "--out", (".html", ".htm"))
    if no_second_run and rtol is not None:
        raise InputError(
            "it is the tolerance of the second run, which --no-second-run leaves out",
            element="--rtol",
            remedy="Leave out one of the two",
        )
    solution = srm_mbs.load_solution(run)
    if not no_second_run:
        typer.echo("making the run again, to estimate its error", err=True)
    certificate = srm_mbs.certify(solution, rtol=rtol, again=not no_second_run, progress=True)
    write_report(solution, path, animation=not no_animation, certificate=certificate)
    table((found.topic, found.grade, found.text) for found in certificate.findings)
    typer.echo(f"written: {path}")
