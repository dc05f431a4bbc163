r"""The one runner: check the options, assemble the problem, integrate, collect the result.

Every run goes these four steps, whoever asks for it: :func:`srm_mbs.simulate`, each segment of a
run with event actions, a rerun with another accuracy; :func:`srm_mbs.solve_dae` and
:class:`srm_mbs.Simulator` use the same checks, controls and records.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.rheonomic import constraint_errors
from srm_mbs.dynamics.controllers import Controller, HeldForce, evaluate_controller
from srm_mbs.dynamics.dae import DaeSystem
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem, make_system
from srm_mbs.dynamics.scaling import constraint_units
from srm_mbs.dynamics.system import System
from srm_mbs.errors import ControllerError, EvaluationError, InputError, SimulationError
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
from srm_mbs.integration.dense_output import DenseOutput, StepData
from srm_mbs.integration.driver import RunRecord, RunStatus
from srm_mbs.integration.events import EventWatch, StateFunction, prepare_events
from srm_mbs.integration.kernel import driver as kernel_driver
from srm_mbs.integration.kernel.backend import uses_kernel
from srm_mbs.integration.kernel.dense_output import CompiledDenseOutput
from srm_mbs.integration.kernel.driver import CompiledRecord
from srm_mbs.integration.kernel.run import CompiledRun
from srm_mbs.integration.kernel.system import Evaluator, shared, workspace
from srm_mbs.integration.messages import MECHANISM, ProblemVocabulary, branch_changes
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, Method, method_messages
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.thesis.sweep_branch_guard import branch_guard
from srm_mbs.integration.singular_endpoints import start
from srm_mbs.model.forces import LimitSpring
from srm_mbs.model.mechanism import per_model, per_start
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
    RunOutcome,
    Settings,
    SimulationResult,
    Statistics,
    attempt_array,
)

DESCRIBED_BIFURCATIONS = 2
"""Bifurcations that the message of a run describes."""
LIMIT_ROUNDING = 1e-12
"""Distance (rad, m) beyond a joint limit that is rounding; times |q| where that is above 1."""
CONSISTENT = 1e-8
"""Largest closure error of an accepted start, in row units, and of its rates in those per time."""
SMALLER_STEPS = "See solution.crossings; try a smaller rtol or step."
"""Remedy for a passage that may have changed the branch."""

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
    on_kernel
        Whether the compiled kernel makes the run.
    held
        The forces that a sampled controller held; None without one.
    watch
        Looks for the events; None without any.
    """

    mechanism: Mechanism
    options: RunOptions
    system: OpenSystem | ClosedSystem
    norm: ErrorNorm
    state: FloatArray
    intervals: SmoothIntervals
    on_kernel: bool
    held: HeldForce | None
    watch: EventWatch | None


def run_segment(mechanism: Mechanism, options: RunOptions, result_type: type[Result]) -> Result:
    """A run without event actions.

    Parameters
    ----------
    options
        From :func:`checked_options`.
    result_type
        Class of the result.
    """
    problem = assemble_problem(mechanism, options)
    by = "kernel" if problem.on_kernel else "python"
    log_start(mechanism.name, options, problem.norm, by)
    record, counters, kernel_system = integrate_problem(problem)
    result = assemble_result(problem, record, counters, kernel_system, result_type)
    result.message += bifurcation_sentences(result)
    log_end(mechanism.name, result)
    return result


