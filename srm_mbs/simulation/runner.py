r"""The one runner: check the options, assemble the problem, integrate, collect the result.

Every run goes these four steps, whoever asks for it: :func:`srm_mbs.simulate`, each segment of a
run with event actions, a rerun with another accuracy; :func:`srm_mbs.solve_dae` and
:class:`srm_mbs.Simulator` use the same checks, controls and records.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.controllers import Controller, HeldForce, evaluate_controller
from srm_mbs.dynamics.forces import over_half_turn
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem, make_system
from srm_mbs.dynamics.scaling import (
    Units,
    position_rounding,
    start_rounding,
)
from srm_mbs.dynamics.system import System
from srm_mbs.errors import (
    ControllerError,
    EvaluationError,
    FunctionError,
    InputError,
    SimulationError,
    safe_repr,
    time_text,
    warn,
)
from srm_mbs.integration import driver
from srm_mbs.integration.breakpoints import BreakpointHandler, SmoothIntervals, smooth_intervals
from srm_mbs.integration.control.prescribed_times import placed, suspected
from srm_mbs.integration.control.step_size import (
    ControlWrapper,
    FixedStep,
    PIControl,
    StepDecision,
    StepSizeControl,
    initial_step,
)
from srm_mbs.integration.critical_passages import (
    CriticalPassages,
    exact_up_to,
    examined_passages,
    step_from_layer,
)
from srm_mbs.integration.dense_output import DenseOutput, StepData
from srm_mbs.integration.driver import EndOfSteps, RunRecord, RunStatus, StepSink
from srm_mbs.integration.events import EventWatch, MechanismFunction, prepare_events
from srm_mbs.integration.generated.policy import Meter, code_of_run
from srm_mbs.integration.kernel import driver as kernel_driver
from srm_mbs.integration.kernel.backend import COMPILED, chosen_backend, code_is_compiled
from srm_mbs.integration.kernel.dense_output import CompiledDenseOutput
from srm_mbs.integration.kernel.driver import CompiledRecord, StepSummary
from srm_mbs.integration.kernel.events import CompiledEventWatch
from srm_mbs.integration.kernel.marshalling import state_from
from srm_mbs.integration.kernel.run import CompiledLayerStart, CompiledRun, first_stage
from srm_mbs.integration.kernel.system import Evaluator, SuccessiveWorkspaces, shared
from srm_mbs.integration.messages import (
    MECHANISM,
    ProblemVocabulary,
    StopReason,
    branch_changes,
    stiffness_sentence,
)
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method, method_messages
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.psrm import is_split
from srm_mbs.integration.methods.thesis.sweep_branch_guard import branch_guard
from srm_mbs.integration.singular_endpoints import start
from srm_mbs.integration.singular_passages import (
    REVERSAL_SIGMA,
    Bifurcation,
    find_bifurcations,
)
from srm_mbs.model.forces import LimitSpring
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import per_model, per_tree
from srm_mbs.model.numbers import finite_array
from srm_mbs.model.validation import START_ARGUMENTS
from srm_mbs.simulation.consistency import closed_start
from srm_mbs.simulation.failure_causes import (
    HeldForceWatch,
    failure_cause,
    rounding_clause,
    unrepeatable,
)
from srm_mbs.simulation.monitoring import log_end, log_start, progress_of
from srm_mbs.simulation.options import (
    RunOptions,
    check_avoidable,
    check_embedded,
    checked_atol,
    checked_breakpoints,
    checked_method,
    checked_samples,
    checked_span,
    loosest_rtol,
    tightest_rtol,
)
from srm_mbs.simulation.result import (
    KnownRunData,
    RunOutcome,
    Settings,
    SimulationResult,
    Statistics,
    attempt_array,
)
from srm_mbs.simulation.streamed_output import OutputStream, StreamedOutput

DESCRIBED_BIFURCATIONS = 2
"""Bifurcations that the message of a run describes."""
LIMIT_ROUNDING = 1e-12
"""Distance (rad, m) beyond a joint limit that is rounding; times |q| where that is above 1."""
LONGEST_REPEATED = 2.0
"""Longest first step of a segment that continues another, over the length of that one: events come
as soon again, and a longer step would be read at its beginning only."""
SHORTEST_REPEATED = 0.1
"""That step, over the last one, below which the first step is chosen as at the start of a run."""
STIFF_START = 1e-10
"""First step, over the length of the run, where the start is faster than any step."""
SMALLER_STEPS = "See solution.crossings; try a smaller rtol or step."
"""Remedy for a passage that may have changed the branch."""
KEPT_NORMS = 16
"""Error norms that a mechanism keeps at most."""
KEPT_OPTIONS = 64
"""Checked options that are kept at most."""
_PLAIN = frozenset((float, int, bool, str, tuple, type(None)))
"""Types of options that are known by their value."""
_known_options: dict[tuple[bool, tuple[Any, ...], tuple[type, ...]], RunOptions] = {}
"""Checked options, by those of the user."""

Result = TypeVar("Result", bound=SimulationResult)
Outcome = TypeVar("Outcome", bound=RunOutcome)
Counters = Sequence[ControlWrapper | CompiledRecord]
"""Objects that counted placed and replaced steps, and know suspect times: the wrappers of a
step-size control, or the record of a run of the kernel."""


@dataclass(eq=False)
class Problem:
    """The initial value problem of a mechanism, ready to be integrated.

    Attributes
    ----------
    mechanism
        With the initial state of the run.
    options
        Checked ones.
    system, norm
        The equations of motion, and the error norm with the tolerances of the run.
    state : (nq + nv,)
        Initial state.
    intervals
        Where the right-hand side is smooth.
    backend
        Makes the run: ``"python"``, ``"kernel"`` or ``"generated"``.
    held
        The forces that a sampled controller held; None without one.
    held_watch
        Watches them for instability; None without one.
    watch
        Looks for the events; None without any.
    passages
        Examines passages of singular configurations; None where steps make them all.
    stream
        Takes the steps of a run with output times; None without them.
    last_step
        Length (s) of the last step of the segment before, as far as it is used; 0 without one.
    stiff
        Whether that segment was stiff at its end.
    code
        The generated code that computes the terms; None without it.
    meter
        Counts the time of a run for which code may be compiled; None for others.
    travelled
        The coordinates of the segments before; None without them, and without joint limits.
    """

    mechanism: Mechanism
    options: RunOptions
    system: OpenSystem | ClosedSystem
    norm: ErrorNorm
    state: FloatArray
    intervals: SmoothIntervals
    backend: str
    held: HeldForce | None
    watch: EventWatch | CompiledEventWatch | None
    passages: CriticalPassages | None
    held_watch: HeldForceWatch | None = None
    stream: OutputStream | None = None
    last_step: float = 0.0
    stiff: bool = False
    code: Any = None
    meter: Meter | None = None
    travelled: Travelled | None = None


class Travelled(NamedTuple):
    """Coordinates (nq,) of a run so far: at its start, the least and the largest."""

    start: FloatArray
    least: FloatArray
    largest: FloatArray

    @classmethod
    def of(
        cls, start: FloatArray, least: FloatArray, largest: FloatArray, before: Travelled | None
    ) -> Travelled:
        """Those of a part with these coordinates, and of what was ``before`` it."""
        if before is None:
            return cls(start, least, largest)
        return cls(
            before.start, np.minimum(before.least, least), np.maximum(before.largest, largest)
        )


@dataclass(eq=False, slots=True)
class Segment(Generic[Result]):
    """A segment of a run, between the actions of events.

    Attributes
    ----------
    problem, result
        What was asked for, and the result.
    end
        The end of its steps.
    """

    problem: Problem
    result: Result
    end: EndOfSteps

    @property
    def last_state(self) -> FloatArray:
        """q and v (nq + nv,) at its end."""
        state = self.end.state
        return self.result.last_state if state is None else state

    @property
    def travelled(self) -> Travelled | None:
        """The coordinates of the run up to its end; None without joint limits."""
        problem = self.problem
        if not _limited_joints(problem.mechanism):
            return problem.travelled
        q = self.result.q
        start, least, largest = problem.mechanism.q0, q.min(axis=0), q.max(axis=0)
        return Travelled.of(start, least, largest, problem.travelled)


def run_segment(
    mechanism: Mechanism,
    options: RunOptions,
    result_type: type[Result],
    workspaces: SuccessiveWorkspaces,
    before: Segment[Result] | None,
) -> Segment[Result]:
    """A segment of a run, between the actions of events.

    Parameters
    ----------
    options
        From :func:`checked_options`.
    result_type
        Class of the result.
    workspaces
        Kernel systems of the segments.
    before
        The segment that this one continues; its equations of motion serve this one, too, unless the
        mechanism was switched.
    """
    problem = assemble_problem(mechanism, options, before)
    record, counters, kernel_system = _make_record(problem, workspaces, before is None)
    end = record.end_of_steps()
    result = assemble_result(problem, record, counters, kernel_system, result_type)
    log_end(mechanism.name, result)
    return Segment(problem, result, end)


def run_whole(mechanism: Mechanism, options: RunOptions, result_type: type[Result]) -> Result:
    """A run without event actions; the parameters are those of :func:`run_segment`."""
    with SuccessiveWorkspaces() as workspaces:
        problem = assemble_problem(mechanism, options)
        made = _make_record(problem, workspaces, True)
        result = assemble_result(problem, *made, result_type)
        log_end(mechanism.name, result)
        return result


def _make_record(
    problem: Problem, workspaces: SuccessiveWorkspaces, first: bool
) -> tuple[RunRecord, Counters, Any]:
    """As :func:`integrate_problem`, logged, with the cause of a failure; ``first``: no segment was
    made before."""
    log_start(problem.mechanism.name, problem.options, problem.norm, problem.backend)
    record, counters, kernel_system = integrate_problem(problem, workspaces)
    if first:
        raise_at_first_call(record.error, problem.options.t0)
    lead_with_cause(problem, record)
    return record, counters, kernel_system


def lead_with_cause(problem: Problem, record: RunRecord) -> None:
    """Let the message of a run whose steps failed begin with the cause, if it is found."""
    failed = record.status is RunStatus.FAILED and record.stop_reason is not StopReason.MEMORY
    if not failed or record.error is not None:
        return
    state = record.run.core.state if isinstance(record, CompiledRecord) else record.last_state
    q, v = problem.system.split(state)
    time = record.end_of_steps().time
    cause = failure_cause(problem.mechanism, time, q, problem.held_watch)
    if problem.options.controller is not None and problem.options.sample_time is None:
        force = problem.system.controlled_force
        cause = unrepeatable(problem.mechanism, force, time, q, v) or cause
    if cause is not None:
        record.lead_with(cause)


def raise_at_first_call(error: BaseException | None, t0: float) -> None:
    """Raise the ``error`` of a run from ``t0`` (s), if a function of the user failed where it was
    called first: at the start there is no result to keep.

    Raises
    ------
    ControllerError, EventError
        With what the function raised as its cause.
    """
    if isinstance(error, FunctionError) and error.t == t0:
        raise error


def unstarted_segment(
    mechanism: Mechanism, options: RunOptions, error: Exception, result_type: type[Result]
) -> Result:
    """The result of a run that ``error`` ends at its start."""
    problem = assemble_problem(mechanism, options)
    record = failed_start(options.t0, problem.state, error, " s")
    return assemble_result(problem, record, (), None, result_type)


def finished(result: Outcome, options: RunOptions) -> Outcome:
    """``result``, unless it failed and the caller asked for an exception.

    Raises
    ------
    SimulationError
        With ``raise_on_failure``.
    """
    if options.raise_on_failure and not result.success:
        raise SimulationError(result.message, result) from result.error
    return result


# --- check ----------------------------------------------------------------------------------------


def checked_options(mechanism: Any, options: RunOptions) -> RunOptions:
    """``options`` of a run of ``mechanism`` with values of their final types.

    Raises
    ------
    InputError
        For the first that is invalid.
    """
    check_mechanism(mechanism)
    return above_rounding(mechanism, _checked(mechanism, options))


def above_rounding(mechanism: Mechanism, options: RunOptions) -> RunOptions:
    """Checked ``options`` with an rtol that the rounding of the initial positions allows; warns
    where it is changed."""
    if options.step is not None or not mechanism.constrained:  # closures magnify it
        return options
    # Invalid positions are refused elsewhere.
    given = None if options.q0 is None else finite_array(options.q0, (mechanism.model.nq,))
    rounding = start_rounding(mechanism) if given is None else position_rounding(mechanism, given)
    if options.rtol >= rounding.relative:
        return options
    warn(
        f"rtol = {options.rtol:g} is below the rounding of the initial positions "
        f"({rounding_clause(mechanism, rounding)}): using {rounding.relative:.1e}"
    )
    return options._replace(rtol=rounding.relative)


def _checked(mechanism: Mechanism, options: RunOptions) -> RunOptions:
    # Most runs of a loop have the same options, of which those without functions and arrays are
    # known by their values and types: 1 is no truth value, and True no number.
    others = options[:2] + options[4:]  # without the start, which is checked elsewhere
    types = tuple(map(type, others))
    plain = _PLAIN.issuperset(types) and not (options.breakpoints or options.singular_times)
    key = (mechanism.constrained, others, types) if plain else None
    known = None if key is None else _known_options.get(key)
    if known is not None:
        if options.q0 is None and options.v0 is None:
            return known
        return RunOptions._make(known[:2] + options[2:4] + known[4:])
    checked = _checked_anew(mechanism, options)
    if key is not None and checked.rtol == options.rtol:  # others warn each time
        if len(_known_options) >= KEPT_OPTIONS:
            _known_options.clear()
        _known_options[key] = checked._replace(q0=None, v0=None)
    return checked


def _checked_anew(mechanism: Mechanism, options: RunOptions) -> RunOptions:
    t0, t_end = checked_span(options.t0, options.t_end)
    if options.controller is not None and not callable(options.controller):
        raise InputError(
            f"controller = {safe_repr(options.controller)} cannot be called",
            element="controller",
            remedy="Give a function of (t, q, v) that returns the generalised forces, or "
            "{joint: force}",
        )
    return checked_accuracy(mechanism, options, t0, t_end)


def checked_accuracy(
    mechanism: Mechanism, options: RunOptions, t0: float, t_end: float
) -> RunOptions:
    """The options of steps, tolerances, method and output, checked for a run in [t0, t_end] (s)."""
    method = mechanism_method(options.method, options.tableau)
    tightest = tightest_rtol(method.scheme, mechanism.constrained)
    return options.checked(
        method,
        (tightest, loosest_rtol(method)),
        (t0, t_end),
        unit=" of seconds",
        arguments="(t, h, state)",
    )


def mechanism_method(method: str | Method, tableau: str | ButcherTableau | None) -> Method:
    """A method object from a name or an object, for the equations of a mechanism."""
    checked = checked_method(method, tableau)
    if getattr(checked, "T", "identity") != "identity":
        raise InputError(
            "T is given, but the sweeps of mechanisms (2.6) have no such matrix",
            element="method",
            remedy="Leave T out; it is for srm.solve_dae",
        )
    return checked


def absolute_tolerance(mechanism: Mechanism, atol: Any, rtol: float) -> FloatArray:
    """Absolute tolerance per tangent component (2 nv,)."""
    if atol is None:
        tolerance: FloatArray = rtol * mechanism.structure.units.state
        return tolerance
    nv = mechanism.model.nv
    remedy = f"Give one positive number, {nv} (per coordinate) or {2 * nv} (positions, then rates)"
    array = checked_atol(atol, (nv, 2 * nv), remedy)
    if array.shape == (nv,):
        array = np.tile(array, 2)
    return np.broadcast_to(array, (2 * nv,)).copy()


@per_model
def _usual_norms(mechanism: Mechanism) -> dict[tuple[float, float, float, Units], ErrorNorm]:
    """Error norms without an absolute tolerance of the user, by what they are made of."""
    return {}


def error_norm(mechanism: Mechanism, options: RunOptions) -> ErrorNorm:
    """The error norm with the tolerances of checked ``options``."""
    known = _usual_norms(mechanism)
    singular = exact_up_to(options.singular_tolerance)
    key = options.rtol, options.negligible, singular, mechanism.structure.units
    if options.atol is None and key in known:
        return known[key]
    atol = absolute_tolerance(mechanism, options.atol, options.rtol)
    unit = mechanism.structure.units.state
    norm = ErrorNorm(atol, options.rtol, options.negligible, unit, singular)
    if options.atol is None:
        if len(known) >= KEPT_NORMS:
            known.clear()
        known[key] = norm
    return norm


def initial_state(
    mechanism: Mechanism, t0: float, q0: Any, v0: Any
) -> tuple[Mechanism, FloatArray]:
    """The mechanism with the requested start, and the state (q, v).

    Drives begin with the state at 0; a later start is one of the motion from there.
    """
    known = (q0 is None or q0 is mechanism.q0) and (v0 is None or v0 is mechanism.v0)
    if not known:
        q0 = mechanism.q0 if q0 is None else q0
        v0 = mechanism.v0 if v0 is None else v0
        if t0 == 0.0:
            mechanism = mechanism.with_state(q0, v0)
        else:
            mechanism = mechanism.moved(q0, v0, START_ARGUMENTS)
    return mechanism, mechanism.start_state


# --- assemble the problem -------------------------------------------------------------------------


def assemble_problem(
    mechanism: Mechanism, options: RunOptions, before: Segment[Result] | None = None
) -> Problem:
    """The problem of a run of ``mechanism``; ``before`` as for :func:`run_segment`.

    Raises
    ------
    InputError
        If the start is inconsistent, a law does not cover the run, or the backend cannot make it.
    """
    t0, t_end, method = options.t0, options.t_end, options.method
    held = None if options.sample_time is None else HeldForce()
    known = None if before is None or held is not None else before.problem
    if known is not None and known.mechanism.structure is not mechanism.structure:
        known = None
    if known is not None and known.intervals.unbroken:
        intervals = known.intervals
    else:
        samples = checked_samples(options.sample_time, options.controller, t0, t_end)
        given = checked_breakpoints(options.breakpoints)
        own = mechanism.breakpoints(t0, t_end)
        intervals = smooth_intervals(np.append(given, own) if own else given, samples, t0, t_end)
        check_avoidable(options.singular_times, intervals.ends, t_end - t0)
    if known is not None:
        by, code = known.backend, known.code
    elif before is not None:
        by, code = code_of_run(before.problem.backend, options.backend, mechanism)
    else:
        by = chosen_backend(options.backend, method, options.placement, options.singular_times)
        by, code = code_of_run(by, options.backend, mechanism)
    mechanism, state = initial_state(mechanism, t0, options.q0, options.v0)
    if known is not None:
        system, norm = known.system, known.norm
        system.restart()
    else:
        system = make_system(mechanism, options.controller if held is None else held)
        norm = error_norm(mechanism, options)
        mechanism.check_covers(t_end)
    if mechanism.constrained:
        closed, _ = closed_start(mechanism, t0, norm, by, system)
        if closed is not mechanism.start_state:
            q0, v0 = system.split(closed)
            return assemble_problem(mechanism, options._replace(q0=q0, v0=v0), before)
    watch: EventWatch | CompiledEventWatch | None = None
    if options.events is not None:
        nq, nv = system.nq, system.nv
        events = prepare_events(options.events, lambda event: MechanismFunction(event, nq))
        if by in COMPILED:
            watch = CompiledEventWatch(method.scheme, events, nq, nv)
        else:
            watch = EventWatch(method.scheme, events, state.size)
    passages = examined_passages(
        system, method, norm, options.placement, options.singular_tolerance
    )
    problem = Problem(mechanism, options, system, norm, state, intervals, by, held, watch, passages)
    problem.code = code
    if known is not None:
        measured = known.meter is not None
    else:
        measured = by == "kernel" and options.backend == "auto" and code_is_compiled()
    if measured:
        problem.meter = Meter(mechanism)
    if before is not None:
        problem.travelled = before.travelled
        problem.stiff = before.end.stiff
        if known is not None:
            problem.last_step = _repeated_step(before.end)
    # Sweeps say at the end what they met in their steps.
    if options.t_eval is not None and is_split(method):
        problem.stream = OutputStream(system, method.scheme, options.t_eval, by)
    return problem


def _repeated_step(end: EndOfSteps) -> float:
    """The first step (s) of the segment after one with that ``end``; 0: that of a run's start."""
    longest = LONGEST_REPEATED * (end.time - end.start)
    last = end.last_time - end.last_start
    return min(last, longest) if longest > SHORTEST_REPEATED * last else 0.0


