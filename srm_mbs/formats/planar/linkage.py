"""``planar``: a planar linkage typed in as points and bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, known_names, safe_repr
from srm_mbs.formats.build import Reading, assembled
from srm_mbs.formats.convert import write_description
from srm_mbs.formats.files import check_name
from srm_mbs.formats.load import mechanism_of, read_tables
from srm_mbs.formats.toml.description import check_description, parse_toml
from srm_mbs.formats.toml.parameters import PARAMETERS
from srm_mbs.formats.translation import PLANAR
from srm_mbs.formats.xml import parse_xml
from srm_mbs.model.laws import ConstantSpeed, Law, Samples, is_of_package
from srm_mbs.model.mechanism import Source
from srm_mbs.model.numbers import checked_name, name_list, named_values, plain

Number = float | str
"""A number, or an expression over parameters such as ``"=2*crank"``."""


@dataclass(frozen=True, eq=False, repr=False)
class Linkage(Mechanism):
    """A planar linkage of :func:`planar`: a mechanism that is written as a description."""

    def save(self, path: str | Path, force: bool = False) -> tuple[Path, Path]:
        """Write it as a TOML description, and its tree as a URDF of the same name beside it.

        Parameters
        ----------
        path
            The description to write, ``.toml``.
        force
            Whether files that exist are overwritten.

        Returns
        -------
        description, urdf
            The paths written.

        Raises
        ------
        InputError
            If a file exists or cannot be written, or the linkage is not as :func:`planar` made
            it: other forces, drives, closures, actuators, another name or state.
        """
        source = self.source
        changed = ["source"] if source is None else self._changed(source)
        if source is None or changed:
            raise InputError(
                f"the linkage was changed after srm.planar made it: {', '.join(changed)}",
                element="save",
                remedy="Give everything to srm.planar, or save a run of it",
            )
        description, urdf, _ = write_description(_reading(source), path, force=force)
        return description, urdf

    def _changed(self, source: Source) -> list[str]:
        """Names of the fields that are not as its texts describe them."""
        made = assembled(_reading(source))

        def same(name: str) -> bool:
            mine, own = getattr(self, name), getattr(made, name)
            return bool(np.array_equal(mine, own) if name in ("q0", "v0") else mine == own)

        names = [key.name for key in fields(made) if key.name not in ("source", "notes")]
        return [name for name in names if not same(name)]


def _reading(source: Source) -> Reading:
    """The texts of a linkage, read again."""
    entries = parse_toml(source.description, source.path)
    tree = parse_xml(source.urdf, source.urdf_path)
    return Reading(check_description(entries, source.path), entries, tree, source)


def planar(
    *,
    points: Mapping[str, Sequence[Number]],
    bars: Mapping[str, Sequence[str] | Mapping[str, Any]],
    ground: Sequence[str],
    sliders: Mapping[str, Mapping[str, Any]] | None = None,
    lengths: Mapping[str | tuple[str, str], Number] | None = None,
    unit: str = "m",
    angle: str = "rad",
    mass_per_length: Number | None = None,
    masses: Mapping[str, Number] | None = None,
    inertias: Mapping[str, Number] | None = None,
    start: Mapping[str, Number] | None = None,
    rates: Mapping[str, Number] | None = None,
    springs: Sequence[Mapping[str, Any]] = (),
    torques: Mapping[str, Number] | None = None,
    loads: Mapping[str, Sequence[Number]] | None = None,
    drives: Mapping[str, Number | Law | Mapping[str, Any]] | None = None,
    gravity: Sequence[Number] | None = None,
    name: str = "linkage",
    cut: Sequence[str] = (),
    parameters: Mapping[str, Number] | None = None,
) -> Linkage:
    """A planar linkage from the points and bars of one closed pose, assembled.

    The pose gives the lengths, the inertias, the branch on which the loops close, and the start.
    x and y of the drawing are x and z of the world; angles count from x to y.  Joints are called
    after their pins, ``"A"``, or ``"A:coupler"`` where more than two bodies meet, and slides after
    their sliders.  The angle of a pin on the ground is that of its bar against x, elsewhere that of
    its bar against the one nearer to the ground; a bar points from the pin that carries it to the
    next of its points.  The same keys are a section of a description (docs/formats.md).

    Wherever a number stands an expression over ``parameters`` may stand, a text that begins with
    ``=``: ``points={"A": ("=crank", 0), ...}, parameters={"crank": 40}``.
    ``linkage.with_parameters(crank=50)`` is then the linkage with another value.

    Parameters
    ----------
    points
        Positions (x, y), by name, in ``unit``.
    bars
        By name, the points of each: two, or more of a plate.  Instead a table with ``points``, and
        any of ``length``, ``mass``, ``mass_per_length``, ``inertia`` and ``centre`` (x, y).
    ground
        The points that stay in place.
    sliders
        By name, tables with ``point``, which moves along the line ``along`` through its place in
        the drawing: an angle, a direction (x, y), or two points.  ``on`` names the bar that has
        the line, by default the ground; ``mass`` (kg) and ``inertia`` (kg m^2) are optional.
    lengths
        Distances in ``unit`` instead of those of the drawing, by bar or pair of points; the points
        are then approximate, and the linkage is closed by assembly.
    unit, angle
        ``"m"``, ``"cm"``, ``"mm"`` or ``"in"`` of all lengths and positions of slides; ``"rad"`` or
        ``"deg"`` of all angles and rates.  Everything else is in SI units.
    mass_per_length
        kg/m of bars whose mass is not given.
    masses, inertias
        kg, and kg m^2 about the centre of mass, by bar.  Without them a bar is slender, a plate
        consists of slender bars along its outline.
    start, rates
        Initial angle (position) and rate of pins (slides), held exactly; the others follow.
    springs
        Tables with the points ``a`` and ``b``, ``stiffness`` (N/m), ``damping`` (N s/m) and
        ``rest_length``, in ``unit``.
    torques
        N m by pin, N by slider, constant.
    loads
        Constant forces (x, y) in N by point.
    drives
        Prescribed motion by pin or slider: a constant speed, a law, or the table of a law.
    gravity
        (x, y) in m/s^2; (0, -9.81) by default.
    name
        Of the mechanism.
    cut
        Names of the pins at which loops are cut, instead of those that the spanning tree leaves.
    parameters
        Numbers by name, or expressions over the others, as in the table ``[parameters]`` of a
        description.

    Returns
    -------
    Linkage
        A :class:`srm_mbs.Mechanism`; its ``points`` are those of the drawing, by name.

    Raises
    ------
    InputError
        Naming the point, bar or slider: unknown, unused or coincident points, a bar of one point,
        parts that nothing connects with the ground, a linkage that cannot move.
    AssemblyError
        If given lengths or a given start do not close.
    """
    given: dict[str, Any] = {
        "unit": unit,
        "angle": angle,
        "mass_per_length": mass_per_length,
        "points": _by_name("points", points),
        "ground": ground,
        "bar": _bars(bars, masses, inertias, lengths),
        "length": [
            {"between": pair, "length": value}
            for pair, value in named_values(lengths, "lengths").items()
            if not isinstance(pair, str)
        ],
        "slider": _sliders(sliders),
        "start": _by_name("start", start),
        "rates": _by_name("rates", rates),
        "spring": springs,
        "torque": [{"pin": k, "torque": v} for k, v in _by_name("torques", torques).items()],
        "load": [{"point": k, "force": v} for k, v in _by_name("loads", loads).items()],
        "drive": [{"pin": k, **_law(v)} for k, v in _by_name("drives", drives).items()],
        "gravity": gravity,
    }
    name = checked_name(name, "name")
    check_name(name, "name")
    entries = {
        "format": 1,
        "name": name,
        "cut": list(name_list(cut, "cut")),
        PLANAR: {
            key: _plain(f"{PLANAR}.{key}", value)
            for key, value in given.items()
            if value is not None
        },
    }
    if parameters is not None:
        entries[PARAMETERS] = _plain(PARAMETERS, _by_name(PARAMETERS, parameters))
    reading = replace(read_tables(entries, f"{name or 'linkage'}.planar"), kind=Linkage)
    return cast(Linkage, mechanism_of(reading))


def _by_name(argument: str, given: Any) -> Mapping[str, Any]:
    """The values of an argument that is given by name."""
    values = named_values(given, argument)
    for name in values:
        if not isinstance(name, str):
            raise InputError(
                f"the name {safe_repr(name)} is not a text",
                element=argument,
                remedy="Give a dictionary: name -> value",
            )
    return values


def _bars(bars: Any, masses: Any, inertias: Any, lengths: Any) -> list[dict[str, Any]]:
    """The tables of the bars, with what is given by their names."""
    tables = {}
    for name, given in _by_name("bars", bars).items():
        own = dict(given) if isinstance(given, Mapping) else {"points": given}
        tables[name] = {"name": name, **own}
    by_bar = {k: v for k, v in named_values(lengths, "lengths").items() if isinstance(k, str)}
    for key, argument, values in (
        ("mass", "masses", _by_name("masses", masses)),
        ("inertia", "inertias", _by_name("inertias", inertias)),
        ("length", "lengths", by_bar),
    ):
        for name, value in values.items():
            if name not in tables:
                raise InputError(
                    f"there is no bar {safe_repr(name)}",
                    element=argument,
                    remedy=known_names(map(str, tables)),
                )
            tables[name][key] = value
    return list(tables.values())


def _sliders(given: Any) -> list[dict[str, Any]]:
    """The tables of the sliders."""
    tables = []
    for name, table in _by_name("sliders", given).items():
        if not isinstance(table, Mapping):
            raise InputError(
                f"{name!r}: {safe_repr(table)} is not a table",
                element="sliders",
                remedy='Give for example {"ram": {"point": "D", "along": (0, 1), "mass": 2.0}}',
            )
        tables.append({"name": name, **table})
    return tables


def _law(given: Any) -> dict[str, Any]:
    """The table of a law, of which a number is the constant speed."""
    if isinstance(given, Mapping):
        return dict(given)
    if isinstance(given, Law):
        if not is_of_package(given):
            raise InputError(
                f"{safe_repr(given)} is not a law that a description can have",
                element="drives",
                remedy="Give its srm.Drive to the linkage, with dataclasses.replace",
            )
        values = {key.name: getattr(given, key.name) for key in fields(given)}  # type: ignore[arg-type]
        return {"type": given.type, **{k: v for k, v in values.items() if v is not None}}
    return {"type": ConstantSpeed.type, "speed": given}


def _plain(key: str, value: Any) -> Any:
    """A value as ``tomllib`` gives it: dictionaries, lists, texts and numbers.

    Raises
    ------
    InputError
        About ``key``, if it holds anything else.
    """
    try:
        return _tables(value)
    except Exception as error:  # objects may raise anything
        raise InputError(
            f"{safe_repr(value)} does not consist of dictionaries, lists, texts and numbers",
            element=key,
            remedy="Give these",
        ) from error


def _tables(value: Any) -> Any:
    """:func:`_plain`, raising anything."""
    if isinstance(value, str):
        return plain(value)
    if isinstance(value, np.ndarray | np.generic):
        return _tables(value.tolist())
    if isinstance(value, Mapping):
        return {plain(name): _tables(part) for name, part in value.items()}
    if isinstance(value, list | tuple | Samples):
        return [_tables(part) for part in value]
    if isinstance(value, int | float):
        return value
    raise TypeError(type(value).__name__)
