"""Force elements as immutable data; :mod:`srm_mbs.dynamics.forces` evaluates them.

``solution.energy`` contains the energy of springs and bushings; torques and wrenches have none.
Torques and wrenches may follow a law over time (:mod:`srm_mbs.model.laws`).

The fields of these classes are the one list of the keys of a force: descriptions
(:mod:`srm_mbs.formats.toml.schema`), saved runs (:mod:`srm_mbs.simulation.storage`) and tables
read them, with the units, lengths and bounds that :func:`quantity` gives them.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, counted, safe_repr
from srm_mbs.model.anchors import (
    Anchor,
    check_apart,
    moving_joint,
    name_places,
    one_degree_joint,
    resolve_moving,
    turn_counting_joint,
)
from srm_mbs.model.laws import Law, check_law
from srm_mbs.model.numbers import checked_name, finite_array, finite_numbers, plain


def quantity(
    unit: str, default: Any, *, nonnegative: bool = False, count: int = 0, needed: bool = False
) -> Any:
    """A numerical field of a force element, which the element checks and stores.

    Parameters
    ----------
    unit
        For tables; "N m, N": that for angles, then that for lengths.
    default
        Its default; None: the element decides.
    nonnegative
        Whether it must not be negative.
    count
        Length of a list of numbers; 0: one number.
    needed
        Whether a description must give it, because the element refuses the default.
    """
    facts = {"unit": unit, "nonnegative": nonnegative, "count": count, "needed": needed}
    return field(default=default, metadata=facts)


class ForceElement(ABC):
    """A force on the joints or links of a mechanism.

    Attributes
    ----------
    type
        Its type in a description.
    name
        Unique name; by default made from the type and what the element acts on.
    has_potential
        Whether its force at rest follows from a potential, which ``solution.energy`` contains.
    """

    type: ClassVar[str]
    has_potential: ClassVar[bool] = False
    name: str

    @abstractmethod
    def check(self, model: pin.Model) -> None:
        """Refuse a joint, link or frame that ``model`` does not have or that cannot take the force.

        Raises
        ------
        InputError
            Naming the element and the remedy.
        """

    @property
    def _element(self) -> str:
        """Its name in messages."""
        named = isinstance(self.name, str) and self.name
        return f"force {safe_repr(named or self.type)}"

    def _fault(self, problem: str, remedy: str) -> InputError:
        return InputError(problem, element=self._element, remedy=remedy)

    def _set(self, key: str, value: Any) -> None:
        object.__setattr__(self, key, value)

    def _take_name(self, *places: str) -> None:
        """The default name, if none is given."""
        name, *others = (checked_name(name, self._element) for name in (self.name, *places))
        self._set("name", name or "_".join((self.type, *others)))

    def _take_number(self, key: str, count: int, nonnegative: bool = False) -> None:
        """Check a number (``count`` 0) or ``count`` numbers and store them as float or tuple."""
        given = getattr(self, key)
        wanted = f"a list of {count} finite numbers" if count else "a finite number"
        numbers = finite_array(given, (count,) if count else ())
        if numbers is None:
            raise self._fault(f"{key} = {safe_repr(given)} is not {wanted}", f"Give {wanted}")
        if nonnegative and numbers.min() < 0.0:
            raise self._fault(f"{key} = {safe_repr(given)} is negative", "Give a value >= 0")
        self._set(key, tuple(numbers.tolist()) if count else float(numbers))

    def _take_quantities(self) -> None:
        """Check and store every :func:`quantity` that is not None."""
        for key in fields(self):  # type: ignore[arg-type]
            if "unit" in key.metadata and getattr(self, key.name) is not None:
                self._take_number(key.name, key.metadata["count"], key.metadata["nonnegative"])

    def _refuse_zeros(self, *keys: str) -> None:
        """Refuse an element without effect: all its quantities ``keys`` are zero."""
        if not any(np.any(getattr(self, key)) for key in keys if getattr(self, key) is not None):
            *others, last = keys
            raise self._fault(
                f"{', '.join(others)} and {last} are zero",
                "Give one of them, or remove the element",
            )

    def _take_law(self, count: int) -> tuple[Law, ...]:
        """Check the field ``law``, one law or ``count`` of them; returns them, () for None."""
        law = getattr(self, "law")  # noqa: B009 - a field of subclasses
        if law is None:
            return ()
        laws = tuple(law) if isinstance(law, list | tuple) else (law,)
        if len(laws) not in (1, count) or not all(isinstance(each, Law) for each in laws):
            several = f" or a list of {count}" if count > 1 else ""
            raise self._fault(f"law is not a law{several}", "Give srm.Sine(...) or alike")
        for each in laws:
            check_law(each)
        self._set("law", laws[0] if len(laws) == 1 else laws)
        return laws


@dataclass(frozen=True)
class UserForce(ForceElement):
    """A force given by a Python function, which is called at every stage of every step.

    It should be smooth; where it is not, give the times as ``breakpoints`` to
    :func:`srm_mbs.simulate`.  The compiled kernel calls back for it, which costs most of its speed.
    It is not saved with a run, and no description has it.

    Parameters
    ----------
    function
        (t, q, v) -> generalised forces (nv,), N and N m; with ``at`` -> (6,), force (N) then moment
        (N m) on the link at the anchor's origin, in world axes.
    at
        An anchor on a moving link, or None.
    name
        Unique name; by default that of the function.

    Raises
    ------
    InputError
        If ``function`` cannot be called, or ``at`` is no anchor.
    """

    type: ClassVar[str] = "user"
    function: Callable[[float, FloatArray, FloatArray], Any]
    at: Anchor | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise self._fault(
                f"{safe_repr(self.function)} cannot be called", "Give a function of (t, q, v)"
            )
        self._take_name(getattr(self.function, "__name__", "function").strip("<>"))
        name_places(self._element, self.at)

    def check(self, model: pin.Model) -> None:
        if self.at is not None:
            resolve_moving(model, [self.at], f"{self._element}, anchor at")


OPEN_LIMIT = 1e16
"""Joint limits (rad, m) from here on are open: SDF writes 1e16 there, others the largest double."""


@dataclass(frozen=True)
class _BetweenLinks(ForceElement):
    """A spring and damper between anchors on different bodies."""

    has_potential: ClassVar[bool] = True
    a: Anchor
    b: Anchor

    def __post_init__(self) -> None:
        self._take_name(*name_places(self._element, self.a, self.b))
        self._take_quantities()
        self._refuse_zeros("stiffness", "damping")

    def check(self, model: pin.Model) -> None:
        check_apart(model, self.a, self.b, self._element)


@dataclass(frozen=True)
class SpringDamper(_BetweenLinks):
    """Spring and damper between two points, along the line that joins them.

    With the distance l of the points it pulls them together with F = k (l - l0) + c dl/dt; with a
    slack s the spring has no force while l is between l0 and l0 + s, and F = k (l - l0 - s) beyond.

    Parameters
    ----------
    a, b
        Anchors on different bodies; their orientation does not matter.
    stiffness, damping
        k in N/m and c in N s/m, not negative.
    rest_length
        l0 in m; needed where there is stiffness.
    name
        Unique name.
    slack
        s in m, not negative; a rope that is s long has l0 = 0.

    Raises
    ------
    InputError
        For a value that is negative, missing or not finite.

    Notes
    -----
    Where the points coincide the line has no direction.  If l0 = 0 the force is continuous there in
    any motion and acts; otherwise that state cannot be evaluated, and a run that meets it says so.
    At the ends of the slack the force is continuous and its slope is not: a step across them is as
    short as its error estimate asks.
    """

    type: ClassVar[str] = "spring_damper"
    stiffness: float = quantity("N/m", 0.0, nonnegative=True)
    damping: float = quantity("N s/m", 0.0, nonnegative=True)
    rest_length: float | None = quantity("m", None, nonnegative=True)
    name: str = ""
    slack: float = quantity("m", 0.0, nonnegative=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rest_length is None:
            if self.stiffness:
                raise self._fault(
                    "a spring needs a rest_length", "Give the length without force, in m"
                )
            self._set("rest_length", 0.0)


@dataclass(frozen=True)
class JointTorque(ForceElement):
    """A generalised force on a joint, constant or over time.

    Parameters
    ----------
    joint
        Its name.
    torque
        N m (prismatic: N), in the positive sense of the joint; for a joint of several degrees of
        freedom one number for each, in Pinocchio's order.  By default 1 with a law, else 0.
    name
        Unique name.
    law
        What ``torque`` is multiplied by over time: one law, or one for each number.

    Raises
    ------
    InputError
        For a value that is not finite.
    """

    type: ClassVar[str] = "torque"
    joint: str
    torque: float | tuple[float, ...] | None = quantity("N m, N", None)
    name: str = ""
    law: Law | tuple[Law, ...] | None = None

    def __post_init__(self) -> None:
        self._take_name(self.joint)
        given: Any = self.torque
        try:
            shape = np.shape(given)
        except Exception:  # objects may raise anything
            shape = ()
        laws = self._take_law(max(1, math.prod(shape)))
        if given is None:
            self._set("torque", 1.0 if laws else 0.0)
        self._take_number("torque", math.prod(shape) if shape else 0)

    def check(self, model: pin.Model) -> None:
        count = moving_joint(model, self.joint, self._element).nv
        if np.size(self.torque) != count:  # type: ignore[arg-type]
            raise self._fault(
                f"torque = {safe_repr(self.torque)} does not fit the {counted(count, 'degree')} of "
                f"freedom of joint {self.joint!r}",
                "Give one number" if count == 1 else f"Give a list of {count} numbers",
            )


@dataclass(frozen=True)
class TorsionSpring(ForceElement):
    """Spring and damper on the coordinate of a one-degree joint: tau = -k (q - q_0) - c dq/dt.

    Parameters
    ----------
    joint
        Name of a revolute or prismatic joint; for a continuous one, whose angle (cos, sin) does not
        count turns, only damping is possible.
    stiffness, damping
        k in N m/rad and c in N m s/rad (prismatic: N/m, N s/m), not negative.
    rest_angle
        q_0 in rad (prismatic: m).
    name
        Unique name.

    Raises
    ------
    InputError
        For a value that is negative or not finite.
    """

    type: ClassVar[str] = "torsion_spring"
    has_potential: ClassVar[bool] = True
    joint: str
    stiffness: float = quantity("N m/rad, N/m", 0.0, nonnegative=True)
    damping: float = quantity("N m s/rad, N s/m", 0.0, nonnegative=True)
    rest_angle: float = quantity("rad, m", 0.0)
    name: str = ""

    def __post_init__(self) -> None:
        self._take_name(self.joint)
        self._take_quantities()
        self._refuse_zeros("stiffness", "damping")

    def check(self, model: pin.Model) -> None:
        kind = turn_counting_joint if self.stiffness else one_degree_joint
        kind(model, self.joint, self._element, "Use a bushing between its links")


@dataclass(frozen=True)
class CouplingSpring(ForceElement):
    """Spring, damper and friction on a sum of joint coordinates, as a cable over several joints has
    them.

    With y = sum c_i q_i, the joint i has the force
    tau_i = -c_i (k d + c dy/dt + F tanh((dy/dt) / v_s)).  The stretch d is y - y_0; with a slack s
    it is 0 from y_0 to y_0 + s, and beyond the distance from there.

    Parameters
    ----------
    joints
        Names of revolute and prismatic joints.
    coefficients
        c_i of each joint, not zero; y has the unit of the products (m, if they are radii in m/rad).
    stiffness, damping
        k and c, not negative: per unit of y, N/m and N s/m where that is m.
    rest
        y_0 in the unit of y.
    name
        Unique name.
    slack
        s, not negative, in the unit of y.
    friction
        F, not negative: the force on y of dry friction, which changes its sign smoothly over the
        ``friction_speed`` v_s of the mechanism, in the unit of y over s.

    Raises
    ------
    InputError
        For a value that is negative or not finite, or joints and coefficients of unequal number.
    """

    type: ClassVar[str] = "coupling_spring"
    has_potential: ClassVar[bool] = True
    joints: tuple[str, ...]
    coefficients: tuple[float, ...]
    stiffness: float = quantity("", 0.0, nonnegative=True)
    damping: float = quantity("", 0.0, nonnegative=True)
    rest: float = quantity("", 0.0)
    name: str = ""
    slack: float = quantity("", 0.0, nonnegative=True)
    friction: float = quantity("", 0.0, nonnegative=True)

    def __post_init__(self) -> None:
        joints = (self.joints,) if isinstance(self.joints, str) else self.joints
        several = isinstance(joints, list | tuple) and len(joints) > 0
        if not several or not all(isinstance(name, str) for name in joints):
            raise self._fault(
                f"joints = {safe_repr(self.joints)} is not a list of names",
                'Give "joints = [first, second]"',
            )
        self._set("joints", tuple(map(plain, joints)))
        for name in self.joints:
            if self.joints.count(name) > 1:
                raise self._fault(
                    f"the joint {name!r} is named twice", "Keep one, with the sum of both"
                )
        self._take_name(*self.joints)
        numbers = finite_numbers(
            self.coefficients,
            len(self.joints),
            "coefficients",
            "Give one number for each joint",
            self._element,
        )
        if 0.0 in numbers:
            raise self._fault("a coefficient is zero", "Remove that joint from the list")
        self._set("coefficients", numbers)
        self._take_quantities()
        self._refuse_zeros("stiffness", "damping", "friction")

    def check(self, model: pin.Model) -> None:
        for name in self.joints:
            turn_counting_joint(
                model, name, self._element, "Name joints with one degree of freedom"
            )


@dataclass(frozen=True)
class Wrench(ForceElement):
    """A force and moment on a link, constant or over time.

    Parameters
    ----------
    at
        Where the force takes hold: an anchor on a moving link.
    force : (3,) N, moment : (3,) N m
        Components in the axes of ``frame``.
    frame
        ``"world"``, or ``"link"`` for the axes of the anchor, which turn with the link.
    name
        Unique name.
    law
        What force and moment are multiplied by over time: one law, or six, one for each number;
        with six, the numbers are 1 by default.

    Raises
    ------
    InputError
        For values that are not finite, both zero, or another ``frame``.
    """

    type: ClassVar[str] = "wrench"
    at: Anchor
    force: tuple[float, float, float] = quantity("N", (0.0, 0.0, 0.0), count=3)
    moment: tuple[float, float, float] = quantity("N m", (0.0, 0.0, 0.0), count=3)
    frame: Literal["world", "link"] = "world"
    name: str = ""
    law: Law | tuple[Law, ...] | None = None

    def __post_init__(self) -> None:
        self._take_name(*name_places(self._element, self.at))
        if len(self._take_law(6)) == 6 and not np.any([self.force, self.moment]):
            self._set("force", (1.0, 1.0, 1.0))
            self._set("moment", (1.0, 1.0, 1.0))
        self._take_quantities()
        self._refuse_zeros("force", "moment")
        if not isinstance(self.frame, str) or self.frame not in ("world", "link"):
            raise self._fault(
                f"there is no frame {safe_repr(self.frame)}", 'Give "world" or "link"'
            )

    def check(self, model: pin.Model) -> None:
        resolve_moving(model, [self.at], f"{self._element}, anchor at")


@dataclass(frozen=True)
class Bushing(_BetweenLinks):
    """Spring and damper in all six directions between two frames.

    Let p be the position of a's origin in b's frame and phi the rotation vector (log3) of a's axes
    against b's.  The energy is (p . Kt p + phi . Kr phi)/2 with diagonal Kt, Kr, the power lost
    dp/dt . Ct dp/dt + dphi/dt . Cr dphi/dt; force and moment follow by virtual work.
    For small rotations they are -Kt p - Ct dp/dt and -Kr phi - Cr w, with the relative angular
    velocity w; the energy balance is exact for any rotation below pi.

    Parameters
    ----------
    a, b
        Anchors on different bodies; relaxed where they coincide.
    stiffness : (6,), damping : (6,)
        Three for the translation (N/m, N s/m), then three for the rotation (N m/rad, N m s/rad),
        along the axes of b; not negative.
    name
        Unique name.

    Raises
    ------
    InputError
        For a value that is negative or not finite.
    """

    type: ClassVar[str] = "bushing"
    stiffness: Sequence[float] = quantity("N m/rad, N/m", (0.0,) * 6, nonnegative=True, count=6)
    damping: Sequence[float] = quantity("N m s/rad, N s/m", (0.0,) * 6, nonnegative=True, count=6)
    name: str = ""


@dataclass(frozen=True)
class LimitSpring(ForceElement):
    """Springs where a joint leaves its limits: tau = -(k d + c dq/dt) S(d / depth).

    d is how far the joint is beyond a limit (its sign that of the excess).  S rises smoothly from 0
    to 1 over the depth, S(x) = x^3 (10 - 15 x + 6 x^2), so that spring and damping are three
    times and twice differentiable at the limit, and twice where S ends.  A step across either place
    is as short as its error estimate asks, and errs by about a tolerance; others keep their order.

    Parameters
    ----------
    joint
        Name of a revolute or prismatic joint.
    stiffness, damping
        k in N m/rad and c in N m s/rad (prismatic: N/m, N s/m), not negative, k positive.
    lower, upper
        Limits (rad, m); by default the model's.
    depth
        rad or m, positive; by default a hundredth of the range, at most 0.01.
    name
        Unique name.

    Raises
    ------
    InputError
        For a value that is missing, negative or not finite, or a joint without limits.
    """

    type: ClassVar[str] = "limit_spring"
    has_potential: ClassVar[bool] = True
    joint: str
    stiffness: float = quantity("N m/rad, N/m", 0.0, nonnegative=True, needed=True)
    damping: float = quantity("N m s/rad, N s/m", 0.0, nonnegative=True)
    lower: float | None = quantity("rad, m", None)
    upper: float | None = quantity("rad, m", None)
    depth: float | None = quantity("rad, m", None)
    name: str = ""

    def __post_init__(self) -> None:
        self._take_name(self.joint)
        self._take_quantities()
        if self.stiffness is None or not self.stiffness > 0.0:
            raise self._fault("a limit needs a stiffness", "Give a positive stiffness")
        if self.depth is not None and not self.depth > 0.0:
            raise self._fault(f"depth = {self.depth:g} is not positive", "Give a positive depth")

    def resolved(self, model: pin.Model) -> tuple[float, float, float]:
        """Lower and upper limit, infinite where open, and depth."""
        joint = moving_joint(model, self.joint, self._element)
        low = float(model.lowerPositionLimit[joint.idx_q]) if self.lower is None else self.lower
        high = float(model.upperPositionLimit[joint.idx_q]) if self.upper is None else self.upper
        low, high = (
            x if abs(x) < OPEN_LIMIT else float(np.copysign(np.inf, x)) for x in (low, high)
        )
        width = min(high - low, 1.0)
        return low, high, 0.01 * width if self.depth is None else self.depth

    def check(self, model: pin.Model) -> None:
        joint = moving_joint(model, self.joint, self._element)
        if not joint.nq == joint.nv == 1:
            raise self._fault(
                f"the position of joint {self.joint!r} is not one number",
                "Give limits to revolute and prismatic joints only",
            )
        low, high, _ = self.resolved(model)
        if not low < high or not np.isfinite([low, high]).any():
            raise self._fault(
                f"joint {self.joint!r} has no limits ({low:g} to {high:g})",
                "Give lower or upper, or limits in the model",
            )


FORCE_TYPES: Mapping[str, Callable[..., ForceElement]] = MappingProxyType(
    {
        kind.type: kind
        for kind in (
            *(SpringDamper, JointTorque, TorsionSpring, Wrench, Bushing, LimitSpring),
            CouplingSpring,
        )
    }
)
"""The force elements by their type in a description."""
