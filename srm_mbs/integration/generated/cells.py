"""Equal cells of a mechanism, whose terms are the same statements at other places.

A cell is a subtree on the ground with the closures that begin in it: its outputs, its guards, and
all nodes that these need, which may be those of other cells as well.  Cells are equal if their
graphs differ in the places of leaves and outputs alone, as ``q[0]`` and ``q[2]`` do.  C computes
equal cells in a loop (:mod:`srm_mbs.integration.generated.writing`), so that statements and the
time of their compilation do not grow with the number of loops of a chain.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
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

FEWEST_EQUAL = 8
"""Equal cells from which on there is a loop."""
MOST_REPEATED = 1.5
"""Operations with loops, in which each cell computes what it shares with others, against those
without: at most."""
LOOP_INDEX, PLACES = "c", "at"
"""Names in C of the number of a cell in its loop, and of its row of a table of places."""


class Loop(NamedTuple):
    """Equal cells: the first of them, and where C finds the numbers of each.

    Attributes
    ----------
    length
        Number of cells.
    outputs, guards
        Those of the first one; targets are already those of each.
    leaves
        Leaves of the first one, and how C reads those of each.
    parameter_places, places
        Places (length,) of leaves that are parameters, and of other leaves and outputs: the columns
        of two tables.
    """

    length: int
    outputs: list[Output]
    guards: list[Guard]
    leaves: list[tuple[Expression, str]]
    parameter_places: list[tuple[int, ...]]
    places: list[tuple[int, ...]]


class SplitOutputs(NamedTuple):
    """Loops over equal cells, and the outputs and guards of no loop."""

    loops: list[Loop]
    outputs: list[Output]
    guards: list[Guard]


class _Cell(NamedTuple):
    """A cell: its outputs and guards, its nodes, and its graph without places."""

    outputs: list[Output]
    guards: list[Guard]
    nodes: list[Expression]
    graph: tuple[object, ...]


def split_cells(outputs: Sequence[Output], guards: Sequence[Guard]) -> SplitOutputs:
    """Find the equal cells among those of the outputs and guards."""
    of_cells: dict[int, tuple[list[Output], list[Guard]]] = defaultdict(lambda: ([], []))
    for output in outputs:
        of_cells[output.cell][0].append(output)
    for guard in guards:
        of_cells[guard.cell][1].append(guard)
    plain = SplitOutputs([], list(outputs), list(guards))
    if len(of_cells) < FEWEST_EQUAL:
        return plain
    equal: dict[tuple[object, ...], list[_Cell]] = defaultdict(list)
    for number in sorted(of_cells):
        if number >= 0:
            cell = _cell(*of_cells[number])
            equal[cell.graph].append(cell)
    groups = [cells for cells in equal.values() if len(cells) >= FEWEST_EQUAL]
    looped = {id(output) for cells in groups for cell in cells for output in cell.outputs}
    guarded = {id(guard) for cells in groups for cell in cells for guard in cell.guards}
    rest = [output for output in outputs if id(output) not in looped]
    others = [guard for guard in guards if id(guard) not in guarded]
    repeated = sum(len(cells) * _operations(cells[0].nodes) for cells in groups)
    repeated += _operations(live_nodes(roots_of(rest, others)))
    if repeated > MOST_REPEATED * _operations(live_nodes(roots_of(outputs, guards))):
        return plain
    return SplitOutputs([_loop(cells) for cells in groups], rest, others)


def _operations(nodes: Iterable[Expression]) -> int:
    return sum(node.depends == VARIABLE and bool(node.operands) for node in nodes)


def _cell(outputs: list[Output], guards: list[Guard]) -> _Cell:
    roots = roots_of(outputs, guards)
    nodes = live_nodes(roots)
    numbers = {node.number: i for i, node in enumerate(nodes)}
    graph: list[object] = []
    for node in nodes:
        if node.operation == "leaf":
            graph.append(_without_places(node.text))
        elif node.operands:
            graph.append((node.operation, *[numbers[o.number] for o in node.operands]))
        else:
            graph.append(node.value)
    targets = tuple(_without_places(output.target) for output in outputs)
    results = tuple(numbers[root.number] for root in roots)
    return _Cell(outputs, guards, nodes, (tuple(graph), results, targets))


_PLACE = re.compile(r"\[(\d+)\]")


def _without_places(text: str) -> str:
    return _PLACE.sub("[]", text)


def _loop(cells: Sequence[_Cell]) -> Loop:
    """The loop over equal cells."""
    first = cells[0]
    tables: tuple[list[tuple[int, ...]], list[tuple[int, ...]]] = [], []

    def reading(texts: Sequence[str], parameters: bool) -> str:
        """How C reads, in each cell, what it reads as ``texts`` in these cells."""
        table = tables[0 if parameters else 1]
        columns = iter(list(zip(*(map(int, _PLACE.findall(text)) for text in texts))))
        return _PLACE.sub(lambda _: f"[{_place(next(columns), table)}]", texts[0])

    leaves = []
    for nodes in zip(*(cell.nodes for cell in cells)):
        if nodes[0].operation == "leaf":
            texts = [node.text for node in nodes]
            leaves.append((nodes[0], reading(texts, nodes[0].depends == PARAMETER)))
    outputs = [
        own[0]._replace(target=reading([output.target for output in own], False))
        for own in zip(*(cell.outputs for cell in cells))
    ]
    return Loop(len(cells), outputs, first.guards, leaves, *tables)


def _place(column: tuple[int, ...], table: list[tuple[int, ...]]) -> str:
    """The place of a number in each cell: linear in the number of the cell, or in a table."""
    start, step = column[0], column[1] - column[0]
    if all(place == start + step * i for i, place in enumerate(column)):
        return f"{start} + {step} * {LOOP_INDEX}" if step else str(start)
    if column not in table:
        table.append(column)
    return f"{PLACES}[{table.index(column)}]"
