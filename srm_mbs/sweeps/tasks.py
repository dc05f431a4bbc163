"""One case of a sweep, in any process: make the mechanism, simulate it, measure the run."""

from __future__ import annotations

import math
import os
import pickle
import platform
import threading
import time
import traceback
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from srm_mbs.api import Solution, simulate
from srm_mbs.assembly.assemble import assemble
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, SimulationError, printable, safe_repr
from srm_mbs.model.lazy import cached_property
from srm_mbs.simulation.result import check_run
from srm_mbs.sweeps.cases import RESERVED, STARTS, varied

Value = bool | int | float | str | None
Measure = Callable[[Solution], Mapping[str, Any]]

_PLAIN = frozenset((bool, int, float, str, type(None)))

ERROR = "error"
"""Status of a case that raised an exception."""
FASTEST = 1
"""Level of compression: higher ones make a mechanism hardly shorter."""


def standard_measures(solution: Solution) -> dict[str, Value]:
    """Default measures of a sweep, at the ends of a run only, so that long runs stay cheap.

    ``t_end`` (s) is the time at which the run ended, ``drift`` the closure error ||g|| (m, rad)
    there, ``energy_change`` (J) the change of kinetic plus potential energy since the start,
    ``steps`` the number of accepted steps, ``wall_time`` in seconds.
    """
    check_run(solution)
    # The energy of a divergent state overflows.
    with np.errstate(over="ignore", invalid="ignore"):
        if solution.t_eval is None and len(solution.segments) == 1:
            # What is known at the ends of steps needs no dense output.
            last = len(solution.t) - 1
            ends: Any = slice(None, None, last) if last else [0, 0]
            t, q, v = solution.t[ends], solution.q[ends], solution.v[ends]
            # Of a run with event actions only its segments have them.
            observables = solution.segments[0].observables
            g, _ = observables.closure_errors(t[1:], q[1:], v[1:])
            drift, energy = np.sqrt(g[0] @ g[0]), observables.energies(q, v).sum(axis=1)
        else:
            read = solution.at(solution.span)
            drift, energy = read.drift[1, 0], read.energy
    return {
        "t_end": solution.span[1],
        "drift": float(drift),
        "energy_change": float(energy[1] - energy[0]),
        "steps": solution.stats.steps,
        "wall_time": solution.stats.wall_time,
    }


@dataclass(frozen=True)
class Outcome:
    """The outcome of a case.

    Attributes
    ----------
    success, status, message
        Of the solution; False, ``"error"`` and the last line of the traceback after an exception.
    measures
        Name -> number, text or None; empty after an exception.
    traceback
        As text; empty without an exception.
    """

    success: bool
    status: str
    message: str
    measures: Mapping[str, Value]
    traceback: str = ""


def raised(error: BaseException) -> Outcome:
    """The outcome of a case that raised ``error``."""
    message = "".join(traceback.format_exception_only(error)).strip()
    return Outcome(False, ERROR, message, {}, "".join(traceback.format_exception(error)))


@dataclass(frozen=True)
class Task:
    """The common part of all cases of a sweep; see :func:`srm_mbs.sweep`."""

    source: Mechanism | Callable[..., Any]
    t_end: float
    measure: Measure
    options: Callable[[Mapping[str, Any]], Mapping[str, Any]] | None
    simulate_options: Mapping[str, Any]

    def run(self, parameters: Mapping[str, Any]) -> Outcome:
        """The outcome of one case; never raises an ``Exception``.

        Raises
        ------
        KeyboardInterrupt
            If the run was interrupted.
        """
        try:
            mechanism, chosen = self._made(parameters)
            if self.options is not None:
                chosen |= self.options(parameters)
            solution = _partial_if_failed(mechanism, chosen.pop("t_end", self.t_end), chosen)
            if solution.status == "interrupted":
                raise KeyboardInterrupt
            measures = checked_measures(self.measure(solution), parameters)
            return Outcome(solution.success, solution.status, solution.message, measures)
        except Exception as error:  # of the user's functions as well; the other cases go on
            return raised(error)

    @cached_property
    def _varied(self) -> tuple[str, ...]:
        return varied(self.source)

    def _made(self, parameters: Mapping[str, Any]) -> tuple[Mechanism, dict[str, Any]]:
        """The mechanism of a case, and its options."""
        chosen = dict(self.simulate_options)
        if not isinstance(self.source, Mechanism):
            made = self.source(**parameters)
            mechanism, more = made if isinstance(made, tuple) else (made, {})
            return mechanism, chosen | more
        values = {name: parameters[name] for name in self._varied if name in parameters}
        source = self.source.with_parameters(**values) if values else self.source
        start = {name: parameters[name] for name in STARTS if name in parameters}
        if "q" in start or "v" in start:
            state = assemble(source, **start)
            start = {"q0": state.q, "v0": state.v}
        return source, chosen | start


