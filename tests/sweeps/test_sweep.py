"""Sweeps: the same numbers on every executor, nothing lost and nothing twice."""

from __future__ import annotations

import csv
import io
import json
import logging
import multiprocessing
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from benchmarks import sweep_throughput as throughput
from srm_mbs.sweeps.fingerprint import fingerprint
from srm_mbs.sweeps.tasks import Outcome, Ran
from tests.support.snapshots import check_messages, check_refusals, refused
from tests.support.sweeping import deadly, drawn, dying_once, lowest, pendulum, period, states

COUNT = 5
SPEEDS = np.linspace(0.5, 2.5, COUNT)
spawning = multiprocessing.get_context("spawn")


@pytest.fixture(scope="module")
def four_bar() -> srm.Mechanism:
    return srm.load("four_bar")


@pytest.fixture(scope="module")
def processes() -> Iterator[Executor]:
    """Two processes that inherit nothing."""
    with ProcessPoolExecutor(2, mp_context=spawning) as executor:
        yield executor


def starts(mechanism: srm.Mechanism) -> dict[str, Any]:
    """Columns of initial states: the mechanism's own, at several speeds."""
    unit = mechanism.v0 / np.abs(mechanism.v0).max()
    return {"q0": np.tile(mechanism.q0, (COUNT, 1)), "v0": np.outer(SPEEDS, unit)}


def check_against_single_runs(sweep: srm.Sweep, mechanism: srm.Mechanism, t_end: float) -> None:
    assert len(sweep) == COUNT
    assert not sweep.failures
    columns = starts(mechanism)
    for k, (q0, v0) in enumerate(zip(columns["q0"], columns["v0"])):
        single = states(srm.simulate(mechanism, t_end, q0=q0, v0=v0, rtol=1e-8))
        for name, value in single.items():
            if name != "process":
                assert sweep.table[name][k] == value, (k, name)


@pytest.mark.parametrize("workers", ["none", "threads", "processes"])
@pytest.mark.parametrize("chunk", [None, 1, 2])
def test_every_executor_gives_the_numbers_of_single_runs(
    workers: str, chunk: int | None, four_bar: srm.Mechanism, request: pytest.FixtureRequest
) -> None:
    with ThreadPoolExecutor(2) as threads:
        executor = {
            "none": lambda: None,
            "threads": lambda: threads,
            "processes": lambda: request.getfixturevalue("processes"),
        }[workers]()
        sweep = srm.sweep(
            four_bar,
            starts(four_bar),
            1.0,
            measure=states,
            executor=executor,
            chunk=chunk,
            rtol=1e-8,
        )
    check_against_single_runs(sweep, four_bar, 1.0)
    elsewhere = set(sweep.table["process"].tolist()) - {os.getpid()}
    assert bool(elsewhere) == (workers == "processes")


