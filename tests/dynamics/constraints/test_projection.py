"""The constraint algebra: exact identities, redundancy, and accuracy next to singular points."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics import manifold, multibody
from srm_mbs.dynamics.constraints.projection import (
    PIVOT_ZERO,
    Projection,
    cholesky,
    pivoted_qr,
    symmetric,
)
from srm_mbs.dynamics.forces import ForceKinematics
from srm_mbs.dynamics.multibody import ClosedSystem, OpenSystem, make_system
from srm_mbs.dynamics.system import Zone
from srm_mbs.errors import EvaluationError
from tests.support.bundled import load
from tests.support.mechanisms import ANCHORED_MODELS, CLOSED_MODELS, INDEPENDENT_MODELS, add_link

assert_close = partial(np.testing.assert_allclose, rtol=0.0)

SIZES = ((1, 1), (2, 1), (5, 3), (6, 6), (12, 4), (30, 20))
G = 9.81


every_size = pytest.mark.parametrize("size", SIZES, ids=str)
every_closed_model = pytest.mark.parametrize("name", CLOSED_MODELS)
every_independent_model = pytest.mark.parametrize("name", INDEPENDENT_MODELS)


class Problem:
    """A random regular M (nv, nv), G (m, nv), f (nv,), bias (m,)."""

    def __init__(self, nv: int, m: int, seed: int = 0) -> None:
        rng = np.random.default_rng([nv, m, seed])
        A = rng.standard_normal((nv, nv))
        self.M = A @ A.T + 0.1 * np.eye(nv)
        self.G = rng.standard_normal((m, nv))
        self.f = rng.standard_normal(nv)
        self.bias = rng.standard_normal(m)
        self.rng = rng

    def factor(self, rank: int | None = None, threshold: float | None = None) -> Projection:
        projection = Projection(len(self.G) if rank is None else rank, 1.0)
        projection.factor(self.M, self.G, self.f, self.bias, threshold)
        return projection

    def dependent(self, combinations: FloatArray) -> Problem:
        """The same problem with further rows that are ``combinations`` (k, m) of its own."""
        new = Problem.__new__(Problem)
        new.M, new.f, new.rng = self.M, self.f, self.rng
        order = self.rng.permutation(len(self.G) + len(combinations))
        new.G = np.vstack([self.G, combinations @ self.G])[order]
        new.bias = np.concatenate([self.bias, combinations @ self.bias])[order]
        return new


def matrices(p: Projection, m: int) -> tuple[FloatArray, FloatArray]:
    """E (nv, m) and P (nv, nv) as dense matrices; rows outside the rank have no column in E."""
    nv = len(p.U)
    E = np.array([p.unwhiten(p.normal(row)) for row in np.eye(m)]).T
    P = np.array([p.project(w) for w in np.eye(nv)]).T
    return E, P


def yhat(p: Projection) -> FloatArray:
    return p.unwhiten(p.white_multiplier)


def dense_yhat(M: FloatArray, G: FloatArray, f: FloatArray, bias: FloatArray) -> FloatArray:
    """M^-1 f minus the acceleration of the dense saddle-point system, G of full rank."""
    m, nv = G.shape
    saddle = np.block([[M, G.T], [G, np.zeros((m, m))]])
    a = np.linalg.solve(saddle, np.concatenate([f, -bias]))[:nv]
    return np.linalg.solve(M, f) - a


# --- identities ---------------------------------------------------------------------------------


@every_size
def test_e_is_a_right_inverse_of_g(size: tuple[int, int]) -> None:
    problem = Problem(*size)
    E, P = matrices(problem.factor(), size[1])
    assert_close(problem.G @ E, np.eye(size[1]), atol=1e-11)
    assert_close(E @ problem.G, P, atol=1e-11)


@every_size
def test_p_is_the_mass_orthogonal_projector_on_the_range_of_e(size: tuple[int, int]) -> None:
    problem = Problem(*size)
    E, P = matrices(problem.factor(), size[1])
    MP = problem.M @ P
    assert_close(P @ P, P, atol=1e-11)
    assert_close(MP, MP.T, atol=1e-11)
    assert_close(P @ E, E, atol=1e-11)
    assert np.trace(P) == pytest.approx(size[1], abs=1e-11)
    # What is left after projecting moves no row.
    assert_close(problem.G @ (np.eye(size[0]) - P), 0.0, atol=1e-11)


@every_size
@pytest.mark.parametrize("seed", range(4))
def test_multiplier_solves_the_dense_saddle_point_system(size: tuple[int, int], seed: int) -> None:
    problem = Problem(*size, seed)
    found = yhat(problem.factor())
    expected = dense_yhat(problem.M, problem.G, problem.f, problem.bias)
    assert_close(found, expected, atol=1e-10 * np.abs(expected).max())


@every_size
def test_multiplier_is_e_times_gamma(size: tuple[int, int]) -> None:
    problem = Problem(*size)
    p = problem.factor()
    E, _ = matrices(p, size[1])
    gamma = problem.G @ np.linalg.solve(problem.M, problem.f) + problem.bias
    assert_close(yhat(p), E @ gamma, atol=1e-10 * np.abs(E @ gamma).max())


@pytest.mark.parametrize("weight", [1e-8, 1e8])
def test_scaling_a_row_changes_neither_projector_nor_multiplier(weight: float) -> None:
    problem = Problem(6, 3)
    p = problem.factor()
    _, P = matrices(p, 3)
    before = yhat(p)
    problem.G[1] *= weight
    problem.bias[1] *= weight
    p = problem.factor()
    assert_close(matrices(p, 3)[1], P, atol=1e-13)
    assert_close(yhat(p), before, rtol=1e-11)


def test_factorising_reads_the_upper_triangle_of_m_and_changes_no_input() -> None:
    problem = Problem(5, 3)
    inputs = [problem.M.copy(), problem.G.copy(), problem.f.copy(), problem.bias.copy()]
    whole = yhat(problem.factor())
    for array, before in zip((problem.M, problem.G, problem.f, problem.bias), inputs):
        np.testing.assert_array_equal(array, before)
    problem.M = np.triu(problem.M) + np.tril(np.full((5, 5), 1e3), -1)
    assert_close(yhat(problem.factor()), whole, rtol=1e-12)


def test_factorisations_are_counted() -> None:
    problem = Problem(4, 2)
    p = Projection(2, 1.0)
    assert p.factorisations == 0
    for count in (1, 2, 3):
        p.factor(problem.M, problem.G, problem.f, problem.bias, None)
        assert p.factorisations == count


def test_sigma_is_the_last_structural_pivot_over_its_reference() -> None:
    problem = Problem(6, 3)
    white = np.linalg.solve(np.linalg.cholesky(problem.M), problem.G.T)
    last = pivoted_qr(np.asfortranarray(white))[3][2]
    p = Projection(3, 0.25)
    p.factor(problem.M, problem.G, problem.f, problem.bias, None)
    assert p.sigma == pytest.approx(last / 0.25, rel=1e-12)
    assert (p.rank, p.rank_deficient) == (3, False)


def test_pivots_are_the_distances_of_each_row_from_those_before_it() -> None:
    W = np.asfortranarray(np.random.default_rng(1).standard_normal((7, 5)))
    _, permutation, _, pivots = pivoted_qr(W)
    for k in range(5):
        chosen, left = W[:, permutation[:k]], W[:, permutation[k:]]
        if k:
            left = left - chosen @ np.linalg.lstsq(chosen, left, rcond=None)[0]
        norms = np.linalg.norm(left, axis=0)
        assert pivots[k] == pytest.approx(norms[0], rel=1e-12)
        assert norms[0] >= norms.max() * (1 - 1e-12)


# --- redundancy ---------------------------------------------------------------------------------


def combination(kind: str, m: int, rng: np.random.Generator) -> FloatArray:
    return {
        "duplicated": np.eye(m)[:2],
        "negated": -np.eye(m)[:1],
        "combined": rng.standard_normal((3, m)),
        "zero": np.zeros((2, m)),
        "all of these": np.vstack([np.eye(m), rng.standard_normal((2, m)), np.zeros((1, m))]),
    }[kind]


@pytest.mark.parametrize("rank_known", [True, False], ids=["rank known", "rank found"])
@pytest.mark.parametrize("kind", ["duplicated", "negated", "combined", "zero", "all of these"])
def test_redundant_rows_change_neither_rank_nor_multiplier(kind: str, rank_known: bool) -> None:
    """Known from the load-time analysis, or found because their pivots are rounding."""
    plain = Problem(9, 4)
    problem = plain.dependent(combination(kind, 4, plain.rng))
    structural = 4 if rank_known else min(9, len(problem.G))
    p = problem.factor(structural)
    assert p.rank == 4
    assert p.rank_deficient == (structural > 4)
    assert_close(yhat(p), yhat(plain.factor()), atol=1e-11)
    assert_close(matrices(p, len(problem.G))[1], matrices(plain.factor(), 4)[1], atol=1e-12)
    w = problem.rng.standard_normal(9)
    assert_close(problem.G @ (w - p.project(w)), 0.0, atol=1e-12)


def test_no_rows_of_any_size_leave_the_motion_free() -> None:
    problem = Problem(4, 2)
    problem.G = np.zeros((2, 4))
    p = problem.factor(2)
    assert (p.rank, p.rank_deficient, p.sigma) == (0, True, 0.0)
    np.testing.assert_array_equal(yhat(p), np.zeros(4))
    np.testing.assert_array_equal(p.project(np.ones(4)), np.zeros(4))


def test_a_pivot_just_above_zero_is_kept_and_just_below_dropped() -> None:
    for pivot, rank in ((3.0 * PIVOT_ZERO, 2), (0.3 * PIVOT_ZERO, 1)):
        problem = Problem(4, 2)
        problem.M = np.eye(4)
        problem.G = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, pivot, 0.0, 0.0]])
        assert problem.factor().rank == rank


# --- what cannot be factorised ------------------------------------------------------------------


@pytest.mark.parametrize("where", [0, 2, 4])
def test_a_mass_matrix_that_is_not_positive_definite_is_an_error(where: int) -> None:
    problem = Problem(5, 3)
    for bad in (0.0, -1.0):
        problem.M[where, where] = bad
        with pytest.raises(EvaluationError, match="not positive definite"):
            problem.factor()
        with pytest.raises(EvaluationError, match="not positive definite"):
            cholesky(problem.M)


@pytest.mark.parametrize(("what", "bad"), [("M", np.nan), ("G", np.nan), ("G", np.inf)])
def test_matrices_that_are_not_finite_are_an_error(what: str, bad: float) -> None:
    for index in ((0, 0), (1, 2), (2, 4)):
        problem = Problem(5, 3)
        getattr(problem, what)[index] = bad
        with pytest.raises(EvaluationError, match="not finite"):
            problem.factor()


NOT_FINITE = [
    *((name, bad) for name in CLOSED_MODELS for bad in (np.nan, np.inf, -np.inf, 1e200)),
    *(("pendulum_chain", bad) for bad in (np.nan, np.inf)),
]


@pytest.mark.parametrize(("name", "bad"), NOT_FINITE)
def test_a_state_that_is_not_finite_is_an_error_and_the_next_one_is_fine(
    name: str, bad: float
) -> None:
    mechanism = load(name)
    system = make_system(mechanism)
    state = np.concatenate([mechanism.q0, mechanism.v0])
    before = system.evaluate(0.0, state).rate().copy()
    for i in range(len(state)):
        broken = state.copy()
        broken[i] = bad
        with pytest.raises(EvaluationError, match="finite"):
            system.evaluate(0.0, broken)
    np.testing.assert_array_equal(system.evaluate(0.0, state).rate(), before)


def test_a_joint_that_moves_no_inertia_is_an_error() -> None:
    model = pin.Model()
    first = add_link(model, 0, pin.JointModelRY(), "first")
    last = model.addJoint(first, pin.JointModelRY(), pin.SE3.Identity(), "last")
    model.addBodyFrame("tip", last, pin.SE3.Identity(), 0)
    loop = srm.LoopClosure(
        "point_on_plane", srm.Anchor("tip", xyz=(1, 0, 0)), srm.Anchor("world"), (0, 0, 1)
    )
    with pytest.raises(
        srm.InputError, match=r"last.*neither .tip. nor anything that it carries has inertia"
    ):
        make_system(srm.Mechanism(model, (loop,)))


# --- next to a singular configuration -----------------------------------------------------------


def below(phi: float) -> tuple[float, float]:
    """Crank angle near 3 pi / 2 + phi as a double, and its exact distance from 3 pi / 2."""
    theta = 1.5 * np.pi + phi
    return theta, float(Fraction(theta) - Fraction("4.712388980384689857693965074919254326"))


def folded(phi: float, rate: float) -> tuple[FloatArray, float]:
    """State of slider_crank at distance phi, and its exact crank acceleration.

    (4/3 + 4 sin^2 th) th'' = -4 sin th cos th th'^2 - g cos th, without cancellation.
    """
    theta, distance = below(phi)
    s, c = -np.cos(distance), np.sin(distance)
    acceleration = (-4.0 * s * c * rate**2 - G * c) / (4.0 / 3.0 + 4.0 * s * s)
    return np.array([theta, -2.0 * theta, rate, -2.0 * rate]), float(acceleration)


@pytest.mark.parametrize("phi", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_acceleration_stays_accurate_next_to_a_singular_configuration(phi: float) -> None:
    system = make_system(load("slider_crank"))
    errors = []
    for rate in np.linspace(-6.0, 6.0, 25):
        for sign in (1.0, -1.0):
            state, exact = folded(sign * phi * (1.0 + 0.01 * rate), rate)
            terms = system.evaluate(0.0, state)
            assert not terms.rank_deficient
            found = terms.rate()
            errors += [abs(found[2] - exact), abs(found[3] + 2.0 * exact)]
    assert max(errors) < 2e-13 / phi  # e / phi for a closure error e of round-off


@pytest.mark.parametrize("phi", [1e-3, 1e-4, 1e-5, 1e-6])
def test_sigma_is_proportional_to_the_distance_from_the_singular_configuration(phi: float) -> None:
    system = make_system(load("slider_crank"))
    far = system.evaluate(0.0, folded(1e-2, 2.0)[0]).sigma
    state, _ = folded(phi, 2.0)
    assert system.evaluate(0.0, state).sigma == pytest.approx(far * below(phi)[1] / 1e-2, rel=1e-3)


@pytest.mark.parametrize("phi", [1e-2, 1e-4, 1e-6])
def test_dropping_the_weak_pivot_makes_the_acceleration_as_wrong_as_the_prediction(
    phi: float,
) -> None:
    """Why no evaluation truncates: the weak direction would come from the prediction alone."""
    system = make_system(load("slider_crank"))
    state, exact = folded(phi, 3.0)
    terms = system.evaluate(0.0, state)
    sigma, right = terms.sigma, terms.multiplier().copy()

    def error(threshold: float, shift: float) -> float:
        zone = Zone(threshold, lambda t: right + shift)
        return abs(system.evaluate(0.0, state, zone).rate()[2] - exact)

    assert error(0.99 * sigma, 0.2) < 2e-13 / phi  # not in the zone: the prediction is not used
    assert error(1.01 * sigma, 0.2) == pytest.approx(0.2, abs=2e-13 / phi)
    assert error(1.01 * sigma, 0.0) < 2e-13 / phi


def crossing_four_bars(angle: float) -> tuple[ClosedSystem, FloatArray]:
    """N-four-bar, N = 2, with all bars within ``angle`` of the ground line: nullity 2 at 0."""
    system = make_system(load("n_four_bar_2"))
    assert isinstance(system, ClosedSystem)
    turn = np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    return system, np.concatenate([angle * turn, 2.0 * turn])


def dense_terms(system: ClosedSystem, state: FloatArray) -> tuple[FloatArray, ...]:
    """M, G, f, bias of the last evaluation at ``state``, from Pinocchio and the loops."""
    q, v = system.split(state)
    data = system.model.createData()
    M = symmetric(pin.crba(system.model, data, q, pin.Convention.WORLD))
    f = -pin.nonLinearEffects(system.model, data, q, v) - system.model.damping * v
    f += ForceKinematics(system.model, system.mechanism.forces).generalised(data, q, v, 0.0)
    return M, system.loops.G.copy(), f, system.loops.bias.copy()


@pytest.mark.parametrize("angle", [1e-2, 1e-4, 1e-6])
def test_the_zone_drops_every_weak_pivot_and_keeps_the_strong_rows_exact(angle: float) -> None:
    system, state = crossing_four_bars(angle)
    prediction = np.array([0.3, -0.7, 1.1, 0.4, -0.2])
    terms = system.evaluate(0.0, state)
    assert (terms.rank, terms.rank_deficient) == (4, False)
    threshold = 4.0 * terms.sigma  # above both weak pivots, which differ by a factor below 3

    asked: list[float] = []

    def predict(t: float) -> FloatArray:
        asked.append(t)
        return prediction

    terms = system.evaluate(0.25, state, Zone(threshold, predict))
    assert (terms.rank, terms.rank_deficient) == (2, True)
    assert asked == [0.25]
    M, rows, f, bias = dense_terms(system, state)
    strong, gamma = rows[system.projection.order], bias[system.projection.order]
    inverse = np.linalg.inv(M)
    E = inverse @ strong.T @ np.linalg.inv(strong @ inverse @ strong.T)
    expected = E @ (strong @ inverse @ f + gamma) + prediction - E @ strong @ prediction
    assert_close(terms.multiplier(), expected, atol=1e-12)
    assert_close(terms.rate()[5:], inverse @ f - expected, atol=1e-11)
    np.testing.assert_array_equal(terms.rate()[:5], state[5:])
    w = np.array([0.1, 0.2, -0.4, 0.8, 0.3])
    assert_close(terms.project(w), E @ strong @ w, atol=1e-12)


@pytest.mark.parametrize("angle", [1e-2, 1e-4, 1e-6])
def test_in_the_zone_a_right_prediction_gives_the_right_acceleration(angle: float) -> None:
    system, state = crossing_four_bars(angle)
    terms = system.evaluate(0.0, state)
    sigma = terms.sigma
    exact, right = terms.rate().copy(), terms.multiplier().copy()
    found = system.evaluate(0.0, state, Zone(4.0 * sigma, lambda t: right)).rate()
    assert_close(found, exact, atol=1e-12 / angle)
    # The common crank angle: I th'' = -g W cos th with I = 3, W = 3.5 for N = 2 (IFToMM A02).
    turn = np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    expected = -G * 3.5 * np.cos(angle) / 3.0 * turn
    assert_close(exact[5:], expected, atol=1e-12 / angle)


def test_corrections_in_the_zone_touch_the_strong_rows_only() -> None:
    system, state = crossing_four_bars(1e-4)
    state = system.retract(state, 1e-7 * np.random.default_rng(2).standard_normal(10))
    whole = np.abs(system.evaluate(0.0, state).correction()).max()
    zone = Zone(1.0, lambda t: np.zeros(5))
    terms = system.evaluate(0.0, state, zone)
    correction = terms.correction()
    assert terms.rank == 2
    order = system.projection.order
    rows, g = system.loops.G[order], system.loops.g[order]
    assert_close(rows @ correction[:5], g, atol=1e-18)
    assert_close(rows @ correction[5:], rows @ state[5:], atol=1e-14)
    # 1e-7 over the distance 1e-4 moves the whole solve by 1e-3, the strong rows only by 1e-7.
    assert np.abs(correction[:5]).max() < 1e-6 < 1e-4 < whole


# --- correction ---------------------------------------------------------------------------------


def off_the_manifold(name: str, size: float) -> tuple[ClosedSystem, FloatArray]:
    mechanism = load(name)
    system = make_system(mechanism)
    assert isinstance(system, ClosedSystem)
    rng = np.random.default_rng(3)
    state = np.concatenate([mechanism.q0, mechanism.v0])
    delta = np.concatenate([rng.uniform(-1, 1, system.nv), rng.uniform(-2, 2, system.nv)])
    delta[: system.nv] *= size * mechanism.structure.units.coordinate
    return system, system.retract(state, delta)


@every_closed_model
def test_one_correction_squares_the_closure_error(name: str) -> None:
    ratios = []
    for size in (1e-2, 1e-3, 1e-4):
        system, state = off_the_manifold(name, size)
        before = np.abs(system.residuals(state)[0]).max()
        corrected = system.retract(state, -system.evaluate(0.0, state).correction())
        after = np.abs(system.residuals(corrected)[0]).max()
        slope = np.abs(system.loops.G).max()  # far from 1 where lengths and masses are
        assert before > 1e-2 * size * slope
        ratios.append(slope * after / before**2)
    # The light rod of the spatial slider-crank takes nearly the whole correction.
    assert max(ratios) < (10.0 if name == "spatial_slider_crank" else 5.0)
    linear = name == "differential"  # solved at once: what is left is rounding
    assert max(ratios) < 1e-9 if linear else ratios[2] == pytest.approx(ratios[1], rel=0.05)


@every_independent_model
def test_the_correction_makes_the_rates_satisfy_the_closures_where_it_was_evaluated(
    name: str,
) -> None:
    system, state = off_the_manifold(name, 1e-2)
    v = state[system.nq :]
    correction = system.evaluate(0.0, state).correction()
    rows, g = system.loops.G.copy(), system.loops.g.copy()
    assert np.abs(rows @ v).max() > 0.1 * np.abs(rows).max()
    assert_close(rows @ (v - correction[system.nv :]), 0.0, atol=1e-13)
    assert_close(rows @ correction[: system.nv], g, atol=1e-15)


@every_closed_model
def test_the_correction_of_a_consistent_state_is_round_off(name: str) -> None:
    mechanism = load(name)
    system = make_system(mechanism)
    terms = system.evaluate(0.0, np.concatenate([mechanism.q0, mechanism.v0]))
    assert np.abs(terms.correction()).max() < 1e-13


@every_closed_model
def test_the_correction_is_the_least_one_in_kinetic_energy(name: str) -> None:
    """M (E g, P v) lies in the span of the rows: no part of it moves along the motion."""
    system, state = off_the_manifold(name, 1e-3)
    correction = system.evaluate(0.0, state).correction()
    M, rows, _, _ = dense_terms(system, state)
    for part in np.split(correction, 2):
        momentum = M @ part
        inside = rows.T @ np.linalg.lstsq(rows.T, momentum, rcond=1e-9)[0]
        assert_close(momentum, inside, atol=1e-12 * np.abs(momentum).max())


# --- the evaluation as a whole ------------------------------------------------------------------


@every_independent_model
def test_rate_solves_the_dense_equations_of_motion(name: str) -> None:
    system, state = off_the_manifold(name, 0.05)
    rate = system.evaluate(0.0, state).rate()
    M, rows, f, bias = dense_terms(system, state)
    nv = system.nv
    np.testing.assert_array_equal(rate[:nv], state[system.nq :])
    scale = np.abs(rate[nv:]).max()
    assert_close(rows @ rate[nv:] + bias, 0.0, atol=1e-11 * max(1.0, scale))
    expected = np.linalg.solve(M, f) - dense_yhat(M, rows, f, bias)
    assert_close(rate[nv:], expected, atol=1e-10 * max(1.0, scale))


def test_controller_and_joint_damping_act_on_closed_and_open_mechanisms() -> None:
    for name in ("four_bar", "pendulum_chain"):
        mechanism = load(name)
        model = mechanism.model.copy()
        model.damping = np.linspace(0.5, 1.5, model.nv)
        damped = srm.Mechanism(model, mechanism.loops, mechanism.q0, mechanism.v0 + 1.0)
        tau = np.linspace(-2.0, 1.0, model.nv)
        system = make_system(damped, lambda t, q, v, tau=tau: tau * (1.0 + t))
        state = np.concatenate([damped.q0, damped.v0])
        found = system.evaluate(0.5, state).rate()[model.nv :]
        q, v = system.split(state)
        data = model.createData()
        M = symmetric(pin.crba(model, data, q))
        f = 1.5 * tau - model.damping * v - pin.nonLinearEffects(model, data, q, v)
        expected = np.linalg.solve(M, f)
        if isinstance(system, ClosedSystem):
            expected = expected - dense_yhat(M, system.loops.G, f, system.loops.bias)
        assert_close(found, expected, atol=1e-11)


def test_rotor_inertia_acts_alike_in_closed_and_open_evaluations() -> None:
    mechanism = load("pendulum_chain")
    model = mechanism.model.copy()
    model.armature = np.array([0.3, 0.2, 0.1])
    heavy = srm.Mechanism(model, (), mechanism.q0, mechanism.v0)
    loop = srm.LoopClosure(
        "point_on_plane", srm.Anchor("link_2", xyz=(1, 0, 0)), srm.Anchor("world"), (0, 0, 1)
    )
    closed = ClosedSystem(srm.Mechanism(model, (loop,), mechanism.q0, mechanism.v0))
    state = np.concatenate([mechanism.q0, np.array([0.3, -0.4, 0.5])])
    terms = closed.evaluate(0.0, state)
    unconstrained = terms.rate() + np.concatenate([np.zeros(3), terms.multiplier()])
    assert_close(unconstrained, make_system(heavy).evaluate(0.0, state).rate(), atol=1e-11)


def counted_pinocchio(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Counts of Pinocchio functions called through the system's module."""
    calls: dict[str, int] = {}

    def counting(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            calls[name] = calls.get(name, 0) + 1
            return function(*args)

        return call

    functions = {
        name: counting(name, value)
        for name, value in vars(pin).items()
        if callable(value) and not isinstance(value, type)
    }
    for module in (manifold, multibody):
        monkeypatch.setattr(module, "pin", SimpleNamespace(**{**vars(pin), **functions}))
    return calls


@every_closed_model
def test_an_evaluation_calls_each_pinocchio_algorithm_once(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mechanism = load(name)
    system = make_system(mechanism)
    state = np.concatenate([mechanism.q0, mechanism.v0])
    calls = counted_pinocchio(monkeypatch)
    terms = system.evaluate(0.0, state)
    terms.rate(), terms.multiplier(), terms.correction(), terms.project(mechanism.v0)
    expected = {"crba": 1, "nonLinearEffects": 1}
    model = mechanism.model
    roots = [joint for joint in range(1, model.njoints) if model.parents[joint] == 0]
    away = any(model.jointPlacements[joint].translation.any() for joint in roots)
    if mechanism.forces and away and name in ANCHORED_MODELS:
        # Elements have places in the world, closures in their trees.
        expected |= {"forwardKinematics": 1, "computeJointJacobians": 1}
    assert calls == expected
    assert (system.evaluations, system.factorisations) == (1, 1)


def test_an_open_chain_calls_aba_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    mechanism = load("pendulum_chain")
    system = make_system(mechanism)
    assert isinstance(system, OpenSystem)
    calls = counted_pinocchio(monkeypatch)
    terms = system.evaluate(0.0, np.concatenate([mechanism.q0, mechanism.v0]))
    assert calls == {"aba": 1}
    assert (terms.sigma, terms.rank, terms.rank_deficient) == (np.inf, 0, False)
    assert not any(
        x.any() for x in (terms.multiplier(), terms.correction(), terms.project(np.ones(3)))
    )


def test_an_evaluation_allocates_little_and_keeps_nothing() -> None:
    mechanism = load("slider_crank")
    system = make_system(mechanism)
    state = np.concatenate([mechanism.q0, mechanism.v0])

    def evaluate() -> None:
        terms = system.evaluate(0.0, state)
        terms.rate()
        terms.correction()

    for _ in range(10):
        evaluate()
    tracemalloc.start()
    try:
        evaluate()
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        evaluate()
        peak = tracemalloc.get_traced_memory()[1] - before
        for _ in range(500):
            evaluate()
        gc.collect()  # what other tests left to the collector
        left = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert peak < 8_000
    assert left < 6_000  # 500 evaluations that each kept a float would leave 12_000


def test_the_answers_of_a_stage_do_not_depend_on_the_order_in_which_they_are_read() -> None:
    system, state = off_the_manifold("parallelogram", 1e-2)
    terms = system.evaluate(0.0, state)
    first = [terms.rate(), terms.multiplier(), terms.correction(), terms.project(np.ones(3))]
    again = [terms.project(np.ones(3)), terms.correction(), terms.multiplier(), terms.rate()]
    for x, y in zip(first, reversed(again)):
        np.testing.assert_array_equal(x, y)
