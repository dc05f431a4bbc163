"""The data of a mechanism: tree, closures, forces, drives and an initial state.

The data check themselves (:mod:`srm_mbs.model.validation` has the checks of the parts together)
and compute no dynamics; :class:`srm_mbs.Mechanism` adds what follows from them.  A ``pin.Model``
cannot be frozen: the package treats it as constant and never attaches anything to it, and so should
you.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import update_wrapper
from types import MappingProxyType
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError, known_names, safe_repr
from srm_mbs.model.actuators import Actuator, checked_actuators
from srm_mbs.model.anchors import Anchor
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.copies import copied
from srm_mbs.model.drives import Drive, positions
from srm_mbs.model.forces import FORCE_TYPES, ForceElement, UserForce
from srm_mbs.model.laws import Curve, Law, is_of_package
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.numbers import checked_name, vector_elements
from srm_mbs.model.pinocchio_constraints import (
    PinocchioConstraints,
    closures_from_pinocchio,
    to_pinocchio,
)
from srm_mbs.model.reach import Reach
from srm_mbs.model.validation import (
    START_ARGUMENTS,
    STATE_ARGUMENTS,
    check_tree,
    checked_elements,
    checked_friction_speed,
    checked_points,
    checked_start,
    without,
)

# References to files by their full name, as in filename="/home/author/arm.stl".
_FOLDER = r"(?:file://)?(?:/|[A-Za-z]:[\\/])(?:[^\"'<>\n]*[\\/])?"
_FILE_KEYS = "urdf|sdf|mjcf|gepetto|table|file|filename"
_FULL_NAME = re.compile(rf"""(\b(?:{_FILE_KEYS})\s*=\s*["']){_FOLDER}(?=[^"'/\\])""")


class SourceTexts:
    """The texts of a source.

    Parameters
    ----------
    description, urdf
        The texts of the TOML description and of the URDF, or functions that make them when they are
        first asked for: most runs need neither.
    """

    def __init__(self, description: str | Callable[[], str], urdf: str | Callable[[], str]) -> None:
        self._description, self._urdf = description, urdf

    @cached_property
    def description(self) -> str:
        """Text of the TOML description."""
        return self._description if isinstance(self._description, str) else self._description()

    @cached_property
    def urdf(self) -> str:
        """Text of the URDF as it was read."""
        return self._urdf if isinstance(self._urdf, str) else self._urdf()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SourceTexts):
            return NotImplemented
        return (self.description, self.urdf) == (other.description, other.urdf)

    def __hash__(self) -> int:
        return hash((self.description, self.urdf))

    def __reduce__(self) -> tuple[type[SourceTexts], tuple[str, str]]:
        """As texts: functions that make them may not be pickled."""
        return SourceTexts, (self.description, self.urdf)


@dataclass(frozen=True)
class Source:
    """Where a mechanism came from: enough to load it again, and to draw it.

    Attributes
    ----------
    texts
        The description and the URDF.
    urdf_path
        Where that URDF lay, for mesh files relative to it; may be gone when a run is replayed.
    path
        The description's own path, for messages.
    base, gravity
        As used: the description's, unless the caller gave others.
    format
        Format of the file that held the links and joints.
    reach
        Which files its meshes may be, as the caller who loaded it decided; never saved.
    parameters
        Values of the parameters of the description; ``description`` has numbers in their place.
    """

    texts: SourceTexts
    urdf_path: str
    path: str
    base: str
    gravity: tuple[float, float, float]
    format: str = "URDF"
    reach: Reach = field(default_factory=Reach, compare=False)
    parameters: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if not isinstance(self.reach, Reach):
            raise InputError(
                "the reach of a mechanism is not saved in files",
                element="reach",
                remedy="Give allow_outside to the function that loads it",
            )

    @property
    def description(self) -> str:
        """Text of the TOML description."""
        return self.texts.description

    @property
    def urdf(self) -> str:
        """Text of the URDF as it was read."""
        return self.texts.urdf

    def entries(self) -> dict[str, Any]:
        """The texts and the fields that are saved: all but the reach."""
        others = (key.name for key in fields(self) if key.name not in ("texts", "reach"))
        return {
            "description": self.description,
            "urdf": self.urdf,
            **{name: getattr(self, name) for name in others},
            "parameters": dict(self.parameters),
        }

    def without_folders(self, text: str) -> str:
        """``text`` of its files or about them, with the files of the model named relative to its
        folders, and other files by their name alone."""
        for file in (self.urdf_path, self.path):
            folder = os.path.dirname(file)
            for absolute in {folder, os.path.abspath(folder), os.path.realpath(folder)}:
                if os.path.isabs(absolute) and absolute != os.path.dirname(absolute):
                    for prefix in (f"file://{absolute}/", f"{absolute}{os.sep}"):
                        text = text.replace(prefix, "")
        return _FULL_NAME.sub(r"\1", text)


@dataclass(frozen=True)
class SimulationDefaults:
    """Defaults of the command line from ``[simulation]``; ``None`` where the file is silent."""

    t_end: float | None = None
    rtol: float | None = None
    atol: float | None = None


class ResultOwner:
    """Base of :class:`MechanismData`: holds the results of :class:`per_tree`, :class:`per_model`
    and :class:`per_start`, by function."""

    _tree_results: dict[Any, Any]
    _model_results: dict[Any, Any]
    _start_results: dict[Any, Any]


Owner = TypeVar("Owner", bound=ResultOwner, contravariant=True)
Result = TypeVar("Result")


_MISSING = object()
"""In place of a result that is not there, which may be None."""


class _Memoised(Generic[Owner, Result]):
    """A function of a mechanism whose result is kept with the mechanism; nothing may change it."""

    _store: str
    """Attribute of :class:`ResultOwner` that holds the results."""

    def __init__(self, function: Callable[[Owner], Result]) -> None:
        self._function = function
        update_wrapper(self, function)

    def __call__(self, mechanism: Owner) -> Result:
        results = getattr(mechanism, self._store)
        result = results.get(self, _MISSING)
        if result is _MISSING:
            result = results[self] = self._function(mechanism)
        return result  # type: ignore[no-any-return]

    def kept(self, mechanism: Owner) -> Result | None:
        """The result, if it was computed or given before."""
        return getattr(mechanism, self._store).get(self)  # type: ignore[no-any-return]

    def keep(self, mechanism: Owner, result: Result) -> None:
        """Use ``result`` instead of computing it."""
        getattr(mechanism, self._store)[self] = result


class per_tree(_Memoised[Owner, Result]):  # noqa: N801 - a decorator
    """Decorator: as :class:`per_model`, once for all variants whose models are copies with other
    placements and inertias (:meth:`MechanismData.of_checked`).

    The result must depend on neither of them, nor on numbers of closures and forces.
    """

    _store = "_tree_results"


class per_model(_Memoised[Owner, Result]):  # noqa: N801 - a decorator
    """Decorator: evaluate a function of a mechanism once for it and every ``with_state`` of it.

    The result must not depend on the initial state.
    """

    _store = "_model_results"


class per_start(_Memoised[Owner, Result]):  # noqa: N801 - a decorator
    """Decorator: evaluate a function of a mechanism once for each initial state."""

    _store = "_start_results"


class VariantMaker(Protocol):
    """Loads a description again with other values of its parameters."""

    @property
    def definition(self) -> tuple[Any, ...]:
        """The texts and options that determine the variants, for fingerprints."""

    def __call__(self, parameters: Mapping[str, Any]) -> Any:
        """The mechanism with ``parameters``, name -> number."""


@per_model
def variant_maker(mechanism: MechanismData) -> VariantMaker | None:
    """The maker of the variants of a mechanism; None unless the function that loaded it gave one,
    and where the mechanism was changed afterwards."""
    return None


FRICTION_SPEED = 0.01
"""Default of ``friction_speed``, rad/s or m/s."""


@dataclass(frozen=True, eq=False)
class MechanismData(ResultOwner):
    """The data of a :class:`~srm_mbs.dynamics.mechanism.Mechanism`, which has the documentation of
    the parameters.
    """

    model: pin.Model
    loops: tuple[LoopClosure, ...] = ()
    q0: FloatArray = None  # type: ignore[assignment]
    v0: FloatArray = None  # type: ignore[assignment]
    forces: tuple[ForceElement, ...] = ()
    drives: tuple[Drive, ...] = ()
    friction_speed: float = FRICTION_SPEED
    name: str = ""
    source: Source | None = None
    defaults: SimulationDefaults = field(default_factory=SimulationDefaults)
    notes: tuple[str, ...] = ()
    points: Mapping[str, Anchor] = field(default_factory=dict)
    actuators: Mapping[str, Actuator] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._forget()
        model = self.model
        set_ = object.__setattr__
        if not isinstance(model, pin.Model):
            raise InputError(
                f"a {type(model).__name__} is not a model",
                element="model",
                remedy="Give a pinocchio.Model",
            )
        check_tree(model)
        set_(self, "name", checked_name(self.name, "name") or model.name)
        self._take_start(
            pin.neutral(model) if self.q0 is None else self.q0,
            np.zeros(model.nv) if self.v0 is None else self.v0,
        )
        examples = "[srm.LoopClosure(...)]"
        loops = checked_elements(model, "loop", self.loops, (LoopClosure,), examples)
        set_(self, "loops", tuple(loop.measured(model, self.q0) for loop in loops))
        examples = "[srm.SpringDamper(...)], or [srm.UserForce(...)] for a force of your own"
        types: tuple[Any, ...] = (*FORCE_TYPES.values(), UserForce)
        set_(self, "forces", checked_elements(model, "force", self.forces, types, examples))
        examples = "[srm.Drive(...)]"
        set_(self, "drives", checked_elements(model, "drive", self.drives, (Drive,), examples))
        set_(self, "friction_speed", checked_friction_speed(model, self.friction_speed))
        set_(self, "points", checked_points(model, self.points))
        set_(self, "actuators", checked_actuators(model, self.actuators))

    def _forget(self) -> None:
        """Begin without results."""
        object.__setattr__(self, "_tree_results", {})
        object.__setattr__(self, "_model_results", {})
        object.__setattr__(self, "_start_results", {})

    @property
    def tree_results(self) -> dict[Any, Any]:
        """The results of :class:`per_tree`, for :meth:`of_checked`."""
        return self._tree_results

    @classmethod
    def of_checked(cls, tree_results: dict[Any, Any], **values: Any) -> Self:
        """A mechanism with these fields, whose parts were checked together: as those of another
        one, with other numbers.

        Parameters
        ----------
        tree_results
            Those of the other one, of whose model ``values["model"]`` is a copy.
        """
        made = object.__new__(cls)
        made._forget()
        set_ = object.__setattr__
        set_(made, "_tree_results", tree_results)
        for name, value in values.items():
            set_(made, name, value)
        made._take_start(values["q0"], np.zeros(made.model.nv))
        set_(made, "loops", tuple(loop.measured(made.model, made.q0) for loop in made.loops))
        return made

    def with_loop(self, loop: LoopClosure) -> Self:
        """The same mechanism with one more closure, for :class:`srm_mbs.Switch`.

        Its initial state may violate the closure; a switch brings its own.

        Raises
        ------
        InputError
            As for the mechanism itself: a name that is there, an anchor that is not.
        """
        return replace(self, loops=(*self.loops, loop))

    def without_loop(self, name: str) -> Self:
        """The same mechanism without the closure ``name``.

        Raises
        ------
        InputError
            If there is none; the message lists those there are.
        """
        return replace(self, loops=without("loop", self.loops, name))

    @classmethod
    def from_pinocchio(cls, model: pin.Model, constraint_models: Any, **options: Any) -> Self:
        """A mechanism whose closures are Pinocchio's constraint models.

        Parameters
        ----------
        model
            The tree.
        constraint_models
            As for :func:`srm_mbs.closures_from_pinocchio`.
        options
            Other parameters of the class.

        Raises
        ------
        InputError
            For a constraint model that is none of its closures.
        """
        return cls(model, closures_from_pinocchio(model, constraint_models), **options)

    def to_pinocchio(self) -> PinocchioConstraints:
        """The closures as Pinocchio's constraint models, as far as it has them: point and frame;
        the others are named."""
        return to_pinocchio(self.model, self.loops, self.drives)

    def without_drive(self, name: str) -> Self:
        """The same mechanism without the drive ``name``.

        Raises
        ------
        InputError
            If there is none; the message lists those there are.
        """
        return replace(self, drives=without("drive", self.drives, name))

    def moved(self, q: Any, v: Any, names: tuple[str, str] = STATE_ARGUMENTS) -> Self:
        """The same mechanism at another state, q (nq,) and v (nv,), of its motion: unlike with
        :meth:`with_state`, drives continue their motion.  Messages call the state ``names``."""
        changed = self._at(q, v, names)
        return changed.with_drive_curves(self.drive_curves) if self.drives else changed

    def with_state(self, q0: Any, v0: Any) -> Self:
        """The same mechanism with another initial state, q0 (nq,) and v0 (nv,).

        It shares the analysis of this one, if there is one, in units of the new state.
        """
        return self._at(q0, v0, START_ARGUMENTS)

    def _at(self, q0: Any, v0: Any, names: tuple[str, str]) -> Self:
        """:meth:`with_state`, whose messages call the state ``names``."""
        changed = self._at_no_start()
        changed._take_start(q0, v0, names)
        return changed

    def with_drive_curves(self, curves: dict[str, Curve]) -> Self:
        """The same mechanism, whose driven coordinates follow ``curves`` (by the drive's name)
        instead of beginning at q0: a motion that began before the initial state."""
        changed = self._at_no_start()
        _drive_curves.keep(changed, curves)
        return changed

    def _at_no_start(self) -> Self:
        """A copy that shares the results for the model and has none for the start."""
        return copied(self, _start_results={})

    def __getstate__(self) -> dict[str, Any]:
        """The fields, and the motion of the drives, which may have begun before this state."""
        state = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        kept = {"drive_curves": _drive_curves.kept(self), "variant_maker": variant_maker(self)}
        return state | kept

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._forget()
        for entry in fields(self):
            object.__setattr__(self, entry.name, state[entry.name])
        if state["drive_curves"] is not None:
            _drive_curves.keep(self, state["drive_curves"])
        variant_maker.keep(self, state["variant_maker"])
        for array in (self.q0, self.v0):
            array.setflags(write=False)

    @property
    def start_state(self) -> FloatArray:
        """The initial state, q0 and v0 (nq + nv,), read-only."""
        return _start_state(self)

    def _take_start(self, q0: Any, v0: Any, names: tuple[str, str] = START_ARGUMENTS) -> None:
        q0, v0 = checked_start(self.model, q0, v0, names)
        object.__setattr__(self, "q0", q0)
        object.__setattr__(self, "v0", v0)

    @property
    def parameters(self) -> Mapping[str, float]:
        """Values of the parameters of its description, read-only; empty if it has none."""
        return MappingProxyType({} if self.source is None else dict(self.source.parameters))

    def with_parameters(self, /, **values: float) -> Self:
        """The mechanism of the same description with other values of its parameters.

        It is loaded anew from the texts that were read, and starts as the description says;
        parameters that are not given keep the values that this mechanism has.

        Raises
        ------
        InputError
            If it was not loaded from a description with parameters, or was changed afterwards other
            than by :meth:`with_state`; for a parameter that is unknown or that nothing uses; and as
            :func:`srm_mbs.load`.
        """
        make = variant_maker(self)
        if make is None:
            raise InputError(
                "there is no description with parameters that makes this mechanism",
                element="with_parameters",
                remedy="Give srm.load a description with [parameters], and change the result after "
                "with_parameters, not before",
            )
        made: Self = make(values)
        return made

    @property
    def constrained(self) -> bool:
        """Whether it has loops or drives."""
        return bool(self.loops or self.drives)

    @property
    def undriven(self) -> Self:
        """The same mechanism without its drives."""
        return replace(self, drives=()) if self.drives else self

    def refuse_drives(self, what: str) -> None:
        """Refuse ``what`` of a mechanism whose motion drives prescribe.

        Raises
        ------
        InputError
            If there are any.
        """
        if self.drives:
            raise InputError(
                f"drives prescribe the motion: {what} would need them at rest",
                element="drives",
                remedy="Take mechanism.undriven, and hold or actuate its joints instead",
            )

    @property
    def drive_curves(self) -> dict[str, Curve]:
        """The driven coordinate (rad, m) of each drive over time, from where q0 has it."""
        return _drive_curves(self)

    def check_covers(self, t_end: float) -> None:
        """Refuse a run to ``t_end`` (s) that is longer than a table.

        Raises
        ------
        InputError
            Naming what has the table.
        """
        for element, law in _laws(self):
            last = law.span[1]
            if last < t_end:
                what = "table" if is_of_package(law) else "law"
                raise InputError(
                    f"its {what} ends at t = {last:g} s, before the run, at {t_end:g} s",
                    element=element,
                    remedy=f"Extend the {what}, or end the run earlier",
                )

    def breakpoints(self, t0: float, t_end: float) -> Sequence[float]:
        """Times (s) between ``t0`` and ``t_end`` at which a part of it that depends on time is not
        smooth: knots of tables, switches of drives.  Runs take no step across them."""
        times: set[float] = set()
        for _, law in _laws(self):
            knots = np.asarray(law.knots, dtype=float)
            times.update(knots[(t0 < knots) & (knots < t_end)].tolist())
        return tuple(sorted(times))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints, in Pinocchio's order."""
        return _joint_names(self)

    def joint(self, name: str) -> Any:
        """The Pinocchio joint model of ``name``.

        Raises
        ------
        InputError
            If there is no such joint; the message lists those there are.
        """
        if not isinstance(name, str) or name not in self.joint_names:
            raise InputError(
                f"there is no joint {safe_repr(name)}", remedy=known_names(self.joint_names)
            )
        return self.model.joints[self.model.getJointId(name)]

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.name!r}, joints={list(self.joint_names)}, "
            f"loops={[loop.name for loop in self.loops]}, "
            f"forces={[force.name for force in self.forces]}, "
            f"drives={[drive.name for drive in self.drives]})"
        )


@per_tree
def _joint_names(mechanism: MechanismData) -> tuple[str, ...]:
    return tuple(vector_elements(mechanism.model.names)[1:])


@per_model
def _laws(mechanism: MechanismData) -> tuple[tuple[str, Law], ...]:
    """Drives and force elements that follow laws over time, each with one of its laws."""
    found = [(f"drive {drive.name!r}", drive.law) for drive in mechanism.drives]
    for force in mechanism.forces:
        given = getattr(force, "law", None) or ()
        laws = given if isinstance(given, tuple) else (given,)
        found += [(f"force {force.name!r}", law) for law in laws]
    return tuple(found)


@per_start
def _start_state(mechanism: MechanismData) -> FloatArray:
    state = np.concatenate([mechanism.q0, mechanism.v0])
    state.setflags(write=False)
    return state


@per_start
def _drive_curves(mechanism: MechanismData) -> dict[str, Curve]:
    starts = positions(mechanism.model, mechanism.drives, mechanism.q0)
    return {drive.name: drive.curve(starts[drive.name]) for drive in mechanism.drives}
