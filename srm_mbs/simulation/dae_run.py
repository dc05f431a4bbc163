"""Runs of semi-explicit index-2 DAEs, with the methods and the stepping of mechanisms."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.dae import JACOBIAN_REMEDY, TIME_DERIVATIVE_REMEDY, DaeSystem
from srm_mbs.dynamics.system import onto_closures
from srm_mbs.errors import (
    CallbackError,
    ControllerError,
    EvaluationError,
    InputError,
    safe_repr,
    time_text,
)
from srm_mbs.integration.control.prescribed_times import suspected
from srm_mbs.integration.control.step_size import ControlWrapper
from srm_mbs.integration.driver import RunRecord, RunStatus
from srm_mbs.integration.events import EventWatch, prepare_events
from srm_mbs.integration.messages import DAE, branch_changes, stiffness_sentence
from srm_mbs.integration.methods.base import ErrorNorm, Method, method_messages
from srm_mbs.integration.methods.near_singular import WATCHED_SIGMA
from srm_mbs.integration.methods.psrm import is_split
from srm_mbs.integration.methods.thesis.dae_stability import instability
from srm_mbs.integration.methods.thesis.sweep import SweepNode, carried_multipliers, sweep_nodes
from srm_mbs.model.dae import SemiExplicitDAE
from srm_mbs.simulation.consistency import LARGEST_MOVE, Motion
from srm_mbs.simulation.dae_result import DaeResult
from srm_mbs.simulation.monitoring import log_end, log_start
from srm_mbs.simulation.options import (
    LOOSEST_RTOL,
    TIGHTEST_RTOL,
    RunOptions,
    checked_atol,
    checked_method,
    numbers,
)
from srm_mbs.simulation.result import attempt_array
from srm_mbs.simulation.runner import (
    failed_start,
    finished,
    integrate_steps,
    raise_at_first_call,
    settings,
    statistics,
)

Result = TypeVar("Result", bound=DaeResult)

CONSISTENT = 1e-8
"""Constraint error of a start, as a relative error of x0, up to which it stays as it is."""
LISTED_STATES = 8
"""States that a message lists at most."""
DECAY_REMEDY = "If it is the states that are small, give an atol of rtol times their size there."
"""What to do where states have become so small that they seem next to a singular point."""
PACE_REMEDY = "A larger rtol, or a right-hand side that changes less abruptly, allows longer ones."
"""What may shorten a run that was interrupted."""
TURN_REMEDY = (
    'Try a smaller rtol or step, restarted sweeps with T = "inverse" (restart=True, carry=True), '
    "or PSRM in its split form."
)
"""What to do about a passage that may have changed the branch."""
CARRIED_Y_REMEDY = (
    'Use T = "inverse", which carries B y (SRM: with restart=True, carry=True), or PSRM in its '
    "split form."
)
"""The same for sweeps that carry y, for which no shorter step does."""
INSTABILITY_REMEDY = (
    " Sweeps with T = I or (GB)^T are stable only while h |G B T|/eps is about 1 or less: try "
    'T = "inverse", or a larger eps.'
)
"""Added to the message of such a run that cannot go on."""
SINGULAR_START = 1e-5
"""sigma below which a start is refused: round-off in x, over sigma, is an error of x'."""


def _interval(t_span: Any) -> tuple[float, float]:
    remedy = "Give (t0, t1) with t0 < t1"
    ends = numbers(t_span, "t_span", remedy)
    if ends.shape != (2,) or not ends[0] < ends[1]:
        raise InputError(
            f"t_span = {safe_repr(t_span)} is not an interval", element="t_span", remedy=remedy
        )
    return float(ends[0]), float(ends[1])


def _start(x0: Any) -> FloatArray:
    remedy = "Give a vector of finite numbers"
    state = numbers(x0, "x0", remedy)
    if state.ndim != 1 or state.size == 0:
        raise InputError(f"x0 has shape {state.shape}", element="x0", remedy=remedy)
    return state


def _absolute_tolerance(atol: Any, rtol: float, nx: int) -> FloatArray:
    if atol is None:
        return np.full(nx, rtol)
    array = checked_atol(atol, (nx,), f"Give one positive number or {nx}")
    return np.broadcast_to(array, (nx,)).copy()


