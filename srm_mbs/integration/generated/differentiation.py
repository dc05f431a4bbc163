"""Derivatives of recorded expressions, themselves recorded.

Along a direction, each node has the derivative that the chain rule gives it from those of its
operands (forward mode: A. Griewank, A. Walther, *Evaluating Derivatives*, 2nd edition, SIAM 2008,
chapter 3).  They are nodes of the same graph: zeros drop out, and what several directions share is
recorded once.  A direction names the rate of change of some leaves, which may be coordinates,
rates or parameters; nodes that do not depend on them are passed over.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from srm_mbs.integration.generated.expressions import Expression, live_nodes

Direction = Mapping[Expression, Expression]
"""Rates of change of leaves; that of other leaves is 0."""


def derivatives(
    values: Sequence[Expression], directions: Sequence[Direction]
) -> list[list[Expression]]:
    """The derivatives of ``values`` along each of the ``directions``.

    A maximum, a minimum or a choice has the derivative of the operand that it takes; |x| has that
    of x where x = 0.
    """
    live = live_nodes(values)
    moved = _moved(live, directions)
    out = []
    for number, direction in enumerate(directions):
        rates = {leaf.number: rate for leaf, rate in direction.items()}
        for node in live:
            if node.operands and moved[node.number] >> number & 1:
                rates[node.number] = _chain_rule(node, rates)
        out.append([rates.get(value.number, value.recorder.zero) for value in values])
    return out


def count_derivatives(values: Sequence[Expression], directions: Sequence[Direction]) -> int:
    """Nodes of ``values`` that move, added up over the ``directions``: a measure of the size of
    their derivatives that takes no recording."""
    live = live_nodes(values)
    moved = _moved(live, directions)
    return sum(moved[node.number].bit_count() for node in live if node.operands)


def _moved(live: Sequence[Expression], directions: Sequence[Direction]) -> dict[int, int]:
    """Of each node, the directions that may change it, as bits."""
    out: dict[int, int] = {}
    for number, direction in enumerate(directions):
        for leaf, rate in direction.items():
            if not rate.is_zero:
                out[leaf.number] = out.get(leaf.number, 0) | 1 << number
    for node in live:
        if node.operands:
            bits = 0
            for operand in node.operands:
                bits |= out.get(operand.number, 0)
            out[node.number] = bits
    return out


def _chain_rule(node: Expression, rates: Mapping[int, Expression]) -> Expression:
    zero = node.recorder.zero
    own = [rates.get(operand.number, zero) for operand in node.operands]
    if all(rate.is_zero for rate in own):
        return zero
    return _RULES[node.operation](node, own)


def _sum(_: Expression, rates: list[Expression]) -> Expression:
    return rates[0] + rates[1]


def _difference(_: Expression, rates: list[Expression]) -> Expression:
    return rates[0] - rates[1]


def _product(node: Expression, rates: list[Expression]) -> Expression:
    (a, b), (da, db) = node.operands, rates
    return da * b + a * db


def _quotient(node: Expression, rates: list[Expression]) -> Expression:
    b = node.operands[1]
    return (rates[0] - node * rates[1]) * (1.0 / b)


def _negative(_: Expression, rates: list[Expression]) -> Expression:
    return -rates[0]


def _square_root(node: Expression, rates: list[Expression]) -> Expression:
    return (0.5 / node) * rates[0]


def _sine(node: Expression, rates: list[Expression]) -> Expression:
    return node.recorder.call("cos", node.operands[0]) * rates[0]


def _cosine(node: Expression, rates: list[Expression]) -> Expression:
    return -(node.recorder.call("sin", node.operands[0]) * rates[0])


def _hyperbolic_tangent(node: Expression, rates: list[Expression]) -> Expression:
    return (1.0 - node * node) * rates[0]


def _absolute(node: Expression, rates: list[Expression]) -> Expression:
    sign = node.recorder.call("copysign", node.recorder.one, node.operands[0])
    return sign * rates[0]


def _exceeds(a: Expression, b: Expression) -> Expression:
    """Not 0 where a > b."""
    return a.recorder.call("fmax", a - b, a.recorder.zero)


def _larger(node: Expression, rates: list[Expression]) -> Expression:
    return node.recorder.choose(_exceeds(*node.operands), *rates)


def _smaller(node: Expression, rates: list[Expression]) -> Expression:
    return node.recorder.choose(_exceeds(*node.operands), rates[1], rates[0])


def _chosen(node: Expression, rates: list[Expression]) -> Expression:
    return node.recorder.choose(node.operands[0], rates[1], rates[2])


_RULES: dict[str, Callable[[Expression, list[Expression]], Expression]] = {
    "+": _sum,
    "-": _difference,
    "*": _product,
    "/": _quotient,
    "negate": _negative,
    "sqrt": _square_root,
    "sin": _sine,
    "cos": _cosine,
    "tanh": _hyperbolic_tangent,
    "fabs": _absolute,
    "fmax": _larger,
    "fmin": _smaller,
    "choose": _chosen,
}
