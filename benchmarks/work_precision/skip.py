"""What a scene does not need is skipped: each item of the design with it and without.

Switched off here, not by options of the package.  Runs with the Python backend; both kinds of run
alternate, and must give the same motion.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from benchmarks.work_precision import timing
from benchmarks.work_precision.records import Results
from srm_mbs.dynamics.constraints.projection import cholesky, unwhiten, whiten
from srm_mbs.dynamics.multibody import OpenSystem, make_system
from srm_mbs.formats.urdf.parser import lock_joints
from srm_mbs.integration.kernel import backend as kernel
from srm_mbs.integration.kernel.marshalling import system_struct
from srm_mbs.integration.methods import split_step
from srm_mbs.simulation import runner
from srm_mbs.visualization.animation.shapes import visuals_of

RTOL = 1e-8
SAME = 1e-6
"""Largest difference (rad, rad/s) at the end of two runs that must be the same motion."""


@dataclass(frozen=True)
class Item:
    """One item: ``skipped`` is what the package does, ``done`` the same with the work done anyway.

    ``result`` turns what the calls return into numbers that must agree; None: nothing to compare.
    """

    name: str
    case: str
    skipped: Callable[[], Any]
    done: Callable[[], Any]
    result: Callable[[Any], Any] | None = None


def _last(solution: srm.Solution) -> Any:
    return np.concatenate([solution.q[-1], solution.v[-1]])


def _run(mechanism: srm.Mechanism, t_end: float) -> srm.Solution:
    return srm.simulate(mechanism, t_end, rtol=RTOL, backend="python")


def _under(patched: Callable[[], AbstractContextManager[Any]], call: Callable[[], Any]) -> Any:
    def run() -> Any:
        with patched():
            return call()

    return run


class _AlgebraAnyway(OpenSystem):
    """An open chain through mass matrix, factorisation and whitening instead of ``aba``."""

    def evaluate(self, t: float, state: Any, zone: Any = None) -> Any:
        self.evaluations += 1
        q, v = self.split(state)
        pin.crba(self.model, self.data, q, pin.Convention.WORLD)
        f = self.applied_force(t, q, v) - pin.nonLinearEffects(self.model, self.data, q, v)
        U = cholesky(self.data.M)
        rate = self._terms.rate()
        rate[: self.nv] = v
        rate[self.nv :] = unwhiten(U, whiten(U, f))
        return self._terms


def _open_chain() -> Item:
    mechanism = srm.load("pendulum_chain")
    anyway = lambda: patch.object(runner, "make_system", _AlgebraAnyway)  # noqa: E731
    run = lambda: _run(mechanism, 3.0)  # noqa: E731
    return Item(
        "constraint algebra of an open chain",
        "pendulum_chain, 3 s",
        run,
        _under(anyway, run),
        _last,
    )


def _zero_rows() -> Item:
    mechanism = srm.load("n_four_bar_5")
    structure = mechanism.structure
    kept = np.ones_like(structure.kept)
    whole = mechanism.with_structure(replace(structure, kept=kept))
    dropped = int((~structure.kept).sum())
    return Item(
        f"{dropped} rows that are always zero",
        "n_four_bar_5, 5 s",
        lambda: _run(mechanism, 5.0),
        lambda: _run(whole, 5.0),
        _last,
    )


def _locked_joints() -> Item:
    loaded = srm.load("pendulum_chain")
    model, q = loaded.model, np.array(loaded.q0)
    reduced = srm.Mechanism(lock_joints(model, ["link_2"], q), q0=q[:2], v0=np.zeros(2))
    joint = model.getJointId("link_2")
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    frame = data.liMi[joint]
    anchor = srm.Anchor(
        "link_1", xyz=tuple(frame.translation), rpy=tuple(pin.rpy.matrixToRpy(frame.rotation))
    )
    held = srm.Mechanism(
        model,
        (srm.LoopClosure("frame", anchor, srm.Anchor("link_2"), name="lock"),),
        q0=q,
        v0=np.zeros(3),
    )
    return Item(
        "a locked joint, otherwise held by a closure",
        "pendulum_chain with link_2 locked, 3 s",
        lambda: _run(reduced, 3.0),
        lambda: _run(held, 3.0),
        lambda solution: np.concatenate([solution.q[-1, :2], solution.v[-1, :2]]),
    )


def _twice(mechanism: srm.Mechanism) -> srm.Mechanism:
    """Two copies of a mechanism in one model, the names of the second marked."""
    model = pin.Model(mechanism.model)
    for j in range(1, mechanism.model.njoints):
        source = mechanism.model
        parent = source.parents[j]
        index = model.addJoint(
            parent + source.njoints - 1 if parent else 0,
            source.joints[j],
            source.jointPlacements[j],
            f"{source.names[j]}'",
        )
        model.appendBodyToJoint(index, source.inertias[j], pin.SE3.Identity())
    for frame in mechanism.model.frames:
        if frame.type == pin.FrameType.BODY and frame.parentJoint:
            index = model.getJointId(f"{mechanism.model.names[frame.parentJoint]}'")
            model.addBodyFrame(f"{frame.name}'", index, frame.placement, 0)

    def moved(anchor: srm.Anchor) -> srm.Anchor:
        fixed = anchor.resolve(mechanism.model)[0] == 0
        return anchor if fixed else replace(anchor, link=f"{anchor.link}'")

    second = [
        replace(loop, a=moved(loop.a), b=moved(loop.b), name=f"{loop.name}'")
        for loop in mechanism.loops
    ]
    return srm.Mechanism(
        model,
        (*mechanism.loops, *second),
        q0=np.tile(mechanism.q0, 2),
        v0=np.tile(mechanism.v0, 2),
    )


def _islands() -> Item:
    """On the kernel: its sparse algebra never lets islands meet, the dense one mixes them."""
    double = _twice(srm.load("n_four_bar_2"))
    system = make_system(double)
    state = double.start_state

    def evaluate(algebra: str) -> Callable[[], None]:
        constants = system.constants() | {"algebra": algebra}
        kernel_system = kernel.core.System(double.model, system_struct(constants), None)
        return lambda: kernel_system.repeat(0.0, state, 10000)

    return Item(
        "islands factorised apart",
        "two n_four_bar_2 in one model, 10000 evaluations",
        evaluate("sparse"),
        evaluate("dense"),
    )


def _geometry() -> Item:
    def load() -> srm.Mechanism:
        return srm.load("four_bar")

    def both() -> srm.Mechanism:
        mechanism = load()
        visuals_of(mechanism)
        return mechanism

    return Item("geometry before playback asks", "load four_bar", load, both)


def _lazy_results() -> Item:
    mechanism = srm.load("four_bar")

    def run() -> srm.Solution:
        return _run(mechanism, 5.0)

    def everything() -> srm.Solution:
        solution = run()
        _ = solution.energy, solution.drift, solution.reactions
        return solution

    return Item("energy, drift, reactions", "four_bar, 5 s", run, everything, _last)


def _placement() -> Item:
    mechanism = srm.load("four_bar")
    run = lambda: _run(mechanism, 5.0)  # noqa: E731
    near = lambda: patch.object(split_step, "FAR_STEPS", 1e300)  # noqa: E731
    return Item(
        "placement and zone while sigma is far", "four_bar, 5 s", run, _under(near, run), _last
    )


def _history() -> Item:
    mechanism = srm.load("four_bar")
    run = lambda: _run(mechanism, 5.0)  # noqa: E731
    always = lambda: patch.object(split_step, "WATCHED_SIGMA", 1e300)  # noqa: E731
    return Item(
        "multiplier history while sigma is far", "four_bar, 5 s", run, _under(always, run), _last
    )


ITEMS: tuple[Callable[[], Item], ...] = (
    _open_chain,
    _zero_rows,
    _locked_joints,
    *((_islands,) if kernel.core is not None else ()),
    _geometry,
    _lazy_results,
    _placement,
    _history,
)
HEAVY = ("meshcat", "matplotlib.figure", "scipy.optimize", "rich.console", "typer", "pydantic")


def import_seconds(modules: tuple[str, ...]) -> float:
    """CPU seconds that a new process needs to import ``modules``."""
    code = (
        "import time\nstart = time.process_time()\n"
        + "".join(f"import {module}\n" for module in modules)
        + "print(time.process_time() - start)"
    )
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True
    )
    return float(run.stdout)


def measure_unneeded(
    results: Results, *, repeats: int, thin: bool, say: Callable[[str], None]
) -> None:
    """Append a row per item: least CPU seconds as it is, and with the work done anyway."""
    for make in ITEMS[:1] if thin else ITEMS:
        item = make()
        calls = item.skipped, item.done
        first = [call() for call in calls]
        if item.result is not None:
            difference = float(np.abs(item.result(first[0]) - item.result(first[1])).max())
            if not difference < SAME:
                raise RuntimeError(f"{item.name}: the two runs differ by {difference:.1e}")
        seconds: list[list[float]] = [[], []]
        for k in range(repeats):
            for which in (0, 1) if k % 2 else (1, 0):
                seconds[which].append(timing.once(calls[which])[0])
        _append(results, item.name, item.case, min(seconds[0]), min(seconds[1]), say)
    if not thin:
        package = [import_seconds(("srm_mbs",)) for _ in range(repeats)]
        everything = [import_seconds(("srm_mbs", *HEAVY)) for _ in range(repeats)]
        _append(
            results,
            "imports of plots, browser, optimisers, command line",
            "import srm_mbs",
            min(package),
            min(everything),
            say,
        )


def _append(
    results: Results,
    item: str,
    case: str,
    skipped: float,
    done: float,
    say: Callable[[str], None],
) -> None:
    results.unneeded.append({"item": item, "case": case, "skipped": skipped, "done": done})
    say(f"skipped: {item} ({case}): {1e3 * skipped:.1f} ms, done anyway {1e3 * done:.1f} ms")
