"""Drake's extensions of URDF, rewritten in the elements that this package reads.

They are described in ``multibody/parsing/parsing_doxygen.h`` of Drake.

* ``<drake:joint>`` of the types ``ball``, ``planar`` (x, y and the angle about z), ``universal``
  (about x of the parent, then about y of the child) and ``screw``;
* ``world`` as the parent of a joint without a link of this name: the ground;
* ``<drake:rotor_inertia>`` and ``<drake:gear_ratio>`` of an actuator: armature of its joint.
"""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element, SubElement

from srm_mbs.formats.urdf.graph import ONE_DEGREE, link_of
from srm_mbs.formats.urdf.validation import ElementChecker
from srm_mbs.formats.xml import local_name
from srm_mbs.model.anchors import WORLD

DRAKE_JOINT = re.compile(r"\{[^}]*drake[^}]*\}joint")
TYPES = {"ball": "spherical", "planar": "planar", "screw": "screw", "universal": "universal"}
"""Types of ``<drake:joint>``, and those of this package."""
AXES = {"planar": ("0 0 1",), "universal": ("1 0 0", "0 1 0")}
"""Their axes, where the type has fixed ones."""
TRANSMISSION = "SimpleTransmission"
"""What the types of transmission contain whose actuators Drake reads."""


def rewrite(root: Element, reader: ElementChecker) -> bool:
    """Rewrite what Drake adds to the URDF ``root``; whether there was anything.

    Raises
    ------
    InputError
        Naming the element that cannot be read.
    """
    joints = [node for node in root if DRAKE_JOINT.fullmatch(node.tag)]
    for node in joints:
        _joint(node, reader)
    grounded = _add_ground(root)
    motors = [name for node in root.findall("transmission") if (name := _motor(root, node, reader))]
    if motors:
        reader.notes.append(
            "the inertia of motors, drake:rotor_inertia times the square of drake:gear_ratio, "
            f"acts as armature of the joints {', '.join(map(repr, motors))}"
        )
    return bool(joints or motors or grounded)


def _add_ground(root: Element) -> bool:
    """Add the link ``world`` if a joint starts from it and the file has none, as Drake does."""
    links = {link.get("name") for link in root.findall("link")}
    missing = WORLD not in links and any(
        link_of(joint, "parent") == WORLD for joint in root.findall("joint")
    )
    if missing:
        SubElement(root, "link", name=WORLD)
    return missing


def _joint(node: Element, reader: ElementChecker) -> None:
    where, kind = f"<drake:joint> {node.get('name', '')!r}", node.get("type", "")
    if kind not in TYPES:
        raise reader.unknown(where, f"there is no type {kind!r} of <drake:joint>", TYPES)
    node.tag = "joint"
    node.set("type", TYPES[kind])
    if kind in AXES:
        for axis in node.findall("axis"):
            node.remove(axis)
        for tag, xyz in zip(("axis", "axis2"), AXES[kind]):
            SubElement(node, tag, xyz=xyz)
    for child in node:
        if local_name(child) == "screw_thread_pitch":
            child.tag = "thread_pitch"


def _motor(root: Element, transmission: Element, reader: ElementChecker) -> str | None:
    """Add the inertia of a motor to the armature of its joint; the name of that, if Drake has an
    actuator there: on no fixed joint, and on none whose limit of effort is zero."""
    actuator, end = transmission.find("actuator"), transmission.find("joint")
    kind = transmission.findtext("type", "") or transmission.get("type", "")
    if actuator is None or end is None or TRANSMISSION not in kind:
        return None
    found = {local_name(node): node for node in actuator if node.tag != local_name(node)}
    rotor, name = found.get("rotor_inertia"), end.get("name", "")
    if rotor is None:
        return None
    where = f"joint {name!r}, <drake:rotor_inertia>"
    inertia = reader.number(rotor, "value", where)
    ratio = reader.number_or(1.0, found.get("gear_ratio"), "value", where)
    if inertia < 0.0:
        raise reader.fault(where, f"the inertia {inertia:g} is negative", "Give a value >= 0")
    actuator.remove(rotor)
    joints = {node.get("name", ""): node for node in root.findall("joint")}
    if name not in joints:
        raise reader.unknown(where, f"there is no joint {name!r}", joints)
    joint = joints[name]
    kind = joint.get("type", "")
    if kind == "fixed" or reader.number_or(1.0, joint.find("limit"), "effort", where) == 0.0:
        return None
    if kind not in ONE_DEGREE:
        problem = f"the motor acts on a joint of type {kind!r}"
        raise reader.fault(where, problem, "Give it to a joint with one degree of freedom")
    dynamics = joint.find("dynamics")
    if dynamics is None:
        dynamics = SubElement(joint, "dynamics")
    armature = reader.number_or(0.0, dynamics, "armature", where) + inertia * ratio**2
    dynamics.set("armature", repr(armature))
    return name
