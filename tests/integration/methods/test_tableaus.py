"""The Runge-Kutta data satisfy the order conditions they claim, and contradictory data are refused.

The order conditions are generated from rooted trees (HNW, II.2): a method with weights w over
stages of matrix A has order p if w . phi(t) = 1 / gamma(t) for every tree t of up to p nodes; its
continuous extension if w(theta) . phi(t) = theta^p / gamma(t).  They are checked in fractions where
the tableau is rational.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from functools import cache
from math import prod
from typing import Any

import numpy as np
import pytest

from srm_mbs._typing import FloatArray
from srm_mbs.integration.methods.butcher import ButcherTableau, DenseExtension, ExactTableau
from srm_mbs.integration.methods.tableaus import TABLEAUS, get_tableau
from tests.support.convergence import fitted_order

Tree = tuple["Tree", ...]  # the subtrees that hang on the root
Array = np.ndarray[Any, np.dtype[Any]]  # of fractions (objects) or floats

EXPLICIT = {
    name: tableau
    for name, tableau in TABLEAUS.items()
    if tableau.implicit is None and tableau.stiff is None
}
RATIONAL = [name for name, tableau in TABLEAUS.items() if tableau.exact is not None]
PAIRS = [name for name, tableau in EXPLICIT.items() if tableau.error is not None]
RATIONAL_PAIRS = [name for name in PAIRS if name in RATIONAL]
EXTENSIONS = [(name, key) for name, t in EXPLICIT.items() for key in t.extensions]
RATIONAL_EXTENSIONS = [(name, key) for name, key in EXTENSIONS if name in RATIONAL]
WHOLE_STEP = Fraction(1)
TIGHT = 3e-13  # rounding leaves 7e-14; a relative change of 1e-10 in any number of dop853 shows
THETAS = [Fraction(1, 7), Fraction(2, 5), Fraction(1, 2), Fraction(8, 9)]


@cache
def trees(order: int) -> tuple[Tree, ...]:
    """All rooted trees with that many nodes."""
    return tuple(forests(order - 1, (order, 0)))


def forests(nodes: int, largest: tuple[int, int]) -> Iterator[Tree]:
    """Multisets of trees with that many nodes in all, none after tree (order, index) largest."""
    if nodes == 0:
        yield ()
    for order in range(1, min(nodes, largest[0]) + 1):
        for index, tree in enumerate(trees(order)):
            if (order, index) <= largest:
                for rest in forests(nodes - order, (order, index)):
                    yield (tree, *rest)


@cache
def size(tree: Tree) -> int:
    return 1 + sum(map(size, tree))


@cache
def density(tree: Tree) -> int:
    """gamma(t)."""
    return size(tree) * prod(map(density, tree))


class Stages:
    """Elementary weights phi(t) of all stages of a matrix A, the end point and extras included."""

    def __init__(self, A: Array) -> None:
        self.A = A
        self.known: dict[Tree, Array] = {(): np.full(len(A), 1, dtype=A.dtype)}

    def phi(self, tree: Tree) -> Array:
        if tree not in self.known:
            factors = [self.A @ self.phi(child) for child in tree]
            self.known[tree] = np.multiply.reduce(factors)
        return self.known[tree]

    def residuals(self, weights: Array, order: int, theta: Fraction = WHOLE_STEP) -> list[Any]:
        """gamma w . phi - theta^order of the trees of one order."""
        target = theta**order if self.A.dtype == object else float(theta) ** order
        return [density(tree) * (weights @ self.phi(tree)) - target for tree in trees(order)]

    def holds_to(
        self, order: int, weights: Array, theta: Fraction = WHOLE_STEP, tolerance: float = 0.0
    ) -> bool:
        """Whether all conditions up to that order hold."""
        residuals = [r for p in range(1, order + 1) for r in self.residuals(weights, p, theta)]
        return bool(max(map(abs, residuals)) <= tolerance)


@cache
def stages_of(name: str, key: str | None = None) -> Stages:
    """The stages with the end point appended, and the extra stages of an extension, if any."""
    tableau = TABLEAUS[name]
    exact, s = tableau.exact, tableau.n_stages
    extra = 0 if key is None else tableau.extensions[key].n_extra
    if exact is not None:
        assert extra == 0
        A = np.full((s + 1, s + 1), Fraction(0), dtype=object)
        A[:s, :s], A[s, :s] = exact.A, exact.b
        return Stages(A)
    A = np.zeros((s + 1 + extra, s + 1 + extra))
    A[:s, :s], A[s, :s] = tableau.A, tableau.b
    if key is not None:
        A[s + 1 :] = tableau.extensions[key].extra_A
    return Stages(A)


def exact_of(name: str) -> ExactTableau:
    exact = TABLEAUS[name].exact
    assert exact is not None
    return exact


def exact_weights(name: str, key: str, theta: Fraction) -> Array:
    """w(theta) by its definition, as a sum over theta^a (1 - theta)^b."""
    rows = exact_of(name).extensions[key]
    factors = [theta ** (k // 2 + 1) * (1 - theta) ** ((k + 1) // 2) for k in range(len(rows))]
    return np.array(
        [
            sum(f * x for f, x in zip(factors, column, strict=True))
            for column in zip(*rows, strict=True)
        ],
        dtype=object,
    )


def test_the_tree_generator_finds_the_known_numbers_of_trees() -> None:
    assert [len(trees(n)) for n in range(1, 10)] == [1, 1, 2, 4, 9, 20, 48, 115, 286]
    assert len(set(trees(8))) == 115
    assert sorted(map(density, trees(4))) == [4, 8, 12, 24]


# Order of the weights


@pytest.mark.parametrize("name", RATIONAL)
def test_the_weights_of_a_rational_scheme_have_exactly_the_stated_order(name: str) -> None:
    order, stages = TABLEAUS[name].order, stages_of(name)
    b = np.array([*exact_of(name).b, Fraction(0)], dtype=object)
    assert stages.holds_to(order, b)
    assert not stages.holds_to(order + 1, b)


@pytest.mark.parametrize("name", RATIONAL_PAIRS)
def test_the_embedded_weights_have_exactly_the_stated_order(name: str) -> None:
    order, stages = TABLEAUS[name].embedded_order, stages_of(name)
    assert order is not None
    bhat = np.array(exact_of(name).bhat, dtype=object)
    assert stages.holds_to(order, bhat)
    assert not stages.holds_to(order + 1, bhat)


def test_dop853_satisfies_all_two_hundred_conditions_of_order_eight_but_not_order_nine() -> None:
    b, stages = np.append(TABLEAUS["dop853"].b, 0.0), stages_of("dop853")
    assert sum(len(stages.residuals(b, p)) for p in range(1, 9)) == 200
    assert stages.holds_to(8, b, tolerance=TIGHT)
    assert not stages.holds_to(9, b, tolerance=1e-2)


def test_the_error_estimate_of_dop853_compares_with_a_solution_of_order_five() -> None:
    tableau, stages = TABLEAUS["dop853"], stages_of("dop853")
    assert tableau.error is not None
    assert tableau.embedded_order == 5
    bhat = np.append(tableau.b, 0.0) - tableau.error
    assert stages.holds_to(5, bhat, tolerance=TIGHT)
    assert not stages.holds_to(6, bhat, tolerance=1e-2)


@pytest.mark.parametrize("name", RATIONAL)
def test_the_floats_of_a_rational_scheme_are_its_fractions_rounded_once(name: str) -> None:
    tableau, exact = TABLEAUS[name], exact_of(name)
    assert tableau.A.tolist() == [[float(x) for x in row] for row in exact.A]
    assert tableau.b.tolist() == [float(x) for x in exact.b]
    assert tableau.c.tolist() == [float(x) for x in exact.c]
    if exact.bhat is None:
        assert tableau.error is None
    else:
        assert tableau.error is not None
        padded = zip((*exact.b, Fraction(0)), exact.bhat, strict=True)
        assert tableau.error.tolist() == [float(b - bhat) for b, bhat in padded]
    for key, rows in exact.extensions.items():
        assert tableau.extensions[key].rows.tolist() == [[float(x) for x in row] for row in rows]


def test_a_step_costs_as_many_evaluations_as_published() -> None:
    assert list(EXPLICIT) == ["fe", "trap", "heun", "tvd32", "erk4", "dopr54", "dop853"]
    assert [tableau.n_stages for tableau in EXPLICIT.values()] == [1, 2, 2, 3, 4, 6, 12]
    rodas5p = TABLEAUS["rodas5p"]
    assert rodas5p.n_stages - rodas5p.lead == 8


class LinearStages(Stages):
    """Elementary weights of a linearly implicit scheme (Hairer and Wanner II, IV.7): a node with
    one child weighs it by alpha + gamma, one with several by alpha."""

    def __init__(self, tableau: ButcherTableau) -> None:
        assert tableau.implicit is not None
        super().__init__(tableau.A)
        self.B = tableau.A + tableau.implicit

    def phi(self, tree: Tree) -> Array:
        if tree not in self.known:
            weights = self.B if len(tree) == 1 else self.A
            self.known[tree] = np.multiply.reduce([weights @ self.phi(child) for child in tree])
        return self.known[tree]


def test_rodas5p_satisfies_all_conditions_of_order_five_but_not_order_six() -> None:
    tableau = TABLEAUS["rodas5p"]
    assert tableau.implicit is not None
    assert tableau.error is not None
    stages = LinearStages(tableau)
    assert sum(len(stages.residuals(tableau.b, p)) for p in range(1, 6)) == 17
    assert stages.holds_to(5, tableau.b, tolerance=TIGHT)
    assert not stages.holds_to(6, tableau.b, tolerance=1e-4)
    embedded = tableau.b - tableau.error[:-1]
    assert stages.holds_to(4, embedded, tolerance=TIGHT)
    assert not stages.holds_to(5, embedded, tolerance=1e-4)
    for theta in THETAS:
        weights = tableau.dense.weights(float(theta))[0][:-1]
        assert stages.holds_to(4, weights, theta, tolerance=1e-12)
    # Stiffly accurate: the last stage is the step.
    whole = tableau.A + tableau.implicit
    np.testing.assert_allclose(whole[-1], tableau.b, rtol=0.0, atol=1e-14)


def test_auto_is_dop853_with_rodas5p_for_stiff_problems() -> None:
    auto, dop853 = TABLEAUS["auto"], TABLEAUS["dop853"]
    assert auto.stiff is not None
    assert auto.stiff.name == "rodas5p"
    assert np.array_equal(auto.A, dop853.A)
    assert np.array_equal(auto.b, dop853.b)
    assert auto.member(True) is auto.stiff
    assert auto.member(False) is auto
    assert dop853.member(True) is dop853


def test_heun_is_the_explicit_midpoint_rule_of_the_thesis() -> None:
    heun = TABLEAUS["heun"]
    assert heun.c.tolist() == [0.0, 0.5]
    assert heun.b.tolist() == [0.0, 1.0]
    assert "midpoint" in heun.citation


# Continuous extensions


@pytest.mark.parametrize(("name", "key"), RATIONAL_EXTENSIONS)
def test_a_rational_extension_has_exactly_the_stated_order_at_every_theta(
    name: str, key: str
) -> None:
    order, stages = TABLEAUS[name].extensions[key].order, stages_of(name)
    for theta in THETAS:
        weights = exact_weights(name, key, theta)
        assert stages.holds_to(order, weights, theta)
        assert not stages.holds_to(order + 1, weights, theta)


def test_the_extension_of_dop853_has_order_seven_at_every_theta() -> None:
    dense, stages = TABLEAUS["dop853"].dense, stages_of("dop853", "dop853")
    assert (dense.order, dense.n_extra, dense.n_rates) == (7, 3, 16)
    for theta in THETAS:
        weights = dense.weights(float(theta))[0]
        assert stages.holds_to(7, weights, theta, tolerance=TIGHT)
        assert not stages.holds_to(8, weights, theta, tolerance=1e-3)


@pytest.mark.parametrize(("name", "key"), RATIONAL_EXTENSIONS)
def test_the_weights_are_the_exact_polynomials_up_to_rounding(name: str, key: str) -> None:
    computed = TABLEAUS[name].extensions[key].weights([float(theta) for theta in THETAS])
    exact = [exact_weights(name, key, theta).astype(float) for theta in THETAS]
    np.testing.assert_allclose(computed, exact, rtol=0.0, atol=2e-15)


def test_the_dopr54_extensions_match_their_published_monomials() -> None:
    t = Fraction(3, 7)
    thesis = exact_weights("dopr54", "thesis", t)
    F = Fraction
    assert thesis[0] == t * (1 + t * (F(-1337, 480) + t * (F(1039, 360) - F(1163, 1152) * t)))
    assert thesis[2] == F(100, 3) * t**2 * (
        F(1054, 9275) + t * (F(-4682, 27825) + F(379, 5565) * t)
    )
    assert thesis[3] == F(-5, 2) * t**2 * (F(27, 40) + t * (F(-9, 5) + F(83, 96) * t))
    assert thesis[4] == F(18225, 848) * t**2 * (F(-3, 250) + t * (F(22, 375) - F(37, 600) * t))
    assert thesis[5] == F(-22, 7) * t**2 * (F(-3, 10) + t * (F(29, 30) - F(17, 24) * t))
    assert thesis[1] == thesis[6] == 0
    # Shampine's formula in the coefficients of theta ... theta^4.
    smooth = exact_weights("dopr54", "C1", t)
    first = (
        F(1),
        F(-8048581381, 2820520608),
        F(8663915743, 2820520608),
        F(-12715105075, 11282082432),
    )
    last = (F(0), F(40617522, 29380423), F(-110615467, 29380423), F(69997945, 29380423))
    assert smooth[0] == sum(x * t ** (k + 1) for k, x in enumerate(first))
    assert smooth[6] == sum(x * t ** (k + 1) for k, x in enumerate(last))


@pytest.mark.parametrize(("name", "key"), EXTENSIONS)
def test_an_extension_joins_both_end_states_exactly(name: str, key: str) -> None:
    tableau = TABLEAUS[name]
    start, end = tableau.extensions[key].weights((0.0, 1.0))
    assert not start.any()
    assert end[: tableau.n_stages].tolist() == tableau.b.tolist()
    assert not end[tableau.n_stages :].any()


@pytest.mark.parametrize(("name", "key"), EXTENSIONS)
def test_only_the_thesis_extension_is_not_continuously_differentiable(name: str, key: str) -> None:
    tableau = TABLEAUS[name]
    extension = tableau.extensions[key]
    slopes = extension.derivative_weights((0.0, 1.0))
    end_rates = np.eye(extension.n_rates)[[0, tableau.n_stages]]
    smooth = np.abs(slopes - end_rates).max() < 1e-14
    assert smooth == (extension.continuity == 1) == (key != "thesis")


@pytest.mark.parametrize(("name", "key"), EXTENSIONS)
def test_derivative_weights_integrate_to_the_weights(name: str, key: str) -> None:
    extension = TABLEAUS[name].extensions[key]
    nodes, factors = np.polynomial.legendre.leggauss(4)  # exact for degree 7
    for theta in (0.2, 0.7, 1.0):
        slopes = extension.derivative_weights(theta * (nodes + 1.0) / 2.0)
        integral = theta / 2.0 * factors @ slopes
        np.testing.assert_allclose(integral, extension.weights(theta)[0], rtol=0.0, atol=1e-13)


def test_theta_may_be_a_scalar_or_a_vector_but_no_matrix() -> None:
    dense = TABLEAUS["dop853"].dense
    assert dense.weights(0.3).shape == dense.derivative_weights(0.3).shape == (1, 16)
    pair = dense.weights(np.array([0.3, 0.6]))
    assert pair.shape == (2, 16)
    assert pair[0].tolist() == dense.weights(0.3)[0].tolist()
    assert dense.weights([]).shape == (0, 16)
    with pytest.raises(ValueError, match=r"theta has shape \(2, 2\)"):
        dense.weights(np.zeros((2, 2)))


def test_the_default_extension_is_smooth_and_dopr54_also_has_that_of_the_thesis() -> None:
    defaults = {name: tableau.dense.name for name, tableau in EXPLICIT.items()}
    hermite = dict.fromkeys(["fe", "trap", "heun", "tvd32", "erk4"], "hermite")
    assert defaults == {**hermite, "dopr54": "C1", "dop853": "dop853"}
    assert list(TABLEAUS["dopr54"].extensions) == ["C1", "thesis"]
    assert all(tableau.dense.continuity == 1 for tableau in EXPLICIT.values())


# Behaviour on x' = cos t + sin^2 t - x^2, x = sin t


def rate(t: float, x: float) -> float:
    return float(np.cos(t) + np.sin(t) ** 2 - x * x)


def rates_of_step(
    tableau: ButcherTableau, extension: DenseExtension, t: float, h: float, x: float
) -> FloatArray:
    """K_0 ... K_s and the extra stages."""
    s = tableau.n_stages
    K = np.zeros(extension.n_rates)
    for i in range(s):
        K[i] = rate(t + h * tableau.c[i], x + h * float(tableau.A[i] @ K[:s]))
    K[s] = rate(t + h, x + h * float(tableau.b @ K[:s]))
    for i, c in enumerate(extension.extra_c):
        K[s + 1 + i] = rate(t + h * c, x + h * float(extension.extra_A[i] @ K))
    return K


def errors(tableau: ButcherTableau, extension: DenseExtension, steps: int) -> tuple[float, float]:
    """Largest error up to t = 3 at the ends of the steps, and inside of them."""
    h, x, at_ends, worst = 3.0 / steps, 0.0, 0.0, 0.0
    theta = np.linspace(0.0, 1.0, 6)
    weights = extension.weights(theta)
    for n in range(steps):
        K = rates_of_step(tableau, extension, n * h, h, x)
        inside = x + h * weights @ K
        worst = max(worst, float(np.abs(inside - np.sin((n + theta) * h)).max()))
        x += h * float(tableau.b @ K[: tableau.n_stages])
        at_ends = max(at_ends, abs(x - np.sin((n + 1) * h)))
    return at_ends, worst


def slope(values: Callable[[int], float], steps: list[int]) -> float:
    """Fitted exponent p of values ~ steps^-p."""
    return -fitted_order(steps, [values(n) for n in steps])


def steps_for(order: int) -> list[int]:
    return {1: [400, 800, 1600], 8: [10, 14, 20, 28]}.get(order, [80, 113, 160, 226])


@pytest.mark.parametrize(("name", "key"), EXTENSIONS)
def test_steps_and_dense_output_have_the_stated_orders_on_a_nonlinear_equation(
    name: str, key: str
) -> None:
    tableau = TABLEAUS[name]
    extension = tableau.extensions[key]
    steps = steps_for(tableau.order)
    found = {n: errors(tableau, extension, n) for n in steps}
    at_ends, inside = (slope(lambda n, k=k: found[n][k], steps) for k in range(2))
    assert at_ends == pytest.approx(tableau.order, abs=0.3)
    assert inside == pytest.approx(min(tableau.order, extension.order + 1), abs=0.3)


@pytest.mark.parametrize("name", PAIRS)
def test_the_error_estimate_falls_with_one_more_than_the_embedded_order(name: str) -> None:
    tableau = TABLEAUS[name]
    error, order = tableau.error, tableau.embedded_order
    assert error is not None
    assert order is not None

    def estimate(n: int) -> float:
        h = 1.0 / n
        K = rates_of_step(tableau, tableau.dense, 0.3, h, 0.7)[: tableau.n_stages + 1]
        return abs(h * float(error @ K))

    assert slope(estimate, [8, 12, 16]) == pytest.approx(order + 1, abs=0.3)


# Gaps between abscissae


def test_gaps_list_the_widest_interval_without_a_stage_first() -> None:
    assert TABLEAUS["dopr54"].gaps[0] == pytest.approx((0.55, 0.25))
    assert TABLEAUS["dop853"].gaps[0] == pytest.approx((7 / 15, 2 / 15))
    assert TABLEAUS["fe"].gaps == ((0.5, 0.5),)
    assert TABLEAUS["erk4"].gaps == ((0.25, 0.25), (0.75, 0.25))


@pytest.mark.parametrize("name", list(TABLEAUS))
def test_gaps_cover_the_step_and_hold_no_abscissa(name: str) -> None:
    tableau = TABLEAUS[name]
    assert sum(2.0 * half for _, half in tableau.gaps) == pytest.approx(1.0)
    for centre, half in tableau.gaps:
        assert np.abs(tableau.c - centre).min() > half - 1e-15


# Looking up


def test_a_tableau_is_found_by_name_or_passed_through() -> None:
    assert get_tableau("dop853") is TABLEAUS["dop853"]
    own = replace(TABLEAUS["erk4"], name="own")
    assert get_tableau(own) is own


@pytest.mark.parametrize("name", ["rk45", "", None, 5])
def test_an_unknown_name_is_refused_with_the_known_ones(name: Any) -> None:
    with pytest.raises(ValueError, match=r"no tableau .*fe, trap, heun, tvd32, erk4, dopr54"):
        get_tableau(name)


# Data that contradict each other


def changed(array: FloatArray, index: Any, value: float) -> FloatArray:
    copied = array.copy()
    copied[index] = value
    return copied


ERK4, DOPR54, DOP853 = TABLEAUS["erk4"], TABLEAUS["dopr54"], TABLEAUS["dop853"]


def test_a_tableau_without_an_extension_has_the_cubic_hermite_polynomial() -> None:
    own = TABLEAUS["erk4"]
    plain = ButcherTableau("plain", own.order, "", own.A, own.b, own.c)
    assert plain.extensions == {"hermite": plain.dense}
    for name in ("order", "continuity"):
        assert getattr(plain.dense, name) == getattr(own.extensions["hermite"], name)
    np.testing.assert_allclose(
        plain.dense.rows, own.extensions["hermite"].rows, rtol=0.0, atol=2e-16
    )
    copied = pickle.loads(pickle.dumps(plain))
    np.testing.assert_array_equal(copied.dense.rows, plain.dense.rows)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"A": changed(DOPR54.A, (5, 1), 355 / 33)}, r"row sum of A .* \(row 5\)"),
        ({"c": changed(DOPR54.c, 2, 0.31)}, r"row sum of A .* instead of 0.31 \(row 2\)"),
        ({"A": changed(DOPR54.A, (2, 4), 0.1)}, "not strictly lower triangular"),
        ({"A": changed(DOPR54.A, (3, 3), 0.1)}, "not strictly lower triangular"),
        ({"A": DOPR54.A[:5, :5]}, r"A has shape \(5, 5\) instead of \(6, 6\)"),
        ({"A": [[0.0], [0.2, 0.0]]}, "A is not an array of numbers"),
        ({"A": changed(DOPR54.A, (4, 0), np.nan)}, "A has an entry that is not finite"),
        ({"b": changed(DOPR54.b, 0, np.inf)}, "b has an entry that is not finite"),
        ({"b": changed(DOPR54.b, 0, 0.1)}, "sum of b"),
        ({"b": 1.0}, "b has shape"),
        ({"c": DOPR54.c[:, None]}, "c has shape"),
        ({"error": [0.5, -0.5]}, r"error has shape \(2,\) instead of \(7,\)"),
        ({"error": np.full(7, 0.1)}, "sum of error"),
        ({"error": None}, "go together"),
        ({"embedded_order": None}, "go together"),
        ({"controller_order": None}, "go together"),
        ({"extensions": {"thesis": DOPR54.extensions["thesis"]}}, "dense .'C1'. is not one of"),
        ({"dense": ERK4.dense, "extensions": ERK4.extensions}, "weighs 5 rates, not 7"),
        (
            {"dense": DOPR54.dense, "extensions": {"C1": DOPR54.dense}, "b": np.eye(6)[0]},
            "does not end at the end state",
        ),
        ({"dense": "C1"}, "dense is 'C1', not a DenseExtension"),
        ({"order": 6}, r"order of b is 6, but t\^5 is integrated with an error of"),
        ({"embedded_order": 5}, r"embedded_order is 5, but t\^4 is integrated"),
    ],
)
def test_a_contradictory_tableau_is_refused_by_name(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^tableau 'dopr54': .*{message}"):
        replace(DOPR54, **fields)


def test_an_extension_that_falsely_claims_an_order_is_refused() -> None:
    claim = replace(DOPR54.dense, order=5)
    said = r"^tableau 'dopr54': order of extension 'C1' is 5, but t\^4 is integrated"
    with pytest.raises(ValueError, match=said):
        replace(DOPR54, dense=claim, extensions={"C1": claim})


def test_an_extension_that_falsely_claims_to_be_smooth_is_refused() -> None:
    claim = replace(DOPR54.extensions["thesis"], continuity=1)
    with pytest.raises(ValueError, match=r"^tableau 'dopr54': extension 'thesis' is not C1"):
        replace(DOPR54, dense=claim, extensions={"thesis": claim})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"continuity": 2}, "continuity is 2"),
        ({"rows": DOP853.dense.rows[0]}, "rows has shape"),
        ({"rows": np.zeros((0, 16))}, "without any stage"),
        ({"rows": changed(DOP853.dense.rows, (4, 5), 242.2834)}, "row sum of rows"),
        ({"rows": changed(DOP853.dense.rows, (4, 5), np.nan)}, "rows has an entry"),
        ({"extra_A": DOP853.dense.extra_A[:2]}, r"extra_A has shape \(2, 16\)"),
        ({"extra_A": changed(DOP853.dense.extra_A, (0, 13), 0.1)}, "own or a later rate"),
        ({"extra_c": np.array([0.1, 0.2, 0.7])}, r"row sum of extra_A .* \(row 2\)"),
    ],
)
def test_a_contradictory_extension_is_refused_by_name(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^extension 'dop853': .*{message}"):
        replace(DOP853.dense, **fields)


# Immutability


def arrays_of(tableau: ButcherTableau) -> list[FloatArray]:
    found = [tableau.A, tableau.b, tableau.c]
    if tableau.error is not None:
        found.append(tableau.error)
    for extension in tableau.extensions.values():
        found += [extension.rows, extension.extra_A, extension.extra_c]
    return found


@pytest.mark.parametrize("name", list(TABLEAUS))
def test_all_data_are_read_only(name: str) -> None:
    tableau = TABLEAUS[name]
    for array in arrays_of(tableau):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0
    with pytest.raises(AttributeError):
        tableau.order = 9  # type: ignore[misc]
    with pytest.raises(TypeError):
        tableau.extensions["other"] = tableau.dense  # type: ignore[index]
    with pytest.raises(TypeError):
        TABLEAUS["other"] = tableau  # type: ignore[index]


def test_a_tableau_does_not_share_the_arrays_it_was_given() -> None:
    b = ERK4.b.copy()
    own = replace(ERK4, b=b)
    b[0] = 7.0
    assert own.b[0] == 1 / 6


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
@pytest.mark.parametrize("name", list(TABLEAUS))
def test_a_copied_or_pickled_tableau_is_equal_and_read_only_as_well(
    name: str, clone: Callable[[ButcherTableau], ButcherTableau]
) -> None:
    assert clone(TABLEAUS[name]) is TABLEAUS[name]  # by whose identity runs are saved
    tableau = replace(TABLEAUS[name])  # one of the user's
    cloned = clone(tableau)
    assert cloned is not tableau
    assert cloned.dense is cloned.extensions[cloned.dense.name]
    for ours, theirs in zip(arrays_of(tableau), arrays_of(cloned), strict=True):
        assert ours.tolist() == theirs.tolist()
        assert not theirs.flags.writeable
    assert (cloned.name, cloned.order) == (name, tableau.order)
    assert cloned.citation == tableau.citation
    if tableau.exact is not None:
        assert cloned.exact is not None
        assert cloned.exact.A == tableau.exact.A
