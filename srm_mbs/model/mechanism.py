"""The description of a mechanism: tree, closures, forces, drives and an initial state.

Nothing here computes; :mod:`srm_mbs.dynamics` evaluates a mechanism.  What is asked of its parts
together is in :mod:`srm_mbs.model.validation`.  A ``pin.Model`` cannot be frozen: the package
treats it as constant and never attaches anything to it, and so should you.

Where a mechanism came from, and what its description says besides the mechanism itself.

What follows from a description, made once when it is first asked for, and kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.drives import NamedLaw, check_covers, knots_between, laws_over_time
from srm_mbs.model.forces import ForceElement
from srm_mbs.model.validation import (
    check_names,
    check_tree,
    checked_elements,
    checked_friction_speed,
    checked_start,
    without,
)

if TYPE_CHECKING:
    from srm_mbs.dynamics.constraints.mobility import Mobility
    from srm_mbs.dynamics.constraints.structure import Structure
    from srm_mbs.model.drives import Drive
    from srm_mbs.model.laws import Curve
    from srm_mbs.model.pinocchio_constraints import PinocchioConstraints


@dataclass(frozen=True)
class Source:
    """Where a mechanism came from: enough to load it again, and to draw it.

    Attributes
    ----------
    description
        Text of the TOML description.
    urdf
        Text of the URDF as it was read.
    urdf_path
        Where that URDF lay, for mesh files relative to it; may be gone when a run is replayed.
    path
        The description's own path, for messages.
    base, gravity
        As used: the description's, unless the caller gave others.
    format
        Format of the file that held the links and joints.
    """

    description: str
    urdf: str
    urdf_path: str
    path: str
    base: str
    gravity: tuple[float, float, float]
    format: str = "URDF"


@dataclass(frozen=True)
class SimulationDefaults:
    """Defaults of the command line from ``[simulation]``; ``None`` where the file is silent."""

    t_end: float | None = None
    rtol: float | None = None
    atol: float | None = None


class Derivations:
    """Base of :class:`~srm_mbs.model.mechanism.Mechanism`: what others derive from it, by name."""

    @cached_property
    def _derived(self) -> dict[str, Any]:
        return {}

    @cached_property
    def _of_start(self) -> dict[str, Any]:
        return {}

    def derived(self, name: str, make: Callable[[], Any]) -> Any:
        """What follows from the model alone, made once and kept under ``name``.

        It is shared with every :meth:`with_state`, so it must not depend on the initial state, and
        nothing may change it.
        """
        if name not in self._derived:
            self._derived[name] = make()
        return self._derived[name]

    def at_start(self, name: str, make: Callable[[], Any]) -> Any:
        """As :meth:`derived`, for what depends on the initial state as well."""
        if name not in self._of_start:
            self._of_start[name] = make()
        return self._of_start[name]


FRICTION_SPEED = 0.01
"""Default of ``friction_speed``, rad/s or m/s."""


@dataclass(frozen=True, eq=False)
class Mechanism(Derivations):
    """A mechanism: a Pinocchio tree, the closures of its loops, and an initial state.

    Parameters
    ----------
    model
        The spanning tree, gravity included; ``model.damping`` acts on the joints (N m s/rad,
        N s/m), and ``model.friction`` F (N m, N) with -F tanh(v / friction_speed).
    loops
        Loop closures; names must be unique.  A ``distance`` without a length takes the one at q0.
    q0 : (nq,), v0 : (nv,)
        Initial state; by default the neutral configuration at rest.  :func:`srm_mbs.load`
        assembles it; from a ``pin.Model`` in hand use :func:`srm_mbs.assemble`.
    forces
        Force elements (:mod:`srm_mbs.model.forces`); names must be unique.
    drives
        Prescribed motions (:class:`srm_mbs.Drive`); names must be unique.
    friction_speed
        Speed (rad/s, m/s) over which joint friction changes its sign: it is 76 % of F there.  A
        joint held by friction creeps below it; small values make the equations stiff.
    name
        Name in messages and plots.
    source, defaults, notes
        Filled in by :func:`srm_mbs.load`: what the mechanism was read from, the defaults of its
        description, and what the reader should know (elements that were ignored, and why).

    Raises
    ------
    InputError
        If names repeat, an anchor or the joint of a force, drive or coupling is unknown or cannot
        take it, a shape does not fit, the joints of the model are not in depth-first order, joint
        friction is negative, or it has mimic joints, which this version does not simulate.
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

    def __post_init__(self) -> None:
        model = self.model
        set_ = object.__setattr__
        check_tree(model)
        set_(self, "loops", checked_elements("loop", self.loops, "LoopClosure"))
        set_(self, "name", self.name or model.name)
        self._take_start(
            pin.neutral(model) if self.q0 is None else self.q0,
            np.zeros(model.nv) if self.v0 is None else self.v0,
        )
        check_names("loop", [loop.name for loop in self.loops])
        for loop in self.loops:
            loop.check(model)
        set_(self, "loops", tuple(loop.measured(model, self.q0) for loop in self.loops))
        set_(self, "forces", checked_elements("force", self.forces, "SpringDamper"))
        check_names("force", [force.name for force in self.forces])
        for force in self.forces:
            force.check(model)
        set_(self, "drives", checked_elements("drive", self.drives, "Drive"))
        check_names("drive", [drive.name for drive in self.drives])
        for drive in self.drives:
            drive.check(model)
        set_(self, "friction_speed", checked_friction_speed(model, self.friction_speed))

    def with_loop(self, loop: LoopClosure) -> Mechanism:
        """The same mechanism with one more closure, for :class:`srm_mbs.Switch`.

        Its initial state may violate the closure; a switch brings its own.

        Raises
        ------
        InputError
            As for the mechanism itself: a name that is there, an anchor that is not.
        """
        return replace(self, loops=(*self.loops, loop))

    def without_loop(self, name: str) -> Mechanism:
        """The same mechanism without the closure ``name``.

        Raises
        ------
        InputError
            If there is none; the message lists those there are.
        """
        return replace(self, loops=without("loop", self.loops, name))

    @classmethod
    def from_pinocchio(cls, model: pin.Model, constraint_models: Any, **options: Any) -> Mechanism:
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
        from srm_mbs.model.pinocchio_constraints import closures_from_pinocchio

        return cls(model, closures_from_pinocchio(model, constraint_models), **options)

    def to_pinocchio(self) -> PinocchioConstraints:
        """The closures as Pinocchio's constraint models, as far as it has them: point and frame;
        the others are named."""
        from srm_mbs.model.pinocchio_constraints import to_pinocchio

        return to_pinocchio(self)

    def without_drive(self, name: str) -> Mechanism:
        """The same mechanism without the drive ``name``.

        Raises
        ------
        InputError
            If there is none; the message lists those there are.
        """
        return replace(self, drives=without("drive", self.drives, name))

    def moved(self, q: Any, v: Any) -> Mechanism:
        """The same mechanism at another state, q (nq,) and v (nv,), of its motion: unlike with
        :meth:`with_state`, drives go on as they were."""
        changed = self.with_state(q, v)
        if self.drives:
            changed.__dict__["drive_curves"] = self.drive_curves
        return changed

    def with_state(self, q0: Any, v0: Any) -> Mechanism:
        """The same mechanism with another initial state, q0 (nq,) and v0 (nv,)."""
        changed = object.__new__(type(self))
        changed.__dict__.update(self.__dict__)
        for kept in ("initial_errors", "drive_curves", "_of_start", "structure"):
            changed.__dict__.pop(kept, None)
        changed._take_start(q0, v0)
        if "structure" in self.__dict__:
            changed.__dict__["structure"] = self.structure.at(changed)
        changed.__dict__["_derived"] = self._derived
        return changed

    def __getstate__(self) -> dict[str, Any]:
        """What a pickle holds: the fields, the analysis, which other processes then share, and the
        motion of drives that did not begin with this state."""
        names = [*(entry.name for entry in fields(self)), "structure", "drive_curves"]
        return {name: self.__dict__[name] for name in names if name in self.__dict__}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for array in (self.q0, self.v0):
            array.setflags(write=False)

    def _take_start(self, q0: Any, v0: Any) -> None:
        q0, v0 = checked_start(self.model, q0, v0)
        object.__setattr__(self, "q0", q0)
        object.__setattr__(self, "v0", v0)

    @cached_property
    def structure(self) -> Structure:
        """Rank, redundancy and scales of the closures, found once by the walk of docs/notation.md.

        An upward import: the analysis evaluates the mechanism.
        """
        from srm_mbs.dynamics.constraints.structure import analyse

        return analyse(self)

    @property
    def mobility(self) -> Mobility:
        """Gruebler counts against the true rank, redundant rows, joints that are stuck or idle.

        An upward import, as for :attr:`structure`.
        """
        from srm_mbs.dynamics.constraints.mobility import mobility

        return self.derived("mobility", lambda: mobility(self))  # type: ignore[no-any-return]

    @cached_property
    def initial_errors(self) -> tuple[FloatArray, FloatArray]:
        """g - s and G v - s' (rows,) at the initial state, in m and rad, and per second."""
        from srm_mbs.dynamics.constraints.rheonomic import constraint_errors

        g, c = constraint_errors(self, np.zeros(1), self.q0[None], self.v0[None])
        return g[0], c[0]

    @property
    def constrained(self) -> bool:
        """Whether it has loops or drives."""
        return bool(self.loops or self.drives)

    @property
    def undriven(self) -> Mechanism:
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

    @cached_property
    def drive_curves(self) -> dict[str, Curve]:
        """The driven coordinate (rad, m) of each drive over time, from where q0 has it."""
        from srm_mbs.model.drives import positions

        starts = positions(self.model, self.drives, self.q0)
        return {drive.name: drive.curve(starts[drive.name]) for drive in self.drives}

    @cached_property
    def _laws(self) -> tuple[NamedLaw, ...]:
        return laws_over_time(self.drives, self.forces)

    def check_covers(self, t_end: float) -> None:
        """Refuse a run to ``t_end`` (s) that is longer than a table.

        Raises
        ------
        InputError
            Naming what has the table.
        """
        check_covers(self._laws, t_end)

    def breakpoints(self, t0: float, t_end: float) -> Sequence[float]:
        """Times (s) between ``t0`` and ``t_end`` at which a part of it that depends on time is not
        smooth: knots of tables, switches of drives.  Runs take no step across them."""
        return knots_between(self._laws, t0, t_end)

    @property
    def degrees_of_freedom(self) -> int:
        """nv minus the structural rank of closures and drives."""
        return int(self.model.nv) - self.structure.rank

    @property
    def redundant_rows(self) -> tuple[str, ...]:
        """Names of the closure rows that are zero wherever the loops are closed; left out."""
        return self.structure.redundant_rows

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints, in Pinocchio's order."""
        return tuple(self.model.names)[1:]

    def joint(self, name: str) -> Any:
        """The Pinocchio joint model of ``name``.

        Raises
        ------
        InputError
            If there is no such joint; the message lists those there are.
        """
        if name not in self.joint_names:
            raise InputError(
                f"there is no joint {name!r}", remedy=f"Known: {', '.join(self.joint_names)}"
            )
        return self.model.joints[self.model.getJointId(name)]

    def __repr__(self) -> str:
        return (
            f"Mechanism({self.name!r}, joints={list(self.joint_names)}, "
            f"loops={[loop.name for loop in self.loops]}, "
            f"forces={[force.name for force in self.forces]}, "
            f"drives={[drive.name for drive in self.drives]})"
        )
