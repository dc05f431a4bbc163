"""From a URDF to a Pinocchio model: the checked tree on its base, and locked joints.

Pinocchio gets a URDF that contains only what
:class:`~srm_mbs.formats.urdf.validation.UrdfChecker` has checked; the notes list what was removed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pinocchio as pin

from srm_mbs.errors import InputError, get_logger
from srm_mbs.formats.urdf.joint_types import MULTIPLE, set_dynamics, take_extended, with_joints
from srm_mbs.formats.urdf.validation import UrdfChecker

log = get_logger(__name__)


@dataclass(frozen=True)
class UrdfModel:
    """A checked URDF and its tree.

    Attributes
    ----------
    model
        Pinocchio's model, with joint damping from the file.
    notes
        Sentences about the contents of the file that are ignored.
    """

    model: pin.Model
    notes: tuple[str, ...]


ROOT_JOINTS: dict[str, Callable[[], Any] | None] = {
    "fixed": None,
    "floating": pin.JointModelFreeFlyer,
    "planar": pin.JointModelPlanar,
}


def build_urdf(
    root: Element,
    file: str,
    base: str,
    locked: Sequence[str] = (),
    counting_turns: Collection[str] = (),
) -> UrdfModel:
    """Check a URDF and build its tree on a fixed, floating or planar base.

    Inertias are checked by :func:`~srm_mbs.model.validation.check_inertia`, after locking.

    Parameters
    ----------
    root, file
        Root element of the URDF, which is reduced to what Pinocchio is to read, and the name of the
        file for messages.
    base
        ``fixed``, ``floating`` (root joint ``root_joint``, a free flyer) or ``planar`` (motion in
        the x-y plane of the world).
    locked
        Joints that will be locked: their damping does not matter.
    counting_turns
        Joints whose angle must count turns: ``continuous`` ones among them are built as revolute
        joints without limits, because Pinocchio stores the others as (cos, sin).

    Raises
    ------
    InputError
        Naming the file, the element and the remedy.
    """
    checker = UrdfChecker(file)
    checker.check(root, base, locked)
    unlimited = _without_limits(root, set(counting_turns) - set(locked))
    dynamics = _take_dynamics(root)
    extended = take_extended(root)
    text = tostring(root, encoding="unicode")
    root_joint = ROOT_JOINTS[base]
    try:
        if root_joint is None:
            model = pin.buildModelFromXML(text)
        else:
            model = pin.buildModelFromXML(text, root_joint())
    except Exception as error:  # Boost.Python raises whatever Pinocchio throws
        raise InputError(
            f"Pinocchio cannot read it: {error}",
            file=file,
            remedy="Correct what it complains about",
        ) from error
    for name, bare in unlimited.items():
        joint = model.joints[model.getJointId(name)]
        model.lowerPositionLimit[joint.idx_q] = -np.inf
        model.upperPositionLimit[joint.idx_q] = np.inf
        if bare:
            model.effortLimit[joint.idx_v] = model.velocityLimit[joint.idx_v] = np.inf
    for note in checker.notes:
        log.info("%s: %s", file, note)
    model = with_joints(model, extended)
    for name, values in dynamics.items():
        joint = model.joints[model.getJointId(name)]
        set_dynamics(model, slice(joint.idx_v, joint.idx_v + joint.nv), **values)
    return UrdfModel(model, tuple(checker.notes))


def _take_dynamics(root: Element) -> dict[str, dict[str, float]]:
    """The values of <dynamics> by joint that Pinocchio's reader leaves out: ``armature``, which
    URDF does not have, and damping and friction of joints of several degrees of freedom."""
    found = {}
    for joint in root.findall("joint"):
        dynamics, kind = joint.find("dynamics"), joint.get("type")
        if dynamics is None:
            continue
        keys = ("armature", "damping", "friction") if kind in MULTIPLE else ("armature",)
        taken = {key: float(dynamics.attrib.pop(key)) for key in keys if key in dynamics.attrib}
        if taken and kind != "fixed":
            found[joint.get("name", "")] = taken
        if not dynamics.attrib:  # which urdfdom does not read
            joint.remove(dynamics)
    return found


def _without_limits(root: Element, names: Collection[str]) -> dict[str, bool]:
    """Make revolute joints of the continuous ones among ``names``.

    Returns those that were changed, and whether they had no <limit> of effort and velocity.
    """
    changed = {}
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        if name not in names or joint.get("type") != "continuous":
            continue
        joint.set("type", "revolute")
        limit = joint.find("limit")
        changed[name] = limit is None
        if limit is None:
            limit = SubElement(joint, "limit", effort="0", velocity="0")
        limit.attrib |= {"lower": "0", "upper": "0"}
    return changed


def lock_joints(model: pin.Model, names: list[str], q: Any) -> pin.Model:
    """``model`` without the joints ``names``, frozen at the configuration ``q`` (nq,).

    ``pin.buildReducedModel`` finds joints by the names of frames, and in URDF models links and
    joints may have the same names; link frames are renamed meanwhile.
    """
    working = model.copy()
    mark = "\0link"
    for frame in working.frames:
        if frame.type == pin.FrameType.BODY:
            frame.name += mark
    reduced = pin.buildReducedModel(working, [working.getJointId(name) for name in names], q)
    for frame in reduced.frames:
        frame.name = frame.name.removesuffix(mark)
    return reduced
