"""Data of the sections of a report; their text is in ``report.html.j2``."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from srm_mbs.analysis.accuracy.assessment import Grade
from srm_mbs.analysis.accuracy.certificate import Certificate
from srm_mbs.analysis.accuracy.error_estimate import Comparison, ErrorEstimate
from srm_mbs.analysis.summary import (
    body_rows,
    drive_rows,
    force_rows,
    joint_rows,
    loop_rows,
    mechanism_rows,
    run_rows,
)
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import ControllerError, EvaluationError, InputError, time_text
from srm_mbs.formats.files import file_name
from srm_mbs.integration.methods.tableaus import TABLEAUS
from srm_mbs.integration.singular_passages import Crossing
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.animation.page import NAMED_LOOPS
from srm_mbs.visualization.animation.snapshot import draw_snapshot
from srm_mbs.visualization.plotting import plot_solution
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

MAX_LISTED_PASSAGES = 100
"""Most passages that are listed one by one."""
MAX_BRANCH_WORK = 3000
"""Most passages times squared number of loops for which branches are followed: some 20 s."""
MAX_DRAWING = 250_000
"""Largest vector drawing (bytes); larger ones are embedded as pixels."""
PIXELS_PER_INCH = 160
SMALLEST_DIFFERENCE = 1e-9
"""Smallest difference that is drawn, over the largest: zeros at the start would make the axis
long."""
MAX_STATES = 1000
"""Most states at which reactions are computed for the table of the largest ones."""
NOT_COMPUTED = "not computed"

FREEDOM = {
    "degrees of freedom": "Independent motions that remain.",
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
"""Meanings of the rows of :func:`srm_mbs.analysis.summary.mechanism_rows`."""
RUN = {
    "status": "finished, ended by an event, failed, or interrupted",
    "computed by": "Both give the same results; the kernel is faster.",
    "steps": "Accepted time steps.",
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
"""Meanings of the rows of :func:`srm_mbs.analysis.summary.run_rows`."""
PRECAUTIONS = {
    "a priori": "step changed in advance",
    "redone": "step redone",
    "zone": "reactions predicted",
}
"""Precautions at a singular passage."""
PICTURES = {
    "run": "Closure errors, energy, distance from singular configurations (0 on one), and lengths "
    "of the steps over time.",
    "state": "Positions and rates of the joints over time.",
    "balance": "Kinetic and potential energy, the work that was done, and the residual.",
    "reactions": "Forces and moments in the closures of the loops and in the joints over time.",
    "sigma": "Distance from singular configurations (0 on one), and how the steps were chosen.",
}
"""Kinds of plots of a report, each with its caption."""
GRADE_LABELS: dict[Grade, str] = {
    "good": "✓ good",
    "fair": "~ fair",
    "poor": "✗ poor",
    "unknown": "? open",
}
"""Each grade as a sign and a word, so that it is legible without its colour."""


def _image(data: bytes, media_type: str, description: str, caption: str) -> dict[str, str]:
    """An image within the page: data URI, alternative text, and the text below the image."""
    source = f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"
    return {"source": source, "description": description, "caption": caption}


def _about(mechanism: Mechanism, text: object, full_paths: bool) -> str:
    """``text`` about ``mechanism``, without the folders of its files unless ``full_paths``."""
    source = mechanism.source
    return str(text) if full_paths or source is None else source.without_folders(str(text))


def mechanism_data(solution: SimulationResult, full_paths: bool) -> dict[str, Any]:
    """Snapshot, provenance, joints, bodies, loops, forces and drives."""
    mechanism = solution.mechanism
    model = mechanism.model
    source = mechanism.source
    rows = [("name", mechanism.name)]
    if source is None:
        rows.append(("read from", "built in Python"))
    else:
        path = source.path if full_paths else file_name(source.path)
        rows += [("read from", path), ("format", source.format), ("base", source.base)]
    gravity = ", ".join(f"{g:.6g}" for g in model.gravity.linear)
    mass = sum(inertia.mass for inertia in list(model.inertias)[1:])
    rows += [("gravity", f"[{gravity}] m/s²"), ("moving mass", f"{mass:.6g} kg")]
    snapshot, problem = None, ""
    start = solution.span[0]
    try:
        snapshot = _image(
            draw_snapshot(solution, start),
            "image/png",
            f"Drawing of the bodies of {mechanism.name} at the start of the run",
            f"The mechanism at the start of the run, t = {time_text(start)} s.",
        )
    except InputError as error:
        problem = _about(mechanism, error, full_paths)
    return {
        "properties": rows,
        "snapshot": snapshot,
        "snapshot_problem": problem,
        "joints": list(joint_rows(mechanism)),
        "bodies": list(body_rows(mechanism)),
        "loops": [
            (*row, loop.kind.summary) for row, loop in zip(loop_rows(mechanism), mechanism.loops)
        ],
        "forces": list(force_rows(mechanism)),
        "drives": list(drive_rows(mechanism)),
        "notes": [
            _about(mechanism, note, full_paths)
            for note in (*mechanism.notes, *mechanism.structure.notes)
        ],
    }


def freedom_rows(mechanism: Mechanism) -> list[tuple[str, str, str]]:
    """Degrees of freedom, counted and true, and redundancy: (quantity, value, meaning)."""
    values = dict(mechanism_rows(mechanism))
    rows = [(name, values[name], words) for name, words in FREEDOM.items() if name in values]
    undetermined = mechanism.mobility.indeterminate_rows
    rows.append(
        (
            "reactions not determined",
            ", ".join(undetermined) or "none",
            "Closure rows whose forces equilibrium alone does not determine, because rigid bodies "
            "can share them in any way; reported are those of least norm.",
        )
    )
    return rows


def run_data(solution: SimulationResult) -> dict[str, Any]:
    """Settings, statistics, singular passages and events."""
    return {
        "message": solution.message,
        "settings": _settings(solution),
        "statistics": [
            (name, value, RUN[name]) for name, value in run_rows(solution) if name in RUN
        ],
        "bifurcations": [str(bifurcation) for bifurcation in solution.bifurcations],
        "events": _events(solution),
        "reactions": reaction_rows(solution),
        **_passages(solution),
    }


def _settings(solution: SimulationResult) -> list[tuple[str, str]]:
    settings, start = solution.settings, solution.span[0]
    scheme = TABLEAUS.get(settings.tableau)
    order = "" if scheme is None else f", a Runge-Kutta scheme of order {scheme.order}"
    request = solution.request
    rows = [
        ("method", settings.method),
        ("scheme", f"{settings.tableau}{order}"),
        ("start", f"{time_text(start)} s"),
    ]
    if request is not None:
        rows.append(("end asked for", f"{time_text(request.t_end)} s"))
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
        times = ", ".join(time_text(t) for t in settings.singular_times)
        rows.append(("times that steps avoid", f"{times} s"))
    if settings.controlled:
        rows.append(("controller or forces in Python", "yes"))
    return rows


def reaction_rows(solution: SimulationResult) -> list[tuple[str, ...]]:
    """Largest force and moment of each closure and joint at the ends of the steps, with their
    times: (name, N, s, N m, s).  None for a loaded run that had a controller."""
    times = (
        solution.t
        if len(solution.t) <= MAX_STATES
        else solution.t[:: -(-len(solution.t) // MAX_STATES)]
    )
    run = solution if len(times) == len(solution.t) else solution.at(times)
    try:
        tables = {"closure": run.reactions, "joint": run.joint_reactions}
    except (InputError, ControllerError, EvaluationError):
        return []
    rows = []
    for kind, table in tables.items():
        for name, wrench in table.items():
            cells = [f"{kind} {name}"]
            for part in (wrench[:, :3], wrench[:, 3:]):
                sizes = np.linalg.norm(part, axis=1)
                cells += [f"{sizes.max():.4g}", f"{run.t[int(np.argmax(sizes))]:.4g}"]
            rows.append(tuple(cells))
    return rows


def _passages(solution: SimulationResult) -> dict[str, Any]:
    """Rows of the singular passages, and what they leave out."""
    crossings = solution.crossings
    listed = crossings[:MAX_LISTED_PASSAGES]
    loops = len(solution.mechanism.loops)
    named, followed = loops <= NAMED_LOOPS, len(listed) * loops**2 <= MAX_BRANCH_WORK
    return {
        "passages": [
            (
                f"{crossing.time:.9g}",
                crossing.participants.names if named else NOT_COMPUTED,
                f"{crossing.sigma:.2g}",
                _residual(crossing) if named else NOT_COMPUTED,
                _branch(crossing) if followed else NOT_COMPUTED,
                PRECAUTIONS.get(crossing.placement, "none needed"),
            )
            for crossing in listed
        ],
        "unlisted_passages": len(crossings) - len(listed),
        "passages_abridged": not (named and followed),
    }


def _residual(crossing: Crossing) -> str:
    return "none found" if crossing.residual is None else f"{abs(crossing.residual):.1e}"


def _branch(crossing: Crossing) -> str:
    if crossing.kind == "avoided":
        return "none: the residual keeps the branches apart"
    count, before, after = len(crossing.branches), crossing.arrived_on, crossing.left_on
    if before is None or after is None:
        return "not known"
    if before == after:
        return f"kept ({count} meet)"
    return f"left on another one ({count} meet)"


def _events(solution: SimulationResult) -> list[tuple[str, str, str]]:
    """(number, times met, first times) of each event."""
    rows = []
    for k, times in enumerate(solution.t_events or (), start=1):
        first = ", ".join(f"{t:.9g}" for t in times[:10])
        rows.append((str(k), str(len(times)), first + (" ..." if len(times) > 10 else "")))
    return rows


def pictures_data(
    solution: SimulationResult, kinds: Sequence[str], full_paths: bool = False
) -> dict[str, Any]:
    """Plots of the run, and sentences about those that it does not have."""
    images, missing = [], []
    for kind in kinds:
        if kind == "sigma" and not solution.crossings:
            continue  # the plot of kind "run" shows it
        try:
            figure = plot_solution(solution, None, kind, {})
        except InputError as error:
            problem = _about(solution.mechanism, error, full_paths)
            missing.append(f"{PICTURES[kind]} Not drawn: {problem}")
            continue
        images.append(_plot_image(figure, f"Plot: {PICTURES[kind]}", PICTURES[kind]))
    return {"images": images, "missing": missing}


def _plot_image(figure: Figure, description: str, caption: str) -> dict[str, str]:
    """A figure of Matplotlib as a vector drawing, or as pixels if that would be too large."""
    out = io.BytesIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    media_type = "image/svg+xml"
    if len(out.getvalue()) > MAX_DRAWING:
        out, media_type = io.BytesIO(), "image/png"
        figure.savefig(out, format="png", dpi=PIXELS_PER_INCH)
    return _image(out.getvalue(), media_type, description, caption)


def accuracy_data(solution: SimulationResult, certificate: Certificate) -> dict[str, Any]:
    """Assessments, drift, energy balance, and the error estimate with the runs it compares."""
    estimate = certificate.estimate
    return {
        "assessments": certificate.findings,
        "drift": [
            (
                f"closure errors in {row.unit}",
                f"{row.position:.2e} {row.unit}",
                f"{row.rate:.2e} {row.unit}/s",
                f"{row.between_position:.2e} {row.unit}",
                f"{row.between_rate:.2e} {row.unit}/s",
            )
            for row in certificate.drift
        ],
        "energy": _energy(certificate),
        "estimate": None if estimate is None else _estimate(solution, estimate),
    }


def _energy(certificate: Certificate) -> list[tuple[str, str]]:
    energy = certificate.energy
    if energy is None:
        return []
    return [
        ("largest residual", f"{energy.residual:.2e} J"),
        ("energy that took part", f"{energy.scale:.4g} J"),
        ("residual over that", f"{energy.relative:.1e}"),
        ("what does work", ", ".join(energy.works) or "nothing: the energy is conserved"),
    ]


def _estimate(solution: SimulationResult, estimate: ErrorEstimate) -> dict[str, Any]:
    """Estimated error of each joint, the runs that were compared, and the plot over time."""
    units = solution.mechanism.structure.units
    plot = None
    if estimate.comparison.largest:
        plot = _plot_image(
            draw_errors(solution, estimate.comparison),
            "Plot: difference to the other run over time",
            f"The difference over time, positions over 1 rad or {units.length:.3g} m, rates over "
            f"those times {units.rate:.3g}/s.",
        )
    return {
        "meaning": _meaning(estimate),
        "joints": [
            (
                row.joint,
                f"{row.position:.2e} {row.unit}",
                _ratio(row.relative_position),
                f"{row.rate:.2e} {row.unit}/s",
                _ratio(row.relative_rate),
            )
            for row in estimate.joints
        ],
        "setting": "step (s)" if estimate.fixed else "relative tolerance",
        "trials": [
            (
                f"{trial.setting:.3g}" + (" (this run)" if trial.own else ""),
                str(trial.steps),
                str(trial.evaluations),
                f"{trial.wall_time:.3g} s",
                f"{trial.status} at {time_text(trial.end)} s",
                "tightest" if trial.difference is None else f"{trial.difference:.2e}",
            )
            for trial in estimate.trials
        ],
        "slope": _slope(estimate),
        "plot": plot,
    }


def draw_errors(solution: SimulationResult, comparison: Comparison) -> Figure:
    """Largest difference of positions and of rates, in units, over time."""
    size = comparison.size
    lowest = SMALLEST_DIFFERENCE * comparison.largest
    size = np.where(size > lowest, size, np.nan)

    def draw(axes: Axes) -> str:
        mark_times(axes, solution)
        for label, values, style in zip(("positions", "rates"), size.T, line_styles(2)):
            axes.plot(comparison.t, values, label=label, **style)
        log_axis(axes)
        axes.set_ylabel("largest difference\n(relative to units)", fontsize=FONT_SIZE)
        return "difference to the other run"

    return time_panels(solution, [draw], height=2.3)


def _ratio(value: float | None) -> str:
    return "does not move" if value is None else f"{value:.1e}"


def _meaning(estimate: ErrorEstimate) -> str:
    """The run and the time to which the error of each joint refers."""
    if estimate.bound:
        return "The largest difference to the next looser run: the error should be smaller."
    if estimate.apart is not None:
        return (
            f"The largest difference to the tightest run, up to t = "
            f"{time_text(estimate.apart)} s only."
        )
    extrapolated = " It is extrapolated to a step of length zero." * estimate.fixed
    return f"The largest difference to the tightest run, over the whole time.{extrapolated}"


def _slope(estimate: ErrorEstimate) -> str:
    """The observed order, or the slope of log error over log tolerance, as a sentence."""
    if estimate.order is None:
        return "How the error falls was not observed."
    if estimate.fixed:
        expected = estimate.expected_order
        theory = "" if expected is None else f"; the order of the scheme is {expected:g}"
        return f"Observed order: {estimate.order:.2f}{theory}."
    return (
        f"Slope of log error over log tolerance: {estimate.order:.2f}; errors in proportion to "
        "the tolerance would give 1."
    )
