"""The sections of a report about its mechanism and its run; those on accuracy are elsewhere.

The difference of two runs over time: what a certificate takes for the error of one of them.

The section of a report that says how accurate its run is.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from srm_mbs.analysis.accuracy.assessment import Grade
from srm_mbs.analysis.accuracy.certificate import Certificate
from srm_mbs.analysis.accuracy.error_estimate import ErrorEstimate
from srm_mbs.analysis.report.html import paragraph, picture, section, subsection, table, text
from srm_mbs.analysis.summary import (
    body_rows,
    drive_rows,
    force_rows,
    joint_rows,
    loop_rows,
    mechanism_rows,
    run_rows,
)
from srm_mbs.errors import InputError
from srm_mbs.integration.methods.tableaus import TABLEAUS
from srm_mbs.integration.singular_passages import Crossing
from srm_mbs.model.mechanism import Mechanism
from srm_mbs.simulation.result import Solution
from srm_mbs.visualization.animation.overlays import OverlayOptions
from srm_mbs.visualization.animation.page import NAMED_LOOPS
from srm_mbs.visualization.animation.playback import page_of
from srm_mbs.visualization.animation.snapshot import draw_snapshot
from srm_mbs.visualization.plotting.figure import (
    FONT_SIZE,
    line_styles,
    log_axis,
    mark_times,
    time_panels,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srm_mbs.analysis.accuracy.error_estimate import Comparison
    from srm_mbs.simulation.result import Solution

DECADES = 1e-9
"""Least difference that is drawn, over the largest: none at the start would make the axis long."""


def draw_errors(solution: Solution, comparison: Comparison) -> Figure:
    """Largest difference of positions and of rates, in units, over time."""
    size = comparison.size
    lowest = DECADES * comparison.largest
    size = np.where(size > lowest, size, np.nan)

    def draw(axes: Axes) -> str:
        mark_times(axes, solution)
        for label, values, style in zip(("positions", "rates"), size.T, line_styles(2)):
            axes.plot(comparison.t, values, label=label, **style)
        log_axis(axes)
        axes.set_ylabel("largest difference\n(relative to units)", fontsize=FONT_SIZE)
        return "difference to the other run"

    return time_panels(solution, [draw], height=2.3)


FRAMES_PER_SECOND = 30.0
"""Of the animation; the browser interpolates between them."""
MOST_PASSAGES = 100
"""Passages that are listed one by one."""
MOST_LABOUR = 3000
"""Passages times squared number of loops up to which branches are followed: some 20 s."""
LARGEST_DRAWING = 250_000
"""Bytes of a drawing from which it is embedded as pixels instead."""
PIXELS_PER_INCH = 160

FREEDOM = {
    "degrees of freedom": "Independent motions that are left.",
    "Gruebler count": "Freedoms of all joints less closure rows: what is expected if no row is "
    "redundant.",
    "closure rows": "Conditions that the closures of the loops put on the joints.",
    "drives": "Motions that are prescribed; each takes a degree of freedom away.",
    "rank": "How many of these conditions are independent.",
    "redundant rows, left out": "Always fulfilled where the loops are closed, such as those across "
    "the plane of a planar loop. Loads that they would carry are not determined by equilibrium.",
    "redundant rows, left to pivoting": "Number of further conditions that follow from the others, "
    "though no one is always fulfilled.",
    "joints that cannot move": "The loops hold them in place.",
    "joints that move no loop": "They move while all others rest, such as the spin of a rod "
    "between two ball joints.",
}
"""What the rows of :func:`srm_mbs.analysis.summary.mechanism_rows` mean to whom sees them first."""
RUN = {
    "status": "finished, ended by an event, failed, or interrupted",
    "computed by": "Both give the same results; the kernel is faster.",
    "steps": "Time steps that stood.",
    "rejected steps": "Steps that were repeated because their estimated error was above the "
    "tolerance.",
    "evaluations": "How often the equations of motion were evaluated: the work of the run.",
    "placements": "Steps whose length was changed so that they pass a singular configuration "
    "safely.",
    "zone steps": "Steps so close to a singular configuration that reactions were predicted there.",
    "singular passages": "How often the mechanism went through a configuration in which its "
    "closures lose rank.",
    "energy change": "Kinetic and potential energy, compared with the start.",
    "wall time": "Time that the computation took.",
}
"""What the rows of :func:`srm_mbs.analysis.summary.run_rows` mean."""
PRECAUTIONS = {
    "a priori": "step changed in advance",
    "redone": "step redone",
    "zone": "reactions predicted",
}
"""What was done about a passage, in words."""
PICTURES = {
    "run": "Closure errors, energy, distance from singular configurations (0 on one), and lengths "
    "of the steps over time.",
    "state": "Positions and rates of the joints over time.",
    "balance": "Kinetic and potential energy, the work that was done, and what is left over.",
    "reactions": "Forces and moments in the closures of the loops over time.",
    "sigma": "Distance from singular configurations (0 on one), and how the steps were chosen.",
}
"""Kinds of pictures of a report, each with its caption."""


def mechanism_section(solution: Solution) -> str:
    """Picture, provenance, joints, bodies, loops, forces and drives."""
    mechanism = solution.mechanism
    model = mechanism.model
    source = mechanism.source
    rows = [("name", mechanism.name)]
    if source is None:
        rows.append(("read from", "built in Python"))
    else:
        rows += [("read from", source.path), ("format", source.format), ("base", source.base)]
    gravity = ", ".join(f"{g:.6g}" for g in model.gravity.linear)
    mass = sum(inertia.mass for inertia in list(model.inertias)[1:])
    rows += [("gravity", f"[{gravity}] m/s²"), ("moving mass", f"{mass:.6g} kg")]
    notes = (*mechanism.notes, *mechanism.structure.notes)
    start = solution.span[0]
    still = ""
    try:
        data = draw_snapshot(solution, start)
        caption = f"The mechanism at the start of the run, t = {start:.6g} s."
        words = f"Drawing of the bodies of {mechanism.name} at the start of the run"
        still = picture(data, "image/png", words, caption)
    except InputError as error:
        still = paragraph(f"It cannot be drawn: {error}")
    return section(
        "mechanism",
        "The mechanism",
        "Bodies that joints connect to a tree, and loops that close it.",
        still,
        table(rows),
        subsection(
            "Joints",
            table(
                joint_rows(mechanism),
                ("joint", "type", "position at the start", "rate at the start"),
            ),
        ),
        subsection(
            "Bodies",
            table(
                body_rows(mechanism),
                ("links", "carried by joint", "mass", "centre of mass in the joint's frame"),
                numbers=[2],
            ),
        ),
        subsection(
            "Loops",
            paragraph(
                "A closure ties a point or frame of one body, a, to one of another, b; world is "
                "the ground. The gap is how far it is open."
            )
            if mechanism.loops
            else paragraph("There are none: it is an open chain."),
            table(
                (
                    (*row, loop.kind.summary)
                    for row, loop in zip(loop_rows(mechanism), mechanism.loops)
                ),
                ("loop", "type", "a", "b", "gap at the start", "what the type keeps"),
            ),
        ),
        subsection(
            "Force elements",
            table(force_rows(mechanism), ("force", "type", "acts on", "values")),
        ),
        subsection(
            "Drives", table(drive_rows(mechanism), ("drive", "law", "what it moves", "values"))
        ),
        subsection("Notes", *(paragraph(note) for note in notes)),
    )


def animation_section(solution: Solution) -> str:
    """The page of the animation in a frame.

    Raises
    ------
    InputError
        If it cannot be made.
    """
    page = page_of(solution, FRAMES_PER_SECOND, OverlayOptions(), panel=True)
    name = text(solution.mechanism.name)
    marks = " Red marks on the time slider are passages through singular configurations."
    return section(
        "animation",
        "The motion",
        "The run as it moved, in real time. The mouse turns, shifts and zooms the picture."
        + marks * bool(solution.crossings),
        f'<iframe title="Animation of {name}" srcdoc="{text(page)}"></iframe>',
    )


def freedom_section(mechanism: Mechanism) -> str:
    """Degrees of freedom, counted and true, and what is redundant."""
    values = dict(mechanism_rows(mechanism))
    rows = [(name, values[name], words) for name, words in FREEDOM.items() if name in values]
    undetermined = mechanism.mobility.indeterminate_rows
    rows.append(
        (
            "reactions not determined",
            ", ".join(undetermined) or "none",
            "Closure rows whose forces equilibrium alone does not give, because rigid bodies share "
            "them in any way; reported are the smallest.",
        )
    )
    return section(
        "freedom",
        "Degrees of freedom",
        "How many independent motions there are, by count and in truth: where the two differ, "
        "conditions are redundant.",
        table(rows, ("quantity", "value", "what it means")),
    )


def run_section(solution: Solution) -> str:
    """Settings, statistics, singular passages."""
    return section(
        "run",
        "The run",
        "How the motion was computed, and what that took.",
        paragraph(solution.message),
        subsection("Settings", table(_settings(solution))),
        subsection("Statistics", table(_statistics(solution), ("quantity", "value", "meaning"))),
        _passages(solution),
        _events(solution),
    )


def _settings(solution: Solution) -> list[tuple[str, str]]:
    settings, start = solution.settings, solution.span[0]
    scheme = TABLEAUS.get(settings.tableau)
    order = "" if scheme is None else f", a Runge-Kutta scheme of order {scheme.order}"
    request = solution.request
    rows = [
        ("method", settings.method),
        ("scheme", f"{settings.tableau}{order}"),
        ("start", f"{start:.6g} s"),
    ]
    if request is not None:
        rows.append(("end asked for", f"{request.t_end:.6g} s"))
    if settings.step is not None:
        rows.append(("step", f"{settings.step:.6g} s, fixed"))
    else:
        low, high = min(settings.atol), max(settings.atol)
        absolute = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        rows += [
            ("relative tolerance", f"{settings.rtol:.3g}"),
            ("absolute tolerance", f"{absolute} (rad, m, and per second)"),
        ]
    rows.append(("placement of steps", settings.placement))
    if settings.singular_times:
        times = ", ".join(f"{t:.6g}" for t in settings.singular_times)
        rows.append(("times that steps avoid", f"{times} s"))
    if settings.controlled:
        rows.append(("controller or forces in Python", "yes"))
    return rows


def _statistics(solution: Solution) -> list[tuple[str, str, str]]:
    return [(name, value, RUN[name]) for name, value in run_rows(solution) if name in RUN]


def _passages(solution: Solution) -> str:
    crossings = solution.crossings
    shown = crossings[:MOST_PASSAGES]
    loops = len(solution.mechanism.loops)
    named, followed = loops <= NAMED_LOOPS, len(shown) * loops**2 <= MOST_LABOUR
    rows = [
        (
            f"{crossing.time:.9g}",
            crossing.participants.names if named else "not told",
            f"{crossing.sigma:.2g}",
            _branch(crossing) if followed else "not told",
            PRECAUTIONS.get(crossing.placement, "none needed"),
        )
        for crossing in shown
    ]
    more = len(crossings) - len(rows)
    return subsection(
        "Singular passages" if crossings or solution.bifurcations else "",
        paragraph(
            "In these configurations the closures lose rank and several motions branch off; "
            "momentum decides which one the mechanism takes. sigma is the distance from them: 0 on "
            "one, about 1 far away; no step may evaluate the equations too close to 0."
        )
        if crossings
        else "",
        table(
            rows,
            ("time (s)", "loops that lose rank", "smallest sigma", "branch", "precaution"),
            numbers=[2],
        ),
        paragraph(f"{more} more are not listed.") if more > 0 else "",
        ""
        if not rows or (named and followed)
        else paragraph(
            "What is not told takes minutes to find out with so many loops and passages; "
            "solution.crossings has it."
        ),
        *(paragraph(f"{bifurcation}.") for bifurcation in solution.bifurcations),
    )


def _branch(crossing: Crossing) -> str:
    count, before, after = len(crossing.branches), crossing.arrived_on, crossing.left_on
    if before is None or after is None:
        return "not told"
    if before == after:
        return f"kept ({count} meet)"
    return f"left on another one ({count} meet)"


def _events(solution: Solution) -> str:
    if solution.t_events is None:
        return ""
    rows = []
    for k, times in enumerate(solution.t_events, start=1):
        shown = ", ".join(f"{t:.9g}" for t in times[:10])
        rows.append((str(k), str(len(times)), shown + (" ..." if len(times) > 10 else "")))
    return subsection("Events", table(rows, ("event", "times met", "at t (s)"), numbers=[1]))


def pictures_section(solution: Solution, kinds: Sequence[str]) -> str:
    """Figures of the run."""
    parts, missing = [], []
    crossings = solution.crossings
    for kind in kinds:
        if kind == "sigma" and not crossings:
            continue  # the picture of the run has it
        if kind == "reactions" and not solution.mechanism.constrained:
            continue
        try:
            figure = solution.plot(kind=kind)
        except InputError as error:
            missing.append(f"{PICTURES[kind]} Not drawn: {error}")
            continue
        parts.append(drawing(figure, f"Plot: {PICTURES[kind]}", PICTURES[kind]))
    return section(
        "pictures",
        "Pictures of the run",
        "Thin dashed vertical lines are passages through singular configurations."
        if crossings
        else "What it did over time.",
        *parts,
        *map(paragraph, missing),
    )


def drawing(figure: object, description: str, caption: str) -> str:
    """A figure of Matplotlib, as lines, or as pixels where these would be too many."""
    out = io.BytesIO()
    figure.savefig(out, format="svg", metadata={"Date": None})  # type: ignore[attr-defined]
    if len(out.getvalue()) <= LARGEST_DRAWING:
        return picture(out.getvalue(), "image/svg+xml", description, caption)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=PIXELS_PER_INCH)  # type: ignore[attr-defined]
    return picture(out.getvalue(), "image/png", description, caption)


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
    pass

    units = solution.mechanism.structure.units
    caption = (
        f"The difference over time, positions over 1 rad or {units.length:.3g} m, rates over those "
        f"times {units.rate:.3g}/s."
    )
    figure = draw_errors(solution, estimate.comparison)
    return drawing(figure, "Plot: difference to the other run over time", caption)
