"""Runs on the compiled kernel: the twin of the default paths, in chunks.

The kernel has the split PSRM with its stages, zone, placement, guard and step-size control, and
dense output.  It gets every constant from the modules of the Python reference, hands back arrays,
and leaves what is rare to Python: events, progress, and the sentences that say why a run stopped.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from srm_mbs._kernel import core, missing
from srm_mbs.arrays import FloatArray
from srm_mbs.errors import ControllerError, EvaluationError, EventError
from srm_mbs.methods import branch, split, zone
from srm_mbs.methods.base import ErrorNorm, Memory, Method, StepResult
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.methods.psrm import PSRM
from srm_mbs.stepping import (
    breakpoints,
    guard,
    hermite,
    kinks,
    loop,
    placement,
    starting,
    stepsize,
    turning,
)
from srm_mbs.stepping.breakpoints import Passing, Pieces
from srm_mbs.stepping.dense import DenseOutput, StepData
from srm_mbs.stepping.events import EventWatch
from srm_mbs.stepping.loop import RunRecord, Tick
from srm_mbs.stepping.stepsize import Verdict
from srm_mbs.systems.base import Zone
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem

CHUNK = 0.1
"""Seconds after which the kernel returns, so that Ctrl-C is heard."""
PLACEMENTS = ("automatic", "off")
_VERDICTS = (Verdict.ACCEPTED, Verdict.REJECTED, Verdict.REPLACED)


def backend() -> str:
    """What ``backend="auto"`` takes where it can: ``"kernel"`` or ``"python"``.

    ``"python"`` where there is no kernel (``srm-mbs info`` says why), or where the environment
    variable SRM_MBS_BACKEND is ``python``.
    """
    unwanted = os.environ.get("SRM_MBS_BACKEND") == "python"
    return "python" if core is None or unwanted else "kernel"


def obstacle(method: Method, placement: str, singular_times: FloatArray) -> str:
    """Why the kernel cannot make a run: it is not there, or lacks an option; empty if it can."""
    if core is None:
        return missing
    if not (isinstance(method, PSRM) and method.correction == "split"):
        return "it has the split PSRM only"
    if placement not in PLACEMENTS:
        return f"it has no placement {placement!r}"
    if len(singular_times):
        return "it has no given singular times"
    return ""


CONSTANTS = {
    "watched": branch.WATCHED,
    "near": branch.NEAR,
    "far": split.FAR,
    "ambiguous": branch.AMBIGUOUS,
    "held": branch.HELD,
    "rounding": branch.ROUNDING,
    "zone_largest": zone.ZONE_LARGEST,
    "count_uncertainty_above": zone.COUNT_UNCERTAINTY_ABOVE,
    "hit": zone.HIT,
    "projections": branch.PROJECTIONS,
    "fewest": zone.FEWEST,
    "gap_every": split.GAP_EVERY,
    "safety": stepsize.SAFETY,
    "min_factor": stepsize.MIN_FACTOR,
    "max_factor": stepsize.MAX_FACTOR,
    "proportional": stepsize.PROPORTIONAL,
    "integral": stepsize.INTEGRAL,
    "xi_old_floor": stepsize.XI_OLD_FLOOR,
    "xi_floor": stepsize.XI_FLOOR,
    "failed_evaluation": stepsize.FAILED_EVALUATION,
    "sigma_change": placement.SIGMA_CHANGE,
    "too_close": placement.TOO_CLOSE,
    "clearance": placement.CLEARANCE,
    "ahead": kinks.AHEAD,
    "max_redone": placement.MAX_REDONE,
    "turned": turning.TURNED,
    "guard_max_redone": guard.MAX_REDONE,
    "smallest_step": loop.SMALLEST_STEP,
    "standstill": loop.STANDSTILL,
    "large_correction": loop.LARGE_CORRECTION,
    "open": loop.OPEN,
    "lost": loop.LOST,
    "watched_steps": loop.WATCHED_STEPS,
    "look": starting.LOOK,
    "closer": breakpoints.CLOSER,
    "allowed": breakpoints.ALLOWED,
}
"""Every number of the algorithm, from the module of the reference that has it."""


def compiled(system: ClosedSystem | OpenSystem) -> Any:
    """The kernel's twin of ``system``, with a workspace of its own."""
    held = system.held
    calls = system.calls_forces or (system.controlled and held is None)
    controller = system.called_force if calls else None
    twin = core.System(system.model, system.constants(), controller)  # type: ignore[union-attr]
    if held is not None:
        for t, force in zip(held.times, held.values):
            twin.hold(t, force, True)
    return twin


