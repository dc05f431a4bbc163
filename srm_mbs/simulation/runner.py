"""What a run of a mechanism begins with: its checked start, tolerances, control and callbacks.

Options that mechanisms and DAEs share are checked in :mod:`srm_mbs.simulation.options`.

What a run of a mechanism ends with: its solution, and the sentences of its message.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.constraints.rheonomic import constraint_errors
from srm_mbs.dynamics.controllers import Controller, HeldForce, evaluate_controller
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem
from srm_mbs.dynamics.scaling import constraint_units
from srm_mbs.errors import InputError
from srm_mbs.integration.control.prescribed_times import placed, suspected
from srm_mbs.integration.control.step_size import ControlWrapper, StepDecision, StepSizeControl
from srm_mbs.integration.dense_output import DenseOutput
from srm_mbs.integration.driver import RunRecord, RunStatus
from srm_mbs.integration.events import EventWatch, StateFunction, prepare_events
from srm_mbs.integration.kernel.dense_output import CompiledDenseOutput
from srm_mbs.integration.kernel.driver import CompiledRecord
from srm_mbs.integration.kernel.system import shared
from srm_mbs.integration.messages import branch_changes, method_messages
from srm_mbs.integration.methods.base import ErrorNorm, Method
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.thesis.sweep_branch_guard import branch_guard
from srm_mbs.model.forces import LimitSpring
from srm_mbs.model.mechanism import Mechanism
from srm_mbs.simulation.options import checked_atol, checked_method, step_size_control
from srm_mbs.simulation.result import Settings, Solution, Statistics, attempt_array

MENDED = "See solution.crossings; try a smaller rtol or step."
"""What to do about a passage that may have changed the branch."""
TOLD = 2
"""Bifurcations that the message of a run describes."""
ROUND_OFF = 1e-12
"""Distance (rad, m) behind a joint limit that is rounding; times |q| where that is above 1."""


def assemble_result(
    mechanism: Mechanism,
    system: OpenSystem | ClosedSystem,
    method: Method,
    record: RunRecord,
    wrappers: Sequence[ControlWrapper],
    watch: EventWatch | None,
    t_eval: FloatArray | None,
    settings: Settings,
    norm: ErrorNorm,
    kernel_system: Any,
) -> Solution:
    """Arrays and statistics from a run record."""
    scheme = method.scheme
    data = record.data(scheme, system.tangent_size)
    placed = sum(wrapper.placed for wrapper in wrappers)
    replaced = sum(wrapper.replaced for wrapper in wrappers)
    suspects = suspected(wrappers)
    dense: DenseOutput
    if not isinstance(record, CompiledRecord):
        dense = DenseOutput(system, scheme, data)
    else:
        dense = CompiledDenseOutput(None if shared(system) else kernel_system, system, scheme, data)
        placed, replaced, suspects = record.placed, record.replaced, record.suspects
    rejected = [a for a in record.attempts if a.verdict is StepDecision.REJECTED]
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
        attempts=attempt_array(record.attempts),
        events=None if watch is None else watch.found(),
        status=record.status,
        message=record.message
        + branch_changes(suspects, "the velocity turned", MENDED)
        + method_messages(method, record.steps, norm)
        + _limits_left(mechanism, dense)
        + _driven_too_far(mechanism, record),
        stats=stats,
        settings=settings,
    )


def _driven_too_far(mechanism: Mechanism, record: RunRecord) -> str:
    """What else may be the cause where a driven mechanism cannot go on."""
    if record.status is not RunStatus.FAILED or not mechanism.drives:
        return ""
    names = ", ".join(drive.name for drive in mechanism.drives)
    return f" A drive ({names}) may lead where the mechanism cannot follow."


def bifurcation_sentences(solution: Solution) -> str:
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
    # The reductions themselves: their methods cost more than they do here.
    least, largest = np.minimum.reduce(q), np.maximum.reduce(q)
    beyond = np.maximum(low - least, largest - high)
    if not max(beyond.tolist()) > 0.0:
        return ""
    # A run that a terminal event ends at a limit has not left it.
    slack = ROUND_OFF * np.maximum(1.0, np.maximum(-least, largest))
    left = [names[k] for k in np.flatnonzero(beyond > slack)]
    return f" Joint limits do not act; these joints left theirs: {', '.join(left)}." if left else ""


CONSISTENT = 1e-8
"""Largest closure error of an accepted start, in row units, and of its rates in those per time."""


def check_mechanism(mechanism: Any) -> None:
    """Refuse what is no mechanism."""
    if not isinstance(mechanism, Mechanism):
        raise InputError(
            f"{mechanism!r} is not a mechanism",
            element="mechanism",
            remedy="Give srm.load(...) or srm.Mechanism(...)",
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


def _units_of_states(mechanism: Mechanism) -> FloatArray:
    """The unit of each tangent component (2 nv,)."""
    units = mechanism.structure.units
    return np.concatenate([units.coordinate, units.coordinate * units.rate])


def absolute_tolerance(mechanism: Mechanism, atol: Any, rtol: float) -> FloatArray:
    """Absolute tolerance per tangent component (2 nv,)."""
    if atol is None:
        tolerance: FloatArray = rtol * mechanism.at_start(
            "units of states", lambda: _units_of_states(mechanism)
        )
        return tolerance
    nv = mechanism.model.nv
    remedy = f"Give one positive number, {nv} (per coordinate) or {2 * nv} (positions, then rates)"
    array = checked_atol(atol, (nv, 2 * nv), remedy)
    if array.shape == (nv,):
        array = np.tile(array, 2)
    return np.broadcast_to(array, (2 * nv,)).copy()


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


def event_watch(
    events: Any, system: OpenSystem | ClosedSystem, method: Method, state: FloatArray
) -> EventWatch | None:
    """What looks for the events (t, q, v) -> float; None if none are given."""
    if events is None:
        return None

    def adapt(event: Callable[..., Any]) -> StateFunction:
        return lambda t, x: event(t, *system.split(x))

    return EventWatch(system, method.scheme, prepare_events(events, adapt), state.size)


def sampler(
    system: OpenSystem | ClosedSystem, held: HeldForce, controller: Controller, kernel_system: Any
) -> Callable[[float, FloatArray], None]:
    """What samples ``controller`` at (t, state), for ``held`` and for the kernel."""

    def sample(t: float, state: FloatArray) -> None:
        force = evaluate_controller(controller, t, *system.split(state))
        held.hold(t, force)
        if kernel_system is not None:
            kernel_system.hold(t, force, True)

    return sample


def placed_control(
    system: OpenSystem | ClosedSystem,
    method: Method,
    step: float | None,
    first_step: Callable[[], float],
    span: tuple[float, float],
    placement: str,
    singular_times: FloatArray,
    arrivals: bool = False,
) -> tuple[StepSizeControl, Sequence[ControlWrapper]]:
    """The step-size control of a run, and the wrappers in it that count what they did.

    ``arrivals``: the driver prepares for ends beside singular configurations.
    """
    scheme = method.scheme
    t0, t_end = span
    control = step_size_control(scheme, t0, t_end, step, first_step)
    control, wrappers = placed(
        control,
        scheme,
        placement if system.has_constraints else None,
        singular_times,
        t_end,
        step,
        arrivals,
    )
    if system.has_constraints and placement == "automatic":
        guard = branch_guard(control, system, method)
        return guard, (*wrappers, guard)
    return control, wrappers
