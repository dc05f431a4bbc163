"""URDF to Pinocchio: the checked tree on its base, and joints that are locked.

Pinocchio gets a copy of the file that holds nothing but what
:class:`~srm_mbs.loading.urdf_check.UrdfChecker` has checked; what is dropped knowingly is listed in
the notes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dpotrf

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.loading.joint_types import take_extended, with_joints
from srm_mbs.loading.safe_xml import parse_urdf
from srm_mbs.loading.urdf_check import UrdfChecker

log = logging.getLogger(__name__)

NO_INERTIA = 1e-13
"""An articulated inertia below this fraction of the composite one is the rounding of zero."""


@dataclass(frozen=True)
class UrdfModel:
    """A checked URDF and its tree.

    Attributes
    ----------
    model
        Pinocchio's model, with joint damping from the file.
    notes
        Sentences about what the file holds and this version does not use.
    """

    model: pin.Model
    notes: tuple[str, ...]


ROOT_JOINTS: dict[str, Callable[[], Any] | None] = {
    "fixed": None,
    "floating": pin.JointModelFreeFlyer,
    "planar": pin.JointModelPlanar,
}


def check_inertia(model: pin.Model, file: str) -> None:
    """Refuse joints that move no inertia: the equations of motion have no solution.

    Raises
    ------
    InputError
        Naming the joint and the links that it moves.
    """
    if model.nv == 0:
        return
    moved = np.zeros((model.njoints, 2))
    for joint in range(model.njoints - 1, 0, -1):
        inertia = model.inertias[joint]
        moved[joint] += inertia.mass, np.trace(inertia.inertia)
        moved[model.parents[joint]] += moved[joint]

    def links(joint: int) -> str:
        return ", ".join(
            repr(f.name)
            for f in model.frames
            if f.parentJoint == joint and f.type == pin.FrameType.BODY
        )

    for joint in range(1, model.njoints):
        if not moved[joint].any():
            raise InputError(
                f"neither {links(joint)} nor anything behind it has inertia",
                file=file,
                element=f"joint {model.names[joint]!r}",
                remedy="Give the moving end of the chain an <inertial>",
            )
    rng = np.random.default_rng(0)
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.0, 1.0, model.nv))
    at = undetermined_joint(model, q, file)
    if at is not None:
        raise InputError(
            f"the joint moves mass ({links(at)} and what is behind it) but no inertia in one "
            "of its directions: its acceleration is not determined",
            file=file,
            element=f"joint {model.names[at]!r}",
            remedy="Give a moment of inertia, or a centre of mass off the axis",
        )


def undetermined_joint(model: pin.Model, q: FloatArray, file: str) -> int | None:
    """A joint with a direction in which it moves no inertia at q (nq,); None if there is none.

    As one whose axis runs through a point mass, or the outer axes of massless links in line.  The
    pivots of M, tips first, show it; they are those of the articulated inertias over M_ii.

    Raises
    ------
    InputError
        If the mass matrix is not finite.
    """
    with np.errstate(all="ignore"):
        M = pin.crba(model, model.createData(), q)
        M = (np.triu(M) + np.triu(M, 1).T)[::-1, ::-1]
        size = np.sqrt(np.diag(M))
        scaled = M / size[:, None] / size
    if not np.isfinite(M).all():
        raise InputError(
            "the mass matrix is not finite",
            file=file,
            remedy="Check the size of the masses, inertias and lengths",
        )
    bad = np.flatnonzero(~(size > 0.0))
    if bad.size:
        failed = int(bad[0])
    else:
        factor, info = dpotrf(scaled, lower=1)
        small = np.flatnonzero(np.diag(factor)[: info - 1 if info else None] ** 2 < NO_INERTIA)
        if not small.size and not info:
            return None
        failed = int(small[0]) if small.size else info - 1
    component = model.nv - 1 - failed
    return next(i for i in range(1, model.njoints) if component < _velocity_end(model, i))


def _velocity_end(model: pin.Model, joint: int) -> int:
    return int(model.joints[joint].idx_v + model.joints[joint].nv)


def build_urdf(
    text: str,
    file: str,
    base: str,
    locked: Sequence[str] = (),
    counting_turns: Collection[str] = (),
) -> UrdfModel:
    """Check ``text`` and build its tree on a fixed, floating or planar base.

    Inertias are checked by :func:`check_inertia`, after locking.

    Parameters
    ----------
    text, file
        The URDF and its name for messages.
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
    root = parse_urdf(text, file)
    checker.check(root, base, locked)
    unlimited = _without_limits(root, set(counting_turns) - set(locked))
    armature = _armature(root)
    extended = take_extended(root)
    text = tostring(root, encoding="unicode")
    root_joint = ROOT_JOINTS[base]
    try:
        if root_joint is None:
            model = pin.buildModelFromXML(text)
        else:
            model = pin.buildModelFromXML(text, root_joint())
    except Exception as error:  # Boost.Python raises whatever Pinocchio throws
        raise InputError(f"Pinocchio cannot read it: {error}", file=file) from error
    for name, bare in unlimited.items():
        joint = model.joints[model.getJointId(name)]
        model.lowerPositionLimit[joint.idx_q] = -np.inf
        model.upperPositionLimit[joint.idx_q] = np.inf
        if bare:
            model.effortLimit[joint.idx_v] = model.velocityLimit[joint.idx_v] = np.inf
    for note in checker.notes:
        log.info("%s: %s", file, note)
    model = with_joints(model, extended)
    for name, value in armature.items():
        joint = model.joints[model.getJointId(name)]
        model.armature[joint.idx_v : joint.idx_v + joint.nv] = value
    return UrdfModel(model, tuple(checker.notes))


def _armature(root: Element) -> dict[str, float]:
    """Inertias of motors by joint: an attribute of <dynamics> that URDF does not have."""
    found = {}
    for joint in root.findall("joint"):
        dynamics = joint.find("dynamics")
        if dynamics is None or "armature" not in dynamics.attrib:
            continue
        value = float(dynamics.attrib.pop("armature"))
        if joint.get("type") != "fixed":
            found[joint.get("name", "")] = value
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

    Pinocchio finds joints by frame name there, and URDF models give links and joints the same
    names; link frames are renamed while it works.
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
