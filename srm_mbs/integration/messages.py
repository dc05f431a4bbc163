"""Sentences of a run's message: why it stopped, and where its motion may be wrong.

:class:`StopReason` is the reason for programs; the sentence beside it is for readers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from srm_mbs.integration.methods.base import ErrorNorm, Method, StepResult

NEAR_SINGULAR_SIGMA = 0.05
"""sigma below which the message of a failure names the singular configuration."""
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


def failure_message(
    failure: RunFailure,
    t: float,
    h: float,
    sigma: float,
    adaptive: bool,
    words: ProblemVocabulary = MECHANISM,
) -> str:
    """The message of a run that failed.

    Parameters
    ----------
    t, h
        Where it stopped, and the length of the last step that was tried (s).
    sigma
        sigma there.
    adaptive
        Whether steps follow a tolerance.
    words
        Names of the problem.
    """
    near = f" {words.singular} (sigma = {sigma:.1e})." if sigma < NEAR_SINGULAR_SIGMA else ""
    return (
        f"Stopped at t = {t:.6g} s with step {h:.1e} s: {failure.sentence}.{near} "
        f"Everything up to there is kept. Try a smaller {'rtol' if adaptive else 'step'}, another "
        f"tableau, or check that {words.check}."
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


def method_messages(method: Method, steps: Sequence[StepResult], norm: ErrorNorm) -> str:
    """Sentences of ``method`` about its limits that the accepted ``steps`` of a run met."""
    own = getattr(method, "run_messages", None)
    return "" if own is None else str(own(steps, norm))
