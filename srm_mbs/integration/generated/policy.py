"""When runs take generated code, and when it is compiled: the policy of ``backend="auto"``.

A run takes the code that is there when it begins, in this process or in the cache of the user, and
keeps it to its end; without code the kernel makes the run.  Once runs of a mechanism have used as
much CPU time as compiling it costs, a compiler works beside the program, for the runs to come: the
time lost is then at most as much again as that of a policy that knows the future (the ski rental
problem).  Runs go on with the kernel whatever becomes of it.

There is no thread: a run starts the compiler, and others look whether it has ended.  Generating the
code takes the run that does it about a tenth of the time of compilation.
"""

from __future__ import annotations

import os
import time
from threading import Lock
from typing import Any, NamedTuple

from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.mechanism import Mechanism
from srm_mbs.errors import InputError, get_logger
from srm_mbs.integration.generated.code import (
    arrivals,
    begin_compilation,
    cached_library,
    known_library,
    load_code,
    loaded_code,
    source_of_structure,
    structure_of_mechanism,
    take_compilation,
)
from srm_mbs.integration.generated.code_cache import (
    Compilation,
    CompilationError,
    keeps_any,
)
from srm_mbs.integration.generated.structure import Structure
from srm_mbs.model.mechanism import MechanismData, per_model

log = get_logger(__name__)

# CPU time of compiling n statements, within 40 % of what g++ 12 takes for bundled mechanisms with
# loops, of open ones up to 2.6 times: START_SECONDS + n (STATEMENT_SECONDS + n PAIR_SECONDS).
START_SECONDS = 0.09
STATEMENT_SECONDS = 2.2e-4
PAIR_SECONDS = 8e-9
STATEMENTS_GUESSED = 120
"""Statements for each coordinate, until they are counted: 60 to 120 in planar chains of loops, 300
in parallel robots.  Too low a guess costs another generation, too high a one a late compilation."""
MOST_GUESSED = 10_000
"""Statements that are guessed at most: long chains of equal loops have fewer."""


def compile_seconds(statements: int) -> float:
    """Estimate of the CPU time (s) of compiling code with ``statements``."""
    return START_SECONDS + statements * (STATEMENT_SECONDS + statements * PAIR_SECONDS)


class _Account:
    """CPU time that runs without code used, of mechanisms with the same numbers of elements.

    Attributes
    ----------
    used
        CPU time (s) since the last compilation.  Threads add to it without a lock, and may lose
        some.
    needed
        That at which the next one begins.
    """

    def __init__(self, coordinates: int) -> None:
        self.used = 0.0
        self.needed = compile_seconds(min(STATEMENTS_GUESSED * coordinates, MOST_GUESSED))


class _Use:
    """Knowledge about the code of a mechanism.

    Attributes
    ----------
    looked
        ``arrivals()`` when it was looked for last; -1 before.
    settled
        Whether there will be none.
    """

    def __init__(self, account: _Account) -> None:
        self.account = account
        self.looked = -1
        self.settled = False


class _Job(NamedTuple):
    """A compilation beside the program."""

    name: str
    structure: Structure
    parameters: FloatArray
    compilation: Compilation


_accounts: dict[tuple[int, ...], _Account] = {}
_lock = Lock()
"""Held by the thread that changes the job; others do not wait for it."""
_job: _Job | None = None
_failed = False
"""Whether a compilation failed: there is no other beside this program."""
_ended_by = 0
"""Process whose end ends the job."""


@per_model
def _use_of(mechanism: MechanismData) -> _Use:
    # Variants of one topology, each a mechanism of its own, have one account.  Others that have it
    # as well do no harm: what is compiled is the mechanism that made it full.
    model = mechanism.model
    elements = len(mechanism.loops), len(mechanism.forces), len(mechanism.drives)
    key = (int(model.njoints), int(model.nq), int(model.nv), *elements)
    return _Use(_accounts.setdefault(key, _Account(key[2])))


def code_at_hand(mechanism: Mechanism) -> Any:
    """The ``GeneratedTerms`` of a mechanism that this process or the cache has; None without them.

    The first call for a mechanism takes 1 ms where the cache has any code; later ones 1 us, until
    other code arrives.
    """
    found = loaded_code(mechanism)
    if found is not None:
        return found
    use = _use_of(mechanism)
    if use.settled:
        return None
    if _job is not None:
        _advance()
    now = arrivals()
    if use.looked == now or (now == 0 and not keeps_any()):
        use.looked = now
        return None
    use.looked = now
    try:
        return load_code(mechanism, compiles=False)
    except InputError as error:
        _settle(mechanism, use, error)
        return None


