"""Long runs with a fixed step, of which only samples are kept."""

from __future__ import annotations

import numpy as np

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.integration.control.step_size import FixedStep
from srm_mbs.integration.driver import integrate
from srm_mbs.integration.methods.base import ErrorNorm, Method

CHUNK = 1000
"""Steps recorded at a time."""


def fixed_step_run(
    system: System, method: Method, state: FloatArray, t_end: float, step: float, every: int
) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and states (n, nx) at the start and after every ``every`` steps.

    Ends early where the run cannot go on.
    """
    norm = ErrorNorm(np.ones(system.tangent_size), 1.0)
    memory = method.start(system, 0.0, state, norm)
    times, states = [0.0], [state]
    count = round(t_end / step)
    for first in range(0, count, CHUNK):
        t0, t1 = first * step, min(count, first + CHUNK) * step
        record = integrate(system, method, FixedStep(t0, t1, step), norm, memory, state, t0, t1)
        kept = slice(every - 1, None, every)
        times += record.times[kept]
        states += [made.state for made in record.steps[kept]]
        if record.status != "finished":
            break
        state = record.steps[-1].state
    return np.array(times), np.array(states)
