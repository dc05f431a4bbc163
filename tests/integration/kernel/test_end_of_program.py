"""Programs that end while daemon threads are in the kernel."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from srm_mbs.integration.kernel import backend

pytestmark = pytest.mark.skipif(backend.core is None, reason=f"no kernel: {backend.missing}")

KERNEL = os.environ | {"SRM_MBS_BACKEND": "kernel"}
"""Environment of programs whose runs the kernel makes, whatever backend the tests are for."""
PROGRAM = """
import threading, time
import numpy as np
import srm_mbs as srm

mechanism = srm.load("four_bar")
running = threading.Event()

def controller(t, q, v):
    running.set()
    return np.zeros(3)

def event(t, q, v):
    running.set()
    return 1.0

def event_in_numpy(t, q, v):
    running.set()
    np.unique(numbers)  # C++ that gives up the interpreter's lock and takes it again
    return 1.0

numbers = np.arange(10_000)

def work():
    {started}
    while True:
        srm.simulate(mechanism, 50.0, rtol=1e-9, {options})

for _ in range({threads}):
    threading.Thread(target=work, daemon=True).start()
running.wait()
time.sleep(0.2)
"""


@pytest.mark.parametrize(
    ("threads", "started", "options"),
    [
        (1, "running.set()", ""),
        (4, "", "controller=controller"),
        pytest.param(1, "", "controller=controller, sample_time=0.01", marks=pytest.mark.stress),
        pytest.param(4, "running.set()", "", marks=pytest.mark.stress),
        pytest.param(4, "", "events=event", marks=pytest.mark.stress),
        (1, "", "events=event_in_numpy"),
    ],
    ids=["run", "controllers", "samples", "runs", "events", "events in NumPy"],
)
def test_a_program_ends_quietly_while_daemon_threads_run(
    threads: int, started: str, options: str
) -> None:
    program = PROGRAM.format(started=started or "pass", options=options, threads=threads)

    ended = subprocess.run(
        [sys.executable, "-c", program],
        env=KERNEL,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )

    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""


def test_code_that_runs_at_the_end_of_a_program_can_simulate() -> None:
    program = """
import atexit
import srm_mbs as srm

mechanism = srm.load("four_bar")

def simulate_at_the_end():
    print(srm.simulate(mechanism, 1.0, controller=lambda t, q, v: 0 * v).status)

atexit.register(simulate_at_the_end)
import srm_mbs.integration.kernel.run
"""

    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=240, check=True
    )

    assert ended.stdout.strip() == "finished"


@pytest.mark.stress
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no child processes by fork")
def test_the_end_of_a_child_process_does_not_wait_for_runs_of_its_parent() -> None:
    program = """
import atexit, os, sys, threading, time

atexit.register(lambda: print(time.monotonic() - before < 4.0, flush=True))
import srm_mbs as srm

mechanism = srm.load("four_bar")
running = threading.Event()

def event(t, q, v):
    running.set()
    return 1.0

def work():
    while True:
        srm.simulate(mechanism, 50.0, rtol=1e-9, events=event)

def begin_to_end():
    global before
    before = time.monotonic()

threading.Thread(target=work, daemon=True).start()
running.wait()
child = os.fork()
if child:
    os.waitpid(child, 0)
    os._exit(0)
atexit.register(begin_to_end)
"""

    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=240, check=True
    )

    assert ended.stdout.strip() == "True"
