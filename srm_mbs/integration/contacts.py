r"""Touching contacts: events whose value is zero where a run or a segment of it begins.

The sides of a *contact*, an event with an action and a direction, are the allowed one, which it is
left from, and the forbidden one, on which the direction ends.  Zeros are located between two
states, so the search of :mod:`srm_mbs.integration.events` does not see a contact that touches at
the start of a segment and leaves at once to the forbidden side.  Such a contact acts at once
(:class:`ContactProbe`), before any step.

The value over time, e(t + d) = e + e' d + e'' d^2 / 2, is measured along the motion
q (+) (d v + d^2 a / 2), v + d a, at two times d that are short for the mechanism.  Sizes below the
rounding of the value, its change when time and state change by rounding, are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.scaling import Units
from srm_mbs.dynamics.system import System
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.events import EventFunction
from srm_mbs.integration.methods.near_singular import LARGEST_ZONE_SIGMA
from srm_mbs.model.lazy import cached_property

VALUE_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Change of time and state, over their sizes and units, by which the rounding of a value is
measured: rounding of positions accumulates over the steps of a segment."""
PROBE_TIME = 1e-5
"""Time d over which the change of a value is measured, over the characteristic time, or over the
length of a shorter run."""
RESTING_SHARE = 1e-3
"""e' d, over e'' d^2 / 2, below which a contact rests: an action may leave that much of a rate."""


class Contact(NamedTuple):
    """A contact that touches.

    Attributes
    ----------
    departs
        1 if the motion leaves to the allowed side, -1 to the forbidden one, 0 if it rests.
    rate
        The same of e' alone.
    """

    departs: int
    rate: int


class ContactProbe:
    """Examines contacts at a time and a state.

    Parameters
    ----------
    system
        The equations of motion.
    units
        Units of the mechanism.
    span
        Length of the run (s).
    t, state
        The time (s) and the state (nx,).
    """

    def __init__(
        self, system: System, units: Units, span: float, t: float, state: FloatArray
    ) -> None:
        self._system, self._t, self._state = system, t, state
        self._scale = units.state
        self._time = PROBE_TIME * min(1.0 / units.rate, span)

    def rounding(self, event: EventFunction, t: float, state: FloatArray) -> float:
        """Change of the value of ``event`` at ``t`` (s) and ``state`` (nx,), which may be others,
        when they change by rounding.

        Raises
        ------
        EventError
            If the event function fails; so does :meth:`contact`.
        """
        return self._rounded_value(event, t, self._rounded(state))[1]

    def _rounded_value(
        self, event: EventFunction, t: float, states: FloatArray
    ) -> tuple[float, float]:
        """The value of ``event`` at ``t`` (s) and the first of ``states``, and its largest change
        when ``t`` and the state change by rounding, to the others."""
        times = [t, *[t * (1.0 - VALUE_ROUNDING)] * (len(states) - 1)]
        value, *others = self._values(event, times, states)
        return value, max([abs(other - value) for other in others])

    def _values(
        self, event: EventFunction, times: Sequence[float], states: FloatArray
    ) -> list[float]:
        return [event(t, x.copy()) for t, x in zip(times, states)]

    def _rounded(self, state: FloatArray) -> FloatArray:
        """``state``, and it changed by rounding in several directions (1 + k, nx)."""
        size, retract = self._scale.size, self._system.retract
        changes = rounding_changes(max(size, state.size))
        scaled = state * (1.0 + changes[:, : state.size])
        return np.array([state, *map(retract, scaled, self._scale * changes[:, :size])])

    @cached_property
    def _beside(self) -> FloatArray:
        return self._rounded(self._state)

    @cached_property
    def _ahead(self) -> FloatArray:
        """States (2, nx) of the motion from here; without acceleration where that cannot be
        evaluated, or is not accurate, next to a singular configuration."""
        t, state, system = self._t, self._state, self._system
        nv, retract = system.multiplier_size, system.retract
        v, a = state[-nv:], np.zeros(nv)
        try:
            terms = system.evaluate(t, state)
            if terms.sigma > LARGEST_ZONE_SIGMA:
                a = terms.rate()[nv:]
        except EvaluationError:
            pass
        return np.array(
            [
                retract(state, np.concatenate([d * v + 0.5 * d**2 * a, d * a]))
                for d in (self._time, 2.0 * self._time)
            ]
        )

    def contact(
        self, event: EventFunction, zero: float, slack: float, floor: float
    ) -> Contact | None:
        """The contact of ``event``; None if it does not touch.

        Parameters
        ----------
        zero, slack
            Sizes of values that are zero on both sides, and on the forbidden one.
        floor
            Size of changes that are rounding, whatever the rounding of the value.
        """
        t = self._t
        value, rounding = self._rounded_value(event, t, self._beside)
        rounding = max(rounding, floor)
        forbidden = event.direction * value > 0.0
        if abs(value) > max(rounding, zero, slack if forbidden else 0.0):
            return None
        near, far = self._values(event, (t + self._time, t + 2.0 * self._time), self._ahead)
        near, far = near - value, far - value
        first, second = 2.0 * near - 0.5 * far, 0.5 * far - near
        allowed = -1.0 if event.direction > 0.0 else 1.0
        resting = max(rounding, RESTING_SHARE * abs(second))
        rate = 0 if abs(first) <= resting else int(np.sign(allowed * first))
        departs = 0 if abs(far) <= rounding else int(np.sign(allowed * far))
        return Contact(rate or departs, rate)


@lru_cache(maxsize=64)
def rounding_changes(size: int) -> FloatArray:
    """Relative changes (k, size) by rounding; any two numbers change apart in one of the rows."""
    numbers = np.arange(size)
    bits = range(max(size - 1, 1).bit_length())
    return VALUE_ROUNDING * np.array([1.0 - 2.0 * (numbers >> bit & 1) for bit in bits])