class Backwards(Executor):
    """Runs what it was given when it is asked for the last of ``count``, last first."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._given: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._given.append((future, partial(fn, *args, **kwargs)))
        if len(self._given) == self._count:
            for waiting, call in reversed(self._given):
                waiting.set_result(call())
        return future


class Recorded(ThreadPoolExecutor):
    """Runs each chunk at once, and records how many cases it had and how many were run."""

    def __init__(self) -> None:
        super().__init__(1)
        self.chunks: list[tuple[int, int]] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        ran = fn(*args, **kwargs)
        self.chunks.append((len(args[1]), len(ran.outcomes)))
        future.set_result(ran)
        return future


class Clock:
    """A clock that only :meth:`wait` moves."""

    def __init__(self) -> None:
        self.now = 0.0

    def wait(self, parameters: Any) -> dict[str, Any]:
        """Let the time pass that a case is to take, as the function of its options."""
        self.now += parameters["seconds"]
        return {}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr("srm_mbs.sweeps.tasks.time.perf_counter", lambda: found.now)
    return found


def waited(seconds: Sequence[float], clock: Clock, **options: Any) -> Recorded:
    """The chunks of a sweep over cases that take these times (s)."""
    executor = Recorded()
    cases = {"seconds": list(seconds)}
    sweep = srm.sweep(
        pendulum(),
        cases,
        1e-3,
        measure=lambda solution: {},
        options=clock.wait,
        executor=executor,
        **options,
    )
    assert sweep.table["seconds"].tolist() == cases["seconds"]
    assert not sweep.failures
    return executor


def test_chunks_are_as_long_as_their_cases_are_short(clock: Clock) -> None:
    short = waited([1e-3] * 2000, clock)
    assert max(sent for sent, _ in short.chunks) == 50
    assert short.chunks[-1][0] == 1  # workers end together
    long = waited([0.2] * 20, clock)
    assert set(long.chunks) == {(1, 1)}


def test_a_worker_returns_the_cases_that_it_has_no_time_for(clock: Clock) -> None:
    executor = waited([1e-3] * 1500 + [0.06] * 100, clock)
    returned = [(sent, ran) for sent, ran in executor.chunks if ran < sent]
    assert returned
    assert all(ran >= 1 for _, ran in returned)
    assert sum(ran for _, ran in executor.chunks) == 1600
    assert max(sent for sent, _ in executor.chunks[-20:]) == 1


def test_a_chunk_that_is_given_is_kept_however_long_its_cases_take(clock: Clock) -> None:
    executor = waited([1.0] * 7, clock, chunk=3)
    assert executor.chunks == [(3, 3), (3, 3), (1, 1)]


@pytest.mark.parametrize(
    ("kind", "longest", "last", "seconds"),
    [(Executor, 64, 6, 1.0), (ProcessPoolExecutor, 3, 1, 0.05)],
)
def test_chunks_take_a_second_with_executors_of_other_packages(
    kind: type[Executor], longest: int, last: int, seconds: float
) -> None:
    sent: list[tuple[int, float]] = []

    class Reporting(kind):  # type: ignore[misc, valid-type]
        """Reports at once that each case took 1/64 s, and runs none."""

        def submit(  # type: ignore[override]
            self, fn: Any, task: Any, chunk: Any, time_limit: float, call: str
        ) -> Future[Ran]:
            sent.append((len(chunk), time_limit))
            future: Future[Ran] = Future()
            outcomes = [Outcome(True, "finished", "", {})] * len(chunk)
            future.set_result(Ran(outcomes, len(chunk) / 64.0, ("host", 1, 1)))
            return future

    srm.sweep(pendulum(), {"v0": np.zeros((2000, 1))}, 1.0, executor=Reporting())
    assert max(length for length, _ in sent) == longest
    assert sent[-2][0] == last  # the last has what is left
    assert {limit for _, limit in sent} == {2.0 * seconds}


class RunningEqualCallsOnce(Executor):
    """Keeps results by the arguments of their calls, as Dask does while anyone has them."""

    def __init__(self) -> None:
        self._known: dict[bytes, Any] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        key = pickle.dumps((args, kwargs))
        if key not in self._known:
            self._known[key] = fn(*args, **kwargs)
        future: Future[Any] = Future()
        future.set_result(self._known[key])
        return future


def test_equal_cases_are_all_run_by_executors_that_run_equal_calls_once() -> None:
    executor, cases = RunningEqualCallsOnce(), {"v0": np.zeros((6, 1))}
    sweeps = [
        srm.sweep(pendulum(), cases, 0.01, measure=drawn, executor=executor, chunk=2)
        for _ in range(2)
    ]
    assert len({number for sweep in sweeps for number in sweep.table["number"]}) == 12


def test_rows_keep_the_order_of_the_cases_whatever_finishes_first() -> None:
    lengths = [0.5, 2.0, 1.0, 1.5]
    order: list[int] = []
    sweep = srm.sweep(
        pendulum,
        {"length": lengths},
        0.2,
        executor=Backwards(4),
        progress=lambda done, total: order.append(done),
    )
    assert sweep.table["length"].tolist() == lengths
    assert order == [1, 2, 3, 4]
    single = [srm.simulate(pendulum(length=length), 0.2).energy for length in lengths]
    assert sweep.table["energy_change"].tolist() == [energy[-1] - energy[0] for energy in single]


def test_periods_of_pendulums_are_those_of_the_elliptic_integral(processes: Executor) -> None:
    from scipy.special import ellipk

    angles, lengths = np.array([0.1, 1.0, 2.5, 0.5]), np.array([1.0, 2.0, 0.5, 1.3])
    sweep = srm.sweep(
        pendulum,
        {"angle": angles, "length": lengths, "mass": np.ones(4)},
        9.0,
        measure=period,
        executor=processes,
        events=lowest,
        rtol=1e-10,
    )
    exact = 4.0 * np.sqrt(lengths / 9.81) * ellipk(np.sin(0.5 * angles) ** 2)
    assert sweep.table["period"] == pytest.approx(exact, rel=1e-9)


def test_masses_and_lengths_reach_the_runs() -> None:
    masses, lengths = np.array([1.0, 3.0, 0.5]), np.array([1.0, 0.4, 2.0])
    sweep = srm.sweep(
        pendulum, {"mass": masses, "length": lengths}, 0.5, measure=lambda s: {"E": s.energy[-1]}
    )
    exact = -masses * 9.81 * lengths * np.cos(0.3)
    assert sweep.table["E"] == pytest.approx(exact, rel=1e-6)


def test_joint_values_are_assembled_case_by_case(four_bar: srm.Mechanism) -> None:
    cases = [{"q": {"crank": angle}, "v": {"crank": 1.5}} for angle in (0.6, 0.9)]
    sweep = srm.sweep(four_bar, cases, 0.3, measure=states)
    for k, case in enumerate(cases):
        state = srm.assemble(four_bar, case["q"], case["v"])
        single = srm.simulate(four_bar, 0.3, q0=state.q, v0=state.v)
        assert sweep.table["q_0"][k] == single.q[-1, 0]
    assert sweep.table["q.crank"].tolist() == [0.6, 0.9]


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_runs_have_their_measures_whether_an_action_happens_or_not(
    four_bar: srm.Mechanism, speed: float
) -> None:
    """The crank starts at 1 rad, and passes 2 rad within 1 s with 4 rad/s only."""
    bounce = srm.Event(lambda t, q, v: q[0] - 2.0, direction=1, action=lambda t, q, v: (q, -v))
    sweep = srm.sweep(four_bar, [{"v": {"crank": speed}}], 1.0, events=bounce)
    assert sweep.failures == ()
    start = srm.assemble(four_bar, {"crank": 1.0}, {"crank": speed})
    run = srm.simulate(four_bar, 1.0, q0=start.q, v0=start.v, events=bounce)
    assert len(run.segments) == (1 if speed == 1.0 else 2)
    assert sweep.table["steps"][0] == run.stats.steps
    assert sweep.table["drift"][0] == pytest.approx(run.drift[-1, 0], abs=1e-14)
    assert sweep.table["energy_change"][0] == pytest.approx(run.energy[-1] - run.energy[0])


def test_a_column_that_is_not_in_the_table_is_answered_with_those_that_are(
    four_bar: srm.Mechanism,
) -> None:
    table = srm.sweep(four_bar, [{"v": {"crank": 1.0}}], 0.1).table
    with pytest.raises(KeyError, match=r"no 'enrgy'\. Known: case, v\.crank, success"):
        table["enrgy"]


def test_controllers_and_ends_come_from_the_case() -> None:
    def braked(gain: float, t_end: float) -> tuple[srm.Mechanism, dict[str, Any]]:
        return pendulum(), {"controller": lambda t, q, v: -gain * v, "t_end": t_end}

    cases = {"gain": [0.0, 0.5], "t_end": [1.0, 2.0]}
    with pytest.raises(srm.InputError, match="no parameter 'gain'"):
        srm.sweep(pendulum(), cases, 3.0)
    made = srm.sweep(braked, cases, 3.0, measure=lambda s: {"end": s.span[1], "q": s.q[-1, 0]})
    chosen = srm.sweep(
        pendulum(),
        cases,
        3.0,
        measure=lambda s: {"end": s.span[1], "angle": s.q[-1, 0]},
        options=lambda case: braked(**case)[1],
    )
    assert made.table["end"].tolist() == [1.0, 2.0]
    assert made.table["q"].tolist() == chosen.table["angle"].tolist()
    assert chosen.table["angle"][0] == srm.simulate(pendulum(), 1.0).q[-1, 0]


def test_what_is_raised_is_kept_with_its_case_and_the_others_go_on(processes: Executor) -> None:
    cases = {"short": {"length": 0.5}, "none": {"length": 0.0}, "long": {"length": 2.0}}
    sweep = srm.sweep(pendulum, cases, 0.2, executor=processes)
    (failure,) = sweep.failures
    assert (failure.index, failure.name, failure.parameters) == (1, "none", {"length": 0.0})
    assert failure.message == "ValueError: the length 0 m is not positive"
    assert "in pendulum" in failure.traceback
    assert sweep.table["case"].tolist() == ["short", "none", "long"]
    assert sweep.table["status"].tolist() == ["finished", "error", "finished"]
    assert np.isnan(sweep.table["drift"]).tolist() == [False, True, False]
    assert repr(sweep) == "Sweep(3 cases, 2 reached the end, 1 failures, 0 resumed)"


def test_a_run_that_ends_early_is_a_row_that_says_why() -> None:
    def pushed(t: float, q: Any, v: Any) -> Any:
        return [1.0 / (0.5 - t) if t < 0.5 else np.nan]

    sweep = srm.sweep(pendulum, [{}], 1.0, controller=pushed)
    assert not sweep.failures
    assert not sweep.table["success"][0]
    assert sweep.table["status"][0] == "failed"
    assert "Stopped at t = " in sweep.table["message"][0]
    assert 0.0 < sweep.table["t_end"][0] < 1.0


@pytest.mark.parametrize(
    ("returned", "match"),
    [({"q": np.zeros(2)}, "'q'"), ({"length": 1.0}, "column already"), (None, "returned None")],
)
def test_measures_that_are_no_numbers_are_failures(returned: Any, match: str) -> None:
    sweep = srm.sweep(pendulum, [{"length": 1.0}], 0.1, measure=lambda solution: returned)
    assert match in sweep.failures[0].message


def test_a_dead_worker_process_leaves_the_finished_cases(tmp_path: Path) -> None:
    cases = [{"length": length} for length in (0.5, 1.0, np.inf, 1.5)]
    file = tmp_path / "sweep.jsonl"
    with ProcessPoolExecutor(1, mp_context=spawning) as executor:
        sweep = srm.sweep(deadly, cases, 0.1, executor=executor, resume=file)
    assert sweep.table["status"].tolist()[:2] == ["finished", "finished"]
    assert [failure.index for failure in sweep.failures] == [2, 3]
    assert all(BrokenProcessPool.__name__ in failure.message for failure in sweep.failures)
    again = srm.sweep(deadly, [case for case in cases if case["length"] < 2.0], 0.1, resume=file)
    assert (again.resumed, len(again.failures)) == (2, 0)


def test_a_sweep_that_was_killed_is_resumed_where_it_stopped(tmp_path: Path) -> None:
    file = tmp_path / "sweep.jsonl"
    cases = [{"length": length} for length in (0.5, 1.0, 1.0, 1.5, 2.0)]
    whole = srm.sweep(pendulum, cases, 0.2, measure=states)
    script = (
        "import os, signal\nimport srm_mbs as srm\nfrom tests.support.sweeping import *\n"
        "def kill(done, total):\n    done == 3 and os.kill(os.getpid(), signal.SIGKILL)\n"
        f"cases = {cases!r}\n"
        f"srm.sweep(pendulum, cases, 0.2, measure=states, resume={str(file)!r}, progress=kill)\n"
    )
    root = Path(__file__).parents[2]
    status = os.spawnve(
        os.P_WAIT,
        sys.executable,
        [sys.executable, "-c", script],
        {**os.environ, "PYTHONPATH": str(root)},
    )
    assert status == -signal.SIGKILL
    with file.open("a", encoding="utf-8") as opened:
        opened.write('{"case": "0123')  # as if it had died while it wrote
    ran: list[int] = []
    sweep = srm.sweep(
        pendulum,
        [cases[4], *cases[:4]],
        0.2,
        measure=states,
        resume=file,
        progress=lambda done, total: ran.append(done),
    )
    assert (sweep.resumed, ran) == (3, [4, 5])
    for name in ("q_0", "v_0", "steps"):
        assert sweep.table[name].tolist() == np.roll(whole.table[name], 1).tolist()
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    assert len({line["case"] for line in lines[1:]}) == len(lines) - 1 == 5


def test_two_sweeps_do_not_write_to_one_file_at_once(
    tmp_path: Path, four_bar: srm.Mechanism
) -> None:
    file = tmp_path / "sweep.jsonl"
    refusals: list[str] = []

    def sweep_again(done: int, total: int) -> None:
        with pytest.raises(srm.InputError, match="another sweep is writing") as caught:
            srm.sweep(four_bar, [{}, {}], 0.1, resume=file)
        refusals.append(str(caught.value))

    srm.sweep(four_bar, [{}, {}], 0.1, resume=file, progress=sweep_again)

    assert len(refusals) == 2
    assert srm.sweep(four_bar, [{}, {}], 0.1, resume=file).resumed == 2


@pytest.mark.parametrize(
    "damage",
    [
        {"success": "yes"},
        {"status": 3},
        {"message": None},
        {"measures": 3},
        {"measures": {"steps": [1]}},
        {"traceback": "import os"},
        {"other": 1},
    ],
)
def test_an_outcome_in_the_file_that_no_sweep_writes_is_refused(
    damage: dict[str, Any], tmp_path: Path, four_bar: srm.Mechanism
) -> None:
    file = tmp_path / "sweep.jsonl"
    srm.sweep(four_bar, [{}], 0.1, resume=file)
    head, line = file.read_text(encoding="utf-8").splitlines()
    entry = json.loads(line)
    entry["outcome"] |= damage
    file.write_text(f"{head}\n{json.dumps(entry)}\n", encoding="utf-8")

    with pytest.raises(srm.InputError, match="line 2 is damaged"):
        srm.sweep(four_bar, [{}], 0.1, resume=file)


@pytest.mark.parametrize("head", ["[" * 100_000, '{"format": 1, "sweep": [3]}', "3"])
def test_a_file_with_a_foreign_first_line_is_refused(
    head: str, tmp_path: Path, four_bar: srm.Mechanism
) -> None:
    file = tmp_path / "sweep.jsonl"
    file.write_text(head + "\n", encoding="utf-8")

    with pytest.raises(srm.InputError, match=r"damaged|not a file of a sweep"):
        srm.sweep(four_bar, [{}], 0.1, resume=file)


@pytest.mark.skipif(os.name != "posix", reason="pipes of POSIX")
@pytest.mark.timeout(20)
def test_a_pipe_is_no_file_of_a_sweep(tmp_path: Path, four_bar: srm.Mechanism) -> None:
    os.mkfifo(tmp_path / "pipe")

    with pytest.raises(srm.InputError, match="no regular file"):
        srm.sweep(four_bar, [{}], 0.1, resume=tmp_path / "pipe")


def test_cases_that_raised_are_tried_again(tmp_path: Path) -> None:
    tries: list[float] = []

    def fails_once(length: float) -> srm.Mechanism:
        tries.append(length)
        return pendulum(length=0.0 if len(tries) == 2 else length)

    # What the function encloses decides which sweep it is: the list must not be compared.
    def measure(solution: srm.Solution) -> dict[str, float]:
        return {"end": solution.span[1]}

    factory = Unchanging(fails_once)
    cases = {"length": [1.0, 2.0, 3.0]}
    first = srm.sweep(factory, cases, 0.1, measure=measure, resume=tmp_path / "s.jsonl")
    assert [failure.index for failure in first.failures] == [1]
    second = srm.sweep(factory, cases, 0.1, measure=measure, resume=tmp_path / "s.jsonl")
    assert not second.failures
    assert tries == [1.0, 2.0, 3.0, 2.0]


class Unchanging:
    """Calls a function that counts as the same one whatever it encloses."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, **parameters: Any) -> Any:
        return self._function(**parameters)

    def __getstate__(self) -> dict[str, Any]:
        return {}


