"""What follows from a description, made once when it is first asked for, and kept."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any


class Derivations:
    """Base of :class:`~srm_mbs.mechanism.Mechanism`: what others derive from it, by name."""

    @cached_property
    def _derived(self) -> dict[str, Any]:
        return {}

    @cached_property
    def _of_start(self) -> dict[str, Any]:
        return {}

    def derived(self, name: str, make: Callable[[], Any]) -> Any:
        """What follows from the model alone, made once and kept under ``name``.

        It is shared with every :meth:`with_state`, so it must not depend on the initial state, and
        nothing may change it.
        """
        if name not in self._derived:
            self._derived[name] = make()
        return self._derived[name]

    def at_start(self, name: str, make: Callable[[], Any]) -> Any:
        """As :meth:`derived`, for what depends on the initial state as well."""
        if name not in self._of_start:
            self._of_start[name] = make()
        return self._of_start[name]
