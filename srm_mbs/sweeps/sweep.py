"""``sweep``: many runs on an executor, each recorded as soon as it is finished."""

from __future__ import annotations

import inspect
import math
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple
from uuid import uuid4

from srm_mbs.api import simulate
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, get_logger, known_names, safe_repr
from srm_mbs.model.numbers import positive_integer
from srm_mbs.simulation.monitoring import Counted, counting
from srm_mbs.simulation.options import check_progress, checked_span
from srm_mbs.simulation.runner import mechanism_method
from srm_mbs.sweeps.cases import Case, listed
from srm_mbs.sweeps.journal import Journal
from srm_mbs.sweeps.results import Sweep
from srm_mbs.sweeps.tasks import (
    Measure,
    Outcome,
    Ran,
    Task,
    packed,
    raised,
    run_chunk,
    standard_measures,
)

log = get_logger(__name__)

MAX_PENDING_CHUNKS = 512
"""Most chunks that are submitted at once: each has a copy of the mechanism."""
LONGEST_CHUNK = 2.0
"""Time of a chunk of adaptive length, over the one it is to take, after which a worker begins no
further case."""
SHORTEST_TIME = 1e-6
"""Time (s) of a chunk below which it is not measured."""
_REFUSED_OPTIONS = {
    "q0": "Give it in the cases",
    "v0": "Give it in the cases",
    "progress": "Give True, or a function of (done, total)",
    "raise_on_failure": "Leave it out: runs that end early are rows that say why",
}
"""Options of ``simulate`` that a sweep does not accept, with the remedy."""