def finished(result: Outcome, options: RunOptions) -> Outcome:
    """``result``, unless it failed and the caller asked for an exception.

    Raises
    ------
    SimulationError
        With ``raise_on_failure``.
    """
    if options.raise_on_failure and not result.success:
        raise SimulationError(result.message, result)
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
    t0, t_end = checked_span(options.t0, options.t_end)
    if options.controller is not None and not callable(options.controller):
        raise InputError(
            f"controller = {options.controller!r} cannot be called",
            element="controller",
            remedy="Give a function of (t, q, v) that returns the generalised forces",
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


@per_start
def _units_of_states(mechanism: Mechanism) -> FloatArray:
    """The unit of each tangent component (2 nv,)."""
    units = mechanism.structure.units
    return np.concatenate([units.coordinate, units.coordinate * units.rate])


def absolute_tolerance(mechanism: Mechanism, atol: Any, rtol: float) -> FloatArray:
    """Absolute tolerance per tangent component (2 nv,)."""
    if atol is None:
        tolerance: FloatArray = rtol * _units_of_states(mechanism)
        return tolerance
    nv = mechanism.model.nv
    remedy = f"Give one positive number, {nv} (per coordinate) or {2 * nv} (positions, then rates)"
    array = checked_atol(atol, (nv, 2 * nv), remedy)
    if array.shape == (nv,):
        array = np.tile(array, 2)
    return np.broadcast_to(array, (2 * nv,)).copy()


def error_norm(mechanism: Mechanism, options: RunOptions) -> ErrorNorm:
    """The error norm with the tolerances of checked ``options``."""
    atol = absolute_tolerance(mechanism, options.atol, options.rtol)
    return ErrorNorm(atol, options.rtol, options.negligible)


def initial_state(
    mechanism: Mechanism, t0: float, q0: Any, v0: Any
) -> tuple[Mechanism, FloatArray]:
    """The mechanism with the requested start, and the state (q, v).

    Drives begin with the state at 0; a later start is one of the motion from there.
    """
    if q0 is not None or v0 is not None:
        start_at = mechanism.with_state if t0 == 0.0 else mechanism.moved
        mechanism = start_at(mechanism.q0 if q0 is None else q0, mechanism.v0 if v0 is None else v0)
    return mechanism, np.concatenate([mechanism.q0, mechanism.v0])


@per_start
def _accepted_times(mechanism: Mechanism) -> set[float]:
    """Times (s) at which the initial state satisfies closures and drives, as far as checked."""
    return set()


def check_consistent(mechanism: Mechanism, t: float = 0.0) -> None:
    """Refuse a start at ``t`` (s) that violates the closures, the drives or their rates.

    Raises
    ------
    InputError
        Naming the row that is violated most.
    """
    accepted = _accepted_times(mechanism)
    if t not in accepted:
        _check_errors(mechanism, t)
        accepted.add(t)


def _check_errors(mechanism: Mechanism, t: float) -> None:
    q0, v0 = mechanism.q0, mechanism.v0
    if t == 0.0:
        g, c = mechanism.initial_errors
    else:
        g, c = (e[0] for e in constraint_errors(mechanism, np.array([t]), q0[None], v0[None]))
    if not len(g):
        return
    units = mechanism.structure.units
    unit = constraint_units(mechanism, units)
    speed = max(units.rate, float(np.max(np.abs(v0) / units.coordinate)))
    for what, values, limit in (("q0", g, CONSISTENT), ("v0", c, CONSISTENT * speed)):
        errors = np.abs(values) / unit
        worst = int(np.argmax(errors))
        if errors[worst] > limit:
            kind = "drives" if worst >= len(g) - len(mechanism.drives) else "closures"
            raise InputError(
                f"the initial state violates the {kind}: row "
                f"{mechanism.structure.row_names[worst]} by {values[worst]:.1e}",
                element=what,
                remedy="Use srm.assemble(mechanism, q=..., v=...) to get a consistent q and v",
            )


# --- assemble the problem -------------------------------------------------------------------------


def assemble_problem(mechanism: Mechanism, options: RunOptions) -> Problem:
    """The problem of a run of ``mechanism``.

    Raises
    ------
    InputError
        If the start is inconsistent, a law does not cover the run, or the backend cannot make it.
    """
    t0, t_end, method = options.t0, options.t_end, options.method
    samples = checked_samples(options.sample_time, options.controller, t0, t_end)
    given = checked_breakpoints(options.breakpoints)
    times = np.concatenate([given, mechanism.breakpoints(t0, t_end)])
    intervals = smooth_intervals(times, samples, t0, t_end)
    check_avoidable(options.singular_times, intervals.ends, t_end - t0)
    on_kernel = uses_kernel(options.backend, method, options.placement, options.singular_times)
    mechanism, state = initial_state(mechanism, t0, options.q0, options.v0)
    norm = error_norm(mechanism, options)
    held = None if options.sample_time is None else HeldForce()
    system = make_system(mechanism, options.controller if held is None else held)
    mechanism.check_covers(t_end)
    if mechanism.constrained:
        check_consistent(mechanism, t0)
    watch = None
    if options.events is not None:

        def adapt(event: Callable[..., Any]) -> StateFunction:
            return lambda t, x: event(t, *system.split(x))

        watch = EventWatch(system, method.scheme, prepare_events(options.events, adapt), state.size)
    return Problem(mechanism, options, system, norm, state, intervals, on_kernel, held, watch)


def sampler(
    system: OpenSystem | ClosedSystem, held: HeldForce, controller: Controller, kernel_system: Any
) -> Callable[[float, FloatArray], None]:
    """A function (t, state) that samples ``controller`` for ``held`` and for the kernel."""

    def sample(t: float, state: FloatArray) -> None:
        force = evaluate_controller(controller, t, *system.split(state))
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
        control = PIControl(t_end, first_step(), scheme.controller_order or 1)
    else:
        control = FixedStep(options.t0, t_end, step)
    placement = options.placement if system.has_constraints else None
    times = options.singular_times
    control, wrappers = placed(control, scheme, placement, times, t_end, step, arrivals)
    if placement != "automatic":
        return control, wrappers
    guard = branch_guard(control, system, options.method)
    return guard, (*wrappers, guard)


# --- integrate ------------------------------------------------------------------------------------


def integrate_problem(problem: Problem) -> tuple[RunRecord, Counters, Any]:
    """The record of the run, its counters, and the kernel's system if there is one.

    Whatever happens on the way ends in the record: a start that cannot be evaluated, too.
    """
    kernel_system: Any = None
    try:
        with workspace(problem.system) if problem.on_kernel else nullcontext() as kernel_system:
            return *_integrate(problem, kernel_system), kernel_system
    except (EvaluationError, ControllerError) as error:
        return failed_start(problem.options.t0, problem.state, error, " s"), (), kernel_system


def _integrate(problem: Problem, kernel_system: Any) -> tuple[RunRecord, Counters]:
    system, options, state, norm = problem.system, problem.options, problem.state, problem.norm
    method, t0 = options.method, options.t0
    evaluator: Any = system if kernel_system is None else Evaluator(system, kernel_system)
    handler = BreakpointHandler(problem.intervals, system, method, norm, evaluator)
    if problem.held is not None:
        handler.sample = sampler(system, problem.held, options.controller, kernel_system)
        handler.sample(t0, state)
    memory = start(system, method, t0, state, norm, options.t_end, evaluator)
    if kernel_system is None:
        found = integrate_steps(system, options, norm, memory, state, problem.watch, handler)
        handler.done()
        return found
    check_embedded(method.scheme, options.step)
    run = CompiledRun(
        kernel_system,
        method,
        norm,
        memory,
        state,
        problem.intervals,
        t0=t0,
        step=options.step,
        first_step=chosen_first_step(evaluator, norm, options, memory, state)
        if options.step is None
        else 0.0,
        max_step=options.longest_step,
        placed=options.placement,
        arrivals=handler.arrivals,
    )
    with progress_of(options.progress, system, options.t_end) as tick:
        record = kernel_driver.integrate(
            system, run, tick=tick, events=problem.watch, passing=handler
        )
    handler.done()
    return record, (record,)


def integrate_steps(
    system: System,
    options: RunOptions,
    norm: ErrorNorm,
    memory: IntegratorState,
    state: FloatArray,
    watch: EventWatch | None,
    handler: BreakpointHandler | None = None,
    words: ProblemVocabulary = MECHANISM,
) -> tuple[RunRecord, Sequence[ControlWrapper]]:
    """The record of a run with the Python reference, and the wrappers of its control.

    The parameters are those of :func:`srm_mbs.integration.driver.integrate`.
    """
    control, wrappers = placed_control(
        system,
        options,
        lambda: chosen_first_step(system, norm, options, memory, state),
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
            words=words,
        )
    return record, wrappers


def chosen_first_step(
    evaluator: Any,
    norm: ErrorNorm,
    options: RunOptions,
    memory: IntegratorState,
    state: FloatArray,
) -> float:
    """The given first step (s), or the one that the start of the run allows."""
    if options.first_step is not None:
        return float(options.first_step)
    order = options.method.scheme.controller_order or 1
    span, t0 = options.t_end - options.t0, options.t0
    if isinstance(evaluator, Evaluator):
        return evaluator.first_step(state, memory, norm, span, order, t0)
    return initial_step(evaluator, state, memory, norm, span, order, t0)


def failed_start(t0: float, state: FloatArray, error: Exception, unit: str = "") -> RunRecord:
    """The record of a run that could not make its first step."""
    record = RunRecord(t0, state.copy())
    record.status = RunStatus.FAILED
    record.message = f"Stopped at t = {t0:.6g}{unit}: {error}."
    return record


# --- collect --------------------------------------------------------------------------------------


def statistics(
    system: OpenSystem | ClosedSystem | DaeSystem,
    record: RunRecord,
    data: StepData,
    counters: Counters,
) -> Statistics:
    """Counts of a run."""
    return Statistics(
        steps=data.count,
        rejected=sum(attempt.decision is StepDecision.REJECTED for attempt in record.attempts),
        placements=sum(counter.placed for counter in counters),
        replaced=sum(counter.replaced for counter in counters),
        zone_steps=len(data.zones),
        evaluations=system.evaluations,
        factorisations=system.factorisations,
        wall_time=record.wall_time,
    )


def settings(options: RunOptions, norm: ErrorNorm, controlled: bool, backend: str) -> Settings:
    """The settings of a run that was made with ``options``."""
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
    )