def _partial_if_failed(mechanism: Mechanism, t_end: float, options: dict[str, Any]) -> Solution:
    """The run, also one that failed: its row says so, without a warning."""
    try:
        return simulate(mechanism, t_end, **options | {"raise_on_failure": True})
    except SimulationError as error:
        partial: Solution = error.solution
        return partial


def checked_measures(
    measures: Mapping[str, Any], parameters: Mapping[str, Any]
) -> dict[str, Value]:
    """``measures`` as plain Python values.

    Raises
    ------
    InputError
        If they are not numbers, texts or None, or have the name of another column.
    """
    remedy = "Let measure= return a dictionary of numbers: name of a column -> number"
    if not isinstance(measures, Mapping):
        raise InputError(f"it returned {safe_repr(measures)}", element="measure", remedy=remedy)
    out: dict[str, Value] = {}
    for name, value in measures.items():
        if name in parameters or name in RESERVED:
            raise InputError(
                f"it returned {safe_repr(name)}, which is a column already",
                element="measure",
                remedy="Give the measure another name",
            )
        plain = value
        if type(value) not in _PLAIN:
            array = isinstance(value, np.generic | np.ndarray)
            plain = value.item() if array and not value.ndim else value
        if not isinstance(name, str) or not isinstance(plain, Value):
            raise InputError(
                f"it returned {safe_repr(name)}: {safe_repr(value)}",
                element="measure",
                remedy=remedy,
            )
        out[name] = plain
    return out


def packed(task: Task) -> bytes:
    """``task`` as bytes for another process.

    cloudpickle, which comes with Dask, also sends functions of the main script and lambdas.  Every
    chunk carries the bytes, and schedulers copy and look through them several times: a pickled
    mechanism is seven times as long as compressed.

    Raises
    ------
    InputError
        If it cannot be sent.
    """
    try:
        from cloudpickle import dumps
    except ImportError:
        from pickle import dumps
    try:
        return zlib.compress(dumps(task), FASTEST)
    except Exception as error:
        raise InputError(
            f"the runs cannot be sent to other processes: {printable(error)}",
            element="executor",
            remedy="Define the functions at the top of a module, install cloudpickle, or use a "
            "ThreadPoolExecutor",
        ) from error


@lru_cache(maxsize=2)
def _unpacked(data: bytes) -> Task:
    """The task of ``data``, made once in every process: this takes longer than a short run."""
    task: Task = pickle.loads(zlib.decompress(data))
    return task


class Ran(NamedTuple):
    """Outcomes of a chunk, from the worker that ran it.

    Attributes
    ----------
    outcomes
        Of its first cases, in order; of all of them unless the time limit ended it.
    seconds
        Time that they took.
    worker
        Host, process and thread.
    """

    outcomes: list[Outcome]
    seconds: float
    worker: tuple[str, int, int]


def run_chunk(
    task: Task | bytes,
    chunk: Sequence[Mapping[str, Any]],
    time_limit: float = math.inf,
    call: str = "",
) -> Ran:
    """Run several cases one after the other; this function is submitted to executors.

    No case begins once ``time_limit`` (s) has passed since the first did.  ``call`` names this call
    and no other: Dask runs calls with equal arguments once, and equal cases may differ in what the
    user's functions draw at random.
    """
    known = _unpacked(task) if isinstance(task, bytes) else task
    begin = time.perf_counter()
    outcomes: list[Outcome] = []
    seconds = 0.0
    for parameters in chunk:
        if outcomes and seconds > time_limit:
            break
        outcomes.append(known.run(parameters))
        seconds = time.perf_counter() - begin
    return Ran(outcomes, seconds, (platform.node(), os.getpid(), threading.get_ident()))
