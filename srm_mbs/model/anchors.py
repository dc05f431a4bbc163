"""Anchors, frames fixed on bodies, and joints: where closures, forces and drives act."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.errors import InputError, joined_names, known_names, safe_repr
from srm_mbs.model.copies import copied, short_repr
from srm_mbs.model.numbers import vector

_UNTURNED, _IDENTITY = np.eye(3), np.eye(4)
WORLD = "world"
"""Reserved link name: the fixed ground."""

_GIVE_ANCHOR = 'Give for example srm.Anchor("rod", xyz=(1.0, 0.0, 0.0))'


@dataclass(frozen=True, repr=False)
class Anchor:
    """A frame fixed on a body, at which a closure, force or drive acts.

    Parameters
    ----------
    link
        Name of a link (a Pinocchio ``BODY`` frame), or ``"world"``.
    frame
        Name of any Pinocchio frame, instead of ``link``.  After a link it may be ``xyz``:
        ``Anchor("rod", (1.0, 0.0, 0.0))``.
    xyz : (3,) m
        Origin of the anchor in the link's or frame's own frame.
    rpy : (3,) rad
        Its orientation there: fixed-axis roll, pitch, yaw as in URDF.

    Raises
    ------
    InputError
        If neither or both of ``link`` and ``frame`` are given, or a vector is malformed.
    """

    link: str | None = None
    frame: str | Sequence[float] | None = None
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if self.link is not None and isinstance(self.frame, tuple | list | np.ndarray):
            object.__setattr__(self, "xyz", self.frame)
            object.__setattr__(self, "frame", None)
        if (self.link is None) == (self.frame is None):
            raise InputError(
                "an anchor needs either a link or a frame",
                element="anchor",
                remedy='Write { link = "rod" } or { frame = "rod_tip" }, not both',
            )
        object.__setattr__(self, "xyz", vector(self.xyz, "xyz"))
        object.__setattr__(self, "rpy", vector(self.rpy, "rpy"))

    @property
    def where(self) -> str:
        """Name of the link or frame."""
        return str(self.link if self.link is not None else self.frame)

    def at(self, xyz: tuple[float, float, float]) -> Anchor:
        """The same anchor with another origin (3,) m, finite floats."""
        return copied(self, xyz=xyz)

    def resolve(self, model: pin.Model) -> tuple[int, pin.SE3]:
        """Joint that carries the anchor (0: ground) and the anchor's placement in that joint.

        Raises
        ------
        InputError
            If the model has no such link or frame; the message lists those it has.
        """
        rotation = pin.rpy.rpyToMatrix(np.array(self.rpy)) if any(self.rpy) else _UNTURNED
        offset = pin.SE3(rotation, np.array(self.xyz))
        if self.link == WORLD:
            return 0, offset
        frame = self._frame(model)
        return int(frame.parentJoint), frame.placement * offset

    def carrier(self, model: pin.Model) -> pin.SE3 | None:
        """Placement of its link or frame in the joint; None where that is the identity."""
        if self.link == WORLD:
            return None
        placement = self._frame(model).placement
        return None if np.array_equal(placement.homogeneous, _IDENTITY) else placement

    def origin_of(self, other: Anchor, carrier: pin.SE3 | None) -> list[float] | None:
        """Origin (3,) of ``other`` in the axes of the joint, as :meth:`resolve` has it, if it is on
        the same link or frame, with this :meth:`carrier`, and has the same axes; None otherwise."""
        if other.link != self.link or other.frame != self.frame or other.rpy != self.rpy:
            return None
        if carrier is None:
            return [x + 0.0 for x in other.xyz]  # no zero has a sign
        return (carrier * pin.SE3(_UNTURNED, np.array(other.xyz))).translation.tolist()  # type: ignore[no-any-return]

    def joint(self, model: pin.Model) -> int:
        """The joint of :meth:`resolve`, which raises the same, without the placement."""
        return 0 if self.link == WORLD else int(self._frame(model).parentJoint)

    def _frame(self, model: pin.Model) -> Any:
        """The frame of ``model`` that it is on."""
        body, missing = pin.FrameType.BODY, model.nframes
        if self.link is not None:
            index = model.getFrameId(self.link, body)
        else:
            frames = enumerate(model.frames)
            index = next((i for i, frame in frames if frame.name == self.frame), missing)
        if index == missing:
            kind = "link" if self.link is not None else "frame"
            names = {f.name for f in model.frames if kind == "frame" or f.type == body}
            names = names - {"universe"} | {WORLD}
            remedy = known_names(sorted(names))
            joint = model.getJointId(self.where)
            if 0 < joint < model.njoints:
                moved = [f.name for f in model.frames if f.type == body and f.parentJoint == joint]
                remedy += f". The joint of this name moves {joined_names(moved)}"
                if not moved:
                    remedy += ": add a link with model.addBodyFrame"
            raise InputError(f"there is no {kind} {safe_repr(self.where)}", remedy=remedy)
        return model.frames[index]


def name_places(element: str, *anchors: Any) -> list[str]:
    """Names of the links or frames of the anchors that are not None.

    Raises
    ------
    InputError
        About the ``element`` if one is neither an anchor nor None.
    """
    for anchor in anchors:
        if not isinstance(anchor, Anchor | None):
            raise InputError(
                f"{safe_repr(anchor)} is not an anchor", element=element, remedy=_GIVE_ANCHOR
            )
    return [anchor.where for anchor in anchors if anchor is not None]


def _resolve(model: pin.Model, anchor: Anchor, element: str) -> tuple[int, pin.SE3]:
    """:meth:`Anchor.resolve`, with an error about ``element``."""
    try:
        return anchor.resolve(model)
    except InputError as error:
        error.element = element
        raise


def check_apart(model: pin.Model, a: Anchor, b: Anchor, element: str) -> None:
    """Refuse anchors of ``element`` that are not on two different bodies of ``model``.

    Raises
    ------
    InputError
        If the model has no such link or frame, or both lie on the same body.
    """
    joints = []
    for anchor, side in ((a, "a"), (b, "b")):
        try:
            joints.append(anchor.joint(model))
        except InputError as error:
            error.element = f"{element}, anchor {side}"
            raise
    if joints[0] == joints[1]:
        raise InputError(
            "both anchors lie on the same body",
            element=element,
            remedy="Anchor it on two bodies that move relative to each other "
            "(locked and fixed joints join bodies)",
        )


def resolve_moving(
    model: pin.Model, anchors: Sequence[Anchor], element: str
) -> list[tuple[int, pin.SE3]]:
    """Moving points, each as in :meth:`Anchor.resolve`.

    Raises
    ------
    InputError
        About ``element`` if one is no anchor, does not exist, or lies on the ground.
    """
    if isinstance(anchors, Anchor):
        raise InputError(f"{element} is one anchor", element=element, remedy="Give a list of them")
    try:
        given: list[Any] = list(anchors)
    except Exception:  # objects may raise anything
        given = [anchors]
    found = []
    for anchor in given:
        if not isinstance(anchor, Anchor):
            raise InputError(
                f"{safe_repr(anchor)} is not a point of a link",
                element=element,
                remedy=_GIVE_ANCHOR,
            )
        joint, placement = _resolve(model, anchor, element)
        if joint == 0:
            raise InputError(
                f"{anchor.where!r} lies on the ground and does not move",
                element=element,
                remedy="Name a point of a link that moves",
            )
        found.append((joint, placement))
    return found


def moving_joint(model: pin.Model, name: str | None, element: str) -> Any:
    """Pinocchio's model of the joint ``name``, on which ``element`` acts.

    Raises
    ------
    InputError
        About ``element`` if there is no such moving joint; the message lists those there are.
    """
    names = list(model.names)[1:]
    if not isinstance(name, str) or name not in names:
        raise InputError(
            f"there is no moving joint {safe_repr(name)}",
            element=element,
            remedy=known_names(names),
        )
    return model.joints[model.getJointId(name)]


def one_degree_joint(model: pin.Model, name: str | None, element: str, instead: str) -> Any:
    """:func:`moving_joint` with one degree of freedom; ``instead`` is the remedy for others.

    Raises
    ------
    InputError
        About ``element`` if there is no such moving joint, or it has several degrees of freedom.
    """
    joint = moving_joint(model, name, element)
    if joint.nv != 1:
        raise InputError(
            f"joint {safe_repr(name)} has {joint.nv} degrees of freedom",
            element=element,
            remedy=instead,
        )
    return joint


def turn_counting_joint(model: pin.Model, name: str | None, element: str, instead: str) -> Any:
    """:func:`one_degree_joint` whose coordinate counts turns: not a (cos, sin) pair.

    Raises
    ------
    InputError
        About ``element``, as there, and for a continuous joint.
    """
    joint = one_degree_joint(model, name, element, instead)
    if joint.nq != 1:
        raise InputError(
            f"the angle of the continuous joint {safe_repr(name)} does not count turns",
            element=element,
            remedy='Make the joint "revolute" in the URDF, with wide limits: they do not act',
        )
    return joint
