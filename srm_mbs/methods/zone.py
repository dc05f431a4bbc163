"""When the multiplier of a stage is predicted, because a singular configuration is too near."""

from __future__ import annotations

from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.systems.base import Zone

ZONE_FLOOR = 1e-3
"""Smallest sigma_z; smaller values failed at tight tolerances."""
ZONE_PER_STEP = 0.05
"""sigma_z as a fraction of the change of sigma over the step."""
COUNT_UNCERTAINTY_ABOVE = 5 * ZONE_FLOOR
"""h * slope of sigma from which the uncertainty of the predicted multiplier counts as error;
counting it always would trap the step-size control next to the singular configuration."""


def zone_of(history: MultiplierHistory | None, sigma_change: float, end: float) -> Zone | None:
    """The zone of a step to the time ``end`` in which sigma changes by ``sigma_change``.

    None without a history.
    """
    if history is None:
        return None
    known = history.known_below if end <= history.known_until else 0.0
    return Zone(max(ZONE_FLOOR, ZONE_PER_STEP * sigma_change, known), history.predict)
