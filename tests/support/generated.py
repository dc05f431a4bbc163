"""Generated code called without the kernel, for comparison with Pinocchio and the reference."""

from __future__ import annotations

import ctypes
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.generated.code_cache import compile_and_load
from srm_mbs.integration.generated.expressions import Expression, live_nodes
from srm_mbs.integration.generated.source import source_of
from srm_mbs.integration.generated.structure import structure_of

_Numbers = ctypes.POINTER(ctypes.c_double)


class Terms(NamedTuple):
    """What ``srm_mbs_terms`` computes."""

    M: FloatArray
    nle: FloatArray
    tau: FloatArray
    g: FloatArray
    bias: FloatArray
    G: FloatArray
    status: int


def _pointer(array: FloatArray) -> Any:
    return array.ctypes.data_as(_Numbers)


class GeneratedFunction:
    """The generated function of a mechanism."""

    def __init__(self, mechanism: srm.Mechanism) -> None:
        constants = make_system(mechanism).constants()
        self.structure, parameters = structure_of(mechanism.model, constants)
        self.library, _ = compile_and_load(
            source_of(self.structure).text, lambda path: ctypes.CDLL(str(path))
        )
        sizes = (ctypes.c_int * 11).in_dll(self.library, "srm_mbs_sizes")
        self.k = np.zeros(sizes[6])
        self.library.srm_mbs_constants(_pointer(parameters), _pointer(self.k))

    def __call__(self, q: FloatArray, v: FloatArray) -> Terms:
        """The terms at q and v, of a mechanism without laws over time and bushings."""
        nv, rows = self.structure.nv, self.structure.rows
        M, G = np.zeros((nv, nv)), np.zeros((rows, nv))
        nle, tau, g, bias = np.zeros(nv), np.zeros(nv), np.zeros(rows), np.zeros(rows)
        entries = (_Numbers * max(rows, 1))(*(_pointer(row) for row in G))
        values, own = np.zeros(self.structure.held), np.zeros(nv)
        arrays = [_pointer(np.ascontiguousarray(x)) for x in (q, v, self.k)]
        out = [_pointer(x) for x in (M, nle, tau, tau, values, own, g, bias)]
        status = self.library.srm_mbs_terms(
            *arrays, None, ctypes.c_double(0.0), None, *out, entries, None, None
        )
        upper = M.T  # written column by column
        return Terms(upper + np.triu(upper, 1).T, nle, tau, g, bias, G, status)


_OPERATIONS: dict[str, Callable[..., float]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "negate": operator.neg,
    "sqrt": math.sqrt,
    "sin": math.sin,
    "cos": math.cos,
    "fabs": abs,
    "fmax": max,
    "fmin": min,
    "copysign": math.copysign,
    "choose": lambda condition, a, b: a if condition != 0.0 else b,
}


def values_of(expressions: Sequence[Expression], leaves: Mapping[Expression, float]) -> list[float]:
    """Numbers of ``expressions``, computed node by node in Python."""
    found = {leaf.number: value for leaf, value in leaves.items()}
    for node in live_nodes(expressions):
        if node.operation == "constant":
            found[node.number] = node.value
        elif node.operands:
            operands = [found[operand.number] for operand in node.operands]
            found[node.number] = _OPERATIONS[node.operation](*operands)
    return [found[expression.number] for expression in expressions]
