"""The model of a variant of a URDF with ``[[override]]``: that of another with other numbers.

Where no fixed joints lump bodies together, an entry of ``[[override]]`` changes the place of one of
Pinocchio's joints, or one of its inertias: the model is copied, and the file is not read again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs._kernel.workspace import share_scratch
from srm_mbs._typing import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.formats.graph.joint_graph import inertia_tensor
from srm_mbs.formats.toml.parameters import Nested, with_numbers
from srm_mbs.formats.toml.schema import OverrideEntry
from srm_mbs.formats.urdf.graph import link_of
from srm_mbs.formats.urdf.override import TENSOR, changed_inertial, changed_place
from srm_mbs.formats.urdf.validation import ElementChecker, doubtful_moments
from srm_mbs.model.numbers import LARGEST_MAGNITUDE


def plain_numbers(inertias: Iterable[pin.Inertia], places: Iterable[pin.SE3]) -> bool:
    """Whether the numbers of a tree are those of real bodies, and of sensible size."""
    bodies = list(inertias)
    numbers = [place.translation for place in places]
    if bodies:
        masses = np.array([inertia.mass for inertia in bodies])
        tensors = np.array([inertia.inertia for inertia in bodies])
        if not (masses >= 0.0).all():
            return False
        negative, impossible = doubtful_moments(np.linalg.eigvalsh(tensors), masses)
        if negative.any() or impossible.any():
            return False
        numbers += [masses, tensors.ravel(), *(inertia.lever for inertia in bodies)]
    return not numbers or bool(np.abs(np.concatenate(numbers)).max() <= LARGEST_MAGNITUDE)


def inertia_as_read(mass: float, lever: Sequence[float], tensor: FloatArray) -> pin.Inertia:
    """An inertia, about the centre of mass in the axes of the link, as Pinocchio's reader of URDF
    rounds it."""
    # The reader adds the body twice to one without mass.
    one = mass * (1.0 / (mass or 1.0))
    body = pin.Inertia.Zero()
    body.mass, body.inertia = mass, tensor + 0.0
    body.lever = np.array([one * (one * (x + 0.0)) for x in lever])
    return pin.SE3.Identity().act(body)


def model_with(
    known: pin.Model, places: Mapping[int, Sequence[float]], inertias: Mapping[int, pin.Inertia]
) -> pin.Model:
    """A copy of a model with other places (m) of joints in their parents and other inertias, by the
    number of the joint."""
    model = known.copy()
    share_scratch(known, model)
    placements, bodies = model.jointPlacements, model.inertias
    for joint, place in places.items():
        placements[joint].translation = np.array(place)
    for joint, inertia in inertias.items():
        bodies[joint] = inertia
    return model


UNTURNED = np.eye(3)


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
    entries, numbers
        The changes, and their numbers among those of variants.
    """

    joints: Mapping[str, list[float]]
    links: Mapping[str, tuple[str, Inertial]]
    entries: Sequence[OverrideEntry]
    numbers: Nested = field(default_factory=dict)

    @classmethod
    def of(
        cls, root: Element, entries: Sequence[OverrideEntry], file: str
    ) -> OverridableTree | None:
        """The numbers of the tree ``root``, before it is changed; None where joints are fixed, or
        an entry has a fault."""
        checker = ElementChecker(file)
        nodes = {node.get("name", ""): node for node in root.findall("joint")}
        bodies = {node.get("name", ""): node for node in root.findall("link")}
        carriers = {link_of(node, "child"): name for name, node in nodes.items()}
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
        return cls(joints, links, entries)

    def with_numbers(self, numbers: Nested) -> OverridableTree:
        """The same for variants with these numbers in their description."""
        return replace(self, numbers=numbers.get("override", {}))

    def model(self, known: pin.Model, numbers: Sequence[float]) -> pin.Model | None:
        """The model with ``numbers`` at the places of the description, from that with others; None
        where the check of the description or of the file would say something about them."""
        places: dict[int, pin.SE3] = {}
        inertias: dict[int, pin.Inertia] = {}
        for entry in with_numbers(self.entries, self.numbers, numbers):
            if not (entry.scale > 0.0 and entry.inertia_scale > 0.0):
                return None
            if entry.joint:
                place = changed_place(self.joints[entry.joint], entry.scale, entry.xyz)
                places[known.getJointId(entry.joint)] = pin.SE3(UNTURNED, np.array(place) + 0.0)
            elif entry.link:
                carrier, own = self.links[entry.link]
                mass, (xx, xy, xz, yy, yz, zz) = changed_inertial(entry, own.mass, own.moments)
                centre = changed_place(own.centre, 1.0, entry.xyz)
                tensor = inertia_tensor((xx, yy, zz, xy, xz, yz))
                inertias[known.getJointId(carrier)] = inertia_as_read(mass, centre, tensor)
        if not plain_numbers(inertias.values(), places.values()):
            return None
        moved = {joint: place.translation for joint, place in places.items()}
        return model_with(known, moved, inertias)
