"""The one driver: propose a step, make it, judge it, record it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.errors import ControllerError, EvaluationError, EventError
from srm_mbs.integration.breakpoints import BreakpointHandler
from srm_mbs.integration.control.step_size import StepDecision, StepSizeControl
from srm_mbs.integration.dense_output import StepData, step_data
from srm_mbs.integration.events import EventWatch, Stop
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method, StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau

SMALLEST_STEP = 1e-14
"""Steps shorter than this fraction of the run, or than round-off of t, end it."""


WATCHED_STEPS = 5000
STANDSTILL = 1e-6
"""A run that covers less than this part of itself in WATCHED_STEPS steps would need more than
5e9 of them."""
LARGE_CORRECTION = 1e-3
"""Below this an end correction closes the loops to its square: nothing to look at."""
OPEN = 1e-9
"""Closure error before a correction, in row units, from which it is looked at whether the
correction closes it."""
LOST = 1e-2
"""Closure error after the correction, in row units, from which a run is meaningless."""

BELOW_ROUND_OFF = "a step this short is below the round-off of the time"
NOT_FINITE = "the state is no longer finite"


@dataclass(frozen=True)
class ProblemVocabulary:
    """What messages call the problem: what is singular, what drives it, what to check."""

    singular: str
    forces: str
    goes_on: str


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


@dataclass(frozen=True)
class Attempt:
    """A step that did not stand: where it started, its length, its error ratio, and why."""

    t: float
    h: float
    error_ratio: float
    verdict: StepDecision


@dataclass
class RunRecord:
    """Everything a run produced, complete at any moment it is stopped.

    The compiled kernel makes its own kind (:mod:`srm_mbs.integration.kernel`).

    Attributes
    ----------
    t0, x0
        Where it started.
    steps
        Accepted steps in order.
    times
        Their end times (s), exact where a step was made to end on a given time.
    attempts
        Steps that were rejected or redone.
    status
        ``running``, ``finished``, ``event``, ``interrupted`` or ``failed``.
    message
        When, why, and what to try.
    stop
        Where a terminal event ended the run (s), within the last step; None without one.
    breaks
        Numbers of the steps after which a breakpoint lies.
    """

    t0: float
    x0: FloatArray
    steps: list[StepResult] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    attempts: list[Attempt] = field(default_factory=list)
    status: str = "running"
    message: str = ""
    stop: float | None = None
    wall_time: float = 0.0
    breaks: list[int] = field(default_factory=list)

    def finished(self, t_end: float) -> None:
        """Mark it as complete."""
        self.status = "finished"
        self.message = f"The run reached t = {t_end:.6g} s."

    def ended(self, stop: Stop) -> None:
        """Mark it as ended by a terminal event."""
        self.status, self.stop, self.message = "event", stop.time, stop.message

    def mark_aborted(self, t: float, error: BaseException) -> None:
        """Mark it as interrupted, or failed because a function of the user did, at ``t``."""
        kept = "verything up to there is kept."
        if isinstance(error, KeyboardInterrupt):
            self.status, self.message = "interrupted", f"Interrupted at t = {t:.6g} s; e{kept}"
        else:
            self.status, self.message = "failed", f"Stopped at t = {t:.6g} s: {error}. E{kept}"

    def data(self, scheme: ButcherTableau, tangent_size: int) -> StepData:
        """The accepted steps as arrays."""
        return step_data(
            self.t0,
            self.x0,
            self.times,
            self.steps,
            scheme,
            tangent_size,
            self.stop,
            self.breaks,
        )


Tick = Callable[[float, float, FloatArray], None]
"""(t, h, state), called after every accepted step."""


def integrate(
    system: System,
    method: Method,
    control: StepSizeControl,
    norm: ErrorNorm,
    memory: IntegratorState,
    state: FloatArray,
    t0: float,
    t_end: float,
    *,
    max_step: float = np.inf,
    tick: Tick | None = None,
    events: EventWatch | None = None,
    breakpoints: BreakpointHandler | None = None,
    words: ProblemVocabulary = MECHANISM,
) -> RunRecord:
    """Integrate from ``t0`` to ``t_end``; never raises for what happens on the way.

    Parameters
    ----------
    system, method, control, norm
        What is integrated, how, with which step-size control and error norm.
    memory
        From ``method.start`` at ``state``.
    state
        Initial state.
    max_step
        Longest step (s).
    tick
        Called after every accepted step.
    events
        Looks for events in every accepted step.
    breakpoints
        Where the right-hand side is not smooth; None if it is.
    words
        What the message of a failure calls the problem.

    Returns
    -------
    RunRecord
        With status ``finished``, or ``event`` after a terminal event; or ``failed`` or
        ``interrupted`` (Ctrl-C), with everything computed so far.
    """
    record = RunRecord(t0, state.copy())
    smallest = SMALLEST_STEP * abs(t_end - t0)
    started = time.perf_counter()
    closures = Closures(system, norm)
    t, x = t0, state
    trouble = ""
    redone = False
    if breakpoints is not None:
        control.set_target_time(breakpoints.end)
    try:
        if events is not None:
            events.begin(t, x)
        while t < t_end:
            if breakpoints is not None and t >= breakpoints.end:
                record.breaks.append(len(record.times))
                memory = breakpoints.next(t, x, memory)
                control.set_target_time(breakpoints.end)
            limit = min(max_step, system.step_limit(x))
            proposal = control.propose(t, limit, memory)
            if proposal.arriving and breakpoints is not None:
                memory = breakpoints.arrive(t, x, memory)
                continue
            h = proposal.h
            if not h > max(smallest, 4.0 * np.spacing(abs(t))):
                if not (record.attempts and record.attempts[-1].t == t):
                    trouble = BELOW_ROUND_OFF
                fail(record, t, h, memory, trouble, control.adaptive, words)
                break
            if len(record.times) % WATCHED_STEPS == 0 and _stands_still(record, t, t_end):
                covered = t - record.times[-WATCHED_STEPS]
                fail(record, t, h, memory, standstill(covered, words), control.adaptive, words)
                break
            result: StepResult | None
            try:
                result = method.step(system, t, h, x, memory, norm)
            except EvaluationError as error:
                result = None
                trouble = str(error)
            verdict = control.decide(proposal, result)
            placement = "redone" if redone else "a priori" if proposal.placed else ""
            redone = verdict is StepDecision.REPLACED
            if verdict is not StepDecision.ACCEPTED or result is None:
                ratio = np.inf if result is None else result.error_ratio
                record.attempts.append(Attempt(t, h, ratio, verdict))
                if not control.adaptive and verdict is StepDecision.REJECTED:
                    fail(record, t, h, memory, trouble or NOT_FINITE, False, words)
                    break
                continue
            trouble = ""
            reason = closures.trouble(result)
            if reason:
                fail(record, t, h, memory, reason, control.adaptive, words)
                break
            result.placement = placement
            method.accept(memory, result)
            start, t, x = x, proposal.t_new, result.state
            record.times.append(t)
            record.steps.append(result)
            stop = None if events is None else events.after_step(start, result, t)
            if stop is not None:
                record.ended(stop)
                break
            if tick is not None:
                call_progress(tick, t, h, x)
        else:
            record.finished(t_end)
    except (KeyboardInterrupt, ControllerError, EvaluationError, EventError) as error:
        record.mark_aborted(t, error)
    # An interrupt between the two appends would leave one list longer.
    del record.times[min(len(record.times), len(record.steps)) :]
    del record.steps[len(record.times) :]
    record.wall_time = time.perf_counter() - started
    return record


def standstill(covered: float, words: ProblemVocabulary = MECHANISM) -> str:
    """What is wrong where WATCHED_STEPS steps covered only ``covered`` (s)."""
    return (
        f"the last {WATCHED_STEPS} steps covered only {covered:.1e} s; {words.forces} changes too "
        "fast or is not smooth"
    )


def _stands_still(record: RunRecord, t: float, t_end: float) -> bool:
    """Whether the last steps covered so little that the run would never end."""
    if len(record.times) < WATCHED_STEPS:
        return False
    return t - record.times[-WATCHED_STEPS] < STANDSTILL * (t_end - record.t0)


def call_progress(tick: Tick, t: float, h: float, x: FloatArray) -> None:
    """Call ``tick`` with a copy of ``x``; what it raises must not lose the run."""
    try:
        tick(t, h, x.copy())
    except Exception as error:
        raise ControllerError(f"the progress callback raised {error!r} at t = {t:.6g} s") from error


class Closures:
    """Looks at whether the loops stay closed; almost always without computing anything."""

    def __init__(self, system: System, norm: ErrorNorm) -> None:
        self._system = system
        self._large = LARGE_CORRECTION * norm.one
        self._seen = OPEN

    def trouble(self, result: StepResult) -> str:
        """What is wrong with the closures at the end of a step; empty if nothing is."""
        # Far from everything singular, a step within the tolerance has a correction to match.
        if (
            result.quiet
            and 0.0 < result.error_ratio <= 1.0
            and result.constraint_residual <= self._seen
        ):
            return ""
        if not result.correction.size:
            return ""
        large = (
            not (np.abs(result.correction) < self._large).all()
            or not result.constraint_residual < LOST
        )
        # With every structural row in use the correction closes all rows, or the rank is wrong.
        unused = result.zone is None and result.constraint_residual > 2.0 * self._seen
        if not (large or unused):
            return ""
        residual = self._system.constraint_residual(result.t + result.h, result.state)
        if not residual < LOST:
            return "the step is so long that the loops come apart"
        if unused and residual > 0.5 * result.constraint_residual:
            return (
                "closures that seemed to follow from the others open: no motion was found that "
                "keeps all loops closed and follows all drives, the mechanism is locked there"
            )
        self._seen = max(self._seen, result.constraint_residual)
        return ""


def fail(
    record: RunRecord,
    t: float,
    h: float,
    memory: IntegratorState,
    trouble: str,
    adaptive: bool,
    words: ProblemVocabulary = MECHANISM,
) -> None:
    """Mark ``record`` as failed at ``t`` with the step ``h`` and say why.

    Parameters
    ----------
    memory
        At ``t``.
    trouble
        Why; empty if no step was short enough for the error estimate.
    adaptive
        Whether steps follow a tolerance.
    words
        What the message calls the problem.
    """
    record.status = "failed"
    reason = trouble or "the error estimate stays above the tolerance however small the step"
    close = memory.sigma < 0.05
    near = f" {words.singular} (sigma = {memory.sigma:.1e})." if close else ""
    record.message = (
        f"Stopped at t = {t:.6g} s with step {h:.1e} s: {reason}.{near} "
        f"Everything up to there is kept. Try a smaller {'rtol' if adaptive else 'step'}, another "
        f"tableau, or check that {words.goes_on}."
    )
