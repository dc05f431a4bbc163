"""The two index-2 test problems of the thesis, as it evaluates them."""

from __future__ import annotations

import numpy as np

import srm_mbs as srm
from tests.support import daes

UNIT = 0.01
"""Problem 1 is solved for x = UNIT t^p: it is linear, so that every error scales with it.  The
package stops a run whose constraint error passes 0.1 for states of order one, and those of one
sweep on the coarsest grids of the thesis are larger."""


def problem_one(p: int) -> srm.SemiExplicitDAE:
    """x' = -y, 0 = x - UNIT t^p on [0, 1]."""
    return srm.SemiExplicitDAE(
        f=lambda t, x: np.zeros(1),
        B=lambda t, x: np.ones(1),
        g=lambda t, x: x[0] - UNIT * t**p,
        G=lambda t, x: np.ones(1),
        g_t=lambda t, x: -UNIT * p * t ** (p - 1),
    )


def problem_two() -> srm.SemiExplicitDAE:
    """x = (exp(-t), sin t), y = exp(t)."""
    return daes.problem_two()


START_TWO = daes.START_TWO
