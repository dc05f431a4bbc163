"""What a run of a mechanism begins with: its checked start, tolerances, control and callbacks.

Options that mechanisms and DAEs share are checked in :mod:`srm_mbs.options`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.mechanism import Mechanism
from srm_mbs.methods.base import Method
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.options import checked_atol, checked_method, step_size_control
from srm_mbs.stepping.events import EventWatch, StateFunction, prepare_events
from srm_mbs.stepping.guard import BranchGuard
from srm_mbs.stepping.singular_times import Placing, placed
from srm_mbs.stepping.stepsize import StepSizeControl
from srm_mbs.systems.controllers import Controller, called
from srm_mbs.systems.driven import constraint_errors
from srm_mbs.systems.held import HeldForce
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem
from srm_mbs.systems.units import constraint_units

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
    arrivals: bool = False,
) -> tuple[StepSizeControl, Sequence[Placing]]:
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
        guard = BranchGuard(control, system)
        return guard, (*wrappers, guard)
    return control, wrappers
