"""CPU times of this package against those of another revision of it, as ratios.

    python -m benchmarks.against OTHER [--cases evaluation runs loops compile] [--rounds 7]

OTHER is the Python of an environment in which another revision is installed, with its compiled
kernel.  Both interpreters measure the same case in turn, on one core and in CPU time, so that other
programs slow both down alike: ratios are medians over the rounds, times the least of them.  Here
runs and evaluations use generated code, which the other revision may not have.  Run it from a
checkout.

    evaluation  one evaluation at the start, in the kernel's own loop (us)
    runs        P1 and P2 of ``benchmarks.work_precision``, with output at 100 times (ms), at
                four tolerances
    loops       N-four-bars: an evaluation, mean over 8 states of a run, and the run itself, 1.2 s
                through the first passage at rtol 1e-8; and the evaluation without generated code,
                which has its limit between 160 and 320 loops
    compile     CPU seconds of compiling into an empty cache, and of loading from it; here only
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from typing import Any

SMALL = (
    "slider_crank",
    "four_bar",
    "n_four_bar_2",
    "spatial_four_bar",
    "squeezing_mechanism",
    "bricard",
)
LARGE = ("jansen_walker", "stewart_platform", "delta_robot")
LOOPS = (20, 40, 80, 160, 320)
RUNS = [
    (name, rtol)
    for name in ("slider_crank_whirl", "slider_crank_regular")
    for rtol in (1e-3, 1e-4, 1e-6, 1e-9)
]

# In each interpreter: reads cases, one a line, and answers each with the least time of a few calls.
WORKER = r'''
import gc, json, resource, sys, time
import numpy as np
import srm_mbs as srm

try:
    from srm_mbs.dynamics.multibody import make_system
    from srm_mbs.integration.generated.code import load_code
    from srm_mbs.integration.kernel.system import make_kernel_system
except ImportError:  # before generated code
    from srm_mbs.compiled.twin import twin_of
    from srm_mbs.systems.multibody import make_system
    load_code = lambda mechanism: None
    make_kernel_system = lambda system, code: twin_of(system)

generates = hasattr(srm, "compile")
mechanisms = {}

def least(call, seconds=0.03, batches=3):
    start = time.process_time()
    call()
    once = max(time.process_time() - start, 1e-7)
    number, best = max(1, int(seconds / batches / once)), float("inf")
    gc.collect()
    for _ in range(batches):
        start = time.process_time()
        for _ in range(number):
            call()
        best = min(best, (time.process_time() - start) / number)
    return best

def loaded(name):
    if name not in mechanisms:
        mechanisms[name] = srm.load(name) if isinstance(name, str) else srm.n_four_bar(name)
        mechanisms[name].structure
    return mechanisms[name]

def code(mechanism, by):
    """Its generated code, if there can be any and ``by`` does not ask for the kernel."""
    try:
        return load_code(mechanism) if by != "kernel" else None
    except srm.InputError:
        return None

def kernel_system(mechanism, by="generated"):
    return make_kernel_system(make_system(mechanism), code(mechanism, by))

def evaluation(name):
    mechanism = loaded(name)
    state = np.concatenate([mechanism.q0, mechanism.v0])
    system = kernel_system(mechanism)
    return least(lambda: system.repeat(0.0, state, 50)) / 50

def run(name, t_end, rtol, samples, by="generated"):
    mechanism = loaded(name)
    by = "generated" if code(mechanism, by) else "kernel"
    backend = {"backend": by} if generates else {}
    times = np.linspace(0.0, t_end, samples + 1)[1:]
    def call():
        solution = srm.simulate(mechanism, t_end, rtol=rtol, **backend)
        if samples:
            solution(times)
    call()
    return least(call)

def mean(name, by="generated"):
    mechanism = loaded(name)
    states = srm.simulate(mechanism, 1.2, rtol=1e-8).steps.states
    chosen = states[np.linspace(0, len(states) - 1, 8).astype(int)]
    system = kernel_system(mechanism, by)
    return float(np.mean([least(lambda: system.repeat(0.0, s, 5), 0.01) for s in chosen])) / 5

def used():
    """CPU seconds of this process and of its compilers."""
    by = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(own.ru_utime + own.ru_stime for own in by)

def compilation(name):
    if not generates:
        return None
    mechanism = loaded(name)
    before = used()
    load_code(mechanism)
    return used() - before

for line in sys.stdin:
    kind, *arguments = json.loads(line)
    print(json.dumps(globals()[kind](*arguments)), flush=True)
'''


class Interpreter:
    """A worker in one environment, with a cache for generated code of its own."""

    def __init__(self, python: str, cache: str) -> None:
        threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            [python, "-c", WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=cache,
            env=os.environ | threads | {"SRM_MBS_CACHE": os.path.join(cache, "code")},
        )

    def measure(self, *case: Any) -> float | None:
        """Seconds of a case; None where this revision has no such thing."""
        print(json.dumps(case), file=self._process.stdin, flush=True)
        answer = "" if self._process.stdout is None else self._process.stdout.readline()
        if not answer:
            raise SystemExit(f"the measurement of {case} failed")
        return json.loads(answer)  # type: ignore[no-any-return]

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def compare(title: str, other: Interpreter, here: Interpreter, rounds: int, *case: Any) -> float:
    """Print the times of a case in both, and their ratio; the time here."""
    theirs, ours = [], []
    for _ in range(rounds):
        theirs.append(other.measure(*case) or float("nan"))
        ours.append(here.measure(*case) or float("nan"))
    ratio = statistics.median(a / b for a, b in zip(theirs, ours))
    print(f"{title:44s} {1e6 * min(theirs):12.3f} {1e6 * min(ours):12.3f} {ratio:8.2f}", flush=True)
    return min(ours)


def compile_times(python: str, names: tuple[str, ...]) -> None:
    """Print what compilation and, in another process, loading cost."""
    for name in names:
        with tempfile.TemporaryDirectory() as cache:
            found = []
            for _ in range(2):
                interpreter = Interpreter(python, cache)
                found.append(interpreter.measure("compilation", name))
                interpreter.close()
        print(f"{name:44s} {found[0]:12.3f} {found[1]:12.4f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("other")
    parser.add_argument("--cases", nargs="+", default=["evaluation", "runs", "loops", "compile"])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--loops", nargs="+", type=int, default=LOOPS)
    parser.add_argument("--names", nargs="+", default=(*SMALL, *LARGE))
    arguments = parser.parse_args()
    rounds = arguments.rounds
    with tempfile.TemporaryDirectory() as cache:
        other, here = Interpreter(arguments.other, cache), Interpreter(sys.executable, cache)
        print(f"{'':44s} {'other, us':>12s} {'here, us':>12s} {'ratio':>8s}")
        if "evaluation" in arguments.cases:
            for name in arguments.names:
                compare(f"evaluation, {name}", other, here, rounds, "evaluation", name)
        if "runs" in arguments.cases:
            for name, rtol in RUNS:
                compare(
                    f"run, {name}, rtol {rtol:g}", other, here, rounds, "run", name, 10.0, rtol, 100
                )
        if "loops" in arguments.cases:
            times: dict[str, list[float]] = {}
            for n in arguments.loops:
                for title, case in (
                    ("evaluation", ("mean", n)),
                    ("run", ("run", n, 1.2, 1e-8, 0)),
                    ("evaluation without generated code", ("mean", n, "kernel")),
                ):
                    found = compare(f"{n} loops, {title}", other, here, rounds, *case)
                    times.setdefault(title, []).append(found)
            first = arguments.loops[0]
            for title, found in times.items():
                print(f"growth from {first} loops on, {title}: {found[-1] / found[0]:.1f}")
        other.close()
        here.close()
    if "compile" in arguments.cases:
        print(f"{'':44s} {'compiled, s':>12s} {'loaded, s':>12s}")
        compile_times(sys.executable, tuple(arguments.names))


if __name__ == "__main__":
    main()