def sweep(
    mechanism: Mechanism | Callable[..., Any],
    cases: Any,
    t_end: float,
    *,
    measure: Measure = standard_measures,
    options: Callable[[Mapping[str, Any]], Mapping[str, Any]] | None = None,
    executor: Executor | None = None,
    chunk: int | None = None,
    resume: str | Path | None = None,
    parameters: Mapping[str, Any] | None = None,
    progress: bool | Counted = False,
    **simulate_options: Any,
) -> Sweep:
    """Simulate many cases to ``t_end`` (s), and record the measures of each.

    Parameters
    ----------
    mechanism
        A mechanism, whose cases differ in their start; or a function that makes the mechanism of a
        case, called with the parameters as keywords.  The function may return (mechanism, options)
        with options of :func:`srm_mbs.simulate`, such as a controller.
    cases
        A sequence of dictionaries of parameters, a mapping of names to such dictionaries, or a
        mapping of columns, parameter -> array with an entry or a row per case.  For a given
        mechanism the parameters are ``q0`` (nq,) and ``v0`` (nv,), a consistent state, or ``q`` and
        ``v`` as for :func:`srm_mbs.assemble`, joint -> value, from which the case is assembled;
        unspecified rates are those of least norm.  Parameters of its description
        (``mechanism.parameters``) may be among them: the case then runs on the mechanism of
        ``mechanism.with_parameters``.  None if ``parameters`` has the cases.
    t_end
        End of the runs (s).
    measure
        Solution -> dictionary of numbers, texts or None, the columns of the table; workers return
        only these.  By default :func:`srm_mbs.standard_measures`.
    options
        Parameters of a case -> further options of its run, ``t_end`` included.  With it the cases
        of a given mechanism may have other parameters as well.
    executor
        Any executor with the interface of ``concurrent.futures``; by default the cases run
        sequentially in this thread.  Threads share the mechanism; processes get it pickled.
    chunk
        Number of cases that a worker runs at a time, which are lost together if it dies.  By
        default as many as take about 0.05 s, by what the last ones took (with executors of other
        packages 1 s): a worker that dies then loses what it did in the last 0.1 s (2 s), and the
        case that it was at.
    resume
        A file to which every finished case is appended; the cases that it already has are read
        instead of being run.  Cases that raised an exception are repeated.
    parameters
        Further parameters of the cases as columns, name -> a value for each case; with ``cases``
        None they are the cases.
    progress
        True for a bar (on a terminal only), or a function of (done, total), called after each case.
    **simulate_options
        Options of :func:`srm_mbs.simulate` for all runs.

    Returns
    -------
    Sweep
        One row per case, in the given order, including failed cases: neither a run that raises nor
        a worker that dies ends the sweep.

    Raises
    ------
    InputError
        Before any run, for invalid cases or options, a file of another sweep, or functions that
        cannot be sent to other processes.
    """
    if not (isinstance(mechanism, Mechanism) or callable(mechanism)):
        raise InputError(
            f"{safe_repr(mechanism)} is neither a mechanism nor a function that makes one",
            element="mechanism",
            remedy="Give srm.load(...), or a function of the parameters of a case",
        )
    for name, function in {"measure": measure, "options": options}.items():
        if not callable(function) and (name == "measure" or function is not None):
            raise InputError(
                f"{name} = {safe_repr(function)} cannot be called",
                element=name,
                remedy="Give a function",
            )
    if chunk is not None:
        chunk = positive_integer(chunk, "chunk", "Give 1 or more", " of cases")
    if executor is not None and not hasattr(executor, "submit"):
        raise InputError(
            f"{safe_repr(executor)} has no submit",
            element="executor",
            remedy="Give an executor of the kind of concurrent.futures; of a Dask client its "
            "get_executor()",
        )
    check_progress(progress, "(done, total)")
    _check_options(simulate_options)
    if isinstance(simulate_options.get("events"), Iterator):  # read once, used by every run
        simulate_options["events"] = list(simulate_options["events"])
    given = listed(mechanism, cases, parameters, free=options is not None)
    _, t_end = checked_span(simulate_options.get("t0", 0.0), t_end)
    task = Task(mechanism, t_end, measure, options, simulate_options)
    if isinstance(mechanism, Mechanism):
        _ = mechanism.structure  # computed once, not by every worker

    with ExitStack() as stack:
        journal = None
        outcomes: dict[int, Outcome] = {}
        if resume is not None:
            journal = stack.enter_context(closing(Journal(resume, task, given)))
            outcomes |= journal.known
        resumed = len(outcomes)
        log.info("sweep of %d cases, %d of them known", len(given), resumed)
        report = stack.enter_context(counting(progress, "cases", len(given)))
        missing = [case for case in given if case.index not in outcomes]
        finished = stack.enter_context(closing(_finished(task, missing, executor, chunk)))
        for case, outcome in finished:
            outcomes[case.index] = outcome
            log.debug("cases[%r]: %s", case.name, outcome.message)
            if journal is not None:
                journal.add(case, outcome)
            if report is not None:
                report(len(outcomes), len(given))
    found = Sweep(given, [outcomes[case.index] for case in given], resumed)
    log.info("sweep ended: %s", found)
    return found


def _check_options(options: Mapping[str, Any]) -> None:
    """Refuse options that runs do not accept."""
    known = set(inspect.signature(simulate).parameters) - {"mechanism", "t_end"}
    for name in options:
        if name in _REFUSED_OPTIONS:
            raise InputError(
                f"a sweep has no option {name!r}", element=name, remedy=_REFUSED_OPTIONS[name]
            )
        if name not in known:
            raise InputError(
                f"there is no option {name!r}",
                element=name,
                remedy=known_names(sorted(known - set(_REFUSED_OPTIONS))),
            )
    mechanism_method(options.get("method", "psrm"), options.get("tableau"))


class _Pace(NamedTuple):
    """Lengths of adaptive chunks.

    Attributes
    ----------
    seconds
        Time that a chunk is to take: sending it takes about a hundredth of that, and a progress bar
        still moves.
    least_seconds
        Time that a chunk takes at least, although workers would end together more closely.
    growth
        Largest ratio of the lengths of a chunk and of the one that it follows from: the first run
        of a worker takes longer than others.
    pending
        Chunks that are submitted at once, if there are so many: more than the workers of most
        executors, whose number no interface tells.
    """

    seconds: float
    least_seconds: float
    growth: int
    pending: int