def test_the_file_of_another_sweep_is_refused(tmp_path: Path, four_bar: srm.Mechanism) -> None:
    file, cases = tmp_path / "sweep.jsonl", [{}]
    again = partial(srm.sweep, four_bar, cases, 0.1, resume=file)
    again()
    kept = file.read_bytes()
    springy = replace(four_bar, forces=(srm.TorsionSpring("crank", stiffness=1.0),))
    messages = {
        "mechanism": refused(lambda: srm.sweep(springy, cases, 0.1, resume=file), tmp_path),
        "t_end": refused(lambda: srm.sweep(four_bar, cases, 0.2, resume=file), tmp_path),
        "options": refused(partial(again, rtol=1e-8), tmp_path),
        "measure": refused(partial(again, measure=states), tmp_path),
        "folder": refused(partial(again, resume=tmp_path / "no" / "sweep.jsonl"), tmp_path),
    }
    assert srm.sweep(srm.load("four_bar"), cases, 0.1, resume=file).resumed == 1
    assert file.read_bytes() == kept
    for case, content in {"damaged line": kept + b"[]\n", "other file": b"my notes"}.items():
        file.write_bytes(content)
        messages[case] = refused(again, tmp_path)
        assert file.read_bytes() == content
    check_messages("sweep_files", messages)


