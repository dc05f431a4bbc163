"""Events and contacts of mechanisms, searched for by the compiled kernel."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.scaling import Units
from srm_mbs.dynamics.system import System
from srm_mbs.integration.contacts import ContactProbe, rounding_changes
from srm_mbs.integration.events import (
    EventFunction,
    Stop,
    examined_fractions,
    read_nodes,
    stop_message,
)
from srm_mbs.integration.kernel import marshalling
from srm_mbs.integration.kernel.run import CompiledStepDense
from srm_mbs.integration.kernel.system import Evaluator
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.methods.near_singular import LARGEST_ZONE_SIGMA
from srm_mbs.model.lazy import cached_property


class CompiledEventWatch:
    """:class:`~srm_mbs.integration.events.EventWatch` of a run of the kernel.

    Parameters
    ----------
    scheme, events
        As for that; the functions are
        :class:`~srm_mbs.integration.events.MechanismFunction` objects.
    nq, nv
        Sizes of the mechanism.
    """

    def __init__(
        self, scheme: ButcherTableau, events: Sequence[EventFunction], nq: int, nv: int
    ) -> None:
        self._events, self._size = tuple(events), nq + nv
        self._search = core.EventWatch(  # type: ignore[union-attr]
            self._events,
            read_nodes,
            nq,
            nv,
            examined_fractions(scheme),
            marshalling.event_constants(),
        )

    def begin(self, t: float, state: FloatArray) -> None:
        """As the reference."""
        self._search.begin(t, state)

    def after_step(
        self, t: float, t_new: float, end: FloatArray, dense: CompiledStepDense
    ) -> Stop | None:
        """As the reference."""
        found = self._search.after_step(t, t_new, end, dense.compiled, dense.by_reference)
        if found is None:
            return None
        time, event, count, stopped = found
        return Stop(time, stopped, stop_message(self._events[event].name, count, time))

    def found(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """As the reference."""
        return self._search.found(*_nothing(self._size))  # type: ignore[no-any-return]


@lru_cache(maxsize=64)
def _nothing(size: int) -> tuple[FloatArray, FloatArray]:
    """Times and states of an event that does not occur."""
    return np.zeros(0), np.zeros((0, size))


class _CompiledContactProbe(ContactProbe):
    """A probe whose states and values the kernel system of ``evaluator`` computes."""

    def __init__(
        self, evaluator: Evaluator, units: Units, span: float, t: float, state: FloatArray
    ) -> None:
        super().__init__(evaluator.system, units, span, t, state)
        self._kernel_system, self._nq = evaluator.kernel_system, evaluator.system.nq
        self._arguments = evaluator.system, units, span, t, state

    def __reduce__(self) -> tuple[Any, ...]:
        # Without the workspace.
        return ContactProbe, self._arguments

    def _rounded(self, state: FloatArray) -> FloatArray:
        changes = rounding_changes(max(self._scale.size, state.size))
        return self._kernel_system.changed_states(state, self._scale, changes)  # type: ignore[no-any-return]

    @cached_property
    def _ahead(self) -> FloatArray:
        return self._kernel_system.states_ahead(  # type: ignore[no-any-return]
            self._t, self._state, self._time, LARGEST_ZONE_SIGMA
        )

    def _values(
        self, event: EventFunction, times: Sequence[float], states: FloatArray
    ) -> list[float]:
        found: list[float] = core.event_values(event, self._nq, times, states)  # type: ignore[union-attr]
        return found


def contact_probe(
    system: System | Evaluator, units: Units, span: float, t: float, state: FloatArray
) -> ContactProbe:
    """A :class:`~srm_mbs.integration.contacts.ContactProbe`, whose parameters these are, on the
    kernel if that evaluates ``system``."""
    if isinstance(system, Evaluator):
        return _CompiledContactProbe(system, units, span, t, state)
    return ContactProbe(system, units, span, t, state)
