"""Newton's iteration and the rules by which it ends, on functions of one number."""

from __future__ import annotations

from collections.abc import Callable

from srm_mbs.dynamics.constraints.newton import newton


def iterated(
    residual: Callable[[float], float], slope: float, start: float, **rules: float
) -> tuple[float, float, int]:
    """Last point, error and number of evaluations of a chord iteration with this ``slope``."""
    count = 0

    def linearise(x: float) -> tuple[float, Callable[[], float | None]]:
        nonlocal count
        count += 1
        return abs(residual(x)), lambda: x - residual(x) / slope

    point, error = newton(start, linearise, 100, monotone=False, **rules)
    return point, error, count


def test_it_ends_where_what_is_left_is_rounding_that_no_step_halves() -> None:
    """A residual that has no zero: it falls to about 3e-12, above the tolerance, and no further."""

    def floored(x: float) -> float:
        return abs(x) + 3e-12

    _, error, count = iterated(floored, 1.0, 1.0, tolerance=1e-14, rounding=1e-9)
    assert 3e-12 <= error <= 2e-11
    assert count <= 4
    assert iterated(floored, 1.0, 1.0, tolerance=1e-14)[2] == 100


def test_slow_convergence_above_rounding_is_no_end() -> None:
    """A tenth of the error is gained by each step: it ends below rounding only."""
    _, error, count = iterated(lambda x: x, 10.0, 1.0, tolerance=1e-14, rounding=1e-3)
    assert 0.5e-3 < error <= 1e-3
    assert count > 60