def test_a_measure_of_a_point_that_has_moved_is_not_read_from_the_file(
    tmp_path: Path, four_bar: srm.Mechanism
) -> None:
    def measure(solution: srm.Solution) -> dict[str, float]:
        return {"x": solution.point("tip").position[-1, 0]}

    def swept(x: float) -> srm.Sweep:
        moved = replace(four_bar, points={"tip": srm.Anchor("rocker", xyz=(x, 0.0, 0.0))})
        return srm.sweep(moved, [{}], 0.1, measure=measure, resume=tmp_path / "sweep.jsonl")

    swept(1.0)
    assert swept(1.0).resumed == 1
    with pytest.raises(srm.InputError, match="differs in mechanism"):
        swept(0.5)


@pytest.mark.parametrize("other", ["LENGTH = 2.0", "SIZES = (1.0, 3.0)", "CALLS = [1]"])
def test_fingerprints_of_functions_cover_the_constants_of_their_module(other: str) -> None:
    code = (
        "LENGTH, SIZES, CALLS = 1.0, (1.0, 2.0), []\n"
        "def measure(x):\n"
        "    CALLS.append(x)\n"
        "    return [LENGTH * size for size in SIZES]\n"
    )

    def made(text: str) -> Any:
        names: dict[str, Any] = {"__name__": "swept"}
        exec(text, names)
        return names["measure"]

    same = other.startswith("CALLS")  # what may be changed by calls does not count
    assert fingerprint(made(code)) == fingerprint(made(code))
    assert (fingerprint(made(code + other)) == fingerprint(made(code))) is same


