"""The joints of a URDF, one by one: type, axes, limits, damping and friction."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from srm_mbs.loading.joint_types import EXTENDED_TYPES
from srm_mbs.loading.urdf_elements import ElementChecker

URDF_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
JOINT_TYPES = (*URDF_TYPES, *EXTENDED_TYPES)
WITH_AXIS = ("revolute", "continuous", "prismatic", "planar", "universal", "screw")
WITH_LIMIT = ("revolute", "continuous", "prismatic", "screw")
UNIVERSE = "universe"
"""Pinocchio's name for the ground."""
ROOT_JOINT = "root_joint"
"""Pinocchio's name for the joint of a floating or planar base."""
PARALLEL = 1e-6
"""Axes of a universal joint at a smaller angle (rad) are parallel."""


class JointChecker(ElementChecker):
    """Checks one joint at a time."""

    def joint(self, name: str, joint: Element, base: str, locked: bool) -> None:
        where = f"joint {name!r}"
        if name == UNIVERSE or (name == ROOT_JOINT and base != "fixed"):
            raise self.fault(
                where,
                f"the name {name!r} is reserved"
                + (f' with base = "{base}"' if name == ROOT_JOINT else ""),
                "Rename the joint",
            )
        self.children(joint, where)
        kind = joint.get("type")
        if kind not in JOINT_TYPES:
            raise self.fault(
                where, f"there is no joint type {kind!r}", f"Known: {', '.join(JOINT_TYPES)}"
            )
        self.origin(joint, where)
        self.axis(joint, kind, where)
        self.only_of(joint, kind, where)
        self.limit(joint, kind, where)
        self.dynamics(joint, kind, where, locked)

    def axis(self, joint: Element, kind: str, where: str) -> None:
        axis = joint.find("axis")
        if axis is not None and kind not in WITH_AXIS:
            joint.remove(axis)
            axis = None
        direction = [1.0, 0.0, 0.0] if axis is None else self.direction(axis, where)
        if kind == "planar" and (direction[:2] != [0.0, 0.0] or direction[2] < 0.0):
            given = " (the default of URDF)" if axis is None else ""
            raise self.fault(
                where,
                f"the normal of a planar joint is read along z only, not {direction}{given}",
                'Write <axis xyz="0 0 1"/> and turn the joint by <origin rpy=...>',
            )

    def direction(self, axis: Element, where: str) -> list[float]:
        """The unit vector of <axis> or <axis2>, written afresh."""
        direction = self.numbers(axis, "xyz", 3, where)
        if not any(direction):
            raise self.fault(where, "its axis is zero", "Give a direction")
        # Pinocchio does not normalise a tiny axis, and takes 2 x for an inclined one.
        length = math.hypot(*direction)
        direction = [component / length for component in direction]
        axis.set("xyz", " ".join(map(repr, direction)))
        return direction

    def only_of(self, joint: Element, kind: str, where: str) -> None:
        """<axis2> of a universal joint and <thread_pitch> of a screw."""
        for tag, owner in (("axis2", "universal"), ("thread_pitch", "screw")):
            node = joint.find(tag)
            if (node is not None) != (kind == owner):
                raise self.fault(
                    where,
                    f"a {kind} joint takes no <{tag}>"
                    if node is not None
                    else f"a {owner} joint needs <{tag}>",
                    "Remove it" if node is not None else "Add it",
                )
            if node is None:
                continue
            if tag == "thread_pitch":
                if self.numbers(node, "value", 1, where) == [0.0]:
                    raise self.fault(
                        where, "its thread pitch is zero", 'Give m per turn, or type="revolute"'
                    )
                continue
            axis = joint.find("axis")
            first = [1.0, 0.0, 0.0] if axis is None else self.direction(axis, where)
            second = self.direction(node, where)
            if np.linalg.norm(np.cross(first, second)) < PARALLEL:
                raise self.fault(
                    where, "<axis> and <axis2> are parallel", "Give them different directions"
                )

    def limit(self, joint: Element, kind: str, where: str) -> None:
        limit = joint.find("limit")
        if limit is None:
            if kind in ("revolute", "prismatic"):
                raise self.fault(
                    where,
                    f"a {kind} joint needs <limit lower upper effort velocity>",
                    'Add it, or use type="continuous" for an unlimited angle'
                    if kind == "revolute"
                    else "Add it",
                )
            return
        for key in limit.attrib:
            self.numbers(limit, key, 1, where)
        if kind not in WITH_LIMIT:
            joint.remove(limit)
            return
        for key in ("effort", "velocity"):
            if limit.get(key) is None and kind in ("continuous", "screw"):
                limit.set(key, "0.0")  # Pinocchio wants both; limits do not act here
            (value,) = self.numbers(limit, key, 1, where)
            if value < 0.0:
                raise self.fault(
                    where, f"the limit {key} = {value:g} is negative", "Give a value >= 0"
                )
        lower, upper = (
            self.numbers(limit, key, 1, where)[0] if key in limit.attrib else 0.0
            for key in ("lower", "upper")
        )
        if lower > upper:
            self.notes.append(
                f"{where}: its limits are none: lower = {lower:g} is above upper = {upper:g}"
            )

    def dynamics(self, joint: Element, kind: str, where: str, locked: bool) -> None:
        dynamics = joint.find("dynamics")
        if dynamics is None:
            return
        for key in dynamics.attrib:
            (value,) = self.numbers(dynamics, key, 1, where)
            if value < 0.0:
                raise self.fault(where, f"the {key} {value:g} is negative", "Give a value >= 0")
            if value != 0.0 and kind in ("floating", "planar") and not locked:
                raise self.fault(
                    where,
                    f"the {key} ({value:g}) of a {kind} joint is not simulated by this version",
                    "Set it to 0; that of one-degree joints acts",
                )
        if not dynamics.attrib:
            joint.remove(dynamics)
