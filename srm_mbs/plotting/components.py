"""Joints as curves: what is drawn of a joint of one or several degrees of freedom."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError
from srm_mbs.mechanism import Mechanism
from srm_mbs.solution import Solution
from srm_mbs.systems.units import coordinate_units, joint_turns

XYZ = ("x", "y", "z")
CERTAIN = 0.1
"""Part of the tolerance of a run below which changes of its coordinates are drawn as none."""
LOOSE = 1e-6
"""The largest tolerance that is taken for this: of loose runs, small motions are seen as well."""


@dataclass(frozen=True, eq=False)
class Component:
    """Coordinates of a joint that share an axis.

    Attributes
    ----------
    joint
        Its name.
    what
        What of it, or "" where it has only this.
    unit
        Of the positions; the rates are per second.
    names
        Of the curves; one "" where there is one only.
    positions : (n, k), rates : (n, k)
        Angles unwrapped, and rotations as vectors; rates linear or angular, in the axes of the
        moving body where there are several.
    sizes
        What is of ordinary size for positions and rates.
    """

    joint: str
    what: str
    unit: str
    names: tuple[str, ...]
    positions: FloatArray
    rates: FloatArray
    sizes: tuple[float, float]


def chosen_joints(mechanism: Mechanism, joints: Sequence[str] | None) -> tuple[str, ...]:
    """The names ``joints``, each checked; all that there are if it is None.

    Raises
    ------
    InputError
        If one is not there, is named twice, or none is named.
    """
    if joints is None:
        return mechanism.joint_names
    names = checked_names(joints, "joints", 'Give for example joints=["crank"]')
    for name in names:
        try:
            mechanism.joint(name)
        except InputError as error:
            error.element = "joints"
            raise
    return names


def checked_names(names: Any, element: str, remedy: str) -> tuple[str, ...]:
    """``names`` as a tuple of different names.

    Raises
    ------
    InputError
        About ``element`` if they are none, one is there twice, or they are no strings.
    """
    single = isinstance(names, str)
    found = () if single or not isinstance(names, Sequence) else tuple(names)
    if not found or not all(isinstance(name, str) for name in found):
        raise InputError(f"{names!r} is not a list of names", element=element, remedy=remedy)
    for name in found:
        if found.count(name) > 1:
            raise InputError(f"{name!r} is named twice", element=element, remedy="Name it once")
    return found


def components(run: Solution, joint: str) -> Iterator[Component]:
    """What is drawn of the joint, read at ``run.t``."""
    mechanism = run.mechanism
    data = mechanism.joint(joint)
    units = coordinate_units(mechanism, mechanism.q0, mechanism.v0)
    q = run.q[:, data.idx_q : data.idx_q + data.nq]
    v = run.v[:, data.idx_v : data.idx_v + data.nv]

    def component(
        what: str, own: slice, positions: FloatArray, names: tuple[str, ...], turns: bool
    ) -> Component:
        size = 1.0 if turns else units.length
        unit = "rad" if turns else "m"
        sizes = (size, size * units.rate)
        return Component(joint, what, unit, names, positions, v[:, own], sizes)

    kind = data.shortname().removeprefix("JointModel")
    if data.nv == 1:
        turns = joint_turns(mechanism.model, joint)
        yield component("", slice(0, 1), run.joint(joint)[0][:, None], ("",), turns)
    elif kind == "FreeFlyer":
        yield component("position", slice(0, 3), q[:, :3], XYZ, turns=False)
        yield component("rotation", slice(3, 6), rotation_vectors(q[:, 3:]), XYZ, turns=True)
    elif kind == "Spherical":
        yield component("rotation", slice(0, 3), rotation_vectors(q), XYZ, turns=True)
    elif kind == "Planar":
        angle = np.unwrap(np.arctan2(q[:, 3], q[:, 2]))[:, None]
        yield component("position", slice(0, 2), q[:, :2], XYZ[:2], turns=False)
        yield component("angle", slice(2, 3), angle, ("",), turns=True)
    else:
        numbers = tuple(str(i + 1) for i in range(data.nv))
        names = XYZ if kind == "Translation" else numbers
        same = q if data.nq == data.nv else q[:, : data.nv]
        yield component("", slice(0, data.nv), same, names, turns=kind != "Translation")


def noise(run: Solution) -> float:
    """Part of the ordinary size below which coordinates of ``run`` do not move."""
    return CERTAIN * min(run.settings.rtol, LOOSE)


def rotation_vectors(quaternions: FloatArray) -> FloatArray:
    """Rotation vectors (n, 3) rad of ``quaternions`` (n, 4) x, y, z, w along a motion.

    Each is the one nearest to its predecessor of all that mean the same rotation, so that turns
    count and no jump is seen where the angle passes pi.
    """
    out = np.empty((len(quaternions), 3))
    last = np.zeros(3)
    for i, (x, y, z, w) in enumerate(quaternions):
        vector = pin.log3(pin.Quaternion(w, x, y, z).toRotationMatrix())
        angle = float(np.linalg.norm(vector))
        # Of the identity, a whole turn about any axis means the same.
        axis = vector / angle if angle > 1e-9 else last / (np.linalg.norm(last) or 1.0)
        whole = np.round((last @ axis - angle) / (2.0 * np.pi))
        last = vector + 2.0 * np.pi * whole * axis
        out[i] = last
    return out
