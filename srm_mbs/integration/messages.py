"""Sentences of a run's message: why it stopped, and where its motion may be wrong.

:class:`StopReason` is the reason for programs; the sentence beside it is for readers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

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
    UNSTABLE_SWEEPS = "the sweeps do not damp their constraint errors"


@dataclass(frozen=True)
class RunFailure:
    """Why a run could not continue: the reason, and a sentence for the message of the run."""

    reason: StopReason
    sentence: str

    @classmethod
    def of(cls, reason: StopReason) -> RunFailure:
        """With the sentence of the reason itself."""
        return cls(reason, reason.value)


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


def branch_changes(times: Sequence[float], what: str, remedy: str) -> str:
    """A sentence naming the times at which the motion may have changed its branch.

    Parameters
    ----------
    times
        The branch guard's suspect times (s).
    what
        What happened there: "the velocity turned".
    remedy
        A sentence.
    """
    if not times:
        return ""
    listed = ", ".join(f"{t:.6g}" for t in times[:TIMES_LISTED]) + (
        ", ..." if len(times) > TIMES_LISTED else ""
    )
    return (
        f" Next to singular configurations, up to t = {listed} s, {what} and no shorter step "
        f"mended it: the motion may have changed its branch. {remedy}"
    )
