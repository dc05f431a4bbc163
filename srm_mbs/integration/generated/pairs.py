"""Equal operations of a mechanism, which C computes two at a time.

The legs of a robot, or the cells of a parallel one, have the same statements with other numbers.
Two outputs whose graphs differ in leaves alone, as ``q[7]`` and ``q[18]``, and in what depends on
parameters, are computed together, each of their operations once for both: in the lanes of a vector
of two numbers, which every processor has.  Statements, their time and that of their compilation
are halved.  What both outputs share is computed once, as it is otherwise.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

from srm_mbs.integration.generated.expressions import (
    PARAMETER,
    VARIABLE,
    Expression,
    Guard,
    Output,
    live_nodes,
    roots_of,
)

LEAST_SAVED = 0.05
"""Part of the operations that pairs save at least: few are not worth the moves of numbers into
lanes and out of them."""
_FIRST = ("g", "bias", "G")
"""Outputs that are paired first: rows tie several bodies, and thereby the pairs of all of them."""


class Pair(NamedTuple):
    """Two nodes with the same operation, of which neither needs the other."""

    first: Expression
    second: Expression


def find_pairs(outputs: Sequence[Output], guards: Sequence[Guard]) -> dict[int, Pair]:
    """The pairs among the operations that depend on the state, by the numbers of both nodes."""
    live = live_nodes(roots_of(outputs, guards))
    shapes = _shapes(live)
    alike: dict[tuple[str, int], list[Expression]] = defaultdict(list)
    for name, output in sorted(
        ((_name(output.target), output) for output in outputs),
        key=lambda named: named[0] not in _FIRST,
    ):
        if _varies(output.value):
            alike[name, shapes[output.value.number]].append(output.value)
    pairs: dict[int, Pair] = {}
    for values in alike.values():
        for i, value in enumerate(values):
            for other in values[i + 1 :]:
                if value.number in pairs:
                    break
                if other.number not in pairs:
                    pairs |= _joined(value, other, pairs) or _joined(other, value, pairs) or {}
    saved, count = len(pairs) // 2, sum(map(_varies, live))
    return pairs if saved > LEAST_SAVED * count else {}


def _varies(node: Expression) -> bool:
    """Whether it is an operation that depends on the state."""
    return node.depends == VARIABLE and bool(node.operands)


def _name(target: str) -> str:
    return target.partition("[")[0]


def _shapes(live: Sequence[Expression]) -> dict[int, int]:
    """A number for the graph of each node, equal for those that differ in places of leaves and in
    what depends on parameters."""
    numbers: dict[object, int] = {}
    out: dict[int, int] = {}
    for node in live:
        key: object
        if node.depends == PARAMETER:
            key = PARAMETER
        elif node.operands:
            key = (node.operation, *[out[operand.number] for operand in node.operands])
        elif node.operation == "leaf":
            key = re.sub(r"\d+", "", node.text)
        else:
            key = node.value
        out[node.number] = numbers.setdefault(key, len(numbers))
    return out


def _joined(
    first: Expression, second: Expression, pairs: dict[int, Pair]
) -> dict[int, Pair] | None:
    """The pairs of operations that two nodes of one shape need, without those of ``pairs``; None
    where an operation has another partner already."""
    new: dict[int, Pair] = {}
    left = [(first, second)]
    while left:
        a, b = left.pop()
        if a is b or not _varies(a):
            continue
        known = [found for n in (a.number, b.number) if (found := pairs.get(n) or new.get(n))]
        if not known:
            new[a.number] = new[b.number] = Pair(a, b)
            left.extend(zip(a.operands, b.operands))
        elif any(found != (a, b) for found in known):
            return None
    return new
