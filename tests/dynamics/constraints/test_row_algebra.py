"""The pivoted factorisation behind the analysis of mechanisms, by LAPACK and by the kernel."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs._kernel import workspace as workspaces
from srm_mbs._kernel.workspace import workspace
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.constraints import row_algebra as ranks
from srm_mbs.dynamics.constraints import structure
from srm_mbs.dynamics.constraints.geometry import ClosureGeometry
from srm_mbs.dynamics.constraints.projection import (
    cholesky,
    pivoted_qr,
    symmetric,
    unwhiten,
    whiten,
)
from srm_mbs.dynamics.constraints.rheonomic import DrivenKinematics
from srm_mbs.dynamics.constraints.row_algebra import (
    RowAlgebra,
    SingularValues,
    coordinate_parents,
    row_algebra,
    trees,
)
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.errors import EvaluationError
from srm_mbs.formats.load import n_four_bar_texts
from srm_mbs.integration.kernel import backend
from tests.support.bundled import load
from tests.support.mechanisms import DISTINCT_MODELS, floating_ring, floating_slider_crank

NAMES = DISTINCT_MODELS
with_kernel = pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")
choices = pytest.mark.parametrize("choice", ["dense", pytest.param("kernel", marks=with_kernel)])


class BySingularValues:
    """The row algebra by singular values and least squares: slow, and what ranks mean."""

    def factor(self, M: np.ndarray | None, G: np.ndarray, cut: float = 0.0) -> None:
        self.U = np.eye(G.shape[1]) if M is None else cholesky(M)
        W = whiten(self.U, np.asfortranarray(G.T))
        self.left, self.size, self.right = np.linalg.svd(W)
        self.rank = int(np.sum(self.size > cut))
        self.row_squares = (W * W).sum(axis=0)
        self.pivots = pivoted_qr(W)[3]

    def tangential(self, w: np.ndarray) -> np.ndarray:
        null = self.left[:, self.rank :]
        return unwhiten(self.U, null @ (null.T @ (self.U @ w)))

    def solve(self, g: np.ndarray) -> np.ndarray:
        used = slice(self.rank)
        inside = (self.right[used] @ g) / self.size[used]
        return unwhiten(self.U, self.left[:, used] @ inside)


def algebra_by(choice: str, pattern: np.ndarray, model: pin.Model | None = None) -> RowAlgebra:
    """The algebra of LAPACK or of the kernel, whatever the number of coordinates."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ranks, "KERNEL_ABOVE", 0 if choice == "kernel" else pattern.shape[1])
        return row_algebra(pattern, None if model is None else coordinate_parents(model))


def rows_of(n: int = 0) -> tuple[pin.Model, np.ndarray, np.ndarray]:
    """Model, M and G of an N-four-bar in an open configuration; of a floating ring for n = 0."""
    mechanism = srm.n_four_bar(n) if n else floating_ring()
    model = mechanism.model
    move = 0.3 * np.random.default_rng(1).standard_normal(model.nv)
    q = pin.integrate(model, mechanism.q0, move)
    data = model.createData()
    rows = DrivenKinematics(model, mechanism.loops, ())
    rows.evaluate(model, data, q)
    assert not rows.G[~rows.pattern()].any()
    return model, symmetric(data.M), rows.G.copy()


# --- the factorisation --------------------------------------------------------------------------


@choices
@pytest.mark.parametrize("n", [0, 3, 12])
def test_what_the_rows_do_not_see_and_the_shortest_solution(n: int, choice: str) -> None:
    model, M, G = rows_of(n)
    algebra = algebra_by(choice, G != 0.0, model)
    algebra.factor(M, G)
    rng = np.random.default_rng(2)
    w, g = rng.standard_normal(model.nv), G @ rng.standard_normal(model.nv)
    free, x = algebra.tangential(w), algebra.solve(g)
    assert np.abs(G @ free).max() < 1e-12
    # What is taken away, and the solution, are M-orthogonal to all that the rows do not see.
    expected = np.linalg.lstsq(np.linalg.cholesky(M).T, np.eye(model.nv), rcond=None)[0]
    null = np.linalg.svd(G @ expected)[2][np.linalg.matrix_rank(G) :]
    assert np.abs((expected @ null.T).T @ M @ (w - free)).max() < 1e-11
    assert np.abs((expected @ null.T).T @ M @ x).max() < 1e-11
    assert np.abs(G @ x - g).max() < 1e-11
    assert algebra.rank == np.linalg.matrix_rank(G)
    white = np.linalg.solve(np.linalg.cholesky(M), G.T)
    np.testing.assert_allclose(algebra.row_squares, (white**2).sum(axis=0), atol=1e-12)


