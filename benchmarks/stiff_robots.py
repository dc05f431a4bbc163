"""Run times of robots whose damping and friction make them stiff.

    python -m benchmarks.stiff_robots [--dir DIR] [--rtol 1e-6] [--robots NAME ...]

Files of example-robot-data, by default those of the installed package.  Each robot falls for 1 s
from its start, on its fixed base and without control; the least CPU time of three runs counts.
Errors are those of all joints after 0.1 s against SciPy's Radau (rtol = 1e-9) on Pinocchio's
dynamics, with couplings eliminated.  For comparison dop853 runs for 5 ms or 20000 time constants.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp
from scipy.linalg import null_space

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.analysis.time_constants import time_constants

ROBOTS = {
    "allegro_hand": "allegro_hand_description/urdf/allegro_left_hand.urdf",
    "centauro": "centauro_description/urdf/centauro.urdf",
    "talos": "talos_data/robots/talos_full_v2.urdf",
    "talos_reduced": "talos_data/robots/talos_reduced.urdf",
    "tiago_pro": "tiago_pro_description/robots/tiago_pro.urdf",
    "icub": "icub_description/robots/icub.urdf",
    "icub_reduced": "icub_description/robots/icub_reduced.urdf",
    "pr2": "pr2_description/urdf/pr2.urdf",
}
SPAN, COMPARED_SPAN = 1.0, 0.1
EXPLICIT_SPAN, EXPLICIT_CONSTANTS = 5e-3, 2e4
"""Span of explicit runs (s), and the most time constants that it contains."""
REPEATS = 3


def installed_robots() -> Path:
    """The folder of the robots of the installed example-robot-data."""
    root = Path(pin.__file__).parents[1]
    while not (share := root / "share" / "example-robot-data" / "robots").is_dir():
        if root == root.parent:
            raise SystemExit("example-robot-data is not installed: give its folder with --dir")
        root = root.parent
    return share


def reference(mechanism: srm.Mechanism, t_end: float) -> FloatArray:
    """Positions (k,) of the joints at ``t_end`` (s), relative to the start."""
    model, speed = mechanism.model, mechanism.friction_speed
    data = model.createData()
    rows = np.zeros((len(mechanism.loops), model.nv))
    for row, loop in zip(rows, mechanism.loops):
        (coupling,) = loop.rows.joint_rows
        for factor, name in zip(coupling.coefficients, coupling.joints):
            row[model.joints[model.getJointId(name)].idx_v] = factor
    free = null_space(rows) if len(rows) else np.eye(model.nv)
    k = free.shape[1]

    def field(t: float, y: FloatArray) -> FloatArray:
        q, v = pin.integrate(model, mechanism.q0, free @ y[:k]), free @ y[k:]
        force = -model.damping * v - model.friction * np.tanh(v / speed)
        if not len(rows):
            return np.concatenate([v, pin.aba(model, data, q, v, force)])
        M = pin.crba(model, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        force = force - pin.nonLinearEffects(model, data, q, v)
        return np.concatenate([y[k:], np.linalg.solve(free.T @ M @ free, free.T @ force)])

    start = np.concatenate([np.zeros(k), free.T @ mechanism.v0])
    run = solve_ivp(field, (0.0, t_end), start, method="Radau", rtol=1e-9, atol=1e-11)
    if not run.success:
        raise SystemExit(f"{mechanism.name}: {run.message}")
    moved: FloatArray = free @ run.y[:k, -1]
    return moved


def measured(
    mechanism: srm.Mechanism, t_end: float, rtol: float, tableau: str
) -> tuple[srm.Solution, float]:
    """A run, and the least CPU time (s) of some."""
    took = []
    for _ in range(REPEATS):
        began = time.process_time()
        run = srm.simulate(mechanism, t_end, rtol=rtol, tableau=tableau)
        took.append(time.process_time() - began)
    return run, min(took)


def row(name: str, path: Path, rtol: float) -> str:
    """One line of the table."""
    mechanism = srm.load(path, allow_outside=True)
    model = mechanism.model
    shortest = next(iter(time_constants(mechanism)), None)
    run, seconds = measured(mechanism, SPAN, rtol, "auto")
    if not run.success:
        raise SystemExit(f"{name}: {run.message}")
    short = srm.simulate(mechanism, COMPARED_SPAN, rtol=rtol)
    moved = pin.difference(model, mechanism.q0, short.q[-1])
    error = np.abs(moved - reference(mechanism, COMPARED_SPAN)).max()
    span, stiff = EXPLICIT_SPAN, ""
    if shortest is not None:
        span = min(span, EXPLICIT_CONSTANTS * shortest.seconds)
        stiff = f"{shortest.element}, {shortest.seconds:.1e} s"
    rate = measured(mechanism, span, rtol, "dop853")[1] / span
    return (
        f"| {name} | {model.nv} | {len(mechanism.loops)} | {stiff} | {run.stats.steps} | "
        f"{run.stats.evaluations} | {seconds / SPAN:.2g} | {rate:.2g} | {error:.0e} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Run times of stiff robots")
    parser.add_argument("--dir", type=Path, help="folder 'robots' of example-robot-data")
    parser.add_argument("--rtol", type=float, default=1e-6)
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    arguments = parser.parse_args()
    folder = arguments.dir or installed_robots()
    print(
        "| robot | coordinates | couplings | shortest time constant | steps | evaluations | "
        "CPU s per s | dop853 | error |\n" + "|---" * 9 + "|"
    )
    warnings.simplefilter("ignore")
    for name in arguments.robots:
        print(row(name, folder / ROBOTS[name], arguments.rtol), flush=True)


if __name__ == "__main__":
    main()
