r"""The state space of a mechanism, x = (q, v): charts, moves, norms and limits.

It depends on the joints alone, not on masses, forces or closures.

Within a step the configuration is q = q_n \oplus u, and u' = dexp^{-1}_u(v) with the body
velocity v.  The chart keeps the full order of a Runge-Kutta scheme where nq != nv; a naive
q_n \oplus h sum a_ij v_j is of order 2 (H. Munthe-Kaas, Appl. Numer. Math. 29 (1999) 115).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs._typing import FloatArray, IndexArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.dynamics.scaling import is_angle, vector_coordinates
from srm_mbs.errors import EvaluationError, InputError
from srm_mbs.model.coordinates import position_of
from srm_mbs.model.lazy import cached_property
from srm_mbs.model.mechanism import MechanismData, per_tree

ROTATION_PER_STEP = 1.5
"""Rotation in one step (rad) that step-size control aims at; dexp^-1 is exact to round-off."""
LARGEST_ROTATION = 2.5
"""Rotation (rad) of a stage that the charts accept: the series errs by 2e-11 there."""

FARTHEST_NODE = 2.0
"""Largest rotation (rad) of a node of an interpolant.  One step more (ROTATION_PER_STEP, and a part
of it that was skipped) does not bring a joint that turns on back within it."""


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
    """A joint whose configurations are a Lie group that does not commute."""

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
            return pin.skew(u)  # type: ignore[no-any-return]
        if self.group == "se3":
            return pin.Motion(u).action  # type: ignore[no-any-return]
        x, y, w = u
        return np.array([[0.0, -w, y], [w, 0.0, -x], [0.0, 0.0, 0.0]])

    def rotation(self, v: FloatArray) -> float:
        """Size of the joint's angular part of a whole tangent vector v (nv,): rad or rad/s."""
        angular = {"so3": 0, "se3": 3, "se2": 2}[self.group]
        return float(np.linalg.norm(v[self.start + angular : self.start + self.size]))


def joint_track(mechanism: MechanismData, q: FloatArray, name: str) -> FloatArray:
    """Positions (n,) of the one-degree joint ``name`` along q (n, nq): rad, without jumps of a
    turn, or m."""
    found = np.array([position_of(mechanism, row, name) for row in q])
    return np.unwrap(found) if is_angle(mechanism.model, name) else found


def group_joints(model: pin.Model) -> tuple[GroupJoint, ...]:
    """The joints of ``model`` that need a chart.

    An unbounded revolute joint stores (cos, sin) but its group is commutative: no chart.

    Raises
    ------
    InputError
        If a joint has nq != nv and is not one of these (a composite joint with a ball inside).
    """
    found = []
    for joint_id in range(1, model.njoints):
        joint = model.joints[joint_id]
        name, kind = model.names[joint_id], joint.shortname()
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
    out = v + 0.5 * w
    for coefficient in SERIES:
        w = ad @ w
        term = coefficient * w
        out += term
        if np.abs(term).max() <= 1e-18 * np.abs(v).max():
            break
        w = ad @ w
    return out


@per_tree
def _groups(mechanism: MechanismData) -> tuple[GroupJoint, ...]:
    return group_joints(mechanism.model)


@per_tree
def _angle_pairs(mechanism: MechanismData) -> IndexArray:
    """Velocity indices of the joints whose angle is (cos, sin)."""
    joints = mechanism.model.joints.tolist()[1:]
    return np.array([j.idx_v for j in joints if (j.nq, j.nv) == (2, 1)], dtype=int)


@per_tree
def _chart_constants(mechanism: MechanismData) -> dict[str, Any]:
    groups = _groups(mechanism)
    return {
        "position_of": vector_coordinates(mechanism).tolist(),
        "groups": [(j.group, j.start, j.size, j.position) for j in groups],
        "series": np.array(SERIES),
        "wrapped_angles": _angle_pairs(mechanism).tolist(),
        "largest_rotation": LARGEST_ROTATION,
        "farthest_node": FARTHEST_NODE,
        "rotation_per_step": ROTATION_PER_STEP,
    }


