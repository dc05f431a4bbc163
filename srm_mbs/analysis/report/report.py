"""Report of a run: one page with its mechanism, motion, settings, accuracy and plots.

The page is a single file, needs neither a network nor a server, and can be printed.  Its text is in
``report.html.j2``, its data come from :mod:`srm_mbs.analysis.report.sections`.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from srm_mbs.analysis.accuracy.certificate import Certificate, certify
from srm_mbs.analysis.report.sections import (
    GRADE_LABELS,
    PICTURES,
    accuracy_data,
    freedom_rows,
    mechanism_data,
    pictures_data,
    run_data,
)
from srm_mbs.errors import InputError, __version__, known_names, safe_repr, time_text
from srm_mbs.formats.files import checked_path, utf8
from srm_mbs.model.numbers import flag, name_list
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.visualization.animation.overlays import ViewOptions
from srm_mbs.visualization.animation.page import render, write_file
from srm_mbs.visualization.animation.playback import page_of

FOLDER = Path(__file__).parent
FRAMES_PER_SECOND = 30.0
"""Key frames per second of the animation."""
CONTENTS = {
    "mechanism": "The mechanism",
    "animation": "The motion",
    "freedom": "Degrees of freedom",
    "run": "The run",
    "accuracy": "Accuracy",
    "pictures": "Pictures",
}
"""Titles of the sections in the table of contents, by their ids."""


def write_report(
    solution: SimulationResult,
    path: str | Path,
    *,
    animation: bool = True,
    pictures: Sequence[str] | None = None,
    certificate: Certificate | None = None,
    rtol: float | None = None,
    again: bool = True,
    progress: Any = False,
    full_paths: bool = False,
) -> None:
    """Write one page about a run: :meth:`srm_mbs.Solution.report`, ``srm-mbs report``.

    Parameters
    ----------
    solution
        A run, finished or not, also one from disk.
    path
        Name of the file, usually ``.html``; an existing one is replaced.
    animation
        Whether to include the animation, which is most of the file; a snapshot is always included.
    pictures
        Kinds of plots (:meth:`srm_mbs.Solution.plot`) among ``run``, ``state``, ``balance``,
        ``reactions`` and ``sigma``, by default all; a sentence replaces one that this run does not
        have.
    certificate
        From :func:`srm_mbs.certify` of this run; by default it is computed with ``rtol``, ``again``
        and ``progress``.
    rtol, again, progress
        As for :func:`srm_mbs.certify`.
    full_paths
        Whether the page names the folders of the mechanism's files; by default it has the names of
        the files only.

    Raises
    ------
    InputError
        If ``rtol`` or a kind of plot is not valid, or the animation or the file cannot be written.
    """
    file = checked_path(path)
    flag(animation, "animation")
    flag(full_paths, "full_paths")
    pictures = name_list(PICTURES if pictures is None else pictures, "pictures")
    for kind in pictures:
        if kind not in PICTURES:
            raise InputError(
                f"reports have no picture of the kind {safe_repr(kind)}",
                element="pictures",
                remedy=known_names(PICTURES),
            )
    if certificate is None:
        certificate = certify(solution, rtol=rtol, again=again, progress=progress)
    page = report_page(
        solution, certificate, animation=animation, pictures=pictures, full_paths=full_paths
    )
    write_file(file, utf8(page))


def report_page(
    solution: SimulationResult,
    certificate: Certificate,
    *,
    animation: bool = True,
    pictures: Sequence[str],
    full_paths: bool = False,
) -> str:
    """The page of :func:`write_report`."""
    player = None
    if animation:
        player = page_of(solution, FRAMES_PER_SECOND, ViewOptions(), panel=True)
    included = {"animation": animation, "pictures": bool(pictures)}
    return render(
        FOLDER,
        "report.html.j2",
        name=solution.mechanism.name,
        today=datetime.date.today().isoformat(),
        version=__version__,
        contents=[(key, title) for key, title in CONTENTS.items() if included.get(key, True)],
        summary=_summary(solution, certificate),
        passages=bool(solution.crossings),
        grades=GRADE_LABELS,
        mechanism=mechanism_data(solution, full_paths),
        animation=player,
        freedom=freedom_rows(solution.mechanism),
        run=run_data(solution),
        accuracy=accuracy_data(solution, certificate),
        pictures=pictures_data(solution, pictures, full_paths) if pictures else None,
    )


def _summary(solution: SimulationResult, certificate: Certificate) -> list[str]:
    """Sentences that summarise the mechanism, the run and its accuracy."""
    mechanism = solution.mechanism
    start, end = solution.span
    counts = [
        (mechanism.degrees_of_freedom, "degree of freedom", "degrees of freedom"),
        (len(mechanism.joint_names), "joint", "joints"),
        (len(mechanism.loops), "loop", "loops"),
    ]
    shape = ", ".join(f"{n} {one if n == 1 else many}" for n, one, many in counts)
    passages = len(solution.crossings)
    passed = f" It passed {passages} singular configurations." if passages > 1 else ""
    passed = " It passed one singular configuration." if passages == 1 else passed
    steps = solution.stats.steps
    worst = next(f for f in certificate.findings if f.grade == certificate.grade)
    estimate = next(f for f in certificate.findings if f.topic == "estimated error")
    shown = [estimate] if worst.grade == estimate.grade else [worst, estimate]
    return [
        f"Mechanism: {shape}.",
        f"Run: {time_text(end - start)} s of motion in {steps} steps; {solution.status}.{passed}",
        f"Accuracy, overall {GRADE_LABELS[certificate.grade]}.",
        *(f"{finding.topic.capitalize()}: {finding.text}" for finding in shown),
    ]
