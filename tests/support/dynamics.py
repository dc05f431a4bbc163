"""Mass matrices, forces and closures of models, for comparison at random states."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints.rows import LoopKinematics


def states(model: pin.Model, count: int = 4, seed: int = 0) -> Iterator[tuple[FloatArray, ...]]:
    """``count`` random q (nq,) and v (nv,)."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.5, 1.5, model.nv))
        yield q, rng.standard_normal(model.nv)


def states_around(mechanism: srm.Mechanism, count: int) -> list[tuple[FloatArray, FloatArray]]:
    """``count`` random q (nq,), up to 1 (rad, m) from q0 in each direction, and v (nv,) up to 2."""
    model, rng = mechanism.model, np.random.default_rng(8)
    return [
        (pin.integrate(model, mechanism.q0, rng.uniform(-1, 1, nv)), rng.uniform(-2, 2, nv))
        for nv in [model.nv] * count
    ]


def mass_matrix(model: pin.Model, q: FloatArray) -> FloatArray:
    """M (nv, nv), both triangles."""
    M = pin.crba(model, model.createData(), q)
    return np.triu(M) + np.triu(M, 1).T


def nonlinear_effects(model: pin.Model, q: FloatArray, v: FloatArray) -> FloatArray:
    """Gravity, Coriolis and centrifugal forces (nv,)."""
    return pin.nonLinearEffects(model, model.createData(), q, v)


def assert_same_dynamics(
    ours: pin.Model, theirs: pin.Model, count: int = 4, atol: float = 1e-12, rtol: float = 1e-7
) -> None:
    """Equal nonlinear effects at random states, and mass matrices, to a hundredth of ``atol``."""
    for q, v in states(theirs, count):
        np.testing.assert_allclose(
            mass_matrix(ours, q), mass_matrix(theirs, q), rtol=rtol, atol=0.01 * atol
        )
        np.testing.assert_allclose(
            nonlinear_effects(ours, q, v), nonlinear_effects(theirs, q, v), rtol=rtol, atol=atol
        )


def evaluate_rows(
    model: pin.Model, rows: LoopKinematics, q: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """g (m,), G (m, nv) and Gdot v (m,) at (q, v)."""
    data = model.createData()
    pin.crba(model, data, q, pin.Convention.WORLD)
    pin.nonLinearEffects(model, data, q, v)
    rows.update(data, q, v)
    return rows.g.copy(), rows.G.copy(), rows.bias.copy()


def closure(mechanism: srm.Mechanism, q: FloatArray, v: FloatArray) -> FloatArray:
    """[g, G v, Gdot v] of all rows."""
    rows = LoopKinematics(mechanism.model, mechanism.loops)
    g, G, bias = evaluate_rows(mechanism.model, rows, q, v)
    return np.concatenate([g, G @ v, bias])


def closure_rows(mechanism: srm.Mechanism, q: FloatArray) -> FloatArray:
    """The Jacobian G (m, nv) of all rows at a closed configuration q."""
    model = mechanism.model
    rows = LoopKinematics(model, mechanism.loops)
    g, G, _ = evaluate_rows(model, rows, q, np.zeros(model.nv))
    np.testing.assert_allclose(g, 0.0, atol=1e-10)
    return G


def check_same_span(ours: FloatArray, theirs: FloatArray) -> None:
    """The rows of both matrices span the same space."""
    spaces = []
    for rows in (ours, theirs):
        _, sizes, directions = np.linalg.svd(rows)
        basis = directions[: (sizes > 1e-7 * sizes[0]).sum()]
        spaces.append(basis.T @ basis)
    np.testing.assert_allclose(spaces[0], spaces[1], atol=1e-7)
