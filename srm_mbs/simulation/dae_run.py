"""``solve_dae``: index-2 DAEs with the methods and the stepping of mechanisms."""

from __future__ import annotations

from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.dae import DaeSystem
from srm_mbs.errors import ControllerError, EvaluationError, InputError, SimulationError
from srm_mbs.integration.control.prescribed_times import placed, suspected
from srm_mbs.integration.control.step_size import ControlWrapper, StepDecision, initial_step
from srm_mbs.integration.dense_output import step_data
from srm_mbs.integration.driver import DAE, RunRecord, RunStatus, Tick, integrate
from srm_mbs.integration.events import EventWatch, prepare_events
from srm_mbs.integration.messages import branch_changes, method_messages
from srm_mbs.integration.methods.base import NEGLIGIBLE, ErrorNorm, Method
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.thesis.dae_stability import instability
from srm_mbs.integration.methods.thesis.sweep import SweepNode, carried_multipliers, sweep_nodes
from srm_mbs.integration.methods.thesis.sweep_branch_guard import branch_guard
from srm_mbs.model.dae import SemiExplicitDAE
from srm_mbs.simulation.dae_result import DaeSolution
from srm_mbs.simulation.monitoring import log_end, log_start, progress_of
from srm_mbs.simulation.options import (
    check_progress,
    checked_atol,
    checked_method,
    checked_placement,
    checked_rtol,
    checked_singular_times,
    checked_times,
    numbers,
    positive,
    step_size_control,
)
from srm_mbs.simulation.result import Settings, Statistics, attempt_array

