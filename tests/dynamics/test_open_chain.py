"""Without loops: plain Runge-Kutta on aba, and no constraint algebra."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.constraints import projection


def runge_kutta(
    mechanism: srm.Mechanism, tableau: str, step: float, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Textbook explicit Runge-Kutta on pin.aba for flat coordinates."""
    model, scheme = mechanism.model, srm.TABLEAUS[tableau]
    data = model.createData()
    q, v = np.array(mechanism.q0), np.array(mechanism.v0)
    for _ in range(count):
        kq, kv = [], []
        for a in scheme.A:
            qi = q + step * sum((x * k for x, k in zip(a, kq)), np.zeros(model.nv))
            vi = v + step * sum((x * k for x, k in zip(a, kv)), np.zeros(model.nv))
            kq.append(vi)
            kv.append(pin.aba(model, data, qi, vi, -model.damping * vi).copy())
        q = q + step * sum(x * k for x, k in zip(scheme.b, kq))
        v = v + step * sum(x * k for x, k in zip(scheme.b, kv))
    return q, v


@pytest.mark.parametrize("tableau", ["fe", "trap", "heun", "tvd32", "erk4", "dopr54", "dop853"])
def test_an_open_chain_is_integrated_exactly_as_runge_kutta_on_aba(tableau: str) -> None:
    mechanism = srm.load("pendulum_chain")
    solution = srm.simulate(mechanism, 1.0, tableau=tableau, step=0.02)
    q, v = runge_kutta(mechanism, tableau, 0.02, 50)
    assert np.abs(solution.q[-1] - q).max() < 1e-12
    assert np.abs(solution.v[-1] - v).max() < 1e-12


def test_an_open_chain_runs_no_constraint_algebra(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("constraint algebra on an open chain")

    for name in ("cholesky", "pivoted_qr", "whiten", "unwhiten"):
        monkeypatch.setattr(projection, name, refuse)
    monkeypatch.setattr(projection.Projection, "factor", refuse)
    solution = srm.simulate(srm.load("pendulum_chain"), 2.0)
    assert solution.success
    assert solution.stats.factorisations == 0
    assert solution.stats.placements == 0
    assert np.array_equal(solution.drift, np.zeros((len(solution.t), 2)))


def test_the_counter_counts_where_there_are_loops() -> None:
    solution = srm.simulate(srm.load("four_bar"), 0.5)
    assert solution.stats.factorisations == solution.stats.evaluations > 0


def test_energy_of_an_open_chain_is_kept_to_the_tolerance() -> None:
    solution = srm.simulate(srm.load("pendulum_chain"), 10.0, rtol=1e-9)
    assert np.abs(solution.energy - solution.energy[0]).max() < 1e-6
