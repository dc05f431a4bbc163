"""The commands ``modes``, ``equilibrium``, ``linearise``, ``linkage`` and ``drag``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import srm_mbs
from srm_mbs.cli.model_file import ModelFile, reads_model
from srm_mbs.cli.output import (
    HTML_SUFFIXES,
    RUN_FAILED,
    Html,
    check_output,
    echo,
    option,
    reported,
    say_written,
    several,
    table,
)
from srm_mbs.cli.playback import Trace, given_points
from srm_mbs.errors import InputError, warn

if TYPE_CHECKING:
    from srm_mbs.dynamics.mechanism import Mechanism
    from srm_mbs.visualization.animation.joint_motion import JointMotion

Hold = Annotated[
    list[str] | None,
    several("--hold", "JOINT[=VALUE]", "Keep a joint at VALUE (rad, m), or where it starts."),
]


def value_wanted(problem: str, element: str) -> InputError:
    """The error about a joint without a value in the option or argument ``element``."""
    unit = "rad/s or m/s" if element == "--v" else "rad or m"
    return InputError(problem, element=element, remedy=f"Write crank=1.5, in {unit}")


def doubt_angles(mechanism: Mechanism, element: str, values: Mapping[str, Any]) -> None:
    """Warn of positions, joint -> value, in ``element`` that may be in degrees."""
    from srm_mbs.formats.plausibility import doubtful_angles

    for doubt in doubtful_angles(mechanism, element, values, None):
        warn(doubt)


def joint_values(given: list[str] | None, element: str) -> tuple[dict[str, list[float]], list[str]]:
    """Joints with values (``JOINT=VALUE,...``), and those without."""
    values: dict[str, list[float]] = {}
    names = []
    for text in given or []:
        name, equals, numbers = text.partition("=")
        if name in values or name in names:
            raise InputError(
                f"joint {name!r} is given twice", element=element, remedy="Give each joint once"
            )
        if not equals:
            names.append(name)
            continue
        try:
            values[name] = [float(number) for number in numbers.split(",")]
        except ValueError:
            raise value_wanted(f"{text!r} is not a joint with a value", element) from None
    return values, names


def _held(mechanism: Mechanism, given: list[str] | None) -> tuple[dict[str, float], list[str]]:
    """Positions of the held joints that have one, and all their names."""
    values, names = joint_values(given, "--hold")
    if any(len(numbers) > 1 for numbers in values.values()):
        raise InputError("a held joint takes one value", element="--hold", remedy="Give one value")
    positions = {name: numbers[0] for name, numbers in values.items()}
    doubt_angles(mechanism, "--hold", positions)
    return positions, [*positions, *names]


def _write_page(html: Path | None, motion: Callable[[], JointMotion]) -> None:
    if html is not None:
        motion().export_html(html)
        say_written(html)


@reported
@reads_model
def modes(
    file: ModelFile,
    hold: Hold = None,
    starts: Annotated[
        int, option("N", "Number of configurations from which closing starts.")
    ] = 200,
    seed: Annotated[int, option("N", "Seed of the random ones among them.")] = 0,
) -> None:
    """List the assembly modes, the ways in which loops close.

    Without --hold as many joints as there are degrees of freedom keep their initial position.
    """
    from srm_mbs.cli.tables import mode_rows

    mechanism = file.load()
    positions, names = _held(mechanism, hold)
    found = srm_mbs.assembly_modes(
        mechanism,
        positions if hold else None,
        hold=names if hold else None,
        starts=starts,
        seed=seed,
    )
    if not found:
        echo("no closed configuration was found", err=True)
        raise typer.Exit(RUN_FAILED)
    echo(f"held: {', '.join(found[0].held) or 'no joint'}")
    table(mode_rows(mechanism, found), ("mode", "found", "", *mechanism.joint_names))


@reported
@reads_model
def equilibrium(
    file: ModelFile,
    hold: Hold = None,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="Find the nearest one, stable or not.")
    ] = False,
) -> None:
    """Find a static equilibrium.

    Prints positions, stability, holding forces and reactions.
    """
    from srm_mbs.cli.tables import equilibrium_rows, position_rows

    mechanism = file.load()
    positions, names = _held(mechanism, hold)
    found = srm_mbs.equilibrium(
        mechanism, positions, hold=names, search="nearest" if nearest else "stable"
    )
    table(equilibrium_rows(mechanism, found))
    echo("")
    table(position_rows(mechanism, found.q), ("joint", "position", ""))


@reported
@reads_model
def linearise(
    file: ModelFile,
    at: Annotated[
        str,
        option(
            "initial|rest|equilibrium|nearest",
            "Where: the initial state, the initial configuration at rest, a stable "
            "equilibrium, or the nearest one.",
        ),
    ] = "initial",
    actuated: Annotated[
        list[str] | None,
        several(
            "--input", "JOINT", "Joint whose force is an input of B.", show_default="all joints"
        ),
    ] = None,
    coordinate: Annotated[
        list[str] | None,
        several("--coordinate", "JOINT", "Joint that is a coordinate.", show_default="chosen"),
    ] = None,
    mode: Annotated[
        int | None, option("N", "Mode that --html shows.", min=0, show_default="0")
    ] = None,
    html: Html = None,
) -> None:
    """Linearise a mechanism: A, B, eigenvalues and mode shapes."""
    from srm_mbs.cli.tables import eigenvalue_rows, matrix_rows, state_names
    from srm_mbs.model.coordinates import coordinate_names

    if mode is not None and html is None:
        raise InputError(
            "there is no page that could show it",
            element="--mode",
            remedy="Give --html, or leave it out",
        )
    check_output(html, "--html", HTML_SUFFIXES)
    mechanism = file.load()
    state = _state(mechanism, at)
    found = srm_mbs.linearise(mechanism, *state, inputs=actuated, coordinates=coordinate)
    inputs = (f"force of {name}" for name in found.inputs)
    table(matrix_rows(found), ("", *state_names(found), *inputs, "drift"))
    echo("")
    header = ("mode", "eigenvalue 1/s", "frequency Hz", "damping")
    table(eigenvalue_rows(found), (*header, *coordinate_names(mechanism)))
    _write_page(html, lambda: found.mode_shape(mode or 0))


def _state(mechanism: Mechanism, at: str) -> tuple[Any, ...]:
    if at == "initial":
        return ()
    if at == "rest":
        return (mechanism.q0,)
    if at in ("equilibrium", "nearest"):
        search: Any = "nearest" if at == "nearest" else "stable"
        return (srm_mbs.equilibrium(mechanism, search=search).q,)
    raise InputError(
        f"there is no state {at!r}",
        element="--at",
        remedy="Known: initial, rest, equilibrium, nearest",
    )


@reported
@reads_model
def linkage(
    file: ModelFile,
    crank: Annotated[str, option("JOINT", "Joint that drives the linkage.")],
    plot: Annotated[
        Path | None, option("FILE", "Draw the report over the crank as .png, .pdf or .svg.")
    ] = None,
    kinematics: Annotated[
        Path | None,
        option("FILE.html", "Write a page in which the crank is turned by hand."),
    ] = None,
    trace: Trace = None,
) -> None:
    """Analyse a linkage over a turn of its crank.

    Prints limit positions, dead points, strokes and time ratios, and of four-bars and slider-cranks
    the transmission angle and the Grashof class. Where the page of --kinematics passes singular
    configurations, from where the motion does not follow from the crank, it prints these instead.
    """
    check_output(kinematics, "--kinematics", HTML_SUFFIXES)
    if trace and kinematics is None:
        raise InputError(
            "it is drawn in the page, and none is asked for",
            element="--trace",
            remedy="Give --kinematics too",
        )
    if plot is not None:
        from srm_mbs.visualization.plotting.figure import FORMATS

        check_output(plot, "--plot", FORMATS)
    mechanism = file.load()
    motion = None
    if kinematics is not None:
        points = given_points(trace or [], "--trace")
        motion = srm_mbs.kinematics(mechanism, crank)
        motion.export_html(kinematics, trace=points)
        say_written(kinematics)
        if motion.singular_positions and plot is None:
            table(motion.rows())
            return
    found = srm_mbs.linkage_report(mechanism, crank)
    table(found.rows())
    if plot is not None:
        found.plot(plot)
        say_written(plot)


@reported
@reads_model
def drag(
    file: ModelFile,
    values: Annotated[
        list[str],
        typer.Argument(
            metavar="JOINT=VALUE[,VALUE...]", help="Joint and the positions to go to (rad, m)."
        ),
    ],
    html: Html = None,
    duration: Annotated[float, option("S", "Length of the animation (s).")] = 3.0,
) -> None:
    """Drag joints through positions, on one branch.

    The exit status is 1 where they go no further.
    """
    from srm_mbs.cli.tables import path_rows, position_rows

    check_output(html, "--html", HTML_SUFFIXES)
    mechanism = file.load()
    targets, bare = joint_values(values, "JOINT=VALUE")
    if bare:
        raise value_wanted(f"joint {bare[0]!r} has no value", "JOINT=VALUE")
    doubt_angles(mechanism, "JOINT=VALUE", {n: p[0] for n, p in targets.items() if len(p) == 1})
    found = srm_mbs.follow(mechanism, targets)
    table(path_rows(found))
    echo("")
    table(
        position_rows(mechanism, found.q[-1] if found.complete else found.path[-1]),
        ("joint", "position", ""),
    )
    _write_page(html, lambda: found.motion(duration))
    if not found.complete:
        raise typer.Exit(RUN_FAILED)
