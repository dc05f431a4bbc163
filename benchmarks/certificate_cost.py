"""What the analysis of a run costs beside the run: passages, certificate, balance, reactions.

    python -m benchmarks.certificate_cost [--models NAME ...] [--seconds 10] [--repeats 5]

Run from a checkout with the compiled kernel; BLAS runs on one thread.  CPU times of the process in
milliseconds, the least of the repeats, each on a fresh run: other programs only add to them.
``certify`` is without its two ``reruns``, which are made and let go of again, and includes the
passages and the balance where it reads them, and its text; ``of run`` and ``of runs`` are its
parts, in per cent, of the run and of all three runs.
``n_four_bar_N`` is ``srm.n_four_bar(N)``; ``swing_X`` is a parallelogram that swings up to X rad
before its change points, on both sides.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import srm_mbs as srm
from srm_mbs.analysis.accuracy import error_estimate
from tests.support.turning import lifted

MODELS = (
    "stewart_platform",
    "jansen_walker",
    "klann_walker",
    "slider_crank",
    "four_bar",
    "n_four_bar_2",
    "n_four_bar_40",
    "n_four_bar_80",
    "delta_robot",
    "bricard",
    "parallelogram",
    "swing_1e-3",
    "swing_1e-5",
)
COUNTED = "n_four_bar_"
TURNING = "swing_"


def mechanism_of(name: str) -> srm.Mechanism:
    """A bundled mechanism, ``n_four_bar_N`` or ``swing_X``."""
    if name.startswith(TURNING):
        return lifted(-float(name.removeprefix(TURNING))).mechanism
    if name.startswith(COUNTED):
        return srm.n_four_bar(int(name.removeprefix(COUNTED)))
    return srm.load(name)


def spent(work: Callable[[], Any]) -> float:
    """CPU time (ms) of a piece of work."""
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def certified(run: srm.Solution) -> tuple[float, float]:
    """CPU times (ms) of ``certify`` and its text without its reruns, and of these."""
    reruns = 0.0
    rerun = error_estimate.rerun
    made: list[Any] = []

    def timed(*args: Any, **options: Any) -> Any:
        nonlocal reruns
        start = time.process_time()
        try:
            made.append(rerun(*args, **options))
        finally:
            reruns += 1e3 * (time.process_time() - start)
        return made[-1]

    with mock.patch.object(error_estimate, "rerun", timed):
        whole = spent(lambda: str(srm.certify(run)))
    return whole - reruns, reruns + spent(made.clear)


READINGS: dict[str, Callable[[srm.Solution], Any]] = {
    "crossings": lambda run: run.crossings,
    "energy": lambda run: run.energy,
    "balance": lambda run: run.energy_balance,
    "drift": lambda run: run.drift,
    "reactions": lambda run: run.reactions,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    heads = ("run", "reruns", "certify", *READINGS, "mobility")
    shown = (*heads, "of run", "of runs")
    print(f"{'ms':18s} steps passages" + "".join(f"{head:>10s}" for head in shown))
    for name in options.models:
        mechanism = mechanism_of(name)

        def run(mechanism: srm.Mechanism = mechanism) -> srm.Solution:
            return srm.simulate(mechanism, options.seconds)

        run()  # what is imported and made once
        rows: dict[str, list[float]] = {head: [] for head in heads}
        for _ in range(options.repeats):
            start = time.process_time()
            whole = run()
            rows["run"].append(1e3 * (time.process_time() - start))
            added, reruns = certified(run())
            rows["certify"].append(added)
            rows["reruns"].append(reruns)
            for head, reading in READINGS.items():
                rows[head].append(spent(lambda: reading(whole)))  # noqa: B023
            rows["mobility"].append(spent(lambda: srm.mobility_map(whole)))  # noqa: B023
        least = {head: min(rows[head]) for head in heads}
        parts = (least["run"], least["run"] + least["reruns"])
        percents = (1e2 * least["certify"] / part for part in parts)
        numbers = "".join(f"{value:10.2f}" for value in (*least.values(), *percents))
        print(f"{name:18s} {whole.stats.steps:5d} {len(whole.crossings):8d}{numbers}", flush=True)


if __name__ == "__main__":
    main()