class _TwinTerms:
    """Terms of a regular stage, evaluated by the kernel."""

    weak = False
    held = False

    def __init__(self, found: dict[str, Any]) -> None:
        self.sigma: float = found["sigma"]
        self.rank: int = found["rank"]
        self._found = found

    def rate(self) -> FloatArray:
        return self._found["rate"]  # type: ignore[no-any-return]

    def multiplier(self) -> FloatArray:
        return self._found["multiplier"]  # type: ignore[no-any-return]


class Evaluator:
    """A system whose stages outside the zone are evaluated by the kernel.

    Parameters
    ----------
    system, twin
        The mechanism, and what :func:`compiled` made of it.
    """

    def __init__(self, system: ClosedSystem | OpenSystem, twin: Any) -> None:
        self._system = system
        self._twin = twin

    def __getattr__(self, name: str) -> Any:
        return getattr(self._system, name)

    def between(self, first: float, last: float) -> None:
        """Times of both within [``first``, ``last``] (s); see :mod:`..stepping.breakpoints`."""
        self._system.between(first, last)
        self._twin.between(first, last)

    def evaluate(self, t: float, state: FloatArray, zone: Zone | None = None) -> Any:
        """Terms of a stage; see :class:`~srm_mbs.systems.base.System`."""
        if zone is None:
            try:
                return _TwinTerms(self._twin.terms(t, state))
            except ArithmeticError:
                pass  # the reference says why
        return self._system.evaluate(t, state, zone)


def _history(history: MultiplierHistory | None) -> dict[str, Any] | None:
    if history is None:
        return None
    normals = history.normals
    return {
        "times": np.ascontiguousarray(history.times),
        "values": np.ascontiguousarray(history.values),
        "known_until": history.known_until,
        "known_below": history.known_below,
        "normals": None if normals is None else np.ascontiguousarray(normals.T),
    }


def _history_from(data: dict[str, Any]) -> MultiplierHistory:
    normals = data["normals"]
    return MultiplierHistory(
        data["times"],
        data["values"],
        data["known_until"],
        data["known_below"],
        None if normals is None else normals.T,
    )


def _memory(memory: Memory) -> dict[str, Any]:
    return {
        "rate": np.ascontiguousarray(memory.rate),
        "magnitude": np.ascontiguousarray(memory.magnitude),
        "sigma": memory.sigma,
        "sigma_slope": memory.sigma_slope,
        "steps": memory.steps,
        "history": _history(memory.history),
    }


def _memory_from(data: dict[str, Any]) -> Memory:
    history = data["history"]
    return Memory(
        data["rate"],
        data["sigma"],
        data["magnitude"],
        None if history is None else _history_from(history),
        data["sigma_slope"],
        data["steps"],
    )


