"""A run in the compiled kernel, advanced in chunks."""

from __future__ import annotations

import math
from contextlib import suppress
from enum import IntEnum
from typing import Any

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System, Zone
from srm_mbs.integration import critical_passages, driver, singular_endpoints
from srm_mbs.integration.breakpoints import BreakpointHandler, SmoothIntervals
from srm_mbs.integration.control.step_size import StepDecision
from srm_mbs.integration.events import step_dense
from srm_mbs.integration.kernel import marshalling
from srm_mbs.integration.kernel.marshalling import CONSTANTS, DECISIONS
from srm_mbs.integration.kernel.system import Evaluator
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method, StepResult
from srm_mbs.integration.methods.psrm import PSRM

CHUNK = 0.1
"""Time (s) after which the kernel returns, so that Ctrl-C interrupts a run."""
_STEP_RESULT = (
    *("t", "h", "state", "rates", "end_rate", "correction", "error_ratio", "sigmas", "rank"),
    *("state_scale", "quiet", "held", "stiff"),
)
"""Fields that a :class:`StepResult` and the ``StepResult`` of the kernel have in common."""


class ReturnReason(IntEnum):
    """Why the kernel returns: ``Stop`` of run.hpp."""

    CHUNK_FULL = 0
    FINISHED = 1
    TOO_SHORT = 2
    """The step is below round-off."""
    STANDSTILL = 3
    """The last steps covered almost no time."""
    CLOSURES = 4
    """The last step leaves the closures open."""
    NOT_EVALUATED = 5
    """A fixed step could not be evaluated."""
    BREAKPOINT = 6
    """The next smooth interval begins."""
    ARRIVAL = 7
    """The end lies next to a singular configuration."""


_REASONS = tuple(ReturnReason)
"""By their numbers."""


def _time_unit(system: System, t: float) -> float:
    """Unit of time (s) of the places of a mechanism with drives, next to ``t`` (s)."""
    analysis = system.singularities
    return 1.0 if analysis is None else float(analysis.geometry(analysis.q0, t).unit[-1])


class CompiledLayerStart:
    """:class:`~srm_mbs.integration.singular_endpoints.LayerStart` of a run of the kernel.

    Parameters
    ----------
    kernel_system, system
        The mechanism.
    tolerance
        Residual (row units) up to which a critical configuration counts as singular.

    Attributes
    ----------
    motion
        The ``MotionAlongCurve`` of passage.hpp that the run begins with; None without one.
    """

    def __init__(self, kernel_system: Any, system: System, tolerance: float) -> None:
        self._kernel_system, self._system = kernel_system, system
        self._tolerance = tolerance
        self.motion: Any = None

    @property
    def under_way(self) -> bool:
        """As the reference."""
        return self.motion is not None

    def begin(self, t: float, state: FloatArray) -> bool:
        """As the reference."""
        self.motion = self._kernel_system.motion_in_layer(
            t,
            state,
            _time_unit(self._system, t),
            self._tolerance,
            critical_passages.START_REACH,
            CONSTANTS,
        )
        return self.under_way


def first_stage(
    evaluator: Evaluator,
    method: Method,
    t: float,
    state: FloatArray,
    norm: ErrorNorm,
    t_end: float,
    stiff: bool,
    layers: CompiledLayerStart | None,
) -> Any:
    """The ``IntegratorState`` of step.hpp at the start of a run: as
    :func:`~srm_mbs.integration.singular_endpoints.start`, which makes it next to a singular
    configuration.

    Parameters
    ----------
    evaluator
        The mechanism.
    stiff
        Whether the problem is stiff at the start, as far as is known.
    layers
        As for ``start``.

    Raises
    ------
    InputError, EvaluationError
        As ``start``.
    """
    try:
        found = evaluator.kernel_system.first_stage(t, state, stiff)
        if not found.sigma < singular_endpoints.NEAR_SINGULAR_SIGMA:
            return found
    except ArithmeticError:
        pass  # the reference raises the error that says why
    memory = singular_endpoints.start(evaluator, method, t, state, norm, t_end, layers=layers)
    memory.stiff = stiff
    return marshalling.state_struct(memory)


