"""Sentences of a run's message: why it stopped, and where its motion may be wrong.

:class:`StopReason` is the reason for programs; the sentence beside it is for readers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from srm_mbs.errors import time_text
from srm_mbs.integration.methods.butcher import ButcherTableau

TIMES_LISTED = 5
"""Times listed in a sentence, at most."""


class StopReason(Enum):
    """Why a run could not continue."""

    ERROR_ESTIMATE = "the error estimate stays above the tolerance however small the step"
    ROUND_OFF = "a step this short is below the round-off of the time"
    STANDSTILL = "many steps covered almost no time"
    NOT_EVALUATED = "a stage could not be evaluated"
    NOT_FINITE = "the state is no longer finite"
    LOOPS_APART = "the step is so long that the loops come apart"
    LOCKED = (
        "closures that seemed to follow from the others open: no motion was found that keeps all "
        "loops closed and follows all drives, the mechanism is locked there"
    )
    MEMORY = "the steps take too much memory"
    UNSTABLE_SWEEPS = "the sweeps do not damp their constraint errors"


@dataclass(frozen=True)
class RunFailure:
    """Why a run could not continue: the reason, a sentence for the message of the run, and what to
    do if that is known (a clause that begins with a verb)."""

    reason: StopReason
    sentence: str
    remedy: str | None = None

    @classmethod
    def of(cls, reason: StopReason) -> RunFailure:
        """With the sentence of the reason itself."""
        return cls(reason, reason.value)


@dataclass(frozen=True)
class FailureCause:
    """Why a run failed: a clause for its message, and the remedy, which begins with a verb."""

    clause: str
    remedy: str


@dataclass(frozen=True)
class ProblemVocabulary:
    """Phrases of messages that name the problem: its singularity, its forces, and a check."""

    singular: str
    forces: str
    check: str


MECHANISM = ProblemVocabulary(
    "The closures are close to a singular configuration",
    "what acts on the mechanism",
    "the mechanism can move on from there (solution.q[-1])",
)
DAE = ProblemVocabulary(
    "G B is almost singular there",
    "its right-hand side",
    "the problem has a solution from there on (solution.x[-1])",
)


def stiffness_sentence(
    intervals: Sequence[tuple[float, float]],
    scheme: ButcherTableau,
    adaptive: bool,
    unit: str = " s",
) -> str:
    """A sentence about where a run was found to be stiff; empty where it was not.

    Parameters
    ----------
    intervals
        Their starts and ends (s).
    scheme
        The tableau of the run.
    adaptive
        Whether steps follow a tolerance.
    unit
        Of the times.
    """
    if not intervals or not adaptive:
        return ""
    listed = ", ".join(
        f"{time_text(start)} to {time_text(end)}{unit}" for start, end in intervals[:TIMES_LISTED]
    )
    more = ", ..." if len(intervals) > TIMES_LISTED else ""
    if scheme.stiff is not None:
        return f" Stiff, with steps of {scheme.stiff.name}: t = {listed}{more}."
    return (
        f" The run is stiff from t = {time_text(intervals[0][0])}{unit} on: the stability of "
        f'{scheme.name} limits its steps, not their accuracy. Use tableau="auto" or "rodas5p".'
    )


def branch_changes(times: Sequence[float], what: str, remedy: str, unit: str = " s") -> str:
    """A sentence naming the times at which the motion may have changed its branch.

    Parameters
    ----------
    times
        The branch guard's suspect times (s).
    what
        What happened there: "the velocity turned".
    remedy
        A sentence.
    unit
        Of the times.
    """
    if not times:
        return ""
    listed = ", ".join(time_text(t) for t in times[:TIMES_LISTED]) + (
        ", ..." if len(times) > TIMES_LISTED else ""
    )
    return (
        f" Next to singular configurations, up to t = {listed}{unit}, {what} and no shorter "
        f"step mended it: the motion may have changed its branch. {remedy}"
    )
