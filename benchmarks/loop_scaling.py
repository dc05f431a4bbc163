"""Cost of one evaluation against the number of loops: both algebras of the kernel, and Pinocchio.

    python -m benchmarks.loop_scaling [--loops 1 20 320] [--repeats 5]

Run from a checkout with the compiled kernel.  N-four-bars, at a regular configuration (upright),
half-way down, and next to the N-fold singular one.  The load-time analysis, which takes minutes
for hundreds of loops, is replaced by the row scales of two loops, spread by 5 % as it spreads
them.  CPU times of this thread, least of the repeats; ``constraintDynamics`` is called from Python.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs._kernel import core
from srm_mbs.arrays import FloatArray
from srm_mbs.loading import generated
from srm_mbs.systems.multibody import ClosedSystem

LOOPS = (1, 2, 5, 10, 20, 40, 80, 160, 320)
ANGLES = {"regular": 0.5 * np.pi, "half-way": 0.8, "singular": 1e-3}
SECONDS = 0.05


def n_four_bar(n: int) -> srm.Mechanism:
    """As :func:`srm_mbs.n_four_bar`, without its load-time analysis."""
    small = srm.n_four_bar(2)
    base = small.loops[0]
    loops = tuple(
        replace(
            base,
            name=f"pin_{i}",
            a=replace(base.a, link=f"coupler_{i}"),
            b=replace(base.b, link=f"crank_{i + 1}"),
        )
        for i in range(n)
    )
    model = pin.buildModelFromXML(generated.n_four_bar(n)[1])
    known = small.structure
    per_loop = base.rows.count
    spread = 1.0 + 0.05 * np.random.default_rng(0).standard_normal(n * per_loop)
    kept = np.tile(known.kept[:per_loop], n)
    mechanism = srm.Mechanism(model, loops, q0=np.zeros(model.nq), v0=np.zeros(model.nv))
    mechanism.__dict__["structure"] = replace(
        known,
        row_names=tuple(f"pin_{i}.{k}" for i in range(n) for k in range(per_loop)),
        row_scale=np.tile(known.row_scale[:per_loop], n) * spread,
        kept=kept,
        rank=int(kept.sum()),
        units=replace(known.units, coordinate=np.ones(model.nv)),
    )
    return mechanism


def state(model: pin.Model, angle: float) -> tuple[FloatArray, FloatArray]:
    """(q, v) with all cranks at ``angle`` (rad), moving."""
    q, v = np.zeros(model.nq), np.zeros(model.nv)
    for name, joint in zip(model.names, model.joints):
        if name.startswith("c"):
            sign = 1.0 if name.startswith("crank") else -1.0
            q[joint.idx_q], v[joint.idx_v] = sign * angle, sign
    return q, v


def least(call: Callable[[int], Any], repeats: int) -> float:
    """Least CPU microseconds of one of the calls that ``call`` makes as often as it is told."""
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
    """``pin.constraintDynamics`` with a point constraint per loop, as often as it is told."""
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
    print(f"loops  auto    {head}constraintDynamics  (us)")
    for n in arguments.loops:
        mechanism = n_four_bar(n)
        model, constants = mechanism.model, ClosedSystem(mechanism).constants()
        cells: dict[str, list[float]] = {}
        chosen = ""
        for choice in ("auto", "dense", "sparse"):
            if choice in cells:
                continue
            # One at a time: each holds a pinocchio.Data, of 8 GB for 320 loops.
            twin = core.System(model, constants | {"algebra": choice}, None)
            name = "sparse" if twin.sparse else "dense"
            chosen = name if choice == "auto" else chosen
            cells[name] = [
                least(partial(twin.repeat, 0.0, np.concatenate(state(model, angle))), repeats)
                for angle in ANGLES.values()
            ]
            del twin
        theirs = least(pinocchio(model, n, *state(model, ANGLES["half-way"])), repeats)
        ours = "".join(
            f"{cells[name][k]:{len(name) + 10}.1f}  "
            for k in range(len(ANGLES))
            for name in ("dense", "sparse")
        )
        print(f"{n:5d}  {chosen:6s}  {ours}{theirs:18.1f}", flush=True)


if __name__ == "__main__":
    main()
