"""Recorded expressions as C: statements in static single assignment, and loops over equal cells.

Nodes that depend on parameters alone are computed once per mechanism, in a function of their own.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
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
    """How C reads each node."""

    def __init__(self) -> None:
        self._names: dict[int, str] = {}

    def give(self, node: Expression, name: str) -> None:
        self._names[node.number] = name

    def of(self, node: Expression) -> str:
        if node.operation == "constant":
            return _literal(node.value)
        return self._names.get(node.number, node.text)

    def operation(self, node: Expression) -> str:
        """The operation of ``node`` in C."""
        if not node.operands:
            return self.of(node)
        names = [self.of(operand) for operand in node.operands]
        if node.operation in _INFIX:
            return f"{names[0]} {node.operation} {names[1]}"
        if node.operation == "negate":
            return f"-{names[0]}"
        if node.operation == "choose":
            return f"{names[0]} != 0.0 ? {names[1]} : {names[2]}"
        return f"{node.operation}({', '.join(names)})"


def _turn_together(live: Sequence[Expression], names: _Names) -> tuple[list[str], set[int]]:
    """Statements with the sines and cosines of leaves, of several at a time, and their nodes."""
    turning = [node for node in live if node.operation in ("sin", "cos")]
    turning = [node for node in turning if node.operands[0].operation == "leaf"]
    places = {
        number: place for place, number in enumerate({n.operands[0].number: 0 for n in turning})
    }
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
    roots = roots_of(outputs, guards)
    live = live_nodes(roots)
    read = [o for node in live if node.depends == VARIABLE for o in node.operands] + roots
    # Parameters and what depends on them alone, as far as the terms read it, in their order.
    places: dict[int, int] = {}
    for node in read:
        if node.depends == PARAMETER:
            places.setdefault(node.number, len(places))
    constants = []
    for node in live:
        if node.depends != PARAMETER:
            continue
        place = places.get(node.number)
        if place is not None:
            constants.append(f"  {constants_in}[{place}] = {names.operation(node)};")
            names.give(node, f"{constants_in}[{place}]")
        elif node.operands:
            constants.append(f"  const double c{node.number} = {names.operation(node)};")
            names.give(node, f"c{node.number}")
    terms, done = _turn_together(live, names)
    count = len(outputs)

    def evaluate(root: Expression) -> str:
        nonlocal count
        for node in live_nodes((root,), done):
            if node.depends == VARIABLE and node.operands:
                terms.append(f"  const double x{node.number} = {names.operation(node)};")
                names.give(node, f"x{node.number}")
                count += 1
        return names.of(root)

    for guard in guards:
        value, bound = evaluate(guard.value), evaluate(guard.bound)
        terms.append(f"  if ({value} < {bound}) return 1;")
    for out in outputs:
        value = evaluate(out.value)
        terms.append(f"  {out.target} = {value};")
    return Written("\n".join(constants), "\n".join(terms), len(places), count)