def sampler(
    system: OpenSystem | ClosedSystem,
    held: HeldForce,
    watch: HeldForceWatch,
    controller: Controller,
    interval: float,
    kernel_system: Any,
) -> Callable[[float, FloatArray], None]:
    """A function (t, state) that samples ``controller`` every ``interval`` (s) for ``held`` and for
    the kernel; ``watch`` ends the run of an unstable one."""

    def sample(t: float, state: FloatArray) -> None:
        q, v = system.split(state)
        force = evaluate_controller(controller, system.mechanism, t, q, v)
        watch.add(force, v)
        watch.stop_runaway(t, interval)
        held.hold(t, force)
        if kernel_system is not None:
            kernel_system.hold(t, force, True)

    return sample


def placed_control(
    system: System,
    options: RunOptions,
    first_step: Callable[[], float],
    arrivals: bool = False,
) -> tuple[StepSizeControl, Sequence[ControlWrapper]]:
    """The step-size control of a run, and the wrappers in it that count what they did.

    Parameters
    ----------
    first_step
        Length (s) of the first step, asked for if the control needs it.
    arrivals
        Whether the driver prepares for ends beside singular configurations.
    """
    scheme, t_end, step = options.method.scheme, options.t_end, options.step
    check_embedded(scheme, step)
    control: StepSizeControl
    if step is None:
        orders = (scheme.member(stiff).controller_order or 1 for stiff in (False, True))
        control = PIControl(t_end, first_step(), *orders)
    else:
        control = FixedStep(options.t0, t_end, step)
    placement = options.placement if system.has_constraints else None
    times, scatters = options.singular_times, system.sigma_scatters
    control, wrappers = placed(control, scheme, placement, times, t_end, step, arrivals, scatters)
    if placement != "automatic":
        return control, wrappers
    guard = branch_guard(control, system, options.method)
    return guard, (*wrappers, guard)