@with_kernel
@pytest.mark.parametrize("n", [0, 3, 12])
def test_with_the_metric_one_its_parts_are_orthonormal_and_transposed(n: int) -> None:
    _, _, G = rows_of(n)
    algebra: Any = algebra_by("kernel", G != 0.0)
    algebra.factor(None, G)
    basis = algebra.complement()
    assert basis.shape == (G.shape[1], G.shape[1] - algebra.rank)
    assert np.abs(basis.T @ basis - np.eye(basis.shape[1])).max(initial=0.0) < 1e-13
    assert np.abs(G @ basis).max(initial=0.0) < 1e-13
    rng = np.random.default_rng(3)
    g, x = rng.standard_normal(len(G)), rng.standard_normal(G.shape[1])
    assert abs(algebra.solve(g) @ x - g @ algebra.multiplier(x)) < 1e-11


@with_kernel
@pytest.mark.parametrize("cut", [0.0, 0.3])
@pytest.mark.parametrize("n", [3, 12, 40])
def test_both_choose_the_same_pivots_and_cut_them_alike(n: int, cut: float) -> None:
    model, M, G = rows_of(n)
    dense, compiled = (algebra_by(choice, G != 0.0, model) for choice in ("dense", "kernel"))
    for algebra in (dense, compiled):
        algebra.factor(M, G, cut)
    assert compiled.rank == dense.rank
    assert np.abs(compiled.pivots - dense.pivots).max() < 1e-12
    w = np.random.default_rng(4).standard_normal(model.nv)
    assert np.abs(compiled.tangential(w) - dense.tangential(w)).max() < 1e-11


@with_kernel
@pytest.mark.parametrize("cut", [0.0, 1e-9])
def test_both_leave_redundant_rows_of_a_long_chain_out(cut: float) -> None:
    """Rows twice, and sums of neighbours: what is left of them is rounding, or nothing at all."""
    model, M, G = rows_of(40)
    G = G[np.abs(G).max(axis=1) > 0.0]
    again = G[:-1:3] + G[1::3] if len(G) % 3 != 1 else G[:-1:3][: len(G[1::3])] + G[1::3]
    G = np.concatenate([G, G[::4], again])
    dense, compiled = (algebra_by(choice, G != 0.0, model) for choice in ("dense", "kernel"))
    for algebra in (dense, compiled):
        algebra.factor(M, G, cut)
    rank = int(np.linalg.matrix_rank(G))
    assert dense.rank == rank
    assert compiled.rank == rank
    assert np.abs(compiled.pivots - dense.pivots).max() < 1e-12
    w = np.random.default_rng(4).standard_normal(model.nv)
    assert np.abs(G @ compiled.tangential(w)).max() < 1e-11
    assert np.abs(compiled.tangential(w) - dense.tangential(w)).max() < 1e-11


@choices
def test_what_cannot_be_factorised_is_refused_with_a_reason(choice: str) -> None:
    model, M, G = rows_of(3)
    algebra = algebra_by(choice, G != 0.0, model)
    with pytest.raises(EvaluationError, match="mass matrix"):
        algebra.factor(M - 10.0 * np.eye(len(M)), G)
    broken = G.copy()
    broken[0, np.flatnonzero(G[0])[0]] = np.nan
    with pytest.raises(EvaluationError, match="closures are not finite"):
        algebra.factor(M, broken)
    algebra.factor(M, G)
    assert algebra.rank == np.linalg.matrix_rank(G)


