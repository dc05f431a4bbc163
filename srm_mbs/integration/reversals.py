r"""Where a rate with friction turns back: steps end beside the layer of rates they do not resolve.

Friction -F tanh(v / v_s) changes its sign within a few v_s.  Stages on both sides of that layer see
a jump of the acceleration, of which an embedded pair, which takes the motion for smooth, finds a
part by chance only: a quadrature with the nodes c_j and weights b_j across a jump at c errs by
sum(b_j, c_j > c) - (1 - c) of the jump times the step, up to 4.2 for dop853.  So a step that would
lead over the layer ends just before it, and the next one on its other side.  Stages of a long step
to that end lie on the other side by their own error; then the step ends earlier, and a short one
leads up to the layer.
"""

from __future__ import annotations

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, StepResult

LAYER = 6.0
"""Rate, in friction speeds, from which the friction is full but for 1e-5 of it."""
LANDING = 2.0
"""Rate, in layers, up to which a step ends that is to end beside one."""
APPROACHED = 0.1
"""Rate with which a step ends, over the one it begins with, whose stages lead over the layer."""
UNRESOLVED = 4.0
"""Change of a rate, in layers, from which a step does not resolve the layer that it leads over."""


class ReversalSearch:
    """Looks for rates with friction, of joints and sums of joints, that turn back in a step.

    Parameters
    ----------
    system, norm
        Of the run.
    """

    def __init__(self, system: System, norm: ErrorNorm) -> None:
        self._norm = norm
        self._k = system.multiplier_part.start
        self._sums, self._layer = system.friction_sums, LAYER * system.friction_speed

    def late(self, memory: IntegratorState, result: StepResult) -> float:
        """Time (s) by which the step ``result`` from ``memory`` leads too far over a layer: 0 where
        it ends beside that, negative before it, -infinity where nothing turns back."""
        k, sums = self._k, self._sums
        if not len(sums):
            return -np.inf
        weights = self._norm.weights(np.maximum(memory.state_scale, result.state_scale))[k:]
        befores, afters = sums @ memory.rate[:k], sums @ result.end_rate[:k]
        stages, tolerances = result.rates[:-1, :k] @ sums.T, np.abs(sums) @ weights
        return max(
            late_past_layer(result.h, before, after, of_stages, self._layer, tolerance)
            for before, after, of_stages, tolerance in zip(
                befores.tolist(), afters.tolist(), stages.T, tolerances.tolist()
            )
        )


def late_past_layer(
    h: float, before: float, after: float, stages: FloatArray, layer: float, tolerance: float
) -> float:
    """Time (s) by which a rate that changes from ``before`` to ``after`` in ``h`` (s) comes too
    far; see :meth:`ReversalSearch.late`.

    Parameters
    ----------
    stages : (s,)
        The rate at the stages.
    layer
        Rate from which the friction is full.
    tolerance
        Changes of the rate up to it do not matter.
    """
    far = LANDING * layer
    target = 0.5 * (layer + far)
    leaves = abs(before) < layer or (abs(before) <= far and before * after < 0.0)
    side = np.copysign(1.0, after if leaves else before)
    start, end = side * before, side * after
    unresolved = abs(end - start) > max(UNRESOLVED * layer, tolerance)
    if leaves:
        if layer <= end <= far:
            return 0.0
        return h * (end - target) / (end - start) if end > far and unresolved else -np.inf
    if not (start > far and end < start):
        return -np.inf
    near = APPROACHED * start
    if layer <= end <= max(far, 2.0 * near):
        over = max(far, end) < 0.5 * near and float((side * stages).min()) < layer
        return h * (near - end) / (start - end) if over else 0.0
    return h * (target - end) / (start - end) if end > far or unresolved else -np.inf
