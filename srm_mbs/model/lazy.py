"""Properties that are computed when they are first read.

A file of its own, because modules of every layer from here on import it.
"""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING or sys.version_info >= (3, 12):
    from functools import cached_property as cached_property
else:

    class cached_property(functools.cached_property):  # noqa: N801 - a decorator
        """As that of Python 3.12, without the lock of Python 3.11: all instances share it while a
        value is computed, and it costs more than most of the values.  Two threads that read one for
        the first time may both compute it."""

        def __get__(self, instance: Any, owner: type[Any] | None = None) -> Any:
            if instance is None:
                return self
            value = self.func(instance)
            object.__setattr__(instance, self.attrname, value)
            return value