class Manifold:
    """The state space of ``mechanism``; see :class:`~srm_mbs.dynamics.system.System`."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        self.model = mechanism.model
        self.nq, self.nv = len(mechanism.q0), len(mechanism.v0)
        self.tangent_size = 2 * self.nv
        self._flat = self.nq == self.nv
        self._unit = mechanism.structure.units.coordinate

    # Of the reference: runs of the compiled kernel read none of them.
    @cached_property
    def wraps(self) -> bool:
        """See :class:`~srm_mbs.dynamics.system.System`."""
        return bool(len(_angle_pairs(self.mechanism)))

    @cached_property
    def _groups(self) -> tuple[GroupJoint, ...]:
        return _groups(self.mechanism)

    @cached_property
    def _planar(self) -> list[GroupJoint]:
        return [joint for joint in self._groups if joint.group == "se2"]

    @cached_property
    def _position_of(self) -> IndexArray:
        return vector_coordinates(self.mechanism)

    @cached_property
    def _largest_scale(self) -> FloatArray:
        """Largest :meth:`state_scale` of coordinates that are a vector space."""
        return np.concatenate([self._unit, np.full(self.nv, np.inf)])

    def chart_constants(self) -> dict[str, Any]:
        """Constants for the compiled kernel, independent of the start."""
        return _chart_constants(self.mechanism)

    def split(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Views (q, v) of a state."""
        return state[: self.nq], state[self.nq :]

    def retract(self, state: FloatArray, delta: FloatArray) -> FloatArray:
        """(q (+) dq, v + dv)."""
        if self._flat:
            return state + delta
        out = np.empty_like(state)
        out[: self.nq] = pin.integrate(self.model, state[: self.nq], delta[: self.nv])
        for joint in self._planar:
            k, i = joint.position, joint.start
            out[k : k + 2] = planar_translation(state[k : k + 4], delta[i : i + 3])
        out[self.nq :] = state[self.nq :] + delta[self.nv :]
        return out

    def reachable(self, start: FloatArray, end: FloatArray) -> bool:
        """Whether no group joint turns by more than ``FARTHEST_NODE``; see
        :class:`~srm_mbs.dynamics.system.System`."""
        if not self._groups:
            return True
        moved = pin.difference(self.model, start[: self.nq], end[: self.nq])
        return all(joint.rotation(moved) <= FARTHEST_NODE for joint in self._groups)

    def difference(
        self, start: FloatArray, end: FloatArray, near: FloatArray | None = None
    ) -> FloatArray:
        """(q_end (-) q_start, v_end - v_start); see :class:`~srm_mbs.dynamics.system.System`."""
        if self._flat:
            return end - start
        nq = self.nq
        delta = np.concatenate(
            [pin.difference(self.model, start[:nq], end[:nq]), end[nq:] - start[nq:]]
        )
        # The logarithm loses digits at small angles, the exponential does not.
        moved = self.retract(start, delta)
        delta[: self.nv] += pin.difference(self.model, moved[:nq], end[:nq])
        if near is not None:
            turning = _angle_pairs(self.mechanism)
            turns = np.round((near[turning] - delta[turning]) / (2.0 * np.pi))
            delta[turning] += 2.0 * np.pi * turns
        return delta

    def chart_rate(self, delta: FloatArray, rate: FloatArray) -> FloatArray:
        """dexp^-1 on the joints that need it; ``rate`` itself otherwise."""
        if not self._groups:
            return rate
        out = rate.copy()
        for joint in self._groups:
            if joint.rotation(delta) > LARGEST_ROTATION:
                raise EvaluationError("a ball or free joint turns too far within one step")
            own = slice(joint.start, joint.start + joint.size)
            out[own] = dexp_inverse(joint, delta[own], rate[own])
        return out

    def rate_change(self, delta: FloatArray) -> FloatArray:
        """(dv, 0); see :class:`~srm_mbs.dynamics.system.System`."""
        out = np.zeros(delta.shape)
        out[..., : self.nv] = delta[..., self.nv :]
        return out

    def position_norm(self, delta: FloatArray) -> float:
        """max |dq| over units; see :class:`~srm_mbs.dynamics.system.System`."""
        # A list: the largest of a few numbers, for which NumPy takes five times as long.
        return float(max(map(abs, (delta[: self.nv] / self._unit).tolist())))

    def position_rounding(self, state: FloatArray) -> float:
        """That of coordinates that are numbers; see :class:`~srm_mbs.dynamics.system.System`."""
        vector = self._position_of >= 0
        q = np.abs(state[self._position_of[vector]])
        return float((np.spacing(q) / self._unit[vector]).max(initial=0.0))

    def state_scale(self, state: FloatArray) -> FloatArray:
        """min(|q|, unit) per coordinate (the unit itself on a group), then |v|.

        Angles are capped at 1 rad so that the accuracy does not decay with the number of turns.
        """
        if self._flat:
            out: FloatArray = np.minimum(np.abs(state), self._largest_scale)
            return out
        q, v = self.split(state)
        position = self._unit.copy()
        vector = self._position_of >= 0
        position[vector] = np.minimum(np.abs(q[self._position_of[vector]]), self._unit[vector])
        return np.concatenate([position, np.abs(v)])

    def step_limit(self, state: FloatArray) -> float:
        """Step over which no group joint turns by more than ``ROTATION_PER_STEP``."""
        v = state[self.nq :]
        speed = max((joint.rotation(v) for joint in self._groups), default=0.0)
        return ROTATION_PER_STEP / speed if speed > 0.0 else np.inf