def test_fingerprints_tell_values_apart_and_know_equal_ones() -> None:
    def adding(number: float) -> Callable[[float], float]:
        return lambda x: x + number

    different = [1, 1.0, True, "1", None, [1], [[1]], {"a": 1}, {"a": 2}, np.ones(1), adding(1.0)]
    different += [adding(2.0), lambda x: x - 1.0, srm.PSRM(), srm.PSRM(tableau="heun"), np.ones(2)]
    different += [lambda a, b: a - b, lambda b, a: b - a]  # called with a=..., b=...
    prints = [fingerprint(value) for value in different]
    assert len(set(prints)) == len(prints)
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": np.int64(1)})
    assert fingerprint(adding(1.0)) == fingerprint(adding(1.0))
    used = srm.PSRM()
    srm.simulate(pendulum(), 0.1, method=used)
    assert fingerprint(used) == fingerprint(srm.PSRM())

    class Scaled:
        """A measure that is an object."""

        def __call__(self, x: float) -> float:
            return 2.0 * x

    before = fingerprint(Scaled())
    assert fingerprint(Scaled()) == before
    Scaled.__call__ = lambda self, x: 3.0 * x  # type: ignore[method-assign]
    assert fingerprint(Scaled()) != before
    looped: list[Any] = []
    looped.append(looped)
    assert fingerprint(looped) != fingerprint([[]])


