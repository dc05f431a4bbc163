"""Drives: motions prescribed over time, as the constraints g(q) = s(t).

A drive removes one degree of freedom; the force that it exerts is ``solution.drive_forces``.

The fields of :class:`Drive` are the one list of the keys of a drive: descriptions
(:mod:`srm_mbs.formats.toml.schema`) and saved runs (:mod:`srm_mbs.simulation.storage`) read them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import workspace
from srm_mbs.errors import InputError, safe_repr
from srm_mbs.model.anchors import Anchor, check_apart, name_places, one_degree_joint
from srm_mbs.model.closures import LoopClosure
from srm_mbs.model.copies import short_repr
from srm_mbs.model.laws import (
    Curve,
    Law,
    Polynomial,
    Sine,
    Table,
    check_law,
    curve_of,
    is_of_package,
)
from srm_mbs.model.numbers import checked_name, unit_vector

LAWS_WITH_VALUES = (Table, Polynomial, Sine)
"""Laws with a value s(0) of their own, which can prescribe positions."""

NOMINAL_LENGTH = 1e-9
"""Length (m) of the closure of a driven distance, which the rows of the drive subtract again."""


@dataclass(frozen=True, repr=False)
class Drive:
    """A prescribed motion of a joint, or of a point relative to another.

    By default the law is the motion *from the initial value*: q(t) = q_initial + s(t) - s(0).

    Parameters
    ----------
    law
        From :mod:`srm_mbs.model.laws`: :class:`~srm_mbs.model.laws.ConstantSpeed`, ...
    joint
        Name of a joint with one degree of freedom (rad; prismatic: m).  The angle of a continuous
        joint counts turns.
    a, b
        Instead of a joint: anchors on different bodies, with ``axis`` or ``distance``.
    axis : (3,)
        In b's frame: the position (m) of a's origin along it is driven.
    distance
        True: the distance (m) of the two origins is driven.
    absolute
        True: the law is the position itself, q(t) = s(t); for laws with values of their own
        (table, polynomial, sine).  The mechanism is then assembled with q(0) = s(0).
    name
        Unique name; by default that of the joint, or ``drive_a_b``.

    Raises
    ------
    InputError
        Unless exactly one motion is described, or for a malformed value.
    """

    law: Law
    joint: str | None = None
    a: Anchor | None = None
    b: Anchor | None = None
    axis: Sequence[float] | None = field(default=None, metadata={"count": 3})
    distance: bool = False
    absolute: bool = False
    name: str = ""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        places = name_places(self._element, self.a, self.b)
        name = checked_name(self.name, "drive") or self.joint or "_".join(["drive", *places])
        object.__setattr__(self, "name", name)
        if not isinstance(self.law, Law):
            raise self._fault(
                f"{safe_repr(self.law)} is not a law",
                "Give srm.ConstantSpeed(...) or alike; a law of your own inherits from "
                "srm_mbs.model.laws.Law",
            )
        check_law(self.law)
        anchors = self.a is not None and self.b is not None
        if (self.joint is None) != anchors or (self.a is None) != (self.b is None):
            raise self._fault(
                "a drive moves either a joint or a point relative to another",
                "Give joint, or a and b",
            )
        if [self.axis is not None, bool(self.distance)].count(True) != anchors:
            raise self._fault(
                "what is driven is not determined",
                "Give axis = [x, y, z] or distance = true with a and b, and neither with a joint",
            )
        if self.absolute and not isinstance(self.law, LAWS_WITH_VALUES):
            raise self._fault(
                f"the law {self.law.type!r} starts from the initial value in any case",
                "Remove absolute",
            )
        if self.axis is not None:
            object.__setattr__(self, "axis", unit_vector(self.axis, "axis", self._element))

    @property
    def _element(self) -> str:
        """Its name in messages."""
        return f"drive {safe_repr(self.name)}"

    def _fault(self, problem: str, remedy: str) -> InputError:
        return InputError(problem, element=self._element, remedy=remedy)

    @property
    def closure(self) -> LoopClosure | None:
        """For a point: the closure whose row is g(q); None for a joint."""
        if self.a is None or self.b is None:
            return None
        if self.distance:
            return LoopClosure("distance", self.a, self.b, name=self.name, length=NOMINAL_LENGTH)
        axis: Any = self.axis
        return LoopClosure("point_on_plane", self.a, self.b, axis, self.name)

    def frozen(self, value: float) -> LoopClosure:
        """For a point: the closure that holds its coordinate at ``value`` (m).

        Raises
        ------
        InputError
            For a distance that is not positive.
        """
        moving = self.closure
        if moving is None or moving.b is None:
            raise self._fault("it moves a joint", "Hold that in q")
        if moving.axis is None:
            return replace(moving, length=value)
        b = moving.b
        ahead = pin.rpy.rpyToMatrix(np.array(b.rpy)) @ np.array(moving.axis) * value
        x, y, z = (np.array(b.xyz) + ahead).tolist()
        return replace(moving, b=Anchor(b.link, b.frame, (x, y, z), b.rpy))

    def curve(self, initial: float) -> Curve:
        """s(t) for the coordinate that is ``initial`` at t = 0.

        Raises
        ------
        InputError
            If a law of the user is no curve, or one that no motion follows because it jumps.
        """
        curve = curve_of(self.law, initial)
        jump = None if is_of_package(self.law) else curve.jump()
        if jump is not None:
            raise self._fault(
                f"{jump[1]} at t = {jump[0]:g} s, by its law {self.law.type!r}",
                "Let them be continuous, or let an event change the drive",
            )
        return curve if self.absolute else curve.shifted(initial - curve(0.0)[0])

    def check(self, model: pin.Model) -> None:
        """Refuse a joint, link or frame that ``model`` does not have or that cannot be driven.

        Raises
        ------
        InputError
            Naming the drive and the remedy.
        """
        if self.a is not None and self.b is not None:
            check_apart(model, self.a, self.b, self._element)
        else:
            instead = "Drive a point with a, b and axis, or model it with joints of one degree"
            one_degree_joint(model, self.joint, self._element, instead)


def in_order_of_rows(drives: Sequence[Drive]) -> tuple[Drive, ...]:
    """The drives in the order of their rows (after those of the loops): points, then joints."""
    return tuple(sorted(drives, key=lambda drive: drive.joint is not None))


def positions(model: pin.Model, drives: Sequence[Drive], q: Any) -> dict[str, float]:
    """The driven coordinate of each drive (rad, m) at q (nq,); angles of continuous joints in
    (-pi, pi]."""
    out: dict[str, float] = {}
    if not drives:
        return out
    data = workspace(model)
    pin.forwardKinematics(model, data, np.asarray(q, dtype=float))
    for drive in drives:
        if drive.a is None or drive.b is None:
            joint = model.joints[model.getJointId(drive.joint)]
            own = q[joint.idx_q]
            out[drive.name] = float(own if joint.nq == 1 else np.arctan2(q[joint.idx_q + 1], own))
            continue
        (at_a, in_a), (at_b, in_b) = drive.a.resolve(model), drive.b.resolve(model)
        apart = (data.oMi[at_b] * in_b).actInv((data.oMi[at_a] * in_a).translation)
        axis = None if drive.axis is None else np.array(drive.axis)
        out[drive.name] = float(np.linalg.norm(apart) if axis is None else axis @ apart)
    return out
