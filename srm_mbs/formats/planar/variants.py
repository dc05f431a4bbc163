"""The model of a variant of a linkage: that of another variant with other numbers.

Variants of a description mostly differ in lengths and masses.  If their trees have the same shape,
Pinocchio's model is copied and gets other placements and inertias, as Pinocchio's reader of URDF
would compute them; texts, the check of the XML and Pinocchio's reader are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import share_scratch
from srm_mbs.formats.graph.joint_graph import Body, Joint
from srm_mbs.formats.graph.spanning_tree_to_urdf import is_identity
from srm_mbs.formats.translation import KnownTree, TreeParts
from srm_mbs.formats.urdf.validation import doubtful_moments
from srm_mbs.model.numbers import LARGEST_MAGNITUDE

KEPT_BODIES = 1024
"""Inertias that are kept: variants of a linkage have most of them in common."""


def plain_parts(bodies: Sequence[Body], joints: Sequence[Joint]) -> TreeParts | None:
    """The parts of a tree for its variants; None where the check of the tree would have a note or a
    fault about its numbers."""
    parts = TreeParts(bodies, joints)
    inertias = [body.inertia for body in bodies if body.inertia is not None]
    plain = inertias and joints and _plain(inertias, [joint.in_parent for joint in joints])
    return parts if plain else None


def _plain(inertias: Sequence[pin.Inertia], places: Sequence[pin.SE3]) -> bool:
    """Whether the numbers of a tree are those of real bodies, and of sensible size."""
    numbers = [place.translation for place in places]
    if inertias:
        masses = np.array([inertia.mass for inertia in inertias])
        tensors = np.array([inertia.inertia for inertia in inertias])
        if not (masses >= 0.0).all():
            return False
        negative, impossible = doubtful_moments(np.linalg.eigvalsh(tensors), masses)
        if negative.any() or impossible.any():
            return False
        numbers += [masses, tensors.ravel(), *(inertia.lever for inertia in inertias)]
    return not numbers or bool(np.abs(np.concatenate(numbers)).max() <= LARGEST_MAGNITUDE)


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
    if not _plain(list(inertias.values()), [joint.in_parent for joint in moved]):
        return None
    model = known.model.copy()
    share_scratch(known.model, model)
    for joint in moved:
        number = known.numbers[joint.child]
        place = joint.in_parent
        at = np.zeros(3) if is_identity(place) else place.translation + 0.0
        model.jointPlacements[number] = pin.SE3(model.jointPlacements[number].rotation, at)
    for link, inertia in inertias.items():
        model.inertias[known.numbers[link]] = _as_read(
            inertia.mass, inertia.lever.tobytes(), inertia.inertia.tobytes()
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


@lru_cache(maxsize=KEPT_BODIES)
def _as_read(mass: float, lever_numbers: bytes, tensor_numbers: bytes) -> pin.Inertia:
    """An inertia as Pinocchio's reader of URDF rounds it; nothing may change it."""
    lever, tensor = np.frombuffer(lever_numbers), np.frombuffer(tensor_numbers)
    if is_identity(pin.SE3(np.eye(3), lever)):
        lever = np.zeros(3)
    # The reader adds the body twice to one without mass.
    one = mass * (1.0 / (mass or 1.0))
    body = pin.Inertia(mass, one * (one * (lever + 0.0)), np.zeros((3, 3)))
    body.inertia = tensor.reshape((3, 3)) + 0.0
    return pin.SE3.Identity().act(body)
