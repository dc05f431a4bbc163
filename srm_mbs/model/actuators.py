"""Actuators as immutable data: motors and servos on joints, which a controller commands by name.

A mechanism lists its actuators; none of them acts by itself.
:func:`srm_mbs.actuator_controller` evaluates them.

The fields of :class:`Actuator` are the one list of the keys of an actuator: descriptions
(:mod:`srm_mbs.formats.toml.schema`), saved runs (:mod:`srm_mbs.simulation.storage`) and tables
read them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs.errors import InputError, safe_repr
from srm_mbs.model.anchors import one_degree_joint, turn_counting_joint
from srm_mbs.model.copies import short_repr
from srm_mbs.model.numbers import finite_array, named_values, plain

ActuatorType = Literal["motor", "position", "velocity"]
ACTUATOR_TYPES: tuple[str, ...] = get_args(ActuatorType)
INSTEAD = "Name a joint with one degree of freedom"


@dataclass(frozen=True, repr=False)
class Actuator:
    """A motor or servo on a joint with one degree of freedom, as MuJoCo has them.

    The control u acts on the joint with the generalised force tau (N m; prismatic: N)::

        tau = gear f,   f = clip(gain clip(u, control_range) + bias - kp l - kv dl/dt, force_range)
        l = gear (q + reference)

    Parameters
    ----------
    joint
        Name of a revolute or prismatic joint; a continuous one, whose angle (cos, sin) does not
        count turns, takes no ``kp``.
    type
        ``motor``: u is a force; ``position``: a desired l; ``velocity``: a desired dl/dt.
    gear
        Ratio of the transmission, not zero.
    kp, kv
        Stiffness and damping of the servo, per unit of l and of dl/dt.  A position servo needs kp,
        a velocity servo kv.
    gain
        Force of one unit of the control; by default 1 for motors, kp for position and kv for
        velocity servos.
    bias
        Force without control, position and rate.
    damping_ratio
        Instead of kv of a position servo: kv = 2 damping_ratio sqrt(kp m), where m is the inertia
        M_jj / gear^2 that the joint moves at its zero configuration.  A mechanism replaces it by
        kv.
    reference
        Joint position (rad, m) of MuJoCo at q = 0.
    control_range, force_range : (2,)
        Lowest and highest u and f; None: unlimited.

    Raises
    ------
    InputError
        For an unknown type, a number that is not finite, a range that decreases, or a servo without
        its gain.
    """

    joint: str
    type: ActuatorType = "motor"
    gear: float = 1.0
    kp: float = 0.0
    kv: float = 0.0
    gain: float | None = None
    bias: float = 0.0
    damping_ratio: float = 0.0
    reference: float = 0.0
    control_range: Sequence[float] | None = field(default=None, metadata={"count": 2})
    force_range: Sequence[float] | None = field(default=None, metadata={"count": 2})

    __repr__ = short_repr

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        if not isinstance(self.joint, str):
            raise self._fault(
                f"joint = {safe_repr(self.joint)} is not a name", "Give the name of a joint"
            )
        set_(self, "joint", plain(self.joint))
        if not isinstance(self.type, str) or self.type not in ACTUATOR_TYPES:
            known = ", ".join(ACTUATOR_TYPES)
            raise self._fault(f"there is no type {safe_repr(self.type)}", f"Give one of {known}")
        set_(self, "type", plain(self.type))
        for entry in fields(self):
            if entry.name in ("joint", "type") or getattr(self, entry.name) is None:
                continue
            set_(self, entry.name, self._numbers(entry.name, entry.metadata.get("count", 0)))
        if self.gear == 0.0:
            raise self._fault("gear is zero", "Give the ratio of the transmission")
        if self.damping_ratio and (self.type != "position" or self.kv or self.damping_ratio < 0.0):
            raise self._fault(
                "damping_ratio is not a positive number of a position servo without kv", "Give kv"
            )
        if self.damping_ratio and self.kp < 0.0:
            raise self._fault("kp is negative, which has no damping_ratio", "Give kv")
        for kind, key in (("position", "kp"), ("velocity", "kv")):
            if self.type == kind and not getattr(self, key):
                raise self._fault(f"a {kind} servo has no {key}", f"Give {key}")

    def _numbers(self, key: str, count: int) -> float | tuple[float, ...]:
        """The field ``key``: a finite number, or a range."""
        given = getattr(self, key)
        numbers = finite_array(given, (count,) if count else ())
        wanted = "two finite numbers that do not decrease" if count else "a finite number"
        if numbers is None or (count and numbers[0] > numbers[1]):
            raise self._fault(f"{key} = {safe_repr(given)} is not {wanted}", f"Give {wanted}")
        return tuple(numbers.tolist()) if count else float(numbers)

    def _fault(self, problem: str, remedy: str) -> InputError:
        return InputError(problem, element="actuator", remedy=remedy)

    @property
    def control_gain(self) -> float:
        """Force of one unit of the control."""
        if self.gain is not None:
            return self.gain
        return {"motor": 1.0, "position": self.kp, "velocity": self.kv}[self.type]

    def check(self, model: pin.Model) -> None:
        """Refuse a joint that ``model`` does not have or that cannot take the actuator.

        Raises
        ------
        InputError
            Naming the joint and the remedy.
        """
        kind = turn_counting_joint if self.kp else one_degree_joint
        kind(model, self.joint, "actuator", INSTEAD)

    def measured(self, model: pin.Model) -> Actuator:
        """The actuator with kv in place of ``damping_ratio``."""
        if not self.damping_ratio:
            return self
        at = model.joints[model.getJointId(self.joint)].idx_v
        inertia = pin.crba(model, workspace(model), pin.neutral(model))[at, at] / self.gear**2
        kv = 2.0 * self.damping_ratio * float(np.sqrt(self.kp * inertia))
        return replace(self, kv=kv, damping_ratio=0.0)


def checked_actuators(model: pin.Model, given: Any) -> dict[str, Actuator]:
    """The actuators of a mechanism by name.

    Raises
    ------
    InputError
        Unless every name is a text and every value an actuator on a joint of ``model``.
    """
    found: dict[str, Actuator] = {}
    for name, actuator in named_values(given, "actuators").items():
        if not isinstance(name, str) or not name or not isinstance(actuator, Actuator):
            raise InputError(
                f"{safe_repr(name)}: {safe_repr(actuator)} is not a name and an actuator",
                element="actuators",
                remedy='Give for example {"hip": srm.Actuator("hip_joint", "motor")}',
            )
        with naming_actuator(name):
            actuator.check(model)
        found[name] = actuator.measured(model)
    return found


@contextmanager
def naming_actuator(name: str) -> Iterator[None]:
    """Errors about an actuator name it."""
    try:
        yield
    except InputError as error:
        if error.element == "actuator":
            error.element = f"actuator {safe_repr(name)}"
        raise
