"""Coordinates of the joints of a run as plots and animations show them: angles, vectors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.scaling import coordinate_units, is_angle
from srm_mbs.simulation.result import SimulationResult

XYZ = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Component:
    """Coordinates of a joint that share an axis.

    Attributes
    ----------
    joint
        Its name.
    part
        For example ``rotation``; "" if the joint has one component.
    unit
        Unit of the positions; that of the rates is per second.
    names
        Names of the curves; a single one is "".
    positions : (n, k), rates : (n, k)
        Unwrapped angles, and rotation vectors; linear or angular rates, in the axes of the moving
        body if there are several.
    sizes
        Typical magnitude of positions, rates and accelerations.
    own
        The columns of its rates among those of the mechanism.
    """

    joint: str
    part: str
    unit: str
    names: tuple[str, ...]
    positions: FloatArray
    rates: FloatArray
    sizes: tuple[float, float, float]
    own: slice


def components(run: SimulationResult, joint: str) -> Iterator[Component]:
    """The components of a joint at the times ``run.t``."""
    mechanism = run.mechanism
    data = mechanism.joint(joint)
    units = coordinate_units(mechanism, mechanism.q0, mechanism.v0)
    q = run.q[:, data.idx_q : data.idx_q + data.nq]
    v = run.v[:, data.idx_v : data.idx_v + data.nv]

    def component(
        part: str, own: slice, positions: FloatArray, names: tuple[str, ...], turns: bool
    ) -> Component:
        unit, size = ("rad", 1.0) if turns else ("m", units.length)
        sizes = (size, size * units.rate, size * units.rate**2)
        first = data.idx_v
        whole = slice(first + own.start, first + own.stop)
        return Component(joint, part, unit, names, positions, v[:, own], sizes, whole)

    kind = data.shortname().removeprefix("JointModel")
    if data.nv == 1:
        turns = is_angle(mechanism.model, joint)
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
        whole = slice(0, data.nv)
        yield component("", whole, q[:, whole], names, turns=kind != "Translation")


def rotation_vectors(quaternions: FloatArray) -> FloatArray:
    """Rotation vectors (n, 3) rad of ``quaternions`` (n, 4) x, y, z, w along a motion.

    Of all vectors of the same rotation, each is the closest one to its predecessor, so that angles
    are unwrapped and do not jump at pi.
    """
    out = np.empty((len(quaternions), 3))
    last = np.zeros(3)
    for i, (x, y, z, w) in enumerate(quaternions):
        vector = pin.log3(pin.Quaternion(w, x, y, z).toRotationMatrix())
        angle = float(np.linalg.norm(vector))
        # The identity is a whole turn about any axis.
        axis = vector / angle if angle > 1e-9 else last / (np.linalg.norm(last) or 1.0)
        whole = np.round((last @ axis - angle) / (2.0 * np.pi))
        last = vector + 2.0 * np.pi * whole * axis
        out[i] = last
    return out
