"""The command line ``srm-mbs``: every command calls the package and prints the result.

Slow imports are made inside the commands, so that ``srm-mbs --help`` answers at once.
Exit status: 0; 1 when a run or a search did not reach its end; 2 for bad input; 130 after Ctrl-C.
"""

from __future__ import annotations

import io
import json
import logging
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

# Before NumPy is loaded: for matrices of this size the threads of BLAS cost more than they gain.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

import srm_mbs
from srm_mbs.cli import analysis, motion_table, playback, plot_report
from srm_mbs.cli.model_file import ModelFile, named_numbers, reads_model
from srm_mbs.cli.output import (
    BAD_INPUT,
    HTML_SUFFIXES,
    RUN_FAILED,
    Html,
    Lines,
    check_output,
    echo,
    flush_output,
    option,
    reported,
    say,
    say_written,
    several,
    table,
    write_files,
)
from srm_mbs.errors import InputError

if TYPE_CHECKING:
    from srm_mbs.dynamics.mechanism import Mechanism

T_END, RTOL = 10.0, 1e-6
"""End time (s) and tolerance where neither the command nor the description gives one."""
HARNESS = Path("benchmarks", "work_precision", "__main__.py")
"""The benchmark in a checkout of the source."""

app = typer.Typer(
    name="srm-mbs",
    help="Simulate closed-loop mechanisms without drift and through singular configurations.",
    epilog="Exit status: 0; 1 if a run or a search did not reach its end; 2 for bad input.",
    no_args_is_help=True,
    add_completion=False,
    # Plain help and usage errors: rich would draw boxes into pipes, and eat "[simulation]".
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        echo(f"srm-mbs {srm_mbs.__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    context: typer.Context,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Log what is done on standard error.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    logger = logging.getLogger("srm_mbs")
    level, handler = logger.level, Lines()
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if verbose else logging.WARNING)

    def restore() -> None:
        logger.removeHandler(handler)
        logger.setLevel(level)

    context.call_on_close(restore)


@app.command()
@reported
@reads_model
def simulate(
    file: ModelFile,
    t_end: Annotated[
        float | None,
        option("S", "End of the run (s).", show_default=f"the description's, else {T_END:g}"),
    ] = None,
    method: Annotated[str, option("NAME", "Integration method.")] = "psrm",
    tableau: Annotated[
        str | None,
        option(
            "NAME",
            "Runge-Kutta scheme of the method; auto is dop853, and rodas5p where forces are stiff.",
            show_default="the method's: auto with psrm, tvd32 with srm",
        ),
    ] = None,
    rtol: Annotated[
        float | None,
        option(
            "R",
            "Relative tolerance, at most 1e-2 with psrm and auto (1e-3 with other tableaus, "
            "1e-4 with srm).",
            show_default="the description's, else 1e-6",
        ),
    ] = None,
    atol: Annotated[
        float | None,
        option(
            "A",
            "Absolute tolerance of every coordinate.",
            show_default="the description's, else rtol times the unit of each coordinate",
        ),
    ] = None,
    step: Annotated[
        float | None, option("H", "Fixed step (s) instead of step-size control.")
    ] = None,
    backend: Annotated[
        str, option("auto|python|kernel|generated", "Backend that computes the run.")
    ] = "auto",
    singular_tolerance: Annotated[
        float | None,
        option(
            "S",
            "Residual, over the size of the mechanism, up to which closures count as exactly "
            "singular; 0 follows the data.",
            show_default="1e-9",
        ),
    ] = None,
    out: Annotated[Path | None, option("RUN.npz", "Save the run, for plot, play and csv.")] = None,
    plot: Annotated[Path | None, option("FILE", "Plot the run as .png, .pdf or .svg.")] = None,
    csv: Annotated[
        Path | None,
        option(
            "FILE.csv",
            "Write the motion at the steps as a table; - prints it, and the summary on standard "
            "error.",
        ),
    ] = None,
    every: motion_table.Every = None,
    points: motion_table.Points = None,
    html: Html = None,
    image: playback.Image = None,
    at: playback.At = None,
    size: playback.Size = None,
    dpi: playback.Dpi = None,
    video: playback.Video = None,
    trace: playback.Trace = None,
    gaps: playback.Gaps = False,
    reactions: playback.Reactions = False,
    arrows: playback.Arrows = False,
    full_paths: Annotated[
        bool,
        typer.Option(
            "--full-paths", help="Name the folders of the mechanism's files in the saved run."
        ),
    ] = False,
    balance: Annotated[
        bool, typer.Option("--balance", help="Print the energy balance of the run.")
    ] = False,
    play: Annotated[bool, typer.Option("--play", help="Play the run in the browser.")] = False,
    live: playback.Live = False,
    base: Annotated[
        str | None, option("fixed|floating|planar", "Root joint instead of the file's.")
    ] = None,
    gravity: Annotated[
        str | None, option("X,Y,Z", "Gravity (m/s^2) instead of the file's, as 0,0,-1.62.")
    ] = None,
    q: Annotated[
        list[str] | None,
        several(
            "--q",
            "JOINT=VALUE",
            "Start with a joint at VALUE (rad, m; all coordinates of a ball as 0,0,0,1); "
            "the others close the loops.",
        ),
    ] = None,
    v: Annotated[
        list[str] | None,
        several(
            "--v",
            "JOINT=RATE",
            "Start with a joint at RATE (rad/s, m/s); with --q or --v other rates are the "
            "smallest that keep the loops closed.",
        ),
    ] = None,
    control: Annotated[
        list[str] | None,
        several(
            "--control",
            "ACTUATOR=VALUE",
            "Control an actuator: the force of a motor (N m, N), the position or rate of a servo. "
            "With it all actuators act, the others with 0.",
        ),
    ] = None,
) -> None:
    """Simulate a mechanism and print a summary of the run.

    A run that fails, or is interrupted with Ctrl-C, keeps everything computed so far: the files
    are written and the exit status is 1. Of an interrupted run singular passages are not counted.
    """
    from srm_mbs.analysis.summary import run_rows
    from srm_mbs.simulation.options import SINGULAR_TOLERANCE

    check_output(out, "--out", (".npz",))
    if plot is not None:
        from srm_mbs.visualization.plotting.figure import FORMATS

        check_output(plot, "--plot", FORMATS)
    motion_table.check_table(csv, "--csv")
    printed = csv == motion_table.STANDARD_OUTPUT
    check_output(html, "--html", HTML_SUFFIXES)
    picture = playback.image_options(image, at, size, dpi)
    playback.check_video(video)

    mechanism = _started(file.load(base=base, gravity=_vector(gravity, "--gravity")), q, v)
    overlays = playback.overlay_options(mechanism, trace, gaps, reactions, arrows)
    playback.check_overlays(trace, gaps, reactions, arrows, (html, image, video, play, live))
    for element, given, about, path, needed in (
        ("--point", points, "table of the motion", csv, "--csv"),
        ("--every", every is not None, "table of the motion", csv, "--csv"),
        ("--full-paths", full_paths, "saved run", out, "--out"),
    ):
        if given and path is None:
            raise InputError(
                f"it is about the {about}, and none is asked for",
                element=element,
                remedy=f"Give {needed} too",
            )
    added = motion_table.table_points(mechanism, points)
    defaults = mechanism.defaults
    t_end = _first(t_end, defaults.t_end, T_END)
    playback.check_time(at, t_end)
    if every is not None:
        motion_table.equal_times(every, 0.0, t_end)
    controller = None
    if control:
        controls = named_numbers(control, "--control", "actuator", "hip")
        controller = srm_mbs.actuator_controller(mechanism, controls)
    view = playback.live_view(mechanism) if live else None
    solution = srm_mbs.simulate(
        mechanism,
        t_end,
        controller=controller,
        method=method,
        tableau=tableau,
        rtol=_first(rtol, defaults.rtol, RTOL),
        atol=defaults.atol if atol is None else atol,
        step=step,
        progress=True if view is None else view,
        backend=backend,
        singular_tolerance=_first(singular_tolerance, None, SINGULAR_TOLERANCE),
    )
    times = None if every is None else motion_table.equal_times(every, *solution.span)
    written, failed = write_files(
        [
            (out, partial(solution.save, full_paths=full_paths)),
            (plot, solution.plot),
            (None if printed else csv, partial(solution.to_csv, t=times, points=added)),
            (html, partial(solution.export_html, **overlays)),
            (image, partial(solution.export_image, **picture, **overlays)),
            (video, partial(solution.export_video, progress=True, **overlays)),
        ]
    )
    rows = run_rows(solution, passages=solution.status != "interrupted")
    if printed:
        motion_table.print_table(solution, times, added)
    table([*rows, *(("written", str(path)) for path in written)], err=printed)
    if balance:
        from srm_mbs.cli.tables import balance_rows

        table(balance_rows(solution.energy_balance), err=printed)
    echo(solution.message, err=printed or not solution.success)
    if play or view:
        playback.play_run(solution, overlays, view)
    if failed:
        raise typer.Exit(BAD_INPUT)
    if not solution.success:
        raise typer.Exit(RUN_FAILED)


def _vector(text: str | None, element: str) -> list[float] | None:
    """The numbers of ``X,Y,Z``; None without a text."""
    try:
        return None if text is None else [float(number) for number in text.split(",")]
    except ValueError:
        raise InputError(
            f"{text!r} is not a vector", element=element, remedy="Write 0,0,-9.81"
        ) from None


def _started(mechanism: Mechanism, q: list[str] | None, v: list[str] | None) -> Mechanism:
    """``mechanism``, started with joints at the values of ``--q`` and ``--v``."""
    if not (q or v):
        return mechanism
    given = []
    for texts, element in ((q, "--q"), (v, "--v")):
        values, bare = analysis.joint_values(texts, element)
        if bare:
            raise analysis.value_wanted(f"joint {bare[0]!r} has no value", element)
        given.append({name: n[0] if len(n) == 1 else n for name, n in values.items()} or None)
    analysis.doubt_angles(mechanism, "--q", given[0] or {})
    start = srm_mbs.assemble(mechanism, *given)
    return mechanism.with_state(start.q, start.v)


def _first(*values: float | None) -> float:
    """The first value that is not None."""
    return next(value for value in values if value is not None)


@app.command()
@reported
@reads_model
def convert(
    file: ModelFile,
    out: Annotated[
        Path, typer.Argument(metavar="OUT.toml", help="The description; its URDF goes beside it.")
    ],
    cut: Annotated[list[str] | None, several("--cut", "JOINT", "Cut a loop at this joint.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
) -> None:
    """Write a file of any format as a TOML description and a URDF."""
    from srm_mbs.formats.convert import convert as write

    *written, notes = write(file.model, out, cut=cut or (), force=force, **file.options())
    for path in written:
        say_written(path)
    for note in notes:
        echo(f"note: {note}")


@app.command()
@reported
@reads_model
def info(file: ModelFile) -> None:
    """Describe a mechanism: joints, loops, forces, the start.

    With its size and mass, its degrees of freedom, the rank of its closure rows, the rows that are
    redundant, what is stiff, and its drives and actuators.  Of a saved run (.npz) first a summary,
    with the residuals of the singular configurations it met.
    """
    from srm_mbs._kernel import missing, remedy
    from srm_mbs.analysis.summary import (
        actuator_rows,
        drive_rows,
        force_rows,
        joint_rows,
        loop_rows,
        mechanism_rows,
        run_rows,
        stiff_rows,
    )

    if Path(file.model).suffix == ".npz":
        solution = srm_mbs.load_solution(file.model, allow_outside=file.allow_outside)
        table(run_rows(solution))
        echo("")
        mechanism = solution.mechanism
    else:
        mechanism = file.load()
    table(mechanism_rows(mechanism))
    for header, rows in (
        (("joint", "type", "initial position", "initial rate"), joint_rows(mechanism)),
        (("loop", "type", "a", "b", "gap at the start"), loop_rows(mechanism)),
        (("force", "type", "acts on", "values"), force_rows(mechanism)),
        (("drive", "law", "moves", "values"), drive_rows(mechanism)),
        (("actuator", "type", "joint", "values"), actuator_rows(mechanism)),
        (("stiff", "coefficient", "time constant"), stiff_rows(mechanism)),
    ):
        if listed := list(rows):
            echo("")
            table(listed, header)
    notes = [*mechanism.notes, *mechanism.structure.notes]
    if missing:
        notes.append(f"the compiled kernel is not available: {missing}. {remedy}")
    if notes:
        echo("")
    for note in notes:
        echo(f"note: {note}")


@app.command(name="compile")
@reported
@reads_model
def compile_model(
    file: ModelFile,
    source: Annotated[
        bool, typer.Option("--source", help="Print the C instead of compiling it.")
    ] = False,
) -> None:
    """Compile code for one mechanism.

    Runs of this mechanism, and of others of its topology, use it from then on.  It needs a C
    compiler: cc, that of the environment variable CC, or the Python package ziglang.  The code
    stays in the cache of the user: srm-mbs cache shows where.
    """
    from srm_mbs.integration.generated.code import generated_source

    mechanism = file.load()
    if source:
        for line in generated_source(mechanism).splitlines():
            echo(line)
        return
    made = srm_mbs.compile(mechanism)
    how = f"compiled in {made.seconds:.2f} s" if made.seconds else "in the cache"
    echo(f"{mechanism.name}: {made.operations} operations, {how}")
    if made.path is None:
        echo("note: the code could not be kept; --verbose says why")


@app.command()
@reported
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all compiled code.")] = False,
) -> None:
    """Show where compiled code of mechanisms lies, or remove it."""
    from srm_mbs.integration.generated import code_cache

    count, size = code_cache.clear() if clear else code_cache.contents()
    rows = [
        ("folder", str(code_cache.cache_folder())),
        ("removed" if clear else "compiled mechanisms", f"{count}"),
        ("size", f"{size / 1e6:.2f} MB"),
    ]
    table(rows)


@app.command()
@reported
def models() -> None:
    """List the mechanisms that come with the package."""
    from srm_mbs.formats.load import largest_n, models_folder

    folder = models_folder()
    table((name, _first_sentence(folder / f"{name}.toml")) for name in srm_mbs.bundled_models())
    echo(f"n_four_bar_<N> is made for any N up to {largest_n()}.")


def _first_sentence(path: Path) -> str:
    """The first sentence of the comment at the top of a description."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comment = takewhile(lambda line: line.startswith("#"), lines)
    text = " ".join(line.removeprefix("#").strip() for line in comment)
    # The full stop of an initial ("C. B. Macdonald") ends no sentence.
    return re.split(r"(?<!\b[A-Z])\.(?:\s|$)", text, maxsplit=1)[0]


for command in (
    *(playback.play, plot_report.plot, motion_table.csv, plot_report.report),
    *(analysis.modes, analysis.equilibrium, analysis.linearise, analysis.linkage, analysis.drag),
):
    app.command()(command)


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    options_metavar="--out DIR [--problems NAME ...] [--peers NAME ...] [--backend python]",
    add_help_option=False,
)
@reported
def benchmark(context: typer.Context) -> None:
    """Compare run time and error with other simulators.

    In the checkout that the package comes from only, and with the compiled kernel unless --backend
    python asks for the Python reference.  The options are those of
    'python -m benchmarks.work_precision'.
    """
    folder = Path.cwd()
    if not _is_checkout(folder):
        if "--help" in context.args:
            typer.echo(context.get_help())
            raise typer.Exit
        raise InputError(
            "the benchmark is not installed with the package, and this folder is not the checkout "
            "that the package comes from",
            file=str(HARNESS),
            element="benchmark",
            remedy="Run it at the top of a checkout of the source, after 'pip install .' there",
        )
    # A new process, which reads the number of threads before it loads NumPy.  It finds the modules
    # of the checkout before those of other folders.
    arguments = [sys.executable, "-m", "benchmarks.work_precision", *context.args]
    settings = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    done = subprocess.run(arguments, cwd=folder, env=settings, check=False)
    raise typer.Exit(done.returncode)


def _is_checkout(folder: Path) -> bool:
    """Whether a folder is the checkout that this package runs in or was installed from.

    It has the package and the benchmark as regular packages, which precede those of the same name
    in other folders.  Names alone would not do: any folder may have them.
    """
    needed = (HARNESS, Path("benchmarks", "__init__.py"), HARNESS.with_name("__init__.py"))
    own = (Path(srm_mbs.__file__).parents[1], *_installed_from())
    return any(place.is_dir() and place.samefile(folder) for place in own) and all(
        (folder / file).is_file() for file in (*needed, Path("srm_mbs", "__init__.py"))
    )


def _installed_from() -> Iterator[Path]:
    """Folders from which the package was installed (PEP 610)."""
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    from srm_mbs._kernel.build_hash import installation_records

    for record in installation_records(sys.path):
        origin = json.loads(record) if record else {}
        if "dir_info" in origin:
            yield Path(url2pathname(urlsplit(origin["url"]).path))


def main() -> None:
    """Entry point of the console script; nothing that a user gives or does shows a traceback."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # What the terminal has no code for is shown escaped.
            stream.reconfigure(errors="backslashreplace")
    try:
        app(prog_name="srm-mbs")
    except OSError as error:  # of help texts; commands report their own
        say("error", error.strerror or error)
        raise SystemExit(BAD_INPUT) from error
    finally:
        flush_output()
