"""Force elements as immutable data; :mod:`srm_mbs.dynamics.forces` evaluates them.

``solution.energy`` contains the energy of springs and bushings; torques and wrenches have none.
Torques and wrenches may follow a law over time (:mod:`srm_mbs.model.laws`).

The fields of these classes are the one list of the keys of a force: descriptions
(:mod:`srm_mbs.formats.toml.schema`), saved runs (:mod:`srm_mbs.simulation.storage`) and tables
read them, with the units, lengths and bounds that :func:`quantity` gives them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.model.anchors import Anchor, name_places, resolve_apart
from srm_mbs.model.laws import Law
from srm_mbs.model.numbers import finite_numbers


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
            raise InputError(
                f"{self.function!r} cannot be called",
                element=f"force {self.name or 'user'!r}",
                remedy="Give a function of (t, q, v)",
            )
        if not self.name:
            made = getattr(self.function, "__name__", "function").strip("<>")
            object.__setattr__(self, "name", f"user_{made}")
        name_places(f"force {self.name!r}", self.at)

    def check(self, model: pin.Model) -> None:
        if self.at is None:
            return
        try:
            joint, _ = self.at.resolve(model)
        except InputError as error:
            error.element = f"force {self.name!r}, anchor at"
            raise
        if joint == 0:
            raise InputError(
                f"{self.at.where!r} does not move",
                element=f"force {self.name!r}",
                remedy="Let the force act on a moving link",
            )


def quantity(
    unit: str, default: Any, *, lowest: float = -np.inf, count: int = 0, needed: bool = False
) -> Any:
    """A numerical field of a force element; :func:`take_quantities` checks and stores it.

    Parameters
    ----------
    unit
        For tables; "N m, N": that for angles, then that for lengths.
    default
        Its default; None: the element decides.
    lowest
        The least value.
    count
        Length of a list of numbers; 0: one number.
    needed
        Whether a description must give it, because the element refuses the default.
    """
    facts = {"unit": unit, "lowest": lowest, "count": count, "needed": needed}
    return field(default=default, metadata=facts)


def fault(force: ForceElement, problem: str, remedy: str) -> InputError:
    """The error of ``force``, to be raised."""
    return InputError(problem, element=f"force {force.name!r}", remedy=remedy)


def take_name(force: ForceElement, *places: str) -> None:
    """The default name, if none is given."""
    if not force.name:
        object.__setattr__(force, "name", "_".join((force.type, *places)))


def take(force: ForceElement, key: str, count: int = 0, lowest: float = -np.inf) -> Any:
    """Check a number, or ``count`` numbers, of ``force`` and store them as float or tuple.

    Raises
    ------
    InputError
        If they are not finite, or below ``lowest``.
    """
    given = getattr(force, key)
    remedy = f"Give a list of {count} finite numbers" if count else "Give a finite number"
    try:
        numbers = finite_numbers(given if count else (given,), count or 1, key, remedy)
    except InputError as error:
        raise fault(force, f"{key} = {given!r} cannot be", remedy) from error
    if min(numbers) < lowest:
        raise fault(force, f"{key} = {given!r} is negative", "Give a value >= 0")
    value = numbers if count else numbers[0]
    object.__setattr__(force, key, value)
    return value


def take_quantities(force: Any) -> None:
    """Check and store every :func:`quantity` of ``force`` that is not None.

    Raises
    ------
    InputError
        If one is not finite, too small, or of the wrong length.
    """
    for key in fields(force):
        if "unit" in key.metadata and getattr(force, key.name) is not None:
            take(force, key.name, key.metadata["count"], key.metadata["lowest"])


def refuse_without_effect(force: ForceElement, *keys: str) -> None:
    """Refuse an element whose quantities ``keys`` are all zero.

    Raises
    ------
    InputError
        Naming them.
    """
    if not np.any([getattr(force, key) for key in keys]):
        raise fault(
            force, f"{' and '.join(keys)} are zero", "Give one of them, or remove the element"
        )


def moving_joint(force: ForceElement, model: pin.Model, name: str) -> Any:
    """Pinocchio's joint ``name``, on which ``force`` acts.

    Raises
    ------
    InputError
        If there is no such moving joint; the message lists those there are.
    """
    names = list(model.names)[1:]
    if name not in names:
        raise fault(
            force, f"there is no moving joint {name!r}", f"Known: {', '.join(names) or 'none'}"
        )
    return model.joints[model.getJointId(name)]


def take_law(force: ForceElement, count: int) -> bool:
    """Check the law of ``force``, one or ``count`` of them; whether there is any.

    Raises
    ------
    InputError
        If it is no law, or there is another number of them.
    """
    law = getattr(force, "law")  # noqa: B009 - the fields of subclasses
    if law is None:
        return False
    laws = tuple(law) if isinstance(law, list | tuple) else (law,)
    if len(laws) not in (1, count) or not all(isinstance(each, Law) for each in laws):
        raise fault(
            force, "law is not a law", f"Give srm.Sine(...) or alike, or a list of {count} of them"
        )
    object.__setattr__(force, "law", laws[0] if len(laws) == 1 else laws)
    return True


OPEN_LIMIT = 1e30
"""Joint limits (rad, m) beyond this are open; Pinocchio writes the largest double there."""


@dataclass(frozen=True)
class SpringDamper(ForceElement):
    """Spring and damper between two points, along the line that joins them.

    With the distance l of the points it pulls them together with F = k (l - l0) + c dl/dt.

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

    Raises
    ------
    InputError
        For a value that is negative, missing or not finite.

    Notes
    -----
    Where the points coincide the line has no direction.  If l0 = 0 the force is continuous there in
    any motion and acts; otherwise that state cannot be evaluated, and a run that meets it says so.
    """

    type: ClassVar[str] = "spring_damper"
    has_potential: ClassVar[bool] = True
    a: Anchor
    b: Anchor
    stiffness: float = quantity("N/m", 0.0, lowest=0.0)
    damping: float = quantity("N s/m", 0.0, lowest=0.0)
    rest_length: float | None = quantity("m", None, lowest=0.0)
    name: str = ""

    def __post_init__(self) -> None:
        take_name(self, *name_places(f"force {self.name or self.type!r}", self.a, self.b))
        take_quantities(self)
        refuse_without_effect(self, "stiffness", "damping")
        if self.rest_length is None:
            if self.stiffness:
                raise fault(
                    self, "a spring needs a rest_length", "Give the length without force, in m"
                )
            object.__setattr__(self, "rest_length", 0.0)

    def check(self, model: pin.Model) -> None:
        resolve_apart(model, self.a, self.b, f"force {self.name!r}")


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
        take_name(self, self.joint)
        given: Any = self.torque
        follows = take_law(self, max(1, np.size(given)))
        if given is None:
            object.__setattr__(self, "torque", 1.0 if follows else 0.0)
        take(self, "torque", np.size(given) if np.ndim(given) else 0)

    def check(self, model: pin.Model) -> None:
        joint = moving_joint(self, model, self.joint)
        numbers: Any = self.torque
        if np.size(numbers) != joint.nv:
            raise fault(
                self,
                f"torque = {self.torque!r} does not fit the {joint.nv} degrees of freedom of "
                f"joint {self.joint!r}",
                "Give one number" if joint.nv == 1 else f"Give a list of {joint.nv} numbers",
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
    stiffness: float = quantity("N m/rad, N/m", 0.0, lowest=0.0)
    damping: float = quantity("N m s/rad, N s/m", 0.0, lowest=0.0)
    rest_angle: float = quantity("rad, m", 0.0)
    name: str = ""

    def __post_init__(self) -> None:
        take_name(self, self.joint)
        take_quantities(self)
        refuse_without_effect(self, "stiffness", "damping")

    def check(self, model: pin.Model) -> None:
        joint = moving_joint(self, model, self.joint)
        if joint.nv != 1:
            raise fault(
                self,
                f"joint {self.joint!r} has {joint.nv} degrees of freedom",
                "Use a bushing between its links",
            )
        if joint.nq != 1 and self.stiffness:
            raise fault(
                self,
                f"the angle of the continuous joint {self.joint!r} does not count turns",
                'Make the joint "revolute" in the URDF, with wide limits: they do not act',
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
        take_name(self, *name_places(f"force {self.name or self.type!r}", self.at))
        several = take_law(self, 6) and not isinstance(self.law, Law)
        if several and not np.any([self.force, self.moment]):
            object.__setattr__(self, "force", (1.0, 1.0, 1.0))
            object.__setattr__(self, "moment", (1.0, 1.0, 1.0))
        take_quantities(self)
        refuse_without_effect(self, "force", "moment")
        if self.frame not in ("world", "link"):
            raise fault(self, f"there is no frame {self.frame!r}", 'Give "world" or "link"')

    def check(self, model: pin.Model) -> None:
        try:
            joint, _ = self.at.resolve(model)
        except InputError as error:
            error.element = f"force {self.name!r}, anchor at"
            raise
        if joint == 0:
            raise fault(
                self, f"{self.at.where!r} does not move", "Let the wrench act on a moving link"
            )


@dataclass(frozen=True)
class Bushing(ForceElement):
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
    has_potential: ClassVar[bool] = True
    a: Anchor
    b: Anchor
    stiffness: Sequence[float] = quantity("N m/rad, N/m", (0.0,) * 6, lowest=0.0, count=6)
    damping: Sequence[float] = quantity("N m s/rad, N s/m", (0.0,) * 6, lowest=0.0, count=6)
    name: str = ""

    def __post_init__(self) -> None:
        take_name(self, *name_places(f"force {self.name or self.type!r}", self.a, self.b))
        take_quantities(self)
        refuse_without_effect(self, "stiffness", "damping")

    def check(self, model: pin.Model) -> None:
        resolve_apart(model, self.a, self.b, f"force {self.name!r}")


@dataclass(frozen=True)
class LimitSpring(ForceElement):
    """Springs where a joint leaves its limits: tau = -(k d + c dq/dt) S(d / depth).

    d is how far the joint is beyond a limit (its sign that of the excess).  S rises smoothly from 0
    to 1 over the depth, S(x) = x^3 (10 - 15 x + 6 x^2), so that the force is three times
    differentiable at the limit and the schemes keep their order.

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
    stiffness: float = quantity("N m/rad, N/m", 0.0, lowest=0.0, needed=True)
    damping: float = quantity("N m s/rad, N s/m", 0.0, lowest=0.0)
    lower: float | None = quantity("rad, m", None)
    upper: float | None = quantity("rad, m", None)
    depth: float | None = quantity("rad, m", None)
    name: str = ""

    def __post_init__(self) -> None:
        take_name(self, self.joint)
        take_quantities(self)
        if not self.stiffness > 0.0:
            raise fault(self, "a limit needs a stiffness", "Give a positive stiffness")
        if self.depth is not None and not self.depth > 0.0:
            raise fault(self, f"depth = {self.depth:g} is not positive", "Give a positive depth")

    def resolved(self, model: pin.Model) -> tuple[float, float, float]:
        """Lower and upper limit, infinite where open, and depth."""
        joint = moving_joint(self, model, self.joint)
        low = float(model.lowerPositionLimit[joint.idx_q]) if self.lower is None else self.lower
        high = float(model.upperPositionLimit[joint.idx_q]) if self.upper is None else self.upper
        low, high = (
            x if abs(x) < OPEN_LIMIT else float(np.copysign(np.inf, x)) for x in (low, high)
        )
        width = min(high - low, 1.0)
        return low, high, 0.01 * width if self.depth is None else self.depth

    def check(self, model: pin.Model) -> None:
        joint = moving_joint(self, model, self.joint)
        if not joint.nq == joint.nv == 1:
            raise fault(
                self,
                f"the position of joint {self.joint!r} is not one number",
                "Give limits to revolute and prismatic joints only",
            )
        low, high, _ = self.resolved(model)
        if not low < high or not np.isfinite([low, high]).any():
            raise fault(
                self,
                f"joint {self.joint!r} has no limits ({low:g} to {high:g})",
                "Give lower or upper, or limits in the model",
            )


FORCE_TYPES: Mapping[str, Callable[..., ForceElement]] = MappingProxyType(
    {
        kind.type: kind
        for kind in (SpringDamper, JointTorque, TorsionSpring, Wrench, Bushing, LimitSpring)
    }
)
"""The force elements by their type in a description."""
