"""Joint rows of closures: linear relations of joint coordinates, g = sum c_i q_i - s."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from srm_mbs.arrays import BoolArray, FloatArray
from srm_mbs.loop_closure import LoopClosure


class JointRows:
    """The kept, scaled joint rows of one closure.

    Attributes
    ----------
    G : (count, nv)
        Their constant Jacobian.
    first_row, count
        Where they stand among the rows of the mechanism.
    support : (nv,)
        0: the world Jacobian has no part in them.
    """

    def __init__(
        self, model: pin.Model, loop: LoopClosure, scale: FloatArray, keep: BoolArray, start: int
    ) -> None:
        kept = [(row, float(s)) for row, s, k in zip(loop.rows.joint_rows, 1.0 / scale, keep) if k]
        self.first_row, self.count = start, len(kept)
        self.support = np.zeros(model.nv)
        self.G = np.zeros((self.count, model.nv))
        # (c_i, place of q_i in q, in v) of each joint, and the offset, over the row scale.
        self._terms: list[tuple[list[tuple[float, int, int]], float]] = []
        for own, (row, factor) in zip(self.G, kept):
            terms = []
            for c, name in zip(row.coefficients, row.joints):
                joint = model.joints[model.getJointId(name)]
                terms.append((factor * c, int(joint.idx_q), int(joint.idx_v)))
                own[joint.idx_v] = factor * c
            self._terms.append((terms, factor * row.offset))

    def constants(self) -> list[dict[str, Any]]:
        """What the compiled kernel needs of each row."""
        return [
            {
                "row": self.first_row + i,
                "coefficients": np.array([c for c, _, _ in terms]),
                "in_q": [k for _, k, _ in terms],
                "in_v": [k for _, _, k in terms],
                "offset": offset,
            }
            for i, (terms, offset) in enumerate(self._terms)
        ]

    def bind(self, data: pin.Data) -> None:
        """Nothing of ``data`` enters."""

    def evaluate(self, q: FloatArray, with_bias: bool, out: list[float]) -> None:
        """Append for each row six zeros for G, which is set apart, then g, then Gdot v = 0."""
        for terms, offset in self._terms:
            g = -offset
            for c, k, _ in terms:
                g += c * q[k]
            out += 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, g, 0.0
