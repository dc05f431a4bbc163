"""Units of the coordinates: what "one" means for an angle, a length and a rate.

Tolerances and step rules use them, so that the same mechanism in millimetres, with other masses
or on another time scale, takes the same steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.mechanism import LoopClosure, Mechanism
from srm_mbs.systems.loops import world_jacobian


@dataclass(frozen=True)
class Units:
    """Characteristic sizes of a mechanism.

    Attributes
    ----------
    length
        Scene diagonal (m): bounding box of joints, centres of mass and anchors at q0.
    coordinate : (nv,)
        1 rad for angles, ``length`` for translations.
    rate
        Characteristic rate (1/s): sqrt(g / length); without gravity the median of the initial
        rates over their units, as far as they are not zero; 1 if all are.  A fast rotor does not
        loosen what is asked of the slow rest.
    """

    length: float
    coordinate: FloatArray
    rate: float


def row_units(loops: Sequence[LoopClosure], length: float) -> FloatArray:
    """Units of the closure rows (rows,): ``length`` (m) for position rows, 1 rad for the others.

    Closure errors over these are pure numbers, whatever the unit of length.
    """
    units = [
        np.repeat([length, 1.0], [len(loop.rows.directions), len(loop.rows.alignments)])
        for loop in loops
    ]
    return np.concatenate(units) if units else np.zeros(0)


def coordinate_units(mechanism: Mechanism, q: FloatArray, v: FloatArray) -> Units:
    """Units of ``mechanism`` at the configuration q (nq,) and velocity v (nv,)."""
    model = mechanism.model
    data = model.createData()
    pin.computeJointJacobians(model, data, q)
    points = []
    for joint in range(1, model.njoints):
        points.append(data.oMi[joint].translation.copy())
        if model.inertias[joint].mass > 0.0:
            points.append(data.oMi[joint].act(model.inertias[joint].lever))
    for loop in mechanism.loops:
        for anchor in (loop.a, loop.b):
            joint, placement = anchor.resolve(model)
            points.append(data.oMi[joint].act(placement.translation))
    corners = np.array(points) if points else np.zeros((1, 3))
    diagonal = float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
    length = diagonal if diagonal > 0.0 else 1.0
    angular = np.abs(world_jacobian(data)[3:]).max(axis=0) > 1e-9
    coordinate = np.where(angular, 1.0, length)
    rate = float(np.sqrt(np.linalg.norm(model.gravity.linear) / length))
    moving = np.abs(v[v != 0.0]) / coordinate[v != 0.0]
    if rate == 0.0:
        rate = float(np.median(moving)) if moving.size else 1.0
    return Units(length, coordinate, rate)
