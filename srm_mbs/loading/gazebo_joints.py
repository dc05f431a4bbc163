"""``<gazebo><joint>``: joints of SDF that a URDF carries for Gazebo, which close loops.

Gazebo inserts the element into the SDF that it makes of the URDF.  There a joint's frame lies on
the child, displaced by ``<pose>``; on the parent it is where it stands at q = 0.  Axes are in the
joint's frame, or with ``<use_parent_model_frame>`` in the root link's.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin

from srm_mbs.anchors import WORLD
from srm_mbs.arrays import FloatArray
from srm_mbs.loading.cut_joints import placement
from srm_mbs.loading.loop_elements import LoopElements

NOT_ACTING = ("physics", "sensor")
"""Elements inside such a joint that belong to Gazebo's own solver."""


def read(root: Element, elements: LoopElements) -> bool:
    """Read and remove the joints of ``root``; whether there were any.

    Raises
    ------
    InputError
        Naming the joint that cannot be read.
    """
    found = False
    for block in root.findall("gazebo"):
        for joint in block.findall("joint"):
            _read_joint(joint, elements)
            block.remove(joint)
            found = True
        if found and not len(block) and not block.attrib:
            root.remove(block)
    return found


def _read_joint(joint: Element, elements: LoopElements) -> None:
    name = joint.get("name", "")
    where = f"<gazebo><joint> {name!r}"
    elements.only(joint, where, ("name", "type"))
    known = ("parent", "child", "pose", "axis", "axis2", *NOT_ACTING)
    parts: dict[str, Element] = {}
    for node in joint:
        if node.tag not in known:
            raise elements.fault(
                where, f"unknown element <{node.tag}> in it", f"Known: {', '.join(known)}"
            )
        if node.tag in parts:
            raise elements.fault(where, f"<{node.tag}> is given twice", "Keep one")
        parts[node.tag] = node
        if node.tag in ("parent", "child", "pose"):
            elements.leaf(node, where)
    parent, child = (_link(parts.get(side), side, where, elements) for side in ("parent", "child"))
    frame = _pose(parts.get("pose"), child, where, elements)
    graph = elements.graph
    poses = {
        link: pin.SE3.Identity() if link == WORLD else graph.pose(link) for link in (parent, child)
    }
    at = poses[child] * frame
    damping = sum(_damping(parts.get(tag), tag, where, elements) for tag in ("axis", "axis2"))
    axes = [_axis(parts.get(tag), tag, at, where, elements) for tag in ("axis", "axis2")]
    elements.joint(
        elements.kind(joint, where),
        name,
        (parent, poses[parent].actInv(at)),
        (child, frame),
        axes,
        damping=damping,
        where=where,
    )


def _text(node: Element | None) -> str:
    return "" if node is None else (node.text or "").strip()


def _numbers(node: Element, count: int, where: str, elements: LoopElements) -> list[float]:
    """The numbers that are the text of an element."""
    bare = Element(node.tag, value=_text(node))
    return elements.numbers(bare, "value", count, where)


def _link(node: Element | None, side: str, where: str, elements: LoopElements) -> str:
    name = _text(node)
    if not name:
        raise elements.fault(where, f"it has no <{side}>", f"Name its {side} link")
    return elements.link(Element(side, link=name), "link", where)


def _pose(node: Element | None, child: str, where: str, elements: LoopElements) -> pin.SE3:
    """Placement of the joint's frame in the child link."""
    if node is None:
        return pin.SE3.Identity()
    elements.only(node, where, ("relative_to", "frame"))
    relative = node.get("relative_to", node.get("frame", ""))
    if relative not in ("", child):
        raise elements.fault(
            where, f"its <pose> is relative to {relative!r}", "Give it relative to the child link"
        )
    values = _numbers(node, 6, where, elements)
    return placement(values[:3], values[3:])


def _damping(node: Element | None, tag: str, where: str, elements: LoopElements) -> float:
    """Damping about <axis>; what else acts there is refused."""
    values = {}
    for key in ("damping", "friction", "spring_stiffness"):
        given = None if node is None else node.find(f"dynamics/{key}")
        values[key] = 0.0 if given is None else _numbers(given, 1, where, elements)[0]
        if values[key] and (key != "damping" or tag == "axis2"):
            raise elements.fault(
                where,
                f"its {key} would not act: a closure has none",
                "Set it to 0, or add a [[force]] in a description",
            )
    return values["damping"]


def _axis(
    node: Element | None, tag: str, at: pin.SE3, where: str, elements: LoopElements
) -> FloatArray | None:
    """Direction of <axis> or <axis2> in the joint's frame."""
    if node is None:
        return None
    known = ("xyz", "limit", "dynamics", "use_parent_model_frame", "initial_position")
    for inner in node:
        if inner.tag not in known:
            raise elements.fault(
                where, f"unknown element <{inner.tag}> in <{tag}>", f"Known: {', '.join(known)}"
            )
        if len(node.findall(inner.tag)) > 1:
            raise elements.fault(where, f"<{inner.tag}> is given twice", "Keep one")
        if inner.tag not in ("limit", "dynamics"):
            elements.leaf(inner, where)
    xyz = node.find("xyz")
    if xyz is None:
        raise elements.fault(where, f"<{tag}> has no <xyz>", "Give its direction")
    direction = np.array(_numbers(xyz, 3, where, elements))
    if _text(node.find("use_parent_model_frame")) in ("1", "true"):
        direction = at.rotation.T @ direction
    return direction
