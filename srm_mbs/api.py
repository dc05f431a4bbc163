"""``simulate``: from a mechanism and options to a :class:`~srm_mbs.simulation.result.Solution`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from srm_mbs.dynamics.controllers import Controller, HeldForce
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.errors import ControllerError, EvaluationError, InputError, SimulationError
from srm_mbs.integration.breakpoints import BreakpointHandler, smooth_intervals
from srm_mbs.integration.control.step_size import ControlWrapper, initial_step
from srm_mbs.integration.driver import RunRecord, RunStatus, Tick, integrate
from srm_mbs.integration.events import acting
from srm_mbs.integration.kernel import driver
from srm_mbs.integration.kernel.backend import uses_kernel
from srm_mbs.integration.kernel.run import CompiledRun
from srm_mbs.integration.kernel.system import Evaluator, given_back, taken
from srm_mbs.integration.methods.base import NEGLIGIBLE, ErrorNorm, Method
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.psrm import PSRM
from srm_mbs.integration.singular_endpoints import start
from srm_mbs.model.mechanism import Mechanism
from srm_mbs.simulation.monitoring import log_end, log_start, progress_of
from srm_mbs.simulation.options import (
    check_avoidable,
    check_embedded,
    check_progress,
    checked_breakpoints,
    checked_placement,
    checked_rtol,
    checked_samples,
    checked_singular_times,
    checked_span,
    checked_times,
    loosest_rtol,
    positive,
    tightest_rtol,
)
from srm_mbs.simulation.result import Request, Settings, Solution
from srm_mbs.simulation.runner import (
    absolute_tolerance,
    assemble_result,
    bifurcation_sentences,
    check_consistent,
    check_mechanism,
    event_watch,
    initial_state,
    mechanism_method,
    placed_control,
    sampler,
)

_NO_OPTIONS = ("mechanism", "t_end")
"""Parameters of :func:`simulate` that are none of its options."""


def simulate(
    mechanism: Mechanism,
    t_end: float,
    *,
    t0: float = 0.0,
    q0: Any = None,
    v0: Any = None,
    method: str | Method = "psrm",
    tableau: str | ButcherTableau | None = None,
    rtol: float = 1e-6,
    atol: Any = None,
    step: float | None = None,
    first_step: float | None = None,
    max_step: float | None = None,
    t_eval: Any = None,
    events: Any = None,
    controller: Controller | None = None,
    sample_time: float | None = None,
    breakpoints: Any = (),
    placement: str = "automatic",
    singular_times: Any = (),
    progress: bool | Tick = False,
    backend: str = "auto",
    raise_on_failure: bool = False,
) -> Solution:
    """Simulate ``mechanism`` from ``t0`` to ``t_end`` (s).

    Parameters
    ----------
    mechanism
        From :func:`srm_mbs.load`, or built from a ``pin.Model``.
    t_end
        End of the run (s), after ``t0``.
    t0
        Start of the run (s).  Drives count from 0: ``q0`` and ``v0`` are then a state of the
        motion that they prescribe from the mechanism's own initial state.
    q0 : (nq,), v0 : (nv,)
        Initial state instead of the mechanism's own; must satisfy the closures.
    method
        ``"psrm"``, ``"srm"`` or a method object: :class:`srm_mbs.PSRM`, :class:`srm_mbs.SRM`.
    tableau
        Runge-Kutta scheme for a method given by name; by default ``"dop853"`` for psrm,
        ``"tvd32"`` for srm.
    rtol
        Relative tolerance: at most 1e-2 for the split PSRM with dop853, 1e-3 with another tableau,
        1e-4 for sweeps; at least 1e-12 with closures or drives (1e-11 with tvd32), 2.2e-14 without:
        below, rounding decides.  Others are replaced with a warning.
    atol
        Absolute tolerance: a number, (nv,) or (2 nv,).  By default rtol times the unit of each
        coordinate: 1 rad, the scene diagonal for lengths, and those times the mechanism's
        characteristic rate for velocities (:class:`srm_mbs.dynamics.scaling.Units`).
    step
        Fixed step (s) instead of step-size control.  A step is split where a stage would lie on
        a singular configuration; the run then returns to the grid.
    first_step, max_step
        First and longest step (s) of the step-size control.
    t_eval : (n,)
        Times (s) at which the solution is given; by default the ends of the steps.
    events
        A function (t, q, v) -> float or a list of them; an event is where it passes zero.  As in
        ``scipy.integrate.solve_ivp``, the attribute ``terminal`` of the function (a bool, or a
        number of occurrences) ends the run there with status ``event``, and ``direction`` (> 0
        or < 0) counts only zeros passed upwards or downwards.  Zeros at the start are no events.
        Located on the dense output (:mod:`srm_mbs.integration.events`).  The attribute ``action``
        changes the state or the mechanism there (:class:`srm_mbs.Event`).
    controller
        (t, q, v) -> generalised forces (nv,), N and N m, called at every stage; with
        ``sample_time`` at 0, T, 2 T, ... only, and what it returned is held in between.
    sample_time
        T (s) of a sampled controller.  Steps end on the samples.
    breakpoints : (k,)
        Times (s) at which a force jumps or has a kink, in any order; those outside the run are
        ignored.  Steps end there, and every scheme keeps its order; those of drives and tables
        of the mechanism are known.
    placement
        How steps are placed around singular configurations: ``"automatic"``, from sigma;
        ``"halved"``, the thesis' rule 2.4.1 (1): a step h that ends on one is replaced by h/2
        (h/4 where the tableau has inner stages) and then h; or ``"off"``.
    singular_times : (k,)
        Times (s) on which no stage or end of a step may lie, beside what ``placement`` does
        (thesis, 2.4.1 (2)); those outside the run are ignored.
    progress
        True for a progress bar (on a terminal only), or a callable (t, h, state).
    backend
        ``"python"``, the readable reference; ``"kernel"``, its compiled twin, which is many times
        faster and has the split PSRM with automatic placement or none; ``"auto"``, the kernel
        wherever it can be used (:func:`srm_mbs.backend`).
    raise_on_failure
        Raise :class:`SimulationError` instead of returning a partial solution.

    Returns
    -------
    Solution
        With ``success`` False and everything computed so far if the run could not go on, an
        event function that raises or returns no finite number included.

    Raises
    ------
    InputError
        For invalid input, before any stepping.
    SimulationError
        Only with ``raise_on_failure``.
    """
    if isinstance(events, Iterator):  # looked at more than once
        events = list(events)
    options = {name: value for name, value in locals().items() if name not in _NO_OPTIONS}
    check_mechanism(mechanism)
    t0, t_end = checked_span(t0, t_end)
    for value, what in ((step, "step"), (first_step, "first_step"), (max_step, "max_step")):
        if value is not None:
            positive(value, what, " of seconds")
    if controller is not None and not callable(controller):
        raise InputError(
            f"controller = {controller!r} cannot be called",
            element="controller",
            remedy="Give a function of (t, q, v) that returns the generalised forces",
        )
    check_progress(progress, "(t, h, state)")
    if acting(events):
        from srm_mbs.simulation.segmented_run import simulate_segments

        return simulate_segments(mechanism, t_end, dict(options, events=events))
    placement = checked_placement(placement)
    avoided = checked_singular_times(singular_times, t0, t_end)
    method = mechanism_method(method, tableau)
    rtol = checked_rtol(
        rtol, loosest_rtol(method), tightest_rtol(method.scheme, mechanism.constrained)
    )
    times = checked_times(t_eval, t0, t_end)
    samples = checked_samples(sample_time, controller, t0, t_end)
    kinks = np.concatenate([checked_breakpoints(breakpoints), mechanism.breakpoints(t0, t_end)])
    pieces = smooth_intervals(kinks, samples, t0, t_end)
    check_avoidable(avoided, pieces.ends, t_end - t0)
    on_kernel = uses_kernel(backend, method, placement, avoided)
    mechanism, state = initial_state(mechanism, t0, q0, v0)
    norm = ErrorNorm(
        absolute_tolerance(mechanism, atol, rtol), rtol, NEGLIGIBLE if step is None else 0.0
    )
    held = None if sample_time is None else HeldForce()
    system = make_system(mechanism, controller if held is None else held)
    mechanism.check_covers(t_end)
    if mechanism.constrained:
        mechanism.at_start(f"consistent at {t0!r}", lambda: check_consistent(mechanism, t0))

    by = "kernel" if on_kernel else "python"
    log_start(mechanism.name, t0, t_end, method, norm, step, by)
    watch = event_watch(events, system, method, state)
    wrappers: Sequence[ControlWrapper] = ()
    kernel_system: Any = None
    record: RunRecord
    try:
        if on_kernel:
            kernel_system = taken(system)
        evaluator = system if kernel_system is None else Evaluator(system, kernel_system)
        passing = BreakpointHandler(pieces, system, method, norm, evaluator)
        if held is not None and controller is not None:
            passing.sample = sampler(system, held, controller, kernel_system)
            passing.sample(t0, state)
        memory = start(system, method, t0, state, norm, t_end, evaluator)

        def chosen_first_step() -> float:
            if first_step is not None:
                return first_step
            order = method.scheme.controller_order or 1
            if isinstance(evaluator, Evaluator):
                return evaluator.first_step(state, memory, norm, t_end - t0, order, t0)
            return initial_step(system, state, memory, norm, t_end - t0, order, t0)

        longest = np.inf if max_step is None else max_step
        with progress_of(progress, system, t_end) as tick:
            if on_kernel and isinstance(method, PSRM):
                check_embedded(method.scheme, step)
                run = CompiledRun(
                    kernel_system,
                    method,
                    norm,
                    memory,
                    state,
                    pieces,
                    t0=t0,
                    step=step,
                    first_step=chosen_first_step() if step is None else 0.0,
                    max_step=longest,
                    placed=placement,
                    arrivals=passing.arrivals,
                )
                record = driver.integrate(system, run, tick=tick, events=watch, passing=passing)
            else:
                control, wrappers = placed_control(
                    system,
                    method,
                    step,
                    chosen_first_step,
                    (t0, t_end),
                    placement,
                    avoided,
                    arrivals=passing.arrivals,
                )
                record = integrate(
                    system,
                    method,
                    control,
                    norm,
                    memory,
                    state,
                    t0,
                    t_end,
                    max_step=longest,
                    tick=tick,
                    events=watch,
                    breakpoints=passing,
                )
        passing.done()
        if kernel_system is not None:
            given_back(system, kernel_system)
    except (EvaluationError, ControllerError) as error:
        record = RunRecord(t0, state.copy())
        record.status, record.message = RunStatus.FAILED, f"Stopped at t = {t0:.6g} s: {error}."
    settings = Settings(
        type(method).__name__,
        method.scheme.name,
        rtol,
        tuple(norm.atol.tolist()),
        step,
        controller is not None or system.calls_forces,
        placement,
        tuple(avoided.tolist()),
        by,
    )
    solution = assemble_result(
        mechanism, system, method, record, wrappers, watch, times, settings, norm, kernel_system
    )
    solution.request = Request.of(t_end, options)
    solution.message += bifurcation_sentences(solution)
    log_end(mechanism.name, solution)
    if raise_on_failure and not solution.success:
        raise SimulationError(solution.message, solution)
    return solution
