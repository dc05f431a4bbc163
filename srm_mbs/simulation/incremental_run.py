"""Incremental runs for :class:`srm_mbs.Simulator`: they continue call by call and record nothing.

:class:`KernelRun` is made by the compiled kernel, :class:`ReferenceRun` by the Python reference.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.controllers import HeldForce
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.breakpoints import SingularProximity, beside_singular, smooth_intervals
from srm_mbs.integration.control.step_size import (
    ControlWrapper,
    StepDecision,
    StepSizeControl,
    initial_step,
)
from srm_mbs.integration.driver import RunStatus, integrate
from srm_mbs.integration.kernel.driver import why_stopped
from srm_mbs.integration.kernel.run import BREAKPOINT, CHUNK, CHUNK_FULL, FINISHED, CompiledRun
from srm_mbs.integration.kernel.system import Evaluator, make_kernel_system
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method
from srm_mbs.integration.singular_endpoints import start
from srm_mbs.simulation.options import RunOptions

MakeControl = Callable[[float], tuple[StepSizeControl, Any]]
"""First step (s) -> step-size control, and the wrappers in it that count."""
LAST_GOOD = "The state is the last good one"


class _IncrementalRun:
    """Base of the runs of both backends.

    Attributes
    ----------
    t, state
        Current time (s) and state (nq + nv,).
    """

    t: float
    state: FloatArray

    def __init__(
        self,
        system: OpenSystem | ClosedSystem,
        held: HeldForce,
        norm: ErrorNorm,
        options: RunOptions,
        evaluator: Any,
    ) -> None:
        self.system, self.norm, self.options = system, norm, options
        self.method: Method = options.method
        self._held = held
        self._evaluator = evaluator

    def _first(self, t: float, state: FloatArray, span: float) -> tuple[IntegratorState, float]:
        """Integrator state at ``state``, and the length of the first step of ``span`` (s)."""
        memory = start(self.system, self.method, t, state, self.norm, np.inf, self._evaluator)
        order = self.method.scheme.controller_order or 1
        first = initial_step(self._evaluator, state, memory, self.norm, span, order, t)
        return memory, first

    def _matters(self, fresh: IntegratorState, span: float) -> bool:
        """Whether the singular configuration next to ``fresh`` does; the kernel has asked."""
        return True

    def _renewed(self, memory: IntegratorState, end: float) -> IntegratorState:
        fresh = self.method.resume(self._evaluator, self.t, self.state, memory, self.norm)
        if not self._matters(fresh, end - self.t):
            return fresh
        return beside_singular(
            self.system, self.method, self.t, self.state, self.norm, end, self._evaluator, fresh
        )


class KernelRun(_IncrementalRun):
    """A run of the compiled kernel.

    Parameters
    ----------
    system, held
        The mechanism, under what is held.
    norm, options
        Error norm and checked options.
    """

    def __init__(
        self,
        system: OpenSystem | ClosedSystem,
        held: HeldForce,
        norm: ErrorNorm,
        options: RunOptions,
    ) -> None:
        kernel_system = make_kernel_system(system)
        super().__init__(system, held, norm, options, Evaluator(system, kernel_system))
        nothing = np.zeros(2 * system.nv)
        state = np.zeros(system.nq + system.nv)
        pieces = smooth_intervals(nothing[:0], nothing[:0], 0.0, 1.0)
        self._kernel_system = kernel_system
        self._run = CompiledRun(
            kernel_system,
            options.method,
            norm,
            IntegratorState(nothing, 1.0, nothing),
            state,
            pieces,
            step=options.step,
            first_step=1.0,
            max_step=options.longest_step,
            placed=options.placement,
        )
        self._go_on = self._run.go_on

    @property
    def t(self) -> float:  # type: ignore[override]
        return float(self._run.t)

    @property
    def state(self) -> FloatArray:  # type: ignore[override]
        state: FloatArray = self._run.state
        return state

    def begin(self, t: float, state: FloatArray, force: FloatArray, span: float) -> None:
        """Start from ``state`` at ``t`` (s), under ``force`` (nv,), for steps of ``span`` (s)."""
        self._held.only(force)
        self._kernel_system.hold(t, force, False)
        self._evaluator.between(-np.inf, np.inf)
        self._run.begin(t, state, *self._first(t, state, span))

    def go_on(
        self,
        end: float,
        first: float,
        last: float,
        force: FloatArray,
        forces_jumped: bool,
        grid: float,
    ) -> str:
        """Go on to ``end`` (s); empty, or why that is not possible.

        Parameters
        ----------
        first, last
            Times (s) within which the system is evaluated.
        force : (nv,)
            Acts from here on.
        forces_jumped
            Whether other forces may have jumped.
        grid
            Length of fixed steps (s); 0 with step-size control.

        Raises
        ------
        ValueError
            If ``force`` has another shape, or is not finite.
        """
        reason = self._go_on(end, first, last, force, forces_jumped, grid, CHUNK)
        self._held.only(force)  # snapshots need it, too
        if reason == FINISHED:
            return ""
        self.system.between(first, last)
        if reason == BREAKPOINT:
            try:
                self._run.remember(self._renewed(self._run.memory(), end))
            except EvaluationError as error:
                return f"Stopped at t = {self.t:.6g} s: {error}. {LAST_GOOD}."
            reason = CHUNK_FULL
        while reason == CHUNK_FULL:
            reason = self._run.advance()
        if reason == FINISHED:
            return ""
        run = self._run
        why = why_stopped(reason, self.system, run)
        return f"Stopped at t = {run.t:.6g} s with step {run.h:.1e} s: {why.sentence}. {LAST_GOOD}."

    def snapshot(self) -> Any:
        """Everything that the next step depends on."""
        return self._run.snapshot(), self._held.values[-1]

    def restore(self, snapshot: Any) -> None:
        """Go on from a :meth:`snapshot` of another run like this."""
        kept, force = snapshot
        self._held.only(force)
        self._kernel_system.hold(kept.t, force, False)
        self._run.restore(kept)

    def counts(self) -> dict[str, int]:
        """Work done, in the words of :class:`~srm_mbs.simulation.result.Statistics`."""
        run, kernel_system, system = self._run, self._kernel_system, self.system
        steps, rejected, zones = run.totals()
        return {
            "steps": steps,
            "rejected": rejected,
            "placements": run.placed,
            "replaced": run.replaced,
            "zone_steps": zones,
            "evaluations": kernel_system.evaluations + system.evaluations,
            "factorisations": kernel_system.factorisations + system.factorisations,
        }


class ReferenceRun(_IncrementalRun):
    """A run of the Python reference.

    Parameters
    ----------
    system, held
        The mechanism, under what is held.
    norm, options
        Error norm and checked options.
    make_control
        Makes its step-size control.
    """

    def __init__(
        self,
        system: OpenSystem | ClosedSystem,
        held: HeldForce,
        norm: ErrorNorm,
        options: RunOptions,
        make_control: MakeControl,
    ) -> None:
        super().__init__(system, held, norm, options, system)
        self._make_control = make_control
        self._control: StepSizeControl
        self._wrappers: tuple[ControlWrapper, ...] = ()
        self._memory: IntegratorState
        self._nearness = SingularProximity()
        self._counted = np.zeros(5, dtype=int)

    def begin(self, t: float, state: FloatArray, force: FloatArray, span: float) -> None:
        """See :meth:`KernelRun.begin`."""
        self._held.only(force)
        self.system.between(-np.inf, np.inf)
        self._count_wrappers()
        self.t, self.state = t, state.copy()
        self._memory, first = self._first(t, state, span)
        self._control, self._wrappers = self._make_control(first)

    def _count_wrappers(self) -> None:
        self._counted[2] += sum(wrapper.placed for wrapper in self._wrappers)
        self._counted[3] += sum(wrapper.replaced for wrapper in self._wrappers)
        self._wrappers = ()

    def _matters(self, fresh: IntegratorState, span: float) -> bool:
        return self._nearness.matters(fresh, self.norm, span, self.system.nv)

    def go_on(
        self,
        end: float,
        first: float,
        last: float,
        force: FloatArray,
        forces_jumped: bool,
        grid: float,
    ) -> str:
        """See :meth:`KernelRun.go_on`."""
        if force.shape != (self.system.nv,) or not np.isfinite(force).all():
            raise ValueError("not nv finite forces")
        forces_jumped = forces_jumped or not np.array_equal(force, self._held.values[-1])
        self._held.only(force)
        self.system.between(first, last)
        if forces_jumped:
            try:
                self._memory = self._renewed(self._memory, end)
            except EvaluationError as error:
                return f"Stopped at t = {self.t:.6g} s: {error}. {LAST_GOOD}."
        self._control.set_target_time(end, (self.t, grid) if grid else None)
        record = integrate(
            self.system,
            self.method,
            self._control,
            self.norm,
            self._memory,
            self.state,
            self.t,
            end,
            max_step=self.options.longest_step,
        )
        if record.times:
            self.t, self.state = record.times[-1], record.steps[-1].state
        rejected = sum(a.decision is StepDecision.REJECTED for a in record.attempts)
        zones = sum(step.zone is not None for step in record.steps)
        self._counted += [len(record.times), rejected, 0, 0, zones]
        if record.status is RunStatus.INTERRUPTED:
            raise KeyboardInterrupt
        return "" if record.status is RunStatus.FINISHED else record.message

    def snapshot(self) -> Any:
        """See :meth:`KernelRun.snapshot`."""
        return self.t, self.state, self._memory, self._held.values[-1], self

    def restore(self, snapshot: Any) -> None:
        """See :meth:`KernelRun.restore`."""
        self.t, state, memory, force, other = snapshot
        self.state = state.copy()
        self._nearness.looked = other._nearness.looked
        self._held.only(force)
        # Controls refer to what they are for: not to be copied, but to be exchanged.
        shared = {id(other.system): self.system, id(self.method.scheme): self.method.scheme}
        self._memory = copy.deepcopy(memory, dict(shared))
        self._control, self._wrappers = copy.deepcopy((other._control, other._wrappers), shared)
        self._counted = -np.array(
            [0, 0, *(sum(getattr(w, n) for w in self._wrappers) for n in ("placed", "replaced")), 0]
        )

    def counts(self) -> dict[str, int]:
        """See :meth:`KernelRun.counts`."""
        names = ("steps", "rejected", "placements", "replaced", "zone_steps")
        out = dict(zip(names, self._counted.tolist()))
        out["placements"] += sum(wrapper.placed for wrapper in self._wrappers)
        out["replaced"] += sum(wrapper.replaced for wrapper in self._wrappers)
        system = self.system
        return out | {"evaluations": system.evaluations, "factorisations": system.factorisations}
