"""The tables of docs/benchmarks.md: error, work, drift, orders, and the drift of SciPy.

    python -m benchmarks.headline [--repeats 5] [--json FILE]

Run from a checkout; BLAS runs on one thread.  Errors are against reduced models integrated by SciPy
near round-off, or the exact solutions in tests/data; times are the median over the repeats of one
process, so that ratios between rows can be compared.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
import timeit
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rows import closure_errors
from srm_mbs.dynamics.multibody import make_system
from srm_mbs.integration.kernel import backend
from srm_mbs.integration.kernel.system import make_kernel_system
from tests.support import reduced
from tests.support.convergence import observed_order, turning
from tests.support.mechanisms import floating_ring

EXACT = json.loads((Path(__file__).parent.parent / "tests/data/exact_solutions.json").read_text())


def _exact(*path: str) -> tuple[float, float]:
    values = EXACT
    for key in path:
        values = values[key]
    return float(values[0]), float(values[1])


def _four_bar() -> tuple[float, float]:
    state = EXACT["fourbar"]["state p(9),v(9)"]["10"]
    return float(state[2]), float(state[11])


def _reduced(field: reduced.Field, start: list[float], t: float) -> tuple[float, float]:
    # Steps of 0.01 s: at rtol = 1e-13 alone SciPy errs by 1e-10, more than the runs at 1e-10.
    run = solve_ivp(field, (0.0, t), start, "DOP853", rtol=3e-14, atol=1e-15, max_step=0.01)
    theta, omega = run.y[:, -1]
    return float(theta), float(omega)


def _spatial_dead_point() -> tuple[float, float]:
    rise = np.pi / 6  # of the guide, from which the reduced angle counts
    angle, rate = _reduced(reduced.spatial_dead_point(), [-rise, 4.0], 10.0)
    return angle + rise, rate


Reference = Callable[[], tuple[float, float]]
CASES: tuple[tuple[str, float, str, Reference], ...] = (
    ("slider_crank", 100.0, "crank", lambda: _exact("slidercrank", "theta1,omega1", "100")),
    (
        "slider_crank_slider",
        100.0,
        "crank",
        lambda: _reduced(reduced.slider_crank(0.5), [7 * np.pi / 4, 0.0], 100.0),
    ),
    ("slider_crank_whirl", 10.0, "crank", lambda: (25.8858770871720776, 2.07434062447342553)),
    ("parallelogram", 10.0, "crank", lambda: _exact("parallelogram", "theta,omega", "10")),
    (
        "n_four_bar_2",
        10.0,
        "crank_0",
        lambda: _reduced(reduced.n_four_bar(2), [np.pi / 2, -1.0], 10.0),
    ),
    ("spatial_dead_point", 10.0, "crank", _spatial_dead_point),
    (
        "slider_crank_regular",
        10.0,
        "crank",
        lambda: _reduced(reduced.regular_slider_crank(), [np.pi / 4, 4.0], 10.0),
    ),
    ("four_bar", 10.0, "crank", _four_bar),
)
RUNS = (("dop853", 1e-6), ("dop853", 1e-8), ("dop853", 1e-10), ("dopr54", 1e-8))


@dataclass(frozen=True)
class Row:
    """One run: what it cost and how good it is."""

    mechanism: str
    t_end: float
    tableau: str
    tolerance: float
    passages: int
    error: float
    evaluations: int
    drift: float
    energy_error: float
    median_seconds: float


def measure(
    name: str, t_end: float, joint: str, reference: tuple[float, float], repeats: int
) -> list[Row]:
    mechanism = srm.load(name)
    rows = []
    for tableau, tol in RUNS:
        times = []
        for _ in range(repeats):
            start = time.perf_counter()
            solution = srm.simulate(mechanism, t_end, tableau=tableau, rtol=tol, atol=tol)
            times.append(time.perf_counter() - start)
        position, rate = solution.joint(joint)
        error = max(abs(position[-1] - reference[0]), abs(rate[-1] - reference[1]))
        energy = solution.energy
        rows.append(
            Row(
                name,
                t_end,
                tableau,
                tol,
                len(solution.crossings),
                error,
                solution.stats.evaluations,
                float(solution.drift[:, 0].max()),
                float(np.abs(energy / energy[0] - 1.0).max()),
                statistics.median(times),
            )
        )
    return rows


def cost_per_evaluation(name: str, repeats: int) -> tuple[float, float, float]:
    """Least microseconds of one evaluation with its rate: on the kernel (NaN without one), in the
    Python reference, and of the Pinocchio calls in the latter.

    The least, not the median: whatever else the machine does only adds.
    """
    mechanism = srm.load(name)
    system = make_system(mechanism)
    state = mechanism.start_state
    model, data = mechanism.model, mechanism.model.createData()

    def whole() -> None:
        system.evaluate(0.0, state).rate()

    def pinocchio_only() -> None:
        pin.crba(model, data, mechanism.q0, pin.Convention.WORLD)
        pin.nonLinearEffects(model, data, mechanism.q0, mechanism.v0)

    def per_call(function: Callable[[], None], calls: int = 500) -> float:
        return 1e6 * min(timeit.repeat(function, number=calls, repeat=4 * repeats)) / calls

    inside = 2000
    compiled = float("nan")
    if backend.core is not None:
        kernel_system = make_kernel_system(system)
        compiled = per_call(lambda: kernel_system.repeat(0.0, state, inside), 1) / inside
    return compiled, per_call(whole), per_call(pinocchio_only)


ORDER_PROBLEMS: tuple[tuple[str, str, float], ...] = (
    ("trap", "slider_crank_regular", 2.0),
    ("tvd32", "slider_crank_regular", 2.0),
    ("erk4", "slider_crank_regular", 2.0),
    ("dopr54", "four_bar", 4.0),
    ("dop853", "slider_crank_regular", 2.0),
)
RING_STEPS = {"dopr54": (0.04, 0.02, 0.01)}


def orders() -> list[tuple[str, int, float, float]]:
    """(tableau, order, observed on a planar loop, observed on a floating ring with ball joints)."""
    ring = floating_ring()
    return [
        (
            tableau,
            srm.TABLEAUS[tableau].order,
            observed_order(turning(name, rate), srm.PSRM(tableau)),
            observed_order(ring, srm.PSRM(tableau), RING_STEPS.get(tableau)),
        )
        for tableau, name, rate in ORDER_PROBLEMS
    ]


def beside_scipy(name: str, tol: float = 1e-6, t_end: float = 10.0) -> tuple[float, float]:
    """Largest ||g|| of SciPy's DOP853 on the index-1 equations, and of ours, same tolerances."""
    mechanism = srm.load(name)
    start = mechanism.start_state
    theirs = solve_ivp(
        reduced.index_one(mechanism), (0.0, t_end), start, method="DOP853", rtol=tol, atol=tol
    )
    nv = mechanism.model.nv
    g, _ = closure_errors(
        mechanism.model, mechanism.loops, theirs.y[:nv].T.copy(), theirs.y[nv:].T.copy()
    )
    ours = srm.simulate(mechanism, t_end, rtol=tol, atol=tol)
    return float(np.linalg.norm(g, axis=1).max()), float(ours.drift[:, 0].max())