CONSISTENT = 1e-8
"""Largest constraint error of an accepted start, as a relative error of x0."""
MENDED = (
    'Try a smaller rtol or step, restarted sweeps with T = "inverse" (restart=True, carry=True), '
    "or PSRM in its split form."
)
"""What to do about a passage that may have changed the branch."""
CARRIED = (
    'Use T = "inverse", which carries B y (SRM: with restart=True, carry=True), or PSRM in its '
    "split form."
)
"""The same for sweeps that carry y, for which no shorter step does."""
UNSTABLE = (
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
        raise InputError(f"t_span = {t_span!r} is not an interval", element="t_span", remedy=remedy)
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


def _check_start(system: DaeSystem, method: Method, t0: float, x0: FloatArray) -> None:
    gap = system.constraint_residual(t0, x0)
    if not gap <= CONSISTENT:
        raise InputError(
            f"x0 violates g(t0, x0) = 0 by {gap:.1e} (relative error of x)",
            element="x0",
            remedy="Move x0 onto the constraints",
        )
    if not system.predicts and getattr(method, "prediction", "") == "exact":
        raise InputError(
            "g depends on t, and its derivative is not given",
            element="g_t",
            remedy='Give g_t, or use SRM or PSRM(prediction="simple"), which do not need it',
        )


def solve_dae(
    problem: SemiExplicitDAE,
    t_span: tuple[float, float],
    x0: Any,
    *,
    method: str | Method = "psrm",
    tableau: str | ButcherTableau | None = None,
    rtol: float = 1e-6,
    atol: Any = None,
    step: float | None = None,
    first_step: float | None = None,
    max_step: float | None = None,
    t_eval: Any = None,
    events: Any = None,
    placement: str = "automatic",
    singular_times: Any = (),
    progress: bool | Tick = False,
    raise_on_failure: bool = False,
) -> DaeSolution:
    """Solve x' = f(t, x) - B(t, x) y, 0 = g(t, x) over ``t_span``.

    The driver, the step-size control and the placement around isolated singularities of G B are
    those of :func:`srm_mbs.simulate`.

    Parameters
    ----------
    problem
        The equations.
    t_span : (t0, t1)
        Start and end.
    x0 : (nx,)
        Initial state, with g(t0, x0) = 0.
    method
        ``"psrm"`` (split), ``"srm"`` or a method object.  The T of its sweeps is I, (GB)^T, or
        (GB)^-1; the last one carries B y, form (2.4) of the thesis.  Isolated singularities of
        G B are passed by the split form, and by sweeps with T = (GB)^-1: restarted ones with
        ``carry`` at a tolerance of 1e-4 with errors below 2e-4, at 1e-6 below 2e-6
        (``tests/test_dae.py``); without it they turn off.  Sweeps with own histories, whose first
        one is off the constraints by O(eps), would leave on another branch of g = 0; next to the
        singularity they are restarted, and the message says when.  Sweeps that carry y, which is
        not bounded there, would leave on another branch, however small the step: x' is compared
        across every passage, and a run with sweeps that took another branch fails there, with a
        message that names the remedy.
    tableau
        Runge-Kutta scheme for a method given by name.
    rtol
        Relative tolerance, at most 1e-4.
    atol
        Absolute tolerance, a number or (nx,); rtol by default, for states of order one.
    step
        Fixed step instead of step-size control.
    first_step, max_step
        First and longest step of the step-size control.
    t_eval : (n,)
        Times at which the solution is given; by default the ends of the steps.
    events
        A function (t, x) -> float or a list of them; an event is where it passes zero.  As in
        ``scipy.integrate.solve_ivp``, the attribute ``terminal`` of the function (a bool, or a
        number of occurrences) ends the run there with status ``event``, and ``direction`` (> 0
        or < 0) counts only zeros passed upwards or downwards
        (:mod:`srm_mbs.integration.events`).
    placement
        How steps are placed around singular points of G B: ``"automatic"``, ``"halved"`` (thesis,
        2.4.1 (1)) or ``"off"``; as in :func:`srm_mbs.simulate`.
    singular_times : (k,)
        Times on which no stage or end of a step may lie (thesis, 2.4.1 (2)).
    progress
        True for a progress bar (on a terminal only), or a callable (t, h, x).
    raise_on_failure
        Raise :class:`SimulationError` instead of returning a partial solution.

    Returns
    -------
    DaeSolution
        With ``success`` False and everything computed so far if the run could not go on: a
        function of the problem that raises, or returns what is not finite, included.

    Raises
    ------
    InputError
        For invalid input, before any stepping.
    SimulationError
        Only with ``raise_on_failure``.
    """
    if not isinstance(problem, SemiExplicitDAE):
        raise InputError(
            f"{problem!r} is not a DAE",
            element="problem",
            remedy="Give srm.SemiExplicitDAE(f=..., B=..., g=..., G=...)",
        )
    t0, t_end = _interval(t_span)
    for value, what in ((step, "step"), (first_step, "first_step"), (max_step, "max_step")):
        if value is not None:
            positive(value, what)
    method = checked_method(method, tableau)
    rtol = checked_rtol(rtol)
    times = checked_times(t_eval, t0, t_end)
    placement = checked_placement(placement)
    avoided = checked_singular_times(singular_times, t0, t_end)
    state = _start(x0)
    norm = ErrorNorm(
        _absolute_tolerance(atol, rtol, state.size), rtol, NEGLIGIBLE if step is None else 0.0
    )
    check_progress(progress, "(t, h, x)")
    system = DaeSystem(problem, t0, state, t_end, getattr(method, "T", "identity"))
    _check_start(system, method, t0, state)

    log_start("DAE", t0, t_end, method, norm, step, "python")
    watch: EventWatch | None = None
    if events is not None:
        prepared = prepare_events(events, lambda event: event)
        watch = EventWatch(system, method.scheme, prepared, state.size)
    wrappers: tuple[ControlWrapper, ...] = ()
    begun: tuple[SweepNode, ...] = ()
    with_sweeps = False
    try:
        memory = method.start(system, t0, state, norm)
        if memory.sigma < SINGULAR_START:
            raise InputError(
                f"G B is singular at the start, or almost (sigma = {memory.sigma:.1e})",
                element="x0",
                remedy="Start beside that point",
            )
        begun = sweep_nodes(memory)
        with_sweeps = bool(begun)

        def chosen_first_step() -> float:
            if first_step is not None:
                return first_step
            order = method.scheme.controller_order or 1
            return initial_step(system, state, memory, norm, t_end - t0, order, t0)

        control = step_size_control(method.scheme, t0, t_end, step, chosen_first_step)
        control, wrappers = placed(control, method.scheme, placement, avoided, t_end, step)
        if placement == "automatic":
            guard = branch_guard(control, system, method)
            control, wrappers = guard, (*wrappers, guard)
        with progress_of(progress, system, t_end) as tick:
            record = integrate(
                system,
                method,
                control,
                norm,
                memory,
                state,
                t0,
                t_end,
                max_step=np.inf if max_step is None else max_step,
                tick=tick,
                events=watch,
                words=DAE,
            )
    except (EvaluationError, ControllerError) as error:
        record = RunRecord(t0, state.copy())
        record.status, record.message = RunStatus.FAILED, f"Stopped at t = {t0:.6g}: {error}."
    carried = carried_multipliers(begun, record.steps)
    turned = suspected(wrappers)
    unstable = ""
    if record.status is RunStatus.FAILED and with_sweeps and not system.carries_yhat:
        eps = getattr(method, "regularisation", None)
        unstable = instability(system, method.scheme, record, begun, eps)
    if unstable:
        if turned:  # that they turned follows from it
            end = record.times[-1] if record.times else t0
            record.message = f"Stopped at t = {end:.6g}: x' turned. Everything up to there is kept."
        record.message += unstable
    elif with_sweeps and turned:
        if record.status is not RunStatus.FAILED:  # within the passage
            record.status = RunStatus.FAILED
            record.message = f"On another branch of g = 0 from t = {turned[0]:.6g} on."
        record.message += " " + (MENDED if system.carries_yhat else CARRIED)
    elif record.status is RunStatus.FAILED and with_sweeps and not system.carries_yhat:
        record.message += UNSTABLE
    data = step_data(
        t0, state, record.times, record.steps, method.scheme, system.tangent_size, record.stop
    )
    stats = Statistics(
        steps=data.count,
        rejected=sum(a.verdict is StepDecision.REJECTED for a in record.attempts),
        placements=sum(wrapper.placed for wrapper in wrappers),
        replaced=sum(wrapper.replaced for wrapper in wrappers),
        zone_steps=len(data.zones),
        evaluations=system.evaluations,
        factorisations=system.factorisations,
        wall_time=record.wall_time,
    )
    solution = DaeSolution(
        system,
        method,
        data,
        carried,
        t_eval=times,
        attempts=attempt_array(record.attempts),
        settings=Settings(
            type(method).__name__,
            method.scheme.name,
            rtol,
            tuple(norm.atol.tolist()),
            step,
            False,
            placement,
            tuple(avoided.tolist()),
        ),
        events=None if watch is None else watch.found(),
        status=record.status,
        message=record.message
        + ("" if with_sweeps else branch_changes(turned, "x' turned", MENDED))
        + method_messages(method, record.steps, norm),
        stats=stats,
    )
    log_end("DAE", solution)
    if raise_on_failure and not solution.success:
        raise SimulationError(solution.message, solution)
    return solution
