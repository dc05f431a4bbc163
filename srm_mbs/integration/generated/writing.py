"""Recorded expressions as C: statements in static single assignment, and loops over equal cells.

Pairs of equal operations are one statement of vectors (:mod:`srm_mbs.integration.generated.pairs`).
Nodes that depend on parameters alone are computed once per mechanism, in a function of their own.
"""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from srm_mbs.integration.generated.cells import LOOP_INDEX, PLACES, Loop, split_cells
from srm_mbs.integration.generated.expressions import (
    PARAMETER,
    VARIABLE,
    Expression,
    Guard,
    Output,
    live_nodes,
    roots_of,
)
from srm_mbs.integration.generated.pairs import Pair, find_pairs


class Written(NamedTuple):
    """The bodies of two C functions.

    Attributes
    ----------
    constants
        Assigns to k[0], k[1], ... what depends on parameters alone.
    terms
        Assigns to the outputs; reads k.
    constant_count
        Length of k.
    operations
        Statements of ``terms``.
    """

    constants: str
    terms: str
    constant_count: int
    operations: int


_INFIX = frozenset("+-*/")
TURNED_TOGETHER = 4
"""Angles of which one call computes sines and cosines: lanes of a vector."""


def _literal(value: float) -> str:
    return f"({value!r})" if value < 0.0 else repr(value)


class _Names:
    """How C reads each node, and pairs of nodes."""

    def __init__(self) -> None:
        self._names: dict[int, str] = {}
        self._pairs: dict[tuple[Expression, Expression], str] = {}

    def give(self, node: Expression, name: str) -> None:
        self._names[node.number] = name

    def give_pair(self, pair: tuple[Expression, Expression], name: str) -> None:
        self._pairs[pair] = name

    def of(self, node: Expression) -> str:
        if node.operation == "constant":
            return _literal(node.value)
        return self._names.get(node.number, node.text)

    def of_pair(self, first: Expression, second: Expression) -> str | None:
        """A vector of both, or their common number; None where they have no name together."""
        return self.of(first) if first is second else self._pairs.get((first, second))

    def operation(self, node: Expression) -> str:
        """The operation of ``node`` in C."""
        if not node.operands:
            return self.of(node)
        return _operation(node.operation, [self.of(operand) for operand in node.operands])

    def operation_of_pair(self, pair: Pair) -> str:
        """The operation of both nodes, whose operands have names together."""
        if _of_vectors(pair):
            operands = zip(pair.first.operands, pair.second.operands)
            return _operation(pair.first.operation, [str(self.of_pair(*both)) for both in operands])
        return f"{{{self.operation(pair.first)}, {self.operation(pair.second)}}}"


def _operation(operation: str, names: Sequence[str]) -> str:
    if operation in _INFIX:
        return f"{names[0]} {operation} {names[1]}"
    if operation == "negate":
        return f"-{names[0]}"
    if operation == "choose":
        return f"{names[0]} != 0.0 ? {names[1]} : {names[2]}"
    return f"{operation}({', '.join(names)})"


def _of_vectors(pair: Pair) -> bool:
    """Whether C has the operation of a pair for vectors; of others it computes each lane, and reads
    of a choice what it takes alone."""
    return pair.first.operation in _INFIX or pair.first.operation == "negate"


def _gather(pair: Pair, names: _Names) -> Iterator[str]:
    """Statements that put together operands of a pair that have no name together yet."""
    if not _of_vectors(pair):
        return
    for both in zip(pair.first.operands, pair.second.operands):
        if names.of_pair(*both) is None:
            name = f"g{both[0].number}_{both[1].number}"
            yield f"  const pair {name} = {{{names.of(both[0])}, {names.of(both[1])}}};"
            names.give_pair(both, name)


