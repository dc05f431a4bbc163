"""The driver: propose a step, make it, decide on it, record it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple, Protocol

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.errors import ControllerError, EvaluationError, EventError, raised, time_text
from srm_mbs.integration.breakpoints import BreakpointHandler
from srm_mbs.integration.control.step_size import (
    Proposal,
    StepDecision,
    StepSizeControl,
    longest_from_rest,
)
from srm_mbs.integration.critical_passages import CriticalPassages
from srm_mbs.integration.dense_output import StepData, step_data
from srm_mbs.integration.events import EventWatch, Stop, step_dense
from srm_mbs.integration.messages import (
    MECHANISM,
    FailureCause,
    ProblemVocabulary,
    RunFailure,
    StopReason,
)
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method, StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.reversals import ReversalSearch

SMALLEST_STEP = 1e-14
"""Shortest step, over the length of the run."""
WATCHED_STEPS = 5000
"""Steps over which the progress of a run is measured."""
MANY_STEPS = 1e5
"""Remaining steps of an interrupted run from which its message says what may shorten them."""
STANDSTILL = 1e-6
"""Part of the run that WATCHED_STEPS steps must cover: a slower one would need 5e9 steps."""
LARGE_CORRECTION = 1e-3
"""Correction at the end of a step, over the unit of the tolerance, from which the closures are
examined; a smaller one closes them to its square."""
RESIDUAL_EXAMINED = 1e-9
"""Constraint residual before a correction, in row units, from which the closures are examined."""
MAX_JUMP_STEPS = 20
"""Lengths with which a step that passes a jump of forces is tried."""
LARGEST_RESIDUAL = 1e-2
"""Constraint residual after the correction, in row units, from which a run is meaningless."""
NAMED_SIGMA = 0.05
"""sigma below which the message of a failure names the singular configuration."""


class RunStatus(StrEnum):
    """How a run ended.  Equal to, and printed as, the string of its value."""

    RUNNING = "running"
    FINISHED = "finished"
    EVENT = "event"
    """A terminal event ended it."""
    INTERRUPTED = "interrupted"
    """By Ctrl-C."""
    FAILED = "failed"
    """The run could not continue, or a function of the user raised."""

    def __repr__(self) -> str:
        return repr(self.value)


class Attempt(NamedTuple):
    """A step that was not accepted: its start, its length, its error ratio, and the decision."""

    t: float
    h: float
    error_ratio: float
    decision: StepDecision


class EndOfSteps(NamedTuple):
    """How the steps of a run end, of one whose steps no :class:`StepSink` took.

    Attributes
    ----------
    start
        Start of the run (s).
    last_start, last_time
        Start and end of the last step (s); both the start of the run without any.
    time, state
        End of the run (s), in the last step where a terminal event ended it, and the state there
        (nx,); None where the dense output has to find it.
    stiff
        Whether the last step was stiff.
    on_curve
        Whether they end on the curve past a critical configuration.
    """

    start: float
    last_start: float
    last_time: float
    time: float
    state: FloatArray | None
    stiff: bool
    on_curve: bool = False


@dataclass
class RunRecord:
    """Everything a run produced, complete at any moment it is stopped.

    The compiled kernel makes its own kind (:mod:`srm_mbs.integration.kernel`).

    Attributes
    ----------
    t0, x0
        Start of the run (s), and the state there (nx,).
    steps
        Accepted steps in order.
    times
        Their end times (s), exact where a step was made to end on a given time.
    attempts
        Steps that were rejected or redone.
    status
        How it ended.
    stop_reason
        Of a failed run, why no further step could be made; None where a function of the user
        raised.
    message
        When, why, and what to try.
    cause
        Of a failed run, what led to it, as far as it is known.
    error
        The exception that ended it, with its traceback; None without one.
    time_unit
        That of the :class:`~srm_mbs.dynamics.system.System`.
    stop, stop_state
        Time (s) and state (nx,) where a terminal event ended the run, within the last step; None
        without one.
    breaks
        Numbers of the steps after which a breakpoint lies.
    made
        Number of accepted steps, also of those that a :class:`StepSink` took.
    watched_time
        End (s) of the first of the last WATCHED_STEPS of them.
    rest
        Time (s) and state (nx,) at the start of the steps that are still here; None if none was
        taken.
    memory
        The integrator's state after the last of them, of a run of the reference.
    """

    t0: float
    x0: FloatArray
    time_unit: str = field(default=" s", kw_only=True)
    steps: list[StepResult] = field(default_factory=list, init=False)
    times: list[float] = field(default_factory=list, init=False)
    attempts: list[Attempt] = field(default_factory=list, init=False)
    status: RunStatus = field(default=RunStatus.RUNNING, init=False)
    stop_reason: StopReason | None = field(default=None, init=False)
    message: str = field(default="", init=False)
    error: BaseException | None = field(default=None, init=False)
    stop: float | None = field(default=None, init=False)
    stop_state: FloatArray | None = field(default=None, init=False)
    wall_time: float = field(default=0.0, init=False)
    breaks: list[int] = field(default_factory=list, init=False)
    made: int = field(default=0, init=False)
    watched_time: float = field(default=0.0, init=False)
    rest: tuple[float, FloatArray] | None = field(default=None, init=False)
    memory: IntegratorState | None = field(default=None, init=False)
    cause: FailureCause | None = field(default=None, init=False)
    _failure: tuple[RunFailure, float, float, float, bool, ProblemVocabulary] | None = field(
        default=None, init=False
    )
    """Arguments of :meth:`mark_failed`."""

    def mark_finished(self, t_end: float) -> None:
        """Mark it as complete."""
        self.status = RunStatus.FINISHED
        self.message = f"The run reached t = {time_text(t_end)}{self.time_unit}."

    def mark_stopped(self, stop: Stop) -> None:
        """Mark it as ended by a terminal event."""
        self.status, self.stop, self.message = RunStatus.EVENT, stop.time, stop.message
        self.stop_state = stop.state

    def mark_aborted(self, t: float, error: BaseException) -> None:
        """Mark it as interrupted, or failed because a function of the user raised, at ``t``."""
        at = f"{time_text(t)}{self.time_unit}"
        if isinstance(error, KeyboardInterrupt):
            self.status = RunStatus.INTERRUPTED
            self.message = f"Interrupted at t = {at}; everything up to there is kept."
        else:
            self.status = RunStatus.FAILED
            self.error = error
            self.message = f"Stopped at t = {at}: {error}. Everything up to there is kept."

    def add_pace(self, t_end: float, remedy: str) -> None:
        """Say in the message of an interrupted run to ``t_end`` (s) how many steps remain, with the
        sentence ``remedy`` if they are many."""
        end = self.end_of_steps()
        h = end.last_time - end.last_start
        if h > 0.0:
            left = (t_end - end.last_time) / h
            length = f"{h:.1e}{self.time_unit}"
            self.message += f" The last step was {length} long; {left:.1e} such steps remain."
            self.message += f" {remedy}" if left > MANY_STEPS else ""

    def mark_failed(
        self,
        failure: RunFailure,
        t: float,
        h: float,
        sigma: float,
        adaptive: bool,
        words: ProblemVocabulary = MECHANISM,
    ) -> None:
        """Mark it as failed.

        Parameters
        ----------
        t, h
            Where it stopped, and the length of the last step that was tried (s).
        sigma
            sigma there.
        adaptive
            Whether steps follow a tolerance.
        words
            How the message names the problem.
        """
        self.status, self.stop_reason = RunStatus.FAILED, failure.reason
        self._failure = failure, t, h, sigma, adaptive, words
        self.message = self._failure_message()

    def lead_with(self, cause: FailureCause) -> None:
        """Let the message of a run whose steps failed begin with the ``cause``."""
        self.cause = cause
        self.message = self._failure_message()

    def _failure_message(self) -> str:
        if self._failure is None:
            return self.message
        failure, t, h, sigma, adaptive, words = self._failure
        near = f" {words.singular} (sigma = {sigma:.1e})." if sigma < NAMED_SIGMA else ""
        remedy = failure.remedy or (
            f"Try a smaller {'rtol' if adaptive else 'step'}, another tableau, or check that "
            f"{words.check}"
        )
        step = f"step {h:.1e}{self.time_unit}"
        stopped = f" with {step}: {failure.sentence}"
        if self.cause is not None:
            remedy = self.cause.remedy
            stopped = f": {self.cause.clause}. With {step}, {failure.sentence}"
        return (
            f"Stopped at t = {time_text(t)}{self.time_unit}{stopped}.{near} Everything up to there "
            f"is kept. {remedy}."
        )

    @property
    def last_state(self) -> FloatArray:
        """State (nx,) at the end of the last step."""
        if self.steps:
            return self.steps[-1].state
        return self.x0 if self.rest is None else self.rest[1]

    def end_of_steps(self) -> EndOfSteps:
        """The end of the steps."""
        if not self.steps:
            return EndOfSteps(self.t0, self.t0, self.t0, self.t0, None, False)
        last = self.steps[-1]
        # The dense output of a single step is that in which the event was found.
        state = self.stop_state if self.made == 1 else None
        time = self.times[-1] if self.stop is None else self.stop
        on_curve = last.placement == "critical" and time == self.times[-1]
        return EndOfSteps(self.t0, last.t, self.times[-1], time, state, last.stiff, on_curve)

    def close(self) -> None:
        """Let go of the steps, which arrays have, and of what made them."""
        self.steps, self.times = [], []

    def data(self, scheme: ButcherTableau, tangent_size: int) -> StepData:
        """The accepted steps as arrays."""
        t0, x0 = (self.t0, self.x0) if self.rest is None else self.rest
        return step_data(
            t0,
            x0,
            self.times,
            self.steps,
            scheme,
            tangent_size,
            self.stop,
            self.breaks,
        )


class StepSink(Protocol):
    """Takes the steps of a run from its record, so that they need no memory."""

    @property
    def block(self) -> int:
        """Number of steps that it takes at once."""

    def take(self, data: StepData) -> None:
        """Take the next steps."""


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
    passages: CriticalPassages | None = None,
    words: ProblemVocabulary = MECHANISM,
    sink: StepSink | None = None,
) -> RunRecord:
    """Integrate from ``t0`` to ``t_end``; errors on the way end the run, and are not raised.

    Parameters
    ----------
    system, method, control, norm
        The equations, the one-step method, the step-size control and the error norm.
    memory
        From ``method.start`` at ``state``.
    state
        Initial state.
    max_step
        Longest step (s).
    tick
        Called after every accepted step.
    events
        Finds events in every accepted step.
    breakpoints
        Where the right-hand side is not smooth; None if it is.
    passages
        Makes the passages of critical configurations that steps cannot make; None for systems
        whose steps are to make them all.
    words
        How the message of a failure names the problem.
    sink
        Takes the steps; they remain in the record without one.

    Returns
    -------
    RunRecord
        With status ``finished``, or ``event`` after a terminal event; or ``failed`` or
        ``interrupted`` (Ctrl-C), with everything computed so far.
    """
    record = RunRecord(t0, state.copy(), time_unit=system.time_unit)
    started = time.perf_counter()
    closures = Closures(system, norm)
    t, x = t0, state
    unevaluated: RunFailure | None = None
    redone = False
    jump = JumpSearch(system, norm)
    rest_limit = math.inf
    if breakpoints is not None:
        control.set_target_time(breakpoints.end)

    def accept(result: StepResult, t_new: float) -> bool:
        """Move to the end of a step; whether a terminal event ends the run there."""
        nonlocal t, x, rest_limit
        method.accept(memory, result)
        rest_limit = math.inf
        start, t, x = x, t_new, result.state
        record.times.append(t)
        record.steps.append(result)
        if record.made % WATCHED_STEPS == 0:
            record.watched_time = t
        record.made += 1
        stop = None
        if events is not None:
            dense = step_dense(system, method.scheme, start, result, t)
            stop = events.after_step(result.t, t, x, dense)
        if stop is not None:
            if passages is not None and result.placement == "critical" and stop.time < t:
                to_event = passages.steps_to(result.t, start, stop.time)
                if to_event:
                    record.steps[-1:], record.times[-1:] = map(list, zip(*to_event))
                    stop = stop._replace(state=record.last_state)
            record.mark_stopped(stop)
            return True
        if tick is not None:
            call_progress(tick, t, result.h, x, system.time_unit)
        return False

    def pass_critical(zero: float | None, expected: bool) -> bool:
        """Make the passage at ``zero`` (s), which is ``expected`` or lies in a step, or go on with
        one that is under way, if steps cannot make it; whether it was made."""
        if passages is None or (zero is None and not passages.under_way):
            return False
        end = t_end if breakpoints is None else breakpoints.end
        if zero is None:
            past = passages.steps_on(t, x, end)
        else:
            past = passages.steps_past(t, x, memory.rate, zero, end, expected)
        if past and not any(accept(step, t_new) for step, t_new in past):
            control.moved(t)
        return bool(past)

    def restarted() -> IntegratorState:
        """``memory`` with the first stage at t evaluated again."""
        if breakpoints is not None:
            return breakpoints.past_jump(t, x, memory)
        system.begin_step(t, x)
        return method.resume(system, t, x, memory, norm)

    try:
        if events is not None:
            events.begin(t, x)
        while t < t_end and record.stop is None:
            if breakpoints is not None and t >= breakpoints.end:
                if record.times:
                    record.breaks.append(len(record.times))
                on_curve = passages is not None and passages.under_way
                memory = breakpoints.next(t, x, memory, evaluated=not on_curve)
                control.set_target_time(breakpoints.end)
                rest_limit = longest_from_rest(system, memory, norm, breakpoints.end - t)
            if passages is not None and passages.under_way:
                if not pass_critical(None, False):
                    memory = restarted()
                continue
            if system.rescale(t, x):
                memory = restarted()
            limit = min(max_step, system.step_limit(x), jump.limit, rest_limit)
            if passages is not None:
                limit = min(limit, passages.curve_limit)
            proposal = control.propose(t, limit, memory)
            if proposal.singular_arrival and breakpoints is not None:
                memory = breakpoints.singular_arrival(t, x, memory)
                continue
            h = proposal.h
            expected = control.next_zero()
            if pass_critical(None if passages is None else passages.unexamined(expected, t), True):
                continue
            last = proposal.t_new == (t_end if breakpoints is None else breakpoints.end)
            failure = _no_further_step(record, t, h, last, t_end, unevaluated, words)
            if failure is not None:
                record.mark_failed(failure, t, h, memory.sigma, control.adaptive, words)
                break
            result: StepResult | None
            system.begin_step(t, x)
            try:
                result = method.step(system, t, h, x, memory, norm)
            except EvaluationError as error:
                result = None
                unevaluated = RunFailure(StopReason.NOT_EVALUATED, str(error))
            if result is not None and pass_critical(
                None if passages is None else passages.crossing(x, result), False
            ):
                continue
            if (
                result is not None
                and passages is not None
                and control.adaptive
                and passages.changes_curve(x, result)
            ):
                continue
            if result is not None and jump.misses(proposal, memory, result, control.adaptive):
                continue
            decision = control.decide(proposal, result)
            placement = "redone" if redone else "a priori" if proposal.placed else ""
            redone = decision is StepDecision.REPLACED
            if decision is not StepDecision.ACCEPTED or result is None:
                ratio = np.inf if result is None else result.error_ratio
                record.attempts.append(Attempt(t, h, ratio, decision))
                if not control.adaptive and decision is StepDecision.REJECTED:
                    failure = unevaluated or RunFailure.of(StopReason.NOT_FINITE)
                    record.mark_failed(failure, t, h, memory.sigma, False, words)
                    break
                continue
            unevaluated = None
            failure = closures.failure(result)
            if failure is not None:
                record.mark_failed(failure, t, h, memory.sigma, control.adaptive, words)
                break
            result.placement = placement
            if passages is not None:
                passages.accepted(result)
            if accept(result, proposal.t_new):
                break
            if jump.found() and t < (t_end if breakpoints is None else breakpoints.end):
                record.breaks.append(len(record.times))
                memory = restarted()
            if sink is not None and len(record.steps) >= sink.block:
                sink.take(record.data(method.scheme, system.tangent_size))
                record.rest = t, x
                for taken in (record.steps, record.times, record.breaks):
                    taken.clear()
        if record.status is RunStatus.RUNNING:
            record.mark_finished(t_end)
    except (KeyboardInterrupt, ControllerError, EvaluationError, EventError) as error:
        record.mark_aborted(t, error)
    # An interrupt between the two appends would leave one list longer.
    del record.times[min(len(record.times), len(record.steps)) :]
    del record.steps[len(record.times) :]
    record.wall_time, record.memory = time.perf_counter() - started, memory
    return record


def _no_further_step(
    record: RunRecord,
    t: float,
    h: float,
    last: bool,
    t_end: float,
    unevaluated: RunFailure | None,
    words: ProblemVocabulary,
) -> RunFailure | None:
    """Why the run cannot continue from ``t`` with a step ``h`` (s); None if it can.

    Parameters
    ----------
    last
        Whether the step leads to the end of the run or of a smooth interval, which may be close.
    unevaluated
        Why the last attempt could not be evaluated.
    """
    shortest = max(SMALLEST_STEP * abs(t_end - record.t0), 4.0 * np.spacing(abs(t)))
    if not (last or h > shortest):
        if not (record.attempts and record.attempts[-1].t == t):
            return RunFailure.of(StopReason.ROUND_OFF)
        return unevaluated or RunFailure.of(StopReason.ERROR_ESTIMATE)
    if record.made >= WATCHED_STEPS and record.made % WATCHED_STEPS == 0:
        covered = t - record.watched_time
        if covered < STANDSTILL * (t_end - record.t0):
            return standstill(covered, words, record.time_unit)
    return None


def standstill(
    covered: float, words: ProblemVocabulary = MECHANISM, unit: str = " s"
) -> RunFailure:
    """The failure of a run whose last WATCHED_STEPS steps covered only ``covered`` (s)."""
    return RunFailure(
        StopReason.STANDSTILL,
        f"the last {WATCHED_STEPS} steps covered only {covered:.1e}{unit}; {words.forces} changes "
        "too fast or is not smooth",
    )


def call_progress(tick: Tick, t: float, h: float, x: FloatArray, unit: str = " s") -> None:
    """Call ``tick`` with a copy of ``x``; an exception of it does not lose the run."""
    try:
        tick(t, h, x.copy())
    except Exception as error:
        raise ControllerError(
            raised("the progress callback", error, f"at t = {time_text(t)}{unit}")
        ) from error


class JumpSearch:
    """Looks for the end of a step that passes a jump of forces: on the jump, or beside the layer in
    which the friction of a joint changes its sign (:mod:`srm_mbs.integration.reversals`).

    The step is made again with other lengths, by Newton's method for the time of the jump; the
    forces are smooth over the step (:meth:`~srm_mbs.dynamics.system.System.begin_step`).  A step
    over a layer is cut, whatever its error: that is unknown.

    Attributes
    ----------
    limit
        Longest next step (s).
    """

    def __init__(self, system: System, norm: ErrorNorm) -> None:
        self._system = system
        self._reversals = ReversalSearch(system, norm)
        self._on_jump = False
        self.limit, self._tries = np.inf, 0

    def misses(
        self, proposal: Proposal, memory: IntegratorState, result: StepResult, adaptive: bool
    ) -> bool:
        """Whether the step ``result`` from ``memory`` is to be made again, with another length."""
        h = proposal.h
        late = self._system.past_jump(proposal.t_new, result.state)
        self._on_jump = late == 0.0
        turned = self._reversals.late(memory, result) if adaptive else -np.inf
        if adaptive and not result.error_ratio <= 1.0 and not turned > 0.0:
            return False
        late = max(late, turned)
        short = h == self.limit and -h < late < 0.0
        if self._tries == MAX_JUMP_STEPS or not (late > 0.0 or short):
            return False
        self.limit = h - late if late < h else 0.5 * h
        self._tries += 1
        return True

    def found(self) -> bool:
        """Whether the step made last, which is accepted, ends on a jump; the search is over."""
        on_jump, self._on_jump = self._on_jump, False
        self.limit, self._tries = np.inf, 0
        return on_jump


class Closures:
    """Examines whether the loops stay closed; almost always without computing anything."""

    def __init__(self, system: System, norm: ErrorNorm) -> None:
        self._system = system
        self._large = LARGE_CORRECTION * norm.one
        self._examined = RESIDUAL_EXAMINED

    def failure(self, result: StepResult) -> RunFailure | None:
        """Why the closures at the end of a step do not hold; None if they do."""
        residual = result.constraint_residual
        # Far from everything singular, a step within the tolerance has a correction to match.
        if result.quiet and 0.0 < result.error_ratio <= 1.0 and residual <= self._examined:
            return None
        if not result.correction.size:
            return None
        large = not (np.abs(result.correction) < self._large).all()
        large = large or not residual < LARGEST_RESIDUAL
        # With every structural row in use the correction closes all rows, or the rank is wrong.
        unused = result.zone is None and residual > 2.0 * self._examined
        if not (large or unused):
            return None
        left = self._system.constraint_residual(result.t + result.h, result.state)
        if not left < LARGEST_RESIDUAL:
            return RunFailure.of(StopReason.LOOPS_APART)
        if unused and left > 0.5 * residual:
            return RunFailure.of(StopReason.LOCKED)
        self._examined = max(self._examined, residual)
        return None