def _closed_start(system: DaeSystem, t0: float, x0: FloatArray, norm: ErrorNorm) -> FloatArray:
    """``x0`` (nx,) on the constraints, as :func:`~srm_mbs.simulation.consistency.closed_start`."""
    gap = system.constraint_residual(t0, x0)
    if gap <= CONSISTENT:
        return x0
    also, remedy = "", "Move x0 onto the constraints"
    with suppress(EvaluationError):
        closed = onto_closures(system, t0, x0)
        motion = Motion.of(system, t0, x0, closed, norm)
        if motion.size > LARGEST_MOVE:
            also = f"; the way to it is {motion.size_text}"
            if len(closed) <= LISTED_STATES and not motion.is_near_singular:
                remedy += f": {closed.tolist()} is on them"
        elif not motion.is_open:
            return closed
    raise InputError(
        f"x0 violates g(t0, x0) = 0 by {gap:.1e} (relative error of x){also}",
        element="x0",
        remedy=remedy,
    )


def _check_prediction(system: DaeSystem, method: Method) -> None:
    if not system.predicts and getattr(method, "prediction", "") == "exact":
        raise InputError(
            "g depends on t, and its derivative is not given",
            element="g_t",
            remedy='Give g_t, or use SRM or PSRM(prediction="simple"), which do not need it',
        )


def run_dae(
    problem: SemiExplicitDAE,
    t_span: tuple[float, float],
    x0: Any,
    options: RunOptions,
    result_type: type[Result],
) -> Result:
    """Solve x' = f(t, x) - B(t, x) y, 0 = g(t, x); see :func:`srm_mbs.solve_dae`.

    Parameters
    ----------
    options
        As the caller gave them.
    result_type
        Class of the result.

    Raises
    ------
    InputError
        For invalid input, before any stepping.
    SimulationError
        Only with ``raise_on_failure``.
    EventError
        If an event function fails where it is called first.
    """
    if not isinstance(problem, SemiExplicitDAE):
        raise InputError(
            f"{safe_repr(problem)} is not a DAE",
            element="problem",
            remedy="Give srm.SemiExplicitDAE(f=..., B=..., g=..., G=...)",
        )
    span, method = _interval(t_span), checked_method(options.method, options.tableau)
    rtol_range = float(TIGHTEST_RTOL), LOOSEST_RTOL
    options = options.checked(method, rtol_range, span, unit="", arguments="(t, h, x)")
    state, t0 = _start(x0), options.t0
    tolerance = _absolute_tolerance(options.atol, options.rtol, state.size)
    norm = ErrorNorm(tolerance, options.rtol, options.negligible)
    T = getattr(method, "T", "identity")
    system = DaeSystem(problem, t0, state, options.t_end, norm.one, T)
    closed = _closed_start(system, t0, state, norm)
    if closed is not state:
        state = closed
        system = DaeSystem(problem, t0, state, options.t_end, norm.one, T)
    _check_prediction(system, method)
    log_start("DAE", options, norm, "python")
    watch = None
    if options.events is not None:
        prepared = prepare_events(options.events, lambda event: event, unit="")
        watch = EventWatch(method.scheme, prepared, state.size)
    record, wrappers, first_sweeps = _integrate(system, options, norm, state, watch)
    raise_at_first_call(record.error, t0)
    adaptive = options.step is None
    if record.status is RunStatus.INTERRUPTED:
        record.add_pace(options.t_end, PACE_REMEDY)
    _check_derivatives(system, record)
    if adaptive and is_split(method):
        _check_end(system, record, norm)
    turned = suspected(wrappers)
    if first_sweeps:
        _add_sweep_failure(system, options, record, first_sweeps, turned)
    else:
        record.message += branch_changes(turned, "x' turned", TURN_REMEDY, "")
    data = record.data(method.scheme, system.tangent_size)
    stiff = data.stiff_intervals
    result = result_type(
        system,
        method,
        data,
        carried_multipliers(first_sweeps, record.steps),
        t_eval=options.t_eval,
        attempts=attempt_array(record.attempts),
        settings=settings(options, norm, False, "python", stiff),
        events=None if watch is None else watch.found(),
        status=record.status,
        message=record.message
        + method_messages(method, record.steps, norm)
        + stiffness_sentence(stiff, method.scheme, adaptive, ""),
        stats=statistics(
            record,
            data.count,
            len(data.zones),
            wrappers,
            (system.evaluations, system.factorisations),
        ),
    )
    result.error = record.error
    log_end("DAE", result)
    return finished(result, options)


