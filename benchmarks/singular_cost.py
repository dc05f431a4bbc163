"""What the measures for singular configurations cost where there are none.

    python -m benchmarks.singular_cost [--repeats 15] [--json FILE]

Run from a checkout; BLAS runs on one thread.  Regular mechanisms are run as they are, and with
placement, the guard of the branch, the zone with its history, stages on the branch, the watch
over closure errors and the look for bifurcations all left out: on the Python reference by a step
without them, on the compiled kernel by constants that never let them begin (it still follows the
slope of sigma).  The two take the same steps, which is checked; the runs alternate; times are CPU
times of the process.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.system import System
from srm_mbs.integration.driver import Closures
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.kernel import marshalling, run
from srm_mbs.integration.methods import near_singular, psrm, split_step
from srm_mbs.integration.methods.base import ErrorNorm, IntegratorState, StepResult
from srm_mbs.integration.methods.split_step import later_stages
from srm_mbs.simulation import runner

CASES = (
    ("four_bar", 6.0),
    ("slider_crank_regular", 8.0),
    ("spatial_four_bar", 6.0),
    ("five_bar", 6.0),
)
RUNS = (("dop853", 1e-8), ("dopr54", 1e-8))
KERNEL_REPEATS = 10
"""Runs on the kernel per run in Python: they are that much shorter."""


@dataclass(frozen=True)
class PlainStep:
    """The split PSRM with nothing for singular configurations (docs/notation.md, "The method")."""

    scheme: srm.ButcherTableau
    eps: None

    def start(
        self, system: System, t: float, state: FloatArray, norm: ErrorNorm
    ) -> IntegratorState:
        """First stage; no multiplier history."""
        terms = system.evaluate(t, state)
        return IntegratorState(terms.rate().copy(), terms.sigma, system.state_scale(state))

    def step(
        self,
        system: System,
        t: float,
        h: float,
        state: FloatArray,
        memory: IntegratorState,
        norm: ErrorNorm,
    ) -> StepResult:
        """One step."""
        scheme, s = self.scheme, self.scheme.n_stages
        all_weights, fractions = later_stages(scheme)
        rates = np.zeros((s + 1, system.tangent_size))
        weighed = rates[:s]
        sigmas = [memory.sigma]
        rates[0] = memory.rate
        for j, weights, fraction in zip(range(1, s + 1), h * all_weights, fractions):
            delta = weights.dot(weighed)
            x = system.retract(state, delta)
            terms = system.evaluate(t + fraction * h, x)
            sigmas.append(terms.sigma)
            rate = terms.rate()
            rates[j] = system.chart_rate(delta, rate)
        state_scale = system.state_scale(x)
        correction = terms.correction()
        weights = norm.weights(np.maximum(memory.state_scale, state_scale))
        return StepResult(
            t=t,
            h=h,
            state=system.retract(x, -correction),
            rates=rates,
            end_rate=rate - system.rate_change(correction),
            correction=correction,
            error_ratio=norm(h * (scheme.error @ rates), weights),
            sigmas=np.array(sigmas),
            rank=terms.rank,
            state_scale=state_scale,
        )

    def accept(self, memory: IntegratorState, result: StepResult) -> None:
        """Rate, sigma and size at the end of the step."""
        memory.steps += 1
        memory.rate = result.end_rate
        memory.sigma = float(result.sigmas[-1])
        memory.state_scale = result.state_scale


@contextmanager
def nothing_for_singular_configurations() -> Iterator[None]:
    """``simulate`` with no placement, guard, watch, look at the start and look for bifurcations."""

    placed_control = runner.placed_control

    def control(system: Any, options: Any, first_step: Callable[[], float], *_: Any) -> Any:
        return placed_control(system, options._replace(placement="off"), first_step)

    def start(
        system: Any, method: Any, t: float, state: Any, norm: Any, *_: Any, **__: Any
    ) -> IntegratorState:
        return method.start(system, t, state, norm)  # type: ignore[no-any-return]

    with (
        patch.object(psrm, "SplitStep", PlainStep),
        patch.object(runner, "placed_control", control),
        patch.object(runner, "start", start),
        patch.object(runner, "bifurcation_sentences", lambda _: ""),
        patch.object(Closures, "failure", lambda *_: None),
    ):
        yield


@contextmanager
def nothing_on_the_kernel() -> Iterator[None]:
    """The same for the kernel, together with ``placement="off"``."""
    with (
        patch.object(near_singular, "WATCHED_SIGMA", -1.0),
        patch.object(near_singular, "FAR_STEPS", 0.0),
        patch.object(split_step, "RESIDUAL_EVERY", -(2**31 - 1)),
    ):
        never = marshalling.constants()
    with (
        patch.object(run, "CONSTANTS", never),
        patch.object(runner, "bifurcation_sentences", lambda _: ""),
    ):
        yield


@dataclass(frozen=True)
class Row:
    """CPU times (s) of one mechanism with everything and without, and their ratio.

    ``ratio`` is that of the least times, ``ratios`` the quartiles of the ratios of runs that
    followed each other.
    """

    backend: str
    mechanism: str
    tableau: str
    evaluations: int
    least_with: float
    least_without: float
    median_with: float
    median_without: float
    ratio: float
    ratios: tuple[float, float, float]


def measure(backend: str, name: str, t_end: float, tableau: str, tol: float, repeats: int) -> Row:
    mechanism = srm.load(name)
    nothing = {"python": nothing_for_singular_configurations, "kernel": nothing_on_the_kernel}
    off = {"python": "automatic", "kernel": "off"}

    def timed(everything: bool) -> tuple[float, srm.Solution]:
        with nullcontext() if everything else nothing[backend]():
            start = time.process_time()
            solution = srm.simulate(
                mechanism,
                t_end,
                tableau=tableau,
                rtol=tol,
                backend=backend,
                placement="automatic" if everything else off[backend],
            )
            return time.process_time() - start, solution

    both = [timed(everything)[1] for everything in (True, False)]
    evaluations = [solution.stats.evaluations for solution in both]
    if evaluations[0] != evaluations[1] or not np.array_equal(both[0].q, both[1].q):
        raise SystemExit(f"{name}, {tableau}: the runs differ, evaluations {evaluations}")
    times: dict[bool, list[float]] = {True: [], False: []}
    for k in range(repeats):
        for everything in (True, False) if k % 2 else (False, True):
            times[everything].append(timed(everything)[0])
    ratios = [a / b for a, b in zip(times[True], times[False])]
    low, middle, high = statistics.quantiles(ratios, n=4)
    return Row(
        backend,
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
    print(
        "| backend | mechanism | tableau | evaluations | least (ms) | without | ratio | quartiles |"
    )
    print("|---|---|---|---|---|---|---|---|")
    backends = ("kernel", "python") if kernel.core is not None else ("python",)
    for backend, (name, t_end), (tableau, tol) in product(backends, CASES, RUNS):
        repeats = arguments.repeats * (KERNEL_REPEATS if backend == "kernel" else 1)
        row = measure(backend, name, t_end, tableau, tol, repeats)
        rows.append(row)
        quartiles = " ".join(f"{ratio:.3f}" for ratio in row.ratios)
        print(
            f"| {backend} | {row.mechanism} | {row.tableau} | {row.evaluations} "
            f"| {1e3 * row.least_with:.2f} | {1e3 * row.least_without:.2f} "
            f"| {row.ratio:.3f} | {quartiles} |",
            flush=True,
        )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    main()
