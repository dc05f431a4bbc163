"""Links and joints of a URDF as a graph, with the placements of the links at q = 0."""

from __future__ import annotations

from xml.etree.ElementTree import Element

import pinocchio as pin

from srm_mbs.errors import InputError
from srm_mbs.formats.graph.spanning_tree_to_urdf import placement
from srm_mbs.formats.xml import parse_numbers

ONE_DEGREE = ("revolute", "continuous", "prismatic", "screw")


def link_of(joint: Element, side: str) -> str:
    """Link that <parent> or <child> names; empty if it names none."""
    node = joint.find(side)
    return "" if node is None else node.get("link", "")


class Graph:
    """The joints of a URDF; the check of the tree refuses missing and wrong names later.

    Attributes
    ----------
    links
        Their names, in the order of the file.
    joints
        By name.
    above
        Link -> the joint that moves it.
    """

    def __init__(self, root: Element) -> None:
        self.links = [link.get("name", "") for link in root.findall("link")]
        self.joints: dict[str, Element] = {}
        self.above: dict[str, Element] = {}
        for joint in root.findall("joint"):
            self.joints.setdefault(joint.get("name", ""), joint)
            self.above.setdefault(link_of(joint, "child"), joint)

    def ancestors(self, link: str) -> list[str]:
        """``link`` and those that carry it, up to the root."""
        out = {link: None}
        at = link
        while (joint := self.above.get(at)) is not None:
            at = link_of(joint, "parent")
            if at in out:  # a ring, which the check of the tree names
                break
            out[at] = None
        return list(out)

    def chains(self, first: str, second: str) -> tuple[list[str], list[str]]:
        """Moving joints from the nearest common ancestor to either link.

        Raises
        ------
        InputError
            If there is none, a chain does not move, or has a joint of several degrees of freedom.
        """
        above = set(self.ancestors(second))
        common = next((link for link in self.ancestors(first) if link in above), None)
        if common is None:
            raise InputError(
                f"the links {first!r} and {second!r} have no common ancestor",
                remedy="Join them by joints",
            )
        return self._below(common, first), self._below(common, second)

    def _below(self, ancestor: str, link: str) -> list[str]:
        found = []
        for at in self.ancestors(link):
            if at == ancestor:
                break
            joint = self.above[at]
            kind, name = joint.get("type", ""), joint.get("name", "")
            if kind == "fixed":
                continue
            if kind not in ONE_DEGREE:
                raise InputError(
                    f"the joint {name!r} of type {kind!r} lies between them",
                    remedy="Couple joints with one degree of freedom",
                )
            found.append(name)
        if not found:
            raise InputError(
                f"no joint moves {link!r} against {ancestor!r}",
                remedy="Name links on both sides of a joint",
            )
        return found[::-1]

    def held(self, link: str) -> tuple[str, pin.SE3]:
        """The link that moves ``link`` through fixed joints only, and the placement in it."""
        placement = pin.SE3.Identity()
        for at in self.ancestors(link):
            joint = self.above.get(at)
            if joint is None or joint.get("type") != "fixed":
                return at, placement
            placement = origin_placement(joint) * placement
        return link, pin.SE3.Identity()  # a ring, which the check of the tree names

    def pose(self, link: str) -> pin.SE3:
        """Placement of ``link`` in the root link's frame at q = 0."""
        out = pin.SE3.Identity()
        for at in self.ancestors(link)[:-1]:
            out = origin_placement(self.above[at]) * out
        return out


def origin_placement(node: Element) -> pin.SE3:
    """Placement that ``<origin>`` of a joint or an <inertial> gives; zero where the file has no
    three numbers."""
    origin = node.find("origin")
    values = []
    for key in ("xyz", "rpy"):
        given = None if origin is None else parse_numbers(origin.get(key, ""))
        values.append(given if given is not None and len(given) == 3 else [0.0] * 3)
    return placement(*values)