@pytest.mark.parametrize("name", ["slider_crank", "stewart_platform", "squeezing_mechanism"])
def test_a_mechanism_comes_out_of_a_pickle_as_it_was(name: str) -> None:
    mechanism = srm.load(name)
    if name == "slider_crank":
        law = srm.Table(t=(0.0, 0.5, 1.0, 2.0), values=(0.0, 0.1, 0.4, 0.5))
        driven = replace(mechanism, drives=(srm.Drive(law, joint="crank"),))
        state = srm.assemble(driven)
        mechanism = driven.with_state(state.q, state.v)
    single = srm.simulate(mechanism, 0.01)
    copied = pickle.loads(pickle.dumps(mechanism))
    assert fingerprint(copied) == fingerprint(mechanism)
    assert copied.structure.sigma_ref == mechanism.structure.sigma_ref
    assert not copied.q0.flags.writeable
    again = srm.simulate(copied, 0.01)
    assert np.array_equal(single.q, again.q)
    assert np.array_equal(single.v, again.v)


def test_tables_are_written_and_read_back(tmp_path: Path) -> None:
    pandas, parquet = pytest.importorskip("pandas"), pytest.importorskip("pyarrow.parquet")
    cases = [{"length": 1.0, "mass": 2}, {"length": 0.0}, {"mass": 3}]
    sweep = srm.sweep(pendulum, cases, 0.1)
    frame = sweep.to_pandas()
    assert list(frame) == list(sweep.table)
    assert list(frame)[:6] == ["case", "length", "mass", "success", "status", "message"]
    sweep.to_parquet(tmp_path / "sweep.parquet")
    again = parquet.read_table(tmp_path / "sweep.parquet").to_pandas()
    pandas.testing.assert_frame_equal(frame, again, check_dtype=False)
    sweep.to_csv(tmp_path / "sweep.csv")
    with (tmp_path / "sweep.csv").open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == list(sweep.table)
    column = head.index("energy_change")
    assert float(rows[2][column]) == sweep.table["energy_change"][2]


