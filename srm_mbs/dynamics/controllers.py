"""Controllers: functions of the user that return generalised forces, evaluated and checked.

:class:`HeldForce` is the controller of sampled runs: it holds a force from one sample to the next,
as a digital controller holds its outputs.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import ControllerError, safe_repr


class HeldForce:
    """Generalised forces that are constant from one sample to the next, right-continuous.

    A controller: at any time of a run, during it or afterwards, it returns the force that acted
    then.
    """

    def __init__(self) -> None:
        self.times: list[float] = []
        self.values: list[FloatArray] = []

    def hold(self, t: float, force: FloatArray) -> None:
        """``force`` (nv,), N and N m, acts from ``t`` (s) on, which is later than all before."""
        self.times.append(t)
        self.values.append(force)

    def only(self, force: FloatArray) -> None:
        """``force`` (nv,) acts at all times."""
        self.times, self.values = [-math.inf], [force]

    def __call__(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """The force (nv,) at ``t``."""
        if t >= self.times[-1]:
            return self.values[-1]
        return self.values[max(0, bisect_right(self.times, t) - 1)]


Controller = Callable[[float, FloatArray, FloatArray], Any]
"""(t, q, v) -> generalised forces tau (nv,), N and N m."""


def evaluate_controller(
    controller: Controller, t: float, q: FloatArray, v: FloatArray
) -> FloatArray:
    """Generalised forces (nv,) of ``controller``, which gets copies of ``q`` and ``v`` and may
    return the same array every time.

    Raises
    ------
    ControllerError
        If it raises, or returns anything but nv finite numbers.
    """
    return evaluate_callback("the controller", controller, len(v), "generalised forces", t, q, v)


def evaluate_callback(
    name: str,
    function: Controller,
    size: int,
    values: str,
    t: float,
    q: FloatArray,
    v: FloatArray,
) -> FloatArray:
    """The result (size,) of a function of the user, as for :func:`evaluate_controller`; messages
    name the function and its ``values``."""
    try:
        result = np.array(function(t, q.copy(), v.copy()), dtype=float, order="C")
    except Exception as error:
        raise ControllerError(f"{name} raised {safe_repr(error)} at t = {t:.6g} s", t) from error
    if result.shape != (size,):
        problem = f"an array of shape {result.shape}"
    elif not np.isfinite(result).all():
        problem = "values that are not finite"
    else:
        return result
    raise ControllerError(
        f"{name} returned {problem} at t = {t:.6g} s; it must return {size} finite {values}", t
    )
