"""Assessments of a certificate: its numbers as grades and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from srm_mbs.analysis.accuracy.conservation import Drift, EnergyError
from srm_mbs.analysis.accuracy.error_estimate import (
    DISAGREEMENT,
    ROUNDING,
    Comparison,
    ErrorEstimate,
    Trial,
)
from srm_mbs.errors import time_text
from srm_mbs.integration.methods.thesis.regularisation import parse_eps
from srm_mbs.simulation.result import SimulationResult

Grade = Literal["good", "fair", "poor", "unknown"]
GRADES: tuple[Grade, ...] = ("good", "fair", "unknown", "poor")
"""From the best to the worst."""

DRIFT_LIMITS = (1e-9, 1e-4)
"""Largest good and largest fair drift, in units."""
RESIDUAL_LIMITS = (1e-6, 1e-3)
"""Largest good and largest fair residual of the energy balance, over the energy that took part."""
ERROR_LIMITS = (1e-3, 0.05)
"""Largest good and largest fair estimated error, in units."""
ORDER_TOLERANCE = 0.3
"""Largest good deficit of the observed order below the expected one."""
SMALLEST_SLOPE = 0.3
"""Smallest good slope of log error over log tolerance."""
ROUNDING_ERROR_LIMIT = 1e-9
"""Error (units) below which accumulated rounding may dominate: it grows by some decades through
singular configurations."""
CONVERGED_QUOTIENT = 3.0
"""Quotient of the differences of two runs from which the error of the tighter one is negligible."""
EXPONENTIAL_GROWTH = 10.0
"""Growth of a difference in the second and in the last third of a run from which it is exponential;
proportional to the cube of time it would grow by 8 and 3.4."""
SHORTEST_RUN = 10.0
"""Shortest run, times the characteristic rate, in which growth of differences is assessed."""


@dataclass(frozen=True)
class Assessment:
    """The assessment of one topic of a certificate.

    Attributes
    ----------
    topic
        For example ``closed loops``.
    grade
        ``good``, ``fair``, ``poor`` or ``unknown``.
    text
        One or several sentences.
    """

    topic: str
    grade: Grade
    text: str


def _grade(value: float, limits: tuple[float, float]) -> Grade:
    good, fair = limits
    return "good" if value <= good else "fair" if value <= fair else "poor"


def assess_status(solution: SimulationResult) -> Assessment:
    """Whether the run reached its end."""
    topic = "end of the run"
    start, end = solution.span
    if solution.status == "finished":
        return Assessment(topic, "good", f"It reached its end at t = {time_text(end)} s.")
    if solution.status == "event":
        return Assessment(topic, "good", f"An event ended it at t = {time_text(end)} s, as asked.")
    word = "was interrupted" if solution.status == "interrupted" else "failed"
    if end <= start:
        return Assessment(topic, "poor", f"It {word} at its start: there is no motion to judge.")
    asked = "" if solution.request is None else f" of {time_text(solution.request.t_end)} s"
    text = (
        f"It {word} at t = {time_text(end)} s{asked}; all assessments refer to the time until then."
    )
    return Assessment(topic, "poor", text)


def assess_drift(drift: Sequence[Drift]) -> Assessment:
    """How well the closures were satisfied."""
    topic = "closed loops"
    if not drift:
        return Assessment(topic, "good", "It has neither loops nor drives: nothing can drift.")
    sizes = " and ".join(f"{row.position:.1e} {row.unit}" for row in drift)
    grade = _grade(max(row.relative for row in drift), DRIFT_LIMITS)
    meaning = {
        "good": "that is rounding, or close to it",
        "fair": "that is small beside the mechanism, but more than rounding",
        "poor": "the loops came visibly apart",
    }[grade]
    return Assessment(topic, grade, f"They stayed closed to {sizes}: {meaning}.")


def assess_energy(energy: EnergyError | str) -> Assessment:
    """Whether the energy balance closes."""
    topic = "energy balance"
    if isinstance(energy, str):
        return Assessment(topic, "unknown", f"It cannot be computed: {energy}")
    if energy.scale <= energy.rounding:
        return Assessment(topic, "good", "Nothing moved, and no energy was exchanged.")
    grade = _grade(energy.relative, RESIDUAL_LIMITS)
    text = "The energy, which should be constant, changes"
    if energy.works:
        text = "The energy gained and the work done, which should be equal, differ"
    text += f" by at most {energy.residual:.1e} J, {energy.relative:.1e} of the"
    text += f" {energy.scale:.3g} J that took part."
    if grade != "good" and energy.residual <= energy.rounding:
        return Assessment(topic, "good", f"{text} That is rounding of the energies.")
    if grade == "poor":
        text += " The run is not accurate, or a force is not smooth where no step ends."
    return Assessment(topic, grade, text)


def _runs_with(estimate: ErrorEstimate, trials: Sequence[Trial]) -> str:
    """The subject of a sentence about ``trials``."""
    name, unit = ("step", " s") if estimate.fixed else ("rtol", "")
    settings = " and ".join(f"{name} {trial.setting:.3g}{unit}" for trial in trials)
    return f"The run{'s' * (len(trials) > 1)} with {settings}"


def assess_errors(solution: SimulationResult, estimate: ErrorEstimate | str) -> list[Assessment]:
    """The error of the run, by comparison with the other runs."""
    if isinstance(estimate, str):
        text = f"There is none, as there is no second run: {estimate}."
        return [Assessment("estimated error", "unknown", text)]
    rate = solution.mechanism.structure.units.rate
    return [
        Assessment("estimated error", *_error(solution, estimate)),
        *_other_runs(solution, estimate),
        Assessment("order" if estimate.fixed else "error over tolerance", *_order(estimate)),
        *_sensitivity(estimate.comparison, rate),
        *_common_errors(solution),
    ]


def _error(solution: SimulationResult, estimate: ErrorEstimate) -> tuple[Grade, str]:
    """Grade and text of the estimated error."""
    largest: dict[str, float] = {}
    for row in estimate.joints:
        largest[row.unit] = max(row.position, largest.get(row.unit, 0.0))
    sizes = " and ".join(f"{value:.1e} {unit}" for unit, value in largest.items())
    if estimate.branch is not None:
        return "poor", (
            f"The run and the comparison run pass the singular configuration at "
            f"t = {time_text(estimate.branch)} s on different branches, and are different motions "
            "from there: at least one of them is wrong; the comparison does not show which."
        )
    if estimate.apart is not None:
        return "poor", (
            f"From t = {estimate.apart:.4g} s on the run and the comparison run disagree about the "
            "position of the mechanism: the rest of the run is a possible motion, not the one that "
            f"follows from the start. Before that they differ by at most {sizes}."
        )
    grade = _grade(estimate.size, ERROR_LIMITS)
    if estimate.bound:
        return grade, (
            f"The comparison run is looser and differs by {sizes}: the error of this run should be "
            "smaller, but there is no tighter run to show by how much."
        )
    end = min(solution.span[1], float(estimate.comparison.t[-1]))
    if not estimate.comparison.largest:
        return grade, (
            f"The comparison run has the same numbers up to t = {time_text(end)} s: the mechanism "
            "rests, or samples, breakpoints or max_step bound the steps of both, which then meet "
            "the tighter tolerance as well."
        )
    return grade, (
        f"No joint is off by more than about {sizes} up to t = {time_text(end)} s. This is an "
        "estimate, the difference to a tighter run, and no proven bound."
    )


def _other_runs(solution: SimulationResult, estimate: ErrorEstimate) -> list[Assessment]:
    """Differences in how the runs ended, and in their jumps."""
    out = []
    others = [trial for trial in estimate.trials if not trial.own]
    ended = [trial for trial in others if trial.status in ("finished", "event")]
    stopped = [trial for trial in others if trial not in ended]
    if solution.status == "failed" and ended:
        runs = _runs_with(estimate, ended)
        text = f"{runs} went on where this one failed: it is the setting that failed."
        out.append(Assessment("second run", "poor", text))
    if stopped and (solution.success or solution.status == "failed"):
        runs = _runs_with(estimate, stopped)
        times = " and ".join(f"{trial.end:.9g} s" for trial in stopped)
        too = " as well" * (not solution.success)
        text = f"{runs} stopped{too}, at t = {times}; compared is what both have."
        out.append(Assessment("second run", "poor" if solution.success else "fair", text))
    jumps = estimate.comparison.jumps
    if len(jumps):
        where = "jump by an event action" if len(jumps) == 1 else f"{len(jumps)} jumps by events"
        text = (
            f"At the {where} the times differ by at most {jumps.max():.1e} s; what lies between is "
            "left out of the comparison."
        )
        out.append(Assessment("jumps", "good", text))
    return out


def _order(estimate: ErrorEstimate) -> tuple[Grade, str]:
    """Grade and text of how errors fall with the step or the tolerance."""
    order, expected = estimate.order, estimate.expected_order
    if order is None:
        return _unobserved_order(estimate)
    if estimate.fixed:
        text = f"With the step, errors fall with order {order:.2f}"
        if expected is None:
            return "fair" if order > SMALLEST_SLOPE else "poor", f"{text}."
        text += f"; that of the scheme is {expected:g}."
        if order > expected - ORDER_TOLERANCE:
            return "good", text
        return "fair", (
            f"{text} The steps are too large for it, or something is not smooth: take the error "
            "above as a rough one."
        )
    if order >= SMALLEST_SLOPE:
        return "good", (
            f"Errors fall as the tolerance to the power {order:.2f}, where 1 is usual: a tighter "
            "tolerance pays, and the estimate holds."
        )
    if estimate.size < ROUNDING_ERROR_LIMIT:
        return "good", (
            "The differences no longer fall with the tolerance: they are what rounding leaves, and "
            "a tighter one gains nothing."
        )
    return "poor" if estimate.size > ERROR_LIMITS[0] else "fair", (
        f"The differences hardly fall with the tolerance (slope {order:.2f}, where 1 is usual): "
        "the estimate of the error cannot be relied on."
    )


def _unobserved_order(estimate: ErrorEstimate) -> tuple[Grade, str]:
    """Grade and text where differences are too close to rounding to decrease regularly."""
    differences = [t.difference for t in estimate.trials if t.difference is not None]
    if max(differences) < ROUNDING:
        return "good", "The differences are rounding already: there is nothing that could fall."
    if len(differences) == 2 and CONVERGED_QUOTIENT * differences[1] < differences[0]:
        return "good", (
            f"The run in between differs from the tightest by {differences[1]:.1e} only, which is "
            "close to rounding: the estimate holds, but how fast errors fall is not seen."
        )
    return "unknown", "There are too few runs to see how the error falls."


def _sensitivity(comparison: Comparison, rate: float) -> list[Assessment]:
    """Whether differences grow exponentially, so that no tolerance follows the motion for long."""
    size = np.maximum.accumulate(comparison.size.max(axis=1))
    size = size[: np.searchsorted(size, DISAGREEMENT)]  # beyond, differences saturate
    t = comparison.t[: len(size)]
    if len(size) < 3 or rate * (t[-1] - t[0]) < SHORTEST_RUN:
        return []
    first, second = np.searchsorted(t, t[0] + (t[-1] - t[0]) * np.array([1.0, 2.0]) / 3.0)
    steady = (
        EXPONENTIAL_GROWTH * size[first] < size[second]
        and EXPONENTIAL_GROWTH * size[second] < size[-1]
    )
    if not (steady and size[first] > 0.0):
        return []
    slope = float(np.polyfit(t[first:], np.log10(size[first:]), 1)[0])
    text = (
        f"Small differences grow about tenfold every {1.0 / slope:.2g} s: the motion is sensitive, "
        "as chaotic ones are, and no tolerance follows it for ever."
    )
    return [Assessment("sensitivity", "fair", text)]


def _common_errors(solution: SimulationResult) -> list[Assessment]:
    """Errors that all runs share, so that no difference shows them."""
    method = None if solution.request is None else solution.request.method
    eps = getattr(method, "eps", None)
    if eps is None or parse_eps(eps).power:
        return []
    text = (
        f"All runs have eps = {parse_eps(eps).factor:.3g} s; what that alone makes wrong is in "
        "none of the differences."
    )
    return [Assessment("regularisation", "unknown", text)]
