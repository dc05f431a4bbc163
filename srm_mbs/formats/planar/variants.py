"""The model of a variant of a linkage: that of another variant with other numbers.

Variants of a description mostly differ in lengths and masses.  If their trees have the same shape,
Pinocchio's model is copied and gets other placements and inertias, as Pinocchio's reader of URDF
would compute them; texts, the check of the XML and Pinocchio's reader are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.formats.graph.joint_graph import Body, Joint
from srm_mbs.formats.graph.spanning_tree_to_urdf import is_identity
from srm_mbs.formats.translation import KnownTree
from srm_mbs.formats.urdf.validation import doubtful_moments
from srm_mbs.model.numbers import LARGEST_MAGNITUDE

KEPT_BODIES = 1024
"""Inertias that are kept: variants of a linkage have most of them in common."""


def shape_of(bodies: Sequence[Body], joints: Sequence[Joint]) -> tuple[Any, ...]:
    """All of a tree but the translations of its joints and the inertias of its bodies; empty where
    the check of the tree would have a note or a fault about these."""
    if not _plain(bodies, joints):
        return ()
    return (
        tuple((body.name, body.inertia is None) for body in bodies),
        tuple((one.name, one.type, one.parent, one.child, one.axis) for one in joints),
    )


def _plain(bodies: Sequence[Body], joints: Sequence[Joint]) -> bool:
    """Whether the numbers of a tree are those of real bodies, and of sensible size."""
    inertias = [body.inertia for body in bodies if body.inertia is not None]
    places = [joint.in_parent.translation for joint in joints]
    if not inertias or not places:
        return False
    masses = np.array([inertia.mass for inertia in inertias])
    tensors = np.array([inertia.inertia for inertia in inertias])
    levers = np.array([inertia.lever for inertia in inertias])
    numbers = np.concatenate([masses, tensors.ravel(), levers.ravel(), np.ravel(places)])
    if not np.abs(numbers).max() <= LARGEST_MAGNITUDE or not (masses >= 0.0).all():
        return False
    negative, impossible = doubtful_moments(np.linalg.eigvalsh(tensors), masses)
    return not (negative.any() or impossible.any())


def model_of_variant(
    known: KnownTree | None,
    shape: tuple[Any, ...],
    bodies: Sequence[Body],
    joints: Sequence[Joint],
) -> pin.Model | None:
    """The model of a tree whose links have their frames at their joints; None unless its shape is
    that of the known one.

    Parameters
    ----------
    shape, bodies, joints
        Of the tree; every joint is in its parent with the axes of this.
    """
    if known is None or not shape or shape != known.shape:
        return None
    model = known.model.copy()
    inertias = {body.name: body.inertia for body in bodies}
    for joint in joints:
        number = model.getJointId(joint.name)
        place = joint.in_parent
        at = np.zeros(3) if is_identity(place) else place.translation + 0.0
        model.jointPlacements[number] = pin.SE3(model.jointPlacements[number].rotation, at)
        inertia = inertias[joint.child]
        if inertia is None:
            continue
        model.inertias[number] = _as_read(
            inertia.mass, inertia.lever.tobytes(), inertia.inertia.tobytes()
        )
    return model


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
