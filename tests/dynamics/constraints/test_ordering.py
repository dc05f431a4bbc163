"""The order of the rows along the graph of the loops, and pivots along it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from srm_mbs.dynamics.constraints.projection import Projection, pivoted_qr, swept_qr
from srm_mbs.dynamics.constraints.row_algebra import GRAPH_ORDER_ABOVE, graph_order


def pattern_of(supports: list[list[int]], nv: int) -> np.ndarray:
    pattern = np.zeros((len(supports), nv), bool)
    for row, support in enumerate(supports):
        pattern[row, support] = True
    return pattern


def chain(loops: int) -> list[list[int]]:
    """Two rows a loop, each with one coordinate in common with the next one's."""
    return [[2 * i, 2 * i + 1, 2 * i + 2] for i in range(loops) for _ in range(2)]


def white(loops: int, weak: float, seed: int = 0) -> np.ndarray:
    """W of a chain: one row of each loop is ``weak`` times the size of the other."""
    rng = np.random.default_rng(seed)
    W = np.zeros((2 * loops + 1, 2 * loops))
    for row, support in enumerate(chain(loops)):
        W[support, row] = rng.uniform(0.5, 1.0, 3) * (weak if row % 2 else 1.0)
    return W


def test_rows_of_a_chain_are_ordered_from_one_end_to_the_other() -> None:
    supports = chain(50)
    order = graph_order(pattern_of(supports, 101), [-1] * 101)
    assert order == tuple(range(100))
    shuffled = np.random.default_rng(0).permutation(100)
    order = graph_order(pattern_of([supports[k] for k in shuffled], 101), [-1] * 101)
    # From both ends, until they meet.
    loops = [int(shuffled[k]) // 2 for k in order]
    assert sorted(loops) == [k // 2 for k in range(100)]
    assert sum(abs(a - b) > 1 for a, b in itertools.pairwise(loops)) <= 1


def test_each_branch_of_a_tree_of_loops_is_ordered_in_one_piece() -> None:
    branches = [[[0, 100 + 20 * b], *([100 + 20 * b + k, 101 + 20 * b + k] for k in range(18))]
                for b in range(5)]  # fmt: skip
    supports = [support for branch in branches for support in branch]
    order = graph_order(pattern_of(supports, 200), [-1] * 200)
    owners = [row // 19 for row in order]
    assert sorted(order) == list(range(95))
    # The last branch to be done goes on where the others meet.
    assert sum(a != b for a, b in itertools.pairwise(owners)) <= 2 * len(branches)


def test_ancestors_make_rows_meet() -> None:
    """Rows that have no coordinate in common, on bodies that one chain carries."""
    many = GRAPH_ORDER_ABOVE + 1
    supports = [[k] for k in range(many)]
    carried = [-1, *range(GRAPH_ORDER_ABOVE)]
    assert graph_order(pattern_of(supports, many), [-1] * many) != ()
    assert graph_order(pattern_of(supports, many), carried) == ()


def test_few_coordinates_and_full_rows_have_no_order() -> None:
    assert graph_order(pattern_of(chain(30), 61), [-1] * 61) == ()
    assert graph_order(np.ones((10, 100), bool), [-1] * 100) == ()
    assert graph_order(np.ones((0, 100), bool), [-1] * 100) == ()


@pytest.mark.parametrize("weak", [1.0, 0.1, 1e-4, 1e-9])
def test_pivots_along_the_graph_give_the_same_projections(weak: float) -> None:
    """P v, E g and the multiplier are those of the largest pivots, to rounding over the weakest."""
    W = white(20, weak)
    nv, rows = W.shape
    rng = np.random.default_rng(1)
    f, bias = rng.standard_normal(nv), W.T @ rng.standard_normal(nv)
    w, g = rng.standard_normal(nv), W.T @ rng.standard_normal(nv)
    found = []
    for order in ((), tuple(range(rows))):
        p = Projection(rows, 1.0, order)
        p.factor(np.eye(nv), W.T, f, bias, None)
        assert p.rank == rows
        found.append((p.project(w), p.normal(g), p.white_multiplier))
    for one, two in zip(*found):
        assert np.abs(one - two).max() < 1e-14 * (1.0 + np.abs(one).max()) * 10.0 / weak
    # To rounding alone where the weak rows are weak as a whole.
    assert np.abs(W.T @ (w - found[1][0])).max() < 1e-13


@pytest.mark.parametrize("weak", [1.0, 0.1, 1e-3, 1e-6])
def test_the_smallest_pivot_is_near_that_of_the_largest_ones(weak: float) -> None:
    for seed in range(5):
        W = white(30, weak, seed)
        pivots = swept_qr(W, tuple(range(60)), 60, 0.0)[3]
        smallest = pivoted_qr(np.asfortranarray(W))[3][-1]
        assert 0.3 < pivots.min() / smallest < 3.0


@pytest.mark.parametrize("floor", [1e-13, 1e-3, 0.2, 0.7])
def test_pivots_below_the_floor_are_the_last(floor: float) -> None:
    for seed in range(5):
        W = white(30, 0.3, seed)
        W[:, ::6] *= 1e-3
        W = np.concatenate([W, W[:, 10:14]], axis=1)
        pivots = swept_qr(W, tuple(range(64)), 60, floor)[3]
        below = pivots[:60] < floor
        assert np.array_equal(below, np.sort(below))
        assert 0 < below.sum() < 60 or floor == 1e-13


def test_the_weakest_normal_is_the_last() -> None:
    W = white(20, 0.5)
    W[:, 7] *= 1e-3
    p = Projection(40, 1.0, tuple(range(40)))
    p.factor(np.eye(41), W.T, np.zeros(41), np.zeros(40), None)
    # What row 7 adds to the others.
    others = np.linalg.qr(np.delete(W, 7, axis=1))[0]
    own = W[:, 7] - others @ (others.T @ W[:, 7])
    assert abs(p.normals()[:, -1] @ own) > 0.99 * np.linalg.norm(own)


def test_weak_normals_are_those_of_pivots_below_the_usual_smallest_one() -> None:
    W = white(20, 0.5)
    W[:, [7, 20]] *= 1e-3
    p = Projection(40, 0.002, tuple(range(40)))
    p.factor(np.eye(41), W.T, np.zeros(41), np.zeros(40), None)
    np.testing.assert_array_equal(p.weak_normals(), p.normals()[:, -2:])
