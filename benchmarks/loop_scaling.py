"""Cost of one evaluation against the number of loops: both algebras of the kernel, and Pinocchio.

    python -m benchmarks.loop_scaling [--loops 1 20 320] [--repeats 5]

Run from a checkout with the compiled kernel.  N-four-bars, at a regular configuration (upright),
half-way down, and next to the N-fold singular one.  CPU times of this thread, least of the repeats,
but for loading (with its analysis and the closing of the loops) and the largest memory of the
process so far, once; ``constraintDynamics`` is called from Python, and left out above 160 loops,
where Pinocchio's own workspace fills the memory (17 GB for 320).
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs._kernel import core
from srm_mbs._typing import FloatArray
from srm_mbs.dynamics.multibody import ClosedSystem
from srm_mbs.integration.kernel.marshalling import system_struct

LOOPS = (1, 2, 5, 10, 20, 40, 80, 160, 320)
ANGLES = {"regular": 0.5 * np.pi, "half-way": 0.8, "singular": 1e-3}
LOOPS_OF_PINOCCHIO = 160
SECONDS = 0.05


def state(model: pin.Model, angle: float) -> tuple[FloatArray, FloatArray]:
    """(q, v) with all cranks at ``angle`` (rad), moving."""
    q, v = np.zeros(model.nq), np.zeros(model.nv)
    for name, joint in zip(model.names, model.joints):
        if name.startswith("c"):
            sign = 1.0 if name.startswith("crank") else -1.0
            q[joint.idx_q], v[joint.idx_v] = sign * angle, sign
    return q, v


def least(call: Callable[[int], Any], repeats: int) -> float:
    """Least CPU time (us) of one call; ``call`` takes the number of repetitions."""
    start = time.thread_time()
    call(1)
    count = max(1, int(SECONDS / max(time.thread_time() - start, 1e-7)))
    best = np.inf
    for _ in range(repeats):
        start = time.thread_time()
        call(count)
        best = min(best, time.thread_time() - start)
    return 1e6 * float(best) / count


def pinocchio(model: pin.Model, n: int, q: FloatArray, v: FloatArray) -> Callable[[int], None]:
    """``pin.constraintDynamics`` with a point constraint per loop, for a number of repetitions."""
    tip = pin.SE3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    point, local = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
    constraints, stored = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    for i in range(n):
        a, b = model.getJointId(f"coupler_{i}"), model.getJointId(f"crank_{i + 1}")
        constraint = pin.RigidConstraintModel(point, model, a, tip, b, tip, local)
        constraints.append(constraint)
        stored.append(constraint.createData())
    data = model.createData()
    pin.initConstraintDynamics(model, data, constraints, stored)
    # A planar loop closed by a point has a redundant row: without mu the result is not finite.
    settings = pin.ProximalSettings(1e-12, 1e-10, 4)
    tau = np.zeros(model.nv)

    def call(count: int) -> None:
        for _ in range(count):
            pin.constraintDynamics(model, data, q, v, tau, constraints, stored, settings)

    return call


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, usage=argparse.SUPPRESS)
    parser.add_argument("--loops", type=int, nargs="+", default=LOOPS)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    repeats = arguments.repeats
    if core is None:
        raise SystemExit("the compiled kernel is not built")
    head = "".join(f"{kind} {where:>9}  " for where in ANGLES for kind in ("dense", "sparse"))
    print(f"loops  load (s)  memory (GB)  auto    {head}constraintDynamics  (us)")
    srm.n_four_bar(1)  # what is imported and made once
    for n in arguments.loops:
        start = time.thread_time()
        mechanism = srm.n_four_bar(n)
        load = time.thread_time() - start
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        model, constants = mechanism.model, ClosedSystem(mechanism).constants()
        cells: dict[str, list[float]] = {}
        chosen = ""
        for choice in ("auto", "dense", "sparse"):
            if choice in cells:
                continue
            kernel_system = core.System(model, system_struct(constants | {"algebra": choice}), None)
            name = "sparse" if kernel_system.sparse else "dense"
            chosen = name if choice == "auto" else chosen
            cells[name] = [
                least(
                    partial(kernel_system.repeat, 0.0, np.concatenate(state(model, angle))), repeats
                )
                for angle in ANGLES.values()
            ]
            del kernel_system
        theirs = np.nan
        if n <= LOOPS_OF_PINOCCHIO:
            theirs = least(pinocchio(model, n, *state(model, ANGLES["half-way"])), repeats)
        ours = "".join(
            f"{cells[name][k]:{len(name) + 10}.1f}  "
            for k in range(len(ANGLES))
            for name in ("dense", "sparse")
        )
        print(f"{n:5d}  {load:8.2f}  {memory:11.2f}  {chosen:6s}  {ours}{theirs:18.1f}", flush=True)


if __name__ == "__main__":
    main()