def code_of_run(by: str, asked: str, mechanism: Mechanism) -> tuple[str, Any]:
    """Backend of a run of ``mechanism``, and its ``GeneratedTerms`` or None.

    Parameters
    ----------
    by
        From :func:`~srm_mbs.integration.kernel.backend.chosen_backend`, or the backend of the
        segment before.
    asked
        The option ``backend``: with ``"auto"``, the kernel runs where there can be no code.

    Raises
    ------
    InputError
        If generated code is insisted on and cannot be made.
    """
    if by == "auto":
        found = code_at_hand(mechanism)
        return "kernel" if found is None else "generated", found
    if by != "generated":
        return by, None
    try:
        return by, load_code(mechanism)
    except InputError as error:
        if asked != "auto":
            raise
        log.info("the kernel makes this run without generated code: %s", error)
        return "kernel", None


class Meter:
    """Charges the CPU time of this thread from now on to a mechanism; see :func:`charge`."""

    __slots__ = ("_last", "_mechanism")

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism
        self._last = time.thread_time()

    def __call__(self) -> None:
        """Charge the time since the last call."""
        now = time.thread_time()
        charge(self._mechanism, now - self._last)
        self._last = now


def charge(mechanism: Mechanism, seconds: float) -> None:
    """Count CPU time (s) that a run of ``mechanism`` used without code, and compile it if it is
    time to.  Nothing is raised: a run goes on whatever becomes of its code."""
    use = _use_of(mechanism)
    if use.settled:
        return
    account = use.account
    account.used += seconds
    if _job is not None or account.used >= account.needed:
        _advance(mechanism)


def _advance(mechanism: Mechanism | None = None) -> None:
    """See to the job, and begin that of ``mechanism`` if there is none."""
    global _failed
    if not _lock.acquire(blocking=False):
        return
    try:
        if _job is not None:
            _collect(_job)
        if _job is None and mechanism is not None and not _failed:
            use = _use_of(mechanism)
            if use.account.used >= use.account.needed:
                _begin(mechanism, use)
    except CompilationError as error:
        _failed = True
        log.info("no mechanism is compiled beside this program any more: %s", error)
    except Exception:
        # A run must not end because something about its code was not foreseen.
        _failed = True
        log.warning("no mechanism is compiled beside this program any more", exc_info=True)
    finally:
        _lock.release()


def _collect(job: _Job) -> None:
    """Take the code of the job, if the compiler has ended."""
    global _job
    compilation = job.compilation
    try:
        if not compilation.poll():
            return
        # A call of srm.compile may have ended it, to make the same itself.
        if known_library(job.structure) is None and not compilation.ended:
            compiled = take_compilation(job.structure, job.parameters, compilation).compiled
            log.info("%s: code compiled in %.2f s, for runs to come", job.name, compiled.seconds)
    except BaseException:
        _job = None
        compilation.end()
        raise
    _job = None
    compilation.end()


def _begin(mechanism: Mechanism, use: _Use) -> None:
    """Find or compile the code of a mechanism whose account is full."""
    global _job
    account = use.account
    try:
        structure, parameters = structure_of_mechanism(mechanism)
        if cached_library(structure, parameters) is not None:  # of another process
            account.used = 0.0
            return
        source = source_of_structure(structure)
    except InputError as error:
        account.used = 0.0
        _settle(mechanism, use, error)
        return
    account.needed = compile_seconds(source.operations)
    if account.used < account.needed:
        return
    account.used = 0.0
    compilation = begin_compilation(structure, source)
    if compilation is None:
        log.info("%s: code is compiled by another process", mechanism.name)
        return
    _job = _Job(mechanism.name, structure, parameters, compilation)
    log.info("%s: %d statements are compiled", mechanism.name, source.operations)
    _end_with_process()


def _settle(mechanism: Mechanism, use: _Use, error: InputError) -> None:
    use.settled = True
    log.info("%s: runs are made by the kernel: %s", mechanism.name, error)


def _end_with_process() -> None:
    """Let the job end with this process, which may be a worker that skips ``atexit``."""
    global _ended_by
    from multiprocessing.util import Finalize

    if _ended_by != os.getpid():
        _ended_by = os.getpid()
        Finalize(None, _end, exitpriority=0)


def _end() -> None:
    """End the job; what it has made is kept."""
    global _job, _failed
    job, _job, _failed = _job, None, True
    if job is None:
        return
    try:
        if job.compilation.poll():
            job.compilation.load(lambda path: None)
    except CompilationError as error:
        log.info("%s", error)
    finally:
        job.compilation.end()


def _forget_job() -> None:
    """In a fork: the job is that of the process before."""
    global _lock, _job
    _lock, _job = Lock(), None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_job)
