"""What a URDF says, checked before Pinocchio reads it.

Pinocchio's parser drops what it does not know without a word: unknown elements, a second joint
with the same child, a whole <inertial> whose numbers are separated by a newline.
Everything that would change the mechanism is therefore checked on the XML, and what is left of it
holds nothing but what was checked, with the numbers written afresh.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from xml.etree.ElementTree import Element

import numpy as np

from srm_mbs.anchors import WORLD
from srm_mbs.errors import SrmWarning
from srm_mbs.loading.urdf_joints import UNIVERSE, JointChecker
from srm_mbs.loading.urdf_schema import ATTRIBUTES

DEEPEST = 1000
"""Most links between the root and a leaf: Pinocchio's recursive parser overflows the stack."""
POINT_LIKE = 1e-18
"""m^2: a radius of gyration below a nanometre is the rounding of zero."""


class UrdfChecker(JointChecker):
    """Walks a URDF once; raises :class:`InputError` at the first fault."""

    def check(self, root: Element, base: str, locked: Sequence[str]) -> None:
        """The whole file; leaves in ``root`` what Pinocchio is to read."""
        self.root(root)
        for block in root.findall("gazebo"):
            for joint in block.iter("joint"):
                if joint.find("child") is not None:
                    raise self.fault(
                        f"<gazebo><joint> {joint.get('name', '')!r}",
                        "a joint deep inside <gazebo> is not read",
                        "Move it up, directly into <gazebo>",
                    )
        self.children(root, "")
        links, joints = self.named(root, "link"), self.named(root, "joint")
        if not links:
            raise self.fault("<robot>", "there is no <link>", "Add one for every body")
        for name, link in links.items():
            self.link(name, link)
        self.tree(links, joints, base)
        for name, joint in joints.items():
            self.joint(name, joint, base, name in locked)
        self.notes += self.ignored_notes()

    def root(self, root: Element) -> None:
        """The root element and its attributes, of which the name is kept."""
        if root.tag.endswith("}robot"):
            raise self.fault(
                "<robot>",
                "it has a default namespace (xmlns=...), so that none of its elements is URDF",
                "Remove the attribute xmlns",
            )
        if root.tag != "robot":
            raise self.fault(f"<{root.tag}>", "the root element is not <robot>", "Give a URDF file")
        version = root.get("version", "1.0")
        if version not in ("1", "1.0", "1.1", "1.2"):
            raise self.fault(
                "<robot>", f"there is no URDF version {version!r}", "Known: 1.0, 1.1, 1.2"
            )
        name = root.get("name")
        if not name:
            raise self.fault("<robot>", "it has no name", 'Give name="..."')
        root.attrib.clear()
        root.set("name", name)

    def link(self, name: str, link: Element) -> None:
        where = f"link {name!r}"
        origin = link.find("origin")
        if origin is not None:  # of no meaning in URDF, but exporters write it with zeros
            self.attributes(origin, where)
            for key in ("xyz", "rpy"):
                if origin.get(key) is not None and any(self.numbers(origin, key, 3, where)):
                    raise self.fault(
                        where,
                        "<origin> in <link> has no meaning in URDF and would not move anything",
                        "Put it into the joint, <inertial> or <visual> that it belongs to",
                    )
            link.remove(origin)
        self.children(link, where)
        inertial = link.find("inertial")
        if inertial is None:
            return
        self.children(inertial, where)
        self.origin(inertial, where)
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is None or inertia is None:
            missing = "mass" if mass is None else "inertia"
            raise self.fault(where, f"<inertial> has no <{missing}>", "Add it")
        (value,) = self.numbers(mass, "value", 1, where)
        if value < 0.0:
            raise self.fault(where, f"the mass {value:g} kg is negative", "Give a mass >= 0")
        xx, yy, zz, xy, xz, yz = (
            self.numbers(inertia, key, 1, where)[0] for key in ATTRIBUTES["inertia"]
        )
        principal = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        rounding = 1e-9 * float(np.abs(principal).max()) + POINT_LIKE * value
        if principal[0] < -rounding:
            raise self.fault(
                where,
                f"a principal moment of inertia is negative ({principal[0]:.3g} kg m^2)",
                "Check the entries of <inertia>",
            )
        if principal[0] + principal[1] < principal[2] - 1e-6 * principal[2] - rounding:
            note = (
                f"link {name!r}: the principal moments of inertia {principal[0]:.3g}, "
                f"{principal[1]:.3g}, {principal[2]:.3g} violate the triangle inequality: "
                "no real body has them"
            )
            self.notes.append(note)
            warnings.warn(f"{self.file}: {note}", SrmWarning, stacklevel=2)

    def tree(self, links: dict[str, Element], joints: dict[str, Element], base: str) -> None:
        parent_joint: dict[str, str] = {}
        parent_link: dict[str, str] = {}
        for name, joint in joints.items():
            ends = {}
            for side in ("parent", "child"):
                node = joint.find(side)
                link = None if node is None else node.get("link")
                if not link:
                    raise self.fault(
                        f"joint {name!r}", f"it has no <{side} link=...>", f"Name its {side} link"
                    )
                if link not in links:
                    raise self.fault(
                        f"joint {name!r}",
                        f"its {side} link {link!r} does not exist",
                        f"Known: {', '.join(links)}",
                    )
                ends[side] = link
            child = ends["child"]
            if child in parent_joint:
                raise self.fault(
                    f"link {child!r}",
                    f"it is the child of two joints, {parent_joint[child]!r} and {name!r}",
                    "Keep one of them and describe the other as [[loop]] in a TOML description",
                )
            parent_joint[child], parent_link[child] = name, ends["parent"]
        roots = [link for link in links if link not in parent_joint]
        if len(roots) != 1:
            problem = (
                "every link has a parent: the joints form a ring"
                if not roots
                else f"{len(roots)} links have no parent joint: {', '.join(roots)}"
            )
            raise self.fault(
                "<robot>", problem, "Keep exactly one root link; close loops by [[loop]]"
            )
        children: dict[str, list[str]] = {}
        for child, parent in parent_link.items():
            children.setdefault(parent, []).append(child)
        level, depth, loose = roots, 0, set(links)
        while level:
            if depth > DEEPEST:
                raise self.fault(
                    f"link {level[0]!r}",
                    f"more than {DEEPEST} joints lie between it and the root link",
                    "Split the chain: Pinocchio cannot read such a deep one",
                )
            loose -= set(level)
            level = [child for link in level for child in children.get(link, ())]
            depth += 1
        if loose:
            ring: dict[str, None] = {}
            at = next(link for link in links if link in loose)
            while at not in ring:
                ring[at] = None
                at = parent_link[at]
            raise self.fault(
                f"link {at!r}",
                f"it is its own ancestor: the joints from {parent_link[at]!r} to it form a ring",
                "Close loops by [[loop]] in a TOML description",
            )
        for reserved in (WORLD, UNIVERSE):
            if reserved in links and (roots[0] != reserved or base != "fixed"):
                raise self.fault(
                    f"link {reserved!r}",
                    f"{reserved!r} is reserved for the ground, but here it moves",
                    'Rename the link, or use base = "fixed"'
                    if roots[0] == reserved
                    else "Rename the link",
                )
