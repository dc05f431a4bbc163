"""Angles of joints that turn without end, followed through the steps of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from srm_mbs.arrays import FloatArray, IndexArray
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
    nodes, cos, sin = steps.states, joint.idx_q, joint.idx_q + 1
    principal = np.arctan2(nodes[:, sin], nodes[:, cos])
    here = np.arctan2(states[:, sin], states[:, cos])
    if not steps.count:
        return here
    # A long step may turn the joint by more than pi: its chart coordinate knows by how much.
    h = np.diff(steps.times)
    turned = h * (steps.rates[:, : scheme.n_stages, joint.idx_v] @ scheme.b)
    wound = principal[0] + np.concatenate([[0.0], np.cumsum(turned)])
    wound = _nearest_turn(principal, wound)
    step = np.clip(np.searchsorted(steps.times, t, side="right") - 1, 0, steps.count - 1)
    theta = (t - steps.times[step]) / h[step]
    return _nearest_turn(here, _between(wound, nq, joint.idx_v, steps, step, theta))


def _nearest_turn(principal: FloatArray, guess: FloatArray) -> FloatArray:
    out: FloatArray = principal + 2.0 * np.pi * np.round((guess - principal) / (2.0 * np.pi))
    return out


def _between(
    wound: FloatArray, nq: int, k: int, steps: StepData, step: IndexArray, theta: FloatArray
) -> FloatArray:
    """The angle (n,) at the fractions ``theta`` (n,) of the steps ``step`` (n,), by the polynomial
    of degree 5 through the angle ``wound``, rate v_k and its derivative at both ends of a step."""
    h, rate = np.diff(steps.times), steps.states[:, nq + k]
    place = steps.rates.shape[2] // 2 + k
    starts = steps.rates[:, 0, place]
    ends = np.append(starts[1:], steps.end_rate[place])
    if len(steps.breaks):
        ends[steps.breaks - 1] = steps.break_rates[:, place]
    v0, v1 = (h * rate[:-1])[step], (h * rate[1:])[step]
    a0, a1 = (h**2 * starts)[step], (h**2 * ends)[step]
    start, gain = wound[step], np.diff(wound)[step]
    # What is left of the cubic terms after the Taylor polynomial at the start.
    p = gain - v0 - 0.5 * a0
    v = v1 - v0 - a0
    a = a1 - a0
    bend = 10.0 * p - 4.0 * v + 0.5 * a + theta * (-15.0 * p + 7.0 * v - a)
    bend += theta**2 * (6.0 * p - 3.0 * v + 0.5 * a)
    out: FloatArray = start + theta * (v0 + theta * (0.5 * a0 + theta * bend))
    return out
