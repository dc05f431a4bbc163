"""A joint that closes a loop: the closure that leaves the same freedom.

Every format with loops names its joint types a little differently; they meet here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.loading.urdf_writer import anchor

CLOSURE_OF = {
    "revolute": "revolute",
    "continuous": "revolute",
    "hinge": "revolute",
    "prismatic": "prismatic",
    "cylindrical": "cylindrical",
    "planar": "planar",
    "universal": "universal",
    "spherical": "point",
    "ball": "point",
    "fixed": "frame",
}
"""Joint types of all formats, and the closure of the same freedom."""
WITH_AXIS = ("revolute", "prismatic", "cylindrical", "planar")
ROTATION_SEEN = ("frame", "prismatic")
"""Closures for which the turn of a about the axis matters."""
PARALLEL = 1e-9


def placement(xyz: Sequence[float], rpy: Sequence[float]) -> pin.SE3:
    """Placement of a URDF <origin>; m and rad."""
    return pin.SE3(pin.rpy.rpyToMatrix(np.array(rpy)), np.array(xyz))


def closure(
    kind: str,
    name: str,
    parent: tuple[str, pin.SE3],
    child: tuple[str, pin.SE3],
    axis: Sequence[float] | None = None,
    child_axis: Sequence[float] | None = None,
    *,
    fault: Callable[[str, str], Exception],
) -> dict[str, Any]:
    """The ``[[loop]]`` of a joint of type ``kind`` between two links.

    The child is a of the closure, the parent is b: the axis is given in the joint's frame on the
    parent, as URDF and SDF do.

    Parameters
    ----------
    kind
        Joint type in the words of its format.
    name
        Of the closure.
    parent, child
        Link and, in its frame, the joint's frame.
    axis, child_axis : (3,)
        Direction in the frame on the parent and, if it is given separately, in that on the child;
        for a universal joint the two axes of the cross.  x by default.
    fault
        Makes the exception of a problem and its remedy.

    Raises
    ------
    Exception
        What ``fault`` makes, for a type without closure, or axes that do not fit together.
    """
    type_ = CLOSURE_OF.get(kind)
    if type_ is None:
        raise fault(
            f"there is no closure for a joint of type {kind!r}",
            f"Known: {', '.join(CLOSURE_OF)}; or cut the loop at another joint",
        )
    direction = _unit((1.0, 0.0, 0.0) if axis is None else axis, fault)
    other = direction if child_axis is None else _unit(child_axis, fault)
    at = child[1]
    out: dict[str, Any] = {"name": name, "type": type_}
    if type_ == "universal":
        if child_axis is None:
            raise fault("a universal joint needs two axes", "Give both")
        out |= {"axis_a": other.tolist(), "axis_b": direction.tolist()}
    elif type_ in WITH_AXIS:
        out["axis"] = direction.tolist()
        if np.linalg.norm(other - direction) > PARALLEL:
            if type_ in ROTATION_SEEN:
                raise fault(
                    f"the axes of a {kind} joint in its two frames differ",
                    "Turn one of the frames so that the axis has the same components in both",
                )
            # About the axis itself the child is free to turn.
            turn = pin.Quaternion.FromTwoVectors(direction, other).matrix()
            at = at * pin.SE3(turn, np.zeros(3))
    return out | {"a": anchor(child[0], at), "b": anchor(*parent)}


def bushing(
    name: str,
    kind: str,
    parent: tuple[str, pin.SE3],
    child: tuple[str, pin.SE3],
    axis: Sequence[float],
    *,
    stiffness: float = 0.0,
    damping: float = 0.0,
    rest: float = 0.0,
) -> dict[str, Any]:
    """The ``[[force]]`` that acts as spring and damper of a revolute or prismatic joint.

    It acts in the one direction that the joint leaves free; ``parent``, ``child`` and ``axis`` are
    those of :func:`closure`, ``rest`` is where the spring is relaxed (rad, m).
    """
    # x of both anchors along the axis; b moves on to where the spring is relaxed.
    turn = pin.SE3(
        pin.Quaternion.FromTwoVectors(np.array([1.0, 0.0, 0.0]), np.array(axis)).matrix(),
        np.zeros(3),
    )
    relaxed = pin.SE3.Identity()
    direction = 0
    if CLOSURE_OF[kind] == "prismatic":
        relaxed.translation = np.array([rest, 0.0, 0.0])
    else:
        relaxed.rotation = pin.rpy.rpyToMatrix(rest, 0.0, 0.0)
        direction = 3
    out: dict[str, Any] = {
        "type": "bushing",
        "name": name,
        "a": anchor(child[0], child[1] * turn),
        "b": anchor(parent[0], parent[1] * turn * relaxed),
    }
    for key, value in (("stiffness", stiffness), ("damping", damping)):
        if value:
            out[key] = [value if i == direction else 0.0 for i in range(6)]
    return out


def _unit(axis: Sequence[float], fault: Callable[[str, str], Exception]) -> FloatArray:
    direction = np.array(axis, dtype=float)
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        raise fault("its axis is zero", "Give a direction")
    out: FloatArray = direction / length
    return out