class CompiledRun:
    """A run of the kernel that can be advanced step by step.

    Parameters
    ----------
    twin
        From :func:`compiled`.
    method, norm, memory, state
        As for :func:`~srm_mbs.stepping.loop.integrate`.
    pieces
        Of the run; its end is that of the last one.
    t0
        Its start (s).
    step, first_step, max_step
        Fixed step or None, first and longest step of step-size control (s).
    placed
        ``"automatic"`` or ``"off"``.
    """

    def __init__(
        self,
        twin: Any,
        method: PSRM,
        norm: ErrorNorm,
        memory: Memory,
        state: FloatArray,
        pieces: Pieces,
        *,
        t0: float = 0.0,
        step: float | None,
        first_step: float,
        max_step: float,
        placed: str,
    ) -> None:
        self.twin, self.method, self.norm = twin, method, norm
        self.start, self.t0, self.t_end = state.copy(), t0, float(pieces.ends[-1])
        self.adaptive = step is None
        scheme = method.scheme
        gaps = np.array(scheme.gaps)
        eps = method.regularisation
        self._run = core.Run(  # type: ignore[union-attr]
            twin,
            {
                "scheme": {
                    "A": scheme.A,
                    "b": scheme.b,
                    "c": scheme.c,
                    "error": scheme.error,
                    "controller_order": scheme.controller_order or 1,
                    "gap_centres": gaps[:, 0].copy(),
                    "gap_half_widths": gaps[:, 1].copy(),
                },
                "constants": CONSTANTS,
                "norm": {
                    "atol": np.ascontiguousarray(norm.atol),
                    "one": np.ascontiguousarray(norm.one),
                    "rtol": norm.rtol,
                    "negligible": norm.negligible,
                },
                "memory": _memory(memory),
                "eps": None if eps is None else (eps.factor, eps.power),
                "state": np.ascontiguousarray(state),
                "t0": t0,
                "ends": pieces.ends,
                "first": pieces.first,
                "last": pieces.last,
                "given": pieces.given.astype(float),
                "step": 0.0 if step is None else step,
                "first_step": first_step,
                "max_step": max_step,
                "placement": placed,
            },
        )

    def advance(self, steps: int = 0) -> int:
        """Make ``steps`` steps (0: as many as fit in CHUNK); why it returned (CHUNK_FULL, ...)."""
        return int(self._run.advance(steps, CHUNK))

    def attempt_from(
        self, t: float, state: FloatArray, memory: Memory, control: dict[str, Any]
    ) -> tuple[int, Verdict | None]:
        """One attempt from where the reference stands, for comparison with it.

        Parameters
        ----------
        t, state, memory
            Before the attempt.
        control
            What step-size control remembers; the keys are those of ``ControlState`` in control.hpp.

        Returns
        -------
        Why it returned (CHUNK_FULL, ...), and the verdict; None if no step was made.
        """
        stop, verdict = self._run.attempt_from(t, state, _memory(memory), control)
        return stop, None if verdict < 0 else _VERDICTS[verdict]

    def last(self) -> StepResult:
        """The step made last."""
        data = dict(self._run.last())
        threshold, history = data.pop("zone_threshold"), data.pop("history")
        known = None if history is None else _history_from(history)
        near = None if known is None else Zone(threshold, known.predict_near, known.normals)
        return StepResult(zone=near, history=known, multiplier=None, **data)

    def memory(self) -> Memory:
        """What it carries to the next step."""
        return _memory_from(self._run.memory())

    def pass_breakpoint(self, passing: Passing) -> None:
        """Go on behind a breakpoint at which the kernel stopped.

        Raises
        ------
        ControllerError
            If the sampled controller fails.
        EvaluationError
            If the first stage cannot be evaluated, or the motion on is not determined.
        """
        t, state = self._run.t, self._run.state
        before = self.memory()
        known = False
        if self._run.at_breakpoint:
            passing.enter(self._run.piece + 1, t, state)
            with suppress(ArithmeticError):  # the reference says why
                known = self._run.enter()
        else:
            passing.enter(self._run.piece, t, state)
        if not known:
            self.remember(passing.resolved(t, state, before))

    def remember(self, memory: Memory) -> None:
        """Carry ``memory`` to the next step."""
        self._run.remember(_memory(memory))

    def begin(self, t: float, state: FloatArray, memory: Memory, first_step: float) -> None:
        """Start again, from ``state`` at ``t`` (s); what was counted stays."""
        fresh = {"h": first_step, "xi_old": 1.0, "just_rejected": False, "index": 1, "slope": 0.0,
                 "zero": np.nan, "redo": 0.0, "redone": 0, "limit": np.inf, "tries": 0}  # fmt: skip
        self._run.restore(
            {
                "t": t,
                "state": np.ascontiguousarray(state),
                "memory": _memory(memory),
                "control": fresh,
                "seen": loop.OPEN,
                "near": starting.LOOK,
            }
        )

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)


