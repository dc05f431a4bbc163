"""What the measures for singular configurations cost where there are none.

    python -m benchmarks.singular_cost [--repeats 15] [--json FILE]

Run from a checkout; BLAS runs on one thread.  Regular mechanisms are run as they are, and with
placement, the guard of the branch, the zone with its history, stages on the branch, the watch
over closure errors and the look for bifurcations all left out.  The two take the same
steps, which is checked; the runs alternate; times are CPU times of the process.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import srm_mbs as srm
from srm_mbs import simulation
from srm_mbs.arrays import FloatArray
from srm_mbs.methods.base import ErrorNorm, Memory, StepResult
from srm_mbs.options import step_size_control
from srm_mbs.systems.base import System

CASES = (
    ("four_bar", 6.0),
    ("slider_crank_regular", 8.0),
    ("spatial_four_bar", 6.0),
    ("five_bar", 6.0),
)
RUNS = (("dop853", 1e-8), ("dopr54", 1e-8))


@dataclass(frozen=True)
class Plain:
    """The split PSRM with nothing for singular configurations (docs/notation.md, "The method")."""

    tableau: str

    @property
    def scheme(self) -> srm.ButcherTableau:
        return srm.TABLEAUS[self.tableau]

    def start(self, system: System, t: float, state: FloatArray, norm: ErrorNorm) -> Memory:
        terms = system.evaluate(t, state)
        return Memory(terms.rate().copy(), terms.sigma, system.magnitudes(state))

    def step(
        self, system: System, t: float, h: float, state: FloatArray, memory: Memory, norm: ErrorNorm
    ) -> StepResult:
        scheme = self.scheme
        s, A, c = scheme.n_stages, scheme.A, scheme.c
        rates = np.empty((s + 1, system.tangent_size))
        sigmas = np.full(s + 1, memory.sigma)
        rates[0] = memory.rate
        for j in range(1, s + 1):
            end = j == s
            delta = (h * (scheme.b if end else A[j, :j])) @ rates[:j]
            x = system.retract(state, delta)
            terms = system.evaluate(t + (1.0 if end else float(c[j])) * h, x)
            sigmas[j] = terms.sigma
            rate = terms.rate()
            rates[j] = system.chart_rate(delta, rate)
        magnitude = system.magnitudes(x)
        correction = terms.correction()
        weights = norm.weights(np.maximum(memory.magnitude, magnitude))
        return StepResult(
            t=t,
            h=h,
            state=system.retract(x, -correction),
            rates=rates,
            end_rate=rate - system.rate_change(correction),
            correction=correction,
            error_ratio=norm(h * (scheme.error @ rates), weights),
            sigmas=sigmas,
            rank=terms.rank,
            zone=None,
            history=None,
            multiplier=None,
            magnitude=magnitude,
        )

    def accept(self, memory: Memory, result: StepResult) -> None:
        memory.rate = result.end_rate
        memory.sigma = float(result.sigmas[-1])
        memory.magnitude = result.magnitude


@contextmanager
def nothing_for_singular_configurations() -> Iterator[None]:
    """``simulate`` without placement, guard, look at the start, and look for bifurcations."""

    def control(
        system: Any, method: Any, step: Any, first_step: Callable[[], float], t_end: float, *_: Any
    ) -> Any:
        return step_size_control(method.scheme, 0.0, t_end, step, first_step), ()

    def start(system: Any, method: Any, t: float, state: Any, norm: Any, t_end: float) -> Memory:
        return method.start(system, t, state, norm)  # type: ignore[no-any-return]

    with (
        patch.object(simulation, "_control", control),
        patch.object(simulation, "start", start),
        patch.object(simulation, "_bifurcations", lambda _: ""),
    ):
        yield


@dataclass(frozen=True)
class Row:
    """CPU times (s) of one mechanism with everything and without, and their ratio.

    ``ratio`` is that of the least times, ``ratios`` the quartiles of the ratios of runs that
    followed each other.
    """

    mechanism: str
    tableau: str
    evaluations: int
    least_with: float
    least_without: float
    median_with: float
    median_without: float
    ratio: float
    ratios: tuple[float, float, float]


def measure(name: str, t_end: float, tableau: str, tol: float, repeats: int) -> Row:
    mechanism = srm.load(name)
    plain = Plain(tableau)

    def run(everything: bool) -> tuple[float, srm.Solution]:
        start = time.process_time()
        if everything:
            solution = srm.simulate(mechanism, t_end, tableau=tableau, rtol=tol)
        else:
            with nothing_for_singular_configurations():
                solution = srm.simulate(mechanism, t_end, method=plain, rtol=tol)
        return time.process_time() - start, solution

    both = [run(everything)[1] for everything in (True, False)]
    evaluations = [solution.stats.evaluations for solution in both]
    if evaluations[0] != evaluations[1] or not np.array_equal(both[0].q, both[1].q):
        raise SystemExit(f"{name}, {tableau}: the runs differ, evaluations {evaluations}")
    times: dict[bool, list[float]] = {True: [], False: []}
    for k in range(repeats):
        for everything in (True, False) if k % 2 else (False, True):
            times[everything].append(run(everything)[0])
    ratios = [a / b for a, b in zip(times[True], times[False])]
    low, middle, high = statistics.quantiles(ratios, n=4)
    return Row(
        name,
        tableau,
        evaluations[0],
        min(times[True]),
        min(times[False]),
        statistics.median(times[True]),
        statistics.median(times[False]),
        min(times[True]) / min(times[False]),
        (low, middle, high),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    print("| mechanism | tableau | evaluations | least (ms) | without | ratio | quartiles |")
    print("|---|---|---|---|---|---|---|")
    for name, t_end in CASES:
        for tableau, tol in RUNS:
            row = measure(name, t_end, tableau, tol, arguments.repeats)
            rows.append(row)
            quartiles = " ".join(f"{ratio:.3f}" for ratio in row.ratios)
            print(
                f"| {row.mechanism} | {row.tableau} | {row.evaluations} "
                f"| {1e3 * row.least_with:.1f} | {1e3 * row.least_without:.1f} "
                f"| {row.ratio:.3f} | {quartiles} |",
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    main()
