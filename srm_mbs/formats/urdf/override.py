"""``[[override]]`` of a description: other places, masses and inertias of its joints and links.

An entry names a joint or a link of the URDF, or of the tree that a file of another format becomes.
The tree is changed before it is built, so that saved runs and conversions have the numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement

from srm_mbs.errors import InputError, known_names
from srm_mbs.formats.toml.schema import OverrideEntry
from srm_mbs.formats.urdf.validation import ElementChecker

OF_LINKS = ("inertia_scale", "mass", "inertia")
"""Keys that a joint does not have."""
TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def override(root: Element, entries: Sequence[OverrideEntry], file: str, urdf: str) -> None:
    """Change the tree ``root`` of the URDF ``urdf`` as the ``entries`` of the description ``file``
    say.

    Lengths are in m, masses in kg, moments of inertia in kg m^2.

    Raises
    ------
    InputError
        Naming the file, the entry and the remedy: for an entry that names no joint or link, a joint
        or link that is not there or is changed twice, a link without inertia, or a mass below 0.
    """
    checker = ElementChecker(urdf)
    changed: set[tuple[str, str]] = set()
    for i, entry in enumerate(entries):
        kind, name = _named(entry, f"override[{i}]", file)
        where = f"override of {kind} {name!r}"
        if (kind, name) in changed:
            raise InputError("it is given twice", file=file, element=where, remedy="Keep one")
        changed.add((kind, name))
        node = _found(root, kind, name, where, file)
        if kind == "joint":
            _change_joint(node, entry, where, file, checker)
        else:
            _change_link(node, entry, where, file, checker)


def _named(entry: OverrideEntry, where: str, file: str) -> tuple[str, str]:
    """Whether an entry is of a joint or a link, and its name."""
    given = [(kind, name) for kind in ("joint", "link") if (name := getattr(entry, kind))]
    if len(given) != 1:
        raise InputError(
            "it names both a joint and a link" if given else "it names no joint and no link",
            file=file,
            element=where,
            remedy='Give joint = "...", or link = "..."',
        )
    return given[0]


def _found(root: Element, kind: str, name: str, where: str, file: str) -> Element:
    elements = {each.get("name", ""): each for each in root.findall(kind)}
    if name not in elements:
        raise InputError(
            f"there is no {kind} {name!r}",
            file=file,
            element=where,
            remedy=known_names(elements),
        )
    return elements[name]


def _change_joint(
    node: Element, entry: OverrideEntry, where: str, file: str, checker: ElementChecker
) -> None:
    """Scale the place of a joint in its parent link, and move it."""
    for key in OF_LINKS:
        if key in entry.model_fields_set:
            raise InputError(
                f"a joint has no {key}",
                file=file,
                element=where,
                remedy="Give scale and xyz, or the link in place of the joint",
            )
    _move_origin(node, entry.scale, entry.xyz, f"joint {node.get('name')!r}", checker)


def _change_link(
    node: Element, entry: OverrideEntry, where: str, file: str, checker: ElementChecker
) -> None:
    """Scale the mass and the moments of inertia of a link, add to them, and move its centre."""
    inertial = node.find("inertial")
    mass = None if inertial is None else inertial.find("mass")
    inertia = None if inertial is None else inertial.find("inertia")
    if inertial is None or mass is None or inertia is None:
        raise InputError(
            "the link has no inertia to change",
            file=file,
            element=where,
            remedy="Give it an <inertial> with <mass> and <inertia>",
        )
    link = f"link {node.get('name')!r}"
    moments = [checker.number(inertia, key, link) for key in TENSOR]
    value, moments = changed_inertial(entry, checker.number(mass, "value", link), moments)
    if value < 0.0:
        raise InputError(
            f"the mass becomes {value:g} kg", file=file, element=where, remedy="Give a larger mass"
        )
    mass.set("value", repr(value))
    for key, moment in zip(TENSOR, moments):
        inertia.set(key, repr(moment))
    _move_origin(inertial, 1.0, entry.xyz, link, checker)


def changed_inertial(
    entry: OverrideEntry, mass: float, moments: Iterable[float]
) -> tuple[float, list[float]]:
    """The mass (kg) and the moments (kg m^2), in the order of :data:`TENSOR`, of a link with an
    entry."""
    factor = entry.scale * entry.inertia_scale
    changed = [factor * own + more for own, more in zip(moments, entry.inertia)]
    return entry.scale * mass + entry.mass, changed


def changed_place(place: Iterable[float], scale: float, offset: Iterable[float]) -> list[float]:
    """``place`` (3,) m times ``scale``, moved by ``offset`` (3,) m."""
    return [scale * own + more for own, more in zip(place, offset)]


def _move_origin(
    node: Element, scale: float, offset: Iterable[float], where: str, checker: ElementChecker
) -> None:
    """Multiply the place of ``<origin>`` of ``node`` by ``scale``, and add ``offset``."""
    origin = node.find("origin")
    given = checker.vector_or_zero(origin, "xyz", where)
    place = changed_place(given, scale, offset)
    if place == given:
        return
    if origin is None:
        origin = SubElement(node, "origin")
    origin.set("xyz", " ".join(map(repr, place)))


def without_overrides(entries: Mapping[str, object]) -> dict[str, object]:
    """The tables of a description whose overrides are done."""
    return {key: value for key, value in entries.items() if key != "override"}
