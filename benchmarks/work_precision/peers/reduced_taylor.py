"""Equations written by hand under heyoka's Taylor integrator, compiled for them (LLVM)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.work_precision.peers.base import (
    Array,
    NotApplicableError,
    Outcome,
    Peer,
    Run,
    RunFailedError,
    Runner,
    Setting,
)
from benchmarks.work_precision.problems.base import Problem, ReducedModel

TOLERANCES = tuple(10.0**-k for k in range(3, 16))
COMPACT_FROM = 4
"""States from which heyoka compiles loops instead of straight-line code, which for Andrews'
mechanism is faster and takes a twentieth of the time to compile."""


class Symbol:
    """An expression of heyoka, which NumPy's functions of objects take."""

    def __init__(self, expression: Any) -> None:
        self.expression = expression

    def _with(self, other: Any, operation: Callable[[Any, Any], Any]) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented
        value = other.expression if isinstance(other, Symbol) else float(other)
        return Symbol(operation(self.expression, value))

    def __add__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: a + b)

    def __radd__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: b + a)

    def __sub__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: a - b)

    def __rsub__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: b - a)

    def __mul__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: a * b)

    def __rmul__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: b * a)

    def __truediv__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: a / b)

    def __rtruediv__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: b / a)

    def __pow__(self, other: Any) -> Any:
        return self._with(other, lambda a, b: a**b)

    def __neg__(self) -> Symbol:
        return Symbol(-self.expression)

    def _of(self, name: str) -> Symbol:
        import heyoka

        return Symbol(getattr(heyoka, name)(self.expression))

    def sin(self) -> Symbol:
        return self._of("sin")

    def cos(self) -> Symbol:
        return self._of("cos")

    def sqrt(self) -> Symbol:
        return self._of("sqrt")

    def hypot(self, other: Symbol) -> Symbol:
        square: Symbol = self * self + other * other
        return square.sqrt()


def right_hand_side(model: ReducedModel) -> list[tuple[Any, Any]]:
    """Variables and their derivatives, as heyoka takes them."""
    import heyoka

    names = [heyoka.expression(f"y{i}") for i in range(len(model.start))]
    symbols = np.array([Symbol(name) for name in names], dtype=object)
    rates = [
        rate if isinstance(rate, Symbol) else float(rate) for rate in model.field(0.0, symbols)
    ]
    return [
        (name, rate.expression if isinstance(rate, Symbol) else heyoka.expression(rate))
        for name, rate in zip(names, rates)
    ]


class ReducedTaylor(Peer):
    """No simulator does this by itself: not counted among the peers in the ratios.  Compilation is
    part of the first, untimed call."""

    name = "taylor"
    title = "hand-written equations + heyoka"
    modules = ("heyoka",)

    def settings(self, problem: Problem) -> Sequence[Setting]:
        return [Setting("rtol", tolerance) for tolerance in TOLERANCES]

    def everyday(self, problem: Problem) -> Setting:
        return Setting("rtol", 1e-15)

    def prepare(self, problem: Problem) -> Runner:
        import heyoka

        model = problem.index_one or problem.reduced
        if model is None:
            raise NotApplicableError("there are no equations written by hand")
        equations = right_hand_side(model)
        expand = problem.expand if model is problem.reduced else np.asarray

        def at(setting: Setting) -> Run:
            compiled: list[Any] = []

            def run() -> Outcome:
                if not compiled:
                    compiled.append(
                        heyoka.taylor_adaptive(
                            equations,
                            list(model.start),
                            tol=setting.value,
                            compact_mode=len(model.start) >= COMPACT_FROM,
                        )
                    )
                integrator = compiled[0]
                integrator.time = 0.0
                integrator.state[:] = model.start
                # The samples begin with the time of the state.
                times = np.concatenate([[0.0], problem.times])
                status, _, _, steps, _, y = integrator.propagate_grid(times)
                if status != heyoka.taylor_outcome.time_limit:
                    raise RunFailedError(f"heyoka ends with {status}")
                observed: Array = np.array(y[1:])
                return Outcome(None, steps, observed=lambda: expand(observed))

            return run

        return at
