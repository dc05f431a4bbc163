"""Controllers: functions of the user that return generalised forces, evaluated and checked.

:class:`HeldForce` is the controller of sampled runs: it holds a force from one sample to the next,
as a digital controller holds its outputs.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.errors import ControllerError, InputError, raised, safe_repr, time_text
from srm_mbs.model.mechanism import MechanismData
from srm_mbs.model.numbers import real_array


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
"""(t, q, v) -> generalised forces tau (nv,), N and N m, or a mapping of joint names to theirs."""


def evaluate_controller(
    controller: Controller, mechanism: MechanismData, t: float, q: FloatArray, v: FloatArray
) -> FloatArray:
    """Generalised forces (nv,) of ``controller``, which gets copies of ``q`` and ``v`` and may
    return the same object every time.

    Of a mapping {joint: force}, the force is a number for a joint of one degree of freedom and an
    array (joint.nv,) for the others; joints that it does not name have none.

    Raises
    ------
    ControllerError
        If it raises, or returns anything but nv finite numbers or finite forces of known joints.
    """
    name = "the controller"
    given = _output(name, controller, t, q, v)
    if isinstance(given, Mapping):
        return forces_of_joints(given, mechanism, t, "the controller's force")
    result = _numbers(given, len(v))
    if not isinstance(result, str):
        return result
    raise ControllerError(
        f"{name} returned {result} at t = {time_text(t)} s; it must return {len(v)} finite "
        "generalised forces, or a mapping of joint names to them",
        t,
    )


def forces_of_joints(
    given: Mapping[Any, Any], mechanism: MechanismData, t: float, what: str
) -> FloatArray:
    """The mapping {joint: force} as generalised forces (nv,), N and N m, at ``t`` (s).

    The force is a number for a joint of one degree of freedom and an array (joint.nv,) for the
    others; joints that are not named have none.  Messages call a force ``what``.

    Raises
    ------
    ControllerError
        For a joint that is not known, or a force that is not finite or has another shape.
    """
    tau = np.zeros(mechanism.model.nv)
    for name, force in given.items():
        own_name = f"{what} of the joint {safe_repr(name)}"
        try:
            joint = mechanism.joint(name)
        except InputError as error:
            raise ControllerError(f"{own_name} at t = {time_text(t)} s: {error}", t) from error
        own = _numbers(force, joint.nv, scalar=True)
        if isinstance(own, str):
            wanted = "a finite number" if joint.nv == 1 else f"{joint.nv} finite numbers"
            raise ControllerError(
                f"{own_name} is given as {own} at t = {time_text(t)} s; it must be {wanted}", t
            )
        tau[joint.idx_v : joint.idx_v + joint.nv] = own
    return tau


def evaluate_callback(
    name: str,
    function: Controller,
    size: int,
    values: str,
    t: float,
    q: FloatArray,
    v: FloatArray,
) -> FloatArray:
    """The result (size,) of a function of the user, which gets copies of ``q`` and ``v``; messages
    name the function and its ``values``.

    Raises
    ------
    ControllerError
        If it raises, or returns anything but ``size`` finite numbers.
    """
    result = _numbers(_output(name, function, t, q, v), size)
    if not isinstance(result, str):
        return result
    raise ControllerError(
        f"{name} returned {result} at t = {time_text(t)} s; it must return {size} finite {values}",
        t,
    )


def _output(name: str, function: Controller, t: float, q: FloatArray, v: FloatArray) -> Any:
    """The result of ``function``, unchecked."""
    try:
        return function(t, q.copy(), v.copy())
    except ControllerError:  # of a controller of this package, whose message is complete
        raise
    except Exception as error:
        raise ControllerError(raised(name, error, f"at t = {time_text(t)} s"), t) from error


def _numbers(given: Any, size: int, scalar: bool = False) -> FloatArray | str:
    """A copy of ``given`` as ``size`` finite numbers, or what it is instead; a ``scalar`` is one
    number without an axis as well."""
    try:
        result = real_array(given)
    except Exception:  # objects may raise anything
        return safe_repr(given)
    if scalar and size == 1 and result.ndim == 0:
        result = result.reshape(1)
    if result.ndim == 0:
        return safe_repr(given)
    if result.shape != (size,):
        return f"an array of shape {result.shape}"
    if not np.isfinite(result).all():
        return "values that are not finite"
    return result