# --- integrate ------------------------------------------------------------------------------------


def integrate_problem(
    problem: Problem, workspaces: SuccessiveWorkspaces
) -> tuple[RunRecord, Counters, Any]:
    """The record of the run, its counters, and the kernel's system if there is one, which is of
    ``workspaces``.

    Whatever happens on the way ends in the record: a start that cannot be evaluated, too.
    """
    kernel_system = None
    try:
        if problem.backend in COMPILED:
            kernel_system = workspaces.of(problem.system, problem.code)
        found = _integrate(problem, kernel_system)
        if _starts_too_fast(found[0], problem.options):
            # The transient is too short for any step: implicit ones pass over it.
            problem.stiff = True
            problem.last_step = STIFF_START * (problem.options.t_end - problem.options.t0)
            found = _integrate(problem, kernel_system)
        return *found, kernel_system
    except (EvaluationError, ControllerError) as error:
        return failed_start(problem.options.t0, problem.state, error, " s"), (), kernel_system


def _starts_too_fast(record: RunRecord, options: RunOptions) -> bool:
    """Whether a run that may take implicit steps stopped because the first step that it chose is
    below round-off."""
    if record.stop_reason is not StopReason.ROUND_OFF or record.rest is not None:
        return False
    end = record.end_of_steps()
    if end.last_time > end.start:
        return False
    scheme = options.method.scheme
    implicit = scheme.implicit is not None or scheme.stiff is not None
    return implicit and options.step is None and options.first_step is None


