"""Run times of robots whose damping and friction make them stiff.

    python -m benchmarks.stiff_robots [--dir DIR] [--rtol 1e-6] [--robots NAME_OR_FILE ...]

Files of example-robot-data, by default those of the installed package, or any others.  Each robot
falls for 1 s from its start, on its fixed base and without control; the least CPU time of three
runs counts.  Errors are those of all joints after 0.1 and 1 s against SciPy (rtol = 1e-9): Radau on
Pinocchio's dynamics, with couplings eliminated, or, with closures between links or force elements,
DOP853 on the accelerations of the Python reference with residuals damped out.  For comparison
dop853 runs for 5 ms or 20000 time constants.  A run that stops ends the benchmark.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp
from scipy.linalg import null_space

import srm_mbs as srm
from srm_mbs._typing import FloatArray
from srm_mbs.analysis.time_constants import time_constants
from srm_mbs.dynamics.multibody import make_system

ROBOTS = {
    "allegro_hand": "allegro_hand_description/urdf/allegro_left_hand.urdf",
    "centauro": "centauro_description/urdf/centauro.urdf",
    "talos": "talos_data/robots/talos_full_v2.urdf",
    "talos_reduced": "talos_data/robots/talos_reduced.urdf",
    "tiago_pro": "tiago_pro_description/robots/tiago_pro.urdf",
    "icub": "icub_description/robots/icub.urdf",
    "icub_reduced": "icub_description/robots/icub_reduced.urdf",
    "pr2": "pr2_description/urdf/pr2.urdf",
    "tiago": "tiago_description/robots/tiago.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "go1": "go1_description/urdf/go1.urdf",
    "cassie": "cassie_description/robots/cassie.sdf",
    "cassie_v2": "cassie_description/robots/cassie_v2.sdf",
}
SPANS = (0.1, 1.0)
"""After which runs are compared (s); the work is that of the last one."""
EXPLICIT_SPAN, EXPLICIT_CONSTANTS = 5e-3, 2e4
"""Span of explicit runs (s), and the most time constants that it contains."""
REPEATS = 3
DIFFERENCE = 1e-6
"""Step of the differences for the Jacobian of the reference, rad, m and per second."""
DAMPED = 30.0
"""Rate (1/s) at which the reference damps residuals of closures."""


def installed_robots() -> Path:
    """The folder of the robots of the installed example-robot-data."""
    root = Path(pin.__file__).parents[1]
    while not (share := root / "share" / "example-robot-data" / "robots").is_dir():
        if root == root.parent:
            raise SystemExit("example-robot-data is not installed: give its folder with --dir")
        root = root.parent
    return share


def reference(mechanism: srm.Mechanism) -> list[FloatArray]:
    """Positions (nv,) of the joints after each of the ``SPANS``, relative to the start."""
    linked = bool(mechanism.forces) or any(loop.anchors for loop in mechanism.loops)
    if linked:
        basis, accelerations = np.eye(mechanism.model.nv), damped_accelerations(mechanism)
    else:
        basis, accelerations = free_accelerations(mechanism)
    k = basis.shape[1]

    def field(t: float, y: FloatArray) -> FloatArray:
        moved = pin.integrate(mechanism.model, mechanism.q0, basis @ y[:k])
        return np.concatenate([y[k:], accelerations(moved, basis @ y[k:])])

    def slopes(t: float, y: FloatArray) -> FloatArray:
        # Those of SciPy lengthen their differences of coordinates that do not act until they
        # overflow.
        steps = DIFFERENCE * np.eye(2 * k)
        return np.array([field(t, y + step) - field(t, y - step) for step in steps]).T / (
            2.0 * DIFFERENCE
        )

    run = solve_ivp(
        field,
        (0.0, SPANS[-1]),
        np.concatenate([np.zeros(k), basis.T @ mechanism.v0]),
        rtol=1e-9,
        atol=1e-11,
        t_eval=SPANS,
        **({"method": "DOP853"} if linked else {"method": "Radau", "jac": slopes}),
    )
    if not run.success:
        raise SystemExit(f"{mechanism.name}: {run.message}")
    return [basis @ y[:k] for y in run.y.T]


Accelerations = Callable[[FloatArray, FloatArray], FloatArray]
"""(q, v) -> accelerations of free coordinates."""


def free_accelerations(mechanism: srm.Mechanism) -> tuple[FloatArray, Accelerations]:
    """Basis (nv, k) of the velocities that couplings of joints leave, and the accelerations (k,)
    along it, by Pinocchio."""
    model, speed = mechanism.model, mechanism.friction_speed
    data = model.createData()
    rows = np.zeros((len(mechanism.loops), model.nv))
    for row, loop in zip(rows, mechanism.loops):
        (coupling,) = loop.rows.joint_rows
        for factor, name in zip(coupling.coefficients, coupling.joints):
            row[model.joints[model.getJointId(name)].idx_v] = factor
    free = null_space(rows) if len(rows) else np.eye(model.nv)

    def accelerations(q: FloatArray, v: FloatArray) -> FloatArray:
        force = -model.damping * v - model.friction * np.tanh(v / speed)
        if not len(rows):
            return np.array(pin.aba(model, data, q, v, force))
        M = pin.crba(model, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        force = force - pin.nonLinearEffects(model, data, q, v)
        found: FloatArray = np.linalg.solve(free.T @ M @ free, free.T @ force)
        return found

    return free, accelerations


def damped_accelerations(mechanism: srm.Mechanism) -> Accelerations:
    """Accelerations (nv,) that drive the residuals of closures to zero, critically damped."""
    system, nv = make_system(mechanism), mechanism.model.nv

    def accelerations(q: FloatArray, v: FloatArray) -> FloatArray:
        terms = system.evaluate(0.0, np.concatenate([q, v]))
        residuals = terms.correction()
        damping = DAMPED**2 * residuals[:nv] + 2.0 * DAMPED * residuals[nv:]
        rates: FloatArray = terms.rate()[nv:] - damping
        return rates

    return accelerations


def measured(
    mechanism: srm.Mechanism, t_end: float, rtol: float, tableau: str
) -> tuple[srm.Solution, float]:
    """A run, and the least CPU time (s) of some."""
    took = []
    for _ in range(REPEATS):
        began = time.process_time()
        run = srm.simulate(mechanism, t_end, rtol=rtol, tableau=tableau)
        took.append(time.process_time() - began)
        if not run.success:
            raise SystemExit(f"{mechanism.name}, {tableau}: {run.message}")
    return run, min(took)


def row(name: str, path: Path, rtol: float) -> str:
    """One line of the table."""
    mechanism = srm.load(path, allow_outside=True, base="fixed")
    model = mechanism.model
    if any(joint.nv != 1 for joint in list(model.joints)[1:]):
        raise SystemExit(f"{name}: the reference is for joints of one degree of freedom")
    shortest = next(iter(time_constants(mechanism)), None)
    runs = [measured(mechanism, span, rtol, "auto") for span in SPANS]
    run, seconds = runs[-1]
    errors = [
        np.abs(pin.difference(model, mechanism.q0, short.q[-1]) - moved).max()
        for (short, _), moved in zip(runs, reference(mechanism))
    ]
    span, stiff = EXPLICIT_SPAN, ""
    if shortest is not None:
        span = min(span, EXPLICIT_CONSTANTS * shortest.seconds)
        stiff = f"{shortest.element}, {shortest.seconds:.1e} s"
    rate = measured(mechanism, span, rtol, "dop853")[1] / span
    return (
        f"| {name} | {model.nv} | {len(mechanism.loops)} | {stiff} | {run.stats.steps} | "
        f"{run.stats.evaluations} | {seconds / SPANS[-1]:.2g} | {rate:.2g} | "
        + " | ".join(f"{error:.0e}" for error in errors)
        + " |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Run times of stiff robots")
    parser.add_argument("--dir", type=Path, help="folder 'robots' of example-robot-data")
    parser.add_argument("--rtol", type=float, default=1e-6)
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), help="names, or files")
    arguments = parser.parse_args()
    folder = arguments.dir or installed_robots()
    print(
        "| robot | coordinates | closures | shortest time constant | steps | evaluations | "
        "CPU s per s | dop853 | error after 0.1 s | 1 s |\n" + "|---" * 10 + "|"
    )
    warnings.simplefilter("ignore")
    for name in arguments.robots:
        path = folder / ROBOTS[name] if name in ROBOTS else Path(name)
        print(row(path.stem if name not in ROBOTS else name, path, arguments.rtol), flush=True)


if __name__ == "__main__":
    main()
