"""Expressions of one function, recorded once and written as straight-line C.

A :class:`Recorder` makes the leaves: constants, parameters, and what is known at an evaluation
only.  Arithmetic on an :class:`Expression` records a node: constants fold, zeros and units drop
out, and the same operation on the same operands is the same node.  Nodes that depend on parameters
alone are computed once per mechanism; :func:`write_c` writes them into a function of their own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Union

CONSTANT, PARAMETER, VARIABLE = range(3)
"""What an expression depends on: nothing, parameters, or the state as well."""

Operand = Union["Expression", float]


class Expression:
    """A node of the graph of a :class:`Recorder`.

    Attributes
    ----------
    operation
        An operator or a function of C, ``"constant"``, or ``"leaf"``.
    operands
        Its operands.
    depends
        CONSTANT, PARAMETER or VARIABLE.
    value
        Of a constant.
    text
        How C reads a leaf.
    """

    __slots__ = ("depends", "number", "operands", "operation", "recorder", "text", "value")

    def __init__(
        self,
        recorder: Recorder,
        operation: str,
        operands: tuple[Expression, ...],
        depends: int,
        value: float = math.nan,
        text: str = "",
    ) -> None:
        self.recorder, self.operation, self.operands = recorder, operation, operands
        self.depends, self.value, self.text = depends, value, text
        self.number = recorder.count
        recorder.count += 1

    @property
    def is_zero(self) -> bool:
        """Whether it is the constant 0."""
        return self.depends == CONSTANT and self.value == 0.0

    def __add__(self, other: Operand) -> Expression:
        return self.recorder.add(self, self.recorder.node(other))

    def __radd__(self, other: Operand) -> Expression:
        return self.recorder.add(self.recorder.node(other), self)

    def __sub__(self, other: Operand) -> Expression:
        return self.recorder.subtract(self, self.recorder.node(other))

    def __rsub__(self, other: Operand) -> Expression:
        return self.recorder.subtract(self.recorder.node(other), self)

    def __mul__(self, other: Operand) -> Expression:
        return self.recorder.multiply(self, self.recorder.node(other))

    def __rmul__(self, other: Operand) -> Expression:
        return self.recorder.multiply(self.recorder.node(other), self)

    def __truediv__(self, other: Operand) -> Expression:
        return self.recorder.divide(self, self.recorder.node(other))

    def __rtruediv__(self, other: Operand) -> Expression:
        return self.recorder.divide(self.recorder.node(other), self)

    def __neg__(self) -> Expression:
        return self.recorder.negate(self)


class Recorder:
    """Makes the expressions of one function; expressions of two recorders do not mix."""

    def __init__(self) -> None:
        self.count = 0
        self._nodes: dict[tuple[str | int, ...], Expression] = {}
        self._constants: dict[float, Expression] = {}
        self.zero, self.one = self.constant(0.0), self.constant(1.0)

    def constant(self, value: float) -> Expression:
        """A number."""
        found = self._constants.get(value)
        if found is None:
            found = Expression(self, "constant", (), CONSTANT, float(value))
            self._constants[value] = found
        return found

    def leaf(self, text: str, depends: int = VARIABLE) -> Expression:
        """A number that C reads as ``text``: a new node at each call."""
        return Expression(self, "leaf", (), depends, text=text)

    def node(self, operand: Operand) -> Expression:
        """``operand`` as an expression."""
        return operand if isinstance(operand, Expression) else self.constant(operand)

    def _record(self, operation: str, *operands: Expression) -> Expression:
        key: tuple[str | int, ...] = (operation, *[operand.number for operand in operands])
        found = self._nodes.get(key)
        if found is None:
            depends = max(operand.depends for operand in operands)
            found = Expression(self, operation, operands, depends)
            self._nodes[key] = found
        return found

    def add(self, a: Expression, b: Expression) -> Expression:
        """a + b"""
        if a.depends == CONSTANT:
            if b.depends == CONSTANT:
                return self.constant(a.value + b.value)
            if a.value == 0.0:
                return b
        if b.is_zero:
            return a
        if b.operation == "negate":
            return self.subtract(a, b.operands[0])
        if a.operation == "negate":
            return self.subtract(b, a.operands[0])
        return self._record("+", *((a, b) if a.number <= b.number else (b, a)))

    def subtract(self, a: Expression, b: Expression) -> Expression:
        """a - b"""
        if b.is_zero:
            return a
        if a is b:
            return self.zero
        # Of a sum and one of its terms, the other term is left, without rounding.
        if a.operation == "+" and b in a.operands:
            return a.operands[1] if a.operands[0] is b else a.operands[0]
        if a.operation == "-" and a.operands[0] is b:
            return self.negate(a.operands[1])
        if b.operation == "+" and a in b.operands:
            return self.negate(b.operands[1] if b.operands[0] is a else b.operands[0])
        if a.depends == CONSTANT:
            if b.depends == CONSTANT:
                return self.constant(a.value - b.value)
            if a.value == 0.0:
                return self.negate(b)
        if b.operation == "negate":
            return self.add(a, b.operands[0])
        return self._record("-", a, b)

    def negate(self, a: Expression) -> Expression:
        """-a"""
        if a.depends == CONSTANT:
            return self.constant(0.0 - a.value)
        if a.operation == "negate":
            return a.operands[0]
        if a.operation == "-":
            return self.subtract(a.operands[1], a.operands[0])
        return self._record("negate", a)

    def multiply(self, a: Expression, b: Expression) -> Expression:
        """a b"""
        if b.depends < a.depends:
            a, b = b, a
        if a.depends == CONSTANT:
            if b.depends == CONSTANT:
                return self.constant(a.value * b.value)
            if a.value == 0.0:
                return self.zero
            if a.value == 1.0:
                return b
            if a.value == -1.0:
                return self.negate(b)
        if a.operation == "negate":
            return self.negate(self.multiply(a.operands[0], b))
        if b.operation == "negate":
            return self.negate(self.multiply(a, b.operands[0]))
        # Factors that do not vary meet: their product is computed once.
        if a.depends < VARIABLE and b.depends == VARIABLE and b.operation == "*":
            factor, rest = b.operands
            if factor.depends < VARIABLE:
                return self.multiply(self.multiply(a, factor), rest)
        if a.depends == b.depends and a.number > b.number:
            a, b = b, a
        return self._record("*", a, b)

    def divide(self, a: Expression, b: Expression) -> Expression:
        """a / b; the divisor is not the constant 0."""
        if b.depends == CONSTANT:
            return self.multiply(self.constant(1.0 / b.value), a)
        if a.is_zero:
            return a
        if a.operation == "negate":
            return self.negate(self.divide(a.operands[0], b))
        return self._record("/", a, b)

    def call(self, function: str, *operands: Expression) -> Expression:
        """A function of C's mathematics, of one argument or two."""
        return self._record(function, *operands)

    def choose(self, condition: Expression, a: Expression, b: Expression) -> Expression:
        """a where ``condition`` is not 0, else b; C computes both."""
        return a if a is b else self._record("choose", condition, a, b)