def _integrate(problem: Problem, kernel_system: Any) -> tuple[RunRecord, Counters]:
    system, options, state, norm = problem.system, problem.options, problem.state, problem.norm
    method, t0 = options.method, options.t0
    evaluator = None if kernel_system is None else Evaluator(system, kernel_system)
    handler = BreakpointHandler(problem.intervals, system, method, norm, evaluator)
    if problem.held is not None:
        watch = problem.held_watch = HeldForceWatch(problem.mechanism)
        controller, interval = options.controller, float(options.sample_time)
        handler.sample = sampler(system, problem.held, watch, controller, interval, kernel_system)
        handler.sample(t0, state)
    if evaluator is None:
        passages = problem.passages
        memory = start(system, method, t0, state, norm, handler.end, layers=passages)
        memory.stiff = problem.stiff
        if passages is not None and passages.under_way:
            problem.last_step = step_from_layer(problem.mechanism, state)
        found = integrate_steps(
            system,
            options,
            norm,
            memory,
            state,
            cast(EventWatch | None, problem.watch),
            handler,
            problem.passages,
            sink=problem.stream,
            last_step=problem.last_step,
        )
        handler.done()
        return found
    check_embedded(method.scheme, options.step)
    layers = None
    if problem.passages is not None:
        layers = CompiledLayerStart(kernel_system, system, options.singular_tolerance)
    first = first_stage(evaluator, method, t0, state, norm, handler.end, problem.stiff, layers)
    motion = None if layers is None else layers.motion
    if motion is not None:
        problem.last_step = step_from_layer(problem.mechanism, state)
    given = options.first_step or problem.last_step or None
    try:
        run = _compiled_run(problem, kernel_system, first, given, handler)
    except ArithmeticError:  # the reference raises the error that says why
        known = state_from(first)
        first_step = chosen_first_step(
            evaluator, norm, options, known, state, smooth_until=handler.end
        )
        run = _compiled_run(problem, kernel_system, first, first_step, handler)
    if motion is not None:
        run.begin(t0, state, first, cast(float, given), motion)
    with progress_of(options.progress, system, options.t_end) as tick:
        record = kernel_driver.integrate(
            system,
            run,
            tick=tick,
            events=problem.watch,
            passing=handler,
            passages=problem.passages,
            sink=problem.stream,
            meter=problem.meter,
        )
    handler.done()
    return record, (record,)


