"""Mechanisms: their data and what follows from them."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.mobility import Mobility, mobility
from srm_mbs.dynamics.constraints.rheonomic import constraint_errors
from srm_mbs.dynamics.constraints.structure import Structure, structure_of
from srm_mbs.errors import InputError, safe_repr
from srm_mbs.model.laws import Curve
from srm_mbs.model.mechanism import MechanismData, per_start
from srm_mbs.model.validation import STATE_ARGUMENTS


@dataclass(frozen=True, eq=False, repr=False)
class Mechanism(MechanismData):
    """A mechanism: a Pinocchio tree, the closures of its loops, and an initial state.

    Parameters
    ----------
    model
        The spanning tree, gravity included; ``model.damping`` acts on the joints (N m s/rad,
        N s/m), and ``model.friction`` F (N m, N) with -F tanh(v / friction_speed).  It is not
        copied, and what follows from it is kept: to change it, make a mechanism of a copy.
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
    points
        Named points of links or of the ground, by name: those of ``[points]`` of a description, and
        of a planar linkage.
    actuators
        Motors and servos by name (:class:`srm_mbs.Actuator`), for
        :func:`srm_mbs.actuator_controller`; without a controller they exert no force.

    Raises
    ------
    InputError
        If names repeat, an anchor or the joint of a force, drive or coupling is unknown or cannot
        take it, a shape does not fit, the joints of the model are not in depth-first order or share
        a name, joint friction is negative, or it has mimic joints, which this version does not
        simulate.
    """

    @property
    def structure(self) -> Structure:
        """Rank, redundancy and scales of the closures (docs/notation.md, "Load-time analysis")."""
        return structure_of(self)

    @property
    def mobility(self) -> Mobility:
        """Gruebler's count and the rank, redundant rows, joints that are stuck or idle."""
        return mobility(self)

    @property
    def initial_errors(self) -> tuple[FloatArray, FloatArray]:
        """g - s and G v - s' (rows,) at the initial state, in m and rad, and per second."""
        return _initial_errors(self)

    @property
    def degrees_of_freedom(self) -> int:
        """nv minus the structural rank of closures and drives."""
        return int(self.model.nv) - self.structure.rank

    @property
    def redundant_rows(self) -> tuple[str, ...]:
        """Names of the closure rows that are zero wherever the loops are closed; left out."""
        return self.structure.redundant_rows

    def _at(self, q0: Any, v0: Any, names: tuple[str, str]) -> Self:
        """As of the base class, with the analysis of this one."""
        changed = super()._at(q0, v0, names)
        structure = structure_of.kept(self)
        if structure is not None:
            structure_of.keep(changed, structure.at(changed))
        return changed

    def continued(self, q: Any, v: Any) -> Self:
        """The same mechanism at another state, q (nq,) and v (nv,), of a run from its own: drives
        continue their motion, and the units remain those of the run."""
        changed = super()._at(q, v, STATE_ARGUMENTS)
        structure_of.keep(changed, self.structure)
        return changed.with_drive_curves(self.drive_curves) if self.drives else changed

    def with_drive_curves(self, curves: dict[str, Curve]) -> Self:
        """The same mechanism, whose driven coordinates follow ``curves`` (by the drive's name)
        instead of beginning at q0: a motion that began before the initial state."""
        changed = super().with_drive_curves(curves)
        structure = structure_of.kept(self)
        if structure is not None:
            structure_of.keep(changed, structure)
        return changed

    def with_structure(self, structure: Structure) -> Self:
        """The same mechanism with ``structure`` instead of an analysis of its own."""
        changed = copy(self)
        structure_of.keep(changed, structure)
        return changed

    def __getstate__(self) -> dict[str, Any]:
        """The data and the analysis, which other processes then share."""
        return super().__getstate__() | {"structure": structure_of.kept(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if state["structure"] is not None:
            structure_of.keep(self, state["structure"])


@per_start
def _initial_errors(mechanism: Mechanism) -> tuple[FloatArray, FloatArray]:
    g, c = constraint_errors(mechanism, np.zeros(1), mechanism.q0[None], mechanism.v0[None])
    return g[0], c[0]


def check_mechanism(mechanism: Any) -> None:
    """Refuse what is not a mechanism.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if not isinstance(mechanism, Mechanism):
        raise InputError(
            f"{safe_repr(mechanism)} is not a mechanism",
            element="mechanism",
            remedy="Give srm.load(...) or srm.Mechanism(...)",
        )