def _integrate(
    system: DaeSystem,
    options: RunOptions,
    norm: ErrorNorm,
    state: FloatArray,
    watch: EventWatch | None,
) -> tuple[RunRecord, Sequence[ControlWrapper], tuple[SweepNode, ...]]:
    """The record of the run, the wrappers of its control, and the sweeps at its start.

    A start that cannot be evaluated ends in the record.
    """
    wrappers: Sequence[ControlWrapper] = ()
    first_sweeps: tuple[SweepNode, ...] = ()
    try:
        memory = options.method.start(system, options.t0, state, norm)
        if memory.sigma < SINGULAR_START:
            raise InputError(
                f"G B is singular at the start, or almost (sigma = {memory.sigma:.1e})",
                element="x0",
                remedy="Start beside that point, or, where states are small or of different sizes, "
                "give an atol of rtol times the usual size of each",
            )
        first_sweeps = sweep_nodes(memory)
        record, wrappers = integrate_steps(system, options, norm, memory, state, watch, words=DAE)
    except (EvaluationError, ControllerError) as error:
        record = failed_start(options.t0, state, error)
    return record, wrappers, first_sweeps


def _check_derivatives(system: DaeSystem, record: RunRecord) -> None:
    """Mark and explain in the record that G or g_t is not the derivative of g where the run ended:
    at the start, where they are checked too, wrong ones may have the values of the right ones."""
    if not record.times:
        return
    t, x = record.times[-1], record.last_state
    try:
        wrong, remedy = system.wrong_jacobian(t, x), JACOBIAN_REMEDY
        if wrong is None:
            wrong = system.wrong_time_derivative(t, x, t - record.t0, (-1, 1))
            remedy = TIME_DERIVATIVE_REMEDY
    except (CallbackError, EvaluationError):
        return
    if wrong is not None:
        record.status = RunStatus.FAILED
        record.message = f"The results are wrong: at t = {time_text(t)}, {wrong}. {remedy}."


def _check_end(system: DaeSystem, record: RunRecord, norm: ErrorNorm) -> None:
    """Say in the record that the run ended so close to a singular point that g, which holds to
    rounding, leaves x open by more than the tolerance."""
    if not record.steps or record.steps[-1].sigmas[-1] > WATCHED_SIGMA:
        return
    t, x = record.times[-1], record.last_state
    try:
        terms = system.evaluate(t, x)
        off = norm(terms.correction(), norm.weights(system.state_scale(x)))
    except (CallbackError, EvaluationError):
        return
    if off > 1.0:
        record.message += (
            f" At t = {time_text(t)}, where G B is almost singular (sigma = {terms.sigma:.1e}), "
            f"the constraints hold to {off:.1g} times the tolerance in x only. {DECAY_REMEDY}"
        )


def _add_sweep_failure(
    system: DaeSystem,
    options: RunOptions,
    record: RunRecord,
    first_sweeps: Sequence[SweepNode],
    turned: Sequence[float],
) -> None:
    """Mark and explain in the record that sweeps were unstable, or took another branch of g = 0."""
    unstable = None
    carries_y = not system.carries_yhat
    if record.status is RunStatus.FAILED and carries_y:
        eps = getattr(options.method, "regularisation", None)
        unstable = instability(system, options.method.scheme, record, first_sweeps, eps)
    if unstable is not None:
        if turned:  # that they turned follows from it
            end = record.times[-1] if record.times else options.t0
            record.message = (
                f"Stopped at t = {time_text(end)}: x' turned. Everything up to there is kept."
            )
        record.stop_reason = unstable.reason
        record.message += f" {unstable.sentence}"
    elif turned:
        if record.status is not RunStatus.FAILED:  # within the passage
            record.status = RunStatus.FAILED
            record.message = f"On another branch of g = 0 from t = {time_text(turned[0])} on."
        record.message += " " + (CARRIED_Y_REMEDY if carries_y else TURN_REMEDY)
    elif record.status is RunStatus.FAILED and carries_y:
        record.message += INSTABILITY_REMEDY
