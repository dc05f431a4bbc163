"""Runs, segment by segment where actions of events change the state or the mechanism.

:func:`run` is the entry of all runs of mechanisms.  Without actions a run is one segment.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem, make_system
from srm_mbs.errors import (
    EvaluationError,
    EventError,
    InputError,
    get_logger,
    raised,
    safe_repr,
    time_text,
)
from srm_mbs.integration.contacts import Contact, ContactProbe
from srm_mbs.integration.driver import RunStatus
from srm_mbs.integration.events import (
    EventFunction,
    MechanismFunction,
    Occurrence,
    acting,
    prepare_events,
    same_time,
    stop_message,
)
from srm_mbs.integration.kernel.events import contact_probe
from srm_mbs.integration.kernel.system import Evaluator, SuccessiveWorkspaces
from srm_mbs.integration.methods.branch_nodes import onto_closed_branch
from srm_mbs.model.drives import positions
from srm_mbs.model.laws import Curve
from srm_mbs.model.numbers import positive_number
from srm_mbs.model.validation import STATE_ARGUMENTS
from srm_mbs.simulation.consistency import check_consistent, closed_start
from srm_mbs.simulation.options import RunOptions
from srm_mbs.simulation.result import SimulationResult
from srm_mbs.simulation.runner import (
    Segment,
    checked_options,
    error_norm,
    finished,
    initial_state,
    raise_at_first_call,
    run_segment,
    run_whole,
    unstarted_segment,
)
from srm_mbs.simulation.segmented_result import R, ResultTypes


class Event:
    """An event function with its attributes in one call.

    Parameters
    ----------
    function
        (t, q, v) -> float; the event is where it passes zero.
    direction
        > 0 for zeros passed upwards, < 0 downwards, 0 for both.
    terminal
        Whether it ends the run, or after how many occurrences.
    action
        (t, q, v) -> how the run continues, called at each occurrence that does not end the run:
        None if nothing changes, a consistent (q, v), or a :class:`Switch`.  The state that it gets
        is on the closures.

    Raises
    ------
    InputError
        If ``function`` or ``action`` cannot be called.
    """

    def __init__(
        self,
        function: Callable[[float, FloatArray, FloatArray], Any],
        *,
        direction: float = 0.0,
        terminal: bool | int = False,
        action: Callable[[float, FloatArray, FloatArray], Any] | None = None,
    ) -> None:
        for given, what in ((function, "function"), (action, "action")):
            if given is not None and not callable(given):
                raise InputError(
                    f"the {what} {safe_repr(given)} of an event cannot be called",
                    element=what,
                    remedy="Give a function of (t, q, v)",
                )
        self.__name__ = getattr(function, "__name__", "<lambda>")
        self.function, self.action = function, action
        self.direction, self.terminal = direction, terminal

    def __repr__(self) -> str:
        action = getattr(self.action, "__name__", self.action)
        fixed = f"direction={self.direction!r}, terminal={self.terminal!r}"
        return f"Event({self.__name__}, {fixed}, action={action})"

    def __call__(self, t: float, q: FloatArray, v: FloatArray) -> Any:
        """The value of the function."""
        return self.function(t, q, v)


@dataclass(frozen=True, eq=False)
class Switch:
    """Another mechanism from here on, as the answer of an action.

    Parameters
    ----------
    mechanism
        With the same joints: other closures (:meth:`srm_mbs.Mechanism.with_loop`,
        :meth:`~srm_mbs.Mechanism.without_loop`), drives or forces.
    q : (nq,), v : (nv,)
        By default as they are.  The positions must satisfy its closures, but for the tolerance of
        the run.  The velocities are projected on them, M-orthogonally: constraint impulses act, as
        in an inelastic impact, and nothing else.

    Drives that the mechanism had go on.  A new one engages: its law counts in the time of the run,
    from the position in which it finds its coordinate, s(t) = s(t_s) + law(t) - law(t_s); an
    absolute one must find it where it prescribes it.
    """

    mechanism: Mechanism
    q: Any = None
    v: Any = None


log = get_logger(__name__)

CHATTER_ACTIONS = 10
"""Times at which an event acts after which it may chatter."""
MOST_AT_ONCE = 1000
"""Actions of an event at one time from which it chatters: inelastic impacts between many bodies
that touch settle after as many as 50 for each of them."""
CHATTER_SPAN = 1e-8
"""An event that acts CHATTER_ACTIONS times within this part of the run chatters."""
HELD_EVENT_ROUNDING = 1e-9
"""Rounding of the value of an event that closures hold at zero, over its values before."""
LARGEST_PROJECTION = 1e-4
"""Largest motion (units) onto the closures of another mechanism: more is an inconsistent state."""
CLOSED_ROUNDING = 1e-13
"""Closure error that is rounding, in scaled rows, and over 1 + |v| that of rates."""
CLOSED_ON_CURVE = 1e-9
"""The same on the curve past a critical configuration; next to a narrow layer it is far closer."""
NEGLIGIBLE_REST = 1e-12
"""Part of the run too short for another segment."""


@dataclass(eq=False)
class _RunEvent:
    """An event over the segments of a run.

    Attributes
    ----------
    event
        Of the whole run.
    place
        Its index among the events.
    count
        Occurrences in the segments so far.
    acted
        Whether its action ended the last segment.
    floor, start_tolerance
        As for :class:`~srm_mbs.integration.events.EventFunction`, in the next segment.
    acted_at
        The last times (s) of its action.
    at_once
        Number of actions at the last of them.
    contact
        How it touches at the start of the next segment; None if it does not.
    rounding
        Rounding of its value at a time and a state.
    zero
        Size of values that are zero at the start of the next segment: twice that at its zero there.
    counts_from
        After an occurrence at the start of the next segment, the least sign of its rate, positive
        to the allowed side, at which it counts again; -1 without one.
    """

    event: EventFunction
    place: int
    count: int = 0
    acted: bool = False
    floor: float = 0.0
    start_tolerance: float | None = None
    acted_at: deque[float] = field(default_factory=lambda: deque(maxlen=CHATTER_ACTIONS))
    at_once: int = 0
    contact: Contact | None = None
    rounding: Callable[[float, FloatArray], float] | None = None
    zero: float = 0.0
    counts_from: int = -1

    @property
    def name(self) -> str:
        return self.event.name.strip("'")

    @property
    def left(self) -> float:
        """Number of further occurrences that ends the run."""
        return self.event.occurrences - self.count

    @property
    def may_touch(self) -> bool:
        """Whether it is a contact: it acts, and has a forbidden side."""
        return self.event.action is not None and self.event.direction != 0.0

    def in_segment(self) -> EventFunction:
        """The event as it is in the next segment."""
        event, contact = self.event, self.contact
        rests = contact is not None and contact.departs == 0
        leaves = self.acted or (contact is not None and not rests)
        return EventFunction(
            event.name,
            event.function,
            self.left,
            event.direction,
            acts=event.action is not None,
            departs=leaves and not rests and self.floor == 0.0,
            rests=self.rounding if rests else None,
            floor=self.floor,
            start_tolerance=self.start_tolerance,
        )

    def value(self, t: float, state: FloatArray) -> float:
        """The value at ``t`` (s) and ``state`` (nx,)."""
        return self.event(t, state.copy())

    def begin_instant(self, acted: bool, zero: float) -> None:
        """Begin the actions at the start of the next segment; see the attributes."""
        self.contact, self.acted, self.zero = None, acted, zero
        self.counts_from = -1

    def acts_at_once(self, probe: ContactProbe, slack: float) -> bool:
        """Whether it touches where ``probe`` is, and leaves to the forbidden side."""
        self.rounding = partial(probe.rounding, self.event)
        self.contact = contact = probe.contact(self.event, self.zero, slack, self.floor)
        if contact is None or contact.rate < self.counts_from:
            return False
        self.counts_from = -1
        return contact.departs < 0

    def act(self, t: float, q: FloatArray, v: FloatArray) -> Any:
        """The answer of the action; None without one."""
        action = self.event.action
        try:
            return None if action is None else action(t, q, v)
        except Exception as error:
            raise EventError(raised(f"the action of the event {self.name!r}", error)) from error

    def check_chatter(self, t: float, span: float) -> None:
        """Record an action at ``t`` (s); refuse too many within a part of the length ``span``."""
        if self.acted_at and self.acted_at[-1] == t:
            self.at_once += 1
        else:
            self.acted_at.append(t)
            self.at_once = 1
        within = t - self.acted_at[0]
        often = len(self.acted_at) == CHATTER_ACTIONS and within < CHATTER_SPAN * span
        if often or self.at_once == MOST_AT_ONCE:
            how = f"{CHATTER_ACTIONS} times within {within:.1e} s" if often else "on and on at once"
            raise EventError(
                f"the event {self.name!r} occurred {how}: it chatters. Let its action hold what it "
                "hits (srm.Switch with a closure) when the impact is slow"
            )


class _Sampled:
    """A controller whose samples go on over the segments of a run."""

    def __init__(self, controller: Callable[..., Any], period: float) -> None:
        self._controller, self._period = controller, period
        self._last: Any = None

    def __call__(self, t: float, q: FloatArray, v: FloatArray) -> Any:
        off = abs(t / self._period - round(t / self._period))
        if self._last is None or off < 1e-9:
            self._last = self._controller(t, q, v)
        return self._last


def run(mechanism: Mechanism, options: RunOptions, types: ResultTypes[R]) -> R:
    """Simulate ``mechanism``; see :func:`srm_mbs.simulate`.

    Parameters
    ----------
    options
        As the caller gave them.
    types
        Classes of the result.

    Raises
    ------
    InputError
        For invalid input, before any stepping.
    SimulationError
        Only with ``raise_on_failure``.
    ControllerError, EventError
        If a function of the user fails where it is called first.
    """
    events = options.events
    if events is not None and isinstance(events, Iterator):  # they are looked at more than once
        options = options._replace(events=list(events))
    checked = checked_options(mechanism, options)
    if events is not None and acting(options.events):
        with SuccessiveWorkspaces() as workspaces:
            result = _run_segments(mechanism, checked, types, workspaces)
    else:
        result = run_whole(mechanism, checked, types.plain)
    result.request = options.repeatable()
    return finished(result, checked)


def _function_of_state(event: Callable[..., Any], nq: int) -> MechanismFunction:
    return MechanismFunction(event.function if type(event) is Event else event, nq)


def _run_segments(
    mechanism: Mechanism,
    options: RunOptions,
    types: ResultTypes[R],
    workspaces: SuccessiveWorkspaces,
) -> R:
    """The segments between the actions of events, joined."""
    t_end, nq = options.t_end, mechanism.model.nq
    given = prepare_events(options.events, lambda event: _function_of_state(event, nq))
    events = [_RunEvent(event, place) for place, event in enumerate(given)]
    q0, v0 = options.q0, options.v0
    if options.t0 == 0.0 and not (q0 is None and v0 is None):
        # Drives begin with this state.
        mechanism = mechanism.with_state(
            mechanism.q0 if q0 is None else q0, mechanism.v0 if v0 is None else v0
        )
    here = options._replace(t_eval=None)
    if options.sample_time is not None and options.controller is not None:
        period = positive_number(options.sample_time, "sample_time", " of seconds")
        here = here._replace(controller=_Sampled(options.controller, period))
    parts: list[R] = []
    segment: Segment[R] | None = None
    t = options.t0
    span = t_end - t
    status, message = RunStatus.RUNNING, ""  # without a message: that of the last segment
    failure: Exception | None = None
    at_once: list[Occurrence] = []
    try:
        mechanism, q, v = _at_start(events, mechanism, here, span, at_once)
        if not at_once:
            q, v = here.q0, here.v0
    except EventError as error:
        raise_at_first_call(error, options.t0)
        parts.append(unstarted_segment(mechanism, here, error, types.plain))
        status, message = parts[0].status, parts[0].message
    while status is RunStatus.RUNNING:
        try:
            watched = [event.in_segment() for event in events]
            asked = here._replace(t0=t, q0=q, v0=v, events=watched)
            segment = run_segment(mechanism, asked, types.plain, workspaces, segment)
            part = segment.result
            part.request = asked.repeatable()
            parts.append(part)
            status, t = part.status, segment.end.time
            due = []
            for event, times in zip(events, part.t_events or []):
                event.count += len(times)
                if len(times) and times[-1] == t:
                    due.append(event)
            if status is not RunStatus.EVENT or any(event.left <= 0 for event in due):
                break
            known = workspaces.evaluator(part.system)
            mechanism, q, v = _after_actions(
                events, due, segment, known, here.controller, span, at_once
            )
            last = next((event for event in events if event.left <= 0), None)
            if last is not None:
                message = stop_message(last.event.name, last.count, t)
                break
        except InputError as error:
            if not parts:
                raise
            status, failure = RunStatus.FAILED, error
            message = f"Stopped at t = {t:.9g} s: after the action {error}."
        except EventError as error:
            if not parts:
                raise
            status, failure = RunStatus.FAILED, error
            message = f"Stopped at t = {t:.9g} s: {error}. Everything up to there is kept."
        except KeyboardInterrupt:
            if not parts:
                raise
            status = RunStatus.INTERRUPTED
            message = f"Interrupted at t = {time_text(t)} s; everything up to there is kept."
        else:
            status = RunStatus.RUNNING if t_end - t > NEGLIGIBLE_REST * span else RunStatus.FINISHED
        finally:
            if parts and at_once:
                parts[-1].add_occurrences(at_once)
                at_once.clear()
    message = message or parts[-1].message
    if len(parts) > 1:
        message += f" Event actions divide the run into {len(parts)} segments."
    result = types.segmented(parts, t_eval=options.t_eval, status=status, message=message)
    result.error = parts[-1].error if failure is None else failure
    return result


def _at_start(
    events: list[_RunEvent],
    mechanism: Mechanism,
    options: RunOptions,
    span: float,
    occurred: list[Occurrence],
) -> tuple[Mechanism, FloatArray, FloatArray]:
    """Mechanism and state after the actions of contacts that touch at the start of the run.

    An occurrence that would end the run is not counted there.

    Raises
    ------
    EventError
        If an action fails, or an event chatters.
    InputError
        If the start is inconsistent.
    """
    t0 = options.t0
    started, x = initial_state(mechanism, t0, options.q0, options.v0)
    nq = started.model.nq
    contacts = [event for event in events if event.may_touch and event.left > 1]
    if contacts:
        if started.constrained:
            closed, _ = closed_start(started, t0, error_norm(started, options))
            if closed is not x:
                started, x = initial_state(mechanism, t0, closed[:nq], closed[nq:])
        found = _act_at_once(
            contacts, started, t0, x[:nq], x[nq:], options.controller, span, occurred
        )
        return found if occurred else (mechanism, x[:nq], x[nq:])
    return mechanism, x[:nq], x[nq:]


def _act_at_once(
    contacts: list[_RunEvent],
    mechanism: Mechanism,
    t: float,
    q: FloatArray,
    v: FloatArray,
    controller: Callable[..., Any] | None,
    span: float,
    occurred: list[Occurrence],
    slack: Callable[[_RunEvent], float] = lambda event: 0.0,
    system: Any = None,
    backend: str = "python",
) -> tuple[Mechanism, FloatArray, FloatArray]:
    """Mechanism and state after the actions of ``contacts`` that touch at ``t`` and leave to their
    forbidden side, one after the other until none does (:mod:`srm_mbs.integration.contacts`).

    Parameters
    ----------
    occurred
        Receives the occurrences.
    slack
        Size of the value of an event on its forbidden side that is zero.
    system
        The equations of motion, if they are known.
    backend
        Evaluates the closures.

    Raises
    ------
    EventError
        If an action fails, or an event chatters.
    """
    units = mechanism.structure.units
    while True:
        x = np.concatenate([q, v])
        if system is None:
            system = make_system(mechanism, controller)
        probe = contact_probe(system, units, span, t, x)
        leaving = [event for event in contacts if event.acts_at_once(probe, slack(event))]
        if not leaving:
            return mechanism, q, v
        event = leaving[0]
        occurred.append(Occurrence(event.place, t, x))
        event.count += 1
        event.acted = True
        if event.left <= 0:
            return mechanism, q, v
        structure = mechanism.structure
        mechanism, q, v = _acted(event, mechanism, t, q, v, backend)
        if mechanism.structure is not structure:
            system = None
        event.check_chatter(t, span)


def _rounding(event: _RunEvent, solution: SimulationResult) -> float:
    """Size of the value of an event that new closures hold at zero."""
    states = np.hstack([solution.q, solution.v])
    return HELD_EVENT_ROUNDING * max(abs(event.value(t, x)) for t, x in zip(solution.t, states))


def _closed(
    system: OpenSystem | ClosedSystem | Evaluator, t: float, x: FloatArray, largest: float
) -> bool:
    """Whether ``x`` is on the closures, up to the ``largest`` error: that of rounding for most.

    A projection would then gain nothing, and next to a singular configuration it would move ``x``
    off its branch by rounding over sigma.
    """
    error, rate = system.largest_residuals(x, t)
    # Of a list: it is short, and NumPy takes five times as long.
    speed = max(map(abs, x[system.nq :].tolist()))
    return bool(error < largest and rate < largest * (1.0 + speed))


def _after_actions(
    events: list[_RunEvent],
    due: list[_RunEvent],
    segment: Segment[Any],
    known: OpenSystem | ClosedSystem | Evaluator,
    controller: Callable[..., Any] | None,
    span: float,
    at_once: list[Occurrence],
) -> tuple[Mechanism, FloatArray, FloatArray]:
    """Mechanism and state after the actions of the events ``due`` at the end of a segment, and of
    contacts that touch there, whose occurrences ``at_once`` receives.

    Raises
    ------
    EventError
        If an action fails, or an event chatters.
    """
    part, end = segment.result, segment.end
    mechanism, t = part.mechanism, end.time
    # What was counted here is not counted again just after; the rest has still to be.
    near = 2.0 * same_time(end.last_start, end.last_time)
    nq = mechanism.model.nq
    before = x = segment.last_state
    try:
        # The dense output is on the closures within the tolerance only.  On a curve that turns
        # beside a critical configuration a projection may lead to the other one there, unless the
        # layer is wide, where the curve is on the closures within the tolerance, too.
        if not _closed(known, t, x, CLOSED_ON_CURVE if end.on_curve else CLOSED_ROUNDING):
            x = onto_closed_branch(
                part.system if controller is None else make_system(mechanism), t, x
            )
    except EvaluationError as error:
        raise EventError(f"no action could be taken: {error}") from error
    for event, times in zip(events, part.t_events or []):
        event.start_tolerance = near if len(times) and times[-1] >= t - near else 0.0
        acted = event in due and event.event.action is not None
        event.begin_instant(acted, 2.0 * abs(event.value(t, x)) if acted else 0.0)
    acting_events = [event for event in events if event.acted]
    if log.isEnabledFor(logging.DEBUG):
        names = ", ".join(event.name for event in acting_events)
        log.debug("%s: action of %s at t = %.9g s", mechanism.name, names, t)
    q, v = x[:nq], x[nq:]
    for event in acting_events:
        mechanism, q, v = _acted(event, mechanism, t, q, v, part.backend)
    switched = mechanism.loops != part.mechanism.loops
    for event in acting_events:
        event.floor = _rounding(event, part) if switched else 0.0
        event.check_chatter(t, span)

    def moved_by(event: _RunEvent) -> float:
        """Twice the change of an event when the state was moved onto the closures."""
        return 0.0 if x is before else 2.0 * abs(event.value(t, x) - event.value(t, before))

    contacts = [event for event in events if event.may_touch]
    if not contacts:
        return mechanism, q, v
    system = known if mechanism.structure is part.mechanism.structure else None
    return _act_at_once(
        contacts, mechanism, t, q, v, controller, span, at_once, moved_by, system, part.backend
    )


def _acted(
    event: _RunEvent, mechanism: Mechanism, t: float, q: FloatArray, v: FloatArray, backend: str
) -> tuple[Mechanism, FloatArray, FloatArray]:
    """Mechanism and state after the action of ``event``; ``backend`` evaluates the closures.

    Raises
    ------
    EventError
        If it fails, or its answer cannot be carried out.
    """
    answer = event.act(t, q.copy(), v.copy())
    event.counts_from = 1 if answer is None else 0
    if answer is None:
        return mechanism, q, v
    try:
        if isinstance(answer, Switch):
            return _switched(mechanism, answer, t, q, v)
        q, v = _state(answer)
        moved = mechanism.continued(q, v)
        if moved.constrained:
            check_consistent(moved, t, backend, names=STATE_ARGUMENTS)
        return moved, moved.q0, moved.v0
    except (InputError, EvaluationError, TypeError, ValueError) as error:
        raise EventError(
            f"the action of the event {event.name!r} cannot be carried out: {error}"
        ) from error


def _state(answer: Any) -> tuple[Any, Any]:
    """q and v from the ``answer`` of an action, as they are."""
    try:
        q, v = answer
    except (TypeError, ValueError) as error:
        raise InputError(
            f"it returned {safe_repr(answer)}",
            remedy="Return None, the state (q, v), or srm.Switch(mechanism)",
        ) from error
    return q, v


def _curves_from(t: float, old: Mechanism, new: Mechanism) -> dict[str, Curve]:
    """The motions of the drives of ``new`` from ``t`` (s) on.

    Drives that ``old`` has continue; others begin at the present value of their coordinate, unless
    they prescribe positions.
    """
    found = positions(new.model, new.drives, new.q0)
    curves = {}
    for drive in new.drives:
        if drive in old.drives:
            curves[drive.name] = old.drive_curves[drive.name]
            continue
        curve = drive.curve(0.0)
        moved = 0.0 if drive.absolute else found[drive.name] - curve(t)[0]
        curves[drive.name] = curve.shifted(moved)
    return curves


def _switched(
    mechanism: Mechanism, switch: Switch, t: float, q: FloatArray, v: FloatArray
) -> tuple[Mechanism, FloatArray, FloatArray]:
    new = switch.mechanism
    if not isinstance(new, Mechanism) or list(new.model.names) != list(mechanism.model.names):
        raise InputError(
            "a switch leads to something else than a mechanism with the same joints",
            remedy="Give a mechanism made from this one, for example with dataclasses.replace",
        )
    new = new.moved(q if switch.q is None else switch.q, v if switch.v is None else switch.v)
    new = new.with_drive_curves(_curves_from(t, mechanism, new))
    given = new.start_state
    system = make_system(new)
    x = onto_closed_branch(system, t, given)
    if system.position_norm(system.difference(given, x)) > LARGEST_PROJECTION:
        check_consistent(new, t, names=STATE_ARGUMENTS)
    nq = new.model.nq
    return new, x[:nq], x[nq:]
