"""Runs with event actions, segment by segment."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from srm_mbs.actions import Switch
from srm_mbs.arrays import FloatArray
from srm_mbs.drives import positions
from srm_mbs.errors import EvaluationError, EventError, InputError, SimulationError
from srm_mbs.laws import Curve
from srm_mbs.mechanism import Mechanism
from srm_mbs.options import checked_times, positive
from srm_mbs.preparation import check_consistent
from srm_mbs.records import Request
from srm_mbs.segmented import SegmentedSolution
from srm_mbs.simulation import simulate
from srm_mbs.solution import Solution
from srm_mbs.stepping.events import Event, prepare_events, together
from srm_mbs.systems.consistent import onto_closures
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem, make_system

log = logging.getLogger(__name__)

MANY = 10
CHATTERS = 1e-8
"""An event that occurs MANY times within this part of the run chatters."""
HELD = 1e-9
"""Rounding of an event that closures hold at zero, over its values before."""
SNAPS = 1e-4
"""Largest motion (units) onto the closures of another mechanism: more is an inconsistent state."""
INTERRUPTED = "Interrupted at t = {:.6g} s; everything up to there is kept."
ON = 1e-13
"""Closure error that is rounding, in scaled rows, and over 1 + |v| that of rates."""
LEFT = 1e-12
"""Part of the run too short for another segment."""


class _Armed:
    """An event of the user, (t, q, v) -> float, within one segment."""

    def __init__(
        self,
        event: Any,
        prepared: Event,
        before: int,
        departs: bool,
        floor: float,
        guard: float | None,
    ) -> None:
        self._event = event
        self.__name__ = prepared.name.strip("'")
        self.direction = prepared.direction
        self.left = prepared.occurrences - before
        self.terminal = int(self.left) if math.isfinite(self.left) else None
        self.acts = getattr(event, "action", None) is not None
        self.departs = departs and floor == 0.0
        self.floor = floor
        self.guard = guard

    def __call__(self, t: float, q: FloatArray, v: FloatArray) -> Any:
        return self._event(t, q, v)


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


def simulate_segments(mechanism: Mechanism, t_end: float, options: dict[str, Any]) -> Solution:
    """:func:`srm_mbs.simulate` with events that have actions.

    Parameters
    ----------
    options
        All others of ``simulate``.
    """
    t_end = float(t_end)
    given = options["events"]
    events = [given] if callable(given) else list(given)
    prepared = prepare_events(given, lambda event: lambda t, x: 0.0)
    if options["t0"] == 0.0 and not (options["q0"] is None and options["v0"] is None):
        # Drives begin with this state.
        q0, v0 = options["q0"], options["v0"]
        mechanism = mechanism.with_state(
            mechanism.q0 if q0 is None else q0, mechanism.v0 if v0 is None else v0
        )
    t_eval = checked_times(options["t_eval"], options["t0"], t_end)
    asked = options["raise_on_failure"]
    here = options | {"t_eval": None, "raise_on_failure": False}
    if options["sample_time"] is not None and callable(options["controller"]):
        period = positive(options["sample_time"], "sample_time", " of seconds")
        here["controller"] = _Sampled(options["controller"], period)
    counts = [0] * len(events)
    last_times: list[list[float]] = [[] for _ in events]
    floors = [0.0] * len(events)
    parts: list[Solution] = []
    acted: list[int] = []
    guards: list[float | None] = [None] * len(events)
    t = float(options["t0"])
    span = t_end - t
    status, message = "", ""
    while not status:
        armed = [
            _Armed(event, prepared[i], counts[i], i in acted, floors[i], guards[i])
            for i, event in enumerate(events)
        ]
        try:
            solution = simulate(mechanism, t_end, **here | {"events": armed})
        except InputError as error:
            if not parts:
                raise
            status, message = "failed", f"Stopped at t = {t:.9g} s: after the action {error}."
            break
        except KeyboardInterrupt:
            if not parts:
                raise
            status, message = "interrupted", INTERRUPTED.format(t)
            break
        parts.append(solution)
        status, message = solution.status, solution.message
        found = solution.t_events or []
        counts = [n + len(times) for n, times in zip(counts, found)]
        t = solution.steps.end
        due = [i for i, times in enumerate(found) if len(times) and times[-1] == t]
        if status != "event" or any(len(found[i]) >= armed[i].left for i in due):
            break
        acted = [i for i in due if armed[i].acts]
        # What was counted here is not counted again just after; the rest has still to be.
        near = 2.0 * together(*solution.steps.times[-2:].tolist())
        guards = [near if len(times) and times[-1] >= t - near else 0.0 for times in found]
        try:
            names = [armed[i].__name__ for i in acted]
            log.debug("%s: action of %s at t = %.9g s", mechanism.name, ", ".join(names), t)
            mechanism, q, v = _after(solution, t, [(events[i], armed[i].__name__) for i in acted])
            switched = mechanism.loops != solution.mechanism.loops
            for i in acted:
                floors[i] = _rounding(events[i], solution) if switched else 0.0
                last_times[i] = [*last_times[i][1 - MANY :], t]
                _check_chatter(last_times[i], span, armed[i].__name__)
        except EventError as error:
            status = "failed"
            message = f"Stopped at t = {t:.9g} s: {error}. Everything up to there is kept."
            break
        except KeyboardInterrupt:
            status, message = "interrupted", INTERRUPTED.format(t)
            break
        here |= {"t0": t, "q0": q, "v0": v}
        status = "" if t_end - t > LEFT * span else "finished"
    if len(parts) > 1:
        message += f" Event actions divide the run into {len(parts)} segments."
    whole = SegmentedSolution(parts, t_eval=t_eval, status=status, message=message)
    whole.request = Request.of(t_end, options)
    if asked and not whole.success:
        raise SimulationError(message, whole)
    return whole


def _rounding(event: Callable[..., Any], solution: Solution) -> float:
    """Size of the value of an event that new closures hold at zero."""
    rows = zip(solution.t, solution.q, solution.v)
    return HELD * max(abs(float(event(t, q.copy(), v.copy()))) for t, q, v in rows)


def _check_chatter(times: list[float], span: float, name: str) -> None:
    if len(times) == MANY and times[-1] - times[0] < CHATTERS * span:
        raise EventError(
            f"the event {name!r} occurred {MANY} times within {times[-1] - times[0]:.1e} s: it "
            "chatters. Let its action hold what it hits (srm.Switch with a closure) when the "
            "impact is slow"
        )


def _closed(system: OpenSystem | ClosedSystem, t: float, x: FloatArray) -> bool:
    """Whether ``x`` is on the closures to rounding.  Moving it onto them would gain nothing, and
    next to a singular configuration take it off its branch by that rounding over sigma."""
    if not isinstance(system, ClosedSystem):
        return True
    g, c = system.residuals(x, t)
    speed = 1.0 + float(np.abs(x[system.nq :]).max())
    return bool((np.abs(g) < ON).all() and (np.abs(c) < ON * speed).all())


def _after(
    solution: Solution, t: float, actions: list[tuple[Any, str]]
) -> tuple[Mechanism, FloatArray, FloatArray]:
    """Mechanism and state after ``actions``, events with their names, at the end of a segment."""
    mechanism = solution.mechanism
    nq = mechanism.model.nq
    x = np.concatenate([solution.q[-1], solution.v[-1]])
    try:
        # The dense output is on the closures within the tolerance only.
        system = make_system(mechanism)
        if not _closed(system, t, x):
            x = onto_closures(system, t, x)
    except EvaluationError as error:
        raise EventError(f"no action could be taken: {error}") from error
    q, v = x[:nq], x[nq:]
    for event, name in actions:
        try:
            answer = event.action(t, q.copy(), v.copy())
        except Exception as error:
            raise EventError(f"the action of the event {name!r} raised {error!r}") from error
        if answer is None:
            continue
        try:
            if isinstance(answer, Switch):
                mechanism, q, v = _switched(mechanism, answer, t, q, v)
            else:
                q, v = (np.asarray(part, dtype=float) for part in answer)
                moved = mechanism.moved(q, v)
                check_consistent(moved, t)
                q, v = moved.q0, moved.v0
        except (InputError, EvaluationError, TypeError, ValueError) as error:
            raise EventError(
                f"the action of the event {name!r} cannot be carried out: {error}"
            ) from error
    return mechanism, q, v


def _curves_from(t: float, old: Mechanism, new: Mechanism) -> dict[str, Curve]:
    """The motions of the drives of ``new`` from ``t`` (s) on: those that ``old`` has go on, others
    engage where they find their coordinate, unless they prescribe positions."""
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
    new = new.with_state(q if switch.q is None else switch.q, v if switch.v is None else switch.v)
    new.__dict__["drive_curves"] = _curves_from(t, mechanism, new)
    given = np.concatenate([new.q0, new.v0])
    system = make_system(new)
    x = onto_closures(system, t, given)
    if system.size(system.difference(given, x)) > SNAPS:
        check_consistent(new, t)
    nq = new.model.nq
    return new, x[:nq], x[nq:]
