"""One page about a run: mechanism, motion, settings, accuracy and pictures in a single file.

It needs neither a network nor a server, and can be printed.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from srm_mbs.analysis.accuracy.certificate import Certificate, certify
from srm_mbs.analysis.report.html import paragraph, text
from srm_mbs.analysis.report.sections import (
    MARKS,
    PICTURES,
    accuracy_section,
    animation_section,
    freedom_section,
    mechanism_section,
    pictures_section,
    run_section,
)
from srm_mbs.errors import InputError, __version__
from srm_mbs.simulation.result import Solution
from srm_mbs.visualization.animation.page import filled, write_page

CONTENTS = {
    "mechanism": "The mechanism",
    "animation": "The motion",
    "freedom": "Degrees of freedom",
    "run": "The run",
    "accuracy": "Accuracy",
    "pictures": "Pictures",
}


def write_report(
    solution: Solution,
    path: str | Path,
    *,
    animation: bool = True,
    pictures: Sequence[str] = tuple(PICTURES),
    certificate: Certificate | None = None,
    rtol: float | None = None,
    again: bool = True,
    progress: Any = False,
) -> None:
    """Write one page about a run: :meth:`srm_mbs.Solution.report`, ``srm-mbs report``.

    Parameters
    ----------
    solution
        A run, finished or not, also one from disk.
    path
        Name of the file, usually ``.html``; an existing one is replaced.
    animation
        Whether it holds the animation, which is most of the file; a still picture there is anyway.
    pictures
        Kinds of plots (:meth:`srm_mbs.Solution.plot`) among ``run``, ``state``, ``balance``,
        ``reactions`` and ``sigma``; those that the run has not are left out with a sentence.
    certificate
        From :func:`srm_mbs.certify` of this run; made with ``rtol``, ``again`` and ``progress`` if
        it is not given.
    rtol, again, progress
        As for :func:`srm_mbs.certify`.

    Raises
    ------
    InputError
        If ``rtol`` or a kind of plot cannot be used, or the animation or the file cannot be made.
    """
    check_pictures(pictures)
    if certificate is None:
        certificate = certify(solution, rtol=rtol, again=again, progress=progress)
    page = report_page(solution, certificate, animation=animation, pictures=pictures)
    write_page(page, Path(path))


def report_page(
    solution: Solution,
    certificate: Certificate,
    *,
    animation: bool = True,
    pictures: Sequence[str] = tuple(PICTURES),
) -> str:
    """The page of :func:`write_report`."""
    check_pictures(pictures)
    sections = [
        ("mechanism", mechanism_section(solution)),
        *([("animation", animation_section(solution))] if animation else []),
        ("freedom", freedom_section(solution.mechanism)),
        ("run", run_section(solution)),
        ("accuracy", accuracy_section(solution, certificate)),
        *([("pictures", pictures_section(solution, pictures))] if pictures else []),
    ]
    name = solution.mechanism.name
    links = "".join(f'<a href="#{key}">{text(CONTENTS[key])}</a>' for key, _ in sections)
    body = [
        f"<header><h1>{text(name)}: report of a run</h1>{_about()}</header>",
        f'<nav aria-label="Contents">{links}</nav>',
        f"<main>{_summary(solution, certificate)}",
        *(content for _, content in sections),
        "</main>",
    ]
    parts = {"title": text(f"{name}: report of a run"), "body": "\n".join(body)}
    return filled("report.html", parts)


def check_pictures(kinds: Sequence[str]) -> None:
    """Refuse a kind of plot that reports do not have.

    Raises
    ------
    InputError
        Naming those that they have.
    """
    for kind in kinds:
        if kind not in PICTURES:
            raise InputError(
                f"reports have no picture of the kind {kind!r}",
                element="pictures",
                remedy=f"Known: {', '.join(PICTURES)}",
            )


def _about() -> str:
    today = datetime.date.today().isoformat()
    words = f"Written on {today} by srm_mbs {__version__}, which simulates mechanisms with"
    return paragraph(
        f"{words} closed kinematic loops. Units are SI; angles are in radians.", "about"
    )


def _summary(solution: Solution, certificate: Certificate) -> str:
    """What the page says, in a few sentences."""
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
    lines = [
        f"Mechanism: {shape}.",
        f"Run: {end - start:.6g} s of motion in {steps} steps; {solution.status}.{passed}",
        f"Accuracy, overall {MARKS[certificate.grade]}.",
        *(f"{finding.topic.capitalize()}: {finding.text}" for finding in shown),
    ]
    return f'<div class="summary">{"".join(map(paragraph, lines))}</div>'
