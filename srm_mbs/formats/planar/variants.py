"""The model of a variant of a linkage: that of another variant with other numbers.

Variants of a description mostly differ in lengths and masses.  If their trees have the same shape,
Pinocchio's model is copied and gets other placements and inertias, as Pinocchio's reader of URDF
would compute them; texts, the check of the XML and Pinocchio's reader are left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from srm_mbs.formats.graph.joint_graph import Body, Joint
from srm_mbs.formats.graph.spanning_tree_to_urdf import is_identity
from srm_mbs.formats.translation import KnownTree, TreeParts
from srm_mbs.formats.urdf.variants import inertia_as_read, model_with, plain_numbers

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
    inertias = {
        body.name: body.inertia
        for body, own in zip(bodies, known.parts.bodies)
        if body.inertia is not None and body.inertia != own.inertia
    }
    places = {
        joint.child: joint.in_parent
        for joint, own in zip(joints, known.parts.joints)
        if joint.in_parent != own.in_parent
    }
    if not plain_numbers(inertias.values(), places.values()):
        return None
    numbers = known.numbers
    return model_with(
        known.model,
        {numbers[link]: _as_written(place) for link, place in places.items()},
        {
            numbers[link]: inertia_as_read(
                own.mass, _as_written(pin.SE3(UNTURNED, own.lever)), own.inertia
            )
            for link, own in inertias.items()
        },
    )


def _as_written(place: pin.SE3) -> list[float]:
    """The translation of a place as a file gives it, which leaves out the identity."""
    return [0.0] * 3 if is_identity(place) else [x + 0.0 for x in place.translation]


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