CHUNK_FULL, FINISHED, TOO_SHORT, STANDSTILL, CLOSURES, NOT_EVALUATED, BREAKPOINT = range(7)
"""Why the kernel returned: ``Stop`` in run.hpp."""


@dataclass
class CompiledRecord(RunRecord):
    """A run of the kernel.

    Attributes
    ----------
    run
        What holds its steps.
    suspects
        Times (s) of steps that were kept although the velocity turned.
    """

    run: Any = None
    suspects: list[float] = field(default_factory=list)
    placed: int = 0
    replaced: int = 0

    def data(self, scheme: ButcherTableau, tangent_size: int) -> StepData:
        """The accepted steps as arrays."""
        if self.run is None:
            return super().data(scheme, tangent_size)
        arrays = self.run.arrays()
        zones = {
            step: (threshold, _history_from(history))
            for step, (threshold, history) in arrays.pop("zones").items()
        }
        times, states = arrays.pop("times"), arrays.pop("states")
        breaks = arrays.pop("breaks").astype(int)
        return StepData(
            breaks=breaks,
            times=np.concatenate([[self.t0], times]),
            states=np.concatenate([self.x0[None], states]),
            zones=zones,
            stop=self.stop,
            **arrays,
        )


def integrate(
    system: ClosedSystem | OpenSystem,
    run: CompiledRun,
    *,
    tick: Tick | None = None,
    events: EventWatch | None = None,
    passing: Passing | None = None,
) -> CompiledRecord:
    """As :func:`srm_mbs.stepping.loop.integrate`, on the kernel.

    Parameters
    ----------
    system
        The mechanism that ``run`` is of.
    tick, events
        With either, the kernel returns after every step.
    passing
        What happens at breakpoints, if there are any.
    """
    state = run.start
    record = CompiledRecord(run.t0, state)
    record.run = run
    started = time.perf_counter()
    one_by_one = tick is not None or events is not None
    start = state
    try:
        if events is not None:
            events.begin(run.t0, state)
        reason = CHUNK_FULL
        while reason in (CHUNK_FULL, BREAKPOINT):
            made = run.count
            reason = run.advance(1 if one_by_one else 0)
            if reason == BREAKPOINT and passing is not None:
                run.pass_breakpoint(passing)
                continue
            if reason not in (CHUNK_FULL, FINISHED):
                trouble = why_stopped(reason, system, run)
                loop.fail(record, run.t, run.h, run.memory().sigma, trouble, run.adaptive)
                break
            if not one_by_one or run.count == made:
                continue
            result, t = run.last(), run.t
            stop = None if events is None else events.after_step(start, result, t)
            start = result.state
            if stop is not None:
                record.ended(stop)
                break
            if tick is not None:
                loop.tell(tick, t, result.h, result.state)
        else:
            record.finished(run.t_end)
    except (KeyboardInterrupt, ControllerError, EvaluationError, EventError) as error:
        record.broken_off(run.t, error)
    record.attempts = [
        loop.Attempt(t, h, ratio, _VERDICTS[verdict]) for t, h, ratio, verdict in run.attempts()
    ]
    record.suspects, record.placed, record.replaced = run.suspects(), run.placed, run.replaced
    system.count(run.twin.evaluations, run.twin.factorisations)
    record.wall_time = time.perf_counter() - started
    loop.log.info("%s", record.message)
    return record


