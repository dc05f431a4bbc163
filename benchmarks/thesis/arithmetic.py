r"""Table 5.1 in the arithmetic of a textbook program, one floating-point operation at a time.

The last digits of y in that table are rounding: y adds up g/eps, and one rounding of g (1e-16) over
eps = 0.005 is 2e-14.  Which digits appear depends on the order of the operations; in the package's
matrix products that order is the machine's.  Here it is written out:

    x' = f - (B y_{s-1} + B (g/eps)),    y_s = y_{s-1} + g/eps,
    g = ((x_1^2 + x_2^2) - (exp(-2t) + sin^2 t))/2,
    K_i = h x',    x + (a_1 K_1 + a_2 K_2 + ...),    t = i h,

with sums from left to right that skip zeros, and weights that are multiples of a unit fraction
taken together, as in (K_1 + 2 K_2 + 2 K_3 + K_4)/6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

from srm_mbs.integration.methods.butcher import ExactRow
from srm_mbs.integration.methods.tableaus import get_tableau

Point = tuple[float, float]

START: Point = (1.0, 0.0)
EXTENSION = "thesis"


def _constraint(t: float, x: Point) -> float:
    sine = math.sin(t)
    return ((x[0] * x[0] + x[1] * x[1]) - (math.exp(-2.0 * t) + sine * sine)) / 2.0


def _rate(t: float, x: Point, y: float, pull: float) -> Point:
    """x' for y_{s-1} = ``y`` and g/eps = ``pull``."""
    f = (1.0 - math.exp(-t), math.cos(t) + math.exp(t) * math.sin(t))
    return (f[0] - (x[0] * y + x[0] * pull), f[1] - (x[1] * y + x[1] * pull))


def _combination(weights: Sequence[float], rates: Sequence[Point]) -> Point:
    """sum_i weights_i rates_i, rounded after every operation: Python's own sum compensates."""
    first = second = 0.0
    for weight, rate in zip(weights, rates):
        if weight:
            first += weight * rate[0]
            second += weight * rate[1]
    return first, second


def _moved(x: Point, weights: ExactRow, rates: Sequence[Point]) -> Point:
    """x + sum_i weights_i rates_i."""
    unit = min((abs(w) for w in weights if w), default=Fraction(1))
    if unit.numerator > 1 or any((w / unit).denominator > 1 for w in weights):
        unit = Fraction(1)
    first, second = _combination([float(w / unit) for w in weights], rates)
    return x[0] + first / unit.denominator, x[1] + second / unit.denominator


def _powers(rows: Sequence[ExactRow], stage: int) -> tuple[Fraction, ...]:
    """(p_1, ..., p_4) of the weight p_1 theta + ... + p_4 theta^4 of a rate, from nested rows."""
    f0, f1, f2, f3 = (row[stage] for row in rows)
    return f0 + f1, f2 + f3 - f1, -f2 - 2 * f3, f3


def _extended(
    x: Point, powers: Sequence[tuple[Fraction, ...]], theta: float, rates: Sequence[Point]
) -> Point:
    """The continuous extension at ``theta``."""
    square = theta * theta
    thetas = (theta, square, square * theta, square * square)
    weights = []
    for coefficients in powers:
        weight = 0.0
        for coefficient, power in zip(coefficients, thetas):
            weight += float(coefficient) * power
        weights.append(weight)
    first, second = _combination(weights, rates)
    return x[0] + first, x[1] + second


def problem_two_at_one(
    tableau: str, sweeps: int, eps: float = 0.005, h: float = 0.001, steps: int = 1000
) -> tuple[float, float, float]:
    """(x_1, x_2, y) of problem 2 after ``steps`` steps of SRM with own histories, y_0 = 0, T = I.

    y reaches the next sweep by the continuous extension of the thesis where the tableau has it,
    linearly otherwise.

    Raises
    ------
    ValueError
        For an unknown tableau, or one that is not rational.
    """
    scheme = get_tableau(tableau)
    exact, s = scheme.exact, scheme.n_stages
    if exact is None:
        raise ValueError(f"tableau {tableau!r} is not rational")
    c = [float(x) for x in exact.c]
    rows = exact.extensions.get(EXTENSION)
    powers = None if rows is None else [_powers(rows, j) for j in range(s)]
    states, y_end = [START] * sweeps, 0.0
    for n in range(steps):
        t, t_end = n * h, (n + 1) * h
        before = [0.0] * (s + 1)
        for k, start in enumerate(states):
            rates: list[Point] = []
            y_start = 0.0
            for j in range(s):
                x = _moved(start, exact.A[j], rates)
                time = t + c[j] * h
                pull = _constraint(time, x) / eps
                rate = _rate(time, x, before[j], pull)
                rates.append((h * rate[0], h * rate[1]))
                if j == 0:
                    y_start = before[0] + pull
            states[k] = _moved(start, exact.b, rates)
            y_end = before[s] + _constraint(t_end, states[k]) / eps
            after = []
            for j in range(s):
                if c[j] in (0.0, 1.0):
                    after.append(y_end if c[j] else y_start)
                elif powers is None:
                    after.append(y_start + c[j] * (y_end - y_start))
                else:
                    x = _extended(start, powers, c[j], rates)
                    after.append(before[j] + _constraint(t + c[j] * h, x) / eps)
            before = [*after, y_end]
    return (*states[-1], y_end)
