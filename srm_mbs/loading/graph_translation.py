"""From a graph of joints to a URDF tree, the closures of the joints cut, and their springs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import pinocchio as pin

from srm_mbs.anchors import WORLD
from srm_mbs.errors import InputError
from srm_mbs.loading.cut_joints import bushing, closure
from srm_mbs.loading.joint_graph import (
    Body,
    Joint,
    NoTreeError,
    SpanningTree,
    components,
    spanning_tree,
)
from srm_mbs.loading.translation import Translation
from srm_mbs.loading.urdf_writer import is_identity, urdf_text

MODEL_FRAME = "__model__"
"""Massless root link of a floating robot: the frame in which the file places its bodies."""


class GraphTranslator:
    """Translates bodies and joints of one file; raises :class:`InputError` at the first fault.

    Parameters
    ----------
    file, name
        Of the file, for messages, and of the robot.
    bodies
        By name, in the order of the file.
    placements
        Of the bodies in the world where every joint's position is zero.
    joints
        Between them.
    root
        The body that floats if nothing connects it with the ground.
    free
        Names for the joints by which bodies move freely beside others.
    """

    def __init__(
        self,
        file: str,
        name: str,
        bodies: Mapping[str, Body],
        placements: Mapping[str, pin.SE3],
        joints: Sequence[Joint],
        root: str,
        free: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.file, self.name = file, name
        self.bodies, self.placements = dict(bodies), placements
        self.joints = list(joints)
        self.root, self.free = root, free
        self.notes: list[str] = []

    def translate(self, cut: Sequence[str] = ()) -> Translation:
        """The tree and the entries ``base``, ``loop`` and ``force``.

        Parameters
        ----------
        cut
            Names of the joints to cut; empty: chosen by :func:`spanning_tree`.
        """
        base, root = self._rooted()
        try:
            tree = spanning_tree(self.joints, root, cut)
        except NoTreeError as error:
            raise InputError(
                error.problem, file=self.file, element="cut", remedy=error.remedy
            ) from error
        entries: dict[str, Any] = {"base": base} if base != "fixed" else {}
        loops = [self._closure(joint) for joint in tree.cut]
        forces = [
            force
            for joint in self.joints
            for force in (self._bushing(joint) if joint in tree.cut else self._spring(joint))
        ]
        if loops:
            entries["loop"] = loops
        if forces:
            entries["force"] = forces
        self._tell(tree)
        urdf = urdf_text(self.name, self.bodies.values(), tree.joints)
        return Translation(urdf, entries, tuple(self.notes))

    def _rooted(self) -> tuple[str, str]:
        """Base and root body; bodies that hang on nothing get a floating joint to the ground."""
        parts = [part for part in components(self.bodies, self.joints) if part != [WORLD]]
        free = [part for part in parts if WORLD not in part]
        if len(parts) == 1 and free:
            root = self.root
            if is_identity(self.placements[root]):
                return "floating", root
            frame = Body(MODEL_FRAME)
            self.bodies = {MODEL_FRAME: frame, **self.bodies}
            self.joints.insert(
                0,
                Joint(f"{MODEL_FRAME}::{root}", "fixed", MODEL_FRAME, root, self.placements[root]),
            )
            return "floating", MODEL_FRAME
        for part in free:
            known = next((body for body in part if body in self.free), None)
            body = known or (self.root if self.root in part else part[0])
            name = self.free.get(body, f"{body}::free")
            self.joints.append(Joint(name, "floating", WORLD, body, self.placements[body]))
            if known is None:
                self.notes.append(
                    f"nothing connects {body!r} with the ground: it moves freely by the joint "
                    f"{name!r}"
                )
        return "fixed", WORLD

    def _refuse_cut(self, joint: Joint, why: str) -> InputError:
        return InputError(
            f"it closes a loop and has {why}, which no closure has",
            file=self.file,
            element=f"joint {joint.name!r}",
            remedy="Name another joint of the loop in cut",
        )

    def _closure(self, joint: Joint) -> dict[str, Any]:
        """The closure for a joint that is cut."""
        for value, why in (
            (joint.friction, "friction"),
            (joint.armature, "armature"),
            (joint.type == "screw", "a thread"),
            (joint.coupled, "a coupling to another joint"),
        ):
            if value:
                raise self._refuse_cut(joint, why)
        return closure(
            joint.type,
            joint.name,
            (joint.parent, joint.in_parent),
            (joint.child, joint.in_child),
            joint.axis,
            joint.second_axis,
            fault=lambda problem, remedy: InputError(
                problem, file=self.file, element=f"joint {joint.name!r}", remedy=remedy
            ),
        )

    def _bushing(self, joint: Joint) -> list[dict[str, Any]]:
        """Spring and damper of a joint that is cut, in the one direction that it leaves free."""
        if not (joint.stiffness or joint.damping):
            return []
        if joint.type not in ("revolute", "prismatic"):
            raise self._refuse_cut(joint, "damping or a spring")
        return [
            bushing(
                f"{joint.name}::spring",
                joint.type,
                (joint.parent, joint.in_parent),
                (joint.child, joint.in_child),
                joint.axis,
                stiffness=joint.stiffness,
                damping=joint.damping,
                rest=joint.rest,
            )
        ]

    def _spring(self, joint: Joint) -> list[dict[str, Any]]:
        """The spring of a joint of the tree; its damping is in the URDF."""
        if not joint.stiffness:
            return []
        return [
            {
                "type": "torsion_spring",
                "name": f"{joint.name}::spring",
                "joint": joint.name,
                "stiffness": joint.stiffness,
                "rest_angle": joint.rest,
            }
        ]

    def _tell(self, tree: SpanningTree) -> None:
        if tree.cut:
            names = ", ".join(repr(joint.name) for joint in tree.cut)
            self.notes.append(f"the joints {names} close loops: they are cut and became closures")
        turned = [
            repr(joint.name)
            for joint in tree.joints
            if joint.name in tree.reversed and joint.type in ("universal", "spherical", "floating")
        ]
        if turned:
            self.notes.append(
                f"in the tree the joints {', '.join(turned)} start from their child: their "
                "coordinates are those of the parent against the child"
            )