def _compiled_run(
    problem: Problem,
    kernel_system: Any,
    memory: Any,
    first_step: float | None,
    handler: BreakpointHandler,
) -> CompiledRun:
    options = problem.options
    return CompiledRun(
        kernel_system,
        options.method,
        problem.norm,
        memory,
        problem.state,
        problem.intervals,
        t0=options.t0,
        step=options.step,
        first_step=first_step,
        max_step=options.longest_step,
        placed=options.placement,
        arrivals=handler.arrivals,
        singular_tolerance=None if problem.passages is None else options.singular_tolerance,
    )


def integrate_steps(
    system: System,
    options: RunOptions,
    norm: ErrorNorm,
    memory: IntegratorState,
    state: FloatArray,
    watch: EventWatch | None,
    handler: BreakpointHandler | None = None,
    passages: CriticalPassages | None = None,
    words: ProblemVocabulary = MECHANISM,
    sink: StepSink | None = None,
    last_step: float = 0.0,
) -> tuple[RunRecord, Sequence[ControlWrapper]]:
    """The record of a run with the Python reference, and the wrappers of its control.

    The parameters are those of :func:`srm_mbs.integration.driver.integrate`, and ``last_step`` as
    for :func:`chosen_first_step`.
    """
    control, wrappers = placed_control(
        system,
        options,
        lambda: chosen_first_step(
            system,
            norm,
            options,
            memory,
            state,
            last_step,
            np.inf if handler is None else handler.end,
        ),
        handler is not None and handler.arrivals,
    )
    with progress_of(options.progress, system, options.t_end) as tick:
        record = driver.integrate(
            system,
            options.method,
            control,
            norm,
            memory,
            state,
            options.t0,
            options.t_end,
            max_step=options.longest_step,
            tick=tick,
            events=watch,
            breakpoints=handler,
            passages=passages,
            words=words,
            sink=sink,
        )
    return record, wrappers


