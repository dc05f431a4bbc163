"""Frames of an SDF file: who is placed relative to whom, and where each is.

Names follow SDF 1.7 and later (``http://sdformat.org/tutorials?tut=pose_frame_semantics``): every
link, joint, frame and nested model is a frame of its model; ``a::b`` is the frame b of the nested
model a; ``__model__`` is a model's own frame.  Older files fit in: they have no frames but these.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from srm_mbs.anchors import WORLD
from srm_mbs.errors import InputError
from srm_mbs.loading.xml_values import XmlValues

MODEL = "__model__"
SEPARATOR = "::"
RESERVED = ("world", "__model__", "__root__")


def joint_frame(name: str, version: tuple[int, int]) -> str:
    """Name of a joint's frame; before SDF 1.7 nothing names it, and links may be called alike."""
    return name if version >= (1, 7) else f"{name}{SEPARATOR}__joint__"


def pose(
    values: XmlValues, text: str | None, where: str, degrees: bool, quaternion: bool
) -> pin.SE3:
    """A pose from its text: x y z and roll pitch yaw, or x y z and a quaternion x y z w."""
    if not (text or "").split():
        return pin.SE3.Identity()
    numbers = values.numbers(text, 7 if quaternion else 6, where, "<pose>")
    if not quaternion:
        angles = np.deg2rad(numbers[3:]) if degrees else numbers[3:]
        return pin.SE3(pin.rpy.rpyToMatrix(angles), numbers[:3])
    length = float(np.linalg.norm(numbers[3:]))
    if abs(length - 1.0) > 1e-3:
        raise values.fault(
            where, f"the quaternion of <pose> has length {length:.6g}", "Give a unit quaternion"
        )
    return pin.SE3(pin.Quaternion(numbers[3:] / length).matrix(), numbers[:3])


@dataclass
class _Frame:
    relative_to: str
    placement: pin.SE3
    where: str
    body: str | None
    attached_to: str


@dataclass
class Frames:
    """The frames of a file by full name; placed in any order, resolved on demand.

    Full names have the names of all nested models in front; the frame of the outermost model is
    ``__model__``.
    """

    file: str
    _frames: dict[str, _Frame] = field(default_factory=dict)
    _found: dict[str, pin.SE3] = field(default_factory=dict)

    def add(
        self,
        name: str,
        relative_to: str,
        placement: pin.SE3,
        where: str,
        *,
        body: str | None = None,
        attached_to: str = WORLD,
    ) -> None:
        """Place a frame; ``body`` is the link that it is part of, or ``attached_to`` tells."""
        if name in self._frames:
            raise InputError(
                f"two links, joints, frames or models of one model are called {name!r}",
                file=self.file,
                element=where,
                remedy="Rename one of them",
            )
        self._frames[name] = _Frame(relative_to, placement, where, body, attached_to)

    def _unknown(self, name: str, where: str) -> InputError:
        return InputError(
            f"there is no link, joint, frame or model {name!r}",
            file=self.file,
            element=where,
            remedy=f"Known: {', '.join((WORLD, *self._frames))}",
        )

    def placement(self, name: str, where: str) -> pin.SE3:
        """Placement of a frame in the world.

        Raises
        ------
        InputError
            If there is no such frame, or it is placed relative to itself.
        """
        chain: list[str] = []
        while name != WORLD and name not in self._found:
            if name not in self._frames:
                raise self._unknown(name, self._frames[chain[-1]].where if chain else where)
            if name in chain:
                raise InputError(
                    f"its pose is relative to itself: {' -> '.join((*chain, name))}",
                    file=self.file,
                    element=self._frames[name].where,
                    remedy="Break the ring of relative_to",
                )
            chain.append(name)
            name = self._frames[name].relative_to
        at = pin.SE3.Identity() if name == WORLD else self._found[name]
        for each in reversed(chain):
            at = at * self._frames[each].placement
            self._found[each] = at
        return at

    def body(self, name: str, where: str) -> str:
        """Name of the link that a frame is part of, or ``world``.

        Raises
        ------
        InputError
            If there is no such frame, or it is attached to itself.
        """
        seen: list[str] = []
        while name != WORLD:
            if name not in self._frames:
                raise self._unknown(name, where)
            frame = self._frames[name]
            if frame.body is not None:
                return frame.body
            if name in seen:
                raise InputError(
                    f"it is attached to itself: {' -> '.join((*seen, name))}",
                    file=self.file,
                    element=frame.where,
                    remedy="Break the ring of attached_to",
                )
            seen.append(name)
            name = frame.attached_to
        return WORLD