def assemble_result(
    problem: Problem,
    record: RunRecord,
    counters: Counters,
    kernel_system: Any,
    result_type: type[Result],
) -> Result:
    """Arrays, statistics and message of a run."""
    system, options, mechanism = problem.system, problem.options, problem.mechanism
    scheme = options.method.scheme
    data = record.data(scheme, system.tangent_size)
    dense: DenseOutput
    if isinstance(record, CompiledRecord):
        dense = CompiledDenseOutput(None if shared(system) else kernel_system, system, scheme, data)
    else:
        dense = DenseOutput(system, scheme, data)
    # Counted before anything below reads the dense output, which evaluates stages.
    stats = statistics(system, record, data, counters)
    controlled = options.controller is not None or system.has_user_forces
    by = "kernel" if problem.on_kernel else "python"
    return result_type(
        mechanism,
        system,
        scheme,
        data,
        dense=dense,
        t_eval=options.t_eval,
        attempts=attempt_array(record.attempts),
        events=None if problem.watch is None else problem.watch.found(),
        status=record.status,
        message=record.message
        + branch_changes(suspected(counters), "the velocity turned", SMALLER_STEPS)
        + method_messages(options.method, record.steps, problem.norm)
        + _limits_left(mechanism, dense)
        + _driven_too_far(mechanism, record),
        stats=stats,
        settings=settings(options, problem.norm, controlled, by),
    )