def chosen_first_step(
    evaluator: Any,
    norm: ErrorNorm,
    options: RunOptions,
    memory: IntegratorState,
    state: FloatArray,
    last_step: float = 0.0,
    smooth_until: float = np.inf,
) -> float:
    """The given first step (s), the ``last_step`` of the segment before, if there is one with the
    same equations, or the step that the start of the run allows, which is smooth until
    ``smooth_until`` (s)."""
    if options.first_step is not None:
        return float(options.first_step)
    order = options.method.scheme.controller_order or 1
    span, t0 = options.t_end - options.t0, options.t0
    return last_step or initial_step(
        evaluator, state, memory, norm, span, order, t0, smooth_until - t0
    )


def failed_start(t0: float, state: FloatArray, error: Exception, unit: str = "") -> RunRecord:
    """The record of a run that could not make its first step."""
    record = RunRecord(t0, state.copy(), time_unit=unit)
    record.status = RunStatus.FAILED
    record.error = error
    record.message = f"Stopped at t = {time_text(t0)}{unit}: {error}."
    return record


# --- collect --------------------------------------------------------------------------------------


def statistics(
    record: RunRecord,
    steps: int,
    zone_steps: int,
    counters: Counters,
    work: tuple[int, int],
) -> Statistics:
    """Counts of a run; ``work``: numbers of evaluations and factorisations."""
    return Statistics(
        steps,
        [attempt.decision for attempt in record.attempts].count(StepDecision.REJECTED),
        sum(counter.placed for counter in counters),
        sum(counter.replaced for counter in counters),
        zone_steps,
        *work,
        record.wall_time,
    )


def settings(
    options: RunOptions,
    norm: ErrorNorm,
    controlled: bool,
    backend: str,
    stiff: Sequence[tuple[float, float]] = (),
    user_forces: bool = False,
) -> Settings:
    """The settings of a run that was made with ``options``; ``stiff``: where it was (s)."""
    return Settings(
        type(options.method).__name__,
        options.method.scheme.name,
        options.rtol,
        tuple(norm.atol.tolist()),
        options.step,
        controlled,
        options.placement,
        tuple(options.singular_times.tolist()),
        backend,
        options.singular_tolerance,
        tuple(stiff),
        user_forces,
    )


