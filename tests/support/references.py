"""Motions of bundled mechanisms by SciPy, sampled over a run; none uses the package's stepping."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support import reduced
from tests.support.bundled import load


def _open_chain(mechanism: srm.Mechanism) -> reduced.Field:
    model, data = mechanism.model, mechanism.model.createData()
    nq = model.nq

    def field(t: float, x: Any) -> np.ndarray:
        q, v = x[:nq], x[nq:]
        return np.concatenate([v, pin.aba(model, data, q, v, -model.damping * v)])

    return field


def observed(name: str, solution: srm.Solution, t: np.ndarray) -> np.ndarray:
    """The quantities of :func:`reference` in a run: angle and rate of the crank, or the state."""
    q, v = solution(t)
    if name in ("four_bar", "spatial_four_bar", "pendulum_chain"):
        return np.hstack([q, v])
    crank = 0 if name.startswith("n_four_bar") else solution.mechanism.joint("crank").idx_q
    angle = q[:, crank]
    return np.column_stack([angle - np.pi / 6 if name == "spatial_dead_point" else angle, v[:, 0]])


@lru_cache(maxsize=32)
def reference(name: str, t_end: float, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Times (samples,) and what is observed there: reduced equations, or the index-1 equations of
    regular mechanisms, by DOP853 near round-off."""
    mechanism = srm.load(name)
    t = np.linspace(0.0, t_end, samples + 1)[1:]
    start = np.array([mechanism.q0[0], mechanism.v0[0]])
    if name in ("slider_crank", "slider_crank_whirl"):
        field = reduced.slider_crank()
    elif name == "parallelogram":
        field = reduced.parallelogram()
    elif name == "spatial_dead_point":
        field, start = reduced.spatial_dead_point(), start - np.array([np.pi / 6, 0.0])
    elif name.startswith("n_four_bar"):
        field = reduced.n_four_bar(int(name.rsplit("_", 1)[1]))
    else:
        start = np.concatenate([mechanism.q0, mechanism.v0])
        closed = bool(mechanism.loops)
        field = reduced.index_one(mechanism) if closed else _open_chain(mechanism)
    run = solve_ivp(field, (0.0, t_end), start, "DOP853", t, rtol=3e-14, atol=1e-14)
    assert run.success
    return t, run.y.T


def error_across(name: str, around: float, **options: Any) -> tuple[float, srm.Solution]:
    """Largest error of q ``around`` (s) after the first singular passage of a bundled mechanism, of
    a run with ``options`` from as long before it; and that run."""
    mechanism = load(name)
    t = srm.simulate(mechanism, 1.5, rtol=1e-8).crossings[0].time
    before = srm.simulate(mechanism, t - around, rtol=1e-12)
    start = mechanism.with_state(before.q[-1], before.v[-1])
    times = {"t0": t - around, "t_eval": [t + around]}
    exact = srm.simulate(start, t + around, rtol=1e-12, **times)
    run = srm.simulate(start, t + around, **options, **times)
    assert run.success, run.message
    assert len(run.crossings) == 1
    return float(np.abs(run.q[-1] - exact.q[-1]).max()), run
