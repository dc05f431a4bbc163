"""Expressions of one function, recorded once.

A :class:`Recorder` makes the leaves: constants, parameters, and what is known at an evaluation
only.  Arithmetic on an :class:`Expression` records a node: constants fold, zeros and units drop
out, and the same operation on the same operands is the same node.
:mod:`srm_mbs.integration.generated.writing` writes them as C.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
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
        recorder = self.recorder
        return recorder.add(self, other if type(other) is Expression else recorder.node(other))

    def __radd__(self, other: Operand) -> Expression:
        return self.recorder.add(self.recorder.node(other), self)

    def __sub__(self, other: Operand) -> Expression:
        recorder = self.recorder
        return recorder.subtract(self, other if type(other) is Expression else recorder.node(other))

    def __rsub__(self, other: Operand) -> Expression:
        return self.recorder.subtract(self.recorder.node(other), self)

    def __mul__(self, other: Operand) -> Expression:
        recorder = self.recorder
        return recorder.multiply(self, other if type(other) is Expression else recorder.node(other))

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
            depends = max([operand.depends for operand in operands])
            found = self._nodes[key] = Expression(self, operation, operands, depends)
        return found

    def _record_two(self, operation: str, a: Expression, b: Expression) -> Expression:
        """The most frequent case of :meth:`_record`."""
        key = (operation, a.number, b.number)
        found = self._nodes.get(key)
        if found is None:
            depends = a.depends if a.depends > b.depends else b.depends
            found = self._nodes[key] = Expression(self, operation, (a, b), depends)
        return found

    def add(self, a: Expression, b: Expression) -> Expression:
        """a + b"""
        if a.depends == CONSTANT:
            if b.depends == CONSTANT:
                return self.constant(a.value + b.value)
            if a.value == 0.0:
                return b
        if b.depends == CONSTANT and b.value == 0.0:
            return a
        if b.operation == "negate":
            return self.subtract(a, b.operands[0])
        if a.operation == "negate":
            return self.subtract(b, a.operands[0])
        return self._record_two("+", *((a, b) if a.number <= b.number else (b, a)))

    def subtract(self, a: Expression, b: Expression) -> Expression:
        """a - b"""
        if b.depends == CONSTANT and b.value == 0.0:
            return a
        if a is b:
            return self.zero
        # Of a sum and one of its terms, the other term is left, without rounding.
        if a.operation == "+" and b in a.operands:
            return a.operands[1] if a.operands[0] is b else a.operands[0]
        if a.operation == "-" and a.operands[0] is b:
            return self.negate(a.operands[1])
        if b.operation == "-" and b.operands[0] is a:
            return b.operands[1]
        if b.operation == "+" and a in b.operands:
            return self.negate(b.operands[1] if b.operands[0] is a else b.operands[0])
        if a.depends == CONSTANT:
            if b.depends == CONSTANT:
                return self.constant(a.value - b.value)
            if a.value == 0.0:
                return self.negate(b)
        if b.operation == "negate":
            return self.add(a, b.operands[0])
        return self._record_two("-", a, b)

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
        return self._record_two("*", a, b)

    def divide(self, a: Expression, b: Expression) -> Expression:
        """a / b; the divisor is not the constant 0."""
        if b.depends == CONSTANT:
            return self.multiply(self.constant(1.0 / b.value), a)
        if a.is_zero:
            return a
        if a.operation == "negate":
            return self.negate(self.divide(a.operands[0], b))
        return self._record_two("/", a, b)

    def call(self, function: str, *operands: Expression) -> Expression:
        """A function of C's mathematics, of one argument or two."""
        return self._record(function, *operands)

    def choose(self, condition: Expression, a: Expression, b: Expression) -> Expression:
        """a where ``condition`` is not 0, else b; C computes both."""
        return a if a is b else self._record("choose", condition, a, b)


class Output(NamedTuple):
    """A result of the function: C assigns ``value`` to ``target``, for the cell of this number
    (:mod:`srm_mbs.integration.generated.cells`) or, if it is -1, for none."""

    target: str
    value: Expression
    cell: int = -1


class Guard(NamedTuple):
    """The function returns 1 where ``value`` is below ``bound``; the cell is that of an output."""

    value: Expression
    bound: Expression
    cell: int = -1


def roots_of(outputs: Iterable[Output], guards: Iterable[Guard]) -> list[Expression]:
    """The expressions of ``guards`` and then of ``outputs``."""
    tested = [node for guard in guards for node in (guard.value, guard.bound)]
    return tested + [output.value for output in outputs]


def live_nodes(
    roots: Iterable[Expression],
    done: set[int] | None = None,
    together: Mapping[int, Sequence[Expression]] | None = None,
) -> list[Expression]:
    """The nodes that ``roots`` need, each after its operands, but those ``done``, which grow.

    Of nodes that are computed ``together``, by the number of each, there is the first one, after
    the operands of all.
    """
    done = set() if done is None else done
    together = {} if together is None else together
    out: list[Expression] = []
    for root in roots:
        stack = [root]
        while stack:
            node = stack[-1]
            if node.number in done:
                stack.pop()
                continue
            nodes = together.get(node.number)
            operands = node.operands
            if nodes is not None:
                operands = tuple(operand for own in nodes for operand in own.operands)
            left = [operand for operand in operands if operand.number not in done]
            if left:
                left.reverse()
                stack += left
                continue
            stack.pop()
            if nodes is None:
                done.add(node.number)
                out.append(node)
            else:
                done.update([own.number for own in nodes])
                out.append(nodes[0])
    return out
