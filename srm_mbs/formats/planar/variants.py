"""The model of a variant of a linkage: that of another variant with other numbers.

Variants of a description mostly differ in lengths and masses.  If their trees have the same shape,
Pinocchio's model is copied and gets other placements and inertias, as Pinocchio's reader of URDF
would compute them; texts, the check of the XML and Pinocchio's reader are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import share_scratch
from srm_mbs.formats.graph.joint_graph import Body, Joint
from srm_mbs.formats.graph.spanning_tree_to_urdf import is_identity
from srm_mbs.formats.translation import KnownTree, TreeParts
from srm_mbs.formats.urdf.variants import inertia_as_read, plain_numbers

UNTURNED = np.eye(3)


def plain_parts(bodies: Sequence[Body], joints: Sequence[Joint]) -> TreeParts | None:
    """The parts of a tree for its variants; None where the check of the tree would have a note or a
    fault about its numbers."""
    parts = TreeParts(bodies, joints)
    inertias = [body.inertia for body in bodies if body.inertia is not None]
    plain = inertias and joints and plain_numbers(inertias, [joint.in_parent for joint in joints])
    return parts if plain else None


def model_of_variant(
    known: KnownTree | None, bodies: Sequence[Body], joints: Sequence[Joint]
) -> pin.Model | None:
    """The model of a tree whose links have their frames at their joints; None unless it is the
    known one with other translations of joints and inertias, about which the check of a tree would
    say nothing.

    Every joint is in its parent with the axes of this.
    """
    if known is None or not _same_tree(known.parts, bodies, joints):
        return None
    heavier = {
        body.name: body.inertia
        for body, own in zip(bodies, known.parts.bodies)
        if body.inertia is not None and body.inertia != own.inertia
    }
    moved = [
        joint for joint, own in zip(joints, known.parts.joints) if joint.in_parent != own.in_parent
    ]
    return model_with(known, moved, heavier)


def model_with(
    known: KnownTree, moved: Sequence[Joint], inertias: Mapping[str, pin.Inertia]
) -> pin.Model | None:
    """The model of ``known`` with other translations of the joints ``moved`` and other ``inertias``
    of links, by name; None where the check of a tree would say something about them."""
    if not plain_numbers(list(inertias.values()), [joint.in_parent for joint in moved]):
        return None
    model = known.model.copy()
    share_scratch(known.model, model)
    for joint in moved:
        number = known.numbers[joint.child]
        place = joint.in_parent
        at = np.zeros(3) if is_identity(place) else place.translation + 0.0
        model.jointPlacements[number] = pin.SE3(model.jointPlacements[number].rotation, at)
    for link, inertia in inertias.items():
        centre = pin.SE3(UNTURNED, inertia.lever)
        lever = np.zeros(3) if is_identity(centre) else inertia.lever
        model.inertias[known.numbers[link]] = inertia_as_read(
            inertia.mass, lever.tobytes(), inertia.inertia.tobytes()
        )
    return model


def _same_tree(known: TreeParts, bodies: Sequence[Body], joints: Sequence[Joint]) -> bool:
    """Whether bodies and joints are those that are known, but for the translations of joints and
    the inertias of bodies."""
    if len(bodies) != len(known.bodies) or len(joints) != len(known.joints):
        return False
    return all(
        one.name == own.name and (one.inertia is None) == (own.inertia is None)
        for one, own in zip(bodies, known.bodies)
    ) and all(
        one.name == own.name
        and one.type == own.type
        and one.parent == own.parent
        and one.child == own.child
        and one.axis == own.axis
        for one, own in zip(joints, known.joints)
    )
