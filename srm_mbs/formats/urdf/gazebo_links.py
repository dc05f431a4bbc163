"""Links inside ``<gazebo>`` of a URDF, which Gazebo adds to the SDF that it makes of the file.

They are links of SDF, posed in the frame of the root link at q = 0, as the parallel bars of the
PR2's grippers.  Each hangs on the first of Gazebo's joints that connects it with a link of the
tree; the other joints at it are closures, as all joints inside ``<gazebo>``
(:mod:`srm_mbs.formats.urdf.loop_elements`).
"""

from __future__ import annotations

from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np

from srm_mbs.formats.graph.joint_graph import Body, Joint
from srm_mbs.formats.graph.spanning_tree_to_urdf import urdf_tree
from srm_mbs.formats.sdf.links import Frames, LinkReader, Scope, pose
from srm_mbs.formats.urdf.graph import Graph
from srm_mbs.formats.urdf.loop_elements import LoopElements
from srm_mbs.formats.xml import XmlValues
from srm_mbs.model.anchors import WORLD
from srm_mbs.model.reach import Reach

VERSION = (1, 12)
"""Version of SDF, whose elements the links have."""
HANGING = {"revolute": "revolute", "prismatic": "prismatic", "fixed": "fixed", "ball": "spherical"}
"""Types of joints on which a link may hang, and their types in a URDF."""


def has_links(root: Element) -> bool:
    """Whether there are links inside ``<gazebo>``."""
    return root.find("gazebo/link") is not None


def hang_links(root: Element, elements: LoopElements, reach: Reach) -> dict[str, float]:
    """Move the links inside ``<gazebo>``, and the joints on which they hang, into the tree.

    Parameters
    ----------
    root, elements
        The URDF, which is changed, and the reader of its loops, whose graph is replaced.
    reach
        Where mesh files may lie.

    Returns
    -------
    The entry ``gravity_compensation`` of links on which gravity does not act.

    Raises
    ------
    InputError
        Naming a link that cannot be read or that no joint holds.
    """
    values = XmlValues(elements.file)
    frames = Frames(values)
    reader = LinkReader(values, frames, reach)
    scope = Scope("", elements.file, VERSION)
    pending: dict[str, Body] = {}
    for block in root.findall("gazebo"):
        for node in block.findall("link"):
            name = node.get("name", "")
            where = f"<gazebo><link> {name!r}"
            if not name:
                raise elements.fault(where, "it has no name", 'Give name="..."')
            if name in (*elements.graph.links, *pending, WORLD):
                raise elements.fault(where, "another link has its name", "Rename one of them")
            placement, relative_to = pose(values, node, where, scope)
            if relative_to:
                problem = f"its <pose> is relative to {relative_to!r}"
                raise elements.fault(where, problem, "Give it relative to the root link")
            frames.add(name, WORLD, placement, where, body=name)
            elements.placed[name] = placement
            pending[name] = reader.read(node, name, scope)
            block.remove(node)
    elements.graph.links.extend(pending)
    while pending:
        _hang_next(root, elements, pending)
    elements.notes.extend(values.notes())
    return dict.fromkeys(reader.weightless, 1.0)


def _hang_next(root: Element, elements: LoopElements, pending: dict[str, Body]) -> None:
    """Hang one of the links that are not in the tree yet, which is taken from ``pending``."""
    for block in root.findall("gazebo"):
        for node in block.findall("joint"):
            name, kind = node.get("name", ""), node.get("type", "")
            names = [(node.findtext(side) or "").strip() for side in ("parent", "child")]
            if kind not in HANGING or sum(end in pending for end in names) != 1:
                continue
            where = f"<gazebo><joint> {name!r}"
            if not name or name in elements.graph.joints:
                raise elements.fault(where, "another joint has its name", "Rename one of them")
            parent, child, (axis, _), damping = elements.gazebo_ends(node, where)
            if kind in ("revolute", "prismatic") and (axis is None or not np.any(axis)):
                raise elements.fault(where, "it has no <axis> with a direction", "Give it")
            joint = Joint(name, HANGING[kind], parent[0], child[0], parent[1], child[1])
            if axis is not None:
                x, y, z = (axis / np.linalg.norm(axis)).tolist()
                joint = replace(joint, axis=(x, y, z), damping=damping)
            if parent[0] in pending:
                joint = joint.reversed()
            root.extend(list(urdf_tree("", [pending.pop(joint.child)], [joint])))
            block.remove(node)
            elements.graph = Graph(root)
            elements.graph.links.extend(pending)
            return
    link = next(iter(pending))
    raise elements.fault(
        f"<gazebo><link> {link!r}",
        "no joint inside <gazebo> holds it to a link of the tree",
        f"Add one of type {', '.join(HANGING)}",
    )
