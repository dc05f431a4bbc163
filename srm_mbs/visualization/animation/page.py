"""The page that plays a run: meshcat's viewer with a panel of values and a bar of controls.

The files of the folder ``page`` are put together with meshcat's viewer into one that needs nothing
else.

What the page of a run tells in words and numbers: values over time, singular passages, notes.
"""

from __future__ import annotations

import base64
import html
import json
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.scaling import row_dimensions
from srm_mbs.errors import CHECK_WRITING, InputError
from srm_mbs.simulation.result import Solution
from srm_mbs.visualization.animation.trajectory import parts_of

if TYPE_CHECKING:
    from srm_mbs.integration.singular_passages import Crossing
    from srm_mbs.visualization.animation.joint_motion import Playable

MAX_SAMPLES = 3000
"""Times at which the values are sampled: some 100 kB in a page."""
NAMED_LOOPS, NAMED_PASSAGES = 12, 100
"""Loops, and passages, up to which the passages name their loops."""
DRIFT, ENERGY = "drift |g|", "energy change"
DIGITS = 4
"""Digits of a value in the page; it shows three."""


def read_out(solution: Playable, times: FloatArray, *, panel: bool = True) -> dict[str, Any]:
    """Values and passages as the page takes them, ready for JSON.

    Parameters
    ----------
    solution
        A run, or a motion, which has no values.
    times : (n,) s
        Of the key frames.
    panel
        Whether the page shows them; otherwise they are not computed.

    Returns
    -------
    dict
        ``start`` (s); ``times`` (s) and ``values``, each with ``label``, ``unit`` and ``samples``
        at the times, null where they are not finite; ``passages``, each with ``time`` (s) and
        ``text``; ``panel``.
    """
    about: dict[str, Any] = {"start": float(times[0]), "panel": panel, "times": []}
    about |= {"values": [], "passages": []}
    if not (panel and isinstance(solution, Solution)):
        return about
    crossings = solution.crossings
    few = len(solution.mechanism.loops) <= NAMED_LOOPS and len(crossings) <= NAMED_PASSAGES
    about["passages"] = [
        {"time": crossing.time, "text": _passage(crossing, named=few)} for crossing in crossings
    ]
    if len(times) > MAX_SAMPLES:
        times = np.linspace(times[0], times[-1], MAX_SAMPLES)
    times = np.union1d(times, [crossing.time for crossing in crossings])
    about["times"] = [float(f"{t:.9g}") for t in times]
    run = solution.at(times)
    values = []
    unit = drift_unit(solution)
    with np.errstate(over="ignore", invalid="ignore"):
        if unit:
            values.append((DRIFT, unit, run.drift[:, 0]))
        values.append((ENERGY, "J", run.energy - solution.at(times[:1]).energy))
        if unit and solution.steps.count:
            values.append(("sigma", "", sigma_at(solution, times)))
    about["values"] = [
        {"label": label, "unit": unit, "samples": [_rounded(x) for x in samples.tolist()]}
        for label, unit, samples in values
    ]
    return about


def drift_unit(solution: Playable) -> str:
    """Units of the closure errors of a run or motion, "" if it never has closures or drives."""
    units: dict[str, None] = {}
    for mechanism, _ in parts_of(solution):
        if mechanism.constrained:
            units |= dict.fromkeys(row_dimensions(mechanism))
    return ", ".join(units)


def _passage(crossing: Crossing, *, named: bool) -> str:
    """What the mark of a passage says: its time and, where all are few, the loops and drives.

    Which loops lose rank takes a second to find out among dozens, and nobody could read them.
    """
    text = f"singular configuration passed at t = {crossing.time:.4g} s"
    return f"{text}: {crossing.participants.names}" if named else text


def sigma_at(solution: Solution, times: FloatArray) -> FloatArray:
    """sigma (relative) at ``times`` (n,) s.

    Straight lines between the stages of the run, where it was recorded, as in the plot of the run,
    and zero at the singular passages, which lie between two of them.
    """
    steps = solution.steps
    abscissae = np.append(solution.scheme.c, 1.0)
    stages = steps.times[:-1, None] + abscissae * np.diff(steps.times)[:, None]
    known = stages.ravel(), steps.sigmas.ravel()
    crossings = solution.crossings
    at = np.append(known[0], [crossing.time for crossing in crossings])
    sigmas = np.append(known[1], np.zeros(len(crossings)))
    order = np.argsort(at, kind="stable")
    return np.interp(times, at[order], sigmas[order])


def _rounded(value: float) -> float | None:
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None


log = logging.getLogger(__name__)

FOLDER = Path(__file__).with_name("web")


def make_page(
    meshcat: Any, title: str, about: dict[str, Any], commands: Sequence[dict[str, Any]] | None
) -> str:
    """One self-contained page.

    Parameters
    ----------
    meshcat
        The package.
    title
        Of the window.
    about
        What the panel and the bar show (:func:`srm_mbs.visualization.animation.page.read_out`).
    commands
        meshcat's commands, which the page holds and, unlike that of meshcat's own
        ``static_html``, applies in their order; None for a page that takes them from the server
        that it comes from.
    """
    root = Path(meshcat.servers.zmqserver.VIEWER_ROOT)
    parts = {
        "title": html.escape(title),
        "viewer": (root / "main.min.js").read_text(encoding="utf-8"),
        "commands": json.dumps(None if commands is None else _packed(commands)),
        # Names are the user's: they must not end the script.
        "about": as_json(about).replace("<", "\\u003c"),
        "script": (FOLDER / "page.js").read_text(encoding="utf-8"),
    }
    return filled("page.html", parts)


def filled(template: str, parts: Mapping[str, str]) -> str:
    """A file of the folder ``page`` with each mark ``@name@`` replaced by what it stands for.

    Parameters
    ----------
    template
        Name of the file.
    parts
        What is put in, in the order of the marks.
    """
    page = (FOLDER / template).read_text(encoding="utf-8")
    # The last first: what is put in may itself hold marks.
    for name in reversed(list(parts)):
        before, after = page.split(f"@{name}@", 1)
        page = before + parts[name] + after
    return page


def as_json(about: dict[str, Any]) -> str:
    """``about`` of :func:`make_page` as text."""
    return json.dumps(about, allow_nan=False)


def _packed(commands: Sequence[dict[str, Any]]) -> list[str]:
    import umsgpack  # type: ignore[import-untyped]

    packed = []
    for command in commands:
        # Animations are played in single precision anyway, and are most of the file.
        precision = "single" if command["type"] == "set_animation" else "double"
        content = umsgpack.packb(command, force_float_precision=precision)
        packed.append(base64.b64encode(content).decode("ascii"))
    return packed


def write_page(page: str, path: Path) -> None:
    """Write a page to ``path``; an existing file is replaced.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"the page cannot be written: {error.strerror}", file=str(path), remedy=CHECK_WRITING
        ) from error
    log.info("written: %s", path)
