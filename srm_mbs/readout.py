"""What the page of a run tells in words and numbers: values over time, singular passages, notes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.solution import Solution
from srm_mbs.spans import parts_of
from srm_mbs.systems.units import row_dimensions

if TYPE_CHECKING:
    from srm_mbs.motion import Playable
    from srm_mbs.stepping.crossings import Crossing

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
