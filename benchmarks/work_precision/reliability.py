"""Right branch, median and worst error over many start speeds, with settings nobody tuned."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.work_precision.harness import attempt, errors_of
from benchmarks.work_precision.peers.base import Budget, NotApplicableError, Peer
from benchmarks.work_precision.problems.base import Problem
from benchmarks.work_precision.problems.n_four_bars import n_four_bar
from benchmarks.work_precision.problems.slider_cranks import whirl
from benchmarks.work_precision.records import Results, Skipped
from benchmarks.work_precision.references import Reference, reduced_reference

SPEEDS = 20
FAMILIES: tuple[tuple[str, Callable[[float], Problem], float, float], ...] = (
    ("slider_crank_whirl", whirl, 1.5, 5.3),  # rad/s; from 1.32 on it turns over the top
    ("n_four_bar_1", lambda speed: n_four_bar(1, speed), 0.5, 4.3),  # m/s
    ("n_four_bar_2", lambda speed: n_four_bar(2, speed), 0.5, 4.3),
)
RIGHT = 0.1
"""Largest error (rad, rad/s) of a run that is on the right branch: a wrong one is off by more."""
LIMIT = 5.0
"""CPU seconds after which a run counts as failed."""


def _with_reference(problem: Problem) -> Problem:
    model = problem.reduced
    if model is None:
        raise ValueError(f"{problem.name} has no reduced model")

    def reference() -> Reference:
        return reduced_reference(model.field, model.start, problem.times)

    return replace(problem, reference_of=reference)


def error_of(problem: Problem, peer: Peer) -> tuple[float | None, str]:
    """Error of the peer's everyday setting on ``problem``, None if it failed; and why."""
    outcome = attempt(problem, peer.prepare(problem), peer.everyday(problem))
    if isinstance(outcome, str):
        return None, outcome
    error = errors_of(problem, outcome[0])[0]
    return (error, "ok") if math.isfinite(error) else (None, "failed: the state is not finite")


def summary(errors: Sequence[float | None]) -> dict[str, Any]:
    """How many are on the right branch; median and worst error, None where a run failed."""
    values = [math.inf if error is None else error for error in errors]
    median, worst = statistics.median(values), max(values)
    return {
        "right": sum(value <= RIGHT for value in values),
        "median": median if math.isfinite(median) else None,
        "worst": worst if math.isfinite(worst) else None,
    }


def measure_reliability(
    peers: Sequence[Peer], results: Results, *, thin: bool, say: Callable[[str], None]
) -> None:
    """Append a row per family and installed peer."""
    Budget.seconds = LIMIT
    installed: list[Peer] = []
    for peer in peers:
        missing = peer.missing()
        if missing is None:
            installed.append(peer)
        else:
            say(f"reliability, {peer.name}: skipped, {missing} is not installed")
            results.skipped.append(Skipped(peer.name, f"{missing} is not installed"))
    for name, family, low, high in FAMILIES:
        problems = [
            _with_reference(family(float(speed)))
            for speed in np.linspace(low, high, 3 if thin else SPEEDS)
        ]
        for peer in installed:
            runs = []
            try:
                for problem in problems:
                    error, status = error_of(problem, peer)
                    assert problem.reduced is not None  # noqa: S101 - _with_reference looked
                    speed = abs(problem.reduced.start[1])
                    runs.append({"speed": speed, "error": error, "status": status})
            except NotApplicableError:
                continue
            setting = peer.everyday(problems[0])
            row = {
                "problem": name,
                "peer": peer.name,
                "title": peer.title,
                "setting": f"{setting.kind} {setting.value:.0e} {setting.variant}".strip(),
                "runs": runs,
                **summary([run["error"] for run in runs]),
            }
            results.reliability.append(row)
            say(
                f"reliability {name}, {peer.name}: {row['right']} of {len(runs)} on the right "
                f"branch, median {row['median']}, worst {row['worst']}"
            )