@with_kernel
def test_arrays_of_another_size_are_refused() -> None:
    _, M, G = rows_of(3)
    algebra: Any = algebra_by("kernel", G != 0.0)
    with pytest.raises(ValueError, match="rows, nv"):
        algebra.factor(M, G[:-1])
    algebra.factor(M, G)
    with pytest.raises(ValueError, match="right size"):
        algebra.tangential(np.zeros(1))


@pytest.mark.parametrize("make", [floating_ring, lambda: srm.n_four_bar(3)])
def test_trees_and_parents_are_those_of_the_mass_matrix(make: Callable[[], srm.Mechanism]) -> None:
    model = make().model
    assert coordinate_parents(model) == list(model.createData().parents_fromRow)
    M = pin.crba(model, model.createData(), pin.randomConfiguration(model))
    blocks = np.zeros(M.shape, dtype=bool)
    for tree in trees(model):
        blocks[tree, tree] = True
    assert not M[~blocks].any()
    assert sum(tree.stop - tree.start for tree in trees(model)) == model.nv


@with_kernel
@pytest.mark.parametrize("angle", [np.pi / 2.0, 0.8, 1e-3])
def test_the_factors_of_a_chain_grow_with_its_loops(angle: float) -> None:
    """Upright, half-way and next to the N-fold singularity; a dense Q would be 16 times as large
    for four times the loops."""
    entries = []
    for n in (80, 320):
        model = pin.buildModelFromXML(n_four_bar_texts(n)[1])
        tip = {"xyz": (1.0, 0.0, 0.0)}
        loops = [
            srm.LoopClosure(
                "point",
                srm.Anchor(f"coupler_{i}", **tip),
                srm.Anchor(f"crank_{i + 1}", **tip),
                name=f"pin_{i}",
            )
            for i in range(n)
        ]
        q = np.array([angle if name.startswith("crank") else -angle for name in model.names[1:]])
        rows = LoopKinematics(model, loops, keep=np.tile([True, False, True], n))
        data = workspace(model)
        rows.evaluate(model, data, q)
        algebra: Any = row_algebra(rows.pattern(), coordinate_parents(model))
        algebra.factor(data.M, rows.G)
        assert algebra.rank == 2 * n
        entries.append(algebra.entries)
    assert entries[1] < 4.5 * entries[0]


# --- ranks of many coordinates ------------------------------------------------------------------