def why_stopped(reason: int, system: ClosedSystem | OpenSystem, run: CompiledRun) -> str:
    """Why the kernel stopped, in the words of the reference, which repeats what failed."""
    attempts: Sequence[tuple[float, float, float, int]] = run.attempts()
    if reason == STANDSTILL:
        return loop.standstill(run.t - run.time_before(loop.WATCHED_STEPS))
    if reason == CLOSURES:
        return loop.Closures(system, run.norm).trouble(run.last())
    if reason == TOO_SHORT and not (attempts and attempts[-1][0] == run.t):
        return loop.BELOW_ROUND_OFF
    if run.trouble:
        failed = [h for t, h, ratio, _ in attempts if t == run.t and np.isinf(ratio)]
        # The last one first; at the edge of what can be evaluated rounding decides.
        for h in reversed(failed):
            try:
                run.method.step(system, run.t, h, run.state, run.memory(), run.norm)
            except EvaluationError as error:
                return str(error)
    return loop.NOT_FINITE if reason == NOT_EVALUATED else ""


def dense_output(
    system: ClosedSystem | OpenSystem, scheme: ButcherTableau, steps: StepData, made_by: str
) -> DenseOutput:
    """Dense output of a run, on the kernel where that made the run and is at hand.

    Parameters
    ----------
    made_by
        Backend of the run.
    """
    if made_by == "kernel" and core is not None:
        return CompiledDenseOutput(compiled(system), system, scheme, steps)
    return DenseOutput(system, scheme, steps)


class CompiledDenseOutput(DenseOutput):
    """Dense output on the kernel, of the runs that it made.

    Parameters
    ----------
    twin
        From :func:`compiled`.
    system, scheme, steps
        As for :class:`~srm_mbs.stepping.dense.DenseOutput`.
    """

    def __init__(
        self,
        twin: Any,
        system: ClosedSystem | OpenSystem,
        scheme: ButcherTableau,
        steps: StepData,
    ) -> None:
        super().__init__(system, scheme, steps)
        self._mechanism_system = system
        self._twin = twin
        self._compiled: Any = None

    def __call__(self, t: FloatArray) -> FloatArray:
        """States (k, nx) at the times ``t`` (k,), in any order; see
        :class:`~srm_mbs.stepping.dense.DenseOutput`."""
        if self._steps.count < 2:  # a single step has no neighbours, but perhaps a zone
            return super().__call__(t)
        if self._lone_zones:
            return super().__call__(t)
        if len(self._extension.extra_c) and self._steps.rates.shape[1] == self._extension.n_rates:
            return super().__call__(t)  # loaded without the controller: no stage is to be evaluated
        self.check(t)
        if self._compiled is None:
            self._compiled = self._compile()
        before = self._twin.evaluations, self._twin.factorisations
        try:
            return self._compiled.states(np.ascontiguousarray(t, dtype=float))  # type: ignore[no-any-return]
        except ArithmeticError:
            return super().__call__(t)  # which says why
        finally:
            done = self._twin.evaluations - before[0], self._twin.factorisations - before[1]
            self._mechanism_system.count(*done)

    @cached_property
    def _lone_zones(self) -> bool:
        """Whether a step with a zone has a breakpoint on both sides: the kernel's extra stages have
        no zone."""
        pieces = (self._steps.piece(step) for step in self._steps.zones)
        return any(last - first < 2 for first, last in pieces)

    def _compile(self) -> Any:
        steps, extension = self._steps, self._extension
        return core.DenseOutput(  # type: ignore[union-attr]
            self._twin,
            {
                "rows": extension.rows,
                "extra_A": extension.extra_A,
                "extra_c": extension.extra_c,
                "degree": len(extension.rows),
                "n_rates": extension.n_rates,
                "abscissae": self._abscissae,
                "nodes": list(hermite.NODES),
                "spacing": hermite.SPACING,
                "close": hermite.CLOSE,
                "probes": hermite.PROBES,
                "count": steps.count,
                "width": steps.rates.shape[1],
                "corrected": steps.corrections.shape[1] > 0,
                "zones": list(steps.zones),
                "breaks": steps.breaks.astype(float),
                **{
                    name: np.ascontiguousarray(getattr(steps, name))
                    for name in (
                        "times", "states", "rates", "corrections", "sigmas", "end_rate",
                        "break_rates",
                    )
                },
            },
        )  # fmt: skip
