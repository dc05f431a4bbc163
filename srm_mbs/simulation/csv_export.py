"""A run as a table of comma-separated values, for spreadsheets and other programs.

One row per time, with a header that names each column and its unit:

* ``t (s)``;
* the positions of each joint: ``crank (rad)``, angles unwrapped; joints of several degrees of
  freedom one column per Pinocchio coordinate, ``base.x (m)``, ..., ``base.qw``;
* the velocities: ``crank rate (rad/s)``, ``base.vx (m/s)``, ..., ``base.wz (rad/s)``, the latter
  in the moving body's frame;
* with loops, the closure errors ``||g||`` and their rates ``||G v||``;
* ``energy (J)``, kinetic plus potential;
* of points that are asked for, ``rod (1; 0; 0) x (m)``, ``... vx (m/s)``, ``... ax (m/s^2)``;
  without the last, and with a warning, of a loaded run that had a controller;
* on request the reactions: ``closure pin fx (N)`` to ``mz (N m)``, and ``joint crank fx (N)``.

Every number is written with as many digits as give the same float back.
Names and texts that a spreadsheet would take as a formula (they begin with = + - @, a tab or an
end of line) get an apostrophe in front, which tables of laws are read without.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.mobility import COMPONENTS
from srm_mbs.dynamics.point_motion import point_name
from srm_mbs.dynamics.scaling import is_angle, row_dimensions
from srm_mbs.errors import InputError, get_logger, warn
from srm_mbs.formats.csv_table import text_cell
from srm_mbs.formats.files import writing
from srm_mbs.model.anchors import Anchor
from srm_mbs.simulation.result import SimulationResult

log = get_logger(__name__)

_LENGTHS, _QUATERNION = ("x (m)", "y (m)", "z (m)"), ("qx", "qy", "qz", "qw")
_LINEAR, _ANGULAR = ("vx (m/s)", "vy (m/s)", "vz (m/s)"), ("wx (rad/s)", "wy (rad/s)", "wz (rad/s)")
_COMPONENTS = {
    "JointModelFreeFlyer": (_LENGTHS + _QUATERNION, _LINEAR + _ANGULAR),
    "JointModelSpherical": (_QUATERNION, _ANGULAR),
    "JointModelTranslation": (_LENGTHS, _LINEAR),
    "JointModelUniversal": (
        ("angle 1 (rad)", "angle 2 (rad)"),
        ("rate 1 (rad/s)", "rate 2 (rad/s)"),
    ),
    "JointModelPlanar": ((*_LENGTHS[:2], "cos", "sin"), (*_LINEAR[:2], _ANGULAR[2])),
}
"""Columns of joints of several degrees of freedom: positions, velocities."""


def write_csv(
    solution: SimulationResult,
    path: str | Path | io.TextIOBase,
    points: Sequence[Anchor | str],
    reactions: bool,
) -> None:
    """Write ``solution`` at its times ``solution.t`` to ``path``; see the module's text.

    Parameters
    ----------
    path
        File name, or an open text file.
    points
        Anchors, or names of points of the mechanism, whose motion is added.
    reactions
        Whether the reactions of closures and joints are added.

    Raises
    ------
    InputError
        If a point does not exist; for reactions of a loaded run that had a controller.
    OSError
        If the file cannot be written.
    """
    # A state that runs away overflows in its drift and energy: "inf" or "nan" is written.
    with np.errstate(over="ignore", invalid="ignore"):
        columns = _columns(solution)
        for point in points:
            columns |= _motion(solution, point)
        if reactions:
            columns |= _wrenches(solution)
    write_table(columns, path)


def write_table(columns: Mapping[str, NDArray[Any]], path: str | Path | io.TextIOBase) -> None:
    """Write ``columns``, header -> values (n,), to ``path``, a file name or an open text file.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    if isinstance(path, io.TextIOBase):
        _write_rows(columns, path)
        return
    with writing(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", errors="backslashreplace", newline="")
        _write_rows(columns, text)
        text.flush()
        text.detach()  # the file is closed by its owner
    log.info("written: %s", path)


def _write_rows(columns: Mapping[str, NDArray[Any]], text: io.TextIOBase) -> None:
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(text_cell, columns))
    # Python's own floats: the csv module writes them with repr.
    writer.writerows(zip(*(_cells(column) for column in columns.values())))


def _cells(column: NDArray[Any]) -> list[Any]:
    """The values of a column as the csv module writes them; numbers stay as they are."""
    values: list[Any] = column.tolist()
    return list(map(text_cell, values)) if column.dtype.kind == "U" else values


def _motion(solution: SimulationResult, point: Anchor | str) -> dict[str, FloatArray]:
    """Columns of the motion of a point, without its accelerations where the run has none."""
    motion = solution.point(point)
    name = point_name(point).replace(",", ";")  # so that nothing is quoted
    parts = [("", "m", motion.position), ("v", "m/s", motion.velocity)]
    try:
        parts.append(("a", "m/s^2", motion.acceleration))
    except InputError as error:
        warn(f"the table has no accelerations of points: {error}")
    return {
        f"{name} {prefix}{axis} ({unit})": values[:, k]
        for prefix, unit, values in parts
        for k, axis in enumerate("xyz")
    }


def _wrenches(solution: SimulationResult) -> dict[str, FloatArray]:
    """Columns of the reactions."""
    return {
        f"{kind} {name} {part} ({'N' if k < 3 else 'N m'})": wrench[:, k]
        for kind, table in (("closure", solution.reactions), ("joint", solution.joint_reactions))
        for name, wrench in table.items()
        for k, part in enumerate(COMPONENTS)
    }


def _columns(solution: SimulationResult) -> dict[str, FloatArray]:
    """Header and values (n,) of each column."""
    mechanism = solution.mechanism
    positions: dict[str, FloatArray] = {}
    rates: dict[str, FloatArray] = {}
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        if joint.nv == 1:
            unit = "rad" if is_angle(mechanism.model, name) else "m"
            positions[f"{name} ({unit})"], rates[f"{name} rate ({unit}/s)"] = solution.joint(name)
            continue
        numbered = [f"q{i}" for i in range(joint.nq)], [f"v{i}" for i in range(joint.nv)]
        q_names, v_names = _COMPONENTS.get(joint.shortname(), numbered)
        for i, component in enumerate(q_names):
            positions[f"{name}.{component}"] = solution.q[:, joint.idx_q + i]
        for i, component in enumerate(v_names):
            rates[f"{name}.{component}"] = solution.v[:, joint.idx_v + i]
    columns = {"t (s)": solution.t, **positions, **rates}
    if mechanism.constrained:
        units = row_dimensions(mechanism)  # joined by semicolons, so that nothing is quoted
        lengths, speeds = "; ".join(units), "; ".join(f"{unit}/s" for unit in units)
        columns[f"||g|| ({lengths})"], columns[f"||G v|| ({speeds})"] = solution.drift.T
    columns["energy (J)"] = solution.energy
    return columns