class CompiledStepDense:
    """Dense output of the step that ``run`` made last, from the state ``start`` (nx,).

    Attributes
    ----------
    compiled
        That of the kernel; None where the step used a zone, or went along a curve.
    """

    __slots__ = ("_run", "_start", "_system", "compiled")

    def __init__(self, run: CompiledRun, system: System, start: FloatArray) -> None:
        self._run, self._system, self._start = run, system, start
        last = run.core.last()
        self.compiled: Any = None
        if not (last.in_zone or last.critical):
            own = marshalling.scheme_dense(run.method.scheme.member(last.stiff))
            self.compiled = run.core.step_dense(start, own, marshalling.dense_constants())

    def by_reference(self, times: FloatArray) -> FloatArray:
        """States (k, nx) at ``times`` (k,) s, by the reference."""
        run = self._run
        dense = step_dense(self._system, run.method.scheme, self._start, run.last(), run.core.t)
        return dense(times)

    def __call__(self, times: FloatArray) -> FloatArray:
        if self.compiled is not None:
            with suppress(ArithmeticError):  # the reference raises the error that says why
                return self.compiled(times)  # type: ignore[no-any-return]
        return self.by_reference(times)


class CompiledRun:
    """A run of the kernel that can be advanced step by step.

    Parameters
    ----------
    kernel_system
        From :func:`~srm_mbs.integration.kernel.system.make_kernel_system`.
    method, norm, state
        As for :func:`~srm_mbs.integration.driver.integrate`.
    memory
        Before the first step: from :func:`first_stage`, or
        :func:`~srm_mbs.integration.kernel.marshalling.state_struct`.
    intervals
        The smooth intervals of the run, which ends with the last one.
    t0
        Start of the run (s).
    step, first_step, max_step
        Fixed step or None, first and longest step of step-size control (s); without a first one,
        the one that the start allows, as
        :func:`~srm_mbs.integration.control.step_size.initial_step` has it.
    placed
        ``"automatic"`` or ``"off"``.
    arrivals
        Whether the kernel returns before an end next to a singular configuration.
    singular_tolerance
        Residual (row units) up to which a critical configuration counts as singular; None where
        they are not examined.

    Attributes
    ----------
    core
        The ``Run`` of the kernel.

    Raises
    ------
    ArithmeticError
        If the first step cannot be evaluated.
    """

    def __init__(
        self,
        kernel_system: Any,
        method: PSRM,
        norm: ErrorNorm,
        memory: Any,
        state: FloatArray,
        intervals: SmoothIntervals,
        *,
        t0: float = 0.0,
        step: float | None,
        first_step: float | None,
        max_step: float,
        placed: str,
        arrivals: bool = False,
        singular_tolerance: float | None = None,
    ) -> None:
        self.kernel_system, self.method, self.norm = kernel_system, method, norm
        self.start, self.t0, self.t_end = state, t0, float(intervals.ends[-1])
        self.adaptive = step is None
        stiff = method.scheme.stiff
        options = marshalling.options_struct(
            step=step,
            max_step=max_step,
            placed=placed,
            arrivals=arrivals,
            singular_tolerance=singular_tolerance,
            rtol=norm.rtol,
            eps=method.regularisation,
        )
        self.core = core.Run(  # type: ignore[union-attr]
            kernel_system,
            marshalling.tableau_struct(method.scheme),
            None if stiff is None else marshalling.tableau_struct(stiff),
            CONSTANTS,
            marshalling.norm_struct(norm),
            memory,
            state,
            marshalling.intervals_struct(intervals),
            options,
            t0,
            0.0 if first_step is None else float(first_step),
        )

    def advance(self, steps: int = 0) -> ReturnReason:
        """Make ``steps`` steps, or with 0 those of CHUNK seconds; the reason of the return."""
        reason: int = self.core.advance(steps, CHUNK)
        return _REASONS[reason]

    def attempt_from(
        self, t: float, state: FloatArray, memory: IntegratorState, control: Any
    ) -> tuple[ReturnReason, StepDecision | None]:
        """One attempt from a state of the reference, for comparison with it.

        Parameters
        ----------
        t, state, memory
            Before the attempt.
        control
            State of the step-size control, from
            :func:`~srm_mbs.integration.kernel.marshalling.control_struct`.

        Returns
        -------
        The reason of the return, and the decision; None if no step was made.
        """
        known = marshalling.state_struct(memory)
        reason, decision = self.core.attempt_from(t, state, known, control)
        return _REASONS[reason], None if decision < 0 else DECISIONS[decision]

    def last(self) -> StepResult:
        """The step made last."""
        r = self.core.last()
        history, zone = None, None
        if r.in_zone:
            history = marshalling.history_from(self.core.last_history())
            zone = Zone(r.zone_threshold, history.predict_near, history.normals)
        return StepResult(
            **{name: getattr(r, name) for name in _STEP_RESULT},
            zone=zone,
            history=history,
            multiplier=None,
            constraint_residual=r.residual,
            placement="critical" if r.critical else "",
        )

    def end_at(self, t: float, state: FloatArray, end: float, system: System) -> bool:
        """Let the step of a passage that was made last, from ``state`` (nx,) at ``t`` (s), end at
        ``end`` (s) within it; whether it does.  Other steps stay as they are.  ``system``: of the
        run."""
        if not self.core.last().critical:
            return False
        unit = _time_unit(system, t)
        ended: bool = self.core.end_at(t, state, end, unit, critical_passages.SEARCH)
        return ended

    def memory(self) -> IntegratorState:
        """The state of the integrator before the next step."""
        return marshalling.state_from(self.core.memory())

    def pass_breakpoint(self, passing: BreakpointHandler) -> None:
        """Enter the interval after a breakpoint at which the kernel returned.

        Raises
        ------
        ControllerError
            If the sampled controller fails.
        EvaluationError
            If the first stage cannot be evaluated, or the motion after it is not determined.
        """
        t, state = self.core.t, self.core.state
        before = self.memory()
        accurate = False
        if self.core.at_breakpoint:
            passing.enter(self.core.interval + 1, t, state)
            with suppress(ArithmeticError):  # the reference raises the error that says why
                accurate = self.core.enter()
        else:
            passing.follow(self.core.interval)
        if not accurate:
            self.remember(passing.resolved(t, state, before))

    def arrive(self, passing: BreakpointHandler) -> None:
        """Prepare for the end next to a singular configuration before which the kernel returned."""
        run = self.core
        self.remember(passing.singular_arrival(run.t, run.state, self.memory(), run.interval))

    def remember(self, memory: IntegratorState) -> None:
        """Start the next step from ``memory``."""
        self.core.remember(marshalling.state_struct(memory))

    def begin(
        self, t: float, state: FloatArray, memory: Any, first_step: float, motion: Any = None
    ) -> None:
        """Start again, from ``state`` at ``t`` (s), in a layer with its ``motion``; the counts of
        steps and evaluations stay.  ``memory``: an ``IntegratorState`` of step.hpp."""
        self.core.restore(
            core.RunSnapshot(  # type: ignore[union-attr]
                t=t,
                state=state,
                memory=memory,
                control=marshalling.control_struct(h=first_step),
                open_residual=driver.RESIDUAL_EXAMINED,
                search_below=singular_endpoints.NEAR_SINGULAR_SIGMA,
                first=True,
                known=False,
                quiet=False,
                examine_below=math.inf,
                avoided=None,
                dead_end=False,
                passage=motion,
            )
        )