@with_kernel
@pytest.mark.parametrize("angle", [1.1, 1e-2, 1e-5])
def test_ranks_of_many_coordinates_are_those_of_singular_values(
    angle: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A chain of 40 loops, regular and next to the singular configuration of nullity 40."""
    mechanism = srm.n_four_bar(40)
    q = np.where([name.startswith("crank") for name in mechanism.joint_names], angle, -angle)
    A = ClosureGeometry(mechanism, mechanism.q0).normalised(q)
    b = A @ np.random.default_rng(5).standard_normal(A.shape[1])
    expected = np.linalg.svd(A, compute_uv=False)
    assert A.shape[1] > ranks.SPARSE_ABOVE
    assert abs(ranks.singular_value(A, 80) / expected[79] - 1.0) < 1e-9
    assert abs(ranks.smallest_singular_value(A, 1e-12) / expected[79] - 1.0) < 1e-9
    null, solved = ranks.null_basis(A, 1e-7), ranks.rank_revealing_qr(A, 1e-7)
    x = ranks.min_norm_solution(A, b, 1e-10)
    monkeypatch.setattr(ranks, "SPARSE_ABOVE", 10**6)
    known = ranks.null_basis(A, 1e-7)
    assert np.abs(null @ null.T - known @ known.T).max() < 1e-9
    assert np.abs(solved.null @ solved.null.T - known @ known.T).max() < 1e-9
    for found in (solved.solve(b), x):
        assert (
            np.abs(found - ranks.min_norm_solution(A, b, 1e-10)).max()
            < 1e-14 / expected[79] ** 2 + 1e-9
        )
    assert abs(ranks.singular_value(A, 80) / expected[79] - 1.0) < 1e-9


@with_kernel
def test_rows_that_depend_on_each_other_have_the_singular_values_of_all_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(6)
    A = rng.standard_normal((5, 9))
    A = np.concatenate([A, A[:2] + A[2:4]])
    expected = np.linalg.svd(A, compute_uv=False)[4]
    for threshold in ("KERNEL_ABOVE", "SPARSE_ABOVE"):
        monkeypatch.setattr(ranks, threshold, 0)
    assert abs(ranks.smallest_singular_value(A, 1e-9) - expected) < 1e-13
    assert abs(ranks.singular_value(A, 5) - expected) < 1e-13
    assert ranks.null_basis(A, 1e-9).shape == (9, 4)
    assert ranks.null_basis(A.T, 1e-9).shape == (7, 2)


# --- decisions ----------------------------------------------------------------------------------

CHAINS = ("n_four_bar_5", "n_four_bar_20")
TURNED = 0.3
"""Bricard's row that is dependent on closed configurations only: the walk closes along it by
another step, so that its samples differ.  Over 40 seeds of the walk their median has a standard
deviation of 3.7 %, the ratio of two one of 5.2 %: this is six of them."""


def same_decisions(a: srm.Mechanism, b: srm.Mechanism, sigma: float) -> None:
    one, other = a.structure, b.structure
    for name in ("row_names", "rank", "loop_rank", "samples", "notes", "redundant_rows"):
        assert getattr(one, name) == getattr(other, name), name
    np.testing.assert_allclose(one.row_scale, other.row_scale, rtol=1e-13)
    assert abs(one.sigma_ref / other.sigma_ref - 1.0) < sigma
    assert a.mobility == b.mobility
    np.testing.assert_allclose(a.q0, b.q0, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(a.v0, b.v0, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", [*NAMES, *CHAINS])
def test_pivots_decide_as_singular_values_do(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ranks, redundant rows, row scales and mobility of every bundled mechanism."""
    found = load(name)
    assert found.mobility
    monkeypatch.setattr(structure, "row_algebra", lambda *_: BySingularValues())
    same_decisions(found, srm.load(name), TURNED if name == "bricard" else 1e-12)


@with_kernel
@pytest.mark.parametrize("name", [*NAMES, *CHAINS])
def test_the_kernel_decides_as_the_reference_does(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its algebra and, as for mechanisms with many coordinates, its workspaces."""
    with monkeypatch.context() as patch:
        patch.setattr(ranks, "KERNEL_ABOVE", sys.maxsize)
        by_lapack = srm.load(name)
        assert by_lapack.mobility
    monkeypatch.setattr(workspaces, "LARGE", 0)
    monkeypatch.setattr(ranks, "SPARSE_ABOVE", 2)
    same_decisions(by_lapack, srm.load(name), 1e-9 if name == "bricard" else 1e-12)


# --- workspaces ---------------------------------------------------------------------------------

MODELS: dict[str, Callable[[], srm.Mechanism]] = {
    "floating ring": floating_ring,
    "floating slider-crank": floating_slider_crank,
    "stewart_platform": lambda: load("stewart_platform"),
    "jansen_walker": lambda: load("jansen_walker"),
    "spatial_four_bar": lambda: load("spatial_four_bar"),
}


def everything(model: pin.Model, data: pin.Data) -> list[np.ndarray]:
    """What the algorithms in use leave in ``data``."""
    rng = np.random.default_rng(8)
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.0, 1.0, model.nv))
    v, tau = rng.standard_normal((2, model.nv))
    out = [pin.aba(model, data, q, v, tau).copy(), pin.nonLinearEffects(model, data, q, v).copy()]
    for convention in (pin.Convention.WORLD, pin.Convention.LOCAL):
        out.append(np.triu(pin.crba(model, data, q, convention)))
        out.append(data.J.copy())
    out.append(pin.computeJointJacobians(model, data, q).copy())
    out.append(pin.computeJointJacobian(model, data, q, model.njoints - 1).copy())
    pin.forwardKinematics(model, data, q, v)
    pin.updateFramePlacements(model, data)
    out += [np.array(m) for m in (*data.oMi, *data.oMf)]
    out += [motion.vector.copy() for vectors in (data.v, data.a_gf) for motion in vectors]
    out.append(pin.centerOfMass(model, data, q).copy())
    energies = pin.computeKineticEnergy(model, data), pin.computePotentialEnergy(model, data)
    out.append(np.array(energies))
    return out


@with_kernel
@pytest.mark.parametrize("name", MODELS)
def test_a_lean_workspace_gives_what_pinocchios_own_gives(name: str) -> None:
    model = MODELS[name]().model
    lean = backend.core.lean_data(model)
    for list_ in ("supports_fromRow", "parents_fromRow", "nvSubtree", "nvSubtree_fromRow"):
        own = getattr(model.createData(), list_)
        assert [list(x) if hasattr(x, "__len__") else x for x in getattr(lean, list_)] == [
            list(x) if hasattr(x, "__len__") else x for x in own
        ]
    for found, expected in zip(everything(model, lean), everything(model, model.createData())):
        assert np.array_equal(found, expected)


@with_kernel
def test_only_models_have_workspaces() -> None:
    with pytest.raises(TypeError, match="not a pinocchio"):
        backend.core.lean_data(3)


def test_a_small_model_has_a_workspace_for_every_algorithm() -> None:
    model = load("four_bar").model
    assert workspace(model).Minv.shape == (3, 3)


def near_null_projectors(A: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
    """By all singular vectors."""
    left, size, right = np.linalg.svd(A)
    rank = int(np.sum(size > max(100.0 * size[k - 1], 1e-9)))
    assert rank < k
    return left[:, rank:] @ left[:, rank:].T, right[rank:].T @ right[rank:]


@pytest.mark.parametrize("angle", [1e-12, 0.0])
@pytest.mark.parametrize("loops", [6, 40])
def test_near_null_spaces_are_those_of_the_singular_vectors(loops: int, angle: float) -> None:
    """Singular values that vanish together, of loops that are singular at once."""
    mechanism = srm.n_four_bar(loops)
    cranks = np.isclose(mechanism.q0, np.pi / 2.0)
    geometry = ClosureGeometry(mechanism, mechanism.q0)
    A = geometry.normalised(np.where(cranks, angle, -angle))
    A = A[np.linalg.norm(geometry.normalised(mechanism.q0 + 0.1), axis=1) > 1e-9]
    left, right = SingularValues(np.ones_like(A, dtype=bool)).near_null_spaces(A, len(A))
    both = near_null_projectors(A, len(A))
    for basis, expected in zip((left, right), both):
        np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-13)
        np.testing.assert_allclose(basis @ basis.T, expected, rtol=0.0, atol=1e-10)


def test_near_null_spaces_of_dependent_rows_and_repeated_values_are_those_of_the_vectors() -> None:
    rng = np.random.default_rng(3)
    left, right = (np.linalg.qr(rng.standard_normal((n, n)))[0] for n in (70, 90))
    size = np.concatenate([np.full(30, 2.0), np.linspace(1.0, 0.3, 28), np.full(6, 1e-13)])
    A = left[:, :64] * size @ right[:64]  # rank 58 of 64, and six more rows that depend on others
    found = SingularValues(np.ones_like(A, dtype=bool)).near_null_spaces(A, 64)
    for basis, expected in zip(found, near_null_projectors(A, 64)):
        np.testing.assert_allclose(basis @ basis.T, expected, rtol=0.0, atol=1e-11)


@with_kernel
def test_null_spaces_without_a_clear_gap_are_those_of_the_singular_vectors() -> None:
    rng = np.random.default_rng(4)
    left, right = (np.linalg.qr(rng.standard_normal((n, n)))[0] for n in (70, 90))
    A = left * np.geomspace(1.0, 1e-8, 70) @ right[:70]
    values = SingularValues(np.ones_like(A, dtype=bool))
    assert values._factored_null_spaces(A, 70) is None
    for basis, expected in zip(values.near_null_spaces(A, 70), near_null_projectors(A, 70)):
        np.testing.assert_allclose(basis @ basis.T, expected, rtol=0.0, atol=1e-11)
