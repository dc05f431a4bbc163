"""``sweep``: many runs on an executor, each kept as soon as it is finished."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from srm_mbs.api import simulate
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError
from srm_mbs.simulation.monitoring import Counted, counting
from srm_mbs.simulation.options import check_progress, checked_span
from srm_mbs.simulation.runner import mechanism_method
from srm_mbs.sweeps.cases import Case, listed
from srm_mbs.sweeps.journal import Journal
from srm_mbs.sweeps.results import Sweep
from srm_mbs.sweeps.tasks import (
    Measure,
    Outcome,
    Task,
    packed,
    raised,
    run_chunk,
    standard_measures,
)

log = logging.getLogger(__name__)

OUTSTANDING = 512
"""Chunks that an executor is given at once: each carries the mechanism, thousands would add up."""
_OF_THE_SWEEP = {
    "q0": "Give it in the cases",
    "v0": "Give it in the cases",
    "progress": "Give True, or a function of (done, total)",
    "raise_on_failure": "Leave it out: runs that end early are rows that say why",
}
"""Options of ``simulate`` that a sweep does not hand on, and what to do instead."""


def sweep(
    mechanism: Mechanism | Callable[..., Any],
    cases: Any,
    t_end: float,
    *,
    measure: Measure = standard_measures,
    options: Callable[[Mapping[str, Any]], Mapping[str, Any]] | None = None,
    executor: Executor | None = None,
    chunk: int = 1,
    resume: str | Path | None = None,
    progress: bool | Counted = False,
    **simulate_options: Any,
) -> Sweep:
    """Simulate many cases to ``t_end`` (s), and keep what ``measure`` says of each.

    Parameters
    ----------
    mechanism
        A mechanism, whose cases differ in their start; or a function that makes the one of a case,
        called with the parameters as keywords.  The function may return (mechanism, options): the
        options, such as a controller, go to :func:`srm_mbs.simulate`.
    cases
        A sequence of dictionaries of parameters, a mapping of names to such dictionaries, or a
        mapping of columns, parameter -> array with an entry or a row per case.  For a given
        mechanism the parameters are ``q0`` (nq,) and ``v0`` (nv,), a consistent state, or ``q`` and
        ``v`` as :func:`srm_mbs.assemble` takes them, joint -> value; it assembles the case, and
        rates not given are the least-norm ones.
    t_end
        End of the runs (s).
    measure
        Solution -> dictionary of numbers, texts or None, the columns of the table; only these come
        back from a worker.  By default :func:`srm_mbs.standard_measures`.
    options
        Parameters of a case -> further options of its run, ``t_end`` included.  With it the cases
        of a given mechanism may have other parameters, too.
    executor
        Any executor of the kind of ``concurrent.futures``; by default the cases run one after the
        other in this thread.  Threads share the mechanism; others get it pickled.
    chunk
        Cases that a worker is given at a time, and that are lost together if it dies.  More than
        one pays where a run takes less time than sending it.
    resume
        A file to which every finished case is appended, and from which those that it holds already
        are taken instead of being run.  Cases in which something was raised are tried again.
    progress
        True for a bar (on a terminal only), or a function of (done, total), called after each case.
    **simulate_options
        Options of :func:`srm_mbs.simulate` for all runs.

    Returns
    -------
    Sweep
        One row per case, in the order given, also of those that failed: neither a run that raises
        nor a worker that dies ends the sweep.

    Raises
    ------
    InputError
        For invalid cases or options, a file of another sweep, or functions that cannot be sent to
        other processes; before any run.
    """
    if not (isinstance(mechanism, Mechanism) or callable(mechanism)):
        raise InputError(
            f"{mechanism!r} is neither a mechanism nor a function that makes one",
            element="mechanism",
            remedy="Give srm.load(...), or a function of the parameters of a case",
        )
    for value, what in ((measure, "measure"), (options, "options")):
        if not (callable(value) or (value is None and what == "options")):
            raise InputError(
                f"{what} = {value!r} cannot be called", element=what, remedy="Give a function"
            )
    if not isinstance(chunk, int) or chunk < 1:
        raise InputError(
            f"chunk = {chunk!r} is not a positive number of cases",
            element="chunk",
            remedy="Give 1 or more",
        )
    if executor is not None and not hasattr(executor, "submit"):
        raise InputError(
            f"{executor!r} has no submit",
            element="executor",
            remedy="Give an executor of the kind of concurrent.futures; of a Dask client its "
            "get_executor()",
        )
    check_progress(progress, "(done, total)")
    _check_options(simulate_options)
    if isinstance(simulate_options.get("events"), Iterator):  # for every run
        simulate_options["events"] = list(simulate_options["events"])
    given = listed(mechanism, cases, free=options is not None)
    _, t_end = checked_span(simulate_options.get("t0", 0.0), t_end)
    task = Task(mechanism, t_end, measure, options, simulate_options)
    if isinstance(mechanism, Mechanism):
        _ = mechanism.structure  # found once, not by every worker

    with ExitStack() as stack:
        journal = None
        outcomes: dict[int, Outcome] = {}
        if resume is not None:
            journal = stack.enter_context(Journal(Path(resume), task, given))
            outcomes |= journal.known
        resumed = len(outcomes)
        log.info("sweep of %d cases, %d of them known", len(given), resumed)
        told = stack.enter_context(counting(progress, "cases", len(given)))
        missing = [case for case in given if case.index not in outcomes]
        finished = stack.enter_context(closing(_finished(task, missing, executor, chunk)))
        for case, outcome in finished:
            outcomes[case.index] = outcome
            log.debug("%s: %s", case.where, outcome.message)
            if journal is not None:
                journal.add(case, outcome)
            if told is not None:
                told(len(outcomes), len(given))
    found = Sweep(given, [outcomes[case.index] for case in given], resumed)
    log.info("sweep ended: %s", found)
    return found


def _check_options(options: Mapping[str, Any]) -> None:
    """Refuse options that no run would take."""
    known = set(inspect.signature(simulate).parameters) - {"mechanism", "t_end"}
    for name in options:
        if name in _OF_THE_SWEEP:
            raise InputError(
                f"a sweep has no option {name!r}", element=name, remedy=_OF_THE_SWEEP[name]
            )
        if name not in known:
            raise InputError(
                f"there is no option {name!r}",
                element=name,
                remedy=f"Known: {', '.join(sorted(known - set(_OF_THE_SWEEP)))}",
            )
    mechanism_method(options.get("method", "psrm"), options.get("tableau"))


def _finished(
    task: Task, cases: Sequence[Case], executor: Executor | None, chunk: int
) -> Generator[tuple[Case, Outcome]]:
    """Each case with its outcome, as soon as it is known."""
    if executor is None:
        for case in cases:
            yield case, task.run(case.parameters)
        return
    sent = task if isinstance(executor, ThreadPoolExecutor) else packed(task)
    chunks = iter([cases[k : k + chunk] for k in range(0, len(cases), chunk)])
    running: dict[Future[list[Outcome]], Sequence[Case]] = {}
    done: SimpleQueue[Future[list[Outcome]]] = SimpleQueue()
    try:
        while True:
            more = list(islice(chunks, OUTSTANDING - len(running)))
            for part in more:
                try:
                    future = executor.submit(run_chunk, sent, [case.parameters for case in part])
                except Exception as error:  # its workers are dead, or it was shut down
                    yield from ((case, raised(error)) for case in part)
                else:
                    running[future] = part
                    future.add_done_callback(done.put)
            if running:
                future = done.get()
                part = running.pop(future)
                yield from zip(part, _outcomes(future, len(part)))
            elif not more:
                return
    finally:
        for future in running:
            future.cancel()


def _outcomes(future: Future[list[Outcome]], count: int) -> Sequence[Outcome]:
    """The outcomes of a chunk of ``count`` cases; the same one for all if its worker is lost."""
    try:
        return future.result()
    except Exception as error:
        return [raised(error)] * count
