"""Linearly implicit steps through singular configurations, against the equation of one freedom.

On their branches the parallelogram and the slider-crank with equal bars have q = q0 + w phi with
constant w: w.M w phi'' = w.(tau - nle), M and nle of the open tree from Pinocchio.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

import srm_mbs as srm
from tests.support.backends import slowly_on_both

BRANCHES = {"parallelogram": (1.0, -1.0, 1.0), "slider_crank": (1.0, -2.0)}
SPEED = 1e-3  # of friction, rad/s


def with_joint_forces(
    name: str, damping: tuple[float, ...], friction: tuple[float, ...]
) -> srm.Mechanism:
    mechanism = srm.load(name)
    model = mechanism.model.copy()
    model.damping, model.upperDryFrictionLimit = np.array(damping), np.array(friction)
    model.lowerDryFrictionLimit = -np.array(friction)
    return replace(mechanism, model=model, friction_speed=SPEED)


def motion(mechanism: srm.Mechanism, w: np.ndarray, rate: float, t_end: float) -> np.ndarray:
    """q at ``t_end`` from q0 with the rates ``rate`` w."""
    model = mechanism.model
    data, friction = model.createData(), model.upperDryFrictionLimit

    def equation(t: float, y: np.ndarray) -> list[float]:
        q, v = mechanism.q0 + y[0] * w, y[1] * w
        mass = np.triu(pin.crba(model, data, q))
        bias = pin.rnea(model, data, q, v, 0.0 * w)
        tau = -model.damping * v - friction * np.tanh(v / SPEED)
        inertia = w @ (mass + np.triu(mass, 1).T) @ w
        return [y[1], w @ (tau - bias) / inertia]

    run = solve_ivp(equation, (0.0, t_end), [0.0, rate], method="Radau", rtol=1e-10, atol=1e-12)
    return np.asarray(mechanism.q0 + run.y[0, -1] * w)


@slowly_on_both
@pytest.mark.parametrize("name", list(BRANCHES))
@pytest.mark.parametrize("rtol", [1e-6, 1e-8, 1e-9])
def test_implicit_steps_pass_singular_configurations_within_the_tolerance(
    name: str, rtol: float, backend: str
) -> None:
    w = np.array(BRANCHES[name])
    mechanism = with_joint_forces(name, (0.0,) * len(w), (0.0,) * len(w))
    run = srm.simulate(mechanism, 1.3, v0=6.0 * w, rtol=rtol, tableau="rodas5p", backend=backend)
    assert run.success, run.message
    assert len(run.crossings) >= 2
    assert np.abs(run.q[-1] - motion(mechanism, w, 6.0, 1.3)).max() < 30.0 * rtol
    assert run.stats.rejected < 0.5 * run.stats.steps


@slowly_on_both
@pytest.mark.parametrize("tableau", ["auto", "rodas5p"])
@pytest.mark.parametrize(
    ("name", "damping", "friction"),
    [
        ("parallelogram", (0.0, 8.0, 0.0), (0.0, 0.0, 0.0)),
        ("parallelogram", (0.0, 0.0, 0.0), (0.07, 0.0, 0.07)),
        ("slider_crank", (0.0, 0.6), (0.0, 0.3)),
    ],
)
def test_damped_motions_pass_singular_configurations(
    name: str, damping: tuple[float, ...], friction: tuple[float, ...], tableau: str, backend: str
) -> None:
    w = np.array(BRANCHES[name])
    mechanism = with_joint_forces(name, damping, friction)
    run = srm.simulate(mechanism, 1.0, v0=9.0 * w, rtol=1e-8, tableau=tableau, backend=backend)
    assert run.success, run.message
    assert len(run.crossings) >= 1
    assert np.abs(run.q[-1] - motion(mechanism, w, 9.0, 1.0)).max() < 1e-6


@slowly_on_both
@pytest.mark.parametrize("rtol", [1e-6, 1e-8])
def test_implicit_steps_keep_the_energy_through_a_spatial_dead_point(
    rtol: float, backend: str
) -> None:
    mechanism = srm.load("spatial_dead_point")
    run = srm.simulate(mechanism, 1.0, rtol=rtol, tableau="rodas5p", backend=backend)
    assert run.success, run.message
    assert len(run.crossings) == 1
    data = mechanism.model.createData()
    energies = [
        pin.computeMechanicalEnergy(mechanism.model, data, q, v) for q, v in zip(run.q, run.v)
    ]
    assert np.ptp(energies) < 100.0 * rtol * abs(pin.computeKineticEnergy(mechanism.model, data))
