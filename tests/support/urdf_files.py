"""URDFs with loops for tests: a tree with two branches, and what closes it in the words of each
tool."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.formats.build import unassembled
from srm_mbs.formats.load import Overrides, read

LINK = """<link name="{name}"><inertial><origin xyz="0.2 {y} 0.1" rpy="0.3 0 0.1"/>
  <mass value="{mass}"/><inertia ixx="0.03" iyy="0.05" izz="0.06" ixy="0.002" ixz="0" iyz="0.001"/>
</inertial></link>
"""
JOINT = """<joint name="{name}" type="{type}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>
  <limit lower="-9" upper="9" effort="1" velocity="1"/>{more}</joint>
"""
BRANCHES = (
    ("hip", "revolute", "base", "thigh", "0.1 0 0.2", "0.3 -0.2 0.1", "0 1 0"),
    ("knee", "continuous", "thigh", "shin", "0 0.4 0.1", "0 0.5 -0.3", "2 1 2"),
    ("track", "prismatic", "base", "slide", "-0.3 0.1 0", "0.2 0.1 0.7", "0 3 4"),
    ("wheel", "revolute", "slide", "rim", "0.2 0 -0.1", "-0.6 0 0.2", "0 0 1"),
)
MASSES = {"thigh": 1.5, "shin": 0.8, "slide": 0.5, "rim": 0.7}

# What closes the loop between shin and rim: frames on both, and an axis in them.
ON_SHIN = ((0.1, -0.2, 0.3), (0.4, 0.2, -0.5))
ON_RIM = ((-0.2, 0.1, 0.05), (0.1, -0.3, 0.8))
AXIS = (1.0, -2.0, 2.0)


def text(values: object) -> str:
    return " ".join(map(str, values))  # type: ignore[call-overload]


def tree(closing: str = "", joints: dict[str, str] | None = None) -> str:
    """A robot of two branches, open; ``closing`` is added to it, ``joints`` inside its joints."""
    out = ['<robot name="two_branches"><link name="base"/>']
    for i, (name, mass) in enumerate(MASSES.items()):
        out.append(LINK.format(name=name, mass=mass, y=0.1 * i))
    keys = ("name", "type", "parent", "child", "xyz", "rpy", "axis")
    for branch in BRANCHES:
        more = (joints or {}).get(branch[0], "")
        out.append(JOINT.format(**dict(zip(keys, branch)), more=more))
    return "".join(out) + closing + "</robot>\n"


def placement(xyz: object, rpy: object) -> pin.SE3:
    return pin.SE3(pin.rpy.rpyToMatrix(np.array(rpy, dtype=float)), np.array(xyz, dtype=float))


def open_mechanism(path: Path, cut: tuple[str, ...] = ()) -> srm.Mechanism:
    """The mechanism of a file before anything is closed."""
    return unassembled(read(path, Overrides(cut=cut)))[0]


def relative(q: FloatArray, on_shin: object = ON_SHIN, on_rim: object = ON_RIM) -> pin.SE3:
    """Placement of the frame on the rim in that on the shin, from Pinocchio's own reader."""
    model = pin.buildModelFromXML(tree())
    at = configuration(model, q)
    data = model.createData()
    pin.framesForwardKinematics(model, data, at)
    shin, rim = (data.oMf[model.getFrameId(name)] for name in ("shin", "rim"))
    return (shin * placement(*on_shin)).actInv(rim * placement(*on_rim))  # type: ignore[misc]


def configuration(model: pin.Model, q: FloatArray) -> FloatArray:
    """q (4,) by hip, knee, track, wheel in the coordinates of ``model``."""
    out = pin.neutral(model)
    for value, name in zip(q, ("hip", "knee", "track", "wheel")):
        joint = model.joints[model.getJointId(name)]
        if joint.nq == 2:
            out[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
        else:
            out[joint.idx_q] = value
    return out
