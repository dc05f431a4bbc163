"""Cassie as example-robot-data describes it in SDF, falling freely with its joints in motion.

26 joints, of which four balls close loops: 12 rows, 10 of them independent, since the two rods
that drive the feet move in the plane of their leg.  Stiff springs (1250 and 1500 N m/rad) in the
shins and heels, and damped joints.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

import srm_mbs as srm
from benchmarks.work_precision.problems.base import Array, Problem
from benchmarks.work_precision.problems.walking_robot import observe
from benchmarks.work_precision.trees import Equations, TorsionSpring, Tree, tree_of
from tests.support.sdf_files import cassie as path_of

SEED = 5
JOINT_SPEED = 1.0  # rad/s, standard deviation before the rates are made consistent


def tree(mechanism: srm.Mechanism) -> Tree:
    """What the peers get: of the rows in the feet the two that are not along the axes of the
    leg's hinges, which stay near the y axis."""
    bare = tree_of(mechanism)
    closures = tuple(
        replace(closure, rows=(0, 2)) if "plantar" in loop.name else closure
        for loop, closure in zip(mechanism.loops, bare.closures)
    )
    springs = tuple(
        TorsionSpring(mechanism.model.getJointId(force.joint), force.stiffness, force.rest_angle)
        for force in mechanism.forces
        if isinstance(force, srm.TorsionSpring)
    )
    return replace(bare, closures=closures, torsion=springs)


@cache
def mechanism() -> srm.Mechanism:
    """Cassie at the pose of the file, falling and turning, its joints in motion."""
    robot = srm.load(path_of("cassie_v2"))
    v = JOINT_SPEED * np.random.default_rng(SEED).standard_normal(robot.model.nv)
    v[:6] = [0.3, 0.1, 0.5, 0.4, -0.6, 0.8]
    q0, v0 = Equations(tree(robot)).projected(robot.q0, v)
    return robot.with_state(q0, v0)


def observed(q: Array, v: Array) -> Array:
    """As of the walking robot: position (3) and rotation matrix (9) of the model's frame, joint
    angles (22), its velocity (6); then the joints' rates (22)."""
    return np.hstack([observe(q, v), v[:, 6:]])


def cassie() -> Problem:
    """Free fall for 0.2 s."""
    return Problem(
        "cassie",
        "Cassie (SDF), free pelvis, 22 joints, 4 loops with 2 redundant rows, falling, 0.2 s",
        0.2,
        mechanism,
        lambda: tree(mechanism()),
        observed,
        rates=34,
        gains=(10.0, 30.0, 100.0),
    )
