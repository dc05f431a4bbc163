"""The model file of a command, and the options with which it is read."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

import srm_mbs
from srm_mbs.cli.output import AllowOutside, option, several
from srm_mbs.errors import InputError

if TYPE_CHECKING:
    from srm_mbs.dynamics.mechanism import Mechanism

Model = Annotated[
    str,
    typer.Argument(
        metavar="MODEL",
        help="A bundled mechanism (see 'srm-mbs models'), a .toml description, or a file of "
        "another format, recognised by its content (docs/formats.md).",
    ),
]
Keyframe = Annotated[
    str | None,
    typer.Option("--keyframe", metavar="NAME", help="Start in this keyframe of an MJCF file."),
]
Massless = Annotated[
    str | None,
    option(
        "fix|MASS,INERTIA",
        "Moving ends without inertia: lock their joints, or give their links this inertia "
        "(kg, kg m^2).",
    ),
]
ClosingTolerance = Annotated[
    float | None,
    option(
        "S",
        "Accuracy (m, rad) of the data of overconstrained loops that do not close exactly: rows "
        "implied to it are left out.",
    ),
]
Parameters = Annotated[
    list[str] | None,
    several("--set", "NAME=VALUE", "Value of a parameter of a description."),
]
MeshDirs = Annotated[
    list[Path] | None,
    several("--mesh-dirs", "DIR", "Further folder of meshes and other files that the model names."),
]


@dataclass(frozen=True)
class ModelFile:
    """The argument MODEL of a command, and the options that all commands with one share."""

    model: Model
    allow_outside: AllowOutside = False
    keyframe: Keyframe = None
    massless: Massless = None
    closing_tolerance: ClosingTolerance = None
    parameters: Parameters = None
    mesh_dirs: MeshDirs = None

    def options(self) -> dict[str, Any]:
        """The options as ``srm_mbs.load`` takes them.

        Raises
        ------
        InputError
            If ``--massless`` is neither ``fix`` nor two numbers, or ``--set`` no name with a
            number.
        """
        return {
            "allow_outside": self.allow_outside,
            "keyframe": self.keyframe,
            "massless": massless_ends(self.massless),
            "closing_tolerance": self.closing_tolerance,
            "parameters": parameter_values(self.parameters or ()),
            "mesh_dirs": self.mesh_dirs or (),
        }

    def load(self, **more: Any) -> Mechanism:
        """The mechanism; ``more`` are further arguments of ``srm_mbs.load``."""
        return srm_mbs.load(self.model, **self.options(), **more)


def massless_ends(given: str | None) -> str | dict[str, float] | None:
    """``--massless`` as ``srm_mbs.load`` takes it.

    Raises
    ------
    InputError
        If it is neither ``fix`` nor two numbers.
    """
    if given is None or given == "fix":
        return given
    try:
        mass, inertia = map(float, given.split(","))
    except ValueError as error:
        raise InputError(
            f"{given!r} is neither fix nor two numbers",
            element="massless",
            remedy="Give fix, or mass and moment of inertia as 0.1,1e-4 (kg, kg m^2)",
        ) from error
    return {"mass": mass, "inertia": inertia}


def parameter_values(given: Sequence[str]) -> dict[str, float]:
    """The texts ``NAME=VALUE`` of ``--set`` as ``srm_mbs.load`` takes them.

    Raises
    ------
    InputError
        As :func:`named_numbers`.
    """
    return named_numbers(given, "parameters", "parameter", "crank")


def named_numbers(given: Sequence[str], element: str, what: str, example: str) -> dict[str, float]:
    """The texts ``NAME=VALUE`` of the argument ``element``; messages call a name ``what``, and
    ``example`` is one.

    Raises
    ------
    InputError
        If one is none, or a name is given again.
    """
    values: dict[str, float] = {}
    for text in given:
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError as error:
            raise InputError(
                f"{text!r} is not a name and a number",
                element=element,
                remedy=f"Give it as {example}=0.3",
            ) from error
        if name in values:
            raise InputError(
                f"the {what} {name!r} is given twice", element=element, remedy="Keep one"
            )
        values[name] = number
    return values


def reads_model(command: Callable[..., None]) -> Callable[..., None]:
    """Decorator of commands whose first parameter is a :class:`ModelFile`: on the command line its
    fields stand in its place, the options after those of the command."""
    hints = get_type_hints(command, include_extras=True)
    own = list(inspect.signature(command).parameters.values())[1:]
    shared = get_type_hints(ModelFile, include_extras=True)
    first, *others = (
        inspect.Parameter(
            key.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if key.name == "model" else key.default,
            annotation=shared[key.name],
        )
        for key in fields(ModelFile)
    )
    mine = [
        each.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[each.name])
        for each in own
    ]

    @wraps(command)
    def run(**given: Any) -> None:
        file = ModelFile(**{name: given.pop(name) for name in shared})
        command(file, **given)

    parameters = [first, *mine, *others]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run
