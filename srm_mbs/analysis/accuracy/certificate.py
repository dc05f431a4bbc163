"""The accuracy of a run: drift, energy balance, and an error estimate by comparison with reruns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from srm_mbs.analysis.accuracy.assessment import (
    GRADES,
    Assessment,
    Grade,
    assess_drift,
    assess_energy,
    assess_errors,
    assess_status,
)
from srm_mbs.analysis.accuracy.conservation import (
    Drift,
    EnergyError,
    drift_of,
    energy_error,
    invariants_of,
)
from srm_mbs.analysis.accuracy.error_estimate import ErrorEstimate, checked_settings, estimate_error
from srm_mbs.model.numbers import flag
from srm_mbs.simulation.rerun import unsupported_reason
from srm_mbs.simulation.result import SimulationResult, check_run


@dataclass(frozen=True, eq=False)
class Certificate:
    """The accuracy of a run, from :func:`srm_mbs.certify`; ``print`` it to read it.

    Attributes
    ----------
    name
        Of the mechanism.
    findings
        The assessments, each with ``topic``, ``grade`` (``good``, ``fair``, ``poor`` or
        ``unknown``) and ``text``.
    drift
        The largest closure errors, :class:`srm_mbs.analysis.accuracy.conservation.Drift` for each
        unit; empty for an open chain.
    energy
        Residual of the energy balance,
        :class:`srm_mbs.analysis.accuracy.conservation.EnergyError`; None if it cannot be computed.
    estimate
        Comparison with the reruns,
        :class:`srm_mbs.analysis.accuracy.error_estimate.ErrorEstimate`; None without them.
    """

    name: str
    findings: tuple[Assessment, ...]
    drift: tuple[Drift, ...]
    energy: EnergyError | None
    estimate: ErrorEstimate | None

    @property
    def grade(self) -> Grade:
        """The worst grade of all assessments."""
        return max((finding.grade for finding in self.findings), key=GRADES.index)

    @property
    def error(self) -> dict[str, tuple[float, float]]:
        """The largest estimated error of positions and of rates, for each unit: {"rad": (rad,
        rad/s), "m": (m, m/s)}; empty without an estimate."""
        rows = () if self.estimate is None else self.estimate.joints
        return {
            unit: (
                max(row.position for row in rows if row.unit == unit),
                max(row.rate for row in rows if row.unit == unit),
            )
            for unit in dict.fromkeys(row.unit for row in rows)
        }

    def __str__(self) -> str:
        lines = [f"Accuracy of the run of {self.name}"]
        lines += [f"  {found.topic} ({found.grade}): {found.text}" for found in self.findings]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"Certificate({self.name!r}, grade={self.grade!r}, error={self.error})"


def certify(
    solution: SimulationResult,
    *,
    rtol: float | None = None,
    again: bool = True,
    progress: Any = False,
) -> Certificate:
    """Estimate how accurate a run is.

    The run is repeated twice: at a tenth and a hundredth of its tolerance (no tighter than rounding
    allows, 1e-12), or with half and a quarter of its fixed step.  With dop853 this takes some three
    times as long as the run, with fixed steps six times.  Functions of the user are called again.

    Parameters
    ----------
    solution
        A run, finished or not.
    rtol
        Relative tolerance of the tightest run, by default a hundredth of that of the run; another
        one lies between.  A looser tolerance gives a bound.
    again
        Whether the run is repeated; otherwise the certificate has drift and energy only.
    progress
        As for :func:`srm_mbs.simulate`, of each run.

    Returns
    -------
    Certificate
        If the run cannot be repeated (a loaded one that had Python functions), an assessment gives
        the reason.

    Raises
    ------
    InputError
        If ``solution`` is no run, or ``rtol`` is not valid for it.
    """
    check_run(solution)
    settings = checked_settings(solution, rtol)
    parts = solution.segments
    samples = [part.samples() for part in parts]
    invariants = [invariants_of(*each) for each in zip(parts, samples)]
    drift = drift_of(parts, invariants)
    energy = energy_error(solution, samples, invariants)
    reason = unsupported_reason(solution) if flag(again, "again") else "it was not asked for"
    if not reason and not solution.stats.steps:
        reason = "the run took no step"
    estimate = reason or estimate_error(solution, settings, samples, progress)
    return Certificate(
        solution.mechanism.name,
        (
            assess_status(solution),
            assess_drift(drift),
            assess_energy(energy),
            *assess_errors(solution, estimate),
        ),
        drift,
        None if isinstance(energy, str) else energy,
        None if isinstance(estimate, str) else estimate,
    )
