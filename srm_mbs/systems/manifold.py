"""The states of a mechanism, x = (q, v): moves on the configuration manifold, sizes and limits.

What depends on q alone through its joints belongs here; nothing here knows masses, forces or
closures.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import FloatArray, IndexArray
from srm_mbs.errors import EvaluationError
from srm_mbs.mechanism import Mechanism
from srm_mbs.systems.charts import (
    FARTHEST_NODE,
    LARGEST_ROTATION,
    ROTATION_PER_STEP,
    SERIES,
    GroupJoint,
    dexp_inverse,
    group_joints,
    planar_translation,
)


class Manifold:
    """The state space of ``mechanism``, as :class:`~srm_mbs.systems.base.System` asks for it."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        self.model = model = mechanism.model
        self.nq, self.nv = model.nq, model.nv
        self.tangent_size = 2 * self.nv
        self._groups: tuple[GroupJoint, ...] = mechanism.derived(
            "groups", lambda: group_joints(self.model)
        )
        self._flat = self.nq == self.nv
        self._unit = mechanism.structure.units.coordinate
        self._position_of: IndexArray = mechanism.derived("position_of", self._vector_coordinates)

    @cached_property
    def _caps(self) -> FloatArray:
        caps: FloatArray = self.mechanism.at_start(
            "caps", lambda: np.concatenate([self._unit, np.full(self.nv, np.inf)])
        )
        return caps

    @cached_property
    def _planar(self) -> tuple[GroupJoint, ...]:
        return tuple(joint for joint in self._groups if joint.group == "se2")

    @cached_property
    def _turning(self) -> IndexArray:
        """Velocity indices of the joints whose angle is (cos, sin)."""
        turning: IndexArray = self.mechanism.derived(
            "turning",
            lambda: np.array(
                [j.idx_v for j in list(self.model.joints)[1:] if (j.nq, j.nv) == (2, 1)], dtype=int
            ),
        )
        return turning

    def _vector_coordinates(self) -> IndexArray:
        """Index into q of each velocity component, -1 where q is not a vector space there."""
        index = np.full(self.nv, -1)
        for joint in list(self.model.joints)[1:]:
            if joint.nq == joint.nv:
                index[joint.idx_v : joint.idx_v + joint.nv] = range(
                    joint.idx_q, joint.idx_q + joint.nq
                )
        return index

    def chart_constants(self) -> dict[str, Any]:
        """What the compiled kernel needs to know of the manifold, independent of the start."""
        return {
            "position_of": [int(i) for i in self._position_of],
            "groups": [(j.group, j.start, j.size, j.position) for j in self._groups],
            "series": np.array(SERIES),
            "turning": [int(i) for i in self._turning],
            "largest_rotation": LARGEST_ROTATION,
            "farthest_node": FARTHEST_NODE,
            "rotation_per_step": ROTATION_PER_STEP,
        }

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
        :class:`~srm_mbs.systems.base.System`."""
        if not self._groups:
            return True
        moved = pin.difference(self.model, start[: self.nq], end[: self.nq])
        return all(joint.rotation(moved) <= FARTHEST_NODE for joint in self._groups)

    def difference(
        self, start: FloatArray, end: FloatArray, near: FloatArray | None = None
    ) -> FloatArray:
        """(q_end (-) q_start, v_end - v_start); see :class:`~srm_mbs.systems.base.System`."""
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
            turning = self._turning
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
        """(dv, 0); see :class:`~srm_mbs.systems.base.System`."""
        out: FloatArray = np.zeros(delta.shape)
        out[..., : self.nv] = delta[..., self.nv :]
        return out

    def size(self, delta: FloatArray) -> float:
        """max |dq| over units; see :class:`~srm_mbs.systems.base.System`."""
        return float((np.abs(delta[: self.nv]) / self._unit).max())

    def magnitudes(self, state: FloatArray) -> FloatArray:
        """min(|q|, unit) per coordinate (the unit itself on a group), then |v|.

        Angles are capped at 1 rad so that the accuracy does not decay with winding.
        """
        if self._flat:
            sizes: FloatArray = np.minimum(np.abs(state), self._caps)
            return sizes
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