def test_a_table_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = srm.sweep(pendulum, [{}], 0.1)
    monkeypatch.setitem(sys.modules, "pandas", None)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(srm.InputError, match=r"pandas is not installed.*srm-mbs\[sweep\]"):
        sweep.to_pandas()
    with pytest.raises(srm.InputError, match="pyarrow is not installed"):
        sweep.to_parquet("sweep.parquet")


def test_bad_input_is_refused_before_any_run(four_bar: srm.Mechanism, processes: Executor) -> None:
    one = [{}]
    held = (line for line in ())
    unsent = partial(srm.sweep, four_bar, one, 1.0, measure=lambda s: {"n": held})
    calls: dict[str, Callable[[], Any]] = {
        "mechanism": lambda: srm.sweep("four_bar", one, 1.0),
        "no cases": lambda: srm.sweep(four_bar, [], 1.0),
        "text as cases": lambda: srm.sweep(four_bar, "q0", 1.0),
        "number as case": lambda: srm.sweep(four_bar, [3.0], 1.0),
        "lengths": lambda: srm.sweep(four_bar, {"q0": [[0.0]], "v0": []}, 1.0),
        "no columns": lambda: srm.sweep(four_bar, {"q0": 1.0}, 1.0),
        "parameter": lambda: srm.sweep(four_bar, {"a": {"mass": 1.0}}, 1.0),
        "two starts": lambda: srm.sweep(four_bar, [{"q": {}, "v0": [0.0]}], 1.0),
        "reserved name": lambda: srm.sweep(pendulum, [{"status": 1.0}], 1.0),
        "end": lambda: srm.sweep(four_bar, one, -1.0),
        "option": lambda: srm.sweep(four_bar, one, 1.0, rtoll=1e-3),
        "start as option": lambda: srm.sweep(four_bar, one, 1.0, q0=four_bar.q0),
        "method": lambda: srm.sweep(four_bar, one, 1.0, method="euler"),
        "measure": lambda: srm.sweep(four_bar, one, 1.0, measure=3),
        "options": lambda: srm.sweep(four_bar, one, 1.0, options=3),
        "chunk": lambda: srm.sweep(four_bar, one, 1.0, chunk=0),
        "executor": lambda: srm.sweep(four_bar, one, 1.0, executor=3),
    }
    check_refusals("sweeps", calls)
    with pytest.raises(srm.InputError, match="cannot be sent"):
        unsent(executor=processes)


def test_an_interrupted_run_ends_the_sweep_and_keeps_what_was_finished(tmp_path: Path) -> None:
    def interrupted(t: float, q: Any, v: Any) -> Any:
        raise KeyboardInterrupt

    def options(case: Any) -> dict[str, Any]:
        return {"controller": interrupted} if case["length"] == 2.0 else {}

    run = partial(srm.sweep, pendulum, {"length": [1.0, 2.0, 3.0]}, 0.1, options=options)
    with pytest.raises(KeyboardInterrupt):
        run(resume=tmp_path / "sweep.jsonl")
    assert len((tmp_path / "sweep.jsonl").read_text(encoding="utf-8").splitlines()) == 2


