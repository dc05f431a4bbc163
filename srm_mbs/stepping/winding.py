"""Angles of joints that turn without end, followed through the steps of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from srm_mbs.arrays import FloatArray
from srm_mbs.methods.butcher import ButcherTableau
from srm_mbs.stepping.dense import StepData


def wound_angles(
    joint: Any, nq: int, steps: StepData, scheme: ButcherTableau, t: FloatArray, states: FloatArray
) -> FloatArray:
    """Angle (n,) rad of a (cos, sin) joint at ``t``, followed through every step of the run.

    Parameters
    ----------
    joint
        Pinocchio's joint model.
    nq
        Length of a configuration: the rates follow it in a state.
    steps, scheme
        The steps of the run, and the scheme that made them.
    t : (n,) s, states : (n, nq + nv)
        Times within the run, and the states there.
    """
    cos, sin = joint.idx_q, joint.idx_q + 1
    nodes = steps.states
    rate = nq + joint.idx_v
    principal = np.arctan2(nodes[:, sin], nodes[:, cos])
    # A long step may turn the joint by more than pi: its chart coordinate knows by how much.
    h = np.diff(steps.times)
    weights = np.append(scheme.b, 0.0)
    turned = h * (steps.rates[:, : len(weights), joint.idx_v] @ weights)
    wound = np.concatenate([[principal[0]], principal[0] + np.cumsum(turned)])
    wound = principal + 2.0 * np.pi * np.round((wound - principal) / (2.0 * np.pi))
    # Between nodes: the step's start plus the principal difference nearest to v dt.
    index = np.clip(np.searchsorted(steps.times, t, side="right") - 1, 0, len(nodes) - 1)
    here = np.arctan2(states[:, sin], states[:, cos])
    mean = 0.5 * (nodes[index, rate] + states[:, rate])
    guess = wound[index] + mean * (t - steps.times[index])
    out: FloatArray = here + 2.0 * np.pi * np.round((guess - here) / (2.0 * np.pi))
    return out
