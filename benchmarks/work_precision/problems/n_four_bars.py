"""P3: the N-four-bar (IFToMM A02), singular when its cranks are horizontal."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

import srm_mbs as srm
from benchmarks.work_precision.problems.base import Array, Problem, ReducedModel
from benchmarks.work_precision.trees import tree_of
from tests.support import reduced

SPEED = 1.0  # m/s, the first crank tip in +x at the start


def n_four_bar(n: int, speed: float = SPEED) -> Problem:
    """The bundled n_four_bar_<n>, with any start speed (m/s)."""

    @cache
    def mechanism() -> srm.Mechanism:
        loaded = srm.load(f"n_four_bar_{n}")
        return loaded if speed == SPEED else loaded.with_state(loaded.q0, loaded.v0 * speed)

    def cranks(q: Array, v: Array) -> Array:
        """Angles and rates (n, 2 (N + 1)) of all cranks: on a wrong branch they differ."""
        model = mechanism().model
        joints = [model.joints[model.getJointId(f"crank_{i}")] for i in range(n + 1)]
        columns = [joint.idx_q for joint in joints]  # of hinges only: idx_v as well
        return np.hstack([q[:, columns], v[:, columns]])

    return Problem(
        f"n_four_bar_{n}",
        f"P3: N-four-bar, N = {n}, through singular configurations, 10 s",
        10.0,
        mechanism,
        lambda: tree_of(mechanism(), rows=(0, 2)),
        cranks,
        rates=n + 1,
        reduced=ReducedModel(reduced.n_four_bar(n), (math.pi / 2.0, -speed)),
        expand=lambda observed: np.repeat(observed, n + 1, axis=1),
        singular=True,
        planar=(0, 2),
    )
