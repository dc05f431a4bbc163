"""The section of a report that says how accurate its run is."""

from __future__ import annotations

from srm_mbs.analysis.certificate import Certificate
from srm_mbs.analysis.error_estimate import ErrorEstimate
from srm_mbs.analysis.verdicts import Grade
from srm_mbs.markup import paragraph, section, subsection, table, text
from srm_mbs.report_sections import drawing
from srm_mbs.solution import Solution

MARKS: dict[Grade, str] = {
    "good": "✓ good",
    "fair": "~ fair",
    "poor": "✗ poor",
    "unknown": "? open",
}
"""Each grade by a sign and a word, so that it does not need its colour."""


def accuracy_section(solution: Solution, certificate: Certificate) -> str:
    """Verdicts, drift, energy, and the estimated errors with what they rest on."""
    estimate = certificate.estimate
    return section(
        "accuracy",
        "Accuracy certificate",
        "How far the computed motion can be off. It judges how exactly the equations of this model "
        "were solved, not how well the model describes a machine.",
        _verdicts(certificate),
        _drift(certificate),
        _energy(certificate),
        "" if estimate is None else _errors(estimate),
        "" if estimate is None else _trials(estimate),
        "" if estimate is None else _over_time(solution, estimate),
    )


def _verdicts(certificate: Certificate) -> str:
    items = [
        f'<li><span class="grade {found.grade}">{text(MARKS[found.grade])}</span> '
        f'<span class="topic">{text(found.topic)}</span> <span>{text(found.text)}</span></li>'
        for found in certificate.findings
    ]
    return f'<ul class="verdicts">{"".join(items)}</ul>'


def _drift(certificate: Certificate) -> str:
    rows = [
        (
            f"closure errors in {row.unit}",
            f"{row.position:.2e} {row.unit}",
            f"{row.rate:.2e} {row.unit}/s",
            f"{row.between_position:.2e} {row.unit}",
            f"{row.between_rate:.2e} {row.unit}/s",
        )
        for row in certificate.drift
    ]
    if not rows:
        return ""
    header = ("", "positions", "rates", "positions, between steps", "rates, between steps")
    return subsection(
        "Drift",
        paragraph(
            "How far the loops came apart at most: at the ends of the steps, and between them, "
            "where the motion is interpolated."
        ),
        table(rows, header, numbers=[1, 2, 3, 4]),
    )


def _energy(certificate: Certificate) -> str:
    energy = certificate.energy
    if energy is None:
        return ""
    works = ", ".join(energy.works) or "nothing: the energy is conserved"
    rows = [
        ("largest residual", f"{energy.residual:.2e} J"),
        ("energy that took part", f"{energy.scale:.4g} J"),
        ("residual over that", f"{energy.relative:.1e}"),
        ("what does work", works),
    ]
    return subsection(
        "Energy balance",
        paragraph(
            "What kinetic and potential energy gain is the work of all that acts. The residual is "
            "what does not add up."
        ),
        table(rows),
    )


def _ratio(value: float | None) -> str:
    return "does not move" if value is None else f"{value:.1e}"


def _errors(estimate: ErrorEstimate) -> str:
    rows = [
        (
            row.joint,
            f"{row.position:.2e} {row.unit}",
            _ratio(row.relative_position),
            f"{row.rate:.2e} {row.unit}/s",
            _ratio(row.relative_rate),
        )
        for row in estimate.joints
    ]
    words = "The largest difference to the tightest run, over the whole time."
    if estimate.bound:
        words = "The largest difference to the next looser run: the error should be smaller."
    elif estimate.apart is not None:
        words = (
            f"The largest difference to the tightest run, up to t = {estimate.apart:.6g} s only."
        )
    elif estimate.fixed:
        words += " It is extrapolated to a step of length zero."
    return subsection(
        "Estimated error of each joint",
        paragraph(
            f"{words} Relative means over the joint's distance from its start, and over its "
            "largest rate."
        ),
        table(
            rows,
            ("joint", "position", "relative", "rate", "relative"),
            numbers=[1, 2, 3, 4],
        ),
    )


def _trials(estimate: ErrorEstimate) -> str:
    name = "step (s)" if estimate.fixed else "relative tolerance"
    rows = [
        (
            f"{trial.setting:.3g}" + (" (this run)" if trial.own else ""),
            str(trial.steps),
            str(trial.evaluations),
            f"{trial.wall_time:.3g} s",
            f"{trial.status} at {trial.end:.6g} s",
            "tightest" if trial.difference is None else f"{trial.difference:.2e}",
        )
        for trial in estimate.trials
    ]
    header = (name, "steps", "evaluations", "wall time", "end", "difference to the tightest")
    if estimate.order is None:
        slope = "How the error falls was not observed."
    elif estimate.fixed:
        expected = estimate.expected_order
        theory = "" if expected is None else f"; the order of the scheme is {expected:g}"
        slope = f"Observed order: {estimate.order:.2f}{theory}."
    else:
        slope = (
            f"Slope of log error over log tolerance: {estimate.order:.2f}; errors in proportion to "
            "the tolerance would give 1."
        )
    return subsection(
        "The runs that were compared",
        paragraph(
            "The same motion again, more accurately. Differences are the largest of all positions "
            "and rates, each over its unit: 1 rad or the size of the mechanism, and those times "
            "its characteristic rate."
        ),
        table(rows, header, numbers=[1, 2, 3, 5]),
        paragraph(slope),
    )


def _over_time(solution: Solution, estimate: ErrorEstimate) -> str:
    from srm_mbs.plotting.errors import draw_errors

    units = solution.mechanism.structure.units
    caption = (
        f"The difference over time, positions over 1 rad or {units.length:.3g} m, rates over those "
        f"times {units.rate:.3g}/s."
    )
    figure = draw_errors(solution, estimate.comparison)
    return drawing(figure, "Plot: difference to the other run over time", caption)
