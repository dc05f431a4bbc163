"""Forces of actuators: a controller that turns controls, by the names of actuators, into tau."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism, check_mechanism
from srm_mbs.errors import ControllerError, InputError, known_names, safe_repr, time_text
from srm_mbs.model.numbers import finite_array, named_values

Controls = Mapping[str, Any]
"""Name of an actuator -> its control: a number, or a function of t (s) that returns one."""


class ActuatorController:
    """The controller of :func:`actuator_controller`."""

    def __init__(self, mechanism: Mechanism, given: Controls | Callable[..., Controls]) -> None:
        actuators = list(mechanism.actuators.values())
        self._names = tuple(mechanism.actuators)
        self._law = given if callable(given) else None
        self._constant = np.zeros(len(self._names))
        self._functions: dict[int, Callable[[float], Any]] = {}
        if self._law is None:
            self._take(named_values(given, "controls"))
        joints = [mechanism.joint(actuator.joint) for actuator in actuators]
        self._nv = int(mechanism.model.nv)
        self._at_q = np.array([joint.idx_q for joint in joints], dtype=int)
        self._at_v = np.array([joint.idx_v for joint in joints], dtype=int)
        self._gear, self._gain, self._bias, self._kp, self._kv, self._reference = np.array(
            [(a.gear, a.control_gain, a.bias, a.kp, a.kv, a.reference) for a in actuators]
        ).T
        unlimited = (-math.inf, math.inf)
        self._control_range, self._force_range = (
            np.array([getattr(a, key) or unlimited for a in actuators], dtype=float).T
            for key in ("control_range", "force_range")
        )

    def _take(self, controls: Mapping[str, Any]) -> None:
        """Check and store controls that are numbers or functions of t."""
        for name, value in controls.items():
            if not isinstance(name, str) or name not in self._names:
                raise InputError(
                    f"there is no actuator {safe_repr(name)}",
                    element="controls",
                    remedy=known_names(self._names),
                )
            at, number = self._names.index(name), finite_array(value, ())
            if number is not None:
                self._constant[at] = number
            elif callable(value):
                self._functions[at] = value
            else:
                raise InputError(
                    f"{safe_repr(value)} is neither a finite number nor a function of t",
                    element=f"the control of {safe_repr(name)}",
                    remedy="Give a number, or a function of t (s) that returns one",
                )

    def _controls(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """The controls (actuators,) before they are clipped."""
        out = self._constant.copy()
        for at, function in self._functions.items():
            name = self._names[at]
            try:
                value = function(t)
            except Exception as error:
                raise ControllerError(
                    f"the control of the actuator {safe_repr(name)}, a function of t, raised "
                    f"{safe_repr(error)} at t = {time_text(t)} s",
                    t,
                ) from error
            out[at] = _control(name, value, t)
        if self._law is None:
            return out
        given = self._law(t, q, v)
        if not isinstance(given, Mapping):
            raise ControllerError(
                f"the function of the controls returned {safe_repr(given)} at t = {time_text(t)} "
                "s; it must return a mapping of the names of actuators to numbers",
                t,
            )
        for name, value in given.items():
            if not isinstance(name, str) or name not in self._names:
                raise ControllerError(
                    f"the function of the controls names the actuator {safe_repr(name)} at "
                    f"t = {time_text(t)} s, which does not exist. {known_names(self._names)}",
                    t,
                )
            out[self._names.index(name)] = _control(name, value, t)
        return out

    def __call__(self, t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        """Generalised forces (nv,), N and N m, of the actuators at t (s), q (nq,), v (nv,)."""
        q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
        control = np.clip(self._controls(t, q, v), *self._control_range)
        length = self._gear * (q[self._at_q] + self._reference)
        rate = self._gear * v[self._at_v]
        force = self._gain * control + self._bias - self._kp * length - self._kv * rate
        tau = np.zeros(self._nv)
        # Several actuators may act on one joint.
        np.add.at(tau, self._at_v, self._gear * np.clip(force, *self._force_range))
        return tau


def _control(name: str, value: Any, t: float) -> float:
    """A control that a function of the user returned."""
    number = finite_array(value, ())
    if number is None:
        raise ControllerError(
            f"the control of the actuator {safe_repr(name)} is {safe_repr(value)} at t = "
            f"{time_text(t)} s; it must be a finite number",
            t,
        )
    return float(number)


def actuator_controller(
    mechanism: Mechanism, controls: Controls | Callable[..., Controls] | None = None
) -> ActuatorController:
    """The controller that applies controls to the actuators of a mechanism, by their names.

    Parameters
    ----------
    mechanism
        With :attr:`~srm_mbs.Mechanism.actuators`; its state does not matter.
    controls
        Name of an actuator -> its control u, a number or a function of t (s); or one function of
        (t, q, v) that returns such a mapping of numbers.  The unit of u is that of
        :class:`srm_mbs.Actuator`.  As in MuJoCo, all actuators act, and u is 0 where none is given:
        a position servo without control holds its joint at zero.

    Returns
    -------
    controller
        A function of (t, q, v) that returns tau (nv,), N and N m, for ``controller=`` of
        :func:`srm_mbs.simulate` and for :meth:`srm_mbs.Simulator.step`.

    Raises
    ------
    InputError
        If the mechanism has no actuators, or a control names none of them or is neither a finite
        number nor a function.  A function that returns anything else than finite numbers of known
        actuators makes the run fail as any controller does.
    """
    check_mechanism(mechanism)
    if not mechanism.actuators:
        raise InputError(
            f"the mechanism {mechanism.name!r} has no actuators",
            element="actuators",
            remedy='Give them, as srm.Mechanism(..., actuators={"hip": srm.Actuator("hip_joint")}) '
            "or in [actuators] of its description",
        )
    return ActuatorController(mechanism, {} if controls is None else controls)
