"""When the multiplier of a stage is predicted, because a singular configuration is too near."""

from __future__ import annotations

from srm_mbs.methods.history import MultiplierHistory
from srm_mbs.systems.base import Zone

ZONE_LARGEST = 1e-3
"""Largest sigma_z: the zone starts here where rounding exceeds the tolerance, or there is none
(fixed steps), and later otherwise (:meth:`~srm_mbs.methods.branch.BranchStages.known_from`)."""
COUNT_UNCERTAINTY_ABOVE = 5 * ZONE_LARGEST
"""h * slope of sigma from which the uncertainty of the predicted multiplier counts as error;
counting it always would trap the step-size control next to the singular configuration."""


HIT = 1e-6
"""sigma that is a direct hit, for which anything predicted is better."""
FEWEST = 3
"""Nodes of the history from which a prediction is better than the direct solve."""


def zone_from(history: MultiplierHistory | None, threshold: float, end: float) -> Zone | None:
    """The zone sigma < ``threshold`` of a step to the time ``end``.

    None without nodes; only for direct hits while they are few.
    """
    if history is None or not history.begun:
        return None
    known = history.known_below if end <= history.known_until else 0.0
    if len(history.times) < FEWEST:
        threshold = min(threshold, HIT)
    return Zone(max(threshold, known), history.predict_near, history.normals)
