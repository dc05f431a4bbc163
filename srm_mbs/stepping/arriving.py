"""Ends beside a singular configuration.

A step that ends there has stages so near that rounding in their direct solves exceeds the
tolerance; their multipliers cannot be predicted from the steps before either, which are too long.
So the multiplier is found first, by collocation from well before up to the end, as for a motion
that leaves a singular configuration (:mod:`srm_mbs.stepping.leaving`): at nodes from which all
stages take it interpolated, the last ones solved on the branch of the motion.  Nothing is evaluated
behind the end.
"""

from __future__ import annotations

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.errors import EvaluationError
from srm_mbs.methods.base import ErrorNorm, Memory
from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.stepping.leaving import AHEAD, Point, block_of
from srm_mbs.stepping.placement import BESIDE
from srm_mbs.systems.closure_geometry import ClosureGeometry
from srm_mbs.systems.driven_geometry import geometry_of
from srm_mbs.systems.multibody import ClosedSystem, OpenSystem

BLOCKS = (1, 2, 4)
"""Blocks of nodes up to the end: as many as the tolerance asks for, the best of them where rounding
is in the way."""
SUFFICES, LARGEST = 0.1, 10.0
"""Error of interpolating the multiplier, over the tolerance, that is no matter, and the largest."""
ABOVE = 2.0
"""What is known holds below this multiple of the largest sigma at the nodes: a step that mixes
known and solved multipliers loses its order."""


def arrive(
    system: OpenSystem | ClosedSystem,
    t: float,
    state: FloatArray,
    memory: Memory,
    norm: ErrorNorm,
    end: float,
) -> Memory:
    """``memory`` at ``t`` (s), with the multipliers known up to ``end``, of the run or its piece.

    Unchanged where they cannot be found: the steps are then made as everywhere else.
    """
    if not isinstance(system, ClosedSystem) or memory.history is None:
        return memory
    geometry = geometry_of(system.mechanism, system.split(state)[0], t)
    try:
        multiplier = system.evaluate(t, state).multiplier().copy()
        here = Point(state, memory.rate, multiplier, memory.sigma)
        best = LARGEST
        for blocks in BLOCKS:
            history = _known(system, geometry, t, here, norm, end, blocks)
            if history is None:
                continue
            error = _error(history, memory, norm, end - t)
            if error < best:
                best, memory.history = error, history
            if error < SUFFICES:
                break
    except (EvaluationError, np.linalg.LinAlgError):
        # A step will meet it, too, and say so; or the search has left all numbers.
        pass
    return memory


def _known(
    system: ClosedSystem,
    geometry: ClosureGeometry,
    t: float,
    here: Point,
    norm: ErrorNorm,
    end: float,
    blocks: int,
) -> MultiplierHistory | None:
    times = np.linspace(t, end, blocks * AHEAD + 1)
    points = [here]
    for k in range(blocks):
        nodes = times[k * AHEAD : (k + 1) * AHEAD + 1]
        block = block_of(system, geometry, points[-1], nodes, norm, BESIDE, foreseen=True)
        if block is None:
            return None
        points += block[1:]
    return MultiplierHistory(
        times,
        np.array([point.multiplier for point in points]),
        # A step to the end may end a rounding behind it.
        known_until=end + 4.0 * float(np.spacing(abs(end))),
        known_below=ABOVE * max(point.sigma for point in points),
    )


def _error(history: MultiplierHistory, memory: Memory, norm: ErrorNorm, span: float) -> float:
    """Error of interpolating between the nodes over ``span`` (s), over the tolerance."""
    nv = history.values.shape[1]
    error = np.zeros(2 * nv)
    for a, b in ((0, 1), (-2, -1)):
        between = 0.5 * float(history.times[a] + history.times[b])
        error[nv:] = np.maximum(error[nv:], span * history.uncertainty(between))
    return norm(error, norm.weights(memory.magnitude))
