"""Recorded expressions: folding, common subexpressions, and the C that they become."""

from __future__ import annotations

import pytest

from srm_mbs.integration.generated.expressions import (
    PARAMETER,
    Expression,
    Guard,
    Output,
    Recorder,
)
from srm_mbs.integration.generated.writing import write_c


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def x(recorder: Recorder) -> Expression:
    return recorder.leaf("q[0]")


@pytest.fixture
def y(recorder: Recorder) -> Expression:
    return recorder.leaf("q[1]")


@pytest.fixture
def p(recorder: Recorder) -> Expression:
    return recorder.leaf("p[0]", PARAMETER)


def test_constants_zeros_and_units_drop_out(recorder: Recorder, x: Expression) -> None:
    assert (2.0 * recorder.constant(3.0) - 5.0).value == 1.0
    assert (x * 0.0).is_zero
    assert (0.0 / x).is_zero
    for same in (x + 0.0, 0.0 + x, x - 0.0, 1.0 * x, x / 1.0, 0.0 - (0.0 - x), -1.0 * (x * -1.0)):
        assert same is x


def test_the_same_operation_is_recorded_once(x: Expression, y: Expression) -> None:
    assert x * y is y * x
    assert x + y is y + x
    assert x - y is not y - x
    assert x + (-y) is x - y
    assert -(x - y) is y - x
    assert (-x) * y is -(x * y)


def test_of_a_sum_and_one_of_its_terms_the_other_is_left_without_rounding(
    x: Expression, y: Expression
) -> None:
    assert (x + y) - y is x
    assert (x + y) - x is y
    assert (x - (x + y)) is -y
    assert (x - y) - x is -y
    assert (x - x).is_zero


def test_what_depends_on_parameters_alone_is_computed_apart(
    recorder: Recorder, x: Expression, p: Expression
) -> None:
    other = recorder.leaf("p[1]", PARAMETER)
    written = write_c([Output("M[0]", p * (other * x)), Output("M[1]", p + 1.0)])
    assert written.constants.splitlines() == ["  k[0] = p[0] * p[1];", "  k[1] = 1.0 + p[0];"]
    assert "p[" not in written.terms
    assert written.constant_count == 2
    # One product, and two stores.
    assert written.operations == 3


def test_unused_expressions_are_not_written(x: Expression, y: Expression) -> None:
    _ = x * y
    written = write_c([Output("g[0]", x + y)])
    assert written.terms.count("double") == 1
    assert "*" not in written.terms


def test_guards_come_before_the_outputs_that_they_protect(
    recorder: Recorder, x: Expression, p: Expression
) -> None:
    length = recorder.call("sqrt", x * x)
    written = write_c([Output("g[0]", 1.0 / length)], [Guard(length, p)])
    lines = written.terms.splitlines()
    guard = next(i for i, line in enumerate(lines) if "return 1;" in line)
    division = next(i for i, line in enumerate(lines) if "/" in line)
    assert guard < division
    assert lines[guard].strip().startswith("if (")


def test_a_choice_of_equal_expressions_is_none(recorder: Recorder, x: Expression) -> None:
    assert recorder.choose(x, x, x) is x
    written = write_c([Output("g[0]", recorder.choose(x, recorder.one, recorder.zero))])
    assert "q[0] != 0.0 ? 1.0 : 0.0" in written.terms


def _cells(recorder: Recorder, count: int, shared: int) -> list[Output]:
    """Equal cells that need one expression of ``shared`` operations."""
    common = recorder.leaf("q[0]")
    for _ in range(shared):
        common = common * common + 1.0
    return [
        Output(f"M[{i}]", common * recorder.leaf(f"v[{i * i}]") * recorder.leaf(f"p[{i}]", 1), i)
        for i in range(count)
    ]


def test_equal_cells_are_written_once(recorder: Recorder) -> None:
    written = write_c(_cells(recorder, 20, 0))
    assert "for (int c = 0; c < 20; ++c)" in written.terms
    assert "M[0 + 1 * c]" in written.terms
    assert ", {9}, {16}" in written.terms
    assert "for (int c = 0; c < 20; ++c)" in written.constants
    assert written.constant_count == 20
    assert written.operations < 8


def test_cells_that_share_most_of_their_operations_share_them(recorder: Recorder) -> None:
    written = write_c(_cells(recorder, 20, 50))
    assert "for" not in written.terms
    assert written.operations < 200
