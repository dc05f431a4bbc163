r"""Events: zeros of functions of time and state, located on the dense output of a run.

The conventions are those of ``scipy.integrate.solve_ivp``: an event is a callable that returns a
float; it occurs where that float passes zero; its attribute ``terminal`` (a bool, or a number of
occurrences) ends the run there, and ``direction`` (> 0 or < 0) counts only zeros passed upwards or
downwards.  An attribute ``action`` is called at every occurrence that does not end the run
(:mod:`srm_mbs.simulation.segmented_run`).  :func:`prepare_events` reads these attributes, and
nothing else does: it makes an :class:`EventFunction` of every callable.  Four points are settled
where SciPy leaves them open:

* A step is examined at as many equal parts of its dense output as that has polynomial degree
  (3 to 7), and, where the parabola through three neighbouring values comes near zero, at its
  vertex: a step of dop853 is long enough to hold several zeros.  Two zeros closer to each other
  than that may still be missed; ``max_step`` helps.
* A zero at the start of the run is not an event, nor is one within round-off of it, so that a run
  can be continued from an event.  Events that act there at once are found before
  (:mod:`srm_mbs.integration.contacts`).
* A zero on the boundary of two steps is one event, passed in the direction in which it was
  reached.
* A terminal event ends the run with the state of the dense output there; other events are kept up
  to and including that time.  Those within round-off of it are at that time: events that occur at
  once, by symmetry, have times that differ by rounding, and a run that continues from there would
  not count them.

The search works on states, for mechanisms and DAEs alike::

    watch = EventWatch(scheme, prepare_events(events, adapt), state.size)
    record = integrate(..., events=watch)
    times, states = watch.found()

``adapt`` turns a user's function into one of (t, state); for a DAE, whose events have that
signature already, it is ``lambda event: event``.  ``record.stop`` belongs into
:class:`~srm_mbs.integration.dense_output.StepData`, whose dense output then ends there.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple, NoReturn

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.errors import EvaluationError, EventError, InputError, raised, safe_repr, time_text
from srm_mbs.integration.dense_output import DenseOutput, step_data
from srm_mbs.integration.methods.base import StepResult
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.model.numbers import real_array

SAME_TIME_STEP = 1e-10
"""Times closer than this part of the step are one: a zero so close after the start of a run lies
on it, and zeros so close after a terminal event lie there."""
SAME_TIME_ROUNDING = 16.0 * float(np.finfo(float).eps)
"""The same, over the time itself: the search finds each of two equal zeros to 8 eps."""
MAX_HALVINGS = 30
"""Halvings of the first part of a step within which a value that departs from zero may return."""
_HALVES: FloatArray = np.exp2(-np.arange(1.0, MAX_HALVINGS + 1.0))
MAX_BISECTIONS = 40
"""Halvings of the time in which a value leaves zero."""
MAX_ROOT_STEPS = 200
"""Steps of the search for a zero; bisection alone takes 60."""
CONVERGED_STEP, FAST_CONVERGENCE = 1e-9, 1e-3
"""Step of that search, over the first bracket and over the step before, after which the next one is
below rounding: the error falls with the power 1.8."""
VERTEX_VALUE = 0.5
"""Value of a parabola's vertex, over the smallest of its three values, below which the event is
evaluated there."""


StateFunction = Callable[[float, FloatArray], Any]
"""(t, state) -> a float that passes zero at the event."""


class MechanismFunction:
    """A function of (t, state) that can be pickled, from one of (t, q, v) and the length of q.

    Attributes
    ----------
    function
        That of (t, q, v), which the compiled kernel calls itself.
    """

    __slots__ = ("_q", "_v", "function")

    def __init__(self, function: Callable[[float, FloatArray, FloatArray], Any], nq: int) -> None:
        self.function = function
        self._q, self._v = slice(None, nq), slice(nq, None)

    def __call__(self, t: float, state: FloatArray) -> Any:
        return self.function(t, state[self._q], state[self._v])


def same_time(t: float, t_new: float) -> float:
    """Distance (s) below which two times within the step from ``t`` to ``t_new`` are one."""
    return max(SAME_TIME_STEP * (t_new - t), SAME_TIME_ROUNDING * max(abs(t), abs(t_new)))


@dataclass(eq=False, slots=True)  # not frozen: that would take three times as long
class EventFunction:
    """An event function and everything that a run needs to know of it.

    Attributes
    ----------
    name
        Its name in messages: the function's own, or its place in the list.
    function
        Of (t, state).
    occurrences
        Number of occurrences that ends the run; infinite if it is not terminal.
    direction
        > 0 for zeros passed upwards, < 0 downwards, 0 for both.
    action
        Called at each occurrence that does not end the run, with the arguments of the function as
        the user gives it; None without one.
    acts
        Whether every occurrence ends the run, or its segment, for the sake of an action.
    departs
        Whether the run starts at an occurrence, from where the value moves away.
    rests
        Of a contact that touches where the run starts, and does not leave at once: the rounding of
        its value at a time and a state.  It occurs where its value leaves zero in its direction.
    floor
        Size of values that count as zero: of an event that closures hold at zero, the rounding.
    start_tolerance
        Time (s) after the start of the run up to which a zero lies on it; None for
        :func:`same_time` of the first step.  In a segment of a run 0 for zeros that its predecessor
        did not count.
    time_unit
        Of times in messages, after a space.
    """

    name: str
    function: StateFunction
    occurrences: float
    direction: float
    action: Callable[..., Any] | None = None
    acts: bool = False
    departs: bool = False
    rests: Callable[[float, FloatArray], float] | None = None
    floor: float = 0.0
    start_tolerance: float | None = None
    time_unit: str = " s"

    def __call__(self, t: float, state: FloatArray) -> float:
        """The value at ``t``; ``state`` must not be needed any more, the user may write to it.

        Raises
        ------
        EventError
            If the function raises, or returns anything but one finite number.
        """
        try:
            found = self.function(t, state)
        except Exception as error:
            self.fail(error, t)
        if isinstance(found, float) and math.isfinite(found):
            return float(found)
        return self.number(found, t)

    def number(self, found: Any, t: float) -> float:
        """The value ``found`` that the function returned at ``t`` (s), as a float.

        Raises
        ------
        EventError
            If it is anything but one finite number.
        """
        try:
            value = real_array(found, new=False)
        except Exception as error:
            self.fail(error, t)
        if value.size != 1 or not np.isfinite(value).all():
            given = None if found is None else value.tolist()
            raise EventError(
                f"the event {self.name} returned {given} at t = {time_text(t)}"
                f"{self.time_unit}; it must return one finite number",
                t,
            )
        return float(value.item())

    def fail(self, error: Exception, t: float) -> NoReturn:
        """Raise the EventError of a function that raised ``error`` at ``t`` (s)."""
        at = f"t = {time_text(t)}{self.time_unit}"
        raise EventError(raised(f"the event {self.name}", error, f"at {at}"), t) from error

    def floor_at(self, t: float, state: FloatArray) -> float:
        """Size of values that count as zero at ``t`` (s) and ``state``."""
        return self.floor if self.rests is None else max(self.floor, self.rests(t, state))

    def counts(self, rising: bool) -> bool:
        """Whether a zero passed upwards (``rising``) or downwards is an event."""
        return self.direction == 0.0 or (self.direction > 0.0) == rising


def prepare_events(
    events: Any, adapt: Callable[[Callable[..., Any]], StateFunction], unit: str = " s"
) -> list[EventFunction]:
    """The event functions of a run, from a callable of the user or a list of them.

    Parameters
    ----------
    events
        Callables with the attributes ``terminal``, ``direction`` and ``action``, all optional; an
        :class:`EventFunction`, whose function is one of (t, state) already, is left as it is.
    adapt
        Makes a function of (t, state) of each callable.
    unit
        Of times in messages, after a space.

    Raises
    ------
    InputError
        If something cannot be called, or an attribute has no meaning.
    """
    functions = [
        event if isinstance(event, EventFunction) else _event_function(event, i, adapt)
        for i, event in enumerate(listed_events(events))
    ]
    for function in functions:
        function.time_unit = unit
    return functions


def _event_function(
    event: Any, i: int, adapt: Callable[[Callable[..., Any]], StateFunction]
) -> EventFunction:
    """The user's ``event``, number ``i``, with its attributes and ``adapt`` of it."""
    place = f"events[{i}]"
    if not callable(event):
        raise InputError(
            f"{safe_repr(event)} cannot be called",
            element=place,
            remedy="Give functions that return a float, as scipy.integrate.solve_ivp takes them",
        )
    name = getattr(event, "__name__", "<lambda>")
    terminal, direction = getattr(event, "terminal", None), getattr(event, "direction", 0)
    occurrences = math.inf if terminal is None else _number(terminal)
    if occurrences == 0.0:
        occurrences = math.inf
    if not (occurrences > 0.0 and (occurrences == math.inf or occurrences.is_integer())):
        raise InputError(
            f"terminal = {safe_repr(terminal)} is neither a boolean nor a number of occurrences",
            element=place,
            remedy="Give True, False or a positive integer",
        )
    if math.isnan(_number(direction)):
        raise InputError(
            f"direction = {safe_repr(direction)} is not a number",
            element=place,
            remedy="Give 1 (upwards), -1 (downwards) or 0 (both)",
        )
    label = place if name == "<lambda>" else repr(name)
    action = getattr(event, "action", None)
    if not (action is None or callable(action)):
        raise InputError(
            f"action = {safe_repr(action)} cannot be called",
            element=place,
            remedy="Give a function of (t, q, v)",
        )
    return EventFunction(label, adapt(event), occurrences, _number(direction), action)


