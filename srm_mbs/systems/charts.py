r"""Tangent charts on the configuration manifold.

Within a step the configuration is q = q_n \oplus u, and u' = dexp^{-1}_u(v) with the body
velocity v.  The chart keeps the full order of a Runge-Kutta scheme where nq != nv; a naive
q_n \oplus h sum a_ij v_j is of order 2 (H. Munthe-Kaas, Appl. Numer. Math. 29 (1999) 115).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import InputError

ROTATION_PER_STEP = 1.5
"""Rotation in one step (rad) that step-size control aims at; dexp^-1 is exact to round-off."""
LARGEST_ROTATION = 2.5
"""Rotation (rad) of a stage that the charts accept: the series errs by 2e-11 there."""

FARTHEST_NODE = 2.0
"""Rotation (rad) of a node of an interpolant.  With one step more (by ROTATION_PER_STEP, and a part
of it that was skipped) a joint that has turned on does not seem to be within it again."""


def _bernoulli_terms(count: int) -> tuple[float, ...]:
    """B_{2n} / (2n)! for n = 1 .. count, exact before rounding."""
    numbers = [Fraction(1)]
    for m in range(1, 2 * count + 1):
        numbers.append(-sum(math.comb(m + 1, k) * numbers[k] for k in range(m)) / Fraction(m + 1))
    return tuple(float(numbers[2 * n] / math.factorial(2 * n)) for n in range(1, count + 1))


# 14 terms reach round-off for 1.5 rad (each gains (angle / 2 pi)^2) with room to spare for the
# stages that lie beyond the step's own rotation.
SERIES = _bernoulli_terms(14)
"""B_2n / (2n)! of dexp^-1."""


@dataclass(frozen=True)
class GroupJoint:
    """A joint whose configuration is a non-commutative Lie group."""

    group: str
    """``so3``, ``se3`` or ``se2``."""
    start: int
    """First velocity index."""
    size: int
    position: int
    """First configuration index."""

    def ad(self, u: FloatArray) -> FloatArray:
        """Matrix of w -> [u, w] in Pinocchio's order (linear, angular)."""
        if self.group == "so3":
            return _skew(u)
        if self.group == "se2":
            x, y, w = u
            return np.array([[0.0, -w, y], [w, 0.0, -x], [0.0, 0.0, 0.0]])
        out = np.zeros((6, 6))
        out[:3, :3] = out[3:, 3:] = _skew(u[3:])
        out[:3, 3:] = _skew(u[:3])
        return out

    def rotation(self, v: FloatArray) -> float:
        """Size of the joint's angular part of a whole tangent vector v (nv,): rad or rad/s."""
        angular = {"so3": 0, "se3": 3, "se2": 2}[self.group]
        return float(np.linalg.norm(v[self.start + angular : self.start + self.size]))


def _skew(w: FloatArray) -> FloatArray:
    x, y, z = w
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def group_joints(model: pin.Model) -> tuple[GroupJoint, ...]:
    """The joints of ``model`` that need a chart.

    An unbounded revolute joint stores (cos, sin) but its group is commutative: no chart.

    Raises
    ------
    InputError
        If a joint has nq != nv in a way that this version does not know (a composite joint with
        a ball inside, a mimic joint).
    """
    found = []
    for joint_id in range(1, model.njoints):
        joint = model.joints[joint_id]
        name, kind = model.names[joint_id], joint.shortname()
        if "Mimic" in kind:
            raise InputError(
                f"joint {name!r} is a Pinocchio mimic joint", remedy="Build the model without it"
            )
        if joint.nq == joint.nv or joint.nv == 1:
            continue
        group = {
            "JointModelSpherical": "so3",
            "JointModelFreeFlyer": "se3",
            "JointModelPlanar": "se2",
        }.get(kind)
        if group is None:
            raise InputError(
                f"joint {name!r} of type {kind} has nq = {joint.nq}, nv = {joint.nv}, "
                "which is not supported",
                remedy="Split it into spherical, planar, free-flyer and one-degree joints",
            )
        found.append(GroupJoint(group, joint.idx_v, joint.nv, joint.idx_q))
    return tuple(found)


def planar_translation(q: FloatArray, u: FloatArray) -> tuple[float, float]:
    """Translation of the planar joint coordinates q (4,) (+) u (3,).

    Pinocchio's own loses eps / angle of the displacement, 1e-8 of it at 1e-8 rad, because it
    forms 1 - cos; here the displacement is turned by half the angle.
    """
    x, y, c, s = q.tolist()
    dx, dy, turn = u.tolist()
    half = 0.5 * turn
    chord = math.sin(half) / half if half else 1.0
    along, across = chord * math.cos(half), chord * math.sin(half)
    a, b = along * dx - across * dy, across * dx + along * dy
    return x + c * a - s * b, y + s * a + c * b


def dexp_inverse(joint: GroupJoint, u: FloatArray, v: FloatArray) -> FloatArray:
    r"""dexp^-1 on one joint's group, shape (size,).

    u' = v + ad_u v / 2 + sum_n B_2n/(2n)! ad_u^{2n} v.  (The sign of the ad_u/2 term belongs to
    body velocities.)  The series is used throughout because Pinocchio's Jlog loses up to 1e-9
    for angles of 3e-4 ... 3e-3 rad.
    """
    ad = joint.ad(u)
    w = ad @ v
    out: FloatArray = v + 0.5 * w
    for coefficient in SERIES:
        w = ad @ w
        term = coefficient * w
        out += term
        if np.abs(term).max() <= 1e-18 * np.abs(v).max():
            break
        w = ad @ w
    return out
