"""``simulate``: from a mechanism and options to a :class:`~srm_mbs.solution.Solution`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from srm_mbs import kernel
from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.errors import (
    ControllerError,
    EvaluationError,
    InputError,
    SimulationError,
)
from srm_mbs.forces import LimitSpring
from srm_mbs.mechanism import Mechanism
from srm_mbs.methods.base import NEGLIGIBLE, ErrorNorm, Method
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.methods.psrm import PSRM
from srm_mbs.options import (
    check_avoidable,
    check_embedded,
    checked_breakpoints,
    checked_method,
    checked_placement,
    checked_rtol,
    checked_samples,
    checked_singular_times,
    checked_span,
    checked_times,
    loosest_rtol,
    numbers,
    positive,
    step_size_control,
)
from srm_mbs.progress import progress_of
from srm_mbs.records import ATTEMPT, Settings, Statistics
from srm_mbs.solution import Solution
from srm_mbs.stepping.breakpoints import Passing, pieces_between
from srm_mbs.stepping.dense import DenseOutput
from srm_mbs.stepping.events import EventWatch, StateFunction, acting, prepare_events
from srm_mbs.stepping.guard import BranchGuard
from srm_mbs.stepping.loop import RunRecord, Tick, integrate
from srm_mbs.stepping.remarks import drift, restarts, turns
from srm_mbs.stepping.singular_times import Placing, placed, suspected
from srm_mbs.stepping.starting import start
from srm_mbs.stepping.stepsize import (
    StepSizeControl,
    Verdict,
    initial_step,
)
from srm_mbs.systems.controllers import Controller, called
from srm_mbs.systems.driven import constraint_errors
from srm_mbs.systems.held import HeldForce
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem, make_system
from srm_mbs.systems.units import constraint_units

log = logging.getLogger(__name__)

MENDED = "See solution.crossings; try a smaller rtol or step."
"""What to do about a passage that may have changed the branch."""
CONSISTENT = 1e-8
"""Largest closure error of an accepted start, in row units, and of its rates in those per time."""
TOLD = 2
"""Bifurcations that the message of a run describes."""
BACKENDS = ("auto", "python", "kernel")
ROUND_OFF = 1e-12
"""Distance (rad, m) behind a joint limit that is rounding; times |q| where that is above 1."""


_NO_OPTIONS = ("mechanism", "t_end")
"""Parameters of :func:`simulate` that are none of its options."""


def absolute_tolerance(mechanism: Mechanism, atol: Any, rtol: float) -> FloatArray:
    """Absolute tolerance per tangent component (2 nv,)."""
    nv = mechanism.model.nv
    units = mechanism.structure.units
    if atol is None:
        return rtol * np.concatenate([units.coordinate, units.coordinate * units.rate])
    remedy = f"Give one positive number, {nv} (per coordinate) or {2 * nv} (positions, then rates)"
    array = numbers(atol, "atol", remedy)
    if array.shape not in ((), (nv,), (2 * nv,)) or not (array > 0.0).all():
        raise InputError(
            f"atol has shape {array.shape} or is not positive", element="atol", remedy=remedy
        )
    if array.shape == (nv,):
        array = np.tile(array, 2)
    return np.broadcast_to(array, (2 * nv,)).copy()


def mechanism_method(method: str | Method, tableau: str | ButcherTableau | None) -> Method:
    checked = checked_method(method, tableau)
    if getattr(checked, "T", "identity") != "identity":
        raise InputError(
            "T is given, but the sweeps of mechanisms (2.6) have no such matrix",
            element="method",
            remedy="Leave T out; it is for srm.solve_dae",
        )
    return checked


def _event_watch(
    events: Any, system: OpenSystem | ClosedSystem, method: Method, state: FloatArray
) -> EventWatch | None:
    """What looks for the events (t, q, v) -> float; None if none are given."""
    if events is None:
        return None

    def adapt(event: Callable[..., Any]) -> StateFunction:
        return lambda t, x: event(t, *system.split(x))

    return EventWatch(system, method.scheme, prepare_events(events, adapt), state.size)


def _initial_state(
    mechanism: Mechanism, t0: float, q0: Any, v0: Any
) -> tuple[Mechanism, FloatArray]:
    """The mechanism with the requested start, and the state (q, v).

    Drives begin with the state at 0; a later start is one of the motion from there.
    """
    if q0 is not None or v0 is not None:
        start_at = mechanism.with_state if t0 == 0.0 else mechanism.moved
        mechanism = start_at(mechanism.q0 if q0 is None else q0, mechanism.v0 if v0 is None else v0)
    return mechanism, np.concatenate([mechanism.q0, mechanism.v0])


def check_consistent(mechanism: Mechanism, t: float = 0.0) -> bool:
    """Refuse a start at ``t`` (s) that violates the closures, the drives or their rates; True for
    any other."""
    q0, v0 = mechanism.q0, mechanism.v0
    if t == 0.0:
        g, c = mechanism.initial_errors
    else:
        g, c = (e[0] for e in constraint_errors(mechanism, np.array([t]), q0[None], v0[None]))
    if not len(g):
        return True
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
    return True


def _sampler(
    system: OpenSystem | ClosedSystem, held: HeldForce, controller: Controller, twin: Any
) -> Callable[[float, FloatArray], None]:
    """What samples ``controller`` at (t, state), for ``held`` and for the kernel."""

    def sample(t: float, state: FloatArray) -> None:
        force = called(controller, t, *system.split(state))
        held.hold(t, force)
        if twin is not None:
            twin.hold(t, force, True)

    return sample


def placed_control(
    system: OpenSystem | ClosedSystem,
    method: Method,
    step: float | None,
    first_step: Callable[[], float],
    span: tuple[float, float],
    placement: str,
    singular_times: FloatArray,
) -> tuple[StepSizeControl, Sequence[Placing]]:
    """The step-size control of a run, and the wrappers in it that count what they did."""
    scheme = method.scheme
    t0, t_end = span
    control = step_size_control(scheme, t0, t_end, step, first_step)
    control, wrappers = placed(
        control, scheme, placement if system.has_constraints else None, singular_times, t_end, step
    )
    if system.has_constraints and placement == "automatic":
        guard = BranchGuard(control, system)
        return guard, (*wrappers, guard)
    return control, wrappers


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
        1e-4 for sweeps; looser values are replaced with a warning.
    atol
        Absolute tolerance: a number, (nv,) or (2 nv,).  By default rtol times the unit of each
        coordinate: 1 rad, the scene diagonal for lengths, and those times the mechanism's
        characteristic rate for velocities (:class:`srm_mbs.systems.units.Units`).
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
        Located on the dense output (:mod:`srm_mbs.stepping.events`).  The attribute ``action``
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
    options = {name: value for name, value in locals().items() if name not in _NO_OPTIONS}
    if not isinstance(mechanism, Mechanism):
        raise InputError(
            f"{mechanism!r} is not a mechanism",
            element="mechanism",
            remedy="Give srm.load(...) or srm.Mechanism(...)",
        )
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
    if backend not in BACKENDS:
        raise InputError(
            f"there is no backend {backend!r}",
            element="backend",
            remedy=f"Give one of {', '.join(BACKENDS)}",
        )
    if acting(events):
        from srm_mbs.segments import simulate_segments

        return simulate_segments(mechanism, t_end, dict(options, events=events))
    placement = checked_placement(placement)
    avoided = checked_singular_times(singular_times, t0, t_end)
    method = mechanism_method(method, tableau)
    rtol = checked_rtol(rtol, loosest_rtol(method))
    times = checked_times(t_eval, t0, t_end)
    samples = checked_samples(sample_time, controller, t0, t_end)
    kinks = np.concatenate([checked_breakpoints(breakpoints), mechanism.breakpoints(t0, t_end)])
    pieces = pieces_between(kinks, samples, t0, t_end)
    check_avoidable(avoided, pieces.ends, t_end - t0)
    on_kernel = uses_kernel(backend, method, placement, avoided)
    mechanism, state = _initial_state(mechanism, t0, q0, v0)
    norm = ErrorNorm(
        absolute_tolerance(mechanism, atol, rtol), rtol, NEGLIGIBLE if step is None else 0.0
    )
    held = None if sample_time is None else HeldForce()
    system = make_system(mechanism, controller if held is None else held)
    mechanism.check_covers(t_end)
    if mechanism.constrained:
        mechanism.at_start(f"consistent at {t0!r}", lambda: check_consistent(mechanism, t0))

    watch = _event_watch(events, system, method, state)
    wrappers: Sequence[Placing] = ()
    twin: Any = None
    record: RunRecord
    try:
        if on_kernel:
            twin = kernel.compiled(system)
        evaluator = system if twin is None else kernel.Evaluator(system, twin)
        passing = Passing(pieces, system, method, norm, evaluator)
        if held is not None and controller is not None:
            passing.sample = _sampler(system, held, controller, twin)
            passing.sample(t0, state)
        memory = start(system, method, t0, state, norm, t_end, evaluator)

        def chosen_first_step() -> float:
            if first_step is not None:
                return first_step
            order = method.scheme.controller_order or 1
            return initial_step(evaluator, state, memory, norm, t_end - t0, order, t0)

        longest = np.inf if max_step is None else max_step
        with progress_of(progress, system, t_end) as tick:
            if on_kernel and isinstance(method, PSRM):
                check_embedded(method.scheme, step)
                run = kernel.CompiledRun(
                    twin,
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
                )
                record = kernel.integrate(system, run, tick=tick, events=watch, passing=passing)
            else:
                control, wrappers = placed_control(
                    system, method, step, chosen_first_step, (t0, t_end), placement, avoided
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
    except (EvaluationError, ControllerError) as error:
        record = RunRecord(t0, state.copy())
        record.status, record.message = "failed", f"Stopped at t = {t0:.6g} s: {error}."
    settings = Settings(
        type(method).__name__,
        method.scheme.name,
        rtol,
        tuple(norm.atol.tolist()),
        step,
        controller is not None or system.calls_forces,
        placement,
        tuple(avoided.tolist()),
        "kernel" if on_kernel else "python",
    )
    solution = _collect(
        mechanism, system, method, record, wrappers, watch, times, settings, norm, twin
    )
    solution.message += _bifurcations(solution)
    if raise_on_failure and not solution.success:
        raise SimulationError(solution.message, solution)
    return solution


def uses_kernel(backend: str, method: Method, placement: str, singular_times: FloatArray) -> bool:
    """Whether a run is made by the compiled kernel.

    Raises
    ------
    InputError
        If ``backend`` asks for it and it cannot.
    """
    if backend == "python" or (backend == "auto" and kernel.backend() == "python"):
        return False
    reason = kernel.obstacle(method, placement, singular_times)
    if backend == "kernel" and reason:
        raise InputError(
            f"the compiled kernel cannot make this run: {reason}",
            element="backend",
            remedy='Use backend="auto", which takes the Python reference where it has to',
        )
    return not reason


def _collect(
    mechanism: Mechanism,
    system: OpenSystem | ClosedSystem,
    method: Method,
    record: RunRecord,
    wrappers: Sequence[Placing],
    watch: EventWatch | None,
    t_eval: FloatArray | None,
    settings: Settings,
    norm: ErrorNorm,
    twin: Any,
) -> Solution:
    """Arrays and statistics from a run record."""
    scheme = method.scheme
    data = record.data(scheme, system.tangent_size)
    placed = sum(wrapper.placed for wrapper in wrappers)
    replaced = sum(wrapper.replaced for wrapper in wrappers)
    suspects = suspected(wrappers)
    dense: DenseOutput
    if not isinstance(record, kernel.CompiledRecord):
        dense = DenseOutput(system, scheme, data)
    else:
        dense = kernel.CompiledDenseOutput(twin, system, scheme, data)
        placed, replaced, suspects = record.placed, record.replaced, record.suspects
    rejected = [a for a in record.attempts if a.verdict is Verdict.REJECTED]
    stats = Statistics(
        steps=data.count,
        rejected=len(rejected),
        placements=placed,
        replaced=replaced,
        zone_steps=len(data.zones),
        evaluations=system.evaluations,
        factorisations=system.factorisations,
        wall_time=record.wall_time,
    )
    return Solution(
        mechanism,
        system,
        scheme,
        data,
        dense=dense,
        t_eval=t_eval,
        attempts=np.array(
            [(a.t, a.h, a.error_ratio, a.verdict.value) for a in record.attempts], dtype=ATTEMPT
        ),
        events=None if watch is None else watch.found(),
        status=record.status,
        message=record.message
        + turns(suspects, "the velocity turned", MENDED)
        + restarts(record.steps)
        + drift(record.steps, norm)
        + _limits_left(mechanism, dense)
        + _driven_too_far(mechanism, record),
        stats=stats,
        settings=settings,
    )


def _driven_too_far(mechanism: Mechanism, record: RunRecord) -> str:
    """What else may be the cause where a driven mechanism cannot go on."""
    if record.status != "failed" or not mechanism.drives:
        return ""
    names = ", ".join(drive.name for drive in mechanism.drives)
    return f" A drive ({names}) may lead where the mechanism cannot follow."


def _bifurcations(solution: Solution) -> str:
    """A sentence for each singular configuration that was reached without momentum."""
    found = solution.bifurcations
    more = f" There were {len(found)} of them." if len(found) > TOLD else ""
    return "".join(f" {bifurcation}." for bifurcation in found[:TOLD]) + more


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
    names, indices, (low, high) = mechanism.derived(
        "limited_joints", lambda: _limited_joints(mechanism)
    )
    if not names:
        return ""
    q = dense.nodes()[1][:, indices]
    least, largest = q.min(axis=0), q.max(axis=0)
    beyond = np.maximum(low - least, largest - high)
    if not beyond.max() > 0.0:
        return ""
    # A run that a terminal event ends at a limit has not left it.
    slack = ROUND_OFF * np.maximum(1.0, np.maximum(-least, largest))
    left = [names[k] for k in np.flatnonzero(beyond > slack)]
    return f" Joint limits do not act; these joints left theirs: {', '.join(left)}." if left else ""