def _turn_together(
    live: Sequence[Expression], names: _Names, pairs: Mapping[int, Pair]
) -> tuple[list[str], set[int]]:
    """Statements with the sines and cosines of leaves, of several at a time, and their nodes."""
    turning = [node for node in live if node.operation in ("sin", "cos")]
    turning = [node for node in turning if node.operands[0].operation == "leaf"]
    # Those of a pair are neighbours.
    joined = [node for own in turning if own.number in pairs for node in pairs[own.number]]
    angles_of = dict.fromkeys(node.operands[0].number for node in (*joined, *turning))
    places = {number: place for place, number in enumerate(angles_of)}
    if len(places) < 2:
        return [], set()
    angles = ["0.0"] * (-(-len(places) // TURNED_TOGETHER) * TURNED_TOGETHER)
    for node in turning:
        place = places[node.operands[0].number]
        angles[place] = names.of(node.operands[0])
        block, lane = divmod(place, TURNED_TOGETHER)
        names.give(node, f"{node.operation}s{block}[{lane}]")
    statements = []
    for block in range(len(angles) // TURNED_TOGETHER):
        first = block * TURNED_TOGETHER
        given = ", ".join(angles[first : first + TURNED_TOGETHER])
        statements.append(f"  angles sins{block}, coss{block};")
        statements.append(f"  turn_all(&(angles){{{given}}}, &sins{block}, &coss{block});")
    return statements, {node.number for node in turning}


def write_c(outputs: Sequence[Output], guards: Sequence[Guard] = ()) -> Written:
    """``outputs`` as C, where all ``guards`` hold.

    It calls ``turn_all`` of :mod:`srm_mbs.integration.generated.source`.
    """
    loops, outputs, guards = split_cells(outputs, guards)
    out = _write_block(outputs, guards, _Names(), "k")
    for number, loop in enumerate(loops):
        names = _Names()
        for leaf, text in loop.leaves:
            names.give(leaf, text)
        block = _write_block(loop.outputs, loop.guards, names, "h")
        own = f"k + {out.constant_count} + {block.constant_count} * {LOOP_INDEX}"
        out = Written(
            out.constants + _in_loop(block.constants, f"double *h = {own};", number, loop, True),
            out.terms + _in_loop(block.terms, f"const double *h = {own};", number, loop, False),
            out.constant_count + loop.length * block.constant_count,
            out.operations + block.operations,
        )
    return out


def _in_loop(body: str, header: str, number: int, loop: Loop, of_parameters: bool) -> str:
    """A body that computes one cell, for all of a loop."""
    table = loop.parameter_places if of_parameters else loop.places
    rows = [f"{{{', '.join(map(str, places))}}}" for places in zip(*table)]
    lines = [f"  for (int {LOOP_INDEX} = 0; {LOOP_INDEX} < {loop.length}; ++{LOOP_INDEX}) {{"]
    if table:
        name = f"places{number}"
        size = f"[{loop.length}][{len(table)}]"
        lines.insert(0, f"  static const int {name}{size} = {{{', '.join(rows)}}};")
        lines.append(f"    const int *{PLACES} = {name}[{LOOP_INDEX}];")
    lines += [f"    {header}", textwrap.indent(body, "  "), "  }"]
    return "\n".join(["", *lines])


def _write_block(
    outputs: Sequence[Output], guards: Sequence[Guard], names: _Names, constants_in: str
) -> Written:
    """``outputs`` without loops; ``names`` has the leaves that C does not read by their texts."""
    pairs = find_pairs(outputs, guards)
    roots = roots_of(outputs, guards)
    live = live_nodes(roots)
    constants, count_of_constants = _write_constants(live, roots, pairs, names, constants_in)
    terms, done = _turn_together(live, names, pairs)
    count = len(outputs)

    def evaluate(root: Expression) -> str:
        nonlocal count
        for node in live_nodes((root,), done, pairs):
            if node.depends != VARIABLE or not node.operands:
                continue
            own = f"x{node.number}"
            pair = pairs.get(node.number)
            if pair is None:
                terms.append(f"  const double {own} = {names.operation(node)};")
                names.give(node, own)
            else:
                terms.extend(_gather(pair, names))
                terms.append(f"  const pair {own} = {names.operation_of_pair(pair)};")
                names.give_pair(pair, own)
                for lane, lane_node in enumerate(pair):
                    names.give(lane_node, f"{own}[{lane}]")
            count += 1
        return names.of(root)

    for guard in guards:
        value, bound = evaluate(guard.value), evaluate(guard.bound)
        terms.append(f"  if ({value} < {bound}) return 1;")
    waiting: dict[int, list[Output]] = defaultdict(list)
    for out in outputs:
        waiting[out.value.number].append(out)
    for out in outputs:
        evaluate(out.value)
        # A pair is stored at once, so that it need not be kept.
        for node in pairs.get(out.value.number, (out.value,)):
            for stored in waiting.pop(node.number, ()):
                terms.append(f"  {stored.target} = {names.of(node)};")
    return Written("\n".join(constants), "\n".join(terms), count_of_constants, count)


def _write_constants(
    live: Sequence[Expression],
    roots: Sequence[Expression],
    pairs: Mapping[int, Pair],
    names: _Names,
    constants_in: str,
) -> tuple[list[str], int]:
    """Statements with parameters and what depends on them alone, as far as the terms read it, and
    the length of their array, in which those of pairs are neighbours."""
    places: dict[int, list[int]] = defaultdict(list)
    alone: dict[int, None] = {}
    count = 0
    for node in live:
        if node.depends != VARIABLE:
            continue
        pair = pairs.get(node.number)
        if pair is None:
            alone |= dict.fromkeys(o.number for o in node.operands if o.depends == PARAMETER)
            continue
        for both in zip(pair.first.operands, pair.second.operands):
            if both[0].depends != PARAMETER:
                continue
            if both[0] is both[1]:
                alone[both[0].number] = None
            elif names.of_pair(*both) is None:
                names.give_pair(both, f"*(const pair_at *)({constants_in} + {count})")
                for operand in both:
                    places[operand.number].append(count)
                    count += 1
    alone |= dict.fromkeys(root.number for root in roots if root.depends == PARAMETER)
    for number in alone:
        if number not in places:
            places[number].append(count)
            count += 1
    statements = []
    for node in live:
        if node.depends != PARAMETER:
            continue
        if node.number in places:
            first, *others = (f"{constants_in}[{place}]" for place in places[node.number])
            statements.append(f"  {first} = {names.operation(node)};")
            statements += [f"  {other} = {first};" for other in others]
            names.give(node, first)
        elif node.operands:
            statements.append(f"  const double c{node.number} = {names.operation(node)};")
            names.give(node, f"c{node.number}")
    return statements, count