def test_a_dask_cluster_that_loses_a_worker_loses_no_run_and_repeats_none(
    tmp_path: Path,
) -> None:
    distributed = pytest.importorskip("distributed")
    lengths, count, fatal = np.linspace(0.5, 2.5, 30), 30, 12
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    )
    file = tmp_path / "sweep.jsonl"
    with cluster, distributed.Client(cluster) as client:
        workers = set(client.run(os.getpid).values())
        sweep = srm.sweep(
            dying_once,
            {
                "length": lengths,
                "fatal": np.arange(count) == fatal,
                "folder": [str(tmp_path)] * count,
            },
            0.5,
            measure=states,
            executor=client.get_executor(),
            resume=file,
        )
    assert len(workers) == 2
    died = int((tmp_path / "died").read_text(encoding="utf-8"))
    assert died in workers
    assert sweep.table["process"][fatal] not in (died, os.getpid())
    assert not sweep.failures
    assert sweep.table["case"].tolist() == list(range(count))
    single = [srm.simulate(pendulum(length=length), 0.5) for length in lengths]
    assert sweep.table["q_0"].tolist() == [solution.q[-1, 0] for solution in single]
    assert len(file.read_text(encoding="utf-8").splitlines()) == 1 + count


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_how_many_cases_are_done(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    srm.sweep(pendulum, {"length": [1.0, 2.0, 3.0]}, 0.1, progress=True)
    assert "3 / 3 cases" in terminal.getvalue()


def test_throughput_is_measured_on_equal_rows() -> None:
    rows = throughput.measure(0.05, seconds=0.01, repeats=1, workers=[1])
    assert [(row.executor, row.chunk) for row in rows] == [
        ("serial", 1),
        ("threads", None),
        ("processes", None),
        ("processes", 1),
    ]
    assert rows[0].of_serial == 1.0
    assert all(row.runs_per_second > 0.0 for row in rows)


HANGING = """format = 1
parameters = { length = 1.0, mass = 1.0 }
[planar]
points = { O = [0, 0], A = ["=length", 0] }
bar = [{ name = "rod", points = ["O", "A"], mass = "=mass" }]
ground = ["O"]
rates = { O = 0.5 }
"""


@pytest.fixture
def rod(tmp_path: Path) -> srm.Mechanism:
    path = tmp_path / "rod.toml"
    path.write_text(HANGING, encoding="utf-8")
    return srm.load(path)


def test_a_sweep_over_parameters_equals_single_runs_on_every_executor(
    rod: srm.Mechanism, processes: Executor
) -> None:
    lengths = [0.5, 0.0, 1.5]  # a bar without length cannot be
    columns = {"length": lengths}
    cases = [{"v": {"O": 0.1 * k}} for k in range(3)]
    wanted = []
    for case, length in zip(cases, lengths):
        if length:
            variant = rod.with_parameters(length=length)
            state = srm.assemble(variant, v=case["v"])
            wanted.append(states(srm.simulate(variant, 0.5, q0=state.q, v0=state.v)))
    with ThreadPoolExecutor(2) as threads:
        for executor in (None, threads, processes):
            sweep = srm.sweep(
                rod, cases, 0.5, measure=states, parameters=columns, executor=executor
            )
            assert [failure.index for failure in sweep.failures] == [1]
            for k, single in zip((0, 2), wanted):
                for name in single.keys() - {"process"}:
                    assert sweep.table[name][k] == single[name]


def test_a_sweep_over_parameters_resumes_the_same_description_only(
    rod: srm.Mechanism, tmp_path: Path
) -> None:
    journal, lengths = tmp_path / "journal", {"length": [0.5, 1.5]}
    first = srm.sweep(rod, None, 0.2, parameters={"length": [0.5]}, resume=journal)
    again = srm.sweep(rod, None, 0.2, parameters=lengths, resume=journal)
    assert again.resumed == 1
    assert again.table["steps"][0] == first.table["steps"][0]
    path = tmp_path / "other.toml"
    path.write_text(HANGING.replace("=length", "=length**2"), encoding="utf-8")
    with pytest.raises(srm.InputError, match="differs in parameters"):
        srm.sweep(srm.load(path), None, 0.2, parameters=lengths, resume=journal)


def test_messages_about_swept_parameters(rod: srm.Mechanism) -> None:
    cases = [{"v": {"O": 0.1}}]
    check_refusals(
        "sweep_parameters",
        {
            "unknown": lambda: srm.sweep(rod, None, 1.0, parameters={"lenght": [1.0]}),
            "start": lambda: srm.sweep(rod, None, 1.0, parameters={"q0": [1.0]}),
            "no columns": lambda: srm.sweep(rod, None, 1.0, parameters={"length": 1.0}),
            "no dictionary": lambda: srm.sweep(rod, cases, 1.0, parameters=3),  # type: ignore[arg-type]
            "counts": lambda: srm.sweep(rod, cases, 1.0, parameters={"length": [1.0, 2.0]}),
            "twice": lambda: srm.sweep(rod, [{"length": 1.0}], 1.0, parameters={"length": [1.0]}),
        },
    )