class FinishedRun:
    """The data of a run that has ended (:class:`~srm_mbs.simulation.result.RunData`).

    Most runs of a sweep or a loop need few of them: each is computed when it is first read.  What
    may call functions of the user is read at once.

    Parameters
    ----------
    problem, record, counters, kernel_system
        From :func:`integrate_problem`.
    result_type
        Class of the result, if the run has to be made again.
    """

    def __init__(
        self,
        problem: Problem,
        record: RunRecord,
        counters: Counters,
        kernel_system: Any,
        result_type: type[SimulationResult],
    ) -> None:
        self._system, options = problem.system, problem.options
        self._mechanism, self._norm = problem.mechanism, problem.norm
        self._options = options if options.progress is False else options._replace(progress=False)
        self.backend, self._passages = problem.backend, problem.passages
        self._travelled = problem.travelled
        self._kernel_system = None if shared(problem.system) else kernel_system
        self._record, self._counters = record, counters
        if record.status is RunStatus.INTERRUPTED:
            record.add_pace(options.t_end, _pace_remedy(options))
        if self._passages is not None and self._passages.examined:
            self._passages.ended(record.end_of_steps().time)
        # Before anything reads the dense output, which evaluates stages.
        self._work = self._system.evaluations, self._system.factorisations
        self.controlled = options.controller is not None or self._system.has_user_forces
        self.output: StreamedOutput | None = None
        self.again: Callable[[], SimulationResult] | None = None
        self._streamed = problem.stream is not None
        if problem.stream is not None:
            last = record.data(options.method.scheme, self._system.tangent_size)
            kept = problem.stream.finish(last, record.status is RunStatus.FAILED)
            if isinstance(kept, StreamedOutput):
                self.steps, self.output = None, kept
                if not self.controlled:
                    repeated = self._options._replace(t_eval=None, backend=self.backend)
                    self.again = partial(run_whole, self._mechanism, repeated, result_type)
            else:
                self.steps = kept
        if self.controlled or not isinstance(record, CompiledRecord):
            _ = self.message
        record.close()

    def __reduce__(self) -> tuple[Any, ...]:
        found = (self.steps, self.dense, self.attempts, self.message, self.stats, self.settings)
        return KnownRunData, (*found, self.output, self.again, self.bifurcations)

    @cached_property
    def steps(self) -> StepData | None:
        return self._record.data(self._options.method.scheme, self._system.tangent_size)

    @property
    def span(self) -> tuple[float, float]:
        if self._summary is not None:
            return cast(CompiledRecord, self._record).span()
        steps = cast(StepData, self.steps)
        return float(steps.times[0]), steps.end

    @cached_property
    def nodes(self) -> tuple[FloatArray, FloatArray]:
        record = self._record
        # A stream took the steps out of the record.
        whole = isinstance(record, CompiledRecord) and not self._streamed
        found = cast(CompiledRecord, record).nodes() if whole else None
        if found is not None:
            return found
        return cast(DenseOutput, self.dense).nodes()

    @cached_property
    def dense(self) -> DenseOutput | None:
        record, scheme = self._record, self._options.method.scheme
        if self._summary is not None:
            record = cast(CompiledRecord, record)
            steps: Any = partial(record.data, scheme, self._system.tangent_size)
            count, recorded = self._summary.steps, record.recorded()
        elif self.steps is None:
            return None
        else:
            steps, count, recorded = self.steps, self.steps.count, None
        # The dense output of a single step is that in which the event was found.
        end_state = record.stop_state if count == 1 else None
        if isinstance(record, CompiledRecord):
            own, by = self._kernel_system, self.backend
            return CompiledDenseOutput(own, self._system, scheme, steps, end_state, by, recorded)
        return DenseOutput(self._system, scheme, steps, end_state)

    @cached_property
    def attempts(self) -> NDArray[np.void]:
        return attempt_array(self._record.attempts)

    @cached_property
    def _summary(self) -> StepSummary | None:
        """Summary of the steps, if it can be had without their arrays."""
        record = self._record
        kept = isinstance(record, CompiledRecord) and not self._streamed
        return cast(CompiledRecord, record).summary() if kept else None

    @cached_property
    def stats(self) -> Statistics:
        if self._summary is not None:
            steps, zone_steps = self._summary.steps, self._summary.zone_steps
        elif self.output is not None:
            steps, zone_steps = self.output.count, self.output.zone_steps
        else:
            data = cast(StepData, self.steps)
            steps, zone_steps = data.count, len(data.zones)
        return statistics(self._record, steps, zone_steps, self._counters, self._work)

    @cached_property
    def settings(self) -> Settings:
        return settings(
            self._options,
            self._norm,
            self.controlled,
            self.backend,
            self._stiff_intervals,
            self._system.has_user_forces,
        )

    @property
    def _stiff_intervals(self) -> list[tuple[float, float]]:
        if self._summary is not None and not self._summary.stiff:
            return []
        data = self.output or self.steps
        return [] if data is None else data.stiff_intervals

    @cached_property
    def bifurcations(self) -> tuple[Bifurcation, ...]:
        if self.output is not None:
            return self.output.bifurcations
        summary = self._summary
        if summary is not None and not (summary.held or summary.least_sigma < REVERSAL_SIGMA):
            return ()  # as the search for them, which needs the steps
        failed = self._record.status is RunStatus.FAILED
        steps = cast(StepData, self.steps)
        return find_bifurcations(self._system, steps, lambda: cast(DenseOutput, self.dense), failed)

    @cached_property
    def message(self) -> str:
        options, record = self._options, self._record
        method = options.method
        return (
            record.message
            + branch_changes(suspected(self._counters), "the velocity turned", SMALLER_STEPS)
            + method_messages(method, record.steps, self._norm)
            + ("" if self._passages is None else self._passages.message())
            + stiffness_sentence(self._stiff_intervals, method.scheme, options.step is None)
            + self._coordinate_sentences()
            + _driven_too_far(self._mechanism, record)
            + bifurcation_sentences(self.bifurcations)
        )

    def _coordinate_sentences(self) -> str:
        """Sentences about the coordinates at the ends of the steps."""
        output = self.output
        if output is not None:
            least, largest, turned = output.least, output.largest, output.over_half_turn
        else:
            q = self.nodes[1][:, : self._system.nq]
            # The reductions themselves: their methods cost more than they do here.
            least, largest = np.minimum.reduce(q), np.maximum.reduce(q)
            turned = over_half_turn(self._mechanism, q)
        so_far = Travelled.of(self._mechanism.q0, least, largest, self._travelled)
        return _limits_left(self._mechanism, so_far) + _half_turns(turned)


