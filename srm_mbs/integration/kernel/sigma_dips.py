"""Minima of the recorded sigma that may be passages, by the compiled kernel."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from srm_mbs._kernel import core
from srm_mbs.integration import singular_passages
from srm_mbs.integration.dense_output import StepData
from srm_mbs.integration.methods.butcher import ButcherTableau
from srm_mbs.integration.singular_passages import RecordedDips


@lru_cache(maxsize=64)
def _dip_search(scheme: ButcherTableau) -> Any:
    """``DipSearch`` of sigma_dips.hpp for the steps of ``scheme`` that are not stiff."""
    own = scheme.member(False)
    return core.DipSearch(  # type: ignore[union-attr]
        columns=own.distinct.tolist(),
        abscissae=own.abscissae[own.distinct],
        around=scheme.n_stages,
        slope_margin=singular_passages.SLOPE_MARGIN,
        vanishing=singular_passages.VANISHING_SIGMA,
        lingering=singular_passages.LINGERING_SIGMA,
        departed=singular_passages.DEPARTED_VALUE,
        least_departed=singular_passages.LEAST_DEPARTED,
        depth=singular_passages.RECORDED_DEPTH,
    )


def recorded_dips(scheme: ButcherTableau, steps: StepData) -> RecordedDips | None:
    """As :func:`srm_mbs.integration.singular_passages.recorded_dips`; that itself for steps of two
    schemes."""
    if np.logical_or.reduce(steps.stiff):
        return singular_passages.recorded_dips(scheme, steps)
    found: RecordedDips | None = core.recorded_dips(  # type: ignore[union-attr]
        _dip_search(scheme), steps.times, steps.sigmas, steps.end
    )
    return found