def scipy_leaves_the_branch(tol: float) -> float | None:
    """When SciPy's DOP853 on the index-1 equations of slider_crank leaves its branch (s), if so."""
    mechanism = srm.load("slider_crank")
    start = mechanism.start_state
    run = solve_ivp(
        reduced.index_one(mechanism), (0.0, 10.0), start, method="DOP853", rtol=tol, atol=tol
    )
    gone = np.flatnonzero(np.abs(run.y[1] + 2.0 * run.y[0]) > 1e-2)
    return float(run.t[gone[0]]) if gone.size else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = [
        row
        for name, t_end, joint, reference in CASES
        for row in measure(name, t_end, joint, reference(), arguments.repeats)
    ]
    print("| mechanism | t_end | tableau, rtol | passages | error | evaluations | drift | energy |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row.mechanism} | {row.t_end:g} s | {row.tableau}, {row.tolerance:.0e} "
            f"| {row.passages} | {row.error:.1e} | {row.evaluations} | {row.drift:.0e} m "
            f"| {row.energy_error:.0e} |"
        )
    observed = orders()
    print("\n| tableau | order | observed, planar loop | observed, ball joints and free flyer |")
    print("|---|---|---|---|")
    for tableau, order, flat, group in observed:
        print(f"| {tableau} | {order} | {flat:.2f} | {group:.2f} |")
    drifts = {}
    print("\n| mechanism, 10 s at 1e-6 | SciPy DOP853, index 1 | srm_mbs |")
    print("|---|---|---|")
    for name in ("slider_crank_regular", "four_bar", "spatial_four_bar"):
        drifts[name] = beside_scipy(name)
        print(f"| {name} | {drifts[name][0]:.0e} m | {drifts[name][1]:.0e} m |")
    leaves = {tol: scipy_leaves_the_branch(tol) for tol in (1e-4, 1e-6, 1e-8, 1e-10)}
    print("\nslider_crank: SciPy DOP853 on the index-1 equations leaves its branch at t =")
    print(", ".join(f"{t:.2f} s (tolerance {tol:g})" for tol, t in leaves.items() if t is not None))
    costs = {}
    print("\n| mechanism | kernel (us per evaluation) | Python reference | Pinocchio from Python |")
    print("|---|---|---|---|")
    for name in ("slider_crank", "four_bar", "n_four_bar_2", "spatial_four_bar", "pendulum_chain"):
        costs[name] = cost_per_evaluation(name, arguments.repeats)
        compiled, python, pinocchio = costs[name]
        print(f"| {name} | {compiled:.2f} | {python:.0f} | {pinocchio:.1f} |")
    if arguments.json:
        record = {
            "machine": platform.machine(),
            "processor_count": os.cpu_count(),
            "python": platform.python_version(),
            "pin": pin.__version__,
            "numpy": np.__version__,
            "srm_mbs": srm.__version__,
            "rows": [asdict(row) for row in rows],
            "orders": observed,
            "largest_drift": drifts,
            "scipy_leaves_the_branch": leaves,
            "microseconds_per_evaluation": costs,
        }
        arguments.json.write_text(json.dumps(record, indent=1))


if __name__ == "__main__":
    main()
