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
