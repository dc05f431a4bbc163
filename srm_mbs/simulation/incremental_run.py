"""Incremental runs for :class:`srm_mbs.Simulator`: they continue call by call and record nothing.

:class:`KernelRun` is made by the compiled kernel, :class:`ReferenceRun` by the Python reference.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.controllers import HeldForce
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.errors import EvaluationError, SimulationError, time_text
from srm_mbs.integration.breakpoints import SingularProximity, beside_singular, smooth_intervals
from srm_mbs.integration.control.step_size import (
    ControlWrapper,
    StepDecision,
    StepSizeControl,
    initial_step,
)
from srm_mbs.integration.critical_passages import (
    CriticalPassages,
    examined_passages,
    step_from_layer,
)
from srm_mbs.integration.driver import RunStatus, integrate
from srm_mbs.integration.generated.code import load_code
from srm_mbs.integration.kernel.driver import why_stopped
from srm_mbs.integration.kernel.marshalling import state_struct
from srm_mbs.integration.kernel.run import CHUNK, CompiledLayerStart, CompiledRun, ReturnReason
from srm_mbs.integration.kernel.system import Evaluator, make_kernel_system
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method
from srm_mbs.integration.singular_endpoints import LayerStart, start
from srm_mbs.simulation.options import RunOptions
from srm_mbs.simulation.result import Statistics
from srm_mbs.simulation.runner import placed_control

FINISHED = int(ReturnReason.FINISHED)


@dataclass(eq=False, repr=False)
class IncrementalRun(ABC):
    """A run that continues call by call.

    Parameters
    ----------
    system, held
        The mechanism, under what is held.
    norm, options
        Error norm and checked options.
    """

    system: OpenSystem | ClosedSystem
    held: HeldForce
    norm: ErrorNorm
    options: RunOptions

    def __post_init__(self) -> None:
        self.method: Method = self.options.method
        self._evaluator: Any = self.system
        self._systems: tuple[Any, ...] = (self.system,)

    def _passages(self) -> CriticalPassages | None:
        options = self.options
        return examined_passages(
            self.system, self.method, self.norm, options.placement, options.singular_tolerance
        )

    @property
    @abstractmethod
    def t(self) -> float:
        """Current time (s)."""

    @property
    @abstractmethod
    def state(self) -> FloatArray:
        """Current state (nq + nv,), a copy."""

    def begin(
        self, t: float, state: FloatArray, force: FloatArray, span: float, smooth_until: float
    ) -> None:
        """Start from ``state`` at ``t`` (s), under ``force`` (nv,), for steps of ``span`` (s); the
        first breakpoint is at ``smooth_until`` (s).

        Raises
        ------
        EvaluationError
            If the first stage cannot be evaluated.
        """
        self._hold(t, force)
        self._evaluator.between(-np.inf, np.inf)
        layers = self._layer_start()
        memory = start(
            self._evaluator, self.method, t, state, self.norm, smooth_until, layers=layers
        )
        if layers is not None and layers.under_way:
            first = step_from_layer(self.system.mechanism, state)
        else:
            order = self.method.scheme.controller_order or 1
            first = initial_step(self._evaluator, state, memory, self.norm, span, order, t)
        self._begin(t, state, memory, first, layers)

    @abstractmethod
    def _layer_start(self) -> LayerStart | None:
        """Begins motions in layers; None where steps are to leave them."""

    def _hold(self, t: float, force: FloatArray) -> None:
        """Let ``force`` (nv,) act from ``t`` (s) on."""
        self.held.only(force)

    @abstractmethod
    def _begin(
        self,
        t: float,
        state: FloatArray,
        memory: IntegratorState,
        first: float,
        layers: Any,
    ) -> None:
        """Start from an integrator state with a step of length ``first`` (s), or from what
        ``layers`` (:meth:`_layer_start`) began."""

    @abstractmethod
    def go_on(
        self,
        end: float,
        first: float,
        last: float,
        force: FloatArray,
        forces_jumped: bool,
        grid: float,
    ) -> None:
        """Go on to ``end`` (s).

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
        SimulationError
            If the run cannot go on; it is then at the last good inner step.
        """

    def _matters(self, fresh: IntegratorState, span: float) -> bool:
        """Whether the singular configuration next to ``fresh`` does; the kernel has asked."""
        return True

    def _renewed(self, memory: IntegratorState, end: float) -> IntegratorState:
        """``memory`` after forces jumped."""
        try:
            fresh = self.method.resume(self._evaluator, self.t, self.state, memory, self.norm)
            if not self._matters(fresh, end - self.t):
                return fresh
            return beside_singular(
                self._evaluator, self.method, self.t, self.state, self.norm, end, fresh
            )
        except EvaluationError as error:
            raise self._stopped("", error) from error

    def _stopped(self, step: str, why: object) -> SimulationError:
        message = (
            f"Stopped at t = {time_text(self.t)} s{step}: {why}. The state is the last good one."
        )
        return SimulationError(message, None)

    @abstractmethod
    def go_on_from(self, other: Self) -> None:
        """Continue as ``other``, a run of the same mechanism, would; the counts start at 0."""

    @property
    @abstractmethod
    def last_steps(self) -> int:
        """Number of inner steps of the last :meth:`go_on`."""

    @abstractmethod
    def _counts(self) -> tuple[int, int, int, int, int]:
        """Steps, rejected, placements, replaced, zone steps."""

    def statistics(self, wall_time: float) -> Statistics:
        """Work done, in ``wall_time`` (s)."""
        evaluations = sum(system.evaluations for system in self._systems)
        factorisations = sum(system.factorisations for system in self._systems)
        return Statistics(*self._counts(), evaluations, factorisations, wall_time)


class KernelRun(IncrementalRun):
    """A run of the compiled kernel."""

    def __post_init__(self) -> None:
        super().__post_init__()
        system, options = self.system, self.options
        code = load_code(system.mechanism) if options.backend == "generated" else None
        self._kernel_system = make_kernel_system(system, code)
        self._evaluator = Evaluator(system, self._kernel_system)
        self._systems = (system, self._kernel_system)
        nothing = np.zeros(2 * system.nv)
        self._run = CompiledRun(
            self._kernel_system,
            options.method,
            self.norm,
            state_struct(IntegratorState(nothing, 1.0, nothing)),
            np.zeros(system.nq + system.nv),
            smooth_intervals(nothing[:0], nothing[:0], 0.0, 1.0),
            step=options.step,
            first_step=1.0,
            max_step=options.longest_step,
            placed=options.placement,
            singular_tolerance=None if self._passages() is None else options.singular_tolerance,
        )
        # Looked up once: steps of control loops take a few microseconds.
        self._core = self._run.core
        self._go_on = self._core.go_on

    @property
    def t(self) -> float:
        return self._core.t  # type: ignore[no-any-return]

    @property
    def state(self) -> FloatArray:
        return self._core.state  # type: ignore[no-any-return]

    def _hold(self, t: float, force: FloatArray) -> None:
        super()._hold(t, force)
        self._kernel_system.hold(t, force, False)

    def _layer_start(self) -> CompiledLayerStart | None:
        if self._passages() is None:
            return None
        tolerance = self.options.singular_tolerance
        return CompiledLayerStart(self._kernel_system, self.system, tolerance)

    def _begin(
        self, t: float, state: FloatArray, memory: IntegratorState, first: float, layers: Any
    ) -> None:
        motion = None if layers is None else layers.motion
        self._run.begin(t, state, state_struct(memory), first, motion)

    def go_on(
        self,
        end: float,
        first: float,
        last: float,
        force: FloatArray,
        forces_jumped: bool,
        grid: float,
    ) -> None:
        # The kernel holds the force of the last call; arrays are not changed in place.
        same = force is self.held.values[0]
        returned = self._go_on(
            end, first, last, None if same else force, forces_jumped, grid, CHUNK
        )
        if not same:
            self.held.only(force)  # clones need it, too
        if returned == FINISHED:
            return
        run = self._run
        self.system.between(first, last)
        reason = ReturnReason(returned)
        if reason is ReturnReason.BREAKPOINT:
            run.remember(self._renewed(run.memory(), end))
            reason = ReturnReason.CHUNK_FULL
        while reason is ReturnReason.CHUNK_FULL:
            reason = run.advance()
        if reason is not ReturnReason.FINISHED:
            failure = why_stopped(reason, self.system, run)
            raise self._stopped(f" with step {self._core.h:.1e} s", failure.sentence)

    def go_on_from(self, other: Self) -> None:
        snapshot = other._core.snapshot()
        self._hold(snapshot.t, other.held.values[-1])
        self._core.restore(snapshot)

    @property
    def last_steps(self) -> int:
        return self._core.count  # type: ignore[no-any-return]

    def _counts(self) -> tuple[int, int, int, int, int]:
        steps, rejected, zones = self._core.totals()
        return steps, rejected, self._core.placed, self._core.replaced, zones


class ReferenceRun(IncrementalRun):
    """A run of the Python reference."""

    _t: float
    _state: FloatArray
    _control: StepSizeControl
    _memory: IntegratorState
    _nearness: SingularProximity
    _examined: CriticalPassages | None
    _wrappers: Sequence[ControlWrapper] = ()
    _steps = _last_steps = _rejected = _zone_steps = 0
    _placed = _replaced = 0
    """Counts of former wrappers."""

    @property
    def t(self) -> float:
        return self._t

    @property
    def state(self) -> FloatArray:
        return self._state.copy()

    def _layer_start(self) -> CriticalPassages | None:
        return self._passages()

    def _begin(
        self, t: float, state: FloatArray, memory: IntegratorState, first: float, layers: Any
    ) -> None:
        _, _, self._placed, self._replaced, _ = self._counts()
        self._t, self._state, self._memory = t, state.copy(), memory
        self._nearness, self._examined = SingularProximity(), layers
        self._control, self._wrappers = placed_control(self.system, self.options, lambda: first)

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
    ) -> None:
        if force.shape != (self.system.nv,) or not np.isfinite(force).all():
            raise ValueError("not nv finite forces")
        forces_jumped = forces_jumped or not np.array_equal(force, self.held.values[-1])
        self.held.only(force)
        self.system.between(first, last)
        passages = self._examined
        if passages is not None:
            passages.examined.clear()
        if forces_jumped and not (passages is not None and passages.under_way):
            self._memory = self._renewed(self._memory, end)
        self._control.set_target_time(end, (self._t, grid) if grid else None)
        record = integrate(
            self.system,
            self.method,
            self._control,
            self.norm,
            self._memory,
            self._state,
            self._t,
            end,
            max_step=self.options.longest_step,
            passages=passages,
        )
        if record.times:
            self._t, self._state = record.times[-1], record.steps[-1].state
        if record.memory is not None:
            self._memory = record.memory
        self._last_steps = len(record.times)
        self._steps += self._last_steps
        self._rejected += sum(a.decision is StepDecision.REJECTED for a in record.attempts)
        self._zone_steps += sum(step.zone is not None for step in record.steps)
        if record.status is RunStatus.INTERRUPTED:
            raise KeyboardInterrupt
        if record.status is not RunStatus.FINISHED:
            raise SimulationError(record.message, None)

    def go_on_from(self, other: Self) -> None:
        self._t, self._state = other.t, other.state
        self._nearness = copy.copy(other._nearness)
        self._hold(self._t, other.held.values[-1])
        # Controls refer to what they are for: not to be copied, but to be exchanged.
        shared = {id(other.system): self.system, id(self.method.scheme): self.method.scheme}
        self._memory = copy.deepcopy(other._memory, dict(shared))
        self._control, self._wrappers, self._examined = copy.deepcopy(
            (other._control, other._wrappers, other._examined), shared
        )
        _, _, placed, replaced, _ = self._counts()
        self._placed, self._replaced = -placed, -replaced

    @property
    def last_steps(self) -> int:
        return self._last_steps

    def _counts(self) -> tuple[int, int, int, int, int]:
        placed = self._placed + sum(wrapper.placed for wrapper in self._wrappers)
        replaced = self._replaced + sum(wrapper.replaced for wrapper in self._wrappers)
        return self._steps, self._rejected, placed, replaced, self._zone_steps
