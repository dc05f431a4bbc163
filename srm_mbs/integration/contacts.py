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

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.scaling import Units
from srm_mbs.dynamics.system import System
from srm_mbs.errors import EvaluationError
from srm_mbs.integration.events import EventFunction
from srm_mbs.integration.methods.near_singular import LARGEST_ZONE_SIGMA

VALUE_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Change of time and state, over their sizes and units, by which the rounding of a value is
measured: rounding of positions accumulates over the steps of a segment."""
PROBE_TIME = 1e-5
"""Time d over which the change of a value is measured, over the characteristic time, or over the
length of a shorter run."""
RESTING_SHARE = 1e-3
"""e' d, over e'' d^2 / 2, below which a contact rests: an action may leave that much of a rate."""


@dataclass(frozen=True)
class Contact:
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
    """Examines contacts.

    Parameters
    ----------
    system
        The equations of motion.
    units
        Units of the mechanism.
    span
        Length of the run (s).
    """

    def __init__(self, system: System, units: Units, span: float) -> None:
        self._system = system
        self._scale = units.motion
        self._time = PROBE_TIME * min(1.0 / units.rate, span)

    def rounding(
        self, event: EventFunction, t: float, state: FloatArray, value: float | None = None
    ) -> float:
        """Change of the ``value`` of ``event`` at ``t`` (s) and ``state`` (nx,) when they change by
        rounding.

        Raises
        ------
        EventError
            If the event function fails; so does :meth:`contact`.
        """
        here = event(t, state.copy()) if value is None else value
        changes = []
        size = self._scale.size
        for signs in _signs(max(size, state.size)):
            scaled = state * (1.0 + VALUE_ROUNDING * signs[: state.size])
            x = self._system.retract(scaled, VALUE_ROUNDING * self._scale * signs[:size])
            changes.append(event(t * (1.0 - VALUE_ROUNDING), x) - here)
        return max(map(abs, changes))

    def _rates(self, t: float, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Velocity and acceleration (nv,); zero for an acceleration that cannot be evaluated, or
        that is not accurate, next to a singular configuration."""
        nv = self._system.multiplier_size
        v, a = state[-nv:], np.zeros(nv)
        try:
            terms = self._system.evaluate(t, state)
            if terms.sigma > LARGEST_ZONE_SIGMA:
                a = terms.rate()[nv:].copy()
        except EvaluationError:
            pass
        return v, a

    def contact(
        self,
        event: EventFunction,
        t: float,
        state: FloatArray,
        zero: float,
        slack: float,
        floor: float,
    ) -> Contact | None:
        """The contact of ``event`` at ``t`` (s) and ``state`` (nx,); None if it does not touch.

        Parameters
        ----------
        zero, slack
            Sizes of values that are zero on both sides, and on the forbidden one.
        floor
            Size of changes that are rounding, whatever the rounding of the value.
        """
        value = event(t, state.copy())
        rounding = max(self.rounding(event, t, state, value), floor)
        forbidden = event.direction * value > 0.0
        if abs(value) > max(rounding, zero, slack if forbidden else 0.0):
            return None
        v, a = self._rates(t, state)
        near, far = (
            event(t + d, self._system.retract(state, np.concatenate([d * v + half * a, d * a])))
            - value
            for d, half in ((k * self._time, 0.5 * (k * self._time) ** 2) for k in (1.0, 2.0))
        )
        first, second = 2.0 * near - 0.5 * far, 0.5 * far - near
        allowed = -1.0 if event.direction > 0.0 else 1.0
        resting = max(rounding, RESTING_SHARE * abs(second))
        rate = 0 if abs(first) <= resting else int(np.sign(allowed * first))
        departs = 0 if abs(far) <= rounding else int(np.sign(allowed * far))
        return Contact(rate or departs, rate)


@lru_cache(maxsize=64)
def _signs(size: int) -> FloatArray:
    """Signs (k, size) of changes by rounding; any two numbers change apart in one of the rows."""
    numbers = np.arange(size)
    return np.array(
        [1.0 - 2.0 * (numbers >> bit & 1) for bit in range(max(size - 1, 1).bit_length())]
    )
