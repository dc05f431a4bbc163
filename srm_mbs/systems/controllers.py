"""Controllers: functions of the user that return generalised forces, called and checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import ControllerError

Controller = Callable[[float, FloatArray, FloatArray], Any]
"""(t, q, v) -> generalised forces tau (nv,), N and N m."""


def called(controller: Controller, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
    """Generalised forces (nv,) of ``controller``, which gets copies of ``q`` and ``v`` and may
    return the same array every time.

    Raises
    ------
    ControllerError
        If it raises, or returns anything but nv finite numbers.
    """
    try:
        tau = np.array(controller(t, q.copy(), v.copy()), dtype=float, order="C")
    except Exception as error:
        raise ControllerError(f"the controller raised {error!r} at t = {t:.6g} s") from error
    trouble = unusable(tau, len(v))
    if trouble:
        raise ControllerError(
            f"the controller returned {trouble} at t = {t:.6g} s; it must return {len(v)} finite "
            "generalised forces"
        )
    return tau


def unusable(given: FloatArray, size: int) -> str:
    """What is wrong with an array that should be ``size`` finite numbers; empty if nothing is."""
    if given.shape != (size,):
        return f"an array of shape {given.shape}"
    return "" if np.isfinite(given).all() else "values that are not finite"
