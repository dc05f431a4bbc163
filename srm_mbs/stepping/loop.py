"""The one driver: propose a step, make it, judge it, record it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import ControllerError, EvaluationError, EventError
from srm_mbs.methods.base import ErrorNorm, Memory, Method, StepResult
from srm_mbs.stepping.events import EventWatch
from srm_mbs.stepping.stepsize import StepSizeControl, Verdict
from srm_mbs.systems.base import System

log = logging.getLogger(__name__)

SMALLEST_STEP = 1e-14
"""Steps shorter than this fraction of the run, or than round-off of t, end it."""


LARGE_CORRECTION = 1e-3
"""Below this an end correction closes the loops to its square: nothing to look at."""
LOST = 1e-2
"""Closure error after the correction, in row units, from which a run is meaningless."""


@dataclass(frozen=True)
class Attempt:
    """A step that did not stand: where it started, its length, its error ratio, and why."""

    t: float
    h: float
    error_ratio: float
    verdict: Verdict


@dataclass
class RunRecord:
    """Everything a run produced, complete at any moment it is stopped.

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


Tick = Callable[[float, float, FloatArray], None]
"""(t, h, state), called after every accepted step."""


def integrate(
    system: System,
    method: Method,
    control: StepSizeControl,
    norm: ErrorNorm,
    memory: Memory,
    state: FloatArray,
    t0: float,
    t_end: float,
    *,
    max_step: float = np.inf,
    tick: Tick | None = None,
    events: EventWatch | None = None,
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

    Returns
    -------
    RunRecord
        With status ``finished``, or ``event`` after a terminal event; or ``failed`` or
        ``interrupted`` (Ctrl-C), with everything computed so far.
    """
    record = RunRecord(t0, state.copy())
    smallest = SMALLEST_STEP * abs(t_end - t0)
    started = time.perf_counter()
    t, x = t0, state
    trouble = ""
    redone = False
    try:
        if events is not None:
            events.begin(t, x)
        while t < t_end:
            limit = min(max_step, system.step_limit(x))
            proposal = control.propose(t, limit, memory)
            h = proposal.h
            if not h > max(smallest, 4.0 * np.spacing(abs(t))):
                _fail(record, t, h, memory, trouble, control.adaptive)
                break
            result: StepResult | None
            try:
                result = method.step(system, t, h, x, memory, norm)
            except EvaluationError as error:
                result = None
                trouble = str(error)
            verdict = control.judge(proposal, result)
            placement = "redone" if redone else "a priori" if proposal.placed else ""
            redone = verdict is Verdict.REPLACED
            if verdict is not Verdict.ACCEPTED or result is None:
                ratio = np.inf if result is None else result.error_ratio
                record.attempts.append(Attempt(t, h, ratio, verdict))
                if not control.adaptive and verdict is Verdict.REJECTED:
                    _fail(record, t, h, memory, trouble or "the state is no longer finite", False)
                    break
                continue
            trouble = ""
            if _closures_lost(system, norm, result):
                reason = "the step is so long that the loops come apart"
                _fail(record, t, h, memory, reason, control.adaptive)
                break
            result.placement = placement
            method.accept(memory, result)
            start, t, x = x, proposal.t_new, result.state
            record.times.append(t)
            record.steps.append(result)
            stop = None if events is None else events.after_step(start, result, t)
            if stop is not None:
                record.status, record.stop, record.message = "event", stop.time, stop.message
                break
            if tick is not None:
                tick(t, h, x)
        else:
            record.status = "finished"
            record.message = f"The run reached t = {t_end:.6g} s."
    except KeyboardInterrupt:
        record.status = "interrupted"
        record.message = f"Interrupted at t = {t:.6g} s; everything up to there is kept."
    except (ControllerError, EventError) as error:
        record.status = "failed"
        record.message = f"Stopped at t = {t:.6g} s: {error}. Everything up to there is kept."
    # An interrupt between the two appends would leave one list longer.
    del record.times[min(len(record.times), len(record.steps)) :]
    del record.steps[len(record.times) :]
    record.wall_time = time.perf_counter() - started
    log.info("%s", record.message)
    return record


def _closures_lost(system: System, norm: ErrorNorm, result: StepResult) -> bool:
    """Whether the end correction was too large to close the loops again."""
    # atol over rtol is the size that the tolerances call "one", whatever the unit of length.
    large = LARGE_CORRECTION * norm.one
    if not result.correction.size or (np.abs(result.correction) < large).all():
        return False
    return not system.closure_gap(result.t + result.h, result.state) < LOST


def _fail(
    record: RunRecord, t: float, h: float, memory: Memory, trouble: str, adaptive: bool
) -> None:
    record.status = "failed"
    reason = trouble or "the error estimate stays above the tolerance however small the step"
    near = (
        f" The closures are close to a singular configuration (sigma = {memory.sigma:.1e})."
        if memory.sigma < 0.05
        else ""
    )
    record.message = (
        f"Stopped at t = {t:.6g} s with step {h:.1e} s: {reason}.{near} "
        f"Everything up to there is kept. Try a smaller {'rtol' if adaptive else 'step'}, another "
        "tableau, or check that the mechanism can move on from there (solution.q[-1])."
    )