class Output(NamedTuple):
    """A result of the function: C assigns ``value`` to ``target``."""

    target: str
    value: Expression


class Guard(NamedTuple):
    """The function returns 1 where ``value`` is below ``bound``."""

    value: Expression
    bound: Expression


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


def live_nodes(roots: Iterable[Expression], done: set[int] | None = None) -> list[Expression]:
    """The nodes that ``roots`` need, each after its operands, but those ``done``, which grow."""
    done = set() if done is None else done
    out: list[Expression] = []
    for root in roots:
        stack = [(root, False)]
        while stack:
            node, ready = stack.pop()
            if node.number in done:
                continue
            if ready or not node.operands:
                done.add(node.number)
                out.append(node)
                continue
            stack.append((node, True))
            stack.extend((operand, False) for operand in reversed(node.operands))
    return out


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
            return node.text
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
        angles[place] = node.operands[0].text
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
    """``outputs`` as C, in static single assignment, where all ``guards`` hold.

    It calls ``turn_all`` of :mod:`srm_mbs.integration.generated.source`.
    """
    roots = [node for guard in guards for node in guard] + [out.value for out in outputs]
    live = live_nodes(roots)
    read = [o for node in live if node.depends == VARIABLE for o in node.operands] + roots
    # Parameters and what depends on them alone, as far as the terms read it, in their order.
    places: dict[int, int] = {}
    for node in read:
        if node.depends == PARAMETER:
            places.setdefault(node.number, len(places))
    names = _Names()
    constants = []
    for node in live:
        if node.depends != PARAMETER:
            continue
        place = places.get(node.number)
        if place is not None:
            constants.append(f"  k[{place}] = {names.operation(node)};")
        elif node.operands:
            constants.append(f"  const double c{node.number} = {names.operation(node)};")
        names.give(node, node.text or f"c{node.number}" if place is None else f"k[{place}]")
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

    def check(guard: Guard) -> None:
        value, bound = evaluate(guard.value), evaluate(guard.bound)
        terms.append(f"  if ({value} < {bound}) return 1;")

    def assign(out: Output) -> None:
        value = evaluate(out.value)
        terms.append(f"  {out.target} = {value};")

    for guard in guards:
        check(guard)
    for out in outputs:
        assign(out)
    return Written("\n".join(constants), "\n".join(terms), len(places), count)