STANDARD = _Pace(0.05, 0.0, 4, 16)
"""With executors of the standard library."""
SCHEDULED = _Pace(1.0, 0.1, 64, 4)
"""With others, whose schedulers and workers, as those of Dask, spend 10 ms of CPU time on a chunk
beside what it computes: few chunks, at the beginning and at the end as well."""


class _Waiting:
    """The cases that no worker has, in chunks.

    Parameters
    ----------
    cases
        All of them.
    chunk
        Number of cases in each; None: as many as a worker runs in the time of ``pace``, by the last
        chunk that was finished, and fewer towards the end, so that workers end together.
    pace
        Of chunks of adaptive length.
    """

    def __init__(self, cases: Sequence[Case], chunk: int | None, pace: _Pace) -> None:
        self._cases = deque(cases)
        self._chunk, self._pace = chunk, pace
        self._size = self._least = 1
        self._workers: set[tuple[str, int, int]] = set()
        self.time_limit = math.inf if chunk is not None else LONGEST_CHUNK * pace.seconds
        """Seconds after which a worker returns what it has not begun."""

    @property
    def _parallel(self) -> int:
        """Number of workers that there may be."""
        return max(len(self._workers), os.cpu_count() or 1)

    @property
    def most_pending(self) -> int:
        """Number of chunks that may be with the executor at once.  If their length adapts there are
        few: one that each worker has, one that it takes next, and enough to find further workers.
        """
        return (
            MAX_PENDING_CHUNKS
            if self._chunk is not None
            else min(MAX_PENDING_CHUNKS, max(self._pace.pending, 2 * self._parallel))
        )

    def next_chunk(self) -> list[Case]:
        """The next cases; none if there are no more."""
        size = self._chunk
        if size is None:
            together = max(self._least, len(self._cases) // (2 * self._parallel))
            size = min(self._size, together)
        return [self._cases.popleft() for _ in range(min(size, len(self._cases)))]

    def learn(self, sent: Sequence[Case], ran: Ran) -> None:
        """Take back what a worker has not begun, and choose the length of the next chunks."""
        self._workers.add(ran.worker)
        self._cases.extendleft(reversed(sent[len(ran.outcomes) :]))
        rate, pace = len(ran.outcomes) / max(ran.seconds, SHORTEST_TIME), self._pace
        self._size = max(1, min(int(pace.seconds * rate), pace.growth * len(sent)))
        self._least = max(1, int(pace.least_seconds * rate))


def _finished(
    task: Task, cases: Sequence[Case], executor: Executor | None, chunk: int | None
) -> Generator[tuple[Case, Outcome]]:
    """Yield each case with its outcome, as soon as it is known."""
    if executor is None:
        for case in cases:
            yield case, task.run(case.parameters)
        return
    sent = task if isinstance(executor, ThreadPoolExecutor) else packed(task)
    standard = isinstance(executor, ThreadPoolExecutor | ProcessPoolExecutor)
    waiting = _Waiting(cases, chunk, STANDARD if standard else SCHEDULED)
    running: dict[Future[Ran], list[Case]] = {}
    done: SimpleQueue[Future[Ran]] = SimpleQueue()
    try:
        while True:
            while len(running) < waiting.most_pending and (part := waiting.next_chunk()):
                parameters = [case.parameters for case in part]
                call = uuid4().hex
                try:
                    future = executor.submit(run_chunk, sent, parameters, waiting.time_limit, call)
                except Exception as error:  # its workers have died, or it was shut down
                    yield from ((case, raised(error)) for case in part)
                else:
                    running[future] = part
                    future.add_done_callback(done.put)
            if not running:
                return
            future = done.get()
            part = running.pop(future)
            try:
                ran = future.result()
            except Exception as error:  # its worker died: the same failure for all
                yield from ((case, raised(error)) for case in part)
            else:
                waiting.learn(part, ran)
                yield from zip(part, ran.outcomes)
    finally:
        for future in running:
            future.cancel()