def _driven_too_far(mechanism: Mechanism, record: RunRecord) -> str:
    """A sentence on drives as a possible cause of a failure; empty without them."""
    if record.status is not RunStatus.FAILED or not mechanism.drives:
        return ""
    names = ", ".join(drive.name for drive in mechanism.drives)
    return f" A drive ({names}) may lead where the mechanism cannot follow."


def bifurcation_sentences(result: SimulationResult) -> str:
    """A sentence for each singular configuration that was reached without momentum."""
    found = result.bifurcations
    more = f" There were {len(found)} of them." if len(found) > DESCRIBED_BIFURCATIONS else ""
    return "".join(f" {bifurcation}." for bifurcation in found[:DESCRIBED_BIFURCATIONS]) + more


@per_model
def _limited_joints(mechanism: Mechanism) -> tuple[list[str], IndexArray, FloatArray]:
    """Names, indices in q (k,) and limits (2, k) of the one-degree joints that have limits."""
    model = mechanism.model
    names, indices, limits = [], [], []
    sprung = {force.joint for force in mechanism.forces if isinstance(force, LimitSpring)}
    for name in mechanism.joint_names:
        joint = mechanism.joint(name)
        if joint.nq == 1 and name not in sprung:
            low = float(model.lowerPositionLimit[joint.idx_q])
            high = float(model.upperPositionLimit[joint.idx_q])
            if low < high and (np.isfinite(low) or np.isfinite(high)):
                names.append(name)
                indices.append(joint.idx_q)
                limits.append((low, high))
    return names, np.array(indices, dtype=int), np.array(limits).reshape(-1, 2).T


def _limits_left(mechanism: Mechanism, dense: DenseOutput) -> str:
    """A sentence naming the one-degree joints that left their limits, which do not act."""
    names, indices, (low, high) = _limited_joints(mechanism)
    if not names:
        return ""
    q = dense.nodes()[1][:, indices]
    # The reductions themselves: their methods cost more than they do here.
    least, largest = np.minimum.reduce(q), np.maximum.reduce(q)
    beyond = np.maximum(low - least, largest - high)
    if not max(beyond.tolist()) > 0.0:
        return ""
    # A run that a terminal event ends at a limit has not left it.
    slack = LIMIT_ROUNDING * np.maximum(1.0, np.maximum(-least, largest))
    left = [names[k] for k in np.flatnonzero(beyond > slack)]
    return f" Joint limits do not act; these joints left theirs: {', '.join(left)}." if left else ""
