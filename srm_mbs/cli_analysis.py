"""The commands around the simulation: assembly modes, equilibria, linearisation, dragging."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import srm_mbs
from srm_mbs.cli_output import RUN_FAILED, Model, check_output, reported, table
from srm_mbs.errors import InputError

if TYPE_CHECKING:
    from srm_mbs.mechanism import Mechanism
    from srm_mbs.motion import JointMotion

Hold = Annotated[
    list[str] | None,
    typer.Option(
        "--hold",
        metavar="JOINT[=VALUE]",
        help="Keep a joint at VALUE (rad, m), or where it starts. May be given several times.",
    ),
]
Html = Annotated[
    Path | None, typer.Option(metavar="FILE.html", help="Write the animation as one page.")
]


def _values(given: list[str] | None, option: str) -> tuple[dict[str, list[float]], list[str]]:
    """Joints with values (``JOINT=VALUE,...``), and those without."""
    values: dict[str, list[float]] = {}
    names = []
    for text in given or []:
        name, equals, numbers = text.partition("=")
        if not equals:
            names.append(name)
            continue
        try:
            values[name] = [float(number) for number in numbers.split(",")]
        except ValueError:
            raise InputError(
                f"{text!r} is no joint with a value", element=option, remedy="Write crank=1.5"
            ) from None
    return values, names


def _held(given: list[str] | None) -> tuple[dict[str, float], list[str]]:
    """Positions of the held joints that have one, and all their names."""
    values, names = _values(given, "--hold")
    if any(len(numbers) > 1 for numbers in values.values()):
        raise InputError("a held joint takes one value", element="--hold", remedy="Give one")
    positions = {name: numbers[0] for name, numbers in values.items()}
    return positions, [*positions, *names]


def _write_page(html: Path | None, motion: Callable[[], JointMotion]) -> None:
    if html is not None:
        motion().export_html(html)
        typer.echo(f"written: {html}")


@reported()
def modes(
    model: Model,
    hold: Hold = None,
    starts: Annotated[
        int, typer.Option(metavar="N", help="Configurations from which closing starts.")
    ] = 200,
    seed: Annotated[int, typer.Option(metavar="N", help="Of the random ones.")] = 0,
) -> None:
    """List the assembly modes of a mechanism: the ways in which its loops close.

    Without --hold as many joints as there are degrees of freedom keep their initial position.
    """
    from srm_mbs.findings import mode_rows

    mechanism = srm_mbs.load(model)
    positions, names = _held(hold)
    found = srm_mbs.assembly_modes(
        mechanism,
        positions if hold else None,
        hold=names if hold else None,
        starts=starts,
        seed=seed,
    )
    if not found:
        typer.echo("no closed configuration was found", err=True)
        raise typer.Exit(RUN_FAILED)
    typer.echo(f"held: {', '.join(found[0].held) or 'no joint'}")
    table(mode_rows(mechanism, found), ("mode", "found", "", *mechanism.joint_names))


@reported()
def equilibrium(
    model: Model,
    hold: Hold = None,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="The nearest one, stable or not.")
    ] = False,
) -> None:
    """Find a static equilibrium and print positions, stability, holding forces and reactions."""
    from srm_mbs.findings import equilibrium_rows, position_rows

    mechanism = srm_mbs.load(model)
    positions, names = _held(hold)
    found = srm_mbs.equilibrium(
        mechanism, positions, hold=names, search="nearest" if nearest else "stable"
    )
    table(equilibrium_rows(found))
    typer.echo()
    table(position_rows(mechanism, found.q), ("joint", "position"))


@reported()
def linearise(
    model: Model,
    at: Annotated[
        str,
        typer.Option(
            metavar="initial|rest|equilibrium|nearest",
            help="The initial state, the initial configuration at rest, or an equilibrium "
            "(stable, or the nearest).",
        ),
    ] = "initial",
    actuated: Annotated[
        list[str] | None,
        typer.Option("--input", metavar="JOINT", help="Input of B. Default: all joints."),
    ] = None,
    coordinate: Annotated[
        list[str] | None,
        typer.Option(metavar="JOINT", help="Joint that is a coordinate. Default: chosen."),
    ] = None,
    mode: Annotated[int, typer.Option(metavar="N", help="Mode that --html shows.")] = 0,
    html: Html = None,
) -> None:
    """Linearise a mechanism: A, B, eigenvalues and mode shapes."""
    from srm_mbs.coordinates import coordinate_names
    from srm_mbs.findings import eigenvalue_rows, matrix_rows, state_names

    if html is not None:
        check_output(html, "--html", (".html", ".htm"))
    mechanism = srm_mbs.load(model)
    state = _state(mechanism, at)
    found = srm_mbs.linearise(mechanism, *state, inputs=actuated, coordinates=coordinate)
    inputs = (f"force of {name}" for name in found.inputs)
    table(matrix_rows(found), ("", *state_names(found), *inputs, "drift"))
    typer.echo()
    header = ("mode", "eigenvalue 1/s", "frequency Hz", "damping")
    table(eigenvalue_rows(found), (*header, *coordinate_names(mechanism)))
    _write_page(html, lambda: found.mode_shape(mode))


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
        remedy="Give initial, rest, equilibrium or nearest",
    )


@reported()
def drag(
    model: Model,
    values: Annotated[
        list[str],
        typer.Argument(metavar="JOINT=VALUE[,VALUE...]", help="Positions to go to (rad, m)."),
    ],
    html: Html = None,
    duration: Annotated[
        float, typer.Option(metavar="S", help="Length of the animation (s).")
    ] = 3.0,
) -> None:
    """Drag joints through positions on one branch; exit status 1 where they go no further."""
    from srm_mbs.findings import path_rows, position_rows

    if html is not None:
        check_output(html, "--html", (".html", ".htm"))
    mechanism = srm_mbs.load(model)
    targets, bare = _values(values, "JOINT=VALUE")
    if bare:
        raise InputError(
            f"joint {bare[0]!r} has no value", element="JOINT=VALUE", remedy="Write crank=1.5"
        )
    found = srm_mbs.follow(mechanism, targets)
    table(path_rows(found))
    typer.echo()
    table(
        position_rows(mechanism, found.q[-1] if found.complete else found.path[-1]),
        ("joint", "position"),
    )
    _write_page(html, lambda: found.motion(duration))
    if not found.complete:
        raise typer.Exit(RUN_FAILED)
