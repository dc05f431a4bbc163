"""The model of a variant of a URDF with ``[[override]]``: that of another with other numbers.

Where no fixed joints lump bodies together, an entry of ``[[override]]`` changes the place of one of
Pinocchio's joints, or one of its inertias: the model is copied, and the file is not read again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import share_scratch
from srm_mbs.errors import InputError
from srm_mbs.formats.graph.joint_graph import inertia_at
from srm_mbs.formats.toml.schema import OverrideEntry
from srm_mbs.formats.urdf.override import TENSOR, changed_inertial, changed_place
from srm_mbs.formats.urdf.validation import ElementChecker, doubtful_moments
from srm_mbs.model.numbers import LARGEST_MAGNITUDE

KEPT_BODIES = 1024
"""Inertias that are kept: variants of a mechanism have most of them in common."""


def plain_numbers(inertias: Sequence[pin.Inertia], places: Sequence[pin.SE3]) -> bool:
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


@lru_cache(maxsize=KEPT_BODIES)
def inertia_as_read(mass: float, lever_numbers: bytes, tensor_numbers: bytes) -> pin.Inertia:
    """An inertia, about the centre of mass in the axes of the link, as Pinocchio's reader of URDF
    rounds it; nothing may change it."""
    lever, tensor = np.frombuffer(lever_numbers), np.frombuffer(tensor_numbers)
    # The reader adds the body twice to one without mass.
    one = mass * (1.0 / (mass or 1.0))
    body = pin.Inertia(mass, one * (one * (lever + 0.0)), np.zeros((3, 3)))
    body.inertia = tensor.reshape((3, 3)) + 0.0
    return pin.SE3.Identity().act(body)


class Inertial(NamedTuple):
    """Mass (kg), moments of inertia (kg m^2) in the order of :data:`TENSOR`, and centre (m) of a
    link in the file."""

    mass: float
    moments: list[float]
    centre: list[float]


@dataclass(frozen=True, eq=False)
class OverridableTree:
    """The numbers of a URDF that ``[[override]]`` changes.

    Attributes
    ----------
    joints
        Places (m) of the joints in their parents, by name.
    links
        Joint that carries each link, and its numbers, by name.
    """

    joints: Mapping[str, list[float]]
    links: Mapping[str, tuple[str, Inertial]]

    @classmethod
    def of(
        cls, root: Element, entries: Sequence[OverrideEntry], file: str
    ) -> OverridableTree | None:
        """The numbers of the tree ``root``, before it is changed; None where joints are fixed, or
        an entry has a fault."""
        checker = ElementChecker(file)
        nodes = {node.get("name", ""): node for node in root.findall("joint")}
        bodies = {node.get("name", ""): node for node in root.findall("link")}
        carriers = {_link(node, "child"): name for name, node in nodes.items()}
        if any(node.get("type") == "fixed" for node in nodes.values()):
            return None
        joints: dict[str, list[float]] = {}
        links: dict[str, tuple[str, Inertial]] = {}
        try:
            for entry in entries:
                if entry.joint:
                    origin = nodes[entry.joint].find("origin")
                    joints[entry.joint] = checker.vector_or_zero(origin, "xyz", "")
                elif entry.link:
                    inertial = bodies[entry.link].find("inertial")
                    mass, moments = (
                        None if inertial is None else inertial.find(tag)
                        for tag in ("mass", "inertia")
                    )
                    if inertial is None or mass is None or moments is None:
                        return None
                    origin = inertial.find("origin")
                    if any(checker.vector_or_zero(origin, "rpy", "")):
                        return None
                    links[entry.link] = (
                        carriers[entry.link],
                        Inertial(
                            checker.number(mass, "value", ""),
                            [checker.number(moments, key, "") for key in TENSOR],
                            checker.vector_or_zero(origin, "xyz", ""),
                        ),
                    )
        except (InputError, KeyError):
            return None  # the changes say what is wrong
        return cls(joints, links)

    def model(self, known: pin.Model, entries: Sequence[OverrideEntry]) -> pin.Model | None:
        """The model with the changes of ``entries``, from that with others; None where the check of
        the file would say something about them."""
        places: dict[str, list[float]] = {}
        inertias: dict[str, pin.Inertia] = {}
        for entry in entries:
            if entry.joint:
                places[entry.joint] = changed_place(
                    self.joints[entry.joint], entry.scale, entry.xyz
                )
            elif entry.link:
                carrier, own = self.links[entry.link]
                mass, (xx, xy, xz, yy, yz, zz) = changed_inertial(entry, own.mass, own.moments)
                centre = pin.SE3(np.eye(3), np.array(changed_place(own.centre, 1.0, entry.xyz)))
                inertias[carrier] = inertia_at(centre, mass, (xx, yy, zz, xy, xz, yz))
        moved = [pin.SE3(np.eye(3), np.array(place)) for place in places.values()]
        if not plain_numbers(list(inertias.values()), moved):
            return None
        model = known.copy()
        share_scratch(known, model)
        for name, place in places.items():
            number = model.getJointId(name)
            rotation = model.jointPlacements[number].rotation
            model.jointPlacements[number] = pin.SE3(rotation, np.array(place) + 0.0)
        for name, inertia in inertias.items():
            model.inertias[model.getJointId(name)] = inertia_as_read(
                inertia.mass, inertia.lever.tobytes(), inertia.inertia.tobytes()
            )
        return model


def _link(joint: Element, tag: str) -> str:
    """The link that the element ``tag`` of a joint names."""
    node = joint.find(tag)
    return "" if node is None else node.get("link", "")
