"""The policy of ``backend="auto"``: code is taken where it is, compiled where it pays, and a run
goes on whatever becomes of it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import srm_mbs as srm
from srm_mbs.integration.generated import code, code_cache, policy
from srm_mbs.integration.generated.code import source_of_structure, structure_of_mechanism
from srm_mbs.integration.kernel import backend
from tests.formats.test_variants import FOUR_BAR
from tests.support.bundled import finished
from tests.support.commands import row, run
from tests.support.mechanisms import rod

pytestmark = [
    pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}"),
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler"),
]

PATIENCE = 60.0
"""Time (s) that a busy machine has for what takes 0.1 s."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A process that knows no code, with an empty cache and a low price of compilation."""
    monkeypatch.setenv("SRM_MBS_BACKEND", "auto")
    monkeypatch.setenv("SRM_MBS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(code, "_libraries", type(code._libraries)())
    monkeypatch.setattr(code, "_arrivals", 0)
    monkeypatch.setattr(code, "_refused", {})
    for name, value in {
        **{"_accounts": {}, "_job": None, "_failed": False},
        **{"START_SECONDS": 0.002, "STATEMENT_SECONDS": 0.0, "PAIR_SECONDS": 0.0},
    }.items():
        monkeypatch.setattr(policy, name, value)
    yield tmp_path / "cache"
    code_cache.end_background()


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Makes the C compiler of a script; it appends a line to the file that is returned."""
    path, log = tmp_path / "compiler", tmp_path / "calls"
    code_cache.compiler()  # kept by the process, which goes on with other tests
    monkeypatch.setenv("CC", str(path))
    monkeypatch.setattr(code_cache, "compiler", code_cache.compiler.__wrapped__)
    log.write_text("")

    def write(script: str) -> Path:
        path.write_text(f"#!/bin/sh\necho $$ >> {log}\n{script.replace('CC', real)}\n")
        path.chmod(0o700)
        return log

    real = f'{shutil.which("cc")} "$@"'
    return write


def _runs(mechanism: srm.Mechanism, until: str = "generated", t_end: float = 2.0) -> list[Any]:
    """Runs up to the first one by the backend ``until``."""
    solutions = []
    started = time.monotonic()
    while time.monotonic() - started < PATIENCE:
        solutions.append(finished(mechanism, t_end))
        if solutions[-1].settings.backend == until:
            return solutions
    raise AssertionError(f"no run by {until} among {len(solutions)}")


def _no_code(mechanism: srm.Mechanism, count: int = 30) -> None:
    """Assert that ``count`` runs are the kernel's, bit by bit."""
    expected = finished(mechanism, 2.0, backend="kernel")
    for _ in range(count):
        solution = finished(mechanism, 2.0)
        assert solution.settings.backend == "kernel"
        assert np.array_equal(solution.q, expected.q)


def _used(name: str = "four_bar") -> srm.Mechanism:
    """A mechanism of which the next run begins the compilation."""
    mechanism = srm.load(name)
    use = policy._use_of(mechanism)
    use.account.used = use.account.needed
    return mechanism


def test_a_mechanism_that_is_used_is_compiled_for_the_runs_to_come(folder: Path) -> None:
    mechanism = srm.load("four_bar")
    assert srm.backend(mechanism) == "kernel"
    *before, last = _runs(mechanism)
    assert len(before) > 0
    assert all(one.settings.backend == "kernel" for one in before)
    assert srm.backend(mechanism) == "generated"
    assert repr(last).endswith("finished, generated)")
    assert len(list(folder.glob("*.so"))) == 1
    assert [path.suffix for path in folder.iterdir() if path.suffix not in (".so", ".sha256")] == []
    # Naming the backend of a run repeats it.
    for one in (before[-1], last):
        again = finished(mechanism, 2.0, backend=one.settings.backend)
        assert np.array_equal(again.q, one.q)
        assert np.array_equal(again.v, one.v)


def test_a_mechanism_that_is_used_less_than_compilation_costs_is_not_compiled(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy, "START_SECONDS", 1e3)
    _no_code(srm.load("four_bar"))
    assert policy._job is None
    assert not folder.exists()


def test_the_price_grows_with_the_statements_and_is_known_once_they_are_counted(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    monkeypatch.setattr(policy, "STATEMENT_SECONDS", 1.0)
    mechanism = _used()
    account = policy._use_of(mechanism).account
    assert account.needed == pytest.approx(3 * policy.STATEMENTS_GUESSED, abs=0.1)
    monkeypatch.setattr(policy, "begin_compilation", lambda *_: None)
    finished(mechanism, 2.0)
    statements = source_of_structure(structure_of_mechanism(mechanism)[0]).operations
    assert account.needed == pytest.approx(statements, abs=0.1)
    # Too low a guess begins nothing but another count.
    monkeypatch.setattr(policy, "STATEMENTS_GUESSED", 1)
    finished(_used("slider_crank"), 2.0)
    assert policy._job is None
    assert not list(folder.glob("*"))


def test_the_first_run_of_another_process_takes_the_code(folder: Path) -> None:
    srm.compile(srm.load("four_bar"))
    script = "import srm_mbs as srm; print(srm.simulate(srm.load('four_bar'), 1.0))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip().endswith("finished, generated)")
    assert "finished, generated" in run("--verbose", "simulate", "four_bar", "--t-end", "0.1") or (
        "generated" in row(run("info", "four_bar"), "runs on")
    )


def test_runs_without_code_cost_no_look_at_files_and_no_structure(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(policy, "START_SECONDS", 1e3)
    looks: list[str] = []

    def counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            looks.append(name)
            return function(*arguments)

        return call

    monkeypatch.setattr(code, "structure_of", counted("structure", code.structure_of))
    monkeypatch.setattr(code, "load_cached", counted("file", code.load_cached))
    mechanism = srm.load("four_bar")
    _no_code(mechanism, 5)
    assert looks == []
    # Where there is code of others, it is looked for once.
    srm.compile(srm.load("slider_crank"))
    looks.clear()
    _no_code(mechanism, 5)
    _no_code(mechanism.with_state(mechanism.q0, 0.5 * mechanism.v0), 5)
    assert looks == ["structure", "file"]


def test_variants_of_one_topology_share_one_function(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "bars.toml"
    path.write_text(FOUR_BAR, encoding="utf-8")
    bars = srm.load(path)
    cases = [{"mass": 1.0 + 0.1 * k} for k in range(8)]
    account = policy._use_of(bars).account
    account.needed = 1e3
    before = srm.sweep(bars, cases, 2.0, measure=_backend)
    assert set(before.table["backend"]) == {"kernel"}
    assert account.used > 0.0
    account.used = account.needed
    _runs(bars)
    variants = [bars.with_parameters(mass=2.0, crank=0.45), bars.with_parameters(ground=1.1)]
    for variant in variants:
        solution, expected = finished(variant, 2.0), finished(variant, 2.0, backend="kernel")
        assert solution.settings.backend == "generated"
        assert np.abs(solution.q[-1] - expected.q[-1]).max() < 1e-6
    after = srm.sweep(bars, cases, 2.0, measure=_backend)
    assert set(after.table["backend"]) == {"generated"}
    assert len(list(folder.glob("*.so"))) == 1


def _backend(solution: srm.Solution) -> dict[str, str]:
    return {"backend": solution.settings.backend}


def test_steps_of_a_simulator_count_and_it_stays_with_its_backend(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("srm_mbs.simulation.simulator.CHARGED", 1e-3)
    mechanism = srm.load("four_bar")
    by_kernel = srm.Simulator(mechanism, backend="kernel")
    simulator = srm.Simulator(mechanism)
    started = time.monotonic()
    while policy.code_at_hand(mechanism) is None and time.monotonic() - started < PATIENCE:
        simulator.step(0.01)
        by_kernel.step(0.01)
    assert srm.backend(mechanism) == "generated"
    for _ in range(20):
        assert np.array_equal(simulator.step(0.01)[0], by_kernel.step(0.01)[0])
    own, generated, kernel = (_stepped(mechanism, by) for by in ("auto", "generated", "kernel"))
    np.testing.assert_array_equal(own, generated)
    assert not np.array_equal(own, kernel)  # their last digits tell them apart


def _stepped(mechanism: srm.Mechanism, by: str) -> np.ndarray:
    simulator = srm.Simulator(mechanism, backend=by)
    return np.array([simulator.step(0.01)[0] for _ in range(200)])


def test_a_long_run_begins_the_compilation_and_stays_with_its_backend() -> None:
    mechanism = srm.load("four_bar")

    def event(t: float, q: np.ndarray, v: np.ndarray) -> float:
        if policy._job is not None:
            process = policy._job.compilation._processes[0]
            assert process is not None
            process.wait()
        if code.arrivals():
            arrived.append(t)
        return 1.0

    arrived: list[float] = []
    solution = finished(mechanism, 20.0, events=event)
    assert 0.0 < arrived[0] < 10.0
    assert solution.settings.backend == "kernel"
    expected = finished(mechanism, 20.0, events=lambda t, q, v: 1.0, backend="kernel")
    assert np.array_equal(solution.q, expected.q)
    assert finished(mechanism, 0.1).settings.backend == "generated"


def test_segments_of_a_run_keep_its_backend_while_code_arrives() -> None:
    mechanism = srm.load("four_bar")

    def bounce(t: float, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if t > 1.0:
            srm.compile(mechanism)
        return q, v

    crossing = srm.Event(lambda t, q, v: np.sin(8.0 * t), action=bounce)
    solution = finished(mechanism, 3.0, events=crossing)
    assert len(solution.segments) > 3
    assert {part.settings.backend for part in solution.segments} == {"kernel"}
    assert finished(mechanism, 3.0, events=crossing).settings.backend == "generated"


def test_a_run_with_code_stays_with_its_backend_where_it_switches_the_mechanism(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(policy, "START_SECONDS", 1e3)  # nothing is compiled without being asked
    mechanism = srm.load("four_bar")
    free = mechanism.without_loop(mechanism.loops[0].name)
    release = srm.Event(
        lambda t, q, v: t - 0.5, terminal=False, action=lambda t, q, v: srm.Switch(free, q, v)
    )
    assert finished(mechanism, 1.0, events=release).settings.backend == "kernel"
    srm.compile(mechanism)
    assert srm.backend(free) == "kernel"
    solution = finished(mechanism, 1.0, events=release)
    assert [part.settings.backend for part in solution.segments] == ["generated"] * 2
    again = finished(mechanism, 1.0, events=release, backend="generated")
    assert np.array_equal(again.q, solution.q)


def test_steps_of_a_run_with_output_times_are_made_again_by_its_backend() -> None:
    mechanism = srm.load("four_bar")
    times = np.linspace(0.0, 2.0, 2001)
    solution = finished(mechanism, 2.0, t_eval=times)
    expected = finished(mechanism, 2.0, backend="kernel")
    srm.compile(mechanism)
    assert np.array_equal(solution(1.2345)[0], expected(1.2345)[0])
    assert finished(mechanism, 2.0, t_eval=times).settings.backend == "generated"


@pytest.mark.parametrize(
    "script",
    ["exit 1", "exit 0", 'while [ "$1" != -o ]; do shift; done; echo rubbish > "$2"'],
    ids=["fails", "makes nothing", "makes rubbish"],
)
def test_runs_go_on_with_the_kernel_where_the_compiler_fails(
    program: Callable[[str], Path], script: str, folder: Path
) -> None:
    calls = program(script)
    mechanism = srm.load("four_bar")
    started = time.monotonic()
    while not policy._failed and time.monotonic() - started < PATIENCE:
        _no_code(mechanism, 1)
    _no_code(mechanism)
    _no_code(_used("slider_crank"), 5)
    assert calls.read_text().count("\n") == 1  # it is asked once per process
    assert not [path.name for path in folder.iterdir() if path.name.startswith(code_cache._WORK)]


def test_runs_go_on_with_the_kernel_while_the_compiler_hangs(
    program: Callable[[str], Path], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(code, "PATIENCE", 1.0)
    calls = program("sleep 100")
    mechanism = _used()
    started = time.monotonic()
    while not policy._failed and time.monotonic() - started < PATIENCE:
        _no_code(mechanism, 1)
    assert time.monotonic() - started > 1.0
    assert not _alive(int(calls.read_text()))
    assert not list(folder.iterdir())


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def _wait_for(condition: Callable[[], object]) -> None:
    started = time.monotonic()
    while not condition():
        assert time.monotonic() - started < PATIENCE
        time.sleep(0.01)


def test_without_a_compiler_nothing_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (code_cache, backend):
        monkeypatch.setattr(module, "compiler", lambda: None)
    mechanism = srm.load("four_bar")
    _no_code(mechanism, 5)
    assert policy._use_of(mechanism).account.used == 0.0
    assert row(run("info", "four_bar"), "generated code") == "none: there is no C compiler"


def test_the_kernel_alone_can_be_asked_for(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    srm.compile(srm.load("four_bar"))
    mechanism = srm.load("four_bar")
    assert "s, or by srm-mbs compile" in row(run("info", "slider_crank"), "generated code")
    assert row(run("info", "four_bar"), "generated code") == "compiled"
    monkeypatch.setenv("SRM_MBS_BACKEND", "kernel")
    _no_code(mechanism, 3)
    assert srm.backend(mechanism) == "kernel"
    assert row(run("info", "four_bar"), "runs on") == "the compiled kernel"
    assert "SRM_MBS_BACKEND is kernel" in row(run("info", "four_bar"), "generated code")


def _egg() -> srm.Mechanism:
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelEllipsoid(1.0, 2.0, 3.0), pin.SE3.Identity(), "egg")
    model.appendBodyToJoint(joint, rod(), pin.SE3.Identity())
    return srm.Mechanism(model, q0=pin.neutral(model), v0=np.full(3, 0.1))


@pytest.mark.parametrize("case", ["an element", "too many statements"])
def test_what_cannot_be_generated_is_tried_once(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tries: list[str] = []
    for name in ("structure_of", "source_of"):
        made = getattr(code, name)

        def counted(*arguments: Any, made: Any = made, name: str = name) -> Any:
            tries.append(name)
            return made(*arguments)

        monkeypatch.setattr(code, name, counted)
    monkeypatch.setattr(code, "MOST_OPERATIONS", 50)
    mechanism = _egg() if case == "an element" else srm.load("flyball_governor")
    use = policy._use_of(mechanism)
    started = time.monotonic()
    while not use.settled and time.monotonic() - started < PATIENCE:
        _no_code(mechanism, 1)
    _no_code(mechanism, 20)
    expected = ["structure_of"] if case == "an element" else ["structure_of", "source_of"]
    assert tries == expected


def test_without_a_place_for_the_cache_code_is_compiled_for_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SRM_MBS_CACHE", str(tmp_path / "file"))
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    _runs(srm.load("four_bar"))
    assert not list(temporary.iterdir())


def test_runs_go_on_with_the_kernel_where_the_disk_is_full(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    mechanism = _used()
    _no_code(mechanism, 5)
    assert policy._failed
    assert not list(folder.iterdir())


def test_a_damaged_library_is_not_run_but_compiled_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    srm.compile(srm.load("four_bar"))
    (library,) = folder.glob("*.so")
    whole = library.read_bytes()
    library.write_bytes(whole[:-7])
    monkeypatch.setattr(code, "_libraries", type(code._libraries)())
    mechanism = srm.load("four_bar")
    assert finished(mechanism, 0.1).settings.backend == "kernel"
    _runs(mechanism)
    assert len(library.read_bytes()) == len(whole)


def test_threads_run_a_mechanism_while_it_is_compiled() -> None:
    mechanism = _used()
    expected = {by: finished(mechanism, 2.0, backend=by).q for by in ("kernel",)}
    taken: set[str] = set()

    def runs(_: int) -> list[Any]:
        out = []
        started = time.monotonic()
        while time.monotonic() - started < PATIENCE:
            out.append(finished(mechanism, 2.0))
            if out[-1].settings.backend == "generated":
                break
        return out

    with ThreadPoolExecutor(3) as pool:
        solutions = [one for found in pool.map(runs, range(3)) for one in found]
    expected["generated"] = finished(mechanism, 2.0, backend="generated").q
    for one in solutions:
        taken.add(one.settings.backend)
        assert np.array_equal(one.q, expected[one.settings.backend])
    assert taken == {"kernel", "generated"}


def test_a_fork_leaves_the_compilation_to_its_parent(
    program: Callable[[str], Path], folder: Path
) -> None:
    calls = program("sleep 0.5; exec CC")
    mechanism = _used()
    assert finished(mechanism, 2.0).settings.backend == "kernel"
    assert policy._job is not None
    child = os.fork()
    if child == 0:  # its runs are the kernel's, and its end is not that of the compiler
        status = 1
        try:
            by = finished(mechanism, 0.5).settings.backend
            status = 0 if by == "kernel" and policy._job is None else 2
            code_cache.end_background()
            policy._end()
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    _runs(mechanism)
    assert calls.read_text().count("\n") == 1
    # And the fork of a process that has code runs it.
    child = os.fork()
    if child == 0:
        status = 1
        try:
            status = 0 if finished(mechanism, 0.5).settings.backend == "generated" else 2
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


RUNS = """
import os, sys, time
from pathlib import Path
import srm_mbs as srm
from srm_mbs.integration.generated import policy

policy.START_SECONDS, policy.STATEMENT_SECONDS, policy.PAIR_SECONDS = 1e-3, 0.0, 0.0
mechanism = srm.load("four_bar")
started = time.monotonic()
while policy._job is None and srm.simulate(mechanism, 2.0).settings.backend == "kernel":
    assert time.monotonic() - started < 60.0
"""
BESIDE = f"""{RUNS}
calls = Path(os.environ["CC"]).with_name("calls")
while str(policy._job.compilation._processes[0].pid) not in calls.read_text().split():
    assert time.monotonic() - started < 60.0
    time.sleep(0.01)
"""
"""A program in which a compiler of :func:`program` has begun beside the runs."""


def test_a_program_that_ends_ends_the_compiler(
    program: Callable[[str], Path], folder: Path
) -> None:
    calls = program("sleep 100 & sleep 100")
    script = f"{BESIDE}\nprint(time.time())"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    took = time.time() - float(done.stdout)
    assert done.stderr == ""
    assert took < 5.0
    assert not _alive(int(calls.read_text()))
    assert not list(folder.iterdir())


@pytest.mark.stress
def test_what_is_compiled_when_a_program_ends_is_kept(
    program: Callable[[str], Path], folder: Path
) -> None:
    program("exec CC")
    script = f"{BESIDE}\npolicy._job.compilation._processes[0].wait()"
    subprocess.run([sys.executable, "-c", script], check=True)
    assert [path.suffix for path in sorted(folder.iterdir())] == [".sha256", ".so"]
    assert finished(srm.load("four_bar"), 0.1).settings.backend == "generated"


@pytest.mark.stress
def test_a_worker_that_ends_ends_its_compiler(
    program: Callable[[str], Path], folder: Path, tmp_path: Path
) -> None:
    """Workers of multiprocessing do not run what is registered with ``atexit``."""
    calls = program("sleep 100")
    indented = BESIDE.replace("\n", "\n    ")
    script = tmp_path / "workers.py"
    script.write_text(
        f"import multiprocessing\ndef work():\n    {indented}\nif __name__ == '__main__':\n"
        "    for way in ('fork', 'spawn'):\n"
        "        worker = multiprocessing.get_context(way).Process(target=work)\n"
        "        worker.start(); worker.join(); assert worker.exitcode == 0\n"
    )
    subprocess.run([sys.executable, str(script)], check=True)
    started = [int(line) for line in calls.read_text().split()]
    assert len(started) == 2
    assert not any(map(_alive, started))
    assert not list(folder.iterdir())


@pytest.mark.stress
def test_of_many_processes_one_compiles(program: Callable[[str], Path], folder: Path) -> None:
    calls = program("sleep 1; exec CC")
    script = RUNS.replace("policy._job is None and ", "")
    programs = [subprocess.Popen([sys.executable, "-c", script]) for _ in range(3)]
    assert [one.wait() for one in programs] == [0, 0, 0]
    assert calls.read_text().count("\n") == 1
    assert [path.suffix for path in sorted(folder.iterdir())] == [".sha256", ".so"]


@pytest.mark.stress
def test_a_process_that_needs_the_code_waits_for_the_one_that_compiles_it(
    program: Callable[[str], Path], folder: Path
) -> None:
    calls = program("sleep 1; exec CC")
    script = "import srm_mbs as srm; print(srm.compile(srm.load('four_bar')))"
    programs = [
        subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    said = [one.communicate()[0] for one in programs]
    assert sorted("found" in text for text in said) == [False, True]
    assert calls.read_text().count("\n") == 1


@pytest.mark.stress
def test_a_killed_process_leaves_the_code_to_others(
    program: Callable[[str], Path], folder: Path
) -> None:
    calls = program("sleep 100")
    killed = subprocess.Popen([sys.executable, "-c", f"{BESIDE}\ntime.sleep(100)"])
    _wait_for(lambda: calls.read_text())
    killed.kill()
    killed.wait()
    os.killpg(int(calls.read_text()), signal.SIGKILL)
    program("exec CC")
    _runs(srm.load("four_bar"))
    (left,) = folder.glob(f"{code_cache._WORK}*")
    long_ago = time.time() - 2.0 * code_cache._ABANDONED
    os.utime(left, (long_ago, long_ago))
    srm.compile(srm.load("slider_crank"))
    assert not left.exists()


def test_compiling_ahead_ends_what_compiles_the_same_beside_the_program(
    program: Callable[[str], Path], folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "slow").write_text("")
    calls = program(f"if [ -e {tmp_path / 'slow'} ]; then sleep 100; fi; exec CC")
    mechanism = _used()
    finished(mechanism, 2.0)
    _wait_for(lambda: calls.read_text())
    (tmp_path / "slow").unlink()
    beside = int(calls.read_text())
    assert srm.compile(mechanism).seconds > 0.0
    assert not _alive(beside)
    assert finished(mechanism, 2.0).settings.backend == "generated"
    # The compiler has not failed: others follow.
    _runs(_used("slider_crank"))


def test_code_that_another_process_compiled_meanwhile_is_taken(
    program: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = program("exec CC")
    mechanism = srm.load("four_bar")
    assert finished(mechanism, 0.1).settings.backend == "kernel"
    srm.compile(srm.load("four_bar"))
    compiled = calls.read_text()  # by a slow kernel, the first run has begun to compile it, too
    assert compiled
    monkeypatch.setattr(code, "_libraries", type(code._libraries)())
    monkeypatch.setattr(code, "_arrivals", 0)
    _runs(mechanism)
    assert calls.read_text() == compiled


@pytest.mark.parametrize("name", ["spatial_four_bar", "jansen_walker"])
def test_code_that_is_compiled_beside_the_program_computes_what_that_compiled_ahead_does(
    name: str, program: Callable[[str], Path], folder: Path
) -> None:
    """Bit by bit: as one unit, and as two, with the algebra of few coordinates and of many."""
    calls = program("exec CC")
    *_, beside = _runs(_used(name), t_end=0.2)
    assert calls.read_text().count("\n") == 1
    code_cache.clear()
    code._libraries.clear()
    mechanism = srm.load(name)
    assert srm.compile(mechanism).seconds > 0.0
    assert calls.read_text().count("\n") == 4  # two units, and what links them
    ahead = finished(mechanism, 0.2, backend="generated")
    assert np.array_equal(ahead.q, beside.q)
    assert np.array_equal(ahead.v, beside.v)


@pytest.mark.stress
def test_the_source_is_the_same_in_every_process() -> None:
    script = (
        "import hashlib; import srm_mbs as srm; m = srm.load('squeezing_mechanism');"
        "from srm_mbs.integration.generated.code import *;"
        "s, _ = structure_of_mechanism(m);"
        "print(*(hashlib.sha256(x.encode()).hexdigest() for x in (generated_source(m),"
        " identity_of(s))))"
    )
    said = {
        subprocess.run(
            [sys.executable, "-c", script],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(said) == 1


def test_the_identity_covers_every_module_that_writes_the_source(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = Path(code.__file__).parent
    writers = {path.stem for path in folder.glob("[a-z]*.py")} - set(code._NO_GENERATOR)
    for name in writers:
        text = (folder / f"{name}.py").read_text()
        for other in code._NO_GENERATOR:
            assert f"generated.{other} import" not in text
    usual = code._generator.__wrapped__()
    read = code.pkgutil.get_data
    for changed in writers:

        def get(package: str, name: str, changed: str = changed) -> bytes:
            return (read(package, name) or b"") + (b" " if name == f"{changed}.py" else b"")

        monkeypatch.setattr(code.pkgutil, "get_data", get)
        assert code._generator.__wrapped__() != usual, changed
    monkeypatch.setattr(code.pkgutil, "get_data", read)
    assert code._generator.__wrapped__() == usual
