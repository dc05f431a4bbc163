"""A two-legged robot of about Cassie's size, falling: 22 joints, a free pelvis, 4 spatial loops.

Every leg has hip roll, yaw and pitch, knee, tarsus and toe; a rod from the thigh to the heel of
the tarsus, and a crank on the tarsus that drives the toe by a second rod.  The rods hang on
universal joints and end in ball joints, which the closures are.  28 coordinates, 12 rows, 16
degrees of freedom; masses and lengths are of Cassie's order, not its own.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from benchmarks.work_precision.problems.base import Array, Problem
from benchmarks.work_precision.trees import Equations, tree_of

SIDES = (("left", 1.0), ("right", -1.0))
SEED = 20
JOINT_SPEED = 1.0  # rad/s, standard deviation before the rates are made consistent


def _body(mass: float, along: Array, thickness: float = 0.05) -> pin.Inertia:
    """A cylinder of ``thickness`` (m) from the origin to ``along`` (m)."""
    length = float(np.linalg.norm(along))
    inertia = pin.Inertia.FromCylinder(mass, thickness, length)
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).matrix()
    return pin.SE3(turn, 0.5 * np.asarray(along)).act(inertia)


class _Builder:
    """Adds joints depth first and remembers where they are at the start."""

    def __init__(self) -> None:
        self.model = pin.Model()
        self.model.name = "walking_robot"
        self.at = {0: pin.SE3.Identity()}
        self.loops: list[srm.LoopClosure] = []

    def joint(
        self, parent: int, kind: object, xyz: Array, name: str, turn: Array | None = None
    ) -> int:
        """A joint at ``xyz`` (m) of its parent, turned by the rotation matrix ``turn``."""
        placement = pin.SE3(np.eye(3) if turn is None else turn, np.array(xyz))
        index = self.model.addJoint(parent, kind, placement, name)
        self.model.addBodyFrame(name, index, pin.SE3.Identity(), 0)
        self.at[index] = self.at[parent] * placement
        return int(index)

    def body(self, joint: int, mass: float, along: Array) -> None:
        self.model.appendBodyToJoint(joint, _body(mass, np.array(along)), pin.SE3.Identity())

    def rod(self, parent: int, xyz: Array, end: Array, mass: float, name: str) -> float:
        """A rod on a universal joint at ``xyz`` of ``parent`` that ends at ``end`` (world axes,
        m); its length (m)."""
        start = self.at[parent].act(np.array(xyz))
        along = self.at[parent].rotation.T @ (end - start)
        length = float(np.linalg.norm(along))
        turn = pin.Quaternion.FromTwoVectors(np.array([1.0, 0.0, 0.0]), along).matrix()
        first = self.joint(parent, pin.JointModelRY(), xyz, f"{name}_y", turn)
        second = self.joint(first, pin.JointModelRZ(), np.zeros(3), name)
        self.body(second, mass, [length, 0.0, 0.0])
        return length

    def close(self, rod: str, length: float, link: str, xyz: Array) -> None:
        a = srm.Anchor(rod, xyz=(length, 0.0, 0.0))
        self.loops.append(
            srm.LoopClosure("point", a, srm.Anchor(link, xyz=tuple(xyz)), name=f"{rod}_end")
        )


def _pitch(angle: float) -> Array:
    return pin.rpy.rpyToMatrix(0.0, angle, 0.0)


def _leg(build: _Builder, pelvis: int, name: str, side: float) -> None:
    out = np.array([1.0, side, 1.0])
    roll = build.joint(pelvis, pin.JointModelRX(), [0.02, 0.13 * side, 0.0], f"{name}_roll")
    build.body(roll, 1.8, [-0.06, 0.0, 0.0])
    yaw = build.joint(roll, pin.JointModelRZ(), [0.0, 0.0, -0.09], f"{name}_yaw")
    build.body(yaw, 1.2, [0.0, 0.03 * side, -0.05])
    thigh = build.joint(
        yaw, pin.JointModelRY(), [0.0, 0.03 * side, -0.06], f"{name}_thigh", _pitch(-0.6)
    )
    build.body(thigh, 5.5, [0.0, 0.0, -0.35])
    knee_at, heel = np.array([0.0, 0.0, -0.35]), out * [-0.06, -0.03, 0.05]
    # The rod comes before the shin: joints are added depth first.
    shin_placement = pin.SE3(_pitch(1.1), knee_at)
    tarsus_placement = pin.SE3(_pitch(-1.2), np.array([0.0, 0.0, -0.3]))
    tarsus_at = build.at[thigh] * shin_placement * tarsus_placement
    rod, at = f"{name}_achilles", out * [0.03, 0.04, -0.05]
    length = build.rod(thigh, at, tarsus_at.act(heel), 0.15, rod)
    build.close(rod, length, f"{name}_tarsus", heel)
    shin = build.joint(thigh, pin.JointModelRY(), knee_at, f"{name}_shin", _pitch(1.1))
    build.body(shin, 1.0, [0.0, 0.0, -0.3])
    tarsus = build.joint(
        shin, pin.JointModelRY(), tarsus_placement.translation, f"{name}_tarsus", _pitch(-1.2)
    )
    build.body(tarsus, 0.8, [0.0, 0.0, -0.35])
    toe_at, lever = np.array([0.0, 0.0, -0.35]), out * [-0.06, 0.02, 0.0]
    toe_placement = pin.SE3(_pitch(0.7), toe_at)
    pin_at = (build.at[tarsus] * toe_placement).act(lever)
    crank = build.joint(
        tarsus, pin.JointModelRY(), out * [0.0, 0.02, -0.06], f"{name}_crank", _pitch(0.6)
    )
    build.body(crank, 0.1, [-0.06, 0.0, 0.0])
    rod = f"{name}_plantar"
    length = build.rod(crank, out * [-0.06, 0.03, 0.0], pin_at, 0.12, rod)
    build.close(rod, length, f"{name}_toe", lever)
    toe = build.joint(tarsus, pin.JointModelRY(), toe_at, f"{name}_toe", _pitch(0.7))
    build.body(toe, 0.3, [0.12, 0.0, -0.02])


@cache
def mechanism() -> srm.Mechanism:
    """The robot 1 m up, falling and turning, its joints in motion."""
    build = _Builder()
    pelvis = build.joint(0, pin.JointModelFreeFlyer(), np.zeros(3), "pelvis")
    build.body(pelvis, 10.0, [0.0, 0.0, 0.15])
    for name, side in SIDES:
        _leg(build, pelvis, name, side)
    model = build.model
    q0 = pin.neutral(model)
    q0[2] = 1.0
    rng = np.random.default_rng(SEED)
    v = JOINT_SPEED * rng.standard_normal(model.nv)
    v[:6] = [0.3, 0.1, 0.5, 0.4, -0.6, 0.8]
    robot = srm.Mechanism(model, tuple(build.loops), q0=q0)
    q0, v0 = Equations(tree_of(robot)).projected(q0, v)
    return robot.with_state(q0, v0)


def observe(q: Array, v: Array) -> Array:
    """Position (3) and rotation matrix (9) of the pelvis, joint angles (22), its velocity (6)."""
    rotations = [pin.Quaternion(x / np.linalg.norm(x)).matrix().ravel() for x in q[:, 3:7]]
    return np.hstack([q[:, :3], rotations, q[:, 7:], v[:, :6]])


def walking_robot() -> Problem:
    """Free fall for 1 s."""
    return Problem(
        "walking_robot",
        "Two-legged robot, free pelvis, 22 joints, 4 spatial loops, falling, 1 s",
        1.0,
        mechanism,
        lambda: tree_of(mechanism()),
        observe,
        rates=34,
        gains=(10.0, 30.0, 100.0),
    )
