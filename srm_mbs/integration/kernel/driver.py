"""Drives a run on the compiled kernel from its start to its record."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.errors import ControllerError, EvaluationError, EventError
from srm_mbs.integration import driver
from srm_mbs.integration.breakpoints import BreakpointHandler
from srm_mbs.integration.critical_passages import CriticalPassages, ExaminedPassage
from srm_mbs.integration.dense_output import StepData, step_bytes
from srm_mbs.integration.driver import EndOfSteps, RunRecord, StepSink, Tick
from srm_mbs.integration.events import EventWatch
from srm_mbs.integration.kernel.events import CompiledEventWatch
from srm_mbs.integration.kernel.marshalling import DECISIONS, steps_from
from srm_mbs.integration.kernel.run import CompiledRun, CompiledStepDense, ReturnReason
from srm_mbs.integration.memory import free_memory
from srm_mbs.integration.messages import RunFailure, StopReason
from srm_mbs.integration.methods.butcher import ButcherTableau


class StepSummary(Protocol):
    """Facts about the steps of a run that most users need, each found where it is read."""

    @property
    def steps(self) -> int:
        """Number of accepted steps."""

    @property
    def zone_steps(self) -> int:
        """Number of those with a zone."""

    @property
    def least_sigma(self) -> float:
        """The least sigma of their stages."""

    @property
    def held(self) -> bool:
        """Whether a stage kept the normals of the last node."""

    @property
    def stiff(self) -> bool:
        """Whether the problem was found to be stiff."""


@dataclass
class CompiledRecord(RunRecord):
    """A run of the kernel.

    Attributes
    ----------
    run
        Holds the steps; None after :meth:`close`.
    placed, replaced
        Numbers of steps that were placed around a singular configuration, and of attempts that
        were repeated for it.
    """

    run: Any
    placed: int = field(default=0, init=False)
    replaced: int = field(default=0, init=False)
    _suspects: Sequence[float] = field(default=(), init=False)
    _records: Any = field(default=None, init=False)
    """The steps, once the run is closed."""
    _data: StepData | None = field(default=None, init=False)
    """The same as arrays, once they were read."""

    def suspect_times(self) -> list[float]:
        """Ends (s) of steps that were accepted although they may have changed the branch."""
        return list(self._suspects if self.run is None else self.run.core.suspect_times())

    def close(self) -> None:
        """Let go of the run, which refers to a workspace; its steps remain."""
        self._suspects, self._records = self.run.core.suspect_times(), self._take_records()
        self.run = None

    def end_of_steps(self) -> EndOfSteps:
        """The end of the steps, before :meth:`close`."""
        core = self.run.core
        if not core.count:
            return EndOfSteps(self.t0, self.t0, self.t0, self.t0, None, False)
        last, t = core.last(), core.t
        state = self.stop_state if core.count == 1 else None
        time = t if self.stop is None else self.stop
        return EndOfSteps(self.t0, last.t, t, time, state, last.stiff, last.critical and time == t)

    def _take_records(self) -> Any:
        start = (self.t0, self.x0) if self.rest is None else self.rest
        return self.run.core.take_records(*start)

    def nodes(self) -> tuple[FloatArray, FloatArray] | None:
        """Times (n + 1,) s and states (n + 1, nx) at the ends of the steps, or at a terminal event
        in the only one; None before :meth:`close`, and where dense output has to find the state of
        the event."""
        records = self._records
        if records is None or self.stop is None:
            return None if records is None else (records.times, records.states)
        times, states = records.times, records.states
        if len(times) != 2:
            return None
        return np.array([times[0], self.stop]), np.array([states[0], self.stop_state])

    def span(self) -> tuple[float, float]:
        """Start and end (s) of the steps that no sink took, after :meth:`close`."""
        start, end = self._records.span
        return start, end if self.stop is None else self.stop

    def summary(self) -> StepSummary | None:
        """The summary of the steps that no sink took, after :meth:`close`; None before."""
        return self._records  # type: ignore[no-any-return]

    def data(self, scheme: ButcherTableau, tangent_size: int) -> StepData:
        """The accepted steps as arrays; after :meth:`close` the same at every call."""
        if self.run is not None:
            return steps_from(self._take_records(), self.stop)
        if self._data is None:
            self._data = steps_from(self._records, self.stop)
        return self._data

    def recorded(self) -> tuple[Any, float | None] | None:
        """Records of the run, and when (s) a terminal event ended it or None, after :meth:`close`;
        None if dense output needs more."""
        return (self._records, self.stop) if self._records.plain else None


def integrate(
    system: ClosedSystem | OpenSystem,
    run: CompiledRun,
    *,
    tick: Tick | None = None,
    events: EventWatch | CompiledEventWatch | None = None,
    passing: BreakpointHandler | None = None,
    passages: CriticalPassages | None = None,
    sink: StepSink | None = None,
    meter: Callable[[], None] | None = None,
) -> CompiledRecord:
    """As :func:`srm_mbs.integration.driver.integrate`, on the kernel.

    Parameters
    ----------
    system
        The mechanism of ``run``.
    tick, events
        With events the kernel returns after every step; with a tick after ``tick.stride`` steps,
        or one.
    passing
        Handles breakpoints, if there are any.
    passages
        Takes the passages of critical configurations that the kernel examined.
    sink
        Takes the steps; they remain in the record without one.
    meter
        Called whenever the kernel returns, which is at least every CHUNK seconds.
    """
    t_start, start = run.t0, run.start
    record = CompiledRecord(run.t0, start, run)
    started = time.perf_counter()
    one_by_one = tick is not None or events is not None
    core = run.core
    size, unnoticed = step_bytes(run.method.scheme, system.tangent_size), NOTICEABLE_BYTES
    try:
        if events is not None:
            events.begin(run.t0, start)
        reason = ReturnReason.CHUNK_FULL
        while reason is not ReturnReason.FINISHED:
            if sink is not None and core.count >= sink.block:
                sink.take(record.data(run.method.scheme, system.tangent_size))
                record.rest = core.t, core.state
            made = core.count if one_by_one or sink is not None else 0
            stride = getattr(tick, "stride", 1) if events is None else 1  # a tick may change it
            block = 0 if sink is None else sink.block - made
            reason = run.advance(stride if one_by_one else block)
            if meter is not None:
                meter()
            if reason is ReturnReason.BREAKPOINT and passing is not None:
                run.pass_breakpoint(passing)
                continue
            if reason is ReturnReason.ARRIVAL and passing is not None:
                run.arrive(passing)
                continue
            if reason not in (ReturnReason.CHUNK_FULL, ReturnReason.FINISHED):
                failure = why_stopped(reason, system, run)
                record.mark_failed(failure, core.t, core.h, core.memory().sigma, run.adaptive)
                break
            if core.count * size > unnoticed and reason is ReturnReason.CHUNK_FULL:
                left = free_memory()
                if core.count * size > left:  # before the system ends the program
                    failure = _out_of_memory(core.count, size)
                    record.mark_failed(failure, core.t, core.h, core.memory().sigma, run.adaptive)
                    break
                unnoticed = core.count * size + BETWEEN_LOOKS * left
            if not one_by_one or core.count == made:
                continue
            t, state = core.t, core.state
            if events is not None:
                if passing is not None:
                    passing.follow(core.interval)
                dense = CompiledStepDense(run, system, start)
                stop = events.after_step(t_start, t, state, dense)
                if stop is not None:
                    if stop.time < t and run.end_at(t_start, start, stop.time, system):
                        stop = stop._replace(state=core.state)
                    record.mark_stopped(stop)
                    break
            t_start, start = t, state
            if tick is not None:
                driver.call_progress(tick, t, core.h, state)
        else:
            record.mark_finished(run.t_end)
    except (KeyboardInterrupt, ControllerError, EvaluationError, EventError) as error:
        record.mark_aborted(core.t, error)
    attempts: Sequence[tuple[float, float, float, int]] = core.attempts()
    record.attempts = [
        driver.Attempt(t, h, ratio, DECISIONS[decision]) for t, h, ratio, decision in attempts
    ]
    record.placed, record.replaced = core.placed, core.replaced
    if passages is not None:
        passages.examined = [ExaminedPassage(*values) for values in core.examined()]
    system.count(run.kernel_system.evaluations, run.kernel_system.factorisations)
    record.wall_time = time.perf_counter() - started
    return record


NOTICEABLE_BYTES = 1e8
"""Size of the steps from which on it is compared with the memory that is left."""
BETWEEN_LOOKS = 0.1
"""Its growth from one comparison to the next, over the memory that is left."""


def _out_of_memory(count: int, size: int) -> RunFailure:
    """The failure of a run with ``count`` steps of ``size`` bytes."""
    return RunFailure(
        StopReason.MEMORY,
        f"its {count} steps take {count * size / 1e9:.2g} GB, half of the memory that was left",
        "Give t_eval, the output times: the run then keeps no other state",
    )


def why_stopped(
    reason: ReturnReason, system: ClosedSystem | OpenSystem, run: CompiledRun
) -> RunFailure:
    """The reason why the kernel stopped, from the reference, which repeats the failed attempt."""
    core = run.core
    attempts: Sequence[tuple[float, float, float, int]] = core.attempts()
    if reason is ReturnReason.STANDSTILL:
        return driver.standstill(core.t - core.watched_time)
    if reason is ReturnReason.CLOSURES:
        failure = driver.Closures(system, run.norm).failure(run.last())
        return failure or RunFailure.of(StopReason.ERROR_ESTIMATE)
    if reason is ReturnReason.TOO_SHORT and not (attempts and attempts[-1][0] == core.t):
        return RunFailure.of(StopReason.ROUND_OFF)
    if core.evaluation_failed:
        failed = [h for t, h, ratio, _ in attempts if t == core.t and np.isinf(ratio)]
        # Where a step can just be evaluated, rounding decides: the reference may not fail at the
        # last one.
        for h in reversed(failed):
            try:
                run.method.step(system, core.t, h, core.state, run.memory(), run.norm)
            except EvaluationError as error:
                return RunFailure(StopReason.NOT_EVALUATED, str(error))
    return RunFailure.of(
        StopReason.NOT_FINITE if reason is ReturnReason.NOT_EVALUATED else StopReason.ERROR_ESTIMATE
    )
