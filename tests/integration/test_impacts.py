"""Impacts against the equations of an impulse that closures take part in, solved as one system."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.dynamics.observables import Observables
from tests.support.backends import on_both
from tests.support.bundled import load


def after_impact(
    mechanism: srm.Mechanism, q: Any, v: Any, normal: Any, restitution: float
) -> np.ndarray:
    """Velocity after M (v' - v) = n mu + G^T lam, G (v' - v) = 0, n.(v' - v) = -(1 + e) n.v, with
    all rows of G, redundant ones too: the solution of least norm."""
    model, nv = mechanism.model, mechanism.model.nv
    M = np.triu(pin.crba(model, model.createData(), q))
    M += np.triu(M, 1).T
    G = Observables(make_system(mechanism)).jacobians(np.zeros(1), q[None])[0][:, :nv]
    n = np.asarray(normal)[:, None]
    across = np.column_stack([n, G.T])
    matrix = np.block([[M, -across], [across.T, np.zeros((across.shape[1],) * 2)]])
    right = np.zeros(len(matrix))
    right[nv] = -(1.0 + restitution) * float(np.asarray(normal) @ v)
    change: np.ndarray = np.linalg.lstsq(matrix, right, rcond=1e-12)[0][:nv]
    return np.asarray(v + change)


@pytest.mark.parametrize("name", ["five_bar", "delta_robot", "spatial_four_bar", "pendulum_chain"])
@on_both
def test_an_impact_is_that_of_the_equations_of_impulses(
    name: str, backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At several states one after the other, which share what the mechanism keeps."""
    monkeypatch.setenv("SRM_MBS_BACKEND", backend)
    mechanism = load(name)
    run = srm.simulate(mechanism, 0.3)
    random = np.random.default_rng(1)
    for t in (0.0, 0.1, 0.3, 0.2):
        q, v = run(t)
        normal = random.normal(size=mechanism.model.nv)
        found = srm.impact(mechanism, q, v, normal, 0.4)
        expected = after_impact(mechanism, q, v, normal, 0.4)
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_an_impact_calls_no_forces_of_the_user() -> None:
    """Impulses outdo all forces."""

    def never(t: float, q: Any, v: Any) -> Any:
        raise AssertionError("called")

    four_bar = load("four_bar")
    forces = (srm.UserForce(never, name="never"),)
    forced = srm.Mechanism(four_bar.model, four_bar.loops, four_bar.q0, four_bar.v0, forces)
    normal = np.eye(four_bar.model.nv)[0]
    found = srm.impact(forced, four_bar.q0, four_bar.v0, normal, 1.0)
    assert found == pytest.approx(-four_bar.v0, rel=1e-9)