def assemble_result(
    problem: Problem,
    record: RunRecord,
    counters: Counters,
    kernel_system: Any,
    result_type: type[Result],
) -> Result:
    """The result of a run, from what :func:`integrate_problem` returned."""
    result = result_type(
        problem.mechanism,
        problem.system,
        problem.options.method.scheme,
        FinishedRun(problem, record, counters, kernel_system, result_type),
        t_eval=problem.options.t_eval,
        events=None if problem.watch is None else _found_events(problem.watch, record),
        status=record.status,
    )
    result.error = record.error
    return result


def _found_events(
    watch: EventWatch | CompiledEventWatch, record: RunRecord
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Times (s) and states of the events that ``watch`` found; those at the end of the run have the
    state there, which may be more accurate than the dense output."""
    times, states = watch.found()
    if record.stop_state is not None:
        for own, reached in zip(times, states):
            reached[own == record.stop] = record.stop_state
    return times, states


def _pace_remedy(options: RunOptions) -> str:
    """A sentence on the usual reason why the steps of a run are short."""
    if options.step is not None:
        return "Give a longer step, or none: steps then follow a tolerance."
    if not is_split(options.method):
        return 'Sweeps need shorter steps than method="psrm".'
    if options.controller is not None and options.sample_time is None:
        return "Give sample_time to a controller that is noisy, jumps or remembers earlier calls."
    return "A larger rtol, or forces that change less abruptly, allow longer ones."


def _half_turns(names: tuple[str, ...]) -> str:
    """A sentence about the bushings ``names``, which turned by more than half a turn."""
    if not names:
        return ""
    return (
        " Bushings turned by more than half a turn, where their moments jump to the opposite "
        f"({', '.join(names)}). Torsion springs have none of these jumps: their angles count turns."
    )


def _driven_too_far(mechanism: Mechanism, record: RunRecord) -> str:
    """A sentence on drives as a possible cause of a failure; empty without them."""
    failed = record.status is RunStatus.FAILED and record.stop_reason is not StopReason.MEMORY
    if not failed or not mechanism.drives or record.cause is not None:
        return ""
    names = ", ".join(drive.name for drive in mechanism.drives)
    return f" A drive ({names}) may lead where the mechanism cannot follow."


def bifurcation_sentences(found: Sequence[Bifurcation]) -> str:
    """A sentence for each singular configuration that was reached without momentum."""
    more = f" There were {len(found)} of them." if len(found) > DESCRIBED_BIFURCATIONS else ""
    return "".join(f" {bifurcation}." for bifurcation in found[:DESCRIBED_BIFURCATIONS]) + more


@per_tree
def _limited_joints(mechanism: Mechanism) -> list[tuple[str, int, float, float]]:
    """Name, index in q, least and largest coordinate of the one-degree joints with limits."""
    model = mechanism.model
    limited = []
    sprung = {force.joint for force in mechanism.forces if isinstance(force, LimitSpring)}
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        if joint.nq == 1 and name not in sprung:
            low = float(model.lowerPositionLimit[joint.idx_q])
            high = float(model.upperPositionLimit[joint.idx_q])
            if low < high and (np.isfinite(low) or np.isfinite(high)):
                limited.append((name, joint.idx_q, low, high))
    return limited


def _limits_left(mechanism: Mechanism, run: Travelled) -> str:
    """A sentence naming the one-degree joints that started beyond their limits, which do not act,
    and those that left them."""
    limited = _limited_joints(mechanism)
    if not limited:
        return ""
    lows, highs = run.least.tolist(), run.largest.tolist()
    started: list[str] = []
    left: list[str] = []
    for name, i, low, high in limited:
        # A run that a terminal event ends at a limit has not left it.
        slack = LIMIT_ROUNDING * max(1.0, -lows[i], highs[i])
        if max(low - lows[i], highs[i] - high) > slack:
            inside = low - slack <= run.start[i] <= high + slack
            (left if inside else started).append(name)
    clauses = [f"these joints left theirs: {', '.join(left)}"] if left else []
    clauses += [f"these joints started beyond theirs: {', '.join(started)}"] if started else []
    return f" Joint limits do not act; {'; '.join(clauses)}." if clauses else ""