def acting(events: Any) -> bool:
    """Whether any of the user's events has an action."""
    return any(getattr(event, "action", None) is not None for event in listed_events(events))


def listed_events(events: Any) -> list[Any]:
    """The user's events as a list; what cannot be iterated is one of them."""
    if callable(events):
        return [events]
    try:
        return list(events)
    except Exception:  # objects may raise anything
        return [events]


def _number(value: Any) -> float:
    """``value`` as a float, NaN if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


def sign_above(value: float, floor: float) -> float:
    """Sign of a value; 0 at the floor."""
    return 0.0 if abs(value) <= floor else math.copysign(1.0, value)


class Occurrence(NamedTuple):
    """An occurrence of an event: its index among the events, its time (s) and state (nx,)."""

    event: int
    time: float
    state: FloatArray


def stop_message(name: str, count: int, t: float, unit: str = " s") -> str:
    """The message of a run that the occurrence ``count`` of the event ``name`` ended at ``t``."""
    which = f" (occurrence {count})" if count > 1 else ""
    return f"The event {name}{which} ended the run at t = {t:.9g}{unit}."


class Stop(NamedTuple):
    """The end of a run by a terminal event: its time (s) and state (nx,), and a sentence that
    names it."""

    time: float
    state: FloatArray
    message: str


StepDense = Callable[[FloatArray], FloatArray]
"""Dense output of one step: times (k,) within it -> states (k, nx)."""


def step_dense(
    system: System, scheme: ButcherTableau, state: FloatArray, result: StepResult, t_new: float
) -> StepDense:
    """Dense output of the step ``result`` from ``state`` to ``t_new`` (s), by the reference."""
    data = step_data(result.t, state, [t_new], [result], scheme, system.tangent_size)
    return DenseOutput(system, scheme, data)


class EventWatch:
    """Finds events step by step; called by the driver.

    Parameters
    ----------
    scheme
        The tableau of the run.
    events
        From :func:`prepare_events`.
    size
        Length of a state.
    """

    def __init__(self, scheme: ButcherTableau, events: Sequence[EventFunction], size: int) -> None:
        self._events = tuple(events)
        self._fractions = examined_fractions(scheme)
        self._values = [0.0] * len(self._events)
        # The sign last seen; 0 after a value that was exactly zero.
        self._signs = [0.0] * len(self._events)
        self._times: list[list[float]] = [[] for _ in self._events]
        self._states: list[list[FloatArray]] = [[] for _ in self._events]
        self._start = 0.0
        self._size = size

    def begin(self, t: float, state: FloatArray) -> None:
        """Evaluate the events at the start of a run.

        Raises
        ------
        EventError
            If an event function fails.
        """
        self._start = t
        self._values = [event(t, state.copy()) for event in self._events]
        self._signs = [
            0.0 if event.departs else sign_above(value, event.floor_at(t, state))
            for event, value in zip(self._events, self._values)
        ]

    def after_step(self, t: float, t_new: float, end: FloatArray, dense: StepDense) -> Stop | None:
        """Record the events of an accepted step from ``t`` to the state ``end`` at ``t_new`` (s).

        Returns
        -------
        Stop or None
            Where and why the run ends, if a terminal event occurred often enough.

        Raises
        ------
        EventError
            If an event function fails, or a state within the step cannot be evaluated.
        """
        inside = t + self._fractions * (t_new - t)
        times = [*inside.tolist(), t_new]
        states = np.concatenate([read_nodes(dense, inside), end[None]])
        found: list[tuple[float, int]] = []
        for i, event in enumerate(self._events):
            values = [event(at, x) for at, x in zip(times, states.copy())]
            nodes = [(t, self._values[i]), *zip(times, values)]
            early = None
            if event.departs and t == self._start and event.counts(rising=values[0] > 0.0):
                early = self._departing(i, dense, nodes)
            nodes = _with_vertices(event, dense, nodes)
            if early is not None:
                nodes = [early, *(node for node in nodes[1:] if node[0] > early[0])]
            floor = event.floor_at(t_new, end)
            found += [(time, i) for time in self._zeros(i, nodes, dense, floor)]
            self._values[i] = values[-1]
        if not found:
            return None
        return self._record(sorted(found), dense, same_time(t, t_new))

    def _departing(
        self, i: int, dense: StepDense, nodes: list[tuple[float, float]]
    ) -> tuple[float, float] | None:
        """A node of the first step between the start and the first of ``nodes`` where the value
        still has the sign with which it departs, if it returns to zero that soon; else None."""
        event, (t, _), (after, value) = self._events[i], *nodes[:2]
        times = t + (after - t) * _HALVES
        for at, x in zip(times.tolist(), dense(times)):
            now = event(at, x)
            if now * value < 0.0:
                self._signs[i] = float(np.sign(now))
                return at, now
        return None

    def _zeros(
        self, i: int, nodes: list[tuple[float, float]], dense: StepDense, floor: float
    ) -> list[float]:
        """Times at which event ``i`` occurs, given its values at ``nodes``; those up to ``floor``
        are zero."""
        event = self._events[i]
        earliest = -math.inf
        if nodes[0][0] == self._start and not event.departs:
            tolerance = event.start_tolerance
            if tolerance is None:
                tolerance = same_time(self._start, nodes[-1][0])
            earliest = self._start + tolerance
        signs = [float((value > floor) - (value < -floor)) for _, value in nodes[1:]]
        before, self._signs[i] = self._signs[i], signs[-1]
        zeros: list[float] = []
        if signs.count(before) == len(signs):
            return zeros
        for (left, right), now in zip(pairwise(nodes), signs):
            if now != before and before != 0.0:
                zero = right[0] if now == 0.0 else _zero_between(event, dense, left, right)
                if zero > earliest and event.counts(rising=before < 0.0):
                    zeros.append(zero)
            elif now != before and event.rests is not None and event.counts(rising=now > 0.0):
                zeros.append(_end_of_rest(event, dense, left[0], right[0], floor))
            before = now
        return zeros

    def _record(
        self, found: list[tuple[float, int]], dense: StepDense, close: float
    ) -> Stop | None:
        stop: Stop | None = None
        for time, i in found:
            if stop is not None:
                if time > stop.time + close:
                    break
                time = stop.time
            self._times[i].append(time)
            state = dense(np.array([time]))[0] if stop is None else stop.state
            self._states[i].append(state)
            event, count = self._events[i], len(self._times[i])
            if stop is None and (event.acts or count >= event.occurrences):
                stop = Stop(time, state, stop_message(event.name, count, time, event.time_unit))
        return stop

    def found(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """Times (k,) and states (k, nx) of the occurrences, for each event in turn."""
        times = [np.array(times, dtype=float) for times in self._times]
        states = [
            np.array(states, dtype=float).reshape(len(states), self._size)
            for states in self._states
        ]
        return times, states


@lru_cache(maxsize=8)
def examined_fractions(scheme: ButcherTableau) -> FloatArray:
    """Where a step is examined inside, over its length."""
    return np.linspace(0.0, 1.0, len(scheme.dense.rows) + 1)[1:-1]


def read_nodes(dense: StepDense, times: FloatArray) -> FloatArray:
    """States (k, nx) at ``times`` (k,) s at which a step is examined.

    Raises
    ------
    EventError
        If one cannot be evaluated.
    """
    try:
        return dense(times)
    except EvaluationError as error:
        raise EventError(f"no event could be looked for within a step: {error}") from error


def _value_at(event: EventFunction, dense: StepDense, t: float) -> float:
    return event(t, dense(np.array([t]))[0])


def _with_vertices(
    event: EventFunction, dense: StepDense, nodes: list[tuple[float, float]]
) -> list[tuple[float, float]]:
    """``nodes``, equally spaced, with the vertices of parabolas that come near zero between."""
    extra = []
    for (_, a), (t, b), (t_next, c) in zip(nodes, nodes[1:], nodes[2:]):
        if b < 0.0:
            a, b, c = -a, -b, -c
        curvature = 0.5 * (a + c) - b
        if not (a > 0.0 and b > 0.0 and c > 0.0 and curvature > 0.0):
            continue
        vertex = -0.25 * (c - a) / curvature
        lowest = b - curvature * vertex**2
        if abs(vertex) < 1.0 and vertex != 0.0 and lowest < VERTEX_VALUE * min(a, b, c):
            at = t + vertex * (t_next - t)
            extra.append((at, _value_at(event, dense, at)))
    return sorted([*nodes, *extra]) if extra else nodes


def _end_of_rest(
    event: EventFunction, dense: StepDense, rests: float, left: float, floor: float
) -> float:
    """The time between ``rests`` and ``left`` (s) at which the value leaves zero."""
    for _ in range(MAX_BISECTIONS):
        middle = 0.5 * (rests + left)
        if abs(_value_at(event, dense, middle)) <= floor:
            rests = middle
        else:
            left = middle
    return left


def _zero_between(
    event: EventFunction, dense: StepDense, left: tuple[float, float], right: tuple[float, float]
) -> float:
    """The zero of ``event`` between two (time, value) of opposite sign, to round-off.

    Brent's method: inverse quadratic interpolation of the last three values, and bisection where
    its steps do not halve in two steps.  It ends where the next step must be below rounding because
    the last ones shrank so fast.
    """
    (a, _), (b, _) = left, right
    rising, length = right[1] > 0.0, b - a
    points = [left, right]
    precision = sys.float_info.epsilon * (length + max(abs(a), abs(b)))
    at, steps = b, [math.inf, math.inf]
    for _ in range(MAX_ROOT_STEPS):
        new = _interpolated_zero(points)
        step = abs(new - at)
        if step <= precision and not a < new < b:
            # Rounding places it on an end of the bracket, which is the zero up to rounding.
            new = min(max(new, a), b)
            interpolated = True
        else:
            interpolated = a < new < b and step < 0.5 * steps[-2]
        if not interpolated:
            new = 0.5 * (a + b)
            step = abs(new - at)
        fast = step < CONVERGED_STEP * length and step < FAST_CONVERGENCE * steps[-1]
        last = b - a <= precision or (interpolated and (step <= precision or fast))
        value, at = _value_at(event, dense, new), new
        if value == 0.0:
            return new
        if last:
            # Of the times beside it the nearest.
            near = _interpolated_zero([points[-1], (new, value)])
            beside = [near, math.nextafter(new, a), math.nextafter(new, b)]
            beside = [x for x in beside if x != new and a <= x <= b]
            best = abs(value)
            for x, state in zip(beside, dense(np.array(beside))):
                found = abs(event(x, state))
                if found < best:
                    best, new = found, x
            return new
        if (value > 0.0) == rising:
            b = new
        else:
            a = new
        points = [*points[-2:], (new, value)]
        steps.append(step)
    return 0.5 * (a + b)


def _interpolated_zero(points: list[tuple[float, float]]) -> float:
    """The zero by inverse interpolation of two or three (time, value); NaN if values are equal."""
    (b, fb), (c, fc) = points[-2:]
    if fb == fc:
        return math.nan
    secant = c - fc * (c - b) / (fc - fb)
    if len(points) == 2:
        return secant
    a, fa = points[0]
    if fa in (fb, fc):
        return math.nan
    other = b - fb * (b - a) / (fb - fa)
    return secant - fc * (secant - other) / (fc - fa)
