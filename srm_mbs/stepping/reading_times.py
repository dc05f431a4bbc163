"""Times at which a run is read."""

from __future__ import annotations

from typing import Any

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError

SLACK = 1e-12
"""Part of the time up to which a run is read beyond its ends, for rounding."""


def times_to_read(t: Any, *, scalar: bool = False) -> FloatArray:
    """``t`` (s) as a new array (k,), or () where a ``scalar`` is allowed.

    Raises
    ------
    InputError
        For more dimensions, or what are no numbers.
    """
    try:
        times = np.array(t, dtype=float)
    except (TypeError, ValueError):
        raise InputError(
            f"t = {t!r} does not consist of numbers", element="t", remedy="Give times (s)"
        ) from None
    if times.ndim != 1 and not (scalar and times.ndim == 0):
        kinds = "a scalar or a vector of times" if scalar else "a vector of times"
        raise InputError(f"t has shape {times.shape}", element="t", remedy=f"Give {kinds}")
    return times


def check_within(t: FloatArray, start: float, end: float) -> None:
    """Refuse times ``t`` (k,) outside a run from ``start`` to ``end`` (s).

    Raises
    ------
    InputError
        If there are such.
    """
    slack = SLACK * max(abs(start), abs(end))
    if len(t) and not (np.min(t) >= start - slack and np.max(t) <= end + slack):
        raise InputError(
            f"the run covers t = {start:.9g} to {end:.9g} s, "
            f"asked for are {np.min(t):.9g} to {np.max(t):.9g} s",
            element="t",
            remedy="Give times of the run",
        )
