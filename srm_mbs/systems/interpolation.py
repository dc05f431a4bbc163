"""Polynomial interpolation through given times."""

from __future__ import annotations

import numpy as np

from srm_mbs.arrays import FloatArray


def lagrange_weights(nodes: FloatArray, t: float) -> FloatArray:
    """Weights (k,) of the polynomial through ``nodes`` (k,), distinct times, at ``t``."""
    k = len(nodes)
    weights = np.ones(k)
    for i in range(k):
        for j in range(k):
            if i != j:
                weights[i] *= (t - nodes[j]) / (nodes[i] - nodes[j])
    return weights
