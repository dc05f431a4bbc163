"""What a step of ``srm.Simulator`` costs beside its integration.

    python -m benchmarks.simulator_step [--models NAME ...] [--repeats 15]

Run from a checkout with the compiled kernel; BLAS runs on one thread.  A thousandth of a second per
call in one inner step, with and without new torques, against the same inner steps in one call.  CPU
times of the process, least of the repeats.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import srm_mbs as srm

MODELS = ("slider_crank_regular", "four_bar", "n_four_bar_2", "stewart_platform")
STEP = 1e-3  # s
COUNT = 300


def least(repeats: int, measured: Callable[[], float]) -> float:
    """Least time (s) per step."""
    return min(measured() for _ in range(repeats)) / COUNT


def timed(work: Callable[[], object]) -> float:
    """CPU time (s) of a piece of work."""
    start = time.process_time()
    work()
    return time.process_time() - start


def calls(simulator: srm.Simulator, torques: list[list[float] | None]) -> None:
    """One call per step."""
    for k in range(COUNT):
        simulator.step(STEP, torques[k % len(torques)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    print(f"{'microseconds':24s} {'integration':>12s} {'one call each':>14s} {'new torques':>12s}")
    for name in options.models:
        mechanism = srm.load(name)
        quiet = [0.0] * mechanism.model.nv
        small = [1e-3, *quiet[1:]]

        def fresh(mechanism: srm.Mechanism = mechanism) -> srm.Simulator:
            simulator = srm.Simulator(mechanism, step=STEP, tableau="erk4", backend="kernel")
            simulator.step(STEP)
            return simulator

        def inside(fresh: Callable[[], srm.Simulator] = fresh) -> float:
            simulator = fresh()
            return timed(lambda: simulator.step(COUNT * STEP))

        def each(
            torques: list[list[float] | None], fresh: Callable[[], srm.Simulator] = fresh
        ) -> float:
            simulator = fresh()
            return timed(lambda: calls(simulator, torques))

        rows = [
            least(options.repeats, inside),
            least(options.repeats, lambda: each([None])),
            least(options.repeats, lambda: each([quiet, small])),  # noqa: B023
        ]
        print(f"{name:24s} {rows[0] * 1e6:12.1f} {rows[1] * 1e6:14.1f} {rows[2] * 1e6:12.1f}")


if __name__ == "__main__":
    main()
